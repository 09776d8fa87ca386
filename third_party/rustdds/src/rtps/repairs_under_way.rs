//! The repairs that one reader has been sent and has not acknowledged yet.
//!
//! A reader requests what it lacks with each ACKNACK, also while the repair is under
//! way: behind 100 ms of delay ten repair rounds sent the same samples ten times, and
//! the others had to wait. RTPS v2.5 Section 8.4.7.1.1 lets a Writer ignore requests
//! that come too soon after what they request was sent (nackSuppressionDuration). How
//! soon that is depends on the way to the reader, so it is measured.

use std::{
  collections::BTreeMap,
  time::{Duration, Instant},
};

use crate::{
  messages::submessages::submessages::AckNack,
  rtps::constant::{
    MAX_REPAIRS_UNDER_WAY, NACK_SUPPRESSION_INITIAL, NACK_SUPPRESSION_MAX, NACK_SUPPRESSION_MIN,
  },
  structure::sequence_number::SequenceNumber,
};

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Repair {
  sent_at: Instant,
  is_repeated: bool,
}

#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct RepairsUnderWay {
  repairs: BTreeMap<SequenceNumber, Repair>,
  // From a repair to the ACKNACK that no longer requests it, smoothed.
  round_trip: Option<Duration>,
  // How long a request for the same sample is ignored.
  suppression: Duration,
  lengthened_at: Option<Instant>,
}

impl Default for RepairsUnderWay {
  fn default() -> Self {
    Self {
      repairs: BTreeMap::new(),
      round_trip: None,
      suppression: NACK_SUPPRESSION_INITIAL,
      lengthened_at: None,
    }
  }
}

impl RepairsUnderWay {
  /// Whether a request for the sample came too soon after its repair was sent.
  pub fn is_under_way(&self, sn: SequenceNumber, now: Instant) -> bool {
    self
      .repairs
      .get(&sn)
      .is_some_and(|repair| now.saturating_duration_since(repair.sent_at) < self.suppression)
  }

  /// The sample was sent once more.
  pub fn sent(&mut self, sn: SequenceNumber, now: Instant) {
    let is_repeated = self.repairs.contains_key(&sn);
    // The repair was lost, or the way is longer than it was. Once for all samples of
    // the same rounds.
    let is_due = self
      .lengthened_at
      .is_none_or(|at| now.saturating_duration_since(at) >= self.suppression);
    if is_repeated && is_due {
      self.suppression = (self.suppression * 2).min(NACK_SUPPRESSION_MAX);
      self.lengthened_at = Some(now);
    }
    self.repairs.insert(
      sn,
      Repair {
        sent_at: now,
        is_repeated,
      },
    );
    while self.repairs.len() > MAX_REPAIRS_UNDER_WAY {
      self.repairs.pop_first();
    }
  }

  /// Takes what the ACKNACK says of repairs.
  pub fn acknowledged(&mut self, ack_nack: &AckNack, now: Instant) {
    let base = ack_nack.reader_sn_state.base();
    while let Some(entry) = self.repairs.first_entry() {
      if *entry.key() >= base {
        break;
      }
      let repair = entry.remove();
      // Which of two copies arrived is not known (Karn's algorithm).
      if !repair.is_repeated {
        let measured = now.saturating_duration_since(repair.sent_at);
        let smoothed = self
          .round_trip
          .map_or(measured, |former| (former * 7 + measured) / 8);
        self.round_trip = Some(smoothed);
        self.suppression = (smoothed * 3 / 2).clamp(NACK_SUPPRESSION_MIN, NACK_SUPPRESSION_MAX);
      }
    }
  }
}

#[cfg(test)]
mod tests {
  use super::*;
  use crate::structure::{guid::EntityId, sequence_number::SequenceNumberSet};

  fn acknowledged_before(base: i64) -> AckNack {
    AckNack {
      reader_id: EntityId::UNKNOWN,
      writer_id: EntityId::UNKNOWN,
      reader_sn_state: SequenceNumberSet::new_empty(SequenceNumber::new(base)),
      count: 1,
    }
  }

  // Samples are sent again as soon as they could have been acknowledged, which is soon
  // for a reader that is near and late for one that is far.
  #[test]
  fn suppression_follows_the_way_to_the_reader() {
    let began = Instant::now();
    for (round_trip_ms, expected_ms) in [(1, 10), (40, 60), (200, 300), (10_000, 500)] {
      let mut repairs = RepairsUnderWay::default();
      let sn = SequenceNumber::new;
      for number in 1..=50 {
        repairs.sent(sn(number), began);
      }
      let arrived = began + Duration::from_millis(round_trip_ms);
      repairs.acknowledged(&acknowledged_before(50), arrived);
      assert!(!repairs.is_under_way(sn(49), arrived), "it has arrived");
      let just_before = began + Duration::from_millis(expected_ms - 1);
      let then = began + Duration::from_millis(expected_ms);
      assert!(repairs.is_under_way(sn(50), just_before), "{round_trip_ms} ms");
      assert!(!repairs.is_under_way(sn(50), then), "{round_trip_ms} ms");
    }
  }

  // A way that became longer makes each repair look lost; the next ones are awaited
  // for longer, until one that was sent once is acknowledged.
  #[test]
  fn a_way_that_became_longer_is_measured_anew() {
    let mut now = Instant::now();
    let mut repairs = RepairsUnderWay::default();
    repairs.sent(SequenceNumber::new(1), now);
    repairs.acknowledged(&acknowledged_before(2), now);
    assert_eq!(repairs.suppression, NACK_SUPPRESSION_MIN);
    for _ in 0..3 {
      for number in 2..=21 {
        repairs.sent(SequenceNumber::new(number), now);
      }
      now += Duration::from_millis(100);
    }
    assert_eq!(repairs.suppression, NACK_SUPPRESSION_MIN * 4);
    repairs.acknowledged(&acknowledged_before(22), now);
    assert_eq!(repairs.suppression, NACK_SUPPRESSION_MIN * 4);
  }

  #[test]
  fn what_is_never_acknowledged_is_bounded() {
    let now = Instant::now();
    let mut repairs = RepairsUnderWay::default();
    (1..=100_000).for_each(|number| repairs.sent(SequenceNumber::new(number), now));
    assert_eq!(repairs.repairs.len(), MAX_REPAIRS_UNDER_WAY);
  }
}
