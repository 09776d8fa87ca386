//! The bridge in containers of a real Docker Engine, one for each process, as docker/compose.yaml deploys it.

use std::collections::HashMap;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use nix::sys::signal::Signal;
use support::bed::{CRITICAL, INPUT, NONCRITICAL, SCAN};
use support::peer::{Peer, Received, RunningPeer, Sent};
use support::process::signal;

/// Images equivalent to those of the Dockerfile, for a machine without access to a registry: the one that the
/// program runs on is made by debootstrap; the one that it is built on has this machine's toolchain as well.
const BOOTSTRAPPED: &str = "adaptive-bridge-test-base";
const BOOTSTRAPPED_RUST: &str = "adaptive-bridge-test-rust";

const CONTAINERS: [&str; 6] =
    ["ingress", "egress-critical", "egress-noncritical", "control", "standby-ingress", "standby-critical"];

fn run(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}: {}\n{stderr}", output.status);
    String::from_utf8(output.stdout).unwrap()
}

/// The image that the Dockerfile gives to an argument.
fn named(argument: &str) -> String {
    let file = fs::read_to_string(support::root().join("docker/Dockerfile")).unwrap();
    let prefix = format!("ARG {argument}=");
    let image = file.lines().find_map(|line| line.strip_prefix(&prefix));
    image.unwrap_or_else(|| panic!("docker/Dockerfile: no {prefix}")).to_owned()
}

fn is_there(image: &str) -> bool {
    succeeds("docker", &["image", "inspect", image])
}

fn succeeds(program: &str, arguments: &[&str]) -> bool {
    Command::new(program).args(arguments).output().is_ok_and(|output: Output| output.status.success())
}

/// The command of compose on this machine: the plugin, or the older program of its own.
fn compose_program() -> Option<Vec<&'static str>> {
    let known = [vec!["docker", "compose"], vec!["docker-compose"]];
    known.into_iter().find(|words| succeeds(words[0], &[&words[1..], &["version"]].concat()))
}

fn missing() -> Option<String> {
    if !succeeds("docker", &["info"]) {
        return Some("the Docker Engine does not answer".to_owned());
    }
    if compose_program().is_none() {
        return Some("docker compose is not installed (make setup)".to_owned());
    }
    let base = named("BASE_IMAGE");
    if !is_there(BOOTSTRAPPED)
        && !is_there(&base)
        && !succeeds("docker", &["pull", &base])
        && !succeeds("debootstrap", &["--version"])
    {
        return Some(format!("neither {base} nor debootstrap is available (make setup)"));
    }
    support::testbed_missing()
}

/// The name of a base image, which is made if necessary.
fn base(folder: &Path) -> String {
    let base = named("BASE_IMAGE");
    if is_there(&base) {
        return base;
    }
    if !is_there(BOOTSTRAPPED) {
        let root = folder.join("debian");
        run(Command::new("debootstrap").args(["--variant=minbase", "bookworm"]).arg(&root));
        let import = format!("tar -C {} -c . | docker import - {BOOTSTRAPPED}", root.display());
        run(Command::new("sh").args(["-c", &import]));
        fs::remove_dir_all(root).unwrap();
    }
    BOOTSTRAPPED.to_owned()
}

/// The name of an image with a Rust toolchain, which is made if necessary.
fn toolchain(folder: &Path) -> String {
    let rust = named("RUST_IMAGE");
    if is_there(&rust) || succeeds("docker", &["pull", "--quiet", &rust]) {
        return rust;
    }
    // The certificates are those by which this machine trusts crates.io. An optimised program would take
    // minutes more to build.
    let file = format!(
        "FROM {}\nRUN apt-get update && apt-get install --yes --no-install-recommends gcc libc6-dev\n\
         COPY etc /etc\nCOPY bin /usr/local/bin\nCOPY lib /usr/local/lib\n\
         ENV CARGO_PROFILE_RELEASE_OPT_LEVEL=1 CARGO_PROFILE_RELEASE_LTO=off \
         CARGO_PROFILE_RELEASE_CODEGEN_UNITS=16 CARGO_PROFILE_RELEASE_DEBUG=0\n",
        base(folder)
    );
    fs::write(folder.join("Dockerfile"), file).unwrap();
    let sysroot = run(Command::new("rustc").args(["--print", "sysroot"]));
    let build = format!(
        "tar -c -C {} Dockerfile -C / etc/ssl/certs/ca-certificates.crt -C {} bin/cargo bin/rustc lib \
         | docker build --quiet --tag {BOOTSTRAPPED_RUST} -",
        folder.display(),
        sysroot.trim()
    );
    run(Command::new("sh").args(["-c", &build]));
    BOOTSTRAPPED_RUST.to_owned()
}

/// A deployment of compose.yaml. Dropping it removes its containers, volumes and image.
struct Deployment {
    project: String,
    domain_id: u16,
    folder: tempfile::TempDir,
}

impl Deployment {
    fn new() -> Self {
        let pid = std::process::id();
        let folder = tempfile::tempdir().unwrap();
        // A domain of its own, because the containers share the network of this machine.
        let domain_id = 100 + (pid % 100) as u16;
        fs::write(folder.path().join("config.yaml"), SCAN).unwrap();
        Self { project: format!("abtest{pid}"), domain_id, folder }
    }

    /// Starts the containers, and waits until all are healthy.
    fn up(&self, mut compose: Command, how: &str) {
        run(compose.args(["up", "--detach", how]));
        for container in CONTAINERS {
            support::wait_until(format!("a healthy {container}"), || {
                self.inspect(container, "{{.State.Health.Status}}") == "healthy"
            });
        }
    }

    /// Makes the image by the Dockerfile, with the program under test in place of one that it would build.
    fn assemble(&self) {
        let source = support::root();
        let docker = || {
            let mut command = Command::new("docker");
            // Every engine has the classic builder.
            command.env("DOCKER_BUILDKIT", "0").args(["build", "--quiet"]);
            command
        };
        let runtime = self.stage("runtime");
        let base = format!("BASE_IMAGE={}", base(self.folder.path()));
        let mut command = docker();
        command.args(["--target", "runtime", "--build-arg", &base, "--tag", &runtime, "--file"]);
        run(command.arg(source.join("docker/Dockerfile")).arg(source));
        let context = self.folder.path().join("context");
        fs::create_dir(&context).unwrap();
        fs::copy(support::bridge::program(), context.join("adaptive-bridge")).unwrap();
        let last = format!("FROM {runtime}\nCOPY adaptive-bridge /usr/bin/adaptive-bridge\n");
        fs::write(context.join("Dockerfile"), last).unwrap();
        run(docker().args(["--tag", &self.project]).arg(&context));
    }

    /// Builds the image, and the program in it, by the command of the Dockerfile. It takes minutes.
    fn build(&self) {
        let given = self.images().map(|(name, image)| format!("{name}={image}"));
        let build = |arguments: &[&str]| {
            let mut command = Command::new("docker");
            command.current_dir(support::root()).args(["build", "-f", "docker/Dockerfile"]).args(arguments);
            // Without a container of the step that failed, which has the output of the compiler.
            command
                .args(["--quiet", "--force-rm"])
                .args(given.iter().flat_map(|given| ["--build-arg", given]));
            run(command.arg("."));
        };
        build(&["-t", &self.project]);
        // A name for what this stage has left, by which it is removed.
        build(&["-t", &self.stage("build"), "--target", "build"]);
    }

    /// The images that the Dockerfile takes as arguments.
    fn images(&self) -> [(&'static str, String); 2] {
        let folder = self.folder.path();
        [("RUST_IMAGE", toolchain(folder)), ("BASE_IMAGE", base(folder))]
    }

    /// The name of the image of a stage.
    fn stage(&self, name: &str) -> String {
        format!("{}-{name}", self.project)
    }

    /// What a container of the image prints for these arguments.
    fn output(&self, arguments: &[&str]) -> String {
        run(Command::new("docker").args(["run", "--rm", &self.project]).args(arguments))
    }

    fn config(&self) -> std::path::PathBuf {
        self.folder.path().join("config.yaml")
    }

    fn compose(&self) -> Command {
        let words = compose_program().unwrap();
        let mut command = Command::new(words[0]);
        command.args(&words[1..]).args(["--project-name", &self.project, "--file"]);
        command.arg(support::root().join("docker/compose.yaml"));
        command.env("ADAPTIVE_BRIDGE_IMAGE", &self.project).env("ADAPTIVE_BRIDGE_CONFIG_FILE", self.config());
        command.env("ROS_DOMAIN_ID", self.domain_id.to_string());
        command
    }

    /// The same, for a command that builds.
    fn compose_with_images(&self) -> Command {
        let images = serde_json::json!({"build": {"args": HashMap::from(self.images())}});
        let services = HashMap::from(CONTAINERS.map(|container| (container, &images)));
        let file = self.folder.path().join("images.yaml");
        fs::write(&file, serde_json::json!({"services": services}).to_string()).unwrap();
        let mut command = self.compose();
        command.arg("--file").arg(file);
        command
    }

    fn inspect(&self, container: &str, format: &str) -> String {
        let id = run(self.compose().args(["ps", "--quiet", container]));
        run(Command::new("docker").args(["inspect", "--format", format, id.trim()])).trim().to_owned()
    }

    /// The containers and volumes of this deployment.
    fn left(&self) -> String {
        let filter = format!("label=com.docker.compose.project={}", self.project);
        let containers = run(Command::new("docker").args(["ps", "--all", "--quiet", "--filter", &filter]));
        containers + &run(Command::new("docker").args(["volume", "ls", "--quiet", "--filter", &filter]))
    }
}

impl Drop for Deployment {
    fn drop(&mut self) {
        if std::thread::panicking() {
            let logs = self.compose().arg("logs").output();
            eprintln!(
                "{}",
                logs.map(|logs| String::from_utf8_lossy(&logs.stdout).into_owned()).unwrap_or_default()
            );
        }
        let _ = self.compose().args(["down", "--volumes"]).output();
        let images = [self.project.clone(), self.stage("runtime"), self.stage("build")];
        let _ = Command::new("docker").args(["rmi", "--force"]).args(images).output();
    }
}

/// A publisher, and a subscriber of each lane, on this machine.
struct Flow {
    publisher: RunningPeer,
    critical: RunningPeer,
    slow: RunningPeer,
}

impl Flow {
    fn start(deployment: &Deployment) -> Self {
        let domain_id = deployment.domain_id;
        let subscriber = |peer: Peer, topic: &str| peer.subscriber().topic(topic).domain(domain_id).start();
        let critical = subscriber(Peer::cyclone().keep_all(), CRITICAL);
        let slow = subscriber(Peer::fast().best_effort(), NONCRITICAL);
        let publisher = Peer::cyclone().publisher().topic(INPUT).domain(domain_id).wait_match(1).start();
        Self { publisher, critical, slow }
    }

    /// Waits for samples on both lanes.
    fn wait_on(&self) {
        let (before_critical, before_slow) = (self.critical.received(), self.slow.received());
        self.critical.wait_received(before_critical + 20);
        self.slow.wait_received(before_slow + 3);
    }

    fn end(self) {
        let sent: Sent = self.publisher.end();
        sent.assert_not_blocked();
        self.critical.end::<Received>().assert_sound();
        self.slow.end::<Received>().assert_sound();
    }
}

#[test]
fn samples_flow_after_any_container_is_killed_and_down_leaves_nothing() {
    let test = "samples_flow_after_any_container_is_killed_and_down_leaves_nothing";
    if let Some(reason) = missing() {
        support::skip(test, &reason);
        return;
    }
    let _exclusive = support::exclusive();
    let deployment = Deployment::new();
    deployment.assemble();
    deployment.up(deployment.compose(), "--no-build");
    let flow = Flow::start(&deployment);
    flow.wait_on();
    for container in CONTAINERS {
        let pid = deployment.inspect(container, "{{.State.Pid}}");
        signal(pid.parse().unwrap(), Signal::SIGKILL);
        support::wait_until(format!("a restart of {container}"), || {
            let present = deployment.inspect(container, "{{.State.Pid}}");
            present != "0" && present != pid
        });
        flow.wait_on();
    }
    flow.end();
    let status =
        run(deployment.compose().args(["exec", "-T", "control", "adaptive-bridge", "status", "--json"]));
    let status: serde_json::Value = serde_json::from_str(&status).unwrap();
    for name in ["ingress", "egress-critical"] {
        let processes = status["processes"].as_array().unwrap();
        let process = processes.iter().find(|process| process["name"] == name).unwrap();
        assert!(process["standby"]["take_overs"].as_u64() > Some(0), "{process}");
    }
    run(deployment.compose().args(["down", "--volumes"]));
    assert_eq!(deployment.left(), "");
}

mod long {
    use super::*;

    /// `make test-image` runs it alone.
    #[test]
    fn the_image_that_the_dockerfile_builds_checks_demonstrates_and_forwards() {
        let test = "the_image_that_the_dockerfile_builds_checks_demonstrates_and_forwards";
        if let Some(reason) = missing() {
            support::skip(test, &reason);
            return;
        }
        let _exclusive = support::exclusive();
        let deployment = Deployment::new();
        deployment.build();
        let here = |arguments: &[&str]| run(Command::new(support::bridge::program()).args(arguments));
        assert_eq!(deployment.output(&["--version"]), here(&["--version"]));
        let minimal = support::root().join("config/minimal.yaml");
        assert_eq!(deployment.output(&["check"]), here(&["check", "--config", minimal.to_str().unwrap()]));
        let demo = deployment.output(&["demo", "--seconds", "6", "--json"]);
        support::bridge::assert_demo_lost_nothing(&serde_json::from_str(&demo).unwrap());

        // The command of the operator's guide, which finds all steps done.
        deployment.up(deployment.compose_with_images(), "--build");
        let flow = Flow::start(&deployment);
        flow.wait_on();
        flow.end();
        run(deployment.compose().arg("stop"));
        for container in CONTAINERS {
            assert_eq!(deployment.inspect(container, "{{.State.ExitCode}}"), "0", "{container}");
        }
        run(deployment.compose().args(["down", "--volumes"]));
        assert_eq!(deployment.left(), "");
    }
}
