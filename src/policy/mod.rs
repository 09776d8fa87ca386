//! Pure decisions: no IO, no clock, no threads, no logs; time is an argument.
//!
//! Those of the data plane allocate when they are made and never afterwards.
//!
//! - [`TokenBucket`] and [`ByteBudget`]: when a rate allows the next sample.
//! - [`age_ns`] and [`is_stale`]: how old a sample is.
//! - [`ClockOffset`]: whether a publisher's clock disagrees with ours.
//! - [`LaneQueue`]: which samples wait, and which give way.
//! - [`RouteShaper`]: those three together, for one route on a noncritical lane.
//! - [`critical_drop`] and [`effective_mode`]: what a mode does to a critical sample, and which mode applies.
//! - [`SequenceTracker`]: what the number of a sample says about those that are missing.
//! - [`publisher_place`]: which publisher's account gives way when another one comes.
//! - [`ProbeWindow`]: what the probes say about the link to one subscriber.
//! - [`SubscriberClassifier`]: the state of one subscriber.
//! - [`lane_mode()`] and [`safety_floor`]: the mode of a lane, and why; the mildest that safety leaves it.
//! - [`SafetySupervisor`]: the mode of the whole bridge.
//! - [`ReplayGuard`] and [`SenderLimits`]: which control messages are acted on, and how many are looked at.
//! - [`SubscriberWarnings`]: which figures of a subscriber are worth a warning.
//! - [`IntruderWatch`]: which readers on other hosts reach past the bridge, and what to say of them.
//! - [`AbsenceWatch`]: which network interfaces and peers on other hosts are away.
//! - [`Location`]: whether a DDS endpoint is on this host.
//! - [`RestartBackoff`]: when a supervised child is started again.

mod absences;
mod classifier;
mod clock_offset;
mod intruders;
mod lane;
mod lane_mode;
mod lane_queue;
mod probe_window;
mod publisher_places;
mod replay_guard;
mod restart;
mod safety;
mod sequence;
mod staleness;
mod token_bucket;
mod warnings;
mod whereabouts;

pub use absences::{
    Absence, AbsenceEvent, AbsenceWatch, HostInterface, MAX_WATCHED_PEERS, REMEMBER_ABSENCE_MS,
};
pub use classifier::{
    FORGET_UNLISTED_MS, MIN_SETTLED, SubscriberClassifier, Transition, TransitionReason, is_forgotten,
};
pub use clock_offset::ClockOffset;
pub use intruders::{
    Guarded, GuardedTopic, Intruder, IntruderCounts, IntruderEvent, IntruderWatch, MAX_REMEMBERED_INTRUDERS,
    NODE_PATIENCE_MS, REMEMBER_MS,
};
pub use lane::{Decision, RouteShaper, TurnOrder, critical_drop, effective_mode};
pub use lane_mode::{LaneDecision, LaneReason, lane_mode, safety_floor};
pub use lane_queue::{Allowance, LaneQueue, Stamps};
pub use probe_window::{Answer, LinkReading, MAX_OUTSTANDING, ProbeTotals, ProbeWindow, STOPPED_NS};
pub use publisher_places::{PUBLISHER_SILENT_MS, publisher_place};
pub use replay_guard::{Admission, IDLE_SENDER_MS, ReplayGuard, SenderLimits};
pub use restart::{
    ChildExit, FIRST_BACKOFF_MS, GOOD_RUN_MS, GiveUpReason, MAX_BACKOFF_MS, RestartBackoff, RestartDecision,
};
pub use safety::{
    ErrorCounts, MAX_SOURCE_LAG_MS, ProcessLoad, SafetyCause, SafetyDecision, SafetyInputs, SafetySupervisor,
    SafetyTrouble, SourceLag,
};
pub use sequence::{SequenceTracker, Sighting};
pub use staleness::{age_ns, is_stale};
pub use token_bucket::{BURST_WINDOW_NS, ByteBudget, MAX_RATE_HZ, TokenBucket, burst_for};
pub use warnings::{SubscriberWarnings, WarningThresholds};
pub use whereabouts::{Location, Whereabouts};
