//! Hosts as network namespaces, each connected by a veth pair to a bridge in a separate namespace. Addresses,
//! ports and multicast are per host; the hosts share everything else with the machine.

use std::fs;
use std::net::Ipv4Addr;
use std::path::Path;
use std::process;

use super::stale::{self, NAMESPACES};
use super::{Bed, Host, Network};
use crate::error::EvalError;
use crate::impairment::system;
use crate::scenario::Switch;

/// Setting of the current network namespace: whether packets through its bridges pass netfilter.
const BRIDGE_NETFILTER: &str = "/proc/sys/net/bridge/bridge-nf-call-iptables";

/// Command with which a user without privileges becomes root in a user namespace in which `ip` can create
/// network namespaces.
const AS_USER: &str = "unshare --user --map-root-user --net --mount sh -c \
                       'mount -t tmpfs none /run && adaptive-bridge-eval ...'";

/// Why this machine cannot create such a bed; `None` when it can.
pub(super) fn missing(switch: Switch) -> Option<String> {
    if !nix::unistd::geteuid().is_root() {
        return Some(format!("network namespaces need root; root of a user namespace is enough: {AS_USER}"));
    }
    let probe = stale::name("probe");
    let created = ip(&format!("netns add {probe}"));
    stale::remove_namespace(&probe);
    if let Err(error) = created {
        return Some(format!("network namespaces cannot be created: {error}"));
    }
    let lacks = switch == Switch::Reassembling && !Path::new(BRIDGE_NETFILTER).exists();
    lacks.then(|| "the kernel has no bridge netfilter: modprobe br_netfilter".to_owned())
}

/// Removes the namespaces of this process when it is dropped, even if the bed is incomplete.
struct Remover;

impl Drop for Remover {
    fn drop(&mut self) {
        stale::remove_namespaces(process::id());
    }
}

/// Creates the hosts and connects them to the switch. If the switch reassembles fragments, the sender is
/// connected through a second, plain switch: packets lost there leave incomplete datagrams at the first one.
pub(super) fn make(names: &[String], sender: &str, switch: Switch) -> Result<Bed, EvalError> {
    let remover = Remover;
    let between = stale::name("switch");
    make_switch(&between)?;
    let network = network(&between);
    set_bridge_netfilter(&network, switch == Switch::Reassembling)?;
    if switch == Switch::Reassembling {
        // A rule that matches connections enables connection tracking in this namespace.
        network.run("iptables -w 5 -A FORWARD -m conntrack --ctstate ESTABLISHED -j ACCEPT")?;
    }
    let mut hosts = Vec::with_capacity(names.len());
    for (index, name) in (0_u8..).zip(names) {
        let namespace = stale::name(name);
        let port = format!("p{index}");
        let address = Ipv4Addr::new(10, 77, 0, index.saturating_add(1));
        ip(&format!("netns add {namespace}"))?;
        let uplink = if switch == Switch::Reassembling && name == sender {
            let uplink = stale::name("uplink");
            make_uplink(&uplink)?;
            ip(&format!("link add {port} netns {between} type veth peer name u0 netns {uplink}"))?;
            ip(&format!("-n {uplink} link set u0 master br0 up"))?;
            ip(&format!("link add u1 netns {uplink} type veth peer name eth0 netns {namespace}"))?;
            ip(&format!("-n {uplink} link set u1 master br0 up"))?;
            Some(self::network(&uplink))
        } else {
            ip(&format!("link add {port} netns {between} type veth peer name eth0 netns {namespace}"))?;
            None
        };
        ip(&format!("-n {between} link set {port} master br0 up"))?;
        ip(&format!("-n {namespace} link set lo up"))?;
        ip(&format!("-n {namespace} addr add {address}/24 dev eth0"))?;
        ip(&format!("-n {namespace} link set eth0 up"))?;
        ip(&format!("-n {namespace} route add 239.0.0.0/8 dev eth0"))?;
        let network = self::network(&namespace);
        let entry = network.entry();
        hosts.push(Host { name: name.clone(), address, entry, network, port, uplink });
    }
    Ok(Bed { hosts, switch: network, _remover: Box::new(remover) })
}

fn make_switch(namespace: &str) -> Result<(), EvalError> {
    ip(&format!("netns add {namespace}"))?;
    ip(&format!("-n {namespace} link add br0 type bridge mcast_snooping 0"))?;
    ip(&format!("-n {namespace} link set br0 up"))
}

/// Creates a switch whose packets pass netfilter without connection tracking, so that each fragment stays a
/// separate packet.
fn make_uplink(namespace: &str) -> Result<(), EvalError> {
    make_switch(namespace)?;
    set_bridge_netfilter(&network(namespace), true)
}

fn set_bridge_netfilter(network: &Network, on: bool) -> Result<(), EvalError> {
    network.within(|| {
        // Without the kernel module, bridge netfilter is off.
        if !on && !Path::new(BRIDGE_NETFILTER).exists() {
            return Ok(());
        }
        let value = if on { "1" } else { "0" };
        fs::write(BRIDGE_NETFILTER, value).map_err(|error| EvalError::file(BRIDGE_NETFILTER.as_ref(), &error))
    })
}

fn network(namespace: &str) -> Network {
    Network::new(Path::new(NAMESPACES).join(namespace))
}

fn ip(arguments: &str) -> Result<(), EvalError> {
    system::run(&system::words(&format!("ip {arguments}")))?;
    Ok(())
}
