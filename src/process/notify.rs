//! What a process tells the service manager that started it: that it is ready, what it does, that it turns,
//! that it ends (sd_notify(3)). Nobody else listens; then all of this does nothing.

use std::fmt::{Display, Write};
use std::time::Duration;

use sd_notify::NotifyState;
use tracing::warn;

use crate::model::{DropCounts, MonotonicNs};

/// A status line is sent so often at most.
const STATUS_MS: u64 = 1_000;

/// The watchdog is fed so many times within its time, so that one message more or less does not matter.
const FEEDS_PER_TIMEOUT: u32 = 4;

/// A process as its service manager sees it.
#[derive(Debug)]
pub(super) struct Notifier {
    listens: bool,
    /// The least time between two feeds of the watchdog; `None` when there is none.
    feed_every: Option<Duration>,
    feed_at: MonotonicNs,
    ready: bool,
    status: String,
    status_at: MonotonicNs,
    /// Goes before the status.
    remark: &'static str,
}

impl Notifier {
    /// By what the service manager has left in the environment.
    pub fn new() -> Self {
        Self {
            listens: std::env::var_os("NOTIFY_SOCKET").is_some(),
            feed_every: sd_notify::watchdog_enabled().map(|timeout| timeout / FEEDS_PER_TIMEOUT),
            feed_at: MonotonicNs(0),
            ready: false,
            status: String::new(),
            status_at: MonotonicNs(0),
            remark: "",
        }
    }

    /// Whether anybody listens.
    pub fn listens(&self) -> bool {
        self.listens
    }

    /// The process is up: shared memory is attached, and so are the DDS endpoints whose types are known.
    /// Once.
    pub fn ready(&mut self) {
        if self.listens && !std::mem::replace(&mut self.ready, true) {
            send(&[NotifyState::Ready]);
        }
    }

    /// The data path turned. Only to be called where that is so: a process that is alive and stuck is to be
    /// restarted.
    pub fn turned(&mut self, now: MonotonicNs) {
        if let Some(every) = self.feed_every
            && now >= self.feed_at
        {
            send(&[NotifyState::Watchdog]);
            self.feed_at = now.plus_ns(u64::try_from(every.as_nanos()).unwrap_or(u64::MAX));
        }
    }

    /// Says what the process does, when it is time to and that has changed. `describe` writes a line.
    pub fn status(&mut self, now: MonotonicNs, describe: impl FnOnce(&mut String)) {
        if !self.listens || now < self.status_at {
            return;
        }
        self.status_at = now.plus_ms(STATUS_MS);
        let mut status = String::with_capacity(self.status.len());
        status.push_str(self.remark);
        describe(&mut status);
        if status != self.status {
            send(&[NotifyState::Status(&status)]);
            self.status = status;
        }
    }

    /// A reload was dealt with.
    pub fn reloaded(&mut self, refused: bool) {
        self.remark = if refused { "the changed configuration file is bad and not in force; " } else { "" };
        self.status_at = MonotonicNs(0);
        if self.listens {
            send(&[NotifyState::Ready]);
        }
    }

    /// The process begins to end.
    pub fn stopping(&self) {
        if self.listens {
            send(&[NotifyState::Stopping]);
        }
    }
}

/// A reload was asked for, and begins.
pub(super) fn reloading() {
    match NotifyState::monotonic_usec_now() {
        Ok(now) => send(&[NotifyState::Reloading, now]),
        Err(error) => warn!(%error, "the service manager is not told of the reload"),
    }
}

fn send(state: &[NotifyState<'_>]) {
    if let Err(error) = sd_notify::notify(state) {
        warn!(%error, "the service manager cannot be told");
    }
}

/// A count that grows, as a rate: what was counted between two readings.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Meter {
    count: u64,
    at: MonotonicNs,
}

impl Meter {
    /// The growth per second since the last reading; 0 at the first.
    pub fn per_s(&mut self, count: u64, now: MonotonicNs) -> f64 {
        let before = std::mem::replace(self, Self { count, at: now });
        let elapsed_ns = now.since(before.at);
        if before.at == MonotonicNs(0) || elapsed_ns == 0 {
            return 0.0;
        }
        count.saturating_sub(before.count) as f64 * 1e9 / elapsed_ns as f64
    }
}

/// Appends `; dropped` and each reason with the sum of its counts, or nothing when there was no drop.
pub(super) fn write_drops<'a>(line: &mut String, counts: impl Iterator<Item = &'a DropCounts>) {
    let mut drops = DropCounts::default();
    for (reason, dropped) in counts.flat_map(DropCounts::iter) {
        drops.add(reason, dropped);
    }
    let dropped = drops.iter().map(|(reason, dropped)| format!("{dropped} {reason}"));
    write_list(line, "; dropped", dropped);
}

/// Appends the heading and the items, with commas between; nothing when there are none.
pub(super) fn write_list(line: &mut String, heading: &str, items: impl Iterator<Item = impl Display>) {
    let mut before = heading;
    for item in items {
        // Writing to a String cannot fail.
        let _ = write!(line, "{before} {item}");
        before = ",";
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::DropReason;

    #[test]
    fn a_meter_tells_what_was_counted_per_second() {
        let at = |ms| MonotonicNs(1).plus_ms(ms);
        let mut meter = Meter::default();
        assert_eq!(meter.per_s(1_000, at(0)), 0.0);
        assert_eq!(meter.per_s(1_050, at(500)), 100.0);
        assert_eq!(meter.per_s(1_050, at(500)), 0.0);
        assert_eq!(meter.per_s(0, at(1_500)), 0.0);
    }

    #[test]
    fn drops_are_named_in_a_status() {
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
