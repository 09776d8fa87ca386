//! The bridge as a package of a ROS 2 workspace: built by a real colcon, found by the real ament index, its
//! launch file run.
//!
//! `launch` is part of ROS 2 and has no other source; `tests/ros/launch` replaces it. So these tests run what
//! the launch file starts, and do not test how `ros2 launch` shows arguments and output.

use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};
use std::process::Command;

use nix::sys::signal::Signal;
use support::bed::{CRITICAL, INPUT, NONCRITICAL, SCAN};
use support::bridge::Bridge;
use support::netns::Net;
use support::peer::{Peer, Received, Sent};
use support::process::Process;

/// Reads a manifest as colcon, bloom and rosdep do, and treats its warnings as errors.
const PARSE: &str = "
import sys
from catkin_pkg.package import parse_package
warnings = []
package = parse_package(sys.argv[1], warnings=warnings)
assert not warnings, warnings
print(package.name, package.version, package.get_build_type())
";

/// Runs a launch file with arguments, as `ros2 launch` does.
const LAUNCH: &str = "
import importlib.util, sys
from launch import LaunchService
spec = importlib.util.spec_from_file_location('launch_file', sys.argv[1])
launch_file = importlib.util.module_from_spec(spec)
spec.loader.exec_module(launch_file)
service = LaunchService(argv=sys.argv[2:])
service.include_launch_description(launch_file.generate_launch_description())
sys.exit(service.run())
";

fn source() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// A Python interpreter that has a module. The system's is not always the first in the path.
fn python_with(module: &str) -> Option<&'static str> {
    let has_it = |python: &&str| {
        let import = Command::new(python).args(["-c", &format!("import {module}")]).output();
        import.is_ok_and(|import| import.status.success())
    };
    ["python3", "/usr/bin/python3"].into_iter().find(has_it)
}

fn run(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let stderr = String::from_utf8_lossy(&output.stderr);
    let printed = String::from_utf8_lossy(&output.stdout);
    assert!(output.status.success(), "{command:?}: {}\n{printed}\n{stderr}", output.status);
    printed.into_owned()
}

/// A workspace with this source tree in it.
struct Workspace {
    folder: tempfile::TempDir,
}

impl Workspace {
    /// Builds the workspace; `None` if the machine cannot, which records the test as skipped.
    fn build(test: &str) -> Option<Self> {
        let lacks = |program: &str| Command::new(program).arg("--help").output().is_err();
        let lacking = ["colcon", "cmake"].into_iter().find(|program| lacks(program));
        let module = ["colcon_ros", "colcon_metadata", "colcon_package_information", "ament_index_python"]
            .into_iter()
            .find(|module| python_with(module).is_none());
        if let Some(what) = lacking.or(module) {
            support::skip(test, &format!("{what} is not installed (make setup)"));
            return None;
        }
        let folder = tempfile::tempdir().unwrap();
        fs::create_dir(folder.path().join("src")).unwrap();
        symlink(source(), folder.path().join("src/adaptive_bridge")).unwrap();
        let workspace = Self { folder };
        let listed = run(workspace.colcon().arg("list"));
        assert_eq!(
            listed.trim(),
            "adaptive_bridge\tsrc/adaptive_bridge\t(ros.cmake)",
            "what else is a package?"
        );
        // The same features as these tests, and those that tests and examples need of dependencies, so that
        // cargo has nothing to build.
        run(workspace.colcon().args(["build", "--cmake-args", "-DCMAKE_BUILD_TYPE=Debug"]).args([
            format!("-DADAPTIVE_BRIDGE_TARGET_DIR={}", source().join("target").display()),
            "-DADAPTIVE_BRIDGE_CARGO_OPTIONS=--example;rust_peer".to_owned(),
        ]));
        Some(workspace)
    }

    fn colcon(&self) -> Command {
        let mut command = Command::new("colcon");
        command.arg("--log-base").arg(self.folder.path().join("log")).current_dir(self.folder.path());
        command
    }

    /// Where the package is installed.
    fn prefix(&self) -> PathBuf {
        self.folder.path().join("install/adaptive_bridge")
    }

    /// The shell commands that run a program as a user of the workspace does.
    fn sourced(&self, program: &str) -> String {
        format!(". {}/install/setup.sh && exec {program}", self.folder.path().display())
    }
}

#[test]
fn the_manifest_is_what_tools_of_ros_take_and_has_the_version_of_the_crate() {
    let test = "the_manifest_is_what_tools_of_ros_take_and_has_the_version_of_the_crate";
    let text = fs::read_to_string(source().join("package.xml")).unwrap();
    let manifest = roxmltree::Document::parse(&text).unwrap();
    let package = manifest.root_element();
    assert_eq!(package.attribute("format"), Some("3"));
    let says = |name: &str| {
        let element = package.children().find(|child| child.has_tag_name(name));
        element.and_then(|element| element.text()).unwrap_or_default().trim().to_owned()
    };
    assert_eq!(says("version"), env!("CARGO_PKG_VERSION"));
    assert_eq!(says("license"), env!("CARGO_PKG_LICENSE"));
    assert!(says("description").starts_with(env!("CARGO_PKG_DESCRIPTION")), "{}", says("description"));
    let Some(python) = python_with("catkin_pkg") else {
        support::skip(test, "catkin_pkg is not installed (make setup)");
        return;
    };
    let parsed = run(Command::new(python).args(["-c", PARSE]).arg(source().join("package.xml")));
    assert_eq!(parsed.trim(), format!("adaptive_bridge {} cmake", env!("CARGO_PKG_VERSION")));
}

#[test]
fn the_launch_file_of_a_built_workspace_starts_a_bridge_through_which_samples_flow() {
    let test = "the_launch_file_of_a_built_workspace_starts_a_bridge_through_which_samples_flow";
    if let Some(reason) = support::testbed_missing() {
        support::skip(test, &reason);
        return;
    }
    let Some(workspace) = Workspace::build(test) else { return };
    let prefix = workspace.prefix();
    let index = python_with("ament_index_python").unwrap();
    let asked = format!(
        "{index} -c 'from ament_index_python import *; print(get_package_share_directory(\"adaptive_bridge\"))'"
    );
    let share = run(Command::new("sh").args(["-c", &workspace.sourced(&asked)]));
    assert_eq!(Path::new(share.trim()), prefix.join("share/adaptive_bridge"));
    // The example that a launch without arguments runs exists and is valid.
    let program = prefix.join("lib/adaptive_bridge/adaptive-bridge");
    run(Command::new(&program)
        .args(["check", "--config"])
        .arg(prefix.join("share/adaptive_bridge/config/minimal.yaml")));

    let net = Net::new(&["publisher", "bridge", "critical", "slow"]);
    let bridge = Bridge::new(&format!("instance: {{instance}}\n{SCAN}"));
    let launch_file = prefix.join("share/adaptive_bridge/launch/adaptive_bridge.launch.py");
    let mut command = net.host("bridge").command("sh");
    let launch =
        format!("{index} -c \"$1\" {} config_path:={}", launch_file.display(), bridge.config().display());
    command.args(["-c", &workspace.sourced(&launch), "sh", LAUNCH]);
    // After the paths of the workspace, so that an installed `launch` takes precedence.
    command.env("PYTHONPATH", source().join("tests/ros")).env("PYTHONDONTWRITEBYTECODE", "1");
    let mut launched = Process::spawn("the launch file", command);
    let subscriber =
        |host: &str, peer: Peer, topic: &str| peer.subscriber().topic(topic).start_on(net.host(host));
    let critical = subscriber("critical", Peer::fast(), CRITICAL);
    let slow = subscriber("slow", Peer::cyclone().best_effort(), NONCRITICAL);
    let publisher = Peer::cyclone().publisher().topic(INPUT).wait_match(1).start_on(net.host("publisher"));
    critical.wait_received(50);
    slow.wait_received(3);
    let status = bridge.status();
    let processes: Vec<&str> = status["processes"]
        .as_array()
        .unwrap()
        .iter()
        .filter(|process| process["state"] == "running")
        .map(|process| process["name"].as_str().unwrap())
        .collect();
    assert_eq!(processes, ["ingress", "control", "egress-critical", "egress-noncritical"], "{status}");
    let sent: Sent = publisher.end();
    assert_eq!(sent.failed, 0, "{sent:?}");
    critical.end::<Received>().assert_sound();
    slow.end::<Received>().assert_sound();

    launched.signal(Signal::SIGINT);
    let ended = launched.wait();
    assert!(ended.success(), "{ended}: {}", launched.log());
    let left = fs::read_dir("/dev/shm").unwrap().flatten().map(|entry| entry.file_name());
    let mine = format!("ab1_{}_", bridge.instance());
    let left: Vec<_> = left.filter(|name| name.to_string_lossy().starts_with(&mine)).collect();
    assert!(left.is_empty(), "{left:?}");
}
