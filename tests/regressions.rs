//! The inputs that fuzzing began with and those that it found, through the functions that are fuzzed. They
//! are checked here without a fuzzer; `scripts/fuzz.sh` looks for more.

use std::fs;
use std::path::{Path, PathBuf};

#[path = "../fuzz/src/lib.rs"]
mod fuzz;

/// The files of a folder of `fuzz/`; none if there is no such folder.
fn inputs(folder: &str, target: &str) -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz").join(folder).join(target);
    let mut files: Vec<PathBuf> =
        fs::read_dir(folder).into_iter().flatten().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

#[test]
fn no_kept_input_breaks_a_promise() {
    for (name, target) in fuzz::TARGETS {
        let seeds = inputs("seeds", name);
        assert!(!seeds.is_empty(), "{name} begins with nothing");
        for path in seeds.into_iter().chain(inputs("regressions", name)) {
            // Of a failure, it is the last one printed that was at fault.
            println!("{}", path.display());
            target(&fs::read(path).unwrap());
        }
    }
}

#[test]
fn every_target_of_the_fuzzer_is_run_here() {
    let manifest = include_str!("../fuzz/Cargo.toml");
    let built: Vec<&str> =
        manifest.split("[[bin]]").skip(1).map(|bin| bin.split('"').nth(1).unwrap()).collect();
    let run: Vec<&str> = fuzz::TARGETS.iter().map(|(name, _)| *name).collect();
    assert_eq!(built, run);
    for folder in ["seeds", "regressions"] {
        for path in inputs(folder, "") {
            let name = path.file_name().unwrap().to_str().unwrap();
            assert!(run.contains(&name), "{} is of no target", path.display());
        }
    }
}
