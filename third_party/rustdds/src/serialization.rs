use std::{cmp::min, io};

use bytes::Bytes;
use speedy::{Endianness, Readable};

mod cdr_adapters;

pub(crate) mod pl_cdr_adapters;
pub(crate) mod speedy_pl_cdr_helpers;

mod representation_identifier;

// Most of the CDR encoding/decoding comes from this external crate
pub use cdr_encoding::{
  from_bytes, to_vec, to_writer, CdrDeserializer, CdrSerializer, Error, Result,
};
// Export some parts of inner modules
pub use cdr_adapters::{
  deserialize_from_cdr_with_decoder_and_rep_id, deserialize_from_cdr_with_rep_id,
  to_writer_with_rep_id, CDRDeserializerAdapter, CDRSerializerAdapter, CdrDeserializeSeedDecoder,
};
pub use representation_identifier::RepresentationIdentifier;

/// Reads a value at the position of the cursor, which moves to its end.
///
/// A reader of speedy for streams allocates and clears a buffer for each value. This one
/// reads from the buffer that is already there.
pub(crate) fn read_at<'a, T: Readable<'a, Endianness>>(
  cursor: &mut io::Cursor<&'a Bytes>,
  endianness: Endianness,
) -> io::Result<T> {
  let buffer: &'a Bytes = cursor.get_ref();
  let begin = min(cursor.position(), buffer.len() as u64);
  let (value, len) =
    T::read_with_length_from_buffer_with_ctx(endianness, &buffer[begin as usize..]);
  cursor.set_position(begin + len as u64);
  value.map_err(io::Error::other)
}

// Compute how much padding bytes are needed to
// get the next multiple of 4
pub fn padding_needed_for_alignment_4(unaligned_length: usize) -> usize {
  if !unaligned_length.is_multiple_of(4) {
    4 - (unaligned_length % 4)
  } else {
    0
  }
}

pub fn round_up_to_4(unaligned_length: usize) -> usize {
  unaligned_length + padding_needed_for_alignment_4(unaligned_length)
}
