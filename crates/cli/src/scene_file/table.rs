//! A table of a TOML file that is asked for its keys one by one, and complains about those that nobody asked for. Every
//! complaint knows its place.
//!
//! A value is read by the function that reads the option of the same meaning: an array of numbers as numbers with commas
//! between them.

use std::ops::Range;

use toml::Spanned;
use toml::de::{DeString, DeTable, DeValue};

/// What is wrong, and where in the text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Wrong {
    pub(super) span: Range<usize>,
    pub(super) what: String,
}

/// A table.
pub(super) struct Table<'t, 'i> {
    /// What a message calls it.
    name: String,
    span: Range<usize>,
    entries: Vec<(&'t Spanned<DeString<'i>>, &'t Spanned<DeValue<'i>>)>,
    asked: Vec<&'static str>,
}

impl<'t, 'i> Table<'t, 'i> {
    pub(super) fn new(name: &str, span: Range<usize>, table: &'t DeTable<'i>) -> Self {
        Table { name: name.to_owned(), span, entries: table.iter().collect(), asked: Vec::new() }
    }

    /// A complaint about the table itself.
    pub(super) fn wrong(&self, what: impl Into<String>) -> Wrong {
        Wrong { span: self.span.clone(), what: what.into() }
    }

    /// Takes a value out.
    fn take(&mut self, key: &'static str) -> Option<&'t Spanned<DeValue<'i>>> {
        self.asked.push(key);
        let position = self.entries.iter().position(|(name, _)| name.get_ref() == key)?;
        Some(self.entries.swap_remove(position).1)
    }

    /// A value as the text of an option, read by what reads the option.
    pub(super) fn parsed<T>(
        &mut self,
        key: &'static str,
        parse: impl Fn(&str) -> Result<T, String>,
    ) -> Result<Option<T>, Wrong> {
        let Some(value) = self.take(key) else { return Ok(None) };
        let wrong = |what: String| Wrong { span: value.span(), what: format!("{key}: {what}") };
        let text = text_of(value.get_ref())
            .ok_or_else(|| wrong("a number, a text or an array of numbers is needed".to_owned()))?;
        parse(&text).map(Some).map_err(wrong)
    }

    /// As [`parsed`](Self::parsed), of a key that must be there.
    pub(super) fn needed<T>(
        &mut self,
        key: &'static str,
        parse: impl Fn(&str) -> Result<T, String>,
    ) -> Result<T, Wrong> {
        self.parsed(key, parse)?.ok_or_else(|| self.wrong(format!("{} needs the key '{key}'", self.name)))
    }

    /// A text.
    pub(super) fn text(&mut self, key: &'static str) -> Result<Option<String>, Wrong> {
        let Some(value) = self.take(key) else { return Ok(None) };
        match value.get_ref() {
            DeValue::String(text) => Ok(Some(text.to_string())),
            _ => Err(Wrong { span: value.span(), what: format!("{key}: a text in quotes is needed") }),
        }
    }

    /// Yes or no.
    pub(super) fn flag(&mut self, key: &'static str) -> Result<Option<bool>, Wrong> {
        let Some(value) = self.take(key) else { return Ok(None) };
        match value.get_ref() {
            DeValue::Boolean(flag) => Ok(Some(*flag)),
            _ => Err(Wrong { span: value.span(), what: format!("{key}: true or false is needed") }),
        }
    }

    /// A table inside; one without keys if it is not there.
    pub(super) fn table(&mut self, key: &'static str) -> Result<Option<Table<'t, 'i>>, Wrong> {
        let Some(value) = self.take(key) else { return Ok(None) };
        match value.get_ref() {
            DeValue::Table(table) => Ok(Some(Table::new(key, value.span(), table))),
            _ => Err(Wrong { span: value.span(), what: format!("{key}: a table is needed, as in [{key}]") }),
        }
    }

    /// A table inside, of a key that may hold something else.
    pub(super) fn table_or(&mut self, key: &'static str) -> Result<Option<Table<'t, 'i>>, Wrong> {
        let is_table = |(name, value): &(&Spanned<DeString<'i>>, &Spanned<DeValue<'i>>)| {
            name.get_ref() == key && value.get_ref().is_table()
        };
        if self.entries.iter().any(is_table) { self.table(key) } else { Ok(None) }
    }

    /// The tables of an array.
    pub(super) fn tables(&mut self, key: &'static str) -> Result<Vec<Table<'t, 'i>>, Wrong> {
        let Some(value) = self.take(key) else { return Ok(Vec::new()) };
        let wrong = |span| Wrong { span, what: format!("{key}: tables are needed, as in [[{key}]]") };
        let DeValue::Array(array) = value.get_ref() else { return Err(wrong(value.span())) };
        let table = |value: &'t Spanned<DeValue<'i>>| match value.get_ref() {
            DeValue::Table(table) => Ok(Table::new(key, value.span(), table)),
            _ => Err(wrong(value.span())),
        };
        array.iter().map(table).collect()
    }

    /// An array of arrays of numbers.
    pub(super) fn rows<const R: usize, const C: usize>(
        &mut self,
        key: &'static str,
    ) -> Result<Option<[[f64; C]; R]>, Wrong> {
        let Some(value) = self.take(key) else { return Ok(None) };
        let read = || -> Option<[[f64; C]; R]> {
            let rows = value.get_ref().as_array()?.iter().map(|row| {
                let numbers = row.get_ref().as_array()?.iter().map(|number| finite(number.get_ref()));
                numbers.collect::<Option<Vec<f64>>>()?.try_into().ok()
            });
            rows.collect::<Option<Vec<[f64; C]>>>()?.try_into().ok()
        };
        let what = format!("{key}: {R} rows of {C} numbers are needed");
        read().map(Some).ok_or(Wrong { span: value.span(), what })
    }

    /// Ends the questions.
    pub(super) fn finish(self) -> Result<(), Wrong> {
        match self.entries.iter().min_by_key(|(key, _)| key.span().start) {
            None => Ok(()),
            Some((key, _)) => Err(Wrong {
                span: key.span(),
                what: format!(
                    "{} has no key '{}'; there are {}",
                    self.name,
                    key.get_ref(),
                    self.asked.join(", ")
                ),
            }),
        }
    }
}

fn finite(value: &DeValue<'_>) -> Option<f64> {
    text_of(value)?.parse::<f64>().ok().filter(|number| number.is_finite())
}

/// A value as it would stand on the command line.
fn text_of(value: &DeValue<'_>) -> Option<String> {
    match value {
        DeValue::String(text) => Some(text.to_string()),
        DeValue::Float(float) => Some(float.as_str().replace('_', "")),
        DeValue::Integer(integer) => {
            let text = integer.as_str().replace('_', "");
            match integer.radix() {
                10 => Some(text),
                radix => i64::from_str_radix(&text, radix).ok().map(|number| number.to_string()),
            }
        }
        DeValue::Array(array) => {
            let parts = array.iter().map(|part| match part.get_ref() {
                number @ (DeValue::Float(_) | DeValue::Integer(_)) => text_of(number),
                _ => None,
            });
            parts.collect::<Option<Vec<String>>>().map(|parts| parts.join(","))
        }
        DeValue::Boolean(_) | DeValue::Datetime(_) | DeValue::Table(_) => None,
    }
}
