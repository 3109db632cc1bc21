//! Coarser levels of a channel, made in memory: for rays whose light is spread so far that fine voxels do not show.
//!
//! A voxel of a coarser level is the mean of the eight that it covers, so that the integral along a line stays about what it
//! was. Voxel `i` of level n lies at `(i + ½) 2ⁿ − ½` of the channel itself, as in packed files.
//!
//! What does not live here: which rays read a coarser level ([`Volume::coarse`](crate::scene::Volume::coarse)).

use std::collections::BTreeSet;

use glam::{DAffine3, DVec3, IVec3};
use nuage_volume::brick::{BrickSummary, Bricks};
use nuage_volume::build::{BuildError, TileSize, TreeBuilder};
use nuage_volume::channel::{Channel, IndexBox};
use nuage_volume::space::{
    BRICK_VOXELS, LOG2_NODE5_BRICKS, NODE4_SLOTS, NODE5_SLOTS, node4_slot_brick, node5_slot_brick,
};
use nuage_volume::tree::{Content, Entry, Nodes, Tree};

use crate::picture::each_tile;

/// A level has no more tiles than this: those of a large tile are its eighth each.
const MAX_TILES: usize = 1 << 20;

/// Bricks that are made by one thread at a time.
const BATCH: usize = 256;

/// The level with `1/2^levels` of the voxels per axis, or the coarsest that there is: one brick is not made coarser. `None`
/// if that is the channel itself.
///
/// # Errors
/// If the level would have more than a million tiles.
pub fn coarser_by(channel: &Channel, levels: u32) -> Result<Option<Channel>, BuildError> {
    let mut level: Option<Channel> = None;
    for _ in 0..levels {
        let Some(coarser) = coarser(level.as_ref().unwrap_or(channel))? else { break };
        level = Some(coarser);
    }
    Ok(level)
}

/// The next coarser level; `None` if there is one brick or tile, or nothing.
fn coarser(channel: &Channel) -> Result<Option<Channel>, BuildError> {
    let tree = &channel.tree;
    let mut regions = regions(tree);
    regions.retain(|(.., content)| *content != Content::Constant(0.0));
    if regions.len() <= 1 {
        return Ok(None);
    }
    let (mut places, mut tiles) = (BTreeSet::new(), Vec::new());
    for (brick, size, content) in regions {
        let half: IVec3 = brick >> 1;
        match (size, content) {
            (TileSize::Brick, _) => {
                places.insert(half.to_array());
            }
            (_, Content::Brick(_)) => {}
            (TileSize::Node4, Content::Constant(value)) => tiles.push((half, 8, 1, TileSize::Brick, value)),
            (TileSize::Node5, Content::Constant(value)) => tiles.push((half, 16, 16, TileSize::Node4, value)),
        }
    }
    if tiles.iter().map(|(_, count, ..)| (count * count * count) as usize).sum::<usize>() > MAX_TILES {
        return Err(BuildError::Limit { what: "tiles of a coarser level", limit: MAX_TILES as u64 });
    }
    let mut builder = TreeBuilder::new();
    for (first, count, stride, size, value) in tiles {
        for i in 0..count * count * count {
            let step = IVec3::new(i / count / count, i / count % count, i % count);
            builder.tile(first + step * stride, size, value)?;
        }
    }
    let places: Vec<IVec3> = places.into_iter().map(IVec3::from_array).collect();
    let mut batches: Vec<Vec<f32>> = vec![Vec::new(); places.len().div_ceil(BATCH)];
    each_tile(
        &mut batches,
        || (),
        |(), index, batch: &mut Vec<f32>| {
            for place in places.iter().skip(index as usize * BATCH).take(BATCH) {
                batch.extend(means(tree, *place));
            }
        },
    );
    let mut values = Vec::new();
    for (place, brick) in
        places.iter().zip(batches.iter().flat_map(|batch| batch.as_chunks::<BRICK_VOXELS>().0))
    {
        match brick.iter().all(|value| *value == brick[0]) {
            true => builder.tile(*place, TileSize::Brick, brick[0])?,
            false => {
                builder.brick(*place, BrickSummary::of(brick))?;
                values.extend(brick);
            }
        }
    }
    let finer_from_coarser = DAffine3::from_scale_rotation_translation(
        DVec3::splat(2.0),
        glam::DQuat::IDENTITY,
        DVec3::splat(0.5),
    );
    Ok(Some(Channel {
        tree: builder.finish(Bricks::F32(values))?,
        world_from_index: channel.world_from_index * finer_from_coarser,
        active_box: channel.active_box.map(|IndexBox { min, max }| IndexBox { min: min >> 1, max: max >> 1 }),
    }))
}

/// The values of a brick of the coarser level.
fn means(tree: &Tree, place: IVec3) -> [f32; BRICK_VOXELS] {
    let mut values = [0.0; BRICK_VOXELS];
    for (x, y, z) in (0..8).map(|i| (i >> 2, i >> 1 & 1, i & 1)) {
        let content = tree.region((place << 1) + IVec3::new(x, y, z)).content;
        for (i, j, k) in (0..64_usize).map(|i| (i >> 4, i >> 2 & 3, i & 3)) {
            let mean = match content {
                Content::Constant(value) => value,
                // Eighths do not overflow.
                Content::Brick(brick) => {
                    let corners = tree.bricks.corners(brick, 2 * (i << 6 | j << 3 | k));
                    corners.iter().map(|value| 0.125 * value).sum()
                }
            };
            let [x, y, z] = [x, y, z].map(|half| 4 * half as usize);
            values[(x + i) << 6 | (y + j) << 3 | (z + k)] = mean;
        }
    }
    values
}

/// What a tree has entries for: the first brick, the size, the content.
fn regions(tree: &Tree) -> Vec<(IVec3, TileSize, Content)> {
    let mut regions = Vec::new();
    for root in &tree.root {
        let cell = root.cell << LOG2_NODE5_BRICKS;
        if root.entry.child == Entry::CONSTANT {
            regions.push((cell, TileSize::Node5, Content::Constant(root.entry.mean)));
            continue;
        }
        for (slot, entry) in entries(&tree.node5, root.entry.child, NODE5_SLOTS) {
            let first = node5_slot_brick(cell, slot);
            if entry.child == Entry::CONSTANT {
                regions.push((first, TileSize::Node4, Content::Constant(entry.mean)));
                continue;
            }
            for (slot, entry) in entries(&tree.node4, entry.child, NODE4_SLOTS) {
                let content = match entry.child {
                    Entry::CONSTANT => Content::Constant(entry.mean),
                    brick => Content::Brick(brick),
                };
                regions.push((node4_slot_brick(first, slot), TileSize::Brick, content));
            }
        }
    }
    regions
}

/// The entries of a node, with their slots.
fn entries(nodes: &Nodes, node: u32, slots: usize) -> impl Iterator<Item = (usize, Entry)> {
    (0..slots).filter_map(move |slot| Some((slot, nodes.entries[nodes.entry_index(node, slots, slot)?])))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hash::{hash_u32, unit_f32};
    use nuage_volume::accessor::Accessor;

    /// Bricks and tiles of all sizes, on both sides of the origin.
    fn channel() -> Channel {
        let mut builder = TreeBuilder::new();
        let mut values = Vec::new();
        let places = [[-1, 0, 0], [0, 0, 0], [1, 0, 0], [5, -3, 2], [40, 7, 7]].map(IVec3::from_array);
        for (i, place) in (0..).zip(places) {
            let brick: [f32; BRICK_VOXELS] = std::array::from_fn(|j| unit_f32(hash_u32(512 * i + j as u32)));
            builder.brick(place, BrickSummary::of(&brick)).expect("a free place");
            values.extend(brick);
        }
        builder.tile(IVec3::new(2, 0, 0), TileSize::Brick, 0.75).expect("a free place");
        builder.tile(IVec3::new(16, 0, 0), TileSize::Node4, 2.0).expect("a free place");
        builder.tile(IVec3::new(0, 0, 512), TileSize::Node5, 3.0).expect("a free place");
        Channel {
            tree: builder.finish(Bricks::F32(values)).expect("a small tree"),
            world_from_index: DAffine3::from_translation(DVec3::new(3.0, 0.0, -1.0)),
            active_box: Some(IndexBox { min: IVec3::new(-8, -24, 0), max: IVec3::new(4095, 4095, 8191) }),
        }
    }

    #[test]
    fn a_coarser_voxel_is_the_mean_of_those_it_covers_and_lies_in_their_middle() {
        let fine = channel();
        let coarse = coarser_by(&fine, 1).expect("few tiles").expect("a coarser level");
        let (mut from, mut to) = (Accessor::new(&fine.tree), Accessor::new(&coarse.tree));
        let mut differ = 0;
        for i in 0..40_000_u32 {
            // Half of them among the bricks around the origin.
            let spread = if i % 2 == 0 { 12.0 } else { 4400.0 };
            let along = |axis| (unit_f32(hash_u32(3 * i + axis)) * 2.0 - 1.0) * spread;
            let voxel = IVec3::new(along(0) as i32, along(1) as i32, along(2) as i32);
            let step = |i: i32| IVec3::new(i >> 2, i >> 1 & 1, i & 1);
            let mean = (0..8).map(|i| 0.125 * from.voxel(2 * voxel + step(i))).sum::<f32>();
            assert_eq!(to.voxel(voxel), mean, "{voxel}");
            differ += u32::from(mean != 0.0);
            let middle = 2.0 * voxel.as_dvec3() + 0.5;
            let apart = coarse.world_from_index.transform_point3(voxel.as_dvec3())
                - fine.world_from_index.transform_point3(middle);
            assert!(apart.length() < 1e-9);
        }
        assert!(differ > 500, "{differ}");
        let voxels = coarse.active_box.expect("voxels");
        assert_eq!((voxels.min, voxels.max), (IVec3::new(-4, -12, 0), IVec3::new(2047, 2047, 4095)));
    }

    #[test]
    fn levels_end_at_one_brick_or_at_too_many_tiles() {
        let mut builder = TreeBuilder::new();
        let brick: [f32; BRICK_VOXELS] = std::array::from_fn(|i| i as f32);
        for place in [[0, 0, 0], [3, 0, 0]] {
            builder.brick(IVec3::from_array(place), BrickSummary::of(&brick)).expect("a free place");
        }
        let tree = builder.finish(Bricks::F32([brick, brick].concat())).expect("a small tree");
        let active_box = Some(IndexBox { min: IVec3::ZERO, max: IVec3::new(31, 7, 7) });
        let two = Channel { tree, world_from_index: DAffine3::IDENTITY, active_box };
        let bricks =
            |levels| coarser_by(&two, levels).expect("few tiles").map(|level| level.tree.bricks.len());
        assert_eq!([0, 1, 2, 3, 30].map(bricks), [None, Some(2), Some(1), Some(1), Some(1)]);
        let many = coarser_by(&channel(), 3);
        assert!(matches!(many, Err(BuildError::Limit { .. })), "4096 tiles become two million");
    }
}
