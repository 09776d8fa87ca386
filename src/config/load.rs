//! Finds, reads and validates a configuration file.

use std::path::{Path, PathBuf};
use std::rc::Rc;

use super::environment::Environment;
use super::field::Field;
use super::in_force::{Configuration, InlineSecret};
use super::parameters::{self, Parameters};
use super::problem::{ConfigError, Place, Problem, Problems};
use super::qos::Profiles;
use super::settings::{SecretSource, SetParameters, Settings, SharedMemory};
use super::yaml::Node;
use super::{control, keys, lanes, routes, yaml};
use crate::model::{InstanceName, NodeName, TopicName, TrafficClass};

/// The environment variable that names the file if the command line does not.
pub const PATH_VARIABLE: &str = "ADAPTIVE_BRIDGE_CONFIG";

/// The file that is read if neither the command line nor the environment names one.
pub const DEFAULT_PATH: &str = "/etc/adaptive-bridge/config.yaml";

/// Loads the settings from a file: `path`, else the file that `$ADAPTIVE_BRIDGE_CONFIG` names, else
/// `/etc/adaptive-bridge/config.yaml`. `env` looks up environment variables.
///
/// # Errors
/// Every problem of the file and of the environment at once; one problem when there is no file or it cannot
/// be read.
pub fn load(path: Option<&Path>, env: &dyn Fn(&str) -> Option<String>) -> Result<Settings, ConfigError> {
    load_configuration(path, &[], env).map(|configuration| configuration.settings)
}

/// Loads the settings as [`load`] does, with the values of `parameters` in place of those of the file, and
/// the secret if there is one.
///
/// # Errors
/// As for [`load`].
pub fn load_configuration(
    path: Option<&Path>,
    parameters: &[Parameters],
    env: &dyn Fn(&str) -> Option<String>,
) -> Result<Configuration, ConfigError> {
    load_configuration_with_budget(path, parameters, env, &|_| None)
}

/// Loads the configuration as [`load_configuration`] does, and reports `shared_memory.budget_bytes` if
/// `is_refused` says what it must be, as a phrase that begins with "must": what the pools need depends on the
/// machine.
///
/// # Errors
/// As for [`load`], and the budget.
pub fn load_configuration_with_budget(
    path: Option<&Path>,
    parameters: &[Parameters],
    env: &dyn Fn(&str) -> Option<String>,
    is_refused: &dyn Fn(&Settings) -> Option<String>,
) -> Result<Configuration, ConfigError> {
    let path = find(path, parameters, env)?.ok_or_else(|| {
        let what = format!(
            "this file does not exist, and neither --config nor ${PATH_VARIABLE} names another; create one with \
             `topics: [{{id: scan, input_topic: /scan}}]`"
        );
        failure(DEFAULT_PATH, Place::File, what)
    })?;
    let name = path.display().to_string();
    let bytes = yaml::read(&path).map_err(|what| failure(&name, Place::File, what))?;
    parse_configuration(&bytes, &name, parameters, env, is_refused)
}

/// Loads the configuration as [`load_configuration`] does; without a file, the defaults with this environment
/// and one placeholder route.
///
/// # Errors
/// As for [`load`], except that a missing default file is no error.
pub fn load_or_default(
    path: Option<&Path>,
    parameters: &[Parameters],
    env: &dyn Fn(&str) -> Option<String>,
) -> Result<Configuration, ConfigError> {
    const DEFAULTS: &[u8] = b"topics: [{id: none, input_topic: /none}]";
    match find(path, parameters, env)? {
        Some(path) => load_configuration(Some(&path), parameters, env),
        None => parse_configuration(DEFAULTS, "the defaults", parameters, env, &|_| None),
    }
}

/// The path of the configuration file: `path`, else that of the parameter `config_path`.
///
/// # Errors
/// A file of parameters cannot be read.
pub fn named_path(path: Option<&Path>, parameters: &[Parameters]) -> Result<Option<PathBuf>, ConfigError> {
    if path.is_some() {
        return Ok(path.map(Path::to_owned));
    }
    let values = parameters::read(parameters);
    values.map(|values| values.config_path).map_err(|problem| bad_parameter(parameters, problem))
}

fn bad_parameter(parameters: &[Parameters], problem: Problem) -> ConfigError {
    ConfigError::new("", parameters::files(parameters), vec![problem])
}

/// The file to read; `None` if none is named and the default file does not exist.
fn find(
    path: Option<&Path>,
    parameters: &[Parameters],
    env: &dyn Fn(&str) -> Option<String>,
) -> Result<Option<PathBuf>, ConfigError> {
    let named = || env(PATH_VARIABLE).filter(|path| !path.is_empty()).map(PathBuf::from);
    let default = || Some(PathBuf::from(DEFAULT_PATH)).filter(|path| path.exists());
    Ok(named_path(path, parameters)?.or_else(named).or_else(default))
}

fn failure(file: &str, place: Place, allowed: String) -> ConfigError {
    ConfigError::new(file, Vec::new(), vec![Problem::new(place, "", allowed)])
}

/// Parses the settings from the content of a file; `file_name` is for messages. It has no side effects except
/// those of `env`.
///
/// # Errors
/// Every problem of the content and of the environment at once; one problem when the content is not YAML.
pub fn parse(
    text: impl AsRef<[u8]>,
    file_name: &str,
    env: &dyn Fn(&str) -> Option<String>,
) -> Result<Settings, ConfigError> {
    parse_configuration(text.as_ref(), file_name, &[], env, &|_| None)
        .map(|configuration| configuration.settings)
}

fn parse_configuration(
    text: &[u8],
    file_name: &str,
    parameters: &[Parameters],
    env: &dyn Fn(&str) -> Option<String>,
    is_budget_refused: &dyn Fn(&Settings) -> Option<String>,
) -> Result<Configuration, ConfigError> {
    let mut document = yaml::parse(text)
        .map_err(|error| failure(file_name, error.line.map_or(Place::File, Place::Line), error.message))?;
    let problems = Problems::default();
    let checked = |document: Option<&Node>, problems: Problems| {
        let settings = validate(document, file_name, env, &problems)?;
        let problems = problems.into_inner();
        if problems.is_empty() {
            return Ok(settings);
        }
        Err(ConfigError::new(file_name, parameters::files(parameters), problems))
    };
    if !parameters.is_empty() {
        let values = parameters::read(parameters).map_err(|problem| bad_parameter(parameters, problem))?;
        let root = Rc::make_mut(document.get_or_insert_with(|| Rc::new(Node::null())));
        if values.have_sections() {
            let (mut without, problems_without) = (root.clone(), Problems::default());
            values.merge_into(&mut without, &problems_without);
            let settings = checked(Some(&without), problems_without)?;
            values.merge_dumps_into(root, &settings, &problems);
        }
        values.merge_into(root, &problems);
    }
    let document = document.as_deref();
    let settings = checked(document, problems)?;
    let problems = Problems::default();
    let root = Field::root(document, &problems);
    if let Some(allowed) = is_budget_refused(&settings) {
        root.get("shared_memory").get("budget_bytes").report::<()>(&allowed);
        return Err(ConfigError::new(file_name, parameters::files(parameters), problems.into_inner()));
    }
    let inline_secret = match settings.security.secret {
        Some(SecretSource::ConfigFile) => root.get("security").get("hmac_secret").text(),
        _ => None,
    };
    let inline_secret = inline_secret.map(|secret| InlineSecret(secret.to_owned()));
    Ok(Configuration { settings, inline_secret })
}

/// Reads the settings from the tree of a file. They are valid only if no problems are reported.
fn validate(
    document: Option<&Node>,
    file_name: &str,
    env: &dyn Fn(&str) -> Option<String>,
    problems: &Problems,
) -> Result<Settings, ConfigError> {
    let root = Field::root(document, problems);
    if !root.is_given() {
        let what = "the file is empty: at least `topics` must be given, such as \
                    `topics: [{id: scan, input_topic: /scan}]`";
        return Err(failure(file_name, Place::File, what.to_owned()));
    }
    if !root.is_map() {
        let line = document.map_or(1, |node| node.line);
        let what = "must be a mapping at its top level, of keys such as `topics:`";
        return Err(failure(file_name, Place::Line(line), what.to_owned()));
    }
    if let Some(node) = document {
        keys::check(node, problems);
    }
    Ok(settings(&root, &Environment::read(env, problems)))
}

/// Builds the settings, which are valid only if no problems are reported.
fn settings(root: &Field<'_>, environment: &Environment) -> Settings {
    let instance = root
        .get("instance")
        .parsed_or_default(InstanceName::ALLOWED, |text| InstanceName::try_from(text).ok());

    let profiles = Profiles::read(root);
    let input = routes::input_network(root, environment);
    let safety = control::safety(root);
    let drafts = lanes::read(root, &profiles, &input, environment, safety.rules.max_noncritical_queue as u64);

    let memory = root.section("shared_memory");
    let max_sample_bytes = memory.get("max_sample_bytes").count_or_default();
    let shared_memory = SharedMemory {
        root_path: memory.get("root_path").parsed("an absolute path", control::absolute_path),
        max_taps: memory.get("max_taps").count_or_default(),
        budget_bytes: memory.get("budget_bytes").count(),
    };
    let (routes, patterns, lanes) = routes::read(root, &profiles, &input, drafts, max_sample_bytes);

    let processes = root.section("processes");
    let ingress_standby =
        processes.section("ingress").get("standby").choice().unwrap_or(lanes::CRITICAL_STANDBY);
    let process = |name: &str, class| {
        let section = processes.section(name).section("scheduling");
        lanes::scheduling(&section, lanes::default_scheduling(class))
    };
    let security = control::security(root);
    let classifier = control::classifier(root);
    control::check_number_of_subscribers(root, classifier.subscriber_id.as_deref());
    let policy_hold_s = root.get("policy_hold_s").decimal_or_default();
    let ros = root.get("ros");
    let namespace = |text: &str| text == "/" || TopicName::try_from(text).is_ok();
    let allowed = "an absolute namespace such as /robot1, or /";
    let node_namespace =
        ros.get("namespace").parsed(allowed, |text| namespace(text).then(|| text.to_owned()));
    let gid_bytes = ros.get("graph_gid_bytes");
    let gid_bytes = gid_bytes.whole_where("must be 16 or 24", |bytes| matches!(bytes, 16 | 24));
    Settings {
        node_namespace: node_namespace.unwrap_or_else(|| match instance.as_str() {
            "default" => "/adaptive_bridge".to_owned(),
            instance => format!("/adaptive_bridge/{instance}"),
        }),
        node_name: ros.get("node_name").parsed(NodeName::ALLOWED, |text| NodeName::try_from(text).ok()),
        instance,
        input,
        graph_gid_bytes: gid_bytes.map_or(environment.graph_gid_bytes, |bytes| bytes as usize),
        routes,
        patterns,
        shared_memory,
        policy_hold_ms: (policy_hold_s * 1_000.0).round() as u64,
        ingress_scheduling: process("ingress", Some(TrafficClass::Critical)),
        ingress_standby,
        control_scheduling: process("control", None),
        classifier,
        probes: control::probes(root, security.max_probe_rate_hz),
        safety,
        security,
        diagnostics: control::diagnostics(root),
        overrides: control::overrides(root),
        subscribers: control::subscribers(root, &lanes),
        set_parameters: SetParameters::new(),
        lanes,
    }
}
