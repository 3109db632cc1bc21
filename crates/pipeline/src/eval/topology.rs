//! Trees of any node sizes over the same bricks: how many nodes and bytes they take, and how many cells a ray visits.
//!
//! A tree is named by the log2 widths of its levels from the root's children down to its bricks: 5-4-3 is OpenVDB's and
//! ours. Bytes are counted in two ways. *Packed*, as [`nuage_volume::packed`] lays trees out: only what is present is
//! there. *Unpacked*, as the thesis does: below a node that is not empty all its children are allocated, each an index
//! and a mask. What does not live here: values, bounds, tiles.

use std::collections::HashSet;

use glam::{DVec3, IVec3};
use nuage_volume::packed::{Entry, Node, RootCell, mask};
use nuage_volume::space::LOG2_BRICK;

/// The most voxels along an edge of a cell of the root, as a power of two.
const MAX_LOG2_ROOT: u32 = 30;
/// The widest node, as a power of two: its mask takes 16 MiB.
const MAX_LOG2_WIDTH: u32 = 9;

/// 32 slots of a node.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
struct MaskWord {
    bits: u32,
    /// The index of the child in the first slot that is set.
    first_child: u32,
}

/// One level of nodes.
#[derive(Debug, Clone, PartialEq)]
struct Level {
    log2_width: u32,
    /// log2 of the voxels along an edge of a child.
    log2_child: u32,
    nodes: usize,
    children: usize,
    /// `words_per_node` of each node.
    words: Vec<MaskWord>,
    words_per_node: usize,
}

/// A tree without values.
#[derive(Debug, Clone, PartialEq)]
pub struct Topology {
    /// What is taken off voxel coordinates: a multiple of 128, so that the tree begins in a corner of the root.
    offset: IVec3,
    /// The bricks' box in voxels, the offset taken off: first coordinates, and those after the last.
    voxels: [IVec3; 2],
    /// The cells of the root, sorted.
    cells: Vec<[i32; 3]>,
    levels: Vec<Level>,
    log2_brick: u32,
    bricks: usize,
}

/// Whether equal masks stand once and are named by an index, or each node has its own.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Masks {
    /// Each node has its own.
    Own,
    /// Equal masks stand once.
    Shared,
}

/// A level of nodes of which all are allocated below a parent that is not empty.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Unpacked {
    /// Nodes, empty ones included.
    pub nodes: u64,
    /// The bytes of the mask of a node.
    pub mask_bytes: u64,
    /// How many different masks there are.
    pub unique_masks: u64,
}

impl Unpacked {
    /// The bytes of the level: each node an index and its mask; or two indices, and each mask once (section 6.2).
    pub fn bytes(self, masks: Masks) -> u64 {
        match masks {
            Masks::Own => self.nodes * (4 + self.mask_bytes),
            Masks::Shared => self.nodes * 8 + self.unique_masks * self.mask_bytes,
        }
    }
}

/// What a ray visits.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Visits {
    /// Cells of any level that the ray passes through, from those of the root down to bricks.
    pub cells: u64,
    /// Those of them that are bricks.
    pub bricks: u64,
}

impl Topology {
    /// The tree over bricks of 8³ voxels at these brick coordinates. Where its own bricks are larger, each holds all of
    /// those in it.
    ///
    /// `None` for widths that are no tree of nodes over bricks: fewer than two, bricks smaller than 8³, nodes narrower
    /// than 2³ or wider than 512³, or more than 2³⁰ voxels along a cell of the root; and for bricks outside of 32-bit voxel
    /// coordinates or further apart than 2³⁰ voxels.
    pub fn new(bricks: &[IVec3], log2_widths: &[u32]) -> Option<Topology> {
        let [inner @ .., log2_brick] = log2_widths else { return None };
        let is_width = |log2: &u32| (1..=MAX_LOG2_WIDTH).contains(log2);
        let log2_root = log2_widths.iter().try_fold(0_u32, |sum, log2| sum.checked_add(*log2))?;
        let is_tree = !inner.is_empty() && inner.iter().all(is_width) && *log2_brick >= LOG2_BRICK;
        let end = 1 << (31 - LOG2_BRICK);
        let is_inside = |brick: &IVec3| brick.min_element() >= -end && brick.max_element() < end;
        if !is_tree || log2_root > MAX_LOG2_ROOT || !bricks.iter().all(is_inside) {
            return None;
        }
        let first = bricks.iter().copied().reduce(IVec3::min).unwrap_or_default();
        let last = bricks.iter().copied().reduce(IVec3::max).unwrap_or_default();
        // Without it, a volume about the origin would stand in eight cells of the root.
        let offset: IVec3 = first & !15;
        let to_voxels = |brick: IVec3| (brick - offset) << LOG2_BRICK;
        if (last - offset).max_element() >= 1 << (MAX_LOG2_ROOT - LOG2_BRICK) {
            return None;
        }
        let mut paths: Vec<([i32; 3], u128)> = bricks
            .iter()
            .map(|brick| {
                let voxel = to_voxels(*brick);
                let mut log2_cell = log2_root;
                let path = inner.iter().fold(0_u128, |path, log2| {
                    log2_cell -= log2;
                    let local = (voxel >> log2_cell as i32) & ((1 << log2) - 1);
                    let slot = (local.x << (2 * log2) | local.y << log2 | local.z) as u128;
                    path << (3 * log2) | slot
                });
                ((voxel >> log2_root as i32).to_array(), path)
            })
            .collect();
        paths.sort_unstable();
        paths.dedup();
        let brick_count = paths.len();

        let mut levels = Vec::new();
        let mut log2_child = *log2_brick;
        for log2_width in inner.iter().rev() {
            let (level, parents) = level_above(&paths, *log2_width, log2_child);
            levels.push(level);
            paths = parents;
            log2_child += log2_width;
        }
        levels.reverse();
        let voxels = match bricks.is_empty() {
            true => [IVec3::ZERO; 2],
            false => [to_voxels(first), to_voxels(last) + (1 << LOG2_BRICK)],
        };
        let cells = paths.into_iter().map(|(cell, _)| cell).collect();
        Some(Topology {
            offset: offset << LOG2_BRICK,
            voxels,
            cells,
            levels,
            log2_brick: *log2_brick,
            bricks: brick_count,
        })
    }

    /// How many nodes each level has, the root's children first.
    pub fn nodes(&self) -> Vec<usize> {
        self.levels.iter().map(|level| level.nodes).collect()
    }

    /// How many bricks there are, of the size that the tree has.
    pub fn bricks(&self) -> usize {
        self.bricks
    }

    /// The voxels of all bricks.
    pub fn voxels(&self) -> u64 {
        (self.bricks as u64) << (3 * self.log2_brick)
    }

    /// Entries of all nodes: children and bricks.
    pub fn entries(&self) -> usize {
        self.levels.iter().map(|level| level.children).sum()
    }

    /// The bytes of the packed tree: cells of the root, nodes, entries and masks.
    ///
    /// Masks of 1024 slots or more are as [`mask`] says, smaller ones plain: their words, and before words other than
    /// the first how many bits are set below, in 16 bits.
    pub fn packed_bytes(&self, masks: Masks) -> usize {
        let mut unique = HashSet::new();
        let mut mask_words = 0;
        for level in &self.levels {
            for node in level.words.chunks(level.words_per_node) {
                let bits: Vec<u32> = node.iter().map(|word| word.bits).collect();
                let words = match bits.len() {
                    1 => bits,
                    count if count < 32 => {
                        let before = (0..count).scan(0, |sum, i| {
                            let before = *sum;
                            *sum += bits[i].count_ones();
                            Some(before)
                        });
                        let before: Vec<u32> = before.collect();
                        let halves = before.chunks(2).map(|pair| pair[0] | pair.get(1).unwrap_or(&0) << 16);
                        bits.iter().copied().chain(halves).collect()
                    }
                    _ => mask::encode(&bits),
                };
                let count = words.len();
                if masks == Masks::Own || unique.insert((level.log2_width, words)) {
                    mask_words += count;
                }
            }
        }
        let nodes: usize = self.nodes().iter().sum();
        self.cells.len() * size_of::<RootCell>()
            + nodes * size_of::<Node>()
            + self.entries() * size_of::<Entry>()
            + mask_words * 4
    }

    /// The levels of the unpacked tree, the root's children first and last the bricks, whose masks tell which of their
    /// voxels are stored. `brick_masks` is how many different ones of these there are.
    pub fn unpacked(&self, brick_masks: u64) -> Vec<Unpacked> {
        let mut allocated = self.cells.len() as u64;
        let mut unpacked = Vec::new();
        for level in &self.levels {
            let bits = |node: &[MaskWord]| node.iter().map(|word| word.bits).collect::<Vec<u32>>();
            let unique: HashSet<Vec<u32>> = level.words.chunks(level.words_per_node).map(bits).collect();
            let has_empty = allocated > level.nodes as u64;
            unpacked.push(Unpacked {
                nodes: allocated,
                mask_bytes: 4 * level.words_per_node as u64,
                unique_masks: unique.len() as u64 + u64::from(has_empty),
            });
            allocated = (level.nodes as u64) << (3 * level.log2_width);
        }
        let has_empty = allocated > self.bricks as u64;
        unpacked.push(Unpacked {
            nodes: allocated,
            mask_bytes: (1_u64 << (3 * self.log2_brick)).div_ceil(32) * 4,
            unique_masks: brick_masks + u64::from(has_empty),
        });
        unpacked
    }

    /// The cells that a ray through index space visits inside the box of all bricks: in each node the cells along the ray
    /// one after the other, and in those that have a child the cells of the child in turn.
    pub fn visits(&self, origin_index: DVec3, direction_index: DVec3) -> Visits {
        let origin = origin_index - self.offset.as_dvec3();
        let ray = Ray { origin, direction: direction_index };
        let mut visits = Visits::default();
        let Some([t0, t1]) = ray.interval(self.voxels[0], self.voxels[1]) else { return visits };
        let log2_cell = self.levels.iter().map(|level| level.log2_width).sum::<u32>() + self.log2_brick;
        let ends = [self.voxels[0], self.voxels[1] - 1].map(|voxel| voxel >> log2_cell as i32);
        ray.cells(IVec3::ZERO, ends, log2_cell, [t0, t1], &mut |cell, span| {
            visits.cells += 1;
            if let Ok(node) = self.cells.binary_search(&cell.to_array()) {
                self.visit(0, node, cell << log2_cell as i32, &ray, span, &mut visits);
            }
        });
        visits
    }

    fn visit(&self, depth: usize, node: usize, first: IVec3, ray: &Ray, span: [f64; 2], visits: &mut Visits) {
        let Some(level) = self.levels.get(depth) else {
            visits.bricks += 1;
            return;
        };
        let log2 = level.log2_width;
        let words = &level.words[node * level.words_per_node..][..level.words_per_node];
        // The ray enters and leaves at the box, which is in the middle of nodes: rounding must not take it across.
        let to_cell = |voxel: IVec3| (voxel - first) >> level.log2_child as i32;
        let low = to_cell(self.voxels[0]).max(IVec3::ZERO);
        let high = to_cell(self.voxels[1] - 1).min(IVec3::splat((1 << log2) - 1));
        ray.cells(first, [low, high], level.log2_child, span, &mut |cell, span| {
            visits.cells += 1;
            let slot = (cell.x << (2 * log2) | cell.y << log2 | cell.z) as usize;
            let (word, bit) = (words[slot / 32], 1_u32 << (slot % 32));
            if word.bits & bit != 0 {
                let child = word.first_child + (word.bits & (bit - 1)).count_ones();
                let first = first + (cell << level.log2_child as i32);
                self.visit(depth + 1, child as usize, first, ray, span, visits);
            }
        });
    }
}

/// The level of nodes whose children are given, sorted, and the paths of its nodes.
fn level_above(
    children: &[([i32; 3], u128)],
    log2_width: u32,
    log2_child: u32,
) -> (Level, Vec<([i32; 3], u128)>) {
    let words_per_node = (1_usize << (3 * log2_width)).div_ceil(32);
    let mut parents: Vec<([i32; 3], u128)> = Vec::new();
    let mut words: Vec<MaskWord> = Vec::new();
    for (i, (cell, path)) in children.iter().enumerate() {
        let parent = (*cell, path >> (3 * log2_width));
        if parents.last() != Some(&parent) {
            parents.push(parent);
            words.resize(words.len() + words_per_node, MaskWord::default());
        }
        let slot = (path & ((1 << (3 * log2_width)) - 1)) as usize;
        let word = &mut words[(parents.len() - 1) * words_per_node + slot / 32];
        if word.bits == 0 {
            word.first_child = i as u32;
        }
        word.bits |= 1 << (slot % 32);
    }
    let level = Level {
        log2_width,
        log2_child,
        nodes: parents.len(),
        children: children.len(),
        words,
        words_per_node,
    };
    (level, parents)
}

/// A ray in voxels.
struct Ray {
    origin: DVec3,
    direction: DVec3,
}

impl Ray {
    /// Where the ray is inside a box of voxels, at t = 0 or later.
    fn interval(&self, first: IVec3, end: IVec3) -> Option<[f64; 2]> {
        let mut span = [0.0_f64, f64::INFINITY];
        for axis in 0..3 {
            let (origin, direction) = (self.origin[axis], self.direction[axis]);
            let [a, b] = [first[axis], end[axis]].map(f64::from);
            if direction == 0.0 {
                if origin < a || origin >= b {
                    return None;
                }
                continue;
            }
            let (ta, tb) = ((a - origin) / direction, (b - origin) / direction);
            span = [span[0].max(ta.min(tb)), span[1].min(ta.max(tb))];
        }
        (span[0] < span[1] && span[1] < f64::INFINITY).then_some(span)
    }

    /// Steps from cell to cell, of `1 << log2_cell` voxels from `first` on, between two cells and two distances. `visit`
    /// is told each cell, and the distances at which the ray is inside (Amanatides and Woo, 1987).
    fn cells(
        &self,
        first: IVec3,
        [low, high]: [IVec3; 2],
        log2_cell: u32,
        [t0, t1]: [f64; 2],
        visit: &mut dyn FnMut(IVec3, [f64; 2]),
    ) {
        let size = f64::from(1 << log2_cell);
        let local = (self.origin + self.direction * t0 - first.as_dvec3()) / size;
        // What rounding puts outside belongs to the cell at the border.
        let mut cell = local.floor().as_ivec3().clamp(low, high);
        let exit = |cell: IVec3, axis: usize| {
            let (origin, direction) = (self.origin[axis], self.direction[axis]);
            if direction == 0.0 {
                return f64::INFINITY;
            }
            let plane = cell[axis] + i32::from(direction > 0.0);
            ((f64::from(first[axis]) + f64::from(plane) * size) - origin) / direction
        };
        let mut exits = [exit(cell, 0), exit(cell, 1), exit(cell, 2)];
        let mut t = t0;
        loop {
            let axis = (1..3).fold(0, |best, axis| if exits[axis] < exits[best] { axis } else { best });
            let end = exits[axis].min(t1).max(t);
            visit(cell, [t, end]);
            if exits[axis] >= t1 {
                break;
            }
            cell[axis] += if self.direction[axis] > 0.0 { 1 } else { -1 };
            if cell[axis] < low[axis] || cell[axis] > high[axis] {
                break;
            }
            t = end;
            exits[axis] = exit(cell, axis);
        }
    }
}

#[cfg(test)]
mod tests;
