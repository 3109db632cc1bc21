//! How volumes are to look: what `nuage_render::scene` says of a scene, without the grids, which are on the device
//! already.

use glam::{DAffine3, DMat4, DVec3, Vec3};
use nuage_render::camera::Camera;
use nuage_render::color::Blackbody;
use nuage_render::filter::Filter;
use nuage_render::light::{Light, Sky};
use nuage_render::march::Quality;
use nuage_render::path::PathSettings;
use nuage_render::scene::{self, Phase, Scene, Shape, Spectrum};
use nuage_render::views::{self, View};
use nuage_volume::channel::Channel;

use crate::error::GpuError;
use crate::params::{LightParams, MediumParams, Params, Place, SHAPE_BALL, SHAPE_BOX, SHAPE_GRID};
pub use crate::params::{MAX_LIGHTS, MAX_MEDIA};
use crate::real_time::RealTime;
use crate::shader::{SOLID_CHANNEL, TELLING_TURNS};
use crate::upload::Volume;

/// The shortest step of [`Pass::Opacity`]: no more than seven samples then lie in a voxel, even from corner to corner.
const SHORTEST_STEP_VOXELS: f32 = 0.25;
/// With steps that are no shorter there are four at most.
pub(crate) const SHORT_STEP_VOXELS: f32 = 0.5;

/// How volumes are to look.
#[derive(Debug, Clone)]
pub struct Look {
    /// The view.
    pub camera: Camera,
    /// What is seen, [`MAX_MEDIA`] at most. Where they overlap, extinctions add up.
    pub media: Vec<Medium>,
    /// Lights, [`MAX_LIGHTS`] at most.
    pub lights: Vec<Light>,
    /// The light from everywhere.
    pub sky: Sky,
}

/// A medium and where it is.
#[derive(Debug, Clone)]
pub struct Medium {
    /// Where it is.
    pub place: MediumPlace,
    /// The number of the channel that shadow rays and rays of scattered light read in place of the densities.
    pub coarse: Option<usize>,
    /// Extinction per density and world length, per colour.
    pub extinction: [f32; 3],
    /// The share of extinction that is scattering, per colour.
    pub albedo: [f32; 3],
    /// Where light goes that is scattered.
    pub phase: Phase,
    /// What glows: the number of the channel, or the density itself if `None`, and how its values become light.
    pub glow: Option<(Option<usize>, Spectrum)>,
}

/// Where a medium is, and its density there.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum MediumPlace {
    /// The number of the channel that holds its densities.
    Channel(usize),
    /// A density of 1 in what this makes of the cube from 0 to 1.
    Box(DAffine3),
    /// A density of 1 in what this makes of the ball of radius 1 around the origin.
    Ball(DAffine3),
}

/// What is computed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Pass {
    /// A debug view.
    View(View),
    /// Of each pixel the distance of the first voxel above a value, negative if there is none, and the voxel's index.
    Hits {
        /// The value, not negative.
        above: f32,
    },
    /// One minus the share of light that passes, as the product of `1 - extinction × value × step` over samples at whole
    /// multiples of a step from the camera: `nuage_render::depth::stepped_transmittance`.
    Opacity {
        /// How values are made of voxels.
        filter: Filter,
        /// The step.
        step_voxels: f32,
    },
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

/// The channels of a scene, each once: of each volume the densities, the coarser level, and what glows. To be uploaded in this
/// order for [`Look::of_scene`].
pub fn channels_of<'a>(scene: &Scene<'a>) -> Vec<&'a Channel> {
    let mut channels: Vec<&Channel> = Vec::new();
    for volume in &scene.volumes {
        let glow = volume.emission.as_ref().and_then(|emission| emission.channel);
        for channel in [volume.shape.channel(), volume.coarse, glow].into_iter().flatten() {
            if !channels.iter().any(|known| std::ptr::eq(*known, channel)) {
                channels.push(channel);
            }
        }
    }
    channels
}

impl Look {
    /// The look of a scene whose channels are numbered as [`channels_of`] lists them.
    ///
    /// # Errors
    /// If the scene has more volumes than there may be.
    pub fn of_scene(scene: &Scene<'_>) -> Result<Look, GpuError> {
        if scene.volumes.len() > MAX_MEDIA {
            return Err(GpuError::Unsupported { feature: "more than sixteen volumes" });
        }
        let channels = channels_of(scene);
        let number = |channel: &Channel| channels.iter().position(|known| std::ptr::eq(*known, channel));
        let medium = |volume: &scene::Volume<'_>| {
            let place = match volume.shape {
                // All channels of the scene are listed.
                Shape::Grid(channel) => MediumPlace::Channel(number(channel).unwrap_or(0)),
                Shape::Box { world_from_unit } => MediumPlace::Box(world_from_unit),
                Shape::Ball { world_from_unit } => MediumPlace::Ball(world_from_unit),
            };
            let glow = volume.emission.as_ref();
            Medium {
                place,
                coarse: volume.coarse.and_then(number),
                extinction: volume.extinction,
                albedo: volume.albedo,
                phase: volume.phase,
                glow: glow.map(|glow| (glow.channel.and_then(number), glow.spectrum.clone())),
            }
        };
        Ok(Look {
            camera: scene.camera,
            media: scene.volumes.iter().map(medium).collect(),
            lights: scene.lights.clone(),
            sky: scene.sky.clone(),
        })
    }

    /// Whether extinction is the same for all colours.
    pub(crate) fn is_grey(&self) -> bool {
        self.media.iter().all(|medium| medium.is_grey())
    }

    /// The relative radiance of black bodies, if any glows as one.
    pub(crate) fn blackbody(&self) -> Option<&Blackbody> {
        self.media.iter().find_map(|medium| match &medium.glow {
            Some((_, Spectrum::Blackbody { table, .. })) => Some(table.as_ref()),
            _ => None,
        })
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
        let mut params = Params {
            camera: wide(eye - origin),
            forward: wide(forward),
            right: wide(right * half_width_tangent),
            up: wide(up * half_width_tangent),
            size: [width, height, frame as u32, 0],
            counts: [1, u32::MAX, 0, self.lights.len() as u32],
            tone: [1.0, 1.0, 1.0, 1.0],
            map_size: [0, 0, TELLING_TURNS, 0],
            rounds: [0, 0, 0, u32::MAX],
            ..Params::default()
        };
        for (slot, medium) in params.media.iter_mut().zip(&self.media) {
            *slot = medium.params(origin, self.blackbody());
        }
        if let Some(table) = self.blackbody() {
            params.blackbody.iter_mut().zip(table.table()).for_each(|(slot, row)| *slot = *row);
        }
        match &self.sky {
            Sky::Gradient { up, zenith, horizon, ground } => {
                params.sky_up = up.extend(0.0).to_array();
                params.sky_zenith = colour(*zenith, 0.0);
                params.sky_horizon = colour(*horizon, 0.0);
                params.sky_ground = colour(*ground, 0.0);
            }
            Sky::Map(map) => {
                let parts = map.parts();
                let rows = parts.map_from_world.transpose();
                let row = |row: Vec3| row.extend(0.0).to_array();
                (params.map_x, params.map_y, params.map_z) =
                    (row(rows.x_axis), row(rows.y_axis), row(rows.z_axis));
                (params.map_size[0], params.map_size[1]) = (parts.width, parts.height);
            }
            even @ Sky::Constant(_) => {
                let radiance = even.radiance(Vec3::Y).extend(0.0).to_array();
                (params.sky_zenith, params.sky_horizon, params.sky_ground) = (radiance, radiance, radiance);
            }
        }
        for (slot, light) in params.lights.iter_mut().zip(&self.lights) {
            *slot = LightParams::of(light, origin);
        }
        match *pass {
            Pass::View(view) => self.view(&mut params, volume, view, frame),
            Pass::Hits { above } => (params.counts[2], params.view[3]) = (4, above),
            Pass::Opacity { filter, step_voxels } => {
                params.counts[2] = match filter {
                    Filter::Nearest => 5,
                    Filter::Trilinear => 6,
                };
                params.march[0] = step_voxels;
            }
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
        let channels = self.media.iter().flat_map(Medium::channels);
        if let Some(missing) = { channels }.find(|channel| *channel >= volume.channels()) {
            return Err(GpuError::Misuse(format!("channel {missing} of a look was not uploaded")));
        }
        if matches!(pass, Pass::Path { .. }) {
            return Ok(());
        }
        let [Medium { place: MediumPlace::Channel(_), .. }] = self.media.as_slice() else {
            return unsupported("anything but one grid in views and in one scattering");
        };
        let is_point_sun = |light: &Light| matches!(light, Light::Sun(sun) if sun.angle_degrees <= 0.0);
        match pass {
            Pass::Opacity { step_voxels, .. }
                if step_voxels.is_nan() || *step_voxels < SHORTEST_STEP_VOXELS =>
            {
                unsupported("steps of less than a quarter of a voxel")
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

    /// The channel of the densities that all passes but those of paths show.
    pub(crate) fn density_channel(&self) -> usize {
        match self.media.first() {
            Some(Medium { place: MediumPlace::Channel(channel), .. }) => *channel,
            _ => 0,
        }
    }

    /// The channel of the densities that shadow rays meet.
    pub(crate) fn shadow_channel(&self) -> usize {
        let coarse = self.media.first().and_then(|medium| medium.coarse);
        coarse.unwrap_or_else(|| self.density_channel())
    }

    fn view(&self, params: &mut Params, volume: &Volume, view: View, frame: usize) {
        let channel = self.density_channel();
        let corners = volume.place(frame, channel).map_or([DVec3::ZERO; 8], Place::world_corners);
        let [nearest, furthest] = views::distances(&corners, &self.camera);
        params.view = [nearest as f32, furthest as f32, volume.largest(channel), 0.0];
        params.counts[2] = match view {
            View::Density { extinction } => {
                params.media[0].extinction = [extinction; 4];
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
        params.march_rays = [quality.sun_rays as f32, quality.sky_rays as f32, max_shadow_depth, 0.0];
        params.counts[0] = quality.samples.max(1);
        params.marched = [params.size[0], params.size[1], 1, 0];
        if let Some(Light::Sun(sun)) = self.lights.first() {
            params.sun_direction = sun.direction_to.extend(0.0).to_array();
            params.sun_irradiance = Vec3::from_array(sun.irradiance).extend(0.0).to_array();
        }
    }
}

impl Medium {
    /// Whether extinction is the same for all colours.
    fn is_grey(&self) -> bool {
        let [red, green, blue] = self.extinction;
        red == green && green == blue
    }

    /// The channels that it reads.
    fn channels(&self) -> impl Iterator<Item = usize> {
        let density = match self.place {
            MediumPlace::Channel(channel) => Some(channel),
            MediumPlace::Box(_) | MediumPlace::Ball(_) => None,
        };
        let glow = self.glow.as_ref().and_then(|(channel, _)| *channel);
        [density, self.coarse, glow].into_iter().flatten()
    }

    /// The channel that glows, [`SOLID_CHANNEL`] for a solid that does itself.
    pub(crate) fn glow_channel(&self) -> Option<u32> {
        let (channel, _) = self.glow.as_ref()?;
        Some(match (*channel, self.place) {
            (Some(channel), _) | (None, MediumPlace::Channel(channel)) => channel as u32,
            (None, _) => SOLID_CHANNEL,
        })
    }

    /// As shaders have it, in a world that begins at `origin`, with the table of black bodies that they have.
    fn params(&self, origin: DVec3, shared: Option<&Blackbody>) -> MediumParams {
        let colour = |colour: [f32; 3], last: f32| Vec3::from_array(colour).extend(last).to_array();
        let strongest = self.extinction.into_iter().fold(0.0, f32::max);
        let mut params = MediumParams {
            extinction: colour(self.extinction, strongest.max(f32::MIN_POSITIVE)),
            albedo: colour(self.albedo, 0.0),
            phase: self.phase.lobes(),
            ..MediumParams::default()
        };
        let (shape, density) = match self.place {
            MediumPlace::Channel(channel) => (SHAPE_GRID, channel as u32),
            MediumPlace::Box(_) => (SHAPE_BOX, SOLID_CHANNEL),
            MediumPlace::Ball(_) => (SHAPE_BALL, SOLID_CHANNEL),
        };
        let coarse = self.coarse.map_or(density, |channel| channel as u32);
        params.kind = [shape, density, coarse, self.glow_channel().unwrap_or(u32::MAX)];
        if let MediumPlace::Box(world_from_unit) | MediumPlace::Ball(world_from_unit) = self.place {
            params.place_solid(world_from_unit, origin);
        }
        match &self.glow {
            Some((_, Spectrum::Linear { rgb })) => params.emission = colour(*rgb, -1.0),
            Some((_, Spectrum::Blackbody { kelvin_per_unit, scale, table })) => {
                // Tables differ in the temperature at which their luminance is 1, and so by a factor.
                let hottest = |table: &Blackbody| table.table().first().map_or(0.0, |row| row[3]);
                let factor = shared.map_or(1.0, |shared| (hottest(table) - hottest(shared)).exp());
                params.emission = [scale * factor, 0.0, 0.0, kelvin_per_unit.max(0.0)];
            }
            None => {}
        }
        params
    }
}

/// What takes a host's clip space to the shaders' world, from what takes its world to clip space.
pub(crate) fn world_from_clip(clip_from_world: &DMat4, origin: DVec3) -> [[f32; 4]; 4] {
    let inverse = DMat4::from_translation(-origin) * clip_from_world.inverse();
    inverse.as_mat4().to_cols_array_2d()
}
