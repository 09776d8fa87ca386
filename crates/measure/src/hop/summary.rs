//! The results of a run, as stored in `summary.json`. Sections that were not measured are empty. Names of
//! figures end with their unit; unknown figures are `null`.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::statistics::quantile;

/// All results of a run.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Summary {
    /// When the run began, such as `2025-11-20T14-05-00Z`.
    pub date: String,
    /// Where it ran.
    pub machine: Machine,
    /// Placement, durations and other parameters, one per line of text.
    pub parameters: Vec<String>,
    /// Cases that were not measured, with the reason.
    pub skipped: Vec<String>,
    /// Latency by rate and payload.
    pub latency: Vec<Latency>,
    /// Long runs at rates at which no sample may be lost.
    pub loss: Vec<Loss>,
    /// The highest rates without loss.
    pub throughput: Vec<Throughput>,
    /// CPU time, memory and system calls of each process.
    pub resources: Vec<Resource>,
    /// System calls by name.
    pub calls: Vec<Call>,
    /// Figures by number of routes and lanes.
    pub scale: Vec<Scale>,
    /// The critical lane while the noncritical one is disturbed.
    pub isolation: Vec<Isolation>,
    /// Samples by size, between programs of other DDS libraries.
    pub large: Vec<Large>,
    /// Memory over time.
    pub soak: Option<Soak>,
}

/// The machine, commit and command of a run.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Machine {
    /// The model of the CPU.
    pub cpu: String,
    /// The number of CPUs.
    pub cpus: usize,
    /// The version of the kernel.
    pub kernel: String,
    /// The commit of the build.
    pub commit: String,
    /// The command line of the run.
    pub command: String,
    /// The load average at the beginning.
    pub load_average: String,
    /// The kernel's limit of a socket's receive buffer, `net.core.rmem_max`.
    pub rmem_max: String,
}

/// The quantiles of a distribution, in µs.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quantiles {
    /// The number of samples.
    pub samples: u64,
    /// The median.
    pub p50_us: Option<f64>,
    /// Only with 100 samples or more.
    pub p99_us: Option<f64>,
    /// Only with 1,000 samples or more: with fewer it would be the maximum.
    pub p999_us: Option<f64>,
    /// The largest value.
    pub max_us: Option<f64>,
}

impl Quantiles {
    /// The quantiles of values in µs; ignores values that are not finite.
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
    /// `other` or `fifo`.
    pub scheduling: String,
    /// The rate of the publisher.
    pub rate_hz: u64,
    /// The size of the payload.
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
    /// The median, over the repetitions, of the difference of the p99, as for `hop_p50_us`.
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
    /// `other` or `fifo`.
    pub scheduling: String,
    /// The rate of the load.
    pub rate_hz: u64,
    /// The size of the payload.
    pub bytes: usize,
    /// `direct`, `relay`, `bridge`.
    pub program: String,
    /// Samples that the publisher's writer accepted.
    pub accepted: u64,
    /// Samples that the publisher's own writer refused.
    pub refused: u64,
    /// Samples that the subscriber received.
    pub received: u64,
    /// Samples that the subscriber did not receive.
    pub lost: u64,
    /// Samples that arrived after a later one.
    pub disordered: u64,
    /// Samples whose payload differs from the one sent.
    pub damaged: u64,
    /// Samples that the bridge dropped, by drop reason.
    pub drops: BTreeMap<String, u64>,
    /// Whether the bridge accounts for every sample: received = forwarded + every named drop.
    pub whole: Option<bool>,
}

/// The highest rate without loss of one program and payload.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Throughput {
    /// `other` or `fifo`.
    pub scheduling: String,
    /// The size of the payload.
    pub bytes: usize,
    /// `direct`, `relay`, `bridge`.
    pub program: String,
    /// The highest rate that passed twice.
    pub rate_hz: Option<f64>,
    /// The failure at the next higher rate that was tried.
    pub limit: String,
    /// The duration of each attempt.
    pub run_s: f64,
    /// The attempts of the search.
    pub attempts: Vec<Attempt>,
}

/// One run of that search.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Attempt {
    /// The rate that was tried.
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
    /// The process, such as `ingress`.
    pub process: String,
    /// The rate of the load; 0 when idle.
    pub rate_hz: u64,
    /// The duration of the load.
    pub seconds: f64,
    /// The number of samples.
    pub samples: u64,
    /// The CPU time of all threads.
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
    /// The part of it that no file backs.
    pub anonymous_kib: u64,
    /// The part of it in shared memory.
    pub shared_kib: u64,
    /// The part of it that files back.
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
    /// `direct`, `relay`, `bridge`.
    pub program: String,
    /// The process, such as `ingress`.
    pub process: String,
    /// The rate of the load.
    pub rate_hz: u64,
    /// The name of the system call.
    pub call: String,
    /// The number of calls.
    pub count: u64,
    /// The number of samples.
    pub samples: u64,
}

/// The figures of one program with a number of routes or lanes.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Scale {
    /// `routes` or `lanes`.
    pub of: String,
    /// The number of routes or lanes.
    pub count: usize,
    /// `direct`, `relay`, `bridge`.
    pub program: String,
    /// The rate of the load.
    pub rate_hz: u64,
    /// The size of the payload.
    pub bytes: usize,
    /// Samples that were sent and not received.
    pub missing: u64,
    /// The known reasons of missing samples.
    pub reasons: BTreeMap<String, u64>,
    /// From the write to the subscriber's decoder.
    pub latency: Quantiles,
    /// The median of each repetition.
    pub repetitions_p50_us: Vec<f64>,
    /// The CPU time of each process.
    pub cpu_us_per_sample: BTreeMap<String, f64>,
    /// The resident memory of each process.
    pub rss_kib: BTreeMap<String, u64>,
}

/// The latency of the critical lane in one condition of the noncritical one.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Isolation {
    /// `other` or `fifo`.
    pub scheduling: String,
    /// What disturbs the noncritical lane.
    pub condition: String,
    /// The condition that it is compared with.
    pub against: String,
    /// The rate of the load.
    pub rate_hz: u64,
    /// Samples that were sent and not received.
    pub missing: u64,
    /// The known reasons of missing samples.
    pub reasons: BTreeMap<String, u64>,
    /// From the write to the critical subscriber's decoder.
    pub latency: Quantiles,
    /// The p99.9 of each round.
    pub rounds_p999_us: Vec<f64>,
    /// Samples that the noncritical egress forwarded.
    pub noncritical_forwarded: u64,
    /// How often the noncritical egress was killed.
    pub kills: u64,
}

/// One program between a publisher and a subscriber of one DDS library, at one rate and payload.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Large {
    /// The library of publisher and subscriber: `Fast DDS`, `Cyclone DDS`, `RustDDS`.
    pub library: String,
    /// `other` or `fifo`.
    pub scheduling: String,
    /// The rate of the publisher.
    pub rate_hz: u64,
    /// The size of the payload.
    pub bytes: usize,
    /// `direct`, `relay`, `bridge`.
    pub program: String,
    /// Whether all sockets had the receive buffers of a kernel without settings, 208 KiB.
    pub stock_buffers: bool,
    /// Samples that the publisher's writer accepted.
    pub accepted: u64,
    /// Of these, samples that the subscriber did not receive.
    pub missing: u64,
    /// Samples whose payload differs from the one sent.
    pub damaged: u64,
    /// The known reasons of missing samples: drops, by process and drop reason.
    pub reasons: BTreeMap<String, u64>,
    /// From the publisher's stamp before its write to the subscriber's after its take.
    pub latency: Quantiles,
    /// The median latency of each repetition.
    pub repetitions_p50_us: Vec<f64>,
    /// The CPU time for each sample in each repetition: of all processes of relay or bridge; of direct, of
    /// publisher and subscriber.
    pub repetitions_cpu_us: Vec<f64>,
}

/// The memory of a bridge under load over time.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Soak {
    /// The duration of the load.
    pub seconds: f64,
    /// The rates and payloads of the load.
    pub load: String,
    /// Samples that the publisher's writer accepted.
    pub accepted: u64,
    /// Samples that were sent and not received.
    pub missing: u64,
    /// The known reasons of missing samples.
    pub reasons: BTreeMap<String, u64>,
    /// The periods of load in which samples are missing.
    pub lossy: Vec<Lossy>,
    /// The longest delay of a CPU within 100 ms in all other periods; `None` in older runs.
    pub held_up_ms: Option<f64>,
    /// What was observed.
    pub series: Vec<SoakSeries>,
}

/// A period of load, some seconds long, in which samples are missing.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct Lossy {
    /// The end of the period, in seconds since the soak began.
    pub at_s: f64,
    /// Samples that were sent and not received.
    pub missing: u64,
    /// The longest delay of a CPU within 100 ms.
    pub held_up_ms: f64,
}

/// The values of one quantity over time, of one process or of the shared memory of all.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct SoakSeries {
    /// What is observed.
    pub name: String,
    /// `KiB`, `samples`, `descriptors`.
    pub unit: String,
    /// Pairs of the time in seconds since the soak began and the value.
    pub points: Vec<(f64, f64)>,
}
