use std::{
  cell::RefCell,
  collections::HashMap,
  io::{self, IoSlice},
  net::{IpAddr, Ipv4Addr, SocketAddr, UdpSocket},
  rc::Rc,
  sync::Arc,
};
#[cfg(unix)]
use std::os::unix::io::{AsRawFd, RawFd};

#[allow(unused_imports)]
use log::{debug, error, info, trace, warn};
use socket2::{Domain, Protocol, SockAddr, SockRef, Socket, Type};

use crate::{
  network::util::{get_local_multicast_ip_addrs_inner, IfAddr, NetworkSelector},
  rtps::{
    message::RTPS_MESSAGE_HEADER_SIZE,
    outbound::{ControlQueue, Datagram, Gather, SendOutcome, SocketId, CONTROL_QUEUE_WARN_LEN},
    transmit::InterfaceSelector,
  },
  structure::locator::Locator,
};

// What an IPv4 datagram holds. How much a path carries without fragmentation is
// the Writers' concern, and loopback carries this.
const MAX_UDP_PAYLOAD: usize = 65_507;

// Messages are put together up to this size, less than any Ethernet path fragments.
const MAX_TOGETHER_BYTES: usize = 1_400;

// We need one multicast sender socket per interface

#[derive(Debug)]
pub struct UDPSender {
  // Shared with the threads that write, see `rtps/direct_send.rs`.
  unicast_socket: Arc<UdpSocket>,
  // One multicast sender socket per local interface, keyed by the interface it
  // was bound to (its `InterfaceSelector`). This lets us target a single
  // interface instead of sending on all of them.
  //
  // A `SocketId::Multicast` is a place in this list. The place of a socket that is
  // closed, since its address is gone, stays empty until a new socket takes it.
  multicast_sockets: RefCell<Vec<Option<(InterfaceSelector, Rc<UdpSocket>)>>>,
  send_buffer_size: usize,

  // nonblocking-transmit: per-socket never-dropped control queue. A control
  // datagram is enqueued only when its socket is currently congested
  // (WouldBlock) or already has queued control ahead of it; otherwise it is
  // sent immediately. Drained on write readiness by `flush_control`.
  // (see src/rtps/nonblocking_transmit_design.md)
  control_queues: RefCell<HashMap<SocketId, ControlQueue>>,

  // What `together` collects, in the order in which it is to be sent.
  together: RefCell<Option<Vec<(SocketId, Datagram)>>>,
}

impl UDPSender {
  #[cfg(test)]
  pub fn new(sender_port: u16) -> io::Result<Self> {
    let interfaces = crate::network::util::local_interface_table();
    Self::new_with_networks(sender_port, &interfaces, None, 0)
  }

  // Request (and verify) SO_SNDBUF on a sender socket. `size == 0` leaves the
  // OS default in place. Like the receive path, the kernel silently clamps the
  // request to a per-socket ceiling (macOS: `kern.ipc.maxsockbuf`, 8 MiB by
  // default; Linux: `net.core.wmem_max`), so we read the effective value back
  // and warn when it is materially smaller than requested -- a too-small send
  // buffer causes WouldBlock churn / control-queue growth under bursty output.
  fn set_and_verify_send_buffer(socket: &Socket, size: usize) {
    if size == 0 {
      return;
    }
    // With CAP_NET_ADMIN `net.core.wmem_max` is no limit.
    #[cfg(target_os = "linux")]
    let forced =
      nix::sys::socket::setsockopt(socket, nix::sys::socket::sockopt::SndBufForce, &size).is_ok();
    #[cfg(not(target_os = "linux"))]
    let forced = false;
    if !forced {
      if let Err(e) = socket.set_send_buffer_size(size) {
        warn!("Failed to set SO_SNDBUF to {size}: {e}. Using OS default.");
        return;
      }
    }
    match socket.send_buffer_size() {
      Ok(effective) if effective < size => warn!(
        "SO_SNDBUF clamped: requested {size} bytes but got {effective} bytes. The kernel limits \
         per-socket send buffers; raise it if the sender backlogs under load (macOS: `sudo sysctl \
         -w kern.ipc.maxsockbuf=<bytes>`, Linux: `sudo sysctl -w net.core.wmem_max=<bytes>`)."
      ),
      Ok(effective) => debug!("SO_SNDBUF requested {size} bytes, effective {effective} bytes."),
      Err(e) => debug!("Could not read back SO_SNDBUF: {e}"),
    }
  }

  pub(crate) fn new_with_networks(
    sender_port: u16,
    interfaces: &[IfAddr],
    only_networks: Option<&[NetworkSelector]>,
    send_buffer_size: usize,
  ) -> io::Result<Self> {
    let unicast_socket = {
      let saddr: SocketAddr = SocketAddr::new("0.0.0.0".parse().unwrap(), sender_port);
      let raw_socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
      Self::set_and_verify_send_buffer(&raw_socket, send_buffer_size);
      raw_socket.bind(&SockAddr::from(saddr))?;
      let socket = UdpSocket::from(raw_socket);
      // nonblocking-transmit: the socket must never stall the event loop.
      socket.set_nonblocking(true)?;
      socket
    };

    // We set multicasting loop on so that we can hear other DomainParticipant
    // instances running on the same host.
    unicast_socket
      .set_multicast_loop_v4(true)
      .unwrap_or_else(|e| {
        error!("Cannot set multicast loop on: {e:?}");
      });

    let sender = Self {
      unicast_socket: Arc::new(unicast_socket),
      multicast_sockets: RefCell::new(Vec::new()),
      send_buffer_size,
      control_queues: RefCell::new(HashMap::new()),
      together: RefCell::new(None),
    };
    sender.follow_interfaces(interfaces, only_networks);
    info!("UDPSender::new() --> {sender:?}");
    Ok(sender)
  }

  /// Opens a socket for multicast for each address that has come, and closes those
  /// of addresses that are gone. Yields the closed ones.
  pub(crate) fn follow_interfaces(
    &self,
    interfaces: &[IfAddr],
    only_networks: Option<&[NetworkSelector]>,
  ) -> Vec<SocketId> {
    let wanted: Vec<InterfaceSelector> =
      get_local_multicast_ip_addrs_inner(interfaces, only_networks)
        .into_iter()
        .map(InterfaceSelector::Ip)
        .collect();
    let mut closed = Vec::new();
    let mut sockets = self.multicast_sockets.borrow_mut();
    for (place, socket) in sockets.iter_mut().enumerate() {
      if socket
        .as_ref()
        .is_some_and(|(interface, _)| !wanted.contains(interface))
      {
        *socket = None;
        let id = SocketId::Multicast(place);
        // What waited for a network that is gone.
        self.control_queues.borrow_mut().remove(&id);
        closed.push(id);
      }
    }
    for interface in wanted {
      if sockets.iter().flatten().any(|(known, _)| *known == interface) {
        continue;
      }
      let InterfaceSelector::Ip(IpAddr::V4(address)) = interface else {
        continue; // `get_local_multicast_ip_addrs_inner` yields none
      };
      match Self::open_multicast_socket(address, self.send_buffer_size) {
        Ok(socket) => {
          let opened = Some((interface, Rc::new(socket)));
          match sockets.iter_mut().find(|place| place.is_none()) {
            Some(place) => *place = opened,
            None => sockets.push(opened),
          }
        }
        // The address may be gone again. Tried again with the next change.
        Err(e) => warn!("Cannot open a socket for multicast from {address}: {e}"),
      }
    }
    closed
  }

  fn open_multicast_socket(address: Ipv4Addr, send_buffer_size: usize) -> io::Result<UdpSocket> {
    let raw_socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;
    raw_socket.set_multicast_if_v4(&address)?;
    Self::set_and_verify_send_buffer(&raw_socket, send_buffer_size);
    raw_socket.bind(&SockAddr::from(SocketAddr::from((address, 0))))?;
    let socket = UdpSocket::from(raw_socket);
    // Participants on this host hear it, too.
    socket.set_multicast_loop_v4(true)?;
    // nonblocking-transmit: a full kernel buffer must never stall the event loop.
    socket.set_nonblocking(true)?;
    Ok(socket)
  }

  #[cfg(test)]
  pub fn new_with_random_port() -> io::Result<Self> {
    Self::new(0)
  }

  /// Sets the DSCP of datagrams that are sent by unicast: the upper six bits of the
  /// field that was type of service.
  pub(crate) fn set_dscp(&self, dscp: u8) -> io::Result<()> {
    if dscp == 0 {
      return Ok(());
    }
    SockRef::from(&*self.unicast_socket).set_tos_v4(u32::from(dscp) << 2)
  }

  pub(crate) fn unicast_socket(&self) -> Arc<UdpSocket> {
    Arc::clone(&self.unicast_socket)
  }

  // --- nonblocking-transmit: socket enumeration & raw non-blocking send ------

  fn multicast_socket(&self, place: usize) -> Option<(InterfaceSelector, Rc<UdpSocket>)> {
    self.multicast_sockets.borrow().get(place).cloned().flatten()
  }

  /// All sender sockets, so `DPEventLoop` can arm write readiness on each.
  pub(crate) fn socket_ids(&self) -> Vec<SocketId> {
    let mut v = vec![SocketId::Unicast];
    v.extend(self.multicast_ids());
    v
  }

  fn multicast_ids(&self) -> Vec<SocketId> {
    let sockets = self.multicast_sockets.borrow();
    let open = sockets.iter().enumerate().filter(|(_, socket)| socket.is_some());
    open.map(|(place, _)| SocketId::Multicast(place)).collect()
  }

  /// Raw fd of a sender socket, for registering write readiness in the poll.
  #[cfg(unix)]
  pub(crate) fn socket_raw_fd(&self, id: SocketId) -> Option<RawFd> {
    match id {
      SocketId::Unicast => Some(self.unicast_socket.as_raw_fd()),
      SocketId::Multicast(place) => self
        .multicast_socket(place)
        .map(|(_, socket)| socket.as_raw_fd()),
    }
  }

  /// Whether socket `id` can address `addr` at all. The unicast socket is
  /// IPv4-only, and a multicast socket only speaks the family of the interface
  /// address it was bound to. Sending across families fails with
  /// `EAFNOSUPPORT` on every datagram, so we filter such destinations out
  /// instead of letting them turn into a per-datagram warning. Peers legally
  /// announce locators we cannot reach (a remote IPv6 locator, or our own
  /// IPv6 interface addresses seen via loopback discovery), so this is normal.
  fn socket_can_reach(&self, id: SocketId, addr: SocketAddr) -> bool {
    match id {
      SocketId::Unicast => addr.is_ipv4(),
      SocketId::Multicast(place) => match self.multicast_socket(place) {
        Some((InterfaceSelector::Ip(iface_ip), _)) => iface_ip.is_ipv4() == addr.is_ipv4(),
        None => false,
      },
    }
  }

  /// One non-blocking datagram send. Never blocks; classifies the result.
  fn raw_send(&self, id: SocketId, addr: SocketAddr, datagram: Gather<'_>) -> SendOutcome {
    if !self.socket_can_reach(id, addr) {
      trace!("raw_send: {id:?} cannot reach {addr} (address family mismatch), dropping");
      return SendOutcome::Dropped;
    }
    let send = |socket: &UdpSocket| {
      if datagram.fragments.is_empty() {
        return socket.send_to(datagram.head, addr);
      }
      let pieces = datagram.pieces().map(IoSlice::new);
      SockRef::from(socket).send_to_vectored(&pieces, &SockAddr::from(addr))
    };
    let sent = match id {
      SocketId::Unicast => send(&self.unicast_socket),
      SocketId::Multicast(place) => match self.multicast_socket(place) {
        Some((_, socket)) => send(&socket),
        None => return SendOutcome::Dropped, // closed meanwhile
      },
    };
    match sent {
      Ok(bytes_sent) => {
        if bytes_sent != datagram.len() {
          error!(
            "raw_send: {id:?} tried {} bytes, sent only {bytes_sent}",
            datagram.len()
          );
        }
        SendOutcome::Sent
      }
      Err(e) if e.kind() == io::ErrorKind::WouldBlock => SendOutcome::WouldBlock,
      // A link that is down, or an address that is gone: so for each datagram until
      // the peer's lease ends.
      Err(e)
        if matches!(
          e.kind(),
          io::ErrorKind::NetworkUnreachable
            | io::ErrorKind::HostUnreachable
            | io::ErrorKind::NetworkDown
            | io::ErrorKind::AddrNotAvailable
        ) =>
      {
        debug!("raw_send: {id:?} to {addr}: {e}");
        SendOutcome::Dropped
      }
      Err(e) => {
        warn!("raw_send: {id:?} to {addr} : {e:?} len={}", datagram.len());
        SendOutcome::Dropped
      }
    }
  }

  fn control_queue_nonempty(&self, id: SocketId) -> bool {
    self
      .control_queues
      .borrow()
      .get(&id)
      .is_some_and(|q| !q.is_empty())
  }

  // --- nonblocking-transmit: control path (never dropped, high priority) -----

  /// Sends the control messages of `work` when it has ended, those to the same
  /// address in one datagram: a message is a header and submessages (RTPS 2.5,
  /// clause 8.3.4), so messages with the same header are one message with the
  /// submessages of all.
  ///
  /// All of them have to be for one participant: an INFO_DST holds for what follows
  /// it, too. And none may be a sample: so does an INFO_TS.
  pub(crate) fn together(&self, work: impl FnOnce()) {
    self.together.replace(Some(Vec::new()));
    work();
    for (id, datagram) in self.together.take().unwrap_or_default() {
      self.control_send_one(id, datagram.addr, &datagram.bytes);
    }
  }

  // Whether `together` has taken it.
  fn collect(&self, id: SocketId, addr: SocketAddr, buffer: &[u8]) -> bool {
    let mut together = self.together.borrow_mut();
    let Some(collected) = together.as_mut() else {
      return false;
    };
    let header = buffer.get(..RTPS_MESSAGE_HEADER_SIZE);
    // The last one to there, for their order to stay.
    let last = collected
      .iter_mut()
      .rev()
      .find(|(other, datagram)| *other == id && datagram.addr == addr)
      .map(|(_, datagram)| datagram);
    match (last, header) {
      (Some(last), Some(header))
        if last.bytes.starts_with(header)
          && last.bytes.len() + buffer.len() - RTPS_MESSAGE_HEADER_SIZE <= MAX_TOGETHER_BYTES =>
      {
        last.bytes.extend_from_slice(&buffer[RTPS_MESSAGE_HEADER_SIZE..]);
      }
      _ => collected.push((
        id,
        Datagram {
          addr,
          bytes: buffer.to_vec(),
        },
      )),
    }
    true
  }

  // Enqueue-or-send one control datagram to a single socket. If the socket
  // already has queued control we must preserve order and just enqueue;
  // otherwise we try an immediate send and only enqueue on WouldBlock.
  fn control_send_one(&self, id: SocketId, addr: SocketAddr, buffer: &[u8]) {
    if self.collect(id, addr, buffer) {
      return;
    }
    let mut queues = self.control_queues.borrow_mut();
    let queue = queues.entry(id).or_default();
    if queue.is_empty() {
      match self.raw_send(id, addr, Gather::whole(buffer)) {
        SendOutcome::Sent | SendOutcome::Dropped => {}
        SendOutcome::WouldBlock => queue.push_back(Datagram {
          addr,
          bytes: buffer.to_vec(),
        }),
      }
    } else {
      queue.push_back(Datagram {
        addr,
        bytes: buffer.to_vec(),
      });
      if queue.len() == CONTROL_QUEUE_WARN_LEN {
        warn!(
          "nonblocking-transmit: control queue for {id:?} reached {} datagrams; link may be \
           wedged (nothing dropped)",
          queue.len()
        );
      }
    }
  }

  /// Try to flush a socket's queued control datagrams (called on write
  /// readiness). Returns `true` if the queue is now empty.
  pub(crate) fn flush_control(&self, id: SocketId) -> bool {
    let mut queues = self.control_queues.borrow_mut();
    let Some(queue) = queues.get_mut(&id) else {
      return true;
    };
    while let Some(front) = queue.front() {
      let addr = front.addr;
      let outcome = self.raw_send(id, addr, Gather::whole(&front.bytes));
      match outcome {
        SendOutcome::Sent | SendOutcome::Dropped => {
          queue.pop_front();
        }
        SendOutcome::WouldBlock => return false,
      }
    }
    true
  }

  /// Whether socket `id` currently has queued (undelivered) control datagrams.
  pub(crate) fn control_backlogged(&self, id: SocketId) -> bool {
    self.control_queue_nonempty(id)
  }

  /// Queue a datagram on socket `id` without sending, as if the socket had
  /// returned WouldBlock.
  #[cfg(test)]
  pub(crate) fn inject_control_backlog(&self, id: SocketId) {
    self
      .control_queues
      .borrow_mut()
      .entry(id)
      .or_default()
      .push_back(Datagram {
        addr: SocketAddr::from(([127, 0, 0, 1], 9)),
        bytes: vec![0; 4],
      });
  }

  /// Sockets that currently have queued (undelivered) control datagrams.
  pub(crate) fn pending_control_sockets(&self) -> Vec<SocketId> {
    self
      .control_queues
      .borrow()
      .iter()
      .filter(|(_, q)| !q.is_empty())
      .map(|(id, _)| *id)
      .collect()
  }

  fn locator_socket_addr(&self, locator: &Locator, ctx: &str) -> Option<SocketAddr> {
    match locator {
      Locator::UdpV4(sa) => Some(SocketAddr::from(*sa)),
      Locator::UdpV6(sa) => Some(SocketAddr::from(*sa)),
      Locator::Invalid | Locator::Reserved => {
        error!("{ctx}: Cannot send to {locator:?}");
        None
      }
      Locator::Other { kind, .. } => {
        // Normal: other implementations define their own kinds (from Discovery).
        trace!("{ctx}: Unknown LocatorKind: {kind:?}");
        None
      }
    }
  }

  pub fn send_to_locator_list(&self, buffer: &[u8], ll: &[Locator]) {
    for loc in ll {
      self.send_to_locator(buffer, loc);
    }
  }

  /// Control-path send to a locator. A multicast locator fans out to every
  /// multicast interface (legacy reachability). Datagrams are queued (never
  /// dropped) if the socket is congested.
  pub fn send_to_locator(&self, buffer: &[u8], locator: &Locator) {
    if buffer.len() > MAX_UDP_PAYLOAD {
      warn!("send_to_locator: Message size = {}", buffer.len());
    }
    let Some(socket_address) = self.locator_socket_addr(locator, "send_to_locator") else {
      return;
    };
    if socket_address.ip().is_multicast() {
      for id in self.multicast_ids() {
        self.control_send_one(id, socket_address, buffer);
      }
    } else {
      self.control_send_one(SocketId::Unicast, socket_address, buffer);
    }
  }

  /// The set of local interfaces on which this sender can emit multicast.
  /// Used by route resolution to validate an observed interface is usable.
  pub fn multicast_interfaces(&self) -> Vec<InterfaceSelector> {
    let sockets = self.multicast_sockets.borrow();
    sockets.iter().flatten().map(|(iface, _)| *iface).collect()
  }

  fn multicast_socket_id_for(&self, interface: &InterfaceSelector) -> Option<SocketId> {
    let sockets = self.multicast_sockets.borrow();
    sockets
      .iter()
      .position(|socket| matches!(socket, Some((iface, _)) if iface == interface))
      .map(SocketId::Multicast)
  }

  /// Control-path multicast send out of a single, specific local interface.
  /// Falls back to all interfaces if the requested one is unknown, so a
  /// stale/misresolved interface never silently drops traffic.
  pub fn send_to_multicast_locator_via(
    &self,
    buffer: &[u8],
    locator: &Locator,
    interface: &InterfaceSelector,
  ) {
    if buffer.len() > MAX_UDP_PAYLOAD {
      warn!(
        "send_to_multicast_locator_via: Message size = {}",
        buffer.len()
      );
    }
    let Some(socket_address) = self.locator_socket_addr(locator, "send_to_multicast_locator_via")
    else {
      return;
    };

    if !socket_address.ip().is_multicast() {
      // Not a multicast destination; treat as a plain unicast send.
      self.control_send_one(SocketId::Unicast, socket_address, buffer);
      return;
    }

    match self.multicast_socket_id_for(interface) {
      Some(id) => self.control_send_one(id, socket_address, buffer),
      None => {
        trace!("send_to_multicast_locator_via: interface {interface:?} not found, sending on all");
        for id in self.multicast_ids() {
          self.control_send_one(id, socket_address, buffer);
        }
      }
    }
  }

  // --- nonblocking-transmit: bulk path (flow-controlled, backpressured) ------

  // One bulk datagram attempt to a socket. Control has strict priority: if the
  // socket still has queued control, report WouldBlock so the writer backs off
  // and resumes only after control has drained.
  fn bulk_send_one(&self, id: SocketId, addr: SocketAddr, datagram: Gather<'_>) -> SendOutcome {
    if self.control_queue_nonempty(id) {
      return SendOutcome::WouldBlock;
    }
    self.raw_send(id, addr, datagram)
  }

  /// Bulk send to a locator. Returns the sockets that could not accept the
  /// datagram (WouldBlock), so the caller can stop and arm write readiness.
  pub(crate) fn try_send_to_locator(
    &self,
    datagram: Gather<'_>,
    locator: &Locator,
  ) -> Vec<SocketId> {
    if datagram.len() > MAX_UDP_PAYLOAD {
      warn!("try_send_to_locator: Message size = {}", datagram.len());
    }
    let mut blocked = Vec::new();
    let Some(socket_address) = self.locator_socket_addr(locator, "try_send_to_locator") else {
      return blocked;
    };
    if socket_address.ip().is_multicast() {
      for id in self.multicast_ids() {
        if self.bulk_send_one(id, socket_address, datagram) == SendOutcome::WouldBlock {
          blocked.push(id);
        }
      }
    } else if self.bulk_send_one(SocketId::Unicast, socket_address, datagram)
      == SendOutcome::WouldBlock
    {
      blocked.push(SocketId::Unicast);
    }
    blocked
  }

  /// Bulk multicast send out of a single interface (fallback: all). Returns the
  /// sockets that could not accept the datagram (WouldBlock).
  pub(crate) fn try_send_to_multicast_locator_via(
    &self,
    datagram: Gather<'_>,
    locator: &Locator,
    interface: &InterfaceSelector,
  ) -> Vec<SocketId> {
    if datagram.len() > MAX_UDP_PAYLOAD {
      warn!(
        "try_send_to_multicast_locator_via: Message size = {}",
        datagram.len()
      );
    }
    let mut blocked = Vec::new();
    let Some(socket_address) =
      self.locator_socket_addr(locator, "try_send_to_multicast_locator_via")
    else {
      return blocked;
    };
    if !socket_address.ip().is_multicast() {
      if self.bulk_send_one(SocketId::Unicast, socket_address, datagram) == SendOutcome::WouldBlock
      {
        blocked.push(SocketId::Unicast);
      }
      return blocked;
    }
    let ids: Vec<SocketId> = match self.multicast_socket_id_for(interface) {
      Some(id) => vec![id],
      None => self.multicast_ids(),
    };
    for id in ids {
      if self.bulk_send_one(id, socket_address, datagram) == SendOutcome::WouldBlock {
        blocked.push(id);
      }
    }
    blocked
  }

  #[cfg(test)]
  pub fn send_to_all(&self, buffer: &[u8], addresses: &[SocketAddr]) {
    let buf_len = buffer.len();

    for address in addresses.iter() {
      // try sending the addr a message
      match self.unicast_socket.send_to(buffer, *address) {
        Ok(bytes_sent) => {
          // error if we didn't send the whole buffer.
          if bytes_sent != buffer.len() {
            panic!("tried to send `{buf_len}` bytes, sent only `{bytes_sent}`!");
          }
        }

        // it's a problem if we couldn't send anything - so we'll panic!
        Err(e) => {
          panic!("Unable to send to `{address}`. err: {e}");
        }
      }
    }
  }

  #[cfg(test)]
  pub fn send_multicast(self, buffer: &[u8], address: Ipv4Addr, port: u16) -> io::Result<usize> {
    if address.is_multicast() {
      let address = SocketAddr::new(IpAddr::V4(address), port);
      let mut size = 0;
      for (_iface, s) in self.multicast_sockets.borrow().iter().flatten() {
        size = s.send_to(buffer, address)?;
      }
      Ok(size)
    } else {
      io::Result::Err(io::Error::other("Not a multicast address"))
    }
  }
}

#[cfg(test)]
mod tests {
  use super::*;
  use crate::network::udp_listener::*;

  #[test]
  fn udps_single_send() {
    let listener = UDPListener::new_unicast("127.0.0.1", 10201).unwrap();
    let sender = UDPSender::new(11201).expect("failed to create UDPSender");

    let data: Vec<u8> = vec![0, 1, 2, 3, 4];

    let addrs = vec![SocketAddr::new("127.0.0.1".parse().unwrap(), 10201)];
    sender.send_to_all(&data, &addrs);

    let rec_data = listener.get_message();

    assert_eq!(rec_data.len(), 5);
    assert_eq!(rec_data, data);
  }

  #[test]
  fn udps_multi_send() {
    let listener_1 = UDPListener::new_unicast("127.0.0.1", 10301).unwrap();
    let listener_2 = UDPListener::new_unicast("127.0.0.1", 10302).unwrap();
    let sender = UDPSender::new(11301).expect("failed to create UDPSender");

    let data: Vec<u8> = vec![5, 4, 3, 2, 1, 0];

    let addrs = vec![
      SocketAddr::new("127.0.0.1".parse().unwrap(), 10301),
      SocketAddr::new("127.0.0.1".parse().unwrap(), 10302),
    ];
    sender.send_to_all(&data, &addrs);

    let rec_data_1 = listener_1.get_message();
    let rec_data_2 = listener_2.get_message();

    assert_eq!(rec_data_1.len(), 6);
    assert_eq!(rec_data_1, data);
    assert_eq!(rec_data_2.len(), 6);
    assert_eq!(rec_data_2, data);
  }

  #[test]
  fn messages_with_one_header_go_together() {
    let listeners = [10501, 10502].map(|port| {
      let listener = UdpSocket::bind(("127.0.0.1", port)).unwrap();
      listener
        .set_read_timeout(Some(std::time::Duration::from_millis(300)))
        .unwrap();
      listener
    });
    let [first, second] = [10501, 10502]
      .map(|port| Locator::from(SocketAddr::from((Ipv4Addr::LOCALHOST, port))));
    let received = |listener: &UdpSocket| {
      let mut datagrams = Vec::new();
      let mut buffer = [0; 4096];
      while let Ok((length, _)) = listener.recv_from(&mut buffer) {
        datagrams.push(buffer[..length].to_vec());
      }
      datagrams
    };
    let header = [1; RTPS_MESSAGE_HEADER_SIZE];
    let message = |header: &[u8], content: &[u8]| [header, content].concat();
    let sender = UDPSender::new(11501).expect("failed to create UDPSender");

    sender.together(|| {
      sender.send_to_locator(&message(&header, b"HEARTBEAT"), &first);
      sender.send_to_locator(&message(&header, b"ACKNACK"), &second);
      sender.send_to_locator(&message(&header, b"ACKNACK"), &first);
      sender.send_to_locator(&message(&[2; RTPS_MESSAGE_HEADER_SIZE], b"of another"), &second);
      // No message at all, and one that nothing fits.
      sender.send_to_locator(b"short", &second);
      sender.send_to_locator(&message(&header, &[3; MAX_TOGETHER_BYTES]), &second);
      assert_eq!(received(&listeners[0]), Vec::<Vec<u8>>::new(), "sent at the end");
    });
    assert_eq!(
      received(&listeners[0]),
      [message(&header, b"HEARTBEATACKNACK")]
    );
    assert_eq!(
      received(&listeners[1]),
      [
        message(&header, b"ACKNACK"),
        message(&[2; RTPS_MESSAGE_HEADER_SIZE], b"of another"),
        b"short".to_vec(),
        message(&header, &[3; MAX_TOGETHER_BYTES]),
      ]
    );

    sender.send_to_locator(&message(&header, b"HEARTBEAT"), &first);
    sender.send_to_locator(&message(&header, b"ACKNACK"), &first);
    assert_eq!(received(&listeners[0]).len(), 2, "each for itself again");
  }

  // The unicast socket is IPv4-only, so an IPv6 destination is unreachable and
  // must be dropped without attempting (and warning about) a send that can only
  // ever fail with EAFNOSUPPORT.
  #[test]
  fn unicast_socket_rejects_ipv6_destination() {
    let sender = UDPSender::new(11401).expect("failed to create UDPSender");

    let v4_dest = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 10401);
    let v6_dest = SocketAddr::new(
      IpAddr::V6(std::net::Ipv6Addr::new(
        0xfe80, 0, 0, 0, 0xd494, 0x8fff, 0xfe08, 0x3ce3,
      )),
      10401,
    );

    assert!(sender.socket_can_reach(SocketId::Unicast, v4_dest));
    assert!(!sender.socket_can_reach(SocketId::Unicast, v6_dest));
    assert_eq!(
      sender.raw_send(SocketId::Unicast, v6_dest, Gather::whole(&[0u8; 4])),
      SendOutcome::Dropped
    );
  }
}
