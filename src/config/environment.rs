//! Reads the environment variables of ROS 2: those that supply defaults for the file, and those that the
//! bridge does not support.

use std::net::Ipv4Addr;

use super::problem::{Place, Problem, Problems, shown};
use super::settings::NetworkSelector;

/// The defaults from the environment.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct Environment {
    /// `ROS_DOMAIN_ID`; 0 without it, as in ROS 2.
    pub domain_id: u16,
    /// The bytes of a graph identifier in the distribution that `ROS_DISTRO` names.
    pub graph_gid_bytes: usize,
    localhost_only: bool,
}

/// A variable that makes the nodes of the robot communicate in a way that the bridge does not. If it is set,
/// the bridge would find no node, or receive nothing, without an error.
struct NotSupported {
    name: &'static str,
    /// Whether nodes with this value and the bridge do not find each other.
    hides: fn(&str) -> bool,
    /// What is allowed, why, and what to do.
    consequence: &'static str,
}

const DDS_IMPLEMENTATIONS: [&str; 5] = [
    "rmw_fastrtps_cpp",
    "rmw_fastrtps_dynamic_cpp",
    "rmw_cyclonedds_cpp",
    "rmw_connextdds",
    "rmw_gurumdds_cpp",
];

const NOT_SUPPORTED: [NotSupported; 4] = [
    NotSupported {
        name: "ROS_DISCOVERY_SERVER",
        hides: |_| true,
        consequence: "must not be set: nodes that use a discovery server and the bridge do not find each other; \
                      start the nodes without it, and the bridge too",
    },
    NotSupported {
        name: "ROS_SECURITY_ENABLE",
        // rcl takes any other value for false.
        hides: |value| value == "true",
        consequence: "must not be true: the bridge has no DDS Security, and nodes that have it do not accept \
                      the bridge; unset it for the bridge if the nodes that it serves run without",
    },
    NotSupported {
        name: "RMW_IMPLEMENTATION",
        hides: |value| !DDS_IMPLEMENTATIONS.contains(&value),
        consequence: "must be a DDS implementation, rmw_fastrtps_cpp, rmw_fastrtps_dynamic_cpp, \
                      rmw_cyclonedds_cpp, rmw_connextdds or rmw_gurumdds_cpp: nodes of others and the bridge do \
                      not find each other; unset it for the bridge if the nodes that it serves use DDS",
    },
    NotSupported {
        name: "FASTDDS_BUILTIN_TRANSPORTS",
        hides: |value| !["DEFAULT", "UDPv4"].contains(&value),
        consequence: "must be DEFAULT or UDPv4: the bridge receives and sends over UDP and IPv4 only, and with \
                      other transports Fast DDS does not; unset it for the bridge if the nodes that it serves \
                      run without",
    },
];

impl Environment {
    /// Reads the variables through `env`. An empty one counts as not set, as in ROS 2.
    pub fn read(env: &dyn Fn(&str) -> Option<String>, problems: &Problems) -> Self {
        let variable = |name: &str| env(name).filter(|value| !value.is_empty());
        let refuse = |name: &str, value: &str, allowed: &str| {
            problems.report(Problem {
                place: Place::Environment,
                key: name.to_owned(),
                value: Some(shown(value)),
                allowed: allowed.to_owned(),
                hint: None,
            });
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
        if let Some(value) = variable("ROS_AUTOMATIC_DISCOVERY_RANGE") {
            match value.as_str() {
                "SUBNET" | "SYSTEM_DEFAULT" => {}
                "LOCALHOST" => localhost_only = true,
                "OFF" => refuse(
                    "ROS_AUTOMATIC_DISCOVERY_RANGE",
                    &value,
                    "must not be OFF: a bridge without discovery finds neither publishers nor subscribers",
                ),
                _ => refuse(
                    "ROS_AUTOMATIC_DISCOVERY_RANGE",
                    &value,
                    "must be one of SUBNET, LOCALHOST, SYSTEM_DEFAULT",
                ),
            }
        }
        if let Some(value) = variable("ROS_STATIC_PEERS") {
            refuse(
                "ROS_STATIC_PEERS",
                &value,
                "must not be set: the DDS library has no list of peers; unset it, and choose the interfaces \
                 with ros.networks or ROS_AUTOMATIC_DISCOVERY_RANGE",
            );
        }
        for not_supported in &NOT_SUPPORTED {
            if let Some(value) = variable(not_supported.name)
                && (not_supported.hides)(&value)
            {
                refuse(not_supported.name, &value, not_supported.consequence);
            }
        }
        // The identifier shrank from 24 to 16 bytes in Iron.
        let graph_gid_bytes = match variable("ROS_DISTRO").as_deref() {
            Some("foxy" | "galactic" | "humble") => 24,
            _ => 16,
        };
        Self { domain_id, graph_gid_bytes, localhost_only }
    }

    /// The interfaces to use if the file names none: all (an empty list), or only loopback.
    pub fn default_interfaces(&self) -> Vec<NetworkSelector> {
        match self.localhost_only {
            true => vec![NetworkSelector::Address(Ipv4Addr::LOCALHOST)],
            false => Vec::new(),
        }
    }
}
