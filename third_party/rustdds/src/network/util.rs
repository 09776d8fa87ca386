use std::{
  cell::RefCell,
  collections::{BTreeSet, HashMap},
  io,
  net::{IpAddr, Ipv4Addr, SocketAddr},
  time::{Duration, Instant},
};

use log::error;

use crate::{
  rtps::{
    constant::{payload_budget_for_mtu, FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE},
    transmit::InterfaceSelector,
  },
  structure::locator::Locator,
};

/// A network interface that a participant uses.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum NetworkSelector {
  /// The interface of this name, with the addresses that it has at the time.
  Name(String),
  /// The interface that has this address at the time.
  Address(IpAddr),
}

/// Whether a participant with these networks uses the address. `None` is all.
pub(crate) fn is_selected(ifa: &IfAddr, only_networks: Option<&[NetworkSelector]>) -> bool {
  if !ifa.has_run && !ifa.is_loopback {
    return false;
  }
  only_networks.is_none_or(|selectors| {
    selectors.iter().any(|selector| match selector {
      NetworkSelector::Name(name) => *name == ifa.name,
      NetworkSelector::Address(ip) => *ip == ifa.ip,
    })
  })
}

/// Platform-neutral view of one network-interface address.
///
/// [`netdev`] gives us a single cross-platform enumeration; we normalize its
/// per-interface data into this small struct (one entry per assigned IP). The
/// inner helper functions then operate on `IfAddr` alone, which keeps them free
/// of any enumeration dependency and makes them trivially unit-testable.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct IfAddr {
  /// Name of the interface, such as `wlan0`.
  pub name: String,
  /// An IP address bound to the interface.
  pub ip: IpAddr,
  /// OS interface index. `0` when unknown / not applicable.
  pub index: u32,
  pub is_loopback: bool,
  /// Whether the interface is up and has a carrier.
  pub is_running: bool,
  /// Whether it is running, or was at a former enumeration. One that has never had a carrier,
  /// such as `docker0` without containers, is neither announced nor used for multicast: Fast DDS
  /// takes its address for that of another host, and sends each sample twice.
  pub has_run: bool,
  /// Whether the interface is multicast-capable.
  pub is_multicast: bool,
  /// IPv4 subnet mask for `ip` (only populated for IPv4 addresses). Used to
  /// decide whether a peer is on the same subnet (i.e. reachable in one hop).
  pub netmask: Option<Ipv4Addr>,
  /// Interface MTU in bytes, when the OS reports it. Drives the per-peer
  /// datagram-payload budget for same-subnet peers.
  pub mtu: Option<u32>,
}

// ---------------------------------------------------------------------------
// Interface enumeration (cross-platform, via netdev)
// ---------------------------------------------------------------------------

/// Enumerate all interface addresses across platforms using [`netdev`].
///
/// `netdev::get_interfaces()` yields one [`netdev::Interface`] per interface
/// with its index, MTU, loopback/multicast flags and the list of assigned
/// IPv4/IPv6 prefixes. We flatten this into one [`IfAddr`] per assigned IP so
/// the existing locator/multicast/ifindex helpers keep working unchanged, while
/// the new fields (`netmask`, `mtu`) enable per-peer path-MTU resolution.
///
/// This is infallible in practice (netdev returns an empty list rather than an
/// error), but the signature is kept as `io::Result` for API compatibility with
/// the previous per-platform implementations.
fn enumerate_interfaces() -> io::Result<Vec<IfAddr>> {
  let mut result = Vec::new();

  for iface in netdev::get_interfaces() {
    let index = iface.index;
    let is_loopback = iface.is_loopback();
    let is_multicast = iface.is_multicast();
    let mtu = iface.mtu;
    let is_running = iface.is_running();
    let name = iface.name;

    for net in &iface.ipv4 {
      result.push(IfAddr {
        name: name.clone(),
        ip: IpAddr::V4(net.addr()),
        index,
        is_loopback,
        is_running,
        has_run: is_running,
        is_multicast,
        netmask: Some(net.netmask()),
        mtu,
      });
    }
    for net in &iface.ipv6 {
      result.push(IfAddr {
        name: name.clone(),
        ip: IpAddr::V6(net.addr()),
        index,
        is_loopback,
        is_running,
        has_run: is_running,
        is_multicast,
        // IPv4-only subnet matching for now; IPv6 peers fall back to default.
        netmask: None,
        mtu,
      });
    }
  }

  Ok(result)
}

// ---------------------------------------------------------------------------
// Per-peer path-MTU resolution
// ---------------------------------------------------------------------------

/// How long an enumeration is valid. A participant that starts asks four times, and each enumeration reads
/// some 80 files (1 to 2 ms).
const ENUMERATION_VALID: Duration = Duration::from_millis(10);

/// Snapshot of the local interface table, used by writers to resolve a per-peer
/// datagram budget. Built once (and refreshed on interface-set changes) and
/// shared with each `Writer` via the event loop.
pub fn local_interface_table() -> Vec<IfAddr> {
  // Of each thread, as threads may be in different network namespaces.
  thread_local!(static LAST: RefCell<Option<(Instant, Vec<IfAddr>)>> = const { RefCell::new(None) });
  LAST.with_borrow_mut(|last| recent(last, Instant::now(), enumerated_table))
}

/// What `enumerate` has returned, or returns now if that was too long ago.
fn recent<T: Clone>(
  last: &mut Option<(Instant, T)>,
  now: Instant,
  enumerate: impl FnOnce() -> T,
) -> T {
  if let Some((at, table)) = last {
    if now.saturating_duration_since(*at) < ENUMERATION_VALID {
      return table.clone();
    }
  }
  let table = enumerate();
  *last = Some((now, table.clone()));
  table
}

fn enumerated_table() -> Vec<IfAddr> {
  match enumerate_interfaces() {
    Ok(ifaces) => ifaces,
    Err(e) => {
      error!("Cannot enumerate local interfaces for path-MTU resolution: {e:?}");
      Vec::new()
    }
  }
}

/// Enumerates the interfaces, `former` being those of the time before. One that has run and lost its
/// carrier stays announced: a peer that discovers this participant when the link returns has to
/// learn its address there.
pub(crate) fn local_interfaces_after(former: &[IfAddr]) -> Vec<IfAddr> {
  with_former(local_interface_table(), former)
}

fn with_former(mut interfaces: Vec<IfAddr>, former: &[IfAddr]) -> Vec<IfAddr> {
  for ifa in &mut interfaces {
    let is_same = |known: &IfAddr| known.name == ifa.name && known.ip == ifa.ip;
    ifa.has_run |= former.iter().any(|known| known.has_run && is_same(known));
  }
  interfaces
}

/// Resolve the per-peer UDP-payload budget (bytes available for RTPS
/// submessages in one datagram) for `peer_ip`, using the "local
/// egress-interface MTU" heuristic:
///
/// * If `peer_ip` is an address of this host, the kernel delivers over the
///   loopback interface whatever interface has the address, so we use that
///   one's MTU. A remote host may have the same private address (that of
///   `docker0`, say) beside others; the caller takes the least of all budgets.
/// * If some local IPv4 interface's subnet contains `peer_ip`, the peer is
///   reachable in one hop, so we use that interface's MTU (minus headers).
///   Loopback peers (e.g. `127.0.0.1`) naturally match `lo`/`lo0` and inherit
///   its (often large) MTU.
/// * Otherwise the peer is behind a router (or IPv6 / unresolved), where the
///   real path MTU is unknown; fall back to
///   [`FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE`] (a conservative
///   ~1500-byte-Ethernet budget).
///
/// An overestimate is a soft failure (IP fragmentation), never data loss, so
/// this errs toward the safe default when unsure.
pub fn path_mtu_payload_for_peer(ifaces: &[IfAddr], peer_ip: IpAddr) -> usize {
  if ifaces.iter().any(|ifa| ifa.ip == peer_ip) {
    let loopback = ifaces.iter().find(|ifa| ifa.ip.is_loopback());
    if let Some(mtu) = loopback.and_then(|ifa| ifa.mtu) {
      return payload_budget_for_mtu(mtu);
    }
  }
  if let IpAddr::V4(peer) = peer_ip {
    for ifa in ifaces {
      let (IpAddr::V4(local), Some(mask)) = (ifa.ip, ifa.netmask) else {
        continue;
      };
      if same_subnet_v4(local, mask, peer) {
        if let Some(mtu) = ifa.mtu {
          return payload_budget_for_mtu(mtu);
        }
        // Same subnet but MTU unknown: keep scanning in case another matching
        // interface reports one; otherwise we fall through to the default.
      }
    }
  }
  FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE
}

/// True when `local` and `peer` share the IPv4 subnet defined by `mask`.
fn same_subnet_v4(local: Ipv4Addr, mask: Ipv4Addr, peer: Ipv4Addr) -> bool {
  let m = u32::from(mask);
  (u32::from(local) & m) == (u32::from(peer) & m)
}

// ---------------------------------------------------------------------------
// Public API
// ---------------------------------------------------------------------------

pub fn get_local_multicast_locators(port: u16) -> Vec<Locator> {
  let saddr = SocketAddr::new("239.255.0.1".parse().unwrap(), port);
  vec![Locator::from(saddr)]
}

/// Build the unicast "localhost SPDP peer" locators for same-host discovery.
///
/// Returns `127.0.0.1:spdp_well_known_unicast_port(domain_id, pid)` for every
/// `pid` in `0..max_participants`, skipping `own_participant_id` (there is no
/// need to announce to ourselves; multicast + the self reader-proxy already
/// cover that). Sending SPDP to these fixed destinations lets two participants
/// on the same host find each other with no external network and without
/// relying on loopback multicast. See
/// `src/rtps/loopback_same_host_design.md`.
pub fn localhost_spdp_peer_locators(
  domain_id: u16,
  own_participant_id: u16,
  max_participants: u16,
) -> Vec<Locator> {
  let others = (0..max_participants).filter(|pid| *pid != own_participant_id);
  others
    .map(|pid| spdp_peer_locator(Ipv4Addr::LOCALHOST, domain_id, pid))
    .collect()
}

/// Where participant `participant_id` of a host takes SPDP by unicast.
pub(crate) fn spdp_peer_locator(host: Ipv4Addr, domain_id: u16, participant_id: u16) -> Locator {
  let port = crate::network::constant::spdp_well_known_unicast_port(domain_id, participant_id);
  Locator::from(SocketAddr::new(IpAddr::V4(host), port))
}

/// The locators at which a listener with that port can be reached.
pub(crate) fn listener_locators(
  ifaces: &[IfAddr],
  port: u16,
  is_multicast: bool,
  only_networks: Option<&[NetworkSelector]>,
) -> Vec<Locator> {
  if !is_multicast {
    get_local_unicast_locators_inner(ifaces, port, only_networks)
  } else if get_local_multicast_ip_addrs_inner(ifaces, only_networks).is_empty() {
    Vec::new()
  } else {
    get_local_multicast_locators(port)
  }
}

fn get_local_unicast_locators_inner(
  ifaces: &[IfAddr],
  port: u16,
  only_networks: Option<&[NetworkSelector]>,
) -> Vec<Locator> {
  ifaces
    .iter()
    // Our unicast transport (both `UDPListener` and the `UDPSender` unicast
    // socket) is IPv4-only, so an announced IPv6 locator is unreachable: peers
    // -- including our own participant, which discovers itself over multicast
    // loopback -- would try to send there and get EAFNOSUPPORT per datagram.
    // Link-local IPv6 is doubly useless, as a `Locator` carries no scope id.
    .filter(|ifa| ifa.ip.is_ipv4())
    // The loopback address whatever the networks are: announcements go to participants
    // on this host over it in any case, and these can answer when a network is away.
    .filter(|ifa| ifa.is_loopback || is_selected(ifa, only_networks))
    .map(|ifa| Locator::from(SocketAddr::new(ifa.ip, port)))
    .collect()
}

/// The IPv4 addresses of the interfaces that a participant uses for multicast.
pub(crate) fn get_local_multicast_ip_addrs_inner(
  ifaces: &[IfAddr],
  only_networks: Option<&[NetworkSelector]>,
) -> Vec<IpAddr> {
  ifaces
    .iter()
    .filter(|ifa| ifa.is_multicast)
    .filter(|ifa| is_selected(ifa, only_networks))
    .map(|ifa| ifa.ip)
    .filter(IpAddr::is_ipv4)
    .collect()
}

/// The indexes of the interfaces on which a participant joins multicast groups.
pub(crate) fn multicast_interface_indexes(
  ifaces: &[IfAddr],
  only_networks: Option<&[NetworkSelector]>,
) -> BTreeSet<u32> {
  ifaces
    .iter()
    .filter(|ifa| ifa.is_multicast && ifa.ip.is_ipv4() && is_selected(ifa, only_networks))
    .map(|ifa| ifa.index)
    .collect()
}

/// Builds a mapping from OS interface index to an [`InterfaceSelector`].
///
/// Used to resolve the `ipi_ifindex` reported by `IP_PKTINFO`/`IPV6_PKTINFO`
/// into the interface identity our sender uses (its IP). Prefers an IPv4
/// address so the result matches the keys of the multicast sender sockets.
pub(crate) fn build_ifindex_map_inner(ifaces: &[IfAddr]) -> HashMap<u32, InterfaceSelector> {
  let mut map: HashMap<u32, InterfaceSelector> = HashMap::new();
  for ifa in ifaces {
    if ifa.index == 0 {
      continue;
    }
    match map.get(&ifa.index) {
      // First address seen for this index.
      None => {
        map.insert(ifa.index, InterfaceSelector::Ip(ifa.ip));
      }
      // Prefer an IPv4 address over a previously stored non-IPv4 one, so the
      // result matches the (IPv4) multicast sender socket keys.
      Some(InterfaceSelector::Ip(existing)) if ifa.ip.is_ipv4() && !existing.is_ipv4() => {
        map.insert(ifa.index, InterfaceSelector::Ip(ifa.ip));
      }
      Some(_) => {}
    }
  }
  map
}

#[cfg(test)]
mod tests {
  use std::{
    net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr},
    time::{Duration, Instant},
  };

  use super::{
    build_ifindex_map_inner, get_local_multicast_ip_addrs_inner, get_local_unicast_locators_inner,
    listener_locators, multicast_interface_indexes, localhost_spdp_peer_locators, path_mtu_payload_for_peer, recent, with_former, IfAddr, InterfaceSelector, NetworkSelector,
  };
  use crate::{
    network::constant::spdp_well_known_unicast_port,
    rtps::constant::FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE, structure::locator::Locator,
  };

  fn v4(a: u8, b: u8, c: u8, d: u8) -> IpAddr {
    IpAddr::V4(Ipv4Addr::new(a, b, c, d))
  }

  fn iface(ip: IpAddr, index: u32, is_loopback: bool, is_multicast: bool) -> IfAddr {
    IfAddr {
      name: format!("if{index}"),
      ip,
      index,
      is_loopback,
      is_running: true,
      has_run: true,
      is_multicast,
      netmask: None,
      mtu: None,
    }
  }

  // Build an interface entry with an IPv4 subnet mask and MTU, for path-MTU
  // resolution tests.
  fn iface_v4(a: u8, b: u8, c: u8, d: u8, prefix: u8, mtu: u32, is_loopback: bool) -> IfAddr {
    let mask = if prefix == 0 {
      0u32
    } else {
      u32::MAX << (32 - u32::from(prefix))
    };
    IfAddr {
      name: "if1".to_string(),
      ip: v4(a, b, c, d),
      index: 1,
      is_loopback,
      is_running: true,
      has_run: true,
      is_multicast: !is_loopback,
      netmask: Some(Ipv4Addr::from(mask)),
      mtu: Some(mtu),
    }
  }

  #[test]
  fn an_enumeration_is_valid_for_a_moment() {
    let mut last = None;
    let start = Instant::now();
    let mut at = |ms, now| recent(&mut last, start + Duration::from_millis(ms), || now);
    assert_eq!([at(0, 1), at(9, 2), at(10, 3), at(19, 4), at(20, 5)], [1, 1, 3, 3, 5]);
  }

  #[test]
  fn test_get_local_multicast_ip_addrs() {
    let ifaces = vec![
      // loopback: not multicast-capable
      iface(IpAddr::V4(Ipv4Addr::LOCALHOST), 0, true, false),
      iface(IpAddr::V6(Ipv6Addr::LOCALHOST), 0, true, false),
      // eth0: multicast-capable, IPv4 + IPv6
      iface(v4(192, 168, 0, 137), 1, false, true),
      iface(
        IpAddr::V6(Ipv6Addr::new(0xfd73, 0x40a2, 0x1c3e, 0, 0, 0, 0, 0)),
        1,
        false,
        true,
      ),
    ];

    let ips = get_local_multicast_ip_addrs_inner(&ifaces, None);

    // Only IPv4 is currently supported for multicast enumeration.
    assert_eq!(ips.len(), 1, "should only contain the non-loopback iface");
    assert!(ips.contains(&v4(192, 168, 0, 137)));
  }

  #[test]
  fn an_interface_is_used_from_its_first_carrier_on() {
    let lo = iface(IpAddr::V4(Ipv4Addr::LOCALHOST), 1, true, false);
    let with_carrier = |has_carrier| IfAddr {
      is_running: has_carrier,
      has_run: has_carrier,
      ..iface(v4(172, 17, 0, 1), 2, false, true)
    };
    let mut former = Vec::new();
    for (has_carrier, is_used) in [(false, false), (true, true), (false, true)] {
      let now = with_former(vec![lo.clone(), with_carrier(has_carrier)], &former);
      assert_eq!(get_local_unicast_locators_inner(&now, 7400, None).len(), 1 + usize::from(is_used));
      assert_eq!(get_local_multicast_ip_addrs_inner(&now, None).len(), usize::from(is_used));
      assert_eq!(multicast_interface_indexes(&now, None).len(), usize::from(is_used));
      former = now;
    }
    // Its address was removed meanwhile.
    former.pop();
    assert!(!with_former(vec![lo, with_carrier(false)], &former)[1].has_run);
  }

  #[test]
  fn no_multicast() {
    let mut ifaces = Vec::new();
    for index in 0..10 {
      ifaces.push(iface(
        v4(192, 168, 0, rand::random()),
        index + 1,
        false,
        false, // no multicast support
      ));
    }

    let ips = get_local_multicast_ip_addrs_inner(&ifaces, None);
    assert!(
      ips.is_empty(),
      "we only want interfaces w/ multicast support"
    );
  }

  #[test]
  fn empty_interfaces() {
    let ips = get_local_multicast_ip_addrs_inner(&[], None);
    assert!(
      ips.is_empty(),
      "blank iface list should result in empty list of ips"
    );
  }

  #[test]
  fn multicast_filter_respects_only_networks() {
    let ifaces = vec![
      iface(v4(192, 168, 0, 10), 1, false, true),
      iface(v4(10, 0, 0, 10), 2, false, true),
    ];

    let only_networks = [NetworkSelector::Address(v4(10, 0, 0, 10))];
    let ips = get_local_multicast_ip_addrs_inner(&ifaces, Some(&only_networks));

    assert_eq!(ips, vec![v4(10, 0, 0, 10)]);
  }

  #[test]
  fn unicast_filter_respects_only_networks() {
    let only_networks = [NetworkSelector::Address(v4(10, 0, 0, 10))];
    let ifaces = vec![
      iface(v4(192, 168, 0, 10), 1, false, true),
      iface(v4(10, 0, 0, 10), 2, false, true),
    ];

    let filtered = get_local_unicast_locators_inner(&ifaces, 7412, Some(&only_networks));

    assert_eq!(
      filtered,
      vec![Locator::from(SocketAddr::new(v4(10, 0, 0, 10), 7412))]
    );
  }

  // Our unicast transport is IPv4-only, so IPv6 interface addresses must never
  // be announced as unicast locators: peers (and we ourselves, via loopback
  // discovery) would send there and get EAFNOSUPPORT on every datagram.
  #[test]
  fn unicast_locators_exclude_ipv6() {
    let ifaces = vec![
      iface(v4(192, 168, 0, 10), 1, false, true),
      // link-local IPv6, as found on e.g. docker0 / veth interfaces
      iface(
        IpAddr::V6(Ipv6Addr::new(
          0xfe80, 0, 0, 0, 0xd494, 0x8fff, 0xfe08, 0x3ce3,
        )),
        1,
        false,
        true,
      ),
      iface(
        IpAddr::V6(Ipv6Addr::new(0xfd73, 0x40a2, 0x1c3e, 0, 0, 0, 0, 1)),
        1,
        false,
        true,
      ),
    ];

    let filtered = get_local_unicast_locators_inner(&ifaces, 7412, None);

    assert_eq!(
      filtered,
      vec![Locator::from(SocketAddr::new(v4(192, 168, 0, 10), 7412))]
    );
  }

  // The address of a name is looked up with each change, that of an address is not.
  #[test]
  fn a_selected_name_is_followed_to_its_new_address() {
    let named = [NetworkSelector::Name("if2".to_string())];
    let at = |ip| [iface(v4(192, 168, 0, 10), 1, false, true), iface(ip, 2, false, true)];
    for ip in [v4(10, 0, 0, 10), v4(172, 16, 0, 3)] {
      let locators = listener_locators(&at(ip), 7412, false, Some(&named));
      assert_eq!(locators, vec![Locator::from(SocketAddr::new(ip, 7412))]);
      assert_eq!(multicast_interface_indexes(&at(ip), Some(&named)), [2].into());
    }
    assert_eq!(listener_locators(&at(v4(10, 0, 0, 10))[..1], 7400, true, Some(&named)), vec![]);
    let locators = listener_locators(&at(v4(10, 0, 0, 10)), 7400, true, Some(&named));
    assert_eq!(locators.len(), 1);
  }

  #[test]
  fn ifindex_map_prefers_ipv4_and_skips_index_zero() {
    let ifaces = vec![
      // index 0 -> skipped
      iface(IpAddr::V4(Ipv4Addr::LOCALHOST), 0, true, false),
      // index 3, IPv6 seen before IPv4: IPv4 should win
      iface(
        IpAddr::V6(Ipv6Addr::new(0xfe80, 0, 0, 0, 0, 0, 0, 1)),
        3,
        false,
        true,
      ),
      iface(v4(10, 0, 0, 7), 3, false, true),
    ];

    let map = build_ifindex_map_inner(&ifaces);
    assert!(!map.contains_key(&0), "index 0 must be skipped");
    assert_eq!(
      map.get(&3),
      Some(&InterfaceSelector::Ip(v4(10, 0, 0, 7))),
      "should prefer the IPv4 address"
    );
  }

  // A peer on the same /24 as a local interface uses that interface's MTU
  // (minus the 48-byte IPv4+UDP+RTPS header overhead).
  #[test]
  fn path_mtu_same_subnet_uses_iface_mtu() {
    let ifaces = vec![
      iface_v4(127, 0, 0, 1, 8, 16384, true),
      iface_v4(192, 168, 1, 10, 24, 1500, false),
    ];
    assert_eq!(
      path_mtu_payload_for_peer(&ifaces, v4(192, 168, 1, 55)),
      1500 - 48
    );
  }

  // A loopback peer matches the loopback interface and inherits its large MTU.
  #[test]
  fn path_mtu_loopback_peer_uses_loopback_mtu() {
    let ifaces = vec![
      iface_v4(127, 0, 0, 1, 8, 16384, true),
      iface_v4(192, 168, 1, 10, 24, 1500, false),
    ];
    assert_eq!(
      path_mtu_payload_for_peer(&ifaces, v4(127, 0, 0, 1)),
      16384 - 48
    );
  }

  // A peer not in any local subnet is assumed to be behind a router: use the
  // conservative Ethernet default.
  #[test]
  fn path_mtu_behind_router_uses_default() {
    let ifaces = vec![iface_v4(192, 168, 1, 10, 24, 1500, false)];
    assert_eq!(
      path_mtu_payload_for_peer(&ifaces, v4(10, 20, 30, 40)),
      FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE
    );
  }

  // An IPv6 peer has no IPv4 subnet to match: fall back to the default.
  #[test]
  fn path_mtu_ipv6_peer_uses_default() {
    let ifaces = vec![iface_v4(192, 168, 1, 10, 24, 9000, false)];
    let peer = IpAddr::V6(Ipv6Addr::LOCALHOST);
    assert_eq!(
      path_mtu_payload_for_peer(&ifaces, peer),
      FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE
    );
  }

  // A jumbo-frame interface yields a correspondingly large budget.
  #[test]
  fn path_mtu_jumbo_frame() {
    let ifaces = vec![iface_v4(10, 0, 0, 1, 8, 9000, false)];
    assert_eq!(
      path_mtu_payload_for_peer(&ifaces, v4(10, 1, 2, 3)),
      9000 - 48
    );
  }

  // Empty table -> default.
  #[test]
  fn path_mtu_empty_table_uses_default() {
    assert_eq!(
      path_mtu_payload_for_peer(&[], v4(192, 168, 1, 1)),
      FALLBACK_MAX_AGGREGATED_DATAGRAM_SIZE
    );
  }

  #[test]
  fn localhost_spdp_peers_cover_range_excluding_self() {
    let domain = 0;
    let own = 2;
    let peers = localhost_spdp_peer_locators(domain, own, 4);
    // pids 0,1,3 (not 2), all on 127.0.0.1 at the well-known SPDP unicast ports.
    let expected: Vec<Locator> = [0u16, 1, 3]
      .iter()
      .map(|pid| {
        Locator::from(SocketAddr::new(
          IpAddr::V4(Ipv4Addr::LOCALHOST),
          spdp_well_known_unicast_port(domain, *pid),
        ))
      })
      .collect();
    assert_eq!(peers, expected);
    assert!(peers
      .iter()
      .all(|l| SocketAddr::from(*l).ip().is_loopback()));
  }
}
