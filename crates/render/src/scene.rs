//! What is rendered: a medium, its lights and a camera. Plain data, shared by all renderers.
//!
//! Light is scene-linear Rec.709. Extinction σt = density × `density_scale`, in 1/world length; scattering
//! σs = albedo × σt.

use glam::Vec3;
use nuage_volume::channel::Channel;

use crate::camera::Camera;
use crate::color::Blackbody;

/// A participating medium.
#[derive(Debug, Clone)]
pub struct Medium<'a> {
    /// The density. Values are finite and not negative, and zero outside the active box.
    pub density: &'a Channel,
    /// Extinction per density and world length.
    pub density_scale: f32,
    /// The share of extinction that is scattering, per colour, 0 to 1.
    pub albedo: [f32; 3],
    /// The mean cosine g of the Henyey–Greenstein phase function; positive is forward.
    pub phase_g: f32,
    /// Light that the medium gives off.
    pub emission: Option<Emission<'a>>,
}

/// Light that a medium gives off, independent of its density.
#[derive(Debug, Clone)]
pub struct Emission<'a> {
    /// What glows: a temperature or a flame. May have a transform of its own.
    pub channel: &'a Channel,
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

/// A light infinitely far away. Not visible itself.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sun {
    /// The direction towards the sun, of length 1.
    pub direction_to: Vec3,
    /// Irradiance on a surface that faces the sun.
    pub irradiance: [f32; 3],
}

/// Everything a picture depends on, but for how finely it is computed.
#[derive(Debug, Clone)]
pub struct Scene<'a> {
    /// The view.
    pub camera: Camera,
    /// What is seen.
    pub medium: Medium<'a>,
    /// The sun, if it shines.
    pub sun: Option<Sun>,
    /// The radiance of the sky, the same from all directions. It lights the medium; what stands behind the
    /// medium in the picture is the caller's business.
    pub sky: [f32; 3],
}
