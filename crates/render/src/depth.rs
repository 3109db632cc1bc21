//! Line integrals: how much of a channel lies along a ray.
//!
//! [`optical_depth`] is exact: between two faces of the voxel lattice an interpolated value is a polynomial along the ray,
//! whose integral has a closed form. [`stepped_transmittance`] takes samples at equal steps, as most programs do, and is here
//! to be compared with them. Both cost nothing where the field is empty.
//!
//! Eight samples of a ray are taken at once. Light that scatters is followed in [`march`](crate::march) and
//! [`path`](crate::path).

use fearless_simd::{
    Level, Simd, dispatch, f32x4, f32x8, f32x16, i32x8, i32x16, prelude::*, u32x8, u32x16, u64x2,
};
use glam::Vec3;
use nuage_volume::brick::Bricks;
use nuage_volume::space::BRICK_VOXELS;

use crate::blocks::{Block, Blocks, SIDE};
use crate::camera::Ray;
use crate::filter::Filter;
use crate::gather::{gather_f32, gather_u16};
use crate::packet::MOST_STEPS;
use crate::simd::{each_lane, level};
use crate::traverse::{Field, LocalRay, Reader};
use crate::walk::{BrickSpan, Sight, Slabs, SortedRay, SpanContent, Spans, with_spans};

/// The cells and voxels of a brick lie at less than this, in voxels from its first corner.
const LAST_CELL_END: f32 = 7.999_999_5;

/// Voxels of the nearest filter begin half a voxel before their place, cells at it.
pub(crate) const NEAREST_SHIFT: f64 = 0.5;

/// The integral of a field along a ray from its origin on, in values times world lengths. Times the extinction of density 1 it
/// is the optical depth.
///
/// Exact but for rounding: about 1e-6 of the integral.
pub fn optical_depth<'a>(field: &Field<'a>, reader: &mut Reader<'a>, ray: &Ray, filter: Filter) -> f32 {
    optical_depth_at(level(), field, reader, ray, filter)
}

/// The share of light that passes along a ray, as the product of `1 - extinction × value × step` over samples at whole
/// multiples of a step from the ray's origin. `extinction` is that of value 1, per world length.
///
/// Converges to `exp(-extinction × optical_depth)` as steps become short, and is a cruder estimate of it than
/// [`optical_depth`] at a similar cost.
pub fn stepped_transmittance<'a>(
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    ray: &Ray,
    filter: Filter,
    step_voxels: f32,
    extinction: f32,
) -> f32 {
    stepped_transmittance_at(level(), field, reader, ray, filter, step_voxels, extinction)
}

pub(crate) fn optical_depth_at<'a>(
    level: Level,
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    ray: &Ray,
    filter: Filter,
) -> f32 {
    dispatch!(level, simd => simd.vectorize(
        #[inline(always)]
        || match filter {
            Filter::Nearest => nearest_depth_on(simd, field, reader, ray),
            Filter::Trilinear => trilinear_depth_on(simd, field, reader, ray),
        }
    ))
}

pub(crate) fn stepped_transmittance_at<'a>(
    level: Level,
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    ray: &Ray,
    filter: Filter,
    step_voxels: f32,
    extinction: f32,
) -> f32 {
    dispatch!(level, simd => simd.vectorize(
        #[inline(always)]
        || match filter {
            Filter::Nearest => nearest_steps_on(simd, field, reader, ray, step_voxels, extinction),
            Filter::Trilinear => trilinear_steps_on(simd, field, reader, ray, step_voxels, extinction),
        }
    ))
}

/// A ray as samples at whole multiples of a step see it: t = 0 is the first of them in the field.
struct Steps {
    ray: SortedRay,
    length: f32,
    step: f32,
}

impl Steps {
    #[inline(always)]
    fn of(field: &Field<'_>, ray: &Ray, shift_voxels: f64, step_voxels: f32) -> Option<Steps> {
        let entered = field.enter(ray, shift_voxels)?;
        let [start, end] = entered.interval;
        // Not so short that numbers of samples could not be told apart.
        let least = (end - start) / MOST_STEPS;
        let step = least.max(f64::from(step_voxels) / entered.voxels_per_length());
        let start = (start / step).ceil() * step;
        let ray = SortedRay::new(entered.local(start));
        Some(Steps { ray, length: (end - start) as f32, step: step as f32 })
    }
}

#[inline(always)]
fn trilinear_steps_on<'a, S: Simd>(
    simd: S,
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    ray: &Ray,
    step_voxels: f32,
    extinction: f32,
) -> f32 {
    let Some(steps) = Steps::of(field, ray, 0.0, step_voxels) else { return 1.0 };
    let Reader { walker, blocks, .. } = reader;
    with_spans!(simd, Sight::Cells, field, walker, &steps.ray, steps.length, |spans| {
        step_cells(simd, field, blocks, &steps.ray.local, spans, steps.step, extinction)
    })
}

#[inline(always)]
fn step_cells<'a, S: Simd>(
    simd: S,
    field: &Field<'a>,
    blocks: &mut Blocks<'a>,
    local: &LocalRay,
    mut spans: impl Spans,
    step: f32,
    extinction: f32,
) -> f32 {
    let per_step = 1.0 / step;
    let loss = extinction * step;
    let (mut passes, mut passes_constant) = (f32x8::splat(simd, 1.0), 1.0);
    while let Some(span) = spans.next_span() {
        let (first, end) = ((span.t0 * per_step).ceil(), (span.t1 * per_step).ceil());
        let block = match block_of(field, blocks, &span) {
            Ok(block) => block,
            Err(value) => {
                passes_constant *= power(1.0 - loss * value, (end - first) as u32);
                continue;
            }
        };
        let brick = BrickRay::new(simd, local, &span);
        let mut sample = first;
        while sample < end {
            let number = lanes(simd) + sample;
            let value = brick.sample(block, (number * step).min(span.t1));
            let value = number.simd_lt(f32x8::splat(simd, end)).select(value, f32x8::splat(simd, 0.0));
            passes *= f32x8::splat(simd, 1.0) - value * loss;
            sample += 8.0;
        }
    }
    passes_constant * product(passes)
}

#[inline(always)]
fn nearest_steps_on<'a, S: Simd>(
    simd: S,
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    ray: &Ray,
    step_voxels: f32,
    extinction: f32,
) -> f32 {
    let Some(steps) = Steps::of(field, ray, NEAREST_SHIFT, step_voxels) else { return 1.0 };
    let bricks = &field.tree().bricks;
    with_spans!(simd, Sight::Voxels, field, &mut reader.walker, &steps.ray, steps.length, |spans| {
        match bricks {
            Bricks::F32(values) => step_voxels_of(simd, values, &steps, spans, extinction),
            Bricks::F16(values) => step_voxels_of(simd, values, &steps, spans, extinction),
        }
    })
}

#[inline(always)]
fn step_voxels_of<S: Simd, V: Stored>(
    simd: S,
    values: &[V],
    steps: &Steps,
    mut spans: impl Spans,
    extinction: f32,
) -> f32 {
    let (per_step, loss) = (1.0 / steps.step, extinction * steps.step);
    let [dx, dy, dz] = steps.ray.local.direction.to_array();
    let (mut passes, mut passes_constant) = (f32x8::splat(simd, 1.0), 1.0);
    while let Some(span) = spans.next_span() {
        let (first, end) = ((span.t0 * per_step).ceil(), (span.t1 * per_step).ceil());
        let brick = match voxels_of(values, &span) {
            Ok(brick) => brick,
            Err(value) => {
                passes_constant *= power(1.0 - loss * value, (end - first) as u32);
                continue;
            }
        };
        let [x, y, z] = (steps.ray.local.origin - span.corner).to_array();
        let mut sample = first;
        while sample < end {
            let number = lanes(simd) + sample;
            let t = number * steps.step;
            // Below the brick by rounding, the conversion to a whole number brings it back.
            let i = (t * dx + x).min(LAST_CELL_END).to_int::<i32x8<S>>();
            let j = (t * dy + y).min(LAST_CELL_END).to_int::<i32x8<S>>();
            let k = (t * dz + z).min(LAST_CELL_END).to_int::<i32x8<S>>();
            let at = ((i << 6) + (j << 3) + k).to_array();
            let value = V::widen(simd, each_lane!(|lane| brick[at[lane] as usize % BRICK_VOXELS]));
            let value = number.simd_lt(end).select(value, f32x8::splat(simd, 0.0));
            passes *= f32x8::splat(simd, 1.0) - value * loss;
            sample += 8.0;
        }
    }
    passes_constant * product(passes)
}

#[inline(always)]
fn trilinear_depth_on<'a, S: Simd>(simd: S, field: &Field<'a>, reader: &mut Reader<'a>, ray: &Ray) -> f32 {
    let Some(entered) = field.enter(ray, 0.0) else { return 0.0 };
    let [start, end] = entered.interval;
    let sorted = SortedRay::new(entered.local(start));
    let Reader { walker, blocks, .. } = reader;
    with_spans!(simd, Sight::Cells, field, walker, &sorted, (end - start) as f32, |spans| {
        integrate_cells(simd, field, blocks, &sorted, spans)
    })
}

#[inline(always)]
fn integrate_cells<'a, S: Simd>(
    simd: S,
    field: &Field<'a>,
    blocks: &mut Blocks<'a>,
    ray: &SortedRay,
    mut spans: impl Spans,
) -> f32 {
    let (mut depth, mut depth_constant) = (f32x8::splat(simd, 0.0), 0.0);
    while let Some(span) = spans.next_span() {
        let block = match block_of(field, blocks, &span) {
            Ok(block) => block,
            Err(value) => {
                depth_constant += value * (span.t1 - span.t0);
                continue;
            }
        };
        let brick = BrickRay::new(simd, &ray.local, &span);
        let crossings = Crossings::of(simd, ray, &span);
        let mut cell = 0;
        while cell < crossings.cells {
            let t0 = f32x8::from_slice(simd, &crossings.t[cell..cell + 8]);
            let t1 = f32x8::from_slice(simd, &crossings.t[cell + 1..cell + 9]);
            depth += brick.integral(block, t0, t1);
            cell += 8;
        }
    }
    depth_constant + sum(depth)
}

#[inline(always)]
fn nearest_depth_on<'a, S: Simd>(simd: S, field: &Field<'a>, reader: &mut Reader<'a>, ray: &Ray) -> f32 {
    let Some(entered) = field.enter(ray, NEAREST_SHIFT) else { return 0.0 };
    let [start, end] = entered.interval;
    let sorted = SortedRay::new(entered.local(start));
    let (walker, bricks) = (&mut reader.walker, &field.tree().bricks);
    with_spans!(simd, Sight::Voxels, field, walker, &sorted, (end - start) as f32, |spans| {
        match bricks {
            Bricks::F32(values) => integrate_voxels(simd, values, &sorted, spans),
            Bricks::F16(values) => integrate_voxels(simd, values, &sorted, spans),
        }
    })
}

#[inline(always)]
fn integrate_voxels<S: Simd, V: Stored>(
    simd: S,
    values: &[V],
    ray: &SortedRay,
    mut spans: impl Spans,
) -> f32 {
    let shifts = ray.order().sorted([6, 3, 0]);
    let (mut depth, mut depth_constant) = (f32x8::splat(simd, 0.0), 0.0);
    while let Some(span) = spans.next_span() {
        let brick = match voxels_of(values, &span) {
            Ok(brick) => brick,
            Err(value) => {
                depth_constant += value * (span.t1 - span.t0);
                continue;
            }
        };
        let slabs = voxel_slabs(simd, ray, &span);
        let along = slabs.number << shifts[0];
        // Counted, since iterators over vectors are not always inlined.
        for i in 0..3 {
            let [u, v] = slabs.across[i];
            let length = slabs.t[i + 1] - slabs.t[i];
            // Few slabs have two crossings, some have none.
            if length.simd_gt(0.0).any_true() {
                let at = (along + (u << shifts[1]) + (v << shifts[2])).to_array();
                depth += V::widen(simd, each_lane!(|lane| brick[at[lane] as usize % BRICK_VOXELS])) * length;
            }
        }
    }
    depth_constant + sum(depth)
}

/// The voxels of the brick of a span, or the one value that they have.
#[inline(always)]
fn voxels_of<'v, V: Stored>(values: &'v [V], span: &BrickSpan) -> Result<&'v [V; BRICK_VOXELS], f32> {
    match span.content {
        SpanContent::Brick(number) => {
            let values = values.get(number as usize * BRICK_VOXELS..);
            values.and_then(|values| values.first_chunk()).ok_or(0.0)
        }
        SpanContent::Constant(value) => Err(value),
        SpanContent::TileBorder => Err(0.0),
    }
}

/// The layers of voxels of a span's brick.
#[inline(always)]
fn voxel_slabs<S: Simd>(simd: S, ray: &SortedRay, span: &BrickSpan) -> Slabs<S> {
    let first = if ray.is_forward() { 0.0 } else { 7.0 };
    Slabs::of(simd, &ray.seen_from(span.corner), first, [span.t0, span.t1], LAST_CELL_END)
}

/// From the exponents of half floats to those of floats.
const TWO_POW_112: f32 = f32::from_bits((127 + 112) << 23);

/// A value as [`Bricks`] store it.
pub(crate) trait Stored: Copy + Default {
    /// The numbers that eight of them stand for.
    fn widen<S: Simd>(simd: S, values: [Self; 8]) -> f32x8<S>;

    /// The numbers at places of a slice; 0 outside of it.
    fn gather<S: Simd>(simd: S, values: &[Self], at: i32x16<S>) -> f32x16<S>;
}

impl Stored for f32 {
    #[inline(always)]
    fn widen<S: Simd>(simd: S, values: [f32; 8]) -> f32x8<S> {
        f32x8::simd_from(simd, values)
    }

    #[inline(always)]
    fn gather<S: Simd>(simd: S, values: &[f32], at: i32x16<S>) -> f32x16<S> {
        gather_f32(simd, values, at)
    }
}

impl Stored for u16 {
    /// What `f32_from_finite_f16` does, in lanes.
    #[inline(always)]
    fn widen<S: Simd>(simd: S, values: [u16; 8]) -> f32x8<S> {
        let bits = u32x8::simd_from(simd, each_lane!(|lane| u32::from(values[lane])));
        let magnitude = ((bits & 0x7fff) << 13).bitcast::<f32x8<S>>() * TWO_POW_112;
        (magnitude.bitcast::<u32x8<S>>() | ((bits & 0x8000) << 16)).bitcast()
    }

    #[inline(always)]
    fn gather<S: Simd>(simd: S, values: &[u16], at: i32x16<S>) -> f32x16<S> {
        let bits = gather_u16(simd, values, at);
        let magnitude = ((bits & 0x7fff) << 13).bitcast::<f32x16<S>>() * TWO_POW_112;
        (magnitude.bitcast::<u32x16<S>>() | ((bits & 0x8000) << 16)).bitcast()
    }
}

#[inline(always)]
fn lanes<S: Simd>(simd: S) -> f32x8<S> {
    f32x8::simd_from(simd, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0])
}

/// The sum of all lanes, in the same order everywhere.
#[inline(always)]
fn sum<S: Simd>(lanes: f32x8<S>) -> f32 {
    let [a, b, c, d, e, f, g, h] = lanes.to_array();
    ((a + b) + (c + d)) + ((e + f) + (g + h))
}

/// The product of all lanes, in the same order everywhere.
#[inline(always)]
fn product<S: Simd>(lanes: f32x8<S>) -> f32 {
    let [a, b, c, d, e, f, g, h] = lanes.to_array();
    ((a * b) * (c * d)) * ((e * f) * (g * h))
}

/// The values of the brick of a span, or the one value that it has.
#[inline(always)]
pub(crate) fn block_of<'b, 'a>(
    field: &Field<'a>,
    blocks: &'b mut Blocks<'a>,
    span: &BrickSpan,
) -> Result<&'b Block, f32> {
    match span.content {
        SpanContent::Brick(entry) => Ok(blocks.of_entry(entry as usize, || field.brick_at(span.corner))),
        SpanContent::Constant(value) => Err(value),
        SpanContent::TileBorder => Ok(blocks.of_tile(field.brick_at(span.corner))),
    }
}

/// x to a whole power, the same on every platform.
fn power(mut x: f32, mut exponent: u32) -> f32 {
    let mut result = 1.0;
    while exponent > 0 {
        if exponent & 1 == 1 {
            result *= x;
        }
        x *= x;
        exponent >>= 1;
    }
    result
}

/// Where a ray crosses the faces of voxels in a brick.
pub(crate) struct Crossings {
    /// Both ends of the span and the crossings between, ascending; behind them the end again.
    pub(crate) t: [f32; Crossings::MOST + 8],
    /// The number of stretches.
    pub(crate) cells: usize,
}

impl Crossings {
    /// Three stretches in each of eight layers.
    const MOST: usize = 24;

    #[inline(always)]
    pub(crate) fn of<S: Simd>(simd: S, ray: &SortedRay, span: &BrickSpan) -> Crossings {
        let slabs = voxel_slabs(simd, ray, span);
        let mut starts = [0.0; 32];
        for i in 0..4 {
            slabs.t[i].store_slice(&mut starts[8 * i..8 * i + 8]);
        }
        let mut t = [span.t1; Crossings::MOST + 8];
        let mut left = slabs.stretches();
        let mut cells = 0;
        while left != 0 && cells < Crossings::MOST {
            let number = left.trailing_zeros();
            t[cells] = starts[((number & 3) * 8 + (number >> 2)) as usize % 32];
            left &= left - 1;
            cells += 1;
        }
        t[0] = span.t0;
        Crossings { t, cells: cells.max(1) }
    }
}

/// What stands where a block has no value, should rounding lead there.
pub(crate) const NOWHERE: [f32; CORNERS_SPAN] = [0.0; CORNERS_SPAN];

/// The eight corners of a cell lie in as many consecutive values of a block: one bounds check.
const CORNERS_SPAN: usize = SIDE * SIDE + SIDE + 2;

/// The values from the first to the last corner of the cell at an offset of a block.
#[inline(always)]
pub(crate) fn corners_from(block: &Block, offset: usize) -> &[f32; CORNERS_SPAN] {
    match block.get(offset..).and_then(|values| values.first_chunk()) {
        Some(values) => values,
        None => &NOWHERE,
    }
}

/// The values from the first to the last corner of the cell around a position in a brick.
#[inline(always)]
pub(crate) fn corners_around(block: &Block, position: Vec3) -> &[f32; CORNERS_SPAN] {
    let cell = position.min(Vec3::splat(LAST_CELL_END)).as_ivec3();
    corners_from(block, (cell.x * 81 + cell.y * 9 + cell.z) as usize)
}

/// The eight corners of a cell, whose coordinates in the brick are whole numbers from 0 to 7: corner `i` at
/// `dx << 2 | dy << 1 | dz`.
#[inline(always)]
pub(crate) fn corners_at(block: &Block, cell: Vec3) -> [f32; 8] {
    let offset = (cell.x as i32 * 81 + cell.y as i32 * 9 + cell.z as i32) as usize;
    let v = corners_from(block, offset);
    [v[0], v[1], v[9], v[10], v[81], v[82], v[90], v[91]]
}

/// The interpolation at a position in a brick: what each lane of [`BrickRay::sample`] does.
#[inline(always)]
pub(crate) fn interpolate(block: &Block, position: Vec3) -> f32 {
    let position = position.min(Vec3::splat(LAST_CELL_END));
    let cell = Vec3::new(position.x as i32 as f32, position.y as i32 as f32, position.z as i32 as f32);
    let ([x, y, z], c) = ((position - cell).to_array(), corners_at(block, cell));
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let low = mix(mix(c[0], c[1], z), mix(c[2], c[3], z), y);
    let high = mix(mix(c[4], c[5], z), mix(c[6], c[7], z), y);
    mix(low, high, x)
}

/// Between two numbers.
#[inline(always)]
fn mix<S: Simd>(a: f32x8<S>, b: f32x8<S>, t: f32x8<S>) -> f32x8<S> {
    a + (b - a) * t
}

/// The mean of the interpolation between eight corners along a line inside their cell, whose middle is at fractions of the cell
/// and which goes a way along each axis.
///
/// Along the line the interpolation is a cubic. With d the way from end to end in voxels, its mean is the value in the
/// middle and a twelfth of the sum, over pairs of axes, of the mixed derivative there times d along both: the mean of
/// `xyz` over a line through `m` is `mx my mz + (mx dy dz + my dx dz + mz dx dy) / 12`, and likewise for `xy`.
///
/// A macro, for vectors of eight and of sixteen lanes have no type in common.
macro_rules! mean_in_cell {
    ($corners:expr, $middle:expr, $way:expr) => {{
        let (c, [x, y, z], [dx, dy, dz]) = ($corners, $middle, $way);
        // Along z: values and slopes of the four edges; then along y, then along x.
        let (e0, e1, e2, e3) = (c[1] - c[0], c[3] - c[2], c[5] - c[4], c[7] - c[6]);
        let (v0, v1, v2, v3) = (c[0] + e0 * z, c[2] + e1 * z, c[4] + e2 * z, c[6] + e3 * z);
        let (y0, y1) = (v1 - v0, v3 - v2);
        let (low, high) = (v0 + y0 * y, v2 + y1 * y);
        let (s0, s1) = (e1 - e0, e3 - e2);
        let value = low + (high - low) * x;
        let yz = s0 + (s1 - s0) * x;
        let xz = (e2 + s1 * y) - (e0 + s0 * y);
        let xy = y1 - y0;
        let mixed = xy * (dx * dy) + xz * (dx * dz) + yz * (dy * dz);
        value + mixed * (1.0 / 12.0)
    }};
}
pub(crate) use mean_in_cell;

/// A ray in voxels from the first corner of a brick, in each lane.
pub(crate) struct BrickRay<S: Simd> {
    simd: S,
    origin: Vec3,
    direction: Vec3,
}

impl<S: Simd> BrickRay<S> {
    #[inline(always)]
    pub(crate) fn new(simd: S, ray: &LocalRay, span: &BrickSpan) -> Self {
        BrickRay { simd, origin: ray.origin - span.corner, direction: ray.direction }
    }

    /// The cells and the fractions inside them. Rounding may put a point a little outside of the brick: below it, the
    /// conversion to a whole number brings it back.
    #[inline(always)]
    fn cells(&self, t: f32x8<S>) -> ([i32; 8], [f32x8<S>; 3]) {
        let x = (t * self.direction.x + self.origin.x).min(LAST_CELL_END);
        let y = (t * self.direction.y + self.origin.y).min(LAST_CELL_END);
        let z = (t * self.direction.z + self.origin.z).min(LAST_CELL_END);
        let (i, j, k) = (x.to_int::<i32x8<S>>(), y.to_int::<i32x8<S>>(), z.to_int::<i32x8<S>>());
        let row = (i << 3) + i + j;
        let fractions =
            [x - i.to_float::<f32x8<S>>(), y - j.to_float::<f32x8<S>>(), z - k.to_float::<f32x8<S>>()];
        (((row << 3) + row + k).to_array(), fractions)
    }

    /// The values at `t`.
    #[inline(always)]
    pub(crate) fn sample(&self, block: &Block, t: f32x8<S>) -> f32x8<S> {
        let (offsets, [x, y, z]) = self.cells(t);
        let c = self.corners(block, offsets);
        let low = mix(mix(c[0], c[1], z), mix(c[2], c[3], z), y);
        let high = mix(mix(c[4], c[5], z), mix(c[6], c[7], z), y);
        mix(low, high, x)
    }

    /// The eight corners of the cell in each lane, corner `i` at `dx << 2 | dy << 1 | dz`.
    #[inline(always)]
    fn corners(&self, block: &Block, offsets: [i32; 8]) -> [f32x8<S>; 8] {
        let cells = each_lane!(|lane| corners_from(block, offsets[lane] as usize));
        let [c0, c1] = self.pairs(cells, 0);
        let [c2, c3] = self.pairs(cells, SIDE);
        let [c4, c5] = self.pairs(cells, SIDE * SIDE);
        let [c6, c7] = self.pairs(cells, SIDE * SIDE + SIDE);
        [c0, c1, c2, c3, c4, c5, c6, c7]
    }

    /// The values at an offset and behind it. Neighbours are read in one piece of 64 bits.
    #[inline(always)]
    fn pairs(&self, cells: [&[f32; CORNERS_SPAN]; 8], at: usize) -> [f32x8<S>; 2] {
        let pairs = each_lane!(|lane| {
            let v = cells[lane];
            u64::from(v[at].to_bits()) | u64::from(v[at + 1].to_bits()) << 32
        });
        let [a, b, c, d, e, f, g, h] = pairs;
        let ab = u64x2::simd_from(self.simd, [a, b]).bitcast::<f32x4<S>>();
        let cd = u64x2::simd_from(self.simd, [c, d]).bitcast::<f32x4<S>>();
        let ef = u64x2::simd_from(self.simd, [e, f]).bitcast::<f32x4<S>>();
        let gh = u64x2::simd_from(self.simd, [g, h]).bitcast::<f32x4<S>>();
        [ab.unzip_low(cd).combine(ef.unzip_low(gh)), ab.unzip_high(cd).combine(ef.unzip_high(gh))]
    }

    /// The integrals of the interpolation over stretches inside one cell each.
    #[inline(always)]
    fn integral(&self, block: &Block, t0: f32x8<S>, t1: f32x8<S>) -> f32x8<S> {
        let (offsets, [x, y, z]) = self.cells((t0 + t1) * 0.5);
        let c = self.corners(block, offsets);
        let length = t1 - t0;
        let (dx, dy, dz) = (length * self.direction.x, length * self.direction.y, length * self.direction.z);
        mean_in_cell!(c, [x, y, z], [dx, dy, dz]) * length
    }
}

#[cfg(test)]
mod tests {
    use nuage_volume::brick::f32_from_finite_f16;

    use super::*;
    use crate::fixtures::{channel, random, rays};
    use crate::simd::levels;

    #[test]
    fn all_levels_give_the_same_bits() {
        let channel = channel();
        let field = Field::new(&channel).unwrap();
        let mut reader = field.reader();
        for ray in rays() {
            for filter in [Filter::Nearest, Filter::Trilinear] {
                let mut both = |level| {
                    let depth = optical_depth_at(level, &field, &mut reader, &ray, filter);
                    let passes = stepped_transmittance_at(level, &field, &mut reader, &ray, filter, 0.5, 0.3);
                    [depth.to_bits(), passes.to_bits()]
                };
                for level in levels() {
                    assert_eq!(both(level), both(Level::new()), "{ray:?}");
                }
            }
        }
    }

    #[test]
    fn the_map_and_the_tree_lead_the_same_way() {
        let channel = channel();
        let field = Field::new(&channel).unwrap();
        let by_tree = Field::new(&channel).unwrap().without_map();
        let (mut reader, mut tree_reader) = (field.reader(), by_tree.reader());
        assert!(field.map(Sight::Cells).is_some() && by_tree.map(Sight::Cells).is_none());
        let mut sum = 0.0;
        for ray in rays() {
            for filter in [Filter::Nearest, Filter::Trilinear] {
                let a = optical_depth(&field, &mut reader, &ray, filter);
                let b = optical_depth(&by_tree, &mut tree_reader, &ray, filter);
                assert!((a - b).abs() < 3e-5 * (1.0 + a), "{ray:?}: {a} and {b}");
                let step =
                    |field, reader: &mut _| stepped_transmittance(field, reader, &ray, filter, 0.5, 0.3);
                let (a, b) = (step(&field, &mut reader), step(&by_tree, &mut tree_reader));
                // A sample at the very face of a brick may fall to either side.
                assert!((a - b).abs() < 0.02, "{ray:?}: {a} and {b}");
                sum += a;
            }
        }
        assert!(sum > 10.0 && sum < 390.0, "{sum}");
    }

    #[test]
    fn halves_are_widened_in_lanes_as_one_by_one() {
        for i in (0..0x7c00_u16).step_by(13) {
            let halves = std::array::from_fn(|lane| i ^ (lane as u16 & 1) << 15);
            let lanes = dispatch!(level(), simd => u16::widen(simd, halves).to_array());
            assert_eq!(lanes.map(f32::to_bits), halves.map(|half| f32_from_finite_f16(half).to_bits()));
        }
    }

    /// A ray that goes through a lattice of cells falls into the same stretches, whichever axis is its fastest.
    #[test]
    fn crossings_are_those_of_the_faces() {
        for i in 0..300 {
            let [a, b, c, d, e, f] = [0, 1, 2, 3, 4, 5].map(|j| random(i * 6 + j) * 8.0);
            let (from, to) = (Vec3::new(a, b, c), Vec3::new(d, e, f));
            let ray = SortedRay::new(LocalRay::new(from + 16.0, to - from));
            let span =
                BrickSpan { t0: 0.0, t1: 1.0, corner: Vec3::splat(16.0), content: SpanContent::TileBorder };
            let crossings = dispatch!(level(), simd => Crossings::of(simd, &ray, &span));
            let mut faces = vec![0.0, 1.0];
            for axis in 0..3 {
                for face in 1..8 {
                    let t = (face as f32 - from[axis]) / (to[axis] - from[axis]);
                    if t > 0.0 && t < 1.0 {
                        faces.push(t);
                    }
                }
            }
            faces.sort_by(f32::total_cmp);
            assert_eq!(crossings.cells + 1, faces.len(), "{ray:?}");
            for (t, face) in crossings.t.iter().zip(&faces) {
                assert!((t - face).abs() < 1e-4, "{ray:?}: {t}, not {face}");
            }
        }
    }

    #[test]
    fn lanes_do_what_the_scalar_code_does() {
        let block: Block = std::array::from_fn(|i| random(i as u32));
        for i in 0..500 {
            let [x, y, z] = [1, 2, 3].map(|j| random(i * 3 + j) * 8.0);
            let at = Vec3::new(x, y, z);
            let ray = LocalRay::new(at, Vec3::new(0.1, -0.3, 0.2));
            let content = SpanContent::TileBorder;
            let span = BrickSpan { t0: 0.0, t1: 1.0, corner: Vec3::ZERO, content };
            let lanes = dispatch!(level(), simd => simd.vectorize(
                #[inline(always)]
                || BrickRay::new(simd, &ray, &span).sample(&block, f32x8::splat(simd, 0.0)).to_array()
            ));
            assert_eq!(lanes, [interpolate(&block, at); 8]);
        }
    }
}
