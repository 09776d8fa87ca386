//! Whether a datagram holds a sample or a part of one, and whose, told without
//! reading it properly.
//!
//! An application that is to get up for a sample can begin to while it is being
//! received; see `DomainParticipantBuilder::on_sample_arriving`.

use crate::{
  messages::submessages::submessage_kind::SubmessageKind,
  rtps::message::{RTPS_MESSAGE_HEADER_SIZE, SUBMESSAGE_HEADER_SIZE},
  structure::{guid::EntityKind, sequence_number::SequenceNumber},
};

// RTPS 2.5, clause 9.4.4: the header ends with the prefix of the sender's GUID.
const PREFIX_BYTES: usize = 12;

// Clause 9.3.1.2: three for the key, one for the kind.
const ENTITY_ID_BYTES: usize = 4;

// Clause 9.4.5.4: extra flags, octetsToInlineQos and the reader's id come before
// the writer's, of which the last byte is its kind.
const DATA_WRITER_AT: usize = 4 + ENTITY_ID_BYTES;

// INFO_DST, INFO_TS and such come before a sample. A message may have any number of
// submessages; what is not found among the first ones is not waited for.
const SUBMESSAGES_LOOKED_AT: usize = 4;

// Clause 9.4.5.5: behind the sample's number.
const FRAGMENTS_AT: usize = DATA_WRITER_AT + ENTITY_ID_BYTES + 8;

/// What a datagram seems to hold.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Arriving {
  // Its GUID.
  pub writer: [u8; PREFIX_BYTES + ENTITY_ID_BYTES],
  pub number: SequenceNumber,
  // Bytes of the sample behind what this datagram has of it; of a whole one none.
  pub left_bytes: u32,
}

/// The GUID of the writer of the first sample in a datagram, if it holds one of a
/// user's writer or a part of one, the sample's sequence number, and how many of
/// its bytes come after this datagram: what the datagram claims; nothing is
/// checked. The datagram's first 256 bytes are enough, as a rule.
pub fn sample_arriving(datagram: &[u8]) -> Option<([u8; 16], i64, usize)> {
  let arriving = sample_in(datagram)?;
  Some((arriving.writer, arriving.number.into(), arriving.left_bytes as usize))
}

/// The first sample of a user's writer, or fragments of one, if there are any.
/// What is malformed has none.
pub(crate) fn sample_in(datagram: &[u8]) -> Option<Arriving> {
  if !datagram.starts_with(b"RTPS") {
    return None;
  }
  let prefix = datagram.get(RTPS_MESSAGE_HEADER_SIZE - PREFIX_BYTES..RTPS_MESSAGE_HEADER_SIZE)?;
  let mut rest = datagram.get(RTPS_MESSAGE_HEADER_SIZE..)?;
  for _ in 0..SUBMESSAGES_LOOKED_AT {
    // Clause 9.4.5.1: kind, flags, and the length of what follows.
    let (&[kind, flags, low, high], content) =
      rest.split_first_chunk::<SUBMESSAGE_HEADER_SIZE>()?;
    let words = Words {
      content,
      is_little_endian: flags & 1 == 1,
    };
    let is_fragment = kind == u8::from(SubmessageKind::DATA_FRAG);
    if is_fragment || kind == u8::from(SubmessageKind::DATA) {
      let id = content.get(DATA_WRITER_AT..DATA_WRITER_AT + ENTITY_ID_BYTES)?;
      let mut guid = [0; PREFIX_BYTES + ENTITY_ID_BYTES];
      guid[..PREFIX_BYTES].copy_from_slice(prefix);
      guid[PREFIX_BYTES..].copy_from_slice(id);
      let is_of_a_user = id.last().is_some_and(|kind| EntityKind::from(*kind).is_user_defined());
      // Clause 9.3.2: its high half, then its low one.
      let high = words.at(DATA_WRITER_AT + ENTITY_ID_BYTES)?.cast_signed();
      let low = words.at(DATA_WRITER_AT + ENTITY_ID_BYTES + 4)?;
      let number = SequenceNumber::from((i64::from(high) << 32) | i64::from(low));
      let left_bytes = if is_fragment { words.left_bytes()? } else { 0 };
      return is_of_a_user.then(|| Arriving {
        writer: guid,
        number,
        left_bytes,
      });
    }
    let length = if words.is_little_endian {
      u16::from_le_bytes([low, high])
    } else {
      u16::from_be_bytes([low, high])
    };
    // The last one may say 0, and so do those that are empty.
    rest = content.get(usize::from(length)..)?;
  }
  None
}

// The words of a submessage.
struct Words<'a> {
  content: &'a [u8],
  is_little_endian: bool,
}

impl Words<'_> {
  fn at(&self, at: usize) -> Option<u32> {
    let bytes = *self.content.get(at..)?.first_chunk::<4>()?;
    Some(if self.is_little_endian {
      u32::from_le_bytes(bytes)
    } else {
      u32::from_be_bytes(bytes)
    })
  }

  // Of a DATA_FRAG: the first fragment's number, from 1 on, how many there are, the
  // size of each, and that of the sample.
  fn left_bytes(&self) -> Option<u32> {
    let first = self.at(FRAGMENTS_AT)?.checked_sub(1)?;
    let two = self.at(FRAGMENTS_AT + 4)?;
    let (count, size) = if self.is_little_endian {
      (two & 0xffff, two >> 16)
    } else {
      (two >> 16, two & 0xffff)
    };
    let here = u64::from(first).saturating_add(u64::from(count)) * u64::from(size);
    let sample_size = self.at(FRAGMENTS_AT + 8)?;
    Some(sample_size.saturating_sub(u32::try_from(here).unwrap_or(u32::MAX)))
  }
}

#[cfg(test)]
mod tests {
  use super::*;

  const USER_WRITER: u8 = 0x03;
  const BUILTIN_WRITER: u8 = 0xc3;

  fn submessage(kind: SubmessageKind, flags: u8, content: &[u8]) -> Vec<u8> {
    let length = content.len() as u16;
    let length = if flags & 1 == 1 {
      length.to_le_bytes()
    } else {
      length.to_be_bytes()
    };
    [&[u8::from(kind), flags], &length[..], content].concat()
  }

  fn data(flags: u8, writer_kind: u8) -> Vec<u8> {
    let mut content = vec![0; 40];
    content[DATA_WRITER_AT..][..ENTITY_ID_BYTES].copy_from_slice(&[1, 2, 3, writer_kind]);
    let halves = if flags & 1 == 1 {
      [1_u32.to_le_bytes(), 5_u32.to_le_bytes()]
    } else {
      [1_u32.to_be_bytes(), 5_u32.to_be_bytes()]
    };
    content[DATA_WRITER_AT + ENTITY_ID_BYTES..][..8].copy_from_slice(&halves.concat());
    submessage(SubmessageKind::DATA, flags, &content)
  }

  fn fragments(flags: u8, first: u32, count: u16, size: u16, sample_size: u32) -> Vec<u8> {
    let mut content = data(flags, USER_WRITER)[SUBMESSAGE_HEADER_SIZE..].to_vec();
    let tail = if flags & 1 == 1 {
      [
        &first.to_le_bytes()[..],
        &count.to_le_bytes(),
        &size.to_le_bytes(),
        &sample_size.to_le_bytes(),
      ]
      .concat()
    } else {
      [
        &first.to_be_bytes()[..],
        &count.to_be_bytes(),
        &size.to_be_bytes(),
        &sample_size.to_be_bytes(),
      ]
      .concat()
    };
    content[FRAGMENTS_AT..][..tail.len()].copy_from_slice(&tail);
    submessage(SubmessageKind::DATA_FRAG, flags, &content)
  }

  #[test]
  fn the_bytes_after_a_fragment_are_counted() {
    for flags in [0, 1] {
      let left = |first, count, size, sample_size| {
        let found = sample_in(&message(&[fragments(flags, first, count, size, sample_size)]));
        found.map(|found| (i64::from(found.number) & 0xffff, found.left_bytes))
      };
      assert_eq!(left(1, 1, 1000, 2500), Some((5, 1500)));
      assert_eq!(left(2, 1, 1000, 2500), Some((5, 500)));
      assert_eq!(left(3, 1, 1000, 2500), Some((5, 0)));
      assert_eq!(left(1, 3, 1000, 2500), Some((5, 0)));
      assert_eq!(left(u32::MAX, u16::MAX, u16::MAX, u32::MAX), Some((5, 0)));
      assert_eq!(left(0, 1, 1000, 2500), None);
    }
  }

  fn message(submessages: &[Vec<u8>]) -> Vec<u8> {
    let header = [&b"RTPS"[..], &[2, 4, 1, 0], &[9; PREFIX_BYTES]].concat();
    [header, submessages.concat()].concat()
  }

  #[test]
  fn a_sample_is_found_behind_what_comes_before_it() {
    let writer = [&[9; PREFIX_BYTES][..], &[1, 2, 3, USER_WRITER]].concat();
    let expected = Some(Arriving {
      writer: writer.try_into().unwrap(),
      number: SequenceNumber::from((1_i64 << 32) + 5),
      left_bytes: 0,
    });
    for flags in [0, 1] {
      let destination = submessage(SubmessageKind::INFO_DST, flags, &[7; 12]);
      let timestamp = submessage(SubmessageKind::INFO_TS, flags, &[7; 8]);
      let sample = data(flags, USER_WRITER);
      let found = sample_in(&message(&[sample.clone()]));
      assert_eq!(found, expected);
      let found = sample_in(&message(&[destination, timestamp, sample]));
      assert_eq!(found, expected);
    }
  }

  #[test]
  fn nothing_else_is_one() {
    let heartbeat = submessage(SubmessageKind::HEARTBEAT, 1, &[0; 28]);
    let fragment = submessage(SubmessageKind::DATA_FRAG, 1, &[BUILTIN_WRITER; 60]);
    for other in [
      message(&[]),
      message(&[heartbeat.clone()]),
      message(&[fragment]),
      message(&[data(1, BUILTIN_WRITER)]),
      [b"HTTP".to_vec(), message(&[data(1, USER_WRITER)])[4..].to_vec()].concat(),
      message(&[vec![heartbeat; SUBMESSAGES_LOOKED_AT].concat(), data(1, USER_WRITER)]),
    ] {
      assert_eq!(sample_in(&other), None, "{other:?}");
    }
  }

  #[test]
  fn no_cut_of_a_message_is_too_short_to_be_looked_at() {
    let whole = message(&[
      submessage(SubmessageKind::INFO_TS, 1, &[7; 8]),
      data(1, USER_WRITER),
    ]);
    let first = (0..=whole.len()).find(|length| sample_in(&whole[..*length]).is_some());
    // Behind the writer's id and the sample's number.
    let content = DATA_WRITER_AT + ENTITY_ID_BYTES + 8;
    assert_eq!(first, Some(RTPS_MESSAGE_HEADER_SIZE + 12 + 4 + content));
    let padding = submessage(SubmessageKind::PAD, 1, &[0; 9]);
    assert_eq!(sample_in(&message(&[padding])), None);
    assert_eq!(sample_in(&message(&[vec![0x09, 1, 0xff, 0xff]])), None);
  }
}
