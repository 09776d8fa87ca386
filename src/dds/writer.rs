//! A DDS writer of raw payloads. A write does not wait for readers unless the writer was created as blocking.

use std::collections::{BTreeSet, VecDeque};
use std::convert::Infallible;
use std::time::Duration;

use bytes::Bytes;

use super::qos;
use super::reader::SampleOrigin;
use super::rustdds::no_key::{DataWriter, SerializerAdapter};
use super::rustdds::{
    DataWriterStatus, GUID, InstanceChange, InstancePayload, RepresentationIdentifier, SampleIdentity,
    SequenceNumber, StatusEvented, Timestamp, WriteOptionsBuilder, dds::result::WriteError as DdsWriteError,
};
use crate::model::{
    Encapsulation, Guid, KeyedPayload, ReaderRecord, SampleKey, SourceTimestamp, TypeHash, UnmatchedPolicy,
};

/// The bytes of the encapsulation header before each payload.
const ENCAPSULATION_BYTES: usize = 4;

/// Why a sample was not written.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum WriteError {
    /// A blocking writer has waited for acknowledgements for its whole blocking time.
    #[error("the window of unacknowledged samples is full")]
    WindowFull,
    /// The DDS library refused the sample for another reason.
    #[error("the DDS library refused the sample")]
    Refused,
}

impl<T> From<DdsWriteError<T>> for WriteError {
    fn from(error: DdsWriteError<T>) -> Self {
        match error {
            DdsWriteError::WouldBlock { .. } => Self::WindowFull,
            _ => Self::Refused,
        }
    }
}

/// A change of the readers that a writer is matched with.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum WriterEvent {
    /// A reader was matched or unmatched.
    Matched {
        /// The reader.
        reader: Guid,
        /// Whether it was matched; otherwise it was unmatched.
        joined: bool,
        /// The number of readers that are matched now.
        readers: u64,
        /// If it was unmatched: samples that had left the history and that it had not acknowledged. 0 if
        /// the event did not fit into the queue of the DDS library; [`RawWriter::overrun`] has them.
        missed: u64,
    },
    /// A reader requests a stronger QoS than the writer offers.
    Incompatible {
        /// The reader.
        reader: Guid,
        /// The first policy for which it does not match.
        policy: UnmatchedPolicy,
    },
}

/// A sample that was handed to the DDS library.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Written {
    /// Matched readers that the sample is offered to.
    pub readers: usize,
    /// The sample's RTPS sequence number, from 1 on.
    pub sequence: i64,
}

/// A DDS writer of raw payloads.
pub struct RawWriter {
    pub(super) inner: DataWriter<RawPayload, PayloadEncoder>,
    pub(super) guid: Guid,
    pub(super) matching: Matching,
}

impl RawWriter {
    /// The writer's GUID.
    pub fn guid(&self) -> Guid {
        self.guid
    }

    /// Announces the hash of the type's definition. Nodes that have discovered the writer before may still
    /// show the former one.
    pub fn set_type_hash(&self, hash: TypeHash) {
        self.inner.set_user_data(qos::user_data(hash));
    }

    /// Writes a sample. Returns at once; a blocking writer returns within its blocking time. The DDS library
    /// keeps `payload` until every matched RELIABLE reader has acknowledged it, or until newer samples evict
    /// it from the history. [`sent_through`](Self::sent_through) tells when it was sent.
    ///
    /// # Errors
    /// The library did not accept the sample, and `payload` is dropped.
    pub fn write(
        &self,
        payload: Bytes,
        encapsulation: Encapsulation,
        timestamp: SourceTimestamp,
    ) -> Result<Written, WriteError> {
        self.write_from(None, payload, encapsulation, timestamp, SampleKey::NONE)
    }

    /// Like [`write`](Self::write), and with the publisher that the sample comes from: a RELIABLE,
    /// TRANSIENT_LOCAL writer keeps the last samples of each publisher for late joiners, as many as its
    /// HISTORY has, until [`forget_history_of`](Self::forget_history_of). Of a type with keys, `key` goes
    /// with the sample, and the writer keeps as many of each key.
    ///
    /// # Errors
    /// As for [`write`](Self::write).
    pub fn write_from(
        &self,
        publisher: Option<Guid>,
        payload: Bytes,
        encapsulation: Encapsulation,
        timestamp: SourceTimestamp,
        key: SampleKey,
    ) -> Result<Written, WriteError> {
        let mut options = with_key(stamped(timestamp), key);
        if let Some(publisher) = publisher {
            options = options.history_source(GUID::from_bytes(publisher.0));
        }
        self.write_with(payload, encapsulation, options)
    }

    fn write_with(
        &self,
        payload: Bytes,
        encapsulation: Encapsulation,
        options: WriteOptionsBuilder,
    ) -> Result<Written, WriteError> {
        let payload = RawPayload { bytes: payload, encapsulation };
        let (sample, readers) = self.inner.write_counting_readers(payload, options.build())?;
        Ok(Written { readers, sequence: i64::from(sample.sequence_number) })
    }

    /// Begins to send a sample that is not complete yet: of `payload`, the library reads only the first
    /// `available` bytes, until [`extend_early`](Self::extend_early) says that there are more. No reader has
    /// the sample before [`complete_early`](Self::complete_early): the library does not send the last
    /// fragment. Returns false, and does nothing, if another sample was begun or the writer is not RELIABLE
    /// and VOLATILE. Any other write gives the sample up.
    pub fn begin_early(
        &self,
        payload: Bytes,
        encapsulation: Encapsulation,
        timestamp: SourceTimestamp,
        available: usize,
    ) -> bool {
        let payload = RawPayload { bytes: payload, encapsulation };
        self.inner.begin_early(payload, stamped(timestamp).build(), available + ENCAPSULATION_BYTES)
    }

    /// The first `available` bytes of the sample that was begun are complete.
    pub fn extend_early(&self, available: usize) {
        self.inner.extend_early(available + ENCAPSULATION_BYTES);
    }

    /// Writes the whole of the sample that was begun, or a sample like any other if none was.
    ///
    /// # Errors
    /// As for [`write`](Self::write).
    pub fn complete_early(
        &self,
        payload: Bytes,
        encapsulation: Encapsulation,
        timestamp: SourceTimestamp,
    ) -> Result<Written, WriteError> {
        self.write_with(payload, encapsulation, stamped(timestamp).completes_early())
    }

    /// Gives up the sample that was begun, of which readers may have a part, and tells them.
    pub fn withdraw_early(&self) {
        self.inner.withdraw_early();
    }

    /// Removes the samples of a publisher from the history for late joiners.
    pub fn forget_history_of(&self, publisher: Guid) {
        self.inner.forget_history_of(GUID::from_bytes(publisher.0));
    }

    /// How many samples of several publishers were evicted from the history for late joiners, because it had
    /// more than 32 MiB or 8,192 of them.
    pub fn history_evicted(&self) -> u64 {
        self.inner.history_evicted()
    }

    /// Like [`write`](Self::write), but to one matched reader only: a late joiner of a BEST_EFFORT writer, to
    /// which the DDS protocol does not deliver the history.
    ///
    /// # Errors
    /// As for [`write`](Self::write).
    pub fn write_to(
        &self,
        reader: Guid,
        payload: Bytes,
        encapsulation: Encapsulation,
        timestamp: SourceTimestamp,
        key: SampleKey,
    ) -> Result<(), WriteError> {
        let payload = RawPayload { bytes: payload, encapsulation };
        let options = with_key(stamped(timestamp), key).to_single_reader(GUID::from_bytes(reader.0));
        self.inner.write_counting_readers(payload, options.build())?;
        Ok(())
    }

    /// Writes the reply of a service to one matched reader of the client that sent `request`, in plain
    /// little-endian CDR. The inline QoS names the request, as DDS-RPC 1.0 clause 7.8.2 defines.
    ///
    /// # Errors
    /// As for [`write`](Self::write).
    pub fn write_reply(
        &self,
        reader: Guid,
        request: &SampleOrigin,
        payload: Bytes,
    ) -> Result<(), WriteError> {
        let payload = RawPayload { bytes: payload, encapsulation: Encapsulation::CDR_LE };
        let request = SampleIdentity {
            writer_guid: GUID::from_bytes(request.writer.0),
            sequence_number: SequenceNumber::from(request.sequence),
        };
        let options = WriteOptionsBuilder::new()
            .related_sample_identity(request)
            .to_single_reader(GUID::from_bytes(reader.0));
        self.inner.write_counting_readers(payload, options.build())?;
        Ok(())
    }

    /// The highest RTPS sequence number that was sent to every reader matched at that time; 0 for none. A
    /// sample that the writing thread can't send waits for the library's own thread.
    pub fn sent_through(&self) -> i64 {
        self.inner.sent_through().into()
    }

    /// Makes readers skip samples that were evicted from the history, instead of requesting them: for samples
    /// that the next ones supersede. Those that a reader has not acknowledged count as its overrun.
    pub fn skip_evicted(&self) {
        self.inner.offer_only_retained();
    }

    /// Lists the matched readers, with the samples that each was offered, has acknowledged and has missed.
    pub fn matched_readers(&self) -> impl Iterator<Item = ReaderRecord> {
        self.inner.matched_readers().into_iter().map(|reader| ReaderRecord {
            reader: Guid(reader.guid.to_bytes()),
            reliable: u64::from(reader.reliable),
            offered: reader.offered,
            unacknowledged: reader.unacknowledged,
            overrun: reader.overrun,
        })
    }

    /// The samples that all readers have missed so far, which never decreases: the sum of the overruns of the
    /// matched readers and of those that have left. For one that has left, it includes what had left the
    /// history and it had not acknowledged.
    pub fn overrun(&self) -> u64 {
        self.inner.overrun()
    }

    /// Waits for `timeout` at most until every matched RELIABLE reader has acknowledged all samples, and
    /// returns whether they have.
    pub fn wait_acknowledged(&self, timeout: Duration) -> bool {
        self.inner.wait_for_acknowledgments(timeout).unwrap_or(false)
    }

    /// Returns the next change of the matched readers, if there is one. Those that did not fit into the
    /// queue of the DDS library, which has 256 places, come after the others.
    pub fn poll_event(&mut self) -> Option<WriterEvent> {
        loop {
            let event = match self.inner.try_recv_status() {
                Some(DataWriterStatus::PublicationMatched { current, reader, missed, .. }) => {
                    self.matching.note(Guid(reader.to_bytes()), current.count_change() > 0, missed)
                }
                Some(DataWriterStatus::OfferedIncompatibleQos { reader, last_policy_id, .. }) => {
                    let policy = qos::unmatched_policy(last_policy_id);
                    Some(WriterEvent::Incompatible { reader: Guid(reader.to_bytes()), policy })
                }
                Some(_) => None,
                None => {
                    if self.inner.has_missed_events() {
                        // The events that came meanwhile are older than the readers that are looked at then.
                        self.matching.is_incomplete = true;
                        continue;
                    }
                    if std::mem::take(&mut self.matching.is_incomplete) {
                        let matched = self.inner.matched_readers();
                        self.matching.compare(matched.iter().map(|reader| Guid(reader.guid.to_bytes())));
                    }
                    let (reader, joined) = self.matching.found.pop_front()?;
                    self.matching.note(reader, joined, 0)
                }
            };
            if event.is_some() {
                return event;
            }
        }
    }
}

/// The readers that a writer has reported as matched.
#[derive(Default)]
pub(super) struct Matching {
    reported: BTreeSet<Guid>,
    /// Whether the DDS library has not reported a change since the last comparison.
    is_incomplete: bool,
    /// Changes that the DDS library did not report, which [`note`](Self::note) has not noted yet.
    found: VecDeque<(Guid, bool)>,
}

impl Matching {
    /// Notes a change, and returns its event, unless it is the end of a match that was not reported. A match
    /// that was reported is a change, too: the end of the one before may be among those without a report.
    fn note(&mut self, reader: Guid, joined: bool, missed: u64) -> Option<WriterEvent> {
        // This is newer than what was found of the reader.
        self.found.retain(|(found, _)| *found != reader);
        let was_reported = if joined { !self.reported.insert(reader) } else { self.reported.remove(&reader) };
        let readers = self.reported.len() as u64;
        (joined || was_reported).then_some(WriterEvent::Matched { reader, joined, readers, missed })
    }

    /// Finds the changes of which there was no report, by the readers that are matched.
    fn compare(&mut self, matched: impl Iterator<Item = Guid>) {
        let matched: BTreeSet<Guid> = matched.collect();
        let left = self.reported.difference(&matched).map(|reader| (*reader, false));
        let joined = matched.difference(&self.reported).map(|reader| (*reader, true));
        self.found = left.chain(joined).collect();
    }
}

pub(super) struct RawPayload {
    bytes: Bytes,
    encapsulation: Encapsulation,
}

/// Passes payloads through RustDDS' serialization traits without encoding them.
pub(super) struct PayloadEncoder;

impl SerializerAdapter<RawPayload> for PayloadEncoder {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(value: &RawPayload) -> Result<Bytes, Infallible> {
        Ok(value.bytes.clone())
    }

    fn output_encapsulation(value: &RawPayload) -> (RepresentationIdentifier, [u8; 2]) {
        (encoding(value.encapsulation), value.encapsulation.options())
    }
}

/// The representation of a payload.
pub(super) fn encoding(encapsulation: Encapsulation) -> RepresentationIdentifier {
    // The conversion needs two bytes, so it cannot fail; CDR_LE is the most common encapsulation.
    RepresentationIdentifier::from_bytes(&encapsulation.representation())
        .unwrap_or(RepresentationIdentifier::CDR_LE)
}

/// A source timestamp, if there is one.
pub(super) fn timestamp(timestamp: SourceTimestamp) -> Option<Timestamp> {
    (timestamp != SourceTimestamp::NONE).then(|| Timestamp::from_ticks(timestamp.0))
}

/// The options of a sample with that source timestamp.
fn stamped(source: SourceTimestamp) -> WriteOptionsBuilder {
    let options = WriteOptionsBuilder::new();
    match timestamp(source) {
        Some(timestamp) => options.source_timestamp(timestamp),
        None => options,
    }
}

/// The options of a sample that says this of its key.
fn with_key(options: WriteOptionsBuilder, key: SampleKey) -> WriteOptionsBuilder {
    if !key.is_keyed() {
        return options;
    }
    let payload = match key.payload() {
        KeyedPayload::Data => InstancePayload::Data,
        KeyedPayload::Key => InstancePayload::Key,
        KeyedPayload::Absent => InstancePayload::Absent,
    };
    options.instance_change(InstanceChange { key_hash: key.hash(), status_info: key.status_info(), payload })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_event_counts_more_than_what_was_found_before_it() {
        let [one, two, three] = [1, 2, 3].map(|number| Guid([number; 16]));
        let mut matching = Matching::default();
        assert!(matching.note(one, true, 0).is_some());
        matching.compare([two, three].into_iter());
        assert_eq!(matching.found, [(one, false), (two, true), (three, true)]);
        assert!(matching.note(three, false, 0).is_none(), "it was not reported");
        assert!(matching.note(one, true, 0).is_some());
        assert_eq!(matching.found, [(two, true)]);
        matching.compare([one].into_iter());
        assert!(matching.found.is_empty());
    }
}
