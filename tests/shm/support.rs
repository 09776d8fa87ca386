//! Children, roots and skips for the tests of shared memory.

use std::fs;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::mpsc::{self, Receiver};
use std::time::{Duration, Instant};

use adaptive_bridge::model::{
    AgeBasis, Encapsulation, Guid, InstanceName, LaneName, MonotonicNs, RouteId, SampleHeader, SampleKey,
    SourceTimestamp,
};
use adaptive_bridge::shm::{BridgeShape, QueueLimits, RouteChannel, ShmNode};
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

/// The timeout of a test for an expected condition.
pub const PATIENCE: Duration = Duration::from_secs(60);

/// Reports that a test was not run; panics if `CI` is set.
pub fn skip(reason: &str) {
    eprintln!("SKIPPED: {reason}");
    assert!(std::env::var_os("CI").is_none(), "skipped in CI: {reason}");
}

/// A root folder for one test, with an instance name.
pub struct Place {
    folder: tempfile::TempDir,
    pub instance: InstanceName,
}

impl Place {
    pub fn new() -> Self {
        Self {
            folder: tempfile::Builder::new().prefix("ab-shm").tempdir().unwrap(),
            instance: InstanceName::try_from("test").unwrap(),
        }
    }

    pub fn root(&self) -> &Path {
        self.folder.path()
    }

    pub fn node(&self) -> ShmNode {
        ShmNode::open(self.root(), &self.instance, "test").unwrap()
    }

    /// The beginning of the names of the instance's files in /dev/shm.
    pub fn prefix(&self) -> String {
        let mut hash = 0xcbf2_9ce4_8422_2325u64;
        let folder = fs::canonicalize(self.root()).unwrap().join(self.instance.as_str());
        for &byte in folder.as_os_str().as_encoded_bytes() {
            hash = (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3);
        }
        format!("ab1_{}_{:08x}_", self.instance, (hash >> 32) as u32 ^ hash as u32)
    }

    /// The instance's files in /dev/shm.
    pub fn shm_files(&self) -> Vec<PathBuf> {
        let prefix = self.prefix();
        let mut files: Vec<_> = fs::read_dir("/dev/shm")
            .unwrap()
            .flatten()
            .filter(|entry| entry.file_name().to_string_lossy().starts_with(&prefix))
            .map(|entry| entry.path())
            .collect();
        files.sort();
        files
    }

    /// Everything below the root.
    pub fn root_files(&self) -> Vec<PathBuf> {
        let mut found = Vec::new();
        let mut folders = vec![self.root().to_owned()];
        while let Some(folder) = folders.pop() {
            for entry in fs::read_dir(folder).into_iter().flatten().flatten() {
                found.push(entry.path());
                if entry.file_type().is_ok_and(|kind| kind.is_dir()) {
                    folders.push(entry.path());
                }
            }
        }
        found.sort();
        found
    }

    pub fn assert_nothing_left(&self) {
        assert_eq!(self.shm_files(), Vec::<PathBuf>::new());
        assert_eq!(self.root_files(), Vec::<PathBuf>::new());
    }
}

pub fn route() -> RouteId {
    RouteId::try_from("scan").unwrap()
}

pub fn shape() -> BridgeShape {
    BridgeShape { lanes: vec![LaneName::critical(), LaneName::noncritical()], routes: vec![route()] }
}

/// Lane 0 must not lose a sample because the machine is busy with other tests; lane 1 may.
pub const DEEP: QueueLimits = QueueLimits { queue_depth: 8_192, max_borrowed: 8 };
pub const LANE: QueueLimits = QueueLimits { queue_depth: 64, max_borrowed: 8 };

/// A channel whose lanes both have a queue of 64.
pub fn channel(max_sample_bytes: usize) -> RouteChannel {
    RouteChannel {
        route: route(),
        max_sample_bytes,
        lanes: vec![LANE, LANE],
        max_taps: 2,
        retained_samples: 0,
        backlog_samples: 0,
    }
}

/// The channel that the children use.
pub fn deep_channel(max_sample_bytes: usize) -> RouteChannel {
    RouteChannel { lanes: vec![DEEP, LANE], ..channel(max_sample_bytes) }
}

pub fn header(sequence: u64) -> SampleHeader {
    SampleHeader {
        sequence,
        source_timestamp: SourceTimestamp(sequence << 32),
        taken_at: MonotonicNs(1),
        published_at: MonotonicNs(2),
        writer_sequence: sequence as i64,
        writer_guid: Guid([9; 16]),
        encapsulation: Encapsulation::CDR_LE,
        age_basis: AgeBasis::SOURCE,
        key: SampleKey::NONE,
    }
}

/// A payload of which every byte depends on the sequence.
pub fn payload(sequence: u64, length: usize) -> Vec<u8> {
    (0..length).map(|at| (sequence as usize).wrapping_mul(31).wrapping_add(at) as u8).collect()
}

/// A copy of this test program that runs one function of `child`; killed when dropped.
pub struct Process {
    child: Child,
    lines: Receiver<String>,
    input: Option<ChildStdin>,
}

impl Process {
    pub fn start(what: &str, place: &Place, arguments: &str) -> Self {
        Self::start_with(Command::new(std::env::current_exe().unwrap()), what, place, arguments)
    }

    pub fn start_with(mut command: Command, what: &str, place: &Place, arguments: &str) -> Self {
        let mut child = command
            .args(["child_entry", "--exact", "--nocapture", "--test-threads=1"])
            .env("AB_CHILD", what)
            .env("AB_ROOT", place.root())
            .env("AB_INSTANCE", place.instance.as_str())
            .env("AB_ARGUMENTS", arguments)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let output = BufReader::new(child.stdout.take().unwrap());
        let (sender, lines) = mpsc::channel();
        std::thread::spawn(move || {
            for line in output.lines().map_while(Result::ok) {
                // libtest writes the test's name without an end of line before the first of ours.
                if let Some((_, message)) = line.split_once("@ ")
                    && sender.send(message.to_owned()).is_err()
                {
                    return;
                }
            }
        });
        let input = child.stdin.take();
        Self { child, lines, input }
    }

    /// The next line that the child printed.
    pub fn next_line(&self) -> String {
        self.lines.recv_timeout(PATIENCE).expect("a line of the child")
    }

    pub fn expect(&self, what: &str) {
        assert_eq!(self.next_line(), what);
    }

    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    pub fn signal(&self, signal: Signal) {
        kill(Pid::from_raw(self.child.id() as i32), signal).unwrap();
    }

    /// Kills the child (SIGKILL) and reaps it.
    pub fn kill(&mut self) {
        let _ = self.child.kill();
        self.child.wait().unwrap();
    }

    /// Requests the child to end by itself and returns its last line.
    pub fn finish(mut self) -> String {
        drop(self.input.take());
        let mut last = String::new();
        while let Ok(line) = self.lines.recv_timeout(PATIENCE) {
            last = line;
        }
        assert!(self.child.wait().unwrap().success(), "the child failed");
        last
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Waits until a condition holds.
pub fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let start = Instant::now();
    while !condition() {
        assert!(start.elapsed() < PATIENCE, "not in {PATIENCE:?}: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}
