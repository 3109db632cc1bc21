//! A file of any of the kinds that are read: `.vdb` or `.nvdb`, told apart by their first bytes.
//!
//! Only what both kinds have in common lives here: grids with names, to be read whole or a box of one.

use crate::any::Grid;
use crate::error::{Error, Result};
use crate::file::File;
use crate::limits::Limits;
use crate::metadata::Metadata;
use crate::nano;
use crate::source::Source;
use crate::stats::IndexBox;

/// An open file.
pub enum AnyFile<S> {
    /// A VDB file.
    Vdb(File<S>),
    /// A NanoVDB file.
    Nano(nano::File<S>),
}

impl<S: Source> AnyFile<S> {
    /// Reads the headers of a file, which is a NanoVDB file if it begins with that name and else a VDB file.
    ///
    /// # Errors
    /// As [`File::open_with`] and [`nano::File::open_with`].
    pub fn open_with(source: S, limits: Limits) -> Result<Self> {
        match is_nano(&source)? {
            true => nano::File::open_with(source, limits).map(AnyFile::Nano),
            false => File::open_with(source, limits).map(AnyFile::Vdb),
        }
    }

    /// The unique names of the grids, in the order of the file. NanoVDB files have plain names only.
    pub fn names(&self) -> Vec<&str> {
        match self {
            AnyFile::Vdb(file) => file.grids.iter().map(|grid| grid.unique_name.as_str()).collect(),
            AnyFile::Nano(file) => file.grids.iter().map(|grid| grid.name.as_str()).collect(),
        }
    }

    /// The grid of that name: a unique name, else the first grid of that plain name.
    pub fn find(&self, name: &str) -> Option<usize> {
        match self {
            AnyFile::Vdb(file) => file.find(name),
            AnyFile::Nano(file) => file.find(name),
        }
    }

    /// The file's own metadata, of which NanoVDB files have none.
    pub fn metadata(&self) -> Metadata {
        match self {
            AnyFile::Vdb(file) => file.metadata.clone(),
            AnyFile::Nano(_) => Metadata::default(),
        }
    }

    /// Reads the voxels of grid `index`.
    ///
    /// # Errors
    /// As [`File::read_grid`].
    pub fn read_grid(&self, index: usize) -> Result<Grid> {
        match self {
            AnyFile::Vdb(file) => file.read_grid(index),
            AnyFile::Nano(file) => file.read_grid(index),
        }
    }

    /// Reads the voxels of grid `index` that lie in a box `[min, max]` of index space, both ends included; see
    /// [`File::read_grid_in_box`]. Of NanoVDB files the grid is read whole and then cut.
    ///
    /// # Errors
    /// As [`File::read_grid_in_box`]; the limit is the default one for tiles of NanoVDB files taken apart.
    pub fn read_grid_in_box(&self, index: usize, bbox: IndexBox) -> Result<Grid> {
        match self {
            AnyFile::Vdb(file) => file.read_grid_in_box(index, bbox),
            AnyFile::Nano(_) if (0..3).any(|i| bbox[0][i] > bbox[1][i]) => {
                Err(Error::Misuse(format!("the box {bbox:?} is empty: its minimum passes its maximum")))
            }
            AnyFile::Nano(file) => {
                let mut grid = file.read_grid(index)?;
                grid.tree = grid.tree.clip(bbox, Limits::default().max_memory_bytes)?.into();
                Ok(grid)
            }
        }
    }

    /// Reads all grids. Those that share a tree in the file share it in memory.
    ///
    /// # Errors
    /// As [`File::read_all`].
    pub fn read_all(&self) -> Result<Vec<Grid>> {
        match self {
            AnyFile::Vdb(file) => file.read_all(),
            AnyFile::Nano(file) => file.read_all(),
        }
    }
}

/// Whether the bytes begin as those of NanoVDB files do, whichever their kind.
pub(crate) fn is_nano<S: Source>(source: &S) -> Result<bool> {
    const BEGIN: &[u8] = b"NanoVDB";
    let len = source.size_bytes()?.min(BEGIN.len() as u64);
    Ok(*source.range(0, len as usize)? == *BEGIN)
}
