//! The fuzz targets: one function for each part of the bridge that reads bytes of another process or host. A
//! target panics if the bridge panics or breaks a promise. `tests/pure/regressions.rs` runs the targets on
//! kept inputs.

use std::collections::HashMap;
use std::fs::DirEntry;
use std::os::unix::fs::{DirEntryExt, FileExt};
use std::path::PathBuf;

use adaptive_bridge::config::{self, Place};
use adaptive_bridge::dds::{decode_graph, encode_graph};
use adaptive_bridge::model::{
    DropReason, Encapsulation, Guid, InstanceName, LaneName, MAX_ID_BYTES, MAX_INTRUDERS, MAX_SUBSCRIBERS,
    MonotonicNs, ProbeRefusal, RouteId, TopicName, TrafficClass, TypeName,
};
use adaptive_bridge::policy::mode_and_source;
use adaptive_bridge::process::probes::{MAX_MESSAGE_BYTES, ProbeRequest, ProbeResponse};
use adaptive_bridge::shm::{Boards, BridgeShape, ProcessRole, ShmNode, Stage};
use ros2_client::dds::rustdds::{RepresentationIdentifier, fuzzing, sample_arriving};

/// A target's name and function.
pub type Target = (&'static str, fn(&[u8]));

/// All targets, by the names under which cargo-fuzz and the folders of inputs know them.
pub const TARGETS: &[Target] = &[
    ("config", config),
    ("boards", boards),
    ("names", names),
    ("graph", graph),
    ("rtps_message", rtps_message),
    ("rtps_arriving", rtps_arriving),
    ("rtps_receive", rtps_receive),
    ("rtps_fragments", rtps_fragments),
    ("rtps_discovery", rtps_discovery),
    ("probe", probe),
];

/// A configuration, and after the last NUL, if there is one, the environment as lines of `NAME=value`.
pub fn config(bytes: &[u8]) {
    let end = bytes.iter().rposition(|&byte| byte == 0);
    let (file, environment) = end.map_or((bytes, &[][..]), |end| (&bytes[..end], &bytes[end + 1..]));
    let environment = String::from_utf8_lossy(environment);
    let variables: HashMap<&str, &str> =
        environment.lines().filter_map(|line| line.split_once('=')).collect();
    let env = |name: &str| variables.get(name).map(|value| (*value).to_owned());

    let outcome = config::parse(file, "f.yaml", &env);
    assert_eq!(outcome, config::parse(file, "f.yaml", &env), "read differently the second time");
    match outcome {
        Ok(settings) => {
            // The properties that other layers rely on.
            assert!(!settings.routes.is_empty() && settings.lanes.len() >= 2);
            let outputs = settings.lanes.iter().flat_map(|lane| &lane.outputs);
            assert!(outputs.clone().all(|output| output.route < settings.routes.len()));
            assert!(outputs.map(|output| format!("rt{}", output.topic).len()).max() <= Some(255));
            let shape = BridgeShape::of(&settings);
            assert_eq!(
                (shape.lanes.len(), shape.routes.len()),
                (settings.lanes.len(), settings.routes.len())
            );
        }
        Err(error) => {
            let printed = error.to_string();
            assert!(!error.problems.is_empty());
            assert_eq!(printed.lines().count(), error.problems.len(), "{printed}");
            let last = file.iter().filter(|&&byte| matches!(byte, b'\n' | b'\r')).count() + 1;
            for problem in &error.problems {
                if let Place::Line(line) = problem.place {
                    assert!((1..=last).contains(&line), "line {line} of {last}: {printed}");
                }
            }
        }
    }
}

/// The boards of a bridge of one lane and one route, filled with these bytes by a foreign process.
pub fn boards(bytes: &[u8]) {
    thread_local! {
        static FOREIGN: Foreign = Foreign::new();
    }
    FOREIGN.with(|foreign| foreign.check(bytes));
}

/// Boards, and the file that they are in.
struct Foreign {
    boards: Boards,
    file: std::fs::File,
    file_bytes: u64,
    _node: ShmNode,
    _root: tempfile::TempDir,
}

impl Foreign {
    fn new() -> Self {
        let root = tempfile::tempdir().expect("a folder");
        let instance = InstanceName::try_from("fuzz").expect("a name");
        let node = ShmNode::open(root.path(), &instance, "fuzz").expect("shared memory");
        let lanes = vec![LaneName::critical()];
        let routes = vec![RouteId::try_from("scan").expect("a name")];
        let boards = node.boards(&BridgeShape { lanes, routes }).expect("boards");
        let file = std::fs::File::options().write(true).open(mapped_boards()).expect("the boards' file");
        let file_bytes = file.metadata().expect("its size").len();
        Self { boards, file, file_bytes, _node: node, _root: root }
    }

    fn check(&self, bytes: &[u8]) {
        // The first two words stay: by these the bridge recognises boards, and refuses another file. The
        // bytes are repeated, so that few of them fill every value.
        let wanted = self.file_bytes as usize - 16;
        let source = if bytes.is_empty() { &[0] } else { bytes };
        let content: Vec<u8> = source.iter().copied().cycle().take(wanted).collect();
        self.file.write_all_at(&content, 16).expect("room in shared memory");

        for role in [ProcessRole::Ingress, ProcessRole::Control, ProcessRole::Egress(0)] {
            let health = self.boards.health(role).expect("no writer");
            assert_eq!(*self.boards.health_writer(role).get(), health);
        }
        let ingress = self.boards.ingress(0).expect("no writer");
        let drops: Vec<u64> = ingress.drops.iter().map(|(_, count)| count).collect();
        assert!(drops.len() <= DropReason::COUNT && !drops.contains(&0));
        let _ = ingress.drops.total();
        let lane = self.boards.lane(0, 0).expect("no writer");
        let _ = (lane.received(), lane.is_accounted_for());
        self.boards.lane_writer(0, 0).update(|counters| {
            counters.drops.add(DropReason::Stale, 1);
        });
        let info = self.boards.route_info(0).expect("no writer");
        assert!(info.dds_type.as_str().len() <= 127);
        let _ = TypeName::from_dds(info.dds_type.as_str());

        let policy = self.boards.policy(0).expect("no writer");
        let _ = mode_and_source(&policy, TrafficClass::Critical, MonotonicNs(1), 1);
        let policies = self.boards.policies().expect("the lock of a folder of our own");
        let set = policies.set(0, MonotonicNs(1), |mut policy| {
            policy.mode = 1;
            policy.by_hand ^= 1;
            policy
        });
        assert!(set.epoch != 0 && set.epoch != policy.epoch, "{policy:?} {set:?}");
        assert_eq!(self.boards.policy(0), Some(set));

        let control = self.boards.control().expect("no writer");
        let _ = (control.safety(), control.safety_reason.as_str());
        let subscriber = self.boards.subscriber(MAX_SUBSCRIBERS - 1).expect("no writer");
        let _ = (subscriber.state(), subscriber.id.as_str());
        assert!(subscriber.loss().is_none_or(|loss| (0.0..=1.0).contains(&loss)));
        let intruder = self.boards.intruder(MAX_INTRUDERS - 1).expect("no writer");
        assert!(intruder.host.as_str().len() <= 127);

        for stage in [Stage::DdsIn, Stage::Shm(0), Stage::DdsOut(0), Stage::Age(0)] {
            let before = self.boards.histogram(stage, 0);
            for quantile in [0.0, 0.5, 0.99, 1.0] {
                assert_eq!(before.quantile_ns(quantile).is_some(), before.count() > 0);
            }
            assert_eq!(before.since(&before).count(), 0);
            assert!(before.buckets().map(|(edge_ns, _)| edge_ns).is_sorted());
            self.boards.histogram_writer(stage, 0).record(bytes.len() as u64 * 1_000);
            let _ = self.boards.histogram(stage, 0).since(&before).count();
        }
    }
}

/// The file of shared memory that this process has mapped as boards.
fn mapped_boards() -> PathBuf {
    let maps = std::fs::read_to_string("/proc/self/maps").expect("the maps of this process");
    let mapped: Vec<&str> = maps.lines().filter_map(|line| line.split_whitespace().nth(4)).collect();
    let files = std::fs::read_dir("/dev/shm").expect("shared memory").filter_map(Result::ok);
    let is_mapped = |file: &DirEntry| {
        let inode = file.ino().to_string();
        file.file_name().as_encoded_bytes().ends_with(b"boards") && mapped.contains(&inode.as_str())
    };
    files.map(|file| (is_mapped(&file), file.path())).find(|(found, _)| *found).expect("boards").1
}

/// Names from configurations, from the network and from other processes.
pub fn names(bytes: &[u8]) {
    let text = &*String::from_utf8_lossy(bytes);
    if let Ok(name) = TopicName::try_from(text) {
        assert_eq!(name.as_str(), text);
        assert!(name.to_dds().starts_with("rt/") && name.to_dds().len() <= 255);
    }
    if let Ok(name) = LaneName::try_from(text) {
        // It becomes part of file names.
        assert!(name.as_str() == text && (1..=24).contains(&text.len()) && !text.contains(['/', '.', '\0']));
        assert!(InstanceName::try_from(text).is_ok());
    }
    if let Ok(id) = RouteId::try_from(text) {
        assert!(id.as_str() == text && text.is_ascii());
    }
    if let Ok(name) = TypeName::try_from(text) {
        assert_eq!(TypeName::from_dds(&name.to_dds()), Some(name.clone()));
        assert_eq!(TypeName::try_from(name.to_string().as_str()), Ok(name));
    }
    if let Some(name) = TypeName::from_dds(text) {
        assert_eq!(name.to_dds(), text);
    }
}

/// A graph entry: one that another participant sent, and one of arbitrary content, which must be read by the
/// rules of CDR as it was written.
pub fn graph(bytes: &[u8]) {
    for encapsulation in [Encapsulation::CDR_LE, Encapsulation([0, 0, 0, 0])] {
        let Some(entry) = decode_graph(bytes, encapsulation) else { continue };
        assert!(entry.nodes.len() <= 256);
        let endpoints = entry.nodes.iter().map(|node| node.readers.len() + node.writers.len()).sum::<usize>();
        // No more endpoints than the bytes have room for.
        assert!(endpoints <= 8_192 && endpoints * 16 <= bytes.len());
        for node in &entry.nodes {
            assert!(node.name.starts_with('/') && node.name.len() <= 2 * 255);
            assert!(node.name.bytes().all(|byte| byte.is_ascii_alphanumeric() || b"_/".contains(&byte)));
        }
    }
    written_graph(bytes);
}

fn written_graph(bytes: &[u8]) {
    let mut left = bytes;
    let mut take = |most: usize| {
        let (taken, rest) = left.split_at(most.min(left.len()));
        left = rest;
        taken
    };
    let gid_bytes = if take(1).first().is_some_and(|byte| byte % 2 == 1) { 24 } else { 16 };
    let mut length = || usize::from(take(1).first().copied().unwrap_or(0));
    let (namespace, node, readers, writers) = (length(), length(), length() % 16, length() % 16);
    let namespace = String::from_utf8_lossy(take(namespace)).into_owned();
    let node = String::from_utf8_lossy(take(node)).into_owned();
    let mut guid = || {
        let mut guid = [0; 16];
        let taken = take(16);
        guid[..taken.len()].copy_from_slice(taken);
        Guid(guid)
    };
    let participant = guid();
    let readers: Vec<Guid> = (0..readers).map(|_| guid()).collect();
    let writers: Vec<Guid> = (0..writers).map(|_| guid()).collect();

    let cdr = encode_graph(participant, &namespace, &node, &readers, &writers, gid_bytes);
    let mut reader = Cdr { bytes: &cdr, at: 0 };
    assert_eq!(reader.gid(gid_bytes), participant);
    assert_eq!(reader.number(), 1);
    assert_eq!(reader.text(), namespace);
    assert_eq!(reader.text(), node);
    for guids in [&readers, &writers] {
        assert_eq!(reader.number() as usize, guids.len());
        for guid in guids {
            assert_eq!(reader.gid(gid_bytes), *guid);
        }
    }
    assert_eq!(reader.at, cdr.len());

    if let Some(entry) = decode_graph(&cdr, Encapsulation::CDR_LE) {
        assert_eq!(entry.participant, participant);
        let [read] = &entry.nodes[..] else { panic!("one node was written: {entry:?}") };
        assert!(read.name.starts_with(&namespace) && read.name.ends_with(&node));
        assert_eq!((&read.readers, &read.writers), (&readers, &writers));
    } else {
        let is_plain = |text: &str| {
            !text.is_empty() && text.len() < 256 && text.bytes().all(|byte| byte.is_ascii_alphanumeric())
        };
        assert!(namespace != "/" || !is_plain(&node), "{node} is a name");
    }
}

/// A reader of little-endian CDR.
struct Cdr<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Cdr<'_> {
    fn take(&mut self, count: usize) -> &[u8] {
        self.at += count;
        &self.bytes[self.at - count..self.at]
    }

    fn number(&mut self) -> u32 {
        self.at = self.at.next_multiple_of(4);
        u32::from_le_bytes(self.take(4).try_into().expect("4 bytes"))
    }

    fn gid(&mut self, gid_bytes: usize) -> Guid {
        let (guid, rest) = self.take(gid_bytes).split_at(16);
        assert!(rest.iter().all(|&byte| byte == 0));
        Guid(guid.try_into().expect("16 bytes"))
    }

    fn text(&mut self) -> String {
        let length = self.number() as usize;
        let (last, text) = self.take(length).split_last().expect("a terminating zero");
        assert_eq!(*last, 0);
        String::from_utf8(text.to_vec()).expect("UTF-8")
    }
}

/// A datagram, read as an RTPS message.
pub fn rtps_message(bytes: &[u8]) {
    fuzzing::read_message(bytes);
}

/// A datagram that the bridge peeks at before it is received, 256 bytes of it.
pub fn rtps_arriving(bytes: &[u8]) {
    let whole = sample_arriving(bytes);
    if let Some((writer, _, left_bytes)) = whole {
        assert!(bytes.starts_with(b"RTPS") && writer[..12] == bytes[8..20]);
        // The two highest bits of an entity's kind are 0 for those of a user (RTPS 2.5, clause 9.3.1.2).
        assert_eq!(writer[15] & 0xc0, 0, "{writer:?}");
        assert!(u32::try_from(left_bytes).is_ok());
    }
    // The beginning of a datagram gives the same result as the whole one, or none.
    for length in [256, bytes.len() / 2, bytes.len().saturating_sub(1)] {
        let part = sample_arriving(&bytes[..length.min(bytes.len())]);
        assert!(part.is_none() || part == whole, "{length} bytes: {part:?}, all: {whole:?}");
    }
}

/// Datagrams of the submessages of a writer that a reader has matched, each after its length in two bytes;
/// the reader is RELIABLE if the first byte is odd.
pub fn rtps_receive(bytes: &[u8]) {
    let Some((&first, mut left)) = bytes.split_first() else { return };
    let mut datagrams = Vec::new();
    while let Some((length, rest)) = left.split_first_chunk::<2>() {
        let (submessages, rest) = rest.split_at(usize::from(u16::from_le_bytes(*length)).min(rest.len()));
        left = rest;
        // Protocol 2.3 of vendor 1.15, eProsima.
        datagrams.push([b"RTPS\x02\x03\x01\x0f", &fuzzing::SENDER[..], submessages].concat());
    }
    fuzzing::receive(first % 2 == 1, datagrams.iter().map(Vec::as_slice));
}

/// Fragments of samples that are put together in lent memory, 8 bytes each; the reader is RELIABLE if the
/// first byte is odd.
pub fn rtps_fragments(bytes: &[u8]) {
    let Some((&first, steps)) = bytes.split_first() else { return };
    fuzzing::assemble(first % 2 == 1, steps);
}

/// Announcements of another participant and its endpoints; big-endian if the first byte is odd.
pub fn rtps_discovery(bytes: &[u8]) {
    let Some((&first, parameters)) = bytes.split_first() else { return };
    let is_big_endian = first % 2 == 1;
    let encoding = match is_big_endian {
        true => RepresentationIdentifier::PL_CDR_BE,
        false => RepresentationIdentifier::PL_CDR_LE,
    };
    fuzzing::read_discovery(parameters, encoding);
    // As a journal that has one record, of a participant or of a reader; and as a whole journal.
    let length = u32::try_from(parameters.len()).unwrap_or(u32::MAX).to_le_bytes();
    for kind in [1, 2] {
        let journal = [&[kind][..], &length, parameters].concat();
        assert!(fuzzing::read_journal(&journal).unwrap_or(0) <= 1);
    }
    fuzzing::read_journal(bytes);
}

/// A probe request or a response: the low byte of its representation identifier, and its payload.
pub fn probe(bytes: &[u8]) {
    let Some((&representation, payload)) = bytes.split_first() else { return };
    let encapsulation = Encapsulation([0, representation, 0, 0]);
    let request = ProbeRequest::decode(payload, encapsulation);
    let response = ProbeResponse::decode(payload, encapsulation);
    let is_oversized = payload.len() > MAX_MESSAGE_BYTES;
    assert_eq!(request == Err(ProbeRefusal::Oversized), is_oversized);
    assert_eq!(response == Err(ProbeRefusal::Oversized), is_oversized);
    if let Ok(request) = request {
        assert!((1..=MAX_ID_BYTES).contains(&request.sender_id.len()) && !request.sender_id.contains('\n'));
        assert!(request.probe_id.to_string().len() <= MAX_ID_BYTES);
        let encoded = request.encode();
        assert!(encoded.len() < 1024);
        assert_eq!(ProbeRequest::decode(&encoded, Encapsulation::CDR_LE), Ok(request));
    }
    if let Ok(response) = response {
        assert!((1..=MAX_ID_BYTES).contains(&response.responder_id.len()));
        assert!(response.probe_id.to_string().len() <= MAX_ID_BYTES);
        let encoded = response.encode();
        assert!(encoded.len() < 1024);
        assert_eq!(ProbeResponse::decode(&encoded, Encapsulation::CDR_LE), Ok(response));
    }
}
