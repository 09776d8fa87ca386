//! The evaluation harness as a program: quick runs without and with the bridge, whose results are consistent;
//! an interrupted or killed harness, which leaves nothing behind.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};

use nix::sys::signal::Signal;
use serde_json::Value;
use support::process::Process;
use support::{exclusive, root, skip, testbed_missing, wait_until};
use tempfile::TempDir;

fn program() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_adaptive-bridge-eval"))
}

/// A command of the harness in the checkout, whose results go to a folder.
fn command(out: &Path, arguments: &str) -> Command {
    let mut command = Command::new(program());
    command.args(arguments.split_whitespace()).arg("--out").arg(out);
    command.arg("--bridge").arg(support::bridge::program());
    command.current_dir(root()).env("NO_COLOR", "1");
    command
}

fn run(out: &Path, arguments: &str) -> Output {
    command(out, arguments).output().unwrap()
}

/// Like [`run`], and asserts success; returns the log.
fn run_well(out: &Path, arguments: &str) -> String {
    let output = run(out, arguments);
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{arguments}: {}\n{stderr}", output.status);
    stderr
}

/// Creates a folder; `None` if the machine lacks the requirements, which records the test as skipped.
fn folder(test: &str) -> Option<TempDir> {
    match testbed_missing() {
        Some(reason) => {
            skip(test, &reason);
            None
        }
        None => Some(tempfile::tempdir().unwrap()),
    }
}

fn docker(arguments: &str) -> std::io::Result<Output> {
    Command::new("docker").args(arguments.split_whitespace()).output()
}

/// Like [`folder`], for a test that also needs the Docker Engine.
fn folder_with_docker(test: &str) -> Option<TempDir> {
    if !docker("version").is_ok_and(|output| output.status.success()) {
        skip(test, "the Docker Engine does not answer");
        return None;
    }
    folder(test)
}

/// What a harness with this process id has on the machine: hosts, folders, shared memory.
fn traces(pid: i32) -> Vec<String> {
    let mut found = Vec::new();
    for (folder, prefix) in [
        (PathBuf::from("/run/netns"), format!("abe-{pid}-")),
        (std::env::temp_dir(), format!("abe-{pid}-")),
        (PathBuf::from("/dev/shm"), format!("ab1_abe_{pid}_")),
    ] {
        let names = fs::read_dir(folder).into_iter().flatten().flatten();
        let names = names.filter_map(|entry| entry.file_name().into_string().ok());
        found.extend(names.filter(|name| name.starts_with(&prefix)));
    }
    found
}

/// The folder of a run.
struct Run {
    folder: PathBuf,
    manifest: Value,
}

impl Run {
    fn read(out: &Path, name: &str) -> Run {
        let folder = out.join("runs").join(name);
        let text = fs::read_to_string(folder.join("manifest.json")).unwrap();
        Run { folder, manifest: serde_json::from_str(&text).unwrap() }
    }

    fn time(&self, key: &str) -> u64 {
        self.manifest[key].as_u64().unwrap()
    }

    /// The rows of a file, by the names of the columns.
    fn rows(&self, file: &str) -> Vec<BTreeMap<String, String>> {
        let mut reader = csv::Reader::from_path(self.folder.join(file)).unwrap();
        reader.deserialize().map(|row| row.unwrap_or_else(|error| panic!("{file}: {error}"))).collect()
    }

    /// A column of numbers.
    fn numbers(&self, file: &str, column: &str) -> Vec<u64> {
        self.rows(file).iter().map(|row| row[column].parse().unwrap()).collect()
    }

    fn endpoint(&self, name: &str) -> &Value {
        let endpoints = self.manifest["endpoints"].as_array().unwrap();
        endpoints.iter().find(|endpoint| endpoint["name"] == name).unwrap()
    }

    /// Asserts that the page of the results documents every key and every column.
    fn assert_documented(&self) {
        let page = include_str!("../../../docs/eval-results.md");
        let documented = |name: &str| page.contains(&format!("`{name}`"));
        let keys = |value: &Value| value.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
        for key in keys(&self.manifest) {
            let nested = ["machine", "software"].contains(&key.as_str());
            let list = ["endpoints", "links", "ports", "problems", "command_line"].contains(&key.as_str());
            let named = if list { format!("{key}[]") } else { key.clone() };
            assert!(nested || documented(&named), "{key}");
            for inner in if nested { keys(&self.manifest[&key]) } else { Vec::new() } {
                assert!(documented(&format!("{key}.{inner}")), "{key}.{inner}");
            }
        }
        for list in ["endpoints", "links"] {
            for key in keys(&self.manifest[list][0]) {
                assert!(documented(&key) || documented(&format!("{key}[]")), "{list}[].{key}");
            }
        }
        for file in fs::read_dir(&self.folder).unwrap() {
            let path = file.unwrap().path();
            if path.extension().is_some_and(|extension| extension == "csv") {
                let mut reader = csv::ReaderBuilder::new().comment(Some(b'#')).from_path(&path).unwrap();
                for column in reader.headers().unwrap() {
                    assert!(documented(column), "{column} of {}", path.display());
                }
            }
        }
    }

    /// Asserts that each file agrees with the summaries of the programs and with the window.
    fn assert_consistent(&self) {
        let manifest = &self.manifest;
        assert_eq!((&manifest["format"], &manifest["problems"]), (&1.into(), &Value::Array(Vec::new())));
        let (begin, end) = (self.time("begin_ns"), self.time("end_ns"));
        let duration_s = manifest["duration_s"].as_f64().unwrap();
        assert_eq!(end - begin, (duration_s * 1e9) as u64);

        let attempts = self.numbers("publisher.csv", "seq");
        let summary = &self.endpoint("publisher")["summary"];
        assert_eq!(summary["attempted"], attempts.len());
        assert_eq!(attempts, (0..attempts.len() as u64).collect::<Vec<_>>());
        let sent = self.numbers("publisher.csv", "time_ns");
        assert!(sent[0] < begin && *sent.last().unwrap() >= end - 1_000_000_000, "the window is covered");
        let ok: u64 = self.numbers("publisher.csv", "ok").iter().sum();
        assert_eq!(summary["ok"], ok);

        for subscriber in ["critical", "slow"] {
            let file = format!("{subscriber}.csv");
            let summary = &self.endpoint(subscriber)["summary"];
            let received = self.rows(&file);
            let distinct: BTreeSet<&String> = received.iter().map(|row| &row["seq"]).collect();
            assert_eq!(summary["received"], distinct.len(), "{subscriber}");
            assert!(!received.is_empty(), "{subscriber} has received nothing");
            for row in &received {
                let [seq, time, latency] =
                    ["seq", "time_ns", "latency_ns"].map(|key| row[key].parse::<u64>().unwrap());
                assert_eq!(time - latency, sent[seq as usize], "{file}: {row:?}");
            }
        }

        let events = self.rows("events.csv");
        let bounds: Vec<_> = events.iter().filter(|row| row["subject"].is_empty()).collect();
        assert_eq!(bounds.iter().map(|row| row["event"].as_str()).collect::<Vec<_>>(), ["begin", "end"]);
        for file in ["wire.csv", "rtps.csv", "kernel.csv", "processes.csv"] {
            let times = self.numbers(file, "time_ns");
            assert!(times.is_sorted() && times[0] < begin && *times.last().unwrap() > begin, "{file}");
        }
        for port in ["publisher", "critical", "slow"] {
            let wire = self.rows("wire.csv");
            let bytes =
                wire.iter().filter(|row| row["port"] == port).map(|row| row["to_host_bytes"].parse::<u64>());
            let bytes: Vec<u64> = bytes.map(Result::unwrap).collect();
            assert!(bytes.is_sorted() && bytes.first() < bytes.last(), "{port}: {bytes:?}");
        }
    }
}

const BASELINE: &str = "baseline_strong.cyclone.as-run.netns.reassembling.r1";
const BRIDGE: &str = "bridge_strong.fast.as-printed.netns.plain.r1";

#[test]
fn quick_runs_without_and_with_the_bridge_have_consistent_results_and_are_not_made_again() {
    let test = "quick_runs_without_and_with_the_bridge_have_consistent_results_and_are_not_made_again";
    let Some(out) = folder(test) else { return };
    let _exclusive = exclusive();
    let out = out.path();
    let baseline =
        "run baseline_strong --quick --library cyclone --reading as-run --switch reassembling --seed 3";
    run_well(out, baseline);
    let run_of = |name: &str| Run::read(out, name);
    let made = run_of(BASELINE);
    made.assert_consistent();
    let manifest = &made.manifest;
    for (key, value) in [
        ("variant", "baseline"),
        ("level", "strong"),
        ("library", "cyclone"),
        ("reading", "as-run"),
        ("bed", "netns"),
        ("switch", "reassembling"),
    ] {
        assert_eq!(manifest[key], value, "{key}");
    }
    let link = &manifest["links"][0]["impairment"];
    assert_eq!((&manifest["links"][0]["name"], &link["loss_good"]), (&"slow<-publisher".into(), &0.5.into()));
    assert!(link["lost"].as_u64() > Some(0), "{link}");
    // Packets lost before the switch leave it with incomplete datagrams.
    assert_eq!(manifest["links"][0]["before_switch"], true);
    let kernel = made.rows("kernel.csv");
    let held = kernel.iter().filter(|row| row["host"] == "switch").map(|row| &row["fragment_memory_bytes"]);
    assert!(held.clone().any(|bytes| bytes != "0"), "{held:?}");
    assert!(manifest["software"]["peer"].as_str().unwrap().starts_with("Cyclone DDS"), "{manifest}");

    run_well(out, "run bridge_strong --quick --seed 3 --switch plain");
    let made = run_of(BRIDGE);
    made.assert_consistent();
    made.assert_documented();
    assert_eq!((&made.manifest["classifier"], &made.manifest["seed"]), (&true.into(), &3.into()));
    assert_eq!(made.endpoint("slow")["lane"], "noncritical");
    let status = fs::read_to_string(made.folder.join("status.jsonl")).unwrap();
    let status: Vec<Value> = status.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert!(status.len() >= 8, "{} lines of status", status.len());
    let last = &status.last().unwrap()["status"];
    assert_eq!((&last["routes"][0]["id"], &last["subscribers"][0]["id"]), (&"scan".into(), &"slow".into()));
    let processes: BTreeSet<String> =
        made.rows("processes.csv").into_iter().map(|row| row["process"].clone()).collect();
    for process in ["up", "ingress", "control", "egress-critical", "egress-noncritical", "responder-slow"] {
        assert!(processes.contains(process), "{process} in {processes:?}");
    }

    // A finished run is not repeated, and a run with other settings is refused for the same folder.
    let before = fs::metadata(made.folder.join("manifest.json")).unwrap().modified().unwrap();
    let stderr = run_well(out, "run bridge_strong --quick --seed 3 --switch plain");
    assert!(stderr.contains("0 finished, 1 already in the results, 0 failed"), "{stderr}");
    assert_eq!(fs::metadata(made.folder.join("manifest.json")).unwrap().modified().unwrap(), before);
    for (arguments, differs) in [("--quick --seed 4", "--seed"), ("--seed 3", "--quick")] {
        let output = run(out, &format!("run bridge_strong --switch plain {arguments}"));
        let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(1), "{stderr}");
        assert!(stderr.contains(&format!("other settings ({differs})")), "{stderr}");
    }
    assert!(!out.join(".partial").exists() && !out.join("failed").exists());
}

#[test]
fn a_run_over_a_trace_keeps_it_and_says_what_each_of_its_rows_lost() {
    let test = "a_run_over_a_trace_keeps_it_and_says_what_each_of_its_rows_lost";
    let Some(out) = folder(test) else { return };
    let _exclusive = exclusive();
    // A scenario of one's own, with its trace beside it.
    let own = tempfile::tempdir().unwrap();
    let scenarios = root().join("config/scenarios");
    for file in ["bridge_drive.yaml", "drive_away_and_back.csv"] {
        fs::copy(scenarios.join(file), own.path().join(file)).unwrap();
    }
    let arguments = format!("run {}/bridge_drive.yaml --quick --backend nfqueue", own.path().display());
    run_well(out.path(), &arguments);
    let made = Run::read(out.path(), "bridge_drive.fast.none.netns.plain.r1");
    made.assert_consistent();
    made.assert_documented();
    let trace = own.path().join("drive_away_and_back.csv");
    let of_file = fs::read_to_string(&trace).unwrap();
    let links = made.manifest["links"].as_array().unwrap();
    assert_eq!(links.len(), 2);
    for (link, direction) in links.iter().zip(["forward", "return"]) {
        let file = format!("trace-slow-{direction}.csv");
        assert_eq!(fs::read_to_string(made.folder.join(&file)).unwrap(), of_file);
        let did = &link["impairment"];
        let (played, rows) = (&did["trace"], did["trace"]["rows"].as_array().unwrap());
        assert_eq!((&played["file"], &played["repeat"], rows.len()), (&file.into(), &true.into(), 120));
        // 240 s in 20: two rounds of 10 s each, and what is behind the window.
        assert_eq!((&played["speed"], &played["length_s"]), (&12.0.into(), &10.0.into()));
        assert!(played["round"].as_u64() >= Some(2), "{played}");
        let sum = |key: &str| rows.iter().map(|row| row[key].as_u64().unwrap()).sum::<u64>();
        assert_eq!((Some(sum("judged")), Some(sum("lost"))), (did["judged"].as_u64(), did["lost"].as_u64()));
        let number = |key: &str| did[key].as_f64().unwrap();
        let expected: f64 =
            rows.iter().map(|row| row["judged"].as_f64().unwrap() * row["loss"].as_f64().unwrap()).sum();
        assert!((number("lost_expected") - expected).abs() < 1e-6, "{did}");
        let off = (number("loss") - number("loss_expected")).abs();
        assert!(sum("lost") > 0 && off <= 5.0 * number("loss_standard_error"), "{did}");
        // Row 60 is the farthest and row 0 the nearest.
        assert_eq!((&rows[60]["loss"], &rows[0]["loss"]), (&0.5778.into(), &0.0.into()));
        assert_eq!(rows[0]["lost"], 0);
    }
    let rows = made.rows("links.csv");
    let of_link = rows.iter().filter(|row| row["link"] == "slow<-bridge" && row["state"] == "on");
    let places: BTreeSet<&String> = of_link.map(|row| &row["trace_row"]).collect();
    assert!(places.len() > 5, "once a second a row: {places:?}");

    // Another trace is another run.
    fs::write(&trace, of_file.replace("0.5778", "0.6")).unwrap();
    let output = run(out.path(), &arguments);
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && stderr.contains("other settings (a trace of a link)"), "{stderr}");
    fs::write(&trace, of_file.replace("0.5778", "57.78")).unwrap();
    let output = run(out.path(), &arguments);
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    let mistake = "drive_away_and_back.csv:65: loss is '57.78', but must be 0 to 1 (a share, not percent)";
    assert!(!output.status.success() && stderr.contains(mistake), "{stderr}");
}

#[test]
fn quick_runs_on_containers_have_consistent_results_and_leave_no_container() {
    let test = "quick_runs_on_containers_have_consistent_results_and_leave_no_container";
    let Some(out) = folder_with_docker(test) else { return };
    let _exclusive = exclusive();
    let mut command = command(out.path(), "run baseline_mild bridge_mild --quick --bed docker");
    let harness = command.stderr(Stdio::piped()).spawn().unwrap();
    let pid = harness.id() as i32;
    let output = harness.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let runs = fs::read_dir(out.path().join("runs")).unwrap();
    let names: Vec<String> = runs.map(|run| run.unwrap().file_name().into_string().unwrap()).collect();
    assert_eq!(names.len(), 2, "{names:?}");
    for name in &names {
        let run = Run::read(out.path(), name);
        run.assert_consistent();
        assert_eq!(run.manifest["bed"], "docker");
    }
    let images = "images --format {{.Repository}}";
    for list in ["ps --all --format {{.Names}}", "network ls --format {{.Name}}", images] {
        let left = String::from_utf8(docker(list).unwrap().stdout).unwrap();
        assert!(!left.contains(&format!("abe-{pid}-")), "{left}");
    }
    assert_eq!(traces(pid), Vec::<String>::new());
}

/// A run of the bridge that is in its measured window.
fn start_long(out: &Path) -> Process {
    let harness = Process::spawn("the harness", command(out, "run bridge_strong"));
    let publisher = out.join(".partial/publisher.csv");
    wait_until("samples of the run", || {
        fs::read_to_string(&publisher).is_ok_and(|text| text.lines().count() > 5)
    });
    assert!(!traces(harness.pid().as_raw()).is_empty());
    harness
}

#[test]
fn a_harness_that_is_interrupted_leaves_nothing() {
    let Some(out) = folder("a_harness_that_is_interrupted_leaves_nothing") else { return };
    let _exclusive = exclusive();
    let mut harness = start_long(out.path());
    let pid = harness.pid().as_raw();
    harness.signal(Signal::SIGINT);
    let status = harness.wait();
    assert_eq!(status.code(), Some(1), "{}", harness.log());
    assert!(harness.log().contains("interrupted"), "{}", harness.log());
    assert_eq!(traces(pid), Vec::<String>::new());
    assert!(!out.path().join(".partial").exists());
    assert_eq!(fs::read_dir(out.path().join("runs")).unwrap().count(), 0);
}

#[test]
fn what_a_harness_that_is_killed_leaves_is_removed_by_the_next() {
    let Some(out) = folder("what_a_harness_that_is_killed_leaves_is_removed_by_the_next") else { return };
    let _exclusive = exclusive();
    let mut harness = start_long(out.path());
    let pid = harness.pid().as_raw();
    // A second one has to wait for its turn.
    let output = run(out.path(), "run baseline_clean --quick");
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!output.status.success() && stderr.contains("another harness writes into"), "{stderr}");

    harness.kill9();
    assert!(!traces(pid).is_empty(), "a killed harness can't clean up");
    let stderr = run_well(out.path(), "run baseline_clean --quick");
    assert!(stderr.contains("removed the leftovers of a harness that no longer runs"), "{stderr}");
    assert_eq!(traces(pid), Vec::<String>::new());
    Run::read(out.path(), "baseline_clean.fast.none.netns.plain.r1").assert_consistent();
    assert!(!out.path().join(".partial").exists());
}

#[test]
fn a_run_that_fails_is_kept_with_its_reason_and_the_next_is_made() {
    let Some(out) = folder("a_run_that_fails_is_kept_with_its_reason_and_the_next_is_made") else { return };
    let _exclusive = exclusive();
    // A subscriber of the right name that ends at once.
    let peers = out.path().join("peers");
    fs::create_dir(&peers).unwrap();
    std::os::unix::fs::symlink("/bin/false", peers.join("fast_peer")).unwrap();
    let built = root().join("tests/peers/build/cyclone_peer");
    std::os::unix::fs::symlink(built, peers.join("cyclone_peer")).unwrap();
    let peers = peers.display();
    let arguments = format!("run baseline_clean --quick --library fast,cyclone --peers {peers}");
    let output = run(out.path(), &arguments);
    let stderr = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("1 finished, 0 already in the results, 1 failed"), "{stderr}");
    let failed = out.path().join("failed/baseline_clean.fast.none.netns.plain.r1");
    let reason = fs::read_to_string(failed.join("reason.txt")).unwrap();
    assert!(reason.contains("ended during the run"), "{reason}");
    assert!(failed.join("scenario.yaml").exists());
    Run::read(out.path(), "baseline_clean.cyclone.none.netns.plain.r1").assert_consistent();
}

#[test]
fn wrong_command_lines_are_said_before_anything_is_made() {
    let out = tempfile::tempdir().unwrap();
    let listed = Command::new(program()).arg("list").current_dir(root()).output().unwrap();
    let listed = String::from_utf8(listed.stdout).unwrap();
    for name in ["baseline_clean", "bridge_strong", "bridge_toggle", "bridge_ablation"] {
        assert!(listed.lines().any(|line| line.starts_with(name)), "{listed}");
    }
    for (arguments, code, message) in [
        ("run nothing_of_the_kind", 1, "no scenario 'nothing_of_the_kind'"),
        ("run /nowhere/a.yaml", 1, "/nowhere/a.yaml"),
        ("run baseline_clean --peers /nowhere", 1, "fast_peer is not in /nowhere"),
        ("run", 2, "required"),
        ("run baseline_clean --pin critical", 2, "must be a host"),
        ("run baseline_clean --repeat 0", 2, "--repeat"),
        ("matrix --scenarios /nowhere", 1, "/nowhere"),
    ] {
        let output = run(out.path(), arguments);
        let error = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!(output.status.code(), Some(code), "{arguments}: {error}");
        assert!(error.contains(message), "{arguments}: {error}");
    }
}

mod long {
    use super::*;

    /// The longest time in the measured window in which the critical subscriber received nothing.
    fn longest_silence_ns(run: &Run) -> u64 {
        let (begin, end) = (run.time("begin_ns"), run.time("end_ns"));
        let mut times = run.numbers("critical.csv", "time_ns");
        times.retain(|time| (begin..end).contains(time));
        times.extend([begin, end]);
        times.sort_unstable();
        times.windows(2).map(|pair| pair[1] - pair[0]).max().unwrap()
    }

    /// Runs of half a minute on containers, with all other times as in the experiments.
    #[test]
    fn on_containers_a_lossy_subscriber_silences_the_critical_one_only_without_the_bridge() {
        let test = "on_containers_a_lossy_subscriber_silences_the_critical_one_only_without_the_bridge";
        let Some(out) = folder_with_docker(test) else { return };
        let _exclusive = exclusive();
        let own = tempfile::tempdir().unwrap();
        let names = ["baseline_strong", "bridge_strong"];
        let mut arguments = "run --bed docker --library cyclone --reading as-run".to_owned();
        for name in names {
            let scenario = fs::read_to_string(root().join(format!("config/scenarios/{name}.yaml"))).unwrap();
            assert!(scenario.contains("duration_s: 180"), "{scenario}");
            let file = own.path().join(format!("{name}.yaml"));
            // As in the paper: a reader that keeps all samples does not lose what waits while it is not run.
            let scenario = scenario.replace("duration_s: 180", "duration_s: 30");
            fs::write(&file, scenario + "workload: {critical_history: keep_all}\n").unwrap();
            arguments += &format!(" {}", file.display());
        }
        run_well(out.path(), &arguments);
        let made = fs::read_dir(out.path().join("runs")).unwrap();
        let made: Vec<_> = made.map(|run| run.unwrap().file_name().into_string().unwrap()).collect();
        // Docker's bridge is the one switch or the other, as the machine has it.
        let runs = names.map(|name| {
            let of_scenario: Vec<_> = made.iter().filter(|run| run.starts_with(name)).collect();
            assert_eq!(of_scenario.len(), 1, "{made:?}");
            Run::read(out.path(), of_scenario[0])
        });
        for run in &runs {
            run.assert_consistent();
            run.assert_documented();
        }
        let [baseline, bridge] = &runs;
        let silences = runs.each_ref().map(longest_silence_ns);
        assert!(silences[0] > 5 * silences[1], "{silences:?} ns");
        let of_bridge = |name: &str, key: &str| bridge.endpoint(name)["summary"][key].clone();
        assert_eq!(of_bridge("critical", "received"), of_bridge("publisher", "ok"));
        let attempted = |run: &Run| run.endpoint("publisher")["summary"]["attempted"].as_u64().unwrap();
        assert!(attempted(baseline) < attempted(bridge), "the publisher waits without the bridge");
    }
}
