//! The payload of a sample and its hash, the same as in `tests/peers/common.cpp`.

/// Bytes of sequence, time of sending and source timestamp.
pub const FRONT_BYTES: usize = 24;

/// The sequence number of a priming sample, which does not count.
pub const PRIMING: u64 = u64::MAX;

/// Most zeros by which RTPS lengthens a payload to whole words.
const MAX_PADDING: usize = 3;

/// What a payload contains after its front.
#[derive(Clone, Copy, Debug)]
pub enum Filling {
    /// Pseudorandom bytes of the seed and the sequence.
    Random { seed: u64 },
    /// Zeros, and the sequence in the last word: a few bytes to write and to check, whatever the size.
    Plain,
}

impl Filling {
    fn fill(self, bytes: &mut [u8], sequence: u64) {
        match self {
            Self::Random { seed } => fill(bytes, seed, sequence),
            Self::Plain => {
                if let Some(last) = bytes.last_chunk_mut() {
                    *last = sequence.to_le_bytes();
                }
            }
        }
    }
}

/// The beginning of a payload, as far as its size allows.
#[derive(Clone, Copy, Debug)]
pub struct Front {
    pub sequence: u64,
    /// CLOCK_MONOTONIC.
    pub sent_ns: u64,
    /// CLOCK_REALTIME.
    pub source_ns: u64,
}

/// The word of a payload at that offset; `None` when the payload is too short.
pub fn word(payload: &[u8], at: usize) -> Option<u64> {
    Some(u64::from_le_bytes(payload.get(at..at + 8)?.try_into().ok()?))
}

/// A payload of that size.
pub fn make(front: Front, size: usize, filling: Filling) -> Vec<u8> {
    let mut payload = vec![0; size.max(FRONT_BYTES)];
    for (at, word) in [front.sequence, front.sent_ns, front.source_ns].into_iter().enumerate() {
        payload[at * 8..][..8].copy_from_slice(&word.to_le_bytes());
    }
    payload.truncate(size);
    filling.fill(payload.get_mut(FRONT_BYTES..).unwrap_or_default(), front.sequence);
    payload
}

/// Whether a payload is what was sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    Whole,
    /// Whole, followed by padding of RTPS.
    Padded,
    Bad,
}

/// Compares a payload with the one of its sequence number, of that size if the size is known.
pub fn check(payload: &[u8], size: Option<usize>, filling: Filling, sequence: u64) -> Verdict {
    let padding = size.map(|size| payload.len().checked_sub(size));
    if padding.is_some_and(|padding| padding.is_none_or(|zeros| zeros > MAX_PADDING)) {
        return Verdict::Bad;
    }
    let padding = padding.flatten().unwrap_or(0);
    let end = payload.len() - padding;
    if matches!(filling, Filling::Plain) {
        let last = payload.get(FRONT_BYTES..end).and_then(|rest| rest.last_chunk());
        let is_whole = last.is_none_or(|last| *last == sequence.to_le_bytes());
        return if is_whole { Verdict::Whole } else { Verdict::Bad };
    }
    let mut expected = payload[..payload.len().min(FRONT_BYTES)].to_vec();
    expected.resize(payload.len(), 0);
    filling.fill(expected.get_mut(FRONT_BYTES..end).unwrap_or_default(), sequence);
    if expected == payload {
        return if padding > 0 { Verdict::Padded } else { Verdict::Whole };
    }
    let same = expected.iter().zip(payload).take_while(|(one, other)| one == other).count();
    let rest = &payload[same..];
    if size.is_none() && rest.len() <= MAX_PADDING && rest.iter().all(|byte| *byte == 0) {
        return Verdict::Padded;
    }
    Verdict::Bad
}

/// The hash of header and payload. It counts padding as if it were always present, so that both sides agree
/// whether or not the reader gets it.
pub fn hash(sample: &[u8]) -> u64 {
    let mut hash = 0xcbf2_9ce4_8422_2325 ^ (sample.len() as u64).div_ceil(4);
    for part in sample.chunks(8) {
        let mut word = [0; 8];
        word[..part.len()].copy_from_slice(part);
        hash = (hash ^ u64::from_le_bytes(word)).wrapping_mul(0x9ddf_ea08_eb38_2d69);
        hash ^= hash >> 32;
    }
    hash
}

/// The pseudorandom bytes of a sequence number.
fn fill(bytes: &mut [u8], seed: u64, sequence: u64) {
    let mut state = scramble(seed.wrapping_mul(0x100_0000_01b3).wrapping_add(sequence));
    for part in bytes.chunks_mut(8) {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        part.copy_from_slice(&state.to_le_bytes()[..part.len()]);
    }
}

/// A state for xorshift, such that neighbouring sequences share nothing (the finalizer of SplitMix64).
fn scramble(value: u64) -> u64 {
    let mut value = value.wrapping_add(0x9e37_79b9_7f4a_7c15);
    value = (value ^ (value >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    value = (value ^ (value >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    (value ^ (value >> 31)) | 1
}
