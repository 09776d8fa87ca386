//! Captures packets at the interface of a remote subscriber's host and counts packets, IP fragments and RTPS
//! submessages. The counts show whether a lane sends fragments, how often writers send heartbeats, and how
//! often readers request repairs.

use std::os::fd::{AsRawFd, OwnedFd};

use nix::errno::Errno;
use nix::sys::socket::{
    AddressFamily, LinkAddr, SockFlag, SockProtocol, SockType, recvfrom, setsockopt, socket, sockopt,
};

use crate::bed::Network;
use crate::error::EvalError;

/// Linux's types of captured packets and of interfaces (linux/if_packet.h, linux/if_arp.h).
const PACKET_OUTGOING: u8 = 4;
const ARPHRD_LOOPBACK: u16 = 772;

/// The socket's receive buffer, for the packets between two turns of the harness.
const RECEIVE_BUFFER_BYTES: usize = 32 << 20;
/// The length at which packets are truncated; longer than an Ethernet frame, so that all headers are
/// complete.
const PACKET_BYTES: usize = 2_048;

/// Counts of captured packets and submessages in one direction, since the start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Tally {
    packets: u64,
    bytes: u64,
    fragments: u64,
    data: u64,
    data_frag: u64,
    heartbeat: u64,
    acknack: u64,
    nack_frag: u64,
    gap: u64,
    user_data: u64,
    user_heartbeat: u64,
    user_acknack: u64,
}

impl Tally {
    pub const COLUMNS: &str = "packets,bytes,fragments,data,data_frag,heartbeat,acknack,nack_frag,gap,user_data,\
                               user_heartbeat,user_acknack";

    /// The values of a row.
    pub fn row(&self) -> [u64; 12] {
        let Self { packets, bytes, fragments, data, data_frag, heartbeat, acknack, nack_frag, gap, .. } =
            *self;
        let Self { user_data, user_heartbeat, user_acknack, .. } = *self;
        [
            packets,
            bytes,
            fragments,
            data,
            data_frag,
            heartbeat,
            acknack,
            nack_frag,
            gap,
            user_data,
            user_heartbeat,
            user_acknack,
        ]
    }

    /// Counts an IP packet of `length` bytes that starts with `packet`; ignores packets other than UDP over
    /// IPv4.
    fn add(&mut self, packet: &[u8], length: usize) {
        let Some(ip) = packet.get(..20) else { return };
        let header = usize::from(ip[0] & 0x0f) * 4;
        if ip[0] >> 4 != 4 || ip[9] != 17 || header < 20 {
            return;
        }
        self.packets += 1;
        self.bytes += length as u64;
        let flags_and_offset = u16::from_be_bytes([ip[6], ip[7]]);
        let (more, offset) = (flags_and_offset & 0x2000 != 0, flags_and_offset & 0x1fff);
        self.fragments += u64::from(more || offset > 0);
        if offset == 0
            && let Some(payload) = packet.get(header + 8..)
            && payload.starts_with(b"RTPS")
            && let Some(submessages) = payload.get(20..)
        {
            self.add_submessages(submessages);
        }
    }

    fn add_submessages(&mut self, mut rest: &[u8]) {
        while let Some((&[id, flags, low, high], body)) = rest.split_first_chunk() {
            let length = match flags & 1 {
                0 => u16::from_be_bytes([low, high]),
                _ => u16::from_le_bytes([low, high]),
            };
            // The position of the writer's entity kind: at the end of the second entity id, which in DATA
            // follows 4 bytes of flags.
            let (counter, user, kind_at) = match id {
                0x06 => (&mut self.acknack, Some(&mut self.user_acknack), 7),
                0x07 => (&mut self.heartbeat, Some(&mut self.user_heartbeat), 7),
                0x08 => (&mut self.gap, None, 7),
                0x12 => (&mut self.nack_frag, Some(&mut self.user_acknack), 7),
                0x13 => (&mut self.heartbeat, Some(&mut self.user_heartbeat), 7),
                0x15 => (&mut self.data, Some(&mut self.user_data), 11),
                0x16 => (&mut self.data_frag, Some(&mut self.user_data), 11),
                _ => (&mut 0, None, 0),
            };
            *counter += 1;
            // The two upper bits of the entity kind are 11 for built-in entities, and 00 for user entities.
            if let (Some(user), Some(0)) = (user, body.get(kind_at).map(|kind| kind >> 6)) {
                *user += 1;
            }
            // A length of 0 means that the submessage extends to the end of the message.
            rest = match usize::from(length) {
                0 if id != 0x01 && id != 0x09 => &[],
                length => body.get(length..).unwrap_or_default(),
            };
        }
    }
}

/// The packet capture at one host.
pub(super) struct Capture {
    pub port: String,
    socket: OwnedFd,
    to_host: Tally,
    from_host: Tally,
}

impl Capture {
    /// Starts to capture at a host.
    pub fn open(port: &str, network: &Network) -> Result<Self, EvalError> {
        let refused = |error: Errno| EvalError::new(format!("a packet socket at {port}: {error}"));
        let flags = SockFlag::SOCK_CLOEXEC | SockFlag::SOCK_NONBLOCK;
        // Datagram: packets without the link-layer header.
        let open = || {
            socket(AddressFamily::Packet, SockType::Datagram, flags, SockProtocol::EthAll).map_err(refused)
        };
        let socket = network.within(open)?;
        // Above the system's limit where the process may, otherwise up to it.
        if setsockopt(&socket, sockopt::RcvBufForce, &RECEIVE_BUFFER_BYTES).is_err() {
            setsockopt(&socket, sockopt::RcvBuf, &RECEIVE_BUFFER_BYTES).map_err(refused)?;
        }
        let (to_host, from_host) = (Tally::default(), Tally::default());
        Ok(Self { port: port.to_owned(), socket, to_host, from_host })
    }

    /// Counts the packets captured since the last call.
    pub fn count_packets(&mut self) {
        let mut packet = [0; PACKET_BYTES];
        while let Ok((length, Some(link))) = recvfrom::<LinkAddr>(self.socket.as_raw_fd(), &mut packet) {
            if link.hatype() == ARPHRD_LOOPBACK {
                continue;
            }
            let captured = &packet[..length.min(PACKET_BYTES)];
            // The length in the IP header, as the captured packet may be truncated.
            let whole =
                captured.get(2..4).map_or(length, |it| usize::from(u16::from_be_bytes([it[0], it[1]])));
            let tally =
                if link.pkttype() == PACKET_OUTGOING { &mut self.from_host } else { &mut self.to_host };
            tally.add(captured, whole);
        }
    }

    /// The counts of each direction.
    pub fn tallies(&self) -> [(&'static str, &Tally); 2] {
        [("to_host", &self.to_host), ("from_host", &self.from_host)]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn packet(flags_and_offset: u16, protocol: u8, payload: &[u8]) -> Vec<u8> {
        let mut packet = vec![0; 20];
        packet[0] = 0x45;
        packet[6..8].copy_from_slice(&flags_and_offset.to_be_bytes());
        packet[9] = protocol;
        packet.extend([0; 8]);
        packet.extend(payload);
        packet
    }

    fn rtps(submessages: &[&[u8]]) -> Vec<u8> {
        let mut message = b"RTPS".to_vec();
        message.resize(20, 0);
        message.extend(submessages.concat());
        message
    }

    fn submessage(id: u8, kind_at: usize, kind: u8) -> Vec<u8> {
        let mut body = vec![0; 16];
        body[kind_at] = kind;
        [vec![id, 1, 16, 0], body].concat()
    }

    #[test]
    fn submessages_of_user_and_built_in_entities_are_counted_separately() {
        let message = rtps(&[
            &submessage(0x0e, 0, 0),
            &submessage(0x15, 11, 0x03),
            &submessage(0x07, 7, 0xc2),
            &submessage(0x07, 7, 0x03),
            &submessage(0x06, 7, 0x02),
            &submessage(0x12, 7, 0x03),
            &submessage(0x16, 11, 0xc2),
            &submessage(0x08, 7, 0x03),
        ]);
        let mut tally = Tally::default();
        let bytes = packet(0, 17, &message);
        tally.add(&bytes, bytes.len());
        let expected = Tally {
            packets: 1,
            bytes: bytes.len() as u64,
            data: 1,
            data_frag: 1,
            heartbeat: 2,
            acknack: 1,
            nack_frag: 1,
            gap: 1,
            user_data: 1,
            user_heartbeat: 1,
            user_acknack: 2,
            fragments: 0,
        };
        assert_eq!(tally, expected);
        assert_eq!(tally.row().len(), Tally::COLUMNS.split(',').count());
    }

    #[test]
    fn fragments_count_and_only_the_first_has_submessages() {
        let message = rtps(&[&submessage(0x15, 11, 0x03)]);
        let mut tally = Tally::default();
        for flags_and_offset in [0x2000, 0x2000 | 185, 370] {
            tally.add(&packet(flags_and_offset, 17, &message), 1_500);
        }
        assert_eq!((tally.packets, tally.fragments, tally.data, tally.bytes), (3, 3, 1, 4_500));
    }

    #[test]
    fn the_last_submessage_may_have_length_0_and_packets_may_be_truncated() {
        let mut data = submessage(0x15, 11, 0x03);
        data[2] = 0;
        let message = rtps(&[&submessage(0x0e, 0, 0), &data]);
        let whole = packet(0, 17, &message);
        for length in 0..whole.len() {
            Tally::default().add(&whole[..length], length);
        }
        let mut tally = Tally::default();
        tally.add(&whole, whole.len());
        assert_eq!(tally.user_data, 1);
        // Not UDP, not IPv4, not RTPS.
        let mut tally = Tally::default();
        tally.add(&packet(0, 6, &message), 100);
        tally.add(&[0x60; 40], 40);
        tally.add(&packet(0, 17, b"other"), 33);
        assert_eq!((tally.packets, tally.data), (1, 0));
    }
}
