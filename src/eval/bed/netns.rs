//! Hosts as network namespaces: each with its own addresses, ports and multicast, on veth pairs to a bridge
//! in a namespace of its own. They share all else with the machine.

use std::fs;
use std::net::Ipv4Addr;
use std::path::Path;
use std::process;

use super::stale::{self, NAMESPACES};
use super::{Bed, Host, Network};
use crate::eval::error::EvalError;
use crate::eval::impairment::system;
use crate::eval::scenario::Switch;

/// Whether what passes a bridge of the present network namespace goes through netfilter.
const BRIDGE_NETFILTER: &str = "/proc/sys/net/bridge/bridge-nf-call-iptables";

/// How a user without rights gets a namespace of its own in which it is root, and where `ip` may keep others.
const AS_USER: &str = "unshare --user --map-root-user --net --mount sh -c \
                       'mount -t tmpfs none /run && adaptive-bridge-eval ...'";

/// Why this machine can't; `None` when it can.
pub(super) fn missing(switch: Switch) -> Option<String> {
    if !nix::unistd::geteuid().is_root() {
        return Some(format!("network namespaces need root, if only that of a user namespace: {AS_USER}"));
    }
    let probe = stale::name("probe");
    let made = ip(&format!("netns add {probe}"));
    stale::remove_namespace(&probe);
    if let Err(error) = made {
        return Some(format!("network namespaces can't be made: {error}"));
    }
    let lacks = switch == Switch::Reassembling && !Path::new(BRIDGE_NETFILTER).exists();
    lacks.then(|| "the kernel has no bridge netfilter: modprobe br_netfilter".to_owned())
}

/// Removes what this process has made, whole or not.
struct Remover;

impl Drop for Remover {
    fn drop(&mut self) {
        stale::remove_namespaces(process::id());
    }
}

/// Makes the hosts, all connected at once. Where the switch puts fragments together, the cable of the sender
/// leads through a second, plain one: what is lost there leaves incomplete datagrams to the switch.
pub(super) fn make(names: &[String], sender: &str, switch: Switch) -> Result<Bed, EvalError> {
    let remover = Remover;
    let between = stale::name("switch");
    make_switch(&between)?;
    let network = network(&between);
    set_bridge_netfilter(&network, switch == Switch::Reassembling)?;
    if switch == Switch::Reassembling {
        // A rule that asks for a connection begins connection tracking in this namespace.
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

/// A switch whose packets go through netfilter, without connection tracking: each fragment still is a packet.
fn make_uplink(namespace: &str) -> Result<(), EvalError> {
    make_switch(namespace)?;
    set_bridge_netfilter(&network(namespace), true)
}

fn set_bridge_netfilter(network: &Network, on: bool) -> Result<(), EvalError> {
    network.within(|| {
        // Where there is none, there is nothing to be switched off.
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
