//! Shared memory: room for it, and who might take it away.

use std::fs;
use std::path::Path;

use nix::sys::statvfs::statvfs;
use nix::unistd::geteuid;

use super::{Finding, Severity};
use crate::cli::root;
use crate::config::Settings;
use crate::shm::{RoleHolder, RouteChannel, instance_files};

const SHM: &str = "/dev/shm";

/// Beside the pools: boards, connections, what iceoryx2 keeps of each.
const BESIDE_BYTES: u64 = 4 << 20;

/// Up to here a user is one of the system's, whose shared memory logind leaves alone.
const SYSTEM_UID_MAX: u32 = 999;

pub(super) fn check(settings: &Settings) -> Vec<Finding> {
    let pools = (0..settings.routes.len()).map(|route| RouteChannel::of(settings, route).pool_size().bytes);
    let needed = pools.sum::<u64>() + BESIDE_BYTES;
    let root = root(settings);
    let holders = RoleHolder::all(&root, &settings.instance).unwrap_or_default();
    let mut findings = Vec::new();
    match statvfs(SHM) {
        Ok(found) => {
            let block = found.fragment_size();
            let room = Room {
                size: found.blocks() * block,
                free: found.blocks_available() * block,
                taken: !holders.is_empty(),
            };
            findings.push(size(needed, &room));
        }
        Err(error) => findings.push(
            Finding::new(
                "shared memory",
                Severity::Error,
                format!("{SHM}: {error}"),
                "Nothing starts without it.",
            )
            .mended_by(format!("sudo mount -t tmpfs -o mode=1777 tmpfs {SHM}")),
        ),
    }
    let files = instance_files(&root, &settings.instance);
    let bytes: u64 = files.iter().filter_map(|file| Some(fs::metadata(file).ok()?.len())).sum();
    findings.push(stale(holders.len(), files.len(), bytes));
    findings.push(remove_ipc(
        geteuid().as_raw(),
        Path::new("/run/systemd/system").exists(),
        &logind_settings(),
    ));
    findings
}

struct Room {
    size: u64,
    free: u64,
    /// Whether the bridge runs, and has what it needs already.
    taken: bool,
}

fn size(needed: u64, room: &Room) -> Finding {
    let check = "shared memory";
    let mib = |bytes: u64| bytes.div_ceil(1 << 20);
    let found =
        format!("needs {} MiB; {SHM} has {} MiB, {} free", mib(needed), mib(room.size), mib(room.free));
    let command = format!("sudo mount -o remount,size={}M {SHM}", (mib(needed) + mib(room.size)).max(64));
    if room.taken {
        Finding::ok(check, format!("{found}; the bridge runs and has what it needs"))
    } else if room.free < needed {
        Finding::new(
            check,
            Severity::Error,
            found,
            "The bridge does not start: its pools are allocated at once.",
        )
        .mended_by(command)
    } else if room.free < needed + needed / 2 {
        Finding::new(
            check,
            Severity::Warning,
            found,
            "Another program that fills it up keeps the bridge from being restarted.",
        )
        .mended_by(command)
    } else {
        Finding::ok(check, found)
    }
}

fn stale(processes: usize, files: usize, bytes: u64) -> Finding {
    let check = "left behind";
    match (processes, files) {
        (0, 0) => Finding::ok(check, "nothing of a former bridge is left"),
        (0, files) => Finding::new(
            check,
            Severity::Note,
            format!("{files} files of {} KiB in {SHM}, and no process of the bridge", bytes.div_ceil(1024)),
            "A bridge was killed as a whole. The next start removes them.",
        ),
        (processes, files) => {
            Finding::ok(check, format!("{processes} processes of the bridge use {files} files"))
        }
    }
}

/// The settings of logind, in the order in which they are read.
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
        return Finding::ok(check, "does not concern a user of the system's");
    }
    if !with_logind {
        return Finding::ok(check, "no systemd runs here");
    }
    let mut values = logind.lines().filter_map(|line| line.trim().strip_prefix("RemoveIPC=")).map(str::trim);
    let value = values.next_back().unwrap_or("yes");
    if ["no", "false", "off", "0"].contains(&value) {
        return Finding::ok(check, "is off");
    }
    Finding::new(
        check,
        Severity::Warning,
        "is on, and this is the user of a person",
        "When you log out, logind removes your shared memory, and with it a bridge that you left running. The \
         installed services have a user of their own.",
    )
    .mended_by(
        "sudo mkdir -p /etc/systemd/logind.conf.d && printf '[Login]\\nRemoveIPC=no\\n' | \
         sudo tee /etc/systemd/logind.conf.d/60-adaptive-bridge.conf && sudo systemctl restart systemd-logind",
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shared_memory_must_have_room_unless_the_bridge_has_taken_its_own() {
        let room = |free: u64, taken| Room { size: 64 << 20, free: free << 20, taken };
        let needed = 40 << 20;
        assert_eq!(size(needed, &room(64, false)).severity, Severity::Ok);
        assert_eq!(size(needed, &room(50, false)).severity, Severity::Warning);
        let lacking = size(needed, &room(39, false));
        assert_eq!(lacking.severity, Severity::Error);
        assert_eq!(lacking.command.unwrap(), "sudo mount -o remount,size=104M /dev/shm");
        assert_eq!(size(needed, &room(3, true)).severity, Severity::Ok);
    }

    #[test]
    fn files_are_stale_when_nobody_is_there_to_use_them() {
        assert_eq!(stale(0, 0, 0).severity, Severity::Ok);
        assert_eq!(stale(4, 9, 1).severity, Severity::Ok);
        assert_eq!(stale(0, 9, 1).severity, Severity::Note);
    }

    #[test]
    fn the_last_word_on_remove_ipc_counts() {
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
