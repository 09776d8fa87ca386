//! Decides whether a DDS endpoint is on this host.

use alloc::vec::Vec;
use core::net::IpAddr;

/// The addresses of an endpoint's participant.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Location {
    /// The source address of the participant's last datagram; `None` when none arrived from the participant
    /// itself, for example because a discovery server forwards its announcements.
    pub seen_from: Option<IpAddr>,
    /// The addresses at which it announces to receive unicast over UDP.
    pub announced: Vec<IpAddr>,
}

/// Whether an endpoint is on this host.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Locality {
    /// On this host.
    Local,
    /// On another host.
    Remote,
    /// The addresses do not show it.
    Unknown,
}

impl Location {
    /// Whether the endpoint is on this host, whose interfaces have the addresses `own`.
    ///
    /// The source address of the participant's datagrams decides if it is known: the kernel sends local
    /// traffic from an address of this host, and drops traffic from outside that claims one. Otherwise the
    /// announced addresses decide, which are weaker evidence:
    /// - 127.0.0.1 beside other addresses is ignored, because some libraries announce it to all hosts. Alone
    ///   it means that the endpoint is on this host.
    /// - An address of this host means local. That is wrong for an address that many hosts have, such as
    ///   172.17.0.1, the default of Docker's bridge: a robot and a laptop that both have it look alike.
    /// - One current address of this host is enough: a node may also announce addresses that the host no
    ///   longer has.
    ///
    /// A container that shares the host's network is this host. One with its own network is another host: its
    /// traffic crosses a virtual switch, which cannot be distinguished from a real one. Shared-memory
    /// locators are not addresses: an endpoint with no others is unknown.
    pub fn locality(&self, own: &[IpAddr]) -> Locality {
        let is_here = |address: &IpAddr| {
            let address = address.to_canonical();
            address.is_loopback() || own.iter().any(|own| own.to_canonical() == address)
        };
        if let Some(source) = &self.seen_from {
            return if is_here(source) { Locality::Local } else { Locality::Remote };
        }
        let mut distinctive = self.distinctive().peekable();
        if distinctive.peek().is_some() {
            if distinctive.any(|address| is_here(&address)) { Locality::Local } else { Locality::Remote }
        } else if self.announced.iter().any(|address| address.to_canonical().is_loopback()) {
            Locality::Local
        } else {
            Locality::Unknown
        }
    }

    /// The address to show for the host: the source address of its datagrams, or else the first announced
    /// address that identifies a host.
    pub fn host(&self) -> Option<IpAddr> {
        self.seen_from.map(|source| source.to_canonical()).or_else(|| self.distinctive().next())
    }

    /// The announced addresses that identify a host: not loopback, unspecified or multicast.
    fn distinctive(&self) -> impl Iterator<Item = IpAddr> {
        let announced = self.announced.iter().map(IpAddr::to_canonical);
        announced
            .filter(|address| !address.is_loopback() && !address.is_unspecified() && !address.is_multicast())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn addresses(texts: &[&str]) -> Vec<IpAddr> {
        texts.iter().map(|text| text.parse().unwrap()).collect()
    }

    fn place(seen_from: Option<&str>, announced: &[&str]) -> Locality {
        let own =
            addresses(&["127.0.0.1", "10.0.0.5", "192.168.1.5", "172.17.0.1", "fe80::5", "2001:db8::5"]);
        let seen_from = seen_from.map(|text| text.parse().unwrap());
        Location { seen_from, announced: addresses(announced) }.locality(&own)
    }

    #[test]
    fn the_source_address_of_the_datagrams_decides() {
        for here in
            ["127.0.0.1", "127.0.1.1", "10.0.0.5", "192.168.1.5", "2001:db8::5", "::1", "::ffff:10.0.0.5"]
        {
            assert_eq!(place(Some(here), &["192.168.1.9"]), Locality::Local, "{here}");
        }
        // A laptop with Docker, which the robot has too, and a library that announces 127.0.0.1.
        let laptop = place(Some("192.168.1.9"), &["127.0.0.1", "192.168.1.9", "172.17.0.1"]);
        assert_eq!(laptop, Locality::Remote);
        assert_eq!(place(Some("2001:db8::9"), &[]), Locality::Remote);
    }

    #[test]
    fn without_datagrams_the_announced_addresses_decide() {
        assert_eq!(place(None, &["10.0.0.5"]), Locality::Local);
        assert_eq!(place(None, &["10.0.0.77", "192.168.1.5"]), Locality::Local, "it had 10.0.0.77 once");
        assert_eq!(place(None, &["127.0.0.1"]), Locality::Local);
        assert_eq!(place(None, &["10.0.0.9", "192.168.1.9"]), Locality::Remote);
        assert_eq!(place(None, &["127.0.0.1", "10.0.0.9"]), Locality::Remote);
        assert_eq!(place(None, &["::1", "2001:db8::9"]), Locality::Remote);
        assert_eq!(place(None, &["2001:db8::5"]), Locality::Local);
        // A container on a bridge of this host.
        assert_eq!(place(None, &["172.17.0.2"]), Locality::Remote);
    }

    #[test]
    fn without_an_address_the_host_is_unknown() {
        assert_eq!(place(None, &[]), Locality::Unknown);
        assert_eq!(place(None, &["0.0.0.0", "239.255.0.1", "::"]), Locality::Unknown);
    }

    #[test]
    fn the_host_address_identifies_one_host() {
        let announced = addresses(&["127.0.0.1", "0.0.0.0", "10.0.0.9"]);
        assert_eq!(
            Location { seen_from: None, announced: announced.clone() }.host(),
            "10.0.0.9".parse().ok()
        );
        let seen_from = "192.168.1.9".parse().ok();
        assert_eq!(Location { seen_from, announced }.host(), seen_from);
        assert_eq!(Location::default().host(), None);
    }
}
