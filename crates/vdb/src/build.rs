//! Building a tree from leaves and tiles in any order, and from another tree.
//!
//! The builder keeps to what the format can say: a region is a leaf, a tile or background, never two of them.

use crate::error::{Error, Result};
use crate::mask::Mask;
use crate::stats::IndexBox;
use crate::tree::{InternalNode, Leaves, RootTile, Shape, Tiles, Tree};
use crate::value::{LeafValues, Value};

/// Collects leaves and tiles and makes a tree of them.
///
/// ```
/// use nuage_vdb::{Shape, TreeBuilder};
///
/// let mut builder = TreeBuilder::new(0.0_f32, Shape::STANDARD);
/// builder.leaf([8, 0, -8], &[u64::MAX; 8], &[0.5; 512]);
/// builder.tile(2, [16, 0, -8], 1.0, true);
/// let tree = builder.build()?;
/// assert_eq!(tree.voxel([9, 1, -3]).value, 0.5);
/// assert_eq!(tree.voxel([17, 1, -3]).value, 1.0);
/// # Ok::<(), nuage_vdb::Error>(())
/// ```
#[derive(Debug, Clone)]
pub struct TreeBuilder<V: Value> {
    background: V,
    shape: Shape,
    /// In the order in which they came.
    leaves: Leaves<V>,
    tiles: Vec<Tile<V>>,
}

#[derive(Debug, Clone, Copy)]
struct Tile<V> {
    /// 0 at the root, then the levels of inner nodes from 1.
    depth: usize,
    origin: [i32; 3],
    value: V,
    active: bool,
}

/// Where a leaf or a tile stands: its root entry, then its slot in each inner node on the way down.
type Path = ([i32; 3], Vec<u32>);

impl<V: Value> TreeBuilder<V> {
    /// Nothing but background.
    pub fn new(background: V, shape: Shape) -> Self {
        TreeBuilder { background, shape, leaves: Leaves::empty(shape.leaf_voxels()), tiles: Vec::new() }
    }

    /// Adds the leaf that holds an index coordinate.
    ///
    /// # Panics
    /// If the mask or the stored values are not those of one leaf.
    pub fn leaf(&mut self, ijk: [i32; 3], mask: &[u64], stored: &[V::Stored]) {
        let voxels = self.shape.leaf_voxels();
        assert!(mask.len() == voxels.div_ceil(64) && stored.len() == V::stored_per_leaf(voxels));
        self.leaves.origins.push(ijk.map(|c| c & (-1 << self.shape.leaf_log2())));
        self.leaves.masks.extend_from_slice(mask);
        self.leaves.values.extend_from_slice(stored);
    }

    /// Adds a tile: one value for the region at `depth` that holds an index coordinate, 0 for a region of the
    /// root, 1 for a child of its children, and so on, as in [`crate::Voxel`].
    ///
    /// # Panics
    /// If tiles of that depth do not exist in the shape.
    pub fn tile(&mut self, depth: usize, ijk: [i32; 3], value: V, active: bool) {
        let log2 = match depth {
            0 => self.shape.root_log2(),
            _ => self.shape.branching(depth - 1).log2_child_voxels,
        };
        self.tiles.push(Tile { depth, origin: ijk.map(|c| c & (-1 << log2)), value, active });
    }

    /// The tree. The order in which leaves and tiles came makes no difference.
    ///
    /// # Errors
    /// [`Error::Misuse`] if two of them overlap.
    pub fn build(self) -> Result<Tree<V>> {
        let TreeBuilder { background, shape, leaves, tiles } = self;
        let inner = shape.inner_levels();
        let path = |origin: [i32; 3], depth: usize| -> Path {
            let slots = (0..depth).map(|i| shape.branching(i).slot(origin) as u32).collect();
            (shape.root_origin(origin), slots)
        };
        let mut leaf_paths: Vec<(Path, usize)> =
            leaves.origins.iter().enumerate().map(|(i, origin)| (path(*origin, inner), i)).collect();
        leaf_paths.sort_unstable();
        let mut tile_paths: Vec<(Path, Tile<V>)> =
            tiles.into_iter().map(|tile| (path(tile.origin, tile.depth), tile)).collect();
        tile_paths.sort_by(|a, b| a.0.cmp(&b.0));
        let overlap = |origin| Error::Misuse(format!("two leaves or tiles overlap at {origin:?}"));
        if let Some(pair) = leaf_paths.windows(2).find(|pair| pair[0].0 == pair[1].0) {
            return Err(overlap(leaves.origins[pair[0].1]));
        }

        // The paths of all nodes of each level: prefixes of the paths of what is below.
        let mut node_paths: Vec<Vec<Path>> = vec![Vec::new(); inner];
        for (level, paths) in node_paths.iter_mut().enumerate() {
            let cut = |(root, slots): &Path| (*root, slots[..level].to_vec());
            let mut add = |path: Path| {
                if paths.last() != Some(&path) {
                    paths.push(path);
                }
            };
            leaf_paths.iter().for_each(|(path, _)| add(cut(path)));
            tile_paths.iter().filter(|(_, tile)| tile.depth > level).for_each(|(path, _)| add(cut(path)));
            paths.sort_unstable();
            paths.dedup();
        }

        let mut levels: Vec<Vec<InternalNode<V>>> = Vec::with_capacity(inner);
        for level in 0..inner {
            let branching = shape.branching(level);
            let (slots, words) = (branching.slots(), branching.slots().div_ceil(64));
            let child_paths: Vec<&Path> = match node_paths.get(level + 1) {
                Some(paths) => paths.iter().collect(),
                None => leaf_paths.iter().map(|(path, _)| path).collect(),
            };
            let level_tiles: Vec<&(Path, Tile<V>)> =
                tile_paths.iter().filter(|(_, tile)| tile.depth == level + 1).collect();
            let (mut next_child, mut next_tile) = (0, 0);
            let mut nodes = Vec::with_capacity(node_paths[level].len());
            for (root, prefix) in &node_paths[level] {
                let origin = (0..level)
                    .fold(*root, |origin, i| shape.branching(i).child_origin(origin, prefix[i] as usize));
                let is_below =
                    |path: &Path| path.0 == *root && path.1[..level.min(path.1.len())] == prefix[..];
                let (mut child_mask, mut value_mask) = (vec![0u64; words], vec![0u64; words]);
                let mut values = vec![background; slots];
                let first_child = next_child;
                while child_paths.get(next_child).is_some_and(|path| is_below(path)) {
                    let slot = child_paths[next_child].1[level] as usize;
                    child_mask[slot / 64] |= 1 << (slot % 64);
                    next_child += 1;
                }
                while let Some((path, tile)) = level_tiles.get(next_tile).filter(|(path, _)| is_below(path)) {
                    let slot = path.1[level] as usize;
                    let is_again = next_tile > 0 && level_tiles[next_tile - 1].0 == *path;
                    if is_again || child_mask[slot / 64] >> (slot % 64) & 1 == 1 {
                        return Err(overlap(tile.origin));
                    }
                    values[slot] = tile.value;
                    value_mask[slot / 64] |= u64::from(tile.active) << (slot % 64);
                    next_tile += 1;
                }
                let child_mask = Mask::new(child_mask.into(), slots);
                let tiles = Tiles::pack(&values, &child_mask, background);
                let value_mask = Mask::new(value_mask.into(), slots);
                nodes.push(InternalNode { origin, child_mask, value_mask, tiles, first_child });
            }
            levels.push(nodes);
        }

        let root_tiles: Vec<RootTile<V>> = tile_paths
            .iter()
            .filter(|(_, tile)| tile.depth == 0)
            .map(|(_, Tile { origin, value, active, .. })| RootTile {
                origin: *origin,
                value: *value,
                active: *active,
            })
            .collect();
        let is_root_child = |origin: &[i32; 3]| match levels.first() {
            Some(nodes) => nodes.binary_search_by_key(origin, |node| node.origin).is_ok(),
            None => leaf_paths.binary_search_by_key(origin, |(path, _)| path.0).is_ok(),
        };
        let is_twice = |i: usize| i > 0 && root_tiles[i - 1].origin == root_tiles[i].origin;
        if let Some((_, tile)) =
            root_tiles.iter().enumerate().find(|(i, tile)| is_twice(*i) || is_root_child(&tile.origin))
        {
            return Err(overlap(tile.origin));
        }

        let mut sorted = Leaves::empty(shape.leaf_voxels());
        if leaf_paths.iter().enumerate().all(|(i, (_, leaf))| i == *leaf) {
            sorted = leaves;
        } else {
            sorted.origins = leaf_paths.iter().map(|(_, i)| leaves.origins[*i]).collect();
            sorted.masks.reserve_exact(leaves.masks.len());
            sorted.values.reserve_exact(leaves.values.len());
            for (_, i) in &leaf_paths {
                sorted.masks.extend_from_slice(leaves.mask(*i));
                sorted.values.extend_from_slice(leaves.stored(*i));
            }
        }
        Ok(Tree { background, shape, root_tiles, levels, leaves: sorted })
    }
}

impl<V: Value> Tree<V> {
    /// The same tree with other values.
    pub fn map<W: Value>(&self, convert: impl Fn(V) -> W) -> Tree<W> {
        let tiles = |tiles: &Tiles<V>| match tiles {
            Tiles::Uniform(value) => Tiles::Uniform(convert(*value)),
            Tiles::PerSlot(values) => Tiles::PerSlot(values.iter().map(|v| convert(*v)).collect()),
        };
        let node = |node: &InternalNode<V>| InternalNode {
            origin: node.origin,
            child_mask: node.child_mask.clone(),
            value_mask: node.value_mask.clone(),
            tiles: tiles(&node.tiles),
            first_child: node.first_child,
        };
        let voxels = self.leaves.leaf_voxels;
        let per_leaf = W::stored_per_leaf(voxels);
        let mut values = vec![W::Stored::default(); self.leaves.len() * per_leaf];
        for (i, stored) in values.chunks_mut(per_leaf.max(1)).enumerate() {
            match W::leaf_mut(stored) {
                LeafValues::Plain(out) => {
                    for (offset, value) in out.iter_mut().enumerate() {
                        *value = convert(self.leaves.value(i, offset));
                    }
                }
                LeafValues::Bits(words) => {
                    for offset in 0..voxels {
                        let on = convert(self.leaves.value(i, offset)).component(0) != 0.0;
                        words[offset / 64] |= u64::from(on) << (offset % 64);
                    }
                }
                LeafValues::Mask => {}
            }
        }
        Tree {
            background: convert(self.background),
            shape: self.shape,
            root_tiles: self
                .root_tiles
                .iter()
                .map(|t| RootTile { origin: t.origin, value: convert(t.value), active: t.active })
                .collect(),
            levels: self.levels.iter().map(|nodes| nodes.iter().map(node).collect()).collect(),
            leaves: Leaves {
                leaf_voxels: voxels,
                origins: self.leaves.origins.clone(),
                masks: self.leaves.masks.clone(),
                values,
            },
        }
    }

    /// The tree with everything outside a box `[min, max]` turned to inactive background, as OpenVDB's `clip`
    /// does it: tiles that the box cuts are taken apart.
    ///
    /// # Errors
    /// [`Error::Limit`] if taking tiles apart would take more than `max_memory_bytes`.
    pub fn clip(&self, bbox: IndexBox, max_memory_bytes: u64) -> Result<Tree<V>> {
        let leaves = (0..self.leaves.len()).map(|i| (i, self.leaves.stored(i)));
        clip_parts(self, leaves, bbox, max_memory_bytes)
    }
}

/// Clips a tree of which only some leaves are known, by number and stored values; the others lie outside the box.
pub(crate) fn clip_parts<'a, V: Value>(
    tree: &Tree<V>,
    leaves: impl Iterator<Item = (usize, &'a [V::Stored])>,
    bbox: IndexBox,
    max_memory_bytes: u64,
) -> Result<Tree<V>> {
    let builder = TreeBuilder::new(tree.background, tree.shape);
    let mut clipper = Clipper { bbox, builder, limit_bytes: max_memory_bytes, left_bytes: max_memory_bytes };
    for tile in &tree.root_tiles {
        clipper.tile(0, tile.origin, tile.value, tile.active)?;
    }
    for (i, nodes) in tree.levels.iter().enumerate() {
        let branching = tree.shape.branching(i);
        for node in nodes {
            for (slot, value, active) in node.tile_slots() {
                if active || !value.same_bits(tree.background) {
                    clipper.tile(i + 1, branching.child_origin(node.origin, slot), value, active)?;
                }
            }
        }
    }
    for (i, stored) in leaves {
        clipper.leaf(tree.leaves.origins[i], tree.leaves.mask(i), stored);
    }
    clipper.builder.build()
}

/// How a region lies to the box.
#[derive(PartialEq)]
enum Overlap {
    None,
    Part,
    Whole,
}

struct Clipper<V: Value> {
    bbox: IndexBox,
    builder: TreeBuilder<V>,
    limit_bytes: u64,
    /// Bytes that may still be taken.
    left_bytes: u64,
}

impl<V: Value> Clipper<V> {
    fn overlap(&self, origin: [i32; 3], log2: u32) -> Overlap {
        let [min, max] = self.bbox;
        let last = origin.map(|c| i64::from(c) + (1 << log2) - 1);
        let touches = (0..3).all(|i| i64::from(min[i]) <= last[i] && origin[i] <= max[i]);
        let covers = (0..3).all(|i| min[i] <= origin[i] && last[i] <= i64::from(max[i]));
        match (touches, covers) {
            (false, _) => Overlap::None,
            (true, false) => Overlap::Part,
            (true, true) => Overlap::Whole,
        }
    }

    fn take(&mut self, bytes: usize) -> Result<()> {
        let left = self.left_bytes.checked_sub(bytes as u64).ok_or_else(|| Error::Limit {
            what: "taking tiles apart at the border of the box".into(),
            needed_bytes: self.limit_bytes.saturating_add(bytes as u64),
            limit_bytes: self.limit_bytes,
        })?;
        self.left_bytes = left;
        Ok(())
    }

    fn tile(&mut self, depth: usize, origin: [i32; 3], value: V, active: bool) -> Result<()> {
        let shape = self.builder.shape;
        let log2 = match depth {
            0 => shape.root_log2(),
            _ => shape.branching(depth - 1).log2_child_voxels,
        };
        match self.overlap(origin, log2) {
            Overlap::None => Ok(()),
            Overlap::Whole => {
                self.take(2 * size_of::<Tile<V>>())?;
                self.builder.tile(depth, origin, value, active);
                Ok(())
            }
            Overlap::Part if depth < shape.inner_levels() => {
                let branching = shape.branching(depth);
                self.take(branching.slots() * size_of::<V>())?;
                (0..branching.slots()).try_for_each(|slot| {
                    self.tile(depth + 1, branching.child_origin(origin, slot), value, active)
                })
            }
            Overlap::Part => {
                let voxels = shape.leaf_voxels();
                let per_leaf = V::stored_per_leaf(voxels);
                self.take(2 * (per_leaf * size_of::<V::Stored>() + voxels.div_ceil(64) * 8 + 12))?;
                let mut stored = vec![V::Stored::default(); per_leaf];
                match V::leaf_mut(&mut stored) {
                    LeafValues::Plain(values) => values.fill(value),
                    LeafValues::Bits(words) => words.fill(if value == V::from_bytes(&[1]) { !0 } else { 0 }),
                    LeafValues::Mask => {}
                }
                let mask = vec![if active { !0 } else { 0 }; voxels.div_ceil(64)];
                self.leaf(origin, &mask, &stored);
                Ok(())
            }
        }
    }

    fn leaf(&mut self, origin: [i32; 3], mask: &[u64], stored: &[V::Stored]) {
        let shape = self.builder.shape;
        match self.overlap(origin, shape.leaf_log2()) {
            Overlap::None => {}
            Overlap::Whole => self.builder.leaf(origin, mask, stored),
            Overlap::Part => {
                let log2 = shape.leaf_log2();
                let [min, max] = self.bbox;
                let inside = |offset: usize| {
                    (0..3).all(|axis| {
                        let local = offset >> (log2 * (2 - axis as u32)) & ((1 << log2) - 1);
                        (min[axis]..=max[axis]).contains(&origin[axis].wrapping_add(local as i32))
                    })
                };
                let (mut mask, mut stored) = (mask.to_vec(), stored.to_vec());
                let outside = (0..shape.leaf_voxels()).filter(|offset| !inside(*offset));
                let background = self.builder.background;
                for offset in outside {
                    mask[offset / 64] &= !(1 << (offset % 64));
                    match V::leaf_mut(&mut stored) {
                        LeafValues::Plain(values) => values[offset] = background,
                        LeafValues::Bits(words) => {
                            words[offset / 64] &= !(1 << (offset % 64));
                            let on = background.component(0) != 0.0;
                            words[offset / 64] |= u64::from(on) << (offset % 64);
                        }
                        LeafValues::Mask => {}
                    }
                }
                self.builder.leaf(origin, &mask, &stored);
            }
        }
    }
}
