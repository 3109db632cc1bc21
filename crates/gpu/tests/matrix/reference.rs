//! The channel that the CPU is given in place of a packed volume: values as the CPU decodes them, in the tree that the device has.
//!
//! Steps begin where nodes do and where values begin to vary. A packed tree has nodes where all is less than 0, is aligned
//! otherwise than that of an imported grid, and has wider bounds: pictures by steps are only the same where trees are.

use glam::{DAffine3, IVec3};
use nuage_gpu::arrays::Meaning;
use nuage_volume::accessor::Accessor;
use nuage_volume::brick::{Bounds, BrickSummary, Bricks};
use nuage_volume::build::{TileSize, TreeBuilder};
use nuage_volume::channel::{Channel, IndexBox};
use nuage_volume::format::Asset;
use nuage_volume::packed::{Content, Entry, mask};
use nuage_volume::space::{
    BRICK_VOXELS, LOG2_BRICK, LOG2_NODE4_BRICKS, LOG2_NODE5_BRICKS, NODE4_SLOTS, NODE5_SLOTS,
    node4_slot_brick, node5_slot_brick,
};
use nuage_volume::tree;

/// The regions of a tree in the order of their entries: those of the root, of `Node5` and of `Node4`.
type ByLevel<T> = [Vec<T>; 3];

/// A channel in the tree of the first grid of a packed volume, and what is added to its indices for those of the channel. `None`
/// if the active box cuts a tile, of which the CPU makes bricks.
pub(crate) fn in_packed_tree(asset: &Asset, channel: &Channel, meaning: Meaning) -> Option<(Channel, IVec3)> {
    let grid = asset.contents().frames.first()?.grids.first()?;
    let offset = IVec3::from_array(grid.index_offset);
    let active_box = channel.active_box?;
    let active_box = IndexBox { min: active_box.min - offset, max: active_box.max - offset };
    let unit = asset.contents().channels.get(grid.channel as usize)?.unit;
    let regions = regions_of(asset)?;

    let mut accessor = Accessor::new(&channel.tree);
    let mut builder = TreeBuilder::new();
    let mut values = Vec::new();
    for (level, of_level) in regions.iter().enumerate() {
        let (size, log2_bricks) = SIZES[level];
        for (first, _) in
            of_level.iter().filter(|(_, entry)| !matches!(entry.content(), Some(Content::Node(_))))
        {
            let region = accessor.region(*first + (offset >> LOG2_BRICK));
            match region.content {
                tree::Content::Brick(index) if log2_bricks == 0 => {
                    let brick: [f32; BRICK_VOXELS] =
                        std::array::from_fn(|at| channel.tree.bricks.value(index, at));
                    builder.brick(*first, BrickSummary::of(&brick)).ok()?;
                    values.extend(brick);
                }
                tree::Content::Constant(value) if value == 0.0 || region.log2_bricks >= log2_bricks => {
                    builder.tile(*first, size, value).ok()?;
                }
                _ => return None,
            }
        }
    }
    let mut tree = builder.finish(Bricks::F32(values)).ok()?;
    let bounds = [0, 1, 2].map(|level: usize| {
        let of_entry = |(first, entry): &(IVec3, Entry)| {
            footprint(*entry, unit, meaning, *first, SIZES[level].1, active_box)
        };
        regions[level].iter().map(of_entry).collect::<Vec<Bounds>>()
    });
    let own: ByLevel<Bounds> = [
        tree.root.iter().map(|cell| cell.footprint).collect(),
        tree.node5.footprints.clone(),
        tree.node4.footprints.clone(),
    ];
    for (own, bounds) in own.iter().zip(&bounds) {
        assert_eq!(own.len(), bounds.len(), "the same entries");
        let holds = |(own, bounds): (&Bounds, &Bounds)| bounds.min <= own.min && bounds.max >= own.max;
        assert!(own.iter().zip(bounds).all(holds), "bounds hold what is there");
    }
    let [of_root, of_node5s, of_node4s] = bounds;
    tree.root.iter_mut().zip(of_root).for_each(|(cell, bounds)| cell.footprint = bounds);
    (tree.node5.footprints, tree.node4.footprints) = (of_node5s, of_node4s);
    let world_from_index = channel.world_from_index * DAffine3::from_translation(offset.as_dvec3());
    Some((Channel { tree, world_from_index, active_box: Some(active_box) }, offset))
}

/// The sizes of regions by level, and log2 of their bricks along a side.
const SIZES: [(TileSize, u32); 3] =
    [(TileSize::Node5, LOG2_NODE5_BRICKS), (TileSize::Node4, LOG2_NODE4_BRICKS), (TileSize::Brick, 0)];

/// The first brick and the entry of each region of the first grid.
fn regions_of(asset: &Asset) -> Option<ByLevel<(IVec3, Entry)>> {
    let trees = asset.trees();
    let level = asset.contents().frames.first()?.grids.first()?.levels.first()?;
    let mut regions: ByLevel<(IVec3, Entry)> = Default::default();
    for cell in trees.cells_of(*level) {
        let first = IVec3::from_array(cell.cell) << LOG2_NODE5_BRICKS;
        regions[0].push((first, cell.entry));
        let Some(Content::Node(node5)) = cell.entry.content() else { continue };
        let node5 = trees.node5s[node5 as usize];
        for (slot, at) in mask::slots(trees, node5.mask, NODE5_SLOTS).zip(node5.first_entry as usize..) {
            let (first, entry) = (node5_slot_brick(first, slot), trees.entries[at]);
            regions[1].push((first, entry));
            let Some(Content::Node(node4)) = entry.content() else { continue };
            let node4 = trees.node4s[node4 as usize];
            let slots = mask::slots(trees, node4.mask, NODE4_SLOTS).zip(node4.first_entry as usize..);
            regions[2].extend(slots.map(|(slot, at)| (node4_slot_brick(first, slot), trees.entries[at])));
        }
    }
    Some(regions)
}

/// The bounds of a region as shaders see them.
fn footprint(
    entry: Entry,
    unit: f32,
    meaning: Meaning,
    first: IVec3,
    log2_bricks: u32,
    active_box: IndexBox,
) -> Bounds {
    let meant = |value: f32| match meaning {
        Meaning::Density => value.max(0.0),
        Meaning::Fog { band } => (-value / band).clamp(0.0, 1.0),
        Meaning::Surface { band } => (band - value).clamp(0.0, 2.0 * band),
    };
    let stored = entry.footprint(unit);
    let (a, b) = (meant(stored.min), meant(stored.max));
    // What is outside of the active box is 0, whatever is stored.
    let low: IVec3 = first << LOG2_BRICK;
    let high = low + (1 << (log2_bricks + LOG2_BRICK));
    let is_inside = low.cmpge(active_box.min).all() && high.cmple(active_box.max).all();
    Bounds { min: if is_inside { a.min(b) } else { 0.0 }, max: a.max(b) }
}
