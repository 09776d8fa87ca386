//! The ROS 2 graph: each process is one node, and says which endpoints belong to it.
//!
//! ROS 2 maps nodes to DDS participants by `rmw_dds_common/msg/ParticipantEntitiesInfo` on the DDS topic
//! `ros_discovery_info`. ros2-client keeps such an entry only for endpoints that it made itself, and its
//! readers and writers decode what they carry; so the entry for our raw endpoints is encoded here.

use crate::model::{Encapsulation, Guid};

/// Topic of the graph entries.
pub(super) const TOPIC: &str = "ros_discovery_info";
/// Type of the graph entries.
pub(super) const TYPE: &str = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";

/// The entry of a participant with one node, in plain little-endian CDR (RTPS 2.5 clause 10, without the
/// encapsulation header).
///
/// `gid_bytes` is the length of `rmw_dds_common/msg/Gid`: 24 up to ROS 2 Humble, 16 since Iron. A GUID fills
/// the first 16; the rest is zero.
pub fn encode_graph(
    participant: Guid,
    namespace: &str,
    node: &str,
    readers: &[Guid],
    writers: &[Guid],
    gid_bytes: usize,
) -> Vec<u8> {
    let mut cdr = Vec::with_capacity(128 + gid_bytes * (1 + readers.len() + writers.len()));
    put_gid(&mut cdr, participant, gid_bytes);
    put_u32(&mut cdr, 1);
    put_string(&mut cdr, namespace);
    put_string(&mut cdr, node);
    for guids in [readers, writers] {
        put_u32(&mut cdr, guids.len() as u32);
        for guid in guids {
            put_gid(&mut cdr, *guid, gid_bytes);
        }
    }
    cdr
}

/// The encapsulation of [`encode_graph`]'s result.
pub(super) const ENCAPSULATION: Encapsulation = Encapsulation::CDR_LE;

fn put_gid(cdr: &mut Vec<u8>, guid: Guid, gid_bytes: usize) {
    let end = cdr.len() + gid_bytes;
    cdr.extend_from_slice(&guid.0);
    cdr.resize(end, 0);
}

fn put_u32(cdr: &mut Vec<u8>, value: u32) {
    cdr.resize(cdr.len().next_multiple_of(4), 0);
    cdr.extend_from_slice(&value.to_le_bytes());
}

/// A CDR string: its length with the terminating zero, its bytes, the zero.
fn put_string(cdr: &mut Vec<u8>, text: &str) {
    put_u32(cdr, text.len() as u32 + 1);
    cdr.extend_from_slice(text.as_bytes());
    cdr.push(0);
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_entry_is_laid_out_as_the_message_definition_says() {
        let cdr = encode_graph(Guid([1; 16]), "/", "ab", &[Guid([2; 16])], &[], 16);
        let mut expected = vec![1; 16];
        expected.extend([1, 0, 0, 0]);
        expected.extend([2, 0, 0, 0, b'/', 0, 0, 0]);
        expected.extend([3, 0, 0, 0, b'a', b'b', 0, 0]);
        expected.extend([1, 0, 0, 0]);
        expected.extend([2; 16]);
        expected.extend([0, 0, 0, 0]);
        assert_eq!(cdr, expected);
    }

    #[test]
    fn identifiers_of_older_distributions_are_longer() {
        let cdr = encode_graph(Guid([1; 16]), "/", "ab", &[], &[], 24);
        assert_eq!(cdr[..24], [[1; 16].as_slice(), &[0; 8]].concat());
    }
}
