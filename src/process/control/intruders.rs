//! Readers on other hosts that reach past the bridge, the nodes of the inputs' publishers and of the outputs'
//! readers, and which of these miss samples.

use std::collections::{BTreeMap, BTreeSet};
use std::net::IpAddr;

use tracing::{info, warn};

use super::super::role::RoleError;
use super::absences::Absences;
use super::networks;
use crate::config::Settings;
use crate::dds::{self, Discovery, Endpoint, GraphWatch, Participant};
use crate::model::{
    FixedText, Guid, IntruderRecord, MAX_INTRUDERS, MAX_NAMED_ENDPOINTS, MonotonicNs, NamedEndpoint,
    TrafficClass,
};
use crate::policy::{Guarded, GuardedTopic, IntruderEvent, IntruderWatch, Location};
use crate::shm::{BoardWriter, Boards};

/// The nodes and the losses of the outputs' readers are looked at so often.
const READERS_MS: u64 = 1_000;

/// The log names a reader that misses samples at most so often.
const OVERRUN_REPEAT_MS: u64 = 10_000;

/// One network that is watched.
struct Watched {
    watch: IntruderWatch,
    graph: GraphWatch,
    /// The outputs there, by DDS name: lane and route.
    outputs: BTreeMap<String, (usize, usize)>,
    /// The input topics there, by DDS name.
    inputs: BTreeSet<String>,
    /// The readers of the outputs and the writers of the inputs, with their places.
    endpoints: Vec<(Guid, Location)>,
}

/// Samples that one reader missed, as far as the log says.
struct LoggedOverrun {
    reader: Guid,
    samples: u64,
    warn_at: MonotonicNs,
}

/// Guards the input topics and the critical outputs.
pub(super) struct Guard {
    /// One for each network, in the order of the participants.
    networks: Vec<Watched>,
    absences: Absences,
    overruns: Vec<LoggedOverrun>,
    named: Vec<BoardWriter<NamedEndpoint>>,
    readers_at: MonotonicNs,
    own: Vec<IpAddr>,
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
            let mut inputs = BTreeSet::new();
            if network == 0 {
                inputs.extend(settings.routes.iter().map(|route| route.input_topic.to_dds()));
                guarded.extend(settings.routes.iter().enumerate().map(|(route, settings_of)| GuardedTopic {
                    topic: settings_of.input_topic.clone(),
                    guarded: Guarded::Input,
                    instead: instead(settings, route),
                }));
            }
            for (lane, configured) in settings.lanes.iter().enumerate() {
                if network_of_lane[lane] != network {
                    continue;
                }
                for output in &configured.outputs {
                    outputs.insert(output.topic.to_dds(), (lane, output.route));
                    if configured.class != TrafficClass::Critical {
                        continue;
                    }
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
                inputs,
                endpoints: Vec::new(),
            });
        }
        let mut named: Vec<_> =
            (0..MAX_NAMED_ENDPOINTS).map(|place| boards.named_endpoint_writer(place)).collect();
        for place in &mut named {
            place.update(|record| *record = NamedEndpoint::default());
        }
        let mut places: Vec<_> = (0..MAX_INTRUDERS).map(|place| boards.intruder_writer(place)).collect();
        for place in &mut places {
            place.update(|record| *record = IntruderRecord::default());
        }
        Ok(Self {
            networks: watched,
            absences: Absences::new(boards, settings),
            overruns: Vec::new(),
            named,
            readers_at: MonotonicNs(0),
            own: Vec::new(),
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
        let mut changed = false;
        for (number, (network, participant)) in self.networks.iter_mut().zip(participants).enumerate() {
            let mut are_addresses_current = false;
            while let Some(change) = participant.poll_discovery() {
                // Anew for what discovery says: an endpoint of this host that is announced again after a
                // change of the host's address would be taken for a remote one.
                if !are_addresses_current {
                    are_addresses_current = true;
                    match dds::host_addresses() {
                        Ok(own) => self.own = own,
                        Err(error) => {
                            warn!(%error, "this host's addresses are not known: who is remote cannot be told")
                        }
                    }
                }
                let is_of_bridge = |topic: &str, publishes: bool| {
                    if publishes {
                        network.inputs.iter().any(|input| input == topic)
                    } else {
                        network.outputs.contains_key(topic)
                    }
                };
                if let Discovery::ParticipantGone { .. } = change {
                    // Its node is not known any more once it is gone.
                    self.absences.name_nodes(number, &network.graph);
                }
                self.absences.take_in(number, &change, is_of_bridge, participant, &self.own, now);
                network.take_in(change, participant, &self.own, now);
            }
            network.graph.poll();
            self.absences.name_nodes(number, &network.graph);
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
        if now >= self.readers_at {
            self.readers_at = now.plus_ms(READERS_MS);
            self.name_endpoints();
            self.log_overruns(settings, now);
            self.absences.look(now);
        }
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

    /// Shows the nodes of the inputs' publishers and of the outputs' readers.
    fn name_endpoints(&mut self) {
        let named = self.networks.iter().flat_map(Watched::named_endpoints);
        let mut named = named.chain(std::iter::repeat(NamedEndpoint::default()));
        for (place, endpoint) in self.named.iter_mut().zip(&mut named) {
            if *place.get() != endpoint {
                place.update(|shown| *shown = endpoint);
            }
        }
    }

    /// Warns of each reader that missed samples since it was warned of.
    fn log_overruns(&mut self, settings: &Settings, now: MonotonicNs) {
        let mut matched = Vec::new();
        for (lane, configured) in settings.lanes.iter().enumerate() {
            for output in &configured.outputs {
                let readers = self.boards.output_readers(lane, output.route).unwrap_or_default();
                for record in readers.iter() {
                    matched.push(record.reader);
                    let logged = match self.overruns.iter().position(|logged| logged.reader == record.reader)
                    {
                        Some(place) => &mut self.overruns[place],
                        None if record.overrun == 0 => continue,
                        None => {
                            self.overruns.push(LoggedOverrun {
                                reader: record.reader,
                                samples: 0,
                                warn_at: now,
                            });
                            let last = self.overruns.len() - 1;
                            &mut self.overruns[last]
                        }
                    };
                    let missed = record.overrun.saturating_sub(logged.samples);
                    if missed == 0 || now < logged.warn_at {
                        continue;
                    }
                    logged.samples = record.overrun;
                    logged.warn_at = now.plus_ms(OVERRUN_REPEAT_MS);
                    let reader = self.networks.iter().find_map(|network| network.name_of(record.reader));
                    warn!(
                        lane = configured.name.as_str(),
                        route = settings.routes[output.route].id.as_str(),
                        topic = output.topic.as_str(),
                        reader = reader.unwrap_or_else(|| record.reader.to_string()),
                        missed,
                        unacknowledged = record.unacknowledged,
                        reason = "reader_overrun",
                        "a subscriber does not keep up and missed samples; the other subscribers have them"
                    );
                }
            }
        }
        self.overruns.retain(|logged| matched.contains(&logged.reader));
    }
}

impl Watched {
    fn take_in(&mut self, change: Discovery, participant: &Participant, own: &[IpAddr], now: MonotonicNs) {
        match change {
            Discovery::Reader(reader) if !participant.owns(reader.guid) => {
                if self.outputs.contains_key(&reader.topic) {
                    self.note(&reader);
                }
                self.watch.found(reader.guid, &reader.topic, &reader.location, own, now);
            }
            Discovery::Writer(writer)
                if !participant.owns(writer.guid) && self.inputs.contains(&writer.topic) =>
            {
                self.note(&writer);
            }
            Discovery::WriterGone(guid) => self.endpoints.retain(|(writer, _)| *writer != guid),
            Discovery::ReaderGone(guid) => {
                self.endpoints.retain(|(reader, _)| *reader != guid);
                self.watch.gone(guid, now);
            }
            Discovery::ParticipantGone { prefix, .. } => {
                self.endpoints.retain(|(endpoint, _)| endpoint.prefix() != prefix);
                self.watch.participant_gone(prefix, now);
                self.graph.participant_gone(prefix);
            }
            _ => {}
        }
    }

    /// Records where an endpoint is. Of more than can be shown, those that came first stay.
    fn note(&mut self, endpoint: &Endpoint) {
        self.endpoints.retain(|(guid, _)| *guid != endpoint.guid);
        if self.endpoints.len() < MAX_NAMED_ENDPOINTS {
            self.endpoints.push((endpoint.guid, endpoint.location.clone()));
        }
    }

    /// The inputs' publishers and the outputs' readers with their nodes and hosts.
    fn named_endpoints(&self) -> impl Iterator<Item = NamedEndpoint> {
        self.endpoints.iter().map(|(guid, location)| NamedEndpoint {
            endpoint: *guid,
            node: FixedText::new(self.graph.node_of(*guid).unwrap_or("")),
            host: FixedText::new(&location.host().map_or_else(String::new, |host| host.to_string())),
        })
    }

    /// A reader of an output by its node and host; `None` for a reader that discovery has not reported.
    fn name_of(&self, reader: Guid) -> Option<String> {
        let (guid, location) = self.endpoints.iter().find(|(guid, _)| *guid == reader)?;
        let node = self.graph.node_of(*guid).map_or_else(|| guid.to_string(), str::to_owned);
        Some(match location.host() {
            Some(host) => format!("{node} on {host}"),
            None => node,
        })
    }
}

/// The route's output on a noncritical lane.
fn instead(settings: &Settings, route: usize) -> Option<crate::model::TopicName> {
    let noncritical = settings.lanes.iter().filter(|lane| lane.class == TrafficClass::Noncritical);
    let mut outputs = noncritical.flat_map(|lane| &lane.outputs);
    outputs.find(|output| output.route == route).map(|output| output.topic.clone())
}
