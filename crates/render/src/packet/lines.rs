//! Line integrals along the rays of a packet: what [`depth`](crate::depth) gives for each of them.

use fearless_simd::{Level, Simd, dispatch, f32x16, i32x16, mask32x16, prelude::*};
use nuage_volume::brick::Bricks;

use super::late::{Asked, Late, ask_for_brick, ask_for_half};
use super::{Lanes, Packet, RAYS, Stretch, each_axis, each_ray, interpolate, to_int};
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
    values_at(lanes, values, places_of(lanes.simd, cells, voxels))
}

/// How many turns pass between asking for values and using them, by what a turn is: a voxel or a cell.
const VOXEL_TURNS: usize = 32;
const CELL_TURNS: usize = 16;

/// The place beyond all values, whose value is 0. Below it stand the constants of special cells.
const NO_PLACE: i32 = -1;

/// The places of voxels in the values of all bricks, or of the constants of special cells.
#[inline(always)]
fn places_of<S: Simd>(simd: S, cells: i32x16<S>, voxels: [i32x16<S>; 3]) -> i32x16<S> {
    let offsets = ((voxels[0] & 7) << 6) | ((voxels[1] & 7) << 3) | (voxels[2] & 7);
    let of_brick = (cells << 9) | offsets;
    let is_special = cells.simd_ge(SPECIAL);
    let others =
        is_special.select(i32x16::splat(simd, NO_PLACE - 1 + SPECIAL) - cells, i32x16::splat(simd, NO_PLACE));
    (cells.simd_ge(0) & !is_special).select(of_brick, others)
}

/// The values at places.
#[inline(always)]
fn values_at<S: Simd, V: Stored>(lanes: &Lanes<'_, S>, values: &[V], places: i32x16<S>) -> f32x16<S> {
    let found = V::gather(lanes.simd, values, places);
    let is_special = places.simd_lt(NO_PLACE);
    match is_special.any_true() {
        true => is_special.select(lanes.constants(i32x16::splat(lanes.simd, NO_PLACE - 1) - places), found),
        false => found,
    }
}

/// Goes along all rays from voxel to voxel: calls with each stretch for what its value counts, and, some turns later and in the same
/// order, with both.
#[inline(always)]
fn each_voxel<S: Simd, V: Stored>(
    lanes: &Lanes<'_, S>,
    values: &[V],
    mut weigh: impl FnMut(&Stretch<S>) -> f32x16<S>,
    mut take: impl FnMut(f32x16<S>, f32x16<S>),
) {
    let (simd, nobody) = (lanes.simd, mask32x16::splat(lanes.simd, false));
    let mut asked = Asked::new(simd);
    let mut late = Late::<_, VOXEL_TURNS>::new((i32x16::splat(simd, NO_PLACE), lanes.splat(0.0)));
    lanes.each_stretch(
        #[inline(always)]
        |stretch| {
            ask_for_brick(values, asked.choose(simd, stretch.cells));
            // Those that have left stand in an empty cell.
            let places = places_of(simd, stretch.cells, to_int(stretch.voxels));
            if let Some((places, weight)) = late.keep((places, weigh(stretch))) {
                take(values_at(lanes, values, places), weight);
            }
            nobody
        },
    );
    for (places, weight) in late.rest() {
        take(values_at(lanes, values, places), weight);
    }
}

/// Goes along all rays from cell to cell, and calls with each stretch some turns after its block was asked for: two turns after what
/// says where that is.
#[inline(always)]
fn each_cell<'a, S: Simd>(
    lanes: &Lanes<'_, S>,
    blocks: &mut Blocks<'a>,
    mut visit: impl FnMut(&mut Blocks<'a>, &Stretch<S>),
) {
    let (simd, nobody) = (lanes.simd, mask32x16::splat(lanes.simd, false));
    let (zero, nowhere) = (lanes.splat(0.0), i32x16::splat(simd, -1));
    let filler = Stretch { t: zero, end: zero, voxels: [zero; 3], cells: nowhere, active: nobody };
    let (mut asked, mut late) = (Asked::new(simd), Late::<_, CELL_TURNS>::new(filler));
    let (mut next, mut entry, mut is_second) = (0, 0, false);
    lanes.each_stretch(
        #[inline(always)]
        |stretch| {
            if !is_second {
                next = asked.choose(simd, stretch.cells);
                blocks.ask_for_place(next);
            }
            ask_for_half(blocks, entry, is_second);
            if is_second {
                entry = next;
            }
            is_second = !is_second;
            if let Some(stretch) = late.keep(*stretch) {
                visit(blocks, &stretch);
            }
            nobody
        },
    );
    for stretch in late.rest() {
        visit(blocks, &stretch);
    }
}

#[inline(always)]
fn integrate_voxels<S: Simd, V: Stored>(lanes: &Lanes<'_, S>, values: &[V]) -> [f32; RAYS] {
    let mut depth = lanes.splat(0.0);
    each_voxel(
        lanes,
        values,
        #[inline(always)]
        |stretch| stretch.end - stretch.t,
        #[inline(always)]
        |value, length| depth += value * length,
    );
    depth.to_array()
}

#[inline(always)]
fn integrate_cells<'a, S: Simd>(
    lanes: &Lanes<'_, S>,
    field: &Field<'a>,
    blocks: &mut Blocks<'a>,
) -> [f32; RAYS] {
    let mut depth = lanes.splat(0.0);
    each_cell(
        lanes,
        blocks,
        #[inline(always)]
        |blocks, stretch| {
            if stretch.is_filled().any_true() {
                let Stretch { t, end, voxels, cells, .. } = *stretch;
                let length = end - t;
                let corners = lanes.corners(field, blocks, cells, to_int(voxels));
                let middle = lanes.at((t + end) * 0.5);
                let [x, y, z] = each_axis!(|axis| middle[axis] - voxels[axis]);
                let [dx, dy, dz] = each_axis!(|axis| lanes.direction[axis] * length);
                let mean = depth::mean_in_cell!(corners, [x, y, z], [dx, dy, dz]);
                depth += lanes.with_specials(cells, mean) * length;
            }
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
    let (mut number, mut passes) = (zero, one);
    each_cell(
        lanes,
        blocks,
        #[inline(always)]
        |blocks, stretch| {
            let Stretch { end, voxels, cells, .. } = *stretch;
            let mut t_sample = number * steps;
            let mut inside = stretch.is_filled() & t_sample.simd_lt(end);
            if inside.any_true() {
                let corners = lanes.corners(field, blocks, cells, to_int(voxels));
                while inside.any_true() {
                    let position = lanes.at(t_sample);
                    let value = interpolate(&corners, each_axis!(|axis| position[axis] - voxels[axis]));
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
        },
    );
    passes.to_array()
}

/// Goes from voxel to voxel: all samples in one find the same value.
#[inline(always)]
fn sample_voxels<S: Simd, V: Stored>(
    lanes: &Lanes<'_, S>,
    values: &[V],
    steps: f32x16<S>,
    extinction: f32,
) -> [f32; RAYS] {
    let one = lanes.splat(1.0);
    let (per_step, loss) = (one / steps, steps * extinction);
    let (mut number, mut passes) = (lanes.splat(0.0), one);
    each_voxel(
        lanes,
        values,
        #[inline(always)]
        |stretch| {
            let before = number;
            number = (stretch.end * per_step).ceil().max(before);
            number - before
        },
        #[inline(always)]
        |value, samples| passes *= power(one - value * loss, samples),
    );
    passes.to_array()
}

/// Powers whose exponents are whole numbers, mostly small ones.
#[inline(always)]
fn power<S: Simd>(base: f32x16<S>, exponent: f32x16<S>) -> f32x16<S> {
    let simd = base.simd;
    let (one, zero) = (f32x16::splat(simd, 1.0), i32x16::splat(simd, 0));
    let (mut left, mut square) = (exponent.to_int::<i32x16<S>>(), base);
    let mut product = one;
    // Not a loop up to the largest exponent: how often it turns could not be told before.
    for _ in 0..3 {
        product *= (left & 1).simd_eq(zero).select(one, square);
        square *= square;
        left >>= 1;
    }
    while left.simd_gt(zero).any_true() {
        product *= (left & 1).simd_eq(zero).select(one, square);
        square *= square;
        left >>= 1;
    }
    product
}
