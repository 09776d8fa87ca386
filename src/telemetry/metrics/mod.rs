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
use crate::model::{LaneMode, SafetyMode, SubscriberState};
use page::Kind::{Counter, Gauge, Histogram};
use page::Page;

/// The report as a page of [`CONTENT_TYPE`]. Its size grows with the number of routes and lanes: about 15 KiB
/// for each route on two lanes.
pub fn metrics_page(report: &Report) -> String {
    let mut page = Page::with_prefix("adaptive_bridge_");
    bridge(&mut page, report);
    processes(&mut page, report);
    lanes(&mut page, report);
    routes(&mut page, report);
    outputs(&mut page, report);
    control(&mut page, report);
    subscribers(&mut page, report);
    page.text
}

fn bridge(page: &mut Page, report: &Report) {
    page.family("info", Gauge, "The instance and the version of the bridge; always 1.");
    let version = env!("CARGO_PKG_VERSION");
    page.sample(&[("instance", &report.instance), ("version", version)], Some(1));
    let help = "Time at which the values of this page were read, since the Unix epoch.";
    page.family("report_timestamp_seconds", Gauge, help);
    page.sample(&[], Some(report.time_unix_ms as f64 / 1e3));
    page.family("problems", Gauge, "Problems, by level.");
    for level in [Level::Warn, Level::Error, Level::Stale] {
        let count = report.problems.iter().filter(|problem| problem.level == level).count();
        page.sample(&[("level", level.label())], Some(count as u64));
    }
}

fn processes(page: &mut Page, report: &Report) {
    let mut each = |name, kind, help, value: fn(&ProcessReport) -> Option<f64>| {
        page.family(name, kind, help);
        for process in &report.processes {
            page.sample(&[("process", &process.reading.name)], value(process));
        }
    };
    each("process_up", Gauge, "1 while the process runs and makes turns.", |process| {
        Some(f64::from(process.reading.state == ProcessState::Running))
    });
    each("process_starts_total", Counter, "Starts of the process.", |process| {
        Some(process.reading.health.starts as f64)
    });
    each("process_standby", Gauge, "1 while a standby waits for its role.", |process| {
        Some(f64::from(process.reading.standby.pid > 0))
    });
    each("process_take_overs_total", Counter, "How often a standby has taken its role over.", |process| {
        Some(process.reading.standby.take_overs as f64)
    });
    each("process_turns_total", Counter, "Turns of its data path.", |process| {
        Some(process.reading.health.turns as f64)
    });
    each("process_errors_total", Counter, "Errors, except dropped samples.", |process| {
        Some(process.reading.health.errors as f64)
    });
    let help = "Reloads refused because of errors in the configuration file.";
    each("process_refused_reloads_total", Counter, help, |process| {
        Some(process.reading.health.refused_reloads as f64)
    });
    each("process_last_turn_age_seconds", Gauge, "Time since its last turn.", |process| {
        seconds(process.last_turn_age_ms)
    });
    let help = "Datagrams and announcements that its participants refused, by reason.";
    page.family("process_network_refusals_total", Counter, help);
    for process in &report.processes {
        let refusals = &process.reading.health.network_refusals;
        page.counts(&[("process", &process.reading.name)], refusals);
    }
}

fn lanes(page: &mut Page, report: &Report) {
    let modes = LaneMode::ALL.map(LaneMode::label);
    page.family("lane_mode", Gauge, "1 for the mode that the lane should be in.");
    for lane in &report.lanes {
        page.states(&[("lane", &lane.name), ("class", lane.class)], "mode", &modes, lane.mode);
    }
    page.family("lane_applied_mode", Gauge, "1 for the mode that its process applies.");
    for lane in &report.lanes {
        if let Some(applied) = lane.applied_mode {
            page.states(&[("lane", &lane.name), ("class", lane.class)], "mode", &modes, applied);
        }
    }
    page.family("lane_mode_changes_total", Counter, "Changes of the lane's policy.");
    for lane in &report.lanes {
        page.sample(&[("lane", &lane.name)], Some(lane.policy_epoch));
    }
}

fn routes(page: &mut Page, report: &Report) {
    let memory = &report.shared_memory;
    page.family("shared_memory_budget_bytes", Gauge, "The most that the pools of all routes may take.");
    page.sample(&[], Some(memory.budget_bytes));
    page.family("shared_memory_used_bytes", Gauge, "Shared memory of the pools of all routes.");
    page.sample(&[], Some(memory.used_bytes));
    page.family("shared_memory_peak_bytes", Gauge, "The most that they have had since ingress started.");
    page.sample(&[], Some(memory.peak_bytes));
    let mut each = |name, kind, help, value: fn(&RouteReport) -> u64| {
        page.family(name, kind, help);
        for route in &report.routes {
            page.sample(&[("route", &route.id)], Some(value(route)));
        }
    };
    each("route_publishers", Gauge, "Matched publishers.", |route| route.counters.writers);
    let help = "Samples taken from DDS.";
    each("route_received_samples_total", Counter, help, |route| route.counters.received);
    let help = "Payload bytes of the received samples.";
    each("route_received_bytes_total", Counter, help, |route| route.counters.received_bytes);
    let help = "Samples given to the lanes.";
    each("route_published_samples_total", Counter, help, |route| route.counters.published);
    let help = "Published samples that were assembled in shared memory, not copied there.";
    each("route_in_place_samples_total", Counter, help, |route| route.counters.in_place);
    let help = "Shared memory of the route's pool.";
    each("route_pool_bytes", Gauge, help, |route| route.counters.pool_bytes);
    let help = "The most shared memory that the route's pool has had since ingress started.";
    each("route_pool_peak_bytes", Gauge, help, |route| route.counters.pool_peak_bytes);
    let help = "Samples lost before ingress, by gaps in the publishers' sequence numbers.";
    each("route_lost_upstream_samples_total", Counter, help, |route| route.counters.lost_upstream);
    let help =
        "Discarded samples that arrived again or after newer ones; not included in the received samples.";
    each("route_repeated_samples_total", Counter, help, |route| route.counters.repeated);
    let help = "Received samples of publishers beyond 64, whose repetitions are not recognised.";
    each("route_unmarked_samples_total", Counter, help, |route| route.counters.unmarked);
    let help = "Samples received but not given to the lanes, by reason.";
    page.family("route_dropped_samples_total", Counter, help);
    for route in &report.routes {
        page.counts(&[("route", &route.id)], &route.counters.drops);
    }
    let help = "From the publisher's source timestamp to ingress. The sum is within 3.2 percent.";
    page.family("route_dds_in_latency_seconds", Histogram, help);
    for route in &report.routes {
        page.histogram(&[("route", &route.id)], &route.dds_in.total);
    }
    page.family("pattern_waiting_topics", Gauge, "Topics that match a pattern and have no route.");
    for pattern in &report.patterns {
        page.sample(&[("pattern", &pattern.id)], Some(pattern.waiting));
    }
}

fn outputs(page: &mut Page, report: &Report) {
    let all = || report.routes.iter().flat_map(|route| route.lanes.iter().map(move |output| (route, output)));
    let mut each = |name, kind, help, value: fn(&OutputReport) -> u64| {
        page.family(name, kind, help);
        for (route, output) in all() {
            page.sample(&[("lane", &output.lane), ("route", &route.id)], Some(value(output)));
        }
    };
    each("lane_subscribers", Gauge, "Matched subscribers.", |output| output.counters.readers);
    let help = "Samples that left the lane's history before single subscribers acknowledged them.";
    each("lane_reader_overrun_samples_total", Counter, help, |output| output.counters.reader_overrun);
    let help = "The most forwarded samples that one subscriber may have missed because a process ended.";
    each("lane_unconfirmed_samples_total", Counter, help, |output| output.counters.unconfirmed);
    let help = "Late joiners that get no history, because too many others waited for it.";
    each("lane_late_joiners_unserved_total", Counter, help, |output| output.counters.late_joiners_unserved);
    let help = "Samples offered to the lane.";
    each("lane_offered_samples_total", Counter, help, |output| output.received);
    let help = "Samples given to DDS.";
    each("lane_forwarded_samples_total", Counter, help, |output| output.counters.forwarded);
    let help = "Payload bytes of the forwarded samples.";
    each("lane_forwarded_bytes_total", Counter, help, |output| output.counters.forwarded_bytes);
    let help = "Forwarded samples that were not copied.";
    each("lane_by_reference_samples_total", Counter, help, |output| output.counters.by_reference);
    let help = "Forwarded samples that were published while the lane was down.";
    each("lane_caught_up_samples_total", Counter, help, |output| output.counters.caught_up);
    each("lane_waiting_samples", Gauge, "Samples waiting in the lane.", |output| output.counters.waiting);
    page.family("lane_dropped_samples_total", Counter, "Samples not forwarded, by reason.");
    for (route, output) in all() {
        page.counts(&[("lane", &output.lane), ("route", &route.id)], &output.counters.drops);
    }
    let mut each = |name, help, stage: fn(&OutputReport) -> &Latency| {
        page.family(name, Histogram, help);
        for (route, output) in all() {
            page.histogram(&[("lane", &output.lane), ("route", &route.id)], &stage(output).total);
        }
    };
    let help = "From ingress to the lane, the wait for a token included. The sum is within 3.2 percent.";
    each("lane_shm_latency_seconds", help, |output| &output.shm);
    let help = "Within the lane, up to its DDS writer. The sum is within 3.2 percent.";
    each("lane_dds_out_latency_seconds", help, |output| &output.dds_out);
    let help = "Age by the source timestamp when given to DDS. The sum is within 3.2 percent.";
    each("lane_sample_age_seconds", help, |output| &output.age);
}

fn control(page: &mut Page, report: &Report) {
    page.family("safety_mode", Gauge, "1 for the safety mode that is in force.");
    page.states(&[], "mode", &SafetyMode::ALL.map(SafetyMode::label), report.safety.mode);
    let mut one = |name, kind, help, value: u64| {
        page.family(name, kind, help);
        page.sample(&[], Some(value));
    };
    let (safety, probes) = (&report.safety, &report.probes);
    one("safety_changes_total", Counter, "Changes of the safety mode.", safety.transitions);
    one("probes_sent_total", Counter, "Probe requests sent.", probes.sent);
    one("probe_responses_total", Counter, "Probe responses accepted.", probes.accepted);
    let present = report.intruders.len() as u64;
    one("intruders", Gauge, "Remote subscribers that bypass the bridge at present.", present);
    let help = "Remote subscribers seen to bypass the bridge.";
    one("intruders_seen_total", Counter, help, report.intruders_seen);
    let away = report.absences.iter().filter(|absence| absence.back_s.is_none()).count() as u64;
    one("absences", Gauge, "Network interfaces and peers that are away at present.", away);
    page.family("probe_refusals_total", Counter, "Probe messages refused, by reason.");
    page.counts(&[], &probes.refused);
}

fn subscribers(page: &mut Page, report: &Report) {
    fn labels(subscriber: &SubscriberReport) -> [(&'static str, &str); 2] {
        let lane = subscriber.lane.as_deref().unwrap_or_default();
        [("subscriber", &subscriber.id), ("lane", lane)]
    }
    page.family("subscriber_state", Gauge, "1 for the state that the subscriber is in.");
    let states = SubscriberState::ALL.map(SubscriberState::label);
    for subscriber in &report.subscribers {
        page.states(&labels(subscriber), "state", &states, subscriber.state);
    }
    let mut each = |name, kind, help, value: fn(&SubscriberReport) -> Option<f64>| {
        page.family(name, kind, help);
        for subscriber in &report.subscribers {
            page.sample(&labels(subscriber), value(subscriber));
        }
    };
    each("subscriber_state_changes_total", Counter, "Changes of its state.", |one| {
        Some(one.transitions as f64)
    });
    let help = "Share of its probes lost, 0 to 1.";
    each("subscriber_loss_ratio", Gauge, help, |one| one.loss);
    each("subscriber_rtt_mean_seconds", Gauge, "Mean round trip.", |one| seconds(one.rtt_mean_ms));
    let help = "95th percentile of the round trip.";
    each("subscriber_rtt_p95_seconds", Gauge, help, |one| seconds(one.rtt_p95_ms));
    each("subscriber_jitter_seconds", Gauge, "Jitter of the round trip.", |one| seconds(one.jitter_ms));
    let help = "Time since its last probe response.";
    each("subscriber_last_response_age_seconds", Gauge, help, |one| seconds(one.last_response_age_ms));
}

fn seconds(ms: Option<f64>) -> Option<f64> {
    ms.map(|ms| ms / 1e3)
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
