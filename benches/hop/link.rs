//! The programs around and beside the bridge: publisher, subscriber, relay. Each is this binary, started with
//! a hidden argument, takes its orders line by line on stdin and answers on stdout.

use std::collections::VecDeque;
use std::io::{self, BufRead, Write};
use std::path::Path;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, TryRecvError, channel};
use std::task::{Wake, Waker};
use std::thread::Thread;
use std::time::Duration;

use adaptive_bridge::clock;
use adaptive_bridge::config::{self, DdsNetwork};
use adaptive_bridge::dds::{
    Participant, ParticipantOptions, RawReader, RawWriter, ReaderQos, Take, WriterEvent,
};
use adaptive_bridge::model::{Durability, Encapsulation, History, QosProfile, Reliability, SourceTimestamp};
use adaptive_bridge::shm::{Boards, BridgeShape, ShmNode};
use bytes::{Bytes, BytesMut};

use super::system::{self, Place, sleep_until};

/// One topic, by the largest sample that it carries.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Route {
    pub index: usize,
    pub max_sample_bytes: usize,
}

/// The payloads of a laser scan; others are point clouds. The bridge never looks, only the names differ.
const SCAN_BYTES: usize = 4096;

impl Route {
    /// Those with these largest samples.
    pub fn all(sizes: &[usize]) -> Vec<Self> {
        sizes.iter().enumerate().map(|(index, &max_sample_bytes)| Self { index, max_sample_bytes }).collect()
    }

    pub fn id(self) -> String {
        format!("r{}", self.index)
    }

    pub const fn message_type(self) -> &'static str {
        if self.max_sample_bytes <= SCAN_BYTES {
            "sensor_msgs/msg/LaserScan"
        } else {
            "sensor_msgs/msg/PointCloud2"
        }
    }

    const fn dds_type(self) -> &'static str {
        if self.max_sample_bytes <= SCAN_BYTES {
            "sensor_msgs::msg::dds_::LaserScan_"
        } else {
            "sensor_msgs::msg::dds_::PointCloud2_"
        }
    }

    /// Samples that may wait in a reader: as ingress has it, 32 MiB at most, 16 to 1,024 samples.
    fn reader_depth(self) -> u32 {
        ((32 << 20) / self.max_sample_bytes).clamp(16, 1024) as u32
    }

    /// As they cross the command line: their sizes.
    pub fn to_argument(routes: &[Self]) -> String {
        routes.iter().map(|route| route.max_sample_bytes.to_string()).collect::<Vec<_>>().join(",")
    }

    fn parse(text: &str) -> Result<Vec<Self>, String> {
        let sizes: Result<Vec<usize>, _> = text.split(',').map(str::parse).collect();
        Ok(Self::all(&sizes.map_err(|_| format!("{text} are no sizes"))?))
    }
}

/// The ROS 2 topics before and after relay or bridge.
pub const INPUT: &str = "/bench/in/";
pub const OUTPUT: &str = "/bench/critical/";

/// What may be unacknowledged, on every RELIABLE writer of the bench and in the bridge (its default).
const WINDOW_SAMPLES: usize = 256;

/// What a payload begins with: its number, when it was due, when it was written; its number is at the end
/// too.
const STAMPS: usize = 24;

/// What the subscriber records of one sample. Instants of CLOCK_MONOTONIC in nanoseconds; 0 is unknown.
#[derive(Clone, Copy, Debug, Default)]
pub struct Record {
    pub number: u64,
    pub due_at: u64,
    pub written_at: u64,
    pub arrived_at: u64,
    /// When ingress took it.
    pub taken_at: u64,
    /// When the lane began to hand it to its DDS writer.
    pub handed_at: u64,
}

/// From one instant to another in microseconds; `NaN` if one is not known.
fn us(from: u64, to: u64) -> f64 {
    if from == 0 || to == 0 { f64::NAN } else { (to as f64 - from as f64) / 1_000.0 }
}

impl Record {
    /// How much later than it was due it was written.
    pub fn late_us(&self) -> f64 {
        us(self.due_at, self.written_at)
    }

    pub fn latency_us(&self) -> f64 {
        us(self.written_at, self.arrived_at)
    }

    pub fn since_due_us(&self) -> f64 {
        us(self.due_at, self.arrived_at)
    }

    pub fn dds_in_us(&self) -> f64 {
        us(self.written_at, self.taken_at)
    }

    pub fn dds_out_us(&self) -> f64 {
        us(self.handed_at, self.arrived_at)
    }
}

/// Runs the program that the hidden argument names.
pub fn run(role: &str, arguments: &[String]) -> ExitCode {
    let outcome = match role {
        "__publisher" => publisher(arguments),
        "__subscriber" => subscriber(arguments),
        "__relay" => relay(arguments),
        "__drain" => drain(arguments),
        "__spinner" => system::slice_of_a_noncritical_lane().and_then(|()| spin()),
        other => Err(format!("no such role: {other}")),
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("bench {role}: {error}");
            ExitCode::FAILURE
        }
    }
}

fn argument(arguments: &[String], index: usize) -> Result<&str, String> {
    arguments.get(index).map(String::as_str).ok_or_else(|| format!("argument {index} is missing"))
}

fn join(arguments: &[String], name: &str) -> Result<Participant, String> {
    let place = Place::parse(argument(arguments, 1)?)?;
    place.apply();
    place.lock_memory();
    let domain_id = argument(arguments, 0)?.parse().map_err(|_| "the first argument is the domain")?;
    Participant::open(&ParticipantOptions {
        network: &DdsNetwork { domain_id, interfaces: Vec::new() },
        namespace: "/bench".to_owned(),
        node_name: name.to_owned(),
        graph_gid_bytes: 16,
    })
    .map_err(|error| error.to_string())
}

fn writer(participant: &mut Participant, prefix: &str, route: Route) -> Result<RawWriter, String> {
    let qos = QosProfile { history: History::KeepLast { depth: 10 }, ..QosProfile::CRITICAL };
    participant
        .create_writer(&format!("rt{prefix}{}", route.id()), route.dds_type(), &qos, WINDOW_SAMPLES)
        .map_err(|error| error.to_string())
}

fn reader(
    participant: &mut Participant,
    prefix: &str,
    route: Route,
    reliability: Reliability,
) -> Result<RawReader, String> {
    let qos = ReaderQos {
        reliability,
        durability: Durability::Volatile,
        depth: route.reader_depth(),
        deadline_ms: None,
    };
    participant
        .create_reader(&format!("rt{prefix}{}", route.id()), route.dds_type(), &qos)
        .map_err(|error| error.to_string())
}

/// Waits for each writer to have a reader.
fn wait_matched(writers: &[&RawWriter]) -> Result<(), String> {
    let give_up_at = clock::monotonic().plus_ms(20_000);
    for writer in writers {
        loop {
            match writer.poll_event() {
                Some(WriterEvent::Matched { joined: true, .. }) => break,
                Some(_) => {}
                None => std::thread::sleep(Duration::from_millis(5)),
            }
            if clock::monotonic() > give_up_at {
                return Err("no reader within 20 s".to_owned());
            }
        }
    }
    Ok(())
}

fn say(line: &str) {
    let mut out = io::stdout().lock();
    let _ = writeln!(out, "{line}");
    let _ = out.flush();
}

/// Sends when told: `send FIRST_ROUTE ROUTES RATE_HZ SAMPLES BYTES FIRST_NUMBER`, one route after the other,
/// answered by `sent ACCEPTED REFUSED`.
fn publisher(arguments: &[String]) -> Result<(), String> {
    let mut participant = join(arguments, "publisher")?;
    let mut writers = Vec::new();
    for route in Route::parse(argument(arguments, 2)?)? {
        writers.push((writer(&mut participant, INPUT, route)?, Arena::new(route)));
    }
    wait_matched(&writers.iter().map(|(writer, _)| writer).collect::<Vec<_>>())?;
    say("ready");
    for line in io::stdin().lock().lines() {
        let line = line.map_err(|error| error.to_string())?;
        let words: Option<Vec<u64>> = line
            .strip_prefix("send ")
            .and_then(|numbers| numbers.split(' ').map(|word| word.parse().ok()).collect());
        let Some([first_route, routes, rate_hz, samples, bytes, first]) = words.as_deref() else {
            return Err(format!("not an order: {line}"));
        };
        let (first_route, routes, bytes) = (*first_route as usize, *routes as usize, *bytes as usize);
        let chosen = writers.get_mut(first_route..first_route + routes).ok_or("no such route")?;
        let (mut accepted, mut refused) = (0u64, 0u64);
        let start = clock::monotonic().0 + 20_000_000;
        for sample in 0..*samples {
            let (writer, arena) = &mut chosen[sample as usize % routes];
            let due_at = start + sample * 1_000_000_000 / rate_hz;
            let mut payload = arena.buffer(bytes);
            payload[..8].copy_from_slice(&(first + sample).to_ne_bytes());
            payload[8..16].copy_from_slice(&due_at.to_ne_bytes());
            payload[bytes - 8..].copy_from_slice(&(first + sample).to_ne_bytes());
            sleep_until(due_at);
            let timestamp = SourceTimestamp::from_wall(clock::wall());
            payload[16..24].copy_from_slice(&clock::monotonic().0.to_ne_bytes());
            match writer.write(payload.freeze(), Encapsulation::CDR_LE, timestamp) {
                Ok(_) => accepted += 1,
                Err(_) => refused += 1,
            }
        }
        say(&format!("sent {accepted} {refused}"));
    }
    Ok(())
}

/// Rung by the DDS library when a sample arrives, as in the bridge's ingress.
struct Bell {
    rung: AtomicBool,
    thread: Thread,
}

impl Bell {
    fn new() -> Arc<Self> {
        Arc::new(Self { rung: AtomicBool::new(true), thread: std::thread::current() })
    }
}

impl Wake for Bell {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.rung.store(true, Ordering::Release);
        self.thread.unpark();
    }
}

/// A reader with its bell.
struct Inlet {
    reader: RawReader,
    bell: Arc<Bell>,
    waker: Waker,
}

impl Inlet {
    fn new(reader: RawReader) -> Self {
        let bell = Bell::new();
        Self { reader, waker: Waker::from(Arc::clone(&bell)), bell }
    }

    /// Takes one sample, if one is there; `None` when none is, and then the bell is armed.
    fn take(&self, lend: &mut dyn FnMut(&[u8], Encapsulation)) -> Option<SourceTimestamp> {
        if !self.bell.rung.load(Ordering::Acquire) {
            return None;
        }
        let mut take = self.reader.take(lend);
        if take == Take::Empty {
            self.bell.rung.store(false, Ordering::Release);
            self.reader.arm(&self.waker);
            take = self.reader.take(lend);
        }
        match take {
            Take::Sample(origin) => {
                self.bell.rung.store(true, Ordering::Release);
                Some(origin.source_timestamp)
            }
            Take::Malformed | Take::Empty => None,
        }
    }
}

/// Records when told: `begin`, then `end SAMPLES PATIENCE_MS`, which waits for so many, or until none has
/// come for so long, and is answered by `samples N DAMAGED` and a line for each.
fn subscriber(arguments: &[String]) -> Result<(), String> {
    let mut participant = join(arguments, "subscriber")?;
    let (boards, _node) = match arguments.get(4) {
        Some(path) => Some(boards(Path::new(path))?),
        None => None,
    }
    .unzip();
    let prefix = argument(arguments, 3)?.to_owned();
    let mut inlets = Vec::new();
    for route in Route::parse(argument(arguments, 2)?)? {
        let reader = reader(&mut participant, &prefix, route, Reliability::Reliable)?;
        inlets.push((route.index, Inlet::new(reader)));
    }
    let orders = orders();
    let mut records: Vec<Record> = Vec::with_capacity(200_000);
    let mut damaged = 0u64;
    let mut ending: Option<(usize, u64)> = None;
    let mut last_at = clock::monotonic();
    say("ready");
    loop {
        for (route, inlet) in &inlets {
            loop {
                let mut record = Record::default();
                let mut whole = false;
                let taken = inlet.take(&mut |payload, _| {
                    record.arrived_at = clock::monotonic().0;
                    whole = read_stamps(payload, &mut record);
                });
                if taken.is_none() {
                    break;
                }
                last_at = clock::monotonic();
                if let Some(boards) = &boards {
                    look_at_boards(boards, *route, &mut record);
                }
                damaged += u64::from(!whole);
                records.push(record);
            }
        }
        match orders.try_recv() {
            Ok(order) => {
                let words: Vec<&str> = order.split(' ').collect();
                match words[..] {
                    ["begin"] => {
                        records.clear();
                        damaged = 0;
                    }
                    ["end", samples, patience_ms] => {
                        let number = |text: &str| text.parse::<u64>().map_err(|_| format!("in: {order}"));
                        last_at = clock::monotonic();
                        ending = Some((number(samples)? as usize, number(patience_ms)?));
                    }
                    _ => return Err(format!("not an order: {order}")),
                }
            }
            Err(TryRecvError::Empty) => {}
            Err(TryRecvError::Disconnected) => return Ok(()),
        }
        if let Some((samples, patience_ms)) = ending {
            let waited_ms = clock::monotonic().since(last_at) / 1_000_000;
            if records.len() >= samples || waited_ms > patience_ms {
                ending = None;
                let mut answer = format!("samples {} {damaged}\n", records.len());
                for r in &records {
                    answer.push_str(&format!(
                        "{} {} {} {} {} {}\n",
                        r.number, r.due_at, r.written_at, r.arrived_at, r.taken_at, r.handed_at
                    ));
                }
                say(answer.trim_end());
            }
        }
        std::thread::park_timeout(Duration::from_millis(100));
    }
}

/// Fills in what the payload says; whether it is whole.
fn read_stamps(payload: &[u8], record: &mut Record) -> bool {
    let word = |at: usize| payload.get(at..at + 8)?.try_into().ok().map(u64::from_ne_bytes);
    let (Some(number), Some(due_at), Some(written_at)) = (word(0), word(8), word(16)) else {
        return false;
    };
    (record.number, record.due_at, record.written_at) = (number, due_at, written_at);
    payload.len() >= STAMPS + 8 && word(payload.len() - 8) == Some(number)
}

/// The stages of the sample that just came, if the boards still speak of it: after its arrival was stamped,
/// so this costs nothing that is measured.
fn look_at_boards(boards: &Boards, route: usize, record: &mut Record) {
    let between = |at: u64| if at > record.written_at && at < record.arrived_at { at } else { 0 };
    record.taken_at = boards.ingress(route).map_or(0, |ingress| between(ingress.last_received_at.0));
    record.handed_at = boards.lane(0, route).map_or(0, |lane| between(lane.last_forwarded_at.0));
}

/// The boards of the bridge with that configuration, and the membership in it: whoever leaves last removes
/// the bridge's files, so it is to last as long as the boards are read.
pub fn boards(config: &Path) -> Result<(Boards, ShmNode), String> {
    let settings = config::load(Some(config), &|_| None).map_err(|error| error.to_string())?;
    let root = settings.shared_memory.root_path.clone().ok_or("the configuration names no root")?;
    let node = ShmNode::open(&root, &settings.instance, "bench").map_err(|error| error.to_string())?;
    let boards = node.boards(&BridgeShape::of(&settings)).map_err(|error| error.to_string())?;
    Ok((boards, node))
}

/// Lines of stdin, each announced to the calling thread.
fn orders() -> Receiver<String> {
    let (sender, receiver) = channel();
    let thread = std::thread::current();
    std::thread::spawn(move || {
        for line in io::stdin().lock().lines().map_while(Result::ok) {
            if sender.send(line).is_err() {
                break;
            }
            thread.unpark();
        }
        drop(sender);
        thread.unpark();
    });
    receiver
}

/// Reads and writes with the DDS library in one process, without shared memory: what the bridge's hop is
/// measured against. An ordinary program against the library's ordinary interface: woken by the library
/// when a sample arrives, it drains its readers on a thread of its own. (Ingress takes samples on the
/// library's receiving thread, and lends the library memory for large ones: extensions of ours.) It is not
/// made slow for it: the same library with the same changes, a copy into an arena (the library lends what
/// it received and keeps what it sends, so one copy there must be), no allocation for each sample.
fn relay(arguments: &[String]) -> Result<(), String> {
    let mut participant = join(arguments, "relay")?;
    let mut lines = Vec::new();
    for route in Route::parse(argument(arguments, 2)?)? {
        let outlet = writer(&mut participant, OUTPUT, route)?;
        let inlet = Inlet::new(reader(&mut participant, INPUT, route, Reliability::Reliable)?);
        lines.push((inlet, outlet, Arena::new(route)));
    }
    let orders = orders();
    say("ready");
    let mut refused = 0u64;
    loop {
        for (inlet, outlet, arena) in &mut lines {
            loop {
                let mut copy = None;
                let taken = inlet.take(&mut |payload, encapsulation| {
                    copy = Some((arena.copy(payload), encapsulation));
                });
                let (Some(timestamp), Some((payload, encapsulation))) = (taken, copy) else { break };
                if outlet.write(payload, encapsulation, timestamp).is_err() {
                    refused += 1;
                }
            }
        }
        match orders.try_recv() {
            Ok(order) if order == "refused" => {
                say(&format!("refused {refused}"));
                refused = 0;
            }
            Ok(order) => return Err(format!("not an order: {order}")),
            Err(TryRecvError::Empty) => {}
            Err(TryRecvError::Disconnected) => return Ok(()),
        }
        std::thread::park_timeout(Duration::from_millis(100));
    }
}

/// Subscribes to what noncritical lanes send, on topics that begin with one of the prefixes, and forgets it.
fn drain(arguments: &[String]) -> Result<(), String> {
    let mut participant = join(arguments, "drain")?;
    let mut inlets = Vec::new();
    for prefix in argument(arguments, 3)?.split(',') {
        for route in Route::parse(argument(arguments, 2)?)? {
            inlets.push(Inlet::new(reader(&mut participant, prefix, route, Reliability::BestEffort)?));
        }
    }
    let orders = orders();
    say("ready");
    loop {
        for inlet in &inlets {
            while inlet.take(&mut |_, _| {}).is_some() {}
        }
        if orders.try_recv() == Err(TryRecvError::Disconnected) {
            return Ok(());
        }
        std::thread::park_timeout(Duration::from_millis(100));
    }
}

/// Burns every CPU until standard input ends: as many threads as there are, in a loop that does nothing.
fn spin() -> Result<(), String> {
    for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
        std::thread::spawn(|| {
            loop {
                std::hint::spin_loop();
            }
        });
    }
    say("ready");
    for _ in io::stdin().lock().lines() {}
    Ok(())
}

/// Buffers that are used again when the DDS library has let go of what was in them.
struct Arena {
    chunk_bytes: usize,
    current: BytesMut,
    filled: VecDeque<BytesMut>,
}

impl Arena {
    fn new(route: Route) -> Self {
        let chunk_bytes = route.max_sample_bytes.max(256 * 1024);
        Self { chunk_bytes, current: BytesMut::with_capacity(chunk_bytes), filled: VecDeque::new() }
    }

    fn reserve(&mut self, bytes: usize) {
        if self.current.capacity() - self.current.len() >= bytes {
            return;
        }
        let reclaimed = self.filled.front_mut().is_some_and(|oldest| oldest.try_reclaim(self.chunk_bytes));
        let next = match reclaimed.then(|| self.filled.pop_front()).flatten() {
            Some(oldest) => oldest,
            None => BytesMut::with_capacity(self.chunk_bytes),
        };
        self.filled.push_back(std::mem::replace(&mut self.current, next));
    }

    fn copy(&mut self, payload: &[u8]) -> Bytes {
        self.reserve(payload.len());
        self.current.extend_from_slice(payload);
        self.current.split().freeze()
    }

    /// A buffer of that length, to be filled.
    fn buffer(&mut self, bytes: usize) -> BytesMut {
        self.reserve(bytes);
        self.current.resize(bytes, 0x5a);
        self.current.split()
    }
}
