//! Which grid of a file the user means. Shared by all subcommands with a `--grid` option.

use nuage_vdb::{File, Source};

/// The position of the grid of that name, or of the only grid if no name was given.
///
/// # Errors
/// What is wrong, with the names to choose from.
pub(crate) fn find_grid<S: Source>(file: &File<S>, name: Option<&str>) -> Result<usize, String> {
    let names = || {
        let names: Vec<&str> = file.grids.iter().map(|grid| grid.unique_name.as_str()).collect();
        names.join(", ")
    };
    match (name, file.grids.len()) {
        (_, 0) => Err("the file has no grids".into()),
        (Some(name), _) => {
            file.find(name).ok_or_else(|| format!("grid '{name}' not found; the file has: {}", names()))
        }
        (None, 1) => Ok(0),
        (None, _) => Err(format!("the file has several grids: {}; choose one with --grid NAME", names())),
    }
}
