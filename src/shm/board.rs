//! Latest values in shared memory, which readers poll without waiting.
//!
//! All boards of an instance are one segment, which the first process creates and which belongs to none: it
//! stays until the last process of the instance has left, so a process that died finds its counters again.
//!
//! Each value is a [`Cell`]; the counts of a histogram are single words, and are counted in place.

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;

use nix::fcntl::FlockArg;

use super::cell::{Cell, LINE, Plain, load};
use super::error::ShmError;
use super::root::{FileLock, InstanceDir, SHM_DIR};
use super::segment::Segment;
use super::wake::{LaneSleeper, LaneWaker};
use crate::config::Settings;
use crate::model::{
    AbsenceRecord, ControlRecord, IngressCounters, InstanceName, IntruderRecord, LaneCounters, LaneName,
    LanePolicy, LatencyHistogram, MAX_ABSENCES, MAX_INTRUDERS, MAX_NAMED_ENDPOINTS, MAX_PUBLISHERS,
    MAX_SUBSCRIBERS, MonotonicNs, NamedEndpoint, OutputReaders, ProcessHealth, PublisherAccount, RouteId,
    RouteInfo, SubscriberRecord, fnv1a,
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

    /// A number that differs when lanes, routes or the layout of a value differ.
    fn fingerprint(&self) -> u64 {
        let mut text = format!("{LAYOUT_VERSION} {}", Layout::of(self).words);
        for lane in &self.lanes {
            text.push_str(&format!(" lane {lane}"));
        }
        for route in &self.routes {
            text.push_str(&format!(" route {route}"));
        }
        fnv1a(text.as_bytes())
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

/// Counts up when the meaning of a word changes.
const LAYOUT_VERSION: u32 = 5;
/// "ABboards", so that a foreign file is not taken for boards.
const MAGIC: u64 = 0x4142_626f_6172_6473;
const HISTOGRAM_WORDS: usize = size_of::<LatencyHistogram>() / 8;

/// Where everything is, in words.
#[derive(Clone, Copy, Debug)]
struct Layout {
    lanes: usize,
    routes: usize,
    wake: usize,
    health: usize,
    policy: usize,
    control: usize,
    subscribers: usize,
    intruders: usize,
    named_endpoints: usize,
    absences: usize,
    route_info: usize,
    ingress: usize,
    publishers: usize,
    lane: usize,
    output_readers: usize,
    histograms: usize,
    words: usize,
}

impl Layout {
    fn of(shape: &BridgeShape) -> Self {
        let (lanes, routes) = (shape.lanes.len(), shape.routes.len());
        let wake = LINE;
        let health = wake + lanes * LINE;
        let policy = health + (2 + lanes) * Cell::<ProcessHealth>::WORDS;
        let control = policy + lanes * Cell::<LanePolicy>::WORDS;
        let subscribers = control + Cell::<ControlRecord>::WORDS;
        let intruders = subscribers + MAX_SUBSCRIBERS * Cell::<SubscriberRecord>::WORDS;
        let named_endpoints = intruders + MAX_INTRUDERS * Cell::<IntruderRecord>::WORDS;
        let absences = named_endpoints + MAX_NAMED_ENDPOINTS * Cell::<NamedEndpoint>::WORDS;
        let route_info = absences + MAX_ABSENCES * Cell::<AbsenceRecord>::WORDS;
        let ingress = route_info + routes * Cell::<RouteInfo>::WORDS;
        let publishers = ingress + routes * Cell::<IngressCounters>::WORDS;
        let lane = publishers + routes * MAX_PUBLISHERS * Cell::<PublisherAccount>::WORDS;
        let output_readers = lane + lanes * routes * Cell::<LaneCounters>::WORDS;
        let histograms = output_readers + lanes * routes * Cell::<OutputReaders>::WORDS;
        let words = histograms + routes * (1 + 3 * lanes) * HISTOGRAM_WORDS.next_multiple_of(LINE);
        Self {
            lanes,
            routes,
            wake,
            health,
            policy,
            control,
            subscribers,
            intruders,
            named_endpoints,
            absences,
            route_info,
            ingress,
            publishers,
            lane,
            output_readers,
            histograms,
            words,
        }
    }

    fn health(&self, role: ProcessRole) -> Cell<ProcessHealth> {
        let place = match role {
            ProcessRole::Ingress => 0,
            ProcessRole::Control => 1,
            ProcessRole::Egress(lane) => 2 + self.check_lane(lane),
        };
        Cell::at(self.health + place * Cell::<ProcessHealth>::WORDS)
    }

    fn policy(&self, lane: usize) -> Cell<LanePolicy> {
        Cell::at(self.policy + self.check_lane(lane) * Cell::<LanePolicy>::WORDS)
    }

    fn control(&self) -> Cell<ControlRecord> {
        Cell::at(self.control)
    }

    fn subscriber(&self, place: usize) -> Cell<SubscriberRecord> {
        assert!(place < MAX_SUBSCRIBERS, "subscriber {place} of {MAX_SUBSCRIBERS}");
        Cell::at(self.subscribers + place * Cell::<SubscriberRecord>::WORDS)
    }

    fn intruder(&self, place: usize) -> Cell<IntruderRecord> {
        assert!(place < MAX_INTRUDERS, "intruder {place} of {MAX_INTRUDERS}");
        Cell::at(self.intruders + place * Cell::<IntruderRecord>::WORDS)
    }

    fn named_endpoint(&self, place: usize) -> Cell<NamedEndpoint> {
        assert!(place < MAX_NAMED_ENDPOINTS, "named endpoint {place} of {MAX_NAMED_ENDPOINTS}");
        Cell::at(self.named_endpoints + place * Cell::<NamedEndpoint>::WORDS)
    }

    fn absence(&self, place: usize) -> Cell<AbsenceRecord> {
        assert!(place < MAX_ABSENCES, "absence {place} of {MAX_ABSENCES}");
        Cell::at(self.absences + place * Cell::<AbsenceRecord>::WORDS)
    }

    fn output_readers(&self, lane: usize, route: usize) -> Cell<OutputReaders> {
        let place = self.check_lane(lane) * self.routes + self.check_route(route);
        Cell::at(self.output_readers + place * Cell::<OutputReaders>::WORDS)
    }

    fn route_info(&self, route: usize) -> Cell<RouteInfo> {
        Cell::at(self.route_info + self.check_route(route) * Cell::<RouteInfo>::WORDS)
    }

    fn ingress(&self, route: usize) -> Cell<IngressCounters> {
        Cell::at(self.ingress + self.check_route(route) * Cell::<IngressCounters>::WORDS)
    }

    fn publisher(&self, route: usize, place: usize) -> Cell<PublisherAccount> {
        assert!(place < MAX_PUBLISHERS, "publisher {place} of {MAX_PUBLISHERS}");
        let index = self.check_route(route) * MAX_PUBLISHERS + place;
        Cell::at(self.publishers + index * Cell::<PublisherAccount>::WORDS)
    }

    fn lane(&self, lane: usize, route: usize) -> Cell<LaneCounters> {
        let place = self.check_lane(lane) * self.routes + self.check_route(route);
        Cell::at(self.lane + place * Cell::<LaneCounters>::WORDS)
    }

    fn histogram(&self, stage: Stage, route: usize) -> usize {
        let of_lane = |lane: usize, stage: usize| 1 + 3 * self.check_lane(lane) + stage;
        let place = match stage {
            Stage::DdsIn => 0,
            Stage::Shm(lane) => of_lane(lane, 0),
            Stage::DdsOut(lane) => of_lane(lane, 1),
            Stage::Age(lane) => of_lane(lane, 2),
        };
        let index = place * self.routes + self.check_route(route);
        self.histograms + index * HISTOGRAM_WORDS.next_multiple_of(LINE)
    }

    fn wake(&self, lane: usize) -> usize {
        self.wake + self.check_lane(lane) * LINE
    }

    /// Numbers come from the configuration that the shape was made of; another one is a defect of the caller.
    fn check_lane(&self, lane: usize) -> usize {
        assert!(lane < self.lanes, "lane {lane} of {}", self.lanes);
        lane
    }

    fn check_route(&self, route: usize) -> usize {
        assert!(route < self.routes, "route {route} of {}", self.routes);
        route
    }
}

/// All boards of an instance.
///
/// # Panics
/// All methods, when the number of a lane or route is not one of the [`BridgeShape`], or a place in a table
/// is not below its size.
#[derive(Clone, Debug)]
pub struct Boards {
    segment: Arc<Segment>,
    layout: Layout,
    policy_lock: PathBuf,
}

impl Boards {
    /// The boards of an instance that runs, or did until its last process was killed; for processes that look
    /// only, such as `status`. `None` when there are none.
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
                what: "the boards were set up with other lanes, other routes, or by another version"
                    .to_owned(),
                path: dir.path.clone(),
            });
        }
        Ok(Self { segment: Arc::new(segment), layout, policy_lock: dir.path.join("policy.lock") })
    }

    /// What a process shows of itself; zeroes while it never ran. `None` when the writer changes it faster
    /// than it can be read, which only a runaway writer does; so for all readings.
    pub fn health(&self, role: ProcessRole) -> Option<ProcessHealth> {
        self.layout.health(role).read(&self.segment)
    }

    /// Writes what a process shows of itself, beginning with what its predecessor wrote. One writer at a
    /// time: the holder of the role's lock.
    pub fn health_writer(&self, role: ProcessRole) -> BoardWriter<ProcessHealth> {
        self.writer(self.layout.health(role))
    }

    /// What ingress has counted on a route.
    pub fn ingress(&self, route: usize) -> Option<IngressCounters> {
        self.layout.ingress(route).read(&self.segment)
    }

    /// Counts for ingress on a route, beginning where its predecessor ended.
    pub fn ingress_writer(&self, route: usize) -> BoardWriter<IngressCounters> {
        self.writer(self.layout.ingress(route))
    }

    /// The account of the publisher at a place below [`MAX_PUBLISHERS`] of a route.
    pub fn publisher(&self, route: usize, place: usize) -> Option<PublisherAccount> {
        self.layout.publisher(route, place).read(&self.segment)
    }

    /// Writes the account of the publisher at a place below [`MAX_PUBLISHERS`] of a route, beginning with
    /// what its predecessor wrote.
    pub fn publisher_writer(&self, route: usize, place: usize) -> BoardWriter<PublisherAccount> {
        self.writer(self.layout.publisher(route, place))
    }

    /// What a lane has counted on a route.
    pub fn lane(&self, lane: usize, route: usize) -> Option<LaneCounters> {
        self.layout.lane(lane, route).read(&self.segment)
    }

    /// Counts for a lane on a route, beginning where its predecessor ended.
    pub fn lane_writer(&self, lane: usize, route: usize) -> BoardWriter<LaneCounters> {
        self.writer(self.layout.lane(lane, route))
    }

    /// What control found and decided for the bridge as a whole.
    pub fn control(&self) -> Option<ControlRecord> {
        self.layout.control().read(&self.segment)
    }

    /// Writes what control found and decided; one writer at a time, as for the health.
    pub fn control_writer(&self) -> BoardWriter<ControlRecord> {
        self.writer(self.layout.control())
    }

    /// What control knows of the subscriber at a place below [`MAX_SUBSCRIBERS`].
    pub fn subscriber(&self, place: usize) -> Option<SubscriberRecord> {
        self.layout.subscriber(place).read(&self.segment)
    }

    /// Writes what control knows of the subscriber at a place below [`MAX_SUBSCRIBERS`].
    pub fn subscriber_writer(&self, place: usize) -> BoardWriter<SubscriberRecord> {
        self.writer(self.layout.subscriber(place))
    }

    /// The intruder at a place below [`MAX_INTRUDERS`].
    pub fn intruder(&self, place: usize) -> Option<IntruderRecord> {
        self.layout.intruder(place).read(&self.segment)
    }

    /// Writes the intruder at a place below [`MAX_INTRUDERS`].
    pub fn intruder_writer(&self, place: usize) -> BoardWriter<IntruderRecord> {
        self.writer(self.layout.intruder(place))
    }

    /// The endpoint that control names at a place below [`MAX_NAMED_ENDPOINTS`].
    pub fn named_endpoint(&self, place: usize) -> Option<NamedEndpoint> {
        self.layout.named_endpoint(place).read(&self.segment)
    }

    /// Writes the endpoint that control names at a place below [`MAX_NAMED_ENDPOINTS`].
    pub fn named_endpoint_writer(&self, place: usize) -> BoardWriter<NamedEndpoint> {
        self.writer(self.layout.named_endpoint(place))
    }

    /// The interface or peer at a place below [`MAX_ABSENCES`] that is or was away.
    pub fn absence(&self, place: usize) -> Option<AbsenceRecord> {
        self.layout.absence(place).read(&self.segment)
    }

    /// Writes the interface or peer at a place below [`MAX_ABSENCES`].
    pub fn absence_writer(&self, place: usize) -> BoardWriter<AbsenceRecord> {
        self.writer(self.layout.absence(place))
    }

    /// The readers that are matched with a lane's output of a route.
    pub fn output_readers(&self, lane: usize, route: usize) -> Option<OutputReaders> {
        self.layout.output_readers(lane, route).read(&self.segment)
    }

    /// Records the readers of a lane's output of a route, beginning with what its predecessor recorded.
    pub fn output_readers_writer(&self, lane: usize, route: usize) -> BoardWriter<OutputReaders> {
        self.writer(self.layout.output_readers(lane, route))
    }

    /// What ingress found out about a route.
    pub fn route_info(&self, route: usize) -> Option<RouteInfo> {
        self.layout.route_info(route).read(&self.segment)
    }

    /// Writes what ingress found out about a route.
    pub fn route_info_writer(&self, route: usize) -> BoardWriter<RouteInfo> {
        self.writer(self.layout.route_info(route))
    }

    /// The latencies of a stage on a route. Counts that are being recorded meanwhile may be in or not.
    pub fn histogram(&self, stage: Stage, route: usize) -> LatencyHistogram {
        load(&self.segment, self.layout.histogram(stage, route))
    }

    /// Records latencies of a stage on a route. One writer at a time, as for the counters.
    pub fn histogram_writer(&self, stage: Stage, route: usize) -> HistogramWriter {
        let upper_edges_ns = LatencyHistogram::default().buckets().map(|(edge_ns, _)| edge_ns).collect();
        HistogramWriter {
            segment: self.segment.clone(),
            at: self.layout.histogram(stage, route),
            upper_edges_ns,
        }
    }

    /// The policy of a lane; epoch 0 when nobody has set one.
    pub fn policy(&self, lane: usize) -> Option<LanePolicy> {
        self.layout.policy(lane).read(&self.segment)
    }

    /// The policies of all lanes, to change them; any process may, one after the other. Others that want to
    /// wait until this is dropped.
    pub fn policies(&self) -> Result<Policies<'_>, ShmError> {
        let one_at_a_time = FileLock::take_soon(&self.policy_lock, FlockArg::LockExclusiveNonblock)?;
        Ok(Policies { boards: self, _one_at_a_time: one_at_a_time })
    }

    /// Wakes a lane.
    pub fn waker(&self, lane: usize) -> LaneWaker {
        LaneWaker::new(self.segment.clone(), self.layout.wake(lane))
    }

    /// Sleeps for a lane; one at a time.
    pub fn sleeper(&self, lane: usize) -> LaneSleeper {
        LaneSleeper::new(self.segment.clone(), self.layout.wake(lane))
    }

    fn writer<T: Plain>(&self, cell: Cell<T>) -> BoardWriter<T> {
        let value = cell.read(&self.segment).unwrap_or_default();
        BoardWriter { segment: self.segment.clone(), cell, value }
    }
}

/// The only one who changes policies.
#[derive(Debug)]
pub struct Policies<'a> {
    boards: &'a Boards,
    _one_at_a_time: FileLock,
}

impl Policies<'_> {
    /// Changes the policy of a lane. `change` gets the present policy and gives the new one; the epoch is
    /// counted here, up by one unless only `written_at` differs. Returns what was written.
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
            // Only a foreign process can have written the last number. 0 still means that none has set one.
            after.epoch = after.epoch.checked_add(1).unwrap_or(1);
            after.changed_at = now;
        }
        cell.write(&self.boards.segment, &after);
        after
    }
}

/// The one writer of one value on a board. Dropping it leaves the value where it is.
#[derive(Debug)]
pub struct BoardWriter<T> {
    segment: Arc<Segment>,
    cell: Cell<T>,
    value: T,
}

#[expect(private_bounds, reason = "only the types of the boards are written")]
impl<T: Plain> BoardWriter<T> {
    /// The value as last written.
    pub fn get(&self) -> &T {
        &self.value
    }

    /// Changes the value and shows it. A process that dies within leaves the value as it was before.
    pub fn update<R>(&mut self, change: impl FnOnce(&mut T) -> R) -> R {
        let result = change(&mut self.value);
        self.cell.write(&self.segment, &self.value);
        result
    }
}

/// The one writer of one histogram.
#[derive(Debug)]
pub struct HistogramWriter {
    segment: Arc<Segment>,
    at: usize,
    /// The upper edge of each bucket, exclusive.
    upper_edges_ns: Box<[u64]>,
}

impl HistogramWriter {
    /// Counts one latency, as [`LatencyHistogram::record`] does.
    pub fn record(&mut self, latency_ns: u64) {
        let above = self.upper_edges_ns.partition_point(|&edge_ns| edge_ns <= latency_ns);
        let bucket = above.min(HISTOGRAM_WORDS - 2);
        let count = self.segment.word(self.at + bucket);
        count.store(count.load(Ordering::Relaxed).wrapping_add(1), Ordering::Relaxed);
        // The maximum stands behind the counts.
        let max_ns = self.segment.word(self.at + HISTOGRAM_WORDS - 1);
        if latency_ns > max_ns.load(Ordering::Relaxed) {
            max_ns.store(latency_ns, Ordering::Relaxed);
        }
    }
}
