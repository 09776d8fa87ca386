//! Problems of subscribers that get nothing from an output, or not its history.

use super::super::problem::{Level, Problem};
use super::super::snapshot::{OutputReading, RouteReading, Snapshot};
use super::super::text::counted;
use super::{about_lane, window_text};
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

/// Late joiners within the window for which the output had no place to wait for its history.
pub(super) fn without_history(
    route: &RouteReading,
    output: &OutputReading,
    now: &Snapshot,
    before: &Snapshot,
) -> Option<Problem> {
    let lane = &now.lanes[output.lane];
    let earlier = before.route(route)?.output(output)?.counters.late_joiners_unserved;
    let unserved = output.counters.late_joiners_unserved.checked_sub(earlier)?;
    (unserved > 0).then(|| {
        let text = format!(
            "lane {}, {}: {} in the last {} without the history, because too many others waited for it \
             (late_joiners_unserved): new samples reach them; restart those that need the history",
            lane.name,
            output.topic,
            counted(unserved, "late joiner"),
            window_text(now, before)
        );
        Problem::new(about_lane(lane), Level::Warn, text)
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
    use super::super::tests::{healthy, problems_after};
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

    #[test]
    fn late_joiners_without_the_history_are_a_problem_while_their_number_rises() {
        let problems = problems_after(|now| now.routes[0].outputs[0].counters.late_joiners_unserved = 3);
        let expected = "lane critical, /c/scan: 3 late joiners in the last 1.0 s without the history, because too \
                        many others waited for it (late_joiners_unserved): new samples reach them; restart those \
                        that need the history";
        assert_eq!(problems, [expected]);
        let mut unchanged = healthy();
        unchanged.routes[0].outputs[0].counters.late_joiners_unserved = 3;
        assert_eq!(super::super::of(&unchanged, &unchanged), []);
    }
}
