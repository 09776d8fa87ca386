//! Encodes and decodes entries of the ROS 2 graph, which name the nodes of a participant and their endpoints.
//!
//! ROS 2 maps nodes to DDS participants by `rmw_dds_common/msg/ParticipantEntitiesInfo` on the DDS topic
//! `ros_discovery_info`. ros2-client publishes such an entry only for endpoints that it created itself, and
//! its readers and writers decode payloads; so this module encodes the entry of the raw endpoints. Each
//! process of the bridge is one node.

use byteorder::{BigEndian, ByteOrder, LittleEndian};
use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::model::{DdsType, Encapsulation, Guid, TypeHash};

/// The most nodes of one participant that are accepted; a component container has tens of them.
const MAX_NODES: usize = 256;
/// The most readers and writers of one participant that are accepted. A node has about fifteen.
const MAX_ENDPOINTS: usize = 8_192;
/// The longest namespace or node name, as in ROS 2 (`rmw_validate_node_name`).
const MAX_NAME_BYTES: usize = 255;

pub(super) const TOPIC: &str = "ros_discovery_info";
/// The DDS type of the graph entries.
pub(super) const TYPE: DdsType = DdsType {
    name: "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_",
    hash: TypeHash::from_hex(b"91a0593bacdcc50ea9bdcf849a938b128412cc1ea821245c663bcd26f83c295e"),
    has_keys: false,
};

/// `rmw_dds_common/msg/ParticipantEntitiesInfo`: the identifiers of the participant and, of each node, its
/// namespace, its name, its readers and its writers. An identifier is a GUID, then zeros.
type Message<Gid> = (Gid, Vec<(String, String, Vec<Gid>, Vec<Gid>)>);

/// Encodes the entry of a participant with one node in plain little-endian CDR (RTPS 2.5 clause 10), without
/// the encapsulation header.
///
/// `gid_bytes` is the length of `rmw_dds_common/msg/Gid`: 24 up to ROS 2 Humble, 16 since Iron.
pub fn encode_graph(
    participant: Guid,
    namespace: &str,
    node: &str,
    readers: &[Guid],
    writers: &[Guid],
    gid_bytes: usize,
) -> Vec<u8> {
    let encode = if gid_bytes == 24 { encode::<24> } else { encode::<16> };
    encode(participant, namespace, node, readers, writers)
}

fn encode<const N: usize>(
    participant: Guid,
    namespace: &str,
    node: &str,
    readers: &[Guid],
    writers: &[Guid],
) -> Vec<u8>
where
    [u8; N]: Serialize,
{
    let gid = |guid: &Guid| -> [u8; N] { std::array::from_fn(|at| guid.0.get(at).copied().unwrap_or(0)) };
    let gids = |guids: &[Guid]| guids.iter().map(gid).collect();
    let node = (namespace.to_owned(), node.to_owned(), gids(readers), gids(writers));
    let message: Message<[u8; N]> = (gid(&participant), vec![node]);
    // Writing to memory does not fail.
    cdr_encoding::to_vec::<_, LittleEndian>(&message).unwrap_or_default()
}

/// A decoded graph entry: the nodes of one participant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GraphEntry {
    /// The participant.
    pub participant: Guid,
    /// Its nodes.
    pub nodes: Vec<GraphNode>,
}

/// A node of a graph entry.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GraphNode {
    /// Its namespace and name, such as `/robot/rviz`.
    pub name: String,
    /// Its readers.
    pub readers: Vec<Guid>,
    /// Its writers.
    pub writers: Vec<Guid>,
}

/// Decodes an entry in plain CDR of either byte order, with identifiers of 16 or 24 bytes; `None` for
/// anything else, for an entry of more than 256 nodes or 8,192 endpoints, and for names that ROS 2 does not
/// allow.
///
/// Only one length of the identifiers fits an entry. An entry with a node has the number of nodes after 16
/// bytes if its identifiers are short, and zeros there if they are long; an entry without a node is too short
/// for long identifiers.
pub fn decode_graph(cdr: &[u8], encapsulation: Encapsulation) -> Option<GraphEntry> {
    match encapsulation.representation() {
        [0, 0] => decode::<16, BigEndian>(cdr).or_else(|| decode::<24, BigEndian>(cdr)),
        [0, 1] => decode::<16, LittleEndian>(cdr).or_else(|| decode::<24, LittleEndian>(cdr)),
        _ => None,
    }
}

fn decode<const N: usize, Order: ByteOrder>(cdr: &[u8]) -> Option<GraphEntry>
where
    [u8; N]: DeserializeOwned,
{
    let ((participant, nodes), used) = cdr_encoding::from_bytes::<Message<[u8; N]>, Order>(cdr).ok()?;
    let endpoints: usize = nodes.iter().map(|(.., readers, writers)| readers.len() + writers.len()).sum();
    // RTPS pads a payload to a multiple of 4 bytes.
    if cdr.len() - used > 3 || nodes.len() > MAX_NODES || endpoints > MAX_ENDPOINTS {
        return None;
    }
    let guid = |gid: &[u8; N]| {
        let (guid, rest) = gid.split_first_chunk::<16>()?;
        rest.iter().all(|&byte| byte == 0).then_some(Guid(*guid))
    };
    let guids = |gids: Vec<[u8; N]>| gids.iter().map(guid).collect::<Option<Vec<_>>>();
    let nodes = nodes.into_iter().map(|(namespace, name, readers, writers)| {
        let name = full_name(namespace, name)?;
        Some(GraphNode { name, readers: guids(readers)?, writers: guids(writers)? })
    });
    Some(GraphEntry { participant: guid(&participant)?, nodes: nodes.collect::<Option<_>>()? })
}

/// Joins namespace and name: `/robot` and `rviz` are `/robot/rviz`. Names are printed in logs and terminals,
/// so only those that ROS 2 allows are accepted: tokens of A-Z, a-z, 0-9 and _.
fn full_name(namespace: String, name: String) -> Option<String> {
    let is_token = |token: &str| {
        !token.is_empty() && token.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_')
    };
    let tokens = namespace.strip_prefix('/')?;
    if namespace.len().max(name.len()) > MAX_NAME_BYTES
        || !is_token(&name)
        || !(tokens.is_empty() || tokens.split('/').all(is_token))
    {
        return None;
    }
    Some(if tokens.is_empty() { format!("/{name}") } else { format!("{namespace}/{name}") })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_entry_has_the_layout_of_the_message_definition() {
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

    fn entry(nodes: &[(&str, u8)]) -> GraphEntry {
        let node = |&(name, id): &(&str, u8)| GraphNode {
            name: name.to_owned(),
            readers: vec![Guid([id; 16]), Guid([id + 1; 16])],
            writers: vec![Guid([id + 2; 16])],
        };
        GraphEntry { participant: Guid([1; 16]), nodes: nodes.iter().map(node).collect() }
    }

    fn encoded(namespace: &str, name: &str, gid_bytes: usize) -> Vec<u8> {
        let (readers, writers) = ([Guid([2; 16]), Guid([3; 16])], [Guid([4; 16])]);
        encode_graph(Guid([1; 16]), namespace, name, &readers, &writers, gid_bytes)
    }

    fn decoded(cdr: &[u8]) -> Option<GraphEntry> {
        decode_graph(cdr, Encapsulation::CDR_LE)
    }

    #[test]
    fn the_length_of_the_identifiers_is_detected() {
        for gid_bytes in [16, 24] {
            let cdr = encoded("/robot", "rviz", gid_bytes);
            assert_eq!(decoded(&cdr), Some(entry(&[("/robot/rviz", 2)])));
            // Padded to a multiple of 4 bytes.
            assert_eq!(decoded(&[&cdr[..], &[0; 3]].concat()), Some(entry(&[("/robot/rviz", 2)])));
            // Without a node, as from a participant that has just been created.
            let mut none = vec![1; 16];
            none.resize(gid_bytes + 4, 0);
            assert_eq!(decoded(&none), Some(entry(&[])));
        }
        assert_eq!(decoded(&encoded("/", "rviz", 16)), Some(entry(&[("/rviz", 2)])));
    }

    #[test]
    fn an_entry_of_several_nodes_and_of_the_other_byte_order_is_decoded() {
        let mut cdr = vec![1; 16];
        cdr.extend([0, 0, 0, 2]);
        for (name, id) in [(b'a', 2), (b'b', 5)] {
            cdr.extend([0, 0, 0, 3, b'/', b'n', 0, 0]);
            cdr.extend([0, 0, 0, 2, name, 0, 0, 0]);
            cdr.extend([0, 0, 0, 2]);
            cdr.extend([id; 16]);
            cdr.extend([id + 1; 16]);
            cdr.extend([0, 0, 0, 1]);
            cdr.extend([id + 2; 16]);
        }
        let read = decode_graph(&cdr, Encapsulation([0, 0, 0, 0]));
        assert_eq!(read, Some(entry(&[("/n/a", 2), ("/n/b", 5)])));
        assert_eq!(decoded(&cdr), None, "in the wrong byte order");
        assert_eq!(decode_graph(&cdr, Encapsulation([0, 7, 0, 0])), None, "in XCDR2");
    }

    #[test]
    fn a_truncated_entry_and_one_with_false_counts_are_rejected() {
        for gid_bytes in [16, 24] {
            let cdr = encoded("/robot", "rviz", gid_bytes);
            for length in 0..cdr.len() {
                // A long identifier that is cut off after its first zeros is also an entry with a short
                // identifier and no node.
                let read = decoded(&cdr[..length]);
                assert!(read.is_none_or(|entry| entry.nodes.is_empty()), "{length} of {} bytes", cdr.len());
            }
            assert_eq!(decoded(&[&cdr[..], &[0; 4]].concat()), None);
            // Each word in turn has the largest value.
            for word in 0..cdr.len() / 4 {
                let mut forged = cdr.clone();
                forged[word * 4..][..4].fill(0xff);
                let _ = decoded(&forged);
            }
            let mut many = cdr.clone();
            many[gid_bytes..][..4].copy_from_slice(&u32::MAX.to_le_bytes());
            assert_eq!(decoded(&many), None);
        }
    }

    #[test]
    fn names_that_ros_does_not_allow_are_rejected() {
        for (namespace, name) in [
            ("/", ""),
            ("", "a"),
            ("a", "b"),
            ("//", "a"),
            ("/a/", "b"),
            ("/", "a/b"),
            ("/", "a b"),
            ("/", "a\n"),
            ("/\u{1b}[2J", "a"),
        ] {
            assert_eq!(decoded(&encoded(namespace, name, 16)), None, "{namespace:?} {name:?}");
        }
        assert_eq!(decoded(&encoded("/", &"a".repeat(256), 16)), None);
        assert!(decoded(&encoded("/", &"a".repeat(255), 24)).is_some());
    }

    #[test]
    fn identifiers_of_humble_are_padded_to_24_bytes() {
        let cdr = encode_graph(Guid([1; 16]), "/", "ab", &[], &[], 24);
        assert_eq!(cdr[..24], [[1; 16].as_slice(), &[0; 8]].concat());
    }
}
