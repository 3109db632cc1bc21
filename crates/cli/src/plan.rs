//! What is to be rendered, before any file is read: the options of the command line, or a scene file and the options that
//! stand beside it. Plain data; a [`Shot`](crate::shot::Shot) makes a scene of it.

use std::collections::HashSet;

use glam::{DAffine3, DMat3, DVec3};
use nuage_render::light::Light;
use nuage_render::scene::Shape;

use crate::look::Look;
use crate::values::{Auto, SunPosition};

/// Everything that a picture depends on but for the files.
#[derive(Debug, Clone)]
pub(crate) struct Plan {
    /// View, film and quality. What it says of media and lights is what the following were made of.
    pub(crate) look: Look,
    pub(crate) volumes: Vec<VolumePlan>,
    pub(crate) lights: Vec<LightPlan>,
    pub(crate) sky: SkyPlan,
}

/// A volume.
#[derive(Debug, Clone)]
pub(crate) struct VolumePlan {
    pub(crate) what: What,
    /// Moves the volume from where its file or its shape puts it.
    pub(crate) transform: DAffine3,
    pub(crate) extinction: Extinction,
    pub(crate) albedo: [f32; 3],
    pub(crate) phase: PhasePlan,
    pub(crate) emission: Option<EmissionPlan>,
}

/// Where the density of a volume comes from.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum What {
    /// A grid of a file, or of the files of a sequence.
    File {
        /// As on the command line, relative to the working directory.
        input: String,
        grid: Option<String>,
    },
    Box {
        min: DVec3,
        max: DVec3,
    },
    Sphere {
        centre: DVec3,
        radius: f64,
    },
}

/// Extinction per density and world length.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Extinction {
    /// Grey, and fitted to the view.
    Auto,
    Rgb([f32; 3]),
}

/// How a volume scatters.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum PhasePlan {
    /// Henyey–Greenstein, by g.
    Lobe(f32),
    /// Draine, by g and α.
    Draine([f32; 2]),
    /// Water droplets, by their diameter in micrometres.
    Droplets(f32),
}

/// What a volume gives off.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct EmissionPlan {
    /// The grid that glows; the density itself if there is none.
    pub(crate) grid: Option<String>,
    pub(crate) colour: Glow,
    pub(crate) scale: Auto,
}

/// How values become light.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Glow {
    /// A black body of so many kelvin per unit.
    Kelvin(f32),
    /// Radiance per value and world length, times the scale.
    Rgb([f32; 3]),
}

/// A light. A sun's direction may depend on what is up.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum LightPlan {
    Sun { position: SunPosition, irradiance: [f32; 3], angle_degrees: f32 },
    Placed(Light),
}

/// The sky; its zenith is where the camera's up is.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum SkyPlan {
    Constant([f32; 3]),
    Gradient {
        zenith: [f32; 3],
        horizon: [f32; 3],
        ground: [f32; 3],
    },
    /// A picture, turned around up and made brighter.
    Map {
        file: String,
        turn_degrees: f32,
        scale: f32,
    },
}

/// The options that were given on the command line, by the names that clap knows them by. All others are defaults.
#[derive(Debug, Clone, Default)]
pub(crate) struct Given(HashSet<String>);

impl Given {
    /// What was given to a subcommand.
    pub(crate) fn of(matches: &clap::ArgMatches) -> Self {
        let is_given = |id: &&clap::Id| {
            matches.value_source(id.as_str()) == Some(clap::parser::ValueSource::CommandLine)
        };
        Given(matches.ids().filter(is_given).map(|id| id.as_str().to_owned()).collect())
    }

    pub(crate) fn has(&self, id: &str) -> bool {
        self.0.contains(id)
    }

    /// The first of some that was given.
    fn first<'i>(&self, ids: &[&'i str]) -> Option<&'i str> {
        ids.iter().copied().find(|id| self.has(id))
    }
}

/// The options that are about a medium.
const MEDIUM: [&str; 9] =
    ["grid", "density", "albedo", "phase", "temperature", "kelvin", "flame", "flame_color", "emission"];

impl Plan {
    /// One volume, as the options describe it.
    pub(crate) fn of_look(look: &Look, input: &str, grid: Option<&str>) -> Self {
        let volume = VolumePlan {
            what: What::File { input: input.to_owned(), grid: grid.map(str::to_owned) },
            transform: DAffine3::IDENTITY,
            extinction: extinction(look.density),
            albedo: look.albedo,
            phase: PhasePlan::Lobe(look.phase),
            emission: emission(look),
        };
        let sun = (look.sun != SunPosition::None).then_some(LightPlan::Sun {
            position: look.sun,
            irradiance: look.sun_irradiance,
            angle_degrees: look.sun_angle,
        });
        Plan {
            look: look.clone(),
            volumes: vec![volume],
            lights: sun.into_iter().collect(),
            sky: SkyPlan::Constant(look.sky),
        }
    }

    /// Puts what was given on the command line over what a scene file says of media and lights.
    ///
    /// # Errors
    /// If it is not clear which volume or light is meant, in words.
    pub(crate) fn overrule(
        &mut self,
        given: &Given,
        input: Option<&str>,
        grid: Option<&str>,
    ) -> Result<(), String> {
        let option = |id: &str| format!("--{}", id.replace('_', "-"));
        let Plan { look, volumes, lights, sky } = self;
        if let Some(input) = input {
            let mut files = volumes.iter_mut().filter(|volume| matches!(volume.what, What::File { .. }));
            let (Some(volume), None) = (files.next(), files.next()) else {
                return Err("the scene has no file, or several: which INPUT replaces is not clear".into());
            };
            if let What::File { input: old, .. } = &mut volume.what {
                *old = input.to_owned();
            }
        }
        if let Some(id) = given.first(&MEDIUM) {
            let count = volumes.len();
            let [volume] = volumes.as_mut_slice() else {
                return Err(format!("{} is about one volume, and the scene has {count}", option(id)));
            };
            if let (What::File { grid: old, .. }, Some(grid)) = (&mut volume.what, grid) {
                *old = Some(grid.to_owned());
            }
            if given.has("density") {
                volume.extinction = extinction(look.density);
            }
            if given.has("albedo") {
                volume.albedo = look.albedo;
            }
            if given.has("phase") {
                volume.phase = PhasePlan::Lobe(look.phase);
            }
            if given.has("temperature") || given.has("flame") {
                volume.emission = emission(look);
            }
            if let Some(emission) = &mut volume.emission {
                match &mut emission.colour {
                    Glow::Kelvin(kelvin) if given.has("kelvin") => *kelvin = look.kelvin,
                    Glow::Rgb(rgb) if given.has("flame_color") => *rgb = look.flame_color,
                    _ => {}
                }
                if given.has("emission") {
                    emission.scale = look.emission;
                }
            }
        }
        if given.has("sky") {
            *sky = SkyPlan::Constant(look.sky);
        }
        if let Some(id) = given.first(&["sun", "sun_irradiance", "sun_angle"]) {
            let mut suns = lights.iter_mut().filter(|light| matches!(light, LightPlan::Sun { .. }));
            match (suns.next(), suns.next()) {
                (_, Some(_)) => {
                    return Err(format!("{} is about one sun, and the scene has several", option(id)));
                }
                (Some(LightPlan::Sun { position, irradiance, angle_degrees }), _) => {
                    if given.has("sun") {
                        *position = look.sun;
                    }
                    if given.has("sun_irradiance") {
                        *irradiance = look.sun_irradiance;
                    }
                    if given.has("sun_angle") {
                        *angle_degrees = look.sun_angle;
                    }
                }
                _ => lights.push(LightPlan::Sun {
                    position: look.sun,
                    irradiance: look.sun_irradiance,
                    angle_degrees: look.sun_angle,
                }),
            }
            lights.retain(|light| !matches!(light, LightPlan::Sun { position: SunPosition::None, .. }));
        }
        Ok(())
    }

    /// Whether there is anything to be settled from the volumes themselves.
    pub(crate) fn needs_volumes(&self) -> bool {
        self.volumes.iter().any(|volume| {
            let glow_is_open = volume.emission.as_ref().is_some_and(|emission| emission.scale == Auto::Auto);
            volume.extinction == Extinction::Auto || glow_is_open
        })
    }
}

impl VolumePlan {
    /// The shape in the world of what comes from no file.
    pub(crate) fn solid(&self) -> Option<Shape<'static>> {
        let placed = |scale: DVec3, origin: DVec3| {
            self.transform * DAffine3 { matrix3: DMat3::from_diagonal(scale), translation: origin }
        };
        match self.what {
            What::File { .. } => None,
            What::Box { min, max } => Some(Shape::Box { world_from_unit: placed(max - min, min) }),
            What::Sphere { centre, radius } => {
                Some(Shape::Ball { world_from_unit: placed(DVec3::splat(radius), centre) })
            }
        }
    }
}

fn extinction(density: Auto) -> Extinction {
    match density {
        Auto::Auto => Extinction::Auto,
        Auto::Value(scale) => Extinction::Rgb([scale; 3]),
    }
}

fn emission(look: &Look) -> Option<EmissionPlan> {
    let glow =
        |grid: &String, colour| EmissionPlan { grid: Some(grid.clone()), colour, scale: look.emission };
    let temperature = look.temperature.as_ref().map(|grid| glow(grid, Glow::Kelvin(look.kelvin)));
    temperature.or_else(|| look.flame.as_ref().map(|grid| glow(grid, Glow::Rgb(look.flame_color))))
}
