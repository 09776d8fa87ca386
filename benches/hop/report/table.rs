//! Markdown tables whose columns are also aligned as plain text.

use std::fmt::Write as _;

/// The longest cell of a column of figures; columns with a longer cell hold text.
const MAX_FIGURE_CHARS: usize = 24;

/// A table. The first column and columns of text are flush left, columns of figures flush right.
pub struct Table {
    rows: Vec<Vec<String>>,
}

impl Table {
    pub fn new(heads: &[&str]) -> Self {
        Self { rows: vec![heads.iter().map(|head| (*head).to_owned()).collect()] }
    }

    /// Adds a row; missing cells stay empty.
    pub fn row(&mut self, cells: impl IntoIterator<Item = String>) {
        let columns = self.rows[0].len();
        let mut cells: Vec<String> = cells.into_iter().map(|cell| cell.replace('|', "/")).collect();
        cells.resize(columns, String::new());
        self.rows.push(cells);
    }

    pub fn is_empty(&self) -> bool {
        self.rows.len() == 1
    }

    pub fn text(&self) -> String {
        let width = |column: usize| {
            self.rows.iter().map(|row| row[column].chars().count()).max().unwrap_or_default().max(3)
        };
        let widths: Vec<usize> = (0..self.rows[0].len()).map(width).collect();
        let left: Vec<bool> = widths
            .iter()
            .enumerate()
            .map(|(column, width)| column == 0 || *width > MAX_FIGURE_CHARS)
            .collect();
        let mut text = String::new();
        for (index, row) in self.rows.iter().enumerate() {
            for ((cell, width), left) in row.iter().zip(&widths).zip(&left) {
                let _ =
                    if *left { write!(text, "| {cell:<width$} ") } else { write!(text, "| {cell:>width$} ") };
            }
            text.push_str("|\n");
            if index == 0 {
                for (width, left) in widths.iter().zip(&left) {
                    let dashes = "-".repeat(width - usize::from(!left));
                    let _ = write!(text, "| {dashes}{} ", if *left { "" } else { ":" });
                }
                text.push_str("|\n");
            }
        }
        text
    }
}
