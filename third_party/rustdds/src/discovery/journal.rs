//! What discovery knows of others, as bytes for a later participant of the same identity.
//!
//! Others answer a participant that they do not know. One that they know waits for their next
//! announcement, some seconds, unless it knows them, too.

use std::collections::BTreeSet;

use crate::{
  discovery::{
    discovery_db::DiscoveryDB, sedp_messages::DiscoveredReaderData,
    spdp_participant_data::SpdpDiscoveredParticipantData,
  },
  serialization::pl_cdr_adapters::{PlCdrDeserialize, PlCdrSerialize},
  structure::guid::{EntityId, GuidPrefix},
  RepresentationIdentifier,
};

/// A longer journal is not read.
pub(crate) const MAX_JOURNAL_BYTES: usize = 256 << 10;

pub(crate) const ENCODING: RepresentationIdentifier = RepresentationIdentifier::PL_CDR_LE;
// The kinds of records. A record is its kind, the length of the announcement, and the
// announcement as it goes over the network, without an encapsulation header.
const PARTICIPANT: u8 = 1;
pub(crate) const READER: u8 = 2;

/// A record of a journal.
#[derive(Debug)]
pub(crate) enum Known {
  Participant(SpdpDiscoveredParticipantData),
  Reader(DiscoveredReaderData),
}

/// The participants in the database but `own`, each followed by its readers of topics of ours.
pub(crate) fn write(db: &DiscoveryDB, own: GuidPrefix) -> Vec<u8> {
  let mut journal = Vec::new();
  for prefix in db.participant_prefixes(|data| data.participant_guid.prefix != own) {
    let Some(participant) = db.find_participant_proxy(prefix) else {
      continue;
    };
    append(&mut journal, PARTICIPANT, participant);
    for reader in db.readers_of_local_topics(prefix) {
      append(&mut journal, READER, reader);
    }
  }
  journal
}

pub(crate) fn append(journal: &mut Vec<u8>, kind: u8, announcement: &impl PlCdrSerialize) {
  let Ok(bytes) = announcement.to_pl_cdr_bytes(ENCODING) else {
    return; // it cannot be announced either
  };
  journal.push(kind);
  journal.extend((bytes.len() as u32).to_le_bytes());
  journal.extend(bytes);
}

/// The kind and the announcement of the first record, which is taken off. `None` if it is torn.
pub(crate) fn next_record<'a>(journal: &mut &'a [u8]) -> Option<(u8, &'a [u8])> {
  let (&kind, rest) = journal.split_first()?;
  let (length, rest) = rest.split_first_chunk()?;
  let length = usize::try_from(u32::from_le_bytes(*length)).ok()?;
  let (announcement, rest) = rest.split_at_checked(length)?;
  *journal = rest;
  Some((kind, announcement))
}

/// Reads a journal as what comes from the network, and all of it: `None` if any record is
/// malformed, is that of `own`, or is a reader's without its participant before it.
pub(crate) fn read(mut journal: &[u8], own: GuidPrefix) -> Option<Vec<Known>> {
  if journal.len() > MAX_JOURNAL_BYTES {
    return None;
  }
  let mut known = Vec::new();
  let mut prefixes = BTreeSet::new();
  while !journal.is_empty() {
    let (kind, bytes) = next_record(&mut journal)?;
    known.push(match kind {
      PARTICIPANT => {
        let data = SpdpDiscoveredParticipantData::from_pl_cdr_bytes(bytes, ENCODING).ok()?;
        let guid = data.participant_guid;
        if guid.entity_id != EntityId::PARTICIPANT || guid.prefix == own {
          return None;
        }
        prefixes.insert(guid.prefix);
        Known::Participant(data)
      }
      READER => {
        let data = DiscoveredReaderData::from_pl_cdr_bytes(bytes, ENCODING).ok()?;
        if !prefixes.contains(&data.reader_proxy.remote_reader_guid.prefix) {
          return None;
        }
        Known::Reader(data)
      }
      _ => return None,
    });
  }
  Some(known)
}

#[cfg(test)]
mod tests {
  use super::*;
  use crate::{
    dds::statusevents::sync_status_channel,
    discovery::discovery_db::tests::{new_participant, new_reader},
    structure::guid::GUID,
  };

  // The journal of a database with two participants, of which one has a reader of a topic of
  // ours and one of another topic; and the former reader.
  fn journal() -> (Vec<u8>, GUID) {
    let (updated_sender, _updated_receiver) = std::sync::mpsc::sync_channel::<()>(4);
    let (status_sender, _status_receiver) = sync_status_channel(16).unwrap();
    let own = GUID::new_participant_guid();
    let mut db = DiscoveryDB::new(own, updated_sender, status_sender);
    db.update_local_topic_reader(new_reader(own, 1, "ours"));
    let mut own_data = new_participant();
    own_data.participant_guid = own;
    let (with_reader, without) = (new_participant(), new_participant());
    for data in [&own_data, &with_reader, &without] {
      db.update_participant(data);
    }
    let participant = with_reader.participant_guid;
    let reader = new_reader(participant, 2, "ours");
    db.update_subscription(&reader);
    db.update_subscription(&new_reader(participant, 3, "another"));
    (write(&db, own.prefix), reader.reader_proxy.remote_reader_guid)
  }

  fn other() -> GuidPrefix {
    GUID::new_participant_guid().prefix
  }

  #[test]
  fn a_journal_has_the_others_and_their_readers_of_our_topics() {
    let (bytes, reader) = journal();
    let known = read(&bytes, other()).unwrap();
    let readers: Vec<GUID> = known
      .iter()
      .filter_map(|known| match known {
        Known::Reader(data) => Some(data.reader_proxy.remote_reader_guid),
        Known::Participant(_) => None,
      })
      .collect();
    assert_eq!((known.len(), readers), (3, vec![reader]));
    assert!(read(&[], other()).unwrap().is_empty());
    // What this participant says of itself.
    assert!(read(&bytes, reader.prefix).is_none());
  }

  // No byte sequence makes it panic, and none is taken in part.
  #[test]
  fn a_torn_or_changed_journal_is_refused_or_read_whole() {
    let (bytes, _) = journal();
    let mut ends = Vec::new();
    let mut end = 0;
    while end < bytes.len() {
      ends.push(end);
      let length = u32::from_le_bytes(bytes[end + 1..end + 5].try_into().unwrap());
      end += 5 + length as usize;
    }
    for torn in 0..bytes.len() {
      let records = ends.iter().position(|end| *end == torn);
      let known = read(&bytes[..torn], other()).map(|known| known.len());
      assert_eq!(known, records, "{torn} of {} bytes", bytes.len());
    }
    for at in 0..bytes.len() {
      for bit in 0..8 {
        let mut changed = bytes.clone();
        changed[at] ^= 1 << bit;
        if let Some(known) = read(&changed, other()) {
          assert!(known.len() <= ends.len());
        }
      }
    }
    for seed in 0..2_000_u32 {
      let mut state = u64::from(seed) + 1;
      let noise: Vec<u8> = (0..seed % 300)
        .map(|_| {
          state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
          (state >> 33) as u8
        })
        .collect();
      let _ = read(&noise, other());
    }
    assert!(read(&vec![0; MAX_JOURNAL_BYTES + 1], other()).is_none());
  }

  // A reader alone could be one of any participant.
  #[test]
  fn a_reader_without_its_participant_is_refused() {
    let (bytes, _) = journal();
    let known = read(&bytes, other()).unwrap();
    let alone: Vec<Vec<u8>> = known
      .iter()
      .filter_map(|known| match known {
        Known::Reader(data) => {
          let mut bytes = Vec::new();
          append(&mut bytes, READER, data);
          Some(bytes)
        }
        Known::Participant(_) => None,
      })
      .collect();
    assert_eq!(alone.len(), 1);
    assert!(read(&alone[0], other()).is_none());
  }
}
