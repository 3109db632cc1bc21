//! What the tests of the renderer share: channels built from closures and tiles, and line integrals in double
//! precision that owe nothing to the code under test.

#![allow(dead_code, reason = "each test binary uses its own part")]
#![allow(unreachable_pub, reason = "a module of test binaries, not of a library")]

use glam::{DAffine3, DVec3, IVec3};
use nuage_render::camera::{Camera, Ray};
use nuage_render::hash::hash_u32;
use nuage_render::scene::{Scene, Shape, Volume};
use nuage_volume::brick::{BrickSummary, Bricks};
use nuage_volume::build::{TileSize, TreeBuilder};
use nuage_volume::channel::{Channel, IndexBox};
use nuage_volume::space::{BRICK_VOXELS, brick_of, voxel_offset};
use nuage_volume::tree::{Content, Tree};

/// A channel of the values of `f` at all voxels from `min` to `max`.
pub fn channel_of(min: IVec3, max: IVec3, world_from_index: DAffine3, f: impl Fn(IVec3) -> f32) -> Channel {
    let mut builder = TreeBuilder::new();
    let mut all = Vec::new();
    let (first, last) = (brick_of(min), brick_of(max));
    for brick in boxed(first, last) {
        let mut values = [0.0; BRICK_VOXELS];
        let first_voxel: IVec3 = brick << 3;
        for voxel in boxed(first_voxel.max(min), (first_voxel + 7).min(max)) {
            values[voxel_offset(voxel)] = f(voxel);
        }
        if values.iter().any(|v| *v != 0.0) {
            builder.brick(brick, BrickSummary::of(&values)).expect("a free place");
            all.extend(values);
        }
    }
    let tree = builder.finish(Bricks::F32(all)).expect("a small tree");
    Channel { tree, world_from_index, active_box: Some(IndexBox { min, max }) }
}

/// A channel of one tile of value 1 whose first voxel is the origin of index space.
pub fn tile(size: TileSize, world_from_index: DAffine3) -> Channel {
    let mut builder = TreeBuilder::new();
    builder.tile(IVec3::ZERO, size, 1.0).expect("a free place");
    let tree = builder.finish(Bricks::F32(Vec::new())).expect("a small tree");
    let max = IVec3::splat(tile_voxels(size) - 1);
    Channel { tree, world_from_index, active_box: Some(IndexBox { min: IVec3::ZERO, max }) }
}

/// The voxels along a side of a tile.
pub fn tile_voxels(size: TileSize) -> i32 {
    match size {
        TileSize::Brick => 8,
        TileSize::Node4 => 128,
        TileSize::Node5 => 4096,
    }
}

/// A channel without voxels.
pub fn empty() -> Channel {
    let tree = TreeBuilder::new().finish(Bricks::F32(Vec::new())).expect("an empty tree");
    Channel { tree, world_from_index: DAffine3::IDENTITY, active_box: None }
}

/// All coordinates from `min` to `max`, both included.
pub fn boxed(min: IVec3, max: IVec3) -> impl Iterator<Item = IVec3> {
    (min.x..=max.x).flat_map(move |x| {
        (min.y..=max.y).flat_map(move |y| (min.z..=max.z).map(move |z| IVec3::new(x, y, z)))
    })
}

/// A medium that only absorbs, without lights.
pub fn absorbing(camera: Camera, density: &Channel, density_scale: f32) -> Scene<'_> {
    Scene::of_one(camera, Volume::absorbing(Shape::Grid(density), density_scale), None, [0.0; 3])
}

/// Any camera, for tests that shoot their rays themselves.
pub fn any_camera() -> Camera {
    Camera::look_at(DVec3::Z, DVec3::ZERO, DVec3::Y, 40.0).expect("a view")
}

/// The value of a voxel, looked up from the root.
pub fn voxel(tree: &Tree, index: IVec3) -> f64 {
    f64::from(match tree.region(brick_of(index)).content {
        Content::Constant(value) => value,
        Content::Brick(brick) => tree.bricks.value(brick, voxel_offset(index)),
    })
}

/// The voxels of a channel in one array: quick to read.
pub struct Dense {
    min: IVec3,
    size: IVec3,
    values: Vec<f64>,
    index_from_world: DAffine3,
}

impl Dense {
    pub fn new(channel: &Channel) -> Self {
        let IndexBox { min, max } = channel.active_box.expect("active voxels");
        let values = boxed(min, max).map(|index| voxel(&channel.tree, index)).collect();
        Dense { min, size: max - min + 1, values, index_from_world: channel.world_from_index.inverse() }
    }

    pub fn voxel(&self, index: IVec3) -> f64 {
        let local = index - self.min;
        let inside = local.cmpge(IVec3::ZERO).all() && local.cmplt(self.size).all();
        if !inside {
            return 0.0;
        }
        self.values[((local.x * self.size.y + local.y) * self.size.z + local.z) as usize]
    }

    /// The value at a world position.
    pub fn at(&self, p_world: DVec3) -> f64 {
        trilinear(&|index| self.voxel(index), self.index_from_world.transform_point3(p_world))
    }

    /// Where a ray is inside of what interpolates to more than zero, at most.
    pub fn interval(&self, ray: &Ray) -> Option<[f64; 2]> {
        let (origin, direction) = to_index(&self.index_from_world, ray);
        let low = (self.min - 1).as_dvec3();
        clip(origin, direction, low, low + (self.size + 1).as_dvec3())
    }

    /// The integral of the channel along a ray, in value × world length. Exact but for rounding.
    pub fn line_integral(&self, ray: &Ray) -> f64 {
        let Some([t0, t1]) = self.interval(ray) else { return 0.0 };
        let (origin, direction) = to_index(&self.index_from_world, ray);
        line_integral(&|index| self.voxel(index), origin, direction, t0, t1)
    }
}

/// A world ray in index space: its direction is in voxels per world length.
pub fn to_index(index_from_world: &DAffine3, ray: &Ray) -> (DVec3, DVec3) {
    (index_from_world.transform_point3(ray.origin), index_from_world.transform_vector3(ray.direction))
}

/// Where a ray with t ≥ 0 is inside of a box.
pub fn clip(origin: DVec3, direction: DVec3, low: DVec3, high: DVec3) -> Option<[f64; 2]> {
    let [mut t0, mut t1] = [0.0f64, f64::INFINITY];
    for axis in 0..3 {
        if direction[axis] == 0.0 {
            if origin[axis] < low[axis] || origin[axis] > high[axis] {
                return None;
            }
            continue;
        }
        let a = (low[axis] - origin[axis]) / direction[axis];
        let b = (high[axis] - origin[axis]) / direction[axis];
        (t0, t1) = (t0.max(a.min(b)), t1.min(a.max(b)));
    }
    (t0 < t1).then_some([t0, t1])
}

/// Trilinear interpolation in double precision.
pub fn trilinear(voxel: &impl Fn(IVec3) -> f64, p_index: DVec3) -> f64 {
    let corner = p_index.floor();
    let f = p_index - corner;
    let cell = corner.as_ivec3();
    let mut sum = 0.0;
    for i in 0..8 {
        let d = IVec3::new(i >> 2 & 1, i >> 1 & 1, i & 1);
        let w = DVec3::select(d.cmpeq(IVec3::ONE), f, 1.0 - f);
        sum += w.x * w.y * w.z * voxel(cell.wrapping_add(d));
    }
    sum
}

/// The parameters at which a ray enters a new cell, with both ends.
pub fn cell_crossings(origin: DVec3, direction: DVec3, t0: f64, t1: f64) -> Vec<f64> {
    let mut crossings = vec![t0, t1];
    for axis in 0..3 {
        if direction[axis] != 0.0 {
            let (a, b) = (origin[axis] + t0 * direction[axis], origin[axis] + t1 * direction[axis]);
            let first = a.min(b).ceil() as i64;
            let last = a.max(b).floor() as i64;
            crossings.extend((first..=last).map(|i| (i as f64 - origin[axis]) / direction[axis]));
        }
    }
    crossings.retain(|t| (t0..=t1).contains(t));
    crossings.sort_by(f64::total_cmp);
    crossings
}

/// The integral over t of the interpolated voxels along a ray in index space. Along a line each cell holds a
/// cubic, which Gauss' rule of two points integrates exactly.
pub fn line_integral(
    voxel: &impl Fn(IVec3) -> f64,
    origin: DVec3,
    direction: DVec3,
    t0: f64,
    t1: f64,
) -> f64 {
    let at = |t: f64| trilinear(voxel, origin + t * direction);
    let spread = 1.0 / 3.0f64.sqrt();
    let cell = |w: &[f64]| {
        let (middle, half) = (0.5 * (w[0] + w[1]), 0.5 * (w[1] - w[0]));
        half * (at(middle - spread * half) + at(middle + spread * half))
    };
    cell_crossings(origin, direction, t0, t1).windows(2).map(cell).sum()
}

/// Random numbers, the same in each run.
pub struct Random(pub u32);

impl Random {
    pub fn bits(&mut self) -> u32 {
        self.0 = self.0.wrapping_add(0x9e37_79b9);
        hash_u32(self.0)
    }

    pub fn unit(&mut self) -> f64 {
        f64::from(self.bits()) / 4_294_967_296.0
    }

    pub fn below(&mut self, end: u32) -> i32 {
        (self.bits() % end) as i32
    }

    pub fn in_box(&mut self, low: DVec3, high: DVec3) -> DVec3 {
        low + (high - low) * DVec3::new(self.unit(), self.unit(), self.unit())
    }

    /// A direction, evenly from the sphere.
    pub fn direction(&mut self) -> DVec3 {
        let z = 2.0 * self.unit() - 1.0;
        let (sin, cos) = (std::f64::consts::TAU * self.unit()).sin_cos();
        let across = (1.0 - z * z).sqrt();
        DVec3::new(across * cos, across * sin, z)
    }
}
