//! What discovery knows of others, as bytes for a later participant of the same identity.
//!
//! Others answer a participant that they do not know. One that they know waits for their next
//! announcement, some seconds, unless it knows them, too.

use std::collections::BTreeSet;

use crate::{
  discovery::{
    discovery_db::DiscoveryDB,
    sedp_messages::{DiscoveredReaderData, DiscoveredWriterData},
    spdp_participant_data::SpdpDiscoveredParticipantData,
  },
  serialization::pl_cdr_adapters::{PlCdrDeserialize, PlCdrSerialize},
  structure::guid::{EntityId, GuidPrefix},
  RepresentationIdentifier,
};

/// A longer journal is not read.
pub(crate) const MAX_JOURNAL_BYTES: usize = 256 << 10;

/// The most participants in a journal that have no endpoint with a topic of ours. With 1,024 forged ones, as many as
/// a database has, a take-over took up to 154 ms. One that is left out is discovered by its next announcement.
const MAX_OTHERS: usize = 128;

pub(crate) const ENCODING: RepresentationIdentifier = RepresentationIdentifier::PL_CDR_LE;
// The kinds of records. A record is its kind, the length of the announcement, and the
// announcement as it goes over the network, without an encapsulation header.
pub(crate) const PARTICIPANT: u8 = 1;
pub(crate) const READER: u8 = 2;
const WRITER: u8 = 3;

/// A record of a journal.
#[derive(Debug)]
pub(crate) enum Known {
  Participant(SpdpDiscoveredParticipantData),
  Reader(DiscoveredReaderData),
  Writer(DiscoveredWriterData),
}

/// The participants in the database but `own`, each followed by its readers and writers of topics of ours.
///
/// Those that have such an endpoint are first, the ones discovered first at the front. A participant for which
/// there is no room is left out.
pub(crate) fn write(db: &DiscoveryDB, own: GuidPrefix) -> Vec<u8> {
  let participants = db.participants_by_age().filter(|(prefix, _)| *prefix != own);
  let (with_our_topics, others): (Vec<_>, Vec<_>) =
    participants.partition(|(prefix, _)| db.has_endpoint_with_local_topic(*prefix));
  let mut journal = Vec::new();
  for (prefix, participant) in with_our_topics.into_iter().chain(others.into_iter().take(MAX_OTHERS)) {
    let end = journal.len();
    append(&mut journal, PARTICIPANT, participant);
    for reader in db.readers_of_local_topics(prefix) {
      append(&mut journal, READER, reader);
    }
    for writer in db.writers_of_local_topics(prefix) {
      append(&mut journal, WRITER, writer);
    }
    if journal.len() > MAX_JOURNAL_BYTES {
      journal.truncate(end);
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
/// malformed, is that of `own`, or is an endpoint's without its participant before it.
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
      WRITER => {
        let data = DiscoveredWriterData::from_pl_cdr_bytes(bytes, ENCODING).ok()?;
        if !prefixes.contains(&data.writer_proxy.remote_writer_guid.prefix) {
          return None;
        }
        Known::Writer(data)
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
    discovery::discovery_db::tests::{new_participant, new_reader, new_writer},
    structure::guid::GUID,
  };

  // The journal of a database with two participants, of which one has a reader and a writer of
  // a topic of ours and of another topic; and the former two.
  fn journal() -> (Vec<u8>, GUID, GUID) {
    let (updated_sender, _updated_receiver) = std::sync::mpsc::sync_channel::<()>(4);
    let (status_sender, _status_receiver) = sync_status_channel(16).unwrap();
    let own = GUID::new_participant_guid();
    let mut db = DiscoveryDB::new(own, updated_sender, status_sender);
    db.update_local_topic_reader(new_reader(own, 1, "ours"));
    let mut own_data = new_participant();
    own_data.participant_guid = own;
    let (with_endpoints, without) = (new_participant(), new_participant());
    for data in [&own_data, &with_endpoints, &without] {
      db.update_participant(data);
    }
    let participant = with_endpoints.participant_guid;
    let (reader, writer) = (new_reader(participant, 2, "ours"), new_writer(participant, 4, "ours"));
    db.update_subscription(&reader);
    db.update_subscription(&new_reader(participant, 3, "another"));
    db.update_publication(&writer);
    db.update_publication(&new_writer(participant, 5, "another"));
    let guids = (reader.reader_proxy.remote_reader_guid, writer.writer_proxy.remote_writer_guid);
    (write(&db, own.prefix), guids.0, guids.1)
  }

  // The participants in the journal of a database in which those with that many writers of a topic of ours were
  // discovered, and those.
  fn written(writers: &[u32]) -> (Vec<GuidPrefix>, Vec<GuidPrefix>) {
    let (updated_sender, _updated_receiver) = std::sync::mpsc::sync_channel::<()>(4);
    let (status_sender, _status_receiver) = sync_status_channel(16).unwrap();
    let own = GUID::new_participant_guid();
    let mut db = DiscoveryDB::new(own, updated_sender, status_sender);
    db.update_local_topic_reader(new_reader(own, 1, "ours"));
    let mut discovered = Vec::new();
    for writers in writers {
      let data = new_participant();
      db.update_participant(&data);
      for key in 0..*writers {
        db.update_publication(&new_writer(data.participant_guid, key, "ours"));
      }
      discovered.push(data.participant_guid.prefix);
    }
    let known = read(&write(&db, own.prefix), own.prefix).expect("longer than what is read");
    let in_journal = known.iter().filter_map(|known| match known {
      Known::Participant(data) => Some(data.participant_guid.prefix),
      _ => None,
    });
    (in_journal.collect(), discovered)
  }

  #[test]
  fn a_journal_has_those_with_a_topic_of_ours_first_and_a_limited_number_of_others() {
    let others = MAX_OTHERS + 10;
    let mut writers = vec![0; others];
    writers.extend([1; 20]);
    let (in_journal, discovered) = written(&writers);
    let expected = [&discovered[others..], &discovered[..MAX_OTHERS]].concat();
    assert_eq!(in_journal, expected);
  }

  // A journal that is too long would not be read at all.
  #[test]
  fn a_journal_has_as_many_as_it_has_room_for() {
    let (in_journal, discovered) = written(&[250; 20]);
    assert!((1..20).contains(&in_journal.len()), "{} participants", in_journal.len());
    assert_eq!(in_journal, discovered[..in_journal.len()]);
  }

  fn other() -> GuidPrefix {
    GUID::new_participant_guid().prefix
  }

  #[test]
  fn a_journal_has_the_others_and_their_endpoints_of_our_topics() {
    let (bytes, reader, writer) = journal();
    let known = read(&bytes, other()).unwrap();
    let endpoints: Vec<GUID> = known
      .iter()
      .filter_map(|known| match known {
        Known::Reader(data) => Some(data.reader_proxy.remote_reader_guid),
        Known::Writer(data) => Some(data.writer_proxy.remote_writer_guid),
        Known::Participant(_) => None,
      })
      .collect();
    assert_eq!((known.len(), endpoints), (4, vec![reader, writer]));
    assert!(read(&[], other()).unwrap().is_empty());
    // What this participant says of itself.
    assert!(read(&bytes, reader.prefix).is_none());
  }

  // No byte sequence makes it panic, and none is taken in part.
  #[test]
  fn a_torn_or_changed_journal_is_refused_or_read_whole() {
    let (bytes, ..) = journal();
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

  // An endpoint alone could be one of any participant.
  #[test]
  fn an_endpoint_without_its_participant_is_refused() {
    let (bytes, ..) = journal();
    let known = read(&bytes, other()).unwrap();
    let alone: Vec<Vec<u8>> = known
      .iter()
      .filter_map(|known| {
        let mut bytes = Vec::new();
        match known {
          Known::Reader(data) => append(&mut bytes, READER, data),
          Known::Writer(data) => append(&mut bytes, WRITER, data),
          Known::Participant(_) => return None,
        }
        Some(bytes)
      })
      .collect();
    assert_eq!(alone.len(), 2);
    assert!(alone.iter().all(|alone| read(alone, other()).is_none()));
  }
}
