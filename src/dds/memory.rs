//! The memory that the DDS library may take, from the limits that bound it. Pure.

use crate::model::{Durability, QosProfile, Reliability};

const MIB: u64 = 1 << 20;

/// Receive sockets of a participant: multicast and unicast, of discovery and of samples, and one for urgent
/// topics.
const RECEIVE_SOCKETS: u64 = 5;
/// Send sockets whose buffers can be full at the same time: that of unicast and that of multicast.
const SEND_SOCKETS: u64 = 2;
/// What the kernel counts for a socket buffer of the size that the package allows
/// (`systemd/sysctl.d/00-adaptive-bridge.conf`): twice the 4 MiB that a program asks for.
const SOCKET_BYTES: u64 = 8 * MIB;

/// Participants and endpoints at the limits of discovery, and those that are gone and remembered: 209 MiB
/// with the largest announcements that it accepts (`a_full_database_takes_a_bounded_amount_of_memory` of
/// RustDDS).
const DISCOVERED_BYTES: u64 = 240 * MIB;
/// Topics of discovery, of which a participant has a RELIABLE reader.
const DISCOVERY_TOPICS: u64 = 4;
/// Announcements of one of them that were read (16 MiB), that wait for an earlier one (16 MiB), and
/// unfinished ones (4 MiB).
const DISCOVERY_TOPIC_BYTES: u64 = 36 * MIB;

/// The payload bytes that a RELIABLE writer retains for readers that have not acknowledged them
/// (`KEEP_LAST_MAX_RETAINED_BYTES` of the library), and the samples that it retains whatever their size.
const RETAINED_BYTES: u64 = 32 * MIB;
const RETAINED_SAMPLES: u64 = 2;

/// Complete samples that wait for an earlier one beyond the depth of a reader
/// (`MAX_WITHHELD_BYTES_PER_TOPIC` of the library).
pub const WITHHELD_BYTES: u64 = 16 * MIB;

/// What discovery may take in a participant.
pub const DISCOVERY_BYTES: u64 = DISCOVERED_BYTES + DISCOVERY_TOPICS * DISCOVERY_TOPIC_BYTES;

/// What datagrams may take in the sockets of a participant.
pub const SOCKETS_BYTES: u64 = (RECEIVE_SOCKETS + SEND_SOCKETS) * SOCKET_BYTES;

/// What the history of a writer may take, with the sample that is written.
pub fn history_bytes(qos: &QosProfile, window_samples: usize, max_sample_bytes: usize) -> u64 {
    let (window, sample) = (window_samples as u64, max_sample_bytes as u64);
    let depth = qos.depth().map_or(window, u64::from);
    let for_repairs = match qos.reliability {
        Reliability::Reliable => {
            window.max(depth).saturating_mul(sample).min(RETAINED_BYTES.max(RETAINED_SAMPLES * sample))
        }
        Reliability::BestEffort => 0,
    };
    // Without a reader to repair for, the depth alone bounds it.
    let is_trimmed = qos.reliability == Reliability::BestEffort || qos.durability == Durability::Volatile;
    let for_depth = if is_trimmed { depth.min(window).saturating_mul(sample) } else { 0 };
    for_repairs.max(for_depth).saturating_add(sample)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dds::discovery::MAX_WAITING_CHANGES;
    use crate::model::History;

    #[test]
    fn the_limits_are_those_of_the_library() {
        let file = |path: &str| {
            let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/third_party/rustdds/src/");
            std::fs::read_to_string(format!("{folder}{path}")).unwrap()
        };
        for (path, limit) in [
            ("rtps/constant.rs", "KEEP_LAST_MAX_RETAINED_BYTES: usize = 32 << 20;"),
            ("rtps/constant.rs", "MAX_WITHHELD_BYTES_PER_TOPIC: usize = 16 * 1024 * 1024;"),
            ("rtps/constant.rs", "MAX_KEPT_BYTES_PER_BUILTIN_TOPIC: usize = 16 * 1024 * 1024;"),
            ("dds/lent.rs", "max_total_bytes: 4 * 1024 * 1024,"),
            ("dds/participant.rs", &format!("sync_status_channel({MAX_WAITING_CHANGES})?")),
            ("network_counts.rs", "MAX_PARTICIPANTS: usize = 1_024;"),
            ("network_counts.rs", "MAX_ENDPOINTS: usize = 16_384;"),
            ("network_counts.rs", "MAX_ENDPOINT_BYTES: usize = 2_048;"),
        ] {
            assert!(file(path).contains(limit), "{path} has another limit than {limit}");
        }
        let sysctl = concat!(env!("CARGO_MANIFEST_DIR"), "/systemd/sysctl.d/00-adaptive-bridge.conf");
        let sysctl = std::fs::read_to_string(sysctl).unwrap();
        assert!(sysctl.contains(&format!("net.core.rmem_max={}\n", SOCKET_BYTES / 2)));
    }

    #[test]
    fn a_history_takes_32_mib_or_two_samples_unless_its_depth_needs_more() {
        let reliable = QosProfile::CRITICAL;
        assert_eq!(history_bytes(&reliable, 256, 1_000), 256 * 1_000 + 1_000);
        assert_eq!(history_bytes(&reliable, 256, 1 << 20), 33 * MIB);
        assert_eq!(history_bytes(&reliable, 256, 64 << 20), 11 * 64 * MIB);
        let latched = QosProfile { durability: Durability::TransientLocal, ..reliable };
        assert_eq!(history_bytes(&latched, 256, 64 << 20), 3 * 64 * MIB);
        let keep_all = QosProfile { history: History::KeepAll, ..reliable };
        assert_eq!(history_bytes(&keep_all, 100, 1 << 20), 101 * MIB);
        assert_eq!(history_bytes(&QosProfile::NONCRITICAL, 256, 1 << 20), 6 * MIB);
    }
}
