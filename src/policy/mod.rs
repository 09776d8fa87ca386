//! Pure decisions: no IO, no clock, no threads, no logs; time is an argument.
//!
//! Those of the data plane allocate when they are made and never afterwards.
//!
//! - [`TokenBucket`] and [`ByteBudget`]: when a rate allows the next sample.
//! - [`age_ns`] and [`is_stale`]: how old a sample is.
//! - [`LaneQueue`]: which samples wait, and which give way.
//! - [`RouteShaper`]: those three together, for one route on a noncritical lane.
//! - [`critical_drop`] and [`effective_mode`]: what a mode does to a critical sample, and which mode applies.
//! - [`SequenceTracker`]: what the number of a sample says about those that are missing.
//! - [`IntruderWatch`]: which readers on other hosts reach past the bridge, and what to say of them.
//! - [`Location`]: whether a DDS endpoint is on this host.
//! - [`RestartBackoff`]: when a supervised child is started again.

mod intruders;
mod lane;
mod lane_queue;
mod restart;
mod sequence;
mod staleness;
mod token_bucket;
mod whereabouts;

pub use intruders::{
    Guarded, GuardedTopic, Intruder, IntruderCounts, IntruderEvent, IntruderWatch, MAX_REMEMBERED_INTRUDERS,
    NODE_PATIENCE_MS, REMEMBER_MS,
};
pub use lane::{Decision, RouteShaper, TurnOrder, critical_drop, effective_mode};
pub use lane_queue::{Allowance, LaneQueue, Stamps};
pub use restart::{
    ChildExit, FIRST_BACKOFF_MS, GOOD_RUN_MS, GiveUpReason, MAX_BACKOFF_MS, RestartBackoff, RestartDecision,
};
pub use sequence::{SequenceTracker, Sighting};
pub use staleness::{age_ns, is_stale};
pub use token_bucket::{BURST_WINDOW_NS, ByteBudget, MAX_RATE_HZ, TokenBucket, burst_for};
pub use whereabouts::{Location, Whereabouts};
