//! How raw payloads pass through RustDDS' serialization interfaces.

use std::any::Any;
use std::cell::RefCell;
use std::convert::Infallible;

use bytes::Bytes;

use super::lent::{Lent, Payload};
use super::rustdds::no_key::{Decode, DeserializerAdapter, SerializerAdapter};
use super::rustdds::{LentMemory, RepresentationIdentifier};
use crate::model::Encapsulation;

/// A payload on its way out.
pub(super) struct RawPayload {
    pub bytes: Bytes,
    pub encapsulation: Encapsulation,
}

/// The adapter for both directions.
pub(super) struct Raw;

/// Every encapsulation that RTPS and XTypes define (RTPS 2.5 table 10.3, XTypes 1.3 table 60). RustDDS turns
/// away any other, which is counted as malformed.
static ENCAPSULATIONS: [RepresentationIdentifier; 17] = [
    RepresentationIdentifier::CDR_LE,
    RepresentationIdentifier::CDR_BE,
    RepresentationIdentifier::PL_CDR_LE,
    RepresentationIdentifier::PL_CDR_BE,
    RepresentationIdentifier::XCDR2_LE,
    RepresentationIdentifier::XCDR2_BE,
    RepresentationIdentifier::D_CDR2_LE,
    RepresentationIdentifier::D_CDR2_BE,
    RepresentationIdentifier::PL_XCDR2_LE,
    RepresentationIdentifier::PL_XCDR2_BE,
    RepresentationIdentifier::CDR2_LE,
    RepresentationIdentifier::CDR2_BE,
    RepresentationIdentifier::PL_CDR2_LE,
    RepresentationIdentifier::PL_CDR2_BE,
    RepresentationIdentifier::D_CDR_LE,
    RepresentationIdentifier::D_CDR_BE,
    RepresentationIdentifier::XML,
];

/// What a payload and its encapsulation are handed to.
pub(super) type Borrower<'a> = dyn FnMut(Payload<'_>, Encapsulation) + 'a;

/// Hands the payload to a closure while it is still in the receive buffer, or with the memory it is in.
#[derive(Clone, Copy)]
pub(super) struct Lend<'cell, 'closure>(pub &'cell RefCell<&'closure mut Borrower<'closure>>);

impl Decode<'_, ()> for Lend<'_, '_> {
    type Error = Infallible;

    fn decode_bytes(self, bytes: &[u8], encoding: RepresentationIdentifier) -> Result<(), Infallible> {
        self.decode_encapsulated(bytes, encoding, [0, 0])
    }

    fn decode_encapsulated(
        self,
        bytes: &[u8],
        encoding: RepresentationIdentifier,
        options: [u8; 2],
    ) -> Result<(), Infallible> {
        (self.0.borrow_mut())(Payload::Bytes(bytes), encapsulation(encoding, options));
        Ok(())
    }

    fn decode_lent(
        self,
        memory: &mut Option<Box<dyn LentMemory>>,
        encoding: RepresentationIdentifier,
        options: [u8; 2],
    ) -> Result<(), Infallible> {
        if let Some(memory) = memory.take() {
            let memory: Box<dyn Any> = memory;
            match memory.downcast::<Lent>() {
                Ok(lent) => {
                    (self.0.borrow_mut())(Payload::Lent(lent.0), encapsulation(encoding, options));
                }
                // Every reader here gives the library memory of that type.
                Err(_) => debug_assert!(false, "memory that nobody here lent"),
            }
        }
        Ok(())
    }
}

fn encapsulation(encoding: RepresentationIdentifier, options: [u8; 2]) -> Encapsulation {
    let [high, low] = encoding.to_bytes();
    Encapsulation([high, low, options[0], options[1]])
}

impl DeserializerAdapter<()> for Raw {
    type Error = Infallible;
    type Decoded = ();

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &ENCAPSULATIONS
    }

    fn transform_decoded((): ()) {}
}

impl SerializerAdapter<RawPayload> for Raw {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(value: &RawPayload) -> Result<Bytes, Infallible> {
        Ok(value.bytes.clone())
    }

    fn output_encapsulation(value: &RawPayload) -> (RepresentationIdentifier, [u8; 2]) {
        let representation = value.encapsulation.representation();
        // Two bytes are all that the conversion reads, so it cannot fail; CDR_LE would be the least surprise.
        let encoding =
            RepresentationIdentifier::from_bytes(&representation).unwrap_or(RepresentationIdentifier::CDR_LE);
        (encoding, value.encapsulation.options())
    }
}
