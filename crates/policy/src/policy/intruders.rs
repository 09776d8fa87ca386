//! Detects intruders: readers on other hosts that bypass the bridge.
//!
//! The bridge cannot prevent a laptop from subscribing to an input topic or to a topic of the critical lane.
//! The link of that laptop can then slow down what the bridge protects. The bridge can warn of it.

use alloc::borrow::ToOwned;
use alloc::collections::VecDeque;
use alloc::format;
use alloc::string::String;
use alloc::vec::Vec;
use core::fmt;
use core::net::IpAddr;

use super::locality::{Locality, Location};
use crate::model::{Guid, MonotonicNs, TopicName};

/// How long a warning waits for the name of the reader's node. Reader and node are announced on different
/// topics, in any order and within a second of each other.
pub const NODE_NAME_TIMEOUT_MS: u64 = 2_000;

/// The most readers that are remembered, including those that were reported and have left; further ones are
/// only counted. More than are shown at once ([`MAX_INTRUDERS`](crate::model::MAX_INTRUDERS)).
pub const MAX_REMEMBERED_INTRUDERS: usize = 64;

/// The most topics that are guarded once discovery has reported them, with those of the configuration.
pub const MAX_GUARDED_TOPICS: usize = 4_096;

/// A reader that returns within this time after it left is the same intruder and causes no second warning: a
/// laptop with bad Wi-Fi leaves and returns frequently. In this time at most [`MAX_REMEMBERED_INTRUDERS`] are
/// reported, whatever the network announces.
pub const REMEMBER_MS: u64 = 600_000;

/// Why other hosts should not read a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Guarded {
    /// The topic is the input of a route: a remote reader can slow down the publisher.
    Input,
    /// The topic is an output of the critical lane: a remote reader can slow down the critical subscribers.
    CriticalOutput,
}

/// A topic that other hosts should not read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GuardedTopic {
    /// The topic.
    pub topic: TopicName,
    /// Why other hosts should not read it.
    pub guarded: Guarded,
    /// The route's output on a noncritical lane, which other hosts should read; `None` if it has none.
    pub alternative: Option<TopicName>,
}

/// A remote reader of a guarded topic. Its text form is the warning, with the remedy.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Intruder {
    /// The reader.
    pub reader: Guid,
    /// The topic that it reads, and the one that it should read.
    pub topic: GuardedTopic,
    /// An address of its host; `None` if no address identifies the host.
    pub host: Option<IpAddr>,
    /// Its node, such as `/rviz`; `None` if its participant announced none, as one that is not of ROS 2.
    pub node: Option<String>,
    /// When it was first seen.
    pub since: MonotonicNs,
}

impl Intruder {
    /// The remedy, as an imperative.
    pub fn remedy(&self) -> String {
        match (self.topic.guarded, &self.topic.alternative) {
            (Guarded::Input, Some(alternative)) => format!("point it at {alternative}"),
            (Guarded::Input, None) => "give the route a noncritical lane and point it at that".to_owned(),
            (Guarded::CriticalOutput, Some(alternative)) => {
                format!("point it at {alternative}, or give it a lane of its own")
            }
            (Guarded::CriticalOutput, None) => "give it a lane of its own".to_owned(),
        }
    }
}

impl fmt::Display for Intruder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.node {
            Some(node) => write!(f, "node {node} on ")?,
            None => write!(f, "a reader without a known node on ")?,
        }
        match self.host {
            Some(host) => write!(f, "host {host}")?,
            None => write!(f, "another host")?,
        }
        let topic = &self.topic.topic;
        match self.topic.guarded {
            Guarded::Input => write!(
                f,
                " subscribes to {topic} directly, bypasses the bridge, and can slow down the publisher"
            )?,
            Guarded::CriticalOutput => {
                write!(f, " subscribes to {topic}, and can slow down the critical subscribers")?;
            }
        }
        write!(f, ": {}", self.remedy())
    }
}

/// A change to log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum IntruderEvent {
    /// A new intruder, to warn of.
    Appeared(Intruder),
    /// An intruder reported as [`Appeared`](Self::Appeared) left.
    Left(Intruder),
    /// An intruder that left has returned, without a second warning.
    Returned(Intruder),
}

/// Watches for remote readers of guarded topics, and returns each event once. Memory is bounded by
/// [`MAX_REMEMBERED_INTRUDERS`].
#[derive(Clone, Debug)]
pub struct IntruderWatch {
    guarded: Vec<GuardedTopic>,
    /// The DDS names, parallel to `guarded`.
    dds_names: Vec<String>,
    tracked: Vec<Tracked>,
    events: VecDeque<IntruderEvent>,
    /// Intruders reported so far.
    pub reported: u64,
    /// Discoveries of further readers while [`MAX_REMEMBERED_INTRUDERS`] were remembered; a reader that is
    /// announced again counts again.
    pub unreported: u64,
}

#[derive(Clone, Debug)]
struct Tracked {
    intruder: Intruder,
    state: State,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// Discovered, and not reported yet: the name of its node may still arrive.
    Waiting { found_at: MonotonicNs },
    /// Reported, and present.
    Present,
    /// Reported, and gone.
    Gone { at: MonotonicNs },
}

impl IntruderWatch {
    /// A watch for readers of these topics.
    pub fn new(guarded: Vec<GuardedTopic>) -> Self {
        Self {
            dds_names: guarded.iter().map(|guarded| guarded.topic.to_dds()).collect(),
            guarded,
            tracked: Vec::new(),
            events: VecDeque::new(),
            reported: 0,
            unreported: 0,
        }
    }

    /// Guards a topic also, unless [`MAX_GUARDED_TOPICS`] others are guarded: for a topic that discovery has
    /// reported, and that was not known before.
    pub fn guard(&mut self, topic: GuardedTopic) {
        let dds_name = topic.topic.to_dds();
        if self.guarded.len() < MAX_GUARDED_TOPICS && !self.dds_names.contains(&dds_name) {
            self.dds_names.push(dds_name);
            self.guarded.push(topic);
        }
    }

    /// Records a reader, new or changed, that discovery found on any DDS topic. `own` are the addresses of
    /// this host. A reader on this host or on an unknown one is no intruder.
    pub fn endpoint_discovered(
        &mut self,
        reader: Guid,
        dds_topic: &str,
        location: &Location,
        own: &[IpAddr],
        now: MonotonicNs,
    ) {
        let Some(at) = self.dds_names.iter().position(|name| name == dds_topic) else { return };
        if location.locality(own) != Locality::Remote {
            // It may have counted as remote before this host had all its addresses.
            self.gone_where(|guid| guid == reader, now);
            return;
        }
        self.remove_expired(now);
        if let Some(known) = self.tracked.iter_mut().find(|tracked| tracked.intruder.reader == reader) {
            known.intruder.host = location.host();
            if matches!(known.state, State::Gone { .. }) {
                known.state = State::Present;
                push(&mut self.events, IntruderEvent::Returned(known.intruder.clone()));
            }
        } else if self.tracked.len() < MAX_REMEMBERED_INTRUDERS {
            let topic = self.guarded[at].clone();
            let intruder = Intruder { reader, topic, host: location.host(), node: None, since: now };
            self.tracked.push(Tracked { intruder, state: State::Waiting { found_at: now } });
        } else {
            self.unreported += 1;
        }
    }

    /// Records that a reader is gone.
    pub fn endpoint_lost(&mut self, reader: Guid, now: MonotonicNs) {
        self.gone_where(|guid| guid == reader, now);
    }

    /// Records that a participant is gone, with all its readers.
    pub fn participant_lost(&mut self, prefix: [u8; 12], now: MonotonicNs) {
        self.gone_where(|guid| guid.prefix() == prefix, now);
    }

    /// The next event, if there is one. `node_of` returns the node of a reader if it is known.
    ///
    /// A new reader is reported as soon as its node is known, or without it after [`NODE_NAME_TIMEOUT_MS`]; a
    /// name that arrives later is added without an event.
    pub fn poll<'graph>(
        &mut self,
        now: MonotonicNs,
        node_of: impl Fn(Guid) -> Option<&'graph str>,
    ) -> Option<IntruderEvent> {
        if let Some(event) = self.events.pop_front() {
            return Some(event);
        }
        for tracked in &mut self.tracked {
            if tracked.intruder.node.is_none() {
                tracked.intruder.node = node_of(tracked.intruder.reader).map(str::to_owned);
            }
            let State::Waiting { found_at } = tracked.state else { continue };
            if tracked.intruder.node.is_some() || now >= found_at.plus_ms(NODE_NAME_TIMEOUT_MS) {
                tracked.state = State::Present;
                self.reported += 1;
                return Some(IntruderEvent::Appeared(tracked.intruder.clone()));
            }
        }
        None
    }

    /// The intruders that were reported and are present, in the order of their discovery.
    pub fn present(&self) -> impl Iterator<Item = &Intruder> {
        let present = self.tracked.iter().filter(|tracked| tracked.state == State::Present);
        present.map(|tracked| &tracked.intruder)
    }

    fn gone_where(&mut self, is_gone: impl Fn(Guid) -> bool, now: MonotonicNs) {
        let events = &mut self.events;
        self.tracked.retain_mut(|tracked| {
            if !is_gone(tracked.intruder.reader) {
                return true;
            }
            match tracked.state {
                // It was not reported, so that it leaves without an event.
                State::Waiting { .. } => false,
                State::Present => {
                    tracked.state = State::Gone { at: now };
                    push(events, IntruderEvent::Left(tracked.intruder.clone()));
                    true
                }
                State::Gone { .. } => true,
            }
        });
    }

    fn remove_expired(&mut self, now: MonotonicNs) {
        self.tracked
            .retain(|tracked| !matches!(tracked.state, State::Gone { at } if now >= at.plus_ms(REMEMBER_MS)));
    }
}

/// Adds an event about a reader that was reported. It cancels a pending event about the same reader, so that
/// there are never more events than readers.
fn push(events: &mut VecDeque<IntruderEvent>, event: IntruderEvent) {
    let reader_of = |event: &IntruderEvent| match event {
        IntruderEvent::Appeared(intruder)
        | IntruderEvent::Left(intruder)
        | IntruderEvent::Returned(intruder) => intruder.reader,
    };
    let before = events.len();
    events.retain(|waiting| reader_of(waiting) != reader_of(&event));
    // If it cancelled one, the reader's state is again the one last returned to the caller.
    if events.len() == before {
        events.push_back(event);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const START: MonotonicNs = MonotonicNs(5_000_000_000);

    fn topic(name: &str) -> TopicName {
        TopicName::try_from(name).unwrap()
    }

    fn watch() -> IntruderWatch {
        IntruderWatch::new(vec![
            GuardedTopic {
                topic: topic("/scan"),
                guarded: Guarded::Input,
                alternative: Some(topic("/adaptive_bridge/noncritical/scan")),
            },
            GuardedTopic {
                topic: topic("/adaptive_bridge/critical/scan"),
                guarded: Guarded::CriticalOutput,
                alternative: Some(topic("/adaptive_bridge/noncritical/scan")),
            },
        ])
    }

    /// Reader `reader` of participant `participant`.
    fn guid(participant: u8, reader: u8) -> Guid {
        let mut guid = [participant; 16];
        guid[12..].fill(reader);
        Guid(guid)
    }

    fn at(text: &str) -> Location {
        Location { seen_from: text.parse().ok(), announced: Vec::new() }
    }

    fn own() -> Vec<IpAddr> {
        vec!["127.0.0.1".parse().unwrap(), "10.0.0.5".parse().unwrap()]
    }

    fn find(watch: &mut IntruderWatch, reader: Guid, now: MonotonicNs) {
        watch.endpoint_discovered(reader, "rt/scan", &at("10.0.0.9"), &own(), now);
    }

    fn nameless(_: Guid) -> Option<&'static str> {
        None
    }

    /// The intruders that are present, reported and not reported.
    fn counts(watch: &IntruderWatch) -> (usize, u64, u64) {
        (watch.present().count(), watch.reported, watch.unreported)
    }

    /// All pending events as text; `node` is the node of every reader.
    fn events(watch: &mut IntruderWatch, now: MonotonicNs, node: Option<&str>) -> Vec<String> {
        let mut texts = Vec::new();
        while let Some(event) = watch.poll(now, |_| node) {
            texts.push(match event {
                IntruderEvent::Appeared(intruder) => format!("appeared: {intruder}"),
                IntruderEvent::Left(intruder) => format!("left: {:?}", intruder.reader.0[12]),
                IntruderEvent::Returned(intruder) => format!("returned: {:?}", intruder.reader.0[12]),
            });
        }
        texts
    }

    #[test]
    fn an_intruder_is_reported_once_with_host_node_and_remedy() {
        let mut watch = watch();
        find(&mut watch, guid(1, 1), START);
        watch.endpoint_discovered(
            guid(1, 2),
            "rt/adaptive_bridge/critical/scan",
            &at("10.0.0.9"),
            &own(),
            START,
        );
        let expected = [
            "appeared: node /rviz on host 10.0.0.9 subscribes to /scan directly, bypasses the bridge, and can slow \
             down the publisher: point it at /adaptive_bridge/noncritical/scan",
            "appeared: node /rviz on host 10.0.0.9 subscribes to /adaptive_bridge/critical/scan, and can slow down \
             the critical subscribers: point it at /adaptive_bridge/noncritical/scan, or give it a lane of its own",
        ];
        assert_eq!(events(&mut watch, START, Some("/rviz")), expected);
        // Discovery reports the same reader repeatedly.
        find(&mut watch, guid(1, 1), START.plus_ms(10));
        assert_eq!(events(&mut watch, START.plus_ms(10), Some("/rviz")), [""; 0]);
        assert_eq!(counts(&watch), (2, 2, 0));
    }

    #[test]
    fn readers_on_this_host_on_an_unknown_host_and_of_other_topics_are_no_intruders() {
        let mut watch = watch();
        watch.endpoint_discovered(guid(1, 1), "rt/scan", &at("10.0.0.5"), &own(), START);
        watch.endpoint_discovered(guid(1, 2), "rt/scan", &at("127.0.0.1"), &own(), START);
        watch.endpoint_discovered(guid(1, 3), "rt/scan", &Location::default(), &own(), START);
        watch.endpoint_discovered(
            guid(1, 4),
            "rt/adaptive_bridge/noncritical/scan",
            &at("10.0.0.9"),
            &own(),
            START,
        );
        assert_eq!(events(&mut watch, START.plus_ms(60_000), None), [""; 0]);
        assert_eq!(counts(&watch), (0, 0, 0));
    }

    #[test]
    fn a_warning_waits_a_limited_time_for_the_name_of_the_node() {
        let mut watch = watch();
        find(&mut watch, guid(1, 1), START);
        assert_eq!(watch.poll(START.plus_ms(NODE_NAME_TIMEOUT_MS - 1), nameless), None);
        let named = events(&mut watch, START.plus_ms(NODE_NAME_TIMEOUT_MS - 1), Some("/late"));
        assert!(named[0].contains("node /late on host 10.0.0.9"), "{named:?}");

        find(&mut watch, guid(2, 2), START);
        let nameless = events(&mut watch, START.plus_ms(NODE_NAME_TIMEOUT_MS), None);
        assert!(nameless[0].contains("a reader without a known node on host 10.0.0.9"), "{nameless:?}");
        assert_eq!(events(&mut watch, START.plus_ms(NODE_NAME_TIMEOUT_MS + 1), Some("/later")), [""; 0]);
        let nodes: Vec<_> = watch.present().map(|intruder| intruder.node.as_deref()).collect();
        assert_eq!(nodes, [Some("/late"), Some("/later")]);
    }

    #[test]
    fn an_intruder_that_leaves_and_returns_causes_no_second_warning() {
        let mut watch = watch();
        find(&mut watch, guid(1, 1), START);
        find(&mut watch, guid(1, 2), START);
        assert_eq!(events(&mut watch, START, Some("/rviz")).len(), 2);
        watch.endpoint_lost(guid(1, 1), START);
        watch.endpoint_lost(guid(1, 1), START);
        assert_eq!(events(&mut watch, START, None), ["left: 1"]);
        watch.participant_lost(guid(1, 0).prefix(), START);
        assert_eq!(events(&mut watch, START, None), ["left: 2"]);
        assert_eq!(watch.present().count(), 0);
        find(&mut watch, guid(1, 2), START.plus_ms(REMEMBER_MS - 1));
        assert_eq!(events(&mut watch, START.plus_ms(REMEMBER_MS - 1), None), ["returned: 2"]);
        find(&mut watch, guid(1, 1), START.plus_ms(REMEMBER_MS));
        assert_eq!(
            events(&mut watch, START.plus_ms(REMEMBER_MS), Some("/rviz")).len(),
            1,
            "no longer remembered"
        );
        assert_eq!(counts(&watch), (2, 3, 0));
    }

    #[test]
    fn a_reader_that_is_gone_before_it_is_reported_causes_no_event() {
        let mut watch = watch();
        find(&mut watch, guid(1, 1), START);
        watch.endpoint_lost(guid(1, 1), START.plus_ms(1_000));
        assert_eq!(events(&mut watch, START.plus_ms(NODE_NAME_TIMEOUT_MS), Some("/brief")), [""; 0]);
    }

    #[test]
    fn a_reader_that_leaves_and_returns_between_two_polls_causes_no_event() {
        let mut watch = watch();
        find(&mut watch, guid(1, 1), START);
        assert_eq!(events(&mut watch, START, Some("/rviz")).len(), 1);
        for _ in 0..1_000 {
            watch.endpoint_lost(guid(1, 1), START);
            find(&mut watch, guid(1, 1), START);
        }
        assert!(watch.events.len() <= 1);
        assert_eq!(events(&mut watch, START, None), [""; 0]);
        watch.endpoint_lost(guid(1, 1), START);
        assert_eq!(events(&mut watch, START, None), ["left: 1"]);
    }

    #[test]
    fn an_intruder_that_proves_to_be_local_has_left() {
        let mut watch = watch();
        find(&mut watch, guid(1, 1), START);
        assert_eq!(events(&mut watch, START, Some("/rviz")).len(), 1);
        // The host has joined the network since.
        let own = [own(), vec!["10.0.0.9".parse().unwrap()]].concat();
        watch.endpoint_discovered(guid(1, 1), "rt/scan", &at("10.0.0.9"), &own, START);
        assert_eq!(events(&mut watch, START, None), ["left: 1"]);
    }

    #[test]
    fn a_flood_of_readers_costs_bounded_memory_and_a_bounded_log() {
        let mut watch = watch();
        let mut count = 0;
        for number in 0..100_000_u32 {
            let mut reader = [0; 16];
            reader[..4].copy_from_slice(&number.to_le_bytes());
            // One reader per ms, each gone after 100 ms, reported or not.
            let now = START.plus_ms(u64::from(number));
            find(&mut watch, Guid(reader), now);
            count += events(&mut watch, now, Some("/flood")).len();
            if let Some(old) = number.checked_sub(100) {
                reader[..4].copy_from_slice(&old.to_le_bytes());
                watch.endpoint_lost(Guid(reader), now);
            }
            count += events(&mut watch, now, None).len();
            assert!(
                watch.tracked.len() <= MAX_REMEMBERED_INTRUDERS
                    && watch.events.len() <= MAX_REMEMBERED_INTRUDERS
            );
        }
        // Each of those reported appeared and left.
        assert_eq!(count, 2 * MAX_REMEMBERED_INTRUDERS);
        assert_eq!(watch.reported + watch.unreported, 100_000);
    }
}
