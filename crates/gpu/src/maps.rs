//! Flat maps of bricks: for each brick of a field's box its entry, or how far around it nothing is. A look-up in one takes two
//! words where the tree takes some twenty, and rays leap over what is empty (Cohen & Sheffer, "Proximity Clouds – an Acceleration
//! Technique for 3D Grid Traversal", 1994).
//!
//! Maps stand behind the trees in the same buffer; volumes so sparse that maps would be large beside the rest do without
//! ([`are_worth`]).
//! What does not live here: the maps of the CPU (`nuage_render::walk`), and the walk (`shader/walk.wgsl`).

use glam::IVec3;
use nuage_volume::packed::{Content, Entry, Trees, mask};
use nuage_volume::space::{LOG2_NODE4_BRICKS, LOG2_NODE5_BRICKS, NODE4_SLOTS, NODE5_SLOTS};

/// The words of a cell: the kind of its entry, then the payload.
pub(crate) const CELL_WORDS: usize = 2;
/// The tag of a cell without an entry; above it stands the distance to the nearest that has one, in bricks along the axis of the
/// greatest difference.
pub(crate) const ABSENT_TAG: u32 = 254;
/// The tags of cells in tiles of the size of a `Node4` and of a `Node5`, which hold the tile's value.
pub(crate) const TILE_TAGS: [u32; 2] = [252, 253];

/// The furthest that is told.
pub(crate) const FURTHEST: u32 = 255;

/// Maps take at most this part of the bytes of trees and bricks: a look-up is then worth its memory, …
const SHARE: usize = 8;
/// … or so many bytes, which no device misses, …
const SMALL_BYTES: usize = 4 << 20;
/// … and with trees no more than any device binds.
const MOST_TREE_BYTES: usize = 128 << 20;

/// The bytes of a `Node5`, a `Node4` and a brick of floats where nodes have a slot for each child: those of NanoVDB
/// (`PNanoVDB.h`, version 32).
const FLAT_BYTES: [usize; 3] = [270_400, 33_856, 2_144];

/// The most that maps may bring a volume to: a twentieth more than flat nodes and floats take, and half of that where bricks are
/// packed. Few voxels far apart would have maps many times as large as themselves.
pub(crate) fn most_bytes(nodes_and_bricks: [usize; 3], are_packed: bool) -> usize {
    let flat: usize = nodes_and_bricks.iter().zip(FLAT_BYTES).map(|(count, bytes)| count * bytes).sum();
    if are_packed { flat / 2 } else { flat / 20 * 21 }
}

/// Whether maps of so many bytes are worth it beside trees and bricks.
pub(crate) fn are_worth(maps: usize, trees: usize, bricks: usize, most: usize) -> bool {
    let is_little = maps <= SMALL_BYTES.max((trees + bricks) / SHARE);
    is_little && trees + maps <= MOST_TREE_BYTES && trees + bricks + maps <= most
}

/// The most cells in all: what single precision counts, and a binding of the default size holds.
const MOST_CELLS: i64 = 1 << 24;
/// The most cells along an axis: four million voxels, which single precision tells apart.
const MOST_ALONG: i64 = 1 << 19;

/// How many cells a map of the bricks from `first` to `last` has, with a layer of absent ones all around. `None` if too many.
pub(crate) fn cell_count(first: IVec3, last: IVec3) -> Option<usize> {
    let size = last.as_i64vec3() - first.as_i64vec3() + 3;
    let is_sane = size.min_element() > 0 && size.max_element() <= MOST_ALONG;
    let count = size.x.checked_mul(size.y)?.checked_mul(size.z)?;
    (is_sane && count <= MOST_CELLS).then_some(count as usize)
}

/// Where cells of a box stand.
#[derive(Debug, Clone, Copy)]
struct Layout {
    /// The brick of the first cell, and how many there are along each axis.
    first: IVec3,
    size: IVec3,
}

impl Layout {
    fn at(&self, brick: IVec3) -> usize {
        let local = brick - self.first;
        ((local.x * self.size.y + local.y) * self.size.z + local.z) as usize
    }
}

/// The words of so many cells with nothing anywhere.
pub(crate) fn empty(cells: usize) -> Vec<u32> {
    [ABSENT_TAG | FURTHEST << 8, 0].repeat(cells)
}

/// The words of the map of the bricks from `first` to `last` of the tree of some root cells.
pub(crate) fn map(trees: &Trees, cells: [u32; 2], first: IVec3, last: IVec3) -> Option<Vec<u32>> {
    let count = cell_count(first, last)?;
    let layout = Layout { first: first - 1, size: last - first + 3 };
    let mut words = empty(count);
    // Puts an entry to all bricks of an aligned cube that lie in the box.
    let mut put = |entry: Entry, corner: IVec3, log2_bricks: u32| {
        let kind = match log2_bricks {
            LOG2_NODE4_BRICKS => entry.kind & !0xff | TILE_TAGS[0],
            LOG2_NODE5_BRICKS => entry.kind & !0xff | TILE_TAGS[1],
            _ => entry.kind,
        };
        let low = corner.max(first);
        let high = (corner + ((1 << log2_bricks) - 1)).min(last);
        for x in low.x..=high.x {
            for y in low.y..=high.y {
                for z in low.z..=high.z {
                    let at = CELL_WORDS * layout.at(IVec3::new(x, y, z));
                    words[at..at + CELL_WORDS].copy_from_slice(&[kind, entry.payload]);
                }
            }
        }
    };
    let [first_cell, count] = cells.map(|n| n as usize);
    for cell in trees.cells.get(first_cell..first_cell + count)? {
        let corner5 = IVec3::from_array(cell.cell) << LOG2_NODE5_BRICKS;
        let Some(Content::Node(node5)) = cell.entry.content() else {
            put(cell.entry, corner5, LOG2_NODE5_BRICKS);
            continue;
        };
        let node5 = trees.node5s.get(node5 as usize)?;
        for (at, slot) in (node5.first_entry as usize..).zip(mask::slots(trees, node5.mask, NODE5_SLOTS)) {
            let entry = *trees.entries.get(at)?;
            let corner4 = corner5 + (coordinates(slot, 5) << LOG2_NODE4_BRICKS);
            let Some(Content::Node(node4)) = entry.content() else {
                put(entry, corner4, LOG2_NODE4_BRICKS);
                continue;
            };
            let node4 = trees.node4s.get(node4 as usize)?;
            for (at, slot) in (node4.first_entry as usize..).zip(mask::slots(trees, node4.mask, NODE4_SLOTS))
            {
                put(*trees.entries.get(at)?, corner4 + coordinates(slot, 4), 0);
            }
        }
    }
    tell_distances(&mut words, layout.size);
    Some(words)
}

/// The place of a slot in a node whose side has `1 << log2_side` slots.
fn coordinates(slot: usize, log2_side: u32) -> IVec3 {
    let slot = slot as i32;
    let last = (1 << log2_side) - 1;
    IVec3::new(slot >> (2 * log2_side), slot >> log2_side & last, slot & last)
}

/// Puts into each absent cell how far the nearest that is not absent is, as a king goes on a chessboard: one pass forth and one
/// back, in each of which the neighbours that were passed already are looked at.
fn tell_distances(words: &mut [u32], size: IVec3) {
    let strides = [size.y * size.z, size.z, 1];
    let inner = |axis: usize| 1..size[axis] - 1;
    let before: Vec<i32> = (-1..=1)
        .flat_map(|x| (-1..=1).flat_map(move |y| (-1..=1).map(move |z| IVec3::new(x, y, z))))
        .map(|step| step.dot(IVec3::from_array(strides)))
        .take(13)
        .collect();
    let mut pass = |x: i32, y: i32, z: i32, sign: i32| {
        let at = IVec3::new(x, y, z).dot(IVec3::from_array(strides));
        let distance = |words: &[u32], at: i32| match words[CELL_WORDS * at as usize] {
            absent if absent & 0xff == ABSENT_TAG => absent >> 8,
            _ => 0,
        };
        let here = distance(words, at);
        if here > 0 {
            let nearest =
                before.iter().map(|step| distance(words, at + sign * step)).min().unwrap_or(FURTHEST);
            words[CELL_WORDS * at as usize] = ABSENT_TAG | here.min(nearest + 1) << 8;
        }
    };
    for x in inner(0) {
        for y in inner(1) {
            inner(2).for_each(|z| pass(x, y, z, 1));
        }
    }
    for x in inner(0).rev() {
        for y in inner(1).rev() {
            inner(2).rev().for_each(|z| pass(x, y, z, -1));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The bytes of the map of a box of bricks.
    fn map_bytes(side: i32) -> usize {
        4 * CELL_WORDS * cell_count(IVec3::ZERO, IVec3::splat(side - 1)).expect("few cells")
    }

    #[test]
    fn maps_make_no_volume_larger_than_flat_nodes() {
        // A brick in each of so many places of a box, in bricks of floats and of four bits.
        for (side, bricks) in [(1, 1), (8, 100), (16, 4096), (40, 30_000), (62, 2), (62, 60_000), (100, 20)] {
            let node4s = (side as usize).div_ceil(16).pow(3).min(bricks);
            let counts = [1, node4s, bricks];
            let trees = 8 * bricks + 700 * node4s + 4600;
            let flat = most_bytes(counts, false) * 20 / 21;
            for (brick_bytes, are_packed) in [(2048, false), (260, true)] {
                let (maps, bricks) = (map_bytes(side), brick_bytes * bricks);
                let is_worth = are_worth(maps, trees, bricks, most_bytes(counts, are_packed));
                let total = trees + bricks + maps;
                let is_within = if are_packed { 2 * total <= flat } else { 20 * total <= 21 * flat + 20 };
                assert!(is_within || !is_worth, "{side}: {total} bytes beside {flat}");
                let is_sparse = side > 16 && bricks < 100 * brick_bytes;
                assert_eq!(is_worth, !is_sparse, "{side}: {maps} bytes for {bricks}");
            }
        }
    }
}
