//! `check`: is this configuration good, and what does it take?

use std::process::ExitCode;

use clap::Args;

use super::ConfigArguments;
use crate::config::Settings;
use crate::shm::RouteChannel;

/// What `check` is asked.
#[derive(Args, Debug)]
pub(super) struct Arguments {
    #[command(flatten)]
    config: ConfigArguments,
}

pub(super) fn run(arguments: &Arguments) -> ExitCode {
    match arguments.config.load() {
        Ok(settings) => {
            print(&settings);
            ExitCode::SUCCESS
        }
        Err(code) => code,
    }
}

fn print(settings: &Settings) {
    println!(
        "instance {}: {} routes, {} lanes",
        settings.instance,
        settings.routes.len(),
        settings.lanes.len()
    );
    let mut total = 0;
    for (index, route) in settings.routes.iter().enumerate() {
        let pool = RouteChannel::of(settings, index).pool_size();
        total += pool.bytes;
        let message_type =
            route.message_type.as_ref().map_or("type found by discovery".to_owned(), ToString::to_string);
        println!("\nroute {}: {} ({message_type})", route.id, route.input_topic);
        for lane in &settings.lanes {
            for output in lane.outputs.iter().filter(|output| output.route == index) {
                println!("  {} -> {}", lane.name, output.topic);
            }
        }
        println!(
            "  shared memory: {} slots for samples of up to {}: {}",
            pool.slots,
            bytes(route.max_sample_bytes as u64),
            bytes(pool.bytes)
        );
    }
    println!("\nshared memory in all: {}", bytes(total));
}

/// A size as people read it.
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
