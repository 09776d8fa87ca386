//! Routes by pattern on a network that announces topics which do not exist: they take no place from a topic
//! with samples, and status counts them. Domain 121.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use adaptive_bridge::config::DdsNetwork;
use adaptive_bridge::dds::{Participant, ParticipantOptions, RawReader, RawWriter, ReaderQos};
use adaptive_bridge::model::{Durability, QosProfile, Reliability};
use adaptive_bridge::policy::{MAX_WAITING_TOPICS, TRIAL_MS};
use serde_json::Value;
use support::bridge::Bridge;
use support::flow::{take_numbers, write_numbers};
use support::wait_until;

const DOMAIN: u16 = 121;
const TYPE: &str = "std_msgs::msg::dds_::UInt8MultiArray_";
/// More than wait for a place at once.
const FORGED: usize = MAX_WAITING_TOPICS + 44;
const PLACES: usize = 3;

fn participant(name: &str) -> Participant {
    Participant::open(&ParticipantOptions {
        network: &DdsNetwork::of_domain(DOMAIN),
        namespace: "/patterns".into(),
        node_name: name.into(),
        graph_gid_bytes: 16,
        dscp: 0,
    })
    .unwrap()
}

/// A publisher of 100 numbered samples per second, until `end`.
struct Publisher {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<(u32, RawWriter)>,
    _participant: Participant,
}

impl Publisher {
    fn start(mut participant: Participant, topic: &str) -> Self {
        let writer = participant.create_writer(topic, TYPE, &QosProfile::CRITICAL, 1_000).unwrap();
        let stop = Arc::new(AtomicBool::new(false));
        let thread = write_numbers(writer, Duration::from_millis(10), &stop);
        Self { stop, thread, _participant: participant }
    }

    fn end(self) -> u32 {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap().0
    }
}

fn reader(participant: &mut Participant, topic: &str) -> RawReader {
    let qos = ReaderQos {
        reliability: Reliability::Reliable,
        durability: Durability::Volatile,
        depth: 100_000,
        deadline_ms: None,
    };
    participant.create_reader(topic, TYPE, &qos).unwrap()
}

fn route<'a>(status: &'a Value, topic: &str) -> Option<&'a Value> {
    status["routes"].as_array().unwrap().iter().find(|route| route["input_topic"] == topic)
}

fn count(value: &Value) -> u64 {
    value.as_u64().unwrap_or_else(|| panic!("{value}"))
}

#[test]
fn forged_topics_displace_no_topic_with_samples_and_are_counted() {
    let bridge = Bridge::new(&format!(
        "instance: {{instance}}\nros: {{domain_id: {DOMAIN}}}\n\
         topics: [{{id: camera, input_topic: /camera/**, max_routes: {PLACES}, max_sample_bytes: 1024}}]\n\
         shared_memory: {{root_path: {{folder}}/root}}\n"
    ));
    let mut up = bridge.start("up");
    bridge.wait_status("the bridge", |status| status["patterns"][0]["routes"] == 0);
    let mut subscriber = participant("subscriber");
    let flow_reader = reader(&mut subscriber, "rt/adaptive_bridge/critical/camera/flow");
    let late_reader = reader(&mut subscriber, "rt/adaptive_bridge/critical/camera/late");
    let (mut flow_numbers, mut late_numbers) = (Vec::new(), Vec::new());

    let flow = Publisher::start(participant("flow"), "rt/camera/flow");
    wait_until("samples of the topic in use", || {
        take_numbers(&flow_reader, &mut flow_numbers);
        flow_numbers.len() > 10
    });
    let began = Instant::now();
    let mut forger = participant("forger");
    let forged: Vec<RawWriter> = (0..FORGED)
        .map(|number| {
            forger
                .create_writer(&format!("rt/camera/forged_{number}"), TYPE, &QosProfile::CRITICAL, 1)
                .unwrap()
        })
        .collect();
    let status = bridge.wait_status("forged topics that are forgotten", |status| {
        let pattern = &status["patterns"][0];
        pattern["forgotten"].as_u64() > Some(20) && pattern["routes"] == PLACES
    });
    // A place that has just got its topic may have made room for one more.
    let waiting = count(&status["patterns"][0]["waiting"]) as usize;
    assert!((MAX_WAITING_TOPICS - PLACES..=MAX_WAITING_TOPICS).contains(&waiting), "{status}");
    let problems = status["problems"].to_string();
    assert!(problems.contains("max_routes") && problems.contains("/camera/forged_"), "{problems}");

    // Another participant's topic gets the next place that a trial frees, and keeps it.
    let late = Publisher::start(participant("late"), "rt/camera/late");
    wait_until("samples of the late topic", || {
        take_numbers(&late_reader, &mut late_numbers);
        late_numbers.len() > 10
    });
    let late_route = route(&bridge.status(), "/camera/late").unwrap()["id"].clone();
    bridge.wait_status("another trial", |status| count(&status["patterns"][0]["released"]) >= 3);
    let status = bridge.status();
    assert_eq!(route(&status, "/camera/flow").unwrap()["id"], "camera.1", "{status}");
    assert_eq!(route(&status, "/camera/late").unwrap()["id"], late_route, "{status}");
    let most = (PLACES - 1) as u64 * (began.elapsed().as_millis() as u64 / TRIAL_MS + 1);
    let released = count(&status["patterns"][0]["released"]);
    assert!(released <= most, "{released} changes of at most {most}");

    let (flow_sent, late_sent) = (flow.end(), late.end());
    let last = |numbers: &[u32]| numbers.last().map(|number| number + 1);
    wait_until("the last samples", || {
        take_numbers(&flow_reader, &mut flow_numbers);
        take_numbers(&late_reader, &mut late_numbers);
        last(&flow_numbers) == Some(flow_sent) && last(&late_numbers) == Some(late_sent)
    });
    // Each from the first one that the subscriber received.
    for (topic, numbers) in [("flow", &flow_numbers), ("late", &late_numbers)] {
        let wrong: Vec<_> = numbers.windows(2).filter(|two| two[1] != two[0] + 1).collect();
        assert!(wrong.is_empty(), "of {topic}: neighbours {wrong:?}; {}", bridge.status());
    }
    let status = bridge.wait_status("every sample accounted for", |status| {
        status["routes"].as_array().unwrap().iter().all(|route| {
            let lanes = route["lanes"].as_array().unwrap();
            route["whole"] == true && lanes.iter().all(|lane| lane["whole"] == true && lane["waiting"] == 0)
        })
    });
    for topic in ["/camera/flow", "/camera/late"] {
        for lane in route(&status, topic).unwrap()["lanes"].as_array().unwrap() {
            assert_eq!(lane["drops"]["no_writer"], 0, "{topic}: {lane}");
        }
    }
    drop(forged);
    assert!(up.terminate().success(), "{}", up.log());
}
