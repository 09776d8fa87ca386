//! The problems of a configuration, collected in one error, each with its place, value and remedy.

use std::cell::RefCell;
use std::collections::HashSet;
use std::fmt;
use std::path::PathBuf;

/// Where a problem is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Place {
    /// An environment variable; the problem's key is its name.
    Environment,
    /// The file as a whole.
    File,
    /// This line of the file, counted from 1.
    Line(usize),
    /// A parameter of the command line.
    Parameter {
        /// Its index in [`ConfigError::parameter_files`].
        source: usize,
        /// The line in its file, counted from 1; 0 for the file as a whole.
        line: usize,
    },
}

/// The nodes of the tree have numbers of lines. Those of parameters have the index of their source, plus 1,
/// above these bits.
const LINE_BITS: u32 = 32;

impl Place {
    /// The place of a node with this number.
    pub(super) fn of(number: usize) -> Self {
        match (number >> LINE_BITS).checked_sub(1) {
            None => Self::Line(number),
            Some(source) => Self::Parameter { source, line: number & ((1 << LINE_BITS) - 1) },
        }
    }

    /// The place of a node with this number, as a noun.
    pub(super) fn noun(number: usize) -> String {
        match Self::of(number) {
            Self::Line(line) => format!("line {line}"),
            _ => "a parameter".to_owned(),
        }
    }

    /// The number of nodes in this line of a source of parameters.
    pub(super) fn number_of_parameter(source: usize, line: usize) -> usize {
        (source + 1) << LINE_BITS | line
    }
}

/// One problem of a configuration.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Problem {
    /// Where it is.
    pub place: Place,
    /// The key path, such as `topics[0].input_topic`; empty for a problem of the whole file or of its syntax.
    pub key: String,
    /// The value in the file, cut to a readable length; `None` when a key is missing or unknown, or the value
    /// is secret.
    pub value: Option<String>,
    /// What is allowed, as a phrase that begins with "must"; or what else is wrong.
    pub allowed: String,
    /// A remedy, such as "did you mean `depth`?".
    pub hint: Option<String>,
}

impl Problem {
    /// A problem without a value and without a hint.
    pub(super) fn new(place: Place, key: &str, allowed: String) -> Self {
        Self { place, key: key.to_owned(), value: None, allowed, hint: None }
    }
}

/// Every problem of a configuration.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConfigError {
    /// The name of the file as given to the loader.
    pub file: String,
    /// The problems, in the order of the file; those of the environment come first.
    pub problems: Vec<Problem>,
    /// The file of each source of parameters on the command line; `None` for a single parameter.
    pub parameter_files: Vec<Option<PathBuf>>,
}

impl ConfigError {
    /// An error with at least one problem. Sorts the problems by their place, and removes repetitions.
    pub(super) fn new(file: &str, parameter_files: Vec<Option<PathBuf>>, mut problems: Vec<Problem>) -> Self {
        let mut seen = HashSet::new();
        problems.retain(|problem| seen.insert((problem.place, problem.key.clone(), problem.allowed.clone())));
        problems.sort_by_key(|problem| problem.place);
        Self { file: file.to_owned(), problems, parameter_files }
    }
}

/// One line for each problem: `FILE:LINE: key.path = value: must be … (did you mean …?)`.
impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, problem) in self.problems.iter().enumerate() {
            if index > 0 {
                f.write_str("\n")?;
            }
            match problem.place {
                Place::Environment => f.write_str("environment: ")?,
                Place::File => write!(f, "{}: ", self.file)?,
                Place::Line(line) => write!(f, "{}:{line}: ", self.file)?,
                Place::Parameter { source, line } => match self.parameter_files.get(source) {
                    Some(Some(path)) if line > 0 => write!(f, "{}:{line}: ", path.display())?,
                    Some(Some(path)) => write!(f, "{}: ", path.display())?,
                    _ => f.write_str("parameter: ")?,
                },
            }
            write!(f, "{problem}")?;
        }
        Ok(())
    }
}

impl std::error::Error for ConfigError {}

/// The problem without its place.
impl fmt::Display for Problem {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.key)?;
        if let Some(value) = &self.value {
            write!(f, " = {value}")?;
        }
        if !self.key.is_empty() {
            f.write_str(": ")?;
        }
        f.write_str(&self.allowed)?;
        match &self.hint {
            Some(hint) => write!(f, " ({hint})"),
            None => Ok(()),
        }
    }
}

/// Collects the problems of a file. All fields share it, which requires the `RefCell`.
#[derive(Debug, Default)]
pub(super) struct Problems(RefCell<Vec<Problem>>);

impl Problems {
    pub fn report(&self, problem: Problem) {
        self.0.borrow_mut().push(problem);
    }

    /// Whether a problem with exactly this key path was added.
    pub fn has_key(&self, key: &str) -> bool {
        self.0.borrow().iter().any(|problem| problem.key == key)
    }

    /// A "did you mean" hint at the name closest to `word`, if one is similar.
    pub fn hint(&self, word: &str, names: &[&str]) -> Option<String> {
        // The comparison is costly, and hints do not help with a file that has so many problems.
        if self.0.borrow().len() >= MAX_HINTS {
            return None;
        }
        nearest(word, names).map(did_you_mean)
    }

    pub fn into_inner(self) -> Vec<Problem> {
        self.0.into_inner()
    }
}

/// The most characters of the user's text that a message repeats.
const SHOWN_CHARS: usize = 60;

/// Limits of the search for similar names. Its time is proportional to the product of the first two and the
/// square of the third.
const MAX_HINTS: usize = 128;
const MAX_COMPARED_NAMES: usize = 512;
const MAX_COMPARED_BYTES: usize = 64;

/// Escapes control characters in the user's text, and cuts it to [`SHOWN_CHARS`].
pub(super) fn shown(text: &str) -> String {
    let mut shown: String = text.chars().take(SHOWN_CHARS).flat_map(char::escape_debug).collect();
    if text.chars().nth(SHOWN_CHARS).is_some() {
        shown.push('…');
    }
    shown
}

/// The most similar name: at most a third of the letters of `word` differ, ignoring case.
pub(super) fn nearest<'a>(word: &str, names: &[&'a str]) -> Option<&'a str> {
    if word.len() > MAX_COMPARED_BYTES {
        return None;
    }
    let word = word.to_ascii_lowercase();
    let limit = (word.chars().count() / 3).max(1);
    names
        .iter()
        .take(MAX_COMPARED_NAMES)
        .filter(|name| name.len() <= MAX_COMPARED_BYTES)
        .map(|name| (strsim::osa_distance(&word, &name.to_ascii_lowercase()), *name))
        .filter(|&(distance, _)| distance <= limit)
        .min()
        .map(|(_, name)| name)
}

pub(super) fn did_you_mean(name: &str) -> String {
    format!("did you mean `{name}`?")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_prints_one_line_for_each_problem_in_the_order_of_the_file() {
        let problem = |place, key: &str, value: Option<&str>, hint: Option<&str>| Problem {
            place,
            key: key.to_owned(),
            value: value.map(str::to_owned),
            allowed: "must be right".to_owned(),
            hint: hint.map(str::to_owned),
        };
        let error = ConfigError::new(
            "a.yaml",
            vec![None, Some("b.yaml".into())],
            vec![
                problem(Place::Parameter { source: 1, line: 3 }, "e", None, None),
                problem(Place::Parameter { source: 1, line: 0 }, "", None, None),
                problem(Place::Parameter { source: 0, line: 1 }, "d", Some("1"), None),
                problem(Place::Line(7), "b.c", Some("5"), Some("did you mean `6`?")),
                problem(Place::Line(2), "a", None, None),
                problem(Place::File, "", None, None),
                problem(Place::Environment, "ROS_DOMAIN_ID", Some("x"), None),
            ],
        );
        assert_eq!(
            error.to_string(),
            "environment: ROS_DOMAIN_ID = x: must be right\n\
             a.yaml: must be right\n\
             a.yaml:2: a: must be right\n\
             a.yaml:7: b.c = 5: must be right (did you mean `6`?)\n\
             parameter: d = 1: must be right\n\
             b.yaml: must be right\n\
             b.yaml:3: e: must be right"
        );
    }

    #[test]
    fn the_nearest_name_is_similar() {
        assert_eq!(nearest("reliabilty", &["reliability", "durability"]), Some("reliability"));
        assert_eq!(nearest("RELIABEL", &["RELIABLE", "BEST_EFFORT"]), Some("RELIABLE"));
        assert_eq!(nearest("colour", &["depth", "history"]), None);
        // One letter of a short word may differ, and a third of those of a longer one.
        assert_eq!(nearest("dpt", &["depth"]), None);
        assert_eq!(nearest("dept", &["depth"]), Some("depth"));
        assert_eq!(nearest("xxrability", &["durability"]), Some("durability"));
        assert_eq!(nearest("xxxxbility", &["durability"]), None);
        let longest = "a".repeat(MAX_COMPARED_BYTES);
        assert_eq!(nearest(&longest, &["a", &longest]), Some(longest.as_str()));
        assert_eq!(nearest(&"a".repeat(100_000), &["a"]), None);
    }

    #[test]
    fn shown_text_is_short_and_cannot_control_a_terminal() {
        assert_eq!(shown("\u{1b}[31mred\n"), "\\u{1b}[31mred\\n");
        assert_eq!(shown(&"x".repeat(1000)).chars().count(), SHOWN_CHARS + 1);
    }
}
