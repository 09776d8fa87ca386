//! Synthetic runs for unit tests, with known figures.

use serde_json::json;

use super::cells::Results;
use super::record::{
    Attempt, BridgeRecord, Event, Folder, KernelReading, Manifest, Published, Role, RtpsReading, Run,
    Subscribed, WireReading,
};
use crate::statistics::{Change, Reception};

/// The properties of a synthetic run.
#[derive(Clone)]
pub struct MadeUp {
    pub scenario: &'static str,
    pub library: &'static str,
    /// The reading of Table I; empty for none.
    pub reading: &'static str,
    pub switch: &'static str,
    pub quick: bool,
    pub length_s: u32,
    pub rate_hz: f64,
    /// Latency of nine critical samples in ten.
    pub latency_ms: f64,
    /// Latency of every tenth critical sample.
    pub tail_ms: f64,
    /// The number of samples in the middle of the run that the critical subscriber does not receive.
    pub lost: u64,
    /// The number of publish calls at the end of the run that fail.
    pub failed: u64,
    pub lane_bytes_per_s: u64,
    pub wire_bytes_per_s: u64,
    pub fragments_per_s: u64,
    /// Seconds from each toggle to the classifier's reaction.
    pub reaction_s: Option<f64>,
    pub toggles: Vec<(f64, bool)>,
}

impl Default for MadeUp {
    fn default() -> Self {
        Self {
            scenario: "baseline_clean",
            library: "fast",
            reading: "",
            switch: "plain",
            quick: false,
            length_s: 20,
            rate_hz: 30.0,
            latency_ms: 0.5,
            tail_ms: 0.9,
            lost: 0,
            failed: 0,
            lane_bytes_per_s: 8_000,
            wire_bytes_per_s: 10_000,
            fragments_per_s: 0,
            reaction_s: None,
            toggles: vec![(0.0, true)],
        }
    }
}

impl MadeUp {
    fn is_bridge(&self) -> bool {
        self.scenario.starts_with("bridge")
    }

    fn manifest(&self) -> Manifest {
        let length_ns = u64::from(self.length_s) * 1_000_000_000;
        let level = match self.scenario.split('_').next_back().unwrap_or_default() {
            level @ ("clean" | "mild" | "strong") => level,
            _ => "moderate",
        };
        let endpoint = |name: &str, lane: Option<&str>| {
            json!({"name": name, "role": name, "route": 0, "host": name, "rate_hz": 30.0, "size_bytes": 2948,
                   "reliability": "RELIABLE", "history": "KEEP_ALL", "lane": lane})
        };
        let lane = |name| self.is_bridge().then_some(name);
        let loss = if level == "clean" { 0.0 } else { 0.1 };
        serde_json::from_value(json!({
            "format": 1, "run": format!("{}.{}.{}.netns.{}.r1", self.scenario, self.library, self.reading,
             self.switch),
            "scenario": self.scenario, "title": "made up", "variant": if self.is_bridge() { "bridge" } else {
             "baseline" },
            "level": level, "library": self.library, "reading": Some(self.reading).filter(|name| !name.is_empty()),
            "bed": "netns", "switch": self.switch, "quick": self.quick, "repetition": 1, "seed": 1,
            "duration_s": self.length_s, "settle_s": 5, "begin_ns": 0, "end_ns": length_ns, "begin_unix_ms": 0,
            "classifier": self.is_bridge().then(|| self.scenario != "bridge_ablation"),
            "machine": {"kernel": "", "cpu": "", "cpus": 2, "memory_bytes": 0, "os": "", "load_before": 0.0},
            "software": {"version": "", "commit": null, "modified": false, "bridge": null, "peer": ""},
            "command_line": [], "synthetic": true,
            "endpoints": [endpoint("publisher", None), endpoint("critical", lane("critical")),
                          endpoint("slow", lane("noncritical"))],
            "links": [{"name": "", "direction": "forward", "impairment": {"backend": "", "reason": "",
             "delay_ms": 0.0,
                       "judged": 1000, "lost": (1000.0 * loss) as u64, "loss_expected": loss,
                       "loss_standard_error": 0.01}}],
        }))
        .unwrap()
    }

    /// Creates the run.
    pub fn run(&self) -> Run {
        let manifest = self.manifest();
        let count = (f64::from(self.length_s) * self.rate_hz) as u64;
        let at = |seq: u64| (seq as f64 + 0.5) / self.rate_hz;
        let written = count - self.failed;
        let attempt = |seq| Attempt { seq, at_s: at(seq), call_ms: 0.05, ok: seq < written };
        let attempts: Vec<Attempt> = (0..count).map(attempt).collect();
        let lost = count / 2..count / 2 + self.lost;
        let receptions = (0..written).filter(|seq| !lost.contains(seq)).map(|seq| {
            let latency_ms = if seq % 10 == 9 { self.tail_ms } else { self.latency_ms };
            Reception { seq, at_s: at(seq) + latency_ms / 1e3, latency_ms }
        });
        let receptions: Vec<Reception> = receptions.collect();
        let endpoint = |role: Role| manifest.endpoints.iter().find(|one| one.role == role).unwrap().clone();
        let seconds = || (0..=self.length_s).map(f64::from);
        let port = || "slow".to_owned();
        let mut states = vec![Change { at_s: -1.0, to: "CRITICAL".to_owned() }];
        for (toggled_s, impaired) in &self.toggles {
            let to = if *impaired { "NONCRITICAL" } else { "CRITICAL" };
            states.extend(
                self.reaction_s.map(|after_s| Change { at_s: toggled_s + after_s, to: to.to_owned() }),
            );
        }
        let mut bridge = BridgeRecord::default();
        bridge.subscribers.push(("slow".to_owned(), Default::default()));
        bridge.subscribers[0].1.transitions = states.len() as u64 - 1;
        bridge.subscribers[0].1.states = states;
        bridge.noncritical_bytes =
            seconds().map(|at_s| (at_s, at_s as u64 * self.lane_bytes_per_s)).collect();
        let events = self.toggles.iter().map(|(at_s, impaired)| Event {
            at_s: *at_s,
            event: if *impaired { "link_on" } else { "link_off" }.to_owned(),
            subject: port(),
        });
        Run {
            published: vec![Published { endpoint: endpoint(Role::Publisher), attempts }],
            subscribed: vec![
                Subscribed { endpoint: endpoint(Role::Critical), receptions: receptions.clone() },
                Subscribed { endpoint: endpoint(Role::Slow), receptions },
            ],
            events: events.collect(),
            wire: seconds()
                .map(|at_s| WireReading {
                    at_s,
                    port: port(),
                    to_host_bytes: at_s as u64 * self.wire_bytes_per_s,
                })
                .collect(),
            rtps: seconds()
                .map(|at_s| RtpsReading {
                    at_s,
                    port: port(),
                    direction: "to_host".to_owned(),
                    fragments: at_s as u64 * self.fragments_per_s,
                    user_data: at_s as u64 * 30,
                    user_heartbeat: at_s as u64,
                    user_acknack: 0,
                })
                .collect(),
            kernel: seconds()
                .map(|at_s| KernelReading {
                    at_s,
                    host: "switch".to_owned(),
                    fragment_memory_bytes: 0,
                    reassembly_failed: 0,
                    udp_buffer_errors: 0,
                })
                .collect(),
            processes: Vec::new(),
            bridge: self.is_bridge().then_some(bridge),
            manifest,
        }
    }
}

/// Groups synthetic runs into results.
pub fn results(runs: &[MadeUp]) -> Results {
    Results::new(Folder { runs: runs.iter().map(MadeUp::run).collect(), unusable: Vec::new() })
}
