//! The walk of a ray through a tree: a hierarchical DDA that yields what is not empty.
//!
//! Integrators see a channel only as [`Run`]s along a ray, each either homogeneous or to be sampled. The walk
//! steps from region to region, as large as the tree has them; a region whose trilinear footprint is zero
//! costs one look-up. Large tiles are homogeneous but for the layer of cells at their high faces, where
//! samples blend with the neighbours.
//!
//! After Amanatides & Woo, "A Fast Voxel Traversal Algorithm for Ray Tracing", 1987, and Museth, "Hierarchical
//! Digital Differential Analyzer for Efficient Ray-Marching in OpenVDB", 2014.

use std::sync::OnceLock;

use glam::{DMat3, DVec3, IVec3, Mat3, Vec3};
use nuage_volume::accessor::{Accessor, BrickPlace};
use nuage_volume::brick::Bounds;
use nuage_volume::channel::Channel;
use nuage_volume::space::LOG2_NODE5_BRICKS;
use nuage_volume::tree::{Content, Tree};

use crate::blocks::{BlockStore, Blocks};
use crate::camera::Ray;
use crate::walk::{BrickMap, BrickSpan, Sight, SpanContent, voxels_of};

/// A channel made ready for rays: its transform inverted, its extent in the coordinates of the walk.
///
/// Positions of the walk are index coordinates relative to the first voxel of `base_brick`, so that single
/// precision suffices wherever a volume lies.
#[derive(Debug, Clone)]
pub struct Field<'a> {
    channel: &'a Channel,
    blocks: BlockStore,
    /// By what is looked for, made when the first ray asks for it.
    maps: [OnceLock<Option<BrickMap>>; 2],
    index_from_world: DMat3,
    /// World origin in positions of the walk.
    offset: DVec3,
    base_brick: IVec3,
    /// The first and last brick that a sample other than zero can lie in.
    brick_box: [IVec3; 2],
    /// Where samples can be other than zero, as positions.
    bounds: [DVec3; 2],
    /// Whether samples reach one voxel beyond their cell on all sides.
    is_wide: bool,
}

/// What one thread needs to read a [`Field`]: places that it remembers.
#[derive(Debug, Clone)]
pub struct Reader<'a> {
    /// Where the camera ray walks.
    pub walker: Accessor<'a>,
    /// Where the shadow ray walks.
    pub shadow_walker: Accessor<'a>,
    /// The values near both.
    pub blocks: Blocks<'a>,
}

/// A ray in the positions of a [`Field`], `p(t) = origin + t × direction`.
#[derive(Debug, Clone, Copy)]
pub struct LocalRay {
    /// The position at t = 0.
    pub origin: Vec3,
    /// Voxels per unit of t, which is world length.
    pub direction: Vec3,
    inverse: Vec3,
}

/// A ray where it is in a [`Field`], in double precision.
pub(crate) struct Entered {
    origin: DVec3,
    direction: DVec3,
    /// Where it enters and leaves, as distances from its origin.
    pub(crate) interval: [f64; 2],
}

/// A stretch of a ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Run {
    /// Where it begins.
    pub t0: f32,
    /// Where it ends.
    pub t1: f32,
    /// What it holds.
    pub kind: RunKind,
}

/// What a stretch of a ray holds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RunKind {
    /// One value everywhere.
    Constant(f32),
    /// Values to be sampled.
    Varying,
}

/// A stretch of a ray through one region, with bounds of all that can be sampled there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Segment {
    /// Where it begins.
    pub t0: f32,
    /// Where it ends.
    pub t1: f32,
    /// No sample is less.
    pub min: f32,
    /// No sample is more; above 0.
    pub max: f32,
}

impl<'a> Field<'a> {
    /// Makes a channel ready. `None` if it has no active voxel or is zero everywhere.
    pub fn new(channel: &'a Channel) -> Option<Self> {
        Self::reaching(channel, 0)
    }

    /// The same for samples that reach one voxel beyond their cell on all sides, as cubic ones do. To be walked by
    /// [`runs`](Self::runs), whose bounds are as wide.
    pub(crate) fn wide(channel: &'a Channel) -> Option<Self> {
        Self::reaching(channel, 1)
    }

    fn reaching(channel: &'a Channel, voxels: i32) -> Option<Self> {
        let active = channel.active_box?;
        if channel.tree.root.is_empty() {
            return None;
        }
        // Interpolation reaches one voxel beyond the box on both sides.
        let min = active.min.saturating_sub(IVec3::splat(1 + voxels));
        let max = active.max.saturating_add(IVec3::splat(voxels));
        // One brick before the first, so that positions are not negative.
        let base_brick: IVec3 = (min >> 3) - 1;
        // In doubles: at the low end of index space this lies outside of 32 bits.
        let base = base_brick.as_dvec3() * 8.0;
        let inverse = channel.world_from_index.inverse();
        Some(Field {
            channel,
            blocks: BlockStore::new(&channel.tree),
            maps: [OnceLock::new(), OnceLock::new()],
            index_from_world: inverse.matrix3,
            offset: inverse.translation - base,
            base_brick,
            brick_box: [min >> 3, max >> 3],
            bounds: [min.as_dvec3() - base, max.as_dvec3() + 1.0 - base],
            is_wide: voxels > 0,
        })
    }

    /// A flat map of the field's bricks, unless they are too many.
    #[inline]
    pub(crate) fn map(&self, sight: Sight) -> Option<&BrickMap> {
        let [first, last] = self.brick_box;
        let make = || BrickMap::new(&mut Accessor::new(&self.channel.tree), sight, first, last);
        self.maps[sight as usize].get_or_init(make).as_ref()
    }

    /// A flat map of the bricks in which interpolation reaches a level.
    pub(crate) fn map_above(&self, level: f32) -> Option<BrickMap> {
        let [first, last] = self.brick_box;
        BrickMap::above(&mut Accessor::new(&self.channel.tree), level, first, last)
    }

    /// The brick whose first voxel is at a position of the walk.
    pub(crate) fn brick_at(&self, corner: Vec3) -> IVec3 {
        (corner * 0.125).as_ivec3().wrapping_add(self.base_brick)
    }

    /// The same field, to be walked by its tree.
    #[cfg(test)]
    pub(crate) fn without_map(self) -> Self {
        Field { maps: [OnceLock::from(None), OnceLock::from(None)], ..self }
    }

    /// The tree of the channel.
    #[inline(always)]
    pub(crate) fn tree(&self) -> &'a Tree {
        &self.channel.tree
    }

    /// The voxel whose place is a position of the walk.
    pub(crate) fn voxel_at(&self, place: Vec3) -> IVec3 {
        place.as_ivec3().wrapping_add(self.base_brick << 3)
    }

    /// The first voxel of the active box, and its size.
    pub(crate) fn voxel_box(&self) -> [DVec3; 2] {
        let reach = f64::from(u8::from(self.is_wide));
        let size = self.bounds[1] - self.bounds[0] - 1.0 - 2.0 * reach;
        [self.bounds[0] + 1.0 + reach + self.base_brick.as_dvec3() * 8.0, size]
    }

    /// The corners, in the world, of the box of all voxels other than zero.
    pub(crate) fn world_corners(&self) -> [DVec3; 8] {
        let [first, size] = self.voxel_box();
        std::array::from_fn(|i| {
            let corner = DVec3::new((i >> 2) as f64, (i >> 1 & 1) as f64, (i & 1) as f64);
            self.channel.world_from_index.transform_point3(first - 0.5 + corner * size)
        })
    }

    /// What a thread needs to read the field.
    pub fn reader(&self) -> Reader<'a> {
        Reader {
            walker: Accessor::new(&self.channel.tree),
            shadow_walker: Accessor::new(&self.channel.tree),
            blocks: Blocks::new(&self.channel.tree, &self.blocks),
        }
    }

    /// What takes directions of the world to positions of the walk, where the world's origin is there, and between what positions
    /// samples can be other than zero.
    pub(crate) fn placement(&self) -> (DMat3, DVec3, [DVec3; 2]) {
        (self.index_from_world, self.offset, self.bounds)
    }

    /// Where a ray enters and leaves the field, as distances from its origin.
    pub fn interval(&self, ray: &Ray) -> Option<[f64; 2]> {
        self.enter(ray, 0.0).map(|entered| entered.interval)
    }

    /// A ray, moved by as many voxels along each axis, where it is in the field.
    #[inline(always)]
    pub(crate) fn enter(&self, ray: &Ray, shift_voxels: f64) -> Option<Entered> {
        let origin = self.index_from_world * ray.origin + self.offset + shift_voxels;
        let direction = self.index_from_world * ray.direction;
        let inverse = direction.recip();
        let (low, high) = ((self.bounds[0] - origin) * inverse, (self.bounds[1] - origin) * inverse);
        let (near, far) = (low.min(high), low.max(high));
        let [mut t0, mut t1] = [0.0f64, f64::INFINITY];
        for axis in 0..3 {
            if direction[axis] == 0.0 {
                if origin[axis] < self.bounds[0][axis] || origin[axis] > self.bounds[1][axis] {
                    return None;
                }
                continue;
            }
            t0 = if near[axis] > t0 { near[axis] } else { t0 };
            t1 = if far[axis] < t1 { far[axis] } else { t1 };
        }
        (t0 < t1).then_some(Entered { origin, direction, interval: [t0, t1] })
    }

    /// The ray in positions of this field, with t = 0 moved to the distance `start`.
    pub fn local(&self, ray: &Ray, start: f64) -> LocalRay {
        let origin = self.index_from_world * (ray.origin + ray.direction * start) + self.offset;
        LocalRay::new(origin.as_vec3(), (self.index_from_world * ray.direction).as_vec3())
    }

    /// Takes directions of the world to positions of this field.
    pub fn directions(&self) -> Mat3 {
        self.index_from_world.as_mat3()
    }

    /// Where a ray that starts inside leaves the field.
    #[inline]
    pub fn exit(&self, ray: &LocalRay) -> f32 {
        let far =
            Vec3::select(ray.direction.cmpge(Vec3::ZERO), self.bounds[1].as_vec3(), self.bounds[0].as_vec3());
        let t = (far - ray.origin) * ray.inverse;
        // An axis along which nothing moves, be its zero negative, never comes first.
        let t = Vec3::select(ray.direction.cmpeq(Vec3::ZERO), Vec3::INFINITY, t);
        f32::INFINITY.min(t.x).min(t.y).min(t.z)
    }

    /// The value at a position.
    #[inline]
    pub fn sample(&self, blocks: &mut Blocks<'a>, position: Vec3) -> f32 {
        // Adding 2^23 to a number that is smaller and not negative rounds it to an integer that stands in the
        // low bits: cheaper than a conversion that must saturate. An integer position may round to the cell
        // before it, whose far corner it then is.
        const SHIFT: f32 = 8_388_608.0;
        let shifted = (position - 0.5) + SHIFT;
        let integer = |x: f32| (x.to_bits() & 0x007f_ffff) as i32;
        let cell = IVec3::new(integer(shifted.x), integer(shifted.y), integer(shifted.z));
        let fraction = position - (shifted - SHIFT);
        blocks.trilinear_in_cell(cell.wrapping_add(self.base_brick << 3), fraction)
    }

    /// The value at a place in the world, read without decoding a brick.
    pub(crate) fn value_at(&self, reader: &mut Accessor<'a>, p_world: DVec3) -> f32 {
        let position = self.index_from_world * p_world + self.offset;
        if position.cmplt(self.bounds[0]).any() || !position.cmple(self.bounds[1]).all() {
            return 0.0;
        }
        let cell = position.floor();
        let index = cell.as_ivec3().wrapping_add(self.base_brick << 3);
        reader.trilinear_in_cell(index, (position - cell).as_vec3())
    }

    /// The runs of a ray between `t0` and `t1`, both inside the field.
    pub fn runs<'r>(&self, accessor: &'r mut Accessor<'a>, ray: LocalRay, t0: f32, t1: f32) -> Runs<'r, 'a> {
        let position = (ray.origin + ray.direction * t0) * 0.125;
        let brick = IVec3::new(floor(position.x), floor(position.y), floor(position.z));
        let forward = ray.direction.cmpge(Vec3::ZERO);
        let mut runs = Runs {
            accessor,
            ray,
            base_brick: self.base_brick,
            brick_box: self.brick_box,
            brick: brick.wrapping_add(self.base_brick).clamp(self.brick_box[0], self.brick_box[1]),
            t: t0,
            t_end: t1,
            t_next: Vec3::INFINITY,
            t_brick: (8.0 * ray.inverse).abs(),
            sign: IVec3::select(forward, IVec3::ONE, IVec3::NEG_ONE),
            brick_end: IVec3::select(forward, self.brick_box[1] + 1, self.brick_box[0] - 1),
            root_leaps_left: MAX_ROOT_LEAPS,
            is_wide: self.is_wide,
            waiting: [Run { t0, t1, kind: RunKind::Varying }; 3],
            waiting_count: 0,
        };
        runs.aim();
        runs
    }
}

impl Entered {
    /// The ray in positions of the field, with t = 0 moved to the distance `start`.
    #[inline(always)]
    pub(crate) fn local(&self, start: f64) -> LocalRay {
        LocalRay::new((self.origin + self.direction * start).as_vec3(), self.direction.as_vec3())
    }

    /// Voxels per world length.
    #[inline(always)]
    pub(crate) fn voxels_per_length(&self) -> f64 {
        self.direction.length()
    }
}

impl LocalRay {
    /// A ray from a position along a direction.
    #[inline]
    pub fn new(origin: Vec3, direction: Vec3) -> Self {
        LocalRay { origin, direction, inverse: direction.recip() }
    }

    /// The position at t.
    #[inline]
    pub fn at(&self, t: f32) -> Vec3 {
        self.origin + self.direction * t
    }

    /// One over the direction.
    pub(crate) fn inverse(&self) -> Vec3 {
        self.inverse
    }

    /// Where the ray enters and leaves a box; empty if it misses.
    fn box_interval(&self, low: Vec3, high: Vec3) -> [f32; 2] {
        let a = (low - self.origin) * self.inverse;
        let b = (high - self.origin) * self.inverse;
        let (near, far) = (a.min(b), a.max(b));
        // Where nothing moves along an axis, one of both is NaN or both are infinite; max() and min() pass
        // over NaN.
        let t0 = f32::NEG_INFINITY.max(near.x).max(near.y).max(near.z);
        let t1 = f32::INFINITY.min(far.x).min(far.y).min(far.z);
        [t0, t1]
    }
}

/// The largest integer not above x. `f32::floor` is a library call without SSE 4.1.
#[inline]
pub(crate) fn floor(x: f32) -> i32 {
    let i = x as i32;
    i.saturating_sub(i32::from(x < i as f32))
}

/// How often a ray may leap over cells that have no entry.
pub const MAX_ROOT_LEAPS: u32 = 4096;

/// Root tables up to this size are searched for the next cell; through larger ones a ray goes cell by cell.
pub const MAX_ROOT_LEAP: usize = 512;

/// The iterator of [`Field::runs`].
#[derive(Debug)]
pub struct Runs<'r, 'a> {
    accessor: &'r mut Accessor<'a>,
    ray: LocalRay,
    base_brick: IVec3,
    brick_box: [IVec3; 2],
    /// The brick to look at next, and where the ray enters it.
    brick: IVec3,
    t: f32,
    t_end: f32,
    /// Where the ray leaves that brick along each axis, and the distance between its faces.
    t_next: Vec3,
    t_brick: Vec3,
    /// The step to the next brick along each axis, and the first brick outside in that direction.
    sign: IVec3,
    brick_end: IVec3,
    /// Rounding must not let a ray leap between two cells for ever.
    root_leaps_left: u32,
    /// Whether bounds are those of samples that reach one voxel beyond their cell.
    is_wide: bool,
    /// Runs found and not yet given out, the last one first.
    waiting: [Run; 3],
    waiting_count: usize,
}

impl Runs<'_, '_> {
    /// The next region that is not empty, brick by brick and not joined as those of the iterator are. To be used
    /// instead of the iterator.
    #[inline]
    pub fn next_segment(&mut self) -> Option<Segment> {
        while self.t < self.t_end {
            let t0 = self.t;
            let (log2_bricks, footprint) = self.pass();
            let t1 = self.t.min(self.t_end);
            if footprint.max > 0.0 && t0 < t1 {
                return Some(Segment { t0, t1, min: footprint.min, max: footprint.max });
            }
            if footprint.max <= 0.0 && log2_bricks == LOG2_NODE5_BRICKS {
                self.leap_to_root_entry();
            }
        }
        None
    }

    /// The next brick or homogeneous part of a tile that is not empty, with the brick in which it begins. To be used instead of
    /// the iterator.
    pub(crate) fn next_brick(&mut self) -> Option<(BrickSpan, IVec3)> {
        while self.t < self.t_end {
            let (t0, brick) = (self.t, self.brick);
            let content = match self.accessor.place(brick) {
                BrickPlace::Entry(entry) => {
                    self.step_brick();
                    let bounds = self.accessor.tree().node4.footprints[entry];
                    match u32::try_from(entry) {
                        Ok(entry) if !bounds.is_constant() => SpanContent::Brick(entry),
                        _ => SpanContent::Constant(bounds.max),
                    }
                }
                BrickPlace::Zero => {
                    self.step_brick();
                    continue;
                }
                BrickPlace::Tile => self.cross_tile(),
            };
            let t1 = self.t.min(self.t_end);
            if content != SpanContent::Constant(0.0) && t0 < t1 {
                let corner = brick.wrapping_sub(self.base_brick).as_vec3() * 8.0;
                return Some((BrickSpan { t0, t1, corner, content }, brick));
            }
        }
        None
    }

    /// Moves on behind the region of the brick, and gives its size and the bounds of samples in it.
    #[inline]
    fn pass(&mut self) -> (u32, Bounds) {
        if self.is_wide {
            return (0, self.pass_wide());
        }
        let (log2_bricks, footprint) = self.accessor.footprint(self.brick);
        if log2_bricks == 0 {
            self.step_brick();
        } else {
            self.leap(log2_bricks);
        }
        (log2_bricks, footprint)
    }

    /// The same for samples that reach one voxel further: bounds are those of the bricks around as well, and of a larger region
    /// only the bricks inside, all around which it is the same, are passed at once.
    fn pass_wide(&mut self) -> Bounds {
        let (log2_bricks, footprint) = self.accessor.footprint(self.brick);
        if log2_bricks > 0 && footprint.is_constant() {
            let (origin, last) = extent(self.brick, log2_bricks);
            let (origin, last) = (origin + 1, last - 1);
            if self.brick.cmpge(origin).all() && self.brick.cmple(last).all() {
                self.leap_over(origin, last);
                return footprint;
            }
        }
        let mut bounds = footprint;
        for i in 0..27 {
            let step = IVec3::new(i / 9, i / 3 % 3, i % 3) - 1;
            bounds = bounds.union(self.accessor.footprint(self.brick.wrapping_add(step)).1);
        }
        self.step_brick();
        bounds
    }

    /// What the voxels of a brick are.
    pub(crate) fn voxels_of(&mut self, brick: IVec3) -> SpanContent {
        voxels_of(self.accessor, brick)
    }

    /// Moves on through a tile as far as it has one value, or by one brick of the layer that blends with the neighbours.
    fn cross_tile(&mut self) -> SpanContent {
        let region = self.accessor.region(self.brick);
        let (origin, last) = extent(self.brick, region.log2_bricks);
        if region.footprint.is_constant() {
            self.leap_over(origin, last);
            if region.footprint.max == 0.0 && region.log2_bricks == LOG2_NODE5_BRICKS {
                self.leap_to_root_entry();
            }
            return SpanContent::Constant(region.footprint.max);
        }
        match region.content {
            Content::Constant(value) if self.brick.cmplt(last).all() => {
                self.leap_over(origin, last - 1);
                SpanContent::Constant(value)
            }
            _ => {
                self.step_brick();
                SpanContent::TileBorder
            }
        }
    }

    /// Moves on to the next brick.
    #[inline]
    fn step_brick(&mut self) {
        let Vec3 { x, y, z } = self.t_next;
        // Written out per axis: indexing by a variable takes vectors through memory.
        let (t, outside) = if x <= y && x <= z {
            self.t_next.x += self.t_brick.x;
            self.brick.x += self.sign.x;
            (x, self.brick.x == self.brick_end.x)
        } else if y <= z {
            self.t_next.y += self.t_brick.y;
            self.brick.y += self.sign.y;
            (y, self.brick.y == self.brick_end.y)
        } else {
            self.t_next.z += self.t_brick.z;
            self.brick.z += self.sign.z;
            (z, self.brick.z == self.brick_end.z)
        };
        self.t = self.t.max(t);
        if outside {
            self.t_end = self.t_end.min(self.t);
        }
    }

    /// Moves on to where the ray leaves a region of more than one brick, and to the brick behind.
    fn leap(&mut self, log2_bricks: u32) {
        let (origin, last) = extent(self.brick, log2_bricks);
        self.leap_over(origin, last);
    }

    /// Moves on to where the ray leaves a box of bricks, first and last, and to the brick behind.
    fn leap_over(&mut self, origin: IVec3, last: IVec3) {
        let forward = self.ray.direction.cmpge(Vec3::ZERO);
        let faces = IVec3::select(forward, last + 1, origin);
        let t = self.faces_at(faces);
        let axis = t.min_position();
        self.t = self.t.max(t[axis]);
        let position = self.ray.at(self.t) * 0.125;
        let brick = IVec3::new(floor(position.x), floor(position.y), floor(position.z));
        // Rounding may put an entry point just outside the box; only the axis of the exit may leave it.
        let [box_first, box_last] = self.brick_box;
        self.brick = brick.wrapping_add(self.base_brick).clamp(origin.max(box_first), last.min(box_last));
        // The axis of the exit moves by the integers, so that the walk never stands still.
        self.brick[axis] = if forward.test(axis) { last[axis] + 1 } else { origin[axis] - 1 };
        let inside = self.brick.cmpge(box_first).all() && self.brick.cmple(box_last).all();
        if !inside {
            self.t_end = self.t_end.min(self.t);
        }
        self.aim();
    }

    /// Moves on to the next cell of the root table that has an entry, over all cells that have none: between
    /// the parts of a scattered volume there may be a million of them.
    fn leap_to_root_entry(&mut self) {
        let root = &self.accessor.tree().root;
        if root.len() > MAX_ROOT_LEAP || self.root_leaps_left == 0 {
            return;
        }
        self.root_leaps_left -= 1;
        let mut next: Option<(f32, IVec3)> = None;
        for entry in root {
            let first = entry.cell << LOG2_NODE5_BRICKS;
            let position = |brick: IVec3| (brick - self.base_brick).as_vec3() * 8.0;
            let [t0, t1] = self.ray.box_interval(position(first), position(first + 512));
            let t0 = t0.max(self.t);
            if t0 < t1 && next.is_none_or(|(t, _)| t0 < t) {
                next = Some((t0, first));
            }
        }
        let Some((t, first)) = next else {
            self.t_end = self.t_end.min(self.t);
            return;
        };
        self.t = t;
        let position = self.ray.at(t) * 0.125;
        let brick = IVec3::new(floor(position.x), floor(position.y), floor(position.z));
        let [box_first, box_last] = self.brick_box;
        let (first, last) = (first.max(box_first), (first + 511).min(box_last));
        if first.cmpgt(last).any() {
            return;
        }
        self.brick = brick.wrapping_add(self.base_brick).clamp(first, last);
        self.aim();
    }

    /// Finds where the ray leaves the brick it is in.
    fn aim(&mut self) {
        let forward = self.ray.direction.cmpge(Vec3::ZERO);
        self.t_next = self.faces_at(IVec3::select(forward, self.brick + 1, self.brick));
    }

    /// Where the ray crosses the low faces of a brick; never, along an axis along which nothing moves.
    fn faces_at(&self, brick: IVec3) -> Vec3 {
        let t = ((brick - self.base_brick).as_vec3() * 8.0 - self.ray.origin) * self.ray.inverse;
        Vec3::select(self.ray.direction.cmpeq(Vec3::ZERO), Vec3::INFINITY, t)
    }

    /// Cuts the stretch of a large tile at its homogeneous part.
    fn split_tile(&mut self, brick: IVec3, t0: f32, t1: f32) {
        let region = self.accessor.region(brick);
        let (origin, last) = extent(brick, region.log2_bricks);
        let value = match region.content {
            Content::Constant(value) => value,
            // Only bricks are not constant, and they are no tiles.
            Content::Brick(_) => 0.0,
        };
        let position = |brick: IVec3| (brick - self.base_brick).as_vec3() * 8.0;
        let [a, b] = self.ray.box_interval(position(origin), position(last + 1) - 1.0);
        // A ray that misses the homogeneous part has its whole stretch in the layer.
        let (a, b) = if a < b { (a.clamp(t0, t1), b.clamp(t0, t1)) } else { (t1, t1) };
        let layer = |t0, t1| Run { t0, t1, kind: RunKind::Varying };
        let core = Run { t0: a, t1: b, kind: RunKind::Constant(value) };
        for run in [layer(b, t1), core, layer(t0, a)] {
            if run.t0 < run.t1 && run.kind != RunKind::Constant(0.0) {
                self.wait(run);
            }
        }
    }

    /// Keeps a run until those before it are given out.
    fn wait(&mut self, run: Run) {
        self.waiting[self.waiting_count] = run;
        self.waiting_count += 1;
    }
}

/// The first and last brick of the aligned cube around a brick.
fn extent(brick: IVec3, log2_bricks: u32) -> (IVec3, IVec3) {
    let bricks = 1 << log2_bricks;
    let origin = brick & !(bricks - 1);
    (origin, origin + (bricks - 1))
}

impl Iterator for Runs<'_, '_> {
    type Item = Run;

    /// Varying bricks that touch come as one run.
    fn next(&mut self) -> Option<Run> {
        if self.waiting_count > 0 {
            self.waiting_count -= 1;
            return Some(self.waiting[self.waiting_count]);
        }
        let mut varying: Option<Run> = None;
        while self.t < self.t_end {
            let (t0, brick) = (self.t, self.brick);
            let (log2_bricks, footprint) = self.pass();
            let t1 = self.t.min(self.t_end);
            if t0 >= t1 {
                continue;
            }
            if footprint.is_constant() {
                if footprint.max == 0.0 {
                    if log2_bricks == LOG2_NODE5_BRICKS {
                        self.leap_to_root_entry();
                    }
                    if varying.is_some() {
                        break;
                    }
                    continue;
                }
                self.wait(Run { t0, t1, kind: RunKind::Constant(footprint.max) });
            } else if log2_bricks == 0 {
                varying = Some(Run { t0: varying.map_or(t0, |run| run.t0), t1, kind: RunKind::Varying });
                continue;
            } else {
                self.split_tile(brick, t0, t1);
            }
            if varying.is_some() || self.waiting_count > 0 {
                break;
            }
        }
        varying.or_else(|| {
            self.waiting_count = self.waiting_count.checked_sub(1)?;
            Some(self.waiting[self.waiting_count])
        })
    }
}
