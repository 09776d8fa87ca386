//! Network interfaces of this host and peers on other hosts that are away: looks, logs and shows.

use std::net::IpAddr;

use tracing::{info, warn};

use super::networks;
use crate::config::{NetworkSelector, Settings};
use crate::dds::{self, Discovery, GraphWatch, Participant};
use crate::model::{AbsenceKind, AbsenceRecord, FixedText, MAX_ABSENCES, MonotonicNs};
use crate::policy::{Absence, AbsenceEvent, AbsenceWatch, Whereabouts};
use crate::shm::{BoardWriter, Boards};

/// Watches, and writes the table.
pub(super) struct Absences {
    watch: AbsenceWatch,
    places: Vec<BoardWriter<AbsenceRecord>>,
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
            places: (0..MAX_ABSENCES).map(|place| boards.absence_writer(place)).collect(),
        };
        absences.show();
        absences
    }

    /// Takes in what discovery says of a network. `is_of_bridge` tells, by DDS name and whether it is
    /// published, the topics whose peers count.
    pub fn take_in(
        &mut self,
        network: usize,
        change: &Discovery,
        is_of_bridge: impl Fn(&str, bool) -> bool,
        participant: &Participant,
        own: &[IpAddr],
        now: MonotonicNs,
    ) {
        let (endpoint, publishes) = match change {
            Discovery::Reader(reader) => (reader, false),
            Discovery::Writer(writer) => (writer, true),
            Discovery::ReaderGone(guid) | Discovery::WriterGone(guid) => return self.watch.gone(*guid),
            Discovery::ParticipantGone { prefix, silent_ms } => {
                return self.watch.participant_gone(network, *prefix, *silent_ms, now);
            }
            Discovery::Incompatible { .. } => return,
        };
        let is_remote = endpoint.location.whereabouts(own) == Whereabouts::Remote;
        if participant.owns(endpoint.guid) || !is_remote || !is_of_bridge(&endpoint.topic, publishes) {
            return;
        }
        if let Some(host) = endpoint.location.host() {
            // As ROS 2 names it.
            let topic = endpoint.topic.strip_prefix("rt").unwrap_or(&endpoint.topic);
            self.watch.found(network, endpoint.guid, topic, publishes, host, now);
        }
    }

    /// Names the nodes of a network's peers.
    pub fn name_nodes(&mut self, network: usize, graph: &GraphWatch) {
        self.watch.name_nodes(network, |endpoint| graph.node_of(endpoint));
    }

    /// Looks at the interfaces; logs what has changed, and shows it.
    pub fn look(&mut self, now: MonotonicNs) {
        match dds::interfaces() {
            Ok(present) => self.watch.look(&present, now),
            Err(error) => warn!(%error, "network interfaces are not known"),
        }
        while let Some(event) = self.watch.poll() {
            match event {
                AbsenceEvent::Away(absence) => {
                    let Absence { name, detail, .. } = &absence;
                    let host = host_of(&absence);
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
                    let (name, host) = (&absence.name, host_of(&absence));
                    match absence.kind {
                        AbsenceKind::Interface => {
                            info!(interface = name, address = host, away_s, "a network interface is back")
                        }
                        AbsenceKind::Peer => info!(node = name, host, away_s, "a peer is back"),
                    }
                }
            }
        }
        self.show();
    }

    fn show(&mut self) {
        let absences = self.watch.absences();
        for (number, place) in self.places.iter_mut().enumerate() {
            let record = absences.get(number).map_or_else(AbsenceRecord::default, |absence| AbsenceRecord {
                since: absence.since,
                back_at: absence.back_at.unwrap_or_default(),
                kind: absence.kind as u64,
                name: FixedText::new(&absence.name),
                host: FixedText::new(&host_of(absence)),
                detail: FixedText::new(&absence.detail),
            });
            if *place.get() != record {
                place.update(|shown| *shown = record);
            }
        }
    }
}

fn host_of(absence: &Absence) -> String {
    absence.host.map_or_else(String::new, |host| host.to_string())
}
