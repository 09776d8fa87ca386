//! Drops in the log: each reason with its count, and not more often than an operator can read.

use tracing::warn;

use crate::model::{DropCounts, DropReason, MonotonicNs};

/// A reason is logged at once when it is new, and at most every 10 s while it goes on.
const REPEAT_MS: u64 = 10_000;

/// Watches the drops of one route in one process.
#[derive(Debug)]
pub(super) struct DropWatch {
    logged: DropCounts,
    next_at: [MonotonicNs; DropReason::COUNT],
}

impl DropWatch {
    /// Begins at `counts`: what a former process dropped is not news.
    pub fn new(counts: DropCounts) -> Self {
        Self { logged: counts, next_at: [MonotonicNs(0); DropReason::COUNT] }
    }

    /// Logs what is new in `counts`. `expected` reasons are how the lane works and are not logged.
    pub fn look(
        &mut self,
        counts: &DropCounts,
        route: &str,
        lane: &str,
        expected: &[DropReason],
        now: MonotonicNs,
    ) {
        for &reason in DropReason::ALL {
            let dropped = counts.get(reason).saturating_sub(self.logged.get(reason));
            if dropped == 0 || expected.contains(&reason) || now < self.next_at[reason as usize] {
                continue;
            }
            warn!(route, lane, reason = reason.label(), dropped, "{}", advice(reason));
            self.logged.add(reason, dropped);
            self.next_at[reason as usize] = now.plus_ms(REPEAT_MS);
        }
    }
}

/// What a reason means and what to do about it.
const fn advice(reason: DropReason) -> &'static str {
    match reason {
        DropReason::TooLarge => "samples dropped: larger than the route's max_sample_bytes; raise it",
        DropReason::PoolExhausted => "samples dropped: no free slot in shared memory; raise queue_depth",
        DropReason::Malformed => {
            "samples dropped: the publisher sends an encapsulation that DDS does not know"
        }
        DropReason::IngressDied => "samples lost: an ingress process died while it had them",
        DropReason::QueueOverflow => {
            "samples lost: the lane was too slow to take them; raise its queue_depth"
        }
        DropReason::LaneDown => "samples lost: published while no process served the lane",
        DropReason::NoWriter => "samples dropped: the message type is not known yet",
        DropReason::WindowFull => {
            "samples dropped: a reader does not acknowledge and the window is full; see `status` for the \
             readers"
        }
        DropReason::WriteFailed => "samples dropped: the DDS library refused them",
        DropReason::Stale => "samples dropped: older than stale_threshold_ms; are the clocks in step?",
        DropReason::Superseded => "samples superseded by fresher ones",
        DropReason::QueueFull => "samples dropped: the lane's queue is full",
        DropReason::Suspended => "samples dropped: the lane is suspended",
        DropReason::Stopped => "samples dropped: forwarding is stopped",
        DropReason::Shutdown => "samples dropped: still waiting at shutdown",
    }
}
