//! `reload`: applies the changes of the configuration file to the running bridge.

use std::process::ExitCode;

use super::{ConfigArguments, EXIT_WAITS, bad_configuration, failed, no_bridge, print};
use crate::config::{Reload, SetParameters};
use crate::process::{InForce, ReloadAnswer, ReloadResult, reload_all};
use crate::shm::root_of;

pub(super) fn run(arguments: &ConfigArguments) -> Result<ExitCode, ExitCode> {
    // A bad file is refused here with all its problems, before any process of the bridge reads it.
    let file = arguments.load()?;
    // The file may have a new instance name since the bridge was started with it.
    let settings = InForce::find(&arguments.file(), Some(&file)).unwrap_or_else(|| file.clone());
    let set = &settings.set_parameters;
    let file = arguments.try_load_with(set).map_err(|error| {
        let code = bad_configuration(&error);
        eprintln!("{}", set_is_the_cause(set));
        code
    });
    let file = file?.settings;
    let root = root_of(&settings);
    let answers = reload_all(&root, &settings.instance).map_err(|error| failed(&error))?;
    if answers.is_empty() {
        return Err(no_bridge(&settings, &root));
    }
    let kept = set.iter().map(|(key, value)| format!("stays as set by a ROS 2 parameter: {key}: {value}\n"));
    print(kept.collect::<String>() + &summary(&answers, file.fingerprint()))?;
    Ok(exit_code(&answers))
}

/// Why a file that is good by itself is bad in the running bridge, and what to do.
fn set_is_the_cause(set: &SetParameters) -> String {
    let set: Vec<String> = set.iter().map(|(key, value)| format!("{key}: {value}")).collect();
    format!(
        "The file alone is good. The likely cause is a parameter that a ROS 2 node has set in place of a value of the \
         file: {}. Remove the one that does not fit: ros2 param delete NODE KEY, where NODE is a node of the bridge.",
        set.join(", ")
    )
}

fn exit_code(answers: &[ReloadAnswer]) -> ExitCode {
    let mut code = ExitCode::SUCCESS;
    for answer in answers {
        match &answer.result {
            Some(ReloadResult::Accepted { reload, .. }) if reload.waits.is_empty() => {}
            Some(ReloadResult::Accepted { .. }) => code = ExitCode::from(EXIT_WAITS),
            Some(ReloadResult::Refused { .. }) | None => return ExitCode::FAILURE,
        }
    }
    code
}

/// Lists the applied changes, the changes that wait for a restart, and the outcome of each process.
/// `fingerprint` is that of the file as this command read it.
fn summary(answers: &[ReloadAnswer], fingerprint: u64) -> String {
    let mut text = String::new();
    let mut add = |line: String| {
        // Processes report the same changes: each line is printed once.
        if !text.lines().any(|printed| printed == line) {
            text += &format!("{line}\n");
        }
    };
    let accepted = answers.iter().filter_map(|answer| match &answer.result {
        Some(ReloadResult::Accepted { reload, .. }) => Some(reload),
        _ => None,
    });
    for change in accepted.clone().flat_map(|reload| &reload.changed) {
        add(format!("changed: {change}"));
    }
    for change in accepted.flat_map(|reload| &reload.waits) {
        add(format!("waits for a restart of the whole bridge: {change}"));
    }
    for ReloadAnswer { role, pid, result } in answers {
        add(format!("{role} (pid {pid}): {}", outcome(result.as_ref(), fingerprint)));
    }
    text
}

fn outcome(result: Option<&ReloadResult>, fingerprint: u64) -> String {
    match result {
        None => "no answer: it is stopped or has exited".to_owned(),
        Some(ReloadResult::Refused { problems }) => {
            format!("refused; its settings are unchanged:\n{problems}")
        }
        Some(ReloadResult::Accepted { file_fingerprint, reload }) => {
            let what = match reload {
                Reload { changed, waits } if changed.is_empty() && waits.is_empty() => "nothing differs",
                Reload { changed, .. } if changed.is_empty() => "nothing changed",
                _ => "reloaded",
            };
            if *file_fingerprint == fingerprint {
                what.to_owned()
            } else {
                format!("{what}; it reads a different file, or has other environment variables or parameters")
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Change;

    #[test]
    fn a_change_of_all_processes_is_listed_once_and_the_outcome_of_each_process() {
        let change = |key: &str| Change { key: key.to_owned(), old: "1".to_owned(), new: "2".to_owned() };
        let reload = Reload { changed: vec![change("policy_hold_s")], waits: vec![change("ros.domain_id")] };
        let answer = |role: &str, result| ReloadAnswer { role: role.to_owned(), pid: 7, result };
        let accepted = |file_fingerprint| ReloadResult::Accepted { file_fingerprint, reload: reload.clone() };
        let nothing = ReloadResult::Accepted { file_fingerprint: 1, reload: Reload::default() };
        let refused = ReloadResult::Refused { problems: "f.yaml:1: x: must be y".to_owned() };
        let answers = [
            answer("egress-a", Some(accepted(1))),
            answer("egress-b", Some(accepted(2))),
            answer("egress-c", Some(nothing)),
            answer("egress-d", Some(refused)),
            answer("ingress", None),
        ];
        assert_eq!(
            summary(&answers, 1),
            "changed: policy_hold_s: 1 -> 2\n\
             waits for a restart of the whole bridge: ros.domain_id: 1 -> 2\n\
             egress-a (pid 7): reloaded\n\
             egress-b (pid 7): reloaded; it reads a different file, or has other environment variables or parameters\n\
             egress-c (pid 7): nothing differs\n\
             egress-d (pid 7): refused; its settings are unchanged:\nf.yaml:1: x: must be y\n\
             ingress (pid 7): no answer: it is stopped or has exited\n"
        );
    }
}
