//! The path of a small critical sample: the table of docs/ARCHITECTURE.md, and how long it may be.

use std::collections::BTreeSet;
use std::path::Path;

const PAGE: &str = "docs/ARCHITECTURE.md";
const SECTION: &str = "## The path of a sample";
const MAX_FILES: usize = 15;
const MAX_FUNCTIONS: usize = 30;

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

/// What is wrong with a path; `read` returns the text of a file.
fn violations(path: &[(&str, &str)], read: &dyn Fn(&str) -> String) -> Vec<String> {
    let files: BTreeSet<&str> = path.iter().map(|(file, _)| *file).collect();
    let mut wrong = Vec::new();
    if files.len() > MAX_FILES {
        wrong.push(format!("{} files, at most {MAX_FILES} are allowed", files.len()));
    }
    if path.len() > MAX_FUNCTIONS {
        wrong.push(format!("{} functions, at most {MAX_FUNCTIONS} are allowed", path.len()));
    }
    let source: String = files.iter().map(|file| read(file)).collect();
    for (index, (file, name)) in path.iter().enumerate() {
        let defines = |text: &str| ["(", "<"].iter().any(|end| text.contains(&format!("fn {name}{end}")));
        if path[..index].contains(&(file, name)) {
            wrong.push(format!("{file}: {name} is listed twice"));
        } else if !defines(&read(file)) {
            wrong.push(format!("{file}: no function {name}"));
        } else if *name != LIBRARY_CALLS && !calls(&source, name) {
            wrong.push(format!("{file}: no file of the path calls {name}"));
        }
    }
    wrong
}

/// Whether a source calls a function of that name.
fn calls(source: &str, name: &str) -> bool {
    let is_call = |before: &str| {
        !before.ends_with("fn ") && !before.ends_with(|c: char| c.is_alphanumeric() || c == '_')
    };
    source.match_indices(&format!("{name}(")).any(|(at, _)| is_call(&source[..at]))
}

/// Called by the DDS library, which the path does not list.
const LIBRARY_CALLS: &str = "decode_encapsulated";

#[test]
fn a_small_critical_sample_passes_at_most_15_files_and_30_functions() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let read = |file: &str| std::fs::read_to_string(root.join(file)).unwrap_or_default();
    let page = read(PAGE);
    let path = path(&page);
    for end in [("src/process/ingress/receiving.rs", "turn"), ("src/dds/writer.rs", "write_from")] {
        assert!(path.contains(&end), "{PAGE} does not list {end:?}: {path:?}");
    }
    let wrong = violations(&path, &read);
    assert!(wrong.is_empty(), "{PAGE}:\n{}", wrong.join("\n"));
}

#[test]
fn a_path_that_is_too_long_or_not_that_of_the_source_is_found() {
    let read = |file: &str| match file {
        "src/a.rs" => "fn a() { x::b(); self.a() }".to_owned(),
        "src/b.rs" => "fn b() {}\nfn c() {}".to_owned(),
        _ => String::new(),
    };
    let wrong = |path: &[(&str, &str)]| violations(path, &read);
    assert!(wrong(&[("src/a.rs", "a"), ("src/b.rs", "b")]).is_empty());
    assert_eq!(wrong(&[("src/b.rs", "c")]), ["src/b.rs: no file of the path calls c"]);
    assert_eq!(wrong(&[("src/a.rs", "b")]), ["src/a.rs: no function b"]);
    assert_eq!(wrong(&[("src/a.rs", "a"), ("src/a.rs", "a")]), ["src/a.rs: a is listed twice"]);
    let files: Vec<String> = (0..=MAX_FILES).map(|number| format!("src/{number}.rs")).collect();
    let long: Vec<(&str, &str)> = files.iter().map(|file| (file.as_str(), "a")).collect();
    assert_eq!(wrong(&long)[0], "16 files, at most 15 are allowed");
    assert_eq!(wrong(&[("src/a.rs", "a"); 31])[0], "31 functions, at most 30 are allowed");
    let page = "x\n## The path of a sample\n| 1 | `src/a.rs` | `a`, `b` | c |\n\
                | 2 | `rustdds/a.rs` | `c` | d |\n## Next\n| 3 | `src/b.rs` | `b` | c |\n";
    assert_eq!(path(page), [("src/a.rs", "a"), ("src/a.rs", "b")]);
}
