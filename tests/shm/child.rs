//! The functions of the tests' child processes.

use std::io::Read;
use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use adaptive_bridge::model::{DropReason, InstanceName, LaneMode, MonotonicNs, RouteId};
use adaptive_bridge::shm::{
    LoanError, NoMemory, ProcessRole, RoleLock, RouteChannel, SamplePublisher, SampleSubscriber, ShmNode,
    Stage, SubscriberRole, TakeError, Woken,
};

use crate::allocations;
use crate::support::{LANE, PATIENCE, channel, deep_channel, header, payload, shape};

pub struct Child {
    pub root: PathBuf,
    pub instance: InstanceName,
    pub arguments: Vec<u64>,
    pub stop: Arc<AtomicBool>,
}

impl Child {
    pub fn from_environment() -> Option<(String, Self)> {
        let what = std::env::var("AB_CHILD").ok()?;
        let stop = Arc::new(AtomicBool::new(false));
        let stopper = stop.clone();
        std::thread::spawn(move || {
            let _ = std::io::stdin().read_to_end(&mut Vec::new());
            stopper.store(true, Ordering::SeqCst);
        });
        let arguments = std::env::var("AB_ARGUMENTS").unwrap();
        let child = Self {
            root: std::env::var_os("AB_ROOT").unwrap().into(),
            instance: InstanceName::try_from(std::env::var("AB_INSTANCE").unwrap().as_str()).unwrap(),
            arguments: arguments.split_whitespace().map(|word| word.parse().unwrap()).collect(),
            stop,
        };
        Some((what, child))
    }

    pub fn run(&self, what: &str) {
        match what {
            "publisher" => self.publisher(),
            "lane" => self.lane(),
            "tap" => self.tap(),
            "role" => self.role(),
            "counter" => self.counter(),
            "policy" => self.policy(),
            "pong" => self.pong(),
            "full" => self.full(),
            "open" => self.open(),
            "allocations" => self.allocations(),
            other => panic!("no child {other}"),
        }
    }

    fn node(&self, name: &str) -> ShmNode {
        ShmNode::open(&self.root, &self.instance, name).unwrap()
    }

    fn stopping(&self) -> bool {
        self.stop.load(Ordering::SeqCst)
    }

    /// Arguments: pause in µs, bytes. Numbers samples on from where the former process stopped.
    fn publisher(&self) {
        let [pause_us, bytes] = self.arguments[..] else { panic!() };
        let _role = RoleLock::acquire(&self.root, &self.instance, "ingress").unwrap();
        let node = self.node("ingress");
        let boards = node.boards(&shape()).unwrap();
        let publisher = SamplePublisher::create(&node, &deep_channel(bytes as usize)).unwrap();
        let wakers = [boards.waker(0), boards.waker(1)];
        let mut counters = boards.ingress_writer(0);
        println!("@ ready");
        while !self.stopping() {
            let sequence = counters.get().published + 1;
            let copied = publisher.copy_in(&payload(sequence, bytes as usize));
            match copied {
                Ok(slot) => {
                    // Counted before it is published, so that no number is used twice.
                    counters.update(|counters| {
                        counters.received += 1;
                        counters.published += 1;
                    });
                    slot.publish(header(sequence)).unwrap();
                    wakers.iter().for_each(|waker| waker.wake());
                }
                Err(LoanError::PoolExhausted) => counters.update(|counters| {
                    counters.received += 1;
                    counters.drops.add(DropReason::PoolExhausted, 1);
                }),
                Err(error) => panic!("{error}"),
            }
            std::thread::sleep(Duration::from_micros(pause_us));
        }
        println!("@ {}", counters.get().published);
    }

    /// Arguments: lane, bytes, samples to hold for ever. Checks every byte, counts what it gets and misses.
    fn lane(&self) {
        let [lane, bytes, hold] = self.arguments[..] else { panic!() };
        let lane = lane as usize;
        let role = shape().lanes[lane].to_string();
        let _role = RoleLock::acquire(&self.root, &self.instance, &role).unwrap();
        let node = self.node(&role);
        let boards = node.boards(&shape()).unwrap();
        let channel = deep_channel(bytes as usize);
        let queue = SubscriberRole::Lane(channel.lanes[lane]);
        let subscriber = SampleSubscriber::open(&node, &channel, queue, false).unwrap();
        let mut sleeper = boards.sleeper(lane);
        let mut counters = boards.lane_writer(lane, 0);
        let mut held = Vec::new();
        println!("@ ready");
        loop {
            sleeper.sleep(Duration::from_millis(50));
            while let Some(sample) = subscriber.take().unwrap() {
                let sequence = sample.header().sequence;
                assert_eq!(*sample.header(), header(sequence));
                assert_eq!(sample.payload(), payload(sequence, bytes as usize), "sample {sequence}");
                counters.update(|counters| {
                    if counters.last_sequence == 0 {
                        counters.first_sequence = sequence - 1;
                        counters.last_sequence = sequence - 1;
                    }
                    assert!(sequence > counters.last_sequence, "{sequence} after {}", counters.last_sequence);
                    counters.drops.add(DropReason::QueueOverflow, sequence - counters.last_sequence - 1);
                    counters.last_sequence = sequence;
                    counters.forwarded += 1;
                });
                if (held.len() as u64) < hold {
                    held.push(sample);
                    if held.len() as u64 == hold {
                        println!("@ holding");
                    }
                }
            }
            if self.stopping() {
                break;
            }
        }
        println!("@ {}", counters.get().forwarded);
    }

    /// Arguments: bytes. Taps until it is stopped.
    fn tap(&self) {
        let node = self.node("tap");
        let channel = deep_channel(self.arguments[0] as usize);
        let subscriber = SampleSubscriber::open(&node, &channel, SubscriberRole::Tap, false).unwrap();
        println!("@ ready");
        while !self.stopping() {
            match subscriber.take() {
                Ok(_) => std::thread::sleep(Duration::from_millis(1)),
                Err(error) => panic!("{error}"),
            }
        }
    }

    fn role(&self) {
        match RoleLock::acquire(&self.root, &self.instance, "ingress") {
            Ok(_role) => {
                println!("@ served");
                while !self.stopping() {
                    std::thread::sleep(Duration::from_millis(1));
                }
            }
            Err(error) => println!("@ {error}"),
        }
    }

    /// Changes a counter, a lane's counters and a histogram as fast as it can. Each published value is
    /// consistent.
    fn counter(&self) {
        let node = self.node("ingress");
        let boards = node.boards(&shape()).unwrap();
        let mut ingress = boards.ingress_writer(0);
        let mut lane = boards.lane_writer(1, 0);
        let mut health = boards.health_writer(ProcessRole::Egress(1));
        health.update(|health| health.starts += 1);
        println!("@ {}", ingress.get().received);
        while !self.stopping() {
            ingress.update(|counters| {
                counters.received += 1;
                counters.received_bytes += 1;
                counters.published += 1;
                counters.lost_upstream += 1;
            });
            lane.update(|counters| {
                counters.last_sequence += 1;
                counters.forwarded += 1;
            });
        }
    }

    /// Confirms the policy of lane 0 until stopped.
    fn policy(&self) {
        let boards = self.node("control").boards(&shape()).unwrap();
        println!("@ ready");
        while !self.stopping() {
            boards.policies().unwrap().set(0, MonotonicNs(1), |mut policy| {
                policy.mode = LaneMode::Degraded as u8;
                policy.written_at.0 += 1;
                policy
            });
        }
    }

    /// Answers every wake of lane 0 by one of lane 1. It does not poll, so a missed wake stays unanswered.
    fn pong(&self) {
        let node = self.node("pong");
        let boards = node.boards(&shape()).unwrap();
        let mut sleeper = boards.sleeper(0);
        let waker = boards.waker(1);
        let (stop, last) = (self.stop.clone(), boards.waker(0));
        std::thread::spawn(move || {
            while !stop.load(Ordering::SeqCst) {
                std::thread::sleep(Duration::from_millis(1));
            }
            last.wake();
        });
        assert_eq!(sleeper.sleep(Duration::ZERO), Woken::Woken, "the first sleep ends at once");
        println!("@ ready");
        while !self.stopping() {
            match sleeper.sleep(PATIENCE * 2) {
                Woken::Early => continue,
                woken => assert_eq!(woken, Woken::Woken),
            }
            waker.wake();
        }
    }

    /// In a small /dev/shm of its own: prints the error of a pool that does not fit, then fills the rest and
    /// continues.
    fn full(&self) {
        let node = self.node("ingress");
        let boards = node.boards(&shape()).unwrap();
        let error = SamplePublisher::create(&node, &deep_channel(1 << 20)).unwrap_err();
        println!("@ {error}");
        let large_channel = RouteChannel { route: RouteId::try_from("large").unwrap(), ..channel(1 << 20) };
        let large = SamplePublisher::create(&node, &large_channel).unwrap();
        let channel = channel(3_000);
        let publisher = SamplePublisher::create(&node, &channel).unwrap();
        let subscriber = SampleSubscriber::open(&node, &channel, SubscriberRole::Lane(LANE), false).unwrap();
        let mut counters = boards.ingress_writer(0);
        // /dev/shm is full now.
        use std::io::Write;
        let mut filler = std::fs::File::create("/dev/shm/filler").unwrap();
        while filler.write_all(&[1; 4096]).is_ok() {}
        while filler.write_all(&[1]).is_ok() {}
        let one_mib = vec![1; 1 << 20];
        for sequence in 1..=500 {
            // What was allocated at the start can be used, and what was not is an error and not SIGBUS.
            large.copy_in(&payload(sequence, 3_000)).unwrap().publish(header(sequence)).unwrap();
            for length in [5_000, 1 << 20] {
                let refused = large.copy_in(&one_mib[..length]).unwrap_err();
                assert_eq!(refused, LoanError::NoMemory(NoMemory::FileSystem));
                assert!(large.lend(length).is_none());
            }
            let slot = publisher.copy_in(&payload(sequence, 3_000)).unwrap();
            slot.publish(header(sequence)).unwrap();
            counters.update(|counters| counters.published += 1);
            boards.histogram_writer(Stage::DdsIn, 0).record(sequence << 12);
            let sample = subscriber.take().unwrap().unwrap();
            assert_eq!(sample.payload(), payload(sequence, 3_000));
            assert!(matches!(subscriber.take(), Ok(None) | Err(TakeError::BorrowLimit)));
        }
        let error = SampleSubscriber::open(&node, &channel, SubscriberRole::Tap, false).unwrap_err();
        println!("@ {error}");
        drop(filler);
        std::fs::remove_file("/dev/shm/filler").unwrap();
        large.copy_in(&one_mib).unwrap().publish(header(501)).unwrap();
        SampleSubscriber::open(&node, &channel, SubscriberRole::Tap, false).unwrap();
        println!("@ done");
    }

    /// Opens everything and waits.
    fn open(&self) {
        let node = self.node("any");
        let _boards = node.boards(&shape()).unwrap();
        let channel = deep_channel(1000);
        let _publisher = SamplePublisher::create(&node, &channel);
        let _subscriber = SampleSubscriber::open(&node, &channel, SubscriberRole::Lane(LANE), false);
        println!("@ ready");
        while !self.stopping() {
            std::thread::sleep(Duration::from_millis(1));
        }
    }

    /// Prints how many allocations this thread made in 10,000 samples, also with a queue that overflows and
    /// with refused samples.
    fn allocations(&self) {
        let node = self.node("ingress");
        let channel = RouteChannel { retained_samples: 2, ..channel(3_000) };
        let boards = node.boards(&shape()).unwrap();
        let publisher = SamplePublisher::create(&node, &channel).unwrap();
        let lane = SampleSubscriber::open(&node, &channel, SubscriberRole::Lane(LANE), false).unwrap();
        let (waker, mut sleeper) = (boards.waker(0), boards.sleeper(0));
        let mut counters = boards.ingress_writer(0);
        let mut latencies = boards.histogram_writer(Stage::Shm(0), 0);
        let content = payload(1, 2_948);
        let mut turn = |sequence| {
            publisher.copy_in(&content).unwrap().publish(header(sequence)).unwrap();
            counters.update(|counters| counters.published += 1);
            waker.wake();
            assert_eq!(sleeper.sleep(Duration::from_secs(1)), Woken::Woken);
            let sample = lane.take().unwrap().unwrap();
            latencies.record(sample.header().sequence);
            assert_eq!(sample.payload().len(), 2_948);
            assert!(lane.take().unwrap().is_none());
            publisher.connect_subscribers();
        };
        turn(1);
        let before = allocations();
        (2..=10_000).for_each(&mut turn);
        let steady = allocations() - before;
        let before = allocations();
        for sequence in 1..=200 {
            publisher.copy_in(&content).unwrap().publish(header(sequence)).unwrap();
            assert!(publisher.copy_in(&[0; 3_001]).is_err());
        }
        let overflowing = allocations() - before;
        let before = allocations();
        drop(std::hint::black_box(Box::new(1)));
        let control = allocations() - before;
        println!("@ steady {steady}, overflowing {overflowing}, control {control}");
    }
}
