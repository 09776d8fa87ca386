//! The keys of the policies and of the control process.

use super::row::Kind::{Choice, Decimal, Flag, Other, Whole};
use super::row::{AGE, Kind, Row, TOPIC, reloads, restarts};
use crate::config::choices::words;
use crate::config::settings::{DropPolicy, TrustMode, Verbosity};
use crate::model::SubscriberState;

const QUEUE: Kind = Whole(0, 4_096, " samples");

pub(super) const ROWS: &[Row] = &[
    restarts(&["routing_policy.critical_always_forward"], Other("`true`"), "`true`").doc(
        "Critical lanes forward in every mode but EMERGENCY. They always do; the key exists for files of \
         the original package.",
    ),
    reloads(&["routing_policy.noncritical_enabled"], Flag, "`true`")
        .doc("`false`: noncritical lanes forward nothing, at any configured rate."),
    reloads(&["routing_policy.noncritical_max_rate_hz"], Decimal(0.0, 100000.0, " Hz"), "10")
        .doc("Rate in lane mode `normal`."),
    reloads(&["routing_policy.noncritical_drop_policy"], Choice(words::<DropPolicy>), "`drop_oldest`")
        .doc("Drop policy in all modes."),
    reloads(&["routing_policy.stale_threshold_ms"], AGE, "200")
        .doc("Age limit in all modes. 0: never stale."),
    reloads(
        &["routing_policy.modes.<mode>.noncritical_max_rate_hz"],
        Decimal(0.0, 100000.0, " Hz; 0 in the last three"),
        "10, 3, 0",
    )
    .doc(
        "Rate in this mode: `normal`, `degraded`, and `disabled`, `emergency`, `failure`, in which \
         noncritical lanes forward nothing.",
    ),
    reloads(&["routing_policy.modes.<mode>.noncritical_depth"], QUEUE, "5 normal, 2 degraded")
        .doc("Samples of each route that may wait in a lane until the rate allows them; 0 counts as 1."),
    reloads(
        &["routing_policy.modes.<mode>.noncritical_drop_policy"],
        Choice(words::<DropPolicy>),
        "`routing_policy.noncritical_drop_policy`",
    )
    .doc("Drop policy in this mode."),
    reloads(&["routing_policy.modes.<mode>.stale_threshold_ms"], AGE, "`routing_policy.stale_threshold_ms`")
        .doc("Age limit in this mode."),
    reloads(&["routing_policy.modes.<mode>.max_noncritical_queue"], QUEUE, "`safety.max_noncritical_queue`")
        .doc("Upper limit of `noncritical_depth`."),
    reloads(&["classifier.enabled"], Flag, "`true`")
        .doc("Whether control classifies subscribers. If not, each is UNKNOWN unless it is forced."),
    reloads(&["classifier.subscriber_id"], Other("text"), "empty")
        .doc("The only responder that counts; empty for any."),
    reloads(&["classifier.evaluate_rate_hz"], Decimal(0.01, 1000.0, " Hz"), "2")
        .doc("Evaluations per second."),
    reloads(&["classifier.demote_loss_threshold"], Decimal(0.0, 1.0, ""), "0.015")
        .doc("Loss above which a reading counts for demotion."),
    reloads(&["classifier.promote_loss_threshold"], Decimal(0.0, 1.0, ""), "0.005")
        .doc("Loss below which a reading counts for promotion."),
    reloads(&["classifier.demote_rtt_ms"], Decimal(0.0, 3600000.0, " ms"), "50")
        .doc("Mean RTT above which a reading counts for demotion."),
    reloads(&["classifier.promote_rtt_ms"], Decimal(0.0, 3600000.0, " ms"), "35")
        .doc("Mean RTT below which a reading counts for promotion."),
    reloads(&["classifier.hysteresis_count"], Whole(1, 1_000, ""), "3")
        .doc("Consecutive readings required for a change of state."),
    reloads(&["classifier.allow_unknown_state"], Flag, "`true`")
        .doc("Whether UNKNOWN is a separate state; otherwise it is treated as CRITICAL."),
    reloads(&["probes.enabled"], Flag, "`true`").doc("Whether probes are sent."),
    reloads(&["probes.rate_hz"], Decimal(0.01, 1000.0, " Hz"), "5")
        .doc("Probes per second; at most `security.max_probe_rate_hz`."),
    reloads(&["probes.rtt_threshold_ms"], Decimal(0.0, 3600000.0, " ms"), "100")
        .doc("`status` shows a warning above it. It has no other effect."),
    reloads(&["probes.loss_threshold"], Decimal(0.0, 1.0, ""), "0.05")
        .doc("`status` shows a warning above it. It has no other effect."),
    reloads(&["probes.jitter_threshold_ms"], Decimal(0.0, 3600000.0, " ms"), "25")
        .doc("`status` shows a warning above it. It has no other effect."),
    reloads(&["probes.window_size"], Whole(1, 10_000, ""), "50").doc("Probes in the sliding window."),
    reloads(&["probes.hysteresis_count"], Whole(1, 1_000, ""), "3")
        .doc("Consecutive readings before a warning appears or disappears."),
    reloads(&["probes.timeout_ms"], Whole(1, 60_000, " ms"), "500").doc("A later response counts as lost."),
    restarts(&["probes.request_topic"], TOPIC, "`/adaptive_bridge/probe_req`").doc("Topic of the requests."),
    restarts(&["probes.response_topic"], TOPIC, "`/adaptive_bridge/probe_resp`")
        .doc("Topic of the responses, different from the former."),
    reloads(&["subscribers.<subscriber>"], Other("a lane"), "none listed").doc(
        "The lane of a known subscriber, by its id: `laptop: rviz`, or `laptop: {lane: rviz}`. This and \
         `overrides` may name 64 subscribers in all.",
    ),
    reloads(&["subscribers.<subscriber>.lane"], Other("a lane"), "must be given, or `null`")
        .doc("The same, in the second form."),
    reloads(&["overrides.<subscriber>"], Choice(words::<SubscriberState>), "none")
        .doc("A forced state of the link, as under [classifier](#classifier)."),
    reloads(&["safety.preserve_critical_path"], Flag, "`true`").doc(
        "Whether critical lanes continue in DEGRADED. `false` stops them there, too, but never for faults \
         of noncritical lanes alone.",
    ),
    reloads(&["safety.allow_noncritical_degrade"], Flag, "`true`").doc(
        "Whether the classifier and the supervisor may degrade noncritical lanes. EMERGENCY stops them in \
         any case.",
    ),
    reloads(&["safety.max_noncritical_queue"], Whole(1, 4_096, " samples"), "50")
        .doc("If more samples of a route wait in a noncritical lane, its queue counts as overflowing."),
    reloads(&["safety.overload_drop_noncritical_first"], Flag, "`true`").doc(
        "Whether overload suspends the noncritical lanes first: EMERGENCY then follows only if DEGRADED \
         has not helped.",
    ),
    // At intervals below 50 ms a few errors would count as many errors per second.
    reloads(&["safety.evaluate_rate_hz"], Decimal(0.1, 20.0, " Hz"), "2").doc("Evaluations per second."),
    reloads(&["safety.degraded_lag_ms"], Decimal(1.0, 3600000.0, " ms"), "500").doc(
        "A reading with at least this p99 of a lane's lag from shared memory to its writer, or this growth \
             of the lag from a publisher to shared memory, counts for DEGRADED.",
    ),
    reloads(&["safety.emergency_lag_ms"], Decimal(1.0, 3600000.0, " ms"), "2000").doc(
        "A reading with at least this p99 of a critical lane's lag, from shared memory to its writer, \
         counts for EMERGENCY.",
    ),
    reloads(&["safety.degraded_queue_occupancy"], Decimal(0.01, 1.0, ""), "0.75")
        .doc("A reading with at least this share of a critical lane's queue in use counts for DEGRADED."),
    reloads(&["safety.emergency_queue_occupancy"], Decimal(0.01, 1.0, ""), "0.95")
        .doc("The same for EMERGENCY."),
    // The greatest value is more than any process can count.
    reloads(&["safety.degraded_errors_per_s"], Decimal(0.1, 1000000.0, " per s"), "5").doc(
        "A reading with at least so many errors of one process per second counts for DEGRADED: samples \
         lost in shared memory, writes that DDS refuses, restarts.",
    ),
    reloads(&["safety.emergency_errors_per_s"], Decimal(0.1, 1000000.0, " per s"), "100").doc(
        "A reading with at least so many samples per second that one process of the critical path loses \
         in shared memory (`queue_overflow`, `pool_exhausted`) counts for EMERGENCY.",
    ),
    // An idle process makes a turn about every 100 ms.
    reloads(&["safety.silent_ms"], Whole(500, 3_600_000, " ms"), "2000").doc(
        "A process without a turn for so long is silent: this counts for DEGRADED on the critical path, \
         and as an error a second elsewhere.",
    ),
    reloads(&["safety.emergency_silent_ms"], Whole(0, 3_600_000, " ms"), "30000")
        .doc("A reading with so long a silence on the critical path counts for EMERGENCY; 0: never."),
    reloads(&["safety.hysteresis_count"], Whole(1, 1_000, ""), "3")
        .doc("Consecutive readings required for each step up."),
    reloads(&["safety.recovery_count"], Whole(1, 1_000, ""), "10")
        .doc("Consecutive readings required for each step back."),
    reloads(&["security.trust_mode"], Choice(words::<TrustMode>), "`default_deny`").doc(
        "With `enable_probe_hmac`: control messages that are not authentic are refused (`default_deny`), \
         accepted and logged (`permissive`), or accepted (`off`).",
    ),
    reloads(&["security.allow_legacy_node_name_overrides"], Flag, "`true`").doc(
        "Without effect: responses have no node name. The key exists for files of the original package.",
    ),
    reloads(&["security.enable_probe_hmac"], Flag, "`false`").doc(
        "Whether probes and responses are signed ([protocol](../docs/probe-protocol.md)). Needs a secret \
         that control and every responder share. Without this key nothing is signed or checked, in any \
         `trust_mode`.",
    ),
    reloads(&["security.max_probe_rate_hz"], Whole(1, 10_000, " Hz, whole"), "20").doc(
        "Requests of one sender that a responder processes per second, and responses of one sender to its \
             own probes that control does. Control decodes other messages, too, and refuses them; that has \
             no such limit.",
    ),
    reloads(&["security.hmac_secret"], Other("text"), "none").doc(
        "The shared secret itself; empty for none. Every user who can read the file has it: prefer one of \
         the next two. At most one of the three may be given.",
    ),
    reloads(&["security.hmac_secret_file"], Other("absolute path"), "none")
        .doc("A file whose first line is the secret."),
    reloads(&["security.hmac_secret_env"], Other("`A-Z`, `a-z`, `0-9`, `_`, no digit first"), "none")
        .doc("An environment variable whose value is the secret."),
    reloads(&["security.replay_window_ms"], Whole(1, 86_400_000, " ms"), "30000")
        .doc("How old a signed message may be."),
    reloads(&["diagnostics.enabled"], Flag, "`true`").doc("Whether diagnostics are published."),
    reloads(&["diagnostics.publish_interval_s"], Decimal(0.01, 3600.0, " s"), "1")
        .doc("Interval of publication."),
    restarts(&["diagnostics.topic"], TOPIC, "`/adaptive_bridge/diagnostics`")
        .doc("Topic: JSON in `std_msgs/String`."),
    reloads(&["diagnostics.verbosity"], Choice(words::<Verbosity>), "`info`").doc(
        "Log level of the processes where `RUST_LOG` sets none. Libraries only log errors. `up` itself \
         applies it when it restarts.",
    ),
    restarts(
        &["diagnostics.metrics"],
        Other(
            "a loopback address and port (`127.0.0.1:9464`), or `unix:` and an absolute path of at most \
             107 bytes",
        ),
        "no page",
    )
    .doc("Address of the Prometheus page, on this machine only."),
];
