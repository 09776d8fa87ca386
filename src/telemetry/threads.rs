//! Whether the threads of a process run, and whether other programs keep them from it.

use std::fs::{self, File};
use std::io;
use std::os::unix::fs::FileExt;

use super::liveness::StatFile;
use crate::model::MonotonicNs;

/// States of a thread (proc(5)) that runs or is ready to run, or that waits for a disk, as it does for a page
/// of memory.
const READY: [char; 2] = ['R', 'D'];

/// A thread of a process at an instant.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Thread {
    id: u64,
    cpu_ns: u64,
    /// Whether it runs, is ready to run, or waits for a disk, as it does for a page of memory.
    ready: bool,
}

impl Thread {
    /// The first field of `schedstat` is the CPU time, the first one after the name in parentheses in `stat`
    /// is the state (proc(5)).
    fn parse(id: u64, schedstat: &str, stat: &str) -> Option<Self> {
        let cpu_ns = cpu_ns(schedstat)?;
        let (_, fields) = stat.rsplit_once(')')?;
        Some(Self { id, cpu_ns, ready: fields.trim_start().starts_with(READY) })
    }

    /// Reads the threads of a process from `/proc`; none if the process does not exist or is not readable.
    fn all(pid: u64) -> Vec<Self> {
        let read = |folder: fs::DirEntry| {
            let id = folder.file_name().to_str()?.parse().ok()?;
            let file = |name: &str| fs::read_to_string(folder.path().join(name)).unwrap_or_default();
            Self::parse(id, &file("schedstat"), &file("stat"))
        };
        folders(pid).filter_map(read).collect()
    }
}

/// The CPU time in the `schedstat` of a thread.
fn cpu_ns(schedstat: &str) -> Option<u64> {
    schedstat.split_whitespace().next()?.parse().ok()
}

/// The folders of the threads of a process.
fn folders(pid: u64) -> impl Iterator<Item = fs::DirEntry> {
    fs::read_dir(format!("/proc/{pid}/task")).into_iter().flatten().flatten()
}

/// Whether a thread of the process runs, is ready to run or waits for a disk, or the process ends.
pub fn may_go_on(pid: u64) -> bool {
    // The files of other threads that have ended are gone at once.
    const ENDED: char = 'Z';
    let state = |folder: fs::DirEntry| StatFile::of(&folder.path()).ok()?.state();
    folders(pid).filter_map(state).any(|state| state == ENDED || READY.contains(&state))
}

/// The open files of a thread, for checks many times a second.
#[derive(Debug)]
pub struct ThreadFiles {
    stat: StatFile,
    schedstat: File,
    cpu_ns: u64,
}

impl ThreadFiles {
    /// Opens the files of the thread with that id.
    ///
    /// # Errors
    /// There is no such thread, or the kernel keeps no CPU times.
    pub fn open(id: i32) -> io::Result<Self> {
        let schedstat = File::open(format!("/proc/{id}/schedstat"))?;
        Ok(Self { stat: StatFile::open(id)?, schedstat, cpu_ns: 0 })
    }

    /// Opens the files of the first thread of a process with that name, of which the kernel keeps 15 bytes.
    ///
    /// # Errors
    /// As for [`open`](Self::open).
    pub fn open_named(pid: u64, name: &str) -> io::Result<Self> {
        let has_name = |folder: &fs::DirEntry| {
            fs::read_to_string(folder.path().join("comm")).is_ok_and(|comm| comm.trim_end() == name)
        };
        let folder = folders(pid).find(has_name).ok_or(io::ErrorKind::NotFound)?;
        let id = folder.file_name().to_str().and_then(|id| id.parse().ok());
        Self::open(id.ok_or(io::ErrorKind::InvalidData)?)
    }

    /// Whether the thread has run since the last call, is ready to run or waits for a disk.
    pub fn has_run(&mut self) -> bool {
        let mut bytes = [0; 64];
        let length = self.schedstat.read_at(&mut bytes, 0).unwrap_or(0);
        // A thread that has ended never runs again, and is not ready.
        let cpu_ns = str::from_utf8(&bytes[..length]).ok().and_then(cpu_ns).unwrap_or(0);
        std::mem::replace(&mut self.cpu_ns, cpu_ns) != cpu_ns
            || self.stat.state().is_some_and(|state| READY.contains(&state))
    }
}

/// Whether a process that makes no progress is kept from it by other programs.
#[derive(Clone, Debug)]
pub struct Starvation {
    interval_ms: u64,
    last: Vec<Thread>,
    checked_at: MonotonicNs,
}

impl Starvation {
    /// For checks that are `interval_ms` apart while the process makes no progress.
    pub const fn new(interval_ms: u64) -> Self {
        Self { interval_ms, last: Vec::new(), checked_at: MonotonicNs(0) }
    }

    /// Whether a thread of the process was ready to run at the last check and is now, and got less than half
    /// of a CPU between them: the machine is busy with other programs, or waits for a disk. True also at the
    /// first check of a stall, and at a late one, which cannot tell.
    pub fn check(&mut self, pid: u64, now: MonotonicNs) -> bool {
        self.compare(Thread::all(pid), now)
    }

    fn compare(&mut self, threads: Vec<Thread>, now: MonotonicNs) -> bool {
        let elapsed_ns = now.since(std::mem::replace(&mut self.checked_at, now));
        let last = std::mem::replace(&mut self.last, threads);
        // A check that is older than two intervals belongs to an earlier stall, or this process was starved
        // as well.
        if last.is_empty() || elapsed_ns >= 2 * self.interval_ms * 1_000_000 {
            return true;
        }
        self.last.iter().filter(|thread| thread.ready).any(|thread| {
            let before = last.iter().find(|before| before.id == thread.id && before.ready);
            before.is_some_and(|before| thread.cpu_ns.saturating_sub(before.cpu_ns) < elapsed_ns / 2)
        })
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::channel;

    use super::*;

    #[test]
    fn a_thread_that_waits_has_not_run_and_one_that_worked_has() {
        let pid = std::process::id().into();
        let name = "thread-to-watch";
        assert!(ThreadFiles::open_named(pid, name).is_err());
        let (work, works) = channel();
        let (done, is_done) = channel();
        let worker = std::thread::Builder::new().name(name.into()).spawn(move || {
            for () in works {
                let sum: u64 = std::hint::black_box(0..10_000).sum();
                done.send(sum).unwrap();
            }
        });
        let worker = worker.unwrap();
        let round = || {
            work.send(()).unwrap();
            is_done.recv().unwrap();
        };
        round();
        let mut files = ThreadFiles::open_named(pid, name).unwrap();
        for _ in 0..3 {
            round();
            assert!(files.has_run());
            // It may still be on its way to the next wait.
            let asleep = (0..1_000).any(|_| {
                std::thread::sleep(std::time::Duration::from_millis(10));
                !files.has_run()
            });
            assert!(asleep);
            assert!(!files.has_run());
        }
        assert!(may_go_on(pid), "this thread runs");
        drop(work);
        worker.join().unwrap();
        assert!(!may_go_on(u64::MAX));
    }

    #[test]
    fn a_process_starves_if_a_thread_is_ready_and_gets_less_than_half_a_cpu() {
        let at = |ms| MonotonicNs(0).plus_ms(ms);
        let threads = |cpu_ms: [u64; 2], ready: [bool; 2]| {
            let thread =
                |id: usize| Thread { id: id as u64, cpu_ns: cpu_ms[id] * 1_000_000, ready: ready[id] };
            [0, 1].map(thread).to_vec()
        };
        let mut starvation = Starvation::new(100);
        let mut check = |ms, cpu_ms, ready| starvation.compare(threads(cpu_ms, ready), at(ms));
        assert!(check(1_000, [0, 0], [true, false]), "nothing to compare with");
        assert!(check(1_100, [49, 0], [true, false]));
        assert!(!check(1_200, [99, 0], [true, true]), "it runs");
        assert!(check(1_300, [199, 49], [true, true]), "one runs, one does not");
        assert!(!check(1_400, [199, 49], [false, false]), "it waits");
        assert!(!check(1_500, [199, 49], [true, true]), "it waited at the last check");
        assert!(check(1_700, [399, 249], [true, true]), "the check is late");
    }

    #[test]
    fn a_thread_has_a_cpu_time_and_a_state() {
        let thread = |stat| Thread::parse(7, "100 7 1", stat);
        assert_eq!(thread("12 (a) R) S 1 2 3"), Some(Thread { id: 7, cpu_ns: 100, ready: false }));
        assert_eq!(thread("13 (b) R 1 2 3"), Some(Thread { id: 7, cpu_ns: 100, ready: true }));
        assert_eq!(thread("13 (b) D 1 2 3"), Some(Thread { id: 7, cpu_ns: 100, ready: true }));
        assert_eq!(Thread::parse(7, "", ""), None);
        // This thread runs, and has had CPU time that may not be counted yet. The main thread has had some.
        let own = Thread::all(std::process::id().into());
        assert!(
            own.iter().any(|thread| thread.ready) && own.iter().any(|thread| thread.cpu_ns > 0),
            "{own:?}"
        );
        assert_eq!(Thread::all(u64::MAX), []);
    }
}
