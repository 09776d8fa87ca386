//! Puts values into the tree of the configuration file, by the names of ROS 2 parameters. The name of a
//! parameter is the key path, but for topics, which are a list in the file: it has their ids, as in
//! `topics.scan.priority`.

use std::rc::Rc;

use super::keys::{self, joined};
use super::problem::{Place, Problem, Problems};
use super::shown::Value;
use super::yaml::{Content, Entry, Node};

/// The most names in the name of a parameter. A longer one is no key.
const MAX_NAMES: usize = 8;

const TOPICS: &str = "topics";

/// The section for the output topic of any lane, and the short keys that the two built-in lanes have beside
/// it. A topic must have only one of both.
const OUTPUTS: [(&str, &str); 2] =
    [("outputs.critical", "critical_output"), ("outputs.noncritical", "noncritical_output")];

/// Puts a value into the tree, in place of what is there.
pub(super) fn put(root: &mut Node, name: &str, value: Node, problems: &Problems) {
    let tree = tree(name, value);
    // Before the merge, which keeps only the last one of repeated keys, so that they are reported.
    keys::check(&tree, problems);
    let Content::Map(entries) = &tree.content else { return };
    match entries.as_slice() {
        [Entry { key, value, .. }] if key == TOPICS && matches!(value.content, Content::Map(_)) => {
            leaves("", value, &mut |name, value| put_into_topic(root, name, value, problems));
        }
        _ => merge(root, tree, "", problems),
    }
}

/// Puts a value at `ID.KEY` of the list of topics.
fn put_into_topic(root: &mut Node, name: &str, value: Node, problems: &Problems) {
    let mut none = Vec::new();
    let topics = match &mut root.content {
        Content::Map(entries) => entries.iter_mut().find(|entry| entry.key == TOPICS),
        _ => None,
    };
    let items = match topics.map(|entry| &mut Rc::make_mut(&mut entry.value).content) {
        Some(Content::List(items)) => items,
        _ => &mut none,
    };
    let ids: Vec<&str> = items.iter().map(|item| id_of(item).unwrap_or_default()).collect();
    // An id may have dots, so that one can be the beginning of another.
    let key_after = |id: &&str| name.strip_prefix(id)?.strip_prefix('.');
    let found = ids.iter().enumerate().filter(|(_, id)| !id.is_empty() && key_after(id).is_some());
    let Some((index, key)) =
        found.max_by_key(|(_, id)| id.len()).and_then(|(index, id)| Some((index, key_after(id)?)))
    else {
        let first = name.split('.').next().unwrap_or_default();
        let allowed = "must begin with `topics.` and the id of a topic in the configuration file".to_owned();
        let problem = Problem::new(Place::of(value.line), &joined(TOPICS, name), allowed);
        problems.report(Problem { hint: problems.hint(first, &ids), ..problem });
        return;
    };
    let item = Rc::make_mut(&mut items[index]);
    if let Content::Map(entries) = &mut item.content
        && let Some((_, short)) = OUTPUTS.iter().find(|(output, _)| *output == key)
    {
        entries.retain(|entry| entry.key != *short);
    }
    merge(item, nested(key.rsplitn(MAX_NAMES, '.'), value), &format!("{TOPICS}[{index}]"), problems);
}

fn id_of(topic: &Node) -> Option<&str> {
    let Content::Map(entries) = &topic.content else { return None };
    match &entries.iter().find(|entry| entry.key == "id")?.value.content {
        Content::Scalar { text, .. } => Some(text),
        _ => None,
    }
}

/// Calls `found` with the name and the value of everything below a value that is no mapping.
pub(super) fn leaves(name: &str, value: &Node, found: &mut dyn FnMut(&str, Node)) {
    let Content::Map(entries) = &value.content else { return found(name, value.clone()) };
    for Entry { key, line, value } in entries {
        leaves(&joined(name, key), &Node { line: *line, ..Node::clone(value) }, found);
    }
}

/// The tree that has only this value, at the key path of this name.
fn tree(name: &str, value: Node) -> Node {
    // The id of a subscriber may have dots.
    match name.split_once('.') {
        Some(("overrides", id)) => nested([id, "overrides"], value),
        Some(("subscribers", id)) => match id.strip_suffix(".lane") {
            Some(id) => nested(["lane", id, "subscribers"], value),
            None => nested([id, "subscribers"], value),
        },
        _ => nested(name.rsplitn(MAX_NAMES, '.'), value),
    }
}

/// The tree that has only this value, at these names, of which the first is the deepest.
fn nested<'n>(names: impl IntoIterator<Item = &'n str>, value: Node) -> Node {
    names.into_iter().fold(value, |value, name| {
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
        (_, Content::Map(_)) if !is_null => {
            let allowed = "must be set as a whole: in the configuration file it is no mapping".to_owned();
            problems.report(Problem::new(Place::of(from.line), path, allowed));
        }
        (own, new) => {
            *own = new;
            into.line = from.line;
        }
    }
}

/// Whether a value of the tree is this value.
pub(super) fn is_equal(value: &Value, node: &Node) -> bool {
    let number = |text: &str| text.parse::<f64>().ok();
    match (value, &node.content) {
        (Value::None, _) => node.is_null(),
        (Value::List(values), Content::List(items)) => {
            values.len() == items.len() && values.iter().zip(items).all(|(value, item)| is_equal(value, item))
        }
        (Value::Flag(flag), Content::Scalar { text, .. }) => *text == flag.to_string(),
        (Value::Whole(whole), Content::Scalar { text, .. }) => number(text) == Some(*whole as f64),
        (Value::Decimal(decimal), Content::Scalar { text, .. }) => number(text) == Some(*decimal),
        (Value::Text(own), Content::Scalar { text, .. }) => own == text,
        _ => false,
    }
}
