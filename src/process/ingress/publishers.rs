//! The accounts of a route's publishers in shared memory: the high-water mark and counts of each.

use std::sync::Arc;

use super::writer_sequences::WriterSequences;
use crate::model::{Guid, IngressCounters, MAX_PUBLISHERS, MonotonicNs, PublisherAccount, Reliability};
use crate::policy::publisher_place;
use crate::shm::{BoardWriter, Boards};

/// A publisher whose last sample is at most this old at a restart is expected to send more.
const EXPECTED_MS: u64 = 5_000;

/// The accounts of a route's publishers. They outlive the process, so that a successor publishes no sample
/// twice.
pub(super) struct Publishers {
    accounts: Vec<BoardWriter<PublisherAccount>>,
    /// For each account, whether discovery has removed its writer.
    gone: [bool; MAX_PUBLISHERS],
    /// For each account, whether its publisher is expected to send more and has not since this process
    /// started.
    expected: [bool; MAX_PUBLISHERS],
    writer_sequences: Arc<WriterSequences>,
    /// The place of the account of the last sample, which is looked up first: most routes have one publisher.
    last_place: usize,
}

/// The result of comparing a sample's sequence number with its publisher's high-water mark.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SequenceCheck {
    /// Above the high-water mark of the account at this place.
    New(usize),
    /// At or below the mark: the sample was taken before, or is too late.
    Repeated(usize),
    /// Not comparable: the publisher has no account, and active publishers use all places.
    Unmarked,
}

impl Publishers {
    /// Opens the accounts as the predecessor of this process left them.
    pub fn open(boards: &Boards, route: usize, counters: &IngressCounters, now: MonotonicNs) -> Self {
        let writer = |place| boards.publisher_writer(route, place);
        let mut accounts: Vec<_> = (0..MAX_PUBLISHERS).map(writer).collect();
        // `update` writes an account twice: with the counts, then in its place. If the predecessor was killed
        // in between, the second write is made here.
        let changed = usize::try_from(counters.changed_place).ok().and_then(|place| accounts.get_mut(place));
        if let Some(account) = changed
            && !counters.changed_account.is_vacant()
        {
            account.update(|account| *account = counters.changed_account);
        }
        let writer_sequences = WriterSequences::default();
        let mut expected = [false; MAX_PUBLISHERS];
        for (place, account) in accounts.iter().map(BoardWriter::get).enumerate() {
            if !account.is_vacant() {
                writer_sequences.set(place, account.writer, account.last_sequence);
                expected[place] = now.since(account.last_at) < EXPECTED_MS * 1_000_000;
            }
        }
        let gone = [false; MAX_PUBLISHERS];
        Self { accounts, gone, expected, writer_sequences: Arc::new(writer_sequences), last_place: 0 }
    }

    /// The high-water marks, for other threads.
    pub fn writer_sequences(&self) -> Arc<WriterSequences> {
        Arc::clone(&self.writer_sequences)
    }

    /// Returns the writers that have accounts, with their high-water marks.
    pub fn marks(&self) -> impl Iterator<Item = (Guid, i64)> + '_ {
        let accounts = self.accounts.iter().map(BoardWriter::get);
        accounts.filter(|account| !account.is_vacant()).map(|account| (account.writer, account.last_sequence))
    }

    /// Compares the sequence number of an arrived sample with the mark of its publisher. A new publisher gets
    /// an account.
    pub fn check(&mut self, writer: Guid, sequence: i64, now: MonotonicNs) -> SequenceCheck {
        let is_of = |place: &usize| self.accounts[*place].get().writer == writer;
        let known = Some(self.last_place).filter(is_of).or_else(|| self.writer_sequences.position(writer));
        let Some(place) = known else {
            return self.open_account(writer, sequence, now);
        };
        self.last_place = place;
        self.gone[place] = false;
        if sequence > self.accounts[place].get().last_sequence {
            self.expected[place] = false;
            SequenceCheck::New(place)
        } else {
            SequenceCheck::Repeated(place)
        }
    }

    fn open_account(&mut self, writer: Guid, sequence: i64, now: MonotonicNs) -> SequenceCheck {
        let accounts = self.accounts.iter().map(BoardWriter::get).zip(self.gone);
        let Some(place) = publisher_place(accounts, now) else { return SequenceCheck::Unmarked };
        self.accounts[place].update(|account| *account = PublisherAccount::new(writer, sequence));
        self.gone[place] = false;
        self.expected[place] = false;
        self.last_place = place;
        SequenceCheck::New(place)
    }

    /// Records the reliability that each publisher offers; `reliability_of` returns `None` for one that
    /// discovery does not know.
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

    /// Whether each publisher that wrote until the predecessor of this process died has sent a sample to this
    /// process, or is gone.
    pub fn have_resumed(&self) -> bool {
        !self.expected.iter().zip(self.gone).any(|(is_expected, is_gone)| *is_expected && !is_gone)
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
        self.writer_sequences.set(place, changed.writer, changed.last_sequence);
        result
    }

    /// Notes that discovery has found the writer.
    pub fn writer_found(&mut self, writer: Guid) {
        self.mark_gone(|known| known == writer, false);
    }

    /// Notes that the writer is gone. Its account stays, because the writer may return.
    pub fn writer_gone(&mut self, writer: Guid) {
        self.mark_gone(|known| known == writer, true);
    }

    /// Notes that a participant and its writers are gone.
    pub fn participant_gone(&mut self, prefix: [u8; 12]) {
        self.mark_gone(|known| known.prefix() == prefix, true);
    }

    fn mark_gone(&mut self, matches: impl Fn(Guid) -> bool, is_gone: bool) {
        for (account, gone) in self.accounts.iter().zip(&mut self.gone) {
            if matches(account.get().writer) {
                *gone = is_gone;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{InstanceName, LaneName, RouteId};
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

    /// Takes the sample if it is new, and returns the number of samples missing before it.
    fn take(
        (counters, publishers): &mut (BoardWriter<IngressCounters>, Publishers),
        writer: Guid,
        sequence: i64,
        now: MonotonicNs,
    ) -> Option<u64> {
        match publishers.check(writer, sequence, now) {
            SequenceCheck::New(place) => {
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
        assert!(!successor.1.have_resumed());
        assert_eq!(successor.1.marks().collect::<Vec<_>>(), [(ONE, 14), (TWO, 500)]);
        assert_eq!(take(&mut successor, ONE, 14, at(101)), None);
        assert_eq!(take(&mut successor, ONE, 20, at(101)), Some(5));
        assert!(!successor.1.have_resumed());
        successor.1.participant_gone(TWO.prefix());
        assert!(successor.1.have_resumed());
        let account = fixture.boards.publisher(0, 0).unwrap();
        assert_eq!((account.first_sequence, account.last_sequence), (10, 20));
        assert_eq!((account.received, account.lost_upstream), (3, 8));
        assert!(
            successor.1.writer_sequences().is_new(ONE, 21) && !successor.1.writer_sequences().is_new(ONE, 20)
        );
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
        assert_eq!(route.1.check(flood(999), 2, at(1_000)), SequenceCheck::Unmarked);
        // A publisher that is gone is replaced at once.
        route.1.writer_gone(flood(5));
        assert_eq!(take(&mut route, TWO, 1, at(1_000)), Some(0));
        assert_eq!(route.1.writer_sequences().position(flood(5)), None);
        assert_eq!(take(&mut route, ONE, 1, at(1_000)), None);
    }
}
