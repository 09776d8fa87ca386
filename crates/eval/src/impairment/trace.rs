//! A trace of a link, read from a CSV file: its loss and delay over time.

use std::fs::File;
use std::io::Read;
use std::path::Path;

use super::delay::NormalDelay;
use super::error::{ImpairmentError, TraceProblem};
use super::gilbert_elliott::GilbertElliott;

/// The largest file, in bytes: a day with a row for each second is 2 MB.
const MAX_BYTES: u64 = 8 << 20;
/// The latest time of a row, in seconds: a day, the longest window of a run.
const TIME_MAX_S: f64 = 86_400.0;
/// The largest number of mistakes that are listed; further ones are only counted.
const PROBLEMS_SHOWN: usize = 10;

/// The names of the columns; the first three are required.
const COLUMNS: [&str; 4] = ["time_s", "loss", "delay_ms", "jitter_ms"];
const REQUIRED: usize = 3;
const TIME: usize = 0;
const LOSS: usize = 1;
const DELAY: usize = 2;
const JITTER: usize = 3;

/// Loss and delay of a link from a time on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TraceRow {
    /// When the row comes into force, in nanoseconds from the start of the trace.
    pub at_ns: u64,
    /// The loss; packets are lost independently of each other.
    pub loss: GilbertElliott,
    /// The delay of packets that are not lost.
    pub delay: NormalDelay,
}

/// A trace: at least one row, the first at 0, each later than the one before it.
#[derive(Clone, Debug, PartialEq)]
pub struct Trace {
    rows: Vec<TraceRow>,
    length_ns: u64,
}

impl Trace {
    /// Reads and parses a file; also returns its text.
    ///
    /// # Errors
    /// The file cannot be read, or has mistakes; the error lists them by line.
    pub fn load(path: &Path) -> Result<(Self, String), ImpairmentError> {
        let refused = |error| ImpairmentError::system(path.display().to_string(), error);
        let file = File::open(path).map_err(refused)?;
        let mut bytes = Vec::new();
        file.take(MAX_BYTES + 1).read_to_end(&mut bytes).map_err(refused)?;
        let bad = |problems| ImpairmentError::BadTrace { path: path.to_owned(), problems };
        if bytes.len() as u64 > MAX_BYTES {
            let what = format!("the file has more than {MAX_BYTES} bytes");
            return Err(bad(vec![TraceProblem { line: 1, what }]));
        }
        let text = String::from_utf8(bytes).map_err(|error| {
            let good = &error.as_bytes()[..error.utf8_error().valid_up_to()];
            let line = 1 + good.iter().filter(|byte| **byte == b'\n').count();
            bad(vec![TraceProblem { line, what: "must be text in UTF-8".to_owned() }])
        })?;
        let trace = Self::parse(&text).map_err(bad)?;
        Ok((trace, text))
    }

    /// Parses the text of a file: a header, then rows; commas, no quotes. Lines that start with `#` are
    /// comments.
    ///
    /// # Errors
    /// The mistakes in the text, by line.
    pub fn parse(text: &str) -> Result<Self, Vec<TraceProblem>> {
        // Spreadsheet programs write a byte order mark.
        let text = text.strip_prefix('\u{feff}').unwrap_or(text);
        let lines = text.lines().enumerate().map(|(index, line)| (index + 1, line.trim()));
        let mut lines = lines.filter(|(_, line)| !line.is_empty() && !line.starts_with('#'));
        let problem = |line, what| TraceProblem { line, what };
        let Some((header_line, header)) = lines.next() else {
            return Err(vec![problem(1, no_header())]);
        };
        let places = columns(header).map_err(|problems| {
            problems.into_iter().map(|what| problem(header_line, what)).collect::<Vec<_>>()
        })?;
        let mut rows: Vec<TraceRow> = Vec::new();
        let mut problems = Vec::new();
        let mut more = 0;
        let mut last_line = header_line;
        let mut before_s = None;
        for (line, text) in lines {
            last_line = line;
            match row(text, &places, before_s) {
                Ok((at_s, row)) => {
                    before_s = Some(at_s);
                    rows.push(row);
                }
                Err((at_s, found)) => {
                    // The next row must be later than this one if its time is valid.
                    before_s = at_s.or(before_s);
                    for what in found {
                        if problems.len() < PROBLEMS_SHOWN {
                            problems.push(problem(line, what));
                        } else {
                            more += 1;
                        }
                    }
                }
            }
        }
        if more > 0 {
            problems.push(problem(last_line, format!("{more} more mistakes up to this line")));
        }
        if problems.is_empty() && rows.is_empty() {
            problems.push(problem(header_line, "there are no rows after the header".to_owned()));
        }
        let length_ns = match rows.as_slice() {
            [.., before, last] => last.at_ns + (last.at_ns - before.at_ns),
            _ => 0,
        };
        if problems.is_empty() { Ok(Self { rows, length_ns }) } else { Err(problems) }
    }

    /// The rows, in the order of their times.
    pub fn rows(&self) -> &[TraceRow] {
        &self.rows
    }

    /// The length of the trace, in nanoseconds: the last row lasts as long as the one before it. 0 for a
    /// single row, whose end is unknown.
    pub const fn length_ns(&self) -> u64 {
        self.length_ns
    }

    /// Returns the trace with its times divided by `speed`: twice as fast with a `speed` of 2.
    #[must_use]
    pub fn at_speed(&self, speed: f64) -> Self {
        // From float to integer `as` saturates.
        let scaled = |at_ns: u64| (at_ns as f64 / speed).round() as u64;
        let rows = self.rows.iter().map(|row| TraceRow { at_ns: scaled(row.at_ns), ..*row });
        Self { rows: rows.collect(), length_ns: scaled(self.length_ns) }
    }

    /// The mean loss over the trace's time: the loss of a steady flow of packets.
    pub fn mean_loss(&self) -> f64 {
        if self.length_ns == 0 {
            return self.rows.last().map_or(0.0, |row| row.loss.stationary_loss());
        }
        let ends = self.rows.iter().skip(1).map(|row| row.at_ns).chain([self.length_ns]);
        let weighed = self.rows.iter().zip(ends);
        let sum: f64 = weighed
            .map(|(row, end_ns)| row.loss.stationary_loss() * end_ns.saturating_sub(row.at_ns) as f64)
            .sum();
        sum / self.length_ns as f64
    }
}

fn no_header() -> String {
    format!("there is no header; it must be {}", COLUMNS.join(","))
}

/// Finds the place of each of [`COLUMNS`] in a header.
fn columns(header: &str) -> Result<[Option<usize>; COLUMNS.len()], Vec<String>> {
    let names: Vec<&str> = header.split(',').map(str::trim).collect();
    if !names.iter().any(|name| COLUMNS.contains(name)) {
        return Err(vec![no_header()]);
    }
    let mut problems = Vec::new();
    for (at, name) in names.iter().enumerate() {
        if !COLUMNS.contains(name) {
            problems.push(format!("unknown column '{name}'; the columns are {}", COLUMNS.join(", ")));
        } else if names[..at].contains(name) {
            problems.push(format!("there are two columns {name}"));
        }
    }
    let places = COLUMNS.map(|column| names.iter().position(|name| *name == column));
    for (column, place) in COLUMNS.iter().zip(&places).take(REQUIRED) {
        if place.is_none() {
            problems.push(format!("there is no column {column}; the header must be {}", COLUMNS.join(",")));
        }
    }
    if problems.is_empty() { Ok(places) } else { Err(problems) }
}

/// Parses a row; returns its time in seconds and the row, or its time if that is valid and its mistakes.
fn row(
    text: &str,
    places: &[Option<usize>; COLUMNS.len()],
    before_s: Option<f64>,
) -> Result<(f64, TraceRow), (Option<f64>, Vec<String>)> {
    let fields: Vec<&str> = text.split(',').map(str::trim).collect();
    let wanted = places.iter().flatten().count();
    if fields.len() != wanted {
        return Err((None, vec![format!("{} fields, but the header has {wanted}", fields.len())]));
    }
    let mut problems = Vec::new();
    let mut number = |column: usize, allowed: &str, is_allowed: &dyn Fn(f64) -> bool| {
        let text = places[column].map(|place| fields[place])?;
        let value = text.parse().ok().filter(|value: &f64| is_allowed(*value));
        if value.is_none() {
            problems.push(format!("{} is '{text}', but must be {allowed}", COLUMNS[column]));
        }
        value
    };
    let time_s = match before_s {
        None => number(TIME, "0 in the first row", &|value| value == 0.0),
        Some(before_s) => {
            let allowed = format!("above {before_s}, the time of the previous row, and at most {TIME_MAX_S}");
            number(TIME, &allowed, &|value| value > before_s && value <= TIME_MAX_S)
        }
    };
    let loss = number(LOSS, "0 to 1 (a share, not percent)", &|value| (0.0..=1.0).contains(&value));
    let is_delay = |value: f64| NormalDelay::new(value, 0.0).is_ok();
    let delay_ms = number(DELAY, "0 to 60000 ms", &is_delay);
    let jitter_ms = match places[JITTER] {
        Some(_) => number(JITTER, "0 to 60000 ms", &is_delay),
        None => Some(0.0),
    };
    let (Some(time_s), Some(loss), Some(delay_ms), Some(jitter_ms)) = (time_s, loss, delay_ms, jitter_ms)
    else {
        return Err((time_s, problems));
    };
    let out_of_range = |error: ImpairmentError| (Some(time_s), vec![error.to_string()]);
    let loss = GilbertElliott::independent(loss).map_err(out_of_range)?;
    let delay = NormalDelay::new(delay_ms, jitter_ms).map_err(out_of_range)?;
    // From float to integer `as` saturates.
    Ok((time_s, TraceRow { at_ns: (time_s * 1e9).round() as u64, loss, delay }))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn problems(text: &str) -> Vec<String> {
        let problems = Trace::parse(text).expect_err(text);
        problems.into_iter().map(|TraceProblem { line, what }| format!("{line}: {what}")).collect()
    }

    fn row(at_s: f64, loss: f64, delay_ms: f64, jitter_ms: f64) -> TraceRow {
        TraceRow {
            at_ns: (at_s * 1e9) as u64,
            loss: GilbertElliott::independent(loss).expect("a probability"),
            delay: NormalDelay::new(delay_ms, jitter_ms).expect("in range"),
        }
    }

    #[test]
    fn columns_are_found_by_name_and_jitter_is_optional() {
        let trace = Trace::parse("time_s,loss,delay_ms\n0,0,5\n0.5,1,60000\n").expect("a trace");
        assert_eq!(trace.rows(), [row(0.0, 0.0, 5.0, 0.0), row(0.5, 1.0, 60_000.0, 0.0)]);
        let text =
            "\u{feff}# made up\r\n\r\n delay_ms , jitter_ms,time_s,loss\r\n1, 2,0,0.25\r\n# so\r\n3,4,9,1e-3";
        let trace = Trace::parse(text).expect("a trace");
        assert_eq!(trace.rows(), [row(0.0, 0.25, 1.0, 2.0), row(9.0, 0.001, 3.0, 4.0)]);
    }

    #[test]
    fn a_mistake_has_line_column_value_and_allowed_range() {
        const HEADER: &str = "time_s,loss,delay_ms\n";
        let share = "but must be 0 to 1 (a share, not percent)";
        for (text, message) in [
            ("", "1: there is no header; it must be time_s,loss,delay_ms,jitter_ms"),
            ("# nothing\n\n", "1: there is no header; it must be time_s,loss,delay_ms,jitter_ms"),
            ("0,0,5\n", "1: there is no header; it must be time_s,loss,delay_ms,jitter_ms"),
            (
                "#\ntime_s,loss\n0,0\n",
                "2: there is no column delay_ms; the header must be time_s,loss,delay_ms,jitter_ms",
            ),
            ("time_s,loss,delay_ms,loss\n", "1: there are two columns loss"),
            (
                "time_s,loss,delay_ms,bandwidth_kbit\n",
                "1: unknown column 'bandwidth_kbit'; the columns are time_s, loss, delay_ms, jitter_ms",
            ),
            (HEADER, "1: there are no rows after the header"),
            (&format!("{HEADER}0,0\n"), "2: 2 fields, but the header has 3"),
            (&format!("{HEADER}0,0,5,\n"), "2: 4 fields, but the header has 3"),
            (&format!("{HEADER}1,0,5\n"), "2: time_s is '1', but must be 0 in the first row"),
            (&format!("{HEADER}-1,0,5\n"), "2: time_s is '-1', but must be 0 in the first row"),
            (
                &format!("{HEADER}0,0,5\n#\n2,0,5\n2,0,5\n"),
                "5: time_s is '2', but must be above 2, the time of the previous row, and at most 86400",
            ),
            (
                &format!("{HEADER}0,0,5\n86401,0,5\n"),
                "3: time_s is '86401', but must be above 0, the time of the previous row, and at most 86400",
            ),
            (
                &format!("{HEADER}0,0,5\nnan,0,5\n"),
                "3: time_s is 'nan', but must be above 0, the time of the previous row, and at most 86400",
            ),
            (&format!("{HEADER}0,5,5\n"), &format!("2: loss is '5', {share}")),
            (&format!("{HEADER}0,5%,5\n"), &format!("2: loss is '5%', {share}")),
            (&format!("{HEADER}0,-0.1,5\n"), &format!("2: loss is '-0.1', {share}")),
            (&format!("{HEADER}0,NaN,5\n"), &format!("2: loss is 'NaN', {share}")),
            (&format!("{HEADER}0,,5\n"), &format!("2: loss is '', {share}")),
            (&format!("{HEADER}0,\"0\",5\n"), &format!("2: loss is '\"0\"', {share}")),
            (&format!("{HEADER}0,0,-5\n"), "2: delay_ms is '-5', but must be 0 to 60000 ms"),
            (&format!("{HEADER}0,0,inf\n"), "2: delay_ms is 'inf', but must be 0 to 60000 ms"),
            ("time_s,loss,delay_ms,jitter_ms\n0,0,5,x\n", "2: jitter_ms is 'x', but must be 0 to 60000 ms"),
        ] {
            assert_eq!(problems(text), [message], "{text}");
        }
    }

    #[test]
    fn all_mistakes_are_listed_up_to_a_limit() {
        // A line without a valid time does not change the lower limit of the next time.
        let found = problems("time_s,loss,delay_ms\n0,2,-1\n1\nx,0,0\n0,0,0\n1,0,0\n");
        let lines: Vec<&str> =
            found.iter().map(|problem| problem.split(" is ").next().unwrap_or("")).collect();
        assert_eq!(
            lines,
            ["2: loss", "2: delay_ms", "3: 1 fields, but the header has 3", "4: time_s", "5: time_s"]
        );
        let many = format!("time_s,loss,delay_ms\n{}", "0,9,9\n".repeat(1_000));
        let found = problems(&many);
        assert_eq!(found.len(), PROBLEMS_SHOWN + 1);
        assert_eq!(found[PROBLEMS_SHOWN], "1001: 1989 more mistakes up to this line");
    }

    #[test]
    fn errors_of_a_file_have_its_path_and_the_line() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.csv");
        let message = |bytes: &[u8]| {
            std::fs::write(&path, bytes).expect("written");
            Trace::load(&path).expect_err("no trace").to_string()
        };
        let name = path.display();
        assert_eq!(message(b"time_s,loss,delay_ms\n0,0,0\n\xff"), format!("{name}:3: must be text in UTF-8"));
        let two = message(b"time_s,loss,delay_ms\n0,2,-1\n");
        assert!(two.starts_with(&format!("{name}:2: loss is '2', but must be 0 to 1")), "{two}");
        assert!(two.contains(&format!("\n{name}:2: delay_ms is '-1'")), "{two}");
        assert!(message(&vec![b'#'; MAX_BYTES as usize + 1]).contains("more than 8388608 bytes"));
        let missing = Trace::load("/nowhere/a.csv".as_ref()).expect_err("no file").to_string();
        assert!(missing.contains("/nowhere/a.csv: No such file"), "{missing}");
    }

    #[test]
    fn the_last_row_lasts_as_long_as_the_one_before_it() {
        let trace = Trace::parse("time_s,loss,delay_ms\n0,0,0\n3,1,0\n4,0.5,0\n").expect("a trace");
        assert_eq!(trace.length_ns(), 5_000_000_000);
        // 3 s without loss, 1 s of full loss and 1 s of half.
        assert!((trace.mean_loss() - 1.5 / 5.0).abs() < 1e-12);
        let fast = trace.at_speed(4.0);
        assert_eq!(
            fast.rows().iter().map(|row| row.at_ns).collect::<Vec<_>>(),
            [0, 750_000_000, 1_000_000_000]
        );
        assert!((fast.mean_loss() - trace.mean_loss()).abs() < 1e-12);
        let one = Trace::parse("time_s,loss,delay_ms\n0,0.5,0\n").expect("a trace");
        assert_eq!((one.length_ns(), one.mean_loss()), (0, 0.5));
    }

    proptest! {
        #[test]
        fn parsing_any_text_terminates(text in "[0-9a-z_,.#\\-\n ]{0,300}", valid: bool) {
            let text = if valid { format!("time_s,loss,delay_ms\n0,0,0\n{text}") } else { text };
            match Trace::parse(&text) {
                Ok(trace) => {
                    prop_assert!(trace.rows()[0].at_ns == 0);
                    prop_assert!(trace.rows().windows(2).all(|pair| pair[0].at_ns <= pair[1].at_ns));
                }
                Err(problems) => {
                    let lines = text.lines().count().max(1);
                    prop_assert!((1..=PROBLEMS_SHOWN + 1).contains(&problems.len()));
                    prop_assert!(problems.iter().all(|problem| (1..=lines).contains(&problem.line)));
                }
            }
        }
    }
}
