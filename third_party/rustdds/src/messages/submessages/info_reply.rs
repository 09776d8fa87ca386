use speedy::{Context, Endianness, Readable, Writable, Writer};

use crate::structure::locator::Locator;

/// This message is sent from an RTPS Reader to an RTPS Writer.
/// It contains explicit information on where to send a reply
/// to the Submessages that follow it within the same message.
#[derive(Debug, PartialEq, Eq, Clone)]
pub struct InfoReply {
  /// Indicates an alternative set of unicast addresses that
  /// the Writer should use to reach the Readers when
  /// replying to the Submessages that follow.
  pub unicast_locator_list: Vec<Locator>,

  /// Indicates an alternative set of multicast addresses that the Writer
  /// should use to reach the Readers when replying to the Submessages that
  /// follow.
  ///
  /// Only present when the MulticastFlag is set.
  pub multicast_locator_list: Option<Vec<Locator>>,
}

impl InfoReply {
  /// Reads the lists of a submessage, the second one if its MulticastFlag is set.
  pub fn read(
    endianness: Endianness,
    content: &[u8],
    has_multicast: bool,
  ) -> Result<Self, speedy::Error> {
    let (unicast, read) = Vec::<Locator>::read_with_length_from_buffer_with_ctx(endianness, content);
    let rest = content.get(read..).unwrap_or_default();
    Ok(Self {
      unicast_locator_list: unicast?,
      multicast_locator_list: has_multicast
        .then(|| Vec::read_from_buffer_with_ctx(endianness, rest))
        .transpose()?,
    })
  }
}

impl<C: Context> Writable<C> for InfoReply {
  fn write_to<T: ?Sized + Writer<C>>(&self, writer: &mut T) -> Result<(), C::Error> {
    writer.write_value(&self.unicast_locator_list)?;
    match &self.multicast_locator_list {
      Some(list) => writer.write_value(list),
      None => Ok(()),
    }
  }
}

#[cfg(test)]
mod tests {
  use super::*;

  #[test]
  fn the_second_list_is_there_if_the_flag_says_so() {
    let locator = |port| Locator::from(std::net::SocketAddr::from(([127, 0, 0, 1], port)));
    for multicast_locator_list in [None, Some(vec![]), Some(vec![locator(7400)])] {
      let has_multicast = multicast_locator_list.is_some();
      let reply = InfoReply {
        unicast_locator_list: vec![locator(7410), locator(7411)],
        multicast_locator_list,
      };
      for endianness in [Endianness::LittleEndian, Endianness::BigEndian] {
        let written = reply.write_to_vec_with_ctx(endianness).unwrap();
        let read = InfoReply::read(endianness, &written, has_multicast);
        assert_eq!(read.as_ref().ok(), Some(&reply));
        let cut = InfoReply::read(endianness, &written[..written.len() - 1], has_multicast);
        assert!(cut.is_err(), "{cut:?}");
      }
    }
    let too_many = u32::MAX.to_le_bytes();
    assert!(InfoReply::read(Endianness::LittleEndian, &too_many, false).is_err());
  }
}
