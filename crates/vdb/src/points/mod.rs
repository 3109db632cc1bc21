//! Grids of points: positions and other attributes, sorted into the leaves of a tree.

use crate::block::BlockFormat;
use crate::error::{Error, Result};
use crate::limits::Budget;
use crate::source::{Reader, Source};
use crate::stats::IndexBox;
use crate::tree::{Shape, Tree};
use crate::value::PointOffset;

/// A tree of points.
#[derive(Debug, Clone, PartialEq)]
pub struct PointTree {
    /// Where the points of each voxel end in the arrays of its leaf.
    pub offsets: Tree<PointOffset>,
}

impl PointTree {
    /// The memory that the points hold, in bytes.
    pub fn memory_bytes(&self) -> u64 {
        self.offsets.memory_bytes()
    }
}

/// The type of values as grid types name it.
pub(crate) const VALUE_TYPE: &str = "ptdataidx32";

/// Reads a tree of points.
pub(crate) fn read(
    _source: &dyn Source,
    _reader: &mut Reader<'_>,
    _format: BlockFormat,
    _shape: Shape,
    _bbox: Option<IndexBox>,
    _budget: &mut Budget,
) -> Result<PointTree> {
    Err(Error::unsupported("grids of points"))
}

/// Moves past a tree of points.
pub(crate) fn skip(
    _reader: &mut Reader<'_>,
    _format: BlockFormat,
    _shape: Shape,
    _budget: &mut Budget,
) -> Result<()> {
    Err(Error::unsupported("grids of points in a file without grid positions"))
}
