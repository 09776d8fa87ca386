//! Routes by pattern: which names match, against a plain definition; and which topics have a place, in
//! virtual time, while others are forged.

use std::collections::BTreeSet;

use adaptive_bridge::model::{Guid, MonotonicNs, TopicName, TopicPattern};
use adaptive_bridge::policy::{AWAY_MS, MAX_WAITING_TOPICS, RoutePlaces, TRIAL_MS};
use proptest::prelude::*;

/// The definition: a `**` takes none of the tokens, or the first one and then again.
fn matches(pattern: &[&str], topic: &[&str]) -> bool {
    match (pattern.split_first(), topic.split_first()) {
        (None, None) => true,
        (Some((&"**", after)), _) => {
            matches(after, topic) || topic.split_first().is_some_and(|(_, rest)| matches(pattern, rest))
        }
        (Some((token, after)), Some((name, rest))) => {
            (*token == "*" || token == name) && matches(after, rest)
        }
        _ => false,
    }
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 20_000,
        failure_persistence: None,
        ..ProptestConfig::default()
    })]

    #[test]
    fn a_pattern_matches_what_its_definition_says(
        pattern in prop::collection::vec(prop::sample::select(vec!["a", "b", "*", "**"]), 1..7),
        topic in prop::collection::vec(prop::sample::select(vec!["a", "b", "c"]), 1..8),
    ) {
        let text = format!("/{}", pattern.join("/"));
        let parsed = TopicPattern::try_from(text.as_str());
        prop_assert_eq!(parsed.is_ok(), !pattern.windows(2).any(|two| two == ["**", "**"]));
        if let Ok(parsed) = parsed {
            let name = format!("/{}", topic.join("/"));
            prop_assert_eq!(parsed.matches(&name), matches(&pattern, &topic), "{} {}", text, name);
        }
    }
}

fn topic(name: &str) -> TopicName {
    TopicName::try_from(format!("/{name}").as_str()).unwrap()
}

/// A writer of a participant.
fn writer(participant: u8, number: u16) -> Guid {
    let mut guid = [participant; 16];
    guid[13..15].copy_from_slice(&number.to_be_bytes());
    Guid(guid)
}

fn at(ms: u64) -> MonotonicNs {
    MonotonicNs(0).plus_ms(ms)
}

/// The topics that got a place.
fn bind_all(places: &mut RoutePlaces, now: MonotonicNs) -> Vec<String> {
    std::iter::from_fn(|| places.poll(now)).map(|binding| binding.topic.to_string()).collect()
}

#[test]
fn topics_get_free_places_in_the_order_of_their_discovery() {
    let mut places = RoutePlaces::new(2);
    assert!(places.writer_found(&topic("b"), writer(1, 1)));
    assert!(places.writer_found(&topic("a"), writer(1, 2)));
    assert!(places.writer_found(&topic("c"), writer(1, 3)));
    assert_eq!(bind_all(&mut places, at(0)), ["/b", "/a"]);
    assert_eq!(places.waiting(), (1, Some(&topic("c"))));
    assert_eq!(bind_all(&mut places, at(TRIAL_MS - 1)), [] as [&str; 0]);
}

#[test]
fn a_topic_without_samples_makes_room_after_its_trial_and_one_with_samples_does_not() {
    let mut places = RoutePlaces::new(2);
    for (number, name) in ["silent", "used", "next"].into_iter().enumerate() {
        places.writer_found(&topic(name), writer(1, number as u16));
    }
    assert_eq!(bind_all(&mut places, at(0)), ["/silent", "/used"]);
    places.samples_at(1, 1, at(100));
    assert_eq!(bind_all(&mut places, at(TRIAL_MS)), ["/next"]);
    assert_eq!([0, 1].map(|place| places.topic_at(place).unwrap().to_string()), ["/next", "/used"]);
    assert_eq!((places.released, places.waiting()), (1, (1, Some(&topic("silent")))));
    // A day later the topic with one sample still has its place: its writer is announced.
    places.samples_at(1, 1, at(86_400_000));
    assert_eq!(places.topic_at(1), Some(&topic("used")));
}

#[test]
fn topics_that_had_a_place_wait_behind_new_ones_in_the_order_in_which_they_lost_it() {
    let mut places = RoutePlaces::new(1);
    for (name, participant) in [("first", 1), ("second", 1), ("other", 2)] {
        places.writer_found(&topic(name), writer(participant, name.len() as u16));
    }
    let bound = |places: &mut RoutePlaces, trial| bind_all(places, at(trial * TRIAL_MS));
    assert_eq!(bound(&mut places, 0), ["/first"]);
    assert_eq!(bound(&mut places, 1), ["/other"], "its participant has no place");
    assert_eq!(bound(&mut places, 2), ["/second"]);
    places.writers_gone(|gone| gone == writer(1, "first".len() as u16));
    places.writer_found(&topic("new"), writer(3, 0));
    assert_eq!(bound(&mut places, 3), ["/new"]);
    assert_eq!(bound(&mut places, 4), ["/other"], "it lost its place before the second one did");
    assert_eq!(bound(&mut places, 5), ["/second"]);
}

#[test]
fn a_topic_that_was_used_makes_room_when_its_writers_have_been_away() {
    let mut places = RoutePlaces::new(1);
    places.writer_found(&topic("used"), writer(1, 1));
    bind_all(&mut places, at(0));
    places.samples_at(0, 5, at(50_000));
    places.writers_gone(|guid| guid == writer(1, 1));
    places.writer_found(&topic("next"), writer(2, 1));
    assert_eq!(places.poll(at(50_000 + AWAY_MS - 1)), None);
    // Samples that still arrive count as presence.
    places.samples_at(0, 6, at(60_000));
    assert_eq!(places.poll(at(50_000 + AWAY_MS)), None);
    assert_eq!(bind_all(&mut places, at(60_000 + AWAY_MS)), ["/next"]);
    assert!(!places.knows(&topic("used")), "it has no writer");
}

#[test]
fn a_place_that_is_resumed_keeps_its_topic() {
    let mut places = RoutePlaces::new(2);
    places.resume(1, topic("used"), 7, at(0));
    places.writer_found(&topic("other"), writer(1, 1));
    places.writer_found(&topic("used"), writer(1, 2));
    assert_eq!(bind_all(&mut places, at(0)), ["/other"]);
    assert_eq!(places.topic_at(1), Some(&topic("used")));
}

/// One participant announces 10,000 topics, forever anew; another one has a topic with samples from the
/// beginning, and a third one announces a topic with samples later.
#[test]
fn ten_thousand_forged_topics_displace_no_topic_in_use_and_delay_a_new_one_by_one_trial() {
    const PLACES: usize = 4;
    let mut places = RoutePlaces::new(PLACES);
    places.writer_found(&topic("flow"), writer(1, 1));
    assert_eq!(bind_all(&mut places, at(0)), ["/flow"]);
    let (mut changes, mut late_at, mut samples) = (0_usize, None, 0);
    let mut had_place = BTreeSet::new();
    for step in 0..3_000_u64 {
        let now_ms = step * 100;
        for forged in 0..40 {
            let number = (step * 40 + forged) % 10_000;
            places.writer_found(&topic(&format!("forged_{number}")), writer(9, number as u16));
        }
        if now_ms == 60_000 {
            assert!(places.writer_found(&topic("late"), writer(2, 1)), "the table of waiting topics is full");
        }
        samples += 1;
        for place in 0..PLACES {
            let is_used = matches!(places.topic_at(place).map(TopicName::as_str), Some("/flow" | "/late"));
            places.samples_at(place, if is_used { samples } else { 0 }, at(now_ms));
        }
        for bound in bind_all(&mut places, at(now_ms)) {
            changes += 1;
            assert_ne!(bound, "/flow");
            if bound == "/late" {
                assert_eq!(late_at.replace(now_ms), None, "it has kept its place");
            }
            had_place.insert(bound);
        }
        assert_eq!(places.topic_at(0), Some(&topic("flow")));
        assert!(places.waiting().0 <= MAX_WAITING_TOPICS);
    }
    let late_at = late_at.unwrap();
    assert!((60_000..=60_000 + TRIAL_MS).contains(&late_at), "{late_at}");
    let most = PLACES * (300_000 / TRIAL_MS as usize + 1);
    assert!(changes <= most, "{changes} changes of at most {most}");
    assert!(places.forgotten > 9_000, "{}", places.forgotten);
    assert!(had_place.len() > 50, "{}", had_place.len());
}
