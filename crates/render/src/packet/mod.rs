//! Rays of neighbouring pixels, sixteen at once: a lane each.
//!
//! A kernel over single rays ([`depth`](crate::depth), [`track`](crate::track), [`surface`](crate::surface)) spends most of
//! its time on getting from one brick to the next, and its lanes are half empty where a ray leaves a brick. Here each lane is
//! a ray of its own that goes from box to box: a voxel where there are some, and where there are none as many bricks as its
//! map of bricks (`walk`) says are empty. No lane waits for another, so that rays need not have anything in common; but those that do
//! find their values in the same lines of the cache.
//!
//! Nothing is shared between lanes, so each ray's result is the same in any company and on any vector instructions. What the
//! kernels over single rays give is the specification, and what fields without a map, or rays of which there are few, use.

use fearless_simd::{Simd, f32x16, i32x16, mask32x16, prelude::*};
use glam::IVec3;

use crate::blocks::{self, Blocks};
use crate::camera::Ray;
use crate::depth::{NOWHERE, corners_at, corners_from};
use crate::gather::{gather_f32, gather_i32};
use crate::simd::each_lane;
use crate::traverse::Field;
use crate::walk::{BORDER, BrickMap, SPECIAL};

mod late;
mod lines;
mod surfaces;
mod tracks;
mod voxels;

pub use lines::{optical_depths, stepped_transmittances};
pub use surfaces::Surface;
pub use tracks::first_collisions;
pub use voxels::first_voxels;

/// Rays of a packet.
pub const RAYS: usize = 16;

/// Pixels along each side of the square whose rays make a packet that finds much of what it reads together.
pub const SIDE: u32 = 4;

/// The pixels of such a square, row by row.
pub fn square(left: u32, top: u32) -> [[u32; 2]; RAYS] {
    each_ray!(|i| [left + i as u32 % SIDE, top + i as u32 / SIDE])
}

/// The most samples along a ray.
pub(crate) const MOST_STEPS: f64 = 8e6;

/// An array of what an expression gives for each ray of a packet; see `each_lane`.
macro_rules! each_ray {
    (|$lane:ident| $value:expr) => {
        each_ray!(@ $lane, $value, 0 1 2 3 4 5 6 7 8 9 10 11 12 13 14 15)
    };
    (@ $lane:ident, $value:expr, $($number:literal)*) => {
        [$({ let $lane: usize = $number; $value }),*]
    };
}
pub(crate) use each_ray;

/// An array of what an expression gives for each axis; see `each_lane`.
macro_rules! each_axis {
    (|$axis:ident| $value:expr) => {
        each_axis!(@ $axis, $value, 0 1 2)
    };
    (@ $axis:ident, $value:expr, $($number:literal)*) => {
        [$({ let $axis: usize = $number; $value }),*]
    };
}
pub(crate) use each_axis;

/// The rays of a packet in the positions of a field, t = 0 being where each enters it. Coordinates come by axis, then by ray.
struct Packet {
    origin: [[f32; RAYS]; 3],
    direction: [[f32; RAYS]; 3],
    inverse: [[f32; RAYS]; 3],
    /// Where t is 0, as a distance from the ray's origin.
    starts: [f64; RAYS],
    /// Where each leaves the field; not above 0 if it misses.
    ends: [f32; RAYS],
    /// The steps asked for in world lengths.
    steps: [f64; RAYS],
}

impl Packet {
    /// `None` if all rays miss. With a step, in voxels, t = 0 is the first whole multiple of it from the ray's origin on.
    ///
    /// What [`Field::enter`] does, in loops over lanes without branches.
    #[inline(always)]
    fn enter(
        field: &Field<'_>,
        rays: &[Ray; RAYS],
        shift_voxels: f64,
        step_voxels: Option<f32>,
    ) -> Option<Packet> {
        let (index_from_world, offset, [low, high]) = field.placement();
        let by_rows = index_from_world.transpose();
        let [mut origin, mut direction, mut inverse] = [[[0.0_f64; RAYS]; 3]; 3];
        let (mut starts, mut ends) = ([0.0_f64; RAYS], [f64::INFINITY; RAYS]);
        for axis in 0..3 {
            let (row, offset) = (by_rows.col(axis), offset[axis] + shift_voxels);
            let (low, high) = (low[axis], high[axis]);
            for lane in 0..RAYS {
                let ray = &rays[lane];
                let o = row.x * ray.origin.x + row.y * ray.origin.y + row.z * ray.origin.z + offset;
                let d = row.x * ray.direction.x + row.y * ray.direction.y + row.z * ray.direction.z;
                let i = 1.0 / d;
                let (to_low, to_high) = ((low - o) * i, (high - o) * i);
                let (near, far) = if to_low < to_high { (to_low, to_high) } else { (to_high, to_low) };
                // Along an axis along which nothing moves a ray is inside for ever or never.
                let aside = if o >= low && o <= high { f64::INFINITY } else { f64::NEG_INFINITY };
                let (near, far) = if d == 0.0 { (-aside, aside) } else { (near, far) };
                starts[lane] = if near > starts[lane] { near } else { starts[lane] };
                ends[lane] = if far < ends[lane] { far } else { ends[lane] };
                (origin[axis][lane], direction[axis][lane], inverse[axis][lane]) = (o, d, i);
            }
        }
        let (mut any, mut steps) = (false, [1.0; RAYS]);
        for lane in 0..RAYS {
            let [x, y, z] = [direction[0][lane], direction[1][lane], direction[2][lane]];
            let speed2 = x * x + y * y + z * z;
            let [x, y, z] = [origin[0][lane], origin[1][lane], origin[2][lane]];
            let distance2 = x * x + y * y + z * z;
            let mut start = starts[lane];
            if let Some(step_voxels) = step_voxels {
                // No step is so short that numbers of samples could not be told apart.
                let step = f64::from(step_voxels) / speed2.sqrt();
                let least = (ends[lane] - start) / MOST_STEPS;
                steps[lane] = if step > least { step } else { least };
                start = (start / steps[lane]).ceil() * steps[lane];
            }
            // Numbers that single precision does not hold, or that are none, are no place to begin.
            let makes_sense = speed2 > 1e-60 && speed2 < 1e60 && distance2 < 1e60;
            let is_hit = makes_sense && start < ends[lane];
            any |= is_hit;
            (starts[lane], ends[lane]) = if is_hit { (start, ends[lane]) } else { (0.0, 0.0) };
        }
        if !any {
            return None;
        }
        let mut packet = Packet {
            origin: [[0.0; RAYS]; 3],
            direction: [[0.0; RAYS]; 3],
            inverse: [[0.0; RAYS]; 3],
            starts,
            ends: [0.0; RAYS],
            steps,
        };
        for axis in 0..3 {
            for lane in 0..RAYS {
                let d = direction[axis][lane];
                packet.origin[axis][lane] = (origin[axis][lane] + d * starts[lane]) as f32;
                packet.direction[axis][lane] = d as f32;
                // An axis along which nothing moves is never the first to meet a face, be its zero negative.
                let inverse = inverse[axis][lane] as f32;
                let inverse = if inverse > f32::MIN { inverse } else { f32::MAX };
                packet.inverse[axis][lane] = if inverse < f32::MAX { inverse } else { f32::MAX };
            }
        }
        for lane in 0..RAYS {
            packet.ends[lane] = (ends[lane] - starts[lane]) as f32;
        }
        Some(packet)
    }
}

/// The rays of a packet in lanes, on their way through a map of bricks.
struct Lanes<'m, S: Simd> {
    simd: S,
    map: &'m BrickMap,
    /// How far apart neighbours along each axis are in the map.
    strides: [f32; 3],
    origin: [f32x16<S>; 3],
    direction: [f32x16<S>; 3],
    inverse: [f32x16<S>; 3],
    /// 1 along an axis along which the ray grows, else 0; and 1 or -1.
    forward: [f32x16<S>; 3],
    sign: [f32x16<S>; 3],
    /// Where each ray leaves the field.
    ends: f32x16<S>,
}

/// The stretches of rays through the boxes they are in.
#[derive(Clone, Copy)]
struct Stretch<S: Simd> {
    /// Where they begin and end.
    t: f32x16<S>,
    end: f32x16<S>,
    /// The voxels in which they begin, along each axis.
    voxels: [f32x16<S>; 3],
    /// The cells of the map; those of rays that are not active are empty.
    cells: i32x16<S>,
    /// The rays that are still on their way.
    active: mask32x16<S>,
}

impl<S: Simd> Stretch<S> {
    /// The rays that are in a brick or in a box of one value other than zero.
    #[inline(always)]
    fn is_filled(&self) -> mask32x16<S> {
        self.active & self.cells.simd_ge(0)
    }
}

/// A step of a ray out of the box it is in.
struct Step<S: Simd> {
    /// Where it leaves the box.
    t: f32x16<S>,
    /// The place behind, along each axis.
    behind: [f32x16<S>; 3],
}

/// The box that a ray is to leave next.
struct Leaving<S: Simd> {
    /// Along each axis, the face towards which the ray goes.
    faces: [f32x16<S>; 3],
    /// Where the ray meets each.
    t_faces: [f32x16<S>; 3],
    /// Where it leaves the box.
    t: f32x16<S>,
}

impl<'m, S: Simd> Lanes<'m, S> {
    #[inline(always)]
    fn new(simd: S, map: &'m BrickMap, packet: &Packet) -> Self {
        let (zero, one) = (f32x16::splat(simd, 0.0), f32x16::splat(simd, 1.0));
        let direction = each_axis!(|axis| f32x16::simd_from(simd, packet.direction[axis]));
        let is_forward = each_axis!(|axis| direction[axis].simd_ge(zero));
        Lanes {
            simd,
            map,
            strides: map.strides().map(|stride| stride as f32),
            origin: each_axis!(|axis| f32x16::simd_from(simd, packet.origin[axis])),
            direction,
            inverse: each_axis!(|axis| f32x16::simd_from(simd, packet.inverse[axis])),
            forward: each_axis!(|axis| is_forward[axis].select(one, zero)),
            sign: each_axis!(|axis| is_forward[axis].select(one, -one)),
            ends: f32x16::simd_from(simd, packet.ends),
        }
    }

    #[inline(always)]
    fn splat(&self, value: f32) -> f32x16<S> {
        f32x16::splat(self.simd, value)
    }

    /// Positions along each axis.
    #[inline(always)]
    fn at(&self, t: f32x16<S>) -> [f32x16<S>; 3] {
        each_axis!(|axis| t * self.direction[axis] + self.origin[axis])
    }

    /// Where bricks stand in the map; an empty one for rays that are not `active`.
    #[inline(always)]
    fn places(&self, bricks: [f32x16<S>; 3], active: mask32x16<S>) -> i32x16<S> {
        let at = bricks[0] * self.strides[0] + bricks[1] * self.strides[1] + bricks[2];
        active.select(at.to_int::<i32x16<S>>(), i32x16::splat(self.simd, 0))
    }

    /// The cells of the map for bricks, those of rays that are not `active` being empty.
    #[inline(always)]
    fn cells(&self, bricks: [f32x16<S>; 3], active: mask32x16<S>) -> i32x16<S> {
        gather_i32(self.simd, self.map.cells(), self.places(bricks, active))
    }

    /// The largest value at places of the map; below 0 it says how far away others are, as cells do.
    #[inline(always)]
    fn tops(&self, places: i32x16<S>) -> f32x16<S> {
        gather_f32(self.simd, self.map.tops(), places)
    }

    /// Constants that the map holds, by their numbers.
    #[inline(always)]
    fn constants(&self, numbers: i32x16<S>) -> f32x16<S> {
        gather_f32(self.simd, self.map.constants(), numbers)
    }

    /// The values of special cells in their lanes.
    #[inline(always)]
    fn with_specials(&self, cells: i32x16<S>, others: f32x16<S>) -> f32x16<S> {
        let is_special = cells.simd_ge(SPECIAL);
        match is_special.any_true() {
            true => is_special.select(self.constants(cells - SPECIAL), others),
            false => others,
        }
    }

    /// Goes along all rays from box to box, voxel by voxel where cells of the map hold bricks. Calls with each stretch, until
    /// rays leave the field or the call says of which ones it has found what it looks for.
    #[inline(always)]
    fn each_stretch(&self, mut visit: impl FnMut(&Stretch<S>) -> mask32x16<S>) {
        let zero = self.splat(0.0);
        let (mut t, mut ends) = (zero, self.ends);
        let mut voxels = trunc(self.at(t));
        loop {
            let active = t.simd_lt(ends);
            if !active.any_true() {
                return;
            }
            let cells = self.cells(bricks_of(voxels), active);
            let step = self.step(voxels, cells, active, t);
            let found = visit(&Stretch { t, end: step.t.min(ends), voxels, cells, active });
            ends = found.select(zero, ends);
            (t, voxels) = (step.t, step.behind);
        }
    }

    /// How a ray leaves a box that ends at these faces.
    #[inline(always)]
    fn leave(&self, faces: [f32x16<S>; 3], t: f32x16<S>) -> Leaving<S> {
        let t_faces = each_axis!(|axis| (faces[axis] - self.origin[axis]) * self.inverse[axis]);
        let t = t_faces[0].min(t_faces[1]).min(t_faces[2]).max(t);
        Leaving { faces, t_faces, t }
    }

    /// How rays leave the voxels they are in, or the bricks that hold one value or none, and the voxels behind.
    #[inline(always)]
    fn step(&self, voxels: [f32x16<S>; 3], cells: i32x16<S>, active: mask32x16<S>, t: f32x16<S>) -> Step<S> {
        let faces = self.faces(voxels, self.splat(0.0));
        let is_whole = cells.simd_lt(0) | cells.simd_ge(SPECIAL);
        if !(is_whole & active).any_true() {
            let leaving = self.leave(faces, t);
            return Step { t: leaving.t, behind: self.next(&leaving, voxels) };
        }
        let brick_faces = self.faces(bricks_of(voxels), self.beyond(cells));
        let faces = each_axis!(|axis| is_whole.select(brick_faces[axis] * 8.0, faces[axis]));
        let leaving = self.leave(faces, t);
        Step { t: leaving.t, behind: self.behind(&leaving, voxels) }
    }

    /// How rays leave the bricks they are in, or as many empty ones as there are, and the bricks behind.
    #[inline(always)]
    fn step_bricks(&self, bricks: [f32x16<S>; 3], beyond: f32x16<S>, t: f32x16<S>) -> Step<S> {
        let faces = self.faces(bricks, beyond);
        let leaving = self.leave(each_axis!(|axis| faces[axis] * 8.0), t);
        let position = self.at(leaving.t);
        let behind = each_axis!(|axis| {
            self.inside(&leaving, axis, position[axis] * 0.125, bricks[axis], faces[axis])
        });
        Step { t: leaving.t, behind }
    }

    /// The places behind the faces by which rays leave boxes, in units of the lattice; along other axes they stay in the box.
    #[inline(always)]
    fn inside(
        &self,
        leaving: &Leaving<S>,
        axis: usize,
        position: f32x16<S>,
        place: f32x16<S>,
        face: f32x16<S>,
    ) -> f32x16<S> {
        let last = face - self.forward[axis];
        let inside = position.trunc().max(place.min(last)).min(place.max(last));
        leaving.t_faces[axis].simd_le(leaving.t).select(last + self.sign[axis], inside)
    }

    #[inline(always)]
    fn behind(&self, leaving: &Leaving<S>, voxels: [f32x16<S>; 3]) -> [f32x16<S>; 3] {
        let position = self.at(leaving.t);
        each_axis!(|axis| self.inside(leaving, axis, position[axis], voxels[axis], leaving.faces[axis]))
    }

    /// The same where each box is one voxel.
    #[inline(always)]
    fn next(&self, leaving: &Leaving<S>, voxels: [f32x16<S>; 3]) -> [f32x16<S>; 3] {
        each_axis!(|axis| {
            let next = voxels[axis] + self.sign[axis];
            leaving.t_faces[axis].simd_le(leaving.t).select(next, voxels[axis])
        })
    }

    /// The faces towards which rays go, of the boxes of a lattice or of as many more as are `beyond` in all directions.
    #[inline(always)]
    fn faces(&self, places: [f32x16<S>; 3], beyond: f32x16<S>) -> [f32x16<S>; 3] {
        each_axis!(|axis| places[axis] + self.forward[axis] + self.sign[axis] * beyond)
    }

    /// How many bricks around are empty as well; 0 where a cell holds something.
    #[inline(always)]
    fn beyond(&self, cells: i32x16<S>) -> f32x16<S> {
        let minus_one = i32x16::splat(self.simd, -1);
        (minus_one - cells.min(minus_one)).to_float::<f32x16<S>>()
    }

    /// The eight corners of the cells that begin at voxels, in those lanes whose cell of the map has a brick: corner `i` at
    /// `dx << 2 | dy << 1 | dz`. Other lanes get zeros.
    #[inline(always)]
    fn corners<'a>(
        &self,
        field: &Field<'a>,
        blocks: &mut Blocks<'a>,
        cells: i32x16<S>,
        voxels: [i32x16<S>; 3],
    ) -> [f32x16<S>; 8] {
        let local = each_axis!(|axis| voxels[axis] & 7);
        let row = (local[0] << 3) + local[0] + local[1];
        let offsets = ((row << 3) + row + local[2]).to_array();
        let of_map = cells.to_array();
        let mut missing = 0_u32;
        let found = each_ray!(|lane| {
            match (0..SPECIAL).contains(&of_map[lane]).then(|| blocks.known(of_map[lane] as usize)) {
                Some(Some(block)) => corners_from(block, offsets[lane] as usize),
                None => &NOWHERE,
                Some(None) => {
                    missing |= 1 << lane;
                    &NOWHERE
                }
            }
        });
        // Not by a function that is called for each, which would not always be inlined.
        let found = each_lane!(|i| f32x16::simd_from(self.simd, each_ray!(|lane| found[lane][CORNERS[i]])));
        match missing {
            0 => found,
            _ => {
                let voxels = each_axis!(|axis| voxels[axis].to_array());
                let mut corners = each_lane!(|i| found[i].to_array());
                complete(field, blocks, missing, &of_map, &voxels, &mut corners);
                each_lane!(|i| f32x16::simd_from(self.simd, corners[i]))
            }
        }
    }
}

/// Where the corners of a cell stand in a block, from its first corner on.
const CORNERS: [usize; 8] = {
    let (y, x) = (blocks::SIDE, blocks::SIDE * blocks::SIDE);
    [0, 1, y, y + 1, x, x + 1, x + y, x + y + 1]
};

/// The corners of cells whose brick is met for the first time, or is part of a tile.
#[cold]
#[inline(never)]
fn complete<'a>(
    field: &Field<'a>,
    blocks: &mut Blocks<'a>,
    missing: u32,
    cells: &[i32; RAYS],
    voxels: &[[i32; RAYS]; 3],
    corners: &mut [[f32; RAYS]; 8],
) {
    each_bit(missing, |lane| {
        let voxel = IVec3::new(voxels[0][lane], voxels[1][lane], voxels[2][lane]);
        let brick = || field.brick_at(voxel.as_vec3());
        let block = match cells[lane] {
            BORDER => blocks.of_tile(brick()),
            entry => blocks.of_entry(entry as usize, brick),
        };
        for (corners, value) in corners.iter_mut().zip(corners_at(block, (voxel & 7).as_vec3())) {
            corners[lane] = value;
        }
    });
}

/// Calls with the number of each bit that is set.
#[inline(always)]
fn each_bit(mut bits: u32, mut call: impl FnMut(usize)) {
    while bits != 0 {
        call(bits.trailing_zeros() as usize);
        bits &= bits - 1;
    }
}

/// The bricks of voxels.
#[inline(always)]
fn bricks_of<S: Simd>(voxels: [f32x16<S>; 3]) -> [f32x16<S>; 3] {
    each_axis!(|axis| (voxels[axis] * 0.125).trunc())
}

#[inline(always)]
fn trunc<S: Simd>(positions: [f32x16<S>; 3]) -> [f32x16<S>; 3] {
    each_axis!(|axis| positions[axis].trunc())
}

#[inline(always)]
fn to_int<S: Simd>(positions: [f32x16<S>; 3]) -> [i32x16<S>; 3] {
    each_axis!(|axis| positions[axis].to_int())
}

/// Between the eight corners of cells, at fractions along each axis.
#[inline(always)]
fn interpolate<S: Simd>(c: &[f32x16<S>; 8], [x, y, z]: [f32x16<S>; 3]) -> f32x16<S> {
    let mix = |a: f32x16<S>, b: f32x16<S>, t: f32x16<S>| a + (b - a) * t;
    let low = mix(mix(c[0], c[1], z), mix(c[2], c[3], z), y);
    let high = mix(mix(c[4], c[5], z), mix(c[6], c[7], z), y);
    mix(low, high, x)
}

#[cfg(test)]
mod tests;
