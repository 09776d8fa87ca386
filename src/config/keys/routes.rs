//! The keys of the bridge, its routes and its lanes.

use super::row::Kind::{Choice, Decimal, Flag, Other, Whole};
use super::row::{Row, names};
use crate::config::choices::{DROP_POLICIES, DURABILITIES, HISTORIES, RELIABILITIES, SCHEDULING_POLICIES};

pub(super) const ROWS: &[Row] = &[
    Row::new(
        &["instance"],
        Other("1 to 24 of `a-z`, `0-9`, `_`, a letter first"),
        "`default`",
        "Name of the bridge, if there are several on a host. Its shared memory and nodes are named after \
         it.",
    ),
    Row::new(
        &["policy_hold_s"],
        Decimal(0.0, 3600.0),
        "5",
        "How long a lane keeps its last policy after control has died. Then critical lanes are normal and \
         noncritical ones degraded.",
    )
    .unit("s")
    .reloads(),
    Row::new(&["ros.domain_id"], Whole(0, 232), "`$ROS_DOMAIN_ID`, else 0", "DDS domain of the publishers."),
    Row::new(
        &["ros.networks"],
        Other("list; empty for all"),
        "all; see [Environment](#environment)",
        "Network interfaces to use there, by name (`wlan0`) or by IPv4 address. Nodes of this host are \
         reached over loopback in any case. An interface that is absent at the start causes a warning in \
         the log, and is used as soon as it has an address.",
    ),
    Row::new(
        &["ros.graph_gid_bytes"],
        Other("16, 24"),
        "by `$ROS_DISTRO`: 24 for `foxy`, `galactic`, `humble`, else 16",
        "Bytes of a graph identifier in `ros_discovery_info`: 24 up to ROS 2 Humble, 16 since Iron.",
    ),
    Row::new(
        &["topics[].id"],
        Other("1 to 64 of `A-Z`, `a-z`, `0-9`, `_`, `-`, `.`"),
        "must be given",
        "Your name for the route; unique.",
    ),
    Row::new(
        &["topics[].input_topic"],
        Other("absolute topic name, at most 246 characters"),
        "must be given",
        "The topic that the bridge subscribes to.",
    ),
    Row::new(
        &["topics[].message_type"],
        Other("a ROS 2 message type"),
        "found by discovery",
        "Message type, `pkg/msg/Name` or `pkg/Name`.",
    ),
    Row::new(
        &["topics[].lanes"],
        Other("list of lane names, at least one"),
        "all lanes",
        "The lanes that the route is on.",
    ),
    Row::new(
        &["topics[].critical_output"],
        Other("absolute topic name"),
        "`/adaptive_bridge/critical` and the input topic",
        "The topic that the critical lane publishes.",
    ),
    Row::new(
        &["topics[].noncritical_output"],
        Other("absolute topic name"),
        "`/adaptive_bridge/noncritical` and the input topic",
        "The topic that the lane `noncritical` publishes.",
    ),
    Row::new(
        &["topics[].outputs.<lane>"],
        Other("absolute topic name"),
        "`/adaptive_bridge/<lane>` and the input topic",
        "The same for any lane. For `critical` and `noncritical` give this or the key above, not both.",
    ),
    Row::new(
        &["topics[].max_sample_bytes"],
        Whole(1, 67_108_864),
        "`shared_memory.max_sample_bytes`",
        "The largest serialized sample; ingress drops a larger one as `too_large`. Shared memory is \
         reserved for samples of this size.",
    )
    .unit("bytes"),
    Row::new(
        &["topics[].retained_samples"],
        Whole(1, 10_000),
        "the largest depth among the route's TRANSIENT_LOCAL outputs (KEEP_ALL counts as the lane's \
         `window_samples`), else 8",
        "Samples retained in shared memory for a lane that restarts, which it then forwards, and which its \
         TRANSIENT_LOCAL writer offers to late joiners.",
    )
    .unit("samples"),
    Row::new(
        &[
            "topics[].qos_overrides.input.reliability",
            "topics[].qos_overrides.<lane>.reliability",
            "qos_profiles.<profile>.reliability",
            "lanes.<lane>.qos.reliability",
        ],
        Choice(|| names(RELIABILITIES)),
        "as above",
        "RELIABILITY: whether lost samples are repaired.",
    ),
    Row::new(
        &[
            "topics[].qos_overrides.input.history",
            "topics[].qos_overrides.<lane>.history",
            "qos_profiles.<profile>.history",
            "lanes.<lane>.qos.history",
        ],
        Choice(|| names(HISTORIES)),
        "as above",
        "HISTORY: the last `depth` samples, or as many as fit (`window_samples`).",
    ),
    // DDS allows 2^31; with 10,000 a route of 1 KiB samples takes 10 MiB on each lane.
    Row::new(
        &[
            "topics[].qos_overrides.input.depth",
            "topics[].qos_overrides.<lane>.depth",
            "qos_profiles.<profile>.depth",
            "lanes.<lane>.qos.depth",
        ],
        Whole(1, 10_000),
        "as above; 10 for an input with KEEP_LAST",
        "Depth of KEEP_LAST.",
    )
    .unit("samples"),
    Row::new(
        &[
            "topics[].qos_overrides.input.durability",
            "topics[].qos_overrides.<lane>.durability",
            "qos_profiles.<profile>.durability",
            "lanes.<lane>.qos.durability",
        ],
        Choice(|| names(DURABILITIES)),
        "as above",
        "DURABILITY: whether late joiners get the history.",
    ),
    Row::new(
        &[
            "topics[].qos_overrides.<lane>.lifespan_ms",
            "qos_profiles.<profile>.lifespan_ms",
            "lanes.<lane>.qos.lifespan_ms",
        ],
        Whole(1, 86_400_000),
        "infinite",
        "LIFESPAN: the age at which a writer discards a sample. An input has none.",
    )
    .unit("ms"),
    Row::new(
        &[
            "topics[].qos_overrides.input.deadline_ms",
            "topics[].qos_overrides.<lane>.deadline_ms",
            "qos_profiles.<profile>.deadline_ms",
            "lanes.<lane>.qos.deadline_ms",
        ],
        Whole(1, 86_400_000),
        "infinite",
        "DEADLINE: the longest time between two samples.",
    )
    .unit("ms"),
    Row::new(
        &["topic_qos_profiles.<topic>.<lane>"],
        Other("a name in `qos_profiles`"),
        "none",
        "The profile of one route, by its `id`, on one lane.",
    ),
    Row::new(
        &["lanes.<lane>.qos"],
        Other("a name in `qos_profiles`, or a mapping"),
        "that of the class",
        "The profile of all routes of the lane: a name, or the policies themselves.",
    ),
    Row::new(
        &["lanes.<lane>.domain_id"],
        Whole(0, 232),
        "that of the publishers",
        "DDS domain of the lane's subscribers.",
    ),
    Row::new(
        &["lanes.<lane>.networks"],
        Other("list of names or IPv4 addresses"),
        "`ros.networks`",
        "Network interfaces to use there; an empty list for all.",
    ),
    // Each sample occupies `max_sample_bytes`.
    Row::new(
        &["lanes.<lane>.queue_depth"],
        Whole(1, 4_096),
        "64 critical, 4 noncritical",
        "Samples of each route that may wait for the lane in shared memory. The critical lane needs at \
         least the rate times the longest delay of its process: 64 is two seconds at 30 Hz, 13 ms at 5 \
         kHz.",
    )
    .unit("samples"),
    Row::new(
        &["lanes.<lane>.max_borrowed"],
        Whole(1, 4_096),
        "8",
        "Samples of each route that the lane may hold in shared memory at once while DDS sends them. \
         Further samples are copied.",
    )
    .unit("samples"),
    Row::new(
        &["lanes.<lane>.by_reference_min_bytes"],
        Whole(0, 67_108_864),
        "65536",
        "Smaller samples are copied for the DDS writer, others passed by reference.",
    )
    .unit("bytes"),
    Row::new(
        &["lanes.<lane>.window_samples"],
        Whole(1, 100_000),
        "256",
        "Samples that a RELIABLE writer of the lane retains for subscribers that have not acknowledged \
         them, 32 MiB at most. Beyond that it evicts the oldest sample; a subscriber that has not \
         acknowledged that one misses it, which counts as its `reader_overrun`.",
    )
    .unit("samples"),
    Row::new(
        &["lanes.<lane>.max_rate_hz"],
        Decimal(0.0, 100000.0),
        "`routing_policy`: 10",
        "Rate in NORMAL. 0 forwards nothing.",
    )
    .unit("Hz")
    .reloads(),
    Row::new(
        &["lanes.<lane>.degraded_rate_hz"],
        Decimal(0.0, 100000.0),
        "`routing_policy.modes.degraded`; else 3, or the NORMAL rate if that is lower",
        "Rate in DEGRADED.",
    )
    .unit("Hz")
    .reloads(),
    // 1 TB/s is more than the bandwidth of any memory.
    Row::new(
        &["lanes.<lane>.max_bytes_per_s"],
        Whole(1, 1_000_000_000_000),
        "unlimited",
        "Payload bytes per second in NORMAL.",
    )
    .unit("bytes/s")
    .reloads(),
    Row::new(
        &["lanes.<lane>.degraded_max_bytes_per_s"],
        Whole(1, 1_000_000_000_000),
        "`max_bytes_per_s`",
        "The same in DEGRADED.",
    )
    .unit("bytes/s")
    .reloads(),
    Row::new(
        &["lanes.<lane>.stale_threshold_ms"],
        Whole(0, 86_400_000),
        "`routing_policy`: 200",
        "In NORMAL the lane drops a sample whose age, by its source timestamp, is larger. 0: never. If \
         the clock of the publisher's computer is constantly more than 100 ms behind or 50 ms ahead of \
         this one's, the age runs from the arrival instead, plus the delay beyond that publisher's \
         fastest samples; `status` then names the publisher and the offset. It does not apply to a \
         TRANSIENT_LOCAL output, whose samples may be old.",
    )
    .unit("ms")
    .reloads(),
    Row::new(
        &["lanes.<lane>.degraded_stale_threshold_ms"],
        Whole(0, 86_400_000),
        "`routing_policy.modes.degraded`, else `stale_threshold_ms` of the lane",
        "The same in DEGRADED.",
    )
    .unit("ms")
    .reloads(),
    Row::new(
        &["lanes.<lane>.drop_policy"],
        Choice(|| names(DROP_POLICIES)),
        "`routing_policy`",
        "Which samples are dropped when more wait than tokens accrue, in both modes. See below.",
    )
    .reloads(),
    Row::new(
        &["lanes.<lane>.queue_samples"],
        Whole(1, 4_096),
        "`noncritical_depth` of the mode",
        "Samples of each route that may wait in the lane for a token, in both modes. Keep it at or below \
         `safety.max_noncritical_queue`: a longer queue counts as overflowing, and suspends the \
         noncritical lanes for a while.",
    )
    .unit("samples")
    .reloads(),
    Row::new(
        &[
            "lanes.<lane>.scheduling.policy",
            "processes.ingress.scheduling.policy",
            "processes.control.scheduling.policy",
        ],
        Choice(|| names(SCHEDULING_POLICIES)),
        "`other`",
        "Linux scheduling policy of the process. `fifo` and `rr` need CAP_SYS_NICE or an rtprio limit.",
    ),
    Row::new(
        &[
            "lanes.<lane>.scheduling.priority",
            "processes.ingress.scheduling.priority",
            "processes.control.scheduling.priority",
        ],
        Whole(1, 99),
        "0",
        "Real-time priority. Must be given with `fifo` and `rr`, and only then.",
    )
    .note("; 0 with `other`"),
    Row::new(
        &[
            "lanes.<lane>.scheduling.nice",
            "processes.ingress.scheduling.nice",
            "processes.control.scheduling.nice",
        ],
        Whole(0, 19),
        "10 in noncritical lanes, else 0",
        "Nice value: a process with a higher one gets less CPU time beside others. Without effect with \
         `fifo` and `rr`, and below the value with which the process was started.",
    ),
    Row::new(
        &[
            "lanes.<lane>.scheduling.slice_ms",
            "processes.ingress.scheduling.slice_ms",
            "processes.control.scheduling.slice_ms",
        ],
        Decimal(0.1, 100.0),
        "0.1 on the critical path, 10 in noncritical lanes, control: the kernel's",
        "Time slice that the process requests from the kernel's fair scheduler: a process that wakes \
         preempts one with a longer slice at once ([why](../docs/decisions/0010-time-slices.md)). Needs \
         no privilege. Without effect with `fifo` and `rr`, and before Linux 6.12.",
    ),
    Row::new(
        &[
            "lanes.<lane>.scheduling.cpus",
            "processes.ingress.scheduling.cpus",
            "processes.control.scheduling.cpus",
        ],
        Other("list of 0 to 1023; empty for all"),
        "all",
        "CPUs that the process may run on.",
    ),
    Row::new(
        &[
            "lanes.<lane>.scheduling.lock_memory",
            "processes.ingress.scheduling.lock_memory",
            "processes.control.scheduling.lock_memory",
        ],
        Flag,
        "`false`",
        "Lock the memory of the process (`mlockall`), so that it has no page faults.",
    ),
    Row::new(
        &["shared_memory.root_path"],
        Other("absolute path"),
        "chosen by the program",
        "Folder of the bridge's own files.",
    ),
    Row::new(
        &["shared_memory.max_sample_bytes"],
        Whole(1, 67_108_864),
        "1048576",
        "The largest sample of a topic without `max_sample_bytes` of its own.",
    )
    .unit("bytes"),
    Row::new(&["shared_memory.max_taps"], Whole(0, 64), "2", "Local programs that may tap a route at once."),
];
