//! The identity that a critical lane keeps over a kill: subscribers stay matched with it.
//!
//! The participant's GUID, ports and numbers are on a board, and what it has discovered is in a journal. The
//! next process goes on with them, unless there is a reason to be another participant: the former process has
//! said goodbye, others may have dropped it, or it would announce something else. Then it is disposed of, as
//! without an identity.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use tracing::{info, warn};

use super::super::role::{Role, RoleError};
use crate::clock;
use crate::config::{Lane, Settings};
use crate::dds::{Participant, ParticipantIdentity, ParticipantOptions, WriterContinuation, host_addresses};
use crate::model::{
    DdsType, Durability, Guid, LaneIdentity, MonotonicNs, ProcessHealth, QosProfile, TrafficClass,
    WriterIdentity,
};
use crate::shm::{BoardWriter, Journal, SendLog};

/// The longest time without a process, below the lease of 15 s: then others drop the participant.
const MAX_AWAY_MS: u64 = 10_000;

/// How long a process that has taken an identity over runs before the next one may.
const PROVEN_AFTER_MS: u64 = 1_000;

/// The share of the lane's time that the journal takes at most: it is written on the lane's thread, and a
/// thousand participants that come and go change it with each housekeeping.
const JOURNAL_SHARE: u64 = 20;

/// What a process may use between two updates of the board, each 100 ms.
const RESERVED_COUNTS: i32 = 1 << 16;
const RESERVED_NUMBERS: i64 = 1 << 12;

/// The identity of the lane's participant, and the journal of its discovery.
pub(super) struct Identity {
    board: BoardWriter<LaneIdentity>,
    journal: Journal,
    conditions: u64,
    /// Whether the next process may continue this one.
    is_kept: bool,
    proven_at: MonotonicNs,
    /// Whether discovery has changed since the journal was written.
    is_outdated: bool,
    journal_at: MonotonicNs,
}

impl Identity {
    /// Joins the domain, as the participant of the former process if that is possible. Returns the identity
    /// to keep.
    pub fn join(
        role: &mut Role,
        settings: &Settings,
        index: usize,
        options: &ParticipantOptions,
    ) -> Result<(Participant, Option<Self>), RoleError> {
        let lane = &settings.lanes[index];
        if lane.class() != TrafficClass::Critical {
            return Ok((role.join(options)?, None));
        }
        let mut identity = Self {
            board: role.boards.lane_identity_writer(index),
            journal: Journal::of(&role.node, &lane.name),
            conditions: conditions(options)?,
            is_kept: true,
            proven_at: clock::monotonic().plus_ms(PROVEN_AFTER_MS),
            is_outdated: false,
            journal_at: MonotonicNs(0),
        };
        let former = if may_be_kept(role, lane) { identity.former(role) } else { None };
        identity.journal.remove();
        let former = former.and_then(|(former, journal)| {
            identity.board.update(|board| *board = LaneIdentity { unproven: 1, ..*board }.sealed());
            match Participant::open_continuing(options, former, journal) {
                Ok(participant) => Some(participant),
                Err(error) => {
                    role.failed();
                    warn!(lane = lane.name.as_str(), %error, "cannot continue the former participant");
                    None
                }
            }
        });
        let continued = former.is_some();
        if !continued {
            // Also if the process that has taken it over died before it said so.
            if identity.board.get().is_intact() && role.former.participant == Guid::default() {
                role.former.participant = identity.board.get().participant;
            }
            identity.board.set(LaneIdentity::default());
        }
        let participant = match former {
            Some(participant) => participant,
            None => Participant::open(options)?,
        };
        role.adopt(&participant);
        identity.record(&participant, continued);
        info!(lane = lane.name.as_str(), participant = ?participant.guid(), continued, "identity");
        Ok((participant, Some(identity)))
    }

    /// What the former process has left, if this one may continue it.
    fn former(&self, role: &mut Role) -> Option<(ParticipantIdentity, Vec<u8>)> {
        let board = *self.board.get();
        if !may_continue(&board, &role.former, self.conditions, clock::monotonic()) {
            return None;
        }
        let identity = ParticipantIdentity {
            participant: board.participant,
            participant_id: board.participant_id.try_into().ok()?,
            highest_count: board.highest_count.try_into().ok()?,
            highest_number: board.highest_number.try_into().ok()?,
        };
        match self.journal.read(board.participant) {
            Ok(journal) => Some((identity, journal?)),
            Err(error) => {
                role.failed();
                warn!(%error, "refused the journal of discovery of the former process");
                None
            }
        }
    }

    /// Keeps the board ahead of the numbers that the participant uses.
    fn record(&mut self, participant: &Participant, unproven: bool) {
        let Some(used) = participant.identity().filter(|_| self.is_kept) else {
            return self.end();
        };
        let former = *self.board.get();
        let ahead = |reserved: u64, used: i64, reserve: i64| {
            let used = used.cast_unsigned();
            if reserved < used + reserve.cast_unsigned() / 2 {
                used + reserve.cast_unsigned()
            } else {
                reserved
            }
        };
        let (count, number) = (i64::from(used.highest_count), used.highest_number);
        let board = LaneIdentity {
            participant: used.participant,
            participant_id: used.participant_id.into(),
            highest_count: ahead(former.highest_count, count, RESERVED_COUNTS.into()),
            highest_number: ahead(former.highest_number, number, RESERVED_NUMBERS),
            conditions: self.conditions,
            unproven: unproven.into(),
            ..LaneIdentity::default()
        };
        self.board.set(board.sealed());
    }

    /// Updates the board, and the journal if discovery has changed. `may_be_kept` is whether all outputs can
    /// be continued.
    pub fn housekeeping(
        &mut self,
        participant: &Participant,
        discovery_changed: bool,
        may_be_kept: bool,
        now: MonotonicNs,
    ) {
        self.is_kept &= may_be_kept;
        let unproven = self.board.get().unproven != 0 && now < self.proven_at;
        self.record(participant, unproven);
        self.is_outdated |= discovery_changed;
        if !self.is_kept || !self.is_outdated || now < self.journal_at {
            return;
        }
        self.is_outdated = false;
        if let Err(error) = self.journal.write(participant.guid(), &participant.discovery_journal()) {
            warn!(%error, "cannot write the journal of discovery; after a kill, subscribers match anew");
        }
        self.journal_at = now.plus_ns(clock::monotonic().since(now) * JOURNAL_SHARE);
    }

    /// The next process does not continue this one: it says goodbye, or announces what the next one cannot.
    pub fn end(&mut self) {
        self.is_kept = false;
        self.board.set(LaneIdentity::default());
        self.journal.remove();
    }
}

/// Whether a former process has left an identity that this one may continue.
fn may_continue(board: &LaneIdentity, former: &ProcessHealth, conditions: u64, now: MonotonicNs) -> bool {
    board.is_intact()
        && board.participant != Guid::default()
        && board.participant == former.participant
        && board.conditions == conditions
        && board.unproven == 0
        && former.ended == 0
        && now.since(former.alive_at) <= MAX_AWAY_MS * 1_000_000
}

/// Whether the outputs of the lane are such that readers of the former process can be served as if nothing
/// had happened: without a history, without keys, and not of a topic that ingress chooses.
fn may_be_kept(role: &Role, lane: &Lane) -> bool {
    lane.outputs.iter().all(|output| {
        let info = role.boards.route_info(output.route).unwrap_or_default();
        let is_latched = output.latched_qos.is_some() && info.durability() == Durability::TransientLocal;
        output.qos.durability == Durability::Volatile
            && !is_latched
            && info.has_keys == 0
            && output.topic.resolve(None).is_some()
    })
}

/// A hash of what the participant announces, and of the addresses that others keep of it.
fn conditions(options: &ParticipantOptions) -> Result<u64, RoleError> {
    let mut addresses = host_addresses()?;
    addresses.sort_unstable();
    let network = options.network;
    let mut hasher = DefaultHasher::new();
    (network.domain_id, format!("{:?}", network.interfaces), addresses).hash(&mut hasher);
    (&options.namespace, &options.node_name, options.graph_gid_bytes).hash(&mut hasher);
    env!("CARGO_PKG_VERSION").hash(&mut hasher);
    Ok(hasher.finish())
}

/// The identity of the DDS writer of one output.
pub(super) struct WriterRecord {
    board: BoardWriter<WriterIdentity>,
    log: SendLog,
    route: usize,
    /// The sequence number in the route of the sample that is being written.
    writing: Arc<AtomicU64>,
    /// Whether the next writer may be that of the former process: the participant is, and this process has
    /// had no writer, which would have said goodbye.
    may_continue: bool,
}

impl WriterRecord {
    /// That of an output; `None` if the lane does not keep the identity of this participant.
    pub fn of(role: &Role, participant: &Participant, lane: usize, route: usize) -> Option<Self> {
        let kept = role.boards.lane_identity(lane)?;
        (kept.is_intact() && kept.participant == participant.guid()).then(|| Self {
            board: role.boards.writer_identity_writer(lane, route),
            log: role.boards.send_log(lane, route),
            route,
            writing: Arc::default(),
            may_continue: role.former.participant == participant.guid(),
        })
    }

    /// The RTPS sequence numbers of the last samples that the former process has written, each with the
    /// sequence number in the route. [`next`](Self::next) may find that its writer can't be continued.
    pub fn logged(&self) -> Vec<(i64, u64)> {
        if self.is_continuable() { self.log.samples() } else { Vec::new() }
    }

    /// To be called before the sample with this sequence number in the route is written.
    pub fn writing(&self, sequence: u64) {
        self.writing.store(sequence, Ordering::Relaxed);
    }

    fn is_continuable(&self) -> bool {
        let former = self.board.get();
        self.may_continue
            && former.is_intact()
            && former.count > 0
            && (0..i64::MAX / 2).contains(&self.log.highest())
    }

    /// How the next writer begins: where that of the former process ended, with its last samples, if it is
    /// the first one, of the same participant, and offers the same; else without them.
    pub fn next(
        &mut self,
        participant: Guid,
        topic: &str,
        dds_type: &DdsType,
        qos: &QosProfile,
    ) -> WriterContinuation {
        let mut hasher = DefaultHasher::new();
        (participant, topic, dds_type.name, dds_type.has_keys, qos).hash(&mut hasher);
        let offer = hasher.finish();
        let former = *self.board.get();
        let is_former = self.is_continuable() && former.offer == offer;
        self.may_continue = false;
        if !is_former {
            // In this order: no number goes with the wrong writer if the process dies in between.
            self.board.set(WriterIdentity::default());
            self.log.reset();
            let count = former.count.wrapping_add(1).max(1);
            self.board.set(WriterIdentity { count, offer, ..WriterIdentity::default() }.sealed());
        }
        let (log, writing) = (self.log.clone(), self.writing.clone());
        WriterContinuation {
            key: key(self.route, self.board.get().count),
            highest_number: self.log.highest(),
            samples: Vec::new(),
            sent_through: self.log.highest(),
            readers: Vec::new(),
            on_number: Box::new(move |number, is_written| {
                let sequence = if is_written { writing.load(Ordering::Relaxed) } else { 0 };
                log.record(number, sequence);
            }),
        }
    }

    /// The writer says goodbye.
    pub fn removed(&mut self) {
        let count = self.board.get().count;
        self.board.set(WriterIdentity { count, ..WriterIdentity::default() });
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
