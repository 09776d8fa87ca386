//! Memory for copies of small payloads that are handed to the DDS writer, without an allocation for each.

use std::collections::VecDeque;

use bytes::{Bytes, BytesMut};

/// Size of a chunk. 256 KiB hold some 90 samples of a typical laser scan (2,948 bytes), and allocators serve
/// that size without a system call for each allocation.
const CHUNK_BYTES: usize = 256 * 1024;

/// The most chunks. A single payload that a writer retains keeps a chunk from being reused: a reader that
/// acknowledges nothing of a slow route keeps one chunk for each sample of it.
const MAX_CHUNKS: usize = 128;

/// The memory of all chunks.
pub(super) const MAX_BYTES: usize = MAX_CHUNKS * CHUNK_BYTES;

/// Copies payloads into chunks, and reuses a chunk when the DDS writer has dropped all payloads in it.
#[derive(Debug)]
pub(super) struct CopyArena {
    current: BytesMut,
    /// Full chunks, oldest first; the writer may still hold payloads in them.
    filled: VecDeque<BytesMut>,
}

impl CopyArena {
    pub fn new() -> Self {
        Self { current: BytesMut::with_capacity(CHUNK_BYTES), filled: VecDeque::with_capacity(MAX_CHUNKS) }
    }

    /// Copies `payload`. It gets an allocation of its own if it is larger than a chunk, or if every chunk is
    /// full and has a payload that is held.
    pub fn copy(&mut self, payload: &[u8]) -> Bytes {
        let is_full = |chunk: &BytesMut| chunk.capacity() - chunk.len() < payload.len();
        if payload.len() > CHUNK_BYTES || (is_full(&self.current) && !self.next_chunk()) {
            return Bytes::copy_from_slice(payload);
        }
        self.current.extend_from_slice(payload);
        self.current.split().freeze()
    }

    /// Continues with a full chunk in which no payload is held, else with a new one. Returns false if there
    /// is neither.
    fn next_chunk(&mut self) -> bool {
        let free = self.filled.iter_mut().position(|chunk| chunk.try_reclaim(CHUNK_BYTES));
        let reused = free.and_then(|place| self.filled.remove(place));
        let may_grow = self.filled.len() + 1 < MAX_CHUNKS;
        let Some(next) = reused.or_else(|| may_grow.then(|| BytesMut::with_capacity(CHUNK_BYTES))) else {
            return false;
        };
        let full = std::mem::replace(&mut self.current, next);
        self.filled.push_back(full);
        true
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn copies_are_equal_and_independent() {
        let mut arena = CopyArena::new();
        let first = arena.copy(b"first");
        let second = arena.copy(b"second");
        assert_eq!((&first[..], &second[..]), (&b"first"[..], &b"second"[..]));
        assert_eq!(arena.copy(&[]), Bytes::new());
        let large = vec![7; CHUNK_BYTES + 1];
        assert_eq!(arena.copy(&large), large);
    }

    #[test]
    fn chunks_are_reused_when_no_payload_in_them_is_held() {
        let mut arena = CopyArena::new();
        let payload = [9; 3_000];
        let mut held = VecDeque::new();
        for _ in 0..100_000 {
            held.push_back(arena.copy(&payload));
            if held.len() > 200 {
                held.pop_front();
            }
        }
        assert!(arena.filled.len() <= 4, "{} chunks for 600 kB in use", arena.filled.len());
        assert!(held.iter().all(|copy| copy[..] == payload));
    }

    #[test]
    fn a_payload_that_is_held_for_ever_costs_one_chunk() {
        let mut arena = CopyArena::new();
        let latched = arena.copy(b"latched");
        for _ in 0..100_000 {
            arena.copy(&[9; 3_000]);
        }
        assert!(arena.filled.len() <= 4, "{} chunks", arena.filled.len());
        assert_eq!(&latched[..], b"latched");
    }

    #[test]
    fn chunks_are_bounded_however_many_payloads_are_held() {
        let mut arena = CopyArena::new();
        let mut held = Vec::new();
        for _ in 0..2 * MAX_CHUNKS {
            held.push(arena.copy(b"held"));
            arena.copy(&[9; CHUNK_BYTES - 8]);
        }
        assert_eq!(arena.filled.len() + 1, MAX_CHUNKS);
        assert!(held.iter().all(|copy| copy[..] == b"held"[..]));
        held.clear();
        arena.copy(&[9; CHUNK_BYTES]);
        assert_eq!(arena.filled.len() + 1, MAX_CHUNKS, "a chunk is reused");
    }
}
