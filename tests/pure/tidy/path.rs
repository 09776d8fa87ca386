//! The path of a small critical sample: the table of docs/ARCHITECTURE.md, how long it may be, and whether it
//! names each function of its files that gets a sample, in the order in which they are called.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use super::source::Rust;

const PAGE: &str = "docs/ARCHITECTURE.md";
const SECTION: &str = "## The path of a sample";
const MAX_FILES: usize = 15;
const MAX_FUNCTIONS: usize = 30;

/// What a function that a sample passes gets or returns.
const SAMPLES: &[&str] = &["Filled", "Payload", "RawPayload", "Received", "ShmSample", "Slot", "TakePayload"];

/// Functions that begin a part of the path: the DDS library, a loop or the end of a sleep calls them, and no
/// function of the path does.
const BEGINNINGS: &[(&str, &str)] = &[
    ("src/process/ingress/receiving.rs", "wake_early"),
    ("src/dds/reader.rs", "raise"),
    ("src/process/ingress/receiving.rs", "turn"),
    ("src/dds/reader.rs", "decode_encapsulated"),
    ("src/shm/wake.rs", "sleep"),
    ("src/process/egress/mod.rs", "sleep"),
    ("src/process/egress/mod.rs", "turn"),
];

/// Functions in files of the path that get a sample and are no part of it, each with the reason.
const NOT_PASSED: &[(&str, &str, &str)] = &[
    ("src/dds/reader.rs", "decode_bytes", "the library has each payload in a `Bytes`"),
    ("src/dds/reader.rs", "decode_lent", "large samples only"),
    ("src/dds/reader.rs", "transform_decoded", "returns its argument to the library"),
    ("src/dds/writer.rs", "to_bytes", "the library reads the payload that it was handed"),
    ("src/dds/writer.rs", "output_encapsulation", "the library reads the payload that it was handed"),
    ("src/process/egress/output.rs", "drop_sample", "counts a sample that is not sent"),
    ("src/process/ingress/pool.rs", "lock", "large samples only"),
    ("src/shm/publisher.rs", "into_slot", "large samples only"),
];

/// The functions of this project in the table of a page, each with its file.
fn path(page: &str) -> Vec<(&str, &str)> {
    let section = page.split(SECTION).nth(1).and_then(|rest| rest.split("\n## ").next()).unwrap_or_default();
    let mut functions = Vec::new();
    for line in section.lines() {
        let [_, _, file, names, _, _] = line.split('|').collect::<Vec<_>>()[..] else { continue };
        let file = file.trim().trim_matches('`');
        if file.starts_with("src/") || file.starts_with("crates/") {
            functions.extend(names.split('`').skip(1).step_by(2).map(|name| (file, name)));
        }
    }
    functions
}

/// A function in a source: its name, whether its signature names a sample, and the functions that it calls.
struct Function {
    name: String,
    gets_sample: bool,
    calls: BTreeSet<String>,
}

/// The functions of a source, without those of its tests, which are at its end.
fn functions(source: &str) -> Vec<Function> {
    let rust = Rust::new(source.split("#[cfg(test)]").next().unwrap_or_default());
    let text = |at: usize| rust.tokens.get(at).map_or("", |token| token.text.as_str());
    let is_name = |at: usize| text(at).starts_with(|c: char| c.is_alphabetic() || c == '_');
    let mut functions = Vec::new();
    for start in (0..rust.tokens.len()).filter(|&at| text(at) == "fn" && is_name(at + 1)) {
        let mut brackets = 0;
        let is_signature = |at: &usize| {
            match text(*at) {
                "[" => brackets += 1,
                "]" => brackets -= 1,
                _ => {}
            }
            // A semicolon in brackets is that of an array's type.
            text(*at) != "{" && (text(*at) != ";" || brackets > 0)
        };
        let signature: Vec<usize> = (start + 2..rust.tokens.len()).take_while(is_signature).collect();
        let body = start + 2 + signature.len();
        let mut calls = BTreeSet::new();
        let mut depth = 0;
        for at in body..rust.tokens.len() {
            match text(at) {
                "{" => depth += 1,
                "}" => depth -= 1,
                name if is_name(at) && text(at + 1) == "(" && text(at - 1) != "fn" => {
                    calls.insert(name.to_owned());
                }
                _ => {}
            }
            if depth == 0 {
                break;
            }
        }
        let gets_sample = signature.iter().any(|&at| SAMPLES.contains(&text(at)));
        functions.push(Function { name: text(start + 1).to_owned(), gets_sample, calls });
    }
    functions
}

/// What is wrong with a path; `read` returns the text of a file.
fn violations(
    path: &[(&str, &str)],
    not_passed: &[(&str, &str, &str)],
    read: &dyn Fn(&str) -> String,
) -> Vec<String> {
    let files: BTreeMap<&str, Vec<Function>> =
        path.iter().map(|(file, _)| (*file, functions(&read(file)))).collect();
    let mut wrong = Vec::new();
    if files.len() > MAX_FILES {
        wrong.push(format!("{} files, at most {MAX_FILES} are allowed", files.len()));
    }
    if path.len() > MAX_FUNCTIONS {
        wrong.push(format!("{} functions, at most {MAX_FUNCTIONS} are allowed", path.len()));
    }
    let named = |file: &str, name: &str| {
        let name = name.to_owned();
        files[file].iter().filter(move |function| function.name == name)
    };
    for (index, (file, name)) in path.iter().enumerate() {
        let before = &path[..index];
        let is_called = || {
            let mut callers = before.iter().flat_map(|(file, caller)| named(file, caller));
            callers.any(|caller| caller.calls.contains(*name))
        };
        if before.contains(&(file, name)) {
            wrong.push(format!("{file}: {name} is listed twice"));
        } else if named(file, name).next().is_none() {
            wrong.push(format!("{file}: no function {name}"));
        } else if !BEGINNINGS.contains(&(file, name)) && !is_called() {
            wrong.push(format!("{file}: no function before {name} calls it"));
        }
    }
    for (file, functions) in &files {
        for Function { name, .. } in functions.iter().filter(|function| function.gets_sample) {
            let is_excepted = not_passed.iter().any(|(known, except, _)| known == file && except == name);
            if !is_excepted && !path.contains(&(*file, name.as_str())) {
                wrong.push(format!("{file}: {name} gets a sample and is not listed"));
            }
        }
    }
    for (file, name, _) in not_passed {
        let is_there = files.contains_key(file) && named(file, name).any(|function| function.gets_sample);
        if !is_there || path.contains(&(*file, *name)) {
            wrong.push(format!("{file}: {name} is no exception"));
        }
    }
    wrong
}

#[test]
fn a_small_critical_sample_passes_at_most_15_files_and_30_functions() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let read = |file: &str| std::fs::read_to_string(root.join(file)).unwrap_or_default();
    let page = read(PAGE);
    let path = path(&page);
    for end in [("src/process/ingress/receiving.rs", "turn"), ("src/dds/writer.rs", "write_from")] {
        assert!(path.contains(&end), "{PAGE} does not list {end:?}: {path:?}");
    }
    let wrong = violations(&path, NOT_PASSED, &read);
    assert!(wrong.is_empty(), "{PAGE}:\n{}", wrong.join("\n"));
}

#[test]
fn a_path_that_is_too_long_or_not_that_of_the_source_is_found() {
    let read = |file: &str| match file {
        "src/shm/wake.rs" => "fn sleep() { x::b(); self.sleep() }".to_owned(),
        "src/b.rs" => "fn b() {}\nfn c();\nfn d(bytes: [u8; N], slot: &Slot) -> Other { e() } // b()\n\
                       #[cfg(test)]\nmod tests { fn f(slot: Slot) { c() } }"
            .to_owned(),
        _ => String::new(),
    };
    let first = ("src/shm/wake.rs", "sleep");
    let (b, c, d) = (("src/b.rs", "b"), ("src/b.rs", "c"), ("src/b.rs", "d"));
    let wrong = |path: &[(&str, &str)]| violations(path, &[], &read);
    assert!(wrong(&[first]).is_empty());
    assert_eq!(wrong(&[first, b]), ["src/b.rs: d gets a sample and is not listed"]);
    let large = [("src/b.rs", "d", "large samples only")];
    assert!(violations(&[first, b], &large, &read).is_empty());
    assert_eq!(violations(&[first], &large, &read), ["src/b.rs: d is no exception"]);
    assert_eq!(violations(&[first, b], &[large[0], ("src/b.rs", "c", "")], &read).len(), 1);
    assert_eq!(wrong(&[first, b, c, d])[0], "src/b.rs: no function before c calls it");
    assert_eq!(violations(&[b, first], &large, &read), ["src/b.rs: no function before b calls it"]);
    assert_eq!(wrong(&[("src/shm/wake.rs", "b")]), ["src/shm/wake.rs: no function b"]);
    assert_eq!(wrong(&[first, first]), ["src/shm/wake.rs: sleep is listed twice"]);
    let files: Vec<String> = (0..=MAX_FILES).map(|number| format!("src/{number}.rs")).collect();
    let long: Vec<(&str, &str)> = files.iter().map(|file| (file.as_str(), "a")).collect();
    assert_eq!(wrong(&long)[0], "16 files, at most 15 are allowed");
    assert_eq!(wrong(&[("src/a.rs", "a"); 31])[0], "31 functions, at most 30 are allowed");
    let page = "x\n## The path of a sample\n| 1 | `src/a.rs` | `a`, `b` | c |\n\
                | 2 | `rustdds/a.rs` | `c` | d |\n## Next\n| 3 | `src/b.rs` | `b` | c |\n";
    assert_eq!(path(page), [("src/a.rs", "a"), ("src/a.rs", "b")]);
}
