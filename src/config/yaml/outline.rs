//! Finds the line and the kind of each value with a parser that reports positions, and checks the limits of
//! a file before the YAML library reads it.

use std::collections::HashMap;
use std::ops::Range;

use granit_parser::{ErrorKind, Event, Parser, ScalarStyle, ScanError, Span, Tag};

use super::{MAX_DEPTH, MAX_NODES, MAX_TEXT_BYTES, SyntaxError, max_aliases};

const SECOND_DOCUMENT: &str = "must be one YAML document; a second one begins here";

/// The line and the kind of a value.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shape {
    /// The line, counted from 1, of this key or item, or of the key of this value.
    pub line: usize,
    pub kind: Kind,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Kind {
    /// `plain` when it may be a number, boolean or null.
    Scalar {
        plain: bool,
    },
    List,
    Map,
}

/// All keys and values of the only document, those of aliases written out, in the order of the file. Empty
/// for a file without a document.
pub(super) fn outline(source: &str) -> Result<Vec<Shape>, SyntaxError> {
    let last_line = line_after(source, usize::MAX);
    let mut outline = Outline { source, last_line, ..Outline::default() };
    let mut parser = Parser::new_from_str_with_options(
        source,
        granit_parser::options! {
            emit_comments: false,
        },
    );
    while let Some(event) = parser.next_event() {
        let (event, span) = event.map_err(|error| outline.explain(&error))?;
        outline.add(event, &span)?;
    }
    outline.later.map_or(Ok(outline.shapes), Err)
}

/// The line that contains the character with this index, as an editor counts lines.
pub(super) fn line_after(source: &str, characters: usize) -> usize {
    let (mut line, mut before) = (1, ' ');
    for character in source.chars().take(characters) {
        match character {
            '\n' if before == '\r' => {}
            '\n' | '\r' => line += 1,
            _ => {}
        }
        before = character;
    }
    line
}

/// An anchored value: what an alias of it adds to the file.
struct Anchor {
    /// The shapes of the value and of all below it.
    shapes: Range<usize>,
    /// The number of collections that are nested in each other, 0 for a scalar.
    height: usize,
    aliases: usize,
    text_bytes: usize,
}

/// A collection whose end has not been reached.
struct Open {
    is_map: bool,
    /// The line of the key whose value comes next.
    key_line: Option<usize>,
    anchor: usize,
    /// Its index in the shapes, and the counts before it.
    start: usize,
    aliases_before: usize,
    text_bytes_before: usize,
    /// The greatest height of its items.
    height: usize,
}

#[derive(Default)]
struct Outline<'a> {
    source: &'a str,
    last_line: usize,
    documents: usize,
    shapes: Vec<Shape>,
    open: Vec<Open>,
    /// The anchors by the numbers that the parser gives them, without those of open collections.
    anchors: HashMap<usize, Anchor>,
    aliases: usize,
    text_bytes: usize,
    /// The first key that is no text, or too much text. It is reported if nothing else stops the pass.
    later: Option<SyntaxError>,
}

impl Outline<'_> {
    fn add(&mut self, event: Event<'_>, span: &Span) -> Result<(), SyntaxError> {
        let line = span.start.line().clamp(1, self.last_line);
        match event {
            Event::DocumentStart(..) => {
                self.documents += 1;
                if self.documents > 1 {
                    return Err(SyntaxError::at(line, SECOND_DOCUMENT));
                }
            }
            Event::Alias(anchor) => self.alias(anchor, line)?,
            Event::Scalar(text, style, anchor, tag) => {
                let plain =
                    is_plain(&text, style, tag.as_deref()).ok_or_else(|| self.bad_tag(anchor, span))?;
                self.text_bytes += text.len();
                let start = self.begin(self.start_line(anchor, span), Kind::Scalar { plain }, line)?;
                let (aliases, text_bytes) = (0, text.len());
                self.end(anchor, Anchor { shapes: start..start + 1, height: 0, aliases, text_bytes });
            }
            Event::SequenceStart(_, anchor, tag) => {
                self.collection(Kind::List, anchor, tag.as_deref(), span, line)?;
            }
            Event::MappingStart(_, anchor, tag) => {
                self.collection(Kind::Map, anchor, tag.as_deref(), span, line)?;
            }
            Event::SequenceEnd | Event::MappingEnd => self.close(),
            _ => {}
        }
        Ok(())
    }

    /// The line where a value begins: of its anchor or tag, which may be above that of its content.
    fn start_line(&self, anchor: usize, span: &Span) -> usize {
        let mut line = span.start.line();
        if let Some(tag) = span.tag_start() {
            line = line.min(tag.line());
        }
        if anchor > 0
            && let Some(sign) = span.start.byte_offset().and_then(|end| self.source.get(..end)?.rfind('&'))
        {
            // Between the sign and the content are only the anchor, a tag, space and comments.
            line = line.min(line_after(&self.source[..sign], usize::MAX));
        }
        line.clamp(1, self.last_line)
    }

    fn bad_tag(&self, anchor: usize, span: &Span) -> SyntaxError {
        SyntaxError::at(self.start_line(anchor, span), "must not use YAML tags (`!name`)")
    }

    /// Adds a key or value that begins at `start_line`, and returns its index. `line` is for errors.
    fn begin(&mut self, start_line: usize, kind: Kind, line: usize) -> Result<usize, SyntaxError> {
        let mut shape = Shape { line: start_line, kind };
        if let Some(open) = self.open.last_mut().filter(|open| open.is_map) {
            match open.key_line.take() {
                Some(key_line) => shape.line = key_line,
                None => {
                    open.key_line = Some(start_line);
                    if !matches!(kind, Kind::Scalar { .. }) {
                        let error = SyntaxError::at(line, "a key must be text, not a list or a mapping");
                        self.later.get_or_insert(error);
                    }
                }
            }
        }
        self.shapes.push(shape);
        self.check_counts(line)?;
        Ok(self.shapes.len() - 1)
    }

    fn check_counts(&mut self, line: usize) -> Result<(), SyntaxError> {
        let most = max_aliases(self.source);
        if self.shapes.len() > MAX_NODES {
            let message =
                format!("must have at most {MAX_NODES} keys and values, including those of aliases");
            return Err(SyntaxError::at(line, message));
        }
        if self.aliases > most {
            let message = format!("must use at most {most} aliases in a file of this size");
            return Err(SyntaxError::at(line, message));
        }
        if self.text_bytes > MAX_TEXT_BYTES {
            let message =
                format!("must have at most {MAX_TEXT_BYTES} bytes of text, including that of aliases");
            self.later.get_or_insert(SyntaxError::at(line, message));
        }
        Ok(())
    }

    fn check_depth(&self, height: usize, line: usize) -> Result<(), SyntaxError> {
        match self.open.len() + height > MAX_DEPTH {
            true => Err(SyntaxError::at(line, too_deep())),
            false => Ok(()),
        }
    }

    fn collection(
        &mut self,
        kind: Kind,
        anchor: usize,
        tag: Option<&Tag>,
        span: &Span,
        line: usize,
    ) -> Result<(), SyntaxError> {
        let is_map = kind == Kind::Map;
        let own_tag = if is_map { "map" } else { "seq" };
        if tag.is_some_and(|tag| tag.core_suffix() != Some(own_tag)) {
            return Err(self.bad_tag(anchor, span));
        }
        self.check_depth(1, line)?;
        let start = self.begin(self.start_line(anchor, span), kind, line)?;
        self.open.push(Open {
            is_map,
            key_line: None,
            anchor,
            start,
            aliases_before: self.aliases,
            text_bytes_before: self.text_bytes,
            height: 0,
        });
        Ok(())
    }

    fn close(&mut self) {
        let Some(open) = self.open.pop() else { return };
        let anchor = Anchor {
            shapes: open.start..self.shapes.len(),
            height: open.height + 1,
            aliases: self.aliases - open.aliases_before,
            text_bytes: self.text_bytes - open.text_bytes_before,
        };
        self.end(open.anchor, anchor);
    }

    fn end(&mut self, anchor: usize, value: Anchor) {
        if let Some(around) = self.open.last_mut() {
            around.height = around.height.max(value.height);
        }
        if anchor > 0 {
            self.anchors.insert(anchor, value);
        }
    }

    /// Adds the value of an alias once more.
    fn alias(&mut self, anchor: usize, line: usize) -> Result<(), SyntaxError> {
        let Some(value) = self.anchors.get(&anchor) else {
            return Err(SyntaxError::at(line, "must not be an alias of a value that contains it"));
        };
        let Anchor { ref shapes, height, aliases, text_bytes } = *value;
        let below = shapes.start + 1..shapes.end;
        let kind = self.shapes[shapes.start].kind;
        self.aliases += aliases + 1;
        self.text_bytes += text_bytes;
        self.check_depth(height, line)?;
        self.begin(line, kind, line)?;
        self.shapes.extend_from_within(below);
        self.check_counts(line)?;
        if let Some(around) = self.open.last_mut() {
            around.height = around.height.max(height);
        }
        Ok(())
    }

    fn explain(&self, error: &ScanError) -> SyntaxError {
        let line = error.marker().line().clamp(1, self.last_line);
        let message = match error.kind() {
            // The parser has its own limit for brackets within a line, which is reached before that of this
            // module.
            ErrorKind::RecursionLimitExceeded if self.open.is_empty() && !self.shapes.is_empty() => {
                SECOND_DOCUMENT.to_owned()
            }
            ErrorKind::RecursionLimitExceeded => too_deep(),
            _ => not_yaml(&error.info()),
        };
        SyntaxError::at(line, message)
    }
}

/// Whether a scalar may be a number, boolean or null; `None` if its tag is not supported or does not fit.
fn is_plain(text: &str, style: ScalarStyle, tag: Option<&Tag>) -> Option<bool> {
    let Some(tag) = tag else { return Some(style == ScalarStyle::Plain) };
    let fits = match tag.core_suffix()? {
        "str" => return Some(false),
        "bool" => text.eq_ignore_ascii_case("true") || text.eq_ignore_ascii_case("false"),
        "int" => serde_yaml::from_str::<i128>(text).is_ok(),
        "float" => serde_yaml::parse_f64(text).is_some(),
        _ => false,
    };
    fits.then_some(true)
}

fn too_deep() -> String {
    format!("must be nested at most {MAX_DEPTH} deep")
}

/// The message for the first words of a parser's error.
pub(super) fn not_yaml(error: &str) -> String {
    let words: String = error.chars().filter(|c| !c.is_control()).take(200).collect();
    format!("not YAML: {words}")
}
