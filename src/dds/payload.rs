//! Passes raw payloads through RustDDS' serialization traits without encoding or decoding them.

use std::convert::Infallible;

use bytes::Bytes;

use super::lent::Payload;
use super::rustdds::no_key::{Decode, DeserializerAdapter, SerializerAdapter};
use super::rustdds::{LentMemory, RepresentationIdentifier};
use crate::model::Encapsulation;

/// A payload to be written, with its encapsulation.
pub(super) struct RawPayload {
    pub bytes: Bytes,
    pub encapsulation: Encapsulation,
}

/// A received payload, with its encapsulation.
pub(super) type Received = (Payload, Encapsulation);

/// The (de)serializer that RustDDS' readers and writers of raw payloads use.
pub(super) struct RawAdapter;

/// Every encapsulation that RTPS and XTypes define (RTPS 2.5 table 10.3, XTypes 1.3 table 60). RustDDS
/// rejects any other, and the bridge counts such a sample as malformed.
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

/// Returns the payload, either in the receive buffer or in the memory that was lent for it.
#[derive(Clone, Copy)]
pub(super) struct PayloadDecoder;

/// Another reader of the topic has taken the memory in which the sample was.
#[derive(Debug, thiserror::Error)]
#[error("another reader has taken the payload")]
pub(super) struct MemoryTaken;

impl Decode<'_, Received> for PayloadDecoder {
    type Error = MemoryTaken;

    fn decode_bytes(self, bytes: &[u8], encoding: RepresentationIdentifier) -> Result<Received, MemoryTaken> {
        self.decode_encapsulated(&Bytes::copy_from_slice(bytes), encoding, [0, 0])
    }

    fn decode_encapsulated(
        self,
        bytes: &Bytes,
        encoding: RepresentationIdentifier,
        options: [u8; 2],
    ) -> Result<Received, MemoryTaken> {
        Ok((Payload::Bytes(bytes.clone()), encapsulation(encoding, options)))
    }

    fn decode_lent(
        self,
        memory: &mut Option<Box<dyn LentMemory>>,
        encoding: RepresentationIdentifier,
        options: [u8; 2],
    ) -> Result<Received, MemoryTaken> {
        let memory = memory.take().ok_or(MemoryTaken)?;
        Ok((Payload::Lent(memory), encapsulation(encoding, options)))
    }
}

fn encapsulation(encoding: RepresentationIdentifier, options: [u8; 2]) -> Encapsulation {
    let [high, low] = encoding.to_bytes();
    Encapsulation([high, low, options[0], options[1]])
}

impl DeserializerAdapter<Received> for RawAdapter {
    type Error = MemoryTaken;
    type Decoded = Received;

    fn supported_encodings() -> &'static [RepresentationIdentifier] {
        &ENCAPSULATIONS
    }

    fn transform_decoded(received: Received) -> Received {
        received
    }
}

impl SerializerAdapter<RawPayload> for RawAdapter {
    type Error = Infallible;

    fn output_encoding() -> RepresentationIdentifier {
        RepresentationIdentifier::CDR_LE
    }

    fn to_bytes(value: &RawPayload) -> Result<Bytes, Infallible> {
        Ok(value.bytes.clone())
    }

    fn output_encapsulation(value: &RawPayload) -> (RepresentationIdentifier, [u8; 2]) {
        let representation = value.encapsulation.representation();
        // The conversion needs two bytes, so it cannot fail; CDR_LE is the most common encapsulation.
        let encoding =
            RepresentationIdentifier::from_bytes(&representation).unwrap_or(RepresentationIdentifier::CDR_LE);
        (encoding, value.encapsulation.options())
    }
}
