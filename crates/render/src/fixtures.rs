//! Volumes and rays for tests of kernels.

use glam::{DAffine3, DVec3, IVec3};
use nuage_volume::brick::{BrickSummary, Bricks};
use nuage_volume::build::{TileSize, TreeBuilder};
use nuage_volume::channel::{Channel, IndexBox};
use nuage_volume::space::BRICK_VOXELS;

use crate::camera::Ray;
use crate::hash::{hash_u32, unit_f32};

pub(crate) fn random(seed: u32) -> f32 {
    unit_f32(hash_u32(seed))
}

/// Bricks here and there, some of one value, and a large tile beside them.
pub(crate) fn channel() -> Channel {
    let mut builder = TreeBuilder::new();
    let mut all = Vec::new();
    builder.tile(IVec3::new(16, 0, 0), TileSize::Node4, 0.4).unwrap();
    for i in 0..300 {
        let brick = [1, 2, 3].map(|j| (random(i * 5 + j) * 16.0) as i32);
        let brick = IVec3::from_array(brick);
        let values: [f32; BRICK_VOXELS] = std::array::from_fn(|j| random(i * 512 + j as u32));
        // Places that are taken already are left as they are.
        if i % 9 == 0 {
            let _ = builder.tile(brick, TileSize::Brick, 0.7);
        } else if builder.brick(brick, BrickSummary::of(&values)).is_ok() {
            all.extend(values);
        }
    }
    let tree = builder.finish(Bricks::F32(all)).unwrap();
    let active_box = Some(IndexBox { min: IVec3::ZERO, max: IVec3::new(255, 127, 127) });
    Channel { tree, world_from_index: DAffine3::from_scale(DVec3::splat(0.1)), active_box }
}

pub(crate) fn rays() -> impl Iterator<Item = Ray> {
    (0..200).map(|i| {
        let point = |seed: u32| {
            let [x, y, z] = [1, 2, 3].map(|j| f64::from(random(seed + j)));
            DVec3::new(x * 26.0, y * 13.0, z * 13.0)
        };
        let (from, to) = (point(i * 50 + 7), point(i * 50 + 20));
        let direction = if i % 5 == 0 { DVec3::AXES[i as usize / 5 % 3] } else { (to - from).normalize() };
        Ray { origin: from - direction * 40.0, direction }
    })
}
