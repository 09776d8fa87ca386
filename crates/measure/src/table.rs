//! Markdown tables whose columns are also aligned as plain text.

use comfy_table::{CellAlignment, ColumnConstraint, Width, presets};

/// The longest cell of a column of figures; columns with a longer cell hold text.
const MAX_FIGURE_CHARS: u16 = 24;

/// A table. The first column and columns of text are flush left, columns of figures flush right.
pub struct Table(comfy_table::Table);

impl Table {
    /// A table with these heads of columns and no row.
    pub fn new(heads: &[&str]) -> Self {
        let mut table = comfy_table::Table::new();
        table.load_preset(presets::ASCII_MARKDOWN).set_header(heads);
        // Three characters and a space on each side; Markdown needs three for the separator.
        table.set_constraints(heads.iter().map(|_| ColumnConstraint::LowerBoundary(Width::Fixed(5))));
        Self(table)
    }

    /// Adds a row; missing cells stay empty.
    pub fn row(&mut self, cells: impl IntoIterator<Item = String>) {
        self.0.add_row(cells.into_iter().map(|cell| cell.replace('|', "/")));
    }

    /// Whether it has no row.
    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    /// The table as text.
    pub fn text(&self) -> String {
        let mut table = self.0.clone();
        let widths = table.column_max_content_widths();
        let left: Vec<bool> = widths
            .iter()
            .enumerate()
            .map(|(column, width)| column == 0 || *width > MAX_FIGURE_CHARS)
            .collect();
        for (column, left) in table.column_iter_mut().zip(&left) {
            column.set_cell_alignment(if *left { CellAlignment::Left } else { CellAlignment::Right });
        }
        let mut lines: Vec<String> = table.lines().collect();
        // comfy-table writes a separator without the alignment of the columns.
        let dashes = lines[1].split('|').filter(|dashes| !dashes.is_empty());
        let separators = dashes.zip(&left).map(|(dashes, left)| match left {
            true => format!(" {} |", &dashes[2..]),
            false => format!(" {}: |", &dashes[3..]),
        });
        lines[1] = format!("|{}", separators.collect::<String>());
        lines.join("\n") + "\n"
    }
}
