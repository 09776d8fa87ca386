//! Warnings about figures of a subscriber. They are shown only and have no influence on any mode.

use super::probe_window::LinkReading;
use crate::model::SubscriberWarning;

/// The thresholds above which a figure causes a warning (`probes.*_threshold`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WarningThresholds {
    /// Mean round trip, in milliseconds.
    pub rtt_ms: f64,
    /// Share of the probes lost, 0 to 1.
    pub loss: f64,
    /// Jitter, in milliseconds.
    pub jitter_ms: f64,
    /// Consecutive readings required to show a warning, and to withdraw it; at least 1.
    pub readings: u32,
}

/// The warnings of one subscriber, with hysteresis.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SubscriberWarnings {
    /// In the order of [`SubscriberWarning::ALL`].
    figures: [Hysteresis; 3],
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Hysteresis {
    /// Whether the warning is shown.
    shown: bool,
    /// Consecutive readings that contradict `shown`.
    contrary: u32,
}

impl SubscriberWarnings {
    /// Applies a reading and returns the warnings to show, as [`SubscriberWarning`]'s bits. The warning of a
    /// figure that the reading does not have stays as it is.
    pub fn read(&mut self, thresholds: &WarningThresholds, link: &LinkReading) -> u8 {
        let loss = (link.settled > 0).then_some(link.loss);
        let (rtt_ms, jitter_ms) = (link.rtt_mean_ms, link.jitter_ms);
        let figures =
            [(rtt_ms, thresholds.rtt_ms), (loss, thresholds.loss), (jitter_ms, thresholds.jitter_ms)];
        let mut bits = 0;
        for ((hysteresis, (figure, threshold)), warning) in
            self.figures.iter_mut().zip(figures).zip(SubscriberWarning::ALL)
        {
            hysteresis.read(figure.map(|figure| figure > threshold), thresholds.readings);
            if hysteresis.shown {
                bits |= warning as u8;
            }
        }
        bits
    }
}

impl Hysteresis {
    fn read(&mut self, above: Option<bool>, readings: u32) {
        match above {
            Some(above) if above != self.shown => self.contrary += 1,
            Some(_) | None => self.contrary = 0,
        }
        if self.contrary > 0 && self.contrary >= readings {
            *self = Self { shown: !self.shown, contrary: 0 };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const THRESHOLDS: WarningThresholds =
        WarningThresholds { rtt_ms: 100.0, loss: 0.05, jitter_ms: 25.0, readings: 3 };

    fn link(rtt_ms: Option<f64>, loss: Option<f64>, jitter_ms: Option<f64>) -> LinkReading {
        let settled = if loss.is_some() { 50 } else { 0 };
        LinkReading {
            settled,
            answered: settled,
            lost: 0,
            full: false,
            loss: loss.unwrap_or(0.0),
            rtt_mean_ms: rtt_ms,
            rtt_p95_ms: rtt_ms,
            jitter_ms,
        }
    }

    /// The warnings shown after each of these round trips.
    fn shown(rtt_ms: &[f64]) -> Vec<u8> {
        let mut warnings = SubscriberWarnings::default();
        let read = |rtt_ms: &f64| warnings.read(&THRESHOLDS, &link(Some(*rtt_ms), Some(0.0), Some(0.0)));
        rtt_ms.iter().map(read).collect()
    }

    #[test]
    fn a_warning_is_shown_and_withdrawn_after_consecutive_readings() {
        assert_eq!(shown(&[101.0, 101.0, 101.0, 99.0, 99.0, 100.0]), [0, 0, 1, 1, 1, 0]);
        assert_eq!(shown(&[101.0, 101.0, 99.0, 101.0, 101.0]), [0; 5]);
        assert_eq!(shown(&[100.0; 9]), [0; 9]);
    }

    #[test]
    fn without_a_number_of_readings_one_is_enough() {
        let mut warnings = SubscriberWarnings::default();
        let at_once = WarningThresholds { readings: 0, ..THRESHOLDS };
        let shown = [101.0, 101.0, 99.0, 99.0]
            .map(|rtt_ms| warnings.read(&at_once, &link(Some(rtt_ms), Some(0.0), Some(0.0))));
        assert_eq!(shown, [1, 1, 0, 0]);
    }

    #[test]
    fn each_figure_has_its_own_warning() {
        let mut warnings = SubscriberWarnings::default();
        let once = WarningThresholds { readings: 1, ..THRESHOLDS };
        let loss = SubscriberWarning::Loss as u8;
        assert_eq!(warnings.read(&once, &link(Some(200.0), Some(0.06), Some(30.0))), 7);
        assert_eq!(warnings.read(&once, &link(Some(10.0), Some(0.06), Some(10.0))), loss);
        assert_eq!(warnings.read(&once, &link(None, None, None)), loss);
        assert_eq!(warnings.read(&once, &link(None, Some(0.0), None)), 0);
    }
}
