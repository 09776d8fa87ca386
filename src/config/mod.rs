//! The configuration: YAML in, validated [`Settings`] out, or every problem of the file at once.

mod settings;

pub use settings::{
    Classifier, DdsNetwork, Diagnostics, DropPolicy, InputQos, Lane, LaneRates, MetricsListener,
    NetworkSelector, Output, Probes, RatePolicy, Route, Safety, Scheduling, SchedulingPolicy, SecretSource,
    Security, Settings, SharedMemory, TrustMode,
};
