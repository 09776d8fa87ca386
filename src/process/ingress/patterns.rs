//! The patterns: which discovered topics get a place, as the policy decides, and which are no candidates.

use tracing::{info, warn};

use crate::config::{Lane, NeverInputs, RoutePattern, Settings};
use crate::dds::Endpoint;
use crate::model::{FixedText, Guid, MonotonicNs, PatternRecord, TopicName, TopicPrefix};
use crate::policy::{Location, MAX_TOPIC_WRITERS, MAX_WAITING_TOPICS, RoutePlaces, TRIAL_MS};
use crate::shm::{BoardWriter, Boards};

/// The most bytes of the name of a topic that gets a place, and of its type: as many as a board has room for.
const MAX_NAME_BYTES: usize = 127;

/// The most memory for what is remembered of the topics of a pattern with 64 places: for each writer two
/// names, its QoS and a share of the topic.
pub(in crate::process) const PATTERN_BYTES: u64 =
    ((MAX_WAITING_TOPICS + 64) * MAX_TOPIC_WRITERS * 1024) as u64;

/// All patterns of the bridge.
pub(super) struct Patterns {
    patterns: Vec<Pattern>,
    never_inputs: NeverInputs,
    /// The outputs of other routes, each with its DDS domain.
    fixed_outputs: Vec<(u16, TopicName)>,
    /// The writers of the topics that the policy remembers.
    writers: Vec<Endpoint>,
    /// The number of forgotten topics when those of forgotten ones were removed.
    pruned_at: u64,
}

struct Pattern {
    settings: RoutePattern,
    /// The DDS type, if the configuration gives it.
    dds_type: Option<String>,
    /// The outputs of each place: the DDS domain and the prefix.
    outputs: Vec<(u16, TopicPrefix)>,
    places: RoutePlaces,
    refused: u64,
    record: BoardWriter<PatternRecord>,
    warn_at: MonotonicNs,
}

impl Patterns {
    pub fn open(settings: &Settings, boards: &Boards) -> Self {
        let fixed_outputs = settings.lanes.iter().flat_map(|lane| {
            let topics = lane.outputs.iter().filter_map(|output| output.topic.topic());
            topics.map(|topic| (lane.network.domain_id, topic.clone()))
        });
        let fixed_outputs = fixed_outputs.collect();
        let pattern = |pattern: &RoutePattern| {
            let of_first = |lane: &Lane| {
                let output = lane.outputs.iter().find(|output| output.route == pattern.first_route)?;
                Some((lane.network.domain_id, output.topic.prefix()?.clone()))
            };
            let message_type = &settings.routes[pattern.first_route].message_type;
            Pattern {
                dds_type: message_type.as_ref().map(|name| name.to_dds()),
                outputs: settings.lanes.iter().filter_map(of_first).collect(),
                places: RoutePlaces::new(pattern.max_routes),
                refused: 0,
                record: boards.pattern_writer(pattern.first_route),
                warn_at: MonotonicNs(0),
                settings: pattern.clone(),
            }
        };
        let patterns = settings.patterns.iter().map(pattern).collect();
        let never_inputs = NeverInputs::of(settings);
        Self { patterns, never_inputs, fixed_outputs, writers: Vec::new(), pruned_at: 0 }
    }

    /// The routes that are places.
    pub fn places(&self) -> Vec<usize> {
        self.patterns.iter().flat_map(|pattern| pattern.settings.places()).collect()
    }

    /// The pattern of a place, and its number there.
    fn place(&mut self, route: usize) -> Option<(&mut Pattern, usize)> {
        let pattern = self.patterns.iter_mut().find(|pattern| pattern.settings.places().contains(&route))?;
        let place = route - pattern.settings.first_route;
        Some((pattern, place))
    }

    /// Returns the topic that a place had in the former process.
    pub fn resume(&mut self, route: usize, bound: Option<(TopicName, u64)>, now: MonotonicNs) {
        if let (Some((pattern, place)), Some((topic, samples))) = (self.place(route), bound) {
            pattern.places.resume(place, topic, samples, now);
        }
    }

    /// Records the samples that a place has had of its topic.
    pub fn samples_at(&mut self, route: usize, bound: Option<(TopicName, u64)>, now: MonotonicNs) {
        if let (Some((pattern, place)), Some((_, samples))) = (self.place(route), bound) {
            pattern.places.samples_at(place, samples, now);
        }
    }

    /// Records a discovered writer of any topic. The first pattern that is for the topic counts.
    pub fn writer_found(&mut self, writer: &Endpoint) {
        let Some(name) = writer.topic.strip_prefix("rt") else { return };
        let Some(of) = self.patterns.iter().position(|pattern| pattern.settings.is_for(name)) else { return };
        // Not a name of ROS 2: no subscriber could have it.
        let Ok(topic) = TopicName::try_from(name) else { return };
        if self.never_inputs.contains(&topic) {
            return;
        }
        let is_possible = writer.dds_type.len() <= MAX_NAME_BYTES && self.has_outputs_for(of, &topic);
        let pattern = &mut self.patterns[of];
        if pattern.dds_type.as_ref().is_some_and(|dds_type| *dds_type != writer.dds_type) {
            return;
        }
        if !is_possible {
            pattern.refused += 1;
            return;
        }
        if pattern.places.writer_found(&topic, writer.guid) {
            self.writers.retain(|known| known.guid != writer.guid);
            let count = self.writers.iter().filter(|known| known.topic == writer.topic).count();
            if count < MAX_TOPIC_WRITERS {
                // The addresses of its host are of no use here, and may be many.
                self.writers.push(Endpoint { location: Location::default(), ..writer.clone() });
            }
        }
    }

    /// Whether the outputs of a topic have valid names, and no other output in their domain the same one.
    fn has_outputs_for(&self, of: usize, topic: &TopicName) -> bool {
        let others = || self.patterns.iter().enumerate().filter(move |(index, _)| *index != of);
        topic.as_str().len() <= MAX_NAME_BYTES
            && self.patterns[of].outputs.iter().all(|(domain_id, prefix)| {
                prefix.output_of(topic).is_some_and(|output| {
                    let is_fixed = |(of, fixed): &(u16, TopicName)| of == domain_id && *fixed == output;
                    !self.fixed_outputs.iter().any(is_fixed)
                        && others().all(|(_, other)| !other.may_publish(*domain_id, prefix, &output))
                })
            })
    }

    /// Records that the writers for which this holds are gone.
    pub fn writers_gone(&mut self, is_gone: impl Fn(Guid) -> bool) {
        self.writers.retain(|writer| !is_gone(writer.guid));
        for pattern in &mut self.patterns {
            pattern.places.writers_gone(&is_gone);
        }
    }

    /// The known writers of a topic.
    pub fn writers_of(&self, topic: &TopicName) -> impl Iterator<Item = &Endpoint> {
        let dds_topic = topic.to_dds();
        self.writers.iter().filter(move |writer| writer.topic == dds_topic)
    }

    /// The next place that gets a topic, and the topic.
    pub fn poll(&mut self, now: MonotonicNs) -> Option<(usize, TopicName)> {
        for pattern in &mut self.patterns {
            let Some(binding) = pattern.places.poll(now) else {
                pattern.warn_of_waiting(now);
                continue;
            };
            let route = pattern.settings.first_route + binding.place;
            let place = format!("{}.{}", pattern.settings.entry, binding.place + 1);
            let topic = binding.topic.as_str();
            match &binding.former {
                None => info!(route = place, topic, "topic found for a place"),
                Some(former) => {
                    info!(route = place, topic, former = former.as_str(), "a place has another topic");
                }
            }
            return Some((route, binding.topic));
        }
        None
    }

    /// Forgets what the policy has forgotten, and writes the boards.
    pub fn housekeeping(&mut self) {
        let Self { patterns, writers, pruned_at, .. } = self;
        // Only after a topic was forgotten: thousands of forged writers take milliseconds.
        let forgotten = patterns.iter().map(|pattern| pattern.places.forgotten).sum();
        if *pruned_at != forgotten {
            *pruned_at = forgotten;
            writers.retain(|writer| {
                let name = writer.topic.strip_prefix("rt").and_then(|name| TopicName::try_from(name).ok());
                name.is_some_and(|name| patterns.iter().any(|pattern| pattern.places.knows(&name)))
            });
        }
        for pattern in patterns {
            let (waiting, first) = pattern.places.waiting();
            pattern.record.set(PatternRecord {
                waiting: waiting as u64,
                released: pattern.places.released,
                refused: pattern.refused,
                forgotten: pattern.places.forgotten,
                first_waiting: first.map_or_else(FixedText::default, |name| FixedText::new(name.as_str())),
            });
        }
    }
}

impl Pattern {
    /// Whether this pattern may publish `output`, the output of another pattern with `prefix`: then the input
    /// that it would be of is this pattern's.
    fn may_publish(&self, domain_id: u16, prefix: &TopicPrefix, output: &TopicName) -> bool {
        self.outputs.iter().any(|(domain, own)| {
            *domain == domain_id
                && own != prefix
                && own.input_of(output).is_some_and(|input| self.settings.is_for(input))
        })
    }

    fn warn_of_waiting(&mut self, now: MonotonicNs) {
        let (waiting, first) = self.places.waiting();
        let Some(first) = first.filter(|_| now >= self.warn_at) else { return };
        self.warn_at = now.plus_ms(6 * TRIAL_MS);
        warn!(
            pattern = self.settings.entry.as_str(),
            waiting,
            topic = first.as_str(),
            max_routes = self.settings.max_routes,
            "more topics match the pattern than it has places: raise max_routes, or exclude topics"
        );
    }
}
