//! Tells the critical lanes of a route how much of a large sample has arrived, so that they begin to send it
//! while the rest arrives.
//!
//! The board of a route shows one sample at a time. It promises nothing: the lanes send the last fragment of
//! a sample only when ingress has published the sample.

use std::sync::{Mutex, MutexGuard, PoisonError};

use crate::clock;
use crate::dds::{PartialArrival, partial_sample};
use crate::model::{FixedText, MonotonicNs, PartialSample};
use crate::policy::{MIN_CUT_THROUGH_BYTES, step_bytes};
use crate::shm::{BoardWriter, LaneWaker};

/// How long a sample of which no more arrives keeps other samples of the route from the board.
const STALLED_NS: u64 = 5_000_000;

/// The board of a partial sample of one route, and the lanes that follow it.
pub(super) struct ArrivalProgress {
    state: Mutex<State>,
    lanes: Vec<LaneWaker>,
}

struct State {
    board: BoardWriter<PartialSample>,
    updated_at: MonotonicNs,
}

/// The place of one sample on the board, which its slot holds.
#[derive(Debug, Default)]
pub(super) struct SampleProgress {
    /// 0 while the sample is not on the board.
    number: u64,
    began_at: Option<MonotonicNs>,
}

impl ArrivalProgress {
    /// Tells these lanes.
    pub fn new(mut board: BoardWriter<PartialSample>, lanes: Vec<LaneWaker>) -> Self {
        // What a killed former process had begun is never completed.
        if board.get().ended == 0 {
            board.update(|partial| partial.ended = 1);
        }
        let state = State { board, updated_at: MonotonicNs(0) };
        Self { state: Mutex::new(state), lanes }
    }

    /// A part of a sample of `len` bytes, whose payload is at `place`, has arrived.
    pub fn advance(
        &self,
        progress: &mut SampleProgress,
        place: (FixedText, u64),
        len: usize,
        arrival: &PartialArrival,
    ) {
        if len < MIN_CUT_THROUGH_BYTES || self.lanes.is_empty() {
            return;
        }
        let now = clock::monotonic();
        let began_at = *progress.began_at.get_or_insert(now);
        // Only a slot that is dropped on another thread can hold the lock; the next fragment tells the lanes.
        let Ok(mut state) = self.state.try_lock() else { return };
        let current = *state.board.get();
        let is_on_board = progress.number != 0;
        let may = if is_on_board {
            current.number == progress.number && current.ended == 0
        } else {
            current.ended != 0
                || current.taken_number == current.number
                || now.since(state.updated_at) >= STALLED_NS
        };
        let before = if is_on_board { current.available } else { 0 };
        if !may || (arrival.complete_bytes as u64).saturating_sub(before) < step_bytes(len) as u64 {
            return;
        }
        if !is_on_board {
            progress.number = current.number.wrapping_add(1);
        }
        let (pool, pool_offset) = place;
        let partial = PartialSample {
            number: progress.number,
            began_at,
            pool_offset,
            len: len as u64,
            ended: 0,
            taken_number: current.taken_number,
            pool,
            ..partial_sample(arrival)
        };
        state.board.set(partial);
        state.updated_at = now;
        drop(state);
        self.wake();
    }

    /// The sample is complete and is taken: the board is free for another one. To be called before the sample
    /// is published, so that a lane that has the sample sees it.
    pub fn taken(&self, progress: &SampleProgress) {
        self.end(progress, |state| state.board.update(|partial| partial.taken_number = partial.number));
    }

    /// The sample never becomes complete: the lanes give it up.
    pub fn given_up(&self, progress: &SampleProgress) {
        if self.end(progress, |state| state.board.update(|partial| partial.ended = 1)) {
            self.wake();
        }
    }

    /// Ends the progress of a sample, and returns whether it is the one on the board.
    fn end(&self, progress: &SampleProgress, end: impl FnOnce(&mut State)) -> bool {
        if progress.number == 0 {
            return false;
        }
        let mut state = self.lock();
        let is_current = state.board.get().number == progress.number && state.board.get().ended == 0;
        if is_current {
            end(&mut state);
        }
        is_current
    }

    fn wake(&self) {
        self.lanes.iter().for_each(LaneWaker::wake_for_progress);
    }

    #[allow(clippy::disallowed_methods, reason = "held to write one board")]
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
