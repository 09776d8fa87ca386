//! Where the results go: the summary, the raw data beside it, the folder of the run.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::SystemTime;

use super::link::Record;
use super::options::Options;
use super::report::{Quantiles, Summary, figures, readme};

/// What a run has given so far.
pub struct Output {
    pub summary: Summary,
    raw: String,
    /// Every sample: too much to keep with the project, so it stays beside what was built.
    samples: String,
    /// Files that other tools wrote, such as strace.
    files: Vec<(String, String)>,
}

/// What a figure of the raw data is of.
#[derive(Clone, Copy)]
pub struct Of<'a> {
    pub section: &'a str,
    pub scheduling: &'a str,
    pub case: &'a str,
    pub program: &'a str,
    pub repetition: usize,
}

impl Output {
    pub fn new(summary: Summary) -> Self {
        Self {
            summary,
            raw: "section,scheduling,case,program,repetition,figure,value\n".to_owned(),
            samples: "section,scheduling,case,program,repetition,written_at_ns,late_us,latency_us,dds_in_us,\
                      dds_out_us\n"
                .to_owned(),
            files: Vec::new(),
        }
    }

    /// One figure of one repetition.
    pub fn raw(&mut self, of: Of, figure: &str, value: f64) {
        let Of { section, scheduling, case, program, repetition } = of;
        let case = case.replace(',', "");
        let _ = writeln!(
            self.raw,
            "{section},{scheduling},{case},{program},{repetition},{figure},{}",
            short(value)
        );
    }

    /// A distribution of one repetition.
    pub fn raw_quantiles(&mut self, of: Of, name: &str, quantiles: &Quantiles) {
        for (quantile, value) in [
            ("p50", quantiles.p50_us),
            ("p99", quantiles.p99_us),
            ("p99.9", quantiles.p999_us),
            ("max", quantiles.max_us),
        ] {
            if let Some(value) = value {
                self.raw(of, &format!("{name} {quantile} us"), value);
            }
        }
    }

    /// How many samples did not arrive, and what became of them.
    pub fn raw_missing(&mut self, of: Of, missing: u64, reasons: &BTreeMap<String, u64>) {
        self.raw(of, "missing", missing as f64);
        for (reason, count) in reasons {
            self.raw(of, &format!("missing: {reason}"), *count as f64);
        }
    }

    /// One sample. When it was written is by CLOCK_MONOTONIC, as a trace of the kernel has it with the clock
    /// `mono`.
    pub fn sample(&mut self, of: Of, record: &Record) {
        let [late, latency, dds_in, dds_out] =
            [record.late_us(), record.latency_us(), record.dds_in_us(), record.dds_out_us()].map(short);
        let Of { section, scheduling, case, program, repetition } = of;
        let (case, written_at) = (case.replace(',', ""), record.written_at);
        let _ = writeln!(
            self.samples,
            "{section},{scheduling},{case},{program},{repetition},{written_at},{late},{latency},{dds_in},{dds_out}"
        );
    }

    pub fn file(&mut self, name: &str, text: String) {
        self.files.push((name.to_owned(), text));
    }

    /// Prints the tables, writes the run, and yields its folder.
    pub fn finish(&self, options: &Options) -> Result<PathBuf, String> {
        println!("{}", readme(&self.summary));
        let manifest = Path::new(env!("CARGO_MANIFEST_DIR"));
        let target =
            std::env::var_os("CARGO_TARGET_DIR").map_or_else(|| manifest.join("target"), PathBuf::from);
        let folder = target.join("bench").join(&self.summary.date);
        self.write_to(&folder)?;
        write(&folder.join("samples.csv"), &self.samples)?;
        if options.save {
            let kept = manifest.join("benches").join("runs").join(&self.summary.date);
            self.write_to(&kept)?;
            println!("kept in {}", kept.display());
        }
        Ok(folder)
    }

    fn write_to(&self, folder: &Path) -> Result<(), String> {
        fs::create_dir_all(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
        let summary = serde_json::to_string_pretty(&self.summary).map_err(|error| error.to_string())?;
        write(&folder.join("summary.json"), &(summary + "\n"))?;
        write(&folder.join("raw.csv"), &self.raw)?;
        write(&folder.join("README.md"), &readme(&self.summary))?;
        for (name, text) in figures(&self.summary).iter().chain(&self.files) {
            write(&folder.join(name), text)?;
        }
        Ok(())
    }
}

/// A hundredth is less than any of the clocks can tell.
fn short(value: f64) -> String {
    if value.is_finite() { format!("{value:.2}") } else { String::new() }
}

fn write(path: &Path, text: &str) -> Result<(), String> {
    fs::write(path, text).map_err(|error| format!("{}: {error}", path.display()))
}

/// `2025-11-20T14-05-00Z`, by the system's `date`, so that no calendar has to be written here.
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
