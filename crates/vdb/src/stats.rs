//! Statistics of a tree: counts, boxes, extremes and hashes, with the meanings OpenVDB gives them.

use crate::mask::bits;
use crate::tree::{InternalNode, Tree};
use crate::value::{LeafValues, Value};

/// A box of index coordinates `[min, max]`, both ends included.
pub type IndexBox = [[i32; 3]; 2];

/// What [`Tree::statistics`] finds in one pass.
#[derive(Debug, Clone, PartialEq)]
pub struct Statistics {
    /// Active voxels, those of active tiles included.
    pub active_voxels: u64,
    /// Active voxels of leaves alone.
    pub active_leaf_voxels: u64,
    /// Active tiles at all levels.
    pub active_tiles: u64,
    /// Tiles by the depth at which they are stored: of the root, then of each level of inner nodes.
    pub tiles_by_depth: Vec<TileCount>,
    /// Leaves all of whose voxels are active.
    pub dense_leaves: u64,
    /// Leaves none of whose voxels is active.
    pub leaves_without_active: u64,
    /// Nodes per level: leaves, then the levels of inner nodes upward (16³ and 32³ in the standard tree), the
    /// root.
    pub node_counts_leaf_to_root: Vec<u64>,
    /// The box of all active voxels and tiles.
    pub active_bbox: Option<IndexBox>,
    /// The box of whole leaves with an active voxel and of active tiles, as OpenVDB's
    /// `evalLeafBoundingBox`; `None` in a tree without leaves.
    pub leaf_bbox: Option<IndexBox>,
    /// What the active values are, per component: one entry, or three for vectors.
    pub components: Vec<ComponentStatistics>,
    /// Active voxels of leaves and active tiles of whose value some component is not a number.
    pub nan_count: u64,
}

/// The tiles of one depth.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct TileCount {
    /// Active ones.
    pub active: u64,
    /// Inactive ones whose value is not the background's.
    pub inactive_not_background: u64,
}

/// The active values of one component, those that are not a number left out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ComponentStatistics {
    /// The smallest; +∞ if there is none.
    pub min: f64,
    /// The largest; −∞ if there is none.
    pub max: f64,
    /// The sum over voxels, those of tiles included.
    pub sum: f64,
    /// The sum of squares over voxels, those of tiles included.
    pub sum_of_squares: f64,
}

impl Statistics {
    /// Smallest and largest active value per component, if there is an active value that is a number.
    pub fn min_max(&self) -> Option<Vec<[f64; 2]>> {
        let found = self.components.iter().all(|c| c.min <= c.max);
        found.then(|| self.components.iter().map(|c| [c.min, c.max]).collect())
    }
}

impl ComponentStatistics {
    /// The mean over that many active voxels, those whose value is not a number not among them.
    pub fn mean(&self, voxels: f64) -> f64 {
        self.sum / voxels
    }

    /// The standard deviation over that many active voxels.
    pub fn standard_deviation(&self, voxels: f64) -> f64 {
        (self.sum_of_squares / voxels - self.mean(voxels).powi(2)).max(0.0).sqrt()
    }
}

/// How often active values fall into each of some equal intervals.
#[derive(Debug, Clone, PartialEq)]
pub struct Histogram {
    /// The lower end of the first interval and the upper end of the last.
    pub range: [f64; 2],
    /// Active voxels per interval, those of tiles included. Values outside the range count nowhere.
    pub counts: Vec<u64>,
}

impl<V: Value> Tree<V> {
    /// Counts, boxes and extremes of the tree.
    pub fn statistics(&self) -> Statistics {
        let mut seen = Seen::new(V::COMPONENTS);
        let mut active_tiles = 0u64;
        let mut tile_voxels = 0u64;
        for tile in self.active_tiles() {
            active_tiles += 1;
            let voxels = 1 << (3 * tile.log2_voxels).min(63);
            tile_voxels = tile_voxels.saturating_add(voxels);
            seen.value(tile.value, voxels);
        }
        let mut leaf_bbox = self.active_tile_bbox();
        let last = (1 << self.shape.leaf_log2()) - 1;
        let mut active_leaf_voxels = 0u64;
        let (mut dense_leaves, mut leaves_without_active) = (0, 0);
        for (i, origin) in self.leaves.origins.iter().enumerate() {
            let mask = self.leaves.mask(i);
            let active = mask.iter().map(|word| u64::from(word.count_ones())).sum::<u64>();
            active_leaf_voxels += active;
            dense_leaves += u64::from(active == self.leaves.leaf_voxels as u64);
            leaves_without_active += u64::from(active == 0);
            if active > 0 {
                grow(&mut leaf_bbox, *origin, origin.map(|c| c.wrapping_add(last)));
            }
            let stored = self.leaves.stored(i);
            for (w, word) in mask.iter().enumerate() {
                bits(*word).for_each(|bit| seen.value(V::in_leaf(stored, mask, w * 64 + bit), 1));
            }
        }
        let mut node_counts_leaf_to_root = vec![self.leaves.len() as u64];
        node_counts_leaf_to_root.extend(self.levels.iter().rev().map(|nodes| nodes.len() as u64));
        node_counts_leaf_to_root.push(1);
        Statistics {
            active_voxels: active_leaf_voxels.saturating_add(tile_voxels),
            active_leaf_voxels,
            active_tiles,
            tiles_by_depth: self.tiles_by_depth(),
            dense_leaves,
            leaves_without_active,
            node_counts_leaf_to_root,
            active_bbox: self.active_bbox(),
            leaf_bbox: leaf_bbox.filter(|_| !self.leaves.is_empty()),
            components: seen.components,
            nan_count: seen.nan_count,
        }
    }

    fn tiles_by_depth(&self) -> Vec<TileCount> {
        let mut counts = vec![TileCount::default(); self.levels.len() + 1];
        let mut count = |depth: usize, value: V, active: bool| {
            let TileCount { active: on, inactive_not_background: off } = &mut counts[depth];
            *on += u64::from(active);
            *off += u64::from(!active && !value.same_bits(self.background));
        };
        self.root_tiles.iter().for_each(|tile| count(0, tile.value, tile.active));
        for (i, nodes) in self.levels.iter().enumerate() {
            for node in nodes {
                node.tile_slots().for_each(|(_, value, active)| count(i + 1, value, active));
            }
        }
        counts
    }

    /// The number of active voxels, those of tiles included.
    pub fn active_voxel_count(&self) -> u64 {
        let of_leaves: u64 = self.leaves.masks.iter().map(|word| u64::from(word.count_ones())).sum();
        let of_tile = |tile: ActiveTile<V>| 1u64 << (3 * tile.log2_voxels).min(63);
        self.active_tiles().map(of_tile).fold(of_leaves, u64::saturating_add)
    }

    /// How one component of the active values is distributed between two bounds.
    pub fn histogram(&self, component: usize, range: [f64; 2], intervals: usize) -> Histogram {
        let mut counts = vec![0u64; intervals];
        let scale = intervals as f64 / (range[1] - range[0]);
        let mut count = |value: V, voxels: u64| {
            let x = value.component(component);
            if x >= range[0] && x <= range[1] {
                let interval = if scale.is_finite() { ((x - range[0]) * scale) as usize } else { 0 };
                if let Some(count) = counts.get_mut(interval.min(intervals.saturating_sub(1))) {
                    *count = count.saturating_add(voxels);
                }
            }
        };
        self.active_tiles().for_each(|tile| count(tile.value, 1 << (3 * tile.log2_voxels).min(63)));
        for i in 0..self.leaves.len() {
            let (stored, mask) = (self.leaves.stored(i), self.leaves.mask(i));
            for (w, word) in mask.iter().enumerate() {
                bits(*word).for_each(|bit| count(V::in_leaf(stored, mask, w * 64 + bit), 1));
            }
        }
        Histogram { range, counts }
    }

    /// The box of all active voxels and tiles, without looking at values.
    pub fn active_bbox(&self) -> Option<IndexBox> {
        let mut bbox = self.active_tile_bbox();
        for (i, origin) in self.leaves.origins.iter().enumerate() {
            grow_to_leaf(&mut bbox, *origin, self.leaves.mask(i), self.shape.leaf_log2());
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

    fn active_tiles(&self) -> impl Iterator<Item = ActiveTile<V>> + '_ {
        let root_log2 = self.shape.root_log2();
        let root_tiles = self.root_tiles.iter().filter(|tile| tile.active).map(move |tile| ActiveTile {
            origin: tile.origin,
            log2_voxels: root_log2,
            value: tile.value,
        });
        let of_node = |(branching, node)| active_tiles_of::<V>(branching, node);
        root_tiles.chain(self.inner_nodes().flat_map(of_node))
    }

    /// FNV-1a hash over origin (three little-endian i32) and mask (a bit per voxel) of every leaf, in leaf order.
    pub fn topology_hash(&self) -> u64 {
        let mut hash = Fnv1a::default();
        for leaf in self.leaf_order() {
            self.leaves.origins[leaf].iter().for_each(|c| hash.add(&c.to_le_bytes()));
            self.leaves.mask(leaf).iter().for_each(|word| hash.add(&word.to_le_bytes()));
        }
        hash.0
    }

    /// FNV-1a hash over all values of every leaf as a file spells them uncompressed, in leaf order. Of a mask
    /// grid, whose leaves have no values beside their mask, the hash of nothing.
    pub fn leaf_value_hash(&self) -> u64 {
        let mut hash = Fnv1a::default();
        let mut bytes = Vec::new();
        for leaf in self.leaf_order() {
            bytes.clear();
            match V::leaf(self.leaves.stored(leaf)) {
                LeafValues::Plain(values) => V::encode(values, false, &mut bytes),
                LeafValues::Bits(words) => {
                    bytes.extend((0..self.leaves.leaf_voxels).map(|i| (words[i / 64] >> (i % 64)) as u8 & 1));
                }
                LeafValues::Mask => {}
            }
            hash.add(&bytes);
        }
        hash.0
    }
}

/// 64-bit FNV-1a.
pub(crate) struct Fnv1a(pub(crate) u64);

impl Default for Fnv1a {
    fn default() -> Self {
        Fnv1a(0xcbf2_9ce4_8422_2325)
    }
}

impl Fnv1a {
    pub(crate) fn add(&mut self, bytes: &[u8]) {
        for byte in bytes {
            self.0 = (self.0 ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
        }
    }
}

pub(crate) fn grow(bbox: &mut Option<IndexBox>, min: [i32; 3], max: [i32; 3]) {
    let [low, high] = bbox.get_or_insert([min, max]);
    for axis in 0..3 {
        low[axis] = low[axis].min(min[axis]);
        high[axis] = high[axis].max(max[axis]);
    }
}

/// An active region of one value.
struct ActiveTile<V> {
    origin: [i32; 3],
    log2_voxels: u32,
    value: V,
}

fn active_tiles_of<V: Value>(
    branching: crate::tree::Branching,
    node: &InternalNode<V>,
) -> impl Iterator<Item = ActiveTile<V>> + '_ {
    let slots = node.value_mask.iter().filter(|slot| !node.child_mask.contains(*slot));
    slots.map(move |slot| ActiveTile {
        origin: branching.child_origin(node.origin, slot),
        log2_voxels: branching.log2_child_voxels,
        value: node.tiles.value(slot),
    })
}

/// Extremes and sums of the values that are numbers, and how many are not.
struct Seen {
    components: Vec<ComponentStatistics>,
    nan_count: u64,
}

impl Seen {
    fn new(components: usize) -> Self {
        let nothing =
            ComponentStatistics { min: f64::INFINITY, max: f64::NEG_INFINITY, sum: 0.0, sum_of_squares: 0.0 };
        Seen { components: vec![nothing; components], nan_count: 0 }
    }

    fn value<V: Value>(&mut self, value: V, voxels: u64) {
        let mut has_nan = false;
        for (i, seen) in self.components.iter_mut().enumerate() {
            let x = value.component(i);
            if x.is_nan() {
                has_nan = true;
                continue;
            }
            seen.min = seen.min.min(x);
            seen.max = seen.max.max(x);
            seen.sum += x * voxels as f64;
            seen.sum_of_squares += x * x * voxels as f64;
        }
        self.nan_count += u64::from(has_nan);
    }
}

/// Takes in the active voxels of a leaf.
pub(crate) fn grow_to_leaf(bbox: &mut Option<IndexBox>, origin: [i32; 3], mask: &[u64], log2: u32) {
    let mut local: Option<IndexBox> = None;
    if log2 == 3 {
        // One word is a slab of constant x; its bytes are rows of constant y.
        let slab = mask.iter().fold(0, |all, word| all | word);
        if slab == 0 {
            return;
        }
        let x = (0..8).filter(|x| mask[*x as usize] != 0);
        let y = (0..8).filter(|y| slab >> (8 * y) & 0xff != 0);
        let columns = slab.to_le_bytes().iter().fold(0u8, |all, row| all | row);
        let min =
            [x.clone().min().unwrap_or(0), y.clone().min().unwrap_or(0), columns.trailing_zeros() as i32];
        let max = [x.max().unwrap_or(7), y.max().unwrap_or(7), 7 - columns.leading_zeros() as i32];
        local = Some([min, max]);
    } else {
        for (w, word) in mask.iter().enumerate() {
            for bit in bits(*word) {
                let offset = w * 64 + bit;
                let at = |axis: u32| (offset >> (log2 * (2 - axis)) & ((1 << log2) - 1)) as i32;
                grow(&mut local, [at(0), at(1), at(2)], [at(0), at(1), at(2)]);
            }
        }
    }
    if let Some([min, max]) = local {
        let at = |local: [i32; 3]| std::array::from_fn(|i| origin[i].wrapping_add(local[i]));
        grow(bbox, at(min), at(max));
    }
}
