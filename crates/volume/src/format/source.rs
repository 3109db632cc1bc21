//! Where the bytes of a packed file come from. The crate opens no files itself.

use std::borrow::Cow;
use std::io;

/// Random access to the bytes of a file.
pub trait ReadAt: Send + Sync {
    /// The size of the whole file in bytes.
    ///
    /// # Errors
    /// Whatever the system says.
    fn size_bytes(&self) -> io::Result<u64>;

    /// `len` bytes from `offset`. Never asked for bytes past the end of the file.
    ///
    /// # Errors
    /// Whatever the system says; `UnexpectedEof` if the file has become shorter.
    fn range(&self, offset: u64, len: usize) -> io::Result<Cow<'_, [u8]>>;
}

impl ReadAt for [u8] {
    fn size_bytes(&self) -> io::Result<u64> {
        Ok(self.len() as u64)
    }

    fn range(&self, offset: u64, len: usize) -> io::Result<Cow<'_, [u8]>> {
        let begin = usize::try_from(offset).ok();
        let bytes = begin.and_then(|begin| self.get(begin..begin.checked_add(len)?));
        bytes.map(Cow::Borrowed).ok_or_else(|| io::ErrorKind::UnexpectedEof.into())
    }
}

impl ReadAt for Vec<u8> {
    fn size_bytes(&self) -> io::Result<u64> {
        self.as_slice().size_bytes()
    }

    fn range(&self, offset: u64, len: usize) -> io::Result<Cow<'_, [u8]>> {
        self.as_slice().range(offset, len)
    }
}

impl<S: ReadAt + ?Sized> ReadAt for &S {
    fn size_bytes(&self) -> io::Result<u64> {
        (**self).size_bytes()
    }

    fn range(&self, offset: u64, len: usize) -> io::Result<Cow<'_, [u8]>> {
        (**self).range(offset, len)
    }
}

impl<S: ReadAt + ?Sized> ReadAt for std::sync::Arc<S> {
    fn size_bytes(&self) -> io::Result<u64> {
        (**self).size_bytes()
    }

    fn range(&self, offset: u64, len: usize) -> io::Result<Cow<'_, [u8]>> {
        (**self).range(offset, len)
    }
}
