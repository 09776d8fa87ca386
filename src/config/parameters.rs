//! Values that the command line sets in place of those of the file: ROS 2 parameters.

use std::collections::BTreeMap;
use std::convert::Infallible;
use std::fmt;
use std::path::PathBuf;
use std::rc::Rc;
use std::str::FromStr;

use super::keys::Key;
use super::overlay::{is_equal, leaves, put};
use super::problem::{Place, Problem, Problems};
use super::settings::Settings;
use super::yaml::{self, Content, Entry, Node};

/// A source of ROS 2 parameters on the command line.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Parameters {
    /// One parameter: `-p key:=value`.
    One {
        /// The key path, such as `classifier.evaluate_rate_hz`.
        key: String,
        /// The value, in YAML.
        value: String,
    },
    /// A file in the format of ROS 2: `--params-file FILE`.
    File(PathBuf),
}

/// `KEY:=VALUE`, or the path of a file.
impl FromStr for Parameters {
    type Err = Infallible;

    fn from_str(text: &str) -> Result<Self, Infallible> {
        Ok(match text.split_once(":=") {
            Some((key, value)) => Self::One { key: key.to_owned(), value: value.to_owned() },
            None => Self::File(text.into()),
        })
    }
}

/// The form that [`FromStr`] reads.
impl fmt::Display for Parameters {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::One { key, value } => write!(f, "{key}:={value}"),
            Self::File(path) => write!(f, "{}", path.display()),
        }
    }
}

/// The parameter of the original package that names the configuration file.
const CONFIG_PATH: &str = "config_path";

/// A parameter of every ROS 2 node, which launch files set for all. It has no effect: the bridge compares
/// source timestamps with the system's clock.
const USE_SIM_TIME: &str = "use_sim_time";

/// The name of the bridge's section in a file of parameters, unless the command line renames the node.
const DEFAULT_NAME: &str = "adaptive_bridge";

/// Parameters that were read.
#[derive(Default)]
pub(super) struct Values {
    /// The value of `config_path`.
    pub config_path: Option<PathBuf>,
    /// The name and the value of each parameter.
    given: Vec<(String, Node)>,
    /// The sections for other nodes. Some of these may be nodes of the bridge.
    sections: Vec<Section>,
}

impl Values {
    /// Puts the values into the tree of the configuration file. A later value replaces an earlier one.
    pub fn merge_into(&self, root: &mut Node, problems: &Problems) {
        for (name, value) in &self.given {
            put(root, name, value.clone(), problems);
        }
    }

    /// Whether there are sections for single nodes, which may be nodes of the bridge.
    pub fn have_sections(&self) -> bool {
        !self.sections.is_empty()
    }

    /// Puts the values for single nodes of the bridge into the tree, as `ros2 param dump` writes them.
    /// `settings` are those without these values.
    ///
    /// A dump has every setting, also those that follow from others or that no key sets alone. So values that
    /// are in force without it are left out.
    pub fn merge_dumps_into(&self, root: &mut Node, settings: &Settings, problems: &Problems) {
        let processes = ["ingress".to_owned(), "control".to_owned()].into_iter();
        let processes = processes.chain(settings.lanes.iter().map(|lane| format!("egress_{}", lane.name)));
        let nodes: Vec<String> = processes
            .map(|process| format!("{}/{}", settings.node_namespace, settings.node_name_of(&process)))
            .collect();
        let nodes: Vec<Vec<&str>> = nodes.iter().map(|node| tokens(node)).collect();
        let mut values = BTreeMap::new();
        for section in &self.sections {
            if !nodes.iter().any(|node| matches(&tokens(&section.pattern), node)) {
                continue;
            }
            let concerning = section.parameters.iter().filter(|entry| concerns(entry, section.is_shared));
            for Entry { key, line, value } in concerning {
                let value = Node { line: *line, ..Node::clone(value) };
                leaves(key, &value, &mut |name, value| {
                    values.insert(name.to_owned(), value);
                });
            }
        }
        let listed = settings.listed();
        for (name, value) in values {
            let own = listed.binary_search_by(|listed| listed.name.cmp(&name));
            let is_in_force = own.is_ok_and(|index| is_equal(&listed[index].value, &value));
            if !is_in_force && name != USE_SIM_TIME {
                put(root, &name, value, problems);
            }
        }
    }

    fn add(&mut self, key: &str, value: Node) {
        match &value.content {
            Content::Scalar { text, .. } if key == CONFIG_PATH => {
                self.config_path = Some(text.into()).filter(|_| !text.is_empty());
            }
            _ if key == USE_SIM_TIME => {}
            _ => self.given.push((key.to_owned(), value)),
        }
    }
}

/// The file of each source of parameters; `None` for a single parameter.
pub(super) fn files(parameters: &[Parameters]) -> Vec<Option<PathBuf>> {
    let file = |parameters: &Parameters| match parameters {
        Parameters::One { .. } => None,
        Parameters::File(path) => Some(path.clone()),
    };
    parameters.iter().map(file).collect()
}

/// Reads parameters in their order.
pub(super) fn read(parameters: &[Parameters]) -> Result<Values, Problem> {
    let renamed = |wanted: &str| {
        parameters.iter().rev().find_map(|parameter| match parameter {
            Parameters::One { key, value } if key == wanted => Some(value.trim_matches('\'')),
            _ => None,
        })
    };
    let namespace = renamed("ros.namespace").unwrap_or_default();
    let mut node = tokens(namespace);
    node.push(renamed("ros.node_name").unwrap_or(DEFAULT_NAME));
    let mut values = Values::default();
    for (source, parameter) in parameters.iter().enumerate() {
        let problem = |key: &str, line: usize, allowed: String| {
            Problem::new(Place::Parameter { source, line }, key, allowed)
        };
        let parse = |key: &str, bytes: &[u8]| {
            let node = yaml::parse(bytes);
            let node = node.map_err(|error| problem(key, error.line.unwrap_or(0), error.message))?;
            Ok(node.map_or_else(Node::null, Rc::unwrap_or_clone))
        };
        match parameter {
            Parameters::One { key, value } => {
                let mut value = parse(key, value.as_bytes())?;
                relocate(&mut value, source);
                values.add(key, value);
            }
            Parameters::File(path) => {
                let bytes = yaml::read(path).map_err(|what| problem("", 0, what))?;
                let mut found = Vec::new();
                sections("", parse("", &bytes)?, &mut found)
                    .map_err(|(line, what)| problem("", line, what))?;
                for mut section in found {
                    section.parameters.iter_mut().for_each(|entry| relocate_entry(entry, source));
                    if matches(&tokens(&section.pattern), &node) {
                        let Section { parameters, is_shared, .. } = section;
                        let concerning = parameters.into_iter().filter(|entry| concerns(entry, is_shared));
                        for Entry { key, line, value } in concerning {
                            values.add(&key, Node { line, ..Rc::unwrap_or_clone(value) });
                        }
                    } else {
                        values.sections.push(section);
                    }
                }
            }
        }
    }
    Ok(values)
}

/// Marks a value and all below it as given by a parameter.
fn relocate(node: &mut Node, source: usize) {
    node.line = Place::number_of_parameter(source, node.line);
    match &mut node.content {
        Content::Scalar { .. } => {}
        Content::List(items) => items.iter_mut().for_each(|item| relocate(Rc::make_mut(item), source)),
        Content::Map(entries) => entries.iter_mut().for_each(|entry| relocate_entry(entry, source)),
    }
}

fn relocate_entry(entry: &mut Entry, source: usize) {
    entry.line = Place::number_of_parameter(source, entry.line);
    relocate(Rc::make_mut(&mut entry.value), source);
}

/// The parameters of a node in a file.
struct Section {
    /// The name of the node, or a pattern of names.
    pattern: String,
    parameters: Vec<Entry>,
    /// Whether it is for several nodes, so that it may have parameters of others.
    is_shared: bool,
}

/// Whether a parameter is one of the bridge, or may be one with a mistake.
fn concerns(entry: &Entry, is_shared: bool) -> bool {
    let first = entry.key.split('.').next().unwrap_or_default();
    !is_shared || [CONFIG_PATH, USE_SIM_TIME].contains(&first) || Key::root().get(first).is_some()
}

/// Collects the sections of a file in their order. Returns the line and the reason if the file has another
/// form.
fn sections(name: &str, document: Node, found: &mut Vec<Section>) -> Result<(), (usize, String)> {
    let Content::Map(entries) = document.content else {
        let what = "must have the form `NODE: {ros__parameters: {KEY: VALUE}}`";
        return Err((document.line, what.to_owned()));
    };
    for Entry { key, line, value } in entries {
        let value = Node { line, ..Rc::unwrap_or_clone(value) };
        // A section may also be written as `namespace: {node: {ros__parameters: …}}`.
        if key != "ros__parameters" {
            sections(&format!("{name}/{key}"), value, found)?;
            continue;
        }
        if value.is_null() {
            continue;
        }
        let Content::Map(parameters) = value.content else {
            return Err((line, "must be a mapping of parameters".to_owned()));
        };
        let is_shared = tokens(name).iter().any(|token| token.starts_with('*'));
        found.push(Section { pattern: name.to_owned(), parameters, is_shared });
    }
    Ok(())
}

/// The parts of a node's name.
fn tokens(name: &str) -> Vec<&str> {
    name.split('/').filter(|token| !token.is_empty()).collect()
}

/// Whether a pattern of rcl is for this node: `*` is one token of its name, `**` any number of them.
fn matches(pattern: &[&str], node: &[&str]) -> bool {
    match (pattern.split_first(), node.split_first()) {
        (None, None) => true,
        (Some((&"**", rest)), below) => {
            matches(rest, node) || below.is_some_and(|(_, below)| matches(pattern, below))
        }
        (Some((token, rest)), Some((own, below))) => (*token == "*" || token == own) && matches(rest, below),
        _ => false,
    }
}
