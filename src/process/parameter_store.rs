//! Parameters that were set while the bridge runs. Control stores them beside the configuration in force;
//! every process reads them at each reload, in place of the values of the file. They end with the bridge.

use std::io;
use std::sync::Arc;

use crate::config::{ConfigError, Configuration, SetParameters};
use crate::shm::InForceFile;

/// Reads the configuration as at the start, with these parameters in place of the values of the file.
pub(super) type Load = Arc<dyn Fn(&SetParameters) -> Result<Configuration, ConfigError> + Send + Sync>;

/// Where the parameters are, and the file whose values they replace.
#[derive(Clone)]
pub(super) struct ParameterStore {
    load: Load,
    file: InForceFile,
}

impl ParameterStore {
    pub fn new(load: Load, file: InForceFile) -> Self {
        Self { load, file }
    }

    /// Reads the configuration file with these parameters.
    pub fn load(&self, set: &SetParameters) -> Result<Configuration, ConfigError> {
        (self.load)(set)
    }

    pub fn read(&self) -> io::Result<SetParameters> {
        read_parameters(&self.file)
    }

    pub fn write(&self, set: &SetParameters) -> io::Result<()> {
        self.file.write_parameters(&serde_json::to_vec(set)?)
    }
}

/// The parameters that are stored beside the configuration in force.
pub(super) fn read_parameters(file: &InForceFile) -> io::Result<SetParameters> {
    match file.read_parameters()? {
        Some(bytes) => Ok(serde_json::from_slice(&bytes)?),
        None => Ok(SetParameters::new()),
    }
}
