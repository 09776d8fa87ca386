//! Checks of socket buffers, network interfaces and multicast.

use std::net::{Ipv4Addr, UdpSocket};

use nix::ifaddrs::getifaddrs;
use nix::net::if_::InterfaceFlags;

use super::{Finding, Severity, list, number};
use crate::config::{NetworkSelector, Settings};

/// Socket buffer for a burst of one large sample. The fragments of a 1 MiB sample all arrive with this size;
/// with the kernel's default of 208 KiB, DDS needed milliseconds to retransmit dropped ones.
const BUFFER_BYTES: i64 = 4 << 20;

/// The largest sample for which the kernel's default buffers suffice at the rates of a robot.
const SMALL_SAMPLE_BYTES: usize = 64 << 10;

/// The multicast address and port on which RTPS participants announce themselves.
const SPDP: (Ipv4Addr, u16) = (Ipv4Addr::new(239, 255, 0, 1), 7400);

pub(super) fn check(settings: &Settings) -> Vec<Finding> {
    let largest = settings.routes.iter().map(|route| route.max_sample_bytes).max().unwrap_or(0);
    let mut findings = Vec::new();
    for name in ["rmem_max", "wmem_max", "rmem_default"] {
        findings
            .extend(number(&format!("/proc/sys/net/core/{name}")).map(|bytes| buffer(name, bytes, largest)));
    }
    let networks = settings.lanes.iter().map(|lane| &lane.network).chain([&settings.input]);
    let mut selectors: Vec<&NetworkSelector> = networks.flat_map(|network| &network.interfaces).collect();
    selectors.sort_by_key(|selector| format!("{selector:?}"));
    selectors.dedup();
    let interfaces = interfaces();
    findings.extend(selectors.iter().map(|selector| selected(selector, &interfaces)));
    findings.push(any_multicast(&interfaces));
    let routed = UdpSocket::bind((Ipv4Addr::UNSPECIFIED, 0)).and_then(|socket| socket.connect(SPDP)).is_ok();
    findings.push(multicast_route(routed, &interfaces));
    findings
}

fn buffer(name: &'static str, bytes: i64, largest_sample: usize) -> Finding {
    let found = format!("net.core.{name} is {bytes}");
    if bytes >= BUFFER_BYTES {
        return Finding::ok(name, found);
    }
    let severity = if largest_sample <= SMALL_SAMPLE_BYTES { Severity::Note } else { Severity::Warning };
    let means = match name {
        "rmem_default" => {
            "Nodes on Fast DDS have this receive buffer, and lose part of each large sample; its repair takes \
             milliseconds. Nodes that run already keep theirs."
        }
        _ => {
            "The kernel drops fragments of large samples in a burst; their retransmission takes milliseconds."
        }
    };
    Finding::new(name, severity, found).means(means).with_command(format!(
        "echo net.core.{name}={BUFFER_BYTES} | sudo tee -a /etc/sysctl.d/60-adaptive-bridge.conf \
         && sudo sysctl --system"
    ))
}

#[derive(Clone, Debug)]
struct Interface {
    name: String,
    address: Option<Ipv4Addr>,
    flags: InterfaceFlags,
}

impl Interface {
    fn carries_multicast(&self) -> bool {
        self.flags.contains(InterfaceFlags::IFF_UP | InterfaceFlags::IFF_MULTICAST)
    }
}

fn interfaces() -> Vec<Interface> {
    let addresses = getifaddrs().into_iter().flatten();
    let interfaces = addresses.map(|found| Interface {
        name: found.interface_name,
        address: found.address.and_then(|address| address.as_sockaddr_in().map(|address| address.ip())),
        flags: found.flags,
    });
    interfaces.collect()
}

fn selected(selector: &NetworkSelector, interfaces: &[Interface]) -> Finding {
    let (name, found): (String, Option<&Interface>) = match selector {
        NetworkSelector::Name(name) => {
            let mut named = interfaces.iter().filter(|interface| interface.name == *name);
            let with_address = named.clone().find(|interface| interface.address.is_some());
            (name.clone(), with_address.or_else(|| named.next()))
        }
        NetworkSelector::Address(address) => {
            (address.to_string(), interfaces.iter().find(|interface| interface.address == Some(*address)))
        }
    };
    let check = "interface";
    let Some(Interface { name: own_name, address, flags }) = found else {
        return Finding::error(
            check,
            format!("no interface {name}; this machine has: {}", names(interfaces)),
        )
        .means("A process that is configured to use it does not start.");
    };
    if !flags.contains(InterfaceFlags::IFF_UP) {
        return Finding::error(check, format!("{name} is down"))
            .means("No DDS participants are discovered on it.")
            .with_command(format!("sudo ip link set {own_name} up"));
    }
    if address.is_none() {
        return Finding::error(check, format!("{name} has no IPv4 address"))
            .means("No DDS participants are discovered on it.");
    }
    if !flags.contains(InterfaceFlags::IFF_MULTICAST) {
        return Finding::error(check, format!("{name} carries no multicast"))
            .means(
                "DDS participants announce themselves by multicast, so none are discovered there, except \
                 those of `static_peers`.",
            )
            .with_command(format!("sudo ip link set {own_name} multicast on"));
    }
    Finding::ok(check, format!("{name} is up"))
}

fn names(interfaces: &[Interface]) -> String {
    let mut names: Vec<&str> = interfaces.iter().map(|interface| interface.name.as_str()).collect();
    names.sort_unstable();
    names.dedup();
    list(names)
}

fn any_multicast(interfaces: &[Interface]) -> Finding {
    let carrying = interfaces.iter().filter(|found| found.carries_multicast() && found.address.is_some());
    let carrying: Vec<Interface> = carrying.cloned().collect();
    if carrying.is_empty() {
        return Finding::warning("multicast", "no interface that is up and has an address carries multicast")
            .means("DDS participants on other machines are not discovered.")
            .with_command("sudo ip link set lo multicast on");
    }
    Finding::ok("multicast", format!("carried by {}", names(&carrying)))
}

/// Checks that the routing table has a route for announcements.
fn multicast_route(routed: bool, interfaces: &[Interface]) -> Finding {
    if routed {
        return Finding::ok("multicast route", format!("there is a route to {}", SPDP.0));
    }
    let carrying = interfaces.iter().find(|found| found.carries_multicast() && found.address.is_some());
    let through = carrying.map_or("eth0", |interface| interface.name.as_str());
    Finding::warning("multicast route", format!("there is no route to {}", SPDP.0))
        .means(
            "Announcements that are not bound to an interface are not sent, so no DDS participants are \
         discovered.",
        )
        .with_command(format!("sudo ip route add 239.0.0.0/8 dev {through}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn interface(name: &str, address: Option<[u8; 4]>, flags: InterfaceFlags) -> Interface {
        Interface { name: name.to_owned(), address: address.map(Ipv4Addr::from), flags }
    }

    #[test]
    fn small_buffers_matter_as_far_as_samples_are_large() {
        assert_eq!(buffer("rmem_max", 4 << 20, 1 << 20).severity, Severity::Ok);
        assert_eq!(buffer("rmem_max", 212_992, 1 << 20).severity, Severity::Warning);
        assert_eq!(buffer("wmem_max", 212_992, 3_000).severity, Severity::Note);
        assert_eq!(buffer("rmem_default", 212_992, 1 << 20).severity, Severity::Warning);
    }

    #[test]
    fn the_package_raises_the_limits_that_are_checked_and_no_default() {
        let file = include_str!("../../../systemd/sysctl.d/00-adaptive-bridge.conf");
        let set: Vec<&str> = file.lines().filter(|line| !line.starts_with('#') && !line.is_empty()).collect();
        let expected = ["rmem_max", "wmem_max"].map(|name| format!("net.core.{name}={BUFFER_BYTES}"));
        assert_eq!(set, expected);
        // A file of that name in /etc/sysctl.d replaces the package's as a whole.
        let command = buffer("rmem_default", 212_992, 0).command.unwrap();
        assert!(!command.contains("00-adaptive-bridge.conf"), "{command}");
    }

    #[test]
    fn an_interface_must_be_there_up_addressed_and_carry_multicast() {
        let good = InterfaceFlags::IFF_UP | InterfaceFlags::IFF_MULTICAST;
        let all = [
            interface("eth0", None, good),
            interface("eth0", Some([10, 0, 0, 1]), good),
            interface("wlan0", Some([10, 0, 1, 1]), InterfaceFlags::IFF_MULTICAST),
            interface("tun0", Some([10, 0, 2, 1]), InterfaceFlags::IFF_UP),
            interface("eth1", None, good),
        ];
        let of = |selector: &str| selected(&NetworkSelector::parse(selector).unwrap(), &all);
        assert_eq!(of("eth0").severity, Severity::Ok);
        assert_eq!(of("10.0.0.1").severity, Severity::Ok);
        for (selector, found) in [
            ("eth9", "no interface"),
            ("10.9.9.9", "no interface"),
            ("wlan0", "down"),
            ("tun0", "no multicast"),
            ("eth1", "no IPv4"),
        ] {
            let finding = of(selector);
            assert!(finding.severity == Severity::Error && finding.found.contains(found), "{finding:?}");
        }
        assert_eq!(any_multicast(&all).found, "carried by eth0");
        assert_eq!(any_multicast(&all[3..]).severity, Severity::Warning);
        assert!(multicast_route(false, &all).command.unwrap().ends_with("dev eth0"));
    }
}
