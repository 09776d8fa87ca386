//! The subscriber role of the peer.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::task::Waker;
use std::time::Duration;

use adaptive_bridge::clock;
use adaptive_bridge::dds::{ArrivalFlag, RawReader, ReaderEvent, ReaderQos, Take};
use adaptive_bridge::model::SourceTimestamp;
use serde_json::{Value, json};

use super::options::Options;
use super::payload::{self, Filling, Verdict};
use super::record::Record;
use super::{Signals, distribution, emit, emit_ready, microseconds};

const SLICE: Duration = Duration::from_millis(100);
const PROGRESS_PERIOD_NS: u64 = 100_000_000;
/// Samples in a row, so that signals and progress get their turn in a flood.
const BATCH: usize = 64;
const MAX_MISSING_RANGES: usize = 1000;
/// An RTPS timestamp counts in 2^-32 s: converting to it and back may cost a nanosecond each time.
const SOURCE_TOLERANCE_NS: u64 = 10;
const HEADER_BYTES: usize = 4;

/// Subscribes according to the options until enough samples or a signal have arrived.
pub fn subscribe(options: &Options, signals: &Signals) -> Result<(), String> {
    let mut participant = options.join().map_err(|error| error.to_string())?;
    let qos = ReaderQos {
        reliability: options.reliability,
        durability: options.durability,
        depth: options.reader_depth(),
        deadline_ms: None,
    };
    let reader = participant
        .create_reader(&options.topic, options.dds_type(), &qos)
        .map_err(|error| error.to_string())?;
    let record = Record::create(options.record.as_deref(), "seq,time_ns,latency_ns")?;
    emit_ready();
    let flag = ArrivalFlag::of_this_thread();
    let waker = Waker::from(Arc::clone(&flag));
    let mut subscriber = Subscriber::new(options, signals, reader, record);
    while !subscriber.done() {
        subscriber.reader.arm(&waker);
        if subscriber.take_batch() < BATCH && !flag.clear() {
            std::thread::park_timeout(SLICE);
        }
        subscriber.tell_matches();
        subscriber.keep_house();
    }
    subscriber.emit_summary();
    Ok(())
}

struct Subscriber<'s> {
    options: &'s Options,
    signals: &'s Signals,
    reader: RawReader,
    record: Record,
    /// The latest sample: its encapsulation header and its payload.
    sample: Vec<u8>,
    /// The writers that are matched at present.
    writers: u64,
    begin_ns: u64,
    stalled_ns: u64,
    progress_ns: u64,
    progress_received: u64,
    last_arrival_ns: Option<u64>,
    max_gap_ns: u64,

    /// Samples received, without duplicates.
    received: u64,
    unnumbered: u64,
    duplicates: u64,
    out_of_order: u64,
    bad: u64,
    padded: u64,
    source_kept: u64,
    source_changed: u64,
    bytes: u64,
    sizes: Option<(usize, usize)>,
    hash: u64,
    seen: BTreeSet<u64>,
    headers: BTreeMap<String, u64>,
    latencies_ns: Vec<i64>,
}

impl<'s> Subscriber<'s> {
    fn new(options: &'s Options, signals: &'s Signals, reader: RawReader, record: Record) -> Self {
        let begin_ns = clock::monotonic().0;
        Self {
            options,
            signals,
            reader,
            record,
            sample: Vec::new(),
            writers: 0,
            begin_ns,
            stalled_ns: begin_ns,
            progress_ns: 0,
            progress_received: 0,
            last_arrival_ns: None,
            max_gap_ns: 0,
            received: 0,
            unnumbered: 0,
            duplicates: 0,
            out_of_order: 0,
            bad: 0,
            padded: 0,
            source_kept: 0,
            source_changed: 0,
            bytes: 0,
            sizes: None,
            hash: 0,
            seen: BTreeSet::new(),
            headers: BTreeMap::new(),
            latencies_ns: Vec::new(),
        }
    }

    /// Takes the waiting samples, up to a batch, and returns their number.
    fn take_batch(&mut self) -> usize {
        for taken in 0..BATCH {
            let sample = &mut self.sample;
            let take = self.reader.take(&mut |payload, encapsulation| {
                sample.clear();
                sample.extend_from_slice(&encapsulation.0);
                sample.extend_from_slice(payload);
            });
            match take {
                Take::Sample(origin) => self.record(origin.source_timestamp),
                Take::Malformed => self.bad += 1,
                Take::Empty => return taken,
            }
        }
        BATCH
    }

    /// Counts the sample that has just been taken.
    fn record(&mut self, source: SourceTimestamp) {
        let now_ns = clock::monotonic().0;
        let (header, payload) = self.sample.split_at(HEADER_BYTES);
        let sequence = payload::word(payload, 0).filter(|_| !self.options.opaque);
        if sequence == Some(payload::PRIMING) {
            return;
        }
        let gap_ns = self.last_arrival_ns.replace(now_ns).map_or(0, |last_ns| now_ns - last_ns);
        self.max_gap_ns = self.max_gap_ns.max(gap_ns);
        let header = header.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
        let size = payload.len();
        self.bytes += size as u64;
        let (smallest, largest) = self.sizes.unwrap_or((size, size));
        self.sizes = Some((smallest.min(size), largest.max(size)));

        let verdict = sequence.map(|sequence| {
            payload::check(payload, self.options.expected_size(sequence), self.options.filling(), sequence)
        });
        self.bad += u64::from(verdict == Some(Verdict::Bad));
        self.padded += u64::from(verdict == Some(Verdict::Padded));
        let is_later = sequence.is_none_or(|sequence| self.seen.last().is_none_or(|last| sequence > *last));
        if sequence.is_none_or(|sequence| self.seen.insert(sequence)) {
            self.received += 1;
            self.unnumbered += u64::from(sequence.is_none());
            self.out_of_order += u64::from(!is_later);
            if let Filling::Random { .. } = self.options.filling() {
                self.hash = self.hash.wrapping_add(payload::hash(&self.sample));
            }
        } else {
            self.duplicates += 1;
        }

        let stamp = |at| payload::word(payload, at).filter(|_| sequence.is_some());
        let latency_ns = stamp(8).map(|sent_ns| now_ns.wrapping_sub(sent_ns) as i64);
        self.latencies_ns.extend(latency_ns);
        if let (Some(sequence), Some(latency_ns)) = (sequence, latency_ns) {
            self.record.row(format_args!("{sequence},{now_ns},{latency_ns}"));
        }
        let source_ns = source.to_wall().map_or(0, |wall| wall.0);
        if let Some(expected_ns) = stamp(16) {
            let kept = source_ns.abs_diff(expected_ns) <= SOURCE_TOLERANCE_NS;
            *(if kept { &mut self.source_kept } else { &mut self.source_changed }) += 1;
        }
        if !self.options.summary {
            emit(&json!({
                "event": "sample", "seq": sequence, "size": size, "header": header,
                "latency_us": latency_ns.map(microseconds), "source_ns": source_ns,
                "good": verdict != Some(Verdict::Bad),
            }));
        }
        *self.headers.entry(header).or_default() += 1;
    }

    fn tell_matches(&mut self) {
        while let Some(event) = self.reader.poll_event() {
            match event {
                ReaderEvent::Matched { writers } => {
                    let change = writers as i64 - self.writers as i64;
                    self.writers = writers;
                    emit(&json!({"event": "matched", "current": writers, "change": change}));
                }
                ReaderEvent::Incompatible { .. } => emit(&json!({"event": "incompatible_qos"})),
            }
        }
    }

    /// Reports progress, and stalls when a stall is due.
    fn keep_house(&mut self) {
        let now_ns = clock::monotonic().0;
        let news = self.received != self.progress_received;
        if self.options.summary && news && now_ns - self.progress_ns >= PROGRESS_PERIOD_NS {
            self.progress_ns = now_ns;
            self.progress_received = self.received;
            let last = self.seen.last();
            emit(&json!({"event": "progress", "received": self.received, "last": last}));
        }
        let every = self.options.stall_every;
        if !every.is_zero() && u128::from(now_ns - self.stalled_ns) >= every.as_nanos() {
            let end_ns = now_ns + self.options.stall_for.as_nanos() as u64;
            while !self.signals.stop() && clock::monotonic().0 < end_ns {
                std::thread::sleep(Duration::from_millis(10));
            }
            self.stalled_ns = clock::monotonic().0;
        }
    }

    fn done(&self) -> bool {
        let enough = self.options.count > 0 && self.received >= self.options.count;
        let limit = self.options.duration;
        let elapsed_ns = u128::from(clock::monotonic().0 - self.begin_ns);
        self.signals.stop() || enough || !limit.is_zero() && elapsed_ns >= limit.as_nanos()
    }

    fn emit_summary(&self) {
        let numbers: Vec<u64> = self.seen.iter().copied().collect();
        let gaps = numbers.windows(2).map(|pair| (pair[0] + 1, pair[1] - 1));
        let missing: Vec<(u64, u64)> = gaps.filter(|(first, last)| first <= last).collect();
        let missing_count: u64 = missing.iter().map(|(first, last)| last - first + 1).sum();
        let (size_min, size_max) = self.sizes.unwrap_or_default();
        let mut summary = json!({
            "event": "summary", "role": "sub", "received": self.received, "unnumbered": self.unnumbered,
            "first": numbers.first(), "last": numbers.last(), "missing_count": missing_count,
            "missing": &missing[..missing.len().min(MAX_MISSING_RANGES)],
            "duplicates": self.duplicates, "out_of_order": self.out_of_order, "bad": self.bad,
            "padded": self.padded, "bytes": self.bytes, "size_min": size_min, "size_max": size_max,
            "headers": self.headers, "source_timestamps_kept": self.source_kept,
            "source_timestamps_changed": self.source_changed,
        });
        summary["latency_us"] = distribution(&self.latencies_ns);
        summary["max_gap_ms"] = Value::from(self.max_gap_ns as f64 / 1e6);
        summary["hash"] = Value::from(format!("{:016x}", self.hash));
        emit(&summary);
    }
}
