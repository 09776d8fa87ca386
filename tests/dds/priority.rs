//! Priorities of routes: with a backlog on two routes, the samples of the higher priority go first, in
//! ingress and in both lanes, and none is lost.

use std::collections::BTreeSet;
use std::sync::{Arc, Mutex};

use adaptive_bridge::config::DdsNetwork;
use adaptive_bridge::dds::{Kept, Participant, ParticipantOptions, RawWriter, ReaderQos, WriterEvent};
use adaptive_bridge::model::{Durability, Encapsulation, Guid, QosProfile, Reliability, SourceTimestamp};
use bytes::Bytes;
use support::bed::{is_accounted_and_idle, outputs};
use support::bridge::Bridge;
use support::wait_until;

const TYPE: &str = "std_msgs::msg::dds_::UInt8MultiArray_";
/// More than a lane takes from one route before it serves the next one.
const SAMPLES: usize = 40;

type Order = Arc<Mutex<Vec<Guid>>>;

fn options<'a>(name: &str, network: &'a DdsNetwork) -> ParticipantOptions<'a> {
    let (namespace, node_name) = ("/priority".into(), name.into());
    ParticipantOptions { network, namespace, node_name, graph_gid_bytes: 16, dscp: 0 }
}

/// What a participant calls for each sample that arrives, and the writers of these samples in that order. A
/// sample that is sent again counts once.
fn recorder() -> (impl FnMut([u8; 16], i64, usize), Order) {
    let order = Order::default();
    let recorded = Arc::clone(&order);
    let mut seen = BTreeSet::new();
    let record = move |writer, sequence, _| {
        if seen.insert((writer, sequence)) {
            recorded.lock().unwrap().push(Guid(writer));
        }
    };
    (record, order)
}

fn qos(reliability: Reliability) -> ReaderQos {
    ReaderQos { reliability, durability: Durability::Volatile, depth: 100, deadline_ms: None }
}

fn write(writer: &RawWriter) {
    let payload = Bytes::from_static(&[7; 52]);
    writer
        .write(payload, Encapsulation::CDR_LE, SourceTimestamp::from_wall(adaptive_bridge::clock::wall()))
        .unwrap();
}

/// Waits for the event, which comes when the writer also waits for acknowledgements of the reader.
fn wait_matched(writer: &mut RawWriter) {
    wait_until("a reader", || matches!(writer.poll_event(), Some(WriterEvent::Matched { joined: true, .. })));
}

#[test]
fn a_lane_sends_what_waits_on_the_route_of_the_higher_priority_first() {
    let bridge = Bridge::new(
        "instance: {instance}\nros: {domain_id: 87}\nshared_memory: {root_path: {folder}/root}\n\
         topics:\n\
         - {id: bulk, input_topic: /bulk, max_sample_bytes: 1024}\n\
         - {id: stop, input_topic: /stop, max_sample_bytes: 1024, priority: 1}\n\
         lanes: {noncritical: {stale_threshold_ms: 0}}\n",
    );
    let _ingress = bridge.start("ingress");
    let critical = bridge.start("egress --lane critical");
    let noncritical = bridge.start("egress --lane noncritical");
    let network = DdsNetwork::of_domain(87);
    let mut publisher = Participant::open(&options("publisher", &network)).unwrap();
    let mut bulk = publisher.create_writer("rt/bulk", TYPE, &QosProfile::CRITICAL, 100).unwrap();
    let mut stop = publisher.create_writer("rt/stop", TYPE, &QosProfile::CRITICAL, 100).unwrap();
    wait_matched(&mut bulk);
    wait_matched(&mut stop);
    let (on_arriving, order) = recorder();
    let mut subscriber = Participant::open_receiving(
        &options("subscriber", &network),
        Kept::default(),
        usize::MAX,
        [],
        on_arriving,
        || false,
    )
    .unwrap();
    let mut reader = |lane: &str, route: &str, reliability| {
        let topic = format!("rt/adaptive_bridge/{lane}/{route}");
        subscriber.create_reader(&topic, TYPE, &qos(reliability)).unwrap()
    };
    let _readers = [
        reader("critical", "bulk", Reliability::Reliable),
        reader("critical", "stop", Reliability::Reliable),
        reader("noncritical", "bulk", Reliability::BestEffort),
        reader("noncritical", "stop", Reliability::BestEffort),
    ];
    bridge.wait_status("the subscribers", |status| outputs(status).all(|output| output["readers"] == 1));

    // The first sample of each route shows the writers, whose readers have then joined.
    let writers = || order.lock().unwrap().iter().copied().collect::<BTreeSet<_>>();
    write(&stop);
    wait_until("a sample of the urgent route on both lanes", || writers().len() == 2);
    let urgent = writers();
    write(&bulk);
    wait_until("a sample of the other route on both lanes", || writers().len() == 4);
    bridge.wait_status("the first samples accounted for", is_accounted_and_idle);

    // Both lanes stand still until each route has a backlog.
    critical.stop();
    noncritical.stop();
    order.lock().unwrap().clear();
    for _ in 0..SAMPLES {
        write(&bulk);
    }
    for _ in 0..SAMPLES {
        write(&stop);
    }
    bridge.wait_status("every sample in ingress", |status| {
        (0..2).all(|route| status["routes"][route]["received"] == 1 + SAMPLES)
    });
    critical.cont();
    wait_until("every sample at the critical subscriber", || order.lock().unwrap().len() >= 2 * SAMPLES);
    let arrived = std::mem::take(&mut *order.lock().unwrap());
    let is_urgent: Vec<bool> = arrived.iter().map(|writer| urgent.contains(writer)).collect();
    assert_eq!(is_urgent, [[true; SAMPLES], [false; SAMPLES]].concat());

    // The noncritical lane sends the freshest sample of each route.
    noncritical.cont();
    wait_until("a sample of each route at the noncritical subscriber", || order.lock().unwrap().len() >= 2);
    assert!(urgent.contains(&order.lock().unwrap()[0]));
    let status = bridge.wait_status("every sample accounted for", is_accounted_and_idle);
    for route in 0..2 {
        let output = &status["routes"][route]["lanes"][0];
        assert_eq!(output["lane"], "critical");
        assert_eq!(output["forwarded"], 1 + SAMPLES, "{output}");
    }
}

#[test]
fn ingress_receives_the_routes_of_higher_priorities_before_what_arrived_earlier() {
    let (on_arriving, order) = recorder();
    // The thread that receives is held up here until everything has arrived.
    let hold = Arc::new(Mutex::new(()));
    let on_received = support::waits_for(&hold);
    let network = DdsNetwork::of_domain(88);
    let urgent = ["rt/stop".to_owned()];
    let mut there = Participant::open_receiving(
        &options("there", &network),
        Kept::default(),
        usize::MAX,
        urgent,
        on_arriving,
        on_received,
    )
    .unwrap();
    let _bulk_reader = there.create_reader("rt/bulk", TYPE, &qos(Reliability::Reliable)).unwrap();
    let _stop_reader = there.create_reader("rt/stop", TYPE, &qos(Reliability::Reliable)).unwrap();
    let mut here = Participant::open(&options("here", &network)).unwrap();
    let mut bulk = here.create_writer("rt/bulk", TYPE, &QosProfile::CRITICAL, 100).unwrap();
    let mut stop = here.create_writer("rt/stop", TYPE, &QosProfile::CRITICAL, 100).unwrap();
    wait_matched(&mut bulk);
    wait_matched(&mut stop);
    // The readers are no longer joining when they have acknowledged a sample.
    for writer in [&bulk, &stop] {
        write(writer);
        assert!(writer.wait_acknowledged(support::patience()));
    }
    order.lock().unwrap().clear();
    let held = hold.lock().unwrap();
    for _ in 0..SAMPLES {
        write(&bulk);
    }
    for _ in 0..SAMPLES {
        write(&stop);
    }
    // All of them are then in the sockets.
    wait_until("every sample sent", || [&bulk, &stop].iter().all(|w| w.sent_through() == SAMPLES as i64 + 1));
    drop(held);
    for writer in [&bulk, &stop] {
        assert!(writer.wait_acknowledged(support::patience()));
    }
    let order = order.lock().unwrap();
    let last_urgent = order.iter().rposition(|writer| *writer == stop.guid()).unwrap();
    let bulk_before = order[..last_urgent].iter().filter(|writer| **writer == bulk.guid()).count();
    // Four before each other datagram, and one that was being received.
    assert!(bulk_before <= SAMPLES / 4 + 1, "{bulk_before} of {SAMPLES} were received first");
}
