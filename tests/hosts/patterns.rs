//! Routes by pattern, with DDS peers that do not know the bridge: topics that appear while it runs are
//! carried, excluded ones and its own outputs are not, and a killed ingress keeps the places.

use std::collections::BTreeMap;

use nix::sys::signal::Signal;
use serde_json::Value;
use support::bed::Bed;
use support::peer::{Peer, Received, Sent};
use support::process::signal;

/// Everything but what the bridge and ROS 2 themselves publish, in two places; and one explicit topic.
const CONFIG: &str = "topics:
  - {id: raw, input_topic: /camera/raw, max_sample_bytes: 65536}
  - id: any
    input_topic: /**
    exclude: [/camera/*/depth, /diagnostics, /rosout, /parameter_events]
    max_routes: 2
    max_sample_bytes: 65536
    outputs: {critical: /critical/**, noncritical: /noncritical/**}
";

/// The routes by their input topic.
fn routes(status: &Value) -> BTreeMap<String, Value> {
    let routes = status["routes"].as_array().unwrap().iter();
    routes.map(|route| (route["input_topic"].as_str().unwrap().to_owned(), route.clone())).collect()
}

fn wait_writers(bed: &Bed, topic: &str) -> Value {
    bed.bridge
        .wait_status(topic, |status| routes(status).get(topic).is_some_and(|route| route["writers"] == 1))
}

#[test]
fn topics_that_match_are_carried_as_they_appear() {
    let Some(bed) = Bed::start("topics_that_match_are_carried_as_they_appear", CONFIG) else { return };
    let publisher = |topic: &str| bed.publish(Peer::cyclone().keep_last(1000).rate_hz(100.0).hold(), topic);
    assert_eq!(routes(&bed.bridge.status()).into_keys().collect::<Vec<_>>(), ["/camera/raw"]);

    // One after the other, while the bridge runs. Both lanes have subscribers from the first sample on.
    let front = publisher("rt/camera/front/image");
    wait_writers(&bed, "/camera/front/image");
    let front_critical = bed.subscribe("critical", Peer::fast().keep_all(), "rt/critical/camera/front/image");
    let front_slow = bed.subscribe("slow", Peer::fast(), "rt/noncritical/camera/front/image");
    front.go();
    front_critical.wait_received(50);
    let excluded = Peer::cyclone().rate_hz(100.0).publisher().topic("rt/camera/front/depth");
    let excluded = excluded.start_on(bed.host("publisher"));
    let raw = publisher("rt/camera/raw");
    let left = publisher("rt/camera/left/image");
    wait_writers(&bed, "/camera/left/image");
    let left_critical =
        bed.subscribe("critical", Peer::cyclone().keep_all(), "rt/critical/camera/left/image");
    left.go();
    raw.go();
    left_critical.wait_received(50);

    // The third one finds no place, and is named with the key to raise.
    let third = Peer::cyclone().rate_hz(100.0).publisher().topic("rt/camera/rear/image");
    let third = third.start_on(bed.host("publisher"));
    let status = bed.bridge.wait_status("a topic that waits", |status| status["patterns"][0]["waiting"] == 1);
    let problems = status["problems"].to_string();
    assert!(problems.contains("/camera/rear/image") && problems.contains("max_routes"), "{problems}");
    let pattern = &status["patterns"][0];
    assert_eq!((&pattern["id"], &pattern["routes"]), (&"any".into(), &2.into()), "{pattern}");
    let before = routes(&status);
    let topics: Vec<_> = before.keys().map(String::as_str).collect();
    assert_eq!(topics, ["/camera/front/image", "/camera/left/image", "/camera/raw"], "nothing else");
    assert_eq!(before["/camera/raw"]["id"], "raw");
    assert_eq!(before["/camera/front/image"]["id"], "any.1");
    assert_eq!(before["/camera/left/image"]["id"], "any.2");

    // A name of 127 characters may wait, one of 128 may not.
    let long = [127, 128].map(|length| {
        let topic = format!("rt{:n<length$}", "/camera/");
        Peer::cyclone().rate_hz(1.0).publisher().topic(&topic).start_on(bed.host("publisher"))
    });
    bed.bridge.wait_status("a name that is too long", |status| {
        let pattern = &status["patterns"][0];
        (&pattern["waiting"], &pattern["refused"]) == (&2.into(), &1.into())
    });

    // A killed ingress keeps the places, and with them the sequence numbers and the account.
    signal(bed.pid("ingress"), Signal::SIGKILL);
    support::wait_until("a restart", || bed.pids("ingress").len() == 2);
    let received = left_critical.received();
    left_critical.wait_received(received + 100);
    let bound = |log: &str| log.matches("topic found for a place").count();
    assert_eq!(bound(&bed.up.log()), 2, "the new process gave a place anew");
    let mut sent: Vec<(&str, Sent)> = Vec::new();
    for (topic, publisher) in [("/camera/front/image", front), ("/camera/left/image", left)] {
        sent.push((topic, publisher.end()));
    }
    for (topic, sent) in &sent {
        assert_eq!(sent.failed, 0, "{sent:?}");
        bed.bridge.wait_status("the last sample at ingress", |status| {
            routes(status)[*topic]["publishers"][0]["last_sequence"].as_u64() == Some(sent.ok)
        });
    }
    excluded.end::<Sent>();
    for waiting in long.into_iter().chain([third]) {
        waiting.end::<Sent>();
    }
    raw.end::<Sent>();
    let status = bed.wait_accounted();
    let number = |value: &Value| value.as_u64().unwrap_or_else(|| panic!("{value}"));
    for (topic, sent) in &sent {
        let account = &routes(&status)[*topic]["publishers"][0];
        let before_first = number(&account["first_sequence"]) - 1;
        let reached = number(&account["received"]) + number(&account["lost_upstream"]);
        assert_eq!(before_first + reached, sent.ok, "{sent:?} {account}");
    }
    for (topic, route) in routes(&status) {
        assert_eq!(before[&topic]["id"], route["id"], "{route}");
        assert_eq!(route["whole"], true, "{route}");
        for lane in route["lanes"].as_array().unwrap() {
            assert_eq!(lane["received"], route["published"], "{topic}: {lane}");
        }
    }
    for (subscriber, topic) in
        [(front_critical, "/camera/front/image"), (left_critical, "/camera/left/image")]
    {
        let route = &routes(&status)[topic];
        let critical =
            route["lanes"].as_array().unwrap().iter().find(|lane| lane["lane"] == "critical").unwrap();
        let forwarded = critical["forwarded"].as_u64().unwrap();
        subscriber.wait_received(forwarded);
        let received: Received = subscriber.end();
        received.assert_sound();
        assert_eq!(received.received, forwarded, "{critical}");
    }
    let slow: Received = front_slow.end();
    slow.assert_sound();
    assert!(slow.received > 10, "{slow:?}");
    bed.end();
}
