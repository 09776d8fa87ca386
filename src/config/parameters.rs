//! Values that the command line sets in place of those of the file: ROS 2 parameters. The name of a parameter
//! is the key path of the configuration.

use std::convert::Infallible;
use std::fmt;
use std::path::PathBuf;
use std::rc::Rc;
use std::str::FromStr;

use super::keys::{self, Key, joined};
use super::problem::{Place, Problem, Problems};
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

/// The most names in the name of a parameter. A longer one is no key.
const MAX_NAMES: usize = 8;

/// The name of the bridge's section in a file of parameters, unless the command line renames the node.
const DEFAULT_NAME: &str = "adaptive_bridge";

/// Parameters that were read.
#[derive(Default)]
pub(super) struct Values {
    /// The value of `config_path`.
    pub config_path: Option<PathBuf>,
    /// A tree for each parameter, with only its value.
    trees: Vec<Node>,
}

impl Values {
    /// Puts the values into the tree of the configuration file. A later value replaces an earlier one.
    pub fn merge_into(self, root: &mut Node, problems: &Problems) {
        for tree in self.trees {
            // Of a key that is given twice in one value, only the last one is left in the tree of the file.
            keys::check(&tree, problems);
            merge(root, tree, "", problems);
        }
    }

    fn add(&mut self, key: &str, value: Node) {
        match &value.content {
            Content::Scalar { text, .. } if key == CONFIG_PATH => {
                self.config_path = Some(text.into()).filter(|_| !text.is_empty());
            }
            _ if key == USE_SIM_TIME => {}
            _ => self.trees.push(nested(key, value)),
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
    let mut node: Vec<&str> = namespace.split('/').filter(|token| !token.is_empty()).collect();
    node.push(renamed("ros.node_name").unwrap_or(DEFAULT_NAME));
    let mut values = Values::default();
    for (source, parameter) in parameters.iter().enumerate() {
        let problem = |key: &str, line: usize, allowed: String| Problem {
            place: Place::Parameter { source, line },
            key: key.to_owned(),
            value: None,
            allowed,
            hint: None,
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
                let sections = sections(parse("", &bytes)?, &node);
                let sections = sections.map_err(|(line, what)| problem("", line, what))?;
                for FileParameter { key, mut value, is_shared } in sections {
                    let first = key.split('.').next().unwrap_or_default();
                    let is_known =
                        [CONFIG_PATH, USE_SIM_TIME].contains(&first) || Key::root().get(first).is_some();
                    if is_shared && !is_known {
                        continue;
                    }
                    relocate(&mut value, source);
                    values.add(&key, value);
                }
            }
        }
    }
    Ok(values)
}

/// Marks a value and all below it as given by a parameter.
fn relocate(node: &mut Node, source: usize) {
    let marked = |line| Place::number_of_parameter(source, line);
    node.line = marked(node.line);
    match &mut node.content {
        Content::Scalar { .. } => {}
        Content::List(items) => items.iter_mut().for_each(|item| relocate(Rc::make_mut(item), source)),
        Content::Map(entries) => {
            for entry in entries {
                entry.line = marked(entry.line);
                relocate(Rc::make_mut(&mut entry.value), source);
            }
        }
    }
}

/// A parameter in a file.
struct FileParameter {
    key: String,
    value: Node,
    /// Whether it is in the section of all nodes, which may have parameters of other nodes.
    is_shared: bool,
}

/// The parameters of a file in the sections of this node and in those of all nodes. Returns the line and the
/// reason if the file has another form.
fn sections(document: Node, node: &[&str]) -> Result<Vec<FileParameter>, (usize, String)> {
    let mut found = Vec::new();
    let mut waiting = vec![(String::new(), document)];
    while let Some((name, section)) = waiting.pop() {
        let Content::Map(entries) = section.content else {
            let what = "must have the form `NODE: {ros__parameters: {KEY: VALUE}}`";
            return Err((section.line, what.to_owned()));
        };
        for Entry { key, line, value } in entries {
            let value = Node { line, ..Rc::unwrap_or_clone(value) };
            // A section may also be written as `namespace: {node: {ros__parameters: …}}`.
            if key != "ros__parameters" {
                waiting.push((format!("{name}/{key}"), value));
                continue;
            }
            let pattern: Vec<&str> = name.split('/').filter(|token| !token.is_empty()).collect();
            if !matches(&pattern, node) {
                continue;
            }
            let Content::Map(parameters) = value.content else {
                return Err((line, "must be a mapping of parameters".to_owned()));
            };
            let is_shared = pattern.iter().any(|token| token.starts_with('*'));
            found.extend(parameters.into_iter().map(|Entry { key, line, value }| {
                let value = Node { line, ..Rc::unwrap_or_clone(value) };
                FileParameter { key, value, is_shared }
            }));
        }
    }
    Ok(found)
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

/// The tree that has only this value, at this key path.
fn nested(path: &str, value: Node) -> Node {
    path.rsplitn(MAX_NAMES, '.').fold(value, |value, name| {
        let line = value.line;
        let entry = Entry { key: name.to_owned(), line, value: Rc::new(value) };
        Node { line, content: Content::Map(vec![entry]) }
    })
}

/// Merges mappings, and replaces other values. Reports a mapping in place of a value, such as the depth of a
/// QoS profile that the file gives by its name.
fn merge(into: &mut Node, from: Node, path: &str, problems: &Problems) {
    let is_null = into.is_null();
    match (&mut into.content, from.content) {
        (Content::Map(own), Content::Map(new)) => {
            for entry in new {
                let Some(own) = own.iter_mut().find(|own| own.key == entry.key) else {
                    own.push(entry);
                    continue;
                };
                if !matches!(entry.value.content, Content::Map(_)) {
                    own.line = entry.line;
                }
                let path = joined(path, &entry.key);
                merge(Rc::make_mut(&mut own.value), Rc::unwrap_or_clone(entry.value), &path, problems);
            }
        }
        (_, Content::Map(_)) if !is_null => problems.report(Problem {
            place: Place::of(from.line),
            key: path.to_owned(),
            value: None,
            allowed: "must be set as a whole: in the configuration file it is no mapping".to_owned(),
            hint: None,
        }),
        (own, new) => {
            *own = new;
            into.line = from.line;
        }
    }
}
