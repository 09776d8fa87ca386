//! Hosts as containers on a bridge network, as in the paper. The containers mount this machine's programs and
//! libraries (`/usr` and `/etc`, read only), so no image has to be pulled or built; each has its own network,
//! shared memory and files. They share the machine's process ids, so that signals and counters work as in
//! network namespaces.

use std::fs;
use std::net::Ipv4Addr;
use std::path::Path;
use std::process;

use serde_json::Value;

use super::stale;
use super::{Bed, Host, Network};
use crate::error::EvalError;
use crate::impairment::system;
use crate::scenario::Switch;

/// The image of all hosts: empty folders to mount into, and symbolic links into `/usr`. It is made for each
/// bed and removed with it: an import under a name that exists would leave the former image without a name.
const IMAGE: &str = "host-image";
const FOLDERS: [&str; 8] = ["usr", "etc", "proc", "sys", "dev", "tmp", "run", "var"];
const LINKS: [&str; 4] = ["bin", "sbin", "lib", "lib64"];
/// Name of the docker network. Names of hosts have no dash, unlike this one and that of the image.
const NETWORK: &str = "bridge-network";
/// Size of a container's /dev/shm: docker's default of 64 MiB is too small for ten routes.
const SHM_SIZE: &str = "1g";

/// Why this machine cannot create such a bed; `None` when it can.
pub(super) fn missing(wanted: Switch) -> Option<String> {
    if !nix::unistd::geteuid().is_root() {
        return Some("it needs root to run programs in containers".to_owned());
    }
    if let Err(error) = docker("version") {
        return Some(error.to_string());
    }
    let is_folder = |name: &&str| fs::symlink_metadata(format!("/{name}")).is_ok_and(|it| it.is_dir());
    if let Some(name) = LINKS.iter().find(|name| is_folder(name)) {
        return Some(format!("/{name} is not a symbolic link into /usr on this machine"));
    }
    let present = switch();
    (wanted != present).then(|| format!("docker's bridge on this machine is a {} switch", present.name()))
}

/// The kind of switch that docker's bridge is on this machine. Docker itself enables connection tracking.
pub fn switch() -> Switch {
    let setting = fs::read_to_string("/proc/sys/net/bridge/bridge-nf-call-iptables").unwrap_or_default();
    if setting.trim() == "1" { Switch::Reassembling } else { Switch::Plain }
}

/// Removes containers, network and image of this process when it is dropped, even if the bed is incomplete.
struct Remover;

impl Drop for Remover {
    fn drop(&mut self) {
        let prefix = stale::name("");
        names().iter().filter(|name| name.starts_with(&prefix)).for_each(|name| remove(name));
    }
}

/// Creates the network and a container for each host.
pub(super) fn make(names: &[String], shared: &[&Path]) -> Result<Bed, EvalError> {
    let remover = Remover;
    let image = stale::name(IMAGE);
    make_image(&image)?;
    let network = stale::name(NETWORK);
    docker(&format!("network create {network}"))?;
    let mut hosts = Vec::with_capacity(names.len());
    for name in names {
        let container = stale::name(name);
        let mut words = system::words(&format!(
            "docker run --detach --rm --name {container} --hostname {name} --network {network} --pid host \
             --ipc private --shm-size {SHM_SIZE} --volume /usr:/usr:ro --volume /etc:/etc:ro"
        ));
        for folder in shared {
            let folder = folder.display();
            words.extend(["--volume".to_owned(), format!("{folder}:{folder}")]);
        }
        words.extend(system::words(&format!("{image} /usr/bin/sleep infinity")));
        system::run(&words)?;
        hosts.push(host(name, &container)?);
    }
    let switch = Network::new(format!("/proc/{}/ns/net", process::id()));
    Ok(Bed { hosts, switch, _remover: Box::new(remover) })
}

/// Creates the image of that name.
fn make_image(name: &str) -> Result<(), EvalError> {
    let folder = stale::scratch("image");
    let root = folder.join("root");
    let created = FOLDERS.iter().try_for_each(|name| fs::create_dir_all(root.join(name)));
    let linked = created.and_then(|()| {
        LINKS.iter().try_for_each(|name| std::os::unix::fs::symlink(format!("usr/{name}"), root.join(name)))
    });
    linked.map_err(|error| EvalError::file(&root, &error))?;
    let archive = folder.join("image.tar");
    let (archive, root) = (archive.display(), root.display());
    let imported =
        system::run(&system::words(&format!("tar --create --file {archive} --directory {root} .")))
            .map_err(EvalError::from)
            .and_then(|_| docker(&format!("import {archive} {name}")));
    let _ = fs::remove_dir_all(&folder);
    imported.map(|_| ())
}

fn host(name: &str, container: &str) -> Result<Host, EvalError> {
    let lacks = |what: &str| EvalError::new(format!("container {container} has no {what}"));
    let found: Value = serde_json::from_str(&docker(&format!("inspect {container}"))?).unwrap_or_default();
    let pid = found[0]["State"]["Pid"].as_u64().filter(|pid| *pid > 0).ok_or_else(|| lacks("process"))?;
    let networks = found[0]["NetworkSettings"]["Networks"].as_object();
    let address = networks.and_then(|networks| networks.values().next()?["IPAddress"].as_str());
    let address: Ipv4Addr = address.and_then(|text| text.parse().ok()).ok_or_else(|| lacks("address"))?;
    let network = Network::new(format!("/proc/{pid}/ns/net"));
    let port = port(&network)?.ok_or_else(|| lacks("port on the bridge"))?;
    let namespaces = ["--mount", "--net", "--ipc", "--uts"].map(str::to_owned);
    let entry = ["nsenter".to_owned(), format!("--target={pid}")].into_iter().chain(namespaces).collect();
    Ok(Host { name: name.to_owned(), address, network, entry, port, uplink: None })
}

/// Finds the machine's end of the veth pair whose other end is the container's interface.
fn port(network: &Network) -> Result<Option<String>, EvalError> {
    let inside: Value = serde_json::from_str(&network.run("ip -j link show dev eth0")?).unwrap_or_default();
    let index = &inside[0]["link_index"];
    let outside = system::run(&system::words("ip -j link show"))?;
    let outside: Value = serde_json::from_str(&outside).unwrap_or_default();
    let mut links = outside.as_array().into_iter().flatten();
    let found = links.find(|link| index.is_u64() && link["ifindex"] == *index);
    Ok(found.and_then(|link| link["ifname"].as_str()).map(str::to_owned))
}

/// Removes containers, networks and images of harness processes that no longer run; returns a description of
/// each.
pub(super) fn remove_leftovers() -> Vec<String> {
    let leftovers = names().into_iter().filter(|name| stale::is_leftover(name));
    let removed =
        leftovers.inspect(|name| remove(name)).map(|name| format!("container, network or image {name}"));
    removed.collect()
}

/// Lists containers, networks and images of all harness processes, including this one; empty without docker.
fn names() -> Vec<String> {
    let containers = docker("ps --all --filter name=^abe- --format {{.Names}}").unwrap_or_default();
    let networks = docker("network ls --filter name=^abe- --format {{.Name}}").unwrap_or_default();
    let images = docker("images --filter reference=abe-* --format {{.Repository}}").unwrap_or_default();
    // Containers first: a network or an image that is in use can't be removed.
    containers.lines().chain(networks.lines()).chain(images.lines()).map(str::to_owned).collect()
}

/// Removes the container, network or image of that name.
fn remove(name: &str) {
    let what = match name {
        _ if name.ends_with(NETWORK) => "network rm",
        _ if name.ends_with(IMAGE) => "image rm",
        _ => "rm --force",
    };
    let _ = docker(&format!("{what} {name}"));
}

fn docker(arguments: &str) -> Result<String, EvalError> {
    Ok(system::run(&system::words(&format!("docker {arguments}")))?)
}
