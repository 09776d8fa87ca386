//! The roles: what each process of a bridge does from its start to its end. The only place where the edges
//! meet policy.
//!
//! A role is a loop of turns. A turn handles what is there and then sleeps until it is woken, or until the
//! next housekeeping, which is all that need not happen for each sample: discovery, matching, logs, health.

mod arena;
mod control;
mod egress;
mod in_force;
mod inbox;
mod ingress;
mod manual;
mod notify;
pub mod probes;
mod reload;
mod responder;
mod role;
mod scheduling;
mod stop;
mod supervisor;
mod watch;

pub use control::control;
pub use egress::egress;
pub use in_force::{InForce, InForceError};
pub use ingress::ingress;
pub use manual::set_mode;
pub use reload::{HangUp, ReloadAnswer, ReloadRequests, ReloadResult, reload_all};
pub use responder::{ResponderOptions, responder};
pub use role::RoleError;
pub use stop::Stop;
pub use supervisor::{SupervisorError, end_with_supervisor, up};

/// How often a role keeps house. A signal to stop is seen within it, so that a role ends within a second.
const HOUSEKEEPING_MS: u64 = 100;
