//! `up` and the services: what they start, and what they refuse to start.

use std::fs;
use std::process::Command;

use nix::sys::signal::Signal;
use serde_json::Value;
use support::bed::{NO_STANDBYS, outputs};
use support::bridge::{Bridge, program};
use support::process::{Process, signal};

/// A bridge without standbys. `shared_memory` are more of its keys.
fn bridge(domain_id: u16, shared_memory: &str) -> Bridge {
    Bridge::new(&format!(
        "instance: {{instance}}\nros: {{domain_id: {domain_id}}}\n\
         topics:\n  - {{id: scan, input_topic: /scan, max_sample_bytes: 8192}}\n\
         shared_memory: {{root_path: {{folder}}/root{shared_memory}}}\n{NO_STANDBYS}"
    ))
}

fn pid(status: &Value, name: &str) -> i32 {
    let processes = status["processes"].as_array().unwrap();
    let process = processes.iter().find(|process| process["name"] == name).unwrap();
    i32::try_from(process["pid"].as_u64().unwrap()).unwrap()
}

fn are_running(status: &Value) -> bool {
    status["processes"].as_array().unwrap().iter().all(|process| process["state"] == "running")
}

/// As by an upgrade of the package, or a new build, which do not end an `up`.
#[test]
fn up_restarts_a_process_after_its_program_was_replaced() {
    let bridge = bridge(116, "");
    let installed = bridge.folder().join("adaptive-bridge");
    fs::copy(program(), &installed).unwrap();
    let mut command = Command::new(&installed);
    command.args(["up", "--config"]).arg(bridge.config());
    let _up = Process::spawn("up", command);
    let before = pid(&bridge.wait_status("all processes", are_running), "ingress");

    fs::remove_file(&installed).unwrap();
    fs::write(&installed, "not a program").unwrap();
    signal(before, Signal::SIGKILL);
    let status = bridge
        .wait_status("the next ingress", |status| are_running(status) && pid(status, "ingress") != before);
    let next = fs::read_link(format!("/proc/{}/exe", pid(&status, "ingress"))).unwrap();
    assert!(next.to_string_lossy().ends_with("adaptive-bridge (deleted)"), "{}", next.display());
}

#[test]
fn a_budget_with_which_ingress_cannot_start_is_a_bad_configuration() {
    let bridge = bridge(117, ", budget_bytes: 1048576, max_taps: 64");
    for role in ["check", "up", "ingress"] {
        let output = bridge.run(role);
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(78), "{role}: {stderr}");
        assert!(stderr.contains("budget_bytes") && stderr.contains("must be at least"), "{role}: {stderr}");
    }
}

/// The target starts the services of the standbys with any configuration.
#[test]
fn the_service_of_a_standby_ends_if_the_configuration_has_none() {
    let bridge = bridge(118, "");
    let _up = bridge.start("up");
    bridge.wait_status("all processes", are_running);
    for role in [&["ingress"][..], &["egress", "--lane", "critical"]] {
        let mut command = Command::new(program());
        command.args(role).arg("--config").arg(bridge.config()).env("ADAPTIVE_BRIDGE_STANDBY", "1");
        let output = command.output().unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(3), "{role:?}: {stderr}");
        assert!(stderr.contains("no standby for this role"), "{stderr}");
    }
}

/// A process has an endpoint for each route to remove, and `up` kills those that have not ended in 4.5 s.
#[test]
fn up_with_sixty_routes_ends_its_processes_in_time() {
    let route = |number| {
        format!(
            "  - {{id: scan{number}, input_topic: /scan{number}, message_type: sensor_msgs/msg/LaserScan, \
             max_sample_bytes: 8192}}\n"
        )
    };
    let topics: String = (0..60).map(route).collect();
    let bridge = Bridge::new(&format!(
        "instance: {{instance}}\nros: {{domain_id: 122}}\ntopics:\n{topics}\
         shared_memory: {{root_path: {{folder}}/root}}\n"
    ));
    // A busy machine may keep a process from ending in time, but hardly three times in a row.
    let mut log = String::new();
    let ends_in_time = (0..3).any(|_| {
        let mut up = bridge.start("up");
        let has_all_writers = |status: &Value| {
            are_running(status) && outputs(status).filter(|output| output["topic"].is_string()).count() == 120
        };
        bridge.wait_status("all processes, and the writers of all routes", has_all_writers);
        let status = up.terminate();
        log = up.log();
        status.success() && !log.contains("did not end in time")
    });
    assert!(ends_in_time, "{log}");
}

/// One that read another file than the other services would be a second bridge beside theirs.
#[test]
fn the_service_of_a_standby_begins_no_bridge() {
    let bridge = bridge(119, "");
    let mut command = Command::new(program());
    command.args(["ingress", "--config"]).arg(bridge.config()).env("ADAPTIVE_BRIDGE_STANDBY", "1");
    let output = command.output().unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("no bridge runs with") && stderr.contains("units --write"), "{stderr}");

    fs::write(bridge.config(), "topics: nonsense\n").unwrap();
    assert_eq!(command.output().unwrap().status.code(), Some(78));
}
