//! How a process of ingress or of a lane leaves its role to its standby: it sends the standby its sockets
//! while it serves, and says so when it was asked to end.

use std::fs;
use std::io::{self, ErrorKind};
use std::net::UdpSocket;
use std::os::fd::{AsFd, AsRawFd, OwnedFd};
use std::os::unix::net::UnixListener;
use std::path::{Path, PathBuf};

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::socket::{
    AddressFamily, Backlog, Shutdown, SockFlag, SockType, UnixAddr, bind, connect, getsockopt, listen,
    shutdown, socket, sockopt,
};
use tracing::debug;

use super::kept_sockets;
use crate::model::MonotonicNs;
use crate::telemetry::StatFile;

/// How long a process that was asked to end serves on, to see whether its standby ends as well: that checks
/// for a request each 50 ms.
const LEAVE_MS: u64 = 100;

/// Opens the socket of a standby, to which the active process connects.
///
/// # Errors
/// The folder of the socket cannot be written to.
pub(super) fn listen_at(path: &Path) -> io::Result<UnixListener> {
    // One that a former standby has left; this process has the right to wait.
    match fs::remove_file(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => return Err(error),
        _ => {}
    }
    let listener = open_socket()?;
    bind(listener.as_raw_fd(), &Address::of(path)?.address)?;
    listen(&listener, Backlog::new(1)?)?;
    Ok(listener.into())
}

/// The address of a socket whose path may be longer than an address (107 bytes).
struct Address {
    address: UnixAddr,
    /// The address is relative to it.
    _folder: fs::File,
}

impl Address {
    fn of(path: &Path) -> io::Result<Self> {
        let (Some(folder), Some(name)) = (path.parent(), path.file_name()) else {
            return Err(ErrorKind::InvalidInput.into());
        };
        let folder = fs::File::open(folder)?;
        let path = Path::new("/proc/self/fd").join(folder.as_raw_fd().to_string()).join(name);
        Ok(Self { address: UnixAddr::new(&path)?, _folder: folder })
    }
}

/// A socket that keeps the bounds of messages, and never blocks.
fn open_socket() -> nix::Result<OwnedFd> {
    let flags = SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK;
    socket(AddressFamily::Unix, SockType::SeqPacket, flags, None)
}

/// How a process ends that was asked to.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) enum Leave {
    /// Not yet: its standby may have been asked to end, too.
    Soon,
    /// Without goodbye: its standby goes on as the same participant.
    HandOver,
    /// With goodbye, as there is no standby.
    ForGood,
}

/// Sends the sockets of this process to its standby, as soon as there is one.
pub(super) struct Successor {
    path: PathBuf,
    address: Option<Address>,
    sockets: Vec<UdpSocket>,
    connection: Option<OwnedFd>,
    /// From when on the process may hand over; `None` if it was not asked to end.
    leave_at: Option<MonotonicNs>,
}

impl Successor {
    /// `path` is the socket of the standby.
    pub fn new(path: PathBuf, sockets: Vec<UdpSocket>) -> Self {
        Self { path, address: None, sockets, connection: None, leave_at: None }
    }

    /// How the process can end now that it was asked to.
    pub fn leave(&mut self, now: MonotonicNs) -> Leave {
        // It may have started since the last housekeeping.
        self.housekeeping();
        let serves_soon = |standby: &OwnedFd| !has_ended(standby) && !is_stopped(standby);
        if self.sockets.is_empty() || !self.connection.as_ref().is_some_and(serves_soon) {
            return Leave::ForGood;
        }
        let leave_at = *self.leave_at.get_or_insert(now.plus_ms(LEAVE_MS));
        if now < leave_at { Leave::Soon } else { Leave::HandOver }
    }

    /// Tells the standby to take over. False if it does not: it has ended, or is about to.
    pub fn hand_over(&self) -> bool {
        self.connection
            .as_ref()
            .is_some_and(|connection| kept_sockets::say_stopping(connection.as_fd()).is_ok())
    }

    /// Connects to a standby that has none of the sockets. Never waits; some 5 µs without a standby.
    pub fn housekeeping(&mut self) {
        if self.connection.as_ref().is_some_and(has_ended) {
            self.connection = None;
            // The next standby may end as well.
            self.leave_at = None;
        }
        if self.connection.is_some() || self.sockets.is_empty() {
            return;
        }
        match self.connect() {
            Ok(connection) => self.connection = Some(connection),
            Err(error) if matches!(error.kind(), ErrorKind::NotFound | ErrorKind::ConnectionRefused) => {}
            Err(error) => debug!(%error, "cannot send the sockets to the standby"),
        }
    }

    fn connect(&mut self) -> io::Result<OwnedFd> {
        // Once, because housekeeping allocates nothing.
        let address = match &self.address {
            Some(address) => address,
            None => self.address.insert(Address::of(&self.path)?),
        };
        let connection = open_socket()?;
        connect(connection.as_raw_fd(), &address.address)?;
        kept_sockets::hand_over(connection.as_fd(), &self.sockets)?;
        Ok(connection)
    }

    /// Makes the standby close the sockets: it will be another participant.
    pub fn end(&mut self) {
        self.sockets.clear();
        if let Some(connection) = &self.connection {
            kept_sockets::take_back(connection.as_fd());
        }
    }
}

/// Makes what the active process sends to a socket from now on fail, messages or attempts to connect. Those
/// before can still be received.
pub(super) fn decline(socket: &impl AsRawFd) {
    // Fails only if the connection has ended.
    let _ = shutdown(socket.as_raw_fd(), Shutdown::Read);
}

/// Whether SIGSTOP has stopped the process that listens at the other end of a connection, as far as this one
/// can see.
fn is_stopped(connection: &OwnedFd) -> bool {
    getsockopt(connection, sockopt::PeerCredentials)
        .is_ok_and(|standby| StatFile::open(standby.pid()).is_ok_and(|stat| stat.is_stopped()))
}

/// Whether the other end of a connection, which sends nothing, is closed.
fn has_ended(connection: &OwnedFd) -> bool {
    let mut polled = [PollFd::new(connection.as_fd(), PollFlags::POLLIN)];
    poll(&mut polled, PollTimeout::ZERO).is_ok_and(|ready| ready > 0)
}

#[cfg(test)]
mod tests {
    use super::super::kept_sockets::Request;
    use super::*;

    fn at(ms: u64) -> MonotonicNs {
        MonotonicNs(0).plus_ms(ms)
    }

    #[test]
    fn a_process_hands_over_to_a_standby_that_does_not_end_as_well() {
        let folder = tempfile::tempdir().unwrap();
        // Longer than the address of a socket.
        let folder = folder.path().join("f".repeat(200));
        fs::create_dir(&folder).unwrap();
        let path = folder.join("standby");
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        let mut active = Successor::new(path.clone(), vec![socket]);
        active.housekeeping();
        assert_eq!(active.leave(at(0)), Leave::ForGood, "no standby");

        let standby = listen_at(&path).unwrap();
        assert_eq!(active.leave(at(1_000)), Leave::Soon);
        let (connection, _) = standby.accept().unwrap();
        assert_eq!(active.leave(at(1_000 + LEAVE_MS - 1)), Leave::Soon);
        assert_eq!(active.leave(at(1_000 + LEAVE_MS)), Leave::HandOver);
        assert!(active.hand_over());
        let received = || kept_sockets::receive(&connection);
        assert!(matches!(received(), Some(Request::Store(sockets)) if sockets.len() == 1));
        assert!(matches!(received(), Some(Request::Stopping)));
        drop((connection, standby));
        assert_eq!(active.leave(at(1_000 + LEAVE_MS)), Leave::ForGood, "the standby has ended");
    }

    #[test]
    fn a_standby_that_ends_has_what_was_handed_over_before_and_refuses_the_rest() {
        for hands_over_first in [true, false] {
            let folder = tempfile::tempdir().unwrap();
            let path = folder.path().join("standby");
            let standby = listen_at(&path).unwrap();
            let mut active = Successor::new(path, vec![UdpSocket::bind("127.0.0.1:0").unwrap()]);
            assert_eq!(active.leave(at(0)), Leave::Soon);
            let connection: OwnedFd = standby.accept().unwrap().0.into();
            assert_eq!(active.leave(at(LEAVE_MS)), Leave::HandOver);
            let handed_over = hands_over_first.then(|| active.hand_over());
            decline(&connection);
            assert_eq!(handed_over.unwrap_or_else(|| active.hand_over()), hands_over_first);
            assert!(matches!(kept_sockets::receive(&connection), Some(Request::Store(_))));
            let last = kept_sockets::receive(&connection);
            assert_eq!(matches!(last, Some(Request::Stopping)), hands_over_first);
            let end = kept_sockets::receive(&connection);
            assert!(matches!(end, Some(Request::Unknown) | None));
        }
    }

    #[test]
    fn a_process_gives_each_standby_the_time_to_end_as_well() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("standby");
        let mut active = Successor::new(path.clone(), vec![UdpSocket::bind("127.0.0.1:0").unwrap()]);
        let standby = listen_at(&path).unwrap();
        assert_eq!(active.leave(at(0)), Leave::Soon);
        drop(standby.accept().unwrap());
        // It connects to one whose connection has ended, and that still listens.
        assert_eq!(active.leave(at(LEAVE_MS)), Leave::Soon);
        decline(&standby);
        drop(standby.accept().unwrap());
        assert_eq!(active.leave(at(2 * LEAVE_MS)), Leave::ForGood, "it listens no more");
    }

    #[test]
    fn a_process_that_gives_up_its_identity_does_not_hand_over() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("standby");
        let standby = listen_at(&path).unwrap();
        let mut active = Successor::new(path, vec![UdpSocket::bind("127.0.0.1:0").unwrap()]);
        active.housekeeping();
        let _connection = standby.accept().unwrap();
        assert_eq!(active.leave(at(0)), Leave::Soon);
        active.end();
        assert_eq!(active.leave(at(LEAVE_MS)), Leave::ForGood);
    }
}
