//! The arguments that `ros2 run` and a launch file's `Node` append: `--ros-args … --`.
//!
//! The bridge has one configuration for all its nodes, so these arguments become values of configuration
//! keys: options `--parameter`.

use std::ffi::{OsStr, OsString};

/// Why an argument after `--ros-args` is refused, with what to do instead.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
#[error("--ros-args {argument}: {what}")]
pub(super) struct RosArgumentError {
    argument: String,
    what: String,
}

/// Replaces everything from each `--ros-args` to the next `--` by the options that have its effect.
///
/// # Errors
/// An argument of ROS 2 is unknown, or the bridge cannot do what it asks for.
pub(super) fn translate(
    arguments: impl IntoIterator<Item = OsString>,
) -> Result<Vec<OsString>, RosArgumentError> {
    let mut arguments = arguments.into_iter();
    let mut translated = Vec::new();
    let mut options = Vec::new();
    while let Some(argument) = arguments.next() {
        if argument != "--ros-args" {
            translated.push(argument);
            continue;
        }
        while let Some(argument) = arguments.next().filter(|argument| argument != "--") {
            options.extend(option(&argument.to_string_lossy(), &mut arguments)?);
        }
    }
    for option in options {
        translated.extend([OsString::from("--parameter"), option]);
    }
    Ok(translated)
}

/// The value of `--parameter` for one argument of ROS 2, whose own value is the next of `arguments`.
fn option(
    argument: &str,
    arguments: &mut impl Iterator<Item = OsString>,
) -> Result<Option<OsString>, RosArgumentError> {
    let refused = |what: &str| RosArgumentError { argument: argument.to_owned(), what: what.to_owned() };
    let mut value = || arguments.next().ok_or_else(|| refused("a value must follow"));
    match argument {
        "-r" | "--remap" => remapping(&value()?).map(Some),
        "-p" | "--param" => parameter(&value()?).map(Some),
        "--params-file" => value().map(Some),
        "--log-level" => log_level(&value()?).map(Some),
        // The bridge logs to standard error, and what its libraries log there.
        "--disable-rosout-logs" | "--enable-stdout-logs" | "--enable-external-lib-logs" => Ok(None),
        "--enable-rosout-logs" | "--disable-stdout-logs" | "--disable-external-lib-logs" => {
            Err(refused("the bridge logs to standard error only; set `--log-level` for less of it"))
        }
        "--log-config-file" | "--log-file-name" => {
            Err(refused("the bridge logs to standard error; redirect that, or use the journal"))
        }
        "-e" | "--enclave" => Err(refused("the bridge does not support SROS 2: leave this out")),
        _ => Err(refused(
            "must be one of -r, --remap, -p, --param, --params-file, --log-level; `--` ends the arguments of ROS 2",
        )),
    }
}

/// Splits `name:=value`, and the name of a node from `node:name`.
fn rule(text: &OsStr) -> Option<(Option<String>, String, String)> {
    let text = text.to_str()?;
    let (name, value) = text.split_once(":=")?;
    Some(match name.split_once(':') {
        // A URL scheme, as in `rostopic:///scan`, is part of the name.
        Some((node, name)) if !name.starts_with("//") => {
            (Some(node.to_owned()), name.to_owned(), value.to_owned())
        }
        _ => (None, name.to_owned(), value.to_owned()),
    })
}

fn remapping(text: &OsStr) -> Result<OsString, RosArgumentError> {
    let refused =
        |what: &str| RosArgumentError { argument: format!("-r {}", text.display()), what: what.to_owned() };
    let Some((node, from, to)) = rule(text) else { return Err(refused("must be `FROM:=TO`")) };
    let key = match from.as_str() {
        "__node" | "__name" => "ros.node_name",
        "__ns" => "ros.namespace",
        _ => {
            return Err(refused(
                "the bridge renames its nodes only, by `__node:=` and `__ns:=`; the topics of a route are \
                 `topics[].input_topic` and `topics[].outputs` in the configuration file",
            ));
        }
    };
    if let Some(node) = node {
        let what = format!("applies to all nodes of the bridge, not to one: leave out `{node}:`");
        return Err(refused(&what));
    }
    Ok(text_parameter(key, &to))
}

fn parameter(text: &OsStr) -> Result<OsString, RosArgumentError> {
    // Without the value, which may be a secret.
    let shown = text.to_string_lossy();
    let name = shown.split('=').next().unwrap_or_default().trim_end_matches(':');
    let refused = |what: String| RosArgumentError { argument: format!("-p {name}"), what };
    let Some((node, key, value)) = rule(text) else {
        return Err(refused("must be `KEY:=VALUE`".to_owned()));
    };
    if let Some(node) = node {
        return Err(refused(format!(
            "all nodes of the bridge have the same configuration: leave out `{node}:`"
        )));
    }
    Ok(format!("{key}:={value}").into())
}

fn log_level(text: &OsStr) -> Result<OsString, RosArgumentError> {
    let level = text.to_string_lossy().to_lowercase();
    let refused = |what: &str| RosArgumentError {
        argument: format!("--log-level {}", text.display()),
        what: what.to_owned(),
    };
    match level.as_str() {
        "debug" | "info" | "warn" | "error" => Ok(text_parameter("diagnostics.verbosity", &level)),
        "fatal" => Ok(text_parameter("diagnostics.verbosity", "error")),
        level if level.contains(":=") => {
            Err(refused("all nodes of the bridge have the same log level: leave out the name of the logger"))
        }
        _ => Err(refused("must be one of debug, info, warn, error, fatal")),
    }
}

/// A parameter whose value is a text, in YAML.
fn text_parameter(key: &str, value: &str) -> OsString {
    format!("{key}:='{}'", value.replace('\'', "''")).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn translated(arguments: &str) -> Result<String, String> {
        let arguments = arguments.split_whitespace().map(OsString::from);
        let joined = |arguments: Vec<OsString>| arguments.join(OsStr::new(" ")).into_string().unwrap();
        translate(arguments).map(joined).map_err(|error| error.to_string())
    }

    #[test]
    fn arguments_of_ros_2_become_parameters() {
        for (given, expected) in [
            ("up -c a.yaml", "up -c a.yaml"),
            ("up --ros-args", "up"),
            (
                "up --ros-args -r __node:=front --remap __ns:=/r1 -- -c a.yaml",
                "up -c a.yaml --parameter ros.node_name:='front' --parameter ros.namespace:='/r1'",
            ),
            (
                "up --ros-args -p config_path:=/a.yaml --params-file b.yaml",
                "up --parameter config_path:=/a.yaml --parameter b.yaml",
            ),
            (
                "up --ros-args --log-level WARN --disable-rosout-logs -- --ros-args --log-level fatal",
                "up --parameter diagnostics.verbosity:='warn' --parameter diagnostics.verbosity:='error'",
            ),
        ] {
            assert_eq!(translated(given), Ok(expected.to_owned()), "{given}");
        }
    }

    #[test]
    fn an_argument_that_the_bridge_cannot_honour_is_named_with_a_remedy() {
        for (given, argument, what) in [
            ("-r /scan:=/front/scan", "-r /scan:=/front/scan", "topics[].input_topic"),
            ("-r rostopic:///scan:=/b", "-r rostopic:///scan:=/b", "topics[].input_topic"),
            ("-r ingress:__node:=a", "-r ingress:__node:=a", "leave out `ingress:`"),
            ("-r __node", "-r __node", "must be `FROM:=TO`"),
            ("-r", "-r", "a value must follow"),
            ("-p control:probes.rate_hz:=4", "-p control:probes.rate_hz", "leave out `control:`"),
            ("-p security.hmac_secret=S3cret", "-p security.hmac_secret", "must be `KEY:=VALUE`"),
            ("--log-level rcl:=debug", "--log-level rcl:=debug", "leave out the name of the logger"),
            ("--log-level loud", "--log-level loud", "debug, info, warn, error, fatal"),
            ("--enclave /a", "--enclave", "SROS 2"),
            ("--enable-rosout-logs", "--enable-rosout-logs", "standard error"),
            ("--log-config-file a", "--log-config-file", "standard error"),
            ("--config a.yaml", "--config", "--params-file"),
        ] {
            let error = translated(&format!("up --ros-args {given}")).unwrap_err();
            assert!(!error.contains("S3cret"), "{error}");
            assert!(
                error.starts_with(&format!("--ros-args {argument}: ")) && error.contains(what),
                "{error}"
            );
        }
    }
}
