//! Writes a CSV file row by row.

use std::fmt::Display;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use crate::eval::error::EvalError;

/// A CSV file that is being written. Values are numbers and names without commas.
pub(super) struct Csv {
    path: PathBuf,
    file: BufWriter<File>,
}

impl Csv {
    /// Creates a file in a folder and writes its header.
    pub fn create(folder: &Path, name: &str, header: &str) -> Result<Self, EvalError> {
        let mut csv = Self::create_without_header(folder, name)?;
        csv.line(header)?;
        Ok(csv)
    }

    /// Creates a file without a header, for lines that are not CSV.
    pub fn create_without_header(folder: &Path, name: &str) -> Result<Self, EvalError> {
        let path = folder.join(name);
        let file = File::create(&path).map_err(|error| EvalError::file(&path, &error))?;
        Ok(Self { path, file: BufWriter::new(file) })
    }

    /// Writes a row.
    pub fn row(&mut self, values: &[&dyn Display]) -> Result<(), EvalError> {
        let mut line = String::with_capacity(128);
        for (at, value) in values.iter().enumerate() {
            if at > 0 {
                line.push(',');
            }
            line.push_str(&value.to_string());
        }
        self.line(&line)
    }

    /// Writes a line unchanged.
    pub fn line(&mut self, line: &str) -> Result<(), EvalError> {
        writeln!(self.file, "{line}").map_err(|error| EvalError::file(&self.path, &error))
    }

    /// Flushes buffered lines.
    pub fn flush(&mut self) -> Result<(), EvalError> {
        self.file.flush().map_err(|error| EvalError::file(&self.path, &error))
    }
}
