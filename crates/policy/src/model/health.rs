//! Records that the processes write to their boards: plain data of fixed size, which a reader can use even
//! after the process that wrote them has died. What `status --json` shows of them is serialized.

use serde::{Serialize, Serializer};

use super::drops::DropCounts;
use super::modes::TakeOverCause;
use super::names::TopicName;
use super::network::NetworkRefusals;
use super::qos::Durability;
use super::sample::Guid;
use super::time::MonotonicNs;
use super::type_hash::{DdsType, TypeHash};

/// The most publishers of one route that have an account each.
pub const MAX_PUBLISHERS: usize = 64;

/// The account of one publisher: which samples of its DDS writer ingress has taken, by sequence numbers.
///
/// `last_sequence - first_sequence + 1 = received + lost_upstream`, always.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[repr(C)]
pub struct PublisherAccount {
    /// The DDS writer; all zero for a free account.
    pub writer: Guid,
    /// The sequence number of the first sample taken. Samples with lower numbers were written before ingress
    /// first read from the writer.
    pub first_sequence: i64,
    /// The highest sequence number taken, the high-water mark: ingress discards samples up to this number.
    pub last_sequence: i64,
    /// Samples taken.
    pub received: u64,
    /// Sequence numbers between the first and the last that were not taken.
    pub lost_upstream: u64,
    /// Samples discarded because their sequence number was at or below the high-water mark.
    pub repeated: u64,
    /// When the last sample was taken.
    #[serde(skip)]
    pub last_at: MonotonicNs,
    /// The reliability that discovery found: `OFFER_UNKNOWN`, `OFFERS_BEST_EFFORT` or `OFFERS_RELIABLE`.
    #[serde(skip)]
    pub offered_reliability: u64,
}

impl PublisherAccount {
    /// The writer is not discovered, or not any more.
    pub const OFFER_UNKNOWN: u64 = 0;
    /// The writer does not resend samples that the network loses.
    pub const OFFERS_BEST_EFFORT: u64 = 1;
    /// The writer resends samples that the network loses.
    pub const OFFERS_RELIABLE: u64 = 2;

    /// The account of a writer before its first sample, which has this sequence number, is taken.
    pub fn new(writer: Guid, first_sequence: i64) -> Self {
        let last_sequence = first_sequence.saturating_sub(1);
        Self { writer, first_sequence, last_sequence, ..Self::default() }
    }

    /// Whether no publisher has this account.
    #[inline]
    pub fn is_vacant(&self) -> bool {
        self.writer == Guid::default()
    }

    /// Counts a sample whose sequence number is above the high-water mark, and returns the number of sequence
    /// numbers skipped before it.
    #[inline]
    pub fn take(&mut self, sequence: i64, now: MonotonicNs) -> u64 {
        let skipped = sequence.saturating_sub(self.last_sequence).saturating_sub(1).max(0).unsigned_abs();
        self.last_sequence = sequence;
        self.received += 1;
        // The number comes from the network: a hostile writer can skip any number of sequence numbers.
        self.lost_upstream = self.lost_upstream.saturating_add(skipped);
        self.last_at = now;
        skipped
    }
}

/// The counters of ingress for one route. `received = published + drops`, always.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[repr(C)]
pub struct IngressCounters {
    /// Samples taken from the DDS reader.
    pub received: u64,
    /// Payload bytes of those.
    pub received_bytes: u64,
    /// Samples published to the lanes; also the number of the last one, as ingress numbers without gaps.
    pub published: u64,
    /// Of the published, those that the DDS library assembled in the pool, without a copy.
    pub in_place: u64,
    /// Samples received and not published.
    pub drops: DropCounts,
    /// Samples lost before ingress: their publisher numbered them, and the DDS reader never returned them.
    pub lost_upstream: u64,
    /// Samples discarded because their sequence number was at or below the high-water mark of their
    /// publisher; not among the received.
    pub repeated: u64,
    /// Of the received, those of publishers beyond [`MAX_PUBLISHERS`], which have no high-water mark.
    pub unmarked: u64,
    /// The index of the account that changed last.
    #[serde(skip)]
    pub changed_place: u64,
    /// That account after the change. Ingress writes it here in one step with the counters and then into the
    /// table: if ingress dies in between, its successor reads it here.
    #[serde(skip)]
    pub changed_account: PublisherAccount,
    /// Writers matched at present.
    pub writers: u64,
    /// Shared memory of the pool, in bytes.
    pub pool_bytes: u64,
    /// The most shared memory that the pool has had since ingress started, in bytes.
    pub pool_peak_bytes: u64,
    /// The budget of the pools of all routes, in bytes; the same for each route, as the next two.
    #[serde(skip)]
    pub budget_bytes: u64,
    /// Shared memory of the pools of all routes, in bytes.
    #[serde(skip)]
    pub budget_used_bytes: u64,
    /// The most that they have had together since ingress started, in bytes.
    #[serde(skip)]
    pub budget_peak_bytes: u64,
    /// When the last sample was taken.
    #[serde(skip)]
    pub last_received_at: MonotonicNs,
    /// How far the clock of `clock_writer` is behind this host's, in nanoseconds, negative when it is ahead;
    /// 0 while the clocks of all publishers agree with this host's.
    #[serde(skip)]
    pub clock_offset_ns: i64,
    /// The writer whose clock differs most; all zero for none.
    #[serde(skip)]
    pub clock_writer: Guid,
}

impl IngressCounters {
    /// How far a publisher's clock is ahead of this computer's; `None` while all agree.
    pub fn clock_offset_s(&self) -> Option<f64> {
        (self.clock_offset_ns != 0).then(|| -(self.clock_offset_ns as f64) / 1e9)
    }
}

/// The counters of one lane for one route.
///
/// `last_sequence - first_sequence = forwarded + drops + waiting`, always.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[repr(C)]
pub struct LaneCounters {
    /// The last sequence number before the first one that the lane accounts for.
    #[serde(skip)]
    pub first_sequence: u64,
    /// The highest sequence number that the lane has accounted for or holds.
    #[serde(skip)]
    pub last_sequence: u64,
    /// Samples written to DDS.
    pub forwarded: u64,
    /// Payload bytes of those.
    pub forwarded_bytes: u64,
    /// Of the forwarded, those passed to DDS by reference.
    pub by_reference: u64,
    /// Of the forwarded, those published while the lane was down, which it caught up with afterwards.
    pub caught_up: u64,
    /// Samples taken or missing, and not forwarded.
    pub drops: DropCounts,
    /// Samples waiting in the lane at present.
    pub waiting: u64,
    /// When the last forwarded sample was written to DDS.
    #[serde(skip)]
    pub last_forwarded_at: MonotonicNs,
    /// Readers matched at present.
    pub readers: u64,
    /// Overruns summed over all readers ever matched: samples that left the writer's history before one
    /// reader acknowledged them. The lane forwarded these samples, and other readers may have received them.
    pub reader_overrun: u64,
    /// Of the forwarded, the most that one reader may have missed because a process of the lane ended before
    /// it had repaired them: [`OutputReaders::unconfirmed`](super::OutputReaders::unconfirmed), summed over
    /// the ends.
    pub unconfirmed: u64,
    /// Samples that the lane began to send before ingress had received all of them.
    pub begun_early: u64,
    /// Of those, the ones that it gave up, because another sample came first or they never became complete.
    /// Those that became complete later were sent as a whole.
    pub withdrawn: u64,
    /// Late joiners that get no history, because too many others waited for it when they matched.
    pub late_joiners_unserved: u64,
    /// The highest RTPS sequence number of a sample that is forwarded or dropped. The next process of the
    /// lane sends the samples after it that are in the send log.
    #[serde(skip)]
    pub accounted_number: i64,
}

impl LaneCounters {
    /// Samples of the route since the lane began to account for them.
    pub fn received(&self) -> u64 {
        self.last_sequence.saturating_sub(self.first_sequence)
    }

    /// Whether every sample is accounted for: forwarded, waiting, or dropped for a named reason.
    pub fn is_accounted_for(&self) -> bool {
        let counted = self.forwarded.saturating_add(self.drops.total()).saturating_add(self.waiting);
        self.received() == counted
    }
}

/// The health of a process: its id, its turns, its starts and the policy that it applies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[repr(C)]
pub struct ProcessHealth {
    /// Process id.
    pub pid: u64,
    /// When the process started.
    #[serde(skip)]
    pub started_at: MonotonicNs,
    /// When its main loop last completed a turn: handled samples, or checked its wake-up source.
    #[serde(skip)]
    pub alive_at: MonotonicNs,
    /// Turns of its main loop.
    pub turns: u64,
    /// Starts of processes with this role in this bridge, including this one.
    pub starts: u64,
    /// The mode that the process applies, as [`LaneMode`](super::modes::LaneMode)'s number.
    #[serde(skip)]
    pub mode: u8,
    /// 1 when the process shut down in order; it stays 0 when the process dies.
    #[serde(skip)]
    pub ended: u8,
    /// Always 0.
    #[serde(skip)]
    pub reserved: [u8; 6],
    /// The epoch of the policy that the process applies.
    #[serde(skip)]
    pub policy_epoch: u64,
    /// The process' DDS participant. If the process is killed, its successor announces to remote participants
    /// that this one has left.
    #[serde(skip)]
    pub participant: Guid,
    /// Failures other than of samples: housekeeping, a board, a policy that it could not write.
    pub errors: u64,
    /// The fingerprint of the configuration that the process applies.
    #[serde(skip)]
    pub settings_fingerprint: u64,
    /// Reloads that the process refused because the file was bad.
    pub refused_reloads: u64,
    /// What its participants refused of the network since it started.
    pub network_refusals: NetworkRefusals,
}

/// The standby of a process: who waits for its role now, and how often one has taken the role over.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
#[repr(C)]
pub struct StandbyRecord {
    /// The process id of the standby that waits; 0 if none does.
    pub pid: u64,
    /// When it last checked whether the role is free.
    #[serde(skip)]
    pub alive_at: MonotonicNs,
    /// How often a standby has taken the role over.
    pub take_overs: u64,
    /// When that last happened.
    #[serde(skip)]
    pub taken_over_at: MonotonicNs,
    /// How long it took: from the end of the former process to the first turn of the next one, in
    /// nanoseconds.
    pub took_ns: u64,
    /// How many take-overs followed each other within a minute, up to the last one. Hand-overs do not count.
    pub in_a_row: u64,
    /// Why the last one happened, as [`TakeOverCause`]'s number; 0 if none has.
    #[serde(serialize_with = "cause_label")]
    pub cause: u8,
    /// Always 0.
    #[serde(skip)]
    pub reserved: [u8; 7],
}

impl StandbyRecord {
    /// Why the last take-over happened; `None` if none has.
    pub const fn cause(&self) -> Option<TakeOverCause> {
        TakeOverCause::from_u8(self.cause)
    }
}

fn cause_label<S: Serializer>(number: &u8, serializer: S) -> Result<S::Ok, S::Error> {
    TakeOverCause::from_u8(*number).map(TakeOverCause::label).serialize(serializer)
}

/// The policy of one lane on the policy board: control's decision, the floor of the safety supervisor and an
/// operator's override. Each part has its own writer, which leaves the other parts unchanged.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct LanePolicy {
    /// Increases by one with each change; 0 before the first.
    pub epoch: u64,
    /// When control last wrote or confirmed its part; 0 for never.
    pub written_at: MonotonicNs,
    /// When the override by hand ends; 0 for never.
    pub expires_at: MonotonicNs,
    /// When the epoch last increased.
    pub changed_at: MonotonicNs,
    /// Control's mode, as [`LaneMode`](super::modes::LaneMode)'s number.
    pub mode: u8,
    /// The mildest mode that the safety supervisor allows, as [`LaneMode`](super::modes::LaneMode)'s number.
    /// An override cannot go below it.
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
    #[inline]
    pub const fn is_overridden(&self, now: MonotonicNs) -> bool {
        self.by_hand != 0 && (self.expires_at.0 == 0 || now.0 < self.expires_at.0)
    }

    /// Whether control has written or confirmed its part within `policy_hold_ms`.
    #[inline]
    pub const fn is_confirmed(&self, now: MonotonicNs, policy_hold_ms: u64) -> bool {
        self.written_at.0 != 0 && now.since(self.written_at) <= policy_hold_ms.saturating_mul(1_000_000)
    }
}

/// A text of at most 127 bytes in shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub struct FixedText {
    length: u8,
    bytes: [u8; 127],
}

impl FixedText {
    /// Copies the text, cut to at most 127 bytes at a character boundary.
    pub fn new(text: &str) -> Self {
        let mut cut = text.len().min(127);
        while !text.is_char_boundary(cut) {
            cut -= 1;
        }
        let mut bytes = [0; 127];
        bytes[..cut].copy_from_slice(&text.as_bytes()[..cut]);
        Self { length: cut as u8, bytes }
    }

    /// The text; empty when the bytes are not UTF-8, which happens only if a foreign program wrote them.
    pub fn as_str(&self) -> &str {
        let length = usize::from(self.length).min(self.bytes.len());
        core::str::from_utf8(&self.bytes[..length]).unwrap_or("")
    }
}

impl Default for FixedText {
    fn default() -> Self {
        Self { length: 0, bytes: [0; 127] }
    }
}

/// The message type that ingress has discovered for a route, for lanes that cannot discover the publisher.
/// Publishers of a topic should agree on it; the other fields name one that does not.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct RouteInfo {
    /// The DDS type name of the input topic; empty while unknown.
    pub dds_type: FixedText,
    /// The hash of the type's definition, which a publisher has announced.
    pub type_hash: TypeHash,
    /// The DDS writer of a publisher that announces another type or another definition of it; all zero for
    /// none.
    pub other_writer: Guid,
    /// The type that it announces.
    pub other_type: FixedText,
    /// The hash that it announces.
    pub other_hash: TypeHash,
    /// 1 if all present publishers offer TRANSIENT_LOCAL, or the last ones did, else 0.
    pub transient_local: u64,
    /// 1 if the type has keys, as the publishers announce it, else 0. It is 0 before there was a publisher.
    pub has_keys: u64,
    /// The input topic of a route that has its topic by a pattern; empty while it has none.
    pub bound_topic: FixedText,
    /// The last sequence number of the route before it got this topic. What is numbered up to it is of
    /// another topic.
    pub bound_after: u64,
    /// How many topics the route has had by its pattern.
    pub bound_count: u64,
}

impl RouteInfo {
    /// What the publishers offer: it applies to outputs for which the configuration gives no DURABILITY.
    pub fn durability(&self) -> Durability {
        if self.transient_local == 0 { Durability::Volatile } else { Durability::TransientLocal }
    }

    /// The topic that the route has by a pattern; `None` while it has none.
    pub fn topic(&self) -> Option<TopicName> {
        TopicName::try_from(self.bound_topic.as_str()).ok()
    }

    /// The type that the outputs of the route announce; `None` while it is unknown.
    pub fn announced_type(&self) -> Option<DdsType<'_>> {
        let name = self.dds_type.as_str();
        (!name.is_empty()).then_some(DdsType { name, hash: self.type_hash, has_keys: self.has_keys != 0 })
    }
}

/// Buckets of each octave: each is at most 1/16 wide, so that a quantile is at most 6.3 % too large.
const SUB_BUCKETS: usize = 16;
/// Octaves, from 2^10 ns (1 µs) to 2^37 ns (137 s).
const OCTAVES: usize = 27;
const LOWEST_BIT: u32 = 10;

/// A histogram of latencies with log-linear buckets from 1 µs to 137 s, of a relative width of at most 1/16.
/// Counts only increase; a reader subtracts two readings for the latencies of a window.
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
    /// Counts one latency; one outside the range counts in the first or last bucket.
    #[inline]
    pub fn record(&mut self, latency_ns: u64) {
        self.counts[Self::bucket(latency_ns)] += 1;
        self.max_ns = self.max_ns.max(latency_ns);
    }

    /// Latencies counted.
    pub fn count(&self) -> u64 {
        // As in `DropCounts`, the counts may be any number.
        self.counts.iter().fold(0, |total, count| total.saturating_add(*count))
    }

    /// The latency at or below which the share `quantile` (0 to 1) of all counted latencies lies, as the
    /// upper edge of its bucket in nanoseconds; `None` when none was counted.
    pub fn quantile_ns(&self, quantile: f64) -> Option<u64> {
        let total = self.count();
        if total == 0 {
            return None;
        }
        let rank = (libm::ceil(quantile.clamp(0.0, 1.0) * total as f64) as u64).max(1);
        let mut seen = 0;
        for (bucket, count) in self.counts.iter().enumerate() {
            seen = u64::saturating_add(seen, *count);
            if seen >= rank {
                return Some(Self::upper_edge_ns(bucket).min(self.max_ns.max(1)));
            }
        }
        Some(self.max_ns)
    }

    /// The latencies counted since an earlier reading; the maximum remains that of all latencies.
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

    /// The index of the bucket in which a latency counts.
    #[inline]
    pub fn bucket(latency_ns: u64) -> usize {
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
    fn quantiles_are_within_one_bucket_of_the_exact_value() {
        let mut histogram = LatencyHistogram::default();
        assert_eq!(histogram.quantile_ns(0.5), None);
        for value in 1..=10_000u64 {
            histogram.record(value * 1_000);
        }
        for quantile in [0.01, 0.5, 0.9, 0.99, 0.999] {
            let exact = quantile * 10_000.0 * 1_000.0;
            let found = histogram.quantile_ns(quantile).unwrap() as f64;
            assert!(found >= exact && found <= exact * 1.0626, "{quantile}: {found} for {exact}");
        }
        assert_eq!(histogram.quantile_ns(1.0), Some(10_000_000));
    }

    #[test]
    fn values_out_of_range_are_counted() {
        let mut histogram = LatencyHistogram::default();
        histogram.record(0);
        histogram.record(u64::MAX);
        assert_eq!(histogram.count(), 2);
        assert_eq!(histogram.max_ns, u64::MAX);
        assert_eq!(histogram.since(&histogram).count(), 0);
    }

    #[test]
    fn a_lane_is_whole_when_every_sample_is_accounted_for() {
        let mut counters =
            LaneCounters { first_sequence: 10, last_sequence: 20, forwarded: 7, ..Default::default() };
        assert!(!counters.is_accounted_for());
        counters.drops.add(DropReason::Stale, 2);
        counters.waiting = 1;
        assert!(counters.is_accounted_for());
    }

    #[test]
    fn fixed_text_cuts_between_characters() {
        assert_eq!(FixedText::new("sensor").as_str(), "sensor");
        assert_eq!(FixedText::default().as_str(), "");
        let long = "ä".repeat(100);
        assert_eq!(FixedText::new(&long).as_str(), "ä".repeat(63));
    }

    #[test]
    fn an_account_counts_the_sequence_numbers_that_its_publisher_skipped() {
        let mut account = PublisherAccount::new(Guid([1; 16]), 5);
        assert!(!account.is_vacant() && PublisherAccount::default().is_vacant());
        let skipped = [5, 6, 10].map(|sequence| account.take(sequence, MonotonicNs(sequence.unsigned_abs())));
        assert_eq!(skipped, [0, 0, 3]);
        assert_eq!((account.received, account.lost_upstream), (3, 3));
        assert_eq!((account.last_sequence, account.last_at), (10, MonotonicNs(10)));
        account.take(i64::MAX, MonotonicNs(11));
        assert_eq!(account.lost_upstream, 3 + i64::MAX.unsigned_abs() - 11);
    }

    #[test]
    fn a_route_announces_the_type_and_the_durability_of_its_publishers() {
        let mut info = RouteInfo::default();
        assert_eq!((info.announced_type(), info.durability()), (None, Durability::Volatile));
        let (name, hash) = ("std_msgs::msg::dds_::String_", TypeHash([7; 32]));
        (info.dds_type, info.type_hash, info.transient_local) = (FixedText::new(name), hash, 1);
        assert_eq!(info.announced_type(), Some(DdsType { name, hash, has_keys: false }));
        assert_eq!(info.durability(), Durability::TransientLocal);
    }

    #[test]
    fn a_clock_that_is_ahead_has_a_positive_offset() {
        let mut counters = IngressCounters::default();
        assert_eq!(counters.clock_offset_s(), None);
        counters.clock_offset_ns = -2_500_000_000;
        assert_eq!(counters.clock_offset_s(), Some(2.5));
        counters.clock_offset_ns = 500_000_000;
        assert_eq!(counters.clock_offset_s(), Some(-0.5));
    }

    #[test]
    fn a_difference_of_histograms_has_the_latencies_since_the_earlier_one() {
        let mut histogram = LatencyHistogram::default();
        histogram.record(5_000_000);
        let earlier = histogram;
        histogram.record(2_000_000);
        histogram.record(2_000_000);
        let since = histogram.since(&earlier);
        let counts: Vec<_> = since.buckets().filter(|&(_, count)| count > 0).collect();
        assert!(matches!(counts[..], [(edge, 2)] if (2_000_000..2_130_000).contains(&edge)), "{counts:?}");
    }

    #[test]
    fn a_standby_has_a_cause_once_it_has_taken_over() {
        let cause = |cause| StandbyRecord { cause, ..StandbyRecord::default() }.cause();
        assert_eq!([0, 1, 3].map(cause), [None, Some(TakeOverCause::Ended), Some(TakeOverCause::HandedOver)]);
    }
}
