//! Where the bytes of a file come from, and a cursor over them.
//!
//! The crate opens no files itself: a caller hands it a byte slice, or anything that can read a range of
//! bytes. Parsers see slices only, through [`Cursor`], whose every read is checked and whose errors carry the
//! offset in the file.

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

/// Parses a part of a file whose length is not known beforehand: reads a window of `first_window_bytes` at
/// `offset` and, as long as `parse` runs out of bytes, tries again with a larger one.
pub(crate) fn parse_window<T>(
    source: &(impl Source + ?Sized),
    offset: u64,
    first_window_bytes: usize,
    max_window_bytes: u64,
    parse: impl Fn(&mut Cursor<'_>) -> Result<T>,
) -> Result<T> {
    let left = source.size_bytes()?.saturating_sub(offset);
    let mut len = left.min(first_window_bytes as u64);
    loop {
        if len > max_window_bytes {
            return Err(Error::Limit {
                what: "a header".into(),
                needed_bytes: len,
                limit_bytes: max_window_bytes,
            });
        }
        let window = source.range(offset, len as usize)?;
        let mut cursor = Cursor::new(&window, offset);
        match parse(&mut cursor) {
            Err(_) if cursor.ran_out && len < left => {
                let larger = left.min(len.saturating_mul(8).max(4096));
                // The last window that the limit allows is tried before it is refused.
                len = if len < max_window_bytes { larger.min(max_window_bytes) } else { larger };
            }
            result => return result,
        }
    }
}

/// Longer than any name or type that makes sense, and short enough to be decoded before it is counted.
const MAX_NAME_BYTES: usize = 1 << 20;

/// A checked reader of little-endian values over a slice that starts at a known offset of the file.
#[derive(Debug, Clone)]
pub(crate) struct Cursor<'a> {
    bytes: &'a [u8],
    /// Offset in the file of the next byte.
    offset: u64,
    /// Whether a read failed for want of bytes.
    ran_out: bool,
}

impl<'a> Cursor<'a> {
    pub(crate) fn new(bytes: &'a [u8], offset: u64) -> Self {
        Cursor { bytes, offset, ran_out: false }
    }

    pub(crate) fn offset(&self) -> u64 {
        self.offset
    }

    pub(crate) fn malformed(&self, what: impl Into<String>) -> Error {
        Error::malformed(self.offset, what)
    }

    pub(crate) fn take(&mut self, len: usize, what: &str) -> Result<&'a [u8]> {
        match self.bytes.split_at_checked(len) {
            Some((taken, rest)) => {
                self.bytes = rest;
                self.offset += len as u64;
                Ok(taken)
            }
            None => {
                self.ran_out = true;
                Err(self.malformed(format!("the file ends inside {what}")))
            }
        }
    }

    pub(crate) fn array<const N: usize>(&mut self, what: &str) -> Result<[u8; N]> {
        let mut out = [0; N];
        out.copy_from_slice(self.take(N, what)?);
        Ok(out)
    }

    pub(crate) fn u8(&mut self, what: &str) -> Result<u8> {
        Ok(self.array::<1>(what)?[0])
    }

    pub(crate) fn u32(&mut self, what: &str) -> Result<u32> {
        self.array(what).map(u32::from_le_bytes)
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

    /// A bit mask of `words.len() * 64` bits.
    pub(crate) fn mask_words(&mut self, words: &mut [u64], what: &str) -> Result<()> {
        let bytes = self.take(words.len() * 8, what)?;
        for (word, chunk) in words.iter_mut().zip(bytes.chunks_exact(8)) {
            *word = u64::from_le_bytes(chunk.try_into().expect("chunks of eight bytes"));
        }
        Ok(())
    }
}
