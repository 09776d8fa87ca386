//! What the unit tests of ingress, the lanes and control share: a role with real shared memory.

use std::time::{Duration, Instant};

use super::place::Place;
use super::reload::ReloadRequests;
use super::role::Role;
use crate::config::{self, Scheduling, Settings};
use crate::shm::ProcessRole;

pub const TYPE: &str = "std_msgs::msg::dds_::UInt8MultiArray_";
pub const SCAN: &str = "topics: [{id: scan, input_topic: /scan}]";

/// Opens a role with the topics and lanes of `yaml`, and returns it after its folder, which is dropped last
/// then: the role removes its files in shared memory by what is there. Each test has a domain of its own,
/// because they run at the same time.
pub fn open(
    process: ProcessRole,
    name: &'static str,
    domain_id: u16,
    yaml: &str,
) -> (tempfile::TempDir, Role, Settings) {
    let folder = tempfile::tempdir().unwrap();
    let text = format!(
        "instance: {name}_{}_{domain_id}\nros: {{domain_id: {domain_id}}}\n\
         shared_memory: {{root_path: {}}}\n{yaml}\n",
        std::process::id(),
        folder.path().display()
    );
    let settings =
        config::parse(&text, "f.yaml", &|_| None).unwrap_or_else(|error| panic!("{text}\n{error}"));
    let read = settings.clone();
    let reloads = ReloadRequests::on_signal(move |_| Ok(read.clone().into())).unwrap();
    let place = Place::take(&settings, reloads, name, &Scheduling::default()).unwrap();
    let role = Role::open(place, process);
    (folder, role, settings)
}

pub fn wait_until(what: &str, mut fulfilled: impl FnMut() -> bool) {
    let give_up = Instant::now() + Duration::from_secs(30);
    while !fulfilled() {
        assert!(Instant::now() < give_up, "{what}");
        std::thread::sleep(Duration::from_millis(1));
    }
}
