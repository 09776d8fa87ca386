//! What every process shows of itself in shared memory: plain records of fixed size, so that a reader needs
//! nothing of the process that wrote them, not even that it is still alive.

use super::drops::DropCounts;
use super::sample::Guid;
use super::time::MonotonicNs;

/// Publishers of one route whose samples are numbered in an account of their own.
pub const MAX_PUBLISHERS: usize = 64;

/// How far ingress has taken the samples of one publisher, by the sequence numbers of its DDS writer.
///
/// `last_sequence - first_sequence + 1 = received + lost_upstream`, always.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct PublisherAccount {
    /// The DDS writer; all zero where no publisher has this place.
    pub writer: Guid,
    /// The number of the first sample taken. What has lower numbers was written before ingress first read
    /// the writer.
    pub first_sequence: i64,
    /// The highest number taken: its high-water mark. No sample with this number or a lower one is published
    /// again.
    pub last_sequence: i64,
    /// Samples taken.
    pub received: u64,
    /// Numbers between the first and the last that were not taken.
    pub lost_upstream: u64,
    /// Samples that arrived with a number at or below the mark, and were discarded.
    pub repeated: u64,
    /// When the last sample was taken.
    pub last_at: MonotonicNs,
    /// What the writer offers, as discovery knows it at present: one of `OFFER_UNKNOWN`,
    /// `OFFERS_BEST_EFFORT` and `OFFERS_RELIABLE`.
    pub offered_reliability: u64,
}

impl PublisherAccount {
    /// Discovery does not know the writer, or no more.
    pub const OFFER_UNKNOWN: u64 = 0;
    /// Samples that the network loses are not repaired.
    pub const OFFERS_BEST_EFFORT: u64 = 1;
    /// Samples that the network loses are repaired.
    pub const OFFERS_RELIABLE: u64 = 2;

    /// The account of a writer whose first sample has this number, before that sample is taken.
    pub const fn new(writer: Guid, first_sequence: i64) -> Self {
        Self {
            writer,
            first_sequence,
            last_sequence: first_sequence.saturating_sub(1),
            received: 0,
            lost_upstream: 0,
            repeated: 0,
            last_at: MonotonicNs(0),
            offered_reliability: Self::OFFER_UNKNOWN,
        }
    }

    /// Whether no publisher has this place.
    pub fn is_vacant(&self) -> bool {
        self.writer == Guid::default()
    }

    /// Takes the sample with that number, which is above the mark; yields how many numbers were skipped.
    pub fn take(&mut self, sequence: i64, now: MonotonicNs) -> u64 {
        let skipped = sequence.saturating_sub(self.last_sequence).saturating_sub(1).max(0).unsigned_abs();
        self.last_sequence = sequence;
        self.received += 1;
        // What the numbers of the writer claim; a hostile one may jump as far as it likes.
        self.lost_upstream = self.lost_upstream.saturating_add(skipped);
        self.last_at = now;
        skipped
    }
}

/// What ingress has done on one route. `received = published + drops`, always.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct IngressCounters {
    /// Samples taken from the DDS reader.
    pub received: u64,
    /// Payload bytes of those.
    pub received_bytes: u64,
    /// Samples published to the lanes; also the sequence of the last one, because ingress numbers without
    /// gaps.
    pub published: u64,
    /// Of the published, those that the DDS library put together in the pool itself, so that they were not
    /// copied there.
    pub in_place: u64,
    /// Samples received and not published.
    pub drops: DropCounts,
    /// Samples that the publisher numbered and the DDS reader never gave us: lost before the bridge.
    pub lost_upstream: u64,
    /// Samples that arrived with a number at or below the high-water mark of their publisher, and were
    /// discarded; not among the received.
    pub repeated: u64,
    /// Of the received, those of publishers beyond [`MAX_PUBLISHERS`], which have no high-water mark.
    pub unmarked: u64,
    /// The place of the account that changed last.
    pub changed_place: u64,
    /// That account as it was left. It is written here in the same step as the counts, and then in its place:
    /// a successor of a process that died in between finds it here.
    pub changed_account: PublisherAccount,
    /// Writers matched at present.
    pub writers: u64,
    /// When the last sample was taken.
    pub last_received_at: MonotonicNs,
    /// How far the clock of `clock_writer` is behind ours in nanoseconds, negative when it is ahead; 0 while
    /// the clocks of all publishers agree with ours.
    pub clock_offset_ns: i64,
    /// The writer whose clock is off furthest; all zero for none.
    pub clock_writer: Guid,
}

/// What one lane has done on one route.
///
/// `last_sequence - first_sequence = forwarded + drops` whenever no sample waits in the lane; while some
/// wait, the difference is `waiting`.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct LaneCounters {
    /// The route's sequence when the lane began to account for it.
    pub first_sequence: u64,
    /// The highest sequence that the lane has accounted for or holds.
    pub last_sequence: u64,
    /// Samples given to the DDS writer.
    pub forwarded: u64,
    /// Payload bytes of those.
    pub forwarded_bytes: u64,
    /// Of the forwarded, those handed over by reference.
    pub by_reference: u64,
    /// Of the forwarded, those published while the lane was down and caught up with afterwards.
    pub caught_up: u64,
    /// Samples taken or missed and not forwarded.
    pub drops: DropCounts,
    /// Samples waiting in the lane at present.
    pub waiting: u64,
    /// The sequence of the last forwarded sample.
    pub last_forwarded_sequence: u64,
    /// When it was given to the DDS writer.
    pub last_forwarded_at: MonotonicNs,
    /// The publisher's writer of the last forwarded sample, and its number there: what a standby resumes
    /// from.
    pub last_writer_guid: Guid,
    /// See `last_writer_guid`.
    pub last_writer_sequence: i64,
    /// Readers matched at present.
    pub readers: u64,
    /// Samples that single readers missed because they did not keep up, summed over all readers ever matched.
    /// The lane forwarded these samples; the other readers have them.
    pub reader_overrun: u64,
}

/// Readers of one output that are recorded by name; further ones are only counted.
pub const MAX_OUTPUT_READERS: usize = 32;

/// One reader that is matched with an output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct ReaderRecord {
    /// The reader; all zero for none.
    pub reader: Guid,
    /// Samples written since it was matched, and the history that it was offered then.
    pub offered: u64,
    /// Of those, samples that a RELIABLE reader has not acknowledged; 0 for a BEST_EFFORT one.
    pub unacknowledged: u64,
    /// Of those, samples that left the writer's history before the reader had them.
    pub overrun: u64,
    /// 1 for a RELIABLE reader, 0 for a BEST_EFFORT one.
    pub reliable: u64,
}

/// The readers that are matched with one output.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct OutputReaders {
    /// The readers, from the first place on.
    pub records: [ReaderRecord; MAX_OUTPUT_READERS],
}

impl OutputReaders {
    /// The recorded readers.
    pub fn iter(&self) -> impl Iterator<Item = &ReaderRecord> {
        self.records.iter().filter(|record| record.reader != Guid::default())
    }
}

impl LaneCounters {
    /// Samples that the lane was offered since it began to account.
    pub fn received(&self) -> u64 {
        self.last_sequence.saturating_sub(self.first_sequence)
    }

    /// Whether every sample offered is forwarded, waiting, or dropped for a named reason.
    pub fn is_whole(&self) -> bool {
        let counted = self.forwarded.saturating_add(self.drops.total()).saturating_add(self.waiting);
        self.received() == counted
    }
}

/// What a process is and that it turns.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct ProcessHealth {
    /// Process id.
    pub pid: u64,
    /// When it came up.
    pub started_at: MonotonicNs,
    /// When its data path last turned: a sample handled, or an idle turn that tested the wake-up source.
    pub alive_at: MonotonicNs,
    /// Turns of the data path.
    pub turns: u64,
    /// How often a process of this role was started in this bridge, this one included.
    pub starts: u64,
    /// The mode that the process applies, as [`LaneMode`](super::modes::LaneMode)'s number.
    pub mode: u8,
    /// 1 when it ended as it was told to. A process that died could not say so.
    pub ended: u8,
    /// Always 0.
    pub reserved: [u8; 6],
    /// The epoch of the policy that the process applies.
    pub policy_epoch: u64,
    /// The process' DDS participant, for its successor to say goodbye for it should it be killed.
    pub participant: Guid,
    /// What failed in the process, samples apart: housekeeping, a board, a policy that could not be written.
    pub errors: u64,
    /// Tells the settings that the process applies from others.
    pub settings_fingerprint: u64,
    /// Reloads that the process refused because the file was bad.
    pub refused_reloads: u64,
}

/// What the policy board says to one lane: what control decided, what safety demands at least, and what an
/// operator has set. Each part has its own writer, and none takes away what another has said.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct LanePolicy {
    /// Grows by one with each change; 0 means that nobody has set a policy yet.
    pub epoch: u64,
    /// When control last wrote or confirmed its part; 0 means that control never did.
    pub written_at: MonotonicNs,
    /// When the override by hand ends; 0 never.
    pub expires_at: MonotonicNs,
    /// When the epoch last grew.
    pub changed_at: MonotonicNs,
    /// The mode that control decided on, as [`LaneMode`](super::modes::LaneMode)'s number.
    pub mode: u8,
    /// The mildest mode that the safety supervisor allows, as [`LaneMode`](super::modes::LaneMode)'s number.
    /// It holds against an override, too.
    pub safety_floor: u8,
    /// 1 while there is an override by hand.
    pub by_hand: u8,
    /// The mode of that override, as [`LaneMode`](super::modes::LaneMode)'s number.
    pub mode_by_hand: u8,
    /// Always 0.
    pub reserved: [u8; 4],
}

impl LanePolicy {
    /// Whether an override by hand is in force.
    pub const fn is_overridden(&self, now: MonotonicNs) -> bool {
        self.by_hand != 0 && (self.expires_at.0 == 0 || now.0 < self.expires_at.0)
    }

    /// Whether control has written or confirmed its part within `policy_hold_ms`.
    pub const fn is_confirmed(&self, now: MonotonicNs, policy_hold_ms: u64) -> bool {
        self.written_at.0 != 0 && now.since(self.written_at) <= policy_hold_ms.saturating_mul(1_000_000)
    }
}

/// Text of at most 127 bytes that can live in shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub struct FixedText {
    length: u8,
    bytes: [u8; 127],
}

impl FixedText {
    /// The text, cut at 127 bytes.
    pub fn new(text: &str) -> Self {
        let mut cut = text.len().min(127);
        while !text.is_char_boundary(cut) {
            cut -= 1;
        }
        let mut bytes = [0; 127];
        bytes[..cut].copy_from_slice(&text.as_bytes()[..cut]);
        Self { length: cut as u8, bytes }
    }

    /// The text; empty when the bytes are not UTF-8, which only a foreign writer could bring about.
    pub fn as_str(&self) -> &str {
        let length = usize::from(self.length).min(self.bytes.len());
        std::str::from_utf8(&self.bytes[..length]).unwrap_or("")
    }
}

impl Default for FixedText {
    fn default() -> Self {
        Self { length: 0, bytes: [0; 127] }
    }
}

/// What ingress has found out about a route, for lanes that cannot discover the publisher themselves.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct RouteInfo {
    /// The DDS type name of the input topic; empty while unknown.
    pub dds_type: FixedText,
}

/// Sub-buckets of each octave; the relative width of a bucket is 1/16, so that a quantile is at most 6.3 %
/// off.
const SUB_BUCKETS: usize = 16;
/// Octaves from 2^10 ns (1 µs) up to 2^37 ns (137 s).
const OCTAVES: usize = 27;
const LOWEST_BIT: u32 = 10;

/// Latencies in log-linear buckets: 1 µs to 137 s, a relative width of 1/16. Counts only grow; a reader that
/// wants a window subtracts two readings.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub struct LatencyHistogram {
    counts: [u64; SUB_BUCKETS * OCTAVES],
    /// The largest value recorded, in nanoseconds.
    pub max_ns: u64,
}

impl Default for LatencyHistogram {
    fn default() -> Self {
        Self { counts: [0; SUB_BUCKETS * OCTAVES], max_ns: 0 }
    }
}

impl LatencyHistogram {
    /// Counts one latency. Values outside the range count in the first or last bucket.
    pub fn record(&mut self, latency_ns: u64) {
        self.counts[Self::bucket(latency_ns)] += 1;
        self.max_ns = self.max_ns.max(latency_ns);
    }

    /// Latencies counted.
    pub fn count(&self) -> u64 {
        // As in `DropCounts`, the counts may be any.
        self.counts.iter().fold(0, |total, count| total.saturating_add(*count))
    }

    /// The latency below or at which a share of `quantile` (0 to 1) of all counted ones lies, in nanoseconds,
    /// as the upper edge of its bucket; `None` when nothing was counted.
    pub fn quantile_ns(&self, quantile: f64) -> Option<u64> {
        let total = self.count();
        if total == 0 {
            return None;
        }
        let rank = ((quantile.clamp(0.0, 1.0) * total as f64).ceil() as u64).max(1);
        let mut seen = 0;
        for (bucket, count) in self.counts.iter().enumerate() {
            seen = u64::saturating_add(seen, *count);
            if seen >= rank {
                return Some(Self::upper_edge_ns(bucket).min(self.max_ns.max(1)));
            }
        }
        Some(self.max_ns)
    }

    /// What was counted since `earlier`, a former reading of the same histogram. The maximum stays that of
    /// all.
    pub fn since(&self, earlier: &Self) -> Self {
        let mut difference = *self;
        for (count, before) in difference.counts.iter_mut().zip(earlier.counts.iter()) {
            *count = count.saturating_sub(*before);
        }
        difference
    }

    /// Upper edges of the buckets in nanoseconds, with their counts, smallest first.
    pub fn buckets(&self) -> impl Iterator<Item = (u64, u64)> + '_ {
        self.counts.iter().enumerate().map(|(bucket, &count)| (Self::upper_edge_ns(bucket), count))
    }

    fn bucket(latency_ns: u64) -> usize {
        let clamped = latency_ns.clamp(1 << LOWEST_BIT, (1 << (LOWEST_BIT + OCTAVES as u32)) - 1);
        let octave = clamped.ilog2() - LOWEST_BIT;
        let within = (clamped >> (octave + LOWEST_BIT - SUB_BUCKETS.ilog2())) as usize - SUB_BUCKETS;
        octave as usize * SUB_BUCKETS + within
    }

    fn upper_edge_ns(bucket: usize) -> u64 {
        let octave = (bucket / SUB_BUCKETS) as u32 + LOWEST_BIT;
        let within = (bucket % SUB_BUCKETS + SUB_BUCKETS + 1) as u64;
        within << (octave - SUB_BUCKETS.ilog2())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::DropReason;

    #[test]
    fn quantiles_are_within_a_bucket_of_the_truth() {
        let mut histogram = LatencyHistogram::default();
        assert_eq!(histogram.quantile_ns(0.5), None);
        for value in 1..=10_000u64 {
            histogram.record(value * 1_000);
        }
        for quantile in [0.01, 0.5, 0.9, 0.99, 0.999] {
            let truth = quantile * 10_000.0 * 1_000.0;
            let found = histogram.quantile_ns(quantile).unwrap() as f64;
            assert!(found >= truth && found <= truth * 1.0626, "{quantile}: {found} for {truth}");
        }
        assert_eq!(histogram.quantile_ns(1.0), Some(10_000_000));
    }

    #[test]
    fn values_out_of_range_are_counted_all_the_same() {
        let mut histogram = LatencyHistogram::default();
        histogram.record(0);
        histogram.record(u64::MAX);
        assert_eq!(histogram.count(), 2);
        assert_eq!(histogram.max_ns, u64::MAX);
        assert_eq!(histogram.since(&histogram).count(), 0);
    }

    #[test]
    fn a_lane_is_whole_when_every_sample_is_somewhere() {
        let mut counters =
            LaneCounters { first_sequence: 10, last_sequence: 20, forwarded: 7, ..Default::default() };
        assert!(!counters.is_whole());
        counters.drops.add(DropReason::Stale, 2);
        counters.waiting = 1;
        assert!(counters.is_whole());
    }

    #[test]
    fn fixed_text_cuts_between_characters() {
        assert_eq!(FixedText::new("sensor").as_str(), "sensor");
        assert_eq!(FixedText::default().as_str(), "");
        let long = "ä".repeat(100);
        assert_eq!(FixedText::new(&long).as_str(), "ä".repeat(63));
    }
}
