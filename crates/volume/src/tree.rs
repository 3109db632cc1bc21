//! The packed tree: flat arrays, ready for a GPU.
//!
//! Three levels stand under a root table: `Node5` (32³ slots), `Node4` (16³ slots) and bricks. Only what is
//! present is stored. A node is a run of [`MaskWord`]s, 32 slots each; a set bit has an [`Entry`], found by
//! the word's count of entries before it plus the popcount of the bits below. An entry is a child, or one
//! constant value for its whole region. What has no entry is zero.
//!
//! Beside each entry stands its *footprint*: bounds of everything that trilinear interpolation can give at a
//! point whose lower corner lies in the region, that is of the region's voxels and those one step beyond it.
//! Regions that are zero themselves but touch others have an entry, so that no entry means: zero everywhere.

use bytemuck::{Pod, Zeroable};
use glam::IVec3;

use crate::brick::{Bounds, Bricks};
use crate::space::{NODE4_SLOTS, NODE5_SLOTS, node4_slot, node5_slot, root_cell};

/// 32 slots of a node.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct MaskWord {
    /// Which slots have an entry.
    pub bits: u32,
    /// The index of the entry of the first set bit, in the level's array.
    pub first_entry: u32,
}

/// What a slot holds.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct Entry {
    /// The index of the child node or brick, or [`Entry::CONSTANT`].
    pub child: u32,
    /// The smallest value in the region.
    pub min: f32,
    /// The largest value in the region.
    pub max: f32,
    /// The mean of the region; the value itself of a constant one.
    pub mean: f32,
}

impl Entry {
    /// Marks an entry whose region has one value, which is `mean`.
    pub const CONSTANT: u32 = u32::MAX;

    /// The entry of a region with one value.
    pub fn constant(value: f32) -> Self {
        Entry { child: Entry::CONSTANT, min: value, max: value, mean: value }
    }
}

/// One level of the tree: the masks of its nodes, and the entries of all of them.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Nodes {
    /// `slots / 32` words per node.
    pub words: Vec<MaskWord>,
    /// The entries of all nodes, in the order of nodes and slots.
    pub entries: Vec<Entry>,
    /// The footprint of each entry.
    pub footprints: Vec<Bounds>,
}

impl Nodes {
    /// The index of the entry in a slot of a node.
    #[inline]
    pub fn entry_index(&self, node: u32, slots: usize, slot: usize) -> Option<usize> {
        let word = self.words[node as usize * (slots / 32) + slot / 32];
        let bit = 1u32 << (slot % 32);
        (word.bits & bit != 0)
            .then(|| word.first_entry as usize + (word.bits & (bit - 1)).count_ones() as usize)
    }
}

/// A cell of the root table: 4096³ voxels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RootEntry {
    /// The cell: its first index coordinate over 4096.
    pub cell: IVec3,
    /// What it holds; the child is a `Node5`.
    pub entry: Entry,
    /// The footprint of the entry.
    pub footprint: Bounds,
}

/// The packed tree of one channel. Made by [`crate::build::TreeBuilder`].
#[derive(Debug, Clone, PartialEq)]
pub struct Tree {
    /// The root table, sorted by `(x, y, z)` of the cell.
    pub root: Vec<RootEntry>,
    /// All `Node5`; their children are `Node4`.
    pub node5: Nodes,
    /// All `Node4`; their children are bricks.
    pub node4: Nodes,
    /// The voxel values.
    pub bricks: Bricks,
}

/// What the tree says of the region around a brick coordinate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Region {
    /// The extent: the region is the aligned cube of `1 << log2_bricks` bricks per axis.
    pub log2_bricks: u32,
    /// The values.
    pub content: Content,
    /// Bounds of trilinear samples whose lower corner lies in the region.
    pub footprint: Bounds,
}

/// The values of a region.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Content {
    /// One value.
    Constant(f32),
    /// The brick of this index; the region is one brick.
    Brick(u32),
}

impl Tree {
    /// The root entry of a cell.
    pub fn root_entry(&self, cell: IVec3) -> Option<&RootEntry> {
        let key = |c: IVec3| (c.x, c.y, c.z);
        self.root.binary_search_by_key(&key(cell), |e| key(e.cell)).ok().map(|i| &self.root[i])
    }

    /// The region around a brick, found from the root. [`crate::accessor::Accessor`] is faster for neighbours.
    pub fn region(&self, brick: IVec3) -> Region {
        let empty =
            |log2_bricks| Region { log2_bricks, content: Content::Constant(0.0), footprint: Bounds::of(0.0) };
        let Some(root) = self.root_entry(root_cell(brick)) else { return empty(9) };
        if root.entry.child == Entry::CONSTANT {
            let content = Content::Constant(root.entry.mean);
            return Region { log2_bricks: 9, content, footprint: root.footprint };
        }
        let Some(i) = self.node5.entry_index(root.entry.child, NODE5_SLOTS, node5_slot(brick)) else {
            return empty(4);
        };
        let entry = self.node5.entries[i];
        if entry.child == Entry::CONSTANT {
            let content = Content::Constant(entry.mean);
            return Region { log2_bricks: 4, content, footprint: self.node5.footprints[i] };
        }
        self.region_in_node4(entry.child, brick)
    }

    /// The region of a brick whose `Node4` is known.
    #[inline]
    pub(crate) fn region_in_node4(&self, node4: u32, brick: IVec3) -> Region {
        match self.node4.entry_index(node4, NODE4_SLOTS, node4_slot(brick)) {
            None => Region { log2_bricks: 0, content: Content::Constant(0.0), footprint: Bounds::of(0.0) },
            Some(i) => {
                let entry = self.node4.entries[i];
                let content = match entry.child {
                    Entry::CONSTANT => Content::Constant(entry.mean),
                    brick => Content::Brick(brick),
                };
                Region { log2_bricks: 0, content, footprint: self.node4.footprints[i] }
            }
        }
    }

    /// Bounds of all values, zero included.
    pub fn bounds(&self) -> Bounds {
        self.root.iter().fold(Bounds::of(0.0), |b, r| b.union(Bounds { min: r.entry.min, max: r.entry.max }))
    }

    /// The memory of the tree without the bricks.
    pub fn topology_bytes(&self) -> usize {
        let nodes = |n: &Nodes| {
            size_of_val(n.words.as_slice())
                + size_of_val(n.entries.as_slice())
                + size_of_val(n.footprints.as_slice())
        };
        size_of_val(self.root.as_slice()) + nodes(&self.node5) + nodes(&self.node4)
    }
}
