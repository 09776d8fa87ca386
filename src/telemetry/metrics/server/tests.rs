//! Tests of the server with real sockets and misbehaving clients.

use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::os::unix::net::UnixListener;

use super::page::CONTENT_TYPE;
use super::*;
use crate::telemetry::test_report::wide_report;

fn server(folder: &tempfile::TempDir) -> (MetricsServer, PathBuf) {
    let path = folder.path().join("metrics.sock");
    (MetricsServer::start(&MetricsListener::Unix(path.clone())).unwrap(), path)
}

fn client(path: &Path) -> UnixStream {
    let client = UnixStream::connect(path).unwrap();
    client.set_read_timeout(Some(Duration::from_secs(120))).unwrap();
    client
}

/// Sends a request and returns the whole response.
fn request(path: &Path, text: &str) -> String {
    let mut client = client(path);
    client.write_all(text.as_bytes()).unwrap();
    let mut response = String::new();
    client.read_to_string(&mut response).unwrap();
    response
}

fn status(response: &str) -> &str {
    response.lines().next().unwrap()
}

#[test]
fn the_page_is_that_of_the_latest_report() {
    let folder = tempfile::tempdir().unwrap();
    let (server, path) = server(&folder);
    let get = "GET /metrics HTTP/1.1\r\nHost: robot\r\n\r\n";
    assert_eq!(status(&request(&path, get)), "HTTP/1.1 503 Service Unavailable");
    server.set_report(Arc::new(Report { instance: "old".into(), ..wide_report() }));
    let report = wide_report();
    server.set_report(Arc::new(report.clone()));
    let response = request(&path, get);
    let (head, body) = response.split_once("\r\n\r\n").unwrap();
    assert_eq!(body, metrics_page(&report));
    assert_eq!(status(head), "HTTP/1.1 200 OK");
    for field in [format!("Content-Type: {CONTENT_TYPE}"), format!("Content-Length: {}", body.len())] {
        assert!(head.split("\r\n").any(|line| line == field), "{head}");
    }
    let head_only = request(&path, "HEAD /metrics?x=1 HTTP/1.1\r\n\r\n");
    assert_eq!(head_only, format!("{head}\r\n\r\n"));
    let old = request(&path, "GET /metrics HTTP/1.0\r\n\r\n");
    assert_eq!((status(&old), old.ends_with(body)), ("HTTP/1.0 200 OK", true));
}

#[test]
fn the_page_is_also_served_over_tcp() {
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let server = MetricsServer::start(&MetricsListener::Tcp("127.0.0.1".parse().unwrap(), port)).unwrap();
    server.set_report(Arc::new(wide_report()));
    let mut client = TcpStream::connect(("127.0.0.1", port)).unwrap();
    // The request is sent in pieces, followed by unneeded bytes.
    for piece in ["GET /met", "rics HTTP/1.1\r\n", "\r", "\nunasked"] {
        client.write_all(piece.as_bytes()).unwrap();
        client.flush().unwrap();
    }
    let mut response = String::new();
    client.read_to_string(&mut response).unwrap();
    assert_eq!(status(&response), "HTTP/1.1 200 OK");
    assert!(response.ends_with(&metrics_page(&wide_report())));
    drop(server);
    assert_eq!(TcpStream::connect(("127.0.0.1", port)).unwrap_err().kind(), ErrorKind::ConnectionRefused);
}

#[test]
fn bad_requests_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (server, path) = server(&folder);
    server.set_report(Arc::new(wide_report()));
    for (bad, expected) in [
        ("POST /metrics HTTP/1.1\r\n\r\n", "405 Method Not Allowed"),
        ("GET / HTTP/1.1\r\n\r\n", "404 Not Found"),
        ("GET /metrics/x HTTP/1.1\r\n\r\n", "404 Not Found"),
        ("GET /metrics HTTP/2\r\n\r\n", "400 Bad Request"),
        ("GET  /metrics HTTP/1.1\r\n\r\n", "400 Bad Request"),
        ("\u{1}\u{2}é\r\n\r\n", "400 Bad Request"),
        // Empty lines before the request are ignored, as RFC 9112 asks for.
        ("\r\n\r\nGET\r\n\r\n", "400 Bad Request"),
        (&"x".repeat(MAX_REQUEST_BYTES + 1), "431 Request Header Fields Too Large"),
        (&format!("GET /metrics HTTP/1.1\r\n{}\r\n\r\n", "x".repeat(100_000)), "431 Request"),
    ] {
        let response = request(&path, bad);
        assert!(status(&response).starts_with(&format!("HTTP/1.1 {expected}")), "{bad:.40}: {response}");
    }
}

#[test]
fn silent_clients_delay_others_only_until_their_timeout() {
    let folder = tempfile::tempdir().unwrap();
    let (server, path) = server(&folder);
    server.set_report(Arc::new(wide_report()));
    // All places are taken: a later client waits in the kernel's queue.
    let silent: Vec<UnixStream> = (0..MAX_CLIENTS).map(|_| client(&path)).collect();
    let mut slow = client(&path);
    slow.write_all(b"GET /metrics").unwrap();
    let response = request(&path, "GET /metrics HTTP/1.1\r\n\r\n");
    assert_eq!(status(&response), "HTTP/1.1 200 OK");
    // The silent clients have timed out.
    for mut client in silent {
        assert_eq!(client.read(&mut [0]).unwrap(), 0);
    }
}

#[test]
fn the_socket_file_is_for_its_owner_and_is_removed_with_the_server() {
    let folder = tempfile::tempdir().unwrap();
    let (first, path) = server(&folder);
    let mode = fs::symlink_metadata(&path).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o600);
    let second = MetricsServer::start(&MetricsListener::Unix(path.clone())).unwrap_err();
    assert!(second.to_string().contains("metrics.sock (diagnostics.metrics)"), "{second}");
    drop(first);
    assert!(!path.exists());
    // A killed server leaves its file behind.
    drop(UnixListener::bind(&path).unwrap());
    assert!(path.exists());
    let (third, _) = server(&folder);
    third.set_report(Arc::new(wide_report()));
    assert_eq!(status(&request(&path, "GET /metrics HTTP/1.1\r\n\r\n")), "HTTP/1.1 200 OK");
    drop(third);
    // A file that is not a socket is kept.
    fs::write(&path, "mine").unwrap();
    let refused = MetricsServer::start(&MetricsListener::Unix(path.clone())).unwrap_err();
    assert!(refused.to_string().contains("exists and is not a socket"), "{refused}");
    assert_eq!(fs::read_to_string(&path).unwrap(), "mine");
}
