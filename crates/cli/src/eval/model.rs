//! The channels of the models that are evaluated, read one at a time, and packed in memory.

use std::convert::Infallible;
use std::io::Cursor;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use nuage_pipeline::pack::assemble::Report;
use nuage_pipeline::pack::frame::Options;
use nuage_pipeline::pack::plan::role;
use nuage_pipeline::pack::sequence::{FrameName, pack};
use nuage_pipeline::pack::unpack::unpack_frame;
use nuage_pipeline::select::is_drawable;
use nuage_vdb::{AnyTree, Grid, Metadata, Tree};
use nuage_volume::format::{Asset, Role};

use crate::error::{Failure, explain};
use crate::source::DiskFile;

/// A channel of a model.
pub(crate) struct Model {
    /// The name of the file.
    pub(crate) name: String,
    /// The name of the grid in it.
    pub(crate) channel: String,
    /// What the values are.
    pub(crate) role: Role,
    /// The grid, its values as single-precision numbers.
    pub(crate) grid: Grid,
}

impl Model {
    /// The values.
    pub(crate) fn tree(&self) -> &Tree<f32> {
        match &*self.grid.tree {
            AnyTree::Float(tree) => tree,
            _ => unreachable!("models are made with such a tree"),
        }
    }

    /// The grid with other values.
    pub(crate) fn with_tree(&self, tree: Tree<f32>) -> Grid {
        Grid { tree: Arc::new(tree.into()), ..self.grid.clone() }
    }
}

/// Names for files: their own, and the folder's where two have the same.
pub(crate) fn names(paths: &[PathBuf]) -> Vec<String> {
    let last = |path: &Path| {
        path.file_name()
            .map_or_else(|| path.display().to_string(), |name| name.to_string_lossy().into_owned())
    };
    let name = |path: &PathBuf| {
        let own = last(path);
        let is_taken = paths.iter().any(|other| other != path && last(other) == own);
        match path.parent().and_then(Path::file_name).filter(|_| is_taken) {
            Some(folder) => format!("{}/{own}", folder.to_string_lossy()),
            None => own,
        }
    };
    paths.iter().map(name).collect()
}

/// Hands each channel of a file to `each`: grids of numbers on a standard tree that have bricks. How many there were.
///
/// # Errors
/// If the file cannot be read, or `each` fails.
pub(crate) fn channels(
    path: &Path,
    name: &str,
    each: &mut dyn FnMut(Model) -> Result<(), String>,
) -> Result<usize, Failure> {
    let disk = DiskFile::open(path)?;
    let file = disk.vdb()?;
    let mut count = 0;
    for (index, info) in file.grids.iter().enumerate().filter(|(_, info)| is_drawable(info)) {
        let mut grid = file.read_grid(index).map_err(|error| Failure::file(path, explain(&error)))?;
        let taken = std::mem::replace(
            &mut grid.tree,
            Arc::new(Tree::empty(0.0_f32, nuage_vdb::Shape::STANDARD).into()),
        );
        let tree = Arc::try_unwrap(taken).unwrap_or_else(|shared| (*shared).clone());
        // As a name to find the channel by later; those of a file may be alike.
        grid.name.clone_from(&info.unique_name);
        let Some(tree) = tree.into_float().filter(|tree| !tree.leaves.is_empty()) else { continue };
        grid.tree = Arc::new(tree.into());
        let model =
            Model { name: name.to_owned(), channel: info.unique_name.clone(), role: role(&grid), grid };
        count += 1;
        each(model).map_err(|what| Failure::file(path, format!("grid '{}': {what}", info.unique_name)))?;
    }
    Ok(count)
}

/// A channel as a packed file.
pub(crate) struct Packed {
    pub(crate) asset: Asset,
    pub(crate) report: Report,
}

impl Packed {
    /// Packs a channel.
    ///
    /// # Errors
    /// What is wrong, in words.
    pub(crate) fn new(model: &Model, options: &Options) -> Result<Packed, String> {
        let name = FrameName { number: None, name: model.name.clone() };
        let load = |_| Ok::<_, Infallible>((vec![model.grid.clone()], Metadata::default()));
        let mut file = Cursor::new(Vec::new());
        let packed = pack(&[name], load, &mut file, options, None, &mut |_| {});
        let (report, _) = packed.map_err(|error| error.to_string())?;
        let mut asset = Asset::open(file.into_inner()).map_err(|error| error.to_string())?;
        asset.load_all().map_err(|error| error.to_string())?;
        Ok(Packed { asset, report })
    }

    /// What a reader sees.
    ///
    /// # Errors
    /// What is wrong, in words.
    pub(crate) fn grid(&self) -> Result<Grid, String> {
        let (grids, _) = unpack_frame(&self.asset, 0).map_err(|error| error.to_string())?;
        grids.into_iter().next().ok_or_else(|| "nothing was packed".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_of_one_name_are_told_apart_by_their_folders() {
        let paths = ["a/b/x.vdb", "a/c/x.vdb", "a/c/y.vdb"].map(PathBuf::from);
        assert_eq!(names(&paths), ["b/x.vdb", "c/x.vdb", "y.vdb"]);
    }
}
