//! Checks of resource limits and rights, scheduling, CPUs, idle states and the clock source.

use std::fs;
use std::path::Path;

use nix::sys::resource::{Resource, getrlimit};
use nix::unistd::geteuid;

use super::{Finding, Severity, list, number};
use crate::config::{Scheduling, SchedulingPolicy, Settings};

/// Open files that a process with some hundred routes needs: sockets, shared memory, pipes.
const OPEN_FILES: u64 = 1024;

/// Exit latency of an idle state that is negligible beside the wake-up of a thread, which takes about as
/// long.
const NEGLIGIBLE_EXIT_US: i64 = 10;

/// Bit of CAP_IPC_LOCK in `CapEff` (capabilities(7)).
const CAP_IPC_LOCK: u32 = 14;
const CAP_SYS_NICE: u32 = 23;

pub(super) fn check(settings: &Settings) -> Vec<Finding> {
    let limit = |resource| getrlimit(resource).map_or(0, |(soft, _)| soft);
    let capabilities = capabilities();
    let rights = Rights {
        nice: capabilities & (1 << CAP_SYS_NICE) != 0,
        lock: capabilities & (1 << CAP_IPC_LOCK) != 0,
        rtprio: limit(Resource::RLIMIT_RTPRIO),
        memlock: limit(Resource::RLIMIT_MEMLOCK),
    };
    let configured: Vec<&Scheduling> = settings
        .lanes
        .iter()
        .map(|lane| &lane.scheduling)
        .chain([&settings.ingress_scheduling, &settings.control_scheduling])
        .collect();
    let mut findings = vec![
        open_files(limit(Resource::RLIMIT_NOFILE)),
        real_time(&configured, &rights),
        memory_lock(&configured, &rights),
    ];
    // The CPUs of the machine, not only those in the affinity mask of this process.
    let online = fs::read_to_string("/sys/devices/system/cpu/online").ok();
    findings.extend(online.map(|online| cpus(&configured, online.trim())));
    findings.extend(number("/proc/sys/kernel/sched_rt_runtime_us").map(throttling));
    findings.extend(idle_states(Path::new("/sys/devices/system/cpu")));
    let source = "/sys/devices/system/clocksource/clocksource0";
    let read = |name: &str| fs::read_to_string(format!("{source}/{name}")).ok();
    if let (Some(current), Some(available)) = (read("current_clocksource"), read("available_clocksource")) {
        findings.push(clock_source(current.trim(), available.trim()));
    }
    findings
}

/// The rights of this process to real-time scheduling and locked memory. The systemd services have their own.
struct Rights {
    nice: bool,
    lock: bool,
    rtprio: u64,
    memlock: u64,
}

fn capabilities() -> u64 {
    let status = fs::read_to_string("/proc/self/status").unwrap_or_default();
    let effective = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
    effective.and_then(|text| u64::from_str_radix(text.trim(), 16).ok()).unwrap_or(0)
}

fn open_files(limit: u64) -> Finding {
    let found = format!("a process may open {limit} files");
    if limit >= OPEN_FILES {
        return Finding::ok("open files", found);
    }
    Finding::warning("open files", found)
        .means("Too few for many routes.")
        .with_command(format!("ulimit -n {OPEN_FILES}"))
}

/// The command that adds a line for this user to limits.conf(5).
fn limits_line(item: &str, value: &str) -> String {
    let user = match geteuid() {
        uid if uid.is_root() => "root".to_owned(),
        uid => nix::unistd::User::from_uid(uid).ok().flatten().map_or(uid.to_string(), |user| user.name),
    };
    format!(
        "echo '{user} - {item} {value}' | sudo tee -a \
         /etc/security/limits.d/60-adaptive-bridge.conf # then log in again"
    )
}

fn real_time(configured: &[&Scheduling], rights: &Rights) -> Finding {
    let check = "real time";
    let real_time = configured.iter().filter(|scheduling| scheduling.policy != SchedulingPolicy::Other);
    match real_time.map(|scheduling| u64::from(scheduling.priority)).max() {
        None => Finding::ok(check, "no real-time policy is configured"),
        Some(priority) if rights.nice || rights.rtprio >= priority => {
            Finding::ok(check, format!("priority {priority} is allowed"))
        }
        Some(priority) => {
            let found =
                format!("priority {priority} is configured, and this user is allowed {}", rights.rtprio);
            Finding::warning(check, found).means(
                "Processes that this user starts run without a real-time policy. The installed services are \
                 allowed 50.",
            )
            .with_command(limits_line("rtprio", &priority.to_string()))
        }
    }
}

fn memory_lock(configured: &[&Scheduling], rights: &Rights) -> Finding {
    let check = "memory lock";
    if !configured.iter().any(|scheduling| scheduling.lock_memory) {
        return Finding::ok(check, "not configured");
    }
    if rights.lock || rights.memlock == u64::MAX {
        return Finding::ok(check, "is allowed");
    }
    let found = format!("lock_memory is configured, and this user may lock {} KiB", rights.memlock / 1024);
    Finding::warning(check, found)
        .means(
            "Page faults may delay processes that this user starts. The installed critical services may lock \
             memory.",
        )
        .with_command(limits_line("memlock", "unlimited"))
}

/// Checks that the configured CPUs exist. `online` is the kernel's list of CPUs, such as `0-3,8`.
fn cpus(configured: &[&Scheduling], online: &str) -> Finding {
    let is_online = |cpu: usize| {
        online.split(',').any(|range| {
            let (first, last) = range.split_once('-').unwrap_or((range, range));
            let bound = |text: &str| text.parse::<usize>().ok();
            bound(first).is_some_and(|first| first <= cpu) && bound(last).is_some_and(|last| cpu <= last)
        })
    };
    let mut missing: Vec<usize> =
        configured.iter().flat_map(|scheduling| scheduling.cpus.iter().copied()).collect();
    missing.retain(|&cpu| !is_online(cpu));
    missing.sort_unstable();
    missing.dedup();
    if missing.is_empty() {
        return Finding::ok("CPUs", format!("{online} are online"));
    }
    Finding::warning("CPUs", format!("CPUs {} are configured, and only {online} are online", list(missing)))
        .means("A process whose configured CPUs are all offline runs on every CPU.")
}

fn throttling(runtime_us: i64) -> Finding {
    let check = "real-time runtime";
    match runtime_us {
        0 => Finding::warning(check, "kernel.sched_rt_runtime_us is 0")
            .means("No process may have a real-time policy.")
            .with_command("sudo sysctl -w kernel.sched_rt_runtime_us=950000"),
        runtime_us if runtime_us < 0 => Finding::note(check, "kernel.sched_rt_runtime_us is -1").means(
            "A real-time process in an endless loop blocks its CPU; LimitRTTIME of the services prevents \
             that.",
        ),
        runtime_us => Finding::ok(check, format!("{runtime_us} us of each second")),
    }
}

/// The enabled idle state with the highest exit latency of all CPUs, and that latency in µs (cpuidle in
/// sysfs).
fn deepest_idle_state(cpus: &Path) -> Option<(String, i64)> {
    let entries = |directory: &Path| fs::read_dir(directory).into_iter().flatten().flatten();
    let states = entries(cpus).flat_map(|cpu| entries(&cpu.path().join("cpuidle")));
    let enabled = states.filter_map(|state| {
        let read = |name: &str| fs::read_to_string(state.path().join(name)).ok();
        let latency_us = read("latency")?.trim().parse().ok()?;
        (read("disable")?.trim() == "0").then_some((read("name")?.trim().to_owned(), latency_us))
    });
    enabled.max_by_key(|(_, latency_us)| *latency_us)
}

/// Checks how long an idle CPU takes to wake up; `None` where the kernel has no cpuidle.
fn idle_states(cpus: &Path) -> Option<Finding> {
    let (name, latency_us) = deepest_idle_state(cpus)?;
    let driver = fs::read_to_string(cpus.join("cpuidle/current_driver")).unwrap_or_default();
    let found = match driver.trim() {
        // The driver of a virtual machine. It reports 1 us; the hypervisor takes 40 to 70.
        "haltpoll" => {
            "idle CPUs of this virtual machine halt in the hypervisor; a wake-up takes tens of us".to_owned()
        }
        _ => format!("{name}, the deepest idle state, has an exit latency of {latency_us} us"),
    };
    if latency_us <= NEGLIGIBLE_EXIT_US && driver.trim() != "haltpoll" {
        return Some(Finding::ok("idle CPUs", found));
    }
    let meaning =
        "At low rates, when CPUs go idle between samples, a sample waits for up to three such wake-ups.";
    let command = "sudo sh -c 'exec 3>/dev/cpu_dma_latency && echo 0 >&3 && exec sleep infinity' \
                   # keeps CPUs awake while it runs; draws more power";
    Some(Finding::note("idle CPUs", found).means(meaning).with_command(command))
}

fn clock_source(current: &str, available: &str) -> Finding {
    let check = "clock source";
    // These are read in user space within nanoseconds; others need a system call or a slow device access.
    const FAST: [&str; 4] = ["tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page"];
    if FAST.contains(&current) {
        return Finding::ok(check, current);
    }
    let better = FAST.into_iter().find(|fast| available.split_whitespace().any(|name| name == *fast));
    let severity = if better.is_some() { Severity::Warning } else { Severity::Note };
    let finding = Finding::new(check, severity, current)
        .means("Each reading of the clock takes microseconds, and each sample needs several readings.");
    match better {
        Some(better) => finding.with_command(format!(
            "echo {better} | sudo tee /sys/devices/system/clocksource/clocksource0/current_clocksource"
        )),
        None => finding,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NONE: Rights = Rights { nice: false, lock: false, rtprio: 0, memlock: 65_536 };

    #[test]
    fn configured_scheduling_must_be_allowed_and_its_cpus_online() {
        let plain = Scheduling::default();
        let fifo = Scheduling {
            policy: SchedulingPolicy::Fifo,
            priority: 20,
            lock_memory: true,
            cpus: vec![3],
            ..Scheduling::default()
        };
        assert_eq!(real_time(&[&plain], &NONE).severity, Severity::Ok);
        assert_eq!(memory_lock(&[&plain], &NONE).severity, Severity::Ok);
        let refused = real_time(&[&plain, &fifo], &NONE);
        assert!(refused.severity == Severity::Warning && refused.command.unwrap().contains("rtprio 20"));
        assert_eq!(memory_lock(&[&fifo], &NONE).severity, Severity::Warning);
        let all = Rights { rtprio: 20, memlock: u64::MAX, ..NONE };
        assert_eq!(real_time(&[&fifo], &all).severity, Severity::Ok);
        assert_eq!(memory_lock(&[&fifo], &all).severity, Severity::Ok);
        assert_eq!(real_time(&[&fifo], &Rights { nice: true, ..NONE }).severity, Severity::Ok);
        for (online, severity) in [
            ("0-3", Severity::Ok),
            ("0,3", Severity::Ok),
            ("0-2", Severity::Warning),
            ("0-2,4-7", Severity::Warning),
        ] {
            assert_eq!(cpus(&[&fifo], online).severity, severity, "{online}");
        }
    }

    #[test]
    fn limits_and_clocks_are_judged() {
        assert_eq!(open_files(1024).severity, Severity::Ok);
        assert_eq!(open_files(256).severity, Severity::Warning);
        assert!(open_files(256).command.unwrap().contains("ulimit -n 1024"));
        assert_eq!(throttling(950_000).severity, Severity::Ok);
        assert_eq!(throttling(-1).severity, Severity::Note);
        assert_eq!(throttling(0).severity, Severity::Warning);
        assert!(throttling(0).command.unwrap().contains("sched_rt_runtime_us=950000"));
        assert_eq!(clock_source("tsc", "tsc hpet").severity, Severity::Ok);
        assert!(clock_source("hpet", "tsc hpet").command.unwrap().contains("echo tsc"));
        assert_eq!(clock_source("acpi_pm", "hpet acpi_pm").severity, Severity::Note);
    }

    #[test]
    fn the_deepest_enabled_idle_state_of_any_cpu_counts() {
        let cpus = tempfile::tempdir().unwrap();
        let write = |cpu: &str, state: u32, [name, latency_us, disable]: [&str; 3]| {
            let state = cpus.path().join(cpu).join("cpuidle").join(format!("state{state}"));
            fs::create_dir_all(&state).unwrap();
            for (file, text) in [("name", name), ("latency", latency_us), ("disable", disable)] {
                fs::write(state.join(file), format!("{text}\n")).unwrap();
            }
        };
        let found = || idle_states(cpus.path()).map(|finding| (finding.severity, finding.found));
        assert_eq!(found(), None, "no cpuidle");
        write("cpu0", 0, ["POLL", "0", "0"]);
        write("cpu0", 1, ["C1", "2", "0"]);
        write("cpu0", 2, ["C10", "1048", "1"]);
        let shallow = "C1, the deepest idle state, has an exit latency of 2 us";
        assert_eq!(found(), Some((Severity::Ok, shallow.to_owned())));
        write("cpu1", 1, ["C6", "133", "0"]);
        write("cpu1", 2, ["broken", "", "0"]);
        let deep = "C6, the deepest idle state, has an exit latency of 133 us";
        assert_eq!(found(), Some((Severity::Note, deep.to_owned())));
        write("cpu1", 1, ["C6", "133", "1"]);
        fs::create_dir(cpus.path().join("cpuidle")).unwrap();
        fs::write(cpus.path().join("cpuidle/current_driver"), "haltpoll\n").unwrap();
        let (severity, found) = found().unwrap();
        assert!(severity == Severity::Note && found.contains("hypervisor"), "{found}");
    }
}
