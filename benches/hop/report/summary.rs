//! The results of a run, as stored in `summary.json`. Sections that were not measured are empty. Names of
//! figures end with their unit; unknown figures are `null`.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::statistics::quantile;

/// All results of a run.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Summary {
    pub date: String,
    pub machine: Machine,
    /// Placement, durations and other parameters, one per line of text.
    pub parameters: Vec<String>,
    /// Cases that were not measured, with the reason.
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

/// The machine, commit and command of a run.
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

/// The quantiles of a distribution, in µs.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quantiles {
    pub samples: u64,
    pub p50_us: Option<f64>,
    /// Only with 100 samples or more.
    pub p99_us: Option<f64>,
    /// Only with 1,000 samples or more: with fewer it would be the maximum.
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

/// The latency of one program at one rate and payload. Figures are of all repetitions together, except hops.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Latency {
    pub scheduling: String,
    pub rate_hz: u64,
    pub bytes: usize,
    /// `wake-up`, `direct`, `relay`, `bridge`.
    pub program: String,
    /// Samples that were sent and not received.
    pub missing: u64,
    /// The known reasons of missing samples: refused by a writer, or dropped, by drop reason.
    pub reasons: BTreeMap<String, u64>,
    /// From the write to the subscriber's decoder.
    pub latency: Quantiles,
    /// From the due time of the sample to the subscriber's decoder.
    pub from_due: Quantiles,
    /// The median of each repetition.
    pub repetitions_p50_us: Vec<f64>,
    /// The median, over the repetitions, of the difference of this p50 and the p50 of direct in the same
    /// repetition.
    pub hop_p50_us: Option<f64>,
    /// The same for the p99.
    pub hop_p99_us: Option<f64>,
    /// The CPU time of all threads of relay or bridge.
    pub cpu_us_per_sample: Option<f64>,
    /// The stages of the bridge: `DDS in`, `shared memory`, `hand-over`, `DDS out`.
    pub stages: BTreeMap<String, Quantiles>,
    /// The number of copies of a payload in user space from the receive buffer to the DDS writer.
    pub copies: Option<f64>,
}

/// A long run at a rate at which no sample may be lost.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Loss {
    pub scheduling: String,
    pub rate_hz: u64,
    pub bytes: usize,
    pub program: String,
    pub accepted: u64,
    /// Samples that the publisher's own writer refused.
    pub refused: u64,
    pub received: u64,
    pub lost: u64,
    pub disordered: u64,
    pub damaged: u64,
    pub drops: BTreeMap<String, u64>,
    /// Whether the bridge accounts for every sample: received = forwarded + every named drop.
    pub whole: Option<bool>,
}

/// The highest rate without loss of one program and payload.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Throughput {
    pub scheduling: String,
    pub bytes: usize,
    pub program: String,
    /// The highest rate that passed twice.
    pub rate_hz: Option<f64>,
    /// The failure at the next higher rate that was tried.
    pub limit: String,
    pub run_s: f64,
    pub attempts: Vec<Attempt>,
}

/// One run of that search.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Attempt {
    pub rate_hz: f64,
    /// The reason why the run failed; `None` when it passed.
    pub failure: Option<String>,
}

/// The resource usage of one process under one load.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Resource {
    /// `direct`, `relay`, `bridge`.
    pub program: String,
    pub process: String,
    /// The rate of the load; 0 when idle.
    pub rate_hz: u64,
    pub seconds: f64,
    pub samples: u64,
    pub cpu_ms: f64,
    /// The CPU time per sample in each repetition.
    pub repetitions_cpu_us: Vec<f64>,
    /// How often a thread went to sleep, and so was woken.
    pub sleeps: u64,
    /// How often a thread was preempted.
    pub preemptions: u64,
    /// Counted by perf in a run of its own; `None` without perf.
    pub system_calls_per_sample: Option<f64>,
    /// Resident memory at the end of the load.
    pub rss_kib: u64,
    pub anonymous_kib: u64,
    pub shared_kib: u64,
    pub file_kib: u64,
}

impl Resource {
    /// A value divided by the number of samples; `None` when idle.
    pub fn per_sample(&self, value: f64) -> Option<f64> {
        (self.samples > 0).then(|| value / self.samples as f64)
    }
}

/// The count of one system call of one process, by strace.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Call {
    pub program: String,
    pub process: String,
    pub rate_hz: u64,
    pub call: String,
    pub count: u64,
    pub samples: u64,
}

/// The figures of one program with a number of routes or lanes.
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
    /// The CPU time of each process.
    pub cpu_us_per_sample: BTreeMap<String, f64>,
    pub rss_kib: BTreeMap<String, u64>,
}

/// The latency of the critical lane in one condition of the noncritical one.
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
    /// The p99.9 of each round.
    pub rounds_p999_us: Vec<f64>,
    /// Samples that the noncritical egress forwarded.
    pub noncritical_forwarded: u64,
    pub kills: u64,
}

/// The memory of a bridge under load over time.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Soak {
    pub seconds: f64,
    pub load: String,
    pub accepted: u64,
    pub missing: u64,
    pub reasons: BTreeMap<String, u64>,
    /// The periods of load in which samples are missing.
    pub lossy: Vec<Lossy>,
    /// The longest delay of a CPU within 100 ms in all other periods; `None` in older runs.
    pub held_up_ms: Option<f64>,
    pub series: Vec<SoakSeries>,
}

/// A period of load, some seconds long, in which samples are missing.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Lossy {
    /// The end of the period, in seconds since the soak began.
    pub at_s: f64,
    pub missing: u64,
    /// The longest delay of a CPU within 100 ms.
    pub held_up_ms: f64,
}

/// The values of one quantity over time, of one process or of the shared memory of all.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct SoakSeries {
    pub name: String,
    /// `KiB`, `samples`, `descriptors`.
    pub unit: String,
    /// Pairs of the time in seconds since the soak began and the value.
    pub points: Vec<(f64, f64)>,
}
