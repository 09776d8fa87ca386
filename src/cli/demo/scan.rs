//! The demo's message: a `sensor_msgs/msg/LaserScan` of 360 beams with intensities, in plain little-endian
//! CDR.

use crate::model::MonotonicNs;

pub(super) const TYPE: &str = "sensor_msgs/msg/LaserScan";

pub(super) const DDS_TYPE: &str = "sensor_msgs::msg::dds_::LaserScan_";

/// The size of one serialized scan, without the 4-byte encapsulation header.
pub(super) const SCAN_BYTES: usize = 2_948;

const BEAMS: u32 = 360;
/// The frame id. With its terminating zero it has 20 bytes, so that the next field needs no padding.
const FRAME_ID: &[u8] = b"demo/base_scan_link\0";
/// Offset of the length of `ranges`, behind the stamp, the frame id and seven parameters of the scan.
const RANGES_AT: usize = 8 + 4 + FRAME_ID.len() + 7 * 4;
/// Offset of the first of `intensities`.
const NUMBER_AT: usize = RANGES_AT + 4 + BEAMS as usize * 4 + 4;

/// The count of scan numbers that an `f32` represents exactly (24 bits): 155 hours of scans.
const NUMBERS: u64 = 1 << 24;

/// The fields of a scan that the demo's subscribers read.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Scan {
    /// The number that the publisher gave it, in the intensity of the first beam.
    pub number: u64,
    /// The `CLOCK_MONOTONIC` time before the publish call, in `header.stamp`.
    pub taken_at: MonotonicNs,
}

impl Scan {
    pub fn encode(self) -> Vec<u8> {
        let mut cdr = Vec::with_capacity(SCAN_BYTES);
        // The uptime in seconds exceeds 31 bits after 68 years.
        let seconds = (self.taken_at.0 / 1_000_000_000) as u32;
        let nanos = (self.taken_at.0 % 1_000_000_000) as u32;
        cdr.extend([seconds, nanos, FRAME_ID.len() as u32].into_iter().flat_map(u32::to_le_bytes));
        cdr.extend_from_slice(FRAME_ID);
        let step = std::f32::consts::TAU / BEAMS as f32;
        // angle_min, angle_max, angle_increment, time_increment, scan_time, range_min, range_max
        let parameters = [0.0, std::f32::consts::TAU - step, step, 0.0, 1.0 / 30.0, 0.12, 12.0];
        let room = |beam: u32| 2.0 + (beam as f32 * step * 2.0).cos();
        cdr.extend(parameters.into_iter().flat_map(f32::to_le_bytes));
        cdr.extend_from_slice(&BEAMS.to_le_bytes());
        cdr.extend((0..BEAMS).map(room).flat_map(f32::to_le_bytes));
        cdr.extend_from_slice(&BEAMS.to_le_bytes());
        let number = (self.number % NUMBERS) as f32;
        let intensities = std::iter::once(number).chain((1..BEAMS).map(|_| 47.0));
        cdr.extend(intensities.flat_map(f32::to_le_bytes));
        cdr
    }

    /// Reads the scan in a payload; `None` when it is not one of the demo's.
    pub fn decode(payload: &[u8]) -> Option<Self> {
        let word = |at: usize| Some(u32::from_le_bytes(*payload.get(at..)?.first_chunk::<4>()?));
        if payload.len() != SCAN_BYTES || payload.get(12..12 + FRAME_ID.len())? != FRAME_ID {
            return None;
        }
        let taken_at = MonotonicNs(u64::from(word(0)?) * 1_000_000_000 + u64::from(word(4)?));
        let number = f32::from_bits(word(NUMBER_AT)?);
        (number >= 0.0 && number < NUMBERS as f32).then_some(Self { number: number as u64, taken_at })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_encoded_scan_has_the_declared_size_and_is_decoded_to_the_same_scan() {
        for number in [0, 1, 17_999, NUMBERS - 1] {
            let scan = Scan { number, taken_at: MonotonicNs(86_400_123_456_789 + number) };
            let cdr = scan.encode();
            assert_eq!(cdr.len(), SCAN_BYTES);
            assert_eq!(Scan::decode(&cdr), Some(scan));
        }
    }

    #[test]
    fn other_payloads_are_not_decoded_as_scans() {
        let cdr = Scan { number: 1, taken_at: MonotonicNs(1) }.encode();
        assert_eq!(Scan::decode(&cdr[..SCAN_BYTES - 1]), None);
        assert_eq!(Scan::decode(&[]), None);
        assert_eq!(Scan::decode(&[0; SCAN_BYTES]), None);
        let mut not_a_number = cdr;
        not_a_number[NUMBER_AT..NUMBER_AT + 4].copy_from_slice(&f32::NAN.to_le_bytes());
        assert_eq!(Scan::decode(&not_a_number), None);
    }
}
