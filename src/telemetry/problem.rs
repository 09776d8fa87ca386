//! A problem of the bridge, as `status` and the diagnostics show it.

/// The severity of a problem: the levels of `diagnostic_msgs/DiagnosticStatus`, with their numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Level {
    /// Nothing is wrong.
    Ok = 0,
    /// Something is wrong, but the bridge forwards samples.
    Warn = 1,
    /// A part of the bridge does not work.
    Error = 2,
    /// A part of the bridge, or a peer, sends no data.
    Stale = 3,
}

impl Level {
    /// `ok`, `warn`, `error` or `stale`.
    pub const fn label(self) -> &'static str {
        match self {
            Self::Ok => "ok",
            Self::Warn => "warn",
            Self::Error => "error",
            Self::Stale => "stale",
        }
    }

    /// The more severe of two levels. `Error` is above `Stale`, because missing data only suggests a fault.
    pub const fn worse(self, other: Self) -> Self {
        const RANKS: [u8; 4] = [0, 1, 3, 2];
        if RANKS[other as usize] > RANKS[self as usize] { other } else { self }
    }
}

/// An entry of `problems` in the report. Its JSON is the text alone.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(transparent)]
pub struct Problem {
    /// The part of the bridge: `bridge`, `ingress`, `control`, `safety`, `probes`, `network`, `intruders`,
    /// `lane NAME`, `route ID` or `subscriber ID`.
    #[serde(skip)]
    pub about: String,
    /// The severity.
    #[serde(skip)]
    pub level: Level,
    /// A sentence for users: what is wrong, with which part or peer, and what to do next.
    pub text: String,
}

impl Problem {
    /// Creates a problem of a part.
    pub(super) fn new(about: impl Into<String>, level: Level, text: String) -> Self {
        Self { about: about.into(), level, text }
    }
}
