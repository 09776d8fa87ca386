//! Changes of states and modes: their number, their delay after a cause, and the time in a state.

/// A record of a state from a time on.
#[derive(Clone, Debug, PartialEq)]
pub struct Change<S> {
    /// The time, in seconds.
    pub at_s: f64,
    /// The state from then on.
    pub to: S,
}

/// The number of transitions to another state. The first record is none, nor is a record of the same state
/// again. The paper's harness counts in the same way.
pub fn transitions<S: PartialEq>(changes: &[Change<S>]) -> usize {
    changes.windows(2).filter(|pair| pair[0].to != pair[1].to).count()
}

/// The reaction of the classifier to a toggle of the link.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reaction {
    /// When the link was switched, in seconds.
    pub toggled_at_s: f64,
    /// Whether the toggle impaired the link; otherwise it restored the link.
    pub impaired: bool,
    /// Time from the toggle to the expected state, in seconds; 0 if that was the state before; `None` if it
    /// was not reached before the next toggle or the end of the run.
    pub after_s: Option<f64>,
}

/// Finds how soon after each toggle, `(time, whether impaired)` in order, the state was the expected one:
/// `demoted` after an impairment, otherwise `promoted`. Later changes before the next toggle are ignored.
pub fn reactions<S: PartialEq>(
    toggles: &[(f64, bool)],
    changes: &[Change<S>],
    demoted: &S,
    promoted: &S,
    end_s: f64,
) -> Vec<Reaction> {
    toggles
        .iter()
        .enumerate()
        .map(|(index, &(toggled_at_s, impaired))| {
            let until = toggles.get(index + 1).map_or(end_s, |next| next.0);
            let expected = if impaired { demoted } else { promoted };
            let before = changes.iter().rev().find(|change| change.at_s <= toggled_at_s);
            let after_s = if before.is_some_and(|change| change.to == *expected) {
                Some(0.0)
            } else {
                let within = |change: &&Change<S>| change.at_s > toggled_at_s && change.at_s < until;
                let first = changes.iter().filter(within).find(|change| change.to == *expected);
                first.map(|change| change.at_s - toggled_at_s)
            };
            Reaction { toggled_at_s, impaired, after_s }
        })
        .collect()
}

/// The share of the time from `from_s` to `to_s` that was spent in a state, 0 to 1. The time before the first
/// record counts for no state.
pub fn share_in<S: PartialEq>(changes: &[Change<S>], state: &S, from_s: f64, to_s: f64) -> f64 {
    let mut spent = 0.0;
    for (index, change) in changes.iter().enumerate() {
        let until = changes.get(index + 1).map_or(to_s, |next| next.at_s);
        if change.to == *state {
            spent += (until.min(to_s) - change.at_s.max(from_s)).max(0.0);
        }
    }
    if to_s > from_s { spent / (to_s - from_s) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn changes(list: &[(f64, char)]) -> Vec<Change<char>> {
        list.iter().map(|&(at_s, to)| Change { at_s, to }).collect()
    }

    #[test]
    fn only_changes_to_another_state_are_transitions() {
        assert_eq!(transitions::<char>(&[]), 0);
        assert_eq!(transitions(&changes(&[(0.0, 'u')])), 0);
        assert_eq!(transitions(&changes(&[(0.0, 'u'), (1.0, 'u'), (2.0, 'c'), (3.0, 'n'), (4.0, 'n')])), 2);
    }

    #[test]
    fn the_reaction_is_the_first_expected_state_before_the_next_toggle() {
        let states = changes(&[
            (0.0, 'u'),
            (3.0, 'c'),
            (72.0, 'n'),
            (75.0, 'c'),
            (76.0, 'n'),
            (131.5, 'c'),
            (250.0, 'n'),
        ]);
        let toggles = [(60.0, true), (120.0, false), (180.0, true)];
        let found = reactions(&toggles, &states, &'n', &'c', 240.0);
        let after: Vec<Option<f64>> = found.iter().map(|reaction| reaction.after_s).collect();
        assert_eq!(after, [Some(12.0), Some(11.5), None]);
        assert_eq!(found[0], Reaction { toggled_at_s: 60.0, impaired: true, after_s: Some(12.0) });
        // The state was the expected one before the toggle.
        let found = reactions(&[(10.0, false)], &states, &'n', &'c', 60.0);
        assert_eq!(found[0].after_s, Some(0.0));
        assert_eq!(reactions(&[(1.0, true)], &[], &'n', &'c', 60.0)[0].after_s, None);
    }

    #[test]
    fn the_share_of_time_in_a_state_matches_that_calculated_by_hand() {
        let modes = changes(&[(0.0, 'n'), (20.0, 'd'), (80.0, 'n')]);
        assert_eq!(share_in(&modes, &'d', 0.0, 100.0), 0.6);
        assert_eq!(share_in(&modes, &'d', 10.0, 30.0), 0.5);
        assert_eq!(share_in(&modes, &'n', 90.0, 100.0), 1.0);
        assert_eq!(share_in(&modes, &'n', 5.0, 5.0), 0.0);
        assert_eq!(share_in(&changes(&[(5.0, 'd')]), &'d', 0.0, 10.0), 0.5);
    }

    proptest! {
        #[test]
        fn a_reaction_lies_between_its_toggle_and_the_next(
            at in proptest::collection::vec((0.0..240.0_f64, 0..3_u8), 0..40),
        ) {
            let mut states: Vec<Change<u8>> = at.into_iter().map(|(at_s, to)| Change { at_s, to }).collect();
            states.sort_by(|one, other| one.at_s.total_cmp(&other.at_s));
            let toggles = [(60.0, true), (120.0, false), (180.0, true)];
            for reaction in reactions(&toggles, &states, &0, &1, 240.0) {
                prop_assert!(reaction.after_s.is_none_or(|after_s| (0.0..60.0).contains(&after_s)));
            }
            let shares: f64 = (0..3).map(|state| share_in(&states, &state, 0.0, 240.0)).sum();
            prop_assert!((0.0..=1.0 + 1e-9).contains(&shares));
        }
    }
}
