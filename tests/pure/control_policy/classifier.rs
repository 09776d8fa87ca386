//! The state machine of a subscriber, and the modes of lanes.

use adaptive_bridge::model::{
    ClassifierThresholds, LaneMode, SafetyMode, SafetyRules, SubscriberState, TrafficClass,
};
use adaptive_bridge::policy::{
    FORGET_UNLISTED_MS, LaneDecision, LaneReason, LinkReading, MIN_SETTLED, SubscriberClassifier,
    TransitionReason, is_forgotten, lane_mode, safety_floor,
};
use proptest::prelude::*;

use super::{at_ms, config};
use SubscriberState::{Critical, Noncritical, Unknown};

fn reading(settled: usize, loss: f64, rtt_mean_ms: f64) -> LinkReading {
    let lost = (settled as f64 * loss).round() as usize;
    let answered = settled - lost;
    let rtt_mean_ms = (answered > 0).then_some(rtt_mean_ms);
    LinkReading { settled, answered, lost, loss, rtt_mean_ms, ..LinkReading::default() }
}

const SLOW: (f64, f64) = (0.0, 50.1);
const LOSSY: (f64, f64) = (0.02, 5.0);
const GOOD: (f64, f64) = (0.0, 34.9);

fn full((loss, rtt_ms): (f64, f64)) -> LinkReading {
    reading(50, loss, rtt_ms)
}

/// The states after each of these readings.
fn run(classifier: &mut SubscriberClassifier, readings: &[LinkReading]) -> Vec<SubscriberState> {
    let thresholds = ClassifierThresholds::default();
    let state = |reading| {
        classifier.evaluate(reading, &thresholds, None);
        classifier.state(&thresholds)
    };
    readings.iter().map(state).collect()
}

#[test]
fn three_readings_in_a_row_decide() {
    for bad in [SLOW, LOSSY] {
        let mut classifier = SubscriberClassifier::default();
        assert_eq!(run(&mut classifier, &[full(GOOD); 3]), [Unknown, Unknown, Critical]);
        assert_eq!(run(&mut classifier, &[full(bad); 3]), [Critical, Critical, Noncritical]);
        assert_eq!(run(&mut classifier, &[full(GOOD); 3]), [Noncritical, Noncritical, Critical]);
        assert_eq!(classifier.transitions(), 3);
    }
}

#[test]
fn a_reading_on_a_threshold_or_between_them_resets_the_count() {
    // On a threshold, between, or one within and one between.
    for between in [(0.015, 34.0), (0.0, 50.0), (0.005, 34.0), (0.0, 35.0), (0.01, 40.0), (0.0, 42.0)] {
        let mut classifier = SubscriberClassifier::default();
        run(&mut classifier, &[full(GOOD); 3]);
        let states = run(&mut classifier, &[SLOW, SLOW, between, SLOW, LOSSY, between].map(full));
        assert_eq!(states, [Critical; 6], "{between:?}");
        assert_eq!(run(&mut classifier, &[SLOW, LOSSY, SLOW].map(full))[2], Noncritical);
        let states = run(&mut classifier, &[GOOD, GOOD, between, GOOD, GOOD].map(full));
        assert_eq!(states, [Noncritical; 5], "{between:?}");
    }
}

#[test]
fn the_reason_has_the_numbers_that_decided() {
    let thresholds = ClassifierThresholds { hysteresis_count: 1, ..ClassifierThresholds::default() };
    let mut classifier = SubscriberClassifier::default();
    let transition = classifier.evaluate(&full((0.5, 80.0)), &thresholds, None).unwrap();
    assert_eq!((transition.from, transition.to), (Unknown, Noncritical));
    assert_eq!(transition.reason.label(), "loss_and_rtt");
    let expected = TransitionReason::Demoted { reading: full((0.5, 80.0)), by_loss: true, by_rtt: true };
    assert_eq!(transition.reason, expected);
    let transition = classifier.evaluate(&full(GOOD), &thresholds, None).unwrap();
    assert_eq!(transition.reason, TransitionReason::Promoted { reading: full(GOOD) });
}

#[test]
fn a_silent_responder_is_demoted_and_too_little_data_decides_nothing() {
    let mut classifier = SubscriberClassifier::default();
    let few = reading(MIN_SETTLED - 1, 1.0, 0.0);
    assert_eq!(run(&mut classifier, &[few; 5]), [Unknown; 5]);
    assert_eq!(run(&mut classifier, &[reading(50, 1.0, 0.0); 3])[2], Noncritical);
    // A full window is enough, also if it holds fewer probes than a reading needs otherwise.
    let mut classifier = SubscriberClassifier::default();
    let small = LinkReading { full: true, ..reading(5, 0.0, 1.0) };
    assert_eq!(run(&mut classifier, &[small; 3])[2], Critical);
}

#[test]
fn unknown_is_critical_where_it_is_not_allowed() {
    let thresholds = ClassifierThresholds { allow_unknown_state: false, ..ClassifierThresholds::default() };
    let mut classifier = SubscriberClassifier::default();
    assert_eq!(classifier.state(&thresholds), Critical);
    for _ in 0..5 {
        assert_eq!(classifier.evaluate(&full(GOOD), &thresholds, None), None);
    }
    assert_eq!(classifier.evaluate(&full(SLOW), &thresholds, Some(Unknown)), None);
    assert_eq!(classifier.transitions(), 0);
    let changes = (0..3).filter_map(|_| classifier.evaluate(&full(SLOW), &thresholds, None));
    let last = changes.last().unwrap();
    assert_eq!((last.from, last.to), (Critical, Noncritical));
}

#[test]
fn an_override_applies_at_once_and_the_classifier_continues_from_it() {
    let thresholds = ClassifierThresholds::default();
    let mut classifier = SubscriberClassifier::default();
    run(&mut classifier, &[full(GOOD); 3]);
    let forced = classifier.evaluate(&full(GOOD), &thresholds, Some(Noncritical)).unwrap();
    assert_eq!((forced.to, forced.reason), (Noncritical, TransitionReason::Override));
    assert!(classifier.is_forced());
    assert_eq!(run(&mut classifier, &[full(GOOD); 3]), [Noncritical, Noncritical, Critical]);
    assert!(!classifier.is_forced());
}

#[test]
fn an_unclassified_subscriber_keeps_no_state_and_no_override() {
    let thresholds = ClassifierThresholds::default();
    let mut classifier = SubscriberClassifier::default();
    assert_eq!(classifier.unclassified(&thresholds), None);
    run(&mut classifier, &[full(SLOW); 5]);
    let change = classifier.unclassified(&thresholds).unwrap();
    assert_eq!((change.from, change.to), (Noncritical, Unknown));
    assert_eq!((change.reason, classifier.unclassified(&thresholds)), (TransitionReason::Unclassified, None));
    // Two of three readings towards a change are forgotten, too.
    run(&mut classifier, &[full(SLOW); 2]);
    classifier.unclassified(&thresholds);
    assert_eq!(run(&mut classifier, &[full(SLOW); 3]), [Unknown, Unknown, Noncritical]);
    classifier.evaluate(&full(SLOW), &thresholds, Some(Critical));
    classifier.unclassified(&thresholds);
    assert!(!classifier.is_forced());
    let never_unknown = ClassifierThresholds { allow_unknown_state: false, ..thresholds };
    assert_eq!(classifier.state(&never_unknown), Critical);
}

#[test]
fn an_unlisted_subscriber_is_forgotten_after_a_minute_of_silence() {
    assert!(!is_forgotten(at_ms(5), at_ms(5 + FORGET_UNLISTED_MS)));
    assert!(is_forgotten(at_ms(5), at_ms(6 + FORGET_UNLISTED_MS)));
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Bad,
    Good,
    Between,
    Few,
}

fn kind() -> impl Strategy<Value = Kind> {
    prop_oneof![4 => Just(Kind::Bad), 4 => Just(Kind::Good), 1 => Just(Kind::Between), 1 => Just(Kind::Few)]
}

fn of_kind(kind: Kind, random: f64) -> LinkReading {
    match kind {
        Kind::Bad if random < 0.5 => full((0.016 + random, 20.0)),
        Kind::Bad => full((0.0, 51.0 + 100.0 * random)),
        Kind::Good => full((0.0, 34.0 * random)),
        Kind::Between if random < 0.5 => full((0.01, 20.0 * random)),
        Kind::Between => full((0.0, 36.0 + 10.0 * random)),
        Kind::Few => reading((random * 9.0) as usize, random, 200.0 * random),
    }
}

fn forced() -> impl Strategy<Value = Option<SubscriberState>> {
    prop_oneof![
        9 => Just(None),
        1 => prop::sample::select(vec![Some(Unknown), Some(Critical), Some(Noncritical)]),
    ]
}

proptest! {
    #![proptest_config(config(512))]

    #[test]
    fn a_transition_takes_so_many_crossings_in_a_row_and_an_override_always_wins(
        hysteresis_count in 0..6_u32,
        allow_unknown_state: bool,
        steps in prop::collection::vec((kind(), 0.0..1.0_f64, forced()), 1..200),
    ) {
        let thresholds =
            ClassifierThresholds { hysteresis_count, allow_unknown_state, ..ClassifierThresholds::default() };
        let needed = hysteresis_count.max(1) as usize;
        let mut classifier = SubscriberClassifier::default();
        // The readings since the last forced state.
        let mut kinds: Vec<Kind> = Vec::new();
        let mut changes = 0;
        for (kind, random, forced) in steps {
            let before = classifier.state(&thresholds);
            let transition = classifier.evaluate(&of_kind(kind, random), &thresholds, forced);
            let state = classifier.state(&thresholds);
            prop_assert_eq!(transition.map(|change| (change.from, change.to)),
                (before != state).then_some((before, state)));
            changes += u64::from(transition.is_some());
            prop_assert!(allow_unknown_state || state != Unknown);
            if let Some(forced) = forced {
                let shown = if forced == Unknown && !allow_unknown_state { Critical } else { forced };
                prop_assert_eq!(state, shown);
                kinds.clear();
                continue;
            }
            kinds.push(kind);
            let in_a_row = kinds.iter().rev().take_while(|last| **last == kind).count();
            let expected = match kind {
                Kind::Bad if in_a_row >= needed => Noncritical,
                Kind::Good if in_a_row >= needed => Critical,
                _ => before,
            };
            prop_assert_eq!(state, expected);
        }
        prop_assert_eq!(classifier.transitions(), changes);
    }
}

fn decided<'a>(states: &[(&'a str, SubscriberState)]) -> LaneDecision<'a> {
    lane_mode(TrafficClass::Noncritical, true, states.iter().copied(), &SafetyRules::default())
}

#[test]
fn the_worst_subscriber_of_a_lane_decides() {
    let healthy = decided(&[("a", Critical), ("b", Unknown)]);
    let reason = LaneReason::Healthy { subscribers: 2, unknown: 1 };
    assert_eq!(healthy, LaneDecision { mode: LaneMode::Normal, reason });
    let impaired = decided(&[("a", Critical), ("b", Noncritical), ("c", Noncritical)]);
    let reason = LaneReason::Subscriber { worst: "b", impaired: 2 };
    assert_eq!(impaired, LaneDecision { mode: LaneMode::Degraded, reason });
    assert_eq!(decided(&[]), LaneDecision { mode: LaneMode::Normal, reason: LaneReason::NoSubscribers });
}

#[test]
fn no_classifier_degrades_a_critical_lane_or_one_that_may_not_be() {
    let states = [("a", Noncritical)];
    let default = SafetyRules::default();
    let forbidden = SafetyRules { allow_noncritical_degrade: false, ..default };
    let cases = [
        (TrafficClass::Critical, true, &default, LaneReason::CriticalLane),
        (TrafficClass::Noncritical, false, &default, LaneReason::ClassifierOff),
        (TrafficClass::Noncritical, true, &forbidden, LaneReason::DegradeForbidden),
    ];
    for (class, enabled, rules, reason) in cases {
        let decision = lane_mode(class, enabled, states, rules);
        assert_eq!(decision, LaneDecision { mode: LaneMode::Normal, reason });
    }
}

#[test]
fn the_safety_mode_sets_the_mildest_mode_of_a_lane() {
    use LaneMode::{Normal, Stopped, Suspended};
    let default = SafetyRules::default();
    let forbidden = SafetyRules { allow_noncritical_degrade: false, ..default };
    let given_up = SafetyRules { preserve_critical_path: false, ..default };
    // Rules, safety mode, trouble of the critical path; then the floors of a critical and a noncritical lane.
    let cases = [
        (&default, SafetyMode::Normal, true, Normal, Normal),
        (&default, SafetyMode::Degraded, true, Normal, Suspended),
        (&default, SafetyMode::Emergency, false, Stopped, Stopped),
        (&forbidden, SafetyMode::Degraded, true, Normal, Normal),
        (&forbidden, SafetyMode::Emergency, true, Stopped, Stopped),
        (&given_up, SafetyMode::Degraded, false, Normal, Suspended),
        (&given_up, SafetyMode::Degraded, true, Stopped, Suspended),
    ];
    for (rules, safety, trouble, critical, noncritical) in cases {
        let floor = |class| safety_floor(class, safety, trouble, rules);
        assert_eq!(floor(TrafficClass::Critical), critical, "{safety} {trouble}");
        assert_eq!(floor(TrafficClass::Noncritical), noncritical, "{safety} {trouble}");
    }
}
