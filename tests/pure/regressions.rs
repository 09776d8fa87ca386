//! Runs the fuzz targets on their seed inputs and on the failing inputs that fuzzing has found, without a
//! fuzzer. `scripts/fuzz.sh` searches for more.

use std::fs;
use std::path::{Path, PathBuf};

#[path = "../../fuzz/src/lib.rs"]
mod fuzz;

/// The input files of a target in a folder of `fuzz/`; empty if the folder does not exist.
fn inputs(folder: &str, target: &str) -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("fuzz").join(folder).join(target);
    let mut files: Vec<PathBuf> =
        fs::read_dir(folder).into_iter().flatten().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

#[test]
fn no_stored_input_fails() {
    for (name, target) in fuzz::TARGETS {
        let seeds = inputs("seeds", name);
        assert!(!seeds.is_empty(), "{name} has no seeds");
        for path in seeds.into_iter().chain(inputs("regressions", name)) {
            // If the target fails, the last printed path is the failing input.
            println!("{}", path.display());
            target(&fs::read(path).unwrap());
        }
    }
}

#[test]
fn every_fuzz_target_is_tested_here() {
    let manifest = include_str!("../../fuzz/Cargo.toml");
    let built: Vec<&str> =
        manifest.split("[[bin]]").skip(1).map(|bin| bin.split('"').nth(1).unwrap()).collect();
    let run: Vec<&str> = fuzz::TARGETS.iter().map(|(name, _)| *name).collect();
    assert_eq!(built, run);
    for folder in ["seeds", "regressions"] {
        for path in inputs(folder, "") {
            let name = path.file_name().unwrap().to_str().unwrap();
            assert!(run.contains(&name), "{} belongs to no target", path.display());
        }
    }
}
