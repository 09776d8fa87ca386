//! What the probes say about the link to one subscriber (paper, section III-C): a sliding window of the
//! newest probes whose fate is known.

use std::collections::VecDeque;

use crate::model::MonotonicNs;

/// Probes that may wait for their answer at once. At 5 Hz and a timeout of 500 ms it is 3; even at 60 s it is
/// 300. Beyond the limit the oldest counts as lost: an answer that so many later probes overtook is late.
pub const MAX_OUTSTANDING: usize = 4_096;

/// Probes whose fate is known and whose number is still known too, to tell a late or repeated answer.
const REMEMBERED: usize = 64;

/// A control process that woke so much after the instant it asked for was stopped, or starved of its CPU: a
/// round trip that it measures then is its own delay and not that of the link. See [`ProbeWindow::stopped`].
pub const STOPPED_NS: u64 = 100_000_000;

/// What the window makes of a response.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Answer {
    /// The probe's first answer, in time.
    Counted {
        /// From the sending of the probe to this answer.
        rtt_ns: u64,
    },
    /// The probe counts as lost already, or was excused.
    Late,
    /// The probe was answered before.
    Repeated,
    /// No such probe was sent, or not lately.
    Unknown,
}

/// The link to one subscriber, as the window shows it.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LinkReading {
    /// Probes whose fate is known, at most those that the window holds; `answered + lost`.
    pub settled: usize,
    /// Of those, answered in time.
    pub answered: usize,
    /// Of those, not answered in time.
    pub lost: usize,
    /// Whether the window holds as many as it can.
    pub full: bool,
    /// `lost / settled`, 0 to 1; 0 while nothing is settled.
    pub loss: f64,
    /// Mean RTT of the answered; `None` when none was.
    pub rtt_mean_ms: Option<f64>,
    /// The RTT at or below which 95 % of the answered lie (nearest rank).
    pub rtt_p95_ms: Option<f64>,
    /// Mean absolute difference of the RTTs of consecutive answers, in the order of their arrival; `None` for
    /// fewer than two. RFC 3550 (section 6.4.1) smooths the same differences with a filter that never quite
    /// forgets; the mean has the window's memory, as all else in a reading.
    pub jitter_ms: Option<f64>,
}

/// What became of all probes: `sent = answered + lost + excused + outstanding`, always.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ProbeTotals {
    /// Probes sent.
    pub sent: u64,
    /// Answered in time.
    pub answered: u64,
    /// Not answered in time.
    pub lost: u64,
    /// Probes that say nothing about the link: sent before the subscriber's first answer, under way when the
    /// control process was stopped, or left behind by a numbering that began anew.
    pub excused: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fate {
    Outstanding,
    Answered,
    Lost,
    Excused,
}

#[derive(Clone, Copy, Debug)]
struct Probe {
    seq: u64,
    sent_at: MonotonicNs,
    fate: Fate,
}

/// The sliding window of one subscriber.
///
/// - It opens with the subscriber's first answer, be it late. Probes before it say nothing: nobody may have
///   been there to answer, or DDS had not yet matched the two sides. So a subscriber never heard has no
///   settled probes, and one that falls silent has lost ones.
/// - A probe that is not answered within the timeout is lost. One still under way doesn't count.
/// - Probes that were never sent are not lost: the window knows only what it was told was sent.
/// - It holds at most `window_size` fates and [`MAX_OUTSTANDING`] + 64 probes, whatever arrives.
#[derive(Clone, Debug)]
pub struct ProbeWindow {
    window_size: usize,
    timeout_ns: u64,
    /// RTTs in nanoseconds, `None` for a lost probe, in the order in which the fates became known.
    settled: VecDeque<Option<u64>>,
    /// By ascending number, and by the time of sending.
    probes: VecDeque<Probe>,
    totals: ProbeTotals,
    heard_at: Option<MonotonicNs>,
    /// For the quantile.
    scratch: Vec<u64>,
}

impl ProbeWindow {
    /// A window of the newest `window_size` probes, at least 1; an answer later than `timeout_ms` doesn't
    /// count.
    pub fn new(window_size: usize, timeout_ms: u64) -> Self {
        let window_size = window_size.max(1);
        Self {
            window_size,
            timeout_ns: timeout_ms.saturating_mul(1_000_000),
            settled: VecDeque::with_capacity(window_size),
            probes: VecDeque::with_capacity(2 * REMEMBERED),
            totals: ProbeTotals::default(),
            heard_at: None,
            scratch: Vec::with_capacity(window_size),
        }
    }

    /// Applies a new configuration. Fates already known stay; a smaller window forgets the oldest.
    pub fn set_limits(&mut self, window_size: usize, timeout_ms: u64) {
        self.window_size = window_size.max(1);
        self.timeout_ns = timeout_ms.saturating_mul(1_000_000);
        let excess = self.settled.len().saturating_sub(self.window_size);
        self.settled.drain(..excess);
    }

    /// A probe was sent. Its number is above all before it, by any amount; a lower one means that the
    /// numbering began anew, and what was under way is excused, since its answers cannot be told from those
    /// to come.
    pub fn sent(&mut self, seq: u64, at: MonotonicNs) {
        self.settle(at);
        if self.probes.back().is_some_and(|newest| newest.seq >= seq) {
            self.excuse(|_| true);
            self.probes.clear();
        }
        // What is left at the front is under way, see `trim`.
        if self.probes.len() >= MAX_OUTSTANDING + REMEMBERED && self.probes.pop_front().is_some() {
            self.lose(1);
        }
        self.probes.push_back(Probe { seq, sent_at: at, fate: Fate::Outstanding });
        self.totals.sent += 1;
        self.trim();
    }

    /// A response to probe `seq` arrived.
    pub fn answered(&mut self, seq: u64, at: MonotonicNs) -> Answer {
        self.settle(at);
        let Ok(index) = self.probes.binary_search_by_key(&seq, |probe| probe.seq) else {
            return Answer::Unknown;
        };
        let probe = self.probes[index];
        if probe.fate == Fate::Answered {
            return Answer::Repeated;
        }
        if self.heard_at.is_none() {
            self.excuse(|earlier| earlier.seq < seq);
        }
        self.heard_at = Some(at);
        if probe.fate != Fate::Outstanding {
            return Answer::Late;
        }
        let rtt_ns = at.since(probe.sent_at);
        self.probes[index].fate = Fate::Answered;
        self.totals.answered += 1;
        self.keep(Some(rtt_ns));
        self.trim();
        Answer::Counted { rtt_ns }
    }

    /// The control process did not run from `from` to `until`: it was stopped (SIGSTOP, a suspended machine)
    /// or starved. An answer that came meanwhile could not be taken, and would be late only because of us, so
    /// that every probe that was under way at any time of the pause is excused.
    ///
    /// Nobody but the caller can tell: it knows when it asked to be woken. To be called first in a turn that
    /// began more than [`STOPPED_NS`] too late, before the answers that piled up are handed in.
    pub fn stopped(&mut self, from: MonotonicNs, until: MonotonicNs) {
        self.settle(from);
        self.excuse(|probe| probe.sent_at <= until);
        self.trim();
    }

    /// When the subscriber was last heard, in time or late; `None` when never.
    pub const fn heard_at(&self) -> Option<MonotonicNs> {
        self.heard_at
    }

    /// What became of all probes so far.
    pub const fn totals(&self) -> ProbeTotals {
        self.totals
    }

    /// Probes that wait for their answer.
    pub fn outstanding(&self) -> usize {
        self.probes.iter().filter(|probe| probe.fate == Fate::Outstanding).count()
    }

    /// The link as it shows at `now`.
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

    /// Gives up on what has timed out: lost, or excused while nobody was heard yet.
    fn settle(&mut self, now: MonotonicNs) {
        let heard = self.heard_at.is_some();
        let mut lost = 0;
        for probe in &mut self.probes {
            if now.since(probe.sent_at) <= self.timeout_ns {
                break;
            }
            match probe.fate {
                Fate::Outstanding if heard => {
                    probe.fate = Fate::Lost;
                    lost += 1;
                }
                Fate::Outstanding => {
                    probe.fate = Fate::Excused;
                    self.totals.excused += 1;
                }
                Fate::Answered | Fate::Lost | Fate::Excused => {}
            }
        }
        self.lose(lost);
        self.trim();
    }

    fn lose(&mut self, probes: u64) {
        self.totals.lost += probes;
        for _ in 0..probes {
            self.keep(None);
        }
    }

    fn keep(&mut self, rtt_ns: Option<u64>) {
        if self.settled.len() >= self.window_size {
            self.settled.pop_front();
        }
        self.settled.push_back(rtt_ns);
    }

    fn excuse(&mut self, which: impl Fn(&Probe) -> bool) {
        for probe in &mut self.probes {
            if probe.fate == Fate::Outstanding && which(probe) {
                probe.fate = Fate::Excused;
                self.totals.excused += 1;
            }
        }
    }

    /// Forgets the numbers of old probes, but of none that is under way.
    fn trim(&mut self) {
        while self.probes.len() > REMEMBERED
            && self.probes.front().is_some_and(|oldest| oldest.fate != Fate::Outstanding)
        {
            self.probes.pop_front();
        }
    }
}
