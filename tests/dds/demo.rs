//! The demo, as a user runs it: the shipped binary with its own processes, real DDS, real shared memory, real
//! signals. What a phase must show follows from its mechanism and from how long the demo says that it stopped
//! the remote subscriber; no test depends on how fast this machine is.

use std::fs;
use std::io::Read;
use std::os::unix::fs::PermissionsExt;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use nix::sys::signal::{Signal, kill};
use nix::unistd::{Pid, geteuid};
use roxmltree::Document;
use serde_json::Value;
use tempfile::TempDir;

const BINARY: &str = env!("CARGO_BIN_EXE_adaptive-bridge");
const PATIENCE: Duration = Duration::from_secs(60);

/// A demo with a temporary folder of its own, by which its processes are found.
struct Demo {
    process: Child,
    folder: TempDir,
}

impl Demo {
    fn start(arguments: &[&str]) -> Self {
        let mut command = Command::new(BINARY);
        command.arg("demo").args(arguments);
        Self::of(command)
    }

    fn of(mut command: Command) -> Self {
        let folder = tempfile::tempdir().unwrap();
        // For the test that runs it as another user.
        fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o777)).unwrap();
        let process = command
            .env("TMPDIR", folder.path())
            .env("ROS_DOMAIN_ID", "garbage that is none of the demo's business")
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap();
        Self { process, folder }
    }

    fn pid(&self) -> Pid {
        Pid::from_raw(self.process.id() as i32)
    }

    /// Processes of the demo that are alive, with their state.
    fn processes(&self) -> Vec<(i32, char)> {
        let mark = format!("TMPDIR={}\0", self.folder.path().display()).into_bytes();
        let mut found = Vec::new();
        for entry in fs::read_dir("/proc").unwrap().flatten() {
            let Some(pid) = entry.file_name().to_str().and_then(|name| name.parse().ok()) else { continue };
            let Ok(environment) = fs::read(entry.path().join("environ")) else { continue };
            let Ok(stat) = fs::read_to_string(entry.path().join("stat")) else { continue };
            let state = stat.rsplit_once(") ").and_then(|(_, rest)| rest.chars().next()).unwrap();
            if state != 'Z' && environment.windows(mark.len()).any(|window| window == mark) {
                found.push((pid, state));
            }
        }
        found
    }

    /// Files of the demo in shared memory.
    fn shared_memory(&self) -> Vec<String> {
        let prefix = format!("ab1_demo_{}_", self.process.id());
        let names = fs::read_dir("/dev/shm").unwrap().flatten();
        names
            .filter_map(|entry| entry.file_name().into_string().ok())
            .filter(|name| name.starts_with(&prefix))
            .collect()
    }

    fn wait_until(&mut self, what: &str, mut there: impl FnMut(&Self) -> bool) {
        let give_up = Instant::now() + PATIENCE;
        while !there(self) {
            assert!(Instant::now() < give_up, "waited for {PATIENCE:?} until {what}");
            thread::sleep(Duration::from_millis(20));
        }
    }

    /// Waits for the end; exit code, stdout and stderr.
    fn end(&mut self) -> (Option<i32>, String, String) {
        let mut stdout = self.process.stdout.take().unwrap();
        let mut stderr = self.process.stderr.take().unwrap();
        let errors = thread::spawn(move || {
            let mut text = String::new();
            stderr.read_to_string(&mut text).unwrap();
            text
        });
        let mut output = String::new();
        stdout.read_to_string(&mut output).unwrap();
        let status = self.process.wait().unwrap();
        (status.code(), output, errors.join().unwrap())
    }

    fn assert_nothing_is_left(&self) {
        assert_eq!(self.processes(), [], "processes");
        assert_eq!(self.shared_memory(), Vec::<String>::new(), "shared memory");
        let files: Vec<_> = fs::read_dir(self.folder.path()).unwrap().flatten().collect();
        assert!(files.is_empty(), "temporary files: {files:?}");
    }
}

impl Drop for Demo {
    /// For a test that failed.
    fn drop(&mut self) {
        for (pid, _) in self.processes() {
            let _ = kill(Pid::from_raw(pid), Signal::SIGKILL);
        }
        let _ = self.process.wait();
    }
}

fn number(value: &Value, path: &str) -> f64 {
    value.pointer(path).and_then(Value::as_f64).unwrap_or_else(|| panic!("no number {path} in {value:#}"))
}

/// Checks the result of a demo of 8 s, in which the remote subscriber is stopped once in each phase.
fn assert_shows_what_the_bridge_is_for(stdout: &str) {
    let result: Value = serde_json::from_str(stdout).unwrap_or_else(|error| panic!("{error}: {stdout}"));
    println!("{result:#}");
    for phase in ["/without_bridge", "/with_bridge"] {
        let at = |key: &str| number(&result, &format!("{phase}{key}"));
        assert_eq!(at("/publisher/due"), 240.0);
        let published = at("/publisher/written") + at("/publisher/timed_out") + at("/publisher/skipped");
        assert_eq!(published, 240.0);
        assert_eq!(at("/critical/received") + at("/critical/lost"), 240.0);
        assert_eq!(at("/remote/stalls"), 1.0);
    }

    // While the remote subscriber is stopped the writer takes 50 scans, its history, and no more. Two more
    // are on the edges of the stall.
    let without = |key: &str| number(&result, &format!("/without_bridge{key}"));
    let stalled_s = without("/remote/stalled_s");
    assert!(stalled_s > 2.0, "stopped for {stalled_s} s only");
    let too_many = stalled_s * 30.0 - 52.0;
    assert!(without("/critical/never_written") >= too_many, "less than {too_many} never written");
    assert!(without("/critical/silence_max_ms") >= too_many / 30.0 * 1e3);
    assert!(without("/publisher/rate_hz") <= (240.0 - too_many) / 8.0 + 0.01);
    assert!(without("/publisher/timed_out") >= 1.0);
    assert!(without("/publisher/call_max_ms") >= 99.0);

    let with = |key: &str| number(&result, &format!("/with_bridge{key}"));
    assert!(with("/publisher/rate_hz") >= 29.5);
    assert_eq!(with("/publisher/timed_out"), 0.0);
    assert_eq!(with("/critical/lost_on_the_way"), 0.0);
    // 10 Hz for 8 s, of which some are lost to it in its 3 s; 20 come before that, so it must have come back.
    let remote = with("/remote/received");
    assert!((30.0..=82.0).contains(&remote), "{remote}");
    for process in ["ingress", "critical"] {
        let dropped = &result["with_bridge"]["drops"][process];
        assert_eq!(dropped, &serde_json::json!({}), "{process}");
    }
    let remote_drops = result["with_bridge"]["drops"]["noncritical"].as_object().unwrap();
    assert!(remote_drops.get("superseded").and_then(Value::as_u64).unwrap() >= 100, "{remote_drops:?}");
    assert_eq!(result["shown"], true);
}

#[test]
fn the_demo_shows_what_the_bridge_is_for_and_leaves_nothing_behind() {
    let folder = tempfile::tempdir().unwrap();
    let picture = folder.path().join("demo.svg");
    let mut demo = Demo::start(&["--seconds", "8", "--json", "--svg", picture.to_str().unwrap()]);
    let (code, stdout, stderr) = demo.end();
    assert_eq!(code, Some(0), "{stderr}");
    assert_shows_what_the_bridge_is_for(&stdout);
    assert_eq!(stderr, "");
    demo.assert_nothing_is_left();
    assert_is_a_picture_of(&stdout, &fs::read_to_string(picture).unwrap());
}

/// Checks that the picture has the figures of the result, and a curve for each phase.
fn assert_is_a_picture_of(result: &str, svg: &str) {
    let result: Value = serde_json::from_str(result).unwrap();
    let document = Document::parse(svg).unwrap_or_else(|error| panic!("{error}: {svg}"));
    let nodes = |name: &'static str| document.descendants().filter(move |node| node.has_tag_name(name));
    let texts: Vec<&str> = nodes("text").filter_map(|node| node.text()).collect();
    let [without, with] = ["without_bridge", "with_bridge"].map(|phase| &result[phase]["critical"]);
    let title = format!(
        "Critical subscriber: {} of 240 scans missed, {} with the bridge",
        without["lost"], with["lost"]
    );
    assert!(texts.contains(&title.as_str()), "{title}: {texts:?}");
    let curves: Vec<_> = nodes("polyline").collect();
    assert_eq!(curves.len(), 2);
    for (critical, curve) in [without, with].into_iter().zip(curves) {
        let silence_s = critical["silence_max_ms"].as_f64().unwrap() / 1e3;
        let figures = format!("{} of 240 scans, longest silence {silence_s:.2} s", critical["received"]);
        assert!(texts.contains(&figures.as_str()), "{figures}: {texts:?}");
        // Two points for each half second.
        let points: Vec<f64> =
            curve.attribute("points").unwrap().split([' ', ',']).map(|at| at.parse().unwrap()).collect();
        assert_eq!(points.len(), 2 * 2 * 16);
        assert!(points.iter().all(|at| (0.0..=800.0).contains(at)), "{points:?}");
    }
    assert_eq!(nodes("rect").filter(|node| node.attribute("class") == Some("stall")).count(), 2);
    assert!(svg.contains("prefers-color-scheme:dark"));
}

/// A small container: another user than root, no network but loopback, 64 MB of shared memory.
#[test]
fn the_demo_runs_as_another_user_without_a_network_and_with_64_mb_of_shared_memory() {
    let allowed =
        || Command::new("unshare").args(["--mount", "--net", "true"]).status().is_ok_and(|end| end.success());
    if !geteuid().is_root() || !allowed() {
        eprintln!(
            "SKIPPED: it takes root (and CAP_SYS_ADMIN) to become another user in namespaces of one's own"
        );
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    fs::set_permissions(folder.path(), fs::Permissions::from_mode(0o755)).unwrap();
    let binary = folder.path().join("adaptive-bridge");
    fs::copy(BINARY, &binary).unwrap();
    let mut command = Command::new("unshare");
    command.args(["--mount", "--net", "sh", "-ec", CONTAINER, "sh"]).arg(&binary);
    let mut demo = Demo::of(command);
    let (code, stdout, stderr) = demo.end();
    assert_eq!(code, Some(0), "{stderr}");
    assert_shows_what_the_bridge_is_for(&stdout);
    demo.assert_nothing_is_left();
}

const CONTAINER: &str = "
mount -t tmpfs -o size=64m,mode=1777 tmpfs /dev/shm
ip link set lo up
runuser -u nobody -- \"$1\" demo --seconds 8 --json
left=$(ls /dev/shm)
test -z \"$left\" || { echo \"left in shared memory: $left\" >&2; exit 9; }
";

#[test]
fn ctrl_c_in_either_phase_ends_at_once_with_0_and_leaves_nothing_behind() {
    for with_bridge in [false, true] {
        let mut demo = Demo::start(&["--seconds", "6"]);
        demo.wait_until("the remote subscriber is stopped", |demo| {
            let stopped = demo.processes().iter().any(|(_, state)| *state == 'T');
            stopped && demo.shared_memory().is_empty() != with_bridge
        });
        kill(demo.pid(), Signal::SIGINT).unwrap();
        let (code, stdout, stderr) = demo.end();
        assert_eq!(code, Some(0), "{stderr}");
        assert!(stdout.ends_with("Stopped. All processes and files of the demo are removed.\n"), "{stdout}");
        assert_eq!(stdout.contains("Phase 2"), with_bridge, "{stdout}");
        assert_eq!(stderr, "");
        demo.assert_nothing_is_left();
    }
}

#[test]
fn a_killed_demo_leaves_no_process_and_no_shared_memory() {
    let mut demo = Demo::start(&["--seconds", "6", "--json"]);
    demo.wait_until("the remote subscriber of the bridge is stopped", |demo| {
        demo.processes().iter().any(|(_, state)| *state == 'T') && !demo.shared_memory().is_empty()
    });
    demo.process.kill().unwrap();
    demo.wait_until("all is gone", |demo| demo.processes().is_empty() && demo.shared_memory().is_empty());
}

#[test]
fn a_dead_process_of_the_demo_is_named_with_its_log_and_the_others_are_removed() {
    let mut demo = Demo::start(&["--seconds", "6"]);
    demo.wait_until("the remote subscriber is stopped", |demo| {
        demo.processes().iter().any(|(_, state)| *state == 'T')
    });
    let stopped = demo.processes().into_iter().find(|(_, state)| *state == 'T').unwrap();
    kill(Pid::from_raw(stopped.0), Signal::SIGKILL).unwrap();
    let (code, _, stderr) = demo.end();
    assert_eq!(code, Some(1));
    assert!(stderr.contains("the remote-subscriber exited unexpectedly (signal: 9 (SIGKILL))"), "{stderr}");
    demo.assert_nothing_is_left();
}

#[test]
fn a_demo_whose_stdout_is_closed_ends_and_leaves_nothing_behind() {
    let mut demo = Demo::start(&["--seconds", "600"]);
    drop(demo.process.stdout.take());
    demo.wait_until("the demo has ended", |demo| {
        demo.processes().iter().all(|(pid, _)| *pid != demo.pid().as_raw())
    });
    assert_eq!(demo.process.wait().unwrap().code(), Some(0));
    demo.assert_nothing_is_left();
}

#[test]
fn help_does_not_show_the_demo_s_own_commands() {
    let output = Command::new(BINARY).arg("--help").output().unwrap();
    let help = String::from_utf8(output.stdout).unwrap();
    assert!(help.contains("demo") && !help.contains("demo-"), "{help}");
}
