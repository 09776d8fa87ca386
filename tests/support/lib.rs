//! Shared support of the integration tests: hosts, peers on several DDS libraries, and the bridge. Nothing is
//! mocked.
//!
//! A test waits for a condition with the timeout [`patience`] and then asserts; it never asserts a maximum
//! time. A test whose requirements the machine does not meet calls [`skip`] and returns, so that `make test`
//! lists it.

#![allow(missing_docs, reason = "names of RTPS, and fields of what the peers print")]

pub mod bed;
pub mod bridge;
pub mod cpu_delay;
pub mod flow;
pub mod forger;
pub mod impairment;
pub mod machine;
pub mod netns;
pub mod pacer;
pub mod peer;
pub mod process;
pub mod prometheus;
pub mod ros;
pub mod rtps;
#[cfg(all(target_os = "linux", target_arch = "x86_64"))]
pub mod threads;
pub mod visitors;

use std::cell::Cell;
use std::fmt::Display;
use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use nix::fcntl::{Flock, FlockArg};

/// The timeout of a test for an expected condition: 30 s, or `ADAPTIVE_BRIDGE_TEST_PATIENCE_S`.
pub fn patience() -> Duration {
    let seconds = std::env::var("ADAPTIVE_BRIDGE_TEST_PATIENCE_S").ok().and_then(|text| text.parse().ok());
    Duration::from_secs(seconds.unwrap_or(30))
}

/// Polls until `probe` returns a value; panics with `what` after [`patience`].
pub fn wait_for<T>(what: impl Display, mut probe: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + patience();
    loop {
        if let Some(value) = probe() {
            return value;
        }
        assert!(Instant::now() < deadline, "timed out after {:?} waiting for: {what}", patience());
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// Like [`wait_for`], for a condition.
pub fn wait_until(what: impl Display, mut condition: impl FnMut() -> bool) {
    wait_for(what, || condition().then_some(()));
}

/// A callback of a participant that holds up its receiving thread while `hold` is locked.
pub fn waits_for(hold: &Arc<Mutex<()>>) -> impl FnMut() -> bool + Send + 'static {
    let hold = Arc::clone(hold);
    move || {
        drop(hold.lock());
        false
    }
}

/// The root of this source tree.
pub fn root() -> &'static Path {
    const SUPPORT: &str = env!("CARGO_MANIFEST_DIR");
    Path::new(SUPPORT.strip_suffix("/tests/support").unwrap_or(SUPPORT))
}

/// The build directory of this source tree.
fn target_dir() -> PathBuf {
    root().join("target")
}

/// The path of a program of the workspace, in the build profile of the running test. cargo builds the
/// programs of the test's own package before the test; those of other packages `make peers` builds.
pub fn built(program: &str) -> PathBuf {
    // target/debug/deps/TEST-HASH
    let test = std::env::current_exe().unwrap();
    let path = test.ancestors().nth(2).unwrap().join(program);
    assert!(path.exists(), "{} is not built: run `make peers`", path.display());
    path
}

/// Records that `test` is skipped on this machine, and why. The caller then returns.
///
/// `make test` prints the list of skipped tests at its end. Panics if `CI` is set, where no test may be
/// skipped.
pub fn skip(test: &str, reason: &str) {
    let ci = std::env::var_os("CI").is_some_and(|value| !value.is_empty());
    skip_into(&target_dir().join("skipped.txt"), ci, test, reason);
}

/// Like [`skip`], with the list file and whether `CI` is set as arguments.
pub fn skip_into(list: &Path, ci: bool, test: &str, reason: &str) {
    assert!(!ci, "{test} cannot run here ({reason}), and no test may be skipped if CI is set");
    eprintln!("SKIPPED {test}: {reason}");
    if let Some(folder) = list.parent() {
        fs::create_dir_all(folder).unwrap();
    }
    let mut file = OpenOptions::new().create(true).append(true).open(list).unwrap();
    writeln!(file, "{test}: {reason}").unwrap();
}

/// Repeats a check that compares rates or ages until it succeeds, three times at most. Another program on
/// the machine can delay the samples of one flow; a fault of the bridge is there each time.
pub fn attempts(mut check: impl FnMut() -> Result<(), String>) {
    for number in 1.. {
        match check() {
            Ok(()) => return,
            Err(error) if number < 3 => eprintln!("attempt {number}: {error}"),
            Err(error) => panic!("attempt {number}: {error}"),
        }
    }
}

/// Returns why tests with several hosts cannot run on this machine: no permission to create network
/// namespaces, or a peer that is not built.
pub fn testbed_missing() -> Option<String> {
    netns::requires_root().or_else(peer::missing)
}

/// The tests that share the machine at most. Most of them wait: they use a tenth of two CPUs.
const SHARED_TESTS: usize = 3;

thread_local! {
    /// Whether this test has the machine for itself.
    static IS_EXCLUSIVE: Cell<bool> = const { Cell::new(false) };
}

/// The machine for one test alone, among all test programs of this source tree.
pub struct Exclusive(#[allow(dead_code, reason = "holds the lock")] Flock<File>);

/// A part of the machine: three tests have one at the same time.
pub struct Shared(#[allow(dead_code, reason = "holds the locks")] [Flock<File>; 2]);

fn lock_file(name: &str) -> File {
    fs::create_dir_all(target_dir()).unwrap();
    File::create(target_dir().join(name)).unwrap()
}

fn lock(name: &str, how: FlockArg) -> Flock<File> {
    Flock::lock(lock_file(name), how).map_err(|(_, error)| error).unwrap()
}

/// Waits until no other test uses the machine: for a test that needs most of it, or that measures. Taken
/// before [`bed::Bed`] or [`netns::Net`], which otherwise take a part ([`shared`]).
///
/// With it, such tests run one after another under any test runner, with any number of threads.
pub fn exclusive() -> Exclusive {
    // While this test waits, none that shares the machine starts.
    let _entrance = lock("testbed.entrance.lock", FlockArg::LockExclusive);
    let lock = lock("testbed.lock", FlockArg::LockExclusive);
    IS_EXCLUSIVE.set(true);
    Exclusive(lock)
}

impl Drop for Exclusive {
    fn drop(&mut self) {
        IS_EXCLUSIVE.set(false);
    }
}

/// Waits for a part of the machine; `None` if this test has it for itself.
pub fn shared() -> Option<Shared> {
    if IS_EXCLUSIVE.get() {
        return None;
    }
    loop {
        for place in 0..SHARED_TESTS {
            let file = lock_file(&format!("testbed.{place}.lock"));
            if let Ok(place) = Flock::lock(file, FlockArg::LockExclusiveNonblock) {
                let _entrance = lock("testbed.entrance.lock", FlockArg::LockExclusive);
                return Some(Shared([place, lock("testbed.lock", FlockArg::LockShared)]));
            }
        }
        std::thread::sleep(Duration::from_millis(20));
    }
}
