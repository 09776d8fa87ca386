//! What a SEDP writer has announced, and takes back.

use std::{
  cell::RefCell,
  collections::{HashMap, VecDeque},
};

use crate::{
  dds::{
    adapters::with_key::SerializerAdapter,
    result::WriteResult,
  },
  discovery::sedp_messages::Endpoint_GUID,
  structure::{guid::GUID, sequence_number::SequenceNumber},
  with_key::DataWriter,
  Keyed,
};

/// What was announced of the endpoints of one kind, and is still in the writer's
/// history. A participant that comes later is sent that history: with the former
/// endpoints in it, it would match them for an instant and write its first samples
/// to them, and the history would grow with each endpoint that ever was.
#[derive(Default)]
pub(crate) struct Announced {
  present: RefCell<HashMap<GUID, SequenceNumber>>,
  // Goodbyes, the oldest first.
  former: RefCell<VecDeque<SequenceNumber>>,
}

// Goodbyes that are kept though all have acknowledged them who are matched now. A
// participant that we lost sight of, and that did not lose sight of us, asks for
// them when it is back: without them it would wait for the acknowledgements of a
// reader that is gone.
const GOODBYES: usize = 64;

impl Announced {
  /// Announces an endpoint, in place of what was said of it before.
  pub fn announce<D, SA>(&self, writer: &DataWriter<D, SA>, guid: GUID, data: D) -> WriteResult<(), D>
  where
    D: Keyed,
    SA: SerializerAdapter<D>,
  {
    let announced = writer.write_with_options(data, None.into())?;
    let former = self
      .present
      .borrow_mut()
      .insert(guid, announced.sequence_number);
    if let Some(former) = former {
      writer.retract(former);
    }
    Ok(())
  }

  /// Says that an endpoint is no more.
  pub fn dispose<D, SA>(&self, writer: &DataWriter<D, SA>, guid: GUID) -> WriteResult<(), ()>
  where
    D: Keyed<K = Endpoint_GUID>,
    SA: SerializerAdapter<D>,
  {
    let goodbye = writer.dispose_numbered(&Endpoint_GUID(guid), None.into())?;
    if let Some(former) = self.present.borrow_mut().remove(&guid) {
      writer.retract(former);
    }
    let mut goodbyes = self.former.borrow_mut();
    goodbyes.push_back(goodbye);
    while goodbyes.len() > GOODBYES {
      match goodbyes.front() {
        Some(&oldest) if writer.is_acknowledged(oldest) => {
          writer.retract(oldest);
          goodbyes.pop_front();
        }
        _ => break,
      }
    }
    Ok(())
  }
}
