//! What an impaired link does to each packet. Pure: packets are numbers, time is an argument.

use std::fmt;
use std::str::FromStr;

use serde::Serialize;

use super::delay::{DelayLine, NormalDelay};
use super::gilbert_elliott::{Chain, GilbertElliott};
use crate::model::MonotonicNs;

/// How many packets may be on their way at once; those beyond it are dropped, as by a full queue. It is 20 ms
/// of a million packets a second.
pub const HELD_MAX: usize = 20_000;

/// What a link does while it is on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Impairment {
    /// Which packets are lost.
    pub loss: GilbertElliott,
    /// How long the others take.
    pub delay: NormalDelay,
    /// The same losses and delays, packet by packet, for the same seed.
    pub seed: u64,
}

/// Whether a link is impaired.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum LinkState {
    /// Packets are lost and delayed.
    On,
    /// Packets pass at once.
    Off,
    /// Every packet is lost.
    Down,
}

impl fmt::Display for LinkState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::On => "on",
            Self::Off => "off",
            Self::Down => "down",
        })
    }
}

impl FromStr for LinkState {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "on" => Ok(Self::On),
            "off" => Ok(Self::Off),
            "down" => Ok(Self::Down),
            _ => Err(format!("'{text}' is not one of on, off, down")),
        }
    }
}

/// A packet that has arrived at the link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Arrival {
    /// The number by which the kernel knows it.
    pub packet: u32,
    /// Its length, IP header included; 0 when unknown.
    pub bytes: u32,
    /// Whether it is a fragment of a datagram.
    pub fragment: bool,
}

/// What becomes of a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fate {
    /// It passes now.
    Pass,
    /// It is lost.
    Drop,
    /// It is on its way; [`Link::pop_due`] will yield it.
    Hold,
}

/// What a link has done so far, in packets. Each fragment of a datagram is one.
///
/// `seen = passed + lost + cut + overflowed + held` at every instant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counters {
    /// Arrived.
    pub seen: u64,
    /// Those of them that are fragments of a datagram. By NFQUEUE only.
    pub fragments: u64,
    /// The longest that arrived, in bytes. More than the MTU says that something before the link puts
    /// fragments together (connection tracking does), so that loss is not by packet. By NFQUEUE only.
    pub largest_bytes: u32,
    /// Arrived while the link was on: so many steps the chain made.
    pub judged: u64,
    /// Lost by the chain.
    pub lost: u64,
    /// Lost as the link was down.
    pub cut: u64,
    /// Lost as too many were on their way.
    pub overflowed: u64,
    /// On their way.
    pub held: u64,
    /// Passed, at once or after their delay.
    pub passed: u64,
}

/// A link that loses and delays packets.
#[derive(Clone, Debug)]
pub struct Link {
    chain: Chain,
    line: DelayLine,
    delays: bool,
    state: LinkState,
    counters: Counters,
}

impl Link {
    /// A link that is on.
    pub fn new(impairment: &Impairment) -> Self {
        Self {
            chain: Chain::new(impairment.loss, impairment.seed),
            line: DelayLine::new(impairment.delay, impairment.seed),
            delays: !impairment.delay.is_none(),
            state: LinkState::On,
            counters: Counters::default(),
        }
    }

    /// Switches it. What is on its way stays so, and the chain stands still until the link is on again.
    pub fn switch(&mut self, state: LinkState) {
        self.state = state;
    }

    /// Changes what it does while it is on, for packets that come from now on.
    pub fn set(&mut self, loss: GilbertElliott, delay: NormalDelay) {
        self.chain.set(loss);
        self.line.set(delay);
        self.delays = !delay.is_none();
    }

    /// Its state.
    pub fn state(&self) -> LinkState {
        self.state
    }

    /// What it has done so far.
    pub fn counters(&self) -> Counters {
        Counters { held: self.line.len() as u64, ..self.counters }
    }

    /// Decides about a packet.
    pub fn arrive(&mut self, arrival: Arrival, now: MonotonicNs) -> Fate {
        self.counters.seen += 1;
        self.counters.fragments += u64::from(arrival.fragment);
        self.counters.largest_bytes = self.counters.largest_bytes.max(arrival.bytes);
        match self.state {
            LinkState::Down => {
                self.counters.cut += 1;
                return Fate::Drop;
            }
            LinkState::Off => {
                self.counters.passed += 1;
                return Fate::Pass;
            }
            LinkState::On => self.counters.judged += 1,
        }
        if self.chain.next_is_lost() {
            self.counters.lost += 1;
            Fate::Drop
        } else if !self.delays {
            self.counters.passed += 1;
            Fate::Pass
        } else if self.line.len() >= HELD_MAX {
            self.counters.overflowed += 1;
            Fate::Drop
        } else {
            self.line.push(arrival.packet, now);
            Fate::Hold
        }
    }

    /// The next packet whose delay is over at `now`.
    pub fn pop_due(&mut self, now: MonotonicNs) -> Option<u32> {
        let packet = self.line.pop_due(now)?;
        self.counters.passed += 1;
        Some(packet)
    }

    /// When the next delay is over; `None` when no packet is on its way.
    pub fn next_release(&self) -> Option<MonotonicNs> {
        self.line.next_release()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::super::levels::{Level, Reading};
    use super::*;

    fn link(delay_ms: f64, seed: u64) -> Link {
        let delay = NormalDelay::new(delay_ms, delay_ms / 4.0).expect("in range");
        Link::new(&Impairment { loss: Level::Strong.model(Reading::AsRun), delay, seed })
    }

    fn arrival(packet: u32) -> Arrival {
        Arrival { packet, bytes: 100, fragment: packet.is_multiple_of(3) }
    }

    proptest! {
        #[test]
        fn every_packet_is_accounted_for(
            steps in proptest::collection::vec((0..10_u8, 0..3_000_000_u64), 1..300),
            delay_ms in prop_oneof![Just(0.0), 0.1..30.0],
            seed: u64,
        ) {
            let mut link = link(delay_ms, seed);
            let mut now = MonotonicNs(0);
            let (mut passed, mut dropped, mut seen) = (0, 0, 0);
            for (step, gap_ns) in steps {
                now = now.plus_ns(gap_ns);
                match step {
                    0 => link.switch(LinkState::On),
                    1 => link.switch(LinkState::Off),
                    2 => link.switch(LinkState::Down),
                    _ => {
                        let fate = link.arrive(arrival(seen), now);
                        seen += 1;
                        match (link.state(), fate) {
                            (LinkState::Off, Fate::Pass) | (LinkState::On, Fate::Pass) => passed += 1,
                            (LinkState::Down, Fate::Drop) | (LinkState::On, Fate::Drop) => dropped += 1,
                            (LinkState::On, Fate::Hold) => prop_assert!(delay_ms > 0.0),
                            other => prop_assert!(false, "{other:?}"),
                        }
                    }
                }
                while link.pop_due(now).is_some() {
                    passed += 1;
                }
                let counters = link.counters();
                prop_assert_eq!(counters.seen, u64::from(seen));
                prop_assert_eq!(counters.passed, passed);
                prop_assert_eq!(counters.lost + counters.cut + counters.overflowed, dropped);
                prop_assert_eq!(counters.seen, passed + dropped + counters.held);
            }
        }

        #[test]
        fn neither_delay_nor_a_pause_changes_which_packets_are_lost(
            pauses in proptest::collection::vec((any::<bool>(), 1..20_usize), 1..20),
            seed: u64,
        ) {
            let mut plain = link(0.0, seed);
            let mut other = link(15.0, seed);
            for (paused, packets) in pauses {
                other.switch(if paused { LinkState::Off } else { LinkState::On });
                for packet in 0..packets {
                    let fate = other.arrive(arrival(packet as u32), MonotonicNs(0));
                    if !paused {
                        let lost = plain.arrive(arrival(packet as u32), MonotonicNs(0)) == Fate::Drop;
                        prop_assert_eq!(fate == Fate::Drop, lost);
                    }
                }
            }
        }
    }

    #[test]
    fn no_more_than_the_limit_is_held() {
        let delay = NormalDelay::new(1_000.0, 0.0).expect("in range");
        let mut link = Link::new(&Impairment { loss: GilbertElliott::CLEAN, delay, seed: 1 });
        for packet in 0..HELD_MAX as u32 {
            assert_eq!(link.arrive(arrival(packet), MonotonicNs(0)), Fate::Hold);
        }
        assert_eq!(link.arrive(arrival(0), MonotonicNs(0)), Fate::Drop);
        assert_eq!((link.counters().overflowed, link.counters().held), (1, HELD_MAX as u64));
        assert_eq!(link.pop_due(MonotonicNs(0).plus_ms(1_000)), Some(0));
        assert_eq!(link.arrive(arrival(0), MonotonicNs(0)), Fate::Hold);
    }

    #[test]
    fn what_is_on_its_way_arrives_though_the_link_is_cut() {
        let delay = NormalDelay::new(10.0, 0.0).expect("in range");
        let mut link = Link::new(&Impairment { loss: GilbertElliott::CLEAN, delay, seed: 1 });
        link.arrive(arrival(4), MonotonicNs(0));
        link.switch(LinkState::Down);
        assert_eq!(link.next_release(), Some(MonotonicNs(10_000_000)));
        assert_eq!(link.pop_due(MonotonicNs(10_000_000)), Some(4));
    }

    #[test]
    fn states_are_written_as_they_are_read() {
        for state in [LinkState::On, LinkState::Off, LinkState::Down] {
            assert_eq!(state.to_string().parse(), Ok(state));
        }
        assert!("up".parse::<LinkState>().is_err());
    }
}
