//! The command line from outside, on bridges that really run: the shipped binary as child processes, real
//! shared memory, and publishers and subscribers of this process on real sockets. Domains 100 to 109, 120
//! and 124.

use std::collections::BTreeSet;
use std::fs;
use std::io::{BufRead, BufReader, Read};
use std::path::Path;
use std::process::{Command, Output, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use adaptive_bridge::config::{self, DdsNetwork};
use adaptive_bridge::dds::{Participant, ParticipantOptions, RawReader, RawWriter, ReaderQos};
use adaptive_bridge::model::{
    DropReason, Durability, Encapsulation, NetworkRefusal, ProbeRefusal, QosProfile, Reliability,
    SourceTimestamp,
};
use bytes::Bytes;
use nix::sys::signal::Signal;
use serde_json::Value;
use support::bridge::{Bridge, program};
use support::flow::Flow;
use support::process::Process;
use support::{wait_for, wait_until};

const TYPE: &str = "std_msgs::msg::dds_::UInt8MultiArray_";
const ENCAPSULATIONS: [[u8; 4]; 4] = [[0, 1, 0, 0], [0, 0, 0, 3], [0, 7, 0, 2], [0, 0x0b, 0, 1]];

/// A bridge of one route, `/scan`, in a domain and with an instance of its own.
fn bridge(domain_id: u16) -> Bridge {
    bridge_with(domain_id, "")
}

/// Like [`bridge`], with more `topics`.
fn bridge_with(domain_id: u16, topics: &str) -> Bridge {
    Bridge::new(&format!(
        "instance: {{instance}}\nros: {{domain_id: {domain_id}}}\n\
         topics:\n  - {{id: front_laser, input_topic: /scan, max_sample_bytes: 8192}}\n{topics}\
         shared_memory: {{root_path: {{folder}}/root, max_taps: 1}}"
    ))
}

fn participant(name: &str, domain_id: u16) -> Participant {
    Participant::open(&ParticipantOptions {
        network: &DdsNetwork::of_domain(domain_id),
        namespace: "/cli".into(),
        node_name: name.into(),
        graph_gid_bytes: 16,
        dscp: 0,
    })
    .unwrap()
}

/// The payload of sample `number`, and its encapsulation. As every publisher pads it, a multiple of 4 bytes.
fn sample(number: u32) -> (Vec<u8>, Encapsulation) {
    let mut payload = number.to_le_bytes().to_vec();
    payload
        .extend((0..number.wrapping_mul(97) % 3_000 / 4 * 4).map(|at| (at.wrapping_mul(31) ^ number) as u8));
    (payload, Encapsulation(ENCAPSULATIONS[number as usize % ENCAPSULATIONS.len()]))
}

/// A subscriber of an output, so that the lane has a reader to forward to.
struct Subscriber {
    _reader: RawReader,
    _participant: Participant,
}

impl Subscriber {
    fn new(domain_id: u16, lane: &str) -> Self {
        let mut participant = participant("subscriber", domain_id);
        let qos = ReaderQos {
            reliability: Reliability::BestEffort,
            durability: Durability::Volatile,
            depth: 16,
            deadline_ms: None,
        };
        let topic = format!("rt/adaptive_bridge/{lane}/scan");
        let reader = participant.create_reader(&topic, TYPE, &qos).unwrap();
        Self { _reader: reader, _participant: participant }
    }
}

struct Publisher {
    writer: RawWriter,
    _participant: Participant,
}

impl Publisher {
    fn new(domain_id: u16) -> Self {
        let mut participant = participant("publisher", domain_id);
        let writer = participant.create_writer("rt/scan", TYPE, &QosProfile::CRITICAL, 1_000).unwrap();
        wait_until("ingress to match the publisher", || writer.matched_readers().next().is_some());
        Self { writer, _participant: participant }
    }

    fn publish(&self, number: u32) {
        let (payload, encapsulation) = sample(number);
        let stamp = SourceTimestamp::from_wall(adaptive_bridge::clock::wall());
        self.writer.write(Bytes::from(payload), encapsulation, stamp).unwrap();
    }

    /// Publishes 0, 1, 2, … at about 200 Hz until dropped.
    fn run(self) -> Running {
        let stop = Arc::new(AtomicBool::new(false));
        let asked = Arc::clone(&stop);
        let thread = std::thread::spawn(move || {
            for number in 0.. {
                if asked.load(Ordering::Relaxed) {
                    return;
                }
                self.publish(number);
                std::thread::sleep(Duration::from_millis(5));
            }
        });
        Running { stop, thread: Some(thread) }
    }
}

struct Running {
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl Drop for Running {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

fn subscriber(domain_id: u16, topic: &str) -> (Participant, RawReader) {
    let mut participant = participant("subscriber", domain_id);
    let qos = ReaderQos {
        reliability: Reliability::Reliable,
        durability: Durability::Volatile,
        depth: 1_000,
        deadline_ms: None,
    };
    let reader = participant.create_reader(topic, TYPE, &qos).unwrap();
    (participant, reader)
}

fn run(arguments: &[&str]) -> Output {
    Command::new(program()).args(arguments).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// The status with a short window.
fn status(bridge: &Bridge) -> Value {
    let output = bridge.run("status --json --interval-ms 100");
    assert!(output.status.success(), "{}", text(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

fn wait_status(bridge: &Bridge, what: &str, fulfilled: impl Fn(&Value) -> bool) -> Value {
    wait_for(what, || {
        let output = bridge.run("status --json --interval-ms 50");
        let status: Value = serde_json::from_slice(&output.stdout).ok()?;
        fulfilled(&status).then_some(status)
    })
}

/// Starts the whole bridge and waits until every process shows itself.
fn up(bridge: &Bridge) -> Process {
    let process = bridge.start("up");
    wait_status(bridge, "all processes", |status| {
        let processes = status["processes"].as_array().unwrap();
        processes.len() == 4 && processes.iter().all(|process| process["state"] == "running")
    });
    process
}

fn lane<'a>(status: &'a Value, name: &str) -> &'a Value {
    let lanes = status["routes"][0]["lanes"].as_array().unwrap();
    lanes.iter().find(|lane| lane["lane"] == name).unwrap()
}

fn problems(status: &Value) -> String {
    status["problems"].as_array().unwrap().iter().map(|problem| format!("{problem}\n")).collect()
}

#[test]
fn without_a_bridge_status_and_tap_say_so_and_create_nothing() {
    let bridge = bridge(100);
    for arguments in ["status", "status --json", "status --watch", "tap /scan", "tap front_laser --hz"] {
        let output = bridge.run(arguments);
        assert_eq!(output.status.code(), Some(1), "{arguments}");
        assert_eq!(text(&output.stdout), "", "{arguments}");
        let stderr = text(&output.stderr);
        for part in ["no bridge runs as instance test_", "/root)", "`adaptive-bridge up`"] {
            assert!(stderr.contains(part), "{arguments}: {part} is not in: {stderr}");
        }
        assert!(!bridge.folder().join("root").exists(), "{arguments} created the root folder");
    }
    let mark = format!("_{}_", bridge.instance());
    for entry in fs::read_dir("/dev/shm").unwrap() {
        let name = entry.unwrap().file_name().to_string_lossy().into_owned();
        assert!(!name.contains(&mark), "{name} was created");
    }
}

#[test]
fn status_accounts_for_every_sample() {
    const SAMPLES: u32 = 300;
    let bridge = bridge(101);
    let mut up = up(&bridge);
    let waiting = status(&bridge);
    assert!(problems(&waiting).contains("front_laser: waits for a publisher of /scan"), "{waiting}");
    assert_eq!(waiting["routes"][0]["message_type"], Value::Null);

    let publisher = Publisher::new(101);
    let _subscriber = subscriber(101, "rt/adaptive_bridge/critical/scan");
    wait_status(&bridge, "the subscriber", |status| lane(status, "critical")["readers"] == 1);
    let mut bytes = 0;
    for number in 0..SAMPLES {
        publisher.publish(number);
        bytes += sample(number).0.len();
        std::thread::sleep(Duration::from_millis(3));
    }
    let all_out = |status: &Value| lane(status, "critical")["forwarded"] == SAMPLES;
    let status = wait_status(&bridge, "every sample on the critical lane", all_out);
    let route = &status["routes"][0];
    assert_eq!(route["received"], SAMPLES);
    assert_eq!(route["published"], SAMPLES);
    assert_eq!(route["received_bytes"], bytes);
    assert_eq!(route["lost_upstream"], 0);
    assert_eq!((&route["writers"], &route["whole"]), (&Value::from(1), &Value::from(true)));
    assert_eq!(route["message_type"], "std_msgs/msg/UInt8MultiArray");
    let critical = lane(&status, "critical");
    assert_eq!(critical["received"], SAMPLES);
    assert_eq!(critical["forwarded_bytes"], bytes);
    let handled = |lane: &Value| {
        let drops: u64 = lane["drops"].as_object().unwrap().values().map(|n| n.as_u64().unwrap()).sum();
        lane["forwarded"].as_u64().unwrap() + drops
    };
    // On a busy machine the noncritical lane receives fewer: its queue overflows, which counts as a drop.
    let settled = wait_status(&bridge, "every sample on the noncritical lane", |status| {
        let noncritical = lane(status, "noncritical");
        noncritical["waiting"] == 0 && handled(noncritical) == u64::from(SAMPLES)
    });
    for name in ["critical", "noncritical"] {
        let lane = lane(&settled, name);
        assert_eq!(handled(lane), u64::from(SAMPLES), "{name}");
        assert_eq!(lane["whole"], true, "{name}");
    }
    let noncritical = lane(&settled, "noncritical");
    assert!(noncritical["forwarded"].as_u64().unwrap() < u64::from(SAMPLES) / 2, "{noncritical}");

    let table = text(&bridge.run("status --interval-ms 100").stdout);
    assert!(table.contains("/adaptive_bridge/critical/scan      1     0.0     0.0"), "{table}");
    assert!(table.lines().all(|line| line.chars().count() <= 100), "{table}");
    assert_eq!(up.terminate().code(), Some(0));
    let after = bridge.run("status");
    assert_eq!(after.status.code(), Some(1), "{}", text(&after.stdout));
}

/// The paths of all keys of a JSON value; names of drop reasons are `<reason>`, a latency has none below it.
fn keys(value: &Value, path: &str, found: &mut BTreeSet<String>) {
    match value {
        Value::Object(map) if map.contains_key("p99_us") => {
            let names: Vec<&str> = map.keys().map(String::as_str).collect();
            assert_eq!(names, ["count", "max_us", "p50_us", "p99_us"], "{path}");
            found.insert(path.to_owned());
        }
        Value::Object(map) if path.ends_with("drops") || path.ends_with("drops_in_window") => {
            let names: BTreeSet<&str> = map.keys().map(String::as_str).collect();
            let all: BTreeSet<&str> = DropReason::ALL.iter().map(|reason| reason.label()).collect();
            assert_eq!(names, all, "{path}");
            found.insert(format!("{path}.<reason>"));
        }
        Value::Object(map) if path.starts_with("probes.refused") => {
            let names: BTreeSet<&str> = map.keys().map(String::as_str).collect();
            let all: BTreeSet<&str> = ProbeRefusal::ALL.iter().map(|refusal| refusal.label()).collect();
            assert_eq!(names, all, "{path}");
            found.insert(format!("{path}.<refusal>"));
        }
        Value::Object(map) if path.ends_with("network_refusals") => {
            let names: BTreeSet<&str> = map.keys().map(String::as_str).collect();
            let all: BTreeSet<&str> = NetworkRefusal::ALL.iter().map(|cause| cause.label()).collect();
            assert_eq!(names, all, "{path}");
            found.insert(format!("{path}.<cause>"));
        }
        Value::Object(map) => {
            for (key, value) in map {
                let below = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
                keys(value, &below, found);
            }
        }
        Value::Array(items) => {
            for item in items {
                keys(item, &format!("{path}[]"), found);
            }
        }
        _ => {
            found.insert(path.to_owned());
        }
    }
}

#[test]
fn every_key_of_the_json_is_documented_and_every_documented_key_is_there() {
    let pattern = "  - {id: camera, input_topic: /camera/**, max_routes: 1, max_sample_bytes: 8192}\n";
    let bridge = bridge_with(102, pattern);
    let _up = up(&bridge);
    let _subscriber = Subscriber::new(102, "critical");
    drop(Publisher::new(102));
    wait_status(&bridge, "a subscriber, and a problem", |status| {
        let is_listed = !lane(status, "critical")["matched_readers"].as_array().unwrap().is_empty();
        is_listed && !status["problems"].as_array().unwrap().is_empty()
    });
    let mut found = BTreeSet::new();
    keys(&status(&bridge), "", &mut found);
    let page = fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("docs/status-json.md")).unwrap();
    let table = |header: &str| -> BTreeSet<String> {
        let rows = page.split(&format!("| {header} |")).nth(1).expect(header).lines().skip(2);
        let rows = rows.take_while(|line| line.starts_with('|'));
        rows.map(|line| line.split('`').nth(1).unwrap().to_owned()).collect()
    };
    // This bridge has no subscriber, parameter or sample, and every reader matches; a unit test of the report
    // checks the keys of these lists.
    let unmatched = "routes[].lanes[].unmatched_readers[]";
    let lists = ["subscribers[]", "intruders[]", "absences[]", "routes[].publishers[]", "parameters.set[]"];
    let is_there = |key: &String| !lists.iter().chain([&unmatched]).any(|list| key.starts_with(*list));
    assert_eq!(table("Key | Meaning").into_iter().filter(is_there).collect::<BTreeSet<_>>(), found);
    let refusals: BTreeSet<String> = ProbeRefusal::ALL.iter().map(|one| one.label().to_owned()).collect();
    assert_eq!(table("Refusal | Meaning"), refusals);
    let causes: BTreeSet<String> = NetworkRefusal::ALL.iter().map(|one| one.label().to_owned()).collect();
    assert_eq!(table("Cause | Meaning"), causes);
    let reasons: BTreeSet<String> = DropReason::ALL.iter().map(|reason| reason.label().to_owned()).collect();
    assert_eq!(table("Reason | Where | Meaning"), reasons);
    let latency = ["count", "max_us", "p50_us", "p99_us"].map(str::to_owned);
    assert_eq!(table("Key of a latency | Meaning"), BTreeSet::from(latency));
}

#[test]
fn status_says_in_words_what_is_wrong() {
    let bridge = bridge(103);
    let ingress = bridge.start("ingress");
    let mut critical = bridge.start("egress --lane critical");
    wait_status(&bridge, "two processes", |status| {
        let running = |process: &&Value| process["state"] == "running";
        status["processes"].as_array().unwrap().iter().filter(running).count() == 2
    });
    let found = problems(&status(&bridge));
    assert!(
        found.contains("egress-noncritical was never started: lane noncritical forwards nothing"),
        "{found}"
    );

    let pid = ingress.pid();
    ingress.stop();
    let stopped = wait_status(&bridge, "ingress to be stopped", |status| {
        problems(status).contains(&format!("ingress (pid {pid}) is stopped: the bridge receives no samples"))
    });
    assert_eq!(stopped["processes"][0]["state"], "stopped");
    ingress.cont();
    wait_status(&bridge, "ingress to go on", |status| status["processes"][0]["state"] == "running");

    let pid = critical.pid();
    critical.kill9();
    let dead = wait_status(&bridge, "the lane to be dead", |status| {
        problems(status)
            .contains(&format!("egress-critical (pid {pid}) is dead: lane critical forwards nothing"))
    });
    assert_eq!(dead["processes"][1]["state"], "dead");
    assert_eq!(dead["processes"][1]["uptime_s"], Value::Null);
    let table = text(&bridge.run("status --interval-ms 50").stdout);
    assert!(table.lines().nth(2).unwrap().contains("egress-critical"), "{table}");

    let _again = bridge.start("egress --lane critical");
    let again =
        wait_status(&bridge, "the lane to be back", |status| status["processes"][1]["state"] == "running");
    assert_eq!(again["processes"][1]["starts"], 2);
}

#[test]
fn a_mode_set_by_hand_is_shown_and_what_it_drops_is_named() {
    let bridge = bridge(104);
    let _up = up(&bridge);
    let _subscriber = Subscriber::new(104, "noncritical");
    let _publisher = Publisher::new(104).run();
    let before = status(&bridge);
    assert_eq!(before["lanes"][1]["mode_reason"], "control");
    assert!(bridge.run("mode noncritical suspended --for 90s").status.success());
    let after = wait_status(&bridge, "suspended samples", |status| {
        lane(status, "noncritical")["drops_in_window"]["suspended"].as_u64() > Some(0)
    });
    let shown = &after["lanes"][1];
    assert_eq!(shown["mode"], "suspended");
    assert_eq!(shown["mode_reason"], "by_hand");
    assert!(shown["mode_ends_in_s"].as_f64().is_some_and(|s| s <= 90.0), "{shown}");
    let applied = wait_status(&bridge, "the mode to be applied", |status| {
        let lane = &status["lanes"][1];
        lane["applied_policy_epoch"] == lane["policy_epoch"]
    });
    assert_eq!(applied["lanes"][1]["applied_mode"], "suspended");
    assert_eq!(applied["lanes"][0]["mode"], "normal");
    assert!(text(&bridge.run("status").stdout).contains("lane noncritical: suspended (by hand, "));

    // An override ends by itself, or when it is taken back.
    assert!(bridge.run("mode noncritical degraded --for 300ms").status.success());
    wait_status(&bridge, "the override to expire", |status| status["lanes"][1]["mode_reason"] != "by_hand");
    assert!(bridge.run("mode noncritical stopped --for forever").status.success());
    wait_status(&bridge, "an override without an end", |status| {
        let lane = &status["lanes"][1];
        lane["mode_reason"] == "by_hand" && lane["mode_ends_in_s"].is_null()
    });
    assert!(bridge.run("mode noncritical auto").status.success());
    wait_status(&bridge, "samples again", |status| {
        status["lanes"][1]["applied_mode"] == "normal"
            && lane(status, "noncritical")["rate_hz"].as_f64() > Some(1.0)
    });
    assert_eq!(bridge.run("mode noncritical degraded --for soon").status.code(), Some(2));
}

#[test]
fn watch_prints_lines_and_succeeds_at_a_signal_or_a_closed_pipe() {
    let bridge = bridge(105);
    let mut running = up(&bridge);
    let mut json = bridge.start("status --watch --json --interval-ms 50");
    let mut text_watch = bridge.start("status --watch --interval-ms 50");
    let mut at = 0;
    for _ in 0..3 {
        let parsed = |line: &str| serde_json::from_str::<Value>(line).ok();
        let (report, next) = json.wait_for_line("a report", at, parsed);
        assert!(report["window_ms"].as_f64().unwrap() >= 50.0, "{report}");
        at = next;
    }
    text_watch.wait_for_line("a table", 0, |line| line.starts_with("bridge test_").then_some(()));

    // A bridge that ends is waited for.
    running.terminate();
    json.wait_for_log("no bridge runs");
    let _again = up(&bridge);
    let restarted = |line: &str| {
        let report: Value = serde_json::from_str(line).ok()?;
        (report["processes"].as_array()?.iter().all(|process| process["state"] == "running")).then_some(())
    };
    json.wait_for_line("a report of the new bridge", json.stdout_lines().len(), restarted);
    for watch in [&mut json, &mut text_watch] {
        watch.signal(Signal::SIGINT);
        assert_eq!(watch.wait().code(), Some(0), "{}", watch.log());
        assert!(!watch.stdout_lines().iter().any(|line| line.contains('\x1b')), "escapes without a terminal");
    }

    for arguments in [&["status", "--watch", "--interval-ms", "50"][..], &["check", "--json"]] {
        let mut unread = Command::new(program())
            .args(arguments)
            .arg("--config")
            .arg(bridge.config())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(unread.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let status = wait_for("the end of watch after its pipe was closed", || unread.try_wait().unwrap());
        let mut log = String::new();
        unread.stderr.take().unwrap().read_to_string(&mut log).unwrap();
        assert_eq!((status.code(), log.as_str()), (Some(0), ""));
    }
}

/// The frames of `tap --raw`.
fn frames(mut bytes: &[u8]) -> Vec<(Encapsulation, Vec<u8>)> {
    let mut frames = Vec::new();
    while !bytes.is_empty() {
        let (length, rest) = bytes.split_first_chunk::<4>().expect("a length");
        let (frame, rest) =
            rest.split_at_checked(u32::from_le_bytes(*length) as usize).expect("a whole frame");
        let (encapsulation, payload) = frame.split_first_chunk::<4>().expect("an encapsulation");
        frames.push((Encapsulation(*encapsulation), payload.to_vec()));
        bytes = rest;
    }
    frames
}

#[test]
fn a_tap_receives_payloads_bit_for_bit_and_disturbs_no_lane() {
    let bridge = bridge(106);
    let _up = up(&bridge);
    let _publisher = Publisher::new(106).run();
    let output = bridge.run("tap scan --raw --count 200");
    assert!(output.status.success(), "{}", text(&output.stderr));
    let frames = frames(&output.stdout);
    assert_eq!(frames.len(), 200);
    let mut last = None;
    for (encapsulation, payload) in frames {
        let number = u32::from_le_bytes(*payload.first_chunk().unwrap());
        assert!(last < Some(number), "{last:?} was followed by {number}");
        let (sent, sent_encapsulation) = sample(number);
        assert!(payload == sent, "sample {number} changed on the way");
        assert_eq!(encapsulation, sent_encapsulation);
        last = Some(number);
    }

    let lines = text(&bridge.run("tap front_laser --count 20").stdout);
    assert_eq!(lines.lines().filter(|line| line.starts_with("sequence=")).count(), 20, "{lines}");
    for field in
        ["age_us=", "bytes=", "encapsulation=CDR2_LE options=0002", "encapsulation=CDR_BE", "writer="]
    {
        assert!(lines.contains(field), "{field} is not in:\n{lines}");
    }
    let retained = text(&bridge.run("tap /scan --retained --count 1").stdout);
    assert!(retained.starts_with("sequence="), "{retained}");

    let hz = text(&bridge.run("tap /scan --hz --count 300").stdout);
    let last = hz.lines().last().unwrap();
    let words: Vec<&str> = last.split_whitespace().collect();
    assert_eq!(
        (words[0], words[2], words[3], words[6], words[9]),
        ("rate", "Hz", "min", "max", "std"),
        "{hz}"
    );
    assert_eq!((words[12], words[13], words[14]), ("window", "300", "lost"), "{hz}");
    let figure = |at: usize| words[at].parse::<f64>().unwrap();
    assert!(figure(4) <= figure(7), "{hz}");
    // The intervals, in ms, have this rate in the mean. The publisher writes at 200 Hz at most.
    let between = 1_000.0 / figure(7)..=1_000.0 / figure(4);
    assert!(between.contains(&figure(1)) && figure(1) < 300.0, "{hz}");

    let status = status(&bridge);
    assert_eq!(status["routes"][0]["whole"], true);
    for lane in ["critical", "noncritical"].map(|name| lane(&status, name)) {
        assert_eq!(lane["whole"], true, "{lane}");
    }
    let drops = lane(&status, "critical")["drops"].as_object().unwrap();
    // There was no subscriber except the tap.
    let others = drops.iter().filter(|(reason, _)| *reason != "no_reader");
    assert!(others.into_iter().all(|(_, count)| *count == 0), "{drops:?}");
}

#[test]
fn taps_that_read_stop_and_die_cost_a_subscriber_no_sample() {
    let bridge = bridge(124);
    let _up = up(&bridge);
    let mut flow = Flow::start(&bridge, |name| participant(name, 124));
    assert!(bridge.run("tap /scan --raw --count 100").status.success());
    // A tap that is stopped takes no further slot and returns none.
    let mut stopped = bridge.start("tap /scan");
    stopped.wait_for_line("a sample", 0, |line| line.starts_with("sequence=").then_some(()));
    stopped.signal(Signal::SIGSTOP);
    flow.wait_more(1_000);
    stopped.kill9();
    flow.wait_more(200);
    flow.end_whole(&bridge);
}

#[test]
fn a_tap_that_cannot_start_reports_the_reason() {
    let bridge = bridge(107);
    let mut running = up(&bridge);
    let _publisher = Publisher::new(107).run();
    let unknown = bridge.run("tap /imu");
    assert_eq!(unknown.status.code(), Some(1));
    let stderr = text(&unknown.stderr);
    assert!(stderr.contains("/imu; the routes are: /scan (front_laser)"), "{stderr}");
    assert_eq!(bridge.run("tap /scan --hz --raw").status.code(), Some(2));

    let mut first = bridge.start("tap /scan");
    first.wait_for_line("a sample", 0, |line| line.starts_with("sequence=").then_some(()));
    let second = bridge.run("tap /scan");
    assert_eq!(second.status.code(), Some(1));
    let stderr = text(&second.stderr);
    assert!(
        stderr.contains("all 1 places on route front_laser are taken; raise shared_memory.max_taps"),
        "{stderr}"
    );
    // A tap that was killed leaves its place to the next.
    first.kill9();
    let mut next = bridge.start("tap /scan");
    next.wait_for_line("a sample", 0, |line| line.starts_with("sequence=").then_some(()));
    next.signal(Signal::SIGINT);
    assert_eq!(next.wait().code(), Some(0), "{}", next.log());

    // A tap ends with its bridge, so that another configuration may be started.
    let mut last = bridge.start("tap /scan");
    last.wait_for_line("a sample", 0, |line| line.starts_with("sequence=").then_some(()));
    assert_eq!(running.terminate().code(), Some(0));
    assert_eq!(last.wait().code(), Some(1));
    assert!(last.log().contains("the bridge has ended"), "{}", last.log());
    assert!(!bridge.folder().join("root").join(bridge.instance()).exists());
}

#[test]
fn commands_read_the_configuration_in_force_and_not_another_file_of_the_instance() {
    let bridge = bridge(108);
    let _up = up(&bridge);
    let other = fs::read_to_string(bridge.config()).unwrap().replace("front_laser", "rear_laser");
    let path = bridge.folder().join("other.yaml");
    fs::write(&path, other).unwrap();
    let run = |command: &[&str]| {
        let output = Command::new(program()).args(command).arg("--config").arg(&path).output().unwrap();
        (output.status.code(), text(&output.stdout) + &text(&output.stderr))
    };
    let (code, output) = run(&["status", "--interval-ms", "50"]);
    assert_eq!(code, Some(0), "{output}");
    assert!(output.contains("front_laser") && !output.contains("rear_laser"), "{output}");
    let (code, output) = run(&["mode", "noncritical", "degraded"]);
    assert_eq!(code, Some(0), "{output}");
    let (code, output) = run(&["tap", "/other"]);
    assert_eq!(code, Some(1), "{output}");
    assert!(output.contains("the routes are: /scan (front_laser)"), "{output}");
    let (code, output) = run(&["check"]);
    assert_eq!(code, Some(0), "{output}");
    assert!(
        output.contains("restart of the whole bridge: topics: [front_laser] -> [rear_laser]"),
        "{output}"
    );
}

#[test]
fn exit_codes_tell_what_was_wrong() {
    let bridge = bridge(109);
    assert_eq!(bridge.run("check").status.code(), Some(0));
    assert_eq!(run(&["--version"]).status.code(), Some(0));
    for wrong in
        [&[][..], &["chek"], &["check", "--no-such-option"], &["tap"], &["status", "--interval-ms", "9"]]
    {
        let output = run(wrong);
        assert_eq!(output.status.code(), Some(2), "{wrong:?}");
        assert_eq!(text(&output.stdout), "", "{wrong:?}");
    }
    for unknown in ["egress --lane nope", "mode nope normal"] {
        let output = bridge.run(unknown);
        assert_eq!(output.status.code(), Some(1), "{unknown}");
        let stderr = text(&output.stderr);
        assert!(
            stderr.contains("there is no lane nope; the configuration has: critical, noncritical"),
            "{stderr}"
        );
    }
    bridge.write_config("topics:\n  - {id: a b, input_topic: scan}\nnonsense: 1\n");
    for arguments in
        ["check", "up", "ingress", "egress --lane critical", "status", "tap /scan", "mode critical normal"]
    {
        let output = bridge.run(arguments);
        assert_eq!(output.status.code(), Some(78), "{arguments}");
        let stderr = text(&output.stderr);
        for key in ["topics[0].id", "topics[0].input_topic", "nonsense"] {
            assert!(stderr.contains(key), "{arguments}: {key} is not in: {stderr}");
        }
    }
}

#[test]
fn check_prints_json_of_good_and_of_bad_configurations() {
    let bridge = bridge(109);
    let output = bridge.run("check --json");
    assert_eq!(output.status.code(), Some(0));
    let good: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(good["routes"][0]["outputs"][1]["topic"], "/adaptive_bridge/noncritical/scan");
    let total = good["shared_memory_bytes"].as_u64().unwrap();
    assert!(total > 8_192 && good["routes"][0]["shared_memory_bytes"] == total, "{good}");
    let memory = good["memory"].as_array().unwrap();
    let processes: Vec<_> = memory.iter().map(|memory| memory["process"].as_str().unwrap()).collect();
    assert_eq!(processes, ["ingress", "egress-critical", "egress-noncritical", "control"]);
    assert!(memory[0]["shared_memory_bytes"].as_u64().unwrap() > 2 * total, "{good}");
    for memory in memory {
        let parts = memory.as_object().unwrap().iter().filter(|(part, _)| !part.starts_with("limit"));
        let sum: u64 = parts.filter_map(|(_, bytes)| bytes.as_u64()).sum();
        assert!(memory["limit_bytes"].as_u64().unwrap() > sum, "{memory}");
    }
    bridge.write_config("topics:\n  - {id: scan, input_topic: /scan, max_sample_bytes: 0}\n");
    let output = bridge.run("check --json");
    assert_eq!(output.status.code(), Some(78));
    let bad: Value = serde_json::from_slice(&output.stdout).unwrap();
    let problem = &bad["problems"][0];
    assert_eq!(problem["key"], "topics[0].max_sample_bytes");
    assert_eq!((&problem["line"], &problem["value"]), (&Value::from(2), &Value::from("0")));
}

#[test]
fn check_explains_a_key_from_its_declaration() {
    let explain = |key: &str| {
        let output = run(&["check", "--explain", key]);
        (output.status.code(), text(&output.stdout), text(&output.stderr))
    };
    let (code, explained, _) = explain("safety.silent_ms");
    assert_eq!(code, Some(0));
    let row = config::rows().find(|row| row.paths == ["safety.silent_ms"]).unwrap();
    for part in ["safety.silent_ms\n", row.documentation, row.default, &row.range(), "reload:  applies"] {
        assert!(explained.contains(part), "{part}: {explained}");
    }
    // The user's own names, items of a list, and what a shell completes.
    for key in ["lanes.rviz.queue_depth", "lanes.<lane>.queue_depth", "lanes.LANE.queue_depth"] {
        let (code, explained, _) = explain(key);
        assert!(code == Some(0) && explained.starts_with("lanes.<lane>.queue_depth\n"), "{explained}");
    }
    for key in ["topics[0].input_topic", "topics.input_topic"] {
        assert!(explain(key).1.starts_with("topics[].input_topic\n"), "{key}");
    }
    // All keys, as they are declared and as a shell completes them.
    let script = text(&run(&["completions", "bash"]).stdout);
    let offered: BTreeSet<&str> = script.split([' ', '"', '\n']).collect();
    for key in config::KEYS.iter() {
        assert!(config::keys_at(key).iter().any(|(found, _)| found == key), "{key}");
        let names = key.replace("[]", "").replace(['<', '>'], " ");
        let plain = names.split(' ').enumerate().map(|(index, name)| match index % 2 {
            0 => name.to_owned(),
            _ => name.to_uppercase(),
        });
        let plain: String = plain.collect();
        assert!(offered.contains(plain.as_str()), "bash does not complete {plain}");
    }
    let (code, section, _) = explain("safety");
    let declared = config::KEYS.iter().filter(|key| key.starts_with("safety.")).count();
    assert_eq!((code, section.matches("reload:").count()), (Some(0), declared));

    let (code, _, error) = explain("safety.silnt_ms");
    assert!(code == Some(2) && error.contains("did you mean `safety.silent_ms`?"), "{error}");
    for key in ["", "safety..silent_ms", "safety.silent_ms.more", "nonsense"] {
        let (code, explained, error) = explain(key);
        assert!(code == Some(2) && explained.is_empty() && !error.is_empty(), "{key}");
    }
    assert_eq!(run(&["check", "--explain", "safety", "--json"]).status.code(), Some(2));
}

/// The subcommands that the help lists.
fn subcommands() -> Vec<String> {
    let help = text(&run(&["--help"]).stdout);
    let commands = help.split("Commands:").nth(1).unwrap().split("Options:").next().unwrap();
    let names = commands.lines().filter_map(|line| line.strip_prefix("  ")?.split(' ').next());
    names.filter(|name| !name.is_empty() && *name != "help").map(str::to_owned).collect()
}

#[test]
fn every_subcommand_has_completions_and_a_manual_page() {
    let commands = subcommands();
    for known in ["check", "ingress", "egress", "up", "status", "tap", "mode", "completions"] {
        assert!(commands.iter().any(|command| command == known), "{known} is not in {commands:?}");
    }
    for shell in ["bash", "zsh", "fish", "elvish", "powershell"] {
        let output = run(&["completions", shell]);
        assert_eq!(output.status.code(), Some(0));
        let script = text(&output.stdout);
        for command in &commands {
            assert!(script.contains(command.as_str()), "{shell} does not complete {command}");
        }
    }
    assert_eq!(run(&["completions", "no-such-shell"]).status.code(), Some(2));

    let folder = tempfile::tempdir().unwrap();
    let directory = folder.path().to_str().unwrap();
    assert_eq!(run(&["man", directory]).status.code(), Some(0));
    assert!(fs::read_to_string(folder.path().join("adaptive-bridge.1")).unwrap().contains(".TH"));
    for command in &commands {
        let path = folder.path().join(format!("adaptive-bridge-{command}.1"));
        let page = fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
        assert!(page.contains(".TH") && page.contains("\\-\\-") || page.contains("SHELL"), "{page}");
    }
    assert_eq!(run(&["man", "/no/such/folder"]).status.code(), Some(1));
}

#[test]
fn a_lane_on_which_no_route_has_an_output_has_no_process() {
    let bridge = Bridge::new(
        "instance: {instance}\nshared_memory: {root_path: {folder}/root}\nros: {domain_id: 120}\n\
         topics: [{id: scan, input_topic: /scan, lanes: [critical]}]\n",
    );
    let mut up = bridge.start("up");
    let status = wait_status(&bridge, "all processes", |status| {
        let processes = status["processes"].as_array().unwrap();
        processes.len() == 3 && processes.iter().all(|process| process["state"] == "running")
    });
    let names: Vec<&str> =
        status["processes"].as_array().unwrap().iter().filter_map(|one| one["name"].as_str()).collect();
    assert_eq!(names, ["ingress", "control", "egress-critical"]);
    assert_eq!(status["lanes"].as_array().unwrap().len(), 1, "{status}");
    assert!(!problems(&status).contains("noncritical"), "{status}");
    let unused = bridge.run("egress --lane noncritical");
    assert_eq!(unused.status.code(), Some(3));
    assert!(text(&unused.stderr).contains("no route has an output on this lane"), "{}", text(&unused.stderr));
    assert!(up.terminate().success());
    let has_started = |child: &str| up.log().contains(&format!("started child=\"{child}\""));
    assert!(has_started("egress-critical") && !has_started("egress-noncritical"), "{}", up.log());
}
