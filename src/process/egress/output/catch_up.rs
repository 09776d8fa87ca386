//! How a critical lane catches up with what was published while it was down, or while it did not run.
//!
//! A VOLATILE reader never gets what was written before it matched, so the samples wait in the queue until
//! the readers of the former process have matched again. An output with a history needs no wait: it gives
//! late joiners what they missed.

use super::Output;
use crate::clock;
use crate::dds::RawWriter;
use crate::model::{ReaderRecord, SampleHeader};
use crate::policy::is_stale;

/// Older samples are left out, except for the last [`ANY_AGE_SAMPLES`]. At 1 Hz ingress retains those of some
/// minutes, and a subscriber that has lost the lane for so long must not act on all of them.
const CATCH_UP_MS: u64 = 10_000;

/// The last samples of a route, which are forwarded however old they are: they may be its present state.
const ANY_AGE_SAMPLES: u64 = 8;

/// The samples before the next one that ingress still keeps while a lane may wait: 32 ms at 1 kHz.
const KEPT_BEFORE: u64 = 32;

impl Output {
    /// Lets the samples go that wait for former readers.
    pub fn end_hold(&mut self) {
        self.is_held = false;
    }

    /// Whether samples still have to wait for former readers.
    pub(super) fn is_still_held(&mut self) -> bool {
        let now = clock::monotonic();
        self.follow_matching(now);
        let waits = self.history.is_none()
            && self.writer.as_ref().is_some_and(|writer| {
                self.former_readers.hold(now)
                    || (self.former_readers.may_hold(now) && self.lack_former(writer.matched_readers()))
            });
        // The readers that have matched must not lose samples to the others.
        self.is_held = waits && (self.counters.get().readers == 0 || !self.are_samples_nearly_lost());
        self.is_held
    }

    /// Whether samples wait until the library has sent the ones before: it would discard the oldest. A lane
    /// that catches up also waits until the readers have acknowledged them: all of them at once would
    /// overflow the sockets of the readers, and leave the history of the writer before they are repaired.
    pub(super) fn is_to_be_paced(&mut self) -> bool {
        // The library may have sent them since the last turn, while another output kept the lane busy.
        self.is_paced = (self.is_library_full() && self.count_sent() && self.is_library_full())
            || self.waits_for_any(self.writer.iter().flat_map(RawWriter::matched_readers));
        self.is_paced
    }

    fn is_library_full(&self) -> bool {
        self.catch_up.is_full(self.unsent.len() as u64, self.unsent.bytes())
    }

    pub(super) fn waits_for_any(&self, mut matched: impl Iterator<Item = ReaderRecord>) -> bool {
        self.catch_up.is_on()
            && self.history.is_none()
            && matched.any(|reader| self.catch_up.waits_for(&reader))
            // The others must not lose samples to a slow one.
            && !self.are_samples_nearly_lost()
    }

    /// The lane has not taken samples in time.
    pub(super) fn begin_catch_up(&mut self) {
        let readers = self.writer.iter().flat_map(RawWriter::matched_readers);
        self.catch_up.begin(readers, clock::monotonic());
    }

    /// The lane takes one more sample, of that size, before its queue is empty.
    pub(super) fn follow_burst(&mut self, bytes: usize) {
        if self.catch_up.takes(bytes as u64) {
            self.begin_catch_up();
        }
    }

    /// The queue is empty. The lane has not caught up before the readers have: what comes next would push
    /// samples out of the history of the writer that they still lack.
    pub(super) fn end_catch_up(&mut self) {
        let readers = || self.writer.iter().flat_map(RawWriter::matched_readers);
        // After a restart it is empty before ingress delivers to it.
        if self.caught_up && !self.waits_for_any(readers()) {
            self.catch_up.end(readers());
        }
    }

    /// Whether samples wait for former readers.
    pub const fn is_held(&self) -> bool {
        self.is_held
    }

    /// Whether samples wait for acknowledgements.
    pub const fn is_paced(&self) -> bool {
        self.is_paced
    }

    /// Whether matched readers lack samples of the former process that are not counted yet. The library sends
    /// them when the last former reader has matched, and to a reader that is not ready then when it is.
    pub(super) fn lack_former(&self, mut matched: impl Iterator<Item = ReaderRecord>) -> bool {
        let lacks = |reader: ReaderRecord| reader.reliable == 1 && reader.unacknowledged > 0;
        self.unsent.len() > 0 && matched.any(lacks)
    }

    /// Whether the queue is nearly full, and ingress keeps few samples before the next one either.
    pub(super) fn are_samples_nearly_lost(&self) -> bool {
        let last = self.boards.ingress(self.route).map_or(0, |ingress| ingress.published);
        let waiting = last.saturating_sub(self.tracker.last());
        let is_kept = || {
            let first = self.boards.backlog(self.route).map_or(0, |backlog| backlog.first_sequence);
            first > 0 && first + KEPT_BEFORE <= self.tracker.last()
        };
        waiting >= self.subscriber.queue_depth() as u64 / 8 * 7 && !is_kept()
    }

    /// Whether a sample is too old to be forwarded by a lane that is behind: its LIFESPAN has ended, or it
    /// belongs to a long outage.
    pub(super) fn is_too_old(&self, header: &SampleHeader) -> bool {
        // A noncritical lane has a limit of its own, and late joiners may need any sample of a history.
        let Some(behind_since) = self.catch_up.since().filter(|_| self.history.is_none()) else {
            return false;
        };
        let age_ns = clock::monotonic().since(header.age_from());
        let lifespan_ms = self.offer.qos.lifespan_ms.unwrap_or(0);
        let last = self.boards.ingress(self.route).map_or(0, |ingress| ingress.published);
        is_stale(age_ns, lifespan_ms)
            || (last.saturating_sub(header.sequence) >= ANY_AGE_SAMPLES
                && is_stale(behind_since.since(header.published_at), CATCH_UP_MS))
    }
}
