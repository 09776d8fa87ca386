//! Monitoring of remote endpoints: intruders (remote readers that bypass the bridge), the node names of input
//! publishers and output readers, and the output readers that miss samples.

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

/// Interval of updating node names, absences and the losses of the outputs' readers.
const ENDPOINTS_MS: u64 = 1_000;

/// Minimum time between two log messages about the same reader that misses samples.
const OVERRUN_REPEAT_MS: u64 = 10_000;

/// The endpoints of one network.
struct WatchedNetwork {
    watch: IntruderWatch,
    graph: GraphWatch,
    /// The outputs on this network, by DDS name: lane and route.
    outputs: BTreeMap<String, (usize, usize)>,
    /// The input topics on this network, by DDS name.
    inputs: BTreeSet<String>,
    /// The readers of the outputs and the writers of the inputs, with their locations.
    endpoints: Vec<(Guid, Location)>,
}

/// Overrun samples of one reader that were already logged.
struct LoggedOverrun {
    reader: Guid,
    samples: u64,
    next_warning_at: MonotonicNs,
}

/// Monitors remote readers and writers of the bridge's topics on all networks.
pub(super) struct EndpointMonitor {
    /// One for each network, in the order of the participants.
    networks: Vec<WatchedNetwork>,
    absences: Absences,
    overruns: Vec<LoggedOverrun>,
    endpoint_writers: Vec<BoardWriter<NamedEndpoint>>,
    next_update_at: MonotonicNs,
    own_addresses: Vec<IpAddr>,
    intruder_writers: Vec<BoardWriter<IntruderRecord>>,
    /// Intruders in the table on the boards.
    intruder_count: usize,
    boards: Boards,
}

impl EndpointMonitor {
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
                guarded.extend(settings.routes.iter().enumerate().map(|(route, route_settings)| {
                    GuardedTopic {
                        topic: route_settings.input_topic.clone(),
                        guarded: Guarded::Input,
                        alternative: noncritical_output(settings, route),
                    }
                }));
            }
            for (lane, configured) in settings.lanes.iter().enumerate() {
                if network_of_lane[lane] != network {
                    continue;
                }
                for output in &configured.outputs {
                    outputs.insert(output.topic.to_dds(), (lane, output.route));
                    if configured.class() != TrafficClass::Critical {
                        continue;
                    }
                    guarded.push(GuardedTopic {
                        topic: output.topic.clone(),
                        guarded: Guarded::CriticalOutput,
                        alternative: noncritical_output(settings, output.route),
                    });
                }
            }
            watched.push(WatchedNetwork {
                watch: IntruderWatch::new(guarded),
                graph: participant.watch_graph()?,
                outputs,
                inputs,
                endpoints: Vec::new(),
            });
        }
        let mut endpoint_writers: Vec<_> =
            (0..MAX_NAMED_ENDPOINTS).map(|index| boards.named_endpoint_writer(index)).collect();
        for writer in &mut endpoint_writers {
            writer.update(|record| *record = NamedEndpoint::default());
        }
        let mut intruder_writers: Vec<_> =
            (0..MAX_INTRUDERS).map(|index| boards.intruder_writer(index)).collect();
        for writer in &mut intruder_writers {
            writer.update(|record| *record = IntruderRecord::default());
        }
        Ok(Self {
            networks: watched,
            absences: Absences::new(boards, settings),
            overruns: Vec::new(),
            endpoint_writers,
            next_update_at: MonotonicNs(0),
            own_addresses: Vec::new(),
            intruder_writers,
            intruder_count: 0,
            boards: boards.clone(),
        })
    }

    /// The number of intruders in the table on the boards.
    pub fn intruder_count(&self) -> usize {
        self.intruder_count
    }

    /// The number of intruders seen since control started.
    pub fn intruders_seen(&self) -> u64 {
        let counts = self.networks.iter().map(|network| network.watch.counts());
        counts.map(|counts| counts.reported + counts.unreported).sum()
    }

    /// Handles discovery events and logs new intruders; once a second also updates node names, absences and
    /// overruns.
    pub fn housekeeping(&mut self, participants: &mut [Participant], settings: &Settings, now: MonotonicNs) {
        let mut changed = false;
        for (number, (network, participant)) in self.networks.iter_mut().zip(participants).enumerate() {
            let mut are_addresses_current = false;
            while let Some(change) = participant.poll_discovery() {
                // Reads the addresses once for each batch of events: after a change of this host's address, a
                // local endpoint that is announced again would otherwise be taken for a remote one.
                if !are_addresses_current {
                    are_addresses_current = true;
                    match dds::host_addresses() {
                        Ok(addresses) => self.own_addresses = addresses,
                        Err(error) => {
                            warn!(
                                %error,
                                "cannot read this host's addresses; local endpoints may be taken for remote ones"
                            )
                        }
                    }
                }
                let is_bridge_topic = |topic: &str, publishes: bool| {
                    if publishes {
                        network.inputs.iter().any(|input| input == topic)
                    } else {
                        network.outputs.contains_key(topic)
                    }
                };
                if let Discovery::ParticipantGone { .. } = change {
                    // Before `network.handle` removes the participant's nodes from the graph.
                    self.absences.name_nodes(number, &network.graph);
                }
                self.absences.handle(number, &change, is_bridge_topic, participant, &self.own_addresses, now);
                network.handle(change, participant, &self.own_addresses, now);
            }
            network.graph.poll();
            self.absences.name_nodes(number, &network.graph);
            while let Some(event) = network.watch.poll(now, |reader| network.graph.node_of(reader)) {
                changed = true;
                match event {
                    IntruderEvent::Appeared(intruder) => warn!("{intruder}"),
                    IntruderEvent::Left(intruder) => info!("intruder left: {intruder}"),
                    IntruderEvent::Returned(intruder) => info!("intruder returned: {intruder}"),
                }
            }
        }
        if changed {
            self.write_intruders();
        }
        if now >= self.next_update_at {
            self.next_update_at = now.plus_ms(ENDPOINTS_MS);
            self.write_endpoints();
            self.log_overruns(settings, now);
            self.absences.update(now);
        }
    }

    /// Writes the table of intruders to the boards.
    fn write_intruders(&mut self) {
        let present: Vec<_> = self.networks.iter().flat_map(|network| network.watch.present()).collect();
        self.intruder_count = present.len().min(self.intruder_writers.len());
        for (number, writer) in self.intruder_writers.iter_mut().enumerate() {
            let record = present.get(number).map_or_else(IntruderRecord::default, |intruder| {
                let host = intruder.host.map_or_else(|| "another host".to_owned(), |host| host.to_string());
                IntruderRecord {
                    topic: FixedText::new(intruder.topic.topic.as_str()),
                    node: FixedText::new(intruder.node.as_deref().unwrap_or("")),
                    host: FixedText::new(&host),
                    remedy: FixedText::new(&intruder.remedy()),
                    since: intruder.since,
                }
            });
            writer.update(|written| *written = record);
        }
    }

    /// Writes the nodes of the inputs' publishers and of the outputs' readers to the boards.
    fn write_endpoints(&mut self) {
        let endpoints = self.networks.iter().flat_map(WatchedNetwork::named_endpoints);
        let mut endpoints = endpoints.chain(std::iter::repeat(NamedEndpoint::default()));
        for (writer, endpoint) in self.endpoint_writers.iter_mut().zip(&mut endpoints) {
            if *writer.get() != endpoint {
                writer.update(|written| *written = endpoint);
            }
        }
    }

    /// Logs each reader that has missed samples since its last log message.
    fn log_overruns(&mut self, settings: &Settings, now: MonotonicNs) {
        let mut matched = Vec::new();
        for (lane, configured) in settings.lanes.iter().enumerate() {
            for output in &configured.outputs {
                let readers = self.boards.output_readers(lane, output.route).unwrap_or_default();
                for record in readers.iter() {
                    matched.push(record.reader);
                    let logged = match self.overruns.iter().position(|logged| logged.reader == record.reader)
                    {
                        Some(index) => &mut self.overruns[index],
                        None if record.overrun == 0 => continue,
                        None => {
                            self.overruns.push(LoggedOverrun {
                                reader: record.reader,
                                samples: 0,
                                next_warning_at: now,
                            });
                            let last = self.overruns.len() - 1;
                            &mut self.overruns[last]
                        }
                    };
                    let missed = record.overrun.saturating_sub(logged.samples);
                    if missed == 0 || now < logged.next_warning_at {
                        continue;
                    }
                    logged.samples = record.overrun;
                    logged.next_warning_at = now.plus_ms(OVERRUN_REPEAT_MS);
                    let reader = self.networks.iter().find_map(|network| network.reader_name(record.reader));
                    warn!(
                        lane = configured.name.as_str(),
                        route = settings.routes[output.route].id.as_str(),
                        topic = output.topic.as_str(),
                        reader = reader.unwrap_or_else(|| record.reader.to_string()),
                        missed,
                        unacknowledged = record.unacknowledged,
                        reason = "reader_overrun",
                        "a subscriber does not keep up and missed samples; the other subscribers received them"
                    );
                }
            }
        }
        self.overruns.retain(|logged| matched.contains(&logged.reader));
    }
}

impl WatchedNetwork {
    /// Handles a discovery event of this network.
    fn handle(
        &mut self,
        change: Discovery,
        participant: &Participant,
        own_addresses: &[IpAddr],
        now: MonotonicNs,
    ) {
        match change {
            Discovery::Reader(reader) if !participant.owns(reader.guid) => {
                if self.outputs.contains_key(&reader.topic) {
                    self.remember(&reader);
                }
                self.watch.endpoint_discovered(
                    reader.guid,
                    &reader.topic,
                    &reader.location,
                    own_addresses,
                    now,
                );
            }
            Discovery::Writer(writer)
                if !participant.owns(writer.guid) && self.inputs.contains(&writer.topic) =>
            {
                self.remember(&writer);
            }
            Discovery::WriterGone(guid) => self.endpoints.retain(|(writer, _)| *writer != guid),
            Discovery::ReaderGone(guid) => {
                self.endpoints.retain(|(reader, _)| *reader != guid);
                self.watch.endpoint_lost(guid, now);
            }
            Discovery::ParticipantGone { prefix, .. } => {
                self.endpoints.retain(|(endpoint, _)| endpoint.prefix() != prefix);
                self.watch.participant_lost(prefix, now);
                self.graph.participant_gone(prefix);
            }
            _ => {}
        }
    }

    /// Remembers the location of an endpoint, unless [`MAX_NAMED_ENDPOINTS`] others are remembered already.
    fn remember(&mut self, endpoint: &Endpoint) {
        self.endpoints.retain(|(guid, _)| *guid != endpoint.guid);
        if self.endpoints.len() < MAX_NAMED_ENDPOINTS {
            self.endpoints.push((endpoint.guid, endpoint.location.clone()));
        }
    }

    /// Iterates over the inputs' publishers and the outputs' readers, with their nodes and hosts.
    fn named_endpoints(&self) -> impl Iterator<Item = NamedEndpoint> {
        self.endpoints.iter().map(|(guid, location)| NamedEndpoint {
            endpoint: *guid,
            node: FixedText::new(self.graph.node_of(*guid).unwrap_or("")),
            host: FixedText::new(&location.host().map_or_else(String::new, |host| host.to_string())),
        })
    }

    /// The node and host of an output's reader, as text; `None` if discovery has not reported the reader.
    fn reader_name(&self, reader: Guid) -> Option<String> {
        let (guid, location) = self.endpoints.iter().find(|(guid, _)| *guid == reader)?;
        let node = self.graph.node_of(*guid).map_or_else(|| guid.to_string(), str::to_owned);
        Some(match location.host() {
            Some(host) => format!("{node} on {host}"),
            None => node,
        })
    }
}

/// The output topic of a route on a noncritical lane.
fn noncritical_output(settings: &Settings, route: usize) -> Option<crate::model::TopicName> {
    let noncritical = settings.lanes.iter().filter(|lane| lane.class() == TrafficClass::Noncritical);
    let mut outputs = noncritical.flat_map(|lane| &lane.outputs);
    outputs.find(|output| output.route == route).map(|output| output.topic.clone())
}
