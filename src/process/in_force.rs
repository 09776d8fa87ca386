//! The configuration in force. The first process of a bridge writes it beside the boards; each process that
//! starts while the bridge runs uses it, even if the configuration file has changed since.

use std::path::{Path, PathBuf};
use std::time::Duration;

use tracing::{info, warn};

use super::parameter_store::read_parameters;
use super::stop::Stop;
use crate::clock;
use crate::config::{ConfigError, Configuration, SetParameters, Settings};
use crate::model::InstanceName;
use crate::shm::{BridgeAddress, InForceFile, InForceShare, ShmError, default_root, root_of};
use crate::telemetry::Snapshot;

/// Environment variable that `up` sets for its children, to the folder of their instance.
pub(super) const FOLDER_VARIABLE: &str = "ADAPTIVE_BRIDGE_FOLDER";

/// How long the service of a standby waits for a bridge. systemd starts all services at once, and gives each
/// 30 s.
const BRIDGE_WITHIN_MS: u64 = 20_000;
const BRIDGE_POLL: Duration = Duration::from_millis(50);

/// The configuration that this process uses, and its share in the file that keeps it in force.
#[derive(Debug)]
pub struct InForce {
    pub(super) configuration: Configuration,
    pub(super) share: InForceShare,
}

/// Why a process cannot get a configuration.
#[derive(Debug, thiserror::Error)]
pub enum InForceError {
    /// The bridge does not run, and the file is bad.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The folder of the instance cannot be used.
    #[error(transparent)]
    Shm(#[from] ShmError),
    /// A standby found no bridge to wait in.
    #[error(
        "standby: no bridge runs with {}; if the services that it is to take over from have drop-ins of their own, \
         give it the same ones (adaptive-bridge units --write)", file.display()
    )]
    NoBridge {
        /// The configuration file that the standby was started with.
        file: PathBuf,
    },
}

impl InForce {
    /// Chooses the configuration of a process that starts: the one in force if its bridge runs, else that of
    /// the file, which is in force from then on. `load` reads `file`, with parameters that were set.
    ///
    /// # Errors
    /// The bridge does not run and the file is bad, or the folder of the instance cannot be used.
    pub fn join(
        file: &Path,
        load: impl Fn(&SetParameters) -> Result<Configuration, ConfigError>,
    ) -> Result<Self, InForceError> {
        if let Some(joined) = Self::join_running(file, &load)? {
            return Ok(joined);
        }
        let configuration = load(&SetParameters::new())?;
        let (root, instance) = (root_of(&configuration.settings), configuration.settings.instance.clone());
        let own = encode(&configuration)?;
        let (share, bytes) = InForceShare::join(&root, &instance, &own)?;
        if bytes != own {
            return Self::of_running_bridge(share, &bytes, load);
        }
        write_address(file, &root, &instance);
        Ok(Self { configuration, share })
    }

    /// The configuration in force of the bridge that was started with `file`; `None` if it does not run.
    fn join_running(
        file: &Path,
        load: impl Fn(&SetParameters) -> Result<Configuration, ConfigError>,
    ) -> Result<Option<Self>, InForceError> {
        let by_file = || BridgeAddress::find(&own_root(), file).map(|found| (found.root, found.instance));
        let Some((root, instance)) = supervised_folder().or_else(by_file) else { return Ok(None) };
        let Some((share, bytes)) = InForceShare::join_running(&root, &instance)? else { return Ok(None) };
        Self::of_running_bridge(share, &bytes, load).map(Some)
    }

    /// Like [`join`](Self::join), for the service of a standby: waits for a bridge and begins none. With
    /// another file than the service that it is to take over from, that would be a second bridge. `None` if
    /// `stop` was requested meanwhile.
    ///
    /// # Errors
    /// No bridge runs with `file` within 20 s, the file is bad, or the folder of the instance cannot be used.
    pub fn wait(
        file: &Path,
        load: impl Fn(&SetParameters) -> Result<Configuration, ConfigError>,
        stop: &Stop,
    ) -> Result<Option<Self>, InForceError> {
        let give_up_at = clock::monotonic().plus_ms(BRIDGE_WITHIN_MS);
        loop {
            if let Some(joined) = Self::join_running(file, &load)? {
                return Ok(Some(joined));
            }
            if stop.is_requested() {
                return Ok(None);
            }
            // With a bad file no other process begins a bridge either.
            load(&SetParameters::new())?;
            if clock::monotonic() >= give_up_at {
                return Err(InForceError::NoBridge { file: file.to_owned() });
            }
            #[allow(clippy::disallowed_methods, reason = "a process that starts handles no samples")]
            std::thread::sleep(BRIDGE_POLL);
        }
    }

    /// Puts a configuration in force for a bridge whose processes are all started together (`up`).
    ///
    /// # Errors
    /// The bridge runs already, or the folder of the instance cannot be used.
    pub fn begin(file: &Path, configuration: Configuration) -> Result<Self, ShmError> {
        let (root, instance) = (root_of(&configuration.settings), configuration.settings.instance.clone());
        let share = InForceShare::begin(&root, &instance, &encode(&configuration)?)?;
        write_address(file, &root, &instance);
        Ok(Self { configuration, share })
    }

    fn of_running_bridge(
        share: InForceShare,
        bytes: &[u8],
        load: impl Fn(&SetParameters) -> Result<Configuration, ConfigError>,
    ) -> Result<Self, InForceError> {
        let configuration = match Configuration::decode(bytes) {
            Ok(configuration) => configuration,
            Err(error) => {
                warn!(%error, "cannot read the configuration in force; using the configuration file instead");
                let set = read_parameters(&share.file()).unwrap_or_else(|error| {
                    warn!(%error, "cannot read the parameters that were set");
                    SetParameters::new()
                });
                return Ok(Self { configuration: load(&set)?, share });
            }
        };
        info!("using the configuration in force of the running bridge, not the configuration file");
        match load(&configuration.settings.set_parameters) {
            Ok(file) => {
                let (_, reload) = configuration.reloaded(file);
                for change in &reload.changed {
                    info!("the configuration file differs, waits for a reload: {change}");
                }
                for change in &reload.waits {
                    info!(
                        "the configuration file differs, waits for a restart of the whole bridge: {change}"
                    );
                }
            }
            Err(error) => {
                warn!("the configuration file is bad; the whole bridge cannot be restarted:\n{error}")
            }
        }
        Ok(Self { configuration, share })
    }

    /// The configuration.
    pub fn configuration(&self) -> &Configuration {
        &self.configuration
    }

    /// Finds the settings in force of a running bridge: the one that was started with `file`, or else the one
    /// of the instance that the file names now; `None` when neither runs. Takes no lock and writes nothing.
    pub fn find(file: &Path, loaded: Option<&Settings>) -> Option<Settings> {
        let by_file = BridgeAddress::find(&own_root(), file)
            .and_then(|address| settings_of_running(&address.root, &address.instance));
        by_file.or_else(|| {
            let named = loaded?;
            settings_of_running(&root_of(named), &named.instance)
        })
    }
}

fn settings_of_running(root: &Path, instance: &InstanceName) -> Option<Settings> {
    let bytes = InForceFile::find(root, instance).ok()??.read().ok()??;
    let settings = Configuration::decode(&bytes).ok()?.settings;
    // A killed bridge leaves its file behind, so its boards are read as well.
    matches!(Snapshot::take(root, &settings), Ok(Some(_))).then_some(settings)
}

fn encode(configuration: &Configuration) -> Result<Vec<u8>, ShmError> {
    configuration.encode().map_err(|error| {
        ShmError::failed("to encode the configuration", &root_of(&configuration.settings), error)
    })
}

/// The default folder of shared files for this environment, whatever the configuration.
fn own_root() -> PathBuf {
    default_root(None, |name| std::env::var_os(name))
}

/// Records where the bridge of `file` runs. Without the record, a process finds its bridge only while the
/// file is valid and names the instance.
fn write_address(file: &Path, root: &Path, instance: &InstanceName) {
    if let Err(error) = BridgeAddress::new(file, root, instance).write(&own_root()) {
        warn!(%error, "a process that restarts finds this bridge only with a valid configuration file");
    }
}

/// The root and instance of the `up` process that started this one, if one did.
fn supervised_folder() -> Option<(PathBuf, InstanceName)> {
    let folder = PathBuf::from(std::env::var_os(FOLDER_VARIABLE)?);
    let instance = InstanceName::try_from(folder.file_name()?.to_str()?).ok()?;
    Some((folder.parent()?.to_owned(), instance))
}
