//! The shared secret of probe messages: loads it and signs with it, without ever printing it.

use std::fmt;
use std::fs::File;
use std::io::Read;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};

use hmac::{Hmac, KeyInit, Mac};
use sha2::Sha256;
use tracing::warn;

use crate::config::{InlineSecret, SecretSource};

/// The largest size of a secret file, of which only the first line is used.
const MAX_FILE_BYTES: u64 = 4096;

/// The length below which a secret can be found by brute force, from a single recorded message.
const STRONG_BYTES: usize = 16;

/// Why the secret could not be loaded. No variant contains any part of a secret.
#[derive(Debug, thiserror::Error)]
pub enum SecretError {
    /// A secret is required and none is configured.
    #[error(
        "security.enable_probe_hmac is true, but no secret is configured: set \
         security.hmac_secret_file to a file with the secret, or set enable_probe_hmac to false"
    )]
    NotConfigured,
    /// The file cannot be read.
    #[error(
        "the secret file {path} {problem}; security.hmac_secret_file must name a file whose first line is the \
         secret"
    )]
    Unreadable {
        /// The path of the file.
        path: PathBuf,
        /// What is wrong, as the rest of a sentence: "cannot be read: …".
        problem: String,
    },
    /// The file's first line is empty.
    #[error(
        "the first line of the secret file {path} is empty; create a secret with `openssl rand -hex 32 \
         > {path}`, and give the bridge and its responders the same file"
    )]
    EmptyFile {
        /// The path of the file.
        path: PathBuf,
    },
    /// The environment variable is not set or is empty.
    #[error(
        "the environment variable {name}, which security.hmac_secret_env names, is not set or is \
         empty; set it to the secret"
    )]
    EmptyVariable {
        /// The name of the variable.
        name: String,
    },
    /// `security.hmac_secret` of the configuration file is empty.
    #[error("security.hmac_secret in the configuration file is empty")]
    EmptyInline,
    /// The operating system provides no random numbers for nonces.
    #[error("cannot get random numbers for signatures: {0}")]
    NoRandomness(getrandom::Error),
}

/// A shared secret, ready for signing. It cannot be printed; only the resulting state of the hash function is
/// kept, not the secret itself.
#[derive(Clone)]
pub struct Secret(Hmac<Sha256>);

impl fmt::Debug for Secret {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Secret")
    }
}

impl Secret {
    /// Makes a secret of these bytes; `None` if there are none.
    pub fn new(secret: &[u8]) -> Option<Self> {
        if secret.is_empty() { None } else { Hmac::new_from_slice(secret).ok().map(Self) }
    }

    /// Loads the secret from its source. `inline` is the secret in the configuration file, if any.
    ///
    /// # Errors
    /// The source cannot be read, or the secret is empty.
    pub fn load(source: &SecretSource, inline: Option<&InlineSecret>) -> Result<Self, SecretError> {
        let (secret, empty) = match source {
            SecretSource::File(path) => (first_line(path)?, SecretError::EmptyFile { path: path.to_owned() }),
            SecretSource::Environment(name) => {
                let value = std::env::var_os(name).unwrap_or_default();
                (value.into_encoded_bytes(), SecretError::EmptyVariable { name: name.clone() })
            }
            SecretSource::ConfigFile => {
                let secret = inline.map_or("", InlineSecret::reveal);
                (secret.as_bytes().to_vec(), SecretError::EmptyInline)
            }
        };
        if (1..STRONG_BYTES).contains(&secret.len()) {
            warn!("the secret of the probes has fewer than {STRONG_BYTES} bytes and can be guessed");
        }
        Self::new(&secret).ok_or(empty)
    }

    /// HMAC-SHA-256 of a text.
    pub fn sign(&self, text: &str) -> [u8; 32] {
        self.0.clone().chain_update(text).finalize().into_bytes().into()
    }

    /// Whether `hmac` is the HMAC-SHA-256 of `text`, compared in constant time.
    pub fn verify(&self, text: &str, hmac: &[u8; 32]) -> bool {
        self.0.clone().chain_update(text).verify_slice(hmac).is_ok()
    }
}

/// Reads the first line of a file, without its line break.
fn first_line(path: &Path) -> Result<Vec<u8>, SecretError> {
    let unreadable = |problem: String| SecretError::Unreadable { path: path.to_owned(), problem };
    let cannot = |error: std::io::Error| unreadable(format!("cannot be read: {error}"));
    let metadata = std::fs::metadata(path).map_err(cannot)?;
    // Reading a pipe or a device may never end.
    if !metadata.is_file() {
        return Err(unreadable("is not a regular file".to_owned()));
    }
    if metadata.permissions().mode() & 0o007 != 0 {
        warn!(
            file = %path.display(),
            "every user of this machine can read or change the secret file; fix it with `chmod o=`"
        );
    }
    let mut bytes = Vec::new();
    File::open(path)
        .and_then(|file| file.take(MAX_FILE_BYTES + 1).read_to_end(&mut bytes))
        .map_err(cannot)?;
    if bytes.len() as u64 > MAX_FILE_BYTES {
        return Err(unreadable(format!("is larger than {MAX_FILE_BYTES} bytes")));
    }
    let mut line = bytes.split(|&byte| byte == b'\n').next().unwrap_or_default();
    line = line.strip_suffix(b"\r").unwrap_or(line);
    Ok(line.to_vec())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// RFC 4231, test case 2.
    #[test]
    fn the_hmac_matches_the_test_vector_of_rfc_4231() {
        let secret = Secret::new(b"Jefe").unwrap();
        let hmac = secret.sign("what do ya want for nothing?");
        assert_eq!(hmac[..4], [0x5b, 0xdc, 0xc1, 0x46]);
        assert_eq!(hmac[28..], [0x64, 0xec, 0x38, 0x43]);
        assert!(secret.verify("what do ya want for nothing?", &hmac));
        assert!(!secret.verify("what do ya want for nothing", &hmac));
        let mut other = hmac;
        other[31] ^= 1;
        assert!(!secret.verify("what do ya want for nothing?", &other));
    }

    #[test]
    fn a_secret_is_the_first_line_of_its_file() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("secret");
        let load = |content: &[u8]| {
            std::fs::write(&path, content).unwrap();
            Secret::load(&SecretSource::File(path.clone()), None)
        };
        let expected = Secret::new(b"sword fish ").unwrap().sign("x");
        for content in ["sword fish ", "sword fish \n", "sword fish \r\n", "sword fish \nsecond\n"] {
            assert_eq!(load(content.as_bytes()).unwrap().sign("x"), expected, "{content:?}");
        }
        for content in ["", "\n", "\r\n", "\nswordfish"] {
            assert!(matches!(load(content.as_bytes()), Err(SecretError::EmptyFile { .. })), "{content:?}");
        }
        assert!(matches!(load(&[b'x'; 5000]), Err(SecretError::Unreadable { .. })));
    }

    #[test]
    fn an_error_names_the_source_and_never_the_secret() {
        let error = |source| Secret::load(&source, None).unwrap_err().to_string();
        let missing = error(SecretSource::File("/nonexistent/secret".into()));
        assert!(missing.contains("/nonexistent/secret") && missing.contains("hmac_secret_file"), "{missing}");
        let folder = error(SecretSource::File("/".into()));
        assert!(folder.contains("not a regular file"), "{folder}");
        let variable = error(SecretSource::Environment("AB_NOT_SET".into()));
        assert!(variable.contains("AB_NOT_SET"), "{variable}");
        assert_eq!(format!("{:?}", Secret::new(b"swordfish")), "Some(Secret)");
    }

    #[test]
    fn a_secret_in_the_configuration_file_is_loaded() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("config.yaml");
        let topics = "topics: [{id: scan, input_topic: /scan}]\n";
        std::fs::write(&path, format!("{topics}security: {{hmac_secret: swordfish}}\n")).unwrap();
        let configuration = crate::config::load_configuration(Some(&path), &[], &|_| None).unwrap();
        let source = configuration.settings.security.secret.unwrap();
        let secret = Secret::load(&source, configuration.inline_secret.as_ref()).unwrap();
        assert_eq!(secret.sign("x"), Secret::new(b"swordfish").unwrap().sign("x"));
        assert!(matches!(Secret::load(&source, None), Err(SecretError::EmptyInline)));
    }
}
