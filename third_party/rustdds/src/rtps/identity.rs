//! What a participant takes over from one of a former process, so that others take it for
//! the same one.

use std::sync::atomic::{AtomicI32, AtomicI64, Ordering};

use bytes::Bytes;

use crate::{
  dds::{
    ddsdata::DDSData,
    with_key::datawriter::{WriteOptions, WriteOptionsBuilder},
  },
  messages::submessages::elements::serialized_payload::SerializedPayload,
  structure::{guid::GUID, sequence_number::SequenceNumber},
  RepresentationIdentifier, Timestamp,
};

/// The identity of a participant. Another process may continue it once its process is gone
/// and has not said goodbye: readers and writers of others then stay matched.
///
/// Both numbers may be higher than what was used; readers ignore what is not above the
/// numbers that they have seen of a GUID.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ParticipantIdentity {
  /// The GUID prefix.
  pub prefix: [u8; 12],
  /// The participant id, which gives the UDP ports (RTPS 2.5, clause 9.6.2.3).
  pub participant_id: u16,
  /// The UDP port of [urgent topics](crate::DomainParticipantBuilder::with_urgent_topics); 0
  /// without them.
  pub urgent_port: u16,
  /// The highest count of any HEARTBEAT, ACKNACK or NACK_FRAG.
  pub highest_count: i32,
  /// The highest sequence number of any built-in writer.
  pub highest_number: i64,
}

impl ParticipantIdentity {
  // Half of the range is left for what the participant itself sends.
  pub(crate) fn is_valid(&self) -> bool {
    self.participant_id < 120
      && (0..i32::MAX / 2).contains(&self.highest_count)
      && (0..i64::MAX / 2).contains(&self.highest_number)
  }
}

/// How a user's writer continues one of a former process.
pub struct ContinuedWriter {
  /// The first three bytes of the entity id, which the participant must give to no other
  /// writer: it counts its own from 0.
  pub entity_key: [u8; 3],
  /// The first sample gets the number after this one; 0 for a writer that is new. It must be
  /// the highest number that the former writer sent: of a lower one readers discard samples
  /// without a word, and of a higher one they report samples as lost.
  pub highest_number: i64,
  /// The last samples of the former writer, in the order of their numbers and up to
  /// `highest_number`. A number between them that is missing is that of a sample that was
  /// withdrawn. Only for VOLATILE writers of topics without keys.
  pub samples: Vec<ContinuedSample>,
  /// The samples up to this number were sent; the others are sent now, again if they were.
  pub sent_through: i64,
  /// The readers that were matched with the former writer. They are offered `samples`; others
  /// are offered what is sent after they were matched.
  pub readers: Vec<GUID>,
  /// Called with each number before the first datagram with it is sent, by the thread that
  /// writes or by the event loop, and with whether it is that of a written sample: another one
  /// may still be withdrawn. It must return at once and call nothing of the library.
  pub on_number: Box<dyn Fn(i64, bool) + Send + Sync>,
}

/// A sample of a former writer.
pub struct ContinuedSample {
  /// Its sequence number.
  pub number: i64,
  /// The payload without its encapsulation header.
  pub payload: Bytes,
  /// The encapsulation of the payload.
  pub encoding: RepresentationIdentifier,
  /// The options in the encapsulation header.
  pub encoding_options: [u8; 2],
  /// The source timestamp, if it has one.
  pub source_timestamp: Option<Timestamp>,
  /// Of a writer that is not VOLATILE: whose history it is in, see
  /// `WriteOptionsBuilder::history_source`.
  pub history_source: Option<GUID>,
}

impl ContinuedSample {
  pub(crate) fn into_data(self) -> (WriteOptions, DDSData) {
    let mut payload = SerializedPayload::new_from_bytes(self.encoding, self.payload);
    payload.representation_options = self.encoding_options;
    let options = WriteOptionsBuilder::new();
    let options = match self.source_timestamp {
      Some(timestamp) => options.source_timestamp(timestamp),
      None => options,
    };
    let options = match self.history_source {
      Some(source) => options.history_source(source),
      None => options,
    };
    (options.build(), DDSData::new(payload))
  }
}

impl ContinuedWriter {
  pub(crate) fn is_valid(&self) -> bool {
    let numbers = || self.samples.iter().map(|sample| sample.number);
    (0..i64::MAX / 2).contains(&self.highest_number)
      && numbers().all(|number| (1..=self.highest_number).contains(&number))
      && numbers().zip(numbers().skip(1)).all(|(one, next)| one < next)
      && numbers().next().is_none_or(|first| self.highest_number - first < MAX_CONTINUED)
  }

  // A writer that has no samples of the former one.
  #[cfg(test)]
  pub(crate) fn after(highest_number: i64) -> Self {
    Self {
      entity_key: [0xff, 1, 2],
      highest_number,
      samples: Vec::new(),
      sent_through: highest_number,
      readers: Vec::new(),
      on_number: Box::new(|_, _| ()),
    }
  }
}

// The most numbers from the first sample of a former writer to its last one.
const MAX_CONTINUED: i64 = 1_024;

/// The numbers that a participant has used, above those that it takes over.
#[derive(Debug, Default)]
pub(crate) struct UsedNumbers {
  count_before: i32,
  count: AtomicI32,
  number: AtomicI64,
}

impl UsedNumbers {
  pub fn after(identity: &ParticipantIdentity) -> Self {
    Self {
      count_before: identity.highest_count,
      count: AtomicI32::new(identity.highest_count),
      number: AtomicI64::new(identity.highest_number),
    }
  }

  /// The count that every HEARTBEAT and ACKNACK exceeds.
  pub fn count_before(&self) -> i32 {
    self.count_before
  }

  pub fn highest_count(&self) -> i32 {
    self.count.load(Ordering::Relaxed)
  }

  pub fn highest_number(&self) -> SequenceNumber {
    SequenceNumber::new(self.number.load(Ordering::Relaxed))
  }

  pub fn use_count(&self, count: i32) {
    self.count.fetch_max(count, Ordering::Relaxed);
  }

  pub fn use_number(&self, number: SequenceNumber) {
    self.number.fetch_max(number.into(), Ordering::Relaxed);
  }
}
