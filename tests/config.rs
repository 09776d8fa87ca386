//! The configuration from outside: the files that are shipped, the documentation, and files of any content.
//! Pure but for the tests of `load`, which read real files.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

use adaptive_bridge::config::{
    self, Classifier, ClassifierThresholds, ConfigError, Diagnostics, DropPolicy, KEYS, LaneRates, Place,
    Probes, RatePolicy, Safety, SafetyRules, Security, Settings, TrustMode, Verbosity,
};
use adaptive_bridge::model::{QosProfile, TopicName, TypeName};
use proptest::prelude::*;

const DEFAULT: &str = include_str!("../config/default.yaml");
const MINIMAL: &str = include_str!("../config/minimal.yaml");
const README: &str = include_str!("../config/README.md");

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
fn the_default_file_says_what_the_minimal_file_means() {
    assert_eq!(settings(DEFAULT), settings(MINIMAL));
}

/// What all three files of the original package have in common.
fn check_common_original(settings: &Settings) {
    let [route] = settings.routes.as_slice() else { panic!("{:?}", settings.routes) };
    assert_eq!((route.id.as_str(), route.input_topic.as_str()), ("scan_main", "/scan"));
    assert_eq!(route.message_type, Some(TypeName::try_from("sensor_msgs/msg/LaserScan").unwrap()));
    let [critical, noncritical] = settings.lanes.as_slice() else { panic!("{:?}", settings.lanes) };
    assert_eq!(critical.outputs.len() + noncritical.outputs.len(), 2);
    assert_eq!(critical.outputs[0].topic, topic("/adaptive_bridge/critical/scan"));
    assert_eq!(critical.outputs[0].qos, QosProfile::CRITICAL);
    assert_eq!(noncritical.outputs[0].topic, topic("/adaptive_bridge/noncritical/scan"));
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
    let settings = settings(include_str!("fixtures/config/original_default.yaml"));
    check_common_original(&settings);
    let lane = &settings.lanes[1];
    assert_eq!(lane.outputs[0].qos, QosProfile { lifespan_ms: Some(500), ..QosProfile::NONCRITICAL });
    let normal = policy(10.0, 5, DropPolicy::DropOldest, 500);
    let degraded = policy(3.0, 2, DropPolicy::DropStale, 250);
    assert_eq!(lane.rates, LaneRates { normal, degraded });
    assert_eq!(settings.classifier, original_classifier());
    assert_eq!(settings.probes, original_probes());
    assert_eq!(settings.safety, original_safety(50));
    assert_eq!(settings.security, original_security());
    assert_eq!(settings.diagnostics, original_diagnostics());
}

#[test]
fn the_originals_minimal_file_keeps_its_meaning() {
    let settings = settings(include_str!("fixtures/config/original_minimal.yaml"));
    check_common_original(&settings);
    let lane = &settings.lanes[1];
    assert_eq!(lane.outputs[0].qos, QosProfile::NONCRITICAL);
    let normal = policy(5.0, 3, DropPolicy::DropOldest, 600);
    let degraded = policy(1.0, 1, DropPolicy::DropStale, 300);
    assert_eq!(lane.rates, LaneRates { normal, degraded });
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
    let settings = settings(include_str!("fixtures/config/original_stress.yaml"));
    check_common_original(&settings);
    let lane = &settings.lanes[1];
    assert_eq!(lane.outputs[0].qos, QosProfile { lifespan_ms: Some(500), ..QosProfile::NONCRITICAL });
    let normal = policy(3.0, 3, DropPolicy::DropStale, 300);
    let degraded = policy(1.0, 1, DropPolicy::DropStale, 150);
    assert_eq!(lane.rates, LaneRates { normal, degraded });
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
    let error = parse(include_str!("fixtures/config/twelve_mistakes.yaml")).unwrap_err();
    let found: Vec<(Place, &str)> =
        error.problems().iter().map(|problem| (problem.place, problem.key.as_str())).collect();
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

/// The keys that the tables of the README document: all that stand in back quotes in the first cell of a row.
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
    // A list of lists is no value of any key, so that a key that lets it pass is a key that nothing reads.
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
        let found = error.problems().iter().find(|problem| problem.key.starts_with(&key.path));
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
    // The command line goes before the environment.
    let missing = folder.path().join("b.yaml");
    let error = config::load(Some(&missing), &env).unwrap_err();
    assert_eq!(error.file(), missing.display().to_string());
    assert!(error.to_string().contains("b.yaml: cannot be read: No such file"), "{error}");
}

#[test]
fn without_any_file_the_error_says_what_to_do() {
    let default = Path::new(config::DEFAULT_PATH);
    if default.exists() {
        // A machine that has a configuration of its own reads that one.
        assert_eq!(config::load(None, &no_env), config::load(Some(default), &no_env));
        return;
    }
    let error = config::load(None, &no_env).unwrap_err().to_string();
    for part in [config::DEFAULT_PATH, "--config", "$ADAPTIVE_BRIDGE_CONFIG", "topics: [{id: scan"] {
        assert!(error.contains(part), "{error}");
    }
}

#[test]
fn what_is_no_ordinary_file_is_refused_and_never_waited_for() {
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
        prop_assert!(!error.problems().is_empty());
        let printed = error.to_string();
        prop_assert_eq!(printed.lines().count(), error.problems().len(), "{}", &printed);
        let last = text.iter().filter(|&&byte| matches!(byte, b'\n' | b'\r')).count() + 1;
        for problem in error.problems() {
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
