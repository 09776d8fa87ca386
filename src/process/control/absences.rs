//! Absences of this host's network interfaces and of peers on other hosts: detection, log messages, records
//! on the boards.

use std::net::IpAddr;

use tracing::{info, warn};

use super::networks;
use crate::config::Settings;
use crate::dds::{self, Discovery, GraphWatch, Participant};
use crate::model::{AbsenceKind, AbsenceRecord, FixedText, MAX_ABSENCES, MonotonicNs};
use crate::policy::{Absence, AbsenceEvent, AbsenceWatch, Locality};
use crate::shm::{BoardWriter, Boards, write_rows};

pub(super) struct Absences {
    watch: AbsenceWatch,
    writers: Vec<BoardWriter<AbsenceRecord>>,
}

impl Absences {
    pub fn new(boards: &Boards, settings: &Settings) -> Self {
        let (networks, _) = networks(settings);
        let configured = networks.iter().flat_map(|network| &network.interfaces);
        let mut absences = Self {
            watch: AbsenceWatch::new(configured.map(ToString::to_string)),
            writers: (0..MAX_ABSENCES).map(|index| boards.absence_writer(index)).collect(),
        };
        absences.write_table();
        absences
    }

    /// Handles a discovery event of a network. `is_bridge_topic` returns whether peers of a topic are
    /// watched; its arguments are the DDS name and whether the peer publishes.
    pub fn handle(
        &mut self,
        network: usize,
        change: &Discovery,
        is_bridge_topic: impl Fn(&str, bool) -> bool,
        participant: &Participant,
        own_addresses: &[IpAddr],
        now: MonotonicNs,
    ) {
        let (endpoint, publishes) = match change {
            Discovery::Reader(reader) => (reader, false),
            Discovery::Writer(writer) => (writer, true),
            Discovery::ReaderGone(guid) | Discovery::WriterGone(guid) => {
                return self.watch.endpoint_lost(*guid);
            }
            Discovery::ParticipantGone { prefix, silent_ms } => {
                return self.watch.participant_lost(network, *prefix, *silent_ms, now);
            }
        };
        let is_remote = endpoint.location.locality(own_addresses) == Locality::Remote;
        if participant.owns(endpoint.guid) || !is_remote || !is_bridge_topic(&endpoint.topic, publishes) {
            return;
        }
        if let Some(host) = endpoint.location.host() {
            // The ROS 2 name of the topic.
            let topic = endpoint.topic.strip_prefix("rt").unwrap_or(&endpoint.topic);
            self.watch.endpoint_discovered(network, endpoint.guid, topic, publishes, host, now);
        }
    }

    pub fn name_nodes(&mut self, network: usize, graph: &GraphWatch) {
        self.watch.name_nodes(network, |endpoint| graph.node_of(endpoint));
    }

    /// Reads the state of the interfaces, logs changes and updates the table.
    pub fn update(&mut self, now: MonotonicNs) {
        match dds::interfaces() {
            Ok(present) => self.watch.update_interfaces(&present, now),
            Err(error) => warn!(%error, "cannot read the network interfaces"),
        }
        while let Some(event) = self.watch.poll() {
            let (absence, away_s) = match event {
                AbsenceEvent::Away(absence) => (absence, None),
                AbsenceEvent::Back(absence) => {
                    let away_s = absence.back_at.unwrap_or(now).since(absence.since) as f64 / 1e9;
                    (absence, Some(away_s))
                }
            };
            let (name, detail, host) = (&absence.name, &absence.detail, host_text(&absence));
            match (absence.kind, away_s) {
                (AbsenceKind::Interface, None) => {
                    warn!(interface = name, address = host, "a network interface is away: it {detail}");
                }
                (AbsenceKind::Interface, Some(away_s)) => {
                    info!(interface = name, address = host, away_s, "a network interface is back");
                }
                (AbsenceKind::Peer, None) => warn!(node = name, host, "a peer is silent: it {detail}"),
                (AbsenceKind::Peer, Some(away_s)) => info!(node = name, host, away_s, "a peer is back"),
            }
        }
        self.write_table();
    }

    fn write_table(&mut self) {
        let rows = self.watch.absences().into_iter().map(|absence| AbsenceRecord {
            since: absence.since,
            back_at: absence.back_at.unwrap_or_default(),
            kind: absence.kind as u64,
            name: FixedText::new(&absence.name),
            host: FixedText::new(&host_text(&absence)),
            detail: FixedText::new(&absence.detail),
        });
        write_rows(&mut self.writers, rows);
    }
}

fn host_text(absence: &Absence) -> String {
    absence.host.map_or_else(String::new, |host| host.to_string())
}
