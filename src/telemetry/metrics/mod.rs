//! The metrics page: the report in the text format of Prometheus, and the HTTP server for it.
//!
//! Names begin with `adaptive_bridge_`. Counters end in `_total` and restart at 0 with the bridge. Times are
//! in seconds. `docs/diagnostics.md` lists all metrics.

mod page;
mod server;

pub use page::CONTENT_TYPE;
pub use server::{MetricsError, MetricsServer};

use super::liveness::ProcessState;
use super::problem::Level;
use super::report::{Latency, OutputReport, ProcessReport, Report, RouteReport, SubscriberReport};
use crate::model::{DropReason, LaneMode, NetworkRefusal, ProbeRefusal, SafetyMode, SubscriberState};
use page::Kind::{Counter, Gauge, Histogram};
use page::{Page, Value};

/// The report as a page of [`CONTENT_TYPE`]. Its size grows with the number of routes and lanes: about 15 KiB
/// for each route on two lanes.
pub fn metrics_page(report: &Report) -> String {
    let mut page = Page::default();
    bridge(&mut page, report);
    processes(&mut page, report);
    lanes(&mut page, report);
    routes(&mut page, report);
    outputs(&mut page, report);
    control(&mut page, report);
    subscribers(&mut page, report);
    page.into_text()
}

fn bridge(page: &mut Page, report: &Report) {
    page.family("adaptive_bridge_info", Gauge, "The instance and the version of the bridge; always 1.");
    let version = env!("CARGO_PKG_VERSION");
    page.sample(&[("instance", &report.instance), ("version", version)], Some(1));
    page.family(
        "adaptive_bridge_report_timestamp_seconds",
        Gauge,
        "Time at which the values of this page were read, since the Unix epoch.",
    );
    page.sample(&[], Some(report.time_unix_ms as f64 / 1e3));
    page.family("adaptive_bridge_problems", Gauge, "Problems, by level.");
    for level in [Level::Warn, Level::Error, Level::Stale] {
        let count = report.problems.iter().filter(|problem| problem.level == level).count();
        page.sample(&[("level", level.label())], Some(count as u64));
    }
}

fn processes(page: &mut Page, report: &Report) {
    let mut each = |name, kind, help: &str, value: &dyn Fn(&ProcessReport) -> Option<Value>| {
        page.family(name, kind, help);
        for process in &report.processes {
            page.sample(&[("process", &process.name)], value(process));
        }
    };
    each("adaptive_bridge_process_up", Gauge, "1 while the process runs and makes turns.", &|process| {
        Some((process.state == ProcessState::Running).into())
    });
    each("adaptive_bridge_process_starts_total", Counter, "Starts of the process.", &|process| {
        Some(process.starts.into())
    });
    each("adaptive_bridge_process_turns_total", Counter, "Turns of its data path.", &|process| {
        Some(process.turns.into())
    });
    each("adaptive_bridge_process_errors_total", Counter, "Errors, except dropped samples.", &|process| {
        Some(process.errors.into())
    });
    each(
        "adaptive_bridge_process_refused_reloads_total",
        Counter,
        "Reloads refused because of errors in the configuration file.",
        &|process| Some(process.refused_reloads.into()),
    );
    each("adaptive_bridge_process_last_turn_age_seconds", Gauge, "Time since its last turn.", &|process| {
        seconds(process.last_turn_age_ms)
    });
    let help = "Datagrams and announcements that its participants refused, by reason.";
    page.family("adaptive_bridge_process_network_refusals_total", Counter, help);
    for process in &report.processes {
        for reason in NetworkRefusal::ALL {
            let labels = [("process", process.name.as_str()), ("reason", reason.label())];
            page.sample(&labels, Some(process.network_refusals.get(*reason)));
        }
    }
}

fn lanes(page: &mut Page, report: &Report) {
    let modes = LaneMode::ALL.map(LaneMode::label);
    page.family("adaptive_bridge_lane_mode", Gauge, "1 for the mode that the lane should be in.");
    for lane in &report.lanes {
        page.states(&[("lane", &lane.name), ("class", lane.class)], "mode", &modes, lane.mode);
    }
    page.family("adaptive_bridge_lane_applied_mode", Gauge, "1 for the mode that its process applies.");
    for lane in &report.lanes {
        if let Some(applied) = lane.applied_mode {
            page.states(&[("lane", &lane.name), ("class", lane.class)], "mode", &modes, applied);
        }
    }
    page.family("adaptive_bridge_lane_mode_changes_total", Counter, "Changes of the lane's policy.");
    for lane in &report.lanes {
        page.sample(&[("lane", &lane.name)], Some(lane.policy_epoch));
    }
}

fn routes(page: &mut Page, report: &Report) {
    let mut each = |name, kind, help: &str, value: &dyn Fn(&RouteReport) -> Value| {
        page.family(name, kind, help);
        for route in &report.routes {
            page.sample(&[("route", &route.id)], Some(value(route)));
        }
    };
    each("adaptive_bridge_route_publishers", Gauge, "Matched publishers.", &|route| route.writers.into());
    each("adaptive_bridge_route_received_samples_total", Counter, "Samples taken from DDS.", &|route| {
        route.received.into()
    });
    each(
        "adaptive_bridge_route_received_bytes_total",
        Counter,
        "Payload bytes of the received samples.",
        &|route| route.received_bytes.into(),
    );
    each("adaptive_bridge_route_published_samples_total", Counter, "Samples given to the lanes.", &|route| {
        route.published.into()
    });
    each(
        "adaptive_bridge_route_in_place_samples_total",
        Counter,
        "Published samples that were assembled in shared memory, not copied there.",
        &|route| route.in_place.into(),
    );
    each(
        "adaptive_bridge_route_lost_upstream_samples_total",
        Counter,
        "Samples lost before ingress, by gaps in the publishers' sequence numbers.",
        &|route| route.lost_upstream.into(),
    );
    each(
        "adaptive_bridge_route_repeated_samples_total",
        Counter,
        "Discarded samples that arrived again or after newer ones; not included in the received samples.",
        &|route| route.repeated.into(),
    );
    each(
        "adaptive_bridge_route_unmarked_samples_total",
        Counter,
        "Received samples of publishers beyond 64, whose repetitions are not recognised.",
        &|route| route.unmarked.into(),
    );
    page.family(
        "adaptive_bridge_route_dropped_samples_total",
        Counter,
        "Samples received but not given to the lanes, by reason.",
    );
    for route in &report.routes {
        for reason in DropReason::ALL {
            let labels = [("route", route.id.as_str()), ("reason", reason.label())];
            page.sample(&labels, Some(route.drops.get(*reason)));
        }
    }
    page.family(
        "adaptive_bridge_route_dds_in_latency_seconds",
        Histogram,
        "From the publisher's source timestamp to ingress. The sum is within 3.2 percent.",
    );
    for route in &report.routes {
        page.histogram(&[("route", &route.id)], &route.dds_in.total);
    }
}

fn outputs(page: &mut Page, report: &Report) {
    let all = || report.routes.iter().flat_map(|route| route.lanes.iter().map(move |output| (route, output)));
    let mut each = |name, kind, help: &str, value: &dyn Fn(&OutputReport) -> u64| {
        page.family(name, kind, help);
        for (route, output) in all() {
            page.sample(&[("lane", &output.lane), ("route", &route.id)], Some(value(output)));
        }
    };
    each("adaptive_bridge_lane_subscribers", Gauge, "Matched subscribers.", &|output| output.readers);
    each(
        "adaptive_bridge_lane_reader_overrun_samples_total",
        Counter,
        "Samples that left the lane's history before single subscribers acknowledged them.",
        &|output| output.reader_overrun,
    );
    each("adaptive_bridge_lane_offered_samples_total", Counter, "Samples offered to the lane.", &|output| {
        output.received
    });
    each("adaptive_bridge_lane_forwarded_samples_total", Counter, "Samples given to DDS.", &|output| {
        output.forwarded
    });
    each(
        "adaptive_bridge_lane_forwarded_bytes_total",
        Counter,
        "Payload bytes of the forwarded samples.",
        &|output| output.forwarded_bytes,
    );
    each(
        "adaptive_bridge_lane_by_reference_samples_total",
        Counter,
        "Forwarded samples that were not copied.",
        &|output| output.by_reference,
    );
    each(
        "adaptive_bridge_lane_caught_up_samples_total",
        Counter,
        "Forwarded samples that were published while the lane was down.",
        &|output| output.caught_up,
    );
    each("adaptive_bridge_lane_waiting_samples", Gauge, "Samples waiting in the lane.", &|output| {
        output.waiting
    });
    page.family("adaptive_bridge_lane_dropped_samples_total", Counter, "Samples not forwarded, by reason.");
    for (route, output) in all() {
        for reason in DropReason::ALL {
            let labels = [("lane", output.lane.as_str()), ("route", &route.id), ("reason", reason.label())];
            page.sample(&labels, Some(output.drops.get(*reason)));
        }
    }
    let mut each = |name, help: &str, stage: fn(&OutputReport) -> &Latency| {
        page.family(name, Histogram, help);
        for (route, output) in all() {
            page.histogram(&[("lane", &output.lane), ("route", &route.id)], &stage(output).total);
        }
    };
    each(
        "adaptive_bridge_lane_shm_latency_seconds",
        "From ingress to the lane, the wait for a token included. The sum is within 3.2 percent.",
        |output| &output.shm,
    );
    each(
        "adaptive_bridge_lane_dds_out_latency_seconds",
        "Within the lane, up to its DDS writer. The sum is within 3.2 percent.",
        |output| &output.dds_out,
    );
    each(
        "adaptive_bridge_lane_sample_age_seconds",
        "Age by the source timestamp when given to DDS. The sum is within 3.2 percent.",
        |output| &output.age,
    );
}

fn control(page: &mut Page, report: &Report) {
    page.family("adaptive_bridge_safety_mode", Gauge, "1 for the safety mode that is in force.");
    let modes = [SafetyMode::Normal, SafetyMode::Degraded, SafetyMode::Emergency].map(SafetyMode::label);
    page.states(&[], "mode", &modes, report.safety.mode);
    let mut one = |name, kind, help: &str, value: u64| {
        page.family(name, kind, help);
        page.sample(&[], Some(value));
    };
    let (safety, probes) = (&report.safety, &report.probes);
    one("adaptive_bridge_safety_changes_total", Counter, "Changes of the safety mode.", safety.transitions);
    one("adaptive_bridge_probes_sent_total", Counter, "Probe requests sent.", probes.sent);
    one("adaptive_bridge_probe_responses_total", Counter, "Probe responses accepted.", probes.accepted);
    let present = report.intruders.len() as u64;
    one("adaptive_bridge_intruders", Gauge, "Remote subscribers that bypass the bridge at present.", present);
    one(
        "adaptive_bridge_intruders_seen_total",
        Counter,
        "Remote subscribers seen to bypass the bridge.",
        report.intruders_seen,
    );
    let away = report.absences.iter().filter(|absence| absence.back_s.is_none()).count() as u64;
    one("adaptive_bridge_absences", Gauge, "Network interfaces and peers that are away at present.", away);
    page.family("adaptive_bridge_probe_refusals_total", Counter, "Probe messages refused, by reason.");
    for reason in ProbeRefusal::ALL {
        page.sample(&[("reason", reason.label())], Some(probes.refused.get(*reason)));
    }
}

fn subscribers(page: &mut Page, report: &Report) {
    let labels =
        |subscriber: &SubscriberReport| [subscriber.id.clone(), subscriber.lane.clone().unwrap_or_default()];
    page.family("adaptive_bridge_subscriber_state", Gauge, "1 for the state that the subscriber is in.");
    let states = [SubscriberState::Unknown, SubscriberState::Critical, SubscriberState::Noncritical];
    for subscriber in &report.subscribers {
        let [id, lane] = labels(subscriber);
        let states = states.map(SubscriberState::label);
        page.states(&[("subscriber", &id), ("lane", &lane)], "state", &states, subscriber.state);
    }
    let mut each = |name, kind, help: &str, value: &dyn Fn(&SubscriberReport) -> Option<Value>| {
        page.family(name, kind, help);
        for subscriber in &report.subscribers {
            let [id, lane] = labels(subscriber);
            page.sample(&[("subscriber", &id), ("lane", &lane)], value(subscriber));
        }
    };
    each("adaptive_bridge_subscriber_state_changes_total", Counter, "Changes of its state.", &|subscriber| {
        Some(subscriber.transitions.into())
    });
    each(
        "adaptive_bridge_subscriber_loss_ratio",
        Gauge,
        "Share of its probes lost, 0 to 1.",
        &|subscriber| subscriber.loss.map(Value::from),
    );
    each("adaptive_bridge_subscriber_rtt_mean_seconds", Gauge, "Mean round trip.", &|subscriber| {
        seconds(subscriber.rtt_mean_ms)
    });
    each(
        "adaptive_bridge_subscriber_rtt_p95_seconds",
        Gauge,
        "95th percentile of the round trip.",
        &|subscriber| seconds(subscriber.rtt_p95_ms),
    );
    each("adaptive_bridge_subscriber_jitter_seconds", Gauge, "Jitter of the round trip.", &|subscriber| {
        seconds(subscriber.jitter_ms)
    });
    each(
        "adaptive_bridge_subscriber_last_response_age_seconds",
        Gauge,
        "Time since its last probe response.",
        &|subscriber| seconds(subscriber.last_response_age_ms),
    );
}

fn seconds(ms: Option<f64>) -> Option<Value> {
    ms.map(|ms| Value::from(ms / 1e3))
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::telemetry::test_report::wide_report;

    #[test]
    fn every_metric_is_documented_with_its_type_and_labels() {
        let documented: BTreeSet<String> = include_str!("../../../docs/diagnostics.md")
            .lines()
            .filter(|line| line.starts_with("| `adaptive_bridge_"))
            .map(|line| line.rsplit_once(" | ").map_or(line, |(row, _meaning)| row).to_owned())
            .collect();
        let page = metrics_page(&wide_report());
        let labels = |name: &str| -> String {
            let sample = page.lines().find(|line| !line.starts_with('#') && line.starts_with(name));
            let Some((_, labels)) = sample.and_then(|line| line.split_once('{')) else {
                return String::new();
            };
            let names = labels.split("\",").filter_map(|label| label.split_once('=')).map(|(name, _)| name);
            names.filter(|name| *name != "le").map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ")
        };
        let families = page.lines().filter_map(|line| line.strip_prefix("# TYPE "));
        let found: BTreeSet<String> = families
            .filter_map(|family| family.split_once(' '))
            .map(|(name, kind)| format!("| `{name}` | {kind} | {}", labels(name)))
            .collect();
        assert_eq!(found, documented);
    }
}
