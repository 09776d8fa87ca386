//! The parser of Prometheus' own Python client.

use std::io::Write;
use std::process::{Command, Stdio};

use serde_json::Value;

/// Reads a page from standard input and prints each family: name, type, samples as [name, labels, value].
const PARSER: &str = "
import json, sys
from prometheus_client.parser import text_string_to_metric_families
text = sys.stdin.buffer.read().decode()
families = text_string_to_metric_families(text)
print(json.dumps([[f.name, f.type, [[s.name, s.labels, str(s.value)] for s in f.samples]] for f in families]))
";

/// A Python that has the parser. That of the system is not always the first in the path.
pub fn python() -> Option<&'static str> {
    let has_parser = |python: &&str| {
        let import = Command::new(python).args(["-c", "import prometheus_client.parser"]).output();
        import.is_ok_and(|import| import.status.success())
    };
    ["python3", "/usr/bin/python3"].into_iter().find(has_parser)
}

/// The families of a page: name, type, and samples as [name, labels, value].
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
