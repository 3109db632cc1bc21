//! From options and volumes to pictures: what `nuage render` and `nuage demo` share.
//!
//! A [`Volume`] is what is loaded of one file; a [`Shot`] is what stays the same over all frames of a sequence:
//! the camera, and the scales of density and emission. The choices themselves are made by the libraries.

use glam::DVec3;
use nuage_pipeline::import::{self, Report};
use nuage_pipeline::select;
use nuage_render::camera::Camera;
use nuage_render::color::Blackbody;
use nuage_render::film::{Image, ImageSizeError};
use nuage_render::framing::{self, WorldBox};
use nuage_render::march::Quality;
use nuage_render::path::PathSettings;
use nuage_render::picture;
use nuage_render::scene::{Emission, Medium, Scene, Spectrum, Sun};
use nuage_vdb::{File, Source};
use nuage_volume::channel::Channel;

use crate::error::explain;
use crate::look::{Integrator, Look};
use crate::values::{Auto, Background, Size};

/// The temperature at which a black body has the stated luminance.
const REFERENCE_KELVIN: f32 = 1500.0;

/// The channels of one frame.
pub(crate) struct Volume {
    pub(crate) density: Channel,
    pub(crate) emission: Option<Channel>,
}

/// What the frames of a sequence have in common.
pub(crate) struct Shot<'l> {
    look: &'l Look,
    camera: Camera,
    density_scale: f32,
    spectrum: Option<Spectrum>,
}

/// The positions in the file of the density grid and of the grid that glows.
///
/// # Errors
/// What is wrong, in words.
pub(crate) fn choose_grids<S: Source>(
    file: &File<S>,
    grid: Option<&str>,
    look: &Look,
) -> Result<(usize, Option<usize>), String> {
    let density = match grid {
        Some(name) => select::named_grid(file, name),
        None => select::density_grid(file),
    };
    let glowing = look.temperature.as_deref().or(look.flame.as_deref());
    let emission = glowing.map(|name| select::named_grid(file, name)).transpose();
    Ok((density.map_err(|e| e.to_string())?, emission.map_err(|e| e.to_string())?))
}

/// Reads the grids of a frame. `warn` is told what was changed on the way to a medium.
///
/// # Errors
/// What is wrong, in words.
pub(crate) fn load<S: Source>(
    file: &File<S>,
    grid: Option<&str>,
    look: &Look,
    warn: &mut dyn FnMut(String),
) -> Result<Volume, String> {
    let (density, emission) = choose_grids(file, grid, look)?;
    let namesakes = select::namesakes(file, density);
    if namesakes.len() > 1 && grid.is_none_or(|name| name != file.grids[density].unique_name) {
        warn(format!(
            "{} grids share the name of {}; --grid chooses another of {}",
            namesakes.len(),
            file.grids[density].unique_name,
            namesakes.join(", ")
        ));
    }
    let mut read = |index: usize| -> Result<Channel, String> {
        let grid = file.read_grid(index).map_err(|e| explain(&e))?;
        let name = file.grids[index].unique_name.clone();
        let (channel, report) = import::import(grid).map_err(|e| e.to_string())?;
        for message in messages(&name, &report, &channel) {
            warn(message);
        }
        Ok(channel)
    };
    Ok(Volume { density: read(density)?, emission: emission.map(read).transpose()? })
}

fn messages(name: &str, report: &Report, channel: &Channel) -> Vec<String> {
    let Report { nan_values, negative_values, infinite_values, level_set_band } = *report;
    let counted = |count: u64, what: &str| (count > 0).then(|| format!("grid '{name}': {count} {what}"));
    let level_set = level_set_band.map(|band| {
        format!("grid '{name}' is a level set: drawn as fog that is full at a depth of {band} world units")
    });
    let nothing = channel.tree.bounds().max == 0.0;
    let empty = nothing.then(|| format!("grid '{name}' holds nothing that is seen: the picture is empty"));
    [
        counted(nan_values, "values are not numbers and count as 0"),
        counted(negative_values, "values are negative and count as 0"),
        counted(infinite_values, "values are infinite and count as the largest number"),
        level_set,
        empty,
    ]
    .into_iter()
    .flatten()
    .collect()
}

impl<'l> Shot<'l> {
    /// Settles camera and scales from the box of all frames and some volumes of the sequence.
    ///
    /// # Errors
    /// What is wrong with the view, in words.
    pub(crate) fn new(
        look: &'l Look,
        world_box: Option<WorldBox>,
        volumes: &[Volume],
    ) -> Result<Self, String> {
        let camera = camera(look, world_box)?;
        let aspect = f64::from(look.size.width) / f64::from(look.size.height);
        // The smallest scale belongs to the densest frame, which must not become a black slab.
        let smallest = |scales: &mut dyn Iterator<Item = f32>| scales.reduce(f32::min).unwrap_or(1.0);
        let density_scale = match look.density {
            Auto::Value(scale) => scale,
            Auto::Auto => smallest(
                &mut volumes.iter().filter_map(|v| framing::fit_density_scale(&v.density, &camera, aspect)),
            ),
        };
        let spectrum = spectrum(look).map(|unscaled| {
            let scale = match look.emission {
                Auto::Value(scale) => scale,
                Auto::Auto => smallest(&mut volumes.iter().filter_map(|volume| {
                    let channel = volume.emission.as_ref()?;
                    let emission = Emission { channel, spectrum: unscaled.clone() };
                    framing::fit_emission_scale(&emission, &camera, aspect)
                })),
            };
            unscaled.brighter(scale)
        });
        Ok(Shot { look, camera, density_scale, spectrum })
    }

    /// Whether volumes are looked at to settle what the options leave open.
    pub(crate) fn needs_volumes(look: &Look) -> bool {
        let glows = look.temperature.is_some() || look.flame.is_some();
        look.density == Auto::Auto || (look.emission == Auto::Auto && glows)
    }

    /// The view.
    pub(crate) fn camera(&self) -> Camera {
        self.camera
    }

    /// Camera and scales in words, so that the shot can be repeated.
    pub(crate) fn describe(&self) -> String {
        let Camera { origin, forward, .. } = self.camera;
        let target = origin + forward;
        let glow = match &self.spectrum {
            None => String::new(),
            Some(Spectrum::Linear { rgb }) => {
                format!(", flame radiance {},{},{} per unit", rgb[0], rgb[1], rgb[2])
            }
            Some(Spectrum::Blackbody { scale, kelvin_per_unit, .. }) => {
                format!(" --emission {scale} --kelvin {kelvin_per_unit}")
            }
        };
        format!(
            "--camera {},{},{} --look-at {},{},{} --density {}{glow}",
            origin.x, origin.y, origin.z, target.x, target.y, target.z, self.density_scale
        )
    }

    /// Renders a frame: composited, exposed.
    ///
    /// # Errors
    /// If the picture is too large.
    pub(crate) fn render(
        &self,
        volume: &Volume,
        progress: &(dyn Fn(u32, u32) + Sync),
    ) -> Result<Image, ImageSizeError> {
        let look = self.look;
        let emission = volume
            .emission
            .as_ref()
            .zip(self.spectrum.clone())
            .map(|(channel, spectrum)| Emission { channel, spectrum });
        let medium = Medium {
            density: &volume.density,
            density_scale: self.density_scale,
            albedo: look.albedo,
            phase_g: look.phase,
            emission,
        };
        let sun = look
            .sun
            .direction(z_is_up(look))
            .map(|direction_to| Sun { direction_to, irradiance: look.sun_irradiance });
        let scene = Scene { camera: self.camera, medium, sun, sky: look.sky };
        let quality = Quality {
            step_voxels: look.step,
            shadow_step_voxels: look.shadow_step,
            shadow_growth: look.shadow_growth,
            min_transmittance: look.cutoff,
            sun_rays: look.sun_rays,
            sky_rays: look.sky_rays,
            samples: look.samples,
        };
        let Size { width, height } = look.size;
        let image = match look.integrator {
            Integrator::March => picture::render(&scene, quality, width, height, progress)?,
            Integrator::Path => {
                let settings = PathSettings { max_scatterings: look.scatterings, ..PathSettings::default() };
                picture::trace(&scene, settings, look.samples, 0, [width, height], progress)?.image
            }
        };
        let image = match look.background {
            Background::None => image,
            Background::Sky => image.over(look.sky),
            Background::Rgb(rgb) => image.over(rgb),
        };
        Ok(if look.exposure == 0.0 { image } else { image.exposed(look.exposure) })
    }
}

fn z_is_up(look: &Look) -> bool {
    look.up.z.abs() > look.up.y.abs()
}

/// The light of the grid that glows, at a scale of 1.
fn spectrum(look: &Look) -> Option<Spectrum> {
    if look.temperature.is_some() {
        let table = Box::new(Blackbody::new(REFERENCE_KELVIN));
        Some(Spectrum::Blackbody { kelvin_per_unit: look.kelvin, scale: 1.0, table })
    } else {
        look.flame.as_ref().map(|_| Spectrum::Linear { rgb: look.flame_color })
    }
}

fn camera(look: &Look, world_box: Option<WorldBox>) -> Result<Camera, String> {
    let aspect = f64::from(look.size.width) / f64::from(look.size.height);
    // An empty sequence is still a picture of the background.
    let world_box = world_box.unwrap_or(WorldBox { min: DVec3::splat(-1.0), max: DVec3::splat(1.0) });
    let target = look.look_at.unwrap_or_else(|| world_box.centre());
    let camera = match look.camera {
        Some(origin) => Camera::look_at(origin, target, look.up, look.fov),
        None => {
            let towards = framing::direction(25.0, 12.0, z_is_up(look)).as_dvec3();
            let fitted = framing::fit_camera(world_box, towards, look.up, look.fov, aspect);
            fitted.and_then(|camera| {
                let shift = target - world_box.centre();
                Camera::look_at(camera.origin + shift, target, look.up, look.fov)
            })
        }
    };
    camera.ok_or_else(|| {
        "the view makes no sense: --camera and --look-at must differ, and --up must not lie along the view".into()
    })
}
