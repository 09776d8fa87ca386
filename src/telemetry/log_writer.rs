//! Writes the lines of the log to stderr from a thread of its own, so that no other thread blocks when stderr
//! is not read: a terminal that is paused or on the other side of a link that is down, or a full pipe.

use std::io::{self, Write};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::mpsc::{Receiver, SyncSender, TryRecvError, sync_channel};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use crate::clock;

/// Lines that wait for stderr: about 200 KB. Further ones are dropped and counted.
const MAX_WAITING: usize = 1_024;

/// How long a process that ends waits for its last lines to be written.
const FLUSH_MS: u64 = 500;

/// Set by the first line: a service logs to the journal, and most commands log nothing.
static STDERR: OnceLock<io::Result<LogWriter>> = OnceLock::new();

/// Writes one line of the log to stderr. Does not wait, unless the system had no thread left.
///
/// # Errors
/// The system had no thread left, and stderr is closed.
pub fn write_log_line(line: &[u8]) -> io::Result<()> {
    match STDERR.get_or_init(|| LogWriter::to(io::stderr())) {
        Ok(writer) => {
            writer.write(line);
            Ok(())
        }
        Err(_) => io::stderr().write_all(line),
    }
}

/// Waits until the lines of the log are written, for half a second at most.
pub fn flush_logs() {
    if let Some(Ok(writer)) = STDERR.get() {
        writer.flush(FLUSH_MS);
    }
}

/// A writer for the layer that formats events: it writes each as one line.
pub(super) struct LogLines;

impl Write for LogLines {
    fn write(&mut self, line: &[u8]) -> io::Result<usize> {
        write_log_line(line).map(|()| line.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

enum Message {
    Line(Vec<u8>),
    Flush(SyncSender<()>),
}

struct LogWriter {
    messages: SyncSender<Message>,
    dropped: Arc<AtomicU64>,
}

impl LogWriter {
    /// # Errors
    /// The system has no thread left.
    fn to(output: impl Write + Send + 'static) -> io::Result<Self> {
        let (messages, waiting) = sync_channel(MAX_WAITING);
        let dropped = Arc::new(AtomicU64::new(0));
        let counted = Arc::clone(&dropped);
        std::thread::Builder::new()
            .name("log".to_owned())
            .spawn(move || write_all(&waiting, &counted, output))?;
        Ok(Self { messages, dropped })
    }

    fn write(&self, line: &[u8]) {
        if self.messages.try_send(Message::Line(line.to_vec())).is_err() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
    }

    #[allow(clippy::disallowed_methods, reason = "only a process that ends waits for its log")]
    fn flush(&self, timeout_ms: u64) {
        let (done, is_done) = sync_channel(1);
        let end = clock::monotonic().plus_ms(timeout_ms);
        let mut is_queued = false;
        while clock::monotonic() < end {
            is_queued = is_queued || self.messages.try_send(Message::Flush(done.clone())).is_ok();
            if is_done.recv_timeout(Duration::from_millis(1)).is_ok() {
                return;
            }
        }
    }
}

/// Writes what waits until there is no writer any more. A closed stderr leaves no place to report a failure.
#[allow(clippy::disallowed_methods, reason = "this thread handles no samples")]
fn write_all(waiting: &Receiver<Message>, dropped: &AtomicU64, mut output: impl Write) {
    loop {
        let message = match waiting.try_recv() {
            Ok(message) => message,
            Err(none) => {
                let dropped = dropped.swap(0, Ordering::Relaxed);
                if dropped > 0 {
                    let _ =
                        writeln!(output, "dropped {dropped} lines of the log, because stderr was not read");
                }
                if none == TryRecvError::Disconnected {
                    return;
                }
                let Ok(message) = waiting.recv() else { return };
                message
            }
        };
        match message {
            Message::Line(line) => {
                let _ = output.write_all(&line);
            }
            Message::Flush(done) => {
                let _ = done.try_send(());
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::io::{BufRead, BufReader};
    use std::os::unix::net::UnixStream;

    use super::*;

    #[test]
    fn a_line_is_written_and_flushed() {
        let (read, write) = UnixStream::pair().unwrap();
        read.set_nonblocking(true).unwrap();
        let writer = LogWriter::to(write).unwrap();
        for line in ["one\n", "two\n"] {
            writer.write(line.as_bytes());
        }
        writer.flush(60_000);
        let lines: Vec<String> = BufReader::new(read).lines().map_while(Result::ok).collect();
        assert_eq!(lines, ["one", "two"]);
    }

    #[test]
    fn lines_that_nobody_reads_are_dropped_and_counted_and_the_rest_stays_in_order() {
        const LINES: usize = 10_000;
        let (read, write) = UnixStream::pair().unwrap();
        let writer = LogWriter::to(write).unwrap();
        for number in 0..LINES {
            writer.write(format!("{number} {}\n", "-".repeat(200)).as_bytes());
        }
        writer.flush(10);
        drop(writer);
        let (mut written, mut dropped) = (Vec::new(), 0);
        for line in BufReader::new(read).lines().map(Result::unwrap) {
            match line.split(' ').collect::<Vec<_>>()[..] {
                ["dropped", count, ..] => dropped += count.parse::<usize>().unwrap(),
                ref words => written.push(words[0].parse::<usize>().unwrap()),
            }
        }
        assert!(written.is_sorted());
        assert!(dropped > 0 && written.len() >= MAX_WAITING, "{dropped}");
        assert_eq!(written.len() + dropped, LINES);
    }
}
