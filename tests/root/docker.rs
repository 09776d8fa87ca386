//! The bridge in containers of a real Docker Engine, one for each process, as docker/compose.yaml deploys it.

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use nix::sys::signal::Signal;
use support::bed::{CRITICAL, INPUT, NONCRITICAL, SCAN};
use support::peer::{Peer, Received, Sent};
use support::process::signal;

/// The base image of the Dockerfile. Without access to a registry, debootstrap makes an equivalent one.
const BASE: &str = "debian:bookworm-slim";
const BOOTSTRAPPED: &str = "adaptive-bridge-test-base";

const CONTAINERS: [&str; 4] = ["ingress", "egress-critical", "egress-noncritical", "control"];

fn run(command: &mut Command) -> String {
    let output = command.output().unwrap_or_else(|error| panic!("{command:?}: {error}"));
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{command:?}: {}\n{stderr}", output.status);
    String::from_utf8(output.stdout).unwrap()
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
    let has_base = || succeeds("docker", &["image", "inspect", BASE]) || succeeds("docker", &["pull", BASE]);
    if !succeeds("docker", &["image", "inspect", BOOTSTRAPPED])
        && !has_base()
        && !succeeds("debootstrap", &["--version"])
    {
        return Some(format!("neither {BASE} nor debootstrap is available (make setup)"));
    }
    support::testbed_missing()
}

/// The name of a base image, which is made if necessary.
fn base(folder: &Path) -> &'static str {
    let is_there = |image| succeeds("docker", &["image", "inspect", image]);
    if is_there(BASE) {
        return BASE;
    }
    if !is_there(BOOTSTRAPPED) {
        let root = folder.join("debian");
        run(Command::new("debootstrap").args(["--variant=minbase", "bookworm"]).arg(&root));
        let import = format!("tar -C {} -c . | docker import - {BOOTSTRAPPED}", root.display());
        run(Command::new("sh").args(["-c", &import]));
        fs::remove_dir_all(root).unwrap();
    }
    BOOTSTRAPPED
}

/// A deployment of compose.yaml. Dropping it removes its containers, volumes and image.
struct Deployment {
    project: String,
    domain_id: u16,
    folder: tempfile::TempDir,
}

impl Deployment {
    fn up() -> Self {
        let pid = std::process::id();
        let folder = tempfile::tempdir().unwrap();
        // A domain of its own, because the containers share the network of this machine.
        let domain_id = 100 + (pid % 100) as u16;
        let deployment = Self { project: format!("abtest{pid}"), domain_id, folder };
        deployment.build();
        fs::write(deployment.config(), SCAN).unwrap();
        run(deployment.compose().args(["up", "--detach", "--no-build"]));
        for container in CONTAINERS {
            support::wait_until(format!("a healthy {container}"), || {
                deployment.inspect(container, "{{.State.Health.Status}}") == "healthy"
            });
        }
        deployment
    }

    /// Builds the image by the Dockerfile, with the program under test in place of one that it would build.
    fn build(&self) {
        let source = Path::new(env!("CARGO_MANIFEST_DIR"));
        let docker = || {
            let mut command = Command::new("docker");
            // Every engine has the classic builder.
            command.env("DOCKER_BUILDKIT", "0").args(["build", "--quiet"]);
            command
        };
        let runtime = format!("{}-runtime", self.project);
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

    fn config(&self) -> std::path::PathBuf {
        self.folder.path().join("config.yaml")
    }

    fn compose(&self) -> Command {
        let words = compose_program().unwrap();
        let mut command = Command::new(words[0]);
        command.args(&words[1..]).args(["--project-name", &self.project, "--file"]);
        command.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("docker/compose.yaml"));
        command.env("ADAPTIVE_BRIDGE_IMAGE", &self.project).env("ADAPTIVE_BRIDGE_CONFIG_FILE", self.config());
        command.env("ROS_DOMAIN_ID", self.domain_id.to_string());
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
        let runtime = format!("{}-runtime", self.project);
        let _ = Command::new("docker").args(["rmi", "--force", &self.project, &runtime]).output();
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
    let deployment = Deployment::up();
    let domain_id = deployment.domain_id;
    let subscriber = |peer: Peer, topic: &str| peer.subscriber().topic(topic).domain(domain_id).start();
    let critical = subscriber(Peer::cyclone().keep_all(), CRITICAL);
    let slow = subscriber(Peer::fast().best_effort(), NONCRITICAL);
    let publisher = Peer::cyclone().publisher().topic(INPUT).domain(domain_id).wait_match(1).start();
    let wait_on = || {
        let (before_critical, before_slow) = (critical.received(), slow.received());
        critical.wait_received(before_critical + 20);
        slow.wait_received(before_slow + 3);
    };
    wait_on();
    for container in CONTAINERS {
        let pid = deployment.inspect(container, "{{.State.Pid}}");
        signal(pid.parse().unwrap(), Signal::SIGKILL);
        support::wait_until(format!("a restart of {container}"), || {
            let present = deployment.inspect(container, "{{.State.Pid}}");
            present != "0" && present != pid
        });
        wait_on();
    }
    let sent: Sent = publisher.end();
    sent.assert_not_blocked();
    critical.end::<Received>().assert_sound();
    slow.end::<Received>().assert_sound();
    run(deployment.compose().args(["down", "--volumes"]));
    assert_eq!(deployment.left(), "");
}
