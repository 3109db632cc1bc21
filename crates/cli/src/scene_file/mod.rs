//! Scene files: what `nuage render --scene` reads and `--save-scene` writes, a TOML file. `docs/scene.md` names every key.
//!
//! Keys have the values of the options that they stand for, and the same limits. An option that stands beside the file
//! overrules it.

mod table;
mod write;

use std::fs;
use std::io::Read;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use glam::{DAffine3, DMat3, DQuat, DVec3, EulerRot};
use nuage_pipeline::sequence::FrameRange;
use nuage_render::light::{Light, Spot};
use toml::de::DeTable;

use crate::error::Failure;
use crate::look::{
    Filter, Integrator, Look, MOST_LEVELS, MOST_SAMPLES, View, not_negative, seconds, share, up,
};
use crate::plan::{
    EmissionPlan, Extinction, Given, Glow, LightPlan, PhasePlan, Plan, SkyPlan, VolumePlan, What,
};
use crate::values::{self, Auto, SunPosition};
use table::{Table, Wrong};
pub(crate) use write::save;

/// The longest scene file that is read, in bytes.
const LONGEST: u64 = 16 << 20;

/// What a scene file says of the run, not of the picture.
#[derive(Debug, Clone, Default, PartialEq)]
pub(crate) struct RunKeys {
    pub(crate) output: Option<String>,
    pub(crate) frames: Option<FrameRange>,
    pub(crate) overwrite: bool,
    pub(crate) resume: bool,
    pub(crate) exr_float: bool,
    pub(crate) threads: Option<u16>,
    pub(crate) timing: bool,
    pub(crate) checkpoint: bool,
    pub(crate) aovs: bool,
    pub(crate) denoise: bool,
}

/// Reads a scene file. Of the options, those that were given keep their values.
///
/// # Errors
/// If it cannot be read, or says something that makes no sense; the message names the line and the column.
pub(crate) fn read(path: &Path, look: &Look, given: &Given) -> Result<(Plan, RunKeys), Failure> {
    let failed = |what: String| Failure::file(path, what);
    let cannot_read = |error: std::io::Error| failed(format!("cannot read the scene file: {error}"));
    if !fs::metadata(path).map_err(cannot_read)?.is_file() {
        return Err(failed("this is no file: name a scene file, as in scene.toml".into()));
    }
    let mut text = String::new();
    let mut file = fs::File::open(path).map_err(cannot_read)?.take(LONGEST + 1);
    file.read_to_string(&mut text).map_err(cannot_read)?;
    if text.len() as u64 > LONGEST {
        return Err(failed("a scene file of more than 16 MiB is not read".into()));
    }
    let folder = path.parent().unwrap_or(Path::new(""));
    parse(&text, folder, look, given).map_err(|Wrong { span, what }| {
        let (line, column) = place(&text, span.start);
        failed(format!("line {line}, column {column}: {what}"))
    })
}

/// The line and the column of a byte, from 1.
fn place(text: &str, byte: usize) -> (usize, usize) {
    let before = text.get(..byte).unwrap_or(text);
    let line = before.rsplit('\n').next().unwrap_or_default();
    (before.matches('\n').count() + 1, line.chars().count() + 1)
}

fn parse(text: &str, folder: &Path, look: &Look, given: &Given) -> Result<(Plan, RunKeys), Wrong> {
    let document = DeTable::parse(text).map_err(|error| Wrong {
        span: error.span().unwrap_or(0..0),
        what: error.message().lines().collect::<Vec<_>>().join(", "),
    })?;
    let mut root = Table::new("a scene", 0..0, document.get_ref());
    let mut look = look.clone();
    // A value of the file, unless the option was given.
    fn put<T>(given: &Given, id: &str, into: &mut T, value: Option<T>) {
        if let Some(value) = value.filter(|_| !given.has(id)) {
            *into = value;
        }
    }
    if let Some(mut camera) = root.table("camera")? {
        put(given, "camera", &mut look.camera, camera.parsed("position", values::vec3)?.map(Some));
        put(given, "look_at", &mut look.look_at, camera.parsed("look_at", values::vec3)?.map(Some));
        put(given, "up", &mut look.up, camera.parsed("up", up)?);
        put(given, "fov", &mut look.fov, camera.parsed("fov", values::field_of_view)?);
        camera.finish()?;
    }
    if let Some(mut film) = root.table("film")? {
        put(given, "size", &mut look.size, film.parsed("size", FromStr::from_str)?);
        put(given, "background", &mut look.background, film.parsed("background", FromStr::from_str)?);
        put(given, "exposure", &mut look.exposure, film.parsed("exposure", values::finite)?);
        film.finish()?;
    }
    if let Some(mut integrator) = root.table("integrator")? {
        let kind = integrator.parsed("kind", |text| {
            <Integrator as clap::ValueEnum>::from_str(text, false)
                .map_err(|_| "'march' or 'path' is needed".into())
        })?;
        put(given, "integrator", &mut look.integrator, kind);
        let view = integrator.parsed("view", |text| {
            <View as clap::ValueEnum>::from_str(text, false)
                .map_err(|_| "'density', 'depth', 'index', 'first-density' or 'surface' is needed".into())
        })?;
        put(given, "view", &mut look.view, view.map(Some));
        let samples = integrator.parsed("samples", count(1, MOST_SAMPLES as u32))?;
        put(given, "samples", &mut look.samples, samples.map(Some));
        put(given, "noise", &mut look.noise, integrator.parsed("noise", values::positive)?.map(Some));
        put(given, "time", &mut look.time, integrator.parsed("time", seconds)?.map(Some));
        put(given, "seed", &mut look.seed, integrator.parsed("seed", count(0, u32::MAX))?);
        let scatterings = integrator.parsed("scatterings", count(0, 1_000_000))?;
        put(given, "scatterings", &mut look.scatterings, scatterings.map(Some));
        let filter = integrator.parsed("filter", |text| {
            <Filter as clap::ValueEnum>::from_str(text, false).map_err(|_| {
                "'nearest', 'trilinear', 'tricubic', 'stochastic-trilinear' or 'stochastic-tricubic' is needed".into()
            })
        })?;
        put(given, "filter", &mut look.filter, filter);
        put(given, "lod", &mut look.lod, integrator.parsed("lod", count(0, MOST_LEVELS as u32))?);
        put(given, "step", &mut look.step, integrator.parsed("step", values::positive)?);
        put(given, "shadow_step", &mut look.shadow_step, integrator.parsed("shadow_step", not_negative)?);
        put(
            given,
            "shadow_growth",
            &mut look.shadow_growth,
            integrator.parsed("shadow_growth", not_negative)?,
        );
        put(given, "cutoff", &mut look.cutoff, integrator.parsed("cutoff", share)?);
        put(given, "sun_rays", &mut look.sun_rays, integrator.parsed("sun_rays", count(1, 1_000_000))?);
        put(given, "sky_rays", &mut look.sky_rays, integrator.parsed("sky_rays", count(1, 65536))?);
        put(given, "no_sky_rays", &mut look.no_sky_rays, integrator.flag("no_sky_rays")?);
        integrator.finish()?;
    }
    let mut run = RunKeys::default();
    if let Some(mut output) = root.table("output")? {
        run.output = output.text("file")?.map(|file| beside(folder, &file));
        run.frames = output.parsed("frames", |text| FrameRange::from_str(text).map_err(|e| e.to_string()))?;
        run.overwrite = output.flag("overwrite")?.unwrap_or(false);
        run.resume = output.flag("resume")?.unwrap_or(false);
        if run.overwrite && run.resume {
            return Err(output.wrong("overwrite and resume exclude each other"));
        }
        run.exr_float = output.flag("exr_float")?.unwrap_or(false);
        run.threads = output.parsed("threads", count(1, 1024))?.and_then(|threads| threads.try_into().ok());
        run.timing = output.flag("timing")?.unwrap_or(false);
        run.checkpoint = output.flag("checkpoint")?.unwrap_or(false);
        run.aovs = output.flag("aovs")?.unwrap_or(false);
        run.denoise = output.flag("denoise")?.unwrap_or(false);
        output.finish()?;
    }
    let sky = match root.table("sky")? {
        None => SkyPlan::Constant([0.0; 3]),
        Some(sky) => read_sky(sky, folder)?,
    };
    let lights = root.tables("lights")?.into_iter().map(read_light).collect::<Result<_, _>>()?;
    let volumes = root.tables("volumes")?.into_iter();
    let volumes = volumes.map(|volume| read_volume(volume, folder, &look)).collect::<Result<_, _>>()?;
    root.finish()?;
    Ok((Plan { look, volumes, lights, sky }, run))
}

fn count(least: u32, most: u32) -> impl Fn(&str) -> Result<u32, String> {
    move |text| match text.trim().parse::<u32>() {
        Ok(count) if (least..=most).contains(&count) => Ok(count),
        _ => Err(format!("a whole number from {least} to {most} is needed")),
    }
}

/// A path as the scene file means it.
fn beside(folder: &Path, file: &str) -> String {
    match folder.as_os_str().is_empty() || Path::new(file).is_absolute() {
        true => file.to_owned(),
        // Joined as text: a pattern is no path, and a folder's end means a folder.
        false => PathBuf::from(folder).join(file).display().to_string(),
    }
}

fn read_sky(mut sky: Table<'_, '_>, folder: &Path) -> Result<SkyPlan, Wrong> {
    if let Some(file) = sky.text("map")? {
        let turn_degrees = sky.parsed("turn", values::finite)?.unwrap_or(0.0);
        let scale = sky.parsed("scale", values::positive)?.unwrap_or(1.0);
        sky.finish()?;
        return Ok(SkyPlan::Map { file: beside(folder, &file), turn_degrees, scale });
    }
    let radiance = sky.parsed("radiance", values::rgb)?;
    let gradient = ["zenith", "horizon", "ground"].map(|key| sky.parsed(key, values::rgb));
    let [zenith, horizon, ground] = gradient;
    let plan = match (radiance, zenith?, horizon?, ground?) {
        (Some(radiance), None, None, None) => SkyPlan::Constant(radiance),
        (None, Some(zenith), Some(horizon), ground) => {
            SkyPlan::Gradient { zenith, horizon, ground: ground.unwrap_or(horizon) }
        }
        _ => return Err(sky.wrong("a sky has either radiance, or zenith, horizon and ground, or a map")),
    };
    sky.finish()?;
    Ok(plan)
}

fn read_light(mut light: Table<'_, '_>) -> Result<LightPlan, Wrong> {
    let kind = light.text("kind")?;
    let plan = match kind.as_deref() {
        Some("sun") => LightPlan::Sun {
            position: light.needed("position", |text| match SunPosition::from_str(text)? {
                SunPosition::None => Err("a light that is none is left out".into()),
                position => Ok(position),
            })?,
            irradiance: light.needed("irradiance", values::rgb)?,
            angle_degrees: light.parsed("angle", values::sun_angle)?.unwrap_or(0.0),
        },
        Some("point") => {
            let position = light.needed("position", values::vec3)?;
            let intensity = bright(&mut light, "intensity", 4.0 * std::f64::consts::PI)?;
            LightPlan::Placed(Light::Point { position, intensity })
        }
        Some("spot") => {
            let position = light.needed("position", values::vec3)?;
            let towards = light.parsed("look_at", values::vec3)?.map(|target| target - position);
            let direction = light.parsed("direction", values::vec3)?;
            let direction = match (towards, direction) {
                (Some(direction), None) | (None, Some(direction)) => values::of_length_1(direction),
                _ => None,
            };
            let direction = direction.ok_or_else(|| {
                light
                    .wrong("a spot has either look_at, elsewhere than it is, or a direction other than 0,0,0")
            })?;
            let intensity = light.needed("intensity", values::rgb)?;
            let outer_degrees = light.needed("angle", values::cone)? / 2.0;
            let inner_degrees =
                light.parsed("inner_angle", values::cone)?.map_or(outer_degrees, |angle| angle / 2.0);
            if inner_degrees > outer_degrees {
                return Err(light.wrong("inner_angle of a spot is at most its angle"));
            }
            let direction = direction.as_vec3();
            LightPlan::Placed(Light::Spot(Spot {
                position,
                direction,
                intensity,
                inner_degrees,
                outer_degrees,
            }))
        }
        Some("sphere") => {
            let centre = light.needed("centre", values::vec3)?;
            let radius = f64::from(light.needed("radius", values::positive)?);
            let area = 4.0 * std::f64::consts::PI.powi(2) * radius * radius;
            let radiance = bright(&mut light, "radiance", area)?;
            LightPlan::Placed(Light::Sphere { centre, radius, radiance })
        }
        Some(kind) => {
            return Err(
                light.wrong(format!("'{kind}' is no kind of light; there are sun, point, spot, sphere"))
            );
        }
        None => return Err(light.wrong("a light needs a kind: sun, point, spot or sphere")),
    };
    light.finish()?;
    Ok(plan)
}

/// How bright a light is, by a key of its own or by its power.
fn bright(light: &mut Table<'_, '_>, key: &'static str, power_per_unit: f64) -> Result<[f32; 3], Wrong> {
    let own = light.parsed(key, values::rgb)?;
    let power = light.parsed("power", |text| {
        let light = values::rgb(text)?.map(|power| (f64::from(power) / power_per_unit) as f32);
        if light.iter().all(|light| light.is_finite()) { Ok(light) } else { Err("this is too bright".into()) }
    })?;
    match (own, power) {
        (Some(light), None) | (None, Some(light)) => Ok(light),
        _ => Err(light.wrong(format!("such a light has either {key} or power"))),
    }
}

fn read_volume(mut volume: Table<'_, '_>, folder: &Path, look: &Look) -> Result<VolumePlan, Wrong> {
    let file = volume.text("file")?;
    let grid = volume.text("grid")?;
    let cube = volume.table("box")?;
    let ball = volume.table("sphere")?;
    let what = match (file, cube, ball) {
        (Some(file), None, None) => What::File { input: beside(folder, &file), grid: grid.clone() },
        (None, Some(mut cube), None) => {
            let min = cube.needed("min", values::vec3)?;
            let max = cube.needed("max", values::vec3)?;
            if !max.cmpgt(min).all() {
                return Err(cube.wrong("max of a box must be more than min along each axis"));
            }
            cube.finish()?;
            What::Box { min, max }
        }
        (None, None, Some(mut ball)) => {
            let centre = ball.parsed("centre", values::vec3)?.unwrap_or(DVec3::ZERO);
            let radius = f64::from(ball.needed("radius", values::positive)?);
            ball.finish()?;
            What::Sphere { centre, radius }
        }
        _ => return Err(volume.wrong("a volume has either a file, a box or a sphere")),
    };
    if grid.is_some() && !matches!(what, What::File { .. }) {
        return Err(volume.wrong("only a volume with a file has a grid"));
    }
    let transform = match volume.table("transform")? {
        None => DAffine3::IDENTITY,
        Some(transform) => read_transform(transform)?,
    };
    let is_file = matches!(what, What::File { .. });
    let auto = |text: &str| match text {
        "auto" if is_file => Ok(Extinction::Auto),
        "auto" => Err("'auto' is for volumes with a file".into()),
        _ => values::rgb(text).map(Extinction::Rgb),
    };
    let extinction = match volume.parsed("extinction", auto)? {
        Some(extinction) => extinction,
        None if is_file => Extinction::Auto,
        None => return Err(volume.wrong("a box and a sphere need the key 'extinction'")),
    };
    let albedo = volume.parsed("albedo", values::albedo)?.unwrap_or(look.albedo);
    let phase = match volume.table_or("phase")? {
        Some(mut phase) => {
            let droplets = phase.parsed("droplets", values::positive)?;
            let g = phase.parsed("g", values::phase)?;
            let alpha = phase.parsed("alpha", not_negative)?;
            let plan = match (droplets, g, alpha) {
                (Some(diameter), None, None) => PhasePlan::Droplets(diameter),
                (None, Some(g), Some(alpha)) => PhasePlan::Draine([g, alpha]),
                (None, Some(g), None) => PhasePlan::Lobe(g),
                _ => return Err(phase.wrong("a phase function has either droplets, or g, or g and alpha")),
            };
            phase.finish()?;
            plan
        }
        None => PhasePlan::Lobe(volume.parsed("phase", values::phase)?.unwrap_or(look.phase)),
    };
    let emission = match volume.table("emission")? {
        None => None,
        Some(emission) => Some(read_emission(emission, look, is_file)?),
    };
    volume.finish()?;
    let plan = VolumePlan { what, transform, extinction, albedo, phase, emission };
    Ok(plan)
}

fn read_transform(mut transform: Table<'_, '_>) -> Result<DAffine3, Wrong> {
    let rows = transform.rows::<3, 4>("matrix")?;
    let translate = transform.parsed("translate", values::vec3)?;
    let rotate = transform.parsed("rotate", values::vec3)?;
    let scale = transform.parsed("scale", values::scale)?;
    let is_plain = translate.is_none() && rotate.is_none() && scale.is_none();
    let affine = match rows {
        Some(_) if !is_plain => {
            return Err(transform.wrong("a transform has either a matrix, or translate, rotate and scale"));
        }
        Some([a, b, c]) => DAffine3::from_cols_array_2d(&std::array::from_fn(|i| [a[i], b[i], c[i]])),
        None => {
            let [x, y, z] = rotate.unwrap_or(DVec3::ZERO).to_array().map(f64::to_radians);
            let turn = DQuat::from_euler(EulerRot::ZYX, z, y, x);
            DAffine3 {
                matrix3: DMat3::from_quat(turn) * DMat3::from_diagonal(scale.unwrap_or(DVec3::ONE)),
                translation: translate.unwrap_or(DVec3::ZERO),
            }
        }
    };
    if !affine.is_finite() || !affine.inverse().is_finite() {
        return Err(transform.wrong("the transform makes a volume flat, or is too large"));
    }
    transform.finish()?;
    Ok(affine)
}

fn read_emission(mut emission: Table<'_, '_>, look: &Look, is_file: bool) -> Result<EmissionPlan, Wrong> {
    let temperature = emission.text("temperature")?;
    let flame = emission.text("flame")?;
    let kelvin = emission.parsed("kelvin", values::positive)?;
    let colour = emission.parsed("color", values::rgb)?;
    let scale = emission.parsed("scale", FromStr::from_str)?;
    let is_flame = flame.is_some() || (temperature.is_none() && kelvin.is_none());
    if (temperature.is_some() && flame.is_some())
        || (is_flame && kelvin.is_some())
        || (!is_flame && colour.is_some())
    {
        return Err(
            emission.wrong("an emission is either a temperature with kelvin, or a flame with a color")
        );
    }
    let grid = temperature.or(flame);
    if grid.is_some() && !is_file {
        return Err(
            emission.wrong("a box and a sphere glow everywhere alike: give kelvin or color, and no grid")
        );
    }
    let scale = match scale {
        Some(Auto::Auto) | None if grid.is_some() => Auto::Auto,
        Some(Auto::Auto) => return Err(emission.wrong("scale: 'auto' is for a grid that glows")),
        None => Auto::Value(1.0),
        Some(scale) => scale,
    };
    let colour = match is_flame {
        true => Glow::Rgb(colour.unwrap_or(look.flame_color)),
        false => Glow::Kelvin(kelvin.unwrap_or(look.kelvin)),
    };
    emission.finish()?;
    Ok(EmissionPlan { grid, colour, scale })
}
