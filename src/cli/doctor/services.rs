//! Checks of versions and of the systemd services.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use super::super::units::{self, DropIns};
use super::{Finding, list, mib, output};
use crate::config::Settings;
use crate::shm::{RoleHolder, root_of};

const TARGET: &str = "adaptive-bridge.target";

/// The oldest supported Linux, from the time of ROS 2 Humble.
const OLDEST_KERNEL: (u32, u32) = (5, 4);

/// Shows the versions of the bridge, Linux and ROS 2, and checks that of Linux.
pub(super) fn versions() -> Vec<Finding> {
    let kernel = fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    let ros = std::env::var("ROS_DISTRO").ok().filter(|name| !name.is_empty());
    let ros = ros.map_or_else(String::new, |name| format!(", ROS 2 {name}"));
    let found = format!("adaptive-bridge {}, Linux {}{ros}", env!("CARGO_PKG_VERSION"), kernel.trim());
    vec![kernel_version(kernel.trim(), found)]
}

fn kernel_version(release: &str, found: String) -> Finding {
    let mut numbers = release.split(['.', '-']).map(|number| number.parse().unwrap_or(0));
    let version = (numbers.next().unwrap_or(0), numbers.next().unwrap_or(0));
    if version >= OLDEST_KERNEL {
        return Finding::ok("versions", found);
    }
    Finding::warning("versions", found).means("The bridge is not tested with a kernel this old.")
}

pub(super) fn check(settings: &Settings, file: &Path) -> Vec<Finding> {
    let holders = RoleHolder::all(&root_of(settings), &settings.instance).unwrap_or_default();
    let mut findings = vec![executables(&holders)];
    if !Path::new("/run/systemd/system").exists() {
        let text = "systemd does not run here; `adaptive-bridge up` supervises the processes";
        findings.push(Finding::ok("services", text));
        return findings;
    }
    let enabled = output("systemctl", &["is-enabled", TARGET]).unwrap_or_default();
    findings.push(services(&enabled));
    if !["", "not-found"].contains(&enabled.as_str()) {
        let match_configuration = DropIns::of(settings, file).match_folder(Path::new(units::FOLDER));
        findings.push(drop_ins(match_configuration, file));
        findings.push(memory_limits(&units::memory_limits(settings), file, |unit| {
            output("systemctl", &["show", "--property=MemoryMax", "--value", unit])
        }));
        let list = ["list-units", "--plain", "--no-legend", "--state=failed", "adaptive-bridge-*"];
        findings.push(failed(&output("systemctl", &list).unwrap_or_default()));
    }
    findings
}

/// Checks that all processes run the installed executable.
fn executables(holders: &[RoleHolder]) -> Finding {
    let is_replaced = |holder: &&RoleHolder| {
        fs::read_link(format!("/proc/{}/exe", holder.pid))
            .is_ok_and(|path| path.as_os_str().as_encoded_bytes().ends_with(b" (deleted)"))
    };
    let old: Vec<&str> = holders.iter().filter(is_replaced).map(|holder| holder.role.as_str()).collect();
    if old.is_empty() {
        return Finding::ok("processes", format!("{} processes of the bridge run", holders.len()));
    }
    Finding::warning("processes", format!("{} still run an executable that was replaced", list(old)))
        .means("An upgrade takes effect after a restart.")
        .with_command(format!("sudo systemctl restart {TARGET}"))
}

/// Checks the state that `systemctl is-enabled` prints for the target.
fn services(enabled: &str) -> Finding {
    match enabled {
        "enabled" | "enabled-runtime" => Finding::ok("services", format!("{TARGET} is enabled")),
        "" | "not-found" => Finding::note("services", "the service units are not installed")
            .means("The bridge does not start when the machine boots."),
        state => Finding::warning("services", format!("{TARGET} is {state}"))
            .means("The bridge does not start when the machine boots.")
            .with_command(format!("sudo systemctl enable --now {TARGET}")),
    }
}

/// Checks that the drop-ins of the units match the configuration.
fn drop_ins(match_configuration: bool, file: &Path) -> Finding {
    if match_configuration {
        return Finding::ok("units", "match the configuration");
    }
    Finding::warning("units", "do not match the configuration")
        .means("A lane has no service, or a service lacks a right that the configuration needs.")
        .with_command(format!("sudo adaptive-bridge units --write --config {}", file.display()))
}

/// Checks the limits of memory in force, which `systemctl show` prints in bytes or as `infinity`.
fn memory_limits(
    needed: &BTreeMap<String, u64>,
    file: &Path,
    in_force: impl Fn(&str) -> Option<String>,
) -> Finding {
    let check = "memory limits";
    let (mut too_low, mut unlimited) = (Vec::new(), Vec::new());
    for (unit, needed) in needed {
        match in_force(unit).and_then(|limit| limit.parse::<u64>().ok()) {
            Some(limit) if limit < *needed => {
                too_low.push(format!("{unit} has {} MiB and may need {}", mib(limit), mib(*needed)));
            }
            Some(_) => {}
            None => unlimited.push(unit),
        }
    }
    let command = format!("sudo adaptive-bridge units --write --config {}", file.display());
    if !too_low.is_empty() {
        Finding::warning(check, list(&too_low))
            .means("The kernel ends a process that needs more than its limit.")
            .with_command(command)
    } else if !unlimited.is_empty() {
        Finding::note(check, format!("{} have none", list(&unlimited)))
            .means("If a process takes too much memory, the kernel ends other programs first.")
            .with_command(command)
    } else {
        Finding::ok(check, "are what the configuration may need, or more")
    }
}

/// Checks the services that `systemctl list-units --state=failed` lists.
fn failed(units: &str) -> Finding {
    let names: Vec<&str> = units.lines().filter_map(|line| line.split_whitespace().next()).collect();
    let Some(first) = names.first().copied() else {
        return Finding::ok("failed", "no service has failed");
    };
    Finding::error("failed", list(&names))
        .means("systemd no longer restarts them: the configuration is bad, or they exited too often.")
        .with_command(format!("journalctl -u {first} -n 50"))
}

#[cfg(test)]
mod tests {
    use super::super::Severity;
    use super::*;

    #[test]
    fn versions_and_services_are_judged() {
        let severity = |release: &str| kernel_version(release, String::new()).severity;
        assert_eq!(severity("6.18.5-rt1"), Severity::Ok);
        assert_eq!(severity("5.15.0-91-generic"), Severity::Ok);
        assert_eq!(severity("4.19.0"), Severity::Warning);
        assert_eq!(services("enabled").severity, Severity::Ok);
        assert_eq!(services("disabled").severity, Severity::Warning);
        assert_eq!(services("not-found").severity, Severity::Note);
        assert_eq!(drop_ins(false, Path::new("/x")).severity, Severity::Warning);
        assert_eq!(failed("").severity, Severity::Ok);
        let found = failed("adaptive-bridge-control.service loaded failed failed Adaptive Bridge: control\n");
        assert_eq!(found.command.unwrap(), "journalctl -u adaptive-bridge-control.service -n 50");
    }

    #[test]
    fn a_limit_of_memory_is_enough_or_missing_or_too_low() {
        let needed = BTreeMap::from([("a.service".to_owned(), 32 << 20), ("b.service".to_owned(), 64 << 20)]);
        let found = |a: &'static str, b: &'static str| {
            let in_force = move |unit: &str| Some(if unit == "a.service" { a } else { b }.to_owned());
            memory_limits(&needed, Path::new("/x"), in_force)
        };
        assert_eq!(found("33554432", "infinity").severity, Severity::Note);
        assert_eq!(found("33554432", "67108864").severity, Severity::Ok);
        let too_low = found("infinity", "67108863");
        assert_eq!(too_low.severity, Severity::Warning);
        assert_eq!(too_low.found, "b.service has 64 MiB and may need 64");
        assert!(too_low.command.unwrap().contains("units --write"));
    }

    #[test]
    fn a_process_of_the_installed_executable_needs_no_restart() {
        let holder = RoleHolder { role: "ingress".into(), pid: std::process::id(), note: "/x".into() };
        assert_eq!(executables(&[holder]).severity, Severity::Ok);
    }
}
