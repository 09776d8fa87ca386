//! Decisions without side effects: no IO, no clock, no threads, no logs; the time is an argument.
//!
//! The types of the data plane allocate only on construction and when their configuration changes.

mod absences;
mod blocked;
mod catch_up;
mod classifier;
mod clock_offset;
mod cut_through;
mod intruders;
mod lane;
mod lane_mode;
mod lane_queue;
mod locality;
mod memory_budget;
mod probe_window;
mod publisher_places;
mod replay_guard;
mod restart;
mod route_places;
mod safety;
mod sequence;
mod staleness;
mod take_overs;
mod token_bucket;
mod warnings;

pub use absences::{
    Absence, AbsenceEvent, AbsenceWatch, HostInterface, MAX_WATCHED_PEERS, REMEMBER_ABSENCE_MS,
};
pub use blocked::BlockedWatch;
pub use catch_up::CatchUp;
pub use classifier::{
    FORGET_UNLISTED_MS, MIN_SETTLED, SubscriberClassifier, Transition, TransitionReason, is_forgotten,
};
pub use clock_offset::ClockOffset;
pub use cut_through::{MIN_CUT_THROUGH_BYTES, begins_early, step_bytes};
pub use intruders::{
    Guarded, GuardedTopic, Intruder, IntruderEvent, IntruderWatch, MAX_GUARDED_TOPICS,
    MAX_REMEMBERED_INTRUDERS, NODE_NAME_TIMEOUT_MS, REMEMBER_MS,
};
pub use lane::{Decision, PollOrder, RouteShaper, critical_drop, mode_and_source};
pub use lane_mode::{LaneDecision, LaneReason, lane_mode, safety_floor};
pub use lane_queue::{Allowance, LaneQueue, SampleStamps};
pub use locality::{Locality, Location};
pub use memory_budget::{BudgetRefusal, MemoryBudget, PoolDemand};
pub use probe_window::{LinkReading, MAX_OUTSTANDING, ProbeTotals, ProbeWindow, ResponseOutcome, STOPPED_NS};
pub use publisher_places::{PUBLISHER_SILENT_MS, publisher_place};
pub use replay_guard::{Admission, IDLE_SENDER_MS, ReplayGuard, SenderLimits};
pub use restart::{
    ChildExit, FIRST_BACKOFF_MS, GiveUpReason, HEALTHY_RUN_MS, HEALTHY_RUN_WITH_STANDBY_MS, HangWatch,
    MAX_BACKOFF_MS, RestartBackoff, RestartDecision,
};
pub use route_places::{AWAY_MS, Binding, MAX_TOPIC_WRITERS, MAX_WAITING_TOPICS, RoutePlaces, TRIAL_MS};
pub use safety::{
    ErrorCounts, MAX_SOURCE_LAG_MS, ProcessLoad, SafetyCause, SafetyDecision, SafetySupervisor,
    SafetyTrouble, SourceLag,
};
pub use sequence::{SequenceOutcome, SequenceTracker};
pub use staleness::{age_ns, is_stale};
pub use take_overs::{blocked_limit_ms, hang_limit_ms, is_take_over_storm, may_fence, take_overs_in_a_row};
pub use token_bucket::{BURST_WINDOW_NS, ByteBudget, MAX_RATE_HZ, TokenBucket, burst_for};
pub use warnings::{SubscriberWarnings, WarningThresholds};
