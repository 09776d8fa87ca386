//! The reason why samples are missing.

use super::*;

#[test]
fn missing_samples_have_the_reason_why_the_lane_did_not_get_them() {
    use DropReason::{IngressDied, LaneDown, QueueOverflow};
    let mut host = Host::start(131, CRITICAL, SCAN);
    let mut output = host.open();
    let started = output.started_at;
    let (before, after) = (MonotonicNs(started.0 - 1_000_000), started.plus_ms(1));
    // Whether a sample was taken since the start, when ingress was restarted, when the next sample was
    // published.
    for (caught_up, restarted_at, published_at, reason) in [
        (false, None, before, LaneDown),
        (false, None, after, LaneDown),
        (true, None, after, QueueOverflow),
        (true, None, before, QueueOverflow),
        (false, Some(before), before, LaneDown),
        (false, Some(before), started, IngressDied),
        (false, Some(before), after, IngressDied),
        (true, Some(before), after, IngressDied),
        (true, Some(after), started, QueueOverflow),
    ] {
        for has_housekeeping in [false, true] {
            host.role.boards.health_writer(ProcessRole::Ingress).update(|health| {
                health.starts = output.ingress_starts + u64::from(restarted_at.is_some());
                health.started_at = restarted_at.unwrap_or(before);
            });
            output.ingress_restarted_at = None;
            if has_housekeeping {
                output.housekeeping(&mut host.participant, after);
            }
            output.caught_up = caught_up;
            output.tracker = SequenceTracker::resume(10, 20);
            output.counters.update(|counters| *counters = LaneCounters::default());
            let next = SampleHeader { published_at, ..header(24) };
            output.count_missing(3, &next);
            let what = format!("{caught_up} {restarted_at:?} {published_at:?} {has_housekeeping}");
            let counters = output.counters.get();
            assert_eq!((counters.drops.get(reason), counters.drops.total()), (3, 3), "{what}");
            assert_eq!((counters.first_sequence, counters.last_sequence), (10, 23), "{what}");
            output.follow_restarts(&next);
            let is_over = restarted_at.is_none_or(|restarted_at| published_at >= restarted_at);
            assert_eq!(output.ingress_restarted_at.is_none(), is_over || !has_housekeeping, "{what}");
        }
    }
}
