//! Monitoring of remote endpoints: intruders (remote readers that bypass the bridge), the node names of input
//! publishers and output readers, and the output readers that miss samples.

use std::collections::{BTreeSet, HashMap};
use std::net::IpAddr;
use std::rc::Rc;

use tracing::{info, warn};

use super::super::error::RoleError;
use super::absences::Absences;
use super::networks;
use crate::config::{InputTopic, Lane, NeverInputs, OutputTopic, RoutePattern, Settings};
use crate::dds::{self, Discovery, DiscoveryTurn, Endpoint, GraphWatch, Participant};
use crate::model::{
    FixedText, Guid, IntruderRecord, MAX_INTRUDERS, MAX_NAMED_ENDPOINTS, MonotonicNs, NamedEndpoint,
    ReaderRecord, TopicName, TopicPrefix, TrafficClass,
};
use crate::policy::{Guarded, GuardedTopic, IntruderEvent, IntruderWatch, Location};
use crate::shm::{BoardWriter, Boards, write_rows};

/// Interval of updating node names, absences and the losses of the outputs' readers.
const ENDPOINTS_MS: u64 = 1_000;

/// Minimum time between two log messages about the same reader that misses samples.
const OVERRUN_REPEAT_MS: u64 = 10_000;

struct WatchedNetwork {
    watch: IntruderWatch,
    graph: GraphWatch,
    /// The DDS names of the outputs and of the inputs on this network.
    outputs: BTreeSet<String>,
    inputs: BTreeSet<String>,
    /// The patterns whose topics are inputs or outputs on this network.
    patterns: Vec<WatchedPattern>,
    /// The readers of the outputs and the writers of the inputs, with their locations.
    endpoints: Vec<(Guid, Location)>,
}

/// A pattern, as far as it concerns one network. Its topics are watched whether they have a place or not.
struct WatchedPattern {
    settings: RoutePattern,
    /// Whether its inputs are on the network, and the prefixes of its outputs there, with their class.
    has_inputs: bool,
    outputs: Vec<(TopicPrefix, TrafficClass)>,
    /// The prefix of the output that a reader on another host should read.
    alternative: Option<TopicPrefix>,
    never_inputs: Rc<NeverInputs>,
}

impl WatchedPattern {
    fn is_input(&self, dds_topic: &str) -> bool {
        let topic =
            dds_topic.strip_prefix("rt").filter(|topic| self.has_inputs && self.settings.is_for(topic));
        let topic = topic.and_then(|topic| TopicName::try_from(topic).ok());
        topic.is_some_and(|topic| !self.never_inputs.contains(&topic))
    }

    /// The input topic of an output and the class of its lane; `None` for other topics.
    fn output(&self, dds_topic: &str) -> Option<(TopicName, TrafficClass)> {
        let topic = TopicName::try_from(dds_topic.strip_prefix("rt")?).ok()?;
        self.outputs.iter().find_map(|(prefix, class)| {
            let input = prefix.input_of(&topic).filter(|input| self.settings.is_for(input))?;
            Some((TopicName::try_from(input).ok()?, *class))
        })
    }

    /// The topic if hosts other than this one should not read it.
    fn guarded(&self, dds_topic: &str) -> Option<GuardedTopic> {
        let topic = TopicName::try_from(dds_topic.strip_prefix("rt")?).ok()?;
        let (input, guarded) = match self.output(dds_topic) {
            Some((input, TrafficClass::Critical)) => (input, Guarded::CriticalOutput),
            Some((_, TrafficClass::Noncritical)) => return None,
            None if self.is_input(dds_topic) => (topic.clone(), Guarded::Input),
            None => return None,
        };
        let alternative = self.alternative.as_ref().and_then(|prefix| prefix.output_of(&input));
        Some(GuardedTopic { topic, guarded, alternative })
    }
}

/// Overrun samples of one reader that were already logged.
#[derive(Default)]
struct LoggedOverrun {
    /// Of the present match.
    samples: u64,
    /// The record of a second ago.
    last: ReaderRecord,
    next_warning_at: MonotonicNs,
}

impl LoggedOverrun {
    /// Samples that the reader has missed and that are not logged yet.
    fn missed(&mut self, record: &ReaderRecord) -> u64 {
        if record.is_of_later_match(&self.last) {
            self.samples = 0;
        }
        self.last = *record;
        record.overrun.saturating_sub(self.samples)
    }
}

/// Monitors remote readers and writers of the bridge's topics on all networks.
pub(super) struct EndpointMonitor {
    /// One for each network, in the order of the participants.
    networks: Vec<WatchedNetwork>,
    absences: Absences,
    overruns: HashMap<Guid, LoggedOverrun>,
    endpoint_writers: Vec<BoardWriter<NamedEndpoint>>,
    next_update_at: MonotonicNs,
    own_addresses: Vec<IpAddr>,
    intruder_writers: Vec<BoardWriter<IntruderRecord>>,
    pub intruder_count: usize,
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
        let never_inputs = Rc::new(NeverInputs::of(settings));
        for (network, participant) in participants.iter().enumerate() {
            let mut guarded = Vec::new();
            let mut outputs = BTreeSet::new();
            let mut inputs = BTreeSet::new();
            if network == 0 {
                for (route, route_settings) in settings.routes.iter().enumerate() {
                    let InputTopic::Topic(topic) = &route_settings.input_topic else { continue };
                    inputs.insert(topic.to_dds());
                    guarded.push(GuardedTopic {
                        topic: topic.clone(),
                        guarded: Guarded::Input,
                        alternative: noncritical_output(settings, route)
                            .and_then(OutputTopic::topic)
                            .cloned(),
                    });
                }
            }
            let mut patterns: Vec<_> = settings
                .patterns
                .iter()
                .map(|pattern| watched_pattern(settings, pattern, &never_inputs, network == 0))
                .collect();
            let lanes =
                settings.lanes.iter().zip(&network_of_lane).filter(|(_, of_lane)| **of_lane == network);
            for (lane, _) in lanes {
                for output in &lane.outputs {
                    let topic = match &output.topic {
                        OutputTopic::Topic(topic) => topic,
                        OutputTopic::Prefix(prefix) => {
                            let of = |one: &&mut WatchedPattern| one.settings.first_route == output.route;
                            if let Some(pattern) = patterns.iter_mut().find(of) {
                                pattern.outputs.push((prefix.clone(), lane.class()));
                            }
                            continue;
                        }
                    };
                    outputs.insert(topic.to_dds());
                    if lane.class() == TrafficClass::Critical {
                        guarded.push(GuardedTopic {
                            topic: topic.clone(),
                            guarded: Guarded::CriticalOutput,
                            alternative: noncritical_output(settings, output.route)
                                .and_then(OutputTopic::topic)
                                .cloned(),
                        });
                    }
                }
            }
            watched.push(WatchedNetwork {
                watch: IntruderWatch::new(guarded),
                graph: participant.watch_graph()?,
                outputs,
                inputs,
                patterns,
                endpoints: Vec::new(),
            });
        }
        let endpoint_writers = (0..MAX_NAMED_ENDPOINTS).map(|index| boards.named_endpoint_writer(index));
        let intruder_writers = (0..MAX_INTRUDERS).map(|index| boards.intruder_writer(index));
        let mut monitor = Self {
            networks: watched,
            absences: Absences::new(boards, settings),
            overruns: HashMap::new(),
            endpoint_writers: endpoint_writers.collect(),
            next_update_at: MonotonicNs(0),
            own_addresses: Vec::new(),
            intruder_writers: intruder_writers.collect(),
            intruder_count: 0,
            boards: boards.clone(),
        };
        // Clears the tables of a previous control process.
        monitor.write_endpoints();
        monitor.write_intruders();
        Ok(monitor)
    }

    /// The number of intruders seen since control started.
    pub fn intruders_seen(&self) -> u64 {
        self.networks.iter().map(|network| network.watch.reported + network.watch.unreported).sum()
    }

    /// Handles discovery and logs new intruders; each second updates node names, absences and overruns.
    pub fn housekeeping(&mut self, participants: &mut [Participant], settings: &Settings, now: MonotonicNs) {
        let mut changed = false;
        for (number, (network, participant)) in self.networks.iter_mut().zip(participants).enumerate() {
            let mut are_addresses_current = false;
            let mut turn = DiscoveryTurn::new(now);
            while let Some(change) = participant.poll_discovery(&mut turn) {
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
                    if publishes { network.is_input(topic) } else { network.is_output(topic) }
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

    fn write_intruders(&mut self) {
        let present: Vec<_> = self.networks.iter().flat_map(|network| network.watch.present()).collect();
        self.intruder_count = present.len().min(MAX_INTRUDERS);
        let rows = present.into_iter().map(|intruder| {
            let host = intruder.host.map_or_else(|| "another host".to_owned(), |host| host.to_string());
            IntruderRecord {
                topic: FixedText::new(intruder.topic.topic.as_str()),
                node: FixedText::new(intruder.node.as_deref().unwrap_or("")),
                host: FixedText::new(&host),
                remedy: FixedText::new(&intruder.remedy()),
                since: intruder.since,
            }
        });
        write_rows(&mut self.intruder_writers, rows);
    }

    /// Writes the nodes of the inputs' publishers and of the outputs' readers to the boards.
    fn write_endpoints(&mut self) {
        let rows = self.networks.iter().flat_map(WatchedNetwork::named_endpoints);
        write_rows(&mut self.endpoint_writers, rows);
    }

    /// Logs each reader that has missed samples since its last log message.
    fn log_overruns(&mut self, settings: &Settings, now: MonotonicNs) {
        let mut matched = Vec::new();
        // On a noncritical lane fresher samples supersede those that are not acknowledged, by design.
        let critical = |(_, lane): &(usize, &Lane)| lane.class() == TrafficClass::Critical;
        for (lane, configured) in settings.lanes.iter().enumerate().filter(critical) {
            for output in &configured.outputs {
                let readers = self.boards.output_readers(lane, output.route).unwrap_or_default();
                for record in readers.iter() {
                    matched.push(record.reader);
                    let logged = self.overruns.entry(record.reader).or_default();
                    let missed = logged.missed(record);
                    if missed == 0 || now < logged.next_warning_at {
                        continue;
                    }
                    logged.samples = record.overrun;
                    logged.next_warning_at = now.plus_ms(OVERRUN_REPEAT_MS);
                    let reader = self.networks.iter().find_map(|network| network.reader_name(record.reader));
                    warn!(
                        lane = configured.name.as_str(),
                        route = settings.routes[output.route].id.as_str(),
                        topic = %output.topic,
                        reader = reader.unwrap_or_else(|| record.reader.to_string()),
                        missed,
                        unacknowledged = record.unacknowledged,
                        reason = "reader_overrun",
                        "a subscriber does not keep up and missed samples; the other subscribers received them"
                    );
                }
            }
        }
        self.overruns.retain(|reader, _| matched.contains(reader));
    }
}

impl WatchedNetwork {
    fn is_input(&self, dds_topic: &str) -> bool {
        self.inputs.contains(dds_topic) || self.patterns.iter().any(|pattern| pattern.is_input(dds_topic))
    }

    fn is_output(&self, dds_topic: &str) -> bool {
        self.outputs.contains(dds_topic)
            || self.patterns.iter().any(|pattern| pattern.output(dds_topic).is_some())
    }

    fn handle(
        &mut self,
        change: Discovery,
        participant: &Participant,
        own_addresses: &[IpAddr],
        now: MonotonicNs,
    ) {
        match change {
            Discovery::Reader(reader) if !participant.owns(reader.guid) => {
                if self.is_output(&reader.topic) {
                    self.remember(&reader);
                }
                if let Some(guarded) = self.patterns.iter().find_map(|one| one.guarded(&reader.topic)) {
                    self.watch.guard(guarded);
                }
                self.watch.endpoint_discovered(
                    reader.guid,
                    &reader.topic,
                    &reader.location,
                    own_addresses,
                    now,
                );
            }
            Discovery::Writer(writer) if !participant.owns(writer.guid) && self.is_input(&writer.topic) => {
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

/// The output of a route that hosts other than this one should read.
fn noncritical_output(settings: &Settings, route: usize) -> Option<&OutputTopic> {
    let noncritical = settings.lanes.iter().filter(|lane| lane.class() == TrafficClass::Noncritical);
    let mut outputs = noncritical.flat_map(|lane| &lane.outputs);
    outputs.find(|output| output.route == route).map(|output| &output.topic)
}

/// A pattern without its outputs.
fn watched_pattern(
    settings: &Settings,
    pattern: &RoutePattern,
    never_inputs: &Rc<NeverInputs>,
    has_inputs: bool,
) -> WatchedPattern {
    let alternative = noncritical_output(settings, pattern.first_route);
    WatchedPattern {
        settings: pattern.clone(),
        has_inputs,
        outputs: Vec::new(),
        alternative: alternative.and_then(OutputTopic::prefix).cloned(),
        never_inputs: never_inputs.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_losses_of_a_reader_that_is_matched_anew_are_logged_from_its_first() {
        let mut logged = LoggedOverrun::default();
        let record = |offered, overrun| ReaderRecord { offered, overrun, ..ReaderRecord::default() };
        assert_eq!(logged.missed(&record(1_000, 40)), 40);
        logged.samples = 40;
        assert_eq!(logged.missed(&record(1_100, 45)), 5);
        // Matched anew: it has missed nothing yet, then more than what was logged before.
        assert_eq!(logged.missed(&record(300, 0)), 0);
        assert_eq!(logged.missed(&record(1_200, 50)), 50);
        logged.samples = 50;
        // Matched anew, with more samples than before and fewer missed.
        assert_eq!(logged.missed(&record(1_300, 30)), 30);
    }
}
