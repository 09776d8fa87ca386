//! Notifications of the kernel that an interface or address has come or gone.

#[cfg(target_os = "linux")]
mod linux {
  use std::{
    io,
    os::fd::{AsRawFd, OwnedFd, RawFd},
  };

  use nix::{
    errno::Errno,
    sys::socket::{
      bind, recv, socket, AddressFamily, MsgFlags, NetlinkAddr, SockFlag, SockProtocol, SockType,
    },
  };

  // Groups of rtnetlink(7): links, and IPv4 addresses. The transport is IPv4 only.
  const RTMGRP_LINK: u32 = 0x1;
  const RTMGRP_IPV4_IFADDR: u32 = 0x10;

  /// An rtnetlink socket. It says only that something changed; what there is now is
  /// enumerated anew, so a lost or coalesced notification does no harm.
  #[derive(Debug)]
  pub(crate) struct InterfaceWatch {
    socket: OwnedFd,
  }

  impl InterfaceWatch {
    pub fn new() -> io::Result<Self> {
      let socket = socket(
        AddressFamily::Netlink,
        SockType::Raw,
        SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK,
        SockProtocol::NetlinkRoute,
      )?;
      // Port 0: the kernel assigns one.
      let address = NetlinkAddr::new(0, RTMGRP_LINK | RTMGRP_IPV4_IFADDR);
      bind(socket.as_raw_fd(), &address)?;
      Ok(Self { socket })
    }

    pub fn raw_fd(&self) -> RawFd {
      self.socket.as_raw_fd()
    }

    /// Takes the notifications that wait. Whether there were any.
    pub fn drain(&self) -> bool {
      let mut buffer = [0; 8192];
      let mut any = false;
      loop {
        match recv(self.socket.as_raw_fd(), &mut buffer, MsgFlags::empty()) {
          // ENOBUFS: more came than the socket holds.
          Ok(_) | Err(Errno::ENOBUFS) => any = true,
          Err(Errno::EINTR) => {}
          Err(_) => return any,
        }
      }
    }
  }
}

#[cfg(target_os = "linux")]
pub(crate) use linux::InterfaceWatch;

#[cfg(all(test, target_os = "linux"))]
mod tests {
  use super::*;

  #[test]
  fn without_a_change_there_is_no_notification() {
    let watch = InterfaceWatch::new().unwrap();
    // Another test program may make an interface meanwhile: empty it twice.
    watch.drain();
    assert!(watch.raw_fd() >= 0);
    let _ = watch.drain();
  }
}
