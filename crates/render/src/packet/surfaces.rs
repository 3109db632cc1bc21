//! Where the rays of a packet meet a surface first: what [`surface`](crate::surface) gives for each of them.

use fearless_simd::{Level, Simd, dispatch, f32x16, mask32x16, prelude::*};
use glam::Vec3;

use super::{Lanes, Packet, RAYS, Stretch, bricks_of, each_axis, each_ray, interpolate, to_int, trunc};
use crate::blocks::Blocks;
use crate::camera::Ray;
use crate::simd::level;
use crate::surface::{self, SurfaceHit, first_hit};
use crate::traverse::{Field, Reader};
use crate::walk::{BrickMap, SPECIAL, Sight};

/// Chords that are drawn for a root: by then it is as good as single precision makes it.
const CHORDS: usize = 8;

/// A surface where a field reaches a level, a value above 0, made ready for packets of rays.
#[derive(Debug, Clone)]
pub struct Surface<'f, 'a> {
    field: &'f Field<'a>,
    level: f32,
    /// The bricks that reach the level somewhere. `None` if there are too many.
    map: Option<BrickMap>,
}

impl<'f, 'a> Surface<'f, 'a> {
    /// Makes a surface ready.
    pub fn new(field: &'f Field<'a>, level: f32) -> Self {
        let map = field.map_above(level);
        Surface { field, level, map }
    }

    /// Where each ray meets the surface first: [`first_hit`] of it.
    pub fn first_hits(&self, reader: &mut Reader<'a>, rays: &[Ray; RAYS]) -> [Option<SurfaceHit>; RAYS] {
        self.first_hits_at(level(), reader, rays)
    }

    pub(super) fn first_hits_at(
        &self,
        level: Level,
        reader: &mut Reader<'a>,
        rays: &[Ray; RAYS],
    ) -> [Option<SurfaceHit>; RAYS] {
        let (Some(map), Some(all)) = (&self.map, self.field.map(Sight::Cells)) else {
            return each_ray!(|lane| first_hit(self.field, reader, &rays[lane], self.level));
        };
        dispatch!(level, simd => simd.vectorize(
            #[inline(always)]
            || {
                let packet = Packet::enter(self.field, rays, 0.0, None)?;
                let (lanes, blocks) = (Lanes::new(simd, map, &packet), &mut reader.blocks);
                let met = meet(&lanes, self.field, blocks, self.level);
                if met.rays == 0 {
                    return None;
                }
                let t = met.roots(&lanes, lanes.splat(self.level));
                let slopes = slopes(&Lanes { map: all, ..lanes }, self.field, blocks, &met, t);
                let (t, slopes) = (t.to_array(), slopes.map(|along| along.to_array()));
                Some(each_ray!(|lane| (met.rays >> lane & 1 == 1).then(|| {
                    let slope = Vec3::new(slopes[0][lane], slopes[1][lane], slopes[2][lane]);
                    surface::hit(self.field, &rays[lane], packet.starts[lane] + f64::from(t[lane]), slope)
                })))
            }
        ))
        .unwrap_or_default()
    }
}

/// The slope of the field where each ray has met the surface, over a voxel to both sides along each axis.
#[inline(always)]
fn slopes<'a, S: Simd>(
    lanes: &Lanes<'_, S>,
    field: &Field<'a>,
    blocks: &mut Blocks<'a>,
    met: &Met<S>,
    t: f32x16<S>,
) -> [f32x16<S>; 3] {
    let (zero, one) = (lanes.splat(0.0), lanes.splat(1.0));
    let has_met = mask32x16::from_bitmask(lanes.simd, u64::from(met.rays));
    let position = lanes.at(t);
    let mut slopes = [zero; 3];
    for axis in 0..3 {
        for step in [one, -one] {
            let mut beside = position;
            beside[axis] = (beside[axis] + step).max(zero);
            let voxels = trunc(beside);
            let cells = lanes.cells(bricks_of(voxels), has_met);
            let corners = lanes.corners(field, blocks, cells, to_int(voxels));
            let fraction = [beside[0] - voxels[0], beside[1] - voxels[1], beside[2] - voxels[2]];
            slopes[axis] += step * lanes.with_specials(cells, interpolate(&corners, fraction));
        }
    }
    slopes
}

/// The cells in which rays meet a surface.
struct Met<S: Simd> {
    /// Which rays have met it, a bit each.
    rays: u32,
    /// Where each ray enters and leaves its cell.
    ends: [f32x16<S>; 2],
    /// The cell's first voxel, and its corners.
    voxels: [f32x16<S>; 3],
    corners: [f32x16<S>; 8],
}

#[inline(always)]
fn meet<'a, S: Simd>(lanes: &Lanes<'_, S>, field: &Field<'a>, blocks: &mut Blocks<'a>, level: f32) -> Met<S> {
    let (zero, level) = (lanes.splat(0.0), lanes.splat(level));
    let mut met = Met { rays: 0, ends: [zero; 2], voxels: [zero; 3], corners: [zero; 8] };
    lanes.each_stretch(
        #[inline(always)]
        |stretch| {
            let mut reached = stretch.is_filled();
            if reached.any_true() {
                let Stretch { t, end, voxels, cells, .. } = *stretch;
                // A special cell has one value, which reaches the level.
                let is_special = cells.simd_ge(SPECIAL);
                let corners = lanes.corners(field, blocks, cells, to_int(voxels));
                // Where a ray leaves a cell, the value is that of the next one too.
                let position = lanes.at(end);
                let value = interpolate(&corners, each_axis!(|axis| position[axis] - voxels[axis]));
                reached &= is_special | value.simd_ge(level);
                if reached.any_true() {
                    met.rays |= reached.to_bitmask() as u32;
                    met.ends = [reached.select(t, met.ends[0]), reached.select(end, met.ends[1])];
                    for (met, voxel) in met.voxels.iter_mut().zip(voxels) {
                        *met = reached.select(voxel, *met);
                    }
                    for (met, corner) in met.corners.iter_mut().zip(corners) {
                        *met = reached.select(is_special.select(level, corner), *met);
                    }
                }
            }
            reached
        },
    );
    met
}

impl<S: Simd> Met<S> {
    /// The interpolation in each cell.
    #[inline(always)]
    fn value(&self, lanes: &Lanes<'_, S>, t: f32x16<S>) -> f32x16<S> {
        let position = lanes.at(t);
        interpolate(&self.corners, each_axis!(|axis| position[axis] - self.voxels[axis]))
    }

    /// Where the interpolation reaches the level in each cell, which it has done where the ray leaves it.
    ///
    /// By chords, of which an end that stays counts half from its second time on (Dowell & Jarratt, "A Modified Regula Falsi
    /// Method for Computing the Root of an Equation", 1971).
    #[inline(always)]
    fn roots(&self, lanes: &Lanes<'_, S>, level: f32x16<S>) -> f32x16<S> {
        let zero = lanes.splat(0.0);
        let [mut a, mut b] = self.ends;
        let (mut value_a, mut value_b) = (self.value(lanes, a) - level, self.value(lanes, b) - level);
        // Inside from the start, or rounding has moved it to an end.
        let is_before = value_a.simd_ge(zero);
        let is_behind = value_b.simd_lt(zero);
        let (mut was_inside, mut was_outside) = (zero.simd_lt(zero), zero.simd_lt(zero));
        for _ in 0..CHORDS {
            let chord = a - value_a * (b - a) / (value_b - value_a);
            let t = chord.max(a).min(b);
            let value_t = self.value(lanes, t) - level;
            let is_inside = value_t.simd_ge(zero);
            (a, b) = (is_inside.select(a, t), is_inside.select(t, b));
            value_a = is_inside.select(was_inside.select(value_a * 0.5, value_a), value_t);
            value_b = is_inside.select(value_t, was_outside.select(value_b * 0.5, value_b));
            (was_inside, was_outside) = (is_inside, !is_inside);
        }
        let [first, last] = self.ends;
        is_before.select(first, is_behind.select(last, b))
    }
}
