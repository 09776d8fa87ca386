//! Floods of valid discovery and graph entries from one peer: what a process takes at a time
//! and keeps.

use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::time::{Duration, Instant};

use adaptive_bridge::dds::encode_graph;
use adaptive_bridge::model::Guid;
use serde_json::Value;
use support::bed::{INPUT, SCAN, SCAN_TYPE};
use support::bridge::{Bridge, program};
use support::forger::Forger;
use support::netns::{Net, requires_root};
use support::process::{Process, memory_kib};
use support::rtps::{EntityId, PARTICIPANT, Prefix};
use support::skip;
use support::visitors::Endpoint;

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
    let Some(net) = net(test) else { return };
    let bridge =
        Bridge::new(&format!("instance: {{instance}}\nsubscribers: {{laptop: noncritical}}\n{SCAN}"));
    let _responder = responder(&net);
    let mut control = bridge.start_on(net.host("robot"), "control");
    bridge.wait_status("responses to probes", |status| accepted(status) > 10);
    let process = control.pid().as_raw();
    let before_kib = memory_kib(process, "VmHWM");

    let forger = Forger::new(net.host("laptop"), 1, process);
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
