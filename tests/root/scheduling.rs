//! The real-time priorities of the threads of a bridge: the shipped binary on the real kernel. Domain 115.

use std::fs;

use support::bridge::Bridge;
use support::process::Process;
use support::{exclusive, netns, skip, wait_for};

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
