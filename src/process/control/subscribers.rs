//! The subscribers that control probes: a probe window and a classifier for each, and their table on the
//! boards.

use tracing::{info, trace, warn};

use super::link::{Link, Response};
use crate::clock;
use crate::config::Settings;
use crate::model::{
    FixedText, MAX_SUBSCRIBERS, MonotonicNs, ProbeRefusal, SubscriberRecord, SubscriberState,
};
use crate::policy::{
    LaneDecision, LinkReading, ProbeWindow, ResponseOutcome, STOPPED_NS, SubscriberClassifier,
    SubscriberWarnings, Transition, TransitionReason, WarningThresholds, is_forgotten, lane_mode,
};
use crate::shm::{BoardWriter, Boards};
use crate::telemetry::Decision;

/// What determines a subscriber's state.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum StateSource {
    Classifier,
    Override,
    Unclassified,
}

impl StateSource {
    /// The reason of a subscriber's state until this source changes it.
    const fn initial_reason(self, previous: Self) -> &'static str {
        match (self, previous) {
            (Self::Override, _) => "forced by the configuration (overrides)",
            (Self::Unclassified, _) => "not classified (classifier.enabled is false)",
            (Self::Classifier, Self::Override) => "unchanged since the previous override ended",
            (Self::Classifier, _) => "not enough probes answered yet",
        }
    }
}

struct Subscriber {
    id: String,
    lane: usize,
    /// The index of the link on which its responses count: that of its lane's network, or the link of its
    /// first response.
    link: usize,
    listed: bool,
    window: ProbeWindow,
    classifier: SubscriberClassifier,
    reading: LinkReading,
    previous: Option<SubscriberState>,
    since: MonotonicNs,
    source: StateSource,
    reason: String,
    warnings: SubscriberWarnings,
    /// Active warnings, as the bits of `SubscriberWarning`.
    warning_bits: u8,
}

pub(super) struct Subscribers {
    list: Vec<Subscriber>,
    /// When control last ran, or the end of its present sleep.
    pub expected_awake_at: MonotonicNs,
    /// One for each row of the table on the boards, in the order of `list`.
    writers: Vec<BoardWriter<SubscriberRecord>>,
}

impl Subscribers {
    /// Starts with the listed subscribers. `link_of_lane` has the index of each lane's link.
    pub fn new(boards: &Boards, settings: &Settings, link_of_lane: &[usize], now: MonotonicNs) -> Self {
        let mut subscribers = Self {
            list: Vec::with_capacity(MAX_SUBSCRIBERS),
            expected_awake_at: now,
            writers: (0..MAX_SUBSCRIBERS).map(|index| boards.subscriber_writer(index)).collect(),
        };
        subscribers.apply(settings, link_of_lane, now);
        // Clears the records of a previous control process.
        for writer in &mut subscribers.writers {
            writer.update(|record| *record = SubscriberRecord::default());
        }
        subscribers.write_table(settings);
        subscribers
    }

    /// Applies lanes, windows and listed subscribers. Known subscribers keep their windows and states.
    pub fn apply(&mut self, settings: &Settings, link_of_lane: &[usize], now: MonotonicNs) {
        let probes = &settings.probes;
        for subscriber in &mut self.list {
            subscriber.window.set_limits(probes.window_size, probes.timeout_ms);
            subscriber.listed = is_listed(settings, &subscriber.id);
            let lane = lane_of(settings, &subscriber.id);
            if lane != subscriber.lane {
                if link_of_lane[lane] != subscriber.link {
                    // Responses to outstanding probes would arrive on the previous link and would not count.
                    subscriber.window.excuse_pause(now, now);
                }
                (subscriber.lane, subscriber.link) = (lane, link_of_lane[lane]);
            }
        }
        let listed = settings.subscribers.keys().chain(settings.classifier.subscriber_id.iter());
        for id in listed.chain(settings.overrides.keys()) {
            if self.list.iter().any(|known| known.id == *id) {
                continue;
            }
            if self.list.len() == MAX_SUBSCRIBERS
                && let Some(unlisted) = self.list.iter().position(|known| !known.listed)
            {
                // A listed subscriber takes the place of an unlisted one, whose id may be made up.
                self.list.remove(unlisted);
            }
            if self.list.len() < MAX_SUBSCRIBERS {
                let lane = lane_of(settings, id);
                self.list.push(Subscriber::new(id, lane, link_of_lane[lane], true, settings, now));
            }
        }
    }

    pub fn on_probe_sent(&mut self, link: usize, seq: u64, at: MonotonicNs) {
        self.note_awake(at);
        // Together with the responses a recording of the link:
        // `RUST_LOG=adaptive_bridge::process::control=trace`.
        trace!(link, seq, sent_at_ms = at.0 / 1_000_000, "probe sent");
        for subscriber in self.list.iter_mut().filter(|subscriber| subscriber.link == link) {
            subscriber.window.sent(seq, at);
        }
    }

    /// Records that control is running. If it was paused for more than [`STOPPED_NS`] beyond its sleep, the
    /// probes of that time count neither as answered nor as lost. Called before every change of the windows,
    /// because control can be stopped at any point.
    pub fn note_awake(&mut self, now: MonotonicNs) {
        if now.since(self.expected_awake_at) > STOPPED_NS {
            for subscriber in &mut self.list {
                subscriber.window.excuse_pause(self.expected_awake_at, now);
            }
        }
        self.expected_awake_at = now;
    }

    /// Handles an accepted response that arrived on link `link_index`.
    pub fn on_response(
        &mut self,
        link_index: usize,
        link: &Link,
        response: &Response,
        settings: &Settings,
    ) -> Result<(), ProbeRefusal> {
        self.note_awake(response.arrived_at);
        let index = match self.list.iter().position(|known| known.id == response.responder_id) {
            Some(index) => index,
            None => self.add_unlisted(link_index, link, response, settings)?,
        };
        let subscriber = &mut self.list[index];
        // A responder that is in several networks of the bridge responds on each; only its lane's network
        // counts.
        if subscriber.link != link_index {
            return Ok(());
        }
        match subscriber.window.answered(response.seq, response.arrived_at) {
            ResponseOutcome::Counted { rtt_ns } => {
                trace!(
                    subscriber = subscriber.id,
                    seq = response.seq,
                    rtt_us = rtt_ns / 1_000,
                    "probe answered"
                );
                Ok(())
            }
            ResponseOutcome::Late => Err(ProbeRefusal::Late),
            ResponseOutcome::Repeated => Err(ProbeRefusal::Replayed),
            ResponseOutcome::Unknown => Err(ProbeRefusal::Unsolicited),
        }
    }

    /// Adds the subscriber of a responder that is not known yet; returns its index in the list.
    fn add_unlisted(
        &mut self,
        link_index: usize,
        link: &Link,
        response: &Response,
        settings: &Settings,
    ) -> Result<usize, ProbeRefusal> {
        let id = &response.responder_id;
        if settings.classifier.subscriber_id.is_some() {
            // The only accepted responders are this one and the listed ones, which are known already.
            return Err(ProbeRefusal::NotTheSubscriber);
        }
        if self.list.len() == MAX_SUBSCRIBERS {
            return Err(ProbeRefusal::TooManySubscribers);
        }
        let lane = lane_of(settings, id);
        info!(
            subscriber = id,
            lane = settings.lanes[lane].name.as_str(),
            "added a responder that is not listed under `subscribers`"
        );
        let mut subscriber = Subscriber::new(id, lane, link_index, false, settings, response.arrived_at);
        for probe in link.probes.iter().filter(|probe| probe.seq >= response.seq) {
            subscriber.window.sent(probe.seq, probe.sent_at);
        }
        self.list.push(subscriber);
        Ok(self.list.len() - 1)
    }

    /// Evaluates every subscriber, publishes changes of state, and removes silent ones that are not listed.
    pub fn evaluate(&mut self, settings: &Settings, now: MonotonicNs, publish: impl Fn(&Decision<'_>)) {
        let warning_thresholds = WarningThresholds {
            rtt_ms: settings.probes.rtt_threshold_ms,
            loss: settings.probes.loss_threshold,
            jitter_ms: settings.probes.jitter_threshold_ms,
            readings: settings.probes.hysteresis_count,
        };
        for subscriber in &mut self.list {
            subscriber.reading = subscriber.window.reading(now);
            subscriber.warning_bits = subscriber.warnings.read(&warning_thresholds, &subscriber.reading);
            let forced = settings.overrides.get(&subscriber.id).copied();
            let source = match forced {
                Some(_) => StateSource::Override,
                None if settings.classifier.enabled => StateSource::Classifier,
                None => StateSource::Unclassified,
            };
            // Updates the reason even if the state stays the same, so that no outdated reason is shown.
            let previous = std::mem::replace(&mut subscriber.source, source);
            if previous != source {
                source.initial_reason(previous).clone_into(&mut subscriber.reason);
            }
            let thresholds = &settings.classifier.thresholds;
            let transition = match source {
                StateSource::Unclassified => subscriber.classifier.unclassified(thresholds),
                _ => subscriber.classifier.evaluate(&subscriber.reading, thresholds, forced),
            };
            let Some(transition) = transition else { continue };
            subscriber.previous = Some(transition.from);
            subscriber.since = now;
            subscriber.reason = reason_text(&transition.reason);
            log(subscriber, &transition, settings);
            publish(&subscriber.decision(settings));
        }
        self.list.retain(|subscriber| {
            // An unlisted subscriber without any response was listed until the last reload.
            let is_removed = !subscriber.listed
                && subscriber.window.last_response_at().is_none_or(|at| is_forgotten(at, now));
            if is_removed {
                info!(subscriber = subscriber.id, "removed a subscriber that is silent and not listed");
            }
            !is_removed
        });
    }

    /// The mode of a lane that follows from the states of its subscribers, and the reason.
    pub fn lane_mode(&self, settings: &Settings, lane: usize) -> LaneDecision<'_> {
        let thresholds = &settings.classifier.thresholds;
        let states = self
            .list
            .iter()
            .filter(|subscriber| subscriber.lane == lane)
            .map(|subscriber| (subscriber.id.as_str(), subscriber.classifier.state(thresholds)));
        let enabled = settings.classifier.enabled || !settings.overrides.is_empty();
        lane_mode(settings.lanes[lane].class(), enabled, states, &settings.safety.rules)
    }

    pub fn count(&self) -> usize {
        self.list.len()
    }

    pub fn write_table(&mut self, settings: &Settings) {
        let thresholds = &settings.classifier.thresholds;
        for (writer, subscriber) in self.writers.iter_mut().zip(&self.list) {
            writer.set(subscriber.record(subscriber.classifier.state(thresholds)));
        }
    }

    pub fn decisions<'a>(&'a self, settings: &'a Settings) -> impl Iterator<Item = Decision<'a>> {
        self.list.iter().map(|subscriber| subscriber.decision(settings))
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
            classifier: SubscriberClassifier::default(),
            reading: LinkReading::default(),
            previous: None,
            since: now,
            source: StateSource::Classifier,
            reason: StateSource::Classifier.initial_reason(StateSource::Unclassified).to_owned(),
            warnings: SubscriberWarnings::default(),
            warning_bits: 0,
        }
    }

    fn decision<'a>(&'a self, settings: &'a Settings) -> Decision<'a> {
        let state = self.classifier.state(&settings.classifier.thresholds);
        Decision {
            subscriber_id: &self.id,
            lane: settings.lanes[self.lane].name.as_str(),
            state,
            previous_state: self.previous.unwrap_or(state),
            reason: &self.reason,
            rtt_ms: self.reading.rtt_mean_ms,
            loss: (self.reading.settled > 0).then_some(self.reading.loss),
            time: clock::wall(),
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
            last_response_at: self.window.last_response_at().unwrap_or_default(),
            state: state as u8,
            forced: u8::from(self.classifier.is_forced()),
            listed: u8::from(self.listed),
            warnings: self.warning_bits,
            reserved: [0; 4],
            reason: FixedText::new(&self.reason),
        }
    }
}

/// Whether the configuration names a subscriber: under `subscribers` or `overrides`, or as the only one. Its
/// state, and so an override, holds whether or not it responds.
fn is_listed(settings: &Settings, id: &str) -> bool {
    settings.subscribers.contains_key(id)
        || settings.overrides.contains_key(id)
        || settings.classifier.subscriber_id.as_deref() == Some(id)
}

/// The index of a subscriber's lane: the configured lane, or else `noncritical`, which always exists.
fn lane_of(settings: &Settings, id: &str) -> usize {
    let by_name = |name: &str| settings.lanes.iter().position(|lane| lane.name.as_str() == name);
    let configured = settings.subscribers.get(id).and_then(|lane| by_name(lane.as_str()));
    configured.or_else(|| by_name("noncritical")).unwrap_or(settings.lanes.len() - 1)
}

/// The reason of a transition, as a sentence that fits into [`FixedText`].
fn reason_text(reason: &TransitionReason) -> String {
    let numbers = |reading: &LinkReading| {
        let rtt = reading.rtt_mean_ms.map_or("no answer".to_owned(), |ms| format!("RTT {ms:.1} ms"));
        format!("{rtt}, loss {:.1} % of {}", reading.loss * 100.0, reading.settled)
    };
    match reason {
        TransitionReason::Override => {
            StateSource::Override.initial_reason(StateSource::Classifier).to_owned()
        }
        TransitionReason::Unclassified => {
            StateSource::Unclassified.initial_reason(StateSource::Classifier).to_owned()
        }
        TransitionReason::Demoted { reading, .. } => {
            format!("impaired ({}): {}", reason.label(), numbers(reading))
        }
        TransitionReason::Promoted { reading } => format!("healthy: {}", numbers(reading)),
    }
}

fn log(subscriber: &Subscriber, transition: &Transition, settings: &Settings) {
    let lane = settings.lanes[subscriber.lane].name.as_str();
    let (from, to) = (transition.from.label(), transition.to.label());
    let (id, reason) = (&subscriber.id, &subscriber.reason);
    if transition.to == SubscriberState::Noncritical {
        warn!(subscriber = id, lane, from, to, reason, "subscriber demoted");
    } else {
        info!(subscriber = id, lane, from, to, reason, "subscriber state changed");
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::probes::Trust;
    use super::*;
    use crate::dds::Participant;
    use crate::model::SubscriberWarning;
    use crate::policy::FORGET_UNLISTED_MS;
    use crate::process::role::{Role, participant_options};
    use crate::process::test_role::{self, SCAN};
    use crate::shm::ProcessRole;

    /// The time between two probes, after each of which control evaluates.
    const STEP_MS: u64 = 200;

    /// The subscribers of a control process whose clock is `now`.
    struct Bench {
        subscribers: Subscribers,
        link: Link,
        trust: Trust,
        now: MonotonicNs,
    }

    impl Bench {
        fn new(role: &Role, settings: &Settings, participant: &mut Participant) -> Self {
            let now = MonotonicNs(1_000_000_000_000);
            Self {
                subscribers: Subscribers::new(&role.boards, settings, &vec![0; settings.lanes.len()], now),
                link: Link::open(participant, settings).unwrap(),
                trust: super::super::load_trust(settings, None).unwrap(),
                now,
            }
        }

        /// Probes and evaluates for some time. The `responders` answer each probe after 5 ms. After each
        /// evaluation, `see` gets the known subscribers.
        fn run(&mut self, settings: &Settings, ms: u64, responders: &[&str], see: impl Fn(&[Subscriber])) {
            for _ in 0..ms / STEP_MS {
                self.link.send(&mut self.trust).unwrap();
                let probe = self.link.probes.back_mut().unwrap();
                probe.sent_at = self.now;
                self.subscribers.on_probe_sent(0, probe.seq, probe.sent_at);
                let (seq, arrived_at) = (probe.seq, self.now.plus_ms(5));
                for id in responders {
                    let response = Response { responder_id: (*id).to_owned(), seq, arrived_at };
                    self.subscribers.on_response(0, &self.link, &response, settings).unwrap();
                }
                self.now = self.now.plus_ms(STEP_MS);
                self.subscribers.expected_awake_at = self.now;
                self.subscribers.evaluate(settings, self.now, |_| ());
                see(&self.subscribers.list);
            }
        }

        fn ids(&self) -> Vec<&str> {
            self.subscribers.list.iter().map(|subscriber| subscriber.id.as_str()).collect()
        }
    }

    #[test]
    fn each_warning_has_the_threshold_of_its_figure() {
        let (_folder, role, mut settings) = test_role::open(ProcessRole::Control, "control", 163, SCAN);
        let options = participant_options(&settings, &settings.lanes[0].network, "control");
        let mut participant = Participant::open(&options).unwrap();
        for warning in SubscriberWarning::ALL {
            // Every figure is above -1, and none is above 1,000.
            let of = |figure| if figure == warning { -1.0 } else { 1_000.0 };
            settings.probes.rtt_threshold_ms = of(SubscriberWarning::Rtt);
            settings.probes.loss_threshold = of(SubscriberWarning::Loss);
            settings.probes.jitter_threshold_ms = of(SubscriberWarning::Jitter);
            let mut bench = Bench::new(&role, &settings, &mut participant);
            bench.run(&settings, 20_000, &["laptop"], |_| ());
            let shown: Vec<u8> = bench.subscribers.list.iter().map(|one| one.warning_bits).collect();
            assert_eq!(shown, [warning as u8]);
        }
    }

    #[test]
    fn an_override_of_a_responder_that_is_not_listed_outlasts_its_silence() {
        let yaml = format!("{SCAN}\nclassifier: {{enabled: true}}");
        let (_folder, role, settings) = test_role::open(ProcessRole::Control, "control", 149, &yaml);
        let options = participant_options(&settings, &settings.lanes[0].network, "control");
        let mut participant = Participant::open(&options).unwrap();
        let links = vec![0; settings.lanes.len()];
        for forced in [SubscriberState::Critical, SubscriberState::Noncritical] {
            let mut bench = Bench::new(&role, &settings, &mut participant);
            bench.run(&settings, 20_000, &["laptop", "tablet"], |_| ());
            assert_eq!(bench.ids(), ["laptop", "tablet"]);
            let state =
                |subscriber: &Subscriber| subscriber.classifier.state(&settings.classifier.thresholds);
            assert!(bench.subscribers.list.iter().all(|one| state(one) == SubscriberState::Critical));

            // While the laptop is silent the classifier says NONCRITICAL, and when it answers CRITICAL.
            let mut overridden = settings.clone();
            overridden.overrides.insert("laptop".to_owned(), forced);
            bench.subscribers.apply(&overridden, &links, bench.now);
            let holds = |known: &[Subscriber]| {
                let laptop = known.iter().find(|subscriber| subscriber.id == "laptop");
                assert_eq!(laptop.map(state), Some(forced));
            };
            bench.run(&overridden, FORGET_UNLISTED_MS + 10_000, &[], holds);
            assert_eq!(bench.ids(), ["laptop"], "the tablet was silent for so long that it is forgotten");
            bench.run(&overridden, 20_000, &["laptop", "tablet"], holds);
            assert_eq!(bench.ids(), ["laptop", "tablet"]);

            // Without the override it is a responder like others.
            bench.subscribers.apply(&settings, &links, bench.now);
            bench.run(&settings, 20_000, &["laptop", "tablet"], |_| ());
            assert!(bench.subscribers.list.iter().all(|one| state(one) == SubscriberState::Critical));
            bench.run(&settings, FORGET_UNLISTED_MS + 10_000, &[], |_| ());
            assert_eq!(bench.ids(), [""; 0]);
        }
    }
}
