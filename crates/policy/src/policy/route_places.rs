//! Decides which of the topics that match a pattern have a place, that is a route.
//!
//! A topic is known by the announcements of its writers, which any program on the network can forge; only
//! samples are evidence of a topic in use. A topic that has had samples keeps its place as long as a writer
//! of it is announced. A topic without samples keeps it for [`TRIAL_MS`] if others wait. The places of a
//! pattern therefore change at most once in that time each, whatever is announced.

use alloc::collections::BTreeMap;
use alloc::vec::Vec;

use crate::model::{Guid, MonotonicNs, TopicName};

/// How long a topic without samples keeps its place while others wait. Publishers of state that are matched
/// send within a second; 10 s also let a camera start.
pub const TRIAL_MS: u64 = 10_000;

/// How long a topic that has had samples keeps its place without a writer while others wait: a publisher that
/// is restarted, or is away for an outage of the network, returns to its place.
pub const AWAY_MS: u64 = 60_000;

/// The most topics of a pattern that are remembered without a place.
pub const MAX_WAITING_TOPICS: usize = 256;

/// The most writers of a topic that are remembered. A topic that lost all of these counts as one without a
/// writer, but keeps its place while samples arrive.
pub const MAX_TOPIC_WRITERS: usize = 64;

/// A topic that gets a place.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Binding {
    /// The place.
    pub place: usize,
    /// The topic.
    pub topic: TopicName,
    /// The topic that had the place before.
    pub former: Option<TopicName>,
}

#[derive(Clone, Debug)]
struct Topic {
    name: TopicName,
    writers: Vec<Guid>,
    /// The participant that announced it first: the places are shared out among participants, so that one
    /// that announces many topics delays its own.
    participant: [u8; 12],
    /// How often it had a place and no samples.
    trials: u32,
    /// Its number in the order of discovery; a topic that loses its place gets a new one.
    order: u64,
}

#[derive(Clone, Debug)]
struct Place {
    topic: Topic,
    bound_at: MonotonicNs,
    /// Samples received of this topic, as far as `samples_at` has been told.
    samples: u64,
    /// The last time at which a writer was known or a sample had arrived.
    present_at: MonotonicNs,
}

/// The places of one pattern, and the topics that wait for one.
#[derive(Clone, Debug)]
pub struct RoutePlaces {
    places: Vec<Option<Place>>,
    waiting: Vec<Topic>,
    next_order: u64,
    /// Places that a topic has had to leave for another one.
    pub released: u64,
    /// Times that a waiting topic was forgotten because [`MAX_WAITING_TOPICS`] waited.
    pub forgotten: u64,
}

impl RoutePlaces {
    /// That many places, all of them free.
    pub fn new(places: usize) -> Self {
        let places = (0..places).map(|_| None).collect();
        Self { places, waiting: Vec::new(), next_order: 0, released: 0, forgotten: 0 }
    }

    /// Gives a place to the topic that had it in the former process, which has had `samples` samples.
    pub fn resume(&mut self, place: usize, name: TopicName, samples: u64, now: MonotonicNs) {
        let order = self.take_order();
        let topic = Topic { name, writers: Vec::new(), participant: [0; 12], trials: 0, order };
        if let Some(free) = self.places.get_mut(place) {
            *free = Some(Place { topic, bound_at: now, samples, present_at: now });
        }
    }

    /// Records a writer of a topic that matches the pattern. Returns whether the topic is remembered.
    pub fn writer_found(&mut self, name: &TopicName, writer: Guid) -> bool {
        let placed = self.places.iter_mut().flatten().map(|place| &mut place.topic);
        let mut known = placed.chain(&mut self.waiting);
        if let Some(topic) = known.find(|topic| topic.name == *name) {
            if !topic.writers.contains(&writer) && topic.writers.len() < MAX_TOPIC_WRITERS {
                if topic.writers.is_empty() {
                    topic.participant = writer.prefix();
                }
                topic.writers.push(writer);
            }
            return true;
        }
        let participant = writer.prefix();
        if self.waiting.len() == MAX_WAITING_TOPICS && !self.forget_one_for(participant) {
            self.forgotten += 1;
            return false;
        }
        let order = self.take_order();
        let writers = Vec::from([writer]);
        self.waiting.push(Topic { name: name.clone(), writers, participant, trials: 0, order });
        true
    }

    /// Forgets the newest waiting topic of the participant with the most, if `participant` has fewer.
    fn forget_one_for(&mut self, participant: [u8; 12]) -> bool {
        let mut counts = BTreeMap::<[u8; 12], usize>::new();
        for topic in &self.waiting {
            *counts.entry(topic.participant).or_default() += 1;
        }
        let count = |of: &[u8; 12]| counts.get(of).copied().unwrap_or(0);
        let newest = self
            .waiting
            .iter()
            .enumerate()
            .map(|(at, topic)| (count(&topic.participant), topic.order, at))
            .max();
        let Some((most, _, at)) = newest else { return false };
        if most <= count(&participant) + 1 {
            return false;
        }
        self.waiting.remove(at);
        self.forgotten += 1;
        true
    }

    /// Records that the writers for which this holds are gone. Waiting topics without a writer are forgotten.
    pub fn writers_gone(&mut self, is_gone: impl Fn(Guid) -> bool) {
        let placed = self.places.iter_mut().flatten().map(|place| &mut place.topic);
        for topic in placed.chain(&mut self.waiting) {
            topic.writers.retain(|writer| !is_gone(*writer));
        }
        self.waiting.retain(|topic| !topic.writers.is_empty());
    }

    /// Records how many samples of its topic a place has received in all.
    pub fn samples_at(&mut self, place: usize, samples: u64, now: MonotonicNs) {
        if let Some(Some(place)) = self.places.get_mut(place) {
            if samples > place.samples || !place.topic.writers.is_empty() {
                place.present_at = now;
            }
            place.samples = samples;
        }
    }

    /// The next topic that gets a place, if there is one. A topic that loses its place for it waits again if
    /// it has a writer.
    pub fn poll(&mut self, now: MonotonicNs) -> Option<Binding> {
        let next = self.next_waiting()?;
        let free = self.places.iter().position(Option::is_none);
        let place = free.or_else(|| self.releasable(now))?;
        let topic = self.waiting.remove(next);
        let name = topic.name.clone();
        let bound = Place { topic, bound_at: now, samples: 0, present_at: now };
        let former = self.places[place].replace(bound);
        let former = former.map(|former| {
            self.released += 1;
            let name = former.topic.name.clone();
            if !former.topic.writers.is_empty() {
                let order = self.take_order();
                let trials = former.topic.trials.saturating_add(1);
                self.waiting.push(Topic { trials, order, ..former.topic });
            }
            name
        });
        Some(Binding { place, topic: name, former })
    }

    /// The waiting topic that is next: of the participant with the fewest places, then with the fewest
    /// trials, then the one that waits longest.
    fn next_waiting(&self) -> Option<usize> {
        let places_of = |participant| {
            let placed = self.places.iter().flatten();
            placed.filter(|place| place.topic.participant == participant).count()
        };
        let rank = |topic: &Topic| (places_of(topic.participant), topic.trials, topic.order);
        self.waiting.iter().enumerate().min_by_key(|(_, topic)| rank(topic)).map(|(at, _)| at)
    }

    /// The place that a waiting topic may take: of a topic without samples for [`TRIAL_MS`], the one bound
    /// first; else of one that has been away for [`AWAY_MS`], the one away longest.
    fn releasable(&self, now: MonotonicNs) -> Option<usize> {
        let is_over = |since: MonotonicNs, ms: u64| now >= since.plus_ms(ms);
        let rank = |place: &Place| {
            if place.samples == 0 {
                is_over(place.bound_at, TRIAL_MS).then_some((0, place.bound_at))
            } else {
                let is_away = place.topic.writers.is_empty() && is_over(place.present_at, AWAY_MS);
                is_away.then_some((1, place.present_at))
            }
        };
        let taken = self.places.iter().enumerate();
        taken.filter_map(|(at, place)| Some((rank(place.as_ref()?)?, at))).min().map(|(_, at)| at)
    }

    fn take_order(&mut self) -> u64 {
        self.next_order += 1;
        self.next_order
    }

    /// The topic of a place.
    pub fn topic_at(&self, place: usize) -> Option<&TopicName> {
        Some(&self.places.get(place)?.as_ref()?.topic.name)
    }

    /// Whether a topic has a place or waits for one.
    pub fn knows(&self, name: &TopicName) -> bool {
        let placed = self.places.iter().flatten().map(|place| &place.topic);
        placed.chain(&self.waiting).any(|topic| topic.name == *name)
    }

    /// How many topics wait, and the one that waits longest.
    pub fn waiting(&self) -> (usize, Option<&TopicName>) {
        let first = self.waiting.iter().min_by_key(|topic| topic.order);
        (self.waiting.len(), first.map(|topic| &topic.name))
    }
}
