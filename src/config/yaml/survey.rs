//! The first pass: finds the line and the kind of each value.

use std::cell::RefCell;
use std::fmt;

use serde::Deserializer;
use serde::de::{DeserializeSeed, EnumAccess, Error as _, MapAccess, SeqAccess, Visitor};
use serde_yaml::budget::{BudgetBreach, check_yaml_budget};

use super::{MAX_DEPTH, MAX_NODES, SyntaxError, budget, max_aliases, too_deep, too_many};

/// Finds the position of the next value without reading it.
///
/// The library treats a newtype as the value that it wraps. Nested newtypes reach its recursion limit, and
/// the error has the position of the value, which the library has not begun to read.
#[derive(Clone, Copy)]
pub(super) struct Position {
    wrappings_left: usize,
}

impl Default for Position {
    fn default() -> Self {
        // Enough to reach the limit at any depth, and an end if the library does not enforce the limit.
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

/// The line and column in the text of an error; a visitor has no other access to them.
fn printed_position(error: &impl fmt::Display) -> Option<(usize, usize)> {
    let text = error.to_string();
    let Some((_, position)) = text.rsplit_once(" at line ") else {
        // The library does not print the position of the start of the file.
        return Some((1, 1));
    };
    let (line, column) = position.split_once(" column ")?;
    Some((line.parse().ok()?, column.parse().ok()?))
}

/// The line and the kind of a value.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shape {
    pub line: usize,
    pub kind: Kind,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// `typed` when the library treats it as a number, a boolean or null.
    Scalar {
        typed: bool,
    },
    List,
    Map,
}

/// The result of the first pass.
pub(super) struct Outline<'a> {
    pub source: &'a str,
    /// All keys and values, including those of aliases, in the order in which serde visits them.
    pub shapes: Vec<Shape>,
    /// The greatest line on the path to the value that was read last.
    pub latest_line: usize,
    /// The kind and the position of the first key or item of each collection around the current value. No two
    /// collections have both in common, so that a collection found here again contains itself.
    pub open: Vec<(Kind, Option<(usize, usize)>)>,
    /// The lines, as the library counts them, that begin after characters which an editor does not treat as
    /// line breaks.
    pub odd_lines: Vec<usize>,
    /// The last line, as an editor counts lines.
    pub last_line: usize,
    /// Why the pass was aborted.
    pub stop: Option<SyntaxError>,
}

impl<'a> Outline<'a> {
    pub fn new(source: &'a str) -> Self {
        let mut odd_lines = Vec::new();
        let (mut line, mut before) = (1, ' ');
        for character in source.chars() {
            match character {
                '\n' if before == '\r' => {}
                '\n' | '\r' => line += 1,
                // Line breaks of YAML 1.1, which the library counts as well.
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

    pub fn line_in_editor(&self, line: usize) -> usize {
        let odd = self.odd_lines.partition_point(|&odd| odd <= line);
        line.saturating_sub(odd).clamp(1, self.last_line)
    }

    /// Converts an error of the library: one about this module's limits gets this module's text, any other
    /// keeps its own.
    pub fn explain(&self, error: &serde_yaml::Error) -> SyntaxError {
        if error.is_message() {
            // The library reports a value of the wrong type only for a tag.
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
            // The check follows YAML 1.2. If a document ends only according to YAML 1.1, the line is not
            // known.
            return SyntaxError::of_file("must be one YAML document");
        }
        let is_prescan = text.contains(" at byte ");
        let cut = [" at line ", " at byte ", " at position "].iter().filter_map(|at| text.find(at)).min();
        let info = text[..cut.unwrap_or(text.len())].chars().filter(|c| !c.is_control()).take(200);
        let line = error.location().map(|location| match is_prescan {
            // The check before parsing counts lines as an editor does.
            true => location.line().clamp(1, self.last_line),
            false => self.line_in_editor(location.line()),
        });
        let message = match info.collect::<String>() {
            // The check has its own limit for brackets within a line, which is reached before that of this
            // module.
            info if info == "recursion limit exceeded" => too_deep(),
            info => format!("not YAML: {info}"),
        };
        SyntaxError { line, message }
    }

    /// The line that exceeds the budget, which the library does not report: the last line of the shortest
    /// prefix that exceeds it.
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

/// How a text exceeds the budget.
pub(super) fn breach(text: &str) -> Option<BudgetBreach> {
    check_yaml_budget(text, &budget()).ok()?.breached
}

pub(super) const SECOND_DOCUMENT: &str = "must be one YAML document; a second one begins here";
pub(super) const NO_TAGS: &str = "must not use YAML tags (`!name`)";

/// The first pass over one value.
#[derive(Clone, Copy)]
pub(super) struct Survey<'s, 'a> {
    pub outline: &'s RefCell<Outline<'a>>,
    /// The line of this key or item, or of the key of this value.
    pub line: usize,
    /// The greatest line on the path to this value. The line of an alias is greater than those of the value
    /// to which it refers.
    pub latest_line: usize,
    pub is_key: bool,
}

impl Survey<'_, '_> {
    /// Aborts the pass.
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

    /// The next key or item of the current collection, from the result of a [`Position`]; `None` at its end.
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
        let mut contains_itself = false;
        if let Some((current, around)) = outline.open.split_last_mut()
            && current.1.is_none()
        {
            current.1 = position;
            contains_itself = position.is_some() && around.contains(current);
        }
        let line = position.map_or(self.line, |(line, _)| outline.line_in_editor(line));
        let latest_line = self.latest_line.max(line);
        outline.latest_line = latest_line;
        drop(outline);
        if contains_itself {
            return self.stop("must not be an alias of a value that contains it");
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

    /// A file without a document.
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
            // Read as a key, a repeated key would be an error of the library, which would hide later
            // problems.
            entries.next_value_seed(key)?;
            entries.next_value_seed(Self { is_key: false, ..key })?;
        }
        self.close();
        Ok(())
    }

    /// A value with a tag.
    fn visit_enum<A: EnumAccess<'de>>(self, _: A) -> Result<(), A::Error> {
        self.stop(NO_TAGS)
    }
}
