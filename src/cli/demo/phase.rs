//! One phase of a demo: starts its processes, periodically stops the remote subscriber, and measures.

use std::ops::Range;
use std::time::Duration;

use super::children::{Children, Role};
use super::sandbox::Sandbox;
use super::screen::Screen;
use super::tally::{BridgeDrops, Figures, Stalls, Tally, Window, drops_between, scans_in_s};
use super::{DemoError, INPUT_TOPIC, Interrupt, Setup, first_due_after};
use crate::clock;
use crate::config::Settings;
use crate::model::{DropCounts, LaneName, MonotonicNs};
use crate::shm::{Boards, BridgeShape};

/// How long to wait for the first scans. Discovery takes a second or two, more on a slow machine.
const READY_TIMEOUT_MS: u64 = 20_000;
/// Scans that must arrive before the measurement begins: half a second's at the full rate and at the 10 Hz of
/// the bridge's remote lane.
const READY_SCANS: [(Role, usize); 2] = [(Role::Critical, 15), (Role::Remote, 5)];
/// How long to wait for the last scans after the phase.
const DRAIN_MS: u64 = 1_000;
/// The longest wait for a report before stalls, exits and the screen are handled again.
const POLL_INTERVAL: Duration = Duration::from_millis(10);
const DRAW_EVERY_MS: u64 = 200;

/// Runs a phase of `seconds` and returns its figures.
pub(super) fn run(
    sandbox: &Sandbox,
    setup: Setup,
    seconds: u64,
    interrupt: &Interrupt,
    screen: &mut Screen,
) -> Result<Figures, DemoError> {
    let mut phase = Phase {
        children: Children::new(sandbox),
        tally: Tally::default(),
        interrupt,
        stalls: Stalls::default(),
        stalled_since: None,
        stalled: Vec::new(),
    };
    phase.start(sandbox, setup)?;
    let window = phase.wait_until_ready(seconds)?;
    // The boards exist by now, because scans have passed the bridge.
    let drops = match setup {
        Setup::Direct => None,
        Setup::Bridge => Some(DropMeter::begin(sandbox)?),
    };
    phase.measure(setup, &window, screen)?;
    let mut figures = phase.tally.figures(&window, phase.stalls, window.end());
    figures.timeline = phase.tally.timeline(&window, &phase.stalled);
    figures.drops = drops.as_ref().map(DropMeter::end);
    Ok(figures)
}

struct Phase<'a> {
    children: Children<'a>,
    tally: Tally,
    interrupt: &'a Interrupt,
    stalls: Stalls,
    stalled_since: Option<MonotonicNs>,
    /// The stalls that have ended.
    stalled: Vec<Range<MonotonicNs>>,
}

impl Phase<'_> {
    fn start(&mut self, sandbox: &Sandbox, setup: Setup) -> Result<(), DemoError> {
        let domain = sandbox.domain().to_string();
        let config_file = sandbox.config_file();
        let settings = sandbox.settings();
        let (critical_topic, remote_topic, remote_reliability) = match setup {
            Setup::Direct => (INPUT_TOPIC, INPUT_TOPIC, "reliable"),
            Setup::Bridge => {
                self.children.start(Role::Bridge, &["up", "--config", &config_file.to_string_lossy()])?;
                let [critical, remote] = lane_topics(settings)?;
                (critical, remote, "best-effort")
            }
        };
        let subscriber = |topic, name, reliability| {
            let domain = domain.as_str();
            #[rustfmt::skip]
            let arguments = [
                "demo-subscriber", "--domain", domain, "--topic", topic, "--name", name,
                "--reliability", reliability,
            ];
            arguments
        };
        self.children.start(Role::Critical, &subscriber(critical_topic, "critical", "reliable"))?;
        self.children.start(Role::Remote, &subscriber(remote_topic, "remote", remote_reliability))?;
        self.children.start(Role::Publisher, &["demo-publisher", "--domain", &domain, "--topic", INPUT_TOPIC])
    }

    /// Waits until scans arrive at both subscribers and returns the window to measure.
    fn wait_until_ready(&mut self, seconds: u64) -> Result<Window, DemoError> {
        let deadline = clock::monotonic().plus_ms(READY_TIMEOUT_MS);
        loop {
            self.poll()?;
            let now = clock::monotonic();
            let late = READY_SCANS.iter().find(|(role, scans)| self.tally.arrived(*role) < *scans);
            match (late, self.tally.began_at()) {
                (None, Some(began_at)) => {
                    // A tenth of a second later, so that the first scan of the window is not published yet.
                    let first = first_due_after(began_at, now.plus_ms(100));
                    return Ok(Window { began_at, numbers: first..first + scans_in_s(seconds) });
                }
                (late, _) if now >= deadline => {
                    let role = late.map_or(Role::Publisher, |(role, _)| *role);
                    return Err(DemoError::NothingArrives {
                        name: role.name(),
                        timeout_ms: READY_TIMEOUT_MS,
                    });
                }
                _ => {}
            }
        }
    }

    fn measure(&mut self, setup: Setup, window: &Window, screen: &mut Screen) -> Result<(), DemoError> {
        let mut draw_at = window.start();
        loop {
            self.poll()?;
            let now = clock::monotonic();
            if now >= window.end() {
                break;
            }
            self.set_stalled(window.is_stalled(now), now);
            if now >= draw_at {
                draw_at = now.plus_ms(DRAW_EVERY_MS);
                screen.draw(setup, &self.tally, window, self.stalls_until(now), self.stalled_since, now);
                if screen.is_closed() {
                    return Err(DemoError::Interrupted);
                }
            }
        }
        self.set_stalled(false, window.end());
        let deadline = window.end().plus_ms(DRAIN_MS);
        while clock::monotonic() < deadline {
            self.poll()?;
        }
        screen.draw(setup, &self.tally, window, self.stalls, None, window.end());
        Ok(())
    }

    /// Waits for the next report and adds it to the tally; fails on an interrupt or when a process has
    /// exited.
    fn poll(&mut self) -> Result<(), DemoError> {
        if let Some((role, report)) = self.children.next_report(POLL_INTERVAL) {
            self.tally.add(role, report);
        }
        if self.interrupt.is_requested() {
            return Err(DemoError::Interrupted);
        }
        match self.children.exited() {
            Some((role, status)) => Err(DemoError::Ended { name: role.name(), status }),
            None => Ok(()),
        }
    }

    /// Stops or continues the remote subscriber if that changes its state, and accounts for the stall.
    fn set_stalled(&mut self, stalled: bool, now: MonotonicNs) {
        if stalled == self.stalled_since.is_some() {
            return;
        }
        self.children.set_stopped(Role::Remote, stalled);
        if stalled {
            self.stalls.count += 1;
            self.stalled_since = Some(now);
        } else {
            self.stalls = self.stalls_until(now);
            self.stalled.extend(self.stalled_since.take().map(|since| since..now));
        }
    }

    /// The stalls so far, including the elapsed part of a stall that still lasts.
    fn stalls_until(&self, now: MonotonicNs) -> Stalls {
        let current_ns = self.stalled_since.map_or(0, |since| now.since(since));
        Stalls { ns: self.stalls.ns + current_ns, ..self.stalls }
    }
}

/// The output topics of the critical and the noncritical lane.
fn lane_topics(settings: &Settings) -> Result<[&str; 2], DemoError> {
    let topic = |index: usize| {
        let output = settings.lanes.get(index)?.outputs.first()?;
        Some(output.topic.as_str())
    };
    let [critical, noncritical] = lane_indices(settings)?;
    topic(critical)
        .zip(topic(noncritical))
        .map(|(critical, noncritical)| [critical, noncritical])
        .ok_or_else(|| DemoError::Config("the demo's lanes have no outputs".to_owned()))
}

/// The indices of the critical and the noncritical lane in the settings.
fn lane_indices(settings: &Settings) -> Result<[usize; 2], DemoError> {
    let index = |name: &LaneName| settings.lanes.iter().position(|lane| lane.name == *name);
    index(&LaneName::critical())
        .zip(index(&LaneName::noncritical()))
        .map(|(critical, noncritical)| [critical, noncritical])
        .ok_or_else(|| DemoError::Config("the demo's lanes are missing".to_owned()))
}

/// Counts the samples that the bridge drops during the measurement, from two readings of its boards.
struct DropMeter {
    boards: Boards,
    lanes: [usize; 2],
    before: [DropCounts; 3],
}

impl DropMeter {
    fn begin(sandbox: &Sandbox) -> Result<Self, DemoError> {
        let settings = sandbox.settings();
        let found = Boards::find(&sandbox.shm_root(), &settings.instance, &BridgeShape::of(settings))?;
        let boards = found.ok_or_else(|| DemoError::Config("the bridge has no boards".to_owned()))?;
        let lanes = lane_indices(settings)?;
        let before = Self::read(&boards, lanes);
        Ok(Self { boards, lanes, before })
    }

    fn end(&self) -> BridgeDrops {
        let after = Self::read(&self.boards, self.lanes);
        let [ingress, critical, noncritical] =
            std::array::from_fn(|index| drops_between(&self.before[index], &after[index]));
        BridgeDrops { ingress, critical, noncritical }
    }

    /// The drop counts of the demo's one route in ingress and in the two lanes.
    fn read(boards: &Boards, lanes: [usize; 2]) -> [DropCounts; 3] {
        let lane = |lane| boards.lane(lane, 0).map(|counters| counters.drops).unwrap_or_default();
        let ingress = boards.ingress(0).map(|counters| counters.drops).unwrap_or_default();
        [ingress, lane(lanes[0]), lane(lanes[1])]
    }
}
