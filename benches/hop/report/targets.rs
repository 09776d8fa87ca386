//! What the overhead should be, and whether it is.

use super::format::number;
use super::statistics::{growth, median, median_interval};
use super::summary::{Isolation, Latency, SoakSeries, Summary};
use super::table::Table;
use super::tables::payload;

/// The hop of the bridge is judged by that of the relay, at this rate with this payload.
pub struct Hop {
    pub rate_hz: u64,
    pub bytes: usize,
    /// The most that it may be of the relay's.
    most: f64,
    /// The most that it may be by itself: what a C++ router of one process adds on such a machine.
    most_us: Option<f64>,
}

/// The CPU of the bridge is judged by that of the relay at this rate.
pub const JUDGED_HZ: u64 = 1_000;

pub const HOPS: [Hop; 5] = [
    Hop { rate_hz: 1_000, bytes: 2_948, most: 1.0, most_us: Some(75.0) },
    Hop { rate_hz: 100, bytes: 2_948, most: 1.25, most_us: Some(145.0) },
    Hop { rate_hz: 10, bytes: 1 << 20, most: 1.0, most_us: None },
    Hop { rate_hz: 30, bytes: 1 << 20, most: 1.0, most_us: None },
    Hop { rate_hz: 100, bytes: 1 << 20, most: 1.0, most_us: None },
];

/// One thing to reach.
struct Target {
    what: String,
    limit: String,
    value: String,
    /// Not known where the run does not say.
    met: Option<bool>,
}

impl Target {
    /// Met when the value is at most the limit.
    fn at_most(what: String, limit: f64, unit: &str, value: Option<f64>) -> Self {
        let unit = if unit.is_empty() { String::new() } else { format!(" {unit}") };
        Self {
            what,
            limit: format!("at most {limit:.2}{unit}").replace(".00", ""),
            value: number(value) + if value.is_some() { &unit } else { "" },
            met: value.map(|value| value <= limit),
        }
    }

    /// Met when the median is certain to be at most the limit, if there is enough to be certain of it; of few
    /// values when it is.
    fn median_at_most(what: String, limit: f64, unit: &str, values: Vec<f64>) -> Self {
        let Some(estimate) = Estimate::of(&values) else { return Self::at_most(what, limit, unit, None) };
        let met = match estimate.interval {
            Some(_) => estimate.is_at_most(limit),
            None => Some(estimate.median <= limit),
        };
        let value = estimate.text() + if unit.is_empty() { "" } else { " " } + unit;
        Self { value, met, ..Self::at_most(what, limit, unit, None) }
    }
}

/// The table of all that the run can say something about; `None` where that is nothing.
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
                    && row.rate_hz == JUDGED_HZ
                    && process.map_or(!["publisher", "subscriber"].contains(&row.process.as_str()), |only| {
                        row.process == only
                    })
            });
            // Of each repetition; of runs that did not keep them, of all.
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
        // The same twice is no target; it says what can be told at all.
        if row.condition != "repeat" {
            let (value, met) = match against(summary, row) {
                Some(ratio) => (ratio.text(), ratio.is_at_most(MOST_OF_UNDISTURBED)),
                None => (number(None), None),
            };
            targets.push(Target { what, limit: format!("at most {MOST_OF_UNDISTURBED:.2}"), value, met });
        }
    }
    for series in summary.soak.iter().flat_map(|soak| &soak.series).filter(|series| series.unit == "KiB") {
        let (trend, kib_per_hour) = trend(series);
        targets.push(Target {
            what: format!("growth of the memory of {}", series.name),
            limit: format!("at most {} KiB/h", number(Some(MOST_KIB_PER_HOUR))),
            value: match trend {
                Trend::TooShort => "too short to tell".to_owned(),
                _ => number(kib_per_hour) + " KiB/h",
            },
            met: match trend {
                Trend::Flat => Some(true),
                Trend::Grows => Some(false),
                Trend::TooShort => None,
            },
        });
    }
    let mut table = Table::new(&["", "to reach", "measured", ""]);
    for target in targets {
        let met = match target.met {
            Some(true) => "met",
            Some(false) => "**missed**",
            None => "not known",
        };
        table.row([target.what, target.limit, target.value, met.to_owned()]);
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
    // Of each repetition.
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
        // One of the relay that is lost in the noise counts as if it were nothing.
        let ratio = |(bridge, relay)| hop_ratio(bridge, relay).unwrap_or(f64::INFINITY);
        let ratios = bridge.iter().copied().zip(relay).map(ratio).collect();
        targets.push(Target::median_at_most(what, hop.most, "", ratios));
    }
    for hop in &HOPS {
        let (Some(most_us), Some(bridge)) = (hop.most_us, hops(hop, "bridge")) else { continue };
        let what = format!("hop of the bridge, {} Hz of {}, {scheduling}", hop.rate_hz, payload(hop.bytes));
        targets.push(Target::median_at_most(what, most_us, "µs", bridge));
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

/// The hop of the bridge over that of the relay; none where the relay's is lost in the noise.
pub fn hop_ratio(bridge_us: f64, relay_us: f64) -> Option<f64> {
    (relay_us > 0.0).then(|| bridge_us / relay_us)
}

/// The critical p99.9 over that of nothing wrong.
const MOST_OF_UNDISTURBED: f64 = 1.1;

/// What is known of a median.
pub struct Estimate {
    /// The median of the values.
    pub median: f64,
    /// Where the median of what they are drawn from lies with a certainty of 95 %; none of few values.
    pub interval: Option<(f64, f64)>,
}

impl Estimate {
    /// None of no values.
    fn of(values: &[f64]) -> Option<Self> {
        (!values.is_empty()).then(|| Self { median: median(values), interval: median_interval(values) })
    }

    /// `1.02 (0.97 to 1.08)`.
    pub fn text(&self) -> String {
        let interval = self.interval.map_or(String::new(), |(low, high)| {
            format!(" ({} to {})", number(Some(low)), number(Some(high)))
        });
        number(Some(self.median)) + &interval
    }

    /// Not known where the interval has the limit within it.
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

/// How the p99.9 of a condition is to that of what it is compared with.
///
/// Round by round, for both of a round had the same neighbours on the machine, and one round in which the
/// hypervisor held the CPUs does not decide, as it does over the p99.9 of all rounds' samples.
pub fn against(summary: &Summary, row: &Isolation) -> Option<Estimate> {
    let other = summary
        .isolation
        .iter()
        .find(|other| other.scheduling == row.scheduling && other.condition == row.against)?;
    let ratios: Vec<f64> =
        row.rounds_p999_us.iter().zip(&other.rounds_p999_us).map(|(one, other)| one / other).collect();
    Estimate::of(&ratios)
}

/// More than this is growth: 24 MiB a day.
pub const MOST_KIB_PER_HOUR: f64 = 1_024.0;

/// Growth below this in all the time looked at is not told from the steps in which an allocator takes memory.
const STEPS_KIB: f64 = 256.0;

/// This share of the time, at the beginning, is not looked at: caches and pools fill.
const WARM_UP: f64 = 0.2;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trend {
    Flat,
    Grows,
    /// Flat as far as can be seen, and a growth that counts could not be seen.
    TooShort,
}

/// Whether the memory grows, and the slope in KiB per hour.
pub fn trend(series: &SoakSeries) -> (Trend, Option<f64>) {
    let end = series.points.last().map_or(0.0, |point| point.0);
    let looked_at: Vec<(f64, f64)> =
        series.points.iter().copied().filter(|point| point.0 >= end * WARM_UP).collect();
    let Some(kib_per_second) = growth(&looked_at) else { return (Trend::TooShort, None) };
    let seconds = end - looked_at.first().map_or(0.0, |point| point.0);
    let kib_per_hour = kib_per_second * 3_600.0;
    let trend = if kib_per_second * seconds > STEPS_KIB {
        if kib_per_hour > MOST_KIB_PER_HOUR { Trend::Grows } else { Trend::Flat }
    } else if STEPS_KIB / seconds * 3_600.0 > MOST_KIB_PER_HOUR {
        Trend::TooShort
    } else {
        Trend::Flat
    };
    (trend, Some(kib_per_hour))
}
