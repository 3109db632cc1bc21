//! Packed volumes in memory: the trees of all frames and channels over one store of encoded bricks, in flat arrays of
//! words that a GPU can take as they are.
//!
//! A tree has the shape of [`crate::tree`]: a root table over `Node5`, `Node4` and bricks, of which only what is present
//! is stored. All trees share their arrays, and equal masks, nodes and bricks are stored once ([`build`] sees to it), so
//! that a frame that repeats another costs its root. What has no entry is background everywhere, trilinear samples
//! included: regions that are background themselves but touch others have an entry.
//!
//! [`mask`] is how the slots of a node are stored, [`store`] where the words of bricks stand; [`check`] makes sure of arrays that come from a file. Codecs live in
//! [`crate::codec`].

pub mod build;
pub mod check;
pub mod mask;
pub mod store;

use bytemuck::{Pod, Zeroable};
use glam::IVec3;

use crate::brick::Bounds;
use crate::codec::{Codec, bounds};
use crate::space::{NODE4_SLOTS, NODE5_SLOTS, node4_slot, node5_slot, root_cell};

/// What a slot of a node, or a cell of a root, holds: two words.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash, Pod, Zeroable)]
pub struct Entry {
    /// The bits of a constant value, the offset of a brick in the brick store, or the index of a node.
    pub payload: u32,
    /// The tag of the codec, or [`Entry::NODE`], in the lowest 8 bits; above it the bounds of the footprint: of all that
    /// trilinear interpolation gives at points whose lower corner lies in the region. As [`crate::codec::bounds`].
    pub kind: u32,
}

/// What an entry says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Content {
    /// One value everywhere.
    Constant(f32),
    /// A brick.
    Brick {
        /// How it is stored.
        codec: Codec,
        /// Its offset in the brick store, in words.
        offset: u32,
    },
    /// The node of this index, in the array of its level.
    Node(u32),
}

impl Entry {
    /// The tag of an entry that is a node.
    pub const NODE: u8 = 255;

    /// An entry of some content, and its footprint's bounds in the channel's unit.
    pub fn new(content: Content, footprint: Bounds, unit: f32) -> Entry {
        let (payload, tag) = match content {
            Content::Constant(value) => (value.to_bits(), Codec::Constant.tag()),
            Content::Brick { codec, offset } => (offset, codec.tag()),
            Content::Node(index) => (index, Entry::NODE),
        };
        Entry { payload, kind: u32::from(tag) | bounds::pack(footprint, unit) << 8 }
    }

    /// What the entry says. `None` if its tag is unknown.
    pub fn content(self) -> Option<Content> {
        match self.kind as u8 {
            Entry::NODE => Some(Content::Node(self.payload)),
            tag => match Codec::from_tag(tag)? {
                Codec::Constant => Some(Content::Constant(f32::from_bits(self.payload))),
                codec => Some(Content::Brick { codec, offset: self.payload }),
            },
        }
    }

    /// Bounds of trilinear samples whose lower corner lies in the region.
    pub fn footprint(self, unit: f32) -> Bounds {
        bounds::unpack(self.kind >> 8, unit)
    }
}

/// A node: a mask, and the entries of the slots that it sets, in order.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Pod, Zeroable)]
pub struct Node {
    /// Where its mask begins in [`Trees::masks`].
    pub mask: u32,
    /// The index of its first entry.
    pub first_entry: u32,
}

/// A cell of the root table of a tree: 4096³ voxels.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Pod, Zeroable)]
pub struct RootCell {
    /// The cell: its first index coordinate over 4096.
    pub cell: [i32; 3],
    /// What it holds; a node is a `Node5`.
    pub entry: Entry,
}

/// The arrays of all trees.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Trees {
    /// The root cells of all trees, each tree's together and sorted by `(x, y, z)`.
    pub cells: Vec<RootCell>,
    /// All `Node5`.
    pub node5s: Vec<Node>,
    /// All `Node4`.
    pub node4s: Vec<Node>,
    /// The entries of all nodes.
    pub entries: Vec<Entry>,
    /// The masks of all nodes, as [`mask`] lays them out.
    pub masks: Vec<u32>,
}

/// One tree among [`Trees`].
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct TreeRef {
    /// The index of its first root cell.
    pub first_cell: u32,
    /// How many cells it has.
    pub cell_count: u32,
    /// The value of what has no entry.
    pub background: f32,
}

impl Trees {
    /// The root cells of a tree; none if it names more than there are.
    pub fn cells_of(&self, tree: TreeRef) -> &[RootCell] {
        let first = tree.first_cell as usize;
        self.cells.get(first..first + tree.cell_count as usize).unwrap_or_default()
    }

    /// What a tree holds at a brick coordinate, and the extent of the region as a power of two of bricks per axis.
    pub fn find(&self, tree: TreeRef, brick: IVec3) -> (Content, u32) {
        let background = Content::Constant(tree.background);
        let cells = self.cells_of(tree);
        let cell = root_cell(brick).to_array();
        let Ok(i) = cells.binary_search_by_key(&cell, |found| found.cell) else { return (background, 9) };
        let node5 = match cells[i].entry.content() {
            Some(Content::Node(node)) => self.node5s.get(node as usize),
            content => return (content.unwrap_or(background), 9),
        };
        let entry = |node: Option<&Node>, slots, slot| {
            let node = node?;
            let rank = mask::rank(&self.masks, node.mask, slots, slot)?;
            self.entries.get(node.first_entry as usize + rank)?.content()
        };
        let node4 = match entry(node5, NODE5_SLOTS, node5_slot(brick)) {
            Some(Content::Node(node)) => self.node4s.get(node as usize),
            content => return (content.unwrap_or(background), 4),
        };
        (entry(node4, NODE4_SLOTS, node4_slot(brick)).unwrap_or(background), 0)
    }

    /// The bytes of all arrays.
    pub fn size_bytes(&self) -> usize {
        size_of_val(self.cells.as_slice())
            + size_of_val(self.node5s.as_slice())
            + size_of_val(self.node4s.as_slice())
            + size_of_val(self.entries.as_slice())
            + size_of_val(self.masks.as_slice())
    }
}
