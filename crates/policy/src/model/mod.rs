//! Plain data types with names and units, shared by all other layers.
//!
//! The types hold, check and convert values and do nothing else. The terms are those of DDS, RTPS, ROS 2 and
//! teletraffic engineering; each is defined at the type of that name.

mod backlog;
mod control;
mod counts;
mod drops;
mod hash;
mod health;
mod identity;
mod modes;
mod names;
mod network;
mod partial;
mod probe;
mod qos;
mod rates;
mod readers;
mod sample;
mod thresholds;
mod time;
mod topic_pattern;
mod type_hash;

pub use backlog::Backlog;
pub use control::{
    AbsenceKind, AbsenceRecord, ControlRecord, IntruderRecord, MAX_ABSENCES, MAX_INTRUDERS,
    MAX_NAMED_ENDPOINTS, MAX_SUBSCRIBERS, NamedEndpoint, ParameterRequests, SubscriberRecord,
    SubscriberWarning,
};
pub use counts::{Counts, Reason};
pub use drops::{DropCounts, DropReason};
pub use hash::fnv1a;
pub use health::{
    FixedText, IngressCounters, LaneCounters, LanePolicy, LatencyHistogram, MAX_PUBLISHERS, ProcessHealth,
    PublisherAccount, RouteInfo, StandbyRecord,
};
pub use identity::{EndpointIdentity, ProcessIdentity};
pub use modes::{
    LaneMode, ModeReason, SafetyMode, SubscriberState, TakeOverCause, TrafficClass, UnmatchedPolicy,
};
pub use names::{InstanceName, LaneName, NameError, NodeName, RouteId, TopicName, TypeName};
pub use network::{NetworkRefusal, NetworkRefusals};
pub use partial::PartialSample;
pub use probe::{MAX_ID_BYTES, ProbeRefusal, RefusalCounts, is_probe_id};
pub use qos::{Durability, History, QosProfile, Reliability};
pub use rates::{DropPolicy, LaneRates, RatePolicy};
pub use readers::{MAX_OUTPUT_READERS, MAX_UNMATCHED_READERS, OutputReaders, ReaderRecord, UnmatchedReader};
pub use sample::{AgeBasis, Encapsulation, Guid, KeyedPayload, SampleHeader, SampleKey};
pub use thresholds::{ClassifierThresholds, SafetyRules};
pub use time::{MonotonicNs, SourceTimestamp, WallNs};
pub use topic_pattern::{PatternRecord, TopicPattern, TopicPrefix};
pub use type_hash::{DdsType, TypeHash};
