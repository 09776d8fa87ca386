//! The configuration: reads YAML into validated [`Settings`], or reports every problem of the file at once.
//!
//! `yaml` parses text into a tree of values with their lines; `keys` declares each key in one row and finds
//! unknown ones; `field` reads and checks one value as its row declares; the other modules build the
//! settings, with one file for each part.

mod choices;
mod control;
mod environment;
mod field;
mod in_force;
mod keys;
mod lanes;
mod listed;
mod load;
mod never_inputs;
mod overlay;
mod parameters;
mod problem;
mod qos;
mod rates;
mod reload;
mod routes;
mod settings;
mod shown;
#[cfg(test)]
mod tests;
mod yaml;

pub use in_force::{Configuration, DecodeError, InlineSecret};
pub use keys::{KEYS, Kind, Row, keys_at, nearest_key, rows};
pub use listed::Listed;
pub use load::{
    DEFAULT_PATH, PATH_VARIABLE, load, load_configuration, load_configuration_with_budget, load_or_default,
    named_path, parse,
};
pub use never_inputs::NeverInputs;
pub use parameters::Parameters;
pub use problem::{ConfigError, Place, Problem};
pub use reload::{Change, Reload};
pub use settings::{
    Classifier, ClassifierThresholds, DdsNetwork, Diagnostics, DropPolicy, Forwarding, InputQos, InputTopic,
    Lane, LaneRates, MetricsListener, NetworkSelector, Output, OutputTopic, Probes, RatePolicy, Route,
    RoutePattern, Safety, SafetyRules, Scheduling, SchedulingPolicy, SecretSource, Security, SetParameters,
    Settings, SharedMemory, Standby, TrustMode, Verbosity,
};
pub use shown::Value;
