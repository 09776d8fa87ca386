//! Fragments: samples that are larger than the route allows, and samples that never become complete, sent in
//! the names of participants that do not exist.

use std::net::{SocketAddrV4, UdpSocket};

use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, SCAN, SCAN_TYPE};
use support::bridge::refused;
use support::forger::Forger;
use support::peer::{Peer, Received, Sent};
use support::process::memory_kib;
use support::rtps::{EntityId, Fragment, Message, Prefix, SEDP_PUBLICATIONS, SEDP_SUBSCRIPTIONS};
use support::visitors::Endpoint;

const ROLES: [&str; 4] = ["ingress", "control", "egress-critical", "egress-noncritical"];
/// How much the resident memory of each process may grow. The fragments of the attack are 480 MB for each.
const MAX_GROWTH_KIB: i64 = 16 * 1024;
const FORGED: u32 = 2_000;
const FRAGMENT_BYTES: u16 = 60_000;

fn prefix(number: u32) -> Prefix {
    let mut prefix = *b"\x01\x0ffrag\0\0\0\0\0\0";
    prefix[8..].copy_from_slice(&number.to_be_bytes());
    prefix
}

/// Sends the first fragment of samples of 60 MB and of 200 kB to the discovery readers of each process, each
/// sample in the name of another participant.
fn attack(socket: &UdpSocket, processes: &[SocketAddrV4]) {
    for number in 0..FORGED {
        for (sample_bytes, (reader, writer)) in [
            (60_000_000, SEDP_PUBLICATIONS),
            (200_000, SEDP_PUBLICATIONS),
            (60_000_000, SEDP_SUBSCRIPTIONS),
            (200_000, SEDP_SUBSCRIPTIONS),
        ] {
            let (bytes, sequence) = (&[0; FRAGMENT_BYTES as usize], i64::from(sample_bytes));
            let fragment = Fragment { number: 1, bytes, sequence, size: FRAGMENT_BYTES, sample_bytes };
            let message = Message::of(prefix(number)).fragment(reader, writer, &fragment);
            for process in processes {
                message.send(socket, *process);
            }
        }
        // Leaves time for the bridge, whose sockets would discard most of it otherwise.
        std::thread::sleep(std::time::Duration::from_millis(5));
    }
}

/// Publishers of one participant that complete no sample.
const WRITERS: u8 = 40;
/// The samples that each of them begins: 158 MB in all. A route with samples of 64 KiB keeps 1 MiB of them;
/// without that limit it would keep 128 samples of each publisher, which is all.
const UNFINISHED: i64 = 66;

#[test]
fn samples_of_an_input_that_never_become_complete_take_little_memory() {
    let test = "samples_of_an_input_that_never_become_complete_take_little_memory";
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let critical = bed.subscribe("critical", Peer::fast().keep_all(), CRITICAL);
    let publisher = bed.publish(Peer::cyclone().keep_all().rate_hz(100.0), INPUT);
    critical.wait_received(100);
    let ingress = bed.pid("ingress");
    let before_kib = memory_kib(ingress, "VmHWM");

    let forger = Forger::new(bed.host("slow"), 1, (bed.host("bridge"), ingress));
    let writers: Vec<EntityId> = (1..=WRITERS).map(|number| [0, 0, number, 0x03]).collect();
    bed.bridge.wait_status("the publishers to match", |status| {
        // Again and again, because the first ones may come before ingress knows the participant; a few in
        // each message, which is one datagram.
        for writers in writers.chunks(8) {
            forger.announce(&Endpoint::writer(INPUT, SCAN_TYPE), writers);
        }
        status["routes"][0]["writers"].as_u64() == Some(u64::from(WRITERS) + 1)
    });
    for sequence in 1..=UNFINISHED {
        for writer in &writers {
            forger.write_unfinished(*writer, sequence, 64_000);
        }
        // Leaves time for ingress, whose socket would discard most of it otherwise.
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    let begun = u64::from(WRITERS) * UNFINISHED as u64;
    bed.bridge.wait_status("unfinished samples discarded", |status| {
        refused(status, "ingress", "unfinished_sample") > begun / 2
    });
    let growth_kib = memory_kib(ingress, "VmHWM") - before_kib;
    println!("ingress grew by {growth_kib} KiB");
    assert!(growth_kib < MAX_GROWTH_KIB, "ingress grew by {growth_kib} KiB");

    let sent: Sent = publisher.end();
    critical.wait_received(sent.ok);
    critical.end::<Received>().assert_all_of(&sent);
    bed.wait_accounted();
    bed.end();
}

/// Tests of a minute or more: `make test-long`.
mod long {
    use super::*;

    #[test]
    fn samples_that_never_become_complete_or_are_too_large_take_little_memory() {
        let test = "samples_that_never_become_complete_or_are_too_large_take_little_memory";
        let _alone = support::exclusive();
        let Some(bed) = Bed::start(test, SCAN) else { return };
        let critical = bed.subscribe("critical", Peer::fast().keep_all(), CRITICAL);
        let publisher = bed.publish(Peer::cyclone().keep_all().rate_hz(100.0), INPUT);
        critical.wait_received(500);
        let pids = ROLES.map(|role| bed.pid(role));
        let resident_kib = |pid| memory_kib(pid, "VmRSS");
        let before = pids.map(resident_kib);

        let processes = bed.discovery_addresses();
        attack(&bed.host("slow").udp_socket(), &processes);
        // The largest sample of the route has 64 KiB.
        let too_large = bed.publish(Peer::fast().keep_all().rate_hz(2.0).size(20 << 20).count(10), INPUT);
        let too_large: Sent = too_large.finish();
        let after = pids.map(resident_kib);

        println!("resident memory {before:?} KiB, then {after:?} KiB");
        for (index, role) in ROLES.into_iter().enumerate() {
            assert_eq!(bed.pids(role).len(), 1, "{role} was restarted\n{}", bed.up.log());
            let growth = after[index] - before[index];
            assert!(growth < MAX_GROWTH_KIB, "{role} grew by {growth} KiB");
        }
        let sent: Sent = publisher.end();
        critical.wait_received(sent.ok);
        critical.end::<Received>().assert_all_of(&sent);
        let status = bed.wait_accounted();
        let route: &Value = &status["routes"][0];
        assert_eq!(route["drops"]["too_large"].as_u64(), Some(too_large.ok), "{route}");
        assert_eq!(route["lost_upstream"].as_u64(), Some(0), "{route}");
        // Of the 200 kB samples, the discovery readers keep 20 at most.
        let discarded = ROLES.map(|role| refused(&status, role, "unfinished_sample"));
        println!("unfinished samples discarded: {discarded:?}");
        for (role, discarded) in ROLES.into_iter().zip(discarded) {
            // A full socket buffer discards the others.
            assert!(discarded > u64::from(FORGED) / 4, "{role} discarded {discarded}");
        }
        assert!(route["received_bytes"].as_u64().unwrap() > too_large.ok * (20 << 20), "{route}");
        bed.end();
    }
}
