//! The folder of an instance, and the locks in it.

use std::ffi::OsString;
use std::path::{Path, PathBuf};

use super::error::ShmError;
use crate::model::InstanceName;

/// The folder under which instances live: the configured one, else the first entry of `$RUNTIME_DIRECTORY`
/// (systemd), else `/run/adaptive-bridge` where that exists and is ours, else
/// `$XDG_RUNTIME_DIR/adaptive-bridge`, else `/tmp/adaptive-bridge-UID`. `env` looks up environment variables.
pub fn default_root(configured: Option<&Path>, env: impl Fn(&str) -> Option<OsString>) -> PathBuf {
    let _ = (configured, env);
    todo!()
}

/// The right to serve a role of an instance: `ingress`, `egress-critical`, … Held until dropped; the operating
/// system releases it when the process dies, however it dies.
#[derive(Debug)]
pub struct RoleLock {}

impl RoleLock {
    /// Takes the role, or says which process has it.
    pub fn acquire(root: &Path, instance: &InstanceName, role: &str) -> Result<Self, ShmError> {
        let _ = (root, instance, role);
        todo!()
    }
}
