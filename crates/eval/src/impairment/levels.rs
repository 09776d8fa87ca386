//! The impairments of the paper's evaluation (Table I), in both readings.

use clap::ValueEnum;
use serde::{Deserialize, Serialize};

use super::gilbert_elliott::GilbertElliott;

/// A row of Table I.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Level {
    /// No loss.
    Clean,
    /// p = 1 %, r = 15 %, 0.5 % and 30 %.
    Mild,
    /// p = 3 %, r = 15 %, 0.5 % and 40 %.
    Moderate,
    /// p = 2 %, r = 10 %, 1 % and 50 %.
    Strong,
}

/// How the last two columns of Table I are read. netem takes the loss in the bad state before that in the
/// good state (tc-netem(8)); the paper's harness passes them in the opposite order. So the losses that were
/// run differ from the printed ones, and each figure belongs to one of the two readings.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Reading {
    /// As printed in the table: 2.3, 7.1 and 9.2 % are lost in the long run.
    AsPrinted,
    /// As the paper's harness ran it, with the losses of the two states swapped: 28, 33 and 42 %.
    AsRun,
}

impl Reading {
    /// The name used on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::AsPrinted => "as-printed",
            Self::AsRun => "as-run",
        }
    }
}

impl Level {
    /// All rows.
    pub const ALL: [Self; 4] = [Self::Clean, Self::Mild, Self::Moderate, Self::Strong];

    /// The name used on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Clean => "clean",
            Self::Mild => "mild",
            Self::Moderate => "moderate",
            Self::Strong => "strong",
        }
    }

    /// The loss model of this row.
    pub const fn model(self, reading: Reading) -> GilbertElliott {
        let (p, r, loss_good, loss_bad) = match self {
            Self::Clean => return GilbertElliott::CLEAN,
            Self::Mild => (0.01, 0.15, 0.005, 0.30),
            Self::Moderate => (0.03, 0.15, 0.005, 0.40),
            Self::Strong => (0.02, 0.10, 0.010, 0.50),
        };
        match reading {
            Reading::AsPrinted => GilbertElliott::of_table(p, r, loss_good, loss_bad),
            Reading::AsRun => GilbertElliott::of_table(p, r, loss_bad, loss_good),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_stationary_losses_are_those_of_the_paper_and_of_its_counters() {
        let percent = |level: Level, reading| level.model(reading).stationary_loss() * 100.0;
        let round = |value: f64, unit: f64| (value / unit).round() * unit;
        let printed = Level::ALL.map(|level| round(percent(level, Reading::AsPrinted), 0.1));
        for (value, paper) in printed.into_iter().zip([0.0, 2.3, 7.1, 9.2]) {
            assert!((value - paper).abs() < 1e-9, "{printed:?}");
        }
        let run = Level::ALL.map(|level| percent(level, Reading::AsRun).round());
        assert_eq!(run, [0.0, 28.0, 33.0, 42.0]);
    }

    #[test]
    fn the_readings_differ_by_the_losses_of_the_states_only() {
        for level in Level::ALL {
            let (printed, run) = (level.model(Reading::AsPrinted), level.model(Reading::AsRun));
            assert_eq!((printed.p(), printed.r()), (run.p(), run.r()));
            assert_eq!((printed.loss_good(), printed.loss_bad()), (run.loss_bad(), run.loss_good()));
        }
    }
}
