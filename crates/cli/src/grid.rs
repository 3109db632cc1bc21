//! Which grid of a file the user means. Shared by all subcommands with a `--grid` option.

use nuage_pipeline::select;
use nuage_vdb::{File, Source};

/// The position of the grid of that name, or of the only grid if no name was given.
///
/// # Errors
/// What is wrong, with the names to choose from.
pub(crate) fn find_grid<S: Source>(file: &File<S>, name: Option<&str>) -> Result<usize, String> {
    match (name, file.grids.as_slice()) {
        (_, []) => Err("the file has no grids".into()),
        (Some(name), _) => select::named_grid(file, name).map_err(|error| error.to_string()),
        (None, [_]) => Ok(0),
        (None, grids) => {
            let names: Vec<&str> = grids.iter().map(|grid| grid.unique_name.as_str()).collect();
            Err(format!("the file has several grids: {}; choose one with --grid NAME", names.join(", ")))
        }
    }
}
