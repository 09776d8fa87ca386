//! The layers: which module may use which other one, and which library.

use super::source::{Rust, SourceFile, SourcePath, files};

/// The layers of the root package: each may use those before it and none after it. `model` and `policy` are
/// a crate of their own, of which the compiler proves that it uses nothing else.
const LAYERS: &[&str] = &["model", "policy", "config", "clock", "dds", "shm", "telemetry", "process", "cli"];

/// Layers that never name each other, though their order would allow it.
const STRANGERS: &[(&str, &str)] = &[("dds", "shm"), ("shm", "dds")];

/// What the evaluation may use of the bridge. It drives the bridge as its users do, by its program.
const EVALUATION: &str = "crates/eval/src/";
const USED_BY_EVALUATION: &[&str] = &["clock", "model", "telemetry"];

/// Folders of figures and reports, which use the standard library but have no side effects, like policy.
const PURE: &[&str] = &["crates/measure/src/", "crates/eval/src/statistics/"];

/// The paths that a pure folder may not use: clocks, threads, IO, logs. Clippy finds macros that print.
const IMPURE: &[&[&str]] = &[
    &["std", "time", "Instant"],
    &["std", "time", "SystemTime"],
    &["std", "thread"],
    &["std", "process"],
    &["std", "env"],
    &["std", "fs"],
    &["std", "io"],
    &["std", "net"],
    &["std", "os"],
    &["tracing"],
    &["nix"],
    &["adaptive_bridge", "clock"],
];

/// Libraries, and the only places that may use them.
const LIBRARIES: &[(&str, &[&str])] = &[
    ("iceoryx2", &["src/shm/"]),
    ("iceoryx2_bb_posix", &["src/shm/"]),
    ("iceoryx2_cal", &["src/shm/"]),
    ("rustdds", &["src/dds/"]),
    ("ros2_client", &["src/dds/"]),
    ("sd_notify", &["src/process/notify.rs"]),
    ("serde_yaml", &["src/config/yaml/", "crates/eval/src/scenario/"]),
    ("granit_parser", &["src/config/yaml/"]),
];

/// The violations of the rules in a file of a library or program.
fn violations(path: &str, text: &str) -> Vec<String> {
    let rust = Rust::new(text);
    let paths = rust.paths();
    let mut found = Vec::new();
    let mut say = |line: usize, what: String| found.push(format!("{path}:{line}: {what}"));
    let layer = layer_of(path);
    let is_pure = PURE.iter().any(|folder| path.starts_with(folder));
    for used in &paths {
        if let (Some(layer), Some(other)) = (layer, layer_used(path, used))
            && let Some(what) = forbidden(layer, &other)
        {
            say(used.line, format!("{}: {what}", used.text()));
        }
        if path.starts_with(EVALUATION)
            && used.names[0] == "adaptive_bridge"
            && let Some(other) = used.names.get(1)
            && !USED_BY_EVALUATION.contains(&other.as_str())
        {
            say(used.line, format!("{}: the evaluation may not use {other}", used.text()));
        }
        if is_pure && IMPURE.iter().any(|names| used.starts_with(names)) {
            say(used.line, format!("{} in a pure folder", used.text()));
        }
        for (library, homes) in LIBRARIES {
            let is_home = homes.iter().any(|home| path.starts_with(home));
            if used.names.iter().any(|name| name == library) && !is_home {
                say(used.line, format!("{}: only {} knows {library}", used.text(), homes.join(", ")));
            }
        }
    }
    found
}

/// The layer that a file belongs to; none for the roots of the programs and of the library.
fn layer_of(path: &str) -> Option<&str> {
    let inside = path.strip_prefix("src/")?.strip_suffix(".rs")?;
    let layer = inside.split('/').next()?;
    (!["main", "lib"].contains(&layer)).then_some(layer)
}

/// What of the crate a path uses: the name behind `crate`, or behind as many `super` as lead there.
fn layer_used(path: &str, used: &SourcePath) -> Option<String> {
    let below_root = path.strip_prefix("src/")?.strip_suffix(".rs")?;
    let depth = below_root.split('/').filter(|name| *name != "mod").count() + used.inline_modules;
    let skipped = match used.names.first()?.as_str() {
        "crate" | "adaptive_bridge" => 1,
        "super" => {
            let supers = used.names.iter().take_while(|name| *name == "super").count();
            if supers < depth {
                return None;
            }
            supers
        }
        _ => return None,
    };
    Some(used.names.get(skipped).map_or("*", String::as_str).to_owned())
}

fn forbidden(layer: &str, other: &str) -> Option<String> {
    let place = |name: &str| LAYERS.iter().position(|known| *known == name);
    match (place(layer), place(other)) {
        (None, _) => Some(format!("{layer} is no layer")),
        (_, None) => Some(format!("{other} is no layer")),
        _ if STRANGERS.contains(&(layer, other)) => Some(format!("{layer} may not know {other}")),
        (Some(own), Some(used)) if used > own => {
            Some(format!("{layer} may not use {other}, which is above it"))
        }
        _ => None,
    }
}

#[test]
fn every_layer_uses_only_those_below_it() {
    let sources: Vec<SourceFile> = ["src", "crates"].iter().flat_map(|folder| files(folder, "rs")).collect();
    assert!(sources.len() > 100, "{} files", sources.len());
    let found: Vec<String> =
        sources.iter().flat_map(|source| violations(&source.path, &source.text)).collect();
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn the_map_of_the_library_lists_the_layers_in_their_order() {
    let text = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/src/lib.rs")).unwrap();
    let listed: Vec<&str> =
        text.lines().filter_map(|line| line.strip_prefix("//! - [`")?.split('`').next()).collect();
    assert_eq!(listed, LAYERS);
    let mut modules: Vec<&str> = text.lines().filter_map(|line| line.strip_prefix("pub mod ")).collect();
    modules.extend(["model;", "policy;"]);
    assert_eq!(modules.len(), LAYERS.len(), "a module of the library is no layer");
    for layer in LAYERS {
        assert!(modules.contains(&format!("{layer};").as_str()), "{layer}");
    }
}

#[test]
fn what_breaks_a_layer_is_found() {
    for (path, text, what) in [
        ("src/config/a.rs", "use crate::{model::B, shm::C};", "config may not use shm"),
        ("src/config/a.rs", "fn a() { super::super::clock::monotonic(); }", "config may not use clock"),
        ("src/config/mod.rs", "use super::process;", "config may not use process"),
        ("src/config/a.rs", "mod tests { use super::super::super::shm::B; }", "config may not use shm"),
        ("src/clock.rs", "use super::dds;", "clock may not use dds"),
        ("src/config/a.rs", "fn a() { let b = crate::dds::C::new(); }", "config may not use dds"),
        ("src/dds/a.rs", "use crate::shm::B;", "dds may not know shm"),
        ("src/shm/a.rs", "use crate::{\n    clock,\n    dds::B,\n};", "shm may not know dds"),
        ("src/telemetry/a.rs", "use crate::process;", "telemetry may not use process"),
        ("src/process/a/b.rs", "use super::super::super::cli::C;", "process may not use cli"),
        ("crates/eval/src/a.rs", "use adaptive_bridge::process::B;", "the evaluation may not use process"),
        ("src/cli/a.rs", "use crate::helpers::B;", "helpers is no layer"),
        ("src/helpers.rs", "use crate::model::B;", "helpers is no layer"),
        ("src/cli/a.rs", "use crate::*;", "* is no layer"),
    ] {
        let found = violations(path, text).join("\n");
        assert!(found.contains(what), "{path}: {text}: found: {found}");
    }
}

#[test]
fn what_is_impure_or_knows_a_library_is_found() {
    for (path, text, what) in [
        (
            "crates/measure/src/a.rs",
            "use std::time::{Duration, Instant};",
            "std::time::Instant in a pure folder",
        ),
        ("crates/measure/src/a.rs", "use std::time::SystemTime;", "in a pure folder"),
        (
            "crates/measure/src/a.rs",
            "fn a() { std::thread::yield_now() }",
            "std::thread::yield_now in a pure folder",
        ),
        ("crates/measure/src/a.rs", "use std::{fs, cell};", "std::fs in a pure folder"),
        ("crates/measure/src/a.rs", "use std::io;", "in a pure folder"),
        ("crates/measure/src/a.rs", "use std::net::IpAddr;", "in a pure folder"),
        ("crates/measure/src/a.rs", "fn a() { tracing::info!(\"b\") }", "tracing::info in a pure folder"),
        ("crates/measure/src/a.rs", "use tracing;", "tracing in a pure folder"),
        ("crates/measure/src/a.rs", "use adaptive_bridge::clock;", "adaptive_bridge::clock in a pure folder"),
        ("crates/measure/src/a.rs", "use std::env;", "in a pure folder"),
        ("crates/eval/src/statistics/a.rs", "use std::fs;", "in a pure folder"),
        ("src/process/a.rs", "use iceoryx2::prelude::*;", "only src/shm/ knows iceoryx2"),
        ("src/process/a.rs", "use ros2_client::dds::rustdds;", "only src/dds/ knows rustdds"),
        ("src/process/a.rs", "use ros2_client::Context;", "only src/dds/ knows ros2_client"),
        ("src/config/load.rs", "fn a() { granit_parser::parse() }", "only src/config/yaml/ knows granit"),
        (
            "src/config/load.rs",
            "use serde_yaml;",
            "only src/config/yaml/, crates/eval/src/scenario/ knows serde_yaml",
        ),
    ] {
        let found = violations(path, text).join("\n");
        assert!(found.contains(what), "{path}: {text}: found: {found}");
    }
}

#[test]
fn what_is_allowed_is_not_found() {
    for (path, text) in [
        ("crates/measure/src/a.rs", "use super::b; use std::time::Duration;"),
        ("crates/eval/src/a.rs", "use adaptive_bridge::model::B; use crate::bed::C;"),
        ("src/config/mod.rs", "mod tests { use super::*; }"),
        ("src/config/a.rs", "mod tests { use super::super::b::C; }"),
        ("src/process/a/b.rs", "use super::super::role::Role; use crate::{dds, shm};"),
        ("src/process/a.rs", "// use crate::cli::B;\nconst B: &str = \"use crate::cli::B;\";"),
        ("src/clock.rs", "use crate::model::MonotonicNs;"),
        ("src/shm/a.rs", "use iceoryx2::prelude::*; use crate::config::Settings;"),
        ("src/config/yaml/mod.rs", "use granit_parser::Parser;"),
        ("src/lib.rs", "pub mod cli; use crate::cli;"),
        ("src/main.rs", "fn main() { adaptive_bridge::cli::main() }"),
        ("crates/eval/src/main.rs", "fn main() { adaptive_bridge_eval::main() }"),
    ] {
        let found = violations(path, text);
        assert!(found.is_empty(), "{path}: {text}: found: {}", found.join("\n"));
    }
}
