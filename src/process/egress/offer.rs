//! What the DDS writer of an output offers to its readers.

use super::history::History;
use super::late_joiners::LateJoiners;
use crate::config::Lane;
use crate::model::{Durability, QosProfile, Reliability};

/// What the DDS writer of an output offers.
#[derive(Clone, Copy)]
pub(super) struct Offer {
    pub qos: QosProfile,
    pub window_samples: usize,
    /// Whether a reader skips the samples that it lacks when fresher ones have evicted them.
    pub supersedes: bool,
}

impl Offer {
    pub fn of(lane: &Lane, qos: QosProfile) -> Self {
        Self { qos, window_samples: lane.window_samples_of(&qos), supersedes: lane.supersedes(&qos) }
    }

    /// The most samples that the writer has accepted and not sent.
    pub fn most_unsent(&self) -> usize {
        self.window_samples.max(self.qos.depth().unwrap_or(1) as usize)
    }

    /// The history for late joiners, if the output has one.
    pub fn history(&self) -> Option<History> {
        if self.qos.durability != Durability::TransientLocal {
            return None;
        }
        // Late joiners of a BEST_EFFORT writer request nothing.
        let depth = self.qos.depth().unwrap_or(1) as usize;
        let is_best_effort = self.qos.reliability == Reliability::BestEffort;
        Some(History::new(is_best_effort.then(|| LateJoiners::new(depth))))
    }
}

/// The DURABILITY of an output's samples: what the present publishers offer, or what the configuration gives.
/// The writer may offer another one.
pub(super) struct RouteDurability {
    follows_publishers: bool,
    current: Durability,
    changed: bool,
}

impl RouteDurability {
    pub const fn new(configured: &Offer, follows_publishers: bool) -> Self {
        Self { follows_publishers, current: configured.qos.durability, changed: false }
    }

    /// Whether the configuration leaves the DURABILITY to the publishers.
    pub const fn follows_publishers(&self) -> bool {
        self.follows_publishers
    }

    pub const fn get(&self) -> Durability {
        self.current
    }

    /// Follows the publishers unless the configuration gives the DURABILITY.
    pub fn set(&mut self, published: Durability) {
        if self.follows_publishers && published != self.current {
            self.current = published;
            self.changed = true;
        }
    }

    /// Makes [`take_change`](Self::take_change) return true: the topic has got keys, or lost them.
    pub const fn set_changed(&mut self) {
        self.changed = true;
    }

    /// Returns whether it has changed since the last call.
    pub fn take_change(&mut self) -> bool {
        std::mem::take(&mut self.changed)
    }
}
