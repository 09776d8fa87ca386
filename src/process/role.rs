//! Start-up and shutdown that ingress, egress and control share: lock, reloads, scheduling, shared memory,
//! health, DDS participant.

use tracing::info;

use super::error::RoleError;
use super::notify::Notifier;
use super::parameter_store::ParameterStore;
use super::reload::{ReloadRequests, Reloads};
use super::scheduling;
use crate::clock;
use crate::config::{Configuration, DdsNetwork, Scheduling, Settings};
use crate::dds::{Participant, ParticipantOptions};
use crate::model::{MonotonicNs, NetworkRefusals, ProcessHealth};
use crate::shm::{BoardWriter, Boards, BridgeShape, ProcessRole, RoleLock, ShmError, ShmNode, root_of};
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
    /// The last field, so that the lock is released only after everything else is dropped.
    _lock: RoleLock,
}

impl Role {
    /// Locks the role `name`, applies its scheduling and attaches to shared memory.
    pub fn open(
        settings: &Settings,
        requests: ReloadRequests,
        role: ProcessRole,
        name: &str,
        scheduling: &Scheduling,
    ) -> Result<Self, RoleError> {
        let root = root_of(settings);
        let lock = RoleLock::acquire(&root, &settings.instance, name)?;
        // Before the scheduling, which is for the data path: the reload thread runs without it.
        let reloads = Reloads::start(requests, settings, lock.note_path())?;
        scheduling::apply(scheduling);
        let node = ShmNode::open(&root, &settings.instance, name)?;
        let cleaned = node.cleaned_up();
        if cleaned.dead_processes > 0 {
            info!(
                dead_processes = cleaned.dead_processes,
                not_yet = cleaned.failed,
                "cleaned up in shared memory after processes that died"
            );
        }
        let boards = node.boards(&BridgeShape::of(settings))?;
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
        Ok(Self { node, boards, reloads, health, notifier: Notifier::new(), former, _lock: lock })
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
