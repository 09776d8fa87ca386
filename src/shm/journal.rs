//! What a process has discovered, in a file in shared memory, for the next process of its role.
//!
//! The file is replaced as a whole, so a killed process leaves the former one or the new one. A file with
//! anything else in it is refused.

use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Read, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use super::node::ShmNode;
use super::root::SHM_DIR;
use crate::model::{Guid, fnv1a};

/// The longest content. A longer one is not written: its reader would lack a part of it.
const MAX_BYTES: usize = 256 << 10;
/// "ABjourn1": the first bytes of a file.
const MAGIC: [u8; 8] = *b"ABjourn1";
/// Magic bytes, owner, checksum of owner and content.
const HEADER_BYTES: usize = 8 + 16 + 8;

/// The journal of a role. One process at a time: the holder of the role's lock.
#[derive(Debug)]
pub struct Journal {
    path: PathBuf,
    /// The owner and a hash of what this process has written last.
    written: Option<(Guid, u64)>,
}

impl Journal {
    /// The journal of a role, which need not exist.
    pub fn of(node: &ShmNode, role: &str) -> Self {
        let name = format!("{}journal-{role}", node.shared().dir().prefix);
        Self { path: Path::new(SHM_DIR).join(name), written: None }
    }

    /// The content that the process of the participant `owner` has left; `None` if there is none.
    ///
    /// # Errors
    /// The file cannot be read, or is not one that such a process has written.
    pub fn read(&self, owner: Guid) -> io::Result<Option<Vec<u8>>> {
        let file = match File::open(&self.path) {
            Err(error) if error.kind() == ErrorKind::NotFound => return Ok(None),
            file => file?,
        };
        let mut bytes = Vec::new();
        file.take((HEADER_BYTES + MAX_BYTES + 1) as u64).read_to_end(&mut bytes)?;
        let refused = || io::Error::new(ErrorKind::InvalidData, "it is damaged, or that of another process");
        content_of(&bytes, owner).map(|content| Some(content.to_vec())).ok_or_else(refused)
    }

    /// Replaces the content, unless this process has written the same before. A content that is too long
    /// removes the file.
    ///
    /// # Errors
    /// The file cannot be written. Then there is none.
    pub fn write(&mut self, owner: Guid, content: &[u8]) -> io::Result<()> {
        let mark = Some((owner, checksum(owner, content)));
        if self.written == mark {
            return Ok(());
        }
        let outcome = if content.len() > MAX_BYTES {
            Err(io::Error::new(ErrorKind::FileTooLarge, format!("it would have {} bytes", content.len())))
        } else {
            self.replace(&encode(owner, content))
        };
        if outcome.is_err() {
            self.remove();
        }
        // Also of a failure, which is not repeated until there is something else to write.
        self.written = mark;
        outcome
    }

    /// Removes the file.
    pub fn remove(&mut self) {
        let _ = fs::remove_file(&self.path);
        self.written = None;
    }

    fn replace(&self, bytes: &[u8]) -> io::Result<()> {
        let draft = self.path.with_extension("draft");
        let mut options = OpenOptions::new();
        let mut file = options.write(true).create(true).truncate(true).mode(0o600).open(&draft)?;
        file.write_all(bytes)?;
        fs::rename(&draft, &self.path)
    }
}

fn checksum(owner: Guid, content: &[u8]) -> u64 {
    fnv1a(&[&owner.0, content].concat())
}

fn encode(owner: Guid, content: &[u8]) -> Vec<u8> {
    [&MAGIC[..], &owner.0, &checksum(owner, content).to_le_bytes(), content].concat()
}

/// The content of a whole file of that owner.
fn content_of(bytes: &[u8], owner: Guid) -> Option<&[u8]> {
    let (magic, rest) = bytes.split_first_chunk()?;
    let (found, rest) = rest.split_first_chunk()?;
    let (sum, content) = rest.split_first_chunk()?;
    let is_whole = *magic == MAGIC
        && Guid(*found) == owner
        && content.len() <= MAX_BYTES
        && u64::from_le_bytes(*sum) == checksum(owner, content);
    is_whole.then_some(content)
}

#[cfg(test)]
mod tests {
    use proptest::collection::vec;
    use proptest::prelude::*;

    use super::*;

    const OWNER: Guid = Guid([7; 16]);

    fn journal() -> (Journal, tempfile::TempDir) {
        let folder = tempfile::tempdir().unwrap();
        (Journal { path: folder.path().join("journal"), written: None }, folder)
    }

    #[test]
    fn a_journal_is_read_as_it_was_written_by_its_owner() {
        let (mut journal, folder) = journal();
        assert_eq!(journal.read(OWNER).unwrap(), None);
        for content in [&b""[..], b"a", &[3; MAX_BYTES]] {
            journal.write(OWNER, content).unwrap();
            assert_eq!(journal.read(OWNER).unwrap().as_deref(), Some(content));
            assert!(journal.read(Guid([8; 16])).is_err());
        }
        // Too much would be a part only.
        assert!(journal.write(OWNER, &[3; MAX_BYTES + 1]).is_err());
        assert_eq!(journal.read(OWNER).unwrap(), None);
        journal.write(OWNER, b"a").unwrap();
        journal.remove();
        journal.write(OWNER, b"a").unwrap();
        assert_eq!(journal.read(OWNER).unwrap().as_deref(), Some(&b"a"[..]));
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 1, "no draft is left");
    }

    proptest! {
        #[test]
        fn any_other_bytes_are_refused_whole(
            content in vec(any::<u8>(), 0..300),
            at in any::<prop::sample::Index>(),
            flip in 1..=u8::MAX,
            noise in vec(any::<u8>(), 0..300),
        ) {
            let (journal, _folder) = journal();
            let whole = encode(OWNER, &content);
            let mut changed = whole.clone();
            changed[at.index(whole.len())] ^= flip;
            let torn = &whole[..at.index(whole.len())];
            let longer = [&whole[..], &[flip]].concat();
            for bytes in [&changed, torn, &longer, &noise] {
                fs::write(&journal.path, bytes).unwrap();
                prop_assert!(journal.read(OWNER).is_err(), "{bytes:?}");
            }
            fs::write(&journal.path, &whole).unwrap();
            prop_assert_eq!(journal.read(OWNER).unwrap(), Some(content));
        }
    }
}
