//! Setting parameters: validates them as the configuration file is validated, stores them, and makes every
//! process of the bridge reload.

use std::path::PathBuf;

use tracing::{error, info};

use super::super::super::parameter_store::ParameterStore;
use super::super::super::reload::request_reload;
use super::answers::Parameters;
use super::messages::{DOUBLE, INTEGER, NOT_SET, Parameter, ParameterValue, STRING, SetResult};
use crate::clock;
use crate::config::{ConfigError, Listed, Row, SetParameters, Settings};
use crate::model::Guid;
use crate::policy::TokenBucket;
use crate::shm::{RoleHolder, root_of};
use crate::telemetry::shortened;

/// The most parameters of one request: each takes the time of reading the file.
const MAX_IN_REQUEST: usize = 8;

/// The most parameters that may be set at the same time: each is kept until the bridge ends.
const MAX_SET: usize = 128;

/// Requests of all nodes together that may change parameters per second, and at once: each makes every
/// process reload.
const MAX_CHANGES_HZ: f64 = 1.0;
const MAX_CHANGES_AT_ONCE: f64 = 5.0;

/// The longest reason of a refusal: a file may have any number of problems.
const MAX_REASON_BYTES: usize = 1024;

/// The longest value, in YAML.
const MAX_VALUE_BYTES: usize = 1024;

/// Sets parameters of the whole bridge.
pub(super) struct Setter {
    /// `None` if the bridge was started without a configuration file.
    store: Option<ParameterStore>,
    changes: TokenBucket,
}

/// What a request has set.
pub(super) struct Outcome {
    /// For each parameter, why it was refused.
    pub results: Vec<Result<(), String>>,
    /// The parameters that the bridge applies once it has reloaded; `None` if nothing changes.
    pub pending: Option<SetParameters>,
}

impl Setter {
    pub fn new(store: Option<ParameterStore>) -> Self {
        let now = clock::monotonic();
        Self { store, changes: TokenBucket::full(MAX_CHANGES_HZ, MAX_CHANGES_AT_ONCE, now) }
    }

    /// Validates and stores parameters, and requests the reload. With `is_atomic` it sets all or none.
    pub fn set(
        &mut self,
        given: &[Parameter],
        current: &Parameters,
        client: Guid,
        is_atomic: bool,
    ) -> Outcome {
        let outcome = self.attempt(given, current, is_atomic);
        let outcome = outcome
            .unwrap_or_else(|reason| Outcome { results: vec![Err(reason); given.len()], pending: None });
        let is_set = |result: &Result<(), String>| outcome.pending.is_some() && result.is_ok();
        for (Parameter { name, value }, _) in
            given.iter().zip(&outcome.results).filter(|(_, result)| is_set(result))
        {
            info!(%client, name, value = value.yaml(), "a ROS 2 node sets a parameter");
        }
        outcome
    }

    /// Returns the outcome, or why all parameters are refused.
    fn attempt(
        &mut self,
        given: &[Parameter],
        current: &Parameters,
        is_atomic: bool,
    ) -> Result<Outcome, String> {
        let Some(store) = &self.store else {
            return Err("the bridge reads no configuration file".to_owned());
        };
        if given.len() > MAX_IN_REQUEST {
            return Err(format!("at most {MAX_IN_REQUEST} parameters can be set by one request"));
        }
        if current.settings.refuses_unsigned() {
            let what = "security.trust_mode is default_deny: requests cannot be signed; edit the configuration file \
                        and run `adaptive-bridge reload`";
            return Err(what.to_owned());
        }
        let before = store.read().map_err(|error| format!("cannot read the parameters: {error}"))?;
        let removes_only = given.iter().all(|parameter| parameter.value.kind == NOT_SET);
        // Parameters that make the file bad can still be removed, which is the remedy.
        if !removes_only || store.load(&before).is_ok() {
            unchanged(store, &before, &current.settings)?;
        }

        let mut results: Vec<_> = given.iter().map(|parameter| is_settable(parameter, current)).collect();
        let all_settable = results.iter().all(Result::is_ok);
        let candidates: Vec<&Parameter> =
            given.iter().zip(&results).filter(|(_, result)| result.is_ok()).map(|(one, _)| one).collect();
        let all = added(&before, &candidates);
        let mut accepted = before.clone();
        match check(store, &all, &candidates, &current.settings) {
            Ok(()) if all_settable || !is_atomic => accepted = all,
            Ok(()) => {}
            Err(reason) if is_atomic => results.iter_mut().for_each(|result| *result = Err(reason.clone())),
            Err(_) => {
                for (parameter, result) in given.iter().zip(&mut results).filter(|(_, result)| result.is_ok())
                {
                    let next = added(&accepted, &[parameter]);
                    *result = check(store, &next, &[parameter], &current.settings);
                    if result.is_ok() {
                        accepted = next;
                    }
                }
            }
        }
        drop_equal_to_file(store, &mut accepted, &candidates);
        if accepted == before {
            return Ok(Outcome { results, pending: None });
        }
        let (root, instance): (PathBuf, _) = (root_of(&current.settings), &current.settings.instance);
        let holders = RoleHolder::all(&root, instance)
            .map_err(|error| format!("cannot find the processes of the bridge: {error}"))?;
        let unreachable = without_holder(&current.settings, &holders);
        if !unreachable.is_empty() {
            return Err(format!(
                "cannot signal the other processes of the bridge ({}): edit the configuration file and send SIGHUP \
                 to each process",
                unreachable.join(", ")
            ));
        }
        if !self.changes.try_take(clock::monotonic()) {
            return Err(format!("parameters change too often: at most {MAX_CHANGES_HZ} request a second"));
        }
        store.write(&accepted).map_err(|error| format!("cannot store the parameters: {error}"))?;
        match request_reload(&root, instance) {
            Ok(_) => Ok(Outcome { results, pending: Some(accepted) }),
            Err(error) => {
                error!(%error, "cannot request a reload");
                // Else a process that restarts would apply what was refused.
                if let Err(error) = store.write(&before) {
                    error!(%error, "cannot restore the former parameters: the next reload applies new ones");
                }
                Err(format!("cannot request a reload: {error}"))
            }
        }
    }
}

/// The processes of the bridge that a reload cannot reach: they do not run, or in a container of their own.
fn without_holder(settings: &Settings, holders: &[RoleHolder]) -> Vec<String> {
    let lanes = settings.lanes.iter().filter(|lane| lane.is_used());
    let roles = lanes.map(|lane| format!("egress-{}", lane.name));
    let roles = ["ingress", "control"].map(str::to_owned).into_iter().chain(roles);
    roles.filter(|role| !holders.iter().any(|holder| holder.role == *role)).collect()
}

/// Refuses to set anything while the file has changes that the bridge has not applied: the reload would apply
/// them, too.
fn unchanged(store: &ParameterStore, before: &SetParameters, in_force: &Settings) -> Result<(), String> {
    let file =
        store.load(before).map_err(|error| format!("the configuration file is bad: {}", listed(&error)))?;
    match in_force.reloaded(file.settings).1.changed.first() {
        None => Ok(()),
        Some(change) => Err(format!(
            "the configuration file has changed: run `adaptive-bridge reload` first, which applies {change}"
        )),
    }
}

fn is_settable(parameter: &Parameter, current: &Parameters) -> Result<(), String> {
    let name = parameter.name.as_str();
    let declared: Option<&Row> = current.find(name).map(|listed| listed.row).or_else(|| Listed::unset(name));
    match declared {
        None => Err("not a parameter of the bridge: `ros2 param list` lists them".to_owned()),
        Some(row) if !row.reloads => {
            Err("read-only: edit the configuration file and restart the bridge".to_owned())
        }
        Some(row) if !Listed::is_settable(name, row) => {
            Err("read-only: edit the configuration file and run `adaptive-bridge reload`".to_owned())
        }
        Some(_) => match parameter.value.yaml() {
            None if parameter.value.kind != NOT_SET => {
                Err("no key of the configuration has this type".to_owned())
            }
            Some(yaml) if yaml.len() > MAX_VALUE_BYTES => {
                Err(format!("a value has at most {MAX_VALUE_BYTES} bytes"))
            }
            _ => Ok(()),
        },
    }
}

/// `set` with these parameters. One without a value has the value of the file again.
fn added(set: &SetParameters, parameters: &[&Parameter]) -> SetParameters {
    let mut added = set.clone();
    for parameter in parameters {
        match parameter.value.yaml() {
            Some(value) => added.insert(parameter.name.clone(), value),
            None => added.remove(&parameter.name),
        };
    }
    added
}

/// Checks that the configuration is valid with `set`, and that a reload applies these parameters.
fn check(
    store: &ParameterStore,
    set: &SetParameters,
    parameters: &[&Parameter],
    in_force: &Settings,
) -> Result<(), String> {
    if set.len() > MAX_SET {
        return Err(format!("{MAX_SET} parameters are set; edit the configuration file instead"));
    }
    let new = store.load(set).map_err(|error| listed(&error))?.settings;
    let (after, _) = in_force.reloaded(new.clone());
    let (new, after) = (Parameters::new(new), Parameters::new(after));
    for Parameter { name, value } in parameters {
        if new.value(name) != after.value(name) {
            return Err(format!(
                "{name}: this value needs a restart of the bridge: edit the configuration file and restart"
            ));
        }
        if value.kind != NOT_SET && !is_same(value, &ParameterValue::from(&after.value(name))) {
            return Err(format!(
                "{name}: without effect: the value in force would be {}; another key determines it",
                after.value(name)
            ));
        }
    }
    Ok(())
}

/// Whether a value that was given is the one in force: a number may be given as another type, a word in other
/// letters, and an empty text for no value.
fn is_same(given: &ParameterValue, in_force: &ParameterValue) -> bool {
    let number = |of: &ParameterValue| match of.kind {
        INTEGER => Some(of.whole as f64),
        DOUBLE => Some(of.decimal),
        _ => None,
    };
    match (number(given), number(in_force)) {
        (Some(one), Some(other)) => (one - other).abs() <= 1e-9 * one.abs().max(other.abs()),
        _ if given.kind == STRING && matches!(in_force.kind, STRING | NOT_SET) => {
            given.text.trim().eq_ignore_ascii_case(in_force.text.trim())
        }
        _ => given == in_force,
    }
}

/// Drops those of the parameters that have the value of the file, so that a later change of the file counts.
/// One is dropped only if the settings stay equal: another parameter may depend on it.
fn drop_equal_to_file(store: &ParameterStore, accepted: &mut SetParameters, parameters: &[&Parameter]) {
    let settings = |set: &SetParameters| {
        let loaded = store.load(set).ok()?.settings;
        Some(Settings { set_parameters: SetParameters::new(), ..loaded })
    };
    for Parameter { name, .. } in parameters {
        let mut without = accepted.clone();
        if without.remove(name).is_some()
            && settings(&without).is_some_and(|without| Some(without) == settings(accepted))
        {
            *accepted = without;
        }
    }
}

fn listed(error: &ConfigError) -> String {
    let problems: Vec<String> = error.problems.iter().map(ToString::to_string).collect();
    problems.join("; ")
}

/// The results in the form of ROS 2.
pub(super) fn set_results(results: Vec<Result<(), String>>) -> Vec<SetResult> {
    let result = |result: Result<(), String>| SetResult {
        successful: result.is_ok(),
        reason: result.err().map(|why| shortened(&why, MAX_REASON_BYTES)).unwrap_or_default(),
    };
    results.into_iter().map(result).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{self, Value};

    #[test]
    fn the_processes_that_cannot_be_signalled_are_named() {
        let settings =
            config::parse("topics: [{id: scan, input_topic: /scan}]", "test.yaml", &|_| None).unwrap();
        let holder = |role: &str| RoleHolder { role: role.to_owned(), pid: 7, note: PathBuf::new() };
        let all = ["control", "egress-critical", "egress-noncritical", "ingress"].map(holder);
        assert!(without_holder(&settings, &all).is_empty());
        // Control in a container of its own sees only itself.
        let missing = without_holder(&settings, &all[..1]);
        assert_eq!(missing, ["ingress", "egress-critical", "egress-noncritical"]);
    }

    #[test]
    fn a_value_is_the_one_in_force_in_each_form_that_the_file_allows() {
        let same = |given: Value, in_force: Value| {
            is_same(&ParameterValue::from(&given), &ParameterValue::from(&in_force))
        };
        let text = |text: &str| Value::Text(text.to_owned());
        assert!(same(Value::Whole(7), Value::Decimal(7.0)) && same(text("Critical"), text("CRITICAL")));
        assert!(same(text(""), Value::None) && same(Value::Flag(true), Value::Flag(true)));
        assert!(!same(Value::Decimal(7.0), Value::Decimal(5.0)) && !same(text("rviz"), Value::None));
        assert!(!same(Value::Flag(true), Value::Flag(false)));
    }
}
