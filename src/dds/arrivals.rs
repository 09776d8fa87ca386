//! Datagrams, seen as they come, by a thread that takes none of them.

use std::io;
use std::net::UdpSocket;
use std::sync::Arc;

use nix::sys::epoll::{Epoll, EpollCreateFlags, EpollEvent, EpollFlags, EpollTimeout};
use nix::sys::eventfd::{EfdFlags, EventFd};

use super::DdsError;
use super::rustdds::sample_arriving;
use crate::model::Guid;

/// What is looked at of a datagram: the headers of RTPS and of the first submessages.
const LOOKED_AT_BYTES: usize = 256;

/// What epoll says of the closer, beside the numbers of the sockets.
const CLOSING: u64 = u64::MAX;

/// The sockets of a participant that samples come to.
///
/// The kernel wakes who waits here right after the thread that receives.
pub struct Arrivals {
    epoll: Epoll,
    sockets: Vec<UdpSocket>,
    closing: Arc<EventFd>,
}

/// Ends the waiting, from any thread.
pub struct ArrivalsCloser {
    closing: Arc<EventFd>,
}

/// What has come.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Arrival {
    /// A sample, or a part of one, as its datagram claims; nothing was checked.
    Sample {
        /// Who wrote it.
        writer: Guid,
        /// Its number among those of the writer.
        sequence: i64,
        /// Bytes of it that come after this datagram.
        left_bytes: usize,
    },
    /// Something else, or what was received before it could be looked at.
    Other,
    /// Somebody called [`ArrivalsCloser::close`].
    Closed,
}

impl Arrivals {
    pub(super) fn new(sockets: io::Result<Vec<UdpSocket>>) -> Result<Self, DdsError> {
        let open = || {
            let sockets = sockets?;
            let epoll = Epoll::new(EpollCreateFlags::EPOLL_CLOEXEC)?;
            // Edge-triggered, for nothing is taken that would end a level. Exclusive, for then the kernel has
            // it behind the event loop in the queue of those it wakes; otherwise it would be before it.
            let flags = EpollFlags::EPOLLIN | EpollFlags::EPOLLET | EpollFlags::EPOLLEXCLUSIVE;
            for (number, socket) in (0..).zip(&sockets) {
                epoll.add(socket, EpollEvent::new(flags, number))?;
            }
            let closing = EventFd::from_flags(EfdFlags::EFD_CLOEXEC | EfdFlags::EFD_NONBLOCK)?;
            epoll.add(&closing, EpollEvent::new(EpollFlags::EPOLLIN, CLOSING))?;
            Ok(Self { epoll, sockets, closing: Arc::new(closing) })
        };
        open().map_err(|error: io::Error| DdsError::library("a watch of its sockets".to_owned(), error))
    }

    /// What ends the waiting.
    pub fn closer(&self) -> ArrivalsCloser {
        ArrivalsCloser { closing: self.closing.clone() }
    }

    /// Waits until something has come since the last call. Of several datagrams that wait to be received the
    /// first one is looked at.
    pub fn wait(&self) -> Arrival {
        let mut events = [EpollEvent::empty()];
        match self.epoll.wait(&mut events, EpollTimeout::NONE) {
            Ok(1) if events[0].data() == CLOSING => Arrival::Closed,
            Ok(1) => {
                let socket = usize::try_from(events[0].data()).ok().and_then(|at| self.sockets.get(at));
                socket.and_then(look_at).unwrap_or(Arrival::Other)
            }
            _ => Arrival::Other,
        }
    }
}

impl ArrivalsCloser {
    /// Lets [`Arrivals::wait`] return [`Arrival::Closed`], now and from now on.
    pub fn close(&self) {
        // A counter that is full has been written to before.
        let _ = self.closing.write(1);
    }
}

fn look_at(socket: &UdpSocket) -> Option<Arrival> {
    let mut datagram = [0; LOOKED_AT_BYTES];
    // Does not block: the socket is one of the library's event loop, which may have received it by now.
    let length = socket.peek(&mut datagram).ok()?;
    let (writer, sequence, left_bytes) = sample_arriving(datagram.get(..length)?)?;
    Some(Arrival::Sample { writer: Guid(writer.to_bytes()), sequence, left_bytes })
}
