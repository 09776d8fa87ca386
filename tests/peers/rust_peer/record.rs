//! A CSV file whose rows are written one by one, so that it is complete when the program is killed.

use std::fmt::Arguments;
use std::fs::File;
use std::io::Write;
use std::path::Path;

/// A CSV file; without a path nothing is written.
pub struct Record(Option<File>);

impl Record {
    /// Creates the file with its header.
    pub fn create(path: Option<&Path>, header: &str) -> Result<Self, String> {
        let create = |path: &Path| {
            let mut file = File::create(path)?;
            writeln!(file, "{header}")?;
            Ok::<_, std::io::Error>(file)
        };
        let failed = |error: std::io::Error| format!("--record: {error}");
        path.map(create).transpose().map(Self).map_err(failed)
    }

    /// Writes a row. A full disk ends the record, not the peer.
    pub fn row(&mut self, values: Arguments) {
        if let Some(file) = &mut self.0
            && file.write_all(format!("{values}\n").as_bytes()).is_err()
        {
            self.0 = None;
        }
    }
}
