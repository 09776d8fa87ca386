//! Which sequence number of the route each of the last samples of a DDS writer has, for the next process.

use std::sync::Arc;
use std::sync::atomic::Ordering;

use super::cell::LINE;
use super::segment::Segment;

/// The numbers that the log has: as many samples as ingress retains at most.
const ENTRIES: usize = 256;

/// The last numbers of one DDS writer. Each is recorded before the sample is sent, and a killed process loses
/// no store that it has executed, so the log is never behind the network.
#[derive(Clone, Debug)]
pub struct SendLog {
    segment: Arc<Segment>,
    at: usize,
}

impl SendLog {
    /// The highest number, on a cache line of its own, and the entries.
    pub(super) const WORDS: usize = LINE + ENTRIES;

    pub(super) const fn at(segment: Arc<Segment>, at: usize) -> Self {
        Self { segment, at }
    }

    /// The highest RTPS sequence number that the writer has used.
    pub fn highest(&self) -> i64 {
        self.segment.word(self.at).load(Ordering::Acquire).cast_signed()
    }

    /// Records the next RTPS sequence number, with the sequence number of the sample in the route: 0 for one
    /// that is not written.
    pub fn record(&self, number: i64, sequence: u64) {
        // In this order: an entry of which the number is not recorded is not read.
        self.segment.word(self.place(number)).store(sequence, Ordering::Release);
        self.segment.word(self.at).store(number.cast_unsigned(), Ordering::Release);
    }

    /// Begins the log of another writer.
    pub fn reset(&self) {
        self.segment.word(self.at).store(0, Ordering::Release);
    }

    /// The RTPS sequence numbers of the last written samples, each with the sequence number in the route;
    /// both ascend. Empty if another process has written something else.
    pub fn samples(&self) -> Vec<(i64, u64)> {
        let highest = self.highest();
        // Without the oldest entry: the next number may have been about to replace it.
        let first = highest.saturating_sub(ENTRIES as i64 - 2).max(1);
        let logged = (first..=highest)
            .map(|number| (number, self.segment.word(self.place(number)).load(Ordering::Acquire)));
        let samples: Vec<(i64, u64)> = logged.filter(|(_, sequence)| *sequence != 0).collect();
        if samples.is_sorted_by(|one, next| one.1 < next.1) { samples } else { Vec::new() }
    }

    const fn place(&self, number: i64) -> usize {
        self.at + LINE + number.rem_euclid(ENTRIES as i64) as usize
    }
}
