//! The executables of the original Python package, for launch files that start them: the program acts as the
//! one whose name it is started by.

use std::ffi::OsString;
use std::path::Path;
use std::process::ExitCode;

use tracing::warn;

use super::roles;

/// Puts the subcommand in place of the name of an executable of the original package.
pub(super) fn translate(arguments: impl IntoIterator<Item = OsString>) -> Vec<OsString> {
    let mut arguments: Vec<OsString> = arguments.into_iter().collect();
    let program = arguments.first().and_then(|program| Path::new(program).file_name()?.to_str());
    let subcommand: &[&str] = match program {
        Some("proxy_node") => &["up"],
        Some("classifier_node" | "diagnostics_node") => &["companion"],
        Some("probe_responder") if arguments.iter().any(|argument| argument == "--id") => &["responder"],
        Some("probe_responder") => &["responder", "--id", "adaptive_bridge_probe_responder"],
        _ => &[],
    };
    let after_program = arguments.len().min(1);
    arguments.splice(after_program..after_program, subcommand.iter().map(OsString::from));
    arguments
}

/// Waits until a signal ends the process: launch files of the original package start the classifier and the
/// diagnostics beside the proxy, and may end all when one of them ends.
pub(super) fn companion() -> Result<ExitCode, ExitCode> {
    warn!(
        "this process does nothing: `proxy_node`, which is `adaptive-bridge up`, also classifies and diagnoses"
    );
    roles::run(|stop| -> Result<(), std::convert::Infallible> {
        while super::pause(u64::MAX, stop) {}
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_the_program_selects_the_subcommand() {
        for (given, expected) in [
            ("/opt/lib/adaptive_bridge/proxy_node -c a", "/opt/lib/adaptive_bridge/proxy_node up -c a"),
            ("classifier_node", "classifier_node companion"),
            ("probe_responder", "probe_responder responder --id adaptive_bridge_probe_responder"),
            ("adaptive-bridge status", "adaptive-bridge status"),
        ] {
            let translated = translate(given.split(' ').map(OsString::from));
            assert_eq!(translated.join(std::ffi::OsStr::new(" ")), expected);
        }
        assert_eq!(translate([]), Vec::<OsString>::new());
    }
}
