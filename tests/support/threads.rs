//! Faults of single threads of a process, caused with ptrace(2).

use std::time::{Duration, Instant};

use nix::sys::ptrace;
use nix::sys::wait::{WaitPidFlag, WaitStatus, waitpid};
use nix::unistd::Pid;

/// What happens to a thread.
#[derive(Clone, Copy, Debug)]
pub enum Fault {
    /// It stays stopped, as in a deadlock.
    Hang,
    /// It ends without a trace, as after a panic that nothing handles.
    End,
}

/// The threads without which a process does nothing: its main thread, the DDS library's event loop and its
/// discovery thread, as the kernel shows their names.
pub const THREADS: [Option<&str>; 3] = [None, Some("RustDDS Partici"), Some("RustDDS discove")];

/// The id of the thread of this name, or of the main thread.
pub fn thread(process: i32, name: Option<&str>) -> Pid {
    let Some(name) = name else { return Pid::from_raw(process) };
    let named = |entry: std::fs::DirEntry| {
        let comm = std::fs::read_to_string(entry.path().join("comm")).ok()?;
        (comm.trim_end() == name).then(|| entry.file_name().to_string_lossy().parse().ok())?
    };
    let tasks = || std::fs::read_dir(format!("/proc/{process}/task")).ok()?.flatten().find_map(named);
    Pid::from_raw(super::wait_for(format!("thread {name} of process {process}"), tasks))
}

/// Waits until the kernel stops or ends the traced thread.
fn wait(thread: Pid) -> WaitStatus {
    waitpid(thread, Some(WaitPidFlag::__WALL)).unwrap()
}

/// Waits until the traced thread has ended: for twice the usual time, because `up` lets a process start for
/// 30 s. If the caller then panics, the kernel lets the thread go on.
fn wait_end(process: i32, thread: Pid) {
    let deadline = Instant::now() + 2 * super::patience();
    while !matches!(
        waitpid(thread, Some(WaitPidFlag::__WALL | WaitPidFlag::WNOHANG)).unwrap(),
        WaitStatus::Exited(..) | WaitStatus::Signaled(..)
    ) {
        assert!(Instant::now() < deadline, "nothing ended process {process}, whose thread {thread} hangs");
        std::thread::sleep(Duration::from_millis(10));
    }
}

/// The ids and names of the threads of the process that are not among [`THREADS`].
pub fn others(process: i32) -> Vec<(Pid, String)> {
    let tasks = std::fs::read_dir(format!("/proc/{process}/task")).unwrap().flatten();
    let named = tasks.filter_map(|task| {
        let name = std::fs::read_to_string(task.path().join("comm")).ok()?;
        Some((Pid::from_raw(task.file_name().to_string_lossy().parse().ok()?), name.trim_end().to_owned()))
    });
    named.filter(|(id, name)| id.as_raw() != process && !THREADS.contains(&Some(name.as_str()))).collect()
}

/// Lets a thread go on that [`stop`] has stopped.
pub fn resume(thread: Pid) {
    ptrace::detach(thread, None).unwrap();
}

/// Stops the thread. The calling thread traces it from then on.
pub fn stop(thread: Pid) {
    ptrace::seize(thread, ptrace::Options::empty()).unwrap();
    ptrace::interrupt(thread).unwrap();
    assert!(matches!(wait(thread), WaitStatus::PtraceEvent(..) | WaitStatus::Stopped(..)));
}

/// Lets a stopped thread call exit(2), which ends this thread only. Returns whether that was possible: the
/// thread must wait in a system call, whose instruction it then executes again with another number.
fn end(thread: Pid) -> bool {
    const SYSCALL: i64 = 0x050f;
    let mut registers = ptrace::getregs(thread).unwrap();
    let instruction = registers.rip - 2;
    if ptrace::read(thread, instruction as ptrace::AddressType).unwrap() & 0xffff != SYSCALL {
        return false;
    }
    (registers.rip, registers.rax, registers.rdi) = (instruction, nix::libc::SYS_exit as u64, 0);
    // The kernel would otherwise restart the interrupted system call in place of this one.
    registers.orig_rax = u64::MAX;
    ptrace::setregs(thread, registers).unwrap();
    true
}

/// Causes the fault in a thread of the process, and waits until the process is dead.
pub fn cause(fault: Fault, process: i32, thread: Pid) {
    stop(thread);
    if matches!(fault, Fault::End) {
        while !end(thread) {
            ptrace::cont(thread, None).unwrap();
            ptrace::interrupt(thread).unwrap();
            wait(thread);
        }
        ptrace::detach(thread, None).unwrap();
    } else {
        // The parent learns of the end of the process only after the tracer has.
        wait_end(process, thread);
    }
    super::wait_until(format!("the end of process {process}"), || {
        std::fs::read_to_string(format!("/proc/{process}/stat")).map_or(true, |stat| stat.contains(") Z "))
            || !std::path::Path::new(&format!("/proc/{process}")).exists()
    });
}
