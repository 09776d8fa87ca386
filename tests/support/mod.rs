//! What the integration tests share: hosts, DDS peers of other makes, and the bridge, all of them real.
//!
//! A test waits for a condition with [`patience`] and then asserts; it never asserts a maximum time.
//! A test that needs what a machine lacks calls [`skip`], and nothing else, so that `make test` can list it.

// Every test binary compiles this module and uses a part of it.
#![allow(dead_code)]

pub mod bed;
pub mod bridge;
pub mod flow;
#[cfg(feature = "eval")]
pub mod impairment;
pub mod machine;
pub mod netns;
pub mod peer;
pub mod process;
pub mod prometheus;
pub mod ros;
pub mod rtps;

use std::fmt::Display;
use std::fs::{self, File, OpenOptions};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nix::fcntl::{Flock, FlockArg};

/// How long a test waits for something that should happen: 30 s, or `ADAPTIVE_BRIDGE_TEST_PATIENCE_S`.
pub fn patience() -> Duration {
    let seconds = std::env::var("ADAPTIVE_BRIDGE_TEST_PATIENCE_S").ok().and_then(|text| text.parse().ok());
    Duration::from_secs(seconds.unwrap_or(30))
}

/// Polls until `probe` yields a value; after [`patience`] panics and says `what` did not happen.
pub fn wait_for<T>(what: impl Display, mut probe: impl FnMut() -> Option<T>) -> T {
    let deadline = Instant::now() + patience();
    loop {
        if let Some(value) = probe() {
            return value;
        }
        assert!(Instant::now() < deadline, "waited {:?} in vain for: {what}", patience());
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// As [`wait_for`], for a condition.
pub fn wait_until(what: impl Display, mut condition: impl FnMut() -> bool) {
    wait_for(what, || condition().then_some(()));
}

/// The build folder of this source tree.
fn target_dir() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("target")
}

/// Records that `test` is not run on this machine, and why. The caller returns at once after it.
///
/// `make test` prints the list at its end. Panics where `CI` is set: there nothing may be skipped.
pub fn skip(test: &str, reason: &str) {
    let ci = std::env::var_os("CI").is_some_and(|value| !value.is_empty());
    skip_into(&target_dir().join("skipped.txt"), ci, test, reason);
}

/// [`skip`] with its surroundings as arguments.
pub fn skip_into(list: &Path, ci: bool, test: &str, reason: &str) {
    assert!(!ci, "{test} can't run here ({reason}), and nothing may be skipped where CI is set");
    eprintln!("SKIPPED {test}: {reason}");
    if let Some(folder) = list.parent() {
        fs::create_dir_all(folder).unwrap();
    }
    let mut file = OpenOptions::new().create(true).append(true).open(list).unwrap();
    writeln!(file, "{test}: {reason}").unwrap();
}

/// Why tests between hosts can't run on this machine: no right to make network namespaces, or a peer not
/// built.
pub fn testbed_missing() -> Option<String> {
    netns::requires_root().or_else(peer::missing)
}

/// Held by one test at a time over all test programs of this source tree.
pub struct Exclusive(#[allow(dead_code)] Flock<File>);

/// Waits until no other test holds it. [`netns::Net`] has it built in; a test takes it once, else it waits
/// for itself for ever.
///
/// It makes tests that load the machine run one after another under any runner, whatever its number of
/// threads.
pub fn exclusive() -> Exclusive {
    fs::create_dir_all(target_dir()).unwrap();
    let file = File::create(target_dir().join("testbed.lock")).unwrap();
    Exclusive(Flock::lock(file, FlockArg::LockExclusive).map_err(|(_, error)| error).unwrap())
}
