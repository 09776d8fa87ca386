//! Memory for copies of small payloads that are handed to the DDS writer, without an allocation for each.

use std::collections::VecDeque;

use bytes::{Bytes, BytesMut};

/// Size of a chunk. 256 KiB hold some 90 samples of a typical laser scan (2,948 bytes), and allocators serve
/// that size without a system call for each allocation.
const CHUNK_BYTES: usize = 256 * 1024;

/// Copies payloads into chunks, and reuses a chunk when the DDS writer has dropped all payloads in it.
#[derive(Debug)]
pub(super) struct CopyArena {
    current: BytesMut,
    /// Full chunks, oldest first; the writer may still hold payloads in them.
    filled: VecDeque<BytesMut>,
}

impl CopyArena {
    pub fn new() -> Self {
        Self { current: BytesMut::with_capacity(CHUNK_BYTES), filled: VecDeque::with_capacity(64) }
    }

    /// Copies `payload`; one that is larger than a chunk gets an allocation of its own.
    pub fn copy(&mut self, payload: &[u8]) -> Bytes {
        if payload.len() > CHUNK_BYTES {
            return Bytes::copy_from_slice(payload);
        }
        if self.current.capacity() - self.current.len() < payload.len() {
            self.next_chunk();
        }
        self.current.extend_from_slice(payload);
        self.current.split().freeze()
    }

    /// Continues with the oldest full chunk if no payload in it is held, else with a new one.
    fn next_chunk(&mut self) {
        let is_free = self.filled.front_mut().is_some_and(|oldest| oldest.try_reclaim(CHUNK_BYTES));
        let reused = if is_free { self.filled.pop_front() } else { None };
        let next = reused.unwrap_or_else(|| BytesMut::with_capacity(CHUNK_BYTES));
        let full = std::mem::replace(&mut self.current, next);
        self.filled.push_back(full);
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
}
