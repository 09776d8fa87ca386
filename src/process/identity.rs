//! The identity that a process keeps over a kill: publishers or subscribers stay matched with it.
//!
//! The participant's GUID, ports and numbers are on a board, what it has discovered is in a journal, and its
//! sockets are with the supervisor of the process. The next process goes on with them, unless there is a
//! reason to be another participant: the former process has said goodbye, others may have dropped it, or it
//! would announce something else. Then it is disposed of, as without an identity.

use std::hash::{DefaultHasher, Hash, Hasher};
use std::io;

use tracing::{info, warn};

use super::error::RoleError;
use super::kept_sockets;
use super::place::MAX_AWAY_MS;
use super::role::Role;
use super::successor::{Leave, Successor};
use crate::clock;
use crate::config::Standby;
use crate::dds::{DdsError, Kept, Participant, ParticipantIdentity, ParticipantOptions, host_addresses};
use crate::model::{Guid, MonotonicNs, ProcessHealth, ProcessIdentity};
use crate::shm::{BoardWriter, Journal, ProcessRole};

/// Processes of one version continue each other, also if they are of different releases: an upgrade changes
/// nothing for subscribers. To be raised with what a participant announces and with the journal's content.
const VERSION: u32 = 1;

/// How long a process that has taken an identity over runs until it has proven that this is not what ends it.
const PROVEN_AFTER_MS: u64 = 1_000;

/// The most processes that take an identity over, one after the other, and end before that. On a lane one: of
/// three processes that continued each other within a second, the last one counted 88 samples as forwarded
/// that a subscriber did not get.
const fn max_unproven(process: ProcessRole) -> u64 {
    match process {
        ProcessRole::Ingress => 3,
        ProcessRole::Control | ProcessRole::Egress(_) => 1,
    }
}

/// The share of the main thread's time that the journal takes at most: on a lane that thread sends, and a
/// thousand participants that come and go change it with each housekeeping.
const JOURNAL_SHARE: u64 = 20;

/// How long a process that continues another one leaves the journal that it has just read as it is: to write
/// it takes 1.3 ms, for which a take-over waits.
const JOURNAL_AFTER_MS: u64 = 100;

/// What a process may use between two updates of the board, each 100 ms.
const RESERVED_COUNTS: i32 = 1 << 16;
const RESERVED_NUMBERS: i64 = 1 << 12;

/// The identity of the participant of a process, and the journal of its discovery.
pub(super) struct Identity {
    board: BoardWriter<ProcessIdentity>,
    journal: Journal,
    conditions: u64,
    max_unproven: u64,
    /// Whether the next process may continue this one.
    is_kept: bool,
    proven_at: MonotonicNs,
    /// Whether discovery has changed since the journal was written.
    is_outdated: bool,
    journal_at: MonotonicNs,
    /// `None` if the role has no standby.
    successor: Option<Successor>,
}

impl Identity {
    /// Opens the participant of the role `name`: that of the former process if nothing speaks against it.
    /// Returns the identity to keep, and whether it is the former one.
    pub fn join(
        role: &mut Role,
        process: ProcessRole,
        name: &str,
        options: &ParticipantOptions,
        standby: Standby,
        open: impl Fn(Kept) -> Result<Participant, DdsError>,
    ) -> Result<(Participant, Self, bool), RoleError> {
        let mut identity = Self {
            board: role.boards.identity_writer(process),
            journal: Journal::of(&role.node, name),
            conditions: conditions(options)?,
            max_unproven: max_unproven(process),
            is_kept: true,
            proven_at: clock::monotonic().plus_ms(PROVEN_AFTER_MS),
            is_outdated: false,
            journal_at: MonotonicNs(0),
            successor: None,
        };
        let sockets = role.sockets();
        let inherited = sockets.len();
        let mut kept = Kept { former: identity.former(role), sockets };
        let mut former = None;
        if kept.former.is_some() {
            identity.board.update(|board| {
                *board = ProcessIdentity { unproven: board.unproven + 1, ..*board }.sealed();
            });
            match open(std::mem::take(&mut kept)) {
                Ok(participant) => former = Some(participant),
                Err(error) => {
                    role.failed();
                    warn!(role = name, %error, "cannot continue the former participant");
                }
            }
        }
        let continued = former.is_some();
        if let Some(participant) = &former {
            role.former.participant = participant.guid();
        } else {
            // Also if the process that has taken it over died before it said so.
            if identity.board.get().is_intact() && role.former.participant == Guid::default() {
                role.former.participant = identity.board.get().participant;
            }
            identity.board.set(ProcessIdentity::default());
            identity.journal.remove();
            // Some of the sockets that the supervisor keeps may be closed here.
            kept_sockets::forget();
        }
        let participant = match former {
            Some(participant) => participant,
            None => open(kept)?,
        };
        role.record_participant(&participant);
        let not_kept = |error: &io::Error| {
            warn!(role = name, %error, "the sockets are not kept; after a kill, what arrives meanwhile is lost");
        };
        match participant.sockets() {
            Ok(sockets) => {
                let _ = kept_sockets::store(&sockets).inspect_err(not_kept);
                // Also if the supervisor does not keep them.
                identity.successor = (standby == Standby::Warm).then(|| role.successor(sockets));
            }
            Err(error) => not_kept(&error),
        }
        if continued {
            identity.journal_at = clock::monotonic().plus_ms(JOURNAL_AFTER_MS);
        }
        let unproven = if continued { identity.board.get().unproven } else { 0 };
        identity.record(&participant, unproven);
        info!(role = name, participant = ?participant.guid(), continued, sockets = inherited, "identity");
        Ok((participant, identity, continued))
    }

    /// What the former process has left, if this one may continue it.
    fn former(&self, role: &mut Role) -> Option<(ParticipantIdentity, Vec<u8>)> {
        let board = *self.board.get();
        let now = clock::monotonic();
        if !may_continue(&board, &role.former, self.conditions, self.max_unproven, now) {
            return None;
        }
        let identity = ParticipantIdentity {
            participant: board.participant,
            participant_id: board.participant_id.try_into().ok()?,
            urgent_port: board.urgent_port.try_into().ok()?,
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
    fn record(&mut self, participant: &Participant, unproven: u64) {
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
        let board = ProcessIdentity {
            participant: used.participant,
            participant_id: used.participant_id.into(),
            urgent_port: used.urgent_port.into(),
            highest_count: ahead(former.highest_count, count, RESERVED_COUNTS.into()),
            highest_number: ahead(former.highest_number, number, RESERVED_NUMBERS),
            conditions: self.conditions,
            unproven,
            alive_at: clock::monotonic(),
            ..ProcessIdentity::default()
        };
        self.board.set(board.sealed());
    }

    /// Updates the board, and the journal if discovery has changed. A process whose threads have not `turned`
    /// is not proven: what it has received may be why, and waits for the next one again.
    pub fn housekeeping(
        &mut self,
        participant: &Participant,
        turned: bool,
        discovery_changed: bool,
        now: MonotonicNs,
    ) {
        let is_proven = turned && now >= self.proven_at;
        let unproven = if is_proven { 0 } else { self.board.get().unproven };
        self.record(participant, unproven);
        if let Some(successor) = &mut self.successor {
            successor.housekeeping();
        }
        self.is_outdated |= discovery_changed;
        if !self.is_kept || !self.is_outdated || now < self.journal_at {
            return;
        }
        self.is_outdated = false;
        // After a stop of 1 s within it, the journal would wait for 20 s by the wall clock.
        let began_ns = clock::thread_cpu_ns();
        if let Err(error) = self.journal.write(participant.guid(), &participant.discovery_journal()) {
            warn!(%error, "cannot write the journal of discovery; after a kill, others match anew");
        }
        self.journal_at = now.plus_ns(clock::thread_cpu_ns().saturating_sub(began_ns) * JOURNAL_SHARE);
    }

    /// How the process ends now that it was asked to.
    pub fn leave(&mut self, participant: &Participant, now: MonotonicNs) -> Leave {
        let Some(successor) = self.successor.as_mut().filter(|_| self.is_kept) else { return Leave::ForGood };
        let leave = successor.leave(now);
        if leave == Leave::ForGood {
            return leave;
        }
        // The next process may not continue one that is not proven, which housekeeping puts on the board.
        if now < self.proven_at || self.board.get().unproven > 0 {
            let gives_up = now >= self.proven_at.plus_ms(PROVEN_AFTER_MS);
            return if gives_up { Leave::ForGood } else { Leave::Soon };
        }
        if leave == Leave::Soon {
            return leave;
        }
        // With what discovery has found since the last housekeeping.
        if let Err(error) = self.journal.write(participant.guid(), &participant.discovery_journal()) {
            warn!(%error, "cannot write the journal of discovery; others match the standby anew");
        }
        if successor.hand_over() { Leave::HandOver } else { Leave::ForGood }
    }

    /// The next process does not continue this one, which says goodbye.
    pub fn end(&mut self) {
        if self.board.get().is_intact() {
            kept_sockets::forget();
        }
        if let Some(successor) = &mut self.successor {
            successor.end();
        }
        self.is_kept = false;
        self.board.set(ProcessIdentity::default());
        self.journal.remove();
    }
}

/// Whether a former process has left an identity that this one may continue.
fn may_continue(
    board: &ProcessIdentity,
    former: &ProcessHealth,
    conditions: u64,
    max_unproven: u64,
    now: MonotonicNs,
) -> bool {
    board.is_intact()
        && board.participant != Guid::default()
        // The former process may have died before it had a participant.
        && [board.participant, Guid::default()].contains(&former.participant)
        && board.conditions == conditions
        && board.unproven < max_unproven
        && former.ended == 0
        && now.since(board.alive_at) <= MAX_AWAY_MS * 1_000_000
}

/// A hash of what the participant announces, and of the addresses that others keep of it.
fn conditions(options: &ParticipantOptions) -> Result<u64, RoleError> {
    let mut addresses = host_addresses()?;
    addresses.sort_unstable();
    let network = options.network;
    let mut hasher = DefaultHasher::new();
    (network.domain_id, format!("{:?}", network.interfaces), addresses).hash(&mut hasher);
    (&options.namespace, &options.node_name, options.graph_gid_bytes).hash(&mut hasher);
    VERSION.hash(&mut hasher);
    Ok(hasher.finish())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_identity_is_given_up_if_others_may_not_know_it_or_it_has_changed() {
        let participant = Guid([3; 16]);
        let alive_at = MonotonicNs(0).plus_ms(60_000);
        let board = ProcessIdentity { participant, conditions: 5, alive_at, ..ProcessIdentity::default() };
        let former = ProcessHealth { participant, ..ProcessHealth::default() };
        let at = |ms| alive_at.plus_ms(ms);
        assert!(may_continue(&board.sealed(), &former, 5, 3, at(200)));
        assert!(may_continue(&board.sealed(), &former, 5, 3, at(MAX_AWAY_MS)));
        assert!(!may_continue(&board.sealed(), &former, 5, 3, at(MAX_AWAY_MS + 1)));
        assert!(!may_continue(&board.sealed(), &former, 6, 3, at(200)));
        assert!(!may_continue(&board, &former, 5, 3, at(200)), "no checksum");
        assert!(!may_continue(&ProcessIdentity::default().sealed(), &ProcessHealth::default(), 0, 3, at(0)));
        let unproven = |unproven| ProcessIdentity { unproven, ..board }.sealed();
        assert!(may_continue(&unproven(2), &former, 5, 3, at(200)));
        assert!(!may_continue(&unproven(3), &former, 5, 3, at(200)));
        assert!(!may_continue(&unproven(1), &former, 5, 1, at(200)));
        let ended = ProcessHealth { ended: 1, ..former };
        assert!(!may_continue(&board.sealed(), &ended, 5, 3, at(200)));
        let without = ProcessHealth { participant: Guid::default(), ..former };
        assert!(may_continue(&board.sealed(), &without, 5, 3, at(200)));
        let of_another = ProcessHealth { participant: Guid([4; 16]), ..former };
        assert!(!may_continue(&board.sealed(), &of_another, 5, 3, at(200)));
    }
}
