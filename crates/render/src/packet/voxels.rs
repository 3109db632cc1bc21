//! The first voxels of a kind on the rays of a packet: what [`first_voxel`](surface::first_voxel) gives for each of them.

use fearless_simd::{Level, Simd, dispatch, prelude::*};
use glam::Vec3;
use nuage_volume::brick::Bricks;

use super::lines::values_of;
use super::{Lanes, Packet, RAYS, each_ray, to_int};
use crate::camera::Ray;
use crate::depth::{NEAREST_SHIFT, Stored};
use crate::simd::level;
use crate::surface::{self, VoxelHit};
use crate::traverse::{Field, Reader};
use crate::walk::Sight;

/// The first voxel on each ray of a value above `above`, which is not negative; voxels are boxes around their places.
pub fn first_voxels<'a>(
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    rays: &[Ray; RAYS],
    above: f32,
) -> [Option<VoxelHit>; RAYS] {
    first_voxels_at(level(), field, reader, rays, above)
}

pub(super) fn first_voxels_at<'a>(
    level: Level,
    field: &Field<'a>,
    reader: &mut Reader<'a>,
    rays: &[Ray; RAYS],
    above: f32,
) -> [Option<VoxelHit>; RAYS] {
    let Some(map) = field.map(Sight::Voxels) else {
        return each_ray!(|lane| surface::first_voxel(field, reader, &rays[lane], above));
    };
    let met = dispatch!(level, simd => simd.vectorize(
        #[inline(always)]
        || {
            let packet = Packet::enter(field, rays, NEAREST_SHIFT, None)?;
            let lanes = Lanes::new(simd, map, &packet);
            let met = match &field.tree().bricks {
                Bricks::F32(values) => meet(&lanes, values, above),
                Bricks::F16(values) => meet(&lanes, values, above),
            };
            Some((packet.starts, met))
        }
    ));
    let Some((starts, met)) = met else { return [None; RAYS] };
    each_ray!(|lane| (met.rays >> lane & 1 == 1).then(|| {
        let place = Vec3::new(met.places[0][lane], met.places[1][lane], met.places[2][lane]);
        VoxelHit {
            distance: starts[lane] + f64::from(met.t[lane]),
            voxel: field.voxel_at(place),
            value: met.values[lane],
        }
    }))
}

/// The voxels that rays have met.
struct Met {
    /// Which rays have met one, a bit each.
    rays: u32,
    t: [f32; RAYS],
    /// Positions of the walk, by axis.
    places: [[f32; RAYS]; 3],
    values: [f32; RAYS],
}

#[inline(always)]
fn meet<S: Simd, V: Stored>(lanes: &Lanes<'_, S>, values: &[V], above: f32) -> Met {
    let zero = lanes.splat(0.0);
    let (mut rays, mut met_t, mut met_value, mut places) = (0, zero, zero, [zero; 3]);
    lanes.each_stretch(
        #[inline(always)]
        |stretch| {
            let mut met = stretch.is_filled();
            if met.any_true() {
                let value = values_of(lanes, values, stretch.cells, to_int(stretch.voxels));
                met &= value.simd_gt(above);
                if met.any_true() {
                    rays |= met.to_bitmask() as u32;
                    (met_t, met_value) = (met.select(stretch.t, met_t), met.select(value, met_value));
                    for (place, voxel) in places.iter_mut().zip(stretch.voxels) {
                        *place = met.select(voxel, *place);
                    }
                }
            }
            met
        },
    );
    let places = [places[0].to_array(), places[1].to_array(), places[2].to_array()];
    Met { rays, t: met_t.to_array(), places, values: met_value.to_array() }
}
