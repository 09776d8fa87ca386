//! The report as text: the problems first, then a table for ingress and one for each lane, in 100 columns.

use std::fmt::{self, Write};

use comfy_table::{CellAlignment, ColumnConstraint, Table, Width, presets};

use super::liveness::ProcessState;
use super::report::{
    AbsenceReport, IntruderReport, LaneReport, Latency, OutputReport, ParametersReport, ProbesReport,
    ProcessReport, Report, RouteReport, SafetyReport, SubscriberReport,
};
use super::snapshot::ProcessReading;
use super::text::{bytes_text, counted, wrapped};
use crate::model::{DropCounts, PublisherAccount, TakeOverCause};

/// The maximum length of a line. Only a single word, such as a long topic name in a problem, may exceed it.
const COLUMNS: usize = 100;
const TOPIC_COLUMNS: usize = 31;

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "bridge {}: routes {}, lanes {}; rates and latencies (p50/p99) of the last {}",
            self.instance,
            self.routes.len(),
            self.lanes.len(),
            latency_text(self.window_ms * 1e3)
        )?;
        match self.problems.len() as u64 {
            0 => writeln!(f, "no problems")?,
            count => writeln!(f, "{}:", counted(count, "problem"))?,
        }
        for problem in &self.problems {
            f.write_str(&wrapped(COLUMNS, "  ! ", "    ", problem.text.split(' '), " "))?;
        }
        let process = |name: &str| self.processes.iter().find(|process| process.reading.name == name);
        if let Some(control) = process("control") {
            write!(f, "\n{}", process_line("control", control))?;
            f.write_str(&safety_text(&self.safety))?;
            f.write_str(&probes_text(&self.probes))?;
            f.write_str(&parameters_text(&self.parameters))?;
            f.write_str(&subscribers_text(&self.subscribers))?;
            f.write_str(&absences_text(&self.absences))?;
            f.write_str(&intruders_text(&self.intruders, self.intruders_seen))?;
        }
        if let Some(ingress) = process("ingress") {
            write!(f, "\n{}", process_line("ingress", ingress))?;
            f.write_str(&self.shared_memory_text())?;
        }
        let heads = ["TOPIC", "PUBS", "IN HZ", "", "BYTES/S", "DDS IN", "LOST UPSTREAM"];
        f.write_str(&table(1, TOPIC_TABLE, heads, self.routes.iter().map(route_row)))?;
        for lane in &self.lanes {
            let process = process(&format!("egress-{}", lane.name));
            let title = format!("lane {}: {};", lane.name, mode_text(lane));
            let process = process.map(process_text).unwrap_or_default();
            let text = format!("{title} {process}");
            write!(f, "\n{}", wrapped(COLUMNS, "", "  ", text.split(' '), " "))?;
            if matches!(lane.mode_reason, "control" | "safety" | "held") {
                f.write_str(&wrapped(COLUMNS, "  why: ", "    ", lane.mode_detail.split(' '), " "))?;
            }
            let heads = ["TOPIC", "SUBS", "IN HZ", "OUT HZ", "SHM", "DDS OUT", "AGE"];
            let outputs = self.routes.iter().flat_map(|route| &route.lanes);
            let rows = outputs.filter(|output| output.lane == lane.name).map(output_row);
            f.write_str(&table(1, TOPIC_TABLE, heads, rows))?;
        }
        Ok(())
    }
}

/// The most routes that the line about shared memory names.
const MAX_NAMED_POOLS: usize = 3;

impl Report {
    /// What the pools have of the budget, and the routes that have the most.
    fn shared_memory_text(&self) -> String {
        let memory = &self.shared_memory;
        if memory.budget_bytes == 0 {
            return String::new();
        }
        let text = |bytes: u64| bytes_text(bytes as f64);
        let mut pools: Vec<_> =
            self.routes.iter().map(|route| (route.counters.pool_bytes, &route.id)).collect();
        pools.sort_by_key(|&(bytes, _)| std::cmp::Reverse(bytes));
        let named = pools.iter().take(MAX_NAMED_POOLS).map(|(bytes, id)| format!("{id} {}", text(*bytes)));
        let line = format!(
            "shared memory: {} of {}, at most {} so far; {}",
            text(memory.used_bytes),
            text(memory.budget_bytes),
            text(memory.peak_bytes),
            named.collect::<Vec<_>>().join(", ")
        );
        wrapped(COLUMNS, " ", "   ", line.split(' '), " ")
    }
}

/// The minimum width of each column.
type Widths = [u16; 7];
/// The cells of a row, and the lines that follow it.
type Row = ([String; 7], String);

/// The widths of the tables of ingress and of the lanes: the same, so that their columns line up.
const TOPIC_TABLE: Widths = [TOPIC_COLUMNS as u16, 5, 7, 7, 13, 13, 13];
const SUBSCRIBER_TABLE: Widths = [24, 13, 12, 13, 7, 7, 15];

/// A table without borders, indented by two columns; all but the first `left` are aligned to the right.
fn table(left: usize, widths: Widths, heads: [&str; 7], rows: impl Iterator<Item = Row>) -> String {
    let (cells, notes): (Vec<_>, Vec<_>) = rows.unzip();
    let mut table = Table::new();
    table.load_preset(presets::NOTHING).set_header(heads).add_rows(cells);
    for (index, (column, width)) in table.column_iter_mut().zip(widths).enumerate() {
        let padding = if index == 0 { 2 } else { 1 };
        let alignment = if index < left { CellAlignment::Left } else { CellAlignment::Right };
        column.set_padding((padding, 0)).set_cell_alignment(alignment);
        column.set_constraint(ColumnConstraint::LowerBoundary(Width::Fixed(padding + width)));
    }
    let mut text = String::new();
    // A cell has no line breaks, so each row is one line; the first is that of the heads.
    for (line, notes) in table.lines().zip([String::new()].iter().chain(&notes)) {
        let _ = writeln!(text, "{}", line.trim_end());
        text.push_str(notes);
    }
    text
}

fn route_row(route: &RouteReport) -> Row {
    let bytes = route.bytes_per_s.map_or("-".to_owned(), |rate| format!("{}/s", bytes_text(rate)));
    let cells = [
        topic_text(&route.input_topic),
        route.counters.writers.to_string(),
        rate_text(route.rate_hz),
        String::new(),
        bytes,
        latencies_text(&route.dds_in),
        route.counters.lost_upstream.to_string(),
    ];
    let mut notes = drops_text(&route.counters.drops, &route.drops_in_window);
    let accounts = route.publishers.iter().map(|publisher| &publisher.account);
    for account in accounts.filter(|account| account.lost_upstream > 0 || account.repeated > 0) {
        let PublisherAccount { writer, received, lost_upstream, repeated, .. } = account;
        let counts = format!("{received} received, {lost_upstream} lost upstream, {repeated} repeated");
        let first = format!("    publisher {writer}: ");
        notes.push_str(&wrapped(COLUMNS, &first, "      ", counts.split_inclusive(", "), ""));
    }
    (cells, notes)
}

fn output_row(output: &OutputReport) -> Row {
    let cells = [
        topic_text(&output.topic),
        output.counters.readers.to_string(),
        rate_text(output.received_hz),
        rate_text(output.rate_hz),
        latencies_text(&output.shm),
        latencies_text(&output.dds_out),
        latencies_text(&output.age),
    ];
    (cells, drops_text(&output.counters.drops, &output.drops_in_window))
}

fn safety_text(safety: &SafetyReport) -> String {
    let since = safety.since_s.map_or(String::new(), |since_s| format!(" for {}", duration_text(since_s)));
    let changes = counted(safety.transitions, "change");
    let reason = safety.reason.as_ref().map_or(String::new(), |reason| format!(": {reason}"));
    let text = format!("{}{since}, {changes}{reason}", safety.mode);
    wrapped(COLUMNS, "  safety: ", "    ", text.split(' '), " ")
}

fn probes_text(probes: &ProbesReport) -> String {
    let mut text = format!("{} sent, {} answered", probes.sent, probes.accepted);
    for (reason, count) in probes.refused.iter() {
        let _ = write!(text, ", {reason} {count}");
    }
    wrapped(COLUMNS, "  probes: ", "    ", text.split_inclusive(", "), "")
}

/// The parameters that were set; no line while the file has all values.
fn parameters_text(parameters: &ParametersReport) -> String {
    if parameters.set.is_empty() {
        return String::new();
    }
    let text = format!("{}; in place of the file until the bridge ends", parameters.set.join(", "));
    wrapped(COLUMNS, "  parameters set: ", "    ", text.split(' '), " ")
}

fn subscribers_text(subscribers: &[SubscriberReport]) -> String {
    if subscribers.is_empty() {
        return String::new();
    }
    let heads = ["SUBSCRIBER", "LANE", "STATE", "RTT MEAN/P95", "JITTER", "LOSS", "LAST RESPONSE"];
    table(3, SUBSCRIBER_TABLE, heads, subscribers.iter().map(subscriber_row))
}

fn subscriber_row(subscriber: &SubscriberReport) -> Row {
    let ms = |ms: Option<f64>| ms.map_or("-".to_owned(), |ms| latency_text(ms * 1e3));
    let response_age_ms = subscriber.last_response_age_ms;
    let cells = [
        end_of(&subscriber.id, 24),
        end_of(subscriber.lane.as_deref().unwrap_or("-"), 13),
        subscriber.state.to_owned(),
        format!("{}/{}", ms(subscriber.rtt_mean_ms), ms(subscriber.rtt_p95_ms)),
        ms(subscriber.jitter_ms),
        subscriber.loss.map_or("-".to_owned(), |loss| format!("{:.1} %", loss * 100.0)),
        response_age_ms.map_or("never".to_owned(), |age_ms| format!("{} ago", latency_text(age_ms * 1e3))),
    ];
    let since =
        subscriber.state_since_s.map_or(String::new(), |since_s| format!("for {}, ", duration_text(since_s)));
    let mut reason = format!("{since}{}", counted(subscriber.transitions, "change"));
    if subscriber.forced {
        reason += ", forced by the configuration";
    } else if !subscriber.reason.is_empty() {
        let _ = write!(reason, ": {}", subscriber.reason);
    }
    if !subscriber.listed {
        reason += "; not listed under subscribers";
    }
    (cells, wrapped(COLUMNS, "    ", "      ", reason.split(' '), " "))
}

fn absences_text(absences: &[AbsenceReport]) -> String {
    let mut text = String::new();
    for absence in absences {
        let name = absence.name.as_deref().unwrap_or("a node of unknown name");
        let host = absence.host.as_ref().map_or_else(String::new, |host| format!(" ({host})"));
        let away = duration_text(absence.away_s);
        let line = match absence.back_s {
            None => format!("{name}{host} {}, for {away}", absence.detail),
            Some(back_s) => format!("{name}{host} for {}, was away for {away}", duration_text(back_s)),
        };
        let first = if absence.back_s.is_none() { "  away: " } else { "  back: " };
        text += &wrapped(COLUMNS, first, "    ", line.split(' '), " ");
    }
    text
}

fn intruders_text(intruders: &[IntruderReport], seen: u64) -> String {
    let mut text = String::new();
    if seen > 0 {
        let _ = writeln!(
            text,
            "  intruders: {} remote subscribers bypass the bridge, {seen} since control started",
            intruders.len()
        );
    }
    for intruder in intruders {
        let node = intruder.node.as_deref().unwrap_or("a node of unknown name");
        let line =
            format!("{node} on {} subscribes to {}: {}", intruder.host, intruder.topic, intruder.remedy);
        text += &wrapped(COLUMNS, "    ", "      ", line.split(' '), " ");
    }
    text
}

fn drops_text(drops: &DropCounts, in_window: &DropCounts) -> String {
    let entries = drops.iter().map(|(reason, count)| match in_window.get(reason) {
        0 => format!("{reason} {count}"),
        new => format!("{reason} {count} (+{new})"),
    });
    let entries: Vec<String> = entries.collect();
    if entries.is_empty() {
        return String::new();
    }
    wrapped(COLUMNS, "    dropped: ", "      ", entries.iter().map(String::as_str), ", ")
}

fn mode_text(lane: &LaneReport) -> String {
    let reason = match lane.mode_reason {
        "by_hand" => "by hand",
        other => other,
    };
    // Control confirms these modes before they end, so the remaining time means nothing to users.
    match lane.mode_ends_in_s.filter(|_| !matches!(lane.mode_reason, "control" | "safety")) {
        Some(left_s) => format!("{} ({reason}, {left_s:.0} s left)", lane.mode),
        None => format!("{} ({reason})", lane.mode),
    }
}

fn process_line(name: &str, process: &ProcessReport) -> String {
    let text = process_text(process);
    wrapped(COLUMNS, &format!("{name}: "), "  ", text.split_inclusive(", "), "")
}

fn process_text(process: &ProcessReport) -> String {
    let ProcessReading { health, state, .. } = &process.reading;
    if *state == ProcessState::NotStarted {
        return state.label().to_owned();
    }
    let restarts = counted(health.starts.saturating_sub(1), "restart");
    let mut failures = String::new();
    if health.errors > 0 {
        let _ = write!(failures, ", {}", counted(health.errors, "error"));
    }
    if health.refused_reloads > 0 {
        let _ = write!(failures, ", {} refused", counted(health.refused_reloads, "reload"));
    }
    for (reason, count) in health.network_refusals.iter() {
        let _ = write!(failures, ", {count} {reason}");
    }
    let mut standby = String::new();
    if process.reading.standby.pid > 0 {
        let _ = write!(standby, ", standby {}", process.reading.standby.pid);
    }
    if process.reading.standby.take_overs > 0 {
        let took_ms = process.reading.standby.took_ns as f64 / 1e6;
        let take_overs = counted(process.reading.standby.take_overs, "take-over");
        let cause = process.reading.standby.cause().map_or("", take_over_cause);
        let _ = write!(standby, ", {take_overs} (the last{cause}: {took_ms:.0} ms)");
    }
    let up = process.uptime_s.map_or(String::new(), |uptime_s| format!(", up {}", duration_text(uptime_s)));
    format!("process {} {}{up}, {restarts}{standby}{failures}", health.pid, state.label())
}

fn take_over_cause(cause: TakeOverCause) -> &'static str {
    match cause {
        TakeOverCause::Ended => ", as the former process ended",
        TakeOverCause::Stopped => ", as the former process was stopped",
        TakeOverCause::Hung => ", as the former process made no progress",
        TakeOverCause::HandedOver => ", on request",
    }
}

fn topic_text(topic: &str) -> String {
    end_of(topic, TOPIC_COLUMNS)
}

/// Shortens a long name to its end, which distinguishes topics better than the beginning.
fn end_of(name: &str, columns: usize) -> String {
    let length = name.chars().count();
    if length <= columns {
        return name.to_owned();
    }
    let end: String = name.chars().skip(length + 1 - columns).collect();
    format!("…{end}")
}

fn rate_text(rate_hz: Option<f64>) -> String {
    rate_hz.map_or("-".to_owned(), |rate| format!("{rate:.1}"))
}

fn latencies_text(latency: &Latency) -> String {
    match (latency.p50_us, latency.p99_us) {
        (Some(p50_us), Some(p99_us)) => format!("{}/{}", latency_text(p50_us), latency_text(p99_us)),
        _ => "-".to_owned(),
    }
}

fn latency_text(us: f64) -> String {
    match us {
        ..999.5 => format!("{us:.0}µs"),
        ..9_995.0 => format!("{:.1}ms", us / 1e3),
        ..999_500.0 => format!("{:.0}ms", us / 1e3),
        ..99_950_000.0 => format!("{:.1}s", us / 1e6),
        _ => format!("{:.0}s", us / 1e6),
    }
}

fn duration_text(seconds: f64) -> String {
    let seconds = seconds as u64;
    let (days, hours, minutes) = (seconds / 86_400, seconds / 3_600 % 24, seconds / 60 % 60);
    match (days, hours, minutes) {
        (0, 0, 0) => format!("{seconds} s"),
        (0, 0, _) => format!("{minutes} min {} s", seconds % 60),
        (0, _, _) => format!("{hours} h {minutes} min"),
        _ => format!("{days} d {hours} h"),
    }
}

#[cfg(test)]
mod tests {
    use super::super::problem::{Level, Problem};
    use super::super::test_report::wide_report;
    use super::*;
    use crate::model::DropReason;

    #[test]
    fn no_line_is_longer_than_100_columns() {
        let text = wide_report().to_string();
        for line in text.lines() {
            assert!(line.chars().count() <= COLUMNS, "{} columns: {line}", line.chars().count());
        }
        for reason in DropReason::ALL {
            assert!(text.contains(&format!("{reason} 184467440737095516")), "{reason} is not shown:\n{text}");
        }
    }

    #[test]
    fn problems_come_first() {
        let mut report = wide_report();
        let problem = |text: &str| Problem { about: "bridge".into(), level: Level::Error, text: text.into() };
        report.problems = vec![problem("ingress is dead"), problem("lane critical has not applied its mode")];
        let text = report.to_string();
        let lines: Vec<&str> = text.lines().collect();
        assert_eq!(
            lines[1..4],
            ["2 problems:", "  ! ingress is dead", "  ! lane critical has not applied its mode"]
        );
        report.problems.clear();
        assert_eq!(report.to_string().lines().nth(1), Some("no problems"));
    }

    #[test]
    fn numbers_are_short_and_have_their_unit() {
        for (us, text) in [
            (0.0, "0µs"),
            (999.4, "999µs"),
            (999.6, "1.0ms"),
            (9_994.0, "10.0ms"),
            (9_996.0, "10ms"),
            (999_600.0, "1.0s"),
            (137_000_000.0, "137s"),
        ] {
            assert_eq!(latency_text(us), text);
        }
        assert_eq!(bytes_text(1_023.0), "1023 B");
        assert_eq!(bytes_text(589_600.0), "575.8 KiB");
        assert_eq!(duration_text(59.9), "59 s");
        assert_eq!(duration_text(3_720.0), "1 h 2 min");
        assert_eq!(duration_text(90_000.0), "1 d 1 h");
        assert_eq!(topic_text("/scan"), "/scan");
        assert_eq!(topic_text(&"a/".repeat(40)).chars().count(), TOPIC_COLUMNS);
    }
}
