//! Decides when a lane begins to send a large sample of which a part has arrived.

/// The smallest sample of which lanes get a part. Fast DDS sends datagrams of 64 KiB, and the
/// bridge sends the last one only when the sample is complete: with less, there is nothing to gain.
pub const MIN_CUT_THROUGH_BYTES: usize = 128 << 10;

/// The fewest bytes between two wakes of the lanes for a sample: a datagram of Fast DDS.
const MIN_STEP_BYTES: usize = 64 << 10;
/// The most wakes of the lanes for a sample that is not complete.
const MAX_STEPS: usize = 8;

/// The longest time within which the rest of a sample has to be expected. A slower one is sent when it is
/// complete: until then every other sample of its topic would end what was begun, and the part that was sent
/// would be sent twice.
const MAX_REST_NS: u64 = 5_000_000;

/// The bytes after which the lanes are woken again for a sample of `len` bytes.
pub const fn step_bytes(len: usize) -> usize {
    let step = len / MAX_STEPS;
    if step < MIN_STEP_BYTES { MIN_STEP_BYTES } else { step }
}

/// Whether a lane begins to send a sample of `len` bytes, of which `available` arrived in `elapsed_ns`.
pub fn begins_early(len: u64, available: u64, elapsed_ns: u64) -> bool {
    let rest = len.saturating_sub(available);
    // rest / available * elapsed_ns <= MAX_REST_NS, without a division.
    u128::from(rest) * u128::from(elapsed_ns) <= u128::from(available) * u128::from(MAX_REST_NS)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sample_wakes_the_lanes_at_most_eight_times() {
        assert_eq!(step_bytes(MIN_CUT_THROUGH_BYTES), 64 << 10);
        assert_eq!(step_bytes(1 << 20), 128 << 10);
        for len in (MIN_CUT_THROUGH_BYTES..8 << 20).step_by(10_007) {
            assert!(len / step_bytes(len) <= MAX_STEPS);
        }
    }

    #[test]
    fn a_sample_begins_early_if_the_rest_arrives_within_five_milliseconds() {
        let mib = 1 << 20;
        assert!(begins_early(mib, mib / 8, 60_000), "64 KiB in 30 us, as within a host");
        assert!(begins_early(mib, mib / 2, 5_000_000) && !begins_early(mib, mib / 2, 5_000_001));
        assert!(!begins_early(mib, mib / 8, 10_000_000), "100 Mbit/s");
        assert!(begins_early(mib, mib, u64::MAX), "nothing is missing");
        assert!(!begins_early(mib, 0, 1), "nothing has arrived");
        assert!(!begins_early(u64::MAX, 1, u64::MAX));
    }
}
