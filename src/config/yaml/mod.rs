//! Parses YAML into a tree of nodes with their lines. Only this module depends on the YAML library.
//!
//! The size, the depth and the number of nodes are limited, with aliases counted as if they were written out,
//! so that no file can make the loader hang or exhaust the memory.
//!
//! The library reads through serde, which supports neither lines nor the original text of numbers. The file
//! is therefore read twice: a first pass finds the line and kind of each value ([`Survey`]), and a second
//! pass uses these to read the text of each scalar ([`NodeSeed`]). Both depend on behaviour of this version
//! of the library that serde does not guarantee, so `Cargo.toml` requires that exact version: a seed that
//! fails before it has read a value leaves the value to the next seed.

mod survey;

use std::cell::{Cell, RefCell};
use std::collections::HashSet;
use std::fmt;
use std::rc::Rc;

use serde::Deserializer;
use serde::de::{DeserializeSeed, Error as _, MapAccess, SeqAccess, Visitor};
use serde_yaml::DeserializerOptions;
use serde_yaml::budget::Budget;

use survey::{Kind, Outline, Position, SECOND_DOCUMENT, Shape, Survey};

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

/// One value of the file.
#[derive(Debug)]
pub(super) struct Node {
    /// The line, counted from 1, of the key of this value, or of this item of a list.
    pub line: usize,
    /// The value.
    pub content: Content,
}

/// The content of a value. Values that a merge key repeats are shared.
#[derive(Debug)]
pub(super) enum Content {
    /// A text, number, boolean or null; the reader of the field interprets it.
    Scalar {
        /// The original text, with escapes resolved.
        text: String,
        /// Whether it may be a number, boolean or null: `10` may, `"10"` may not.
        plain: bool,
    },
    /// A sequence.
    List(Vec<Rc<Node>>),
    /// A mapping, in the order of the file, with duplicates.
    Map(Vec<Entry>),
}

/// One key of a mapping.
#[derive(Clone, Debug)]
pub(super) struct Entry {
    /// The key.
    pub key: String,
    /// The line of the key.
    pub line: usize,
    /// Its value.
    pub value: Rc<Node>,
}

impl Node {
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

    let outline = RefCell::new(Outline::new(text));
    let surveyed =
        Survey { outline: &outline, line: 1, latest_line: 1, is_key: false }.deserialize(deserializer(text));
    let outline = outline.into_inner();
    surveyed.map_err(|error| outline.stop.clone().unwrap_or_else(|| outline.explain(&error)))?;
    if let Some(line) = line_after_end(text) {
        // The library does not read it.
        return Err(SyntaxError::at(line, SECOND_DOCUMENT));
    }
    if outline.shapes.is_empty() {
        return Ok(None);
    }

    let (next, text_bytes) = (Cell::new(0), Cell::new(0));
    let seed = NodeSeed { source: text, shapes: &outline.shapes, next: &next, text_bytes: &text_bytes };
    let mut root = seed.deserialize(deserializer(text)).map_err(|error| {
        if text_bytes.get() <= MAX_TEXT_BYTES {
            return outline.explain(&error);
        }
        let line = outline.shapes.get(next.get().saturating_sub(1)).map(|shape| shape.line);
        let message = format!("must have at most {MAX_TEXT_BYTES} bytes of text, including that of aliases");
        SyntaxError { line, message }
    })?;
    if !matches!(root.content, Content::Map(_)) {
        // The caller reports it, and only the root's line is not known yet.
        let found =
            Position::default().deserialize(deserializer(text)).err().and_then(|error| error.location());
        root.line = found.map_or(1, |location| outline.line_in_editor(location.line()));
    }
    Ok(Some(Rc::new(root)))
}

fn deserializer(text: &str) -> serde_yaml::Deserializer<'_> {
    let options = DeserializerOptions {
        recursion_limit: MAX_DEPTH as u8 + 1,
        alias_limit: max_aliases(text),
        budget: Some(budget()),
        ..DeserializerOptions::default()
    };
    serde_yaml::Deserializer::from_str_with_options(text, &options)
}

/// The line of the first content after the end marker of the document.
fn line_after_end(text: &str) -> Option<usize> {
    let is_end = |line: &str| {
        line.strip_prefix("...").is_some_and(|rest| rest.is_empty() || rest.starts_with(char::is_whitespace))
    };
    let is_content =
        |line: &str| !is_end(line) && !matches!(line.trim_start().chars().next(), None | Some('#'));
    let mut lines = text.lines().zip(1..).skip_while(|(line, _)| !is_end(line));
    lines.find(|(line, _)| is_content(line)).map(|(_, number)| number)
}

fn max_aliases(text: &str) -> usize {
    MAX_ALIASED_BYTES / text.len().max(1)
}

/// The limits that the library checks before it parses: its parser takes quadratic time for deep nesting.
fn budget() -> Budget {
    Budget {
        max_events: usize::MAX,
        max_aliases: MAX_NODES,
        max_anchors: MAX_NODES,
        max_depth: MAX_DEPTH,
        max_documents: 1,
        max_nodes: MAX_NODES,
        max_total_scalar_bytes: MAX_TEXT_BYTES,
        enforce_alias_anchor_ratio: false,
        ..Budget::default()
    }
}

fn too_many() -> String {
    format!("must have at most {MAX_NODES} keys and values, including those of aliases")
}

fn too_deep() -> String {
    format!("must be nested at most {MAX_DEPTH} deep")
}

/// The second pass: reads one value, whose kind is known, into a [`Node`].
#[derive(Clone, Copy)]
struct NodeSeed<'r> {
    source: &'r str,
    shapes: &'r [Shape],
    /// The index of the next value in `shapes`.
    next: &'r Cell<usize>,
    text_bytes: &'r Cell<usize>,
}

impl<'de> DeserializeSeed<'de> for NodeSeed<'_> {
    type Value = Node;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<Node, D::Error> {
        let Some(&Shape { line, kind }) = self.shapes.get(self.next.get()) else {
            return Err(D::Error::custom("more values than before"));
        };
        self.next.set(self.next.get() + 1);
        let content = match kind {
            Kind::Scalar { typed } => {
                let Scalar { text, may_be_plain } =
                    deserializer.deserialize_str(ScalarVisitor(self.source))?;
                self.text_bytes.set(self.text_bytes.get() + text.len());
                if self.text_bytes.get() > MAX_TEXT_BYTES {
                    return Err(D::Error::custom("too much text"));
                }
                let plain = typed || may_be_plain && !has_type(&text);
                Content::Scalar { text, plain }
            }
            Kind::List => deserializer.deserialize_seq(self)?,
            Kind::Map => deserializer.deserialize_map(self)?,
        };
        Ok(Node { line, content })
    }
}

impl<'de> Visitor<'de> for NodeSeed<'_> {
    type Value = Content;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("the same value as before")
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
        while !matches!(pairs.next_key_seed(Position::default()), Ok(None)) {
            let key = pairs.next_value_seed(self)?;
            let Content::Scalar { text, .. } = key.content else {
                return Err(A::Error::custom("another key than before"));
            };
            let value = Rc::new(pairs.next_value_seed(self)?);
            entries.push(Entry { key: text, line: key.line, value });
        }
        Ok(Content::Map(merged(entries)))
    }
}

struct Scalar {
    text: String,
    may_be_plain: bool,
}

/// Reads a scalar of the source as text.
struct ScalarVisitor<'s>(&'s str);

impl<'de> Visitor<'de> for ScalarVisitor<'_> {
    type Value = Scalar;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("text")
    }

    /// A slice of the source; in quotes if a quote precedes it.
    fn visit_borrowed_str<E: serde::de::Error>(self, text: &'de str) -> Result<Scalar, E> {
        let offset = text.as_ptr().addr().wrapping_sub(self.0.as_ptr().addr());
        let before = self.0.as_bytes().get(offset.wrapping_sub(1));
        let may_be_plain = !matches!(before, Some(b'\'' | b'"'));
        Ok(Scalar { text: text.to_owned(), may_be_plain })
    }

    /// No slice of the source: a block, or text with escapes or line breaks.
    fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<Scalar, E> {
        Ok(Scalar { text: text.to_owned(), may_be_plain: false })
    }
}

/// Whether plain text is a number, boolean or null. If the library did not treat it as such, it has a `!!str`
/// tag.
fn has_type(text: &str) -> bool {
    let is_number = || serde_yaml::parse_f64(text).is_some() && !serde_yaml::digits_but_not_number(text);
    matches!(text, "" | "~" | "null" | "Null" | "NULL")
        || text.eq_ignore_ascii_case("true")
        || text.eq_ignore_ascii_case("false")
        || is_number()
}

/// Replaces each merge key (`<<: *alias`) by the entries of the mapping that it names, except keys that the
/// mapping itself has. A `<<` with a value other than mappings stays, and is reported as an unknown key.
fn merged(entries: Vec<Entry>) -> Vec<Entry> {
    if !entries.iter().any(|entry| entry.key == "<<") {
        return entries;
    }
    let (merges, mut entries): (Vec<Entry>, Vec<Entry>) =
        entries.into_iter().partition(|entry| entry.key == "<<");
    for merge in merges {
        let sources: Vec<&Node> = match &merge.value.content {
            Content::List(items) => items.iter().map(Rc::as_ref).collect(),
            _ => vec![&*merge.value],
        };
        let maps: Vec<&[Entry]> = sources
            .iter()
            .filter_map(|source| match &source.content {
                Content::Map(entries) => Some(entries.as_slice()),
                _ => None,
            })
            .collect();
        if maps.len() < sources.len() {
            entries.push(merge);
            continue;
        }
        let mut known: HashSet<String> = entries.iter().map(|entry| entry.key.clone()).collect();
        for inherited in maps.into_iter().flatten() {
            if known.insert(inherited.key.clone()) {
                entries.push(inherited.clone());
            }
        }
    }
    entries
}
