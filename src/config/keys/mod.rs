//! The configuration keys: one [`Row`] declares each, and everything else about the keys comes from these
//! rows. This module finds the row of a path, and unknown and repeated keys.

mod control;
mod routes;
mod row;

use std::collections::HashMap;
use std::sync::LazyLock;

pub use row::{Kind, Row};

use super::problem::{Place, Problem, Problems, did_you_mean, nearest, shown};
use super::yaml::{Content, Entry, Node};

/// The rows of all keys, in the order of `config/README.md`.
pub fn rows() -> impl Iterator<Item = &'static Row> {
    routes::ROWS.iter().chain(control::ROWS)
}

/// The path of every key. `[]` is an item of a list; a name in angle brackets is a name that the user
/// chooses.
pub static KEYS: LazyLock<Vec<&str>> =
    LazyLock::new(|| rows().flat_map(|row| row.paths.iter().copied()).collect());

/// The keys at and below a path, each with its row; empty for an unknown path. The path may have items of
/// lists and names that the user chose, such as `topics[0].id` and `lanes.rviz.queue_depth`.
pub fn keys_at(path: &str) -> Vec<(String, &'static Row)> {
    let mut key = Key::root();
    let mut found_path = String::new();
    for name in path.split('.') {
        let name = name.split('[').next().unwrap_or_default();
        let Some((known, below)) = key.entry(name).filter(|_| !name.is_empty()) else { return Vec::new() };
        found_path = joined(&found_path, known);
        key = below;
        if let Some(item) = key.item() {
            found_path.push_str("[]");
            key = item;
        }
    }
    let mut found = Vec::new();
    key.list(found_path, &mut found);
    found
}

/// The row of the key at this path, which may have items of lists and names that the user chose; `None` for
/// an unknown path and for a section.
pub(super) fn row_at(path: &str) -> Option<&'static Row> {
    let mut key = Key::root();
    let mut rest = path;
    while !rest.is_empty() {
        let end = rest.find(['.', '[']).unwrap_or(rest.len());
        key = key.get(&rest[..end])?;
        rest = &rest[end..];
        // The name of an item may have dots.
        if let Some(item) = rest.strip_prefix('[') {
            key = key.item()?;
            rest = item.split_once(']')?.1;
        }
        rest = rest.strip_prefix('.').unwrap_or(rest);
    }
    key.row
}

/// The known path that is most similar to an unknown one.
pub fn nearest_key(path: &str) -> Option<&'static str> {
    nearest(path, &KEYS)
}

static TREE: LazyLock<Key> = LazyLock::new(|| {
    let mut root = Key::default();
    for row in rows() {
        for path in row.paths {
            let mut key = &mut root;
            for name in path.split('.') {
                let list = name.strip_suffix("[]");
                key = key.insert(list.unwrap_or(name));
                if list.is_some() {
                    key = key.insert("[]");
                }
            }
            key.row = Some(row);
        }
    }
    root
});

/// A known key, or the beginning of one.
#[derive(Debug, Default)]
pub(super) struct Key {
    /// `None` for a section or a list of sections.
    pub row: Option<&'static Row>,
    below: Vec<(&'static str, Key)>,
}

impl Key {
    pub fn root() -> &'static Self {
        &TREE
    }

    /// The key of this name below this one: the declared one, else a placeholder such as `<lane>`.
    pub fn get(&self, name: &str) -> Option<&Self> {
        self.entry(name).map(|(_, key)| key)
    }

    /// Like `get`, and also returns the declared name.
    fn entry(&self, name: &str) -> Option<&(&'static str, Self)> {
        let named = |own: &&(&str, Self)| own.0 == name;
        let placeholder = |own: &&(&str, Self)| own.0.starts_with('<');
        self.below.iter().find(named).or_else(|| self.below.iter().find(placeholder))
    }

    /// Adds this key and all below it to `found`.
    fn list(&self, path: String, found: &mut Vec<(String, &'static Row)>) {
        for (name, key) in &self.below {
            let below = if *name == "[]" { format!("{path}[]") } else { joined(&path, name) };
            key.list(below, found);
        }
        // A section that may also be a value comes after its keys.
        found.extend(self.row.map(|row| (path, row)));
    }

    pub fn item(&self) -> Option<&Self> {
        self.below.iter().find(|(name, _)| *name == "[]").map(|(_, key)| key)
    }

    fn names(&self) -> Vec<&'static str> {
        self.below.iter().map(|(name, _)| *name).filter(|name| *name != "[]").collect()
    }

    fn insert(&mut self, name: &'static str) -> &mut Self {
        let index = self.below.iter().position(|(own, _)| *own == name).unwrap_or_else(|| {
            self.below.push((name, Self::default()));
            self.below.len() - 1
        });
        &mut self.below[index].1
    }
}

/// Reports every unknown key and every repeated key of the file.
pub(super) fn check(root: &Node, problems: &Problems) {
    walk(root, Some(Key::root()), "", problems);
}

/// Checks a value and all below it. `key` is `None` below an unknown key.
fn walk(node: &Node, key: Option<&Key>, path: &str, problems: &Problems) {
    match &node.content {
        Content::Scalar { .. } => {}
        Content::List(items) => {
            let key = key.and_then(Key::item);
            for (index, item) in items.iter().enumerate() {
                walk(item, key, &format!("{path}[{index}]"), problems);
            }
        }
        Content::Map(entries) => {
            let known = key.map(Key::names).unwrap_or_default();
            let mut first_lines: HashMap<&str, usize> = HashMap::new();
            for entry in entries {
                let path = joined(path, &shown_key(path, &entry.key));
                if let Some(first_line) = first_lines.get(entry.key.as_str()) {
                    let first = Place::noun(*first_line);
                    let allowed = format!("must be given only once; {first} already has it");
                    problems.report(Problem::new(Place::of(entry.line), &path, allowed));
                }
                first_lines.entry(&entry.key).or_insert(entry.line);
                let below = key.and_then(|key| key.get(&entry.key));
                // A mapping at a key that has no keys below it is a value of the wrong type, which its reader
                // reports.
                if below.is_none() && !known.is_empty() {
                    problems.report(unknown(entry, &path, &known, problems));
                }
                walk(&entry.value, below, &path, problems);
            }
        }
    }
}

fn unknown(entry: &Entry, path: &str, known: &[&str], problems: &Problems) -> Problem {
    // Without a similar key here, a key that exists elsewhere is probably misplaced.
    let hint = problems.hint(&entry.key, known).or_else(|| {
        let elsewhere = KEYS.iter().find(|key| key.rsplit('.').next() == Some(&entry.key));
        elsewhere.map(|key| did_you_mean(key))
    });
    let allowed = match hint {
        Some(_) => "must be a known key".to_owned(),
        None => format!("must be a known key: {}", known.join(", ")),
    };
    Problem { place: Place::of(entry.line), key: path.to_owned(), value: None, allowed, hint }
}

/// A key for a message. `{hmac_secret:abc}`, without a space, is a key that contains the secret, so that a
/// key below `security` is cut at the first separator.
fn shown_key(path: &str, key: &str) -> String {
    let end = if path == "security" { key.find([':', '=', ' ']) } else { None };
    shown(&key[..end.unwrap_or(key.len())])
}

pub(super) fn joined(path: &str, name: &str) -> String {
    if path.is_empty() { name.to_owned() } else { format!("{path}.{name}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_keys_at_a_path_are_those_at_and_below_it_as_they_are_declared() {
        let paths_at =
            |path: &str| -> Vec<String> { keys_at(path).into_iter().map(|(key, _)| key).collect() };
        for (path, key) in [
            ("policy_hold_s", "policy_hold_s"),
            ("lanes.rviz.queue_depth", "lanes.<lane>.queue_depth"),
            ("topics[0].id", "topics[].id"),
            ("topics.id", "topics[].id"),
        ] {
            assert_eq!(paths_at(path), [key]);
        }
        let subscriber = "subscribers.<subscriber>";
        assert_eq!(paths_at("subscribers"), [format!("{subscriber}.lane"), subscriber.to_owned()]);
        for (section, start) in [("probes", "probes."), ("topics", "topics[].")] {
            let expected: Vec<_> = KEYS.iter().filter(|key| key.starts_with(start)).collect();
            let mut found = paths_at(section);
            assert_eq!(found.len(), expected.len(), "{found:?}");
            found.retain(|key| !expected.contains(&&key.as_str()));
            assert_eq!(found, [""; 0]);
        }
        for unknown in ["", "prob", "probes.", "probes.rate", "probes..rate_hz", "policy_hold_s.x"] {
            assert_eq!(paths_at(unknown), [""; 0], "{unknown}");
        }
        assert!(keys_at("probes").iter().all(|(path, row)| row.paths.contains(&path.as_str())));
    }

    #[test]
    fn the_nearest_key_is_one_with_a_similar_path() {
        assert_eq!(nearest_key("probes.rate_hs"), Some("probes.rate_hz"));
        assert_eq!(nearest_key("something.else.entirely"), None);
    }
}
