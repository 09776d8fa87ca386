//! The answers about parameters: names, values, types, descriptors.

use std::collections::BTreeSet;

use super::messages::{
    BOOL, DOUBLE, DecimalRange, Descriptor, INTEGER, ListReply, ListRequest, LoggerLevel, NOT_SET,
    ParameterValue, STRING, WholeRange, signed,
};
use crate::config::{Kind, Listed, Settings, Value, Verbosity};

/// The parameters of the settings in force, in the order of their names.
pub(super) struct Parameters {
    pub settings: Settings,
    listed: Vec<Listed>,
}

impl Parameters {
    pub fn new(settings: Settings) -> Self {
        Self { listed: settings.listed(), settings }
    }

    pub fn find(&self, name: &str) -> Option<&Listed> {
        let found = self.listed.binary_search_by(|listed| listed.name.as_str().cmp(name));
        found.ok().and_then(|index| self.listed.get(index))
    }

    /// The value of a parameter; no value for an unknown one.
    pub fn value(&self, name: &str) -> Value {
        self.find(name).map_or(Value::None, |listed| match (listed.row.kind, &listed.value) {
            // A number that the program keeps in whole milliseconds.
            (Kind::Decimal(..), Value::Whole(number)) => Value::Decimal(*number as f64),
            (_, value) => value.clone(),
        })
    }

    /// The names below the prefixes, as `rclcpp` lists them: with a depth other than 0 only those with fewer
    /// dots after the prefix.
    pub fn list(&self, ListRequest { prefixes, depth }: &ListRequest) -> ListReply {
        let is_near = |rest: &str| *depth == 0 || (rest.matches('.').count() as u64) < *depth;
        let is_listed = |name: &str| {
            let below = |prefix: &String| {
                let rest = name.strip_prefix(prefix.as_str());
                rest.is_some_and(|rest| rest.is_empty() || rest.strip_prefix('.').is_some_and(is_near))
            };
            if prefixes.is_empty() { is_near(name) } else { prefixes.iter().any(below) }
        };
        let names: Vec<String> =
            self.listed.iter().map(|listed| &listed.name).filter(|name| is_listed(name)).cloned().collect();
        let above: BTreeSet<&str> =
            names.iter().filter_map(|name| name.rsplit_once('.').map(|(prefix, _)| prefix)).collect();
        ListReply { prefixes: above.into_iter().map(str::to_owned).collect(), names }
    }

    pub fn values(&self, names: &[String]) -> Vec<ParameterValue> {
        names.iter().map(|name| ParameterValue::from(&self.value(name))).collect()
    }

    pub fn types(&self, names: &[String]) -> Vec<u8> {
        names.iter().map(|name| ParameterValue::from(&self.value(name)).kind).collect()
    }

    pub fn describe(&self, names: &[String]) -> Vec<Descriptor> {
        names.iter().map(|name| self.descriptor(name)).collect()
    }

    fn descriptor(&self, name: &str) -> Descriptor {
        let Some(Listed { row, .. }) = self.find(name) else {
            return Descriptor { name: name.to_owned(), ..Descriptor::default() };
        };
        let (mut decimals, mut wholes) = (Vec::new(), Vec::new());
        let declared = match row.kind {
            Kind::Flag => BOOL,
            Kind::Whole(least, most, _) => {
                wholes.push(WholeRange { least: signed(least), most: signed(most), step: 1 });
                INTEGER
            }
            Kind::Decimal(least, most, _) => {
                decimals.push(DecimalRange { least, most, step: 0.0 });
                DOUBLE
            }
            Kind::Choice(_) | Kind::Other(_) => STRING,
        };
        let kind = ParameterValue::from(&self.value(name)).kind;
        Descriptor {
            name: name.to_owned(),
            kind: if kind == NOT_SET { declared } else { kind },
            description: if Listed::is_file_only(name) {
                format!(
                    "{} Read-only for ROS 2 nodes: only the configuration file sets it.",
                    row.documentation
                )
            } else {
                row.documentation.to_owned()
            },
            additional_constraints: format!("{}; default: {}", row.range(), row.default),
            read_only: !Listed::is_settable(name, row),
            // A parameter without a value has no type yet.
            dynamic_typing: kind == NOT_SET,
            decimals,
            wholes,
        }
    }

    /// The log level of each logger: all have that of `diagnostics.verbosity`.
    pub fn logger_levels(&self, names: Vec<String>) -> Vec<LoggerLevel> {
        // The levels of rcutils, which has none below DEBUG.
        let level = match self.settings.diagnostics.verbosity {
            Verbosity::Trace | Verbosity::Debug => 10,
            Verbosity::Info => 20,
            Verbosity::Warn => 30,
            Verbosity::Error => 40,
        };
        names.into_iter().map(|name| LoggerLevel { name, level }).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config;

    fn parameters() -> Parameters {
        let yaml = "topics: [{id: scan, input_topic: /scan}, {id: scan.rear, input_topic: /rear}]\n\
                    overrides: {laptop: CRITICAL, laptop.local: CRITICAL}\n\
                    security: {hmac_secret: a secret of the bridge}";
        Parameters::new(config::parse(yaml, "test.yaml", &|_| None).unwrap())
    }

    fn names(of: &Parameters, prefixes: &[&str], depth: u64) -> Vec<String> {
        let prefixes = prefixes.iter().map(|&prefix| prefix.to_owned()).collect();
        of.list(&ListRequest { prefixes, depth }).names
    }

    #[test]
    fn prefixes_and_depth_select_names() {
        let parameters = parameters();
        let all = names(&parameters, &[], 0);
        for name in [
            "probes.rate_hz",
            "topics.scan.input_topic",
            "topics.scan.rear.qos_overrides.critical.depth",
            "overrides.laptop",
            "overrides.laptop.local",
            "policy_hold_s",
        ] {
            assert!(all.contains(&name.to_owned()), "{name}: {all:?}");
        }
        assert!(all.is_sorted() && !all.iter().any(|name| name.contains("secret")), "{all:?}");
        assert_eq!(names(&parameters, &[], 1), ["instance", "policy_hold_s"]);
        assert!(names(&parameters, &["probes"], 1).iter().all(|name| name.starts_with("probes.")));
        assert_eq!(names(&parameters, &["probes.rate_hz", "prob"], 0), ["probes.rate_hz"]);
        let reply = parameters.list(&ListRequest { prefixes: vec!["overrides".to_owned()], depth: 0 });
        assert_eq!(reply.prefixes, ["overrides", "overrides.laptop"]);
    }

    #[test]
    fn every_value_has_the_type_that_its_key_declares() {
        let parameters = parameters();
        for name in names(&parameters, &[], 0) {
            let row = parameters.find(&name).unwrap().row;
            let value = parameters.value(&name);
            let fits = match row.kind {
                Kind::Flag => matches!(value, Value::Flag(_) | Value::None),
                Kind::Whole(..) => matches!(value, Value::Whole(_) | Value::None),
                Kind::Decimal(..) => matches!(value, Value::Decimal(_) | Value::None),
                Kind::Choice(_) => matches!(value, Value::Text(_) | Value::None),
                Kind::Other(_) => true,
            };
            assert!(fits, "{name}: {value:?} as {:?}", row.kind);
        }
    }

    #[test]
    fn a_descriptor_has_the_range_and_what_a_reload_cannot_change_is_read_only() {
        let names =
            ["probes.rate_hz", "classifier.hysteresis_count", "ros.domain_id", "security.trust_mode", "x"];
        let described = parameters().describe(&names.map(str::to_owned));
        let file_only = parameters().describe(&["safety.silent_ms", "policy_hold_s"].map(str::to_owned));
        assert!(file_only.iter().all(|one| one.read_only && one.description.contains("Read-only")));
        let read_only: Vec<bool> = described.iter().map(|descriptor| descriptor.read_only).collect();
        assert_eq!(read_only, [false, false, true, true, false]);
        assert_eq!(described[0].decimals, [DecimalRange { least: 0.01, most: 1000.0, step: 0.0 }]);
        assert_eq!(described[1].wholes, [WholeRange { least: 1, most: 1_000, step: 1 }]);
        assert_eq!(described[4], Descriptor { name: "x".to_owned(), ..Descriptor::default() });
        assert_eq!(described.iter().map(|one| one.kind).collect::<Vec<_>>(), [3, 2, 2, 4, 0]);
    }
}
