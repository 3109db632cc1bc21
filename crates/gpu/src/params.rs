//! What crosses to the shaders, as plain bytes: twins of the structures in `shader/bindings.wgsl`, and how fields, solids
//! and lights become them.
//!
//! What does not live here: words of trees and bricks ([`crate::arrays`]), and who sends all this ([`crate::renderer`]).

use bytemuck::{Pod, Zeroable};
use glam::{DAffine3, DVec3, IVec3, Vec3, Vec4};
use nuage_render::color::Blackbody;
use nuage_render::light::Light;
use nuage_volume::channel::IndexBox;
use nuage_volume::space::LOG2_BRICK;

/// The most lights of a scene.
pub const MAX_LIGHTS: usize = 16;
/// The most volumes of a scene.
pub const MAX_MEDIA: usize = 16;

/// The temperatures of which the radiance of a black body is known.
pub(crate) const BLACKBODY_ROWS: usize = Blackbody::STEPS + 1;

/// What a medium is, as shaders know it.
pub(crate) const SHAPE_GRID: u32 = 0;
pub(crate) const SHAPE_BOX: u32 = 1;
pub(crate) const SHAPE_BALL: u32 = 2;

/// The kinds of lights, as shaders know them.
pub(crate) const LIGHT_SUN: u32 = 0;
pub(crate) const LIGHT_POINT: u32 = 1;
pub(crate) const LIGHT_SPOT: u32 = 2;
pub(crate) const LIGHT_SPHERE: u32 = 3;

/// A channel in one frame.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct Field {
    pub(crate) x_axis: [f32; 4],
    pub(crate) y_axis: [f32; 4],
    pub(crate) z_axis: [f32; 4],
    pub(crate) origin: [f32; 4],
    pub(crate) bounds_min: [f32; 4],
    pub(crate) bounds_max: [f32; 4],
    pub(crate) base_brick: [i32; 4],
    pub(crate) box_first: [i32; 4],
    pub(crate) box_last: [i32; 4],
    pub(crate) active_min: [i32; 4],
    pub(crate) active_max: [i32; 4],
    pub(crate) value: [f32; 4],
    pub(crate) index_offset: [i32; 4],
}

/// Where a channel is in one frame, and what its words mean.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Place {
    /// From the tree's own indices.
    pub(crate) world_from_index: DAffine3,
    /// In the tree's own indices.
    pub(crate) active_box: IndexBox,
    pub(crate) index_offset: IVec3,
    /// The first root cell, and how many there are.
    pub(crate) cells: [u32; 2],
    pub(crate) brick_unit: f32,
    pub(crate) bounds_unit: f32,
    pub(crate) floor: f32,
    /// Scale, bias, and the largest value.
    pub(crate) meaning: [f32; 3],
}

impl Place {
    /// The corners, in the world, of the box of all voxels other than zero.
    pub(crate) fn world_corners(&self) -> [DVec3; 8] {
        let first = self.active_box.min.as_dvec3() - 0.5;
        // In doubles: 32 bits may not hold it.
        let size = self.active_box.max.as_dvec3() - self.active_box.min.as_dvec3() + 1.0;
        std::array::from_fn(|i| {
            let corner = DVec3::new((i >> 2) as f64, (i >> 1 & 1) as f64, (i & 1) as f64);
            self.world_from_index.transform_point3(first + corner * size)
        })
    }

    /// The first and the last brick that matter.
    pub(crate) fn bricks(&self) -> [IVec3; 2] {
        // Cells reach one voxel below the active ones, and the widest filter one further to both sides.
        let first = self.active_box.min.saturating_sub(IVec3::splat(2));
        let last = self.active_box.max.saturating_add(IVec3::ONE);
        [first >> LOG2_BRICK, last >> LOG2_BRICK]
    }

    /// The brick that positions count from.
    pub(crate) fn base_brick(&self) -> IVec3 {
        self.bricks()[0] - 1
    }

    /// The field, in a world that begins at `origin`: as `nuage_render::traverse::Field` has it.
    pub(crate) fn field(&self, origin: DVec3) -> Field {
        let (min, max) = (self.active_box.min.saturating_sub(IVec3::ONE), self.active_box.max);
        let [first_brick, last_brick] = self.bricks();
        let base_brick = self.base_brick();
        let base = (base_brick << LOG2_BRICK).as_dvec3();
        let index_from_world = self.world_from_index.inverse();
        let of_origin = index_from_world.transform_point3(origin) - base;
        let axes = index_from_world.matrix3;
        let column = |axis: DVec3| axis.as_vec3().extend(0.0).to_array();
        let place = |p: DVec3, last: f32| p.as_vec3().extend(last).to_array();
        let whole = |p: IVec3, last: u32| p.extend(last as i32).to_array();
        let [scale, bias, most] = self.meaning;
        Field {
            x_axis: column(axes.x_axis),
            y_axis: column(axes.y_axis),
            z_axis: column(axes.z_axis),
            origin: place(of_origin, self.brick_unit),
            bounds_min: place(min.as_dvec3() - base, self.bounds_unit),
            bounds_max: place(max.as_dvec3() + 1.0 - base, self.floor),
            base_brick: whole(base_brick, self.cells[0]),
            box_first: whole(first_brick, self.cells[1]),
            box_last: whole(last_brick, 0),
            active_min: whole(self.active_box.min, 0),
            active_max: whole(self.active_box.max, 0),
            value: [scale, bias, most, 0.0],
            index_offset: whole(self.index_offset, 0),
        }
    }
}

/// A light.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct LightParams {
    pub(crate) place: [f32; 4],
    pub(crate) colour: [f32; 4],
    pub(crate) aim: [f32; 4],
}

impl LightParams {
    /// A light, in a world that begins at `origin`.
    pub(crate) fn of(light: &Light, origin: DVec3) -> LightParams {
        let place = |p: Vec3, kind: u32| p.extend(kind as f32).to_array();
        let colour = |colour: [f32; 3], last: f32| Vec3::from_array(colour).extend(last).to_array();
        match light {
            Light::Sun(sun) => {
                let sin = (f64::from(sun.angle_degrees).clamp(0.0, 180.0).to_radians() / 2.0).sin();
                let sin_squared = sin * sin;
                let spread = sin_squared / (1.0 + (1.0 - sin_squared).max(0.0).sqrt());
                // What an even disc sends to a surface that faces it.
                let area = (std::f64::consts::PI * sin_squared) as f32;
                let light = if area > 0.0 { sun.irradiance.map(|c| c / area) } else { sun.irradiance };
                LightParams {
                    place: place(sun.direction_to, LIGHT_SUN),
                    colour: colour(light, spread as f32),
                    ..LightParams::default()
                }
            }
            Light::Point { position, intensity } => LightParams {
                place: place((*position - origin).as_vec3(), LIGHT_POINT),
                colour: colour(*intensity, 0.0),
                ..LightParams::default()
            },
            Light::Spot(spot) => LightParams {
                place: place((spot.position - origin).as_vec3(), LIGHT_SPOT),
                colour: colour(spot.intensity, spot.inner_degrees.to_radians().cos()),
                aim: spot.direction.extend(spot.outer_degrees.to_radians().cos()).to_array(),
            },
            Light::Sphere { centre, radius, radiance } => LightParams {
                place: place((*centre - origin).as_vec3(), LIGHT_SPHERE),
                colour: colour(*radiance, *radius as f32),
                ..LightParams::default()
            },
        }
    }
}

/// A medium: what it is made of, and where it is.
#[repr(C)]
#[derive(Debug, Clone, Copy, Default, PartialEq, Pod, Zeroable)]
pub(crate) struct MediumParams {
    pub(crate) extinction: [f32; 4],
    pub(crate) albedo: [f32; 4],
    pub(crate) phase: [f32; 4],
    pub(crate) emission: [f32; 4],
    pub(crate) kind: [u32; 4],
    pub(crate) unit_x: [f32; 4],
    pub(crate) unit_y: [f32; 4],
    pub(crate) unit_z: [f32; 4],
}

impl MediumParams {
    /// Puts a solid where it is, in a world that begins at `origin`; nowhere if it has no volume.
    pub(crate) fn place_solid(&mut self, world_from_unit: DAffine3, origin: DVec3) {
        let unit_from_world = world_from_unit.inverse() * DAffine3::from_translation(origin);
        if !world_from_unit.is_finite() || !unit_from_world.is_finite() {
            // Far beside the unit cube and ball, wherever a ray goes.
            (self.unit_x, self.unit_y, self.unit_z) = ([0.0, 0.0, 0.0, 8.0], [0.0; 4], [0.0; 4]);
            return;
        }
        let axes = unit_from_world.matrix3.transpose();
        let row = |axis: DVec3, last: f64| Vec4::from((axis.as_vec3(), last as f32)).to_array();
        let last = unit_from_world.translation;
        self.unit_x = row(axes.x_axis, last.x);
        self.unit_y = row(axes.y_axis, last.y);
        self.unit_z = row(axes.z_axis, last.z);
    }
}

/// What a pass is told.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct Params {
    pub(crate) camera: [f32; 4],
    pub(crate) forward: [f32; 4],
    pub(crate) right: [f32; 4],
    pub(crate) up: [f32; 4],
    pub(crate) size: [u32; 4],
    pub(crate) counts: [u32; 4],
    pub(crate) sky_up: [f32; 4],
    pub(crate) sky_zenith: [f32; 4],
    pub(crate) sky_horizon: [f32; 4],
    pub(crate) sky_ground: [f32; 4],
    pub(crate) march: [f32; 4],
    pub(crate) march_rays: [f32; 4],
    pub(crate) sun_direction: [f32; 4],
    pub(crate) sun_irradiance: [f32; 4],
    pub(crate) view: [f32; 4],
    pub(crate) tone: [f32; 4],
    pub(crate) clip_x: [f32; 4],
    pub(crate) clip_y: [f32; 4],
    pub(crate) clip_z: [f32; 4],
    pub(crate) clip_w: [f32; 4],
    pub(crate) marched: [u32; 4],
    pub(crate) light_first: [f32; 4],
    pub(crate) light_x: [f32; 4],
    pub(crate) light_y: [f32; 4],
    pub(crate) light_z: [f32; 4],
    pub(crate) light_u: [f32; 4],
    pub(crate) light_v: [f32; 4],
    pub(crate) light_w: [f32; 4],
    pub(crate) before_camera: [f32; 4],
    pub(crate) before_forward: [f32; 4],
    pub(crate) before_right: [f32; 4],
    pub(crate) before_up: [f32; 4],
    pub(crate) history: [f32; 4],
    pub(crate) map_x: [f32; 4],
    pub(crate) map_y: [f32; 4],
    pub(crate) map_z: [f32; 4],
    pub(crate) map_size: [u32; 4],
    pub(crate) rounds: [u32; 4],
    pub(crate) media: [MediumParams; MAX_MEDIA],
    pub(crate) lights: [LightParams; MAX_LIGHTS],
    pub(crate) blackbody: [[f32; 4]; BLACKBODY_ROWS],
}

impl Default for Params {
    fn default() -> Params {
        Params::zeroed()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shader::{Features, Source};
    use std::mem::offset_of;

    /// The offset of each member of a structure, as naga lays it out.
    fn members(name: &str) -> (Vec<(String, u32)>, u32) {
        let text = Source::Views.text(&Features::ALL);
        let module = naga::front::wgsl::parse_str(&text).expect("a valid shader");
        let found = module.types.iter().find(|(_, kind)| kind.name.as_deref() == Some(name));
        let Some((_, naga::Type { inner: naga::TypeInner::Struct { members, span }, .. })) = found else {
            panic!("no structure {name}")
        };
        let named = members.iter().map(|member| (member.name.clone().unwrap_or_default(), member.offset));
        (named.collect(), *span)
    }

    macro_rules! assert_layout {
        ($rust:ty, $wgsl:literal, $($member:ident)*) => {
            let ours = vec![$((stringify!($member).to_owned(), offset_of!($rust, $member) as u32)),*];
            assert_eq!(members($wgsl), (ours, size_of::<$rust>() as u32));
        };
    }

    #[test]
    fn shaders_lay_structures_out_as_we_do() {
        assert_layout!(
            Field, "Field", x_axis y_axis z_axis origin bounds_min bounds_max base_brick box_first box_last
            active_min active_max value index_offset
        );
        assert_layout!(LightParams, "Light", place colour aim);
        assert_layout!(
            MediumParams, "Medium", extinction albedo phase emission kind unit_x unit_y unit_z
        );
        assert_layout!(
            Params, "Params", camera forward right up size counts sky_up sky_zenith sky_horizon sky_ground march
            march_rays sun_direction sun_irradiance view tone clip_x clip_y clip_z clip_w marched light_first light_x
            light_y light_z light_u light_v light_w before_camera before_forward before_right before_up history map_x
            map_y map_z map_size rounds media lights blackbody
        );
    }
}
