//! How ingress wakes a lane.

use std::time::Duration;

/// Why a [`LaneSleeper`] returned.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Woken {
    /// There was a wake since the last return, or a signal came.
    Woken,
    /// The time is over and nobody woke the lane.
    TimedOut,
}

/// Wakes one lane; any process or thread may hold any number of them.
#[derive(Clone, Debug)]
pub struct LaneWaker {}

impl LaneWaker {
    /// Wakes the lane. Never blocks, also while the lane is stopped; several wakes before the lane looks are one.
    pub fn wake(&self) {
        todo!()
    }
}

/// Sleeps until its lane is woken; one for each lane.
#[derive(Debug)]
pub struct LaneSleeper {}

impl LaneSleeper {
    /// Sleeps until a wake, or for `timeout` at most. A wake that came since the last return ends it at once.
    pub fn sleep(&mut self, timeout: Duration) -> Woken {
        let _ = timeout;
        todo!()
    }
}
