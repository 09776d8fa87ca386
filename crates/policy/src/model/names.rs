//! Names that are checked on construction: a value of these types is always valid.

use alloc::borrow::ToOwned;
use alloc::format;
use alloc::string::String;
use core::fmt;

use serde::{Deserialize, Deserializer, Serialize};

/// The error for a string that is not a valid name.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NameError {
    /// The kind of name, such as `lane name`.
    pub kind: &'static str,
    /// The allowed texts, as a phrase that completes "must be …".
    pub allowed: &'static str,
}

impl fmt::Display for NameError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "not a {}: must be {}", self.kind, self.allowed)
    }
}

impl core::error::Error for NameError {}

macro_rules! checked_name {
    ($(#[doc = $doc:literal])+ $name:ident, $kind:literal, $allowed:literal, $parse:path) => {
        $(#[doc = $doc])+
        #[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize)]
        pub struct $name(String);

        impl $name {
            /// The allowed texts, as a phrase that completes "must be …".
            pub const ALLOWED: &'static str = $allowed;

            /// The name as text.
            pub fn as_str(&self) -> &str {
                &self.0
            }
        }

        impl TryFrom<&str> for $name {
            type Error = NameError;

            fn try_from(text: &str) -> Result<Self, NameError> {
                $parse(text).map(Self).ok_or(NameError { kind: $kind, allowed: $allowed })
            }
        }

        impl fmt::Display for $name {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(&self.0)
            }
        }

        impl<'de> Deserialize<'de> for $name {
            fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
                let text = String::deserialize(deserializer)?;
                Self::try_from(text.as_str()).map_err(serde::de::Error::custom)
            }
        }
    };
}

checked_name! {
    /// The name of a lane: `critical`, `noncritical`, `rviz`, … It is part of file, unit and node names.
    LaneName, "lane name", "1 to 24 characters of a-z, 0-9 and _, beginning with a letter", short_name
}

checked_name! {
    /// The name of one bridge among several on a host; the namespace of its shared memory.
    InstanceName, "instance name",
    "1 to 24 characters of a-z, 0-9 and _, beginning with a letter",
    short_name
}

checked_name! {
    /// The user's name for a route, unique in a configuration.
    RouteId, "route id", "1 to 64 characters of A-Z, a-z, 0-9, _, - and .", route_id
}

checked_name! {
    /// A fully qualified ROS 2 topic name.
    TopicName, "topic name",
    "an absolute ROS 2 topic name of at most 246 characters: /tokens of A-Z, a-z, 0-9 and _, none beginning \
     with a digit",
    topic_name
}

checked_name! {
    /// The name of a ROS 2 node, without its namespace.
    NodeName, "node name",
    "a ROS 2 node name of at most 200 characters of A-Z, a-z, 0-9 and _, not beginning with a digit",
    node_name
}

impl LaneName {
    /// The name of the lane of the critical subscribers.
    pub fn critical() -> Self {
        Self("critical".to_owned())
    }

    /// The name of the lane that noncritical subscribers are on unless the configuration names another.
    pub fn noncritical() -> Self {
        Self("noncritical".to_owned())
    }
}

impl TopicName {
    /// The DDS topic of a ROS 2 topic, with the prefix `rt` of REP 2009: `rt/scan` for `/scan`.
    pub fn to_dds(&self) -> String {
        format!("rt{}", self.0)
    }
}

checked_name! {
    /// A ROS 2 message type, such as `sensor_msgs/msg/LaserScan`.
    TypeName, "message type",
    "package/msg/Name or package/Name, such as sensor_msgs/msg/LaserScan",
    type_name
}

impl TypeName {
    /// The DDS type name: `sensor_msgs::msg::dds_::LaserScan_`.
    pub fn to_dds(&self) -> String {
        format!("{}_", self.0.replacen("/msg/", "::msg::dds_::", 1))
    }

    /// The ROS 2 type of a DDS type name; `None` when it is not that of a ROS 2 message.
    pub fn from_dds(dds: &str) -> Option<Self> {
        let (package, name) = dds.split_once("::msg::dds_::")?;
        Self::try_from(format!("{package}/msg/{}", name.strip_suffix('_')?).as_str()).ok()
    }
}

fn short_name(text: &str) -> Option<String> {
    let is_valid = text.len() <= 24
        && text.starts_with(|c: char| c.is_ascii_lowercase())
        && text.chars().all(|c| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '_');
    is_valid.then(|| text.to_owned())
}

fn route_id(text: &str) -> Option<String> {
    let is_valid = (1..=64).contains(&text.len())
        && text.chars().all(|c| c.is_ascii_alphanumeric() || matches!(c, '_' | '-' | '.'));
    is_valid.then(|| text.to_owned())
}

/// DDS limits a topic name to 255 characters; 246 leaves room for every prefix that ROS 2 uses.
fn topic_name(text: &str) -> Option<String> {
    let is_valid =
        text.len() <= 246 && text.strip_prefix('/').is_some_and(|rest| rest.split('/').all(is_token));
    is_valid.then(|| text.to_owned())
}

/// ROS 2 allows 255 characters; 200 leave room for `_egress_` and a lane.
fn node_name(text: &str) -> Option<String> {
    (text.len() <= 200 && is_token(text)).then(|| text.to_owned())
}

/// The name with `msg`, which a user may omit.
fn type_name(text: &str) -> Option<String> {
    let (package, name) = text.split_once("/msg/").or_else(|| text.split_once('/'))?;
    (is_token(package) && is_token(name)).then(|| format!("{package}/msg/{name}"))
}

fn is_token(text: &str) -> bool {
    text.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
        && text.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn topic_names_are_checked_and_converted_to_dds_names() {
        let topic = TopicName::try_from("/robot_1/scan").unwrap();
        assert_eq!(topic.to_dds(), "rt/robot_1/scan");
        for wrong in ["", "/", "scan", "/scan/", "//scan", "/2d", "/a b", "/~", "/{x}"] {
            assert!(TopicName::try_from(wrong).is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn type_names_with_and_without_msg_are_equal() {
        let long = TypeName::try_from("sensor_msgs/msg/LaserScan").unwrap();
        assert_eq!(long, TypeName::try_from("sensor_msgs/LaserScan").unwrap());
        assert_eq!(long.to_dds(), "sensor_msgs::msg::dds_::LaserScan_");
        assert_eq!(TypeName::from_dds(&long.to_dds()), Some(long.clone()));
        assert_eq!(long.to_string(), "sensor_msgs/msg/LaserScan");
        for wrong in ["", "LaserScan", "a/srv/B", "a/msg/", "a/b/c/d", "a b/C"] {
            assert!(TypeName::try_from(wrong).is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn lane_names_are_valid_in_file_names() {
        assert_eq!(LaneName::try_from("rviz_2").unwrap().as_str(), "rviz_2");
        for wrong in ["", "2d", "Rviz", "a-b", "a/b", "a_name_that_is_too_long_for_us"] {
            assert!(LaneName::try_from(wrong).is_err(), "{wrong:?}");
        }
        let error = LaneName::try_from("Rviz").unwrap_err().to_string();
        assert!(error.contains("lane name") && error.contains("a-z"), "{error}");
    }

    #[test]
    fn node_names_are_one_token_of_at_most_200_characters() {
        for right in ["ingress", "_Front2", &"n".repeat(200)] {
            assert_eq!(NodeName::try_from(right).map(|name| name.to_string()), Ok(right.to_owned()));
        }
        for wrong in ["", "2d", "a/b", "a b", &"n".repeat(201)] {
            assert!(NodeName::try_from(wrong).is_err(), "{wrong:?}");
        }
    }

    #[test]
    fn route_ids_have_1_to_64_letters_digits_and_three_signs() {
        for right in ["a", "2", "scan_2-b.c", "A", &"x".repeat(64)] {
            assert_eq!(RouteId::try_from(right).map(|id| id.to_string()), Ok(right.to_owned()));
        }
        for wrong in ["", "a b", "a/b", "ä", &"x".repeat(65)] {
            assert!(RouteId::try_from(wrong).is_err(), "{wrong:?}");
        }
    }
}
