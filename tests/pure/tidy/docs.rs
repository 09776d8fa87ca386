//! Checks of the documents: links lead to files, promises and mutations name tests, numbers of decisions are
//! unique, there is a changelog.

use std::collections::BTreeMap;
use std::path::{Component, Path, PathBuf};

use support::root;

use super::source::{Rust, SourceFile, files};

/// Links of a page that lead nowhere. `exists` answers for paths from the root of the project.
fn dead_links(path: &str, text: &str, exists: &dyn Fn(&Path) -> bool) -> Vec<String> {
    let folder = Path::new(path).parent().unwrap_or(Path::new(""));
    let mut fenced = false;
    let mut dead = Vec::new();
    for (index, line) in text.lines().enumerate() {
        if line.trim_start().starts_with("```") {
            fenced = !fenced;
        }
        if fenced {
            continue;
        }
        for target in line.split("](").skip(1).filter_map(|rest| rest.split(')').next()) {
            let target = target.split(' ').next().unwrap_or_default();
            let file = target.split('#').next().unwrap_or_default();
            let elsewhere = target.contains("://") || target.starts_with("mailto:");
            if !elsewhere && !file.is_empty() && !normal(&folder.join(file)).is_some_and(|path| exists(&path))
            {
                dead.push(format!("{path}:{}: {target}", index + 1));
            }
        }
    }
    dead
}

/// The path without `.` and `..`; `None` when it leaves the project.
fn normal(path: &Path) -> Option<PathBuf> {
    let mut normal = PathBuf::new();
    for component in path.components() {
        match component {
            Component::CurDir => {}
            Component::ParentDir => {
                if !normal.pop() {
                    return None;
                }
            }
            Component::Normal(name) => normal.push(name),
            Component::RootDir | Component::Prefix(_) => return None,
        }
    }
    Some(normal)
}

/// What is wrong with the names of decision records, `NNNN-words.md` each with a number of its own.
fn bad_records(names: &[&str]) -> Vec<String> {
    let mut bad = Vec::new();
    let mut numbers: BTreeMap<&str, &str> = BTreeMap::new();
    for name in names {
        let number = name.split('-').next().unwrap_or_default();
        if number.len() != 4 || !number.chars().all(|c| c.is_ascii_digit()) || !name.ends_with(".md") {
            bad.push(format!("{name} is not NNNN-words.md"));
        } else if let Some(other) = numbers.insert(number, name) {
            bad.push(format!("{name} has the number of {other}"));
        }
    }
    bad
}

#[test]
fn every_relative_link_leads_to_a_file() {
    let pages = files("", "md");
    assert!(pages.iter().any(|page| page.path == "config/README.md"), "no pages are found");
    let exists = |path: &Path| root().join(path).exists();
    let dead: Vec<String> =
        pages.iter().flat_map(|page| dead_links(&page.path, &page.text, &exists)).collect();
    assert!(dead.is_empty(), "{}", dead.join("\n"));
}

#[test]
fn the_pages_to_read_first_are_short() {
    let limits = [("README.md", 150), ("docs/ARCHITECTURE.md", 200), ("docs/performance.md", 150)];
    for (page, max_lines) in limits {
        let lines = std::fs::read_to_string(root().join(page)).unwrap().lines().count();
        assert!(lines <= max_lines, "{page}: {lines} lines, at most {max_lines}");
    }
}

#[test]
fn no_page_has_the_markers_of_an_unresolved_merge() {
    let is_marker = |line: &str| line.starts_with("<<<<<<< ") || line.starts_with(">>>>>>> ");
    assert!(is_marker("<<<<<<< HEAD") && is_marker(">>>>>>> main") && !is_marker("# Merge"));
    for page in files("", "md") {
        assert!(!page.text.lines().any(is_marker), "{}", page.path);
    }
}

#[test]
fn every_page_that_the_source_names_is_there() {
    let mut named = 0;
    for source in ["src", "crates", "tests", "benches"].iter().flat_map(|folder| files(folder, "rs")) {
        for comment in Rust::new(&source.text).comments {
            let words = comment.text.split(|c: char| c.is_whitespace() || "`()[],;:'\"".contains(c));
            for word in words.filter(|word| word.starts_with("docs/") && word.ends_with(".md")) {
                named += 1;
                assert!(root().join(word).exists(), "{}:{}: {word}", source.path, comment.line);
            }
        }
    }
    assert!(named > 0, "no page is named anywhere");
}

/// The files that a line of a guide names in back quotes, and its functions: those of a table's row with the
/// cells number, file, function and remark.
fn files_and_functions(line: &str) -> (Vec<String>, Vec<String>) {
    const FOLDERS: [&str; 9] =
        ["src/", "crates/", "tests/", "benches/", "config/", "docs/", "fuzz/", "scripts/", "rustdds/"];
    let quoted =
        |text: &str| -> Vec<String> { text.split('`').skip(1).step_by(2).map(str::to_owned).collect() };
    let is_file = |word: &String| {
        FOLDERS.iter().any(|folder| word.starts_with(folder)) && !word.contains(['<', '*', ' ', 'N'])
    };
    let files: Vec<String> = quoted(line).into_iter().filter(is_file).collect();
    let cells: Vec<&str> = line.split('|').collect();
    let functions = match cells[..] {
        [_, _, file, functions, _, _] if quoted(file).iter().any(is_file) => quoted(functions),
        _ => Vec::new(),
    };
    (files, functions)
}

#[test]
fn every_file_and_function_that_the_guides_name_is_there() {
    let mut named = 0;
    for page in ["docs/ARCHITECTURE.md", "CONTRIBUTING.md"] {
        for line in std::fs::read_to_string(root().join(page)).unwrap().lines() {
            let (files, functions) = files_and_functions(line);
            let paths: Vec<PathBuf> = files
                .iter()
                .map(|file| match file.strip_prefix("rustdds/") {
                    Some(inside) => root().join("third_party/rustdds/src").join(inside),
                    None => root().join(file),
                })
                .collect();
            for path in &paths {
                assert!(path.exists(), "{page}: {}", path.display());
            }
            for function in functions {
                let source = std::fs::read_to_string(&paths[0]).unwrap();
                let is_there = ["(", "<"].iter().any(|end| source.contains(&format!("fn {function}{end}")));
                assert!(is_there, "{page}: no function {function} in {}", paths[0].display());
                named += 1;
            }
        }
    }
    assert!(named > 10, "{named} functions are named");
}

/// The tests that a text names in back quotes after the file that has them.
fn tests_by_file(text: &str) -> Vec<(&str, &str)> {
    let mut file = "";
    let mut tests = Vec::new();
    for word in text.split('`').skip(1).step_by(2) {
        if word.ends_with(".rs") {
            file = word;
        } else if word.matches('_').count() > 1 && word.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
        {
            tests.push((file, word));
        }
    }
    tests
}

/// The cells of each row of a page's tables, without the heads.
fn rows(page: &str) -> Vec<Vec<&str>> {
    let mut is_below_head = false;
    let mut rows = Vec::new();
    for line in page.lines() {
        let cells = line.strip_prefix('|').and_then(|line| line.strip_suffix('|'));
        match cells {
            Some(cells) if cells.starts_with("---") => is_below_head = true,
            Some(cells) if is_below_head => rows.push(cells.split('|').map(str::trim).collect()),
            Some(_) => {}
            None => is_below_head = false,
        }
    }
    rows
}

/// What is wrong with a row of docs/promises.md, which has the cells promise, test and mutation. `mutations`
/// are rows of docs/mutations.md, with the cells place, mutation and test that failed.
fn bad_promise(row: &[&str], mutations: &[Vec<&str>]) -> Option<String> {
    let [promise, tests, mutation] = row else {
        return Some(format!("{} cells instead of 3: {}", row.len(), row.join(" | ")));
    };
    let tests = tests_by_file(tests);
    if tests.is_empty() {
        return Some(format!("no test: {promise}"));
    }
    let is_named = |name: &str| tests.iter().any(|(_, test)| *test == name);
    let has_failed = mutations.iter().any(|row| match row[..] {
        [_, broken, failed] => {
            broken == *mutation && tests_by_file(failed).iter().any(|(_, test)| is_named(test))
        }
        _ => false,
    });
    (!has_failed).then(|| format!("none of its tests has failed for '{mutation}': {promise}"))
}

#[test]
fn each_promise_has_a_test_and_a_mutation_that_it_noticed() {
    let read = |page: &str| std::fs::read_to_string(root().join(page)).unwrap();
    let (promises, mutations) = (read("docs/promises.md"), read("docs/mutations.md"));
    let (promises, mutations) = (rows(&promises), rows(&mutations));
    assert!(promises.len() > 100 && mutations.len() > 100, "{} and {}", promises.len(), mutations.len());
    let bad: Vec<String> = promises.iter().filter_map(|row| bad_promise(row, &mutations)).collect();
    assert!(bad.is_empty(), "{}", bad.join("\n"));
}

/// What is wrong with the test files that docs/mutations.md names: each has a row of a mutation, or else one
/// with the reason for having none.
fn bad_test_files(page: &str, files: &[&str]) -> Vec<String> {
    let Some((with, without)) = page.split_once("\n## Test files without a mutation\n") else {
        return vec!["no section for the test files without a mutation".to_owned()];
    };
    let (with, without) = (rows(with), rows(without));
    let names = |rows: &[Vec<&str>], file: &str| rows.iter().any(|row| row[0] == format!("`{file}`"));
    let mut bad = Vec::new();
    for file in files {
        match (names(&with, file), names(&without, file)) {
            (false, false) => bad.push(format!("{file} has neither a mutation nor a reason for having none")),
            (true, true) => bad.push(format!("{file} has a mutation: remove it from those without one")),
            (true, false) | (false, true) => {}
        }
    }
    for row in without {
        if !files.iter().any(|file| row[0] == format!("`{file}`")) {
            bad.push(format!("{} is no test file", row[0]));
        }
        if row.get(1).is_none_or(|reason| reason.is_empty()) {
            bad.push(format!("{} has no reason", row[0]));
        }
    }
    bad
}

#[test]
fn every_test_file_has_a_mutation_or_a_reason_for_having_none() {
    let found: Vec<SourceFile> = ["tests", "crates"].iter().flat_map(|folder| files(folder, "rs")).collect();
    let is_program = |path: &str| path.starts_with("tests/") || path.split('/').nth(2) == Some("tests");
    let tests: Vec<&str> = found
        .iter()
        .filter(|file| is_program(&file.path) && file.text.contains("#[test]"))
        .map(|file| file.path.as_str())
        .collect();
    for known in
        ["tests/testbed.rs", "tests/dds/cli.rs", "tests/pure/tidy/docs.rs", "crates/eval/tests/eval.rs"]
    {
        assert!(tests.contains(&known), "{known} is not in {tests:?}");
    }
    let page = std::fs::read_to_string(root().join("docs/mutations.md")).unwrap();
    let bad = bad_test_files(&page, &tests);
    assert!(bad.is_empty(), "{}", bad.join("\n"));
}

#[test]
fn every_file_and_test_that_the_pages_of_rustdds_and_of_promises_name_is_there() {
    let read = |file: &str| {
        let path = match file.strip_prefix("rustdds/") {
            Some(inside) => root().join("third_party/rustdds/src").join(inside),
            None => root().join(file),
        };
        std::fs::read_to_string(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
    };
    let [changes, promises] = ["docs/rustdds-changes.md", "docs/promises.md"].map(read);
    for line in changes.lines().chain(promises.lines()) {
        files_and_functions(line).0.iter().filter(|file| file.ends_with(".rs")).for_each(|file| {
            read(file);
        });
    }
    let promised = rows(&promises).into_iter().filter_map(|row| row.get(1).copied()).flat_map(tests_by_file);
    for tests in [tests_by_file(&changes), promised.collect()] {
        assert!(tests.len() > 30, "{} tests", tests.len());
        for (file, test) in tests {
            assert!(read(file).contains(&format!("fn {test}(")), "no test {test} in {file}");
        }
    }
}

#[test]
fn every_decision_record_has_a_number_of_its_own() {
    let records: Vec<String> = files("docs/decisions", "md").into_iter().map(|page| page.path).collect();
    let names: Vec<&str> = records.iter().filter_map(|path| path.rsplit('/').next()).collect();
    assert!(names.len() >= 3, "{names:?}");
    let bad = bad_records(&names);
    assert!(bad.is_empty(), "{}", bad.join("\n"));
}

#[test]
fn the_changelog_has_a_section_for_what_is_not_released() {
    let text = std::fs::read_to_string(root().join("CHANGELOG.md")).unwrap();
    let headings: Vec<&str> = text.lines().filter_map(|line| line.strip_prefix("## ")).collect();
    let first = headings.first().map(|heading| heading.trim_matches(['[', ']']));
    assert_eq!(first, Some("Unreleased"));
}

#[test]
fn the_documentation_of_the_configuration_keys_is_tested() {
    let text = std::fs::read_to_string(root().join("tests/pure/config.rs")).unwrap();
    for test in [
        "every_key_is_documented_and_every_documented_key_exists",
        "every_key_is_in_the_default_file",
        "the_tables_of_the_documentation_are_made_of_the_rows",
        "the_default_file_has_the_defaults_of_the_rows",
    ] {
        assert!(text.contains(&format!("#[test]\nfn {test}()")), "tests/pure/config.rs has no test {test}");
    }
}

/// The cells of the README's table of the evaluation, as the report of it has them for one library: without
/// the bridge, and with it.
fn evaluation_cells(report: &str, library: &str) -> Vec<[String; 2]> {
    let first = format!("{library}, strong loss as run");
    let rows = rows(report);
    let row = rows.iter().find(|row| row[0].starts_with(&first)).expect("a row of the library");
    let [rate_hz, p95_ms, gap_ms, lost] = [1, 2, 3, 4].map(|column| row[column].split_once(" → ").unwrap());
    let pair = |(without, with): (&str, &str), cell: &dyn Fn(f64, &str) -> String| {
        [without, with].map(|text| cell(text.replace(',', "").parse().unwrap(), text))
    };
    let seconds = |ms: f64, _: &str| match ms / 1e3 {
        s if s < 1.0 => format!("{s:.2} s"),
        s => format!("{s:.1} s"),
    };
    let [without, with] = pair(rate_hz, &|hz, _| format!("{hz:.1} Hz"));
    vec![
        [format!("{without} of 30"), with],
        pair(gap_ms, &seconds),
        pair(p95_ms, &|ms, text| if ms < 100.0 { format!("{ms:.1} ms") } else { format!("{text} ms") }),
        pair(lost, &|_, text| text.to_owned()),
    ]
}

#[test]
fn the_figures_of_the_readme_are_those_of_the_evaluation() {
    let readme = std::fs::read_to_string(root().join("README.md")).unwrap();
    let link = readme.split("docs/evaluation/").nth(1).and_then(|rest| rest.split('/').next()).unwrap();
    let report = root().join("docs/evaluation").join(link).join("report.md");
    let report = std::fs::read_to_string(report).unwrap();
    let (fast, cyclone) = (evaluation_cells(&report, "Fast DDS"), evaluation_cells(&report, "Cyclone DDS"));
    let expected: Vec<Vec<String>> =
        fast.into_iter().zip(cyclone).map(|(fast, cyclone)| [fast, cyclone].concat()).collect();
    let rows = rows(&readme);
    let of_table = rows.iter().skip_while(|row| row[0] != "publisher").take(expected.len());
    let found: Vec<&[&str]> = of_table.map(|row| &row[1..]).collect();
    assert_eq!(found, expected);
}

#[test]
fn dead_links_and_bad_records_are_found() {
    let exists = |path: &Path| path == Path::new("docs/there.md");
    let dead = |path: &str, text: &str| dead_links(path, text, &exists);
    assert_eq!(dead("docs/a.md", "x\n[b](gone.md#c) [d](there.md)"), ["docs/a.md:2: gone.md#c"]);
    assert_eq!(dead("docs/x/a.md", "[b](../there.md)[c](there.md)"), ["docs/x/a.md:1: there.md"]);
    assert_eq!(dead("a.md", "[b](../docs/there.md)"), ["a.md:1: ../docs/there.md"]);
    assert!(dead("a.md", "[b](https://c.d/e) [f](#g) [h](docs/there.md \"i\")").is_empty());
    assert!(dead("a.md", "```\n[b](gone.md)\n```").is_empty());
    assert_eq!(
        bad_records(&["0001-a.md", "0002-b.md", "0001-c.md"]),
        ["0001-c.md has the number of 0001-a.md"]
    );
    assert_eq!(bad_records(&["1-a.md"]), ["1-a.md is not NNNN-words.md"]);
    assert!(bad_records(&["0001-a.md", "0002-b.md"]).is_empty());
}

#[test]
fn bad_promises_are_found() {
    let page = "| a | b |\n|---|---|\n| `x.rs` | `!=` | `a_test_of_it`, then more |\n\n| no | row |\n";
    let mutations = rows(page);
    assert_eq!(mutations, [["`x.rs`", "`!=`", "`a_test_of_it`, then more"]]);
    let bad = |line: &str| bad_promise(&rows(&format!("|---|\n{line}"))[0], &mutations);
    assert_eq!(bad("| p | `x.rs` `a_test_of_it` | `!=` |"), None);
    assert_eq!(bad("| p | `x.rs` | |").unwrap(), "no test: p");
    assert_eq!(
        bad("| p | `x.rs` `a_test_of_it` |").unwrap(),
        "2 cells instead of 3: p | `x.rs` `a_test_of_it`"
    );
    let others = ["`another_test_of_it` | `!=` |", "`a_test_of_it` | `==` |", "`a_test_of_it` | |"];
    for other in others.map(|cells| format!("| p | `x.rs` {cells}")) {
        assert!(bad(&other).unwrap().starts_with("none of its tests has failed for "), "{other}");
    }
}

#[test]
fn bad_test_files_are_found() {
    let with = "|---|\n| `tests/a.rs` | x | y |\n";
    let page = &format!("{with}\n## Test files without a mutation\n\n|---|\n| `tests/b.rs` | why |\n");
    assert!(bad_test_files(page, &["tests/a.rs", "tests/b.rs"]).is_empty());
    let bad = |page: &str, files: &[&str]| bad_test_files(page, files).join("; ");
    let more = ["tests/a.rs", "tests/b.rs", "tests/c.rs"];
    assert_eq!(bad(page, &more), "tests/c.rs has neither a mutation nor a reason for having none");
    assert_eq!(bad(page, &["tests/a.rs"]), "`tests/b.rs` is no test file");
    let both = page.replace("tests/b", "tests/a");
    assert_eq!(bad(&both, &["tests/a.rs"]), "tests/a.rs has a mutation: remove it from those without one");
    assert_eq!(bad(&page.replace("why", ""), &more[..2]), "`tests/b.rs` has no reason");
    assert_eq!(bad("", &more[..1]), "no section for the test files without a mutation");
}
