//! Reads the routes and their outputs, and checks them against each other.

use std::cmp::Reverse;
use std::collections::{HashMap, HashSet};
use std::hash::Hash;
use std::ops::RangeInclusive;

use super::environment::Environment;
use super::field::Field;
use super::lanes::{self, LaneDraft};
use super::problem::Place;
use super::qos::{PartialQos, Profiles};
use super::settings::{DdsNetwork, InputTopic, Lane, Output, OutputTopic, Route, RoutePattern};
use crate::model::{Durability, QosProfile, RouteId, TopicName, TopicPattern, TopicPrefix, TypeName};

/// The most routes, with the places of patterns. Each has a pool in shared memory, a reader, and a writer on
/// each of its lanes.
const MAX_ROUTES: usize = 1_024;

/// The most patterns in `exclude`. Each is compared with each topic that discovery reports.
const MAX_EXCLUDED: usize = 64;

/// Samples of a route that are retained for a restarted lane when no output is configured TRANSIENT_LOCAL: as
/// many as fit [`RETAINED_BYTES`] if each is as large as the route allows. 256 are 1.3 s at 200 Hz, and more
/// than a lane takes to restart; 8 are what a route of images can afford.
const RETAINED_SAMPLES: RangeInclusive<usize> = 8..=256;
const RETAINED_BYTES: usize = 16 << 20;

/// The most samples that ingress keeps of a route in addition, as far as they fit a number of bytes: where a
/// route allows large samples, most are still small. 512 are half a second at 1 kHz.
const BACKLOG_SAMPLES: usize = 512;

/// Of all routes together, each has an equal share of so many such samples. Each sample takes a page at
/// least, so that they take 32 MiB before one comes.
const RETAINED_IN_ALL: usize = 8_192;

pub(super) fn input_network(root: &Field<'_>, environment: &Environment) -> DdsNetwork {
    let base = DdsNetwork {
        static_peers: environment.static_peers.clone(),
        ..DdsNetwork::of_domain(environment.domain_id)
    };
    lanes::network(&root.section("ros"), &base, environment)
}

/// Reads `topics` and `topic_qos_profiles`: the routes, and the lanes with their outputs.
pub(super) fn read(
    root: &Field<'_>,
    profiles: &Profiles<'_>,
    input: &DdsNetwork,
    drafts: Vec<LaneDraft>,
    max_sample_bytes: usize,
) -> (Vec<Route>, Vec<RoutePattern>, Vec<Lane>) {
    let topics = root.get("topics");
    let mut items = topics.items().unwrap_or_default();
    if items.is_empty() && !topics.was_reported() {
        topics
            .report::<()>("must be a list of at least one topic, such as `- {id: scan, input_topic: /scan}`");
    }
    if items.len() > MAX_ROUTES {
        topics.report_key(&format!("must be at most {MAX_ROUTES} topics"));
        items.truncate(MAX_ROUTES);
    }
    let topic_qos = root.section("topic_qos_profiles");
    let reader = RouteReader { profiles, lanes: &drafts, topic_qos: &topic_qos, max_sample_bytes };
    let read: Vec<RouteDraft<'_>> = items.iter().map(|item| reader.read(item)).collect();
    reader.check_topic_qos(&read);
    check_topics(&read, input, &drafts);
    check_places(&topics, &read);

    // A route without an id or topic can be left out, because the settings are discarded if there are
    // problems.
    let (mut routes, mut patterns) = (Vec::new(), Vec::new());
    let mut lanes: Vec<Lane> = drafts.into_iter().map(|draft| draft.lane).collect();
    let places = read.iter().map(|draft| draft.route_ids.len()).sum();
    for draft in read {
        let Some(mut route) = draft.route else { continue };
        if draft.retains_by_size {
            let by_size = retained_by_size(route.max_sample_bytes, places);
            route.retained_samples = route.retained_samples.max(by_size);
            let backlog = share_of(places).min(BACKLOG_SAMPLES);
            if backlog > route.retained_samples {
                route.backlog_samples = backlog;
            }
        }
        if let Some(pattern) = draft.pattern {
            patterns.push(RoutePattern { first_route: routes.len(), ..pattern });
        }
        for id in draft.route_ids {
            for OutputDraft { lane, topic, qos, latched_qos, .. } in &draft.outputs {
                let (topic, qos, latched_qos) = (topic.clone(), *qos, *latched_qos);
                lanes[*lane].outputs.push(Output { route: routes.len(), topic, qos, latched_qos });
            }
            routes.push(Route { id, ..route.clone() });
        }
    }
    for lane in &mut lanes {
        lane.outputs.sort_by_key(|output| Reverse(routes[output.route].priority));
    }
    (routes, patterns, lanes)
}

/// The samples of at most so many bytes that each of so many routes retains for a restarted lane.
fn retained_by_size(max_sample_bytes: usize, routes: usize) -> usize {
    let by_bytes = RETAINED_BYTES / max_sample_bytes.max(1);
    by_bytes.min(share_of(routes)).clamp(*RETAINED_SAMPLES.start(), *RETAINED_SAMPLES.end())
}

/// The share of each of so many routes in the samples of all.
const fn share_of(routes: usize) -> usize {
    RETAINED_IN_ALL / if routes == 0 { 1 } else { routes }
}

/// One entry of `topics`, with the parts that are valid.
struct RouteDraft<'a> {
    field: Field<'a>,
    id: Option<RouteId>,
    input: Option<(InputTopic, Field<'a>)>,
    /// Its first route, with the id of the entry.
    route: Option<Route>,
    /// The ids of its routes: its own, or those of the pattern's places.
    route_ids: Vec<RouteId>,
    /// Whether the route retains samples by their size, and not as the file says.
    retains_by_size: bool,
    pattern: Option<RoutePattern>,
    outputs: Vec<OutputDraft<'a>>,
}

struct OutputDraft<'a> {
    lane: usize,
    topic: OutputTopic,
    /// The field of the topic in the file, whose value may be missing.
    field: Field<'a>,
    qos: QosProfile,
    latched_qos: Option<QosProfile>,
}

struct RouteReader<'a, 'f> {
    profiles: &'a Profiles<'f>,
    lanes: &'a [LaneDraft],
    topic_qos: &'a Field<'f>,
    max_sample_bytes: usize,
}

impl<'f> RouteReader<'_, 'f> {
    fn read(&self, field: &Field<'f>) -> RouteDraft<'f> {
        field.entries();
        if field.was_reported() {
            // It is no mapping, so its missing keys are not reported.
            return RouteDraft {
                field: field.clone(),
                id: None,
                input: None,
                route: None,
                route_ids: Vec::new(),
                retains_by_size: false,
                pattern: None,
                outputs: Vec::new(),
            };
        }
        let id = required(&field.get("id"), RouteId::ALLOWED, |text| RouteId::try_from(text).ok());
        let input = field.get("input_topic");
        let input_topic = input_topic(&input);
        let (exclude, max_routes) = (exclude(field), field.get("max_routes"));
        let places: usize = max_routes.count_or_default();
        let is_pattern = input_topic.as_ref().is_some_and(InputTopic::is_place);
        if input_topic.is_some() && !is_pattern {
            for only in [&max_routes, &field.get("exclude")].into_iter().filter(|only| only.is_given()) {
                only.report_key("must be given only with a pattern as input_topic, such as /camera/**");
            }
        }
        let message_type =
            field.get("message_type").parsed(TypeName::ALLOWED, |text| TypeName::try_from(text).ok());
        let max_sample_bytes = field.get("max_sample_bytes").count();
        let priority = field.get("priority").count_or_default();
        let given_retained = field.get("retained_samples").count();

        let overrides = field.section("qos_overrides");
        self.check_lane_keys(&overrides, &["input"]);
        let input_qos = PartialQos::read(&overrides.get("input")).input();
        let outputs = self.outputs(field, id.as_ref(), input_topic.as_ref(), &overrides);
        let (latched, following) = self.retained_for_late_joiners(&outputs);
        let retained = given_retained.or(latched.map(|latched| latched.max(following)));

        let route = match (&id, &input_topic) {
            (Some(id), Some(input_topic)) => Some(Route {
                id: id.clone(),
                entry: id.clone(),
                input_topic: input_topic.clone(),
                message_type,
                input_qos,
                max_sample_bytes: max_sample_bytes.unwrap_or(self.max_sample_bytes),
                priority,
                retained_samples: retained.unwrap_or(following),
                backlog_samples: 0,
            }),
            _ => None,
        };
        let pattern = match (&id, &input_topic) {
            (Some(id), Some(InputTopic::Pattern(pattern))) => Some(RoutePattern {
                entry: id.clone(),
                input_topic: pattern.clone(),
                exclude,
                first_route: 0,
                max_routes: places,
            }),
            _ => None,
        };
        let route_ids = match &id {
            Some(id) if is_pattern => place_ids(id, places, field),
            _ => id.clone().into_iter().collect(),
        };
        let input = input_topic.map(|topic| (topic, input));
        RouteDraft {
            field: field.clone(),
            id,
            input,
            route,
            route_ids,
            retains_by_size: retained.is_none(),
            pattern,
            outputs,
        }
    }

    /// One output for each lane that serves the route.
    fn outputs(
        &self,
        field: &Field<'f>,
        id: Option<&RouteId>,
        input: Option<&InputTopic>,
        overrides: &Field<'f>,
    ) -> Vec<OutputDraft<'f>> {
        let section = field.section("outputs");
        self.check_lane_keys(&section, &[]);
        let serving = self.serving_lanes(field);
        let topic_qos = id.map(|id| self.topic_qos.section(id.as_str()));
        let mut outputs = Vec::new();
        for (index, LaneDraft { lane, qos: lane_qos }) in self.lanes.iter().enumerate() {
            let name = lane.name.as_str();
            let mut given = section.get(name);
            if matches!(name, "critical" | "noncritical") {
                let short = field.get(&format!("{name}_output"));
                if short.is_given() && given.is_given() {
                    given.report::<()>(&format!("must not be given together with {}", short.path));
                } else if short.is_given() {
                    given = short;
                }
            }
            // Values of lanes that do not serve the route are checked too.
            let topic = match input {
                Some(InputTopic::Pattern(_)) => {
                    given.parsed(TopicPrefix::ALLOWED, TopicPrefix::parse).map(OutputTopic::Prefix)
                }
                _ => {
                    let topic = given.parsed(TopicName::ALLOWED, |text| TopicName::try_from(text).ok());
                    topic.map(OutputTopic::Topic)
                }
            };
            let override_qos = PartialQos::read(&overrides.get(name));
            let profile = topic_qos.as_ref().and_then(|section| self.profiles.named(&section.get(name)));
            if !serving[index] {
                continue;
            }
            let default = || {
                let input = match input.filter(|_| !given.is_given())? {
                    InputTopic::Topic(topic) => topic,
                    InputTopic::Pattern(_) => {
                        return TopicPrefix::parse(&format!("/adaptive_bridge/{name}/**"))
                            .map(OutputTopic::Prefix);
                    }
                };
                let default = format!("/adaptive_bridge/{name}{input}");
                let topic = TopicName::try_from(default.as_str()).ok();
                if topic.is_none() {
                    given.report_value(&default, format!("must be {}", TopicName::ALLOWED));
                }
                topic.map(OutputTopic::Topic)
            };
            let Some(topic) = topic.or_else(default) else { continue };
            let given_qos = override_qos.over(profile.unwrap_or(*lane_qos));
            let (qos, latched_qos) = (given_qos.complete(lane.class()), given_qos.latched(lane.class()));
            outputs.push(OutputDraft { lane: index, topic, field: given, qos, latched_qos });
        }
        outputs
    }

    /// For each lane, whether it serves the route.
    fn serving_lanes(&self, field: &Field<'_>) -> Vec<bool> {
        let lanes = field.get("lanes");
        let Some(items) = lanes.items() else { return vec![true; self.lanes.len()] };
        if items.is_empty() {
            lanes.report::<()>("must be a list of at least one lane");
        }
        let names = self.lane_names();
        let mut serving = vec![false; self.lanes.len()];
        for item in &items {
            let index =
                item.reference("a lane", &names, |name| names.iter().position(|known| *known == name));
            if let Some(index) = index {
                serving[index] = true;
            }
        }
        serving
    }

    /// The samples that late joiners need of a restarted lane: the largest history of the TRANSIENT_LOCAL
    /// outputs, if there are any, and that of the outputs that follow the publishers. These count with their
    /// depth, and never with a KEEP_ALL window, because most stay VOLATILE.
    fn retained_for_late_joiners(&self, outputs: &[OutputDraft<'_>]) -> (Option<usize>, usize) {
        let durable = outputs.iter().filter(|output| output.qos.durability == Durability::TransientLocal);
        let depths = durable.map(|output| match output.qos.depth() {
            Some(depth) => depth as usize,
            // KEEP_ALL keeps as many samples as the writer's window.
            None => self.lanes[output.lane].lane.window_samples_of(&output.qos),
        });
        let following = outputs.iter().filter_map(|output| output.latched_qos?.depth());
        (depths.max(), following.max().map_or(0, |depth| depth as usize))
    }

    fn lane_names(&self) -> Vec<&str> {
        self.lanes.iter().map(|draft| draft.lane.name.as_str()).collect()
    }

    /// Checks that the keys of a mapping are lanes or one of `others`.
    fn check_lane_keys(&self, section: &Field<'_>, others: &[&str]) {
        let mut known = others.to_vec();
        known.extend(self.lane_names());
        for (name, field) in section.entries() {
            if !known.contains(&name) {
                field.report_unknown_key("a lane", name, &known);
            }
        }
    }

    /// Checks that the keys of `topic_qos_profiles` are routes and lanes.
    fn check_topic_qos(&self, routes: &[RouteDraft<'_>]) {
        let known: Vec<&str> =
            routes.iter().filter_map(|route| route.id.as_ref().map(RouteId::as_str)).collect();
        let unique: HashSet<&str> = known.iter().copied().collect();
        for (id, section) in self.topic_qos.entries() {
            if unique.contains(id) {
                self.check_lane_keys(&section, &[]);
            } else {
                section.report_unknown_key("the id of a topic", id, &known);
            }
        }
    }
}

fn required<T>(field: &Field<'_>, allowed: &str, parse: impl FnOnce(&str) -> Option<T>) -> Option<T> {
    if !field.is_given() {
        return field.report(&format!("must be {allowed}"));
    }
    field.parsed(allowed, parse)
}

/// A topic, or a pattern if the text has a wild card.
fn input_topic(field: &Field<'_>) -> Option<InputTopic> {
    if field.text().is_some_and(|text| text.contains('*')) {
        let pattern = field.parsed(TopicPattern::ALLOWED, |text| TopicPattern::try_from(text).ok());
        return pattern.map(InputTopic::Pattern);
    }
    required(field, TopicName::ALLOWED, |text| TopicName::try_from(text).ok()).map(InputTopic::Topic)
}

/// The patterns in `exclude`.
fn exclude(field: &Field<'_>) -> Vec<TopicPattern> {
    let mut items = field.get("exclude").items().unwrap_or_default();
    if items.len() > MAX_EXCLUDED {
        field.get("exclude").report_key(&format!("must be at most {MAX_EXCLUDED} patterns"));
        items.truncate(MAX_EXCLUDED);
    }
    let pattern =
        |item: &Field<'_>| item.parsed(TopicPattern::ALLOWED, |text| TopicPattern::try_from(text).ok());
    items.iter().filter_map(pattern).collect()
}

/// The ids of a pattern's places: `camera.1`, `camera.2`, …
fn place_ids(id: &RouteId, places: usize, field: &Field<'_>) -> Vec<RouteId> {
    let ids: Vec<_> =
        (1..=places).filter_map(|place| RouteId::try_from(format!("{id}.{place}").as_str()).ok()).collect();
    if ids.len() < places {
        field.get("id").report::<()>("must be short enough for .1, .2, … after it: 61 characters at most");
    }
    ids
}

/// Checks the number of routes, and that no other entry has the id of a place.
fn check_places(topics: &Field<'_>, routes: &[RouteDraft<'_>]) {
    if routes.iter().map(|route| route.route_ids.len()).sum::<usize>() > MAX_ROUTES {
        topics.report_key(&format!("must be at most {MAX_ROUTES} topics, with max_routes of each pattern"));
    }
    let patterns = routes.iter().filter(|route| route.pattern.is_some());
    let places: HashMap<_, _> =
        patterns.flat_map(|route| route.route_ids.iter().map(move |id| (id, &route.field))).collect();
    for route in routes {
        if let Some(first) = route.id.as_ref().and_then(|id| places.get(id)) {
            let allowed = format!("must not be the id of a route of the pattern {}", at(&first.get("id")));
            route.field.get("id").report::<()>(&allowed);
        }
    }
}

/// Checks that ids are unique, and that each topic of a domain is only one input or one output. A topic that
/// is both would be a loop.
fn check_topics(routes: &[RouteDraft<'_>], input: &DdsNetwork, lanes: &[LaneDraft]) {
    let mut ids = HashMap::new();
    let mut inputs: HashMap<String, &Field<'_>> = HashMap::new();
    for route in routes {
        if let Some(id) = &route.id
            && let Some(first) = first_of(&mut ids, id.as_str(), &route.field)
        {
            let allowed = format!("must be unique; it is the same as {}", at(&first.get("id")));
            route.field.get("id").report::<()>(&allowed);
        }
        if let Some((topic, field)) = &route.input
            && let Some(first) = first_of(&mut inputs, topic.to_string(), field)
        {
            field.report::<()>(&format!("must be listed once; {} is the same topic", at(first)));
        }
    }
    let mut outputs = HashMap::new();
    for (index, pattern, output) in routes.iter().enumerate().flat_map(|(index, route)| {
        // Two patterns may have the same prefix: a topic has one route, and so an output of its own.
        let pattern = route.pattern.as_ref();
        let index = pattern.map(|_| index);
        route.outputs.iter().map(move |output| (index, pattern, output))
    }) {
        let domain_id = lanes[output.lane].lane.network.domain_id;
        let topic = output.topic.to_string();
        let loops = if domain_id == input.domain_id { inputs.get(&topic) } else { None };
        if let Some(field) = loops
            && index.is_none()
        {
            let allowed = format!("must not be an input topic in the same domain ({}): a loop", at(field));
            output.field.report_value(&topic, allowed);
        }
        if let (Some(pattern), OutputTopic::Prefix(prefix)) = (pattern, &output.topic)
            && prefix.is_within(&format!("{}/topic", pattern.input_topic.literal_start()))
        {
            let allowed =
                "must not be what all topics of the pattern begin with: each would be an output".to_owned();
            output.field.report_value(&topic, allowed);
        }
        if let Some(first) = first_of(&mut outputs, (index, domain_id, topic.clone()), &output.field) {
            let allowed = format!("must not be another output in the same domain ({})", at(first));
            output.field.report_value(&topic, allowed);
        }
    }
}

/// The first field with this key; `None` if that is this one.
fn first_of<'m, K: Eq + Hash>(
    seen: &mut HashMap<K, &'m Field<'m>>,
    key: K,
    field: &'m Field<'m>,
) -> Option<&'m Field<'m>> {
    let first = *seen.entry(key).or_insert(field);
    (!std::ptr::eq(first, field)).then_some(first)
}

/// The key path and place of a field, for a message.
fn at(field: &Field<'_>) -> String {
    format!("{}, {}", field.path, Place::noun(field.line))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{Settings, parse};

    fn settings(text: &str) -> Settings {
        parse(text, "f.yaml", &|_| None).unwrap_or_else(|error| panic!("{text}\n{error}"))
    }

    #[test]
    fn a_route_retains_more_small_samples_for_a_restarted_lane_and_fewer_beside_many_routes() {
        let retained = |bytes: usize, routes: usize| {
            let route =
                |number| format!("- {{id: r{number}, input_topic: /r{number}, max_sample_bytes: {bytes}}}\n");
            let text = format!("topics:\n{}", (0..routes).map(route).collect::<String>());
            let retained: HashSet<_> =
                settings(&text).routes.iter().map(|route| route.retained_samples).collect();
            let [retained] = retained.into_iter().collect::<Vec<_>>()[..] else {
                panic!("not the same for all")
            };
            retained
        };
        for (bytes, routes, samples) in [
            (1 << 10, 1, 256),
            (64 << 10, 1, 256),
            (512 << 10, 1, 32),
            (2 << 20, 1, 8),
            (64 << 20, 1, 8),
            (64 << 10, 32, 256),
            (64 << 10, 64, 128),
            (512 << 10, 64, 32),
            (64 << 10, 1_024, 8),
        ] {
            assert_eq!(retained(bytes, routes), samples, "{routes} routes of {bytes} bytes");
        }
        let backlog = |text: &str| settings(text).routes[0].backlog_samples;
        assert_eq!(backlog("topics: [{id: a, input_topic: /a}]"), 512);
        assert_eq!(backlog("topics: [{id: a, input_topic: /a, max_sample_bytes: 1000}]"), 512);
        assert_eq!(backlog("topics: [{id: a, input_topic: /a/**, max_routes: 64}]"), 128);
        let route = |number| format!("- {{id: r{number}, input_topic: /r{number}}}\n");
        assert_eq!(backlog(&format!("topics:\n{}", (0..1_024).map(route).collect::<String>())), 0);
        assert_eq!(backlog("topics: [{id: a, input_topic: /a, retained_samples: 3}]"), 0);
        // Of a pattern, each place counts.
        let text = "topics: [{id: any, input_topic: /a/**, max_routes: 64, max_sample_bytes: 1000}]";
        assert_eq!(settings(text).routes[5].retained_samples, 128);
        // What the file says stays.
        let text = "topics: [{id: a, input_topic: /a, max_sample_bytes: 1000, retained_samples: 3}]";
        assert_eq!(settings(text).routes[0].retained_samples, 3);
        let text = "topics: [{id: a, input_topic: /a, max_sample_bytes: 1000}]\n\
                    lanes: {critical: {qos: {durability: TRANSIENT_LOCAL, depth: 5}}}";
        assert_eq!(settings(text).routes[0].retained_samples, 5);
    }
}
