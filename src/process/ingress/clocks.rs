//! Compares the clocks of a route's publishers with this computer's.

use tracing::{info, warn};

use crate::model::{AgeBasis, Guid, IngressCounters, MonotonicNs, SourceTimestamp, WallNs};
use crate::policy::ClockOffset;

/// The most publishers of one route whose clocks are compared. A further one replaces the one that has been
/// silent longest.
const PUBLISHERS: usize = 32;

/// How long a silent publisher may still be reported as the one whose clock is off furthest.
const REPORTED_MS: u64 = 60_000;

/// Shortest interval between two log lines of a route about its clocks.
const LOG_MS: u64 = 30_000;

/// The clock offset of each publisher of a route.
pub(super) struct Clocks {
    route: String,
    publishers: Vec<(Guid, ClockOffset)>,
    /// The publisher that was logged last; `None` when all clocks agreed.
    logged: Option<Guid>,
    log_at: MonotonicNs,
}

impl Clocks {
    pub fn new(route: &str) -> Self {
        let publishers = Vec::with_capacity(PUBLISHERS);
        Self { route: route.to_owned(), publishers, logged: None, log_at: MonotonicNs(0) }
    }

    /// Returns the basis of the age of a sample that arrived at `now`. Allocates nothing.
    pub fn observe(
        &mut self,
        writer: Guid,
        source: SourceTimestamp,
        now: MonotonicNs,
        now_wall: WallNs,
    ) -> AgeBasis {
        let Some(source) = source.to_wall() else { return AgeBasis::SOURCE };
        let place = match self.publishers.iter().position(|(known, _)| *known == writer) {
            Some(place) => place,
            None => self.place_for(writer),
        };
        self.publishers[place].1.observe(source, now, now_wall)
    }

    fn place_for(&mut self, writer: Guid) -> usize {
        let new = (writer, ClockOffset::default());
        if self.publishers.len() < PUBLISHERS {
            self.publishers.push(new);
            return self.publishers.len() - 1;
        }
        let silent_longest = self.publishers.iter().enumerate().min_by_key(|(_, (_, clock))| clock.last_at());
        let place = silent_longest.map_or(0, |(place, _)| place);
        self.publishers[place] = new;
        place
    }

    /// Records the publisher whose clock is off furthest in `counters`, and logs a change.
    pub fn housekeeping(&mut self, counters: &mut IngressCounters, now: MonotonicNs) {
        let off = self.publishers.iter().filter_map(|(writer, clock)| {
            let is_recent = clock.last_at().is_some_and(|at| now.since(at) < REPORTED_MS * 1_000_000);
            Some((*writer, clock.offset_ns().filter(|_| is_recent)?))
        });
        let furthest = off.max_by_key(|(_, offset_ns)| offset_ns.unsigned_abs());
        (counters.clock_writer, counters.clock_offset_ns) = furthest.unwrap_or_default();
        let writer = furthest.map(|(writer, _)| writer);
        if writer != self.logged && now >= self.log_at {
            self.logged = writer;
            self.log_at = now.plus_ms(LOG_MS);
            match furthest {
                Some((writer, offset_ns)) => warn!(
                    route = self.route,
                    %writer,
                    offset_s = -(offset_ns as f64) / 1e9,
                    "a publisher's clock disagrees with this computer's: the age of its samples runs from \
                     their arrival; synchronise the clocks (chrony, PTP)"
                ),
                None => info!(route = self.route, "the clocks of all publishers agree with this computer's"),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_publisher_has_its_own_offset_and_their_number_is_bounded() {
        let mut clocks = Clocks::new("scan");
        let at = |ms: u64| (MonotonicNs(0).plus_ms(ms), WallNs(1_763_000_000_000_000_000 + ms * 1_000_000));
        let mut observe = |writer: u8, ms: u64, behind_ms: u64| {
            let (now, wall) = at(ms);
            let source = SourceTimestamp::from_wall(WallNs(wall.0 - behind_ms * 1_000_000));
            clocks.observe(Guid([writer; 16]), source, now, wall)
        };
        for ms in (0..3_000).step_by(50) {
            observe(1, ms, 1);
            observe(2, ms, 5_000);
        }
        assert_eq!(observe(1, 3_000, 1), AgeBasis::SOURCE);
        assert_eq!(observe(2, 3_000, 5_000).late_ns(), Some(0));
        let mut counters = IngressCounters::default();
        clocks.housekeeping(&mut counters, at(3_000).0);
        assert_eq!((counters.clock_writer, counters.clock_offset_ns), (Guid([2; 16]), 5_000_000_000));
        clocks.housekeeping(&mut counters, at(63_001).0);
        assert_eq!((counters.clock_writer, counters.clock_offset_ns), (Guid::default(), 0));
        for writer in 0..=255 {
            let (now, wall) = at(4_000 + u64::from(writer));
            clocks.observe(Guid([writer; 16]), SourceTimestamp::from_wall(wall), now, wall);
        }
        assert_eq!(clocks.publishers.len(), PUBLISHERS);
        assert_eq!(clocks.publishers.capacity(), PUBLISHERS);
    }
}
