//! A value at a key path of the file, and functions to read it. A wrong value is reported and then counts as
//! missing: reading continues, so that one run finds every problem.

use std::ops::RangeInclusive;
use std::rc::Rc;

use super::choices::{Choice, words};
use super::keys::{Key, Kind, Row, joined};
use super::problem::{Place, Problem, Problems, did_you_mean, shown};
use super::yaml::{Content, Node};

/// A key path of the file, with or without a value.
#[derive(Clone, Debug)]
pub(super) struct Field<'a> {
    /// Its key path, such as `topics[0].id`.
    pub path: String,
    /// The line of its key; for a missing key that of the closest existing parent.
    pub line: usize,
    node: Option<&'a Node>,
    /// Its declaration; `None` for an unknown key.
    key: Option<&'static Key>,
    problems: &'a Problems,
}

impl<'a> Field<'a> {
    /// The field of the whole file.
    pub fn root(node: Option<&'a Node>, problems: &'a Problems) -> Self {
        Self { path: String::new(), line: 1, node, key: Some(Key::root()), problems }
    }

    /// Whether there is a value other than null.
    pub fn is_given(&self) -> bool {
        self.value().is_some()
    }

    /// Whether the key exists with the value null, which all other functions treat as missing.
    pub fn is_null(&self) -> bool {
        self.node.is_some_and(Node::is_null)
    }

    fn value(&self) -> Option<&'a Node> {
        self.node.filter(|node| !node.is_null())
    }

    fn child(&self, path: String, line: usize, node: Option<&'a Node>, key: Option<&'static Key>) -> Self {
        Self { path, line, node, key, problems: self.problems }
    }

    /// The field with this name in a mapping; without a value if this is no mapping or has no such key.
    pub fn get(&self, name: &str) -> Self {
        let entry = match self.value().map(|node| &node.content) {
            Some(Content::Map(entries)) => entries.iter().find(|entry| entry.key == name),
            _ => None,
        };
        let line = entry.map_or(self.line, |entry| entry.line);
        let key = self.key.and_then(|key| key.get(name));
        self.child(joined(&self.path, name), line, entry.map(|entry| &*entry.value), key)
    }

    /// The field with this name; reports a value that is no mapping.
    pub fn section(&self, name: &str) -> Self {
        let section = self.get(name);
        section.entries();
        section
    }

    pub fn is_map(&self) -> bool {
        matches!(self.value().map(|node| &node.content), Some(Content::Map(_)))
    }

    /// The keys of a mapping with their fields, each key once; none if there is no value. Reports a value
    /// that is no mapping.
    pub fn entries(&self) -> Vec<(&'a str, Self)> {
        let Some(node) = self.value() else { return Vec::new() };
        let Content::Map(entries) = &node.content else {
            self.report::<()>("must be a mapping (`key: value`)");
            return Vec::new();
        };
        let mut seen = std::collections::HashSet::new();
        let once = entries.iter().filter(|entry| seen.insert(entry.key.as_str()));
        once.map(|entry| {
            let path = joined(&self.path, &shown(&entry.key));
            let key = self.key.and_then(|key| key.get(&entry.key));
            (entry.key.as_str(), self.child(path, entry.line, Some(&entry.value), key))
        })
        .collect()
    }

    /// The items of a list; `None` if there is no value. Reports a value that is no list.
    pub fn items(&self) -> Option<Vec<Self>> {
        let Content::List(items) = &self.value()?.content else {
            return self.report("must be a list");
        };
        let key = self.key.and_then(Key::item);
        let item = |(index, item): (usize, &'a Rc<Node>)| {
            self.child(format!("{}[{index}]", self.path), item.line, Some(item), key)
        };
        Some(items.iter().enumerate().map(item).collect())
    }

    fn scalar(&self) -> Option<(&'a str, bool)> {
        match &self.value()?.content {
            Content::Scalar { text, plain } => Some((text, *plain)),
            _ => None,
        }
    }

    pub fn flag(&self) -> Option<bool> {
        self.value()?;
        let meant = match self.scalar() {
            Some(("true" | "True" | "TRUE", true)) => return Some(true),
            Some(("false" | "False" | "FALSE", true)) => return Some(false),
            Some(("yes" | "Yes" | "YES" | "on" | "On" | "ON", _) | ("true", false)) => Some("true"),
            Some(("no" | "No" | "NO" | "off" | "Off" | "OFF", _) | ("false", false)) => Some("false"),
            _ => None,
        };
        self.report_with("must be true or false", meant.map(did_you_mean))
    }

    /// The row of the key; `None` for an unknown key, which is reported as such.
    fn row(&self) -> Option<&'static Row> {
        self.key?.row
    }

    /// Returns `None` for a key that is read as another type than its row declares, which is a defect.
    fn no_value<T>(&self, kind: Kind) -> Option<T> {
        debug_assert!(false, "{} is declared as {kind:?}", self.path);
        None
    }

    /// The default that the row of the key declares.
    fn default<T>(&self, parse: impl Fn(&str) -> Option<T>) -> T {
        let text = self.row().map_or("", |row| row.default);
        #[allow(clippy::expect_used, reason = "the tests read a file without keys, so every default")]
        parse(text.trim_matches('`')).expect("the default of a key is one of its values")
    }

    pub fn flag_or_default(&self) -> bool {
        self.flag().unwrap_or_else(|| self.default(|text| text.parse().ok()))
    }

    /// A whole number in the key's range.
    pub fn count<T: TryFrom<u64>>(&self) -> Option<T> {
        match self.row()?.kind {
            Kind::Whole(least, most, _) => T::try_from(self.whole_in(least..=most)?).ok(),
            other => self.no_value(other),
        }
    }

    pub fn count_or_default<T: TryFrom<u64>>(&self) -> T {
        let default = || self.default(|text| T::try_from(parse_whole(text)?).ok());
        self.count().unwrap_or_else(default)
    }

    /// A finite number in the key's range.
    pub fn decimal(&self) -> Option<f64> {
        let (least, most) = match self.row()?.kind {
            Kind::Decimal(least, most, _) => (least, most),
            other => return self.no_value(other),
        };
        let allowed = format!("must be a number from {least} to {most}");
        self.number(&allowed, |text| parse_decimal(text).filter(|number| (least..=most).contains(number)))
    }

    pub fn decimal_or_default(&self) -> f64 {
        self.decimal().unwrap_or_else(|| self.default(parse_decimal))
    }

    /// A whole number in a range; `10.0` is one too.
    pub fn whole_in(&self, range: RangeInclusive<u64>) -> Option<u64> {
        let allowed = format!("must be a whole number from {} to {}", range.start(), range.end());
        self.whole_where(&allowed, |number| range.contains(&number))
    }

    /// A whole number that satisfies a condition.
    pub fn whole_where(&self, allowed: &str, accept: impl Fn(u64) -> bool) -> Option<u64> {
        self.number(allowed, |text| parse_whole(text).filter(|&number| accept(number)))
    }

    fn number<T>(&self, allowed: &str, parse: impl Fn(&str) -> Option<T>) -> Option<T> {
        self.value()?;
        match self.scalar() {
            Some((text, true)) => parse(text).or_else(|| self.report(allowed)),
            Some((text, false)) if parse(text).is_some() => {
                self.report_with(allowed, Some("remove the quotes".to_owned()))
            }
            _ => self.report(allowed),
        }
    }

    /// A text. A number or boolean must be in quotes, because other YAML parsers would change `010`.
    pub fn text(&self) -> Option<&'a str> {
        self.value()?;
        match self.scalar() {
            Some((text, true)) if parse_decimal(text).is_some() || matches!(text, "true" | "false") => {
                self.report_with("must be text", Some("put it in quotes".to_owned()))
            }
            Some((text, _)) => Some(text),
            None => self.report("must be text"),
        }
    }

    /// A text that `parse` accepts.
    pub fn parsed<T>(&self, allowed: &str, parse: impl FnOnce(&str) -> Option<T>) -> Option<T> {
        let text = self.text()?;
        parse(text).or_else(|| self.report(&format!("must be {allowed}")))
    }

    /// One of a few words, in any case.
    pub fn choice<T: Choice>(&self) -> Option<T> {
        self.value()?;
        let word = self.scalar().map_or("", |(text, _)| text);
        let found = T::WORDS.iter().find(|(name, _)| name.eq_ignore_ascii_case(word));
        found.map(|&(_, choice)| choice).or_else(|| {
            let names = words::<T>();
            let hint = self.problems.hint(word, &names);
            self.report_with(&format!("must be one of {}", names.join(", ")), hint)
        })
    }

    pub fn choice_or_default<T: Choice>(&self) -> T {
        let find = |text: &str| T::WORDS.iter().find(|(name, _)| *name == text).map(|&(_, choice)| choice);
        self.choice().unwrap_or_else(|| self.default(find))
    }

    pub fn parsed_or_default<T>(&self, allowed: &str, parse: impl Fn(&str) -> Option<T>) -> T {
        self.parsed(allowed, &parse).unwrap_or_else(|| self.default(parse))
    }

    /// A reference by name to something that the file defines elsewhere; `find` looks it up.
    pub fn reference<T>(
        &self,
        what: &str,
        names: &[&str],
        find: impl FnOnce(&str) -> Option<T>,
    ) -> Option<T> {
        let name = self.text()?;
        find(name).or_else(|| {
            let hint = self.problems.hint(name, names);
            self.report_with(&one_of(what, names), hint)
        })
    }

    /// Reports this field's value, or that it is missing. Always returns `None`, which the caller can return.
    pub fn report<T>(&self, allowed: &str) -> Option<T> {
        self.report_with(allowed, None)
    }

    /// Reports this field as [`report`](Self::report) does, with a hint at the remedy.
    pub fn report_with<T>(&self, allowed: &str, hint: Option<String>) -> Option<T> {
        match self.value() {
            Some(node) => self.add(self.shown(node), allowed.to_owned(), hint),
            None => {
                let allowed = allowed.strip_prefix("must be ").unwrap_or(allowed);
                self.add(None, format!("must be given: {allowed}"), hint);
            }
        }
        None
    }

    /// Reports the key without its value.
    pub fn report_key(&self, allowed: &str) {
        self.add(None, allowed.to_owned(), None);
    }

    /// Reports a key that is not one of the known names.
    pub fn report_unknown_key(&self, what: &str, name: &str, known: &[&str]) {
        let hint = self.problems.hint(name, known);
        self.add(None, one_of(what, known), hint);
    }

    /// Reports a value that the loader computed from this field or from defaults.
    pub fn report_value(&self, value: &str, allowed: String) {
        self.add(Some(shown(value)), allowed, None);
    }

    /// Whether a problem with exactly this key path has been reported.
    pub fn was_reported(&self) -> bool {
        self.problems.has_key(&self.path)
    }

    fn add(&self, value: Option<String>, allowed: String, hint: Option<String>) {
        let place = Place::of(self.line);
        self.problems.report(Problem { place, key: self.path.clone(), value, allowed, hint });
    }

    /// The value for a message; `None` if it may contain a secret.
    fn shown(&self, node: &Node) -> Option<String> {
        if self.path == "security" || self.path.starts_with("security.hmac_secret") {
            return None;
        }
        Some(match &node.content {
            Content::Scalar { text, plain: true } => shown(text),
            Content::Scalar { text, .. } => format!("\"{}\"", shown(text)),
            Content::List(_) => "a list".to_owned(),
            Content::Map(_) => "a mapping".to_owned(),
        })
    }
}

/// The allowed names, for a message. A list of more than 16 names is left out, to keep the message readable.
fn one_of(what: &str, names: &[&str]) -> String {
    match names.len() {
        0 => format!("must be {what}, and there is none"),
        1..=16 => format!("must be {what}: {}", names.join(", ")),
        _ => format!("must be {what}"),
    }
}

/// Parses a whole number that is not negative.
fn parse_whole(text: &str) -> Option<u64> {
    let digits = text.strip_prefix('+').unwrap_or(text);
    // 010 is ten in YAML 1.2 and eight in YAML 1.1, so it is refused.
    if digits.starts_with('0') && digits.as_bytes().get(1).is_some_and(u8::is_ascii_digit) {
        return None;
    }
    digits.parse().ok().or_else(|| {
        // Above 2^53 (9.007e15) an `f64` cannot represent every whole number.
        let number = parse_decimal(digits)?;
        (number.fract() == 0.0 && (0.0..=9.0e15).contains(&number)).then_some(number as u64)
    })
}

/// Parses a finite number in decimal notation; not `.nan`, `.inf`, `0x10` or `1_000`.
fn parse_decimal(text: &str) -> Option<f64> {
    let is_number = text.bytes().all(|byte| matches!(byte, b'0'..=b'9' | b'+' | b'-' | b'.' | b'e' | b'E'));
    let number = if is_number { text.parse::<f64>().ok() } else { None };
    number.filter(|number| number.is_finite())
}
