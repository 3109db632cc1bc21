//! The walk of a ray over a flat map of bricks: what [`Runs`] does through the tree, for kernels in which the walk is most
//! of the work.
//!
//! A [`BrickMap`] says for each brick of a field's box which entry it has, or how many bricks around it are empty (Cohen &
//! Sheffer, "Proximity Clouds – an Acceleration Technique for 3D Grid Traversal", 1994). A field whose box is too large for one
//! is walked by its tree; both give the same [`BrickSpan`]s.

use fearless_simd::{Simd, f32x4, i32x4, mask32x4, prelude::*};
use glam::{IVec3, Vec3};
use nuage_volume::accessor::{Accessor, BrickPlace};
use nuage_volume::brick::Bounds;
use nuage_volume::tree::Content;

use crate::traverse::{Field, LocalRay, Runs, floor};

/// The most bricks of a map: 16 MiB.
const MOST_CELLS: i64 = 1 << 22;

/// A ray leaps where this many layers of bricks around it are empty; where there are fewer, steps are faster.
const LEAST_LEAP: u32 = 5;

/// Cells of a map from here on have no entry to be read.
const NO_ENTRY: u32 = 0xffff_fe00;
/// The brick has one value other than zero, or lies in a tile.
const SPECIAL: u32 = 0xffff_fe00;
/// The brick is empty, as are all those less than `cell - EMPTY` away along each axis.
const EMPTY: u32 = 0xffff_ff00;
/// The furthest that is told of an empty brick.
const FURTHEST: u8 = 255;

/// What a stretch of a ray through one brick, or through more of one value, holds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum SpanContent {
    /// One value.
    Constant(f32),
    /// The brick of this entry.
    Entry(u32),
    /// A brick of a tile that blends with the tile's neighbours.
    TileBorder,
}

/// A stretch of a ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct BrickSpan {
    /// Where it begins.
    pub(crate) t0: f32,
    /// Where it ends.
    pub(crate) t1: f32,
    /// The first voxel of the brick in which it begins, as a position of the walk.
    pub(crate) corner: Vec3,
    /// What is there.
    pub(crate) content: SpanContent,
}

/// Does something with the spans of a ray through a field: by its map of bricks if it has one, else by the tree.
///
/// A macro, so that the loop is made for each of the two and inlined where the vector instructions are known.
macro_rules! with_spans {
    ($simd:expr, $field:expr, $walker:expr, $local:expr, $length:expr, |$spans:ident| $work:expr) => {
        match $field.map() {
            Some(map) => {
                let $spans = crate::walk::MapWalk::new($simd, map, $field, $walker, $local, 0.0, $length);
                $work
            }
            None => {
                let $spans = $field.runs($walker, $local, 0.0, $length);
                $work
            }
        }
    };
}
pub(crate) use with_spans;

/// Yields the stretches of a ray that are not empty, in order.
pub(crate) trait Spans {
    /// The next one.
    fn next_span(&mut self) -> Option<BrickSpan>;
}

impl Spans for Runs<'_, '_> {
    #[inline(always)]
    fn next_span(&mut self) -> Option<BrickSpan> {
        self.next_brick()
    }
}

/// What stands in each brick of a box.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct BrickMap {
    /// By `(x * size.y + y) * size.z + z`, with a layer of empty bricks all around.
    cells: Box<[u32]>,
    size: IVec3,
}

impl BrickMap {
    /// The map of the bricks from `first` to `last`. `None` if there are too many.
    pub(crate) fn new(accessor: &mut Accessor<'_>, first: IVec3, last: IVec3) -> Option<BrickMap> {
        let size = last.as_i64vec3() - first.as_i64vec3() + 3;
        // Each axis by itself first, so that the product does not overflow.
        if size.max_element() > MOST_CELLS || size.element_product() > MOST_CELLS {
            return None;
        }
        let size = size.as_ivec3();
        let mut distances = vec![FURTHEST; size.element_product() as usize];
        let mut cells = vec![EMPTY; distances.len()];
        for x in 1..size.x - 1 {
            for y in 1..size.y - 1 {
                for z in 1..size.z - 1 {
                    let cell = cell_of(accessor, first + IVec3::new(x, y, z) - 1);
                    let at = ((x * size.y + y) * size.z + z) as usize;
                    cells[at] = cell;
                    if cell < EMPTY {
                        distances[at] = 0;
                    }
                }
            }
        }
        chessboard_distances(&mut distances, size);
        for (cell, distance) in cells.iter_mut().zip(distances) {
            if *cell == EMPTY {
                *cell = EMPTY | u32::from(distance);
            }
        }
        Some(BrickMap { cells: cells.into(), size })
    }

    /// How far apart neighbours along each axis are.
    fn strides(&self) -> IVec3 {
        IVec3::new(self.size.y * self.size.z, self.size.z, 1)
    }
}

/// What a map says of a brick.
fn cell_of(accessor: &mut Accessor<'_>, brick: IVec3) -> u32 {
    let (bounds, entry) = match accessor.place(brick) {
        BrickPlace::Entry(entry) => (accessor.tree().node4.footprints[entry], Some(entry)),
        BrickPlace::Zero => return EMPTY,
        BrickPlace::Tile => (accessor.footprint(brick).1, None),
    };
    match entry {
        _ if bounds == Bounds::of(0.0) => EMPTY,
        Some(entry) if !bounds.is_constant() && (entry as u64) < u64::from(NO_ENTRY) => entry as u32,
        _ => SPECIAL,
    }
}

/// Turns zeros and large numbers into the distance from the nearest zero, as a king goes on a chessboard.
fn chessboard_distances(distances: &mut [u8], size: IVec3) {
    let (row, slice) = (size.z as usize, (size.y * size.z) as usize);
    // One axis after another: what a step along the axis adds is at most 1, and steps along several axes are one. So each axis
    // takes the maximum of its own way and that of the axes before, least over all starts; a window that grows finds it.
    let mut sweep = |stride: usize, length: usize, first_of: &dyn Fn(usize) -> usize, lines: usize| {
        let mut line = vec![0; length];
        for first in (0..lines).map(first_of) {
            for (i, value) in line.iter_mut().enumerate() {
                *value = distances[first + i * stride];
            }
            for i in 0..length {
                let mut best = line[i];
                let mut away = 1;
                while away < usize::from(best) && away < length {
                    let before = if i >= away { line[i - away] } else { FURTHEST };
                    let behind = line.get(i + away).copied().unwrap_or(FURTHEST);
                    best = best.min(before.min(behind).max(away as u8));
                    away += 1;
                }
                distances[first + i * stride] = best;
            }
        }
    };
    let [x, y, z] = size.to_array().map(|n| n as usize);
    sweep(1, z, &|line| line * row, x * y);
    sweep(row, y, &|line| line / z * slice + line % z, x * z);
    sweep(slice, x, &|line| line, y * z);
}

/// The faces of a lattice that a ray is about to cross, one for each axis.
pub(crate) struct Faces<S: Simd> {
    /// Where the ray crosses them; the last lane is never.
    next: f32x4<S>,
    /// From face to face.
    spacing: f32x4<S>,
}

impl<S: Simd> Faces<S> {
    #[inline(always)]
    pub(crate) fn new(simd: S, next: [f32; 3], spacing: Vec3) -> Self {
        let spacing = [spacing.x, spacing.y, spacing.z, 0.0];
        Faces { next: Self::lanes(simd, next), spacing: f32x4::simd_from(simd, spacing) }
    }

    #[inline(always)]
    fn lanes(simd: S, [x, y, z]: [f32; 3]) -> f32x4<S> {
        f32x4::simd_from(simd, [x, y, z, f32::INFINITY])
    }

    /// Goes through the nearest face, or through several that meet in an edge. Returns where, and along which axes.
    #[inline(always)]
    pub(crate) fn pass(&mut self) -> (f32, mask32x4<S>) {
        // Floats that are not negative are ordered as their bits are, and integers take fewer cycles.
        let bits = self.next.bitcast::<i32x4<S>>();
        let nearest = bits.min(bits.rotate_elements_left::<1>());
        let nearest = nearest.min(nearest.rotate_elements_left::<2>());
        let axes = bits.simd_eq(nearest);
        self.next = axes.select(self.next + self.spacing, self.next);
        (f32::from_bits(nearest[0] as u32), axes)
    }
}

/// A ray on its way through a [`BrickMap`].
pub(crate) struct MapWalk<'w, 'a, S: Simd> {
    simd: S,
    map: &'w BrickMap,
    field: &'w Field<'a>,
    accessor: &'w mut Accessor<'a>,
    ray: LocalRay,
    t: f32,
    t_end: f32,
    faces: Faces<S>,
    /// The first voxel of the brick.
    corner: f32x4<S>,
    corner_step: f32x4<S>,
    /// The place of the brick in the map: what each axis adds to it, and from brick to brick.
    cell: i32x4<S>,
    stride: i32x4<S>,
}

/// Where a walk stands.
#[derive(Clone, Copy)]
struct Place {
    next: [f32; 3],
    corner: [f32; 4],
    cell: [i32; 4],
}

impl<'w, 'a, S: Simd> MapWalk<'w, 'a, S> {
    /// The walk of a ray between `t0` and `t1`, both inside the field.
    #[inline(always)]
    pub(crate) fn new(
        simd: S,
        map: &'w BrickMap,
        field: &'w Field<'a>,
        accessor: &'w mut Accessor<'a>,
        ray: LocalRay,
        t0: f32,
        t1: f32,
    ) -> Self {
        let position = ray.at(t0) * 0.125;
        let brick = IVec3::new(floor(position.x), floor(position.y), floor(position.z));
        let place = Place::of(map, &ray, brick.clamp(IVec3::ONE, map.size - 2));
        let sign = IVec3::select(ray.direction.cmpge(Vec3::ZERO), IVec3::ONE, IVec3::NEG_ONE);
        let stride = map.strides() * sign;
        let [x, y, z] = (8.0 * sign.as_vec3()).to_array();
        MapWalk {
            simd,
            map,
            field,
            accessor,
            ray,
            t: t0,
            t_end: t1,
            faces: Faces::new(simd, place.next, (8.0 * ray.inverse()).abs()),
            corner: f32x4::simd_from(simd, place.corner),
            corner_step: f32x4::simd_from(simd, [x, y, z, 0.0]),
            cell: i32x4::simd_from(simd, place.cell),
            stride: i32x4::simd_from(simd, [stride.x, stride.y, stride.z, 0]),
        }
    }

    /// Moves on to the next brick, or diagonally through an edge.
    #[inline(always)]
    fn step(&mut self) {
        let (t, axes) = self.faces.pass();
        self.corner += axes.select(self.corner_step, f32x4::splat(self.simd, 0.0));
        self.cell += axes.select(self.stride, i32x4::splat(self.simd, 0));
        self.t = if t > self.t { t } else { self.t };
    }

    /// Moves on to where the ray leaves the bricks that are at most `reach` away.
    #[inline(always)]
    fn leap(&mut self, reach: [IVec3; 2]) {
        // A copy: what a call might change through a reference, the compiler keeps in memory.
        let ray = self.ray;
        let (t, place) = Place::behind(self.map, &ray, self.corner.to_array(), reach);
        self.t = if t > self.t { t } else { self.t };
        self.faces.next = Faces::lanes(self.simd, place.next);
        self.corner = f32x4::simd_from(self.simd, place.corner);
        self.cell = i32x4::simd_from(self.simd, place.cell);
    }

    /// What the map says of the brick.
    #[inline(always)]
    fn read(&self) -> Option<u32> {
        let pairs = self.cell + self.cell.rotate_elements_left::<1>();
        let all = pairs + pairs.rotate_elements_left::<2>();
        self.map.cells.get(all[0] as usize).copied()
    }
}

impl Place {
    #[inline(always)]
    fn of(map: &BrickMap, ray: &LocalRay, brick: IVec3) -> Place {
        let corner = brick.as_vec3() * 8.0;
        let far = Vec3::select(ray.direction.cmpge(Vec3::ZERO), corner + 8.0, corner);
        let t = (far - ray.origin) * ray.inverse();
        let t = Vec3::select(ray.direction.cmpeq(Vec3::ZERO), Vec3::INFINITY, t);
        let cell = brick * map.strides();
        Place {
            next: t.to_array(),
            corner: [corner.x, corner.y, corner.z, 0.0],
            cell: [cell.x, cell.y, cell.z, 0],
        }
    }

    /// Where a ray leaves a box of bricks around the one at a corner, how many below and above it, and the brick behind.
    #[inline(never)]
    fn behind(map: &BrickMap, ray: &LocalRay, corner: [f32; 4], [below, above]: [IVec3; 2]) -> (f32, Place) {
        let brick = (Vec3::new(corner[0], corner[1], corner[2]) * 0.125).as_ivec3();
        let (low, high) = (brick - below, brick + above);
        let forward = ray.direction.cmpge(Vec3::ZERO);
        let faces = IVec3::select(forward, high + 1, low).as_vec3() * 8.0;
        let t = (faces - ray.origin) * ray.inverse();
        let t = Vec3::select(ray.direction.cmpeq(Vec3::ZERO), Vec3::INFINITY, t);
        let axis = t.min_position();
        let position = ray.at(t[axis]) * 0.125;
        let behind = IVec3::new(floor(position.x), floor(position.y), floor(position.z));
        let mut behind = behind.clamp(low, high);
        // The axis of the exit moves by the integers, so that the walk never stands still.
        behind[axis] = if forward.test(axis) { high[axis] + 1 } else { low[axis] - 1 };
        // Beyond the box lies nothing, and the walk ends where the field does.
        let inside = behind.cmpge(IVec3::ZERO).all() && behind.cmplt(map.size).all();
        match inside {
            true => (t[axis], Place::of(map, ray, behind)),
            false => (f32::INFINITY, Place::of(map, ray, IVec3::ZERO)),
        }
    }
}

impl<S: Simd> Spans for MapWalk<'_, '_, S> {
    #[inline(always)]
    fn next_span(&mut self) -> Option<BrickSpan> {
        while self.t < self.t_end {
            let (t0, corner) = (self.t, self.corner);
            let cell = self.read()?;
            if cell >= EMPTY {
                let distance = cell - EMPTY;
                match distance >= LEAST_LEAP {
                    true => self.leap([IVec3::splat(distance as i32 - 1); 2]),
                    false => self.step(),
                }
                continue;
            }
            let mut content = SpanContent::Entry(cell);
            if cell >= NO_ENTRY {
                let [x, y, z, _] = corner.to_array();
                let (special, reach) = special(self.field, self.accessor, Vec3::new(x, y, z));
                content = special;
                self.leap(reach);
            } else {
                self.step();
            }
            let t1 = if self.t < self.t_end { self.t } else { self.t_end };
            if t0 < t1 {
                let [x, y, z, _] = corner.to_array();
                return Some(BrickSpan { t0, t1, corner: Vec3::new(x, y, z), content });
            }
        }
        None
    }
}

/// What a brick without an entry to be read holds, and how many bricks below and above it hold the same.
#[inline(never)]
fn special(field: &Field<'_>, accessor: &mut Accessor<'_>, corner: Vec3) -> (SpanContent, [IVec3; 2]) {
    let brick = field.brick_at(corner);
    let single = [IVec3::ZERO; 2];
    if let BrickPlace::Entry(entry) = accessor.place(brick) {
        return (SpanContent::Constant(accessor.tree().node4.footprints[entry].max), single);
    }
    let region = accessor.region(brick);
    let bricks = 1 << region.log2_bricks;
    let local = brick & (bricks - 1);
    let (below, above) = (local, bricks - 1 - local);
    match region.content {
        _ if region.footprint.is_constant() => (SpanContent::Constant(region.footprint.max), [below, above]),
        Content::Constant(value) if above.cmpgt(IVec3::ZERO).all() => {
            (SpanContent::Constant(value), [below, above - 1])
        }
        _ => (SpanContent::TileBorder, single),
    }
}
