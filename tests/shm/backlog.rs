//! The backlog of a route: what ingress keeps for a lane that restarts.

use std::ops::Range;
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::time::Duration;

use adaptive_bridge::shm::{
    BacklogKeeper, Boards, LoanError, PoolBudget, RouteChannel, SamplePublisher, ShmNode, read_backlog,
};

use crate::support::{Place, channel, header, payload, shape};

/// The channel, its publisher, and what keeps up to 10,000 bytes of its samples.
struct Route {
    publisher: SamplePublisher,
    keeper: BacklogKeeper,
    boards: Boards,
}

impl Route {
    fn open(node: &ShmNode, channel: &RouteChannel, budget_bytes: u64) -> Self {
        let budget = PoolBudget::of_channels(std::slice::from_ref(channel), budget_bytes);
        let publisher = SamplePublisher::create_within(node, channel, &budget, 0).unwrap();
        let boards = node.boards(&shape()).unwrap();
        let board = boards.backlog_writer(0);
        let keeper = BacklogKeeper::open(node, channel, &publisher, 10_000, board).unwrap().unwrap();
        Self { publisher, keeper, boards }
    }

    fn publish(&mut self, sequence: u64, bytes: usize) {
        let slot = self.publisher.copy_in(&payload(sequence, bytes)).unwrap();
        slot.publish(header(sequence)).unwrap();
        self.keeper.keep_published();
    }

    /// The sequence numbers of the samples that are kept, whose payloads are those that were published.
    fn kept(&self, wanted: Range<u64>) -> Vec<u64> {
        sequences(&self.boards, wanted)
    }
}

fn sequences(boards: &Boards, wanted: Range<u64>) -> Vec<u64> {
    let samples = read_backlog(boards, 0, wanted).unwrap();
    samples
        .iter()
        .map(|sample| {
            let sequence = sample.header().sequence;
            assert_eq!(sample.payload(), payload(sequence, sample.payload().len()));
            assert_eq!(*sample.header(), header(sequence));
            sequence
        })
        .collect()
}

fn backlogged(max_sample_bytes: usize) -> RouteChannel {
    RouteChannel { retained_samples: 2, backlog_samples: 50, ..channel(max_sample_bytes) }
}

#[test]
fn the_last_samples_are_kept_as_many_as_fit() {
    let place = Place::new();
    let node = place.node();
    let mut route = Route::open(&node, &backlogged(1 << 20), u64::MAX);
    assert!(route.kept(1..u64::MAX).is_empty());
    for sequence in 1..=200 {
        route.publish(sequence, 100);
    }
    // 50 samples, then 10,000 bytes.
    assert_eq!(route.kept(1..u64::MAX), (151..=200).collect::<Vec<_>>());
    assert_eq!(route.kept(140..155), [151, 152, 153, 154]);
    assert!(route.kept(1..151).is_empty() && route.kept(201..300).is_empty());
    for sequence in 201..=220 {
        route.publish(sequence, 1_000);
    }
    assert_eq!(route.kept(1..u64::MAX), (211..=220).collect::<Vec<_>>());
    route.publish(221, 9_500);
    assert_eq!(route.kept(1..u64::MAX), [221]);
    route.publish(222, 1 << 20);
    assert!(route.kept(1..u64::MAX).is_empty(), "too large");
    route.publish(223, 0);
    assert_eq!(route.kept(1..u64::MAX), [223]);
    // After a number that was not published.
    route.publish(225, 10);
    assert_eq!(route.kept(1..u64::MAX), [225]);
    drop(route.publisher);
    let boards = route.boards.clone();
    drop(route.keeper);
    assert!(read_backlog(&boards, 0, 1..u64::MAX).is_err(), "the pool is gone");
}

#[test]
fn a_route_without_a_backlog_forgets_that_of_the_former_process() {
    let place = Place::new();
    let node = place.node();
    let mut former = Route::open(&node, &backlogged(1_000), u64::MAX);
    former.publish(1, 10);
    assert_eq!(former.kept(0..10), [1]);
    let boards = former.boards.clone();
    drop(former);
    drop(node);
    let node = place.node();
    let channel = channel(1_000);
    let publisher = SamplePublisher::create(&node, &channel).unwrap();
    let keeper = BacklogKeeper::open(&node, &channel, &publisher, 10_000, boards.backlog_writer(0)).unwrap();
    assert!(keeper.is_none());
    assert!(sequences(&boards, 0..10).is_empty());
}

#[test]
fn kept_samples_are_freed_when_a_new_one_needs_their_memory() {
    let place = Place::new();
    let node = place.node();
    let channel = backlogged(1 << 20);
    let first_bytes = channel.pool_size().first_bytes;
    // Room for two samples of more than a page, which the channel retains until small ones replace them.
    let mut route = Route::open(&node, &channel, first_bytes + 2 * 4_096);
    for (sequence, bytes) in [(1, 4_500), (2, 4_500), (3, 10), (4, 10)] {
        route.publish(sequence, bytes);
    }
    let Err(refused) = route.publisher.copy_in(&[1; 4_500]) else { panic!("there was room") };
    assert!(matches!(refused, LoanError::NoMemory(_)), "{refused:?}");
    assert_eq!(route.kept(1..10), [1, 2, 3, 4]);
    assert!(route.keeper.free_all());
    route.publish(5, 4_500);
    assert_eq!(route.kept(1..10), [5]);
    route.keeper.free_all();
    assert!(!route.keeper.free_all());
    assert!(route.kept(1..10).is_empty());
}

/// The reader never takes the bytes of a later sample for an earlier one.
#[test]
fn a_backlog_is_read_while_its_slots_are_written_again() {
    let place = Place::new();
    let node = place.node();
    let mut route = Route::open(&node, &backlogged(1 << 20), u64::MAX);
    let boards = route.boards.clone();
    let (samples, published, ends) = (AtomicUsize::new(0), AtomicU64::new(0), AtomicBool::new(false));
    std::thread::scope(|scope| {
        let reader = scope.spawn(|| {
            let mut reads = 0;
            while !ends.load(Ordering::Relaxed) {
                // Of a later sample, a part of the header may have been written.
                let wanted = 1..published.load(Ordering::Acquire) + 1;
                samples.fetch_add(sequences(&boards, wanted).len(), Ordering::Relaxed);
                reads += 1;
            }
            reads
        });
        // A read that lasts longer than 50 samples returns none: on a busy machine each one did.
        let mut sequence = 0;
        while sequence < 100_000 || samples.load(Ordering::Relaxed) == 0 {
            sequence += 1;
            assert!(sequence <= 1_000_000, "no sample was read while samples were written");
            route.publish(sequence, 900 + sequence as usize % 200);
            published.store(sequence, Ordering::Release);
            if sequence.is_multiple_of(50) {
                std::thread::sleep(Duration::from_micros(100));
            }
        }
        ends.store(true, Ordering::Relaxed);
        println!("{} samples in {} reads", samples.load(Ordering::Relaxed), reader.join().unwrap());
    });
}
