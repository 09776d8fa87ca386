//! Computes the figures of one run.

use std::collections::{BTreeMap, HashSet};

use super::record::{Attempt, Published, Role, Run, Subscribed};
use crate::statistics::{
    Change, Distribution, Reaction, Received, Reception, WINDOW_S, longest_silence_s, outstanding, reactions,
    received, share_in, sliding_rate,
};

/// A publish call that takes longer than this counts as blocked: half a period at the paper's 30 Hz.
pub const BLOCKED_MS: f64 = 1000.0 / 60.0;

/// The figures of a run. Latencies and rates are of samples whose attempt to publish is in the measured
/// window.
#[derive(Clone, Debug, Default)]
pub struct Measures {
    /// Attempts to publish per second, mean over the paper's windows; of several publishers, the slowest.
    pub rate_hz: Option<f64>,
    /// Standard deviation of the rate over these windows; of several publishers, the largest.
    pub rate_std_hz: Option<f64>,
    /// The configured rate of a publisher.
    pub nominal_hz: f64,
    /// Attempts to publish.
    pub attempts: usize,
    /// Attempts that failed.
    pub failed: usize,
    /// Attempts that took longer than [`BLOCKED_MS`].
    pub blocked: usize,
    /// Durations of publish calls.
    pub call_ms: Distribution,
    /// Latencies of the critical subscribers.
    pub critical_ms: Distribution,
    /// Samples that the critical subscribers received and missed.
    pub critical: Received,
    /// The longest time in which a critical subscriber received no sample.
    pub critical_gap_ms: Option<f64>,
    /// Latencies of the remote subscribers.
    pub noncritical_ms: Distribution,
    /// Receptions per second of a remote subscriber; of several, the slowest.
    pub noncritical_hz: Option<f64>,
    /// The largest number of samples that the writer had to hold for a remote subscriber of the publisher's
    /// own topic.
    pub outstanding_max: Option<usize>,
    /// Transitions of the classifier, of all subscribers.
    pub transitions: Option<u64>,
    /// The classifier's reactions to toggles of the link.
    pub reactions: Vec<Reaction>,
    /// The share of the impaired time in which the noncritical lane was degraded.
    pub degraded_share: Option<f64>,
    /// Bytes of payload per second that the noncritical lanes sent while a link was impaired.
    pub lane_impaired_bytes_per_s: Option<f64>,
    /// Bytes per second on the wire to the remote hosts while a link was impaired.
    pub wire_impaired_bytes_per_s: Option<f64>,
    /// Bytes per second on the wire to the remote hosts.
    pub wire_bytes_per_s: Option<f64>,
    /// IP fragments sent to the remote hosts.
    pub fragments_to_remote: Option<u64>,
    /// Repair requests (ACKNACK and NACK_FRAG) from the remote hosts.
    pub acknacks: Option<u64>,
    /// Heartbeats to the remote hosts.
    pub heartbeats: Option<u64>,
    /// The largest memory of incomplete datagrams at the switch.
    pub fragment_memory_max_bytes: Option<u64>,
    /// Incomplete datagrams that the switch discarded.
    pub reassembly_failed: Option<u64>,
    /// Datagrams that hosts dropped because a receive buffer was full; if any, the test bed was too slow.
    pub udp_buffer_errors: Option<u64>,
    /// CPU time and memory of each process.
    pub usage: BTreeMap<String, Usage>,
    /// Lanes of routes with samples that were neither forwarded nor counted under a drop reason.
    pub unaccounted_lanes: Option<usize>,
}

/// CPU time and memory of a process.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Usage {
    /// CPU time per time, in percent of one core.
    pub cpu_percent: f64,
    /// The largest resident memory.
    pub rss_max_bytes: u64,
}

impl Measures {
    /// Computes the figures of a run.
    pub fn of(run: &Run) -> Self {
        let mut measures = Self::default();
        measures.measure_publishers(run);
        measures.measure_critical(run);
        measures.measure_remote(run);
        measures.measure_classifier(run);
        measures.measure_network(run);
        measures.usage = usage(run);
        measures
    }

    fn measure_publishers(&mut self, run: &Run) {
        let mut calls = Vec::new();
        for publisher in &run.published {
            let attempts: Vec<&Attempt> = in_window(publisher, run).collect();
            let times: Vec<f64> = attempts.iter().map(|attempt| attempt.at_s).collect();
            let nominal_hz = publisher.endpoint.rate_hz;
            if let Some(spread) = sliding_rate(&times, 0.0, run.length_s(), 1.0 / nominal_hz).spread() {
                self.rate_hz = lower(self.rate_hz, Some(spread.mean));
                self.rate_std_hz = higher(self.rate_std_hz, Some(spread.deviation));
            }
            self.nominal_hz = nominal_hz;
            self.attempts += attempts.len();
            self.failed += attempts.iter().filter(|attempt| !attempt.ok).count();
            calls.extend(attempts.iter().map(|attempt| attempt.call_ms));
        }
        self.call_ms = Distribution::new(calls);
        self.blocked = self.call_ms.above(BLOCKED_MS);
    }

    fn measure_critical(&mut self, run: &Run) {
        let mut latencies = Vec::new();
        for subscriber in run.of_role(Role::Critical) {
            let written = written_for(run, subscriber);
            // A sample is late once the next one is due, which is more useful to a robot.
            let late_ms = 1000.0 / subscriber.endpoint.rate_hz;
            let receptions = of_window(subscriber, &written);
            let one = received(written.iter().map(|(_, seq)| *seq), &receptions, late_ms);
            self.critical.samples += one.samples;
            self.critical.lost += one.lost;
            self.critical.repeated += one.repeated;
            self.critical.reordered += one.reordered;
            self.critical.late += one.late;
            let times = subscriber.receptions.iter().map(|reception| reception.at_s);
            let gap_ms = longest_silence_s(times, 0.0, run.length_s()) * 1e3;
            self.critical_gap_ms = higher(self.critical_gap_ms, Some(gap_ms));
            latencies.extend(receptions.iter().map(|reception| reception.latency_ms));
        }
        self.critical_ms = Distribution::new(latencies);
    }

    fn measure_remote(&mut self, run: &Run) {
        let mut latencies = Vec::new();
        for subscriber in run.of_role(Role::Slow) {
            let written = written_for(run, subscriber);
            latencies.extend(of_window(subscriber, &written).iter().map(|reception| reception.latency_ms));
            let in_window = |at_s: f64| (0.0..run.length_s()).contains(&at_s);
            let received = subscriber.receptions.iter().filter(|reception| in_window(reception.at_s)).count();
            self.noncritical_hz = lower(self.noncritical_hz, Some(received as f64 / run.length_s()));
            // A lane's writer is BEST_EFFORT and holds no samples.
            if subscriber.endpoint.lane.is_none() {
                let most = backlog(run, subscriber).into_iter().map(|(_, held)| held).max();
                self.outstanding_max = self.outstanding_max.max(most);
            }
        }
        self.noncritical_ms = Distribution::new(latencies);
    }

    fn measure_classifier(&mut self, run: &Run) {
        let Some(bridge) = &run.bridge else { return };
        self.unaccounted_lanes = Some(bridge.unaccounted_lanes);
        self.lane_impaired_bytes_per_s = growth_per_s(&bridge.noncritical_bytes, &run.impaired_spans());
        if run.manifest.classifier != Some(true) {
            self.transitions = Some(0);
        } else {
            self.transitions = Some(bridge.subscribers.iter().map(|(_, record)| record.transitions).sum());
            let toggles = run.toggles();
            let (demoted, promoted) = ("NONCRITICAL".to_owned(), "CRITICAL".to_owned());
            self.reactions = bridge
                .subscribers
                .iter()
                .flat_map(|(_, record)| {
                    reactions(&toggles, &record.states, &demoted, &promoted, run.length_s())
                })
                .collect();
        }
        let degraded = "degraded".to_owned();
        let impaired_s = total_s(&run.impaired_spans());
        let share = |changes: &Vec<Change<String>>| {
            let spent = run
                .impaired_spans()
                .into_iter()
                .map(|(from_s, to_s)| share_in(changes, &degraded, from_s, to_s) * (to_s - from_s));
            (impaired_s > 0.0).then(|| spent.sum::<f64>() / impaired_s)
        };
        self.degraded_share = bridge
            .lanes
            .iter()
            .find(|(name, _)| name == "noncritical")
            .and_then(|(_, changes)| share(changes));
    }

    fn measure_network(&mut self, run: &Run) {
        let remote = remote_hosts(run);
        let spans = run.impaired_spans();
        for host in &remote {
            let points: Vec<(f64, u64)> = run
                .wire
                .iter()
                .filter(|reading| reading.port == *host)
                .map(|reading| (reading.at_s, reading.to_host_bytes))
                .collect();
            let all = [(0.0, run.length_s())];
            self.wire_bytes_per_s = sum(self.wire_bytes_per_s, growth_per_s(&points, &all));
            self.wire_impaired_bytes_per_s =
                sum(self.wire_impaired_bytes_per_s, growth_per_s(&points, &spans));
            let towards: Vec<_> = run
                .rtps
                .iter()
                .filter(|reading| reading.port == *host && reading.direction == "to_host")
                .collect();
            let back: Vec<_> = run
                .rtps
                .iter()
                .filter(|reading| reading.port == *host && reading.direction == "from_host")
                .collect();
            if let (Some(first), Some(last)) = (towards.first(), towards.last()) {
                let grown = |one: u64, other: u64| Some(other.saturating_sub(one));
                self.fragments_to_remote =
                    sum(self.fragments_to_remote, grown(first.fragments, last.fragments));
                self.heartbeats = sum(self.heartbeats, grown(first.user_heartbeat, last.user_heartbeat));
            }
            if let (Some(first), Some(last)) = (back.first(), back.last()) {
                let grown = last.user_acknack.saturating_sub(first.user_acknack);
                self.acknacks = sum(self.acknacks, Some(grown));
            }
        }
        let switch = || run.kernel.iter().filter(|reading| reading.host == "switch");
        self.fragment_memory_max_bytes = switch().map(|reading| reading.fragment_memory_bytes).max();
        if let (Some(first), Some(last)) = (switch().next(), switch().next_back()) {
            self.reassembly_failed = Some(last.reassembly_failed.saturating_sub(first.reassembly_failed));
        }
        let mut errors: BTreeMap<&str, (u64, u64)> = BTreeMap::new();
        for reading in &run.kernel {
            let span = errors.entry(&reading.host).or_insert((reading.udp_buffer_errors, 0));
            span.1 = reading.udp_buffer_errors.saturating_sub(span.0);
        }
        self.udp_buffer_errors = (!errors.is_empty()).then(|| errors.values().map(|span| span.1).sum());
    }

    /// The slowest demotion (`impaired`) or promotion, in seconds; toggles without a reaction are ignored.
    pub fn slowest_reaction_s(&self, impaired: bool) -> Option<f64> {
        let of_kind = self.reactions.iter().filter(|reaction| reaction.impaired == impaired);
        of_kind.filter_map(|reaction| reaction.after_s).max_by(f64::total_cmp)
    }

    /// The sum of CPU time and memory over the bridge's processes; `None` without a bridge.
    pub fn bridge_usage(&self) -> Option<Usage> {
        let of_bridge = |name: &&String| {
            matches!(name.as_str(), "up" | "ingress" | "control") || name.starts_with("egress-")
        };
        let mut processes = self.usage.iter().filter(|(name, _)| of_bridge(name)).map(|(_, usage)| *usage);
        let first = processes.next()?;
        Some(processes.fold(first, |sum, one| Usage {
            cpu_percent: sum.cpu_percent + one.cpu_percent,
            rss_max_bytes: sum.rss_max_bytes + one.rss_max_bytes,
        }))
    }
}

/// Lists the hosts of remote subscribers without duplicates.
pub fn remote_hosts(run: &Run) -> Vec<String> {
    let mut hosts: Vec<String> = run.of_role(Role::Slow).map(|one| one.endpoint.host.clone()).collect();
    hosts.sort();
    hosts.dedup();
    hosts
}

/// Samples that the writer of a remote subscriber's topic had to hold for it, `(seconds, samples)`: just
/// after each write, when the number is largest, and four times a second, as the writer may accept none for
/// long.
pub fn backlog(run: &Run, subscriber: &Subscribed) -> Vec<(f64, usize)> {
    let publishers = run.published.iter().filter(|one| one.endpoint.route == subscriber.endpoint.route);
    let attempts = publishers.flat_map(|publisher| &publisher.attempts);
    let written: Vec<(f64, u64)> =
        attempts.filter(|attempt| attempt.ok).map(|attempt| (attempt.at_s, attempt.seq)).collect();
    let quarters = (0..(run.length_s() * 4.0) as u32).map(|quarter| f64::from(quarter) / 4.0);
    let mut times: Vec<f64> = written.iter().map(|(at_s, _)| *at_s).chain(quarters).collect();
    times.sort_by(f64::total_cmp);
    let held = outstanding(&written, &subscriber.receptions, &times);
    let in_window = |(at_s, _): &(f64, usize)| (0.0..run.length_s()).contains(at_s);
    times.into_iter().zip(held).filter(in_window).collect()
}

fn in_window<'a>(publisher: &'a Published, run: &Run) -> impl Iterator<Item = &'a Attempt> {
    let length_s = run.length_s();
    publisher.attempts.iter().filter(move |attempt| (0.0..length_s).contains(&attempt.at_s))
}

/// Time and sequence number of the samples that the publisher of a subscriber's route wrote in the window.
fn written_for(run: &Run, subscriber: &Subscribed) -> Vec<(f64, u64)> {
    let of_route = |one: &&Published| one.endpoint.route == subscriber.endpoint.route;
    let publishers = run.published.iter().filter(of_route);
    let written = publishers.flat_map(|one| in_window(one, run)).filter(|attempt| attempt.ok);
    written.map(|attempt| (attempt.at_s, attempt.seq)).collect()
}

/// A subscriber's receptions of these samples.
fn of_window(subscriber: &Subscribed, written: &[(f64, u64)]) -> Vec<Reception> {
    let numbers: HashSet<u64> = written.iter().map(|(_, seq)| *seq).collect();
    subscriber.receptions.iter().filter(|reception| numbers.contains(&reception.seq)).copied().collect()
}

/// The growth of a counter per second within spans of time; `None` without two readings within a span.
fn growth_per_s(points: &[(f64, u64)], spans: &[(f64, f64)]) -> Option<f64> {
    let (mut grown, mut over_s) = (0.0, 0.0);
    for pair in points.windows(2) {
        let [(from_s, from), (to_s, to)] = [pair[0], pair[1]];
        // Readings are a second apart; only pairs completely within a span count.
        if to_s > from_s && spans.iter().any(|span| span.0 <= from_s && to_s <= span.1) {
            grown += to.saturating_sub(from) as f64;
            over_s += to_s - from_s;
        }
    }
    (over_s > 0.0).then(|| grown / over_s)
}

fn usage(run: &Run) -> BTreeMap<String, Usage> {
    let mut usage: BTreeMap<String, Usage> = BTreeMap::new();
    let mut last: BTreeMap<(&str, u32), f64> = BTreeMap::new();
    let (mut first_s, mut last_s) = (f64::INFINITY, f64::NEG_INFINITY);
    let in_window = |at_s: f64| (-WINDOW_S..=run.length_s()).contains(&at_s);
    for reading in run.processes.iter().filter(|reading| in_window(reading.at_s)) {
        first_s = first_s.min(reading.at_s);
        last_s = last_s.max(reading.at_s);
        let used = usage.entry(reading.process.clone()).or_default();
        used.rss_max_bytes = used.rss_max_bytes.max(reading.rss_bytes);
        // The first reading of a process gives the initial value.
        if let Some(before) = last.insert((&reading.process, reading.pid), reading.cpu_ms) {
            used.cpu_percent += (reading.cpu_ms - before).max(0.0);
        }
    }
    let over_ms = (last_s - first_s) * 1e3;
    for used in usage.values_mut() {
        used.cpu_percent = if over_ms > 0.0 { used.cpu_percent / over_ms * 100.0 } else { 0.0 };
    }
    usage
}

fn total_s(spans: &[(f64, f64)]) -> f64 {
    spans.iter().map(|(from_s, to_s)| to_s - from_s).sum()
}

fn lower(one: Option<f64>, other: Option<f64>) -> Option<f64> {
    one.into_iter().chain(other).min_by(f64::total_cmp)
}

fn higher(one: Option<f64>, other: Option<f64>) -> Option<f64> {
    one.into_iter().chain(other).max_by(f64::total_cmp)
}

fn sum<T: std::ops::Add<Output = T>>(one: Option<T>, other: Option<T>) -> Option<T> {
    match (one, other) {
        (Some(one), Some(other)) => Some(one + other),
        (one, other) => one.or(other),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::made_up::MadeUp;
    use crate::report::record::ProcessReading;

    #[test]
    fn figures_of_a_run_match_those_calculated_by_hand() {
        let run = MadeUp {
            scenario: "bridge_moderate",
            reading: "as-run",
            tail_ms: 40.0,
            lost: 3,
            reaction_s: Some(5.0),
            fragments_per_s: 2,
            ..MadeUp::default()
        };
        let measures = Measures::of(&run.run());
        assert_eq!((measures.attempts, measures.failed, measures.blocked), (600, 0, 0));
        assert_eq!(measures.rate_hz, Some(30.0));
        assert_eq!(measures.critical, Received { samples: 597, lost: 3, late: 60, ..Received::default() });
        assert_eq!(measures.critical_ms.quantile(0.5), Some(0.5));
        assert_eq!(measures.critical_ms.max(), Some(40.0));
        // Three samples are missing after a late one: four periods, less the difference between the latencies
        // of the late sample and the next.
        let gap_ms = measures.critical_gap_ms.unwrap();
        assert!((gap_ms - (4000.0 / 30.0 - 39.5)).abs() < 1e-6, "{gap_ms}");
        assert_eq!((measures.wire_bytes_per_s, measures.wire_impaired_bytes_per_s), (Some(1e4), Some(1e4)));
        assert_eq!(measures.fragments_to_remote, Some(40));
        assert_eq!(measures.transitions, Some(1));
        assert_eq!(measures.slowest_reaction_s(true), Some(5.0));
        assert_eq!(measures.slowest_reaction_s(false), None);
        // The writer of a lane holds no samples.
        assert_eq!(measures.outstanding_max, None);
        let baseline = MadeUp { tail_ms: 90.0, ..MadeUp::default() };
        // The slow sample, and the two that were published while it was in transit.
        assert_eq!(Measures::of(&baseline.run()).outstanding_max, Some(3));
    }

    #[test]
    fn a_disabled_classifier_has_no_transitions() {
        let run = MadeUp { scenario: "bridge_ablation", reading: "as-run", ..MadeUp::default() };
        let measures = Measures::of(&run.run());
        assert_eq!((measures.transitions, measures.reactions.len()), (Some(0), 0));
        assert_eq!(Measures::of(&MadeUp::default().run()).transitions, None);
    }

    #[test]
    fn cpu_time_of_a_restarted_process_is_the_sum_of_both() {
        let mut run = MadeUp::default().run();
        let reading = |at_s: f64, pid, cpu_ms| ProcessReading {
            at_s,
            process: "ingress".to_owned(),
            pid,
            cpu_ms,
            rss_bytes: 7,
        };
        run.processes = vec![
            reading(0.0, 1, 50.0),
            reading(5.0, 1, 550.0),
            reading(6.0, 2, 10.0),
            reading(10.0, 2, 510.0),
        ];
        let used = usage(&run)["ingress"];
        assert_eq!(used, Usage { cpu_percent: 10.0, rss_max_bytes: 7 });
    }

    #[test]
    fn growth_counts_whole_seconds_within_the_spans() {
        let points: Vec<(f64, u64)> =
            (0..10).map(|second| (f64::from(second) + 0.5, second as u64 * 100)).collect();
        assert_eq!(growth_per_s(&points, &[(0.0, 10.0)]), Some(100.0));
        assert_eq!(growth_per_s(&points, &[(2.0, 4.0), (6.0, 8.0)]), Some(100.0));
        assert_eq!(growth_per_s(&points, &[(2.0, 2.9)]), None);
        assert_eq!(growth_per_s(&[], &[(0.0, 10.0)]), None);
    }
}
