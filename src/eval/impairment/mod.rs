//! A link that loses and delays packets as a radio link does: bursts of loss by Gilbert and Elliott, delay by
//! the normal distribution, both seeded, or both as a trace of a link has them from time to time; and the
//! link switched off, on, or cut while traffic flows.
//!
//! What happens to a packet is decided by a [`Link`], which is pure. It is put in the way of real packets by
//! one of two back ends: `tc netem` where the kernel has it, otherwise the same model in user space over
//! NFQUEUE.

mod backend;
mod delay;
mod error;
mod gilbert_elliott;
mod levels;
mod link;
mod netem;
mod nfqueue;
mod random;
mod replay;
pub(super) mod system;
mod trace;

pub use backend::{Backend, BackendChoice, Opened, open};
pub use delay::{DelayLine, NormalDelay};
pub use error::ImpairmentError;
pub use gilbert_elliott::{Chain, GilbertElliott};
pub use levels::{Level, Reading};
pub use link::{Arrival, Counters, Fate, HELD_MAX, Impairment, Link, LinkState};
pub use netem::Netem;
pub use nfqueue::Nfqueue;
pub use replay::{Replay, RowCounts};
pub use trace::{Trace, TraceProblem, TraceRow};
