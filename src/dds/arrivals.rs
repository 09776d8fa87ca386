//! Detects arriving samples by peeking at datagrams before the DDS library receives them.

use std::io;
use std::net::UdpSocket;
use std::sync::Arc;

use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use nix::sys::eventfd::{EfdFlags, EventFd};

use super::DdsError;
use super::rustdds::sample_arriving;
use crate::model::Guid;

/// The part of a datagram that is peeked at: the RTPS header and the headers of the first submessages.
const PEEKED_BYTES: usize = 256;

/// The epoll data of the closer; that of a socket is its index.
const CLOSER: u64 = u64::MAX;

/// Waits for datagrams on the sockets on which a participant receives samples, without receiving them.
///
/// The kernel wakes the waiting thread right after the thread that receives.
pub struct Arrivals {
    epoll: Epoll,
    sockets: Vec<UdpSocket>,
    close_event: Arc<EventFd>,
}

/// Makes [`Arrivals::wait`] return, from any thread.
pub struct ArrivalsCloser {
    close_event: Arc<EventFd>,
}

/// The result of [`Arrivals::wait`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// A sample or a fragment of one, as the datagram claims; the claim is not checked.
    Sample {
        /// The writer of the sample.
        writer: Guid,
        /// The writer's sequence number of the sample.
        sequence: i64,
        /// Bytes of the sample that are still missing after this datagram.
        left_bytes: usize,
    },
    /// Another datagram, or one that was received before it could be peeked at.
    Other,
    /// [`ArrivalsCloser::close`] was called.
    Closed,
}

impl Arrivals {
    pub(super) fn new(sockets: io::Result<Vec<UdpSocket>>) -> Result<Self, DdsError> {
        let open = || {
            let sockets = sockets?;
            let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
            // Edge-triggered, because datagrams stay in the socket and a level would never end. Exclusive, so
            // that the kernel wakes this thread after the library's event loop instead of before it.
            let flags = EpollFlags::EPOLLIN | EpollFlags::EPOLLET | EpollFlags::EPOLLEXCLUSIVE;
            for (number, socket) in (0..).zip(&sockets) {
                epoll.add(socket, EpollEvent::new(flags, number))?;
            }
            let close_event = EventFd::from_flags(EfdFlags::EFD_CLOEXEC | EfdFlags::EFD_NONBLOCK)?;
            epoll.add(&close_event, EpollEvent::new(EpollFlags::EPOLLIN, CLOSER))?;
            Ok(Self { epoll, sockets, close_event: Arc::new(close_event) })
        };
        open().map_err(|error: io::Error| DdsError::library("a watch of its sockets".to_owned(), error))
    }

    /// Returns a handle that ends the waiting.
    pub fn closer(&self) -> ArrivalsCloser {
        ArrivalsCloser { close_event: self.close_event.clone() }
    }

    /// Waits for a datagram that has arrived since the last call. If several wait to be received on its
    /// socket, the first of them is peeked at.
    pub fn wait(&self) -> Arrival {
        let mut events = [EpollEvent::empty()];
        match self.epoll.wait(&mut events, EpollTimeout::NONE) {
            Ok(1) if events[0].data() == CLOSER => Arrival::Closed,
            Ok(1) => {
                let socket = usize::try_from(events[0].data()).ok().and_then(|at| self.sockets.get(at));
                socket.and_then(peek_sample).unwrap_or(Arrival::Other)
            }
            _ => Arrival::Other,
        }
    }
}

impl ArrivalsCloser {
    /// Makes [`Arrivals::wait`] return [`Arrival::Closed`], in this call and in all later ones.
    pub fn close(&self) {
        // A write fails only if the counter is full, that is, if this was called before.
        let _ = self.close_event.write(1);
    }
}

/// Reads the start of the first waiting datagram; `None` if it carries no sample or has been received
/// already.
fn peek_sample(socket: &UdpSocket) -> Option<Arrival> {
    let mut datagram = [0; PEEKED_BYTES];
    // Does not block, because the event loop's sockets are non-blocking. The event loop may have received
    // the datagram already.
    let length = socket.peek(&mut datagram).ok()?;
    let (writer, sequence, left_bytes) = sample_arriving(datagram.get(..length)?)?;
    Some(Arrival::Sample { writer: Guid(writer), sequence, left_bytes })
}
