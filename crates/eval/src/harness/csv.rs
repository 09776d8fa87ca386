//! Writes a CSV file row by row.

use std::fmt::Display;
use std::fs::File;
use std::path::{Path, PathBuf};

use crate::error::EvalError;

/// A CSV file that is being written.
pub(super) struct Csv {
    path: PathBuf,
    writer: csv::Writer<File>,
}

impl Csv {
    /// Creates a file in a folder and writes its header, the names of the columns with commas between them.
    pub fn create(folder: &Path, name: &str, header: &str) -> Result<Self, EvalError> {
        let path = folder.join(name);
        let file = File::create(&path).map_err(|error| EvalError::file(&path, &error))?;
        let mut csv = Self { path, writer: csv::Writer::from_writer(file) };
        csv.record(header.split(','))?;
        Ok(csv)
    }

    /// Writes a row; it must have a value for each column.
    pub fn row(&mut self, values: &[&dyn Display]) -> Result<(), EvalError> {
        self.record(values.iter().map(ToString::to_string))
    }

    fn record(&mut self, values: impl Iterator<Item: AsRef<[u8]>>) -> Result<(), EvalError> {
        self.writer.write_record(values).map_err(|error| EvalError::file(&self.path, &error.into()))
    }

    /// Flushes buffered rows.
    pub fn flush(&mut self) -> Result<(), EvalError> {
        self.writer.flush().map_err(|error| EvalError::file(&self.path, &error))
    }
}
