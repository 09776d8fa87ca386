//! Faults while samples flow: processes of the bridge that are stopped and killed, subscribers that stall,
//! links that break, shared memory that is full. Uses real processes, signals and DDS peers on separate
//! hosts.

use std::time::Duration;

use nix::sys::signal::Signal;
use nix::unistd::Pid;
use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, NO_STANDBYS, NONCRITICAL, SCAN, outputs};
use support::bridge::{Bridge, program};
use support::flow::lane;
use support::netns::Net;
use support::peer::{Peer, Received, RunningPeer, Sent};
use support::process::{Process, signal};

/// Samples that the publisher of a flow writes in a second.
const RATE_HZ: u32 = 200;

/// How often a process of the critical path is killed.
const KILLS: usize = 5;
/// A subscriber misses fewer samples for each kill: those of a second.
const MAX_MISSED_PER_KILL: u64 = RATE_HZ as u64;

/// A flow of [`RATE_HZ`] to a critical subscriber on a separate host.
struct Flow {
    publisher: RunningPeer,
    critical: RunningPeer,
}

impl Flow {
    fn start(bed: &Bed) -> Self {
        let critical = bed.subscribe("critical", Peer::fast().keep_all(), CRITICAL);
        // Not Fast DDS: 2.9.1 as Debian builds it aborts in an assertion of its statistics module
        // (OutputTrafficManager) when a reader, such as that of a restarted ingress, joins while it sends.
        let publisher = bed.publish(Peer::cyclone().keep_all().rate_hz(RATE_HZ.into()), INPUT);
        critical.wait_received(50);
        Self { publisher, critical }
    }

    /// Waits for some seconds and asserts that samples flow in that time, at a quarter of the rate at least:
    /// a fault that blocks the publisher for its duration costs nearly all of them, a busy machine a few.
    fn flow_for(&self, seconds: u64) {
        let before = self.critical.received();
        std::thread::sleep(Duration::from_secs(seconds));
        let received = self.critical.received() - before;
        let expected = seconds * u64::from(RATE_HZ);
        assert!(received >= expected / 4, "{received} of {expected} samples reached the critical subscriber");
    }

    /// Ends the flow. Asserts that the publisher was never blocked and that the critical subscriber received
    /// each sample once.
    fn end_whole(self) -> (Sent, Received) {
        let sent: Sent = self.publisher.end();
        self.critical.wait_received(sent.ok);
        let received: Received = self.critical.end();
        received.assert_all_of(&sent);
        sent.assert_not_blocked();
        (sent, received)
    }
}

/// The names of an instance's files in `/dev/shm`.
fn shared_memory_of(instance: &str) -> Vec<String> {
    let files = std::fs::read_dir("/dev/shm").unwrap();
    let names = files.filter_map(|file| file.ok()?.file_name().into_string().ok());
    names.filter(|name| name.contains(instance)).collect()
}

#[test]
fn a_noncritical_egress_stopped_for_ten_seconds_and_killed_five_times_costs_no_critical_sample() {
    let test = "a_noncritical_egress_stopped_for_ten_seconds_and_killed_five_times_costs_no_critical_sample";
    // It asserts the rate of the flow.
    let _alone = support::exclusive();
    let Some(bed) = Bed::start_without_watchdog(test, SCAN) else { return };
    let flow = Flow::start(&bed);
    let slow = bed.subscribe("slow", Peer::fast().best_effort(), NONCRITICAL);
    slow.wait_received(5);

    let stopped = bed.pid("egress-noncritical");
    signal(stopped, Signal::SIGSTOP);
    flow.flow_for(10);
    signal(stopped, Signal::SIGCONT);
    let before = slow.received();
    slow.wait_received(before + 5);

    for restarts in 1..=5 {
        signal(bed.pid("egress-noncritical"), Signal::SIGKILL);
        support::wait_until("a restart", || bed.pids("egress-noncritical").len() == restarts + 1);
        flow.flow_for(1);
    }
    slow.wait_received(slow.received() + 5);
    flow.end_whole();
    bed.wait_accounted();
    slow.end::<Received>().assert_sound();
    bed.end();
}

/// As when the terminal of `up` is paused, or was reached over a link that is down.
#[test]
fn samples_flow_and_a_process_is_restarted_while_nobody_reads_the_log() {
    let test = "samples_flow_and_a_process_is_restarted_while_nobody_reads_the_log";
    if let Some(reason) = support::testbed_missing() {
        return support::skip(test, &reason);
    }
    let net = Net::new(&["publisher", "bridge", "critical", "slow"]);
    let bridge = Bridge::new(&format!("instance: {{instance}}\n{SCAN}{NO_STANDBYS}"));
    let mut up = net.host("bridge").command(program());
    up.args(["up", "--config"]).arg(bridge.config()).envs([("NO_COLOR", "1"), ("RUST_LOG", "debug")]);
    let bed = Bed { up: Process::spawn("up", up), bridge, net };
    bed.wait_up();
    let flow = Flow::start(&bed);
    let unread = bed.up.leave_log_unread();
    flow.flow_for(5);
    let pid = |status: &Value| {
        let mut processes = status["processes"].as_array().unwrap().iter();
        processes.find(|one| one["name"] == "control" && one["state"] == "running")?["pid"].as_i64()
    };
    let before = pid(&bed.bridge.status()).unwrap();
    signal(i32::try_from(before).unwrap(), Signal::SIGKILL);
    bed.bridge.wait_status("another control", |status| pid(status).is_some_and(|now| now != before));
    flow.flow_for(1);
    drop(unread);
    bed.up.wait_for_log("lines of the log, because stderr was not read");
    flow.end_whole();
    bed.end();
}

#[test]
fn a_critical_egress_or_an_ingress_that_is_stopped_for_1_5_s_costs_no_sample() {
    let test = "a_critical_egress_or_an_ingress_that_is_stopped_for_1_5_s_costs_no_sample";
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let peers = [Peer::fast(), Peer::cyclone()];
    let subscribers = peers.map(|peer| bed.subscribe("critical", peer.keep_last(1000), CRITICAL));
    let publisher = bed.publish(Peer::cyclone().keep_last(1000).rate_hz(200.0), INPUT);
    let flow_on = || {
        for subscriber in &subscribers {
            subscriber.wait_received(subscriber.received() + 200);
        }
    };
    flow_on();
    for role in ["egress-critical", "ingress", "egress-critical", "ingress"] {
        let stopped = bed.pid(role);
        signal(stopped, Signal::SIGSTOP);
        // The watchdog restarts a process that is stopped for 2 s. 300 samples are published in this time:
        // the queue of the lane has room for 64 and the history of its writer for 256.
        std::thread::sleep(Duration::from_millis(1_500));
        signal(stopped, Signal::SIGCONT);
        flow_on();
        assert_eq!(bed.pid(role), stopped, "{role} was restarted");
    }
    let sent: Sent = publisher.end();
    sent.assert_not_blocked();
    for subscriber in subscribers {
        subscriber.wait_received(sent.ok);
        let received: Received = subscriber.end();
        received.assert_sound();
        assert_eq!((received.received, received.missing_count), (sent.ok, 0), "{received:?}");
    }
    bed.wait_accounted();
    bed.end();
}

#[test]
fn remote_subscribers_that_are_slow_stopped_or_disconnected_cost_no_critical_sample() {
    let test = "remote_subscribers_that_are_slow_stopped_or_disconnected_cost_no_critical_sample";
    // It asserts the rate of the flow.
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let flow = Flow::start(&bed);
    let reader = || Peer::cyclone().best_effort().keep_all();
    let stalling = bed.subscribe("slow", reader().stall(2.0, 1.5), NONCRITICAL);
    let stopped = bed.subscribe("slow", reader(), NONCRITICAL);
    stopped.wait_received(3);
    stopped.stop();
    flow.flow_for(4);
    bed.host("slow").lose_incoming(0.5);
    flow.flow_for(3);
    bed.host("slow").lose_incoming(0.0);
    bed.host("slow").set_link(false);
    flow.flow_for(3);
    bed.host("slow").set_link(true);
    stopped.cont();
    let before = stalling.received();
    stalling.wait_received(before + 5);
    flow.end_whole();
    bed.wait_accounted();
    bed.end();
}

#[test]
fn samples_flow_again_after_a_link_was_down_for_longer_than_the_lease() {
    let test = "samples_flow_again_after_a_link_was_down_for_longer_than_the_lease";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let subscribers = [
        bed.subscribe("slow", Peer::cyclone().best_effort(), NONCRITICAL),
        bed.subscribe("slow", Peer::fast().best_effort(), NONCRITICAL),
        bed.subscribe("slow", Peer::cyclone(), CRITICAL),
        bed.subscribe("slow", Peer::fast(), CRITICAL),
    ];
    let publisher = bed.publish(Peer::cyclone().rate_hz(100.0), INPUT);
    let all_receive = |what| {
        let before: Vec<u64> = subscribers.iter().map(RunningPeer::received).collect();
        support::wait_until(what, || {
            subscribers.iter().zip(&before).all(|(subscriber, before)| subscriber.received() > before + 5)
        });
    };
    all_receive("samples before");

    // First the link of the subscribers, then that of the publisher.
    let readers =
        |status: &Value| outputs(status).map(|output| output["readers"].as_u64()).sum::<Option<u64>>();
    bed.host("slow").set_link(false);
    bed.bridge.wait_status("no matched readers", |status| readers(status) == Some(0));
    bed.host("slow").set_link(true);
    all_receive("samples after the subscribers are back");

    let writers = |status: &Value| status["routes"][0]["writers"].as_u64();
    bed.host("publisher").set_link(false);
    bed.bridge.wait_status("no matched publisher", |status| writers(status) == Some(0));
    bed.host("publisher").set_link(true);
    all_receive("samples after the publisher is back");

    let _: Sent = publisher.end();
    for subscriber in subscribers {
        subscriber.end::<Received>().assert_sound();
    }
    bed.end();
}

#[test]
fn a_killed_critical_egress_is_restarted_and_counts_the_lost_samples() {
    let test = "a_killed_critical_egress_is_restarted_and_counts_the_lost_samples";
    // It asserts the rate of the flow.
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let flow = Flow::start(&bed);
    for restarts in 1..=KILLS {
        signal(bed.pid("egress-critical"), Signal::SIGKILL);
        support::wait_until("a restart", || bed.pids("egress-critical").len() == restarts + 1);
        let before = flow.critical.received();
        flow.critical.wait_received(before + 100);
    }
    let sent: Sent = flow.publisher.end();
    sent.assert_not_blocked();
    let status = bed.wait_accounted();
    let critical = lane(&status, "critical");
    let received: Received = flow.critical.end();
    received.assert_sound();
    // The subscriber received what the lane forwarded, and maybe samples that count as `no_reader` because
    // the lane wrote them before it matched the subscriber.
    let forwarded = critical["forwarded"].as_u64().unwrap();
    let dropped: u64 = critical["drops"].as_object().unwrap().values().filter_map(Value::as_u64).sum();
    assert_eq!(forwarded + dropped, sent.ok, "every sample is forwarded or has a drop reason: {critical}");
    let no_reader = critical["drops"]["no_reader"].as_u64().unwrap();
    // And one for each kill may have been written and not yet counted: it counts as `lane_down`.
    let uncounted = critical["drops"]["lane_down"].as_u64().unwrap().min(KILLS as u64);
    let possible = forwarded..=forwarded + no_reader + uncounted;
    assert!(possible.contains(&received.received), "{received:?} of {critical}");
    let max_missed = KILLS as u64 * MAX_MISSED_PER_KILL;
    assert!(received.missing_count < max_missed, "{received:?}");
    bed.end();
}

#[test]
fn a_killed_ingress_is_restarted_and_continues_its_counts() {
    let test = "a_killed_ingress_is_restarted_and_continues_its_counts";
    // It asserts the rate of the flow.
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let flow = Flow::start(&bed);
    for restarts in 1..=KILLS {
        signal(bed.pid("ingress"), Signal::SIGKILL);
        support::wait_until("a restart", || bed.pids("ingress").len() == restarts + 1);
        let before = flow.critical.received();
        flow.critical.wait_received(before + 100);
    }
    let sent: Sent = flow.publisher.end();
    let received: Received = flow.critical.end();
    received.assert_sound();
    assert!(received.missing_count < KILLS as u64 * MAX_MISSED_PER_KILL, "{received:?}");
    let status = bed.wait_accounted();
    let route = &status["routes"][0];
    assert_eq!(route["whole"], true, "{route}");
    // Sequence numbers continue across restarts. Samples that no ingress received are missing in `published`.
    let published = route["published"].as_u64().unwrap();
    let critical = lane(&status, "critical");
    assert!(published <= sent.ok, "{route}");
    assert!(critical["forwarded"].as_u64().unwrap() >= received.received, "{critical}");
    bed.end();
}

#[test]
fn a_publisher_on_fast_dds_does_not_wait_for_an_ingress_that_was_killed() {
    let test = "a_publisher_on_fast_dds_does_not_wait_for_an_ingress_that_was_killed";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let critical = bed.subscribe("critical", Peer::fast().keep_all(), CRITICAL);
    // 200 samples are 6.7 s, less than the 15 s lease of the killed ingress: a publisher that retains its
    // samples for that ingress until the lease ends has no room for more.
    let publisher = bed.publish(Peer::fast().keep_all().max_samples(200).rate_hz(30.0), INPUT);
    critical.wait_received(30);
    signal(bed.pid("ingress"), Signal::SIGKILL);
    support::wait_until("a restart", || bed.pids("ingress").len() == 2);
    let before = critical.received();
    critical.wait_received(before + 600);
    let sent: Sent = publisher.end();
    sent.assert_not_blocked();
    critical.end::<Received>().assert_sound();
    bed.end();
}

#[test]
fn a_bridge_whose_processes_were_killed_leaves_no_shared_memory() {
    let test = "a_bridge_whose_processes_were_killed_leaves_no_shared_memory";
    let Some(mut bed) = Bed::start(test, SCAN) else { return };
    let flow = Flow::start(&bed);
    let children: Vec<i32> =
        ["ingress", "egress-critical", "egress-noncritical"].iter().map(|child| bed.pid(child)).collect();
    assert!(!shared_memory_of(bed.bridge.instance()).is_empty());
    // Kills the supervisor first: its children must end by themselves.
    bed.up.kill9();
    support::wait_until("no orphans", || {
        children.iter().all(|child| nix::sys::signal::kill(Pid::from_raw(*child), None).is_err())
    });

    // The next bridge of the same instance removes the files of the previous one, forwards, and leaves no
    // files when it ends.
    bed.start_up_again();
    let before = flow.critical.received();
    flow.critical.wait_received(before + 100);
    for child in ["ingress", "egress-critical", "egress-noncritical"] {
        signal(bed.pid(child), Signal::SIGKILL);
    }
    let before = flow.critical.received();
    flow.critical.wait_received(before + 100);
    let status = bed.up.terminate();
    assert!(status.success(), "{status}\n{}", bed.up.log());
    assert_eq!(shared_memory_of(bed.bridge.instance()), Vec::<String>::new());
}

#[test]
fn a_stopped_critical_subscriber_costs_the_others_no_sample_and_its_overrun_is_counted() {
    let test = "a_stopped_critical_subscriber_costs_the_others_no_sample_and_its_overrun_is_counted";
    let yaml = format!("{SCAN}lanes:\n  critical: {{window_samples: 64}}\n");
    let Some(bed) = Bed::start(test, &yaml) else { return };
    let stopped = bed.subscribe("slow", Peer::cyclone().keep_all(), CRITICAL);
    let others = [
        bed.subscribe("critical", Peer::cyclone().keep_all(), CRITICAL),
        bed.subscribe("critical", Peer::fast().keep_all(), CRITICAL),
    ];
    let publisher = bed.publish(Peer::fast().keep_all().rate_hz(1_000.0), INPUT);
    stopped.wait_received(50);
    stopped.stop();
    // 18 MB: more than the stopped subscriber's socket holds.
    let before = others[0].received();
    others[0].wait_received(before + 6_000);
    // While it catches up, a sample that it has and has not acknowledged yet must not leave the history: that
    // would count as well.
    publisher.stop();
    stopped.cont();
    let all_acknowledged = |status: &Value| {
        let readers = lane(status, "critical")["matched_readers"].as_array().unwrap().clone();
        readers.len() == 3 && readers.iter().all(|reader| reader["unacknowledged"] == 0)
    };
    bed.bridge.wait_status("all acknowledged", all_acknowledged);
    publisher.cont();
    let before = stopped.received();
    stopped.wait_received(before + 100);
    bed.up.wait_for_log("a subscriber does not keep up");
    let sent: Sent = publisher.end();
    sent.assert_not_blocked();
    bed.wait_accounted();
    let status = bed.bridge.wait_status("all acknowledged", all_acknowledged);
    let critical = lane(&status, "critical");
    assert_eq!(critical["forwarded"], sent.ok, "{critical}");
    for other in others {
        other.end::<Received>().assert_all_of(&sent);
    }
    let received: Received = stopped.end();
    received.assert_sound();
    let overruns: Vec<u64> = critical["matched_readers"]
        .as_array()
        .unwrap()
        .iter()
        .map(|reader| reader["overrun"].as_u64().unwrap())
        .filter(|overrun| *overrun > 0)
        .collect();
    assert_eq!(overruns, [received.missing_count], "{critical}\n{received:?}");
    assert_eq!(critical["reader_overrun"], received.missing_count, "{critical}");
    bed.end();
}

#[test]
fn killed_critical_subscribers_cost_the_others_no_sample() {
    let test = "killed_critical_subscribers_cost_the_others_no_sample";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let other = bed.subscribe("critical", Peer::cyclone().keep_all(), CRITICAL);
    let victims = [
        bed.subscribe("slow", Peer::cyclone().keep_all(), CRITICAL),
        bed.subscribe("slow", Peer::fast().keep_all(), CRITICAL),
        bed.subscribe("critical", Peer::fast(), CRITICAL),
    ];
    let publisher = bed.publish(Peer::cyclone().keep_all().rate_hz(500.0), INPUT);
    for victim in &victims {
        victim.wait_received(100);
    }
    for mut victim in victims {
        victim.kill9();
    }
    // More than the 256 samples that the writer retains, sent before the leases of 10 and 20 s end.
    let before = other.received();
    other.wait_received(before + 3_000);
    let sent: Sent = publisher.end();
    sent.assert_not_blocked();
    let status = bed.wait_accounted();
    assert_eq!(lane(&status, "critical")["forwarded"], sent.ok, "{status}");
    other.end::<Received>().assert_all_of(&sent);
    bed.end();
}

#[test]
fn manual_modes_take_effect_and_rates_are_kept() {
    let test = "manual_modes_take_effect_and_rates_are_kept";
    // It asserts the rate of the flow.
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let flow = Flow::start(&bed);
    let slow = bed.subscribe("slow", Peer::cyclone().best_effort(), NONCRITICAL);
    slow.wait_received(5);
    let set = |mode: &str| {
        let output = bed.bridge.run(&format!("mode noncritical {mode}"));
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        bed.bridge.wait_status(mode, |status| {
            let lanes = status["lanes"].as_array().unwrap();
            lanes.iter().any(|lane| lane["name"] == "noncritical" && lane["applied_mode"] == mode)
        });
    };
    // Over 20 s within 1 % of the target rate, plus two samples for the ends of the interval.
    for (mode, rate_hz) in [("normal", 10.0), ("degraded", 3.0)] {
        set(mode);
        let forwarded = || lane(&bed.bridge.status(), "noncritical")["forwarded"].as_u64().unwrap();
        let began = std::time::Instant::now();
        let before = forwarded();
        std::thread::sleep(Duration::from_secs(20));
        let sent = (forwarded() - before) as f64;
        let expected = rate_hz * began.elapsed().as_secs_f64();
        assert!((sent - expected).abs() <= expected * 0.01 + 2.0, "{mode}: {sent} of {expected}");
    }
    set("suspended");
    let before = slow.received();
    flow.flow_for(2);
    assert!(slow.received() <= before + 1, "a suspended lane forwards nothing");
    set("normal");
    slow.wait_received(before + 10);
    let refused = bed.bridge.run("mode nosuch normal");
    assert_eq!(refused.status.code(), Some(1));
    assert!(String::from_utf8_lossy(&refused.stderr).contains("critical, noncritical"));
    flow.end_whole();
    bed.wait_accounted();
    bed.end();
}

#[test]
fn two_bridges_run_side_by_side_and_the_end_of_one_does_not_affect_the_other() {
    let test = "two_bridges_run_side_by_side_and_the_end_of_one_does_not_affect_the_other";
    // It asserts the rate of the flow.
    let _alone = support::exclusive();
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let flow = Flow::start(&bed);
    let other = Bridge::new(&format!(
        "instance: {{instance}}\n{}",
        SCAN.replace(
            "input_topic: /scan",
            "input_topic: /scan, critical_output: /other/scan, noncritical_output: /other/slow"
        )
    ));
    let mut other_up = other.start_on(bed.host("bridge"), "up");
    other_up.wait_for_log("ingress is up");
    let second = Peer::cyclone().subscriber().topic("rt/other/scan").start_on(bed.host("critical"));
    second.wait_received(100);
    second.end::<Received>().assert_sound();
    assert!(other_up.terminate().success(), "{}", other_up.log());
    assert_eq!(shared_memory_of(other.instance()), Vec::<String>::new());
    flow.flow_for(1);
    // The files of the first bridge are still there: the next process of a lane needs them.
    signal(bed.pid("egress-noncritical"), Signal::SIGKILL);
    support::wait_until("a restart", || bed.pids("egress-noncritical").len() == 2);
    bed.bridge.wait_status("the restarted lane", |status| {
        let mut processes = status["processes"].as_array().into_iter().flatten();
        processes
            .any(|one| one["name"] == "egress-noncritical" && one["starts"] == 2 && one["state"] == "running")
    });
    flow.end_whole();
    bed.end();
}

/// Waits until a role ends by itself; returns its exit code and log.
fn wait_ended(mut process: Process) -> (Option<i32>, String) {
    let status = process.wait();
    (status.code(), process.log())
}

#[test]
fn a_second_egress_of_a_lane_is_refused_and_names_the_first() {
    let bridge =
        Bridge::new(&format!("instance: {{instance}}\nros: {{domain_id: 120}}\n{SCAN}{NO_STANDBYS}"));
    let mut first = bridge.start("egress --lane critical");
    first.wait_for_log("egress is up");
    let (code, log) = wait_ended(bridge.start("egress --lane critical"));
    assert_eq!(code, Some(1), "{log}");
    assert!(log.contains("egress-critical") && log.contains(&first.pid().to_string()), "{log}");
    let (code, log) = wait_ended(bridge.start("egress --lane nosuch"));
    assert_eq!(code, Some(1), "{log}");
    assert!(log.contains("nosuch") && log.contains("critical, noncritical"), "{log}");
    first.kill9();
    let mut again = bridge.start("egress --lane critical");
    again.wait_for_log("egress is up");
    assert!(again.terminate().success(), "{}", again.log());
}

#[test]
fn pools_that_do_not_fit_are_an_error_with_the_needed_size() {
    // More than 4,096 slots, of which the headers take 4 KiB each.
    let yaml = "instance: {instance}\nros: {domain_id: 121}\ntopics:\n  - {id: scan, input_topic: /scan, \
                max_sample_bytes: 67108864}\nlanes:\n  critical: {queue_depth: 4096}\n\
                shared_memory: {budget_bytes: 1048576}\n";
    let bridge = Bridge::new(yaml);
    let (code, log) = wait_ended(bridge.start("ingress"));
    assert_eq!(code, Some(78), "{log}");
    assert!(log.contains("shared_memory.budget_bytes must be at least"), "{log}");
    assert_eq!(shared_memory_of(bridge.instance()), Vec::<String>::new());
}

#[test]
fn every_role_ends_with_exit_code_0_after_sigterm_and_sigint() {
    let bridge = Bridge::new(&format!("instance: {{instance}}\nros: {{domain_id: 122}}\n{SCAN}"));
    for (role, up) in
        [("ingress", "ingress is up"), ("egress --lane noncritical", "egress is up"), ("up", "ingress is up")]
    {
        for signal in [Signal::SIGTERM, Signal::SIGINT] {
            let mut process = bridge.start(role);
            process.wait_for_log(up);
            process.signal(signal);
            let status = process.wait();
            assert!(status.success(), "{role} after {signal}: {status}\n{}", process.log());
        }
    }
    assert_eq!(shared_memory_of(bridge.instance()), Vec::<String>::new());
}
