//! Views and densities for volumes that nobody described: where to put the camera so that everything is seen,
//! and how dense to make the medium so that it shows.

use glam::{DVec2, DVec3, Vec3};
use nuage_volume::channel::{Channel, IndexBox};

use crate::camera::{Camera, Ray};
use crate::color::luminance;
use crate::march::{Marcher, Quality, Worker};
use crate::scene::{Emission, Scene, Shape, Volume};

/// The optical depth that the denser rays through a volume shall have.
const TARGET_DEPTH: f32 = 8.0;
/// The luminance that the brighter rays through something that glows shall have: white in a picture.
const TARGET_LUMINANCE: f32 = 1.0;
/// Rays per side of the grid that probes the volume.
const PROBES: u32 = 32;
/// Room around the volume in the picture.
const MARGIN: f64 = 1.04;

/// A box in world space.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct WorldBox {
    /// The smallest coordinates.
    pub min: DVec3,
    /// The largest coordinates.
    pub max: DVec3,
}

impl WorldBox {
    /// The box around the corners of an index box, taken to the world.
    pub fn of_index_box(world_from_index: &glam::DAffine3, index: IndexBox) -> Self {
        let (min, max) = (index.min.as_dvec3() - 0.5, index.max.as_dvec3() + 0.5);
        let corners = corners(min, max).map(|corner| world_from_index.transform_point3(corner));
        WorldBox {
            min: corners.into_iter().reduce(DVec3::min).expect("eight corners"),
            max: corners.into_iter().reduce(DVec3::max).expect("eight corners"),
        }
    }

    /// The box of a channel's active voxels.
    pub fn of(channel: &Channel) -> Option<Self> {
        channel.active_box.map(|index| Self::of_index_box(&channel.world_from_index, index))
    }

    /// The box around both.
    #[must_use]
    pub fn union(self, other: Self) -> Self {
        WorldBox { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    /// The middle.
    pub fn centre(self) -> DVec3 {
        0.5 * (self.min + self.max)
    }
}

fn corners(min: DVec3, max: DVec3) -> [DVec3; 8] {
    std::array::from_fn(|i| {
        DVec3::new(
            if i & 4 == 0 { min.x } else { max.x },
            if i & 2 == 0 { min.y } else { max.y },
            if i & 1 == 0 { min.z } else { max.z },
        )
    })
}

/// The nearest camera that sees all of a box from a direction. `towards_camera` points from the box to the
/// camera; `aspect` is width over height. `None` if the numbers make no view.
pub fn fit_camera(
    world_box: WorldBox,
    towards_camera: DVec3,
    up: DVec3,
    fov_degrees: f64,
    aspect: f64,
) -> Option<Camera> {
    let centre = world_box.centre();
    let back = towards_camera.try_normalize()?;
    let view = Camera::look_at(centre + back, centre, up, fov_degrees)?;
    let horizontal = view.half_width_tangent;
    let vertical = horizontal / aspect;
    let distance = corners(world_box.min, world_box.max)
        .into_iter()
        .map(|corner| {
            let corner = (corner - centre) * MARGIN;
            let (x, y) = (corner.dot(view.right).abs(), corner.dot(view.up).abs());
            (x / horizontal).max(y / vertical) - corner.dot(view.forward)
        })
        .fold(0.0, f64::max);
    Camera::look_at(centre + back * distance, centre, up, fov_degrees)
}

/// A density scale that shows the volume: one at which the denser rays of a view have an optical depth
/// around eight. `None` if no ray meets anything.
pub fn fit_density_scale(density: &Channel, camera: &Camera, aspect: f64) -> Option<f32> {
    let volume = Volume::absorbing(Shape::Grid(density), 1.0);
    let depth =
        dense_value(volume, camera, aspect, |marcher, worker, ray| marcher.depth_per_scale(worker, ray));
    valid_scale(TARGET_DEPTH / depth?)
}

/// How many times brighter an emission has to be so that the brighter rays of a view have a luminance around one,
/// white in a picture. `None` if no ray meets anything that glows, or if it has
/// no channel of its own.
pub fn fit_emission_scale(emission: &Emission<'_>, camera: &Camera, aspect: f64) -> Option<f32> {
    // The glowing channel stands in for the density, of which nothing is seen.
    let density = Shape::Grid(emission.channel?);
    let volume = Volume { emission: Some(emission.clone()), ..Volume::absorbing(density, 0.0) };
    let luminance = dense_value(volume, camera, aspect, |marcher, worker, ray| {
        luminance(marcher.radiance(worker, ray, 0).scattered.to_array())
    });
    valid_scale(TARGET_LUMINANCE / luminance?)
}

/// The value that nine of ten rays of a view that see anything stay below.
fn dense_value(
    volume: Volume<'_>,
    camera: &Camera,
    aspect: f64,
    value: impl for<'m> Fn(&Marcher<'m>, &mut Worker<'m>, &Ray) -> f32,
) -> Option<f32> {
    let scene = Scene::of_one(*camera, volume, None, [0.0; 3]);
    let quality = Quality { step_voxels: 1.0, ..Quality::default() };
    let marcher = Marcher::new(&scene, quality);
    let mut worker = marcher.worker();
    let height = ((f64::from(PROBES) / aspect).round() as u32).clamp(1, 64 * PROBES);
    let mut values: Vec<f32> = (0..PROBES * height)
        .map(|i| {
            let pixel = DVec2::new(f64::from(i % PROBES) + 0.5, f64::from(i / PROBES) + 0.5);
            value(&marcher, &mut worker, &camera.ray(pixel, PROBES, height))
        })
        .filter(|value| *value > 0.0)
        .collect();
    values.sort_by(f32::total_cmp);
    values.get(values.len() * 9 / 10).copied()
}

fn valid_scale(scale: f32) -> Option<f32> {
    (scale.is_finite() && scale > 0.0).then_some(scale)
}

/// The direction with an azimuth and an elevation in degrees, around an up axis: azimuth 0 is +z with y up and
/// −y with z up (towards the viewer of Blender's front view), and turns towards +x.
pub fn direction(azimuth_degrees: f64, elevation_degrees: f64, z_up: bool) -> Vec3 {
    let (sin_a, cos_a) = azimuth_degrees.to_radians().sin_cos();
    let (sin_e, cos_e) = elevation_degrees.to_radians().sin_cos();
    let (x, forward) = (sin_a * cos_e, cos_a * cos_e);
    let direction = if z_up { DVec3::new(x, -forward, sin_e) } else { DVec3::new(x, sin_e, forward) };
    direction.as_vec3()
}
