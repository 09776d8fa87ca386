//! Detects network interfaces and peers on other hosts that are away, and records when they come back.

use alloc::borrow::ToOwned;
use alloc::collections::VecDeque;
use alloc::format;
use alloc::string::{String, ToString};
use alloc::vec::Vec;
use core::net::{IpAddr, Ipv4Addr};

use crate::model::{AbsenceKind, Guid, MonotonicNs};

/// How long an absence is kept after its end; or, unless the interface is configured, after its beginning.
/// Longer than a robot takes to cross a gap in its Wi-Fi.
pub const REMEMBER_ABSENCE_MS: u64 = 900_000;

/// The most participants on other hosts that are watched; further ones are ignored.
pub const MAX_WATCHED_PEERS: usize = 128;

/// The most readers and writers of one participant that are recorded.
const MAX_PEER_ENDPOINTS: usize = 32;

/// The most interfaces that are watched in addition to the configured ones.
const MAX_FOUND_INTERFACES: usize = 16;

/// A network interface of this host with one of its IPv4 addresses, or without any.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HostInterface {
    /// Its name, such as `wlan0`.
    pub name: String,
    /// The address and its network mask.
    pub address: Option<(Ipv4Addr, Ipv4Addr)>,
    /// Whether it is up and has a carrier, or is associated with an access point.
    pub has_link: bool,
}

impl HostInterface {
    fn reaches(&self, host: IpAddr) -> bool {
        let (Some((own, mask)), IpAddr::V4(host)) = (self.address, host) else { return false };
        own.to_bits() & mask.to_bits() == host.to_bits() & mask.to_bits()
    }
}

/// The absence of an interface or a peer, current or past.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Absence {
    /// Whether it is an interface or a peer.
    pub kind: AbsenceKind,
    /// The interface as configured, or the peer's node; empty when the node is not known.
    pub name: String,
    /// The last address of the interface, or that of the peer's host.
    pub host: Option<IpAddr>,
    /// What the interface lacks, or what the peer subscribes to and publishes.
    pub detail: String,
    /// When the absence began.
    pub since: MonotonicNs,
    /// When the interface or peer came back; `None` while it is away.
    pub back_at: Option<MonotonicNs>,
}

/// A change to log.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum AbsenceEvent {
    /// The interface or peer is away.
    Away(Absence),
    /// The interface or peer came back.
    Back(Absence),
}

/// When an absence began, and when it ended.
#[derive(Clone, Copy, Debug)]
struct Span {
    since: MonotonicNs,
    back_at: Option<MonotonicNs>,
}

impl Span {
    fn is_expired(self, is_configured: bool, now: MonotonicNs) -> bool {
        match self.back_at {
            None => !is_configured && now >= self.since.plus_ms(REMEMBER_ABSENCE_MS),
            Some(at) => now >= at.plus_ms(REMEMBER_ABSENCE_MS),
        }
    }
}

fn is_away(span: Option<Span>) -> bool {
    span.is_some_and(|span| span.back_at.is_none())
}

#[derive(Clone, Debug)]
struct Interface {
    /// Its name, or its address if the configuration has that.
    name: String,
    is_configured: bool,
    address: Option<Ipv4Addr>,
    detail: &'static str,
    /// The absence, current or past.
    span: Option<Span>,
}

impl Interface {
    fn new(name: String, is_configured: bool, address: Option<Ipv4Addr>) -> Self {
        Self { name, is_configured, address, detail: "", span: None }
    }

    fn absence(&self) -> Option<Absence> {
        let Span { since, back_at } = self.span?;
        Some(Absence {
            kind: AbsenceKind::Interface,
            name: self.name.clone(),
            host: self.address.map(IpAddr::V4),
            detail: self.detail.to_owned(),
            since,
            back_at,
        })
    }
}

#[derive(Clone, Debug)]
struct Endpoint {
    guid: Guid,
    topic: String,
    publishes: bool,
}

#[derive(Clone, Debug)]
struct Peer {
    network: usize,
    prefix: [u8; 12],
    node: Option<String>,
    host: IpAddr,
    endpoints: Vec<Endpoint>,
    /// The absence, current or past.
    span: Option<Span>,
}

impl Peer {
    fn absence(&self) -> Option<Absence> {
        let Span { since, back_at } = self.span?;
        let topics = |publishes: bool| {
            let topics = self.endpoints.iter().filter(move |endpoint| endpoint.publishes == publishes);
            topics.map(|endpoint| endpoint.topic.as_str()).collect::<Vec<_>>().join(", ")
        };
        let parts = [("subscribes to ", topics(false)), ("publishes ", topics(true))];
        let parts = parts.iter().filter(|(_, topics)| !topics.is_empty());
        let detail: Vec<String> = parts.map(|(verb, topics)| format!("{verb}{topics}")).collect();
        Some(Absence {
            kind: AbsenceKind::Peer,
            name: self.node.clone().unwrap_or_default(),
            host: Some(self.host),
            detail: detail.join(" and "),
            since,
            back_at,
        })
    }
}

/// Watches the configured interfaces, the interfaces by which peers were reached, and the peers. Memory is
/// bounded, whatever the network announces.
#[derive(Clone, Debug, Default)]
pub struct AbsenceWatch {
    interfaces: Vec<Interface>,
    peers: Vec<Peer>,
    events: VecDeque<AbsenceEvent>,
}

impl AbsenceWatch {
    /// Watches the configured interfaces, given by name or address, and those by which peers are reached.
    pub fn new(configured: impl IntoIterator<Item = String>) -> Self {
        let mut watch = Self::default();
        for name in configured {
            if !watch.interfaces.iter().any(|known| known.name == name) {
                watch.interfaces.push(Interface::new(name, true, None));
            }
        }
        watch
    }

    /// Compares with the interfaces that this host has now, and removes expired absences.
    pub fn update_interfaces(&mut self, present: &[HostInterface], now: MonotonicNs) {
        self.interfaces.retain_mut(|interface| {
            let is_configured = interface.is_configured;
            let kept = interface.span.filter(|span| !span.is_expired(is_configured, now));
            let is_expired = interface.span.is_some() && kept.is_none();
            interface.span = kept;
            is_configured || !is_expired
        });
        self.peers.retain_mut(|peer| {
            let was_away = is_away(peer.span);
            peer.span = peer.span.filter(|span| !span.is_expired(false, now));
            peer.span.is_some() || !was_away
        });
        self.find_interfaces(present);
        for interface in &mut self.interfaces {
            match usable_address(&interface.name, present) {
                Ok(address) => {
                    interface.address = Some(address);
                    if let Some(span) = interface.span.as_mut().filter(|span| span.back_at.is_none()) {
                        span.back_at = Some(now);
                        self.events.extend(interface.absence().map(AbsenceEvent::Back));
                    }
                }
                Err(detail) => {
                    interface.detail = detail;
                    if !is_away(interface.span) {
                        interface.span = Some(Span { since: now, back_at: None });
                        self.events.extend(interface.absence().map(AbsenceEvent::Away));
                    }
                }
            }
        }
    }

    /// Adds the interfaces by which a peer is reached. Others come and go with containers and tunnels.
    fn find_interfaces(&mut self, present: &[HostInterface]) {
        for found in present.iter().filter(|found| found.has_link) {
            let Some((address, _)) = found.address else { continue };
            let is_known = self
                .interfaces
                .iter()
                .any(|known| known.name == found.name || known.name == address.to_string());
            let count = self.interfaces.iter().filter(|known| !known.is_configured).count();
            if is_known || count >= MAX_FOUND_INTERFACES {
                continue;
            }
            if self.peers.iter().any(|peer| !is_away(peer.span) && found.reaches(peer.host)) {
                self.interfaces.push(Interface::new(found.name.clone(), false, Some(address)));
            }
        }
    }

    /// Records a reader or writer, new or changed, that discovery found on another host.
    pub fn endpoint_discovered(
        &mut self,
        network: usize,
        guid: Guid,
        topic: &str,
        publishes: bool,
        host: IpAddr,
        now: MonotonicNs,
    ) {
        let prefix = guid.prefix();
        let is_same = |peer: &Peer| peer.network == network && peer.prefix == prefix;
        // A restarted program replaces a peer that is away if one of its topics is the same.
        let has = |endpoint: &Endpoint| endpoint.topic == topic && endpoint.publishes == publishes;
        let is_replaced = |peer: &Peer| {
            is_away(peer.span)
                && peer.network == network
                && peer.host == host
                && peer.endpoints.iter().any(has)
        };
        let peers = &mut self.peers;
        let place = match peers.iter().position(is_same).or_else(|| peers.iter().position(is_replaced)) {
            Some(place) => place,
            None if peers.len() == MAX_WATCHED_PEERS => return,
            None => {
                peers.push(Peer { network, prefix, node: None, host, endpoints: Vec::new(), span: None });
                peers.len() - 1
            }
        };
        let peer = &mut peers[place];
        if peer.prefix != prefix {
            peer.prefix = prefix;
            peer.endpoints.clear();
        }
        peer.host = host;
        if !peer.endpoints.iter().any(|endpoint| endpoint.guid == guid)
            && peer.endpoints.len() < MAX_PEER_ENDPOINTS
        {
            peer.endpoints.push(Endpoint { guid, topic: topic.to_owned(), publishes });
        }
        if let Some(span) = peer.span.as_mut().filter(|span| span.back_at.is_none()) {
            span.back_at = Some(now);
            self.events.extend(peer.absence().map(AbsenceEvent::Back));
        }
    }

    /// Removes a reader or writer that was deleted in order.
    pub fn endpoint_lost(&mut self, guid: Guid) {
        for peer in &mut self.peers {
            peer.endpoints.retain(|endpoint| endpoint.guid != guid);
        }
        self.peers.retain(|peer| !peer.endpoints.is_empty());
    }

    /// Removes a participant that left in order, or marks one as away whose lease expired after `silent_ms`.
    pub fn participant_lost(
        &mut self,
        network: usize,
        prefix: [u8; 12],
        silent_ms: Option<u64>,
        now: MonotonicNs,
    ) {
        let is_same = |peer: &Peer| peer.network == network && peer.prefix == prefix;
        let Some(silent_ms) = silent_ms else { return self.peers.retain(|peer| !is_same(peer)) };
        if let Some(peer) = self.peers.iter_mut().find(|peer| is_same(peer))
            && !is_away(peer.span)
        {
            let silent_ns = silent_ms.saturating_mul(1_000_000);
            let since = MonotonicNs(now.0.saturating_sub(silent_ns));
            peer.span = Some(Span { since, back_at: None });
            self.events.extend(peer.absence().map(AbsenceEvent::Away));
        }
    }

    /// Updates the nodes of the peers in a network; `node_of` returns the node of a reader or writer.
    pub fn name_nodes<'graph>(&mut self, network: usize, node_of: impl Fn(Guid) -> Option<&'graph str>) {
        let peers = self.peers.iter_mut().filter(|peer| peer.network == network && !is_away(peer.span));
        for peer in peers {
            let node = peer.endpoints.iter().find_map(|endpoint| node_of(endpoint.guid));
            if node.is_some() && node != peer.node.as_deref() {
                peer.node = node.map(str::to_owned);
            }
        }
    }

    /// The next change, if there is one.
    pub fn poll(&mut self) -> Option<AbsenceEvent> {
        self.events.pop_front()
    }

    /// All absences: current ones first, then past ones, each with interfaces before peers.
    pub fn absences(&self) -> Vec<Absence> {
        let interfaces = self.interfaces.iter().filter_map(Interface::absence);
        let mut all: Vec<Absence> = interfaces.chain(self.peers.iter().filter_map(Peer::absence)).collect();
        all.sort_by_key(|absence| absence.back_at.is_some());
        all
    }
}

/// The address of an interface, given by name or address, or why it cannot be used.
fn usable_address(name: &str, present: &[HostInterface]) -> Result<Ipv4Addr, &'static str> {
    let by_address: Option<Ipv4Addr> = name.parse().ok();
    let is_same = |found: &&HostInterface| match by_address {
        Some(address) => found.address.is_some_and(|(own, _)| own == address),
        None => found.name == name,
    };
    let mut detail =
        if by_address.is_some() { "is the address of no interface" } else { "is not on this host" };
    for found in present.iter().filter(is_same) {
        match found.address {
            Some((address, _)) if found.has_link => return Ok(address),
            Some(_) => detail = "has no link",
            None if detail != "has no link" => {
                detail = if found.has_link { "has no IPv4 address" } else { "has no link" }
            }
            None => {}
        }
    }
    Err(detail)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(ms: u64) -> MonotonicNs {
        MonotonicNs(1_000_000_000).plus_ms(ms)
    }

    fn guid(participant: u8, entity: u8) -> Guid {
        let mut guid = [participant; 16];
        guid[15] = entity;
        Guid(guid)
    }

    fn interface(name: &str, address: Option<[u8; 4]>, has_link: bool) -> HostInterface {
        let address = address.map(|of| (Ipv4Addr::from(of), Ipv4Addr::new(255, 255, 255, 0)));
        HostInterface { name: name.into(), address, has_link }
    }

    const LAPTOP: IpAddr = IpAddr::V4(Ipv4Addr::new(10, 0, 0, 4));

    /// All absences as text.
    fn absences(watch: &AbsenceWatch) -> Vec<String> {
        let line = |absence: Absence| {
            let state = if absence.back_at.is_some() { "back" } else { "away" };
            format!("{state} {} {}", absence.name, absence.detail)
        };
        watch.absences().into_iter().map(line).collect()
    }

    #[test]
    fn a_configured_interface_is_away_until_it_has_an_address_and_a_link() {
        let mut watch = AbsenceWatch::new(["wlan0".to_owned(), "10.0.0.9".to_owned(), "lo".to_owned()]);
        let lo = interface("lo", Some([127, 0, 0, 1]), true);
        watch.update_interfaces(std::slice::from_ref(&lo), at(0));
        assert_eq!(
            absences(&watch),
            ["away wlan0 is not on this host", "away 10.0.0.9 is the address of no interface"]
        );
        assert!(matches!(watch.poll(), Some(AbsenceEvent::Away(absence)) if absence.name == "wlan0"));
        let other = interface("eth0", Some([10, 0, 0, 9]), true);
        watch.update_interfaces(&[lo.clone(), other.clone(), interface("wlan0", None, true)], at(1_000));
        assert_eq!(
            absences(&watch),
            ["away wlan0 has no IPv4 address", "back 10.0.0.9 is the address of no interface"]
        );
        let wlan = |has_link| interface("wlan0", Some([10, 0, 1, 2]), has_link);
        watch.update_interfaces(&[lo.clone(), other.clone(), wlan(false)], at(2_000));
        assert_eq!(absences(&watch)[0], "away wlan0 has no link");
        watch.update_interfaces(&[lo.clone(), other.clone(), wlan(true)], at(3_000));
        let back = &watch.absences()[0];
        assert_eq!((back.since, back.back_at), (at(0), Some(at(3_000))));
        assert_eq!(back.host, Some(IpAddr::V4(Ipv4Addr::new(10, 0, 1, 2))));
        watch.update_interfaces(&[lo, other, wlan(true)], at(3_000 + REMEMBER_ABSENCE_MS));
        assert_eq!(absences(&watch), [""; 0], "expired");
    }

    #[test]
    fn an_interface_without_a_link_is_reported_so_although_it_has_entries_without_an_address() {
        let mut watch = AbsenceWatch::new(["wlan0".to_owned()]);
        let no_link = interface("wlan0", Some([10, 0, 1, 2]), false);
        watch.update_interfaces(&[no_link, interface("wlan0", None, true)], at(0));
        assert_eq!(absences(&watch), ["away wlan0 has no link"]);
    }

    #[test]
    fn without_configured_interfaces_those_that_reach_peers_are_watched() {
        let mut watch = AbsenceWatch::new([]);
        let eth = |has_link| interface("eth0", Some([10, 0, 0, 1]), has_link);
        let docker = |has_link| interface("docker0", Some([172, 17, 0, 1]), has_link);
        watch.update_interfaces(&[eth(true), docker(true)], at(0));
        watch.endpoint_discovered(0, guid(1, 4), "/scan", false, LAPTOP, at(0));
        watch.update_interfaces(&[eth(true), docker(true)], at(1_000));
        watch.update_interfaces(&[eth(false), docker(false)], at(2_000));
        assert_eq!(absences(&watch), ["away eth0 has no link"]);
        watch.update_interfaces(&[], at(2_000 + REMEMBER_ABSENCE_MS));
        assert_eq!(absences(&watch), [""; 0], "an interface that is not configured expires");
    }

    #[test]
    fn a_peer_is_away_when_its_lease_expires_and_not_when_it_leaves_in_order() {
        let mut watch = AbsenceWatch::new([]);
        watch.endpoint_discovered(0, guid(1, 4), "/scan", false, LAPTOP, at(0));
        watch.endpoint_discovered(0, guid(1, 3), "/odom", true, LAPTOP, at(0));
        watch.endpoint_discovered(0, guid(2, 4), "/scan", false, LAPTOP, at(0));
        watch.endpoint_discovered(0, guid(3, 4), "/scan", false, LAPTOP, at(0));
        watch.name_nodes(0, |endpoint| (endpoint.prefix() == [1; 12]).then_some("/rviz"));
        watch.participant_lost(0, [2; 12], None, at(100));
        watch.endpoint_lost(guid(3, 4));
        watch.participant_lost(0, [3; 12], Some(10_000), at(20_000));
        watch.participant_lost(1, [1; 12], Some(10_000), at(20_000));
        assert_eq!(absences(&watch), [""; 0]);
        watch.participant_lost(0, [1; 12], Some(10_000), at(20_000));
        assert_eq!(absences(&watch), ["away /rviz subscribes to /scan and publishes /odom"]);
        assert_eq!(watch.absences()[0].since, at(10_000));
        watch.endpoint_discovered(0, guid(1, 4), "/scan", false, LAPTOP, at(25_000));
        assert_eq!(absences(&watch), ["back /rviz subscribes to /scan and publishes /odom"]);
        let events: Vec<_> = std::iter::from_fn(|| watch.poll()).collect();
        assert!(matches!(&events[..], [AbsenceEvent::Away(_), AbsenceEvent::Back(_)]), "{events:?}");
    }

    #[test]
    fn a_restarted_program_is_back_and_one_that_is_not_restarted_expires() {
        let mut watch = AbsenceWatch::new([]);
        for participant in [1, 2] {
            watch.endpoint_discovered(0, guid(participant, 4), "/scan", false, LAPTOP, at(0));
        }
        for participant in [1, 2] {
            watch.participant_lost(0, [participant; 12], Some(10_000), at(20_000));
        }
        watch.endpoint_discovered(0, guid(3, 4), "/scan", false, LAPTOP, at(30_000));
        assert_eq!(absences(&watch), ["away  subscribes to /scan", "back  subscribes to /scan"]);
        watch.update_interfaces(&[], at(20_000 + REMEMBER_ABSENCE_MS));
        assert_eq!(absences(&watch), ["back  subscribes to /scan"]);
    }

    #[test]
    fn an_absence_is_shown_until_it_expires_and_its_peer_is_watched_on() {
        let mut watch = AbsenceWatch::new([]);
        let eth = |has_link| interface("eth0", Some([10, 0, 0, 1]), has_link);
        watch.endpoint_discovered(0, guid(1, 4), "/scan", false, LAPTOP, at(0));
        watch.update_interfaces(&[eth(true)], at(0));
        watch.update_interfaces(&[eth(true)], at(500));
        watch.participant_lost(0, [1; 12], Some(10_000), at(20_000));
        watch.update_interfaces(&[eth(false)], at(20_000));
        watch.update_interfaces(&[eth(false)], at(21_000));
        assert_eq!(absences(&watch), ["away eth0 has no link", "away  subscribes to /scan"]);
        watch.endpoint_discovered(0, guid(1, 4), "/scan", false, LAPTOP, at(22_000));
        watch.update_interfaces(&[eth(true)], at(22_000));
        let expired = 22_000 + REMEMBER_ABSENCE_MS;
        watch.update_interfaces(&[eth(true)], at(expired));
        assert_eq!(absences(&watch), [""; 0]);
        watch.participant_lost(0, [1; 12], Some(10_000), at(expired + 20_000));
        assert_eq!(absences(&watch), ["away  subscribes to /scan"], "still watched");
    }

    #[test]
    fn an_interface_is_watched_once_whether_it_is_configured_by_name_or_by_address() {
        let eth = |has_link| interface("eth0", Some([10, 0, 0, 1]), has_link);
        for (configured, expected) in [
            (vec!["eth0"], vec!["away eth0 has no link"]),
            (vec!["10.0.0.1"], vec!["away 10.0.0.1 has no link"]),
            (vec!["lo"], vec!["away lo is not on this host", "away eth0 has no link"]),
        ] {
            let mut watch = AbsenceWatch::new(configured.iter().map(|&name| name.to_owned()));
            watch.endpoint_discovered(0, guid(1, 4), "/scan", false, LAPTOP, at(0));
            watch.update_interfaces(&[eth(true)], at(0));
            watch.update_interfaces(&[eth(false)], at(1_000));
            assert_eq!(absences(&watch), expected);
        }
    }

    #[test]
    fn interfaces_that_reach_peers_are_limited_and_configured_ones_do_not_count() {
        let mut watch = AbsenceWatch::new((0..MAX_FOUND_INTERFACES).map(|number| format!("can{number}")));
        watch.endpoint_discovered(0, guid(1, 4), "/scan", false, LAPTOP, at(0));
        let found = |number: usize| interface(&format!("eth{number}"), Some([10, 0, 0, number as u8]), true);
        let present: Vec<_> = (10..11 + MAX_FOUND_INTERFACES).map(found).collect();
        watch.update_interfaces(&present, at(0));
        let names: Vec<_> = watch.interfaces.iter().filter(|one| !one.is_configured).collect();
        assert_eq!(names.len(), MAX_FOUND_INTERFACES);
    }

    #[test]
    fn a_program_that_does_something_else_replaces_no_peer() {
        let mut watch = AbsenceWatch::new([]);
        watch.endpoint_discovered(0, guid(1, 4), "/scan", false, LAPTOP, at(0));
        watch.participant_lost(0, [1; 12], Some(10_000), at(20_000));
        watch.endpoint_discovered(0, guid(2, 3), "/scan", true, LAPTOP, at(30_000));
        watch.endpoint_discovered(0, guid(3, 4), "/odom", false, LAPTOP, at(30_000));
        watch.endpoint_discovered(1, guid(4, 4), "/scan", false, LAPTOP, at(30_000));
        assert_eq!(absences(&watch), ["away  subscribes to /scan"]);
    }

    #[test]
    fn a_peer_keeps_its_node_and_the_nodes_of_another_network_are_not_its() {
        let mut watch = AbsenceWatch::new([]);
        watch.endpoint_discovered(0, guid(1, 4), "/scan", false, LAPTOP, at(0));
        watch.name_nodes(1, |_| Some("/other"));
        watch.name_nodes(0, |_| Some("/rviz"));
        watch.name_nodes(1, |_| Some("/other"));
        watch.name_nodes(0, |_| None);
        watch.participant_lost(0, [1; 12], Some(10_000), at(20_000));
        watch.name_nodes(0, |_| Some("/another"));
        assert_eq!(absences(&watch), ["away /rviz subscribes to /scan"]);
    }

    #[test]
    fn memory_is_bounded() {
        let mut watch = AbsenceWatch::new([]);
        for participant in 0..=255 {
            for entity in 0..=255 {
                watch.endpoint_discovered(0, guid(participant, entity), "/scan", false, LAPTOP, at(0));
            }
        }
        assert_eq!(watch.peers.len(), MAX_WATCHED_PEERS);
        assert!(watch.peers.iter().all(|peer| peer.endpoints.len() <= MAX_PEER_ENDPOINTS));
    }
}
