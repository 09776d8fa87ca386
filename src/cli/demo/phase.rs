//! One phase of a demo: starts its processes, periodically stops the remote subscriber, and measures.

use std::ops::Range;
use std::time::Duration;

use super::children::{Children, Role};
use super::sandbox::Sandbox;
use super::screen::Screen;
use super::tally::{BridgeDrops, Figures, Tally, Window};
use super::{DemoError, INPUT_TOPIC, RATE_HZ, Setup, first_due_after};
use crate::clock;
use crate::config::Settings;
use crate::model::{DropCounts, MonotonicNs};
use crate::process::Stop;
use crate::shm::{Boards, BridgeShape, root_of};

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
/// The indices of the lanes that any settings begin with.
const CRITICAL: usize = 0;
const NONCRITICAL: usize = 1;

pub(super) fn run(
    sandbox: &Sandbox,
    setup: Setup,
    seconds: u64,
    stop: &Stop,
    screen: &mut Screen,
) -> Result<Figures, DemoError> {
    let mut phase = Phase {
        children: Children::new(sandbox),
        tally: Tally::default(),
        stop,
        stalled_since: None,
        stalls: Vec::new(),
    };
    phase.start(sandbox, setup)?;
    let window = phase.wait_until_ready(seconds)?;
    // The boards exist by now, because scans have passed the bridge.
    let boards = match setup {
        Setup::Direct => None,
        Setup::Bridge => Some(boards(&sandbox.settings)?),
    };
    let before = boards.as_ref().map(drop_counts);
    phase.measure(setup, &window, screen)?;
    let mut figures = phase.tally.figures(&window, &phase.stalls, window.end());
    figures.timeline = phase.tally.timeline(&window, &phase.stalls);
    let after = boards.as_ref().map(drop_counts);
    figures.drops = before.zip(after).map(|(before, after)| BridgeDrops::between(&before, &after));
    Ok(figures)
}

struct Phase<'a> {
    children: Children<'a>,
    tally: Tally,
    stop: &'a Stop,
    stalled_since: Option<MonotonicNs>,
    /// The stalls that have ended.
    stalls: Vec<Range<MonotonicNs>>,
}

impl Phase<'_> {
    fn start(&mut self, sandbox: &Sandbox, setup: Setup) -> Result<(), DemoError> {
        let Settings { lanes, input, .. } = &sandbox.settings;
        let [critical, noncritical] =
            [CRITICAL, NONCRITICAL].map(|lane| lanes[lane].outputs[0].topic.to_string());
        let (critical, remote, remote_options) = match setup {
            Setup::Direct => (INPUT_TOPIC, INPUT_TOPIC, vec!["--name", "remote"]),
            Setup::Bridge => {
                let config_file = sandbox.config_file();
                self.children.start(Role::Bridge, &["up", "--config", &config_file.to_string_lossy()])?;
                (&*critical, &*noncritical, vec!["--name", "remote", "--best-effort"])
            }
        };
        let domain = input.domain_id.to_string();
        let mut start = |role, program, topic, options: &[&str]| {
            self.children.start(role, &[&[program, "--domain", &domain, "--topic", topic], options].concat())
        };
        start(Role::Critical, "demo-subscriber", critical, &["--name", "critical"])?;
        start(Role::Remote, "demo-subscriber", remote, &remote_options)?;
        start(Role::Publisher, "demo-publisher", INPUT_TOPIC, &[])
    }

    /// Waits until scans arrive at both subscribers and returns the window to measure.
    fn wait_until_ready(&mut self, seconds: u64) -> Result<Window, DemoError> {
        let deadline = clock::monotonic().plus_ms(READY_TIMEOUT_MS);
        loop {
            self.poll()?;
            let now = clock::monotonic();
            let late = READY_SCANS.iter().find(|(role, scans)| self.tally.arrived(*role) < *scans);
            match (late, self.tally.began_at) {
                (None, Some(began_at)) => {
                    // A tenth of a second later, so that the first scan of the window is not published yet.
                    let first = first_due_after(began_at, now.plus_ms(100));
                    return Ok(Window { began_at, numbers: first..first + seconds * RATE_HZ });
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
                screen.draw(setup, &self.tally, window, self.stalled_since, now);
                if screen.closed {
                    return Err(DemoError::Interrupted);
                }
            }
        }
        self.set_stalled(false, window.end());
        let deadline = window.end().plus_ms(DRAIN_MS);
        while clock::monotonic() < deadline {
            self.poll()?;
        }
        screen.draw(setup, &self.tally, window, None, window.end());
        Ok(())
    }

    /// Waits for the next report and adds it to the tally; fails on an interrupt or when a process has
    /// exited.
    fn poll(&mut self) -> Result<(), DemoError> {
        if let Some((role, report)) = self.children.next_report(POLL_INTERVAL) {
            self.tally.add(role, report);
        }
        if self.stop.is_requested() {
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
        self.stalls.extend(self.stalled_since.take().map(|since| since..now));
        self.stalled_since = stalled.then_some(now);
    }
}

fn boards(settings: &Settings) -> Result<Boards, DemoError> {
    let found = Boards::find(&root_of(settings), &settings.instance, &BridgeShape::of(settings))?;
    found.ok_or_else(|| DemoError::Config("the bridge has no boards".to_owned()))
}

/// The drop counts of the demo's one route in ingress and in the two lanes.
fn drop_counts(boards: &Boards) -> [DropCounts; 3] {
    let lane = |lane| boards.lane(lane, 0).map(|counters| counters.drops).unwrap_or_default();
    let ingress = boards.ingress(0).map(|counters| counters.drops).unwrap_or_default();
    [ingress, lane(CRITICAL), lane(NONCRITICAL)]
}
