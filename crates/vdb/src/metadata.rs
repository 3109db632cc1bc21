//! Metadata: the named, typed values attached to a file and to each grid.
//!
//! Values are kept as the bytes that the file holds and decoded when asked for, so that types we do not know
//! survive. The text form is the one OpenVDB prints.

use std::fmt;

use crate::error::Result;
use crate::limits::Budget;
use crate::source::Reader;

/// One value: a type name and the bytes of the value, little-endian.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MetaValue {
    /// The type as the file names it: `string`, `bool`, `int32`, `vec3d`, `mat4s`, …
    pub type_name: String,
    /// The value as the file holds it.
    pub bytes: Vec<u8>,
}

/// The metadata of a file or a grid, sorted by name.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Metadata {
    entries: Vec<(String, MetaValue)>,
}

impl Metadata {
    /// Adds a value or replaces the one of that name.
    pub fn insert(&mut self, name: &str, value: MetaValue) {
        match self.entries.binary_search_by(|(key, _)| key.as_str().cmp(name)) {
            Ok(i) => self.entries[i].1 = value,
            Err(i) => self.entries.insert(i, (name.to_owned(), value)),
        }
    }

    /// Removes the value of that name.
    pub fn remove(&mut self, name: &str) -> Option<MetaValue> {
        let i = self.entries.binary_search_by(|(key, _)| key.as_str().cmp(name)).ok()?;
        Some(self.entries.remove(i).1)
    }

    /// The class of a grid with these metadata: `"fog volume"`, `"level set"`, `"staggered"` or `"unknown"`.
    pub fn grid_class(&self) -> &str {
        match self.string("class") {
            Some(class @ ("fog volume" | "level set" | "staggered")) => class,
            _ => "unknown",
        }
    }

    /// How the vectors of a grid with these metadata follow its transform: one of OpenVDB's five ways, by
    /// default `"invariant"`: not at all.
    pub fn vector_type(&self) -> &str {
        match self.string("vector_type") {
            Some(
                known @ ("covariant"
                | "covariant normalize"
                | "contravariant relative"
                | "contravariant absolute"),
            ) => known,
            _ => "invariant",
        }
    }

    /// The value of that name.
    pub fn get(&self, name: &str) -> Option<&MetaValue> {
        self.entries
            .binary_search_by(|(key, _)| key.as_str().cmp(name))
            .ok()
            .and_then(|i| self.entries.get(i))
            .map(|(_, value)| value)
    }

    /// All names and values, sorted by name.
    pub fn iter(&self) -> impl ExactSizeIterator<Item = (&str, &MetaValue)> {
        self.entries.iter().map(|(name, value)| (name.as_str(), value))
    }

    /// The text of a `string` value.
    pub fn string(&self, name: &str) -> Option<&str> {
        self.get(name).and_then(MetaValue::as_str)
    }

    /// The value of a `bool`.
    pub fn bool(&self, name: &str) -> Option<bool> {
        let value = self.get(name).filter(|value| value.type_name == "bool")?;
        value.bytes.first().map(|byte| *byte != 0)
    }

    /// The value of a `vec3i`.
    pub fn vec3i(&self, name: &str) -> Option<[i32; 3]> {
        let value = self.get(name).filter(|value| value.type_name == "vec3i")?;
        let mut numbers = value.numbers(4, |b| i32::from_le_bytes([b[0], b[1], b[2], b[3]]));
        Some([numbers.next()?, numbers.next()?, numbers.next()?])
    }

    /// Reads a count and that many entries. A later entry of the same name replaces an earlier one, as in
    /// OpenVDB.
    pub(crate) fn read(reader: &mut Reader<'_>, budget: &mut Budget) -> Result<Self> {
        let count = reader.u32("a metadata count")?;
        let mut entries: Vec<(String, MetaValue)> = Vec::new();
        for _ in 0..count {
            let name = reader.string("a metadata name")?;
            let type_name = reader.string("a metadata type name")?;
            let len = reader.u32("the size of a metadata value")?;
            // The entry itself counts twice for the growth of the vector and once more for the sorting, the value
            // once more for the window of the file in which it is read.
            let entry_bytes = 3 * size_of::<(String, MetaValue)>();
            let value_bytes = 2 * (len as usize);
            budget.take(1, entry_bytes + 2 * (name.len() + type_name.len()) + value_bytes, "metadata")?;
            let bytes = reader.take(len as usize, "a metadata value")?;
            // Where OpenVDB keeps positions for its own delayed loading; of no use to anyone else.
            if name != "file_delayed_load" {
                entries.push((name, MetaValue { type_name, bytes: bytes.to_vec() }));
            }
        }
        entries.reverse();
        entries.sort_by(|a, b| a.0.cmp(&b.0));
        entries.dedup_by(|a, b| a.0 == b.0);
        entries.shrink_to_fit();
        Ok(Metadata { entries })
    }
}

impl MetaValue {
    /// A `string`.
    pub fn from_text(text: &str) -> Self {
        MetaValue { type_name: "string".into(), bytes: text.as_bytes().to_vec() }
    }

    /// A `bool`.
    pub fn from_bool(value: bool) -> Self {
        MetaValue { type_name: "bool".into(), bytes: vec![value.into()] }
    }

    /// An `int64`.
    pub fn from_int64(value: i64) -> Self {
        MetaValue { type_name: "int64".into(), bytes: value.to_le_bytes().to_vec() }
    }

    /// A `float`.
    pub fn from_float(value: f32) -> Self {
        MetaValue { type_name: "float".into(), bytes: value.to_le_bytes().to_vec() }
    }

    /// A `vec3i`.
    pub fn from_vec3i(value: [i32; 3]) -> Self {
        MetaValue { type_name: "vec3i".into(), bytes: value.iter().flat_map(|c| c.to_le_bytes()).collect() }
    }

    /// The text of a `string` value that is valid UTF-8.
    pub fn as_str(&self) -> Option<&str> {
        (self.type_name == "string").then(|| std::str::from_utf8(&self.bytes).ok())?
    }

    fn numbers<T>(&self, width: usize, decode: impl Fn(&[u8]) -> T) -> impl Iterator<Item = T> {
        self.bytes.chunks_exact(width).map(decode)
    }

    /// The text form as bytes: what OpenVDB's `Metadata::str()` gives. Strings come out as the file holds
    /// them, whatever their encoding.
    pub fn text_bytes(&self) -> Vec<u8> {
        match self.type_name.as_str() {
            "string" => self.bytes.clone(),
            _ => self.number_text().into_bytes(),
        }
    }

    fn number_text(&self) -> String {
        fn f32_at(b: &[u8]) -> f64 {
            f32::from_le_bytes([b[0], b[1], b[2], b[3]]).into()
        }
        fn f64_at(b: &[u8]) -> f64 {
            f64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]])
        }
        fn i32_at(b: &[u8]) -> i64 {
            i32::from_le_bytes([b[0], b[1], b[2], b[3]]).into()
        }
        fn i64_at(b: &[u8]) -> i64 {
            i64::from_le_bytes([b[0], b[1], b[2], b[3], b[4], b[5], b[6], b[7]])
        }
        let ints = |numbers: Vec<i64>| numbers.iter().map(i64::to_string).collect();
        let floats = |numbers: Vec<f64>| numbers.iter().map(|x| format_g(*x, 6)).collect();
        let fixed = |numbers: Vec<f64>| numbers.iter().map(|x| format!("{x:.6}")).collect();
        let (count, texts): (usize, Vec<String>) = match self.type_name.as_str() {
            "bool" => {
                let text = if self.bytes.first().is_some_and(|b| *b != 0) { "true" } else { "false" };
                return text.to_owned();
            }
            "int32" => (1, ints(self.numbers(4, i32_at).collect())),
            "int64" => (1, ints(self.numbers(8, i64_at).collect())),
            "float" => (1, floats(self.numbers(4, f32_at).collect())),
            "double" => (1, floats(self.numbers(8, f64_at).collect())),
            "vec2i" => (2, ints(self.numbers(4, i32_at).collect())),
            "vec3i" => (3, ints(self.numbers(4, i32_at).collect())),
            "vec4i" => (4, ints(self.numbers(4, i32_at).collect())),
            "vec2s" => (2, floats(self.numbers(4, f32_at).collect())),
            "vec3s" => (3, floats(self.numbers(4, f32_at).collect())),
            "vec4s" => (4, floats(self.numbers(4, f32_at).collect())),
            "vec2d" => (2, floats(self.numbers(8, f64_at).collect())),
            "vec3d" => (3, floats(self.numbers(8, f64_at).collect())),
            "vec4d" => (4, floats(self.numbers(8, f64_at).collect())),
            "mat4s" => (16, fixed(self.numbers(4, f32_at).collect())),
            "mat4d" => (16, fixed(self.numbers(8, f64_at).collect())),
            _ => (0, Vec::new()),
        };
        match (count, texts.len()) {
            (1, 1) => texts.concat(),
            (16, 16) => {
                let rows: Vec<String> =
                    texts.chunks_exact(4).map(|row| format!("[{}]", row.join(", "))).collect();
                format!("[{}]", rows.join(",\n "))
            }
            (n, m) if n == m && n > 0 => format!("[{}]", texts.join(", ")),
            _ if self.bytes.is_empty() => String::new(),
            _ => "<binary data>".to_owned(),
        }
    }
}

impl fmt::Display for MetaValue {
    /// The text form; bytes of a string that are not UTF-8 are replaced.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&String::from_utf8_lossy(&self.text_bytes()))
    }
}

/// A number with `digits` significant digits and no trailing zeros, as C's `%g` and a C++ stream print it.
pub fn format_g(x: f64, digits: usize) -> String {
    if x.is_nan() {
        return "nan".into();
    }
    if x.is_infinite() {
        return if x > 0.0 { "inf" } else { "-inf" }.into();
    }
    let digits = digits.max(1);
    let scientific = format!("{x:.*e}", digits - 1);
    let (mantissa, exponent) = scientific.split_once('e').unwrap_or((&scientific, "0"));
    let exponent: i32 = exponent.parse().unwrap_or(0);
    let trim = |text: &str| match text.contains('.') {
        true => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
        false => text.to_owned(),
    };
    if exponent < -4 || exponent >= digits as i32 {
        let sign = if exponent < 0 { '-' } else { '+' };
        format!("{}e{sign}{:02}", trim(mantissa), exponent.abs())
    } else {
        let decimals = (digits as i32 - 1 - exponent).max(0) as usize;
        trim(&format!("{x:.decimals$}"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_print_as_c_prints_them() {
        for (x, text) in [
            (0.0, "0"),
            (2.25, "2.25"),
            (1e-5, "1e-05"),
            (0.0001, "0.0001"),
            (123456.0, "123456"),
            (1234567.0, "1.23457e+06"),
            (-0.5, "-0.5"),
            (999999.5, "1e+06"),
            (f64::INFINITY, "inf"),
        ] {
            assert_eq!(format_g(x, 6), text);
        }
    }

    #[test]
    fn a_value_shorter_than_its_type_is_shown_as_bytes() {
        let value = MetaValue { type_name: "vec3d".into(), bytes: vec![0; 9] };
        assert_eq!(value.to_string(), "<binary data>");
    }
}
