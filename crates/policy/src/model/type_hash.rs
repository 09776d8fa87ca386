//! The hash of a message type's definition, which ROS 2 announces with each reader and writer (REP 2011).

use core::fmt;

/// The bytes in USER_DATA before the 64 hexadecimal digits of a hash of version 1.
const PREFIX: &[u8] = b"typehash=RIHS01_";

/// The SHA-256 of a type's description (RIHS01). All zeros stand for an unknown hash.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(transparent)]
pub struct TypeHash(pub [u8; 32]);

impl TypeHash {
    /// The hash of a type that nodes before ROS 2 Iron, or programs other than ROS 2 nodes, announce.
    pub const UNKNOWN: Self = Self([0; 32]);

    /// The hash with these 64 hexadecimal digits; [`UNKNOWN`](Self::UNKNOWN) for any other text.
    pub const fn from_hex(digits: &[u8]) -> Self {
        if digits.len() != 64 {
            return Self::UNKNOWN;
        }
        let mut bytes = [0; 32];
        let mut index = 0;
        while index < 64 {
            let Some(digit) = (digits[index] as char).to_digit(16) else { return Self::UNKNOWN };
            bytes[index / 2] = bytes[index / 2] << 4 | digit as u8;
            index += 1;
        }
        Self(bytes)
    }

    /// The hash in the USER_DATA of an endpoint, which has `key=value;` pairs.
    pub fn find_in(user_data: &[u8]) -> Self {
        let digits = user_data.split(|byte| *byte == b';').find_map(|pair| pair.strip_prefix(PREFIX));
        digits.map_or(Self::UNKNOWN, Self::from_hex)
    }

    /// Whether the hash is known.
    pub fn is_known(&self) -> bool {
        *self != Self::UNKNOWN
    }

    /// Whether both hashes are known and differ.
    pub fn contradicts(&self, other: &Self) -> bool {
        self.is_known() && other.is_known() && self != other
    }
}

/// As ROS 2 shows it: `RIHS01_` and 64 hexadecimal digits.
impl fmt::Display for TypeHash {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("RIHS01_")?;
        self.0.iter().try_for_each(|byte| write!(f, "{byte:02x}"))
    }
}

/// A DDS type as its readers and writers announce it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DdsType<'a> {
    /// Its DDS name, such as `sensor_msgs::msg::dds_::LaserScan_`.
    pub name: &'a str,
    /// The hash of its definition, if it is known.
    pub hash: TypeHash,
    /// Whether it has keys, which the types of ROS 2 itself have not. DDS announces that by the entity ids of
    /// readers and writers.
    pub has_keys: bool,
}

/// A type without keys whose hash is unknown.
impl<'a> From<&'a str> for DdsType<'a> {
    fn from(name: &'a str) -> Self {
        Self { name, hash: TypeHash::UNKNOWN, has_keys: false }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use alloc::string::ToString;

    const LASER_SCAN: &str = "RIHS01_64c191398013af96509d518dac71d5164f9382553fce5c1f8cca5be7924bd828";

    #[test]
    fn a_hash_in_user_data_is_shown_as_it_was_announced() {
        for (before, after) in [("", ";"), ("", ""), ("enclave=/;", ";"), ("a=b;", ";typehash=;")] {
            let user_data = alloc::format!("{before}typehash={LASER_SCAN}{after}");
            assert_eq!(TypeHash::find_in(user_data.as_bytes()).to_string(), LASER_SCAN, "{user_data}");
        }
    }

    #[test]
    fn other_user_data_has_no_hash() {
        let cut = &LASER_SCAN[..LASER_SCAN.len() - 1];
        let letters = LASER_SCAN.replace('c', "g");
        let signed = LASER_SCAN.replace("64c1", "+4c1");
        let version_2 = LASER_SCAN.replace("RIHS01", "RIHS02");
        for hash in ["", cut, &alloc::format!("{LASER_SCAN}0"), &letters, &signed, &version_2] {
            assert!(
                TypeHash::find_in(alloc::format!("typehash={hash};").as_bytes()) == TypeHash::UNKNOWN,
                "{hash}"
            );
        }
        assert_eq!(TypeHash::find_in(b""), TypeHash::UNKNOWN);
        assert_eq!(TypeHash::find_in(&[0xff; 300]), TypeHash::UNKNOWN);
        let other_key = alloc::format!("mytypehash={LASER_SCAN};");
        assert_eq!(TypeHash::find_in(other_key.as_bytes()), TypeHash::UNKNOWN);
    }

    #[test]
    fn hashes_contradict_each_other_only_if_both_are_known_and_differ() {
        let [one, other] = [TypeHash([1; 32]), TypeHash([2; 32])];
        assert!(one.is_known() && !TypeHash::UNKNOWN.is_known());
        assert!(one.contradicts(&other) && !one.contradicts(&one));
        assert!(!one.contradicts(&TypeHash::UNKNOWN) && !TypeHash::UNKNOWN.contradicts(&one));
    }
}
