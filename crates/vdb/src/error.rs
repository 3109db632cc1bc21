//! The crate's one error type, its variants ordered by whose fault they are.

use std::io;

/// Why a file could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The source or the sink of the bytes failed: the disk, the network, a permission.
    #[error("input or output failed: {0}")]
    Io(#[from] io::Error),
    /// The bytes are not a valid VDB file: truncated, damaged or not a VDB file at all.
    #[error("malformed file at byte {offset}: {what}")]
    Malformed {
        /// What is wrong, in words.
        what: String,
        /// Where it is wrong, in bytes from the start of the file.
        offset: u64,
    },
    /// The file is valid as far as we can tell, but uses something this crate does not read.
    #[error("unsupported: {feature}")]
    Unsupported {
        /// What is used.
        feature: String,
    },
    /// Reading on would take more memory than [`crate::Limits`] allows.
    #[error("{what} would take {needed_bytes} bytes of memory, over the limit of {limit_bytes}")]
    Limit {
        /// What asked for the memory.
        what: String,
        /// How much memory would be in use.
        needed_bytes: u64,
        /// The limit that was set.
        limit_bytes: u64,
    },
    /// The caller asked for something that does not exist.
    #[error("{0}")]
    Misuse(String),
}

/// Results of this crate.
pub type Result<T> = std::result::Result<T, Error>;

impl Error {
    pub(crate) fn malformed(offset: u64, what: impl Into<String>) -> Self {
        Error::Malformed { what: what.into(), offset }
    }

    pub(crate) fn unsupported(feature: impl Into<String>) -> Self {
        Error::Unsupported { feature: feature.into() }
    }
}
