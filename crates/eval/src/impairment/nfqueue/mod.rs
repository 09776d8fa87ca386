//! The back end in user space: the kernel queues each packet of a source, and [`Link`] decides its verdict.

mod messages;
mod rules;

use std::net::Ipv4Addr;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd};

use adaptive_bridge::clock;
use adaptive_bridge::model::MonotonicNs;
use nix::errno::Errno;
use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::socket::{
    AddressFamily, MsgFlags, NetlinkAddr, SockFlag, SockProtocol, SockType, bind, recv, sendto, setsockopt,
    socket, sockopt,
};

use self::messages::Message;
use self::rules::Rule;
use super::backend::Backend;
use super::delay::NormalDelay;
use super::error::ImpairmentError;
use super::gilbert_elliott::GilbertElliott;
use super::link::{Counters, Fate, HELD_MAX, Impairment, Link, LinkState};

/// The largest number of packets that wait in the kernel for a verdict: those in transit, and those not read
/// yet. Linux 6.18 limits it to 65,536.
const QUEUE_MAX: u32 = 5 * HELD_MAX as u32;
/// The socket's receive buffer: room for packets not read yet, so that only the link loses packets. The
/// default of some 200 KB holds about 250 packets, fewer than the fragments of one large sample.
const RECEIVE_BUFFER_BYTES: usize = 64 << 20;
/// The largest number of packets read in a turn, so that delayed packets that are due do not wait long.
const TURN_PACKETS: usize = 256;
/// The buffer of a datagram: a packet of which the kernel copies the first bytes needs a few hundred bytes.
const DATAGRAM_BYTES: usize = 8 << 10;
/// How long to wait for the answer to a request, which the kernel sends at once.
const ANSWER_TIMEOUT_MS: u16 = 5_000;

/// An impairment by NFQUEUE. Dropping it removes the rule first and then closes the queue.
pub struct Nfqueue {
    // Dropped in this order: once the rule is removed, no further packet enters the queue.
    _rule: Rule,
    queue: Queue,
    link: Link,
}

impl Nfqueue {
    /// Starts to impair the packets that the current network namespace receives from `source`; with a
    /// `destination`, only those that it forwards there. Removes the rules that killed processes have left.
    ///
    /// # Errors
    /// netfilter refused the rule or the queue, or another program listens on the queue.
    pub fn open(
        source: Ipv4Addr,
        destination: Option<Ipv4Addr>,
        queue: u16,
        impairment: &Impairment,
    ) -> Result<Self, ImpairmentError> {
        rules::remove_stale()?;
        // The listener before the rule, so that a rule of the harness without a listener is always stale.
        let queue = Queue::open(queue)?;
        let rule = Rule::install(source, destination, queue.number)?;
        Ok(Self { _rule: rule, queue, link: Link::new(impairment) })
    }
}

impl Backend for Nfqueue {
    fn name(&self) -> &'static str {
        "nfqueue"
    }

    fn is_seeded(&self) -> bool {
        true
    }

    fn fd(&self) -> Option<BorrowedFd<'_>> {
        Some(self.queue.socket.as_fd())
    }

    fn next_release(&self) -> Option<MonotonicNs> {
        self.link.next_release()
    }

    fn work(&mut self) -> Result<(), ImpairmentError> {
        let mut datagram = [0; DATAGRAM_BYTES];
        let mut verdicts = Vec::new();
        for _ in 0..TURN_PACKETS {
            let Some(bytes) = self.queue.receive(&mut datagram)? else { break };
            // Read for each datagram: with the time of the turn's start, a packet that arrived during the
            // turn would leave too early (0.12 ms of a delay of 5 ms, measured).
            let now = clock::monotonic();
            for message in messages::messages(&datagram[..bytes]) {
                // An answer here belongs to a verdict on a packet that the kernel has discarded, because its
                // interface was removed.
                let Message::Packet(arrival) = message else { continue };
                let accept = match self.link.arrive(arrival, now) {
                    Fate::Hold => continue,
                    Fate::Pass => true,
                    Fate::Drop => false,
                };
                messages::put_verdict(&mut verdicts, self.queue.number, arrival.packet, accept);
            }
        }
        self.queue.send(&verdicts)?;
        let now = clock::monotonic();
        loop {
            verdicts.clear();
            while verdicts.len() < DATAGRAM_BYTES
                && let Some(packet) = self.link.pop_due(now)
            {
                messages::put_verdict(&mut verdicts, self.queue.number, packet, true);
            }
            if verdicts.is_empty() {
                return Ok(());
            }
            self.queue.send(&verdicts)?;
        }
    }

    fn switch(&mut self, state: LinkState) -> Result<(), ImpairmentError> {
        self.link.switch(state);
        Ok(())
    }

    fn set(&mut self, loss: GilbertElliott, delay: NormalDelay) -> Result<(), ImpairmentError> {
        self.link.set(loss, delay);
        Ok(())
    }

    fn state(&self) -> LinkState {
        self.link.state()
    }

    fn counters(&mut self) -> Result<Counters, ImpairmentError> {
        Ok(self.link.counters())
    }

    fn kernel_dropped(&self) -> Result<u64, ImpairmentError> {
        rules::dropped_by_kernel(self.queue.number)
    }
}

/// A kernel queue of packets with this process as its listener.
struct Queue {
    socket: OwnedFd,
    number: u16,
}

impl Queue {
    fn open(number: u16) -> Result<Self, ImpairmentError> {
        let refused = |error| ImpairmentError::system(format!("NFQUEUE {number}"), error);
        let flags = SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK;
        let protocol = SockProtocol::NetlinkNetFilter;
        let socket = socket(AddressFamily::Netlink, SockType::Raw, flags, protocol).map_err(refused)?;
        // Above the system's limit where the process may, otherwise up to it.
        if setsockopt(&socket, sockopt::RcvBufForce, &RECEIVE_BUFFER_BYTES).is_err() {
            setsockopt(&socket, sockopt::RcvBuf, &RECEIVE_BUFFER_BYTES).map_err(refused)?;
        }
        bind(socket.as_raw_fd(), &NetlinkAddr::new(0, 0)).map_err(refused)?;
        let queue = Self { socket, number };
        let requests = [
            messages::bind(number, 1),
            messages::set_max_length(number, 2, QUEUE_MAX),
            messages::set_copy(number, 3),
        ];
        for (sequence, request) in (1..).zip(requests) {
            queue.send(&request)?;
            match queue.answer(sequence)? {
                Errno::UnknownErrno => {}
                // The kernel returns EPERM both without the right and when another process listens.
                Errno::EPERM if rules::is_listened(number) => {
                    return Err(ImpairmentError::QueueTaken { queue: number });
                }
                error => return Err(refused(error)),
            }
        }
        Ok(queue)
    }

    /// Waits for the kernel's answer to a request; `UnknownErrno` (0) means success.
    fn answer(&self, request: u32) -> Result<Errno, ImpairmentError> {
        let refused = |error: Errno| ImpairmentError::system("the answer of netfilter", error);
        let mut datagram = [0; DATAGRAM_BYTES];
        loop {
            let mut readable = [PollFd::new(self.socket.as_fd(), PollFlags::POLLIN)];
            match poll(&mut readable, PollTimeout::from(ANSWER_TIMEOUT_MS)) {
                Ok(0) => return Err(refused(Errno::ETIMEDOUT)),
                Ok(_) | Err(Errno::EINTR) => {}
                Err(error) => return Err(refused(error)),
            }
            let Some(bytes) = self.receive(&mut datagram)? else { continue };
            for message in messages::messages(&datagram[..bytes]) {
                if let Message::Answer { sequence, error } = message
                    && sequence == request
                {
                    return Ok(Errno::from_raw(error));
                }
            }
        }
    }

    /// Receives the next datagram; `None` when there is none.
    fn receive(&self, datagram: &mut [u8]) -> Result<Option<usize>, ImpairmentError> {
        loop {
            return match recv(self.socket.as_raw_fd(), datagram, MsgFlags::empty()) {
                Ok(bytes) => Ok(Some(bytes)),
                Err(Errno::EAGAIN) => Ok(None),
                // The socket was full: the kernel has dropped packets and counted them.
                Err(Errno::EINTR | Errno::ENOBUFS) => continue,
                Err(error) => Err(ImpairmentError::system("receiving from NFQUEUE", error)),
            };
        }
    }

    fn send(&self, messages: &[u8]) -> Result<(), ImpairmentError> {
        if messages.is_empty() {
            return Ok(());
        }
        loop {
            match sendto(self.socket.as_raw_fd(), messages, &NetlinkAddr::new(0, 0), MsgFlags::empty()) {
                Ok(_) => return Ok(()),
                Err(Errno::EINTR) => {}
                Err(error) => return Err(ImpairmentError::system("a verdict to NFQUEUE", error)),
            }
        }
    }
}
