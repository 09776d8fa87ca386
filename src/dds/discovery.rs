//! Changes of remote readers, writers and participants, as discovery reports them.

use std::collections::{BTreeMap, BTreeSet};
use std::pin::pin;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::task::{Context, Poll, Wake, Waker};
use std::time::Duration;
use std::vec;

use futures_core::Stream;

use super::qos::{durability_of, reliability_of};
use super::rustdds::{
    DomainParticipant, DomainParticipantStatusEvent, DomainParticipantStatusListener, EndpointDescription,
    LostReason, StatusEvented,
};
use crate::model::{Durability, Guid, MonotonicNs, Reliability, TypeHash};
use crate::policy::Location;

/// The most announced addresses of an endpoint that are kept. A host has fewer.
const MAX_ADDRESSES: usize = 64;

/// The most changes that wait for [`Participant::poll_discovery`](super::Participant::poll_discovery): those
/// beyond are lost, and found again within a second.
pub(super) const MAX_WAITING_CHANGES: usize = 2_048;

/// The changes of discovery that the caller still takes before it does its other work: as many as can wait. A
/// peer that announces and withdraws endpoints as fast as it can keeps no caller in a loop.
#[derive(Debug)]
pub struct DiscoveryTurn {
    now: MonotonicNs,
    left: usize,
    /// What the caller was not told of, once there is no other change left.
    missed: Option<vec::IntoIter<Discovery>>,
}

impl DiscoveryTurn {
    /// A turn at `now`.
    pub const fn new(now: MonotonicNs) -> Self {
        Self { now, left: MAX_WAITING_CHANGES, missed: None }
    }

    /// Whether the turn takes another change, also one that the bridge does not look at, which then counts.
    pub(super) const fn takes_another(&mut self) -> bool {
        let takes_another = self.left > 0;
        self.left = self.left.saturating_sub(1);
        takes_another
    }
}

/// A remote reader or writer that was discovered.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Endpoint {
    /// Its GUID.
    pub guid: Guid,
    /// DDS topic, such as `rt/scan`.
    pub topic: String,
    /// DDS type, such as `sensor_msgs::msg::dds_::LaserScan_`.
    pub dds_type: String,
    /// The hash of the type's definition, if it announces one.
    pub type_hash: TypeHash,
    /// The RELIABILITY that it offers or requests.
    pub reliability: Reliability,
    /// The DURABILITY that it offers or requests.
    pub durability: Durability,
    /// The addresses from which its host is determined.
    pub location: Location,
}

/// A change of a remote reader, writer or participant.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Discovery {
    /// A writer was discovered, or has changed.
    Writer(Endpoint),
    /// A writer was deleted.
    WriterGone(Guid),
    /// A reader was discovered, or has changed.
    Reader(Endpoint),
    /// A reader was deleted.
    ReaderGone(Guid),
    /// A participant has left or its lease has expired. Its readers and writers are gone with it; no separate
    /// change reports them.
    ParticipantGone {
        /// The GUID prefix of the participant and of its endpoints.
        prefix: [u8; 12],
        /// The time for which nothing was received from it, if its lease has expired; `None` if it announced
        /// that it leaves.
        silent_ms: Option<u64>,
    },
}

/// The shortest time between two searches for missed changes, each of which takes some milliseconds with
/// 16,384 readers and as many writers.
const FIND_MISSED_MS: u64 = 1_000;

/// The changes that discovery reports to a participant.
pub(super) struct Changes {
    listener: DomainParticipantStatusListener,
    /// Called for the first change after `poll` has found none.
    waker: Waker,
    woken: Receiver<()>,
    reported: Reported,
    find_missed_at: MonotonicNs,
}

impl Changes {
    pub fn of(participant: &DomainParticipant) -> Self {
        let (waker, woken) = sync_channel(1);
        Self {
            listener: participant.status_listener(),
            waker: Waker::from(Arc::new(DiscoveryWaker(waker))),
            woken,
            reported: Reported::default(),
            find_missed_at: MonotonicNs::default(),
        }
    }

    /// Waits until there is a change that [`poll`](Self::poll) has not returned, or for `most`.
    #[allow(clippy::disallowed_methods, reason = "no thread of the data path waits for discovery")]
    pub fn wait(&self, most: Duration) {
        // It times out, and cannot be disconnected: the waker is a field of this one.
        let _ = self.woken.recv_timeout(most);
    }

    /// The next change, if there is one and `turn` still takes one; then the ones that did not fit.
    pub fn poll(&mut self, participant: &DomainParticipant, turn: &mut DiscoveryTurn) -> Option<Discovery> {
        if turn.missed.is_none() {
            if let Some(change) = self.poll_waiting(turn) {
                return Some(change);
            }
            turn.missed = Some(self.find_missed(participant, turn.now).into_iter());
        }
        // Before what waits now, which is younger.
        turn.missed.as_mut()?.next()
    }

    fn poll_waiting(&mut self, turn: &mut DiscoveryTurn) -> Option<Discovery> {
        let mut changes = pin!(self.listener.as_async_status_stream());
        let mut context = Context::from_waker(&self.waker);
        while turn.takes_another() {
            let Poll::Ready(Some(change)) = changes.as_mut().poll_next(&mut context) else { return None };
            if let Some(change) = translate(change) {
                self.reported.note(&change);
                return Some(change);
            }
        }
        None
    }

    /// The readers and writers of which the caller was not told, and the ends of those that are gone, if more
    /// changes waited than can; nothing within a second after the last search. The hosts of what it finds are
    /// known by their announced addresses alone.
    fn find_missed(&mut self, participant: &DomainParticipant, now: MonotonicNs) -> Vec<Discovery> {
        if now < self.find_missed_at || !self.listener.has_missed_events() {
            return Vec::new();
        }
        self.find_missed_at = now.plus_ms(FIND_MISSED_MS);
        let mut present = BTreeSet::new();
        let found = participant.discovered_besides(|guid| {
            let guid = Guid(guid.to_bytes());
            present.insert(guid);
            self.reported.contains(guid)
        });
        let mut missed = self.reported.ended(&present);
        missed.extend(found.into_iter().filter_map(translate));
        missed.iter().for_each(|change| self.reported.note(change));
        let changes = missed.len();
        tracing::warn!(changes, "discovery reported more changes at a time than can wait; found them");
        missed
    }
}

/// Ends the wait for discovery.
struct DiscoveryWaker(SyncSender<()>);

impl Wake for DiscoveryWaker {
    fn wake(self: Arc<Self>) {
        // If the channel is full, the waiting thread is awake already.
        let _ = self.0.try_send(());
    }
}

/// The remote endpoints that were reported to the caller, to find what it was not told.
#[derive(Debug, Default)]
struct Reported {
    /// Whether each is a writer.
    endpoints: BTreeMap<Guid, bool>,
}

impl Reported {
    /// Notes a change that is about to be reported.
    pub fn note(&mut self, change: &Discovery) {
        match change {
            Discovery::Writer(writer) => {
                self.endpoints.insert(writer.guid, true);
            }
            Discovery::Reader(reader) => {
                self.endpoints.insert(reader.guid, false);
            }
            Discovery::WriterGone(guid) | Discovery::ReaderGone(guid) => {
                self.endpoints.remove(guid);
            }
            Discovery::ParticipantGone { prefix, .. } => {
                let of_participant = self.endpoints.range(first_of(*prefix)..=last_of(*prefix));
                for guid in of_participant.map(|(guid, _)| *guid).collect::<Vec<_>>() {
                    self.endpoints.remove(&guid);
                }
            }
        }
    }

    pub fn contains(&self, guid: Guid) -> bool {
        self.endpoints.contains_key(&guid)
    }

    /// The ends of those that are not among the `present` ones. A participant of which none is present counts
    /// as gone.
    pub fn ended(&self, present: &BTreeSet<Guid>) -> Vec<Discovery> {
        let mut ended = Vec::new();
        for (guid, is_writer) in self.endpoints.iter().filter(|(guid, _)| !present.contains(guid)) {
            let prefix = guid.prefix();
            if present.range(first_of(prefix)..=last_of(prefix)).next().is_some() {
                ended.push(if *is_writer {
                    Discovery::WriterGone(*guid)
                } else {
                    Discovery::ReaderGone(*guid)
                });
            } else {
                let gone = Discovery::ParticipantGone { prefix, silent_ms: None };
                if ended.last() != Some(&gone) {
                    ended.push(gone);
                }
            }
        }
        ended
    }
}

/// The lowest GUID of a participant.
fn first_of(prefix: [u8; 12]) -> Guid {
    with_entity(prefix, [0; 4])
}

/// The highest GUID of a participant.
fn last_of(prefix: [u8; 12]) -> Guid {
    with_entity(prefix, [0xff; 4])
}

fn with_entity(prefix: [u8; 12], entity: [u8; 4]) -> Guid {
    let mut guid = [0; 16];
    guid[..12].copy_from_slice(&prefix);
    guid[12..].copy_from_slice(&entity);
    Guid(guid)
}

/// Converts an event of RustDDS; `None` for one that the bridge does not use.
fn translate(event: DomainParticipantStatusEvent) -> Option<Discovery> {
    use DomainParticipantStatusEvent as Event;
    match event {
        // DDS 1.4, table in clause 2.2.3: the default RELIABILITY is RELIABLE for writers and BEST_EFFORT for
        // readers.
        Event::WriterDetected { writer } => Some(Discovery::Writer(endpoint(writer, Reliability::Reliable))),
        Event::ReaderDetected { reader } => {
            Some(Discovery::Reader(endpoint(reader, Reliability::BestEffort)))
        }
        Event::WriterLost { guid, .. } => Some(Discovery::WriterGone(Guid(guid.to_bytes()))),
        Event::ReaderLost { guid, .. } => Some(Discovery::ReaderGone(Guid(guid.to_bytes()))),
        Event::ParticipantLost { id, reason } => {
            let silent_ms = match reason {
                LostReason::Disposed => None,
                LostReason::Timeout { elapsed, .. } => {
                    Some(u64::try_from(elapsed.to_std().as_millis()).unwrap_or(u64::MAX))
                }
            };
            Some(Discovery::ParticipantGone { prefix: id.as_ref().try_into().ok()?, silent_ms })
        }
        _ => None,
    }
}

fn endpoint(description: EndpointDescription, default_reliability: Reliability) -> Endpoint {
    Endpoint {
        guid: Guid(description.guid.to_bytes()),
        reliability: reliability_of(&description.qos, default_reliability),
        durability: durability_of(&description.qos),
        location: Location {
            seen_from: description.seen_from.map(|source| source.ip()),
            announced: description
                .unicast_addresses
                .iter()
                .take(MAX_ADDRESSES)
                .map(|address| address.ip())
                .collect(),
        },
        type_hash: TypeHash::find_in(&description.user_data),
        topic: description.topic_name,
        dds_type: description.type_name,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn endpoint(participant: u8, entity: u8) -> Endpoint {
        Endpoint {
            guid: with_entity([participant; 12], [0, 0, entity, 3]),
            topic: "rt/scan".to_owned(),
            dds_type: "T".to_owned(),
            type_hash: TypeHash::default(),
            reliability: Reliability::Reliable,
            durability: Durability::Volatile,
            location: Location { seen_from: None, announced: Vec::new() },
        }
    }

    #[test]
    fn more_publishers_at_a_time_than_changes_can_wait_are_all_found() {
        let domain_id = 165;
        let participant = DomainParticipant::new(domain_id).unwrap();
        let mut changes = Changes::of(&participant);
        let other = DomainParticipant::new(domain_id).unwrap();
        let qos = super::super::rustdds::QosPolicies::qos_none();
        let publisher = other.create_publisher(&qos).unwrap();
        let kind = super::super::rustdds::TopicKind::NoKey;
        let topic = other.create_topic("many".to_owned(), "T".to_owned(), &qos, kind).unwrap();
        let mut writers = Vec::new();
        while writers.len() < MAX_WAITING_CHANGES + 200 {
            // The library announces at most 512 of those that are created while its thread of discovery waits
            // for a CPU.
            writers.extend(
                (0..256).map(|_| publisher.create_datawriter_no_key_cdr::<u32>(&topic, None).unwrap()),
            );
            let found = || participant.discovered_writers().len();
            for _ in 0..3_000 {
                if found() == writers.len() {
                    break;
                }
                std::thread::sleep(Duration::from_millis(20));
            }
            assert_eq!(found(), writers.len(), "writers discovered within a minute");
        }

        let mut told = BTreeSet::new();
        let mut tell = |change| match change {
            Discovery::Writer(writer) => told.insert(writer.guid),
            _ => false,
        };
        let mut turn = DiscoveryTurn::new(MonotonicNs(1));
        while let Some(change) = changes.poll(&participant, &mut turn) {
            tell(change);
        }
        assert_eq!(turn.left, 0, "more changes waited than can");
        assert!(writers.iter().all(|writer| {
            let guid = super::super::rustdds::RTPSEntity::guid(writer);
            told.contains(&Guid(guid.to_bytes()))
        }));
        assert!(changes.find_missed(&participant, MonotonicNs(2)).is_empty(), "within a second");
    }

    #[test]
    fn what_has_ended_without_a_report_is_found() {
        let mut reported = Reported::default();
        let guid = |participant, entity| endpoint(participant, entity).guid;
        for participant in 1..=4 {
            reported.note(&Discovery::Writer(endpoint(participant, 1)));
            reported.note(&Discovery::Reader(endpoint(participant, 2)));
        }
        reported.note(&Discovery::ParticipantGone { prefix: [3; 12], silent_ms: None });
        reported.note(&Discovery::WriterGone(guid(4, 1)));
        assert!(!reported.contains(guid(3, 1)) && !reported.contains(guid(4, 1)));
        assert!(reported.contains(guid(2, 2)) && reported.contains(guid(4, 2)));
        let present = [guid(1, 2), guid(4, 2), guid(4, 9)].into();
        let gone = Discovery::ParticipantGone { prefix: [2; 12], silent_ms: None };
        assert_eq!(reported.ended(&present), [Discovery::WriterGone(guid(1, 1)), gone]);
    }

    #[test]
    fn a_turn_takes_as_many_changes_as_can_wait() {
        let mut turn = DiscoveryTurn::new(MonotonicNs(0));
        let taken = (0..10_000).filter(|_| turn.takes_another()).count();
        assert_eq!(taken, MAX_WAITING_CHANGES);
    }
}
