//! Tests of the loader for each key: the values that it accepts and the messages that it reports.

use std::fmt::Write;
use std::net::Ipv4Addr;

use super::*;
use crate::model::{Durability, History, LaneName, QosProfile, Reliability, SubscriberState};

/// A file with one topic, in line 1.
const TOPIC: &str = "topics: [{id: scan, input_topic: /scan}]\n";

fn no_env(_: &str) -> Option<String> {
    None
}

fn settings(text: &str) -> Settings {
    parse(text, "f.yaml", &no_env).unwrap_or_else(|error| panic!("{text}\n{error}"))
}

/// The settings of [`TOPIC`] and `text`.
fn with(text: &str) -> Settings {
    settings(&format!("{TOPIC}{text}"))
}

fn messages(text: &str) -> Vec<String> {
    messages_in(text, &no_env)
}

fn messages_in(text: &str, env: &dyn Fn(&str) -> Option<String>) -> Vec<String> {
    match parse(text, "f.yaml", env) {
        Ok(settings) => panic!("accepted: {text}\n{settings:?}"),
        Err(error) => error.to_string().lines().map(str::to_owned).collect(),
    }
}

fn rates(lane: &Lane) -> LaneRates {
    match &lane.forwarding {
        Forwarding::Limited(rates) => *rates,
        Forwarding::Everything => panic!("lane {} has no rates", lane.name),
    }
}

fn lane<'a>(settings: &'a Settings, name: &str) -> &'a Lane {
    settings.lane(&LaneName::try_from(name).unwrap()).unwrap()
}

#[test]
fn a_file_with_one_topic_has_the_papers_defaults() {
    let settings = settings(TOPIC);
    let [critical, noncritical] = settings.lanes.as_slice() else { panic!("{:?}", settings.lanes) };
    assert_eq!((critical.name.as_str(), critical.queue_depth), ("critical", 64));
    assert_eq!((noncritical.name.as_str(), noncritical.queue_depth), ("noncritical", 16));
    assert_eq!(critical.outputs[0].topic.to_string(), "/adaptive_bridge/critical/scan");
    assert_eq!(critical.outputs[0].qos, QosProfile::CRITICAL);
    assert_eq!(noncritical.outputs[0].topic.to_string(), "/adaptive_bridge/noncritical/scan");
    assert_eq!(noncritical.outputs[0].qos, QosProfile::NONCRITICAL_RELIABLE);
    let normal = RatePolicy {
        max_rate_hz: 10.0,
        max_bytes_per_s: None,
        stale_threshold_ms: 200,
        drop_policy: DropPolicy::DropOldest,
        queue_samples: 5,
    };
    let degraded = RatePolicy { max_rate_hz: 3.0, queue_samples: 2, ..normal };
    assert_eq!(noncritical.forwarding, Forwarding::Limited(LaneRates { normal, degraded }));
    assert_eq!(critical.forwarding, Forwarding::Everything);
    assert_eq!(settings.routes[0].max_sample_bytes, 16 << 20);
    assert_eq!(settings.routes[0].retained_samples, 8);
    assert_eq!(settings.routes[0].input_qos, InputQos::default());
    assert_eq!((settings.policy_hold_ms, settings.graph_gid_bytes), (5000, 16));
    assert_eq!(settings.instance.as_str(), "default");
}

#[test]
fn null_is_the_same_as_a_missing_key() {
    let nulls = "instance: ~\nlanes: {critical: null, noncritical: {max_rate_hz: }}\nprobes:\n";
    assert_eq!(with(nulls), settings(TOPIC));
}

#[test]
fn qos_comes_from_override_then_profile_then_lane_then_class() {
    let settings = settings(
        "topics:\n\
         - {id: a, input_topic: /a}\n\
         - {id: b, input_topic: /b}\n\
         - {id: c, input_topic: /c, qos_overrides: {rviz: {depth: 7, deadline_ms: 9}}}\n\
         qos_profiles: {map: {durability: transient_local, depth: 1}, all: {history: KEEP_ALL}}\n\
         lanes: {rviz: {qos: map}, fleet: {qos: {reliability: RELIABLE, lifespan_ms: 50}}}\n\
         topic_qos_profiles: {b: {rviz: all}, c: {rviz: map}}\n",
    );
    let rviz = |route: usize| lane(&settings, "rviz").outputs[route].qos;
    let map = QosProfile {
        durability: Durability::TransientLocal,
        history: History::KeepLast { depth: 1 },
        ..QosProfile::NONCRITICAL_RELIABLE
    };
    assert_eq!(rviz(0), map);
    assert_eq!(rviz(1), QosProfile { history: History::KeepAll, ..QosProfile::NONCRITICAL_RELIABLE });
    let deadline_ms = Some(9);
    assert_eq!(rviz(2), QosProfile { history: History::KeepLast { depth: 7 }, deadline_ms, ..map });
    let fleet = lane(&settings, "fleet").outputs[0].qos;
    let reliability = Reliability::Reliable;
    assert_eq!(fleet, QosProfile { reliability, lifespan_ms: Some(50), ..QosProfile::NONCRITICAL_RELIABLE });
    // The deepest TRANSIENT_LOCAL output of each route, else 8 of the largest samples.
    assert_eq!(settings.routes.iter().map(|route| route.retained_samples).collect::<Vec<_>>(), [1, 8, 7]);
}

#[test]
fn a_file_that_says_best_effort_gets_the_papers_profile() {
    let of = |text: &str| lane(&with(text), "noncritical").outputs[0].qos;
    assert_eq!(of("lanes: {noncritical: {qos: {reliability: BEST_EFFORT}}}\n"), QosProfile::NONCRITICAL);
    let depth = QosProfile { history: History::KeepLast { depth: 9 }, ..QosProfile::NONCRITICAL };
    assert_eq!(of("lanes: {noncritical: {qos: {reliability: best_effort, depth: 9}}}\n"), depth);
}

#[test]
fn a_noncritical_lane_retains_for_repair_only_what_it_offers() {
    let window = |name: &str, text: &str| {
        let settings = with(&format!("lanes: {{{name}: {{{text}}}}}\n"));
        let lane = lane(&settings, name);
        lane.window_samples_of(&lane.outputs[0].qos)
    };
    assert_eq!(window("critical", "qos: {depth: 7}"), 256);
    assert_eq!(window("noncritical", "qos: {depth: 7}"), 7);
    assert_eq!(window("noncritical", "qos: {depth: 7}, window_samples: 9"), 9);
    assert_eq!(window("noncritical", "qos: {history: KEEP_ALL}"), 256);
    // State does not supersede state.
    assert_eq!(window("noncritical", "qos: {depth: 7, durability: TRANSIENT_LOCAL}"), 256);
}

#[test]
fn a_keep_all_transient_local_output_retains_the_window_of_its_lane() {
    let text =
        "lanes: {noncritical: {window_samples: 30, qos: {history: KEEP_ALL, durability: TRANSIENT_LOCAL}}}\n";
    assert_eq!(with(text).routes[0].retained_samples, 30);
    // Without a durability the output may follow TRANSIENT_LOCAL publishers, with the depth that is given.
    let retained =
        |qos: &str| with(&format!("lanes: {{critical: {{qos: {{{qos}}}}}}}\n")).routes[0].retained_samples;
    assert_eq!(retained("depth: 30"), 30);
    assert_eq!(
        [retained("depth: 3"), retained("history: KEEP_ALL"), retained("depth: 30, durability: VOLATILE")],
        [8; 3]
    );
}

#[test]
fn missing_input_qos_follows_the_publisher() {
    let input = |text: &str| {
        let text = format!("topics: [{{id: a, input_topic: /a, qos_overrides: {{input: {text}}}}}]");
        settings(&text).routes[0].input_qos
    };
    assert_eq!(input("{}"), InputQos::default());
    let depth = |depth| Some(History::KeepLast { depth });
    assert_eq!(input("{depth: 3}"), InputQos { history: depth(3), ..InputQos::default() });
    assert_eq!(input("{history: KEEP_LAST}"), InputQos { history: depth(10), ..InputQos::default() });
    let all = InputQos {
        reliability: Some(Reliability::BestEffort),
        durability: Some(Durability::Volatile),
        history: Some(History::KeepAll),
        deadline_ms: Some(5),
    };
    assert_eq!(
        input(
            "{reliability: best_effort, durability: VOLATILE, history: KEEP_ALL, depth: 4, deadline_ms: 5}"
        ),
        all
    );
}

#[test]
fn a_route_is_on_the_lanes_that_it_names() {
    let settings = settings(
        "topics:\n\
         - {id: a, input_topic: /a, lanes: [rviz, critical], outputs: {rviz: /rviz/a, critical: /c/a}}\n\
         - {id: b, input_topic: /b, noncritical_output: /n/b}\n\
         lanes: {rviz: {}}\n",
    );
    let outputs = |name: &str| -> Vec<(usize, String)> {
        let outputs = lane(&settings, name).outputs.iter();
        outputs.map(|output| (output.route, output.topic.to_string())).collect()
    };
    assert_eq!(outputs("critical"), [(0, "/c/a".into()), (1, "/adaptive_bridge/critical/b".into())]);
    assert_eq!(outputs("noncritical"), [(1, "/n/b".into())]);
    assert_eq!(outputs("rviz"), [(0, "/rviz/a".into()), (1, "/adaptive_bridge/rviz/b".into())]);
}

#[test]
fn rates_come_from_lane_then_mode_then_routing_policy() {
    let settings = with(
        "routing_policy:\n\
         \x20 noncritical_max_rate_hz: 20\n\
         \x20 noncritical_drop_policy: drop_latest\n\
         \x20 stale_threshold_ms: 900\n\
         \x20 modes:\n\
         \x20   normal: {noncritical_max_rate_hz: 25, noncritical_depth: 30, max_noncritical_queue: 12}\n\
         \x20   degraded: {noncritical_max_rate_hz: 4, stale_threshold_ms: 100, noncritical_depth: 0, \
         noncritical_drop_policy: drop_stale}\n\
         safety: {max_noncritical_queue: 6}\n\
         lanes:\n\
         \x20 slow: {max_rate_hz: 2, stale_threshold_ms: 0, max_bytes_per_s: 1000, queue_samples: 9}\n\
         \x20 fast: {degraded_rate_hz: 15, degraded_stale_threshold_ms: 3, degraded_max_bytes_per_s: 10, \
         drop_policy: drop_oldest}\n",
    );
    let policy = |max_rate_hz, max_bytes_per_s, stale_threshold_ms, drop_policy, queue_samples| RatePolicy {
        max_rate_hz,
        max_bytes_per_s,
        stale_threshold_ms,
        drop_policy,
        queue_samples,
    };
    let rates = |name: &str| rates(lane(&settings, name));
    assert_eq!(rates("noncritical").normal, policy(25.0, None, 900, DropPolicy::DropLatest, 12));
    assert_eq!(rates("noncritical").degraded, policy(4.0, None, 100, DropPolicy::DropStale, 1));
    assert_eq!(rates("slow").normal, policy(2.0, Some(1000), 0, DropPolicy::DropLatest, 9));
    assert_eq!(rates("slow").degraded, policy(4.0, Some(1000), 100, DropPolicy::DropStale, 9));
    assert_eq!(rates("fast").normal, policy(25.0, None, 900, DropPolicy::DropOldest, 12));
    assert_eq!(rates("fast").degraded, policy(15.0, Some(10), 3, DropPolicy::DropOldest, 1));
}

#[test]
fn the_safety_limit_applies_to_the_queue_of_a_mode_without_its_own_limit() {
    let text =
        "safety: {max_noncritical_queue: 6}\nrouting_policy: {modes: {normal: {noncritical_depth: 30}}}\n";
    assert_eq!(rates(&with(text).lanes[1]).normal.queue_samples, 6);
}

#[test]
fn disabled_noncritical_lanes_forward_nothing() {
    let settings = with("routing_policy: {noncritical_enabled: false}\nlanes: {rviz: {max_rate_hz: 5}}\n");
    for name in ["noncritical", "rviz"] {
        let rates = rates(lane(&settings, name));
        assert_eq!((rates.normal.max_rate_hz, rates.degraded.max_rate_hz), (0.0, 0.0));
    }
    assert_eq!(settings.lanes[0].forwarding, Forwarding::Everything);
}

#[test]
fn lanes_have_their_own_networks_and_scheduling() {
    let settings = with(
        "ros: {domain_id: 4, networks: [eth0, 10.0.0.7]}\n\
         lanes:\n\
         \x20 critical: {scheduling: {policy: fifo, priority: 80, cpus: [2, 3], lock_memory: true}}\n\
         \x20 noncritical: {domain_id: 9, networks: [wlan0]}\n\
         \x20 fleet: {networks: [], scheduling: {nice: 3, slice_ms: 2.5}}\n\
         processes: {ingress: {scheduling: {policy: rr, priority: 1}}}\n",
    );
    let name = |name: &str| NetworkSelector::Name(name.to_owned());
    let address = NetworkSelector::Address([10, 0, 0, 7].into());
    let input = DdsNetwork { interfaces: vec![name("eth0"), address], ..DdsNetwork::of_domain(4) };
    assert_eq!(settings.input, input);
    assert_eq!(lane(&settings, "critical").network, input);
    assert_eq!(
        lane(&settings, "noncritical").network,
        DdsNetwork { interfaces: vec![name("wlan0")], ..DdsNetwork::of_domain(9) }
    );
    assert_eq!(lane(&settings, "fleet").network, DdsNetwork::of_domain(4));
    let fifo = Scheduling {
        policy: SchedulingPolicy::Fifo,
        priority: 80,
        nice: 0,
        slice_us: Some(100),
        cpus: vec![2, 3],
        lock_memory: true,
    };
    assert_eq!(lane(&settings, "critical").scheduling, fifo);
    let rr = Scheduling {
        policy: SchedulingPolicy::RoundRobin,
        priority: 1,
        slice_us: Some(100),
        ..Scheduling::default()
    };
    assert_eq!(settings.ingress_scheduling, rr);
    assert_eq!(settings.control_scheduling, Scheduling::default());
    assert_eq!(lane(&settings, "noncritical").scheduling.nice, 10);
    assert_eq!(lane(&settings, "noncritical").scheduling.slice_us, Some(10_000));
    assert_eq!(lane(&settings, "fleet").scheduling.nice, 3);
    assert_eq!(lane(&settings, "fleet").scheduling.slice_us, Some(2_500));
}

#[test]
fn subscribers_and_overrides_are_read_by_id() {
    let settings = with(
        "lanes: {rviz: {}}\n\
         subscribers: {laptop: rviz, tablet: {lane: noncritical}, gone: {lane: null}}\n\
         overrides: {laptop: critical, 7: NONCRITICAL, other: null}\n",
    );
    let lanes: Vec<_> = settings.subscribers.iter().map(|(id, lane)| (id.as_str(), lane.as_str())).collect();
    assert_eq!(lanes, [("laptop", "rviz"), ("tablet", "noncritical")]);
    let states: Vec<_> = settings.overrides.iter().map(|(id, &state)| (id.as_str(), state)).collect();
    assert_eq!(states, [("7", SubscriberState::Noncritical), ("laptop", SubscriberState::Critical)]);
}

#[test]
fn the_settings_contain_the_source_of_a_secret_only() {
    let secret = |text: &str| with(&format!("security: {{{text}}}\n")).security.secret;
    assert_eq!(secret("hmac_secret: ''"), None);
    assert_eq!(secret("hmac_secret: swordfish"), Some(SecretSource::ConfigFile));
    assert_eq!(secret("hmac_secret_file: /etc/secret"), Some(SecretSource::File("/etc/secret".into())));
    assert_eq!(secret("hmac_secret_env: SECRET"), Some(SecretSource::Environment("SECRET".into())));
    assert!(!format!("{:?}", with("security: {hmac_secret: swordfish}\n")).contains("swordfish"));
}

#[test]
fn no_message_contains_a_secret() {
    for text in [
        "security: swordfish",
        "security: [swordfish]",
        "security: {hmac_secret: [swordfish]}",
        "security: {hmac_secret: {swordfish: 1}}",
        "security: {hmac_secret:swordfish}",
        "security: {hmac_secrt: swordfish}",
        "security: {hmac_secret: swordfish, hmac_secret: swordfish}",
        "security: {hmac_secret: swordfish, hmac_secret_file: /swordfish}",
        "security: {hmac_secret_file: swordfish}",
        "security: {hmac_secret_env: sword-swordfish}",
        "security: {hmac_secret: *swordfish}",
        "security: {hmac_secret: !swordfish x}",
        "security: {hmac_secret: swordfish",
        "security:\n  hmac_secret: 'swordfish\n",
    ] {
        let text = format!("{TOPIC}{text}\n");
        let error = parse(&text, "f.yaml", &no_env).expect_err(&text);
        assert!(!format!("{error}{error:?}").contains("swordfish"), "{text}{error}");
    }
}

#[test]
fn aliases_and_merge_keys_are_expanded() {
    let settings = settings(
        "topics: [{id: a, input_topic: /a}]\n\
         qos_profiles:\n\
         \x20 base: &base {reliability: RELIABLE, depth: 3}\n\
         \x20 derived: {<<: *base, depth: 4}\n\
         topic_qos_profiles: {a: {critical: base, noncritical: derived}}\n",
    );
    let qos = |lane: usize| settings.lanes[lane].outputs[0].qos;
    assert_eq!(qos(0).depth(), Some(3));
    assert_eq!((qos(1).depth(), qos(1).reliability), (Some(4), Reliability::Reliable));
}

#[test]
fn an_output_in_another_domain_may_have_the_name_of_its_input() {
    let settings = settings(
        "topics: [{id: a, input_topic: /a, noncritical_output: /a}]\nlanes: {noncritical: {domain_id: 1}}\n",
    );
    assert_eq!(settings.lanes[1].outputs[0].topic.to_string(), "/a");
}

#[test]
fn a_default_output_that_is_too_long_is_reported() {
    let input = format!("/{}", "a".repeat(240));
    let found = messages(&format!("topics: [{{id: a, input_topic: {input}}}]"));
    assert_eq!(found.len(), 2);
    assert!(
        found[0].starts_with("f.yaml:1: topics[0].outputs.critical = /adaptive_bridge/critical/aaa"),
        "{found:?}"
    );
    assert!(found[0].contains("at most 246 characters"), "{found:?}");
}

#[test]
fn each_mistake_is_reported_with_line_value_and_what_is_allowed() {
    let cases = include_str!("../../tests/fixtures/config/messages.txt").split("\n\n").skip(1);
    let mut count = 0;
    for case in cases {
        let (text, expected): (Vec<&str>, Vec<&str>) =
            case.lines().partition(|line| !line.starts_with("=> "));
        let text = text.join("\n");
        let text = if text.starts_with("topics") { text } else { format!("{TOPIC}{text}") };
        let expected: Vec<String> = expected.iter().map(|line| line.replacen("=> ", "f.yaml:", 1)).collect();
        assert_eq!(messages(&text), expected, "{text}");
        count += 1;
    }
    assert!(count > 90, "{count} cases");
}

#[test]
fn a_file_without_topics_is_refused() {
    let found = messages("instance: a");
    assert_eq!(found.len(), 1);
    assert!(
        found[0].starts_with("f.yaml:1: topics: must be given: a list of at least one topic"),
        "{found:?}"
    );
}

#[test]
fn files_that_are_empty_no_mapping_or_invalid_yaml_are_refused() {
    for text in ["", "\n\n", "# nothing\n", "---\n", "~", "---\n...\n", "\u{feff}"] {
        let found = messages(text);
        assert_eq!(found.len(), 1, "{text:?}");
        assert!(found[0].starts_with("f.yaml: the file is empty: at least `topics` must"), "{found:?}");
    }
    for (text, message) in [
        ("5", "f.yaml:1: must be a mapping at its top level, of keys such as `topics:`"),
        ("\n- a\n- b", "f.yaml:2: must be a mapping at its top level, of keys such as `topics:`"),
        ("topics: [", "f.yaml:1: not YAML: "),
        ("a: b\n c: d", "f.yaml:2: not YAML: "),
        ("a: b\n\tc: d", "f.yaml:1: not YAML: "),
        ("a: 1\n---\nb: 2\n", "f.yaml:2: must be one YAML document; a second one begins here"),
        ("a: 1\n? [b]\n: 2\n", "f.yaml:2: a key must be text, not a list or a mapping"),
        ("a: *b\n", "f.yaml:1: not YAML: "),
        ("a: &a\n  b: *a\n", "f.yaml:2: must not be an alias of a value that contains it"),
        ("a: &a\n  c: 1\n  b: [*a]\n", "f.yaml:3: must not be an alias of a value that contains it"),
        ("a: !include b\n", "f.yaml:1: must not use YAML tags (`!name`)"),
        ("a: 1\nb: !!int c\n", "f.yaml:2: must not use YAML tags (`!name`)"),
        ("a: 1\nb: !!binary c\n", "f.yaml:2: must not use YAML tags (`!name`)"),
        ("a: 1\n...\n# the end\nb: 2\n", "f.yaml:4: must be one YAML document; a second one begins here"),
    ] {
        let found = messages(text);
        assert_eq!(found.len(), 1, "{text}");
        assert!(found[0].starts_with(message), "{text}: {found:?}");
    }
    let error = parse(b"a: b\nc: \xff\n", "f.yaml", &no_env).unwrap_err();
    assert_eq!(error.to_string(), "f.yaml:2: must be text in UTF-8");
}

#[test]
fn lines_are_counted_as_in_an_editor() {
    // A byte order mark is not a line, CR LF is one line break, NEL and LS are none.
    for (text, line) in [
        ("\n\ninstance: 7", 4),
        ("\r\n# a\r\ninstance: 7", 4),
        ("# a\rinstance: 7", 3),
        ("x: \"a\u{85}b\u{2028}c\"\ninstance: 7", 3),
        ("?\n instance\n:\n 7", 3),
        ("diagnostics: {\n}\ninstance:\n\n  7", 4),
    ] {
        let found = messages(&format!("\u{feff}{TOPIC}{text}"));
        let found = found.iter().find(|message| message.contains("instance = 7"));
        let expected = format!("f.yaml:{line}: instance = 7: must be text (put it in quotes)");
        assert_eq!(found, Some(&expected), "{text:?}");
    }
    let items = "topics:\n- {id: a, input_topic: /a}\n- {\n  }\n- &b\n  id: b\n-\n  5\n- *b\n- []\n";
    let lines = messages(items);
    for (index, line) in [(1, 3), (2, 5), (3, 8), (4, 9), (5, 10)] {
        let start = format!("f.yaml:{line}: topics[{index}]");
        assert!(lines.iter().any(|message| message.starts_with(&start)), "{start}: {lines:#?}");
    }
}

#[test]
fn files_designed_to_exhaust_the_loader_are_refused() {
    let mut bomb = String::from("a0: &a0 [x, x, x, x, x, x, x, x, x]\n");
    for level in 1..40 {
        let aliases = vec![format!("*a{}", level - 1); 9].join(", ");
        writeln!(bomb, "a{level}: &a{level} [{aliases}]").unwrap();
    }
    let mebibyte = 1 << 20;
    let many = "must have at most 65536 keys and values, including those of aliases";
    let deep = "must be nested at most 32 deep";
    for (text, message) in [
        (bomb, format!("f.yaml:5: {many}")),
        ("[".repeat(mebibyte), format!("f.yaml:1: {deep}")),
        ("{a: ".repeat(mebibyte / 4), format!("f.yaml:1: {deep}")),
        ("- ".repeat(mebibyte / 2), format!("f.yaml:1: {deep}")),
        ("? ".repeat(mebibyte / 2), format!("f.yaml:1: {deep}")),
        (format!("[{}]", "a,".repeat(mebibyte / 2 - 1)), format!("f.yaml:1: {many}")),
        (" ".repeat(mebibyte + 1), "f.yaml: must be at most 1048576 bytes long".to_owned()),
        (
            format!("a: &a {}\nb:\n- *a\n- *a\n- *a", "b ".repeat(mebibyte / 2 - 50)),
            "f.yaml:4: must have at most 2097152 bytes of text, including that of aliases".to_owned(),
        ),
        (
            format!("a: &a '{}'\nb: [{}]\n", "b".repeat(mebibyte / 2), "*a, ".repeat(4000)),
            "f.yaml:2: must use at most 993 aliases in a file of this size".to_owned(),
        ),
        // The library neither reads nor counts content after the end of the document.
        (
            format!("a: 1\n...\n{}", "{a: ".repeat(mebibyte / 5)),
            "f.yaml:3: must be one YAML document; a second one begins here".to_owned(),
        ),
    ] {
        assert_eq!(messages(&text), [message]);
    }
    // Mixed nesting stays below both limits of the library; the loader counts it.
    let mixed = messages(&"- [\n".repeat(40));
    assert!(mixed[0].starts_with("f.yaml:"), "{mixed:?}");
}

#[test]
fn too_many_lanes_or_topics_are_refused() {
    let mut lanes = String::from("lanes:\n");
    for index in 0..31 {
        writeln!(lanes, "  l{index}: {{}}").unwrap();
    }
    assert_eq!(
        messages(&format!("{TOPIC}{lanes}")),
        ["f.yaml:2: lanes: must be at most 32 lanes, each of which is a process"]
    );
    let mut topics = String::from("topics:\n");
    for index in 0..1025 {
        writeln!(topics, "- {{id: t{index}, input_topic: /t{index}}}").unwrap();
    }
    assert_eq!(messages(&topics), ["f.yaml:1: topics: must be at most 1024 topics"]);
}

#[test]
fn environment_variables_supply_values_missing_in_the_file() {
    let parse_in = |text: &str, name: &'static str, value: &'static str| {
        let text = format!("{TOPIC}{text}");
        parse(&text, "f.yaml", &|asked: &str| (asked == name).then(|| value.to_owned())).unwrap()
    };
    let loopback = [NetworkSelector::Address([127, 0, 0, 1].into())];
    assert_eq!(parse_in("", "ROS_DOMAIN_ID", "42").input.domain_id, 42);
    assert_eq!(parse_in("", "ROS_DOMAIN_ID", "42").lanes[1].network.domain_id, 42);
    assert_eq!(parse_in("", "ROS_DOMAIN_ID", "").input.domain_id, 0);
    assert_eq!(parse_in("ros: {domain_id: 7}", "ROS_DOMAIN_ID", "42").input.domain_id, 7);
    assert_eq!(parse_in("", "ROS_LOCALHOST_ONLY", "1").input.interfaces, loopback);
    assert!(parse_in("", "ROS_LOCALHOST_ONLY", "0").input.interfaces.is_empty());
    let range = "ROS_AUTOMATIC_DISCOVERY_RANGE";
    assert_eq!(parse_in("", range, "LOCALHOST").lanes[0].network.interfaces, loopback);
    assert!(parse_in("", range, "SUBNET").input.interfaces.is_empty());
    assert!(parse_in("", range, "SYSTEM_DEFAULT").input.interfaces.is_empty());
    let named = parse_in("ros: {networks: [eth0]}\nlanes: {a: {networks: []}}", range, "LOCALHOST");
    assert_eq!(named.input.interfaces, [NetworkSelector::Name("eth0".to_owned())]);
    assert_eq!(lane(&named, "a").network.interfaces, loopback);
    let peers = parse_in("", "ROS_STATIC_PEERS", "10.0.0.1;10.0.0.2;");
    assert_eq!(peers.input.static_peers, [[10, 0, 0, 1], [10, 0, 0, 2]].map(Ipv4Addr::from));
    let own = "ros: {static_peers: [10.0.0.9]}\nlanes: {a: {static_peers: []}}";
    let own = parse_in(own, "ROS_STATIC_PEERS", "10.0.0.1");
    assert_eq!(own.lanes[0].network.static_peers, [Ipv4Addr::new(10, 0, 0, 9)]);
    assert!(lane(&own, "a").network.static_peers.is_empty());
    for (distro, bytes) in [("humble", 24), ("galactic", 24), ("foxy", 24), ("iron", 16), ("jazzy", 16)] {
        assert_eq!(parse_in("", "ROS_DISTRO", distro).graph_gid_bytes, bytes, "{distro}");
    }
    assert_eq!(parse_in("ros: {graph_gid_bytes: 16}", "ROS_DISTRO", "humble").graph_gid_bytes, 16);
}

#[test]
fn a_wrong_environment_variable_is_reported() {
    for (name, value, message) in [
        ("ROS_DOMAIN_ID", "233", "must be a whole number from 0 to 232"),
        ("ROS_DOMAIN_ID", "-1", "must be a whole number from 0 to 232"),
        ("ROS_LOCALHOST_ONLY", "true", "must be 0 or 1"),
        ("ROS_AUTOMATIC_DISCOVERY_RANGE", "subnet", "must be one of SUBNET, LOCALHOST, SYSTEM_DEFAULT"),
        (
            "ROS_AUTOMATIC_DISCOVERY_RANGE",
            "OFF",
            "must not be OFF: a bridge without discovery finds neither publishers nor subscribers",
        ),
        (
            "ROS_STATIC_PEERS",
            "10.0.0.1;laptop",
            "must be at most 16 IPv4 addresses separated by `;`: the bridge does not look up names of hosts",
        ),
    ] {
        let found = messages_in(TOPIC, &|asked: &str| (asked == name).then(|| value.to_owned()));
        assert_eq!(found, [format!("environment: {name} = {value}: {message}")]);
    }
}

#[test]
fn each_degraded_threshold_of_safety_is_below_its_emergency_threshold() {
    let rules =
        with("safety: {emergency_lag_ms: 900, silent_ms: 600, emergency_silent_ms: 0}\n").safety.rules;
    assert_eq!((rules.degraded_lag_ms, rules.emergency_lag_ms), (500.0, 900.0));
    assert_eq!((rules.silent_ms, rules.emergency_silent_ms), (600, 0));
    for (text, message) in [
        ("emergency_lag_ms: 500", "emergency_lag_ms = 500: must be above safety.degraded_lag_ms (500)"),
        (
            "degraded_errors_per_s: 200",
            "degraded_errors_per_s = 200: must be below safety.emergency_errors_per_s (100)",
        ),
        (
            "degraded_queue_occupancy: 0.96",
            "degraded_queue_occupancy = 0.96: must be below safety.emergency_queue_occupancy (0.95)",
        ),
        ("silent_ms: 30000", "silent_ms = 30000: must be below safety.emergency_silent_ms (30000)"),
        ("evaluate_rate_hz: 21", "evaluate_rate_hz = 21: must be a number from 0.1 to 20"),
        ("recovery_count: 0", "recovery_count = 0: must be a whole number from 1 to 1000"),
    ] {
        let found = messages(&format!("{TOPIC}safety: {{{text}}}\n"));
        assert!(matches!(&found[..], [only] if only.ends_with(message)), "{found:?}");
    }
}

#[test]
fn values_at_a_limit_are_accepted_and_converted() {
    let settings = with("probes: {rate_hz: 20}\nsecurity: {max_probe_rate_hz: 20}\n");
    assert_eq!((settings.probes.rate_hz, settings.security.max_probe_rate_hz), (20.0, 20));
    assert_eq!(with("diagnostics: {publish_interval_s: 2.5}\n").diagnostics.publish_interval_ms, 2_500);
    assert_eq!(with("classifier: {subscriber_id: ''}\n").classifier.subscriber_id, None);
    assert_eq!(with("classifier: {subscriber_id: rviz}\n").classifier.subscriber_id.as_deref(), Some("rviz"));
}

#[test]
fn the_variable_of_the_secret_has_the_name_of_a_variable() {
    for name in ["PROBE_SECRET", "_a1"] {
        let source = with(&format!("security: {{hmac_secret_env: {name}}}\n")).security.secret;
        assert_eq!(source, Some(SecretSource::Environment(name.to_owned())));
    }
    for name in ["''", "1A", "A-B", "'A B'"] {
        let found = messages(&format!("{TOPIC}security: {{hmac_secret_env: {name}}}\n"));
        assert!(found.iter().any(|line| line.contains("the name of an environment variable")), "{found:?}");
    }
}
