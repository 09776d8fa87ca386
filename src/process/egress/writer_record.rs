//! What a writer of a lane leaves to that of the next process: its entity id and its numbers.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use super::super::role::Role;
use crate::config::Output;
use crate::dds::{Participant, WriterContinuation};
use crate::model::{DdsType, Durability, EndpointIdentity, Guid, QosProfile, Reliability, RouteInfo};
use crate::shm::{BoardWriter, ProcessRole, SendLog};

/// What the output offers if it is TRANSIENT_LOCAL.
pub(super) fn latched(output: &Output, info: &RouteInfo) -> Option<QosProfile> {
    let followed = output.latched_qos.filter(|_| info.durability() == Durability::TransientLocal);
    followed.or(Some(output.qos)).filter(|qos| qos.durability == Durability::TransientLocal)
}

/// Whether the output is such that readers of the former process can be served as if nothing had happened:
/// without keys, and without a history that is sent to late joiners as new samples.
fn may_be_continued(role: &Role, output: &Output) -> bool {
    let info = role.boards.route_info(output.route).unwrap_or_default();
    let has_history_of_reliable =
        latched(output, &info).is_none_or(|qos| qos.reliability == Reliability::Reliable);
    has_history_of_reliable && info.has_keys == 0
}

/// The next writer of an output.
pub(super) struct Next {
    pub continuation: WriterContinuation,
    /// Whether it is the writer of the former process, with whose readers it is matched already.
    pub is_former: bool,
    /// The key of the former process' writer if readers still know that one, and this one is another.
    pub superseded: Option<[u8; 3]>,
}

/// The identity of the DDS writer of one output.
pub(super) struct WriterRecord {
    board: BoardWriter<EndpointIdentity>,
    log: SendLog,
    route: usize,
    /// The sequence number in the route of the sample that is being written.
    writing: Arc<AtomicU64>,
    /// Whether the participant is that of the former process, and this process has had no writer of the
    /// output, which would have said goodbye.
    is_first: bool,
    /// Whether the next writer may be that of the former process.
    may_continue: bool,
}

impl WriterRecord {
    /// That of an output; `None` if the lane does not keep the identity of this participant.
    pub fn of(role: &Role, participant: &Participant, lane: usize, output: &Output) -> Option<Self> {
        let kept = role.boards.identity(ProcessRole::Egress(lane))?;
        let is_first = role.former.participant == participant.guid();
        (kept.is_intact() && kept.participant == participant.guid()).then(|| Self {
            board: role.boards.writer_identity_writer(lane, output.route),
            log: role.boards.send_log(lane, output.route),
            route: output.route,
            writing: Arc::default(),
            is_first,
            may_continue: may_be_continued(role, output),
        })
    }

    /// The RTPS sequence numbers of the last samples that the former process has written, each with the
    /// sequence number in the route. [`next`](Self::next) may find that its writer can't be continued.
    pub fn logged(&self) -> Vec<(i64, u64)> {
        if self.is_continuable() { self.log.samples() } else { Vec::new() }
    }

    /// The next writer is not that of the former process.
    pub const fn give_up(&mut self) {
        self.may_continue = false;
    }

    /// To be called before the sample with this sequence number in the route is written.
    pub fn writing(&self, sequence: u64) {
        self.writing.store(sequence, Ordering::Relaxed);
    }

    fn is_continuable(&self) -> bool {
        let former = self.board.get();
        self.is_first
            && self.may_continue
            && former.is_intact()
            && former.count > 0
            && (0..i64::MAX / 2).contains(&self.log.highest())
    }

    /// How the next writer begins: where that of the former process ended, with its last samples, if it is
    /// the first one, of the same participant, and offers the same; else without them.
    pub fn next(&mut self, participant: Guid, topic: &str, dds_type: &DdsType, qos: &QosProfile) -> Next {
        let mut hasher = DefaultHasher::new();
        (participant, topic, dds_type.name, dds_type.has_keys, qos).hash(&mut hasher);
        let offer = hasher.finish();
        let former = *self.board.get();
        let is_former = self.is_continuable() && former.offer == offer;
        let was_announced = self.is_first && former.is_intact() && former.offer != 0;
        let superseded = (was_announced && !is_former).then(|| key(self.route, former.count));
        self.is_first = false;
        if !is_former {
            // In this order: no number goes with the wrong writer if the process dies in between.
            self.board.set(EndpointIdentity::default());
            self.log.reset();
            let count = former.count.wrapping_add(1).max(1);
            self.board.set(EndpointIdentity { count, offer, ..EndpointIdentity::default() }.sealed());
        }
        let (log, writing) = (self.log.clone(), self.writing.clone());
        let continuation = WriterContinuation {
            key: key(self.route, self.board.get().count),
            highest_number: self.log.highest(),
            samples: Vec::new(),
            sent_through: self.log.highest(),
            readers: Vec::new(),
            on_number: Box::new(move |number, is_written| {
                let sequence = if is_written { writing.load(Ordering::Relaxed) } else { 0 };
                log.record(number, sequence);
            }),
        };
        Next { continuation, is_former, superseded }
    }

    /// The writer says goodbye.
    pub fn removed(&mut self) {
        let count = self.board.get().count;
        self.board.set(EndpointIdentity { count, ..EndpointIdentity::default() });
    }
}

/// The part of the entity id of the `count`-th writer of the output of a route: 0x80 to 0xbf first, 12 bits
/// of the route, and 10 bits of the count.
fn key(route: usize, count: u64) -> [u8; 3] {
    let number = 0x80_0000 | (route as u32 & 0xfff) << 10 | (count as u32 & 0x3ff);
    let [_, high, middle, low] = number.to_be_bytes();
    [high, middle, low]
}

#[cfg(test)]
mod tests;
