//! What a signed message may do once only, and a sender only so often.

use std::collections::VecDeque;

use super::token_bucket::{TokenBucket, burst_for};
use crate::model::{MonotonicNs, WallNs};

/// What the guard makes of a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Admission {
    /// Not seen before, and of now.
    Fresh,
    /// Seen before.
    Replayed,
    /// Sent longer ago than the window.
    TooOld,
    /// Sent further ahead than the window: the clocks differ.
    Ahead,
    /// Not older than the window, but than what the guard can remember: it could be a replay.
    Forgotten,
}

/// Admits each message of one sender once, and none that is older than a window.
///
/// Only messages whose signature was verified are to be shown to it, otherwise forged ones would take the
/// places of genuine ones; and each sender needs a guard of its own, for the same reason.
///
/// The memory is fixed. What it forgets, because it is full or because the window has passed, it remembers as
/// an instant before which nothing is admitted any more, so that neither a flood nor a clock that steps back
/// lets a replay in.
#[derive(Clone, Debug)]
pub struct ReplayGuard {
    window_ns: u64,
    capacity: usize,
    /// Ascending.
    seen: VecDeque<(WallNs, [u8; 16])>,
    /// The latest instant of what was forgotten.
    forgotten: Option<WallNs>,
}

impl ReplayGuard {
    /// A guard with room for `capacity` messages, at least 1. The rate of the sender times twice the window
    /// is enough to forget none early.
    pub fn new(window_ms: u64, capacity: usize) -> Self {
        let capacity = capacity.max(1);
        Self {
            window_ns: window_ms.saturating_mul(1_000_000),
            capacity,
            seen: VecDeque::with_capacity(capacity),
            forgotten: None,
        }
    }

    /// Applies a new window. What was forgotten stays so.
    pub const fn set_window(&mut self, window_ms: u64) {
        self.window_ns = window_ms.saturating_mul(1_000_000);
    }

    /// Messages remembered.
    pub fn len(&self) -> usize {
        self.seen.len()
    }

    /// Whether no message is remembered.
    pub fn is_empty(&self) -> bool {
        self.seen.is_empty()
    }

    /// Whether to act on a message that its sender numbered `nonce` and stamped `sent`.
    pub fn admit(&mut self, nonce: [u8; 16], sent: WallNs, now: WallNs) -> Admission {
        while let Some(&(oldest, _)) = self.seen.front()
            && now.since(oldest) > self.window_ns
        {
            self.forget_oldest();
        }
        if now.since(sent) > self.window_ns {
            return Admission::TooOld;
        }
        if sent.since(now) > self.window_ns {
            return Admission::Ahead;
        }
        let place = match self.seen.binary_search(&(sent, nonce)) {
            Ok(_) => return Admission::Replayed,
            Err(place) => place,
        };
        if self.forgotten.is_some_and(|forgotten| sent <= forgotten) {
            return Admission::Forgotten;
        }
        if self.seen.len() < self.capacity {
            self.seen.insert(place, (sent, nonce));
        } else if place == 0 {
            // It would be the first to be forgotten again.
            self.forgotten = Some(sent);
        } else {
            self.forget_oldest();
            self.seen.insert(place - 1, (sent, nonce));
        }
        Admission::Fresh
    }

    fn forget_oldest(&mut self) {
        if let Some((sent, _)) = self.seen.pop_front() {
            self.forgotten = self.forgotten.max(Some(sent));
        }
    }
}

/// A sender that was not heard for so long gives its place to another.
pub const IDLE_SENDER_MS: u64 = 10_000;

/// How many messages of each sender are looked at per second, before anything is computed for them.
///
/// `K` names a sender by something that costs nothing to compare: the GUID of its DDS writer, say, and not an
/// id in the message, which a forger could share with its victim. The table is fixed: senders beyond it share
/// one rate, so that a flood from any number of names costs no more than `capacity + 1` senders would, and a
/// sender that is heard regularly keeps its place.
#[derive(Clone, Debug)]
pub struct SenderLimits<K> {
    rate_hz: f64,
    capacity: usize,
    senders: Vec<Sender<K>>,
    /// For those that have no place.
    others: TokenBucket,
    refused: u64,
}

#[derive(Clone, Debug)]
struct Sender<K> {
    key: K,
    bucket: TokenBucket,
    heard_at: MonotonicNs,
}

impl<K: PartialEq> SenderLimits<K> {
    /// `rate_hz` for each of at most `capacity` senders.
    pub fn new(rate_hz: f64, capacity: usize, now: MonotonicNs) -> Self {
        Self {
            rate_hz,
            capacity,
            senders: Vec::with_capacity(capacity),
            others: TokenBucket::new(rate_hz, burst_for(rate_hz), now),
            refused: 0,
        }
    }

    /// Applies a new rate.
    pub fn set_rate(&mut self, rate_hz: f64, now: MonotonicNs) {
        self.rate_hz = rate_hz;
        let buckets = self.senders.iter_mut().map(|sender| &mut sender.bucket);
        for bucket in buckets.chain([&mut self.others]) {
            bucket.set_rate(rate_hz, burst_for(rate_hz), now);
        }
    }

    /// Whether to look at a message of `key`.
    pub fn allow(&mut self, key: K, now: MonotonicNs) -> bool {
        let allowed = match self.senders.iter().position(|sender| sender.key == key) {
            Some(index) => {
                let sender = &mut self.senders[index];
                sender.heard_at = now;
                sender.bucket.try_take(now)
            }
            None => self.allow_new(key, now),
        };
        self.refused = self.refused.saturating_add(u64::from(!allowed));
        allowed
    }

    /// Messages not looked at so far.
    pub const fn refused(&self) -> u64 {
        self.refused
    }

    /// Senders that have a place.
    pub fn len(&self) -> usize {
        self.senders.len()
    }

    /// Whether no sender has a place.
    pub fn is_empty(&self) -> bool {
        self.senders.is_empty()
    }

    fn allow_new(&mut self, key: K, now: MonotonicNs) -> bool {
        let mut bucket = TokenBucket::new(self.rate_hz, burst_for(self.rate_hz), now);
        let idle_ns = IDLE_SENDER_MS * 1_000_000;
        if self.senders.len() < self.capacity {
            let allowed = bucket.try_take(now);
            self.senders.push(Sender { key, bucket, heard_at: now });
            return allowed;
        }
        match self.senders.iter_mut().find(|sender| now.since(sender.heard_at) > idle_ns) {
            Some(idle) => {
                let allowed = bucket.try_take(now);
                *idle = Sender { key, bucket, heard_at: now };
                allowed
            }
            None => self.others.try_take(now),
        }
    }
}
