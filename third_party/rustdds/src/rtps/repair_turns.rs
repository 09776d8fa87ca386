//! Which repair rounds of a participant's Writers run when.
//!
//! A repair round sends one reader what it requested, on the thread that also sends
//! what is written for the first time. What readers request has no bound: one
//! ACKNACK requests 256 samples of any size, and twenty readers that request them
//! again and again would leave no time for anything else. So all rounds together
//! get a share of the thread's time, and take turns in the order in which they were
//! due, so that readers which request much do not keep others waiting for ever.

use std::{
  collections::VecDeque,
  time::{Duration, Instant},
};

use crate::{
  rtps::{
    constant::{REPAIR_TIME_BURST, REPAIR_TIME_DIVISOR},
    writer::TimedEvent,
  },
  structure::guid::EntityId,
};

/// A repair round of one Writer for one reader.
pub(crate) type Round = (EntityId, TimedEvent);

#[derive(Default)]
pub(crate) struct RepairTurns {
  waiting: VecDeque<Round>,
  // Repairs would have used exactly their share of the time by then.
  paid_by: Option<Instant>,
}

impl RepairTurns {
  /// The round is to run as soon as those before it have.
  pub fn due(&mut self, round: Round) {
    self.waiting.push_back(round);
  }

  // The round to run now, if there is one and repairs have not used up their share.
  fn next(&mut self, now: Instant) -> Option<Round> {
    if self.pause(now).is_some() {
      return None;
    }
    self.waiting.pop_front()
  }

  /// Runs the rounds that are due, as far as their share goes. Returns how long those
  /// that are left have to wait.
  pub fn run(&mut self, mut run_round: impl FnMut(Round)) -> Option<Duration> {
    if self.waiting.is_empty() {
      return None;
    }
    let mut now = Instant::now();
    let mut used = thread_cpu_time();
    while let Some(round) = self.next(now) {
      run_round(round);
      now = Instant::now();
      let used_before = std::mem::replace(&mut used, thread_cpu_time());
      self.ran(now, used.saturating_sub(used_before));
    }
    self.wait(now)
  }

  // A round has taken that long.
  fn ran(&mut self, now: Instant, took: Duration) {
    let paid_by = self.paid_by.map_or(now, |paid_by| paid_by.max(now));
    self.paid_by = Some(paid_by + took * REPAIR_TIME_DIVISOR);
  }

  // How long the rounds that wait have to, if any do.
  fn wait(&self, now: Instant) -> Option<Duration> {
    if self.waiting.is_empty() {
      return None;
    }
    Some(self.pause(now).unwrap_or_default())
  }

  fn pause(&self, now: Instant) -> Option<Duration> {
    let burst = REPAIR_TIME_BURST * REPAIR_TIME_DIVISOR;
    let ahead = self.paid_by?.saturating_duration_since(now);
    ahead.checked_sub(burst).filter(|pause| !pause.is_zero())
  }
}

// The CPU time that this thread has used, which is what repairs take from other samples. By the
// wall clock, a process that was stopped for 0.8 s within a round sent no repair for the next
// 3.2 s, and its history did not retain samples of 6 MB for as long.
#[cfg(unix)]
fn thread_cpu_time() -> Duration {
  use nix::time::{clock_gettime, ClockId};
  clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).map_or(Duration::ZERO, Duration::from)
}

#[cfg(not(unix))]
fn thread_cpu_time() -> Duration {
  static BEGAN: std::sync::LazyLock<Instant> = std::sync::LazyLock::new(Instant::now);
  BEGAN.elapsed()
}

#[cfg(test)]
mod tests {
  use super::*;
  use crate::structure::guid::{GuidPrefix, GUID};

  fn round(reader: u8) -> Round {
    let to_reader = GUID::new(GuidPrefix::new(&[reader; 12]), EntityId::UNKNOWN);
    (EntityId::UNKNOWN, TimedEvent::SendRepairData { to_reader })
  }

  // Rounds of 1 ms that are always due get a quarter of the time, each its turn.
  #[test]
  fn rounds_take_turns_and_a_share_of_the_time() {
    let began = Instant::now();
    let took = Duration::from_millis(1);
    let mut now = began;
    let mut turns = RepairTurns::default();
    (0..20).for_each(|reader| turns.due(round(reader)));
    let mut ran = Vec::new();
    while now < began + Duration::from_secs(1) {
      match turns.next(now) {
        Some(round) => {
          now += took;
          turns.ran(now, took);
          ran.push(round);
          turns.due(round);
        }
        None => now += turns.wait(now).unwrap(),
      }
    }
    let expected = 1_000 / REPAIR_TIME_DIVISOR as usize;
    assert!(
      ran.len() >= expected && ran.len() <= expected + 10,
      "{}",
      ran.len()
    );
    for (place, round_run) in ran.iter().enumerate() {
      assert!(*round_run == round((place % 20) as u8));
    }
  }

  // A few small rounds wait for nothing, and nothing is saved up while there are none.
  #[test]
  fn what_is_little_runs_at_once() {
    let mut now = Instant::now();
    let mut turns = RepairTurns::default();
    for _ in 0..3 {
      for _ in 0..10 {
        turns.due(round(1));
        assert!(turns.next(now).is_some());
        now += Duration::from_micros(50);
        turns.ran(now, Duration::from_micros(50));
      }
      now += Duration::from_secs(60);
    }
    turns.ran(now, Duration::from_millis(10));
    turns.due(round(1));
    assert!(turns.next(now).is_none());
    assert!(turns.next(now + turns.wait(now).unwrap()).is_some());
    assert!(turns.wait(now).is_none(), "none waits");
  }

  // The thread sleeps, as it does while the process is stopped.
  #[test]
  fn repairs_do_not_pay_for_time_in_which_the_thread_did_not_run() {
    let mut turns = RepairTurns::default();
    let mut ran = 0;
    for _ in 0..3 {
      turns.due(round(1));
      let wait = turns.run(|_| {
        ran += 1;
        std::thread::sleep(Duration::from_millis(50));
      });
      assert_eq!(wait, None);
    }
    assert_eq!(ran, 3);
    turns.due(round(1));
    turns.due(round(2));
    let wait = turns.run(|_| {
      ran += 1;
      let began = thread_cpu_time();
      while thread_cpu_time() < began + Duration::from_millis(50) {}
    });
    assert!(ran == 4 && wait.is_some(), "{ran}");
  }
}
