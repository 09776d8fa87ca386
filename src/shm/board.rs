//! Latest values in shared memory, which readers poll without waiting.

use std::marker::PhantomData;

use super::error::ShmError;
use super::wake::{LaneSleeper, LaneWaker};
use crate::config::Settings;
use crate::model::{
    IngressCounters, LaneCounters, LaneName, LanePolicy, LatencyHistogram, ProcessHealth, RouteId, RouteInfo,
};

/// What the boards must have room for. All processes of an instance must agree on it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BridgeShape {
    /// The lanes; a lane's number is its place here.
    pub lanes: Vec<LaneName>,
    /// The routes; a route's number is its place here.
    pub routes: Vec<RouteId>,
}

impl BridgeShape {
    /// The shape of a configured bridge.
    pub fn of(settings: &Settings) -> Self {
        Self {
            lanes: settings.lanes.iter().map(|lane| lane.name.clone()).collect(),
            routes: settings.routes.iter().map(|route| route.id.clone()).collect(),
        }
    }
}

/// A process that shows its health.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ProcessRole {
    /// Ingress.
    Ingress,
    /// Control.
    Control,
    /// The egress of the lane of that number.
    Egress(usize),
}

/// A stage of a sample's way whose latency is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// From the publisher's source timestamp to ingress; recorded by ingress.
    DdsIn,
    /// From ingress to the lane of that number; recorded by the lane.
    Shm(usize),
    /// Within the lane of that number, up to its DDS writer.
    DdsOut(usize),
    /// From the source timestamp to the DDS writer of the lane of that number.
    Age(usize),
}

/// All boards of an instance.
#[derive(Clone, Debug)]
pub struct Boards {}

impl Boards {
    /// What a process shows of itself; zeroes while it never ran. `None` when the writer changes it faster than
    /// it can be read, which only a runaway writer does; so for all readings.
    pub fn health(&self, role: ProcessRole) -> Option<ProcessHealth> {
        let _ = role;
        todo!()
    }

    /// Writes what a process shows of itself, beginning with what its predecessor wrote. One writer at a time:
    /// the holder of the role's lock.
    pub fn health_writer(&self, role: ProcessRole) -> BoardWriter<ProcessHealth> {
        let _ = role;
        todo!()
    }

    /// What ingress has counted on a route.
    pub fn ingress(&self, route: usize) -> Option<IngressCounters> {
        let _ = route;
        todo!()
    }

    /// Counts for ingress on a route, beginning where its predecessor ended.
    pub fn ingress_writer(&self, route: usize) -> BoardWriter<IngressCounters> {
        let _ = route;
        todo!()
    }

    /// What a lane has counted on a route.
    pub fn lane(&self, lane: usize, route: usize) -> Option<LaneCounters> {
        let _ = (lane, route);
        todo!()
    }

    /// Counts for a lane on a route, beginning where its predecessor ended.
    pub fn lane_writer(&self, lane: usize, route: usize) -> BoardWriter<LaneCounters> {
        let _ = (lane, route);
        todo!()
    }

    /// What ingress found out about a route.
    pub fn route_info(&self, route: usize) -> Option<RouteInfo> {
        let _ = route;
        todo!()
    }

    /// Writes what ingress found out about a route.
    pub fn route_info_writer(&self, route: usize) -> BoardWriter<RouteInfo> {
        let _ = route;
        todo!()
    }

    /// The latencies of a stage on a route. Counts that are being recorded meanwhile may be in or not.
    pub fn histogram(&self, stage: Stage, route: usize) -> LatencyHistogram {
        let _ = (stage, route);
        todo!()
    }

    /// Records latencies of a stage on a route.
    pub fn histogram_writer(&self, stage: Stage, route: usize) -> HistogramWriter {
        let _ = (stage, route);
        todo!()
    }

    /// The policy of a lane.
    pub fn policy(&self, lane: usize) -> Option<LanePolicy> {
        let _ = lane;
        todo!()
    }

    /// Changes the policy of a lane; any process may, one after the other. `change` gets the present policy and
    /// gives the new one; the epoch is counted up here when the two differ in more than time. Returns what was
    /// written.
    pub fn set_policy(
        &self,
        lane: usize,
        change: impl FnOnce(LanePolicy) -> LanePolicy,
    ) -> Result<LanePolicy, ShmError> {
        let _ = (lane, change);
        todo!()
    }

    /// Wakes a lane.
    pub fn waker(&self, lane: usize) -> LaneWaker {
        let _ = lane;
        todo!()
    }

    /// Sleeps for a lane.
    pub fn sleeper(&self, lane: usize) -> LaneSleeper {
        let _ = lane;
        todo!()
    }
}

/// The one writer of one value on a board. Dropping it leaves the value where it is.
#[derive(Debug)]
pub struct BoardWriter<T> {
    value: T,
    _type: PhantomData<T>,
}

impl<T> BoardWriter<T> {
    /// The value as last written.
    pub fn get(&self) -> &T {
        &self.value
    }

    /// Changes the value and shows it. A process that dies within leaves the value as it was before.
    pub fn update<R>(&mut self, change: impl FnOnce(&mut T) -> R) -> R {
        let _ = change;
        todo!()
    }
}

/// The one writer of one histogram.
#[derive(Debug)]
pub struct HistogramWriter {}

impl HistogramWriter {
    /// Counts one latency.
    pub fn record(&mut self, latency_ns: u64) {
        let _ = latency_ns;
        todo!()
    }
}
