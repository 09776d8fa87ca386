//! Readers on other hosts that reach past the bridge.
//!
//! The bridge can't keep a laptop from subscribing to the publisher's own topic, or to a topic of the
//! critical lane; that laptop's link then holds back what the bridge is there to protect. It can say so.

// Addresses only: `core::net` has no sockets.
use core::net::IpAddr;
use std::collections::VecDeque;
use std::fmt;

use super::whereabouts::{Location, Whereabouts};
use crate::model::{Guid, MonotonicNs, TopicName};

/// How long the name of a reader's node is waited for. Reader and node are announced by different topics, in
/// either order and within a second of each other.
pub const NODE_PATIENCE_MS: u64 = 2_000;

/// Readers that are remembered, those that were told and have left included. More are only counted. That
/// is more than are shown at once ([`MAX_INTRUDERS`](crate::model::MAX_INTRUDERS)), as some have left.
pub const MAX_REMEMBERED_INTRUDERS: usize = 64;

/// A reader that comes back within this time after it was gone is the same intruder, which was told already:
/// a laptop on bad Wi-Fi goes and comes all the time. Thus no more than
/// [`MAX_REMEMBERED_INTRUDERS`] are told in it, whatever the network makes up.
pub const REMEMBER_MS: u64 = 600_000;

/// Why no other host should read a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Guarded {
    /// It is the input of a route: a remote reader holds back the publisher itself.
    Input,
    /// It is an output of the critical lane: a remote reader holds back the critical subscribers.
    CriticalOutput,
}

/// A topic that no other host should read.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GuardedTopic {
    /// The topic.
    pub topic: TopicName,
    /// Why.
    pub guarded: Guarded,
    /// The route's output on a noncritical lane, which is for other hosts; `None` if it has none.
    pub instead: Option<TopicName>,
}

/// A remote reader of a guarded topic. As text, it is the warning, with what to do about it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Intruder {
    /// The reader.
    pub reader: Guid,
    /// What it reads, and what it should.
    pub topic: GuardedTopic,
    /// An address of its host; `None` if none tells hosts apart.
    pub host: Option<IpAddr>,
    /// Its node, such as `/rviz`; `None` if its participant never said, as one that is no ROS 2 node.
    pub node: Option<String>,
    /// When it was first seen.
    pub since: MonotonicNs,
}

impl Intruder {
    /// What to do about it, as an imperative.
    pub fn mending_step(&self) -> String {
        match (self.topic.guarded, &self.topic.instead) {
            (Guarded::Input, Some(instead)) => format!("point it at {instead}"),
            (Guarded::Input, None) => "give the route a noncritical lane and point it at that".to_owned(),
            (Guarded::CriticalOutput, Some(instead)) => {
                format!("point it at {instead}, or give it a lane of its own")
            }
            (Guarded::CriticalOutput, None) => "give it a lane of its own".to_owned(),
        }
    }
}

impl fmt::Display for Intruder {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.node {
            Some(node) => write!(f, "node {node} on ")?,
            None => write!(f, "a reader of no known node on ")?,
        }
        match self.host {
            Some(host) => write!(f, "host {host}")?,
            None => write!(f, "another host")?,
        }
        let topic = &self.topic.topic;
        match self.topic.guarded {
            Guarded::Input => {
                write!(f, " subscribes to {topic} itself, past the bridge, and can hold back its publisher")?
            }
            Guarded::CriticalOutput => {
                write!(f, " subscribes to {topic}, and can hold back the critical subscribers")?;
            }
        }
        write!(f, ": {}", self.mending_step())
    }
}

/// What there is to say.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum IntruderEvent {
    /// A new one: warn.
    Appeared(Intruder),
    /// One of which [`Appeared`](Self::Appeared) was said is gone.
    Left(Intruder),
    /// One that left is back, and needs no second warning.
    Returned(Intruder),
}

/// How many intruders there are.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct IntruderCounts {
    /// There now, of those that were told.
    pub present: u64,
    /// Told since the beginning.
    pub told: u64,
    /// Sightings of others while [`MAX_REMEMBERED_INTRUDERS`] were remembered; one that announces itself
    /// again counts again.
    pub untold: u64,
}

/// Watches for remote readers of guarded topics. Memory is bounded by [`MAX_REMEMBERED_INTRUDERS`], and
/// an event is given once.
#[derive(Clone, Debug)]
pub struct IntruderWatch {
    guarded: Vec<GuardedTopic>,
    /// By DDS name, beside `guarded`.
    dds_names: Vec<String>,
    tracked: Vec<Tracked>,
    events: VecDeque<IntruderEvent>,
    told: u64,
    untold: u64,
}

#[derive(Clone, Debug)]
struct Tracked {
    intruder: Intruder,
    state: State,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum State {
    /// Found, and not told yet: the name of its node may come.
    Waiting { found_at: MonotonicNs },
    /// Told, and there.
    Present,
    /// Told, and gone.
    Gone { at: MonotonicNs },
}

impl IntruderWatch {
    /// For these topics.
    pub fn new(guarded: Vec<GuardedTopic>) -> Self {
        Self {
            dds_names: guarded.iter().map(|guarded| guarded.topic.to_dds()).collect(),
            guarded,
            tracked: Vec::new(),
            events: VecDeque::new(),
            told: 0,
            untold: 0,
        }
    }

    /// Whether readers of this DDS topic are of interest.
    pub fn guards(&self, dds_topic: &str) -> bool {
        self.dds_names.iter().any(|name| name == dds_topic)
    }

    /// Discovery sees a reader, new or changed, of any DDS topic. `own` are the addresses of this host; a
    /// reader on this host, or of which nobody knows where it is, is no intruder.
    pub fn found(
        &mut self,
        reader: Guid,
        dds_topic: &str,
        location: &Location,
        own: &[IpAddr],
        now: MonotonicNs,
    ) {
        let Some(at) = self.dds_names.iter().position(|name| name == dds_topic) else { return };
        if location.whereabouts(own) != Whereabouts::Remote {
            // It was taken for a remote one if the host had not all its addresses yet.
            self.gone_where(|guid| guid == reader, now);
            return;
        }
        self.forget(now);
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
            self.untold += 1;
        }
    }

    /// A reader is gone.
    pub fn gone(&mut self, reader: Guid, now: MonotonicNs) {
        self.gone_where(|guid| guid == reader, now);
    }

    /// A participant is gone, and with it all its readers.
    pub fn participant_gone(&mut self, prefix: [u8; 12], now: MonotonicNs) {
        self.gone_where(|guid| guid.prefix() == prefix, now);
    }

    /// The next event, if there is one. `node_of` names the node of a reader if that is known.
    ///
    /// A new reader is told as soon as its node is known, or after [`NODE_PATIENCE_MS`] without; a name that
    /// comes later still is filled in without an event.
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
            if tracked.intruder.node.is_some() || now >= found_at.plus_ms(NODE_PATIENCE_MS) {
                tracked.state = State::Present;
                self.told += 1;
                return Some(IntruderEvent::Appeared(tracked.intruder.clone()));
            }
        }
        None
    }

    /// Those that were told and are there, in the order in which they were found.
    pub fn present(&self) -> impl Iterator<Item = &Intruder> {
        let present = self.tracked.iter().filter(|tracked| tracked.state == State::Present);
        present.map(|tracked| &tracked.intruder)
    }

    /// How many there are.
    pub fn counts(&self) -> IntruderCounts {
        IntruderCounts { present: self.present().count() as u64, told: self.told, untold: self.untold }
    }

    fn gone_where(&mut self, is_it: impl Fn(Guid) -> bool, now: MonotonicNs) {
        let events = &mut self.events;
        self.tracked.retain_mut(|tracked| {
            if !is_it(tracked.intruder.reader) {
                return true;
            }
            match tracked.state {
                // Nobody was told, so nothing is to be taken back.
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

    fn forget(&mut self, now: MonotonicNs) {
        self.tracked
            .retain(|tracked| !matches!(tracked.state, State::Gone { at } if now >= at.plus_ms(REMEMBER_MS)));
    }
}

/// Adds an event of a reader that was told. It takes the place of one about the same reader that nobody has
/// asked for yet, so that there are no more events than readers.
fn push(events: &mut VecDeque<IntruderEvent>, event: IntruderEvent) {
    let reader_of = |event: &IntruderEvent| match event {
        IntruderEvent::Appeared(intruder)
        | IntruderEvent::Left(intruder)
        | IntruderEvent::Returned(intruder) => intruder.reader,
    };
    let before = events.len();
    events.retain(|waiting| reader_of(waiting) != reader_of(&event));
    // What it takes back nobody has heard of.
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
                instead: Some(topic("/adaptive_bridge/noncritical/scan")),
            },
            GuardedTopic {
                topic: topic("/adaptive_bridge/critical/scan"),
                guarded: Guarded::CriticalOutput,
                instead: Some(topic("/adaptive_bridge/noncritical/scan")),
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
        watch.found(reader, "rt/scan", &at("10.0.0.9"), &own(), now);
    }

    fn nameless(_: Guid) -> Option<&'static str> {
        None
    }

    /// All that there is to say, with the node for every reader.
    fn told(watch: &mut IntruderWatch, now: MonotonicNs, node: Option<&str>) -> Vec<String> {
        let mut said = Vec::new();
        while let Some(event) = watch.poll(now, |_| node) {
            said.push(match event {
                IntruderEvent::Appeared(intruder) => format!("appeared: {intruder}"),
                IntruderEvent::Left(intruder) => format!("left: {:?}", intruder.reader.0[12]),
                IntruderEvent::Returned(intruder) => format!("returned: {:?}", intruder.reader.0[12]),
            });
        }
        said
    }

    #[test]
    fn an_intruder_is_told_once_with_host_node_and_the_mending_step() {
        let mut watch = watch();
        find(&mut watch, guid(1, 1), START);
        watch.found(guid(1, 2), "rt/adaptive_bridge/critical/scan", &at("10.0.0.9"), &own(), START);
        let expected = [
            "appeared: node /rviz on host 10.0.0.9 subscribes to /scan itself, past the bridge, and can hold back \
             its publisher: point it at /adaptive_bridge/noncritical/scan",
            "appeared: node /rviz on host 10.0.0.9 subscribes to /adaptive_bridge/critical/scan, and can hold back \
             the critical subscribers: point it at /adaptive_bridge/noncritical/scan, or give it a lane of its own",
        ];
        assert_eq!(told(&mut watch, START, Some("/rviz")), expected);
        // Discovery repeats itself.
        find(&mut watch, guid(1, 1), START.plus_ms(10));
        assert_eq!(told(&mut watch, START.plus_ms(10), Some("/rviz")), [""; 0]);
        assert_eq!(watch.counts(), IntruderCounts { present: 2, told: 2, untold: 0 });
    }

    #[test]
    fn readers_of_this_host_of_unknown_place_and_of_other_topics_are_none() {
        let mut watch = watch();
        assert!(watch.guards("rt/scan") && !watch.guards("rt/adaptive_bridge/noncritical/scan"));
        watch.found(guid(1, 1), "rt/scan", &at("10.0.0.5"), &own(), START);
        watch.found(guid(1, 2), "rt/scan", &at("127.0.0.1"), &own(), START);
        watch.found(guid(1, 3), "rt/scan", &Location::default(), &own(), START);
        watch.found(guid(1, 4), "rt/adaptive_bridge/noncritical/scan", &at("10.0.0.9"), &own(), START);
        assert_eq!(told(&mut watch, START.plus_ms(60_000), None), [""; 0]);
        assert_eq!(watch.counts(), IntruderCounts::default());
    }

    #[test]
    fn the_name_of_the_node_is_waited_for_and_not_for_ever() {
        let mut watch = watch();
        find(&mut watch, guid(1, 1), START);
        assert_eq!(watch.poll(START.plus_ms(NODE_PATIENCE_MS - 1), nameless), None);
        let named = told(&mut watch, START.plus_ms(NODE_PATIENCE_MS - 1), Some("/late"));
        assert!(named[0].contains("node /late on host 10.0.0.9"), "{named:?}");

        find(&mut watch, guid(2, 2), START);
        let nameless = told(&mut watch, START.plus_ms(NODE_PATIENCE_MS), None);
        assert!(nameless[0].contains("a reader of no known node on host 10.0.0.9"), "{nameless:?}");
        assert_eq!(told(&mut watch, START.plus_ms(NODE_PATIENCE_MS + 1), Some("/later")), [""; 0]);
        let nodes: Vec<_> = watch.present().map(|intruder| intruder.node.as_deref()).collect();
        assert_eq!(nodes, [Some("/late"), Some("/later")]);
    }

    #[test]
    fn one_that_leaves_and_returns_is_not_warned_of_again() {
        let mut watch = watch();
        find(&mut watch, guid(1, 1), START);
        find(&mut watch, guid(1, 2), START);
        assert_eq!(told(&mut watch, START, Some("/rviz")).len(), 2);
        watch.gone(guid(1, 1), START);
        watch.gone(guid(1, 1), START);
        assert_eq!(told(&mut watch, START, None), ["left: 1"]);
        watch.participant_gone(guid(1, 0).prefix(), START);
        assert_eq!(told(&mut watch, START, None), ["left: 2"]);
        assert_eq!(watch.counts().present, 0);
        find(&mut watch, guid(1, 2), START.plus_ms(REMEMBER_MS - 1));
        assert_eq!(told(&mut watch, START.plus_ms(REMEMBER_MS - 1), None), ["returned: 2"]);
        find(&mut watch, guid(1, 1), START.plus_ms(REMEMBER_MS));
        assert_eq!(told(&mut watch, START.plus_ms(REMEMBER_MS), Some("/rviz")).len(), 1, "long forgotten");
        assert_eq!(watch.counts(), IntruderCounts { present: 2, told: 3, untold: 0 });
    }

    #[test]
    fn one_that_is_gone_before_it_was_told_is_not_told() {
        let mut watch = watch();
        find(&mut watch, guid(1, 1), START);
        watch.gone(guid(1, 1), START.plus_ms(1_000));
        assert_eq!(told(&mut watch, START.plus_ms(NODE_PATIENCE_MS), Some("/brief")), [""; 0]);
    }

    #[test]
    fn what_goes_and_comes_between_two_looks_says_nothing() {
        let mut watch = watch();
        find(&mut watch, guid(1, 1), START);
        assert_eq!(told(&mut watch, START, Some("/rviz")).len(), 1);
        for _ in 0..1_000 {
            watch.gone(guid(1, 1), START);
            find(&mut watch, guid(1, 1), START);
        }
        assert!(watch.events.len() <= 1);
        assert_eq!(told(&mut watch, START, None), [""; 0]);
        watch.gone(guid(1, 1), START);
        assert_eq!(told(&mut watch, START, None), ["left: 1"]);
    }

    #[test]
    fn one_that_turns_out_to_be_local_has_left() {
        let mut watch = watch();
        find(&mut watch, guid(1, 1), START);
        assert_eq!(told(&mut watch, START, Some("/rviz")).len(), 1);
        // The host has joined the network since.
        let own = [own(), vec!["10.0.0.9".parse().unwrap()]].concat();
        watch.found(guid(1, 1), "rt/scan", &at("10.0.0.9"), &own, START);
        assert_eq!(told(&mut watch, START, None), ["left: 1"]);
    }

    #[test]
    fn a_flood_of_readers_costs_bounded_memory_and_a_bounded_log() {
        let mut watch = watch();
        let mut said = 0;
        for number in 0..100_000_u32 {
            let mut reader = [0; 16];
            reader[..4].copy_from_slice(&number.to_le_bytes());
            // One each ms, and each gone after 100 ms, told or not.
            let now = START.plus_ms(u64::from(number));
            find(&mut watch, Guid(reader), now);
            said += told(&mut watch, now, Some("/flood")).len();
            if let Some(old) = number.checked_sub(100) {
                reader[..4].copy_from_slice(&old.to_le_bytes());
                watch.gone(Guid(reader), now);
            }
            said += told(&mut watch, now, None).len();
            assert!(
                watch.tracked.len() <= MAX_REMEMBERED_INTRUDERS
                    && watch.events.len() <= MAX_REMEMBERED_INTRUDERS
            );
        }
        // Each of those told appeared and left.
        assert_eq!(said, 2 * MAX_REMEMBERED_INTRUDERS);
        let counts = watch.counts();
        assert_eq!(counts.told + counts.untold, 100_000);
    }
}
