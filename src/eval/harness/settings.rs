//! What holds for all runs of a harness.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::ValueEnum;
use serde::Serialize;

use crate::eval::error::EvalError;
use crate::eval::impairment::BackendChoice;

/// Whose DDS the publishers and subscribers run on.
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
    /// As the command line has it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Fast => "fast",
            Self::Cyclone => "cyclone",
            Self::Rust => "rust",
        }
    }
}

/// How far the seeds of a repetition are from those of the next: more than a run has links.
const SEEDS_OF_A_REPETITION: u64 = 1_000;

/// What holds for all runs.
#[derive(Clone, Debug)]
pub struct Settings {
    /// The folder of the results.
    pub out: PathBuf,
    /// This program.
    pub harness: PathBuf,
    /// The program `adaptive-bridge`.
    pub bridge: PathBuf,
    /// The folder of the peers.
    pub peers: PathBuf,
    /// A smoke run.
    pub quick: bool,
    /// Of the links.
    pub seed: u64,
    /// What impairs the links.
    pub backend: BackendChoice,
    /// The CPUs, as `taskset` takes them, on which the programs of a host run.
    pub pins: BTreeMap<String, String>,
    /// The command line, for the record.
    pub command_line: Vec<String>,
}

impl Settings {
    /// How long a publisher publishes before the measured window begins, in seconds: matching is over by
    /// then, and the classifier has its first window of probes.
    pub const fn settle_s(&self) -> f64 {
        if self.quick { 1.0 } else { 10.0 }
    }

    /// The back end as the command line has it.
    pub const fn backend_name(&self) -> &'static str {
        match self.backend {
            BackendChoice::Auto => "auto",
            BackendChoice::Nfqueue => "nfqueue",
            BackendChoice::Netem => "netem",
        }
    }

    /// The seed of a link of a run, the links being numbered from 0. A repetition meets other losses than the
    /// one before it, or it would say nothing of the spread; scenarios of the same repetition meet the same.
    pub fn link_seed(&self, repetition: u32, link: u16) -> u64 {
        let of_repetition = SEEDS_OF_A_REPETITION * u64::from(repetition.saturating_sub(1));
        self.seed.wrapping_add(of_repetition).wrapping_add(u64::from(link))
    }

    /// The program of a library's publishers and subscribers.
    ///
    /// # Errors
    /// It is not built.
    pub fn peer(&self, library: Library) -> Result<PathBuf, EvalError> {
        let name = format!("{}_peer", library.name());
        // The one on RustDDS is built by cargo, beside this program.
        let beside = self.harness.parent().map(|folder| folder.join("examples"));
        let folders = std::iter::once(self.peers.clone()).chain(beside);
        let found = folders.map(|folder| folder.join(&name)).find(|path| path.exists());
        found.ok_or_else(|| {
            let how = match library {
                Library::Rust => "make peers, or cargo build --example rust_peer",
                _ => "make peers, and see what it says",
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
