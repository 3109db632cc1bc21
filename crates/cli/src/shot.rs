//! From options and volumes to pictures: what `nuage render` and `nuage demo` share.
//!
//! A [`Volume`] is what is loaded of one file; a [`Shot`] is what stays the same over all frames of a sequence:
//! the plan with everything settled that it left open, the camera and the scales of density and emission. The choices
//! themselves are made by the libraries.

use std::sync::Arc;
use std::time::Duration;

use glam::{DAffine3, DVec3};
use nuage_pipeline::import::{self, Report};
use nuage_pipeline::select;
use nuage_render::camera::Camera;
use nuage_render::color::Blackbody;
use nuage_render::envmap::{self, EnvironmentMap};
use nuage_render::film::{Film, Image, ImageSizeError};
use nuage_render::framing::{self, WorldBox};
use nuage_render::light::{Light, Sky, Sun};
use nuage_render::lod;
use nuage_render::march::{self, Quality};
use nuage_render::path::PathSettings;
use nuage_render::picture;
use nuage_render::progressive::{self, Stopped, Watch};
use nuage_render::scene::{self, Emission, Phase, Scene, Shape, Spectrum};
use nuage_render::traverse::Field;
use nuage_render::views;
use nuage_vdb::{File, Source};
use nuage_volume::channel::Channel;

use crate::device::Gpu;
use crate::error::explain;
use crate::look::{Integrator, Look, View};
use crate::plan::{EmissionPlan, Extinction, Glow, LightPlan, PhasePlan, Plan, SkyPlan};
use crate::values::{Auto, Background, Size};

/// The temperature at which a black body has the stated luminance.
const REFERENCE_KELVIN: f32 = 1500.0;

/// The channels of one frame.
pub(crate) struct Volume {
    pub(crate) density: Channel,
    /// A coarser level of it, if one was asked for.
    pub(crate) coarse: Option<Channel>,
    pub(crate) emission: Option<Channel>,
    /// The value at the surface, if the density is a level set to be drawn as one.
    pub(crate) surface: Option<f32>,
}

impl Volume {
    /// Where it is; `None` if it is nowhere.
    pub(crate) fn world_box(&self) -> Option<WorldBox> {
        let channels = [Some(&self.density), self.emission.as_ref()].into_iter().flatten();
        channels.filter_map(WorldBox::of).reduce(WorldBox::union)
    }

    /// Makes a level with `1/2^levels` of the voxels per axis beside the density.
    ///
    /// # Errors
    /// If that has too many tiles, in words.
    pub(crate) fn coarsen(&mut self, levels: u32) -> Result<(), String> {
        let coarse = lod::coarser_by(&self.density, levels);
        self.coarse = coarse.map_err(|e| format!("--lod {levels} is too much: {e}"))?;
        Ok(())
    }

    /// Moves it.
    pub(crate) fn transform(&mut self, world_from_file: &DAffine3) {
        if *world_from_file != DAffine3::IDENTITY {
            for channel in [Some(&mut self.density), self.emission.as_mut()].into_iter().flatten() {
                channel.world_from_index = *world_from_file * channel.world_from_index;
            }
        }
    }
}

/// The volumes of a frame, in the order of the plan; of those that come from no file, nothing.
pub(crate) type Frame<'v> = [Option<&'v Volume>];

/// What the frames of a sequence have in common.
pub(crate) struct Shot {
    /// Without anything left open.
    plan: Plan,
    camera: Camera,
    spectra: Vec<Option<Spectrum>>,
    /// The picture of the sky, if the plan names one.
    map: Option<Arc<EnvironmentMap>>,
}

/// The positions in the file of the density grid, or of what a view shows, and of the grid that glows.
///
/// # Errors
/// What is wrong, in words.
pub(crate) fn choose_grids<S: Source>(
    file: &File<S>,
    grid: Option<&str>,
    glowing: Option<&str>,
    view: Option<View>,
) -> Result<(usize, Option<usize>), String> {
    let level_set = select::level_set(file).filter(|_| view == Some(View::Surface));
    let density = match (grid, level_set) {
        (Some(name), _) => select::named_grid(file, name),
        (None, Some(level_set)) => Ok(level_set),
        (None, None) => select::density_grid(file),
    };
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
    let glowing = look.temperature.as_deref().or(look.flame.as_deref());
    let mut volume = load_grids(file, grid, glowing, look.view, warn)?;
    volume.coarsen(look.lod)?;
    Ok(volume)
}

/// As [`load`], by the names of the density grid and of the grid that glows.
///
/// # Errors
/// What is wrong, in words.
pub(crate) fn load_grids<S: Source>(
    file: &File<S>,
    grid: Option<&str>,
    glowing: Option<&str>,
    view: Option<View>,
    warn: &mut dyn FnMut(String),
) -> Result<Volume, String> {
    let (density, emission) = choose_grids(file, grid, glowing, view)?;
    let namesakes = select::namesakes(file, density);
    if namesakes.len() > 1 && grid.is_none_or(|name| name != file.grids[density].unique_name) {
        warn(format!(
            "{} grids share the name of {}; --grid chooses another of {}",
            namesakes.len(),
            file.grids[density].unique_name,
            namesakes.join(", ")
        ));
    }
    if view == Some(View::Surface) {
        let grid = file.read_grid(density).map_err(|e| explain(&e))?;
        if !import::is_level_set(&grid) {
            let name = &file.grids[density].unique_name;
            return Err(format!("grid '{name}' is no level set: --view surface has nothing to show"));
        }
        let (density, level) = import::import_surface(grid).map_err(|e| e.to_string())?;
        return Ok(Volume { density, coarse: None, emission: None, surface: Some(level) });
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
    let (density, emission) = (read(density)?, emission.map(read).transpose()?);
    Ok(Volume { density, coarse: None, emission, surface: None })
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

impl Shot {
    /// Settles camera and scales of one volume from the box of all frames and some volumes of the sequence.
    ///
    /// # Errors
    /// What is wrong with the view, in words.
    pub(crate) fn new(look: &Look, world_box: Option<WorldBox>, volumes: &[Volume]) -> Result<Self, String> {
        let frames: Vec<Vec<Option<&Volume>>> = volumes.iter().map(|volume| vec![Some(volume)]).collect();
        Self::of_plan(Plan::of_look(look, "", None), world_box, &frames)
    }

    /// Settles what a plan leaves open from the box of all frames and some frames of the sequence.
    ///
    /// # Errors
    /// What is wrong with the view, in words.
    pub(crate) fn of_plan(
        mut plan: Plan,
        world_box: Option<WorldBox>,
        frames: &[Vec<Option<&Volume>>],
    ) -> Result<Self, String> {
        let boxes = plan.volumes.iter().filter_map(|volume| Some(solid_box(volume.solid()?)));
        let world_box = boxes.chain(world_box).reduce(WorldBox::union);
        let (camera, target) = camera(&plan.look, world_box)?;
        (plan.look.camera, plan.look.look_at) = (Some(camera.origin), Some(target));
        let aspect = f64::from(plan.look.size.width) / f64::from(plan.look.size.height);
        // The smallest scale belongs to the densest frame, which must not become a black slab.
        let smallest = |scales: &mut dyn Iterator<Item = f32>| scales.reduce(f32::min).unwrap_or(1.0);
        let mut spectra = Vec::new();
        for (i, volume) in plan.volumes.iter_mut().enumerate() {
            let loaded = || frames.iter().filter_map(|frame| frame.get(i).copied().flatten());
            if volume.extinction == Extinction::Auto {
                let fitted = |volume: &Volume| framing::fit_density_scale(&volume.density, &camera, aspect);
                volume.extinction = Extinction::Rgb([smallest(&mut loaded().filter_map(fitted)); 3]);
            }
            let Some(EmissionPlan { colour, scale, .. }) = &mut volume.emission else {
                spectra.push(None);
                continue;
            };
            let unscaled = spectrum(*colour);
            let value = match *scale {
                Auto::Value(scale) => scale,
                Auto::Auto => smallest(&mut loaded().filter_map(|volume| {
                    let emission = Emission { channel: volume.emission.as_ref(), spectrum: unscaled.clone() };
                    framing::fit_emission_scale(&emission, &camera, aspect)
                })),
            };
            *scale = Auto::Value(value);
            spectra.push(Some(unscaled.brighter(value)));
        }
        Ok(Shot { plan, camera, spectra, map: None })
    }

    /// Lights it by a picture of radiance of so many columns and rows, as the plan says.
    ///
    /// # Errors
    /// What is wrong with the picture, in words.
    pub(crate) fn light_by(
        &mut self,
        [width, height]: [u32; 2],
        mut texels: Vec<[f32; 3]>,
    ) -> Result<(), String> {
        let SkyPlan::Map { turn_degrees, scale, .. } = self.plan.sky else { return Ok(()) };
        texels.iter_mut().flatten().for_each(|light| *light *= scale);
        let world_from_map = envmap::orientation(self.plan.look.up.as_vec3(), turn_degrees / 360.0);
        let map = EnvironmentMap::new(width, height, texels, world_from_map).map_err(|e| e.to_string())?;
        self.map = Some(Arc::new(map));
        Ok(())
    }

    /// The view.
    pub(crate) fn camera(&self) -> Camera {
        self.camera
    }

    /// The plan, with nothing left open.
    pub(crate) fn plan(&self) -> &Plan {
        &self.plan
    }

    /// Camera and scales in words, so that the shot can be repeated.
    pub(crate) fn describe(&self) -> String {
        let Camera { origin, forward, .. } = self.camera;
        let target = origin + forward;
        let mut text = format!(
            "--camera {},{},{} --look-at {},{},{}",
            origin.x, origin.y, origin.z, target.x, target.y, target.z
        );
        for (volume, spectrum) in self.plan.volumes.iter().zip(&self.spectra) {
            if let Extinction::Rgb([red, green, blue]) = volume.extinction {
                text += &match red == green && green == blue {
                    true => format!(" --density {red}"),
                    false => format!(", extinction {red},{green},{blue}"),
                };
            }
            text += &match spectrum {
                None => String::new(),
                Some(Spectrum::Linear { rgb }) => {
                    format!(", flame radiance {},{},{} per unit", rgb[0], rgb[1], rgb[2])
                }
                Some(Spectrum::Blackbody { scale, kelvin_per_unit, .. }) => {
                    format!(" --emission {scale} --kelvin {kelvin_per_unit}")
                }
            };
        }
        match self.plan.look.lod {
            0 => {}
            lod => text += &format!(" --lod {lod} (shadows and scattered light are a little wrong)"),
        }
        text
    }

    /// The scene of a frame. A volume that the frame lacks is left out.
    fn scene<'v>(&'v self, volumes: &Frame<'v>) -> Scene<'v> {
        let Plan { look, sky, .. } = &self.plan;
        let plans = self.plan.volumes.iter().zip(&self.spectra).enumerate();
        let volumes = plans.filter_map(|(i, (plan, spectrum))| {
            let loaded = volumes.get(i).copied().flatten();
            let shape = plan.solid().or_else(|| loaded.map(|volume| Shape::Grid(&volume.density)))?;
            let extinction = match plan.extinction {
                Extinction::Rgb(rgb) => rgb,
                Extinction::Auto => [1.0; 3],
            };
            let channel = loaded.and_then(|volume| volume.emission.as_ref());
            let emission = spectrum.clone().map(|spectrum| Emission { channel, spectrum });
            let phase = match plan.phase {
                PhasePlan::Lobe(g) => Phase::HenyeyGreenstein { g },
                PhasePlan::Draine([g, alpha]) => Phase::Draine { g, alpha },
                PhasePlan::Droplets(diameter_um) => Phase::mie(diameter_um),
            };
            let coarse = loaded.and_then(|volume| volume.coarse.as_ref());
            Some(scene::Volume { shape, coarse, extinction, albedo: plan.albedo, phase, emission })
        });
        let z_up = z_is_up(look);
        let lights = self.plan.lights.iter().filter_map(|light| match *light {
            LightPlan::Placed(light) => Some(light),
            LightPlan::Sun { position, irradiance, angle_degrees } => {
                Some(Light::Sun(Sun { direction_to: position.direction(z_up)?, irradiance, angle_degrees }))
            }
        });
        let sky = match *sky {
            SkyPlan::Constant(radiance) => Sky::Constant(radiance),
            // Without a picture there is no light of it.
            SkyPlan::Map { .. } => self.map.clone().map_or(Sky::Constant([0.0; 3]), Sky::Map),
            SkyPlan::Gradient { zenith, horizon, ground } => {
                Sky::Gradient { up: look.up.as_vec3(), zenith, horizon, ground }
            }
        };
        Scene { camera: self.camera, volumes: volumes.collect(), lights: lights.collect(), sky }
    }

    /// What the marcher could not follow, in words; `None` if it is not asked, or can.
    pub(crate) fn unsupported(&self, frame: &Frame<'_>) -> Option<String> {
        let look = &self.plan.look;
        if look.view.is_some() {
            let is_one =
                matches!(self.scene(frame).volumes[..], [scene::Volume { shape: Shape::Grid(_), .. }]);
            return (!is_one).then(|| "--view shows one volume, of a file".to_owned());
        }
        let is_marched = look.integrator == Integrator::March;
        let what = march::unsupported(&self.scene(frame)).filter(|_| is_marched)?;
        Some(format!("--integrator march cannot render {what}; --integrator path can"))
    }

    /// Renders a frame of one volume: composited, exposed.
    ///
    /// # Errors
    /// If the picture is too large.
    pub(crate) fn render(
        &self,
        volume: &Volume,
        progress: &(dyn Fn(u32, u32) + Sync),
    ) -> Result<Image, ImageSizeError> {
        self.render_scene(&self.scene(&[Some(volume)]), progress)
    }

    /// Renders a frame: composited, exposed.
    ///
    /// # Errors
    /// If the picture is too large.
    pub(crate) fn render_frame(
        &self,
        frame: &Frame<'_>,
        progress: &(dyn Fn(u32, u32) + Sync),
    ) -> Result<Image, ImageSizeError> {
        let scene = self.scene(frame);
        if let Some(view) = self.plan.look.view {
            let surface = frame.iter().copied().flatten().find_map(|volume| volume.surface);
            return self.render_view(view, surface, &scene, progress);
        }
        self.render_scene(&scene, progress)
    }

    /// The picture of a volume itself.
    fn render_view(
        &self,
        view: View,
        surface: Option<f32>,
        scene: &Scene<'_>,
        progress: &(dyn Fn(u32, u32) + Sync),
    ) -> Result<Image, ImageSizeError> {
        let [width, height] = self.size();
        let volume = scene.volumes.first();
        let field = volume.and_then(|volume| volume.shape.channel()).and_then(Field::new);
        let view = library_view(view, surface, scene);
        let image = match &field {
            Some(field) => views::render_view(field, view, &self.camera, [width, height], progress)?,
            // Nothing is seen of what is empty.
            None => Image::new(width, height)?,
        };
        Ok(self.before(image, scene))
    }

    /// The size of the picture.
    pub(crate) fn size(&self) -> [u32; 2] {
        [self.plan.look.size.width, self.plan.look.size.height]
    }

    /// Traces the paths of a frame into a film, from where it stands.
    pub(crate) fn trace(&self, frame: &Frame<'_>, film: &mut Film, watch: &mut Watch<'_>) -> Stopped {
        progressive::trace(&self.scene(frame), &self.paths(), film, watch)
    }

    /// A picture with the background behind it.
    pub(crate) fn before_background(&self, image: Image, frame: &Frame<'_>) -> Image {
        self.before(image, &self.scene(frame))
    }

    fn before(&self, image: Image, scene: &Scene<'_>) -> Image {
        match self.plan.look.background {
            Background::None => image,
            Background::Sky => before_sky(image, scene),
            Background::Rgb(rgb) => image.over(rgb),
        }
    }

    /// Which paths are traced.
    fn paths(&self) -> progressive::Plan {
        let look = &self.plan.look;
        progressive::Plan {
            settings: PathSettings {
                max_scatterings: look.scatterings,
                sky_rays: !look.no_sky_rays,
                lookup: look.filter.lookup(),
            },
            seed: look.seed,
            pass_samples: 1,
            samples: look.paths(),
            noise: look.noise.map(f64::from),
            time: look.time.map(Duration::from_secs_f32),
        }
    }

    /// How finely pictures are marched.
    fn quality(&self) -> Quality {
        let look = &self.plan.look;
        Quality {
            step_voxels: look.step,
            shadow_step_voxels: look.shadow_step,
            shadow_growth: look.shadow_growth,
            min_transmittance: look.cutoff,
            sun_rays: look.sun_rays,
            sky_rays: look.sky_rays,
            samples: look.samples.unwrap_or(1),
            lookup: look.filter.lookup(),
        }
    }

    /// What a GPU is asked to show.
    #[cfg(feature = "gpu")]
    fn asked(&self, frame: &Frame<'_>) -> nuage_gpu::picture::Asked {
        use nuage_gpu::picture::Asked;
        let look = &self.plan.look;
        let surface = frame.iter().copied().flatten().find_map(|volume| volume.surface);
        match (look.view, look.integrator) {
            (Some(view), _) => Asked::View(library_view(view, surface, &self.scene(frame))),
            (None, Integrator::March) => Asked::March(self.quality()),
            (None, Integrator::Path) => {
                let plan = self.paths();
                Asked::Path { settings: plan.settings, samples: plan.samples }
            }
        }
    }

    /// How a GPU shows a frame that it has already, and the first pass of it.
    ///
    /// # Errors
    /// If it cannot.
    #[cfg(feature = "gpu")]
    pub(crate) fn pass(
        &self,
        frame: &Frame<'_>,
    ) -> Result<(nuage_gpu::look::Look, nuage_gpu::look::Pass), nuage_gpu::error::GpuError> {
        use nuage_gpu::look::Pass;
        use nuage_gpu::picture::Asked;
        let look = nuage_gpu::look::Look::of_scene(&self.scene(frame))?;
        let pass = match self.asked(frame) {
            Asked::View(view) => Pass::View(view),
            Asked::March(quality) => Pass::March(quality),
            Asked::Path { settings, .. } => Pass::Path { settings, sample: 0 },
        };
        Ok((look, pass))
    }

    /// Renders a frame on a GPU: composited, exposed.
    ///
    /// # Errors
    /// What is wrong, in words.
    #[cfg(feature = "gpu")]
    pub(crate) fn render_frame_on(
        &self,
        gpu: &Gpu,
        frame: &Frame<'_>,
        progress: &dyn Fn(u32, u32),
    ) -> Result<Image, String> {
        let (scene, look) = (self.scene(frame), &self.plan.look);
        let asked = self.asked(frame);
        let image = nuage_gpu::picture::render(gpu, &scene, &asked, self.size(), progress)
            .map_err(|error| error.to_string())?;
        let image = self.before(image, &scene);
        // Views are not light.
        Ok(if look.exposure == 0.0 || look.view.is_some() { image } else { image.exposed(look.exposure) })
    }

    /// As above; without the feature `gpu` there is no device to call it with.
    #[cfg(not(feature = "gpu"))]
    pub(crate) fn render_frame_on(
        &self,
        gpu: &Gpu,
        _frame: &Frame<'_>,
        _progress: &dyn Fn(u32, u32),
    ) -> Result<Image, String> {
        match *gpu {}
    }

    fn render_scene(
        &self,
        scene: &Scene<'_>,
        progress: &(dyn Fn(u32, u32) + Sync),
    ) -> Result<Image, ImageSizeError> {
        let look = &self.plan.look;
        let quality = self.quality();
        let Size { width, height } = look.size;
        let image = match look.integrator {
            Integrator::March => picture::render(scene, quality, width, height, progress)?,
            Integrator::Path => {
                let mut film = Film::new(width, height)?;
                let tile = |share: f64| progress((share.clamp(0.0, 1.0) * 1000.0) as u32, 1000);
                let mut watch = Watch { tile: Some(&tile), ..Watch::default() };
                progressive::trace(scene, &self.paths(), &mut film, &mut watch);
                film.image()
            }
        };
        let image = self.before(image, scene);
        Ok(if look.exposure == 0.0 { image } else { image.exposed(look.exposure) })
    }
}

/// A view as the library has it.
fn library_view(view: View, surface: Option<f32>, scene: &Scene<'_>) -> views::View {
    let extinction = scene.volumes.first().map_or(1.0, |volume| volume.extinction[0]);
    match view {
        View::Density => views::View::Density { extinction },
        View::Depth => views::View::Depth,
        View::Index => views::View::Index,
        View::FirstDensity => views::View::FirstDensity,
        View::Surface => views::View::Surface { level: surface.unwrap_or(f32::INFINITY) },
    }
}

/// A picture with the sky behind what is in it.
fn before_sky(mut image: Image, scene: &Scene<'_>) -> Image {
    if let Sky::Constant(radiance) = scene.sky {
        return image.over(radiance);
    }
    let size = [image.width, image.height];
    for (i, pixel) in (0..).zip(&mut image.pixels) {
        let sky = scene.sky.behind(&scene.camera, [i % size[0], i / size[0]], size);
        let passes = 1.0 - pixel[3];
        pixel.iter_mut().zip(sky).for_each(|(pixel, sky)| *pixel += passes * sky);
        pixel[3] = 1.0;
    }
    image
}

fn z_is_up(look: &Look) -> bool {
    look.up.z.abs() > look.up.y.abs()
}

/// The box around a homogeneous shape.
fn solid_box(shape: Shape<'_>) -> WorldBox {
    let (world_from_unit, [low, high]) = match shape {
        Shape::Grid(_) => (DAffine3::IDENTITY, [0.0, 0.0]),
        Shape::Box { world_from_unit } => (world_from_unit, [0.0, 1.0]),
        Shape::Ball { world_from_unit } => (world_from_unit, [-1.0, 1.0]),
    };
    let corner = |i: i32| {
        let pick = |bit: i32| if i >> bit & 1 == 0 { low } else { high };
        world_from_unit.transform_point3(DVec3::new(pick(0), pick(1), pick(2)))
    };
    let first = WorldBox { min: corner(0), max: corner(0) };
    (1..8).map(corner).fold(first, |all, corner| all.union(WorldBox { min: corner, max: corner }))
}

/// The light of what glows, at a scale of 1.
fn spectrum(glow: Glow) -> Spectrum {
    match glow {
        Glow::Kelvin(kelvin_per_unit) => {
            let table = Box::new(Blackbody::new(REFERENCE_KELVIN));
            Spectrum::Blackbody { kelvin_per_unit, scale: 1.0, table }
        }
        Glow::Rgb(rgb) => Spectrum::Linear { rgb },
    }
}

/// The camera, and what it looks at.
fn camera(look: &Look, world_box: Option<WorldBox>) -> Result<(Camera, DVec3), String> {
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
    let camera = camera.ok_or_else(|| -> String {
        "the view makes no sense: --camera and --look-at must differ, and --up must not lie along the view".into()
    })?;
    Ok((camera, target))
}
