//! The link in user space: the kernel queues each packet of a source, and the link says what becomes of it.

mod messages;
mod rules;

use std::net::Ipv4Addr;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd};

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
use crate::clock;
use crate::model::MonotonicNs;

/// How many packets may wait in the kernel for a verdict: those on their way, and those not read yet. Linux
/// 6.18 lets 65,536 wait at most.
const QUEUE_MAX: u32 = 5 * HELD_MAX as u32;
/// Room for so many that are not read yet, so that nothing is lost but what the link loses. The default of
/// some 200 KB holds about 250 packets, less than one large sample has fragments.
const RECEIVE_BUFFER_BYTES: usize = 64 << 20;
/// Packets in a turn, so that delays that are over are not kept waiting.
const TURN_PACKETS: usize = 256;
/// A packet of which the first bytes are copied takes a few hundred.
const DATAGRAM_BYTES: usize = 8 << 10;
/// The answer to a request comes at once.
const ANSWER_TIMEOUT_MS: u16 = 5_000;

/// An impairment by NFQUEUE. Dropping it removes the rule first and then closes the queue.
pub struct Nfqueue {
    // In this order: without the rule nothing more comes to the queue.
    _rule: Rule,
    queue: Queue,
    link: Link,
}

impl Nfqueue {
    /// Begins to impair what the present network namespace receives from `source`, or of that only what it
    /// passes on to `destination`. What a former one that has died has left is removed.
    ///
    /// # Errors
    /// The machine can't, or another program listens on the queue.
    pub fn open(
        source: Ipv4Addr,
        destination: Option<Ipv4Addr>,
        queue: u16,
        impairment: &Impairment,
    ) -> Result<Self, ImpairmentError> {
        rules::remove_stale()?;
        // First the listener, so that a rule of ours without one is always stale.
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
            // For each: by the time of the turn's begin, a packet that came within it would leave too early,
            // by 0.12 ms of 5 when that was seen.
            let now = clock::monotonic();
            for message in messages::messages(&datagram[..bytes]) {
                // An answer here is to a verdict on a packet that the kernel has given up, as its interface
                // has gone.
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

/// A queue that we listen on.
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
        // Beyond the system's limit where that is allowed, otherwise up to it.
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
                // So it says to who may not, and to who comes second.
                Errno::EPERM if rules::is_listened(number) => {
                    return Err(ImpairmentError::QueueTaken { queue: number });
                }
                error => return Err(refused(error)),
            }
        }
        Ok(queue)
    }

    /// Waits for the answer to a request; `UnknownErrno` (0) is yes.
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

    /// The next datagram; `None` when there is none at present.
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
