//! Problems of a route's publishers.

use super::super::snapshot::{PatternReading, RouteReading, Snapshot, type_name};
use super::super::text::{counted, printable};
use super::{Level, Problem};
use crate::model::{DropReason, Guid, PublisherAccount};

/// A problem names at most this many publishers.
const MAX_NAMED_PUBLISHERS: usize = 3;

/// The publishers whose samples were lost within the window, with their counts, the largest first.
pub(super) fn lost_by_publisher(now: &Snapshot, route: &RouteReading, former: &RouteReading) -> String {
    let lost_before = |writer| {
        let before = former.publishers.iter().find(|account| account.writer == writer);
        before.map_or(0, |account| account.lost_upstream)
    };
    let lost = |account: &PublisherAccount| account.lost_upstream.saturating_sub(lost_before(account.writer));
    let mut losses: Vec<_> = route
        .publishers
        .iter()
        .map(|account| (lost(account), account.writer))
        .filter(|of| of.0 > 0)
        .collect();
    losses.sort_by_key(|&(lost, _)| std::cmp::Reverse(lost));
    if losses.is_empty() {
        return String::new();
    }
    let named = losses.iter().take(MAX_NAMED_PUBLISHERS);
    let named = named.map(|(lost, writer)| format!("{lost} from {}", now.endpoint_name("writer", *writer)));
    let and_others = if losses.len() > MAX_NAMED_PUBLISHERS { ", and others" } else { "" };
    format!(": {}{and_others}", named.collect::<Vec<_>>().join(", "))
}

/// A route of which ingress has refused every sample as too large. The problem stays: the only sample of a
/// latched topic may have been refused long ago.
pub(super) fn never_served(route: &RouteReading) -> Option<Problem> {
    let refused = route.counters.drops.get(DropReason::TooLarge);
    (refused > 0 && route.counters.published == 0).then(|| {
        let (id, refused) = (&route.id, counted(refused, "sample"));
        let text = format!(
            "route {id}: nothing is forwarded: each of {refused} so far was {} (too_large), and restart the bridge",
            DropReason::TooLarge.meaning()
        );
        Problem::new(format!("route {id}"), Level::Error, text)
    })
}

/// A publisher whose clock does not agree with this computer's.
pub(super) fn clock_offset(now: &Snapshot, route: &RouteReading) -> Option<Problem> {
    let offset_s = route.counters.clock_offset_s()?;
    let side = if offset_s < 0.0 { "behind" } else { "ahead of" };
    let text = format!(
        "route {}: the clock of {} is {:.1} s {side} this computer's clock, so the bridge measures the age of its \
         samples from their arrival; synchronise the clocks (chrony, PTP)",
        route.id,
        now.endpoint_name("writer", route.counters.clock_writer),
        offset_s.abs()
    );
    Some(Problem::new(format!("route {}", route.id), Level::Warn, text))
}

/// A publisher that announces another type than the others, or another definition of the same type.
pub(super) fn other_type(now: &Snapshot, route: &RouteReading) -> Option<Problem> {
    let info = &route.info;
    if info.other_writer == Guid::default() {
        return None;
    }
    let publisher = now.endpoint_name("writer", info.other_writer);
    let its_type = printable(&type_name(info.other_type.as_str()));
    let (level, text) = match info.announced_type() {
        None => (
            Level::Error,
            format!(
                "publishers of {} announce different types, {publisher} {its_type}, so no sample is taken; set \
                 message_type of the route, or stop a publisher",
                route.input_topic
            ),
        ),
        Some(announced) if announced.name != info.other_type.as_str() => (
            Level::Warn,
            format!(
                "{publisher} publishes {} with the type {its_type}, not {}, so none of its samples is taken; stop \
                 it, or correct message_type of the route and restart the bridge",
                route.input_topic,
                printable(&type_name(announced.name))
            ),
        ),
        Some(announced) if announced.has_keys != info.other_writer.has_keys() => {
            let (its, others) = if announced.has_keys { ("without", "with") } else { ("with", "without") };
            (
                Level::Warn,
                format!(
                    "{publisher} announces {its_type} {its} keys, the publishers and outputs of {} {others}, and \
                     DDS does not match both, so none of its samples is taken; build all nodes with the same \
                     version of that package",
                    route.input_topic
                ),
            )
        }
        Some(announced) => (
            Level::Warn,
            format!(
                "{publisher} publishes {} with another definition of {its_type} ({}) than the outputs announce ({}), \
                 so subscribers may misread its samples; build all nodes with the same version of that package",
                route.input_topic, info.other_hash, announced.hash
            ),
        ),
    };
    Some(Problem::new(format!("route {}", route.id), level, format!("route {}: {text}", route.id)))
}

/// BEST_EFFORT publishers of a topic that also has RELIABLE ones. Where all are BEST_EFFORT, that is the
/// topic's QoS and no problem.
pub(super) fn unrepaired(now: &Snapshot, route: &RouteReading) -> Option<Problem> {
    let offering =
        |offered| route.publishers.iter().filter(move |account| account.offered_reliability == offered);
    offering(PublisherAccount::OFFERS_RELIABLE).next()?;
    let mut best_effort: Vec<_> = offering(PublisherAccount::OFFERS_BEST_EFFORT).collect();
    if best_effort.is_empty() {
        return None;
    }
    let beyond = best_effort.len().saturating_sub(MAX_NAMED_PUBLISHERS);
    best_effort.truncate(MAX_NAMED_PUBLISHERS);
    let names: Vec<_> =
        best_effort.into_iter().map(|account| now.endpoint_name("writer", account.writer)).collect();
    let and_others = if beyond > 0 { format!(" and {beyond} others") } else { String::new() };
    let text = format!(
        "route {}: BEST_EFFORT publishers beside RELIABLE ones of {}: {}{and_others}; samples of theirs that the \
         network loses are not repaired; set their reliability to RELIABLE",
        route.id,
        route.input_topic,
        names.join(", ")
    );
    Some(Problem::new(format!("route {}", route.id), Level::Warn, text))
}

/// A pattern with more topics than places.
pub(super) fn no_place(pattern: &PatternReading) -> Option<Problem> {
    let PatternReading { settings, record } = pattern;
    (record.waiting > 0).then(|| {
        let text = format!(
            "{} match the pattern {} of {} and are not bridged, {} first: all {} have a topic; raise max_routes of \
             the topic, or exclude topics, and restart the bridge",
            counted(record.waiting, "topic"),
            settings.input_topic,
            settings.entry,
            printable(record.first_waiting.as_str()),
            counted(settings.max_routes as u64, "place"),
        );
        Problem::new(format!("pattern {}", settings.entry), Level::Warn, text)
    })
}

/// A route without a matched publisher. The topics of a pattern come and go.
pub(super) fn no_publisher(route: &RouteReading) -> Option<Problem> {
    (route.counters.writers == 0 && route.pattern.is_none()).then(|| {
        let text = match route.counters.received {
            0 => format!(
                "route {}: waits for a publisher of {}; if one runs, check ROS_DOMAIN_ID and the network with \
                 `adaptive-bridge doctor`",
                route.id, route.input_topic
            ),
            _ => format!(
                "route {}: lost the last publisher of {}; check that its node runs and that its link is up",
                route.id, route.input_topic
            ),
        };
        Problem::new(format!("route {}", route.id), Level::Stale, text)
    })
}

#[cfg(test)]
mod tests {
    use super::super::tests::{healthy, problems_after};
    use super::*;
    use crate::model::{FixedText, NamedEndpoint, RouteInfo, TypeHash};

    #[test]
    fn best_effort_publishers_beside_reliable_ones_are_a_problem() {
        let publisher = |id: u8, offered_reliability| PublisherAccount {
            offered_reliability,
            ..PublisherAccount::new(Guid([id; 16]), 1)
        };
        let best_effort = |id| publisher(id, PublisherAccount::OFFERS_BEST_EFFORT);
        let left = publisher(8, PublisherAccount::OFFER_UNKNOWN);
        let problems = problems_after(|now| now.routes[0].publishers = vec![best_effort(1), left]);
        assert_eq!(problems, [""; 0]);
        let reliable = publisher(9, PublisherAccount::OFFERS_RELIABLE);
        let problems = problems_after(|now| {
            now.routes[0].publishers = vec![best_effort(1), reliable, best_effort(2)];
            let (node, host) = (FixedText::new("/imu"), FixedText::new("10.0.0.7"));
            now.named_endpoints.push(NamedEndpoint { endpoint: Guid([1; 16]), node, host });
        });
        let [problem] = problems.as_slice() else { panic!("{problems:?}") };
        let named = format!("RELIABLE ones of /scan: /imu on 10.0.0.7, writer {};", Guid([2; 16]));
        assert!(problem.contains(&named), "{problem}");
    }

    #[test]
    fn a_route_of_which_all_samples_were_too_large_is_a_problem_until_one_is_published() {
        let of = |published| {
            let mut now = healthy();
            let counters = &mut now.routes[0].counters;
            counters.drops.add(DropReason::TooLarge, 3);
            (counters.published, counters.received) = (published, published + 3);
            never_served(&now.routes[0]).map(|problem| problem.text)
        };
        let expected = "route scan: nothing is forwarded: each of 3 samples so far was larger than the route's \
                        max_sample_bytes; raise it (too_large), and restart the bridge";
        assert_eq!(of(0).as_deref(), Some(expected));
        assert_eq!(of(1), None);
    }

    #[test]
    fn a_publisher_that_announces_another_type_is_a_problem() {
        let scan = FixedText::new("sensor_msgs::msg::dds_::LaserScan_");
        let of_writer = |writer: Guid, dds_type, other_type, other_hash| {
            let problems = problems_after(|now| {
                now.routes[0].info = RouteInfo {
                    dds_type,
                    type_hash: TypeHash([1; 32]),
                    other_writer: writer,
                    other_type,
                    other_hash: TypeHash([other_hash; 32]),
                    ..RouteInfo::default()
                };
                let (node, host) = (FixedText::new("/imu"), FixedText::new("10.0.0.7"));
                now.named_endpoints.push(NamedEndpoint { endpoint: writer, node, host });
            });
            let [problem] = problems.as_slice() else { panic!("{problems:?}") };
            problem.clone()
        };
        let problem =
            |dds_type, other_type, other_hash| of_writer(Guid([1; 16]), dds_type, other_type, other_hash);
        let with_keys = of_writer(Guid([2; 16]), scan, scan, 1);
        assert!(
            with_keys.contains("/imu on 10.0.0.7 announces sensor_msgs/msg/LaserScan with keys"),
            "{with_keys}"
        );
        let cloud = FixedText::new("sensor_msgs::msg::dds_::PointCloud2_");
        let disputed = problem(FixedText::default(), cloud, 2);
        assert!(
            disputed.contains("/imu on 10.0.0.7 sensor_msgs/msg/PointCloud2, so no sample"),
            "{disputed}"
        );
        let other_type = problem(scan, cloud, 2);
        assert!(
            other_type
                .contains("/scan with the type sensor_msgs/msg/PointCloud2, not sensor_msgs/msg/LaserScan"),
            "{other_type}"
        );
        let other_definition = problem(scan, scan, 2);
        let (its, announced) = (TypeHash([2; 32]), TypeHash([1; 32]));
        let named = format!(
            "definition of sensor_msgs/msg/LaserScan ({its}) than the outputs announce ({announced})"
        );
        assert!(other_definition.contains(&named), "{other_definition}");
    }
}
