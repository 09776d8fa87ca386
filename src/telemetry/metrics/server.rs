//! Serves the metrics page over HTTP: TCP on a loopback address, or a unix socket.
//!
//! One thread serves all connections without blocking on any of them: a slow client only takes one of the
//! places until its timeout. The caller passes each report under a lock that is held for the copy of a
//! pointer; the thread writes the page when a client requests it.
//!
//! The server is written here because it is small: HTTP/1.1 with GET and HEAD, one page, and a connection
//! that ends after the response. tiny_http, the only small library without an asynchronous runtime, has no
//! timeouts (its issue 143) and no release since 2022.

use std::fmt;
use std::io::{self, ErrorKind, Read, Write};
use std::net::{Shutdown, TcpListener, TcpStream};
use std::os::fd::{AsFd, AsRawFd, BorrowedFd};
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;
use std::{fs, thread};

use nix::poll::{PollFd, PollFlags, PollTimeout, poll};
use nix::sys::socket::{AddressFamily, Backlog, SockFlag, SockType, UnixAddr, bind, listen, socket};
use nix::sys::stat::{Mode, fchmod};

use super::metrics_page;
use super::page::CONTENT_TYPE;
use crate::clock;
use crate::config::MetricsListener;
use crate::model::MonotonicNs;
use crate::telemetry::report::Report;

/// Clients served at once; further clients wait in the kernel's queue.
const MAX_CLIENTS: usize = 8;
/// The time that a client has to send its request and to read the response.
const CLIENT_MS: u64 = 5_000;
/// The maximum size of a request; requests of scrapers are smaller.
const MAX_REQUEST_BYTES: usize = 8 * 1024;
/// The pause before a retry when the system lacks resources.
const RETRY_PAUSE: Duration = Duration::from_millis(100);
/// Reads and writes for one client in one turn, so that a fast client does not delay the others.
const MAX_STEPS: usize = 16;

/// The reason why the metrics page cannot be served.
#[derive(Debug)]
pub struct MetricsError {
    address: String,
    cause: io::Error,
}

impl fmt::Display for MetricsError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "cannot serve the metrics page on {} (diagnostics.metrics): {}", self.address, self.cause)
    }
}

impl std::error::Error for MetricsError {
    fn source(&self) -> Option<&(dyn std::error::Error + 'static)> {
        Some(&self.cause)
    }
}

/// The HTTP server of the metrics page. Dropping it stops the thread and removes the file of a unix socket.
#[derive(Debug)]
pub struct MetricsServer {
    latest: Arc<Mutex<Option<Arc<Report>>>>,
    /// Closed to end the thread.
    stop: Option<UnixStream>,
    thread: Option<JoinHandle<()>>,
}

impl MetricsServer {
    /// Starts to listen and to serve. Before the first report it responds with 503.
    ///
    /// # Errors
    /// The address is in use, listening on it fails, or the thread cannot be started. The file of a unix
    /// socket without a listener is replaced; a file of another kind is an error.
    pub fn start(listener: &MetricsListener) -> Result<Self, MetricsError> {
        let address = match listener {
            MetricsListener::Tcp(ip, port) => std::net::SocketAddr::new(*ip, *port).to_string(),
            MetricsListener::Unix(path) => path.display().to_string(),
        };
        Self::try_start(listener).map_err(|cause| MetricsError { address, cause })
    }

    fn try_start(listener: &MetricsListener) -> io::Result<Self> {
        let listening = match listener {
            MetricsListener::Tcp(ip, port) => Listener::Tcp(TcpListener::bind((*ip, *port))?),
            MetricsListener::Unix(path) => Listener::Unix(SocketFile::listen(path)?),
        };
        listening.set_nonblocking()?;
        let (stop, stopped) = UnixStream::pair()?;
        let latest = Arc::new(Mutex::new(None));
        let reports = latest.clone();
        let serve = move || serve(&listening, &stopped, &reports);
        let thread = thread::Builder::new().name("metrics".to_owned()).spawn(serve)?;
        Ok(Self { latest, stop: Some(stop), thread: Some(thread) })
    }

    /// Serves this report from now on. It waits at most for another thread to copy a pointer.
    pub fn show(&self, report: Arc<Report>) {
        #[allow(clippy::disallowed_methods, reason = "held for the copy of a pointer")]
        let former = self.latest.lock().unwrap_or_else(PoisonError::into_inner).replace(report);
        // The former report is freed after the lock is released.
        drop(former);
    }
}

impl Drop for MetricsServer {
    fn drop(&mut self) {
        self.stop = None;
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::error!("the thread of the metrics page panicked");
        }
    }
}

/// The listening socket.
enum Listener {
    Tcp(TcpListener),
    Unix(SocketFile),
}

impl Listener {
    fn set_nonblocking(&self) -> io::Result<()> {
        match self {
            Self::Tcp(listener) => listener.set_nonblocking(true),
            Self::Unix(file) => file.listener.set_nonblocking(true),
        }
    }

    fn accept(&self) -> io::Result<Stream> {
        let stream = match self {
            Self::Tcp(listener) => Stream::Tcp(listener.accept()?.0),
            Self::Unix(file) => Stream::Unix(file.listener.accept()?.0),
        };
        match &stream {
            Stream::Tcp(stream) => stream.set_nonblocking(true)?,
            Stream::Unix(stream) => stream.set_nonblocking(true)?,
        }
        Ok(stream)
    }
}

impl AsFd for Listener {
    fn as_fd(&self) -> BorrowedFd<'_> {
        match self {
            Self::Tcp(listener) => listener.as_fd(),
            Self::Unix(file) => file.listener.as_fd(),
        }
    }
}

/// A listening unix socket. Dropping it removes its file.
struct SocketFile {
    listener: UnixListener,
    path: PathBuf,
    /// Device and inode of the file that this process created.
    identity: (u64, u64),
}

impl SocketFile {
    fn listen(path: &Path) -> io::Result<Self> {
        Self::remove_stale(path)?;
        let flags = SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK;
        let fd = socket(AddressFamily::Unix, SockType::Stream, flags, None)?;
        // The file gets the mode of the socket, less the umask, so no other user can connect before the mode
        // is set below.
        fchmod(&fd, Mode::S_IRUSR | Mode::S_IWUSR)?;
        bind(fd.as_raw_fd(), &UnixAddr::new(path)?)?;
        listen(&fd, Backlog::new(MAX_CLIENTS as i32)?)?;
        let file = fs::symlink_metadata(path)?;
        let identity = (file.dev(), file.ino());
        let bound = Self { listener: UnixListener::from(fd), path: path.to_owned(), identity };
        fs::set_permissions(path, fs::Permissions::from_mode(0o600))?;
        Ok(bound)
    }

    /// Removes the socket file of a process that was killed.
    fn remove_stale(path: &Path) -> io::Result<()> {
        match fs::symlink_metadata(path) {
            Err(error) if error.kind() == ErrorKind::NotFound => Ok(()),
            Err(error) => Err(error),
            Ok(file) if !file.file_type().is_socket() => Err(io::Error::new(
                ErrorKind::AlreadyExists,
                "the path exists and is not a socket; remove it or choose another path",
            )),
            Ok(_) => match UnixStream::connect(path) {
                Ok(_) => Err(ErrorKind::AddrInUse.into()),
                Err(error) if error.kind() == ErrorKind::ConnectionRefused => fs::remove_file(path),
                Err(error) => Err(error),
            },
        }
    }
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        let file = fs::symlink_metadata(&self.path);
        if file.is_ok_and(|file| (file.dev(), file.ino()) == self.identity) {
            let _ = fs::remove_file(&self.path);
        }
    }
}

enum Stream {
    Tcp(TcpStream),
    Unix(UnixStream),
}

impl Stream {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        match self {
            Self::Tcp(stream) => stream.read(buffer),
            Self::Unix(stream) => stream.read(buffer),
        }
    }

    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        match self {
            Self::Tcp(stream) => stream.write(bytes),
            Self::Unix(stream) => stream.write(bytes),
        }
    }

    fn shut_down_write(&self) -> io::Result<()> {
        match self {
            Self::Tcp(stream) => stream.shutdown(Shutdown::Write),
            Self::Unix(stream) => stream.shutdown(Shutdown::Write),
        }
    }
}

impl AsFd for Stream {
    fn as_fd(&self) -> BorrowedFd<'_> {
        match self {
            Self::Tcp(stream) => stream.as_fd(),
            Self::Unix(stream) => stream.as_fd(),
        }
    }
}

/// Serves until the other end of `stopped` is closed.
fn serve(listener: &Listener, stopped: &UnixStream, reports: &Mutex<Option<Arc<Report>>>) {
    #[allow(clippy::disallowed_methods, reason = "held for the copy of a pointer")]
    let latest = || reports.lock().unwrap_or_else(PoisonError::into_inner).clone();
    let mut clients: Vec<Client> = Vec::with_capacity(MAX_CLIENTS);
    loop {
        let now = clock::monotonic();
        clients.retain(|client| now < client.until);
        let Some(ready) = wait(listener, stopped, &clients, now) else { continue };
        if ready[0] {
            return;
        }
        let mut client_ready = ready[2..].iter();
        clients.retain_mut(|client| client_ready.next() != Some(&true) || client.turn(&latest));
        if ready[1] {
            accept(listener, &mut clients);
        }
    }
}

/// Waits for an event: whether `stopped`, the listener and each client are ready. `None` when a client's time
/// is over.
fn wait(
    listener: &Listener,
    stopped: &UnixStream,
    clients: &[Client],
    now: MonotonicNs,
) -> Option<Vec<bool>> {
    let for_new_clients = if clients.len() < MAX_CLIENTS { PollFlags::POLLIN } else { PollFlags::empty() };
    let mut fds =
        vec![PollFd::new(stopped.as_fd(), PollFlags::POLLIN), PollFd::new(listener.as_fd(), for_new_clients)];
    fds.extend(clients.iter().map(|client| PollFd::new(client.stream.as_fd(), client.waits_for())));
    let left_ms = clients.iter().map(|client| client.until.since(now) / 1_000_000 + 1).min();
    let timeout =
        left_ms.map_or(PollTimeout::NONE, |ms| PollTimeout::try_from(ms).unwrap_or(PollTimeout::MAX));
    match poll(&mut fds, timeout) {
        Ok(1..) => Some(fds.iter().map(|fd| fd.any().unwrap_or(true)).collect()),
        Ok(_) | Err(nix::errno::Errno::EINTR) => None,
        Err(error) => {
            tracing::error!(%error, "the metrics page cannot poll its clients; it retries in 100 ms");
            #[allow(clippy::disallowed_methods, reason = "this thread handles no samples")]
            thread::sleep(RETRY_PAUSE);
            None
        }
    }
}

fn accept(listener: &Listener, clients: &mut Vec<Client>) {
    while clients.len() < MAX_CLIENTS {
        match listener.accept() {
            Ok(stream) => clients.push(Client {
                stream,
                until: clock::monotonic().plus_ms(CLIENT_MS),
                request: Vec::new(),
                state: State::ReadingRequest,
            }),
            Err(error) if error.kind() == ErrorKind::WouldBlock => return,
            // The client has disconnected already.
            Err(error) if matches!(error.kind(), ErrorKind::ConnectionAborted | ErrorKind::Interrupted) => {}
            Err(error) => {
                // For example, no file descriptor is free.
                tracing::warn!(%error, "the metrics page cannot accept a client; it retries in 100 ms");
                #[allow(clippy::disallowed_methods, reason = "this thread handles no samples")]
                thread::sleep(RETRY_PAUSE);
                return;
            }
        }
    }
}

/// One connection.
struct Client {
    stream: Stream,
    until: MonotonicNs,
    request: Vec<u8>,
    state: State,
}

enum State {
    ReadingRequest,
    WritingResponse {
        response: Vec<u8>,
        written: usize,
    },
    /// The response is sent, and what the client still sends is read and discarded. Closing a connection with
    /// unread bytes resets it, and the client may lose the response.
    Draining,
}

impl Client {
    fn waits_for(&self) -> PollFlags {
        match self.state {
            State::ReadingRequest | State::Draining => PollFlags::POLLIN,
            State::WritingResponse { .. } => PollFlags::POLLOUT,
        }
    }

    /// Proceeds as far as possible without blocking; returns whether the client stays connected.
    fn turn(&mut self, latest: &dyn Fn() -> Option<Arc<Report>>) -> bool {
        for _ in 0..MAX_STEPS {
            match self.step(latest) {
                Ok(true) => {}
                Ok(false) => return false,
                Err(error) if error.kind() == ErrorKind::WouldBlock => return true,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(_) => return false,
            }
        }
        true
    }

    fn step(&mut self, latest: &dyn Fn() -> Option<Arc<Report>>) -> io::Result<bool> {
        let mut buffer = [0; 2048];
        match &mut self.state {
            State::ReadingRequest => {
                let count = self.stream.read(&mut buffer)?;
                self.request.extend_from_slice(&buffer[..count]);
                let is_complete = self.request.windows(4).any(|bytes| bytes == b"\r\n\r\n");
                if is_complete || self.request.len() > MAX_REQUEST_BYTES {
                    let response =
                        if is_complete { respond(&self.request, latest) } else { refusal(TOO_LARGE) };
                    self.state = State::WritingResponse { response, written: 0 };
                    self.request = Vec::new();
                }
                Ok(count > 0)
            }
            State::WritingResponse { response, written } => {
                *written += self.stream.write(&response[*written..])?;
                if *written == response.len() {
                    self.stream.shut_down_write()?;
                    self.state = State::Draining;
                }
                Ok(true)
            }
            State::Draining => Ok(self.stream.read(&mut buffer)? > 0),
        }
    }
}

const NOT_HTTP: &str = "400 Bad Request";
const NOT_FOUND: &str = "404 Not Found";
const NOT_ALLOWED: &str = "405 Method Not Allowed";
const TOO_LARGE: &str = "431 Request Header Fields Too Large";
const NOT_YET: &str = "503 Service Unavailable";

/// The response to a request with a complete head (RFC 9112).
fn respond(request: &[u8], latest: &dyn Fn() -> Option<Arc<Report>>) -> Vec<u8> {
    let line = request.split(|&byte| byte == b'\r').next().unwrap_or_default();
    let words: Vec<&str> = std::str::from_utf8(line).unwrap_or_default().split(' ').collect();
    let (method, target) = match words[..] {
        [method, target, "HTTP/1.0" | "HTTP/1.1"] => (method, target),
        _ => return refusal(NOT_HTTP),
    };
    if !matches!(method, "GET" | "HEAD") {
        return refusal(NOT_ALLOWED);
    }
    if target.split('?').next() != Some("/metrics") {
        return refusal(NOT_FOUND);
    }
    match latest() {
        Some(report) => response("200 OK", CONTENT_TYPE, &metrics_page(&report), method == "HEAD"),
        None => refusal(NOT_YET),
    }
}

fn refusal(status: &str) -> Vec<u8> {
    let body = match status {
        NOT_FOUND => "no such page; the metrics are at /metrics\n",
        NOT_ALLOWED => "only GET and HEAD are allowed\n",
        NOT_YET => "control has made no report yet; retry in a few seconds\n",
        _ => "",
    };
    response(status, "text/plain; charset=utf-8", body, false)
}

fn response(status: &str, content_type: &str, body: &str, head_only: bool) -> Vec<u8> {
    let allow = if status == NOT_ALLOWED { "Allow: GET, HEAD\r\n" } else { "" };
    let mut text = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {content_type}\r\nContent-Length: {}\r\n{allow}\
         Connection: close\r\n\r\n",
        body.len()
    );
    if !head_only {
        text.push_str(body);
    }
    text.into_bytes()
}

#[cfg(test)]
mod tests;
