//! The interface of the two back ends that impair real packets, and the choice between them.

use std::net::Ipv4Addr;
use std::os::fd::BorrowedFd;

use adaptive_bridge::model::MonotonicNs;
use clap::ValueEnum;

use super::delay::NormalDelay;
use super::error::ImpairmentError;
use super::gilbert_elliott::GilbertElliott;
use super::link::{Counters, Impairment, LinkState};
use super::netem::Netem;
use super::nfqueue::Nfqueue;

/// Impairs the packets that this network namespace receives from one source, until it is dropped.
pub trait Backend {
    /// The back end's name, `nfqueue` or `netem`.
    fn name(&self) -> &'static str;

    /// Whether losses and delays are reproducible from a seed.
    fn is_seeded(&self) -> bool;

    /// The descriptor that is readable when packets wait; `None` when the kernel handles all packets.
    fn fd(&self) -> Option<BorrowedFd<'_>>;

    /// When the next delayed packet must be released; `None` when none is delayed here.
    fn next_release(&self) -> Option<MonotonicNs>;

    /// Handles waiting packets and releases delayed ones that are due; does not block.
    ///
    /// # Errors
    /// The operating system refused an operation; the impairment has ended.
    fn work(&mut self) -> Result<(), ImpairmentError>;

    /// Switches the link.
    ///
    /// # Errors
    /// The operating system refused it; the state is unchanged.
    fn switch(&mut self, state: LinkState) -> Result<(), ImpairmentError>;

    /// Changes loss and delay while the link is on, for packets that arrive from now on.
    ///
    /// # Errors
    /// The operating system refused it.
    fn set(&mut self, loss: GilbertElliott, delay: NormalDelay) -> Result<(), ImpairmentError>;

    /// The state of the link.
    fn state(&self) -> LinkState;

    /// The packets counted so far.
    ///
    /// # Errors
    /// The operating system's counters cannot be read.
    fn counters(&mut self) -> Result<Counters, ImpairmentError>;

    /// Packets that the kernel dropped before the link saw them, because the back end did not keep up. Any
    /// value but 0 invalidates a measurement.
    ///
    /// # Errors
    /// The operating system's counters cannot be read.
    fn kernel_dropped(&self) -> Result<u64, ImpairmentError>;
}

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
        BackendChoice::Netem | BackendChoice::Auto => super::netem::missing(queue),
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
