//! The configuration in force, and its encoding in the file next to the boards of a running bridge.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::reload::Reload;
use super::settings::Settings;

/// Settings and the secret from the same file.
#[derive(Clone, Debug, PartialEq)]
pub struct Configuration {
    /// The settings.
    pub settings: Settings,
    /// `security.hmac_secret` of the file. It is not in the settings, because they are logged.
    pub inline_secret: Option<InlineSecret>,
}

/// A secret from a configuration file. `Debug` does not show it.
#[derive(Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct InlineSecret(pub(super) String);

impl InlineSecret {
    /// The secret itself.
    pub fn reveal(&self) -> &str {
        &self.0
    }
}

impl fmt::Debug for InlineSecret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("InlineSecret")
    }
}

impl From<Settings> for Configuration {
    /// Settings without an inline secret.
    fn from(settings: Settings) -> Self {
        Self { settings, inline_secret: None }
    }
}

/// The encoded form. The fingerprint detects a program whose `Settings` type differs from the writer's.
#[derive(Serialize, Deserialize)]
struct Encoded {
    program_version: String,
    fingerprint: u64,
    settings: Settings,
    inline_secret: Option<InlineSecret>,
}

/// The error for a stored configuration that another version of the program wrote, or that is damaged.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
pub struct DecodeError(String);

impl Configuration {
    /// As [`Settings::reloaded`]: this configuration with all changes in `new` that a running bridge can
    /// apply.
    pub fn reloaded(&self, new: Self) -> (Self, Reload) {
        let (settings, reload) = self.settings.reloaded(new.settings);
        (Self { settings, inline_secret: new.inline_secret }, reload)
    }

    /// Encodes the configuration, including the secret, for [`decode`](Self::decode).
    ///
    /// # Errors
    /// None known: every value of the settings can be encoded.
    pub fn encode(&self) -> Result<Vec<u8>, serde_json::Error> {
        serde_json::to_vec(&Encoded {
            program_version: env!("CARGO_PKG_VERSION").to_owned(),
            fingerprint: self.settings.fingerprint(),
            settings: self.settings.clone(),
            inline_secret: self.inline_secret.clone(),
        })
    }

    /// Decodes a configuration exactly as it was encoded.
    ///
    /// # Errors
    /// Another version of the program wrote the bytes, or they are damaged.
    pub fn decode(bytes: &[u8]) -> Result<Self, DecodeError> {
        let Encoded { program_version, fingerprint, settings, inline_secret } =
            serde_json::from_slice(bytes).map_err(|error| DecodeError(error.to_string()))?;
        if settings.fingerprint() != fingerprint {
            let what = format!("written by version {program_version} of the program, whose settings differ");
            return Err(DecodeError(what));
        }
        Ok(Self { settings, inline_secret })
    }
}
