//! Reads the sections of the control process: classifier, probes, safety, security, diagnostics, overrides
//! and subscribers.

use std::collections::{BTreeMap, BTreeSet};
use std::net::SocketAddr;
use std::path::PathBuf;

use super::field::Field;
use super::settings::{
    Classifier, ClassifierThresholds, Diagnostics, Lane, MetricsListener, Probes, Safety, SafetyRules,
    SecretSource, Security,
};
use crate::model::{LaneName, MAX_SUBSCRIBERS, SubscriberState, TopicName, is_probe_id};

pub(super) fn classifier(root: &Field<'_>) -> Classifier {
    let section = root.section("classifier");
    let subscriber = section.get("subscriber_id").text().filter(|id| !id.is_empty());
    let classifier = Classifier {
        enabled: section.get("enabled").flag_or_default(),
        subscriber_id: subscriber.map(str::to_owned),
        evaluate_rate_hz: section.get("evaluate_rate_hz").decimal_or_default(),
        thresholds: ClassifierThresholds {
            demote_loss: section.get("demote_loss_threshold").decimal_or_default(),
            promote_loss: section.get("promote_loss_threshold").decimal_or_default(),
            demote_rtt_ms: section.get("demote_rtt_ms").decimal_or_default(),
            promote_rtt_ms: section.get("promote_rtt_ms").decimal_or_default(),
            hysteresis_count: section.get("hysteresis_count").count_or_default(),
            allow_unknown_state: section.get("allow_unknown_state").flag_or_default(),
        },
    };
    let ClassifierThresholds { demote_loss, promote_loss, demote_rtt_ms, promote_rtt_ms, .. } =
        classifier.thresholds;
    check_below(&section, ("promote_loss_threshold", promote_loss), ("demote_loss_threshold", demote_loss));
    check_below(&section, ("promote_rtt_ms", promote_rtt_ms), ("demote_rtt_ms", demote_rtt_ms));
    classifier
}

/// Checks that one threshold is below the other. Without a gap between them a subscriber would be promoted
/// and demoted alternately, and EMERGENCY would be called for at the same value as DEGRADED.
fn check_below(section: &Field<'_>, (lower, low): (&str, f64), (upper, high): (&str, f64)) {
    let (lower, upper) = (section.get(lower), section.get(upper));
    if low < high || lower.was_reported() || upper.was_reported() {
        return;
    }
    // The value to change is one that the file gives.
    if lower.is_given() {
        lower.report::<()>(&format!("must be below {} ({high})", upper.path));
    } else {
        upper.report::<()>(&format!("must be above {} ({low})", lower.path));
    }
}

/// Reads `probes`. `max_probe_rate_hz` is the rate that a responder accepts.
pub(super) fn probes(root: &Field<'_>, max_probe_rate_hz: u32) -> Probes {
    let section = root.section("probes");
    let rate = section.get("rate_hz");
    let request = section.get("request_topic");
    let response = section.get("response_topic");
    let probes = Probes {
        enabled: section.get("enabled").flag_or_default(),
        rate_hz: rate.decimal_or_default(),
        rtt_threshold_ms: section.get("rtt_threshold_ms").decimal_or_default(),
        loss_threshold: section.get("loss_threshold").decimal_or_default(),
        jitter_threshold_ms: section.get("jitter_threshold_ms").decimal_or_default(),
        window_size: section.get("window_size").count_or_default(),
        hysteresis_count: section.get("hysteresis_count").count_or_default(),
        timeout_ms: section.get("timeout_ms").count_or_default(),
        request_topic: topic(&request),
        response_topic: topic(&response),
    };
    if probes.rate_hz > f64::from(max_probe_rate_hz) && !rate.was_reported() {
        // Probes above the limit are not answered, and would count as lost.
        let allowed = format!("must be at most security.max_probe_rate_hz ({max_probe_rate_hz})");
        rate.report_value(&probes.rate_hz.to_string(), allowed);
    }
    if probes.request_topic == probes.response_topic && !request.was_reported() && !response.was_reported() {
        let given = if response.is_given() { response } else { request };
        given.report::<()>(
            "must not be the topic of the other direction: requests and responses need one each",
        );
    }
    probes
}

fn topic(field: &Field<'_>) -> TopicName {
    field.parsed_or_default(TopicName::ALLOWED, |text| TopicName::try_from(text).ok())
}

pub(super) fn safety(root: &Field<'_>) -> Safety {
    let section = root.section("safety");
    let flag = |name: &str| section.get(name).flag_or_default();
    let pair = |what: &str| {
        let (degraded, emergency) = (format!("degraded_{what}"), format!("emergency_{what}"));
        let [low, high] = [&degraded, &emergency].map(|name| section.get(name).decimal_or_default());
        check_below(&section, (&degraded, low), (&emergency, high));
        (low, high)
    };
    let (lag_ms, occupancy, errors_per_s) = (pair("lag_ms"), pair("queue_occupancy"), pair("errors_per_s"));
    let silent_ms = section.get("silent_ms").count_or_default();
    let emergency_silent_ms = section.get("emergency_silent_ms").count_or_default();
    if emergency_silent_ms != 0 {
        let emergency = ("emergency_silent_ms", emergency_silent_ms as f64);
        check_below(&section, ("silent_ms", silent_ms as f64), emergency);
    }
    Safety {
        evaluate_rate_hz: section.get("evaluate_rate_hz").decimal_or_default(),
        rules: SafetyRules {
            preserve_critical_path: flag("preserve_critical_path"),
            allow_noncritical_degrade: flag("allow_noncritical_degrade"),
            max_noncritical_queue: section.get("max_noncritical_queue").count_or_default(),
            overload_drop_noncritical_first: flag("overload_drop_noncritical_first"),
            degraded_lag_ms: lag_ms.0,
            emergency_lag_ms: lag_ms.1,
            degraded_queue_occupancy: occupancy.0,
            emergency_queue_occupancy: occupancy.1,
            degraded_errors_per_s: errors_per_s.0,
            emergency_errors_per_s: errors_per_s.1,
            silent_ms,
            emergency_silent_ms,
            hysteresis_count: section.get("hysteresis_count").count_or_default(),
            recovery_count: section.get("recovery_count").count_or_default(),
        },
    }
}

/// Reads `security`. The settings contain the source of the secret, not the secret.
pub(super) fn security(root: &Field<'_>) -> Security {
    let section = root.section("security");
    let inline = section.get("hmac_secret");
    let file = section.get("hmac_secret_file");
    let variable = section.get("hmac_secret_env");
    let in_config = inline.text().filter(|secret| !secret.is_empty()).map(|_| SecretSource::ConfigFile);
    let in_file = file.parsed("an absolute path", absolute_path).map(SecretSource::File);
    let in_variable = variable.parsed("the name of an environment variable: A-Z, a-z, 0-9 and _", |name| {
        let is_name = !name.is_empty()
            && !name.starts_with(|first: char| first.is_ascii_digit())
            && name.bytes().all(|byte| byte.is_ascii_alphanumeric() || byte == b'_');
        is_name.then(|| SecretSource::Environment(name.to_owned()))
    });
    let sources: Vec<(Field<'_>, SecretSource)> =
        [(inline, in_config), (file, in_file), (variable, in_variable)]
            .into_iter()
            .filter_map(|(field, source)| source.map(|source| (field, source)))
            .collect();
    if let [(first, _), others @ ..] = sources.as_slice() {
        for (field, _) in others {
            field.report_key(&format!("must not be given together with {}: use one of them", first.path));
        }
    }
    Security {
        trust_mode: section.get("trust_mode").choice_or_default(),
        enable_probe_hmac: section.get("enable_probe_hmac").flag_or_default(),
        secret: sources.into_iter().next().map(|(_, source)| source),
        replay_window_ms: section.get("replay_window_ms").count_or_default(),
        max_probe_rate_hz: section.get("max_probe_rate_hz").count_or_default(),
        allow_legacy_node_name_overrides: section.get("allow_legacy_node_name_overrides").flag_or_default(),
    }
}

pub(super) fn diagnostics(root: &Field<'_>) -> Diagnostics {
    let section = root.section("diagnostics");
    let interval_s = section.get("publish_interval_s").decimal_or_default();
    Diagnostics {
        enabled: section.get("enabled").flag_or_default(),
        publish_interval_ms: (interval_s * 1_000.0).round() as u64,
        topic: topic(&section.get("topic")),
        verbosity: section.get("verbosity").choice_or_default(),
        metrics: section.get("metrics").parsed(
            "a loopback address and port such as 127.0.0.1:9464, or unix: and an absolute path",
            metrics_listener,
        ),
    }
}

/// Parses the address of the metrics page. It must be reachable from this host only, because the page shows
/// without authentication what runs on the robot.
fn metrics_listener(text: &str) -> Option<MetricsListener> {
    if let Some(path) = text.strip_prefix("unix:") {
        // `sockaddr_un` has room for 107 bytes and a zero (unix(7)).
        return absolute_path(path).filter(|_| path.len() <= 107).map(MetricsListener::Unix);
    }
    let address: SocketAddr = text.parse().ok()?;
    let is_usable = address.ip().is_loopback() && address.port() != 0;
    is_usable.then(|| MetricsListener::Tcp(address.ip(), address.port()))
}

/// Parses an absolute path, which does not depend on the working directory.
pub(super) fn absolute_path(text: &str) -> Option<PathBuf> {
    let is_path = text.starts_with('/') && !text.contains('\0');
    is_path.then(|| PathBuf::from(text))
}

/// Reads `overrides`: states that the user forces.
pub(super) fn overrides(root: &Field<'_>) -> BTreeMap<String, SubscriberState> {
    let entries = root.get("overrides").entries();
    let states = entries.into_iter().filter_map(|(id, field)| {
        check_id(id, &field);
        field.choice().map(|state| (id.to_owned(), state))
    });
    states.collect()
}

/// Reads `subscribers`: the lane of each, as `id: lane` or `id: {lane: lane}`.
pub(super) fn subscribers(root: &Field<'_>, lanes: &[Lane]) -> BTreeMap<String, LaneName> {
    let names: Vec<&str> = lanes.iter().map(|lane| lane.name.as_str()).collect();
    let entries = root.get("subscribers").entries();
    let on_lanes = entries.into_iter().filter_map(|(id, field)| {
        check_id(id, &field);
        let lane = if field.is_map() { field.get("lane") } else { field };
        if !lane.is_given() && !lane.is_null() {
            return lane.report("must be a lane");
        }
        let found =
            lane.reference("a lane", &names, |name| lanes.iter().find(|lane| lane.name.as_str() == name));
        found.map(|lane| (id.to_owned(), lane.name.clone()))
    });
    on_lanes.collect()
}

/// Checks that control has a place for each subscriber that the configuration names.
pub(super) fn check_number_of_subscribers(root: &Field<'_>, classified: Option<&str>) {
    let mut named: BTreeSet<&str> = classified.into_iter().collect();
    for section in ["subscribers", "overrides"] {
        for (id, field) in root.get(section).entries() {
            if named.insert(id) && named.len() > MAX_SUBSCRIBERS {
                field.report_key(&format!(
                    "is one subscriber too many: `subscribers`, `overrides` and `classifier.subscriber_id` may \
                     name {MAX_SUBSCRIBERS} in all"
                ));
                return;
            }
        }
    }
}

/// Checks that a subscriber's id is valid in probe messages.
fn check_id(id: &str, field: &Field<'_>) {
    if !is_probe_id(id) {
        field.report_key("must be a subscriber's id: 1 to 127 bytes without control characters");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::load::parse;
    use crate::config::problem::Problems;

    #[test]
    fn the_default_topics_are_valid_topic_names() {
        let problems = Problems::default();
        let root = Field::root(None, &problems);
        assert_eq!(probes(&root, 20).request_topic.as_str(), "/adaptive_bridge/probe_req");
        assert_eq!(probes(&root, 20).response_topic.as_str(), "/adaptive_bridge/probe_resp");
        assert_eq!(diagnostics(&root).topic.as_str(), "/adaptive_bridge/diagnostics");
        assert!(problems.into_inner().is_empty());
    }

    #[test]
    fn no_more_subscribers_may_be_named_than_control_has_places_for() {
        let yaml = |listed: std::ops::Range<usize>| {
            let lines = |state: &'static str| move |id: usize| format!("  s{id}: {state}\n");
            let subscribers: String = listed.clone().map(lines("noncritical")).collect();
            let overrides: String = listed.map(lines("UNKNOWN")).collect();
            format!(
                "topics: [{{id: scan, input_topic: /scan}}]\nclassifier: {{subscriber_id: s0}}\n\
                 subscribers:\n{subscribers}overrides:\n{overrides}"
            )
        };
        let problems = |yaml: &str| parse(yaml, "f.yaml", &|_| None).err().map(|error| error.to_string());
        assert_eq!(problems(&yaml(0..64)), None);
        let error = problems(&yaml(0..65)).unwrap();
        assert!(error.contains("subscribers.s64") && error.contains("may name 64 in all"), "{error}");
        assert!(problems(&yaml(1..65)).is_some());
    }

    #[test]
    fn the_metrics_page_is_reachable_from_this_host_only() {
        let tcp = |address: &str| MetricsListener::Tcp(address.parse().unwrap(), 9464);
        assert_eq!(metrics_listener("127.0.0.1:9464"), Some(tcp("127.0.0.1")));
        assert_eq!(metrics_listener("[::1]:9464"), Some(tcp("::1")));
        let unix = MetricsListener::Unix("/run/bridge.sock".into());
        assert_eq!(metrics_listener("unix:/run/bridge.sock"), Some(unix));
        let long = format!("unix:/{}", "x".repeat(107));
        for wrong in
            ["0.0.0.0:9464", "127.0.0.1:0", "127.0.0.1", "192.168.0.1:80", "unix:run.sock", "", &long]
        {
            assert_eq!(metrics_listener(wrong), None, "{wrong:?}");
        }
    }
}
