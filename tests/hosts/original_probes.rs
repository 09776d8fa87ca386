//! Probes between this bridge and the nodes of the original Python package, whose publishers and
//! subscriptions are RELIABLE: in both directions each side receives the messages of the other one.

use support::bed::{Bed, SCAN};
use support::netns::Host;
use support::process::Process;
use support::ros;

/// Starts a node of the original package; `None` if rclpy is missing.
fn original(test: &str, host: &Host, side: &str) -> Option<Process> {
    if let Some(reason) = ros::missing() {
        support::skip(test, &reason);
        return None;
    }
    let mut command = host.command(ros::Release::Jazzy.python());
    command.arg(ros::original_probes()).arg(side);
    Some(Process::spawn(&format!("original {side}"), command))
}

#[test]
fn a_responder_of_the_original_answers_the_probes_of_this_bridge() {
    let test = "a_responder_of_the_original_answers_the_probes_of_this_bridge";
    let yaml = format!("{SCAN}subscribers: {{laptop: noncritical}}\n");
    let Some(bed) = Bed::start(test, &yaml) else { return };
    let Some(_responder) = original(test, bed.host("slow"), "responder") else { return };
    bed.bridge.wait_status("20 accepted responses", |status| {
        let mut subscribers = status["subscribers"].as_array().into_iter().flatten();
        status["probes"]["accepted"].as_u64() >= Some(20) && subscribers.any(|one| one["id"] == "laptop")
    });
    bed.end();
}

#[test]
fn the_responder_answers_a_bridge_of_the_original() {
    let test = "the_responder_answers_a_bridge_of_the_original";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let responder = bed.bridge.start_on(bed.host("slow"), "responder --id laptop");
    responder.wait_for_log("responder is up");
    let Some(original) = original(test, bed.host("critical"), "bridge") else { return };
    original.wait_for_line("20 responses", 0, |line| {
        let event: serde_json::Value = serde_json::from_str(line).ok()?;
        (event["received"].as_u64()? >= 20).then_some(())
    });
    bed.end();
}
