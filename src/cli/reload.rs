//! `reload`: lets the running bridge take over what was changed in its configuration file.

use std::fmt::Write as _;
use std::io::{self, Write as _};
use std::process::ExitCode;

use super::{ConfigArguments, EXIT_WAITS, failed, no_bridge, output_ended, root};
use crate::config::Reload;
use crate::process::{InForce, ReloadAnswer, ReloadResult, reload_all};

pub(super) fn run(arguments: &ConfigArguments) -> ExitCode {
    // A bad file is shown here with all its problems, and no process is asked to read it.
    let file = match arguments.load() {
        Ok(settings) => settings,
        Err(code) => return code,
    };
    // The file may name another instance than the bridge that was started with it.
    let settings = InForce::find(&arguments.file(), Some(&file)).unwrap_or_else(|| file.clone());
    let root = root(&settings);
    let answers = match reload_all(&root, &settings.instance) {
        Ok(answers) if answers.is_empty() => return no_bridge(&settings, &root),
        Ok(answers) => answers,
        Err(error) => return failed(&error),
    };
    let text = tell(&answers, file.fingerprint());
    if let Err(error) = io::stdout().write_all(text.as_bytes()) {
        return output_ended(&error);
    }
    exit_code(&answers)
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

/// What changed, what waits for a restart, then each process. `fingerprint` is that of the file as it was
/// read here.
fn tell(answers: &[ReloadAnswer], fingerprint: u64) -> String {
    let mut text = String::new();
    let mut say = |line: String| {
        // The processes agree on most of it: each thing is said once.
        if !text.lines().any(|said| said == line) {
            let _ = writeln!(text, "{line}");
        }
    };
    let accepted = answers.iter().filter_map(|answer| match &answer.result {
        Some(ReloadResult::Accepted { reload, .. }) => Some(reload),
        _ => None,
    });
    for reload in accepted.clone() {
        reload.changed.iter().for_each(|change| say(format!("changed: {change}")));
    }
    for reload in accepted {
        for change in &reload.waits {
            say(format!("waits for a restart of the whole bridge: {change}"));
        }
    }
    for ReloadAnswer { role, pid, result } in answers {
        say(format!("{role} (pid {pid}): {}", outcome(result.as_ref(), fingerprint)));
    }
    text
}

fn outcome(result: Option<&ReloadResult>, fingerprint: u64) -> String {
    match result {
        None => "no answer: it is stopped, or has ended".to_owned(),
        Some(ReloadResult::Refused { problems }) => {
            format!("refused, and nothing changed in it:\n{problems}")
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
                format!("{what}; it reads another file than this one, or has another environment")
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Change;

    #[test]
    fn what_all_processes_say_is_told_once_and_each_outcome_for_itself() {
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
            tell(&answers, 1),
            "changed: policy_hold_s: 1 -> 2\n\
             waits for a restart of the whole bridge: ros.domain_id: 1 -> 2\n\
             egress-a (pid 7): reloaded\n\
             egress-b (pid 7): reloaded; it reads another file than this one, or has another environment\n\
             egress-c (pid 7): nothing differs\n\
             egress-d (pid 7): refused, and nothing changed in it:\nf.yaml:1: x: must be y\n\
             ingress (pid 7): no answer: it is stopped, or has ended\n"
        );
    }
}
