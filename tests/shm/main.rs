//! The shared-memory module on real shared memory, with real processes that are killed, stopped and
//! restarted.

mod backlog;
mod child;
mod support;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::fs;
use std::os::unix::fs::{MetadataExt, PermissionsExt, symlink};
use std::process::Command;
use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::Duration;

use self::support::{
    LANE, Place, Process, channel, deep_channel, header, payload, route, shape, skip, until,
};
use adaptive_bridge::model::{InstanceName, LaneMode, LanePolicy, LatencyHistogram, MonotonicNs, RouteId};
use adaptive_bridge::shm::{
    Boards, BridgeShape, HeaderError, LoanError, NoMemory, PoolBudget, ProcessRole, QueueLimits, RoleLock,
    RouteChannel, SamplePublisher, SampleSubscriber, ShmError, ShmNode, ShmSample, Stage, SubscriberRole,
    TakeError, Woken, this_cpu,
};
use nix::sys::signal::Signal;

/// Counts the allocations of each thread.
struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: hands everything to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.with(|count| count.set(count.get() + 1));
        // SAFETY: the caller's promise.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's promise.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn allocations() -> u64 {
    ALLOCATIONS.with(Cell::get)
}

/// Not a test of its own: what the children of the others run.
#[test]
fn child_entry() {
    if let Some((what, child)) = child::Child::from_environment() {
        child.run(&what);
    }
}

fn lane(node: &ShmNode, channel: &RouteChannel) -> SampleSubscriber {
    SampleSubscriber::open(node, channel, SubscriberRole::Lane(channel.lanes[0]), false).unwrap()
}

fn publish(publisher: &SamplePublisher, sequence: u64, length: usize) -> usize {
    publisher.copy_in(&payload(sequence, length)).unwrap().publish(header(sequence)).unwrap()
}

fn sequences(subscriber: &SampleSubscriber) -> Vec<u64> {
    std::iter::from_fn(|| subscriber.take().unwrap()).map(|sample| sample.header().sequence).collect()
}

#[test]
fn samples_of_every_size_arrive_as_they_were_sent() {
    let place = Place::new();
    let node = place.node();
    let channel = channel(100_000);
    let publisher = SamplePublisher::create(&node, &channel).unwrap();
    let lane = lane(&node, &channel);
    let tap = SampleSubscriber::open(&node, &channel, SubscriberRole::Tap, false).unwrap();
    for (sequence, length) in [(1, 0), (2, 1), (3, 7), (4, 2_948), (5, 99_999), (6, 100_000), (7, 0)] {
        assert_eq!(publish(&publisher, sequence, length), 2);
        for subscriber in [&lane, &tap] {
            let sample = subscriber.take().unwrap().unwrap();
            assert_eq!(*sample.header(), header(sequence));
            assert_eq!(sample.payload(), payload(sequence, length));
            assert_eq!(sample.as_ref().len(), length);
            assert!(subscriber.take().unwrap().is_none());
        }
    }
    let too_large = publisher.copy_in(&vec![0; 100_001]).unwrap_err();
    assert_eq!(too_large, LoanError::TooLarge { len: 100_001, max: 100_000 });
    assert_eq!(publish(&publisher, 8, 10), 2);
    assert_eq!(sequences(&lane), [8]);
}

#[test]
fn a_slot_that_is_not_published_is_free_again() {
    let place = Place::new();
    let node = place.node();
    let publisher = SamplePublisher::create(&node, &channel(64)).unwrap();
    for _ in 0..10_000 {
        drop(publisher.copy_in(&[1; 64]).unwrap());
    }
    assert_eq!(publish(&publisher, 1, 64), 0, "no subscriber has joined");
}

#[test]
fn the_pool_has_the_computed_size_and_its_headers_or_small_slots_are_allocated() {
    for (bytes, retained_samples, max_taps) in [(2_948, 0, 0), (100, 3, 2), (1 << 20, 1, 1), (16 << 20, 0, 2)]
    {
        let place = Place::new();
        let node = place.node();
        let channel = RouteChannel { max_taps, retained_samples, ..channel(bytes) };
        let pool = channel.pool_size();
        let before = place.shm_files();
        let _publisher = SamplePublisher::create(&node, &channel).unwrap();
        let pools: Vec<_> = place
            .shm_files()
            .into_iter()
            .filter(|path| !before.contains(path) && path.to_string_lossy().ends_with(".data"))
            .collect();
        assert_eq!(pools.len(), 1);
        let metadata = fs::metadata(&pools[0]).unwrap();
        println!("{channel:?}: {pool:?}, {} bytes, {} blocks", metadata.len(), metadata.blocks());
        assert_eq!(metadata.len().next_multiple_of(4096), pool.bytes);
        for path in place.shm_files() {
            let metadata = fs::metadata(&path).unwrap();
            let least = if path == pools[0] { pool.first_bytes - 4096 } else { metadata.len() };
            assert!(metadata.blocks() * 512 >= least, "{path:?} lacks pages");
        }
        assert!(metadata.blocks() * 512 <= pool.first_bytes + 2 * 4096, "{metadata:?}");
        assert_eq!(pool.first_bytes == pool.bytes, bytes < 4_000, "small slots are allocated completely");
    }
}

/// The bytes of the instance's files in /dev/shm that exist.
fn allocated_bytes(place: &Place) -> u64 {
    place.shm_files().iter().map(|path| fs::metadata(path).unwrap().blocks() * 512).sum()
}

/// A channel of a configured route with the default lanes and two taps.
fn routed(route: &str) -> RouteChannel {
    RouteChannel {
        route: RouteId::try_from(route).unwrap(),
        lanes: vec![QueueLimits { queue_depth: 32, max_borrowed: 8 }; 3],
        retained_samples: 8,
        backlog_samples: 0,
        ..channel(16 << 20)
    }
}

fn no_memory(publisher: &SamplePublisher, length: usize) -> NoMemory {
    match publisher.copy_in(&vec![1; length]) {
        Err(LoanError::NoMemory(why)) => why,
        other => panic!("{other:?}"),
    }
}

#[test]
fn sixty_routes_of_scans_take_at_most_48_mib() {
    // By default each retains and keeps so many if its samples may have 16 MiB, or 64 KiB.
    sixty_scans(8, 136, 16 << 20);
    sixty_scans(136, 0, 64 << 10);
}

fn sixty_scans(retained_samples: usize, backlog_samples: usize, max_sample_bytes: usize) {
    let place = Place::new();
    let node = place.node();
    let limits = |route| RouteChannel { retained_samples, backlog_samples, max_sample_bytes, ..route };
    let channels: Vec<_> = (0..60).map(|number| limits(routed(&format!("scan{number}")))).collect();
    let budget = PoolBudget::of_channels(&channels, 256 << 20);
    let routes: Vec<_> = (0..)
        .zip(&channels)
        .map(|(number, channel)| {
            let publisher = SamplePublisher::create_within(&node, channel, &budget, number).unwrap();
            (publisher, channel.lanes.iter().map(|_| lane(&node, channel)).collect::<Vec<_>>())
        })
        .collect();
    for sequence in 1..=200 {
        for (publisher, lanes) in &routes {
            assert_eq!(publish(publisher, sequence, 2_948), 3);
            for lane in lanes {
                let sample = lane.take().unwrap().unwrap();
                assert_eq!(sample.payload(), payload(sequence, 2_948));
            }
        }
    }
    let bytes = allocated_bytes(&place);
    println!("60 routes of scans that retain {retained_samples}: {} KiB", bytes >> 10);
    assert!(bytes <= 48 << 20, "{bytes}");
}

#[test]
fn cameras_and_clouds_beside_sixty_scans_lose_nothing_within_512_mib() {
    let place = Place::new();
    let node = place.node();
    let channels: Vec<_> = (0..66).map(|number| routed(&format!("route{number}"))).collect();
    let budget = PoolBudget::of_channels(&channels, 512 << 20);
    let routes: Vec<_> = (0..)
        .zip(&channels)
        .map(|(number, channel)| {
            let publisher = SamplePublisher::create_within(&node, channel, &budget, number).unwrap();
            (publisher, [lane(&node, channel), lane(&node, channel)])
        })
        .collect();
    let bytes_of = |route| match route {
        0..60 => 2_948,
        60..64 => 6_220_800,
        _ => 2_000_000,
    };
    // Two seconds: cameras at 30 Hz, scans and clouds at 10 Hz. The first lane takes each sample at once and
    // holds the last one; the second one takes what has come every 100 ms.
    let mut held: Vec<Option<ShmSample>> = routes.iter().map(|_| None).collect();
    let mut grown = 0;
    for frame in 1..=60_u64 {
        for (route, (publisher, lanes)) in routes.iter().enumerate() {
            if (60..64).contains(&route) || frame % 3 == 1 {
                let mut slot = publisher.lend(bytes_of(route)).unwrap();
                slot.payload_mut().fill(frame as u8);
                assert_eq!(slot.into_slot().publish(header(frame)).unwrap(), 2);
                held[route] = lanes[0].take().unwrap();
            }
            if frame % 3 == 0 {
                while let Some(sample) = lanes[1].take().unwrap() {
                    let bytes = sample.payload();
                    let middle = bytes.len() / 2;
                    assert_eq!(bytes.len(), bytes_of(route));
                    for at in [0, middle, bytes.len() - 1] {
                        assert_eq!(bytes[at], sample.header().sequence as u8);
                    }
                }
            }
        }
        if frame == 30 {
            grown = budget.usage(0).budget_used_bytes;
        }
    }
    let usage = budget.usage(0);
    println!("{usage:?}, allocated {} MiB", allocated_bytes(&place) >> 20);
    assert_eq!(
        usage.budget_used_bytes, grown,
        "the pools of a steady flow do not grow after the first second"
    );
    assert!(allocated_bytes(&place) <= 512 << 20);
}

#[test]
fn a_stopped_lane_of_a_camera_pins_at_most_its_quota_and_no_other_route_suffers() {
    let place = Place::new();
    let node = place.node();
    let channels: Vec<_> = (0..8).map(|number| routed(&format!("route{number}"))).collect();
    let budget = PoolBudget::of_channels(&channels, 256 << 20);
    let create = |number| SamplePublisher::create_within(&node, &channels[number], &budget, number).unwrap();
    let (camera, scan) = (create(0), create(1));
    let stopped = lane(&node, &channels[0]);
    let image = 6_220_800;
    let mut published = 0;
    while let Ok(slot) = camera.copy_in(&vec![7; image]) {
        published += 1;
        slot.publish(header(published)).unwrap();
    }
    assert_eq!(no_memory(&camera, image), NoMemory::Quota);
    let usage = budget.usage(0);
    // Half of what the start leaves: 21 images, more than the 12 of a steady flow.
    assert!((114 << 20..=128 << 20).contains(&usage.used_bytes), "{usage:?}");
    assert_eq!(published, 21);
    assert_eq!(usage.peak_bytes, usage.used_bytes);
    for sequence in 1..=200 {
        assert_eq!(publish(&scan, sequence, 2_948), 0);
    }
    // A smaller sample still finds a slot that has the memory, or takes it.
    drop(camera.copy_in(&[1; 2_948]).unwrap());
    // The lane continues, and has what was published before.
    assert_eq!(sequences(&stopped), (1..=published).collect::<Vec<_>>());
    for sequence in published + 1..published + 100 {
        camera.copy_in(&vec![7; image]).unwrap().publish(header(sequence)).unwrap();
        assert_eq!(sequences(&stopped), [sequence]);
    }
    assert_eq!(budget.usage(0).used_bytes, usage.used_bytes, "slots that are free are used again");
}

#[test]
fn the_memory_of_idle_slots_goes_back_to_the_budget_and_that_of_a_steady_flow_stays() {
    let at = |ms| MonotonicNs(1_000_000_000).plus_ms(ms);
    let place = Place::new();
    let node = place.node();
    let channels = [0, 1].map(|number| RouteChannel { retained_samples: 1, ..routed(&format!("r{number}")) });
    let budget = PoolBudget::of_channels(&channels, 256 << 20);
    let create = |number| SamplePublisher::create_within(&node, &channels[number], &budget, number).unwrap();
    let (first, second) = (create(0), create(1));
    let (lane_of_first, image) = (lane(&node, &channels[0]), 6_220_800);
    // A burst that a lane had not taken, and then a flow of one image at a time, which uses a few slots.
    assert_eq!(first.give_back_idle(at(0)), 0);
    for sequence in 1..=15 {
        assert_eq!(publish(&first, sequence, image), 1);
    }
    assert_eq!(sequences(&lane_of_first), (1..=15).collect::<Vec<_>>());
    let flow = |from_ms: u64, to_ms: u64| {
        let mut given_back = 0;
        for ms in (from_ms..to_ms).step_by(100) {
            for _ in 0..3 {
                publish(&first, 15 + ms, image);
                assert_eq!(sequences(&lane_of_first), [15 + ms]);
            }
            given_back += first.give_back_idle(at(ms));
        }
        given_back
    };
    assert_eq!(flow(100, 11_000), 0, "a minute has not passed, and no route is short");
    let (before, allocated) = (budget.usage(0), allocated_bytes(&place));
    // The other route needs more than is left, and goes on to need it.
    let stopped = lane(&node, &channels[1]);
    let images = Cell::new(0);
    let fill = || {
        while let Ok(slot) = second.copy_in(&payload(images.get() + 1, image)) {
            images.set(images.get() + 1);
            slot.publish(header(images.get())).unwrap();
        }
    };
    fill();
    let began_at = std::time::Instant::now();
    let first_step = first.give_back_idle(at(11_000));
    println!("{first_step} bytes given back in {} µs", began_at.elapsed().as_micros());
    assert_eq!(first_step, 2 << 20, "not all at once");
    let mut given_back = first_step;
    for ms in (11_100..17_000).step_by(100) {
        fill();
        given_back += flow(ms, ms + 100);
    }
    let after = budget.usage(0);
    assert_eq!(before.used_bytes - after.used_bytes, given_back);
    // Of 15 images, the flow needs three slots at most.
    assert!(given_back >= 12 * (image as u64), "{given_back}");
    let of_second = budget.usage(1).used_bytes - channels[1].pool_size().first_bytes;
    assert!(allocated_bytes(&place) + given_back <= allocated + of_second + (1 << 20));
    assert_eq!(flow(17_100, 19_000), 0, "what a steady flow uses stays");
    assert_eq!(budget.usage(0).used_bytes, after.used_bytes);
    // What was published meanwhile is unchanged.
    for sequence in 1..=images.get() {
        let sample = stopped.take().unwrap().unwrap();
        assert_eq!(
            (sample.header().sequence, sample.payload() == payload(sequence, image)),
            (sequence, true)
        );
    }
    // After a minute without a sample all of it goes back, but for the retained one.
    let rest: u64 = (0..100).map(|step| first.give_back_idle(at(80_000 + 1_000 * step))).sum();
    assert!(rest > 0);
    let left = budget.usage(0).used_bytes - channels[0].pool_size().first_bytes;
    assert!((image as u64..8 << 20).contains(&left), "{left}");
    publish(&first, 1_000_000, image);
    assert_eq!(lane_of_first.take().unwrap().unwrap().payload(), payload(1_000_000, image));
}

#[test]
fn a_sample_gets_a_slot_that_has_the_memory_although_another_one_is_the_first_free_one() {
    let place = Place::new();
    let node = place.node();
    let channel = RouteChannel { retained_samples: 0, ..routed("camera") };
    let image = 6_220_800;
    // Room for one image, and not for a second one.
    let bytes = channel.pool_size().first_bytes + (10 << 20);
    let budget = PoolBudget::of_channels(std::slice::from_ref(&channel), bytes);
    let camera = SamplePublisher::create_within(&node, &channel, &budget, 0).unwrap();
    let large = camera.copy_in(&vec![7; image]).unwrap();
    assert_eq!(no_memory(&camera, image), NoMemory::Budget);
    // Freed after the large one, so that they are before it among the free ones.
    let small = [(); 2].map(|()| camera.copy_in(&[1; 100]).unwrap());
    drop(large);
    drop(small);
    let used = budget.usage(0).used_bytes;
    let lane = lane(&node, &channel);
    for sequence in 1..=20 {
        assert_eq!(publish(&camera, sequence, image), 1);
        assert_eq!(sequences(&lane), [sequence]);
    }
    assert_eq!(camera.lend(image).unwrap().payload_mut().len(), image);
    assert_eq!(budget.usage(0).used_bytes, used);
    // What was tried is free again: there are fewer slots than tries.
    let _large = camera.copy_in(&vec![7; image]).unwrap();
    for _ in 0..100 {
        assert_eq!(no_memory(&camera, image), NoMemory::Budget);
    }
    drop(camera.copy_in(&[1; 100]).unwrap());
}

#[test]
fn pools_that_do_not_fit_the_budget_at_the_start_are_an_error_that_names_the_key() {
    let place = Place::new();
    let budget = PoolBudget::of_channels(&[channel(1 << 20)], 4096);
    let error = SamplePublisher::create_within(&place.node(), &channel(1 << 20), &budget, 0).unwrap_err();
    assert!(matches!(error, ShmError::BudgetTooSmall { budget_bytes: 4096, .. }), "{error}");
    assert!(error.to_string().contains("shared_memory.budget_bytes"), "{error}");
}

#[test]
fn a_payload_written_into_a_lent_slot_arrives_beside_copied_ones() {
    let place = Place::new();
    let node = place.node();
    let channel = channel(1_000);
    let publisher = SamplePublisher::create(&node, &channel).unwrap();
    let lane = lane(&node, &channel);
    assert!(publisher.lend(1_001).is_none(), "a sample longer than the route allows gets no slot");
    let mut first = publisher.lend(1_000).unwrap();
    let mut second = publisher.lend(10).unwrap();
    assert!(publisher.lend(10).is_none(), "a publisher lends at most two slots at a time");
    for sequence in 1..=50 {
        publish(&publisher, sequence, 1_000);
        assert_eq!(sequences(&lane), [sequence]);
    }
    first.payload_mut().copy_from_slice(&payload(51, 1_000));
    second.payload_mut().copy_from_slice(&payload(52, 10));
    let first = std::thread::spawn(move || first).join().unwrap();
    for (slot, sequence, length) in [(first, 51, 1_000), (second, 52, 10)] {
        assert_eq!(slot.into_slot().publish(header(sequence)).unwrap(), 1);
        let sample = lane.take().unwrap().unwrap();
        assert_eq!((*sample.header(), sample.payload()), (header(sequence), &payload(sequence, length)[..]));
    }
    // What is dropped, or outlives its publisher, is free again.
    for _ in 0..100 {
        drop(publisher.lend(1_000).unwrap());
    }
    let orphan = publisher.lend(1_000).unwrap();
    drop((publisher, lane, node));
    drop(orphan);
    SamplePublisher::create(&place.node(), &channel).unwrap();
}

#[test]
fn the_pool_suffices_when_each_subscriber_holds_its_maximum() {
    // The deepest queue is that of a lane, or all are as deep as the samples that are retained.
    pool_suffices(2, 5);
    pool_suffices(12, 12);
}

/// Each subscriber borrows other samples than the others and has a full queue. The deepest has room for
/// `deepest` samples.
fn pool_suffices(retained_samples: usize, deepest: usize) {
    let place = Place::new();
    let node = place.node();
    let shares =
        [QueueLimits { queue_depth: 5, max_borrowed: 3 }, QueueLimits { queue_depth: 2, max_borrowed: 7 }];
    let channel = RouteChannel { lanes: shares.to_vec(), max_taps: 1, retained_samples, ..channel(1_000) };
    assert_eq!(channel.pool_size().slots, deepest + 3 + 7 + 2 + 3);
    let publisher = SamplePublisher::create(&node, &channel).unwrap();
    let subscribers = [
        SampleSubscriber::open(&node, &channel, SubscriberRole::Lane(shares[0]), false).unwrap(),
        SampleSubscriber::open(&node, &channel, SubscriberRole::Lane(shares[1]), false).unwrap(),
        SampleSubscriber::open(&node, &channel, SubscriberRole::Tap, false).unwrap(),
    ];
    let mut held: Vec<ShmSample> = Vec::new();
    let mut sequence = 0;
    for subscriber in &subscribers {
        for _ in 0..subscriber.max_borrowed() {
            sequence += 1;
            publish(&publisher, sequence, 1_000);
            // The others' queues overflow meanwhile, so what is borrowed differs from one to the other.
            held.push(subscriber.take().unwrap().unwrap());
        }
        assert_eq!(subscriber.take().unwrap_err(), TakeError::BorrowLimit);
    }
    for _ in 0..100 {
        sequence += 1;
        publish(&publisher, sequence, 1_000);
    }
    let lent: Vec<_> = (0..2).map(|_| publisher.lend(1_000).unwrap()).collect();
    assert!(publisher.lend(1_000).is_none());
    let copy = publisher.copy_in(&[0; 1_000]).unwrap();
    assert!(publisher.copy_in(&[0; 1_000]).is_err());
    drop((lent, copy));
    drop(held);
    for (subscriber, depth) in subscribers.iter().zip([5, 2, 4]) {
        let depth = depth.max(retained_samples as u64);
        assert_eq!(sequences(subscriber), (sequence - depth + 1..=sequence).collect::<Vec<_>>());
    }
}

#[test]
fn the_borrow_limit_loses_no_sample_and_any_thread_may_return_one() {
    let place = Place::new();
    let node = place.node();
    let channel = channel(100);
    let publisher = SamplePublisher::create(&node, &channel).unwrap();
    let lane = lane(&node, &channel);
    for sequence in 1..=20 {
        publish(&publisher, sequence, 100);
    }
    let mut held: Vec<_> = (0..8).map(|_| lane.take().unwrap().unwrap()).collect();
    assert_eq!((lane.borrowed(), lane.max_borrowed()), (8, 8));
    assert_eq!(lane.take().unwrap_err(), TakeError::BorrowLimit);
    assert_eq!(lane.borrowed(), 8);
    let one = held.remove(3);
    std::thread::spawn(move || drop(one)).join().unwrap();
    assert_eq!(lane.borrowed(), 7);
    let ninth = lane.take().unwrap().unwrap();
    assert_eq!(ninth.header().sequence, 9);
    // What `Bytes::from_owner` requires.
    let bytes = bytes::Bytes::from_owner(ninth);
    assert_eq!(bytes, payload(9, 100));
    assert_eq!(lane.borrowed(), 8);
    drop((bytes, held));
    assert_eq!(lane.borrowed(), 0);
    assert_eq!(sequences(&lane), (10..=20).collect::<Vec<_>>());
}

#[test]
fn a_full_queue_discards_its_oldest_sample() {
    let place = Place::new();
    let node = place.node();
    let channel = channel(100);
    let publisher = SamplePublisher::create(&node, &channel).unwrap();
    let lane = lane(&node, &channel);
    for sequence in 1..=1_000 {
        assert_eq!(publish(&publisher, sequence, 100), 1);
    }
    assert_eq!(sequences(&lane), (1_000 - 63..=1_000).collect::<Vec<_>>());
}

#[test]
fn publisher_and_subscribers_may_start_in_any_order() {
    let place = Place::new();
    let channel = channel(100);
    let (lane_node, tap_node) = (place.node(), place.node());
    let early = lane(&lane_node, &channel);
    let publisher = SamplePublisher::create(&place.node(), &channel).unwrap();
    publish(&publisher, 1, 100);
    let late = SampleSubscriber::open(&tap_node, &channel, SubscriberRole::Tap, false).unwrap();
    publish(&publisher, 2, 100);
    assert_eq!(sequences(&early), [1, 2]);
    assert_eq!(sequences(&late), [2]);
    drop(publisher);
    let publisher = SamplePublisher::create(&place.node(), &channel).unwrap();
    publish(&publisher, 3, 100);
    assert_eq!(sequences(&early), [3]);
    assert_eq!(sequences(&late), [3]);
    drop((publisher, early, late, lane_node, tap_node));
    place.assert_nothing_left();
}

#[test]
fn a_borrowed_sample_outlives_publisher_and_subscriber() {
    let place = Place::new();
    let channel = channel(100);
    let (one, other) = (place.node(), place.node());
    let publisher = SamplePublisher::create(&one, &channel).unwrap();
    let lane = lane(&other, &channel);
    publish(&publisher, 1, 100);
    publish(&publisher, 2, 100);
    let first = lane.take().unwrap().unwrap();
    drop((publisher, one));
    let second = lane.take().unwrap().unwrap();
    drop((lane, other));
    assert_eq!(first.payload(), payload(1, 100));
    assert_eq!(second.payload(), payload(2, 100));
    assert!(!place.root_files().is_empty(), "a borrowed sample keeps its subscriber's files");
    drop((first, second));
    place.assert_nothing_left();
}

#[test]
fn a_lane_outlives_more_publishers_than_it_holds_samples_of() {
    let place = Place::new();
    let channel = channel(100);
    let node = place.node();
    let lane = lane(&node, &channel);
    let mut held = Vec::new();
    for sequence in 1..=300 {
        let publisher = SamplePublisher::create(&place.node(), &channel).unwrap();
        publish(&publisher, sequence, 100);
        let sample = lane.take().unwrap().unwrap();
        assert_eq!(sample.header().sequence, sequence);
        if sequence % 40 == 0 {
            held.push(sample);
        }
    }
    for sample in held {
        assert_eq!(sample.payload(), payload(sample.header().sequence, 100));
    }
}

#[test]
fn subscribers_that_request_retained_samples_receive_them_without_a_new_one() {
    let place = Place::new();
    let node = place.node();
    let shallow = QueueLimits { queue_depth: 1, max_borrowed: 2 };
    let channel = RouteChannel { lanes: vec![shallow; 2], retained_samples: 3, ..channel(100) };
    let publisher = SamplePublisher::create(&node, &channel).unwrap();
    for sequence in 1..=10 {
        publish(&publisher, sequence, 100);
    }
    let requesting = SampleSubscriber::open(&node, &channel, SubscriberRole::Lane(shallow), true).unwrap();
    let does_not = SampleSubscriber::open(&node, &channel, SubscriberRole::Lane(shallow), false).unwrap();
    assert_eq!(sequences(&requesting), [0u64; 0]);
    publisher.connect_subscribers();
    assert_eq!(sequences(&requesting), [8, 9, 10]);
    assert_eq!(sequences(&does_not), [0u64; 0]);
    publish(&publisher, 11, 100);
    assert_eq!(sequences(&requesting), [11]);
    assert_eq!(sequences(&does_not), [11]);
}

#[test]
fn an_invalid_header_is_an_error_and_the_next_sample_is_received() {
    let place = Place::new();
    let node = place.node();
    let channel = channel(100);
    let publisher = SamplePublisher::create(&node, &channel).unwrap();
    let lane = lane(&node, &channel);
    publisher.copy_in(&[1]).unwrap().publish(header(0)).unwrap();
    publish(&publisher, 2, 100);
    assert_eq!(lane.take().unwrap_err(), TakeError::Malformed(HeaderError::SequenceZero));
    assert_eq!(lane.borrowed(), 0);
    assert_eq!(sequences(&lane), [2]);
}

#[test]
fn a_sample_costs_no_allocation() {
    // In a process of its own: what a loan needs is kept for the whole process, and other tests loan too.
    let place = Place::new();
    let child = Process::start("allocations", &place, "");
    child.expect("steady 0, overflowing 0, control 1");
    child.finish();
}

#[test]
fn other_users_cannot_read_shared_memory() {
    let place = Place::new();
    let node = place.node();
    let channel = RouteChannel { retained_samples: 1, ..channel(100) };
    let _role = RoleLock::acquire(place.root(), &place.instance, "ingress").unwrap();
    let boards = node.boards(&shape()).unwrap();
    boards.policies().unwrap().set(0, MonotonicNs(1), |policy| policy);
    let publisher = SamplePublisher::create(&node, &channel).unwrap();
    let _lane = lane(&node, &channel);
    let _tap = SampleSubscriber::open(&node, &channel, SubscriberRole::Tap, true).unwrap();
    publish(&publisher, 1, 100);
    let files = place.shm_files();
    assert!(files.len() >= 5, "{files:?}");
    let instance = fs::symlink_metadata(place.root().join("test")).unwrap();
    assert_eq!(instance.permissions().mode() & 0o7777, 0o700);
    for path in files.into_iter().chain(place.root_files()) {
        let metadata = fs::symlink_metadata(&path).unwrap();
        // iceoryx2 creates the deeper folders; the mode 0700 of the instance's folder protects them.
        if !metadata.is_dir() || path.parent() == Some(&place.root().join("test")) {
            assert_eq!(metadata.permissions().mode() & 0o077, 0, "{path:?}");
        }
    }
}

#[test]
fn the_last_process_that_ends_leaves_no_files() {
    let place = Place::new();
    let role = RoleLock::acquire(place.root(), &place.instance, "ingress").unwrap();
    let (first, second) = (place.node(), place.node());
    let channel = channel(100);
    let publisher = SamplePublisher::create(&first, &channel).unwrap();
    let boards = first.boards(&shape()).unwrap();
    boards.ingress_writer(0).update(|counters| counters.published = 5);
    drop((publisher, boards, first));
    assert_eq!(second.boards(&shape()).unwrap().ingress(0).unwrap().published, 5);
    drop(second);
    assert_eq!(place.shm_files().len(), 0);
    assert_eq!(place.root_files().len(), 2, "the role is still held: {:?}", place.root_files());
    drop(role);
    place.assert_nothing_left();
    assert!(Boards::find(place.root(), &place.instance, &shape()).unwrap().is_none());
}

#[test]
fn instances_and_roots_are_separate() {
    let (here, mut there) = (Place::new(), Place::new());
    let channel = channel(100);
    let other_name = InstanceName::try_from("other").unwrap();
    let nodes = [here.node(), there.node(), ShmNode::open(here.root(), &other_name, "test").unwrap()];
    let ends = nodes.each_ref().map(|node| {
        (
            SamplePublisher::create(node, &channel).unwrap(),
            lane(node, &channel),
            node.boards(&shape()).unwrap(),
        )
    });
    let _roles = [
        RoleLock::acquire(here.root(), &here.instance, "ingress").unwrap(),
        RoleLock::acquire(there.root(), &there.instance, "ingress").unwrap(),
        RoleLock::acquire(here.root(), &other_name, "ingress").unwrap(),
    ];
    for (number, (publisher, _, boards)) in (1..).zip(&ends) {
        assert_eq!(publish(publisher, number, 100), 1);
        boards.ingress_writer(0).update(|counters| counters.published = number);
    }
    for (number, (_, lane, boards)) in (1..).zip(&ends) {
        assert_eq!(sequences(lane), [number]);
        assert_eq!(boards.ingress(0).unwrap().published, number);
    }
    // An instance that ends removes its files and none of the others'.
    let [first, second, third] = ends;
    let [first_node, second_node, third_node] = nodes;
    drop((first, first_node));
    assert_eq!(here.shm_files().len(), 0);
    for (publisher, lane, _) in [&second, &third] {
        assert_eq!(publish(publisher, 9, 100), 1);
        assert_eq!(sequences(lane), [9]);
    }
    drop((second, second_node, third, third_node));
    there.instance = other_name;
    assert_eq!(there.shm_files().len(), 0);
}

#[test]
fn processes_with_different_sizes_do_not_share_a_channel() {
    let place = Place::new();
    let node = place.node();
    let _lane = lane(&node, &channel(100));
    for other in [
        channel(101),
        RouteChannel { retained_samples: 1, ..channel(100) },
        RouteChannel { lanes: vec![LANE], ..channel(100) },
        RouteChannel { max_taps: 1, ..channel(100) },
    ] {
        let error = SamplePublisher::create(&node, &other).unwrap_err();
        assert!(matches!(error, ShmError::Incompatible { .. }), "{error}");
        assert!(error.to_string().contains("stop all processes"), "{error}");
    }
    let _boards = node.boards(&shape()).unwrap();
    let other = RouteId::try_from("other").unwrap();
    for routes in [vec![route(), other.clone()], vec![other]] {
        let error = node.boards(&BridgeShape { routes, ..shape() }).unwrap_err();
        assert!(matches!(error, ShmError::Incompatible { .. }), "{error}");
    }
}

#[test]
fn taps_beyond_the_limit_are_refused_and_leave_the_lanes_their_places() {
    let place = Place::new();
    let node = place.node();
    let channel = channel(100);
    let open = || SampleSubscriber::open(&node, &channel, SubscriberRole::Tap, false);
    let mut taps = vec![open().unwrap(), open().unwrap()];
    let error = open().unwrap_err();
    assert!(matches!(error, ShmError::TooManySubscribers { max: 2, .. }), "{error}");
    assert!(error.to_string().contains("scan") && error.to_string().contains("max_taps"), "{error}");
    let lanes = [lane(&node, &channel), lane(&node, &channel)];
    taps.pop();
    taps.push(open().unwrap());
    taps.pop();
    drop((taps, lanes));
    let open = || SampleSubscriber::open(&node, &deep_channel(100), SubscriberRole::Tap, false);
    let mut others = [0, 1].map(|_| Process::start("tap", &place, "100"));
    others.iter().for_each(|other| other.expect("ready"));
    assert!(open().is_err());
    others[1].kill();
    open().unwrap();
}

#[test]
fn a_folder_that_others_could_tamper_with_is_refused() {
    let place = Place::new();
    let open = |root: &std::path::Path| ShmNode::open(root, &place.instance, "test").map(drop);
    let root = place.root().join("root");

    fs::create_dir(&root).unwrap();
    fs::set_permissions(&root, fs::Permissions::from_mode(0o777)).unwrap();
    let error = open(&root).unwrap_err();
    assert!(matches!(error, ShmError::RootNotOurs { .. }), "{error}");
    assert!(error.to_string().contains("other users may write"), "{error}");
    fs::set_permissions(&root, fs::Permissions::from_mode(0o755)).unwrap();
    open(&root).unwrap();

    let link = place.root().join("link");
    symlink(&root, &link).unwrap();
    assert!(matches!(open(&link).unwrap_err(), ShmError::RootNotOurs { .. }));
    assert!(matches!(open("relative".as_ref()).unwrap_err(), ShmError::RootNotOurs { .. }));
    let file = place.root().join("file");
    fs::write(&file, "").unwrap();
    assert!(matches!(open(&file).unwrap_err(), ShmError::RootNotOurs { .. }));
    let below_file = open(&file.join("below")).unwrap_err();
    assert!(matches!(below_file, ShmError::CannotCreateRoot { .. }), "{below_file}");

    let long = place.root().join("a".repeat(120));
    let error = open(&long).unwrap_err();
    assert!(matches!(error, ShmError::PathTooLong { .. }), "{error}");
    let ShmError::PathTooLong { max, .. } = error else { unreachable!() };
    let fits = max - place.root().as_os_str().len() - "/".len() - "/test".len();
    let longest = place.root().join("b".repeat(fits));
    let node = ShmNode::open(&longest, &place.instance, "test").unwrap();
    let channel = channel(100);
    let publisher = SamplePublisher::create(&node, &channel).unwrap();
    let lane = lane(&node, &channel);
    publish(&publisher, 1, 100);
    assert_eq!(sequences(&lane), [1]);
    assert!(matches!(open(&place.root().join("b".repeat(fits + 1))), Err(ShmError::PathTooLong { .. })));

    if nix::unistd::geteuid().is_root() {
        std::os::unix::fs::chown(&root, Some(12_345), None).unwrap();
        let error = open(&root).unwrap_err();
        assert!(error.to_string().contains("belongs to user 12345"), "{error}");
    } else {
        skip("a folder of another user: needs root");
    }
}

#[test]
fn a_configuration_file_in_the_working_folder_changes_nothing() {
    let place = Place::new();
    let elsewhere = tempfile::tempdir().unwrap();
    let foreign = "[global]\nroot-path = \"/nonexistent\"\nprefix = \"foreign_\"\n";
    fs::write(elsewhere.path().join("iceoryx2.toml"), foreign).unwrap();
    fs::create_dir(elsewhere.path().join("config")).unwrap();
    fs::write(elsewhere.path().join("config/iceoryx2.toml"), foreign).unwrap();
    let mut command = Command::new(std::env::current_exe().unwrap());
    command.current_dir(elsewhere.path());
    let mut child = Process::start_with(command, "open", &place, "");
    child.expect("ready");
    assert!(place.shm_files().iter().any(|path| path.to_string_lossy().ends_with(".data")));
    child.kill();
    let node = place.node();
    assert!(node.cleaned_up().stray_files > 0, "{:?}", node.cleaned_up());
    drop(node);
    place.assert_nothing_left();
}

#[test]
fn a_role_is_held_by_one_process_at_a_time() {
    let place = Place::new();
    let mut holder = Process::start("role", &place, "");
    holder.expect("served");
    let error = RoleLock::acquire(place.root(), &place.instance, "ingress").unwrap_err();
    let pid = holder.pid();
    assert!(
        matches!(&error, ShmError::AlreadyServed { role, pid: held } if role == "ingress" && *held == pid)
    );
    assert!(error.to_string().contains(&format!("process {pid}")), "{error}");
    let other = RoleLock::acquire(place.root(), &place.instance, "egress-critical").unwrap();
    holder.kill();
    let role = RoleLock::acquire(place.root(), &place.instance, "ingress").unwrap();
    let refused = Process::start("role", &place, "");
    let message = refused.next_line();
    assert!(
        message.contains(&format!("ingress is served already, by process {}", std::process::id())),
        "{message}"
    );
    refused.finish();
    drop(role);
    let next = Process::start("role", &place, "");
    next.expect("served");
    next.finish();
    drop(other);
    place.assert_nothing_left();
}

#[test]
fn lanes_continue_after_repeated_kills_of_ingress() {
    let place = Place::new();
    let lanes = [0, 1].map(|lane| Process::start("lane", &place, &format!("{lane} 2948 0")));
    lanes.iter().for_each(|lane| lane.expect("ready"));
    let boards = || Boards::find(place.root(), &place.instance, &shape()).unwrap().unwrap();
    for _ in 0..10 {
        let mut ingress = Process::start("publisher", &place, "100 2948");
        ingress.expect("ready");
        let before = boards().lane(0, 0).unwrap().last_sequence;
        until("samples are forwarded", || boards().lane(0, 0).unwrap().last_sequence > before + 200);
        ingress.kill();
        let dead = boards().ingress(0).unwrap();
        assert_eq!(dead.received, dead.published, "every received sample found a slot of the pool");
    }
    let last = Process::start("publisher", &place, "100 2948");
    last.expect("ready");
    let before = boards().lane(1, 0).unwrap().last_sequence;
    until("samples are forwarded", || boards().lane(1, 0).unwrap().last_sequence > before + 200);
    let published: u64 = last.finish().parse().unwrap();
    for number in 0..2 {
        until("the lane has received every sample", || {
            boards().lane(number, 0).unwrap().last_sequence == published
        });
        let counters = boards().lane(number, 0).unwrap();
        assert!(counters.is_accounted_for(), "{counters:?}");
        if number == 0 {
            // One for each death: numbered, and not published.
            assert!(counters.drops.total() <= 10, "{counters:?}");
        }
    }
    for lane in lanes {
        lane.finish();
    }
    place.assert_nothing_left();
}

#[test]
fn ingress_and_the_other_lane_continue_after_a_lane_is_killed_that_holds_samples() {
    let place = Place::new();
    let ingress = Process::start("publisher", &place, "100 2948");
    ingress.expect("ready");
    let healthy = Process::start("lane", &place, "0 2948 0");
    healthy.expect("ready");
    let boards = Boards::find(place.root(), &place.instance, &shape()).unwrap().unwrap();
    for _ in 0..10 {
        let mut victim = Process::start("lane", &place, "1 2948 7");
        victim.expect("ready");
        victim.expect("holding");
        victim.kill();
    }
    // If the slots of the ten killed processes (70) and their queues were lost, the pool would be empty by
    // now.
    let fresh = Process::start("lane", &place, "1 2948 0");
    fresh.expect("ready");
    let before = boards.lane(1, 0).unwrap().last_sequence;
    until("the new lane forwards samples", || boards.lane(1, 0).unwrap().last_sequence > before + 500);
    assert!(fresh.finish().parse::<u64>().unwrap() > 0);
    let published: u64 = ingress.finish().parse().unwrap();
    let counters = boards.ingress(0).unwrap();
    assert_eq!(counters.received, published, "no sample found the pool empty: {counters:?}");
    until("the healthy lane has received every sample", || {
        boards.lane(0, 0).unwrap().last_sequence == published
    });
    let counters = boards.lane(0, 0).unwrap();
    assert_eq!(counters.drops.total(), 0, "{counters:?}");
    healthy.finish();
    place.assert_nothing_left();
}

#[test]
fn a_stopped_lane_delays_no_other_process_and_continues_after_a_gap() {
    let place = Place::new();
    let lanes = [0, 1].map(|lane| Process::start("lane", &place, &format!("{lane} 2948 0")));
    lanes.iter().for_each(|lane| lane.expect("ready"));
    let ingress = Process::start("publisher", &place, "50 2948");
    ingress.expect("ready");
    let boards = Boards::find(place.root(), &place.instance, &shape()).unwrap().unwrap();
    until("both lanes forward samples", || (0..2).all(|lane| boards.lane(lane, 0).unwrap().forwarded > 100));
    lanes[1].signal(Signal::SIGSTOP);
    let stopped_at = boards.ingress(0).unwrap().published;
    // Far more than a queue of 64, and more wakes than a socket's buffer would take.
    until("ingress continues", || boards.ingress(0).unwrap().published > stopped_at + 20_000);
    lanes[1].signal(Signal::SIGCONT);
    let resumed_at = boards.ingress(0).unwrap().published;
    until("the lane continues", || boards.lane(1, 0).unwrap().last_sequence > resumed_at + 500);
    let published: u64 = ingress.finish().parse().unwrap();
    assert_eq!(boards.ingress(0).unwrap().received, published);
    until("every sample is accounted for", || {
        (0..2).all(|lane| boards.lane(lane, 0).unwrap().last_sequence == published)
    });
    let counters = [0, 1].map(|lane| boards.lane(lane, 0).unwrap());
    assert!(counters.iter().all(|counters| counters.is_accounted_for()), "{counters:?}");
    assert_eq!(counters[0].drops.total(), 0, "{counters:?}");
    assert!(counters[1].drops.total() >= 19_000, "{counters:?}");
    for lane in lanes {
        lane.finish();
    }
    place.assert_nothing_left();
}

#[test]
fn taps_that_start_and_are_killed_disturb_no_lane() {
    let place = Place::new();
    let healthy = Process::start("lane", &place, "0 500 0");
    healthy.expect("ready");
    let ingress = Process::start("publisher", &place, "200 500");
    ingress.expect("ready");
    for _ in 0..10 {
        let mut taps = [0, 1].map(|_| Process::start("tap", &place, "500"));
        taps.iter().for_each(|tap| tap.expect("ready"));
        taps.iter_mut().for_each(Process::kill);
    }
    let boards = Boards::find(place.root(), &place.instance, &shape()).unwrap().unwrap();
    let published: u64 = ingress.finish().parse().unwrap();
    until("every sample has arrived", || boards.lane(0, 0).unwrap().last_sequence == published);
    assert_eq!(boards.lane(0, 0).unwrap().drops.total(), 0);
    healthy.finish();
    place.assert_nothing_left();
}

#[test]
fn processes_killed_while_they_start_leave_nothing() {
    let place = Place::new();
    let survivor = Process::start("lane", &place, "0 1000 0");
    survivor.expect("ready");
    for delay_ms in 0..40 {
        let mut victim = Process::start("open", &place, "");
        std::thread::sleep(Duration::from_millis(delay_ms / 2));
        victim.kill();
    }
    let ingress = Process::start("publisher", &place, "100 1000");
    ingress.expect("ready");
    let boards = Boards::find(place.root(), &place.instance, &shape()).unwrap().unwrap();
    until("samples are forwarded", || boards.lane(0, 0).unwrap().forwarded > 100);
    ingress.finish();
    survivor.finish();
    place.assert_nothing_left();
    for delay_ms in 0..20 {
        let mut victim = Process::start("open", &place, "");
        std::thread::sleep(Duration::from_millis(delay_ms));
        victim.kill();
    }
    drop(place.node());
    place.assert_nothing_left();
}

#[test]
fn incomplete_files_of_a_killed_process_are_removed_and_delay_no_other_process() {
    let place = Place::new();
    let survivor = Process::start("tap", &place, "1000");
    survivor.expect("ready");
    // As after kill -9 between the calls that create a file, set its length, fill it and publish it.
    let instance = place.root().join("test");
    let services = || fs::read_dir(instance.join("services")).unwrap().flatten().map(|entry| entry.path());
    let other = RouteChannel { route: RouteId::try_from("other").unwrap(), ..channel(100) };
    let service = {
        let before: Vec<_> = services().collect();
        let node = place.node();
        let _publisher = SamplePublisher::create(&node, &other).unwrap();
        services().find(|path| !before.contains(path)).unwrap()
    };
    assert!(!service.exists(), "the service is removed with its last user");
    let count = place.shm_files().into_iter().find(|path| path.to_string_lossy().ends_with("global_mgmt"));
    let count = count.unwrap();
    let connection = std::path::Path::new("/dev/shm")
        .join(format!("{}b9fc73e5c1f646968758453273c6c65cb372831b_1_2.connection", place.prefix()));
    let node_folder = instance.join("nodes/12345678901234567890");
    let write = |path: &std::path::Path, content: &[u8], mode| {
        let _ = fs::remove_file(path);
        fs::write(path, content).unwrap();
        fs::set_permissions(path, fs::Permissions::from_mode(mode)).unwrap();
    };
    for content in [&[][..], &[0; 64]] {
        write(&count, content, 0o200);
        write(&connection, content, 0o200);
        write(&service, content, 0o600);
        fs::create_dir(&node_folder).unwrap();
        fs::write(node_folder.join("x.details"), "half").unwrap();
        let node = place.node();
        assert_eq!(node.cleaned_up().stray_files, 4);
        assert!(!connection.exists() && !service.exists() && !node_folder.exists());
        let publisher = SamplePublisher::create(&node, &other).unwrap();
        let lane = lane(&node, &other);
        publish(&publisher, 1, 100);
        assert_eq!(sequences(&lane), [1]);
    }
    survivor.finish();
    place.assert_nothing_left();
}

#[test]
fn counters_of_a_killed_writer_remain_consistent() {
    let place = Place::new();
    let node = place.node();
    let boards = node.boards(&shape()).unwrap();
    let mut last = 0;
    for round in 1..=30 {
        let mut writer = Process::start("counter", &place, "");
        let resumed: u64 = writer.next_line().parse().unwrap();
        assert_eq!(resumed, last, "the new writer continues from the last value of the killed one");
        let mut read = 0;
        while read < 20_000 || boards.ingress(0).unwrap().received < last + 1_000 {
            let counters = boards.ingress(0).unwrap();
            let n = counters.received;
            let whole = (n, n, n) == (counters.received_bytes, counters.published, counters.lost_upstream);
            assert!(whole, "a torn value: {counters:?}");
            assert!(boards.lane(1, 0).unwrap().is_accounted_for());
            read += 1;
        }
        writer.kill();
        let counters = boards.ingress(0).unwrap();
        assert_eq!(counters.received, counters.published);
        assert!(counters.received >= last + 1_000);
        last = counters.received;
        assert_eq!(boards.health(ProcessRole::Egress(1)).unwrap().starts, round);
        let found = Boards::find(place.root(), &place.instance, &shape()).unwrap().unwrap();
        assert_eq!(found.ingress(0).unwrap(), counters);
    }
}

#[test]
fn each_value_has_its_own_place_on_the_boards() {
    let place = Place::new();
    let node = place.node();
    let shape = BridgeShape {
        routes: vec![route(), RouteId::try_from("map").unwrap(), RouteId::try_from("tf").unwrap()],
        ..shape()
    };
    let boards = node.boards(&shape).unwrap();
    let roles = [ProcessRole::Ingress, ProcessRole::Control, ProcessRole::Egress(0), ProcessRole::Egress(1)];
    let stages = |lane| [Stage::Shm(lane), Stage::DdsOut(lane), Stage::Age(lane)];
    let stages: Vec<_> = [Stage::DdsIn]
        .into_iter()
        .chain((0..2).flat_map(stages))
        .flat_map(|s| [(s, 0), (s, 1), (s, 2)])
        .collect();
    for (n, role) in (1..).zip(roles) {
        boards.health_writer(role).update(|health| health.turns = n);
    }
    for (n, &(stage, route)) in (1u64..).zip(&stages) {
        let mut latencies = boards.histogram_writer(stage, route);
        (0..n).for_each(|_| latencies.record(u64::MAX));
    }
    for route in 0..3 {
        boards.ingress_writer(route).update(|counters| counters.published = 100 + route as u64);
        let name = adaptive_bridge::model::FixedText::new(&format!("type {route}"));
        boards.route_info_writer(route).update(|info| info.dds_type = name);
        for lane in 0..2 {
            let mut counters = boards.lane_writer(lane, route);
            counters.update(|counters| counters.forwarded = (10 * lane + route) as u64);
        }
    }
    for (n, role) in (1..).zip(roles) {
        assert_eq!(boards.health(role).unwrap().turns, n);
    }
    for (n, &(stage, route)) in (1..).zip(&stages) {
        let found = boards.histogram(stage, route);
        assert_eq!((found.count(), found.max_ns), (n, u64::MAX), "{stage:?} {route}");
    }
    for route in 0..3 {
        assert_eq!(boards.ingress(route).unwrap().published, 100 + route as u64);
        assert_eq!(boards.route_info(route).unwrap().dds_type.as_str(), format!("type {route}"));
        for lane in 0..2 {
            assert_eq!(boards.lane(lane, route).unwrap().forwarded, (10 * lane + route) as u64);
        }
    }
}

#[test]
fn a_histogram_on_the_board_counts_as_the_model_does() {
    let place = Place::new();
    let node = place.node();
    let boards = node.boards(&shape()).unwrap();
    let mut expected = LatencyHistogram::default();
    let mut latencies = boards.histogram_writer(Stage::Age(1), 0);
    let mut value = 0x9e37_79b9_7f4a_7c15u64;
    let edges = (0..64).flat_map(|bit| [(1u64 << bit) - 1, 1 << bit, (1 << bit) + 1]);
    let random = std::iter::repeat_with(|| {
        value ^= value << 13;
        value ^= value >> 7;
        value ^= value << 17;
        value >> (value % 64)
    });
    for latency_ns in edges.chain([0, u64::MAX]).chain(random.take(100_000)) {
        expected.record(latency_ns);
        latencies.record(latency_ns);
    }
    assert_eq!(boards.histogram(Stage::Age(1), 0), expected);
}

#[test]
fn a_policy_counts_its_changes_and_is_changed_by_one_process_at_a_time() {
    let place = Place::new();
    let node = place.node();
    let boards = node.boards(&shape()).unwrap();
    assert_eq!(boards.policy(0).unwrap().epoch, 0);
    let set = |mode: LaneMode, at| {
        let change = |mut policy: LanePolicy| {
            (policy.mode, policy.written_at) = (mode as u8, MonotonicNs(at));
            policy
        };
        boards.policies().unwrap().set(0, MonotonicNs(1), change).epoch
    };
    assert_eq!(
        set(LaneMode::Normal, 0),
        1,
        "the first policy increments the epoch even if it equals the default"
    );
    assert_eq!(set(LaneMode::Normal, 7), 1);
    assert_eq!(boards.policy(0).unwrap().written_at, MonotonicNs(7));
    assert_eq!(set(LaneMode::Suspended, 8), 2);
    assert_eq!(boards.policy(0).unwrap().mode, LaneMode::Suspended as u8);
    assert_eq!(boards.policy(1).unwrap().epoch, 0);
    // Another process confirms and changes the policy meanwhile: no change is lost, and a killed process
    // blocks no other.
    for _ in 0..5 {
        let mut other = Process::start("policy", &place, "");
        other.expect("ready");
        for _ in 0..500 {
            let mut before = 0;
            let after = boards.policies().unwrap().set(0, MonotonicNs(1), |mut policy| {
                before = policy.written_at.0;
                policy.written_at.0 += 1;
                policy
            });
            assert_eq!(after.written_at.0, before + 1);
        }
        other.kill();
        assert_eq!(set(LaneMode::Stopped, 1), set(LaneMode::Stopped, 2));
    }
}

#[test]
fn no_wake_is_missed() {
    let place = Place::new();
    let node = place.node();
    let boards = node.boards(&shape()).unwrap();
    let pong = Process::start("pong", &place, "");
    pong.expect("ready");
    let (waker, mut sleeper) = (boards.waker(0), boards.sleeper(1));
    assert_eq!(sleeper.sleep(Duration::ZERO), Woken::Woken, "the first sleep ends at once");
    for turn in 0..200_000 {
        // Varies the moment of the wake: before, during or after the other side's falling asleep.
        (0..turn * 7_919 % 400).for_each(|_| std::hint::spin_loop());
        if turn % 3 != 0 {
            waker.wake_early(ELSEWHERE);
            (0..turn * 6_091 % 400).for_each(|_| std::hint::spin_loop());
        }
        waker.wake();
        // A wake whose system call is delayed is reported as an early one.
        let woken = sleeper.sleep(support::PATIENCE);
        let woken = if woken == Woken::Early { sleeper.sleep(support::PATIENCE) } else { woken };
        assert_eq!(woken, Woken::Woken, "turn {turn}");
    }
    pong.finish();
    while sleeper.sleep(Duration::from_millis(20)) != Woken::TimedOut {}
    boards.waker(1).wake();
    boards.waker(1).wake();
    assert_eq!(sleeper.sleep(Duration::ZERO), Woken::Woken, "a wake before the sleep ends it");
    assert_eq!(sleeper.sleep(Duration::ZERO), Woken::TimedOut, "two wakes before the sleep end one sleep");
    let start = std::time::Instant::now();
    assert_eq!(sleeper.sleep(Duration::from_millis(30)), Woken::TimedOut);
    assert!(start.elapsed() >= Duration::from_millis(30), "the sleep lasts until its timeout");
}

/// No CPU that a lane sleeps on.
const ELSEWHERE: u32 = 0;

#[test]
fn an_early_wake_is_distinguished_from_a_wake() {
    let place = Place::new();
    let node = place.node();
    let boards = node.boards(&shape()).unwrap();
    let (waker, mut sleeper) = (boards.waker(1), boards.sleeper(1));
    assert_eq!(sleeper.sleep(Duration::ZERO), Woken::Woken, "the first sleep ends at once");
    let done = AtomicBool::new(false);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !done.load(Ordering::Relaxed) {
                waker.wake_early(ELSEWHERE);
            }
        });
        assert_eq!(sleeper.sleep(support::PATIENCE), Woken::Early, "an early wake ends the sleep");
        // No sample follows, so the lane ignores further early wakes until its next wake.
        let start = std::time::Instant::now();
        assert_eq!(sleeper.sleep(Duration::from_millis(100)), Woken::TimedOut);
        assert!(start.elapsed() >= Duration::from_millis(100), "the sleep lasts until its timeout");
        waker.wake();
        assert_eq!(
            sleeper.sleep(support::PATIENCE),
            Woken::Woken,
            "a wake ends the sleep among ignored early wakes"
        );
        assert_eq!(
            sleeper.sleep(support::PATIENCE),
            Woken::Early,
            "early wakes end the sleep again after a wake"
        );
        waker.wake();
        assert_eq!(sleeper.sleep(support::PATIENCE), Woken::Woken, "a wake during an early wake is not lost");
        done.store(true, Ordering::Relaxed);
    });
}

#[test]
fn an_early_wake_from_the_cpu_that_the_lane_sleeps_on_is_ignored() {
    let place = Place::new();
    let node = place.node();
    let boards = node.boards(&shape()).unwrap();
    let (waker, mut sleeper) = (boards.waker(1), boards.sleeper(1));
    assert_eq!(sleeper.sleep(Duration::ZERO), Woken::Woken, "the first sleep ends at once");
    let done = AtomicBool::new(false);
    let cpu = AtomicU32::new(0);
    std::thread::scope(|scope| {
        scope.spawn(|| {
            while !done.load(Ordering::Relaxed) {
                waker.wake_early(cpu.load(Ordering::Relaxed));
            }
        });
        // This thread stays on its CPU.
        let mut here = nix::sched::CpuSet::new();
        here.set(nix::sched::sched_getcpu().unwrap()).unwrap();
        nix::sched::sched_setaffinity(nix::unistd::Pid::from_raw(0), &here).unwrap();
        cpu.store(this_cpu(), Ordering::Relaxed);
        while sleeper.sleep(Duration::from_millis(10)) == Woken::Early {}
        waker.wake();
        assert_eq!(
            sleeper.sleep(support::PATIENCE),
            Woken::Woken,
            "after a wake early wakes are not ignored"
        );
        assert_eq!(sleeper.sleep(Duration::from_millis(100)), Woken::TimedOut);
        done.store(true, Ordering::Relaxed);
    });
}

#[test]
fn waking_a_stopped_lane_never_blocks() {
    let place = Place::new();
    let node = place.node();
    let boards = node.boards(&shape()).unwrap();
    let mut lane = Process::start("pong", &place, "");
    lane.expect("ready");
    lane.signal(Signal::SIGSTOP);
    let (waker, mut sleeper) = (boards.waker(0), boards.sleeper(1));
    for _ in 0..1_000_000 {
        waker.wake();
    }
    assert_eq!(sleeper.sleep(Duration::ZERO), Woken::Woken);
    lane.signal(Signal::SIGCONT);
    assert_eq!(sleeper.sleep(support::PATIENCE), Woken::Woken, "the lane continues");
    lane.kill();
    // The dead one may have been asleep: its flag stays up, and waking it is harmless.
    waker.wake();
    let next = Process::start("pong", &place, "");
    next.expect("ready");
    while sleeper.sleep(Duration::from_millis(10)) != Woken::TimedOut {}
    waker.wake();
    assert_eq!(sleeper.sleep(support::PATIENCE), Woken::Woken);
    next.finish();
}

#[test]
fn a_full_shared_memory_is_an_error_at_the_start_and_never_later() {
    let unshare = Command::new("unshare").args(["-m", "true"]).status();
    if !nix::unistd::geteuid().is_root() || !unshare.is_ok_and(|status| status.success()) {
        return skip("a small /dev/shm of its own: needs root and unshare(1)");
    }
    let place = Place::new();
    let mut command = Command::new("unshare");
    let script = "mount -t tmpfs -o size=4m tmpfs /dev/shm && exec \"$0\" \"$@\"";
    command.args(["-m", "sh", "-c", script]).arg(std::env::current_exe().unwrap());
    let child = Process::start_with(command, "full", &place, "");
    let error = child.next_line();
    let needed = deep_channel(1 << 20).pool_size().first_bytes;
    for part in [&format!("needs {}", needed + 512 * 1024), "/dev/shm", "scan", "remount", "max_sample_bytes"]
    {
        assert!(error.contains(part), "{part} is not in: {error}");
    }
    let error = child.next_line();
    assert!(error.contains("0 free"), "{error}");
    child.expect("done");
    child.finish();
    place.assert_nothing_left();
}
