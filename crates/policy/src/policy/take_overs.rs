//! When a standby kills an active process that is stopped or hangs, and when take-overs are too many.

use crate::model::{MonotonicNs, StandbyRecord, TakeOverCause};

/// The shortest time between two take-overs that a standby causes. A process that has taken an identity over
/// leaves none if it ends within a second.
const PAUSE_MS: u64 = 1_500;

/// How long an active process may make no progress. It completes a turn every 100 ms even without samples,
/// and stops doing so up to 250 ms after a thread of the DDS library has hung.
const HANG_MS: u64 = 500;
/// More for each route: a turn may create an endpoint or a connection of each.
const HANG_MS_PER_ROUTE: u64 = 10;
/// The most, after several take-overs in a row: the limit of the watchdogs of systemd and `up`.
const MAX_HANG_MS: u64 = 2_000;

/// How long a thread of an active process may have work and not run. The kernel runs one that is woken within
/// microseconds, or it is ready to run, which does not count.
const BLOCKED_MS: u64 = 12;
/// Several take-overs in a row double it so many times at most, to 384 ms.
const MAX_BLOCKED_DOUBLINGS: u64 = 5;

/// The longest time between two take-overs in a row.
const IN_A_ROW_MS: u64 = 60_000;

/// How many take-overs in a row are a storm.
const STORM: u64 = 5;

/// Whether a standby may kill a process that is stopped or hangs, `now`, when its role was last taken over at
/// `taken_over_at` (0: never). A program that stops each process causes at most 40 take-overs a minute.
pub const fn may_fence(taken_over_at: MonotonicNs, now: MonotonicNs) -> bool {
    taken_over_at.0 == 0 || now.since(taken_over_at) >= PAUSE_MS * 1_000_000
}

/// How long the active process of a role in a bridge with so many `routes` may make no progress, `now`,
/// before its standby kills it, in milliseconds. Each take-over in a row doubles it: if the machine is so
/// slow that working processes are killed, they are so less and less often.
pub fn hang_limit_ms(record: &StandbyRecord, routes: usize, now: MonotonicNs) -> u64 {
    let doublings = recent_in_a_row(record, now).min(2);
    let once_ms = (routes as u64).saturating_mul(HANG_MS_PER_ROUTE).saturating_add(HANG_MS);
    (once_ms.min(MAX_HANG_MS) << doublings).min(MAX_HANG_MS)
}

/// How long a thread of the active process of a role may have work and not run, `now`, before the standby
/// kills the process, in milliseconds. Each take-over in a row doubles it.
pub fn blocked_limit_ms(record: &StandbyRecord, now: MonotonicNs) -> u64 {
    BLOCKED_MS << recent_in_a_row(record, now).min(MAX_BLOCKED_DOUBLINGS)
}

/// How many take-overs have followed each other within a minute, with one that happens `now` for `cause`
/// after those of `former`. A process that was asked to end hands over without a fault, which does not count.
pub fn take_overs_in_a_row(former: &StandbyRecord, cause: TakeOverCause, now: MonotonicNs) -> u64 {
    recent_in_a_row(former, now).saturating_add((cause != TakeOverCause::HandedOver).into())
}

/// Whether the active process of a role fails again and again, `now`: subscribers miss no sample as long as a
/// standby is there in time, but its start takes longer than the process lives.
pub const fn is_take_over_storm(record: &StandbyRecord, now: MonotonicNs) -> bool {
    is_recent(record, now) && record.in_a_row >= STORM
}

/// How many take-overs have followed each other, if the last one was within a minute.
const fn recent_in_a_row(record: &StandbyRecord, now: MonotonicNs) -> u64 {
    if is_recent(record, now) { record.in_a_row } else { 0 }
}

const fn is_recent(record: &StandbyRecord, now: MonotonicNs) -> bool {
    record.taken_over_at.0 != 0 && now.since(record.taken_over_at) <= IN_A_ROW_MS * 1_000_000
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> MonotonicNs {
        MonotonicNs(0).plus_ms(ms)
    }

    #[test]
    fn a_stopped_process_is_not_killed_soon_after_a_take_over() {
        assert!(may_fence(MonotonicNs(0), at(1)));
        assert!(!may_fence(at(1), at(1_500)));
        assert!(may_fence(at(1), at(1_501)));
    }

    #[test]
    fn the_time_without_progress_doubles_with_take_overs_and_grows_with_routes() {
        let limit_ms = |in_a_row, routes, ms| {
            let record = StandbyRecord { taken_over_at: at(1), in_a_row, ..StandbyRecord::default() };
            hang_limit_ms(&record, routes, at(ms))
        };
        assert_eq!(
            [0, 1, 2, 3, u64::MAX].map(|in_a_row| limit_ms(in_a_row, 0, 60_001)),
            [500, 1_000, 2_000, 2_000, 2_000]
        );
        assert_eq!(limit_ms(3, 0, 60_002), 500, "a minute has passed");
        assert_eq!(
            [1, 60, 1_024, usize::MAX].map(|routes| limit_ms(0, routes, 60_001)),
            [510, 1_100, 2_000, 2_000]
        );
    }

    #[test]
    fn the_time_in_which_a_thread_with_work_may_sleep_doubles_with_take_overs() {
        let limit_ms = |in_a_row, ms| {
            let record = StandbyRecord { taken_over_at: at(1), in_a_row, ..StandbyRecord::default() };
            blocked_limit_ms(&record, at(ms))
        };
        assert_eq!(
            [0, 1, 2, 5, 6, u64::MAX].map(|in_a_row| limit_ms(in_a_row, 60_001)),
            [12, 24, 48, 384, 384, 384]
        );
        assert_eq!(limit_ms(3, 60_002), 12, "a minute has passed");
    }

    #[test]
    fn five_take_overs_each_within_a_minute_are_a_storm_until_a_minute_has_passed() {
        use TakeOverCause::{Ended, HandedOver, Stopped};

        let mut record = StandbyRecord::default();
        let mut take_over = |cause, ms| {
            let in_a_row = take_overs_in_a_row(&record, cause, at(ms));
            record = StandbyRecord { taken_over_at: at(ms), in_a_row, ..record };
            record
        };
        assert_eq!(take_over(HandedOver, 1).in_a_row, 0);
        for number in 1..=4 {
            let record = take_over(if number % 2 == 0 { Ended } else { Stopped }, number * 60_000);
            assert_eq!(record.in_a_row, number);
            assert!(!is_take_over_storm(&record, record.taken_over_at));
        }
        assert!(!is_take_over_storm(&take_over(HandedOver, 270_000), at(270_000)));
        let fifth = take_over(Ended, 330_000);
        assert_eq!(fifth.in_a_row, 5);
        assert!(is_take_over_storm(&fifth, at(390_000)) && !is_take_over_storm(&fifth, at(390_001)));
        assert_eq!(take_over(Ended, 390_001).in_a_row, 1);
    }
}
