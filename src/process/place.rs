//! The place of a process in its bridge: the lock of its role, and shared memory.

use tracing::info;

use super::error::RoleError;
use super::kept_sockets;
use super::reload::{ReloadRequests, WaitingReloads};
use super::scheduling;
use super::standby::{TakeOver, Waiting, take_place};
use super::stop::Stop;
use crate::clock;
use crate::config::{self, Scheduling, Settings};
use crate::model::{Guid, MonotonicNs};
use crate::shm::{Boards, BridgeShape, ProcessRole, RoleLock, ShmError, ShmNode, root_of};

/// The longest time without a process, below the lease of 15 s: then others drop the participant.
pub(super) const MAX_AWAY_MS: u64 = 10_000;

/// What a process has before it opens anything of DDS.
pub(super) struct Place {
    pub lock: RoleLock,
    pub node: ShmNode,
    pub boards: Boards,
    pub reloads: WaitingReloads,
    /// What it has from waiting for the end of another process; `None` if it did not wait.
    pub take_over: Option<TakeOver>,
}

impl Place {
    /// Locks the role `name`, applies `scheduling` and attaches to shared memory.
    ///
    /// # Errors
    /// Another process serves the role, or shared memory is not available.
    pub fn take(
        settings: &Settings,
        requests: ReloadRequests,
        name: &str,
        scheduling: &Scheduling,
    ) -> Result<Self, RoleError> {
        // Before the scheduling, which is for the data path: the reload thread runs without it.
        let reloads = WaitingReloads::start(requests, settings)?;
        let lock = RoleLock::acquire(&root_of(settings), &settings.instance, name)?;
        let (node, boards) = attach(settings, name, scheduling)?;
        Ok(Self { lock, node, boards, reloads, take_over: None })
    }

    /// Like [`take`](Self::take), but with a `standby` a process that finds the role taken waits until the
    /// other process ends, and calls `prepare` at first and about every 50 ms meanwhile. `None` if `stop` was
    /// requested.
    ///
    /// # Errors
    /// Without a standby another process serves the role, with one another process waits for it; or shared
    /// memory is not available.
    pub fn wait(
        settings: &Settings,
        requests: ReloadRequests,
        role: (ProcessRole, &str),
        scheduling: &Scheduling,
        standby: config::Standby,
        stop: &Stop,
        prepare: &mut dyn FnMut(&ShmNode, &Settings),
    ) -> Result<Option<Self>, RoleError> {
        let (_, name) = role;
        let mut reloads = WaitingReloads::start(requests, settings)?;
        let lock = match RoleLock::acquire(&root_of(settings), &settings.instance, name) {
            Err(ShmError::AlreadyServed { .. }) if standby == config::Standby::Warm => None,
            lock => Some(lock?),
        };
        let mut place = None;
        if lock.is_none() {
            // Before the rest: a process that takes the role over needs the CPU time which this one takes to
            // attach, and to clean up after the one that died.
            place = take_place(settings, name, stop)?;
            if place.is_none() {
                return Ok(None);
            }
        }
        let (node, boards) = attach(settings, name, scheduling)?;
        // If both processes of the role have died, the one whose supervisor has the sockets goes first.
        let gives_way = standby == config::Standby::Warm
            && !kept_sockets::are_inherited()
            && has_died_lately(&boards, role.0, clock::monotonic());
        if let Some(lock) = lock.filter(|_| !gives_way) {
            return Ok(Some(Self { lock, node, boards, reloads, take_over: None }));
        }
        let place = match place {
            None => take_place(settings, name, stop)?,
            place => place,
        };
        let Some(place) = place else { return Ok(None) };
        let mut waiting = Waiting::open(settings, place, role, &boards)?;
        let mut prepare = || {
            reloads.discard_requests();
            prepare(&node, &reloads.in_force.settings);
        };
        let Some(lock) = waiting.wait(settings, name, stop, &mut prepare)? else { return Ok(None) };
        reloads.refresh();
        Ok(Some(Self { lock, node, boards, reloads, take_over: Some(waiting.take_over()) }))
    }

    /// The settings in force.
    pub fn settings(&self) -> &Settings {
        &self.reloads.in_force.settings
    }
}

/// Whether a process of that role has died lately, whose sockets its supervisor keeps for another process.
fn has_died_lately(boards: &Boards, role: ProcessRole, now: MonotonicNs) -> bool {
    boards.identity(role).is_some_and(|left| {
        left.is_intact()
            && left.participant != Guid::default()
            && now.since(left.alive_at) <= MAX_AWAY_MS * 1_000_000
    })
}

fn attach(settings: &Settings, name: &str, scheduling: &Scheduling) -> Result<(ShmNode, Boards), RoleError> {
    scheduling::apply(scheduling);
    let node = ShmNode::open(&root_of(settings), &settings.instance, name)?;
    let cleaned = node.cleaned_up();
    if cleaned.dead_processes > 0 {
        info!(
            dead_processes = cleaned.dead_processes,
            not_yet = cleaned.failed,
            "cleaned up in shared memory after processes that died"
        );
    }
    let boards = node.boards(&BridgeShape::of(settings))?;
    Ok((node, boards))
}

#[cfg(test)]
mod tests {
    use std::fs;
    use std::path::Path;
    use std::time::Duration;

    use super::super::test_role::{SCAN, wait_until};
    use super::*;

    /// How many files and folders are below a folder.
    fn entries(folder: &Path) -> usize {
        // A file has no entries: to read it as a folder fails.
        fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| 1 + entries(&entry.path())).sum()
    }

    #[test]
    fn a_process_attaches_to_shared_memory_when_the_take_over_of_its_role_is_complete() {
        const ROLE: &str = "ingress";
        let folder = tempfile::tempdir().unwrap();
        let instance = format!("place_{}", std::process::id());
        let root = folder.path().display();
        let text = format!("instance: {instance}\nshared_memory: {{root_path: {root}}}\n{SCAN}\n");
        let settings = config::parse(&text, "f.yaml", &|_| None).unwrap();
        let acquired = |acquire: fn(&Path, &_, &str) -> Result<RoleLock, ShmError>| {
            acquire(&root_of(&settings), &settings.instance, ROLE).unwrap()
        };
        let (_active, taking_over) = (acquired(RoleLock::acquire), acquired(RoleLock::acquire_standby));
        let before = entries(folder.path());
        let stop = Stop::default();
        std::thread::scope(|scope| {
            let next = scope.spawn(|| {
                let read = settings.clone();
                let reloads = ReloadRequests::on_signal(move |_| Ok(read.clone().into())).unwrap();
                let role = (ProcessRole::Ingress, ROLE);
                let (scheduling, warm) = (Scheduling::default(), config::Standby::Warm);
                Place::wait(&settings, reloads, role, &scheduling, warm, &stop, &mut |_, _| ())
            });
            // Longer than it takes to attach.
            std::thread::sleep(Duration::from_millis(300));
            let during = entries(folder.path());
            drop(taking_over);
            wait_until("it attaches", || entries(folder.path()) > before + 1);
            stop.request();
            assert!(next.join().unwrap().unwrap().is_none());
            assert_eq!(during, before, "it has attached while another process took the role over");
        });
    }
}
