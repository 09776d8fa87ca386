//! Which signed messages were seen before.

use std::collections::BTreeSet;

use crate::model::{ProbeRefusal, WallNs};

/// Messages remembered: those of the default window, 30 s, of 64 senders at 20 Hz, and some more. They take
/// 3 MiB at most.
const REMEMBERED: usize = 65_536;

/// Admits each signed message once. Time is an argument, and may step back: what was seen is forgotten for
/// want of room only, the oldest first, and nothing older than what was forgotten is admitted any more.
#[derive(Debug)]
pub(super) struct Replays {
    window_ns: u64,
    /// By the time of sending, so that the oldest is at hand.
    seen: BTreeSet<(WallNs, [u8; 16])>,
    /// When the latest of the forgotten was sent.
    forgotten: Option<WallNs>,
    capacity: usize,
}

impl Replays {
    /// Admits messages that were sent within `window_ms` of now, before or after.
    pub fn new(window_ms: u64) -> Self {
        let window_ns = window_ms.saturating_mul(1_000_000);
        Self { window_ns, seen: BTreeSet::new(), forgotten: None, capacity: REMEMBERED }
    }

    /// Admits a message by its nonce and time of sending, whose signature is known to be good.
    ///
    /// # Errors
    /// Expired or replayed.
    pub fn admit(&mut self, nonce: [u8; 16], sent: WallNs, now: WallNs) -> Result<(), ProbeRefusal> {
        if sent.0.abs_diff(now.0) > self.window_ns {
            return Err(ProbeRefusal::Expired);
        }
        // A clock that stepped back by more than is remembered would have everything refused. It is the same
        // as after a restart, which remembers nothing either.
        if self.forgotten.is_some_and(|forgotten| forgotten.0 > now.0.saturating_add(self.window_ns)) {
            self.seen.clear();
            self.forgotten = None;
        }
        if self.forgotten.is_some_and(|forgotten| sent <= forgotten) {
            return Err(ProbeRefusal::Expired);
        }
        if !self.seen.insert((sent, nonce)) {
            return Err(ProbeRefusal::Replayed);
        }
        if self.seen.len() > self.capacity {
            let oldest = self.seen.pop_first();
            self.forgotten = oldest.map(|(sent, _)| sent);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: u64 = 1_000_000_000;

    fn nonce(number: u64) -> [u8; 16] {
        u128::from(number).to_be_bytes()
    }

    #[test]
    fn a_message_is_admitted_once_and_within_the_window() {
        let mut replays = Replays::new(1_000);
        let now = WallNs(100 * SECOND);
        assert_eq!(replays.admit(nonce(1), now, now), Ok(()));
        assert_eq!(replays.admit(nonce(1), now, now), Err(ProbeRefusal::Replayed));
        assert_eq!(replays.admit(nonce(2), WallNs(99 * SECOND), now), Ok(()));
        assert_eq!(replays.admit(nonce(3), WallNs(101 * SECOND), now), Ok(()));
        assert_eq!(replays.admit(nonce(4), WallNs(99 * SECOND - 1), now), Err(ProbeRefusal::Expired));
        assert_eq!(replays.admit(nonce(5), WallNs(101 * SECOND + 1), now), Err(ProbeRefusal::Expired));
    }

    #[test]
    fn a_clock_that_steps_back_makes_nothing_seen_new_again() {
        let mut replays = Replays::new(1_000);
        for second in 100..200 {
            let now = WallNs(second * SECOND);
            assert_eq!(replays.admit(nonce(second), now, now), Ok(()));
        }
        for second in 100..200 {
            let now = WallNs(second * SECOND);
            assert_eq!(replays.admit(nonce(second), now, now), Err(ProbeRefusal::Replayed));
            assert_eq!(replays.admit(nonce(second + 1_000), now, now), Ok(()));
        }
    }

    #[test]
    fn memory_is_bounded_and_what_was_forgotten_stays_out() {
        let mut replays = Replays { capacity: 10, ..Replays::new(60_000) };
        let now = WallNs(100 * SECOND);
        for number in 0..100 {
            assert_eq!(replays.admit(nonce(number), WallNs(now.0 + number), now), Ok(()));
            assert!(replays.seen.len() <= 10);
        }
        for number in 0..100 {
            let again = replays.admit(nonce(number), WallNs(now.0 + number), now);
            let expected = if number < 90 { ProbeRefusal::Expired } else { ProbeRefusal::Replayed };
            assert_eq!(again, Err(expected), "{number}");
        }
    }

    #[test]
    fn a_clock_that_steps_back_far_locks_nobody_out() {
        let mut replays = Replays { capacity: 2, ..Replays::new(1_000) };
        for second in 1_000..1_010 {
            let now = WallNs(second * SECOND);
            assert_eq!(replays.admit(nonce(second), now, now), Ok(()));
        }
        let back = WallNs(10 * SECOND);
        assert_eq!(replays.admit(nonce(1), back, back), Ok(()));
        assert_eq!(replays.admit(nonce(1), back, back), Err(ProbeRefusal::Replayed));
    }
}
