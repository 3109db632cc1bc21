//! Which grid of a file the user means. Shared by all subcommands with a `--grid` option.

use nuage_vdb::{AnyFile, Source};

/// The position of the grid of that name, or of the only grid if no name was given.
///
/// # Errors
/// What is wrong, with the names to choose from.
pub(crate) fn find_grid<S: Source>(file: &AnyFile<S>, name: Option<&str>) -> Result<usize, String> {
    let names = file.names();
    match (name, names.as_slice()) {
        (_, []) => Err("the file has no grids".into()),
        (Some(name), _) => file
            .find(name)
            .ok_or_else(|| format!("grid '{name}' not found; the file has: {}", names.join(", "))),
        (None, [_]) => Ok(0),
        (None, _) => {
            Err(format!("the file has several grids: {}; choose one with --grid NAME", names.join(", ")))
        }
    }
}
