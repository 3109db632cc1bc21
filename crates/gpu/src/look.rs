//! How a volume is to look: what `nuage_render::scene` says of a scene with one grid, without the grid, which is on the
//! device already.

use glam::{DMat4, DVec3, Vec3};
use nuage_render::camera::Camera;
use nuage_render::filter::Lookup;
use nuage_render::light::{Light, Sky};
use nuage_render::march::Quality;
use nuage_render::path::PathSettings;
use nuage_render::scene::{Phase, Scene, Shape, Spectrum};
use nuage_render::views::{self, View};

use crate::error::GpuError;
pub use crate::params::MAX_LIGHTS;
use crate::params::{LightParams, Params, Place};
use crate::real_time::RealTime;
use crate::upload::Volume;

/// How a volume is to look.
#[derive(Debug, Clone)]
pub struct Look {
    /// The view.
    pub camera: Camera,
    /// Extinction per density and world length, per colour.
    pub extinction: [f32; 3],
    /// The share of extinction that is scattering, per colour.
    pub albedo: [f32; 3],
    /// Where light goes that is scattered.
    pub phase: Phase,
    /// What glows: the number of the channel, and how its values become light.
    pub glow: Option<(usize, Spectrum)>,
    /// Lights, [`MAX_LIGHTS`] at most.
    pub lights: Vec<Light>,
    /// The light from everywhere; not a picture.
    pub sky: Sky,
}

/// What is computed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pass {
    /// A debug view.
    View(View),
    /// Of each pixel the distance of the first voxel above 0, negative if there is none, and the voxel's index.
    Hits,
    /// Of each pixel the distance at which a level is reached, negative if it is not.
    SurfaceHits {
        /// The value at the surface.
        level: f32,
    },
    /// Single scattering, as `nuage_render::march`.
    March(Quality),
    /// Single scattering in pictures that follow each other: as [`Pass::March`], by what [`RealTime`] asks for.
    RealTime {
        /// How finely, where there is time.
        quality: Quality,
        /// By which means.
        measures: RealTime,
    },
    /// The volume's shadow on a scene: the share of the sun's light that gets to each pixel of the host's depth buffer, in all
    /// colours, with an opacity of 1. Without a depth buffer to points, which stand in the picture
    /// ([`Renderer::set_points`](crate::renderer::Renderer::set_points)).
    Shadow(Quality),
    /// Multiple scattering, as `nuage_render::path`: adds one path to those that each pixel has.
    ///
    /// One, so that no pass lasts long: drivers end passes of seconds, and lavapipe leaves loops after 65535 turns in all.
    Path {
        /// How paths are made.
        settings: PathSettings,
        /// The number of the path; at 0 the picture begins anew.
        sample: u32,
    },
}

impl Look {
    /// The look of a scene of one grid, whose channel is the first one uploaded; what glows is the second one, unless it is
    /// the same.
    ///
    /// # Errors
    /// If the scene has something else.
    pub fn of_scene(scene: &Scene<'_>) -> Result<Look, GpuError> {
        let unsupported = |feature| GpuError::Unsupported { feature };
        let [volume] = scene.volumes.as_slice() else {
            return Err(unsupported("more than one volume, or none"));
        };
        if !matches!(volume.shape, Shape::Grid(_)) {
            return Err(unsupported("a homogeneous box or ball"));
        }
        if volume.coarse.is_some() {
            return Err(unsupported("a coarser level for shadows and scattered light"));
        }
        let glow = volume.emission.as_ref();
        let glow = glow.map(|emission| (usize::from(emission.channel.is_some()), emission.spectrum.clone()));
        Ok(Look {
            camera: scene.camera,
            extinction: volume.extinction,
            albedo: volume.albedo,
            phase: volume.phase,
            glow,
            lights: scene.lights.clone(),
            sky: scene.sky.clone(),
        })
    }

    /// Whether extinction is the same for all colours.
    pub(crate) fn is_grey(&self) -> bool {
        let [red, green, blue] = self.extinction;
        red == green && green == blue
    }

    /// What a pass is told.
    ///
    /// # Errors
    /// If the pass cannot show this look.
    pub(crate) fn params(
        &self,
        volume: &Volume,
        pass: &Pass,
        [width, height]: [u32; 2],
        frame: usize,
    ) -> Result<Params, GpuError> {
        self.check(volume, pass)?;
        let origin = volume.origin();
        let Camera { origin: eye, forward, right, up, half_width_tangent } = self.camera;
        let wide = |v: DVec3| v.as_vec3().extend(0.0).to_array();
        let colour = |colour: [f32; 3], last: f32| Vec3::from_array(colour).extend(last).to_array();
        let strongest = self.extinction.into_iter().fold(0.0, f32::max);
        let mut params = Params {
            camera: wide(eye - origin),
            forward: wide(forward),
            right: wide(right * half_width_tangent),
            up: wide(up * half_width_tangent),
            size: [width, height, frame as u32, 0],
            counts: [1, u32::MAX, 0, self.lights.len() as u32],
            extinction: colour(self.extinction, strongest.max(f32::MIN_POSITIVE)),
            albedo: colour(self.albedo, 0.0),
            phase: self.phase.lobes(),
            tone: [1.0, 1.0, 1.0, 1.0],
            ..Params::default()
        };
        match &self.glow {
            Some((_, Spectrum::Linear { rgb })) => params.emission = colour(*rgb, -1.0),
            Some((_, Spectrum::Blackbody { kelvin_per_unit, scale, .. })) => {
                params.emission = [*scale, 0.0, 0.0, kelvin_per_unit.max(0.0)];
            }
            None => {}
        }
        match &self.sky {
            Sky::Gradient { up, zenith, horizon, ground } => {
                params.sky_up = up.extend(0.0).to_array();
                params.sky_zenith = colour(*zenith, 0.0);
                params.sky_horizon = colour(*horizon, 0.0);
                params.sky_ground = colour(*ground, 0.0);
            }
            even => {
                let radiance = even.radiance(Vec3::Y).extend(0.0).to_array();
                (params.sky_zenith, params.sky_horizon, params.sky_ground) = (radiance, radiance, radiance);
            }
        }
        for (slot, light) in params.lights.iter_mut().zip(&self.lights) {
            *slot = LightParams::of(light, origin);
        }
        match *pass {
            Pass::View(view) => self.view(&mut params, volume, view, frame),
            Pass::Hits => params.counts[2] = 4,
            Pass::SurfaceHits { level } => (params.counts[2], params.view[3]) = (4, level),
            Pass::March(quality) | Pass::RealTime { quality, .. } | Pass::Shadow(quality) => {
                self.march(&mut params, quality);
            }
            Pass::Path { settings, sample } => {
                params.size[3] = sample;
                params.counts[1] = settings.max_scatterings.unwrap_or(u32::MAX);
                params.tone[1] = 1.0 / sample.saturating_add(1) as f32;
            }
        }
        Ok(params)
    }

    /// Whether a pass can show this look.
    fn check(&self, volume: &Volume, pass: &Pass) -> Result<(), GpuError> {
        let unsupported = |feature| Err(GpuError::Unsupported { feature });
        if self.lights.len() > MAX_LIGHTS {
            return unsupported("more than sixteen lights");
        }
        if matches!(self.sky, Sky::Map(_)) {
            return unsupported("a sky that is a picture");
        }
        if self.glow.as_ref().is_some_and(|(channel, _)| *channel >= volume.channels()) {
            return Err(GpuError::Misuse("the channel that glows was not uploaded".to_owned()));
        }
        let is_point_sun = |light: &Light| matches!(light, Light::Sun(sun) if sun.angle_degrees <= 0.0);
        let is_trilinear = |lookup: &Lookup| *lookup == Lookup::Trilinear;
        match pass {
            Pass::March(Quality { lookup, .. })
            | Pass::RealTime { quality: Quality { lookup, .. }, .. }
            | Pass::Shadow(Quality { lookup, .. })
            | Pass::Path { settings: PathSettings { lookup, .. }, .. }
                if !is_trilinear(lookup) =>
            {
                unsupported("a filter that is not trilinear")
            }
            Pass::March(Quality { shadow_step_voxels, .. })
            | Pass::RealTime { quality: Quality { shadow_step_voxels, .. }, .. }
            | Pass::Shadow(Quality { shadow_step_voxels, .. })
                if *shadow_step_voxels <= 0.0 =>
            {
                unsupported("shadow rays without steps")
            }
            Pass::March(_) | Pass::RealTime { .. } | Pass::Shadow(_) if !self.is_grey() => {
                unsupported("an extinction with a colour in one scattering")
            }
            Pass::March(_) | Pass::RealTime { .. } | Pass::Shadow(_)
                if self.lights.len() > 1 || !self.lights.iter().all(is_point_sun) =>
            {
                unsupported("lights other than one sun without extent in one scattering")
            }
            Pass::March(_) | Pass::RealTime { .. } if !matches!(self.sky, Sky::Constant(_)) => {
                unsupported("a sky that is not the same from everywhere in one scattering")
            }
            _ => Ok(()),
        }
    }

    fn view(&self, params: &mut Params, volume: &Volume, view: View, frame: usize) {
        let corners = volume.place(frame).map_or([DVec3::ZERO; 8], Place::world_corners);
        let [nearest, furthest] = views::distances(&corners, &self.camera);
        params.view = [nearest as f32, furthest as f32, volume.largest(), 0.0];
        params.counts[2] = match view {
            View::Density { extinction } => {
                params.extinction = [extinction; 4];
                0
            }
            View::Depth => 1,
            View::Index => 2,
            View::FirstDensity => 3,
            View::Surface { level } => {
                params.view[3] = level;
                0
            }
        };
    }

    fn march(&self, params: &mut Params, quality: Quality) {
        let Quality { step_voxels, shadow_step_voxels, shadow_growth, min_transmittance, .. } = quality;
        params.march = [step_voxels, shadow_step_voxels, shadow_growth, min_transmittance];
        let max_shadow_depth = -min_transmittance.clamp(f32::MIN_POSITIVE, 1.0).ln();
        params.march_rays =
            [quality.sun_rays as f32, quality.sky_rays as f32, max_shadow_depth, shadow_step_voxels];
        params.counts[0] = quality.samples.max(1);
        params.marched = [params.size[0], params.size[1], 1, 0];
        if let Some(Light::Sun(sun)) = self.lights.first() {
            params.sun_direction = sun.direction_to.extend(0.0).to_array();
            params.sun_irradiance = Vec3::from_array(sun.irradiance).extend(0.0).to_array();
        }
    }
}

/// What takes a host's clip space to the shaders' world, from what takes its world to clip space.
pub(crate) fn world_from_clip(clip_from_world: &DMat4, origin: DVec3) -> [[f32; 4]; 4] {
    let inverse = DMat4::from_translation(-origin) * clip_from_world.inverse();
    inverse.as_mat4().to_cols_array_2d()
}
