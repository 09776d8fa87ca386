//! Finds the ROS 2 node of an endpoint in the graph entries of the other participants.

use std::collections::HashMap;

use super::graph::{GraphNode, decode_graph};
use super::reader::{KEPT_SMALL_SAMPLES_BYTES, RawReader, TakePayload};
use crate::model::Guid;

/// The most participants whose entries are kept.
pub const MAX_PARTICIPANTS: usize = 256;
/// The most readers and writers that are kept, of all participants together: 1 MiB of GUIDs.
pub const MAX_GRAPH_ENDPOINTS: usize = 65_536;

/// The most entries that one [`GraphWatch::poll`] takes, so that a flood of them does not delay its caller:
/// one of each participant. The reader has room for twice as many.
const MAX_POLLED_ENTRIES: usize = MAX_PARTICIPANTS;
/// The bytes after which it takes no further entry: half of what the reader keeps.
const MAX_POLLED_BYTES: usize = KEPT_SMALL_SAMPLES_BYTES / 2;

/// The graph entries of the other participants; created by [`Participant::watch_graph`].
///
/// Its memory is bounded whatever the network sends. Create one only where the names of nodes are needed,
/// because it reads the entries of all participants.
///
/// [`Participant::watch_graph`]: super::Participant::watch_graph
pub struct GraphWatch {
    reader: RawReader,
    entries: Entries,
}

/// Counts the samples from which no entry was stored.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GraphRefusals {
    /// Samples that are no graph entry, or an entry for another participant than the sender.
    pub malformed: u64,
    /// Entries beyond [`MAX_PARTICIPANTS`] or [`MAX_GRAPH_ENDPOINTS`].
    pub too_many: u64,
}

impl GraphWatch {
    pub(super) fn new(reader: RawReader) -> Self {
        Self { reader, entries: Entries::default() }
    }

    /// Reads entries that have arrived since the last call: at most 256, or about 2 MiB. The rest waits
    /// in the reader, where newer entries replace older ones.
    pub fn poll(&mut self) {
        let mut bytes = 0;
        for _ in 0..MAX_POLLED_ENTRIES {
            if bytes >= MAX_POLLED_BYTES {
                return;
            }
            match self.reader.take_payload() {
                TakePayload::Sample(origin, mut payload, encapsulation) => {
                    bytes += payload.bytes().len();
                    let prefix = origin.writer.prefix();
                    let own_entry = decode_graph(payload.bytes(), encapsulation)
                        .filter(|entry| entry.participant.prefix() == prefix);
                    match own_entry {
                        Some(entry) => self.entries.insert(prefix, entry.nodes),
                        None => self.entries.refusals.malformed += 1,
                    }
                }
                TakePayload::Malformed => self.entries.refusals.malformed += 1,
                TakePayload::Empty => return,
            }
        }
    }

    /// The node that has this reader or writer, such as `/robot/rviz`; `None` until its participant has
    /// published an entry for it.
    pub fn node_of(&self, endpoint: Guid) -> Option<&str> {
        self.entries.node_of(endpoint)
    }

    /// Removes the entry of a participant that has left or whose lease has expired.
    pub fn participant_gone(&mut self, prefix: [u8; 12]) {
        self.entries.remove(prefix);
    }

    /// The samples from which no entry was stored, since this was created.
    pub fn refusals(&self) -> GraphRefusals {
        self.entries.refusals
    }
}

/// The entries by GUID prefix of the sender, so that no participant can name the endpoints of another one.
#[derive(Default)]
struct Entries {
    nodes_by_participant: HashMap<[u8; 12], Vec<GraphNode>>,
    endpoints: usize,
    refusals: GraphRefusals,
}

impl Entries {
    fn insert(&mut self, prefix: [u8; 12], nodes: Vec<GraphNode>) {
        self.remove(prefix);
        let endpoints = count_endpoints(&nodes);
        if self.nodes_by_participant.len() == MAX_PARTICIPANTS
            || self.endpoints + endpoints > MAX_GRAPH_ENDPOINTS
        {
            self.refusals.too_many += 1;
            return;
        }
        self.endpoints += endpoints;
        self.nodes_by_participant.insert(prefix, nodes);
    }

    fn remove(&mut self, prefix: [u8; 12]) {
        if let Some(nodes) = self.nodes_by_participant.remove(&prefix) {
            self.endpoints -= count_endpoints(&nodes);
        }
    }

    fn node_of(&self, endpoint: Guid) -> Option<&str> {
        let nodes = self.nodes_by_participant.get(&endpoint.prefix())?;
        let has = |node: &&GraphNode| node.readers.contains(&endpoint) || node.writers.contains(&endpoint);
        nodes.iter().find(has).map(|node| node.name.as_str())
    }
}

fn count_endpoints(nodes: &[GraphNode]) -> usize {
    nodes.iter().map(|node| node.readers.len() + node.writers.len()).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn prefix(number: usize) -> [u8; 12] {
        let mut prefix = [0; 12];
        prefix[..8].copy_from_slice(&number.to_le_bytes());
        prefix
    }

    fn guid(participant: usize, entity: usize) -> Guid {
        let mut guid = [0; 16];
        guid[..12].copy_from_slice(&prefix(participant));
        guid[12..].copy_from_slice(&(entity as u32).to_le_bytes());
        Guid(guid)
    }

    fn node(name: &str, participant: usize, readers: usize) -> GraphNode {
        let readers = (0..readers).map(|entity| guid(participant, entity)).collect();
        GraphNode { name: name.into(), readers, writers: vec![guid(participant, 1 << 20)] }
    }

    #[test]
    fn only_its_own_participant_can_name_the_node_of_an_endpoint() {
        let mut entries = Entries::default();
        entries.insert(prefix(1), vec![node("/a", 1, 2), node("/thief", 2, 5)]);
        entries.insert(prefix(2), vec![node("/b", 2, 2)]);
        assert_eq!(entries.node_of(guid(1, 1)), Some("/a"));
        assert_eq!(entries.node_of(guid(1, 1 << 20)), Some("/a"));
        assert_eq!(entries.node_of(guid(2, 1)), Some("/b"));
        assert_eq!(entries.node_of(guid(2, 4)), None, "another participant's claim");
        entries.insert(prefix(1), vec![node("/c", 1, 1)]);
        assert_eq!(entries.node_of(guid(1, 0)), Some("/c"));
        assert_eq!(entries.node_of(guid(1, 1)), None);
        entries.remove(prefix(1));
        assert_eq!(entries.node_of(guid(1, 0)), None);
    }

    #[test]
    fn entries_beyond_the_limits_are_refused() {
        let mut entries = Entries::default();
        for number in 0..MAX_PARTICIPANTS + 10 {
            entries.insert(prefix(number), vec![node("/a", number, 1)]);
        }
        assert_eq!((entries.nodes_by_participant.len(), entries.refusals.too_many), (MAX_PARTICIPANTS, 10));
        entries.insert(prefix(3), vec![node("/b", 3, 1)]);
        assert_eq!(entries.node_of(guid(3, 0)), Some("/b"), "an entry of a known participant is replaced");

        let mut entries = Entries::default();
        for number in 0..10 {
            entries.insert(prefix(number), vec![node("/a", number, 8_000)]);
        }
        assert_eq!((entries.nodes_by_participant.len(), entries.refusals.too_many), (8, 2));
        assert!(entries.endpoints <= MAX_GRAPH_ENDPOINTS);
        for number in 0..10 {
            entries.remove(prefix(number));
        }
        assert_eq!(entries.endpoints, 0);
    }
}
