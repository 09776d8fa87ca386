//! What travels beside a serialized sample from ingress to the lanes.

use super::time::{MonotonicNs, SourceTimestamp};

/// The RTPS encapsulation header of a serialized payload (RTPS 2.5 clause 10.2): two bytes of representation
/// identifier (CDR_LE, PL_CDR2_BE, …) and two bytes of options, whose two lowest bits count the padding bytes
/// at the end (XTypes 1.3 clause 7.6.3.1.2). Forwarded as it came.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(transparent)]
pub struct Encapsulation(pub [u8; 4]);

impl Encapsulation {
    /// Plain CDR, little endian, no options: what nearly all ROS 2 publishers send.
    pub const CDR_LE: Self = Self([0, 1, 0, 0]);

    /// The representation identifier.
    pub const fn representation(self) -> [u8; 2] {
        [self.0[0], self.0[1]]
    }

    /// The representation options.
    pub const fn options(self) -> [u8; 2] {
        [self.0[2], self.0[3]]
    }
}

/// The GUID of a DDS entity (RTPS 2.5 clause 8.2.4.1): 12 bytes of participant prefix, 4 of entity id.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(transparent)]
pub struct Guid(pub [u8; 16]);

impl Guid {
    /// The prefix, which all entities of a participant share.
    pub const fn prefix(self) -> [u8; 12] {
        let [a, b, c, d, e, f, g, h, i, j, k, l, ..] = self.0;
        [a, b, c, d, e, f, g, h, i, j, k, l]
    }
}

/// The fixed header of one sample in shared memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
pub struct SampleHeader {
    /// The sample's number on its route, given by ingress: 1, 2, 3, … without a gap, also across restarts of
    /// ingress. A gap that a lane sees is therefore a number of samples that the lane did not get.
    pub sequence: u64,
    /// The publisher's DDS source timestamp.
    pub source_timestamp: SourceTimestamp,
    /// When ingress took the sample from its DDS reader.
    pub taken_at: MonotonicNs,
    /// When ingress published the sample to the lanes.
    pub published_at: MonotonicNs,
    /// The sequence number that the publisher's DDS writer gave the sample.
    pub writer_sequence: i64,
    /// The publisher's DDS writer.
    pub writer_guid: Guid,
    /// How the payload is encoded.
    pub encapsulation: Encapsulation,
    /// Always 0; keeps the size a multiple of 8 without bytes that nobody wrote.
    pub reserved: u32,
}
