//! The program under test, run as a user runs it: its binary, a configuration file, its command line.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use adaptive_bridge::shm::default_root;
use serde_json::Value;
use tempfile::TempDir;

use super::netns::Host;
use super::process::Process;

/// The binary.
pub fn program() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_adaptive-bridge"))
}

/// One bridge: an instance name, and a folder with its configuration file.
///
/// Declare it before its processes: they are killed when they are dropped and leave their shared memory
/// behind, which is removed with the bridge.
pub struct Bridge {
    instance: String,
    folder: TempDir,
}

impl Bridge {
    /// A bridge of its own, not started yet. In `yaml`, `{instance}` becomes a name that no other bridge has,
    /// and `{folder}` the folder of the file, which is removed with the bridge.
    pub fn new(yaml: &str) -> Bridge {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let instance = format!("test_{}_{number}", std::process::id());
        let bridge = Bridge { instance, folder: tempfile::tempdir().unwrap() };
        bridge.write_config(yaml);
        bridge
    }

    /// Writes the configuration file anew, as [`Bridge::new`] does.
    pub fn write_config(&self, yaml: &str) {
        let folder = self.folder().display().to_string();
        let yaml = yaml.replace("{instance}", &self.instance).replace("{folder}", &folder);
        std::fs::write(self.config(), yaml).unwrap();
    }

    /// Its instance name.
    pub fn instance(&self) -> &str {
        &self.instance
    }

    /// Its folder.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// Its configuration file.
    pub fn config(&self) -> PathBuf {
        self.folder().join("bridge.yaml")
    }

    /// Completes a command line such as `egress --lane critical` with `--config`.
    fn complete(&self, mut command: Command, arguments: &str) -> Command {
        command.args(arguments.split_whitespace()).arg("--config").arg(self.config());
        command.env("NO_COLOR", "1");
        command
    }

    /// Starts a role on a host; `arguments` such as `up`, `ingress`, `egress --lane critical`.
    pub fn start_on(&self, host: &Host, arguments: &str) -> Process {
        let command = self.complete(host.command(program()), arguments);
        Process::spawn(&format!("adaptive-bridge {arguments} on {}", host.name()), command)
    }

    /// Starts a role on this machine.
    pub fn start(&self, arguments: &str) -> Process {
        let command = self.complete(Command::new(program()), arguments);
        Process::spawn(&format!("adaptive-bridge {arguments}"), command)
    }

    /// Runs a subcommand to its end, such as `check` or `mode rviz suspended`.
    pub fn run(&self, arguments: &str) -> Output {
        self.complete(Command::new(program()), arguments).output().unwrap()
    }

    /// What `status --json` says; an error is what it wrote instead. It reads shared memory, so it needs no
    /// host.
    pub fn try_status(&self) -> Result<Value, String> {
        let output = self.run("status --json --interval-ms 50");
        let said = || String::from_utf8_lossy(&output.stderr).into_owned();
        if !output.status.success() {
            return Err(format!("{}: {}", output.status, said()));
        }
        serde_json::from_slice(&output.stdout).map_err(|error| format!("{error}: {}", said()))
    }

    /// What `status --json` says.
    pub fn status(&self) -> Value {
        self.try_status().unwrap_or_else(|error| panic!("status of {}: {error}", self.instance))
    }

    /// Waits until the status fulfils a condition; yields it.
    pub fn wait_status(&self, what: &str, mut fulfilled: impl FnMut(&Value) -> bool) -> Value {
        let deadline = Instant::now() + super::patience();
        loop {
            let status = self.try_status();
            if let Ok(status) = &status
                && fulfilled(status)
            {
                return status.clone();
            }
            assert!(Instant::now() < deadline, "waited in vain for: {what}; the last status: {status:?}");
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
        // Where the configuration names no root below the bridge's own folder.
        let root = default_root(None, |name| std::env::var_os(name));
        let _ = std::fs::remove_dir_all(root.join(&self.instance));
    }
}
