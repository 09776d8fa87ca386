//! The topics that no pattern has as an input, because the bridge itself writes or reads them.

use super::{InputTopic, OutputTopic, Settings};
use crate::model::{TopicName, TopicPrefix};

/// Where outputs are without configured names, also those of other bridges.
const DEFAULT_OUTPUTS: &str = "/adaptive_bridge/**";

/// The topics of a configuration that match no pattern.
#[derive(Clone, Debug)]
pub struct NeverInputs {
    topics: Vec<TopicName>,
    prefixes: Vec<TopicPrefix>,
}

impl NeverInputs {
    /// The inputs of other routes, the outputs, and the topics of probes and diagnostics.
    pub fn of(settings: &Settings) -> Self {
        let fixed = settings.routes.iter().filter_map(|route| match &route.input_topic {
            InputTopic::Topic(topic) => Some(topic.clone()),
            InputTopic::Pattern(_) => None,
        });
        let own =
            [&settings.probes.request_topic, &settings.probes.response_topic, &settings.diagnostics.topic];
        let mut topics: Vec<_> = fixed.chain(own.into_iter().cloned()).collect();
        let mut prefixes: Vec<_> = TopicPrefix::parse(DEFAULT_OUTPUTS).into_iter().collect();
        for lane in &settings.lanes {
            let is_beside_inputs = lane.network.domain_id == settings.input.domain_id;
            for output in &lane.outputs {
                match &output.topic {
                    OutputTopic::Topic(topic) => topics.extend(is_beside_inputs.then(|| topic.clone())),
                    // In other domains, too: a bridge there may forward them back, each time below one more
                    // prefix.
                    OutputTopic::Prefix(prefix) if !prefixes.contains(prefix) => {
                        prefixes.push(prefix.clone());
                    }
                    OutputTopic::Prefix(_) => {}
                }
            }
        }
        Self { topics, prefixes }
    }

    /// Whether no pattern has this topic.
    pub fn contains(&self, topic: &TopicName) -> bool {
        self.topics.contains(topic) || self.prefixes.iter().any(|prefix| prefix.is_within(topic.as_str()))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::parse;

    #[test]
    fn what_the_bridge_writes_or_reads_itself_matches_no_pattern() {
        let text = "topics: [{id: all, input_topic: /**, outputs: {video: /out/**}}, \
                    {id: b, input_topic: /scan, critical_output: /x}]\n\
                    lanes: {video: {domain_id: 7}}";
        let settings = parse(text, "f.yaml", &|_| None).unwrap();
        let never = NeverInputs::of(&settings);
        let contains = |topic: &str| never.contains(&TopicName::try_from(topic).unwrap());
        let own = [&settings.probes.request_topic, &settings.diagnostics.topic].map(TopicName::as_str);
        // An output in another domain, too: a bridge there may forward it back below a prefix.
        let more = ["/scan", "/x", "/adaptive_bridge/critical/a", "/out/a", "/back/out/a"];
        for topic in own.into_iter().chain(more) {
            assert!(contains(topic), "{topic}");
        }
        for topic in ["/camera", "/out", "/scan/raw"] {
            assert!(!contains(topic), "{topic}");
        }
    }
}
