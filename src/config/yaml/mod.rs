//! Parses YAML into a tree of nodes with their lines. Only this module depends on YAML libraries.
//!
//! The size, the depth and the number of nodes are limited, with aliases counted as if they were written out,
//! so that no file can make the loader hang or exhaust the memory.
//!
//! A file is read twice. A parser that reports positions finds the line and kind of each value
//! ([`outline`]); then serde_yaml, which supports neither lines nor the original text of numbers unless it is
//! asked for text, reads the content ([`NodeSeed`]). The second pass depends on behaviour of this version of
//! the library that serde does not guarantee, so `Cargo.toml` requires that exact version: a seed that fails
//! before it has read a key leaves the key to the next seed.

mod outline;

use std::cell::Cell;
use std::collections::HashSet;
use std::fmt;
use std::fs::File;
use std::io::Read;
use std::path::Path;
use std::rc::Rc;

use serde::de::{DeserializeSeed, Error as _, MapAccess, SeqAccess, Visitor};
use serde::{Deserialize, Deserializer};
use serde_yaml::DeserializerOptions;

use outline::{Kind, Shape, line_after, not_yaml, outline};

/// The largest configuration file, in bytes. The default one has 6 KiB.
pub(super) const MAX_BYTES: usize = 1 << 20;

/// The most keys and values in a file, including each use of an alias: 1,024 routes of 30 keys each.
const MAX_NODES: usize = 65_536;

/// The deepest nesting. The deepest key, `lanes.<lane>.scheduling.cpus[]`, is 5 deep.
const MAX_DEPTH: usize = 32;

/// The most bytes of text in a file, including each use of an alias. Escapes make text longer than in the
/// file, by at most a half: the two bytes `\L` become three.
const MAX_TEXT_BYTES: usize = 2 * MAX_BYTES;

/// The most bytes to read if each alias referred to the whole file: the library reads a value again for each
/// alias of it, which takes 2 ms for a number of a megabyte. A file of 200 KiB, enough for 1,024 routes, may
/// have 2,621 aliases.
const MAX_ALIASED_BYTES: usize = 1 << 29;

#[derive(Clone, Debug)]
pub(super) struct Node {
    /// The line, counted from 1, of the key of this value, or of this item of a list; or a parameter, see
    /// `Place::of`.
    pub line: usize,
    pub content: Content,
}

/// The content of a value. Values that a merge key repeats are shared.
#[derive(Clone, Debug)]
pub(super) enum Content {
    /// A text, number, boolean or null; the reader of the field interprets it.
    Scalar {
        /// The original text, with escapes resolved.
        text: String,
        /// Whether it may be a number, boolean or null: `10` may, `"10"` may not.
        plain: bool,
    },
    List(Vec<Rc<Node>>),
    /// A mapping, in the order of the file, with duplicates.
    Map(Vec<Entry>),
}

#[derive(Clone, Debug)]
pub(super) struct Entry {
    pub key: String,
    pub line: usize,
    pub value: Rc<Node>,
}

impl Node {
    pub fn null() -> Self {
        Self { line: 1, content: Content::Scalar { text: String::new(), plain: true } }
    }

    /// Whether this is null: an empty value, `~` or `null`.
    pub fn is_null(&self) -> bool {
        match &self.content {
            Content::Scalar { text, plain: true } => {
                matches!(text.as_str(), "" | "~" | "null" | "Null" | "NULL")
            }
            _ => false,
        }
    }
}

/// The error for a text that is not valid YAML or exceeds a limit.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct SyntaxError {
    /// The line, counted from 1; `None` for the file as a whole.
    pub line: Option<usize>,
    /// What is wrong, as a phrase.
    pub message: String,
}

impl SyntaxError {
    fn at(line: usize, message: impl Into<String>) -> Self {
        Self { line: Some(line), message: message.into() }
    }

    fn of_file(message: impl Into<String>) -> Self {
        Self { line: None, message: message.into() }
    }
}

/// Reads a regular file. A pipe or a device is refused, because it may never end.
pub(super) fn read(path: &Path) -> Result<Vec<u8>, String> {
    let cannot = |error: std::io::Error| format!("cannot be read: {error}");
    let metadata = std::fs::metadata(path).map_err(cannot)?;
    if !metadata.is_file() {
        return Err("must be a regular file".to_owned());
    }
    let mut bytes = Vec::new();
    // One byte more than allowed distinguishes a file that is too long from one of the largest size.
    let limit = MAX_BYTES as u64 + 1;
    File::open(path).and_then(|file| file.take(limit).read_to_end(&mut bytes)).map_err(cannot)?;
    Ok(bytes)
}

/// Parses the only document of a file; `None` for a file without a document.
pub(super) fn parse(bytes: &[u8]) -> Result<Option<Rc<Node>>, SyntaxError> {
    if bytes.len() > MAX_BYTES {
        return Err(SyntaxError::of_file(format!("must be at most {MAX_BYTES} bytes long")));
    }
    let text = std::str::from_utf8(bytes).map_err(|error| {
        let line = 1 + bytes[..error.valid_up_to()].iter().filter(|&&byte| byte == b'\n').count();
        SyntaxError::at(line, "must be text in UTF-8")
    })?;
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);

    let shapes = outline(text)?;
    if shapes.is_empty() {
        return Ok(None);
    }
    let seed = NodeSeed { shapes: &shapes, next: &Cell::new(0) };
    let root = seed.deserialize(deserializer(text)).map_err(|error| explain(&error, text))?;
    Ok(Some(Rc::new(root)))
}

/// A deserializer without limits of its own except that of recursion; [`outline`] has checked the others.
fn deserializer(text: &str) -> serde_yaml::Deserializer<'_> {
    let options = DeserializerOptions {
        recursion_limit: MAX_DEPTH as u8 + 1,
        alias_limit: usize::MAX,
        budget: None,
        ..DeserializerOptions::default()
    };
    serde_yaml::Deserializer::from_str_with_options(text, &options)
}

fn max_aliases(text: &str) -> usize {
    MAX_ALIASED_BYTES / text.len().max(1)
}

/// Converts an error of the library about a text that the first parser accepts: the library reads YAML 1.1,
/// the first parser YAML 1.2.
fn explain(error: &serde_yaml::Error, text: &str) -> SyntaxError {
    let line = error.location().map(|location| line_after(text, location.index()));
    if error.is_message() {
        let differently =
            "YAML 1.1 and YAML 1.2 read this differently; put text in quotes, and indent by spaces";
        return SyntaxError { line, message: not_yaml(differently) };
    }
    let error = error.to_string();
    if error.contains("more than one document") {
        return SyntaxError::of_file("must be one YAML document");
    }
    let end = [" at line ", " at position "].iter().filter_map(|at| error.find(at)).min();
    SyntaxError { line, message: not_yaml(&error[..end.unwrap_or(error.len())]) }
}

/// The second pass: reads one value, whose kind is known, into a [`Node`].
#[derive(Clone, Copy)]
struct NodeSeed<'r> {
    shapes: &'r [Shape],
    /// The index of the next value in `shapes`.
    next: &'r Cell<usize>,
}

impl<'de> DeserializeSeed<'de> for NodeSeed<'_> {
    type Value = Node;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Node, D::Error> {
        let Some(&Shape { line, kind }) = self.shapes.get(self.next.get()) else {
            return Err(D::Error::custom("more values than in the first pass"));
        };
        self.next.set(self.next.get() + 1);
        let content = match kind {
            Kind::Scalar { plain } => Content::Scalar { text: String::deserialize(deserializer)?, plain },
            Kind::List => deserializer.deserialize_seq(self)?,
            Kind::Map => deserializer.deserialize_map(self)?,
        };
        Ok(Node { line, content })
    }
}

impl<'de> Visitor<'de> for NodeSeed<'_> {
    type Value = Content;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the value of the first pass")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<Content, A::Error> {
        let mut list = Vec::new();
        while let Some(item) = items.next_element_seed(self)? {
            list.push(Rc::new(item));
        }
        Ok(Content::List(list))
    }

    fn visit_map<A: MapAccess<'de>>(self, mut pairs: A) -> Result<Content, A::Error> {
        let mut entries = Vec::new();
        // Read as a key, a repeated key would be an error of the library, which would hide later problems.
        while !matches!(pairs.next_key_seed(Unread), Ok(None)) {
            let key = pairs.next_value_seed(self)?;
            let Content::Scalar { text, .. } = key.content else {
                return Err(A::Error::custom("another key than in the first pass"));
            };
            let value = Rc::new(pairs.next_value_seed(self)?);
            entries.push(Entry { key: text, line: key.line, value });
        }
        Ok(Content::Map(merged(entries)))
    }
}

/// A seed that fails before it reads the key: it shows whether a key follows, which the next seed reads.
struct Unread;

impl<'de> DeserializeSeed<'de> for Unread {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, _: D) -> Result<(), D::Error> {
        Err(D::Error::custom("left to the next seed"))
    }
}

/// Replaces each merge key (`<<: *alias`) by the entries of the mapping that it names, except keys that the
/// mapping itself has. A `<<` with a value other than mappings stays, and is reported as an unknown key.
fn merged(entries: Vec<Entry>) -> Vec<Entry> {
    let (merges, mut entries): (Vec<Entry>, Vec<Entry>) =
        entries.into_iter().partition(|entry| entry.key == "<<");
    for merge in merges {
        let sources = match &merge.value.content {
            Content::List(items) => items.as_slice(),
            _ => std::slice::from_ref(&merge.value),
        };
        let maps = sources.iter().map(|source| match &source.content {
            Content::Map(entries) => Some(entries),
            _ => None,
        });
        let Some(maps) = maps.collect::<Option<Vec<_>>>() else {
            entries.push(merge);
            continue;
        };
        let mut known: HashSet<String> = entries.iter().map(|entry| entry.key.clone()).collect();
        for inherited in maps.into_iter().flatten() {
            if known.insert(inherited.key.clone()) {
                entries.push(inherited.clone());
            }
        }
    }
    entries
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The line and the message of the error of a text; `None` for a text that is accepted.
    fn error(text: &str) -> Option<(usize, String)> {
        parse(text.as_bytes()).err().map(|error| (error.line.unwrap(), error.message))
    }

    /// The keys of a mapping, each with its text or the number of its items.
    fn entries(node: &Node) -> Vec<String> {
        let Content::Map(entries) = &node.content else { panic!("{node:?}") };
        let shown = |entry: &Entry| match &entry.value.content {
            Content::Scalar { text, .. } => format!("{}: {text}", entry.key),
            Content::List(items) => format!("{}: {} items", entry.key, items.len()),
            Content::Map(_) => format!("{}: a mapping", entry.key),
        };
        entries.iter().map(shown).collect()
    }

    #[test]
    fn lines_end_with_either_or_both_of_cr_and_lf() {
        for (text, line) in
            [("", 1), ("a", 1), ("a\nb", 2), ("a\rb", 2), ("a\r\nb", 2), ("a\r\n\r\nb\n\nc", 5)]
        {
            assert_eq!(line_after(text, usize::MAX), line, "{text:?}");
        }
        assert_eq!(line_after("a\nb\nc", 3), 2);
    }

    #[test]
    fn a_list_of_merged_mappings_gives_each_key_the_first_value() {
        let text = "one: &one {a: 1, b: 1}\ntwo: &two {b: 2, c: 2}\nthree: {<<: [*one, *two], a: 3}\n\
                    four: {<<: [*one, 5]}\n";
        let root = parse(text.as_bytes()).unwrap().unwrap();
        let Content::Map(sections) = &root.content else { panic!("{root:?}") };
        assert_eq!(entries(&sections[2].value), ["a: 3", "b: 1", "c: 2"]);
        assert_eq!(entries(&sections[3].value), ["<<: 2 items"]);
    }

    #[test]
    fn a_value_may_have_the_core_tag_of_its_kind_and_no_other() {
        for text in
            ["!!bool true", "!!bool FALSE", "!!int -7", "!!float 2.5", "!!str 7", "!!map {b: c}", "!!seq [b]"]
        {
            assert_eq!(error(&format!("a: {text}\n")), None, "{text}");
        }
        for text in ["!!bool yes", "!!int 2.5", "!!float x", "!!null x", "!!seq {b: c}", "!!map [b]", "!b c"]
        {
            let refused = Some((1, "must not use YAML tags (`!name`)".to_owned()));
            assert_eq!(error(&format!("a: {text}\n")), refused, "{text}");
        }
    }

    #[test]
    fn an_error_of_the_parser_is_repeated_in_words() {
        let (line, message) = error("a: {").unwrap();
        assert!(line == 1 && message.len() > "not YAML: ".len() + 5, "{message}");
    }

    #[test]
    fn as_many_keys_and_values_as_the_limit_are_read_and_not_more() {
        // The list is a value, too.
        assert_eq!(error(&"- a\n".repeat(MAX_NODES - 1)), None);
        let many = "must have at most 65536 keys and values, including those of aliases".to_owned();
        assert_eq!(error(&"- a\n".repeat(MAX_NODES)), Some((MAX_NODES, many)));
    }

    #[test]
    fn values_may_be_nested_as_deep_as_the_limit_and_not_deeper() {
        let lists = |depth: usize| format!("{}x\n", "- ".repeat(depth));
        assert_eq!(error(&lists(MAX_DEPTH)), None);
        let deep = "must be nested at most 32 deep".to_owned();
        assert_eq!(error(&lists(MAX_DEPTH + 1)), Some((1, deep.clone())));
        // An alias of three nested lists, within 29 more lists, one of which is the whole file.
        let aliased = |depth: usize| {
            let (open, close) = ("[".repeat(depth - 1), "]".repeat(depth - 1));
            format!("- &a [[[x]]]\n- {open}*a{close}\n")
        };
        assert_eq!(error(&aliased(29)), None);
        assert_eq!(error(&aliased(30)), Some((2, deep)));
    }

    #[test]
    fn as_many_aliases_as_the_size_of_the_file_allows_are_read_and_not_more() {
        // Of a value, and of one that contains an alias: 110 + 1 + 2 × 201.
        let mut text = format!("- &a x\n{}- &b [*a]\n{}", "- *a\n".repeat(110), "- *b\n".repeat(201));
        let comment = MAX_ALIASED_BYTES / 513 - 100 - text.len();
        text = format!("# {}\n{text}", "x".repeat(comment));
        assert_eq!(max_aliases(&text), 513);
        assert_eq!(error(&text), None);
        let many = "must use at most 513 aliases in a file of this size".to_owned();
        assert_eq!(error(&format!("{text}- *a\n")), Some((315, many)));
    }

    #[test]
    fn as_much_text_as_the_limit_is_read_and_not_more() {
        // Half of the kibibytes by a text and its aliases, the other half by aliases of a list that has it.
        let kibibytes = MAX_TEXT_BYTES / 1_024 / 2;
        let (own, listed) = ("- *a\n".repeat(kibibytes - 1), "- *b\n".repeat(kibibytes - 1));
        let text = format!("- &a {}\n{own}- &b [*a]\n{listed}", "x".repeat(1_024));
        assert_eq!(error(&text), None);
        let much = "must have at most 2097152 bytes of text, including that of aliases".to_owned();
        assert_eq!(error(&format!("{text}- y\n")), Some((2 * kibibytes + 1, much)));
    }
}
