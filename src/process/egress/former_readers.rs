//! The readers that a former process of the lane was matched with.
//!
//! They do not receive what the lane writes until they match again. They stay on the board until then,
//! because the present process may die first: of processes that die within a second, each matches some of
//! them at most, and the next one has to wait for all.

use crate::model::{Guid, MonotonicNs, OutputReaders};

/// After a restart, how long the lane expects the former readers to match again. A live one matches within
/// 1 to 3 s (Fast DDS and Cyclone DDS answer a new participant at once); one that has not matched by then
/// counts as gone. Each restart begins a wait of its own, as a process that runs for less than 3 s may not
/// have matched a live one.
const WAIT_MS: u64 = 5_000;

/// After a restart, how long the samples of an output wait for its former readers. Live ones match within
/// 0.3 s on an idle machine; one that died with the lane delays the samples of the others by this time.
const HOLD_MS: u64 = 1_000;

/// The former readers of one output that are not matched again yet.
#[derive(Debug, Default)]
pub(super) struct FormerReaders {
    missing: Vec<Guid>,
    /// Whether there may be others, for which the board had no room.
    more: bool,
    wait_ends_at: MonotonicNs,
    hold_ends_at: MonotonicNs,
}

impl FormerReaders {
    /// The former readers by what the former process left on the board when this one starts, `now`: those
    /// that it was matched with, and those that it was not matched with yet.
    pub fn of(board: &OutputReaders, now: MonotonicNs) -> Self {
        let mut missing: Vec<Guid> = board.iter().map(|record| record.reader).collect();
        // A full table may lack readers.
        let more = board.more_former != 0 || missing.len() == board.records.len();
        for former in board.former() {
            if !missing.contains(&former) {
                missing.push(former);
            }
        }
        Self { missing, more, wait_ends_at: now.plus_ms(WAIT_MS), hold_ends_at: now.plus_ms(HOLD_MS) }
    }

    /// The readers that are missing, as far as they are known.
    pub fn missing(&self) -> &[Guid] {
        &self.missing
    }

    /// Whether none is missing any more.
    pub const fn is_empty(&self) -> bool {
        self.missing.is_empty() && !self.more
    }

    /// Whether samples have to wait for those that are missing. Not for readers that the board had no room
    /// for: no event tells when the last one of them has matched.
    pub fn hold(&self, now: MonotonicNs) -> bool {
        !self.missing.is_empty() && self.may_hold(now)
    }

    /// Whether samples may still have to wait.
    pub fn may_hold(&self, now: MonotonicNs) -> bool {
        now < self.hold_ends_at
    }

    /// Removes a reader that has matched.
    pub fn matched(&mut self, reader: Guid) {
        self.missing.retain(|missing| *missing != reader);
    }

    /// Removes all if the wait is over.
    pub fn expire(&mut self, now: MonotonicNs) {
        if now >= self.wait_ends_at {
            self.missing.clear();
            self.more = false;
        }
    }

    /// The board of an output with these former readers and no others, of a lane that has forwarded so many
    /// samples.
    pub fn on_board(&self, forwarded: u64) -> OutputReaders {
        let mut board = OutputReaders { forwarded, ..OutputReaders::default() };
        for (place, missing) in board.former.iter_mut().zip(&self.missing) {
            *place = *missing;
        }
        board.more_former = u64::from(self.more || self.missing.len() > board.former.len());
        board
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::MAX_OUTPUT_READERS;

    fn guid(number: usize) -> Guid {
        Guid([u8::try_from(number).unwrap() + 1; 16])
    }

    /// Matches readers, as a process does that writes its board in its housekeeping.
    fn matched(former: &mut FormerReaders, readers: impl IntoIterator<Item = usize>) -> OutputReaders {
        let readers: Vec<Guid> = readers.into_iter().map(guid).collect();
        readers.iter().for_each(|reader| former.matched(*reader));
        let mut board = former.on_board(0);
        for (record, reader) in board.records.iter_mut().zip(readers) {
            record.reader = reader;
        }
        board
    }

    fn at(ms: u64) -> MonotonicNs {
        MonotonicNs(0).plus_ms(ms)
    }

    fn first() -> FormerReaders {
        FormerReaders::of(&OutputReaders::default(), at(0))
    }

    #[test]
    fn a_process_that_dies_before_all_have_matched_leaves_the_others_to_the_next() {
        let mut process = first();
        assert!(process.is_empty());
        let mut board = matched(&mut process, [0, 1, 2]);
        // The second process matches one of the three, the third dies at its start, and neither has matched
        // the other two.
        process = FormerReaders::of(&board, at(1_000));
        assert!(!process.is_empty());
        board = matched(&mut process, [1]);
        process = FormerReaders::of(&board, at(1_300));
        board = process.on_board(0);
        process = FormerReaders::of(&board, at(1_600));
        for (reader, all) in [(2, false), (1, false), (0, true)] {
            process.matched(guid(reader));
            assert_eq!(process.is_empty(), all, "{process:?}");
        }
        assert_eq!(process.on_board(0), OutputReaders::default());
    }

    #[test]
    fn a_reader_that_matched_a_moment_ago_is_one_former_reader() {
        let mut board = matched(&mut first(), [0, 1]);
        // The table already has a reader whose match the process has not handled.
        board.former[0] = guid(1);
        assert_eq!(FormerReaders::of(&board, at(0)).missing, [guid(0), guid(1)]);
    }

    #[test]
    fn the_wait_for_readers_that_are_gone_ends_5_s_after_the_last_restart() {
        let mut board = matched(&mut first(), [0, 1]);
        for restarted_at in [0, 300, 4_000] {
            board = FormerReaders::of(&board, at(restarted_at)).on_board(0);
        }
        let mut process = FormerReaders::of(&board, at(8_000));
        process.expire(at(12_999));
        assert!(!process.is_empty());
        process.expire(at(13_000));
        assert!(process.is_empty());
        // The next process does not wait for them, only for those that have matched.
        board = matched(&mut process, [1]);
        let mut process = FormerReaders::of(&board, at(14_000));
        process.matched(guid(1));
        assert!(process.is_empty());
    }

    #[test]
    fn samples_wait_for_readers_that_may_match_in_time() {
        let board = matched(&mut first(), [0, 1]);
        let mut process = FormerReaders::of(&board, at(500));
        assert!(process.hold(at(500 + HOLD_MS - 1)) && !process.hold(at(500 + HOLD_MS)));
        process.matched(guid(0));
        assert!(process.hold(at(500)));
        process.matched(guid(1));
        assert!(!process.hold(at(500)) && !first().hold(at(0)));
    }

    #[test]
    fn the_whole_wait_is_for_readers_that_the_board_has_no_room_for() {
        // The next to last reader fits the table, the last one fills it, and there may be more.
        for (readers, known) in [(MAX_OUTPUT_READERS - 1, true), (MAX_OUTPUT_READERS, false)] {
            let board = matched(&mut first(), 0..readers);
            // Over a crash in between, too.
            let board = FormerReaders::of(&board, at(0)).on_board(0);
            let mut process = FormerReaders::of(&board, at(0));
            (0..readers).for_each(|reader| process.matched(guid(reader)));
            assert_eq!(process.is_empty(), known, "{readers} readers");
            process.expire(at(WAIT_MS));
            assert!(process.is_empty());
        }
        // 20 former readers, and 20 that have matched since: 40 for the next.
        let board = matched(&mut first(), 0..20);
        let board = matched(&mut FormerReaders::of(&board, at(0)), 20..40);
        let process = FormerReaders::of(&board, at(0));
        assert_eq!((process.missing.len(), process.more), (40, false));
        let board = process.on_board(0);
        assert_eq!((board.former().count(), board.more_former), (MAX_OUTPUT_READERS, 1));
    }
}
