//! Paths of the ROS 2 nodes in `tests/ros`, which run on rclpy of Jazzy in the virtual environment that
//! `scripts/setup.sh` creates. [`Peer::rclpy`](super::peer::Peer::rclpy) starts a node.

use std::path::PathBuf;

/// The list of required packages; a complete environment contains a copy of it.
const REQUIREMENTS: &str = "requirements.txt";

fn environment() -> PathBuf {
    super::target_dir().join("ros/jazzy")
}

fn sources() -> PathBuf {
    super::root().join("tests/ros")
}

/// The Python interpreter that has rclpy.
pub fn python() -> PathBuf {
    environment().join("bin/python")
}

/// The Python program of a node.
pub fn node_program() -> PathBuf {
    sources().join("node.py")
}

/// The Python program of the original package's probing nodes.
pub fn original_probes() -> PathBuf {
    sources().join("original_probes.py")
}

/// The hash of a message type's definition as its ROS 2 package states it, such as
/// `sensor_msgs/msg/LaserScan`.
pub fn type_hash(message_type: &str) -> String {
    let path = environment().join("share").join(format!("{message_type}.json"));
    let text = std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let description: serde_json::Value = serde_json::from_str(&text).unwrap();
    let hashes = description["type_hashes"].as_array().unwrap();
    let hash = hashes.iter().find(|hash| hash["type_name"] == message_type).unwrap();
    hash["hash_string"].as_str().unwrap().to_owned()
}

/// Returns why a node cannot be started: rclpy is not installed, or not in the required versions.
pub fn missing() -> Option<String> {
    let wanted = std::fs::read(sources().join(REQUIREMENTS)).unwrap();
    let installed = std::fs::read(environment().join(REQUIREMENTS)).ok();
    if installed.as_ref() == Some(&wanted) {
        return None;
    }
    Some(format!(
        "rclpy is not installed in {}: run `make setup` and read its output",
        environment().display()
    ))
}
