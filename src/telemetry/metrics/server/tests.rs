//! The server with real sockets and clients that behave badly.

use super::*;
use crate::telemetry::samples::wide;

fn server(folder: &tempfile::TempDir) -> (MetricsServer, PathBuf) {
    let path = folder.path().join("metrics.sock");
    (MetricsServer::start(&MetricsListener::Unix(path.clone())).unwrap(), path)
}

fn client(path: &Path) -> UnixStream {
    let client = UnixStream::connect(path).unwrap();
    client.set_read_timeout(Some(Duration::from_secs(120))).unwrap();
    client
}

/// The whole answer to a request.
fn ask(path: &Path, request: &str) -> String {
    let mut client = client(path);
    client.write_all(request.as_bytes()).unwrap();
    let mut answer = String::new();
    client.read_to_string(&mut answer).unwrap();
    answer
}

fn status(answer: &str) -> &str {
    answer.lines().next().unwrap()
}

#[test]
fn the_page_is_that_of_the_latest_report() {
    let folder = tempfile::tempdir().unwrap();
    let (server, path) = server(&folder);
    let get = "GET /metrics HTTP/1.1\r\nHost: robot\r\n\r\n";
    assert_eq!(status(&ask(&path, get)), "HTTP/1.1 503 Service Unavailable");
    server.show(Arc::new(Report { instance: "old".into(), ..wide() }));
    let report = wide();
    server.show(Arc::new(report.clone()));
    let answer = ask(&path, get);
    let (head, body) = answer.split_once("\r\n\r\n").unwrap();
    assert_eq!(body, metrics_page(&report));
    assert_eq!(status(head), "HTTP/1.1 200 OK");
    assert!(head.contains(&format!("\r\nContent-Type: {CONTENT_TYPE}\r\n")), "{head}");
    assert!(head.contains(&format!("\r\nContent-Length: {}\r\n", body.len())), "{head}");
    let head_only = ask(&path, "HEAD /metrics?x=1 HTTP/1.0\r\n\r\n");
    assert_eq!(head_only, format!("{head}\r\n\r\n"));
}

#[test]
fn it_is_served_over_tcp_too() {
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let server = MetricsServer::start(&MetricsListener::Tcp("127.0.0.1".parse().unwrap(), port)).unwrap();
    server.show(Arc::new(wide()));
    let mut client = TcpStream::connect(("127.0.0.1", port)).unwrap();
    // In pieces, and with more than was asked for.
    for piece in ["GET /met", "rics HTTP/1.1\r\n", "\r", "\nunasked"] {
        client.write_all(piece.as_bytes()).unwrap();
        client.flush().unwrap();
    }
    let mut answer = String::new();
    client.read_to_string(&mut answer).unwrap();
    assert_eq!(status(&answer), "HTTP/1.1 200 OK");
    assert!(answer.ends_with(&metrics_page(&wide())));
    drop(server);
    assert_eq!(TcpStream::connect(("127.0.0.1", port)).unwrap_err().kind(), ErrorKind::ConnectionRefused);
}

#[test]
fn what_is_no_request_for_the_page_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (server, path) = server(&folder);
    server.show(Arc::new(wide()));
    for (request, expected) in [
        ("POST /metrics HTTP/1.1\r\n\r\n", "405 Method Not Allowed"),
        ("GET / HTTP/1.1\r\n\r\n", "404 Not Found"),
        ("GET /metrics/x HTTP/1.1\r\n\r\n", "404 Not Found"),
        ("GET /metrics HTTP/2\r\n\r\n", "400 Bad Request"),
        ("GET  /metrics HTTP/1.1\r\n\r\n", "400 Bad Request"),
        ("\u{1}\u{2}é\r\n\r\n", "400 Bad Request"),
        ("\r\n\r\n", "400 Bad Request"),
        (&"x".repeat(MAX_REQUEST_BYTES + 1), "431 Request Header Fields Too Large"),
        (&format!("GET /metrics HTTP/1.1\r\n{}\r\n\r\n", "x".repeat(100_000)), "431 Request"),
    ] {
        let answer = ask(&path, request);
        assert!(status(&answer).starts_with(&format!("HTTP/1.1 {expected}")), "{request:.40}: {answer}");
    }
}

#[test]
fn clients_that_say_nothing_hold_nobody_up_for_long() {
    let folder = tempfile::tempdir().unwrap();
    let (server, path) = server(&folder);
    server.show(Arc::new(wide()));
    // All places are taken: who comes later waits in the kernel's queue.
    let silent: Vec<UnixStream> = (0..MAX_CLIENTS).map(|_| client(&path)).collect();
    let mut slow = client(&path);
    slow.write_all(b"GET /metrics").unwrap();
    let answer = ask(&path, "GET /metrics HTTP/1.1\r\n\r\n");
    assert_eq!(status(&answer), "HTTP/1.1 200 OK");
    // Their time is over.
    for mut client in silent {
        assert_eq!(client.read(&mut [0]).unwrap(), 0);
    }
}

#[test]
fn the_file_of_the_socket_is_for_its_owner_and_goes_with_the_server() {
    let folder = tempfile::tempdir().unwrap();
    let (first, path) = server(&folder);
    let mode = fs::symlink_metadata(&path).unwrap().permissions().mode();
    assert_eq!(mode & 0o777, 0o600);
    let second = MetricsServer::start(&MetricsListener::Unix(path.clone())).unwrap_err();
    assert!(second.to_string().contains("metrics.sock (diagnostics.metrics)"), "{second}");
    drop(first);
    assert!(!path.exists());
    // One that was killed leaves its file.
    drop(UnixListener::bind(&path).unwrap());
    assert!(path.exists());
    let (third, _) = server(&folder);
    third.show(Arc::new(wide()));
    assert_eq!(status(&ask(&path, "GET /metrics HTTP/1.1\r\n\r\n")), "HTTP/1.1 200 OK");
    drop(third);
    // What is no socket is somebody's own.
    fs::write(&path, "mine").unwrap();
    let refused = MetricsServer::start(&MetricsListener::Unix(path.clone())).unwrap_err();
    assert!(refused.to_string().contains("there is a file of that name"), "{refused}");
    assert_eq!(fs::read_to_string(&path).unwrap(), "mine");
}
