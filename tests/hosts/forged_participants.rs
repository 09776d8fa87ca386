//! Forged but well-formed discovery: a million participants that do not exist announce themselves while
//! samples flow.

use std::fs::{self, File};
use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::time::{Duration, Instant};

use nix::sched::{CloneFlags, setns};
use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, SCAN};
use support::peer::{Peer, Received, Sent};
use support::rtps::Message;

const PARTICIPANTS: u32 = 1_000_000;
const ATTACK: Duration = Duration::from_secs(60);
const ROLES: [&str; 4] = ["ingress", "control", "egress-critical", "egress-noncritical"];
/// How much the resident memory of each process may grow.
const MAX_GROWTH_KIB: u64 = 32 * 1024;

fn resident_kib(pid: i32) -> u64 {
    let status = fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.split_whitespace().next().unwrap().parse().unwrap()
}

/// The ports for unicast discovery traffic in the network namespace of a process: one for each participant.
fn discovery_ports(pid: i32) -> Vec<u16> {
    let table = fs::read_to_string(format!("/proc/{pid}/net/udp")).unwrap();
    let ports = table
        .lines()
        .skip(1)
        .filter_map(|line| u16::from_str_radix(line.split_whitespace().nth(1)?.rsplit(':').next()?, 16).ok());
    // Unicast discovery traffic goes to 7400 + 10 + 2 * participant number (clause 9.6.1.1 of RTPS 2.5).
    let mut ports: Vec<u16> = ports.filter(|port| (7410..7440).contains(port) && port % 2 == 0).collect();
    ports.sort_unstable();
    ports.dedup();
    ports
}

/// Announces [`PARTICIPANTS`] from inside a network namespace, to the processes of the bridge in turn.
fn announce(namespace: &str, source: Ipv4Addr, bridge: Ipv4Addr, ports: &[u16]) {
    setns(File::open(format!("/run/netns/{namespace}")).unwrap(), CloneFlags::CLONE_NEWNET).unwrap();
    let socket = UdpSocket::bind((source, 0)).unwrap();
    let begin = Instant::now();
    for number in 0..PARTICIPANTS {
        let mut prefix = *b"\x01\x0fforged\0\0\0\0";
        prefix[8..].copy_from_slice(&number.to_be_bytes());
        let announcement = Message::announcement(prefix, SocketAddrV4::new(source, 9));
        let port = ports[number as usize % ports.len()];
        let _ = socket.send_to(announcement.bytes(), (bridge, port));
        if number % 32 == 0 {
            let due = ATTACK * number / PARTICIPANTS;
            std::thread::sleep(due.saturating_sub(begin.elapsed()));
        }
    }
}

fn refused(status: &Value, process: &str) -> u64 {
    let processes = status["processes"].as_array().unwrap();
    let process = processes.iter().find(|found| found["name"] == process).unwrap();
    process["network_refusals"]["too_many_participants"].as_u64().unwrap()
}

#[test]
fn a_million_forged_participants_take_little_memory_and_cost_no_critical_sample() {
    let test = "a_million_forged_participants_take_little_memory_and_cost_no_critical_sample";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let critical = bed.subscribe("critical", Peer::fast().keep_all(), CRITICAL);
    let publisher = bed.publish(Peer::cyclone().keep_all().rate_hz(100.0), INPUT);
    critical.wait_received(500);
    let pids = ROLES.map(|role| bed.pid(role));
    let before = pids.map(resident_kib);
    let ports = discovery_ports(pids[0]);
    assert!(ports.len() >= ROLES.len(), "{ports:?}");

    let attacker = bed.host("slow");
    let (namespace, source) = (attacker.namespace().to_owned(), attacker.address());
    let bridge = bed.host("bridge").address();
    let attack = std::thread::spawn(move || announce(&namespace, source, bridge, &ports));
    // The limit is for each address, so that a subscriber on another host joins meanwhile.
    support::wait_until("refused announcements", || refused(&bed.bridge.status(), "egress-critical") > 1_000);
    let late = bed.subscribe("critical", Peer::fast().keep_all(), CRITICAL);
    late.wait_received(100);
    attack.join().unwrap();

    let status = bed.bridge.status();
    let after = pids.map(resident_kib);
    let counts = ROLES.map(|role| refused(&status, role));
    println!("resident memory {before:?} KiB, then {after:?} KiB; refused {counts:?}");
    for (index, role) in ROLES.into_iter().enumerate() {
        assert_eq!(bed.pids(role).len(), 1, "{role} was restarted\n{}", bed.up.log());
        let growth = after[index].saturating_sub(before[index]);
        assert!(growth < MAX_GROWTH_KIB, "{role} grew by {growth} KiB");
        // A full socket buffer discards the others.
        assert!(counts[index] > 10_000, "{role} refused {}", counts[index]);
    }
    let sent: Sent = publisher.end();
    critical.wait_received(sent.ok);
    critical.end::<Received>().assert_all_of(&sent);
    late.end::<Received>().assert_sound();
    bed.wait_accounted();
    bed.end();
}
