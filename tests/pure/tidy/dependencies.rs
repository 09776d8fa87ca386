//! The Rust version: that which the dependencies need, and that of the image.

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

/// The image that the Dockerfile gives to an argument: its Rust version, if it has one, and its Debian.
fn image(dockerfile: &str, argument: &str) -> Option<(Option<[u32; 3]>, String)> {
    let image = dockerfile.lines().find_map(|line| line.strip_prefix("ARG ")?.strip_prefix(argument))?;
    let (name, tag) = image.strip_prefix('=')?.split_once(':')?;
    match name {
        "rust" => tag.split_once('-').map(|(rust, debian)| (Some(version(rust)), debian.to_owned())),
        _ => Some((None, tag.strip_suffix("-slim").unwrap_or(tag).to_owned())),
    }
}

#[test]
fn the_image_is_built_by_a_given_rust_that_is_new_enough_on_the_debian_that_it_runs_on() {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/docker/Dockerfile");
    let dockerfile = std::fs::read_to_string(file).unwrap();
    let (rust, debian) = image(&dockerfile, "RUST_IMAGE").unwrap();
    assert!(rust.unwrap() >= version(env!("CARGO_PKG_RUST_VERSION")), "{rust:?}");
    assert!(rust.unwrap()[1] > 0, "rust:1 is another Rust with each release");
    assert_eq!(image(&dockerfile, "BASE_IMAGE").unwrap(), (None, debian));
}

/// The packages of the workspace whose manifest the image's build, which lists what it copies, does not get.
fn not_copied(dockerignore: &str, manifests: &[String]) -> Vec<String> {
    let copied: Vec<&str> = dockerignore.lines().filter_map(|line| line.strip_prefix('!')).collect();
    let is_copied = |manifest: &&String| {
        copied.iter().any(|path| {
            manifest.strip_prefix(path).is_some_and(|rest| rest.is_empty() || rest.starts_with('/'))
        })
    };
    manifests.iter().filter(|manifest| !is_copied(manifest)).cloned().collect()
}

#[test]
fn the_image_is_built_with_the_manifest_of_each_package_of_the_workspace() {
    let root = env!("CARGO_MANIFEST_DIR");
    let local = |package: &Value| {
        let manifest = package["manifest_path"].as_str()?.strip_prefix(root)?;
        package["source"].is_null().then(|| manifest.trim_start_matches('/').to_owned())
    };
    let manifests: Vec<String> = packages().iter().filter_map(local).collect();
    assert!(manifests.len() >= 5, "{manifests:?}");
    let dockerignore = std::fs::read_to_string(format!("{root}/.dockerignore")).unwrap();
    assert_eq!(not_copied(&dockerignore, &manifests), Vec::<String>::new());
    let without = dockerignore.replace("!crates/measure/Cargo.toml", "");
    assert_eq!(not_copied(&without, &manifests), ["crates/measure/Cargo.toml"]);
}
