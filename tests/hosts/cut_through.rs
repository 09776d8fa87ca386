//! Large samples that the critical lane sends while they arrive: no subscriber gets a sample that ingress has
//! not published, or a part of another one, and none misses a sample. Peers compare each byte.

use adaptive_bridge::config::DdsNetwork;
use adaptive_bridge::dds::{Participant, ParticipantOptions, RawWriter, ReaderQos, Take};
use adaptive_bridge::model::{Durability, Encapsulation, QosProfile, Reliability, SourceTimestamp};
use bytes::Bytes;
use nix::sys::signal::Signal;
use serde_json::Value;
use support::bed::{Bed, outputs};
use support::peer::{Library, Peer, Received, RunningPeer, Sent};
use support::process::signal;

const YAML: &str = "topics:\n  - {id: camera, input_topic: /camera, message_type: sensor_msgs/msg/PointCloud2, \
                    max_sample_bytes: 4194304}\nlanes: {critical: {queue_depth: 64}}\n";
const INPUT: &str = "rt/camera";
const TYPE: &str = "sensor_msgs::msg::dds_::PointCloud2_";
const CRITICAL: &str = "rt/adaptive_bridge/critical/camera";
const MIB: usize = 1 << 20;

fn camera(library: Library) -> Peer {
    let peer = Peer::on(library).type_name(TYPE).large_socket_buffers();
    peer.keep_last(30)
}

fn critical(status: &Value) -> &Value {
    outputs(status).find(|output| output["lane"] == "critical").unwrap()
}

fn count(status: &Value, what: &str) -> u64 {
    critical(status)[what].as_u64().unwrap_or_else(|| panic!("{what}: {status}"))
}

/// Waits until each subscriber has every sample that the lane has forwarded, and ends them.
fn compare(bed: &Bed, subscribers: Vec<RunningPeer>) -> Value {
    let status = bed.wait_accounted();
    let forwarded = count(&status, "forwarded");
    // A busy machine may keep a subscriber from reading for longer than the lane retains samples. That of the
    // subscriber with the most: `reader_overrun` is the sum of both, and may be more than was forwarded.
    let readers = critical(&status)["matched_readers"].as_array().unwrap();
    let overrun = readers.iter().map(|reader| reader["overrun"].as_u64().unwrap()).max().unwrap();
    for subscriber in subscribers {
        subscriber.wait_received(forwarded - overrun);
        let received: Received = subscriber.end();
        assert_eq!((received.bad, received.duplicates), (0, 0), "{received:?}");
        assert!(received.received <= forwarded, "{received:?} {status}");
    }
    println!("{forwarded} forwarded, {} begun early, {} withdrawn", count(&status, "begun_early"), {
        count(&status, "withdrawn")
    });
    status
}

/// A participant in the test's own process.
fn participant(bed: &Bed, host: &str) -> Participant {
    let options = ParticipantOptions {
        network: &DdsNetwork::of_domain(0),
        namespace: "/".into(),
        node_name: "stops".into(),
        graph_gid_bytes: 16,
        dscp: 0,
    };
    bed.host(host).within(|| Participant::open(&options).unwrap())
}

fn wait_matched(writer: &RawWriter, what: &str) {
    support::wait_until(what, || writer.matched_readers().next().is_some());
}

/// Sends three quarters of a sample, and gives the lane time to send as much.
fn begin_and_pause(writer: &RawWriter, payload: Bytes, number: u64) -> SourceTimestamp {
    let timestamp = SourceTimestamp(number << 32);
    assert!(writer.begin_early(payload, Encapsulation::CDR_LE, timestamp, MIB * 3 / 4));
    #[allow(clippy::disallowed_methods, reason = "the lane could send the whole sample several times")]
    std::thread::sleep(std::time::Duration::from_millis(100));
    timestamp
}

fn subscribers(bed: &Bed) -> Vec<RunningPeer> {
    let subscribe = |library| bed.subscribe("critical", camera(library), CRITICAL);
    [Library::Fast, Library::Cyclone].map(subscribe).into()
}

#[test]
fn samples_of_two_publishers_are_sent_while_they_arrive() {
    let test = "samples_of_two_publishers_are_sent_while_they_arrive";
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, YAML) else { return };
    let subscribers = subscribers(&bed);
    let publish = |(number, library)| {
        let peer = camera(library).sizes(&[MIB, 200_000, 3_000, 700_001]).rate_hz(30.0).count(100);
        bed.publish(peer.first_seq(1 + number * 1_000), INPUT)
    };
    let publishers = [(0_u64, Library::Fast), (1, Library::Cyclone)].map(publish);
    for publisher in publishers {
        let sent: Sent = publisher.finish();
        assert_eq!((sent.ok, sent.failed), (100, 0));
    }
    let status = compare(&bed, subscribers);
    assert_eq!(count(&status, "forwarded"), 200, "{status}");
    // A busy machine may complete some samples before the lane runs.
    assert!(count(&status, "begun_early") >= 20, "{status}");
    bed.end();
}

#[test]
fn a_publisher_that_dies_in_the_middle_of_a_sample_costs_the_others_nothing() {
    let test = "a_publisher_that_dies_in_the_middle_of_a_sample_costs_the_others_nothing";
    let Some(bed) = Bed::start(test, YAML) else { return };
    let subscribers = subscribers(&bed);
    let steady = bed.publish(camera(Library::Cyclone).size(MIB).rate_hz(30.0), INPUT);
    for round in 1..=20 {
        let peer = camera(Library::Fast).size(MIB).rate_hz(20.0).first_seq(1 + round * 10_000);
        let mut dying = bed.publish(peer, INPUT);
        support::wait_until("a sample", || dying.written() > round % 3);
        dying.kill9();
    }
    let sent: Sent = steady.end();
    assert_eq!(sent.failed, 0, "{sent:?}");
    let status = compare(&bed, subscribers);
    assert!(count(&status, "forwarded") >= sent.ok, "{status}");
    bed.end();
}

#[test]
fn samples_that_never_become_complete_are_withdrawn() {
    let test = "samples_that_never_become_complete_are_withdrawn";
    let Some(bed) = Bed::start(test, YAML) else { return };
    let subscribers = subscribers(&bed);
    let mut node = participant(&bed, "publisher");
    let writer = node.create_writer(INPUT, TYPE, &QosProfile::CRITICAL, 64).unwrap();
    wait_matched(&writer, "ingress");
    let steady = bed.publish(camera(Library::Cyclone).size(MIB).rate_hz(10.0), INPUT);
    // The publisher sends three quarters of each sample. On a busy machine they may arrive too slowly for the
    // lane to begin; and ingress lends the DDS library two slots at a time.
    let mut number = 0;
    support::wait_until("samples that were withdrawn", || {
        number += 1;
        let payload = Bytes::from(vec![0xEE; MIB]);
        let timestamp = SourceTimestamp(number << 32);
        assert!(writer.begin_early(payload, Encapsulation::CDR_LE, timestamp, MIB * 3 / 4));
        #[allow(clippy::disallowed_methods, reason = "five periods of the other publisher")]
        std::thread::sleep(std::time::Duration::from_millis(500));
        writer.withdraw_early();
        #[allow(clippy::disallowed_methods, reason = "three periods of housekeeping")]
        std::thread::sleep(std::time::Duration::from_millis(300));
        count(&bed.bridge.status(), "withdrawn") >= 5
    });
    let sent: Sent = steady.end();
    assert_eq!(sent.failed, 0, "{sent:?}");
    let status = compare(&bed, subscribers);
    assert_eq!(count(&status, "forwarded"), sent.ok, "{status}");
    bed.end();
}

#[test]
fn of_a_sample_that_pauses_no_byte_is_sent_before_it_has_arrived() {
    let test = "of_a_sample_that_pauses_no_byte_is_sent_before_it_has_arrived";
    let Some(bed) = Bed::start(test, YAML) else { return };
    let [mut here, mut there] = ["publisher", "critical"].map(|host| participant(&bed, host));
    let qos = ReaderQos {
        reliability: Reliability::Reliable,
        durability: Durability::Volatile,
        depth: 10,
        deadline_ms: None,
    };
    let reader = there.create_reader(CRITICAL, TYPE, &qos).unwrap();
    let writer = here.create_writer(INPUT, TYPE, &QosProfile::CRITICAL, 64).unwrap();
    wait_matched(&writer, "ingress");
    bed.bridge.wait_status("the subscriber", |status| count(status, "readers") == 1);
    let mut number = 0;
    // On a busy machine some arrive too slowly for the lane to begin.
    support::wait_until("samples that were begun early", || {
        number += 1;
        let payload = || Bytes::from(vec![number; MIB]);
        let timestamp = begin_and_pause(&writer, payload(), number.into());
        writer.complete_early(payload(), Encapsulation::CDR_LE, timestamp).unwrap();
        // The slot has bytes of former samples where this one has not arrived.
        let mut wrong = None;
        support::wait_until(format!("sample {number}"), || {
            let mut count_wrong = |bytes: &[u8], _| {
                let others = bytes.iter().filter(|byte| **byte != number).count();
                wrong = Some((bytes.len(), others));
            };
            matches!(reader.take(&mut count_wrong), Take::Sample(_))
        });
        assert_eq!(wrong, Some((MIB, 0)), "sample {number}");
        count(&bed.bridge.status(), "begun_early") >= 5
    });
    let status = bed.wait_accounted();
    assert_eq!(count(&status, "forwarded"), u64::from(number), "{status}");
    drop(reader);
    bed.end();
}

#[test]
fn a_sample_is_begun_early_after_one_that_was_withdrawn() {
    let test = "a_sample_is_begun_early_after_one_that_was_withdrawn";
    let Some(bed) = Bed::start(test, YAML) else { return };
    let subscriber = bed.subscribe("critical", camera(Library::Cyclone), CRITICAL);
    let mut node = participant(&bed, "publisher");
    let writer = node.create_writer(INPUT, TYPE, &QosProfile::CRITICAL, 64).unwrap();
    wait_matched(&writer, "ingress");
    let mut number = 0;
    support::wait_until("samples that were begun early and withdrawn", || {
        number += 1;
        begin_and_pause(&writer, Bytes::from(vec![0xEE; MIB]), number);
        writer.withdraw_early();
        #[allow(clippy::disallowed_methods, reason = "three periods of housekeeping")]
        std::thread::sleep(std::time::Duration::from_millis(300));
        // No sample is written in between, which would end the one that was begun.
        let status = bed.bridge.status();
        count(&status, "begun_early").min(count(&status, "withdrawn")) >= 3
    });
    assert_eq!(subscriber.received(), 0);
    let _: Received = subscriber.end();
    bed.end();
}

/// The most kills before the supervisor waits for seconds until it starts ingress again.
const KILLS: u64 = 10;

/// Kills ingress ten times, each time after another delay, so that it dies in the middle of samples.
fn kill_ingress(test: &str, first_kill: u64) {
    let Some(bed) = Bed::start(test, YAML) else { return };
    let subscribers = subscribers(&bed);
    let publisher = bed.publish(camera(Library::Fast).size(2 * MIB).rate_hz(20.0), INPUT);
    for kill in 1..=KILLS {
        for subscriber in &subscribers {
            subscriber.wait_received(subscriber.received() + 5);
        }
        #[allow(clippy::disallowed_methods, reason = "a period of 20 Hz has 50 ms")]
        std::thread::sleep(std::time::Duration::from_micros((first_kill + kill) * 3_237 % 50_000));
        signal(bed.pid("ingress"), Signal::SIGKILL);
        support::wait_until("a restart", || bed.pids("ingress").len() as u64 == kill + 1);
    }
    publisher.end::<Sent>();
    compare(&bed, subscribers);
    bed.end();
}

#[test]
fn no_reader_waits_for_a_sample_of_a_killed_ingress() {
    kill_ingress("no_reader_waits_for_a_sample_of_a_killed_ingress", 0);
}

/// Tests of a minute or more: `make test-long`.
mod long {
    use super::KILLS;

    #[test]
    fn no_reader_waits_for_a_sample_of_200_killed_ingresses() {
        let kill_100 = |first: u64| {
            for first_kill in (first..first + 100).step_by(KILLS as usize) {
                super::kill_ingress("no_reader_waits_for_a_sample_of_200_killed_ingresses", first_kill);
            }
        };
        // Two bridges at once: most of the time goes to the waits of `up` before it restarts ingress.
        std::thread::scope(|scope| {
            scope.spawn(|| kill_100(0));
            kill_100(100);
        });
    }
}
