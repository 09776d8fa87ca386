//! Which readers an output has.

use tracing::{info, warn};

use super::super::overrun::log_left;
use super::Output;
use crate::dds::WriterEvent;
use crate::model::{Guid, MAX_UNMATCHED_READERS, MonotonicNs, UnmatchedReader};

impl Output {
    /// Forgets the readers without a match for which `is_gone` holds.
    pub fn forget_unmatched(&mut self, is_gone: impl Fn(Guid) -> bool) {
        self.unmatched.retain(|(reader, _)| !is_gone(*reader));
    }

    pub(super) fn follow_matching(&mut self, now: MonotonicNs) {
        let Some(writer) = &mut self.writer else {
            return;
        };
        while let Some(event) = writer.poll_event() {
            match event {
                WriterEvent::Matched { reader, joined, readers, missed } => {
                    self.counters.update(|counters| counters.readers = readers);
                    if joined {
                        self.former_readers.matched(reader);
                        self.unmatched.retain(|(unmatched, _)| *unmatched != reader);
                    }
                    info!(route = self.id, lane = self.lane, ?reader, joined, readers, "readers changed");
                    log_left(&self.id, &self.lane, self.class, reader, missed);
                    let history = self.history.as_mut();
                    if let Some(late_joiners) = history.and_then(|it| it.late_joiners.as_mut()) {
                        if !joined {
                            late_joiners.left(reader);
                        } else if !late_joiners.joined(reader, now) {
                            self.counters.update(|counters| counters.late_joiners_unserved += 1);
                            warn!(
                                route = self.id,
                                lane = self.lane,
                                ?reader,
                                "too many late joiners wait for the history; this one gets only new samples"
                            );
                        }
                    }
                }
                WriterEvent::Incompatible { reader, policy } => {
                    // The DDS library repeats the event with each announcement of the reader.
                    if self.unmatched.contains(&(reader, policy)) {
                        continue;
                    }
                    self.unmatched.retain(|(unmatched, _)| *unmatched != reader);
                    if self.unmatched.len() < MAX_UNMATCHED_READERS {
                        self.unmatched.push((reader, policy));
                    }
                    warn!(
                        route = self.id,
                        lane = self.lane,
                        topic = self.topic.dds_topic,
                        ?reader,
                        %policy,
                        "a reader requests a stricter QoS than this lane offers and receives nothing: change \
                         its QoS or the lane's"
                    );
                }
            }
        }
    }

    /// Writes the matched readers to their board, as many as it has room for, and counts the overruns of all.
    pub fn record_readers(&mut self, now: MonotonicNs) {
        self.former_readers.expire(now);
        let Some(writer) = &self.writer else {
            return;
        };
        let mut current = self.former_readers.on_board(self.counters.get().forwarded);
        for (place, reader) in current.records.iter_mut().zip(writer.matched_readers()) {
            *place = reader;
        }
        for (place, (reader, policy)) in current.unmatched.iter_mut().zip(&self.unmatched) {
            *place = UnmatchedReader { reader: *reader, policy: *policy as u64 };
        }
        self.readers.set(current);
        self.overrun.count(writer, &mut self.counters);
    }
}
