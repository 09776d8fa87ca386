//! What a lane's process leaves to the next one, so that subscribers take both for the same.

use super::hash::fnv1a;
use super::sample::Guid;

/// The identity of the DDS participant of a lane's process, on a board.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct LaneIdentity {
    /// The participant; all zero if the next process cannot continue it.
    pub participant: Guid,
    /// Its participant id, which gives its ports (RTPS 2.5, clause 9.6.2.3).
    pub participant_id: u64,
    /// The counts of HEARTBEATs and ACKNACKs that the next process exceeds.
    pub highest_count: u64,
    /// The sequence numbers of built-in writers that the next process exceeds.
    pub highest_number: u64,
    /// A hash of what must be the same for the next process: domain, interfaces, addresses.
    pub conditions: u64,
    /// 1 while the process that took it over has not run for long: the next one does not, in case that was
    /// the reason why this one ended.
    pub unproven: u64,
    /// The `checksum` of the rest.
    pub checksum: u64,
}

/// The identity of the DDS writer of one output, on a board. Its highest sequence number is a word beside it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct WriterIdentity {
    /// How many writers the output has had under this participant, including this one; 0 for no writer.
    pub count: u64,
    /// A hash of participant, topic, type and QoS.
    pub offer: u64,
    /// The `checksum` of the rest.
    pub checksum: u64,
}

/// Declares the checksum of a record.
macro_rules! checked {
    ($type:ident: $words:expr) => {
        impl $type {
            /// The record with its checksum.
            #[must_use]
            pub fn sealed(self) -> Self {
                Self { checksum: self.checksum(), ..self }
            }

            /// Whether a process has written this record, and nothing else has changed it.
            pub fn is_intact(&self) -> bool {
                self.checksum == self.checksum()
            }

            fn checksum(&self) -> u64 {
                let words: [u64; $words] = $type::words(self);
                let mut bytes = [0; $words * 8];
                for (place, word) in bytes.chunks_exact_mut(8).zip(words) {
                    place.copy_from_slice(&word.to_le_bytes());
                }
                fnv1a(&bytes)
            }
        }
    };
}

checked!(LaneIdentity: 7);
checked!(WriterIdentity: 2);

impl LaneIdentity {
    fn words(&self) -> [u64; 7] {
        let guid = u128::from_le_bytes(self.participant.0);
        [
            guid as u64,
            (guid >> 64) as u64,
            self.participant_id,
            self.highest_count,
            self.highest_number,
            self.conditions,
            self.unproven,
        ]
    }
}

impl WriterIdentity {
    const fn words(&self) -> [u64; 2] {
        [self.count, self.offer]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_record_that_was_changed_or_never_written_is_not_intact() {
        assert!(!LaneIdentity::default().is_intact());
        assert!(!WriterIdentity::default().is_intact());
        let lane = LaneIdentity { participant: Guid([7; 16]), participant_id: 3, ..LaneIdentity::default() };
        let lane = lane.sealed();
        assert!(lane.is_intact());
        let changes: [fn(&mut LaneIdentity); 8] = [
            |lane| lane.participant.0[0] ^= 1,
            |lane| lane.participant.0[15] ^= 1,
            |lane| lane.participant_id += 1,
            |lane| lane.highest_count += 1,
            |lane| lane.highest_number += 1,
            |lane| lane.conditions += 1,
            |lane| lane.unproven = 1,
            |lane| lane.checksum ^= 1,
        ];
        for change in changes {
            let mut changed = lane;
            change(&mut changed);
            assert!(!changed.is_intact(), "{changed:?}");
        }
        let writer = WriterIdentity { count: 1, offer: 2, ..WriterIdentity::default() }.sealed();
        assert!(writer.is_intact());
        assert!(!WriterIdentity { count: 2, ..writer }.is_intact());
        assert!(!WriterIdentity { offer: 3, ..writer }.is_intact());
    }
}
