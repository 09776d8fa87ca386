//! The output of `ros2 param dump` for a node of the bridge, used as a file of parameters.

use std::path::Path;

use adaptive_bridge::config::{self, Kind, Parameters, Settings, Value};
use serde_json::json;

/// A route with a short key for an output, an id with a dot that begins with that of another route, and what
/// follows from several keys: queues of both modes, the depth of an output without a durability.
const FILE: &str = "\
topics:
  - {id: scan, input_topic: /scan, critical_output: /front/scan}
  - {id: scan.rear, input_topic: /rear/scan, lanes: [critical]}
overrides: {lap.top: CRITICAL}
subscribers: {lap.top: noncritical}
routing_policy: {modes: {degraded: {noncritical_depth: 3, noncritical_drop_policy: drop_stale}}}
processes: {control: {scheduling: {cpus: [0, 1]}}}
";

/// The value of a parameter as a ROS 2 node gets it.
fn json_of(kind: Kind, value: &Value) -> serde_json::Value {
    match (kind, value) {
        (_, Value::None) => json!(null),
        (_, Value::Flag(flag)) => json!(flag),
        (Kind::Decimal(..), Value::Whole(number)) => json!(*number as f64),
        (_, Value::Whole(number)) => json!(number),
        (_, Value::Decimal(number)) => json!(number),
        (_, Value::Text(text)) => json!(text),
        (_, Value::List(items)) => items.iter().map(|item| json_of(kind, item)).collect(),
    }
}

/// The dump of a node, in JSON, which is YAML; one line for each key.
fn dump(settings: &Settings, process: &str) -> serde_json::Value {
    let mut parameters = json!({});
    for listed in settings.listed() {
        let place = listed.name.split('.').fold(&mut parameters, |node, name| &mut node[name]);
        *place = json_of(listed.row.kind, &listed.value);
    }
    let node = format!("{}/{}", settings.node_namespace, settings.node_name_of(process));
    json!({ node: { "ros__parameters": parameters } })
}

fn load(file: &str, params: Option<&serde_json::Value>, more: &[&str]) -> Result<Settings, String> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bridge.yaml");
    std::fs::write(&path, file).unwrap();
    let mut parameters: Vec<Parameters> = more.iter().map(|text| text.parse().unwrap()).collect();
    if let Some(params) = params {
        let path = folder.path().join("dump.yaml");
        std::fs::write(&path, format!("{params:#}")).unwrap();
        parameters.push(Parameters::File(path));
    }
    let loaded = config::load_configuration(Some(&path), &parameters, &|_| None);
    let folder = format!("{}/", folder.path().display());
    loaded.map(|loaded| loaded.settings).map_err(|error| error.to_string().replace(&folder, ""))
}

#[test]
fn the_dump_of_any_node_changes_nothing_where_it_was_made() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut files = vec![FILE.to_owned(), format!("instance: rear\nros: {{node_name: front}}\n{FILE}")];
    let examples = std::fs::read_dir(root.join("config/examples")).unwrap();
    let examples = examples.map(|entry| entry.unwrap().path()).chain([root.join("config/default.yaml")]);
    files.extend(examples.map(|path| std::fs::read_to_string(path).unwrap()));
    assert!(files.len() >= 7, "{files:?}");
    for file in files {
        let settings = load(&file, None, &[]).unwrap();
        for process in ["ingress", "control", "egress_critical", "egress_noncritical"] {
            let given_back = load(&file, Some(&dump(&settings, process)), &[]);
            assert_eq!(given_back.as_ref(), Ok(&settings), "{process}: {file}");
        }
    }
}

#[test]
fn the_dump_of_a_bridge_with_parameters_gives_them_back() {
    let parameters = [
        "lanes.noncritical.max_rate_hz:=7",
        "lanes.noncritical.queue_samples:=9",
        "probes.rate_hz:=2.5",
        "overrides.laptop.local:=CRITICAL",
        "topics.scan.rear.priority:=3",
        "topics.scan.outputs.critical:=/other/scan",
        "ros.networks:=[lo]",
        "processes.control.scheduling.cpus:=[1]",
    ];
    let settings = load(FILE, None, &parameters).unwrap();
    assert_eq!(settings.routes[1].priority, 3);
    assert_eq!(load(FILE, Some(&dump(&settings, "control")), &[]), Ok(settings.clone()));
    // A parameter of the command line replaces a value of a dump, whichever comes first.
    let replaced = load(FILE, Some(&dump(&settings, "ingress")), &["probes.rate_hz:=3"]).unwrap();
    assert_eq!((replaced.probes.rate_hz, replaced.routes[1].priority), (3.0, 3));
    // A section of another node does not apply to this bridge.
    let other = json!({ "/other/control": { "ros__parameters": { "probes": { "rate_hz": 4 }, "a": 1 } } });
    assert_eq!(load(FILE, Some(&other), &[]), load(FILE, None, &[]));
}

#[test]
fn a_wrong_value_of_a_dump_is_reported_with_its_file_line_and_key() {
    for (parameters, expected) in [
        (json!({ "probes": { "rate_hz": "x" } }), "dump.yaml:5: probes.rate_hz = \"x\": must be a number"),
        (json!({ "probes": { "rate": 4 } }), "dump.yaml:5: probes.rate: must be a known key: enabled"),
        (
            json!({ "topics": { "scan": { "priority": 100 } } }),
            "dump.yaml:6: topics[0].priority = 100: must be a whole number from 0 to 99",
        ),
        (
            json!({ "topics": { "scam": { "priority": 1 } } }),
            "dump.yaml:6: topics.scam.priority: must begin with `topics.` and the id of a topic in the \
             configuration file (did you mean `scan`?)",
        ),
        (
            json!({ "topics": { "scan": { "outputs": { "critical": "/scan" } } } }),
            "dump.yaml:7: topics[0].outputs.critical = /scan: must not be an input topic in the same domain",
        ),
        (json!({ "topics": 4 }), "dump.yaml:4: topics = 4: must be a list"),
    ] {
        let params = json!({ "/adaptive_bridge/control": { "ros__parameters": parameters } });
        let error = load(FILE, Some(&params), &[]).unwrap_err();
        assert!(error.starts_with(expected), "{error}\n{expected}");
    }
}
