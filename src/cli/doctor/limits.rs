//! What this user may ask of the kernel, and what the kernel has.

use std::fs;
use std::path::Path;

use nix::sys::resource::{Resource, getrlimit};
use nix::unistd::geteuid;

use super::{Finding, Severity, list, number};
use crate::config::{Scheduling, SchedulingPolicy, Settings};

/// Sockets, shared memory and pipes of a process with some hundred routes.
const OPEN_FILES: u64 = 1024;

/// What leaving an idle state may take without being noticed: about what a wake-up takes anyway.
const SLEEP_US: i64 = 10;

/// CAP_SYS_NICE and CAP_IPC_LOCK, as bits of `CapEff` (capabilities(7)).
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
    // Of the machine, and not of the CPUs that this process was left with.
    let online = fs::read_to_string("/sys/devices/system/cpu/online").ok();
    findings.extend(online.map(|online| cpus(&configured, online.trim())));
    findings.extend(number("/proc/sys/kernel/sched_rt_runtime_us").map(throttling));
    findings.extend(sleep(Path::new("/sys/devices/system/cpu")));
    let source = "/sys/devices/system/clocksource/clocksource0";
    let read = |name: &str| fs::read_to_string(format!("{source}/{name}")).ok();
    if let (Some(current), Some(available)) = (read("current_clocksource"), read("available_clocksource")) {
        findings.push(clock_source(current.trim(), available.trim()));
    }
    findings
}

/// What this process may do; services have rights of their own.
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
    let found = format!("{limit} open files for each process");
    if limit >= OPEN_FILES {
        return Finding::ok("open files", found);
    }
    Finding::new("open files", Severity::Warning, found, "Many routes may not fit.")
        .mended_by(format!("ulimit -n {OPEN_FILES}"))
}

/// A line for limits.conf(5), for this user.
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
    let wanted = configured.iter().filter(|how| how.policy != SchedulingPolicy::Other);
    match wanted.map(|how| u64::from(how.priority)).max() {
        None => Finding::ok(check, "no real-time policy is configured"),
        Some(priority) if rights.nice || rights.rtprio >= priority => {
            Finding::ok(check, format!("priority {priority} is allowed"))
        }
        Some(priority) => Finding::new(
            check,
            Severity::Warning,
            format!("priority {priority} is configured and this user may have {}", rights.rtprio),
            "Processes that this user starts run with the usual policy. The installed services may have up to 50.",
        )
        .mended_by(limits_line("rtprio", &priority.to_string())),
    }
}

fn memory_lock(configured: &[&Scheduling], rights: &Rights) -> Finding {
    let check = "memory lock";
    let wanted = configured.iter().any(|how| how.lock_memory);
    if !wanted {
        return Finding::ok(check, "not configured");
    }
    if rights.lock || rights.memlock == u64::MAX {
        return Finding::ok(check, "is allowed");
    }
    let found = format!("lock_memory is configured and this user may lock {} KiB", rights.memlock / 1024);
    Finding::new(
        check,
        Severity::Warning,
        found,
        "Processes that this user starts may wait for a page. The installed services of the critical path may lock.",
    )
    .mended_by(limits_line("memlock", "unlimited"))
}

/// `online` as the kernel lists CPUs, such as `0-3,8`.
fn cpus(configured: &[&Scheduling], online: &str) -> Finding {
    let is_online = |cpu: usize| {
        online.split(',').any(|range| {
            let (first, last) = range.split_once('-').unwrap_or((range, range));
            let bound = |text: &str| text.parse::<usize>().ok();
            bound(first).is_some_and(|first| first <= cpu) && bound(last).is_some_and(|last| cpu <= last)
        })
    };
    let mut lacking: Vec<usize> = configured.iter().flat_map(|how| how.cpus.iter().copied()).collect();
    lacking.retain(|&cpu| !is_online(cpu));
    lacking.sort_unstable();
    lacking.dedup();
    if lacking.is_empty() {
        return Finding::ok("CPUs", format!("this machine has {online}"));
    }
    Finding::new(
        "CPUs",
        Severity::Warning,
        format!("CPUs {} are configured, and this machine has {online}", list(lacking)),
        "A process that may run on none of its CPUs runs on all.",
    )
}

fn throttling(runtime_us: i64) -> Finding {
    let check = "real-time runtime";
    match runtime_us {
        0 => Finding::new(
            check,
            Severity::Warning,
            "kernel.sched_rt_runtime_us is 0",
            "No process may have a real-time policy.",
        )
        .mended_by("sudo sysctl -w kernel.sched_rt_runtime_us=950000"),
        runtime_us if runtime_us < 0 => Finding::new(
            check,
            Severity::Note,
            "kernel.sched_rt_runtime_us is -1",
            "A real-time process that spins takes its CPU for good; the services have LimitRTTIME against that.",
        ),
        runtime_us => Finding::ok(check, format!("{runtime_us} us of each second")),
    }
}

/// The enabled idle state of any CPU that takes longest to leave, and how long, as `sysfs` says
/// (the kernel's cpuidle).
fn deepest_sleep(cpus: &Path) -> Option<(String, i64)> {
    let entries = |directory: &Path| fs::read_dir(directory).into_iter().flatten().flatten();
    let states = entries(cpus).flat_map(|cpu| entries(&cpu.path().join("cpuidle")));
    let enabled = states.filter_map(|state| {
        let read = |name: &str| fs::read_to_string(state.path().join(name)).ok();
        let latency_us = read("latency")?.trim().parse().ok()?;
        (read("disable")?.trim() == "0").then_some((read("name")?.trim().to_owned(), latency_us))
    });
    enabled.max_by_key(|(_, latency_us)| *latency_us)
}

/// `None` where the kernel has no idle states to choose from.
fn sleep(cpus: &Path) -> Option<Finding> {
    let (name, latency_us) = deepest_sleep(cpus)?;
    let driver = fs::read_to_string(cpus.join("cpuidle/current_driver")).unwrap_or_default();
    let found = match driver.trim() {
        // A guest's driver. It says 1 us, and the hypervisor takes 40 to 70.
        "haltpoll" => {
            "idle CPUs of this virtual machine go to its hypervisor, which takes tens of us".to_owned()
        }
        _ => format!("{name}, the deepest idle state, takes {latency_us} us to leave"),
    };
    if latency_us <= SLEEP_US && driver.trim() != "haltpoll" {
        return Some(Finding::ok("idle CPUs", found));
    }
    let meaning =
        "A sample waits for it at up to three hand-overs, where samples are rare enough for CPUs to sleep.";
    let command = "sudo sh -c 'exec 3>/dev/cpu_dma_latency && echo 0 >&3 && exec sleep infinity' \
                   # none sleeps while this runs; takes power";
    Some(Finding::new("idle CPUs", Severity::Note, found, meaning).mended_by(command))
}

fn clock_source(current: &str, available: &str) -> Finding {
    let check = "clock source";
    // Read in user space, in nanoseconds; the others take a system call or a slow device.
    const FAST: [&str; 4] = ["tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page"];
    if FAST.contains(&current) {
        return Finding::ok(check, current);
    }
    let better = FAST.into_iter().find(|fast| available.split_whitespace().any(|name| name == *fast));
    let finding = Finding::new(
        check,
        if better.is_some() { Severity::Warning } else { Severity::Note },
        current,
        "Each reading of the clock costs microseconds, and each sample takes several.",
    );
    match better {
        Some(better) => finding.mended_by(format!(
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
    fn what_is_configured_must_be_allowed() {
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
        assert_eq!(throttling(950_000).severity, Severity::Ok);
        assert_eq!(throttling(-1).severity, Severity::Note);
        assert_eq!(throttling(0).severity, Severity::Warning);
        assert_eq!(clock_source("tsc", "tsc hpet").severity, Severity::Ok);
        assert!(clock_source("hpet", "tsc hpet").command.unwrap().contains("echo tsc"));
        assert_eq!(clock_source("acpi_pm", "hpet acpi_pm").severity, Severity::Note);
    }

    #[test]
    fn the_deepest_sleep_of_any_cpu_counts_if_it_is_enabled() {
        let cpus = tempfile::tempdir().unwrap();
        let write = |cpu: &str, state: u32, [name, latency_us, disable]: [&str; 3]| {
            let state = cpus.path().join(cpu).join("cpuidle").join(format!("state{state}"));
            fs::create_dir_all(&state).unwrap();
            for (file, text) in [("name", name), ("latency", latency_us), ("disable", disable)] {
                fs::write(state.join(file), format!("{text}\n")).unwrap();
            }
        };
        let found = || sleep(cpus.path()).map(|finding| (finding.severity, finding.found));
        assert_eq!(found(), None, "no cpuidle");
        write("cpu0", 0, ["POLL", "0", "0"]);
        write("cpu0", 1, ["C1", "2", "0"]);
        write("cpu0", 2, ["C10", "1048", "1"]);
        let shallow = "C1, the deepest idle state, takes 2 us to leave";
        assert_eq!(found(), Some((Severity::Ok, shallow.to_owned())));
        write("cpu1", 1, ["C6", "133", "0"]);
        write("cpu1", 2, ["broken", "", "0"]);
        let deep = "C6, the deepest idle state, takes 133 us to leave";
        assert_eq!(found(), Some((Severity::Note, deep.to_owned())));
        write("cpu1", 1, ["C6", "133", "1"]);
        fs::create_dir(cpus.path().join("cpuidle")).unwrap();
        fs::write(cpus.path().join("cpuidle/current_driver"), "haltpoll\n").unwrap();
        let (severity, found) = found().unwrap();
        assert!(severity == Severity::Note && found.contains("hypervisor"), "{found}");
    }
}
