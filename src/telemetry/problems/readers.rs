//! Problems of subscribers that get nothing from an output.

use super::super::problem::{Level, Problem};
use super::super::snapshot::{OutputReading, RouteReading, Snapshot};
use crate::model::{TrafficClass, UnmatchedPolicy};

/// The readers of an output's topic that request a stricter QoS than the lane offers.
pub(super) fn unmatched(
    route: &RouteReading,
    output: &OutputReading,
    now: &Snapshot,
) -> impl Iterator<Item = Problem> {
    let lane = &now.lanes[output.lane];
    let level = match lane.class {
        TrafficClass::Critical => Level::Error,
        TrafficClass::Noncritical => Level::Warn,
    };
    let (lane, topic, route) = (lane.name.to_string(), &output.topic, &route.id);
    output.readers.unmatched().map(move |(reader, policy)| {
        let text = format!(
            "lane {lane}, {topic}: {} gets nothing: {}",
            now.endpoint_name("reader", reader),
            cause(policy, &format!("qos_overrides.{lane} of topic {route}"))
        );
        Problem::new(format!("lane {lane}"), level, text)
    })
}

/// Why a reader does not match, and what to do; `overrides` names the section of the configuration.
fn cause(policy: UnmatchedPolicy, overrides: &str) -> String {
    let (request, remedy) = match policy {
        UnmatchedPolicy::Reliability => (
            "it requests RELIABLE and the configuration makes the lane BEST_EFFORT",
            format!("remove reliability: BEST_EFFORT from the lane's qos or from {overrides}"),
        ),
        UnmatchedPolicy::Durability => (
            "it requests TRANSIENT_LOCAL and the lane offers VOLATILE",
            format!("set durability: TRANSIENT_LOCAL in {overrides}"),
        ),
        UnmatchedPolicy::Deadline => {
            ("it requests a shorter DEADLINE than the lane offers", format!("set deadline_ms in {overrides}"))
        }
        other => {
            return format!("it requests another {other} than the lane offers; change the subscriber's QoS");
        }
    };
    format!("{request} ({policy}); {remedy}, or change the subscriber's QoS")
}

#[cfg(test)]
mod tests {
    use super::super::tests::problems_after;
    use super::*;
    use crate::model::{FixedText, Guid, NamedEndpoint, UnmatchedReader};

    #[test]
    fn a_subscriber_that_gets_nothing_is_named_with_the_policy_and_the_remedy() {
        let reader = Guid([1; 16]);
        let problems = problems_after(|now| {
            let (node, host) = (FixedText::new("/rviz"), FixedText::new("10.0.0.3"));
            now.named_endpoints.push(NamedEndpoint { endpoint: reader, node, host });
            let policy = UnmatchedPolicy::Reliability as u64;
            now.routes[0].outputs[1].readers.unmatched[0] = UnmatchedReader { reader, policy };
            let policy = UnmatchedPolicy::Ownership as u64;
            now.routes[0].outputs[0].readers.unmatched[0] = UnmatchedReader { reader, policy };
        });
        let expected = [
            "lane critical, /c/scan: /rviz on 10.0.0.3 gets nothing: it requests another OWNERSHIP than the lane \
             offers; change the subscriber's QoS",
            "lane noncritical, /n/scan: /rviz on 10.0.0.3 gets nothing: it requests RELIABLE and the configuration \
             makes the lane BEST_EFFORT (RELIABILITY); remove reliability: BEST_EFFORT from the lane's qos or from \
             qos_overrides.noncritical of topic scan, or change the subscriber's QoS",
        ];
        assert_eq!(problems, expected);
    }
}
