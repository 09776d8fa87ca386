//! A CSV file that is written row by row.

use std::fmt::Display;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use crate::eval::error::EvalError;

/// A file with a header. Values are numbers and names without commas.
pub(super) struct Csv {
    path: PathBuf,
    file: BufWriter<File>,
}

impl Csv {
    /// Begins a file of that name in a folder.
    pub fn create(folder: &Path, name: &str, header: &str) -> Result<Self, EvalError> {
        let mut csv = Self::create_without_header(folder, name)?;
        csv.line(header)?;
        Ok(csv)
    }

    /// Begins a file of other lines than values.
    pub fn create_without_header(folder: &Path, name: &str) -> Result<Self, EvalError> {
        let path = folder.join(name);
        let file = File::create(&path).map_err(|error| EvalError::file(&path, &error))?;
        Ok(Self { path, file: BufWriter::new(file) })
    }

    /// A row.
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

    /// A row as it stands.
    pub fn line(&mut self, line: &str) -> Result<(), EvalError> {
        writeln!(self.file, "{line}").map_err(|error| EvalError::file(&self.path, &error))
    }

    /// Writes out what waits.
    pub fn flush(&mut self) -> Result<(), EvalError> {
        self.file.flush().map_err(|error| EvalError::file(&self.path, &error))
    }
}
