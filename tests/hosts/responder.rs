//! The responder as a program: the shipped binary on one host answers bridges on another host, which use the
//! bridge's DDS module. Their messages follow docs/probe-protocol.md, or are hostile.

use std::fs::{self, File};
use std::path::Path;
use std::process::{Command, Output};
use std::time::{Duration, Instant};

use adaptive_bridge::clock;
use adaptive_bridge::config::{DdsNetwork, SecretSource, Security, TrustMode};
use adaptive_bridge::dds::{Participant, ParticipantOptions, RawReader, RawWriter, Take};
use adaptive_bridge::model::{Encapsulation, SourceTimestamp, WallNs};
use adaptive_bridge::policy::burst_for;
use adaptive_bridge::process::probes::{
    PROBE_READER_QOS, PROBE_TYPE, PROBE_WRITER_QOS, ProbeId, ProbeRequest, ProbeResponse, Trust,
};
use bytes::Bytes;
use nix::sched::{CloneFlags, setns};
use serde_json::{Value, json};
use support::bridge::program;
use support::netns::{Host, Net, requires_root};
use support::process::{Process, memory_kib};
use support::{skip, wait_for, wait_until};

const SECRET: &str = "an ill-kept secret of many bytes";

/// Creates two hosts; `None` if the machine cannot, which records the test as skipped.
fn net(test: &str) -> Option<Net> {
    match requires_root() {
        Some(reason) => {
            skip(test, &reason);
            None
        }
        None => Some(Net::new(&["bridge", "laptop"])),
    }
}

/// Starts a responder and waits until it is up.
fn start(host: &Host, arguments: &[&str]) -> Process {
    let mut command = host.command(program());
    command.args(["responder", "--id", "laptop 1"]).args(arguments);
    command.env_remove("ROS_DOMAIN_ID").env_remove("ADAPTIVE_BRIDGE_CONFIG").env("NO_COLOR", "1");
    let responder = Process::spawn("responder", command);
    responder.wait_for_log("responder is up");
    responder
}

/// The endpoints of a bridge: a writer of requests and a reader of responses, matched with the responder's.
struct Asker {
    responses: RawReader,
    requests: RawWriter,
    _participant: Participant,
    name: &'static str,
    sent: u64,
    received: Vec<(Vec<u8>, Encapsulation)>,
}

impl Asker {
    fn join(host: &Host, name: &'static str) -> Asker {
        let namespace = format!("/run/netns/{}", host.namespace());
        // The threads and sockets of the participant are in the network namespace of the thread that creates
        // it.
        let joined = std::thread::spawn(move || {
            setns(File::open(namespace).unwrap(), CloneFlags::CLONE_NEWNET).unwrap();
            let mut participant = Participant::open(&ParticipantOptions {
                network: &DdsNetwork::of_domain(0),
                namespace: "/test".to_owned(),
                node_name: name.to_owned(),
                graph_gid_bytes: 16,
                dscp: 0,
            })
            .unwrap();
            let responses = participant
                .create_reader("rt/adaptive_bridge/probe_resp", PROBE_TYPE, &PROBE_READER_QOS)
                .unwrap();
            let requests = participant
                .create_writer("rt/adaptive_bridge/probe_req", PROBE_TYPE, &PROBE_WRITER_QOS, 16)
                .unwrap();
            Asker { responses, requests, _participant: participant, name, sent: 0, received: Vec::new() }
        });
        let asker = joined.join().unwrap();
        wait_until("a responder", || asker.requests.matched_readers().count() == 1);
        asker
    }

    fn send_payload(&self, payload: impl Into<Bytes>) {
        let _ = self.requests.write(payload.into(), Encapsulation::CDR_LE, SourceTimestamp::NONE);
    }

    fn send(&self, json: &str) {
        self.send_payload(cdr(json));
    }

    /// The responses received so far.
    fn received(&mut self) -> &[(Vec<u8>, Encapsulation)] {
        let received = &mut self.received;
        let mut keep = |payload: &[u8], encapsulation| received.push((payload.to_vec(), encapsulation));
        while self.responses.take(&mut keep) != Take::Empty {}
        &self.received
    }

    /// Makes a request of this bridge with a new number.
    fn request(&mut self) -> ProbeRequest {
        self.sent += 1;
        ProbeRequest {
            seq: self.sent,
            send_time: clock::wall(),
            sender_id: self.name.to_owned(),
            probe_id: ProbeId::Text(format!("{}-{}", self.name, self.sent)),
            signature: None,
        }
    }

    /// Sends valid requests until one is answered; a BEST_EFFORT reader may lose some.
    fn ask(&mut self, mut make: impl FnMut(ProbeRequest) -> ProbeRequest) -> (ProbeRequest, ProbeResponse) {
        wait_for("a response", || {
            let request = self.request();
            let request = make(request);
            self.send_payload(request.encode());
            let until = Instant::now() + Duration::from_millis(300);
            while Instant::now() < until {
                let response = self.decoded().into_iter().find(|it| it.probe_id == request.probe_id);
                if let Some(response) = response {
                    return Some((request, response));
                }
                std::thread::sleep(Duration::from_millis(5));
            }
            None
        })
    }

    fn decoded(&mut self) -> Vec<ProbeResponse> {
        let received = self.received().iter();
        received
            .map(|(payload, encapsulation)| ProbeResponse::decode(payload, *encapsulation).unwrap())
            .collect()
    }

    /// Asserts that no request with a probe id that contains `what` was answered.
    fn assert_unanswered(&mut self, what: &str) {
        let answered = self.decoded().into_iter().find(|it| it.probe_id.to_string().contains(what));
        assert_eq!(answered, None);
    }
}

/// Encodes a `std_msgs/String` in little-endian CDR.
fn cdr(text: &str) -> Vec<u8> {
    [&(text.len() as u32 + 1).to_le_bytes()[..], text.as_bytes(), &[0]].concat()
}

/// Decodes the text of a `std_msgs/String`.
fn text(payload: &[u8]) -> &str {
    let length = u32::from_le_bytes(payload[..4].try_into().unwrap()) as usize;
    std::str::from_utf8(&payload[4..4 + length - 1]).unwrap()
}

/// Signs and checks messages with the secret in a file.
fn trust(secret: &Path) -> Trust {
    let security = Security {
        trust_mode: TrustMode::DefaultDeny,
        enable_probe_hmac: true,
        secret: Some(SecretSource::File(secret.to_owned())),
        replay_window_ms: 30_000,
        max_probe_rate_hz: 20,
        allow_legacy_node_name_overrides: true,
    };
    Trust::load(&security, None).unwrap()
}

fn run(arguments: &[&str]) -> Output {
    let mut command = Command::new(program());
    command.arg("responder").args(arguments).env_remove("ADAPTIVE_BRIDGE_CONFIG").output().unwrap()
}

#[test]
fn requests_of_the_original_package_and_of_several_bridges_are_answered() {
    let Some(net) = net("requests_of_the_original_package_and_of_several_bridges_are_answered") else {
        return;
    };
    let mut responder = start(net.host("laptop"), &[]);
    let mut first = Asker::join(net.host("bridge"), "first");

    // The request of the original package, with exactly its fields.
    let response: Value = wait_for("a response", || {
        let request = json!({
            "v": 1, "seq": 1, "send_time_ns": clock::wall().0, "sender_id": "original", "probe_id": "p-1"
        });
        first.send(&request.to_string());
        std::thread::sleep(Duration::from_millis(100));
        first.received().first().map(|(payload, _)| serde_json::from_str(text(payload)).unwrap())
    });
    let mut keys: Vec<&str> = response.as_object().unwrap().keys().map(String::as_str).collect();
    keys.sort_unstable();
    let expected =
        ["probe_id", "recv_time_ns", "reply_time_ns", "responder_id", "response_send_time_ns", "seq", "v"];
    assert_eq!(keys, expected);
    assert_eq!((&response["v"], &response["seq"]), (&json!(1), &json!(1)));
    assert_eq!((&response["probe_id"], &response["responder_id"]), (&json!("p-1"), &json!("laptop 1")));
    let times = ["recv_time_ns", "reply_time_ns", "response_send_time_ns"].map(|key| response[key].as_u64());
    assert!(times.is_sorted() && times[0] > Some(1_700_000_000_000_000_000), "{times:?}");
    responder.wait_for_log("probe requests arrive");

    // A second bridge, and one whose probe ids are numbers.
    let mut second = Asker::join(net.host("bridge"), "second");
    let (request, response) = second.ask(|request| request);
    assert_eq!(response.seq, request.seq);
    let (_, response) =
        first.ask(|request| ProbeRequest { probe_id: ProbeId::Number(request.seq), ..request });
    assert!(matches!(response.probe_id, ProbeId::Number(_)));
    second.ask(|request| request);

    assert!(responder.terminate().success(), "{}", responder.log());
    assert!(responder.log().contains("responder is done"), "{}", responder.log());
    assert!(responder.stdout_lines().is_empty());
}

#[test]
fn invalid_requests_are_counted_by_reason_and_delay_no_other_bridge() {
    let Some(net) = net("invalid_requests_are_counted_by_reason_and_delay_no_other_bridge") else { return };
    let mut responder = start(net.host("laptop"), &[]);
    let mut good = Asker::join(net.host("bridge"), "good");
    good.ask(|request| request);

    let mut bad = Asker::join(net.host("bridge"), "bad");
    let of_version = |v: u64| {
        json!({"v": v, "seq": 1, "send_time_ns": 1, "sender_id": "bad", "probe_id": "bad-version"})
            .to_string()
    };
    let long = of_version(1) + &" ".repeat(5_000);
    let huge = of_version(1) + &" ".repeat(200_000);
    for name in ["malformed", "oversized", "unsupported_version"] {
        wait_until(name, || {
            match name {
                "malformed" => {
                    bad.send_payload(vec![]);
                    bad.send_payload(vec![0xff; 64]);
                    bad.send("{}");
                    bad.send(&"[".repeat(4_000));
                    bad.send(r#"{"v":1,"seq":-1,"send_time_ns":1,"sender_id":"bad","probe_id":"bad"}"#);
                }
                "oversized" => {
                    bad.send(&long);
                    bad.send(&huge);
                }
                _ => bad.send(&of_version(2)),
            }
            // Beyond the sender's rate, the responder would count all of them as `rate_limited`.
            std::thread::sleep(Duration::from_millis(500));
            responder.log().contains(&format!("reason=\"{name}\""))
        });
        good.ask(|request| request);
    }
    bad.assert_unanswered("bad");
    assert!(responder.terminate().success(), "{}", responder.log());
}

#[test]
fn with_a_secret_only_signed_requests_are_answered_also_during_a_flood() {
    let Some(net) = net("with_a_secret_only_signed_requests_are_answered_also_during_a_flood") else {
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let (path, wrong) = (folder.path().join("secret"), folder.path().join("wrong"));
    fs::write(&path, SECRET).unwrap();
    fs::write(&wrong, "another secret of many bytes").unwrap();
    let mut responder = start(net.host("laptop"), &["--secret-file", path.to_str().unwrap()]);

    let mut bridge = trust(&path);
    let mut forger = trust(&wrong);
    let mut good = Asker::join(net.host("bridge"), "good");
    let (request, response) = good.ask(|mut request| {
        request.signature = bridge.sign(&request);
        request
    });
    assert_eq!(bridge.check(&response, clock::wall()), Ok(None));
    let recorded = request.encode();

    let mut bad = Asker::join(net.host("bridge"), "bad");
    for name in ["unsigned", "bad_signature", "expired", "replayed"] {
        wait_until(name, || {
            let mut request = bad.request();
            match name {
                "unsigned" => {}
                "bad_signature" => request.signature = forger.sign(&request),
                "expired" => {
                    request.send_time = WallNs(request.send_time.0 - 60_000_000_000);
                    request.signature = bridge.sign(&request);
                }
                _ => {}
            }
            let payload = if name == "replayed" { recorded.clone() } else { request.encode() };
            bad.send_payload(payload);
            std::thread::sleep(Duration::from_millis(100));
            responder.log().contains(&format!("reason=\"{name}\""))
        });
    }
    bad.assert_unanswered("bad");

    // A flood of forged and replayed requests, while a bridge continues to send its own.
    let before = memory_kib(responder.pid().as_raw(), "VmRSS");
    for round in 0..20 {
        for _ in 0..500 {
            let mut request = bad.request();
            request.signature = forger.sign(&request);
            bad.send_payload(request.encode());
            bad.send_payload(recorded.clone());
        }
        good.ask(|mut request| {
            request.signature = bridge.sign(&request);
            request
        });
        assert!(responder.is_running(), "round {round}");
    }
    responder.wait_for_log("reason=\"rate_limited\"");
    bad.assert_unanswered("bad");
    // A sender with the secret is answered at most 20 times a second, too.
    let mut greedy = Asker::join(net.host("bridge"), "greedy");
    let began = Instant::now();
    for _ in 0..500 {
        let mut request = greedy.request();
        request.signature = bridge.sign(&request);
        greedy.send_payload(request.encode());
        std::thread::sleep(Duration::from_millis(2));
    }
    good.ask(|mut request| {
        request.signature = bridge.sign(&request);
        request
    });
    let answers = greedy.decoded().iter().filter(|it| it.probe_id.to_string().starts_with("greedy")).count();
    let bound = 20.0 * began.elapsed().as_secs_f64() + burst_for(20.0);
    assert!(
        answers > 0 && (answers as f64) <= bound,
        "{answers} of 500 requests answered, at most {bound:.0}"
    );
    let grown = memory_kib(responder.pid().as_raw(), "VmRSS") - before;
    assert!(grown < 32 << 10, "{grown} KiB more");
    // The recorded request was answered once.
    let answers = good.decoded().into_iter().filter(|it| it.probe_id == request.probe_id).count();
    assert_eq!(answers, 1);

    assert!(responder.terminate().success());
    assert!(!responder.log().contains(SECRET), "{}", responder.log());
}

#[test]
fn a_responder_without_its_secret_prints_what_to_do() {
    let output = run(&["--id", "a", "--secret-file", "/nonexistent/secret"]);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(78), "{stderr}");
    assert!(stderr.contains("/nonexistent/secret"), "{stderr}");

    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bridge.yaml");
    fs::write(&path, "topics: [{id: a, input_topic: /a}]\nsecurity: {enable_probe_hmac: true}\n").unwrap();
    let output = run(&["--id", "a", "--config", path.to_str().unwrap()]);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(78), "{stderr}");
    assert!(stderr.contains("hmac_secret_file") && stderr.contains("enable_probe_hmac"), "{stderr}");
}

#[test]
fn an_invalid_command_line_is_refused() {
    let long = "x".repeat(128);
    for arguments in [
        &["--id", ""][..],
        &["--id", &long],
        &["--id", "a\nb"],
        &["--id", "a", "--domain", "233"],
        &["--id", "a", "--network", "300.1.1.1"],
        &["--id", "a", "--request-topic", "relative"],
        &[],
    ] {
        let output = run(arguments);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(2), "{arguments:?}: {stderr}");
    }
}
