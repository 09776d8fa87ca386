//! Network interfaces: the configured ones, as the DDS library takes them, and those that the host has.

use std::net::{IpAddr, Ipv4Addr};

use nix::ifaddrs::{InterfaceAddress, getifaddrs};
use nix::net::if_::InterfaceFlags;
use nix::sys::socket::SockaddrStorage;

use super::error::DdsError;
use super::rustdds;
use crate::config::NetworkSelector;
use crate::policy::HostInterface;

/// Converts the configured interfaces to selectors of RustDDS.
pub(super) fn selectors(asked: &[NetworkSelector]) -> impl Iterator<Item = rustdds::NetworkSelector> {
    asked.iter().map(|selector| match selector {
        NetworkSelector::Name(name) => rustdds::NetworkSelector::Name(name.clone()),
        NetworkSelector::Address(address) => rustdds::NetworkSelector::Address(IpAddr::V4(*address)),
    })
}

/// A message for each configured interface that has no IPv4 address at present.
///
/// # Errors
/// The kernel cannot list the interfaces.
pub(super) fn absent_interfaces(asked: &[NetworkSelector]) -> Result<Vec<String>, DdsError> {
    if asked.is_empty() {
        return Ok(Vec::new());
    }
    let present = interface_addresses()?.filter_map(|interface| {
        let address = interface.address?.as_sockaddr_in()?.ip();
        Some((interface.interface_name, address))
    });
    Ok(absent(asked, &present.collect::<Vec<_>>()))
}

/// The IPv4 and IPv6 addresses of this host at present, with which
/// [`Location::locality`](crate::policy::Location::locality) compares. They change when the host joins
/// or leaves a network.
///
/// # Errors
/// The kernel cannot list the interfaces.
pub fn host_addresses() -> Result<Vec<IpAddr>, DdsError> {
    Ok(interface_addresses()?
        .filter_map(|interface| {
            let address = interface.address?;
            let v4 = address.as_sockaddr_in().map(|v4| IpAddr::V4(v4.ip()));
            v4.or_else(|| address.as_sockaddr_in6().map(|v6| IpAddr::V6(v6.ip())))
        })
        .collect())
}

/// The interfaces of this host at present: one entry for each IPv4 address, and one for each interface
/// without an IPv4 address.
///
/// # Errors
/// The kernel cannot list the interfaces.
pub fn interfaces() -> Result<Vec<HostInterface>, DdsError> {
    let mut interfaces: Vec<HostInterface> = Vec::new();
    for listed in interface_addresses()? {
        let v4 = |address: Option<SockaddrStorage>| Some(address?.as_sockaddr_in()?.ip());
        let address = v4(listed.address).zip(v4(listed.netmask));
        let name = listed.interface_name;
        // The kernel lists an interface once for each of its addresses, of any family.
        let place = interfaces.iter().position(|known| known.name == name && known.address.is_none());
        match place {
            Some(place) if address.is_some() => interfaces[place].address = address,
            _ if address.is_none() && interfaces.iter().any(|known| known.name == name) => {}
            _ => {
                let running = InterfaceFlags::IFF_UP | InterfaceFlags::IFF_RUNNING;
                let has_link = listed.flags.contains(running);
                interfaces.push(HostInterface { name, address, has_link });
            }
        }
    }
    Ok(interfaces)
}

fn interface_addresses() -> Result<impl Iterator<Item = InterfaceAddress>, DdsError> {
    getifaddrs().map_err(|errno| DdsError::Interfaces(errno.into()))
}

fn absent(asked: &[NetworkSelector], present: &[(String, Ipv4Addr)]) -> Vec<String> {
    let is_absent = |selector: &&NetworkSelector| {
        !present.iter().any(|(name, address)| match selector {
            NetworkSelector::Name(wanted) => wanted == name,
            NetworkSelector::Address(wanted) => wanted == address,
        })
    };
    let has: Vec<String> = present.iter().map(|(name, address)| format!("{name} {address}")).collect();
    let message = |selector: &NetworkSelector| {
        format!(
            "network interface {selector} is not on this host or has no IPv4 address; it is used as soon as \
             it has one; the host has: {}",
            has.join(", ")
        )
    };
    asked.iter().filter(is_absent).map(message).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn host() -> Vec<(String, Ipv4Addr)> {
        vec![("lo".into(), Ipv4Addr::LOCALHOST), ("wlan0".into(), Ipv4Addr::new(192, 168, 0, 7))]
    }

    #[test]
    fn an_interface_that_the_host_has_by_name_or_address_is_not_absent() {
        let asked =
            [NetworkSelector::Name("wlan0".into()), NetworkSelector::Address(Ipv4Addr::new(192, 168, 0, 7))];
        assert_eq!(absent(&asked, &host()), Vec::<String>::new());
    }

    #[test]
    fn the_message_names_the_absent_interface_and_those_of_the_host() {
        let absent = absent(&[NetworkSelector::Name("eth9".into())], &host());
        assert_eq!(absent.len(), 1);
        let text = &absent[0];
        assert!(text.contains("eth9") && text.contains("wlan0 192.168.0.7"), "{text}");
    }
}
