//! The subscribers that control follows: one window and one classifier each, and what the boards show of it.

use tracing::{info, trace, warn};

use super::link::{Link, Response};
use crate::config::Settings;
use crate::model::{
    FixedText, MAX_SUBSCRIBERS, MonotonicNs, ProbeRefusal, SubscriberRecord, SubscriberState,
};
use crate::policy::{
    Answer, LaneDecision, LinkReading, ProbeWindow, STOPPED_NS, SubscriberClassifier, SubscriberWarnings,
    Transition, TransitionReason, WarningThresholds, is_forgotten, lane_mode,
};
use crate::shm::{BoardWriter, Boards};

/// Who decides on a subscriber's state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Judge {
    Classifier,
    Override,
    /// The classifier is switched off.
    Nobody,
}

impl Judge {
    /// Why a subscriber is in the state in which this one found it.
    const fn reason_at_first(self, former: Self) -> &'static str {
        match (self, former) {
            (Self::Override, _) => "forced by the configuration (overrides)",
            (Self::Nobody, _) => "not classified (classifier.enabled is false)",
            (Self::Classifier, Self::Override) => "as the former override left it",
            (Self::Classifier, _) => "not enough probes answered yet",
        }
    }
}

/// One subscriber.
struct Subscriber {
    id: String,
    lane: usize,
    /// The number of the link on which it answers: that of its lane's network, or the one on which it was
    /// first heard.
    link: usize,
    listed: bool,
    window: ProbeWindow,
    classifier: SubscriberClassifier,
    reading: LinkReading,
    /// The state before the last change.
    previous: Option<SubscriberState>,
    since: MonotonicNs,
    judge: Judge,
    reason: String,
    warnings: SubscriberWarnings,
    /// Those that are shown, as `SubscriberWarning`'s bits.
    warned: u8,
}

/// A change of state, for those who listen.
#[derive(Clone, Debug)]
pub(super) struct Change {
    pub subscriber: String,
    pub lane: usize,
    pub transition: Transition,
    pub reading: LinkReading,
    pub reason: String,
}

/// A subscriber as it is shown.
pub(super) struct Shown<'a> {
    pub id: &'a str,
    pub lane: &'a str,
    pub state: SubscriberState,
    pub previous_state: SubscriberState,
    pub reading: &'a LinkReading,
    pub reason: &'a str,
}

/// All subscribers, listed ones first.
pub(super) struct Subscribers {
    list: Vec<Subscriber>,
    /// When control was last seen to run, or until when it means to sleep.
    awake_at: MonotonicNs,
    /// The place of each in the table on the board is its place in the list.
    places: Vec<BoardWriter<SubscriberRecord>>,
}

impl Subscribers {
    /// The listed ones. `link_of_lane` gives the number of the link of each lane.
    pub fn new(boards: &Boards, settings: &Settings, link_of_lane: &[usize], now: MonotonicNs) -> Self {
        let mut subscribers = Self {
            list: Vec::with_capacity(MAX_SUBSCRIBERS),
            awake_at: now,
            places: (0..MAX_SUBSCRIBERS).map(|place| boards.subscriber_writer(place)).collect(),
        };
        subscribers.adopt(settings, link_of_lane, now);
        // What a predecessor left.
        for place in &mut subscribers.places {
            place.update(|record| *record = SubscriberRecord::default());
        }
        subscribers.show(settings);
        subscribers
    }

    /// Applies a configuration: lanes, windows, who is listed. Subscribers that are known keep what is known
    /// of them.
    pub fn adopt(&mut self, settings: &Settings, link_of_lane: &[usize], now: MonotonicNs) {
        let probes = &settings.probes;
        for subscriber in &mut self.list {
            subscriber.window.set_limits(probes.window_size, probes.timeout_ms);
            subscriber.listed = is_listed(settings, &subscriber.id);
            let lane = lane_of(settings, &subscriber.id);
            if lane != subscriber.lane {
                if link_of_lane[lane] != subscriber.link {
                    // Answers to what is under way would come on a link that is its own no longer.
                    subscriber.window.stopped(now, now);
                }
                (subscriber.lane, subscriber.link) = (lane, link_of_lane[lane]);
            }
        }
        let listed = settings.subscribers.keys().chain(settings.classifier.subscriber_id.iter());
        for id in listed {
            if self.list.iter().any(|known| known.id == *id) {
                continue;
            }
            if self.list.len() == MAX_SUBSCRIBERS
                && let Some(place) = self.list.iter().position(|known| !known.listed)
            {
                // Whoever made up the others cannot keep a listed one out.
                self.list.remove(place);
            }
            if self.list.len() < MAX_SUBSCRIBERS {
                let lane = lane_of(settings, id);
                self.list.push(Subscriber::new(id, lane, link_of_lane[lane], true, settings, now));
            }
        }
    }

    /// A probe was sent on a link.
    pub fn sent(&mut self, link: usize, seq: u64, at: MonotonicNs) {
        self.awake(at);
        // With the answers, a recording of the link: `RUST_LOG=adaptive_bridge::process::control=trace`.
        trace!(link, seq, sent_at_ms = at.0 / 1_000_000, "probe sent");
        for subscriber in self.list.iter_mut().filter(|subscriber| subscriber.link == link) {
            subscriber.window.sent(seq, at);
        }
    }

    /// Control runs. If it has not for much longer than it meant to, then what was under way says nothing.
    /// It may be stopped anywhere, so that this is asked whenever the windows are told of something.
    pub fn awake(&mut self, now: MonotonicNs) {
        if now.since(self.awake_at) > STOPPED_NS {
            for subscriber in &mut self.list {
                subscriber.window.stopped(self.awake_at, now);
            }
        }
        self.awake_at = now;
    }

    /// Control means to sleep until then.
    pub fn asleep(&mut self, until: MonotonicNs) {
        self.awake_at = until;
    }

    /// Takes in a response that is believed.
    pub fn answered(
        &mut self,
        number: usize,
        link: &Link,
        response: &Response,
        settings: &Settings,
    ) -> Result<(), ProbeRefusal> {
        self.awake(response.arrived_at);
        let place = match self.list.iter().position(|known| known.id == response.responder_id) {
            Some(place) => place,
            None => self.welcome(number, link, response, settings)?,
        };
        let subscriber = &mut self.list[place];
        // One that is in several of our networks answers on each of them; only one of them is its lane's.
        if subscriber.link != number {
            return Ok(());
        }
        match subscriber.window.answered(response.seq, response.arrived_at) {
            Answer::Counted { rtt_ns } => {
                trace!(
                    subscriber = subscriber.id,
                    seq = response.seq,
                    rtt_us = rtt_ns / 1_000,
                    "probe answered"
                );
                Ok(())
            }
            Answer::Late => Err(ProbeRefusal::Late),
            Answer::Repeated => Err(ProbeRefusal::Replayed),
            Answer::Unknown => Err(ProbeRefusal::Unsolicited),
        }
    }

    /// One who is not known yet.
    fn welcome(
        &mut self,
        number: usize,
        link: &Link,
        response: &Response,
        settings: &Settings,
    ) -> Result<usize, ProbeRefusal> {
        let id = &response.responder_id;
        if settings.classifier.subscriber_id.is_some() {
            // It names the only one that counts; those that are listed beside it are known already.
            return Err(ProbeRefusal::NotTheSubscriber);
        }
        if self.list.len() == MAX_SUBSCRIBERS {
            return Err(ProbeRefusal::TooManySubscribers);
        }
        let lane = lane_of(settings, id);
        info!(
            subscriber = id,
            lane = settings.lanes[lane].name.as_str(),
            "a responder that is not listed under `subscribers`"
        );
        let mut subscriber = Subscriber::new(id, lane, number, false, settings, response.arrived_at);
        for probe in link.since(response.seq) {
            subscriber.window.sent(probe.seq, probe.sent_at);
        }
        self.list.push(subscriber);
        Ok(self.list.len() - 1)
    }

    /// One evaluation of every subscriber. Forgets those that left.
    pub fn evaluate(&mut self, settings: &Settings, now: MonotonicNs) -> Vec<Change> {
        let mut changes = Vec::new();
        let warning_thresholds = WarningThresholds {
            rtt_ms: settings.probes.rtt_threshold_ms,
            loss: settings.probes.loss_threshold,
            jitter_ms: settings.probes.jitter_threshold_ms,
            readings: settings.probes.hysteresis_count,
        };
        for subscriber in &mut self.list {
            subscriber.reading = subscriber.window.reading(now);
            subscriber.warned = subscriber.warnings.read(&warning_thresholds, &subscriber.reading);
            let forced = settings.overrides.get(&subscriber.id).copied();
            let judge = match forced {
                Some(_) => Judge::Override,
                None if settings.classifier.enabled => Judge::Classifier,
                None => Judge::Nobody,
            };
            // Also where the state stays: a reason that no longer holds is worse than none.
            let former = std::mem::replace(&mut subscriber.judge, judge);
            if former != judge {
                judge.reason_at_first(former).clone_into(&mut subscriber.reason);
            }
            let thresholds = &settings.classifier.thresholds;
            let transition = match judge {
                Judge::Nobody => subscriber.classifier.unclassified(thresholds),
                _ => subscriber.classifier.evaluate(&subscriber.reading, thresholds, forced),
            };
            let Some(transition) = transition else { continue };
            subscriber.previous = Some(transition.from);
            subscriber.since = now;
            subscriber.reason = reason_text(&transition.reason);
            log(subscriber, &transition, settings);
            changes.push(Change {
                subscriber: subscriber.id.clone(),
                lane: subscriber.lane,
                transition,
                reading: subscriber.reading,
                reason: subscriber.reason.clone(),
            });
        }
        self.list.retain(|subscriber| {
            // One that was never heard has been listed until now.
            let left = !subscriber.listed
                && subscriber.window.heard_at().is_none_or(|heard_at| is_forgotten(heard_at, now));
            if left {
                info!(subscriber = subscriber.id, "silent and not listed: forgotten");
            }
            !left
        });
        changes
    }

    /// The mode that the subscribers of a lane give it, and why.
    pub fn lane_mode(&self, settings: &Settings, lane: usize) -> LaneDecision<'_> {
        let thresholds = &settings.classifier.thresholds;
        let states = self
            .list
            .iter()
            .filter(|subscriber| subscriber.lane == lane)
            .map(|subscriber| (subscriber.id.as_str(), subscriber.classifier.state(thresholds)));
        let enabled = settings.classifier.enabled || !settings.overrides.is_empty();
        lane_mode(settings.lanes[lane].class, enabled, states, &settings.safety.rules)
    }

    /// Places taken in the table.
    pub fn count(&self) -> usize {
        self.list.len()
    }

    /// Writes the table.
    pub fn show(&mut self, settings: &Settings) {
        let thresholds = &settings.classifier.thresholds;
        for (place, subscriber) in self.places.iter_mut().zip(&self.list) {
            let record = subscriber.record(subscriber.classifier.state(thresholds));
            if record != *place.get() {
                place.update(|shown| *shown = record);
            }
        }
    }

    /// What is known of each.
    pub fn iter<'a>(&'a self, settings: &'a Settings) -> impl Iterator<Item = Shown<'a>> {
        let thresholds = &settings.classifier.thresholds;
        self.list.iter().map(|subscriber| {
            let state = subscriber.classifier.state(thresholds);
            Shown {
                id: &subscriber.id,
                lane: settings.lanes[subscriber.lane].name.as_str(),
                state,
                previous_state: subscriber.previous.unwrap_or(state),
                reading: &subscriber.reading,
                reason: &subscriber.reason,
            }
        })
    }
}

impl Subscriber {
    fn new(id: &str, lane: usize, link: usize, listed: bool, settings: &Settings, now: MonotonicNs) -> Self {
        Self {
            id: id.to_owned(),
            lane,
            link,
            listed,
            window: ProbeWindow::new(settings.probes.window_size, settings.probes.timeout_ms),
            classifier: SubscriberClassifier::new(),
            reading: LinkReading::default(),
            previous: None,
            since: now,
            judge: Judge::Classifier,
            reason: Judge::Classifier.reason_at_first(Judge::Nobody).to_owned(),
            warnings: SubscriberWarnings::default(),
            warned: 0,
        }
    }

    fn record(&self, state: SubscriberState) -> SubscriberRecord {
        let us = |ms: Option<f64>| ms.map_or(0, |ms| (ms * 1e3).round() as u64);
        SubscriberRecord {
            id: FixedText::new(&self.id),
            lane: self.lane as u64,
            state_since: self.since,
            transitions: self.classifier.transitions(),
            settled: self.reading.settled as u64,
            lost: self.reading.lost as u64,
            rtt_mean_us: us(self.reading.rtt_mean_ms),
            rtt_p95_us: us(self.reading.rtt_p95_ms),
            jitter_us: us(self.reading.jitter_ms),
            last_response_at: self.window.heard_at().unwrap_or_default(),
            state: state as u8,
            forced: u8::from(self.classifier.is_forced()),
            listed: u8::from(self.listed),
            warnings: self.warned,
            reserved: [0; 4],
            reason: FixedText::new(&self.reason),
        }
    }
}

/// Whether the configuration knows it.
fn is_listed(settings: &Settings, id: &str) -> bool {
    settings.subscribers.contains_key(id) || settings.classifier.subscriber_id.as_deref() == Some(id)
}

/// The number of a subscriber's lane: as configured, else `noncritical`, which is always there.
fn lane_of(settings: &Settings, id: &str) -> usize {
    let by_name = |name: &str| settings.lanes.iter().position(|lane| lane.name.as_str() == name);
    let configured = settings.subscribers.get(id).and_then(|lane| by_name(lane.as_str()));
    configured.or_else(|| by_name("noncritical")).unwrap_or(settings.lanes.len() - 1)
}

/// Why, in a sentence that fits the board.
fn reason_text(reason: &TransitionReason) -> String {
    let numbers = |reading: &LinkReading| {
        let rtt = reading.rtt_mean_ms.map_or("no answer".to_owned(), |ms| format!("RTT {ms:.1} ms"));
        format!("{rtt}, loss {:.1} % of {}", reading.loss * 100.0, reading.settled)
    };
    match reason {
        TransitionReason::Override => Judge::Override.reason_at_first(Judge::Classifier).to_owned(),
        TransitionReason::Unclassified => Judge::Nobody.reason_at_first(Judge::Classifier).to_owned(),
        TransitionReason::Demoted { reading, .. } => {
            format!("impaired ({}): {}", reason.label(), numbers(reading))
        }
        TransitionReason::Promoted { reading } => format!("healthy: {}", numbers(reading)),
    }
}

fn log(subscriber: &Subscriber, transition: &Transition, settings: &Settings) {
    let lane = settings.lanes[subscriber.lane].name.as_str();
    let (from, to) = (transition.from.label(), transition.to.label());
    if transition.to == SubscriberState::Noncritical {
        warn!(subscriber = subscriber.id, lane, from, to, reason = subscriber.reason, "subscriber demoted");
    } else {
        info!(
            subscriber = subscriber.id,
            lane,
            from,
            to,
            reason = subscriber.reason,
            "subscriber's state changed"
        );
    }
}
