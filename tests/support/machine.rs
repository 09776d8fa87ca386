//! A test machine with its own systemd, in a systemd-nspawn container: this machine's files below a temporary
//! overlay; its own processes, `/dev/shm` and users; the network of a [`Host`].

use std::fmt::Write as _;
use std::fs;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};

use nix::sys::signal::Signal;
use serde_json::Value;
use tempfile::TempDir;

use super::netns::Host;
use super::process::Process;
use super::{bridge, netns, wait_for, wait_until};

/// The hierarchies in which a container with systemd needs its own control group.
const CGROUPS: [&str; 2] = ["/sys/fs/cgroup/systemd", "/sys/fs/cgroup/unified"];

/// The version 1 hierarchies with which systemd limits the resources of services. They are only used on
/// request: with `RT_GROUP_SCHED` a CPU control group has no real-time budget, so that real-time processes
/// fail in it.
const LIMITING: [&str; 3] = ["/sys/fs/cgroup/cpu", "/sys/fs/cgroup/cpuacct", "/sys/fs/cgroup/memory"];

/// The signal that makes systemd shut down in order (systemd(1): SIGRTMIN+4).
const POWER_OFF: &str = "RTMIN+4";

/// The shell script that prepares the root directory and starts systemd-nspawn. It runs in its own mount
/// namespace, which removes its mounts when it ends.
const PREPARE: &str = "\
set -e
mount -t tmpfs -o mode=755 tmpfs $1
mkdir $1/upper $1/work $1/root
mount -t overlay overlay -o lowerdir=/,upperdir=$1/upper,workdir=$1/work $1/root
od -An -N16 -tx1 /dev/urandom | tr -d ' \\n' >$1/root/etc/machine-id
rm -rf $1/root/etc/systemd/system $1/root/etc/adaptive-bridge
cp -a $2/. $1/root/
for group in $3; do mkdir -p $group; echo $$ >$group/cgroup.procs; done
exec systemd-nspawn --quiet --machine=$5 --directory=$1/root --network-namespace-path=$4 --register=no --keep-unit \
    --resolv-conf=off --timezone=off --link-journal=no --console=pipe --boot -- --unit=basic.target";

/// Returns why a test machine cannot be started here.
fn missing() -> Option<String> {
    netns::requires_root().or_else(|| {
        let is_installed =
            |program: &str| Command::new(program).arg("--version").stdout(Stdio::null()).status().is_ok();
        let lacking =
            ["systemd-nspawn", "systemd-analyze"].into_iter().find(|program| !is_installed(program));
        lacking.map(|program| format!("{program} is not installed (make setup)"))
    })
}

/// Returns why tests with test machines cannot run here.
pub fn machine_missing() -> Option<String> {
    super::testbed_missing().or_else(missing)
}

/// A running test machine. Dropping it powers it off.
pub struct Machine {
    nspawn: Process,
    leader: i32,
    cgroups: Vec<PathBuf>,
    _folder: TempDir,
}

impl Machine {
    /// Boots a machine on a host. `stage` adds files to a folder that becomes part of its root directory.
    pub fn boot(host: &Host, stage: &dyn Fn(&Path)) -> Machine {
        Self::boot_in(host, &CGROUPS, stage)
    }

    /// Like [`boot`](Self::boot), with working limits on CPU and memory.
    pub fn boot_with_limits(host: &Host, stage: &dyn Fn(&Path)) -> Machine {
        let machine = Self::boot_in(host, &[CGROUPS.as_slice(), &LIMITING].concat(), stage);
        // systemd-nspawn mounts these read-only.
        for hierarchy in LIMITING.iter().filter(|path| Path::new(path).is_dir()) {
            machine.run(&["mount", "-o", "remount,bind,rw", hierarchy]);
        }
        machine.run(&["systemctl", "daemon-reexec"]);
        machine
    }

    fn boot_in(host: &Host, hierarchies: &[&str], stage: &dyn Fn(&Path)) -> Machine {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let folder = tempfile::tempdir().unwrap();
        let [overlay, staged] = ["overlay", "staged"].map(|name| folder.path().join(name));
        fs::create_dir(&overlay).unwrap();
        fs::create_dir(&staged).unwrap();
        stage(&staged);
        let name = format!("ab-{}-{}", std::process::id(), NUMBER.fetch_add(1, Ordering::Relaxed));
        let hierarchies = hierarchies.iter().map(Path::new).filter(|path| path.is_dir());
        let cgroups: Vec<PathBuf> = hierarchies.map(|path| path.join(&name)).collect();
        let groups = cgroups.iter().fold(String::new(), |mut list, group| {
            write!(list, " {}", group.display()).unwrap();
            list
        });
        let mut command = Command::new("unshare");
        command.args(["--mount", "--propagation", "private", "sh", "-c", PREPARE, "sh"]);
        command
            .arg(&overlay)
            .arg(&staged)
            .arg(groups)
            .arg(format!("/run/netns/{}", host.namespace()))
            .arg(name);
        let nspawn = Process::spawn("systemd-nspawn", command);
        let leader = wait_for("the first process of the machine", || child_of(nspawn.pid().as_raw()));
        let machine = Machine { nspawn, leader, cgroups, _folder: folder };
        wait_until("the machine to boot", || {
            let state = machine.try_run(&["systemctl", "is-system-running"]);
            matches!(String::from_utf8_lossy(&state.stdout).trim(), "running" | "degraded")
        });
        machine
    }

    /// Makes a command that will run in the machine.
    pub fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new("nsenter");
        command
            .args(["-t", &self.leader.to_string(), "-m", "-p", "-n", "-u", "-i", "-C", "--"])
            .args(arguments);
        command.env("SYSTEMD_PAGER", "").env("NO_COLOR", "1");
        command
    }

    /// Runs a program and waits for its end, without checking its exit code.
    pub fn try_run(&self, arguments: &[&str]) -> Output {
        self.command(arguments).output().unwrap()
    }

    /// Runs a program, asserts that it succeeds, and returns its stdout.
    pub fn run(&self, arguments: &[&str]) -> String {
        let output = self.try_run(arguments);
        let stderr = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "{arguments:?}: {}\n{stderr}", output.status);
        String::from_utf8(output.stdout).unwrap()
    }

    /// Writes a file in the machine.
    pub fn write(&self, path: &str, text: &str) {
        let mut command = self.command(&["tee", path]);
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
        child.stdin.take().unwrap().write_all(text.as_bytes()).unwrap();
        assert!(child.wait().unwrap().success(), "{path} cannot be written");
    }

    /// A property of a unit, from `systemctl show`.
    pub fn property(&self, unit: &str, property: &str) -> String {
        self.run(&["systemctl", "show", "--property", property, "--value", unit]).trim().to_owned()
    }

    /// Waits until a property of a unit has a value; panics with the unit's status and log after
    /// [`patience`](super::patience).
    pub fn wait_property(&self, unit: &str, property: &str, value: &str) {
        let deadline = std::time::Instant::now() + super::patience();
        while self.property(unit, property) != value {
            if std::time::Instant::now() > deadline {
                let status = self.try_run(&["systemctl", "status", "--lines=40", unit]);
                let actual = self.property(unit, property);
                panic!(
                    "{property} of {unit} is {actual}, not {value}\n{}",
                    String::from_utf8_lossy(&status.stdout)
                );
            }
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
    }

    /// The process id of a unit's main process, inside the machine.
    pub fn main_pid(&self, unit: &str) -> String {
        self.property(unit, "MainPID")
    }

    /// The process id of a unit's main process, outside the machine.
    pub fn outer_main_pid(&self, unit: &str) -> i32 {
        let pid = self.main_pid(unit);
        let own_namespace = fs::read_link(format!("/proc/{}/ns/pid", self.leader)).unwrap();
        // Searches /proc outside the machine; the last entry of `NSpid` is the process id inside.
        let processes = fs::read_dir("/proc").unwrap().flatten().map(|entry| entry.path());
        let is_main_process = |process: &PathBuf| {
            let status = fs::read_to_string(process.join("status")).unwrap_or_default();
            let numbers = status.lines().find_map(|line| line.strip_prefix("NSpid:")).unwrap_or_default();
            numbers.split_whitespace().last() == Some(&pid)
                && fs::read_link(process.join("ns/pid")).is_ok_and(|namespace| namespace == own_namespace)
        };
        let process =
            processes.into_iter().find(is_main_process).unwrap_or_else(|| panic!("{unit} has no process"));
        process.file_name().unwrap().to_str().unwrap().parse().unwrap()
    }

    /// The output of `adaptive-bridge status --json` in the machine; `None` if the bridge does not run.
    pub fn try_status(&self) -> Option<Value> {
        let user = ["runuser", "-u", "adaptive-bridge", "--"];
        let status = ["adaptive-bridge", "status", "--json", "--interval-ms", "50"];
        let output = self.try_run(&[user.as_slice(), &status].concat());
        serde_json::from_slice(&output.stdout).ok()
    }

    /// The log entries of a unit, with all their fields.
    pub fn journal(&self, unit: &str) -> Vec<Value> {
        let lines = self.run(&["journalctl", "--output=json", "--all", "--unit", unit]);
        lines.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
    }
}

impl Drop for Machine {
    fn drop(&mut self) {
        let _ = Command::new("kill").args(["-s", POWER_OFF, &self.leader.to_string()]).status();
        let deadline = std::time::Instant::now() + super::patience();
        while self.nspawn.is_running() && std::time::Instant::now() < deadline {
            std::thread::sleep(std::time::Duration::from_millis(20));
        }
        if self.nspawn.is_running() {
            self.nspawn.signal_group(Signal::SIGKILL);
        }
        for group in &self.cgroups {
            remove_groups(group);
        }
    }
}

/// The child of a process once it is systemd.
fn child_of(pid: i32) -> Option<i32> {
    let children = fs::read_to_string(format!("/proc/{pid}/task/{pid}/children")).ok()?;
    let child: i32 = children.trim().parse().ok()?;
    // Before that it is a child of the shell, or of nspawn while it starts.
    let name = fs::read_to_string(format!("/proc/{child}/comm")).ok()?;
    (name.trim() == "systemd").then_some(child)
}

/// Removes a control group and its descendants. The kernel removes the files in them.
fn remove_groups(group: &Path) {
    for entry in fs::read_dir(group).into_iter().flatten().flatten() {
        if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
            remove_groups(&entry.path());
        }
    }
    let _ = fs::remove_dir(group);
}

/// Copies the program and its units to where a package would install them.
pub fn install(root: &Path) {
    let source = super::root().join("systemd");
    let units = root.join("usr/lib/systemd/system");
    for entry in fs::read_dir(&source).unwrap().flatten() {
        let name = entry.file_name().into_string().unwrap();
        let to = match name.as_str() {
            "sysctl.d" | "sysusers.d" | "tmpfiles.d" => root.join("usr/lib").join(&name),
            _ => units.join(&name),
        };
        fs::create_dir_all(to.parent().unwrap()).unwrap();
        if entry.path().is_dir() {
            fs::create_dir_all(&to).unwrap();
            for file in fs::read_dir(entry.path()).unwrap().flatten() {
                fs::copy(file.path(), to.join(file.file_name())).unwrap();
            }
        } else {
            fs::copy(entry.path(), to).unwrap();
        }
    }
    fs::create_dir_all(root.join("usr/bin")).unwrap();
    fs::copy(bridge::program(), root.join("usr/bin/adaptive-bridge")).unwrap();
}
