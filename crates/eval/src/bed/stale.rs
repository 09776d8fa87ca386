//! Names and removal of what a harness creates on the machine. The names contain the harness's process id, so
//! that the next harness finds and removes the leftovers of a killed one.

use std::fs;
use std::path::{Path, PathBuf};
use std::process;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use crate::impairment::system;

/// The folder of network namespaces created by `ip`.
pub(super) const NAMESPACES: &str = "/run/netns";

/// Prefix of the names of namespaces, containers and folders: `abe-PID-NAME`.
const PREFIX: &str = "abe-";
/// The folder of shared-memory segments. The bridge's segments are named `ab1_INSTANCE_…`.
const SEGMENTS: &str = "/dev/shm";
const SEGMENT_PREFIX: &str = "ab1_abe_";

/// Builds the name of a namespace, container or folder of this process.
pub fn name(what: &str) -> String {
    format!("{PREFIX}{}-{what}", process::id())
}

/// The instance name of the bridge that this process starts.
pub fn instance() -> String {
    format!("abe_{}", process::id())
}

/// The folder for the bridge's temporary files, which is not created yet. Its path is short, as the names in
/// it may be long.
pub fn folder() -> PathBuf {
    scratch("bridge")
}

/// Another folder of this process for temporary files.
pub(super) fn scratch(what: &str) -> PathBuf {
    std::env::temp_dir().join(name(what))
}

/// Removes namespaces and files of harness processes that no longer run; returns a description of each.
pub(super) fn remove_all() -> Vec<String> {
    let mut removed = Vec::new();
    for name in names(NAMESPACES).into_iter().filter(|name| is_stale(name, PREFIX)) {
        remove_namespace(&name);
        removed.push(format!("host {name}"));
    }
    let folders = std::env::temp_dir();
    for name in names(&folders).into_iter().filter(|name| is_stale(name, PREFIX)) {
        let _ = fs::remove_dir_all(folders.join(&name));
        removed.push(format!("folder {name}"));
    }
    let segments = names(SEGMENTS).into_iter().filter(|name| is_stale(name, SEGMENT_PREFIX));
    let count = segments.filter(|name| fs::remove_file(Path::new(SEGMENTS).join(name)).is_ok()).count();
    if count > 0 {
        removed.push(format!("{count} files of shared memory"));
    }
    removed
}

/// Removes shared memory and folder of the bridge that this process started, also after the bridge was
/// killed.
pub fn remove_own_bridge() {
    let prefix = format!("ab1_{}_", instance());
    for name in names(SEGMENTS).into_iter().filter(|name| name.starts_with(&prefix)) {
        let _ = fs::remove_file(Path::new(SEGMENTS).join(name));
    }
    let _ = fs::remove_dir_all(folder());
}

/// Removes the network namespaces of a harness process.
pub(super) fn remove_namespaces(pid: u32) {
    let prefix = format!("{PREFIX}{pid}-");
    names(NAMESPACES).iter().filter(|name| name.starts_with(&prefix)).for_each(|name| remove_namespace(name));
}

/// Kills the processes in a namespace and removes it; ignores errors, as it may have been removed already.
pub(super) fn remove_namespace(name: &str) {
    let line = |arguments: &str| system::words(&format!("ip netns {arguments} {name}"));
    let pids = system::run(&line("pids")).unwrap_or_default();
    for pid in pids.split_whitespace().filter_map(|pid| pid.parse().ok()) {
        let _ = kill(Pid::from_raw(pid), Signal::SIGKILL);
    }
    let _ = system::run(&line("del"));
}

/// Whether this is the name of a namespace, container or folder of a process that no longer runs.
pub(super) fn is_leftover(name: &str) -> bool {
    is_stale(name, PREFIX)
}

/// Whether a name with that prefix contains the id of a process that no longer runs.
fn is_stale(name: &str, prefix: &str) -> bool {
    let rest = name.strip_prefix(prefix);
    let pid = rest.and_then(|rest| rest.split(['-', '_']).next()?.parse::<u32>().ok());
    pid.is_some_and(|pid| !Path::new(&format!("/proc/{pid}")).exists())
}

fn names(folder: impl AsRef<Path>) -> Vec<String> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.filter_map(|entry| entry.file_name().into_string().ok()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_names_with_the_id_of_a_process_that_no_longer_runs_are_stale() {
        let own = process::id();
        // Linux has no process ids beyond 2^22.
        assert!(is_stale("abe-9999999-slow", PREFIX));
        assert!(is_stale("ab1_abe_9999999_0123abcd_x", SEGMENT_PREFIX));
        for name in [&name("slow"), &format!("abe-{own}-switch"), "abe-x-slow", "abe-", "ab-9999999-0-slow"] {
            assert!(!is_stale(name, PREFIX), "{name}");
        }
        assert!(!is_stale(&format!("ab1_{}_0123abcd_x", instance()), SEGMENT_PREFIX));
        assert!(!is_stale("ab1_default_0123abcd_x", SEGMENT_PREFIX));
    }
}
