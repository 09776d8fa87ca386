//! Participants that join and leave: the memory of the bridge does not grow with those that have left.

use support::bed::{Bed, CRITICAL, INPUT, NONCRITICAL, SCAN, SCAN_TYPE};
use support::process::memory_kib;
use support::visitors::{Endpoint, Leave, Visitors};
use support::wait_until;

/// The visitors that are present at the same time.
const AT_ONCE: usize = 100;
/// The visitors before the first measurement of memory. By then most bounded tables are full, such as that of
/// the endpoints of the last 256 participants that are gone, and the allocator has its areas.
const FIRST: usize = 500;
/// The visitors after that, or the variable's number rounded up to a multiple of [`FIRST`].
const MORE: usize = 1_000;
const MORE_VARIABLE: &str = "ADAPTIVE_BRIDGE_TEST_VISITORS";
/// The most that a process may grow after that. If the memory of participants that are gone is not freed,
/// 1,000 visitors cost 6.5 to 7 MiB. Now 9,000 cost 0.1 to 0.7 MiB, or up to 1.8 when the CPUs are busy: the
/// areas of the allocator grow with the largest number of datagrams that waited at the same time.
const MAX_GROWTH_KIB: i64 = 3_072;
/// Half of the visitors end normally, half are killed.
const WAYS: [Leave; 6] = [
    Leave::Close,
    Leave::Kill,
    Leave::CloseParticipant,
    Leave::Kill,
    Leave::CloseParticipantFirst,
    Leave::Kill,
];
/// The polls, of 60 ms each, after which visitors leave again. A visitor that is killed is gone after 3 s.
const POLLS_PER_LEAVE: u32 = 80;
/// The processes that have a DDS participant.
const PROCESSES: [&str; 4] = ["ingress", "egress-critical", "egress-noncritical", "control"];

/// What a visitor has: readers of both outputs, a publisher of the input, and what each ROS 2 node has.
fn endpoints() -> Vec<Endpoint> {
    let graph = "rmw_dds_common::msg::dds_::ParticipantEntitiesInfo_";
    let events = "rcl_interfaces::msg::dds_::ParameterEvent_";
    vec![
        Endpoint::reader(CRITICAL, SCAN_TYPE),
        Endpoint::reader(NONCRITICAL, SCAN_TYPE).best_effort(),
        Endpoint::reader("ros_discovery_info", graph).transient_local(),
        Endpoint::reader("rt/parameter_events", events),
        Endpoint::writer(INPUT, SCAN_TYPE).samples(vec![vec![7; 100]; 2]),
        Endpoint::writer("ros_discovery_info", graph).transient_local(),
        Endpoint::writer("rt/parameter_events", events),
        Endpoint::writer("rt/rosout", "rcl_interfaces::msg::dds_::Log_").transient_local(),
    ]
}

/// The number of matched readers of each output.
fn readers(bed: &Bed) -> Vec<u64> {
    let status = bed.bridge.try_status().unwrap_or_default();
    let outputs = support::bed::outputs(&status);
    outputs.filter_map(|output| output["readers"].as_u64()).collect()
}

/// Lets `count` visitors join and leave.
fn churn(bed: &Bed, visitors: &mut Visitors, count: usize) {
    for _ in 0..count / AT_ONCE {
        visitors.join(AT_ONCE);
        wait_until("the readers of all visitors", || {
            visitors.announce();
            readers(bed) == [AT_ONCE as u64; 2]
        });
        visitors.write();
        let mut polls = 0;
        wait_until("the end of all visitors", || {
            if polls % POLLS_PER_LEAVE == 0 {
                visitors.leave(&WAYS);
            }
            polls += 1;
            readers(bed) == [0; 2]
        });
        visitors.clear();
    }
}

/// The memory of each process in KiB, without what it shares with others.
fn anonymous_kib(bed: &Bed) -> [i64; PROCESSES.len()] {
    PROCESSES.map(|process| memory_kib(bed.pid(process), "RssAnon"))
}

/// Tests of a minute or more: `make test-long`.
mod long {
    use super::*;

    #[test]
    fn memory_does_not_grow_with_the_participants_that_are_gone() {
        let test = "memory_does_not_grow_with_the_participants_that_are_gone";
        // A process that is restarted, on a machine that is busy otherwise, would begin with less memory.
        let _alone = support::exclusive();
        let Some(bed) = Bed::start_without_watchdog(test, SCAN) else {
            return;
        };
        bed.up.wait_for_log("control is up");
        let mut visitors = Visitors::new(bed.host("slow"), endpoints(), PROCESSES.len());
        churn(&bed, &mut visitors, FIRST);
        let before = anonymous_kib(&bed);
        let more = std::env::var(MORE_VARIABLE).map_or(MORE, |count| count.parse().unwrap());
        for number in 1..=more.div_ceil(FIRST) {
            churn(&bed, &mut visitors, FIRST);
            let after = anonymous_kib(&bed);
            println!("after {FIRST}: {before:?} KiB; after {} more: {after:?} KiB", number * FIRST);
            for ((process, before), after) in PROCESSES.iter().zip(before).zip(after) {
                assert!(
                    after - before < MAX_GROWTH_KIB,
                    "{process} has grown from {before} to {after} KiB with {} participants",
                    number * FIRST
                );
                assert_eq!(bed.pids(process).len(), 1, "{process} was restarted\n{}", bed.up.log());
            }
        }
        bed.end();
    }
}
