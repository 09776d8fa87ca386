//! Floods of ROS 2 graph entries: how many of them one poll takes, and what the DDS library keeps.

use std::time::Duration;

use adaptive_bridge::config::DdsNetwork;
use adaptive_bridge::dds::{GraphWatch, Participant, ParticipantOptions, RawWriter};
use adaptive_bridge::model::{Durability, Encapsulation, QosProfile, SourceTimestamp};
use bytes::Bytes;

const TYPE: &str = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";
const QOS: QosProfile = QosProfile { durability: Durability::TransientLocal, ..QosProfile::CRITICAL };

fn participant(name: &str) -> Participant {
    let network = &DdsNetwork::of_domain(64);
    let (namespace, node_name) = ("/test".into(), name.into());
    Participant::open(&ParticipantOptions { network, namespace, node_name, graph_gid_bytes: 16, dscp: 0 })
        .unwrap()
}

/// Writes malformed entries, and waits until they have all arrived at the only reader.
fn write(writer: &RawWriter, count: usize, bytes: usize) {
    for number in 1..=count {
        writer.write(Bytes::from(vec![0xff; bytes]), Encapsulation::CDR_LE, SourceTimestamp::NONE).unwrap();
        // In small steps, because the history of the writer is short.
        if number.is_multiple_of(5) {
            assert!(writer.wait_acknowledged(Duration::from_secs(20)), "an entry has not arrived");
        }
    }
}

/// The number of malformed entries that one poll takes.
fn polled(watch: &mut GraphWatch) -> u64 {
    let before = watch.refusals().malformed;
    watch.poll();
    watch.refusals().malformed - before
}

#[test]
fn a_poll_takes_a_limited_part_of_a_flood_of_graph_entries() {
    let mut here = participant("here");
    let own = here.create_writer("rt/own", TYPE, &QOS, 1).unwrap();
    let mut watch = here.watch_graph().unwrap();
    let mut there = participant("there");
    let writer = there.create_writer("ros_discovery_info", TYPE, &QOS, 64).unwrap();
    support::wait_until("the reader of the graph", || writer.matched_readers().next().is_some());
    // The entries that the participants publish of themselves would count among the 256: they come first.
    support::wait_until("the entries of both participants", || {
        watch.poll();
        watch.node_of(writer.guid()).is_some() && watch.node_of(own.guid()).is_some()
    });

    write(&writer, 400, 100);
    assert_eq!([(); 3].map(|()| polled(&mut watch)), [256, 144, 0]);
    // 4 MiB are kept of 6 MB, and the last sample; a poll takes no further one after 2 MiB.
    write(&writer, 30, 200_000);
    assert_eq!([(); 3].map(|()| polled(&mut watch)), [11, 10, 0]);
}
