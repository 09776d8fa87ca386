//! The accounts of a route's publishers in shared memory: the high-water mark and counts of each; and how far
//! the clock of each differs from this computer's.

use std::sync::Arc;
use std::sync::atomic::{AtomicI64, AtomicU64, Ordering};

use tracing::{info, warn};

use crate::dds::SampleOrigin;
use crate::model::{
    AgeBasis, Guid, IngressCounters, MAX_PUBLISHERS, MonotonicNs, PublisherAccount, Reliability, WallNs,
};
use crate::policy::{ClockOffset, publisher_place};
use crate::shm::{BoardWriter, Boards};

/// How long a silent publisher may still be reported as the one whose clock is off furthest.
const CLOCK_REPORTED_MS: u64 = 60_000;

/// Shortest interval between two log lines of a route about its publishers' clocks.
const CLOCK_LOG_MS: u64 = 30_000;

/// A publisher whose last sample is at most this old at a restart is expected to send more.
const EXPECTED_MS: u64 = 5_000;

/// The accounts of a route's publishers, which a successor continues: it publishes no sample twice.
pub(super) struct Publishers {
    accounts: Vec<BoardWriter<PublisherAccount>>,
    /// For each account, whether discovery has removed its writer.
    gone: [bool; MAX_PUBLISHERS],
    /// For each account, whether its publisher wrote until the restart and has not written since.
    expected: [bool; MAX_PUBLISHERS],
    marks: Arc<HighWaterMarks>,
    /// For each account, the offset of its publisher's clock; not kept over a restart.
    clocks: Box<[ClockOffset]>,
    /// The publisher whose clock was logged last; `None` when all clocks agreed.
    logged_clock: Option<Guid>,
    log_clock_at: MonotonicNs,
    /// The place of the account of the last sample, which is looked up first: most routes have one publisher.
    last_place: usize,
}

/// The result of comparing a sample's sequence number with its publisher's high-water mark.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SequenceCheck {
    /// Above the high-water mark of the account at this place; and the basis of the sample's age.
    New(usize, AgeBasis),
    /// At or below the mark: the sample was taken before, or is too late.
    Repeated(usize),
    /// Not comparable: the publisher has no account, and active publishers use all places.
    Unmarked,
}

impl Publishers {
    /// Opens the accounts as the former process left them.
    pub fn open(boards: &Boards, route: usize, counters: &IngressCounters, now: MonotonicNs) -> Self {
        let writer = |place| boards.publisher_writer(route, place);
        let mut accounts: Vec<_> = (0..MAX_PUBLISHERS).map(writer).collect();
        // `update` writes an account twice: with the counts, then in its place. If the former process was
        // killed in between, the second write is made here.
        let changed = usize::try_from(counters.changed_place).ok().and_then(|place| accounts.get_mut(place));
        if let Some(account) = changed
            && !counters.changed_account.is_vacant()
        {
            account.update(|account| *account = counters.changed_account);
        }
        let marks = HighWaterMarks::default();
        let mut expected = [false; MAX_PUBLISHERS];
        for (place, account) in accounts.iter().map(BoardWriter::get).enumerate() {
            if !account.is_vacant() {
                marks.set(place, account.writer, account.last_sequence);
                expected[place] = now.since(account.last_at) < EXPECTED_MS * 1_000_000;
            }
        }
        Self {
            accounts,
            gone: [false; MAX_PUBLISHERS],
            expected,
            marks: Arc::new(marks),
            clocks: vec![ClockOffset::default(); MAX_PUBLISHERS].into(),
            logged_clock: None,
            log_clock_at: MonotonicNs(0),
            last_place: 0,
        }
    }

    pub fn marks(&self) -> Arc<HighWaterMarks> {
        Arc::clone(&self.marks)
    }

    /// Returns the writers that have accounts, with the sequence numbers of their marks.
    pub fn last_sequences(&self) -> impl Iterator<Item = (Guid, i64)> + '_ {
        let accounts = self.accounts.iter().map(BoardWriter::get);
        accounts.filter(|account| !account.is_vacant()).map(|account| (account.writer, account.last_sequence))
    }

    /// Compares the sequence number of a sample that has arrived at `now` with the mark of its publisher, and
    /// for a new one the publisher's clock with this computer's. A new publisher gets an account. Allocates
    /// nothing.
    pub fn check(&mut self, origin: &SampleOrigin, now: MonotonicNs, now_wall: WallNs) -> SequenceCheck {
        let is_of = |place: &usize| self.accounts[*place].get().writer == origin.writer;
        let known = Some(self.last_place).filter(is_of);
        let known = known.or_else(|| self.marks.find(origin.writer).map(|(place, _)| place));
        let Some(place) = known.or_else(|| self.open_account(origin.writer, origin.sequence, now)) else {
            return SequenceCheck::Unmarked;
        };
        self.last_place = place;
        self.gone[place] = false;
        if known.is_some() && origin.sequence <= self.accounts[place].get().last_sequence {
            return SequenceCheck::Repeated(place);
        }
        self.expected[place] = false;
        let source = origin.source_timestamp.to_wall();
        let observe = |source| self.clocks[place].observe(source, now, now_wall);
        SequenceCheck::New(place, source.map_or(AgeBasis::SOURCE, observe))
    }

    /// Opens an account for a publisher without one, and returns its place.
    fn open_account(&mut self, writer: Guid, sequence: i64, now: MonotonicNs) -> Option<usize> {
        let accounts = self.accounts.iter().map(BoardWriter::get).zip(self.gone);
        let place = publisher_place(accounts, now)?;
        self.accounts[place].update(|account| *account = PublisherAccount::new(writer, sequence));
        self.clocks[place] = ClockOffset::default();
        Some(place)
    }

    /// Records the publisher whose clock is off furthest in `counters`, and logs a change.
    pub fn report_clocks(&mut self, route: &str, counters: &mut IngressCounters, now: MonotonicNs) {
        let accounts = self.accounts.iter().map(|account| account.get().writer);
        let off = accounts.zip(&self.clocks).filter_map(|(writer, clock)| {
            let is_recent = clock.last_at().is_some_and(|at| now.since(at) < CLOCK_REPORTED_MS * 1_000_000);
            Some((writer, clock.offset_ns().filter(|_| is_recent)?))
        });
        let furthest = off.max_by_key(|(_, offset_ns)| offset_ns.unsigned_abs());
        (counters.clock_writer, counters.clock_offset_ns) = furthest.unwrap_or_default();
        let writer = furthest.map(|(writer, _)| writer);
        if writer == self.logged_clock || now < self.log_clock_at {
            return;
        }
        self.logged_clock = writer;
        self.log_clock_at = now.plus_ms(CLOCK_LOG_MS);
        match furthest {
            Some((writer, offset_ns)) => warn!(
                route,
                %writer,
                offset_s = -(offset_ns as f64) / 1e9,
                "a publisher's clock disagrees with this computer's: the age of its samples runs from their \
                 arrival; synchronise the clocks (chrony, PTP)"
            ),
            None => info!(route, "the clocks of all publishers agree with this computer's"),
        }
    }

    /// Records the reliability that each publisher offers; `None` for one that discovery does not know.
    pub fn set_reliabilities(&mut self, reliability_of: impl Fn(Guid) -> Option<Reliability>) {
        for account in &mut self.accounts {
            let present = *account.get();
            if present.is_vacant() {
                continue;
            }
            let offered = match reliability_of(present.writer) {
                None => PublisherAccount::OFFER_UNKNOWN,
                Some(Reliability::BestEffort) => PublisherAccount::OFFERS_BEST_EFFORT,
                Some(Reliability::Reliable) => PublisherAccount::OFFERS_RELIABLE,
            };
            if present.offered_reliability != offered {
                account.update(|account| account.offered_reliability = offered);
            }
        }
    }

    /// How many publishers that wrote until the former process died, and are not known to be gone, have sent
    /// no sample to this process.
    pub fn expected(&self) -> u64 {
        let expected = self.expected.iter().zip(self.gone);
        expected.filter(|(is_expected, is_gone)| **is_expected && !is_gone).count() as u64
    }

    /// Changes the counts of the route and the account at `place` atomically: a process that dies meanwhile
    /// has changed both or neither.
    pub fn update<R>(
        &mut self,
        place: usize,
        counters: &mut BoardWriter<IngressCounters>,
        change: impl FnOnce(&mut IngressCounters, &mut PublisherAccount) -> R,
    ) -> R {
        let mut changed = *self.accounts[place].get();
        let result = counters.update(|counters| {
            let result = change(counters, &mut changed);
            counters.changed_place = place as u64;
            counters.changed_account = changed;
            result
        });
        self.accounts[place].update(|account| *account = changed);
        self.marks.set(place, changed.writer, changed.last_sequence);
        result
    }

    /// Records that a writer is gone. Its account stays, because the writer may return.
    pub fn writer_gone(&mut self, writer: Guid) {
        self.mark_gone(|known| known == writer, true);
    }

    /// Records whether the writers that `matches` chooses are gone.
    pub fn mark_gone(&mut self, matches: impl Fn(Guid) -> bool, is_gone: bool) {
        for (account, gone) in self.accounts.iter().zip(&mut self.gone) {
            if matches(account.get().writer) {
                *gone = is_gone;
            }
        }
    }
}

/// The highest sequence number taken of each publisher, readable without the lock of the route.
///
/// The thread that holds the route's lock writes; any thread may read meanwhile, without a lock. A read while
/// a publisher replaces another may see a mix of both, so that a lane is woken without a sample, or only when
/// the sample is published.
pub(super) struct HighWaterMarks {
    marks: [Mark; MAX_PUBLISHERS],
}

struct Mark {
    writer: [AtomicU64; 2],
    last: AtomicI64,
}

impl Default for HighWaterMarks {
    fn default() -> Self {
        let vacant = |_| Mark { writer: Default::default(), last: AtomicI64::new(i64::MAX) };
        Self { marks: std::array::from_fn(vacant) }
    }
}

impl HighWaterMarks {
    /// The place and the value of the mark of `writer`.
    pub fn find(&self, writer: Guid) -> Option<(usize, i64)> {
        let halves = halves(writer);
        let is_of = |mark: &Mark| {
            mark.writer.iter().zip(halves).all(|(word, half)| word.load(Ordering::Relaxed) == half)
        };
        let place = self.marks.iter().position(is_of)?;
        Some((place, self.marks[place].last.load(Ordering::Relaxed)))
    }

    /// Sets the mark at a place below [`MAX_PUBLISHERS`].
    pub fn set(&self, place: usize, writer: Guid, last: i64) {
        let mark = &self.marks[place];
        for (word, half) in mark.writer.iter().zip(halves(writer)) {
            word.store(half, Ordering::Relaxed);
        }
        mark.last.store(last, Ordering::Relaxed);
    }
}

fn halves(guid: Guid) -> [u64; 2] {
    let bytes = u128::from_ne_bytes(guid.0);
    [bytes as u64, (bytes >> 64) as u64]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{InstanceName, LaneName, RouteId, SampleKey, SourceTimestamp};
    use crate::shm::{BridgeShape, ShmNode};

    const ONE: Guid = Guid([1; 16]);
    const TWO: Guid = Guid([2; 16]);

    struct Fixture {
        boards: Boards,
        _node: ShmNode,
        _root: tempfile::TempDir,
    }

    impl Fixture {
        fn new(name: &str) -> Self {
            let root = tempfile::tempdir().unwrap();
            let instance = InstanceName::try_from(format!("{name}_{}", std::process::id()).as_str()).unwrap();
            let node = ShmNode::open(root.path(), &instance, "ingress").unwrap();
            let routes = vec![RouteId::try_from("scan").unwrap()];
            let boards = node.boards(&BridgeShape { lanes: vec![LaneName::critical()], routes }).unwrap();
            Self { boards, _node: node, _root: root }
        }

        fn open(&self, now: MonotonicNs) -> (BoardWriter<IngressCounters>, Publishers) {
            let counters = self.boards.ingress_writer(0);
            let publishers = Publishers::open(&self.boards, 0, counters.get(), now);
            (counters, publishers)
        }
    }

    fn at(ms: u64) -> MonotonicNs {
        MonotonicNs(0).plus_ms(ms)
    }

    fn origin(writer: Guid, sequence: i64, source_timestamp: SourceTimestamp) -> SampleOrigin {
        SampleOrigin { source_timestamp, writer, sequence, key: SampleKey::NONE }
    }

    /// Takes the sample if it is new, and returns the number of samples missing before it.
    fn take(
        (counters, publishers): &mut (BoardWriter<IngressCounters>, Publishers),
        writer: Guid,
        sequence: i64,
        now: MonotonicNs,
    ) -> Option<u64> {
        match publishers.check(&origin(writer, sequence, SourceTimestamp::NONE), now, WallNs(0)) {
            SequenceCheck::New(place, _) => {
                Some(publishers.update(place, counters, |_, account| account.take(sequence, now)))
            }
            SequenceCheck::Repeated(_) | SequenceCheck::Unmarked => None,
        }
    }

    #[test]
    fn a_successor_takes_no_sample_twice_and_counts_the_missing_ones() {
        let fixture = Fixture::new("successor");
        let mut former = fixture.open(at(0));
        assert_eq!(take(&mut former, ONE, 10, at(1)), Some(0));
        assert_eq!(take(&mut former, TWO, 500, at(1)), Some(0));
        assert_eq!(take(&mut former, ONE, 14, at(2)), Some(3));
        assert_eq!(take(&mut former, ONE, 12, at(2)), None);
        drop(former);

        let mut successor = fixture.open(at(100));
        assert!(successor.1.expected() != 0);
        assert_eq!(successor.1.last_sequences().collect::<Vec<_>>(), [(ONE, 14), (TWO, 500)]);
        let marks = successor.1.marks();
        assert_eq!([ONE, TWO].map(|writer| marks.find(writer)), [Some((0, 14)), Some((1, 500))]);
        assert_eq!(take(&mut successor, ONE, 14, at(101)), None);
        assert_eq!(take(&mut successor, ONE, 20, at(101)), Some(5));
        assert!(successor.1.expected() != 0);
        successor.1.mark_gone(|known| known.prefix() == TWO.prefix(), true);
        assert!(successor.1.expected() == 0);
        let account = fixture.boards.publisher(0, 0).unwrap();
        assert_eq!((account.first_sequence, account.last_sequence), (10, 20));
        assert_eq!((account.received, account.lost_upstream), (3, 8));
        assert_eq!(marks.find(ONE), Some((0, 20)));
    }

    #[test]
    fn a_publisher_is_expected_that_wrote_in_the_last_5_s() {
        let fixture = Fixture::new("expected");
        let mut former = fixture.open(at(0));
        assert_eq!(take(&mut former, ONE, 1, at(1)), Some(0));
        drop(former);
        for (now_ms, is_expected) in [(5_000, true), (5_001, false)] {
            assert_eq!(fixture.open(at(now_ms)).1.expected() == 0, !is_expected, "{now_ms} ms");
        }
    }

    #[test]
    fn the_account_has_the_reliability_that_its_publisher_offers() {
        let fixture = Fixture::new("offered");
        let mut route = fixture.open(at(0));
        assert_eq!(take(&mut route, ONE, 1, at(1)), Some(0));
        for (reliability, offered) in [
            (Some(Reliability::Reliable), PublisherAccount::OFFERS_RELIABLE),
            (Some(Reliability::BestEffort), PublisherAccount::OFFERS_BEST_EFFORT),
            (None, PublisherAccount::OFFER_UNKNOWN),
        ] {
            route.1.set_reliabilities(|writer| reliability.filter(|_| writer == ONE));
            assert_eq!(fixture.boards.publisher(0, 0).unwrap().offered_reliability, offered);
        }
    }

    #[test]
    fn the_second_write_of_an_account_is_made_up_for_after_a_kill() {
        let fixture = Fixture::new("completed");
        let mut former = fixture.open(at(0));
        assert_eq!(take(&mut former, ONE, 1, at(1)), Some(0));
        // The process is killed after the first of the two writes for sample 2.
        former.0.update(|counters| {
            counters.changed_account.take(2, at(2));
        });
        drop(former);
        let mut successor = fixture.open(at(100));
        assert_eq!(take(&mut successor, ONE, 2, at(101)), None);
        assert_eq!(take(&mut successor, ONE, 3, at(101)), Some(0));
        assert_eq!(fixture.boards.publisher(0, 0).unwrap().received, 3);
    }

    #[test]
    fn a_flood_of_publishers_does_not_replace_active_ones() {
        let fixture = Fixture::new("flood");
        let mut route = fixture.open(at(0));
        let flood = |number: u64| Guid((u128::from(number) + 1_000).to_ne_bytes());
        assert_eq!(take(&mut route, ONE, 1, at(0)), Some(0));
        for number in 0..1_000 {
            take(&mut route, flood(number), 1, at(number));
        }
        assert_eq!(take(&mut route, ONE, 1, at(1_000)), None, "the first publisher still has its mark");
        let unmarked = origin(flood(999), 2, SourceTimestamp::NONE);
        assert_eq!(route.1.check(&unmarked, at(1_000), WallNs(0)), SequenceCheck::Unmarked);
        // A publisher that is gone is replaced at once.
        route.1.writer_gone(flood(5));
        assert_eq!(take(&mut route, TWO, 1, at(1_000)), Some(0));
        assert_eq!(route.1.marks().find(flood(5)), None);
        assert_eq!(take(&mut route, ONE, 1, at(1_000)), None);
    }
    #[test]
    fn each_publisher_has_its_own_clock_offset() {
        let fixture = Fixture::new("clocks");
        let (mut counters, mut publishers) = fixture.open(at(0));
        let mut observe = |publishers: &mut Publishers, writer: u64, ms: u64, behind_ms: u64| {
            let wall = WallNs(1_763_000_000_000_000_000 + ms * 1_000_000);
            let source = SourceTimestamp::from_wall(WallNs(wall.0 - behind_ms * 1_000_000));
            let writer = Guid(u128::from(writer).to_ne_bytes());
            match publishers.check(&origin(writer, 1 + ms.cast_signed(), source), at(ms), wall) {
                SequenceCheck::New(place, basis) => {
                    let take = |_: &mut _, account: &mut PublisherAccount| {
                        account.take(1 + ms.cast_signed(), at(ms));
                    };
                    publishers.update(place, &mut counters, take);
                    Some(basis)
                }
                _ => None,
            }
        };
        for ms in (0..3_000).step_by(50) {
            observe(&mut publishers, 1, ms, 1);
            observe(&mut publishers, 2, ms, 5_000);
        }
        assert_eq!(observe(&mut publishers, 1, 3_000, 1), Some(AgeBasis::SOURCE));
        assert_eq!(observe(&mut publishers, 2, 3_000, 5_000), Some(AgeBasis::arrival(0)));
        assert_eq!(observe(&mut publishers, 2, 3_000, 5_000), None, "a repetition");
        let furthest = |publishers: &mut Publishers, ms| {
            let mut counters = IngressCounters::default();
            publishers.report_clocks("scan", &mut counters, at(ms));
            (counters.clock_writer, counters.clock_offset_ns)
        };
        let second = Guid(2_u128.to_ne_bytes());
        assert_eq!(furthest(&mut publishers, 3_000), (second, 5_000_000_000));
        let logged = |publishers: &Publishers| (publishers.logged_clock, publishers.log_clock_at);
        assert_eq!(logged(&publishers), (Some(second), at(33_000)));
        assert_eq!(furthest(&mut publishers, 62_999), (second, 5_000_000_000));
        assert_eq!(logged(&publishers), (Some(second), at(33_000)), "nothing has changed");
        publishers.log_clock_at = at(63_001);
        assert_eq!(furthest(&mut publishers, 63_000), (Guid::default(), 0), "silent");
        assert_eq!(logged(&publishers), (Some(second), at(63_001)), "too soon after the last line");
        assert_eq!(furthest(&mut publishers, 63_001), (Guid::default(), 0), "silent");
        assert_eq!(logged(&publishers), (None, at(93_001)));
        // A publisher that takes over an account does not inherit the offset.
        observe(&mut publishers, 2, 4_000, 5_000);
        assert_eq!(furthest(&mut publishers, 4_000), (second, 5_000_000_000));
        publishers.writer_gone(second);
        for writer in 3..100 {
            observe(&mut publishers, writer, 4_001, 5_000);
        }
        assert!(publishers.marks().find(second).is_none(), "its account was taken over");
        assert_eq!(furthest(&mut publishers, 4_001), (Guid::default(), 0));
    }

    #[test]
    fn a_mark_is_found_by_its_publisher() {
        let marks = HighWaterMarks::default();
        assert_eq!(marks.find(ONE), None, "a publisher without a mark");
        let vacant = marks.find(Guid([0; 16])).map(|(_, last)| last);
        assert_eq!(vacant, Some(i64::MAX), "no sample is above a vacant place");
        let other_entity = Guid(std::array::from_fn(|byte| if byte < 8 { 1 } else { 2 }));
        marks.set(3, ONE, 10);
        assert_eq!(marks.find(other_entity), None, "it differs in the second half");
        assert_eq!((marks.find(ONE), marks.find(TWO)), (Some((3, 10)), None));
        marks.set(3, TWO, 11);
        assert_eq!((marks.find(ONE), marks.find(TWO)), (None, Some((3, 11))));
    }
}
