//! The most memory that each process may need with a configuration, from the limits that bound its parts.
//! Pure: `check` shows it, and `units` makes it the limit of each service.
//!
//! `docs/decisions/0020-memory-limits.md` has the measurements.

use serde::Serialize;

use super::control::memory::{REQUESTS_BYTES, networks, node_bytes};
use super::egress::memory::{COPIES_BYTES, output_bytes};
use super::ingress::memory::{PATTERN_BYTES, fragment_bytes, waiting_bytes};
use crate::config::{Lane, Settings};
use crate::dds::{DISCOVERY_BYTES, SOCKETS_BYTES};
use crate::model::TrafficClass;
use crate::shm::{DEFAULT_BUDGET_BYTES, OTHER_SHARED_BYTES, RouteChannel, most_backlog_bytes};

const MIB: u64 = 1 << 20;

/// The program itself, its libraries, stacks and page tables, and the state of an idle process.
const PROGRAM_BYTES: u64 = 32 * MIB;

/// Beside the parts, a fixed part of the margin: receive buffers of 256 KiB, which a small sample keeps for
/// up to 5 s although fragments share them, and freed memory that the allocator keeps.
const MARGIN_BYTES: u64 = 32 * MIB;

/// The other part of the margin is the need of the process divided by this: a quarter. Shared memory needs no
/// margin, because its size is exact.
const MARGIN_DIVISOR: u64 = 4;

/// Limits are multiples of this, so that a small change of the configuration changes none.
const STEP_BYTES: u64 = 16 * MIB;

/// The most memory that a process may need, in bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct MemoryNeed {
    /// The program, its libraries and its threads.
    pub program_bytes: u64,
    /// Participants and endpoints at the limits of discovery.
    pub discovery_bytes: u64,
    /// Datagrams in the buffers of the sockets.
    pub sockets_bytes: u64,
    /// Samples of which fragments are missing.
    pub fragments_bytes: u64,
    /// Received samples that the DDS library keeps.
    pub waiting_bytes: u64,
    /// Samples that writers retain, and copies for them.
    pub history_bytes: u64,
    /// Requests, replies and probes of control and the responder.
    pub requests_bytes: u64,
    /// Shared memory that the kernel counts for the process, because it touches it first.
    pub shared_memory_bytes: u64,
}

impl MemoryNeed {
    /// The need of a process with so many participants, without its samples.
    fn of_participants(participants: u64) -> Self {
        Self {
            program_bytes: PROGRAM_BYTES,
            discovery_bytes: participants * DISCOVERY_BYTES,
            sockets_bytes: participants * SOCKETS_BYTES,
            shared_memory_bytes: OTHER_SHARED_BYTES,
            ..Self::default()
        }
    }

    /// The parts with their names, in the order of the fields.
    pub const fn parts(&self) -> [(&'static str, u64); 8] {
        [
            ("program", self.program_bytes),
            ("discovery", self.discovery_bytes),
            ("sockets", self.sockets_bytes),
            ("fragments", self.fragments_bytes),
            ("waiting samples", self.waiting_bytes),
            ("histories", self.history_bytes),
            ("requests", self.requests_bytes),
            ("shared memory", self.shared_memory_bytes),
        ]
    }

    /// The limit for the process: all parts and the margin.
    pub fn limit_bytes(&self) -> u64 {
        let add = |sum: u64, (_, bytes): (_, u64)| sum.saturating_add(bytes);
        let sum = self.parts().into_iter().fold(0, add);
        let own = sum - self.shared_memory_bytes;
        let limit = sum.saturating_add(own / MARGIN_DIVISOR).saturating_add(MARGIN_BYTES);
        limit.div_ceil(STEP_BYTES).saturating_mul(STEP_BYTES)
    }
}

/// The memory that each process of a bridge may need.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MemoryNeeds {
    /// Ingress.
    pub ingress: MemoryNeed,
    /// Each lane, in the order of the settings.
    pub lanes: Vec<MemoryNeed>,
    /// Control.
    pub control: MemoryNeed,
}

impl MemoryNeeds {
    /// The needs of the processes with these settings.
    pub fn of(settings: &Settings) -> Self {
        Self {
            ingress: of_ingress(settings),
            lanes: settings.lanes.iter().map(|lane| of_lane(settings, lane)).collect(),
            control: of_control(settings),
        }
    }

    /// The need of a responder, which has no settings.
    pub fn of_responder() -> MemoryNeed {
        MemoryNeed { requests_bytes: REQUESTS_BYTES, ..MemoryNeed::of_participants(1) }
    }
}

fn of_ingress(settings: &Settings) -> MemoryNeed {
    let mut need = MemoryNeed::of_participants(1);
    need.discovery_bytes += settings.patterns.len() as u64 * PATTERN_BYTES;
    need.fragments_bytes = fragment_bytes(&settings.routes);
    let (mut first_bytes, mut most_bytes) = (0, 0);
    for (index, route) in settings.routes.iter().enumerate() {
        add(&mut need.waiting_bytes, waiting_bytes(route));
        let pool = RouteChannel::of(settings, index).pool_size();
        add(&mut first_bytes, pool.first_bytes);
        add(&mut most_bytes, pool.bytes);
    }
    // Without a budget in the file, the largest that the default may be on any machine.
    let budget_bytes = settings.shared_memory.budget_bytes.unwrap_or(DEFAULT_BUDGET_BYTES);
    // Twice: the pool of a killed ingress remains until the lanes have taken what is in it.
    add(&mut need.shared_memory_bytes, 2 * most_bytes.min(budget_bytes.max(first_bytes)));
    need
}

fn of_lane(settings: &Settings, lane: &Lane) -> MemoryNeed {
    let mut need = MemoryNeed { history_bytes: COPIES_BYTES, ..MemoryNeed::of_participants(1) };
    for output in &lane.outputs {
        let route = &settings.routes[output.route];
        add(&mut need.history_bytes, output_bytes(lane, output, route.max_sample_bytes));
    }
    if lane.class() == TrafficClass::Critical {
        // Copies of what it lacks when it restarts.
        let routes = lane.outputs.iter().map(|output| &settings.routes[output.route]);
        add(&mut need.history_bytes, most_backlog_bytes(routes));
    }
    need
}

fn of_control(settings: &Settings) -> MemoryNeed {
    let networks = networks(settings).0.len() as u64;
    let mut need = MemoryNeed::of_participants(networks);
    let nodes = networks + 1 + settings.lanes.iter().filter(|lane| lane.is_used()).count() as u64;
    need.requests_bytes = networks * REQUESTS_BYTES + nodes * node_bytes();
    need
}

fn add(sum: &mut u64, bytes: u64) {
    *sum = sum.saturating_add(bytes);
}
