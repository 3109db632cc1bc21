//! The decoded tree of a float grid: root, 32³ nodes, 16³ nodes and 8³ leaves in flat vectors.
//!
//! The tree is read-only and keeps everything the file says, active states included. Rendering wants the
//! packed volume of another crate; this one is for reading, checking and converting.

use crate::mask::Mask;

/// The number of voxels in a leaf.
pub const LEAF_VOXELS: usize = 512;

/// A float tree with 5-4-3 branching: nodes of 32³ and 16³ children over leaves of 8³ voxels.
#[derive(Debug, Clone, PartialEq)]
pub struct Tree {
    /// The value of everything that is not stored.
    pub background: f32,
    /// Regions of 4096³ voxels with one value, sorted by origin.
    pub root_tiles: Vec<RootTile>,
    /// The children of the root, 32³ children each, sorted by origin.
    pub nodes5: Vec<InternalNode>,
    /// The children of `nodes5`, 16³ children each; those of one parent stand together in mask order.
    pub nodes4: Vec<InternalNode>,
    /// The children of `nodes4`; those of one parent stand together in mask order.
    pub leaves: Leaves,
}

/// One value for 4096³ voxels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RootTile {
    /// The smallest index coordinate of the region.
    pub origin: [i32; 3],
    /// The value.
    pub value: f32,
    /// Whether the region is active.
    pub active: bool,
}

/// A node between root and leaves. A slot `x << 2·log2 | y << log2 | z` is a child, or a tile.
#[derive(Debug, Clone, PartialEq)]
pub struct InternalNode {
    /// The smallest index coordinate of the node.
    pub origin: [i32; 3],
    /// Which slots are children.
    pub child_mask: Mask,
    /// Which slots are active tiles. Bits at children say nothing.
    pub value_mask: Mask,
    /// The values of the slots that are not children.
    pub tiles: Tiles,
    /// Where this node's children begin in the vector of the next level.
    pub first_child: usize,
}

/// The tile values of a node.
#[derive(Debug, Clone, PartialEq)]
pub enum Tiles {
    /// All tiles have this value.
    Uniform(f32),
    /// A value per slot; those at children say nothing.
    PerSlot(Box<[f32]>),
}

/// All leaves of a tree, one array per property.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Leaves {
    /// The smallest index coordinate of each leaf.
    pub origins: Vec<[i32; 3]>,
    /// The active voxels of each leaf, bit `x << 6 | y << 3 | z`.
    pub masks: Vec<[u64; 8]>,
    /// [`LEAF_VOXELS`] values per leaf at offset `x << 6 | y << 3 | z`, active or not.
    pub values: Vec<f32>,
}

/// What a tree says of one index coordinate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Voxel {
    /// The value.
    pub value: f32,
    /// The active state.
    pub active: bool,
    /// Where the value is stored: −1 background, 0 root tile, 1 and 2 tiles of the nodes, 3 leaf.
    pub depth: i32,
}

impl Tiles {
    /// The value of a slot.
    pub fn value(&self, slot: usize) -> f32 {
        match self {
            Tiles::Uniform(value) => *value,
            Tiles::PerSlot(values) => values.get(slot).copied().unwrap_or_default(),
        }
    }
}

impl Leaves {
    /// The number of leaves.
    pub fn len(&self) -> usize {
        self.origins.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.origins.is_empty()
    }

    /// The 512 values of leaf `i`.
    ///
    /// # Panics
    /// If there are not that many leaves.
    pub fn values(&self, i: usize) -> &[f32; LEAF_VOXELS] {
        self.values[i * LEAF_VOXELS..(i + 1) * LEAF_VOXELS].try_into().expect("512 values per leaf")
    }
}

/// Which level an [`InternalNode`] belongs to: its own and its children's extent as powers of two.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Level {
    /// log2 of the number of children per axis.
    pub log2_children: u32,
    /// log2 of the voxels per axis of one child.
    pub log2_child_voxels: u32,
}

/// The children of the root.
pub const LEVEL5: Level = Level { log2_children: 5, log2_child_voxels: 7 };
/// The nodes above the leaves.
pub const LEVEL4: Level = Level { log2_children: 4, log2_child_voxels: 3 };

impl Level {
    /// The number of slots of a node.
    pub const fn slots(self) -> usize {
        1 << (3 * self.log2_children)
    }

    /// The slot of the child that holds an index coordinate.
    pub fn slot(self, ijk: [i32; 3]) -> usize {
        let mask = (1 << self.log2_children) - 1;
        ijk.iter()
            .fold(0, |slot, c| slot << self.log2_children | ((c >> self.log2_child_voxels) & mask) as usize)
    }

    /// The smallest index coordinate of the child in a slot of a node at `origin`.
    pub fn child_origin(self, origin: [i32; 3], slot: usize) -> [i32; 3] {
        let mask = (1 << self.log2_children) - 1;
        std::array::from_fn(|axis| {
            let cell = (slot >> (self.log2_children as usize * (2 - axis))) & mask;
            origin[axis].wrapping_add((cell << self.log2_child_voxels) as i32)
        })
    }
}

/// The offset of a voxel in its leaf.
pub fn leaf_offset([x, y, z]: [i32; 3]) -> usize {
    ((x & 7) << 6 | (y & 7) << 3 | (z & 7)) as usize
}

impl Tree {
    /// The value, state and depth at an index coordinate.
    pub fn voxel(&self, ijk: [i32; 3]) -> Voxel {
        let root_origin = ijk.map(|c| c & !4095);
        if let Ok(i) = self.root_tiles.binary_search_by_key(&root_origin, |tile| tile.origin) {
            let tile = self.root_tiles[i];
            return Voxel { value: tile.value, active: tile.active, depth: 0 };
        }
        let Ok(i) = self.nodes5.binary_search_by_key(&root_origin, |node| node.origin) else {
            return Voxel { value: self.background, active: false, depth: -1 };
        };
        let child = match self.nodes5[i].child_or_tile(LEVEL5, ijk) {
            Ok(child) => child,
            Err((value, active)) => return Voxel { value, active, depth: 1 },
        };
        let leaf = match self.nodes4[child].child_or_tile(LEVEL4, ijk) {
            Ok(leaf) => leaf,
            Err((value, active)) => return Voxel { value, active, depth: 2 },
        };
        let offset = leaf_offset(ijk);
        Voxel {
            value: self.leaves.values(leaf)[offset],
            active: self.leaves.masks[leaf][offset / 64] >> (offset % 64) & 1 == 1,
            depth: 3,
        }
    }

    /// The memory that the tree's vectors hold, in bytes.
    pub fn memory_bytes(&self) -> u64 {
        let node = |node: &InternalNode| {
            let mask_words = node.child_mask.words().len() + node.value_mask.words().len();
            let tiles = match &node.tiles {
                Tiles::Uniform(_) => 0,
                Tiles::PerSlot(values) => size_of_val(&**values),
            };
            size_of_val(node) + mask_words * Mask::BYTES_PER_WORD + tiles
        };
        let nodes: usize = self.nodes5.iter().chain(&self.nodes4).map(node).sum();
        let Leaves { origins, masks, values } = &self.leaves;
        let leaves = size_of_val(&**origins) + size_of_val(&**masks) + size_of_val(&**values);
        (size_of_val(&*self.root_tiles) + nodes + leaves) as u64
    }

    /// The leaves in OpenVDB's order: by root child, then by slot, then by slot.
    pub fn leaf_order(&self) -> impl Iterator<Item = usize> + '_ {
        self.nodes5.iter().flat_map(|node5| node5.children()).flat_map(|i| self.nodes4[i].children())
    }
}

impl InternalNode {
    /// The indices of this node's children in the vector of the next level.
    pub fn children(&self) -> std::ops::Range<usize> {
        self.first_child..self.first_child + self.child_mask.count()
    }

    /// The child that holds an index coordinate, or the tile's value and state.
    fn child_or_tile(&self, level: Level, ijk: [i32; 3]) -> Result<usize, (f32, bool)> {
        let slot = level.slot(ijk);
        match self.child_mask.contains(slot) {
            true => Ok(self.first_child + self.child_mask.rank(slot)),
            false => Err((self.tiles.value(slot), self.value_mask.contains(slot))),
        }
    }

    /// The slots that are tiles: slot, value, whether active.
    pub fn tile_slots(&self) -> impl Iterator<Item = (usize, f32, bool)> + '_ {
        (0..self.child_mask.words().len() * 64)
            .filter(|slot| !self.child_mask.contains(*slot))
            .map(|slot| (slot, self.tiles.value(slot), self.value_mask.contains(slot)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slot_and_its_origin_are_inverse_to_each_other() {
        for level in [LEVEL5, LEVEL4] {
            for slot in 0..level.slots() {
                let origin = level.child_origin([-4096, 0, 4096], slot);
                assert_eq!(level.slot(origin), slot);
            }
        }
        assert_eq!(LEVEL4.child_origin([0; 3], 0x123), [8, 16, 24]);
    }
}
