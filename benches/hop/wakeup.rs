//! The wake-up reference: the time to wake a thread on the other CPU through an eventfd.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use nix::sys::eventfd::{EfdFlags, EventFd};

use super::options::{Case, Options};
use super::system::{self, Place, Scheduling};
use adaptive_bridge::clock;

/// Measures as many wake-ups as the case has samples, at its rate. Returns their latencies in nanoseconds,
/// from before the write to after the read.
pub fn eventfd(case: &Case, options: &Options, scheduling: Scheduling) -> Result<Vec<u64>, String> {
    let event = EventFd::from_flags(EfdFlags::EFD_SEMAPHORE).map_err(|error| format!("eventfd: {error}"))?;
    let event = Arc::new(event);
    let (samples, rate_hz) = (case.samples, case.rate_hz);
    // The write time of each wake-up: a late sleeper finds several pending.
    let written_at: Arc<[AtomicU64]> = (0..samples).map(|_| AtomicU64::new(0)).collect();
    let sleeper = {
        let (event, written_at) = (Arc::clone(&event), Arc::clone(&written_at));
        let place = Place::of(options.placement, scheduling, 1);
        std::thread::spawn(move || {
            place.apply();
            let mut latencies = Vec::with_capacity(samples);
            for written_at in &written_at[..] {
                if event.read().is_err() {
                    break;
                }
                let now = clock::monotonic().0;
                latencies.push(now.saturating_sub(written_at.load(Ordering::Acquire)));
            }
            latencies
        })
    };
    let place = Place::of(options.placement, scheduling, 0);
    let waker = std::thread::spawn(move || {
        place.apply();
        let start = clock::monotonic().0 + 10_000_000;
        for (sample, written_at) in written_at.iter().enumerate() {
            system::sleep_until(start + sample as u64 * 1_000_000_000 / rate_hz);
            written_at.store(clock::monotonic().0, Ordering::Release);
            if event.write(1).is_err() {
                break;
            }
        }
    });
    waker.join().map_err(|_| "the waking thread panicked".to_owned())?;
    sleeper.join().map_err(|_| "the sleeping thread panicked".to_owned())
}
