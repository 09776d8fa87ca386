//! The keys of the bridge, its routes and its lanes.

use super::row::Kind::{Choice, Decimal, Flag, Other, Whole};
use super::row::{AGE, Kind, Row, TOPIC, reloads, restarts};
use crate::config::choices::{HistoryKind, words};
use crate::config::settings::{DropPolicy, SchedulingPolicy, Standby};
use crate::model::{Durability, Reliability};

const SAMPLE: Kind = Whole(1, 67_108_864, " bytes");
/// 1 TB/s is more than the bandwidth of any memory.
const BANDWIDTH: Kind = Whole(1, 1_000_000_000_000, " bytes/s");

/// The paths of a QoS policy.
macro_rules! qos {
    ($name:literal) => {
        &[
            concat!("topics[].qos_overrides.input.", $name),
            concat!("topics[].qos_overrides.<lane>.", $name),
            concat!("qos_profiles.<profile>.", $name),
            concat!("lanes.<lane>.qos.", $name),
        ]
    };
}

/// The paths of a key of a process' scheduling.
macro_rules! scheduling {
    ($name:literal) => {
        &[
            concat!("lanes.<lane>.scheduling.", $name),
            concat!("processes.ingress.scheduling.", $name),
            concat!("processes.control.scheduling.", $name),
        ]
    };
}

pub(super) const ROWS: &[Row] = &[
    restarts(&["instance"], Other("1 to 24 of `a-z`, `0-9`, `_`, a letter first"), "`default`").doc(
        "Name of the bridge, if there are several on a host. Its shared memory and nodes are named after \
         it.",
    ),
    reloads(&["policy_hold_s"], Decimal(0.0, 3600.0, " s"), "5").doc(
        "How long a lane keeps its last policy after control has died. Then critical lanes are normal and \
         noncritical ones degraded.",
    ),
    restarts(&["ros.domain_id"], Whole(0, 232, ""), "`$ROS_DOMAIN_ID`, else 0")
        .doc("DDS domain of the publishers."),
    restarts(&["ros.networks"], Other("list; empty for all"), "all; see [Environment](#environment)").doc(
        "Network interfaces to use there, by name (`wlan0`) or by IPv4 address. Nodes of this host are \
         reached over loopback in any case. An interface that is absent at the start causes a warning in \
         the log, and is used as soon as it has an address.",
    ),
    restarts(
        &["ros.static_peers"],
        Other("list of at most 16 IPv4 addresses"),
        "`$ROS_STATIC_PEERS`, else none",
    )
    .doc("Hosts to which the bridge is also announced by unicast, for networks without multicast."),
    restarts(
        &["ros.namespace"],
        Other("absolute namespace"),
        "`/adaptive_bridge`, and `/` and the instance unless that is `default`",
    )
    .doc("Namespace of the bridge's nodes. `--ros-args -r __ns:=` sets it."),
    restarts(&["ros.node_name"], Other("node name"), "none").doc(
        "What the names of the bridge's nodes begin with: with `front` they are `front_ingress`, \
         `front_control`, `front_egress_critical`, …, and that of a responder is `front`. `--ros-args -r \
         __node:=` sets it.",
    ),
    restarts(
        &["ros.graph_gid_bytes"],
        Other("16, 24"),
        "by `$ROS_DISTRO`: 24 for `foxy`, `galactic`, `humble`, else 16",
    )
    .doc("Bytes of a graph identifier in `ros_discovery_info`: 24 up to ROS 2 Humble, 16 since Iron."),
    restarts(&["topics[].id"], Other("1 to 64 of `A-Z`, `a-z`, `0-9`, `_`, `-`, `.`"), "must be given")
        .doc("Your name for the route; unique."),
    restarts(
        &["topics[].input_topic"],
        Other("absolute topic name, or a pattern of such names, at most 246 characters"),
        "must be given",
    )
    .doc(
        "The topic that the bridge subscribes to. `*` in place of a token stands for any one token, `**` for \
         any number of them: see [Routes by pattern](#routes-by-pattern).",
    ),
    restarts(&["topics[].exclude"], Other("list of at most 64 topic names or patterns"), "none")
        .doc("Of a pattern: topics that match it and are not bridged."),
    restarts(&["topics[].max_routes"], Whole(1, 64, " routes"), "8").doc(
        "Of a pattern: the most topics that are bridged at once. Each has shared memory, and memory in each \
         process, as a topic of its own has.",
    ),
    restarts(&["topics[].message_type"], Other("a ROS 2 message type"), "found by discovery")
        .doc("Message type, `pkg/msg/Name` or `pkg/Name`."),
    restarts(&["topics[].lanes"], Other("list of lane names, at least one"), "all lanes")
        .doc("The lanes that the route is on."),
    restarts(&["topics[].critical_output"], TOPIC, "`/adaptive_bridge/critical` and the input topic")
        .doc("The topic that the critical lane publishes."),
    restarts(&["topics[].noncritical_output"], TOPIC, "`/adaptive_bridge/noncritical` and the input topic")
        .doc("The topic that the lane `noncritical` publishes."),
    restarts(&["topics[].outputs.<lane>"], TOPIC, "`/adaptive_bridge/<lane>` and the input topic")
        .doc(
            "The same for any lane. For `critical` and `noncritical` give this or the key above, not both. Of a \
         pattern it ends in `/**`, which stands for the input topic.",
        ),
    restarts(&["topics[].max_sample_bytes"], SAMPLE, "`shared_memory.max_sample_bytes`").doc(
        "The largest serialized sample; ingress drops a larger one as `too_large`. Shared memory is \
         taken for the samples that come, not for this size.",
    ),
    restarts(&["topics[].priority"], Whole(0, 99, ""), "0").doc(
        "Which routes go first: each lane sends waiting samples of a higher number first, and ingress \
         receives critical routes above the lowest number in use on a UDP port of their own; a route on \
         noncritical lanes alone has none. A noncritical lane that has begun to send samples of a lower number \
         sends all that its rate allows before it checks for samples of a higher number.",
    ),
    restarts(
        &["topics[].retained_samples"],
        Whole(1, 10_000, " samples"),
        "the largest depth among the route's TRANSIENT_LOCAL outputs (KEEP_ALL counts as the lane's \
         `window_samples`), else 256, but at most 16 MiB of the largest samples that the route allows, or 8; with \
         more than 32 routes an equal share of 8192; at least the depth given for an output without a durability",
    )
    .doc(
        "Samples retained in shared memory for a lane that restarts, which it then forwards, and which its \
         TRANSIENT_LOCAL writer offers to late joiners. A topic with several latched publishers, such as \
         `/tf_static`, needs one for each. Without this key a critical lane that restarts also forwards earlier \
         ones: up to 512, with more than 16 routes an equal share of 8192, as far as they fit 16 MiB and an equal \
         share of 128 MiB or an eighth of `shared_memory.budget_bytes`.",
    ),
    restarts(qos!("reliability"), Choice(words::<Reliability>), "as above")
        .doc("RELIABILITY: whether lost samples are repaired."),
    restarts(qos!("history"), Choice(words::<HistoryKind>), "as above")
        .doc("HISTORY: the last `depth` samples, or as many as fit (`window_samples`)."),
    // DDS allows 2^31; with 10,000 a route of 1 KiB samples takes 10 MiB on each lane.
    restarts(qos!("depth"), Whole(1, 10_000, " samples"), "as above; 10 for an input with KEEP_LAST")
        .doc("Depth of KEEP_LAST."),
    restarts(qos!("durability"), Choice(words::<Durability>), "what the publishers offer")
        .doc("DURABILITY: whether late joiners get the history."),
    restarts(
        &[
            "topics[].qos_overrides.<lane>.lifespan_ms",
            "qos_profiles.<profile>.lifespan_ms",
            "lanes.<lane>.qos.lifespan_ms",
        ],
        Whole(1, 86_400_000, " ms"),
        "infinite",
    )
    .doc(
        "LIFESPAN: the age at which subscribers discard a sample. A critical lane that catches up leaves it \
         out. An input has none.",
    ),
    restarts(qos!("deadline_ms"), Whole(1, 86_400_000, " ms"), "infinite")
        .doc("DEADLINE: the longest time between two samples."),
    restarts(&["topic_qos_profiles.<topic>.<lane>"], Other("a name in `qos_profiles`"), "none")
        .doc("The profile of one route, by its `id`, on one lane."),
    restarts(&["lanes.<lane>.qos"], Other("a name in `qos_profiles`, or a mapping"), "that of the class")
        .doc("The profile of all routes of the lane: a name, or the policies themselves."),
    restarts(&["lanes.<lane>.domain_id"], Whole(0, 232, ""), "that of the publishers")
        .doc("DDS domain of the lane's subscribers."),
    restarts(&["lanes.<lane>.networks"], Other("list of names or IPv4 addresses"), "`ros.networks`")
        .doc("Network interfaces to use there; an empty list for all."),
    restarts(
        &["lanes.<lane>.static_peers"],
        Other("list of at most 16 IPv4 addresses"),
        "`ros.static_peers`",
    )
    .doc("Hosts to which the lane is also announced by unicast."),
    restarts(&["lanes.<lane>.dscp"], Whole(0, 63, ""), "46 (EF) critical, else 0").doc(
        "Differentiated Services Code Point of what the lane sends by unicast. Networks with priorities, \
         such as Wi-Fi, send higher classes first.",
    ),
    // Each sample occupies `max_sample_bytes`.
    restarts(&["lanes.<lane>.queue_depth"], Whole(1, 4_096, " samples"), "64 critical, 16 noncritical").doc(
        "Samples of each route that may wait for the lane in shared memory: 64 are two seconds at 30 Hz, \
         13 ms at 5 kHz. When they are more, the oldest leave the queue. A critical lane reads those from \
         the last 512 that ingress keeps of a route (16 MiB at most), unless it has been behind for 2 s.",
    ),
    restarts(&["lanes.<lane>.max_borrowed"], Whole(1, 4_096, " samples"), "8").doc(
        "Samples of each route that the lane may hold in shared memory at once while DDS sends them. \
         Further samples are copied.",
    ),
    restarts(&["lanes.<lane>.by_reference_min_bytes"], Whole(0, 67_108_864, " bytes"), "65536")
        .doc("Smaller samples are copied for the DDS writer, others passed by reference."),
    restarts(
        &["lanes.<lane>.window_samples"],
        Whole(1, 100_000, " samples"),
        "256; on a noncritical lane the depth of a VOLATILE KEEP_LAST output",
    )
    .doc(
        "Samples that a RELIABLE writer of the lane retains for subscribers that have not acknowledged \
         them, 32 MiB at most. Beyond that it evicts the oldest sample; a subscriber that has not \
         acknowledged that one misses it, which counts as its `reader_overrun`.",
    ),
    reloads(&["lanes.<lane>.max_rate_hz"], Decimal(0.0, 100000.0, " Hz"), "`routing_policy`: 10")
        .doc("Rate in lane mode `normal`. 0 forwards nothing."),
    reloads(
        &["lanes.<lane>.degraded_rate_hz"],
        Decimal(0.0, 100000.0, " Hz"),
        "`routing_policy.modes.degraded`; else 3, or the rate of `normal` if that is lower",
    )
    .doc("Rate in lane mode `degraded`."),
    reloads(&["lanes.<lane>.max_bytes_per_s"], BANDWIDTH, "unlimited")
        .doc("Payload bytes per second in lane mode `normal`."),
    reloads(&["lanes.<lane>.degraded_max_bytes_per_s"], BANDWIDTH, "`max_bytes_per_s`")
        .doc("The same in lane mode `degraded`."),
    reloads(&["lanes.<lane>.stale_threshold_ms"], AGE, "`routing_policy`: 200").doc(
        "In lane mode `normal` the lane drops a sample whose age, by its source timestamp, is larger. 0: never. If \
         the clock of the publisher's computer is constantly more than 100 ms behind or 50 ms ahead of \
         this one's, the age runs from the arrival instead, plus the delay beyond that publisher's \
         fastest samples; `status` then names the publisher and the offset. It does not apply to a \
         TRANSIENT_LOCAL output, whose samples may be old.",
    ),
    reloads(
        &["lanes.<lane>.degraded_stale_threshold_ms"],
        AGE,
        "`routing_policy.modes.degraded`, else `stale_threshold_ms` of the lane",
    )
    .doc("The same in lane mode `degraded`."),
    reloads(&["lanes.<lane>.drop_policy"], Choice(words::<DropPolicy>), "`routing_policy`")
        .doc("Which samples are dropped when more wait than the rate allows, in both modes. See below."),
    reloads(&["lanes.<lane>.queue_samples"], Whole(1, 4_096, " samples"), "`noncritical_depth` of the mode")
        .doc(
            "Samples of each route that may wait in the lane until the rate allows them, in both modes. Keep it at or \
         below `safety.max_noncritical_queue`: a longer queue counts as overflowing, and suspends the \
         noncritical lanes for a while.",
        ),
    restarts(scheduling!("policy"), Choice(words::<SchedulingPolicy>), "`other`")
        .doc("Linux scheduling policy of the process. `fifo` and `rr` need CAP_SYS_NICE or an rtprio limit."),
    restarts(scheduling!("priority"), Whole(1, 99, "; 0 with `other`"), "0")
        .doc("Real-time priority. Must be given with `fifo` and `rr`, and only then."),
    restarts(scheduling!("nice"), Whole(0, 19, ""), "10 in noncritical lanes, else 0").doc(
        "Nice value: a process with a higher one gets less CPU time beside others. Without effect with \
         `fifo` and `rr`, and below the value with which the process was started.",
    ),
    restarts(
        scheduling!("slice_ms"),
        Decimal(0.1, 100.0, ""),
        "0.1 on the critical path, 10 in noncritical lanes, control: the kernel's",
    )
    .doc(
        "Time slice that the process requests from the kernel's fair scheduler: a process that wakes \
         preempts one with a longer slice at once ([why](../docs/decisions/0010-time-slices.md)). Needs \
         no privilege. Without effect with `fifo` and `rr`, and before Linux 6.12.",
    ),
    restarts(scheduling!("cpus"), Other("list of 0 to 1023; empty for all"), "all")
        .doc("CPUs that the process may run on."),
    restarts(scheduling!("lock_memory"), Flag, "`false`")
        .doc("Lock the memory of the process (`mlockall`), so that it has no page faults."),
    restarts(
        &["lanes.<lane>.standby", "processes.ingress.standby"],
        Choice(words::<Standby>),
        "`warm` for ingress and the critical lane; other lanes: always `none`",
    )
    .doc(
        "`warm`: a second process of the critical lane, or of ingress, waits and takes over when the first one \
         ends, is stopped or hangs, without the time that a start takes. It has 12 MB of resident memory and \
         takes 0.6 to 1.6 % of a CPU.",
    ),
    restarts(&["shared_memory.root_path"], Other("absolute path"), "chosen by the program")
        .doc("Folder of the bridge's own files."),
    restarts(&["shared_memory.max_sample_bytes"], SAMPLE, "16777216")
        .doc("The largest sample of a topic without `max_sample_bytes` of its own."),
    restarts(&["shared_memory.max_taps"], Whole(0, 64, ""), "2")
        .doc("Local programs that may tap a route at once."),
    restarts(
        &["shared_memory.budget_bytes"],
        Whole(1_048_576, 1_099_511_627_776, " bytes"),
        "2147483648, or a quarter of the machine's memory if that is less",
    )
    .doc(
        "The most shared memory that the samples of all routes take together. A route takes what its samples \
         need, and leaves the others room for theirs; ingress drops what does not fit as `over_budget` or \
         `over_quota`.",
    ),
];
