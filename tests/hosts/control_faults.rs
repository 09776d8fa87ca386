//! Faults around control in a running bridge: control and responders killed and stopped, clock steps, forged
//! messages, an overloaded bridge. The shipped binary runs on a separate host, most tests with a flow of 200
//! samples per second.

use std::io::{Read, Write};
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use adaptive_bridge::clock;
use adaptive_bridge::config::{DdsNetwork, SecretSource, Security, TrustMode};
use adaptive_bridge::dds::{
    Participant, ParticipantOptions, RawReader, RawWriter, ReaderEvent, ReaderQos, Take,
};
use adaptive_bridge::model::{
    Durability, Encapsulation, History, ProbeRefusal, QosProfile, Reliability, SourceTimestamp, WallNs,
};
use adaptive_bridge::policy::burst_for;
use adaptive_bridge::process::probes::{
    PROBE_READER_QOS, PROBE_TYPE, PROBE_WRITER_QOS, ProbeRequest, ProbeResponse, Trust,
};
use bytes::Bytes;
use nix::sys::signal::Signal;
use serde_json::Value;
use support::bridge::{Bridge, program};
use support::flow::{Flow, lane};
use support::netns::{Host, Net, requires_root};
use support::peer::Peer;
use support::process::{Process, memory_kib, signal};
use support::{prometheus, skip, wait_for, wait_until};

const SECRET: &str = "an ill-kept secret of many bytes";

/// Thresholds that a busy machine does not reach, and a window that is full after two seconds.
const TOLERANT: &str = "probes: {rate_hz: 10, window_size: 20, timeout_ms: 2000}\n\
                         classifier: {demote_rtt_ms: 1000, promote_rtt_ms: 900}\n\
                         subscribers: {laptop: noncritical}\n";

/// Creates one host for the bridge and all other processes; `None`, with `test` recorded as skipped, if it
/// cannot.
fn net(test: &str) -> Option<Net> {
    match requires_root() {
        Some(reason) => {
            skip(test, &reason);
            None
        }
        None => Some(Net::new(&["robot"])),
    }
}

/// Creates a bridge with one route; `more` is added to its configuration.
fn bridge(more: &str) -> Bridge {
    Bridge::new(&file(more))
}

fn file(more: &str) -> String {
    format!(
        "instance: {{instance}}\ntopics: [{{id: scan, input_topic: /scan, max_sample_bytes: 1024}}]\n\
         shared_memory: {{root_path: {{folder}}/root}}\n{more}"
    )
}

/// Starts the whole bridge and waits until every process is running. Without the watchdog, because several
/// tests stop a process for longer than it allows.
fn up(bridge: &Bridge, host: &Host) -> Process {
    let up = bridge.start_on(host, "up --no-watchdog");
    wait_running(bridge);
    up
}

/// Waits until ingress, control and the two default lanes run.
pub fn wait_running(bridge: &Bridge) {
    bridge.wait_status("all processes", |status| {
        let processes = status["processes"].as_array().unwrap();
        processes.len() == 4 && processes.iter().all(|process| process["state"] == "running")
    });
}

/// Starts a responder and waits until it is up.
fn responder(host: &Host, arguments: &[&str], environment: &[(&str, String)]) -> Process {
    let mut command = host.command(program());
    command.args(["responder", "--id", "laptop"]).args(arguments).env_remove("ADAPTIVE_BRIDGE_CONFIG");
    command.env("NO_COLOR", "1").envs(environment.iter().cloned());
    let responder = Process::spawn("responder", command);
    responder.wait_for_log("responder is up");
    responder
}

/// Opens a participant on a host.
fn join(host: &Host, name: &str) -> Participant {
    let options = ParticipantOptions {
        network: &DdsNetwork::of_domain(0),
        namespace: "/test".to_owned(),
        node_name: name.to_owned(),
        graph_gid_bytes: 16,
        dscp: 0,
    };
    host.within(|| Participant::open(&options).unwrap())
}

fn flow(bridge: &Bridge, host: &Host) -> Flow {
    Flow::start(bridge, |name| join(host, name))
}

fn process<'a>(status: &'a Value, name: &str) -> &'a Value {
    let processes = status["processes"].as_array().unwrap();
    processes.iter().find(|process| process["name"] == name).unwrap_or(&Value::Null)
}

/// The process id of a running process of the bridge.
fn pid(bridge: &Bridge, name: &str) -> i32 {
    let status = bridge.status();
    process(&status, name)["pid"].as_i64().and_then(|pid| pid.try_into().ok()).unwrap()
}

fn subscriber<'a>(status: &'a Value, id: &str) -> &'a Value {
    let subscribers = status["subscribers"].as_array().unwrap();
    subscribers.iter().find(|subscriber| subscriber["id"] == id).unwrap_or(&Value::Null)
}

/// Whether a lane has and applies a mode for a given reason.
fn is_in(status: &Value, name: &str, mode: &str, reason: &str) -> bool {
    let lanes = status["lanes"].as_array().unwrap();
    let lane = lanes.iter().find(|lane| lane["name"] == name).unwrap();
    lane["mode"] == mode && lane["mode_reason"] == reason && lane["applied_mode"] == mode
}

/// Waits until the subscriber is in a state and its lane in a mode.
fn wait_state(bridge: &Bridge, state: &str, mode: &str) -> Value {
    bridge.wait_status(&format!("laptop {state}, lane {mode}"), |status| {
        subscriber(status, "laptop")["state"] == state && is_in(status, "noncritical", mode, "control")
    })
}

/// Waits until so many more responses have been accepted.
fn wait_accepted(bridge: &Bridge, more: u64) -> Value {
    let accepted = |status: &Value| status["probes"]["accepted"].as_u64().unwrap();
    let before = accepted(&bridge.status());
    bridge.wait_status("accepted responses", |status| accepted(status) >= before + more)
}

fn problems(status: &Value) -> String {
    let problems = status["problems"].as_array().unwrap().iter();
    problems.map(|problem| problem.as_str().unwrap()).collect::<Vec<_>>().join("\n")
}

/// Terminates the bridge; asserts that it ends successfully and leaves no shared memory.
fn end(mut up: Process, bridge: &Bridge) {
    let ended = up.terminate();
    assert!(ended.success(), "{ended}: {}", up.log());
    let left: Vec<_> = std::fs::read_dir("/dev/shm")
        .unwrap()
        .filter_map(|file| file.ok()?.file_name().into_string().ok())
        .filter(|name| name.contains(bridge.instance()))
        .collect();
    assert_eq!(left, [""; 0]);
    assert!(!bridge.folder().join("root").join(bridge.instance()).exists());
}

#[test]
fn a_killed_stopped_or_restarted_control_costs_no_critical_sample_and_demotes_no_subscriber() {
    let test = "a_killed_stopped_or_restarted_control_costs_no_critical_sample_and_demotes_no_subscriber";
    let Some(net) = net(test) else { return };
    let host = net.host("robot");
    let bridge = bridge(&format!("policy_hold_s: 2\n{TOLERANT}"));
    let _responder = responder(host, &[], &[]);
    let up = up(&bridge, host);
    let mut flow = flow(&bridge, host);
    wait_state(&bridge, "CRITICAL", "normal");

    for starts in 2..=3 {
        signal(pid(&bridge, "control"), Signal::SIGKILL);
        bridge.wait_status("control again", |status| {
            let control = process(status, "control");
            control["starts"] == starts && control["state"] == "running"
        });
        wait_state(&bridge, "CRITICAL", "normal");
        flow.wait_more(100);
    }

    let before = wait_accepted(&bridge, 30);
    let stopped = pid(&bridge, "control");
    signal(stopped, Signal::SIGSTOP);
    let since = Instant::now();
    let status = bridge.wait_status("the safe default modes", |status| {
        is_in(status, "noncritical", "degraded", "expired") && is_in(status, "critical", "normal", "expired")
    });
    assert_eq!(process(&status, "control")["state"], "stopped");
    while since.elapsed() < Duration::from_secs(8) {
        flow.wait_more(100);
    }
    assert!(is_in(&bridge.status(), "noncritical", "degraded", "expired"));
    signal(stopped, Signal::SIGCONT);
    wait_state(&bridge, "CRITICAL", "normal");
    // More responses than the window holds, so that it no longer contains probes from before or during the
    // pause.
    let status = wait_accepted(&bridge, 60);
    let transitions = |status: &Value| subscriber(status, "laptop")["transitions"].as_u64().unwrap();
    assert_eq!(transitions(&status), transitions(&before), "{}", up.log());
    assert_eq!((&status["safety"]["mode"], &status["safety"]["transitions"]), (&"normal".into(), &0.into()));
    assert_eq!(process(&status, "control")["starts"], 3);

    flow.end_whole(&bridge);
    end(up, &bridge);
}

#[test]
fn a_terminated_control_is_shown_as_ended_and_a_killed_one_as_dead() {
    let Some(net) = net("a_terminated_control_is_shown_as_ended_and_a_killed_one_as_dead") else { return };
    let host = net.host("robot");
    let bridge = bridge(TOLERANT);
    let mut ingress = bridge.start_on(host, "ingress");
    let mut control = bridge.start_on(host, "control");
    bridge.wait_status("ingress and control", |status| {
        ["ingress", "control"].iter().all(|name| process(status, name)["state"] == "running")
    });
    assert!(control.terminate().success(), "{}", control.log());
    let status = bridge.status();
    assert_eq!(process(&status, "control")["state"], "ended");
    assert!(problems(&status).contains("control has ended"), "{status}");
    assert!(!problems(&status).contains("dead"), "{status}");

    let mut control = bridge.start_on(host, "control");
    bridge.wait_status("control again", |status| process(status, "control")["state"] == "running");
    control.kill9();
    bridge.wait_status("control dead", |status| process(status, "control")["state"] == "dead");
    assert!(ingress.terminate().success(), "{}", ingress.log());
}

#[test]
fn a_killed_responder_counts_as_loss_and_its_restart_promotes_the_subscriber() {
    let Some(net) = net("a_killed_responder_counts_as_loss_and_its_restart_promotes_the_subscriber") else {
        return;
    };
    let host = net.host("robot");
    let bridge = bridge(TOLERANT);
    let up = up(&bridge, host);
    let flow = flow(&bridge, host);
    for _ in 0..2 {
        let mut responder = responder(host, &[], &[]);
        wait_state(&bridge, "CRITICAL", "normal");
        responder.kill9();
        let status = wait_state(&bridge, "NONCRITICAL", "degraded");
        let laptop = subscriber(&status, "laptop");
        assert!(laptop["lost"].as_u64() > Some(0), "{laptop}");
        assert!(laptop["reason"].as_str().unwrap().contains("loss"), "{laptop}");
    }
    flow.end_whole(&bridge);
    end(up, &bridge);
}

#[test]
fn probes_have_their_own_topics_and_only_the_named_responder_counts() {
    let Some(net) = net("probes_have_their_own_topics_and_only_the_named_responder_counts") else { return };
    let host = net.host("robot");
    let bridge = bridge(
        "probes: {request_topic: /robot/ask, response_topic: /robot/answer, rate_hz: 10, window_size: 20, \
         timeout_ms: 2000}\n\
         classifier: {subscriber_id: laptop, demote_rtt_ms: 1000, promote_rtt_ms: 900}\n",
    );
    let up = up(&bridge, host);
    // It takes the topics from the file. Its answers reach control, which is seen by their count.
    let desk = bridge.start_on(host, "responder --id desk");
    let wait_answers = |answers| {
        let answered = |status: &Value| refused(status, ProbeRefusal::NotTheSubscriber) > answers;
        bridge.wait_status("answers of another responder", answered)
    };
    wait_answers(20);
    // In the next 2 s, at least, control does not hear the right one on the topics of the default.
    let of_default_topics = responder(host, &[], &[]);
    let status = wait_answers(refused(&bridge.status(), ProbeRefusal::NotTheSubscriber) + 20);
    assert_eq!(subscriber(&status, "laptop")["state"], "UNKNOWN", "{status}");
    drop(of_default_topics);
    let topics = ["--request-topic", "/robot/ask", "--response-topic", "/robot/answer"];
    let _laptop = responder(host, &topics, &[]);
    let status = wait_state(&bridge, "CRITICAL", "normal");
    let ids: Vec<_> = status["subscribers"].as_array().unwrap().iter().map(|it| &it["id"]).collect();
    assert_eq!(ids, ["laptop"], "{status}");
    drop(desk);
    end(up, &bridge);
}

/// A wall clock that a test can step while a program runs, by Debian's libfaketime. The monotonic clock stays
/// that of the machine.
struct FakeClock {
    file: PathBuf,
    library: PathBuf,
}

impl FakeClock {
    fn library() -> Option<PathBuf> {
        let folders = std::fs::read_dir("/usr/lib").ok()?.flatten();
        let mut libraries = folders.map(|folder| folder.path().join("faketime/libfaketimeMT.so.1"));
        libraries.find(|library| library.exists())
    }

    /// Creates a clock without offset.
    fn new(library: &Path, folder: &Path, name: &str) -> Self {
        let clock = Self { file: folder.join(name), library: library.to_owned() };
        clock.set("+0");
        clock
    }

    /// Sets the offset to the right time, atomically: a reader sees either the old offset or the new one.
    fn set(&self, offset: &str) {
        let new = self.file.with_extension("new");
        std::fs::write(&new, format!("{offset}\n")).unwrap();
        std::fs::rename(new, &self.file).unwrap();
    }

    fn environment(&self) -> Vec<(&'static str, String)> {
        let text = |path: &Path| path.to_str().unwrap().to_owned();
        vec![
            ("LD_PRELOAD", text(&self.library)),
            ("FAKETIME_TIMESTAMP_FILE", text(&self.file)),
            ("FAKETIME_NO_CACHE", "1".to_owned()),
            ("FAKETIME_DONT_FAKE_MONOTONIC", "1".to_owned()),
            ("DONT_FAKE_MONOTONIC", "1".to_owned()),
            ("FAKETIME_DISABLE_SHM", "1".to_owned()),
        ]
    }
}

/// Starts a bridge and a responder with a [`FakeClock`] each; returns bridge, responder and the clocks in
/// that order.
fn with_clocks(
    bridge: &Bridge,
    host: &Host,
    library: &Path,
    arguments: &[&str],
) -> (Process, Process, [FakeClock; 2]) {
    let clocks = ["bridge.clock", "laptop.clock"].map(|name| FakeClock::new(library, bridge.folder(), name));
    let laptop = responder(host, arguments, &clocks[1].environment());
    let mut command = host.command(program());
    command.args(["up", "--config"]).arg(bridge.config()).env("NO_COLOR", "1");
    let up = Process::spawn("up", {
        command.envs(clocks[0].environment());
        command
    });
    wait_running(bridge);
    (up, laptop, clocks)
}

#[test]
fn a_wall_clock_that_steps_by_an_hour_changes_no_round_trip_and_demotes_no_subscriber() {
    let test = "a_wall_clock_that_steps_by_an_hour_changes_no_round_trip_and_demotes_no_subscriber";
    let Some(library) = FakeClock::library() else { return skip(test, "no faketime") };
    let Some(net) = net(test) else { return };
    let host = net.host("robot");
    let bridge = bridge(TOLERANT);
    let (up, _laptop, [own, laptops]) = with_clocks(&bridge, host, &library, &[]);
    let flow = flow(&bridge, host);
    wait_state(&bridge, "CRITICAL", "normal");
    let before = wait_accepted(&bridge, 20);
    let steps = [("-3600", "+0"), ("-3600", "-3600"), ("+0", "-3600"), ("+0", "+0"), ("+3600", "+0")];
    for (offset, laptops_offset) in steps {
        own.set(offset);
        laptops.set(laptops_offset);
        let status = wait_accepted(&bridge, 40);
        let subscriber = |key: &str| subscriber(&status, "laptop")[key].clone();
        assert_eq!((subscriber("state"), subscriber("lost")), ("CRITICAL".into(), 0.into()), "{status}");
        let rtt_ms = subscriber("rtt_mean_ms").as_f64().unwrap();
        assert!(rtt_ms > 0.0 && rtt_ms < 1_000.0, "{rtt_ms} at {offset}, {laptops_offset}");
    }
    let status = wait_state(&bridge, "CRITICAL", "normal");
    assert_eq!(subscriber(&status, "laptop")["transitions"], subscriber(&before, "laptop")["transitions"]);
    flow.end_whole(&bridge);
    end(up, &bridge);
}

#[test]
fn signed_probes_expire_while_a_clock_is_an_hour_off() {
    let test = "signed_probes_expire_while_a_clock_is_an_hour_off";
    let Some(library) = FakeClock::library() else { return skip(test, "no faketime") };
    let Some(net) = net(test) else { return };
    let host = net.host("robot");
    let bridge = bridge(&format!("{TOLERANT}{}", signed("default_deny")));
    let secret = write_secret(&bridge);
    let (up, laptop, [own, laptops]) =
        with_clocks(&bridge, host, &library, &["--secret-file", secret.to_str().unwrap()]);
    wait_state(&bridge, "CRITICAL", "normal");
    for clock in [&laptops, &own] {
        clock.set("-3600");
        let before = laptop.log().matches("reason=\"expired\"").count();
        wait_state(&bridge, "NONCRITICAL", "degraded");
        wait_until("expired requests in the log", || {
            laptop.log().matches("reason=\"expired\"").count() > before
        });
        clock.set("+0");
        wait_state(&bridge, "CRITICAL", "normal");
    }
    end(up, &bridge);
}

fn signed(trust_mode: &str) -> String {
    format!(
        "security: {{trust_mode: {trust_mode}, enable_probe_hmac: true, \
         hmac_secret_file: '{{folder}}/secret'}}\ndiagnostics: {{verbosity: debug}}\n"
    )
}

fn write_secret(bridge: &Bridge) -> PathBuf {
    let path = bridge.folder().join("secret");
    std::fs::write(&path, SECRET).unwrap();
    path
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

/// An attacker in the network that receives all requests and responses and sends forged responses.
struct Attacker {
    requests: RawReader,
    responses: RawReader,
    writer: RawWriter,
    newest_request: Option<ProbeRequest>,
    newest_response: Vec<u8>,
    names_made: u64,
    _participant: Participant,
}

impl Attacker {
    fn join(host: &Host) -> Self {
        let mut participant = join(host, "attacker");
        let mut reader = |topic| participant.create_reader(topic, PROBE_TYPE, &PROBE_READER_QOS).unwrap();
        let requests = reader("rt/adaptive_bridge/probe_req");
        let responses = reader("rt/adaptive_bridge/probe_resp");
        // A smaller history would overwrite the messages of a flood before they are sent.
        let qos = QosProfile { history: History::KeepLast { depth: 4096 }, ..PROBE_WRITER_QOS };
        let writer =
            participant.create_writer("rt/adaptive_bridge/probe_resp", PROBE_TYPE, &qos, 4096).unwrap();
        let mut attacker = Self {
            requests,
            responses,
            writer,
            newest_request: None,
            newest_response: Vec::new(),
            names_made: 0,
            _participant: participant,
        };
        // The writer matches two readers: the attacker's own and that of control.
        wait_until("control's reader of responses", || attacker.writer.matched_readers().count() >= 2);
        wait_until("a probe", || attacker.receive_request().is_some());
        attacker
    }

    /// The newest request; `None` if none was received so far.
    fn receive_request(&mut self) -> Option<ProbeRequest> {
        let newest = &mut self.newest_request;
        let mut on_sample = |payload: &[u8], encapsulation| {
            *newest = ProbeRequest::decode(payload, encapsulation).ok();
        };
        while self.requests.take(&mut on_sample) != Take::Empty {}
        self.newest_request.clone()
    }

    /// The payload of the newest response that the attacker did not send itself.
    fn receive_response(&mut self) -> Vec<u8> {
        let mut received = Vec::new();
        loop {
            let mut on_sample = |payload: &[u8], _| received = payload.to_vec();
            match self.responses.take(&mut on_sample) {
                Take::Empty => return self.newest_response.clone(),
                Take::Sample(origin) if origin.writer != self.writer.guid() => {
                    self.newest_response = std::mem::take(&mut received);
                }
                _ => {}
            }
        }
    }

    /// Forges an unsigned response of a responder to the newest request.
    fn response(&mut self, responder_id: &str) -> ProbeResponse {
        let request = self.receive_request().unwrap();
        let now = clock::wall();
        ProbeResponse {
            seq: request.seq,
            probe_id: request.probe_id,
            recv_time: now,
            reply_time: now,
            response_send_time: now,
            responder_id: responder_id.to_owned(),
            signature: None,
        }
    }

    /// Makes a responder id that was not used before.
    fn new_name(&mut self) -> String {
        self.names_made += 1;
        format!("attacker-{}", self.names_made)
    }

    /// Sends a payload as a response; returns whether the writer accepted it.
    fn send(&self, payload: impl Into<Bytes>) -> bool {
        self.writer.write(payload.into(), Encapsulation::CDR_LE, SourceTimestamp::NONE).is_ok()
    }
}

/// Encodes a `std_msgs/String` in little-endian CDR.
fn cdr(text: &str) -> Vec<u8> {
    [&(text.len() as u32 + 1).to_le_bytes()[..], text.as_bytes(), &[0]].concat()
}

fn refused(status: &Value, reason: ProbeRefusal) -> u64 {
    status["probes"]["refused"][reason.label()].as_u64().unwrap()
}

/// Asserts that the listed subscriber is the only one, in the same state as before and without lost probes.
fn assert_untouched(before: &Value, status: &Value) {
    let subscribers = status["subscribers"].as_array().unwrap();
    assert_eq!(subscribers.len(), 1, "{subscribers:?}");
    for key in ["id", "state", "transitions", "lost"] {
        assert_eq!(subscribers[0][key], before["subscribers"][0][key], "{key} in {status}");
    }
}

#[test]
fn forged_responses_change_nothing_in_trust_mode_default_deny() {
    let test = "forged_responses_change_nothing_in_trust_mode_default_deny";
    let Some(net) = net(test) else { return };
    let host = net.host("robot");
    let bridge = bridge(&format!("{TOLERANT}{}", signed("default_deny")));
    let secret = write_secret(&bridge);
    let wrong = bridge.folder().join("wrong");
    std::fs::write(&wrong, "another secret of many bytes").unwrap();
    let laptop = responder(host, &["--secret-file", secret.to_str().unwrap()], &[]);
    let up = up(&bridge, host);
    wait_state(&bridge, "CRITICAL", "normal");
    // Waits until the window no longer contains probes that were lost before both sides were matched.
    let before = bridge.wait_status("a full window without loss", |status| {
        let laptop = subscriber(status, "laptop");
        laptop["lost"] == 0 && laptop["settled"] == 20
    });

    let (mut genuine, mut wrong_key) = (trust(&secret), trust(&wrong));
    let mut attacker = Attacker::join(host);
    let kinds = [
        ProbeRefusal::Malformed,
        ProbeRefusal::Oversized,
        ProbeRefusal::UnsupportedVersion,
        ProbeRefusal::Unsolicited,
        ProbeRefusal::Unsigned,
        ProbeRefusal::BadSignature,
        ProbeRefusal::Replayed,
        ProbeRefusal::Expired,
        ProbeRefusal::RateLimited,
    ];
    // Only a flood, as below, exceeds the rate of a sender.
    for kind in kinds.into_iter().filter(|kind| *kind != ProbeRefusal::RateLimited) {
        for name in ["laptop", "not listed"] {
            let counted = refused(&bridge.status(), kind);
            wait_until(kind.label(), || {
                let mut response = attacker.response(name);
                match kind {
                    ProbeRefusal::Malformed => {
                        attacker.send(vec![0xff; 64]);
                        attacker.send(cdr("{}"));
                        attacker.send(vec![]);
                    }
                    ProbeRefusal::Oversized => {
                        let text = format!("{{\"v\":1,\"responder_id\":\"{name}\"{}}}", " ".repeat(5_000));
                        attacker.send(cdr(&text));
                        attacker.send(cdr(&" ".repeat(100_000)));
                    }
                    ProbeRefusal::UnsupportedVersion => {
                        attacker.send(cdr("{\"v\":2}"));
                    }
                    ProbeRefusal::Unsolicited => {
                        response.seq += 1_000;
                        response.signature = genuine.sign(&response);
                        attacker.send(response.encode());
                    }
                    ProbeRefusal::Unsigned => {
                        attacker.send(response.encode());
                    }
                    ProbeRefusal::BadSignature => {
                        response.signature = wrong_key.sign(&response);
                        attacker.send(response.encode());
                        // A genuine signature of a different message.
                        response.signature = genuine.sign(&response);
                        response.responder_id.push('x');
                        attacker.send(response.encode());
                    }
                    ProbeRefusal::Expired => {
                        response.response_send_time = WallNs(clock::wall().0 - 3_600_000_000_000);
                        response.signature = genuine.sign(&response);
                        attacker.send(response.encode());
                    }
                    // A replay of a genuine response.
                    _ => {
                        let recorded = attacker.receive_response();
                        attacker.send(recorded);
                    }
                }
                std::thread::sleep(Duration::from_millis(50));
                refused(&bridge.status(), kind) > counted
            });
        }
    }
    assert_untouched(&before, &wait_accepted(&bridge, 10));

    // A flood of several thousand responses a second of different kinds, each with a new name, but all of one
    // sender: of those that answer a probe, more than its rate are not checked further.
    let control = pid(&bridge, "control");
    let memory_before = memory_kib(control, "VmRSS");
    let refused_before = bridge.status();
    let mut sent = 0_u64;
    let began = Instant::now();
    let until = began + Duration::from_secs(5);
    while Instant::now() < until && sent < 40_000 {
        for _ in 0..5 {
            let name = attacker.new_name();
            let unsigned = attacker.response(&name);
            let mut forged = unsigned.clone();
            forged.signature = wrong_key.sign(&forged);
            let replayed = attacker.receive_response();
            for payload in [unsigned.encode(), forged.encode(), replayed.into(), cdr(&name).into()] {
                sent += u64::from(attacker.send(payload));
            }
        }
        std::thread::sleep(Duration::from_millis(4));
    }
    let status = wait_accepted(&bridge, 10);
    assert_untouched(&before, &status);
    // The network and the DDS library may drop any part of a flood.
    let counted = |kind| refused(&status, kind) - refused(&refused_before, kind);
    println!("{sent} sent; counted: {:?} of {kinds:?}", kinds.map(counted));
    let checked = [ProbeRefusal::Unsigned, ProbeRefusal::BadSignature];
    for kind in [ProbeRefusal::Malformed, ProbeRefusal::RateLimited].into_iter().chain(checked) {
        assert!(counted(kind) > 0, "{kind}: {status}");
    }
    // The rate of a sender, and the burst of ten seconds that control allows it after an outage.
    let bound = 20.0 * (began.elapsed().as_secs_f64() + 10.0) + burst_for(20.0);
    let of_rate: u64 = checked.map(counted).into_iter().sum();
    assert!(of_rate as f64 <= bound, "{of_rate} signatures checked, at most {bound:.0}");
    let grown = memory_kib(control, "VmRSS") - memory_before;
    assert!(grown < 32 << 10, "{grown} KiB more");
    assert_eq!(process(&status, "control")["starts"], 1);

    for text in [up.log(), laptop.log(), bridge.status().to_string()] {
        assert!(!text.contains(SECRET), "{text}");
    }
    end(up, &bridge);
}

#[test]
fn trust_mode_permissive_accepts_and_counts_unsigned_responses() {
    let Some(net) = net("trust_mode_permissive_accepts_and_counts_unsigned_responses") else { return };
    let host = net.host("robot");
    let bridge = bridge(&format!("{TOLERANT}{}", signed("permissive")));
    write_secret(&bridge);
    let up = up(&bridge, host);
    let mut attacker = Attacker::join(host);
    bridge.wait_status("the attacker among the subscribers", |status| {
        let response = attacker.response("guest");
        attacker.send(response.encode());
        let guest = subscriber(status, "guest");
        guest["listed"] == false && guest["lane"] == "noncritical" && guest["settled"].as_u64() > Some(0)
    });
    assert!(refused(&bridge.status(), ProbeRefusal::Unsigned) > 0);
    end(up, &bridge);
}

#[test]
fn without_its_secret_control_runs_on_and_reports_a_problem() {
    let Some(net) = net("without_its_secret_control_runs_on_and_reports_a_problem") else { return };
    let host = net.host("robot");
    let bridge = bridge(&format!("{TOLERANT}{}", signed("default_deny")));
    let up = up(&bridge, host);
    let flow = flow(&bridge, host);
    up.wait_for_log("no subscriber is probed");
    let status =
        bridge.wait_status("the problem", |status| problems(status).contains("no subscriber is probed"));
    assert_eq!(status["probes"]["sent"], 0);
    assert!(is_in(&status, "noncritical", "normal", "control"), "{status}");

    let secret = write_secret(&bridge);
    let _laptop = responder(host, &["--secret-file", secret.to_str().unwrap()], &[]);
    let reloaded = bridge.run("reload");
    assert!(reloaded.status.success(), "{reloaded:?}");
    let status = wait_state(&bridge, "CRITICAL", "normal");
    assert!(!problems(&status).contains("no subscriber is probed"), "{status}");
    assert!(!up.log().contains(SECRET));
    flow.end_whole(&bridge);
    end(up, &bridge);
}

/// Subscribes to the JSON diagnostics, to check that they are published while forwarding is stopped.
fn diagnostics(host: &Host) -> (RawReader, Participant) {
    let mut participant = join(host, "monitor");
    let qos = ReaderQos {
        reliability: Reliability::Reliable,
        durability: Durability::Volatile,
        depth: 1_000,
        deadline_ms: None,
    };
    let reader = participant.create_reader("rt/adaptive_bridge/diagnostics", PROBE_TYPE, &qos).unwrap();
    wait_until("the writer of diagnostics", || {
        matches!(reader.poll_event(), Some(ReaderEvent::Matched { writers: 1.. }))
    });
    (reader, participant)
}

/// Waits until a diagnostics message fulfils a condition.
fn wait_diagnostics(reader: &RawReader, what: &str, mut fulfilled: impl FnMut(&Value) -> bool) {
    wait_until(what, || {
        let mut found = false;
        let mut on_sample = |payload: &[u8], _| {
            let length = u32::from_le_bytes(payload[..4].try_into().unwrap()) as usize;
            found |= fulfilled(&serde_json::from_slice(&payload[4..4 + length - 1]).unwrap());
        };
        while reader.take(&mut on_sample) != Take::Empty {}
        found
    });
}

#[test]
fn a_stopped_critical_lane_causes_emergency_and_its_return_normal() {
    let test = "a_stopped_critical_lane_causes_emergency_and_its_return_normal";
    let Some(net) = net(test) else { return };
    let host = net.host("robot");
    let bridge = bridge("safety: {silent_ms: 1000, emergency_silent_ms: 4000, recovery_count: 6}\n");
    let up = up(&bridge, host);
    let mut flow = flow(&bridge, host);
    let (reader, _monitor) = diagnostics(host);
    flow.wait_more(200);
    let safety = |status: &Value| status["safety"]["mode"].as_str().unwrap().to_owned();
    let drops =
        |status: &Value, name: &str, reason: &str| lane(status, name)["drops"][reason].as_u64().unwrap();

    let stopped = pid(&bridge, "egress-critical");
    signal(stopped, Signal::SIGSTOP);
    let status = bridge.wait_status("DEGRADED", |status| {
        safety(status) == "degraded" && is_in(status, "noncritical", "suspended", "safety")
    });
    assert!(status["safety"]["reason"].as_str().unwrap().contains("critical"), "{status}");
    bridge.wait_status("drops in DEGRADED", |status| drops(status, "noncritical", "suspended") > 0);

    bridge.wait_status("EMERGENCY", |status| {
        safety(status) == "emergency" && is_in(status, "noncritical", "stopped", "safety")
    });
    let manual = bridge.run("mode noncritical normal --for 10m");
    assert!(manual.status.success(), "{manual:?}");
    let before = drops(&bridge.status(), "noncritical", "stopped");
    let status = bridge.wait_status("drops in EMERGENCY, in spite of the manual mode", |status| {
        drops(status, "noncritical", "stopped") > before + 100
    });
    assert!(is_in(&status, "noncritical", "stopped", "safety"), "{status}");
    wait_diagnostics(&reader, "diagnostics in EMERGENCY", |report| report["safety"]["mode"] == "emergency");

    signal(stopped, Signal::SIGCONT);
    bridge.wait_status("drops of the stopped critical lane", |status| {
        drops(status, "critical", "stopped") > 0 && is_in(status, "critical", "stopped", "safety")
    });
    bridge.wait_status("DEGRADED during recovery", |status| safety(status) == "degraded");
    let status = bridge.wait_status("NORMAL", |status| {
        safety(status) == "normal"
            && is_in(status, "critical", "normal", "control")
            && is_in(status, "noncritical", "normal", "by_hand")
    });
    assert_eq!(status["safety"]["reason"], Value::Null);
    flow.wait_more(200);
    let status = flow.end_accounted(&bridge);
    assert!(drops(&status, "critical", "stopped") > 0);
    end(up, &bridge);
}

#[test]
fn a_noncritical_lane_causes_degraded_at_most() {
    let Some(net) = net("a_noncritical_lane_causes_degraded_at_most") else { return };
    let host = net.host("robot");
    let bridge = bridge(
        "lanes: {noncritical: {queue_samples: 50, drop_policy: drop_latest, stale_threshold_ms: 60000}}\n\
         safety: {max_noncritical_queue: 20, silent_ms: 1000, emergency_silent_ms: 3000, recovery_count: 4}\n",
    );
    let up = up(&bridge, host);
    let mut flow = flow(&bridge, host);
    let seen_modes = std::cell::RefCell::new(std::collections::BTreeSet::new());
    let wait = |what: &str, fulfilled: &dyn Fn(&Value) -> bool| {
        bridge.wait_status(what, |status| {
            seen_modes.borrow_mut().insert(status["safety"]["mode"].as_str().unwrap().to_owned());
            fulfilled(status)
        })
    };

    let status = wait("DEGRADED because of a long queue", &|status| status["safety"]["mode"] == "degraded");
    assert!(status["safety"]["reason"].as_str().unwrap().contains("samples wait"), "{status}");
    wait("drops of suspended samples", &|status| {
        lane(status, "noncritical")["drops"]["suspended"].as_u64() > Some(0)
    });
    wait("NORMAL", &|status| status["safety"]["mode"] == "normal");

    let stopped = pid(&bridge, "egress-noncritical");
    signal(stopped, Signal::SIGSTOP);
    let since = Instant::now();
    while since.elapsed() < Duration::from_secs(8) {
        wait("a status", &|_| true);
        flow.wait_more(50);
    }
    signal(stopped, Signal::SIGCONT);
    wait("the lane running again", &|status| process(status, "egress-noncritical")["state"] == "running");
    flow.wait_more(200);
    flow.end_whole(&bridge);
    assert!(!seen_modes.borrow().contains("emergency"), "{:?}\n{}", seen_modes.borrow(), up.log());
    end(up, &bridge);
}

#[test]
fn prometheus_parses_the_metrics_page_of_a_running_bridge() {
    let test = "prometheus_parses_the_metrics_page_of_a_running_bridge";
    let Some(python) = prometheus::python() else { return skip(test, "no python3-prometheus-client") };
    let Some(net) = net(test) else { return };
    let host = net.host("robot");
    let _laptop = responder(host, &[], &[]);
    for listener in ["127.0.0.1:9464", "unix:{folder}/metrics.sock"] {
        let bridge = bridge(&format!("{TOLERANT}diagnostics: {{metrics: '{listener}'}}\n"));
        let up = up(&bridge, host);
        let flow = flow(&bridge, host);
        wait_state(&bridge, "CRITICAL", "normal");
        let scrape = || -> Option<String> {
            let request = b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n";
            let mut answer = String::new();
            if listener.starts_with("unix") {
                let mut client = UnixStream::connect(bridge.folder().join("metrics.sock")).ok()?;
                client.write_all(request).ok()?;
                client.read_to_string(&mut answer).ok()?;
            } else {
                let connect = || std::net::TcpStream::connect(listener).ok();
                let mut client = host.within(connect)?;
                client.write_all(request).ok()?;
                client.read_to_string(&mut answer).ok()?;
            }
            Some(answer.split_once("\r\n\r\n")?.1.to_owned())
        };
        wait_for("the metrics of the running bridge", || {
            let families = prometheus::parse(python, &scrape()?);
            let value = |name: &str, label: &str, is: &str| {
                let samples = families.iter().flat_map(|(_, _, samples)| samples);
                let mut named = samples.filter(|sample| sample[0] == name);
                named.find(|sample| sample[1][label] == is)?[2].as_str()?.parse::<f64>().ok()
            };
            (value("adaptive_bridge_process_up", "process", "control")? == 1.0
                && value("adaptive_bridge_safety_mode", "mode", "normal")? == 1.0
                && value("adaptive_bridge_subscriber_state", "state", "CRITICAL")? == 1.0
                && value("adaptive_bridge_route_received_samples_total", "route", "scan")? > 100.0)
                .then_some(())
        });
        flow.end_whole(&bridge);
        end(up, &bridge);
    }
}

#[test]
fn the_verbosity_of_the_log_is_configured_and_reloaded_unless_the_environment_sets_it() {
    let test = "the_verbosity_of_the_log_is_configured_and_reloaded_unless_the_environment_sets_it";
    let Some(net) = net(test) else { return };
    let host = net.host("robot");
    let bridge = bridge("diagnostics: {verbosity: error}\n");
    let start = |environment: Option<&str>| {
        let mut command: Command = host.command(program());
        command.args(["ingress", "--config"]).arg(bridge.config()).env("NO_COLOR", "1");
        command.env_remove("RUST_LOG").envs(environment.map(|filter| ("RUST_LOG", filter)));
        let ingress = Process::spawn("ingress", command);
        bridge.wait_status("ingress", |status| process(status, "ingress")["state"] == "running");
        ingress
    };
    let mut ingress = start(None);
    assert_eq!(ingress.log(), "");
    bridge.write_config(&file("diagnostics: {verbosity: info}\n"));
    assert!(bridge.run("reload").status.success());
    ingress.wait_for_log("reloaded: diagnostics.verbosity");
    assert!(ingress.terminate().success());
    assert!(ingress.log().contains("INFO"), "{}", ingress.log());

    bridge.write_config(&file("diagnostics: {verbosity: error}\n"));
    let mut ingress = start(Some("info"));
    ingress.wait_for_log("ingress is up");
    assert!(ingress.terminate().success());
}

#[test]
fn a_peer_that_knows_only_the_message_definitions_decodes_the_diagnostics() {
    let test = "a_peer_that_knows_only_the_message_definitions_decodes_the_diagnostics";
    if let Some(reason) = support::testbed_missing() {
        return skip(test, &reason);
    }
    let Some(net) = net(test) else { return };
    let host = net.host("robot");
    let bridge = bridge(TOLERANT);
    let mut laptop = responder(host, &[], &[]);
    let up = up(&bridge, host);
    let flow = flow(&bridge, host);
    wait_state(&bridge, "CRITICAL", "normal");
    let array = Peer::cyclone().decode_diagnostics().start_on(host);
    let strings = |topic| Peer::cyclone().decode_string().topic(topic).start_on(host);
    let json = strings("rt/adaptive_bridge/diagnostics");
    let decisions = strings("rt/adaptive_bridge/classifier/state");
    let object = |message: &Value| -> Value {
        let text = message["data"].as_str().unwrap_or_default();
        serde_json::from_str(text).unwrap_or_else(|error| panic!("{error}: {text}"))
    };
    let part = |message: &Value, name: &str| -> Value {
        let name = format!("adaptive_bridge_{}: {name}", bridge.instance());
        let mut parts = message["status"].as_array().unwrap().iter();
        parts.find(|part| part["name"] == name).cloned().unwrap_or_default()
    };
    let value = |part: &Value, key: &str| -> Option<String> {
        let mut values = part["values"].as_array()?.iter();
        values.find(|value| value["key"] == key)?["value"].as_str().map(str::to_owned)
    };

    let parts = [
        "bridge",
        "ingress",
        "control",
        "lane critical",
        "lane noncritical",
        "route scan",
        "subscriber laptop",
        "safety",
        "probes",
        "intruders",
        "network",
    ];
    let whole = array.wait_decoded("every part of the bridge at level OK", |message| {
        parts.iter().all(|name| part(message, name)["level"] == 0)
            && value(&part(message, "lane noncritical"), "mode").as_deref() == Some("normal")
    });
    assert_eq!(whole["status"].as_array().unwrap().len(), parts.len(), "{whole}");
    let of_subscriber = part(&whole, "subscriber laptop");
    assert_eq!(of_subscriber["hardware_id"], bridge.instance());
    assert_eq!(value(&of_subscriber, "state").as_deref(), Some("CRITICAL"), "{of_subscriber}");
    assert_eq!(value(&of_subscriber, "lane").as_deref(), Some("noncritical"), "{of_subscriber}");
    assert_eq!(value(&part(&whole, "safety"), "mode").as_deref(), Some("normal"), "{whole}");
    let rate_hz = value(&part(&whole, "route scan"), "critical.rate_hz").unwrap();
    assert!(rate_hz.parse::<f64>().unwrap() > 0.0, "{rate_hz}");

    json.wait_decoded("the report", |message| {
        let report = object(message);
        report["v"] == 1
            && report["type"] == "diagnostics"
            && report["instance"] == bridge.instance()
            && subscriber(&report, "laptop")["state"] == "CRITICAL"
            && lane(&report, "critical")["whole"] == true
    });
    let is_decision = |message: &Value, state: &str| {
        let decision = object(message);
        (decision["v"] == 1 && decision["type"] == "decision" && decision["subscriber_id"] == "laptop")
            .then_some(decision)
            .is_some_and(|decision| decision["lane"] == "noncritical" && decision["state"] == state)
    };
    let is_critical = |message: &Value| is_decision(message, "CRITICAL");
    let decision = object(&decisions.wait_decoded("the state", is_critical));
    assert!(decision["rtt_ms"].as_f64().is_some() && decision["loss"].as_f64().is_some(), "{decision}");

    laptop.kill9();
    let is_noncritical = |message: &Value| is_decision(message, "NONCRITICAL");
    let decision = object(&decisions.wait_decoded("the demotion", is_noncritical));
    assert_eq!(decision["previous_state"], "CRITICAL");
    let reason = decision["reason"].as_str();
    assert!(decision["loss"].as_f64() > Some(0.0) && reason != Some(""), "{decision}");
    array.wait_decoded("a subscriber that does not answer", |message| {
        part(message, "subscriber laptop")["level"] == 3
            && value(&part(message, "lane noncritical"), "mode").as_deref() == Some("degraded")
    });
    let stopped = pid(&bridge, "egress-noncritical");
    signal(stopped, Signal::SIGSTOP);
    array.wait_decoded("a lane whose process is stopped", |message| {
        part(message, "lane noncritical")["level"] == 2 && part(message, "lane critical")["level"] == 0
    });
    signal(stopped, Signal::SIGCONT);
    flow.end_whole(&bridge);
    end(up, &bridge);
}
