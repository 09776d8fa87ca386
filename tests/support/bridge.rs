//! Runs the program under test as a user does: the binary with a configuration file and arguments.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::LazyLock;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use adaptive_bridge::shm::default_root;
use serde_json::Value;
use tempfile::TempDir;

use super::netns::Host;
use super::process::Process;

/// The path of the `adaptive-bridge` binary.
pub fn program() -> &'static Path {
    static PROGRAM: LazyLock<PathBuf> = LazyLock::new(|| super::built("adaptive-bridge"));
    &PROGRAM
}

/// Asserts that a demo (`demo --json`) forwarded every critical sample, and some to the remote subscriber.
pub fn assert_demo_lost_nothing(demo: &Value) {
    let bridge = &demo["with_bridge"];
    assert!(bridge["publisher"]["written"].as_u64().unwrap() > 0, "{demo:#}");
    assert_eq!(bridge["critical"]["lost"], 0, "{demo:#}");
    assert_eq!(bridge["critical"]["received"], bridge["publisher"]["written"], "{demo:#}");
    assert!(bridge["remote"]["received"].as_u64().unwrap() > 0, "{demo:#}");
}

/// How often a process has refused something of the network for this cause, one of `NetworkRefusal`.
pub fn refused(status: &Value, process: &str, cause: &str) -> u64 {
    let processes = status["processes"].as_array().unwrap();
    let process = processes.iter().find(|found| found["name"] == process).unwrap();
    process["network_refusals"][cause].as_u64().unwrap()
}

/// One bridge: an instance name and a folder with its configuration file.
///
/// Declare it before its processes: dropping a process kills it and leaves its shared memory behind, which
/// dropping the bridge removes.
pub struct Bridge {
    instance: String,
    folder: TempDir,
}

impl Bridge {
    /// Creates a bridge without starting it. In `yaml`, `{instance}` is replaced by a unique instance name,
    /// and `{folder}` by the folder of the configuration file, which is removed with the bridge.
    pub fn new(yaml: &str) -> Bridge {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        // Of equal length, so that no name is the beginning of another one.
        let instance = format!("test_{}_{number:03}", std::process::id());
        let bridge = Bridge { instance, folder: tempfile::tempdir().unwrap() };
        bridge.write_config(yaml);
        bridge
    }

    /// Rewrites the configuration file, with the same replacements as [`Bridge::new`].
    pub fn write_config(&self, yaml: &str) {
        let folder = self.folder().display().to_string();
        let yaml = yaml.replace("{instance}", &self.instance).replace("{folder}", &folder);
        std::fs::write(self.config(), yaml).unwrap();
    }

    /// The instance name.
    pub fn instance(&self) -> &str {
        &self.instance
    }

    /// The folder of the configuration file.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// The path of the configuration file.
    pub fn config(&self) -> PathBuf {
        self.folder().join("bridge.yaml")
    }

    /// Completes a command line such as `egress --lane critical` with `--config`.
    fn complete(&self, mut command: Command, arguments: &str) -> Command {
        command.args(arguments.split_whitespace()).arg("--config").arg(self.config());
        command.env("NO_COLOR", "1");
        command
    }

    /// Starts a role on a host, with arguments such as `up`, `ingress`, `egress --lane critical`.
    pub fn start_on(&self, host: &Host, arguments: &str) -> Process {
        let command = self.complete(host.command(program()), arguments);
        Process::spawn(&format!("adaptive-bridge {arguments} on {}", host.name()), command)
    }

    /// Starts a role on this machine.
    pub fn start(&self, arguments: &str) -> Process {
        let command = self.complete(Command::new(program()), arguments);
        Process::spawn(&format!("adaptive-bridge {arguments}"), command)
    }

    /// Runs a subcommand such as `check` or `mode rviz suspended` and waits for its end.
    pub fn run(&self, arguments: &str) -> Output {
        self.complete(Command::new(program()), arguments).output().unwrap()
    }

    /// The output of `status --json`, or an error with its stderr. It reads shared memory and therefore runs
    /// outside the bridge's host.
    pub fn try_status(&self) -> Result<Value, String> {
        let output = self.run("status --json --interval-ms 50");
        let stderr = || String::from_utf8_lossy(&output.stderr).into_owned();
        if !output.status.success() {
            return Err(format!("{}: {}", output.status, stderr()));
        }
        serde_json::from_slice(&output.stdout).map_err(|error| format!("{error}: {}", stderr()))
    }

    /// The output of `status --json`; panics if it fails.
    pub fn status(&self) -> Value {
        self.try_status().unwrap_or_else(|error| panic!("status of {}: {error}", self.instance))
    }

    /// Waits until the status fulfils a condition; returns that status.
    pub fn wait_status(&self, what: &str, mut fulfilled: impl FnMut(&Value) -> bool) -> Value {
        let deadline = Instant::now() + super::patience();
        loop {
            let status = self.try_status();
            if let Ok(status) = &status
                && fulfilled(status)
            {
                return status.clone();
            }
            assert!(Instant::now() < deadline, "timed out waiting for: {what}; the last status: {status:?}");
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

impl Drop for Bridge {
    fn drop(&mut self) {
        let prefix = format!("ab1_{}_", self.instance);
        for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
            if entry.file_name().to_string_lossy().starts_with(&prefix) {
                let _ = std::fs::remove_file(entry.path());
            }
        }
        // For a configuration whose root path is not inside the bridge's folder.
        let root = default_root(None, |name| std::env::var_os(name));
        let _ = std::fs::remove_dir_all(root.join(&self.instance));
    }
}
