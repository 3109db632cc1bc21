//! Statistics of a tree: counts, boxes, extremes and hashes, with the meanings OpenVDB gives them.

use crate::mask::bits;
use crate::tree::{InternalNode, LEVEL4, LEVEL5, Level, RootTile, Tree};

/// A box of index coordinates `[min, max]`, both ends included.
pub type IndexBox = [[i32; 3]; 2];

/// What [`Tree::statistics`] finds in one pass.
#[derive(Debug, Clone, PartialEq)]
pub struct Statistics {
    /// Active voxels, those of active tiles included.
    pub active_voxels: u64,
    /// Active tiles at all levels.
    pub active_tiles: u64,
    /// Nodes per level: leaves, 16³ nodes, 32³ nodes, the root.
    pub node_counts_leaf_to_root: [u64; 4],
    /// The box of all active voxels and tiles.
    pub active_bbox: Option<IndexBox>,
    /// The box of whole leaves with an active voxel and of active tiles, as OpenVDB's
    /// `evalLeafBoundingBox`; `None` in a tree without leaves.
    pub leaf_bbox: Option<IndexBox>,
    /// Smallest and largest active value that is a number, if there is one.
    pub min_max: Option<[f32; 2]>,
    /// Active voxels of leaves and active tiles whose value is not a number.
    pub nan_count: u64,
}

impl Tree {
    /// Counts, boxes and extremes of the tree.
    pub fn statistics(&self) -> Statistics {
        let mut seen = Seen { min_max: None, nan_count: 0 };
        let (mut active_voxels, mut active_tiles) = (0u64, 0u64);
        for tile in self.active_tiles() {
            active_tiles += 1;
            active_voxels = active_voxels.saturating_add(1 << (3 * tile.log2_voxels));
            seen.value(tile.value);
        }
        let mut leaf_bbox = self.active_tile_bbox();
        for (i, (origin, mask)) in self.leaves.origins.iter().zip(&self.leaves.masks).enumerate() {
            let active = mask.iter().map(|word| u64::from(word.count_ones())).sum::<u64>();
            active_voxels = active_voxels.saturating_add(active);
            if active > 0 {
                grow(&mut leaf_bbox, *origin, origin.map(|c| c.wrapping_add(7)));
            }
            let values = self.leaves.values(i);
            for (x, word) in mask.iter().enumerate() {
                bits(*word).for_each(|bit| seen.value(values[x * 64 + bit]));
            }
        }
        Statistics {
            active_voxels,
            active_tiles,
            node_counts_leaf_to_root: [
                self.leaves.len() as u64,
                self.nodes4.len() as u64,
                self.nodes5.len() as u64,
                1,
            ],
            active_bbox: self.active_bbox(),
            leaf_bbox: leaf_bbox.filter(|_| !self.leaves.is_empty()),
            min_max: seen.min_max,
            nan_count: seen.nan_count,
        }
    }

    /// The box of all active voxels and tiles, without looking at values.
    pub fn active_bbox(&self) -> Option<IndexBox> {
        let mut bbox = self.active_tile_bbox();
        for (origin, mask) in self.leaves.origins.iter().zip(&self.leaves.masks) {
            grow_to_leaf(&mut bbox, *origin, mask);
        }
        bbox
    }

    fn active_tile_bbox(&self) -> Option<IndexBox> {
        let mut bbox = None;
        for ActiveTile { origin, log2_voxels, .. } in self.active_tiles() {
            grow(&mut bbox, origin, origin.map(|c| c.wrapping_add((1 << log2_voxels) - 1)));
        }
        bbox
    }

    fn active_tiles(&self) -> impl Iterator<Item = ActiveTile> + '_ {
        let of_root =
            |tile: &RootTile| ActiveTile { origin: tile.origin, log2_voxels: 12, value: tile.value };
        let root_tiles = self.root_tiles.iter().filter(|tile| tile.active).map(of_root);
        let tiles5 = self.nodes5.iter().flat_map(|node| active_tiles_of(node, LEVEL5));
        let tiles4 = self.nodes4.iter().flat_map(|node| active_tiles_of(node, LEVEL4));
        root_tiles.chain(tiles5).chain(tiles4)
    }

    /// FNV-1a hash over origin (three little-endian i32) and mask (64 bytes) of every leaf, in leaf order.
    pub fn topology_hash(&self) -> u64 {
        let mut hash = Fnv1a::default();
        for leaf in self.leaf_order() {
            self.leaves.origins[leaf].iter().for_each(|c| hash.add(&c.to_le_bytes()));
            self.leaves.masks[leaf].iter().for_each(|word| hash.add(&word.to_le_bytes()));
        }
        hash.0
    }

    /// FNV-1a hash over all 512 values of every leaf (little-endian f32), in leaf order.
    pub fn leaf_value_hash(&self) -> u64 {
        let mut hash = Fnv1a::default();
        for leaf in self.leaf_order() {
            self.leaves.values(leaf).iter().for_each(|value| hash.add(&value.to_le_bytes()));
        }
        hash.0
    }
}

/// 64-bit FNV-1a.
struct Fnv1a(u64);

impl Default for Fnv1a {
    fn default() -> Self {
        Fnv1a(0xcbf2_9ce4_8422_2325)
    }
}

impl Fnv1a {
    fn add(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.0 = (self.0 ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }
}

fn grow(bbox: &mut Option<IndexBox>, min: [i32; 3], max: [i32; 3]) {
    let [low, high] = bbox.get_or_insert([min, max]);
    for axis in 0..3 {
        low[axis] = low[axis].min(min[axis]);
        high[axis] = high[axis].max(max[axis]);
    }
}

/// An active region of one value.
struct ActiveTile {
    origin: [i32; 3],
    log2_voxels: u32,
    value: f32,
}

fn active_tiles_of(node: &InternalNode, level: Level) -> impl Iterator<Item = ActiveTile> + '_ {
    let slots = node.value_mask.iter().filter(|slot| !node.child_mask.contains(*slot));
    slots.map(move |slot| ActiveTile {
        origin: level.child_origin(node.origin, slot),
        log2_voxels: level.log2_child_voxels,
        value: node.tiles.value(slot),
    })
}

/// Extremes of the values that are numbers, and how many are not.
struct Seen {
    min_max: Option<[f32; 2]>,
    nan_count: u64,
}

impl Seen {
    fn value(&mut self, value: f32) {
        if value.is_nan() {
            self.nan_count += 1;
            return;
        }
        let [min, max] = self.min_max.get_or_insert([value, value]);
        *min = min.min(value);
        *max = max.max(value);
    }
}

/// Takes in the active voxels of a leaf.
fn grow_to_leaf(bbox: &mut Option<IndexBox>, origin: [i32; 3], mask: &[u64; 8]) {
    // One word is a slab of constant x; its bytes are rows of constant y.
    let slab = mask.iter().fold(0, |all, word| all | word);
    if slab == 0 {
        return;
    }
    let x = (0..8).filter(|x| mask[*x as usize] != 0);
    let y = (0..8).filter(|y| slab >> (8 * y) & 0xff != 0);
    let columns = slab.to_le_bytes().iter().fold(0u8, |all, row| all | row);
    let min = [x.clone().min().unwrap_or(0), y.clone().min().unwrap_or(0), columns.trailing_zeros() as i32];
    let max = [x.max().unwrap_or(7), y.max().unwrap_or(7), 7 - columns.leading_zeros() as i32];
    let at = |local: [i32; 3]| std::array::from_fn(|i| origin[i].wrapping_add(local[i]));
    grow(bbox, at(min), at(max));
}
