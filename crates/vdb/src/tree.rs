//! The decoded tree of a grid: root, inner nodes and leaves in flat vectors.
//!
//! The tree keeps everything the file says, active states included, and is generic over the type of its values
//! and over its shape: OpenVDB's standard is 32³ and 16³ nodes over leaves of 8³ voxels, but a file may name
//! others. Trees are built by the readers of this crate and by [`crate::TreeBuilder`]; rendering wants the packed
//! volume of another crate.

use crate::mask::Mask;
use crate::value::Value;

/// The number of voxels in a leaf of the standard tree.
pub const LEAF_VOXELS: usize = 512;

/// The widths of the nodes of a tree from the root's children down to the leaves, as powers of two.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shape {
    log2: [u8; Shape::MAX_LEVELS],
    count: u8,
}

impl Shape {
    /// The most levels below the root, leaves included.
    pub const MAX_LEVELS: usize = 8;
    /// The standard shape: 32³, 16³, 8³.
    pub const STANDARD: Shape = Shape { log2: [5, 4, 3, 0, 0, 0, 0, 0], count: 3 };

    /// A shape from the root's children to the leaves. `None` for shapes that are not supported: nodes below
    /// 2³ or above 64³, or more levels than [`Shape::MAX_LEVELS`], or more than 2³⁰ voxels along a root entry,
    /// or no level at all.
    pub fn new(log2_root_to_leaf: &[u8]) -> Option<Self> {
        let in_range = log2_root_to_leaf.iter().all(|log2| (1..=6).contains(log2));
        let voxels: u32 = log2_root_to_leaf.iter().map(|log2| u32::from(*log2)).sum();
        let mut log2 = [0; Self::MAX_LEVELS];
        if !in_range || voxels == 0 || voxels > 30 {
            return None;
        }
        log2.get_mut(..log2_root_to_leaf.len())?.copy_from_slice(log2_root_to_leaf);
        Some(Shape { log2, count: log2_root_to_leaf.len() as u8 })
    }

    /// The widths from the root's children to the leaves, as powers of two.
    pub fn log2_root_to_leaf(&self) -> &[u8] {
        &self.log2[..usize::from(self.count)]
    }

    /// The number of levels of inner nodes.
    pub fn inner_levels(&self) -> usize {
        usize::from(self.count) - 1
    }

    /// The inner nodes of level `i`, 0 being the root's children.
    ///
    /// # Panics
    /// If there are not that many levels.
    pub fn branching(&self, i: usize) -> Branching {
        assert!(i < self.inner_levels(), "level {i} of {}", self.inner_levels());
        let below = &self.log2_root_to_leaf()[i + 1..];
        Branching {
            log2_children: self.log2[i].into(),
            log2_child_voxels: below.iter().map(|log2| u32::from(*log2)).sum(),
        }
    }

    /// log2 of the voxels along an edge of a leaf.
    pub fn leaf_log2(&self) -> u32 {
        self.log2[usize::from(self.count) - 1].into()
    }

    /// The voxels of a leaf.
    pub fn leaf_voxels(&self) -> usize {
        1 << (3 * self.leaf_log2())
    }

    /// log2 of the voxels along an edge of an entry of the root.
    pub fn root_log2(&self) -> u32 {
        self.log2_root_to_leaf().iter().map(|log2| u32::from(*log2)).sum()
    }

    /// The smallest coordinate of the root entry that holds an index coordinate.
    pub fn root_origin(&self, ijk: [i32; 3]) -> [i32; 3] {
        ijk.map(|c| c & (-1 << self.root_log2()))
    }

    /// The offset of a voxel in its leaf: z fastest.
    pub fn leaf_offset(&self, ijk: [i32; 3]) -> usize {
        let log2 = self.leaf_log2();
        ijk.iter().fold(0, |offset, c| offset << log2 | (c & ((1 << log2) - 1)) as usize)
    }
}

/// A tree of values of one type.
#[derive(Debug, Clone, PartialEq)]
pub struct Tree<V: Value> {
    /// The value of everything that is not stored.
    pub background: V,
    /// The widths of the nodes.
    pub shape: Shape,
    /// Regions as large as a child of the root with one value, sorted by origin.
    pub root_tiles: Vec<RootTile<V>>,
    /// The inner nodes by level, the children of the root first and sorted by origin; those of one parent stand
    /// together in mask order. As many as [`Shape::inner_levels`].
    pub levels: Vec<Vec<InternalNode<V>>>,
    /// The leaves; those of one parent stand together in mask order.
    pub leaves: Leaves<V>,
}

/// One value for a region as large as a child of the root.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RootTile<V> {
    /// The smallest index coordinate of the region.
    pub origin: [i32; 3],
    /// The value.
    pub value: V,
    /// Whether the region is active.
    pub active: bool,
}

/// A node between root and leaves. A slot `x << 2·log2 | y << log2 | z` is a child, or a tile.
#[derive(Debug, Clone, PartialEq)]
pub struct InternalNode<V> {
    /// The smallest index coordinate of the node.
    pub origin: [i32; 3],
    /// Which slots are children.
    pub child_mask: Mask,
    /// Which slots are active tiles. Bits at children say nothing.
    pub value_mask: Mask,
    /// The values of the slots that are not children.
    pub tiles: Tiles<V>,
    /// Where this node's children begin in the vector of the next level.
    pub first_child: usize,
}

/// The tile values of a node.
#[derive(Debug, Clone, PartialEq)]
pub enum Tiles<V> {
    /// All tiles have this value.
    Uniform(V),
    /// A value per slot; those at children say nothing.
    PerSlot(Box<[V]>),
}

/// All leaves of a tree, one array per property.
#[derive(Debug, Clone, PartialEq)]
pub struct Leaves<V: Value> {
    /// The voxels of a leaf.
    pub leaf_voxels: usize,
    /// The smallest index coordinate of each leaf.
    pub origins: Vec<[i32; 3]>,
    /// The active voxels, a bit each; as many words per leaf as [`Leaves::mask_words`].
    pub masks: Vec<u64>,
    /// The values, active or not, [`Value::stored_per_leaf`] per leaf: for most types one per voxel.
    pub values: Vec<V::Stored>,
}

/// What a tree says of one index coordinate.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Voxel<V> {
    /// The value.
    pub value: V,
    /// The active state.
    pub active: bool,
    /// Where the value is stored: −1 background, 0 root tile, then the tiles of each level of inner nodes (1 and
    /// 2 in the standard tree), and at last the leaves (3).
    pub depth: i32,
}

impl<V: Value> Tiles<V> {
    /// The value of a slot.
    pub fn value(&self, slot: usize) -> V {
        match self {
            Tiles::Uniform(value) => *value,
            Tiles::PerSlot(values) => values.get(slot).copied().unwrap_or_default(),
        }
    }

    /// The tiles of a node from a value per slot, of which those at children say nothing: one value if all tiles
    /// agree on it to the bit, else all of them.
    pub(crate) fn pack(values: &[V], child_mask: &Mask, background: V) -> Self {
        let mut tiles = (0..values.len()).filter(|slot| !child_mask.contains(*slot)).map(|slot| values[slot]);
        let Some(first) = tiles.next() else { return Tiles::Uniform(background) };
        if tiles.all(|value| value.same_bits(first)) {
            return Tiles::Uniform(first);
        }
        // Trees that say the same shall be equal.
        let tile = |slot: usize| if child_mask.contains(slot) { background } else { values[slot] };
        Tiles::PerSlot((0..values.len()).map(tile).collect())
    }
}

impl<V: Value> Leaves<V> {
    /// No leaves of that many voxels each.
    pub fn empty(leaf_voxels: usize) -> Self {
        Leaves { leaf_voxels, origins: Vec::new(), masks: Vec::new(), values: Vec::new() }
    }

    /// The number of leaves.
    pub fn len(&self) -> usize {
        self.origins.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.origins.is_empty()
    }

    /// The words of a leaf's mask: 8 in the standard tree.
    pub fn mask_words(&self) -> usize {
        self.leaf_voxels.div_ceil(64)
    }

    /// The active mask of leaf `i`.
    ///
    /// # Panics
    /// If there are not that many leaves.
    pub fn mask(&self, i: usize) -> &[u64] {
        let words = self.mask_words();
        &self.masks[i * words..(i + 1) * words]
    }

    /// What leaf `i` stores of its values: for most types one value per voxel.
    ///
    /// # Panics
    /// If there are not that many leaves.
    pub fn stored(&self, i: usize) -> &[V::Stored] {
        let count = V::stored_per_leaf(self.leaf_voxels);
        &self.values[i * count..(i + 1) * count]
    }

    /// The value of a voxel of leaf `i`.
    ///
    /// # Panics
    /// If there are not that many leaves, or voxels in one.
    pub fn value(&self, i: usize, offset: usize) -> V {
        V::in_leaf(self.stored(i), self.mask(i), offset)
    }

    /// Whether a voxel of leaf `i` is active.
    ///
    /// # Panics
    /// As [`Leaves::value`].
    pub fn is_active(&self, i: usize, offset: usize) -> bool {
        self.mask(i)[offset / 64] >> (offset % 64) & 1 == 1
    }
}

/// How the inner nodes of one level branch: their own and their children's extent as powers of two.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Branching {
    /// log2 of the number of children per axis.
    pub log2_children: u32,
    /// log2 of the voxels per axis of one child.
    pub log2_child_voxels: u32,
}

/// The children of the root of a standard tree.
pub const LEVEL5: Branching = Branching { log2_children: 5, log2_child_voxels: 7 };
/// The nodes above the leaves of a standard tree.
pub const LEVEL4: Branching = Branching { log2_children: 4, log2_child_voxels: 3 };

impl Branching {
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

/// The offset of a voxel in its leaf in a standard tree: `x << 6 | y << 3 | z`.
pub fn leaf_offset([x, y, z]: [i32; 3]) -> usize {
    ((x & 7) << 6 | (y & 7) << 3 | (z & 7)) as usize
}

impl<V: Value> Tree<V> {
    /// A tree of one value everywhere, nothing of it active.
    pub fn empty(background: V, shape: Shape) -> Self {
        Tree {
            background,
            shape,
            root_tiles: Vec::new(),
            levels: vec![Vec::new(); shape.inner_levels()],
            leaves: Leaves::empty(shape.leaf_voxels()),
        }
    }

    /// The value, state and depth at an index coordinate.
    pub fn voxel(&self, ijk: [i32; 3]) -> Voxel<V> {
        let root_origin = self.shape.root_origin(ijk);
        if let Ok(i) = self.root_tiles.binary_search_by_key(&root_origin, |tile| tile.origin) {
            let tile = self.root_tiles[i];
            return Voxel { value: tile.value, active: tile.active, depth: 0 };
        }
        let found = match self.levels.first() {
            Some(nodes) => nodes.binary_search_by_key(&root_origin, |node| node.origin),
            None => self.leaves.origins.binary_search(&root_origin),
        };
        let Ok(mut child) = found else {
            return Voxel { value: self.background, active: false, depth: -1 };
        };
        for (i, nodes) in self.levels.iter().enumerate() {
            match nodes[child].child_or_tile(self.shape.branching(i), ijk) {
                Ok(next) => child = next,
                Err((value, active)) => return Voxel { value, active, depth: i as i32 + 1 },
            }
        }
        let offset = self.shape.leaf_offset(ijk);
        Voxel {
            value: self.leaves.value(child, offset),
            active: self.leaves.is_active(child, offset),
            depth: self.levels.len() as i32 + 1,
        }
    }

    /// The memory that the tree's vectors hold, in bytes.
    pub fn memory_bytes(&self) -> u64 {
        let node = |node: &InternalNode<V>| {
            let mask_words = node.child_mask.words().len() + node.value_mask.words().len();
            let tiles = match &node.tiles {
                Tiles::Uniform(_) => 0,
                Tiles::PerSlot(values) => size_of_val(&**values),
            };
            size_of_val(node) + mask_words * Mask::BYTES_PER_WORD + tiles
        };
        let nodes: usize = self.levels.iter().flatten().map(node).sum();
        let Leaves { origins, masks, values, .. } = &self.leaves;
        let leaves = size_of_val(&**origins) + size_of_val(&**masks) + size_of_val(&**values);
        (size_of_val(&*self.root_tiles) + nodes + leaves) as u64
    }

    /// The inner nodes of all levels with how they branch, the children of the root first.
    pub fn inner_nodes(&self) -> impl Iterator<Item = (Branching, &InternalNode<V>)> + '_ {
        self.levels.iter().enumerate().flat_map(|(i, nodes)| {
            let branching = self.shape.branching(i);
            nodes.iter().map(move |node| (branching, node))
        })
    }

    /// The leaves in OpenVDB's order: by root child, then by slot, level by level.
    pub fn leaf_order(&self) -> Vec<usize> {
        let mut order: Vec<usize> = match self.levels.first() {
            Some(nodes) => (0..nodes.len()).collect(),
            None => (0..self.leaves.len()).collect(),
        };
        for nodes in &self.levels {
            order = order.iter().flat_map(|i| nodes[*i].children()).collect();
        }
        order
    }
}

impl<V: Value> InternalNode<V> {
    /// The indices of this node's children in the vector of the next level.
    pub fn children(&self) -> std::ops::Range<usize> {
        self.first_child..self.first_child + self.child_mask.count()
    }

    /// The child that holds an index coordinate, or the tile's value and state.
    fn child_or_tile(&self, branching: Branching, ijk: [i32; 3]) -> Result<usize, (V, bool)> {
        let slot = branching.slot(ijk);
        match self.child_mask.contains(slot) {
            true => Ok(self.first_child + self.child_mask.rank(slot)),
            false => Err((self.tiles.value(slot), self.value_mask.contains(slot))),
        }
    }

    /// The slots that are tiles: slot, value, whether active.
    pub fn tile_slots(&self) -> impl Iterator<Item = (usize, V, bool)> + '_ {
        (0..self.child_mask.len())
            .filter(|slot| !self.child_mask.contains(*slot))
            .map(|slot| (slot, self.tiles.value(slot), self.value_mask.contains(slot)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_slot_and_its_origin_are_inverse_to_each_other() {
        for branching in [LEVEL5, LEVEL4] {
            for slot in 0..branching.slots() {
                let origin = branching.child_origin([-4096, 0, 4096], slot);
                assert_eq!(branching.slot(origin), slot);
            }
        }
        assert_eq!(LEVEL4.child_origin([0; 3], 0x123), [8, 16, 24]);
    }

    #[test]
    fn a_shape_says_what_its_levels_are() {
        let shape = Shape::STANDARD;
        assert_eq!(Shape::new(&[5, 4, 3]), Some(shape));
        assert_eq!([shape.branching(0), shape.branching(1)], [LEVEL5, LEVEL4]);
        assert_eq!((shape.leaf_voxels(), shape.root_log2()), (LEAF_VOXELS, 12));
        assert_eq!(shape.root_origin([-1, 4095, 4096]), [-4096, 0, 4096]);
        assert_eq!(shape.leaf_offset([-1, 9, 2]), leaf_offset([-1, 9, 2]));
        let flat = Shape::new(&[3]).unwrap();
        assert_eq!((flat.inner_levels(), flat.leaf_voxels(), flat.root_log2()), (0, 512, 3));
        for wrong in [&[][..], &[0, 3], &[7, 3], &[5, 5, 5, 5, 5, 5, 5], &[2; 9]] {
            assert_eq!(Shape::new(wrong), None, "{wrong:?}");
        }
    }
}
