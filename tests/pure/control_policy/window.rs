//! The window of probes: which probes count, and that each probe has exactly one outcome.

use adaptive_bridge::model::{ClassifierThresholds, MonotonicNs, SubscriberState};
use adaptive_bridge::policy::{MAX_OUTSTANDING, ProbeWindow, ResponseOutcome, SubscriberClassifier};
use proptest::prelude::*;

use super::{MS, at_ms, config};

/// A window with one answered probe: probe 0 was sent at 0 and answered after 10 ms.
fn open_window(window_size: usize) -> ProbeWindow {
    let mut window = ProbeWindow::new(window_size, 500);
    window.sent(0, at_ms(0));
    assert_eq!(window.answered(0, at_ms(10)), ResponseOutcome::Counted { rtt_ns: 10 * MS });
    window
}

fn is_accounted_for(window: &ProbeWindow) -> bool {
    let totals = window.totals();
    totals.sent == totals.answered + totals.lost + totals.excused + window.outstanding() as u64
}

#[test]
fn a_probe_is_lost_after_its_timeout_and_not_before() {
    let mut window = open_window(50);
    window.sent(1, at_ms(200));
    assert_eq!(window.reading(at_ms(700)).settled, 1);
    let reading = window.reading(MonotonicNs(700 * MS + 1));
    assert_eq!((reading.settled, reading.answered, reading.lost), (2, 1, 1));
    assert_eq!(reading.loss, 0.5);
    assert_eq!(window.answered(1, at_ms(701)), ResponseOutcome::Late);
    assert_eq!(window.reading(at_ms(701)).lost, 1);
}

#[test]
fn answers_count_once_and_only_for_probes_that_were_sent() {
    let mut window = open_window(50);
    assert_eq!(window.answered(0, at_ms(20)), ResponseOutcome::Repeated);
    assert_eq!(window.answered(7, at_ms(20)), ResponseOutcome::Unknown);
    assert_eq!(window.answered(u64::MAX, at_ms(20)), ResponseOutcome::Unknown);
    assert_eq!(window.totals().answered, 1);
}

#[test]
fn rtt_and_jitter_are_those_of_the_window() {
    let mut window = ProbeWindow::new(4, 500);
    for (seq, rtt_ms) in [400, 10, 20, 40, 30].into_iter().enumerate() {
        let sent_ms = seq as u64 * 500;
        window.sent(seq as u64, at_ms(sent_ms));
        window.answered(seq as u64, at_ms(sent_ms + rtt_ms));
    }
    let reading = window.reading(at_ms(2_500));
    assert_eq!((reading.settled, reading.full, reading.loss), (4, true, 0.0));
    assert_eq!(reading.rtt_mean_ms, Some(25.0));
    assert_eq!(reading.rtt_p95_ms, Some(40.0));
    assert_eq!(reading.jitter_ms, Some(40.0 / 3.0));
}

#[test]
fn a_subscriber_that_never_answered_has_no_data_and_one_that_stops_answering_has_loss() {
    let mut window = ProbeWindow::new(50, 500);
    for seq in 0..100 {
        window.sent(seq, at_ms(seq * 200));
    }
    let reading = window.reading(at_ms(60_000));
    assert_eq!((reading.settled, reading.loss, reading.rtt_mean_ms), (0, 0.0, None));
    assert!(window.last_response_at().is_none() && is_accounted_for(&window));
    // A probe before the first answered one does not count.
    window.sent(100, at_ms(60_000));
    window.sent(101, at_ms(60_200));
    window.answered(101, at_ms(60_210));
    assert_eq!(window.answered(100, at_ms(60_220)), ResponseOutcome::Late);
    assert_eq!(window.reading(at_ms(61_000)).loss, 0.0);
    for seq in 102..152 {
        window.sent(seq, at_ms(60_400 + seq * 200));
    }
    let reading = window.reading(at_ms(120_000));
    assert_eq!((reading.settled, reading.loss, reading.rtt_mean_ms), (50, 1.0, None));
    assert_eq!(window.last_response_at(), Some(at_ms(60_220)));
}

#[test]
fn a_subscriber_whose_answers_are_all_late_has_loss() {
    let mut window = ProbeWindow::new(50, 500);
    for seq in 0..40 {
        window.sent(seq, at_ms(seq * 200));
        if seq >= 3 {
            assert_eq!(window.answered(seq - 3, at_ms(seq * 200 + 50)), ResponseOutcome::Late);
        }
    }
    let reading = window.reading(at_ms(8_500));
    assert!(reading.settled >= 30 && reading.loss == 1.0, "{reading:?}");
}

#[test]
fn probes_pending_while_the_control_process_was_stopped_are_excused() {
    let mut window = open_window(50);
    // One probe is lost before the stop, one is outstanding at its beginning, one is sent at its end.
    window.sent(1, at_ms(200));
    window.sent(2, at_ms(900));
    window.excuse_pause(at_ms(1_000), at_ms(61_000));
    assert_eq!(window.answered(2, at_ms(61_001)), ResponseOutcome::Late);
    let reading = window.reading(at_ms(61_100));
    assert_eq!((reading.answered, reading.lost), (1, 1));
    window.sent(3, at_ms(61_200));
    assert_eq!(window.answered(3, at_ms(61_203)), ResponseOutcome::Counted { rtt_ns: 3 * MS });
    assert_eq!(window.totals().excused, 1);
    assert!(is_accounted_for(&window));
}

#[test]
fn a_restarted_numbering_excuses_pending_probes() {
    let mut window = open_window(50);
    window.sent(1_000_000, at_ms(200));
    window.sent(0, at_ms(300));
    assert_eq!(window.answered(1_000_000, at_ms(310)), ResponseOutcome::Unknown);
    assert_eq!(window.answered(0, at_ms(310)), ResponseOutcome::Counted { rtt_ns: 10 * MS });
    let reading = window.reading(at_ms(2_000));
    assert_eq!((reading.answered, reading.lost, window.totals().excused), (2, 0, 1));
}

#[test]
fn pending_probes_beyond_the_window_are_lost_oldest_first() {
    let mut window = ProbeWindow::new(10, 60_000);
    window.sent(0, at_ms(0));
    window.answered(0, at_ms(0));
    for seq in 1..20_000 {
        window.sent(seq, at_ms(1));
    }
    assert_eq!(window.outstanding(), MAX_OUTSTANDING + 64);
    assert_eq!(window.totals().lost, 19_999 - (MAX_OUTSTANDING + 64) as u64);
    assert_eq!(window.reading(at_ms(1)).loss, 1.0);
    assert!(is_accounted_for(&window));
}

#[test]
fn responses_to_the_newest_64_settled_probes_are_recognized() {
    let mut window = open_window(50);
    let send = |window: &mut ProbeWindow, seqs: std::ops::Range<u64>| {
        for seq in seqs {
            window.sent(seq, at_ms(20));
            window.answered(seq, at_ms(30));
        }
    };
    send(&mut window, 1..100);
    assert_eq!(window.answered(36, at_ms(40)), ResponseOutcome::Repeated);
    assert_eq!(window.answered(35, at_ms(40)), ResponseOutcome::Unknown);
    // An outstanding probe keeps the later ones in the list.
    window.sent(100, at_ms(40));
    send(&mut window, 101..300);
    assert_eq!(window.answered(101, at_ms(50)), ResponseOutcome::Repeated);
    assert_eq!(window.answered(100, at_ms(50)), ResponseOutcome::Counted { rtt_ns: 10 * MS });
    assert_eq!(window.answered(236, at_ms(50)), ResponseOutcome::Repeated);
    assert_eq!(window.answered(235, at_ms(50)), ResponseOutcome::Unknown);
}

#[test]
fn new_limits_apply_to_pending_probes_and_keep_the_newest_results() {
    let mut window = ProbeWindow::new(50, 500);
    for seq in 0..50 {
        window.sent(seq, at_ms(seq * 100));
        window.answered(seq, at_ms(seq * 100 + seq));
    }
    window.set_limits(10, 50);
    let reading = window.reading(at_ms(5_000));
    assert_eq!((reading.settled, reading.rtt_mean_ms), (10, Some(44.5)));
    window.sent(50, at_ms(5_000));
    assert_eq!(window.reading(at_ms(5_051)).lost, 1);
    window.set_limits(0, 50);
    assert_eq!(window.reading(at_ms(5_051)).settled, 1);
}

#[test]
fn a_stopped_control_process_demotes_no_subscriber() {
    let thresholds = ClassifierThresholds::default();
    let mut window = ProbeWindow::new(50, 500);
    let mut classifier = SubscriberClassifier::default();
    let mut now_ms = 0;
    for seq in 0..2_000 {
        let before_ms = now_ms;
        // Every 100th turn is 40 s late.
        now_ms += if seq % 100 == 99 { 40_000 } else { 200 };
        if now_ms - before_ms > 300 {
            window.excuse_pause(at_ms(before_ms + 200), at_ms(now_ms));
            window.answered(seq - 1, at_ms(now_ms));
        }
        window.sent(seq, at_ms(now_ms));
        if seq % 100 != 98 {
            window.answered(seq, at_ms(now_ms + 8));
        }
        if seq % 2 == 0 {
            classifier.evaluate(&window.reading(at_ms(now_ms + 10)), &thresholds, None);
        }
    }
    assert_eq!(classifier.state(&thresholds), SubscriberState::Critical);
    assert_eq!(classifier.transitions(), 1);
    assert_eq!(window.totals().lost, 0);
}

#[derive(Clone, Debug)]
enum Step {
    Send { ahead: u64 },
    SendAgain { seq: u64 },
    Answer { back: u64 },
    AnswerAny { seq: u64 },
    Stop { ms: u64 },
    Limits { window_size: usize, timeout_ms: u64 },
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        8 => prop_oneof![Just(1), 1..1_000_u64].prop_map(|ahead| Step::Send { ahead }),
        1 => any::<u64>().prop_map(|seq| Step::SendAgain { seq }),
        6 => (0..8_u64).prop_map(|back| Step::Answer { back }),
        1 => any::<u64>().prop_map(|seq| Step::AnswerAny { seq }),
        1 => (0..5_000_u64).prop_map(|ms| Step::Stop { ms }),
        1 => (0..100_usize, 0..2_000_u64).prop_map(|(window_size, timeout_ms)| {
            Step::Limits { window_size, timeout_ms }
        }),
    ]
}

proptest! {
    #![proptest_config(config(256))]

    #[test]
    fn every_probe_is_accounted_for(
        window_size in 0..60_usize,
        steps in prop::collection::vec((step(), 0..700_u64), 1..300),
    ) {
        let mut window = ProbeWindow::new(window_size, 500);
        let mut limit = window_size.max(1);
        let (mut now_ms, mut seq) = (0, 0_u64);
        let mut counted = 0;
        for (step, wait_ms) in steps {
            now_ms += wait_ms;
            let now = at_ms(now_ms);
            let answer = match step {
                Step::Send { ahead } => {
                    seq = seq.saturating_add(ahead);
                    window.sent(seq, now);
                    None
                }
                Step::SendAgain { seq: again } => {
                    seq = again;
                    window.sent(seq, now);
                    None
                }
                Step::Answer { back } => Some(window.answered(seq.saturating_sub(back), now)),
                Step::AnswerAny { seq } => Some(window.answered(seq, now)),
                Step::Stop { ms } => {
                    now_ms += ms;
                    window.excuse_pause(now, at_ms(now_ms));
                    None
                }
                Step::Limits { window_size, timeout_ms } => {
                    limit = window_size.max(1);
                    window.set_limits(window_size, timeout_ms);
                    None
                }
            };
            counted += u64::from(matches!(answer, Some(ResponseOutcome::Counted { .. })));
            prop_assert!(is_accounted_for(&window), "{window:?}");
            let reading = window.reading(at_ms(now_ms));
            prop_assert!(is_accounted_for(&window));
            prop_assert_eq!(reading.settled, reading.answered + reading.lost);
            prop_assert!(reading.settled <= limit);
            prop_assert!((0.0..=1.0).contains(&reading.loss));
            prop_assert_eq!(window.totals().answered, counted);
            prop_assert_eq!(reading.rtt_mean_ms.is_some(), reading.answered > 0);
        }
    }

    /// Compares with a plain count, for a link that answers each probe after some time or never.
    #[test]
    fn loss_and_mean_rtt_are_those_of_the_newest_probes(
        fates in prop::collection::vec(prop::option::weighted(0.8, 0..500_u64), 10..200),
    ) {
        let mut window = open_window(50);
        let mut events: Vec<(u64, u8, u64)> = Vec::new();
        for (index, fate) in fates.iter().enumerate() {
            let (seq, sent_ms) = (index as u64 + 1, index as u64 * 200 + 200);
            events.push((sent_ms, 0, seq));
            events.extend(fate.map(|rtt_ms| (sent_ms + rtt_ms, 1, seq)));
        }
        events.sort_unstable();
        for (ms, kind, seq) in events {
            if kind == 0 {
                window.sent(seq, at_ms(ms));
            } else {
                let counted = matches!(window.answered(seq, at_ms(ms)), ResponseOutcome::Counted { .. });
                prop_assert!(counted);
            }
        }
        let reading = window.reading(at_ms(1_000_000));
        prop_assert_eq!(reading.settled, (fates.len() + 1).min(50));
        let totals = window.totals();
        prop_assert_eq!(totals.lost, fates.iter().filter(|fate| fate.is_none()).count() as u64);
        prop_assert_eq!(totals.excused, 0);
        if fates.len() < 50 {
            let rtts: Vec<u64> = fates.iter().flatten().copied().chain([10]).collect();
            let mean_ms = rtts.iter().sum::<u64>() as f64 / rtts.len() as f64;
            prop_assert!((reading.rtt_mean_ms.unwrap() - mean_ms).abs() < 1e-9);
            prop_assert_eq!(reading.lost as u64, totals.lost);
        }
    }
}
