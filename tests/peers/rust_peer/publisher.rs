//! The publisher role of the peer.

use std::time::Duration;

use adaptive_bridge::clock;
use adaptive_bridge::dds::{RawWriter, WriterEvent};
use adaptive_bridge::model::{QosProfile, SourceTimestamp, WallNs};
use bytes::Bytes;
use serde_json::json;

use super::options::Options;
use super::payload::{self, FRONT_BYTES, Filling, Front};
use super::record::Record;
use super::{Signals, distribution, emit, emit_ready, microseconds};

/// How long a wait may take before signals and the library's events are handled.
const SLICE: Duration = Duration::from_millis(10);
const PROGRESS_PERIOD_NS: u64 = 100_000_000;
/// How long the publisher waits for the acknowledgement of its last samples.
const ACKNOWLEDGEMENT_NS: u64 = 10_000_000_000;

/// Publishes according to the options until all samples are sent or a signal arrives.
pub fn publish(options: &Options, signals: &Signals) -> Result<(), String> {
    let file = match &options.payload_file {
        Some(path) => Some(std::fs::read(path).map_err(|error| format!("{}: {error}", path.display()))?),
        None => None,
    };
    let mut participant = options.join().map_err(|error| error.to_string())?;
    let qos = QosProfile {
        reliability: options.reliability,
        durability: options.durability,
        history: options.history,
        lifespan_ms: None,
        deadline_ms: None,
    };
    let writer = participant
        .create_blocking_writer(
            &options.topic,
            options.dds_type(),
            &qos,
            options.max_samples,
            options.max_blocking_ms,
        )
        .map_err(|error| error.to_string())?;
    let record = Record::create(options.record.as_deref(), "seq,time_ns,call_ns,ok")?;
    emit_ready();
    let tally = Tally::default();
    let mut publisher = Publisher { options, signals, writer, file, record, readers: 0, tally };
    publisher.begin();
    publisher.run();
    let acknowledged = publisher.linger();
    publisher.tally.emit(options.first_seq, acknowledged);
    Ok(())
}

struct Publisher<'p> {
    options: &'p Options,
    signals: &'p Signals,
    writer: RawWriter,
    /// A payload from a file, in place of generated ones.
    file: Option<Vec<u8>>,
    record: Record,
    /// The readers that are matched at present.
    readers: u64,
    tally: Tally,
}

/// The counts of the samples sent so far.
#[derive(Default)]
struct Tally {
    attempted: u64,
    ok: u64,
    skipped_ticks: u64,
    hash: u64,
    last: u64,
    calls_ns: Vec<i64>,
    begin_ns: u64,
    end_ns: u64,
    progress_ns: u64,
}

impl Publisher<'_> {
    /// Waits until it may send, and sends the priming sample if the options require one.
    fn begin(&mut self) {
        while !self.signals.stop() && self.readers < self.options.wait_match {
            self.pause(SLICE);
        }
        while !self.signals.stop() && self.options.hold && !self.signals.go() {
            self.pause(SLICE);
        }
        if self.options.prime {
            let mut bytes = vec![0; FRONT_BYTES];
            bytes[..8].copy_from_slice(&payload::PRIMING.to_le_bytes());
            let source = SourceTimestamp::from_wall(clock::wall());
            // An error is ignored: the writes after it fail for the same reason, and are counted.
            let _ = self.writer.write(Bytes::from(bytes), self.options.encap, source);
            while !self.signals.stop() && !self.acknowledged() {}
        }
    }

    fn run(&mut self) {
        let period_ns = if self.options.rate > 0.0 { (1e9 / self.options.rate) as u64 } else { 0 };
        let begin_ns = clock::monotonic().0;
        let mut due_ns = begin_ns;
        self.tally.begin_ns = begin_ns;
        loop {
            let attempted = self.tally.attempted;
            if attempted > 0 && attempted.is_multiple_of(self.options.burst) {
                self.wait_for_go();
                due_ns = clock::monotonic().0;
            } else if attempted > 0 {
                due_ns += period_ns;
                // Skips the ticks that have passed, as a timer does: a stalled write lowers the rate.
                let late_ns = clock::monotonic().0.saturating_sub(due_ns);
                if let Some(skipped) = late_ns.checked_div(period_ns) {
                    self.tally.skipped_ticks += skipped;
                    due_ns += skipped * period_ns;
                }
            }
            let all_sent = self.options.count > 0 && self.tally.attempted >= self.options.count;
            let limit = self.options.duration;
            let time_up = !limit.is_zero() && u128::from(due_ns - begin_ns) >= limit.as_nanos();
            if all_sent || time_up {
                break;
            }
            self.tell_matches();
            if period_ns > 0 {
                self.sleep_until(due_ns);
            }
            if self.signals.stop() {
                break;
            }
            self.write_next();
        }
        self.tally.emit_progress();
    }

    /// Waits for the signal to send the next burst.
    fn wait_for_go(&mut self) {
        self.signals.await_go_again();
        emit(&json!({"event": "paused", "attempted": self.tally.attempted, "ok": self.tally.ok}));
        while !self.signals.stop() && !self.signals.go() {
            self.pause(SLICE);
        }
    }

    fn write_next(&mut self) {
        let sequence = self.options.first_seq + self.tally.attempted;
        let source_age_ns = self.options.source_age_ms.as_nanos() as u64;
        let source = WallNs(clock::wall().0.saturating_sub(source_age_ns));
        let front = Front { sequence, sent_ns: clock::monotonic().0, source_ns: source.0 };
        let bytes = Bytes::from(match &self.file {
            Some(file) => file.clone(),
            None => payload::make(front, self.options.size_to_send(sequence), self.options.filling()),
        });
        let before_ns = clock::monotonic().0;
        let outcome =
            self.writer.write(bytes.clone(), self.options.encap, SourceTimestamp::from_wall(source));
        let now_ns = clock::monotonic().0;
        let hash = match self.options.filling() {
            Filling::Random { .. } => payload::hash(&[&self.options.encap.0, &bytes[..]].concat()),
            Filling::Plain => 0,
        };
        let ok = u8::from(outcome.is_ok());
        self.record.row(format_args!("{sequence},{},{},{ok}", front.sent_ns, now_ns - before_ns));
        self.tally.record(sequence, outcome.is_ok().then_some(hash), before_ns, now_ns);
        if !self.options.summary {
            let call_us = microseconds((now_ns - before_ns) as i64);
            emit(&json!({"event": "write", "seq": sequence, "call_us": call_us, "ok": outcome.is_ok()}));
        } else if now_ns - self.tally.progress_ns >= PROGRESS_PERIOD_NS {
            self.tally.progress_ns = now_ns;
            self.tally.emit_progress();
        }
    }

    /// Waits until all samples are acknowledged, 10 s at most, also after SIGTERM: a publisher that ends at
    /// once takes the last samples with it, of which a reader may still miss fragments. Then lingers.
    /// Returns whether all are acknowledged.
    fn linger(&mut self) -> bool {
        let deadline_ns = clock::monotonic().0 + ACKNOWLEDGEMENT_NS;
        let mut acknowledged = false;
        while !acknowledged && clock::monotonic().0 < deadline_ns {
            acknowledged = self.acknowledged();
        }
        emit(&json!({"event": "sent", "acknowledged": acknowledged}));
        self.sleep_until(clock::monotonic().0 + self.options.linger.as_nanos() as u64);
        acknowledged
    }

    /// Waits for up to 100 ms until every RELIABLE reader has acknowledged all samples; returns whether they
    /// have.
    fn acknowledged(&mut self) -> bool {
        self.tell_matches();
        self.writer.wait_acknowledged(Duration::from_millis(100))
    }

    fn sleep_until(&mut self, at_ns: u64) {
        while !self.signals.stop() {
            let left = Duration::from_nanos(at_ns.saturating_sub(clock::monotonic().0));
            if left.is_zero() {
                return;
            }
            self.pause(left.min(SLICE));
        }
    }

    fn pause(&mut self, how_long: Duration) {
        self.tell_matches();
        std::thread::sleep(how_long);
    }

    fn tell_matches(&mut self) {
        while let Some(event) = self.writer.poll_event() {
            match event {
                WriterEvent::Matched { joined, readers, .. } => {
                    self.readers = readers;
                    let change = if joined { 1 } else { -1 };
                    emit(&json!({"event": "matched", "current": readers, "change": change}));
                }
                WriterEvent::Incompatible { .. } => emit(&json!({"event": "incompatible_qos"})),
            }
        }
    }
}

impl Tally {
    /// Counts one call of write, with the sample's hash if it succeeded.
    fn record(&mut self, sequence: u64, hash: Option<u64>, before_ns: u64, now_ns: u64) {
        self.attempted += 1;
        self.ok += u64::from(hash.is_some());
        self.hash = self.hash.wrapping_add(hash.unwrap_or(0));
        self.last = sequence;
        self.calls_ns.push((now_ns - before_ns) as i64);
        self.end_ns = now_ns;
    }

    fn emit_progress(&self) {
        emit(&json!({"event": "progress", "attempted": self.attempted, "ok": self.ok}));
    }

    fn emit(&self, first: u64, acknowledged: bool) {
        let elapsed_s = self.end_ns.saturating_sub(self.begin_ns) as f64 / 1e9;
        // n samples span n - 1 periods.
        let periods = self.ok.saturating_sub(1) as f64;
        let rate_hz = if elapsed_s > 0.0 { periods / elapsed_s } else { 0.0 };
        emit(&json!({
            "event": "summary", "role": "pub", "attempted": self.attempted, "ok": self.ok,
            "failed": self.attempted - self.ok, "first": first, "last": self.last,
            "skipped_ticks": self.skipped_ticks, "call_us": distribution(&self.calls_ns), "rate_hz": rate_hz,
            "elapsed_s": elapsed_s, "acknowledged": acknowledged, "hash": format!("{:016x}", self.hash),
        }));
    }
}
