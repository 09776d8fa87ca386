//! Reload on a bridge that really runs: the shipped binary, real shared memory, real signals, under a flow of
//! 200 samples per second. Domains 110 to 118.

use std::time::Duration;

use adaptive_bridge::config::{self, DdsNetwork, Settings};
use adaptive_bridge::dds::{Participant, ParticipantOptions};
use adaptive_bridge::model::ProcessHealth;
use adaptive_bridge::shm::{Boards, BridgeShape, ProcessRole};
use nix::sys::signal::Signal;
use serde_json::Value;
use support::bridge::Bridge;
use support::flow::{Flow, lane};
use support::process::{self, Process};
use support::{wait_for, wait_until};

/// The file of a bridge with one route; `more` is added to it.
fn file(domain_id: u16, more: &str) -> String {
    format!(
        "instance: {{instance}}\nros: {{domain_id: {domain_id}}}\n\
         topics: [{{id: scan, input_topic: /scan, max_sample_bytes: 1024}}]\n\
         shared_memory: {{root_path: {{folder}}/root}}\n{more}"
    )
}

fn settings(bridge: &Bridge) -> Settings {
    config::load(Some(&bridge.config()), &|name| std::env::var(name).ok()).unwrap()
}

/// The health of ingress and the two lanes on the boards of the bridge with these settings; `None` until each
/// has made a turn.
fn healths(settings: &Settings) -> Option<[ProcessHealth; 3]> {
    let root = settings.shared_memory.root_path.as_deref().unwrap();
    let boards = Boards::find(root, &settings.instance, &BridgeShape::of(settings)).ok()??;
    let roles = [ProcessRole::Ingress, ProcessRole::Egress(0), ProcessRole::Egress(1)];
    let healths = roles.map(|role| boards.health(role).unwrap());
    healths.iter().all(|health| health.turns > 0).then_some(healths)
}

/// Waits until ingress and the two lanes show that these settings are in force. They answer `reload` first,
/// and show it with their next turn.
fn wait_in_force(shape: &Settings, fingerprint: u64) -> [ProcessHealth; 3] {
    wait_for("the settings to be in force", || {
        healths(shape).filter(|all| all.iter().all(|health| health.settings_fingerprint == fingerprint))
    })
}

/// Starts the whole bridge and waits until every process turns; returns it with the health of the processes.
fn up(bridge: &Bridge) -> (Process, [ProcessHealth; 3]) {
    let settings = settings(bridge);
    let process = bridge.start("up");
    let healths = wait_for("all processes", || healths(&settings));
    assert!(healths.iter().all(|health| health.settings_fingerprint == settings.fingerprint()));
    (process, healths)
}

fn participant(name: &str, domain_id: u16) -> Participant {
    Participant::open(&ParticipantOptions {
        network: &DdsNetwork::of_domain(domain_id),
        namespace: "/reload".into(),
        node_name: name.into(),
        graph_gid_bytes: 16,
        dscp: 0,
    })
    .unwrap()
}

/// A flow in that domain.
fn flow(bridge: &Bridge, domain_id: u16) -> Flow {
    Flow::start(bridge, |name| participant(name, domain_id))
}

/// Waits until the noncritical lane forwards at about that rate.
fn wait_rate(bridge: &Bridge, hz: f64) {
    wait_for(format!("{hz} Hz"), || {
        let output = bridge.run("status --json --interval-ms 2000");
        let status: Value = serde_json::from_slice(&output.stdout).ok()?;
        let rate_hz = lane(&status, "noncritical")["rate_hz"].as_f64()?;
        (rate_hz > 0.85 * hz && rate_hz < 1.15 * hz).then_some(())
    });
}

/// Runs `reload`; returns its exit code and its output.
fn reload(bridge: &Bridge) -> (Option<i32>, String) {
    let output = bridge.run("reload");
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    (output.status.code(), text(&output.stdout) + &text(&output.stderr))
}

fn assert_says(output: &str, parts: &[&str]) {
    for part in parts {
        assert!(output.contains(part), "{part:?} is not in:\n{output}");
    }
}

/// Asserts that the processes are the same as before, and were not restarted.
fn assert_same_processes(before: &[ProcessHealth; 3], now: &[ProcessHealth; 3]) {
    for (before, now) in before.iter().zip(now) {
        assert_eq!((now.pid, now.starts), (before.pid, before.starts));
    }
}

#[test]
fn rates_and_staleness_change_under_flow_and_no_sample_is_lost() {
    let bridge = Bridge::new(&file(110, ""));
    let (_up, before) = up(&bridge);
    let flow = flow(&bridge, 110);
    wait_rate(&bridge, 10.0);

    bridge.write_config(&file(
        110,
        "lanes: {noncritical: {max_rate_hz: 20, stale_threshold_ms: 100, queue_samples: 2}}\npolicy_hold_s: 9",
    ));
    let (code, output) = reload(&bridge);
    assert_eq!(code, Some(0), "{output}");
    assert_says(
        &output,
        &[
            "changed: lanes.noncritical.max_rate_hz: 10 -> 20\n",
            "changed: lanes.noncritical.stale_threshold_ms: 200 -> 100\n",
            "changed: lanes.noncritical.queue_samples: 5 -> 2\n",
            "changed: policy_hold_s: 5 -> 9\n",
            &format!("egress-noncritical (pid {}): reloaded\n", before[2].pid),
            &format!("ingress (pid {}): reloaded\n", before[0].pid),
        ],
    );
    assert!(!output.contains("restarted"), "{output}");
    wait_rate(&bridge, 20.0);
    let after = healths(&settings(&bridge)).unwrap();
    assert_same_processes(&before, &after);
    let fingerprint = settings(&bridge).fingerprint();
    assert!(after.iter().all(|health| health.settings_fingerprint == fingerprint), "{after:?}");

    let (code, output) = reload(&bridge);
    assert_eq!(code, Some(0), "{output}");
    assert_says(&output, &["): nothing differs\n"]);

    // The samples have 8 bytes, so that 320 bytes/s are 40 Hz.
    bridge.write_config(&file(110, "lanes: {noncritical: {max_rate_hz: 100, max_bytes_per_s: 320}}"));
    let (code, output) = reload(&bridge);
    assert_eq!(code, Some(0), "{output}");
    wait_rate(&bridge, 40.0);
    flow.end_whole(&bridge);
}

#[test]
fn a_bad_file_changes_nothing_and_is_reported() {
    let bridge = Bridge::new(&file(111, ""));
    let good = settings(&bridge);
    let (up, before) = up(&bridge);
    let flow = flow(&bridge, 111);
    bridge.write_config(&file(111, "lanes: {noncritical: {max_rate_hz: -1}}\nclassifyer: {}"));

    // The command contacts no process.
    let (code, output) = reload(&bridge);
    assert_eq!(code, Some(78), "{output}");
    assert_says(&output, &["lanes.noncritical.max_rate_hz = -1: must be", "did you mean `classifier`?"]);
    assert!(healths(&good).unwrap().iter().all(|health| health.refused_reloads == 0));

    // A signal does, and each process refuses, names all problems and counts.
    up.signal(Signal::SIGHUP);
    wait_until("every process to refuse", || {
        healths(&good).unwrap().iter().all(|health| health.refused_reloads == 1)
    });
    for part in ["max_rate_hz = -1", "did you mean `classifier`?", "nothing is changed"] {
        up.wait_for_log(part);
    }
    let after = healths(&good).unwrap();
    assert_same_processes(&before, &after);
    assert!(after.iter().all(|health| health.settings_fingerprint == good.fingerprint()), "{after:?}");
    wait_rate(&bridge, 10.0);

    bridge.write_config(&file(111, "lanes: {noncritical: {max_rate_hz: 5}}"));
    let (code, output) = reload(&bridge);
    assert_eq!(code, Some(0), "{output}");
    wait_rate(&bridge, 5.0);
    assert!(healths(&good).unwrap().iter().all(|health| health.refused_reloads == 1));
    flow.end_whole(&bridge);
}

#[test]
fn what_needs_a_restart_is_named_and_left_as_it_is() {
    let bridge = Bridge::new(&file(112, ""));
    let old = settings(&bridge);
    let (_up, before) = up(&bridge);
    let flow = flow(&bridge, 112);
    bridge.write_config(&file(
        112,
        "lanes: {rviz: {}, noncritical: {domain_id: 113, max_rate_hz: 20}}\n\
         subscribers: {laptop: rviz, tablet: noncritical}",
    ));
    let (code, output) = reload(&bridge);
    assert_eq!(code, Some(5), "{output}");
    assert_says(
        &output,
        &[
            "changed: lanes.noncritical.max_rate_hz: 10 -> 20\n",
            "changed: subscribers.tablet: none -> noncritical\n",
            "waits for a restart of the whole bridge: lanes.noncritical.domain_id: 112 -> 113\n",
            "waits for a restart of the whole bridge: lanes: [critical, noncritical] -> \
             [critical, noncritical, rviz]\n",
            "waits for a restart of the whole bridge: subscribers.laptop: none -> rviz\n",
        ],
    );
    let (in_force, _) = old.reloaded(settings(&bridge));
    assert_same_processes(&before, &wait_in_force(&old, in_force.fingerprint()));
    // The commands read what is in force, not the file, which has another lane.
    wait_rate(&bridge, 20.0);
    flow.end_whole(&bridge);
}

#[test]
fn no_storm_of_hang_ups_ends_a_process_or_loses_a_sample() {
    let bridge = Bridge::new(&file(113, ""));
    let started = settings(&bridge);
    let mut up_process = bridge.start("up");
    // From the first child on, while it starts.
    up_process.wait_for_log("started");
    let before = wait_for("all processes", || {
        up_process.signal(Signal::SIGHUP);
        healths(&started)
    });
    assert!(before.iter().all(|health| health.starts == 1), "{before:?}\n{}", up_process.log());
    let flow = flow(&bridge, 113);
    let storm = || {
        for round in 0..100 {
            let rate_hz = 10 + round % 2 * 10;
            bridge.write_config(&file(113, &format!("lanes: {{noncritical: {{max_rate_hz: {rate_hz}}}}}")));
            up_process.signal(Signal::SIGHUP);
            for health in &before {
                process::signal(health.pid as i32, Signal::SIGHUP);
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    };
    storm();
    let last = settings(&bridge);
    let (code, output) = reload(&bridge);
    assert_eq!(code, Some(0), "{output}");
    assert_same_processes(&before, &wait_in_force(&last, last.fingerprint()));
    flow.end_whole(&bridge);

    // Also while they stop.
    up_process.signal(Signal::SIGTERM);
    for _ in 0..50 {
        if up_process.is_running() {
            up_process.signal(Signal::SIGHUP);
        }
        std::thread::sleep(Duration::from_millis(2));
    }
    assert_eq!(up_process.wait().code(), Some(0));
}

#[test]
fn a_process_that_does_not_answer_is_named_and_no_other_is_signalled() {
    let bridge = Bridge::new(&file(114, ""));
    let (code, output) = reload(&bridge);
    assert_eq!(code, Some(1), "{output}");
    assert_says(&output, &["no bridge runs as instance"]);

    let ingress = bridge.start("ingress");
    let mut critical = bridge.start("egress --lane critical");
    bridge.wait_status("both processes", |status| {
        let processes = status["processes"].as_array().unwrap();
        processes.iter().filter(|process| process["state"] == "running").count() == 2
    });
    // The lock file of a dead process has its id, which another program may have by now.
    let lock = bridge.folder().join("root").join(bridge.instance()).join("role-egress-critical.lock");
    critical.kill9();
    let mut stranger = std::process::Command::new("sleep").arg("1000").spawn().unwrap();
    std::fs::write(&lock, format!("{}\n", stranger.id())).unwrap();
    ingress.stop();
    let (code, output) = reload(&bridge);
    assert_eq!(code, Some(1), "{output}");
    assert_says(&output, &[&format!("ingress (pid {}): no answer", ingress.pid())]);
    assert!(!output.contains("egress-critical"), "{output}");
    assert!(stranger.try_wait().unwrap().is_none(), "a stranger was signalled");
    stranger.kill().unwrap();
    stranger.wait().unwrap();

    ingress.cont();
    wait_until("ingress to go on", || reload(&bridge).0 == Some(0));
}

/// Waits until the process with this name in `status` runs with another id than `not`; returns its id.
fn pid_of(bridge: &Bridge, name: &str, not: Option<u64>) -> u64 {
    let mut found = None;
    bridge.wait_status(&format!("{name} to run"), |status| {
        let processes = status["processes"].as_array().unwrap();
        let running = processes.iter().filter(|process| process["state"] == "running");
        found = running.filter(|process| process["name"] == name).find_map(|process| process["pid"].as_u64());
        found.is_some() && found != not
    });
    found.unwrap()
}

fn kill(pid: u64) {
    process::signal(i32::try_from(pid).unwrap(), Signal::SIGKILL);
}

/// Kills each process of a running bridge and waits until it is back and forwards again.
fn kill_each(bridge: &Bridge, names: &[&str]) {
    for name in names {
        let before = pid_of(bridge, name, None);
        kill(before);
        pid_of(bridge, name, Some(before));
    }
    let received = |status: &Value| lane(status, "critical")["forwarded"].as_u64().unwrap();
    let before = received(&bridge.status());
    bridge.wait_status("the critical lane to forward", |status| received(status) > before + 20);
}

#[test]
fn crashed_processes_restart_with_the_configuration_in_force() {
    the_next_process_has_the_configuration_in_force(115, "none");
}

#[test]
fn a_standby_takes_over_with_the_configuration_in_force() {
    the_next_process_has_the_configuration_in_force(126, "warm");
}

fn the_next_process_has_the_configuration_in_force(domain_id: u16, standby: &str) {
    let file = |lanes: &str| {
        let keys = format!(
            "processes: {{ingress: {{standby: {standby}}}}}\nlanes: {{critical: {{standby: {standby}}}{lanes}}}"
        );
        file(domain_id, &keys)
    };
    let bridge = Bridge::new(&file(""));
    let in_force = settings(&bridge);
    let (up, _) = up(&bridge);
    let _flow = flow(&bridge, domain_id);
    wait_rate(&bridge, 10.0);
    let all = ["egress-critical", "egress-noncritical", "ingress", "control"];

    // A lane more.
    bridge.write_config(&file(", rviz: {}, noncritical: {max_rate_hz: 20}"));
    let (code, output) = reload(&bridge);
    assert_eq!(code, Some(5), "{output}");
    kill_each(&bridge, &all);
    for part in [
        "using the configuration in force of the running bridge, not the configuration file",
        "waits for a restart of the whole bridge: lanes: [critical, noncritical] -> [critical, noncritical, rviz]",
    ] {
        up.wait_for_log(part);
    }
    // The reloaded settings are in force in the restarted processes, too.
    wait_rate(&bridge, 20.0);
    let check = bridge.run("check");
    let output = String::from_utf8_lossy(&check.stdout).into_owned();
    assert_eq!(check.status.code(), Some(0), "{output}");
    assert_says(&output, &["waits for a restart of the whole bridge: lanes: [critical, noncritical] -> "]);

    // A broken file, no file, and another instance.
    for yaml in
        [Some("topics: [{id: scan"), None, Some("instance: another\ntopics: [{id: x, input_topic: /x}]")]
    {
        match yaml {
            Some(yaml) => bridge.write_config(yaml),
            None => std::fs::remove_file(bridge.config()).unwrap(),
        }
        kill_each(&bridge, &all);
        for command in ["mode noncritical degraded", "mode noncritical auto", "tap /scan --count 3"] {
            let output = bridge.run(command);
            assert!(output.status.success(), "{command}: {}", String::from_utf8_lossy(&output.stderr));
        }
        let status = bridge.status();
        assert_eq!(status["instance"], bridge.instance());
        let fingerprints = status["processes"].as_array().unwrap().iter();
        let fingerprints: Vec<_> = fingerprints.map(|process| &process["settings_fingerprint"]).collect();
        assert!(fingerprints.iter().all(|one| *one == fingerprints[0]), "{status}");
    }
    let folder = in_force.shared_memory.root_path.unwrap().join(bridge.instance());
    use std::os::unix::fs::PermissionsExt;
    let kept = std::fs::metadata(folder.join("in-force.json")).unwrap();
    assert_eq!(kept.permissions().mode() & 0o777, 0o600);
}

#[test]
fn a_restart_of_the_whole_bridge_applies_the_file() {
    let bridge = Bridge::new(&file(116, ""));
    let (mut first, _) = up(&bridge);
    bridge.write_config(&file(116, "lanes: {rviz: {}}"));
    first.signal(Signal::SIGTERM);
    assert_eq!(first.wait().code(), Some(0));
    assert!(!bridge.folder().join("root").join(bridge.instance()).exists());
    let mut second = bridge.start("up");
    pid_of(&bridge, "egress-rviz", None);
    // Also after all processes were killed, which leaves every file.
    bridge.write_config(&file(116, "lanes: {fleet: {}}"));
    second.kill9();
    wait_until("the children to end", || {
        let folder = bridge.folder().join("root").join(bridge.instance());
        !folder.exists() || bridge.try_status().is_err()
    });
    let third = wait_for("a start", || {
        let mut third = bridge.start("up");
        std::thread::sleep(Duration::from_millis(500));
        third.is_running().then_some(third)
    });
    pid_of(&bridge, "egress-fleet", None);
    drop(third);
}

#[test]
fn a_bridge_that_runs_is_not_started_a_second_time() {
    let bridge = Bridge::new(&file(117, ""));
    let (up, before) = up(&bridge);
    let again = bridge.run("up");
    let output = String::from_utf8_lossy(&again.stderr).into_owned();
    assert_eq!(again.status.code(), Some(1), "{output}");
    assert_says(&output, &[&format!("runs already as instance {}, process {}", bridge.instance(), up.pid())]);
    let again = bridge.run("ingress");
    let output = String::from_utf8_lossy(&again.stderr).into_owned();
    assert_eq!(again.status.code(), Some(1), "{output}");
    assert_says(&output, &[&format!("ingress is served already, by process {}", before[0].pid)]);
    assert_same_processes(&before, &healths(&settings(&bridge)).unwrap());
}

#[test]
fn processes_started_one_by_one_agree_on_the_first_ones_configuration() {
    let bridge = Bridge::new(&file(118, ""));
    let ingress = bridge.start("ingress");
    pid_of(&bridge, "ingress", None);
    bridge.write_config(&file(118, "lanes: {rviz: {}}"));
    let critical = bridge.start("egress --lane critical");
    pid_of(&bridge, "egress-critical", None);
    critical.wait_for_log("waits for a restart of the whole bridge: lanes:");
    // `up` beside them names one of them.
    let again = bridge.run("up");
    let output = String::from_utf8_lossy(&again.stderr).into_owned();
    assert_eq!(again.status.code(), Some(1), "{output}");
    assert!(
        [ingress.pid(), critical.pid()].iter().any(|pid| output.contains(&format!("process {pid}"))),
        "{output}"
    );
}
