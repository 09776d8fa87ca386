//! The targets for the bridge's overhead, and whether a run meets them.

use super::summary::{Isolation, Latency, SoakSeries, Summary};
use crate::format::{number, payload};
use crate::statistics::{Growth, growth, median, median_interval};
use crate::table::Table;

/// A target for the bridge's hop at one rate and payload.
pub struct Hop {
    /// The rate of the publisher.
    pub rate_hz: u64,
    /// The size of the payload.
    pub bytes: usize,
    /// The highest ratio to the relay's hop.
    max_ratio: f64,
    /// The highest hop: what a C++ router of one process adds on such a machine.
    max_us: Option<f64>,
}

/// The rate of the target for the bridge's CPU time, as a ratio to the relay's.
pub const TARGET_HZ: u64 = 1_000;

/// The targets for hops.
pub const HOPS: [Hop; 5] = [
    Hop { rate_hz: 1_000, bytes: 2_948, max_ratio: 1.0, max_us: Some(75.0) },
    Hop { rate_hz: 100, bytes: 2_948, max_ratio: 1.25, max_us: Some(145.0) },
    Hop { rate_hz: 10, bytes: 1 << 20, max_ratio: 1.0, max_us: None },
    Hop { rate_hz: 30, bytes: 1 << 20, max_ratio: 1.0, max_us: None },
    Hop { rate_hz: 100, bytes: 1 << 20, max_ratio: 1.0, max_us: None },
];

/// A row of the table of targets.
struct Target {
    what: String,
    limit: String,
    value: String,
    /// Whether the target is met; `None` when the run does not tell.
    met: Option<bool>,
}

impl Target {
    /// A target that is met when the value is at most the limit.
    fn at_most(what: String, limit: f64, unit: &str, value: Option<f64>) -> Self {
        let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
        Self {
            what,
            limit: format!("at most {limit:.2}{unit}").replace(".00", ""),
            value: number(value) + if value.is_some() { &unit } else { "" },
            met: value.map(|value| value <= limit),
        }
    }

    /// A target for a median. With six or more values it is met when the whole confidence interval is at most
    /// the limit; with fewer, when the median is.
    fn median_at_most(what: String, limit: f64, unit: &str, values: Vec<f64>) -> Self {
        let Some(estimate) = Estimate::of(&values) else { return Self::at_most(what, limit, unit, None) };
        let met = estimate.meets(limit);
        let value = estimate.text() + if unit.is_empty() { "" } else { " " } + unit;
        Self { value, met, ..Self::at_most(what, limit, unit, None) }
    }
}

/// The table of all targets for which the run has figures; `None` when there are none.
pub fn table(summary: &Summary) -> Option<String> {
    let mut targets = Vec::new();
    for scheduling in ["other", "fifo"] {
        latency(summary, scheduling, &mut targets);
    }
    for row in &summary.loss {
        let lost = row.lost + row.refused;
        let what = format!(
            "{}: lost or refused at {} Hz of {}, {}",
            row.program,
            row.rate_hz,
            payload(row.bytes),
            row.scheduling
        );
        if row.program == "bridge" {
            targets.push(Target::at_most(what, 0.0, "", Some(lost as f64)));
        }
    }
    if !summary.resources.is_empty() {
        let of = |program: &str, process: Option<&str>| {
            let rows = summary.resources.iter().filter(|row| {
                row.program == program
                    && row.rate_hz == TARGET_HZ
                    && process.map_or(!["publisher", "subscriber"].contains(&row.process.as_str()), |only| {
                        row.process == only
                    })
            });
            // A value for each repetition; older runs only have one for all.
            rows.map(|row| match &row.repetitions_cpu_us[..] {
                [] => row.per_sample(row.cpu_ms).into_iter().collect(),
                each => each.to_vec(),
            })
            .reduce(|all: Vec<f64>, of_one| all.iter().zip(of_one).map(|(all, one)| all + one).collect())
            .unwrap_or_default()
        };
        let ratios = of("bridge", None).into_iter().zip(of("relay", Some("relay")));
        let ratios = ratios.map(|(bridge, relay)| bridge / relay).collect();
        let what = "CPU of all processes of the bridge / CPU of the relay, 1 kHz".to_owned();
        targets.push(Target::median_at_most(what, 1.5, "", ratios));
    }
    for row in summary.isolation.iter().filter(|row| row.condition != row.against) {
        let what = format!(
            "critical p99.9, noncritical lane {} / {}, {}",
            row.condition, row.against, row.scheduling
        );
        // `repeat` has no target: it shows the noise of the comparison.
        if row.condition != "repeat" {
            let (value, met) = match ratio_to_baseline(summary, row) {
                Some(ratio) => (ratio.text(), ratio.is_at_most(MAX_RATIO_TO_UNDISTURBED)),
                None => (number(None), None),
            };
            targets.push(Target {
                what,
                limit: format!("at most {MAX_RATIO_TO_UNDISTURBED:.2}"),
                value,
                met,
            });
        }
    }
    for series in summary.soak.iter().flat_map(|soak| &soak.series).filter(|series| series.unit == "KiB") {
        let (trend, per_hour) = trend(series);
        targets.push(Target {
            what: format!("growth of the memory of {}", series.name),
            limit: format!("at most {} KiB/h", number(Some(MAX_KIB_PER_HOUR))),
            value: match trend {
                Trend::TooShort => "too short to tell".to_owned(),
                _ => slope(per_hour) + " KiB/h",
            },
            met: match trend {
                Trend::Flat | Trend::Slow => Some(true),
                Trend::Grows => Some(false),
                Trend::TooShort => None,
            },
        });
    }
    let mut table = Table::new(&["", "target", "measured", ""]);
    for target in targets {
        table.row([target.what, target.limit, target.value, word(target.met).to_owned()]);
    }
    (!table.is_empty()).then(|| table.text())
}

fn latency(summary: &Summary, scheduling: &str, targets: &mut Vec<Target>) {
    let row = |rate_hz: u64, bytes: usize, program: &str| -> Option<&Latency> {
        summary.latency.iter().find(|row| {
            row.scheduling == scheduling
                && row.rate_hz == rate_hz
                && row.program == program
                && (row.bytes == bytes || program == "wake-up")
        })
    };
    // The hop of each repetition.
    let hops = |hop: &Hop, program| -> Option<Vec<f64>> {
        let with = row(hop.rate_hz, hop.bytes, program)?.repetitions_p50_us.iter();
        let without = &row(hop.rate_hz, hop.bytes, "direct")?.repetitions_p50_us;
        Some(with.zip(without).map(|(with, without)| with - without).collect())
    };
    for hop in &HOPS {
        let Some(bridge) = hops(hop, "bridge") else { continue };
        let relay = hops(hop, "relay").unwrap_or_default();
        let what = format!(
            "hop of the bridge / hop of the relay, {} Hz of {}, {scheduling}",
            hop.rate_hz,
            payload(hop.bytes)
        );
        // If the relay's hop is lost in the noise, it counts as 0.
        let ratio = |(bridge, relay)| hop_ratio(bridge, relay).unwrap_or(f64::INFINITY);
        let ratios = bridge.iter().copied().zip(relay).map(ratio).collect();
        targets.push(Target::median_at_most(what, hop.max_ratio, "", ratios));
    }
    for hop in &HOPS {
        let (Some(max_us), Some(bridge)) = (hop.max_us, hops(hop, "bridge")) else { continue };
        let what = format!("hop of the bridge, {} Hz of {}, {scheduling}", hop.rate_hz, payload(hop.bytes));
        targets.push(Target::median_at_most(what, max_us, "µs", bridge));
    }
    for rate_hz in [1_000, 100] {
        let Some(bridge) = row(rate_hz, 2_948, "bridge") else { continue };
        let stage = bridge.stages.get("shared memory").and_then(|stage| stage.p50_us);
        let floor = row(rate_hz, 2_948, "wake-up").and_then(|row| row.latency.p50_us);
        let ratio = stage.zip(floor).map(|(stage, floor)| stage / floor);
        let what = format!("shared memory / eventfd wake-up, {rate_hz} Hz of 2,948 B, {scheduling}");
        targets.push(Target::at_most(what, 1.3, "", ratio));
    }
}

/// Whether a target is met, as tables say it; `None` when the run does not tell.
pub fn word(met: Option<bool>) -> &'static str {
    match met {
        Some(true) => "met",
        Some(false) => "**missed**",
        None => "not known",
    }
}

/// The ratio of the bridge's hop to the relay's; `None` when the relay's hop is lost in the noise.
pub fn hop_ratio(bridge_us: f64, relay_us: f64) -> Option<f64> {
    (relay_us > 0.0).then(|| bridge_us / relay_us)
}

/// The highest ratio of the critical p99.9 in a condition to that in its undisturbed baseline.
const MAX_RATIO_TO_UNDISTURBED: f64 = 1.1;

/// An estimated median.
pub struct Estimate {
    /// The median of the values.
    pub median: f64,
    /// The 95 % confidence interval of the median; `None` with too few values.
    pub interval: Option<(f64, f64)>,
}

impl Estimate {
    /// `None` without values.
    pub fn of(values: &[f64]) -> Option<Self> {
        (!values.is_empty()).then(|| Self { median: median(values), interval: median_interval(values) })
    }

    /// Median and interval, such as `1.02 (0.97 to 1.08)`.
    pub fn text(&self) -> String {
        let interval = self.interval.map_or(String::new(), |(low, high)| {
            format!(" ({} to {})", number(Some(low)), number(Some(high)))
        });
        number(Some(self.median)) + &interval
    }

    /// Whether a target is met: with an interval, whether all of it is at most the limit; without one,
    /// whether the median is. `None` when the limit is within the interval.
    pub fn meets(&self, limit: f64) -> Option<bool> {
        match self.interval {
            Some(_) => self.is_at_most(limit),
            None => Some(self.median <= limit),
        }
    }

    /// Whether the median is at most the limit; `None` when the limit is within the interval or there is
    /// none.
    fn is_at_most(&self, limit: f64) -> Option<bool> {
        let (low, high) = self.interval?;
        if high <= limit {
            Some(true)
        } else if low > limit {
            Some(false)
        } else {
            None
        }
    }
}

/// The ratio of the p99.9 of a condition to that of its baseline.
///
/// It is the median of the ratios of the rounds: conditions of the same round ran under the same load of the
/// machine, and one round in which the hypervisor took the CPUs does not decide, as it would for the p99.9
/// over the samples of all rounds.
pub fn ratio_to_baseline(summary: &Summary, row: &Isolation) -> Option<Estimate> {
    let other = summary
        .isolation
        .iter()
        .find(|other| other.scheduling == row.scheduling && other.condition == row.against)?;
    let ratios: Vec<f64> =
        row.rounds_p999_us.iter().zip(&other.rounds_p999_us).map(|(one, other)| one / other).collect();
    Estimate::of(&ratios)
}

/// The highest slope of memory that is not growth: 24 MiB a day.
pub const MAX_KIB_PER_HOUR: f64 = 1_024.0;

/// The total growth that cannot be distinguished from the steps in which an allocator takes memory.
const ALLOCATION_STEP_KIB: f64 = 256.0;

/// The share of the time at the beginning that is ignored, because caches and pools still fill.
const WARM_UP: f64 = 0.2;

/// Whether memory grows.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trend {
    /// It does not grow: the interval of the slope begins at 0 or below, or the growth is less than an
    /// allocator takes at once.
    Flat,
    /// It grows by at most [`MAX_KIB_PER_HOUR`].
    Slow,
    /// It grows by more.
    Grows,
    /// No growth was found, but the run was too short to find one.
    TooShort,
}

/// A slope with its 95 % interval.
pub fn slope(growth: Option<Growth>) -> String {
    let Some(growth) = growth else { return number(None) };
    format!("{} ({} to {})", number(Some(growth.slope)), number(Some(growth.low)), number(Some(growth.high)))
}

/// The trend of the memory, and its slope in KiB per hour.
pub fn trend(series: &SoakSeries) -> (Trend, Option<Growth>) {
    let end = series.points.last().map_or(0.0, |point| point.0);
    let warm = series.points.iter().filter(|point| point.0 >= end * WARM_UP);
    let by_hour: Vec<(f64, f64)> = warm.map(|(at_s, value)| (at_s / 3_600.0, *value)).collect();
    let Some(per_hour) = growth(&by_hour) else { return (Trend::TooShort, None) };
    let hours = end / 3_600.0 - by_hour.first().map_or(0.0, |point| point.0);
    let trend = if per_hour.slope * hours > ALLOCATION_STEP_KIB {
        match per_hour {
            Growth { slope, .. } if slope > MAX_KIB_PER_HOUR => Trend::Grows,
            Growth { low, .. } if low > 0.0 => Trend::Slow,
            _ => Trend::Flat,
        }
    } else if ALLOCATION_STEP_KIB / hours > MAX_KIB_PER_HOUR {
        Trend::TooShort
    } else {
        Trend::Flat
    };
    (trend, Some(per_hour))
}
