//! Measures the link to one subscriber with probes (paper, section III-C), over a sliding window of the
//! newest probes that were answered or lost.

use alloc::collections::VecDeque;
use alloc::vec::Vec;

use crate::model::MonotonicNs;

/// The most probes that wait for a response at once. At 5 Hz and a timeout of 500 ms 3 probes wait; even at a
/// timeout of 60 s it is 300. Beyond the limit the oldest counts as lost.
pub const MAX_OUTSTANDING: usize = 4_096;

/// Settled and excused probes that the window remembers, to recognize late and repeated responses.
const REMEMBERED: usize = 64;

/// A control process that wakes this much later than planned was stopped, or got no CPU time: round trips
/// that it measures then include its own delay. See [`ProbeWindow::excuse_pause`].
pub const STOPPED_NS: u64 = 100_000_000;

/// How the window counts a probe response.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ResponseOutcome {
    /// The probe's first response, in time.
    Counted {
        /// From the sending of the probe to the response.
        rtt_ns: u64,
    },
    /// The probe had already been counted as lost or excused.
    Late,
    /// The probe was answered before.
    Repeated,
    /// No such probe was sent, or the window does not remember it any more.
    Unknown,
}

/// The state of the link to one subscriber, computed from the window.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LinkReading {
    /// Probes in the window; `answered + lost`.
    pub settled: usize,
    /// Of those, answered in time.
    pub answered: usize,
    /// Of those, not answered in time.
    pub lost: usize,
    /// Whether the window is full.
    pub full: bool,
    /// `lost / settled`, 0 to 1; 0 when nothing is settled.
    pub loss: f64,
    /// Mean RTT of the answered probes; `None` when there are none.
    pub rtt_mean_ms: Option<f64>,
    /// The RTT at or below which 95 % of those of the answered probes lie (nearest rank).
    pub rtt_p95_ms: Option<f64>,
    /// Mean absolute difference of the RTTs of consecutive responses, in the order of their arrival; `None`
    /// for fewer than two. RFC 3550 (section 6.4.1) smooths the same differences with a filter of unlimited
    /// memory; the mean covers the window, as the other figures do.
    pub jitter_ms: Option<f64>,
}

/// Counts of all probes by outcome: `sent = answered + lost + excused + outstanding`, always.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ProbeTotals {
    /// Probes sent.
    pub sent: u64,
    /// Answered in time.
    pub answered: u64,
    /// Not answered in time.
    pub lost: u64,
    /// Probes excluded from the measurement: sent before the subscriber's first response, outstanding while
    /// the control process was stopped, or outstanding when the numbering restarted.
    pub excused: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Outcome {
    Outstanding,
    Answered,
    Lost,
    Excused,
}

#[derive(Clone, Copy, Debug)]
struct Probe {
    seq: u64,
    sent_at: MonotonicNs,
    outcome: Outcome,
}

/// The sliding window of the probes to one subscriber.
///
/// - It starts with the subscriber's first response, even a late one. Earlier probes do not count: there may
///   have been no responder, or DDS had not yet matched the two sides. A subscriber that never responded
///   therefore has no settled probes, and one that falls silent has lost probes.
/// - A probe that is not answered within the timeout is lost. An outstanding one does not count yet.
/// - A probe that was never sent is not lost: the window counts only probes passed to [`sent`](Self::sent).
/// - It holds at most `window_size` settled probes and [`MAX_OUTSTANDING`] + 64 others, whatever arrives.
#[derive(Clone, Debug)]
pub struct ProbeWindow {
    window_size: usize,
    timeout_ns: u64,
    /// RTTs in nanoseconds, `None` for a lost probe, in the order in which the probes were answered or lost.
    settled: VecDeque<Option<u64>>,
    /// By ascending number, which is also the order of sending.
    probes: VecDeque<Probe>,
    totals: ProbeTotals,
    last_response_at: Option<MonotonicNs>,
    /// A buffer for the quantile.
    scratch: Vec<u64>,
}

impl ProbeWindow {
    /// A window of the newest `window_size` probes, at least 1; a probe is lost after `timeout_ms`.
    pub fn new(window_size: usize, timeout_ms: u64) -> Self {
        let window_size = window_size.max(1);
        Self {
            window_size,
            timeout_ns: timeout_ms.saturating_mul(1_000_000),
            settled: VecDeque::with_capacity(window_size),
            probes: VecDeque::with_capacity(2 * REMEMBERED),
            totals: ProbeTotals::default(),
            last_response_at: None,
            scratch: Vec::with_capacity(window_size),
        }
    }

    /// Applies a new configuration. Settled probes stay; a smaller window removes the oldest.
    pub fn set_limits(&mut self, window_size: usize, timeout_ms: u64) {
        self.window_size = window_size.max(1);
        self.timeout_ns = timeout_ms.saturating_mul(1_000_000);
        let excess = self.settled.len().saturating_sub(self.window_size);
        self.settled.drain(..excess);
    }

    /// Records a probe that was sent. Numbers increase, by any amount. A number that is not above the last
    /// one means that the numbering restarted: outstanding probes are excused then, because their responses
    /// could be confused with those to new probes.
    pub fn sent(&mut self, seq: u64, at: MonotonicNs) {
        self.settle(at);
        if self.probes.back().is_some_and(|newest| newest.seq >= seq) {
            self.excuse(|_| true);
            self.probes.clear();
        }
        // The probe at the front is outstanding, see `trim`.
        if self.probes.len() >= MAX_OUTSTANDING + REMEMBERED && self.probes.pop_front().is_some() {
            self.count_lost(1);
        }
        self.probes.push_back(Probe { seq, sent_at: at, outcome: Outcome::Outstanding });
        self.totals.sent += 1;
        self.trim();
    }

    /// Records a response to probe `seq`.
    pub fn answered(&mut self, seq: u64, at: MonotonicNs) -> ResponseOutcome {
        self.settle(at);
        let Ok(index) = self.probes.binary_search_by_key(&seq, |probe| probe.seq) else {
            return ResponseOutcome::Unknown;
        };
        let probe = self.probes[index];
        if probe.outcome == Outcome::Answered {
            return ResponseOutcome::Repeated;
        }
        if self.last_response_at.is_none() {
            self.excuse(|earlier| earlier.seq < seq);
        }
        self.last_response_at = Some(at);
        if probe.outcome != Outcome::Outstanding {
            return ResponseOutcome::Late;
        }
        let rtt_ns = at.since(probe.sent_at);
        self.probes[index].outcome = Outcome::Answered;
        self.totals.answered += 1;
        self.push_settled(Some(rtt_ns));
        self.trim();
        ResponseOutcome::Counted { rtt_ns }
    }

    /// Excuses every probe that was outstanding at any time from `from` to `until`, while the control process
    /// did not run: it was stopped (SIGSTOP, a suspended machine) or got no CPU time. Responses that arrived
    /// in that time would count as late only because control did not read them.
    ///
    /// The caller detects the pause, because it knows when it should have woken. It calls this first in a
    /// turn that began more than [`STOPPED_NS`] late, before it passes the responses that queued up.
    pub fn excuse_pause(&mut self, from: MonotonicNs, until: MonotonicNs) {
        self.settle(from);
        self.excuse(|probe| probe.sent_at <= until);
        self.trim();
    }

    /// When the subscriber's last response arrived, in time or late; `None` for never.
    pub const fn last_response_at(&self) -> Option<MonotonicNs> {
        self.last_response_at
    }

    /// Counts of all probes so far, by outcome.
    pub const fn totals(&self) -> ProbeTotals {
        self.totals
    }

    /// Probes that wait for their response.
    pub fn outstanding(&self) -> usize {
        self.probes.iter().filter(|probe| probe.outcome == Outcome::Outstanding).count()
    }

    /// The state of the link at `now`.
    pub fn reading(&mut self, now: MonotonicNs) -> LinkReading {
        self.settle(now);
        self.scratch.clear();
        self.scratch.extend(self.settled.iter().flatten());
        let rtts = &mut self.scratch;
        let (settled, answered) = (self.settled.len(), rtts.len());
        let mean_ms = |sum_ns: u128, n: usize| (n > 0).then(|| sum_ns as f64 / n as f64 / 1e6);
        let sum_ns = rtts.iter().map(|&rtt_ns| u128::from(rtt_ns)).sum();
        let steps_ns = rtts.windows(2).map(|pair| u128::from(pair[0].abs_diff(pair[1]))).sum();
        rtts.sort_unstable();
        let p95_ns = (answered * 95).div_ceil(100).checked_sub(1).and_then(|index| rtts.get(index));
        LinkReading {
            settled,
            answered,
            lost: settled - answered,
            full: settled >= self.window_size,
            loss: if settled == 0 { 0.0 } else { (settled - answered) as f64 / settled as f64 },
            rtt_mean_ms: mean_ms(sum_ns, answered),
            rtt_p95_ms: p95_ns.map(|&rtt_ns| rtt_ns as f64 / 1e6),
            jitter_ms: mean_ms(steps_ns, answered.saturating_sub(1)),
        }
    }

    /// Times out outstanding probes: they are lost, or excused before the subscriber's first response.
    fn settle(&mut self, now: MonotonicNs) {
        let outcome = if self.last_response_at.is_some() { Outcome::Lost } else { Outcome::Excused };
        let mut timed_out = 0;
        for probe in &mut self.probes {
            if now.since(probe.sent_at) <= self.timeout_ns {
                break;
            }
            if probe.outcome == Outcome::Outstanding {
                probe.outcome = outcome;
                timed_out += 1;
            }
        }
        match outcome {
            Outcome::Lost => self.count_lost(timed_out),
            _ => self.totals.excused += timed_out,
        }
        self.trim();
    }

    fn count_lost(&mut self, probes: u64) {
        self.totals.lost += probes;
        for _ in 0..probes {
            self.push_settled(None);
        }
    }

    fn push_settled(&mut self, rtt_ns: Option<u64>) {
        if self.settled.len() >= self.window_size {
            self.settled.pop_front();
        }
        self.settled.push_back(rtt_ns);
    }

    fn excuse(&mut self, which: impl Fn(&Probe) -> bool) {
        for probe in &mut self.probes {
            if probe.outcome == Outcome::Outstanding && which(probe) {
                probe.outcome = Outcome::Excused;
                self.totals.excused += 1;
            }
        }
    }

    /// Removes the oldest probes beyond [`REMEMBERED`], up to the first outstanding one.
    fn trim(&mut self) {
        while self.probes.len() > REMEMBERED
            && self.probes.front().is_some_and(|oldest| oldest.outcome != Outcome::Outstanding)
        {
            self.probes.pop_front();
        }
    }
}
