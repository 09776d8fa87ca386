//! The parameter services of the bridge's nodes, called by a ROS 2 node (rclpy on Fast DDS), and by a peer on
//! Cyclone DDS in the form of rmw_cyclonedds.

use std::time::Duration;

use nix::sys::signal::Signal;
use serde_json::{Value, json};
use support::bed::{Bed, SCAN};
use support::peer::{Peer, RunningPeer};
use support::process::signal;
use support::ros;

/// Beside SCAN: values that are not the defaults.
const PROBES: &str = "probes: {rate_hz: 4}\nclassifier: {hysteresis_count: 7}\n";

/// A node that calls services, and the replies that the test has read.
struct Client {
    peer: RunningPeer,
    replies: usize,
}

impl Client {
    fn start(bed: &Bed) -> Self {
        Self { peer: Peer::parameters("rqt").start_on(bed.host("slow")), replies: 0 }
    }

    /// Calls a service of a node of the bridge; returns the whole event.
    fn event(&mut self, bed: &Bed, node: &str, mut call: Value) -> Value {
        call["node"] = format!("/adaptive_bridge/{}/{node}", bed.bridge.instance()).into();
        self.peer.say(call.to_string());
        self.replies += 1;
        let mut seen = 0;
        self.peer.wait_for(&format!("the reply to {call}"), |event| {
            seen += usize::from(event["event"] == "reply");
            event["event"] == "reply" && seen == self.replies
        })
    }

    fn call(&mut self, bed: &Bed, node: &str, call: Value) -> Value {
        let event = self.event(bed, node, call.clone());
        assert_eq!(event["answered"], 1, "{call}: {event}");
        event["reply"].clone()
    }

    fn values(&mut self, bed: &Bed, names: &[&str]) -> Value {
        self.call(bed, "control", json!({ "call": "get", "names": names }))["values"].clone()
    }

    fn set(&mut self, bed: &Bed, values: Value) -> Value {
        self.call(bed, "control", json!({ "call": "set", "values": values }))["results"].clone()
    }

    /// Sets parameters again while a process has not applied them within the 2 s that the reply waits.
    fn set_applied(&mut self, bed: &Bed, values: &Value) -> Value {
        support::wait_for("the parameters applied", || {
            let results = self.set(bed, values.clone());
            let is_late = |result: &Value| {
                let reason = result["reason"].as_str().unwrap();
                ["not applied within", "has changed: run"].iter().any(|late| reason.contains(late))
            };
            let is_late = results.as_array().unwrap().iter().any(is_late);
            if is_late {
                pause();
            }
            (!is_late).then_some(results)
        })
    }
}

/// Keeps the requests below the 20 per second that one participant may send.
fn pause() {
    std::thread::sleep(Duration::from_millis(100));
}

fn start(test: &str) -> Option<(Bed, Client)> {
    start_with(test, "")
}

/// Starts the bridge with more lines of configuration.
fn start_with(test: &str, yaml: &str) -> Option<(Bed, Client)> {
    if let Some(reason) = ros::missing() {
        support::skip(test, &reason);
        return None;
    }
    let bed = Bed::start(test, &format!("{SCAN}{PROBES}{yaml}"))?;
    let client = Client::start(&bed);
    Some((bed, client))
}

fn refused(results: &Value, index: usize) -> &str {
    assert_eq!(results[index]["successful"], false, "{results}");
    results[index]["reason"].as_str().unwrap()
}

#[test]
fn every_node_lists_gets_and_describes_the_configuration_in_force() {
    let Some((bed, mut client)) = start("every_node_lists_gets_and_describes_the_configuration_in_force")
    else {
        return;
    };
    for node in ["ingress", "control", "egress_critical", "egress_noncritical"] {
        let listed = client.call(&bed, node, json!({ "call": "list", "names": ["probes", "topics.scan"] }));
        let names = listed["result"]["names"].as_array().unwrap();
        for name in ["probes.rate_hz", "topics.scan.input_topic", "topics.scan.qos_overrides.critical.depth"]
        {
            assert!(names.contains(&json!(name)), "{node}: {names:?}");
        }
    }
    let names = ["probes.rate_hz", "classifier.hysteresis_count", "topics.scan.input_topic", "no.key"];
    assert_eq!(client.values(&bed, &names), json!([4.0, 7, "/scan", null]));
    let types = client.call(&bed, "control", json!({ "call": "types", "names": names }));
    assert_eq!(types["types"], json!([3, 2, 4, 0]));
    let described = client.call(&bed, "control", json!({ "call": "describe", "names": names }));
    let described = &described["descriptors"];
    let range = json!([{ "from_value": 0.01, "to_value": 1000.0, "step": 0.0 }]);
    assert_eq!(described[0]["floating_point_range"], range);
    assert_eq!(described[1]["integer_range"], json!([{ "from_value": 1, "to_value": 1000, "step": 1 }]));
    assert_eq!([&described[0]["read_only"], &described[2]["read_only"]], [false, true]);
    // All at once, in several datagrams.
    let all = client.call(&bed, "control", json!({ "call": "list" }))["result"]["names"].clone();
    let count = all.as_array().unwrap().len();
    assert!(count > 100, "{count} parameters");
    let described = client.call(&bed, "control", json!({ "call": "describe", "names": all }));
    assert_eq!(described["descriptors"].as_array().unwrap().len(), count);
    bed.end();
}

#[test]
fn a_parameter_that_is_set_reaches_all_processes_and_stays_until_the_bridge_ends() {
    let test = "a_parameter_that_is_set_reaches_all_processes_and_stays_until_the_bridge_ends";
    let Some((bed, mut client)) = start(test) else { return };
    let set = |status: &Value| status["parameters"]["set"].clone();
    let results = client.set_applied(
        &bed,
        &json!({ "lanes.noncritical.max_rate_hz": 7.0, "probes.rate_hz": 0.0, "topics.scan.input_topic": "/a" }),
    );
    assert_eq!(results[0], json!({ "successful": true, "reason": "" }), "{results}");
    assert_eq!(refused(&results, 1), "probes.rate_hz = 0: must be a number from 0.01 to 1000");
    assert!(refused(&results, 2).starts_with("read-only"), "{results}");
    let status = bed.bridge.wait_status("the same settings in all processes", |status| {
        let processes = status["processes"].as_array().unwrap();
        processes.iter().all(|one| one["settings_fingerprint"] == processes[0]["settings_fingerprint"])
            && set(status) != json!([])
    });
    assert_eq!(set(&status), json!(["lanes.noncritical.max_rate_hz: 7"]));
    bed.up.wait_for_log("reloaded: lanes.noncritical.max_rate_hz: 10 -> 7");
    let names = ["lanes.noncritical.max_rate_hz", "probes.rate_hz"];
    assert_eq!(client.values(&bed, &names), json!([7.0, 4.0]));

    // A process that restarts keeps the parameter.
    let lane = "egress-noncritical";
    signal(bed.pid(lane), Signal::SIGKILL);
    support::wait_until("a restart", || bed.pids(lane).len() == 2);
    bed.bridge.wait_status("the parameter in the restarted process", |status| {
        let processes = status["processes"].as_array().unwrap();
        processes.iter().all(|one| one["settings_fingerprint"] == processes[0]["settings_fingerprint"])
            && processes.iter().any(|one| one["name"] == lane && one["starts"] == 2)
    });

    // A reload of the file changes the rest of the settings and keeps the parameter.
    let yaml = format!("instance: {{instance}}\n{SCAN}{}", PROBES.replace("rate_hz: 4", "rate_hz: 6"));
    bed.bridge.write_config(&yaml);
    let results = client.set(&bed, json!({ "classifier.hysteresis_count": 8 }));
    assert!(refused(&results, 0).contains("run `adaptive-bridge reload` first"), "{results}");
    let reload = bed.bridge.run("reload");
    assert!(reload.status.success(), "{}", String::from_utf8_lossy(&reload.stderr));
    support::wait_until("the reloaded file", || {
        pause();
        client.values(&bed, &names) == json!([7.0, 6.0])
    });

    // All or none.
    let both = json!({ "classifier.hysteresis_count": 8, "probes.rate_hz": 0.0 });
    let result = client.call(&bed, "control", json!({ "call": "set_atomically", "values": both }));
    assert_eq!(result["result"]["successful"], false, "{result}");
    assert_eq!(client.values(&bed, &["classifier.hysteresis_count"]), json!([7]));
    // Nothing that could stop critical lanes.
    let values =
        json!({ "safety.preserve_critical_path": false, "safety.silent_ms": 600, "policy_hold_s": 0.0 });
    let results = client.set(&bed, values);
    for index in 0..3 {
        assert!(refused(&results, index).starts_with("read-only: edit the configuration file"), "{results}");
    }
    // With the value of the file the parameter is no longer in place of it.
    client.set_applied(&bed, &json!({ "lanes.noncritical.max_rate_hz": 10.0 }));
    bed.bridge.wait_status("no parameter set", |status| set(status) == json!([]));
    bed.end();
}

#[test]
fn no_parameter_can_be_set_if_messages_are_signed_and_unknown_senders_denied() {
    let test = "no_parameter_can_be_set_if_messages_are_signed_and_unknown_senders_denied";
    let signed = "security: {trust_mode: default_deny, enable_probe_hmac: true, \
                  hmac_secret_file: '{folder}/secret'}\n";
    let Some((bed, mut client)) = start_with(test, signed) else { return };
    let results = client.set(&bed, json!({ "probes.rate_hz": 5.0, "lanes.noncritical.max_rate_hz": 7.0 }));
    for index in [0, 1] {
        let reason = refused(&results, index);
        assert!(
            reason.starts_with("security.trust_mode is default_deny: requests cannot be signed"),
            "{reason}"
        );
    }
    let names = ["probes.rate_hz", "lanes.noncritical.max_rate_hz"];
    assert_eq!(client.values(&bed, &names), json!([4.0, 10.0]));
    assert_eq!(bed.bridge.status()["parameters"]["set"], json!([]));
    bed.end();
}

#[test]
fn a_bridge_that_starts_with_the_dump_of_a_node_has_what_was_set() {
    let test = "a_bridge_that_starts_with_the_dump_of_a_node_has_what_was_set";
    let Some((mut bed, mut client)) = start(test) else { return };
    let results = client.set(&bed, json!({ "lanes.noncritical.max_rate_hz": 7.0 }));
    assert_eq!(results[0], json!({ "successful": true, "reason": "" }), "{results}");
    // What `ros2 param dump` prints, in JSON, which is YAML.
    let names = client.call(&bed, "ingress", json!({ "call": "list" }))["result"]["names"].clone();
    let values = client.call(&bed, "ingress", json!({ "call": "get", "names": names }))["values"].clone();
    let mut parameters = json!({});
    for (name, value) in names.as_array().unwrap().iter().zip(values.as_array().unwrap()) {
        let place = name.as_str().unwrap().split('.').fold(&mut parameters, |node, name| &mut node[name]);
        *place = value.clone();
    }
    let node = format!("/adaptive_bridge/{}/ingress", bed.bridge.instance());
    let dump = bed.bridge.folder().join("dump.yaml");
    std::fs::write(&dump, format!("{:#}", json!({ node: { "ros__parameters": parameters } }))).unwrap();

    bed.up.signal(Signal::SIGINT);
    assert!(bed.up.wait().success(), "{}", bed.up.log());
    let arguments = format!("up --ros-args --params-file {} --", dump.display());
    bed.up = bed.bridge.start_on(bed.host("bridge"), &arguments);
    bed.wait_up();
    let mut client = Client::start(&bed);
    let names = ["lanes.noncritical.max_rate_hz", "probes.rate_hz"];
    assert_eq!(client.values(&bed, &names), json!([7.0, 4.0]));
    let status = bed.bridge.status();
    assert_eq!(status["parameters"]["set"], json!([]));
    bed.end();
}

#[test]
fn a_parameter_that_makes_the_file_bad_is_named_by_reload_and_can_be_removed() {
    let test = "a_parameter_that_makes_the_file_bad_is_named_by_reload_and_can_be_removed";
    let Some((bed, mut client)) = start(test) else { return };
    let nine: Value = (0..9).map(|index| (format!("overrides.laptop{index}"), json!("CRITICAL"))).collect();
    let results = client.set(&bed, nine);
    assert_eq!(refused(&results, 8), "at most 8 parameters can be set by one request");
    let results = client.set_applied(&bed, &json!({ "probes.rate_hz": 15.0 }));
    assert_eq!(results[0], json!({ "successful": true, "reason": "" }), "{results}");

    let limit = "security: {max_probe_rate_hz: 10}\n";
    bed.bridge.write_config(&format!("instance: {{instance}}\n{SCAN}{PROBES}{limit}"));
    let reload = bed.bridge.run("reload");
    let error = String::from_utf8_lossy(&reload.stderr).into_owned();
    assert!(!reload.status.success(), "{error}");
    assert!(error.contains("probes.rate_hz: 15") && error.contains("ros2 param delete"), "{error}");
    let results = client.set(&bed, json!({ "policy_hold_s": 6.0, "probes.window_size": 60 }));
    assert!(refused(&results, 1).contains("the configuration file is bad"), "{results}");
    let results = client.set_applied(&bed, &json!({ "probes.rate_hz": null }));
    assert_eq!(results[0], json!({ "successful": true, "reason": "" }), "{results}");
    let names = ["probes.rate_hz", "security.max_probe_rate_hz"];
    assert_eq!(client.values(&bed, &names), json!([4.0, 10]));
    bed.end();
}

#[test]
fn requests_beyond_the_rate_of_a_participant_are_counted_and_dropped() {
    let test = "requests_beyond_the_rate_of_a_participant_are_counted_and_dropped";
    let Some((bed, mut client)) = start(test) else { return };
    let requests = |status: &Value, what: &str| status["parameters"]["requests"][what].as_u64().unwrap();
    // 100 requests may arrive at once, and then 20 a second. The client waits for no reply.
    support::wait_until("requests beyond the rate", || {
        for _ in 0..10 {
            let call = json!({ "call": "get", "names": ["instance"], "times": 20, "waits": false });
            client.event(&bed, "control", call);
        }
        requests(&bed.bridge.status(), "rate_limited") > 0
    });
    bed.bridge.wait_status("the answers within the rate", |status| requests(status, "answered") >= 100);
    // A node of another participant is answered.
    let mut other = Client::start(&bed);
    assert_eq!(other.values(&bed, &["probes.rate_hz"]), json!([4.0]));
    bed.end();
}

#[test]
fn a_request_that_is_too_large_is_counted_and_the_next_one_is_answered() {
    let test = "a_request_that_is_too_large_is_counted_and_the_next_one_is_answered";
    let Some((bed, mut client)) = start(test) else { return };
    // The reply to the first one would have some 200 kB. The second one has 70 kB, and comes in fragments.
    let too_large = [vec!["instance".to_owned(); 3_000], vec!["n".repeat(70_000)]];
    for (sent, names) in (1_u64..).zip(too_large) {
        let call = json!({ "call": "get", "names": names, "times": 1, "waits": false });
        client.event(&bed, "control", call);
        bed.bridge.wait_status("a request that is too large", |status| {
            status["parameters"]["requests"]["too_large"] == sent
        });
        assert_eq!(client.values(&bed, &["probes.rate_hz"]), json!([4.0]));
    }
    bed.end();
}

/// A client on Cyclone DDS of a service of a node.
struct CycloneClient {
    peer: RunningPeer,
    calls: u64,
}

impl CycloneClient {
    fn start(bed: &Bed, node: &str, service: &str, type_name: &str) -> Self {
        let service = format!("adaptive_bridge/{}/{node}/{service}", bed.bridge.instance());
        let type_name = format!("rcl_interfaces::srv::dds_::{type_name}");
        Self { peer: Peer::client(&service, &type_name).start_on(bed.host("slow")), calls: 0 }
    }

    /// The CDR of the reply.
    fn call(&mut self, request: &[u8]) -> Vec<u8> {
        self.peer.say(request.iter().map(|byte| format!("{byte:02x}")).collect::<String>());
        self.calls += 1;
        let calls = self.calls;
        let reply = self.peer.wait_for(&format!("reply {calls}"), |event| {
            event["event"] == "reply" && event["number"] == calls
        });
        assert_eq!(reply["encapsulation"], "00010000");
        let digits = reply["body"].as_str().unwrap().as_bytes().chunks(2);
        digits.map(|two| u8::from_str_radix(std::str::from_utf8(two).unwrap(), 16).unwrap()).collect()
    }

    fn end(self) {
        let others = self.peer.events().iter().filter(|event| event["event"] == "reply_of_another").count();
        assert_eq!(others, 0);
        let _: Value = self.peer.finish();
    }
}

/// Lengthens plain CDR to a multiple of `bytes`.
fn align(cdr: &mut Vec<u8>, bytes: usize) {
    cdr.resize(cdr.len().next_multiple_of(bytes), 0);
}

fn put_string(cdr: &mut Vec<u8>, text: &str) {
    align(cdr, 4);
    cdr.extend((text.len() as u32 + 1).to_le_bytes());
    cdr.extend([text.as_bytes(), b"\0"].concat());
}

/// `rcl_interfaces/msg/ParameterValue` with a number.
fn put_value(cdr: &mut Vec<u8>, kind: u8, whole: i64, decimal: f64) {
    cdr.extend([kind, 0]);
    align(cdr, 8);
    cdr.extend([whole.to_le_bytes(), decimal.to_le_bytes()].concat());
    put_string(cdr, "");
    align(cdr, 4);
    // Five empty lists.
    cdr.extend([0; 20]);
}

fn sequence(count: u32, put: impl FnOnce(&mut Vec<u8>)) -> Vec<u8> {
    let mut cdr = count.to_le_bytes().to_vec();
    put(&mut cdr);
    cdr
}

/// The texts of a sequence of strings at the beginning of `cdr`.
fn strings(cdr: &[u8]) -> Vec<&str> {
    let word = |at: usize| u32::from_le_bytes(cdr[at..at + 4].try_into().unwrap()) as usize;
    let mut at = 4_usize;
    let text = |_| {
        at = at.next_multiple_of(4);
        let (begin, length) = (at + 4, word(at));
        at = begin + length;
        std::str::from_utf8(&cdr[begin..at - 1]).unwrap()
    };
    (0..word(0)).map(text).collect()
}

#[test]
fn clients_of_rmw_cyclonedds_list_get_and_set_parameters() {
    let test = "clients_of_rmw_cyclonedds_list_get_and_set_parameters";
    let Some(bed) = Bed::start(test, &format!("{SCAN}{PROBES}")) else { return };
    let names = sequence(2, |cdr| {
        put_string(cdr, "probes.rate_hz");
        put_string(cdr, "classifier.hysteresis_count");
    });
    let values = |rate_hz: f64| {
        sequence(2, |cdr| {
            put_value(cdr, 3, 0, rate_hz);
            put_value(cdr, 2, 7, 0.0);
        })
    };
    // Two clients of the same service: each takes its own replies only.
    let getting = || CycloneClient::start(&bed, "control", "get_parameters", "GetParameters");
    let mut get = [getting(), getting()];
    for call in 0..6 {
        assert_eq!(get[call % 2].call(&names), values(4.0));
    }
    let mut list = CycloneClient::start(&bed, "ingress", "list_parameters", "ListParameters");
    // No prefixes and any depth; the reply is larger than a datagram.
    let listed = list.call(&[0; 16]);
    assert!(listed.len() > 1_500, "{} bytes", listed.len());
    let listed = strings(&listed);
    assert!(listed.is_sorted() && listed.contains(&"topics.scan.input_topic"), "{listed:?}");

    let mut set = CycloneClient::start(&bed, "control", "set_parameters", "SetParameters");
    let request = sequence(1, |cdr| {
        put_string(cdr, "probes.rate_hz");
        put_value(cdr, 3, 0, 5.0);
    });
    let successful = sequence(1, |cdr| {
        cdr.push(1);
        put_string(cdr, "");
        // RTPS sends whole words.
        align(cdr, 4);
    });
    assert_eq!(set.call(&request), successful);
    assert_eq!(get[0].call(&names), values(5.0));
    for client in get.into_iter().chain([list, set]) {
        client.end();
    }
    bed.end();
}
