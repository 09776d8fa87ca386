//! The parts of the report that come from control: safety, probes, subscribers, intruders, absences.

use super::{age_ms, some_text};
use crate::model::{
    AbsenceRecord, IntruderRecord, LaneMode, ModeReason, MonotonicNs, ParameterRequests, RefusalCounts,
    SubscriberState, SubscriberWarning, TrafficClass,
};
use crate::telemetry::snapshot::{LaneReading, Snapshot, SubscriberReading};
use crate::telemetry::text::printable;

/// The state of the safety supervisor.
#[derive(Clone, Debug, serde::Serialize)]
pub struct SafetyReport {
    /// The safety mode: `normal`, `degraded` or `emergency`.
    pub(crate) mode: &'static str,
    /// The cause of the mode; null in normal mode.
    pub(crate) reason: Option<String>,
    /// The time since the mode was entered; null when control never ran.
    pub(crate) since_s: Option<f64>,
    pub(crate) transitions: u64,
}

/// Probe counts, summed over all subscribers.
#[derive(Clone, Copy, Debug, Default, serde::Serialize)]
pub struct ProbesReport {
    pub(crate) sent: u64,
    pub(crate) accepted: u64,
    pub(crate) refused: RefusalCounts,
    pub(crate) refused_in_window: RefusalCounts,
}

/// The parameters of the bridge's ROS 2 nodes.
#[derive(Clone, Debug, Default, serde::Serialize)]
pub struct ParametersReport {
    /// The parameters that were set while the bridge runs, each as `key: value` in YAML.
    pub(crate) set: Vec<String>,
    pub(crate) requests: ParameterRequests,
}

/// The state and the link figures of one subscriber.
#[derive(Clone, Debug, serde::Serialize)]
pub struct SubscriberReport {
    /// The id of its responder.
    pub id: String,
    pub(crate) lane: Option<String>,
    pub(crate) listed: bool,
    pub(crate) state: &'static str,
    pub(crate) forced: bool,
    pub(crate) reason: String,
    pub(crate) state_since_s: Option<f64>,
    pub(crate) transitions: u64,
    /// Probes of the sliding window that were answered or timed out.
    pub(crate) settled: u64,
    /// Settled probes without a response in time.
    pub(crate) lost: u64,
    pub(crate) loss: Option<f64>,
    pub(crate) rtt_mean_ms: Option<f64>,
    pub(crate) rtt_p95_ms: Option<f64>,
    pub(crate) jitter_ms: Option<f64>,
    pub(crate) last_response_age_ms: Option<f64>,
    /// The figures above their warning threshold: `rtt`, `loss`, `jitter`.
    pub(crate) warnings: Vec<&'static str>,
}

impl SubscriberReport {
    /// The link figures as text, such as `RTT 81.2 ms, loss 2.0 %`.
    pub fn figures(&self) -> String {
        match (self.rtt_mean_ms, self.loss) {
            (Some(rtt_ms), Some(loss)) => format!("RTT {rtt_ms:.1} ms, loss {:.1} %", loss * 100.0),
            (None, Some(_)) => format!("none of {} probes answered", self.settled),
            (_, None) => "no probe answered or timed out yet".to_owned(),
        }
    }
}

/// A remote subscriber that bypasses the bridge.
#[derive(Clone, Debug, serde::Serialize)]
pub struct IntruderReport {
    pub(crate) topic: String,
    /// Its node; null when it is unknown.
    pub(crate) node: Option<String>,
    pub(crate) host: String,
    pub(crate) remedy: String,
    pub(crate) since_s: Option<f64>,
}

/// A network interface or peer that is or was away.
#[derive(Clone, Debug, serde::Serialize)]
pub struct AbsenceReport {
    pub(crate) kind: &'static str,
    /// The interface, or the peer's node; null when the node is unknown.
    pub(crate) name: Option<String>,
    /// The address of the interface, or of the peer's host; null when it is unknown.
    pub(crate) host: Option<String>,
    /// What the interface lacks, or the topics that the peer subscribes to and publishes.
    pub(crate) detail: String,
    /// The time that it is or was away.
    pub(crate) away_s: f64,
    pub(crate) back_s: Option<f64>,
}

impl Snapshot {
    pub(super) fn safety_report(&self) -> SafetyReport {
        let control = &self.control;
        SafetyReport {
            mode: control.safety().label(),
            reason: some_text(control.safety_reason.as_str()),
            since_s: age_s(control.safety_since, self.at),
            transitions: control.safety_transitions,
        }
    }

    pub(super) fn parameters_report(&self) -> ParametersReport {
        let set = self.set_parameters.iter().map(|(name, value)| printable(&format!("{name}: {value}")));
        ParametersReport { set: set.collect(), requests: self.control.parameter_requests }
    }

    pub(super) fn probes_report(&self, earlier: &Self) -> ProbesReport {
        let (now, before) = (&self.control.refused, &earlier.control.refused);
        ProbesReport {
            sent: self.control.probes_sent,
            accepted: self.control.responses_accepted,
            refused: *now,
            refused_in_window: now.since(before),
        }
    }

    pub(in crate::telemetry) fn subscriber_report(&self, reading: &SubscriberReading) -> SubscriberReport {
        let SubscriberReading { lane, record } = reading;
        let answered = record.settled > record.lost;
        let ms = |us: u64| answered.then_some(us as f64 / 1e3);
        SubscriberReport {
            id: printable(record.id.as_str()),
            lane: lane.map(|lane| self.lanes[lane].name.to_string()),
            listed: record.listed != 0,
            state: record.state().label(),
            forced: record.forced != 0,
            reason: printable(record.reason.as_str()),
            state_since_s: age_s(record.state_since, self.at),
            transitions: record.transitions,
            settled: record.settled,
            lost: record.lost,
            loss: record.loss(),
            rtt_mean_ms: ms(record.rtt_mean_us),
            rtt_p95_ms: ms(record.rtt_p95_us),
            jitter_ms: ms(record.jitter_us),
            last_response_age_ms: age_ms(record.last_response_at, self.at),
            warnings: record.warnings().map(SubscriberWarning::label).collect(),
        }
    }

    pub(in crate::telemetry) fn intruder_report(&self, intruder: &IntruderRecord) -> IntruderReport {
        IntruderReport {
            topic: printable(intruder.topic.as_str()),
            node: some_text(intruder.node.as_str()),
            host: printable(intruder.host.as_str()),
            remedy: printable(intruder.remedy.as_str()),
            since_s: age_s(intruder.since, self.at),
        }
    }

    pub(in crate::telemetry) fn absence_report(&self, absence: &AbsenceRecord) -> AbsenceReport {
        let end = if absence.is_away() { self.at } else { absence.back_at };
        AbsenceReport {
            kind: absence.kind().label(),
            name: some_text(absence.name.as_str()),
            host: some_text(absence.host.as_str()),
            detail: printable(absence.detail.as_str()),
            away_s: end.since(absence.since) as f64 / 1e9,
            back_s: age_s(absence.back_at, self.at),
        }
    }

    /// The reason of a lane's mode, as text for users.
    pub(super) fn mode_detail(&self, number: usize, lane: &LaneReading) -> String {
        match lane.reason {
            ModeReason::Default => "no mode was set".to_owned(),
            ModeReason::ByHand => "an operator has set it with `adaptive-bridge mode`".to_owned(),
            ModeReason::Safety => match self.control.safety_reason.as_str() {
                "" => format!("the safety mode is {}", self.control.safety()),
                reason => format!("the safety mode is {}: {}", self.control.safety(), printable(reason)),
            },
            ModeReason::Control => self.control_detail(number, lane),
            ModeReason::Held => {
                let detail = self.control_detail(number, lane);
                format!("control does not run, its last decision holds for policy_hold_s: {detail}")
            }
            ModeReason::Expired => "control has not run for longer than policy_hold_s".to_owned(),
        }
    }

    /// The basis of control's decision: the subscriber of a noncritical lane with the worst link.
    fn control_detail(&self, number: usize, lane: &LaneReading) -> String {
        if lane.class == TrafficClass::Critical {
            return "a critical lane forwards every sample, even over bad links".to_owned();
        }
        if self.control.classifies == 0 {
            return "subscribers are not classified".to_owned();
        }
        let of_lane = self.subscribers.iter().filter(|subscriber| subscriber.lane == Some(number));
        let badness = |subscriber: &SubscriberReading| {
            let record = &subscriber.record;
            let state = match record.state() {
                SubscriberState::Critical => 0,
                SubscriberState::Unknown => 1,
                SubscriberState::Noncritical => 2,
            };
            (state, record.lost, record.rtt_mean_us)
        };
        let count = of_lane.clone().count();
        let Some(worst) = of_lane.max_by_key(|subscriber| badness(subscriber)) else {
            return "the lane has no subscriber that answers probes".to_owned();
        };
        let stays = lane.mode == LaneMode::Normal && worst.record.state() == SubscriberState::Noncritical;
        let stays = if stays {
            "; the lane stays normal because safety.allow_noncritical_degrade is false"
        } else {
            ""
        };
        let worst = self.subscriber_report(worst);
        let forced = if worst.forced { ", forced" } else { "" };
        let of = if count == 1 {
            "its subscriber".to_owned()
        } else {
            format!("the worst of {count} subscribers,")
        };
        format!("{of} {} is {}{forced}: {}{stays}", worst.id, worst.state, worst.figures())
    }
}

fn age_s(at: MonotonicNs, now: MonotonicNs) -> Option<f64> {
    age_ms(at, now).map(|ms| ms / 1e3)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{FixedText, SafetyMode, SubscriberRecord};
    use crate::telemetry::problems::tests::healthy;

    fn subscriber(id: &str, state: SubscriberState, lost: u64) -> SubscriberReading {
        let record = SubscriberRecord {
            id: FixedText::new(id),
            state: state as u8,
            settled: 50,
            lost,
            rtt_mean_us: 20_000,
            ..SubscriberRecord::default()
        };
        SubscriberReading { lane: Some(1), record }
    }

    fn detail(reason: ModeReason, change: impl FnOnce(&mut Snapshot)) -> String {
        let mut snapshot = healthy();
        snapshot.control.classifies = 1;
        snapshot.lanes[1].reason = reason;
        snapshot.lanes[1].mode = LaneMode::Degraded;
        change(&mut snapshot);
        snapshot.mode_detail(1, &snapshot.lanes[1])
    }

    #[test]
    fn a_mode_set_by_control_is_explained_by_the_worst_subscriber_of_the_lane() {
        let none = detail(ModeReason::Control, |_| {});
        assert_eq!(none, "the lane has no subscriber that answers probes");
        let worst = detail(ModeReason::Control, |now| {
            let mut elsewhere = subscriber("robot", SubscriberState::Noncritical, 50);
            elsewhere.lane = Some(0);
            now.subscribers = vec![
                subscriber("desk", SubscriberState::Critical, 0),
                subscriber("laptop", SubscriberState::Noncritical, 1),
                subscriber("tablet", SubscriberState::Unknown, 9),
                elsewhere,
            ];
        });
        let expected = "the worst of 3 subscribers, laptop is NONCRITICAL: RTT 20.0 ms, loss 2.0 %";
        assert_eq!(worst, expected);
    }

    #[test]
    fn a_lane_that_is_not_degraded_has_a_reason() {
        let noncritical = |now: &mut Snapshot| {
            now.subscribers = vec![subscriber("laptop", SubscriberState::Noncritical, 1)];
        };
        let found = detail(ModeReason::Control, |now| {
            noncritical(now);
            now.lanes[1].mode = LaneMode::Normal;
        });
        assert!(found.ends_with("because safety.allow_noncritical_degrade is false"), "{found}");
        let found = detail(ModeReason::Control, |now| {
            noncritical(now);
            now.lanes[1].class = TrafficClass::Critical;
        });
        assert_eq!(found, "a critical lane forwards every sample, even over bad links");
        let found = detail(ModeReason::Control, |now| now.control.classifies = 0);
        assert_eq!(found, "subscribers are not classified");
    }

    #[test]
    fn a_mode_set_by_safety_is_explained_by_its_cause() {
        let found = detail(ModeReason::Safety, |now| {
            now.control.safety = SafetyMode::Emergency as u8;
            now.control.safety_reason = FixedText::new("ingress is dead");
        });
        assert_eq!(found, "the safety mode is emergency: ingress is dead");
    }

    #[test]
    fn round_trips_are_unknown_when_no_probe_was_answered() {
        let now = healthy();
        let report = now.subscriber_report(&subscriber("laptop", SubscriberState::Noncritical, 50));
        assert_eq!((report.rtt_mean_ms, report.loss), (None, Some(1.0)));
        assert_eq!(report.figures(), "none of 50 probes answered");
    }
}
