//! The comparison of both phases, as text and as JSON.

use serde::Serialize;

use super::scan::SCAN_BYTES;
use super::tally::{Figures, Quantiles};
use super::{HISTORY_SCANS, MAX_BLOCKING_MS, RATE_HZ, STALL_EVERY_MS, STALL_MS};
use crate::model::DropReason;
use crate::telemetry;

/// The explanation of the drop reason `superseded`, which is intended on a rate-limited lane.
const SUPERSEDED: &str = "Superseded: the remote lane forwards 10 scans a second, each time the latest one, \
                          and drops the older ones.";

/// The label of a row, and its figure of one phase.
type Row = (&'static str, fn(&Figures) -> String);

#[derive(Debug, Serialize)]
pub(super) struct Outcome {
    pub seconds_per_phase: u64,
    pub scan_rate_hz: u64,
    pub scan_bytes: usize,
    pub history_scans: usize,
    pub max_blocking_ms: u64,
    pub stall_ms: u64,
    pub stall_every_ms: u64,
    pub without_bridge: Figures,
    pub with_bridge: Figures,
    /// Whether the stalls impaired the critical subscriber without the bridge and not with it.
    pub shown: bool,
    pub summary: String,
}

impl Outcome {
    pub fn new(seconds_per_phase: u64, without_bridge: Figures, with_bridge: Figures) -> Self {
        Self {
            seconds_per_phase,
            scan_rate_hz: RATE_HZ,
            scan_bytes: SCAN_BYTES,
            history_scans: HISTORY_SCANS,
            max_blocking_ms: MAX_BLOCKING_MS,
            stall_ms: STALL_MS,
            stall_every_ms: STALL_EVERY_MS,
            shown: is_impaired(&without_bridge) && !is_impaired(&with_bridge),
            summary: summary(&without_bridge, &with_bridge),
            without_bridge,
            with_bridge,
        }
    }

    /// The comparison, at most 79 columns wide.
    pub fn text(&self) -> String {
        let (without, with) = (&self.without_bridge, &self.with_bridge);
        let mut text = String::new();
        let mut row = |label: &str, without: &str, with: &str| {
            text += &format!("  {label:<37}{without:>18}{with:>18}\n");
        };
        row("", "without bridge", "with bridge");
        let rows: [Row; 10] = [
            ("publisher: scans written", |one| format!("{:.1} Hz", one.publisher.rate_hz)),
            ("publisher: longest publish call", |one| latency(one.publisher.call_max_ms)),
            ("critical: scans received", |one| format!("{} of {}", one.critical.received, one.publisher.due)),
            ("critical: scans lost", |one| one.critical.lost.to_string()),
            ("critical: longest silence", |one| format!("{:.2} s", one.critical.silence_max_ms / 1e3)),
            ("critical: latency p50", |one| quantile(one, |all| all.p50)),
            ("                  p95", |one| quantile(one, |all| all.p95)),
            ("                  p99", |one| quantile(one, |all| all.p99)),
            ("                  max", |one| quantile(one, |all| all.max)),
            ("remote: scans received", |one| one.remote.received.to_string()),
        ];
        for (label, figure) in rows {
            row(label, &figure(without), &figure(with));
        }
        if let Some(drops) = &with.drops {
            let processes = [
                ("ingress", &drops.ingress),
                ("critical lane", &drops.critical),
                ("remote lane", &drops.noncritical),
            ];
            for (process, dropped) in processes {
                if dropped.is_empty() {
                    row(&format!("drops, {process}"), "", "none");
                }
                for (name, count) in dropped {
                    row(&format!("drops, {process}: {name}"), "", &count.to_string());
                }
            }
            if drops.noncritical.contains_key(DropReason::Superseded.label()) {
                text += &format!("\n{}\n", wrapped(SUPERSEDED));
            }
        }
        text + "\n" + &wrapped(&self.summary)
    }
}

/// Whether the critical subscriber was impaired: it missed more than one scan in a hundred.
fn is_impaired(figures: &Figures) -> bool {
    figures.critical.lost * 100 > figures.publisher.due
}

fn summary(without: &Figures, with: &Figures) -> String {
    let silence_s = |figures: &Figures| figures.critical.silence_max_ms / 1e3;
    let bridge = format!(
        "the publisher wrote {:.1} scans a second, no publish call took longer than {}, and the critical \
         subscriber received {} of {} scans",
        with.publisher.rate_hz,
        latency(with.publisher.call_max_ms),
        with.critical.received,
        with.publisher.due,
    );
    match (is_impaired(without), is_impaired(with)) {
        (true, false) => format!(
            "Shown: without the bridge, the failed link of the remote subscriber filled the history of the \
             writer that both subscribers share. Publish calls waited up to {}, and the publisher fell to \
             {:.1} Hz; the critical subscriber, whose own link worked, missed {} of {} scans and once received \
             nothing for {:.1} s. With the bridge, under the same stalls, {bridge}.",
            latency(without.publisher.call_max_ms),
            without.publisher.rate_hz,
            without.critical.lost,
            without.publisher.due,
            silence_s(without),
        ),
        (true, true) => format!(
            "Not shown: the critical subscriber missed {} scans without the bridge and {} with it. The \
             bridge should lose none: this machine may be too busy for 30 scans a second.",
            without.critical.lost, with.critical.lost,
        ),
        (false, false) => format!(
            "Not shown: in this run the stalls did not fill the history of the writer that both subscribers \
             share, so the critical subscriber was not impaired without the bridge either. With the bridge, \
             {bridge}."
        ),
        (false, true) => format!(
            "Not shown: the critical subscriber missed {} scans with the bridge and {} without it. This \
             machine may be too busy for 30 scans a second.",
            with.critical.lost, without.critical.lost,
        ),
    }
}

fn latency(ms: f64) -> String {
    if ms < 10.0 { format!("{ms:.2} ms") } else { format!("{ms:.0} ms") }
}

fn quantile(figures: &Figures, which: impl Fn(&Quantiles) -> f64) -> String {
    figures.critical.latency_ms.as_ref().map_or("-".to_owned(), |all| latency(which(all)))
}

/// Wraps the text into lines of at most 79 columns.
pub(super) fn wrapped(text: &str) -> String {
    telemetry::wrapped(79, "", "", text.split_whitespace(), " ").trim_end().to_owned()
}
