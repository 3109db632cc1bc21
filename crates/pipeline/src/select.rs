//! Which grid of a file a user means.

use nuage_vdb::{File, GridInfo, Shape, Source};

/// Why no grid was found.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SelectError {
    /// No grid has that name.
    #[error("grid '{name}' not found; the file has: {available}")]
    NotFound {
        /// What was asked for.
        name: String,
        /// The names that exist, separated by commas.
        available: String,
    },
    /// Nothing that can be drawn.
    #[error("the file has no float grid to draw; it has: {available}")]
    NoFloatGrid {
        /// The names and types that exist, separated by commas.
        available: String,
    },
}

/// The grid of that name: a unique name (`density[1]`), else the first grid of that plain name.
///
/// # Errors
/// If there is none.
pub fn named_grid<S: Source>(file: &File<S>, name: &str) -> Result<usize, SelectError> {
    file.find(name).ok_or_else(|| {
        let names: Vec<&str> = file.grids.iter().map(|grid| grid.unique_name.as_str()).collect();
        let available = if names.is_empty() { "no grids".to_owned() } else { names.join(", ") };
        SelectError::NotFound { name: name.to_owned(), available }
    })
}

/// Whether a grid can become a medium: floating-point numbers on a tree of the standard shape.
pub fn is_drawable(grid: &GridInfo) -> bool {
    matches!(grid.value_type(), "float" | "half" | "double") && grid.shape() == Some(Shape::STANDARD)
}

/// The grid to draw when none is named: `density`, else the first fog volume, else the first level set, else
/// the first float grid.
///
/// # Errors
/// If the file has no float grid.
pub fn density_grid<S: Source>(file: &File<S>) -> Result<usize, SelectError> {
    let first = |wanted: &dyn Fn(&GridInfo) -> bool| {
        file.grids.iter().position(|grid| is_drawable(grid) && wanted(grid))
    };
    first(&|grid| grid.name == "density")
        .or_else(|| first(&|grid| grid.grid_class() == "fog volume"))
        .or_else(|| first(&|grid| grid.grid_class() == "level set"))
        .or_else(|| first(&|_| true))
        .ok_or_else(|| {
            let names: Vec<String> = file
                .grids
                .iter()
                .map(|grid| format!("{} ({})", grid.unique_name, grid.value_type()))
                .collect();
            let available = if names.is_empty() { "no grids".to_owned() } else { names.join(", ") };
            SelectError::NoFloatGrid { available }
        })
}

/// The first level set of a file, if it has one that can be drawn.
pub fn level_set<S: Source>(file: &File<S>) -> Option<usize> {
    file.grids.iter().position(|grid| is_drawable(grid) && grid.grid_class() == "level set")
}

/// The unique names of all grids that share the plain name of grid `index`.
pub fn namesakes<S: Source>(file: &File<S>, index: usize) -> Vec<&str> {
    let Some(grid) = file.grids.get(index) else { return Vec::new() };
    file.grids
        .iter()
        .filter(|other| other.name == grid.name)
        .map(|other| other.unique_name.as_str())
        .collect()
}
