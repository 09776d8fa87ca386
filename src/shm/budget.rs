//! The shared memory that the pools of all routes may take, and the slots of one pool that have it.
//!
//! iceoryx2 maps a pool with slots of the largest sample, of which only the headers exist at the start.
//! Before ingress writes a payload into a slot, it allocates the pages that the payload needs. So a page that
//! does not exist is never touched: SIGBUS kills a process that touches one when the file system is full.

use std::fs::{self, File, OpenOptions};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use nix::errno::Errno;
use nix::fcntl::{FallocateFlags, fallocate};
use nix::sys::sysinfo::sysinfo;

use super::channel::{LOANED_SLOTS, PoolSize, RouteChannel, SLOT_HEADER_BYTES, page_bytes};
use super::error::ShmError;
use super::root::SHM_DIR;
use super::segment::{free_bytes, no_room};
use crate::config::{Route, Settings};
use crate::model::{Backlog, FixedText, MonotonicNs};
use crate::policy::{BudgetRefusal, MemoryBudget, PoolDemand};

/// The budget if the configuration sets none: this, or a quarter of the machine's memory if that is less,
/// which is half of what `/dev/shm` has by default. Nothing is allocated for it: it only bounds what stalled
/// lanes may hold. Two stalled lanes with five cameras of 6 MB hold 1.6 GiB.
pub const DEFAULT_BUDGET_BYTES: u64 = 2 << 30;
const DEFAULT_BUDGET_DIVISOR: u64 = 4;

/// The most bytes of the samples that ingress keeps of a route: 1.3 s of 64 KiB at 200 Hz. Of all routes, and
/// the share of the budget: what a lane that restarts may lack must not be what the present samples need.
const MAX_BACKLOG_BYTES: u64 = 16 << 20;
const MAX_BACKLOG_BYTES_IN_ALL: u64 = 128 << 20;
const BACKLOG_DIVISOR: u64 = 8;

/// The unit in which slots note when they had a sample: 0.1 s, as ingress does its housekeeping. 32 bits hold
/// 13 years.
const TICK_MS: u64 = 100;

/// Until a pool is searched again after a search found no idle slot that is free: slots that stopped lanes
/// hold, or that are retained, may be idle for long.
const SEARCH_AGAIN_TICKS: u32 = 10;

/// Why a slot gets no memory for its payload.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum NoMemory {
    /// One route may hold no more.
    #[error("the route holds as much of shared_memory.budget_bytes as one route may")]
    Quota,
    /// The budget is used up, or the rest is kept for other routes.
    #[error("shared_memory.budget_bytes is used up, or the rest is kept for other routes")]
    Budget,
    /// The file system has no room.
    #[error("/dev/shm is full")]
    FileSystem,
    /// The kernel refused.
    #[error("cannot allocate shared memory: {0}")]
    System(Errno),
    /// The pool is not where it should be.
    #[error("the slot is outside of its pool")]
    NoSuchSlot,
}

/// What the pool of a route takes of the budget.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PoolUse {
    /// What the pool has now.
    pub used_bytes: u64,
    /// The most that it ever had.
    pub peak_bytes: u64,
    /// The budget of all pools.
    pub budget_bytes: u64,
    /// What all pools have now.
    pub budget_used_bytes: u64,
    /// The most that all pools together ever had.
    pub budget_peak_bytes: u64,
}

/// The shared memory of all pools of ingress.
#[derive(Debug)]
pub struct PoolBudget {
    state: Mutex<MemoryBudget>,
}

impl PoolBudget {
    /// The budget of the configured routes.
    pub fn of(settings: &Settings) -> Arc<Self> {
        let demand = |index| demand_of(&RouteChannel::of(settings, index), settings.is_critical(index));
        let demands: Vec<_> = (0..settings.routes.len()).map(demand).collect();
        Arc::new(Self { state: Mutex::new(MemoryBudget::new(budget_bytes(settings), &demands)) })
    }

    /// A budget for pools of the critical lane.
    pub fn of_channels(channels: &[RouteChannel], bytes: u64) -> Arc<Self> {
        let demand = |channel: &RouteChannel| demand_of(channel, true);
        let demands: Vec<_> = channels.iter().map(demand).collect();
        Arc::new(Self { state: Mutex::new(MemoryBudget::new(bytes, &demands)) })
    }

    /// What the pool of a route takes.
    pub fn usage(&self, route: usize) -> PoolUse {
        let state = self.lock();
        let (used_bytes, peak_bytes) = state.used_and_peak_of(route);
        let (budget_used_bytes, budget_peak_bytes) = state.used_and_peak();
        let budget_bytes = state.limit_bytes();
        PoolUse { used_bytes, peak_bytes, budget_bytes, budget_used_bytes, budget_peak_bytes }
    }

    #[allow(clippy::disallowed_methods, reason = "held for a sum over the routes, when a slot grows")]
    fn lock(&self) -> MutexGuard<'_, MemoryBudget> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

fn demand_of(channel: &RouteChannel, is_critical: bool) -> PoolDemand {
    let pool = channel.pool_size();
    let steady_samples = (channel.retained_samples + LOANED_SLOTS + 1) as u64;
    PoolDemand { first_bytes: pool.first_bytes, most_bytes: pool.bytes, steady_samples, is_critical }
}

/// The most bytes of samples that ingress keeps of one route for a lane that restarts: an equal share,
/// because all routes together take at most an eighth of the budget.
pub fn backlog_bytes(settings: &Settings) -> u64 {
    let all = MAX_BACKLOG_BYTES_IN_ALL.min(budget_bytes(settings) / BACKLOG_DIVISOR);
    MAX_BACKLOG_BYTES.min(all / settings.routes.len().max(1) as u64)
}

/// The most bytes of samples that ingress keeps of these routes, whatever the budget.
pub fn most_backlog_bytes<'a>(routes: impl Iterator<Item = &'a Route>) -> u64 {
    let of_route = |route: &Route| (route.backlog_samples * route.max_sample_bytes) as u64;
    let of_all: u64 = routes.map(|route| of_route(route).min(MAX_BACKLOG_BYTES)).sum();
    of_all.min(MAX_BACKLOG_BYTES_IN_ALL)
}

/// The budget of the configuration, or the default on this machine.
pub fn budget_bytes(settings: &Settings) -> u64 {
    settings.shared_memory.budget_bytes.unwrap_or_else(|| {
        let machine = sysinfo().map_or(u64::MAX, |info| info.ram_total());
        DEFAULT_BUDGET_BYTES.min(machine / DEFAULT_BUDGET_DIVISOR)
    })
}

/// The slots of a pool, and how much of each exists.
#[derive(Debug)]
pub(super) struct SlotMemory {
    file: File,
    /// The name of the file.
    name: FixedText,
    /// The address of the first slot, and its place in the file.
    first_address: usize,
    first_offset: u64,
    pool: PoolSize,
    /// The pages of each slot that exist, from its beginning. Only the thread that holds a slot changes them.
    pages: Box<[AtomicU32]>,
    /// When a payload needed most of these pages last, in ticks.
    used_at: Box<[AtomicU32]>,
    /// The time of the last housekeeping, in ticks.
    now: AtomicU32,
    /// The largest class of a complete sample.
    noted_bytes: AtomicU64,
    /// Not before this tick are idle slots searched for.
    search_at: AtomicU32,
    budget: Arc<PoolBudget>,
    route: usize,
}

impl SlotMemory {
    /// Finds the file of a pool by the address of the payload in its first slot, and allocates what the pool
    /// takes at the start.
    ///
    /// iceoryx2 has written the description of the pool before, so the page of the first header exists.
    pub(super) fn find(
        first_payload: usize,
        pool: PoolSize,
        budget: &Arc<PoolBudget>,
        route: usize,
        what: &str,
    ) -> Result<Self, ShmError> {
        let usage = budget.usage(route);
        if usage.budget_used_bytes > usage.budget_bytes {
            return Err(ShmError::BudgetTooSmall {
                needed_bytes: usage.budget_used_bytes,
                budget_bytes: usage.budget_bytes,
            });
        }
        let failure =
            |reason: String| ShmError::failed(format!("to find {what}"), Path::new(SHM_DIR), reason);
        let first_address = first_payload - SLOT_HEADER_BYTES;
        let mapping = Mapping::at(first_address).ok_or_else(|| failure("it is not mapped".to_owned()))?;
        let file = OpenOptions::new().read(true).write(true).open(&mapping.path);
        let file = file.map_err(|error| ShmError::os("to open a pool", &mapping.path, &error))?;
        let length = file.metadata().map_err(|error| failure(error.to_string()))?.len();
        let first_offset = (first_address - mapping.start) as u64 + mapping.offset;
        let end = first_offset + pool.slots as u64 * pool.stride_bytes;
        if first_offset + SLOT_HEADER_BYTES as u64 > page_bytes() || end > length {
            return Err(failure(format!("its first slot is at {first_offset}, it has {length} bytes")));
        }
        let pages = if pool.is_sparse { 1 } else { u32::MAX };
        let pages = (0..pool.slots).map(|_| AtomicU32::new(pages)).collect();
        let name = mapping.path.file_name().and_then(|name| name.to_str()).unwrap_or_default();
        let slots = Self {
            file,
            name: FixedText::new(name),
            first_address,
            first_offset,
            pool,
            pages,
            used_at: (0..pool.slots).map(|_| AtomicU32::new(0)).collect(),
            now: AtomicU32::new(0),
            noted_bytes: AtomicU64::new(0),
            search_at: AtomicU32::new(0),
            budget: budget.clone(),
            route,
        };
        let no_room = |errno| match errno {
            Errno::ENOSPC => no_room(what, pool.first_bytes, free_bytes()),
            errno => ShmError::os("to reserve shared memory", Path::new(SHM_DIR), &errno.into()),
        };
        if pool.is_sparse {
            for slot in 0..pool.slots {
                slots.allocate(slot, 0, 1).map_err(no_room)?;
            }
            // The end of the last slot shares its page with the free list.
            let tail = (end / page_bytes()) * page_bytes();
            allocate(&slots.file, tail, length - tail).map_err(no_room)?;
        } else {
            allocate(&slots.file, 0, length).map_err(no_room)?;
        }
        Ok(slots)
    }

    /// What the pool takes of the budget.
    pub(super) fn usage(&self) -> PoolUse {
        self.budget.usage(self.route)
    }

    /// The name of the pool's file, and where a payload at this address begins in it.
    pub(super) fn place(&self, payload: usize) -> (FixedText, u64) {
        (self.name, self.first_offset + payload.wrapping_sub(self.first_address) as u64)
    }

    /// Where the slots are, for a backlog of which no sample is kept yet.
    pub(super) fn empty_backlog(&self) -> Backlog {
        Backlog {
            first_sequence: 0,
            first_offset: self.first_offset,
            stride_bytes: self.pool.stride_bytes,
            slots: self.pool.slots as u64,
            pool: self.name,
        }
    }

    /// Notes the size of a complete sample, of which other routes leave this one room for a steady flow. What
    /// the first fragment of a sample claims is not noted: anybody may send one.
    pub(super) fn note_sample(&self, len: usize) {
        if self.pool.is_sparse {
            let bytes = self.class_bytes(len);
            if self.noted_bytes.fetch_max(bytes, Ordering::Relaxed) < bytes {
                self.budget.lock().note_sample(self.route, bytes);
            }
        }
    }

    /// The bytes of a slot for a sample of that length.
    fn class_bytes(&self, len: usize) -> u64 {
        let needed = (self.first_offset + (SLOT_HEADER_BYTES + len) as u64).div_ceil(page_bytes()) as u32;
        let most = (self.pool.stride_bytes / page_bytes()) as u32;
        u64::from(size_class(needed).min(most)) * page_bytes()
    }

    /// Makes sure that the pages of a payload exist, in a slot that the caller holds.
    pub(super) fn ensure(&self, payload: usize, len: usize) -> Result<(), NoMemory> {
        if len == 0 || !self.pool.is_sparse {
            return Ok(());
        }
        let slot = self.slot_of(payload).ok_or(NoMemory::NoSuchSlot)?;
        let pages = &self.pages[slot];
        let present = pages.load(Ordering::Relaxed);
        let needed = (self.first_offset + (SLOT_HEADER_BYTES + len) as u64).div_ceil(page_bytes()) as u32;
        // What lies beyond the pages of this slot is on the first page of the next one, or of the free list.
        let most = (self.pool.stride_bytes / page_bytes()) as u32;
        if needed.min(most) <= present {
            if needed > present / 2 {
                self.note_use(slot);
            }
            return Ok(());
        }
        let wanted = size_class(needed).min(most);
        let more = u64::from(wanted - present) * page_bytes();
        self.budget.lock().take(self.route, more).map_err(|refusal| match refusal {
            BudgetRefusal::Quota => NoMemory::Quota,
            BudgetRefusal::Budget => NoMemory::Budget,
        })?;
        if let Err(errno) = self.allocate(slot, present, wanted) {
            let mut budget = self.budget.lock();
            budget.give_back(self.route, more);
            budget.note_refusal();
            return Err(if errno == Errno::ENOSPC { NoMemory::FileSystem } else { NoMemory::System(errno) });
        }
        pages.store(wanted, Ordering::Relaxed);
        self.note_use(slot);
        Ok(())
    }

    fn note_use(&self, slot: usize) {
        self.used_at[slot].store(self.now.load(Ordering::Relaxed), Ordering::Relaxed);
    }

    /// Notes the time, and returns for how many ticks a slot must be idle to give its memory back, if there
    /// is such a slot. The caller then passes the free ones to [`give_back`](Self::give_back).
    pub(super) fn find_idle(&self, now: MonotonicNs) -> Option<u32> {
        let tick = (now.0 / (TICK_MS * 1_000_000)) as u32;
        self.now.store(tick, Ordering::Relaxed);
        let idle_ms = self.budget.lock().idle_ms(now);
        let is_due = tick.wrapping_sub(self.search_at.load(Ordering::Relaxed)).cast_signed() >= 0;
        if !is_due || !self.pool.is_sparse {
            return None;
        }
        let ticks = (idle_ms / TICK_MS) as u32;
        if (0..self.pool.slots).any(|slot| self.is_idle(slot, ticks)) {
            self.search_at.store(tick.wrapping_add(SEARCH_AGAIN_TICKS), Ordering::Relaxed);
            return Some(ticks);
        }
        None
    }

    fn is_idle(&self, slot: usize, ticks: u32) -> bool {
        let since = self.used_at[slot].load(Ordering::Relaxed);
        let idle = self.now.load(Ordering::Relaxed).wrapping_sub(since);
        self.pages[slot].load(Ordering::Relaxed) > 1 && idle >= ticks
    }

    /// Gives the memory of a slot that the caller holds back, `most_bytes` from its end and not the page of
    /// its header, if the slot has been idle for so many ticks. Returns the bytes.
    pub(super) fn give_back(&self, payload: usize, ticks: u32, most_bytes: u64) -> u64 {
        let Some(slot) = self.slot_of(payload).filter(|&slot| self.is_idle(slot, ticks)) else { return 0 };
        let present = self.pages[slot].load(Ordering::Relaxed);
        let left = present.saturating_sub((most_bytes / page_bytes()) as u32).max(1);
        let (first, bytes) = self.range_of(slot, left, present);
        let flags = FallocateFlags::FALLOC_FL_PUNCH_HOLE | FallocateFlags::FALLOC_FL_KEEP_SIZE;
        // Without the right to punch a hole, the slot keeps its memory.
        if fallocate_all(&self.file, flags, first, bytes).is_err() {
            return 0;
        }
        self.pages[slot].store(left, Ordering::Relaxed);
        // More may be idle.
        self.search_at.store(self.now.load(Ordering::Relaxed), Ordering::Relaxed);
        self.budget.lock().give_back(self.route, bytes);
        bytes
    }

    /// The number of the slot of a payload.
    fn slot_of(&self, payload: usize) -> Option<usize> {
        let from_first = payload.wrapping_sub(SLOT_HEADER_BYTES + self.first_address);
        let stride = self.pool.stride_bytes as usize;
        Some(from_first / stride).filter(|&slot| slot < self.pages.len() && from_first.is_multiple_of(stride))
    }

    /// Where pages of a slot are in the file, and their bytes.
    fn range_of(&self, slot: usize, from_page: u32, to_page: u32) -> (u64, u64) {
        let first = slot as u64 * self.pool.stride_bytes + u64::from(from_page) * page_bytes();
        (first, u64::from(to_page - from_page) * page_bytes())
    }

    fn allocate(&self, slot: usize, from_page: u32, to_page: u32) -> nix::Result<()> {
        let (first, bytes) = self.range_of(slot, from_page, to_page);
        allocate(&self.file, first, bytes)
    }
}

/// Rounds a number of pages up, so that samples whose size varies a little share a class: to at most a
/// quarter more.
fn size_class(pages: u32) -> u32 {
    let step = (pages.next_power_of_two() / 8).max(1);
    pages.next_multiple_of(step)
}

fn allocate(file: &File, offset: u64, bytes: u64) -> nix::Result<()> {
    fallocate_all(file, FallocateFlags::empty(), offset, bytes)
}

fn fallocate_all(file: &File, flags: FallocateFlags, offset: u64, bytes: u64) -> nix::Result<()> {
    loop {
        match fallocate(file, flags, offset.cast_signed(), bytes.cast_signed()) {
            Err(Errno::EINTR) => {}
            result => return result,
        }
    }
}

/// A mapped file of this process.
struct Mapping {
    start: usize,
    /// The place in the file that is mapped at `start`.
    offset: u64,
    path: PathBuf,
}

impl Mapping {
    fn at(address: usize) -> Option<Self> {
        let maps = fs::read_to_string("/proc/self/maps").ok()?;
        maps.lines().find_map(|line| Self::of_line(line, address))
    }

    /// Reads a line such as `7f00-7f10 rw-s 00001000 00:19 42 /dev/shm/name`.
    fn of_line(line: &str, address: usize) -> Option<Self> {
        let (range, rest) = line.split_once(' ')?;
        let (start, end) = range.split_once('-')?;
        let number = |text| usize::from_str_radix(text, 16).ok();
        let (start, end) = (number(start)?, number(end)?);
        if !(start..end).contains(&address) {
            return None;
        }
        let offset = number(rest.split_ascii_whitespace().nth(1)?)? as u64;
        Some(Self { start, offset, path: rest.get(rest.find('/')?..)?.into() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_size_class_is_at_most_a_quarter_larger() {
        for pages in 1..20_000 {
            let class = size_class(pages);
            assert!((pages..=pages + pages / 4).contains(&class), "{pages}: {class}");
        }
        assert_eq!([1, 8, 9, 1_500, 1_537].map(size_class), [1, 8, 10, 1_536, 1_792]);
    }

    #[test]
    fn a_mapping_is_read_from_its_line() {
        let line =
            "7f0000000000-7f0000002000 rw-s 00001000 00:19 42                         /dev/shm/ab1_a b";
        let mapping = Mapping::of_line(line, 0x7f00_0000_1fff).unwrap();
        assert_eq!((mapping.start, mapping.offset), (0x7f00_0000_0000, 0x1000));
        assert_eq!(mapping.path, Path::new("/dev/shm/ab1_a b"));
        assert!(Mapping::of_line(line, 0x7f00_0000_2000).is_none());
        assert!(Mapping::of_line("7f00-7f10 rw-p 00000000 00:00 0", 0x7f01).is_none());
    }
}
