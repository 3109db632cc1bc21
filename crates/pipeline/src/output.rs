//! Output files that appear whole or not at all.
//!
//! What is in the files, and what they are called, is decided elsewhere ([`crate::sequence::output_path`]).

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use tempfile::NamedTempFile;
use thiserror::Error;

/// Why a file was not written. In every case what was at its path before is still there, untouched.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum OutputError {
    /// The file exists and the caller did not ask to replace it.
    #[error("`{}` exists already; ask to overwrite it, or choose another name", path.display())]
    Exists {
        /// The file.
        path: PathBuf,
    },
    /// The caller named a file in a folder that does not exist.
    #[error("can't write `{}`: there is no folder `{}`; make it first", path.display(), folder.display())]
    NoFolder {
        /// The file.
        path: PathBuf,
        /// The folder.
        folder: PathBuf,
    },
    /// The caller named something that is no file and can't be replaced by one: a folder, a device, a pipe.
    #[error("can't write `{}`: it is not the name of a file", path.display())]
    NotAFile {
        /// What was named.
        path: PathBuf,
    },
    /// The system refused: the disk is full, the folder not ours, ...
    #[error("can't write `{}`: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
}

/// Writes `bytes` to the file `path`, which another process sees either whole or not at all.
///
/// The bytes go to a temporary file in the same folder, reach the disk, and are then renamed. Without `overwrite` a
/// file at `path` is never replaced, even if it appears while this one is written. With it, a link is replaced, not
/// what it points to. The file gets the permissions of any newly created file.
///
/// # Errors
/// [`OutputError`], with no partial file left behind.
pub fn write_whole(path: &Path, bytes: &[u8], overwrite: bool) -> Result<(), OutputError> {
    write_whole_with(path, overwrite, |file| {
        file.write_all(bytes).map_err(|source| OutputError::Io { path: path.to_owned(), source })
    })
}

/// The same with bytes that `write` puts into the file. If it fails, nothing appears.
///
/// # Errors
/// That of `write`, or an [`OutputError`], with no partial file left behind.
pub fn write_whole_with<T, E: From<OutputError>>(
    path: &Path,
    overwrite: bool,
    write: impl FnOnce(&mut fs::File) -> Result<T, E>,
) -> Result<T, E> {
    let error = |source| OutputError::Io { path: path.to_owned(), source };
    let exists = || OutputError::Exists { path: path.to_owned() };
    // Replacing a device such as /dev/null by a file would harm the whole system.
    if path.file_name().is_none() || fs::metadata(path).is_ok_and(|data| !data.is_file()) {
        return Err(OutputError::NotAFile { path: path.to_owned() }.into());
    }
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    if !folder.is_dir() {
        return Err(OutputError::NoFolder { path: path.to_owned(), folder: folder.to_owned() }.into());
    }
    // Only saves the work: the rename below is what holds against a race.
    if !overwrite && path.symlink_metadata().is_ok() {
        return Err(exists().into());
    }
    let mut file = temporary_in(folder).map_err(error)?;
    let written = write(file.as_file_mut())?;
    file.as_file().sync_all().map_err(error)?;
    let renamed = if overwrite { file.persist(path) } else { file.persist_noclobber(path) };
    match renamed {
        Ok(_) => Ok(written),
        Err(failed) if !overwrite && failed.error.kind() == io::ErrorKind::AlreadyExists => {
            Err(exists().into())
        }
        Err(failed) => Err(error(failed.error).into()),
    }
}

/// Writes two files that belong together: both appear, or none does. Only with `overwrite`, and only if the system fails
/// between two renames, may the first be left without the second.
///
/// # Errors
/// [`OutputError`], as for [`write_whole`].
pub fn write_both(files: [(&Path, &[u8]); 2], overwrite: bool) -> Result<(), OutputError> {
    let [(first, first_bytes), (second, second_bytes)] = files;
    let mut has_first = false;
    // The first appears while the second lies complete under a temporary name.
    let written = write_whole_with(second, overwrite, |file| {
        let error = |source| OutputError::Io { path: second.to_owned(), source };
        file.write_all(second_bytes).and_then(|()| file.sync_all()).map_err(error)?;
        write_whole(first, first_bytes, overwrite)?;
        has_first = true;
        Ok(())
    });
    if written.is_err() && has_first && !overwrite {
        // It was not there before, so it is ours. That it stays behind is all that can go wrong.
        let _ = fs::remove_file(first);
    }
    written
}

/// A temporary file that is removed when dropped.
fn temporary_in(folder: &Path) -> io::Result<NamedTempFile> {
    let mut builder = tempfile::Builder::new();
    builder.prefix(".nuage-").suffix(".part");
    // Temporary files are private to their owner by default. This mode is given to the call that creates the file,
    // so that the system takes the umask off, as it does for any other file.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    builder.tempfile_in(folder)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names_in(folder: &Path) -> Vec<String> {
        let mut names: Vec<String> = fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    #[test]
    fn a_file_is_written_whole_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        for bytes in [&b""[..], b"abc", &[7; 100_000]] {
            let path = folder.path().join("a.bin");
            write_whole(&path, bytes, true).unwrap();
            assert_eq!(fs::read(&path).unwrap(), bytes);
            assert_eq!(names_in(folder.path()), ["a.bin"]);
        }
    }

    #[test]
    fn a_file_is_replaced_only_when_asked() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        write_whole(&path, b"first", false).unwrap();
        let error = write_whole(&path, b"second", false).unwrap_err();
        assert!(
            matches!(error, OutputError::Exists { .. }) && error.to_string().contains("a.bin"),
            "{error}"
        );
        assert_eq!(fs::read(&path).unwrap(), b"first");
        write_whole(&path, b"second", true).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"second");
        assert_eq!(names_in(folder.path()), ["a.bin"]);
    }

    #[test]
    fn of_two_files_none_appears_without_the_other() {
        let folder = tempfile::tempdir().unwrap();
        let [a, b] = ["a.bin", "b.bin"].map(|name| folder.path().join(name));
        for taken in [&a, &b] {
            fs::write(taken, b"before").unwrap();
            let error = write_both([(&a, b"a"), (&b, b"b")], false).unwrap_err();
            assert!(matches!(error, OutputError::Exists { path } if path == *taken));
            assert_eq!(names_in(folder.path()).len(), 1);
            assert_eq!(fs::read(taken).unwrap(), b"before");
            fs::remove_file(taken).unwrap();
        }
        write_both([(&a, b"a"), (&b, b"b")], false).unwrap();
        write_both([(&a, b"aa"), (&b, b"bb")], true).unwrap();
        assert_eq!([fs::read(&a).unwrap(), fs::read(&b).unwrap()], [b"aa", b"bb"]);
        assert_eq!(names_in(folder.path()), ["a.bin", "b.bin"]);
    }

    #[test]
    fn of_many_writers_exactly_one_wins() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.bin");
        let write = |n: u8| write_whole(&path, &[n; 5000], false).is_ok();
        let winners: Vec<u8> = std::thread::scope(|scope| {
            let threads: Vec<_> = (0..8).map(|n| (n, scope.spawn(move || write(n)))).collect();
            threads.into_iter().filter_map(|(n, thread)| thread.join().unwrap().then_some(n)).collect()
        });
        assert_eq!(winners.len(), 1);
        assert_eq!(fs::read(&path).unwrap(), [winners[0]; 5000]);
        assert_eq!(names_in(folder.path()), ["a.bin"]);
    }

    #[test]
    fn what_is_no_place_for_a_file_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let error = write_whole(&folder.path().join("no/such/a.bin"), b"", true).unwrap_err();
        assert!(matches!(error, OutputError::NoFolder { .. }), "{error}");
        assert!(matches!(write_whole(folder.path(), b"", true), Err(OutputError::NotAFile { .. })));
        assert!(matches!(write_whole(Path::new(""), b"", true), Err(OutputError::NotAFile { .. })));
        assert!(matches!(write_whole(Path::new("/"), b"", true), Err(OutputError::NotAFile { .. })));
        assert_eq!(names_in(folder.path()), [""; 0]);
    }

    #[cfg(unix)]
    #[test]
    fn permissions_are_those_of_any_new_file() {
        use std::os::unix::fs::PermissionsExt;
        let folder = tempfile::tempdir().unwrap();
        let mode = |name: &str| fs::metadata(folder.path().join(name)).unwrap().permissions().mode();
        fs::write(folder.path().join("usual"), b"").unwrap();
        write_whole(&folder.path().join("ours"), b"", false).unwrap();
        assert_eq!(mode("ours"), mode("usual"));
    }

    #[cfg(unix)]
    #[test]
    fn a_dangling_link_counts_as_existing() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("link");
        std::os::unix::fs::symlink("nowhere", &path).unwrap();
        assert!(matches!(write_whole(&path, b"", false), Err(OutputError::Exists { .. })));
        write_whole(&path, b"x", true).unwrap();
        assert_eq!(fs::read(&path).unwrap(), b"x");
    }
}
