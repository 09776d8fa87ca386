//! Where a demo runs: a folder, a DDS domain and an instance of its own, so that neither a robot nor another
//! demo on this machine notices it.

use std::fs::{self, DirBuilder};
use std::io::{self, ErrorKind};
use std::net::{Ipv4Addr, UdpSocket};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

use super::scan::{SCAN_BYTES, TYPE};
use super::{DemoError, INPUT_TOPIC};
use crate::config::{self, Settings};
use crate::shm::ShmNode;

/// DDS domains of demos. Robots are on low ones, and from 101 on the ports are those that Linux hands out.
const DOMAINS: std::ops::RangeInclusive<u16> = 90..=99;

/// Port of a domain's discovery (RTPS 2.5 clause 9.6.1.1, with its defaults PB 7400 and DG 250).
const fn discovery_port(domain: u16) -> u16 {
    7400 + 250 * domain
}

/// Between the two multicast ports of a domain (offsets 0 and 1) and the unicast ones (10 and above) are
/// ports that no DDS program uses. Whoever has bound this one has the domain.
const fn claim_port(domain: u16) -> u16 {
    discovery_port(domain) + 5
}

/// A shared-memory slot for one scan.
const MAX_SAMPLE_BYTES: usize = 4096;
const _: () = assert!(SCAN_BYTES <= MAX_SAMPLE_BYTES);

/// The folder and domain of one demo. Both are given back when it is dropped, and nothing is left behind.
#[derive(Debug)]
pub(super) struct Place {
    folder: PathBuf,
    domain: u16,
    settings: Settings,
    /// Bound while the domain is ours.
    _claim: UdpSocket,
}

impl Place {
    pub fn find() -> Result<Self, DemoError> {
        let (domain, claim) = claim_domain()?;
        let folder = make_folder().map_err(|error| DemoError::os("cannot make a temporary folder", error))?;
        match write_config(&folder, domain) {
            Ok(settings) => Ok(Self { folder, domain, settings, _claim: claim }),
            Err(error) => {
                let _ = fs::remove_dir_all(&folder);
                Err(error)
            }
        }
    }

    pub fn domain(&self) -> u16 {
        self.domain
    }

    pub fn settings(&self) -> &Settings {
        &self.settings
    }

    pub fn config_file(&self) -> PathBuf {
        config_file(&self.folder)
    }

    pub fn shm_root(&self) -> PathBuf {
        shm_root(&self.folder)
    }

    /// The log of the process called `name`.
    pub fn log(&self, name: &str) -> PathBuf {
        self.folder.join(format!("{name}.log"))
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        // The bridge's last process clears its shared memory away. If that one was killed, something is left,
        // and whoever joins and leaves next clears it away instead.
        if self.shm_root().join(self.settings.instance.as_str()).exists() {
            drop(ShmNode::open(&self.shm_root(), &self.settings.instance, "demo"));
        }
        if let Err(error) = fs::remove_dir_all(&self.folder) {
            eprintln!("adaptive-bridge: cannot remove {}: {error}", self.folder.display());
        }
    }
}

/// A domain that nobody uses.
fn claim_domain() -> Result<(u16, UdpSocket), DemoError> {
    for domain in DOMAINS {
        let Ok(claim) = UdpSocket::bind((Ipv4Addr::LOCALHOST, claim_port(domain))) else { continue };
        // DDS programs share this port among themselves, but not with somebody who does not ask to share.
        if UdpSocket::bind((Ipv4Addr::UNSPECIFIED, discovery_port(domain))).is_ok() {
            return Ok((domain, claim));
        }
    }
    Err(DemoError::NoDomain { from: *DOMAINS.start(), to: *DOMAINS.end() })
}

/// A new folder, private to this user.
fn make_folder() -> io::Result<PathBuf> {
    let parent = std::env::temp_dir();
    let mut attempt = 0;
    loop {
        let folder = parent.join(format!("adaptive-bridge-demo-{}-{attempt}", std::process::id()));
        match DirBuilder::new().mode(0o700).create(&folder) {
            Ok(()) => return Ok(folder),
            // Left by a demo of the same process id that was killed with -9.
            Err(error) if error.kind() == ErrorKind::AlreadyExists && attempt < 100 => attempt += 1,
            Err(error) => return Err(error),
        }
    }
}

fn config_file(folder: &Path) -> PathBuf {
    folder.join("config.yaml")
}

fn shm_root(folder: &Path) -> PathBuf {
    folder.join("shm")
}

fn write_config(folder: &Path, domain: u16) -> Result<Settings, DemoError> {
    let file = config_file(folder);
    let text = config_text(domain, &shm_root(folder));
    fs::write(&file, &text).map_err(|error| DemoError::os("cannot write the configuration", error))?;
    config::parse(text.into_bytes(), &file.display().to_string(), &|_| None)
        .map_err(|error| DemoError::Config(error.to_string()))
}

/// All but the topic is there to keep the demo to itself.
fn config_text(domain: u16, shm_root: &Path) -> String {
    // As JSON, which YAML understands, whatever characters the path has.
    let shm_root = serde_json::Value::from(shm_root.to_string_lossy());
    let instance = format!("demo_{}", std::process::id());
    format!(
        "instance: {instance}
ros: {{domain_id: {domain}, networks: [127.0.0.1]}}
topics:
  - id: scan
    input_topic: {INPUT_TOPIC}
    message_type: {TYPE}
shared_memory: {{root_path: {shm_root}, max_sample_bytes: {MAX_SAMPLE_BYTES}}}
classifier: {{enabled: false}}
probes: {{enabled: false}}
diagnostics: {{enabled: false}}
"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_configuration_is_a_good_one_whatever_the_folder_is_called() {
        for root in ["/tmp/x/shm", "/tmp/it's \"odd\" # {yes}: no/shm", "/tmp/größer\\n"] {
            let text = config_text(91, Path::new(root));
            let settings = config::parse(text.into_bytes(), "demo", &|_| None).unwrap();
            assert_eq!(settings.shared_memory.root_path.as_deref(), Some(Path::new(root)));
            assert_eq!(settings.input.domain_id, 91);
            assert!(settings.lanes.iter().all(|lane| lane.network == settings.input));
        }
    }

    #[test]
    fn two_demos_get_two_domains() {
        let (first, _first_claim) = claim_domain().unwrap();
        let (second, _second_claim) = claim_domain().unwrap();
        assert_ne!(first, second);
    }
}
