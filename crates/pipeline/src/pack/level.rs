//! The bricks and tiles of a tree, and those of the next coarser level.
//!
//! A voxel of a coarser level is the mean of the eight it covers, so that the integral along any line, and with it the
//! optical depth, stays what it was. Voxel `i` of level `n` lies at `(i + ½) 2ⁿ - ½` of level 0. No level knows of
//! active states; what differs from the background counts.

use std::collections::BTreeMap;

use glam::IVec3;
use nuage_vdb::{LEVEL4, LEVEL5, Tree};
use nuage_volume::build::TileSize;
use nuage_volume::space::BRICK_VOXELS;

use crate::encode::quantize::Brick;

/// More tiles than this are not split for a coarser level.
const MAX_TILES: usize = 1 << 20;

/// A tile: the coordinate of its first brick, its size, its value.
pub type Tile = (IVec3, TileSize, f32);

/// What is stored of one level: all that differs from the background.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Level {
    /// Where each brick stands, in bricks.
    pub places: Vec<IVec3>,
    /// The values of the bricks, none of them constant.
    pub bricks: Vec<Brick>,
    /// Regions of one value.
    pub tiles: Vec<Tile>,
}

impl Level {
    /// The level of a tree itself, moved by minus `offset` bricks.
    pub fn of(tree: &Tree<f32>, offset: IVec3) -> Level {
        let mut level = Level::default();
        let background = tree.background;
        let mut tile = |origin: [i32; 3], size, value: f32| {
            if value != background {
                level.tiles.push(((IVec3::from_array(origin) >> 3) - offset, size, value));
            }
        };
        for root_tile in &tree.root_tiles {
            tile(root_tile.origin, TileSize::Node5, root_tile.value);
        }
        for (nodes, branching, size) in
            [(&tree.levels[0], LEVEL5, TileSize::Node4), (&tree.levels[1], LEVEL4, TileSize::Brick)]
        {
            for node in nodes {
                for (slot, value, _) in node.tile_slots() {
                    tile(branching.child_origin(node.origin, slot), size, value);
                }
            }
        }
        for (origin, values) in tree.leaves.origins.iter().zip(tree.leaves.values.as_chunks().0) {
            level.push((IVec3::from_array(*origin) >> 3) - offset, values, background);
        }
        level
    }

    fn push(&mut self, place: IVec3, values: &Brick, background: f32) {
        if values.iter().any(|value| *value != values[0]) {
            self.places.push(place);
            self.bricks.push(*values);
        } else if values[0] != background {
            self.tiles.push((place, TileSize::Brick, values[0]));
        }
    }

    /// The voxels of all bricks that differ from the background.
    pub fn voxels(&self, background: f32) -> u64 {
        self.bricks
            .iter()
            .map(|brick| brick.iter().filter(|value| **value != background).count() as u64)
            .sum()
    }

    /// The next coarser level. `None` if there is next to nothing to gain: the level is a single brick or none, or has
    /// more tiles than are worth splitting.
    pub fn coarser(&self, background: f32) -> Option<Level> {
        if self.places.len() + self.tiles.len() <= 1 || self.tiles.len() > MAX_TILES {
            return None;
        }
        let mut bricks: BTreeMap<[i32; 3], Box<Brick>> = BTreeMap::new();
        let mut level = Level::default();
        let mut parent = |place: IVec3, child: &dyn Fn(usize, usize, usize) -> f32| {
            let at: IVec3 = place >> 1;
            let brick = bricks.entry(at.to_array()).or_insert_with(|| Box::new([background; BRICK_VOXELS]));
            let first = (place & 1) * 4;
            for (x, y, z) in (0..64).map(|i| (i >> 4, i >> 2 & 3, i & 3)) {
                let to = [x + first.x as usize, y + first.y as usize, z + first.z as usize];
                brick[to[0] << 6 | to[1] << 3 | to[2]] = child(x, y, z);
            }
        };
        for (place, brick) in self.places.iter().zip(&self.bricks) {
            parent(*place, &|x, y, z| {
                let voxel = |i: usize| {
                    brick[(2 * x + (i >> 2)) << 6 | (2 * y + (i >> 1 & 1)) << 3 | (2 * z + (i & 1))]
                };
                // Eighths do not overflow.
                (0..8).map(|i| 0.125 * voxel(i)).sum()
            });
        }
        for (place, size, value) in &self.tiles {
            let half: IVec3 = *place >> 1;
            let (count, size, stride) = match size {
                TileSize::Brick => {
                    parent(*place, &|_, _, _| *value);
                    continue;
                }
                TileSize::Node4 => (8, TileSize::Brick, 1),
                TileSize::Node5 => (16, TileSize::Node4, 16),
            };
            if level.tiles.len() > MAX_TILES {
                return None;
            }
            for (x, y, z) in
                (0..count * count * count).map(|i| (i / count / count, i / count % count, i % count))
            {
                level.tiles.push((half + IVec3::new(x, y, z) * stride, size, *value));
            }
        }
        for (place, values) in &bricks {
            level.push(IVec3::from_array(*place), values, background);
        }
        Some(level)
    }
}
