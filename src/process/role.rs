//! What every role begins with and ends by.

use std::fmt;
use std::path::PathBuf;

use tracing::info;

use super::notify::Notifier;
use super::reload::{Look, ReloadRequests, Reloads};
use super::scheduling;
use crate::clock;
use crate::config::{Configuration, Scheduling, Settings};
use crate::dds::{DdsError, Participant, ParticipantOptions};
use crate::model::{Guid, MonotonicNs, ProcessHealth};
use crate::shm::{BoardWriter, Boards, BridgeShape, ProcessRole, RoleLock, ShmError, ShmNode, default_root};

/// Why a role could not start, or had to end.
#[derive(Debug)]
pub enum RoleError {
    /// The configuration has no lane of that name.
    NoSuchLane {
        /// The name.
        name: String,
        /// The lanes there are.
        lanes: Vec<String>,
    },
    /// No process serves the lane.
    NotRunning {
        /// The bridge.
        instance: String,
        /// The lane.
        lane: String,
    },
    /// Shared memory.
    Shm(ShmError),
    /// DDS.
    Dds(DdsError),
    /// The operating system refused something else.
    Os(std::io::Error),
}

impl fmt::Display for RoleError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoSuchLane { name, lanes } => {
                write!(f, "there is no lane {name}; the configuration has: {}", lanes.join(", "))
            }
            Self::NotRunning { instance, lane } => write!(
                f,
                "no process serves lane {lane} of instance {instance}; start it with \
                 `adaptive-bridge egress --lane {lane}` or `adaptive-bridge up`"
            ),
            Self::Shm(error) => error.fmt(f),
            Self::Dds(error) => error.fmt(f),
            Self::Os(error) => error.fmt(f),
        }
    }
}

impl std::error::Error for RoleError {}

impl From<ShmError> for RoleError {
    fn from(error: ShmError) -> Self {
        Self::Shm(error)
    }
}

impl From<DdsError> for RoleError {
    fn from(error: DdsError) -> Self {
        Self::Dds(error)
    }
}

impl From<std::io::Error> for RoleError {
    fn from(error: std::io::Error) -> Self {
        Self::Os(error)
    }
}

/// The number of the lane called `name`.
pub(super) fn lane_index(settings: &Settings, name: &str) -> Result<usize, RoleError> {
    settings.lanes.iter().position(|lane| lane.name.as_str() == name).ok_or_else(|| RoleError::NoSuchLane {
        name: name.to_owned(),
        lanes: settings.lanes.iter().map(|lane| lane.name.to_string()).collect(),
    })
}

/// The folder of the bridge's shared files, for these settings and this environment.
pub(super) fn root(settings: &Settings) -> PathBuf {
    default_root(settings.shared_memory.root_path.as_deref(), |name| std::env::var_os(name))
}

/// A role that is up: nobody else serves it, shared memory is attached, health is shown.
pub(super) struct Role {
    pub node: ShmNode,
    pub boards: Boards,
    reloads: Reloads,
    health: BoardWriter<ProcessHealth>,
    notifier: Notifier,
    /// The participant of the process that served the role before; all zero for none.
    former_participant: Guid,
    /// Last, so that the role is free only when everything else is gone.
    _lock: RoleLock,
}

impl Role {
    /// Takes the role `name`, applies its scheduling and attaches to shared memory.
    pub fn open(
        settings: &Settings,
        requests: ReloadRequests,
        role: ProcessRole,
        name: &str,
        how: &Scheduling,
    ) -> Result<Self, RoleError> {
        let root = root(settings);
        let lock = RoleLock::acquire(&root, &settings.instance, name)?;
        // Before the scheduling, which is for the data path: a file is read at leisure.
        let reloads = Reloads::start(requests, settings, lock.note_path())?;
        scheduling::apply(how);
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
        let former_participant = health.get().participant;
        health.update(|health| {
            let starts = health.starts + 1;
            *health = ProcessHealth {
                pid: u64::from(std::process::id()),
                started_at: now,
                alive_at: now,
                starts,
                settings_fingerprint: reloads.fingerprint(),
                ..ProcessHealth::default()
            };
        });
        Ok(Self { node, boards, reloads, health, notifier: Notifier::new(), former_participant, _lock: lock })
    }

    /// Opens the role's DDS participant. If the process that served the role before was killed, the others
    /// are told that its participant is gone.
    pub fn join(&mut self, options: &ParticipantOptions) -> Result<Participant, RoleError> {
        let participant = Participant::open(options)?;
        self.joined(&participant);
        Ok(participant)
    }

    /// Like [`join`](Self::join), with what the thread that receives is to do; see
    /// [`Participant::open_receiving`]. The others are told only by
    /// [`dispose_former`](Self::dispose_former).
    pub fn join_receiving(
        &mut self,
        options: &ParticipantOptions,
        on_arriving: impl FnMut(Guid, i64, usize) + Send + 'static,
        on_received: impl FnMut() -> bool + Send + 'static,
    ) -> Result<Participant, RoleError> {
        let participant = Participant::open_receiving(options, on_arriving, on_received)?;
        self.show(&participant);
        Ok(participant)
    }

    fn joined(&mut self, participant: &Participant) {
        self.dispose_former(participant);
        self.show(participant);
    }

    /// Tells the other participants, once, that the participant of a killed predecessor is gone. A writer
    /// then lets go of the samples that only the predecessor had not acknowledged.
    pub fn dispose_former(&mut self, participant: &Participant) {
        participant.say_goodbye_for(std::mem::take(&mut self.former_participant));
    }

    /// Whether the participant of a killed predecessor has yet to be disposed of.
    pub fn has_former(&self) -> bool {
        self.former_participant != Guid::default()
    }

    fn show(&mut self, participant: &Participant) {
        let guid = participant.guid();
        self.health.update(|health| health.participant = guid);
    }

    /// Takes over what was reloaded since the last look, if anything was, and shows it. What is yielded then
    /// is the configuration in force from now on, for the role to apply.
    pub fn reload(&mut self) -> Option<&Configuration> {
        let look = self.reloads.look();
        if look == Look::Nothing {
            return None;
        }
        let (fingerprint, refused) = (self.reloads.fingerprint(), self.reloads.refused());
        self.health.update(|health| {
            health.settings_fingerprint = fingerprint;
            health.refused_reloads = refused;
        });
        self.notifier.reloaded(look == Look::Refused);
        (look == Look::Reloaded).then(|| self.reloads.configuration())
    }

    /// The role is up: its DDS endpoints are there, but for those whose type discovery has yet to tell.
    pub fn ready(&mut self) {
        self.notifier.ready();
    }

    /// Says what the role does, about once a second, if anybody listens. `describe` writes a line.
    pub fn status(&mut self, now: MonotonicNs, describe: impl FnOnce(&mut String)) {
        self.notifier.status(now, describe);
    }

    /// The role begins to end.
    pub fn stopping(&self) {
        self.notifier.stopping();
    }

    /// Counts a failure that cost no sample.
    pub fn failed(&mut self) {
        self.health.update(|health| health.errors += 1);
    }

    /// Shows that the data path turned, and what it applies.
    pub fn turned(&mut self, mode: u8, policy_epoch: u64) {
        let now = clock::monotonic();
        self.health.update(|health| {
            health.alive_at = now;
            health.turns += 1;
            health.mode = mode;
            health.policy_epoch = policy_epoch;
        });
        self.notifier.turned(now);
    }
}

impl Drop for Role {
    fn drop(&mut self) {
        if !std::thread::panicking() {
            self.health.update(|health| health.ended = 1);
        }
    }
}

/// The ROS 2 namespace of a bridge's nodes: that of the default instance is short.
pub(super) fn namespace(settings: &Settings) -> String {
    match settings.instance.as_str() {
        "default" => "/adaptive_bridge".to_owned(),
        instance => format!("/adaptive_bridge/{instance}"),
    }
}
