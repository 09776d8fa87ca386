//! The measurements of one phase: computes its figures from the reports of its processes. Pure.

use std::collections::BTreeMap;
use std::ops::Range;

use serde::Serialize;

use super::children::Role;
use super::report::Report;
use super::{STALL_AFTER_MS, STALL_EVERY_MS, STALL_MS, due_at};
use crate::model::{DropCounts, MonotonicNs};

/// What the picture shows of a phase, in times from the start of the measurement.
#[derive(Clone, Debug, Default)]
pub(super) struct Timeline {
    /// The number of scans that arrived at the critical subscriber in each [`BIN_MS`].
    pub critical: Vec<usize>,
    /// The stalls of the remote subscriber, in seconds.
    pub stalls_s: Vec<Range<f64>>,
}

/// The time that a step of the curve covers: half a second, 15 scans.
pub(super) const BIN_MS: u64 = 500;

#[derive(Clone, Copy, Debug)]
struct Arrival {
    taken_at: MonotonicNs,
    arrived_at: MonotonicNs,
}

#[derive(Clone, Copy, Debug)]
struct Published {
    call_ns: u64,
    written: bool,
}

#[derive(Debug, Default)]
pub(super) struct Tally {
    /// The instant at which scan 0 was due; `None` until the publisher has started its timer.
    pub began_at: Option<MonotonicNs>,
    published: BTreeMap<u64, Published>,
    critical: BTreeMap<u64, Arrival>,
    remote: BTreeMap<u64, Arrival>,
}

impl Tally {
    /// Adds a report. Only the first arrival of a scan counts.
    pub fn add(&mut self, role: Role, report: Report) {
        match (role, report) {
            (Role::Publisher, Report::Began { at }) => self.began_at = Some(at),
            (Role::Publisher, Report::Published { number, call_ns, written }) => {
                self.published.insert(number, Published { call_ns, written });
            }
            (Role::Critical | Role::Remote, Report::Arrived { number, taken_at, arrived_at }) => {
                let arrivals = if role == Role::Remote { &mut self.remote } else { &mut self.critical };
                arrivals.entry(number).or_insert(Arrival { taken_at, arrived_at });
            }
            _ => {}
        }
    }

    fn arrivals(&self, role: Role) -> &BTreeMap<u64, Arrival> {
        if role == Role::Remote { &self.remote } else { &self.critical }
    }

    /// The number of scans that have arrived at a subscriber.
    pub fn arrived(&self, role: Role) -> usize {
        self.arrivals(role).len()
    }

    /// The number of written scans that were due in an interval.
    pub fn written_in(&self, window: &Window, interval: Range<MonotonicNs>) -> usize {
        let written = self.published.range(window.numbers.clone()).filter(|(_, one)| one.written);
        written.filter(|(number, _)| interval.contains(&due_at(window.began_at, **number))).count()
    }

    /// The number of scans of the window that arrived in an interval.
    pub fn arrived_in(&self, role: Role, window: &Window, interval: Range<MonotonicNs>) -> usize {
        let arrivals = self.arrivals(role).range(window.numbers.clone());
        arrivals.filter(|(_, one)| interval.contains(&one.arrived_at)).count()
    }

    /// What the picture shows of a window in which the remote subscriber was stalled at these times.
    pub fn timeline(&self, window: &Window, stalls: &[Range<MonotonicNs>]) -> Timeline {
        let since_start_s = |instant: MonotonicNs| instant.since(window.start()) as f64 / 1e9;
        let bins = window.end().since(window.start()) / (BIN_MS * 1_000_000);
        let arrived = |bin| {
            let from = window.start().plus_ms(bin * BIN_MS);
            self.arrived_in(Role::Critical, window, from..from.plus_ms(BIN_MS))
        };
        Timeline {
            critical: (0..bins).map(arrived).collect(),
            stalls_s: stalls.iter().map(|one| since_start_s(one.start)..since_start_s(one.end)).collect(),
        }
    }

    pub fn silent_ns(&self, window: &Window, now: MonotonicNs) -> u64 {
        let last = self.critical.range(window.numbers.clone()).next_back();
        now.since(last.map_or(window.start(), |(_, one)| one.arrived_at))
    }

    /// The figures of a window up to `until`.
    pub fn figures(&self, window: &Window, stalls: &[Range<MonotonicNs>], until: MonotonicNs) -> Figures {
        let until = until.min(window.end());
        let numbers = window.numbers.start..window.numbers_before(until);
        let due = numbers.end - numbers.start;
        let published: Vec<_> = self.published.range(numbers.clone()).collect();
        let written = published.iter().filter(|(_, one)| one.written).count() as u64;
        let timed_out = published.len() as u64 - written;
        let call_max_ns = published.iter().map(|(_, one)| one.call_ns).max().unwrap_or(0);
        let elapsed_s = until.since(window.start()) as f64 / 1e9;

        let arrivals: Vec<_> = self.critical.range(numbers.clone()).collect();
        let received = arrivals.len() as u64;
        let never_written = due.saturating_sub(written);
        let lost = due.saturating_sub(received);
        let mut latencies_ns: Vec<u64> =
            arrivals.iter().map(|(_, one)| one.arrived_at.since(one.taken_at)).collect();
        latencies_ns.sort_unstable();
        let mut arrived_at: Vec<_> = arrivals.iter().map(|(_, one)| one.arrived_at).collect();
        arrived_at.extend([window.start(), until]);
        arrived_at.sort_unstable();
        let silence_max_ns = arrived_at.windows(2).map(|pair| pair[1].since(pair[0])).max().unwrap_or(0);

        Figures {
            publisher: PublisherFigures {
                due,
                written,
                timed_out,
                skipped: never_written.saturating_sub(timed_out),
                rate_hz: if elapsed_s > 0.0 { written as f64 / elapsed_s } else { 0.0 },
                call_max_ms: ms(call_max_ns),
            },
            critical: CriticalFigures {
                received,
                lost,
                never_written,
                lost_on_the_way: lost.saturating_sub(never_written),
                silence_max_ms: ms(silence_max_ns),
                latency_ms: Quantiles::of(&latencies_ns),
            },
            remote: RemoteFigures {
                received: self.remote.range(numbers).count() as u64,
                stalls: stalls.len(),
                stalled_s: stalls.iter().map(|one| one.end.since(one.start)).sum::<u64>() as f64 / 1e9,
            },
            drops: None,
            timeline: Timeline::default(),
        }
    }
}

/// The measured part of a phase, as a range of scan numbers.
#[derive(Clone, Debug)]
pub(super) struct Window {
    /// The instant at which scan 0 was due.
    pub began_at: MonotonicNs,
    pub numbers: Range<u64>,
}

impl Window {
    pub fn start(&self) -> MonotonicNs {
        due_at(self.began_at, self.numbers.start)
    }

    pub fn end(&self) -> MonotonicNs {
        due_at(self.began_at, self.numbers.end)
    }

    /// Whether an instant of the window is within a stall of the remote subscriber.
    pub fn is_stalled(&self, instant: MonotonicNs) -> bool {
        let in_cycle_ms = instant.since(self.start()) / 1_000_000 % STALL_EVERY_MS;
        (STALL_AFTER_MS..STALL_AFTER_MS + STALL_MS).contains(&in_cycle_ms)
    }

    /// The end of the range of scans of the window that are due before an instant.
    fn numbers_before(&self, instant: MonotonicNs) -> u64 {
        let number = super::first_due_after(self.began_at, instant);
        number.clamp(self.numbers.start, self.numbers.end)
    }
}

#[derive(Clone, Debug, Serialize)]
pub(super) struct Figures {
    pub publisher: PublisherFigures,
    pub critical: CriticalFigures,
    pub remote: RemoteFigures,
    /// The samples that the bridge dropped, by process and drop reason; `None` without a bridge.
    pub drops: Option<BridgeDrops>,
    /// The phase over time, for the picture.
    #[serde(skip)]
    pub timeline: Timeline,
}

/// The figures of the publisher: `due = written + timed_out + skipped`.
#[derive(Clone, Debug, Serialize)]
pub(super) struct PublisherFigures {
    /// Scans that were due in the window.
    pub due: u64,
    /// Scans that the DDS writer accepted.
    pub written: u64,
    /// Scans whose publish call timed out.
    pub timed_out: u64,
    /// Scans that became due while an earlier publish call was blocked.
    pub skipped: u64,
    pub rate_hz: f64,
    pub call_max_ms: f64,
}

/// The figures of the critical subscriber: `due = received + lost`, `lost = never_written + lost_on_the_way`.
#[derive(Clone, Debug, Serialize)]
pub(super) struct CriticalFigures {
    pub received: u64,
    pub lost: u64,
    pub never_written: u64,
    pub lost_on_the_way: u64,
    /// The longest time without an arrival.
    pub silence_max_ms: f64,
    /// From before the publish call to the arrival; `None` when nothing arrived.
    pub latency_ms: Option<Quantiles>,
}

#[derive(Clone, Debug, Serialize)]
pub(super) struct RemoteFigures {
    pub received: u64,
    pub stalls: usize,
    pub stalled_s: f64,
}

#[derive(Clone, Debug, Serialize)]
pub(super) struct Quantiles {
    pub p50: f64,
    pub p95: f64,
    pub p99: f64,
    pub max: f64,
}

impl Quantiles {
    /// The quantiles of sorted values by nearest rank; `None` without values.
    fn of(sorted_ns: &[u64]) -> Option<Self> {
        let max = *sorted_ns.last()?;
        let at = |quantile: f64| {
            let rank = (quantile * sorted_ns.len() as f64).ceil() as usize;
            ms(sorted_ns[rank.clamp(1, sorted_ns.len()) - 1])
        };
        Some(Self { p50: at(0.5), p95: at(0.95), p99: at(0.99), max: ms(max) })
    }
}

/// Samples that the bridge dropped during the measurement, by drop reason, for each process.
#[derive(Clone, Debug, Default, Serialize)]
pub(super) struct BridgeDrops {
    pub ingress: BTreeMap<&'static str, u64>,
    pub critical: BTreeMap<&'static str, u64>,
    pub noncritical: BTreeMap<&'static str, u64>,
}

impl BridgeDrops {
    /// The samples dropped between two readings of the boards of ingress and the two lanes.
    pub fn between(before: &[DropCounts; 3], after: &[DropCounts; 3]) -> Self {
        let [ingress, critical, noncritical] = std::array::from_fn(|index| {
            let dropped = after[index].since(&before[index]);
            dropped.iter().map(|(reason, count)| (reason.label(), count)).collect()
        });
        Self { ingress, critical, noncritical }
    }
}

fn ms(ns: u64) -> f64 {
    ns as f64 / 1e6
}

#[cfg(test)]
mod tests {
    use super::*;

    const BEGAN: MonotonicNs = MonotonicNs(1_000_000_000);

    fn tally(published: &[(u64, bool)], arrived: &[u64], latency_ns: u64) -> Tally {
        let mut tally = Tally::default();
        tally.add(Role::Publisher, Report::Began { at: BEGAN });
        for &(number, written) in published {
            let call_ns = if written { 50_000 } else { 100_000_000 };
            tally.add(Role::Publisher, Report::Published { number, call_ns, written });
        }
        for &number in arrived {
            let taken_at = due_at(BEGAN, number);
            let arrived_at = taken_at.plus_ns(latency_ns);
            tally.add(Role::Critical, Report::Arrived { number, taken_at, arrived_at });
        }
        tally
    }

    fn window() -> Window {
        Window { began_at: BEGAN, numbers: 30..60 }
    }

    #[test]
    fn every_due_scan_is_accounted_for() {
        // 30 to 39 are written, 40 times out, 41 to 43 are skipped, 44 to 59 are written, but 50 does not
        // arrive.
        let mut published: Vec<_> = (0..90).map(|number| (number, true)).collect();
        published.retain(|(number, _)| !(41..44).contains(number));
        published[40].1 = false;
        let arrived: Vec<_> = (0..90).filter(|n| !(40..44).contains(n) && *n != 50).collect();
        let figures = tally(&published, &arrived, 250_000).figures(&window(), &[], MonotonicNs(u64::MAX));
        let publisher = &figures.publisher;
        assert_eq!((publisher.due, publisher.written), (30, 26));
        assert_eq!((publisher.timed_out, publisher.skipped), (1, 3));
        assert!((publisher.rate_hz - 26.0).abs() < 0.01, "{}", publisher.rate_hz);
        assert_eq!(publisher.call_max_ms, 100.0);
        let critical = &figures.critical;
        assert_eq!((critical.received, critical.lost), (25, 5));
        assert_eq!((critical.never_written, critical.lost_on_the_way), (4, 1));
        // Between the arrivals of 39 and 44.
        assert!((critical.silence_max_ms - 5.0 * 100.0 / 3.0).abs() < 0.01, "{}", critical.silence_max_ms);
        let latency_ms = critical.latency_ms.as_ref().unwrap();
        assert_eq!((latency_ms.p50, latency_ms.max), (0.25, 0.25));
    }

    #[test]
    fn silence_at_the_edges_of_the_window_counts() {
        let published: Vec<_> = (0..90).map(|number| (number, true)).collect();
        let arrived: Vec<_> = (0..50).collect();
        let tally = tally(&published, &arrived, 0);
        let figures = tally.figures(&window(), &[], MonotonicNs(u64::MAX));
        assert!((figures.critical.silence_max_ms - 11.0 * 100.0 / 3.0).abs() < 0.01);
        assert_eq!(figures.critical.lost_on_the_way, 10);
        let nothing = Tally::default().figures(&window(), &[], window().end());
        assert!((nothing.critical.silence_max_ms - 1000.0).abs() < 0.01);
        assert!(nothing.critical.latency_ms.is_none());
        assert_eq!((nothing.publisher.skipped, nothing.critical.never_written), (30, 30));
    }

    #[test]
    fn quantiles_are_of_the_nearest_rank() {
        let values: Vec<u64> = (1..=100).map(|ms| ms * 1_000_000).collect();
        let quantiles = Quantiles::of(&values).unwrap();
        assert_eq!((quantiles.p50, quantiles.p95, quantiles.p99, quantiles.max), (50.0, 95.0, 99.0, 100.0));
        let one = Quantiles::of(&[7_000_000]).unwrap();
        assert_eq!((one.p50, one.max), (7.0, 7.0));
        assert!(Quantiles::of(&[]).is_none());
    }
}
