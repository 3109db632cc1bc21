//! Line integrals along the rays of a packet: what [`depth`](crate::depth) gives for each of them.

use fearless_simd::{Level, Simd, dispatch, f32x16, i32x16, mask32x16, prelude::*};
use nuage_volume::brick::Bricks;

use super::ahead::{Asked, EACH_VOXELS, ahead_of, ask_for_block, ask_for_brick};
use super::{Lanes, Packet, RAYS, Stretch, bricks_of, each_ray, interpolate, to_int};
use crate::blocks::Blocks;
use crate::camera::Ray;
use crate::depth::{self, NEAREST_SHIFT, Stored};
use crate::filter::Filter;
use crate::simd::level;
use crate::traverse::{Field, Reader};
use crate::walk::{SPECIAL, Sight};

/// The integral of a field along each ray: [`optical_depth`](depth::optical_depth) of it.
pub fn optical_depths<'a>(
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    rays: &[Ray; RAYS],
    filter: Filter,
) -> [f32; RAYS] {
    optical_depths_at(level(), field, reader, rays, filter)
}

/// The share of light that passes along each ray: [`stepped_transmittance`](depth::stepped_transmittance) of it.
pub fn stepped_transmittances<'a>(
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    rays: &[Ray; RAYS],
    filter: Filter,
    step_voxels: f32,
    extinction: f32,
) -> [f32; RAYS] {
    stepped_transmittances_at(level(), field, reader, rays, filter, step_voxels, extinction)
}

pub(super) fn optical_depths_at<'a>(
    level: Level,
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    rays: &[Ray; RAYS],
    filter: Filter,
) -> [f32; RAYS] {
    let (sight, shift) = sight_of(filter);
    let Some(map) = field.map(sight) else {
        return each_ray!(|lane| depth::optical_depth_at(level, field, reader, &rays[lane], filter));
    };
    dispatch!(level, simd => simd.vectorize(
        #[inline(always)]
        || {
            let Some(packet) = Packet::enter(field, rays, shift, None) else { return [0.0; RAYS] };
            let lanes = Lanes::new(simd, map, &packet);
            match (filter, &field.tree().bricks) {
                (Filter::Nearest, Bricks::F32(values)) => integrate_voxels(&lanes, values),
                (Filter::Nearest, Bricks::F16(values)) => integrate_voxels(&lanes, values),
                (Filter::Trilinear, _) => integrate_cells(&lanes, field, &mut reader.blocks),
            }
        }
    ))
}

pub(super) fn stepped_transmittances_at<'a>(
    level: Level,
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    rays: &[Ray; RAYS],
    filter: Filter,
    step_voxels: f32,
    extinction: f32,
) -> [f32; RAYS] {
    let (sight, shift) = sight_of(filter);
    let Some(map) = field.map(sight) else {
        return each_ray!(|lane| {
            depth::stepped_transmittance_at(
                level,
                field,
                reader,
                &rays[lane],
                filter,
                step_voxels,
                extinction,
            )
        });
    };
    dispatch!(level, simd => simd.vectorize(
        #[inline(always)]
        || {
            let Some(packet) = Packet::enter(field, rays, shift, Some(step_voxels)) else { return [1.0; RAYS] };
            let lanes = Lanes::new(simd, map, &packet);
            let steps = f32x16::simd_from(simd, each_ray!(|lane| packet.steps[lane] as f32));
            match (filter, &field.tree().bricks) {
                (Filter::Nearest, Bricks::F32(values)) => sample_voxels(&lanes, values, steps, extinction),
                (Filter::Nearest, Bricks::F16(values)) => sample_voxels(&lanes, values, steps, extinction),
                (Filter::Trilinear, _) => sample_cells(&lanes, field, &mut reader.blocks, steps, extinction),
            }
        }
    ))
}

fn sight_of(filter: Filter) -> (Sight, f64) {
    match filter {
        Filter::Nearest => (Sight::Voxels, NEAREST_SHIFT),
        Filter::Trilinear => (Sight::Cells, 0.0),
    }
}

/// The values of voxels in bricks; those of special cells of the map; 0 where cells are empty.
#[inline(always)]
pub(super) fn values_of<S: Simd, V: Stored>(
    lanes: &Lanes<'_, S>,
    values: &[V],
    cells: i32x16<S>,
    voxels: [i32x16<S>; 3],
) -> f32x16<S> {
    let simd = lanes.simd;
    let found = V::gather(simd, values, places_of(simd, cells, voxels));
    lanes.with_specials(cells, found)
}

/// The places of voxels in the values of all bricks; beyond all where cells hold no brick.
#[inline(always)]
fn places_of<S: Simd>(simd: S, cells: i32x16<S>, voxels: [i32x16<S>; 3]) -> i32x16<S> {
    let offsets = ((voxels[0] & 7) << 6) | ((voxels[1] & 7) << 3) | (voxels[2] & 7);
    let holds_brick = cells.simd_ge(0) & cells.simd_lt(SPECIAL);
    holds_brick.select((cells << 9) | offsets, i32x16::splat(simd, -1))
}

#[inline(always)]
fn integrate_voxels<S: Simd, V: Stored>(lanes: &Lanes<'_, S>, values: &[V]) -> [f32; RAYS] {
    let (none, mut depth) = (mask32x16::splat(lanes.simd, false), lanes.splat(0.0));
    let ahead = ahead_of(lanes);
    let mut asked = Asked::new(EACH_VOXELS);
    lanes.each_stretch(
        #[inline(always)]
        |stretch| {
            asked.look_ahead(lanes, stretch.t + ahead, |brick| ask_for_brick(values, brick));
            // Those that have left stand in an empty cell.
            depth +=
                values_of(lanes, values, stretch.cells, to_int(stretch.voxels)) * (stretch.end - stretch.t);
            none
        },
    );
    depth.to_array()
}

#[inline(always)]
fn integrate_cells<'a, S: Simd>(
    lanes: &Lanes<'_, S>,
    field: &Field<'a>,
    blocks: &mut Blocks<'a>,
) -> [f32; RAYS] {
    let (none, mut depth) = (mask32x16::splat(lanes.simd, false), lanes.splat(0.0));
    let (ahead, mut asked) = (ahead_of(lanes), Asked::new(EACH_VOXELS));
    lanes.each_stretch(
        #[inline(always)]
        |stretch| {
            asked.look_ahead(lanes, stretch.t + ahead, |entry| ask_for_block(blocks, entry));
            if stretch.is_filled().any_true() {
                let Stretch { t, end, voxels, cells, .. } = *stretch;
                let length = end - t;
                let corners = lanes.corners(field, blocks, cells, to_int(voxels));
                let middle = lanes.at((t + end) * 0.5);
                let along = |axis: usize| (middle[axis] - voxels[axis], lanes.direction[axis] * length);
                let ((x, dx), (y, dy), (z, dz)) = (along(0), along(1), along(2));
                let mean = depth::mean_in_cell!(corners, [x, y, z], [dx, dy, dz]);
                depth += lanes.with_specials(cells, mean) * length;
            }
            none
        },
    );
    depth.to_array()
}

/// Goes from cell to cell: two samples or so lie in each, and its corners are looked up once.
#[inline(always)]
fn sample_cells<'a, S: Simd>(
    lanes: &Lanes<'_, S>,
    field: &Field<'a>,
    blocks: &mut Blocks<'a>,
    steps: f32x16<S>,
    extinction: f32,
) -> [f32; RAYS] {
    let (zero, one) = (lanes.splat(0.0), lanes.splat(1.0));
    let (per_step, loss) = (one / steps, steps * extinction);
    let none = mask32x16::splat(lanes.simd, false);
    let (mut number, mut passes) = (zero, one);
    let (ahead, mut asked) = (ahead_of(lanes), Asked::new(EACH_VOXELS));
    lanes.each_stretch(
        #[inline(always)]
        |stretch| {
            asked.look_ahead(lanes, stretch.t + ahead, |entry| ask_for_block(blocks, entry));
            let Stretch { end, voxels, cells, .. } = *stretch;
            let mut t_sample = number * steps;
            let mut inside = stretch.is_filled() & t_sample.simd_lt(end);
            if inside.any_true() {
                let corners = lanes.corners(field, blocks, cells, to_int(voxels));
                while inside.any_true() {
                    let position = lanes.at(t_sample);
                    let along = |axis: usize| position[axis] - voxels[axis];
                    let value = interpolate(&corners, [along(0), along(1), along(2)]);
                    let lost = lanes.with_specials(cells, value) * loss;
                    passes *= one - inside.select(lost, zero);
                    number += inside.select(one, zero);
                    t_sample = number * steps;
                    inside &= t_sample.simd_lt(end);
                }
            }
            let is_empty = cells.simd_lt(0);
            if is_empty.any_true() {
                number = is_empty.select((end * per_step).ceil().max(number), number);
            }
            none
        },
    );
    passes.to_array()
}

/// Goes from sample to sample.
#[inline(always)]
fn sample_voxels<S: Simd, V: Stored>(
    lanes: &Lanes<'_, S>,
    values: &[V],
    steps: f32x16<S>,
    extinction: f32,
) -> [f32; RAYS] {
    let (one, per_step, loss) = (lanes.splat(1.0), lanes.splat(1.0) / steps, steps * extinction);
    let (mut number, mut passes, mut asked) = (lanes.splat(0.0), one, Asked::new(2 * EACH_VOXELS));
    let ahead = ahead_of(lanes);
    loop {
        let t = number * steps;
        let active = t.simd_lt(lanes.ends);
        if !active.any_true() {
            break;
        }
        let position = lanes.at(t);
        let bricks = bricks_of(position);
        let cells = lanes.cells(bricks, active);
        let is_empty = cells.simd_lt(0);
        number += one;
        if !is_empty.all_true() {
            asked.look_ahead(lanes, t + ahead, |brick| ask_for_brick(values, brick));
            passes *= one - values_of(lanes, values, cells, to_int(position)) * loss;
        }
        if (is_empty & active).any_true() {
            let leaving = lanes.leave_bricks(bricks, lanes.beyond(cells), t);
            let next = (leaving * per_step).ceil().max(number);
            number = is_empty.select(next, number);
        }
    }
    passes.to_array()
}
