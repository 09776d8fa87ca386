//! The header that ingress passes to the lanes with each serialized sample.

use core::fmt;

use serde::{Serialize, Serializer};

use super::time::{MonotonicNs, SourceTimestamp};

/// The RTPS encapsulation header of a serialized payload (RTPS 2.5 clause 10.2): two bytes of representation
/// identifier (CDR_LE, PL_CDR2_BE, …) and two bytes of options, whose two lowest bits count the padding bytes
/// at the end (XTypes 1.3 clause 7.6.3.1.2). Forwarded unchanged.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
#[repr(transparent)]
pub struct Encapsulation(pub [u8; 4]);

impl Encapsulation {
    /// Plain CDR, little endian, no options: that of nearly all ROS 2 publishers.
    pub const CDR_LE: Self = Self([0, 1, 0, 0]);

    /// The representation identifier.
    #[inline]
    pub const fn representation(self) -> [u8; 2] {
        [self.0[0], self.0[1]]
    }

    /// The representation options.
    #[inline]
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
    #[inline]
    pub const fn prefix(self) -> [u8; 12] {
        let [a, b, c, d, e, f, g, h, i, j, k, l, ..] = self.0;
        [a, b, c, d, e, f, g, h, i, j, k, l]
    }

    /// Whether it is a reader or a writer of a topic with keys (RTPS 2.5 table 9.1); endpoints match only if
    /// both have keys or neither has.
    #[inline]
    pub const fn has_keys(self) -> bool {
        matches!(self.0[15] & 0x0f, 0x02 | 0x07)
    }
}

impl fmt::Display for Guid {
    /// Prefix and entity id in hexadecimal, as DDS tools print them: `0102…0c:00000103`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (prefix, entity) = self.0.split_at(12);
        prefix.iter().try_for_each(|byte| write!(f, "{byte:02x}"))?;
        f.write_str(":")?;
        entity.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

impl Serialize for Guid {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

/// What a sample of a topic with keys says of its key beside the payload, as its publisher sends it. The
/// bridge does not know the type, so it knows a key only by its hash.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct SampleKey {
    hash: [u8; 16],
    flags: u64,
}

/// What the payload of a sample of a topic with keys is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum KeyedPayload {
    /// The data.
    Data,
    /// The key alone.
    Key,
    /// There is none; the hash tells the key.
    Absent,
}

impl SampleKey {
    /// That of a sample of a topic without keys.
    pub const NONE: Self = Self { hash: [0; 16], flags: 0 };

    const DISPOSED: u64 = 1;
    const UNREGISTERED: u64 = 2;
    const IS_KEYED: u64 = 4;
    const HAS_HASH: u64 = 8;
    const IS_KEY: u64 = 16;
    const IS_ABSENT: u64 = 32;

    /// That of a sample with this key hash, if the publisher sends one, these flags of PID_STATUS_INFO (RTPS
    /// 2.5 clause 9.6.4.9), and this kind of payload.
    pub const fn new(hash: Option<[u8; 16]>, status_info: u8, payload: KeyedPayload) -> Self {
        let mut flags = Self::IS_KEYED | (status_info as u64 & (Self::DISPOSED | Self::UNREGISTERED));
        flags |= match payload {
            KeyedPayload::Data => 0,
            KeyedPayload::Key => Self::IS_KEY,
            KeyedPayload::Absent => Self::IS_ABSENT,
        };
        match hash {
            Some(hash) => Self { hash, flags: flags | Self::HAS_HASH },
            None => Self { hash: [0; 16], flags },
        }
    }

    /// Whether the sample is of a topic with keys.
    #[inline]
    pub const fn is_keyed(&self) -> bool {
        self.flags & Self::IS_KEYED != 0
    }

    /// The key hash; `None` if the publisher sends none.
    #[inline]
    pub const fn hash(&self) -> Option<[u8; 16]> {
        if self.flags & Self::HAS_HASH != 0 { Some(self.hash) } else { None }
    }

    /// The flags of PID_STATUS_INFO.
    #[inline]
    pub const fn status_info(&self) -> u8 {
        (self.flags & (Self::DISPOSED | Self::UNREGISTERED)) as u8
    }

    /// Whether the sample disposes or unregisters its key.
    #[inline]
    pub const fn is_end(&self) -> bool {
        self.status_info() != 0
    }

    /// What the payload is.
    #[inline]
    pub const fn payload(&self) -> KeyedPayload {
        if self.flags & Self::IS_KEY != 0 {
            KeyedPayload::Key
        } else if self.flags & Self::IS_ABSENT != 0 {
            KeyedPayload::Absent
        } else {
            KeyedPayload::Data
        }
    }
}

/// The header of one sample in shared memory, of fixed size.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C)]
pub struct SampleHeader {
    /// The sample's number in its route. Ingress assigns 1, 2, 3, … without gaps, also across its restarts,
    /// so that a gap which a lane finds is the number of samples that the lane did not receive.
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
    /// The instant from which its age is measured.
    pub age_basis: AgeBasis,
    /// What it says of its key.
    pub key: SampleKey,
}

impl SampleHeader {
    /// The source timestamp if the sample's age is measured from it, otherwise [`SourceTimestamp::NONE`].
    #[inline]
    pub const fn age_source(&self) -> SourceTimestamp {
        match self.age_basis.late_ns() {
            Some(_) => SourceTimestamp::NONE,
            None => self.source_timestamp,
        }
    }

    /// The instant from which the sample's age is measured when it is not measured from a source timestamp.
    #[inline]
    pub const fn age_from(&self) -> MonotonicNs {
        match self.age_basis.late_ns() {
            Some(late_ns) => MonotonicNs(self.taken_at.0.saturating_sub(late_ns)),
            None => self.taken_at,
        }
    }
}

/// The instant from which a sample's age is measured: its source timestamp; or, when the publisher's clock
/// disagrees with this host's, its arrival less its delay beyond the publisher's fastest samples.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(transparent)]
pub struct AgeBasis(u32);

impl AgeBasis {
    /// From the source timestamp, or from the arrival of a sample that has none.
    pub const SOURCE: Self = Self(0);

    /// From `late_ns` before the arrival; at most 71 minutes.
    #[inline]
    pub const fn arrival(late_ns: u64) -> Self {
        let late_us = late_ns / 1_000;
        Self(if late_us >= u32::MAX as u64 { u32::MAX } else { late_us as u32 + 1 })
    }

    /// The age of the sample on its arrival; `None` when its age is measured from the source timestamp.
    #[inline]
    pub const fn late_ns(self) -> Option<u64> {
        match self.0 {
            0 => None,
            code => Some((code as u64 - 1) * 1_000),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::WallNs;

    #[test]
    fn parts_of_encapsulations_and_guids_are_their_bytes() {
        let encapsulation = Encapsulation([1, 2, 3, 4]);
        assert_eq!((encapsulation.representation(), encapsulation.options()), ([1, 2], [3, 4]));
        let guid = Guid([1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 0, 0, 1, 3]);
        assert_eq!(guid.prefix(), [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]);
        assert_eq!(guid.to_string(), "0102030405060708090a0b0c:00000103");
    }

    #[test]
    fn what_a_sample_says_of_its_key_is_kept() {
        assert!(!SampleKey::NONE.is_keyed());
        for hash in [None, Some([0; 16]), Some([7; 16])] {
            for status_info in 0..=3 {
                for payload in [KeyedPayload::Data, KeyedPayload::Key, KeyedPayload::Absent] {
                    let key = SampleKey::new(hash, status_info, payload);
                    assert!(key.is_keyed());
                    assert_eq!((key.hash(), key.status_info(), key.payload()), (hash, status_info, payload));
                    assert_eq!(key.is_end(), status_info != 0);
                }
            }
        }
        // Other flags are reserved.
        assert_eq!(SampleKey::new(None, 0xfc, KeyedPayload::Data).status_info(), 0);
        let kinds = [0x02, 0x03, 0x04, 0x07].map(|kind| {
            let mut guid = Guid([1; 16]);
            guid.0[15] = kind;
            guid.has_keys()
        });
        assert_eq!(kinds, [true, false, false, true]);
    }

    #[test]
    fn a_delay_is_kept_in_microseconds_up_to_71_minutes() {
        for (late_ns, kept_ns) in [(0, 0), (999, 0), (1_000, 1_000), (2_345_678, 2_345_000)] {
            let basis = AgeBasis::arrival(late_ns);
            assert_eq!(basis.late_ns(), Some(kept_ns), "{late_ns}");
        }
        assert_eq!(AgeBasis::arrival(u64::MAX).late_ns(), Some(u64::from(u32::MAX - 1) * 1_000));
        let largest = u64::from(u32::MAX - 2) * 1_000;
        assert_eq!(AgeBasis::arrival(largest).late_ns(), Some(largest));
        assert_eq!((AgeBasis::SOURCE.late_ns(), AgeBasis::SOURCE), (None, AgeBasis(0)));
    }

    #[test]
    fn the_age_is_measured_from_the_source_timestamp_or_before_the_arrival() {
        let source = SourceTimestamp::from_wall(WallNs(1_763_000_000_000_000_000));
        let mut header = SampleHeader {
            sequence: 1,
            source_timestamp: source,
            taken_at: MonotonicNs(10_000_000),
            published_at: MonotonicNs(11_000_000),
            writer_sequence: 1,
            writer_guid: Guid::default(),
            encapsulation: Encapsulation::CDR_LE,
            age_basis: AgeBasis::SOURCE,
            key: SampleKey::NONE,
        };
        assert_eq!((header.age_source(), header.age_from()), (source, MonotonicNs(10_000_000)));
        header.age_basis = AgeBasis::arrival(4_000_000);
        assert_eq!((header.age_source(), header.age_from()), (SourceTimestamp::NONE, MonotonicNs(6_000_000)));
    }
}
