//! Tables, as Markdown for people and as CSV for programs.

use std::fmt::Write;

use crate::text::{one_line, thousands};

/// What stands in a table.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum Cell {
    /// Words.
    Text(String),
    /// How many of something.
    Count(u64),
    /// A number, and how many digits after the point people want to see of it.
    Fixed(f64, usize),
    /// A number of which people want to see so many digits.
    Digits(f64, usize),
    /// There is nothing to say.
    None,
}

impl From<&str> for Cell {
    fn from(text: &str) -> Self {
        Cell::Text(text.to_owned())
    }
}

impl From<usize> for Cell {
    fn from(count: usize) -> Self {
        Cell::Count(count as u64)
    }
}

impl Cell {
    fn markdown(&self) -> String {
        match self {
            Cell::Text(text) => one_line(text).replace('|', "\\|"),
            Cell::Count(count) => thousands(*count),
            Cell::Fixed(value, digits) if value.is_finite() => format!("{value:.digits$}"),
            Cell::Digits(value, digits) if value.is_finite() => significant(*value, *digits),
            Cell::Fixed(value, _) | Cell::Digits(value, _) if *value == f64::INFINITY => "exact".to_owned(),
            Cell::Fixed(..) | Cell::Digits(..) => "–".to_owned(),
            Cell::None => String::new(),
        }
    }

    fn csv(&self) -> String {
        match self {
            Cell::Text(text) if text.contains(['"', ',', '\n', '\r']) => {
                format!("\"{}\"", text.replace('"', "\"\""))
            }
            Cell::Text(text) => text.clone(),
            Cell::Count(count) => count.to_string(),
            Cell::Fixed(value, _) | Cell::Digits(value, _) => value.to_string(),
            Cell::None => String::new(),
        }
    }
}

/// A number with so many digits that say something; very small ones with a power of ten.
fn significant(value: f64, digits: usize) -> String {
    if value == 0.0 {
        return "0".to_owned();
    }
    let magnitude = value.abs().log10().floor() as i32;
    if magnitude < -4 {
        let fraction = digits.saturating_sub(1);
        return format!("{value:.fraction$e}");
    }
    let fraction = (digits as i32 - 1 - magnitude).max(0) as usize;
    format!("{value:.fraction$}")
}

/// A table.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Table {
    /// Its name in file names.
    pub(crate) name: &'static str,
    /// What it is about.
    pub(crate) title: &'static str,
    /// How it is to be read.
    pub(crate) note: String,
    /// The heads of columns: for people, and for programs.
    pub(crate) columns: Vec<[&'static str; 2]>,
    /// As many cells each as there are columns.
    pub(crate) rows: Vec<Vec<Cell>>,
}

impl Table {
    /// The table as Markdown.
    pub(crate) fn markdown(&self) -> String {
        let mut out = format!("## {}\n\n{}\n\n", self.title, self.note);
        let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
        let heads: Vec<String> = self.columns.iter().map(|[head, _]| (*head).to_owned()).collect();
        out += &line(&heads);
        let is_text = |column: usize| {
            self.rows.iter().all(|row| matches!(row.get(column), Some(Cell::Text(_) | Cell::None)))
        };
        let rule: Vec<String> =
            (0..heads.len()).map(|i| if is_text(i) { "---" } else { "---:" }.to_owned()).collect();
        out += &line(&rule);
        for row in &self.rows {
            out += &line(&row.iter().map(Cell::markdown).collect::<Vec<_>>());
        }
        out
    }

    /// The table as CSV (RFC 4180 but for the ends of lines), numbers in full. With `named`, the first column is the name
    /// of the table, for files of several.
    pub(crate) fn csv(&self, named: bool) -> String {
        let mut out = String::new();
        let mut line = |first: &str, cells: Vec<String>| {
            let first = if named { format!("{first},") } else { String::new() };
            // Writing to a string does not fail.
            let _ = writeln!(out, "{first}{}", cells.join(","));
        };
        line("table", self.columns.iter().map(|[_, head]| (*head).to_owned()).collect());
        for row in &self.rows {
            line(self.name, row.iter().map(Cell::csv).collect());
        }
        out
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table() -> Table {
        Table {
            name: "sizes",
            title: "Sizes",
            note: "In bytes.".to_owned(),
            columns: vec![["Model", "model"], ["Bytes", "bytes"], ["Error", "error"]],
            rows: vec![
                vec!["a|b, \"c\"".into(), Cell::Count(1_234_567), Cell::Digits(0.012_345, 3)],
                vec!["d".into(), Cell::Fixed(2.0, 2), Cell::Digits(f64::INFINITY, 3)],
                vec!["e".into(), Cell::None, Cell::Digits(0.000_012_345, 3)],
            ],
        }
    }

    #[test]
    fn markdown_is_aligned_by_kind_and_escaped() {
        let expected = "## Sizes\n\nIn bytes.\n\n| Model | Bytes | Error |\n| --- | ---: | ---: |\n\
            | a\\|b, \"c\" | 1,234,567 | 0.0123 |\n| d | 2.00 | exact |\n| e |  | 1.23e-5 |\n";
        assert_eq!(table().markdown(), expected);
    }

    #[test]
    fn csv_is_in_full_and_quoted() {
        let expected = "model,bytes,error\n\"a|b, \"\"c\"\"\",1234567,0.012345\nd,2,inf\ne,,0.000012345\n";
        assert_eq!(table().csv(false), expected);
        assert!(table().csv(true).starts_with("table,model,bytes,error\nsizes,\"a|b"));
    }

    #[test]
    fn digits_that_say_something() {
        let cases = [(0.0, "0"), (1.0, "1.00"), (123.4, "123"), (0.0102, "0.0102"), (12345.6, "12346")];
        for (value, text) in cases {
            assert_eq!(significant(value, 3), text);
        }
    }
}
