//! The configuration as a whole: the shipped files, the documentation, and files of any content. Pure except
//! the tests of `load`, which read real files.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use adaptive_bridge::config::{
    self, Classifier, ClassifierThresholds, ConfigError, Diagnostics, DropPolicy, Forwarding, KEYS, Kind,
    LaneRates, Parameters, Place, Probes, RatePolicy, Row, Safety, SafetyRules, Security, Settings,
    TrustMode, Verbosity,
};
use adaptive_bridge::model::{QosProfile, TopicName, TypeName};
use proptest::prelude::*;

const DEFAULT: &str = include_str!("../../config/default.yaml");
const MINIMAL: &str = include_str!("../../config/minimal.yaml");
const README: &str = include_str!("../../config/README.md");

fn no_env(_: &str) -> Option<String> {
    None
}

fn parse(text: &str) -> Result<Settings, ConfigError> {
    config::parse(text, "f.yaml", &no_env)
}

fn settings(text: &str) -> Settings {
    parse(text).unwrap_or_else(|error| panic!("{error}"))
}

fn topic(name: &str) -> TopicName {
    TopicName::try_from(name).unwrap()
}

#[test]
fn the_default_file_and_the_minimal_file_give_the_same_settings() {
    assert_eq!(settings(DEFAULT), settings(MINIMAL));
}

/// What all three files of the original package have in common.
fn check_common_original(settings: &Settings) {
    let [route] = settings.routes.as_slice() else { panic!("{:?}", settings.routes) };
    assert_eq!((route.id.as_str(), &*route.input_topic.to_string()), ("scan_main", "/scan"));
    assert_eq!(route.message_type, Some(TypeName::try_from("sensor_msgs/msg/LaserScan").unwrap()));
    let [critical, noncritical] = settings.lanes.as_slice() else { panic!("{:?}", settings.lanes) };
    assert_eq!(critical.outputs.len() + noncritical.outputs.len(), 2);
    assert_eq!(critical.outputs[0].topic.to_string(), "/adaptive_bridge/critical/scan");
    assert_eq!(critical.outputs[0].qos, QosProfile::CRITICAL);
    assert_eq!(noncritical.outputs[0].topic.to_string(), "/adaptive_bridge/noncritical/scan");
    assert!(settings.overrides.is_empty() && settings.subscribers.is_empty());
}

fn policy(
    max_rate_hz: f64,
    queue_samples: usize,
    drop_policy: DropPolicy,
    stale_threshold_ms: u64,
) -> RatePolicy {
    RatePolicy { max_rate_hz, max_bytes_per_s: None, stale_threshold_ms, drop_policy, queue_samples }
}

fn original_classifier() -> Classifier {
    Classifier {
        enabled: true,
        subscriber_id: None,
        evaluate_rate_hz: 2.0,
        thresholds: ClassifierThresholds {
            demote_loss: 0.04,
            promote_loss: 0.02,
            demote_rtt_ms: 80.0,
            promote_rtt_ms: 40.0,
            hysteresis_count: 3,
            allow_unknown_state: true,
        },
    }
}

fn original_probes() -> Probes {
    Probes {
        enabled: true,
        rate_hz: 5.0,
        rtt_threshold_ms: 100.0,
        loss_threshold: 0.05,
        jitter_threshold_ms: 25.0,
        window_size: 50,
        hysteresis_count: 3,
        timeout_ms: 500,
        request_topic: topic("/adaptive_bridge/probe_req"),
        response_topic: topic("/adaptive_bridge/probe_resp"),
    }
}

fn original_safety(max_noncritical_queue: usize) -> Safety {
    let rules = SafetyRules {
        preserve_critical_path: true,
        allow_noncritical_degrade: true,
        max_noncritical_queue,
        overload_drop_noncritical_first: true,
        ..SafetyRules::default()
    };
    Safety { evaluate_rate_hz: 2.0, rules }
}

fn original_security() -> Security {
    Security {
        trust_mode: TrustMode::DefaultDeny,
        enable_probe_hmac: false,
        secret: None,
        replay_window_ms: 30_000,
        max_probe_rate_hz: 20,
        allow_legacy_node_name_overrides: true,
    }
}

fn original_diagnostics() -> Diagnostics {
    Diagnostics {
        enabled: true,
        publish_interval_ms: 1_000,
        topic: topic("/adaptive_bridge/diagnostics"),
        verbosity: Verbosity::Info,
        metrics: None,
    }
}

#[test]
fn the_originals_default_file_keeps_its_meaning() {
    let settings = settings(include_str!("../fixtures/config/original_default.yaml"));
    check_common_original(&settings);
    let lane = &settings.lanes[1];
    assert_eq!(lane.outputs[0].qos, QosProfile { lifespan_ms: Some(500), ..QosProfile::NONCRITICAL });
    let normal = policy(10.0, 5, DropPolicy::DropOldest, 500);
    let degraded = policy(3.0, 2, DropPolicy::DropStale, 250);
    assert_eq!(lane.forwarding, Forwarding::Limited(LaneRates { normal, degraded }));
    assert_eq!(settings.classifier, original_classifier());
    assert_eq!(settings.probes, original_probes());
    assert_eq!(settings.safety, original_safety(50));
    assert_eq!(settings.security, original_security());
    assert_eq!(settings.diagnostics, original_diagnostics());
}

#[test]
fn the_originals_minimal_file_keeps_its_meaning() {
    let settings = settings(include_str!("../fixtures/config/original_minimal.yaml"));
    check_common_original(&settings);
    let lane = &settings.lanes[1];
    assert_eq!(lane.outputs[0].qos, QosProfile::NONCRITICAL);
    let normal = policy(5.0, 3, DropPolicy::DropOldest, 600);
    let degraded = policy(1.0, 1, DropPolicy::DropStale, 300);
    assert_eq!(lane.forwarding, Forwarding::Limited(LaneRates { normal, degraded }));
    assert_eq!(settings.classifier, original_classifier());
    let probes = Probes {
        rate_hz: 2.0,
        rtt_threshold_ms: 120.0,
        loss_threshold: 0.10,
        jitter_threshold_ms: 30.0,
        window_size: 20,
        timeout_ms: 600,
        ..original_probes()
    };
    assert_eq!(settings.probes, probes);
    assert_eq!(settings.safety, original_safety(20));
    assert_eq!(settings.security, Security { max_probe_rate_hz: 10, ..original_security() });
    assert_eq!(settings.diagnostics, original_diagnostics());
}

#[test]
fn the_originals_stress_file_keeps_its_meaning() {
    let settings = settings(include_str!("../fixtures/config/original_stress.yaml"));
    check_common_original(&settings);
    let lane = &settings.lanes[1];
    assert_eq!(lane.outputs[0].qos, QosProfile { lifespan_ms: Some(500), ..QosProfile::NONCRITICAL });
    let normal = policy(3.0, 3, DropPolicy::DropStale, 300);
    let degraded = policy(1.0, 1, DropPolicy::DropStale, 150);
    assert_eq!(lane.forwarding, Forwarding::Limited(LaneRates { normal, degraded }));
    let classifier = Classifier {
        evaluate_rate_hz: 5.0,
        thresholds: ClassifierThresholds {
            hysteresis_count: 5,
            allow_unknown_state: false,
            ..original_classifier().thresholds
        },
        ..original_classifier()
    };
    assert_eq!(settings.classifier, classifier);
    let probes = Probes {
        rate_hz: 10.0,
        rtt_threshold_ms: 80.0,
        loss_threshold: 0.04,
        jitter_threshold_ms: 15.0,
        window_size: 80,
        hysteresis_count: 5,
        timeout_ms: 300,
        ..original_probes()
    };
    assert_eq!(settings.probes, probes);
    assert_eq!(settings.safety, original_safety(10));
    let security = Security {
        enable_probe_hmac: true,
        max_probe_rate_hz: 15,
        allow_legacy_node_name_overrides: false,
        ..original_security()
    };
    assert_eq!(settings.security, security);
    let diagnostics =
        Diagnostics { publish_interval_ms: 500, verbosity: Verbosity::Debug, ..original_diagnostics() };
    assert_eq!(settings.diagnostics, diagnostics);
}

#[test]
fn twelve_mistakes_in_one_file_are_twelve_problems_with_their_lines() {
    let error = parse(include_str!("../fixtures/config/twelve_mistakes.yaml")).unwrap_err();
    let found: Vec<(Place, &str)> =
        error.problems.iter().map(|problem| (problem.place, problem.key.as_str())).collect();
    let expected = [
        (3, "instance"),
        (5, "ros.domain_id"),
        (8, "topics[0].input_topic"),
        (9, "topics[0].message_typ"),
        (10, "topics[1].id"),
        (13, "qos_profiles.fast.reliability"),
        (14, "qos_profiles.fast.depth"),
        (18, "topic_qos_profiles.scan.critical"),
        (22, "lanes.critical.max_rate_hz"),
        (25, "lanes.rviz.scheduling.priority"),
        (29, "classifier.promote_rtt_ms"),
        (33, "safety.max_noncritical_queue"),
    ];
    assert_eq!(found, expected.map(|(line, key)| (Place::Line(line), key)), "{error}");
    assert_eq!(error.to_string().lines().count(), 12);
    assert_eq!(
        error.to_string().lines().nth(5).unwrap(),
        "f.yaml:13: qos_profiles.fast.reliability = RELYABLE: must be one of RELIABLE, BEST_EFFORT \
         (did you mean `RELIABLE`?)"
    );
}

/// The keys that the tables of the README document: those in back quotes in the first cell of a row.
fn documented_keys() -> BTreeSet<&'static str> {
    let environment = README.find("\n## Environment").unwrap();
    let rows = README[..environment].lines().filter(|line| line.starts_with("| `"));
    rows.flat_map(|row| row.split('|').nth(1).unwrap().split('`').skip(1).step_by(2)).collect()
}

#[test]
fn every_key_is_documented_and_every_documented_key_exists() {
    let known: BTreeSet<&str> = KEYS.iter().copied().collect();
    assert_eq!(known.len(), KEYS.len(), "a key is listed twice");
    assert_eq!(documented_keys(), known);
}

#[test]
fn the_tables_of_the_documentation_are_made_of_the_rows() {
    let environment = README.find("\n## Environment").unwrap();
    let tables: Vec<&str> = README[..environment].lines().filter(|line| line.starts_with("| `")).collect();
    let rows: Vec<String> = config::rows().map(Row::documented).collect();
    let missing: Vec<&str> = rows.iter().map(String::as_str).filter(|row| !tables.contains(row)).collect();
    assert!(missing.is_empty(), "config/README.md must have these rows:\n{}", missing.join("\n"));
    assert_eq!(tables.len(), rows.len(), "a row of config/README.md has no declaration");
}

#[test]
fn the_default_file_has_the_defaults_of_the_rows() {
    let text = block_default();
    let lines: Vec<&str> = text.lines().collect();
    let mut checked = 0;
    for key in default_keys(&text) {
        let Some(row) = config::rows().find(|row| row.paths.contains(&key.pattern.as_str())) else {
            continue;
        };
        let value = lines[key.line][key.column..].split('#').next().unwrap().trim();
        let default = row.default.trim_matches('`');
        let equal = match row.kind {
            Kind::Flag => default == value,
            Kind::Choice(names) if names().contains(&default) => default == value,
            Kind::Whole(..) | Kind::Decimal(..) => match default.parse::<f64>() {
                Ok(default) => value.parse::<f64>() == Ok(default),
                // The default depends on other keys.
                Err(_) => continue,
            },
            _ => continue,
        };
        // A lane or mode may have another default than most.
        let is_exception = key.path.starts_with("routing_policy.modes.");
        assert!(equal || value == "null" || is_exception, "{} is {value}, not {default}", key.path);
        checked += 1;
    }
    assert!(checked > 50, "{checked} keys");
}

#[test]
fn the_defaults_of_the_rows_are_those_of_the_policies() {
    let settings = settings(MINIMAL);
    assert_eq!(settings.classifier.thresholds, ClassifierThresholds::default());
    assert_eq!(settings.safety.rules, SafetyRules::default());
}

/// A key of `default.yaml`.
struct DefaultKey {
    /// Its path in the terms of [`KEYS`].
    pattern: String,
    /// Its path in the file.
    path: String,
    /// The index of its line.
    line: usize,
    /// Where its value begins in that line; the value may go on in deeper lines.
    column: usize,
}

/// The keys of `default.yaml` in block style, found without the loader.
fn default_keys(text: &str) -> Vec<DefaultKey> {
    let mut keys: Vec<DefaultKey> = Vec::new();
    // Indentation, pattern and path of the keys above.
    let mut above: Vec<(usize, String, String)> = Vec::new();
    for (line, content) in text.lines().enumerate() {
        let trimmed = content.trim_start();
        if trimmed.is_empty() || trimmed.starts_with('#') {
            continue;
        }
        let is_item = trimmed.starts_with("- ");
        let name_at = content.len() - trimmed.len() + if is_item { 2 } else { 0 };
        let (name, _) = content[name_at..].split_once(':').unwrap();
        above.retain(|(indent, ..)| *indent < name_at);
        let (parent, parent_path) =
            above.last().map_or(("", ""), |(_, pattern, path)| (pattern.as_str(), path.as_str()));
        let placeholder = match parent {
            "qos_profiles" => "<profile>",
            "topic_qos_profiles" => "<topic>",
            "subscribers" | "overrides" => "<subscriber>",
            "routing_policy.modes" => "<mode>",
            "lanes" | "topics[].outputs" | "topic_qos_profiles.<topic>" => "<lane>",
            "topics[].qos_overrides" if name != "input" => "<lane>",
            _ => name,
        };
        let join = |parent: &str, item: &str, name: &str| match parent {
            "" => name.to_owned(),
            "topics" => format!("topics{item}.{name}"),
            _ => format!("{parent}.{name}"),
        };
        let (pattern, path) = (join(parent, "[]", placeholder), join(parent_path, "[0]", name));
        above.push((name_at, pattern.clone(), path.clone()));
        keys.push(DefaultKey { pattern, path, line, column: name_at + name.len() + 1 });
    }
    keys
}

/// `default.yaml` with each mapping in block style.
fn block_default() -> String {
    let mut text = String::new();
    for line in DEFAULT.lines() {
        match line.split_once(": {") {
            Some((key, rest)) if !rest.starts_with('}') => {
                let indent = " ".repeat(key.len() - key.trim_start().len() + 2);
                text.push_str(&format!("{key}:\n"));
                for pair in rest.split('}').next().unwrap().split(", ") {
                    text.push_str(&format!("{indent}{pair}\n"));
                }
            }
            _ => text.push_str(&format!("{line}\n")),
        }
    }
    text
}

#[test]
fn every_key_is_in_the_default_file() {
    let text = block_default();
    assert_eq!(settings(&text), settings(DEFAULT));
    let keys = default_keys(&text);
    let found: BTreeSet<&str> = keys.iter().map(|key| key.pattern.as_str()).collect();
    let missing: Vec<_> = KEYS.iter().filter(|key| !found.contains(**key)).collect();
    assert!(missing.is_empty(), "{missing:?}");
}

#[test]
fn every_key_is_read() {
    // No key accepts a list of lists, so a key for which it is not reported is a key that no code reads.
    let text = block_default();
    let lines: Vec<&str> = text.lines().collect();
    let known: BTreeSet<&str> = KEYS.iter().copied().collect();
    let mut checked = 0;
    for key in default_keys(&text).iter().filter(|key| known.contains(key.pattern.as_str())) {
        let indent = |line: &str| line.len() - line.trim_start().len();
        let own = key.path.rsplit('.').next().unwrap();
        let own_indent = lines[key.line].find(own).unwrap();
        let mut changed: Vec<String> = lines[..key.line].iter().map(|line| (*line).to_owned()).collect();
        changed.push(format!("{} [[]]", &lines[key.line][..key.column]));
        let below = lines[key.line + 1..].iter();
        changed.extend(below.skip_while(|line| indent(line) > own_indent).map(|line| (*line).to_owned()));
        let error = parse(&changed.join("\n")).expect_err(&key.path);
        let found = error.problems.iter().find(|problem| problem.key.starts_with(&key.path));
        let found = found.unwrap_or_else(|| panic!("{}: {error}", key.path));
        assert_eq!(found.place, Place::Line(key.line + 1), "{}", key.path);
        checked += 1;
    }
    assert!(checked >= KEYS.len(), "{checked} keys");
}

#[test]
fn a_file_is_found_by_its_path_or_by_the_environment() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.yaml");
    fs::write(&path, MINIMAL).unwrap();
    let expected = settings(MINIMAL);
    assert_eq!(config::load(Some(&path), &no_env).unwrap(), expected);
    let named = path.display().to_string();
    let env = |name: &str| (name == "ADAPTIVE_BRIDGE_CONFIG").then(|| named.clone());
    assert_eq!(config::load(None, &env).unwrap(), expected);
    // The command line has priority over the environment.
    let missing = folder.path().join("b.yaml");
    let error = config::load(Some(&missing), &env).unwrap_err();
    assert_eq!(error.file, missing.display().to_string());
    assert!(error.to_string().contains("b.yaml: cannot be read: No such file"), "{error}");
}

#[test]
fn without_a_file_the_error_explains_how_to_give_one() {
    let default = Path::new(config::DEFAULT_PATH);
    if default.exists() {
        // On a machine with a file at the default path, that file is read.
        assert_eq!(config::load(None, &no_env), config::load(Some(default), &no_env));
        return;
    }
    let error = config::load(None, &no_env).unwrap_err().to_string();
    for part in [config::DEFAULT_PATH, "--config", "$ADAPTIVE_BRIDGE_CONFIG", "topics: [{id: scan"] {
        assert!(error.contains(part), "{error}");
    }
}

#[test]
fn anything_but_a_regular_file_is_refused_without_blocking() {
    let folder = tempfile::tempdir().unwrap();
    let pipe = folder.path().join("pipe");
    nix::unistd::mkfifo(&pipe, nix::sys::stat::Mode::S_IRWXU).unwrap();
    for path in [folder.path(), &pipe, Path::new("/dev/zero")] {
        let error = config::load(Some(path), &no_env).unwrap_err().to_string();
        assert_eq!(error, format!("{}: must be a regular file", path.display()));
    }
    let long = folder.path().join("long");
    fs::File::create(&long).unwrap().set_len(1 << 40).unwrap();
    let error = config::load(Some(&long), &no_env).unwrap_err().to_string();
    assert_eq!(error, format!("{}: must be at most 1048576 bytes long", long.display()));
}

/// Keys with two values each, in JSON, which is YAML. Both are allowed in combination with any other ones.
const CHOICES: &[(&str, &str, &str)] = &[
    ("instance", r#""robot""#, r#""robot_2""#),
    ("policy_hold_s", "5", "4.5"),
    ("ros.domain_id", "0", "7"),
    ("ros.networks", "[]", r#"["lo"]"#),
    ("ros.graph_gid_bytes", "16", "24"),
    ("ros.static_peers", "[]", r#"["10.0.0.7", "10.0.0.9"]"#),
    ("ros.namespace", r#""/robot1""#, r#""/""#),
    ("ros.node_name", r#""front""#, r#""rear_2""#),
    ("topics.0.input_topic", r#""/scan""#, r#""/scan_2""#),
    ("topics.1.input_topic", r#""/camera/**""#, r#""/camera/*""#),
    ("topics.1.exclude", "[]", r#"["/camera/*/depth"]"#),
    ("topics.1.max_routes", "2", "3"),
    ("topics.0.message_type", "null", r#""sensor_msgs/msg/LaserScan""#),
    ("topics.0.lanes", "null", r#"["critical", "noncritical"]"#),
    ("topics.0.outputs.critical", r#""/critical""#, r#""/critical_2""#),
    ("topics.0.max_sample_bytes", "1000", "2000"),
    ("topics.0.priority", "0", "5"),
    ("topics.0.retained_samples", "8", "9"),
    ("topics.0.qos_overrides.input.reliability", "null", r#""RELIABLE""#),
    ("topics.0.qos_overrides.input.history", "null", r#""KEEP_ALL""#),
    ("topics.0.qos_overrides.input.durability", "null", r#""VOLATILE""#),
    ("topics.0.qos_overrides.input.deadline_ms", "null", "100"),
    ("topics.0.qos_overrides.critical.reliability", r#""RELIABLE""#, r#""BEST_EFFORT""#),
    ("topics.0.qos_overrides.critical.depth", "10", "11"),
    ("topics.0.qos_overrides.critical.durability", r#""VOLATILE""#, r#""TRANSIENT_LOCAL""#),
    ("topics.0.qos_overrides.critical.lifespan_ms", "null", "100"),
    ("topics.0.qos_overrides.critical.deadline_ms", "null", "100"),
    ("lanes.rviz.domain_id", "0", "9"),
    ("lanes.rviz.dscp", "0", "34"),
    ("lanes.rviz.static_peers", "[]", r#"["10.0.0.7"]"#),
    ("lanes.rviz.networks", "[]", r#"["192.168.0.7"]"#),
    ("lanes.rviz.queue_depth", "16", "17"),
    ("lanes.rviz.max_borrowed", "8", "9"),
    ("lanes.rviz.by_reference_min_bytes", "65536", "0"),
    ("lanes.rviz.window_samples", "null", "255"),
    ("lanes.rviz.scheduling.nice", "10", "19"),
    ("lanes.rviz.scheduling.slice_ms", "10", "5"),
    ("lanes.rviz.scheduling.cpus", "[]", "[1]"),
    ("lanes.rviz.scheduling.lock_memory", "false", "true"),
    ("lanes.noncritical.max_rate_hz", "10", "20"),
    ("lanes.noncritical.degraded_rate_hz", "3", "2"),
    ("lanes.noncritical.max_bytes_per_s", "null", "1000000"),
    ("lanes.noncritical.degraded_max_bytes_per_s", "200000", "100000"),
    ("lanes.noncritical.stale_threshold_ms", "200", "100"),
    ("lanes.noncritical.degraded_stale_threshold_ms", "200", "0"),
    ("lanes.noncritical.drop_policy", r#""drop_oldest""#, r#""drop_stale""#),
    ("lanes.noncritical.queue_samples", "5", "6"),
    ("shared_memory.root_path", "null", r#""/run/elsewhere""#),
    ("shared_memory.budget_bytes", "268435456", "536870912"),
    ("shared_memory.max_taps", "2", "3"),
    ("lanes.critical.standby", r#""warm""#, r#""none""#),
    ("processes.ingress.standby", r#""warm""#, r#""none""#),
    ("processes.ingress.scheduling.nice", "0", "1"),
    ("processes.ingress.scheduling.cpus", "[]", "[1]"),
    ("processes.control.scheduling.lock_memory", "false", "true"),
    ("classifier.enabled", "true", "false"),
    ("classifier.subscriber_id", r#""""#, r#""laptop""#),
    ("classifier.evaluate_rate_hz", "2", "3"),
    ("classifier.demote_loss_threshold", "0.015", "0.02"),
    ("classifier.promote_loss_threshold", "0.005", "0.004"),
    ("classifier.demote_rtt_ms", "50", "60"),
    ("classifier.promote_rtt_ms", "35", "30"),
    ("classifier.hysteresis_count", "3", "4"),
    ("classifier.allow_unknown_state", "true", "false"),
    ("probes.enabled", "true", "false"),
    ("probes.rate_hz", "5", "6"),
    ("probes.rtt_threshold_ms", "100", "90"),
    ("probes.loss_threshold", "0.05", "0.04"),
    ("probes.jitter_threshold_ms", "25", "24"),
    ("probes.window_size", "50", "40"),
    ("probes.hysteresis_count", "3", "4"),
    ("probes.timeout_ms", "500", "400"),
    ("probes.request_topic", r#""/request""#, r#""/request_2""#),
    ("probes.response_topic", r#""/response""#, r#""/response_2""#),
    ("subscribers.laptop", r#""noncritical""#, r#""rviz""#),
    ("overrides.laptop", "null", r#""CRITICAL""#),
    ("safety.preserve_critical_path", "true", "false"),
    ("safety.allow_noncritical_degrade", "true", "false"),
    ("safety.max_noncritical_queue", "50", "40"),
    ("safety.overload_drop_noncritical_first", "true", "false"),
    ("safety.evaluate_rate_hz", "2", "3"),
    ("safety.degraded_lag_ms", "50", "60"),
    ("safety.emergency_lag_ms", "500", "600"),
    ("safety.degraded_queue_occupancy", "0.5", "0.6"),
    ("safety.emergency_queue_occupancy", "0.9", "0.8"),
    ("safety.degraded_errors_per_s", "1", "2"),
    ("safety.emergency_errors_per_s", "10", "20"),
    ("safety.silent_ms", "1000", "2000"),
    ("safety.emergency_silent_ms", "5000", "6000"),
    ("safety.hysteresis_count", "3", "4"),
    ("safety.recovery_count", "6", "7"),
    ("security.trust_mode", r#""default_deny""#, r#""off""#),
    ("security.allow_legacy_node_name_overrides", "true", "false"),
    ("security.enable_probe_hmac", "false", "true"),
    ("security.max_probe_rate_hz", "20", "19"),
    ("security.hmac_secret_file", "null", r#""/etc/secret""#),
    ("security.replay_window_ms", "30000", "20000"),
    ("diagnostics.enabled", "true", "false"),
    ("diagnostics.publish_interval_s", "1", "0.5"),
    ("diagnostics.topic", r#""/diagnostics""#, r#""/diagnostics_2""#),
    ("diagnostics.verbosity", r#""info""#, r#""debug""#),
    ("diagnostics.metrics", "null", r#""127.0.0.1:9464""#),
];

/// The settings in which each key has its first value, or its second where `second` is true.
fn chosen(second: impl Fn(usize) -> bool) -> Settings {
    let mut file = serde_json::json!({"topics": [{"id": "scan"}, {"id": "camera"}]});
    for (index, (key, first, other)) in CHOICES.iter().enumerate() {
        let place = key.split('.').fold(&mut file, |node, name| match name.parse::<usize>() {
            Ok(item) => &mut node[item],
            Err(_) => &mut node[name],
        });
        *place = serde_json::from_str(if second(index) { other } else { first }).unwrap();
    }
    settings(&file.to_string())
}

/// The keys of the README that have the sign for "without a restart".
fn marked_keys() -> BTreeSet<&'static str> {
    let rows = README.lines().filter(|line| line.starts_with("| `"));
    let first_cells = rows.filter_map(|row| row.split('|').nth(1)).filter(|cell| cell.contains('↻'));
    first_cells.flat_map(|cell| cell.split('`').skip(1).step_by(2)).collect()
}

/// A key of a change in the terms of [`KEYS`].
fn pattern(key: &str) -> String {
    let key = key.trim_end_matches(" in DEGRADED");
    match key.split('.').collect::<Vec<_>>().as_slice() {
        ["lanes", _, rest @ ..] => format!("lanes.<lane>.{}", rest.join(".")),
        [of @ ("subscribers" | "overrides"), _] => format!("{of}.<subscriber>"),
        _ => key.to_owned(),
    }
}

#[test]
fn exactly_the_keys_documented_as_reloadable_change_without_a_restart() {
    let (_, reload) = chosen(|_| false).reloaded(chosen(|_| true));
    let changed: BTreeSet<String> = reload.changed.iter().map(|change| pattern(&change.key)).collect();
    // Changes of these are reported under other keys: the lanes' rates, the secret.
    let reported_elsewhere = |key: &&str| {
        key.starts_with("routing_policy.")
            || ["subscribers.<subscriber>.lane", "security.hmac_secret_file", "security.hmac_secret_env"]
                .contains(key)
    };
    let marked: BTreeSet<String> =
        marked_keys().into_iter().filter(|key| !reported_elsewhere(key)).map(str::to_owned).collect();
    assert_eq!(changed, marked);
    for left in &reload.waits {
        assert!(!marked.contains(&pattern(&left.key)), "{left}");
    }
    for (index, (key, ..)) in CHOICES.iter().enumerate() {
        let (_, reload) = chosen(|_| false).reloaded(chosen(|other| other == index));
        assert_ne!(reload, config::Reload::default(), "a change of {key} is reported");
    }
}

#[test]
fn each_change_is_reported_with_key_and_values_of_the_file() {
    let (_, reload) = chosen(|_| false).reloaded(chosen(|_| true));
    let mut reported: Vec<String> = reload.changed.iter().map(ToString::to_string).collect();
    reported.extend(reload.waits.iter().map(ToString::to_string));
    for expected in [
        "policy_hold_s: 5 -> 4.5",
        "lanes.noncritical.max_rate_hz: 10 -> 20",
        "lanes.noncritical.max_bytes_per_s: none -> 1000000",
        "lanes.noncritical.drop_policy: drop_oldest -> drop_stale",
        "lanes.noncritical.drop_policy in DEGRADED: drop_oldest -> drop_stale",
        "security.trust_mode: default_deny -> off",
        "security.hmac_secret: none -> the file /etc/secret",
        "subscribers.laptop: noncritical -> rviz",
        "overrides.laptop: none -> CRITICAL",
        "ros.networks: [] -> [lo]",
        "topics[scan].lanes.rviz: true -> false",
        "topics[scan].qos_overrides.input.history: none -> KEEP_ALL",
        "topics[scan].qos_overrides.critical.history: KEEP_LAST 10 -> KEEP_LAST 11",
        "lanes.rviz.domain_id: 0 -> 9",
        "lanes.rviz.scheduling.slice_ms: 10 -> 5",
        "diagnostics.metrics: none -> 127.0.0.1:9464",
    ] {
        assert!(
            reported.iter().any(|line| line == expected),
            "{expected} is not in:\n{}",
            reported.join("\n")
        );
    }
}

#[test]
fn an_added_or_removed_lane_and_a_subscriber_on_it_need_a_restart() {
    let base = "topics: [{id: scan, input_topic: /scan}]\n";
    let old = settings(&format!("{base}lanes: {{old: {{}}}}\nsubscribers: {{a: old, b: critical}}"));
    let new =
        settings(&format!("{base}lanes: {{new: {{}}}}\nsubscribers: {{a: new, b: noncritical, c: new}}"));
    let (reloaded, reload) = old.reloaded(new);
    assert_eq!(reloaded.lanes, old.lanes);
    let subscribers: Vec<_> = reloaded.subscribers.iter().map(|(id, lane)| format!("{id} {lane}")).collect();
    assert_eq!(subscribers, ["a old", "b noncritical"]);
    let left: Vec<String> = reload.waits.iter().map(ToString::to_string).collect();
    assert_eq!(
        left,
        [
            "lanes: [critical, noncritical, old] -> [critical, noncritical, new]",
            "subscribers.a: old -> new",
            "subscribers.c: none -> new",
        ]
    );
    assert_eq!(reload.changed.len(), 1, "{reload:?}");
}

#[test]
fn a_longer_queue_is_reloaded_only_if_shared_memory_has_room_for_it() {
    let with = |samples: usize| {
        settings(&format!(
            "topics: [{{id: scan, input_topic: /scan}}]\n\
             lanes: {{noncritical: {{queue_samples: {samples}, max_rate_hz: {samples}}}}}"
        ))
    };
    let rates = |settings: &Settings| match &settings.lanes[1].forwarding {
        Forwarding::Limited(rates) => rates.normal,
        Forwarding::Everything => panic!("{:?}", settings.lanes[1]),
    };
    let (reloaded, reload) = with(5).reloaded(with(6));
    assert_eq!((rates(&reloaded).queue_samples, reload.waits.len()), (6, 0));
    for (old, new) in [(5, 50), (50, 5)] {
        let (reloaded, reload) = with(old).reloaded(with(new));
        assert_eq!((rates(&reloaded).queue_samples, rates(&reloaded).max_rate_hz), (old, new as f64));
        let left: Vec<String> = reload.waits.iter().map(ToString::to_string).collect();
        let expected = format!("lanes.noncritical.queue_samples: {old} -> {new}");
        assert_eq!(left[0], expected);
    }
}

#[test]
fn a_noncritical_lane_holds_its_queue_and_two_samples_more_in_shared_memory() {
    let held = |lane: usize, queue_samples: usize| {
        let lanes = format!("lanes: {{noncritical: {{queue_samples: {queue_samples}}}}}");
        settings(&format!("topics: [{{id: scan, input_topic: /scan}}]\n{lanes}")).lanes[lane]
            .max_borrowed_in_all()
    };
    // At least `max_borrowed`, which is 8; of a critical lane only that.
    assert_eq!([5, 7, 50].map(|queue_samples| held(1, queue_samples)), [8, 9, 52]);
    assert_eq!(held(0, 50), 8);
}

#[test]
fn the_parameter_config_path_names_the_file_unless_it_is_empty() {
    let folder = tempfile::tempdir().unwrap();
    let [of_environment, of_parameter] = ["environment", "parameter"].map(|id| {
        let path = folder.path().join(id).display().to_string();
        fs::write(&path, format!("topics: [{{id: {id}, input_topic: /scan}}]\n")).unwrap();
        path
    });
    let env = |name: &str| (name == config::PATH_VARIABLE).then(|| of_environment.clone());
    for (config_path, expected) in [(of_parameter.as_str(), "parameter"), ("''", "environment")] {
        let parameters = [format!("config_path:={config_path}").parse().unwrap()];
        let loaded = config::load_configuration(None, &parameters, &env).unwrap();
        assert_eq!(loaded.settings.routes[0].id.as_str(), expected);
    }
}

#[test]
fn aliases_of_aliases_within_the_limit_of_keys_and_values_are_read() {
    // 11,110 aliases if written out; without a limit of its own, the YAML library refuses 100 for each value.
    let mut text = String::from("a0: &a0 x\n");
    for level in 1..=4 {
        let aliases = vec![format!("*a{}", level - 1); 10].join(", ");
        text.push_str(&format!("a{level}: &a{level} [{aliases}]\n"));
    }
    let error = parse(&text).unwrap_err().to_string();
    assert!(error.contains("f.yaml:5: a4: must be a known key"), "{error}");
    // It also refuses more than 100 aliases of one value.
    let error = parse(&format!("a: &a x\nb: [{}]\n", ["*a"; 200].join(", "))).unwrap_err().to_string();
    assert!(error.contains("f.yaml:2: b: must be a known key"), "{error}");
}

#[test]
fn a_file_may_be_nested_as_deep_as_the_limit_and_not_deeper() {
    // The file itself is a mapping.
    let error =
        |lists: usize| parse(&format!("a: {}{}\n", "[".repeat(lists), "]".repeat(lists))).unwrap_err();
    assert!(error(31).to_string().contains("f.yaml:1: a: must be a known key"), "{}", error(31));
    assert_eq!(error(32).to_string(), "f.yaml:1: must be nested at most 32 deep");
}

#[test]
fn a_depth_that_differs_only_for_latched_topics_is_reported_as_the_depth() {
    let with = |depth: &str| {
        settings(&format!(
            "topics: [{{id: scan, input_topic: /scan, qos_overrides: {{critical: {{depth: {depth}}}}}}}]"
        ))
    };
    // Without a depth it is 10, and 1 for an output that follows TRANSIENT_LOCAL publishers.
    for (depth, expected) in
        [("10", "depth: KEEP_LAST 1 -> KEEP_LAST 10"), ("11", "history: KEEP_LAST 10 -> KEEP_LAST 11")]
    {
        let (_, reload) = with("null").reloaded(with(depth));
        let changes = reload.waits.iter().map(ToString::to_string);
        let of_qos: Vec<_> = changes.filter(|change| change.contains(".qos_overrides.")).collect();
        assert_eq!(of_qos, [format!("topics[scan].qos_overrides.critical.{expected}")]);
    }
}

#[test]
fn a_lane_without_a_route_is_not_used() {
    let settings = settings("topics: [{id: scan, input_topic: /scan, lanes: [critical]}]");
    assert_eq!(settings.lanes.iter().map(config::Lane::is_used).collect::<Vec<_>>(), [true, false]);
}

#[test]
fn as_many_topics_as_allowed_are_accepted() {
    let topics: String =
        (0..1_024).map(|number| format!("- {{id: t{number}, input_topic: /t{number}}}\n")).collect();
    assert_eq!(settings(&format!("topics:\n{topics}")).routes.len(), 1_024);
}

/// Pieces that YAML is made of, and pieces of configurations, with `;` between them.
const PIECES: &str = concat!(
    "\n;\n  ;\n    ;- ;: ;:;, ;[;];{;};\";';|\n;>-\n;&a ;*a;!!str ;!x ;#;",
    "? ;---\n;...\n;%YAML 1.2\n;<<: *a;\t;\r\n;~;",
    "null;true;yes;-1;0;1e999;.nan;.inf;18446744073709551616;/a;\0;\u{feff};\u{85};é;topics;id;input_topic;",
    "lanes;qos_profiles;noncritical;critical;qos;depth;overrides",
);

fn piece() -> impl Strategy<Value = String> {
    let words = PIECES.split(';').collect::<Vec<_>>();
    let any = any::<char>().prop_map(String::from);
    prop_oneof![8 => prop::sample::select(words).prop_map(str::to_owned), 1 => any]
}

/// `default.yaml` with some of its lines removed, doubled, swapped, or overwritten in part.
fn mutated_default() -> impl Strategy<Value = String> {
    let change = (any::<prop::sample::Index>(), 0..5u8, any::<prop::sample::Index>(), piece());
    prop::collection::vec(change, 1..12).prop_map(|changes| {
        let mut lines: Vec<String> = DEFAULT.lines().map(str::to_owned).collect();
        for (at, kind, other, piece) in changes {
            let at = at.index(lines.len());
            let other = other.index(lines.len());
            match kind {
                0 if lines.len() > 1 => drop(lines.remove(at)),
                1 => lines.insert(at, lines[other].clone()),
                2 => lines.swap(at, other),
                3 => lines[at].push_str(&piece),
                _ => {
                    let (key, _) = lines[at].split_once(':').unwrap_or((&lines[at], ""));
                    lines[at] = format!("{key}: {piece}");
                }
            }
        }
        lines.join("\n")
    })
}

/// Reads the text twice, and checks what holds for every outcome.
fn check_any(text: &[u8]) -> Result<(), TestCaseError> {
    let outcome = config::parse(text, "f.yaml", &no_env);
    prop_assert_eq!(&outcome, &config::parse(text, "f.yaml", &no_env));
    if let Err(error) = outcome {
        prop_assert!(!error.problems.is_empty());
        let printed = error.to_string();
        prop_assert_eq!(printed.lines().count(), error.problems.len(), "{}", &printed);
        let last = text.iter().filter(|&&byte| matches!(byte, b'\n' | b'\r')).count() + 1;
        for problem in &error.problems {
            if let Place::Line(line) = problem.place {
                prop_assert!((1..=last).contains(&line), "line {} of {}: {}", line, last, &printed);
            }
        }
    }
    Ok(())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2_000, ..ProptestConfig::default() })]

    #[test]
    fn no_text_made_of_yaml_makes_the_loader_panic(pieces in prop::collection::vec(piece(), 0..60)) {
        check_any(pieces.concat().as_bytes())?;
    }

    #[test]
    fn no_bytes_make_the_loader_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        check_any(&bytes)?;
    }

    #[test]
    fn no_mutation_of_the_default_file_makes_the_loader_panic(text in mutated_default()) {
        check_any(text.as_bytes())?;
    }
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, ..ProptestConfig::default() })]

    #[test]
    fn a_reload_applies_every_reloadable_key_and_keeps_the_others(
        choices in prop::collection::vec(any::<(bool, bool)>(), CHOICES.len()),
    ) {
        let old = chosen(|index| choices[index].0);
        let new = chosen(|index| choices[index].1);
        let (reloaded, reload) = old.reloaded(new.clone());
        prop_assert_eq!(reload.changed.is_empty() && reload.waits.is_empty(), old == new);
        prop_assert_eq!(reload.waits.is_empty(), reloaded == new);
        prop_assert_eq!(reload.changed.is_empty(), reloaded == old);
        prop_assert_eq!(reloaded.fingerprint() == new.fingerprint(), reloaded == new);

        // A second reload of the same file applies nothing more, and the same changes wait.
        let (again, second) = reloaded.reloaded(new);
        prop_assert_eq!(&again, &reloaded);
        prop_assert_eq!(second.changed, Vec::new());
        prop_assert_eq!(second.waits, reload.waits);

        // A reload of the first file restores the first settings: settings that wait were not changed.
        let (back, third) = reloaded.reloaded(old.clone());
        prop_assert_eq!(back, old);
        prop_assert_eq!(third.waits, Vec::new());
    }

    #[test]
    fn the_configuration_in_force_is_read_back_exactly(
        choices in prop::collection::vec(any::<(bool, bool, bool)>(), CHOICES.len()),
        secret in "[ -~é\\n]{0,40}",
    ) {
        let start: config::Configuration = chosen(|index| choices[index].0).into();
        let (once, _) = start.reloaded(chosen(|index| choices[index].1).into());
        let (twice, _) = once.reloaded(chosen(|index| choices[index].2).into());
        for in_force in [start, once, twice] {
            let bytes = in_force.encode().unwrap();
            let read = config::Configuration::decode(&bytes).unwrap();
            prop_assert_eq!(read.settings.fingerprint(), in_force.settings.fingerprint());
            prop_assert_eq!(read, in_force);
        }
        let file = tempfile::NamedTempFile::new().unwrap();
        let quoted = serde_json::to_string(&secret).unwrap();
        let text = format!("topics: [{{id: scan, input_topic: /scan}}]\nsecurity: {{hmac_secret: {quoted}}}\n");
        std::fs::write(file.path(), text).unwrap();
        let loaded = config::load_configuration(Some(file.path()), &[], &no_env).unwrap();
        let shown = format!("{loaded:?}");
        prop_assert!(secret.len() < 8 || !shown.contains(&secret));
        let read = config::Configuration::decode(&loaded.encode().unwrap()).unwrap();
        prop_assert_eq!(&read, &loaded);
        let held = read.inline_secret.map(|held| held.reveal().to_owned()).unwrap_or_default();
        prop_assert_eq!(held, secret);
    }

    #[test]
    fn any_rate_and_threshold_is_read_back_exactly(rate in 0.1f64..1000.0, loss in 0.0f64..0.01) {
        let text = format!(
            "topics: [{{id: scan, input_topic: /scan}}]\n\
             lanes: {{noncritical: {{max_rate_hz: {rate}}}}}\nclassifier: {{promote_loss_threshold: {loss}}}\n"
        );
        let in_force: config::Configuration = settings(&text).into();
        prop_assert_eq!(config::Configuration::decode(&in_force.encode().unwrap()).unwrap(), in_force);
    }

    #[test]
    fn a_damaged_stored_configuration_is_an_error(cut in any::<prop::sample::Index>(), byte in any::<u8>()) {
        let mut bytes = config::Configuration::from(chosen(|_| true)).encode().unwrap();
        let at = cut.index(bytes.len());
        let whole = config::Configuration::decode(&bytes).unwrap();
        prop_assert!(config::Configuration::decode(&bytes[..at]).is_err());
        bytes[at] = byte;
        // A damaged secret is not detectable from the settings; they have their fingerprint.
        if let Ok(read) = config::Configuration::decode(&bytes) {
            prop_assert_eq!(read.settings, whole.settings);
        }
    }
}

/// Loads a file with parameters.
fn load_with(file: &str, parameters: &[&str]) -> Result<Settings, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bridge.yaml");
    std::fs::write(&path, file).unwrap();
    let parameters: Vec<Parameters> = parameters.iter().map(|text| text.parse().unwrap()).collect();
    let loaded = config::load_configuration(Some(&path), &parameters, &no_env);
    let folder = folder.path().display().to_string();
    loaded.map(|loaded| loaded.settings).map_err(|error| error.to_string().replace(&folder, ""))
}

#[test]
fn parameters_replace_values_of_the_file() {
    let file = "topics: [{id: scan, input_topic: /scan}]\nprobes: {rate_hz: 2, timeout_ms: 300}\n";
    let parameters =
        ["probes.rate_hz:=4", "safety.silent_ms:=2500", "ros.namespace:='/r1'", "probes.rate_hz:=3"];
    let settings = load_with(file, &parameters).unwrap();
    assert_eq!((settings.probes.rate_hz, settings.probes.timeout_ms), (3.0, 300));
    assert_eq!(settings.node_namespace, "/r1");
    assert_eq!(settings.node_name_of("ingress"), "ingress");
    let named = load_with(file, &["ros.node_name:='front'"]).unwrap();
    assert_eq!(named.node_namespace, "/adaptive_bridge");
    assert_eq!(named.node_name_of("egress_rviz"), "front_egress_rviz");
    assert_eq!(load_with(file, &["use_sim_time:=true"]), load_with(file, &[]));
    // A section of the file that has no value is one without keys.
    assert_eq!(
        load_with("topics: [{id: scan, input_topic: /scan}]\nprobes:\n", &["probes.rate_hz:=4"])
            .unwrap()
            .probes
            .rate_hz,
        4.0
    );
    let deep = format!("{}a:=1", "a.".repeat(400_000));
    assert!(load_with(file, &[&deep]).is_err());
    let replaced = load_with(file, &["topics:=[{id: b, input_topic: /b}]"]).unwrap();
    assert_eq!(replaced.routes[0].id.as_str(), "b");
}

#[test]
fn a_wrong_parameter_is_reported_with_its_key_and_value() {
    let file = "topics: [{id: scan, input_topic: /scan}]\nprobes: {rate_hz: 2}\n";
    for (parameters, expected) in [
        (&["probes.rate_hz:=often"][..], "parameter: probes.rate_hz = often: must be a number"),
        (&["probes.rate:=4"], "parameter: probes.rate: must be a known key: enabled, rate_hz"),
        (&["probes.rate_hz:=[4"], "parameter: probes.rate_hz: not YAML: "),
        (&["ros.namespace:=robot1"], "parameter: ros.namespace = robot1: must be an absolute namespace"),
        (&["ros.node_name:='2d'"], "parameter: ros.node_name = \"2d\": must be a ROS 2 node name"),
        (&["probes:=4"], "parameter: probes = 4: must be a mapping"),
        (
            &["probes:={rate_hz: 1, rate_hz: 2}"],
            "parameter: probes.rate_hz: must be given only once; a parameter",
        ),
        (&["topics.id:=a"], "parameter: topics.id: must begin with `topics.` and the id of a topic"),
        (&["topics.scan:=a"], "parameter: topics.scan: must begin with `topics.` and the id of a topic"),
        (&["topics.scan.priority:=a"], "parameter: topics[0].priority = a: must be a whole number"),
        (&["topics.scan:={priority: 100}"], "parameter: topics[0].priority = 100: must be a whole number"),
        (&["a.b.c.d.e.f.g.h.i.j:=4"], "parameter: a.b.c: must be a known key"),
        (&["/no/such/file.yaml"], "/no/such/file.yaml: cannot be read"),
    ] {
        let error = load_with(file, parameters).unwrap_err();
        assert!(error.starts_with(expected), "{error}");
    }
}

#[test]
fn a_file_of_parameters_applies_to_the_nodes_that_it_names() {
    let folder = tempfile::tempdir().unwrap();
    let bridge = folder.path().join("other.yaml");
    std::fs::write(&bridge, "topics: [{id: other, input_topic: /other}]\n").unwrap();
    let path = folder.path().join("params.yaml");
    let load = |text: &str, more: &[&str]| {
        std::fs::write(&path, text).unwrap();
        let mut parameters: Vec<Parameters> = more.iter().map(|text| text.parse().unwrap()).collect();
        parameters.push(Parameters::File(path.clone()));
        let loaded = config::load_configuration(None, &parameters, &|name| {
            (name == config::PATH_VARIABLE).then(|| bridge.display().to_string())
        });
        loaded.map(|loaded| loaded.settings).map_err(|error| error.to_string())
    };
    let file = "/**:\n  ros__parameters: {use_sim_time: true, probes: {rate_hz: 3}}\n\
                /adaptive_bridge:\n  ros__parameters: {probes.timeout_ms: 250}\n\
                amcl:\n  ros__parameters: {alpha1: 0.2}\n";
    let settings = load(file, &[]).unwrap();
    assert_eq!((settings.probes.rate_hz, settings.probes.timeout_ms), (3.0, 250));

    // A later section replaces values of an earlier one.
    for (first, second) in [("/**", "/adaptive_bridge"), ("/adaptive_bridge", "/**")] {
        let section =
            |node, rate_hz| format!("{node}: {{ros__parameters: {{probes: {{rate_hz: {rate_hz}}}}}}}\n");
        let file = section(first, 3) + &section(second, 5);
        assert_eq!(load(&file, &[]).unwrap().probes.rate_hz, 5.0, "{file}");
    }

    // The forms in which rcl takes the name of a node.
    for (node, applies) in [
        ("/*/front", true),
        ("/r1/front", true),
        ("/r1/**", true),
        ("/**/front", true),
        ("/*", false),
        ("/r2/front", false),
        ("front", false),
    ] {
        let file = format!("{node}: {{ros__parameters: {{probes.rate_hz: 3}}}}\n");
        let named = ["ros.node_name:='front'", "ros.namespace:='/r1'"];
        let rate_hz = load(&file, &named).unwrap().probes.rate_hz;
        assert_eq!(rate_hz == 3.0, applies, "{node}");
    }
    let nested = "r1:\n  front: {ros__parameters: {probes: {rate_hz: 3}}}\n";
    assert_eq!(
        load(nested, &["ros.node_name:='front'", "ros.namespace:='/r1'"]).unwrap().probes.rate_hz,
        3.0
    );
    let root = "/front: {ros__parameters: {probes: {rate_hz: 3}}}\n";
    assert_eq!(load(root, &["ros.node_name:='front'", "ros.namespace:='/'"]).unwrap().probes.rate_hz, 3.0);

    // As a launch file's `Node` with a name and `parameters` writes it.
    let file = format!(
        "/r1/adaptive_bridge_proxy: {{ros__parameters: {{config_path: {}}}}}\n/adaptive_bridge: {{}}\n",
        bridge.display()
    );
    let renamed = ["ros.node_name:='adaptive_bridge_proxy'", "ros.namespace:='/r1'"];
    assert_eq!(load(&file, &renamed).unwrap().routes[0].id.as_str(), "other");

    for (text, expected) in [
        ("/**: {ros__parameters: {probes: {rate_hz: x}}}", ":1: probes.rate_hz = x: must be a number"),
        ("\nadaptive_bridge:\n  ros__parameters:\n    prob: 1", ":4: prob: must be a known key"),
        ("/**: {probes: {rate_hz: 4}}", ":1: must have the form `NODE: {ros__parameters: {KEY: VALUE}}`"),
        ("/**: {ros__parameters: 4}", ":1: must be a mapping of parameters"),
        ("[1]", ":1: must have the form"),
        ("a: {", ":1: not YAML: "),
    ] {
        let error = load(text, &[]).unwrap_err();
        let expected = format!("{}{expected}", path.display());
        assert!(error.starts_with(&expected), "{error}\n{expected}");
    }
}
