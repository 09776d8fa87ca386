//! A hostile network: random, malformed and truncated RTPS datagrams at every port of a running bridge, while
//! samples flow. No process crashes or is restarted, and no sample is lost, unless it is in the name of the
//! participants between which it flows.

use std::net::{Ipv4Addr, UdpSocket};
use std::time::{Duration, Instant};

use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, NONCRITICAL, SCAN, outputs};
use support::netns::udp_ports;
use support::peer::{Peer, Received, Sent};
use support::rtps::Prefix;

const ROLES: [&str; 4] = ["ingress", "egress-critical", "egress-noncritical", "control"];

/// A pseudo-random sequence that is reproducible from its seed (xorshift64*).
pub(super) struct Random(pub(super) u64);

impl Random {
    fn next(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_f491_4f6c_dd1d)
    }

    pub(super) fn below(&mut self, bound: usize) -> usize {
        (self.next() % bound as u64) as usize
    }

    fn bytes(&mut self, count: usize) -> Vec<u8> {
        (0..count).map(|_| self.next() as u8).collect()
    }
}

/// Entity ids of the attack: those of discovery and the first user-defined ones.
const ENTITIES: [[u8; 4]; 10] = [
    [0, 1, 0, 0xc2],
    [0, 1, 0, 0xc7],
    [0, 0, 3, 0xc2],
    [0, 0, 3, 0xc7],
    [0, 0, 4, 0xc2],
    [0, 0, 4, 0xc7],
    [0, 2, 0, 0xc2],
    [0, 0, 1, 0x03],
    [0, 0, 1, 0x04],
    [0, 0, 0, 0],
];

/// The submessage kinds of RTPS 2.5 (clause 9.4.5.1.1), and an undefined one.
const KINDS: [u8; 14] = [0x01, 0x06, 0x07, 0x08, 0x09, 0x0c, 0x0d, 0x0e, 0x0f, 0x12, 0x13, 0x15, 0x16, 0x7f];

/// Boundary values of number fields.
const EDGES: [u32; 8] = [0, 1, 2, 255, 256, 0x7fff_ffff, 0x8000_0000, 0xffff_ffff];

/// Makes one datagram of the attack, half of them in the name of one of the participants `known`. The bridge
/// discards most submessages of a participant that it does not know.
fn datagram(random: &mut Random, known: &[Prefix]) -> Vec<u8> {
    if random.below(8) == 0 {
        let length = random.below(1500);
        return random.bytes(length);
    }
    let mut datagram = b"RTPS\x02\x03\x01\x12".to_vec();
    match known {
        [_, ..] if random.below(2) == 0 => datagram.extend(known[random.below(known.len())]),
        _ => datagram.extend(random.bytes(12)),
    }
    for _ in 0..=random.below(4) {
        let kind = KINDS[random.below(KINDS.len())];
        let mut body = Vec::new();
        for _ in 0..random.below(24) {
            match random.below(4) {
                0 => body.extend(ENTITIES[random.below(ENTITIES.len())]),
                1 => body.extend(EDGES[random.below(EDGES.len())].to_le_bytes()),
                2 => body.extend((random.below(64) as u32).to_le_bytes()),
                _ => body.extend(random.bytes(4)),
            }
        }
        // The length is correct, random, or zero, which means "to the end of the message".
        let length = match random.below(4) {
            0 => random.next() as u16,
            1 => 0,
            _ => body.len() as u16,
        };
        datagram.extend([kind, random.next() as u8]);
        datagram.extend(length.to_le_bytes());
        datagram.extend(body);
    }
    if random.below(3) == 0 {
        let cut = random.below(datagram.len()).max(1);
        datagram.truncate(cut);
    }
    datagram
}

/// The participants of GUIDs as `status` prints them, `PREFIX:ENTITY` in hexadecimal.
fn prefixes<'a>(guids: impl Iterator<Item = &'a Value>) -> Vec<Prefix> {
    let prefix = |guid: &Value| -> Prefix {
        let digits = guid.as_str().and_then(|guid| guid.split(':').next()).unwrap();
        std::array::from_fn(|at| u8::from_str_radix(&digits[2 * at..2 * at + 2], 16).unwrap())
    };
    guids.map(prefix).collect()
}

/// The GUIDs of the matched readers of all lanes.
fn readers(status: &Value) -> impl Iterator<Item = &Value> {
    outputs(status).flat_map(|output| output["matched_readers"].as_array().unwrap()).map(|one| &one["guid"])
}

/// The malformed datagrams that each role has counted.
fn malformed(bed: &Bed) -> [u64; ROLES.len()] {
    let status = bed.bridge.status();
    let processes = status["processes"].as_array().unwrap();
    ROLES.map(|role| {
        let process = processes.iter().find(|process| process["name"] == role);
        let refused = process.and_then(|process| process["network_refusals"]["malformed_datagram"].as_u64());
        refused.unwrap_or_else(|| panic!("{role}: {status}"))
    })
}

/// Sends datagrams to the bridge from another host for some time, in part in the name of the participants
/// `known`. Asserts that each process counted malformed ones and none was restarted.
fn attack(bed: &Bed, seconds: u64, known: &[Prefix]) {
    let ports = udp_ports(bed.pid("ingress"));
    assert!(ports.contains(&7400) && ports.len() >= 8, "{ports:?}");
    let seed = u64::from(std::process::id()) | 1;
    println!("seed {seed}");
    let address = bed.host("bridge").address();
    let until = Instant::now() + Duration::from_secs(seconds);
    let go_on = || Instant::now() < until;
    let sent = bed.host("slow").within(|| send(address, &ports, seed, known, go_on));
    assert!(sent > 10_000, "only {sent} datagrams were sent");
    for (role, malformed) in ROLES.into_iter().zip(malformed(bed)) {
        assert_eq!(bed.pids(role).len(), 1, "{role} was restarted\n{}", bed.up.log());
        println!("{role} counted {malformed} malformed of {sent} datagrams");
        assert!(malformed > 0, "{role} counted no malformed datagram of {sent}");
    }
}

/// Sends datagrams while `go_on` is true; returns the number sent.
pub(super) fn send(
    address: Ipv4Addr,
    ports: &[u16],
    seed: u64,
    known: &[Prefix],
    go_on: impl Fn() -> bool,
) -> u64 {
    let socket = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).unwrap();
    let mut random = Random(seed);
    let mut sent = 0;
    while go_on() {
        // About 20,000 datagrams a second: more than a robot's network carries, but few enough that the
        // machine, which also runs the bridge, has time to forward.
        for _ in 0..40 {
            let port = ports[random.below(ports.len())];
            // Also sends to the multicast ports by unicast, to attack only the bridge and not the peers.
            if socket.send_to(&datagram(&mut random, known), (address, port)).is_ok() {
                sent += 1;
            }
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    sent
}

#[test]
fn each_process_counts_each_kind_of_malformed_datagram() {
    let Some(bed) = Bed::start("each_process_counts_each_kind_of_malformed_datagram", SCAN) else { return };
    bed.up.wait_for_log("control is up");
    let processes = bed.discovery_addresses();
    let socket = bed.host("slow").udp_socket();
    let header = [&b"RTPS\x02\x03\x01\x12"[..], &[7; 12]].concat();
    let kinds = [
        ("shorter than a header", header[..19].to_vec()),
        ("not of RTPS", [&b"RTPQ"[..], &header[4..]].concat()),
        ("a submessage without its end", [&header[..], &[0x15, 1, 0xff, 0]].concat()),
    ];
    for (kind, datagram) in kinds {
        let before = malformed(&bed);
        // Again until all count it, because the network may lose datagrams.
        support::wait_until(format!("all processes to count a datagram that is {kind}"), || {
            for process in &processes {
                socket.send_to(&datagram, process).unwrap();
            }
            malformed(&bed).iter().zip(before).all(|(now, before)| *now > before)
        });
    }
    bed.end();
}

/// Tests of a minute or more: `make test-long`.
mod long {
    use super::*;

    #[test]
    fn a_minute_of_malformed_datagrams_at_every_port_loses_no_sample_and_restarts_no_process() {
        let test = "a_minute_of_malformed_datagrams_at_every_port_loses_no_sample_and_restarts_no_process";
        let _alone = support::exclusive();
        let Some(bed) = Bed::start(test, SCAN) else { return };
        // Two subscribers in whose names datagrams come. They may miss samples; the others may not.
        let named = [
            bed.subscribe("slow", Peer::cyclone(), CRITICAL),
            bed.subscribe("slow", Peer::fast().best_effort(), NONCRITICAL),
        ];
        let known = prefixes(readers(&bed.bridge.status()));
        assert_eq!(known.len(), named.len(), "{known:?}");
        let critical = bed.subscribe("critical", Peer::fast().keep_all(), CRITICAL);
        let slow = bed.subscribe("critical", Peer::fast().best_effort(), NONCRITICAL);
        let publisher = bed.publish(Peer::cyclone().keep_all().rate_hz(100.0), INPUT);
        critical.wait_received(50);
        attack(&bed, 60, &known);

        let before = slow.received();
        slow.wait_received(before + 5);
        let sent: Sent = publisher.end();
        critical.wait_received(sent.ok);
        critical.end::<Received>().assert_all_of(&sent);
        slow.end::<Received>().assert_sound();
        bed.wait_accounted();
        bed.end();
    }

    #[test]
    fn malformed_datagrams_in_the_names_of_all_participants_restart_no_process() {
        let test = "malformed_datagrams_in_the_names_of_all_participants_restart_no_process";
        let _alone = support::exclusive();
        let Some(bed) = Bed::start(test, SCAN) else { return };
        let critical = bed.subscribe("critical", Peer::fast().keep_all(), CRITICAL);
        let publisher = bed.publish(Peer::cyclone().rate_hz(100.0), INPUT);
        critical.wait_received(50);
        let status = bed.bridge.status();
        let publishers = status["routes"][0]["publishers"].as_array().unwrap();
        let known = prefixes(readers(&status).chain(publishers.iter().map(|one| &one["writer"])));
        assert_eq!(known.len(), 2, "{status}");
        attack(&bed, 20, &known);
        // What they send in these names may end the flow between them, so the next one is between others.
        drop((critical, publisher));

        let critical = bed.subscribe("critical", Peer::fast().keep_all(), CRITICAL);
        let publisher = bed.publish(Peer::cyclone().keep_all().rate_hz(100.0), INPUT);
        critical.wait_received(200);
        let sent: Sent = publisher.end();
        critical.wait_received(sent.ok);
        critical.end::<Received>().assert_all_of(&sent);
        bed.wait_accounted();
        bed.end();
    }
}
