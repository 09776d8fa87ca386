//! Which thread of a bridge has which real-time priority: the shipped binary on the real kernel. Domain 115.

mod support;

use std::fs;

use nix::libc;
use support::bridge::Bridge;
use support::process::Process;
use support::{netns, skip, wait_for};

/// Name and real-time priority of the main thread, and of the DDS library's: what receives, and discovery,
/// with names as the kernel cuts them.
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

/// Policy, as proc_pid_stat(5) counts, and CPUs of the thread that gets critical lanes up, if there is one.
fn lookout(ingress: &Process) -> Option<(u32, String)> {
    let tasks = fs::read_dir(format!("/proc/{}/task", ingress.pid())).unwrap();
    tasks.filter_map(Result::ok).find_map(|task| {
        let stat = fs::read_to_string(task.path().join("stat")).ok()?;
        let (before, after) = stat.rsplit_once(')')?;
        if before.split_once('(')?.1 != "lookout" {
            return None;
        }
        let policy = after.split_whitespace().nth(38)?.parse().ok()?;
        let status = fs::read_to_string(task.path().join("status")).ok()?;
        let cpus = status.lines().find_map(|line| line.strip_prefix("Cpus_allowed_list:"))?;
        Some((policy, cpus.trim().to_owned()))
    })
}

/// Where a lane could get in the way of ingress nobody gets it up: `docs/decisions/0013-lookout.md`.
#[test]
fn the_lookout_is_where_the_critical_lane_is() {
    let test = "the_lookout_is_where_the_critical_lane_is";
    if std::thread::available_parallelism().is_ok_and(|cpus| cpus.get() < 2) {
        return skip(test, "one CPU");
    }
    let ingress_with = |ingress: &str, lane: &str| {
        let bridge = Bridge::new(&format!(
            "instance: {{instance}}\nros: {{domain_id: 115}}\nshared_memory: {{root_path: {{folder}}/root}}\n\
             topics: [{{id: scan, input_topic: /scan, max_sample_bytes: 1024}}]\n\
             processes: {{ingress: {{scheduling: {{{ingress}}}}}}}\nlanes: {{critical: {{scheduling: {{{lane}}}}}}}\n"
        ));
        let process = bridge.start("ingress");
        process.wait_for_log("ingress is up");
        (bridge, process)
    };
    let (_bridge, mut ingress) = ingress_with("cpus: [0]", "cpus: [1]");
    // It sets what it runs as by itself.
    wait_for("a lookout that runs on CPU 1 when nothing else does", || {
        lookout(&ingress).filter(|lookout| *lookout == (libc::SCHED_BATCH as u32, "1".to_owned()))
    });
    assert!(ingress.terminate().success());
    for (of_ingress, of_lane) in
        [("", ""), ("cpus: [0]", ""), ("", "cpus: [1]"), ("cpus: [0, 1]", "cpus: [1]")]
    {
        let (_bridge, ingress) = ingress_with(of_ingress, of_lane);
        assert_eq!(lookout(&ingress), None, "ingress {of_ingress:?}, lane {of_lane:?}");
    }
}
