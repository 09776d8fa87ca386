//! Keeps a publisher from writing more than a busy machine can carry: a test of what the bridge does to its
//! subscribers otherwise fails for what other programs on the machine do to all of them.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use super::peer::RunningPeer;

/// How often a publisher and its subscribers are compared. Peers report their progress every 100 ms.
const PERIOD: Duration = Duration::from_millis(100);
/// A smaller share of idle CPU time means that the machine is busy.
const BUSY_IDLE_SHARE: f64 = 0.1;
/// The longest stop. A stopped publisher announces nothing, and the lease of Cyclone DDS is 10 s.
const LONGEST: Duration = Duration::from_secs(5);

/// The CPU time of the machine since its start, in ticks: idle, and all.
fn cpu_ticks() -> [f64; 2] {
    let stat = std::fs::read_to_string("/proc/stat").unwrap();
    // user, nice, system, idle, iowait, irq, softirq, steal
    let ticks = stat.lines().next().unwrap().split_whitespace().skip(1).take(8);
    let ticks: Vec<f64> = ticks.map(|ticks| ticks.parse().unwrap()).collect();
    [ticks[3] + ticks[4], ticks.iter().sum()]
}

/// Runs `work` and stops `publisher` (SIGSTOP) meanwhile whenever a subscriber that keeps up lacks more than
/// `samples` of what it wrote and the CPUs were idle for less than a tenth of the last 100 ms, until that
/// subscriber has all but a quarter of them, or for 5 s.
///
/// With idle CPUs a subscriber lacks samples because of the bridge. The publisher then goes on, so that the
/// test finds what is lost.
pub fn paced<'a, T>(
    publisher: &RunningPeer,
    subscribers: impl IntoIterator<Item = &'a RunningPeer>,
    samples: u64,
    work: impl FnOnce() -> T,
) -> T {
    let subscribers: Vec<&RunningPeer> = subscribers.into_iter().collect();
    let ended = AtomicBool::new(false);
    let lag = || {
        let written = publisher.written();
        subscribers.iter().map(|subscriber| written.saturating_sub(subscriber.received())).max().unwrap_or(0)
    };
    std::thread::scope(|scope| {
        let pacer = scope.spawn(|| {
            let (mut stops, mut stopped) = (0, Duration::ZERO);
            let mut before = cpu_ticks();
            while !ended.load(Ordering::Relaxed) {
                std::thread::sleep(PERIOD);
                let now = cpu_ticks();
                let [idle, all] = [now[0] - before[0], now[1] - before[1]];
                before = now;
                if idle > BUSY_IDLE_SHARE * all || lag() <= samples {
                    continue;
                }
                let since = Instant::now();
                publisher.stop();
                while lag() > samples / 4 && since.elapsed() < LONGEST && !ended.load(Ordering::Relaxed) {
                    std::thread::sleep(PERIOD);
                }
                publisher.cont();
                stops += 1;
                stopped += since.elapsed();
            }
            if stops > 0 {
                println!("a busy machine: the publisher was stopped {stops} times, {stopped:.1?} in all");
            }
        });
        // Ends the thread also if `work` panics, for which the scope would wait.
        struct End<'a>(&'a AtomicBool);
        impl Drop for End<'_> {
            fn drop(&mut self) {
                self.0.store(true, Ordering::Relaxed);
            }
        }
        let end = End(&ended);
        let result = work();
        drop(end);
        pacer.join().unwrap();
        result
    })
}
