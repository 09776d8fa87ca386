//! The choice between the two back ends.

use std::net::Ipv4Addr;

use clap::ValueEnum;

use super::backend::Backend;
use super::error::ImpairmentError;
use super::link::Impairment;
use super::netem::{self, Netem};
use super::nfqueue::Nfqueue;

/// The back end that the user requests.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum BackendChoice {
    /// netem where the kernel has it, otherwise NFQUEUE
    Auto,
    /// The model in user space over NFQUEUE: seeded, needs iptables
    Nfqueue,
    /// tc netem: not seeded, needs the kernel's netem and ifb
    Netem,
}

/// The result of [`open`].
pub struct Opened {
    /// The back end, with the link on.
    pub backend: Box<dyn Backend>,
    /// Why this back end was chosen.
    pub reason: String,
}

/// Starts to impair the packets that the current network namespace receives from `source`; with a
/// `destination`, only the packets that the namespace forwards to it. No other program in the namespace may
/// use the number `queue`.
///
/// # Errors
/// The machine lacks what the back end needs, or the queue is in use.
pub fn open(
    choice: BackendChoice,
    source: Ipv4Addr,
    destination: Option<Ipv4Addr>,
    queue: u16,
    impairment: &Impairment,
) -> Result<Opened, ImpairmentError> {
    let lacks_netem = match choice {
        BackendChoice::Nfqueue => None,
        _ if destination.is_some() => Some("it does not support --destination".to_owned()),
        BackendChoice::Netem | BackendChoice::Auto => netem::missing(queue),
    };
    let (netem, reason) = match (choice, lacks_netem) {
        (BackendChoice::Nfqueue, _) => (false, "chosen by --backend".to_owned()),
        (BackendChoice::Netem, None) => (true, "chosen by --backend".to_owned()),
        (BackendChoice::Netem, Some(reason)) => {
            return Err(ImpairmentError::NoBackend { backend: "netem", reason });
        }
        (BackendChoice::Auto, None) => (true, "the kernel has netem".to_owned()),
        (BackendChoice::Auto, Some(reason)) => (false, format!("no netem: {reason}")),
    };
    let backend: Box<dyn Backend> = if netem {
        Box::new(Netem::open(source, queue, impairment)?)
    } else {
        Box::new(Nfqueue::open(source, destination, queue, impairment)?)
    };
    Ok(Opened { backend, reason })
}
