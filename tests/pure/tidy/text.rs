//! The form of a file of Rust: sizes, words, `unsafe`.

use super::source::{Rust, SourceFile, files};

const MAX_COLUMNS: usize = 110;
/// The limit of a line with a string, which rustfmt does not break: a search for the words of a message finds
/// it only if it is in one line.
const MAX_STRING_COLUMNS: usize = 120;
/// The limit of files of libraries and programs. Tests may be longer.
const MAX_LINES: usize = 600;
/// The limit of the root of a program, which only dispatches.
const MAX_MAIN_LINES: usize = 20;

/// Files that may contain `unsafe`, each for a purpose that safe Rust cannot serve.
const UNSAFE: &[&str] = &[
    // Memory that other processes write, and the futex in it.
    "src/shm/cell.rs",
    "src/shm/header.rs",
    "src/shm/pool_view.rs",
    "src/shm/publisher.rs",
    "src/shm/segment.rs",
    "src/shm/service.rs",
    "src/shm/subscriber.rs",
    "src/shm/wake.rs",
    // File descriptors that come from another process.
    "src/process/kept_sockets.rs",
    // System calls without a safe wrapper.
    "src/process/allocator.rs",
    "src/process/scheduling.rs",
    // Code of a child process between fork and exec.
    "benches/hop/beds.rs",
    "src/cli/demo/children.rs",
    "tests/support/process.rs",
    // A thread that is traced, and so stopped by itself.
    "tests/support/machine.rs",
    // Scheduling of the benchmark and of threads that measure delays of CPUs, and an allocator that counts.
    "benches/hop/system.rs",
    "tests/support/cpu_delay.rs",
    "tests/dds/allocations.rs",
    "tests/shm/main.rs",
];

/// The violations of the rules in a file of Rust.
fn violations(path: &str, text: &str) -> Vec<String> {
    let rust = Rust::new(text);
    let mut found = Vec::new();
    let mut say = |line: usize, what: &str| found.push(format!("{path}:{line}: {what}"));
    let lines: Vec<&str> = text.lines().collect();
    for (index, line) in lines.iter().enumerate() {
        let columns = line.chars().count();
        let in_string = |&(first, last): &(usize, usize)| (first..=last).contains(&(index + 1));
        let max = if rust.strings.iter().any(in_string) { MAX_STRING_COLUMNS } else { MAX_COLUMNS };
        if columns > max {
            say(index + 1, &format!("{columns} columns, at most {max}"));
        }
    }
    if is_shipped(path) && lines.len() > MAX_LINES {
        say(lines.len(), &format!("{} lines, at most {MAX_LINES}", lines.len()));
    }
    if is_program(path) && lines.len() > MAX_MAIN_LINES {
        say(lines.len(), "the root of a program does more than dispatch");
    }
    for (at, token) in rust.tokens.iter().enumerate() {
        match token.text.as_str() {
            "ignore" if at >= 2 && rust.reads(at - 2, &["#", "["]) => say(token.line, "an ignored test"),
            "unsafe" if !UNSAFE.contains(&path) => say(token.line, "unsafe in a file that is not listed"),
            _ => {}
        }
    }
    for comment in &rust.comments {
        let words = |word: &&str| ["TODO", "FIXME", "XXX"].contains(word);
        let is_word = |c: char| !c.is_alphanumeric();
        for (offset, line) in comment.text.lines().enumerate() {
            if let Some(word) = line.split(is_word).find(words) {
                say(comment.line + offset, word);
            }
        }
    }
    found
}

/// Whether a file belongs to a library or program, and not to tests or benchmarks.
fn is_shipped(path: &str) -> bool {
    path.starts_with("src/") || (path.starts_with("crates/") && path.contains("/src/"))
}

/// Whether a file is the root of a program.
fn is_program(path: &str) -> bool {
    is_shipped(path) && path.ends_with("src/main.rs")
}

fn rust_files() -> Vec<SourceFile> {
    ["src", "crates", "tests", "benches", "fuzz"].iter().flat_map(|folder| files(folder, "rs")).collect()
}

#[test]
fn every_file_keeps_to_sizes_words_and_the_list_of_unsafe() {
    let sources = rust_files();
    assert!(sources.len() > 60, "{} files", sources.len());
    let found: Vec<String> =
        sources.iter().flat_map(|source| violations(&source.path, &source.text)).collect();
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn programs_only_dispatch() {
    let mut programs = rust_files();
    programs.retain(|source| is_program(&source.path));
    assert!(programs.len() >= 2, "{} programs", programs.len());
    for program in programs {
        let rust = Rust::new(&program.text);
        let functions = rust.tokens.iter().filter(|token| token.text == "fn").count();
        assert_eq!(functions, 1, "{} has functions beside main", program.path);
    }
}

#[test]
fn what_breaks_a_rule_is_found() {
    let long_line = format!("// {}", "x".repeat(MAX_COLUMNS));
    let long_string = format!("\n\"{}\"", "x".repeat(MAX_STRING_COLUMNS - 1));
    let many_lines = "\n".repeat(MAX_LINES + 1);
    let long_main = "\n".repeat(MAX_MAIN_LINES + 1);
    for (path, text, what) in [
        ("src/a.rs", long_line.as_str(), ":1: 113 columns"),
        ("src/a.rs", &long_string, ":2: 121 columns"),
        ("src/a.rs", &many_lines, "601 lines"),
        ("crates/a/src/b.rs", &many_lines, "601 lines"),
        ("src/main.rs", &long_main, "more than dispatch"),
        ("crates/a/src/main.rs", &long_main, "more than dispatch"),
        ("tests/a.rs", "#[test]\n#[ignore]\nfn a() {}", ":2: an ignored test"),
        ("tests/a.rs", "#[ignore = \"slow\"]\nfn a() {}", "an ignored test"),
        ("src/a.rs", "// TODO: b", "TODO"),
        ("src/a.rs", "/* b\n FIXME c */", ":2: FIXME"),
        ("src/a.rs", "fn a() { unsafe { b() } }", "not listed"),
    ] {
        let found = violations(path, text).join("\n");
        assert!(found.contains(what), "{path}: {text:.60}: found: {found}");
    }
}

#[test]
fn what_is_allowed_is_not_found() {
    for (path, text) in [
        ("src/a.rs", "const A: &str = \"TODO todo!() unsafe { }\"; // a todo list of a dbg"),
        (
            "src/shm/wake.rs",
            "fn a() {\n    // SAFETY: b\n    // and c.\n    let d =\n        unsafe { e() };\n}",
        ),
        ("src/shm/wake.rs", "// SAFETY: b.\nunsafe impl A for B {}"),
        ("src/shm/wake.rs", "/// # Safety\n/// b\nunsafe trait A {}"),
        ("src/a.rs", "fn ignore() {} #[allow(dead_code)] fn todo() {}"),
    ] {
        let found = violations(path, text);
        assert!(found.is_empty(), "{path}: {text}: found: {}", found.join("\n"));
    }
    assert!(violations("tests/a.rs", &"\n".repeat(MAX_LINES + 1)).is_empty());
    assert!(violations("src/a.rs", &format!("\"{}\"", "x".repeat(MAX_STRING_COLUMNS - 2))).is_empty());
}
