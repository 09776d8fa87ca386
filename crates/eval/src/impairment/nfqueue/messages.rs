//! The netlink messages of the kernel's packet queue (linux/netfilter/nfnetlink_queue.h) that bind a queue,
//! deliver packets and return verdicts. Pure: bytes in, bytes out.
//!
//! Netlink headers are in the machine's byte order, values of attributes in network byte order.

use super::super::link::Arrival;

const HEADER_BYTES: usize = 16;
/// Size of `struct nfgenmsg`: family, version, and the number of the queue.
const QUEUE_HEADER_BYTES: usize = 4;
const ATTRIBUTE_HEADER_BYTES: usize = 4;

const REQUEST: u16 = 1;
const ACKNOWLEDGE: u16 = 4;
const TYPE_ERROR: u16 = 2;
/// The subsystem of netfilter's queues, in the upper byte of a message's type.
const SUBSYSTEM: u16 = 3 << 8;
const TYPE_PACKET: u16 = SUBSYSTEM;
const TYPE_VERDICT: u16 = SUBSYSTEM | 1;
const TYPE_CONFIG: u16 = SUBSYSTEM | 2;

const CONFIG_COMMAND: u16 = 1;
const CONFIG_PARAMETERS: u16 = 2;
const CONFIG_MAX_LENGTH: u16 = 3;
const COMMAND_BIND: u8 = 1;
const COPY_PACKET: u8 = 2;

const PACKET_HEADER: u16 = 1;
const VERDICT_HEADER: u16 = 2;
const PAYLOAD: u16 = 10;
/// Mask of an attribute's type without its flags.
const TYPE_MASK: u16 = 0x3fff;

const VERDICT_DROP: u32 = 0;
const VERDICT_ACCEPT: u32 = 1;

/// Bytes of each packet that the kernel copies: the IPv4 header without options, for length and fragment
/// bits.
pub(super) const COPIED_BYTES: u32 = 20;
/// Mask of `MF` and the fragment offset, in the fourth 16-bit word of the IPv4 header (RFC 791).
const FRAGMENT_MASK: u16 = 0x3fff;

/// Builds the request to listen on a queue.
pub(super) fn bind(queue: u16, sequence: u32) -> Vec<u8> {
    // Command, padding, and a protocol family that the kernel ignores.
    config(queue, sequence, CONFIG_COMMAND, &[COMMAND_BIND, 0, 0, 0])
}

/// Builds the request to limit the packets that wait in the kernel for a verdict.
pub(super) fn set_max_length(queue: u16, sequence: u32, packets: u32) -> Vec<u8> {
    config(queue, sequence, CONFIG_MAX_LENGTH, &packets.to_be_bytes())
}

/// Builds the request to deliver the first [`COPIED_BYTES`] of each packet.
pub(super) fn set_copy(queue: u16, sequence: u32) -> Vec<u8> {
    let [a, b, c, d] = COPIED_BYTES.to_be_bytes();
    config(queue, sequence, CONFIG_PARAMETERS, &[a, b, c, d, COPY_PACKET])
}

fn config(queue: u16, sequence: u32, attribute: u16, value: &[u8]) -> Vec<u8> {
    let mut message = Vec::new();
    put(&mut message, TYPE_CONFIG, REQUEST | ACKNOWLEDGE, sequence, queue, (attribute, value));
    message
}

/// Appends the verdict on a packet.
pub(super) fn put_verdict(messages: &mut Vec<u8>, queue: u16, packet: u32, accept: bool) {
    let verdict = if accept { VERDICT_ACCEPT } else { VERDICT_DROP };
    let mut value = [0; 8];
    value[..4].copy_from_slice(&verdict.to_be_bytes());
    value[4..].copy_from_slice(&packet.to_be_bytes());
    put(messages, TYPE_VERDICT, REQUEST, 0, queue, (VERDICT_HEADER, &value));
}

fn put(
    messages: &mut Vec<u8>,
    kind: u16,
    flags: u16,
    sequence: u32,
    queue: u16,
    (attribute, value): (u16, &[u8]),
) {
    let attribute_bytes = ATTRIBUTE_HEADER_BYTES + value.len();
    let bytes = HEADER_BYTES + QUEUE_HEADER_BYTES + attribute_bytes.next_multiple_of(4);
    let end = messages.len() + bytes;
    messages.extend((bytes as u32).to_ne_bytes());
    messages.extend(kind.to_ne_bytes());
    messages.extend(flags.to_ne_bytes());
    messages.extend(sequence.to_ne_bytes());
    // The port id: 0, as the kernel knows the sender.
    messages.extend(0_u32.to_ne_bytes());
    // Any family, version 0.
    messages.extend([0, 0]);
    messages.extend(queue.to_be_bytes());
    messages.extend((attribute_bytes as u16).to_ne_bytes());
    messages.extend(attribute.to_ne_bytes());
    messages.extend(value);
    messages.resize(end, 0);
}

/// A message of the kernel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Message {
    /// A packet that waits for a verdict.
    Packet(Arrival),
    /// The answer to a request.
    Answer {
        /// The sequence number of the request.
        sequence: u32,
        /// 0 for success, otherwise a value of errno(3).
        error: i32,
    },
    /// Something else, or something malformed.
    Other,
}

/// Parses the messages of one datagram. A malformed message is [`Message::Other`]; it is the last one if its
/// length is invalid.
pub(super) fn messages(datagram: &[u8]) -> impl Iterator<Item = Message> {
    let mut rest = datagram;
    std::iter::from_fn(move || {
        if rest.is_empty() {
            return None;
        }
        let bytes = u32_at(rest, 0).map_or(0, |bytes| bytes as usize);
        let Some(message) = rest.get(..bytes).filter(|_| bytes >= HEADER_BYTES) else {
            rest = &[];
            return Some(Message::Other);
        };
        rest = rest.get(bytes.next_multiple_of(4)..).unwrap_or_default();
        Some(parse(message).unwrap_or(Message::Other))
    })
}

fn parse(message: &[u8]) -> Option<Message> {
    match u16_at(message, 4)? {
        TYPE_ERROR => {
            let error = u32_at(message, HEADER_BYTES)?.cast_signed();
            Some(Message::Answer { sequence: u32_at(message, 8)?, error: error.checked_neg()? })
        }
        TYPE_PACKET => {
            let attributes = message.get(HEADER_BYTES + QUEUE_HEADER_BYTES..)?;
            let packet = attribute(attributes, PACKET_HEADER)?.first_chunk()?;
            let header = attribute(attributes, PAYLOAD).unwrap_or_default();
            let half = |at: usize| header.get(at..)?.first_chunk().copied().map(u16::from_be_bytes);
            Some(Message::Packet(Arrival {
                packet: u32::from_be_bytes(*packet),
                bytes: half(2).map_or(0, u32::from),
                fragment: half(6).is_some_and(|half| half & FRAGMENT_MASK != 0),
            }))
        }
        _ => None,
    }
}

/// Returns the value of the first attribute of this kind.
fn attribute(mut attributes: &[u8], kind: u16) -> Option<&[u8]> {
    loop {
        let bytes = usize::from(u16_at(attributes, 0)?);
        let value = attributes.get(ATTRIBUTE_HEADER_BYTES..bytes)?;
        if u16_at(attributes, 2)? & TYPE_MASK == kind {
            return Some(value);
        }
        attributes = attributes.get(bytes.next_multiple_of(4)..)?;
    }
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..)?.first_chunk().copied().map(u32::from_ne_bytes)
}

fn u16_at(bytes: &[u8], at: usize) -> Option<u16> {
    bytes.get(at..)?.first_chunk().copied().map(u16::from_ne_bytes)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    /// A packet as the kernel delivers it: an attribute that is ignored, then header and payload.
    fn packet(id: u32, payload: &[u8]) -> Vec<u8> {
        let mut message = Vec::new();
        put(&mut message, TYPE_PACKET, 0, 0, 7, (5, &[0, 0, 0, 2]));
        let mut append = |kind: u16, value: &[u8]| {
            message.extend((4 + value.len() as u16).to_ne_bytes());
            message.extend(kind.to_ne_bytes());
            message.extend(value);
            message.resize(message.len().next_multiple_of(4), 0);
        };
        let [a, b, c, d] = id.to_be_bytes();
        append(PACKET_HEADER, &[a, b, c, d, 8, 0, 0]);
        append(PAYLOAD, payload);
        let bytes = (message.len() as u32).to_ne_bytes();
        message[..4].copy_from_slice(&bytes);
        message
    }

    fn ipv4(bytes: u16, flags_and_offset: u16) -> [u8; 20] {
        let mut header = [0; 20];
        header[0] = 0x45;
        header[2..4].copy_from_slice(&bytes.to_be_bytes());
        header[6..8].copy_from_slice(&flags_and_offset.to_be_bytes());
        header
    }

    #[test]
    fn a_verdict_has_the_bytes_of_the_kernels_definition() {
        let mut message = Vec::new();
        put_verdict(&mut message, 0x0102, 0x0a0b_0c0d, true);
        let mut expected = Vec::new();
        expected.extend(32_u32.to_ne_bytes());
        expected.extend(0x0301_u16.to_ne_bytes());
        expected.extend(1_u16.to_ne_bytes());
        expected.extend([0; 8]);
        expected.extend([0, 0, 1, 2]);
        expected.extend(12_u16.to_ne_bytes());
        expected.extend(2_u16.to_ne_bytes());
        expected.extend([0, 0, 0, 1, 10, 11, 12, 13]);
        assert_eq!(message, expected);
        put_verdict(&mut message, 0x0102, 0x0a0b_0c0d, false);
        assert_eq!(message.len(), 64);
        assert_eq!(message[56..60], [0, 0, 0, 0]);
    }

    #[test]
    fn requests_that_set_up_a_queue_have_valid_lengths_and_padding() {
        for (message, attribute_bytes, kind) in [
            (bind(7, 1), 8_u16, CONFIG_COMMAND),
            (set_max_length(7, 2, 100), 8, CONFIG_MAX_LENGTH),
            (set_copy(7, 3), 9, CONFIG_PARAMETERS),
        ] {
            assert_eq!(u32_at(&message, 0), Some(message.len() as u32));
            assert_eq!(message.len() % 4, 0);
            assert_eq!(u16_at(&message, 6), Some(REQUEST | ACKNOWLEDGE));
            assert_eq!((u16_at(&message, 20), u16_at(&message, 22)), (Some(attribute_bytes), Some(kind)));
        }
    }

    #[test]
    fn packets_and_fragments_are_parsed() {
        let mut datagram = Vec::new();
        // Whole; whole with DF set; the first fragment; the last one.
        for (id, flags) in [(1, 0), (2, 0x4000), (3, 0x2000), (4, 0x00b9)] {
            datagram.extend(packet(id, &ipv4(1500, flags)));
        }
        let read: Vec<Message> = messages(&datagram).collect();
        let expected = |packet, fragment| Message::Packet(Arrival { packet, bytes: 1500, fragment });
        assert_eq!(read, [expected(1, false), expected(2, false), expected(3, true), expected(4, true)]);
        let without_payload: Vec<Message> = messages(&packet(9, &[])).collect();
        assert_eq!(without_payload, [Message::Packet(Arrival { packet: 9, bytes: 0, fragment: false })]);
    }

    #[test]
    fn an_answer_is_parsed() {
        let mut message = Vec::new();
        put(&mut message, TYPE_ERROR, 0, 77, 0, (0, &[]));
        message[HEADER_BYTES..HEADER_BYTES + 4].copy_from_slice(&(-1_i32).to_ne_bytes());
        let read: Vec<Message> = messages(&message).collect();
        assert_eq!(read, [Message::Answer { sequence: 77, error: 1 }]);
    }

    proptest! {
        #[test]
        fn parsing_any_bytes_terminates(
            mut datagram in proptest::collection::vec(any::<u8>(), 0..200),
            changes in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..8),
            valid: bool,
        ) {
            if valid {
                datagram = packet(1, &ipv4(20, 0));
                datagram.extend(packet(2, &ipv4(20, 0)));
                for (at, value) in changes {
                    let at = at.index(datagram.len());
                    datagram[at] = value;
                }
            }
            prop_assert!(messages(&datagram).count() <= datagram.len() / HEADER_BYTES + 1);
        }
    }
}
