//! A plan as the text of a scene file. Every number stands there with as many digits as it takes to read the same one back.

use std::fmt::{Display, Write};
use std::path::{Component, Path, PathBuf};

use clap::ValueEnum;
use glam::{DAffine3, DVec3};
use nuage_render::light::{Light, Spot};

use super::RunKeys;
use crate::plan::{EmissionPlan, Extinction, Glow, LightPlan, PhasePlan, Plan, SkyPlan, VolumePlan, What};
use crate::values::{Auto, Background, Size, SunPosition};

/// The text of a scene file that lies in `folder`.
pub(crate) fn save(plan: &Plan, run: &RunKeys, folder: &Path) -> String {
    let mut text = String::new();
    let Plan { look, volumes, lights, sky } = plan;
    let mut table = |header: &str, keys: Vec<(&str, Option<String>)>| {
        // Writing to a string cannot fail.
        let _ = writeln!(text, "{}{header}", if text.is_empty() { "" } else { "\n" });
        for (key, value) in keys {
            let _ = value.map(|value| writeln!(text, "{key} = {value}"));
        }
    };
    table(
        "[camera]",
        vec![
            ("position", look.camera.map(vector)),
            ("look_at", look.look_at.map(vector)),
            ("up", Some(vector(look.up))),
            ("fov", Some(look.fov.to_string())),
        ],
    );
    let Size { width, height } = look.size;
    let background = match look.background {
        Background::None => quoted("none"),
        Background::Sky => quoted("sky"),
        Background::Rgb(rgb) => colour(rgb),
    };
    table(
        "[film]",
        vec![
            ("size", Some(format!("[{width}, {height}]"))),
            ("background", Some(background)),
            ("exposure", Some(look.exposure.to_string())),
        ],
    );
    let kind = look.integrator.to_possible_value().map(|value| quoted(value.get_name()));
    let view = look.view.and_then(|view| view.to_possible_value()).map(|value| quoted(value.get_name()));
    table(
        "[integrator]",
        vec![
            ("kind", kind),
            ("view", view),
            ("samples", look.samples.map(|samples| samples.to_string())),
            ("noise", look.noise.map(|noise| noise.to_string())),
            ("time", look.time.map(|time| time.to_string())),
            ("seed", Some(look.seed.to_string())),
            ("scatterings", look.scatterings.map(|most| most.to_string())),
            ("filter", look.filter.to_possible_value().map(|value| quoted(value.get_name()))),
            ("lod", Some(look.lod.to_string())),
            ("step", Some(look.step.to_string())),
            ("shadow_step", Some(look.shadow_step.to_string())),
            ("shadow_growth", Some(look.shadow_growth.to_string())),
            ("cutoff", Some(look.cutoff.to_string())),
            ("sun_rays", Some(look.sun_rays.to_string())),
            ("sky_rays", Some(look.sky_rays.to_string())),
            ("no_sky_rays", look.no_sky_rays.then(|| "true".to_owned())),
        ],
    );
    let yes = |flag: bool| flag.then(|| "true".to_owned());
    let frames = |frames: &[i64]| frames.iter().map(i64::to_string).collect::<Vec<_>>().join(",");
    table(
        "[output]",
        vec![
            ("file", run.output.as_deref().map(|file| quoted(&path(folder, file)))),
            ("frames", run.frames.as_ref().map(|range| quoted(&frames(range.frames())))),
            ("overwrite", yes(run.overwrite)),
            ("resume", yes(run.resume)),
            ("exr_float", yes(run.exr_float)),
            ("threads", run.threads.map(|threads| threads.to_string())),
            ("timing", yes(run.timing)),
            ("checkpoint", yes(run.checkpoint)),
            ("aovs", yes(run.aovs)),
            ("denoise", yes(run.denoise)),
        ],
    );
    table(
        "[sky]",
        match sky {
            SkyPlan::Constant(radiance) => vec![("radiance", Some(colour(*radiance)))],
            SkyPlan::Map { file, turn_degrees, scale } => vec![
                ("map", Some(quoted(&path(folder, file)))),
                ("turn", Some(turn_degrees.to_string())),
                ("scale", Some(scale.to_string())),
            ],
            SkyPlan::Gradient { zenith, horizon, ground } => vec![
                ("zenith", Some(colour(*zenith))),
                ("horizon", Some(colour(*horizon))),
                ("ground", Some(colour(*ground))),
            ],
        },
    );
    for light in lights {
        table("[[lights]]", light_keys(light));
    }
    for volume in volumes {
        table("[[volumes]]", volume_keys(volume, folder));
    }
    text
}

fn light_keys(light: &LightPlan) -> Vec<(&'static str, Option<String>)> {
    match *light {
        LightPlan::Sun { position, irradiance, angle_degrees } => vec![
            ("kind", Some(quoted("sun"))),
            (
                "position",
                match position {
                    SunPosition::None => None,
                    SunPosition::Angles(azimuth, elevation) => Some(array([azimuth, elevation])),
                    SunPosition::Direction(direction) => Some(vector(direction)),
                },
            ),
            ("irradiance", Some(colour(irradiance))),
            ("angle", Some(angle_degrees.to_string())),
        ],
        LightPlan::Placed(Light::Sun(sun)) => vec![
            ("kind", Some(quoted("sun"))),
            ("position", Some(array(sun.direction_to.to_array()))),
            ("irradiance", Some(colour(sun.irradiance))),
            ("angle", Some(sun.angle_degrees.to_string())),
        ],
        LightPlan::Placed(Light::Point { position, intensity }) => vec![
            ("kind", Some(quoted("point"))),
            ("position", Some(vector(position))),
            ("intensity", Some(colour(intensity))),
        ],
        LightPlan::Placed(Light::Spot(Spot {
            position,
            direction,
            intensity,
            inner_degrees,
            outer_degrees,
        })) => vec![
            ("kind", Some(quoted("spot"))),
            ("position", Some(vector(position))),
            ("direction", Some(array(direction.to_array()))),
            ("intensity", Some(colour(intensity))),
            ("angle", Some((2.0 * outer_degrees).to_string())),
            ("inner_angle", Some((2.0 * inner_degrees).to_string())),
        ],
        LightPlan::Placed(Light::Sphere { centre, radius, radiance }) => vec![
            ("kind", Some(quoted("sphere"))),
            ("centre", Some(vector(centre))),
            ("radius", Some(radius.to_string())),
            ("radiance", Some(colour(radiance))),
        ],
    }
}

fn volume_keys(volume: &VolumePlan, folder: &Path) -> Vec<(&'static str, Option<String>)> {
    let mut keys = match &volume.what {
        What::File { input, grid } => {
            vec![("file", Some(quoted(&path(folder, input)))), ("grid", grid.as_deref().map(quoted))]
        }
        What::Box { min, max } => {
            vec![("box", Some(format!("{{ min = {}, max = {} }}", vector(*min), vector(*max))))]
        }
        What::Sphere { centre, radius } => {
            vec![("sphere", Some(format!("{{ centre = {}, radius = {radius} }}", vector(*centre))))]
        }
    };
    let transform = (volume.transform != DAffine3::IDENTITY).then(|| {
        let [x, y, z, w] = volume.transform.to_cols_array_2d();
        let rows = (0..3).map(|i| array([x[i], y[i], z[i], w[i]])).collect::<Vec<_>>();
        format!("{{ matrix = [{}] }}", rows.join(", "))
    });
    keys.push(("transform", transform));
    keys.push((
        "extinction",
        Some(match volume.extinction {
            Extinction::Auto => quoted("auto"),
            Extinction::Rgb(rgb) => colour(rgb),
        }),
    ));
    keys.push(("albedo", Some(colour(volume.albedo))));
    keys.push((
        "phase",
        Some(match volume.phase {
            PhasePlan::Lobe(g) => g.to_string(),
            PhasePlan::Draine([g, alpha]) => format!("{{ g = {g}, alpha = {alpha} }}"),
            PhasePlan::Droplets(diameter) => format!("{{ droplets = {diameter} }}"),
        }),
    ));
    keys.push((
        "emission",
        volume.emission.as_ref().map(|emission| {
            let EmissionPlan { grid, colour: glow, scale } = emission;
            let (kind, how) = match glow {
                Glow::Kelvin(kelvin) => ("temperature", format!("kelvin = {kelvin}")),
                Glow::Rgb(rgb) => ("flame", format!("color = {}", colour(*rgb))),
            };
            let grid = grid.as_ref().map_or(String::new(), |grid| format!("{kind} = {}, ", quoted(grid)));
            let scale = match scale {
                Auto::Auto => quoted("auto"),
                Auto::Value(scale) => scale.to_string(),
            };
            format!("{{ {grid}{how}, scale = {scale} }}")
        }),
    ));
    keys
}

/// One number if all are the same.
fn colour(rgb: [f32; 3]) -> String {
    let [red, green, blue] = rgb;
    if red == green && green == blue { red.to_string() } else { array(rgb) }
}

fn vector(vector: DVec3) -> String {
    array(vector.to_array())
}

fn array<T: Display, const N: usize>(numbers: [T; N]) -> String {
    format!("[{}]", numbers.map(|number| number.to_string()).join(", "))
}

fn quoted(text: &str) -> String {
    let mut quoted = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => quoted.extend(['\\', c]),
            c if c.is_control() => {
                let _ = write!(quoted, "\\u{:04X}", u32::from(c));
            }
            c => quoted.push(c),
        }
    }
    quoted.push('"');
    quoted
}

/// The path of a file, seen from a folder: both as seen from the working directory. Absolute ones stay as they are.
fn path(folder: &Path, file: &str) -> String {
    if Path::new(file).is_absolute() || folder.as_os_str().is_empty() {
        return file.to_owned();
    }
    let whole = |path: &Path| std::path::absolute(path).ok();
    // A folder that goes up would have to be followed on disk: then the path says where the file is in full.
    let goes_up = |path: &Path| path.components().any(|part| part == Component::ParentDir);
    let (Some(from), Some(to)) = (whole(folder), whole(Path::new(file))) else { return file.to_owned() };
    if goes_up(&from) || from.canonicalize().is_ok_and(|real| real != from) {
        return to.display().to_string();
    }
    let shared = from.components().zip(to.components()).take_while(|(a, b)| a == b).count();
    let ups = from.components().skip(shared).map(|_| Component::ParentDir);
    let path: PathBuf = ups.chain(to.components().skip(shared)).collect();
    path.display().to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_are_seen_from_the_folder_of_the_scene() {
        let here = std::env::current_dir().unwrap();
        if here.canonicalize().unwrap() == here {
            assert_eq!(path(Path::new(""), "a/b.vdb"), "a/b.vdb");
            assert_eq!(path(&here, "a/b.####.vdb"), "a/b.####.vdb");
            assert_eq!(path(&here.join("src"), "a/b.vdb"), "../a/b.vdb");
        }
        assert_eq!(path(Path::new("x"), "/a/b.vdb"), "/a/b.vdb");
    }

    #[test]
    fn texts_are_quoted() {
        assert_eq!(quoted("a\"b\\c\n"), r#""a\"b\\c\u000A""#);
    }
}
