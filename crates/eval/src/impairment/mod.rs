//! A link that loses and delays packets as a radio link does. Losses come in bursts (Gilbert-Elliott) and
//! delays are normally distributed, both seeded; or a trace of a link sets both over time. The link can be
//! switched on, off or cut while traffic flows.
//!
//! [`Link`] is the model; it is pure. One of two back ends applies it to real packets: `tc netem` where the
//! kernel has it, otherwise the same model in user space over NFQUEUE.

mod backend;
mod choice;
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

pub use backend::Backend;
pub use choice::{BackendChoice, Opened, open};
pub use delay::{DelayLine, NormalDelay};
pub use error::{ImpairmentError, TraceProblem};
pub use gilbert_elliott::{Chain, GilbertElliott};
pub use levels::{Level, Reading};
pub use link::{Arrival, Counters, Fate, HELD_MAX, Impairment, Link, LinkState};
pub use netem::Netem;
pub use nfqueue::Nfqueue;
pub use replay::{Replay, RowCounts};
pub use trace::{Trace, TraceRow};
