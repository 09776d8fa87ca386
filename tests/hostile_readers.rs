//! Twenty hostile readers of the critical lane at once: their discovery is valid, and then they acknowledge
//! nothing, or lie in ACKNACKs and NACK_FRAGs a thousand times a second each, some of them in the name of
//! other readers. Beside them subscribers that keep up receive every sample.

mod support;

use std::time::{Duration, Instant};

use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, SCAN_TYPE, outputs};
use support::peer::{Library, Peer, Received, RunningPeer, Sent};
use support::ros;
use support::rtps::{EntityId, ForgedReader, Message, NumberSet, Prefix, Writer};

const READERS: u8 = 20;
const ATTACK: Duration = Duration::from_secs(20);
const LIBRARIES: [Library; 3] = [Library::Rclpy, Library::Fast, Library::Cyclone];
/// One sample of 64 is a large one, which a hostile reader requests by one bit of an ACKNACK.
const SIZES: [usize; 64] = {
    let mut sizes = [2_948; 64];
    sizes[0] = 512 << 10;
    sizes
};
const YAML: &str = "topics:\n  - {id: scan, input_topic: /scan, message_type: sensor_msgs/msg/LaserScan, \
                    max_sample_bytes: 1048576}\n";
/// Samples that the lane retains for readers that acknowledge nothing: `window_samples`.
const RETAINED: i64 = 256;

/// What a hostile reader does a thousand times a second.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Lie {
    /// It acknowledges nothing and requests nothing.
    Silence,
    /// It acknowledges what was not written yet.
    Future,
    /// It acknowledges zero and less.
    Negative,
    /// It acknowledges everything, then nothing, then a half.
    Backwards,
    /// It requests 256 samples of those that are retained.
    Everything,
    /// It requests the large ones of those that are retained.
    Large,
    /// It requests the first 256 samples that it was offered, which are gone.
    Gone,
    /// It requests samples that were never written.
    NeverWritten,
    /// Its set is larger than a set can be.
    TooManyBits,
    /// It requests 256 samples, with counts that jump.
    Counts,
    /// It requests 256 fragments of samples that are there, gone, or never were, also such as no sample has.
    Fragments,
    /// In the name of another reader it acknowledges everything.
    OthersEverything,
    /// In the name of another reader it acknowledges nothing and requests everything.
    OthersNothing,
}

const LIES: [Lie; READERS as usize] = [
    Lie::Silence,
    Lie::Silence,
    Lie::Silence,
    Lie::Future,
    Lie::Negative,
    Lie::Backwards,
    Lie::Everything,
    Lie::Everything,
    Lie::Large,
    Lie::Large,
    Lie::Gone,
    Lie::Gone,
    Lie::NeverWritten,
    Lie::TooManyBits,
    Lie::Counts,
    Lie::Counts,
    Lie::Fragments,
    Lie::Fragments,
    Lie::OthersEverything,
    Lie::OthersNothing,
];

impl Lie {
    /// The datagram of that number; `others` are readers that it may speak for.
    fn message(
        self,
        forged: &ForgedReader,
        writer: &Writer,
        turn: i32,
        others: &[(Prefix, EntityId)],
    ) -> Option<Message> {
        let last = writer.last;
        let pick = |values: &[i64]| values[turn as usize % values.len()];
        let own = (forged.prefix(), forged.entity());
        let ack_nack = |(prefix, entity): (Prefix, EntityId), set: NumberSet, count: i32| {
            Some(Message::of(prefix).to(writer.participant).ack_nack(entity, writer.entity, &set, count))
        };
        match self {
            Lie::Silence => None,
            Lie::Future => {
                let bases = [last + 2, last + 1_000, 1 << 61, 1 << 62, i64::MAX - 1, i64::MAX];
                ack_nack(own, NumberSet::none(pick(&bases)), turn)
            }
            Lie::Negative => {
                let set = NumberSet { base: pick(&[0, -1, -5, i64::MIN]), ..NumberSet::all(0) };
                ack_nack(own, set, turn)
            }
            Lie::Backwards => ack_nack(own, NumberSet::none(pick(&[last + 1, 1, last / 2])), turn),
            Lie::Everything => ack_nack(own, NumberSet::all((last - RETAINED + 8).max(1)), turn),
            Lie::Large => {
                let first_large = (last - RETAINED + 72) / SIZES.len() as i64 * SIZES.len() as i64 + 1;
                let mut words = vec![0; 8];
                for large in (0..RETAINED as usize).step_by(SIZES.len()) {
                    words[large / 32] |= 1 << 31;
                }
                ack_nack(own, NumberSet { base: first_large, bits: 256, words }, turn)
            }
            Lie::Gone => ack_nack(own, NumberSet::all(writer.first), turn),
            Lie::NeverWritten => ack_nack(own, NumberSet::all(last + 1), turn),
            Lie::TooManyBits => {
                let bits = pick(&[257, 65_536, i64::from(u32::MAX)]) as u32;
                ack_nack(own, NumberSet { bits, ..NumberSet::all(1) }, turn)
            }
            Lie::Counts => {
                let count = pick(&[i64::from(i32::MAX), 0, i64::from(i32::MIN), i64::from(-turn)]) as i32;
                ack_nack(own, NumberSet::all((last - i64::from(turn % 250)).max(1)), count)
            }
            Lie::Fragments => {
                let large = last / SIZES.len() as i64 * SIZES.len() as i64 + 1;
                let sample = pick(&[large, last, last - i64::from(turn % 250), large, 1, last + 5, -1]);
                let base = i64::from(turn * 256 % 2_048 + 1);
                let base = pick(&[base, base, base, 1, 0, i64::from(u32::MAX)]);
                let set = NumberSet::all(base);
                let message = Message::of(own.0).to(writer.participant);
                Some(message.nack_frag(own.1, writer.entity, sample, &set, turn))
            }
            Lie::OthersEverything => {
                let other = *others.get(turn as usize % others.len())?;
                ack_nack(other, NumberSet::none(last + 1), turn)
            }
            Lie::OthersNothing => {
                let other = *others.get(turn as usize % others.len())?;
                ack_nack(other, NumberSet::all(pick(&[1, last - RETAINED])), turn)
            }
        }
    }
}

/// Each reader sends a datagram each millisecond, as far as the machine has time for it; how many it were.
fn attack(readers: &mut [ForgedReader], others: &[(Prefix, EntityId)]) -> u64 {
    let began = Instant::now();
    let mut sent = 0;
    let mut turn = 0;
    while began.elapsed() < ATTACK {
        // Half of the queues stay full, as those of a reader do that takes nothing.
        for reader in readers.iter_mut().step_by(2) {
            reader.listen();
        }
        let latest = readers.iter().filter_map(|reader| reader.writer()).map(|(writer, _)| writer.last).max();
        for (reader, lie) in readers.iter().zip(LIES) {
            let Some((writer, address)) = reader.writer() else { continue };
            let writer = Writer { last: latest.unwrap_or(0), ..writer };
            if let Some(message) = lie.message(reader, &writer, turn, others) {
                reader.send(&message, address);
                sent += 1;
            }
        }
        turn += 1;
        let next = began + Duration::from_millis(1) * turn as u32;
        std::thread::sleep(next.saturating_duration_since(Instant::now()));
    }
    sent
}

fn critical(status: &Value) -> &Value {
    outputs(status).find(|output| output["lane"] == "critical").unwrap_or_else(|| panic!("{status}"))
}

fn matched_readers(status: &Value) -> &[Value] {
    critical(status)["matched_readers"].as_array().map(Vec::as_slice).unwrap_or_default()
}

/// A GUID as `status` shows it.
fn guid(shown: &str) -> (Prefix, EntityId) {
    let bytes: Vec<u8> = (shown.replace(':', "").as_bytes().chunks(2))
        .map(|pair| u8::from_str_radix(str::from_utf8(pair).unwrap(), 16).unwrap())
        .collect();
    (bytes[..12].try_into().unwrap(), bytes[12..].try_into().unwrap())
}

/// Bytes of resident memory, and seconds of CPU used.
fn usage(pid: i32) -> (u64, f64) {
    let read = |file: &str| std::fs::read_to_string(format!("/proc/{pid}/{file}")).unwrap();
    let statm = read("statm");
    let pages: u64 = statm.split(' ').nth(1).unwrap().parse().unwrap();
    let stat = read("stat");
    // After the name of the program: state, and so on; the 12th and 13th are user and system time.
    let ticks = stat.rsplit(')').next().unwrap().split_whitespace().skip(11).take(2);
    let ticks: f64 = ticks.map(|ticks| ticks.parse::<f64>().unwrap()).sum();
    (pages * 4096, ticks / 100.0)
}

/// Bytes that a host has received.
fn received_bytes(bed: &Bed, host: &str) -> u64 {
    let interfaces = bed.host(host).run("cat", &["/proc/net/dev"]);
    let line = interfaces.lines().find_map(|line| line.trim().strip_prefix("eth0:")).unwrap();
    line.split_whitespace().next().unwrap().parse().unwrap()
}

#[test]
fn twenty_hostile_readers_cost_the_others_no_sample() {
    let test = "twenty_hostile_readers_cost_the_others_no_sample";
    if let Some(reason) = ros::missing() {
        return support::skip(test, &reason);
    }
    let Some(bed) = Bed::start_with(test, YAML, &["victim"]) else { return };
    let subscribe = |host: &str| -> Vec<RunningPeer> {
        LIBRARIES
            .map(|library| match library {
                Library::Rclpy => Peer::rclpy("planner"),
                other => Peer::on(other),
            })
            .map(|peer| bed.subscribe(host, peer.keep_last(1000).sizes(&SIZES), CRITICAL))
            .into()
    };
    let healthy = subscribe("critical");
    // Acknowledgements are forged in the name of these.
    let victims = subscribe("victim");
    let victims_address = bed.host("victim").address().to_string();
    let publisher = Peer::cyclone().keep_last(1000).sizes(&SIZES).rate_hz(200.0);
    let publisher = bed.publish(publisher, INPUT);
    healthy[0].wait_received(400);

    let mut readers: Vec<ForgedReader> =
        (0..READERS).map(|identity| ForgedReader::new(bed.host("slow"), identity)).collect();
    support::wait_until("a match with each hostile reader", || {
        for reader in &mut readers {
            reader.listen();
            if reader.writer().is_none() {
                reader.announce(CRITICAL, SCAN_TYPE);
            }
        }
        std::thread::sleep(Duration::from_millis(50));
        readers.iter().all(|reader| reader.writer().is_some())
    });
    let status = bed.bridge.wait_status("hosts of the victims", |status| {
        matched_readers(status).iter().filter(|reader| reader["host"] == *victims_address).count()
            == LIBRARIES.len()
    });
    let others: Vec<(Prefix, EntityId)> = matched_readers(&status)
        .iter()
        .filter(|reader| reader["host"] == *victims_address)
        .map(|reader| guid(reader["guid"].as_str().unwrap()))
        .collect();

    let egress = bed.pid("egress-critical");
    let watched = |what: &str, work: &mut dyn FnMut()| {
        // It joins and leaves, so that its latency is that of the meantime.
        let witness = bed.subscribe("critical", Peer::cyclone().keep_last(1000), CRITICAL);
        let look = || (Instant::now(), usage(egress), received_bytes(&bed, "slow"), healthy[0].received());
        let (began, before, bytes_before, samples_before) = look();
        work();
        let (ended, after, bytes_after, samples_after) = look();
        let latency = witness.end::<Received>().latency_us;
        let latency =
            latency.map(|latency| format!("{:.0} µs median, {:.0} µs p99", latency.p50, latency.p99));
        let per_s = |amount: f64| amount / ended.duration_since(began).as_secs_f64();
        println!(
            "{what}: critical egress {} to {} KiB resident, CPU {:.0} %; the hostile host got {:.1} MB/s; \
             rclpy received {:.0} samples/s; latency {}",
            before.0 >> 10,
            after.0 >> 10,
            per_s(after.1 - before.1) * 100.0,
            per_s((bytes_after - bytes_before) as f64) / 1e6,
            per_s((samples_after - samples_before) as f64),
            latency.unwrap_or_default(),
        );
        (before.0, after.0)
    };
    watched("silent readers", &mut || std::thread::sleep(Duration::from_secs(5)));
    let mut lies = 0;
    let (before, after) = watched("lying readers", &mut || lies = attack(&mut readers, &others));
    println!("{lies} lies");

    // The attack is over; everybody goes on.
    for subscriber in healthy.iter().chain(&victims) {
        subscriber.wait_received(subscriber.received() + 50);
    }
    let hostile_address = bed.host("slow").address().to_string();
    let status = bed.bridge.wait_status("the hostile readers by name", |status| {
        readers.iter().zip(LIES).all(|(reader, lie)| {
            let of_reader = |shown: &&Value| shown["guid"] == reader.guid();
            let Some(shown) = matched_readers(status).iter().find(of_reader) else { return false };
            let missed = |key: &str| shown[key].as_u64() > Some(0);
            shown["host"] == *hostile_address
                && match lie {
                    Lie::Silence => missed("unacknowledged"),
                    Lie::Gone => missed("overrun"),
                    _ => true,
                }
        })
    });
    for (reader, lie) in readers.iter().zip(LIES) {
        let shown = matched_readers(&status).iter().find(|shown| shown["guid"] == reader.guid());
        println!("{lie:?}: {}", shown.unwrap_or(&Value::Null));
    }

    let sent: Sent = publisher.end();
    assert_eq!(sent.failed, 0, "no call of the publisher waited in vain: {sent:?}");
    for subscriber in healthy {
        subscriber.wait_received(sent.ok);
        let received: Received = subscriber.end();
        received.assert_all_of(&sent);
    }
    for victim in victims {
        victim.wait_for("the last sample", |event| event["last"] == sent.last);
        let received: Received = victim.end();
        received.assert_sound();
        println!("{} of {} samples of one in whose name was lied", received.received, sent.ok);
    }
    let status = bed.wait_whole();
    assert_eq!(critical(&status)["forwarded"], sent.ok, "{status}");
    for role in ["ingress", "egress-critical", "egress-noncritical"] {
        assert_eq!(bed.pids(role).len(), 1, "{role} was restarted\n{}", bed.up.log());
    }
    // What the lane retains, 32 MiB at most, and as much again for what is being sent.
    assert!(after < before + (64 << 20), "{before} to {after} bytes resident");
    bed.end();
}
