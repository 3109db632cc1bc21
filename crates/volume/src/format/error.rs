//! The one error of reading and writing packed files, its variants ordered by whose fault they are, and limits.

use std::io;

/// Why a packed file could not be read or written.
#[derive(Debug, thiserror::Error)]
pub enum FormatError {
    /// The source or the sink of the bytes failed.
    #[error("input or output failed: {0}")]
    Io(#[from] io::Error),
    /// The bytes are no valid file: cut off, damaged, or not one of nuage at all.
    #[error("malformed file at byte {offset}: {what}")]
    Malformed {
        /// What is wrong, in words.
        what: String,
        /// Where it is wrong, in bytes from the start of the file.
        offset: u64,
    },
    /// The file is of a later version of the format.
    #[error("unsupported: {feature}")]
    Unsupported {
        /// What is used.
        feature: String,
    },
    /// Reading on would take more memory than [`Limits`] allows.
    #[error("{what} would take {needed_bytes} bytes of memory, over the limit of {limit_bytes}")]
    Limit {
        /// What asked for the memory.
        what: String,
        /// How much memory would be in use.
        needed_bytes: u64,
        /// The limit that was set.
        limit_bytes: u64,
    },
    /// The caller asked for what does not exist, or gave what cannot be written.
    #[error("{0}")]
    Misuse(String),
}

impl FormatError {
    pub(super) fn malformed(offset: u64, what: impl Into<String>) -> Self {
        FormatError::Malformed { what: what.into(), offset }
    }
}

/// Limits on what a file may ask for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Limits {
    /// The most memory, in bytes, that an asset may take for what its file says, and what is being decoded with it. A
    /// window of at most 8 MiB for each decoder comes on top.
    pub max_memory_bytes: u64,
}

impl Default for Limits {
    /// 16 GiB, as for the reader of source files.
    fn default() -> Self {
        Limits { max_memory_bytes: 16 << 30 }
    }
}

impl Limits {
    /// Makes sure that so many bytes are allowed. The terms are added up without overflow.
    pub(super) fn check(&self, terms: &[u64], what: &str) -> Result<(), FormatError> {
        let needed_bytes = terms.iter().fold(0_u64, |sum, term| sum.saturating_add(*term));
        let limit_bytes = self.max_memory_bytes;
        match needed_bytes <= limit_bytes {
            true => Ok(()),
            false => Err(FormatError::Limit { what: what.to_owned(), needed_bytes, limit_bytes }),
        }
    }
}
