//! Twenty hostile readers of the critical lane at once: after valid discovery they acknowledge nothing, or
//! send a thousand false ACKNACKs or NACK_FRAGs a second each, some with the GUID of another reader. Other
//! subscribers that keep up must receive every sample.

use std::time::{Duration, Instant};

use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, SCAN_TYPE, outputs};
use support::pacer::paced;
use support::peer::{Library, Peer, Received, RunningPeer, Sent};
use support::ros;
use support::rtps::{EntityId, ForgedReader, Message, NumberSet, Prefix, Writer};

const READERS: u8 = 20;
const ATTACK_TIME: Duration = Duration::from_secs(20);
const LIBRARIES: [Library; 3] = [Library::Rclpy, Library::Fast, Library::Cyclone];
/// Sample sizes: one of 64 is large, which a hostile reader can request with a single bit of an ACKNACK.
const SIZES: [usize; 64] = {
    let mut sizes = [2_948; 64];
    sizes[0] = 512 << 10;
    sizes
};
const YAML: &str = "topics:\n  - {id: scan, input_topic: /scan, message_type: sensor_msgs/msg/LaserScan, \
                    max_sample_bytes: 1048576}\n";
/// Samples that the lane retains for a reader that acknowledges nothing: the default of `window_samples`.
const RETAINED: i64 = 256;

/// The message that a hostile reader sends a thousand times a second.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Attack {
    /// None: acknowledges and requests nothing.
    Silence,
    /// Acknowledges samples that are not written yet.
    Future,
    /// Acknowledges sequence numbers of zero and below.
    Negative,
    /// Acknowledges everything, then nothing, then a half.
    Backwards,
    /// Requests 256 of the retained samples.
    Everything,
    /// Requests the large ones of the retained samples.
    Large,
    /// Requests the first 256 samples that it was offered, which are evicted.
    Evicted,
    /// Requests samples that were never written.
    NeverWritten,
    /// Sends a number set that is larger than allowed.
    TooManyBits,
    /// Requests 256 samples, with `count` fields that jump.
    Counts,
    /// Requests 256 fragments, existing or not, of samples that are retained, evicted or were never written.
    Fragments,
    /// Acknowledges everything with the GUID of another reader.
    ForgedAcknowledgement,
    /// Acknowledges nothing and requests everything with the GUID of another reader.
    ForgedRequest,
}

const ATTACKS: [Attack; READERS as usize] = [
    Attack::Silence,
    Attack::Silence,
    Attack::Silence,
    Attack::Future,
    Attack::Negative,
    Attack::Backwards,
    Attack::Everything,
    Attack::Everything,
    Attack::Large,
    Attack::Large,
    Attack::Evicted,
    Attack::Evicted,
    Attack::NeverWritten,
    Attack::TooManyBits,
    Attack::Counts,
    Attack::Counts,
    Attack::Fragments,
    Attack::Fragments,
    Attack::ForgedAcknowledgement,
    Attack::ForgedRequest,
];

impl Attack {
    /// Makes the datagram number `number`; `others` are the readers whose GUIDs may be forged.
    fn message(
        self,
        reader: &ForgedReader,
        writer: &Writer,
        number: i32,
        others: &[(Prefix, EntityId)],
    ) -> Option<Message> {
        let last = writer.last;
        let pick = |values: &[i64]| values[number as usize % values.len()];
        let own = (reader.prefix(), reader.entity());
        let ack_nack = |(prefix, entity): (Prefix, EntityId), set: NumberSet, count: i32| {
            Some(Message::of(prefix).to(writer.participant).ack_nack(entity, writer.entity, &set, count))
        };
        match self {
            Attack::Silence => None,
            Attack::Future => {
                let bases = [last + 2, last + 1_000, 1 << 61, 1 << 62, i64::MAX - 1, i64::MAX];
                ack_nack(own, NumberSet::none(pick(&bases)), number)
            }
            Attack::Negative => {
                let set = NumberSet { base: pick(&[0, -1, -5, i64::MIN]), ..NumberSet::all(0) };
                ack_nack(own, set, number)
            }
            Attack::Backwards => ack_nack(own, NumberSet::none(pick(&[last + 1, 1, last / 2])), number),
            Attack::Everything => ack_nack(own, NumberSet::all((last - RETAINED + 8).max(1)), number),
            Attack::Large => {
                let first_large = (last - RETAINED + 72) / SIZES.len() as i64 * SIZES.len() as i64 + 1;
                let mut words = vec![0; 8];
                for large in (0..RETAINED as usize).step_by(SIZES.len()) {
                    words[large / 32] |= 1 << 31;
                }
                ack_nack(own, NumberSet { base: first_large, bits: 256, words }, number)
            }
            Attack::Evicted => ack_nack(own, NumberSet::all(writer.first), number),
            Attack::NeverWritten => ack_nack(own, NumberSet::all(last + 1), number),
            Attack::TooManyBits => {
                let bits = pick(&[257, 65_536, i64::from(u32::MAX)]) as u32;
                ack_nack(own, NumberSet { bits, ..NumberSet::all(1) }, number)
            }
            Attack::Counts => {
                let count = pick(&[i64::from(i32::MAX), 0, i64::from(i32::MIN), i64::from(-number)]) as i32;
                ack_nack(own, NumberSet::all((last - i64::from(number % 250)).max(1)), count)
            }
            Attack::Fragments => {
                let large = last / SIZES.len() as i64 * SIZES.len() as i64 + 1;
                let sample = pick(&[large, last, last - i64::from(number % 250), large, 1, last + 5, -1]);
                let base = i64::from(number * 256 % 2_048 + 1);
                let base = pick(&[base, base, base, 1, 0, i64::from(u32::MAX)]);
                let set = NumberSet::all(base);
                let message = Message::of(own.0).to(writer.participant);
                Some(message.nack_frag(own.1, writer.entity, sample, &set, number))
            }
            Attack::ForgedAcknowledgement => {
                let other = *others.get(number as usize % others.len())?;
                ack_nack(other, NumberSet::none(last + 1), number)
            }
            Attack::ForgedRequest => {
                let other = *others.get(number as usize % others.len())?;
                ack_nack(other, NumberSet::all(pick(&[1, last - RETAINED])), number)
            }
        }
    }
}

/// Each reader sends one datagram per millisecond if the machine is fast enough; returns the number sent.
fn run_attacks(readers: &mut [ForgedReader], others: &[(Prefix, EntityId)]) -> u64 {
    let began = Instant::now();
    let mut sent = 0;
    let mut number = 0;
    while began.elapsed() < ATTACK_TIME {
        // The other half of the sockets stays full, like that of a reader that receives nothing.
        for reader in readers.iter_mut().step_by(2) {
            reader.receive();
        }
        let latest = readers.iter().filter_map(|reader| reader.writer()).map(|(writer, _)| writer.last).max();
        for (reader, attack) in readers.iter().zip(ATTACKS) {
            let Some((writer, address)) = reader.writer() else { continue };
            let writer = Writer { last: latest.unwrap_or(0), ..writer };
            if let Some(message) = attack.message(reader, &writer, number, others) {
                reader.send(&message, address);
                sent += 1;
            }
        }
        number += 1;
        let next = began + Duration::from_millis(1) * number as u32;
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

/// Parses a GUID in the format of `status`.
fn guid(text: &str) -> (Prefix, EntityId) {
    let bytes: Vec<u8> = (text.replace(':', "").as_bytes().chunks(2))
        .map(|pair| u8::from_str_radix(str::from_utf8(pair).unwrap(), 16).unwrap())
        .collect();
    (bytes[..12].try_into().unwrap(), bytes[12..].try_into().unwrap())
}

/// The resident memory in bytes and the used CPU time in seconds of a process.
fn usage(pid: i32) -> (u64, f64) {
    let read = |file: &str| std::fs::read_to_string(format!("/proc/{pid}/{file}")).unwrap();
    let statm = read("statm");
    let pages: u64 = statm.split(' ').nth(1).unwrap().parse().unwrap();
    let stat = read("stat");
    // After the program name, the 12th and 13th fields are user and system time.
    let ticks = stat.rsplit(')').next().unwrap().split_whitespace().skip(11).take(2);
    let ticks: f64 = ticks.map(|ticks| ticks.parse::<f64>().unwrap()).sum();
    (pages * 4096, ticks / 100.0)
}

/// The bytes that a host has received.
fn received_bytes(bed: &Bed, host: &str) -> u64 {
    let interfaces = bed.host(host).run("cat", &["/proc/net/dev"]);
    let line = interfaces.lines().find_map(|line| line.trim().strip_prefix("eth0:")).unwrap();
    line.split_whitespace().next().unwrap().parse().unwrap()
}

/// Tests of a minute or more: `make test-long`.
mod long {
    use super::*;

    #[test]
    fn twenty_hostile_readers_cost_the_others_no_sample() {
        let test = "twenty_hostile_readers_cost_the_others_no_sample";
        if let Some(reason) = ros::missing() {
            return support::skip(test, &reason);
        }
        let _alone = support::exclusive();
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
        // The GUIDs of these subscribers are forged.
        let victims = subscribe("victim");
        let victims_address = bed.host("victim").address().to_string();
        let publisher = Peer::cyclone().keep_last(1000).sizes(&SIZES).rate_hz(200.0);
        let publisher = bed.publish(publisher, INPUT);
        healthy[0].wait_received(400);

        let mut readers: Vec<ForgedReader> =
            (0..READERS).map(|identity| ForgedReader::new(bed.host("slow"), identity)).collect();
        support::wait_until("a match with each hostile reader", || {
            for reader in &mut readers {
                reader.receive();
                if reader.writer().is_none() {
                    reader.announce_endpoint(CRITICAL, SCAN_TYPE);
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
        let measure = |what: &str, work: &mut dyn FnMut()| {
            // Subscribes only during `work`, so that its latency is that of this time.
            let probe_subscriber = bed.subscribe("critical", Peer::cyclone().keep_last(1000), CRITICAL);
            let read =
                || (Instant::now(), usage(egress), received_bytes(&bed, "slow"), healthy[0].received());
            let (began, before, bytes_before, samples_before) = read();
            work();
            let (ended, after, bytes_after, samples_after) = read();
            let latency = probe_subscriber.end::<Received>().latency_us;
            let latency =
                latency.map(|latency| format!("{:.0} µs median, {:.0} µs p99", latency.p50, latency.p99));
            let per_s = |amount: f64| amount / ended.duration_since(began).as_secs_f64();
            println!(
                "{what}: critical egress {} to {} KiB resident, CPU {:.0} %; the hostile host received {:.1} MB/s; \
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
        measure("silent readers", &mut || std::thread::sleep(Duration::from_secs(5)));
        let mut sent = 0;
        let (before, after) = paced(&publisher, &healthy, 100, || {
            let memory = measure("attacking readers", &mut || sent = run_attacks(&mut readers, &others));
            // After the attack all subscribers still receive samples.
            for subscriber in healthy.iter().chain(&victims) {
                subscriber.wait_received(subscriber.received() + 50);
            }
            memory
        });
        println!("{sent} hostile datagrams");

        let hostile_address = bed.host("slow").address().to_string();
        let status = bed.bridge.wait_status("the hostile readers in the status", |status| {
            readers.iter().zip(ATTACKS).all(|(reader, attack)| {
                let is_reader = |matched: &&Value| matched["guid"] == reader.guid();
                let Some(matched) = matched_readers(status).iter().find(is_reader) else { return false };
                let is_counted = |key: &str| matched[key].as_u64() > Some(0);
                matched["host"] == *hostile_address
                    && match attack {
                        Attack::Silence => is_counted("unacknowledged"),
                        Attack::Evicted => is_counted("overrun"),
                        _ => true,
                    }
            })
        });
        for (reader, attack) in readers.iter().zip(ATTACKS) {
            let matched = matched_readers(&status).iter().find(|matched| matched["guid"] == reader.guid());
            println!("{attack:?}: {}", matched.unwrap_or(&Value::Null));
        }

        let sent: Sent = publisher.end();
        sent.assert_not_blocked();
        for subscriber in healthy {
            subscriber.wait_received(sent.ok);
            let received: Received = subscriber.end();
            received.assert_all_of(&sent);
        }
        for victim in victims {
            victim.wait_for("the last sample", |event| event["last"] == sent.last);
            let received: Received = victim.end();
            received.assert_sound();
            println!(
                "{} of {} samples received by a subscriber whose GUID was forged",
                received.received, sent.ok
            );
        }
        let status = bed.wait_accounted();
        assert_eq!(critical(&status)["forwarded"], sent.ok, "{status}");
        for role in ["ingress", "egress-critical", "egress-noncritical"] {
            assert_eq!(bed.pids(role).len(), 1, "{role} was restarted\n{}", bed.up.log());
        }
        // The samples that the lane retains, 32 MiB at most, and as much again for samples that are being
        // sent.
        assert!(after < before + (64 << 20), "{before} to {after} bytes resident");
        bed.end();
    }
}
