//! What a process leaves to the next one, so that other participants take both for the same.

use super::hash::fnv1a;
use super::sample::Guid;
use super::time::MonotonicNs;

/// The identity of the DDS participant of a process, on a board.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct ProcessIdentity {
    /// The participant; all zero if the next process cannot continue it.
    pub participant: Guid,
    /// Its participant id, which gives its ports (RTPS 2.5, clause 9.6.2.3).
    pub participant_id: u64,
    /// The UDP port of its urgent topics; 0 without them.
    pub urgent_port: u64,
    /// The counts of HEARTBEATs and ACKNACKs that the next process exceeds.
    pub highest_count: u64,
    /// The sequence numbers of built-in writers that the next process exceeds.
    pub highest_number: u64,
    /// A hash of what must be the same for the next process: domain, interfaces, addresses.
    pub conditions: u64,
    /// How many processes, up to this one, have taken it over and not run for long: after several the next
    /// one does not, in case that is the reason why they ended.
    pub unproven: u64,
    /// When the process wrote this.
    pub alive_at: MonotonicNs,
    /// The `checksum` of the rest.
    pub checksum: u64,
}

/// The identity of a DDS writer of a lane or a DDS reader of ingress, on a board. The highest sequence number
/// of a writer is a word beside it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct EndpointIdentity {
    /// How many endpoints there have been in its place, including this one; 0 for none.
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

checked!(ProcessIdentity: 9);
checked!(EndpointIdentity: 2);

impl ProcessIdentity {
    fn words(&self) -> [u64; 9] {
        let guid = u128::from_le_bytes(self.participant.0);
        [
            guid as u64,
            (guid >> 64) as u64,
            self.participant_id,
            self.urgent_port,
            self.highest_count,
            self.highest_number,
            self.conditions,
            self.unproven,
            self.alive_at.0,
        ]
    }
}

impl EndpointIdentity {
    const fn words(&self) -> [u64; 2] {
        [self.count, self.offer]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_record_that_was_changed_or_never_written_is_not_intact() {
        assert!(!ProcessIdentity::default().is_intact());
        assert!(!EndpointIdentity::default().is_intact());
        let process =
            ProcessIdentity { participant: Guid([7; 16]), participant_id: 3, ..ProcessIdentity::default() };
        let process = process.sealed();
        assert!(process.is_intact());
        let changes: [fn(&mut ProcessIdentity); 10] = [
            |process| process.participant.0[0] ^= 1,
            |process| process.participant.0[15] ^= 1,
            |process| process.participant_id += 1,
            |process| process.urgent_port += 1,
            |process| process.highest_count += 1,
            |process| process.highest_number += 1,
            |process| process.conditions += 1,
            |process| process.unproven = 1,
            |process| process.alive_at = MonotonicNs(1),
            |process| process.checksum ^= 1,
        ];
        for change in changes {
            let mut changed = process;
            change(&mut changed);
            assert!(!changed.is_intact(), "{changed:?}");
        }
        let endpoint = EndpointIdentity { count: 1, offer: 2, ..EndpointIdentity::default() }.sealed();
        assert!(endpoint.is_intact());
        assert!(!EndpointIdentity { count: 2, ..endpoint }.is_intact());
        assert!(!EndpointIdentity { offer: 3, ..endpoint }.is_intact());
    }
}
