//! The walk of a ray over a flat map of bricks: what [`Runs`] does through the tree, for kernels in which the walk is most
//! of the work.
//!
//! A ray crosses at most one face along each of its two slower axes while it goes from one lattice plane of its fastest axis to
//! the next. So it falls into [`Slabs`] of at most three stretches that do not depend on each other, and eight slabs are
//! done at once: layers of bricks here, voxels in [`depth`](crate::depth).
//!
//! A [`BrickMap`] says for each brick of a field's box what it holds, or how many bricks around it are empty (Cohen &
//! Sheffer, "Proximity Clouds – an Acceleration Technique for 3D Grid Traversal", 1994). A field whose box is too large for one
//! is walked by its tree; both give the same [`BrickSpan`]s.

use fearless_simd::{Simd, f32x8, i32x8, prelude::*};
use glam::{IVec3, Vec3};
use nuage_volume::accessor::{Accessor, BrickPlace};
use nuage_volume::tree::Content;

use crate::simd::each_lane;
use crate::traverse::{LocalRay, Runs, floor};

/// The most bricks of a map: 16 MiB.
const MOST_CELLS: i64 = 1 << 22;

/// The most bricks along an axis: four million voxels.
const MOST_ALONG: i64 = 1 << 19;

/// A ray leaps where it is this far from bricks that are not empty.
const LEAST_LEAP: i32 = 4;

/// The cell of a map whose brick is part of a tile and blends with the tile's neighbours.
pub(crate) const BORDER: i32 = SPECIAL - 1;

/// Cells of a map from here on have one value each.
pub(crate) const SPECIAL: i32 = 1 << 30;

/// The furthest that is told of an empty brick.
const FURTHEST: u8 = 255;

/// What a stretch of a ray through one brick, or through more of one value, holds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum SpanContent {
    /// One value.
    Constant(f32),
    /// The brick of this entry; on a walk over voxels, the brick of this number.
    Brick(u32),
    /// A brick of a tile that blends with the tile's neighbours. Does not occur on a walk over voxels.
    TileBorder,
}

/// What a ray looks for in bricks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Sight {
    /// Cells between voxels, which reach into the next bricks.
    Cells,
    /// The voxels of each brick by themselves.
    Voxels,
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
    ($simd:expr, $sight:expr, $field:expr, $walker:expr, $ray:expr, $length:expr, |$spans:ident| $work:expr) => {
        match $field.map($sight) {
            Some(map) => {
                let $spans = crate::walk::MapWalk::new($simd, map, $ray, $length);
                $work
            }
            None => {
                let runs = $field.runs($walker, $ray.local, 0.0, $length);
                let $spans = crate::walk::TreeWalk { runs, sight: $sight };
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

/// The spans of a ray by its tree.
pub(crate) struct TreeWalk<'r, 'a> {
    pub(crate) runs: Runs<'r, 'a>,
    pub(crate) sight: Sight,
}

impl Spans for TreeWalk<'_, '_> {
    #[inline(always)]
    fn next_span(&mut self) -> Option<BrickSpan> {
        loop {
            let (span, brick) = self.runs.next_brick()?;
            if self.sight == Sight::Cells {
                return Some(span);
            }
            let content = match span.content {
                // Where interpolation sees one value, voxels have no other.
                SpanContent::Constant(value) => SpanContent::Constant(value),
                _ => self.runs.voxels_of(brick),
            };
            if content != SpanContent::Constant(0.0) {
                return Some(BrickSpan { content, ..span });
            }
        }
    }
}

/// What stands in each brick of a box.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct BrickMap {
    /// By `(x * size.y + y) * size.z + z`, with a layer of empty bricks all around. Below 0 the brick is empty, as are all those
    /// less than `-cell` away along each axis. From [`SPECIAL`] on it is the index of a constant; else that of a brick, or
    /// [`BORDER`].
    cells: Box<[i32]>,
    size: IVec3,
    constants: Vec<f32>,
    /// By cell, the largest value that interpolation finds there; below 0 what the cell is. Of cells between voxels alone.
    tops: Box<[f32]>,
}

impl BrickMap {
    /// The map of the bricks from `first` to `last`. `None` if there are too many.
    pub(crate) fn new(
        accessor: &mut Accessor<'_>,
        sight: Sight,
        first: IVec3,
        last: IVec3,
    ) -> Option<BrickMap> {
        // Places of voxels are whole numbers of 31 bits.
        if accessor.tree().bricks.len() as i64 > MOST_CELLS {
            return None;
        }
        let mut map = match sight {
            Sight::Cells => BrickMap::of(first, last, |brick| cells_of(accessor, brick)),
            Sight::Voxels => return BrickMap::of(first, last, |brick| voxels_of(accessor, brick)),
        }?;
        let tops = (0..).zip(&map.cells).map(|(at, cell)| match *cell {
            distance @ ..0 => distance as f32,
            special @ SPECIAL.. => map.constant(special),
            BORDER => accessor.region(first + map.brick(at)).footprint.max,
            entry => accessor.tree().node4.footprints[entry as usize].max,
        });
        map.tops = tops.collect();
        Some(map)
    }

    /// The map of the bricks in which interpolation reaches a level.
    pub(crate) fn above(
        accessor: &mut Accessor<'_>,
        level: f32,
        first: IVec3,
        last: IVec3,
    ) -> Option<BrickMap> {
        BrickMap::of(first, last, |brick| match cells_of(accessor, brick) {
            SpanContent::Constant(value) if value < level => SpanContent::Constant(0.0),
            SpanContent::Brick(entry) if accessor.tree().node4.footprints[entry as usize].max < level => {
                SpanContent::Constant(0.0)
            }
            content => content,
        })
    }

    /// The map of what is in the bricks from `first` to `last`.
    fn of(first: IVec3, last: IVec3, mut content_of: impl FnMut(IVec3) -> SpanContent) -> Option<BrickMap> {
        let size = last.as_i64vec3() - first.as_i64vec3() + 3;
        // Each axis by itself first, so that the product does not overflow and voxels can be told apart in single precision.
        if size.max_element() > MOST_ALONG || size.element_product() > MOST_CELLS {
            return None;
        }
        let size = size.as_ivec3();
        let mut distances = vec![FURTHEST; size.element_product() as usize];
        let mut cells = vec![0; distances.len()];
        let mut constants = Vec::new();
        for x in 1..size.x - 1 {
            for y in 1..size.y - 1 {
                for z in 1..size.z - 1 {
                    let content = content_of(first + IVec3::new(x, y, z) - 1);
                    if content == SpanContent::Constant(0.0) {
                        continue;
                    }
                    let at = ((x * size.y + y) * size.z + z) as usize;
                    distances[at] = 0;
                    cells[at] = match content {
                        SpanContent::Brick(index) if index < BORDER as u32 => index as i32,
                        SpanContent::Constant(value) => {
                            // Neighbours often hold the same. There are fewer constants than cells.
                            if constants.last() != Some(&value) {
                                constants.push(value);
                            }
                            SPECIAL + constants.len() as i32 - 1
                        }
                        // More bricks than a map has cells do not occur.
                        SpanContent::Brick(_) | SpanContent::TileBorder => BORDER,
                    };
                }
            }
        }
        chessboard_distances(&mut distances, size);
        for (cell, distance) in cells.iter_mut().zip(distances) {
            if distance > 0 {
                *cell = -i32::from(distance);
            }
        }
        Some(BrickMap { cells: cells.into(), size, constants, tops: Box::default() })
    }

    /// The brick of a cell, counted from the map's first.
    fn brick(&self, at: i32) -> IVec3 {
        let [x, y, _] = self.strides();
        IVec3::new(at / x, at % x / y, at % y) - 1
    }

    /// The value of a cell from [`SPECIAL`] on.
    fn constant(&self, cell: i32) -> f32 {
        self.constants.get((cell - SPECIAL) as usize).copied().unwrap_or(0.0)
    }

    /// How far apart neighbours along each axis are.
    pub(crate) fn strides(&self) -> [i32; 3] {
        [self.size.y * self.size.z, self.size.z, 1]
    }

    /// The values of the cells from [`SPECIAL`] on.
    #[inline(always)]
    pub(crate) fn constants(&self) -> &[f32] {
        &self.constants
    }

    /// The largest value of each cell; below 0 the cell itself, which is empty.
    #[inline(always)]
    pub(crate) fn tops(&self) -> &[f32] {
        &self.tops
    }

    /// All cells.
    #[inline(always)]
    pub(crate) fn cells(&self) -> &[i32] {
        &self.cells
    }

    #[inline(always)]
    fn cell(&self, at: i32) -> i32 {
        self.cells.get(at as usize).copied().unwrap_or(-1)
    }
}

/// What the cells hold that begin in a brick.
fn cells_of(accessor: &mut Accessor<'_>, brick: IVec3) -> SpanContent {
    match accessor.place(brick) {
        BrickPlace::Zero => SpanContent::Constant(0.0),
        BrickPlace::Entry(entry) => {
            let bounds = accessor.tree().node4.footprints[entry];
            match u32::try_from(entry) {
                Ok(entry) if !bounds.is_constant() => SpanContent::Brick(entry),
                _ => SpanContent::Constant(bounds.max),
            }
        }
        BrickPlace::Tile => {
            let region = accessor.region(brick);
            let last = (1 << region.log2_bricks) - 1;
            let is_inner = (brick & last).cmplt(IVec3::splat(last)).all();
            match region.content {
                _ if region.footprint.is_constant() => SpanContent::Constant(region.footprint.max),
                Content::Constant(value) if is_inner => SpanContent::Constant(value),
                _ => SpanContent::TileBorder,
            }
        }
    }
}

/// What the voxels of a brick are.
pub(crate) fn voxels_of(accessor: &mut Accessor<'_>, brick: IVec3) -> SpanContent {
    match accessor.region(brick).content {
        Content::Constant(value) => SpanContent::Constant(value),
        Content::Brick(number) => SpanContent::Brick(number),
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

/// A ray with its axes in another order: the one along which it is fastest, and the other two.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SortedRay {
    /// The ray as it was.
    pub(crate) local: LocalRay,
    order: Order,
    origin: [f32; 3],
    direction: [f32; 3],
    inverse: [f32; 3],
}

/// Which axis comes first; the others follow as they do in a circle.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Order {
    Xyz,
    Yzx,
    Zxy,
}

impl Order {
    /// From x, y, z to this order.
    #[inline(always)]
    pub(crate) fn sorted<T>(self, [x, y, z]: [T; 3]) -> [T; 3] {
        match self {
            Order::Xyz => [x, y, z],
            Order::Yzx => [y, z, x],
            Order::Zxy => [z, x, y],
        }
    }

    /// From this order to x, y, z.
    #[inline(always)]
    fn restored<T>(self, [a, b, c]: [T; 3]) -> [T; 3] {
        match self {
            Order::Xyz => [a, b, c],
            Order::Yzx => [c, a, b],
            Order::Zxy => [b, c, a],
        }
    }
}

impl SortedRay {
    #[inline(always)]
    pub(crate) fn new(local: LocalRay) -> SortedRay {
        let speed = local.direction.abs();
        let order = match speed.x >= speed.y && speed.x >= speed.z {
            true => Order::Xyz,
            false if speed.y >= speed.z => Order::Yzx,
            false => Order::Zxy,
        };
        SortedRay {
            local,
            order,
            origin: order.sorted(local.origin.to_array()),
            direction: order.sorted(local.direction.to_array()),
            inverse: order.sorted(local.inverse().to_array()),
        }
    }

    /// The order of its axes.
    #[inline(always)]
    pub(crate) fn order(&self) -> Order {
        self.order
    }

    /// The same in units of bricks.
    #[inline(always)]
    fn in_bricks(self) -> SortedRay {
        let ([o0, o1, o2], [d0, d1, d2], [i0, i1, i2]) = (self.origin, self.direction, self.inverse);
        SortedRay {
            origin: [o0 * 0.125, o1 * 0.125, o2 * 0.125],
            direction: [d0 * 0.125, d1 * 0.125, d2 * 0.125],
            inverse: [i0 * 8.0, i1 * 8.0, i2 * 8.0],
            ..self
        }
    }

    /// The same seen from another place.
    #[inline(always)]
    pub(crate) fn seen_from(&self, corner: Vec3) -> SortedRay {
        SortedRay { origin: self.order.sorted((self.local.origin - corner).to_array()), ..*self }
    }

    #[inline(always)]
    pub(crate) fn is_forward(&self) -> bool {
        self.direction[0] >= 0.0
    }
}

/// Eight slabs of a lattice in the order in which a ray goes through them.
pub(crate) struct Slabs<S: Simd> {
    /// Which slab it is along the fastest axis.
    pub(crate) number: i32x8<S>,
    /// Where the ray enters the slab, crosses a first and a second face in it, and leaves it: ascending, and the last for faces
    /// that it does not cross.
    pub(crate) t: [f32x8<S>; 4],
    /// The cells of the three stretches between, along the other two axes.
    pub(crate) across: [[i32x8<S>; 2]; 3],
}

impl<S: Simd> Slabs<S> {
    /// The slabs from `first` on, in lattice units of the ray, as far as they lie between `t0` and `t1`; cells across are held
    /// between 0 and `last`.
    #[inline(always)]
    pub(crate) fn of(simd: S, ray: &SortedRay, first: f32, [t0, t1]: [f32; 2], last: f32) -> Self {
        let lanes = f32x8::simd_from(simd, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);
        let (sign, behind) = if ray.is_forward() { (1.0, 0.0) } else { (-1.0, 1.0) };
        let number = lanes * sign + first;
        // The same numbers where slabs meet: faces are whole.
        let (enter, leave) = (number + behind, number + (behind + sign));
        let enter = ((enter - ray.origin[0]) * ray.inverse[0]).max(t0).min(t1);
        let leave = ((leave - ray.origin[0]) * ray.inverse[0]).max(t0).min(t1);
        let (u0, u1, t_u) = Self::cross(ray, 1, enter, leave, last);
        let (v0, v1, t_v) = Self::cross(ray, 2, enter, leave, last);
        let u_first = t_u.simd_lt(t_v);
        let between = [u_first.select(u1, u0), u_first.select(v0, v1)];
        Slabs {
            number: number.to_int(),
            t: [enter, t_u.min(t_v), t_u.max(t_v), leave],
            across: [[u0, v0], between, [u1, v1]],
        }
    }

    /// The cells along an axis at both ends of slabs, and where the ray crosses the face between them, if there is one.
    #[inline(always)]
    fn cross(
        ray: &SortedRay,
        axis: usize,
        enter: f32x8<S>,
        leave: f32x8<S>,
        last: f32,
    ) -> (i32x8<S>, i32x8<S>, f32x8<S>) {
        let (origin, direction) = (ray.origin[axis], ray.direction[axis]);
        // Truncation, since nothing is below 0 but by rounding.
        let before = (enter * direction + origin).min(last).to_int::<i32x8<S>>();
        let behind = (leave * direction + origin).min(last).to_int::<i32x8<S>>();
        let face = before.to_float::<f32x8<S>>() + if direction >= 0.0 { 1.0 } else { 0.0 };
        let crossing = ((face - origin) * ray.inverse[axis]).max(enter).min(leave);
        (before, behind, before.simd_eq(behind).select(leave, crossing))
    }

    /// The stretches that are not empty: bit `4 * slab + stretch`.
    #[inline(always)]
    pub(crate) fn stretches(&self) -> u32 {
        let parts = [
            self.t[0].simd_lt(self.t[1]).to_bitmask() as u32,
            self.t[1].simd_lt(self.t[2]).to_bitmask() as u32,
            self.t[2].simd_lt(self.t[3]).to_bitmask() as u32,
        ];
        spread(parts[0]) | spread(parts[1]) << 1 | spread(parts[2]) << 2
    }
}

/// Moves bit i of the lowest eight to 4 i. A table, for there are as many uses as brick layers.
#[inline(always)]
fn spread(bits: u32) -> u32 {
    const TABLE: [u32; 256] = {
        let mut table = [0; 256];
        let mut i = 0;
        while i < 8 * 256 {
            table[i / 8] |= ((i as u32 / 8) >> (i % 8) & 1) << (4 * (i % 8));
            i += 1;
        }
        table
    };
    TABLE[bits as usize % 256]
}

/// A ray on its way through a [`BrickMap`].
pub(crate) struct MapWalk<'w, S: Simd> {
    simd: S,
    map: &'w BrickMap,
    /// In units of bricks.
    ray: SortedRay,
    t_start: f32,
    t_end: f32,
    /// The next layer of bricks, and the first one outside of the map at the end of the way.
    layer: f32,
    layers_end: f32,
    /// How far apart neighbours lie in the map. Their places are whole numbers that floats hold.
    strides: [f32; 3],
    /// The stretches found and not yet given out, as [`Slabs::stretches`] numbers them.
    waiting: u32,
    /// What is known of them, at `8 * stretch + slab`.
    t: [f32; 32],
    cells: [i32; 24],
    /// Their bricks, in the order of the ray's axes.
    bricks: [[i32; 24]; 3],
}

impl<'w, S: Simd> MapWalk<'w, S> {
    /// The walk of a ray from t = 0 to `length`, both inside the field.
    #[inline(always)]
    pub(crate) fn new(simd: S, map: &'w BrickMap, ray: &SortedRay, length: f32) -> Self {
        let ray = ray.in_bricks();
        let [layers, ..] = ray.order.sorted(map.size.to_array());
        let [x, y, z] = map.strides();
        MapWalk {
            simd,
            map,
            ray,
            t_start: 0.0,
            t_end: length,
            layer: floor(ray.origin[0]).clamp(1, layers - 2) as f32,
            layers_end: if ray.is_forward() { layers as f32 } else { -1.0 },
            strides: ray.order.sorted([x as f32, y as f32, z as f32]),
            waiting: 0,
            t: [0.0; 32],
            cells: [0; 24],
            bricks: [[0; 24]; 3],
        }
    }

    /// Goes on to where bricks are not far. False if the ray ends before.
    #[inline(always)]
    fn approach(&mut self) -> bool {
        let (ray, [along, u, v]) = (&self.ray, self.strides);
        let (sign, behind) = if ray.is_forward() { (1.0, 0.0) } else { (-1.0, 1.0) };
        loop {
            let t = (self.layer + behind - ray.origin[0]) * ray.inverse[0];
            let t = if t > self.t_start { t } else { self.t_start };
            if t >= self.t_end || self.layer == self.layers_end {
                return false;
            }
            let brick_u = (ray.origin[1] + ray.direction[1] * t).trunc();
            let brick_v = (ray.origin[2] + ray.direction[2] * t).trunc();
            // Added to 2^23, a smaller whole number stands in the low bits: cheaper than a conversion that must saturate.
            let at = (self.layer * along + brick_u * u + brick_v * v + 8_388_608.0).to_bits() & 0x7f_ffff;
            let distance = -self.map.cell(at as i32);
            self.t_start = t;
            if distance < LEAST_LEAP {
                return true;
            }
            // Bricks less than `distance` away are empty, and other than along the fastest axis the ray changes by at most
            // one in this layer and in each that follows.
            let layer = self.layer + sign * (distance - 1) as f32;
            self.layer = if sign > 0.0 { layer.min(self.layers_end) } else { layer.max(self.layers_end) };
        }
    }

    /// Looks at the next eight layers.
    #[inline(always)]
    fn look(&mut self) {
        // A copy: what a call might change through a reference, the compiler keeps in memory.
        let (ray, [along, u, v]) = (self.ray, self.strides);
        let limits = [self.t_start, self.t_end];
        let slabs = Slabs::of(self.simd, &ray, self.layer, limits, f32::INFINITY);
        let layers = slabs.number.to_float::<f32x8<S>>() * along;
        let mut waiting = slabs.stretches();
        // Counted, since iterators over vectors are not always inlined.
        for i in 0..3 {
            slabs.t[i].store_slice(&mut self.t[8 * i..8 * i + 8]);
            if waiting & 0x1111_1111 << i == 0 {
                continue;
            }
            let across = slabs.across[i];
            let at = layers + across[0].to_float::<f32x8<S>>() * u + across[1].to_float::<f32x8<S>>() * v;
            let at = at.to_int::<i32x8<S>>().to_array();
            let cells = i32x8::simd_from(self.simd, each_lane!(|lane| self.map.cell(at[lane])));
            let empty = cells.simd_lt(i32x8::splat(self.simd, 0)).to_bitmask() as u32;
            waiting &= !(spread(empty) << i);
            cells.store_slice(&mut self.cells[8 * i..8 * i + 8]);
            slabs.number.store_slice(&mut self.bricks[0][8 * i..8 * i + 8]);
            across[0].store_slice(&mut self.bricks[1][8 * i..8 * i + 8]);
            across[1].store_slice(&mut self.bricks[2][8 * i..8 * i + 8]);
        }
        slabs.t[3].store_slice(&mut self.t[24..]);
        self.waiting = waiting;
        self.t_start = self.t[31];
        // Not beyond the map, where the walk ends.
        self.layer = match ray.is_forward() {
            true => (self.layer + 8.0).min(self.layers_end),
            false => (self.layer - 8.0).max(self.layers_end),
        };
    }
}

impl<S: Simd> Spans for MapWalk<'_, S> {
    #[inline(always)]
    fn next_span(&mut self) -> Option<BrickSpan> {
        while self.waiting == 0 {
            if !self.approach() {
                return None;
            }
            self.look();
        }
        let number = self.waiting.trailing_zeros();
        self.waiting &= self.waiting - 1;
        // Stretches are 0 to 2, so the highest index is 23.
        let at = ((number & 3) * 8 + (number >> 2)) as usize % 24;
        let cell = self.cells[at];
        let content = match cell {
            ..BORDER => SpanContent::Brick(cell as u32),
            BORDER => SpanContent::TileBorder,
            _ => SpanContent::Constant(self.map.constant(cell)),
        };
        let brick = [self.bricks[0][at], self.bricks[1][at], self.bricks[2][at]];
        let corner = IVec3::from_array(self.ray.order.restored(brick)).as_vec3() * 8.0;
        Some(BrickSpan { t0: self.t[at], t1: self.t[at + 8], corner, content })
    }
}
