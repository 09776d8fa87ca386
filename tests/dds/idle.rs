//! A bridge without samples costs little CPU time: its processes sleep.

use std::fs;
use std::thread::sleep;
use std::time::Duration;

use support::bridge::Bridge;

/// The most wake-ups of a process a second: each of its threads has timers with intervals of 50 ms or more.
/// An ingress that looked for publishers every 10 ms had 130.
const MAX_WAKE_UPS_PER_S: u64 = 80;

/// How often the threads of a process have gone to sleep.
fn wake_ups(pid: i32) -> u64 {
    let tasks = fs::read_dir(format!("/proc/{pid}/task")).unwrap().map(Result::unwrap);
    let of_task = |path: &str| -> Option<u64> {
        let status = fs::read_to_string(path).ok()?;
        let count = status.lines().find_map(|line| line.strip_prefix("voluntary_ctxt_switches:"))?;
        Some(count.trim().parse().unwrap())
    };
    tasks.filter_map(|task| of_task(&format!("{}/status", task.path().display()))).sum()
}

#[test]
fn processes_without_samples_sleep_also_while_topics_have_no_publisher() {
    let bridge = Bridge::new(
        "instance: {instance}\nros: {domain_id: 62}\nshared_memory: {root_path: {folder}/root}\n\
         topics:\n- {id: scan, input_topic: /scan}\n- {id: pose, input_topic: /pose}\n",
    );
    let processes = ["ingress", "egress --lane critical", "egress --lane noncritical", "control"]
        .map(|arguments| bridge.start(arguments));
    for (process, up) in processes.iter().zip(["ingress", "egress", "egress", "control"]) {
        process.wait_for_log(&format!("{up} is up"));
    }
    // The announcements of the first seconds.
    sleep(Duration::from_secs(5));
    let wake_ups = || processes.each_ref().map(|process| wake_ups(process.pid().as_raw()));
    let before = wake_ups();
    let seconds = 5;
    sleep(Duration::from_secs(seconds));
    for ((process, before), after) in processes.iter().zip(before).zip(wake_ups()) {
        let per_s = (after - before) / seconds;
        assert!(per_s > 0, "{} does not run", process.name());
        assert!(per_s <= MAX_WAKE_UPS_PER_S, "{} wakes {per_s} times a second", process.name());
    }
}
