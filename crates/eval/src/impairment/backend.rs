//! The interface of the two back ends that impair real packets.

use std::os::fd::BorrowedFd;

use adaptive_bridge::model::MonotonicNs;

use super::delay::NormalDelay;
use super::error::ImpairmentError;
use super::gilbert_elliott::GilbertElliott;
use super::link::{Counters, LinkState};

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
