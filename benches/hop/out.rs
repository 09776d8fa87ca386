//! The output of a run: its summary, raw data, plots and other files, and the folder that they are written
//! to.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::SystemTime;

use adaptive_bridge_measure::hop::{Quantiles, Summary, figures, readme};
use serde_json::Value;

use super::link::Record;
use super::options::Options;

/// The results of a run so far.
pub struct Output {
    pub summary: Summary,
    raw: csv::Writer<Vec<u8>>,
    /// A row for each sample. Too large for the repository, so it is written only to the target directory.
    samples: csv::Writer<Vec<u8>>,
    /// Names and contents of files that other tools wrote, such as strace.
    files: Vec<(String, String)>,
}

/// The key columns of a row of raw data.
#[derive(Clone, Copy)]
pub struct RowKey<'a> {
    pub section: &'a str,
    pub scheduling: &'a str,
    pub case: &'a str,
    pub program: &'a str,
    pub repetition: usize,
}

impl RowKey<'_> {
    /// The values of the columns [`KEY`]. Cases lose their commas, as in the runs that are saved already.
    fn fields(self) -> [String; 5] {
        let Self { section, scheduling, case, program, repetition } = self;
        let case = case.replace(',', "");
        [section.to_owned(), scheduling.to_owned(), case, program.to_owned(), repetition.to_string()]
    }
}

/// The names of the key columns.
const KEY: [&str; 5] = ["section", "scheduling", "case", "program", "repetition"];

impl Output {
    pub fn new(summary: Summary) -> Self {
        let with_columns = |columns: &[&str]| {
            let mut writer = csv::Writer::from_writer(Vec::new());
            add(&mut writer, KEY.iter().chain(columns));
            writer
        };
        Self {
            summary,
            raw: with_columns(&["figure", "value"]),
            samples: with_columns(&["written_at_ns", "late_us", "latency_us", "dds_in_us", "dds_out_us"]),
            files: Vec::new(),
        }
    }

    /// Adds one figure of one repetition to the raw data.
    pub fn raw(&mut self, key: RowKey, figure: &str, value: f64) {
        add(&mut self.raw, key.fields().into_iter().chain([figure.to_owned(), short(value)]));
    }

    /// Adds the quantiles of one repetition to the raw data.
    pub fn raw_quantiles(&mut self, key: RowKey, name: &str, quantiles: &Quantiles) {
        for (quantile, value) in [
            ("p50", quantiles.p50_us),
            ("p99", quantiles.p99_us),
            ("p99.9", quantiles.p999_us),
            ("max", quantiles.max_us),
        ] {
            if let Some(value) = value {
                self.raw(key, &format!("{name} {quantile} us"), value);
            }
        }
    }

    /// Adds the number of missing samples, in total and by known reason, to the raw data.
    pub fn raw_missing(&mut self, key: RowKey, missing: u64, reasons: &BTreeMap<String, u64>) {
        self.raw(key, "missing", missing as f64);
        for (reason, count) in reasons {
            self.raw(key, &format!("missing: {reason}"), *count as f64);
        }
    }

    /// Adds a line for one sample to samples.csv. Its write time is of CLOCK_MONOTONIC, which is the clock
    /// `mono` of a kernel trace.
    pub fn sample(&mut self, key: RowKey, record: &Record) {
        let [late, latency, dds_in, dds_out] =
            [record.late_us(), record.latency_us(), record.dds_in_us(), record.dds_out_us()].map(short);
        let values = [record.written_at.to_string(), late, latency, dds_in, dds_out];
        add(&mut self.samples, key.fields().into_iter().chain(values));
    }

    /// Records that something was not measured, and why.
    pub fn skip(&mut self, line: String) {
        eprintln!("bench: {line}");
        if !self.summary.skipped.contains(&line) {
            self.summary.skipped.push(line);
        }
    }

    /// Adds a file that another tool wrote.
    pub fn file(&mut self, name: &str, text: String) {
        self.files.push((name.to_owned(), text));
    }

    /// Prints the tables, writes the files of the run and returns its folder.
    pub fn finish(self, options: &Options) -> Result<PathBuf, String> {
        println!("{}", readme(&self.summary));
        let manifest = Path::new(env!("CARGO_MANIFEST_DIR"));
        let target =
            std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| manifest.join("target"), PathBuf::from);
        let folder = target.join("bench").join(&self.summary.date);
        let [raw, samples] = [self.raw, self.samples]
            .map(|rows| rows.into_inner().map_err(|error| format!("the rows of a CSV file: {error}")));
        let raw = raw?;
        write_to(&folder, &self.summary, &raw, &self.files)?;
        write(&folder.join("samples.csv"), &samples?)?;
        if options.save {
            let saved = manifest.join("benches").join("runs").join(&self.summary.date);
            write_to(&saved, &self.summary, &raw, &self.files)?;
            compress(&saved.join("raw.csv"));
            println!("saved in {}", saved.display());
        }
        Ok(folder)
    }
}

fn write_to(folder: &Path, summary: &Summary, raw: &[u8], files: &[(String, String)]) -> Result<(), String> {
    fs::create_dir_all(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    let mut json = serde_json::to_value(summary).map_err(|error| error.to_string())?;
    drop_nulls(&mut json);
    write(&folder.join("summary.json"), format!("{json}\n").as_bytes())?;
    write(&folder.join("raw.csv"), raw)?;
    write(&folder.join("README.md"), readme(summary).as_bytes())?;
    for (name, text) in figures(summary).iter().chain(files) {
        write(&folder.join(name), text.as_bytes())?;
    }
    Ok(())
}

/// Leaves out the figures that were not measured, which are a fifth of a summary.
fn drop_nulls(json: &mut Value) {
    match json {
        Value::Object(fields) => {
            fields.values_mut().for_each(drop_nulls);
            fields.retain(|_, value| !value.is_null());
        }
        Value::Array(values) => values.iter_mut().for_each(drop_nulls),
        _ => {}
    }
}

/// Replaces a file by a compressed one, with the `xz` command; without the command the file stays as it is.
fn compress(path: &Path) {
    let status = Command::new("xz").args(["-9e", "--force"]).arg(path).status();
    if !status.is_ok_and(|status| status.success()) {
        eprintln!("not compressed, as xz failed: {}", path.display());
    }
}

/// Adds a row to a file that is kept in memory, which does not fail.
fn add(writer: &mut csv::Writer<Vec<u8>>, fields: impl Iterator<Item: AsRef<[u8]>>) {
    let _ = writer.write_record(fields);
}

/// A value with two decimals; a hundredth of a µs is below the resolution of the clocks.
fn short(value: f64) -> String {
    if value.is_finite() { format!("{value:.2}") } else { String::new() }
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), String> {
    fs::write(path, bytes).map_err(|error| format!("{}: {error}", path.display()))
}

/// An instant such as `2025-11-20T14-05-00Z`, formatted by the `date` command.
pub fn date(instant: SystemTime) -> String {
    let seconds = instant.duration_since(SystemTime::UNIX_EPOCH).map_or(0, |since| since.as_secs());
    Command::new("date")
        .args(["-u", "-d", &format!("@{seconds}"), "+%Y-%m-%dT%H-%M-%SZ"])
        .output()
        .ok()
        .filter(|output| output.status.success())
        .map_or_else(
            || seconds.to_string(),
            |output| String::from_utf8_lossy(&output.stdout).trim().to_owned(),
        )
}
