//! `check`: checks a configuration file and shows the shared memory that it needs.

use std::fmt::{self, Write as _};
use std::io::{self, Write as _};
use std::process::ExitCode;

use clap::Args;
use serde::Serialize;
use serde_json::json;

use super::{ConfigArguments, EXIT_CONFIG, output_ended};
use crate::config::{ConfigError, Place, Settings};
use crate::process::InForce;
use crate::shm::RouteChannel;

/// The arguments of `check`.
#[derive(Args, Debug)]
pub(super) struct Arguments {
    /// Print JSON, for the problems of a bad file too
    #[arg(long)]
    json: bool,
    #[command(flatten)]
    config: ConfigArguments,
}

pub(super) fn run(arguments: &Arguments) -> ExitCode {
    let (text, code) = if arguments.json {
        match arguments.config.try_load() {
            Ok(settings) => (json!(Summary::of(&settings)).to_string() + "\n", ExitCode::SUCCESS),
            Err(error) => (problems(&error).to_string() + "\n", ExitCode::from(EXIT_CONFIG)),
        }
    } else {
        match arguments.config.load() {
            Ok(settings) => {
                let running = InForce::find(&arguments.config.file(), Some(&settings));
                let text = Summary::of(&settings).to_string();
                (
                    text + &running.map_or_else(String::new, |running| differences(&running, settings)),
                    ExitCode::SUCCESS,
                )
            }
            Err(code) => return code,
        }
    };
    match io::stdout().write_all(text.as_bytes()) {
        Ok(()) => code,
        Err(error) => output_ended(&error),
    }
}

/// The lanes, routes and shared memory of a good configuration.
#[derive(Serialize)]
struct Summary {
    instance: String,
    lanes: Vec<String>,
    routes: Vec<RouteSummary>,
    shared_memory_bytes: u64,
}

#[derive(Serialize)]
struct RouteSummary {
    id: String,
    input_topic: String,
    message_type: Option<String>,
    outputs: Vec<OutputSummary>,
    max_sample_bytes: u64,
    slots: usize,
    shared_memory_bytes: u64,
}

#[derive(Serialize)]
struct OutputSummary {
    lane: String,
    topic: String,
}

impl Summary {
    fn of(settings: &Settings) -> Self {
        let routes: Vec<RouteSummary> = settings
            .routes
            .iter()
            .enumerate()
            .map(|(index, route)| {
                let pool = RouteChannel::of(settings, index).pool_size();
                let outputs = settings.lanes.iter().flat_map(|lane| {
                    lane.outputs.iter().filter(|output| output.route == index).map(|output| OutputSummary {
                        lane: lane.name.to_string(),
                        topic: output.topic.to_string(),
                    })
                });
                RouteSummary {
                    id: route.id.to_string(),
                    input_topic: route.input_topic.to_string(),
                    message_type: route.message_type.as_ref().map(ToString::to_string),
                    outputs: outputs.collect(),
                    max_sample_bytes: route.max_sample_bytes as u64,
                    slots: pool.slots,
                    shared_memory_bytes: pool.bytes,
                }
            })
            .collect();
        Self {
            instance: settings.instance.to_string(),
            lanes: settings.lanes.iter().map(|lane| lane.name.to_string()).collect(),
            shared_memory_bytes: routes.iter().map(|route| route.shared_memory_bytes).sum(),
            routes,
        }
    }
}

impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "instance {}: {} routes, {} lanes", self.instance, self.routes.len(), self.lanes.len())?;
        for route in &self.routes {
            let message_type = route.message_type.as_deref().unwrap_or("type from DDS discovery");
            writeln!(f, "\nroute {}: {} ({message_type})", route.id, route.input_topic)?;
            for output in &route.outputs {
                writeln!(f, "  {} -> {}", output.lane, output.topic)?;
            }
            writeln!(
                f,
                "  shared memory: {} slots for samples of up to {}: {}",
                route.slots,
                bytes(route.max_sample_bytes),
                bytes(route.shared_memory_bytes)
            )?;
        }
        writeln!(f, "\ntotal shared memory: {}", bytes(self.shared_memory_bytes))
    }
}

/// Lists the differences between the configuration in force and the file.
fn differences(running: &Settings, file: Settings) -> String {
    let (_, reload) = running.reloaded(file);
    let mut text = String::new();
    // Writing to a String cannot fail.
    for change in &reload.changed {
        let _ = writeln!(text, "waits for a reload: {change}");
    }
    for change in &reload.waits {
        let _ = writeln!(text, "waits for a restart of the whole bridge: {change}");
    }
    if text.is_empty() {
        text
    } else {
        format!("\nthe configuration in force in the running bridge differs from this file:\n{text}")
    }
}

/// The problems of a bad file as JSON.
fn problems(error: &ConfigError) -> serde_json::Value {
    let problems: Vec<_> = error
        .problems()
        .iter()
        .map(|problem| {
            let (place, line) = match problem.place {
                Place::Environment => ("environment", None),
                Place::File => ("file", None),
                Place::Line(line) => ("file", Some(line)),
            };
            json!({
                "place": place,
                "line": line,
                "key": problem.key,
                "value": problem.value,
                "allowed": problem.allowed,
                "hint": problem.hint,
            })
        })
        .collect();
    json!({ "file": error.file(), "problems": problems })
}

/// A size with a unit, such as `12.0 KiB`.
fn bytes(count: u64) -> String {
    const KIB: f64 = 1024.0;
    let size = count as f64;
    if size < KIB {
        format!("{count} B")
    } else if size < KIB * KIB {
        format!("{:.1} KiB", size / KIB)
    } else {
        format!("{:.1} MiB", size / KIB / KIB)
    }
}
