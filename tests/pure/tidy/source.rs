//! Finds the files of the project, and parses Rust as far as the rules need: tokens, comments and paths.

use std::fs;
use std::path::{Path, PathBuf};

/// A file: its path from the root of the project, with `/`, and its text.
pub struct SourceFile {
    pub path: String,
    pub text: String,
}

/// Every file below `folder` with that extension; none if the folder does not exist.
pub fn files(folder: &str, extension: &str) -> Vec<SourceFile> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut found = Vec::new();
    walk(root, &root.join(folder), extension, &mut found);
    found.sort_by(|one, other| one.path.cmp(&other.path));
    found
}

fn walk(root: &Path, folder: &Path, extension: &str, found: &mut Vec<SourceFile>) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries {
        let path: PathBuf = entry.unwrap().path();
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        let relative = path.strip_prefix(root).unwrap().to_string_lossy().into_owned();
        // Build results, git's data and third-party code.
        let foreign =
            ["target", "third_party", ".git"].contains(&relative.as_str()) || name == "node_modules";
        if path.is_dir() && !foreign {
            walk(root, &path, extension, found);
        } else if path.extension().is_some_and(|found| found == extension) {
            let text = fs::read_to_string(&path).unwrap_or_else(|error| panic!("{relative}: {error}"));
            found.push(SourceFile { path: relative, text });
        }
    }
}

/// A token of code: a word, `::`, or one other character. A string or character is an empty pair of quotes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Token {
    pub line: usize,
    pub text: String,
}

/// The parts of a Rust source.
#[derive(Default)]
pub struct Rust {
    pub tokens: Vec<Token>,
    /// Comments, without nesting, with the line on which they begin.
    pub comments: Vec<Token>,
    /// The first and the last line of each string.
    pub strings: Vec<(usize, usize)>,
}

impl Rust {
    pub fn new(text: &str) -> Self {
        let chars: Vec<char> = text.chars().collect();
        let mut rust = Self::default();
        let (mut at, mut line) = (0, 1);
        while at < chars.len() {
            let start = at;
            let rest = &chars[at..];
            let kind = if rest.starts_with(&['/', '/']) {
                at += rest.iter().position(|&c| c == '\n').unwrap_or(rest.len());
                Kind::Comment
            } else if rest.starts_with(&['/', '*']) {
                at += block_comment(rest);
                Kind::Comment
            } else if let Some(length) = string(rest) {
                at += length;
                Kind::String
            } else if chars[at].is_alphanumeric() || chars[at] == '_' {
                at += rest.iter().position(|&c| !c.is_alphanumeric() && c != '_').unwrap_or(rest.len());
                Kind::Code
            } else {
                at += if rest.starts_with(&[':', ':']) { 2 } else { 1 };
                if chars[start].is_whitespace() { Kind::Space } else { Kind::Code }
            };
            let text: String = match kind {
                Kind::String => "\"\"".to_owned(),
                _ => chars[start..at].iter().collect(),
            };
            match kind {
                Kind::Comment => rust.comments.push(Token { line, text }),
                Kind::String | Kind::Code => rust.tokens.push(Token { line, text }),
                Kind::Space => {}
            }
            let first = line;
            line += chars[start..at].iter().filter(|&&c| c == '\n').count();
            if matches!(kind, Kind::String) {
                rust.strings.push((first, line));
            }
        }
        rust
    }

    /// Whether the token at `at` and those after it are these.
    pub fn reads(&self, at: usize, texts: &[&str]) -> bool {
        let tokens = self.tokens.get(at..at + texts.len());
        tokens.is_some_and(|tokens| tokens.iter().zip(texts).all(|(token, text)| token.text == *text))
    }

    /// Every path of two names or more, and every name that is imported; groups are written out.
    pub fn paths(&self) -> Vec<SourcePath> {
        let mut paths = Vec::new();
        let mut at = 0;
        let mut modules = Modules::default();
        while at < self.tokens.len() {
            modules.step(self, at);
            let imported = self.reads(at, &["use"]);
            let begins = imported || (self.is_name(at) && self.reads(at + 1, &["::"]));
            if begins {
                let first = paths.len();
                at = self.tree(at + usize::from(imported), &[], &mut paths);
                for path in &mut paths[first..] {
                    path.inline_modules = modules.depth();
                }
                paths.retain(|path: &SourcePath| path.names.len() > 1 || path.imported);
                for path in paths.iter_mut().skip(first) {
                    path.imported = imported;
                }
            } else {
                at += 1;
            }
        }
        paths
    }

    fn is_name(&self, at: usize) -> bool {
        self.tokens.get(at).is_some_and(|token| {
            token.text == "*" || token.text.starts_with(|c: char| c.is_alphabetic() || c == '_')
        })
    }

    /// Reads `a::b::{c, d::e}` from `at` on, and returns where it ends.
    fn tree(&self, mut at: usize, prefix: &[String], paths: &mut Vec<SourcePath>) -> usize {
        let mut names = prefix.to_vec();
        let line = self.tokens.get(at).map_or(0, |token| token.line);
        if self.reads(at, &["::"]) {
            at += 1;
        }
        while self.is_name(at) {
            names.push(self.tokens[at].text.clone());
            at += 1;
            if !self.reads(at, &["::"]) {
                break;
            }
            at += 1;
            if self.reads(at, &["{"]) {
                at += 1;
                while at < self.tokens.len() && !self.reads(at, &["}"]) {
                    let end = self.tree(at, &names, paths);
                    // Not a name, so the braces are not a group of imports.
                    at = if end == at { at + 1 } else { end };
                    while at < self.tokens.len() && !self.reads(at, &[","]) && !self.reads(at, &["}"]) {
                        at += 1;
                    }
                    at += usize::from(self.reads(at, &[","]));
                }
                return at + 1;
            }
        }
        if names.len() > prefix.len() {
            paths.push(SourcePath { line, names, imported: true, inline_modules: 0 });
        }
        at
    }
}

enum Kind {
    Comment,
    String,
    Code,
    Space,
}

/// A path in code, such as `crate::model::Guid`.
#[derive(Clone, Debug)]
pub struct SourcePath {
    pub line: usize,
    pub names: Vec<String>,
    /// Whether it is in a `use`.
    pub imported: bool,
    /// The number of inline modules of the file that contain it.
    pub inline_modules: usize,
}

impl SourcePath {
    pub fn starts_with(&self, names: &[&str]) -> bool {
        self.names.len() >= names.len() && self.names.iter().zip(names).all(|(one, other)| one == other)
    }

    pub fn text(&self) -> String {
        self.names.join("::")
    }
}

/// The inline modules (`mod name { … }`) that contain a token.
#[derive(Default)]
struct Modules {
    braces: usize,
    open: Vec<usize>,
}

impl Modules {
    fn step(&mut self, rust: &Rust, at: usize) {
        match rust.tokens[at].text.as_str() {
            "{" => {
                self.braces += 1;
                if at >= 2 && rust.reads(at - 2, &["mod"]) {
                    self.open.push(self.braces);
                }
            }
            "}" => {
                if self.open.last() == Some(&self.braces) {
                    self.open.pop();
                }
                self.braces = self.braces.saturating_sub(1);
            }
            _ => {}
        }
    }

    fn depth(&self) -> usize {
        self.open.len()
    }
}

fn block_comment(text: &[char]) -> usize {
    let (mut depth, mut at) = (0, 0);
    while at < text.len() {
        if text[at..].starts_with(&['/', '*']) {
            depth += 1;
            at += 2;
        } else if text[at..].starts_with(&['*', '/']) {
            depth -= 1;
            at += 2;
            if depth == 0 {
                break;
            }
        } else {
            at += 1;
        }
    }
    at
}

/// The length of the string or character that `text` begins with, if it does.
fn string(text: &[char]) -> Option<usize> {
    let prefix = text.iter().take(2).take_while(|c| matches!(c, 'b' | 'c' | 'r')).count();
    let raw = prefix > 0 && text[prefix - 1] == 'r';
    let after = text.get(prefix..)?;
    let hashes = if raw { after.iter().take_while(|&&c| c == '#').count() } else { 0 };
    match after.get(hashes)? {
        '"' if raw => {
            let end: Vec<char> = std::iter::once('"').chain(std::iter::repeat_n('#', hashes)).collect();
            let body = &after[hashes + 1..];
            let length = body.windows(end.len()).position(|window| window == end)?;
            Some(prefix + hashes + 1 + length + end.len())
        }
        '"' => Some(prefix + quoted(after, '"')),
        // A lifetime has no closing quote behind its first character.
        '\'' if prefix == 0 || text[0] == 'b' => {
            let is_char = after.get(1) == Some(&'\\') || after.get(2) == Some(&'\'');
            is_char.then(|| prefix + quoted(after, '\''))
        }
        _ => None,
    }
}

fn quoted(text: &[char], quote: char) -> usize {
    let mut at = 1;
    while at < text.len() && text[at] != quote {
        at += if text[at] == '\\' { 2 } else { 1 };
    }
    (at + 1).min(text.len())
}

#[test]
fn code_comments_and_strings_are_distinguished() {
    let text = "a::b /* x /* y */ z */ \"c \\\" // d\" r#\"e\" f\"# 'g' '\\'' &'h str // i\n/// j\nb\"k\" 'l";
    let rust = Rust::new(text);
    let tokens: Vec<&str> = rust.tokens.iter().map(|token| token.text.as_str()).collect();
    let string = "\"\"";
    assert_eq!(
        tokens,
        ["a", "::", "b", string, string, string, string, "&", "'", "h", "str", string, "'", "l"]
    );
    let comments: Vec<(usize, &str)> =
        rust.comments.iter().map(|comment| (comment.line, comment.text.as_str())).collect();
    assert_eq!(comments, [(1, "/* x /* y */ z */"), (1, "// i"), (2, "/// j")]);
}

#[test]
fn groups_of_imports_are_written_out() {
    let rust =
        Rust::new("use a::{b, c::{self, d as e}, f::*}; use g; fn h() { i::j(k) } mod l { use m::n; }");
    let paths = rust.paths();
    let texts: Vec<String> = paths.iter().map(SourcePath::text).collect();
    assert_eq!(texts, ["a::b", "a::c::self", "a::c::d", "a::f::*", "g", "i::j", "m::n"]);
    let depths: Vec<usize> = paths.iter().map(|path| path.inline_modules).collect();
    assert_eq!(depths, [0, 0, 0, 0, 0, 0, 1]);
}
