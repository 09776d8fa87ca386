//! Problems of the bridge's processes.

use super::{Level, Problem};
use crate::model::TakeOverCause;
use crate::policy::is_take_over_storm;
use crate::shm::ProcessRole;
use crate::telemetry::liveness::ProcessState;
use crate::telemetry::snapshot::{ProcessReading, Snapshot};

/// The problem of a process that does not run, or that was restarted within the window.
pub(super) fn problem(process: &ProcessReading, now: &Snapshot, before: &Snapshot) -> Option<Problem> {
    let (name, pid) = (&process.name, process.health.pid);
    let consequence = match process.role {
        ProcessRole::Ingress => "the bridge receives no samples".to_owned(),
        ProcessRole::Control => {
            "lanes keep their modes for policy_hold_s, then critical lanes are normal and noncritical ones degraded"
                .to_owned()
        }
        ProcessRole::Egress(lane) => match now.lanes.get(lane) {
            Some(lane) => format!("lane {} forwards nothing", lane.name),
            None => "its lane forwards nothing".to_owned(),
        },
    };
    let about = about(process, now);
    let start = start_command(name);
    let text = match process.state {
        // An operator ended it, so it is no error; the consequence is worth a warning.
        ProcessState::Ended => {
            let text = format!(
                "{name} has ended: {consequence}; if it should run, start its service or run `{start}`"
            );
            return Some(Problem::new(about, Level::Warn, text));
        }
        ProcessState::Dead => format!(
            "{name} (pid {pid}) is dead: {consequence}; read its log, and if it is not restarted \
             automatically, start its service or run `{start}`"
        ),
        ProcessState::Stopped => {
            format!("{name} (pid {pid}) is stopped: {consequence}; resume it with `kill -CONT {pid}`")
        }
        ProcessState::Silent => {
            let silent_s = now.at.since(process.health.alive_at) as f64 / 1e9;
            format!(
                "{name} (pid {pid}) hangs, its main loop made no turn for {silent_s:.1} s: {consequence}; check the \
                 CPU load and its log, and restart it if it does not recover"
            )
        }
        ProcessState::NotStarted => {
            format!("{name} was never started: {consequence}; start its service or run `{start}`")
        }
        ProcessState::Running => {
            let former = before.processes.iter().find(|former| former.name == process.name)?;
            let restarts = process.health.starts.checked_sub(former.health.starts).filter(|&n| n > 0)?;
            let times = if restarts == 1 { "once".to_owned() } else { format!("{restarts} times") };
            let window = super::window_text(now, before);
            let text =
                format!("{name} was restarted {times} in the last {window}; read its log for the cause");
            return Some(Problem::new(about, Level::Warn, text));
        }
    };
    Some(Problem::new(about, Level::Error, text))
}

/// The problem of a process whose standby has to take over again and again.
pub(super) fn take_over_storm(process: &ProcessReading, now: &Snapshot) -> Option<Problem> {
    let standby = &process.standby;
    let what = match standby.cause()? {
        TakeOverCause::Stopped => "was stopped by a signal",
        TakeOverCause::Hung => "made no progress",
        TakeOverCause::Ended | TakeOverCause::HandedOver => "ended",
    };
    is_take_over_storm(standby, now.at).then(|| {
        let text = format!(
            "the standby of {} took over {} times, each time within a minute of the last, because the active process \
             {what}: read its log for the cause; samples are lost when it fails before the next standby has started",
            process.name, standby.in_a_row
        );
        Problem::new(about(process, now), Level::Warn, text)
    })
}

/// The part that a problem of this process is about.
pub(super) fn about(process: &ProcessReading, now: &Snapshot) -> String {
    match process.role {
        ProcessRole::Egress(lane) => now.lanes.get(lane).map_or("bridge".to_owned(), super::about_lane),
        ProcessRole::Ingress | ProcessRole::Control => process.name.clone(),
    }
}

/// The command that starts the process of that name by hand.
fn start_command(process_name: &str) -> String {
    match process_name.strip_prefix("egress-") {
        Some(lane) => format!("adaptive-bridge egress --lane {lane}"),
        None => format!("adaptive-bridge {process_name}"),
    }
}
