//! Where the rays of a packet meet a surface first: what [`surface`](crate::surface) gives for each of them.

use fearless_simd::{Level, Simd, dispatch, f32x16, prelude::*};
use glam::Vec3;
use nuage_volume::accessor::Accessor;

use super::{Lanes, Packet, RAYS, bricks_of, each_bit, each_ray, interpolate, to_int, trunc};
use crate::camera::Ray;
use crate::simd::level;
use crate::surface::{self, SurfaceHit, first_hit, meet_in_cell};
use crate::traverse::{Field, Reader};
use crate::walk::{BrickMap, SPECIAL};

/// A surface where a field reaches a level, a value above 0, made ready for packets of rays.
#[derive(Debug, Clone)]
pub struct Surface<'f, 'a> {
    field: &'f Field<'a>,
    level: f32,
    /// The bricks that reach the level somewhere. `None` if there are too many, or some blend with tiles.
    map: Option<BrickMap>,
}

impl<'f, 'a> Surface<'f, 'a> {
    /// Makes a surface ready.
    pub fn new(field: &'f Field<'a>, level: f32) -> Self {
        let map = field.map_above(&mut Accessor::new(field.tree()), level).filter(BrickMap::is_plain);
        Surface { field, level, map }
    }

    /// Where each ray meets the surface first: [`first_hit`] of it.
    pub fn first_hits(&self, reader: &mut Reader<'a>, rays: &[Ray; RAYS]) -> [Option<SurfaceHit>; RAYS] {
        self.first_hits_at(level(), reader, rays)
    }

    fn first_hits_at(
        &self,
        level: Level,
        reader: &mut Reader<'a>,
        rays: &[Ray; RAYS],
    ) -> [Option<SurfaceHit>; RAYS] {
        let Some(map) = &self.map else {
            return each_ray!(|lane| first_hit(self.field, reader, &rays[lane], self.level));
        };
        let met = dispatch!(level, simd => simd.vectorize(
            #[inline(always)]
            || {
                let packet = Packet::enter(self.field, rays, 0.0, None)?;
                let lanes = Lanes::new(simd, map, &packet);
                let met = meet(&lanes, self.field, reader, self.level);
                Some((packet, met))
            }
        ));
        let Some((packet, met)) = met else { return [None; RAYS] };
        each_ray!(|lane| met[lane].map(|t| {
            let along = |axis: usize| packet.origin[axis][lane] + packet.direction[axis][lane] * t;
            let position = Vec3::new(along(0), along(1), along(2));
            surface::hit(self.field, &mut reader.blocks, &rays[lane], packet.starts[lane] + f64::from(t), position)
        }))
    }
}

#[inline(always)]
fn meet<'a, S: Simd>(
    lanes: &Lanes<'_, S>,
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    level: f32,
) -> [Option<f32>; RAYS] {
    let mut hits = [None; RAYS];
    let (mut t, mut ends) = (lanes.splat(0.0), lanes.ends);
    let mut voxels = trunc(lanes.at(t));
    loop {
        let active = t.simd_lt(ends);
        if !active.any_true() {
            return hits;
        }
        let cells = lanes.cells(bricks_of(voxels), active);
        let step = lanes.step(voxels, cells, active, t);
        let mut reached = (active & cells.simd_ge(SPECIAL)).to_bitmask() as u32;
        let holds_brick = active & cells.simd_ge(0);
        if holds_brick.any_true() {
            let corners = lanes.corners(field, &mut reader.blocks, cells, to_int(voxels));
            // Where a ray leaves a cell, the value is that of the next one too.
            let end = lanes.at(step.t.min(ends));
            let along = |axis: usize| end[axis] - voxels[axis];
            let value = interpolate(corners, [along(0), along(1), along(2)]);
            reached |= (holds_brick & value.simd_ge(level)).to_bitmask() as u32;
        }
        if reached != 0 {
            let (starts, leaves, cells) = (t.to_array(), step.t.min(ends).to_array(), cells.to_array());
            let mut new_ends = ends.to_array();
            each_bit(reached, |lane| {
                let [t0, t1] = [starts[lane], leaves[lane]];
                let block = (cells[lane] < SPECIAL).then(|| reader.blocks.known(cells[lane] as usize)).flatten();
                let corner = |axis: usize| (voxels[axis].to_array()[lane] as i32 & !7) as f32;
                let origin = |axis: usize| lanes.origin[axis].to_array()[lane] - corner(axis);
                let direction = |axis: usize| lanes.direction[axis].to_array()[lane];
                let origin = Vec3::new(origin(0), origin(1), origin(2));
                let direction = Vec3::new(direction(0), direction(1), direction(2));
                let t = block.map_or(t0, |block| meet_in_cell(block, origin, direction, [t0, t1], level));
                (hits[lane], new_ends[lane]) = (Some(t), 0.0);
            });
            ends = f32x16::simd_from(lanes.simd, new_ends);
        }
        (t, voxels) = (step.t, step.behind);
    }
}
