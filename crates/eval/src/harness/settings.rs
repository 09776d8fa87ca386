//! The settings that all runs of a harness share.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::ValueEnum;
use serde::Serialize;

use crate::error::EvalError;
use crate::impairment::BackendChoice;

/// The DDS library of the publishers and subscribers.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Library {
    /// Fast DDS
    Fast,
    /// Cyclone DDS
    Cyclone,
    /// RustDDS
    Rust,
}

impl Library {
    /// The name used on the command line.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Fast => "fast",
            Self::Cyclone => "cyclone",
            Self::Rust => "rust",
        }
    }
}

/// Distance between the seeds of two repetitions: more than a run has links.
const SEEDS_OF_A_REPETITION: u64 = 1_000;

/// Settings of the harness that apply to all runs.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The folder of the results.
    pub out: PathBuf,
    /// Path of this program.
    pub harness: PathBuf,
    /// Path of the program `adaptive-bridge`.
    pub bridge: PathBuf,
    /// The folder of the peer programs.
    pub peers: PathBuf,
    /// Whether runs are smoke runs.
    pub quick: bool,
    /// Seed of the links.
    pub seed: u64,
    /// Back end of the links.
    pub backend: BackendChoice,
    /// The CPUs that run the programs of a host, in the format of `taskset`, by host.
    pub pins: BTreeMap<String, String>,
    /// The harness's command line, for the manifest.
    pub command_line: Vec<String>,
}

impl Settings {
    /// How long publishers publish before the measured window begins, in seconds: enough for matching and for
    /// the classifier's first window of probes.
    pub const fn settle_s(&self) -> f64 {
        if self.quick { 1.0 } else { 10.0 }
    }

    /// The back end's name on the command line.
    pub const fn backend_name(&self) -> &'static str {
        match self.backend {
            BackendChoice::Auto => "auto",
            BackendChoice::Nfqueue => "nfqueue",
            BackendChoice::Netem => "netem",
        }
    }

    /// The seed of a run's link, by its number from 0. Repetitions have different losses, so that their
    /// spread is meaningful; scenarios of the same repetition have the same losses.
    pub fn link_seed(&self, repetition: u32, link: u16) -> u64 {
        let of_repetition = SEEDS_OF_A_REPETITION * u64::from(repetition.saturating_sub(1));
        self.seed.wrapping_add(of_repetition).wrapping_add(u64::from(link))
    }

    /// Finds the peer program of a library.
    ///
    /// # Errors
    /// The program has not been built.
    pub fn peer(&self, library: Library) -> Result<PathBuf, EvalError> {
        let name = format!("{}_peer", library.name());
        // Cargo builds the RustDDS peer into the folder `examples` beside this program.
        let beside = self.harness.parent().map(|folder| folder.join("examples"));
        let folders = std::iter::once(self.peers.clone()).chain(beside);
        let found = folders.map(|folder| folder.join(&name)).find(|path| path.exists());
        found.ok_or_else(|| {
            let how = match library {
                Library::Rust => "run `make peers` or `cargo build --example rust_peer`",
                _ => "run `make peers` and read its output",
            };
            EvalError::new(format!("{name} is not in {}: {how}", self.peers.display()))
        })
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    #[test]
    fn no_two_links_of_any_repetition_have_the_same_seed() {
        let settings = Settings {
            out: PathBuf::new(),
            harness: PathBuf::new(),
            bridge: PathBuf::new(),
            peers: PathBuf::new(),
            quick: false,
            seed: 1,
            backend: BackendChoice::Auto,
            pins: BTreeMap::new(),
            command_line: Vec::new(),
        };
        let seeds = || (1..=1_000).flat_map(|repetition| (0..8).map(move |link| (repetition, link)));
        let seeds: BTreeSet<u64> = seeds().map(|(run, link)| settings.link_seed(run, link)).collect();
        assert_eq!(seeds.len(), 8_000);
        assert_eq!(settings.link_seed(1, 0), 1);
    }
}
