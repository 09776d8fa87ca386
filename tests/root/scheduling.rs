//! The real-time priorities of the threads of a bridge: the shipped binary on the real kernel. Domain 115.

use std::fs;
use std::process::Command;
use std::time::Duration;

use adaptive_bridge::config::{self, DdsNetwork};
use adaptive_bridge::dds::{Participant, ParticipantOptions};
use adaptive_bridge::model::{Encapsulation, QosProfile, SourceTimestamp};
use adaptive_bridge::shm::{BridgeShape, ShmNode, Woken};
use bytes::Bytes;
use nix::libc;
use nix::sched::{CpuSet, sched_setaffinity};
use nix::unistd::Pid;
use support::bridge::Bridge;
use support::cpu_delay::two_cpus;
use support::process::Process;
use support::{exclusive, netns, skip, wait_for};

const DOMAIN_ID: u16 = 115;
const TYPE: &str = "std_msgs/msg/String";

/// Name and real-time priority of the main thread and of the DDS library's receiving and discovery threads.
/// The kernel cuts the names.
fn data_path(process: &Process) -> Vec<(String, u8)> {
    let pid = process.pid();
    let tasks = fs::read_dir(format!("/proc/{pid}/task")).unwrap();
    tasks
        .filter_map(|task| {
            let task = task.unwrap();
            // A thread may have ended since.
            let stat = fs::read_to_string(task.path().join("stat")).ok()?;
            let (before, after) = stat.rsplit_once(')')?;
            let name = before.split_once('(')?.1;
            let is_main = task.file_name().to_str() == Some(&pid.to_string());
            // proc_pid_stat(5): rt_priority is field 40, and the name field 2.
            let priority = after.split_whitespace().nth(37)?.parse().ok()?;
            let is_librarys = ["RustDDS Partici", "RustDDS discove"].contains(&name);
            (is_main || is_librarys).then(|| (name.to_owned(), priority))
        })
        .collect()
}

/// A thread that waits for one of lower priority on its CPU waits for ever, and the channels between the DDS
/// library's threads and ours do wait: `docs/decisions/0011-discovery-beside-samples.md`.
#[test]
fn the_threads_of_a_data_path_have_one_priority() {
    let test = "the_threads_of_a_data_path_have_one_priority";
    if let Some(reason) = netns::requires_root() {
        return skip(test, &reason);
    }
    let _exclusive = exclusive();
    let bridge = Bridge::new(
        "instance: {instance}\nros: {domain_id: 115}\nshared_memory: {root_path: {folder}/root}\n\
         topics: [{id: scan, input_topic: /scan, max_sample_bytes: 1024}]\n\
         processes: {ingress: {scheduling: {policy: fifo, priority: 30}}}\n\
         lanes: {critical: {scheduling: {policy: fifo, priority: 20}}, \
         noncritical: {scheduling: {policy: rr, priority: 1}}}\n",
    );
    let ingress = bridge.start("ingress");
    let critical = bridge.start("egress --lane critical");
    let noncritical = bridge.start("egress --lane noncritical");
    for (process, priority) in [(&ingress, 30), (&critical, 20), (&noncritical, 1)] {
        let threads = wait_for("the threads of a data path", || {
            Some(data_path(process)).filter(|threads| threads.len() == 3)
        });
        assert!(threads.iter().all(|thread| thread.1 == priority), "not all {priority}: {threads:?}");
    }
}

/// The locked memory of a process in KiB: `VmLck`, proc_pid_status(5).
fn locked_kib(process: &Process) -> u64 {
    let status = fs::read_to_string(format!("/proc/{}/status", process.pid())).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmLck:")).unwrap();
    line.split_whitespace().next().unwrap().parse().unwrap()
}

#[test]
fn a_process_locks_its_memory_if_that_is_configured() {
    let test = "a_process_locks_its_memory_if_that_is_configured";
    if let Some(reason) = netns::requires_root() {
        return skip(test, &reason);
    }
    let _exclusive = exclusive();
    let bridge = Bridge::new(
        "instance: {instance}\nros: {domain_id: 115}\nshared_memory: {root_path: {folder}/root}\n\
         topics: [{id: scan, input_topic: /scan, max_sample_bytes: 1024}]\n\
         lanes: {critical: {scheduling: {lock_memory: true}}}\n",
    );
    let critical = bridge.start("egress --lane critical");
    let noncritical = bridge.start("egress --lane noncritical");
    critical.wait_for_log("egress is up");
    noncritical.wait_for_log("egress is up");
    // The program alone has more than 1 MiB.
    assert!(locked_kib(&critical) > 1024, "{}", critical.log());
    assert_eq!(locked_kib(&noncritical), 0);
}

/// Policy, as proc_pid_stat(5) counts, and CPUs of the early waker, if it runs.
fn early_waker(ingress: &Process) -> Option<(u32, String)> {
    let tasks = fs::read_dir(format!("/proc/{}/task", ingress.pid())).unwrap();
    tasks.filter_map(Result::ok).find_map(|task| {
        let stat = fs::read_to_string(task.path().join("stat")).ok()?;
        let (before, after) = stat.rsplit_once(')')?;
        if before.split_once('(')?.1 != "early-waker" {
            return None;
        }
        let policy = after.split_whitespace().nth(38)?.parse().ok()?;
        let status = fs::read_to_string(task.path().join("status")).ok()?;
        let cpus = status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:"))?;
        Some((policy, cpus.trim().to_owned()))
    })
}

/// Ingress of a bridge with one critical lane, with the scheduling settings of each.
fn pinned(ingress: &str, lane: &str) -> (Bridge, Process) {
    let bridge = Bridge::new(&format!(
        "instance: {{instance}}\nros: {{domain_id: {DOMAIN_ID}}}\nshared_memory: {{root_path: {{folder}}/root}}\n\
         topics: [{{id: scan, input_topic: /scan, message_type: {TYPE}, max_sample_bytes: 1024}}]\n\
         processes: {{ingress: {{scheduling: {{{ingress}}}}}}}\nlanes: {{critical: {{scheduling: {{{lane}}}}}}}\n"
    ));
    let process = bridge.start("ingress");
    process.wait_for_log("ingress is up");
    (bridge, process)
}

/// Without CPUs of its own for each, ingress starts no early waker: `docs/decisions/0013-early-waker.md`.
#[test]
fn the_early_waker_runs_on_the_cpus_of_the_critical_lanes() {
    let Some([here, there]) = two_cpus() else {
        return skip("the_early_waker_runs_on_the_cpus_of_the_critical_lanes", "one CPU");
    };
    let _exclusive = exclusive();
    let (here, there) = (format!("cpus: [{here}]"), format!("cpus: [{there}]"));
    let (_bridge, mut ingress) = pinned(&here, &there);
    // The early waker sets its own policy and CPUs.
    wait_for("an early waker on the CPU of the lane with SCHED_BATCH", || {
        let (policy, cpus) = early_waker(&ingress)?;
        (policy == libc::SCHED_BATCH as u32 && there == format!("cpus: [{cpus}]")).then_some(())
    });
    assert!(ingress.terminate().success());
    for (of_ingress, of_lane) in [("", ""), (&here, ""), ("", &there), (&there, &there)] {
        let (_bridge, ingress) = pinned(of_ingress, of_lane);
        assert_eq!(early_waker(&ingress), None, "ingress {of_ingress:?}, lane {of_lane:?}");
    }
    // A CPU that does not exist.
    let (_bridge, mut ingress) = pinned(&here, "cpus: [1023]");
    ingress.wait_for_log("no early waker");
    wait_for("an end of the early waker", || early_waker(&ingress).is_none().then_some(()));
    assert!(ingress.terminate().success());
}

/// While a program of higher priority keeps ingress from receiving, only the early waker can wake a lane for
/// a sample.
#[test]
fn the_early_waker_wakes_a_lane_before_ingress_has_received_the_sample() {
    let test = "the_early_waker_wakes_a_lane_before_ingress_has_received_the_sample";
    let Some([here, there]) = two_cpus() else {
        return skip(test, "one CPU");
    };
    if let Some(reason) = netns::requires_root() {
        return skip(test, &reason);
    }
    let _exclusive = exclusive();
    let (bridge, ingress) = pinned(&format!("cpus: [{here}]"), &format!("cpus: [{there}]"));
    let settings = config::load(Some(&bridge.config()), &|_| None).unwrap();
    let root = settings.shared_memory.root_path.clone().unwrap();
    let node = ShmNode::open(&root, &settings.instance, "test").unwrap();
    let boards = node.boards(&BridgeShape::of(&settings)).unwrap();
    let published = || boards.ingress(0).unwrap().published;
    let network = DdsNetwork::of_domain(DOMAIN_ID);
    let (namespace, node_name) = ("/test".into(), "source".into());
    let options =
        ParticipantOptions { network: &network, namespace, node_name, graph_gid_bytes: 16, dscp: 0 };
    let mut source = Participant::open(&options).unwrap();
    let writer =
        source.create_writer("rt/scan", "std_msgs::msg::dds_::String_", &QosProfile::CRITICAL, 64).unwrap();
    let write = || {
        writer.write(Bytes::from(vec![7; 100]), Encapsulation::CDR_LE, SourceTimestamp(1)).unwrap();
    };
    wait_for("a sample that is published", || {
        write();
        (published() > 0).then_some(())
    });
    // This thread is the lane.
    let mut cpu = CpuSet::new();
    cpu.set(there).unwrap();
    sched_setaffinity(Pid::from_raw(0), &cpu).unwrap();
    let mut lane = boards.sleeper(0);
    let times = (0..10).filter(|_| {
        while lane.sleep(Duration::from_millis(100)) != Woken::TimedOut {}
        let before = published();
        let mut command = Command::new("chrt");
        command.args([
            "-f",
            "1",
            "taskset",
            "-c",
            &here.to_string(),
            "sh",
            "-c",
            "echo up; while :; do :; done",
        ]);
        let mut burner = Process::spawn("burner", command);
        burner.wait_for_line("a program that loads its CPU", 0, |line| (line == "up").then_some(()));
        write();
        let woken = lane.sleep(Duration::from_millis(200));
        let received = published() - before;
        burner.kill9();
        wait_for("the sample", || (published() > before).then_some(()));
        woken == Woken::Early && received == 0
    });
    // A datagram that is not a sample may have arrived just before it.
    assert!(times.count() > 5, "{}", ingress.log());
}
