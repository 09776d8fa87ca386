//! Parsing of metrics pages with the official Python client of Prometheus.

use std::io::Write;
use std::process::{Command, Stdio};

use serde_json::Value;

/// A Python program that reads a page from stdin and prints each family as JSON: name, type, and samples as
/// [name, labels, value].
const PARSER: &str = "
import json, sys
from prometheus_client.parser import text_string_to_metric_families
text = sys.stdin.buffer.read().decode()
families = text_string_to_metric_families(text)
print(json.dumps([[f.name, f.type, [[s.name, s.labels, str(s.value)] for s in f.samples]] for f in families]))
";

/// Returns a Python interpreter that has the parser. The first one in the path may lack the system's
/// packages.
pub fn python() -> Option<&'static str> {
    let has_parser = |python: &&str| {
        let import = Command::new(python).args(["-c", "import prometheus_client.parser"]).output();
        import.is_ok_and(|import| import.status.success())
    };
    ["python3", "/usr/bin/python3"].into_iter().find(has_parser)
}

/// Parses a page into families: name, type, and samples as [name, labels, value].
pub fn parse(python: &str, page: &str) -> Vec<(String, String, Vec<Value>)> {
    let mut parser = Command::new(python)
        .args(["-c", PARSER])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    parser.stdin.take().unwrap().write_all(page.as_bytes()).unwrap();
    let output = parser.wait_with_output().unwrap();
    assert!(output.status.success(), "{}\n{page}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}
