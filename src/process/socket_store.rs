//! The sockets that `up` keeps for its children, as systemd does with `FileDescriptorStoreMax`.
//!
//! A child sends them over one end of a socket pair, which it inherits. Such a socket has no address, so no
//! other process can send to it.

use std::io;
use std::net::UdpSocket;
use std::os::fd::{AsFd, AsRawFd, BorrowedFd};
use std::os::unix::net::UnixDatagram;
use std::process::{Child, Command};

use nix::sys::stat::fstat;
use tracing::{debug, warn};

use super::kept_sockets::{
    MAX_SOCKETS, Request, SEND_TIMEOUT, SOCKETS_VARIABLE, STORE_VARIABLE, receive, set_close_on_exec,
};

/// Variables of a service manager that are for `up` only, and those with which `up` passes sockets.
const VARIABLES: [&str; 6] =
    ["NOTIFY_SOCKET", "LISTEN_PID", "LISTEN_FDS", "LISTEN_FDNAMES", STORE_VARIABLE, SOCKETS_VARIABLE];

/// The sockets of one child, for its next process.
#[derive(Debug)]
pub(super) struct SocketStore {
    receiving: UnixDatagram,
    /// The end that the child inherits.
    sending: UnixDatagram,
    sockets: Vec<UdpSocket>,
}

impl SocketStore {
    pub fn open() -> io::Result<Self> {
        let (receiving, sending) = UnixDatagram::pair()?;
        sending.set_write_timeout(Some(SEND_TIMEOUT))?;
        Ok(Self { receiving, sending, sockets: Vec::new() })
    }

    /// Handles the messages that have arrived from the child, which may have ended since.
    pub fn receive(&mut self) {
        while let Some(request) = receive(&self.receiving) {
            match request {
                Request::Store(sockets) => sockets.into_iter().for_each(|socket| self.keep(socket)),
                Request::Forget => self.close(),
                Request::Stopping | Request::Unknown => {
                    debug!("ignored a message from a child that is no request")
                }
            }
        }
    }

    /// Closes the sockets.
    pub fn close(&mut self) {
        self.sockets.clear();
    }

    fn keep(&mut self, socket: UdpSocket) {
        // A process that has inherited a socket may store it again.
        let inode = |socket: &UdpSocket| fstat(socket).map(|stat| stat.st_ino).ok();
        if self.sockets.iter().any(|kept| inode(kept) == inode(&socket)) {
            return;
        }
        if self.sockets.len() < MAX_SOCKETS {
            self.sockets.push(socket);
        } else {
            warn!("a child has more than {MAX_SOCKETS} sockets to keep; the others end with it");
        }
    }
}

/// Starts a child, which inherits the sockets of `store` and the socket for messages to it. Without `store`
/// the child has neither.
pub(super) fn spawn(command: &mut Command, store: Option<&SocketStore>) -> io::Result<Child> {
    for variable in VARIABLES {
        command.env_remove(variable);
    }
    let Some(store) = store else { return command.spawn() };
    command.env(STORE_VARIABLE, store.sending.as_raw_fd().to_string());
    if !store.sockets.is_empty() {
        let fds: Vec<String> = store.sockets.iter().map(|socket| socket.as_raw_fd().to_string()).collect();
        command.env(SOCKETS_VARIABLE, fds.join(","));
    }
    // Only while this child starts: another one must not inherit them.
    let _inheritable = Inheritable::new(store)?;
    command.spawn()
}

/// Lets a program that is started inherit the sockets of a store, until it is dropped.
struct Inheritable<'a>(Vec<BorrowedFd<'a>>);

impl<'a> Inheritable<'a> {
    fn new(store: &'a SocketStore) -> io::Result<Self> {
        let sockets = store.sockets.iter().map(AsFd::as_fd);
        let all = Self(sockets.chain([store.sending.as_fd()]).collect());
        all.0.iter().try_for_each(|fd| set_close_on_exec(*fd, false))?;
        Ok(all)
    }
}

impl Drop for Inheritable<'_> {
    fn drop(&mut self) {
        for fd in &self.0 {
            if let Err(error) = set_close_on_exec(*fd, true) {
                warn!(%error, "another child may inherit a socket");
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::fs::{self, File};
    use std::os::fd::RawFd;
    use std::os::linux::net::SocketAddrExt;
    use std::os::unix::net::SocketAddr;
    use std::os::unix::process::ExitStatusExt;
    use std::path::PathBuf;
    use std::time::Duration;

    use nix::sys::signal::{Signal, raise};

    use super::super::kept_sockets::{self, send};
    use super::*;

    const STORE: &str = "FDSTORE=1\nFDNAME=dds\nFDPOLL=0";
    const FORGET: &str = "FDSTOREREMOVE=1\nFDNAME=dds";

    /// Variables of the child of a test: what it is to do, and the port of the test.
    const ROLE_VARIABLE: &str = "SOCKET_TEST_ROLE";
    const PORT_VARIABLE: &str = "SOCKET_TEST_PORT";

    fn udp() -> UdpSocket {
        let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
        socket.set_read_timeout(Some(Duration::from_secs(30))).unwrap();
        socket
    }

    fn links_of_open_files() -> Vec<String> {
        let files = fs::read_dir("/proc/self/fd").unwrap().map(|file| fs::read_link(file.unwrap().path()));
        files.flatten().map(|link| link.display().to_string()).collect()
    }

    /// No test: the process that the next tests start. Does nothing otherwise.
    #[test]
    fn a_child_of_the_next_tests() {
        let Ok(role) = std::env::var(ROLE_VARIABLE) else { return };
        let test = format!("127.0.0.1:{}", std::env::var(PORT_VARIABLE).unwrap());
        let mut sockets = kept_sockets::inherited();
        assert!(kept_sockets::inherited().is_empty());
        match role.as_str() {
            "first" => {
                assert!(sockets.is_empty());
                let socket = udp();
                socket.send_to(b"mine", test).unwrap();
                kept_sockets::store(&[socket]).unwrap();
                raise(Signal::SIGKILL).unwrap();
            }
            "second" => {
                let socket = sockets.pop().unwrap();
                assert!(sockets.is_empty());
                let mut bytes = [0; 32];
                let length = socket.recv(&mut bytes).unwrap();
                socket.send_to(&bytes[..length], test).unwrap();
                kept_sockets::store(&[socket]).unwrap();
            }
            "third" => kept_sockets::forget(),
            other => {
                assert!(sockets.is_empty());
                let variables = VARIABLES.iter().filter(|name| std::env::var_os(name).is_some());
                assert_eq!(variables.count(), 0);
                assert!(!links_of_open_files().contains(&other.to_owned()), "it has inherited {other}");
            }
        }
    }

    /// The process that does what `role` says; `test` is the socket with which it exchanges datagrams.
    fn child(mut command: Command, role: &str, test: &UdpSocket) -> Command {
        let name = "process::socket_store::tests::a_child_of_the_next_tests";
        command.args(["--exact", name, "--nocapture"]).env(ROLE_VARIABLE, role);
        command.env(PORT_VARIABLE, test.local_addr().unwrap().port().to_string());
        command
    }

    fn program() -> PathBuf {
        std::env::current_exe().unwrap()
    }

    #[test]
    fn the_next_process_receives_what_came_while_there_was_none() {
        let test = udp();
        let start = |command: Command, role: &str, store: Option<&SocketStore>| {
            let mut command = child(command, role, &test);
            command.env("NOTIFY_SOCKET", "/nonexistent").env("LISTEN_PID", "1").env("LISTEN_FDS", "1");
            spawn(&mut command, store).unwrap().wait().unwrap()
        };
        let mut store = SocketStore::open().unwrap();
        let first = start(Command::new(program()), "first", Some(&store));
        assert_eq!(first.signal(), Some(Signal::SIGKILL as i32));
        store.receive();
        assert_eq!(store.sockets.len(), 1);
        let mut bytes = [0; 32];
        let (_, address) = test.recv_from(&mut bytes).unwrap();
        assert_eq!(store.sockets[0].local_addr().unwrap(), address);

        let link = format!("socket:[{}]", fstat(&store.sockets[0]).unwrap().st_ino);
        assert!(start(Command::new(program()), &link, None).success());

        // The same as from systemd.
        let mut as_systemd = Command::new("bash");
        let fd = store.sockets[0].as_raw_fd();
        let script =
            format!("unset {SOCKETS_VARIABLE}; LISTEN_PID=$$ LISTEN_FDS=1 exec \"$0\" \"$@\" 3<&{fd}");
        as_systemd.args(["-c", &script]).arg(program());
        for command in [Command::new(program()), as_systemd] {
            test.send_to(b"while it was dead", address).unwrap();
            assert!(start(command, "second", Some(&store)).success());
            let (length, from) = test.recv_from(&mut bytes).unwrap();
            assert_eq!((&bytes[..length], from), (&b"while it was dead"[..], address));
            // It has stored the socket again.
            store.receive();
            assert_eq!(store.sockets.len(), 1);
        }

        assert!(start(Command::new(program()), "third", Some(&store)).success());
        store.receive();
        assert!(store.sockets.is_empty());
    }

    #[test]
    fn a_process_stores_its_socket_with_the_service_manager() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notify");
        let name = format!("adaptive-bridge-test-{}", std::process::id());
        let by_name = SocketAddr::from_abstract_name(&name).unwrap();
        for (manager, address) in [
            (UnixDatagram::bind(&path).unwrap(), path.display().to_string()),
            (UnixDatagram::bind_addr(&by_name).unwrap(), format!("@{name}")),
        ] {
            let test = udp();
            child(Command::new(program()), "first", &test).env("NOTIFY_SOCKET", address).status().unwrap();
            let (_, from) = test.recv_from(&mut [0; 32]).unwrap();
            let Some(Request::Store(sockets)) = receive(&manager) else { panic!("no socket came") };
            assert_eq!(sockets[0].local_addr().unwrap(), from);
        }
    }

    #[test]
    fn what_is_no_request_of_a_child_is_ignored() {
        let mut store = SocketStore::open().unwrap();
        let sending = store.sending.as_raw_fd();
        let sockets: Vec<UdpSocket> = (0..MAX_SOCKETS + 2).map(|_| udp()).collect();
        let fds: Vec<RawFd> = sockets.iter().map(AsRawFd::as_raw_fd).collect();
        let file = File::open("/dev/null").unwrap();
        let mut kept = |message: &str, fds: &[RawFd]| {
            send(sending, message, fds).unwrap();
            store.receive();
            store.sockets.len()
        };
        let long = format!("{STORE}\n{}", "x".repeat(1_000));
        for malformed in ["", "READY=1", "FDSTORE=1", "FDNAME=dds", "FDSTORE", "\0\n=\n", &long] {
            assert_eq!(kept(malformed, &fds[..1]), 0, "{malformed:?}");
        }
        assert_eq!(kept(STORE, &[]), 0);
        assert_eq!(kept(STORE, &[file.as_raw_fd(), sending]), 0);
        assert_eq!(kept(STORE, &[file.as_raw_fd(), fds[0]]), 1);
        assert_eq!(kept(STORE, &fds), MAX_SOCKETS);
        assert_eq!(kept(FORGET, &fds[..1]), 0);
        // Nothing of all that is open any more, also in a message with as many as the kernel allows.
        let inode = fstat(&sockets[0]).unwrap().st_ino;
        assert_eq!(kept("", &[fds[0]; 253]), 0);
        let link = format!("socket:[{inode}]");
        assert_eq!(links_of_open_files().iter().filter(|open| **open == link).count(), 1);
    }
}
