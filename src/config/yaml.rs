//! YAML text to a tree of nodes that know their line. The only module that knows which library parses YAML.
//!
//! The size, the depth and the number of nodes are bounded, aliases counted as if they were written out, so
//! that no file of any content can make the loader hang or exhaust the memory.
//!
//! The library reads through serde, which was made neither for lines nor for numbers as they were written. So
//! the file is read twice: once to see where everything is and what kind of value it is ([`Survey`]), and,
//! knowing that, for the text of every scalar ([`Reading`]). Both rely on what this version of the library
//! does and serde does not ask of it, hence the exact version in `Cargo.toml`: a seed that fails before it
//! has read a value leaves it to the next one.

use std::cell::{Cell, RefCell};
use std::collections::HashSet;
use std::fmt;
use std::rc::Rc;

use serde::Deserializer;
use serde::de::{DeserializeSeed, EnumAccess, Error as _, MapAccess, SeqAccess, Visitor};
use serde_yaml::DeserializerOptions;
use serde_yaml::budget::{Budget, BudgetBreach, check_yaml_budget};

/// The largest configuration file, in bytes. The default one has 6 KiB.
pub(super) const MAX_BYTES: usize = 1 << 20;

/// The most keys and values that a file may have, each use of an alias counted: 1,024 routes of 30 keys each.
const MAX_NODES: usize = 65_536;

/// The deepest nesting. The deepest key there is, `lanes.<lane>.scheduling.cpus[]`, is 5 deep.
const MAX_DEPTH: usize = 32;

/// The most text in a file, each use of an alias counted. Escapes make text longer than it is in the file, by
/// a half at most: `\L` stands for three bytes.
const MAX_TEXT_BYTES: usize = 2 * MAX_BYTES;

/// The most bytes to be read if each alias stood for the whole file: a number of a megabyte is read anew, in
/// 2 ms, for each alias of it. 200 KiB, which is 1,024 routes, may have 2,621 aliases.
const MAX_ALIASED_BYTES: usize = 1 << 29;

/// One value of the file.
#[derive(Debug)]
pub(super) struct Node {
    /// The line, counted from 1, of the key whose value this is, or of this item of a list.
    pub line: usize,
    /// What it is.
    pub content: Content,
}

/// What a value is. Values are shared where a merge key repeats them.
#[derive(Debug)]
pub(super) enum Content {
    /// Text, number, truth value or null: which of them is for its reader to say.
    Scalar {
        /// As written, escapes resolved.
        text: String,
        /// Whether it may be something else than text: `10` may, `"10"` may not.
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

/// Reads the one document of a file; `None` when there is none in it.
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
        // The library leaves it unread.
        return Err(SyntaxError::at(line, SECOND_DOCUMENT));
    }
    if outline.shapes.is_empty() {
        return Ok(None);
    }

    let (next, text_bytes) = (Cell::new(0), Cell::new(0));
    let reading = Reading { source: text, shapes: &outline.shapes, next: &next, text_bytes: &text_bytes };
    let mut root = reading.deserialize(deserializer(text)).map_err(|error| {
        if text_bytes.get() <= MAX_TEXT_BYTES {
            return outline.explain(&error);
        }
        let line = outline.shapes.get(next.get().saturating_sub(1)).map(|shape| shape.line);
        let message = format!("must have at most {MAX_TEXT_BYTES} bytes of text, that of aliases included");
        SyntaxError { line, message }
    })?;
    if !matches!(root.content, Content::Map(_)) {
        // That will be reported, and the root is the one value whose line nothing has told so far.
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

/// The line of the first thing that comes after the marker of the document's end.
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

/// What the library checks before it reads anything: its parser takes quadratic time for deep nesting.
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
    format!("must have at most {MAX_NODES} keys and values, those of aliases included")
}

fn too_deep() -> String {
    format!("must be nested at most {MAX_DEPTH} deep")
}

/// Learns the position of the next value without reading it.
///
/// To the library a newtype is the value that it wraps. Newtypes within newtypes come to its limit of
/// recursion, and the error tells where the value is that it has not begun to read.
#[derive(Clone, Copy)]
struct Position {
    wrappings_left: usize,
}

impl Default for Position {
    fn default() -> Self {
        // Enough at any depth, and an end if the limit were not kept.
        Self { wrappings_left: MAX_DEPTH + 2 }
    }
}

impl<'de> DeserializeSeed<'de> for Position {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        let Some(wrappings_left) = self.wrappings_left.checked_sub(1) else {
            return Err(D::Error::custom("no limit of recursion"));
        };
        deserializer.deserialize_newtype_struct("", Self { wrappings_left })
    }
}

impl<'de> Visitor<'de> for Position {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("any value")
    }

    fn visit_newtype_struct<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        self.deserialize(deserializer)
    }
}

/// Line and column of an error as it is printed; within a visitor nothing else is known of it.
fn printed_position(error: &impl fmt::Display) -> Option<(usize, usize)> {
    let text = error.to_string();
    let Some((_, position)) = text.rsplit_once(" at line ") else {
        // The very beginning is not printed.
        return Some((1, 1));
    };
    let (line, column) = position.split_once(" column ")?;
    Some((line.parse().ok()?, column.parse().ok()?))
}

/// What is known of a value before its text is.
#[derive(Clone, Copy, Debug)]
struct Shape {
    line: usize,
    kind: Kind,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    /// `typed` when the library takes it for a number, a truth value or null.
    Scalar {
        typed: bool,
    },
    List,
    Map,
}

/// What the first reading finds out.
struct Outline<'a> {
    source: &'a str,
    /// All keys and values, those of aliases included, in the order in which serde comes upon them.
    shapes: Vec<Shape>,
    /// The greatest line on the way to the value that was read last.
    latest_line: usize,
    /// The kind and the position of the first key or item of each collection around the present value. No two
    /// collections have both in common, so that one found here again is within itself.
    open: Vec<(Kind, Option<(usize, usize)>)>,
    /// The lines, as the library counts them, that begin after characters which end no line in an editor.
    odd_lines: Vec<usize>,
    /// The last line, as an editor counts them.
    last_line: usize,
    /// Why reading was broken off.
    stop: Option<SyntaxError>,
}

impl<'a> Outline<'a> {
    fn new(source: &'a str) -> Self {
        let mut odd_lines = Vec::new();
        let (mut line, mut before) = (1, ' ');
        for character in source.chars() {
            match character {
                '\n' if before == '\r' => {}
                '\n' | '\r' => line += 1,
                // Line breaks of YAML 1.1, which the library counts.
                '\u{85}' | '\u{2028}' | '\u{2029}' => {
                    line += 1;
                    odd_lines.push(line);
                }
                _ => {}
            }
            before = character;
        }
        let last_line = line - odd_lines.len();
        Self {
            source,
            shapes: Vec::new(),
            latest_line: 1,
            open: Vec::new(),
            odd_lines,
            last_line,
            stop: None,
        }
    }

    fn line_in_editor(&self, line: usize) -> usize {
        let odd = self.odd_lines.partition_point(|&odd| odd <= line);
        line.saturating_sub(odd).clamp(1, self.last_line)
    }

    /// The error of the library in our words where it is about our limits, else in its own.
    fn explain(&self, error: &serde_yaml::Error) -> SyntaxError {
        if error.is_message() {
            // Only of a tag does the library say that a value is not what it claims to be.
            let line = error.location().map(|location| self.line_in_editor(location.line()));
            return SyntaxError { line, message: NO_TAGS.to_owned() };
        }
        let text = error.to_string();
        if text == "repetition limit exceeded" {
            let most = max_aliases(self.source);
            let message = format!("must use at most {most} aliases in a file of this size");
            return SyntaxError::at(self.latest_line, message);
        }
        if let Some(breach) = breach(self.source) {
            let message = match breach {
                BudgetBreach::Documents { .. } => SECOND_DOCUMENT.to_owned(),
                BudgetBreach::Depth { .. } => too_deep(),
                _ => too_many(),
            };
            return SyntaxError::at(self.line_of_breach(), message);
        }
        if text.ends_with("more than one document is not supported") {
            // The check goes by YAML 1.2. Where only YAML 1.1 sees the end of a document, no line is known.
            return SyntaxError::of_file("must be one YAML document");
        }
        let is_prescan = text.contains(" at byte ");
        let cut = [" at line ", " at byte ", " at position "].iter().filter_map(|at| text.find(at)).min();
        let info = text[..cut.unwrap_or(text.len())].chars().filter(|c| !c.is_control()).take(200);
        let line = error.location().map(|location| match is_prescan {
            // The check before the reading counts lines as an editor does.
            true => location.line().clamp(1, self.last_line),
            false => self.line_in_editor(location.line()),
        });
        let message = match info.collect::<String>() {
            // The check has a limit of its own, before ours, for brackets within a line.
            info if info == "recursion limit exceeded" => too_deep(),
            info => format!("not YAML: {info}"),
        };
        SyntaxError { line, message }
    }

    /// The line that breaks the budget, which the library does not tell: the last of the shortest part that
    /// breaks it.
    fn line_of_breach(&self) -> usize {
        let ends: Vec<usize> = self
            .source
            .split_inclusive('\n')
            .scan(0, |end, line| {
                *end += line.len();
                Some(*end)
            })
            .collect();
        let line = ends.partition_point(|&end| breach(&self.source[..end]).is_none());
        (line + 1).min(ends.len().max(1))
    }
}

/// How a text breaks the budget.
fn breach(text: &str) -> Option<BudgetBreach> {
    check_yaml_budget(text, &budget()).ok()?.breached
}

const SECOND_DOCUMENT: &str = "must be one YAML document; a second one begins here";
const NO_TAGS: &str = "must be without YAML tags (`!name`)";

/// The first reading, of one value.
#[derive(Clone, Copy)]
struct Survey<'s, 'a> {
    outline: &'s RefCell<Outline<'a>>,
    /// The line of this key or item, or of the key whose value this is.
    line: usize,
    /// The greatest line on the way here. That of an alias is greater than any of what it stands for.
    latest_line: usize,
    is_key: bool,
}

impl Survey<'_, '_> {
    /// Breaks the reading off.
    fn stop<T, E: serde::de::Error>(self, message: impl Into<String>) -> Result<T, E> {
        let error = SyntaxError::at(self.latest_line, message);
        let message = error.message.clone();
        self.outline.borrow_mut().stop.get_or_insert(error);
        Err(E::custom(message))
    }

    fn add<E: serde::de::Error>(self, kind: Kind) -> Result<(), E> {
        if self.is_key && !matches!(kind, Kind::Scalar { .. }) {
            return self.stop("a key must be text, not a list or a mapping");
        }
        if self.outline.borrow().shapes.len() >= MAX_NODES {
            return self.stop(too_many());
        }
        self.outline.borrow_mut().shapes.push(Shape { line: self.line, kind });
        Ok(())
    }

    fn typed<E: serde::de::Error>(self) -> Result<(), E> {
        self.add(Kind::Scalar { typed: true })
    }

    fn open<E: serde::de::Error>(self, kind: Kind) -> Result<(), E> {
        self.add(kind)?;
        if self.outline.borrow().open.len() >= MAX_DEPTH {
            return self.stop(too_deep());
        }
        self.outline.borrow_mut().open.push((kind, None));
        Ok(())
    }

    fn close(self) {
        self.outline.borrow_mut().open.pop();
    }

    /// The next key or item of the present collection, given the outcome of a [`Position`]; `None` at its
    /// end.
    fn child<E: serde::de::Error>(
        self,
        position: Result<Option<()>, E>,
        is_key: bool,
    ) -> Result<Option<Self>, E> {
        let position = match position {
            Ok(None) => return Ok(None),
            Ok(Some(())) => None,
            Err(error) => printed_position(&error),
        };
        let mut outline = self.outline.borrow_mut();
        let mut is_within_itself = false;
        if let Some((present, around)) = outline.open.split_last_mut()
            && present.1.is_none()
        {
            present.1 = position;
            is_within_itself = position.is_some() && around.contains(present);
        }
        let line = position.map_or(self.line, |(line, _)| outline.line_in_editor(line));
        let latest_line = self.latest_line.max(line);
        outline.latest_line = latest_line;
        drop(outline);
        if is_within_itself {
            return self.stop("this alias refers to what it is part of");
        }
        Ok(Some(Self { line, latest_line, is_key, ..self }))
    }
}

impl<'de> DeserializeSeed<'de> for Survey<'_, '_> {
    type Value = ();

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<(), D::Error> {
        deserializer.deserialize_any(self)
    }
}

impl<'de> Visitor<'de> for Survey<'_, '_> {
    type Value = ();

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("any value")
    }

    fn visit_bool<E: serde::de::Error>(self, _: bool) -> Result<(), E> {
        self.typed()
    }

    fn visit_i64<E: serde::de::Error>(self, _: i64) -> Result<(), E> {
        self.typed()
    }

    fn visit_i128<E: serde::de::Error>(self, _: i128) -> Result<(), E> {
        self.typed()
    }

    fn visit_u64<E: serde::de::Error>(self, _: u64) -> Result<(), E> {
        self.typed()
    }

    fn visit_u128<E: serde::de::Error>(self, _: u128) -> Result<(), E> {
        self.typed()
    }

    fn visit_f64<E: serde::de::Error>(self, _: f64) -> Result<(), E> {
        self.typed()
    }

    fn visit_unit<E: serde::de::Error>(self) -> Result<(), E> {
        self.typed()
    }

    /// There is no document.
    fn visit_none<E: serde::de::Error>(self) -> Result<(), E> {
        Ok(())
    }

    fn visit_str<E: serde::de::Error>(self, _: &str) -> Result<(), E> {
        self.add(Kind::Scalar { typed: false })
    }

    fn visit_seq<A: SeqAccess<'de>>(self, mut items: A) -> Result<(), A::Error> {
        self.open(Kind::List)?;
        while let Some(item) = self.child(items.next_element_seed(Position::default()), false)? {
            items.next_element_seed(item)?;
        }
        self.close();
        Ok(())
    }

    fn visit_map<A: MapAccess<'de>>(self, mut entries: A) -> Result<(), A::Error> {
        self.open(Kind::Map)?;
        while let Some(key) = self.child(entries.next_key_seed(Position::default()), true)? {
            // As a key the library would refuse one that is there twice, and with it all problems after it.
            entries.next_value_seed(key)?;
            entries.next_value_seed(Self { is_key: false, ..key })?;
        }
        self.close();
        Ok(())
    }

    /// What has a tag.
    fn visit_enum<A: EnumAccess<'de>>(self, _: A) -> Result<(), A::Error> {
        self.stop(NO_TAGS)
    }
}

/// The second reading, of one value, whose kind is known.
#[derive(Clone, Copy)]
struct Reading<'r> {
    source: &'r str,
    shapes: &'r [Shape],
    /// The place of the next value among them.
    next: &'r Cell<usize>,
    text_bytes: &'r Cell<usize>,
}

impl<'de> DeserializeSeed<'de> for Reading<'_> {
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

impl<'de> Visitor<'de> for Reading<'_> {
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

/// Reads a scalar of this source as text.
struct ScalarVisitor<'s>(&'s str);

impl<'de> Visitor<'de> for ScalarVisitor<'_> {
    type Value = Scalar;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("text")
    }

    /// A part of the source: in quotes if there is a quote before it.
    fn visit_borrowed_str<E: serde::de::Error>(self, text: &'de str) -> Result<Scalar, E> {
        let offset = text.as_ptr().addr().wrapping_sub(self.0.as_ptr().addr());
        let before = self.0.as_bytes().get(offset.wrapping_sub(1));
        let may_be_plain = !matches!(before, Some(b'\'' | b'"'));
        Ok(Scalar { text: text.to_owned(), may_be_plain })
    }

    /// Something else than a part of the source: a block, or text with escapes or line breaks.
    fn visit_str<E: serde::de::Error>(self, text: &str) -> Result<Scalar, E> {
        Ok(Scalar { text: text.to_owned(), may_be_plain: false })
    }
}

/// Whether this, if plain, is a number, truth value or null. That it was not taken for it is due to `!!str`.
fn has_type(text: &str) -> bool {
    let is_number = || serde_yaml::parse_f64(text).is_some() && !serde_yaml::digits_but_not_number(text);
    matches!(text, "" | "~" | "null" | "Null" | "NULL")
        || text.eq_ignore_ascii_case("true")
        || text.eq_ignore_ascii_case("false")
        || is_number()
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
