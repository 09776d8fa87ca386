//! The cost of a sample in steady state: no heap allocation by the bridge's own code, and only the copies of
//! its payload that are necessary. The roles run unchanged, as threads of this process, over real shared
//! memory and real RTPS, with an allocator that counts. Allocations of the libraries for DDS and shared
//! memory do not count as ours: an allocation belongs to the code of the innermost frame of its backtrace
//! that is of a library or of the bridge.

use std::alloc::{GlobalAlloc, Layout, System};
use std::backtrace::Backtrace;
use std::cell::Cell;
use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, AtomicI32, AtomicU64, Ordering};
use std::thread;
use std::time::{Duration, Instant};

use adaptive_bridge::config::{self, DdsNetwork, Settings};
use adaptive_bridge::dds::{Participant, ParticipantOptions, RawReader, RawWriter, ReaderQos, Take};
use adaptive_bridge::model::{
    Durability, Encapsulation, IngressCounters, LaneCounters, QosProfile, Reliability, SourceTimestamp,
    WallNs,
};
use adaptive_bridge::process::{self, ReloadRequests, Stop};
use adaptive_bridge::shm::{Boards, BridgeShape, ShmNode};
use bytes::Bytes;
use nix::unistd::gettid;

const TYPE: &str = "std_msgs::msg::dds_::UInt8MultiArray_";
const DOMAIN_ID: u16 = 76;
/// The critical lane is the first one.
const LANES: [&str; 2] = ["critical", "noncritical"];
const ROLES: [&str; 3] = ["ingress", "critical", "noncritical"];
/// A laser scan, copied for DDS; and a size that DDS is given by reference.
const SMALL_BYTES: usize = 2_948;
const LARGE_BYTES: usize = 1 << 20;

static COUNTING: AtomicBool = AtomicBool::new(false);
static OURS: [AtomicU64; 3] = [const { AtomicU64::new(0) }; 3];
static DDS: [AtomicU64; 3] = [const { AtomicU64::new(0) }; 3];
static SHARED_MEMORY: [AtomicU64; 3] = [const { AtomicU64::new(0) }; 3];
/// Allocations of ours that have room for a large payload, which is what a copy of one would take.
static PAYLOADS: AtomicU64 = AtomicU64::new(0);
/// Where the first few allocations of ours came from.
static CULPRITS: Mutex<Vec<String>> = Mutex::new(Vec::new());

/// The thread of the DDS library on which ingress takes samples.
static RECEIVING_THREAD: AtomicI32 = AtomicI32::new(0);

thread_local! {
    /// The role that this thread runs.
    static ROLE: Cell<Option<usize>> = const { Cell::new(None) };
    /// Whether the number of this thread was compared already.
    static NUMBERED: Cell<bool> = const { Cell::new(false) };
}

/// Makes the receiving thread one of ingress.
fn number_thread() {
    if !NUMBERED.replace(true) && gettid().as_raw() == RECEIVING_THREAD.load(Ordering::Relaxed) {
        ROLE.set(Some(0));
    }
}

struct Counting;

// SAFETY: every call goes to the system's allocator unchanged. Counting touches atomics and const-initialised
// thread-local cells, and a thread does not count while it takes a backtrace, which allocates itself.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size());
        // SAFETY: as the caller promises.
        unsafe { System.alloc(layout) }
    }

    unsafe fn alloc_zeroed(&self, layout: Layout) -> *mut u8 {
        count(layout.size());
        // SAFETY: as the caller promises.
        unsafe { System.alloc_zeroed(layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        count(new_size);
        // SAFETY: as the caller promises.
        unsafe { System.realloc(pointer, layout, new_size) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: as the caller promises.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

fn count(bytes: usize) {
    if !COUNTING.load(Ordering::Relaxed) {
        return;
    }
    number_thread();
    let Some(role) = ROLE.get() else {
        return;
    };
    // Taking a backtrace allocates.
    ROLE.set(None);
    let backtrace = Backtrace::force_capture().to_string();
    let position = |names: &[&str]| names.iter().filter_map(|name| backtrace.find(name)).min();
    let owners = [
        (position(&["rustdds"]), &DDS),
        (position(&["iceoryx2"]), &SHARED_MEMORY),
        (position(&["adaptive_bridge::", "./src/"]), &OURS),
    ];
    let owner =
        owners.iter().filter(|(position, _)| position.is_some()).min_by_key(|(position, _)| *position);
    // An allocation whose backtrace shows no library counts as ours.
    let counts = owner.map_or(&OURS, |(_, counts)| counts);
    counts[role].fetch_add(1, Ordering::Relaxed);
    if std::ptr::eq(counts, &OURS) {
        PAYLOADS.fetch_add(u64::from(bytes >= LARGE_BYTES), Ordering::Relaxed);
        if let Ok(mut culprits) = CULPRITS.try_lock()
            && culprits.len() < 3
        {
            culprits.push(format!("{}: {bytes} bytes\n{backtrace}", ROLES[role]));
        }
    }
    ROLE.set(Some(role));
}

/// A bridge of one route and both lanes in this process, with a publisher and a subscriber of each lane.
struct Bench {
    boards: Boards,
    writer: RawWriter,
    reader: RawReader,
    noncritical: RawReader,
    _participants: [Participant; 2],
}

fn settings(folder: &Path) -> Settings {
    let path = folder.join("bridge.yaml");
    let text = format!(
        "ros: {{domain_id: {DOMAIN_ID}}}\nshared_memory: {{root_path: {}, max_sample_bytes: {}}}\n\
         routing_policy: {{noncritical_max_rate_hz: 100}}\n\
         topics:\n  - {{id: blob, input_topic: /in, critical_output: /out, noncritical_output: /slow}}\n",
        folder.display(),
        2 * LARGE_BYTES
    );
    std::fs::write(&path, text).unwrap();
    config::load(Some(&path), &|_| None).unwrap()
}

/// The id of the receiving thread of ingress, which must be the only role so far.
fn receiving_thread() -> i32 {
    let give_up = Instant::now() + Duration::from_secs(30);
    loop {
        let tasks = std::fs::read_dir("/proc/self/task").unwrap().map(|task| task.unwrap().path());
        // Names of threads are cut at 15 characters.
        let named = |task: &PathBuf| {
            std::fs::read_to_string(task.join("comm")).is_ok_and(|name| name.starts_with("RustDDS Partici"))
        };
        let found: Vec<PathBuf> = tasks.filter(named).collect();
        if let [task] = &found[..] {
            return task.file_name().unwrap().to_str().unwrap().parse().unwrap();
        }
        assert!(found.is_empty() && Instant::now() < give_up, "{found:?}");
        thread::sleep(Duration::from_millis(1));
    }
}

fn participant(name: &str) -> Participant {
    Participant::open(&ParticipantOptions {
        network: &DdsNetwork::of_domain(DOMAIN_ID),
        namespace: "/test".into(),
        node_name: name.into(),
        graph_gid_bytes: 16,
        dscp: 0,
    })
    .unwrap()
}

impl Bench {
    fn open(settings: &Settings) -> Self {
        let mut source = participant("source");
        let writer = source.create_writer("rt/in", TYPE, &QosProfile::CRITICAL, 256).unwrap();
        let mut sink = participant("sink");
        let qos = ReaderQos {
            reliability: Reliability::Reliable,
            durability: Durability::Volatile,
            depth: 64,
            deadline_ms: None,
        };
        let reader = sink.create_reader("rt/out", TYPE, &qos).unwrap();
        let qos = ReaderQos { reliability: Reliability::BestEffort, ..qos };
        let noncritical = sink.create_reader("rt/slow", TYPE, &qos).unwrap();
        let root = settings.shared_memory.root_path.clone().unwrap();
        let node = ShmNode::open(&root, &settings.instance, "test").unwrap();
        let boards = node.boards(&BridgeShape::of(settings)).unwrap();
        Self { boards, writer, reader, noncritical, _participants: [source, sink] }
    }

    /// Sends that many samples at 200 Hz, one when the one before it has arrived or 20 s are over, and
    /// returns how many arrived.
    fn send(&self, samples: usize, bytes: usize) -> usize {
        let mut arrived = 0;
        for sample in 0..samples {
            let payload = Bytes::from(vec![sample as u8; bytes]);
            let now = adaptive_bridge::clock::wall();
            let timestamp = SourceTimestamp::from_wall(WallNs(now.0));
            self.writer.write(payload, Encapsulation::CDR_LE, timestamp).unwrap();
            let give_up = Instant::now() + Duration::from_secs(20);
            thread::sleep(Duration::from_millis(5));
            while self.take_all(bytes) == 0 && Instant::now() < give_up {
                thread::sleep(Duration::from_millis(1));
            }
            arrived += usize::from(Instant::now() < give_up);
        }
        arrived
    }

    fn take_all(&self, bytes: usize) -> usize {
        // The noncritical lane may still send a sample of another size.
        while self.noncritical.take(&mut |_, _| {}) != Take::Empty {}
        let mut taken = 0;
        let mut lend = |payload: &[u8], _| assert_eq!(payload.len(), bytes);
        while self.reader.take(&mut lend) != Take::Empty {
            taken += 1;
        }
        taken
    }

    /// The counters of ingress and of both lanes, once no sample waits in a lane.
    fn counters(&self) -> (IngressCounters, [LaneCounters; 2]) {
        let give_up = Instant::now() + Duration::from_secs(30);
        loop {
            let ingress = self.boards.ingress(0).unwrap();
            let lanes = [0, 1].map(|lane| self.boards.lane(lane, 0).unwrap());
            let settled = |lane: &LaneCounters| lane.forwarded + lane.drops.total() == ingress.published;
            if lanes.iter().all(settled) {
                return (ingress, lanes);
            }
            assert!(Instant::now() < give_up, "{ingress:?} {lanes:?}");
            thread::sleep(Duration::from_millis(1));
        }
    }
}

/// What some samples in steady state cost.
struct Cost {
    /// Allocations of ours, by role.
    ours: [u64; 3],
    /// Samples that were assembled in the pool.
    in_place: u64,
    /// Samples that each lane forwarded.
    forwarded: [u64; 2],
    /// Those of them that it forwarded by reference.
    by_reference: [u64; 2],
    /// Samples that the critical lane began to send while they arrived.
    begun_early: u64,
}

fn measure(bench: &Bench, samples: usize, bytes: usize) -> Cost {
    let (ingress_before, lanes_before) = bench.counters();
    let before = [0, 1, 2].map(|role: usize| OURS[role].load(Ordering::Relaxed));
    COUNTING.store(true, Ordering::SeqCst);
    let arrived = bench.send(samples, bytes);
    let (ingress, lanes) = bench.counters();
    COUNTING.store(false, Ordering::SeqCst);
    assert_eq!(arrived, samples, "samples of {bytes} bytes did not arrive");
    assert_eq!(ingress.published - ingress_before.published, samples as u64);
    let in_lanes = |count: fn(&LaneCounters) -> u64| {
        [0, 1].map(|lane: usize| count(&lanes[lane]) - count(&lanes_before[lane]))
    };
    Cost {
        ours: [0, 1, 2].map(|role| OURS[role].load(Ordering::Relaxed) - before[role]),
        in_place: ingress.in_place - ingress_before.in_place,
        forwarded: in_lanes(|lane| lane.forwarded),
        by_reference: in_lanes(|lane| lane.by_reference),
        begun_early: in_lanes(|lane| lane.begun_early)[0],
    }
}

fn culprits() -> String {
    CULPRITS.lock().map(|culprits| culprits.join("\n")).unwrap_or_default()
}

/// The reload requests of a role, as in the program; no test sends one.
fn reloads(settings: &Settings) -> ReloadRequests {
    let settings = settings.clone();
    ReloadRequests::on_signal(move |_| Ok(settings.clone().into())).unwrap()
}

#[test]
fn in_steady_state_no_step_of_ours_allocates_and_large_payloads_are_not_copied() {
    let folder = tempfile::tempdir().unwrap();
    let settings = settings(folder.path());
    let stop = Stop::default();
    thread::scope(|scope| {
        let (settings, stop) = (&settings, &stop);
        scope.spawn(move || {
            ROLE.set(Some(0));
            process::ingress(settings, reloads(settings), stop).unwrap();
        });
        RECEIVING_THREAD.store(receiving_thread(), Ordering::SeqCst);
        for (index, lane) in LANES.into_iter().enumerate() {
            scope.spawn(move || {
                ROLE.set(Some(1 + index));
                process::egress(settings, lane, reloads(settings), stop).unwrap();
            });
        }
        // Stops the roles also when an assertion fails; otherwise the scope would wait for them for ever.
        let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| check(settings)));
        stop.request();
        if let Err(panic) = outcome {
            std::panic::resume_unwind(panic);
        }
    });
}

fn check(settings: &Settings) {
    let bench = Bench::open(settings);
    // Waits for discovery, then sends until each buffer that is reused has been allocated.
    let give_up = Instant::now() + Duration::from_secs(30);
    while bench.send(1, SMALL_BYTES) == 0 {
        assert!(Instant::now() < give_up, "nothing arrives");
    }
    for bytes in [LARGE_BYTES, SMALL_BYTES] {
        bench.send(600, bytes.min(SMALL_BYTES));
        bench.send(40, bytes);
    }

    let small = measure(&bench, 1_000, SMALL_BYTES);
    assert_eq!(small.ours, [0; 3], "allocations for 1,000 small samples, by {ROLES:?}:\n{}", culprits());
    // One copy into shared memory, one for DDS.
    assert_eq!((small.in_place, small.forwarded[0], small.by_reference), (0, 1_000, [0; 2]));
    // At 100 of 200 Hz; without samples the lane would allocate nothing in any case.
    assert!(small.forwarded[1] >= 100, "the noncritical lane forwarded {:?}", small.forwarded);

    let large = measure(&bench, 60, LARGE_BYTES);
    // A slot that is lent takes one handle, of some 100 bytes, and so does a payload that is handed over by
    // reference (`Bytes::from_owner`), once more if it was begun early.
    let handles = [large.in_place, large.by_reference[0] + large.begun_early, large.by_reference[1]];
    assert_eq!(large.ours, handles, "allocations for 60 large samples, by {ROLES:?}:\n{}", culprits());
    // No copy, and nothing was allocated that could hold one.
    assert_eq!((large.in_place, large.forwarded[0]), (60, 60));
    assert!(large.forwarded[1] >= 6, "the noncritical lane forwarded {:?}", large.forwarded);
    assert_eq!(large.by_reference, large.forwarded);
    assert_eq!(PAYLOADS.load(Ordering::Relaxed), 0, "{}", culprits());

    let of = |counts: &[AtomicU64; 3]| [0, 1, 2].map(|role: usize| counts[role].load(Ordering::Relaxed));
    let (dds, shared_memory) = (of(&DDS), of(&SHARED_MEMORY));
    println!("allocations in 1,060 samples by {ROLES:?}: DDS library {dds:?}, iceoryx2 {shared_memory:?}");
    // iceoryx2 itself allocates a handle for each slot that it lends; the bridge's service variant
    // (shm/service.rs) does not.
    assert_eq!(shared_memory, [0, 0, 0]);
    // Shows that allocations were counted.
    assert!(dds.into_iter().all(|allocations| allocations > 0), "{dds:?}");
}
