//! The service units have the settings that docs/hardening.md promises. `tests/root/systemd.rs` runs them.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

/// The settings of a file of systemd, `NAME=VALUE`.
fn settings(file: &str) -> BTreeSet<String> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("systemd").join(file);
    let text = fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    text.lines().filter(|line| line.contains('=') && !line.starts_with('#')).map(str::to_owned).collect()
}

const COMMON: &str = "adaptive-bridge-.service.d/10-common.conf";
/// The services of ingress and of the critical lane.
const CRITICAL: [&str; 4] = [
    "adaptive-bridge-ingress.service",
    "adaptive-bridge-egress@critical.service.d/50-critical.conf",
    "adaptive-bridge-standby-ingress.service",
    "adaptive-bridge-standby-critical.service",
];
const OTHERS: [&str; 4] = [
    COMMON,
    "adaptive-bridge-control.service",
    "adaptive-bridge-egress@.service",
    "adaptive-bridge-responder@.service",
];

#[test]
fn services_have_no_capabilities_and_write_only_to_shared_memory() {
    let common = settings(COMMON);
    for setting in [
        "User=adaptive-bridge",
        "CapabilityBoundingSet=",
        "AmbientCapabilities=",
        "NoNewPrivileges=yes",
        "PrivateUsers=yes",
        "PrivateDevices=yes",
        "PrivateTmp=yes",
        "ProtectSystem=strict",
        "ProtectHome=yes",
        "RemoveIPC=no",
        "RestrictAddressFamilies=AF_UNIX AF_INET AF_INET6 AF_NETLINK",
        "SystemCallFilter=@system-service",
        "UMask=0077",
    ] {
        assert!(common.contains(setting), "{setting} is missing in {COMMON}");
    }
    // No unit takes one of them back; a later setting replaces or extends an earlier one.
    let names: BTreeSet<&str> = common.iter().filter_map(|setting| setting.split('=').next()).collect();
    for unit in CRITICAL.into_iter().chain(OTHERS).filter(|unit| *unit != COMMON) {
        for setting in settings(unit) {
            let name = setting.split('=').next().unwrap_or_default();
            let protects = ["Capab", "Ambient", "NoNew", "Private", "Protect", "Remove", "System", "UMask"];
            assert!(
                !(names.contains(name) && protects.iter().any(|start| name.starts_with(start))),
                "{unit} replaces {setting}"
            );
        }
    }
}

/// A standby sees whether the process that it would take over from is stopped or makes progress.
#[test]
fn only_ingress_the_critical_lane_and_their_standbys_see_all_processes() {
    for unit in CRITICAL.into_iter().chain(OTHERS).filter(|unit| *unit != COMMON) {
        // A drop-in overrides the service, so that of the critical lane has to say so.
        let expected = if CRITICAL.contains(&unit) { "default" } else { "invisible" };
        assert!(settings(unit).contains(&format!("ProtectProc={expected}")), "{unit}");
    }
}

#[test]
fn only_ingress_and_the_critical_lane_may_use_real_time_scheduling_and_lock_memory() {
    for unit in CRITICAL {
        let settings = settings(unit);
        for setting in ["RestrictRealtime=no", "LimitRTPRIO=50", "LimitMEMLOCK=infinity"] {
            assert!(settings.contains(setting), "{setting} is missing in {unit}");
        }
        let limit = settings.iter().find(|setting| setting.starts_with("LimitRTTIME="));
        assert!(limit.is_some_and(|limit| limit != "LimitRTTIME=infinity"), "{unit}: {limit:?}");
    }
    for unit in OTHERS {
        assert!(unit == COMMON || settings(unit).contains("RestrictRealtime=yes"), "{unit}");
        for setting in settings(unit) {
            let grants = ["LimitRTPRIO=", "LimitMEMLOCK=", "RestrictRealtime=no"];
            assert!(!grants.iter().any(|grant| setting.starts_with(grant)), "{setting} in {unit}");
        }
    }
}

/// Either of the two processes of a role may serve it.
#[test]
fn a_standby_has_the_settings_of_the_service_that_it_takes_over_from() {
    let service = |unit: &str| {
        let of_unit = [
            "Description=",
            "Documentation=",
            "PartOf=",
            "After=",
            "ExecStart=",
            "ExecReload=",
            "Environment=ADAPTIVE_BRIDGE_STANDBY=",
        ];
        let settings = settings(unit).into_iter();
        settings.filter(|line| !of_unit.iter().any(|name| line.starts_with(name))).collect::<BTreeSet<_>>()
    };
    let [ingress, critical, of_ingress, of_critical] = CRITICAL.map(service);
    assert_eq!((ingress, critical), (of_ingress, of_critical));
}

#[test]
fn what_reads_no_file_has_no_reload() {
    // SIGHUP ends the responder.
    let reloads = |unit: &str| settings(unit).contains("ExecReload=kill -HUP $MAINPID");
    assert!(!reloads(COMMON) && !reloads("adaptive-bridge-responder@.service"));
    let services = CRITICAL.into_iter().chain(OTHERS).filter(|unit| unit.ends_with(".service"));
    assert_eq!(services.filter(|unit| !reloads(unit)).count(), 1);
}

#[test]
fn systemd_keeps_the_sockets_of_ingress_and_the_critical_lane() {
    // systemd ignores the sockets of a process whose notifications it does not accept.
    assert!(settings(COMMON).contains("NotifyAccess=main"));
    let keeps = |unit: &str| settings(unit).contains("FileDescriptorStoreMax=8");
    assert!(CRITICAL.into_iter().all(keeps));
    assert!(!OTHERS.into_iter().any(keeps));
}

#[test]
fn each_service_has_a_watchdog_and_is_in_the_slice_of_its_kind() {
    for unit in CRITICAL.into_iter().chain(OTHERS).filter(|unit| *unit != COMMON) {
        let settings = settings(unit);
        let of = |name: &str| settings.iter().find_map(|line| line.strip_prefix(name));
        let (slice, watchdog) = match unit {
            _ if CRITICAL.contains(&unit) => (Some("adaptive-bridge-critical.slice"), "2s"),
            "adaptive-bridge-egress@.service" => (Some("adaptive-bridge-noncritical.slice"), "5s"),
            "adaptive-bridge-control.service" => (Some("adaptive-bridge.slice"), "5s"),
            // It runs on another computer.
            _ => (None, "5s"),
        };
        assert_eq!((of("Slice="), of("WatchdogSec=")), (slice, Some(watchdog)), "{unit}");
    }
    let limits = settings("adaptive-bridge-noncritical.slice");
    for limit in ["CPUQuota=100%", "TasksMax=1024"] {
        assert!(limits.contains(limit), "{limit} in {limits:?}");
    }
    let others = ["adaptive-bridge.slice", "adaptive-bridge-critical.slice"].map(settings);
    let is_limit = |line: &&String| ["CPUQuota", "Memory", "Tasks"].iter().any(|name| line.starts_with(name));
    assert_eq!(others.iter().flatten().find(is_limit), None);
}
