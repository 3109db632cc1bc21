//! Why a subcommand failed, and how that reads on standard error.
//!
//! Every message names the file, says what is wrong and, where we know it, how to mend it.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use crate::text;

/// Why a subcommand stopped.
#[derive(Debug, thiserror::Error)]
pub(crate) enum Failure {
    /// Something is wrong with a file, or with what was asked of it.
    #[error("{}: {what}", path.display())]
    File {
        /// The file as the user named it.
        path: PathBuf,
        /// What is wrong and how to mend it.
        what: String,
    },
    /// A line of standard input is not what it should be.
    #[error("standard input, line {line}: {what}")]
    Input {
        /// The number of the line, from 1.
        line: u64,
        /// What is wrong and how to mend it.
        what: String,
    },
    /// The result could not be written.
    #[error("cannot write to standard output: {0}")]
    Output(#[from] io::Error),
    /// The command line parses but makes no sense.
    #[error("{0}")]
    Usage(String),
    /// Part of the work failed and all of that has been reported.
    #[error("reported before")]
    Reported,
}

impl Failure {
    /// Something is wrong with a file.
    pub(crate) fn file(path: &Path, what: impl Into<String>) -> Self {
        Failure::File { path: path.to_owned(), what: what.into() }
    }

    /// The file could not be read as a VDB file.
    pub(crate) fn vdb(path: &Path, error: &nuage_vdb::Error) -> Self {
        Failure::file(path, explain(error))
    }

    /// Writes `nuage: FILE: what is wrong` to standard error.
    pub(crate) fn report(&self) {
        if !matches!(self, Failure::Reported) {
            // With standard error gone there is nowhere left to complain.
            let _ = writeln!(io::stderr(), "nuage: {}", text::one_line(&self.to_string()));
        }
    }
}

/// An error of the reader in words, with the way out that a user has.
pub(crate) fn explain(error: &nuage_vdb::Error) -> String {
    let mend = match error {
        nuage_vdb::Error::Malformed { .. } => {
            "; the file is damaged, incomplete or of another format: copy or export it again"
        }
        nuage_vdb::Error::Unsupported { .. } => "; export it as grids of numbers with a current OpenVDB",
        _ => "",
    };
    format!("{error}{mend}")
}
