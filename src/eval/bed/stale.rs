//! What a harness makes on the machine, by whose it is: names carry the process id, so that what one that was
//! killed has left is known and removed by the next.

use std::fs;
use std::path::{Path, PathBuf};
use std::process;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

use crate::eval::impairment::system;

/// Where `ip` keeps network namespaces.
pub(super) const NAMESPACES: &str = "/run/netns";

/// Namespaces, containers and folders are called `abe-PID-NAME`.
const PREFIX: &str = "abe-";
/// The bridge's shared memory begins with `ab1_` and its instance.
const SEGMENTS: &str = "/dev/shm";
const SEGMENT_PREFIX: &str = "ab1_abe_";

/// The name of something of this process.
pub fn name(what: &str) -> String {
    format!("{PREFIX}{}-{what}", process::id())
}

/// The instance of a bridge of this process.
pub fn instance() -> String {
    format!("abe_{}", process::id())
}

/// A folder of this process for short-lived files, which is not made yet. Its path is short, as names in it
/// may be long.
pub fn folder() -> PathBuf {
    scratch("bridge")
}

/// A folder of this process for short-lived files of another kind.
pub(super) fn scratch(what: &str) -> PathBuf {
    std::env::temp_dir().join(name(what))
}

/// Removes what harnesses that are gone have left, and says what it was.
pub fn remove_all() -> Vec<String> {
    let mut removed = Vec::new();
    for name in names(NAMESPACES).into_iter().filter(|name| is_stale(name, PREFIX)) {
        remove_namespace(&name);
        removed.push(format!("host {name}"));
    }
    for name in super::docker::leftovers().into_iter().filter(|name| is_stale(name, PREFIX)) {
        super::docker::remove(&name);
        removed.push(format!("container or network {name}"));
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

/// Removes the bridge's shared memory and folder of this process, whatever state it was killed in.
pub fn remove_own_bridge() {
    let prefix = format!("ab1_{}_", instance());
    for name in names(SEGMENTS).into_iter().filter(|name| name.starts_with(&prefix)) {
        let _ = fs::remove_file(Path::new(SEGMENTS).join(name));
    }
    let _ = fs::remove_dir_all(folder());
}

/// Removes the namespaces of a process.
pub(super) fn remove_namespaces(pid: u32) {
    let prefix = format!("{PREFIX}{pid}-");
    names(NAMESPACES).iter().filter(|name| name.starts_with(&prefix)).for_each(|name| remove_namespace(name));
}

/// Kills what runs in a namespace and removes it. What has gone meanwhile is as good as removed.
pub(super) fn remove_namespace(name: &str) {
    let line = |arguments: &str| system::words(&format!("ip netns {arguments} {name}"));
    let pids = system::run(&line("pids")).unwrap_or_default();
    for pid in pids.split_whitespace().filter_map(|pid| pid.parse().ok()) {
        let _ = kill(Pid::from_raw(pid), Signal::SIGKILL);
    }
    let _ = system::run(&line("del"));
}

/// Whether a name with that prefix carries the id of a process that is gone.
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
    fn only_what_carries_the_id_of_a_process_that_is_gone_is_stale() {
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
