//! What ingress, egress and control share while they serve their role: reloads, health, DDS participant,
//! shutdown.

use std::net::UdpSocket;

use super::error::RoleError;
use super::kept_sockets;
use super::notify::Notifier;
use super::parameter_store::ParameterStore;
use super::place::Place;
use super::reload::Reloads;
use super::standby::TakeOver;
use super::successor::Successor;
use crate::clock;
use crate::config::{Configuration, DdsNetwork, Settings};
use crate::dds::{Participant, ParticipantOptions};
use crate::model::{MonotonicNs, NetworkRefusals, ProcessHealth};
use crate::shm::{BoardWriter, Boards, ProcessRole, RoleLock, ShmError, ShmNode};
use crate::telemetry;

pub(super) fn lane_index(settings: &Settings, name: &str) -> Result<usize, RoleError> {
    settings.lanes.iter().position(|lane| lane.name.as_str() == name).ok_or_else(|| RoleError::NoSuchLane {
        name: name.to_owned(),
        lanes: settings.lanes.iter().map(|lane| lane.name.to_string()).collect(),
    })
}

/// A process that is up: it holds the lock of its role, has shared memory attached and writes its health.
pub(super) struct Role {
    pub node: ShmNode,
    pub boards: Boards,
    reloads: Reloads,
    health: BoardWriter<ProcessHealth>,
    pub notifier: Notifier,
    /// What the former process wrote last; its participant is all zero once it is disposed of.
    pub former: ProcessHealth,
    /// Until a process that was a standby is up.
    take_over: Option<TakeOver>,
    /// The last field, so that the lock is released only after everything else is dropped.
    lock: RoleLock,
}

impl Role {
    /// Begins to serve the role of `place`.
    pub fn open(place: Place, role: ProcessRole) -> Self {
        let Place { lock, node, boards, reloads, take_over } = place;
        let reloads = reloads.begin(lock.note_path());
        let mut health = boards.health_writer(role);
        let now = clock::monotonic();
        let former = *health.get();
        health.update(|health| {
            let starts = health.starts + 1;
            *health = ProcessHealth {
                pid: u64::from(std::process::id()),
                started_at: now,
                alive_at: now,
                starts,
                settings_fingerprint: reloads.in_force.settings.fingerprint(),
                ..ProcessHealth::default()
            };
        });
        Self { node, boards, reloads, health, notifier: Notifier::new(), former, take_over, lock }
    }

    /// The sockets that this process goes on with, from the process that it has taken the role over from, or
    /// else from its supervisor. Once.
    pub fn sockets(&mut self) -> Vec<UdpSocket> {
        match &mut self.take_over {
            Some(take_over) => std::mem::take(&mut take_over.sockets),
            None => kept_sockets::inherited(),
        }
    }

    /// Sends `sockets` to the standby of this role.
    pub fn successor(&self, sockets: Vec<UdpSocket>) -> Successor {
        Successor::new(self.lock.standby_socket(), sockets)
    }

    /// Opens the DDS participant. If the former process was killed, the participant disposes of
    /// that process's participant, so that the others remove it.
    pub fn join(&mut self, options: &ParticipantOptions) -> Result<Participant, RoleError> {
        let participant = Participant::open(options)?;
        self.record_participant(&participant);
        self.dispose_former(&participant);
        Ok(participant)
    }

    /// Announces to the other participants, once, that the participant of a killed former process is gone,
    /// unless this process continues it. A writer then releases the samples that only the former process had
    /// not acknowledged.
    pub fn dispose_former(&mut self, participant: &Participant) {
        let former = std::mem::take(&mut self.former.participant);
        if former != participant.guid() {
            participant.dispose_participant(former);
        }
    }

    /// Writes the participant to the health board, for a successor that has to dispose of it.
    pub fn record_participant(&mut self, participant: &Participant) {
        let guid = participant.guid();
        self.health.update(|health| health.participant = guid);
    }

    /// Returns the new configuration in force if a reload has completed since the last call, for the caller
    /// to apply. Writes the outcome to the health board and to the service manager.
    pub fn reload(&mut self) -> Option<&Configuration> {
        let is_valid = self.reloads.poll()?;
        self.health.update(|health| {
            health.settings_fingerprint = self.reloads.in_force.settings.fingerprint();
            health.refused_reloads = self.reloads.refused;
        });
        self.notifier.reloaded(!is_valid);
        is_valid.then_some(&self.reloads.in_force)
    }

    /// Sets parameters of the whole bridge; `None` for a process that reads no configuration file.
    pub fn parameter_store(&self) -> Option<ParameterStore> {
        self.reloads.parameters.clone()
    }

    /// Sends the status line of `describe`, and logs how many log lines were left out, once a second.
    pub fn status(&mut self, now: MonotonicNs, describe: impl FnOnce(&mut String)) {
        self.notifier.status(now, describe);
        telemetry::log_left_out(now);
    }

    /// Counts an error that dropped no sample.
    pub fn failed(&mut self) {
        self.health.update(|health| health.errors += 1);
    }

    /// Records a turn of the data path, the mode and policy that it applies, and what its participants have
    /// refused of the network; feeds the watchdog.
    pub fn report_turn(&mut self, mode: u8, policy_epoch: u64, network_refusals: NetworkRefusals) {
        let now = clock::monotonic();
        self.health.update(|health| {
            health.alive_at = now;
            health.turns += 1;
            health.mode = mode;
            health.policy_epoch = policy_epoch;
            health.network_refusals = network_refusals;
        });
        self.notifier.feed_watchdog(now);
    }

    /// Opens queues or pools beside the participant, which `join` opens: either takes 5 to 8 ms, for which a
    /// take-over waits.
    ///
    /// # Errors
    /// Either fails. If shared memory does, the process ends as if it were killed: dropped, the participant
    /// would say goodbye, and the role would record a regular end. After either, the next process could not
    /// continue it.
    pub fn open_beside<M: Send, J>(
        mut self,
        open: impl FnOnce(&ShmNode, &Boards) -> Result<M, ShmError> + Send,
        join: impl FnOnce(&mut Self) -> Result<J, RoleError>,
    ) -> Result<(Self, M, J), RoleError> {
        let (node, boards) = (self.node.clone(), self.boards.clone());
        let (opened, joined) = std::thread::scope(|scope| {
            let opened = scope.spawn(|| open(&node, &boards));
            let joined = join(&mut self);
            (opened.join(), joined)
        });
        match opened.unwrap_or_else(|panic| std::panic::resume_unwind(panic)) {
            Ok(memory) => Ok((self, memory, joined?)),
            Err(error) => {
                std::mem::forget((self, joined));
                Err(error.into())
            }
        }
    }

    /// The process is up. Not in [`report_turn`](Self::report_turn), which may wait until the threads of the
    /// DDS library have turned, for 0.1 s.
    pub fn is_up(&mut self) {
        if let Some(take_over) = self.take_over.take() {
            take_over.complete();
        }
        self.notifier.ready();
    }
}

impl Drop for Role {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            self.health.update(|health| health.ended = 1);
        }
    }
}

pub(super) fn participant_options<'a>(
    settings: &Settings,
    network: &'a DdsNetwork,
    process: &str,
) -> ParticipantOptions<'a> {
    ParticipantOptions {
        network,
        namespace: settings.node_namespace.clone(),
        node_name: settings.node_name_of(process),
        graph_gid_bytes: settings.graph_gid_bytes,
        dscp: 0,
    }
}
