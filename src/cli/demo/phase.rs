//! One phase: starts its processes, stops the remote subscriber now and then, and measures.

use std::time::Duration;

use super::children::{Children, Who};
use super::place::Place;
use super::screen::Screen;
use super::tally::{BridgeDrops, Figures, Stalls, Tally, Window, drops_between, scans_in_s};
use super::{DemoError, INPUT_TOPIC, Interrupt, STALL_AFTER_MS, STALL_EVERY_MS, STALL_MS, first_due_after};
use crate::clock;
use crate::config::Settings;
use crate::model::{DropCounts, LaneName, MonotonicNs};
use crate::shm::{Boards, BridgeShape};

/// How the subscribers get the scans.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Way {
    /// Both from the publisher's writer.
    Direct,
    /// Each from a lane of the bridge.
    Bridge,
}

/// Discovery takes a second or two; on a slow machine more.
const READY_PATIENCE_MS: u64 = 20_000;
/// What has to arrive before the measurement begins: half a second at the full rate, and at the 10 Hz of the
/// bridge's remote lane.
const READY_SCANS: [(Who, usize); 2] = [(Who::Critical, 15), (Who::Remote, 5)];
/// How long scans may still be on their way when the phase is over.
const DRAIN_MS: u64 = 1_000;
/// How often what goes on is looked at.
const LOOK: Duration = Duration::from_millis(10);
const DRAW_EVERY_MS: u64 = 200;

/// Runs a phase of `seconds`.
pub(super) fn run(
    place: &Place,
    way: Way,
    seconds: u64,
    interrupt: &Interrupt,
    screen: &mut Screen,
) -> Result<Figures, DemoError> {
    let mut phase = Phase {
        children: Children::new(place),
        tally: Tally::default(),
        interrupt,
        stalls: Stalls::default(),
        stalled_since: None,
    };
    phase.start(place, way)?;
    let window = phase.wait_until_ready(seconds)?;
    // The boards are there: scans have come through them.
    let watch = match way {
        Way::Direct => None,
        Way::Bridge => Some(DropWatch::begin(place)?),
    };
    phase.measure(way, &window, screen)?;
    let mut figures = phase.tally.figures(&window, phase.stalls, window.end());
    figures.drops = watch.as_ref().map(DropWatch::end);
    Ok(figures)
}

struct Phase<'a> {
    children: Children<'a>,
    tally: Tally,
    interrupt: &'a Interrupt,
    stalls: Stalls,
    stalled_since: Option<MonotonicNs>,
}

impl Phase<'_> {
    fn start(&mut self, place: &Place, way: Way) -> Result<(), DemoError> {
        let domain = place.domain().to_string();
        let config_file = place.config_file();
        let settings = place.settings();
        let (critical_topic, remote_topic, remote_reliability) = match way {
            Way::Direct => (INPUT_TOPIC, INPUT_TOPIC, "reliable"),
            Way::Bridge => {
                self.children.start(Who::Bridge, &["up", "--config", &config_file.to_string_lossy()])?;
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
        self.children.start(Who::Critical, &subscriber(critical_topic, "critical", "reliable"))?;
        self.children.start(Who::Remote, &subscriber(remote_topic, "remote", remote_reliability))?;
        self.children.start(Who::Publisher, &["demo-publisher", "--domain", &domain, "--topic", INPUT_TOPIC])
    }

    /// Waits until scans flow to both subscribers, and says which ones are to be measured.
    fn wait_until_ready(&mut self, seconds: u64) -> Result<Window, DemoError> {
        let deadline = clock::monotonic().plus_ms(READY_PATIENCE_MS);
        loop {
            self.look()?;
            let now = clock::monotonic();
            let late = READY_SCANS.iter().find(|(who, scans)| self.tally.arrived(*who) < *scans);
            match (late, self.tally.began_at()) {
                (None, Some(began_at)) => {
                    // In a tenth of a second, so that the first scan is not one that was published already.
                    let first = first_due_after(began_at, now.plus_ms(100));
                    return Ok(Window { began_at, numbers: first..first + scans_in_s(seconds) });
                }
                (late, _) if now >= deadline => {
                    let who = late.map_or(Who::Publisher, |(who, _)| *who);
                    return Err(DemoError::NothingArrives {
                        who: who.name(),
                        patience_ms: READY_PATIENCE_MS,
                    });
                }
                _ => {}
            }
        }
    }

    fn measure(&mut self, way: Way, window: &Window, screen: &mut Screen) -> Result<(), DemoError> {
        let mut draw_at = window.start();
        loop {
            self.look()?;
            let now = clock::monotonic();
            if now >= window.end() {
                break;
            }
            self.set_stalled(is_stalled(window, now), now);
            if now >= draw_at {
                draw_at = now.plus_ms(DRAW_EVERY_MS);
                screen.draw(way, &self.tally, window, self.stalls_until(now), self.stalled_since, now);
                if screen.is_gone() {
                    return Err(DemoError::Interrupted);
                }
            }
        }
        self.set_stalled(false, window.end());
        let deadline = window.end().plus_ms(DRAIN_MS);
        while clock::monotonic() < deadline {
            self.look()?;
        }
        screen.draw(way, &self.tally, window, self.stalls, None, window.end());
        Ok(())
    }

    /// Takes in what was reported, and sees to it that all is well.
    fn look(&mut self) -> Result<(), DemoError> {
        if let Some((who, report)) = self.children.next_report(LOOK) {
            self.tally.add(who, report);
        }
        if self.interrupt.is_requested() {
            return Err(DemoError::Interrupted);
        }
        match self.children.ended() {
            Some((who, status)) => Err(DemoError::Ended { who: who.name(), status }),
            None => Ok(()),
        }
    }

    fn set_stalled(&mut self, stalled: bool, now: MonotonicNs) {
        if stalled == self.stalled_since.is_some() {
            return;
        }
        self.children.set_stopped(Who::Remote, stalled);
        if stalled {
            self.stalls.count += 1;
            self.stalled_since = Some(now);
        } else {
            self.stalls = self.stalls_until(now);
            self.stalled_since = None;
        }
    }

    /// The stalls, with that of the moment as far as it has lasted.
    fn stalls_until(&self, now: MonotonicNs) -> Stalls {
        let present_ns = self.stalled_since.map_or(0, |since| now.since(since));
        Stalls { ns: self.stalls.ns + present_ns, ..self.stalls }
    }
}

/// Whether the remote subscriber is to be stopped at an instant of the window.
pub(super) fn is_stalled(window: &Window, instant: MonotonicNs) -> bool {
    let in_cycle_ms = instant.since(window.start()) / 1_000_000 % STALL_EVERY_MS;
    (STALL_AFTER_MS..STALL_AFTER_MS + STALL_MS).contains(&in_cycle_ms)
}

/// What the critical and the noncritical lane publish to.
fn lane_topics(settings: &Settings) -> Result<[&str; 2], DemoError> {
    let topic = |index: usize| {
        let output = settings.lanes.get(index)?.outputs.first()?;
        Some(output.topic.as_str())
    };
    let [critical, noncritical] = lane_numbers(settings)?;
    topic(critical)
        .zip(topic(noncritical))
        .map(|(critical, noncritical)| [critical, noncritical])
        .ok_or_else(|| DemoError::Config("the demo's lanes have no outputs".to_owned()))
}

fn lane_numbers(settings: &Settings) -> Result<[usize; 2], DemoError> {
    let number = |name: &LaneName| settings.lanes.iter().position(|lane| lane.name == *name);
    number(&LaneName::critical())
        .zip(number(&LaneName::noncritical()))
        .map(|(critical, noncritical)| [critical, noncritical])
        .ok_or_else(|| DemoError::Config("the demo's lanes are missing".to_owned()))
}

/// What the bridge drops while it is measured: the difference of two readings of its boards.
struct DropWatch {
    boards: Boards,
    lanes: [usize; 2],
    before: [DropCounts; 3],
}

impl DropWatch {
    fn begin(place: &Place) -> Result<Self, DemoError> {
        let settings = place.settings();
        let found = Boards::find(&place.shm_root(), &settings.instance, &BridgeShape::of(settings))?;
        let boards = found.ok_or_else(|| DemoError::Config("the bridge has no boards".to_owned()))?;
        let lanes = lane_numbers(settings)?;
        let before = Self::read(&boards, lanes);
        Ok(Self { boards, lanes, before })
    }

    fn end(&self) -> BridgeDrops {
        let after = Self::read(&self.boards, self.lanes);
        let [ingress, critical, noncritical] =
            std::array::from_fn(|index| drops_between(&self.before[index], &after[index]));
        BridgeDrops { ingress, critical, noncritical }
    }

    /// The demo's one route in ingress and in the two lanes.
    fn read(boards: &Boards, lanes: [usize; 2]) -> [DropCounts; 3] {
        let lane = |lane| boards.lane(lane, 0).map(|counters| counters.drops).unwrap_or_default();
        let ingress = boards.ingress(0).map(|counters| counters.drops).unwrap_or_default();
        [ingress, lane(lanes[0]), lane(lanes[1])]
    }
}
