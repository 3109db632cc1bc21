//! What is rendered: volumes, lights, a sky and a camera. Plain data, shared by all renderers.
//!
//! Light is scene-linear Rec.709. Extinction σt = density × `extinction`, in 1/world length; scattering
//! σs = albedo × σt. Where volumes overlap, their extinctions add up, and each scatters its share in its own way.
//!
//! What does not live here: lights ([`crate::light`]), and how any of this is followed ([`crate::march`], [`crate::path`]).

use glam::{DAffine3, Vec3};
use nuage_volume::channel::Channel;

use crate::camera::Camera;
use crate::color::Blackbody;
use crate::light::{Light, Sky, Sun};
pub use crate::phase::Phase;

/// A participating medium and where it is.
#[derive(Debug, Clone)]
pub struct Volume<'a> {
    /// Where the medium is, and its density there.
    pub shape: Shape<'a>,
    /// A coarser level of the densities ([`lod`](crate::lod)), which shadow rays and rays of scattered light read in place of
    /// those of the shape. It makes them faster and the picture a little wrong; without one the path tracer has no bias.
    pub coarse: Option<&'a Channel>,
    /// Extinction per density and world length, per colour.
    pub extinction: [f32; 3],
    /// The share of extinction that is scattering, per colour, 0 to 1.
    pub albedo: [f32; 3],
    /// Where light goes that is scattered.
    pub phase: Phase,
    /// Light that the medium gives off.
    pub emission: Option<Emission<'a>>,
}

impl<'a> Volume<'a> {
    /// A medium of grey extinction that only absorbs.
    pub fn absorbing(shape: Shape<'a>, extinction: f32) -> Self {
        let phase = Phase::HenyeyGreenstein { g: 0.0 };
        Volume { shape, coarse: None, extinction: [extinction; 3], albedo: [0.0; 3], phase, emission: None }
    }
}

/// Where a medium is, and its density there.
#[derive(Debug, Clone, Copy)]
pub enum Shape<'a> {
    /// The densities of a channel. They are finite and not negative, and zero outside the active box.
    Grid(&'a Channel),
    /// A density of 1 in what an invertible transform makes of the cube from 0 to 1.
    Box {
        /// World from cube.
        world_from_unit: DAffine3,
    },
    /// A density of 1 in what an invertible transform makes of the ball of radius 1 around the origin.
    Ball {
        /// World from ball.
        world_from_unit: DAffine3,
    },
}

impl<'a> Shape<'a> {
    /// The channel that holds the densities, if one does.
    pub fn channel(self) -> Option<&'a Channel> {
        match self {
            Shape::Grid(channel) => Some(channel),
            Shape::Box { .. } | Shape::Ball { .. } => None,
        }
    }
}

/// Light that a medium gives off, independent of its density.
#[derive(Debug, Clone)]
pub struct Emission<'a> {
    /// What glows: a temperature or a flame. May have a transform of its own. If `None`, it is the density of the volume,
    /// which is 1 in a box and in a ball.
    pub channel: Option<&'a Channel>,
    /// How values become light.
    pub spectrum: Spectrum,
}

/// How a value of an emission channel becomes radiance per world length.
#[derive(Debug, Clone)]
pub enum Spectrum {
    /// `rgb` × value.
    Linear {
        /// Radiance per value and world length.
        rgb: [f32; 3],
    },
    /// A black body at `kelvin_per_unit` × value.
    Blackbody {
        /// Kelvin per unit of the channel.
        kelvin_per_unit: f32,
        /// Radiance per world length at the table's reference temperature, as luminance.
        scale: f32,
        /// Relative radiance by temperature.
        table: Box<Blackbody>,
    },
}

impl Spectrum {
    /// The same light, `factor` times as bright.
    #[must_use]
    pub fn brighter(self, factor: f32) -> Self {
        match self {
            Spectrum::Linear { rgb } => Spectrum::Linear { rgb: rgb.map(|c| c * factor) },
            Spectrum::Blackbody { kelvin_per_unit, scale, table } => {
                Spectrum::Blackbody { kelvin_per_unit, scale: scale * factor, table }
            }
        }
    }

    /// Radiance per world length.
    #[inline]
    pub fn radiance(&self, value: f32) -> Vec3 {
        match self {
            Spectrum::Linear { rgb } => Vec3::from_array(*rgb) * value,
            Spectrum::Blackbody { kelvin_per_unit, scale, table } => {
                Vec3::from_array(table.radiance(value * kelvin_per_unit)) * *scale
            }
        }
    }
}

/// Everything a picture depends on, but for how finely it is computed.
#[derive(Debug, Clone)]
pub struct Scene<'a> {
    /// The view.
    pub camera: Camera,
    /// What is seen. Volumes may overlap.
    pub volumes: Vec<Volume<'a>>,
    /// Lights with a place or a direction. They light the volumes and are not visible themselves.
    pub lights: Vec<Light>,
    /// The light from everywhere. What stands behind the volumes in the picture is the caller's business.
    pub sky: Sky,
}

impl<'a> Scene<'a> {
    /// A scene of one volume, lit by a sun, if there is one, and by a sky that is the same from everywhere.
    pub fn of_one(camera: Camera, volume: Volume<'a>, sun: Option<Sun>, sky: [f32; 3]) -> Self {
        let lights = sun.map(Light::Sun).into_iter().collect();
        Scene { camera, volumes: vec![volume], lights, sky: Sky::Constant(sky) }
    }
}
