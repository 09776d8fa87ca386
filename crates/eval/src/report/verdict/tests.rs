//! Tests of verdicts on synthetic runs.

use super::*;
use crate::report::made_up::{MadeUp, results};

const READINGS: [&str; 2] = ["as-printed", "as-run"];

fn finding(runs: &[MadeUp], index: usize) -> Finding {
    findings(&results(runs)).swap_remove(index)
}

fn baselines(reading: &'static str, rate_hz: f64, tail_ms: f64) -> Vec<MadeUp> {
    let mut runs = vec![MadeUp::default()];
    for scenario in ["baseline_mild", "baseline_moderate", "baseline_strong"] {
        runs.push(MadeUp { scenario, reading, rate_hz, tail_ms, ..MadeUp::default() });
    }
    runs
}

#[test]
fn h1_is_confirmed_for_the_reading_in_which_all_rules_hold() {
    let runs = baselines("as-run", 20.0, 12_000.0);
    let [printed, run] = [finding(&runs, 0), finding(&runs, 1)];
    assert_eq!((printed.verdict, run.verdict), (Verdict::NotTested, Verdict::Confirmed), "{run:?}");
    assert_eq!(run.criteria.len(), 6);
    assert!(
        run.because.contains("rate degraded at every level, critical latency at every level"),
        "{}",
        run.because
    );
    // Runs that are missing on the other library are listed.
    assert!(run.missing.contains(&"baseline_strong as run on Cyclone DDS".to_owned()), "{:?}", run.missing);
    assert!(!run.missing.iter().any(|one| one.contains("as printed")), "{:?}", run.missing);
}

#[test]
fn h1_is_partly_confirmed_or_contradicted() {
    assert_eq!(finding(&baselines("as-run", 20.0, 0.9), 1).verdict, Verdict::Partly);
    let none = finding(&baselines("as-printed", 30.0, 0.95), 0);
    assert_eq!(none.verdict, Verdict::Contradicted);
    assert!(none.because.contains("rate degraded at no level"), "{}", none.because);
    // The limits: 5 % of the rate, ten times the latency.
    assert_eq!(finding(&baselines("as-run", 28.6, 8.9), 1).verdict, Verdict::Contradicted);
    assert_eq!(finding(&baselines("as-run", 28.4, 9.1), 1).verdict, Verdict::Confirmed);
    // One level is not enough for "contradicted", and without a clean run there is no verdict.
    let some: Vec<MadeUp> = baselines("as-run", 30.0, 0.9).into_iter().take(2).collect();
    assert_eq!(finding(&some, 1).verdict, Verdict::NotSeen);
    assert_eq!(finding(&baselines("as-run", 20.0, 12_000.0)[1..], 1).verdict, Verdict::NotTested);
}

#[test]
fn h1_is_partly_confirmed_if_a_rule_does_not_hold_at_one_place() {
    let mut runs = baselines("as-run", 20.0, 12_000.0);
    runs.push(MadeUp { library: "cyclone", ..MadeUp::default() });
    let there = MadeUp { library: "cyclone", reading: "as-run", rate_hz: 20.0, ..MadeUp::default() };
    runs.push(MadeUp { scenario: "baseline_strong", tail_ms: 12_000.0, ..there.clone() });
    assert_eq!(finding(&runs, 1).verdict, Verdict::Confirmed);
    runs.push(MadeUp { scenario: "baseline_mild", ..there });
    assert_eq!(finding(&runs, 1).verdict, Verdict::Partly);
}

#[test]
fn the_longest_silence_is_that_of_one_run_and_no_median() {
    let mut runs = baselines("as-run", 20.0, 12_000.0);
    for lost in [0, 59] {
        runs.push(MadeUp { scenario: "baseline_strong", reading: "as-run", lost, ..runs[1].clone() });
    }
    let found = finding(&runs, 1);
    assert!(found.because.contains("without a critical sample 2."), "{}", found.because);
}

#[test]
fn h1_compares_with_the_clean_baseline_of_the_other_switch_if_there_is_no_other() {
    let mut runs = baselines("as-run", 20.0, 12_000.0);
    for run in &mut runs[1..] {
        run.switch = "reassembling";
    }
    let found = finding(&runs, 1);
    assert_eq!((found.verdict, found.criteria.len()), (Verdict::Confirmed, 6), "{found:?}");
    assert!(found.because.contains("switch that reassembles fragments: rate"), "{}", found.because);
    // That of the same switch comes first: its rate is as low.
    let own = MadeUp { switch: "reassembling", rate_hz: 20.0, ..MadeUp::default() };
    let found = finding(&[&runs[..], &[own]].concat(), 1);
    assert_eq!(found.verdict, Verdict::Partly, "{found:?}");
    assert!(found.because.contains("rate degraded at no level"), "{}", found.because);
    // One of another library does not count.
    runs[0].library = "cyclone";
    assert_eq!(finding(&runs, 1).verdict, Verdict::NotTested);
}

/// All runs that H2 and H3 require.
fn bridges() -> Vec<MadeUp> {
    let mut runs = Vec::new();
    for library in ["fast", "cyclone"] {
        let clean = MadeUp { library, ..MadeUp::default() };
        runs.push(clean.clone());
        runs.push(MadeUp {
            scenario: "bridge_clean",
            latency_ms: 0.8,
            tail_ms: 1.2,
            toggles: vec![],
            ..clean.clone()
        });
        for reading in READINGS {
            let bridge = |scenario| MadeUp {
                scenario,
                reading,
                latency_ms: 0.8,
                tail_ms: 1.25,
                lane_bytes_per_s: 9_000,
                reaction_s: Some(2.0),
                ..clean.clone()
            };
            runs.extend(["bridge_mild", "bridge_moderate", "bridge_strong"].map(bridge));
            runs.push(MadeUp { lane_bytes_per_s: 30_000, reaction_s: None, ..bridge("bridge_ablation") });
            let toggles = vec![(20.0, true), (40.0, false), (60.0, true)];
            runs.push(MadeUp { toggles, length_s: 80, reaction_s: Some(11.0), ..bridge("bridge_toggle") });
        }
    }
    runs
}

fn change(runs: &mut [MadeUp], scenario: &str, change: impl Fn(&mut MadeUp)) {
    let run = runs.iter_mut().find(|run| run.scenario == scenario).unwrap();
    change(run);
}

#[test]
fn h2_is_confirmed_if_all_scenarios_were_run_and_all_rules_hold() {
    let found = finding(&bridges(), 2);
    assert_eq!(found.verdict, Verdict::Confirmed, "{found:?}");
    assert!(found.missing.is_empty());
    let mut fewer = bridges();
    fewer.retain(|run| run.library == "fast");
    let found = finding(&fewer, 2);
    assert_eq!(found.verdict, Verdict::Incomplete);
    assert!(found.missing.contains(&"bridge_clean on Cyclone DDS".to_owned()), "{:?}", found.missing);
    assert_eq!(finding(&[MadeUp::default()], 2).verdict, Verdict::NotTested);
}

#[test]
fn each_rule_of_h2_can_fail() {
    type Change = fn(&mut MadeUp);
    let cases: [(&str, Change, &str); 4] = [
        (
            "bridge_mild",
            |run| run.rate_hz = 29.9,
            "the rate is 30.0 ± 0.0 Hz does not hold in 1 of 22 places",
        ),
        (
            "bridge_mild",
            |run| run.lost = 1,
            "no critical sample is lost does not hold in 1 of 22 places: 1 of 600 lost",
        ),
        (
            "bridge_toggle",
            |run| run.tail_ms = 1.4,
            "at most 10 % above the clean bridge's does not hold in 1 of 16",
        ),
        ("bridge_clean", |run| run.tail_ms = 1.4, "the bridge adds at most 0.4 ms"),
    ];
    for (scenario, how, because) in cases {
        let mut runs = bridges();
        change(&mut runs, scenario, how);
        let found = finding(&runs, 2);
        assert_eq!(found.verdict, Verdict::Partly, "{scenario}");
        assert!(found.because.contains(because), "{}", found.because);
    }
}

#[test]
fn h3_depends_on_the_bytes_that_the_lane_sends_and_on_every_toggle() {
    let found = finding(&bridges(), 3);
    assert_eq!(found.verdict, Verdict::Confirmed, "{found:?}");
    assert!(found.criteria.iter().any(|one| one.found.starts_with("70 % saved")), "{:?}", found.criteria);

    let mut wasteful = bridges();
    change(&mut wasteful, "bridge_moderate", |run| run.lane_bytes_per_s = 12_000);
    assert_eq!(finding(&wasteful, 3).verdict, Verdict::Partly);

    let mut slow = bridges();
    change(&mut slow, "bridge_toggle", |run| run.reaction_s = Some(19.9));
    assert_eq!(finding(&slow, 3).verdict, Verdict::Confirmed);
    // A reaction after the next toggle does not count.
    change(&mut slow, "bridge_toggle", |run| run.reaction_s = Some(21.0));
    let found = finding(&slow, 3);
    assert_eq!(found.verdict, Verdict::Partly);
    assert!(found.because.contains("no reaction to"), "{}", found.because);
}

#[test]
fn lanes_that_send_fragments_are_coupled_below_dds() {
    assert_eq!(finding(&bridges(), 4).verdict, Verdict::Incomplete);
    let mut runs = bridges();
    for run in &mut runs {
        run.switch = "reassembling";
    }
    assert_eq!(finding(&runs, 4).verdict, Verdict::Confirmed);
    change(&mut runs, "bridge_strong", |run| run.fragments_per_s = 3);
    let found = finding(&runs, 4);
    assert_eq!(found.verdict, Verdict::Partly);
    assert!(found.because.contains("60 fragments"), "{}", found.because);
}

#[test]
fn a_smoke_run_gives_no_verdict() {
    let mut runs = bridges();
    runs.extend(baselines("as-run", 20.0, 12_000.0));
    change(&mut runs, "bridge_mild", |run| run.quick = true);
    assert!(findings(&results(&runs)).iter().all(|found| found.verdict == Verdict::NotTested));
}

#[test]
fn the_mechanism_follows_from_the_figures() {
    let all = results(&baselines("as-run", 30.0, 0.9));
    let cell = all.cells().find(|cell| cell.scenario == "baseline_mild").unwrap();
    let text = mechanism(cell).unwrap();
    assert!(text.starts_with("The writer's history did not fill: at most"), "{text}");
    assert!(text.ends_with("The switch held no fragments, so it dropped nothing of the critical path."));
    // Each number is the lost samples of a repetition, in which two publish calls of 600 fail.
    for (lost, expected) in [
        (&[0, 0, 0][..], "ms after they were written, and each one that the writer took."),
        (&[1], "ms after they were written, and missed 1 that the writer took."),
        (&[0, 0, 5], "ms after they were written, and missed 5 that the writer took."),
        (&[1, 2, 5], "ms after they were written, and missed 8 that the writer took."),
    ] {
        let run = |&lost| MadeUp { scenario: "baseline_mild", lost, failed: 2, ..MadeUp::default() };
        let all = results(&lost.iter().map(run).collect::<Vec<_>>());
        let text = mechanism(all.cells().next().unwrap()).unwrap();
        let calls = format!("0 of {} publish calls blocked and {} failed.", 600 * lost.len(), 2 * lost.len());
        assert!(text.replace(',', "").contains(&calls), "{text}");
        assert!(text.contains(expected), "{lost:?}: {text}");
        // Five lost samples at 30 Hz are six periods without one.
        let gap = if lost.contains(&5) { "for up to 0.2 s" } else { "for up to 0.1 s" };
        assert!(text.contains(gap), "{lost:?}: {text}");
    }
    // A lane's writer is BEST_EFFORT and holds no samples.
    let all = results(&bridges());
    assert!(all.cells().filter(|cell| cell.bridge).all(|cell| mechanism(cell).is_none()));
}
