//! Whether a DDS endpoint is on this host.

// Addresses only: `core::net` has no sockets.
use core::net::IpAddr;

/// What is known of where an endpoint is.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Location {
    /// Where the last datagram of its participant came from; `None` when none came from the participant
    /// itself, because a discovery server passed on what it announces, say.
    pub seen_from: Option<IpAddr>,
    /// Where it says that it receives unicast over UDP.
    pub announced: Vec<IpAddr>,
}

/// Where an endpoint is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Whereabouts {
    /// On this host.
    Local,
    /// On another one.
    Remote,
    /// Nothing says.
    Unknown,
}

impl Location {
    /// Whether that is here, on the host whose interfaces have the addresses `own`.
    ///
    /// The sender of the participant's datagrams decides if it is known: the kernel sends what stays on a
    /// host from an address of that host, and lets nothing in that claims one. What is announced decides
    /// otherwise, and is weaker evidence:
    /// - 127.0.0.1 says nothing beside other addresses, for some libraries announce it to all. Alone it means
    ///   that only this host is served.
    /// - An address of ours means here, as long as it is not one that many hosts have, such as 172.17.0.1,
    ///   the default of Docker's bridge: a robot and a laptop that both have it look alike.
    /// - A node that announces an address which its host had once is not taken for another host's if it
    ///   announces a present one too.
    ///
    /// A container that shares the host's network is this host. One with a network of its own is another:
    /// what it receives crosses a virtual switch, and nothing tells that from a real one. Shared-memory
    /// locators are no addresses: an endpoint with these alone is unknown, and can't be remote.
    pub fn whereabouts(&self, own: &[IpAddr]) -> Whereabouts {
        let is_here = |address: &IpAddr| {
            let address = address.to_canonical();
            address.is_loopback() || own.iter().any(|own| own.to_canonical() == address)
        };
        if let Some(source) = &self.seen_from {
            return if is_here(source) { Whereabouts::Local } else { Whereabouts::Remote };
        }
        let mut telling = self.telling().peekable();
        if telling.peek().is_some() {
            if telling.any(|address| is_here(&address)) { Whereabouts::Local } else { Whereabouts::Remote }
        } else if self.announced.iter().any(|address| address.to_canonical().is_loopback()) {
            Whereabouts::Local
        } else {
            Whereabouts::Unknown
        }
    }

    /// The address by which to name the host: where its datagrams come from, or else the first that it
    /// announces and that tells hosts apart.
    pub fn host(&self) -> Option<IpAddr> {
        self.seen_from.map(|source| source.to_canonical()).or_else(|| self.telling().next())
    }

    /// The announced addresses that belong to one host or another.
    fn telling(&self) -> impl Iterator<Item = IpAddr> {
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

    fn place(seen_from: Option<&str>, announced: &[&str]) -> Whereabouts {
        let own =
            addresses(&["127.0.0.1", "10.0.0.5", "192.168.1.5", "172.17.0.1", "fe80::5", "2001:db8::5"]);
        let seen_from = seen_from.map(|text| text.parse().unwrap());
        Location { seen_from, announced: addresses(announced) }.whereabouts(&own)
    }

    #[test]
    fn the_sender_of_the_datagrams_decides() {
        for here in
            ["127.0.0.1", "127.0.1.1", "10.0.0.5", "192.168.1.5", "2001:db8::5", "::1", "::ffff:10.0.0.5"]
        {
            assert_eq!(place(Some(here), &["192.168.1.9"]), Whereabouts::Local, "{here}");
        }
        // A laptop with Docker, as the robot has it, and a library that announces 127.0.0.1.
        let laptop = place(Some("192.168.1.9"), &["127.0.0.1", "192.168.1.9", "172.17.0.1"]);
        assert_eq!(laptop, Whereabouts::Remote);
        assert_eq!(place(Some("2001:db8::9"), &[]), Whereabouts::Remote);
    }

    #[test]
    fn what_is_announced_decides_otherwise() {
        assert_eq!(place(None, &["10.0.0.5"]), Whereabouts::Local);
        assert_eq!(place(None, &["10.0.0.77", "192.168.1.5"]), Whereabouts::Local, "it had 10.0.0.77 once");
        assert_eq!(place(None, &["127.0.0.1"]), Whereabouts::Local);
        assert_eq!(place(None, &["10.0.0.9", "192.168.1.9"]), Whereabouts::Remote);
        assert_eq!(place(None, &["127.0.0.1", "10.0.0.9"]), Whereabouts::Remote);
        assert_eq!(place(None, &["::1", "2001:db8::9"]), Whereabouts::Remote);
        assert_eq!(place(None, &["2001:db8::5"]), Whereabouts::Local);
        // A container on a bridge of this host.
        assert_eq!(place(None, &["172.17.0.2"]), Whereabouts::Remote);
    }

    #[test]
    fn without_an_address_nothing_is_known() {
        assert_eq!(place(None, &[]), Whereabouts::Unknown);
        assert_eq!(place(None, &["0.0.0.0", "239.255.0.1", "::"]), Whereabouts::Unknown);
    }

    #[test]
    fn a_host_is_named_by_an_address_that_is_its_own() {
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
