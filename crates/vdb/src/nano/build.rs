//! From a tree to a grid's bytes: where each node goes, what the root, the tree and the grid say of them.
//!
//! Nodes stand breadth first: root, upper nodes, lower nodes, leaves, each level in OpenVDB's order. The
//! bytes of single nodes are made in `encode`.

use flate2::Crc;

use super::encode::{self, Written, put, put_box};
use super::layout::{self, ALIGNMENT, Kind, Layout, round_up};
use super::stats::{NanoValue, NodeStats};
use crate::any::Grid;
use crate::error::{Error, Result};
use crate::stats::IndexBox;
use crate::transform::Matrix4;
use crate::tree::{LEVEL4, LEVEL5, RootTile, Tree};

/// The version that is written.
pub(super) const VERSION: u32 = layout::pack_version([32, 4, 2]);
/// Where the root stands.
pub(super) const ROOT: usize = layout::TREE + layout::TREE_BYTES;

/// How the leaves of a grid are written.
pub(super) struct LeafEncoder<'a, V> {
    /// The bytes that leaf `i` takes.
    pub(super) bytes: &'a dyn Fn(usize) -> usize,
    /// Writes leaf `i`.
    pub(super) encode: &'a (dyn Fn(usize, &mut [u8]) -> NodeStats<V> + Sync),
}

/// The bytes of a grid of the standard shape.
pub(super) fn grid<V: NanoValue>(
    grid: &Grid,
    tree: &Tree<V>,
    kind: Kind,
    leaf: &LeafEncoder<'_, V>,
) -> Result<Vec<u8>> {
    let Layout { root, upper, lower, .. } = Layout::of(kind);
    let [uppers, lowers] = &tree.levels[..] else {
        return Err(Error::unsupported("NanoVDB trees of another shape than the standard one"));
    };
    let lower_order: Vec<usize> = uppers.iter().flat_map(|node| node.children()).collect();
    let leaf_order = tree.leaf_order();

    // Where everything goes.
    let mut end = Some(ROOT);
    let mut place = |bytes: Option<usize>| {
        let begin = end;
        end = begin.and_then(|begin| begin.checked_add(bytes?));
        begin.unwrap_or(usize::MAX)
    };
    let entries = uppers.len() + tree.root_tiles.len();
    let root_bytes = root.tile_bytes.checked_mul(entries).and_then(|bytes| bytes.checked_add(root.bytes));
    place(root_bytes);
    let upper_at = place(uppers.len().checked_mul(upper.bytes));
    let lower_at = place(lower_order.len().checked_mul(lower.bytes));
    let leaf_sizes: Vec<usize> = leaf_order.iter().map(|i| (leaf.bytes)(*i)).collect();
    let leaf_at = place(leaf_sizes.iter().try_fold(0, |sum: usize, bytes| sum.checked_add(*bytes)));
    let is_long_name = grid.name.len() >= layout::SHORT_NAME_BYTES;
    let blind_at = place(Some(match is_long_name {
        true => layout::BLIND_BYTES + round_up(grid.name.len() + 1, ALIGNMENT),
        false => 0,
    }));
    let size = end.ok_or_else(|| Error::unsupported("NanoVDB grids larger than the machine's addresses"))?;
    let mut bytes = vec![0; size];

    // Nodes from the leaves up, since each says something of all below it.
    let leaves = encode_leaves(&leaf_order, &leaf_sizes, leaf, leaf_at, &mut bytes[leaf_at..blind_at]);
    let mut lower_tiles = 0;
    let mut lower_nodes = Vec::with_capacity(lower_order.len());
    let mut children = &leaves[..];
    let out = bytes[lower_at..leaf_at].chunks_exact_mut(lower.bytes);
    for (k, (i, out)) in lower_order.iter().zip(out).enumerate() {
        let (mine, others) = children.split_at(lowers[*i].child_mask.count());
        let (written, tiles) =
            encode::node(&lowers[*i], LEVEL4, &lower, mine, lower_at + k * lower.bytes, out);
        children = others;
        lower_tiles += tiles;
        lower_nodes.push(written);
    }
    let mut upper_tiles = 0;
    let mut upper_nodes = Vec::with_capacity(uppers.len());
    let mut children = &lower_nodes[..];
    let out = bytes[upper_at..lower_at].chunks_exact_mut(upper.bytes);
    for (k, (node, out)) in uppers.iter().zip(out).enumerate() {
        let (mine, others) = children.split_at(node.child_mask.count());
        let (written, tiles) = encode::node(node, LEVEL5, &upper, mine, upper_at + k * upper.bytes, out);
        children = others;
        upper_tiles += tiles;
        upper_nodes.push(written);
    }
    let bbox = put_root(tree, kind, &upper_nodes, &mut bytes[ROOT..upper_at]);

    // The tree.
    let root_tiles = tree.root_tiles.iter().filter(|tile| tile.active).count() as u64;
    let node_counts = [leaves.len(), lower_nodes.len(), upper_nodes.len()];
    for (i, (count, at)) in node_counts.iter().zip([leaf_at, lower_at, upper_at]).enumerate() {
        let offset = if *count > 0 { at - layout::TREE } else { 0 };
        put(&mut bytes, layout::TREE + 8 * i, &(offset as u64).to_le_bytes());
        put(&mut bytes, layout::TREE_NODE_COUNTS + 4 * i, &(*count as u32).to_le_bytes());
    }
    put(&mut bytes, layout::TREE + 24, &((ROOT - layout::TREE) as u64).to_le_bytes());
    for (i, count) in [lower_tiles, upper_tiles, root_tiles].iter().enumerate() {
        put(&mut bytes, layout::TREE_NODE_COUNTS + 12 + 4 * i, &(*count as u32).to_le_bytes());
    }
    let in_leaves: u64 = tree.leaves.masks.iter().map(|word| u64::from(word.count_ones())).sum();
    let active = in_leaves + (lower_tiles << 9) + (upper_tiles << 21) + root_tiles.wrapping_shl(36);
    put(&mut bytes, layout::TREE_VOXEL_COUNT, &active.to_le_bytes());

    put_grid(grid, kind, V::HAS_STATS, bbox, &mut bytes)?;
    if is_long_name {
        put(&mut bytes, layout::GRID_BLIND, &(blind_at as u64).to_le_bytes());
        put(&mut bytes, layout::GRID_BLIND + 8, &1_u32.to_le_bytes());
        let description = &mut bytes[blind_at..];
        put(description, 0, &(layout::BLIND_BYTES as u64).to_le_bytes());
        // As many elements of one byte, which is where later versions have the size of an element.
        put(description, 8, &(grid.name.len() as u64 + 1).to_le_bytes());
        put(description, 16, &1_u32.to_le_bytes());
        put(description, layout::BLIND_CLASS, &layout::BLIND_CLASS_NAME.to_le_bytes());
        put(description, layout::BLIND_BYTES, grid.name.as_bytes());
    }

    // The checksum of everything before the nodes, and none of those: the way to compute that one has changed
    // between versions. Where there are no nodes, later versions cannot tell where to end.
    let mut checksum = u64::MAX;
    if !uppers.is_empty() {
        let mut crc = Crc::new();
        crc.update(&bytes[layout::GRID_VERSION..upper_at]);
        checksum = u64::from(u32::MAX) << 32 | u64::from(crc.sum());
    }
    put(&mut bytes, layout::GRID_CHECKSUM, &checksum.to_le_bytes());
    Ok(bytes)
}

/// Writes the leaves in that order and of those sizes, one behind the other.
fn encode_leaves<V: NanoValue>(
    order: &[usize],
    sizes: &[usize],
    leaf: &LeafEncoder<'_, V>,
    begin: usize,
    mut bytes: &mut [u8],
) -> Vec<Written<V>> {
    let mut at = begin;
    let mut tasks = Vec::with_capacity(order.len());
    for (i, size) in order.iter().zip(sizes) {
        let (mine, others) = bytes.split_at_mut(*size);
        tasks.push((*i, at, mine));
        bytes = others;
        at += size;
    }
    let encode = leaf.encode;
    let write = |(i, at, bytes): (usize, usize, &mut [u8])| Written { at, stats: encode(i, bytes) };
    #[cfg(feature = "parallel")]
    {
        use rayon::prelude::*;
        tasks.into_par_iter().with_min_len(64).map(write).collect()
    }
    #[cfg(not(feature = "parallel"))]
    tasks.into_iter().map(write).collect()
}

/// Writes the root and its tiles to bytes that are zero. Gives the box of all active values.
fn put_root<V: NanoValue>(
    tree: &Tree<V>,
    kind: Kind,
    children: &[Written<V>],
    bytes: &mut [u8],
) -> Option<IndexBox> {
    enum Entry<'a, V> {
        Child(&'a Written<V>),
        Tile(&'a RootTile<V>),
    }
    let places = Layout::of(kind).root;
    let uppers = tree.levels.first().into_iter().flatten();
    let mut entries: Vec<([i32; 3], Entry<'_, V>)> =
        uppers.zip(children).map(|(node, child)| (node.origin, Entry::Child(child))).collect();
    entries.extend(tree.root_tiles.iter().map(|tile| (tile.origin, Entry::Tile(tile))));
    entries.sort_by_key(|(origin, _)| *origin);

    let mut stats = NodeStats::default();
    let mut encoded = Vec::with_capacity(24);
    for ((origin, entry), out) in
        entries.iter().zip(bytes[places.bytes..].chunks_exact_mut(places.tile_bytes))
    {
        // Each coordinate without its lower 12 bits takes 21 bits.
        let key = origin.iter().fold(0, |key: u64, c| key << 21 | u64::from(*c as u32 >> 12));
        put(out, 0, &key.to_le_bytes());
        match entry {
            Entry::Child(child) => {
                put(out, 8, &((child.at - ROOT) as u64).to_le_bytes());
                stats.add(&child.stats);
            }
            Entry::Tile(tile) => {
                encoded.clear();
                tile.value.append_to(&mut encoded);
                put(out, 16, &u32::from(tile.active).to_le_bytes());
                put(out, places.tile_value, &encoded);
                if tile.active {
                    stats.add(&NodeStats::of_tile(tile.value, tile.origin, 12));
                }
            }
        }
    }
    put_box(bytes, 0, stats.bbox.unwrap_or([[i32::MAX; 3], [i32::MIN; 3]]));
    put(bytes, 24, &(entries.len() as u32).to_le_bytes());
    encoded.clear();
    tree.background.append_to(&mut encoded);
    put(bytes, places.background, &encoded);
    if V::HAS_STATS {
        match stats.range {
            Some(_) => stats.write_to(bytes, places.stats),
            None => [places.stats.min, places.stats.max].iter().for_each(|at| put(bytes, *at, &encoded)),
        }
    }
    stats.bbox
}

/// Writes what the grid says of itself, the checksum and blind data left out.
fn put_grid(
    grid: &Grid,
    kind: Kind,
    has_stats: bool,
    bbox: Option<IndexBox>,
    bytes: &mut [u8],
) -> Result<()> {
    let matrix = affine(grid)?;
    let inverse = inverse(matrix).ok_or_else(|| {
        Error::Misuse(format!("the transform of grid '{}' has no inverse, which NanoVDB needs", grid.name))
    })?;
    let mut flags = layout::IS_BREADTH_FIRST;
    if bbox.is_some() {
        flags |= layout::HAS_BBOX;
    }
    if has_stats {
        flags |= layout::HAS_MIN_MAX | layout::HAS_AVERAGE | layout::HAS_DEVIATION;
    }
    if grid.name.len() >= layout::SHORT_NAME_BYTES {
        flags |= layout::HAS_LONG_NAME;
    }
    let size = bytes.len() as u64;
    put(bytes, 0, &layout::MAGIC_OLD.to_le_bytes());
    put(bytes, layout::GRID_VERSION, &VERSION.to_le_bytes());
    put(bytes, layout::GRID_FLAGS, &flags.to_le_bytes());
    put(bytes, layout::GRID_COUNT, &1_u32.to_le_bytes());
    put(bytes, layout::GRID_SIZE, &size.to_le_bytes());
    let short = grid.name.len().min(layout::SHORT_NAME_BYTES - 1);
    put(bytes, layout::GRID_NAME, &grid.name.as_bytes()[..short]);

    // Vectors are columns there and rows here.
    let columns = |m: &Matrix4| -> [f64; 9] { std::array::from_fn(|i| m[i % 3][i / 3]) };
    let translation = [matrix[3][0], matrix[3][1], matrix[3][2]];
    let numbers = columns(matrix).into_iter().chain(columns(&inverse)).chain(translation).chain([1.0]);
    for (i, number) in numbers.enumerate() {
        put(bytes, layout::GRID_MAP_F32 + 4 * i, &(number as f32).to_le_bytes());
        put(bytes, layout::GRID_MAP_F64 + 8 * i, &number.to_le_bytes());
    }
    let world = world_box(grid, bbox);
    for (i, number) in world.as_flattened().iter().chain(&grid.transform.voxel_size()).enumerate() {
        put(bytes, layout::GRID_WORLD_BOX + 8 * i, &number.to_le_bytes());
    }
    let class = layout::CLASSES.iter().find(|(_, name)| *name == grid.grid_class());
    // A class on values that it is not made for would make the grid invalid.
    let class = match (class, kind) {
        (Some((number @ 3, _)), Kind::Vec3f | Kind::Vec3d) => *number,
        (_, Kind::Mask) => layout::CLASS_TOPOLOGY,
        (_, Kind::Int16 | Kind::Int32 | Kind::Int64 | Kind::Bool | Kind::Vec3f | Kind::Vec3d) => 0,
        (Some((number @ (1 | 2), _)), _) => *number,
        _ => 0,
    };
    put(bytes, layout::GRID_CLASS, &class.to_le_bytes());
    put(bytes, layout::GRID_TYPE, &kind.number().to_le_bytes());
    Ok(())
}

/// The matrix of a grid's transform, if it is one that NanoVDB has.
fn affine(grid: &Grid) -> Result<&Matrix4> {
    let matrix =
        grid.transform.matrix().filter(|m| [m[0][3], m[1][3], m[2][3], m[3][3]] == [0.0, 0.0, 0.0, 1.0]);
    matrix.ok_or_else(|| {
        Error::unsupported(format!(
            "the transform of grid '{}', which is not affine, in NanoVDB files",
            grid.name
        ))
    })
}

/// The box of all active values in the world, voxels counted in full from their corner as NanoVDB does; of
/// none the largest box turned inside out.
fn world_box(grid: &Grid, bbox: Option<IndexBox>) -> [[f64; 3]; 2] {
    let [mut low, mut high] = [[f64::MAX; 3], [f64::MIN; 3]];
    let Some([min, max]) = bbox else { return [low, high] };
    for corner in 0..8 {
        let index = std::array::from_fn(|axis| match corner >> axis & 1 {
            0 => f64::from(min[axis]),
            _ => f64::from(max[axis]) + 1.0,
        });
        for (axis, x) in grid.transform.world_from_index(index).into_iter().enumerate() {
            low[axis] = low[axis].min(x);
            high[axis] = high[axis].max(x);
        }
    }
    [low, high]
}

/// The inverse of the linear part of an affine matrix, in its upper left; `None` if there is none.
fn inverse(m: &Matrix4) -> Option<Matrix4> {
    let minor = |row: usize, column: usize| {
        let [r0, r1] = [(row + 1) % 3, (row + 2) % 3];
        let [c0, c1] = [(column + 1) % 3, (column + 2) % 3];
        m[r0][c0] * m[r1][c1] - m[r0][c1] * m[r1][c0]
    };
    let determinant: f64 = (0..3).map(|column| m[0][column] * minor(0, column)).sum();
    let entry = |row: usize, column: usize| match row.max(column) {
        0..3 => minor(column, row) / determinant,
        _ => 0.0,
    };
    let inverse: Matrix4 = std::array::from_fn(|row| std::array::from_fn(|column| entry(row, column)));
    inverse.as_flattened().iter().all(|x| x.is_finite()).then_some(inverse)
}
