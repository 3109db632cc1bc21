//! Line integrals: how much of a channel lies along a ray.
//!
//! [`optical_depth`] is exact: between two faces of the voxel lattice an interpolated value is a polynomial along the ray,
//! whose integral has a closed form. [`stepped_transmittance`] takes samples at equal steps, as most programs do, and is here
//! to be compared with them. Both cost nothing where the field is empty.
//!
//! Eight samples of a ray in one brick are taken at once. Light that scatters is followed in [`march`](crate::march) and
//! [`path`](crate::path).

use fearless_simd::{Level, Simd, dispatch, f32x8, i32x8, prelude::*};
use glam::Vec3;

use crate::blocks::{Block, Blocks, SIDE};
use crate::camera::Ray;
use crate::filter::Filter;
use crate::simd::level;
use crate::traverse::{Field, LocalRay, Reader};
use crate::walk::{BrickSpan, Faces, SpanContent, Spans, with_spans};

/// The cells of a brick lie at less than this, in voxels from its first corner.
const LAST_CELL_END: f32 = 7.999_999_5;

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
            Filter::Nearest => optical_depth_on::<_, true>(simd, field, reader, ray),
            Filter::Trilinear => optical_depth_on::<_, false>(simd, field, reader, ray),
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
            Filter::Nearest => stepped_on::<_, true>(simd, field, reader, ray, step_voxels, extinction),
            Filter::Trilinear => stepped_on::<_, false>(simd, field, reader, ray, step_voxels, extinction),
        }
    ))
}

/// Where a ray enters and leaves the field, as a filter sees it.
#[inline(always)]
pub(crate) fn filter_interval<const NEAREST: bool>(field: &Field<'_>, ray: &Ray) -> Option<[f64; 2]> {
    field.interval_of(ray, if NEAREST { 0.5 } else { 0.0 })
}

/// The ray of a filter: voxels of the nearest filter begin half a voxel before their place, cells at it.
#[inline(always)]
pub(crate) fn filter_ray<const NEAREST: bool>(ray: LocalRay) -> LocalRay {
    match NEAREST {
        true => LocalRay::new(ray.origin + 0.5, ray.direction),
        false => ray,
    }
}

#[inline(always)]
fn stepped_on<'a, S: Simd, const NEAREST: bool>(
    simd: S,
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    ray: &Ray,
    step_voxels: f32,
    extinction: f32,
) -> f32 {
    let Some([start, end]) = filter_interval::<NEAREST>(field, ray) else { return 1.0 };
    let step = f64::from(step_voxels) / field.voxels_per_length(ray);
    // t = 0 is the first sample in the field.
    let start = (start / step).ceil() * step;
    let local = filter_ray::<NEAREST>(field.local(ray, start));
    let (length, step) = ((end - start) as f32, step as f32);
    let Reader { walker, blocks, .. } = reader;
    with_spans!(simd, field, walker, local, length, |spans| {
        step_spans::<S, NEAREST>(simd, field, blocks, &local, spans, step, extinction)
    })
}

#[inline(always)]
fn step_spans<'a, S: Simd, const NEAREST: bool>(
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
    let lanes = f32x8::simd_from(simd, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);
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
            let number = lanes + sample;
            let value = brick.sample::<NEAREST>(block, (number * step).min(span.t1));
            let value = number.simd_lt(f32x8::splat(simd, end)).select(value, f32x8::splat(simd, 0.0));
            passes *= f32x8::splat(simd, 1.0) - value * loss;
            sample += 8.0;
        }
    }
    let [a, b, c, d, e, f, g, h] = passes.to_array();
    passes_constant * (((a * b) * (c * d)) * ((e * f) * (g * h)))
}

#[inline(always)]
fn optical_depth_on<'a, S: Simd, const NEAREST: bool>(
    simd: S,
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    ray: &Ray,
) -> f32 {
    let Some([start, end]) = filter_interval::<NEAREST>(field, ray) else { return 0.0 };
    let local = filter_ray::<NEAREST>(field.local(ray, start));
    let length = (end - start) as f32;
    let Reader { walker, blocks, .. } = reader;
    with_spans!(simd, field, walker, local, length, |spans| {
        integrate_spans::<S, NEAREST>(simd, field, blocks, &local, spans)
    })
}

#[inline(always)]
fn integrate_spans<'a, S: Simd, const NEAREST: bool>(
    simd: S,
    field: &Field<'a>,
    blocks: &mut Blocks<'a>,
    local: &LocalRay,
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
        let brick = BrickRay::new(simd, local, &span);
        let crossings = Crossings::of(simd, local, &span);
        let mut cell = 0;
        while cell < crossings.cells {
            let t0 = f32x8::from_slice(simd, &crossings.t[cell..cell + 8]);
            let t1 = f32x8::from_slice(simd, &crossings.t[cell + 1..cell + 9]);
            depth += match NEAREST {
                true => brick.sample::<true>(block, (t0 + t1) * 0.5) * (t1 - t0),
                false => brick.integral(block, t0, t1),
            };
            cell += 8;
        }
    }
    let [a, b, c, d, e, f, g, h] = depth.to_array();
    depth_constant + (((a + b) + (c + d)) + ((e + f) + (g + h)))
}

/// The values of the brick of a span, or the one value that it has.
#[inline(always)]
pub(crate) fn block_of<'b, 'a>(
    field: &Field<'a>,
    blocks: &'b mut Blocks<'a>,
    span: &BrickSpan,
) -> Result<&'b Block, f32> {
    match span.content {
        SpanContent::Entry(entry) => Ok(blocks.of_entry(entry as usize, || field.brick_at(span.corner))),
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
    /// More than the 24 faces of voxels that a ray can cross in a brick, rounding included.
    const MOST: usize = 32;

    #[inline(always)]
    pub(crate) fn of<S: Simd>(simd: S, ray: &LocalRay, span: &BrickSpan) -> Crossings {
        let origin = ray.origin - span.corner;
        let entry = origin + ray.direction * span.t0;
        let next = |entry: f32, origin: f32, direction: f32, inverse: f32| {
            // Truncation: an entry is not below 0 but for rounding.
            let cell = (entry as i32).clamp(0, 7);
            let face = cell + i32::from(direction >= 0.0);
            match direction == 0.0 {
                true => f32::INFINITY,
                false => (face as f32 - origin) * inverse,
            }
        };
        let (inverse, step) = (ray.inverse(), ray.inverse().abs());
        let x = next(entry.x, origin.x, ray.direction.x, inverse.x);
        let y = next(entry.y, origin.y, ray.direction.y, inverse.y);
        let z = next(entry.z, origin.z, ray.direction.z, inverse.z);
        let mut faces = Faces::new(simd, [x, y, z], step);
        let mut t = [span.t1; Crossings::MOST + 8];
        t[0] = span.t0;
        let mut cells = 1;
        while cells < Crossings::MOST {
            let nearest = faces.pass().0;
            if nearest >= span.t1 {
                break;
            }
            t[cells] = if nearest > span.t0 { nearest } else { span.t0 };
            cells += 1;
        }
        Crossings { t, cells }
    }
}

/// What stands where a block has no value, should rounding lead there.
const NOWHERE: [f32; CORNERS_SPAN] = [0.0; CORNERS_SPAN];

/// The eight corners of a cell lie in as many consecutive values of a block: one bounds check.
const CORNERS_SPAN: usize = SIDE * SIDE + SIDE + 2;

/// The values from the first to the last corner of the cell at an offset of a block.
#[inline(always)]
fn corners_from(block: &Block, offset: usize) -> &[f32; CORNERS_SPAN] {
    match block.get(offset..).and_then(|values| values.first_chunk()) {
        Some(values) => values,
        None => &NOWHERE,
    }
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
    /// conversion to a whole number brings it back; above it, there is a voxel, but no cell.
    #[inline(always)]
    fn cells<const NEAREST: bool>(&self, t: f32x8<S>) -> ([i32; 8], [f32x8<S>; 3]) {
        let axis = |origin: f32, direction: f32| {
            let p = t * direction + origin;
            let p = if NEAREST { p } else { p.min(LAST_CELL_END) };
            let cell = p.to_int::<i32x8<S>>();
            (cell, p - cell.to_float::<f32x8<S>>())
        };
        let (x, fx) = axis(self.origin.x, self.direction.x);
        let (y, fy) = axis(self.origin.y, self.direction.y);
        let (z, fz) = axis(self.origin.z, self.direction.z);
        let times_nine = |i: i32x8<S>| (i << 3) + i;
        ((times_nine(times_nine(x) + y) + z).to_array(), [fx, fy, fz])
    }

    /// The values at `t`.
    #[inline(always)]
    pub(crate) fn sample<const NEAREST: bool>(&self, block: &Block, t: f32x8<S>) -> f32x8<S> {
        let (offsets, [x, y, z]) = self.cells::<NEAREST>(t);
        if NEAREST {
            return f32x8::from_fn(self.simd, |lane| {
                block.get(offsets[lane] as usize).copied().unwrap_or(0.0)
            });
        }
        let c = self.corners(block, offsets);
        let mix = |a: f32x8<S>, b: f32x8<S>, t: f32x8<S>| a + (b - a) * t;
        let low = mix(mix(c[0], c[1], z), mix(c[2], c[3], z), y);
        let high = mix(mix(c[4], c[5], z), mix(c[6], c[7], z), y);
        mix(low, high, x)
    }

    /// The eight corners of the cell in each lane, corner `i` at `dx << 2 | dy << 1 | dz`.
    #[inline(always)]
    fn corners(&self, block: &Block, offsets: [i32; 8]) -> [f32x8<S>; 8] {
        let cells: [&[f32; CORNERS_SPAN]; 8] =
            std::array::from_fn(|lane| corners_from(block, offsets[lane] as usize));
        let corner = |at: usize| f32x8::from_fn(self.simd, |lane| cells[lane][at]);
        [corner(0), corner(1), corner(9), corner(10), corner(81), corner(82), corner(90), corner(91)]
    }

    /// The integrals of the interpolation over stretches inside one cell each.
    ///
    /// Along the stretch the interpolation is a cubic. With d the way from end to end in voxels, its mean is the value in the
    /// middle and a twelfth of the sum, over pairs of axes, of the mixed derivative there times d along both: the mean of
    /// `xyz` over a line through `m` is `mx my mz + (mx dy dz + my dx dz + mz dx dy) / 12`, and likewise for `xy`.
    #[inline(always)]
    fn integral(&self, block: &Block, t0: f32x8<S>, t1: f32x8<S>) -> f32x8<S> {
        let (offsets, [x, y, z]) = self.cells::<false>((t0 + t1) * 0.5);
        let c = self.corners(block, offsets);
        let length = t1 - t0;
        let [dx, dy, dz] = self.direction.to_array().map(|direction| length * direction);
        let mix = |a: f32x8<S>, b: f32x8<S>, t: f32x8<S>| a + (b - a) * t;
        // Along z: values and slopes of the four edges; then along y, then along x.
        let (e0, e1, e2, e3) = (c[1] - c[0], c[3] - c[2], c[5] - c[4], c[7] - c[6]);
        let (v0, v1, v2, v3) = (c[0] + e0 * z, c[2] + e1 * z, c[4] + e2 * z, c[6] + e3 * z);
        let (y0, y1) = (v1 - v0, v3 - v2);
        let (low, high) = (v0 + y0 * y, v2 + y1 * y);
        let value = mix(low, high, x);
        let yz = mix(e1 - e0, e3 - e2, x);
        let xz = mix(e2, e3, y) - mix(e0, e1, y);
        let xy = y1 - y0;
        let mixed = xy * (dx * dy) + xz * (dx * dz) + yz * (dy * dz);
        (value + mixed * (1.0 / 12.0)) * length
    }
}

#[cfg(test)]
mod tests {
    use glam::{DAffine3, DVec3, IVec3};
    use nuage_volume::brick::{BrickSummary, Bricks};
    use nuage_volume::build::{TileSize, TreeBuilder};
    use nuage_volume::channel::{Channel, IndexBox};
    use nuage_volume::space::BRICK_VOXELS;

    use super::*;
    use crate::hash::{hash_u32, unit_f32};

    fn random(seed: u32) -> f32 {
        unit_f32(hash_u32(seed))
    }

    /// Bricks here and there, some of one value, and a large tile beside them.
    fn channel() -> Channel {
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

    fn rays() -> impl Iterator<Item = Ray> {
        (0..200).map(|i| {
            let point = |seed: u32| {
                let [x, y, z] = [1, 2, 3].map(|j| f64::from(random(seed + j)));
                DVec3::new(x * 26.0, y * 13.0, z * 13.0)
            };
            let (from, to) = (point(i * 50 + 7), point(i * 50 + 20));
            let direction =
                if i % 5 == 0 { DVec3::AXES[i as usize / 5 % 3] } else { (to - from).normalize() };
            Ray { origin: from - direction * 40.0, direction }
        })
    }

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
                assert_eq!(both(Level::baseline()), both(Level::new()), "{ray:?}");
            }
        }
    }

    #[test]
    fn the_map_and_the_tree_lead_the_same_way() {
        let channel = channel();
        let field = Field::new(&channel).unwrap();
        let by_tree = Field::new(&channel).unwrap().without_map();
        let (mut reader, mut tree_reader) = (field.reader(), by_tree.reader());
        assert!(field.map().is_some() && by_tree.map().is_none());
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
                || BrickRay::new(simd, &ray, &span).sample::<false>(&block, f32x8::splat(simd, 0.0)).to_array()
            ));
            assert_eq!(lanes, [interpolate(&block, at); 8]);
        }
    }
}
