//! The package for arm64, and tests on arm64 that need no network: built in a container and run by QEMU
//! (`scripts/arm64.sh`). `make test-arm64` runs it, and `make test` does not, because it builds all
//! dependencies again.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use serde_json::Value;
use tempfile::TempDir;

/// `e_machine` of an executable for arm64, EM_AARCH64.
const AARCH64: u16 = 183;

/// The newest glibc that a program may need: that of Ubuntu 22.04, the oldest system with ROS 2 that is
/// supported.
const GLIBC: (u32, u32) = (2, 35);

/// Runs a command and returns its stdout; `Err` with all its output if it fails.
fn output(command: &mut Command) -> Result<String, String> {
    let output = command.output().map_err(|error| format!("{command:?}: {error}"))?;
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    if output.status.success() {
        Ok(text(&output.stdout))
    } else {
        Err(format!("{command:?}: {}\n{}{}", output.status, text(&output.stdout), text(&output.stderr)))
    }
}

/// A command in the container, where programs for arm64 run.
fn on_arm64(words: impl IntoIterator<Item = impl AsRef<OsStr>>) -> Command {
    let mut command = Command::new(support::root().join("scripts/arm64.sh"));
    command.args(words);
    command
}

/// Makes the image of the container. Returns whether that is possible; else the test is skipped.
fn is_possible(test: &str) -> bool {
    match output(&mut on_arm64(["true"])) {
        Ok(_) => true,
        Err(reason) => {
            support::skip(test, reason.trim().lines().last().unwrap_or_default());
            false
        }
    }
}

/// Makes a package of this version, and returns its path.
fn package(version: &str, variables: &[(&str, &OsStr)]) -> PathBuf {
    let mut command = Command::new(support::root().join("scripts/package.sh"));
    command.args(["--deb-version", version]).env_remove("PROGRAM").env_remove("ARCH");
    command.envs(variables.iter().copied());
    let printed = output(&mut command).unwrap();
    support::root().join(printed.lines().last().unwrap())
}

fn dpkg_deb(option: &str, package: &Path, more: &[&OsStr]) -> String {
    output(Command::new("dpkg-deb").arg(option).arg(package).args(more)).unwrap()
}

/// The files of a package, with their modes and owners.
fn files(package: &Path) -> Vec<String> {
    let contents = dpkg_deb("--contents", package, &[]);
    let line = |line: &str| {
        let words: Vec<&str> = line.split_whitespace().collect();
        // Mode, owner, size, date, time, path.
        format!("{} {} {}", words[0], words[1], words[5..].join(" "))
    };
    contents.lines().map(line).collect()
}

/// The version of glibc in the field `Depends`.
fn glibc(depends: &str) -> (u32, u32) {
    let (_, rest) = depends.split_once("libc6 (>= ").unwrap_or_else(|| panic!("no libc6: {depends}"));
    let (major, minor) = rest.split_once(')').unwrap().0.split_once('.').unwrap();
    (major.parse().unwrap(), minor.parse().unwrap())
}

#[test]
fn the_package_has_what_that_of_this_machine_has_and_its_program_runs() {
    if !is_possible("the_package_has_what_that_of_this_machine_has_and_its_program_runs") {
        return;
    }
    let _exclusive = support::exclusive();
    let here = support::bridge::program();
    let native = package("0.0.1-1", &[("PROGRAM", here.as_ref())]);
    let package = package("0.0.1-1", &[("ARCH", "arm64".as_ref())]);
    assert_eq!(dpkg_deb("--field", &package, &["Architecture".as_ref()]).trim(), "arm64");
    let depends = dpkg_deb("--field", &package, &["Depends".as_ref()]);
    assert!(depends.contains("systemd (>= 249)"), "{depends}");
    assert!(glibc(&depends) <= GLIBC, "{depends}");
    assert_eq!(files(&package), files(&native));

    // In a folder that the container also has.
    let folder = TempDir::new_in(support::root().join("target")).unwrap();
    dpkg_deb("--extract", &package, &[folder.path().as_ref()]);
    let program = folder.path().join("usr/bin/adaptive-bridge");
    let executable = fs::read(&program).unwrap();
    assert_eq!(u16::from_le_bytes([executable[18], executable[19]]), AARCH64);
    let sections = output(Command::new("readelf").args(["--wide", "--sections"]).arg(&program)).unwrap();
    for section in [".symtab", ".debug_line"] {
        assert!(!sections.contains(section), "it is not stripped: {sections}");
    }
    println!(
        "{}: {} KiB; {}: {} KiB; Depends: {depends}",
        package.file_name().unwrap().display(),
        fs::metadata(&package).unwrap().len() / 1024,
        program.file_name().unwrap().display(),
        executable.len() / 1024,
    );

    let config = folder.path().join("etc/adaptive-bridge/config.yaml");
    let check = ["check".as_ref(), "--config".as_ref(), config.as_os_str()];
    for arguments in [["--version".as_ref()].as_slice(), &check] {
        let run = |mut command: Command| output(command.args(arguments)).unwrap();
        assert_eq!(run(on_arm64([&program])), run(Command::new(here)), "{arguments:?}");
    }
    let demo = output(on_arm64([&program]).args(["demo", "--seconds", "6", "--json"])).unwrap();
    let demo: Value = serde_json::from_str(&demo).unwrap();
    println!("demo: {}", demo["summary"]);
    support::bridge::assert_demo_lost_nothing(&demo);
}

/// Runs a test program, and returns how many of its tests passed.
///
/// It is built with the optimisations of the package's program, which may differ between architectures.
fn passed(program: &str, options: &[&str]) -> u32 {
    let mut command = on_arm64(["cargo", "test", "--locked", "--release", "--test", program, "--"]);
    let printed = output(command.args(options)).unwrap();
    let result = printed.lines().rfind(|line| line.starts_with("test result: ok. ")).unwrap();
    println!("{program}: {result}");
    result.split_whitespace().nth(3).unwrap().parse().unwrap()
}

#[test]
fn the_pure_tests_and_those_of_shared_memory_pass() {
    if !is_possible("the_pure_tests_and_those_of_shared_memory_pass") {
        return;
    }
    let _exclusive = support::exclusive();
    assert!(passed("pure", &[]) > 100);
    // This test gives a folder to another user, and the user namespace of the container has only one user.
    let needs_users = ["--skip", "a_folder_that_others_could_tamper_with_is_refused"];
    assert!(passed("shm", &needs_users) > 30);
}
