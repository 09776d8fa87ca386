//! Checks of shared memory: free space, files left by a killed bridge, removal by logind.

use std::fs;
use std::path::Path;

use nix::sys::statvfs::statvfs;
use nix::unistd::geteuid;

use super::{Finding, mib};
use crate::config::Settings;
use crate::shm::{OTHER_SHARED_BYTES, RoleHolder, RouteChannel, budget_bytes, instance_files, root_of};

const SHM: &str = "/dev/shm";

/// The highest user id of system users, whose shared memory logind does not remove.
const SYSTEM_UID_MAX: u32 = 999;

pub(super) fn check(settings: &Settings) -> Vec<Finding> {
    let pools = || (0..settings.routes.len()).map(|route| RouteChannel::of(settings, route).pool_size());
    let most: u64 = pools().map(|pool| pool.bytes).sum();
    let needed = Needed {
        at_start: pools().map(|pool| pool.first_bytes).sum::<u64>() + OTHER_SHARED_BYTES,
        most: most.min(budget_bytes(settings)) + OTHER_SHARED_BYTES,
    };
    let root = root_of(settings);
    let holders = RoleHolder::all(&root, &settings.instance).unwrap_or_default();
    let space = match statvfs(SHM) {
        Ok(found) => {
            let block = found.fragment_size();
            let space = Space {
                size: found.blocks() * block,
                free: found.blocks_available() * block,
                is_allocated: !holders.is_empty(),
            };
            free_space(needed, &space)
        }
        Err(error) => Finding::error("shared memory", format!("{SHM}: {error}"))
            .means("The bridge cannot start without it.")
            .with_command(format!("sudo mount -t tmpfs -o mode=1777 tmpfs {SHM}")),
    };
    let files = instance_files(&root, &settings.instance);
    let bytes: u64 = files.iter().filter_map(|file| Some(fs::metadata(file).ok()?.len())).sum();
    let leftover = leftover_files(holders.len(), files.len(), bytes);
    let with_logind = Path::new("/run/systemd/system").exists();
    vec![space, leftover, remove_ipc(geteuid().as_raw(), with_logind, &logind_settings())]
}

/// The size of /dev/shm, in bytes.
struct Space {
    size: u64,
    free: u64,
    /// Whether the bridge runs and so has already allocated its pools.
    is_allocated: bool,
}

/// What the bridge takes of /dev/shm, in bytes.
#[derive(Clone, Copy)]
struct Needed {
    at_start: u64,
    /// With the largest samples, up to the budget.
    most: u64,
}

fn free_space(needed: Needed, space: &Space) -> Finding {
    let check = "shared memory";
    let Needed { at_start, most } = needed;
    let most = most.max(at_start);
    let found = format!(
        "needs {} MiB at the start, at most {} MiB; {SHM} has {} MiB, {} free",
        mib(at_start),
        mib(most),
        mib(space.size),
        mib(space.free)
    );
    let command = format!("sudo mount -o remount,size={}M {SHM}", (mib(most) + mib(space.size)).max(64));
    if space.is_allocated {
        Finding::ok(check, format!("{found}; the running bridge already has a part of it"))
    } else if space.free < at_start {
        Finding::error(check, found)
            .means("The bridge does not start, because it allocates the headers of its samples at the start.")
            .with_command(command)
    } else if space.free < most + most / 2 {
        Finding::warning(check, found)
            .means("If /dev/shm is full, ingress drops the samples for which there is no room.")
            .with_command(command)
    } else {
        Finding::ok(check, found)
    }
}

fn leftover_files(processes: usize, files: usize, bytes: u64) -> Finding {
    let check = "left behind";
    match (processes, files) {
        (0, 0) => Finding::ok(check, "no files of an earlier bridge"),
        (0, files) => Finding::note(
            check,
            format!("{files} files ({} KiB) in {SHM}, and no process of the bridge", bytes.div_ceil(1024)),
        )
        .means("All processes of a bridge were killed. The next start removes these files."),
        (processes, files) => {
            Finding::ok(check, format!("{processes} processes of the bridge use {files} files"))
        }
    }
}

/// The configuration files of logind joined in the order in which it reads them.
fn logind_settings() -> String {
    let mut texts = vec![fs::read_to_string("/etc/systemd/logind.conf").unwrap_or_default()];
    for folder in
        ["/usr/lib/systemd/logind.conf.d", "/run/systemd/logind.conf.d", "/etc/systemd/logind.conf.d"]
    {
        let mut files: Vec<_> =
            fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()).collect();
        files.sort();
        texts.extend(files.iter().filter_map(|file| fs::read_to_string(file).ok()));
    }
    texts.join("\n")
}

fn remove_ipc(uid: u32, with_logind: bool, logind: &str) -> Finding {
    let check = "RemoveIPC";
    if uid <= SYSTEM_UID_MAX {
        return Finding::ok(check, "does not apply to a system user");
    }
    if !with_logind {
        return Finding::ok(check, "no systemd runs here");
    }
    let mut values = logind.lines().filter_map(|line| line.trim().strip_prefix("RemoveIPC=")).map(str::trim);
    let value = values.next_back().unwrap_or("yes");
    if ["no", "false", "off", "0"].contains(&value) {
        return Finding::ok(check, "is off");
    }
    Finding::warning(check, "is on, and this is not a system user").means(
        "When you log out, logind removes your shared memory, also that of a bridge that still runs. The \
         installed services run as a system user.",
    )
    .with_command(
        "sudo mkdir -p /etc/systemd/logind.conf.d && printf '[Login]\\nRemoveIPC=no\\n' | \
         sudo tee /etc/systemd/logind.conf.d/60-adaptive-bridge.conf && sudo systemctl restart systemd-logind",
    )
}

#[cfg(test)]
mod tests {
    use super::super::Severity;
    use super::*;

    #[test]
    fn shared_memory_must_be_free_unless_the_bridge_has_allocated_it() {
        let space = |free: u64, is_allocated| Space { size: 64 << 20, free: free << 20, is_allocated };
        let needed = Needed { at_start: 40 << 20, most: 40 << 20 };
        let growing = Needed { at_start: 4 << 20, most: 100 << 20 };
        assert_eq!(free_space(growing, &space(64, false)).severity, Severity::Warning);
        assert_eq!(free_space(growing, &space(3, false)).severity, Severity::Error);
        assert_eq!(free_space(needed, &space(64, false)).severity, Severity::Ok);
        assert_eq!(free_space(needed, &space(50, false)).severity, Severity::Warning);
        let too_small = free_space(needed, &space(39, false));
        assert_eq!(too_small.severity, Severity::Error);
        assert_eq!(too_small.command.unwrap(), "sudo mount -o remount,size=104M /dev/shm");
        assert_eq!(free_space(needed, &space(3, true)).severity, Severity::Ok);
    }

    #[test]
    fn files_without_a_process_that_uses_them_are_reported() {
        assert_eq!(leftover_files(0, 0, 0).severity, Severity::Ok);
        assert_eq!(leftover_files(4, 9, 1).severity, Severity::Ok);
        assert_eq!(leftover_files(0, 9, 1).severity, Severity::Note);
    }

    #[test]
    fn the_last_value_of_remove_ipc_counts() {
        assert_eq!(remove_ipc(0, true, "").severity, Severity::Ok);
        assert_eq!(remove_ipc(1000, false, "").severity, Severity::Ok);
        assert_eq!(
            remove_ipc(1000, true, "#RemoveIPC=yes\nRemoveIPC=yes\n RemoveIPC=no\n").severity,
            Severity::Ok
        );
        assert_eq!(remove_ipc(1000, true, "RemoveIPC=no\nRemoveIPC=yes").severity, Severity::Warning);
        assert_eq!(remove_ipc(1000, true, "").severity, Severity::Warning);
    }
}
