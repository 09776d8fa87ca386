//! Boards: latest values in shared memory, which readers poll without waiting.
//!
//! All boards of an instance are in one segment. The first process creates it and the last process that
//! leaves the instance removes it, so a process that is restarted continues with the counters of the former
//! process.
//!
//! Each value is a [`Cell`]. A histogram is not: its counts are single words, which are incremented in place.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;

use nix::fcntl::FlockArg;

use super::cell::{Cell, LINE, Plain, load};
use super::error::ShmError;
use super::lock::FileLock;
use super::root::{InstanceDir, SHM_DIR};
use super::segment::Segment;
use super::send_log::SendLog;
use super::wake::{LaneObserver, LaneSleeper, LaneWaker};
use crate::config::Settings;
use crate::model::{
    AbsenceRecord, Backlog, ControlRecord, EndpointIdentity, IngressCounters, InstanceName, IntruderRecord,
    LaneCounters, LaneName, LanePolicy, LatencyHistogram, MAX_ABSENCES, MAX_INTRUDERS, MAX_NAMED_ENDPOINTS,
    MAX_PUBLISHERS, MAX_SUBSCRIBERS, MonotonicNs, NamedEndpoint, OutputReaders, PartialSample, PatternRecord,
    ProcessHealth, ProcessIdentity, PublisherAccount, Reliability, RouteId, RouteInfo, StandbyRecord,
    SubscriberRecord, fnv1a,
};

/// The lanes and routes for which the boards have room. It must be the same in all processes of an instance.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct BridgeShape {
    /// The lanes; the number of a lane is its index.
    pub lanes: Vec<LaneName>,
    /// The routes; the number of a route is its index.
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

    /// A hash of the lanes, the routes and the layout, by which processes detect that theirs differ.
    fn fingerprint(&self) -> u64 {
        let lanes: String = self.lanes.iter().map(|lane| format!(" lane {lane}")).collect();
        let routes: String = self.routes.iter().map(|route| format!(" route {route}")).collect();
        fnv1a(format!("{LAYOUT_VERSION} {}{lanes}{routes}", Layout::of(self).words).as_bytes())
    }
}

/// A process that publishes its health on a board.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ProcessRole {
    /// Ingress.
    Ingress,
    /// Control.
    Control,
    /// Egress of the lane with that number.
    Egress(usize),
}

/// A stage of a sample's path through the bridge whose latency is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// From the publisher's source timestamp to ingress; recorded by ingress.
    DdsIn,
    /// From ingress to the lane with that number; recorded by the lane.
    Shm(usize),
    /// Within the lane with that number, up to its DDS writer.
    DdsOut(usize),
    /// From the source timestamp to the DDS writer of the lane with that number.
    Age(usize),
}

/// Incremented whenever the meaning of a word in the segment changes.
const LAYOUT_VERSION: u32 = 16;
/// The readers of a route: one for the publishers of each reliability.
const READERS: usize = 2;
/// "ABboards": the first word, by which a file of another program is rejected.
const MAGIC: u64 = 0x4142_626f_6172_6473;
const HISTOGRAM_WORDS: usize = size_of::<LatencyHistogram>() / 8;

/// The offset of each board in the segment, in words.
#[derive(Clone, Copy, Debug)]
struct Layout {
    lanes: usize,
    routes: usize,
    wake: usize,
    health: usize,
    standby: usize,
    policy: usize,
    control: usize,
    subscriber: usize,
    intruder: usize,
    named_endpoint: usize,
    absence: usize,
    route_info: usize,
    pattern: usize,
    partial: usize,
    backlog: usize,
    ingress: usize,
    publisher: usize,
    lane: usize,
    output_readers: usize,
    identity: usize,
    reader_identity: usize,
    writer_identity: usize,
    send_log: usize,
    histograms: usize,
    words: usize,
}

impl Layout {
    fn of(shape: &BridgeShape) -> Self {
        let (lanes, routes) = (shape.lanes.len(), shape.routes.len());
        let mut end = LINE;
        let mut next = |words: usize| {
            end += words;
            end - words
        };
        // In the order of their places.
        Self {
            lanes,
            routes,
            wake: next(lanes * LINE),
            health: next((2 + lanes) * Cell::<ProcessHealth>::WORDS),
            standby: next((2 + lanes) * Cell::<StandbyRecord>::WORDS),
            policy: next(lanes * Cell::<LanePolicy>::WORDS),
            control: next(Cell::<ControlRecord>::WORDS),
            subscriber: next(MAX_SUBSCRIBERS * Cell::<SubscriberRecord>::WORDS),
            intruder: next(MAX_INTRUDERS * Cell::<IntruderRecord>::WORDS),
            named_endpoint: next(MAX_NAMED_ENDPOINTS * Cell::<NamedEndpoint>::WORDS),
            absence: next(MAX_ABSENCES * Cell::<AbsenceRecord>::WORDS),
            route_info: next(routes * Cell::<RouteInfo>::WORDS),
            pattern: next(routes * Cell::<PatternRecord>::WORDS),
            partial: next(routes * Cell::<PartialSample>::WORDS),
            backlog: next(routes * Cell::<Backlog>::WORDS),
            ingress: next(routes * Cell::<IngressCounters>::WORDS),
            publisher: next(routes * MAX_PUBLISHERS * Cell::<PublisherAccount>::WORDS),
            lane: next(lanes * routes * Cell::<LaneCounters>::WORDS),
            output_readers: next(lanes * routes * Cell::<OutputReaders>::WORDS),
            identity: next((2 + lanes) * Cell::<ProcessIdentity>::WORDS),
            reader_identity: next(routes * READERS * Cell::<EndpointIdentity>::WORDS),
            writer_identity: next(lanes * routes * Cell::<EndpointIdentity>::WORDS),
            send_log: next(lanes * routes * SendLog::WORDS),
            histograms: next(routes * (1 + 3 * lanes) * HISTOGRAM_WORDS.next_multiple_of(LINE)),
            words: end,
        }
    }

    fn policy(&self, lane: usize) -> Cell<LanePolicy> {
        Cell::at(self.policy + self.check_lane(lane) * Cell::<LanePolicy>::WORDS)
    }

    fn histogram(&self, stage: Stage, route: usize) -> usize {
        let of_lane = |lane: usize, stage: usize| 1 + 3 * self.check_lane(lane) + stage;
        let stage_index = match stage {
            Stage::DdsIn => 0,
            Stage::Shm(lane) => of_lane(lane, 0),
            Stage::DdsOut(lane) => of_lane(lane, 1),
            Stage::Age(lane) => of_lane(lane, 2),
        };
        let index = stage_index * self.routes + self.check_route(route);
        self.histograms + index * HISTOGRAM_WORDS.next_multiple_of(LINE)
    }

    fn wake(&self, lane: usize) -> usize {
        self.wake + self.check_lane(lane) * LINE
    }

    fn process(&self, role: ProcessRole) -> usize {
        match role {
            ProcessRole::Ingress => 0,
            ProcessRole::Control => 1,
            ProcessRole::Egress(lane) => 2 + self.check_lane(lane),
        }
    }

    fn output(&self, lane: usize, route: usize) -> usize {
        self.check_lane(lane) * self.routes + self.check_route(route)
    }

    /// Panics for a number that the shape does not have: a defect of the caller, because numbers come from
    /// the configuration that the shape was made from.
    fn check_lane(&self, lane: usize) -> usize {
        assert!(lane < self.lanes, "lane {lane} of {}", self.lanes);
        lane
    }

    fn check_route(&self, route: usize) -> usize {
        assert!(route < self.routes, "route {route} of {}", self.routes);
        route
    }
}

/// The index in a table of this size, which contains it.
fn within(index: usize, size: usize) -> usize {
    assert!(index < size, "record {index} of {size}");
    index
}

/// Declares the boards: how each is read, how its only writer gets it, the type of its value, and which of
/// the cells of the layout it is.
macro_rules! boards {
    ($($(#[doc = $doc:literal])+
       $name:ident, $writer:ident($($arg:ident: $of:ty),*): $value:ty = |$layout:ident| $index:expr;)+) => {
        impl Layout {
            $(fn $name(&self, $($arg: $of),*) -> Cell<$value> {
                let $layout = self;
                Cell::at($layout.$name + ($index) * Cell::<$value>::WORDS)
            })+
        }

        impl Boards {
            $($(#[doc = $doc])+
            ///
            /// `None` when the writer changes the value faster than it can be read, which only a runaway
            /// writer does; zeroes when it has never been written.
            pub fn $name(&self, $($arg: $of),*) -> Option<$value> {
                self.layout.$name($($arg),*).read(&self.segment)
            }

            #[doc = concat!("The writer of [`Self::", stringify!($name), "`]. It begins")]
            /// with what the former process wrote. One writer at a time: the holder of the role's lock.
            pub fn $writer(&self, $($arg: $of),*) -> BoardWriter<$value> {
                self.writer(self.layout.$name($($arg),*))
            })+
        }
    };
}

boards! {
    /// The health of a process.
    health, health_writer(role: ProcessRole): ProcessHealth = |layout| layout.process(role);
    /// The standby of a process. Its writer is the holder of the standby's lock.
    standby, standby_writer(role: ProcessRole): StandbyRecord = |layout| layout.process(role);
    /// The state and decisions of control that concern the whole bridge.
    control, control_writer(): ControlRecord = |layout| 0;
    /// The record of the subscriber at an index below [`MAX_SUBSCRIBERS`].
    subscriber, subscriber_writer(index: usize): SubscriberRecord = |layout| within(index, MAX_SUBSCRIBERS);
    /// The intruder at an index below [`MAX_INTRUDERS`].
    intruder, intruder_writer(index: usize): IntruderRecord = |layout| within(index, MAX_INTRUDERS);
    /// The named endpoint at an index below [`MAX_NAMED_ENDPOINTS`]: a GUID and its ROS 2 node.
    named_endpoint, named_endpoint_writer(index: usize): NamedEndpoint =
        |layout| within(index, MAX_NAMED_ENDPOINTS);
    /// The absence (of an interface or peer) at an index below [`MAX_ABSENCES`].
    absence, absence_writer(index: usize): AbsenceRecord = |layout| within(index, MAX_ABSENCES);
    /// What ingress has discovered about a route.
    route_info, route_info_writer(route: usize): RouteInfo = |layout| layout.check_route(route);
    /// The state of the pattern whose first place is this route, from ingress.
    pattern, pattern_writer(route: usize): PatternRecord = |layout| layout.check_route(route);
    /// The large sample of a route of which ingress has received a part.
    partial, partial_writer(route: usize): PartialSample = |layout| layout.check_route(route);
    /// The samples of a route that ingress keeps for a lane that restarts.
    backlog, backlog_writer(route: usize): Backlog = |layout| layout.check_route(route);
    /// The counters of ingress for a route.
    ingress, ingress_writer(route: usize): IngressCounters = |layout| layout.check_route(route);
    /// The account of the publisher of a route at an index below [`MAX_PUBLISHERS`].
    publisher, publisher_writer(route: usize, index: usize): PublisherAccount =
        |layout| layout.check_route(route) * MAX_PUBLISHERS + within(index, MAX_PUBLISHERS);
    /// The counters of a lane for a route.
    lane, lane_writer(lane: usize, route: usize): LaneCounters = |layout| layout.output(lane, route);
    /// The readers that are matched with a lane's output of a route.
    output_readers, output_readers_writer(lane: usize, route: usize): OutputReaders =
        |layout| layout.output(lane, route);
    /// The identity of the participant of a process.
    identity, identity_writer(role: ProcessRole): ProcessIdentity = |layout| layout.process(role);
    /// The identity of the DDS reader of a route for the publishers of a reliability.
    reader_identity, reader_identity_writer(route: usize, reliability: Reliability): EndpointIdentity =
        |layout| layout.check_route(route) * READERS + reliability as usize;
    /// The identity of the DDS writer of a lane's output of a route.
    writer_identity, writer_identity_writer(lane: usize, route: usize): EndpointIdentity =
        |layout| layout.output(lane, route);
}

/// All boards of an instance.
///
/// # Panics
/// All methods panic if the [`BridgeShape`] has no lane or route with the given number, or if the index in a
/// table is not below its size.
#[derive(Clone, Debug)]
pub struct Boards {
    segment: Arc<Segment>,
    layout: Layout,
    policy_lock: PathBuf,
}

impl Boards {
    /// Opens the boards of an instance, for commands that only read them, such as `status`; `None` when there
    /// are none. Boards also exist after the last process of the instance was killed.
    pub fn find(root: &Path, instance: &InstanceName, shape: &BridgeShape) -> Result<Option<Self>, ShmError> {
        let Some(dir) = InstanceDir::find(root, instance)? else { return Ok(None) };
        let layout = Layout::of(shape);
        let Some(segment) = Segment::open(&Self::path(&dir), layout.words)? else { return Ok(None) };
        Self::new(&dir, segment, layout, shape).map(Some)
    }

    pub(super) fn open_or_create(dir: &InstanceDir, shape: &BridgeShape) -> Result<Self, ShmError> {
        let layout = Layout::of(shape);
        let path = Self::path(dir);
        let segment = match Segment::open(&path, layout.words)? {
            Some(segment) => segment,
            None => Segment::create(&path, layout.words, &[MAGIC, shape.fingerprint()])?,
        };
        Self::new(dir, segment, layout, shape)
    }

    fn path(dir: &InstanceDir) -> PathBuf {
        Path::new(SHM_DIR).join(format!("{}boards", dir.prefix))
    }

    fn new(
        dir: &InstanceDir,
        segment: Segment,
        layout: Layout,
        shape: &BridgeShape,
    ) -> Result<Self, ShmError> {
        let first = [0, 1].map(|at| segment.word(at).load(Ordering::Relaxed));
        if first != [MAGIC, shape.fingerprint()] {
            return Err(ShmError::Incompatible {
                what: "the boards were created with other lanes or routes, or by another version".to_owned(),
                path: dir.path.clone(),
            });
        }
        Ok(Self { segment: Arc::new(segment), layout, policy_lock: dir.path.join("policy.lock") })
    }

    /// The latencies of a stage on a route. Latencies that are recorded during the call may be missing.
    pub fn histogram(&self, stage: Stage, route: usize) -> LatencyHistogram {
        load(&self.segment, self.layout.histogram(stage, route))
    }

    /// Records latencies of a stage on a route. One writer at a time, as for the counters.
    pub fn histogram_writer(&self, stage: Stage, route: usize) -> HistogramWriter {
        HistogramWriter { segment: self.segment.clone(), at: self.layout.histogram(stage, route) }
    }

    /// The policy of a lane; epoch 0 if none has been set.
    pub fn policy(&self, lane: usize) -> Option<LanePolicy> {
        self.layout.policy(lane).read(&self.segment)
    }

    /// Locks the policies of all lanes for changes. Any process may change them, one at a time: another
    /// caller waits until this is dropped.
    pub fn policies(&self) -> Result<Policies<'_>, ShmError> {
        let lock = FileLock::take_soon(&self.policy_lock, FlockArg::LockExclusiveNonblock)?;
        Ok(Policies { boards: self, _lock: lock })
    }

    /// The send log of a lane's output of a route. One process at a time.
    pub fn send_log(&self, lane: usize, route: usize) -> SendLog {
        SendLog::at(
            self.segment.clone(),
            self.layout.send_log + self.layout.output(lane, route) * SendLog::WORDS,
        )
    }

    /// The waker of a lane, for ingress.
    pub fn waker(&self, lane: usize) -> LaneWaker {
        LaneWaker::new(self.segment.clone(), self.layout.wake(lane))
    }

    /// The sleeper of a lane, for its egress process. One at a time.
    pub fn sleeper(&self, lane: usize) -> LaneSleeper {
        LaneSleeper::new(self.segment.clone(), self.layout.wake(lane))
    }

    /// The observer of a lane, for its standby.
    pub fn observer(&self, lane: usize) -> LaneObserver {
        LaneObserver::new(self.segment.clone(), self.layout.wake(lane))
    }

    fn writer<T: Plain>(&self, cell: Cell<T>) -> BoardWriter<T> {
        let value = cell.read(&self.segment).unwrap_or_default();
        BoardWriter { segment: self.segment.clone(), cell, value }
    }
}

/// The exclusive right to change the policies of the lanes.
#[derive(Debug)]
pub struct Policies<'a> {
    boards: &'a Boards,
    _lock: FileLock,
}

impl Policies<'_> {
    /// Changes the policy of a lane. `change` gets the present policy and returns the new one. This method
    /// sets the epoch: it increments it unless only `written_at` differs. Returns the policy that was
    /// written.
    pub fn set(
        &self,
        lane: usize,
        now: MonotonicNs,
        change: impl FnOnce(LanePolicy) -> LanePolicy,
    ) -> LanePolicy {
        let cell = self.boards.layout.policy(lane);
        let before = cell.read(&self.boards.segment).unwrap_or_default();
        let mut after = change(before);
        (after.epoch, after.changed_at) = (before.epoch, before.changed_at);
        let only_time_differs = LanePolicy { written_at: before.written_at, ..after } == before;
        if before.epoch == 0 || !only_time_differs {
            // Only a foreign process can have written the largest number. 0 means that no policy has been
            // set.
            after.epoch = after.epoch.checked_add(1).unwrap_or(1);
            after.changed_at = now;
        }
        cell.write(&self.boards.segment, &after);
        after
    }
}

/// The only writer of a value on a board. The value stays on the board after the writer is dropped.
#[derive(Debug)]
pub struct BoardWriter<T> {
    segment: Arc<Segment>,
    cell: Cell<T>,
    value: T,
}

#[expect(private_bounds, reason = "only the types of the boards are written")]
impl<T: Plain> BoardWriter<T> {
    /// The value that was last written.
    pub fn get(&self) -> &T {
        &self.value
    }

    /// Publishes the value, unless it is the one that was last written.
    pub fn set(&mut self, value: T)
    where
        T: PartialEq,
    {
        if value != self.value {
            self.update(|written| *written = value);
        }
    }

    /// Changes the value and publishes it. If the process dies during the call, the previous value stays.
    pub fn update<R>(&mut self, change: impl FnOnce(&mut T) -> R) -> R {
        let result = change(&mut self.value);
        self.cell.write(&self.segment, &self.value);
        result
    }
}

/// Writes the rows of a table, and zeroes to the writers that are left.
#[expect(private_bounds, reason = "only the types of the boards are written")]
pub fn write_rows<T: Plain + PartialEq>(writers: &mut [BoardWriter<T>], rows: impl Iterator<Item = T>) {
    let rows = rows.chain(std::iter::repeat_with(T::default));
    writers.iter_mut().zip(rows).for_each(|(writer, row)| writer.set(row));
}

/// The only writer of a histogram.
#[derive(Debug)]
pub struct HistogramWriter {
    segment: Arc<Segment>,
    at: usize,
}

impl HistogramWriter {
    /// Counts one latency, as [`LatencyHistogram::record`] does.
    pub fn record(&mut self, latency_ns: u64) {
        let count = self.segment.word(self.at + LatencyHistogram::bucket(latency_ns));
        count.store(count.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
        // The maximum is the word after the counts.
        let max_ns = self.segment.word(self.at + HISTOGRAM_WORDS - 1);
        if latency_ns > max_ns.load(Ordering::Relaxed) {
            max_ns.store(latency_ns, Ordering::Relaxed);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Where each record of each board is: its first word and its words.
    fn records(layout: &Layout) -> Vec<(usize, usize)> {
        fn place<T: Plain>(cell: Cell<T>) -> (usize, usize) {
            (cell.at, Cell::<T>::WORDS)
        }
        let (lanes, routes) = (layout.lanes, layout.routes);
        let mut found = vec![
            place(layout.health(ProcessRole::Ingress)),
            place(layout.health(ProcessRole::Control)),
            place(layout.standby(ProcessRole::Ingress)),
            place(layout.standby(ProcessRole::Control)),
            place(layout.identity(ProcessRole::Ingress)),
            place(layout.identity(ProcessRole::Control)),
            place(layout.control()),
        ];
        for lane in 0..lanes {
            found.push((layout.wake(lane), LINE));
            found.push(place(layout.health(ProcessRole::Egress(lane))));
            found.push(place(layout.standby(ProcessRole::Egress(lane))));
            found.push(place(layout.policy(lane)));
            found.push(place(layout.identity(ProcessRole::Egress(lane))));
        }
        found.extend((0..MAX_SUBSCRIBERS).map(|index| place(layout.subscriber(index))));
        found.extend((0..MAX_INTRUDERS).map(|index| place(layout.intruder(index))));
        found.extend((0..MAX_NAMED_ENDPOINTS).map(|index| place(layout.named_endpoint(index))));
        found.extend((0..MAX_ABSENCES).map(|index| place(layout.absence(index))));
        for route in 0..routes {
            found.push(place(layout.route_info(route)));
            found.push(place(layout.pattern(route)));
            found.push(place(layout.partial(route)));
            found.push(place(layout.backlog(route)));
            found.push(place(layout.ingress(route)));
            for reliability in [Reliability::BestEffort, Reliability::Reliable] {
                found.push(place(layout.reader_identity(route, reliability)));
            }
            found.extend((0..MAX_PUBLISHERS).map(|index| place(layout.publisher(route, index))));
            let mut stages = vec![Stage::DdsIn];
            for lane in 0..lanes {
                found.push(place(layout.lane(lane, route)));
                found.push(place(layout.output_readers(lane, route)));
                found.push(place(layout.writer_identity(lane, route)));
                found.push((layout.send_log + layout.output(lane, route) * SendLog::WORDS, SendLog::WORDS));
                stages.extend([Stage::Shm(lane), Stage::DdsOut(lane), Stage::Age(lane)]);
            }
            let words = size_of::<LatencyHistogram>().div_ceil(8).next_multiple_of(LINE);
            found.extend(stages.into_iter().map(|stage| (layout.histogram(stage, route), words)));
        }
        found.sort_unstable();
        found
    }

    #[test]
    fn the_boards_fill_the_segment_without_gap_or_overlap() {
        for (lanes, routes) in [(2, 1), (2, 3), (5, 4)] {
            let shape = BridgeShape {
                lanes: (0..lanes).map(|n| LaneName::try_from(&*format!("l{n}")).unwrap()).collect(),
                routes: (0..routes).map(|n| RouteId::try_from(&*format!("r{n}")).unwrap()).collect(),
            };
            let layout = Layout::of(&shape);
            // The first line has the magic number and the fingerprint.
            let mut next = LINE;
            for (first, words) in records(&layout) {
                assert_eq!(first, next, "{lanes} lanes, {routes} routes");
                next = first + words;
            }
            assert_eq!(next, layout.words);
        }
    }
}
