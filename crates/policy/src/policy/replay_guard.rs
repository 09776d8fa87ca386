//! Protection of the probe protocol: each signed message is accepted once, and each sender has a rate limit.

use alloc::collections::VecDeque;
use alloc::vec::Vec;

use super::token_bucket::{TokenBucket, burst_for};
use crate::model::{MonotonicNs, WallNs};

/// Whether the guard accepts a message, or why not.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Admission {
    /// Accepted: new, and sent within the window.
    Fresh,
    /// Received before.
    Replayed,
    /// Sent longer ago than the window.
    TooOld,
    /// Sent further in the future than the window: the clocks differ.
    Ahead,
    /// Within the window but not newer than a message that the guard has removed: it could be a replay.
    Forgotten,
}

/// Accepts each message of one sender once, and none that is older than a window.
///
/// The caller passes only messages whose signature it has verified, and uses one guard for each sender:
/// otherwise forged messages, or those of another sender, would displace genuine ones.
///
/// The memory is fixed. When the guard removes a message, because it is full or because the window has
/// passed, it keeps its instant and accepts no message sent at or before it, so that neither a flood nor a
/// clock that steps back permits a replay.
#[derive(Clone, Debug)]
pub struct ReplayGuard {
    window_ns: u64,
    capacity: usize,
    /// The messages remembered, in ascending order.
    seen: VecDeque<(WallNs, [u8; 16])>,
    /// The latest instant of the messages removed.
    forgotten: Option<WallNs>,
}

impl ReplayGuard {
    /// A guard that remembers `capacity` messages, at least 1. The sender's rate times twice the window is
    /// enough to remove none before the window has passed.
    pub fn new(window_ms: u64, capacity: usize) -> Self {
        let capacity = capacity.max(1);
        Self {
            window_ns: window_ms.saturating_mul(1_000_000),
            capacity,
            seen: VecDeque::with_capacity(capacity),
            forgotten: None,
        }
    }

    /// This guard with the memory of a former one, which had another window perhaps.
    pub fn remembering(self, former: Self) -> Self {
        Self { window_ns: self.window_ns, ..former }
    }

    /// Messages remembered.
    pub fn len(&self) -> usize {
        self.seen.len()
    }

    /// Whether no message is remembered.
    pub fn is_empty(&self) -> bool {
        self.seen.is_empty()
    }

    /// Decides whether to accept a message that its sender marked with `nonce` and the instant `sent`.
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
            // It is the oldest, and would be the next one to remove.
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

/// The silence after which a new sender may replace a sender in the table.
pub const IDLE_SENDER_MS: u64 = 10_000;

/// Limits the messages of each sender per second, before they are decoded or verified.
///
/// `K` identifies a sender by something that is cheap to compare and that a forger cannot share with its
/// victim: the GUID of the DDS writer, not an id in the message. The table is fixed: senders beyond it share
/// one rate, so that a flood from any number of senders costs no more than one from `capacity + 1`, and a
/// sender that sends regularly stays in the table.
#[derive(Clone, Debug)]
pub struct SenderLimits<K> {
    rate_hz: f64,
    /// The time whose messages may arrive at once.
    burst_s: f64,
    capacity: usize,
    senders: Vec<Sender<K>>,
    /// Shared by the senders that are not in the table.
    others: TokenBucket,
}

#[derive(Clone, Debug)]
struct Sender<K> {
    key: K,
    bucket: TokenBucket,
    last_request_at: MonotonicNs,
}

impl<K: PartialEq> SenderLimits<K> {
    /// A limit of `rate_hz` for each of at most `capacity` senders.
    pub fn new(rate_hz: f64, capacity: usize, now: MonotonicNs) -> Self {
        Self::with_burst(rate_hz, 0.0, capacity, now)
    }

    /// A limit of `rate_hz` for each sender, of whom the messages of `burst_s` may arrive at once, as after
    /// an outage of a link.
    pub fn with_burst(rate_hz: f64, burst_s: f64, capacity: usize, now: MonotonicNs) -> Self {
        let others = TokenBucket::new(rate_hz, burst_for(rate_hz), now);
        let senders = Vec::with_capacity(capacity);
        let mut limits = Self { rate_hz, burst_s, capacity, senders, others };
        limits.others = limits.bucket(now);
        limits
    }

    fn burst(&self) -> f64 {
        burst_for(self.rate_hz) + self.rate_hz * self.burst_s
    }

    fn bucket(&self, now: MonotonicNs) -> TokenBucket {
        if self.burst_s > 0.0 {
            TokenBucket::full(self.rate_hz, self.burst(), now)
        } else {
            TokenBucket::new(self.rate_hz, self.burst(), now)
        }
    }

    /// Applies a new rate.
    pub fn set_rate(&mut self, rate_hz: f64, now: MonotonicNs) {
        self.rate_hz = rate_hz;
        let burst = self.burst();
        let buckets = self.senders.iter_mut().map(|sender| &mut sender.bucket);
        for bucket in buckets.chain([&mut self.others]) {
            bucket.set_rate(rate_hz, burst, now);
        }
    }

    /// Whether the rate allows a message of `key`.
    pub fn allow(&mut self, key: K, now: MonotonicNs) -> bool {
        let bucket = match self.place_of(key, now) {
            Some(place) => {
                self.senders[place].last_request_at = now;
                &mut self.senders[place].bucket
            }
            None => &mut self.others,
        };
        bucket.try_take(now)
    }

    /// Senders in the table.
    pub fn len(&self) -> usize {
        self.senders.len()
    }

    /// Whether the table has no senders.
    pub fn is_empty(&self) -> bool {
        self.senders.is_empty()
    }

    /// The place of a sender in the table; a new one may replace a sender that is idle.
    fn place_of(&mut self, key: K, now: MonotonicNs) -> Option<usize> {
        if let Some(place) = self.senders.iter().position(|sender| sender.key == key) {
            return Some(place);
        }
        let is_idle = |sender: &Sender<K>| now.since(sender.last_request_at) > IDLE_SENDER_MS * 1_000_000;
        let sender = Sender { key, bucket: self.bucket(now), last_request_at: now };
        if self.senders.len() < self.capacity {
            self.senders.push(sender);
            return Some(self.senders.len() - 1);
        }
        let place = self.senders.iter().position(is_idle)?;
        self.senders[place] = sender;
        Some(place)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_message_is_too_old_for_one_window_and_fresh_for_a_longer_one() {
        let mut guard = ReplayGuard::new(1_000, 8);
        assert!(guard.is_empty());
        let now = WallNs(100_000_000_000);
        let sent = WallNs(now.0 - 5_000_000_000);
        assert_eq!(guard.admit([1; 16], sent, now), Admission::TooOld);
        assert!(guard.is_empty());
        let mut guard = ReplayGuard::new(10_000, 8);
        assert_eq!(guard.admit([2; 16], sent, now), Admission::Fresh);
        assert!(!guard.is_empty());
    }
}
