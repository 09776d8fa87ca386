//! The ROS 2 nodes of `tests/ros`: rclpy of Jazzy in the virtual environment that `scripts/setup.sh` makes.
//! [`Peer::rclpy`](super::peer::Peer::rclpy) starts one.

use std::path::{Path, PathBuf};

/// The list of the packages; the environment has a copy of it when it is complete.
const REQUIREMENTS: &str = "requirements.txt";

fn environment() -> PathBuf {
    super::target_dir().join("ros/jazzy")
}

fn sources() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/ros")
}

/// The Python that has rclpy.
pub fn python() -> PathBuf {
    environment().join("bin/python")
}

/// The program of a node.
pub fn node_program() -> PathBuf {
    sources().join("node.py")
}

/// Why a node can't be started: rclpy is not installed, or not in the versions of the list.
pub fn missing() -> Option<String> {
    let wanted = std::fs::read(sources().join(REQUIREMENTS)).unwrap();
    let installed = std::fs::read(environment().join(REQUIREMENTS)).ok();
    if installed.as_ref() == Some(&wanted) {
        return None;
    }
    Some(format!(
        "rclpy is not installed in {}: run `make setup`, and see what it says",
        environment().display()
    ))
}
