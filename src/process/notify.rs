//! Notifications to the service manager (sd_notify(3)): readiness, status line, watchdog, reload and
//! shutdown. Without a service manager all of this does nothing.

use std::fmt::Display;
use std::time::Duration;

use sd_notify::NotifyState;
use tracing::warn;

use crate::model::{DropCounts, MonotonicNs};

/// Shortest interval between two status lines.
const STATUS_MS: u64 = 1_000;

/// Watchdog messages per watchdog timeout, so that one late message does not restart the process.
const FEEDS_PER_TIMEOUT: u32 = 4;

/// How long a start may take, in microseconds: `TimeoutStartSec` of the services.
const START_US: u32 = 30_000_000;

/// Sends the state of this process to its service manager.
#[derive(Debug)]
pub(super) struct Notifier {
    /// Whether a service manager receives the notifications.
    pub is_enabled: bool,
    /// Shortest interval between two watchdog messages; `None` without a watchdog.
    feed_every: Option<Duration>,
    feed_at: MonotonicNs,
    ready: bool,
    status: String,
    status_at: MonotonicNs,
    /// Text before each status line.
    prefix: &'static str,
}

impl Notifier {
    /// Reads the notification settings that the service manager has put into the environment.
    pub fn new() -> Self {
        Self {
            is_enabled: std::env::var_os("NOTIFY_SOCKET").is_some(),
            feed_every: sd_notify::watchdog_enabled().map(|timeout| timeout / FEEDS_PER_TIMEOUT),
            feed_at: MonotonicNs(0),
            ready: false,
            status: String::new(),
            status_at: MonotonicNs(0),
            prefix: "",
        }
    }

    /// Reports, once, that the process has shared memory and the DDS endpoints whose types are known.
    pub fn ready(&mut self) {
        if !std::mem::replace(&mut self.ready, true) {
            send(&[NotifyState::Ready]);
        }
    }

    /// Gives the process as much time until its next turn as a service has for its start.
    pub fn allow_start(&self) {
        if self.feed_every.is_some() {
            send(&[NotifyState::WatchdogUsec(START_US)]);
        }
    }

    /// Ends that time.
    pub fn end_start(&self) {
        if let Some(timeout) = self.feed_every.map(|every| every * FEEDS_PER_TIMEOUT) {
            let usec = u32::try_from(timeout.as_micros()).unwrap_or(u32::MAX);
            send(&[NotifyState::WatchdogUsec(usec), NotifyState::Watchdog]);
        }
    }

    /// Feeds the watchdog, if it is time to. To be called only after a turn of the data path, so that the
    /// service manager restarts a process that is alive but stuck.
    pub fn feed_watchdog(&mut self, now: MonotonicNs) {
        if let Some(every) = self.feed_every
            && now >= self.feed_at
        {
            send(&[NotifyState::Watchdog]);
            self.feed_at = now.plus_ns(u64::try_from(every.as_nanos()).unwrap_or(u64::MAX));
        }
    }

    /// Sends the status line that `describe` writes, if it is time to and the line has changed.
    pub fn status(&mut self, now: MonotonicNs, describe: impl FnOnce(&mut String)) {
        if !self.is_enabled || now < self.status_at {
            return;
        }
        self.status_at = now.plus_ms(STATUS_MS);
        let mut status = self.prefix.to_owned();
        describe(&mut status);
        if status != self.status {
            send(&[NotifyState::Status(&status)]);
            self.status = status;
        }
    }

    pub fn reloaded(&mut self, refused: bool) {
        self.prefix = if refused { "the changed configuration file is bad and not in force; " } else { "" };
        self.status_at = MonotonicNs(0);
        send(&[NotifyState::Ready]);
    }

    pub fn stopping(&self) {
        send(&[NotifyState::Stopping]);
    }
}

pub(super) fn reloading() {
    match NotifyState::monotonic_usec_now() {
        Ok(now) => send(&[NotifyState::Reloading, now]),
        Err(error) => warn!(%error, "cannot notify the service manager of the reload"),
    }
}

/// Does nothing without a service manager.
fn send(state: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(state) {
        warn!(%error, "cannot notify the service manager");
    }
}

/// Computes the rate of a growing count from two readings of it.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Meter {
    count: u64,
    at: MonotonicNs,
}

impl Meter {
    /// The increase of the count per second since the last call; 0 at the first call.
    pub fn per_s(&mut self, count: u64, now: MonotonicNs) -> f64 {
        let before = std::mem::replace(self, Self { count, at: now });
        let elapsed_ns = now.since(before.at);
        if before.at == MonotonicNs(0) || elapsed_ns == 0 {
            return 0.0;
        }
        count.saturating_sub(before.count) as f64 * 1e9 / elapsed_ns as f64
    }
}

/// Appends `; dropped` and the sum of the counts of each reason; nothing without drops.
pub(super) fn write_drops<'a>(line: &mut String, counts: impl Iterator<Item = &'a DropCounts>) {
    let mut drops = DropCounts::default();
    counts.for_each(|one| drops.merge(one));
    let dropped = drops.iter().map(|(reason, dropped)| format!("{dropped} {reason}"));
    write_list(line, "; dropped", dropped);
}

/// Appends the heading and the comma-separated items; nothing without items.
pub(super) fn write_list(line: &mut String, heading: &str, items: impl Iterator<Item = impl Display>) {
    let mut before = heading;
    for item in items {
        *line += &format!("{before} {item}");
        before = ",";
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::DropReason;

    #[test]
    fn a_meter_returns_the_rate_between_two_readings() {
        let at = |ms| MonotonicNs(1).plus_ms(ms);
        let mut meter = Meter::default();
        assert_eq!(meter.per_s(1_000, at(0)), 0.0);
        assert_eq!(meter.per_s(1_050, at(500)), 100.0);
        assert_eq!(meter.per_s(1_050, at(500)), 0.0);
        assert_eq!(meter.per_s(0, at(1_500)), 0.0);
    }

    #[test]
    fn a_status_line_lists_drops_by_reason() {
        let mut drops = [DropCounts::default(); 2];
        let mut line = String::from("x");
        write_drops(&mut line, drops.iter());
        assert_eq!(line, "x");
        drops[0].add(DropReason::Stale, 3);
        drops[1].add(DropReason::Superseded, 30);
        drops[0].add(DropReason::Superseded, 10);
        write_drops(&mut line, drops.iter());
        assert_eq!(line, "x; dropped 3 stale, 40 superseded");
    }
}
