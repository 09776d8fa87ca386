//! When a figure of a subscriber is worth a warning. A warning is shown and decides nothing.

use super::probe_window::LinkReading;
use crate::model::SubscriberWarning;

/// Above what a figure is worth a warning (`probes.*_threshold`).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WarningThresholds {
    /// Mean round trip, in milliseconds.
    pub rtt_ms: f64,
    /// Share of the probes lost, 0 to 1.
    pub loss: f64,
    /// Jitter, in milliseconds.
    pub jitter_ms: f64,
    /// Consecutive readings that it takes to show a warning, and to withdraw it; at least 1.
    pub readings: u32,
}

/// The warnings of one subscriber.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SubscriberWarnings {
    /// In the order of [`SubscriberWarning::ALL`].
    gates: [Gate; 3],
}

#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
struct Gate {
    shown: bool,
    /// Consecutive readings that speak against what is shown.
    against: u32,
}

impl SubscriberWarnings {
    /// Takes a reading; a figure that cannot be told leaves its warning as it is. Returns the warnings that
    /// are shown, as [`SubscriberWarning`]'s bits.
    pub fn read(&mut self, thresholds: &WarningThresholds, link: &LinkReading) -> u8 {
        let loss = (link.settled > 0).then_some(link.loss);
        let (rtt_ms, jitter_ms) = (link.rtt_mean_ms, link.jitter_ms);
        let figures =
            [(rtt_ms, thresholds.rtt_ms), (loss, thresholds.loss), (jitter_ms, thresholds.jitter_ms)];
        let mut bits = 0;
        for ((gate, (figure, threshold)), warning) in
            self.gates.iter_mut().zip(figures).zip(SubscriberWarning::ALL)
        {
            gate.read(figure.map(|figure| figure > threshold), thresholds.readings);
            if gate.shown {
                bits |= warning as u8;
            }
        }
        bits
    }
}

impl Gate {
    fn read(&mut self, above: Option<bool>, readings: u32) {
        match above {
            Some(above) if above != self.shown => self.against += 1,
            Some(_) | None => self.against = 0,
        }
        if self.against > 0 && self.against >= readings {
            *self = Self { shown: !self.shown, against: 0 };
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

    /// What is shown after each of these round trips.
    fn shown(rtt_ms: &[f64]) -> Vec<u8> {
        let mut warnings = SubscriberWarnings::default();
        let read = |rtt_ms: &f64| warnings.read(&THRESHOLDS, &link(Some(*rtt_ms), Some(0.0), Some(0.0)));
        rtt_ms.iter().map(read).collect()
    }

    #[test]
    fn a_warning_takes_consecutive_readings_both_ways() {
        assert_eq!(shown(&[101.0, 101.0, 101.0, 99.0, 99.0, 100.0]), [0, 0, 1, 1, 1, 0]);
        assert_eq!(shown(&[101.0, 101.0, 99.0, 101.0, 101.0]), [0; 5]);
        assert_eq!(shown(&[100.0; 9]), [0; 9]);
    }

    #[test]
    fn each_figure_has_a_warning_of_its_own() {
        let mut warnings = SubscriberWarnings::default();
        let once = WarningThresholds { readings: 1, ..THRESHOLDS };
        let loss = SubscriberWarning::Loss as u8;
        assert_eq!(warnings.read(&once, &link(Some(200.0), Some(0.06), Some(30.0))), 7);
        assert_eq!(warnings.read(&once, &link(Some(10.0), Some(0.06), Some(10.0))), loss);
        assert_eq!(warnings.read(&once, &link(None, None, None)), loss);
        assert_eq!(warnings.read(&once, &link(None, Some(0.0), None)), 0);
    }
}
