//! Where light collides first along the rays of a packet: what [`track`](crate::track) gives for each of them.

use fearless_simd::{Level, Simd, dispatch, f32x16, prelude::*};
use glam::Vec3;

use super::{Lanes, Packet, RAYS, bricks_of, each_axis, each_bit, each_ray};
use crate::blocks::Blocks;
use crate::camera::Ray;
use crate::depth::{corners_around, interpolate};
use crate::gather::prefetch;
use crate::math::ln;
use crate::simd::level;
use crate::track;
use crate::traverse::{Field, Reader};
use crate::walk::{BORDER, SPECIAL, Sight};

/// The distance at which each ray collides with a medium of `extinction` at value 1, per world length:
/// [`first_collision`](track::first_collision) of it.
///
/// `random` gives numbers from 0 to less than 1 by 2⁻²⁴ or more, those of a ray by its place in the packet.
pub fn first_collisions<'a>(
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    rays: &[Ray; RAYS],
    extinction: f32,
    random: impl FnMut(usize) -> f32,
) -> [Option<f64>; RAYS] {
    first_collisions_at(level(), field, reader, rays, extinction, random)
}

pub(super) fn first_collisions_at<'a>(
    level: Level,
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    rays: &[Ray; RAYS],
    extinction: f32,
    mut random: impl FnMut(usize) -> f32,
) -> [Option<f64>; RAYS] {
    if field.map(Sight::Cells).is_none() {
        return each_ray!(|lane| track::first_collision(field, reader, &rays[lane], extinction, || random(
            lane
        )));
    }
    dispatch!(level, simd => simd.vectorize(
        #[inline(always)]
        || {
            let map = field.map(Sight::Cells)?;
            let packet = Packet::enter(field, rays, 0.0, None)?;
            let lanes = Lanes::new(simd, map, &packet);
            let hits = collide(&lanes, field, &mut reader.blocks, extinction, &mut random);
            Some(each_ray!(|lane| hits[lane].map(|t| packet.starts[lane] + f64::from(t))))
        }
    ))
    .unwrap_or_default()
}

/// An optical depth at which a ray collides.
#[inline(always)]
fn depth(random: f32) -> f32 {
    -ln(1.0 - random)
}

#[inline(always)]
fn collide<'a, S: Simd>(
    lanes: &Lanes<'_, S>,
    field: &Field<'a>,
    blocks: &mut Blocks<'a>,
    extinction: f32,
    random: &mut impl FnMut(usize) -> f32,
) -> [Option<f32>; RAYS] {
    let (simd, zero) = (lanes.simd, lanes.splat(0.0));
    let mut hits = [None; RAYS];
    let (mut t, mut ends) = (zero, lanes.ends);
    let mut bricks = bricks_of(lanes.at(t));
    let entering = t.simd_lt(ends).to_bitmask() as u32;
    // What is left of the optical depth up to the next tentative collision.
    let mut depths = [0.0; RAYS];
    each_bit(entering, |lane| depths[lane] = depth(random(lane)));
    let mut left = f32x16::simd_from(simd, depths);
    loop {
        let active = t.simd_lt(ends);
        if !active.any_true() {
            return hits;
        }
        let places = lanes.places(bricks, active);
        let tops = lanes.tops(places);
        let step = lanes.step_bricks(bricks, (-tops - 1.0).max(zero), t);
        let majorants = tops.max(zero) * extinction;
        let here = (step.t.min(ends) - t) * majorants;
        let collides = active & left.simd_lt(here);
        let t_collision = t + left / majorants;
        left = collides.select(left, left - here);
        t = collides.select(t_collision, step.t);
        let collided = collides.to_bitmask() as u32;
        if collided != 0 {
            let position = lanes.at(t);
            let place = each_axis!(|axis| bricks[axis].to_array());
            let position = each_axis!(|axis| position[axis].to_array());
            let (places, tops) = (places.to_array(), tops.to_array());
            let (mut depths, mut new_ends) = (left.to_array(), ends.to_array());
            let at = t.to_array();
            let cells =
                each_ray!(|lane| lanes.map.cells().get(places[lane] as usize).copied().unwrap_or(SPECIAL));
            let corner_of = |lane: usize| Vec3::new(place[0][lane], place[1][lane], place[2][lane]) * 8.0;
            let position_of =
                |lane: usize| Vec3::new(position[0][lane], position[1][lane], position[2][lane]);
            // All values are asked for before the first is used: they come from memory side by side.
            each_bit(collided, |lane| {
                if let Some(block) = blocks.known(cells[lane] as usize) {
                    prefetch(corners_around(block, position_of(lane) - corner_of(lane)));
                }
            });
            let mut values = [f32::INFINITY; RAYS];
            each_bit(collided, |lane| {
                let corner = corner_of(lane);
                let block = match cells[lane] {
                    SPECIAL.. => return,
                    BORDER => blocks.of_tile(field.brick_at(corner)),
                    entry => blocks.of_entry(entry as usize, || field.brick_at(corner)),
                };
                values[lane] = interpolate(block, position_of(lane) - corner);
            });
            each_bit(collided, |lane| {
                let is_real = values[lane] == f32::INFINITY || random(lane) * tops[lane] < values[lane];
                match is_real {
                    true => (hits[lane], new_ends[lane]) = (Some(at[lane]), 0.0),
                    false => depths[lane] = depth(random(lane)),
                }
            });
            (left, ends) = (f32x16::simd_from(simd, depths), f32x16::simd_from(simd, new_ends));
        }
        bricks = each_axis!(|axis| collides.select(bricks[axis], step.behind[axis]));
    }
}
