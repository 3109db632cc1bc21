//! Building a packed tree from bricks and tiles.
//!
//! The builder collects regions in ordered maps, adds entries for zero regions that touch others, computes
//! every footprint, and flattens the maps into the arrays of [`Tree`].

use std::collections::{BTreeMap, btree_map};
use std::iter::repeat_n;

use glam::IVec3;

use crate::brick::{Bounds, BrickSummary, Bricks};
use crate::space::{
    LOG2_NODE4_BRICKS, LOG2_NODE5_BRICKS, NODE4_SLOTS, NODE5_SLOTS, node4_slot, node4_slot_brick, node5_slot,
    node5_slot_brick, root_cell,
};
use crate::tree::{Entry, MaskWord, Nodes, RootEntry, Tree};

/// Why a tree cannot be built.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum BuildError {
    /// More of something than a limit allows, such as bricks or entries than 32-bit indices can name.
    #[error("the volume needs more than {limit} {what}")]
    Limit {
        /// What there are too many of.
        what: &'static str,
        /// How many there may be.
        limit: u64,
    },
    /// Two regions were given for the same place.
    #[error("two regions overlap at index {0}")]
    Overlap(IVec3),
}

/// The size of a tile.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TileSize {
    /// 8³ voxels.
    Brick,
    /// 128³ voxels.
    Node4,
    /// 4096³ voxels.
    Node5,
}

/// Collects the regions of a tree. Values must be finite.
#[derive(Debug, Default)]
pub struct TreeBuilder {
    root: BTreeMap<[i32; 3], Slot<Node5>>,
    node4s: Vec<Node4>,
    /// The `Node4` that was changed last and its first brick: bricks of one mostly come together.
    last_node4: Option<(IVec3, usize)>,
    summaries: Vec<BrickSummary>,
}

/// A child is an index of [`TreeBuilder::node4s`].
type Node5 = BTreeMap<u16, Slot<usize>>;
type Node4 = Box<[Leaf]>;

/// One value, or a child.
#[derive(Debug, Clone, Copy)]
enum Slot<T> {
    Tile(f32),
    Child(T),
}

/// What stands in a slot of a `Node4`.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Leaf {
    Absent,
    Tile(f32),
    Brick(u32),
}

/// A node and what stands beside it in one direction, by the bit set of the axes along which it lies.
type Around<T> = [Option<Slot<T>>; 8];

const ZERO: Bounds = Bounds { min: 0.0, max: 0.0 };
/// Index coordinates have 32 bits, so brick coordinates lie in `-BRICK_END..BRICK_END`.
const BRICK_END: i32 = 1 << 28;
/// Entries and bricks are named by 32 bits, of which one value is taken.
const INDEX_LIMIT: usize = u32::MAX as usize;

/// The step to the next brick along the axes of a bit set `x << 2 | y << 1 | z`.
fn step(axes: usize) -> IVec3 {
    IVec3::new((axes >> 2 & 1) as i32, (axes >> 1 & 1) as i32, (axes & 1) as i32)
}

impl TreeBuilder {
    /// A builder of an empty tree.
    pub fn new() -> Self {
        Self::default()
    }

    /// Adds a brick at a brick coordinate and gives its index. The n-th brick added is the n-th of the array
    /// given to [`TreeBuilder::finish`].
    ///
    /// # Errors
    /// If something is there already, which then stays.
    pub fn brick(&mut self, brick: IVec3, summary: BrickSummary) -> Result<u32, BuildError> {
        let index = self.summaries.len() as u32;
        self.leaf(brick, Leaf::Brick(index))?;
        self.summaries.push(summary);
        Ok(index)
    }

    /// Places a brick that was added before at another brick coordinate as well.
    ///
    /// # Errors
    /// If something is there already, which then stays.
    ///
    /// # Panics
    /// If no brick of that index was added.
    pub fn brick_again(&mut self, brick: IVec3, index: u32) -> Result<(), BuildError> {
        assert!((index as usize) < self.summaries.len(), "brick {index} was added before");
        self.leaf(brick, Leaf::Brick(index))
    }

    /// Adds a region of one value around a brick: the aligned cube of that size.
    ///
    /// # Errors
    /// If something is there already, which then stays.
    pub fn tile(&mut self, brick: IVec3, size: TileSize, value: f32) -> Result<(), BuildError> {
        let overlap = BuildError::Overlap(brick << 3);
        let cell = self.root.entry(root_cell(brick).to_array());
        let vacant = match size {
            TileSize::Brick => return self.leaf(brick, Leaf::Tile(value)),
            TileSize::Node5 => insert_if_vacant(cell, Slot::Tile(value)),
            TileSize::Node4 => match cell.or_insert_with(|| Slot::Child(Node5::new())) {
                Slot::Tile(_) => false,
                Slot::Child(node5) => {
                    insert_if_vacant(node5.entry(node5_slot(brick) as u16), Slot::Tile(value))
                }
            },
        };
        if vacant { Ok(()) } else { Err(overlap) }
    }

    fn leaf(&mut self, brick: IVec3, leaf: Leaf) -> Result<(), BuildError> {
        let overlap = BuildError::Overlap(brick << 3);
        let first_brick = brick & !15;
        let node4 = match self.last_node4 {
            Some((last, node4)) if last == first_brick => node4,
            _ => {
                let node5 = self.root.entry(root_cell(brick).to_array());
                let Slot::Child(node5) = node5.or_insert_with(|| Slot::Child(Node5::new())) else {
                    return Err(overlap);
                };
                let node4s = &mut self.node4s;
                let new_node4 = || {
                    node4s.push(vec![Leaf::Absent; NODE4_SLOTS].into());
                    Slot::Child(node4s.len() - 1)
                };
                let slot = node5.entry(node5_slot(brick) as u16).or_insert_with(new_node4);
                let Slot::Child(node4) = *slot else { return Err(overlap) };
                self.last_node4 = Some((first_brick, node4));
                node4
            }
        };
        match &mut self.node4s[node4][node4_slot(brick)] {
            at @ Leaf::Absent => {
                *at = leaf;
                Ok(())
            }
            _ => Err(overlap),
        }
    }

    /// The tree. `bricks` holds the values of the bricks in the order in which they were added.
    ///
    /// # Errors
    /// If there are more bricks or entries than indices.
    ///
    /// # Panics
    /// If `bricks` holds another number of bricks than were added.
    pub fn finish(self, bricks: Bricks) -> Result<Tree, BuildError> {
        assert_eq!(bricks.len(), self.summaries.len(), "one array entry per brick added");
        Ok(Tree { bricks, ..self.topology()? })
    }

    /// The tree without the values of its bricks, for who keeps them elsewhere.
    ///
    /// # Errors
    /// If there are more bricks or entries than indices.
    pub fn topology(mut self) -> Result<Tree, BuildError> {
        if self.summaries.len() >= INDEX_LIMIT {
            return Err(BuildError::Limit { what: "bricks", limit: INDEX_LIMIT as u64 });
        }
        for (brick, log2_bricks, axes) in self.regions_before_others() {
            self.add_zero_region(brick, log2_bricks, axes);
        }
        let bricks = Bricks::F32(Vec::new());
        let mut tree = Tree { root: Vec::new(), node5: Nodes::default(), node4: Nodes::default(), bricks };
        for (cell, slot) in &self.root {
            let cell = IVec3::from_array(*cell);
            let brick = cell << LOG2_NODE5_BRICKS;
            let after = self.node5s_around(brick, 1);
            let (entry, footprint) = match slot {
                Slot::Tile(value) => {
                    let reach = |axes| self.node5_low_bounds(after[axes], axes);
                    (Entry::constant(*value), union_of((0..8).map(reach)))
                }
                Slot::Child(node5) => self.flatten_node5(node5, &after, &mut tree)?,
            };
            tree.root.push(RootEntry { cell, entry, footprint });
        }
        Ok(tree)
    }

    fn flatten_node5(
        &self,
        node5: &Node5,
        after: &Around<&Node5>,
        tree: &mut Tree,
    ) -> Result<(Entry, Bounds), BuildError> {
        let mut entries = Vec::with_capacity(node5.len());
        for (slot, content) in node5 {
            let slot = usize::from(*slot);
            let after = self.node4s_around(after, slot, 1);
            let (entry, footprint) = match content {
                Slot::Tile(value) => {
                    let reach = |axes| self.node4_low_bounds(after[axes], axes);
                    (Entry::constant(*value), union_of((0..8).map(reach)))
                }
                Slot::Child(node4) => self.flatten_node4(*node4, &after, &mut tree.node4)?,
            };
            entries.push((slot, entry, footprint));
        }
        push_node(&mut tree.node5, NODE5_SLOTS, &entries)
    }

    fn flatten_node4(
        &self,
        node4: usize,
        after: &Around<&[Leaf]>,
        nodes: &mut Nodes,
    ) -> Result<(Entry, Bounds), BuildError> {
        let after = Bordered::new(after, 1);
        let mut entries = Vec::new();
        for (slot, leaf) in self.node4s[node4].iter().enumerate() {
            let entry = match leaf {
                Leaf::Absent => continue,
                Leaf::Tile(value) => Entry::constant(*value),
                Leaf::Brick(index) => {
                    let BrickSummary { low_bounds: [all, ..], mean } = self.summaries[*index as usize];
                    Entry { child: *index, min: all.min, max: all.max, mean }
                }
            };
            let after = after.leaves(slot);
            let footprint = match leaf {
                // So are most of the many tiles that a cut region leaves.
                Leaf::Tile(value) if after == [*leaf; 8] => Bounds::of(*value),
                _ => union_of((0..8).map(|axes| self.leaf_low_bounds(after[axes], axes))),
            };
            entries.push((slot, entry, footprint));
        }
        push_node(nodes, NODE4_SLOTS, &entries)
    }

    /// What stands in the cell of a brick and beside it, up or down.
    fn node5s_around(&self, brick: IVec3, direction: i32) -> Around<&Node5> {
        std::array::from_fn(|axes| {
            let cell = root_cell(brick) + step(axes) * direction;
            self.root.get(&cell.to_array()).map(|slot| match slot {
                Slot::Tile(value) => Slot::Tile(*value),
                Slot::Child(node5) => Slot::Child(node5),
            })
        })
    }

    /// What stands in a slot of a `Node5` and beside it, up or down.
    fn node4s_around(&self, node5s: &Around<&Node5>, slot: usize, direction: i32) -> Around<&[Leaf]> {
        std::array::from_fn(|axes| {
            let at = node5_slot_brick(IVec3::ZERO, slot) + ((step(axes) * direction) << LOG2_NODE4_BRICKS);
            self.node4_in(node5s[outside(at, LOG2_NODE5_BRICKS)], node5_slot(at))
        })
    }

    fn node4_in(&self, node5: Option<Slot<&Node5>>, slot: usize) -> Option<Slot<&[Leaf]>> {
        match node5? {
            Slot::Tile(value) => Some(Slot::Tile(value)),
            Slot::Child(node5) => node5.get(&(slot as u16)).map(|slot| match slot {
                Slot::Tile(value) => Slot::Tile(*value),
                Slot::Child(node4) => Slot::Child(&*self.node4s[*node4]),
            }),
        }
    }

    /// Bounds of the voxels of a cell at its low end along some axes.
    fn node5_low_bounds(&self, node5: Option<Slot<&Node5>>, axes: usize) -> Bounds {
        match node5 {
            None => ZERO,
            Some(Slot::Tile(value)) => Bounds::of(value),
            Some(Slot::Child(_)) => {
                let slots = face_slots(LOG2_NODE5_BRICKS - LOG2_NODE4_BRICKS, axes, 0);
                union_of(slots.map(|slot| self.node4_low_bounds(self.node4_in(node5, slot), axes)))
            }
        }
    }

    /// The same of a slot of a `Node5`.
    fn node4_low_bounds(&self, node4: Option<Slot<&[Leaf]>>, axes: usize) -> Bounds {
        match node4 {
            None => ZERO,
            Some(Slot::Tile(value)) => Bounds::of(value),
            Some(Slot::Child(node4)) => {
                let slots = face_slots(LOG2_NODE4_BRICKS, axes, 0);
                union_of(slots.map(|slot| self.leaf_low_bounds(node4[slot], axes)))
            }
        }
    }

    /// The same of a slot of a `Node4`.
    fn leaf_low_bounds(&self, leaf: Leaf, axes: usize) -> Bounds {
        match leaf {
            Leaf::Absent => ZERO,
            Leaf::Tile(value) => Bounds::of(value),
            Leaf::Brick(index) => self.summaries[index as usize].low_bounds[axes],
        }
    }

    /// The places before stored regions, along the axes of a bit set, that see values there that are not
    /// zero: first brick, extent, axes. Those of the same extent at which something is stored are left out.
    fn regions_before_others(&self) -> Vec<(IVec3, u32, usize)> {
        let mut found = Vec::new();
        let mut add = |brick: IVec3, log2_bricks: u32, axes: usize| {
            let before = brick - (step(axes) << log2_bricks);
            if before.min_element() >= -BRICK_END {
                found.push((before, log2_bricks, axes));
            }
        };
        for (cell, slot) in &self.root {
            let first_brick = IVec3::from_array(*cell) << LOG2_NODE5_BRICKS;
            let node5 = match slot {
                Slot::Tile(value) => {
                    if *value != 0.0 {
                        (1..8).for_each(|axes| add(first_brick, LOG2_NODE5_BRICKS, axes));
                    }
                    continue;
                }
                Slot::Child(node5) => node5,
            };
            let before = self.node5s_around(first_brick, -1);
            for (slot, content) in node5 {
                let slot = usize::from(*slot);
                let first_brick = node5_slot_brick(first_brick, slot);
                let before = self.node4s_around(&before, slot, -1);
                let node4 = match content {
                    Slot::Tile(value) => {
                        let open = |axes: &usize| !matches!(before[*axes], Some(Slot::Tile(_)));
                        if *value != 0.0 {
                            (1..8).filter(open).for_each(|axes| add(first_brick, LOG2_NODE4_BRICKS, axes));
                        }
                        continue;
                    }
                    Slot::Child(node4) => &self.node4s[*node4],
                };
                let before = Bordered::new(&before, -1);
                for (slot, leaf) in node4.iter().enumerate().filter(|(_, leaf)| **leaf != Leaf::Absent) {
                    let before = before.leaves(slot);
                    for axes in (1..8).filter(|axes| before[*axes] == Leaf::Absent) {
                        if self.leaf_low_bounds(*leaf, axes) != ZERO {
                            add(node4_slot_brick(first_brick, slot), 0, axes);
                        }
                    }
                }
            }
        }
        found
    }

    /// Stores zero wherever nothing is stored at the high end, along some axes, of the region of that extent
    /// around a brick, in regions as large as the tree allows.
    fn add_zero_region(&mut self, brick: IVec3, log2_bricks: u32, axes: usize) {
        let entry = self.root.entry(root_cell(brick).to_array());
        let Slot::Child(node5) = entry.or_insert(Slot::Tile(0.0)) else { return };
        let slot = (log2_bricks < LOG2_NODE5_BRICKS).then(|| node5_slot(brick));
        for slot in slot_or_face(slot, LOG2_NODE5_BRICKS - LOG2_NODE4_BRICKS, axes, 31) {
            let Slot::Child(node4) = node5.entry(slot as u16).or_insert(Slot::Tile(0.0)) else { continue };
            let node4 = &mut self.node4s[*node4];
            let slot = (log2_bricks == 0).then(|| node4_slot(brick));
            for slot in slot_or_face(slot, LOG2_NODE4_BRICKS, axes, 15) {
                if node4[slot] == Leaf::Absent {
                    node4[slot] = Leaf::Tile(0.0);
                }
            }
        }
    }
}

/// The axes along which a brick coordinate lies one step outside of `0..1 << log2_bricks`, up or down.
fn outside(brick: IVec3, log2_bricks: u32) -> usize {
    let beyond = (brick >> log2_bricks) & 1;
    (beyond.x << 2 | beyond.y << 1 | beyond.z) as usize
}

/// The slots of a `Node4` with one layer of what stands beside it, up or down.
struct Bordered {
    /// 17³ of them.
    leaves: Vec<Leaf>,
    direction: i32,
}

impl Bordered {
    fn new(around: &Around<&[Leaf]>, direction: i32) -> Self {
        // Along z a run of slots stands together, and the border is one more.
        let runs = if direction < 0 { [-1..0, 0..16] } else { [0..16, 16..17] };
        let mut leaves = Vec::with_capacity(17 * 17 * 17);
        for x in runs[0].start..runs[1].end {
            for y in runs[0].start..runs[1].end {
                for run in &runs {
                    let at = IVec3::new(x, y, run.start);
                    let (slot, len) = (node4_slot(at), run.len());
                    match around[outside(at, LOG2_NODE4_BRICKS)] {
                        None => leaves.extend(repeat_n(Leaf::Absent, len)),
                        Some(Slot::Tile(value)) => leaves.extend(repeat_n(Leaf::Tile(value), len)),
                        Some(Slot::Child(node4)) => leaves.extend_from_slice(&node4[slot..slot + len]),
                    }
                }
            }
        }
        Bordered { leaves, direction }
    }

    /// What stands in a slot and one step from it, by the bit set of the axes of the step.
    fn leaves(&self, slot: usize) -> [Leaf; 8] {
        let index = |at: IVec3| (at.x * 17 + at.y) * 17 + at.z;
        let here = index(node4_slot_brick(IVec3::splat(-self.direction.min(0)), slot));
        std::array::from_fn(|axes| self.leaves[(here + self.direction * index(step(axes))) as usize])
    }
}

/// Fills a place of a map. Whether it was free.
fn insert_if_vacant<K: Ord, V>(entry: btree_map::Entry<'_, K, V>, value: V) -> bool {
    match entry {
        btree_map::Entry::Vacant(place) => {
            place.insert(value);
            true
        }
        btree_map::Entry::Occupied(_) => false,
    }
}

fn union_of(bounds: impl Iterator<Item = Bounds>) -> Bounds {
    bounds.reduce(Bounds::union).unwrap_or(ZERO)
}

/// One slot, or without one those of [`face_slots`].
fn slot_or_face(
    slot: Option<usize>,
    log2_slots: u32,
    axes: usize,
    end: usize,
) -> impl Iterator<Item = usize> {
    let face = slot.is_none().then(|| face_slots(log2_slots, axes, end));
    slot.into_iter().chain(face.into_iter().flatten())
}

/// The slots of a node whose coordinate along each of some axes is `end`.
fn face_slots(log2_slots: u32, axes: usize, end: usize) -> impl Iterator<Item = usize> {
    let range = move |axis: usize| if axes >> axis & 1 == 1 { end..end + 1 } else { 0..1 << log2_slots };
    range(2).flat_map(move |x| {
        range(1).flat_map(move |y| range(0).map(move |z| (x << log2_slots | y) << log2_slots | z))
    })
}

/// Appends a node with these entries, sorted by slot, and gives the entry of the node itself.
fn push_node(
    nodes: &mut Nodes,
    slots: usize,
    entries: &[(usize, Entry, Bounds)],
) -> Result<(Entry, Bounds), BuildError> {
    if nodes.entries.len() + entries.len() >= INDEX_LIMIT {
        return Err(BuildError::Limit { what: "tree entries", limit: INDEX_LIMIT as u64 });
    }
    let node = (nodes.words.len() / (slots / 32)) as u32;
    let mut words = vec![MaskWord::default(); slots / 32];
    for (slot, ..) in entries {
        words[slot / 32].bits |= 1 << (slot % 32);
    }
    let mut first_entry = nodes.entries.len() as u32;
    for word in &mut words {
        word.first_entry = first_entry;
        first_entry += word.bits.count_ones();
    }
    nodes.words.extend(words);
    nodes.entries.extend(entries.iter().map(|(_, entry, _)| *entry));
    nodes.footprints.extend(entries.iter().map(|(.., footprint)| *footprint));

    // Slots without an entry are zero.
    let start = if entries.len() < slots { Some(ZERO) } else { None };
    let union = |all: Option<Bounds>, one: Bounds| Some(all.map_or(one, |all| all.union(one)));
    let own = entries.iter().map(|(_, e, _)| Bounds { min: e.min, max: e.max }).fold(start, union);
    let own = own.unwrap_or(ZERO);
    let footprint = entries.iter().map(|(.., footprint)| *footprint).fold(start, union).unwrap_or(ZERO);
    let sum: f64 = entries.iter().map(|(_, entry, _)| f64::from(entry.mean)).sum();
    let mean = (sum / slots as f64) as f32;
    Ok((Entry { child: node, min: own.min, max: own.max, mean }, footprint))
}
