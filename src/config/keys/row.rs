//! What is declared of a configuration key.

use std::fmt::Write as _;

/// The declaration of a key, or of several that differ in their place only. The list of known keys, the
/// reading and checking of the value, its default, the messages, what a reload applies and the tables of
/// `config/README.md` come from it.
#[derive(Debug)]
pub struct Row {
    /// The paths. `[]` is an item of a list; a name in angle brackets is a name that the user chooses.
    pub paths: &'static [&'static str],
    /// Type and range.
    pub kind: Kind,
    /// The unit; empty for none.
    unit: &'static str,
    /// What the documentation adds to the range.
    note: &'static str,
    /// The default as in the documentation: a value, or where it is taken from.
    pub default: &'static str,
    /// Whether a reload applies a change; if not, it waits for a restart.
    pub reloads: bool,
    /// One line of documentation.
    pub documentation: &'static str,
}

/// The type and the range of a value.
#[derive(Clone, Copy, Debug)]
pub enum Kind {
    /// A boolean.
    Flag,
    /// A whole number, with the least and the greatest.
    Whole(u64, u64),
    /// A number, with the least and the greatest.
    Decimal(f64, f64),
    /// One of these words.
    Choice(fn() -> Vec<&'static str>),
    /// Another type, which its reader checks; the allowed values as in the documentation.
    Other(&'static str),
}

/// The words of a choice.
pub(super) fn names<T>(choices: &[(&'static str, T)]) -> Vec<&'static str> {
    choices.iter().map(|(name, _)| *name).collect()
}

impl Row {
    pub(super) const fn new(
        paths: &'static [&'static str],
        kind: Kind,
        default: &'static str,
        documentation: &'static str,
    ) -> Self {
        Self { paths, kind, unit: "", note: "", default, reloads: false, documentation }
    }

    pub(super) const fn unit(self, unit: &'static str) -> Self {
        Self { unit, ..self }
    }

    pub(super) const fn note(self, note: &'static str) -> Self {
        Self { note, ..self }
    }

    pub(super) const fn reloads(self) -> Self {
        Self { reloads: true, ..self }
    }

    /// The range and the unit, for the documentation.
    pub fn range(&self) -> String {
        let mut range = match self.kind {
            Kind::Flag => "`true`, `false`".to_owned(),
            Kind::Whole(least, most) => format!("{least} to {most}"),
            Kind::Decimal(least, most) => format!("{least} to {most}"),
            Kind::Choice(names) => format!("`{}`", names().join("`, `")),
            Kind::Other(allowed) => allowed.to_owned(),
        };
        if !self.unit.is_empty() {
            let _ = write!(range, " {}", self.unit);
        }
        range + self.note
    }

    /// The row of this key in the tables of `config/README.md`.
    pub fn documented(&self) -> String {
        let Self { paths, default, documentation, reloads, .. } = self;
        let keys = paths.join("` `");
        let sign = if *reloads { " ↻" } else { "" };
        format!("| `{keys}`{sign} | {documentation} | {} | {default} |", self.range())
    }
}
