//! The history of a TRANSIENT_LOCAL output: the last `depth` samples of each publisher, for late joiners.
//!
//! A publisher's samples stay in the history when it ends, because `ros2 topic pub --once` ends at once. They
//! leave it first when there are more publishers than it has room for.

use bytes::Bytes;
use tracing::warn;

use super::late_joiners::{self, KeptSample, LateJoiners, SAMPLES_PER_TURN};
use crate::dds::RawWriter;
use crate::model::{Guid, MAX_PUBLISHERS, MonotonicNs, PublisherAccount, SampleHeader};
use crate::shm::Boards;

/// Shortest interval between two log lines of an output about a full history.
const LOG_MS: u64 = 30_000;

/// The history of one output. That of a RELIABLE writer is in the DDS library, and this bounds it.
pub(super) struct History {
    publishers: Publishers,
    /// The history of a BEST_EFFORT writer, which the DDS library does not send to late joiners.
    pub late_joiners: Option<LateJoiners>,
    /// Publishers whose samples were evicted.
    evicted_publishers: u64,
    /// What was logged last: the evicted publishers and samples.
    logged: (u64, u64),
    log_at: MonotonicNs,
}

impl History {
    pub fn new(late_joiners: Option<LateJoiners>) -> Self {
        Self {
            publishers: Publishers::default(),
            late_joiners,
            evicted_publishers: 0,
            logged: (0, 0),
            log_at: MonotonicNs(0),
        }
    }

    /// The sample, if this history keeps it and not the DDS library.
    pub fn kept(&self, payload: &Bytes, header: &SampleHeader) -> Option<KeptSample> {
        self.late_joiners.as_ref().map(|_| KeptSample::of(payload.clone(), header))
    }

    /// Adds a sample that was written. If it is of one publisher too many, the history loses the samples of
    /// another: of one that is not `present`, else of the one that wrote longest ago.
    pub fn add(
        &mut self,
        publisher: Guid,
        kept: Option<KeptSample>,
        writer: Option<&RawWriter>,
        present: impl FnOnce() -> Vec<Guid>,
    ) {
        if let (Some(late_joiners), Some(kept)) = (&mut self.late_joiners, kept) {
            late_joiners.keep(kept);
        }
        if let Some(evicted) = self.publishers.wrote(publisher, present) {
            self.evicted_publishers += 1;
            if let Some(late_joiners) = &mut self.late_joiners {
                late_joiners.forget(evicted);
            }
            if let Some(writer) = writer {
                writer.forget_history_of(evicted);
            }
        }
    }

    /// Sends the history to the late joiners that are due, and logs what it has lost.
    pub fn serve(&mut self, writer: &RawWriter, route: &str, lane: &str, now: MonotonicNs) {
        if let Some(late_joiners) = &mut self.late_joiners {
            let mut left = SAMPLES_PER_TURN;
            while let Some((reader, history)) = late_joiners.next_due(now, &mut left) {
                for kept in history {
                    let payload = kept.payload.clone();
                    let written =
                        writer.write_to(reader, payload, kept.encapsulation, kept.timestamp, kept.key);
                    if let Err(failure) = written {
                        warn!(route, lane, ?reader, %failure, "cannot send the history to a late joiner");
                    }
                }
            }
        }
        let evicted_samples =
            self.late_joiners.as_ref().map_or_else(|| writer.history_evicted(), LateJoiners::evicted);
        let evicted = (self.evicted_publishers, evicted_samples);
        if evicted != self.logged && now >= self.log_at {
            warn!(
                route,
                lane,
                evicted_publishers = evicted.0,
                evicted_samples = evicted.1,
                most_publishers = MAX_PUBLISHERS,
                most_bytes = late_joiners::MAX_BYTES,
                "the history for late joiners is full"
            );
            self.logged = evicted;
            self.log_at = now.plus_ms(LOG_MS);
        }
    }
}

/// The publishers whose samples a history has.
#[derive(Debug, Default)]
struct Publishers {
    /// The one that wrote last is at the end.
    known: Vec<Guid>,
}

impl Publishers {
    /// Records that a publisher wrote, and returns the one that it replaces, if there is no room for both.
    fn wrote(&mut self, publisher: Guid, present: impl FnOnce() -> Vec<Guid>) -> Option<Guid> {
        if self.known.last() == Some(&publisher) {
            return None;
        }
        if let Some(place) = self.known.iter().position(|known| *known == publisher) {
            self.known[place..].rotate_left(1);
            return None;
        }
        let evicted = (self.known.len() >= MAX_PUBLISHERS).then(|| {
            let present = present();
            let gone = self.known.iter().position(|known| !present.contains(known));
            self.known.remove(gone.unwrap_or(0))
        });
        self.known.push(publisher);
        evicted
    }
}

/// The publishers of a route that ingress knows to be there.
pub(super) fn present_publishers(boards: &Boards, route: usize) -> Vec<Guid> {
    let accounts = (0..MAX_PUBLISHERS).filter_map(|place| boards.publisher(route, place));
    let is_present =
        |account: &PublisherAccount| account.offered_reliability != PublisherAccount::OFFER_UNKNOWN;
    accounts.filter(is_present).map(|account| account.writer).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn publisher(number: usize) -> Guid {
        Guid((number as u128 + 1).to_be_bytes())
    }

    #[test]
    fn publishers_that_are_gone_give_way_first_and_then_the_one_that_wrote_longest_ago() {
        let mut publishers = Publishers::default();
        let all = || (0..1_000).map(publisher).collect::<Vec<_>>();
        for number in 0..MAX_PUBLISHERS {
            assert_eq!(publishers.wrote(publisher(number), all), None);
        }
        assert_eq!(publishers.wrote(publisher(0), all), None, "it is known");
        let but_seven = || all().into_iter().filter(|known| *known != publisher(7)).collect();
        assert_eq!(publishers.wrote(publisher(100), but_seven), Some(publisher(7)));
        assert_eq!(publishers.wrote(publisher(101), all), Some(publisher(1)));
        assert_eq!(publishers.wrote(publisher(0), all), None, "it wrote again after the others");
        assert_eq!(publishers.known.len(), MAX_PUBLISHERS);
    }
}
