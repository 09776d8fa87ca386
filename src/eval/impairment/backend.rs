//! What puts a link in the way of real packets, and which of the two ways is taken.

use std::net::Ipv4Addr;
use std::os::fd::BorrowedFd;

use clap::ValueEnum;

use super::delay::NormalDelay;
use super::error::ImpairmentError;
use super::gilbert_elliott::GilbertElliott;
use super::link::{Counters, Impairment, LinkState};
use super::netem::Netem;
use super::nfqueue::Nfqueue;
use crate::model::MonotonicNs;

/// An impairment of what this network namespace receives from one source. Dropping it ends it.
pub trait Backend {
    /// `nfqueue` or `netem`.
    fn name(&self) -> &'static str;

    /// Whether a seed decides what happens to which packet.
    fn is_seeded(&self) -> bool;

    /// What is readable when there is work; `None` when the kernel does it all.
    fn fd(&self) -> Option<BorrowedFd<'_>>;

    /// When there is work although nothing is readable.
    fn next_release(&self) -> Option<MonotonicNs>;

    /// Does what there is to do, and does not wait.
    ///
    /// # Errors
    /// The operating system refused something; the impairment is over.
    fn work(&mut self) -> Result<(), ImpairmentError>;

    /// Switches the link.
    ///
    /// # Errors
    /// The operating system refused it; the state is the one before.
    fn switch(&mut self, state: LinkState) -> Result<(), ImpairmentError>;

    /// Changes what the link does while it is on, for packets that come from now on.
    ///
    /// # Errors
    /// The operating system refused it.
    fn set(&mut self, loss: GilbertElliott, delay: NormalDelay) -> Result<(), ImpairmentError>;

    /// The state of the link.
    fn state(&self) -> LinkState;

    /// What it has done so far.
    ///
    /// # Errors
    /// The operating system does not say.
    fn counters(&mut self) -> Result<Counters, ImpairmentError>;

    /// Packets that the kernel dropped before the link saw them, as the back end did not keep up. Anything
    /// but 0 spoils a measurement.
    ///
    /// # Errors
    /// The operating system does not say.
    fn kernel_dropped(&self) -> Result<u64, ImpairmentError>;
}

/// Which back end is wanted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum BackendChoice {
    /// netem where the kernel has it, otherwise NFQUEUE
    Auto,
    /// The model in user space: seeded, needs iptables
    Nfqueue,
    /// tc netem: not seeded, needs the kernel's netem and ifb
    Netem,
}

/// A back end, and why it is this one.
pub struct Opened {
    /// It, with the link on.
    pub backend: Box<dyn Backend>,
    /// Why it was chosen.
    pub reason: String,
}

/// Begins to impair what the present network namespace receives from `source`, or of that only what is for
/// `destination`, where it passes packets on. `queue` is a number that no other program in the namespace
/// uses.
///
/// # Errors
/// The machine can't, or what the link needs is in use.
pub fn open(
    choice: BackendChoice,
    source: Ipv4Addr,
    destination: Option<Ipv4Addr>,
    queue: u16,
    impairment: &Impairment,
) -> Result<Opened, ImpairmentError> {
    let lacks_netem = match choice {
        BackendChoice::Nfqueue => None,
        _ if destination.is_some() => Some("here it impairs only what a host itself receives".to_owned()),
        BackendChoice::Netem | BackendChoice::Auto => super::netem::missing(queue),
    };
    let (netem, reason) = match (choice, lacks_netem) {
        (BackendChoice::Nfqueue, _) => (false, "asked for".to_owned()),
        (BackendChoice::Netem, None) => (true, "asked for".to_owned()),
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
