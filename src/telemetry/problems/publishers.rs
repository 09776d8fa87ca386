//! What is wrong with the publishers of a route, in words.

use super::super::report::clock_offset_s;
use super::super::snapshot::{RouteReading, Snapshot};
use super::{Level, Problem};
use crate::model::PublisherAccount;

/// A sentence names so many publishers at most.
const MAX_NAMED_PUBLISHERS: usize = 3;

/// The publishers whose samples were lost, those with most losses first.
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
    let named = named.map(|(lost, writer)| format!("{lost} of {}", now.publisher_name(*writer)));
    let and_others = if losses.len() > MAX_NAMED_PUBLISHERS { ", and others" } else { "" };
    format!(": {}{and_others}", named.collect::<Vec<_>>().join(", "))
}

pub(super) fn clock_offset(now: &Snapshot, route: &RouteReading) -> Option<Problem> {
    let offset_s = clock_offset_s(&route.counters)?;
    let side = if offset_s < 0.0 { "behind" } else { "ahead of" };
    let text = format!(
        "route {}: the clock of {} is {:.1} s {side} this computer's, so that the age of its samples runs \
         from their arrival; synchronise the clocks (chrony, PTP)",
        route.id,
        now.publisher_name(route.counters.clock_writer),
        offset_s.abs()
    );
    Some(Problem::new(format!("route {}", route.id), Level::Warn, text))
}

/// BEST_EFFORT publishers beside RELIABLE ones. Where all are BEST_EFFORT, that is the topic's QoS.
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
    let names: Vec<_> = best_effort.into_iter().map(|account| now.publisher_name(account.writer)).collect();
    let and_others = if beyond > 0 { format!(" and {beyond} others") } else { String::new() };
    let text = format!(
        "route {}: {}{and_others} publish {} BEST_EFFORT beside RELIABLE publishers: samples of theirs that the \
         network loses can't be repaired; let them offer RELIABLE",
        route.id,
        names.join(", "),
        route.input_topic
    );
    Some(Problem::new(format!("route {}", route.id), Level::Warn, text))
}

pub(super) fn no_publisher(route: &RouteReading) -> Option<Problem> {
    (route.counters.writers == 0).then(|| {
        let text = match route.counters.received {
            0 => format!("route {}: waits for a publisher of {}", route.id, route.input_topic),
            _ => format!("route {}: the publisher of {} is gone", route.id, route.input_topic),
        };
        Problem::new(format!("route {}", route.id), Level::Stale, text)
    })
}

#[cfg(test)]
mod tests {
    use super::super::tests::after;
    use super::*;
    use crate::model::{FixedText, Guid, NamedEndpoint};

    #[test]
    fn best_effort_publishers_beside_reliable_ones_are_named() {
        let publisher = |id: u8, offered_reliability| PublisherAccount {
            offered_reliability,
            ..PublisherAccount::new(Guid([id; 16]), 1)
        };
        let best_effort = |id| publisher(id, PublisherAccount::OFFERS_BEST_EFFORT);
        let gone = publisher(8, PublisherAccount::OFFER_UNKNOWN);
        let problems = after(|now| now.routes[0].publishers = vec![best_effort(1), gone]);
        assert_eq!(problems, [""; 0]);
        let reliable = publisher(9, PublisherAccount::OFFERS_RELIABLE);
        let problems = after(|now| {
            now.routes[0].publishers = vec![best_effort(1), reliable, best_effort(2)];
            let (node, host) = (FixedText::new("/imu"), FixedText::new("10.0.0.7"));
            now.named_endpoints.push(NamedEndpoint { endpoint: Guid([1; 16]), node, host });
        });
        let [problem] = problems.as_slice() else { panic!("{problems:?}") };
        let second = format!("the writer {}", Guid([2; 16]));
        assert!(problem.starts_with(&format!("route scan: /imu on 10.0.0.7, {second} publish")), "{problem}");
    }
}
