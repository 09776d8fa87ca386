//! Sockets that outlive a killed process. Its supervisor (systemd or `up`) has duplicates of them, in which
//! the kernel goes on queueing datagrams, and passes them to the next process.
//!
//! The messages are those of systemd's file descriptor store (sd_notify(3), sd_listen_fds(3)). `up` takes the
//! same ones from a socket of its own ([`STORE_VARIABLE`]): with `NOTIFY_SOCKET` its children would also
//! send it their status lines.

use std::env;
use std::io::{self, IoSlice, IoSliceMut};
use std::net::UdpSocket;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd, FromRawFd, OwnedFd, RawFd};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::net::{SocketAddr, UnixDatagram};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use nix::cmsg_space;
use nix::fcntl::{FcntlArg, FdFlag, fcntl};
use nix::sys::socket::{
    ControlMessage, ControlMessageOwned, MsgFlags, SockType, SockaddrIn, getsockname, getsockopt, recvmsg,
    sendmsg, sockopt,
};
use tracing::warn;

/// Environment variable of a child of `up`: the file descriptor of the socket that takes messages for `up`.
pub(super) const STORE_VARIABLE: &str = "ADAPTIVE_BRIDGE_SOCKET_STORE";

/// Environment variable of a child of `up`: the file descriptors of the sockets that it inherits, separated
/// by commas.
pub(super) const SOCKETS_VARIABLE: &str = "ADAPTIVE_BRIDGE_SOCKETS";

/// Sockets that a supervisor keeps for a process. The service units have the same as
/// `FileDescriptorStoreMax`.
pub(super) const MAX_SOCKETS: usize = 8;

/// How long the sender of a message may wait for a supervisor whose queue is full.
pub(super) const SEND_TIMEOUT: Duration = Duration::from_millis(100);

/// The first file descriptor that systemd passes.
const FIRST_OF_SYSTEMD: RawFd = 3;

/// Asks to keep the sockets that are attached. Without `FDPOLL=0` systemd closes a socket with an ICMP error,
/// which is what it has once a subscriber ended.
const STORE: &str = "FDSTORE=1\nFDNAME=dds\nFDPOLL=0";

/// Asks to close all kept sockets.
const FORGET: &str = "FDSTOREREMOVE=1\nFDNAME=dds";

/// Says that the process ends on request, so that its standby knows why.
const STOPPING: &str = "STOPPING=1";

/// More than the file descriptors that the kernel lets one message have (253), so that none is cut off.
const MAX_ATTACHED: usize = 256;

/// The UDP sockets that the supervisor passes to this process; none at a second call. To be called before
/// the process opens sockets.
pub(super) fn inherited() -> Vec<UdpSocket> {
    static TAKEN: AtomicBool = AtomicBool::new(false);
    if TAKEN.swap(true, Ordering::Relaxed) {
        return Vec::new();
    }
    let mut sockets = Vec::new();
    for fd in passed(|name| env::var(name).ok()) {
        match inherit(fd) {
            Ok(socket) => sockets.push(socket),
            Err(error) => warn!(fd, %error, "a file descriptor from the supervisor is not used"),
        }
    }
    sockets
}

/// Whether the supervisor passes sockets to this process.
pub(super) fn are_inherited() -> bool {
    !passed(|name| env::var(name).ok()).is_empty()
}

/// Gives the supervisor duplicates of the sockets, to keep for the next process. It ignores those that it has
/// already. Does nothing without a supervisor.
///
/// # Errors
/// The supervisor cannot be reached, or does not read its messages for [`SEND_TIMEOUT`].
pub(super) fn store(sockets: &[UdpSocket]) -> io::Result<()> {
    let fds: Vec<RawFd> = sockets.iter().map(AsRawFd::as_raw_fd).collect();
    if fds.is_empty() { Ok(()) } else { send_to_supervisor(STORE, &fds) }
}

/// Sends duplicates of the sockets to a standby.
///
/// # Errors
/// The connection has ended, or its queue is full.
pub(super) fn hand_over(connection: BorrowedFd<'_>, sockets: &[UdpSocket]) -> io::Result<()> {
    let fds: Vec<RawFd> = sockets.iter().map(AsRawFd::as_raw_fd).collect();
    send(connection.as_raw_fd(), STORE, &fds)
}

/// Makes a standby close the sockets that it got from this process.
pub(super) fn take_back(connection: BorrowedFd<'_>) {
    // A connection that has ended has no standby.
    let _ = send(connection.as_raw_fd(), FORGET, &[]);
}

/// Says to a standby that this process ends because it was asked to. The standby then takes over.
///
/// # Errors
/// The standby has ended, or is about to and takes nothing over any more.
pub(super) fn say_stopping(connection: BorrowedFd<'_>) -> io::Result<()> {
    send(connection.as_raw_fd(), STOPPING, &[])
}

/// Makes the supervisor close the sockets that it keeps for this process.
pub(super) fn forget() {
    if let Err(error) = send_to_supervisor(FORGET, &[]) {
        warn!(%error, "the supervisor may keep sockets that are no longer used");
    }
}

/// What a process asks of its supervisor, or tells its standby.
pub(super) enum Request {
    Store(Vec<UdpSocket>),
    Forget,
    /// It ends on request.
    Stopping,
    /// A message that has no meaning here, or the end of a connection.
    Unknown,
}

/// Receives the next message that has arrived; `None` if there is none. Closes whatever is attached that is
/// not a socket to store.
pub(super) fn receive(socket: &impl AsRawFd) -> Option<Request> {
    receive_with(socket, cmsg_space!([RawFd; MAX_ATTACHED]))
}

fn receive_with(socket: &impl AsRawFd, mut attached: Vec<u8>) -> Option<Request> {
    let mut bytes = [0; 64];
    let mut parts = [IoSliceMut::new(&mut bytes)];
    let flags = MsgFlags::MSG_DONTWAIT | MsgFlags::MSG_CMSG_CLOEXEC;
    let message = recvmsg::<()>(socket.as_raw_fd(), &mut parts, Some(&mut attached), flags).ok()?;
    let mut fds = Vec::new();
    for part in message.cmsgs().into_iter().flatten() {
        if let ControlMessageOwned::ScmRights(received) = part {
            // SAFETY: the kernel has just opened them for this message, so nothing else owns them.
            fds.extend(received.into_iter().map(|fd| unsafe { OwnedFd::from_raw_fd(fd) }));
        }
    }
    let (length, is_cut_off) = (message.bytes, message.flags.contains(MsgFlags::MSG_CTRUNC));
    if is_cut_off {
        // The kernel has opened the first ones, of which nix lists none.
        close_listed(&attached);
        warn!("this process has no file descriptors left for the sockets of another one");
        return Some(Request::Unknown);
    }
    Some(match bytes.get(..length) {
        Some(text) if text == STORE.as_bytes() => {
            fds.retain(|fd| {
                let checked = check_udp(fd.as_fd());
                checked.inspect_err(|error| warn!(%error, "refused to keep a file descriptor")).is_ok()
            });
            Request::Store(fds.into_iter().map(Into::into).collect())
        }
        Some(text) if text == FORGET.as_bytes() => Request::Forget,
        Some(text) if text == STOPPING.as_bytes() => Request::Stopping,
        _ => Request::Unknown,
    })
}

/// Closes the file descriptors in the control message of a message whose list of them was cut off: its
/// length, level and type take 16 bytes (cmsg(3)).
fn close_listed(control: &[u8]) {
    let length = control.first_chunk().map_or(0, |length| usize::from_ne_bytes(*length));
    let listed = control.get(16..length.min(control.len())).unwrap_or_default();
    for fd in listed.as_chunks().0 {
        // SAFETY: the kernel has just opened it for this message, so nothing else owns it.
        drop(unsafe { OwnedFd::from_raw_fd(RawFd::from_ne_bytes(*fd)) });
    }
}

/// Sends a message and duplicates of `fds`.
pub(super) fn send(socket: RawFd, message: &str, fds: &[RawFd]) -> io::Result<()> {
    let rights = [ControlMessage::ScmRights(fds)];
    let attached = &rights[..usize::from(!fds.is_empty())];
    sendmsg::<()>(socket, &[IoSlice::new(message.as_bytes())], attached, MsgFlags::MSG_NOSIGNAL, None)?;
    Ok(())
}

/// Does nothing without a supervisor.
fn send_to_supervisor(message: &str, fds: &[RawFd]) -> io::Result<()> {
    if let Ok(inherited) = env::var(STORE_VARIABLE) {
        let socket = inherited.parse().map_err(|_| invalid(format!("{STORE_VARIABLE}={inherited}")))?;
        return send(socket, message, fds);
    }
    let Some(address) = env::var_os("NOTIFY_SOCKET") else { return Ok(()) };
    let socket = UnixDatagram::unbound()?;
    match address.as_encoded_bytes() {
        [b'@', name @ ..] => socket.connect_addr(&SocketAddr::from_abstract_name(name)?)?,
        _ => socket.connect(address)?,
    }
    socket.set_write_timeout(Some(SEND_TIMEOUT))?;
    send(socket.as_raw_fd(), message, fds)
}

/// The file descriptors that the environment says were passed to this process.
fn passed(variable: impl Fn(&str) -> Option<String>) -> Vec<RawFd> {
    let number = |name: &str| variable(name).and_then(|value| value.parse::<u32>().ok());
    if let Some(list) = variable(SOCKETS_VARIABLE) {
        let is_number = |text: &&str| {
            let is_fd = text.parse::<RawFd>().is_ok_and(|fd| fd >= FIRST_OF_SYSTEMD);
            if !is_fd {
                warn!("{SOCKETS_VARIABLE} has {text:?}, which is no inherited file descriptor");
            }
            is_fd
        };
        return list
            .split(',')
            .filter(is_number)
            .take(MAX_SOCKETS)
            .filter_map(|fd| fd.parse().ok())
            .collect();
    }
    // The variables may be those of another process, such as a shell from which this one was started.
    if number("LISTEN_PID") != Some(std::process::id()) {
        return Vec::new();
    }
    (FIRST_OF_SYSTEMD..).take(MAX_SOCKETS.min(number("LISTEN_FDS").unwrap_or(0) as usize)).collect()
}

/// Takes over a UDP socket that this process has inherited.
fn inherit(fd: RawFd) -> io::Result<UdpSocket> {
    getsockname::<SockaddrIn>(fd)?;
    // SAFETY: the call above shows that it is open, and nothing closes it while this function runs.
    let borrowed = unsafe { BorrowedFd::borrow_raw(fd) };
    check_udp(borrowed)?;
    if is_close_on_exec(borrowed)? {
        return Err(invalid("not inherited".to_owned()));
    }
    set_close_on_exec(borrowed, true)?;
    // SAFETY: nothing else owns it. It is inherited: the standard library and socket2, with which this
    // process opens sockets, set FD_CLOEXEC on each. It was not taken over before: that sets it, too.
    Ok(unsafe { OwnedFd::from_raw_fd(fd) }.into())
}

fn is_close_on_exec(fd: BorrowedFd<'_>) -> io::Result<bool> {
    Ok(FdFlag::from_bits_retain(fcntl(fd, FcntlArg::F_GETFD)?).contains(FdFlag::FD_CLOEXEC))
}

/// Sets or clears `FD_CLOEXEC`, which keeps the programs that this process starts from inheriting `fd`.
pub(super) fn set_close_on_exec(fd: BorrowedFd<'_>, is_set: bool) -> io::Result<()> {
    let flags = if is_set { FdFlag::FD_CLOEXEC } else { FdFlag::empty() };
    fcntl(fd, FcntlArg::F_SETFD(flags))?;
    Ok(())
}

/// Checks that `fd` is a UDP socket of IPv4.
fn check_udp(fd: BorrowedFd<'_>) -> io::Result<()> {
    let is_ipv4 = getsockname::<SockaddrIn>(fd.as_raw_fd()).is_ok();
    if !is_ipv4 || getsockopt(&fd, sockopt::SockType)? != SockType::Datagram {
        return Err(invalid("no UDP socket of IPv4".to_owned()));
    }
    Ok(())
}

fn invalid(what: String) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidInput, what)
}

#[cfg(test)]
mod tests {
    use std::fs::File;
    use std::net::TcpListener;
    use std::os::fd::IntoRawFd;

    use super::*;

    #[test]
    fn only_an_inherited_udp_socket_of_ipv4_is_taken_over() {
        let refused = |fd: OwnedFd| {
            set_close_on_exec(fd.as_fd(), false).unwrap();
            inherit(fd.as_raw_fd()).unwrap_err()
        };
        refused(File::open("/dev/null").unwrap().into());
        refused(TcpListener::bind("127.0.0.1:0").unwrap().into());
        refused(UnixDatagram::unbound().unwrap().into());
        assert!(inherit(RawFd::MAX).is_err());

        let own = UdpSocket::bind("127.0.0.1:0").unwrap();
        assert_eq!(inherit(own.as_raw_fd()).unwrap_err().to_string(), "not inherited");
        set_close_on_exec(own.as_fd(), false).unwrap();
        let address = own.local_addr().unwrap();
        // Given up here, as by the process that this one would inherit it from.
        let inherited = inherit(own.into_raw_fd()).unwrap();
        assert_eq!(inherited.local_addr().unwrap(), address);
        assert!(is_close_on_exec(inherited.as_fd()).unwrap());
    }

    #[test]
    fn what_arrives_of_a_list_that_is_cut_off_is_closed() {
        let (receiving, sending) = UnixDatagram::pair().unwrap();
        let pairs = [(); 3].map(|()| UnixDatagram::pair().unwrap());
        let fds = pairs.each_ref().map(|(one, _)| one.as_raw_fd());
        send(sending.as_raw_fd(), STORE, &fds).unwrap();
        // As if this process had room for two file descriptors; the third one the kernel closes.
        let received = receive_with(&receiving, cmsg_space!([RawFd; 2]));
        assert!(matches!(received, Some(Request::Unknown)));
        for (one, other) in pairs {
            drop(one);
            let error = other.send(b"").unwrap_err();
            assert_eq!(error.kind(), io::ErrorKind::ConnectionRefused, "a duplicate is open");
        }
        send(sending.as_raw_fd(), STORE, &[]).unwrap();
        let received = receive_with(&receiving, cmsg_space!([RawFd; 2]));
        assert!(matches!(received, Some(Request::Store(sockets)) if sockets.is_empty()));
    }

    #[test]
    fn the_environment_names_the_passed_file_descriptors() {
        let passed = |variables: &[(&str, &str)]| {
            passed(|name| {
                variables.iter().find(|(own, _)| *own == name).map(|(_, value)| (*value).to_owned())
            })
        };
        let own = std::process::id().to_string();
        let none: [RawFd; 0] = [];
        assert_eq!(passed(&[]), none);
        assert_eq!(passed(&[(SOCKETS_VARIABLE, "7,12")]), [7, 12]);
        assert_eq!(passed(&[(SOCKETS_VARIABLE, "x,,-1,2,9999999999,5")]), [5]);
        assert_eq!(passed(&[("LISTEN_PID", &own), ("LISTEN_FDS", "2")]), [3, 4]);
        assert_eq!(passed(&[("LISTEN_PID", "1"), ("LISTEN_FDS", "2")]), none);
        assert_eq!(passed(&[("LISTEN_PID", &own), ("LISTEN_FDS", "x")]), none);
        assert_eq!(passed(&[("LISTEN_PID", &own), ("LISTEN_FDS", "4294967295")]).len(), MAX_SOCKETS);
    }
}
