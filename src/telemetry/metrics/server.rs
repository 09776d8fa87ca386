//! Serves the metrics page over HTTP: TCP on a loopback address, or a unix socket.
//!
//! hyper serves all connections on one thread of their own, in a tokio runtime of that thread: a slow client
//! only takes one of the places until its timeout, and control never waits for it. The caller passes each
//! report under a lock that is held for the copy of a pointer; the thread writes the page when a client
//! requests it.

use std::convert::Infallible;
use std::fs;
use std::future::{poll_fn, ready};
use std::io::{self, ErrorKind};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use http_body_util::Full;
use hyper::body::{Bytes, Incoming};
use hyper::header::{ALLOW, CONTENT_TYPE, HeaderValue};
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Method, Request, Response, StatusCode};
use hyper_util::rt::TokioIo;
use nix::sys::socket::{AddressFamily, Backlog, SockFlag, SockType, UnixAddr, bind, listen, socket};
use nix::sys::stat::{Mode, fchmod};
use tokio::io::{AsyncRead, AsyncReadExt, AsyncWrite, AsyncWriteExt};
use tokio::net::{TcpListener, UnixListener};
use tokio::runtime;
use tokio::sync::{OwnedSemaphorePermit, Semaphore, oneshot};

use super::metrics_page;
use super::page;
use crate::config::MetricsListener;
use crate::telemetry::report::Report;

/// Clients served at once; further clients wait in the kernel's queue.
const MAX_CLIENTS: usize = 8;
/// The time that a client has to send its request and to read the response.
const CLIENT_TIMEOUT: Duration = Duration::from_secs(5);
/// The maximum size of a request; requests of scrapers are smaller.
const MAX_REQUEST_BYTES: usize = 8 * 1024;
/// The pause before a retry when the system lacks resources.
const RETRY_PAUSE: Duration = Duration::from_millis(100);

type Latest = Arc<Mutex<Option<Arc<Report>>>>;

/// The reason why the metrics page cannot be served.
#[derive(Debug, thiserror::Error)]
#[error("cannot serve the metrics page on {address} (diagnostics.metrics): {source}")]
pub struct MetricsError {
    address: String,
    source: io::Error,
}

/// The HTTP server of the metrics page. Dropping it stops the thread and removes the file of a unix socket.
#[derive(Debug)]
pub struct MetricsServer {
    latest: Latest,
    /// Dropped to end the thread.
    stop: Option<oneshot::Sender<Infallible>>,
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
        Self::try_start(listener).map_err(|source| MetricsError { address, source })
    }

    fn try_start(listener: &MetricsListener) -> io::Result<Self> {
        let runtime = runtime::Builder::new_current_thread().enable_io().enable_time().build()?;
        let listening = runtime.block_on(Listener::open(listener))?;
        let (stop, stopped) = oneshot::channel::<Infallible>();
        let latest = Latest::default();
        let reports = latest.clone();
        let serve = move || {
            runtime.block_on(async {
                // Ends when the runtime is dropped, as the tasks of the clients do.
                tokio::spawn(serve(listening, reports));
                // Returns when `MetricsServer` drops the sender.
                let _ = stopped.await;
            });
        };
        let thread = thread::Builder::new().name("metrics".to_owned()).spawn(serve)?;
        Ok(Self { latest, stop: Some(stop), thread: Some(thread) })
    }

    /// Serves this report from now on. It waits at most for another thread to copy a pointer.
    pub fn set_report(&self, report: Arc<Report>) {
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
    async fn open(listener: &MetricsListener) -> io::Result<Self> {
        match listener {
            MetricsListener::Tcp(ip, port) => Ok(Self::Tcp(TcpListener::bind((*ip, *port)).await?)),
            MetricsListener::Unix(path) => Ok(Self::Unix(SocketFile::listen(path)?)),
        }
    }

    /// Accepts a client, and serves it in a task that holds `place` until its end.
    async fn accept(&self, latest: &Latest, place: OwnedSemaphorePermit) -> io::Result<()> {
        let latest = latest.clone();
        match self {
            Self::Tcp(listener) => tokio::spawn(client(listener.accept().await?.0, latest, place)),
            Self::Unix(file) => tokio::spawn(client(file.listener.accept().await?.0, latest, place)),
        };
        Ok(())
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
        // The file gets the socket's mode, less the umask: no other user can connect before it is set below.
        fchmod(&fd, Mode::S_IRUSR | Mode::S_IWUSR)?;
        bind(fd.as_raw_fd(), &UnixAddr::new(path)?)?;
        listen(&fd, Backlog::new(MAX_CLIENTS as i32)?)?;
        let file = fs::symlink_metadata(path)?;
        let identity = (file.dev(), file.ino());
        let listener = UnixListener::from_std(fd.into())?;
        let bound = Self { listener, path: path.to_owned(), identity };
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

async fn serve(listener: Listener, latest: Latest) {
    let places = Arc::new(Semaphore::new(MAX_CLIENTS));
    while let Ok(place) = places.clone().acquire_owned().await {
        match listener.accept(&latest, place).await {
            Ok(()) => {}
            // The client has disconnected already.
            Err(error) if matches!(error.kind(), ErrorKind::ConnectionAborted | ErrorKind::Interrupted) => {}
            Err(error) => {
                // For example, no file descriptor is free.
                tracing::warn!(%error, "the metrics page cannot accept a client; it retries in 100 ms");
                tokio::time::sleep(RETRY_PAUSE).await;
            }
        }
    }
}

async fn client(stream: impl AsyncRead + AsyncWrite + Unpin, latest: Latest, _place: OwnedSemaphorePermit) {
    // A client that takes too long is disconnected.
    let _ = tokio::time::timeout(CLIENT_TIMEOUT, exchange(stream, &latest)).await;
}

/// Reads one request and responds to it.
async fn exchange(stream: impl AsyncRead + AsyncWrite + Unpin, latest: &Latest) {
    let service = service_fn(|request| ready(Ok::<_, Infallible>(respond(&request, latest))));
    let mut connection = http1::Builder::new()
        .keep_alive(false)
        .half_close(true)
        .auto_date_header(false)
        .title_case_headers(true)
        .max_buf_size(MAX_REQUEST_BYTES)
        .serve_connection(TokioIo::new(stream), service);
    // An error concerns only this client; hyper has responded to a bad request.
    let _ = poll_fn(|context| connection.poll_without_shutdown(context)).await;
    // What the client still sends is read and discarded. Closing a connection with unread bytes resets it,
    // and the client may lose the response.
    let mut stream = connection.into_parts().io.into_inner();
    if stream.shutdown().await.is_ok() {
        let mut unread = [0; 2048];
        while stream.read(&mut unread).await.is_ok_and(|count| count > 0) {}
    }
}

fn respond(request: &Request<Incoming>, latest: &Latest) -> Response<Full<Bytes>> {
    if !matches!(*request.method(), Method::GET | Method::HEAD) {
        let mut refusal = refusal(StatusCode::METHOD_NOT_ALLOWED, "only GET and HEAD are allowed\n");
        refusal.headers_mut().insert(ALLOW, HeaderValue::from_static("GET, HEAD"));
        return refusal;
    }
    if request.uri().path() != "/metrics" {
        return refusal(StatusCode::NOT_FOUND, "no such page; the metrics are at /metrics\n");
    }
    #[allow(clippy::disallowed_methods, reason = "held for the copy of a pointer")]
    let report = latest.lock().unwrap_or_else(PoisonError::into_inner).clone();
    match report {
        Some(report) => response(page::CONTENT_TYPE, metrics_page(&report).into()),
        None => refusal(
            StatusCode::SERVICE_UNAVAILABLE,
            "control has made no report yet; retry in a few seconds\n",
        ),
    }
}

fn refusal(status: StatusCode, text: &'static str) -> Response<Full<Bytes>> {
    let mut refusal = response("text/plain; charset=utf-8", Bytes::from_static(text.as_bytes()));
    *refusal.status_mut() = status;
    refusal
}

fn response(content_type: &'static str, body: Bytes) -> Response<Full<Bytes>> {
    let mut response = Response::new(Full::new(body));
    response.headers_mut().insert(CONTENT_TYPE, HeaderValue::from_static(content_type));
    response
}

#[cfg(test)]
mod tests;
