//! The topic of an output. If the route is a place of a pattern, ingress chooses it, and may change it.

use crate::config::{self, OutputTopic, Route};
use crate::model::{RouteInfo, TopicName};

/// The topic of an output.
pub(super) struct BoundTopic {
    configured: OutputTopic,
    pub is_place: bool,
    /// The DDS topic; empty for a place without a topic.
    pub dds_topic: String,
    /// The last sequence number of a place before it got its topic.
    after: u64,
    /// How many topics the place has had.
    count: u64,
}

impl BoundTopic {
    /// The topic of an output at its start. A place has the one that ingress has given to it by now, if any.
    pub fn new(route: &Route, output: &config::Output, info: &RouteInfo) -> Self {
        let dds_topic = output.topic.resolve(None).map_or_else(String::new, |topic| topic.to_dds());
        let is_place = route.input_topic.is_place();
        let mut topic = Self { configured: output.topic.clone(), is_place, dds_topic, after: 0, count: 0 };
        if let Some(bound) = topic.next(info) {
            topic.set(info, &bound);
        }
        topic
    }

    /// Whether this is the topic that ingress has given to the place; also true for other routes.
    pub const fn is_current(&self, info: &RouteInfo) -> bool {
        info.bound_count == self.count
    }

    /// The topic to change to, if ingress has given the place another one.
    pub fn next(&self, info: &RouteInfo) -> Option<TopicName> {
        let input = info.topic().filter(|_| !self.is_current(info));
        self.configured.resolve(Some(&input?))
    }

    /// Changes to the topic that [`next`](Self::next) has returned.
    pub fn set(&mut self, info: &RouteInfo, topic: &TopicName) {
        (self.after, self.count) = (info.bound_after, info.bound_count);
        self.dds_topic = topic.to_dds();
    }

    /// Whether the sample with this number is of the former topic of the place.
    pub const fn is_former(&self, sequence: u64) -> bool {
        sequence <= self.after
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::parse;
    use crate::model::FixedText;

    #[test]
    fn a_place_changes_its_topic_with_the_record_of_ingress_and_knows_samples_of_the_former_one() {
        let text = "topics: [{id: any, input_topic: /a/**, critical_output: /out/**, max_routes: 1}]";
        let settings = parse(text, "f.yaml", &|_| None).unwrap();
        let start = |info: &_| BoundTopic::new(&settings.routes[0], &settings.lanes[0].outputs[0], info);
        let mut info = RouteInfo::default();
        let mut topic = start(&info);
        assert!(topic.is_place && topic.is_current(&info) && topic.next(&info).is_none());
        assert_eq!((topic.dds_topic.as_str(), topic.is_former(0)), ("", true));
        // The second topic follows the first one without a sample of it.
        for (count, name, after) in [(1, "/a/x", 0), (2, "/a/y", 0), (3, "/a/x", 17)] {
            info.bound_topic = FixedText::new(name);
            (info.bound_after, info.bound_count) = (after, count);
            let next = topic.next(&info).unwrap();
            assert_eq!(next.to_string(), format!("/out{name}"));
            assert!(!topic.is_current(&info));
            topic.set(&info, &next);
            // And one that starts now.
            for topic in [&topic, &start(&info)] {
                assert!(topic.is_current(&info) && topic.next(&info).is_none());
                assert_eq!(topic.dds_topic, format!("rt/out{name}"));
                assert_eq!([after, after + 1].map(|sequence| topic.is_former(sequence)), [true, false]);
            }
        }
    }

    #[test]
    fn another_route_has_its_topic_for_ever() {
        let settings = parse("topics: [{id: scan, input_topic: /scan}]", "f.yaml", &|_| None).unwrap();
        let output = &settings.lanes[0].outputs[0];
        let topic = BoundTopic::new(&settings.routes[0], output, &RouteInfo::default());
        assert_eq!(topic.dds_topic, "rt/adaptive_bridge/critical/scan");
        assert!(!topic.is_place && topic.is_current(&RouteInfo::default()) && !topic.is_former(1));
    }
}
