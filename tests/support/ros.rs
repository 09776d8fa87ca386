//! Paths of the ROS 2 nodes in `tests/ros`, which run on rclpy in the virtual environments that
//! `scripts/setup.sh` creates. [`Peer::rclpy`](super::peer::Peer::rclpy) starts a node.

use std::path::PathBuf;

/// A complete environment contains a copy of the list of required packages under this name.
const REQUIREMENTS: &str = "requirements.txt";

/// A release of ROS 2.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Release {
    /// With Fast DDS 2.14.
    Jazzy,
    /// With Fast DDS 3.2.
    Kilted,
}

impl Release {
    const ALL: [Self; 2] = [Self::Jazzy, Self::Kilted];

    const fn name(self) -> &'static str {
        match self {
            Self::Jazzy => "jazzy",
            Self::Kilted => "kilted",
        }
    }

    fn environment(self) -> PathBuf {
        super::target_dir().join("ros").join(self.name())
    }

    /// The Python interpreter that has rclpy.
    pub fn python(self) -> PathBuf {
        self.environment().join("bin/python")
    }

    fn is_installed(self) -> bool {
        let wanted = std::fs::read(sources().join(self.name()).with_extension("txt")).unwrap();
        std::fs::read(self.environment().join(REQUIREMENTS)).is_ok_and(|installed| installed == wanted)
    }
}

fn sources() -> PathBuf {
    super::root().join("tests/ros")
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
    let path = Release::Jazzy.environment().join("share").join(format!("{message_type}.json"));
    let text = std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()));
    let description: serde_json::Value = serde_json::from_str(&text).unwrap();
    let hashes = description["type_hashes"].as_array().unwrap();
    let hash = hashes.iter().find(|hash| hash["type_name"] == message_type).unwrap();
    hash["hash_string"].as_str().unwrap().to_owned()
}

/// Returns why a node cannot be started: rclpy is not installed, or not in the required versions.
pub fn missing() -> Option<String> {
    let release = Release::ALL.into_iter().find(|release| !release.is_installed())?;
    let path = release.environment();
    Some(format!("rclpy is not installed in {}: run `make setup` and read its output", path.display()))
}
