//! No circles of imports: no file may use a file that uses it, directly or through others. A module and those
//! below it do not count: a parent declares its children, and they may use what it has for all of them. A use
//! of something that a module re-exports is a use of that module.

use std::collections::{BTreeMap, BTreeSet};

use super::source::{Rust, SourcePath, files};

/// The folders of the crates, and of the benchmark, which is one program.
const CRATES: &[&str] = &["src", "crates/policy/src", "crates/measure/src", "crates/eval/src", "benches/hop"];

/// The files that each file of a crate uses, both by the paths of their modules.
type Uses = BTreeMap<String, BTreeSet<String>>;

/// The module of a file: `config::yaml` for `config/yaml/mod.rs`; empty for the root of the crate.
fn module_of(file: &str) -> String {
    let path = file.trim_end_matches(".rs").trim_end_matches("mod").trim_end_matches('/').replace('/', "::");
    if ["lib", "main"].contains(&path.as_str()) { String::new() } else { path }
}

/// The module of this crate that a path leads into.
fn module_used(module: &str, used: &SourcePath, modules: &BTreeSet<&str>) -> Option<String> {
    let mut place: Vec<&str> = match used.names.first()?.as_str() {
        "crate" => Vec::new(),
        "self" | "super" => module.split("::").filter(|name| !name.is_empty()).collect(),
        _ => return None,
    };
    for name in &used.names {
        match name.as_str() {
            "crate" | "self" => {}
            "super" => drop(place.pop()),
            name => place.push(name),
        }
    }
    while !place.is_empty() && !modules.contains(place.join("::").as_str()) {
        place.pop();
    }
    Some(place.join("::"))
}

/// Whether one of two modules is the other, or below it.
fn are_related(one: &str, other: &str) -> bool {
    let is_within = |inner: &str, outer: &str| {
        outer.is_empty() || format!("{inner}::").starts_with(&format!("{outer}::"))
    };
    is_within(one, other) || is_within(other, one)
}

fn uses(sources: &[(String, String)]) -> Uses {
    let modules: BTreeSet<&str> = sources.iter().map(|(module, _)| module.as_str()).collect();
    let of = |module: &str, text: &str| {
        // Inline modules contain tests, which do not count.
        let paths = Rust::new(text).paths().into_iter().filter(|path| path.inline_modules == 0);
        let used = paths.filter_map(|path| module_used(module, &path, &modules));
        used.filter(|used| !are_related(module, used)).collect::<BTreeSet<_>>()
    };
    sources.iter().map(|(module, text)| (module.clone(), of(module, text))).collect()
}

/// Each use that is part of a circle.
fn circles(uses: &Uses) -> Vec<String> {
    let leads_to = |from: &str, to: &str| {
        let (mut seen, mut next) = (BTreeSet::from([from]), vec![from]);
        while let Some(module) = next.pop() {
            if module == to {
                return true;
            }
            next.extend(uses[module].iter().map(String::as_str).filter(|used| seen.insert(used)));
        }
        false
    };
    let pairs = uses.iter().flat_map(|(module, used)| used.iter().map(move |used| (module, used)));
    let back = pairs.filter(|(module, used)| leads_to(used, module));
    back.map(|(module, used)| format!("{module} uses {used}, which uses it")).collect()
}

#[test]
fn no_file_uses_a_file_that_uses_it() {
    for folder in CRATES {
        let inside = |path: &str| path.strip_prefix(folder).unwrap().trim_start_matches('/').to_owned();
        let sources: Vec<(String, String)> =
            files(folder, "rs").into_iter().map(|file| (module_of(&inside(&file.path)), file.text)).collect();
        let uses = uses(&sources);
        assert!(uses.values().map(BTreeSet::len).sum::<usize>() > 10, "{folder}: {uses:?}");
        let found = circles(&uses);
        assert!(found.is_empty(), "{folder}:\n{}", found.join("\n"));
    }
}

#[test]
fn a_circle_is_found() {
    let of = |files: &[(&str, &str)]| {
        let files = files.iter().map(|(path, text)| (module_of(path), (*text).to_owned()));
        circles(&uses(&files.collect::<Vec<_>>()))
    };
    let direct = [("a.rs", "use crate::b::{B, C};"), ("b.rs", "fn b() { super::a::a(); }")];
    assert_eq!(of(&direct), ["a uses b, which uses it", "b uses a, which uses it"]);
    let through_others = [
        ("x/mod.rs", "mod a; mod b;"),
        ("x/a.rs", "use super::b::B;"),
        ("x/b.rs", "use crate::y;"),
        ("y/mod.rs", "use crate::x::a::{self, A};"),
    ];
    assert_eq!(of(&through_others).len(), 3);
    let none = [
        ("lib.rs", "mod a; use crate::a::A;"),
        ("a.rs", "use super::b::B; use crate::ROOT;"),
        ("b.rs", "mod tests { use super::super::a::A; }\n// use super::a::A;"),
        ("c/mod.rs", "use self::d::D;"),
        ("c/d.rs", "use super::C;"),
    ];
    assert_eq!(of(&none), Vec::<String>::new());
}
