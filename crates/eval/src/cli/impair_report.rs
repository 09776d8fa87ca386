//! The output of `impair`: lines of text or of JSON.

use std::fmt;
use std::net::Ipv4Addr;

use serde::Serialize;

use crate::impairment::{Counters, GilbertElliott, LinkState, Replay, RowCounts};

/// The event that a line of output reports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub(super) enum Event {
    /// The link is in place.
    Ready,
    /// The link was switched.
    Changed,
    /// The user requested the counters.
    Counters,
    /// The link is about to be removed.
    Ended,
}

/// A line of output; docs/eval-json.md describes it.
#[derive(Debug, Serialize)]
pub(super) struct Report<'a> {
    pub event: Event,
    pub backend: &'static str,
    pub reason: &'a str,
    pub source: Ipv4Addr,
    pub destination: Option<Ipv4Addr>,
    pub state: LinkState,
    pub seed: Option<u64>,
    pub p: f64,
    pub r: f64,
    pub loss_good: f64,
    pub loss_bad: f64,
    pub delay_ms: f64,
    pub jitter_ms: f64,
    pub trace: Option<TraceReport<'a>>,
    #[serde(flatten)]
    pub counters: Counters,
    pub kernel_dropped: u64,
    #[serde(flatten)]
    pub loss: Loss,
}

/// The trace that the link follows.
#[derive(Debug, Serialize)]
pub(super) struct TraceReport<'a> {
    file: &'a str,
    repeat: bool,
    speed: f64,
    length_s: f64,
    row: Option<usize>,
    round: u64,
    /// Only in the last line: a trace may have thousands of rows.
    #[serde(skip_serializing_if = "Option::is_none")]
    rows: Option<Vec<RowReport>>,
}

/// The model of a row of the trace, and the packets counted while the row was in force.
#[derive(Debug, Serialize)]
struct RowReport {
    time_s: f64,
    loss: f64,
    delay_ms: f64,
    jitter_ms: f64,
    #[serde(flatten)]
    counts: RowCounts,
}

impl<'a> TraceReport<'a> {
    pub fn of(replay: &Replay, file: &'a str, speed: f64, event: Event) -> Self {
        let seconds = |ns: u64| ns as f64 / 1e9;
        let rows = || {
            let rows = replay.trace().rows().iter().zip(replay.counts());
            let row = rows.map(|(row, counts)| RowReport {
                time_s: seconds(row.at_ns),
                loss: row.loss.stationary_loss(),
                delay_ms: row.delay.mean_ms(),
                jitter_ms: row.delay.sigma_ms(),
                counts: *counts,
            });
            row.collect()
        };
        Self {
            file,
            repeat: replay.is_repeated(),
            speed,
            length_s: seconds(replay.trace().length_ns()),
            row: replay.has_started().then_some(replay.row()),
            round: replay.round(),
            rows: (event == Event::Ended).then(rows),
        }
    }
}

/// The measured loss while the link was on, and the loss that the model expects.
#[derive(Clone, Copy, Debug, Serialize)]
pub(super) struct Loss {
    loss: Option<f64>,
    loss_expected: f64,
    loss_standard_error: Option<f64>,
    lost_expected: f64,
}

impl Loss {
    /// The loss of a link that follows one correlated chain.
    pub fn of_chain(model: &GilbertElliott, counters: &Counters) -> Self {
        let any = counters.judged > 0;
        let loss_expected = model.stationary_loss();
        Self {
            loss: any.then(|| counters.lost as f64 / counters.judged as f64),
            loss_expected,
            loss_standard_error: any.then(|| model.loss_standard_error(counters.judged)),
            lost_expected: loss_expected * counters.judged as f64,
        }
    }

    /// The loss of a link that follows a trace: a packet's expected loss is that of the row in force at its
    /// arrival.
    pub fn of_trace(replay: &Replay, counters: &Counters) -> Self {
        let (lost_expected, error) = replay.lost_expected();
        if counters.judged == 0 {
            let loss_expected = replay.trace().mean_loss();
            return Self { loss: None, loss_expected, loss_standard_error: None, lost_expected };
        }
        let judged = counters.judged as f64;
        Self {
            loss: Some(counters.lost as f64 / judged),
            loss_expected: lost_expected / judged,
            loss_standard_error: Some(error / judged),
            lost_expected,
        }
    }
}

impl fmt::Display for Report<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { counters, loss, .. } = self;
        if let Event::Ready = self.event {
            let expected = loss.loss_expected * 100.0;
            write!(f, "{} from {}: {expected:.2} % lost in the long run, ", self.state, self.source)?;
            match &self.trace {
                Some(trace) => write!(f, "by {} of {:.1} s", trace.file, trace.length_s)?,
                None => write!(f, "{} ± {} ms", self.delay_ms, self.jitter_ms)?,
            }
            return write!(f, ", by {} ({})", self.backend, self.reason);
        }
        write!(f, "{}: {} packets seen, {} passed", self.state, counters.seen, counters.passed)?;
        if let (Some(share), Some(error)) = (loss.loss, loss.loss_standard_error) {
            let [share, error, expected] =
                [share, 1.96 * error, loss.loss_expected].map(|share| share * 100.0);
            let (lost, judged) = (counters.lost, counters.judged);
            write!(f, ", {lost} of {judged} lost ({share:.2} % ± {error:.2}, {expected:.2} % expected)")?;
        }
        for (count, what) in [
            (counters.cut, "lost while down"),
            (counters.overflowed, "dropped because too many were in transit"),
            (counters.held, "in transit"),
            (self.kernel_dropped, "dropped by the kernel before the link"),
        ] {
            if count > 0 {
                write!(f, ", {count} {what}")?;
            }
        }
        Ok(())
    }
}
