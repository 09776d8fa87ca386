//! The safety supervisor: which fault leads to which mode, and escalation and recovery.

use adaptive_bridge::model::{SafetyMode, SafetyRules, TrafficClass};
use adaptive_bridge::policy::{
    ErrorCounts, ProcessLoad, SafetyDecision, SafetySupervisor, SafetyTrouble, SourceLag,
};
use proptest::prelude::*;

use super::{at_ms, config};
use SafetyMode::{Degraded, Emergency, Normal};
use TrafficClass::{Critical, Noncritical};

const INGRESS: ProcessLoad<'static> = ProcessLoad::idle("ingress", Critical);
const CRITICAL: ProcessLoad<'static> =
    ProcessLoad { queue_capacity: 64, ..ProcessLoad::idle("critical", Critical) };
const NONCRITICAL: ProcessLoad<'static> = ProcessLoad::idle("noncritical", Noncritical);
/// Loads beyond the threshold of EMERGENCY, and beyond that of DEGRADED.
const EXTREME: ProcessLoad<'static> = ProcessLoad { writer_lag_ms: Some(2_000.0), ..CRITICAL };
const NEAR: ProcessLoad<'static> = ProcessLoad { writer_lag_ms: Some(500.0), ..CRITICAL };

/// A supervisor that is evaluated at 2 Hz.
struct Bench {
    supervisor: SafetySupervisor,
    rules: SafetyRules,
    now_ms: u64,
}

impl Bench {
    fn new(rules: SafetyRules) -> Self {
        let mut bench = Self { supervisor: SafetySupervisor::default(), rules, now_ms: 0 };
        bench.next(&[]);
        bench
    }

    fn next(&mut self, processes: &[ProcessLoad<'_>]) -> SafetyDecision {
        self.now_ms += 500;
        self.supervisor.evaluate(processes, &self.rules, at_ms(self.now_ms))
    }

    /// The modes after each of `times` evaluations of the same load.
    fn modes(&mut self, process: ProcessLoad<'_>, times: usize) -> Vec<SafetyMode> {
        (0..times).map(|_| self.next(&[INGRESS, process]).mode).collect()
    }

    fn last(&mut self, process: ProcessLoad<'_>, times: usize) -> SafetyMode {
        self.modes(process, times).pop().unwrap()
    }
}

fn bench() -> Bench {
    Bench::new(SafetyRules::default())
}

#[test]
fn escalation_and_recovery_pass_through_degraded() {
    let mut bench = bench();
    assert_eq!(bench.modes(EXTREME, 6), [Normal, Normal, Degraded, Degraded, Degraded, Emergency]);
    assert_eq!(bench.modes(CRITICAL, 10)[8..], [Emergency, Degraded]);
    assert_eq!(bench.modes(CRITICAL, 10)[8..], [Degraded, Normal]);
    assert_eq!(bench.supervisor.transitions(), 4);
}

#[test]
fn a_reading_that_differs_resets_the_count_either_way() {
    let mut bench = bench();
    for _ in 0..5 {
        assert_eq!(bench.last(EXTREME, 2), Normal);
        assert_eq!(bench.last(CRITICAL, 1), Normal);
    }
    assert_eq!(bench.last(NEAR, 3), Degraded);
    assert_eq!(bench.last(NEAR, 50), Degraded);
    assert_eq!(bench.last(CRITICAL, 9), Degraded);
    assert_eq!(bench.last(NEAR, 1), Degraded);
    assert_eq!(bench.last(CRITICAL, 9), Degraded);
    assert_eq!(bench.last(CRITICAL, 1), Normal);
}

#[test]
fn emergency_ends_when_readings_no_longer_indicate_it() {
    let mut bench = bench();
    assert_eq!(bench.last(EXTREME, 6), Emergency);
    assert_eq!(bench.modes(NEAR, 10)[8..], [Emergency, Degraded]);
    assert_eq!(bench.last(NEAR, 20), Degraded);
}

#[test]
fn without_noncritical_first_emergency_comes_at_once() {
    let rules = SafetyRules { overload_drop_noncritical_first: false, ..SafetyRules::default() };
    assert_eq!(Bench::new(rules).modes(EXTREME, 3), [Normal, Normal, Emergency]);
    assert_eq!(Bench::new(rules).modes(NEAR, 3), [Normal, Normal, Degraded]);
}

#[test]
fn a_safety_decision_names_the_process_and_the_cause() {
    let mut bench = bench();
    let waiting = ProcessLoad { waiting: 51, ..NONCRITICAL };
    for _ in 0..2 {
        bench.next(&[waiting, EXTREME]);
    }
    let decision = bench.next(&[waiting, EXTREME]);
    assert_eq!((decision.mode, decision.changed_from), (Degraded, Some(Normal)));
    let cause = decision.cause.unwrap();
    assert_eq!((cause.process.as_str(), cause.class, cause.speaks_for), ("critical", Critical, Emergency));
    assert_eq!(cause.trouble, SafetyTrouble::WriterLag { lag_ms: 2_000.0, limit_ms: 2_000.0 });
    assert!(decision.critical_trouble && !decision.clean);
    // The decision names the cause until the bridge is in NORMAL again.
    let decision = bench.next(&[CRITICAL]);
    assert!(decision.clean && decision.cause == Some(cause));
    assert_eq!(bench.last(CRITICAL, 10), Normal);
    assert_eq!(bench.next(&[CRITICAL]).cause, None);
}

#[test]
fn each_fault_of_the_critical_path_indicates_its_mode() {
    let errors = |errors| ProcessLoad { errors, ..CRITICAL };
    let lost = |n| errors(ErrorCounts { queue_overflow: n, ..ErrorCounts::default() });
    let cases = [
        ("a queue at three quarters", ProcessLoad { queued: 48, ..CRITICAL }, Degraded),
        ("a queue below", ProcessLoad { queued: 47, ..CRITICAL }, Normal),
        ("a full queue", ProcessLoad { queued: 64, ..CRITICAL }, Emergency),
        ("a full short queue", ProcessLoad { queued: 4, queue_capacity: 4, ..CRITICAL }, Normal),
        ("source lag", ProcessLoad { source_lag_ms: Some(9_999.0), ..CRITICAL }, Degraded),
        ("a clock ahead", ProcessLoad { source_lag_ms: Some(-4.0e9), ..CRITICAL }, Normal),
        ("a clock behind", ProcessLoad { source_lag_ms: Some(10_001.0), ..CRITICAL }, Normal),
        ("no number", ProcessLoad { source_lag_ms: Some(f64::NAN), ..CRITICAL }, Normal),
        ("two lost samples a second", lost(1), Normal),
        ("six lost samples a second", lost(3), Degraded),
        ("100 lost samples a second", lost(50), Emergency),
        (
            "writes that DDS refuses",
            errors(ErrorCounts { write_failed: 1 << 40, ..ErrorCounts::default() }),
            Degraded,
        ),
        ("restarts", errors(ErrorCounts { restarts: u64::MAX, ..ErrorCounts::default() }), Degraded),
        ("silence", ProcessLoad { silent_ms: 2_000, queued: 64, ..EXTREME }, Degraded),
        ("long silence", ProcessLoad { silent_ms: 30_000, ..CRITICAL }, Emergency),
    ];
    for (what, process, expected) in cases {
        assert_eq!(bench().last(process, 30), expected, "{what}");
    }
    let never = SafetyRules { emergency_silent_ms: 0, ..SafetyRules::default() };
    let silent = ProcessLoad { silent_ms: u64::MAX, ..CRITICAL };
    assert_eq!(Bench::new(never).last(silent, 30), Degraded);
}

#[test]
fn each_fault_of_a_noncritical_lane_indicates_at_most_degraded() {
    let errors = |errors| ProcessLoad { errors, ..NONCRITICAL };
    let cases = [
        ("samples that wait", ProcessLoad { waiting: 51, ..NONCRITICAL }, Degraded),
        ("as many as may wait", ProcessLoad { waiting: 50, ..NONCRITICAL }, Normal),
        ("lag", ProcessLoad { writer_lag_ms: Some(1e9), ..NONCRITICAL }, Degraded),
        ("SIGSTOP", ProcessLoad { silent_ms: 600_000, waiting: 4_096, ..NONCRITICAL }, Normal),
        ("a limited rate", errors(ErrorCounts { queue_overflow: 1 << 40, ..ErrorCounts::default() }), Normal),
        ("failed writes", errors(ErrorCounts { write_failed: 3, ..ErrorCounts::default() }), Degraded),
    ];
    for (what, process, expected) in cases {
        assert_eq!(bench().last(process, 100), expected, "{what}");
    }
}

#[test]
fn a_restart_of_a_process_never_causes_emergency() {
    // Down for 3 s while its queue runs full, and then back with samples that have waited as long.
    for process in [CRITICAL, INGRESS] {
        let mut bench = bench();
        for silent_ms in [500, 1_000, 1_500, 2_000, 2_500, 3_000] {
            let down = ProcessLoad { silent_ms, queued: process.queue_capacity, ..process };
            assert_ne!(bench.last(down, 1), Emergency);
        }
        let errors = ErrorCounts { restarts: 1, queue_overflow: 40, ..ErrorCounts::default() };
        let back = ProcessLoad { writer_lag_ms: Some(3_000.0), queued: 60, errors, ..process };
        assert_ne!(bench.last(back, 1), Emergency);
        assert_eq!(bench.last(process, 12), Normal);
    }
}

#[test]
fn a_lane_that_hangs_until_its_watchdog_restarts_it_stops_no_other_and_not_itself() {
    // 200 Hz into a queue of 64, for the 2 s of the watchdog.
    for begins_in in [Normal, Degraded] {
        let mut bench = bench();
        if begins_in == Degraded {
            assert_eq!(bench.last(ProcessLoad { queued: 48, ..CRITICAL }, 3), Degraded);
        }
        for silent_ms in [300, 800, 1_300, 1_800, 2_300] {
            let hangs = ProcessLoad { silent_ms, queued: silent_ms / 5, ..CRITICAL };
            assert_eq!(bench.last(hangs, 1), begins_in, "{silent_ms} ms");
        }
        assert_eq!(bench.last(CRITICAL, 1), begins_in);
    }
}

#[test]
fn a_control_process_that_was_stopped_changes_nothing() {
    let mut bench = bench();
    let errors = ErrorCounts { queue_overflow: 400, write_failed: 100, ..ErrorCounts::default() };
    bench.now_ms += 3_600_000;
    assert_eq!(bench.last(ProcessLoad { silent_ms: 3_600_000, errors, ..EXTREME }, 1), Normal);
    assert_eq!(bench.last(CRITICAL, 1), Normal);
    assert_eq!(bench.supervisor.transitions(), 0);
}

#[test]
fn a_constant_difference_between_clocks_is_no_lag_and_growth_is() {
    let mut lag = SourceLag::default();
    for second in 0..600 {
        assert_eq!(lag.excess_ms(7_000.0, at_ms(second * 1_000)), Some(0.0));
    }
    let grown_ms = lag.excess_ms(9_000.0, at_ms(601_000)).unwrap();
    assert!((1_400.0..2_000.0).contains(&grown_ms), "{grown_ms}");
    // A new difference is forgiven after two minutes at most.
    let after: Vec<_> = (0..300).map(|s| lag.excess_ms(9_000.0, at_ms(602_000 + s * 1_000))).collect();
    assert!(after[0] > Some(1_000.0) && after[125..].iter().all(|excess| *excess == Some(0.0)), "{after:?}");
    assert_eq!(lag.excess_ms(10_001.0, at_ms(903_000)), None);
    assert_eq!(lag.excess_ms(-1.0, at_ms(903_000)), None);
    assert_eq!(lag.excess_ms(f64::NAN, at_ms(903_000)), None);
    assert_eq!(SourceLag::default().excess_ms(800.0, at_ms(500)), Some(0.0));
}

#[test]
fn the_minimum_lag_is_that_of_at_most_the_last_two_minutes() {
    // With a gap between two readings in which no sample arrived.
    for (gap_s, excess_ms) in [(60, 1_437.5), (90, 1_437.5), (120, 1_437.5), (121, 0.0)] {
        let mut lag = SourceLag::default();
        assert_eq!(lag.excess_ms(7_000.0, at_ms(0)), Some(0.0));
        // The histogram may have rounded up by 562.5 ms, a sixteenth.
        assert_eq!(lag.excess_ms(9_000.0, at_ms(gap_s * 1_000)), Some(excess_ms), "{gap_s} s");
    }
}

#[test]
fn the_worst_trouble_is_named_then_that_of_the_critical_path_then_the_first() {
    let second = ProcessLoad { name: "second", ..NEAR };
    let extreme = ProcessLoad { name: "extreme", ..EXTREME };
    let waiting = ProcessLoad { waiting: 51, ..NONCRITICAL };
    let slow = ProcessLoad { name: "slow", writer_lag_ms: Some(1e9), ..NONCRITICAL };
    for (processes, worst) in [
        ([waiting, NEAR], "critical"),
        ([NEAR, waiting], "critical"),
        ([NEAR, second], "critical"),
        ([NEAR, extreme], "extreme"),
        ([extreme, NEAR], "extreme"),
        ([waiting, slow], "noncritical"),
    ] {
        let cause = bench().next(&processes).cause.unwrap();
        assert_eq!(cause.process.as_str(), worst, "{processes:?}");
    }
}

#[test]
fn each_trouble_has_its_label() {
    let errors = ErrorCounts { write_failed: 100, ..ErrorCounts::default() };
    for (process, label) in [
        (ProcessLoad { queued: 64, ..CRITICAL }, "queue"),
        (ProcessLoad { waiting: 51, ..NONCRITICAL }, "waiting"),
        (ProcessLoad { source_lag_ms: Some(900.0), ..INGRESS }, "source_lag"),
        (NEAR, "writer_lag"),
        (ProcessLoad { errors, ..CRITICAL }, "errors"),
        (ProcessLoad { silent_ms: 2_000, ..CRITICAL }, "silent"),
    ] {
        assert_eq!(bench().next(&[process]).cause.unwrap().trouble.label(), label);
    }
}

#[test]
fn a_silent_noncritical_lane_counts_as_one_error_per_second() {
    let silent = ProcessLoad { silent_ms: 2_000, ..NONCRITICAL };
    for (degraded_errors_per_s, mode) in [(1.0, Degraded), (1.1, Normal)] {
        let rules = SafetyRules { degraded_errors_per_s, ..SafetyRules::default() };
        assert_eq!(Bench::new(rules).last(silent, 10), mode, "{degraded_errors_per_s}");
    }
}

#[test]
fn errors_between_two_evaluations_at_one_instant_have_no_rate() {
    let errors = ErrorCounts { write_failed: 1, ..ErrorCounts::default() };
    let mut supervisor = SafetySupervisor::default();
    for _ in 0..10 {
        let decision =
            supervisor.evaluate(&[ProcessLoad { errors, ..CRITICAL }], &SafetyRules::default(), at_ms(500));
        assert!(decision.clean, "{decision:?}");
    }
}

fn load(class: TrafficClass) -> impl Strategy<Value = ProcessLoad<'static>> {
    let count = prop_oneof![Just(0), 0..100_u64, any::<u64>()];
    let errors = prop::collection::vec(count.clone(), 4).prop_map(|n| ErrorCounts {
        write_failed: n[0],
        pool_exhausted: n[1],
        queue_overflow: n[2],
        restarts: n[3],
    });
    let lag = prop_oneof![Just(None), (-1e5..1e5).prop_map(Some), Just(Some(f64::NAN))];
    (errors, count.clone(), count.clone(), count.clone(), count, lag.clone(), lag).prop_map(
        move |(errors, silent_ms, queued, queue_capacity, waiting, source_lag_ms, writer_lag_ms)| {
            let name = "some";
            ProcessLoad {
                name,
                class,
                silent_ms,
                errors,
                queued,
                queue_capacity,
                waiting,
                source_lag_ms,
                writer_lag_ms,
            }
        },
    )
}

proptest! {
    #![proptest_config(config(256))]

    #[test]
    fn every_transition_takes_its_number_of_consecutive_readings(
        hysteresis_count in 0..5_u32,
        recovery_count in 0..8_u32,
        first: bool,
        levels in prop::collection::vec(0..3_usize, 1..300),
    ) {
        let rules = SafetyRules {
            hysteresis_count,
            recovery_count,
            overload_drop_noncritical_first: first,
            ..SafetyRules::default()
        };
        let (up, back) = (hysteresis_count.max(1) as usize, recovery_count.max(1) as usize);
        let mut bench = Bench::new(rules);
        // The levels of the readings since the last change of the mode.
        let mut since: Vec<usize> = Vec::new();
        for level in levels {
            let before = bench.supervisor.mode();
            let mode = bench.last([CRITICAL, NEAR, EXTREME][level], 1);
            since.push(level);
            let in_a_row = |accept: fn(usize) -> bool| since.iter().rev().take_while(|l| accept(**l)).count();
            let expected = match before {
                Normal if !first && in_a_row(|level| level == 2) >= up => Emergency,
                Normal if in_a_row(|level| level >= 1) >= up => Degraded,
                Degraded if in_a_row(|level| level == 2) >= up => Emergency,
                Degraded if in_a_row(|level| level == 0) >= back => Normal,
                Emergency if in_a_row(|level| level <= 1) >= back => Degraded,
                same => same,
            };
            prop_assert_eq!(mode, expected);
            if mode != before {
                since.clear();
            }
        }
    }

    #[test]
    fn noncritical_lanes_never_cause_emergency_whatever_they_report(
        first: bool,
        steps in prop::collection::vec(prop::collection::vec(load(Noncritical), 0..4), 1..60),
    ) {
        let rules = SafetyRules {
            hysteresis_count: 1,
            overload_drop_noncritical_first: first,
            ..SafetyRules::default()
        };
        let mut bench = Bench::new(rules);
        for processes in steps {
            let decision = bench.next(&processes);
            prop_assert_ne!(decision.mode, Emergency);
            prop_assert!(!decision.critical_trouble);
        }
    }

    #[test]
    fn recovery_to_normal_is_possible_after_any_report_of_the_critical_path(
        steps in prop::collection::vec(load(Critical), 1..60),
    ) {
        let mut bench = bench();
        for process in steps {
            bench.next(&[process]);
        }
        prop_assert_eq!(bench.last(CRITICAL, 20), Normal);
    }
}
