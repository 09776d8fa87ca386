//! What a run gave, as `summary.json` holds it. A section that was not measured is empty. Figures are in the
//! unit that their name ends with; `null` is not known.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::statistics::quantile;

/// All of a run.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Summary {
    pub date: String,
    pub machine: Machine,
    /// Placement, durations and the like, a sentence each.
    pub parameters: Vec<String>,
    /// What was not measured, and why.
    pub skipped: Vec<String>,
    pub latency: Vec<Latency>,
    pub loss: Vec<Loss>,
    pub throughput: Vec<Throughput>,
    pub resources: Vec<Resource>,
    pub calls: Vec<Call>,
    pub scale: Vec<Scale>,
    pub isolation: Vec<Isolation>,
    pub soak: Option<Soak>,
}

/// What the figures depend on.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Machine {
    pub cpu: String,
    pub cpus: usize,
    pub kernel: String,
    pub commit: String,
    pub command: String,
    pub load_average: String,
    pub rmem_max: String,
}

/// A distribution, in µs.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quantiles {
    pub samples: u64,
    pub p50_us: Option<f64>,
    /// Of 100 samples or more.
    pub p99_us: Option<f64>,
    /// Of 1,000 samples or more: of fewer it would be the maximum by another name.
    pub p999_us: Option<f64>,
    pub max_us: Option<f64>,
}

impl Quantiles {
    pub fn of(us: &[f64]) -> Self {
        let samples = us.iter().filter(|value| value.is_finite()).count();
        let of = |share: f64, least: usize| (samples >= least).then(|| quantile(us, share));
        Self {
            samples: samples as u64,
            p50_us: of(0.5, 1),
            p99_us: of(0.99, 100),
            p999_us: of(0.999, 1_000),
            max_us: of(1.0, 1),
        }
    }
}

/// Latency of one program at one rate and payload. All repetitions together, but for hops.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Latency {
    pub scheduling: String,
    pub rate_hz: u64,
    pub bytes: usize,
    /// `wake-up`, `direct`, `relay`, `bridge`.
    pub program: String,
    /// Sent and not received.
    pub missing: u64,
    /// What became of those, as far as anybody said so: refused, or dropped by name.
    pub reasons: BTreeMap<String, u64>,
    /// From the write to the subscriber's decoder.
    pub latency: Quantiles,
    /// The same, from when the sample was due.
    pub from_due: Quantiles,
    /// The median of each repetition.
    pub repetitions_p50_us: Vec<f64>,
    /// The median, over the repetitions, of what is beyond direct in the same repetition.
    pub hop_p50_us: Option<f64>,
    pub hop_p99_us: Option<f64>,
    /// What all threads of relay or bridge had of the CPUs.
    pub cpu_us_per_sample: Option<f64>,
    /// Of the bridge: `DDS in`, `shared memory`, `hand-over`, `DDS out`.
    pub stages: BTreeMap<String, Quantiles>,
    /// Copies of a payload in user space from the receive buffer to the DDS writer.
    pub copies: Option<f64>,
}

/// A long run at a rate that must lose nothing.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Loss {
    pub scheduling: String,
    pub rate_hz: u64,
    pub bytes: usize,
    pub program: String,
    pub accepted: u64,
    /// Refused by the publisher's own writer.
    pub refused: u64,
    pub received: u64,
    pub lost: u64,
    pub disordered: u64,
    pub damaged: u64,
    pub drops: BTreeMap<String, u64>,
    /// Of the bridge: received = forwarded + every named drop.
    pub whole: Option<bool>,
}

/// The highest rate without loss.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Throughput {
    pub scheduling: String,
    pub bytes: usize,
    pub program: String,
    /// Nothing was lost here, twice in a row.
    pub rate_hz: Option<f64>,
    /// What ended the search at the next higher rate that was tried.
    pub limit: String,
    pub run_s: f64,
    pub attempts: Vec<Attempt>,
}

/// One run of that search.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Attempt {
    pub rate_hz: f64,
    /// Why the rate does not count; none where it does.
    pub failure: Option<String>,
}

/// What one process takes under one load.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Resource {
    /// `direct`, `relay`, `bridge`.
    pub program: String,
    pub process: String,
    /// 0: idle.
    pub rate_hz: u64,
    pub seconds: f64,
    pub samples: u64,
    pub cpu_ms: f64,
    /// For each sample, of each repetition.
    pub repetitions_cpu_us: Vec<f64>,
    /// Times that a thread went to sleep, and so was woken.
    pub sleeps: u64,
    /// Times that a thread was taken off its CPU.
    pub preemptions: u64,
    /// By perf, where it can; in a run of its own.
    pub system_calls_per_sample: Option<f64>,
    /// Resident, at the end of the load.
    pub rss_kib: u64,
    pub anonymous_kib: u64,
    pub shared_kib: u64,
    pub file_kib: u64,
}

impl Resource {
    pub fn per_sample(&self, value: f64) -> Option<f64> {
        (self.samples > 0).then(|| value / self.samples as f64)
    }
}

/// One system call of one process, as strace counted it.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Call {
    pub program: String,
    pub process: String,
    pub rate_hz: u64,
    pub call: String,
    pub count: u64,
    pub samples: u64,
}

/// One program with so many routes or lanes.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Scale {
    /// `routes` or `lanes`.
    pub of: String,
    pub count: usize,
    pub program: String,
    pub rate_hz: u64,
    pub bytes: usize,
    pub missing: u64,
    pub reasons: BTreeMap<String, u64>,
    pub latency: Quantiles,
    pub repetitions_p50_us: Vec<f64>,
    /// Of each process.
    pub cpu_us_per_sample: BTreeMap<String, f64>,
    pub rss_kib: BTreeMap<String, u64>,
}

/// The critical lane while something is wrong with the noncritical one.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Isolation {
    pub scheduling: String,
    pub condition: String,
    /// The condition that it is compared with.
    pub against: String,
    pub rate_hz: u64,
    pub missing: u64,
    pub reasons: BTreeMap<String, u64>,
    pub latency: Quantiles,
    /// Of each round.
    pub rounds_p999_us: Vec<f64>,
    /// What the noncritical egress forwarded meanwhile.
    pub noncritical_forwarded: u64,
    pub kills: u64,
}

/// Memory over time.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Soak {
    pub seconds: f64,
    pub load: String,
    pub accepted: u64,
    pub missing: u64,
    pub reasons: BTreeMap<String, u64>,
    /// Where samples are missing.
    pub lossy: Vec<Lossy>,
    /// The most that a CPU was held up for within 100 ms, where none are missing; `None` in older runs.
    pub held_up_ms: Option<f64>,
    pub series: Vec<SoakSeries>,
}

/// Some seconds of load of which samples are missing.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Lossy {
    /// When they ended, in seconds since the first began.
    pub at_s: f64,
    pub missing: u64,
    /// The most that a CPU was held up for within 100 ms.
    pub held_up_ms: f64,
}

/// One process, or the shared memory of all.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct SoakSeries {
    pub name: String,
    /// `KiB`, `samples`, `descriptors`.
    pub unit: String,
    /// Seconds since the load began, and value.
    pub points: Vec<(f64, f64)>,
}
