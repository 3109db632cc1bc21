//! A file on disk as a source of bytes for the VDB reader.
//!
//! Every read names its position and length, so that one grid of a large file is read without touching the
//! rest. No memory map: a file that shrinks while it is read is an error here, not a crash.

use std::borrow::Cow;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use nuage_vdb::{AnyFile, Limits, Source};
use nuage_volume::format::ReadAt;

use crate::error::Failure;
use crate::frames;

/// How much memory a file may ask for: shared by the subcommands that look into files.
#[derive(Debug, Clone, Copy, clap::Args)]
pub(crate) struct Memory {
    /// The most memory that reading the headers of a file, or one grid, may take, in GiB
    #[arg(long = "max-memory", value_name = "GIB", value_parser = limits, default_value = "16")]
    pub(crate) limits: Limits,
}

/// A number of GiB as limits.
fn limits(text: &str) -> Result<Limits, String> {
    let gib: f64 = text.parse().map_err(|_| "this is no number".to_owned())?;
    match gib > 0.0 && gib < f64::from(1 << 30) {
        true => Ok(Limits { max_memory_bytes: (gib * f64::from(1 << 30)) as u64 }),
        false => Err("give a number of GiB above 0, as in 2 or 0.5".into()),
    }
}

/// An open file on disk, or a frame of a packed one.
pub(crate) struct DiskFile {
    path: PathBuf,
    file: fs::File,
    size_bytes: u64,
    /// The frame as a .vdb file, which is then what is read.
    frame: Option<Vec<u8>>,
}

impl DiskFile {
    /// Opens a file. A packed one is read as a .vdb file of the frame that the path names, or of its first.
    ///
    /// # Errors
    /// If there is no such file, it may not be read, or it is a folder or a pipe.
    pub(crate) fn open(path: &Path) -> Result<Self, Failure> {
        match frames::packed(path) {
            Some((file, number)) => {
                let mut disk = Self::open_plain(&file)?;
                disk.frame = Some(frames::as_vdb(&file, number)?);
                Ok(disk)
            }
            None => Self::open_plain(path),
        }
    }

    /// Opens a file as it is.
    ///
    /// # Errors
    /// As [`DiskFile::open`].
    pub(crate) fn open_plain(path: &Path) -> Result<Self, Failure> {
        let cannot_open = |error| Failure::file(path, format!("cannot open the file: {error}"));
        // Asked before opening: opening a named pipe would wait for its writer.
        let kind = fs::metadata(path).map_err(cannot_open)?;
        if kind.is_dir() {
            return Err(Failure::file(path, "this is a folder: name the files in it, as in FOLDER/*.vdb"));
        }
        if !kind.is_file() {
            return Err(Failure::file(path, "this is no regular file: copy it to disk first"));
        }
        Self::of(path, fs::File::open(path).map_err(cannot_open)?)
    }

    /// A file that is open already, as it is. `path` is what messages call it.
    ///
    /// # Errors
    /// If the system does not say how large it is.
    pub(crate) fn of(path: &Path, file: fs::File) -> Result<Self, Failure> {
        let data =
            file.metadata().map_err(|error| Failure::file(path, format!("cannot read it: {error}")))?;
        Ok(DiskFile { path: path.to_owned(), file, size_bytes: data.len(), frame: None })
    }

    /// Reads the header of the file as a VDB file.
    ///
    /// # Errors
    /// If it is not a VDB file that we read.
    pub(crate) fn vdb(&self) -> Result<nuage_vdb::File<&Self>, Failure> {
        nuage_vdb::File::open(self).map_err(|error| Failure::vdb(&self.path, &error))
    }

    /// Reads the headers of the file as whatever it is, a VDB or a NanoVDB file.
    ///
    /// # Errors
    /// If it is neither.
    pub(crate) fn any(&self, memory: Memory) -> Result<AnyFile<&Self>, Failure> {
        AnyFile::open_with(self, memory.limits).map_err(|error| Failure::vdb(&self.path, &error))
    }

    /// The path as it was given.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// The size when the file was opened, in bytes.
    pub(crate) fn size(&self) -> u64 {
        self.size_bytes
    }
}

impl Source for DiskFile {
    fn size_bytes(&self) -> io::Result<u64> {
        Ok(self.frame.as_ref().map_or(self.size_bytes, |frame| frame.len() as u64))
    }

    fn range(&self, offset: u64, len: usize) -> io::Result<Cow<'_, [u8]>> {
        match &self.frame {
            Some(frame) => Source::range(frame, offset, len),
            None => ReadAt::range(self, offset, len),
        }
    }
}

impl ReadAt for DiskFile {
    fn size_bytes(&self) -> io::Result<u64> {
        Ok(self.size_bytes)
    }

    fn range(&self, offset: u64, len: usize) -> io::Result<Cow<'_, [u8]>> {
        let mut bytes = vec![0; len];
        read_exact_at(&self.file, &mut bytes, offset)?;
        Ok(Cow::Owned(bytes))
    }
}

#[cfg(unix)]
fn read_exact_at(file: &fs::File, bytes: &mut [u8], offset: u64) -> io::Result<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, bytes, offset)
}

#[cfg(windows)]
fn read_exact_at(file: &fs::File, mut bytes: &mut [u8], mut offset: u64) -> io::Result<()> {
    use std::os::windows::fs::FileExt;
    while !bytes.is_empty() {
        match file.seek_read(bytes, offset) {
            Ok(0) => return Err(io::ErrorKind::UnexpectedEof.into()),
            Ok(count) => {
                bytes = &mut bytes[count..];
                offset += count as u64;
            }
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    #[test]
    fn a_range_is_what_stands_there_and_the_end_of_the_file_is_an_error() {
        let mut file = tempfile::NamedTempFile::new().unwrap();
        let bytes: Vec<u8> = (0..=255).collect();
        file.write_all(&bytes).unwrap();
        let disk = DiskFile::open(file.path()).unwrap();
        assert_eq!(Source::size_bytes(&disk).unwrap(), 256);
        for (offset, len) in [(0, 256), (17, 100), (255, 1), (256, 0)] {
            assert_eq!(*Source::range(&disk, offset as u64, len).unwrap(), bytes[offset..offset + len]);
        }
        // The file is shorter than it was said to be, as when it is cut off while being read.
        file.as_file().set_len(100).unwrap();
        assert_eq!(Source::range(&disk, 50, 51).unwrap_err().kind(), io::ErrorKind::UnexpectedEof);
    }

    #[test]
    fn a_folder_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        assert!(matches!(DiskFile::open(folder.path()), Err(Failure::File { .. })));
    }
}
