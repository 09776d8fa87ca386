//! What the dependencies declare: the Rust version that they need.

use std::process::Command;

use serde_json::Value;

/// The packages that a build with all features on this platform compiles, this one and those of the tests
/// included, as `cargo metadata` describes them. Reads only what cargo has downloaded for this test.
fn packages() -> Vec<Value> {
    let platform = format!("{}-unknown-linux-gnu", std::env::consts::ARCH);
    let output = Command::new(env!("CARGO"))
        .args(["metadata", "--format-version=1", "--locked", "--offline", "--all-features"])
        .args(["--filter-platform", &platform])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    assert!(output.status.success(), "cargo metadata: {}", String::from_utf8_lossy(&output.stderr));
    let mut metadata: Value = serde_json::from_slice(&output.stdout).unwrap();
    let Value::Array(packages) = metadata["packages"].take() else { panic!("cargo metadata: no packages") };
    packages
}

/// A version of two or three numbers, for comparison.
fn version(text: &str) -> [u32; 3] {
    let mut numbers = [0; 3];
    for (number, text) in numbers.iter_mut().zip(text.split('.')) {
        *number = text.parse().unwrap_or_else(|_| panic!("{text:?} in a version"));
    }
    numbers
}

/// The dependencies that need a later Rust version than `ours`.
fn too_new(ours: &str, packages: &[Value]) -> Vec<String> {
    let needs = packages.iter().filter_map(|package| Some((package, package["rust_version"].as_str()?)));
    needs
        .filter(|(_, needed)| version(needed) > version(ours))
        .map(|(package, needed)| {
            let name = |key: &str| package[key].as_str().unwrap_or_default().to_owned();
            format!("{} {} needs Rust {needed}, Cargo.toml promises {ours}", name("name"), name("version"))
        })
        .collect()
}

#[test]
fn no_dependency_needs_a_later_rust_than_the_one_promised() {
    let packages = packages();
    assert!(packages.len() > 100, "{} packages", packages.len());
    let declared = packages.iter().filter(|package| package["rust_version"].is_string()).count();
    assert!(declared > 50, "{declared} packages declare a Rust version");
    let found = too_new(env!("CARGO_PKG_RUST_VERSION"), &packages);
    assert!(found.is_empty(), "{}", found.join("\n"));
}

#[test]
fn a_dependency_that_needs_a_later_rust_is_found() {
    let package = |rust: Value| serde_json::json!({"name": "a", "version": "1.0.0", "rust_version": rust});
    let found = |rust: &str| too_new("1.89", &[package(rust.into()), package(Value::Null)]);
    assert_eq!(found("1.90.0"), ["a 1.0.0 needs Rust 1.90.0, Cargo.toml promises 1.89"]);
    assert_eq!(found("1.89.1").len(), 1);
    assert_eq!(found("2.0").len(), 1);
    assert!(found("1.89.0").is_empty());
    assert!(found("1.9").is_empty());
}
