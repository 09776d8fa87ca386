//! The settings as ROS 2 parameters: a name, a typed value and the declaration of the key for each.

use super::keys::{Row, row_at};
use super::settings::{Settings, TrustMode};
use super::shown::Value;

/// One setting as a ROS 2 parameter.
#[derive(Clone, Debug)]
pub struct Listed {
    /// The key path. A route is named by its id: `topics.scan.max_sample_bytes`.
    pub name: String,
    /// The value in force.
    pub value: Value,
    /// The declaration of its key.
    pub row: &'static Row,
}

/// The entries that a user may add to these sections; each is one setting.
const OPEN_SECTIONS: [&str; 2] = ["overrides.", "subscribers."];

/// The keys that cannot be set as parameters, because any host on the network can set parameters: a change
/// of `safety` or `policy_hold_s` could stop critical lanes, and one of `security` could admit forged
/// messages.
const FILE_ONLY: [&str; 3] = ["safety.", "security.", "policy_hold_s"];

/// The key of the secret and of its source, which is not listed.
const SECRET: &str = "security.hmac_secret";

impl Listed {
    /// Whether the parameter `name`, whose key is declared by `row`, can be set in a running bridge.
    pub fn is_settable(name: &str, row: &Row) -> bool {
        row.reloads && !Self::is_file_only(name)
    }

    /// Whether only the configuration file may change the parameter `name`.
    pub fn is_file_only(name: &str) -> bool {
        FILE_ONLY.iter().any(|start| name.starts_with(start))
    }

    /// The declaration of a parameter that is not set yet and can be: a forced state or the lane of a
    /// subscriber.
    pub fn unset(name: &str) -> Option<&'static Row> {
        let is_open = OPEN_SECTIONS.iter().any(|section| name.starts_with(section));
        let is_name = name.split('.').count() == 2 && !name.chars().any(char::is_control);
        row_at(name).filter(|_| is_open && is_name)
    }
}

impl Settings {
    /// Every setting that has a key of its own, without secrets. Those that several keys determine, such as
    /// `routing_policy`, are listed by the key of the lane.
    pub fn listed(&self) -> Vec<Listed> {
        let mut listed = Vec::new();
        for (path, value) in self.values() {
            // The id of a subscriber may have dots.
            let section = OPEN_SECTIONS.iter().find(|section| path.starts_with(**section));
            let row = section.map_or_else(|| row_at(&path), |section| row_at(&format!("{section}id")));
            let Some(row) = row.filter(|_| path != SECRET) else { continue };
            let name = named_by_id(&path);
            // The depth of an output that follows its publishers' durability is already in `history`.
            if name.ends_with(".depth") && matches!(value, Value::Text(_)) {
                continue;
            }
            // HISTORY is two keys in the file.
            if let (Some(policies), Value::Text(text)) = (path.strip_suffix(".history"), &value)
                && let Some((kind, depth)) = text.split_once(' ')
            {
                let path = format!("{policies}.depth");
                let depth = depth.parse().ok().map(Value::Whole).zip(row_at(&path));
                listed.extend(depth.map(|(value, row)| Listed { name: named_by_id(&path), value, row }));
                listed.push(Listed { value: Value::Text(kind.to_owned()), name, row });
                continue;
            }
            listed.push(Listed { name, value, row });
        }
        listed.sort_by(|one, other| one.name.cmp(&other.name));
        listed
    }

    /// Whether control messages that are not authentic are refused, such as a request to set a parameter.
    pub fn refuses_unsigned(&self) -> bool {
        self.security.enable_probe_hmac && self.security.trust_mode == TrustMode::DefaultDeny
    }
}

/// `topics.scan.id` of `topics[scan].id`.
fn named_by_id(path: &str) -> String {
    path.replacen('[', ".", 1).replacen(']', "", 1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::parse;

    fn settings(text: &str) -> Settings {
        let text = format!("topics: [{{id: scan, input_topic: /scan}}]\n{text}");
        parse(&text, "f.yaml", &|_| None).unwrap_or_else(|error| panic!("{error}"))
    }

    #[test]
    fn each_setting_is_listed_once_by_its_key_and_a_secret_is_not() {
        let listed = settings(
            "lanes: {noncritical: {qos: {history: KEEP_ALL}}}\noverrides: {laptop: critical}\n\
             security: {hmac_secret: swordfish}\n",
        )
        .listed();
        let text = |text: &str| Some(Value::Text(text.to_owned()));
        let critical = "topics.scan.qos_overrides.critical";
        for (name, expected) in [
            ("probes.rate_hz", Some(Value::Decimal(5.0))),
            ("topics.scan.input_topic", text("/scan")),
            ("overrides.laptop", text("CRITICAL")),
            (&format!("{critical}.history"), text("KEEP_LAST")),
            (&format!("{critical}.depth"), Some(Value::Whole(10))),
            ("topics.scan.qos_overrides.noncritical.history", text("KEEP_ALL")),
            ("topics.scan.qos_overrides.noncritical.depth", None),
            ("security.hmac_secret", None),
        ] {
            let found: Vec<_> = listed.iter().filter(|listed| listed.name == name).collect();
            assert_eq!(
                found.iter().map(|listed| &listed.value).collect::<Vec<_>>(),
                Vec::from_iter(&expected)
            );
            let row = row_at(&name.replace("topics.scan", "topics[scan]")).unwrap();
            assert!(found.iter().all(|listed| std::ptr::eq(listed.row, row)), "{name}");
        }
        assert!(listed.is_sorted_by(|one, other| one.name < other.name), "each once, in order");
    }

    #[test]
    fn what_can_stop_lanes_or_admit_messages_can_be_set_in_the_file_only() {
        for (name, is_settable, is_file_only) in [
            ("probes.rate_hz", true, false),
            ("probes.request_topic", false, false),
            ("policy_hold_s", false, true),
            ("safety.silent_ms", false, true),
            ("security.trust_mode", false, true),
        ] {
            let row = row_at(name).unwrap();
            assert_eq!(Listed::is_settable(name, row), is_settable, "{name}");
            assert_eq!(Listed::is_file_only(name), is_file_only, "{name}");
        }
    }

    #[test]
    fn only_the_state_or_lane_of_a_subscriber_can_be_set_without_being_listed() {
        for name in ["overrides.laptop", "subscribers.laptop"] {
            assert_eq!(Listed::unset(name).unwrap().paths, row_at(name).unwrap().paths, "{name}");
        }
        for name in
            ["overrides", "overrides.a.b", "overrides.a\nb", "subscribers.laptop.lane", "probes.rate_hz"]
        {
            assert!(Listed::unset(name).is_none(), "{name}");
        }
    }

    #[test]
    fn unsigned_messages_are_refused_if_messages_are_signed_and_unknown_senders_denied() {
        for (signed, trust_mode, refuses) in
            [(true, "default_deny", true), (true, "permissive", false), (false, "default_deny", false)]
        {
            let settings = settings(&format!(
                "security: {{enable_probe_hmac: {signed}, hmac_secret: swordfish, trust_mode: {trust_mode}}}\n"
            ));
            assert_eq!(settings.refuses_unsigned(), refuses, "{signed} {trust_mode}");
        }
    }
}
