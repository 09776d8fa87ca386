//! Replays and floods.

use std::collections::BTreeSet;

use adaptive_bridge::model::WallNs;
use adaptive_bridge::policy::{Admission, IDLE_SENDER_MS, ReplayGuard, SenderLimits};
use proptest::prelude::*;

use super::{MS, at_ms, config};

fn wall(ms: u64) -> WallNs {
    WallNs((1_763_000_000_000 + ms) * MS)
}

fn nonce(number: u8) -> [u8; 16] {
    [number; 16]
}

#[test]
fn a_message_is_admitted_once_and_within_the_window_only() {
    let mut guard = ReplayGuard::new(30_000, 100);
    assert_eq!(guard.admit(nonce(1), wall(0), wall(5)), Admission::Fresh);
    assert_eq!(guard.admit(nonce(1), wall(0), wall(6)), Admission::Replayed);
    assert_eq!(guard.admit(nonce(2), wall(0), wall(30_000)), Admission::Fresh);
    assert_eq!(guard.admit(nonce(1), wall(0), wall(30_001)), Admission::TooOld);
    assert_eq!(guard.admit(nonce(3), wall(70_000), wall(40_000)), Admission::Fresh);
    assert_eq!(guard.admit(nonce(4), wall(70_001), wall(40_000)), Admission::Ahead);
}

#[test]
fn a_guard_with_the_memory_of_another_admits_nothing_twice_in_a_wider_window() {
    let mut former = ReplayGuard::new(1_000, 100);
    assert_eq!(former.admit(nonce(1), wall(0), wall(0)), Admission::Fresh);
    assert_eq!(former.admit(nonce(2), wall(1_500), wall(1_500)), Admission::Fresh);
    let mut guard = ReplayGuard::new(30_000, 100).remembering(former);
    assert_eq!(guard.admit(nonce(2), wall(1_500), wall(2_000)), Admission::Replayed);
    assert_eq!(guard.admit(nonce(1), wall(0), wall(2_000)), Admission::Forgotten);
    assert_eq!(guard.admit(nonce(3), wall(1_000), wall(20_000)), Admission::Fresh);
}

#[test]
fn messages_may_overtake_each_other() {
    let mut guard = ReplayGuard::new(30_000, 100);
    for (number, sent_ms) in [(1, 40), (2, 20), (3, 30), (4, 10)] {
        assert_eq!(guard.admit(nonce(number), wall(sent_ms), wall(50)), Admission::Fresh);
    }
    for (number, sent_ms) in [(1, 40), (2, 20), (3, 30), (4, 10)] {
        assert_eq!(guard.admit(nonce(number), wall(sent_ms), wall(50)), Admission::Replayed);
    }
}

#[test]
fn a_message_older_than_the_oldest_kept_one_is_refused() {
    let mut guard = ReplayGuard::new(30_000, 4);
    for number in 0..10 {
        assert_eq!(guard.admit(nonce(number), wall(u64::from(number)), wall(20)), Admission::Fresh);
    }
    assert_eq!(guard.len(), 4);
    assert_eq!(guard.admit(nonce(5), wall(5), wall(20)), Admission::Forgotten);
    assert_eq!(guard.admit(nonce(6), wall(6), wall(20)), Admission::Replayed);
}

#[test]
fn a_clock_that_steps_forth_and_back_lets_no_replay_in() {
    let mut guard = ReplayGuard::new(30_000, 100);
    assert_eq!(guard.admit(nonce(1), wall(0), wall(0)), Admission::Fresh);
    assert_eq!(guard.admit(nonce(2), wall(3_600_000), wall(3_600_000)), Admission::Fresh);
    assert_eq!(guard.admit(nonce(1), wall(0), wall(10)), Admission::Forgotten);
    // A new message is admitted.
    assert_eq!(guard.admit(nonce(3), wall(10), wall(10)), Admission::Fresh);
}

proptest! {
    #![proptest_config(config(256))]

    #[test]
    fn no_message_is_admitted_twice_whatever_the_clock_does(
        capacity in 0..20_usize,
        window_ms in 0..2_000_u64,
        steps in prop::collection::vec((0..40_u8, 0..3_000_u64, 0..3_000_u64), 1..400),
    ) {
        let mut guard = ReplayGuard::new(window_ms, capacity);
        let mut admitted = BTreeSet::new();
        for (number, sent_ms, now_ms) in steps {
            let sent_ms = sent_ms / 100 * 100;
            if guard.admit(nonce(number), wall(sent_ms), wall(now_ms)) == Admission::Fresh {
                prop_assert!(admitted.insert((number, sent_ms)));
                prop_assert!(sent_ms.abs_diff(now_ms) <= window_ms);
            }
            prop_assert!(guard.len() <= capacity.max(1));
        }
    }
}

#[test]
fn messages_held_up_by_an_outage_are_within_the_burst_and_a_flood_is_not() {
    let mut limits = SenderLimits::with_burst(20.0, 10.0, 8, at_ms(0));
    assert!((0..100).all(|_| limits.allow("laptop", at_ms(0))), "the responses of 5 s of probes at 20 Hz");
    let flood = (0..10_000_u64).filter(|number| limits.allow("forger", at_ms(number / 10))).count();
    assert!((203..=224).contains(&flood), "{flood} in one second");
    assert!(limits.allow("laptop", at_ms(1_000)));
}

#[test]
fn each_sender_has_its_own_rate() {
    let mut limits = SenderLimits::new(20.0, 8, at_ms(0));
    // One sender floods, another one sends at 5 Hz.
    let (mut flood, mut honest) = (0, 0);
    for ms in 0..10_000 {
        flood += u32::from(limits.allow(1, at_ms(ms)));
        if ms % 200 == 0 {
            honest += u32::from(limits.allow(2, at_ms(ms)));
        }
    }
    assert_eq!(honest, 50);
    assert!((200..=204).contains(&flood), "{flood}");
}

#[test]
fn a_flood_from_many_names_costs_as_much_as_a_few_senders() {
    let mut limits = SenderLimits::new(20.0, 8, at_ms(0));
    let (mut flood, mut honest) = (0, 0);
    for ms in 0..100_000_u64 {
        if ms % 200 == 0 {
            honest += u32::from(limits.allow(u64::MAX, at_ms(ms)));
        }
        flood += u32::from(limits.allow(ms, at_ms(ms)));
    }
    assert_eq!(honest, 500, "it keeps its place");
    assert_eq!(limits.len(), 8);
    // 20 Hz for all senders without a place, and 7 new places after each period of idleness.
    let places = 8 * (100_000 / IDLE_SENDER_MS as u32 + 1);
    assert!(flood <= 2_000 + 4 + places, "{flood}");
}

#[test]
fn a_sender_without_a_burst_starts_with_one_message() {
    let mut limits = SenderLimits::new(20.0, 8, at_ms(0));
    assert!(limits.is_empty());
    let allowed = [0, 0, 49, 50, 50].map(|ms| limits.allow("laptop", at_ms(ms)));
    assert_eq!(allowed, [true, false, false, true, false]);
    assert!(!limits.is_empty());
}

#[test]
fn a_sender_keeps_its_place_until_it_was_silent_for_longer_than_the_limit() {
    // A new place allows one message, and the bucket that senders without a place share has two tokens by
    // then.
    let messages_of_a_second_sender = |after_ms: u64| {
        let mut limits = SenderLimits::new(1.0, 1, at_ms(0));
        assert!(limits.allow("first", at_ms(0)));
        (0..10).filter(|_| limits.allow("second", at_ms(after_ms))).count()
    };
    assert_eq!(messages_of_a_second_sender(IDLE_SENDER_MS), 2, "without a place");
    assert_eq!(messages_of_a_second_sender(IDLE_SENDER_MS + 1), 1, "in the place of the first");
}

#[test]
fn another_rate_applies_to_senders_with_and_without_a_place() {
    let mut limits = SenderLimits::new(20.0, 1, at_ms(0));
    assert!(limits.allow("known", at_ms(0)) && limits.allow("other", at_ms(0)));
    limits.set_rate(2.0, at_ms(0));
    for sender in ["known", "other", "known"] {
        assert!(!limits.allow(sender, at_ms(499)), "{sender}");
    }
    assert!(limits.allow("known", at_ms(500)) && limits.allow("other", at_ms(500)));
    let replaced_ms = 501 + IDLE_SENDER_MS;
    let of_a_new_one = [0, 499, 500].map(|ms| limits.allow("new", at_ms(replaced_ms + ms)));
    assert_eq!(of_a_new_one, [true, false, true]);
}
