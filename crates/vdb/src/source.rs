//! Where the bytes of a file come from, and a reader that goes through them.
//!
//! The crate opens no files itself: a caller hands it a byte slice, or anything that can read a range of
//! bytes. Parsers go through a [`Reader`], whose every read is checked and whose errors carry the offset in the
//! file. It holds a window of the file and never more, so that a part can be read without the rest.

use std::borrow::Cow;
use std::io;

use crate::error::{Error, Result};

/// Random access to the bytes of a file.
pub trait Source: Sync {
    /// The size of the whole file in bytes.
    ///
    /// # Errors
    /// Whatever the operating system says.
    fn size_bytes(&self) -> io::Result<u64>;

    /// `len` bytes from `offset`. Never asked for bytes past the end of the file.
    ///
    /// # Errors
    /// Whatever the operating system says; `UnexpectedEof` if the file has become shorter.
    fn range(&self, offset: u64, len: usize) -> io::Result<Cow<'_, [u8]>>;
}

impl Source for [u8] {
    fn size_bytes(&self) -> io::Result<u64> {
        Ok(self.len() as u64)
    }

    fn range(&self, offset: u64, len: usize) -> io::Result<Cow<'_, [u8]>> {
        usize::try_from(offset)
            .ok()
            .and_then(|start| self.get(start..start.checked_add(len)?))
            .map(Cow::Borrowed)
            .ok_or_else(|| io::ErrorKind::UnexpectedEof.into())
    }
}

impl Source for Vec<u8> {
    fn size_bytes(&self) -> io::Result<u64> {
        self.as_slice().size_bytes()
    }

    fn range(&self, offset: u64, len: usize) -> io::Result<Cow<'_, [u8]>> {
        self.as_slice().range(offset, len)
    }
}

impl<S: Source + ?Sized> Source for &S {
    fn size_bytes(&self) -> io::Result<u64> {
        (**self).size_bytes()
    }

    fn range(&self, offset: u64, len: usize) -> io::Result<Cow<'_, [u8]>> {
        (**self).range(offset, len)
    }
}

/// Longer than any name or type that makes sense, and short enough to be decoded before it is counted.
const MAX_NAME_BYTES: usize = 1 << 20;

/// How much is read at once where more is likely to be wanted.
const WINDOW_BYTES: usize = 64 << 10;

/// A checked reader of little-endian values from some part of a source.
pub(crate) struct Reader<'a> {
    source: Option<&'a dyn Source>,
    /// The part of the source that is at hand.
    window: Cow<'a, [u8]>,
    /// Offset in the file of the first byte of the window.
    window_at: u64,
    /// Offset in the file of the next byte.
    at: u64,
    /// Offset in the file past the last byte that may be read.
    end: u64,
}

impl<'a> Reader<'a> {
    /// A reader of the bytes from `begin` to `end`, which is cut to the source's own end.
    pub(crate) fn new(source: &'a dyn Source, begin: u64, end: u64) -> Result<Self> {
        let end = end.min(source.size_bytes()?);
        Ok(Reader { source: Some(source), window: Cow::Borrowed(&[]), window_at: begin, at: begin, end })
    }

    /// A reader of bytes that are at hand and begin at offset `at` of a file.
    pub(crate) fn over(bytes: &'a [u8], at: u64) -> Self {
        let end = at.saturating_add(bytes.len() as u64);
        Reader { source: None, window: Cow::Borrowed(bytes), window_at: at, at, end }
    }

    /// Offset in the file of the next byte.
    pub(crate) fn offset(&self) -> u64 {
        self.at
    }

    /// The bytes that are left to read.
    pub(crate) fn left(&self) -> u64 {
        self.end.saturating_sub(self.at)
    }

    /// Goes on at an offset of the file.
    pub(crate) fn seek(&mut self, offset: u64) {
        self.at = offset;
    }

    pub(crate) fn malformed(&self, what: impl Into<String>) -> Error {
        Error::malformed(self.at, what)
    }

    /// Moves past bytes without looking at them.
    pub(crate) fn skip(&mut self, len: u64, what: &str) -> Result<()> {
        if len > self.left() {
            return Err(self.ended(what));
        }
        self.at += len;
        Ok(())
    }

    /// The next bytes.
    pub(crate) fn take(&mut self, len: usize, what: &str) -> Result<&[u8]> {
        let at = self.at;
        self.skip(len as u64, what)?;
        self.load(at, len)?;
        Ok(self.loaded(at, len))
    }

    /// Makes sure that the bytes from an offset are in the window, and as many more as are likely to be wanted.
    ///
    /// The caller has checked that they lie before the end.
    pub(crate) fn load(&mut self, at: u64, len: usize) -> Result<()> {
        let is_loaded = at >= self.window_at && at - self.window_at + len as u64 <= self.window.len() as u64;
        if let (false, Some(source)) = (is_loaded, self.source) {
            let window = (len.max(WINDOW_BYTES) as u64).min(self.end.saturating_sub(at)).max(len as u64);
            self.window = source.range(at, window as usize)?;
            self.window_at = at;
        }
        Ok(())
    }

    /// Bytes that are in the window: those that were just loaded or taken.
    ///
    /// Empty if they are not, which would be a mistake of this crate.
    pub(crate) fn loaded(&self, at: u64, len: usize) -> &[u8] {
        let begin = at.checked_sub(self.window_at).map_or(usize::MAX, |begin| begin as usize);
        let bytes = begin.checked_add(len).and_then(|end| self.window.get(begin..end));
        debug_assert!(bytes.is_some(), "bytes that were not loaded");
        bytes.unwrap_or_default()
    }

    fn ended(&self, what: &str) -> Error {
        Error::malformed(self.at.min(self.end), format!("the file ends inside {what}"))
    }

    pub(crate) fn array<const N: usize>(&mut self, what: &str) -> Result<[u8; N]> {
        let mut out = [0; N];
        out.copy_from_slice(self.take(N, what)?);
        Ok(out)
    }

    pub(crate) fn u8(&mut self, what: &str) -> Result<u8> {
        Ok(self.array::<1>(what)?[0])
    }

    pub(crate) fn u16(&mut self, what: &str) -> Result<u16> {
        self.array(what).map(u16::from_le_bytes)
    }

    pub(crate) fn u32(&mut self, what: &str) -> Result<u32> {
        self.array(what).map(u32::from_le_bytes)
    }

    pub(crate) fn u64(&mut self, what: &str) -> Result<u64> {
        self.array(what).map(u64::from_le_bytes)
    }

    pub(crate) fn i32(&mut self, what: &str) -> Result<i32> {
        self.array(what).map(i32::from_le_bytes)
    }

    pub(crate) fn i64(&mut self, what: &str) -> Result<i64> {
        self.array(what).map(i64::from_le_bytes)
    }

    pub(crate) fn f64(&mut self, what: &str) -> Result<f64> {
        self.array(what).map(f64::from_le_bytes)
    }

    pub(crate) fn vec3d(&mut self, what: &str) -> Result<[f64; 3]> {
        Ok([self.f64(what)?, self.f64(what)?, self.f64(what)?])
    }

    pub(crate) fn coord(&mut self, what: &str) -> Result<[i32; 3]> {
        Ok([self.i32(what)?, self.i32(what)?, self.i32(what)?])
    }

    /// A string: its length as u32, then its bytes. Bytes that are not UTF-8 are replaced.
    pub(crate) fn string(&mut self, what: &str) -> Result<String> {
        let len = self.u32(what)? as usize;
        if len > MAX_NAME_BYTES {
            return Err(self.malformed(format!("{what} of {len} bytes")));
        }
        Ok(String::from_utf8_lossy(self.take(len, what)?).into_owned())
    }

    /// A bit mask of `bits` bits, appended in words of 64. A file holds whole bytes of it.
    pub(crate) fn mask_words(&mut self, bits: usize, words: &mut Vec<u64>, what: &str) -> Result<()> {
        for chunk in self.take(bits / 8, what)?.chunks(8) {
            let mut bytes = [0; 8];
            bytes[..chunk.len()].copy_from_slice(chunk);
            words.push(u64::from_le_bytes(bytes));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reader_gives_what_stands_in_the_source_whatever_the_order() {
        let bytes: Vec<u8> =
            (0..3 * WINDOW_BYTES as u32).map(|i| (i.wrapping_mul(2_654_435_761) >> 24) as u8).collect();
        let mut reader = Reader::new(&bytes, 5, bytes.len() as u64 - 7).unwrap();
        let mut at = 5;
        for len in [1, 1000, WINDOW_BYTES, 3, WINDOW_BYTES - 10, 0, 17] {
            assert_eq!(reader.take(len, "bytes").unwrap(), &bytes[at..at + len]);
            at += len;
        }
        reader.skip(100, "bytes").unwrap();
        assert_eq!(reader.u8("a byte").unwrap(), bytes[at + 100]);
        reader.seek(9);
        assert_eq!(reader.take(4, "bytes").unwrap(), &bytes[9..13]);
        reader.seek(bytes.len() as u64 - 10);
        assert_eq!(reader.take(3, "bytes").unwrap().len(), 3);
        assert!(matches!(reader.u8("a byte"), Err(Error::Malformed { .. })));
        assert!(reader.skip(1, "a byte").is_err());
    }
}
