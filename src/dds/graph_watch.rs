//! Which node of the ROS 2 graph an endpoint belongs to, as the other participants say.

use std::collections::HashMap;

use super::graph::{GraphNode, decode_graph};
use super::reader::{RawReader, Take};
use crate::model::Guid;

/// Participants whose entries are kept.
pub const MAX_PARTICIPANTS: usize = 256;
/// Readers and writers that are kept, of all participants together: 1 MiB of GUIDs.
pub const MAX_GRAPH_ENDPOINTS: usize = 65_536;

/// The graph entries of the other participants, made by [`Participant::watch_graph`].
///
/// Its memory is bounded whatever the network says. Only who asks for nodes should have one: it takes in
/// whatever any participant announces.
///
/// [`Participant::watch_graph`]: super::Participant::watch_graph
pub struct GraphWatch {
    reader: RawReader,
    entries: Entries,
}

/// What did not become an entry.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct GraphRefusals {
    /// Samples that are no graph entry, or that speak of another participant than the one that sent them.
    pub malformed: u64,
    /// Entries beyond [`MAX_PARTICIPANTS`] or [`MAX_GRAPH_ENDPOINTS`].
    pub too_many: u64,
}

impl GraphWatch {
    pub(super) fn new(reader: RawReader) -> Self {
        Self { reader, entries: Entries::default() }
    }

    /// Takes in what has come since the last time.
    pub fn poll(&mut self) {
        loop {
            let mut decoded = None;
            let taken =
                self.reader.take(&mut |cdr, encapsulation| decoded = decode_graph(cdr, encapsulation));
            match taken {
                Take::Sample(origin) => {
                    let from_itself =
                        decoded.filter(|entry| entry.participant.prefix() == origin.writer.prefix());
                    match from_itself {
                        Some(entry) => self.entries.put(origin.writer.prefix(), entry.nodes),
                        None => self.entries.refusals.malformed += 1,
                    }
                }
                Take::Malformed => self.entries.refusals.malformed += 1,
                Take::Empty => return,
            }
        }
    }

    /// The node that has this reader or writer, such as `/robot/rviz`; `None` until its participant has said
    /// so.
    pub fn node_of(&self, endpoint: Guid) -> Option<&str> {
        self.entries.node_of(endpoint)
    }

    /// Forgets a participant that is gone.
    pub fn participant_gone(&mut self, prefix: [u8; 12]) {
        self.entries.remove(prefix);
    }

    /// Participants whose entries are kept.
    pub fn participants(&self) -> usize {
        self.entries.of.len()
    }

    /// What did not become an entry, since the beginning.
    pub fn refusals(&self) -> GraphRefusals {
        self.entries.refusals
    }
}

/// The entries, by the prefix of the participant that sent them: nobody speaks for another.
#[derive(Default)]
struct Entries {
    of: HashMap<[u8; 12], Vec<GraphNode>>,
    endpoints: usize,
    refusals: GraphRefusals,
}

impl Entries {
    fn put(&mut self, prefix: [u8; 12], nodes: Vec<GraphNode>) {
        self.remove(prefix);
        let endpoints = endpoints_of(&nodes);
        if self.of.len() == MAX_PARTICIPANTS || self.endpoints + endpoints > MAX_GRAPH_ENDPOINTS {
            self.refusals.too_many += 1;
            return;
        }
        self.endpoints += endpoints;
        self.of.insert(prefix, nodes);
    }

    fn remove(&mut self, prefix: [u8; 12]) {
        if let Some(nodes) = self.of.remove(&prefix) {
            self.endpoints -= endpoints_of(&nodes);
        }
    }

    fn node_of(&self, endpoint: Guid) -> Option<&str> {
        let nodes = self.of.get(&endpoint.prefix())?;
        let has = |node: &&GraphNode| node.readers.contains(&endpoint) || node.writers.contains(&endpoint);
        nodes.iter().find(has).map(|node| node.name.as_str())
    }
}

fn endpoints_of(nodes: &[GraphNode]) -> usize {
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
    fn an_endpoint_is_that_of_its_own_participants_node() {
        let mut entries = Entries::default();
        entries.put(prefix(1), vec![node("/a", 1, 2), node("/thief", 2, 5)]);
        entries.put(prefix(2), vec![node("/b", 2, 2)]);
        assert_eq!(entries.node_of(guid(1, 1)), Some("/a"));
        assert_eq!(entries.node_of(guid(1, 1 << 20)), Some("/a"));
        assert_eq!(entries.node_of(guid(2, 1)), Some("/b"));
        assert_eq!(entries.node_of(guid(2, 4)), None, "another participant's claim");
        entries.put(prefix(1), vec![node("/c", 1, 1)]);
        assert_eq!(entries.node_of(guid(1, 0)), Some("/c"));
        assert_eq!(entries.node_of(guid(1, 1)), None);
        entries.remove(prefix(1));
        assert_eq!(entries.node_of(guid(1, 0)), None);
    }

    #[test]
    fn no_more_is_kept_than_the_limits_allow() {
        let mut entries = Entries::default();
        for number in 0..MAX_PARTICIPANTS + 10 {
            entries.put(prefix(number), vec![node("/a", number, 1)]);
        }
        assert_eq!((entries.of.len(), entries.refusals.too_many), (MAX_PARTICIPANTS, 10));
        entries.put(prefix(3), vec![node("/b", 3, 1)]);
        assert_eq!(entries.node_of(guid(3, 0)), Some("/b"), "a known one is renewed");

        let mut entries = Entries::default();
        for number in 0..10 {
            entries.put(prefix(number), vec![node("/a", number, 8_000)]);
        }
        assert_eq!((entries.of.len(), entries.refusals.too_many), (8, 2));
        assert!(entries.endpoints <= MAX_GRAPH_ENDPOINTS);
        for number in 0..10 {
            entries.remove(prefix(number));
        }
        assert_eq!(entries.endpoints, 0);
    }
}
