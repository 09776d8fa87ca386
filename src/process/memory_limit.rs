//! Warns at the start of a process whose limit of memory is lower than its need.

use std::fs;
use std::path::Path;

use tracing::warn;

use super::memory::MemoryNeeds;
use crate::config::Settings;
use crate::shm::ProcessRole;

/// Where the kernel shows its control groups (version 2).
const GROUPS: &str = "/sys/fs/cgroup";

/// Logs a warning if the kernel would end the process before it has the memory that it may need.
pub(super) fn check(settings: &Settings, role: ProcessRole) {
    let needs = MemoryNeeds::of(settings);
    let need = match role {
        ProcessRole::Ingress => Some(needs.ingress),
        ProcessRole::Control => Some(needs.control),
        ProcessRole::Egress(lane) => needs.lanes.get(lane).copied(),
    };
    let group = fs::read_to_string("/proc/self/cgroup").unwrap_or_default();
    let limit = limit_of(&group, &|path| fs::read_to_string(Path::new(GROUPS).join(path)).ok());
    if let (Some(limit), Some(need)) = (limit, need.map(|need| need.limit_bytes()))
        && limit < need
    {
        warn!(
            limit_mib = limit >> 20,
            needed_mib = need >> 20,
            "the limit of memory of this process is lower than its possible need, and the kernel ends it at the limit; \
             `adaptive-bridge units --write` sets the limits of services"
        );
    }
}

/// The lowest limit of the group that `/proc/self/cgroup` names and of those that contain it, in bytes.
fn limit_of(group: &str, read: &dyn Fn(&Path) -> Option<String>) -> Option<u64> {
    let path = group.lines().find_map(|line| line.strip_prefix("0::/"))?;
    let groups = Path::new(path).ancestors();
    groups.filter_map(|group| read(&group.join("memory.max"))?.trim().parse().ok()).min()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_lowest_limit_of_all_groups_counts() {
        let read = |path: &Path| {
            let text = match path.to_str()? {
                "a.slice/b.service/memory.max" => "max\n",
                "a.slice/memory.max" => "4096\n",
                "x.service/memory.max" => "8192\n",
                _ => return None,
            };
            Some(text.to_owned())
        };
        assert_eq!(limit_of("0::/a.slice/b.service\n", &read), Some(4096));
        assert_eq!(limit_of("3:memory:/y\n0::/x.service\n", &read), Some(8192));
        assert_eq!(limit_of("0::/\n", &read), None);
        assert_eq!(limit_of("3:memory:/x.service\n", &read), None);
    }
}
