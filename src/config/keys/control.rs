//! The keys of the policies and of the control process.

use super::row::Kind::{Choice, Decimal, Flag, Other, Whole};
use super::row::{Row, names};
use crate::config::choices::{DROP_POLICIES, STATES, TRUST_MODES, VERBOSITIES};

pub(super) const ROWS: &[Row] = &[
    Row::new(
        &["routing_policy.critical_always_forward"],
        Other("`true`"),
        "`true`",
        "Critical lanes forward in every mode but EMERGENCY. They always do; the key exists for files of \
         the original package.",
    ),
    Row::new(
        &["routing_policy.noncritical_enabled"],
        Flag,
        "`true`",
        "`false`: noncritical lanes forward nothing, at any configured rate.",
    )
    .reloads(),
    Row::new(&["routing_policy.noncritical_max_rate_hz"], Decimal(0.0, 100000.0), "10", "Rate in NORMAL.")
        .unit("Hz")
        .reloads(),
    Row::new(
        &["routing_policy.noncritical_drop_policy"],
        Choice(|| names(DROP_POLICIES)),
        "`drop_oldest`",
        "Drop policy in all modes.",
    )
    .reloads(),
    Row::new(
        &["routing_policy.stale_threshold_ms"],
        Whole(0, 86_400_000),
        "200",
        "Age limit in all modes. 0: never stale.",
    )
    .unit("ms")
    .reloads(),
    Row::new(
        &["routing_policy.modes.<mode>.noncritical_max_rate_hz"],
        Decimal(0.0, 100000.0),
        "10, 3, 0",
        "Rate in this mode: `normal`, `degraded`, and `disabled`, `emergency`, `failure`, in which \
         noncritical lanes forward nothing.",
    )
    .unit("Hz")
    .note("; 0 in the last three")
    .reloads(),
    Row::new(
        &["routing_policy.modes.<mode>.noncritical_depth"],
        Whole(0, 4_096),
        "5 normal, 2 degraded",
        "Samples of each route that may wait in a lane for a token; 0 counts as 1.",
    )
    .unit("samples")
    .reloads(),
    Row::new(
        &["routing_policy.modes.<mode>.noncritical_drop_policy"],
        Choice(|| names(DROP_POLICIES)),
        "`routing_policy.noncritical_drop_policy`",
        "Drop policy in this mode.",
    )
    .reloads(),
    Row::new(
        &["routing_policy.modes.<mode>.stale_threshold_ms"],
        Whole(0, 86_400_000),
        "`routing_policy.stale_threshold_ms`",
        "Age limit in this mode.",
    )
    .unit("ms")
    .reloads(),
    Row::new(
        &["routing_policy.modes.<mode>.max_noncritical_queue"],
        Whole(0, 4_096),
        "`safety.max_noncritical_queue`",
        "Upper limit of `noncritical_depth`.",
    )
    .unit("samples")
    .reloads(),
    Row::new(
        &["classifier.enabled"],
        Flag,
        "`true`",
        "Whether control classifies subscribers. If not, each is UNKNOWN unless it is forced.",
    )
    .reloads(),
    Row::new(
        &["classifier.subscriber_id"],
        Other("text"),
        "empty",
        "The only responder that counts; empty for any.",
    )
    .reloads(),
    Row::new(&["classifier.evaluate_rate_hz"], Decimal(0.01, 1000.0), "2", "Evaluations per second.")
        .unit("Hz")
        .reloads(),
    Row::new(
        &["classifier.demote_loss_threshold"],
        Decimal(0.0, 1.0),
        "0.015",
        "Loss above which a reading counts for demotion.",
    )
    .reloads(),
    Row::new(
        &["classifier.promote_loss_threshold"],
        Decimal(0.0, 1.0),
        "0.005",
        "Loss below which a reading counts for promotion.",
    )
    .reloads(),
    Row::new(
        &["classifier.demote_rtt_ms"],
        Decimal(0.0, 3600000.0),
        "50",
        "Mean RTT above which a reading counts for demotion.",
    )
    .unit("ms")
    .reloads(),
    Row::new(
        &["classifier.promote_rtt_ms"],
        Decimal(0.0, 3600000.0),
        "35",
        "Mean RTT below which a reading counts for promotion.",
    )
    .unit("ms")
    .reloads(),
    Row::new(
        &["classifier.hysteresis_count"],
        Whole(1, 1_000),
        "3",
        "Consecutive readings required for a change of state.",
    )
    .reloads(),
    Row::new(
        &["classifier.allow_unknown_state"],
        Flag,
        "`true`",
        "Whether UNKNOWN is a separate state; otherwise it is treated as CRITICAL.",
    )
    .reloads(),
    Row::new(&["probes.enabled"], Flag, "`true`", "Whether probes are sent.").reloads(),
    Row::new(
        &["probes.rate_hz"],
        Decimal(0.01, 1000.0),
        "5",
        "Probes per second; at most `security.max_probe_rate_hz`.",
    )
    .unit("Hz")
    .reloads(),
    Row::new(
        &["probes.rtt_threshold_ms"],
        Decimal(0.0, 3600000.0),
        "100",
        "`status` shows a warning above it. It has no other effect.",
    )
    .unit("ms")
    .reloads(),
    Row::new(
        &["probes.loss_threshold"],
        Decimal(0.0, 1.0),
        "0.05",
        "`status` shows a warning above it. It has no other effect.",
    )
    .reloads(),
    Row::new(
        &["probes.jitter_threshold_ms"],
        Decimal(0.0, 3600000.0),
        "25",
        "`status` shows a warning above it. It has no other effect.",
    )
    .unit("ms")
    .reloads(),
    Row::new(&["probes.window_size"], Whole(1, 10_000), "50", "Probes in the sliding window.").reloads(),
    Row::new(
        &["probes.hysteresis_count"],
        Whole(1, 1_000),
        "3",
        "Consecutive readings before a warning appears or disappears.",
    )
    .reloads(),
    Row::new(&["probes.timeout_ms"], Whole(1, 60_000), "500", "A later response counts as lost.")
        .unit("ms")
        .reloads(),
    Row::new(
        &["probes.request_topic"],
        Other("absolute topic name"),
        "`/adaptive_bridge/probe_req`",
        "Topic of the requests.",
    ),
    Row::new(
        &["probes.response_topic"],
        Other("absolute topic name"),
        "`/adaptive_bridge/probe_resp`",
        "Topic of the responses, different from the former.",
    ),
    Row::new(
        &["subscribers.<subscriber>"],
        Other("a lane"),
        "none listed",
        "The lane of a known subscriber, by its id: `laptop: rviz`, or `laptop: {lane: rviz}`.",
    )
    .reloads(),
    Row::new(
        &["subscribers.<subscriber>.lane"],
        Other("a lane"),
        "must be given, or `null`",
        "The same, in the second form.",
    )
    .reloads(),
    Row::new(&["overrides.<subscriber>"], Choice(|| names(STATES)), "none", "A forced state.").reloads(),
    Row::new(
        &["safety.preserve_critical_path"],
        Flag,
        "`true`",
        "Whether critical lanes continue in DEGRADED. `false` stops them there, too, but never for faults \
         of noncritical lanes alone.",
    )
    .reloads(),
    Row::new(
        &["safety.allow_noncritical_degrade"],
        Flag,
        "`true`",
        "Whether the classifier and the supervisor may degrade noncritical lanes. EMERGENCY stops them in \
         any case.",
    )
    .reloads(),
    Row::new(
        &["safety.max_noncritical_queue"],
        Whole(1, 4_096),
        "50",
        "If more samples of a route wait in a noncritical lane, its queue counts as overflowing.",
    )
    .unit("samples")
    .reloads(),
    Row::new(
        &["safety.overload_drop_noncritical_first"],
        Flag,
        "`true`",
        "Whether overload suspends the noncritical lanes first: EMERGENCY then follows only if DEGRADED \
         has not helped.",
    )
    .reloads(),
    // At intervals below 50 ms a few errors would count as many errors per second.
    Row::new(&["safety.evaluate_rate_hz"], Decimal(0.1, 20.0), "2", "Evaluations per second.")
        .unit("Hz")
        .reloads(),
    Row::new(
        &["safety.degraded_lag_ms"],
        Decimal(1.0, 3600000.0),
        "500",
        "A reading with at least this p99 of the processing lag counts for DEGRADED.",
    )
    .unit("ms")
    .reloads(),
    Row::new(
        &["safety.emergency_lag_ms"],
        Decimal(1.0, 3600000.0),
        "2000",
        "A reading with at least this p99 of a critical lane's lag, from shared memory to its writer, \
         counts for EMERGENCY.",
    )
    .unit("ms")
    .reloads(),
    Row::new(
        &["safety.degraded_queue_occupancy"],
        Decimal(0.01, 1.0),
        "0.75",
        "A reading with at least this share of a critical lane's queue in use counts for DEGRADED.",
    )
    .reloads(),
    Row::new(&["safety.emergency_queue_occupancy"], Decimal(0.01, 1.0), "0.95", "The same for EMERGENCY.")
        .reloads(),
    // The greatest value is more than any process can count.
    Row::new(
        &["safety.degraded_errors_per_s"],
        Decimal(0.1, 1000000.0),
        "5",
        "A reading with at least so many errors of one process per second counts for DEGRADED: samples \
         lost in shared memory, writes that DDS refuses, restarts.",
    )
    .unit("per s")
    .reloads(),
    Row::new(
        &["safety.emergency_errors_per_s"],
        Decimal(0.1, 1000000.0),
        "100",
        "A reading with at least so many samples per second that one process of the critical path loses \
         in shared memory (`queue_overflow`, `pool_exhausted`) counts for EMERGENCY.",
    )
    .unit("per s")
    .reloads(),
    // An idle process makes a turn about every 100 ms.
    Row::new(
        &["safety.silent_ms"],
        Whole(500, 3_600_000),
        "2000",
        "A process without a turn for so long is silent: this counts for DEGRADED on the critical path, \
         and as an error a second elsewhere.",
    )
    .unit("ms")
    .reloads(),
    Row::new(
        &["safety.emergency_silent_ms"],
        Whole(0, 3_600_000),
        "30000",
        "A reading with so long a silence on the critical path counts for EMERGENCY; 0: never.",
    )
    .unit("ms")
    .reloads(),
    Row::new(
        &["safety.hysteresis_count"],
        Whole(1, 1_000),
        "3",
        "Consecutive readings required for each step up.",
    )
    .reloads(),
    Row::new(
        &["safety.recovery_count"],
        Whole(1, 1_000),
        "10",
        "Consecutive readings required for each step back.",
    )
    .reloads(),
    Row::new(
        &["security.trust_mode"],
        Choice(|| names(TRUST_MODES)),
        "`default_deny`",
        "With `enable_probe_hmac`: control messages that are not authentic are refused (`default_deny`), \
         accepted and logged (`permissive`), or accepted (`off`).",
    )
    .reloads(),
    Row::new(
        &["security.allow_legacy_node_name_overrides"],
        Flag,
        "`true`",
        "Whether an override may name a subscriber by its node name.",
    )
    .reloads(),
    Row::new(
        &["security.enable_probe_hmac"],
        Flag,
        "`false`",
        "Whether probes and responses are signed ([protocol](../docs/probe-protocol.md)). Needs a secret \
         that control and every responder share. Without this key nothing is signed or checked, in any \
         `trust_mode`.",
    )
    .reloads(),
    Row::new(
        &["security.max_probe_rate_hz"],
        Whole(1, 10_000),
        "20",
        "Probes and responses of one sender that are processed per second.",
    )
    .unit("Hz")
    .note(", whole")
    .reloads(),
    Row::new(
        &["security.hmac_secret"],
        Other("text"),
        "none",
        "The shared secret itself; empty for none. Every user who can read the file has it: prefer one of \
         the next two. At most one of the three may be given.",
    )
    .reloads(),
    Row::new(
        &["security.hmac_secret_file"],
        Other("absolute path"),
        "none",
        "A file whose first line is the secret.",
    )
    .reloads(),
    Row::new(
        &["security.hmac_secret_env"],
        Other("`A-Z`, `a-z`, `0-9`, `_`, no digit first"),
        "none",
        "An environment variable whose value is the secret.",
    )
    .reloads(),
    Row::new(
        &["security.replay_window_ms"],
        Whole(1, 86_400_000),
        "30000",
        "How old a signed message may be.",
    )
    .unit("ms")
    .reloads(),
    Row::new(&["diagnostics.enabled"], Flag, "`true`", "Whether diagnostics are published.").reloads(),
    Row::new(&["diagnostics.publish_interval_s"], Decimal(0.01, 3600.0), "1", "Interval of publication.")
        .unit("s")
        .reloads(),
    Row::new(
        &["diagnostics.topic"],
        Other("absolute topic name"),
        "`/adaptive_bridge/diagnostics`",
        "Topic: JSON in `std_msgs/String`.",
    ),
    Row::new(
        &["diagnostics.verbosity"],
        Choice(|| names(VERBOSITIES)),
        "`info`",
        "Log level of the processes where `RUST_LOG` sets none. Libraries only log errors. `up` itself \
         applies it when it restarts.",
    )
    .reloads(),
    Row::new(
        &["diagnostics.metrics"],
        Other(
            "a loopback address and port (`127.0.0.1:9464`), or `unix:` and an absolute path of at most \
             107 bytes",
        ),
        "no page",
        "Address of the Prometheus page, on this machine only.",
    ),
];
