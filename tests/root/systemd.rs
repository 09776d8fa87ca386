//! The bridge as services of a real systemd: hardened, supervised, restarted. Machines in containers, real
//! signals, real DDS peers on hosts of their own.

use std::collections::HashMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use serde_json::Value;
use support::bed::{CRITICAL, INPUT, NO_STANDBYS, NONCRITICAL, SCAN};
use support::machine::{Machine, install, machine_missing};
use support::netns::{Host, Net};
use support::peer::{Peer, Received, RunningPeer, Sent};
use support::threads::{Fault, THREADS, cause, thread};

const TARGET: &str = "adaptive-bridge.target";
const INGRESS: &str = "adaptive-bridge-ingress.service";
const EGRESS_CRITICAL: &str = "adaptive-bridge-egress@critical.service";
const EGRESS_NONCRITICAL: &str = "adaptive-bridge-egress@noncritical.service";
const CONTROL: &str = "adaptive-bridge-control.service";
const UNITS: [&str; 4] = [INGRESS, EGRESS_CRITICAL, EGRESS_NONCRITICAL, CONTROL];
const STANDBYS: [&str; 2] =
    ["adaptive-bridge-standby-ingress.service", "adaptive-bridge-standby-critical.service"];
const RESPONDER: &str = "adaptive-bridge-responder@laptop.service";

/// The rate of the publisher.
const RATE_HZ: f64 = 200.0;
const CONFIG: &str = "/etc/adaptive-bridge/config.yaml";

/// A message of a reload that does not apply a change.
const WAITS: &str = "waits for a restart of the whole bridge";

/// Tenths: `systemd-analyze security` shows 2.0 for 20.
const MAX_EXPOSURE: &str = "--threshold=20";

/// A machine with the bridge, and hosts around it. Fields are dropped in this order.
struct Bed {
    machine: Machine,
    net: Net,
}

impl Bed {
    fn boot(test: &str, yaml: &str) -> Option<Self> {
        Self::boot_by(Machine::boot, test, yaml)
    }

    fn boot_by(boot: impl FnOnce(&Host, &dyn Fn(&Path)) -> Machine, test: &str, yaml: &str) -> Option<Self> {
        if let Some(reason) = machine_missing() {
            support::skip(test, &reason);
            return None;
        }
        let net = Net::new(&["publisher", "bridge", "critical", "slow"]);
        let machine = boot(net.host("bridge"), &|root: &Path| {
            install(root);
            let config = root.join(CONFIG.trim_start_matches('/'));
            fs::create_dir_all(config.parent().unwrap()).unwrap();
            fs::write(config, yaml).unwrap();
        });
        Some(Self { machine, net })
    }

    /// Starts the bridge and waits until every process has reported that it is ready.
    fn start(&self) {
        self.machine.run(&["systemctl", "start", TARGET]);
        for unit in UNITS {
            self.machine.wait_property(unit, "ActiveState", "active");
        }
    }

    /// Stops the bridge and waits until every process has ended.
    fn stop(&self) {
        self.machine.run(&["systemctl", "stop", TARGET]);
        for unit in UNITS.into_iter().chain(STANDBYS) {
            self.machine.wait_property(unit, "ActiveState", "inactive");
            assert_eq!(self.machine.property(unit, "Result"), "success", "{unit}");
        }
    }

    fn flow(&self) -> Flow {
        let subscriber = |host: &str, peer: Peer, topic: &str| {
            peer.subscriber().topic(topic).start_on(self.net.host(host))
        };
        let critical = subscriber("critical", Peer::fast().keep_all(), CRITICAL);
        let slow = subscriber("slow", Peer::fast().best_effort(), NONCRITICAL);
        // KEEP_LAST, as ROS 2 has it: a KEEP_ALL writer waits for an ingress that is stopped, until that is
        // restarted.
        let direct = subscriber("slow", Peer::fast(), INPUT);
        let publisher = Peer::cyclone().rate_hz(RATE_HZ).publisher().topic(INPUT).wait_match(2);
        let publisher = publisher.start_on(self.net.host("publisher"));
        critical.wait_received(50);
        slow.wait_received(3);
        direct.wait_received(50);
        Flow { publisher, critical, slow, direct }
    }

    /// Waits until a unit was restarted `restarts` times and is active again.
    fn wait_restarts(&self, unit: &str, restarts: usize) {
        self.machine.wait_property(unit, "NRestarts", &restarts.to_string());
        self.machine.wait_property(unit, "ActiveState", "active");
    }
}

/// A publisher, a critical and a remote subscriber, and one that receives without the bridge.
struct Flow {
    publisher: RunningPeer,
    critical: RunningPeer,
    slow: RunningPeer,
    direct: RunningPeer,
}

impl Flow {
    /// Waits until samples that are sent from now on reach both subscribers.
    fn wait_on(&self) {
        self.wait_critical(20);
        self.wait_slow(3);
    }

    /// Waits until so many more samples reach the remote subscriber.
    fn wait_slow(&self, samples: u64) {
        self.slow.wait_received(self.slow.received() + samples);
    }

    /// Waits until so many more samples reach the critical subscriber.
    fn wait_critical(&self, samples: u64) {
        self.critical.wait_received(self.critical.received() + samples);
    }

    /// Asserts that the publisher has written at a quarter of its rate at least since `began`, when it had
    /// written `before` samples: one that waits for a stopped process writes none meanwhile.
    fn assert_written(&self, before: u64, began: Instant) {
        let (written, time_s) = (self.direct.received() - before, began.elapsed().as_secs_f64());
        assert!(written as f64 >= time_s * RATE_HZ / 4.0, "{written} samples written in {time_s:.2} s");
    }

    /// Ends the flow. Asserts that the publisher was never blocked and that the received samples are sound.
    fn end(self) -> (Sent, Received) {
        let sent: Sent = self.publisher.end();
        sent.assert_not_blocked();
        let longest_ms = sent.call_us.map_or(0.0, |calls| calls.max / 1e3);
        println!(
            "publisher: {} samples, {:.1} Hz, {} ticks skipped, longest write {longest_ms:.1} ms",
            sent.ok, sent.rate_hz, sent.skipped_ticks
        );
        let received: Received = self.critical.end();
        received.assert_sound();
        self.slow.end::<Received>().assert_sound();
        self.direct.end::<Received>().assert_sound();
        (sent, received)
    }
}

#[test]
fn the_units_are_sound_and_hardened() {
    let test = "the_units_are_sound_and_hardened";
    if Command::new("systemd-analyze").arg("--version").output().is_err() {
        support::skip(test, "systemd-analyze is not installed (make setup)");
        return;
    }
    // Units of this machine that ours refer to, and the programs that they start.
    let root = tempfile::tempdir().unwrap();
    install(root.path());
    let units = root.path().join("usr/lib/systemd/system");
    for unit in ["basic", "multi-user", "network", "shutdown", "sysinit"] {
        fs::write(units.join(format!("{unit}.target")), "[Unit]\nDescription=Here\n").unwrap();
    }
    fs::copy("/bin/kill", root.path().join("usr/bin/kill")).unwrap();
    let analyze = |arguments: &[&str], unit: &str| {
        let mut command = Command::new("systemd-analyze");
        command.arg(format!("--root={}", root.path().display())).args(arguments).arg(unit);
        let output = command.output().unwrap();
        let printed = [output.stdout, output.stderr].concat();
        assert!(output.status.success(), "{command:?}\n{}", String::from_utf8_lossy(&printed));
    };
    for unit in UNITS.into_iter().chain(STANDBYS).chain([RESPONDER]) {
        analyze(&["security", "--offline=true", MAX_EXPOSURE], unit);
    }
    for unit in UNITS.into_iter().chain(STANDBYS).chain([RESPONDER, TARGET, "adaptive-bridge-critical.slice"])
    {
        analyze(&["verify", "--recursive-errors=one", "--man=no"], unit);
    }
}

#[test]
fn a_killed_or_stopped_unit_is_restarted_and_delays_no_other() {
    let test = "a_killed_or_stopped_unit_is_restarted_and_delays_no_other";
    let Some(bed) = Bed::boot(test, &format!("{SCAN}{NO_STANDBYS}")) else { return };
    bed.start();
    for standby in STANDBYS {
        bed.machine.wait_property(standby, "ActiveState", "inactive");
        assert_eq!(bed.machine.property(standby, "Result"), "success", "{standby}");
    }
    bed.machine.run(&["systemctl", "start", RESPONDER]);
    let flow = bed.flow();
    for unit in UNITS.into_iter().chain([RESPONDER]) {
        for (restarts, signal) in [(1, "KILL"), (2, "STOP")] {
            if (unit, signal) == (EGRESS_CRITICAL, "STOP") {
                // A process that was up for less than a second does not leave its identity if it took it
                // over. Then the sample that it was sending may arrive twice.
                std::thread::sleep(Duration::from_millis(1_500));
            }
            let (began, before) = (Instant::now(), flow.direct.received());
            bed.machine.run(&["kill", "-s", signal, &bed.machine.main_pid(unit)]);
            bed.wait_restarts(unit, restarts);
            flow.assert_written(before, began);
            let active = began.elapsed();
            flow.wait_critical(20);
            let critical = began.elapsed();
            // Those of discovery and of samples, by unicast and by multicast.
            let sockets = if [INGRESS, EGRESS_CRITICAL].contains(&unit) { "4" } else { "0" };
            assert_eq!(bed.machine.property(unit, "NFileDescriptorStore"), sockets, "{unit}");
            if (unit, signal) == (INGRESS, "KILL") {
                let status = bed.machine.try_status().unwrap();
                assert_eq!(status["routes"][0]["lost_upstream"], 0, "{status}");
            }
            // Later than the other: the supervisor of safety suspends this lane while the critical one has
            // trouble, and for ten good readings after that, two a second.
            flow.wait_slow(3);
            println!(
                "{unit}: SIG{signal} to active {:.2} s, to flow on the critical lane {:.2} s, on every lane {:.2} s",
                active.as_secs_f64(),
                critical.as_secs_f64(),
                began.elapsed().as_secs_f64()
            );
        }
    }
    flow.end();
    bed.machine.run(&["systemctl", "stop", RESPONDER]);
    bed.stop();
}

/// Either unit of a role may have it: the one that finds it taken waits.
#[test]
fn a_standby_takes_over_from_a_unit_that_is_killed_stopped_restarted_or_hangs() {
    let test = "a_standby_takes_over_from_a_unit_that_is_killed_stopped_restarted_or_hangs";
    let Some(bed) = Bed::boot(test, SCAN) else { return };
    bed.start();
    for standby in STANDBYS {
        bed.machine.wait_property(standby, "ActiveState", "active");
    }
    let process = |name: &str| -> Option<Value> {
        let status = bed.machine.try_status()?;
        status["processes"].as_array()?.iter().find(|process| process["name"] == name).cloned()
    };
    let flow = bed.flow();
    let (lane, ingress) =
        (("egress-critical", [EGRESS_CRITICAL, STANDBYS[1]]), ("ingress", [INGRESS, STANDBYS[0]]));
    let of_both =
        ["KILL", "STOP", "TERM", "KILL"].into_iter().flat_map(|what| [(lane, what), (ingress, what)]);
    let mut take_overs = HashMap::new();
    for ((name, units), what) in [(lane, "hang")].into_iter().chain(of_both) {
        let active = support::wait_for(format!("a standby of {name}"), || {
            let process = process(name).filter(|process| process["standby"]["pid"] != 0)?;
            Some(process["pid"].to_string())
        });
        // See the test above. A standby has the sockets of the active process after 0.1 s.
        std::thread::sleep(Duration::from_millis(1_500));
        let unit = units.into_iter().find(|unit| bed.machine.main_pid(unit) == active);
        let unit = unit.expect("a unit of the active process");
        match what {
            "hang" => {
                let process = bed.machine.outer_main_pid(unit);
                cause(Fault::Hang, process, thread(process, None));
            }
            "TERM" => drop(bed.machine.run(&["systemctl", "restart", unit])),
            signal => drop(bed.machine.run(&["kill", "-s", signal, &active])),
        }
        let take_overs = take_overs.entry(name).or_insert(0);
        *take_overs += 1;
        let standby = support::wait_for(format!("take-over {take_overs} of {name}"), || {
            let standby = process(name)?["standby"].clone();
            (standby["take_overs"] == *take_overs).then_some(standby)
        });
        println!("{name}, {what}: taken over in {} ns", standby["took_ns"]);
        let cause = match what {
            "hang" => "hung",
            "STOP" => "stopped",
            "TERM" => "handed_over",
            _ => "ended",
        };
        assert_eq!(standby["cause"], cause, "{standby}");
        flow.wait_on();
    }
    assert_eq!(flow.critical.matches(), (1, 0));
    let (sent, received) = flow.end();
    assert_eq!((received.missing_count, received.received), (0, sent.ok), "{received:?}");
    bed.stop();
}

#[test]
fn a_restart_of_the_target_applies_the_edited_file_and_that_of_a_service_does_not() {
    let test = "a_restart_of_the_target_applies_the_edited_file_and_that_of_a_service_does_not";
    let Some(bed) = Bed::boot(test, SCAN) else { return };
    bed.start();
    let fingerprints = || -> Vec<String> {
        let status = bed.machine.try_status().unwrap_or_default();
        let processes = status["processes"].as_array().cloned().unwrap_or_default();
        let running = processes.iter().filter(|process| process["state"] == "running");
        running.filter_map(|process| process["settings_fingerprint"].as_str().map(str::to_owned)).collect()
    };
    // All four processes apply the same settings.
    let agreed = || -> Option<String> {
        let all = fingerprints();
        (all.len() == UNITS.len() && all.iter().all(|one| *one == all[0])).then(|| all[0].clone())
    };
    let mut in_force = support::wait_for("all processes to agree", agreed);
    for nice in [5, 6, 7] {
        let edited = format!("{SCAN}\nprocesses: {{control: {{scheduling: {{nice: {nice}}}}}}}\n");
        bed.machine.write(CONFIG, &edited);
        bed.machine.run(&["systemctl", "restart", EGRESS_CRITICAL]);
        bed.machine.wait_property(EGRESS_CRITICAL, "ActiveState", "active");
        assert_eq!(support::wait_for("all processes to agree", agreed), in_force);
        // A reload of which all waits leaves the unit active.
        // `systemctl reload` only sends SIGHUP: it can return before the process reports that it reloads.
        let reloads = || bed.machine.run(&["journalctl", "--unit", CONTROL]).matches(WAITS).count();
        let before = reloads();
        bed.machine.run(&["systemctl", "reload", CONTROL]);
        support::wait_until("the reload of control", || reloads() > before);
        bed.machine.wait_property(CONTROL, "ActiveState", "active");
        assert_eq!(bed.machine.property(CONTROL, "NRestarts"), "0");

        bed.machine.run(&["systemctl", "restart", TARGET]);
        in_force =
            support::wait_for("the edited file to be in force", || agreed().filter(|new| *new != in_force));
    }
    bed.stop();
}

#[test]
fn systemd_restarts_a_process_in_which_any_thread_hangs_or_ends() {
    let test = "systemd_restarts_a_process_in_which_any_thread_hangs_or_ends";
    let Some(bed) = Bed::boot(test, &format!("{SCAN}{NO_STANDBYS}")) else { return };
    bed.start();
    let flow = bed.flow();
    std::thread::scope(|scope| {
        for unit in UNITS {
            let bed = &bed;
            scope.spawn(move || {
                let mut restarts = 0;
                for fault in [Fault::Hang, Fault::End] {
                    for name in THREADS {
                        let process = bed.machine.outer_main_pid(unit);
                        cause(fault, process, thread(process, name));
                        restarts += 1;
                        bed.wait_restarts(unit, restarts);
                    }
                }
            });
        }
    });
    for unit in UNITS {
        let log = bed.machine.run(&["journalctl", "--unit", unit]);
        assert!(log.matches("Watchdog timeout").count() >= 2 * THREADS.len(), "{unit}: {log}");
    }
    flow.wait_on();
    flow.end();
    bed.stop();
}

#[test]
fn what_noncritical_lanes_may_take_is_limited_and_the_critical_one_flows() {
    let test = "what_noncritical_lanes_may_take_is_limited_and_the_critical_one_flows";
    let Some(bed) = Bed::boot_by(Machine::boot_with_limits, test, SCAN) else { return };
    let slice = "adaptive-bridge-noncritical.slice";
    bed.machine.run(&["mkdir", "-p", &format!("/etc/systemd/system/{slice}.d")]);
    let less = "[Slice]\nCPUQuota=20%\nMemoryHigh=infinity\nMemoryMax=128M\n";
    bed.machine.write(&format!("/etc/systemd/system/{slice}.d/90-less.conf"), less);
    bed.machine.run(&["systemctl", "daemon-reload"]);
    bed.start();
    let flow = bed.flow();
    // Starts a faulty program in the slice of the noncritical lanes.
    let start_faulty = |unit: &str, what: &str| {
        let unit = format!("--unit={unit}");
        bed.machine.run(&["systemd-run", &unit, &format!("--slice={slice}"), "sh", "-c", what]);
    };
    start_faulty("spins.service", "while :; do :; done");
    let ticks = || -> u64 {
        let stat =
            bed.machine.run(&["cat", &format!("/proc/{}/stat", bed.machine.main_pid("spins.service"))]);
        stat.split_whitespace().skip(13).take(2).map(|ticks| ticks.parse::<u64>().unwrap()).sum()
    };
    let (began, before) = (Instant::now(), ticks());
    flow.wait_critical(600);
    // Ticks are hundredths of a second.
    let share = (ticks() - before) as f64 / 100.0 / began.elapsed().as_secs_f64();
    println!("of one CPU, a lane that spins has {share:.2}");
    assert!(share < 0.3, "CPUQuota does not bite: {share}");
    bed.machine.run(&["systemctl", "stop", "spins.service"]);

    start_faulty("grows.service", "head -c 400M /dev/zero | tail");
    bed.machine.wait_property("grows.service", "ActiveState", "failed");
    // The shell's exit code for a program that SIGKILL ended: the kernel has no more memory for the slice.
    assert_eq!(bed.machine.property("grows.service", "ExecMainStatus"), "137");
    flow.wait_critical(50);
    for unit in [INGRESS, EGRESS_CRITICAL, CONTROL] {
        assert_eq!(bed.machine.property(unit, "NRestarts"), "0", "{unit}");
    }
    flow.end();
    bed.stop();
}

#[test]
fn the_limits_of_memory_of_a_configuration_are_in_force_and_samples_flow() {
    let test = "the_limits_of_memory_of_a_configuration_are_in_force_and_samples_flow";
    let Some(bed) = Bed::boot_by(Machine::boot_with_limits, test, SCAN) else { return };
    let doctor = || -> (Value, Value) {
        let output = bed.machine.try_run(&["adaptive-bridge", "doctor", "--json"]);
        let diagnosis: Value = serde_json::from_slice(&output.stdout).unwrap();
        let findings = diagnosis["findings"].as_array().unwrap();
        let found = findings.iter().find(|finding| finding["check"] == "memory limits");
        let found = found.unwrap_or_else(|| panic!("{diagnosis}"));
        (found["severity"].clone(), found["found"].clone())
    };
    let (severity, found) = doctor();
    assert!(severity == "note" && found.as_str().unwrap().contains(INGRESS), "{severity}: {found}");
    bed.machine.run(&["adaptive-bridge", "units", "--write"]);
    bed.machine.run(&["systemctl", "daemon-reload"]);
    bed.start();
    assert_eq!(doctor().0, "ok");
    let checked: Value =
        serde_json::from_str(&bed.machine.run(&["adaptive-bridge", "check", "--json"])).unwrap();
    let number = |unit: &str, property: &str| -> u64 {
        let value = bed.machine.property(unit, property);
        value.parse().unwrap_or_else(|_| panic!("{property} of {unit} is {value}"))
    };
    let flow = bed.flow();
    flow.wait_critical(600);
    let processes = ["ingress", "egress-critical", "egress-noncritical", "control"];
    for (unit, process) in UNITS.into_iter().zip(processes) {
        let memory = checked["memory"].as_array().unwrap();
        let expected = memory.iter().find(|memory| memory["process"] == process).unwrap();
        let limit = number(unit, "MemoryMax");
        assert_eq!(Some(limit), expected["limit_bytes"].as_u64(), "{unit}");
        // The memory that the kernel counts, including sockets and shared memory.
        let used = number(unit, "MemoryCurrent");
        println!("{unit}: {} of {} MiB", used >> 20, limit >> 20);
        assert!((1 << 20..limit).contains(&used), "{unit} uses {used} of {limit}");
        assert_eq!(bed.machine.property(unit, "NRestarts"), "0", "{unit}");
        // The kernel slows down a process above it.
        assert_eq!(bed.machine.property(unit, "MemoryHigh"), "infinity", "{unit}");
    }
    let slice_high = bed.machine.property("adaptive-bridge-noncritical.slice", "MemoryHigh");
    assert!(slice_high.parse::<u64>().is_ok(), "{slice_high}");
    // The kernel lets no process of a container have a lower score than the container.
    for (unit, score) in UNITS.into_iter().zip(["-800", "-800", "300", "0"]) {
        assert_eq!(bed.machine.property(unit, "OOMScoreAdjust"), score, "{unit}");
    }
    flow.end();
    bed.stop();
    // A file that needs more than the limits allow.
    bed.machine.write(CONFIG, &SCAN.replace("65536", "67108864"));
    let (severity, found) = doctor();
    assert!(severity == "warning" && found.as_str().unwrap().contains(INGRESS), "{severity}: {found}");
}

#[test]
fn a_process_that_finds_shared_memory_full_waits_for_room_and_the_others_go_on() {
    let test = "a_process_that_finds_shared_memory_full_waits_for_room_and_the_others_go_on";
    // The headers of 5,000 slots take 20 MiB.
    let config = SCAN.replace("max_sample_bytes: 65536", "max_sample_bytes: 65536, retained_samples: 1000");
    let Some(bed) = Bed::boot(test, &config) else { return };
    // Enough for everything except the pool of samples, which ingress creates.
    bed.machine.run(&["mount", "-t", "tmpfs", "-o", "size=4M,mode=1777", "tmpfs", "/dev/shm"]);
    bed.machine.run(&["systemctl", "start", "--no-block", TARGET]);
    support::wait_until("two restarts of ingress", || {
        bed.machine.property(INGRESS, "NRestarts").parse::<u32>().unwrap() >= 2
    });
    for unit in [EGRESS_CRITICAL, EGRESS_NONCRITICAL, CONTROL] {
        bed.machine.wait_property(unit, "ActiveState", "active");
        assert_eq!(bed.machine.property(unit, "NRestarts"), "0", "{unit}");
    }
    let log = bed.machine.run(&["journalctl", "--unit", INGRESS]);
    assert!(log.contains("/dev/shm"), "{log}");
    bed.machine.run(&["mount", "-o", "remount,size=64M", "/dev/shm"]);
    for unit in [INGRESS, STANDBYS[0]] {
        bed.machine.wait_property(unit, "ActiveState", "active");
    }
    let flow = bed.flow();
    flow.end();
    bed.stop();
}

#[test]
fn the_critical_lane_needs_nothing_that_is_not_critical() {
    let test = "the_critical_lane_needs_nothing_that_is_not_critical";
    let Some(bed) = Bed::boot(test, SCAN) else { return };
    bed.machine.run(&["systemctl", "mask", "--runtime", EGRESS_NONCRITICAL, CONTROL]);
    bed.machine.run(&["systemctl", "start", TARGET]);
    for unit in [INGRESS, EGRESS_CRITICAL] {
        bed.machine.wait_property(unit, "ActiveState", "active");
    }
    let critical = Peer::cyclone().subscriber().topic(CRITICAL).start_on(bed.net.host("critical"));
    let publisher =
        Peer::cyclone().publisher().topic(INPUT).wait_match(1).start_on(bed.net.host("publisher"));
    critical.wait_received(50);
    let sent: Sent = publisher.end();
    sent.assert_not_blocked();
    bed.machine.run(&["systemctl", "stop", TARGET]);
}

#[test]
fn a_bad_configuration_causes_no_restart_and_a_good_one_starts() {
    let test = "a_bad_configuration_causes_no_restart_and_a_good_one_starts";
    let Some(bed) = Bed::boot(test, "topics: nonsense\n") else { return };
    bed.machine.run(&["systemctl", "start", "--no-block", TARGET]);
    for unit in UNITS {
        bed.machine.wait_property(unit, "ActiveState", "failed");
        assert_eq!(bed.machine.property(unit, "ExecMainStatus"), "78", "{unit}");
        assert_eq!(bed.machine.property(unit, "NRestarts"), "0", "{unit}");
        let log = bed.machine.journal(unit);
        let says = |text: &str| {
            log.iter().any(|entry| entry["MESSAGE"].as_str().is_some_and(|message| message.contains(text)))
        };
        assert!(says("topics"), "{unit}: {log:?}");
    }
    bed.machine.write(CONFIG, SCAN);
    bed.start();
    bed.flow().end();
    bed.stop();
}

#[test]
fn systemd_shows_the_state_of_the_bridge_and_stop_leaves_no_files() {
    let test = "systemd_shows_the_state_of_the_bridge_and_stop_leaves_no_files";
    let yaml = "topics:\n  - {id: scan, input_topic: /scan, max_sample_bytes: 65536}\n";
    let Some(bed) = Bed::boot(test, yaml) else { return };
    bed.start();
    let says = |unit: &str, text: &str| {
        support::wait_until(format!("'{text}' in the status of {unit}"), || {
            bed.machine.property(unit, "StatusText").contains(text)
        });
    };
    says(INGRESS, "reading 0 of 1 routes, 0.0 samples/s; no publisher found yet for /scan");
    says(EGRESS_CRITICAL, "type not known yet for route scan");
    says(CONTROL, "safety mode normal");
    bed.machine.run(&["systemctl", "start", RESPONDER]);
    says(RESPONDER, "probes answered per s; 0 refused");
    bed.machine.run(&["systemctl", "stop", RESPONDER]);
    let flow = bed.flow();
    says(INGRESS, "reading 1 of 1 routes");
    says(EGRESS_CRITICAL, "mode normal; forwarding 1");
    says(EGRESS_NONCRITICAL, "superseded");

    // Structured fields, and a reload that is refused.
    let reading = |entry: &Value| {
        entry["BRIDGE_ROUTE"] == "scan"
            && entry["MESSAGE"].as_str().is_some_and(|text| text.starts_with("DDS reader created route=scan"))
    };
    let log = bed.machine.journal(INGRESS);
    assert!(log.iter().any(reading), "{log:?}");
    bed.machine.write(CONFIG, &format!("{yaml}nonsense: 1\n"));
    bed.machine.run(&["systemctl", "reload", INGRESS]);
    says(INGRESS, "the changed configuration file is bad and not in force; reading 1 of 1");
    bed.machine.write(CONFIG, yaml);
    bed.machine.run(&["systemctl", "reload", INGRESS]);
    support::wait_until("the end of the remark", || {
        bed.machine.property(INGRESS, "StatusText").starts_with("reading 1 of 1")
    });
    bed.machine.wait_property(INGRESS, "ActiveState", "active");
    assert_eq!(bed.machine.property(INGRESS, "NRestarts"), "0");
    flow.end();

    bed.stop();
    let up = ["--unit=whole", "--service-type=notify", "--uid=adaptive-bridge", "--property=WatchdogSec=5"];
    let up = [["systemd-run"].as_slice(), &up, &["adaptive-bridge", "up"]].concat();
    // `systemd-run` returns when the service has reported that it is ready.
    bed.machine.run(&up);
    says("whole.service", "6 of 6 processes; in scan 0.0/s; out critical (normal) 0.0/s");
    bed.machine.run(&["systemctl", "stop", "whole.service"]);
    let left = || bed.machine.run(&["sh", "-c", "ls /dev/shm /run/adaptive-bridge"]);
    assert!(!left().contains("ab1_") && !left().contains("default"), "{}", left());
}

#[test]
fn a_lane_of_the_users_own_runs_once_its_units_are_written() {
    let test = "a_lane_of_the_users_own_runs_once_its_units_are_written";
    let yaml = format!(
        "{SCAN}lanes: {{rviz: {{scheduling: {{cpus: [1]}}}}, critical: {{scheduling: {{cpus: [0]}}}}}}\n"
    );
    let Some(bed) = Bed::boot(test, &yaml) else { return };
    let doctor = |check: &str| {
        let output = bed.machine.try_run(&["adaptive-bridge", "doctor", "--json"]);
        let diagnosis: Value = serde_json::from_slice(&output.stdout).unwrap();
        let code = match diagnosis["severity"].as_str() {
            Some("ok" | "note") => 0,
            Some("warning") => 3,
            _ => 4,
        };
        assert_eq!(output.status.code(), Some(code), "{diagnosis}");
        let findings = diagnosis["findings"].as_array().unwrap();
        let found = findings.iter().find(|finding| finding["check"] == check);
        found.unwrap_or_else(|| panic!("{check} in {diagnosis}")).clone()
    };
    let units = doctor("units");
    assert_eq!(units["severity"], "warning", "{units}");
    let command = units["command"].as_str().unwrap().replace("sudo ", "");
    let written = bed.machine.run(&command.split(' ').collect::<Vec<_>>());
    assert!(written.contains("adaptive-bridge.target.d") && written.contains("daemon-reload"), "{written}");
    // FIFO by a capability: a container may not be allowed to raise the limit that the units use.
    let may =
        "[Service]\nCapabilityBoundingSet=CAP_SYS_NICE\nAmbientCapabilities=CAP_SYS_NICE\nPrivateUsers=no\n";
    bed.machine.run(&["mkdir", "-p", "/etc/systemd/system/adaptive-bridge-egress@critical.service.d"]);
    bed.machine.write("/etc/systemd/system/adaptive-bridge-egress@critical.service.d/90-nice.conf", may);
    bed.machine.run(&["systemctl", "daemon-reload"]);
    bed.start();
    assert_eq!(doctor("units")["severity"], "ok");
    assert_eq!(doctor("services")["severity"], "warning");
    bed.machine.run(&["systemctl", "enable", TARGET]);
    assert_eq!(doctor("services")["severity"], "ok");
    let rviz = "adaptive-bridge-egress@rviz.service";
    bed.machine.wait_property(rviz, "ActiveState", "active");
    let shown = |unit: &str, field: &str| {
        let path = format!("/proc/{}/status", bed.machine.main_pid(unit));
        let status = bed.machine.run(&["cat", &path]);
        let line = status.lines().find(|line| line.starts_with(field)).unwrap_or_default();
        line.split_whitespace().nth(1).unwrap_or_default().to_owned()
    };
    assert_eq!(shown(rviz, "Cpus_allowed_list:"), "1");
    assert_eq!(shown(EGRESS_CRITICAL, "Cpus_allowed_list:"), "0");
    for unit in UNITS.into_iter().chain([rviz]).filter(|unit| *unit != EGRESS_CRITICAL) {
        assert_eq!(shown(unit, "CapEff:"), "0000000000000000", "{unit}");
    }
    let scheduling = bed.machine.run(&["chrt", "-p", &bed.machine.main_pid(EGRESS_CRITICAL)]);
    assert!(scheduling.contains("SCHED_FIFO") && scheduling.contains("priority: 10"), "{scheduling}");
    let scheduling = bed.machine.run(&["chrt", "-p", &bed.machine.main_pid(rviz)]);
    assert!(scheduling.contains("SCHED_OTHER"), "{scheduling}");
    let nice_of = |unit: &str| {
        let stat = bed.machine.run(&["cat", &format!("/proc/{}/stat", bed.machine.main_pid(unit))]);
        // The name in brackets may have spaces; the nice value is the 17th field after it.
        let after_name = stat.rsplit_once(')').map(|(_, rest)| rest.to_owned()).unwrap_or_default();
        after_name.split_whitespace().nth(16).unwrap_or_default().to_owned()
    };
    assert_eq!(
        (nice_of(rviz), nice_of("adaptive-bridge-ingress.service")),
        ("10".to_owned(), "0".to_owned())
    );
    // Slices also work in units whose RestrictRealtime= allows only the fair scheduler. Linux grants them
    // since 6.12.
    let release = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap();
    let version: Vec<u32> = release.split('.').take(2).map(|number| number.parse().unwrap()).collect();
    if version >= vec![6, 12] {
        let slice_of = |unit: &str| -> u64 {
            let sched = bed.machine.run(&["cat", &format!("/proc/{}/sched", bed.machine.main_pid(unit))]);
            let line = sched.lines().find(|line| line.starts_with("se.slice")).unwrap();
            line.rsplit(' ').next().unwrap().parse().unwrap()
        };
        assert_eq!(slice_of("adaptive-bridge-ingress.service"), 100_000);
        assert_eq!(slice_of(rviz), 10_000_000);
    }

    let out = Peer::cyclone().best_effort().subscriber().topic("rt/adaptive_bridge/rviz/scan");
    let out = out.start_on(bed.net.host("slow"));
    let flow = bed.flow();
    out.wait_received(5);
    flow.end();
    bed.stop();
    bed.machine.wait_property(rviz, "ActiveState", "inactive");
    let written = bed.machine.run(&["adaptive-bridge", "units", "--write"]);
    assert_eq!(written, "the drop-ins already match the configuration\n");
}

/// Makes the package of the program under test, with that version.
fn package(version: &str) -> Result<PathBuf, String> {
    let source = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut command = Command::new(source.join("scripts/package.sh"));
    command.args(["--deb-version", version]).env("PROGRAM", support::bridge::program());
    let output = command.output().map_err(|error| error.to_string())?;
    let stderr = String::from_utf8_lossy(&output.stderr);
    match String::from_utf8_lossy(&output.stdout).lines().last() {
        Some(path) if output.status.success() => Ok(source.join(path)),
        _ => Err(stderr.into_owned()),
    }
}

#[test]
fn the_package_installs_upgrades_while_samples_flow_and_leaves_nothing() {
    let test = "the_package_installs_upgrades_while_samples_flow_and_leaves_nothing";
    let cargo_deb = Command::new("cargo").args(["deb", "--version"]).output();
    let no_cargo_deb = (!cargo_deb.is_ok_and(|output| output.status.success()))
        .then(|| "cargo-deb is not installed (make setup)".to_owned());
    if let Some(reason) = machine_missing().or(no_cargo_deb) {
        support::skip(test, &reason);
        return;
    }
    let net = Net::new(&["publisher", "bridge", "critical", "slow"]);
    let [old, new] = ["0.0.1-1", "0.0.2-1"].map(|version| package(version).unwrap());
    let contents = Command::new("dpkg-deb").arg("-c").arg(&new).output().unwrap();
    let contents = String::from_utf8(contents.stdout).unwrap();
    let help = Command::new(support::bridge::program()).arg("help").output().unwrap();
    let help = String::from_utf8(help.stdout).unwrap();
    let commands = help.lines().skip_while(|line| *line != "Commands:").skip(1);
    let commands = commands.take_while(|line| !line.is_empty()).filter_map(|line| line.strip_prefix("  "));
    // The further lines of a long description are indented more.
    let commands = commands.filter(|line| !line.starts_with(' '));
    let commands: Vec<&str> = commands.filter_map(|line| line.split_whitespace().next()).collect();
    assert!(commands.contains(&"egress"), "{help}");
    for command in commands.iter().filter(|command| **command != "help") {
        assert!(
            contents.contains(&format!("man1/adaptive-bridge-{command}.1.gz\n")),
            "{command}: {contents}"
        );
    }
    for (shell, completions) in [
        ("bash", "completions/adaptive-bridge"),
        ("fish", "adaptive-bridge.fish"),
        ("zsh", "_adaptive-bridge"),
    ] {
        assert!(contents.contains(&format!("{completions}\n")), "{completions}: {contents}");
        let made = Path::new(env!("CARGO_MANIFEST_DIR")).join("target/package/completions").join(shell);
        let made = fs::read_to_string(made).unwrap();
        for command in commands.iter().filter(|command| **command != "help") {
            assert!(made.contains(command), "{shell} does not complete {command}");
        }
    }

    let machine = Machine::boot(net.host("bridge"), &|root: &Path| {
        fs::copy(&old, root.join("old.deb")).unwrap();
        fs::copy(&new, root.join("new.deb")).unwrap();
    });
    let bed = Bed { machine, net };
    // Files in place of the kernel's limits, because the machine shares the kernel with its host.
    let limits = ["rmem_max", "wmem_max"].map(|name| format!("/proc/sys/net/core/{name}"));
    // Older kernels (before 6.11) show them only outside of network namespaces.
    let has_limits = bed.machine.try_run(&["test", "-e", &limits[0]]).status.success();
    for (path, value) in limits.iter().zip(["212992", "8388608"]).filter(|_| has_limits) {
        let file = format!("/run/{}", path.rsplit('/').next().unwrap());
        let script = format!("echo {value} >{file}; mount --bind {file} {path}");
        bed.machine.run(&["sh", "-c", &script]);
    }
    bed.machine.run(&["dpkg", "-i", "/old.deb"]);
    for (path, value) in limits.iter().zip(["4194304", "8388608"]).filter(|_| has_limits) {
        let set = bed.machine.run(&["cat", path]);
        assert_eq!(set.trim(), value, "{path}: a limit that is too low is raised, and none is lowered");
    }
    assert_eq!(bed.machine.property(TARGET, "ActiveState"), "inactive");
    bed.machine.write(CONFIG, &format!("{SCAN}{NO_STANDBYS}"));
    bed.machine.run(&["systemctl", "enable", "--now", TARGET]);
    bed.start();
    let flow = bed.flow();
    let pids = UNITS.map(|unit| bed.machine.main_pid(unit));
    bed.machine.run(&["dpkg", "-i", "/new.deb"]);
    for (unit, pid) in UNITS.iter().zip(&pids) {
        bed.machine.wait_property(unit, "ActiveState", "active");
        assert_ne!(bed.machine.main_pid(unit), *pid, "{unit} was not restarted");
        assert_eq!(bed.machine.property(unit, "NRestarts"), "0", "{unit}");
    }
    flow.wait_on();
    flow.end();

    // With standbys no subscriber notices an upgrade; the way back to the former package is one, too.
    bed.machine.write(CONFIG, SCAN);
    bed.machine.run(&["systemctl", "restart", TARGET]);
    let flow = bed.flow();
    let units = [&UNITS[..], &STANDBYS].concat();
    for unit in &units {
        bed.machine.wait_property(unit, "ActiveState", "active");
    }
    let pids: Vec<_> = units.iter().map(|unit| bed.machine.main_pid(unit)).collect();
    // A process leaves its identity once it has run for a second.
    flow.wait_critical(300);
    bed.machine.run(&["dpkg", "-i", "/old.deb"]);
    for (unit, pid) in units.iter().zip(&pids) {
        bed.machine.wait_property(unit, "ActiveState", "active");
        assert_ne!(bed.machine.main_pid(unit), *pid, "{unit} was not restarted");
    }
    flow.wait_on();
    assert_eq!(flow.critical.matches(), (1, 0));
    let (sent, received) = flow.end();
    assert_eq!((received.missing_count, received.received), (0, sent.ok), "{received:?}");

    bed.machine.run(&["dpkg", "-r", "adaptive-bridge"]);
    let processes = bed.machine.try_run(&["pgrep", "-u", "adaptive-bridge"]);
    assert!(processes.stdout.is_empty(), "processes are left: {processes:?}");
    bed.machine.run(&["dpkg", "-P", "adaptive-bridge"]);
    let find = "find /dev/shm /run /etc /usr/lib/systemd /usr/bin -name 'adaptive-bridge*' -o -name 'ab1_*'";
    assert_eq!(bed.machine.run(&["sh", "-c", find]), "");
    assert!(!bed.machine.try_run(&["id", "adaptive-bridge"]).status.success());
}
