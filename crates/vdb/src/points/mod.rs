//! Grids of points: positions and other attributes, sorted into the leaves of a tree.
//!
//! A leaf holds an array per attribute; the values of its voxels say where the points of each voxel end in
//! those arrays. Here is what can be asked of such a tree. What an attribute is and how its values are coded
//! lives in `attribute`; how all of it stands in a file, in `read` and `paged`.

mod attribute;
mod paged;
mod read;

use std::ops::Range;

pub use attribute::{Attribute, AttributeArray, AttributeSet, Group, GroupMembers, Numbers};
pub(crate) use read::{read, skip, skip_point_indices};

use crate::transform::Transform;
use crate::tree::Tree;
use crate::value::PointOffset;
use attribute::Column;

/// The type of values as grid types name it.
pub(crate) const VALUE_TYPE: &str = "ptdataidx32";
/// The type of values of point index grids: an index into points that are stored elsewhere.
pub(crate) const INDEX_VALUE_TYPE: &str = "ptidx32";

/// The attribute that holds positions.
pub const POSITION: &str = "P";

/// A tree of points.
#[derive(Debug, Clone, PartialEq)]
pub struct PointTree {
    /// Where the points of each voxel end in the arrays of its leaf. Never descending within a leaf.
    pub offsets: Tree<PointOffset>,
    /// The sets of attributes that leaves have: of almost all grids one, which all leaves share.
    pub attribute_sets: Vec<AttributeSet>,
    /// Which set each leaf has.
    set_of_leaf: Vec<u32>,
    /// The arrays of all leaves by the position of the attribute in its set.
    columns: Vec<Column>,
}

impl PointTree {
    /// The number of points.
    pub fn point_count(&self) -> u64 {
        (0..self.leaf_count()).map(|leaf| self.leaf_point_count(leaf) as u64).sum()
    }

    /// The number of leaves.
    pub fn leaf_count(&self) -> usize {
        self.offsets.leaves.len()
    }

    /// The number of points in a leaf.
    ///
    /// # Panics
    /// If there are not that many leaves.
    pub fn leaf_point_count(&self, leaf: usize) -> usize {
        self.offsets.leaves.stored(leaf).last().map_or(0, |last| last.0 as usize)
    }

    /// Which points of a leaf lie in a voxel, by its offset in the leaf.
    ///
    /// # Panics
    /// If there are not that many leaves, or voxels in one.
    pub fn voxel_points(&self, leaf: usize, offset: usize) -> Range<usize> {
        let ends = self.offsets.leaves.stored(leaf);
        let begin = offset.checked_sub(1).map_or(0, |before| ends[before].0);
        begin as usize..ends[offset].0 as usize
    }

    /// The attributes and groups of a leaf.
    ///
    /// # Panics
    /// If there are not that many leaves.
    pub fn attribute_set(&self, leaf: usize) -> &AttributeSet {
        &self.attribute_sets[self.set_of_leaf[leaf] as usize]
    }

    /// The values of an attribute in a leaf. `None` if the leaf has no such attribute.
    ///
    /// # Panics
    /// If there are not that many leaves.
    pub fn attribute(&self, leaf: usize, name: &str) -> Option<AttributeArray<'_>> {
        let attributes = &self.attribute_set(leaf).attributes;
        let position = attributes.iter().position(|attribute| attribute.name == name)?;
        self.array(leaf, position)
    }

    /// The values of all attributes of a leaf, in the order of its set.
    ///
    /// # Panics
    /// If there are not that many leaves.
    pub fn attributes(&self, leaf: usize) -> impl Iterator<Item = AttributeArray<'_>> {
        (0..self.attribute_set(leaf).attributes.len()).filter_map(move |i| self.array(leaf, i))
    }

    /// Which points of a leaf belong to a group. `None` if the leaf knows no such group.
    ///
    /// # Panics
    /// If there are not that many leaves.
    pub fn group(&self, leaf: usize, name: &str) -> Option<GroupMembers<'_>> {
        let set = self.attribute_set(leaf);
        let group = set.groups.iter().find(|group| group.name == name)?;
        let (position, bit) = set.group_bit(group)?;
        Some(GroupMembers { array: self.array(leaf, position)?, bit })
    }

    /// The positions of the points of a leaf in index space, in the order of its arrays. `None` if the leaf
    /// has no attribute `P` of three floating-point numbers.
    ///
    /// # Panics
    /// If there are not that many leaves.
    pub fn positions_index(&self, leaf: usize) -> Option<impl Iterator<Item = [f64; 3]> + '_> {
        let in_voxel = self.attribute(leaf, POSITION)?.positions()?;
        let origin = self.offsets.leaves.origins[leaf];
        let log2 = self.offsets.shape.leaf_log2();
        let voxels = 0..self.offsets.leaves.leaf_voxels;
        Some(voxels.flat_map(move |offset| self.voxel_points(leaf, offset).map(move |i| (offset, i))).map(
            move |(offset, i)| {
                // Positions count from the centre of their voxel, and a uniform array has one for all points.
                let p = in_voxel.get(i).or(in_voxel.first()).copied().unwrap_or_default();
                std::array::from_fn(|axis| {
                    let cell = offset >> (log2 as usize * (2 - axis)) & ((1 << log2) - 1);
                    f64::from(origin[axis]) + cell as f64 + p[axis]
                })
            },
        ))
    }

    /// The positions of all points in world space, leaf by leaf. Leaves without positions give none.
    pub fn positions_world<'a>(&'a self, transform: &'a Transform) -> impl Iterator<Item = [f64; 3]> + 'a {
        (0..self.leaf_count())
            .filter_map(|leaf| self.positions_index(leaf))
            .flatten()
            .map(|p_index| transform.world_from_index(p_index))
    }

    /// The memory that the points hold, in bytes.
    pub fn memory_bytes(&self) -> u64 {
        let columns: usize =
            self.columns.iter().map(|c| size_of_val(&*c.arrays) + size_of_val(&*c.bytes)).sum();
        let sets: u64 = self.attribute_sets.iter().map(AttributeSet::memory_bytes).sum();
        self.offsets.memory_bytes() + sets + (columns + size_of_val(&*self.set_of_leaf)) as u64
    }

    /// The array of a leaf at a position of its set.
    fn array(&self, leaf: usize, position: usize) -> Option<AttributeArray<'_>> {
        let attribute = self.attribute_set(leaf).attributes.get(position)?;
        self.columns.get(position)?.array(leaf, attribute)
    }
}
