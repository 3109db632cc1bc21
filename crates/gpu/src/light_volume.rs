//! Where the light volume lies: a lattice of nodes around a field, with an axis along the sun's rays, so that one walk lights
//! a column of them.
//!
//! What does not live here: what it holds (`shader/light_volume.wgsl`), and when it is filled ([`crate::real_time`]).

use glam::{DAffine3, DMat3, DVec3, Vec3};
use nuage_render::phase::tangent_frame;
use nuage_volume::space::LOG2_BRICK;

use crate::params::{Params, Place};

/// Nodes along each side: seven megabytes in all.
pub(crate) const NODES: u32 = 96;

/// The step of the walks that fill it, in voxels, where shadow rays take steps, or none at all.
pub(crate) fn step_voxels(shadow_step_voxels: f32) -> f32 {
    if shadow_step_voxels > 0.0 { shadow_step_voxels } else { 1.0 }
}

/// Lays the lattice around a field. `None` if numbers cannot hold it.
pub(crate) fn lay(params: &mut Params, place: &Place) -> Option<()> {
    let [x, y, z, _] = params.sun_direction;
    let along = Vec3::new(x, y, z).as_dvec3().try_normalize()?;
    let (tangent, bitangent) = tangent_frame(along.as_vec3());
    // Not quite at right angles, as single precision has it: nothing here needs that.
    let world_from_sun = DMat3::from_cols(tangent.as_dvec3(), bitangent.as_dvec3(), along);
    let sun_from_world = world_from_sun.inverse();
    let corners = place.world_corners().map(|corner| sun_from_world * corner);
    let low = corners.into_iter().fold(DVec3::INFINITY, DVec3::min);
    let high = corners.into_iter().fold(DVec3::NEG_INFINITY, DVec3::max);
    // A cell on each side holds what fades out beyond the voxels' own boxes.
    let cell = (high - low) / f64::from(NODES - 3);
    let (low, high) = (low - cell, high + cell);
    let to_next = world_from_sun * DMat3::from_diagonal(DVec3::new(cell.x, cell.y, -cell.z));
    let world_from_node = DAffine3::from_mat3_translation(to_next, world_from_sun * low.with_z(high.z));

    let base = place.base_brick() << LOG2_BRICK;
    let position_from_world = DAffine3::from_translation(-base.as_dvec3()) * place.world_from_index.inverse();
    let position_from_node = position_from_world * world_from_node;
    let node_from_position = position_from_node.inverse();
    let half = DVec3::splat(0.5);
    let rows = (node_from_position.matrix3 * (1.0 / f64::from(NODES))).transpose();
    let last = (node_from_position.translation + half) / f64::from(NODES);
    let axes = position_from_node.matrix3;
    let wide = |v: DVec3, last: f64| v.as_vec3().extend(last as f32).to_array();
    params.light_first = wide(position_from_node.translation, 0.0);
    params.light_x = wide(axes.x_axis, 0.0);
    params.light_y = wide(axes.y_axis, 0.0);
    params.light_z = wide(axes.z_axis, cell.z);
    params.light_u = wide(rows.x_axis, last.x);
    params.light_v = wide(rows.y_axis, last.y);
    params.light_w = wide(rows.z_axis, last.z);
    let numbers = [params.light_first, params.light_u, params.light_v, params.light_w];
    let is_finite = numbers.into_iter().flatten().all(f32::is_finite);
    (is_finite && cell.min_element() > 0.0).then_some(())
}
