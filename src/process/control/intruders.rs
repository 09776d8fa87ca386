//! Readers on other hosts that reach past the bridge, and the readers behind a critical write that failed.

use std::collections::BTreeMap;
use std::net::IpAddr;

use tracing::{info, warn};

use super::super::role::RoleError;
use super::networks;
use crate::config::Settings;
use crate::dds::{self, Discovery, GraphWatch, Participant};
use crate::model::{DropReason, FixedText, Guid, IntruderRecord, MAX_INTRUDERS, MonotonicNs, TrafficClass};
use crate::policy::{Guarded, GuardedTopic, IntruderEvent, IntruderWatch, Location};
use crate::shm::{BoardWriter, Boards};

/// Interfaces come and go with Wi-Fi: this host's addresses are looked at so often.
const ADDRESSES_MS: u64 = 5_000;

/// Readers of critical outputs that are remembered, to be named when writes fail.
const MAX_READERS: usize = 64;

/// Failed writes of one lane and topic are warned of at most so often.
const FAILED_WRITES_REPEAT_MS: u64 = 10_000;

/// One network that is watched.
struct Watched {
    watch: IntruderWatch,
    graph: GraphWatch,
    /// The critical outputs there, by DDS name: lane and route.
    outputs: BTreeMap<String, (usize, usize)>,
    /// Their readers, by topic.
    readers: Vec<(Guid, String, Location)>,
}

/// Critical writes that failed on one topic.
struct FailedWrites {
    lane: usize,
    route: usize,
    counted: u64,
    warn_at: MonotonicNs,
}

/// Guards the input topics and the critical outputs.
pub(super) struct Guard {
    /// One for each network, in the order of the participants.
    networks: Vec<Watched>,
    failed_writes: Vec<FailedWrites>,
    own: Vec<IpAddr>,
    addresses_at: MonotonicNs,
    places: Vec<BoardWriter<IntruderRecord>>,
    shown: usize,
    boards: Boards,
}

impl Guard {
    pub fn open(
        boards: &Boards,
        settings: &Settings,
        participants: &mut [Participant],
    ) -> Result<Self, RoleError> {
        let (_, network_of_lane) = networks(settings);
        let mut watched = Vec::with_capacity(participants.len());
        for (network, participant) in participants.iter().enumerate() {
            let mut guarded = Vec::new();
            let mut outputs = BTreeMap::new();
            if network == 0 {
                guarded.extend(settings.routes.iter().enumerate().map(|(route, settings_of)| GuardedTopic {
                    topic: settings_of.input_topic.clone(),
                    guarded: Guarded::Input,
                    instead: instead(settings, route),
                }));
            }
            for (lane, configured) in settings.lanes.iter().enumerate() {
                if configured.class != TrafficClass::Critical || network_of_lane[lane] != network {
                    continue;
                }
                for output in &configured.outputs {
                    outputs.insert(output.topic.to_dds(), (lane, output.route));
                    guarded.push(GuardedTopic {
                        topic: output.topic.clone(),
                        guarded: Guarded::CriticalOutput,
                        instead: instead(settings, output.route),
                    });
                }
            }
            watched.push(Watched {
                watch: IntruderWatch::new(guarded),
                graph: participant.watch_graph()?,
                outputs,
                readers: Vec::new(),
            });
        }
        let failed_writes = watched.iter().flat_map(|network| network.outputs.values());
        let failed_writes = failed_writes
            .map(|&(lane, route)| FailedWrites {
                lane,
                route,
                counted: failed(boards, lane, route),
                warn_at: MonotonicNs(0),
            })
            .collect();
        let mut places: Vec<_> = (0..MAX_INTRUDERS).map(|place| boards.intruder_writer(place)).collect();
        for place in &mut places {
            place.update(|record| *record = IntruderRecord::default());
        }
        Ok(Self {
            networks: watched,
            failed_writes,
            own: Vec::new(),
            addresses_at: MonotonicNs(0),
            places,
            shown: 0,
            boards: boards.clone(),
        })
    }

    /// Intruders in the table.
    pub fn shown(&self) -> usize {
        self.shown
    }

    /// Intruders seen since control came up.
    pub fn seen(&self) -> u64 {
        let counts = self.networks.iter().map(|network| network.watch.counts());
        counts.map(|counts| counts.told + counts.untold).sum()
    }

    /// Takes in what discovery says; warns of what is new.
    pub fn keep_house(&mut self, participants: &mut [Participant], settings: &Settings, now: MonotonicNs) {
        if now >= self.addresses_at {
            match dds::host_addresses() {
                Ok(own) => self.own = own,
                Err(error) => {
                    warn!(%error, "this host's addresses are not known: who is remote cannot be told")
                }
            }
            self.addresses_at = now.plus_ms(ADDRESSES_MS);
        }
        let mut changed = false;
        for (network, participant) in self.networks.iter_mut().zip(participants) {
            while let Some(change) = participant.poll_discovery() {
                network.take_in(change, participant, &self.own, now);
            }
            network.graph.poll();
            while let Some(event) = network.watch.poll(now, |reader| network.graph.node_of(reader)) {
                changed = true;
                match event {
                    IntruderEvent::Appeared(intruder) => warn!("{intruder}"),
                    IntruderEvent::Left(intruder) => info!("gone: {intruder}"),
                    IntruderEvent::Returned(intruder) => info!("back: {intruder}"),
                }
            }
        }
        if changed {
            self.show();
        }
        self.name_laggards(settings, now);
    }

    fn show(&mut self) {
        let present: Vec<_> = self.networks.iter().flat_map(|network| network.watch.present()).collect();
        self.shown = present.len().min(self.places.len());
        for (number, place) in self.places.iter_mut().enumerate() {
            let record = present.get(number).map_or_else(IntruderRecord::default, |intruder| {
                let host = intruder.host.map_or_else(|| "another host".to_owned(), |host| host.to_string());
                IntruderRecord {
                    topic: FixedText::new(intruder.topic.topic.as_str()),
                    node: FixedText::new(intruder.node.as_deref().unwrap_or("")),
                    host: FixedText::new(&host),
                    remedy: FixedText::new(&intruder.mending_step()),
                    since: intruder.since,
                }
            });
            place.update(|shown| *shown = record);
        }
    }

    /// A laggard is not always remote: whoever is matched when critical writes fail may be it.
    fn name_laggards(&mut self, settings: &Settings, now: MonotonicNs) {
        for writes in &mut self.failed_writes {
            let total = failed(&self.boards, writes.lane, writes.route);
            let failed = total.saturating_sub(writes.counted);
            if failed == 0 || now < writes.warn_at {
                continue;
            }
            writes.counted = total;
            writes.warn_at = now.plus_ms(FAILED_WRITES_REPEAT_MS);
            let lane = &settings.lanes[writes.lane];
            let readers: Vec<String> = self
                .networks
                .iter()
                .flat_map(|network| network.readers_of(writes.lane, writes.route))
                .collect();
            warn!(
                lane = lane.name.as_str(),
                route = settings.routes[writes.route].id.as_str(),
                failed,
                readers = if readers.is_empty() { "none known".to_owned() } else { readers.join("; ") },
                "critical writes failed: one of the readers that are matched does not acknowledge; make it \
                 BEST_EFFORT, or move it to a noncritical lane"
            );
        }
    }
}

impl Watched {
    fn take_in(&mut self, change: Discovery, participant: &Participant, own: &[IpAddr], now: MonotonicNs) {
        match change {
            Discovery::Reader(reader) if !participant.owns(reader.guid) => {
                if self.outputs.contains_key(&reader.topic) {
                    self.readers.retain(|(guid, _, _)| *guid != reader.guid);
                    if self.readers.len() < MAX_READERS {
                        self.readers.push((reader.guid, reader.topic.clone(), reader.location.clone()));
                    }
                }
                self.watch.found(reader.guid, &reader.topic, &reader.location, own, now);
            }
            Discovery::ReaderGone(guid) => {
                self.readers.retain(|(reader, _, _)| *reader != guid);
                self.watch.gone(guid, now);
            }
            Discovery::ParticipantGone { prefix } => {
                self.readers.retain(|(reader, _, _)| reader.prefix() != prefix);
                self.watch.participant_gone(prefix, now);
                self.graph.participant_gone(prefix);
            }
            _ => {}
        }
    }

    /// The readers of a lane's output, by node and host.
    fn readers_of(&self, lane: usize, route: usize) -> impl Iterator<Item = String> {
        let topic = self.outputs.iter().find(|(_, place)| **place == (lane, route)).map(|(topic, _)| topic);
        let readers = self.readers.iter().filter(move |(_, read, _)| Some(read) == topic);
        readers.map(|(guid, _, location)| {
            let node = self.graph.node_of(*guid).unwrap_or("no known node");
            match location.host() {
                Some(host) => format!("{node} on {host}"),
                None => node.to_owned(),
            }
        })
    }
}

/// The route's output on a noncritical lane.
fn instead(settings: &Settings, route: usize) -> Option<crate::model::TopicName> {
    let noncritical = settings.lanes.iter().filter(|lane| lane.class == TrafficClass::Noncritical);
    let mut outputs = noncritical.flat_map(|lane| &lane.outputs);
    outputs.find(|output| output.route == route).map(|output| output.topic.clone())
}

fn failed(boards: &Boards, lane: usize, route: usize) -> u64 {
    boards.lane(lane, route).map_or(0, |counters| {
        counters.drops.get(DropReason::WindowFull) + counters.drops.get(DropReason::WriteFailed)
    })
}
