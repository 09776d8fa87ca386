//! The programs of the test beds: publisher, subscriber, relay, drain and spinner. Each runs this binary with
//! a hidden argument, reads commands line by line from stdin and answers on stdout.

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
use adaptive_bridge::dds::{Participant, ParticipantOptions, RawReader, RawWriter, ReaderQos, Take};
use adaptive_bridge::model::{Durability, Encapsulation, History, QosProfile, Reliability, SourceTimestamp};
use adaptive_bridge::shm::{Boards, BridgeShape, ShmNode};
use bytes::{Bytes, BytesMut};

use super::system::{self, Place, sleep_until};

/// One topic, with the size of its largest sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Route {
    pub index: usize,
    pub max_sample_bytes: usize,
}

/// The largest sample of routes of type LaserScan; routes with larger ones are of type PointCloud2. Only the
/// type names differ, because the bridge does not interpret payloads.
const SCAN_BYTES: usize = 4096;

impl Route {
    /// Routes with these largest samples.
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

    pub const fn dds_type(self) -> &'static str {
        if self.max_sample_bytes <= SCAN_BYTES {
            "sensor_msgs::msg::dds_::LaserScan_"
        } else {
            "sensor_msgs::msg::dds_::PointCloud2_"
        }
    }

    /// The history depth of readers, as of ingress: at most 32 MiB, but 16 to 1,024 samples.
    fn reader_depth(self) -> u32 {
        ((32 << 20) / self.max_sample_bytes).clamp(16, 1024) as u32
    }

    /// The routes as a command-line argument: their sizes.
    pub fn to_argument(routes: &[Self]) -> String {
        routes.iter().map(|route| route.max_sample_bytes.to_string()).collect::<Vec<_>>().join(",")
    }

    fn parse(text: &str) -> Result<Vec<Self>, String> {
        let sizes: Result<Vec<usize>, _> = text.split(',').map(str::parse).collect();
        Ok(Self::all(&sizes.map_err(|_| format!("{text} is not a list of sizes"))?))
    }
}

/// The prefix of the input topics.
pub const INPUT: &str = "/bench/in/";
/// The prefix of the output topics of relay and bridge.
pub const OUTPUT: &str = "/bench/critical/";

/// The highest number of unacknowledged samples of each RELIABLE writer of the bench, the default of the
/// bridge.
const WINDOW_SAMPLES: usize = 256;

/// The bytes of the stamps at the beginning of a payload: sample number, due time, write time. The number is
/// also at the end.
const STAMPS: usize = 24;

/// The record of one received sample. Times are of CLOCK_MONOTONIC in nanoseconds; 0 is unknown.
#[derive(Clone, Copy, Debug, Default)]
pub struct Record {
    pub number: u64,
    pub due_at: u64,
    pub written_at: u64,
    pub arrived_at: u64,
    /// When ingress took it from DDS.
    pub taken_at: u64,
    /// When the lane began to hand it to its DDS writer.
    pub handed_at: u64,
}

/// The time from one instant to another in microseconds; `NaN` if one is unknown.
fn us(from: u64, to: u64) -> f64 {
    if from == 0 || to == 0 { f64::NAN } else { (to as f64 - from as f64) / 1_000.0 }
}

impl Record {
    /// The delay of the write after the due time.
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
        "__spinner" => system::set_noncritical_time_slice().and_then(|()| spin()),
        other => Err(format!("unknown role: {other}")),
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
    let domain_id = argument(arguments, 0)?.parse().map_err(|_| "the first argument must be the domain")?;
    Participant::open(&ParticipantOptions {
        network: &DdsNetwork::of_domain(domain_id),
        namespace: "/bench".to_owned(),
        node_name: name.to_owned(),
        graph_gid_bytes: 16,
        dscp: 0,
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

/// Waits until each writer has matched a reader.
fn wait_matched(writers: &[&RawWriter]) -> Result<(), String> {
    let give_up_at = clock::monotonic().plus_ms(20_000);
    for writer in writers {
        while writer.matched_readers().next().is_none() {
            if clock::monotonic() > give_up_at {
                return Err("a writer has matched no reader within 20 s".to_owned());
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }
    Ok(())
}

/// Writes an answer to stdout.
fn answer(line: &str) {
    let mut out = io::stdout().lock();
    let _ = writeln!(out, "{line}");
    let _ = out.flush();
}

/// The publisher. The command `send FIRST_ROUTE ROUTES RATE_HZ SAMPLES BYTES FIRST_NUMBER` sends samples on
/// the routes in turn; the answer is `sent ACCEPTED REFUSED`.
fn publisher(arguments: &[String]) -> Result<(), String> {
    let mut participant = join(arguments, "publisher")?;
    let mut writers = Vec::new();
    for route in Route::parse(argument(arguments, 2)?)? {
        writers.push((writer(&mut participant, INPUT, route)?, Arena::new(route)));
    }
    wait_matched(&writers.iter().map(|(writer, _)| writer).collect::<Vec<_>>())?;
    answer("ready");
    for line in io::stdin().lock().lines() {
        let line = line.map_err(|error| error.to_string())?;
        let words: Option<Vec<u64>> = line
            .strip_prefix("send ")
            .and_then(|numbers| numbers.split(' ').map(|word| word.parse().ok()).collect());
        let Some([first_route, routes, rate_hz, samples, bytes, first]) = words.as_deref() else {
            return Err(format!("unknown command: {line}"));
        };
        let (first_route, routes, bytes) = (*first_route as usize, *routes as usize, *bytes as usize);
        let chosen =
            writers.get_mut(first_route..first_route + routes).ok_or("the command names an unknown route")?;
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
        answer(&format!("sent {accepted} {refused}"));
    }
    Ok(())
}

/// The waker of a reader: the DDS library wakes it when a sample arrives.
struct WakeFlag {
    is_set: AtomicBool,
    thread: Thread,
}

impl WakeFlag {
    fn new() -> Arc<Self> {
        Arc::new(Self { is_set: AtomicBool::new(true), thread: std::thread::current() })
    }
}

impl Wake for WakeFlag {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        self.is_set.store(true, Ordering::Release);
        self.thread.unpark();
    }
}

/// A reader that wakes the calling thread when a sample arrives.
struct WakingReader {
    reader: RawReader,
    wake_flag: Arc<WakeFlag>,
    waker: Waker,
}

impl WakingReader {
    fn new(reader: RawReader) -> Self {
        let wake_flag = WakeFlag::new();
        Self { reader, waker: Waker::from(Arc::clone(&wake_flag)), wake_flag }
    }

    /// Takes one sample; without one, arms the waker and returns `None`.
    fn take(&self, lend: &mut dyn FnMut(&[u8], Encapsulation)) -> Option<SourceTimestamp> {
        if !self.wake_flag.is_set.load(Ordering::Acquire) {
            return None;
        }
        let mut take = self.reader.take(lend);
        if take == Take::Empty {
            self.wake_flag.is_set.store(false, Ordering::Release);
            self.reader.arm(&self.waker);
            take = self.reader.take(lend);
        }
        match take {
            Take::Sample(origin) => {
                self.wake_flag.is_set.store(true, Ordering::Release);
                Some(origin.source_timestamp)
            }
            Take::Malformed | Take::Empty => None,
        }
    }
}

/// The subscriber. The command `begin` starts a recording; `end SAMPLES TIMEOUT_MS` ends it when that many
/// samples have arrived or none has arrived for the timeout. The answer is `samples N DAMAGED` and a line for
/// each sample.
fn subscriber(arguments: &[String]) -> Result<(), String> {
    let mut participant = join(arguments, "subscriber")?;
    let (boards, _node) = match arguments.get(4) {
        Some(path) => Some(boards(Path::new(path))?),
        None => None,
    }
    .unzip();
    let prefix = argument(arguments, 3)?.to_owned();
    let mut readers = Vec::new();
    for route in Route::parse(argument(arguments, 2)?)? {
        let reader = reader(&mut participant, &prefix, route, Reliability::Reliable)?;
        readers.push((route.index, WakingReader::new(reader)));
    }
    let commands = commands();
    let mut records: Vec<Record> = Vec::with_capacity(200_000);
    let mut damaged = 0u64;
    let mut ending: Option<(usize, u64)> = None;
    let mut last_at = clock::monotonic();
    answer("ready");
    loop {
        for (route, reader) in &readers {
            loop {
                let mut record = Record::default();
                let mut undamaged = false;
                let taken = reader.take(&mut |payload, _| {
                    record.arrived_at = clock::monotonic().0;
                    undamaged = read_stamps(payload, &mut record);
                });
                if taken.is_none() {
                    break;
                }
                last_at = clock::monotonic();
                if let Some(boards) = &boards {
                    read_board_times(boards, *route, &mut record);
                }
                damaged += u64::from(!undamaged);
                records.push(record);
            }
        }
        match commands.try_recv() {
            Ok(command) => {
                let words: Vec<&str> = command.split(' ').collect();
                match words[..] {
                    ["begin"] => {
                        records.clear();
                        damaged = 0;
                    }
                    ["end", samples, timeout_ms] => {
                        let number =
                            |text: &str| text.parse::<u64>().map_err(|_| format!("{text} in: {command}"));
                        last_at = clock::monotonic();
                        ending = Some((number(samples)? as usize, number(timeout_ms)?));
                    }
                    _ => return Err(format!("unknown command: {command}")),
                }
            }
            Err(TryRecvError::Empty) => {}
            Err(TryRecvError::Disconnected) => return Ok(()),
        }
        if let Some((samples, timeout_ms)) = ending {
            let waited_ms = clock::monotonic().since(last_at) / 1_000_000;
            if records.len() >= samples || waited_ms > timeout_ms {
                ending = None;
                let mut text = format!("samples {} {damaged}\n", records.len());
                for r in &records {
                    text.push_str(&format!(
                        "{} {} {} {} {} {}\n",
                        r.number, r.due_at, r.written_at, r.arrived_at, r.taken_at, r.handed_at
                    ));
                }
                answer(text.trim_end());
            }
        }
        std::thread::park_timeout(Duration::from_millis(100));
    }
}

/// Copies the stamps of a payload to its record; returns whether the payload is undamaged.
fn read_stamps(payload: &[u8], record: &mut Record) -> bool {
    let word = |at: usize| payload.get(at..at + 8)?.try_into().ok().map(u64::from_ne_bytes);
    let (Some(number), Some(due_at), Some(written_at)) = (word(0), word(8), word(16)) else {
        return false;
    };
    (record.number, record.due_at, record.written_at) = (number, due_at, written_at);
    payload.len() >= STAMPS + 8 && word(payload.len() - 8) == Some(number)
}

/// Adds the times at ingress and the lane to the record of a sample, if the boards still have those of this
/// sample. It is called after the arrival is stamped, so it adds nothing to the measured latency.
fn read_board_times(boards: &Boards, route: usize, record: &mut Record) {
    let between = |at: u64| if at > record.written_at && at < record.arrived_at { at } else { 0 };
    record.taken_at = boards.ingress(route).map_or(0, |ingress| between(ingress.last_received_at.0));
    record.handed_at = boards.lane(0, route).map_or(0, |lane| between(lane.last_forwarded_at.0));
}

/// Opens the boards of the bridge with a configuration file. The node must live as long as the boards are
/// read: when the last node closes, it removes the bridge's files.
pub fn boards(config: &Path) -> Result<(Boards, ShmNode), String> {
    let settings = config::load(Some(config), &|_| None).map_err(|error| error.to_string())?;
    let root =
        settings.shared_memory.root_path.clone().ok_or("the configuration has no shared_memory.root_path")?;
    let node = ShmNode::open(&root, &settings.instance, "bench").map_err(|error| error.to_string())?;
    let boards = node.boards(&BridgeShape::of(&settings)).map_err(|error| error.to_string())?;
    Ok((boards, node))
}

/// Reads commands from stdin on another thread, which unparks the calling thread for each.
fn commands() -> Receiver<String> {
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

/// The relay, the reference for the bridge's hop: reads and writes with the DDS library in one process,
/// without shared memory. It uses only the library's ordinary interface: the library wakes its thread when a
/// sample arrives, and the thread takes all samples of its readers. (Ingress uses two extensions of the
/// patched library: it takes samples on the library's receive thread, and lends it memory for large ones.)
/// Otherwise it is as fast as possible: it uses the same patched library, allocates nothing per sample, and
/// copies each sample once into an arena, which cannot be avoided because the library only lends received
/// samples and keeps sent ones.
fn relay(arguments: &[String]) -> Result<(), String> {
    let mut participant = join(arguments, "relay")?;
    let mut routes = Vec::new();
    for route in Route::parse(argument(arguments, 2)?)? {
        let writer = writer(&mut participant, OUTPUT, route)?;
        let reader = WakingReader::new(reader(&mut participant, INPUT, route, Reliability::Reliable)?);
        routes.push((reader, writer, Arena::new(route)));
    }
    let commands = commands();
    answer("ready");
    let mut refused = 0u64;
    loop {
        for (reader, writer, arena) in &mut routes {
            loop {
                let mut copy = None;
                let taken = reader.take(&mut |payload, encapsulation| {
                    copy = Some((arena.copy(payload), encapsulation));
                });
                let (Some(timestamp), Some((payload, encapsulation))) = (taken, copy) else { break };
                if writer.write(payload, encapsulation, timestamp).is_err() {
                    refused += 1;
                }
            }
        }
        match commands.try_recv() {
            Ok(command) if command == "refused" => {
                answer(&format!("refused {refused}"));
                refused = 0;
            }
            Ok(command) => return Err(format!("unknown command: {command}")),
            Err(TryRecvError::Empty) => {}
            Err(TryRecvError::Disconnected) => return Ok(()),
        }
        std::thread::park_timeout(Duration::from_millis(100));
    }
}

/// The drain: subscribes to the topics of noncritical lanes, which begin with one of the prefixes, and
/// discards the samples.
fn drain(arguments: &[String]) -> Result<(), String> {
    let mut participant = join(arguments, "drain")?;
    let mut readers = Vec::new();
    for prefix in argument(arguments, 3)?.split(',') {
        for route in Route::parse(argument(arguments, 2)?)? {
            readers.push(WakingReader::new(reader(
                &mut participant,
                prefix,
                route,
                Reliability::BestEffort,
            )?));
        }
    }
    let commands = commands();
    answer("ready");
    loop {
        for reader in &readers {
            while reader.take(&mut |_, _| {}).is_some() {}
        }
        if commands.try_recv() == Err(TryRecvError::Disconnected) {
            return Ok(());
        }
        std::thread::park_timeout(Duration::from_millis(100));
    }
}

/// The spinner: uses every CPU fully until stdin ends, with a busy loop in one thread per CPU.
fn spin() -> Result<(), String> {
    for _ in 0..std::thread::available_parallelism().map_or(1, usize::from) {
        std::thread::spawn(|| {
            loop {
                std::hint::spin_loop();
            }
        });
    }
    answer("ready");
    for _ in io::stdin().lock().lines() {}
    Ok(())
}

/// Buffers for payloads, which are reused after the DDS library has released them.
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

    /// Makes `current` a chunk with space for a payload.
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

    /// A buffer of the given length for the caller to fill.
    fn buffer(&mut self, bytes: usize) -> BytesMut {
        self.reserve(bytes);
        self.current.resize(bytes, 0x5a);
        self.current.split()
    }
}
