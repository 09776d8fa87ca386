//! A thread of a bridge's process that hangs or ends: the supervisor restarts the process, whichever thread
//! it is. Uses real processes, whose threads are stopped and ended one by one.

#![cfg(all(target_os = "linux", target_arch = "x86_64"))]

use std::collections::BTreeSet;
use std::os::unix::net::UnixDatagram;
use std::process::Command;
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, SCAN};
use support::bridge::program;
use support::cpu_delay::two_cpus;
use support::netns::{Net, requires_root};
use support::peer::{Peer, Received, Sent};
use support::process::Process;
use support::threads::{Fault, THREADS, cause, others, resume, stop, thread};

const ROLES: [&str; 4] = ["ingress", "egress-critical", "egress-noncritical", "control"];

#[test]
fn up_restarts_a_process_in_which_any_thread_hangs_or_ends() {
    let test = "up_restarts_a_process_in_which_any_thread_hangs_or_ends";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let subscriber = bed.subscribe("critical", Peer::cyclone().keep_last(1000), CRITICAL);
    let publisher = bed.publish(Peer::cyclone().keep_last(1000).rate_hz(100.0), INPUT);
    subscriber.wait_received(100);
    std::thread::scope(|scope| {
        for role in ROLES {
            let bed = &bed;
            scope.spawn(move || {
                for fault in [Fault::Hang, Fault::End] {
                    for name in THREADS {
                        let (before, process) = (bed.pids(role).len(), bed.pid(role));
                        cause(fault, process, thread(process, name));
                        support::wait_until(
                            format!("a restart of {role} after {fault:?} of thread {name:?}"),
                            || bed.pids(role).len() == before + 1,
                        );
                        bed.bridge.wait_status(&format!("a turn of the new {role}"), |status| {
                            let processes = status["processes"].as_array().unwrap();
                            let is_turning = |one: &Value| {
                                one["state"] == "running"
                                    && one["turns"].as_u64().is_some_and(|turns| turns > 0)
                            };
                            processes.iter().any(|one| one["name"] == role && is_turning(one))
                        });
                    }
                }
            });
        }
    });
    subscriber.wait_received(subscriber.received() + 300);
    let _: Sent = publisher.end();
    let _: Received = subscriber.end();
    bed.end();
}

#[test]
fn samples_flow_while_every_other_thread_of_every_process_hangs() {
    let test = "samples_flow_while_every_other_thread_of_every_process_hangs";
    let Some([of_ingress, of_lane]) = two_cpus() else {
        return support::skip(test, "one CPU, so that ingress starts no early waker");
    };
    let metrics = "diagnostics: {metrics: '127.0.0.1:9464'}";
    let pinned = format!(
        "{SCAN}{metrics}\nprocesses: {{ingress: {{scheduling: {{cpus: [{of_ingress}]}}}}}}\n\
         lanes: {{critical: {{scheduling: {{cpus: [{of_lane}]}}}}}}\n"
    );
    let Some(bed) = Bed::start(test, &pinned) else { return };
    let subscriber = bed.subscribe("critical", Peer::cyclone().keep_all(), CRITICAL);
    let publisher = bed.publish(Peer::cyclone().keep_all().rate_hz(100.0), INPUT);
    subscriber.wait_received(100);
    let of_role = |role: &str| others(bed.pid(role));
    let threads: Vec<_> = ROLES.into_iter().flat_map(of_role).collect();
    let names: BTreeSet<&str> = threads.iter().map(|(_, name)| name.as_str()).collect();
    assert_eq!(names, BTreeSet::from(["early-waker", "log", "metrics", "parameters", "reload", "report"]));
    threads.iter().for_each(|(thread, _)| stop(*thread));
    // Longer than a process may be without progress.
    subscriber.wait_received(subscriber.received() + 1_000);
    threads.iter().for_each(|(thread, _)| resume(*thread));
    let sent: Sent = publisher.end();
    subscriber.wait_received(sent.ok);
    subscriber.end::<Received>().assert_all_of(&sent);
    bed.wait_accounted();
    for role in ROLES {
        assert_eq!(bed.pids(role).len(), 1, "{role} was restarted\n{}", bed.up.log());
    }
    bed.end();
}

#[test]
fn up_restarts_a_process_that_hangs_before_its_first_turn() {
    let test = "up_restarts_a_process_that_hangs_before_its_first_turn";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let role = "egress-noncritical";
    let is_noticed = (0..5).any(|_| {
        let starts = bed.pids(role).len();
        kill(Pid::from_raw(bed.pid(role)), Signal::SIGKILL).unwrap();
        support::wait_until("its restart", || bed.pids(role).len() == starts + 1);
        let process = bed.pid(role);
        cause(Fault::Hang, process, thread(process, None));
        support::wait_until("another restart", || bed.pids(role).len() == starts + 2);
        // On a busy machine the process may have had its first turn before this test stopped it.
        bed.up.log().contains("no first turn within 30000 ms")
    });
    assert!(is_noticed, "{}", bed.up.log());
    bed.end();
}

/// Without the watchdog, because it would kill the process before the test asks `up` to end.
#[test]
fn up_that_has_to_kill_a_process_at_its_end_fails_and_names_it() {
    let test = "up_that_has_to_kill_a_process_at_its_end_fails_and_names_it";
    let role = "ingress";
    // A busy machine may keep others from ending in time, too, but hardly three times in a row.
    for attempt in 1..=3 {
        let Some(bed) = Bed::start_without_watchdog(test, SCAN) else { return };
        let killed = end_while_it_hangs(bed, role);
        assert!(killed.iter().any(|name| name == role), "{killed:?}");
        if killed.len() == 1 {
            break;
        }
        assert!(attempt < 3, "{killed:?}");
    }
}

/// Ends a bridge in which the main thread of a process hangs; returns the names of the processes that `up`
/// killed.
fn end_while_it_hangs(mut bed: Bed, role: &str) -> Vec<String> {
    let process = bed.pid(role);
    std::thread::scope(|scope| {
        // A thread of the test traces the hanging one until its process is dead. `up` continues a process in
        // SIGSTOP, but not one that is traced.
        scope.spawn(|| cause(Fault::Hang, process, thread(process, None)));
        support::wait_until("a main thread that hangs", || {
            std::fs::read_to_string(format!("/proc/{process}/stat")).is_ok_and(|stat| stat.contains(") t "))
        });
        let status = bed.up.terminate();
        let log = bed.up.log();
        assert_eq!(status.code(), Some(1), "{log}");
        let killed = "did not end within 4500 ms of SIGTERM and were killed: ";
        let names = log.lines().find_map(|line| Some(line.split_once(killed)?.1));
        names.unwrap_or_else(|| panic!("{log}")).split(", ").map(str::to_owned).collect()
    })
}

/// Waits until the process that notifies this socket has fed its watchdog so many times.
fn wait_fed(socket: &UnixDatagram, times: usize) {
    for _ in 0..times {
        support::wait_until("a message to the watchdog", || is_fed(socket));
    }
}

/// Waits for the next notification, and returns whether it feeds the watchdog.
fn is_fed(socket: &UnixDatagram) -> bool {
    let mut message = [0; 1024];
    let length = socket.recv(&mut message).unwrap_or(0);
    message[..length].split(|byte| *byte == b'\n').any(|line| line == b"WATCHDOG=1")
}

/// Kills a process when it has not fed its watchdog for this time, as a service manager does, and returns
/// true. Kills it and returns false if it feeds the watchdog for longer than a test waits.
fn watch(socket: &UnixDatagram, process: i32, timeout: Duration) -> bool {
    let (begun, mut fed_at) = (Instant::now(), Instant::now());
    while fed_at.elapsed() < timeout && begun.elapsed() < support::patience() {
        if is_fed(socket) {
            fed_at = Instant::now();
        }
    }
    let is_starved = fed_at.elapsed() >= timeout;
    kill(Pid::from_raw(process), Signal::SIGKILL).unwrap();
    is_starved
}

/// The responder runs without a bridge, so that only the watchdog of systemd restarts it.
#[test]
fn a_responder_in_which_any_thread_hangs_or_ends_does_not_feed_its_watchdog() {
    let test = "a_responder_in_which_any_thread_hangs_or_ends_does_not_feed_its_watchdog";
    if let Some(reason) = requires_root() {
        return support::skip(test, &reason);
    }
    // `WatchdogSec` of its unit.
    let timeout = Duration::from_secs(5);
    let net = Net::new(&["laptop"]);
    let check = |fault: Fault, name: Option<&str>| {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("notify");
        let socket = UnixDatagram::bind(&path).unwrap();
        socket.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
        let mut command = net.host("laptop").command(program());
        command.args(["responder", "--id", "laptop"]).env_remove("ADAPTIVE_BRIDGE_CONFIG");
        command.env("NOTIFY_SOCKET", &path).env("WATCHDOG_USEC", timeout.as_micros().to_string());
        let responder = Process::spawn("responder", command);
        wait_fed(&socket, 3);
        let process = responder.pid().as_raw();
        std::thread::scope(|scope| {
            let watch = scope.spawn(|| watch(&socket, process, timeout));
            // Returns when the process is dead, or at once if its main thread has ended.
            cause(fault, process, thread(process, name));
            let is_starved = watch.join().unwrap();
            assert!(is_starved, "fed its watchdog after {fault:?} of thread {name:?}:\n{}", responder.log());
        });
    };
    std::thread::scope(|scope| {
        for fault in [Fault::Hang, Fault::End] {
            for name in THREADS {
                let check = &check;
                scope.spawn(move || check(fault, name));
            }
        }
    });
}

/// Turns off the grouping of processes by session, in which a busy process leaves others their share; until
/// it is dropped.
struct NoAutogroup(String);

const AUTOGROUP: &str = "/proc/sys/kernel/sched_autogroup_enabled";

impl NoAutogroup {
    fn set() -> Self {
        let before = std::fs::read_to_string(AUTOGROUP).unwrap_or_default();
        // A kernel without the file has no such groups.
        let _ = std::fs::write(AUTOGROUP, "0");
        Self(before)
    }
}

impl Drop for NoAutogroup {
    fn drop(&mut self) {
        let _ = std::fs::write(AUTOGROUP, &self.0);
    }
}

#[test]
fn up_does_not_kill_a_process_that_gets_no_cpu_time() {
    let test = "up_does_not_kill_a_process_that_gets_no_cpu_time";
    // A user namespace may neither raise a priority nor write the setting of the kernel.
    let owns_all = |map: String| map.split_whitespace().last() == Some("4294967295");
    if !std::fs::read_to_string("/proc/self/uid_map").is_ok_and(owns_all) {
        return support::skip(test, "needs root outside a user namespace");
    }
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let subscriber = bed.subscribe("critical", Peer::cyclone().keep_last(1000), CRITICAL);
    let publisher = bed.publish(Peer::cyclone().keep_last(1000).rate_hz(100.0), INPUT);
    subscriber.wait_received(100);
    let role = "egress-critical";
    let pid = bed.pid(role).to_string();
    let run = |program: &str, arguments: &[&str]| {
        let output = Command::new(program).args(arguments).output().unwrap();
        assert!(output.status.success(), "{program} {arguments:?}: {output:?}");
    };
    let turns = || {
        let status = bed.bridge.status();
        let processes = status["processes"].as_array().unwrap();
        processes.iter().find(|one| one["name"] == role).unwrap()["turns"].as_u64().unwrap()
    };
    {
        let _no_autogroup = NoAutogroup::set();
        run("taskset", &["-a", "-c", "-p", "0", &pid]);
        run("chrt", &["-a", "-i", "-p", "0", &pid]);
        let before = turns();
        // Four times as long as the supervisor waits for a turn of a critical lane.
        let busy = ["8", "nice", "-n", "-20", "taskset", "-c", "0", "sh", "-c", "while :; do :; done"];
        let ended = Command::new("timeout").args(busy).status().unwrap();
        assert_eq!(ended.code(), Some(124), "the busy program ended before its time");
        let during = turns() - before;
        // Without this, the lane was not starved, and the test shows nothing.
        assert!(during < 40, "the lane made {during} turns in 8 s");
        run("chrt", &["-a", "-o", "-p", "0", &pid]);
    }
    subscriber.wait_received(subscriber.received() + 100);
    assert_eq!(bed.pids(role).len(), 1, "{}", bed.up.log());
    let _: Sent = publisher.end();
    let _: Received = subscriber.end();
    bed.wait_accounted();
    bed.end();
}
