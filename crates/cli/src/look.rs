//! The options of `nuage render` that say how a volume looks: view, light, medium and quality.

use glam::DVec3;
use nuage_render::filter::Lookup;

use crate::values::{
    Auto, Background, Size, SunPosition, albedo, field_of_view, finite, of_length_1, phase, positive, rgb,
    sun_angle, vec3,
};

/// How light is followed through the medium.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Integrator {
    /// Steps along rays, light scattered once.
    #[default]
    March,
    /// Paths, light scattered any number of times.
    Path,
}

/// How values between voxels are found.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum Filter {
    /// That of the nearest voxel.
    Nearest,
    /// Linear between eight voxels.
    #[default]
    Trilinear,
    /// The cubic B-spline of 64 voxels: smooth, and softer than the voxels.
    Tricubic,
    /// One of the eight voxels at random, with the chance of its weight.
    StochasticTrilinear,
    /// One of the 64 voxels at random, with the chance of its weight.
    StochasticTricubic,
}

impl Filter {
    pub(crate) fn lookup(self) -> Lookup {
        match self {
            Filter::Nearest => Lookup::Nearest,
            Filter::Trilinear => Lookup::Trilinear,
            Filter::Tricubic => Lookup::Tricubic,
            Filter::StochasticTrilinear => Lookup::StochasticTrilinear,
            Filter::StochasticTricubic => Lookup::StochasticTricubic,
        }
    }
}

/// What a picture shows in place of light.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum)]
pub(crate) enum View {
    /// Opacity by the density along the ray, exact.
    Density,
    /// The distance of the first voxel above 0: white is near, black is far.
    Depth,
    /// The place of that voxel in the box of voxels, as a hue.
    Index,
    /// The density of that voxel, as a hue from red at 0 to magenta at the largest.
    FirstDensity,
    /// A level set's surface, bright where it faces the camera.
    Surface,
}

/// View, light, medium and quality.
#[derive(Debug, clap::Args, Clone)]
pub(crate) struct Look {
    /// Size of the picture in pixels, WIDTHxHEIGHT
    #[arg(long, default_value = "1024x1024", value_name = "WxH", help_heading = "View")]
    pub(crate) size: Size,

    /// Position of the camera in world units, x,y,z [default: where all of the volume is seen]
    #[arg(long, value_parser = vec3, allow_hyphen_values = true, value_name = "X,Y,Z", help_heading = "View")]
    pub(crate) camera: Option<DVec3>,

    /// World position in the middle of the picture, x,y,z [default: the middle of the volume]
    #[arg(long, value_parser = vec3, allow_hyphen_values = true, value_name = "X,Y,Z", help_heading = "View")]
    pub(crate) look_at: Option<DVec3>,

    /// Which way is up: y (Houdini, Maya), z (Blender), or a direction x,y,z
    #[arg(long, default_value = "y", value_parser = up, allow_hyphen_values = true, value_name = "AXIS", help_heading = "View")]
    pub(crate) up: DVec3,

    /// Horizontal field of view in degrees
    #[arg(long, default_value = "35", value_parser = field_of_view, value_name = "DEGREES", help_heading = "View")]
    pub(crate) fov: f64,

    /// Where the sun stands: azimuth,elevation in degrees, or the direction TO the sun as x,y,z, or none
    ///
    /// Azimuth 0 is +z with y up and -y with z up (both towards the viewer of the default view) and turns
    /// towards +x; elevation is positive above the horizon.
    #[arg(
        long,
        default_value = "-60,40",
        allow_hyphen_values = true,
        value_name = "AZ,EL|X,Y,Z|none",
        help_heading = "Light"
    )]
    pub(crate) sun: SunPosition,

    /// Irradiance of the sun on a surface that faces it, one number or r,g,b (linear Rec.709)
    #[arg(long, default_value = "12,11.2,10", value_parser = rgb, value_name = "E|R,G,B", help_heading = "Light")]
    pub(crate) sun_irradiance: [f32; 3],

    /// Angular diameter of the sun in degrees: 0 is a point, the sun of the earth has 0.53 (with --integrator path)
    #[arg(long, default_value = "0", value_parser = sun_angle, value_name = "DEGREES", help_heading = "Light")]
    pub(crate) sun_angle: f32,

    /// Radiance of the sky, the same from everywhere, one number or r,g,b (linear Rec.709)
    #[arg(long, default_value = "0.22,0.32,0.5", value_parser = rgb, value_name = "L|R,G,B", help_heading = "Light")]
    pub(crate) sky: [f32; 3],

    /// What stands behind the volume: sky, a radiance (one number or r,g,b), or none to keep the alpha channel
    #[arg(long, default_value = "sky", value_name = "sky|R,G,B|none", help_heading = "Light")]
    pub(crate) background: Background,

    /// Exposure in stops: every stop doubles all light in the picture
    #[arg(long, default_value = "0", value_parser = finite, allow_hyphen_values = true, value_name = "STOPS", help_heading = "Light")]
    pub(crate) exposure: f32,

    /// Extinction per density and world unit of length; auto gives the denser rays an optical depth of 8
    #[arg(long, default_value = "auto", value_name = "SCALE|auto", help_heading = "Medium")]
    pub(crate) density: Auto,

    /// Share of extinction that is scattering, 0 to 1, one number or r,g,b
    #[arg(long, default_value = "0.95", value_parser = albedo, value_name = "A|R,G,B", help_heading = "Medium")]
    pub(crate) albedo: [f32; 3],

    /// Mean cosine g of the Henyey-Greenstein phase function, -1 to 1; positive scatters forward
    #[arg(long, default_value = "0.2", value_parser = phase, allow_hyphen_values = true, value_name = "G", help_heading = "Medium")]
    pub(crate) phase: f32,

    /// Grid of temperatures that glows as a black body (see --kelvin)
    #[arg(long, value_name = "GRID", conflicts_with = "flame", help_heading = "Emission")]
    pub(crate) temperature: Option<String>,

    /// Kelvin per unit of the temperature grid; Blender writes 0 to 3, for which 800 is a start
    #[arg(long, default_value = "800", value_parser = positive, value_name = "K", help_heading = "Emission")]
    pub(crate) kelvin: f32,

    /// Grid whose value times --flame-color is radiance
    #[arg(long, value_name = "GRID", help_heading = "Emission")]
    pub(crate) flame: Option<String>,

    /// Colour of the flame, one number or r,g,b (linear Rec.709)
    #[arg(long, default_value = "1,0.32,0.06", value_parser = rgb, value_name = "R,G,B", help_heading = "Emission")]
    pub(crate) flame_color: [f32; 3],

    /// Radiance per world unit of length: of a black body at 1500 K, or of a flame of value 1; auto makes the
    /// brighter rays white
    #[arg(long, default_value = "auto", value_name = "SCALE|auto", help_heading = "Emission")]
    pub(crate) emission: Auto,

    /// Length of a step of a camera ray in voxels; halving it quarters the error
    #[arg(long, default_value = "0.5", value_parser = positive, value_name = "VOXELS", help_heading = "Quality")]
    pub(crate) step: f32,

    /// Length of the first step of a shadow ray in voxels: longer ones make shadows lighter, by 1 to 2 % as it stands; 0 takes
    /// no steps but integrates exactly, which takes longer
    #[arg(long, default_value = "2", value_parser = not_negative, value_name = "VOXELS", help_heading = "Quality")]
    pub(crate) shadow_step: f32,

    /// Each step of a shadow ray is longer than the one before by this part of the first; 0 keeps them equal
    #[arg(long, default_value = "0.05", value_parser = not_negative, value_name = "PART", help_heading = "Quality")]
    pub(crate) shadow_growth: f32,

    /// How light is followed: march (scattered once, smooth, with steps) or path (any number of times, unbiased, with
    /// noise)
    #[arg(long, value_enum, default_value_t, value_name = "NAME", help_heading = "Quality")]
    pub(crate) integrator: Integrator,

    /// Show the volume itself in place of light, along the ray through the middle of each pixel
    #[arg(long, value_enum, value_name = "NAME", help_heading = "Quality")]
    pub(crate) view: Option<View>,

    /// How values between voxels are found
    #[arg(long, value_enum, default_value_t, value_name = "NAME", help_heading = "Quality")]
    pub(crate) filter: Filter,

    /// Shadow rays and rays of scattered light read the level that has 1/2^N of the voxels per axis: faster, and a little wrong;
    /// 0 is the volume itself
    #[arg(long, default_value = "0", value_parser = clap::value_parser!(u32).range(0..=MOST_LEVELS), value_name = "N", help_heading = "Quality")]
    pub(crate) lod: u32,

    /// The most that light scatters with --integrator path [default: as often as it does]
    #[arg(long, value_parser = clap::value_parser!(u32).range(0..=1_000_000), value_name = "N", help_heading = "Quality")]
    pub(crate) scatterings: Option<u32>,

    /// Camera rays per pixel; with --integrator path, as many paths at most [default: 1; of paths 64, or with --noise or
    /// --time as many as it takes]
    #[arg(long, visible_alias = "spp", value_parser = clap::value_parser!(u32).range(1..=MOST_SAMPLES), value_name = "N", help_heading = "Quality")]
    pub(crate) samples: Option<u32>,

    /// With --integrator path, stop when the noise of the picture is no more than this: the root mean square over lit
    /// pixels of the standard error of luminance over luminance, that of dark pixels plus a tenth of the mean
    #[arg(long, value_parser = positive, value_name = "PART", help_heading = "Quality")]
    pub(crate) noise: Option<f32>,

    /// With --integrator path, stop after so many seconds of tracing, but not before each pixel has a path
    #[arg(long, value_parser = seconds, value_name = "SECONDS", help_heading = "Quality")]
    pub(crate) time: Option<f32>,

    /// A ray ends where less than this share of the light passes
    #[arg(long, default_value = "0.0003", value_parser = share, value_name = "T", help_heading = "Quality")]
    pub(crate) cutoff: f32,

    /// Shadow rays towards the sun per camera ray that is scattered whole; a large number means one per step
    #[arg(long, default_value = "16", value_parser = clap::value_parser!(u32).range(1..=1_000_000), value_name = "N", help_heading = "Quality")]
    pub(crate) sun_rays: u32,

    /// Shadow rays towards the sky per camera ray that is scattered whole
    #[arg(long, default_value = "8", value_parser = clap::value_parser!(u32).range(1..=65536), value_name = "N", help_heading = "Quality")]
    pub(crate) sky_rays: u32,

    /// Which random numbers --integrator path takes: pictures of different numbers are independent
    #[arg(long, default_value = "0", value_name = "N", help_heading = "Quality")]
    pub(crate) seed: u32,

    /// With --integrator path, see a sky that is a picture only by paths that leave the volumes, not by rays of its own
    #[arg(long, help_heading = "Quality")]
    pub(crate) no_sky_rays: bool,
}

/// The coarsest level that can be asked for.
pub(crate) const MOST_LEVELS: i64 = 12;

/// The most paths of a pixel that can be asked for.
pub(crate) const MOST_SAMPLES: i64 = 1 << 24;

/// The paths of a pixel if nothing is asked for.
const DEFAULT_PATHS: u32 = 64;

impl Look {
    /// The most paths of a pixel.
    pub(crate) fn paths(&self) -> u32 {
        let has_end = self.noise.is_some() || self.time.is_some();
        self.samples.unwrap_or(if has_end { u32::MAX } else { DEFAULT_PATHS })
    }
}

/// Seconds, at most a month.
pub(crate) fn seconds(text: &str) -> Result<f32, String> {
    match positive(text)? {
        seconds if seconds <= 2_678_400.0 => Ok(seconds),
        _ => Err("seconds up to a month (2678400) are needed".into()),
    }
}

/// A number that is not negative.
pub(crate) fn not_negative(text: &str) -> Result<f32, String> {
    match finite(text)? {
        x if x >= 0.0 => Ok(x),
        _ => Err("a number that is not negative is needed".into()),
    }
}

/// A number above 0 and below 1.
pub(crate) fn share(text: &str) -> Result<f32, String> {
    match positive(text)? {
        share if share < 1.0 => Ok(share),
        _ => Err("a number between 0 and 1 is needed".into()),
    }
}

/// A direction that is up.
pub(crate) fn up(text: &str) -> Result<DVec3, String> {
    match text {
        "y" | "Y" => Ok(DVec3::Y),
        "z" | "Z" => Ok(DVec3::Z),
        _ => of_length_1(vec3(text).map_err(|e| format!("y, z or a direction is needed: {e}"))?)
            .ok_or_else(|| "a direction other than 0,0,0 is needed".into()),
    }
}
