use std::{
  collections::{BTreeSet, HashMap},
  io,
  net::{IpAddr, Ipv4Addr, SocketAddr},
};

use log::{debug, info, trace, warn};
use socket2::{Domain, InterfaceIndexOrAddress, Protocol, SockAddr, SockRef, Socket, Type};
use bytes::{Bytes, BytesMut};

use crate::{
  network::util::{build_ifindex_map_inner, multicast_interface_indexes, IfAddr, NetworkSelector},
  rtps::transmit::InterfaceSelector,
  serialization::padding_needed_for_alignment_4,
};

/// Metadata captured about where a received datagram came from and how it
/// reached us.
#[derive(Clone, Copy, Debug)]
pub struct PacketOrigin {
  /// Remote source socket address, if it could be determined.
  pub source: Option<SocketAddr>,
  /// Local interface the datagram was received on, if it could be determined
  /// (requires `IP_PKTINFO`; `None` on platforms/paths where it is
  /// unavailable).
  pub local_if: Option<InterfaceSelector>,
}

impl PacketOrigin {
  /// An origin with no captured metadata (forces the legacy send fallback).
  #[allow(dead_code)] // Used by tests and the loopback path; harmless if unused in a given build.
  pub const UNKNOWN: Self = Self {
    source: None,
    local_if: None,
  };
}

const MAX_MESSAGE_SIZE: usize = 64 * 1024; // This is max we can get from UDP.
const MESSAGE_BUFFER_ALLOCATION_CHUNK: usize = 256 * 1024; // must be >= MAX_MESSAGE_SIZE
static_assertions::const_assert!(MESSAGE_BUFFER_ALLOCATION_CHUNK > MAX_MESSAGE_SIZE);
// The topic cache keeps the datagram of a small sample for 5 s. It would keep a whole
// chunk of fragments with it, up to 1,024 of them for one topic: 256 MiB.
const SMALL_MESSAGE_SIZE: usize = 16 * 1024;
const SMALL_MESSAGES_CHUNK: usize = 64 * 1024;
// More than a receive buffer of 4 MiB holds: 10,082 datagrams of one byte.
const MAX_DISCARDED: usize = 16 * 1024;

/// Listens to messages coming to specified host port combination.
/// Only messages from added listen addressed are read when get_all_messages is
/// called.
#[derive(Debug)]
pub struct UDPListener {
  socket: mio1::net::UdpSocket,
  receive_buffer: BytesMut,
  // Where datagrams of up to SMALL_MESSAGE_SIZE are copied to.
  small_messages: BytesMut,
  // Whether a datagram stays in the socket until it is handled, and whether one is there.
  keeps_until_handled: bool,
  is_kept: bool,
  multicast_group: Option<Ipv4Addr>,
  // Indexes of the interfaces on which the group is joined. By index, because an
  // interface keeps it when its address changes.
  joined: BTreeSet<u32>,
  // Cached OS interface-index -> local interface map, used to resolve the
  // receiving interface reported by IP_PKTINFO. Kept by `follow_interfaces`.
  ifindex_map: HashMap<u32, InterfaceSelector>,
}

impl UDPListener {
  fn new_listening_socket(
    host: &str,
    port: u16,
    reuse_addr: bool,
    recv_buffer_size: usize,
    kept: Option<std::net::UdpSocket>,
  ) -> io::Result<mio1::net::UdpSocket> {
    if let Some(socket) = kept {
      // It has been bound, and has its options, since a former process opened it.
      socket.set_nonblocking(true)?;
      return Ok(mio1::net::UdpSocket::from_std(socket));
    }
    let raw_socket = Socket::new(Domain::IPV4, Type::DGRAM, Some(Protocol::UDP))?;

    if recv_buffer_size > 0 {
      // With CAP_NET_ADMIN `net.core.rmem_max` is no limit.
      #[cfg(target_os = "linux")]
      let forced = nix::sys::socket::setsockopt(
        &raw_socket,
        nix::sys::socket::sockopt::RcvBufForce,
        &recv_buffer_size,
      )
      .is_ok();
      #[cfg(not(target_os = "linux"))]
      let forced = false;
      if !forced {
        raw_socket
          .set_recv_buffer_size(recv_buffer_size)
          .unwrap_or_else(|e| {
            warn!("Failed to set SO_RCVBUF to {recv_buffer_size}: {e}. Using OS default.");
          });
      }

      // Verify the effective size (getsockopt). The kernel silently clamps
      // SO_RCVBUF to a per-socket ceiling (macOS: `kern.ipc.maxsockbuf`, which
      // defaults to 8 MiB; Linux: `net.core.rmem_max`). Note Linux reports back
      // ~2x the requested value (bookkeeping overhead). Warn only when the
      // effective size is materially below what we asked for, so silent clamping
      // that can cause packet loss under load is visible in the logs.
      match raw_socket.recv_buffer_size() {
        Ok(effective) => {
          if effective < recv_buffer_size {
            warn!(
              "SO_RCVBUF clamped: requested {recv_buffer_size} bytes but got {effective} bytes. \
               The kernel limits per-socket receive buffers; raise it to reduce packet loss under \
               load (macOS: `sudo sysctl -w kern.ipc.maxsockbuf=<bytes>`, Linux: `sudo sysctl -w \
               net.core.rmem_max=<bytes>`)."
            );
          } else {
            debug!("SO_RCVBUF requested {recv_buffer_size} bytes, effective {effective} bytes.");
          }
        }
        Err(e) => {
          debug!("Could not read back SO_RCVBUF: {e}");
        }
      }
    }

    // We set ReuseAddr so that other DomainParticipants on this host can
    // bind to the same multicast address and port.
    // To have an effect on bind, this must be done before bind call, so must be
    // done below Rust std::net::UdpSocket level.
    if reuse_addr {
      raw_socket.set_reuse_address(true)?;
    }

    // MacOS requires this also
    #[cfg(not(any(target_os = "solaris", target_os = "illumos", windows)))]
    {
      if reuse_addr {
        raw_socket.set_reuse_port(true)?;
      }
    }

    // Ask the kernel to attach IP_PKTINFO to received datagrams so we can learn
    // which local interface each one arrived on. Best-effort: if it fails we
    // simply lose interface metadata and fall back to the legacy send path.
    #[cfg(unix)]
    {
      if let Err(e) = nix::sys::socket::setsockopt(
        &raw_socket,
        nix::sys::socket::sockopt::Ipv4PacketInfo,
        &true,
      ) {
        warn!(
          "Could not enable IP_PKTINFO on listener socket: {e}. Interface-aware transmit disabled \
           for this socket."
        );
      }
    }

    let address = SocketAddr::new(host.parse().map_err(io::Error::other)?, port);

    if let Err(e) = raw_socket.bind(&SockAddr::from(address)) {
      info!("new_socket - cannot bind socket: {e:?}");
      return Err(e);
    }

    let std_socket = std::net::UdpSocket::from(raw_socket);
    std_socket
      .set_nonblocking(true)
      .map_err(|e| io::Error::other(format!("Failed to set std socket to non blocking: {e}")))?;

    // mio 1.2 takes the already-nonblocking std socket directly.
    let mio_socket = mio1::net::UdpSocket::from_std(std_socket);
    info!(
      "UDPListener: new socket with address {:?}",
      mio_socket.local_addr()
    );

    Ok(mio_socket)
  }

  /// Port, and whether it is a listener to multicast.
  pub(crate) fn kind(&self) -> io::Result<(u16, bool)> {
    let port = self.socket.local_addr()?.port();
    Ok((port, self.multicast_group.is_some()))
  }

  /// Joins the multicast group on interfaces that have come, and leaves it on those
  /// that are gone. The membership of an interface that was removed and comes back
  /// under the same name is not that of the new one, which has another index.
  pub(crate) fn follow_interfaces(
    &mut self,
    interfaces: &[IfAddr],
    only_networks: Option<&[NetworkSelector]>,
  ) {
    self.ifindex_map = build_ifindex_map_inner(interfaces);
    let Some(group) = self.multicast_group else {
      return;
    };
    let wanted = multicast_interface_indexes(interfaces, only_networks);
    let socket = SockRef::from(&self.socket);
    for gone in self.joined.difference(&wanted) {
      // The kernel has done so where the interface was removed.
      let interface = InterfaceIndexOrAddress::Index(*gone);
      if let Err(e) = socket.leave_multicast_v4_n(&group, &interface) {
        debug!("leave_multicast_v4_n {group} on interface {gone}: {e}");
      }
    }
    self.joined.retain(|index| wanted.contains(index));
    for new in wanted {
      if self.joined.contains(&new) {
        continue;
      }
      let interface = InterfaceIndexOrAddress::Index(new);
      match socket.join_multicast_v4_n(&group, &interface) {
        Ok(()) => {
          self.joined.insert(new);
        }
        // The former process of a kept socket has joined it.
        Err(e) if e.kind() == io::ErrorKind::AddrInUse => {
          self.joined.insert(new);
        }
        // Tried again with the next change.
        Err(e) => warn!("join_multicast_v4_n {group} on interface {new} failed: {e}"),
      }
    }
  }

  #[cfg(test)]
  pub fn new_unicast(host: &str, port: u16) -> io::Result<Self> {
    let interfaces = crate::network::util::local_interface_table();
    Self::new_unicast_with_buf_size(host, port, 0, &interfaces, None)
  }

  pub(crate) fn new_unicast_with_buf_size(
    host: &str,
    port: u16,
    recv_buffer_size: usize,
    interfaces: &[IfAddr],
    kept: Option<std::net::UdpSocket>,
  ) -> io::Result<Self> {
    let mio_socket = Self::new_listening_socket(host, port, false, recv_buffer_size, kept)?;

    Ok(Self {
      socket: mio_socket,
      receive_buffer: BytesMut::with_capacity(MESSAGE_BUFFER_ALLOCATION_CHUNK),
      small_messages: BytesMut::new(),
      keeps_until_handled: false,
      is_kept: false,
      multicast_group: None,
      joined: BTreeSet::new(),
      ifindex_map: build_ifindex_map_inner(interfaces),
    })
  }

  #[cfg(test)]
  pub fn new_multicast(host: &str, port: u16, multicast_group: Ipv4Addr) -> io::Result<Self> {
    let interfaces = crate::network::util::local_interface_table();
    Self::new_multicast_with_buf_size(host, port, multicast_group, 0, &interfaces, None, None)
  }

  pub(crate) fn new_multicast_with_buf_size(
    host: &str,
    port: u16,
    multicast_group: Ipv4Addr,
    recv_buffer_size: usize,
    interfaces: &[IfAddr],
    only_networks: Option<&[NetworkSelector]>,
    kept: Option<std::net::UdpSocket>,
  ) -> io::Result<Self> {
    if !multicast_group.is_multicast() {
      return io::Result::Err(io::Error::other("Not a multicast address"));
    }
    let socket = Self::new_listening_socket(host, port, true, recv_buffer_size, kept)?;
    // By default Linux delivers a group that any process has joined on an interface to
    // all sockets of its port (ip(7), IP_MULTICAST_ALL). A participant that has not yet
    // taken over a new address would hear a peer there, and answer with addresses at
    // which the peer cannot reach it; Fast DDS 2.9 keeps those as long as it lives.
    #[cfg(target_os = "linux")]
    if let Err(e) = socket2::SockRef::from(&socket).set_multicast_all_v4(false) {
      warn!("Multicast of groups that others have joined is received, too: {e}");
    }
    let mut listener = Self {
      socket,
      receive_buffer: BytesMut::with_capacity(MESSAGE_BUFFER_ALLOCATION_CHUNK),
      small_messages: BytesMut::new(),
      keeps_until_handled: false,
      is_kept: false,
      multicast_group: Some(multicast_group),
      joined: BTreeSet::new(),
      ifindex_map: HashMap::new(),
    };
    listener.follow_interfaces(interfaces, only_networks);
    if listener.joined.is_empty() {
      info!("No interface to join multicast group {multicast_group} on, yet.");
    }
    Ok(listener)
  }

  /// A duplicate of the socket. It receives from the same queue.
  #[cfg(unix)]
  pub fn duplicate(&self) -> io::Result<std::net::UdpSocket> {
    use std::os::fd::AsFd;
    Ok(self.socket.as_fd().try_clone_to_owned()?.into())
  }

  pub fn mio_socket(&mut self) -> &mut mio1::net::UdpSocket {
    &mut self.socket
  }

  #[cfg(test)]
  pub fn port(&self) -> u16 {
    match self.socket.local_addr() {
      Ok(add) => add.port(),
      _ => 0,
    }
  }

  // TODO: remove this. It is used only for tests.
  // We cannot read a single packet only, because we use edge-triggered polls.
  #[cfg(test)]
  pub fn get_message(&self) -> Vec<u8> {
    let mut buf: [u8; MAX_MESSAGE_SIZE] = [0; MAX_MESSAGE_SIZE];

    // try getting the message several times
    for _ in 0..10 {
      match self.socket.recv(&mut buf) {
        Ok(nbytes) => {
          assert!(nbytes > 0, "tests should always read data");

          return buf[..nbytes].to_vec();
        }
        Err(e) => {
          // handle EAGAIN on UNIX platforms.
          //
          // this means we need to wait for the kernel to give us the data.
          if e.kind() == io::ErrorKind::WouldBlock {
            std::thread::sleep(core::time::Duration::from_millis(50));
            continue;
          }

          panic!("test helper (`get_message`) failed! err: {e}");
        }
      }
    }

    panic!("test helper didn't recv message after ten attempts.");
  }

  /// Drain up to `max_messages` datagrams waiting in the socket.
  #[cfg(test)]
  pub fn messages_bounded(&mut self, max_messages: usize) -> Vec<(Bytes, PacketOrigin)> {
    std::iter::from_fn(|| self.next_message())
      .take(max_messages)
      .collect()
  }

  /// From now on `next_message` leaves its datagram in the socket until the next call, by
  /// which the one before must have been handled: if the process is killed meanwhile, the
  /// one that takes over the socket receives it again.
  pub fn keep_until_handled(&mut self) {
    self.keeps_until_handled = cfg!(unix);
  }

  /// Discards what waits in the socket.
  pub fn discard_all(&self) {
    // New ones may come as fast as they are discarded.
    let _ = (0..MAX_DISCARDED).all(|_| self.discard_one().is_ok());
  }

  // Takes a datagram out of the socket, without a byte of it.
  fn discard_one(&self) -> io::Result<usize> {
    self.socket.recv(&mut [])
  }

  /// The next datagram that waits in the socket, with its [`PacketOrigin`]
  /// (source address and receiving interface, when available).
  ///
  /// `None` when there is none. The reactor registers listeners edge-triggered:
  /// a datagram left unread does not produce another readiness event.
  pub fn next_message(&mut self) -> Option<(Bytes, PacketOrigin)> {
    if std::mem::take(&mut self.is_kept) {
      if let Err(e) = self.discard_one() {
        warn!("cannot discard a datagram that was handled: {e:?}");
      }
    }
    // Loop invariant. Note that capacity() may be large, but .len() == 0.
    assert_eq!(self.receive_buffer.len(), 0);

    // Ensure that receive buffer has enough capacity for a message. The chunk is used
    // again if no datagram in it is kept, such as after fragments, which were copied
    // elsewhere: a new chunk costs 64 page faults.
    if !self.receive_buffer.try_reclaim(MAX_MESSAGE_SIZE) {
      self.receive_buffer = BytesMut::with_capacity(MESSAGE_BUFFER_ALLOCATION_CHUNK);
      debug!("ensure_receive_buffer_capacity - reallocated receive_buffer");
    }
    unsafe {
      // This is safe, because we just checked that there is enough capacity,
      // or allocated more.
      // We do not read undefined data, because the recv()
      // will overwrite this space and truncate the rest away.
      self.receive_buffer.set_len(MAX_MESSAGE_SIZE);
    }
    trace!(
      "ensure_receive_buffer_capacity - {} bytes left",
      self.receive_buffer.capacity()
    );
    let (nbytes, origin) = match self.recv_one() {
      Ok(Some(received)) => received,
      Ok(None) => {
        // WouldBlock: nothing (more) to read.
        self.receive_buffer.clear();
        return None;
      }
      Err(e) => {
        self.receive_buffer.clear();
        warn!("socket recv() error: {e:?}");
        return None;
      }
    };
    // Something was received.
    // The buffer length is still MAX_MESSAGE_SIZE, set before the receive so
    // the kernel had room to write into. Shrink it back to the number of bytes
    // actually received, so that the padding + split below only consume this
    // datagram's worth of the chunk. Without this, every datagram (however
    // small) would carve off a full MAX_MESSAGE_SIZE slot, wasting the chunk
    // and defeating the packing this alignment logic assumes.
    unsafe {
      // Safe: recv_one wrote `nbytes` valid bytes at the front of the buffer,
      // and nbytes <= MAX_MESSAGE_SIZE == the current len.
      self.receive_buffer.set_len(nbytes);
    }

    let buffer = if nbytes <= SMALL_MESSAGE_SIZE {
      if self.small_messages.capacity() < SMALL_MESSAGE_SIZE {
        self.small_messages = BytesMut::with_capacity(SMALL_MESSAGES_CHUNK);
      }
      self
        .small_messages
        .extend_from_slice(&self.receive_buffer);
      self.receive_buffer.clear();
      &mut self.small_messages
    } else {
      &mut self.receive_buffer
    };

    // Now, append some extra data to align the buffer end, so the next piece will
    // be aligned also. This assumes that the initial buffer was aligned to begin
    // with. This is because RTPS data is optimized to align to 4-byte boundaries.
    let pad = padding_needed_for_alignment_4(buffer.len());
    if pad != 0 {
      buffer.extend_from_slice(&[0xCC, 0xCC, 0xCC, 0xCC][..pad]);
      // Funny value 0xCC encourages a fast crash in case these bytes
      // are ever accessed, as they should not.
    }

    // Now split away the used portion.
    let mut message = buffer.split_to(buffer.len());
    message.truncate(nbytes); // discard (hide) padding
    Some((Bytes::from(message), origin)) // freeze bytes
  }

  /// Receive a single datagram into `self.receive_buffer`, capturing its
  /// [`PacketOrigin`]. Returns `Ok(None)` when the socket would block.
  #[cfg(unix)]
  fn recv_one(&mut self) -> io::Result<Option<(usize, PacketOrigin)>> {
    use std::{io::IoSliceMut, os::unix::io::AsRawFd};

    use nix::{
      errno::Errno,
      sys::socket::{recvmsg, ControlMessageOwned, MsgFlags, SockaddrStorage},
    };

    let fd = self.socket.as_raw_fd();
    let flags = if self.keeps_until_handled {
      MsgFlags::MSG_PEEK
    } else {
      MsgFlags::empty()
    };
    let mut cmsg_space = nix::cmsg_space!(nix::libc::in_pktinfo);

    // Read the datagram and pull out the Copy metadata; the borrow of
    // `receive_buffer` (through `iov`) ends when this block ends.
    let (nbytes, source, ifindex, spec_dst) = {
      let mut iov = [IoSliceMut::new(
        &mut self.receive_buffer[..MAX_MESSAGE_SIZE],
      )];
      let msg =
        match recvmsg::<SockaddrStorage>(fd, &mut iov, Some(&mut cmsg_space), flags) {
          Ok(m) => m,
          Err(Errno::EAGAIN) => return Ok(None),
          Err(e) => return Err(io::Error::from_raw_os_error(e as i32)),
        };

      // Also if what came with it cannot be read: it would be received for ever.
      self.is_kept = self.keeps_until_handled;
      let nbytes = msg.bytes;
      let source = msg.address.and_then(sockaddr_storage_to_socketaddr);

      let mut ifindex = 0u32;
      let mut spec_dst: Option<IpAddr> = None;
      for cmsg in msg.cmsgs()? {
        if let ControlMessageOwned::Ipv4PacketInfo(info) = cmsg {
          // libc::in_pktinfo.ipi_ifindex is i32 on older libc (MSRV 1.88) and
          // u32 on newer; keep the cast so both compile.
          #[allow(clippy::unnecessary_cast, clippy::cast_sign_loss)]
          {
            ifindex = info.ipi_ifindex as u32;
          }
          let addr = Ipv4Addr::from(u32::from_be(info.ipi_spec_dst.s_addr));
          if !addr.is_unspecified() {
            spec_dst = Some(IpAddr::V4(addr));
          }
        }
      }
      (nbytes, source, ifindex, spec_dst)
    };

    // Prefer the exact local destination address (matches sender interface
    // keys directly); otherwise resolve the interface index.
    let local_if = spec_dst
      .map(InterfaceSelector::Ip)
      .or_else(|| self.ifindex_map.get(&ifindex).copied());

    Ok(Some((nbytes, PacketOrigin { source, local_if })))
  }

  /// Non-Unix fallback: capture the source address only (no interface info).
  #[cfg(not(unix))]
  fn recv_one(&mut self) -> io::Result<Option<(usize, PacketOrigin)>> {
    match self
      .socket
      .recv_from(&mut self.receive_buffer[..MAX_MESSAGE_SIZE])
    {
      Ok((nbytes, source)) => Ok(Some((
        nbytes,
        PacketOrigin {
          source: Some(source),
          local_if: None,
        },
      ))),
      Err(e) if e.kind() == io::ErrorKind::WouldBlock => Ok(None),
      Err(e) => Err(e),
    }
  }

  #[cfg(test)] // normally done in .drop()
  pub fn leave_multicast(&self, address: &Ipv4Addr) -> io::Result<()> {
    if address.is_multicast() {
      return self
        .socket
        .leave_multicast_v4(address, &Ipv4Addr::UNSPECIFIED);
    }
    io::Result::Err(io::Error::other("Not a multicast address"))
  }
}

#[cfg(unix)]
fn sockaddr_storage_to_socketaddr(addr: nix::sys::socket::SockaddrStorage) -> Option<SocketAddr> {
  use std::net::{SocketAddrV4, SocketAddrV6};
  if let Some(v4) = addr.as_sockaddr_in() {
    Some(SocketAddr::V4(SocketAddrV4::new(v4.ip(), v4.port())))
  } else {
    addr.as_sockaddr_in6().map(|v6| {
      SocketAddr::V6(SocketAddrV6::new(
        v6.ip(),
        v6.port(),
        v6.flowinfo(),
        v6.scope_id(),
      ))
    })
  }
}

#[cfg(test)]
mod tests {
  // use std::os::unix::io::AsRawFd;
  // use nix::sys::socket::setsockopt;
  // use nix::sys::socket::sockopt::IpMulticastLoop;
  use std::{thread, time};

  use super::*;
  use crate::network::udp_sender::*;

  #[test]
  fn udpl_single_address() {
    let listener = UDPListener::new_unicast("127.0.0.1", 10001).unwrap();
    let sender = UDPSender::new_with_random_port().expect("failed to create UDPSender");

    let data: Vec<u8> = vec![0, 1, 2, 3, 4];

    let addrs = vec![SocketAddr::new("127.0.0.1".parse().unwrap(), 10001)];
    sender.send_to_all(&data, &addrs);

    let rec_data = listener.get_message();

    assert_eq!(rec_data.len(), 5); // It appears that this test may randomly fail.
    assert_eq!(rec_data, data);
  }

  // Sends a datagram to a listener, and receives it.
  fn pass(
    listener: &mut UDPListener,
    socket: &std::net::UdpSocket,
    port: u16,
    datagram: &[u8],
  ) -> Bytes {
    socket.send_to(datagram, ("127.0.0.1", port)).unwrap();
    let (received, _) = std::iter::repeat_with(|| listener.next_message())
      .inspect(|message| {
        if message.is_none() {
          thread::sleep(time::Duration::from_millis(1));
        }
      })
      .take(5_000)
      .flatten()
      .next()
      .expect("a datagram");
    received
  }

  // What is kept of a small datagram does not keep the memory of large ones.
  #[test]
  fn small_datagrams_share_memory_with_small_ones_only() {
    let mut listener = UDPListener::new_unicast("127.0.0.1", 10012).unwrap();
    let socket = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let mut small = Vec::new();
    for number in 0..20_u8 {
      for len in [1_001, 60_000] {
        let received = pass(&mut listener, &socket, 10012, &vec![number; len]);
        assert_eq!(received, vec![number; len]);
        if len == 1_001 {
          small.push(received);
        }
      }
    }
    let begin = small[0].as_ptr() as usize;
    for (index, datagram) in small.iter().enumerate() {
      assert_eq!(datagram.as_ptr() as usize, begin + index * 1_004);
    }
  }

  // The next process has a duplicate of the socket.
  #[cfg(unix)]
  #[test]
  fn a_datagram_that_a_killed_process_has_not_handled_is_received_again() {
    let mut listener = UDPListener::new_unicast("127.0.0.1", 10014).unwrap();
    let next = listener.duplicate().unwrap();
    let receive = || {
      let mut datagram = [0; 8];
      next.recv(&mut datagram).ok().map(|_| datagram[0])
    };
    let socket = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    assert_eq!(pass(&mut listener, &socket, 10014, &[1; 8])[0], 1);
    assert_eq!(receive(), None);
    listener.keep_until_handled();
    assert_eq!(pass(&mut listener, &socket, 10014, &[2; 8])[0], 2);
    assert_eq!(receive(), Some(2));
    listener.is_kept = false;
    assert_eq!(pass(&mut listener, &socket, 10014, &[3; 8])[0], 3);
    assert!(listener.next_message().is_none());
    assert_eq!(receive(), None);
    assert_eq!(pass(&mut listener, &socket, 10014, &[4; 8])[0], 4);
    assert_eq!(pass(&mut listener, &socket, 10014, &[5; 8])[0], 5);
    assert_eq!(receive(), Some(5));
    listener.is_kept = false;
    for number in 6..20 {
      socket.send_to(&[number; 8], ("127.0.0.1", 10014)).unwrap();
    }
    listener.discard_all();
    assert_eq!(receive(), None);
  }

  #[test]
  fn large_datagrams_that_are_not_kept_share_one_chunk() {
    let mut listener = UDPListener::new_unicast("127.0.0.1", 10013).unwrap();
    let socket = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let mut pass = |number: u8| pass(&mut listener, &socket, 10013, &[number; 60_000]);
    let begin = pass(0).as_ptr() as usize;
    for number in 1..20 {
      let at = pass(number).as_ptr() as usize;
      assert!((begin..begin + MESSAGE_BUFFER_ALLOCATION_CHUNK).contains(&at));
    }
    // One that is kept stays as it is.
    let kept: Vec<Bytes> = (20..40).map(&mut pass).collect();
    for (datagram, number) in kept.iter().zip(20..) {
      assert_eq!(datagram, &[number; 60_000][..]);
    }
  }

  #[test]
  fn udpl_multicast_address() {
    let listener =
      UDPListener::new_multicast("0.0.0.0", 10002, Ipv4Addr::new(239, 255, 0, 1)).unwrap();
    let sender = UDPSender::new_with_random_port().unwrap();

    // setsockopt(sender.socket.as_raw_fd(), IpMulticastLoop, &true)
    //  .expect("Unable set IpMulticastLoop option on socket");

    let data: Vec<u8> = vec![2, 4, 6];

    sender
      .send_multicast(&data, Ipv4Addr::new(239, 255, 0, 1), 10002)
      .expect("Failed to send multicast");

    thread::sleep(time::Duration::from_secs(1));

    let rec_data = listener.get_message();

    listener
      .leave_multicast(&Ipv4Addr::new(239, 255, 0, 1))
      .unwrap();

    assert_eq!(rec_data.len(), 3);
    assert_eq!(rec_data, data);
  }
}
