//! Absences of this host's network interfaces and of peers on other hosts: detection, log messages, records
//! on the boards.

use std::net::IpAddr;

use tracing::{info, warn};

use super::networks;
use crate::config::{NetworkSelector, Settings};
use crate::dds::{self, Discovery, GraphWatch, Participant};
use crate::model::{AbsenceKind, AbsenceRecord, FixedText, MAX_ABSENCES, MonotonicNs};
use crate::policy::{Absence, AbsenceEvent, AbsenceWatch, Locality};
use crate::shm::{BoardWriter, Boards};

/// Detects absences and writes their table to the boards.
pub(super) struct Absences {
    watch: AbsenceWatch,
    /// One for each row of the table.
    writers: Vec<BoardWriter<AbsenceRecord>>,
}

impl Absences {
    pub fn new(boards: &Boards, settings: &Settings) -> Self {
        let (networks, _) = networks(settings);
        let configured = networks.iter().flat_map(|network| &network.interfaces);
        let configured = configured.map(|selector| match selector {
            NetworkSelector::Name(name) => name.clone(),
            NetworkSelector::Address(address) => address.to_string(),
        });
        let mut absences = Self {
            watch: AbsenceWatch::new(configured),
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
            Discovery::Incompatible { .. } => return,
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

    /// Looks up the node names of a network's peers.
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
            match event {
                AbsenceEvent::Away(absence) => {
                    let Absence { name, detail, .. } = &absence;
                    let host = host_text(&absence);
                    match absence.kind {
                        AbsenceKind::Interface => {
                            warn!(
                                interface = name,
                                address = host,
                                "a network interface is away: it {detail}"
                            )
                        }
                        AbsenceKind::Peer => {
                            warn!(node = name, host, "a peer is silent: it {detail}");
                        }
                    }
                }
                AbsenceEvent::Back(absence) => {
                    let back_at = absence.back_at.unwrap_or(now);
                    let away_s = back_at.since(absence.since) as f64 / 1e9;
                    let (name, host) = (&absence.name, host_text(&absence));
                    match absence.kind {
                        AbsenceKind::Interface => {
                            info!(interface = name, address = host, away_s, "a network interface is back")
                        }
                        AbsenceKind::Peer => info!(node = name, host, away_s, "a peer is back"),
                    }
                }
            }
        }
        self.write_table();
    }

    fn write_table(&mut self) {
        let absences = self.watch.absences();
        for (number, writer) in self.writers.iter_mut().enumerate() {
            let record = absences.get(number).map_or_else(AbsenceRecord::default, |absence| AbsenceRecord {
                since: absence.since,
                back_at: absence.back_at.unwrap_or_default(),
                kind: absence.kind as u64,
                name: FixedText::new(&absence.name),
                host: FixedText::new(&host_text(absence)),
                detail: FixedText::new(&absence.detail),
            });
            if *writer.get() != record {
                writer.update(|written| *written = record);
            }
        }
    }
}

fn host_text(absence: &Absence) -> String {
    absence.host.map_or_else(String::new, |host| host.to_string())
}
