//! Reads the routes and their outputs, and checks them against each other.

use std::cmp::Reverse;
use std::collections::{HashMap, HashSet};
use std::hash::Hash;

use super::environment::Environment;
use super::field::Field;
use super::lanes::{self, LaneDraft};
use super::problem::Place;
use super::qos::{PartialQos, Profiles};
use super::settings::{DdsNetwork, Lane, Output, Route};
use crate::model::{Durability, QosProfile, RouteId, TopicName, TypeName};

/// The most routes. Each has a pool in shared memory, a reader, and a writer on each of its lanes.
const MAX_ROUTES: usize = 1_024;

/// Samples retained for a restarted lane when no output is configured TRANSIENT_LOCAL.
const RETAINED_SAMPLES: usize = 8;

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
) -> (Vec<Route>, Vec<Lane>) {
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

    // A route without an id or topic can be left out, because the settings are discarded if there are
    // problems.
    let mut routes = Vec::new();
    let mut lanes: Vec<Lane> = drafts.into_iter().map(|draft| draft.lane).collect();
    for draft in read {
        let Some(route) = draft.route else { continue };
        for OutputDraft { lane, topic, qos, latched_qos, .. } in draft.outputs {
            lanes[lane].outputs.push(Output { route: routes.len(), topic, qos, latched_qos });
        }
        routes.push(route);
    }
    for lane in &mut lanes {
        lane.outputs.sort_by_key(|output| Reverse(routes[output.route].priority));
    }
    (routes, lanes)
}

/// One entry of `topics`, with the parts that are valid.
struct RouteDraft<'a> {
    field: Field<'a>,
    id: Option<RouteId>,
    input: Option<(TopicName, Field<'a>)>,
    route: Option<Route>,
    outputs: Vec<OutputDraft<'a>>,
}

struct OutputDraft<'a> {
    lane: usize,
    topic: TopicName,
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
            let outputs = Vec::new();
            return RouteDraft { field: field.clone(), id: None, input: None, route: None, outputs };
        }
        let id = required(&field.get("id"), RouteId::ALLOWED, |text| RouteId::try_from(text).ok());
        let input = field.get("input_topic");
        let input_topic = required(&input, TopicName::ALLOWED, |text| TopicName::try_from(text).ok());
        let message_type =
            field.get("message_type").parsed(TypeName::ALLOWED, |text| TypeName::try_from(text).ok());
        let max_sample_bytes = field.get("max_sample_bytes").count();
        let priority = field.get("priority").count_or_default();
        let retained_samples = field.get("retained_samples").count();

        let overrides = field.section("qos_overrides");
        self.check_lane_keys(&overrides, &["input"]);
        let input_qos = PartialQos::read(&overrides.get("input")).input();
        let outputs = self.outputs(field, id.as_ref(), input_topic.as_ref(), &overrides);

        let route = match (&id, &input_topic) {
            (Some(id), Some(input_topic)) => Some(Route {
                id: id.clone(),
                input_topic: input_topic.clone(),
                message_type,
                input_qos,
                max_sample_bytes: max_sample_bytes.unwrap_or(self.max_sample_bytes),
                priority,
                retained_samples: retained_samples.unwrap_or_else(|| self.retained_samples(&outputs)),
            }),
            _ => None,
        };
        let input = input_topic.map(|topic| (topic, input));
        RouteDraft { field: field.clone(), id, input, route, outputs }
    }

    /// One output for each lane that serves the route.
    fn outputs(
        &self,
        field: &Field<'f>,
        id: Option<&RouteId>,
        input: Option<&TopicName>,
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
            let topic = given.parsed(TopicName::ALLOWED, |text| TopicName::try_from(text).ok());
            let override_qos = PartialQos::read(&overrides.get(name));
            let profile = topic_qos.as_ref().and_then(|section| self.profiles.named(&section.get(name)));
            if !serving[index] {
                continue;
            }
            let default = || {
                let default = format!("/adaptive_bridge/{name}{}", input.filter(|_| !given.is_given())?);
                let topic = TopicName::try_from(default.as_str()).ok();
                if topic.is_none() {
                    given.report_value(&default, format!("must be {}", TopicName::ALLOWED));
                }
                topic
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

    /// The samples that a restarted lane needs: the largest history of the TRANSIENT_LOCAL outputs. Outputs
    /// that follow the publishers count with their depth, and never with a KEEP_ALL window, because most stay
    /// VOLATILE.
    fn retained_samples(&self, outputs: &[OutputDraft<'_>]) -> usize {
        let durable = outputs.iter().filter(|output| output.qos.durability == Durability::TransientLocal);
        let depths = durable.map(|output| match output.qos.depth() {
            Some(depth) => depth as usize,
            // KEEP_ALL keeps as many samples as the writer's window.
            None => self.lanes[output.lane].lane.window_samples_of(&output.qos),
        });
        let following = outputs.iter().filter_map(|output| output.latched_qos?.depth());
        let following = following.max().map_or(0, |depth| depth as usize);
        depths.max().unwrap_or(RETAINED_SAMPLES).max(following)
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

/// Checks that ids are unique, and that each topic of a domain is only one input or one output. A topic that
/// is both would be a loop.
fn check_topics(routes: &[RouteDraft<'_>], input: &DdsNetwork, lanes: &[LaneDraft]) {
    let mut ids = HashMap::new();
    let mut inputs = HashMap::new();
    for route in routes {
        if let Some(id) = &route.id
            && let Some(first) = first_of(&mut ids, id.as_str(), &route.field)
        {
            let allowed = format!("must be unique; it is the same as {}", at(&first.get("id")));
            route.field.get("id").report::<()>(&allowed);
        }
        if let Some((topic, field)) = &route.input
            && let Some(first) = first_of(&mut inputs, topic.as_str(), field)
        {
            field.report::<()>(&format!("must be listed once; {} is the same topic", at(first)));
        }
    }
    let mut outputs = HashMap::new();
    for output in routes.iter().flat_map(|route| &route.outputs) {
        let domain_id = lanes[output.lane].lane.network.domain_id;
        let topic = output.topic.as_str();
        let loops = if domain_id == input.domain_id { inputs.get(topic) } else { None };
        if let Some(field) = loops {
            let allowed = format!("must not be an input topic in the same domain ({}): a loop", at(field));
            output.field.report_value(topic, allowed);
        }
        if let Some(first) = first_of(&mut outputs, (domain_id, topic), &output.field) {
            let allowed = format!("must not be another output in the same domain ({})", at(first));
            output.field.report_value(topic, allowed);
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
