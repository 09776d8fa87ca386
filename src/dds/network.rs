//! From the interfaces that a user names to the addresses that the DDS library wants.

use std::net::{IpAddr, Ipv4Addr};

use nix::ifaddrs::{InterfaceAddress, getifaddrs};

use super::error::DdsError;
use crate::config::NetworkSelector;

/// The addresses of the interfaces asked for; empty when none was asked for, which means all.
pub(super) fn addresses(asked: &[NetworkSelector]) -> Result<Vec<IpAddr>, DdsError> {
    if asked.is_empty() {
        return Ok(Vec::new());
    }
    select(asked, &host_interfaces()?)
}

fn host_interfaces() -> Result<Vec<(String, Ipv4Addr)>, DdsError> {
    Ok(interface_addresses()?
        .filter_map(|interface| {
            let address = interface.address?.as_sockaddr_in()?.ip();
            Some((interface.interface_name, address))
        })
        .collect())
}

/// The addresses of this host at present, of both families: what
/// [`Location::whereabouts`](crate::policy::Location::whereabouts) compares with. They change when a network
/// is joined or left.
///
/// # Errors
/// The kernel does not list them.
pub fn host_addresses() -> Result<Vec<IpAddr>, DdsError> {
    Ok(interface_addresses()?
        .filter_map(|interface| {
            let address = interface.address?;
            let v4 = address.as_sockaddr_in().map(|v4| IpAddr::V4(v4.ip()));
            v4.or_else(|| address.as_sockaddr_in6().map(|v6| IpAddr::V6(v6.ip())))
        })
        .collect())
}

fn interface_addresses() -> Result<impl Iterator<Item = InterfaceAddress>, DdsError> {
    getifaddrs().map_err(|errno| DdsError::Interfaces(errno.into()))
}

fn select(asked: &[NetworkSelector], present: &[(String, Ipv4Addr)]) -> Result<Vec<IpAddr>, DdsError> {
    let mut chosen = Vec::new();
    for selector in asked {
        let before = chosen.len();
        for (name, address) in present {
            let wanted = match selector {
                NetworkSelector::Name(wanted) => wanted == name,
                NetworkSelector::Address(wanted) => wanted == address,
            };
            if wanted && !chosen.contains(&IpAddr::V4(*address)) {
                chosen.push(IpAddr::V4(*address));
            }
        }
        let known = present.iter().any(|(name, address)| match selector {
            NetworkSelector::Name(wanted) => wanted == name,
            NetworkSelector::Address(wanted) => wanted == address,
        });
        if chosen.len() == before && !known {
            return Err(DdsError::NoSuchInterface {
                asked: match selector {
                    NetworkSelector::Name(name) => name.clone(),
                    NetworkSelector::Address(address) => address.to_string(),
                },
                present: present.iter().map(|(name, address)| format!("{name} {address}")).collect(),
            });
        }
    }
    Ok(chosen)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn host() -> Vec<(String, Ipv4Addr)> {
        vec![("lo".into(), Ipv4Addr::LOCALHOST), ("wlan0".into(), Ipv4Addr::new(192, 168, 0, 7))]
    }

    #[test]
    fn an_interface_is_found_by_name_and_by_address() {
        let by_name = select(&[NetworkSelector::Name("wlan0".into())], &host()).unwrap();
        let by_address = select(&[NetworkSelector::Address(Ipv4Addr::new(192, 168, 0, 7))], &host()).unwrap();
        assert_eq!(by_name, by_address);
        assert_eq!(by_name, [IpAddr::V4(Ipv4Addr::new(192, 168, 0, 7))]);
    }

    #[test]
    fn an_unknown_interface_is_an_error_that_lists_the_known_ones() {
        let error = select(&[NetworkSelector::Name("eth9".into())], &host()).unwrap_err().to_string();
        assert!(error.contains("eth9") && error.contains("wlan0 192.168.0.7"), "{error}");
    }
}
