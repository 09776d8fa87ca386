//! A thread of a bridge's process that hangs or ends: the supervisor restarts the process, whichever thread
//! it is. Uses real processes, whose threads are stopped and ended one by one.

#![cfg(all(target_os = "linux", target_arch = "x86_64"))]

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use serde_json::Value;
use support::bed::{Bed, CRITICAL, INPUT, SCAN};
use support::peer::{Peer, Received, Sent};
use support::threads::{Fault, THREADS, cause, thread};

#[test]
fn up_restarts_a_process_in_which_any_thread_hangs_or_ends() {
    let test = "up_restarts_a_process_in_which_any_thread_hangs_or_ends";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let subscriber = bed.subscribe("critical", Peer::cyclone().keep_last(1000), CRITICAL);
    let publisher = bed.publish(Peer::cyclone().keep_last(1000).rate_hz(100.0), INPUT);
    subscriber.wait_received(100);
    std::thread::scope(|scope| {
        for role in ["ingress", "egress-critical", "egress-noncritical", "control"] {
            let bed = &bed;
            scope.spawn(move || {
                for fault in [Fault::Hang, Fault::End] {
                    for name in THREADS {
                        let (before, process) = (bed.pids(role).len(), bed.pid(role));
                        cause(fault, process, thread(process, name));
                        support::wait_until(
                            format!("a restart of {role} after {fault:?} of thread {name:?}"),
                            || bed.pids(role).len() == before + 1,
                        );
                        bed.bridge.wait_status(&format!("a turn of the new {role}"), |status| {
                            let processes = status["processes"].as_array().unwrap();
                            let is_turning = |one: &Value| {
                                one["state"] == "running"
                                    && one["turns"].as_u64().is_some_and(|turns| turns > 0)
                            };
                            processes.iter().any(|one| one["name"] == role && is_turning(one))
                        });
                    }
                }
            });
        }
    });
    subscriber.wait_received(subscriber.received() + 300);
    let _: Sent = publisher.end();
    let _: Received = subscriber.end();
    bed.end();
}

#[test]
fn up_restarts_a_process_that_hangs_before_its_first_turn() {
    let test = "up_restarts_a_process_that_hangs_before_its_first_turn";
    let Some(bed) = Bed::start(test, SCAN) else { return };
    let role = "egress-noncritical";
    kill(Pid::from_raw(bed.pid(role)), Signal::SIGKILL).unwrap();
    support::wait_until("its restart", || bed.pids(role).len() == 2);
    let process = bed.pid(role);
    cause(Fault::Hang, process, thread(process, None));
    support::wait_until("another restart", || bed.pids(role).len() == 3);
    assert!(bed.up.log().contains("no first turn within 30000 ms"), "{}", bed.up.log());
    bed.end();
}
