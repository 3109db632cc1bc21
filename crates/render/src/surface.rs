//! What a ray meets first: the surface where the interpolated field reaches a level, and the first voxel above a level.
//!
//! A level set is drawn as a surface by a channel that grows inwards, such as `nuage_pipeline::import::import_surface`
//! makes: bricks that stay below the level are not looked into.

use fearless_simd::{Simd, dispatch, f32x8, prelude::*};
use glam::{IVec3, Vec3};
use nuage_volume::brick::Bricks;

use crate::blocks::{Block, Blocks};
use crate::camera::Ray;
use crate::depth::{BrickRay, Crossings, NEAREST_SHIFT, block_of, corners_at};
use crate::simd::level;
use crate::traverse::{Field, LocalRay, Reader};
use crate::walk::{BrickSpan, Sight, SortedRay, SpanContent, Spans, with_spans};

/// Where a ray meets a surface.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SurfaceHit {
    /// The distance from the ray's origin, in world lengths.
    pub distance: f64,
    /// The normal in the world, of length 1, towards smaller values; back along the ray where the field is flat or the ray began
    /// inside.
    pub normal: Vec3,
}

/// The first voxel of its kind on a ray.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VoxelHit {
    /// The distance from the ray's origin at which the ray enters the voxel, in world lengths.
    pub distance: f64,
    /// The voxel's index.
    pub voxel: IVec3,
    /// Its value.
    pub value: f32,
}

/// Where the trilinear interpolation first reaches `surface`, a value above 0, from below; where the ray enters the field if it
/// is above there.
///
/// It is looked at where the ray goes from cell to cell, so that a ray which dips through a surface within a cell may miss it.
/// The place itself is found on the cubic that the interpolation is inside the cell.
pub fn first_hit<'a>(
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    ray: &Ray,
    surface: f32,
) -> Option<SurfaceHit> {
    let Reader { walker, blocks, .. } = reader;
    let (start, t, position) = dispatch!(level(), simd => simd.vectorize(
        #[inline(always)]
        || {
            let entered = field.enter(ray, 0.0)?;
            let [start, end] = entered.interval;
            let sorted = SortedRay::new(entered.local(start));
            let length = (end - start) as f32;
            let t = with_spans!(simd, Sight::Cells, field, walker, &sorted, length, |spans| {
                meet_surface(simd, field, blocks, &sorted, spans, surface)
            })?;
            Some((start, t, sorted.local.at(t)))
        }
    ))?;
    Some(hit(field, ray, start + f64::from(t), slope(field, blocks, position)))
}

/// What a ray meets at a distance, the field having a slope there along each axis of the walk.
pub(crate) fn hit(field: &Field<'_>, ray: &Ray, distance: f64, slope: Vec3) -> SurfaceHit {
    // A normal turns with the transposed inverse of what turns points.
    let normal = (field.directions().transpose() * -slope).try_normalize();
    SurfaceHit { distance, normal: normal.unwrap_or(-ray.direction.as_vec3()) }
}

/// The first voxel of a value above `above`, which is not negative; voxels are boxes around their places.
pub fn first_voxel<'a>(
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    ray: &Ray,
    above: f32,
) -> Option<VoxelHit> {
    dispatch!(level(), simd => simd.vectorize(
        #[inline(always)]
        || {
            let entered = field.enter(ray, NEAREST_SHIFT)?;
            let [start, end] = entered.interval;
            let sorted = SortedRay::new(entered.local(start));
            let length = (end - start) as f32;
            let bricks = &field.tree().bricks;
            let (t, place, value) =
                with_spans!(simd, Sight::Voxels, field, &mut reader.walker, &sorted, length, |spans| {
                    meet_voxel(simd, bricks, &sorted, spans, above)
                })?;
            Some(VoxelHit { distance: start + f64::from(t), voxel: field.voxel_at(place), value })
        }
    ))
}

/// Halvings and chords until a root is as good as single precision makes it.
pub const MOST_REFINEMENTS: usize = 16;

#[inline(always)]
fn meet_surface<'a, S: Simd>(
    simd: S,
    field: &Field<'a>,
    blocks: &mut Blocks<'a>,
    ray: &SortedRay,
    mut spans: impl Spans,
    surface: f32,
) -> Option<f32> {
    while let Some(span) = spans.next_span() {
        match span.content {
            SpanContent::Brick(entry) if field.bounds(entry).max < surface => continue,
            SpanContent::Constant(value) if value < surface => continue,
            SpanContent::Constant(_) => return Some(span.t0),
            _ => {}
        }
        let Ok(block) = block_of(field, blocks, &span) else { continue };
        let crossings = Crossings::of(simd, ray, &span);
        let local = &ray.local;
        let brick = BrickRay::new(simd, local, &span);
        let mut cell = 0;
        while cell < crossings.cells {
            // Where cells end, the value is that of the next one too.
            let ends = f32x8::from_slice(simd, &crossings.t[cell + 1..cell + 9]);
            let reached = brick.sample(block, ends).simd_ge(f32x8::splat(simd, surface)).to_bitmask();
            let first = cell + reached.trailing_zeros() as usize;
            if reached != 0 && first < crossings.cells {
                let ends = [crossings.t[first], crossings.t[first + 1]];
                return Some(meet_in_cell(block, local.origin - span.corner, local.direction, ends, surface));
            }
            cell += 8;
        }
    }
    None
}

/// Where the interpolation in a cell reaches the surface, which it has done at the end.
#[inline(always)]
fn meet_in_cell(block: &Block, origin: Vec3, direction: Vec3, [t0, t1]: [f32; 2], surface: f32) -> f32 {
    let cell = (origin + direction * (0.5 * (t0 + t1))).clamp(Vec3::ZERO, Vec3::splat(7.0)).floor();
    let c = corners_at(block, cell);
    let value = |t: f32| {
        let [x, y, z] = (origin + direction * t - cell).to_array();
        let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let low = mix(mix(c[0], c[1], z), mix(c[2], c[3], z), y);
        let high = mix(mix(c[4], c[5], z), mix(c[6], c[7], z), y);
        mix(low, high, x) - surface
    };
    let (value_0, value_1) = (value(t0), value(t1));
    match value_0 < 0.0 && value_1 > 0.0 {
        true => root(value, [t0, t1], [value_0, value_1]),
        // Inside from the start, or rounding has moved it to an end.
        false if value_0 >= 0.0 => t0,
        false => t1,
    }
}

/// Where a function goes from below 0 to 0 or above, by chords, and by halves where those are slow.
#[inline(always)]
fn root(value: impl Fn(f32) -> f32, [mut a, mut b]: [f32; 2], [mut value_a, mut value_b]: [f32; 2]) -> f32 {
    let tolerance = 1e-4 * (b - a);
    for turn in 0..MOST_REFINEMENTS {
        let chord = a - value_a * (b - a) / (value_b - value_a);
        let middle = 0.5 * (a + b);
        let t = if turn % 3 == 2 || !(chord > a && chord < b) { middle } else { chord };
        let value_t = value(t);
        if value_t.abs() <= 1e-6 * (value_b - value_a) {
            return t;
        }
        match value_t >= 0.0 {
            true => (b, value_b) = (t, value_t),
            false => (a, value_a) = (t, value_t),
        }
        if b - a <= tolerance {
            break;
        }
    }
    b
}

/// The gradient of the interpolation at a position, over a voxel to both sides along each axis.
#[inline]
fn slope<'a>(field: &Field<'a>, blocks: &mut Blocks<'a>, position: Vec3) -> Vec3 {
    let mut along = |axis: Vec3| {
        field.sample(blocks, position + axis) - field.sample(blocks, (position - axis).max(Vec3::ZERO))
    };
    Vec3::new(along(Vec3::X), along(Vec3::Y), along(Vec3::Z))
}

#[inline(always)]
fn meet_voxel<S: Simd>(
    simd: S,
    bricks: &Bricks,
    ray: &SortedRay,
    mut spans: impl Spans,
    above: f32,
) -> Option<(f32, Vec3, f32)> {
    while let Some(span) = spans.next_span() {
        let number = match span.content {
            SpanContent::Brick(number) => number,
            SpanContent::Constant(value) if value > above => {
                return Some((span.t0, in_span(&ray.local, &span), value));
            }
            _ => continue,
        };
        let crossings = Crossings::of(simd, ray, &span);
        for cell in crossings.t[..=crossings.cells].windows(2) {
            let middle = ray.local.at(0.5 * (cell[0] + cell[1])) - span.corner;
            let voxel = middle.clamp(Vec3::ZERO, Vec3::splat(7.0)).as_ivec3();
            let value = bricks.value(number, (voxel.x << 6 | voxel.y << 3 | voxel.z) as usize);
            if value > above {
                return Some((cell[0], span.corner + voxel.as_vec3(), value));
            }
        }
    }
    None
}

/// The voxel in which a span begins. A span of one value may be larger than a brick; it begins in the one of its corner.
fn in_span(local: &LocalRay, span: &BrickSpan) -> Vec3 {
    span.corner + (local.at(span.t0) - span.corner).clamp(Vec3::ZERO, Vec3::splat(7.0)).floor()
}
