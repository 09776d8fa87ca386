//! The demo's publisher and subscribers: ordinary DDS programs, each a process of its own and independent of
//! the bridge.

use std::convert::Infallible;
use std::error::Error;
use std::io::{self, Write};
use std::net::Ipv4Addr;
use std::process::ExitCode;
use std::sync::Arc;
use std::task::Waker;
use std::thread;
use std::time::Duration;

use bytes::Bytes;
use clap::Args;

use super::report::Report;
use super::scan::{DDS_TYPE, Scan};
use super::{HISTORY_SCANS, MAX_BLOCKING_MS, due_at, first_due_after};
use crate::cli::{failed, topic};
use crate::clock;
use crate::config::{DdsNetwork, NetworkSelector};
use crate::dds::{ArrivalFlag, DdsError, Participant, ParticipantOptions, ReaderQos, Take};
use crate::model::{Durability, Encapsulation, History, QosProfile, Reliability, SourceTimestamp, TopicName};

/// History depth of the subscribers' readers: more than two seconds of scans, so that none is lost there.
const READER_DEPTH: u32 = 64;

/// QoS of the publisher: it keeps unacknowledged scans, up to [`HISTORY_SCANS`].
const PUBLISHER_QOS: QosProfile = QosProfile { history: History::KeepAll, ..QosProfile::CRITICAL };

/// The arguments of the demo's publisher.
#[derive(Args, Debug)]
pub(in crate::cli) struct PeerArguments {
    /// DDS domain
    #[arg(long)]
    domain: u16,
    /// ROS 2 topic
    #[arg(long, value_parser = topic)]
    topic: TopicName,
}

/// The arguments of a subscriber of the demo.
#[derive(Args, Debug)]
pub(in crate::cli) struct SubscriberArguments {
    #[command(flatten)]
    peer: PeerArguments,
    /// Name of the node
    #[arg(long)]
    name: String,
    /// Request BEST_EFFORT
    #[arg(long)]
    best_effort: bool,
}

pub(in crate::cli) fn publisher(arguments: &PeerArguments) -> ExitCode {
    let Err(error) = publish(arguments);
    failed(&error)
}

pub(in crate::cli) fn subscriber(arguments: &SubscriberArguments) -> ExitCode {
    let Err(error) = subscribe(arguments);
    failed(&error)
}

/// Publishes scans like a timer of rclcpp: scans that become due during a publish call are skipped.
fn publish(arguments: &PeerArguments) -> Result<Infallible, Box<dyn Error>> {
    let mut participant = join(arguments.domain, "publisher")?;
    let writer = participant.create_blocking_writer(
        &arguments.topic.to_dds(),
        DDS_TYPE,
        &PUBLISHER_QOS,
        HISTORY_SCANS,
        Duration::from_millis(MAX_BLOCKING_MS),
    )?;
    let began_at = clock::monotonic();
    report(Report::Began { at: began_at })?;
    let mut number = 0;
    loop {
        #[allow(clippy::disallowed_methods, reason = "the demo's publisher keeps its rate")]
        thread::sleep(Duration::from_nanos(due_at(began_at, number).since(clock::monotonic())));
        let taken_at = clock::monotonic();
        let payload = Bytes::from(Scan { number, taken_at }.encode());
        let timestamp = SourceTimestamp::from_wall(clock::wall());
        let written = writer.write(payload, Encapsulation::CDR_LE, timestamp).is_ok();
        let returned_at = clock::monotonic();
        report(Report::Published { number, call_ns: returned_at.since(taken_at), written })?;
        number += 1;
        // A scan that was already due before the call is late because this process was not scheduled: it is
        // published late, not skipped.
        if due_at(began_at, number) >= taken_at {
            number = first_due_after(began_at, returned_at).max(number);
        }
    }
}

fn subscribe(arguments: &SubscriberArguments) -> Result<Infallible, Box<dyn Error>> {
    let mut participant = join(arguments.peer.domain, &arguments.name)?;
    let qos = ReaderQos {
        reliability: match arguments.best_effort {
            true => Reliability::BestEffort,
            false => Reliability::Reliable,
        },
        durability: Durability::Volatile,
        depth: READER_DEPTH,
        deadline_ms: None,
    };
    let reader = participant.create_reader(&arguments.peer.topic.to_dds(), DDS_TYPE, &qos)?;
    let flag = ArrivalFlag::of_this_thread();
    let waker = Waker::from(Arc::clone(&flag));
    loop {
        reader.arm(&waker);
        loop {
            let mut scan = None;
            let taken = reader.take(&mut |payload, _| scan = Scan::decode(payload));
            let arrived_at = clock::monotonic();
            if let Some(Scan { number, taken_at }) = scan {
                report(Report::Arrived { number, taken_at, arrived_at })?;
            }
            if taken == Take::Empty {
                break;
            }
        }
        while !flag.clear() {
            #[allow(clippy::disallowed_methods, reason = "the demo is no part of the bridge")]
            thread::park();
        }
    }
}

fn join(domain_id: u16, name: &str) -> Result<Participant, DdsError> {
    Participant::open(&ParticipantOptions {
        network: &DdsNetwork {
            interfaces: vec![NetworkSelector::Address(Ipv4Addr::LOCALHOST)],
            ..DdsNetwork::of_domain(domain_id)
        },
        namespace: "/demo".to_owned(),
        node_name: name.to_owned(),
        graph_gid_bytes: 16,
        dscp: 0,
    })
}

/// Prints a report on stdout, where the demo reads it.
fn report(report: Report) -> io::Result<()> {
    writeln!(io::stdout(), "{}", serde_json::to_string(&report)?)
}
