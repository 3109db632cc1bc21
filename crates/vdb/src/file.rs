//! Opening files and reading grids, whole or a box of one.
//!
//! Opening reads headers only. Each grid says where it begins and ends, so one grid is read without touching
//! the others. Files written as streams lack those positions; they are walked through once at opening.

use std::sync::Arc;

use half::f16;

use crate::any::{AnyTree, Grid};
use crate::block::BlockFormat;
use crate::build;
use crate::error::{Error, Result};
use crate::header::{self, GridInfo, Header};
use crate::limits::{Budget, Limits};
use crate::metadata::Metadata;
use crate::points;
use crate::read;
use crate::source::{Reader, Source};
use crate::stats::IndexBox;
use crate::transform::Transform;
use crate::tree::{Shape, Tree};
use crate::value::{Value, ValueMask};

/// An open VDB file: its header, and the source to read grids from.
pub struct File<S> {
    source: S,
    limits: Limits,
    /// The version of the file format.
    pub file_version: u32,
    /// Major and minor version of the library that wrote the file.
    pub library_version: [u32; 2],
    /// The file's identifier, a UUID in text form.
    pub uuid: String,
    /// The file's own metadata.
    pub metadata: Metadata,
    /// The grids in the order of the file.
    pub grids: Vec<GridInfo>,
}

/// Runs an expression for the type of values of that name, or another one if there is none of that name.
macro_rules! for_value_type {
    ($name:expr, $value:ident => $body:expr, $otherwise:expr) => {
        match $name {
            "float" => for_value_type!(@ f32, $value, $body),
            "double" => for_value_type!(@ f64, $value, $body),
            "half" => for_value_type!(@ f16, $value, $body),
            "int32" => for_value_type!(@ i32, $value, $body),
            "int64" => for_value_type!(@ i64, $value, $body),
            "bool" => for_value_type!(@ bool, $value, $body),
            "mask" => for_value_type!(@ ValueMask, $value, $body),
            "vec3s" => for_value_type!(@ [f32; 3], $value, $body),
            "vec3d" => for_value_type!(@ [f64; 3], $value, $body),
            "vec3i" => for_value_type!(@ [i32; 3], $value, $body),
            _ => $otherwise,
        }
    };
    (@ $type:ty, $value:ident, $body:expr) => {{
        type $value = $type;
        $body
    }};
}

impl GridInfo {
    /// Whether the grid's type is one that this crate reads.
    pub fn is_readable(&self) -> bool {
        let known = for_value_type!(self.stored_type(), _V => true, self.stored_type() == points::VALUE_TYPE);
        known && self.shape().is_some()
    }
}

impl<S: Source> File<S> {
    /// Reads the header of a file with the default [`Limits`].
    ///
    /// # Errors
    /// If the source fails, the bytes are no VDB file or a damaged one, or the version is not supported.
    pub fn open(source: S) -> Result<Self> {
        Self::open_with(source, Limits::default())
    }

    /// Reads the header of a file. The limits hold for opening and for each grid read later.
    ///
    /// # Errors
    /// As [`File::open`], and if a limit is passed.
    pub fn open_with(source: S, limits: Limits) -> Result<Self> {
        let size = source.size_bytes()?;
        let mut reader = Reader::new(&source, 0, size)?;
        let mut budget = Budget::new(&limits);
        let header = header::read_header(&mut reader, &mut budget)?;
        let mut grids = Vec::new();
        for _ in 0..header.grid_count {
            let begin = reader.offset();
            let descriptor = header::read_descriptor(&mut reader, header.file_version)?;
            let after = reader.offset();
            let (grid_begin, grid_end) = match header.has_offsets {
                true => (descriptor.grid_begin, descriptor.grid_end),
                false => (after, size),
            };
            if grid_end > size {
                return Err(Error::malformed(
                    after,
                    format!("the grid '{}' ends at byte {grid_end} of {size}", descriptor.unique_name),
                ));
            }
            // Growing positions also bound the number of grids by the size of the file.
            if grid_begin < after || grid_end < grid_begin {
                return Err(Error::malformed(after, "the positions of a grid are out of order"));
            }
            reader.seek(grid_begin);
            let mut info = header::read_grid_header(&mut reader, &header, &descriptor, &mut budget)?;
            header::take_grid_header(&mut budget, after - begin + (reader.offset() - grid_begin))?;
            if reader.offset() > grid_end {
                return Err(Error::malformed(reader.offset(), "a grid's header passes its end"));
            }
            if header.file_version < header::INSTANCES_SINCE {
                let format = block_format(header.file_version, &info);
                info.transform = transform_behind_topology(&source, &info, format, grid_end, &limits)?;
            }
            info.tree_range[1] = grid_end;
            if !header.has_offsets {
                if info.instance_of.is_none() {
                    skip_tree(&mut reader, &info, block_format(header.file_version, &info), &limits)?;
                }
                info.tree_range[1] = reader.offset();
            }
            reader.seek(info.tree_range[1]);
            grids.push(info);
        }
        drop(reader);
        let Header { file_version, library_version, uuid, metadata, .. } = header;
        Ok(File { source, limits, file_version, library_version, uuid, metadata, grids })
    }

    /// The grid of that name: a unique name, else the first grid of that plain name.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.grids
            .iter()
            .position(|grid| grid.unique_name == name)
            .or_else(|| self.grids.iter().position(|grid| grid.name == name))
    }

    /// Reads the voxels of grid `index`, without reading those of any other.
    ///
    /// # Errors
    /// If the source fails, the bytes are damaged, the type of the grid is not supported, a limit is passed,
    /// or there is no such grid.
    pub fn read_grid(&self, index: usize) -> Result<Grid> {
        let info = self.info(index)?;
        let tree = self.read_tree(self.owner(info)?, None)?;
        Ok(grid_of(info, Arc::new(tree)))
    }

    /// Reads the voxels of grid `index` that lie in a box `[min, max]` of index space, both ends included. Of the
    /// file's bytes those of leaves that lie outside are not decoded, and read only where they stand between others.
    /// Everything outside the box is inactive background in the result; tiles that the box cuts are taken apart.
    /// The leaves of point grids stay whole.
    ///
    /// # Errors
    /// As [`File::read_grid`], and [`Error::Misuse`] if the box is empty.
    pub fn read_grid_in_box(&self, index: usize, bbox: IndexBox) -> Result<Grid> {
        if (0..3).any(|i| bbox[0][i] > bbox[1][i]) {
            return Err(Error::Misuse(format!("the box {bbox:?} is empty: its minimum passes its maximum")));
        }
        let info = self.info(index)?;
        let tree = self.read_tree(self.owner(info)?, Some(bbox))?;
        Ok(grid_of(info, Arc::new(tree)))
    }

    /// Reads all grids. Those that share a tree in the file share it in memory.
    ///
    /// # Errors
    /// As [`File::read_grid`]. The memory limit holds for each grid on its own.
    pub fn read_all(&self) -> Result<Vec<Grid>> {
        let mut trees: Vec<(&str, Arc<AnyTree>)> = Vec::new();
        let mut grids = Vec::with_capacity(self.grids.len());
        for info in &self.grids {
            let owner = self.owner(info)?;
            let known = trees.iter().find(|(name, _)| *name == owner.unique_name);
            let tree = match known {
                Some((_, tree)) => tree.clone(),
                None => {
                    let tree = Arc::new(self.read_tree(owner, None)?);
                    trees.push((&owner.unique_name, tree.clone()));
                    tree
                }
            };
            grids.push(grid_of(info, tree));
        }
        Ok(grids)
    }

    fn info(&self, index: usize) -> Result<&GridInfo> {
        self.grids
            .get(index)
            .ok_or_else(|| Error::Misuse(format!("there is no grid {index}, only {}", self.grids.len())))
    }

    /// The grid that holds the tree of another: itself or the one it shares a tree with.
    fn owner<'a>(&'a self, info: &'a GridInfo) -> Result<&'a GridInfo> {
        let Some(name) = &info.instance_of else { return Ok(info) };
        let owner = self.grids.iter().find(|grid| grid.unique_name == *name && grid.instance_of.is_none());
        let owner = owner.ok_or_else(|| {
            Error::malformed(
                info.tree_range[0],
                format!("the grid '{name}' that '{}' shares its tree with is missing", info.unique_name),
            )
        })?;
        match owner.grid_type == info.grid_type {
            true => Ok(owner),
            false => Err(Error::malformed(
                info.tree_range[0],
                format!(
                    "the grid '{name}' that '{}' shares its tree with has another type",
                    info.unique_name
                ),
            )),
        }
    }

    fn read_tree(&self, info: &GridInfo, bbox: Option<IndexBox>) -> Result<AnyTree> {
        let unsupported = || {
            Error::unsupported(format!("grids of type '{}' (grid '{}')", info.grid_type, info.unique_name))
        };
        let shape = info.shape().ok_or_else(unsupported)?;
        let mut budget = Budget::new(&self.limits);
        let mut reader = Reader::new(&self.source, info.tree_range[0], info.tree_range[1])?;
        let format = block_format(self.file_version, info);
        let read = TreeRead { source: &self.source, format, shape };
        for_value_type!(
            info.stored_type(),
            V => read.values::<V>(&mut reader, bbox, &mut budget).map(AnyTree::from),
            match info.stored_type() {
                points::VALUE_TYPE => {
                    points::read(&self.source, &mut reader, format, shape, bbox, &mut budget).map(AnyTree::from)
                }
                _ => Err(unsupported()),
            }
        )
    }
}

/// What reading the tree of a grid takes.
struct TreeRead<'a> {
    source: &'a dyn Source,
    format: BlockFormat,
    shape: Shape,
}

impl TreeRead<'_> {
    fn values<V: Value>(
        &self,
        reader: &mut Reader<'_>,
        bbox: Option<IndexBox>,
        budget: &mut Budget,
    ) -> Result<Tree<V>> {
        let mut tree = nodes::<V>(reader, self.format, self.shape, budget)?;
        let Some(bbox) = bbox else {
            read::leaf_values(self.source, reader, self.format, &mut tree, budget)?;
            return Ok(tree);
        };
        let (wanted, values) =
            read::leaf_values_in_box(self.source, reader, self.format, &tree, bbox, budget)?;
        let per_leaf = V::stored_per_leaf(self.shape.leaf_voxels());
        let leaves =
            wanted.iter().enumerate().map(|(i, leaf)| (*leaf as usize, &values[i * per_leaf..][..per_leaf]));
        build::clip_parts(&tree, leaves, bbox, budget.left_bytes())
    }
}

fn grid_of(info: &GridInfo, tree: Arc<AnyTree>) -> Grid {
    Grid {
        name: info.name.clone(),
        metadata: info.metadata.clone(),
        transform: info.transform.clone(),
        save_float_as_half: info.save_float_as_half,
        tree,
    }
}

fn block_format(file_version: u32, info: &GridInfo) -> BlockFormat {
    BlockFormat { compression: info.compression, half: info.save_float_as_half, file_version }
}

/// Reads the nodes of a tree and moves to its leaves' values: past the transform, which old files have in between.
fn nodes<V: Value>(
    reader: &mut Reader<'_>,
    format: BlockFormat,
    shape: Shape,
    budget: &mut Budget,
) -> Result<Tree<V>> {
    let tree = read::topology::<V>(reader, format, shape, budget)?;
    if format.file_version < header::INSTANCES_SINCE {
        Transform::read(reader, format.file_version)?;
    }
    Ok(tree)
}

fn no_way_past(info: &GridInfo) -> Error {
    Error::unsupported(format!("a file of this kind that holds a grid of type '{}'", info.grid_type))
}

/// Moves past the tree of a grid in a file without positions.
fn skip_tree(reader: &mut Reader<'_>, info: &GridInfo, format: BlockFormat, limits: &Limits) -> Result<()> {
    let shape = info.shape().ok_or_else(|| no_way_past(info))?;
    let mut budget = Budget::new(limits);
    for_value_type!(
        info.stored_type(),
        V => {
            let tree = nodes::<V>(reader, format, shape, &mut budget)?;
            read::skip_leaf_values(reader, format, &tree.leaves)
        },
        match info.stored_type() {
            points::VALUE_TYPE => points::skip(reader, format, shape, &mut budget),
            points::INDEX_VALUE_TYPE => points::skip_point_indices(reader, format, shape, &mut budget),
            _ => Err(no_way_past(info)),
        }
    )
}

/// What walking through the tree of a grid shows besides its values.
pub(crate) struct Walked {
    /// Where the tree ends.
    pub(crate) end: u64,
    /// Position and origin of the first leaf whose mask stands differently before its values.
    pub(crate) contrary_mask: Option<(u64, [i32; 3])>,
}

/// Walks through the tree of a grid without decoding its values. `None` for grids of points.
pub(crate) fn walk_tree<S: Source>(file: &File<S>, info: &GridInfo) -> Result<Option<Walked>> {
    let shape = info.shape().ok_or_else(|| no_way_past(info))?;
    let mut reader = Reader::new(&file.source, info.tree_range[0], info.tree_range[1])?;
    let mut budget = Budget::new(&file.limits);
    let format = block_format(file.file_version, info);
    for_value_type!(
        info.stored_type(),
        V => {
            let tree = nodes::<V>(&mut reader, format, shape, &mut budget)?;
            let contrary_mask = read::first_contrary_mask(&mut reader, format, &tree.leaves)?;
            Ok(Some(Walked { end: reader.offset(), contrary_mask }))
        },
        Ok(None)
    )
}

/// Reads the transform of a grid from behind its topology, where old files have it.
fn transform_behind_topology(
    source: &dyn Source,
    info: &GridInfo,
    format: BlockFormat,
    grid_end: u64,
    limits: &Limits,
) -> Result<Transform> {
    let shape = info.shape().ok_or_else(|| no_way_past(info))?;
    let mut reader = Reader::new(source, info.tree_range[0], grid_end)?;
    let mut budget = Budget::new(limits);
    for_value_type!(
        info.stored_type(),
        V => read::topology::<V>(&mut reader, format, shape, &mut budget).map(|_| ())?,
        return Err(no_way_past(info))
    );
    Transform::read(&mut reader, format.file_version)
}
