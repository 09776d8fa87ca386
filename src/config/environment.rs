//! Reads the environment variables of ROS 2: those that supply defaults for the file, and those that the
//! bridge does not support.

use std::net::Ipv4Addr;

use super::problem::{Place, Problem, Problems, shown};
use super::settings::{DdsNetwork, NetworkSelector};

#[derive(Debug, PartialEq, Eq)]
pub(super) struct Environment {
    /// `ROS_DOMAIN_ID`; 0 without it, as in ROS 2.
    pub domain_id: u16,
    /// The bytes of a graph identifier in the distribution that `ROS_DISTRO` names.
    pub graph_gid_bytes: usize,
    localhost_only: bool,
    /// `ROS_STATIC_PEERS`.
    pub static_peers: Vec<Ipv4Addr>,
}

const DDS_IMPLEMENTATIONS: [&str; 5] = [
    "rmw_fastrtps_cpp",
    "rmw_fastrtps_dynamic_cpp",
    "rmw_cyclonedds_cpp",
    "rmw_connextdds",
    "rmw_gurumdds_cpp",
];

type NotSupported = (&'static str, fn(&str) -> bool, &'static str);

/// Variables with which nodes communicate in a way that the bridge does not support: it would find no node,
/// or receive nothing, without an error. For each: its name; whether a value has this effect; the message
/// with the allowed values, the reason and the remedy.
const NOT_SUPPORTED: [NotSupported; 4] = [
    (
        "ROS_DISCOVERY_SERVER",
        |_| true,
        "must not be set: nodes that use a discovery server and the bridge do not find each other; start the \
         nodes without it, and the bridge too",
    ),
    (
        "ROS_SECURITY_ENABLE",
        // rcl takes any other value for false.
        |value| value == "true",
        "must not be true: the bridge has no DDS Security, and nodes that have it do not accept the bridge; \
         unset it for the bridge if the nodes that it serves run without",
    ),
    (
        "RMW_IMPLEMENTATION",
        |value| !DDS_IMPLEMENTATIONS.contains(&value),
        "must be a DDS implementation, rmw_fastrtps_cpp, rmw_fastrtps_dynamic_cpp, rmw_cyclonedds_cpp, \
         rmw_connextdds or rmw_gurumdds_cpp: nodes of others and the bridge do not find each other; unset it \
         for the bridge if the nodes that it serves use DDS",
    ),
    (
        "FASTDDS_BUILTIN_TRANSPORTS",
        |value| !["DEFAULT", "UDPv4"].contains(&value),
        "must be DEFAULT or UDPv4: the bridge receives and sends over UDP and IPv4 only, and with other \
         transports Fast DDS does not; unset it for the bridge if the nodes that it serves run without",
    ),
];

impl Environment {
    /// Reads the variables through `env`. An empty one counts as not set, as in ROS 2.
    pub fn read(env: &dyn Fn(&str) -> Option<String>, problems: &Problems) -> Self {
        let variable = |name: &str| env(name).filter(|value| !value.is_empty());
        let refuse = |name: &str, value: &str, allowed: &str| {
            let problem = Problem::new(Place::Environment, name, allowed.to_owned());
            problems.report(Problem { value: Some(shown(value)), ..problem });
        };

        let mut domain_id = 0;
        if let Some(value) = variable("ROS_DOMAIN_ID") {
            match value.parse() {
                Ok(id) if id <= 232 => domain_id = id,
                _ => refuse("ROS_DOMAIN_ID", &value, "must be a whole number from 0 to 232"),
            }
        }
        let mut localhost_only = false;
        if let Some(value) = variable("ROS_LOCALHOST_ONLY") {
            match value.as_str() {
                "0" => {}
                "1" => localhost_only = true,
                _ => refuse("ROS_LOCALHOST_ONLY", &value, "must be 0 or 1"),
            }
        }
        let range = "ROS_AUTOMATIC_DISCOVERY_RANGE";
        if let Some(value) = variable(range) {
            match value.as_str() {
                "SUBNET" | "SYSTEM_DEFAULT" => {}
                "LOCALHOST" => localhost_only = true,
                "OFF" => refuse(
                    range,
                    &value,
                    "must not be OFF: a bridge without discovery finds neither publishers nor subscribers",
                ),
                _ => refuse(range, &value, "must be one of SUBNET, LOCALHOST, SYSTEM_DEFAULT"),
            }
        }
        let mut static_peers = Vec::new();
        if let Some(value) = variable("ROS_STATIC_PEERS") {
            let addresses = value.split(';').map(str::trim).filter(|address| !address.is_empty());
            let addresses: Result<Vec<_>, _> = addresses.map(str::parse).collect();
            match addresses {
                Ok(addresses) if addresses.len() <= DdsNetwork::MAX_STATIC_PEERS => static_peers = addresses,
                _ => refuse(
                    "ROS_STATIC_PEERS",
                    &value,
                    &format!(
                        "must be at most {} IPv4 addresses separated by `;`: the bridge does not look up \
                         names of hosts",
                        DdsNetwork::MAX_STATIC_PEERS
                    ),
                ),
            }
        }
        for (name, hides, consequence) in NOT_SUPPORTED {
            if let Some(value) = variable(name).filter(|value| hides(value)) {
                refuse(name, &value, consequence);
            }
        }
        // The identifier shrank from 24 to 16 bytes in Iron.
        let graph_gid_bytes = match variable("ROS_DISTRO").as_deref() {
            Some("foxy" | "galactic" | "humble") => 24,
            _ => 16,
        };
        Self { domain_id, graph_gid_bytes, localhost_only, static_peers }
    }

    /// The interfaces to use if the file names none: all (an empty list), or only loopback.
    pub fn default_interfaces(&self) -> Vec<NetworkSelector> {
        match self.localhost_only {
            true => vec![NetworkSelector::Address(Ipv4Addr::LOCALHOST)],
            false => Vec::new(),
        }
    }
}

#[cfg(test)]
mod tests {
    use crate::config::parse;

    const TOPIC: &str = "topics: [{id: scan, input_topic: /scan}]\n";

    #[test]
    fn a_variable_with_which_nodes_do_not_find_the_bridge_is_refused_with_what_to_do() {
        let unset = "unset it for the bridge";
        for (name, refused, accepted, remedy) in [
            ("ROS_DISCOVERY_SERVER", "10.0.0.1:11811", "", "start the nodes without it"),
            ("ROS_SECURITY_ENABLE", "true", "False", unset),
            ("RMW_IMPLEMENTATION", "rmw_zenoh_cpp", "rmw_cyclonedds_cpp", unset),
            ("FASTDDS_BUILTIN_TRANSPORTS", "LARGE_DATA", "UDPv4", unset),
            ("FASTDDS_BUILTIN_TRANSPORTS", "LARGE_DATA?max_msg_size=1MB", "DEFAULT", unset),
        ] {
            let with = |value: &'static str| {
                parse(TOPIC, "f.yaml", &|asked: &str| (asked == name).then(|| value.to_owned()))
            };
            let message = with(refused).unwrap_err().to_string();
            assert!(message.starts_with(&format!("environment: {name} = {refused}: must ")), "{message}");
            assert!(message.contains(remedy) && message.lines().count() == 1, "{message}");
            assert!(with(accepted).is_ok());
        }
    }

    #[test]
    fn as_many_static_peers_as_allowed_are_accepted_and_more_are_not() {
        let with = |peers: usize| {
            let value = vec!["10.0.0.1"; peers].join(";");
            parse(TOPIC, "f.yaml", &|asked: &str| (asked == "ROS_STATIC_PEERS").then(|| value.clone()))
        };
        assert_eq!(with(16).unwrap().input.static_peers.len(), 16);
        let message = with(17).unwrap_err().to_string();
        assert!(message.contains("must be at most 16 IPv4 addresses"), "{message}");
    }
}
