//! The model of an impaired link: decides what happens to each packet. Pure: packets are numbers, time is an
//! argument.

use std::fmt;
use std::str::FromStr;

use adaptive_bridge::model::MonotonicNs;
use serde::Serialize;

use super::delay::{DelayLine, NormalDelay};
use super::gilbert_elliott::{Chain, GilbertElliott};

/// The largest number of packets in transit; further ones are dropped, as by a full queue. It is 20 ms of a
/// million packets a second.
pub const HELD_MAX: usize = 20_000;

/// Loss and delay of a link while it is on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Impairment {
    /// The model of loss.
    pub loss: GilbertElliott,
    /// The delay of packets that are not lost.
    pub delay: NormalDelay,
    /// Seed of the random numbers; the same seed gives the same losses and delays, packet by packet.
    pub seed: u64,
}

/// The state of a link: impaired, clean or cut.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum LinkState {
    /// Packets are lost and delayed.
    On,
    /// Packets pass without loss or delay.
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
            _ => Err("must be on, off or down".to_owned()),
        }
    }
}

/// A packet that has arrived at the link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Arrival {
    /// The kernel's number of the packet.
    pub packet: u32,
    /// Its length, IP header included; 0 when unknown.
    pub bytes: u32,
    /// Whether it is a fragment of a datagram.
    pub fragment: bool,
}

/// The link's decision about a packet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fate {
    /// The packet passes now.
    Pass,
    /// The packet is lost.
    Drop,
    /// The packet is in transit; [`Link::pop_due`] returns it when its delay is over.
    Hold,
}

/// Numbers of packets that a link has handled. Each fragment of a datagram is a packet.
///
/// `seen = passed + lost + cut + overflowed + held` at every instant.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Counters {
    /// Packets that arrived.
    pub seen: u64,
    /// Packets that arrived and are fragments of a datagram. NFQUEUE only.
    pub fragments: u64,
    /// Length of the longest packet that arrived, in bytes. If it is above the MTU, something before the link
    /// (such as connection tracking) reassembles fragments, so loss is not by packet. NFQUEUE only.
    pub largest_bytes: u32,
    /// Packets that arrived while the link was on, which is the number of steps of the chain.
    pub judged: u64,
    /// Packets lost by the chain.
    pub lost: u64,
    /// Packets lost because the link was down.
    pub cut: u64,
    /// Packets lost because too many were in transit.
    pub overflowed: u64,
    /// Packets in transit.
    pub held: u64,
    /// Packets that passed, without or after a delay.
    pub passed: u64,
}

/// A link that loses and delays packets.
#[derive(Clone, Debug)]
pub struct Link {
    chain: Chain,
    line: DelayLine,
    has_delay: bool,
    state: LinkState,
    counters: Counters,
}

impl Link {
    /// Creates a link that is on.
    pub fn new(impairment: &Impairment) -> Self {
        Self {
            chain: Chain::new(impairment.loss, impairment.seed),
            line: DelayLine::new(impairment.delay, impairment.seed),
            has_delay: !impairment.delay.is_none(),
            state: LinkState::On,
            counters: Counters::default(),
        }
    }

    /// Switches the link. Packets in transit stay there, and the chain makes no steps until the link is on
    /// again.
    pub fn switch(&mut self, state: LinkState) {
        self.state = state;
    }

    /// Changes loss and delay while the link is on, for packets that arrive from now on.
    pub fn set(&mut self, loss: GilbertElliott, delay: NormalDelay) {
        self.chain.set(loss);
        self.line.set(delay);
        self.has_delay = !delay.is_none();
    }

    /// The state of the link.
    pub fn state(&self) -> LinkState {
        self.state
    }

    /// The packets counted so far.
    pub fn counters(&self) -> Counters {
        Counters { held: self.line.len() as u64, ..self.counters }
    }

    /// Decides what happens to a packet that arrives at `now`.
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
        } else if !self.has_delay {
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

    /// Removes and returns the next packet whose delay is over at `now`.
    pub fn pop_due(&mut self, now: MonotonicNs) -> Option<u32> {
        let packet = self.line.pop_due(now)?;
        self.counters.passed += 1;
        Some(packet)
    }

    /// When the next delay is over; `None` when no packet is in transit.
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
    fn packets_above_the_limit_in_transit_are_dropped() {
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
    fn packets_in_transit_arrive_although_the_link_is_cut() {
        let delay = NormalDelay::new(10.0, 0.0).expect("in range");
        let mut link = Link::new(&Impairment { loss: GilbertElliott::CLEAN, delay, seed: 1 });
        link.arrive(arrival(4), MonotonicNs(0));
        link.switch(LinkState::Down);
        assert_eq!(link.next_release(), Some(MonotonicNs(10_000_000)));
        assert_eq!(link.pop_due(MonotonicNs(10_000_000)), Some(4));
    }

    #[test]
    fn states_parse_from_their_printed_form() {
        for state in [LinkState::On, LinkState::Off, LinkState::Down] {
            assert_eq!(state.to_string().parse(), Ok(state));
        }
        assert!("up".parse::<LinkState>().is_err());
    }
}
