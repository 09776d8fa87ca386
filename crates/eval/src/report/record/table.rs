//! Reads the CSV files of a run by the names of their columns.

use std::fs::File;
use std::io::ErrorKind;
use std::path::Path;
use std::str::FromStr;

use csv::{Position, StringRecord};

use super::super::error::ReportError;

/// The requested columns of a row of a CSV file.
pub struct Row<'a, const N: usize> {
    path: &'a Path,
    columns: [&'a str; N],
    /// Where the columns are in the file.
    places: [usize; N],
    record: &'a StringRecord,
}

impl<'a, const N: usize> Row<'a, N> {
    /// The text of a column, by its index in the requested columns.
    pub fn text(&self, column: usize) -> &'a str {
        &self.record[self.places[column]]
    }

    /// Parses the number in a column.
    pub fn number<T: FromStr>(&self, column: usize) -> Result<T, ReportError> {
        self.text(column).parse().map_err(|_| {
            let problem =
                format!("{} is '{}', but must be a number", self.columns[column], self.text(column));
            ReportError::content(self.path, line(self.record.position()), problem)
        })
    }
}

fn line(position: Option<&Position>) -> usize {
    position.map_or(0, |position| position.line() as usize)
}

/// Reads a file and converts each row with `read`. The file may have further columns.
pub fn read<T, const N: usize>(
    path: &Path,
    columns: [&str; N],
    mut read: impl FnMut(Row<N>) -> Result<T, ReportError>,
) -> Result<Vec<T>, ReportError> {
    let file = File::open(path).map_err(ReportError::file(path))?;
    let refused = |error: csv::Error| ReportError::content(path, line(error.position()), error.to_string());
    // Rows of other lengths are refused below, with a message that names the header.
    let mut reader = csv::ReaderBuilder::new().flexible(true).from_reader(file);
    let header = reader.headers().map_err(refused)?.clone();
    let mut places = [0; N];
    for (place, column) in places.iter_mut().zip(columns) {
        let found = header.iter().position(|name| name == column);
        *place =
            found.ok_or_else(|| ReportError::content(path, 1, format!("there is no column {column}")))?;
    }
    let mut rows = Vec::new();
    let mut record = StringRecord::new();
    while reader.read_record(&mut record).map_err(refused)? {
        if record.len() != header.len() {
            let problem = format!("{} fields, but the header has {}", record.len(), header.len());
            return Err(ReportError::content(path, line(record.position()), problem));
        }
        rows.push(read(Row { path, columns, places, record: &record })?);
    }
    Ok(rows)
}

/// Like [`read`], but returns no rows if the file does not exist.
pub fn read_if_exists<T, const N: usize>(
    path: &Path,
    columns: [&str; N],
    row: impl FnMut(Row<N>) -> Result<T, ReportError>,
) -> Result<Vec<T>, ReportError> {
    match read(path, columns, row) {
        Err(ReportError::File { source, .. }) if source.kind() == ErrorKind::NotFound => Ok(Vec::new()),
        other => other,
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn rows(text: &str) -> Result<Vec<(u64, String)>, String> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.csv");
        fs::write(&path, text).unwrap();
        read(&path, ["seq", "what"], |row| Ok((row.number(0)?, row.text(1).to_owned())))
            .map_err(|error| error.to_string().rsplit('/').next().unwrap_or_default().to_owned())
    }

    #[test]
    fn columns_are_found_by_name() {
        assert_eq!(rows("what,x,seq\na,,7\n,b,8\n"), Ok(vec![(7, "a".to_owned()), (8, String::new())]));
        assert_eq!(rows("seq,what\n"), Ok(vec![]));
    }

    #[test]
    fn mistakes_are_reported_with_their_line() {
        assert_eq!(rows("seq\n1\n"), Err("a.csv:1: there is no column what".to_owned()));
        assert_eq!(rows(""), Err("a.csv:1: there is no column seq".to_owned()));
        assert_eq!(rows("seq,what\n1,a\n2\n"), Err("a.csv:3: 1 fields, but the header has 2".to_owned()));
        assert_eq!(rows("seq,what\n-1,a\n"), Err("a.csv:2: seq is '-1', but must be a number".to_owned()));
    }

    #[test]
    fn an_optional_file_may_be_missing() {
        let none = read_if_exists(Path::new("/nowhere/a.csv"), ["seq"], |row| row.number::<u64>(0));
        assert!(none.unwrap().is_empty());
    }
}
