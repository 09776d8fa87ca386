//! Sends log events to journald in its native protocol (systemd.io/JOURNAL_NATIVE_PROTOCOL).
//!
//! Each field of an event becomes a field of the journal entry, so that `journalctl BRIDGE_ROUTE=scan` finds
//! it. The fields are also appended to the message, for readers who do not filter by field.

use std::ffi::OsString;
use std::fmt::Debug;
use std::io;
use std::os::fd::AsFd;
use std::os::unix::net::UnixDatagram;
use std::path::Path;

use nix::sys::stat::fstat;
use tracing::field::{Field, Visit};
use tracing::{Event, Level, Subscriber};
use tracing_log::NormalizeEvent;
use tracing_subscriber::Layer;
use tracing_subscriber::layer::Context;

const SOCKET: &str = "/run/systemd/journal/socket";

/// The maximum length of a field's value. A datagram of a unix socket holds about 200 KiB
/// (`net.core.wmem_default`), far more than an event of the bridge needs.
const MAX_MESSAGE_BYTES: usize = 32 * 1024;

/// The tracing layer that sends events to journald.
pub(super) struct Journal {
    socket: UnixDatagram,
}

impl Journal {
    /// Connects to journald if `log` is connected to the journal. systemd sets `JOURNAL_STREAM` to the device
    /// and inode of a service's standard error.
    pub fn for_log(log: impl AsFd, journal_stream: Option<OsString>) -> Option<Self> {
        let named = journal_stream?.into_string().ok()?;
        let metadata = fstat(log).ok()?;
        if named != format!("{}:{}", metadata.st_dev, metadata.st_ino) {
            return None;
        }
        Self::connect(Path::new(SOCKET)).ok()
    }

    fn connect(socket: &Path) -> io::Result<Self> {
        let journal = Self { socket: UnixDatagram::unbound()? };
        journal.socket.connect(socket)?;
        // A full socket buffer must not block the data path: entries that do not fit are lost.
        journal.socket.set_nonblocking(true)?;
        Ok(journal)
    }
}

impl<S: Subscriber> Layer<S> for Journal {
    fn on_event(&self, event: &Event<'_>, _context: Context<'_, S>) {
        let entry = Entry::of(event);
        // There is no other place to report a failed log write to.
        let _ = self.socket.send(&entry.encode());
    }
}

struct Entry {
    priority: u8,
    target: String,
    message: String,
    /// The fields of the event without its message, in upper case and with [`PREFIX`].
    fields: Vec<(String, String)>,
}

impl Entry {
    fn of(event: &Event<'_>) -> Self {
        // Events from the `log` crate carry their level and target in fields of their own.
        let normalized = event.normalized_metadata();
        let metadata = normalized.as_ref().unwrap_or_else(|| event.metadata());
        let mut entry = Self {
            priority: priority(*metadata.level()),
            target: metadata.target().to_owned(),
            message: String::new(),
            fields: Vec::new(),
        };
        event.record(&mut entry);
        for (name, value) in &entry.fields {
            entry.message += &format!(" {}={value}", name[PREFIX.len()..].to_ascii_lowercase());
        }
        entry
    }

    fn add(&mut self, field: &Field, value: String) {
        let name = field.name();
        if name == "message" {
            self.message.insert_str(0, &value);
        } else if !name.starts_with("log.") {
            self.fields.push((journal_name(name), value));
        }
    }

    fn encode(&self) -> Vec<u8> {
        let mut bytes = Vec::with_capacity(256 + 2 * self.message.len());
        put(&mut bytes, "PRIORITY", &self.priority.to_string());
        put(&mut bytes, "SYSLOG_IDENTIFIER", env!("CARGO_PKG_NAME"));
        put(&mut bytes, "TARGET", &self.target);
        put(&mut bytes, "MESSAGE", &self.message);
        for (name, value) in &self.fields {
            put(&mut bytes, name, value);
        }
        bytes
    }
}

impl Visit for Entry {
    fn record_str(&mut self, field: &Field, value: &str) {
        self.add(field, value.to_owned());
    }

    fn record_debug(&mut self, field: &Field, value: &dyn Debug) {
        self.add(field, format!("{value:?}"));
    }
}

/// The priority of a level, as in syslog(3).
fn priority(level: Level) -> u8 {
    match level {
        Level::ERROR => 3,
        Level::WARN => 4,
        Level::INFO => 6,
        Level::DEBUG | Level::TRACE => 7,
    }
}

/// The prefix of the event's fields. Without it, an event field `priority` would overwrite the entry's own.
const PREFIX: &str = "BRIDGE_";

/// The name of an event field in the journal, which accepts upper case letters, digits and underscores.
fn journal_name(name: &str) -> String {
    let allowed = |c: char| if c.is_ascii_alphanumeric() { c.to_ascii_uppercase() } else { '_' };
    PREFIX.chars().chain(name.chars().map(allowed)).collect()
}

/// Appends a field in the form with an explicit length, which also allows line breaks in the value.
fn put(bytes: &mut Vec<u8>, name: &str, value: &str) {
    let mut end = value.len().min(MAX_MESSAGE_BYTES);
    while !value.is_char_boundary(end) {
        end -= 1;
    }
    bytes.extend_from_slice(name.as_bytes());
    bytes.push(b'\n');
    bytes.extend_from_slice(&(end as u64).to_le_bytes());
    bytes.extend_from_slice(&value.as_bytes()[..end]);
    bytes.push(b'\n');
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;
    use std::fs::File;
    use std::time::Duration;

    use tracing_subscriber::prelude::*;

    use super::*;

    /// Decodes an entry into its fields.
    fn decode(mut bytes: &[u8]) -> BTreeMap<String, String> {
        let mut fields = BTreeMap::new();
        while let Some(end) = bytes.iter().position(|&byte| byte == b'\n') {
            let (name, rest) = (&bytes[..end], &bytes[end + 1..]);
            let length = u64::from_le_bytes(rest[..8].try_into().unwrap()) as usize;
            let text = |bytes: &[u8]| String::from_utf8(bytes.to_vec()).unwrap();
            assert_eq!(rest[8 + length], b'\n');
            assert_eq!(fields.insert(text(name), text(&rest[8..8 + length])), None);
            bytes = &rest[9 + length..];
        }
        fields
    }

    /// Logs events and returns the entries that journald receives.
    fn received(events: impl FnOnce()) -> Vec<BTreeMap<String, String>> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("journal");
        let journald = UnixDatagram::bind(&path).unwrap();
        journald.set_read_timeout(Some(Duration::from_millis(10))).unwrap();
        let subscriber = tracing_subscriber::registry().with(Journal::connect(&path).unwrap());
        tracing::subscriber::with_default(subscriber, events);
        let mut buffer = vec![0; 1 << 18];
        std::iter::from_fn(|| journald.recv(&mut buffer).ok().map(|length| decode(&buffer[..length])))
            .collect()
    }

    #[test]
    fn each_field_of_an_event_is_a_field_of_its_entry() {
        let entries = received(|| {
            tracing::warn!(
                route = "scan",
                lane = "critical",
                priority = 7,
                "samples dropped: {}",
                "two\nlines"
            );
            tracing::info!(error.kind = ?Some("ä"), "x");
        });
        let expected = [
            ("BRIDGE_LANE", "critical"),
            ("BRIDGE_PRIORITY", "7"),
            ("BRIDGE_ROUTE", "scan"),
            ("MESSAGE", "samples dropped: two\nlines route=scan lane=critical priority=7"),
            ("PRIORITY", "4"),
            ("SYSLOG_IDENTIFIER", "adaptive-bridge"),
            ("TARGET", module_path!()),
        ];
        assert_eq!(entries[0], expected.map(|(name, value)| (name.to_owned(), value.to_owned())).into());
        assert_eq!(entries[1]["BRIDGE_ERROR_KIND"], "Some(\"ä\")");
        assert_eq!((entries.len(), entries[1]["PRIORITY"].as_str()), (2, "6"));
    }

    #[test]
    fn an_event_of_any_length_reaches_the_journal() {
        let entries = received(|| tracing::error!("{}", "ä".repeat(MAX_MESSAGE_BYTES)));
        assert_eq!(entries[0]["MESSAGE"].len(), MAX_MESSAGE_BYTES);
    }

    #[test]
    fn the_journal_is_used_only_if_the_log_is_connected_to_it() {
        let log = File::open("/dev/null").unwrap();
        assert!(Journal::for_log(&log, None).is_none());
        assert!(Journal::for_log(&log, Some("0:0".into())).is_none());
        assert!(Journal::for_log(&log, Some("what".into())).is_none());
    }
}
