//! The processes of a bridge (ingress, egress, control, responder, supervisor), each from its start to its
//! end. Only this module connects DDS and shared memory to policy.
//!
//! A process runs a loop of turns. A turn handles the samples and messages that have arrived; then the
//! process sleeps until it is woken or until its next housekeeping. Housekeeping is the work that is not
//! needed for each sample: discovery, matching, logs, health.

mod allocator;
mod blocked;
mod control;
mod count_log;
mod egress;
mod error;
mod identity;
mod in_force;
mod ingress;
mod kept_sockets;
mod lane_override;
mod memory;
mod memory_limit;
mod notify;
mod parameter_store;
mod place;
pub mod probes;
mod reload;
mod responder;
mod role;
mod scheduling;
mod socket_store;
mod standby;
mod stop;
mod successor;
mod supervisor;
#[cfg(test)]
mod test_role;

pub use allocator::bound_free_memory;
pub use control::control;
pub use egress::{egress, end_standby, end_unused};
pub use error::RoleError;
pub use in_force::{InForce, InForceError};
pub use ingress::ingress;
pub use lane_override::set_mode;
pub use memory::{MemoryNeed, MemoryNeeds};
pub use reload::{HangUp, ReloadAnswer, ReloadRequests, ReloadResult, reload_all};
pub use responder::{ResponderOptions, responder};
pub use stop::{Stop, abort_on_panic};
pub use supervisor::{SupervisorError, end_with_supervisor, up};

/// Interval of housekeeping. A process checks for a request to stop at least this often, so that it ends
/// within a second of one.
const HOUSEKEEPING_MS: u64 = 100;
