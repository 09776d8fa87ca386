//! The first reading: where everything is, and what kind of value it is.

use std::cell::RefCell;
use std::fmt;

use serde::Deserializer;
use serde::de::{DeserializeSeed, EnumAccess, Error as _, MapAccess, SeqAccess, Visitor};
use serde_yaml::budget::{BudgetBreach, check_yaml_budget};

use super::{MAX_DEPTH, MAX_NODES, SyntaxError, budget, max_aliases, too_deep, too_many};

/// Learns the position of the next value without reading it.
///
/// To the library a newtype is the value that it wraps. Newtypes within newtypes come to its limit of
/// recursion, and the error tells where the value is that it has not begun to read.
#[derive(Clone, Copy)]
pub(super) struct Position {
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
pub(super) struct Shape {
    pub line: usize,
    pub kind: Kind,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// `typed` when the library takes it for a number, a truth value or null.
    Scalar {
        typed: bool,
    },
    List,
    Map,
}

/// What the first reading finds out.
pub(super) struct Outline<'a> {
    pub source: &'a str,
    /// All keys and values, those of aliases included, in the order in which serde comes upon them.
    pub shapes: Vec<Shape>,
    /// The greatest line on the way to the value that was read last.
    pub latest_line: usize,
    /// The kind and the position of the first key or item of each collection around the present value. No two
    /// collections have both in common, so that one found here again is within itself.
    pub open: Vec<(Kind, Option<(usize, usize)>)>,
    /// The lines, as the library counts them, that begin after characters which end no line in an editor.
    pub odd_lines: Vec<usize>,
    /// The last line, as an editor counts them.
    pub last_line: usize,
    /// Why reading was broken off.
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

    pub fn line_in_editor(&self, line: usize) -> usize {
        let odd = self.odd_lines.partition_point(|&odd| odd <= line);
        line.saturating_sub(odd).clamp(1, self.last_line)
    }

    /// The error of the library in our words where it is about our limits, else in its own.
    pub fn explain(&self, error: &serde_yaml::Error) -> SyntaxError {
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
pub(super) fn breach(text: &str) -> Option<BudgetBreach> {
    check_yaml_budget(text, &budget()).ok()?.breached
}

pub(super) const SECOND_DOCUMENT: &str = "must be one YAML document; a second one begins here";
pub(super) const NO_TAGS: &str = "must be without YAML tags (`!name`)";

/// The first reading, of one value.
#[derive(Clone, Copy)]
pub(super) struct Survey<'s, 'a> {
    pub outline: &'s RefCell<Outline<'a>>,
    /// The line of this key or item, or of the key whose value this is.
    pub line: usize,
    /// The greatest line on the way here. That of an alias is greater than any of what it stands for.
    pub latest_line: usize,
    pub is_key: bool,
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
