//! `tap`: shows the samples of a route, read directly from shared memory.
//!
//! A tap is another subscriber of the route's channel, with a short queue. It polls; ingress neither wakes it
//! nor waits for it, and a sample that it does not take in time is overwritten. Ingress and the lanes are
//! unaffected.

use std::io::{self, BufWriter, StdoutLock, Write};
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;

use super::{ConfigArguments, failed, output_ended, read_bridge, running_bridge};
use crate::clock;
use crate::config::Settings;
use crate::model::{Encapsulation, MonotonicNs, RouteInfo};
use crate::policy::{SequenceOutcome, SequenceTracker};
use crate::process::Stop;
use crate::shm::{
    Boards, BridgeShape, RouteChannel, SampleSubscriber, ShmNode, ShmSample, SubscriberRole, TakeError,
    root_of,
};
use crate::telemetry::Intervals;

/// The period of the lines of `--hz`.
const REPORT_MS: u64 = 1_000;
/// How often a tap checks that the bridge still runs. A tap that stayed would keep the shared memory of a
/// bridge that has ended, and a bridge with other routes could not start.
const BRIDGE_CHECK_MS: u64 = 200;
const USUAL_PAUSE_US: u64 = 1_000;

#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// The input topic, such as /scan, or the id of the route
    topic: String,
    /// Show the rate and the spread of the intervals each second, as `ros2 topic hz` does
    #[arg(long, conflicts_with = "raw")]
    hz: bool,
    /// Write only the payloads to stdout. For each sample: the number of bytes that follow (u32, little
    /// endian), the encapsulation header (4 bytes), the serialized message
    #[arg(long)]
    raw: bool,
    /// Begin with the samples that the bridge retains for late subscribers, such as the last map
    #[arg(long, conflicts_with = "hz")]
    retained: bool,
    /// Exit after N samples
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    #[command(flatten)]
    config: ConfigArguments,
}

pub(super) fn run(arguments: &Arguments) -> Result<ExitCode, ExitCode> {
    let settings = arguments.config.in_force()?;
    let root = root_of(&settings);
    let boards = Boards::find(&root, &settings.instance, &BridgeShape::of(&settings));
    // A route without a pattern needs no board to be found.
    let boards = boards.ok().flatten();
    let info = |route: usize| boards.as_ref().and_then(|boards| boards.route_info(route)).unwrap_or_default();
    let Some(route) = find_route(&settings, &arguments.topic, info) else {
        return Err(failed(&unknown_topic(&settings, &arguments.topic)));
    };
    // Checked first, because opening a node would create the shared memory of a bridge that does not run.
    running_bridge(&root, &settings)?;
    let bound = info(route);
    let stop = Stop::on_signals().map_err(|error| failed(&error))?;
    let opened = ShmNode::open(&root, &settings.instance, "tap").and_then(|node| {
        let channel = RouteChannel::of(&settings, route);
        SampleSubscriber::open(&node, &channel, SubscriberRole::Tap, arguments.retained)
    });
    let subscriber = opened.map_err(|error| failed(&error))?;
    let has_same_topic = || info(route).bound_count == bound.bound_count;
    let goes_on = || has_same_topic() && matches!(read_bridge(&root, &settings), Ok(Some(_)));
    match Tap::new(arguments, bound.bound_after).follow(&subscriber, &stop, goes_on) {
        Ok(true) => Ok(ExitCode::SUCCESS),
        Ok(false) if !has_same_topic() => Err(failed(&"the route has got another topic")),
        Ok(false) => Err(failed(&"the bridge has ended")),
        Err(error) => Err(output_ended(&error)),
    }
}

fn find_route(settings: &Settings, topic: &str, info: impl Fn(usize) -> RouteInfo) -> Option<usize> {
    let absolute = format!("/{}", topic.trim_start_matches('/'));
    let mut routes = settings.routes.iter().enumerate();
    let by_topic = routes.position(|(index, route)| {
        route.input_topic.resolve(&info(index)).is_some_and(|topic| topic.as_str() == absolute)
    });
    by_topic.or_else(|| settings.routes.iter().position(|route| route.id.as_str() == topic))
}

fn unknown_topic(settings: &Settings, topic: &str) -> String {
    let known: Vec<String> =
        settings.routes.iter().map(|route| format!("{} ({})", route.input_topic, route.id)).collect();
    format!("no route has the input topic or id {topic}; the routes are: {}", known.join(", "))
}

enum Format {
    Lines,
    Raw,
    Hz { intervals: Intervals, lost: u64, new: u64, report_at: MonotonicNs },
}

struct Tap {
    format: Format,
    /// Samples to show until the end; `None` without a limit.
    left: Option<u64>,
    tracker: SequenceTracker,
    /// The last sequence number before the route got its topic.
    bound_after: u64,
    output: BufWriter<StdoutLock<'static>>,
}

impl Tap {
    fn new(arguments: &Arguments, bound_after: u64) -> Self {
        let format = if arguments.raw {
            Format::Raw
        } else if arguments.hz {
            let report_at = clock::monotonic().plus_ms(REPORT_MS);
            Format::Hz { intervals: Intervals::default(), lost: 0, new: 0, report_at }
        } else {
            Format::Lines
        };
        Self {
            format,
            left: arguments.count,
            tracker: SequenceTracker::default(),
            bound_after,
            output: BufWriter::new(io::stdout().lock()),
        }
    }

    /// Shows samples until a stop is requested, the last wanted sample is shown, or the bridge ends or gives
    /// the route another topic: then returns `false`.
    fn follow(
        &mut self,
        subscriber: &SampleSubscriber,
        stop: &Stop,
        goes_on: impl Fn() -> bool,
    ) -> io::Result<bool> {
        let mut pause_us = USUAL_PAUSE_US;
        let mut check_at = clock::monotonic().plus_ms(BRIDGE_CHECK_MS);
        while !stop.is_requested() {
            let mut taken = 0;
            loop {
                match subscriber.take() {
                    Ok(Some(sample)) => {
                        taken += 1;
                        self.show(&sample)?;
                        if self.left == Some(0) {
                            return self.finish();
                        }
                    }
                    Ok(None) | Err(TakeError::BorrowLimit) => break,
                    Err(error) => {
                        eprintln!("adaptive-bridge: {error}");
                        break;
                    }
                }
                if stop.is_requested() {
                    break;
                }
            }
            let now = clock::monotonic();
            self.report(now)?;
            self.output.flush()?;
            if now >= check_at {
                if !goes_on() {
                    return Ok(false);
                }
                check_at = now.plus_ms(BRIDGE_CHECK_MS);
            }
            pause_us = pause_after(pause_us, taken);
            #[allow(clippy::disallowed_methods, reason = "a subcommand handles no samples of the bridge")]
            std::thread::sleep(Duration::from_micros(pause_us));
        }
        self.finish()
    }

    fn show(&mut self, sample: &ShmSample) -> io::Result<()> {
        let header = sample.header();
        if header.sequence <= self.bound_after {
            return Ok(());
        }
        self.left = self.left.map(|left| left.saturating_sub(1));
        let missed = match self.tracker.record(header.sequence) {
            SequenceOutcome::AfterGap(missed) => missed,
            SequenceOutcome::InOrder | SequenceOutcome::Duplicate => 0,
        };
        match &mut self.format {
            Format::Lines => {
                if missed > 0 {
                    writeln!(self.output, "lost={missed}")?;
                }
                writeln!(self.output, "{}", line(sample))
            }
            Format::Raw => write_frame(&mut self.output, header.encapsulation, sample.payload()),
            Format::Hz { intervals, lost, new, .. } => {
                *lost += missed;
                *new += 1;
                intervals.record(header);
                Ok(())
            }
        }
    }

    /// Prints the line of `--hz` when it is due.
    fn report(&mut self, now: MonotonicNs) -> io::Result<()> {
        let Format::Hz { intervals, lost, new, report_at } = &mut self.format else { return Ok(()) };
        if now < *report_at {
            return Ok(());
        }
        *report_at = now.plus_ms(REPORT_MS);
        let text = match intervals.statistics() {
            _ if *new == 0 => "no new samples".to_owned(),
            None => "one sample".to_owned(),
            Some(found) => format!(
                "rate {:.2} Hz  min {:.3} ms  max {:.3} ms  std {:.3} ms  window {}  lost {lost}",
                found.rate_hz, found.min_ms, found.max_ms, found.std_ms, found.samples
            ),
        };
        *new = 0;
        writeln!(self.output, "{text}")
    }

    fn finish(&mut self) -> io::Result<bool> {
        if matches!(self.format, Format::Hz { new: 1.., .. }) {
            self.report(MonotonicNs(u64::MAX))?;
        }
        self.output.flush()?;
        Ok(true)
    }
}

/// One sample as a line of `key=value` fields, which scripts can parse.
fn line(sample: &ShmSample) -> String {
    let header = sample.header();
    let age = match header.source_timestamp.to_wall() {
        Some(written) => format!("{:.1}", clock::wall().since(written) as f64 / 1e3),
        None => "none".to_owned(),
    };
    format!(
        "sequence={} age_us={age} bytes={} encapsulation={} options={} writer={}",
        header.sequence,
        sample.payload().len(),
        representation(header.encapsulation),
        hex(&header.encapsulation.options()),
        hex(&header.writer_guid.0),
    )
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// The name of the data representation (RTPS 2.5 clause 10.2, XTypes 1.3 clause 7.6.3.1.2), or its number.
fn representation(encapsulation: Encapsulation) -> String {
    const NAMES: [&str; 12] = [
        "CDR_BE",
        "CDR_LE",
        "PL_CDR_BE",
        "PL_CDR_LE",
        "XML",
        "",
        "CDR2_BE",
        "CDR2_LE",
        "D_CDR2_BE",
        "D_CDR2_LE",
        "PL_CDR2_BE",
        "PL_CDR2_LE",
    ];
    let number = encapsulation.representation();
    let name = NAMES.get(usize::from(u16::from_be_bytes(number))).filter(|name| !name.is_empty());
    name.map_or_else(|| format!("0x{}", hex(&number)), |name| (*name).to_owned())
}

/// Writes one sample in the format of `--raw`.
fn write_frame(output: &mut impl Write, encapsulation: Encapsulation, payload: &[u8]) -> io::Result<()> {
    // At most 64 MiB, the limit of `max_sample_bytes`, so it always fits.
    let length = u32::try_from(payload.len() + encapsulation.0.len()).map_err(io::Error::other)?;
    output.write_all(&length.to_le_bytes())?;
    output.write_all(&encapsulation.0)?;
    output.write_all(payload)
}

/// The time between two polls of a tap, after one that took so many samples: 1 ms while samples arrive, down
/// to 0.1 ms when a poll takes several, because the queue has room for four, and doubled up to 20 ms while
/// none arrive.
fn pause_after(pause_us: u64, taken: usize) -> u64 {
    match taken {
        0 => (pause_us * 2).min(20_000),
        1 => pause_us.min(USUAL_PAUSE_US),
        _ => (pause_us / 2).clamp(100, USUAL_PAUSE_US),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_is_length_encapsulation_and_payload() {
        let mut bytes = Vec::new();
        write_frame(&mut bytes, Encapsulation([0, 7, 0, 2]), b"abc").unwrap();
        write_frame(&mut bytes, Encapsulation::CDR_LE, b"").unwrap();
        assert_eq!(bytes, [7, 0, 0, 0, 0, 7, 0, 2, b'a', b'b', b'c', 4, 0, 0, 0, 0, 1, 0, 0]);
    }

    #[test]
    fn a_tap_polls_more_often_while_samples_arrive() {
        let pause_us = (0..11).fold(USUAL_PAUSE_US, |pause_us, _| pause_after(pause_us, 0));
        assert_eq!(pause_us, 20_000);
        assert_eq!(pause_after(pause_us, 1), 1_000);
        let pause_us = (0..11).fold(1_000, |pause_us, _| pause_after(pause_us, 4));
        assert_eq!(pause_us, 100);
        assert_eq!((pause_after(pause_us, 2), pause_after(pause_us, 1)), (100, 100));
    }

    #[test]
    fn an_encapsulation_without_a_name_is_shown_as_its_number() {
        assert_eq!(representation(Encapsulation::CDR_LE), "CDR_LE");
        assert_eq!(representation(Encapsulation([0x12, 0xab, 0, 0])), "0x12ab");
    }
}
