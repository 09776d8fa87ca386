//! Shared memory: passes samples, wake-ups, counters and policies between the processes of one bridge.
//!
//! - [`ShmNode`]: the membership of a process in a bridge instance; cleans up after dead processes.
//! - [`RouteChannel`], [`SamplePublisher`], [`SampleSubscriber`]: the samples of one route, in a pool of
//!   slots (iceoryx2 publish-subscribe).
//! - [`BacklogKeeper`]: samples that ingress keeps for a lane that restarts.
//! - [`PoolBudget`]: the shared memory that the pools of all routes may take.
//! - [`LaneWaker`], [`LaneSleeper`]: ingress wakes a lane.
//! - [`Boards`]: latest values that readers poll without waiting: health, counters, latencies, policy.
//! - [`Journal`]: what the process of a lane has discovered, for the next one.
//! - [`RoleLock`]: lets at most one process serve a role; [`RoleHolder`]: names that process.
//! - [`InForceShare`]: the configuration in force, which exists as long as any process of the bridge runs.
//!
//! The public interface has no types of iceoryx2. Any process may be killed, stopped or restarted at any
//! moment; `docs/decisions/0004-shared-memory.md` describes how each primitive tolerates that.

mod backlog;
mod board;
mod budget;
mod cell;
mod channel;
mod error;
mod header;
mod in_force;
mod journal;
mod lock;
mod membership;
mod node;
mod pool_view;
mod publisher;
mod roles;
mod root;
mod segment;
mod send_log;
mod service;
mod subscriber;
mod wake;

pub use backlog::{BacklogKeeper, read_backlog};
pub use board::{
    BoardWriter, Boards, BridgeShape, HistogramWriter, Policies, ProcessRole, Stage, write_rows,
};
pub use budget::{
    DEFAULT_BUDGET_BYTES, NoMemory, PoolBudget, PoolUse, backlog_bytes, budget_bytes, most_backlog_bytes,
};
pub use channel::{OTHER_SHARED_BYTES, PoolSize, QueueLimits, RouteChannel};
pub use error::ShmError;
pub use header::HeaderError;
pub use in_force::{BridgeAddress, InForceFile, InForceShare};
pub use journal::Journal;
pub use node::{CleanUp, ShmNode};
pub use pool_view::{PoolPayload, PoolView};
pub use publisher::{LentSlot, LoanError, PublishError, SamplePublisher, Slot};
pub use roles::{RoleHolder, RoleLock, instance_files};
pub use root::{default_root, root_of};
pub use send_log::SendLog;
pub use subscriber::{SampleSubscriber, ShmSample, SubscriberRole, TakeError};
pub use wake::{LaneObserver, LaneSleeper, LaneWaker, Woken, this_cpu};
