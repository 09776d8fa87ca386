//! Forged but well-formed discovery while samples flow: a million participants that do not exist announce
//! themselves, and one announces more readers than a process keeps.

use std::net::{Ipv4Addr, SocketAddrV4, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use adaptive_bridge::config;
use adaptive_bridge::process::MemoryNeeds;
use nix::sys::signal::Signal;
use support::bed::{Bed, CRITICAL, INPUT, SCAN, SCAN_TYPE, STANDBYS};
use support::bridge::refused;
use support::peer::{Peer, Received, Sent};
use support::process::{memory_kib, signal};
use support::rtps::{LEASE_S, Message, Prefix};

use super::control_faults::wait_running;
use super::standby::{took_ms, wait_standby, wait_take_over};

const PARTICIPANTS: u32 = 1_000_000;
const ATTACK: Duration = Duration::from_secs(60);
const LANE: &str = "egress-critical";
const ROLES: [&str; 4] = ["ingress", "control", LANE, "egress-noncritical"];
/// How much the resident memory of each process may grow.
const MAX_GROWTH_KIB: i64 = 32 * 1024;
/// The most participants that a process evicts: it admits 128 at once and 32 a second from one address.
const MAX_EVICTED: u64 = 10_000;
/// The most readers of one participant that a process keeps.
const MAX_READERS: u16 = 4_096;
/// Readers beyond those.
const REFUSED: u16 = 100;
/// Where the forged participants claim to receive.
const NOWHERE: SocketAddrV4 = SocketAddrV4::new(Ipv4Addr::new(192, 0, 2, 1), 9);

fn prefix(number: u32) -> Prefix {
    let mut prefix = *b"\x01\x0fforged\0\0\0\0";
    prefix[8..].copy_from_slice(&number.to_be_bytes());
    prefix
}

/// Announces participants that do not exist to the processes of the bridge in turn: as many a second as are
/// [`PARTICIPANTS`] within [`ATTACK`], divided by `divisor`, as long as `goes_on`, called with the number
/// announced so far, returns true.
/// Each fourth round, a participant that the processes know sends the announcement.
pub fn announce(socket: &UdpSocket, processes: &[SocketAddrV4], divisor: u32, goes_on: impl Fn(u32) -> bool) {
    let begin = Instant::now();
    let mut number = 0;
    while goes_on(number) {
        let (round, process) = (number as usize / processes.len(), number as usize % processes.len());
        let announced = prefix(number);
        // The first round announces the participants that the others name as their sender.
        let sender = if round > 0 && round.is_multiple_of(4) { prefix(process as u32) } else { announced };
        let message = Message::of(sender).announcement(announced, NOWHERE, i64::from(number) + 1, LEASE_S);
        message.send(socket, processes[process]);
        number += 1;
        if number % 32 == 0 {
            let due = ATTACK * number / PARTICIPANTS * divisor;
            std::thread::sleep(due.saturating_sub(begin.elapsed()));
        }
    }
}

/// Announces a participant and its readers with these numbers to all processes of the bridge. Those that have
/// an announcement already discard its repetition.
fn announce_readers(socket: &UdpSocket, processes: &[SocketAddrV4], numbers: &[u16]) {
    let owner = prefix(0);
    let participant = Message::of(owner).announcement(owner, NOWHERE, 1, LEASE_S);
    let readers = numbers.chunks(6).map(|numbers| {
        numbers.iter().fold(Message::of(owner), |message, number| {
            let [high, low] = number.to_be_bytes();
            let sequence = i64::from(*number);
            message.reader(owner, [high, low, 1, 0x04], "rt/forged", SCAN_TYPE, NOWHERE, sequence)
        })
    });
    for message in std::iter::once(participant).chain(readers) {
        for process in processes {
            message.send(socket, *process);
        }
    }
}

#[test]
fn each_process_counts_the_readers_of_a_participant_beyond_its_limit() {
    let test = "each_process_counts_the_readers_of_a_participant_beyond_its_limit";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    bed.up.wait_for_log("control is up");
    let critical = bed.subscribe("critical", Peer::fast().keep_all(), CRITICAL);
    let publisher = bed.publish(Peer::cyclone().keep_all().rate_hz(100.0), INPUT);
    critical.wait_received(50);

    let (socket, processes) = (bed.host("slow").udp_socket(), bed.discovery_addresses());
    let numbers: Vec<u16> = (1..=MAX_READERS + REFUSED).collect();
    for batch in numbers.chunks(500) {
        // Again, because the network may lose datagrams, and the first ones come before the participant is
        // known.
        for _ in 0..3 {
            announce_readers(&socket, &processes, batch);
            std::thread::sleep(Duration::from_millis(50));
        }
    }
    let counted = || {
        let status = bed.bridge.status();
        ROLES.map(|role| refused(&status, role, "too_many_endpoints"))
    };
    support::wait_until("all processes to refuse the readers beyond the limit", || {
        announce_readers(&socket, &processes, &numbers);
        counted() == [u64::from(REFUSED); ROLES.len()]
    });

    // The readers of other participants are not refused.
    let late = bed.subscribe("critical", Peer::fast().keep_all(), CRITICAL);
    late.wait_received(50);
    assert_eq!(counted(), [u64::from(REFUSED); ROLES.len()]);
    let sent: Sent = publisher.end();
    critical.wait_received(sent.ok);
    critical.end::<Received>().assert_all_of(&sent);
    late.end::<Received>().assert_sound();
    bed.wait_accounted();
    bed.end();
}

// A standby that read all of them took 56 to 154 ms, and discovery reported more of them than can wait.
#[test]
fn a_standby_takes_over_with_the_subscribers_and_few_of_many_forged_participants() {
    let test = "a_standby_takes_over_with_the_subscribers_and_few_of_many_forged_participants";
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, &format!("{SCAN}{STANDBYS}")) else { return };
    wait_running(&bed.bridge);
    let (socket, processes, stop) =
        (bed.host("slow").udp_socket(), bed.discovery_addresses(), Arc::new(AtomicBool::new(false)));
    let attack = std::thread::spawn({
        let stop = Arc::clone(&stop);
        move || announce(&socket, &processes, 16, |_| !stop.load(Ordering::Relaxed))
    });
    support::wait_until("ingress and the lane to be full of forged participants", || {
        let status = bed.bridge.status();
        ["ingress", LANE].iter().all(|role| refused(&status, role, "evicted_participant") > 0)
    });
    // Younger than the forged ones.
    let critical = bed.subscribe("critical", Peer::cyclone().keep_all(), CRITICAL);
    let publisher = bed.publish(Peer::fast().keep_all().rate_hz(200.0), INPUT);
    critical.wait_received(200);
    for (name, take_overs) in [(LANE, 1), ("ingress", 1), (LANE, 2), ("ingress", 2)] {
        signal(wait_standby(&bed, name), Signal::SIGKILL);
        let took_ms = took_ms(&wait_take_over(&bed, name, take_overs));
        println!("{name}: taken over in {took_ms:.1} ms");
        critical.wait_received(critical.received() + 200);
    }
    stop.store(true, Ordering::Relaxed);
    attack.join().unwrap();
    let sent: Sent = publisher.end();
    critical.wait_received(sent.ok);
    critical.end::<Received>().assert_all_of(&sent);
    bed.wait_accounted();
    let log = bed.up.log();
    assert!(!log.contains("more changes at a time than can wait"), "{log}");
    bed.end();
}

/// Tests of a minute or more: `make test-long`.
mod long {
    use super::*;

    #[test]
    fn a_million_forged_participants_take_little_memory_and_cost_no_critical_sample() {
        let test = "a_million_forged_participants_take_little_memory_and_cost_no_critical_sample";
        let _alone = support::exclusive();
        let Some(bed) = Bed::start(test, SCAN) else { return };
        let critical = bed.subscribe("critical", Peer::fast().keep_all(), CRITICAL);
        let publisher = bed.publish(Peer::cyclone().keep_all().rate_hz(100.0), INPUT);
        critical.wait_received(500);
        let pids = ROLES.map(|role| bed.pid(role));
        let before = pids.map(|pid| memory_kib(pid, "VmRSS"));
        let processes = bed.discovery_addresses();

        let (socket, stop) = (bed.host("slow").udp_socket(), Arc::new(AtomicBool::new(false)));
        let attack = std::thread::spawn({
            let stop = Arc::clone(&stop);
            move || {
                announce(&socket, &processes, 1, |number| {
                    number < PARTICIPANTS || !stop.load(Ordering::Relaxed)
                })
            }
        });
        let too_many = "too_many_participants";
        support::wait_until("refused announcements", || {
            refused(&bed.bridge.status(), "egress-critical", too_many) > 1_000
        });
        // The limit is for each address, so that a subscriber on another host joins during the attack.
        let late = bed.subscribe("critical", Peer::fast().keep_all(), CRITICAL);
        late.wait_received(100);
        stop.store(true, Ordering::Relaxed);
        attack.join().unwrap();

        let status = bed.bridge.status();
        // The most that each has had.
        let after = pids.map(|pid| memory_kib(pid, "VmHWM"));
        let [many, malformed, evicted] = [too_many, "malformed_datagram", "evicted_participant"]
            .map(|cause| ROLES.map(|role| refused(&status, role, cause)));
        let needs = MemoryNeeds::of(&config::parse(SCAN, "the test", &|_| None).unwrap());
        let needs = [needs.ingress, needs.control, needs.lanes[0], needs.lanes[1]];
        let limits_kib = needs.map(|need| need.limit_bytes() as i64 / 1024);
        println!("resident memory {before:?} KiB, then {after:?} KiB, limits {limits_kib:?} KiB");
        println!("refused {many:?}, malformed {malformed:?}, evicted {evicted:?}");
        for (index, role) in ROLES.into_iter().enumerate() {
            assert_eq!(bed.pids(role).len(), 1, "{role} was restarted\n{}", bed.up.log());
            let growth = after[index] - before[index];
            assert!(growth < MAX_GROWTH_KIB, "{role} grew by {growth} KiB");
            assert!(after[index] < limits_kib[index], "{role} takes more than its limit");
            // A full socket buffer discards the others.
            assert!(many[index] > 10_000, "{role} refused {}", many[index]);
            assert!(malformed[index] > 1_000, "{role} took {} of another sender", malformed[index]);
            assert!(evicted[index] < MAX_EVICTED, "{role} evicted {}", evicted[index]);
        }
        let sent: Sent = publisher.end();
        critical.wait_received(sent.ok);
        critical.end::<Received>().assert_all_of(&sent);
        late.end::<Received>().assert_sound();
        bed.wait_accounted();
        bed.end();
    }
}
