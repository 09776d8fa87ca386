//! Limits the rate of log lines, because a peer can provoke some of them at its own rate: by joining and
//! leaving, by a wrong QoS or type, by malformed messages.

use std::collections::HashMap;
use std::sync::{LazyLock, Mutex, MutexGuard, TryLockError};

use tracing::callsite::Identifier;
use tracing::{Event, Level, Subscriber, warn};
use tracing_subscriber::Layer;
use tracing_subscriber::layer::Context;

use crate::clock;
use crate::model::MonotonicNs;
use crate::policy::TokenBucket;

/// Lines per second of one place in the source, after the first [`BURST_LINES`]. All lines of libraries that
/// use the `log` crate count as one place for each level.
const LINES_PER_S: f64 = 5.0;
/// A burst: more than the lines of a start with a hundred endpoints.
const BURST_LINES: f64 = 200.0;

/// Interval at which the lines that were left out are reported.
const REPORT_MS: u64 = 1_000;

/// The places in the source that have logged, and what each may still log.
static PLACES: LazyLock<Mutex<Places>> = LazyLock::new(Mutex::default);

#[derive(Default)]
struct Places {
    by_callsite: HashMap<Identifier, Place>,
    /// When the lines that were left out were reported last.
    reported_at: MonotonicNs,
}

struct Place {
    bucket: TokenBucket,
    /// The name of the call site, such as `event src/process/egress/output.rs:380`.
    name: &'static str,
    left_out: u64,
}

/// A layer that drops the lines beyond the limit, for all layers. Debug and trace lines are not limited: an
/// operator has asked for them.
pub(super) struct LogLimit;

impl<S: Subscriber> Layer<S> for LogLimit {
    fn event_enabled(&self, event: &Event<'_>, _: Context<'_, S>) -> bool {
        let metadata = event.metadata();
        if *metadata.level() > Level::INFO {
            return true;
        }
        // A thread that finds the lock taken logs its line, rather than wait.
        let Some(mut places) = try_lock() else { return true };
        admit(&mut places, metadata.callsite(), metadata.name(), clock::monotonic())
    }
}

fn admit(places: &mut Places, callsite: Identifier, name: &'static str, now: MonotonicNs) -> bool {
    let place = places.by_callsite.entry(callsite).or_insert_with(|| Place {
        bucket: TokenBucket::full(LINES_PER_S, BURST_LINES, now),
        name,
        left_out: 0,
    });
    let admitted = place.bucket.try_take(now);
    place.left_out += u64::from(!admitted);
    admitted
}

/// Logs, at most once a second and for each place, how many lines were left out since the last time. To be
/// called at each housekeeping.
pub fn log_left_out(now: MonotonicNs) {
    let Some(mut places) = try_lock() else { return };
    if now < places.reported_at.plus_ms(REPORT_MS) {
        return;
    }
    places.reported_at = now;
    let left_out: Vec<_> = places
        .by_callsite
        .values_mut()
        .filter(|place| place.left_out > 0)
        .map(|place| (place.name, std::mem::take(&mut place.left_out)))
        .collect();
    // The lines below lock it again.
    drop(places);
    for (place, lines) in left_out {
        warn!(place, lines, "log lines left out: more than {LINES_PER_S} per second");
    }
}

fn try_lock() -> Option<MutexGuard<'static, Places>> {
    match PLACES.try_lock() {
        Ok(places) => Some(places),
        Err(TryLockError::Poisoned(poisoned)) => Some(poisoned.into_inner()),
        Err(TryLockError::WouldBlock) => None,
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicU64, Ordering};

    use tracing::info;
    use tracing_subscriber::layer::SubscriberExt;

    use super::*;

    static LINES: AtomicU64 = AtomicU64::new(0);

    struct Count;

    impl<S: Subscriber> Layer<S> for Count {
        fn on_event(&self, _: &Event<'_>, _: Context<'_, S>) {
            LINES.fetch_add(1, Ordering::Relaxed);
        }
    }

    #[test]
    fn lines_beyond_the_limit_are_left_out_and_counted() {
        let subscriber = tracing_subscriber::registry().with(LogLimit).with(Count);
        tracing::subscriber::with_default(subscriber, || {
            for line in 0..10_000 {
                info!(line, "a peer joined");
            }
            let logged = LINES.load(Ordering::Relaxed);
            assert!((BURST_LINES as u64..BURST_LINES as u64 + 100).contains(&logged), "{logged}");
            info!("another place");
            assert_eq!(LINES.load(Ordering::Relaxed), logged + 1);
            let later = clock::monotonic().plus_ms(REPORT_MS);
            log_left_out(later);
            assert_eq!(LINES.load(Ordering::Relaxed), logged + 2, "one line for the place");
            log_left_out(later.plus_ms(REPORT_MS));
            assert_eq!(LINES.load(Ordering::Relaxed), logged + 2, "reported once");
        });
    }
}
