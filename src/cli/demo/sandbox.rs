//! The folder, DDS domain and instance that a demo has for itself, so that it does not disturb a robot or
//! another demo on this machine.

use std::fs::{self, DirBuilder};
use std::io::{self, ErrorKind};
use std::net::{Ipv4Addr, UdpSocket};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};

use super::scan::{SCAN_BYTES, TYPE};
use super::{DemoError, INPUT_TOPIC};
use crate::config::{self, Settings};
use crate::shm::{ShmNode, root_of};

/// DDS domains of demos. Robots use low ones, and from 101 on the ports of a domain are in Linux's ephemeral
/// range.
const DOMAINS: std::ops::RangeInclusive<u16> = 90..=99;

/// The discovery port of a domain (RTPS 2.5 clause 9.6.1.1, with its defaults PB 7400 and DG 250).
const fn discovery_port(domain: u16) -> u16 {
    7400 + 250 * domain
}

/// The port that a demo binds to claim a domain. DDS programs do not use it: it lies between the domain's two
/// multicast ports (offsets 0 and 1) and its unicast ports (10 and above).
const fn claim_port(domain: u16) -> u16 {
    discovery_port(domain) + 5
}

const CONFIG_FILE: &str = "config.yaml";

/// The size of a slot in shared memory, which holds one scan.
const MAX_SAMPLE_BYTES: usize = 4096;
const _: () = assert!(SCAN_BYTES <= MAX_SAMPLE_BYTES);

/// The folder, DDS domain and settings of one demo. Dropping it removes the folder and releases the domain.
#[derive(Debug)]
pub(super) struct Sandbox {
    folder: PathBuf,
    pub settings: Settings,
    /// Bound to the claim port as long as the demo uses the domain.
    _claim: UdpSocket,
}

impl Sandbox {
    pub fn create() -> Result<Self, DemoError> {
        let (domain, claim) = claim_domain()?;
        let folder = make_folder()
            .map_err(|error| DemoError::Os { action: "cannot make a temporary folder", error })?;
        match write_config(&folder, domain) {
            Ok(settings) => Ok(Self { folder, settings, _claim: claim }),
            Err(error) => {
                let _ = fs::remove_dir_all(&folder);
                Err(error)
            }
        }
    }

    pub fn config_file(&self) -> PathBuf {
        self.folder.join(CONFIG_FILE)
    }

    pub fn log(&self, name: &str) -> PathBuf {
        self.folder.join(format!("{name}.log"))
    }
}

impl Drop for Sandbox {
    fn drop(&mut self) {
        // The last process of a bridge removes its shared memory. If it was killed, the memory remains until
        // another process opens and closes the instance, as this does.
        let root = root_of(&self.settings);
        if root.join(self.settings.instance.as_str()).exists() {
            drop(ShmNode::open(&root, &self.settings.instance, "demo"));
        }
        if let Err(error) = fs::remove_dir_all(&self.folder) {
            eprintln!("adaptive-bridge: cannot remove {}: {error}", self.folder.display());
        }
    }
}

fn claim_domain() -> Result<(u16, UdpSocket), DemoError> {
    for domain in DOMAINS {
        let Ok(claim) = UdpSocket::bind((Ipv4Addr::LOCALHOST, claim_port(domain))) else { continue };
        // DDS programs bind this port with SO_REUSEADDR. This bind does not, so it fails if one uses the
        // domain.
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
            // Left by a demo with the same process id that was killed with SIGKILL.
            Err(error) if error.kind() == ErrorKind::AlreadyExists && attempt < 100 => attempt += 1,
            Err(error) => return Err(error),
        }
    }
}

fn write_config(folder: &Path, domain: u16) -> Result<Settings, DemoError> {
    let file = folder.join(CONFIG_FILE);
    let text = config_text(domain, &folder.join("shm"));
    fs::write(&file, &text)
        .map_err(|error| DemoError::Os { action: "cannot write the configuration", error })?;
    config::parse(text, &file.display().to_string(), &|_| None)
        .map_err(|error| DemoError::Config(error.to_string()))
}

/// The configuration of the demo's bridge. Everything but the topic keeps it separate from other bridges.
fn config_text(domain: u16, shm_root: &Path) -> String {
    // Written as a JSON string, which is valid YAML with any characters in the path.
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
    fn the_configuration_is_valid_with_any_folder_name() {
        for root in ["/tmp/x/shm", "/tmp/it's \"odd\" # {yes}: no/shm", "/tmp/größer\\n"] {
            let text = config_text(91, Path::new(root));
            let settings = config::parse(text.into_bytes(), "demo", &|_| None).unwrap();
            assert_eq!(settings.shared_memory.root_path.as_deref(), Some(Path::new(root)));
            assert_eq!(settings.input.domain_id, 91);
            assert!(settings.lanes.iter().all(|lane| lane.network == settings.input));
        }
    }

    #[test]
    fn two_demos_claim_different_domains() {
        let (first, _first_claim) = claim_domain().unwrap();
        let (second, _second_claim) = claim_domain().unwrap();
        assert_ne!(first, second);
    }
}
