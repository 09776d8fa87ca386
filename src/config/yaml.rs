//! YAML text to a tree of nodes that know their line. The only module that knows which library parses YAML.
//!
//! The size, the depth and the number of nodes are bounded, aliases counted as if they were written out, so
//! that no file of any content can make the loader hang or exhaust the memory.

use std::borrow::Cow;
use std::collections::{HashMap, HashSet};
use std::rc::Rc;

use granit_parser::{Event, Parser, ScalarStyle, Tag};

/// The largest configuration file, in bytes. The default one has 6 KiB.
pub(super) const MAX_BYTES: usize = 1 << 20;

/// The most keys and values that a file may have, each use of an alias counted: 1,024 routes of 30 keys each.
const MAX_NODES: usize = 65_536;

/// The deepest nesting. The deepest key there is, `lanes.<lane>.scheduling.cpus[]`, is 5 deep.
const MAX_DEPTH: usize = 32;

/// One value of the file.
#[derive(Debug)]
pub(super) struct Node {
    /// Where it begins, counted from 1.
    pub line: usize,
    /// What it is.
    pub content: Content,
    /// Keys and values in it, itself and the expansion of its aliases included.
    size: usize,
}

/// What a value is. Values are shared where the file has aliases.
#[derive(Debug)]
pub(super) enum Content {
    /// Text, number, truth value or null: which of them is for its reader to say.
    Scalar {
        /// As written, escapes resolved.
        text: String,
        /// Neither quoted nor a block: `10` is, `"10"` is not.
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
    /// Whether this stands for "not given": an empty value, `~` or `null`.
    pub fn is_null(&self) -> bool {
        match &self.content {
            Content::Scalar { text, plain: true } => {
                matches!(text.as_str(), "" | "~" | "null" | "Null" | "NULL")
            }
            _ => false,
        }
    }
}

/// Why a text could not be read as YAML.
#[derive(Debug, PartialEq, Eq)]
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

/// Reads the one document of a file; `None` when there is none in it.
pub(super) fn parse(bytes: &[u8]) -> Result<Option<Rc<Node>>, SyntaxError> {
    if bytes.len() > MAX_BYTES {
        return Err(SyntaxError::of_file(format!("must be at most {MAX_BYTES} bytes long")));
    }
    let text = std::str::from_utf8(bytes).map_err(|error| {
        let line = 1 + bytes[..error.valid_up_to()].iter().filter(|&&byte| byte == b'\n').count();
        SyntaxError::at(line, "must be text in UTF-8")
    })?;
    let options = granit_parser::options! {
        flow_nesting_limit: MAX_DEPTH,
        block_nesting_limit: MAX_DEPTH,
    };
    let mut builder = Builder::default();
    for event in Parser::new_from_str_with_options(text, options) {
        let (event, span) = event
            .map_err(|error| SyntaxError::at(error.marker().line(), format!("not YAML: {}", error.info())))?;
        builder.take(event, span.start.line())?;
    }
    Ok(builder.document)
}

/// A collection that has begun and not ended.
struct Open {
    anchor: usize,
    line: usize,
    size: usize,
    collection: Collection,
}

enum Collection {
    List(Vec<Rc<Node>>),
    /// The entries, and the key that waits for its value.
    Map(Vec<Entry>, Option<(String, usize)>),
}

#[derive(Default)]
struct Builder {
    document: Option<Rc<Node>>,
    documents: usize,
    open: Vec<Open>,
    anchors: HashMap<usize, Rc<Node>>,
    nodes: usize,
}

impl Builder {
    fn take(&mut self, event: Event<'_>, line: usize) -> Result<(), SyntaxError> {
        match event {
            Event::DocumentStart(..) => {
                self.documents += 1;
                if self.documents > 1 {
                    return Err(SyntaxError::at(line, "must be one YAML document; a second one begins here"));
                }
            }
            Event::Scalar(text, style, anchor, tag) => {
                let forced_text = is_text_tag(tag, line)?;
                let plain = style == ScalarStyle::Plain && !forced_text;
                let content = Content::Scalar { text: text.into_owned(), plain };
                self.insert(Rc::new(Node { line, content, size: 1 }), anchor, line)?;
            }
            Event::SequenceStart(_, anchor, tag) => {
                is_text_tag(tag, line)?;
                self.begin(anchor, line, Collection::List(Vec::new()))?;
            }
            Event::MappingStart(_, anchor, tag) => {
                is_text_tag(tag, line)?;
                self.begin(anchor, line, Collection::Map(Vec::new(), None))?;
            }
            Event::SequenceEnd | Event::MappingEnd => self.end(line)?,
            Event::Alias(anchor) => {
                // An anchor is known once its value is complete: an alias inside it finds nothing.
                let node = self.anchors.get(&anchor).cloned();
                let node =
                    node.ok_or_else(|| SyntaxError::at(line, "this alias refers to what it is part of"))?;
                self.insert(node, 0, line)?;
            }
            _ => {}
        }
        Ok(())
    }

    fn begin(&mut self, anchor: usize, line: usize, collection: Collection) -> Result<(), SyntaxError> {
        if self.open.len() >= MAX_DEPTH {
            return Err(SyntaxError::at(line, format!("must be nested at most {MAX_DEPTH} deep")));
        }
        self.open.push(Open { anchor, line, size: 1, collection });
        Ok(())
    }

    fn end(&mut self, line: usize) -> Result<(), SyntaxError> {
        let Some(Open { anchor, line: begun_at, size, collection }) = self.open.pop() else {
            return Err(SyntaxError::at(line, "not YAML: a collection ends that never began"));
        };
        let content = match collection {
            Collection::List(items) => Content::List(items),
            Collection::Map(entries, _) => Content::Map(merged(entries)),
        };
        self.insert(Rc::new(Node { line: begun_at, content, size }), anchor, begun_at)
    }

    /// Puts a complete value where it belongs: into the innermost open collection, or as the document.
    fn insert(&mut self, node: Rc<Node>, anchor: usize, line: usize) -> Result<(), SyntaxError> {
        if anchor != 0 {
            self.anchors.insert(anchor, Rc::clone(&node));
        }
        self.nodes += 1;
        let Some(parent) = self.open.last_mut() else {
            self.document = Some(node);
            return Ok(());
        };
        parent.size = parent.size.saturating_add(node.size);
        if parent.size.max(self.nodes) > MAX_NODES {
            let message = format!("must have at most {MAX_NODES} keys and values, those of aliases included");
            return Err(SyntaxError::at(line, message));
        }
        match &mut parent.collection {
            Collection::List(items) => items.push(node),
            Collection::Map(entries, pending) => match pending.take() {
                Some((key, line)) => entries.push(Entry { key, line, value: node }),
                None => match &node.content {
                    Content::Scalar { text, .. } => *pending = Some((text.clone(), line)),
                    _ => return Err(SyntaxError::at(line, "a key must be text, not a list or a mapping")),
                },
            },
        }
        Ok(())
    }
}

/// Whether `!!str` says that a number is text. Other tags are refused, because nothing would heed them.
fn is_text_tag(tag: Option<Cow<'_, Tag>>, line: usize) -> Result<bool, SyntaxError> {
    match tag {
        None => Ok(false),
        Some(tag) if tag.core_suffix() == Some("str") => Ok(true),
        Some(_) => Err(SyntaxError::at(line, "must be without YAML tags (`!name`)")),
    }
}

/// The entries with each merge key (`<<: *alias`) replaced by what it names, unless the mapping says
/// otherwise. A `<<` of anything but mappings stays, and is reported as the unknown key that it then is.
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
