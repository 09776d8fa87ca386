//! Floods of valid discovery and graph entries from one peer: what a process takes of them at a time, what
//! it keeps, and what it logs.

use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::time::{Duration, Instant};

use adaptive_bridge::dds::encode_graph;
use adaptive_bridge::model::Guid;
use serde_json::Value;
use support::bed::{CRITICAL, INPUT, SCAN, SCAN_TYPE};
use support::bridge::{Bridge, program};
use support::forger::Forger;
use support::netns::{Net, requires_root};
use support::process::{Process, memory_kib};
use support::rtps::{EntityId, PARTICIPANT, Prefix};
use support::visitors::Endpoint;
use support::{skip, wait_until};

/// The entity id of the writer of graph entries.
const GRAPH_WRITER: EntityId = [0, 0, 0x20, 0x03];
const GRAPH_TYPE: &str = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";
/// The encapsulation header of plain little-endian CDR.
const CDR_LE: [u8; 4] = [0, 1, 0, 0];
/// How much control may grow at most: what the topic keeps, what waits for earlier samples, what is
/// unfinished, and buffers. Entries of the size below take 100 MB if only their number is limited.
const MAX_GROWTH_KIB: i64 = 32 << 10;
/// The most readers and writers in a graph entry.
const MAX_ENDPOINTS: usize = 8_192;
/// The lines of one place in the source that a process logs at once, and then per second.
const BURST_LINES: u64 = 200;
const LINES_PER_S: u64 = 5;

/// Creates a host with the bridge and one with the hostile peer; `None`, with `test` recorded as skipped, if
/// the machine cannot.
fn net(test: &str) -> Option<Net> {
    match requires_root() {
        Some(reason) => {
            skip(test, &reason);
            None
        }
        None => Some(Net::new(&["robot", "laptop"])),
    }
}

fn responder(net: &Net) -> Process {
    let mut command = net.host("robot").command(program());
    command.args(["responder", "--id", "laptop"]).env_remove("ADAPTIVE_BRIDGE_CONFIG").env("NO_COLOR", "1");
    Process::spawn("responder", command)
}

fn turns(status: &Value) -> u64 {
    let processes = status["processes"].as_array().unwrap();
    let control = processes.iter().find(|process| process["name"] == "control").unwrap();
    control["turns"].as_u64().unwrap()
}

fn accepted(status: &Value) -> u64 {
    status["probes"]["accepted"].as_u64().unwrap()
}

/// Whether `status` has an intruder of this node.
fn has_intruder(status: &Value, node: &str) -> bool {
    status["intruders"].as_array().unwrap().iter().any(|intruder| intruder["node"] == node)
}

/// Ends a flood also if the test fails meanwhile.
struct StopAtEnd<'a>(&'a AtomicBool);

impl Drop for StopAtEnd<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

/// What a flood consists of: one graph entry again and again. It names the node of readers of the input, so
/// that `status` shows whether control takes it.
struct Flood {
    node: &'static str,
    readers: Vec<EntityId>,
    payload: Vec<u8>,
}

impl Flood {
    /// Of entries with so many readers, some of which the test announces.
    fn new(node: &'static str, prefix: Prefix, kind: u8, readers: usize) -> Self {
        let readers: Vec<EntityId> =
            (0..readers).map(|number| [kind, (number >> 8) as u8, number as u8, 0x04]).collect();
        let guid = |entity: EntityId| Guid([prefix.as_slice(), &entity].concat().try_into().unwrap());
        let guids: Vec<Guid> = readers.iter().copied().map(guid).collect();
        let entry = encode_graph(guid(PARTICIPANT), "/", node, &guids, &[], 24);
        Self { node, readers, payload: [CDR_LE.as_slice(), &entry].concat() }
    }

    /// Sends entries as fast as the socket takes them until `stop`; `last` is the last sequence number.
    fn send(&self, forger: &Forger, last: &AtomicI64, stop: &AtomicBool) {
        // As many as a datagram has room for.
        let at_once = 60_000 / (self.payload.len() + 32);
        while !stop.load(Ordering::Relaxed) {
            let first = last.load(Ordering::Relaxed) + 1;
            match at_once {
                0 => forger.write_large(GRAPH_WRITER, first, &self.payload),
                _ => forger.write(GRAPH_WRITER, first, &self.payload, at_once),
            }
            last.fetch_add(at_once.max(1) as i64, Ordering::Relaxed);
        }
    }
}

#[test]
fn control_goes_on_and_grows_little_during_a_flood_of_graph_entries() {
    let test = "control_goes_on_and_grows_little_during_a_flood_of_graph_entries";
    let _alone = support::exclusive();
    let Some(net) = net(test) else { return };
    let bridge =
        Bridge::new(&format!("instance: {{instance}}\nsubscribers: {{laptop: noncritical}}\n{SCAN}"));
    let _responder = responder(&net);
    let mut control = bridge.start_on(net.host("robot"), "control");
    bridge.wait_status("responses to probes", |status| accepted(status) > 10);
    let process = control.pid().as_raw();
    let before_kib = memory_kib(process, "VmHWM");

    let forger = Forger::new(net.host("laptop"), 1, (net.host("robot"), process));
    let graph = Endpoint::writer("ros_discovery_info", GRAPH_TYPE).transient_local();
    let reader = Endpoint::reader(INPUT, SCAN_TYPE);
    let small = Flood::new("small", forger.prefix(), 1, 8);
    let large = Flood::new("large", forger.prefix(), 2, MAX_ENDPOINTS);
    let last = AtomicI64::new(0);
    for (flood, entries) in [(small, 100_000), (large, 2_000)] {
        let (begun, first, stop) = (bridge.status(), last.load(Ordering::Relaxed), AtomicBool::new(false));
        let mut readers = flood.readers.iter().take(8).cycle();
        let mut announced_at = None;
        std::thread::scope(|scope| {
            let _stop = StopAtEnd(&stop);
            scope.spawn(|| flood.send(&forger, &last, &stop));
            bridge.wait_status(&format!("turns of control in a flood of {} entries", flood.node), |status| {
                // Again and again, because datagrams are lost in the flood, and a reader is reported without
                // its node if that is not known soon.
                if announced_at.is_none_or(|at: Instant| at.elapsed() > Duration::from_secs(1)) {
                    forger.announce(&graph, &[GRAPH_WRITER]);
                    forger.announce(&reader, &[*readers.next().unwrap()]);
                    announced_at = Some(Instant::now());
                }
                has_intruder(status, &format!("/{}", flood.node))
                    && turns(status) >= turns(&begun) + 30
                    && accepted(status) >= accepted(&begun) + 10
                    && last.load(Ordering::Relaxed) >= first + entries
            });
        });
        let growth_kib = memory_kib(process, "VmHWM") - before_kib;
        println!("{} {} entries: {growth_kib} KiB", last.load(Ordering::Relaxed) - first, flood.node);
        assert!(growth_kib < MAX_GROWTH_KIB, "control grew by {growth_kib} KiB");
    }
    assert!(control.terminate().success(), "{}", control.log());
}

/// The lines of a log that contain `text`.
fn lines(log: &str, text: &str) -> u64 {
    log.lines().filter(|line| line.contains(text)).count() as u64
}

/// The lines that a log reports as left out.
fn left_out(log: &str) -> u64 {
    let reports = log.lines().filter(|line| line.contains("log lines left out"));
    let count = |line: &str| line.rsplit_once(" lines=")?.1.split_whitespace().next()?.parse::<u64>().ok();
    reports.map(|line| count(line).unwrap_or_else(|| panic!("{line}"))).sum()
}

#[test]
fn log_lines_that_a_peer_provokes_are_limited_and_those_left_out_are_counted() {
    let test = "log_lines_that_a_peer_provokes_are_limited_and_those_left_out_are_counted";
    let Some(net) = net(test) else { return };
    let bridge = Bridge::new(&format!("instance: {{instance}}\n{SCAN}"));
    let mut lane = bridge.start_on(net.host("robot"), "egress --lane critical");
    lane.wait_for_log("egress is up");
    let since = Instant::now();
    let matched = Endpoint::reader(CRITICAL, SCAN_TYPE);
    let unmatched = matched.clone().transient_local();
    for (kind, reader, text) in [
        (1, matched, "readers changed"),
        (2, unmatched, "a reader requests a stricter QoS than this lane offers"),
    ] {
        // Each kind has a participant of its own, which may have 4,096 readers.
        let forger = Forger::new(net.host("laptop"), kind, (net.host("robot"), lane.pid().as_raw()));
        let left_out_before = left_out(&lane.log());
        let provoked = || {
            let log = lane.log();
            (lines(&log, text), left_out(&log) - left_out_before)
        };
        let mut entities = (0..u16::MAX).map(|number| [kind, (number >> 8) as u8, number as u8, 0x04]);
        wait_until(format!("1000 lines, logged or left out: {text}"), || {
            forger.announce(&reader, &entities.by_ref().take(50).collect::<Vec<_>>());
            std::thread::sleep(Duration::from_millis(50));
            let (logged, left_out) = provoked();
            logged + left_out >= 1_000
        });
        let (logged, left_out) = provoked();
        println!("{logged} logged, {left_out} left out: {text}");
        let bound = BURST_LINES + LINES_PER_S * (since.elapsed().as_secs() + 1);
        assert!(logged <= bound, "{logged} of at most {bound} lines: {text}");
    }
    assert!(lane.terminate().success(), "{}", lane.log());
}
