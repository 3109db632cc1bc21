//! What coarser levels and shadow rays in steps change of a picture, and what they save:
//! `cargo bench -p nuage-render --bench lod -- CLOUD.vdb…`, with each cloud's density in the light that `nuage render` gives it.
//!
//! Prints two tables in Markdown. Marched pictures are held to those whose shadow rays integrate the volume itself exactly, paths
//! to many more paths through it. RMS errors are over blocks of 16² pixels; of paths, noise is taken off them.

#![allow(clippy::print_stdout, reason = "the tables printed are what the program is for")]

use std::error::Error;
use std::path::Path;
use std::time::Instant;

use nuage_render::film::{Film, Tally};
use nuage_render::framing::{self, WorldBox};
use nuage_render::light::Sun;
use nuage_render::lod::coarser_by;
use nuage_render::march::Quality;
use nuage_render::picture;
use nuage_render::progressive::{Plan, Watch, trace};
use nuage_render::scene::{Phase, Scene, Shape, Volume};
use nuage_volume::channel::Channel;

/// Pixels per side of pictures, and of the blocks that are compared.
const SIDE: u32 = 512;
const BLOCK: u32 = 16;
const PATHS: u32 = 64;
const REFERENCE_PATHS: u32 = 256;
/// Each picture is made so often, in turns, and the median of times counts.
const ROUNDS: usize = 3;

/// The sums of green light over blocks, and their variances.
struct Blocks {
    light: Vec<f64>,
    variance: Vec<f64>,
}

fn blocks(values: impl Iterator<Item = (f64, f64)>) -> Blocks {
    let across = (SIDE / BLOCK) as usize;
    let mut sums = Blocks { light: vec![0.0; across * across], variance: vec![0.0; across * across] };
    for (i, (light, variance)) in (0..).zip(values) {
        let block = (i / SIDE / BLOCK) as usize * across + (i % SIDE / BLOCK) as usize;
        sums.light[block] += light;
        sums.variance[block] += variance;
    }
    sums
}

/// The error of the mean, its standard error, and the root mean square error of blocks without noise, as shares of the mean.
fn errors(found: &Blocks, expected: &Blocks) -> [f64; 3] {
    let sum = |values: &[f64]| values.iter().sum::<f64>();
    let whole = sum(&expected.light);
    let noise = sum(&found.variance) + sum(&expected.variance);
    let squares: f64 = found.light.iter().zip(&expected.light).map(|(a, b)| (a - b).powi(2)).sum();
    let count = expected.light.len() as f64;
    let rms = ((squares - noise).max(0.0) / count).sqrt() / (whole / count);
    [sum(&found.light) / whole - 1.0, noise.sqrt() / whole, rms]
}

fn scene<'a>(density: &'a Channel, coarse: Option<&'a Channel>, extinction: f32) -> Option<Scene<'a>> {
    let up = glam::DVec3::Y;
    let towards = framing::direction(25.0, 12.0, false).as_dvec3();
    let camera = framing::fit_camera(WorldBox::of(density)?, towards, up, 35.0, 1.0)?;
    let extinction =
        if extinction > 0.0 { extinction } else { framing::fit_density_scale(density, &camera, 1.0)? };
    let volume = Volume {
        coarse,
        albedo: [0.95; 3],
        phase: Phase::HenyeyGreenstein { g: 0.2 },
        ..Volume::absorbing(Shape::Grid(density), extinction)
    };
    let sun = Sun::point(framing::direction(-60.0, 40.0, false), [12.0, 11.2, 10.0]);
    Some(Scene::of_one(camera, volume, Some(sun), [0.22, 0.32, 0.5]))
}

fn marched(scene: &Scene<'_>, shadow_step_voxels: f32) -> Result<Blocks, Box<dyn Error>> {
    let quality = Quality { shadow_step_voxels, ..Quality::default() };
    let image = picture::render(scene, quality, SIDE, SIDE, &|_, _| {})?;
    Ok(blocks(image.pixels.iter().map(|pixel| (pixel[1].into(), 0.0))))
}

fn traced(scene: &Scene<'_>, samples: u32, seed: u32) -> Result<Blocks, Box<dyn Error>> {
    let mut film = Film::new(SIDE, SIDE)?;
    trace(scene, &Plan { samples, seed, ..Plan::default() }, &mut film, &mut Watch::default());
    let variance = film.map(Tally::standard_error);
    let pixels = film.image().pixels;
    Ok(blocks(pixels.iter().zip(&variance).map(|(pixel, e)| (pixel[1].into(), f64::from(e[1]).powi(2)))))
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn table(file: &Path) -> Result<[Vec<String>; 2], Box<dyn Error>> {
    let name = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
    let vdb = nuage_vdb::File::open(std::fs::read(file)?)?;
    let grid = vdb.read_grid(nuage_pipeline::select::density_grid(&vdb)?)?;
    let (density, _) = nuage_pipeline::import::import(grid)?;
    let levels = [coarser_by(&density, 1)?, coarser_by(&density, 2)?];
    let extinction = scene(&density, None, 0.0).ok_or("nothing to see")?.volumes[0].extinction[0];
    let scenes: Vec<Scene<'_>> = [None, levels[0].as_ref(), levels[1].as_ref()]
        .into_iter()
        .filter_map(|coarse| scene(&density, coarse, extinction))
        .collect();
    let cases: Vec<(f32, usize)> =
        [0.0, 2.0].into_iter().flat_map(|step| (0..3).map(move |l| (step, l))).collect();
    let mut times = vec![Vec::new(); cases.len() + scenes.len()];
    let mut found = Vec::new();
    for round in 0..ROUNDS {
        found.clear();
        for (times, (step, level)) in times.iter_mut().zip(&cases) {
            let begin = Instant::now();
            found.push(marched(&scenes[*level], *step)?);
            times.push(begin.elapsed().as_secs_f64());
        }
        for (times, scene) in times[cases.len()..].iter_mut().zip(&scenes) {
            let begin = Instant::now();
            found.push(traced(scene, PATHS, round as u32)?);
            times.push(begin.elapsed().as_secs_f64());
        }
    }
    let times: Vec<f64> = times.into_iter().map(median).collect();
    let paths = traced(&scenes[0], REFERENCE_PATHS, 1000)?;
    let marches = cases.iter().zip(&found).zip(&times).map(|(((step, level), picture), time)| {
        let shadows = if *step > 0.0 { format!("steps from {step} voxels") } else { "exact".to_owned() };
        let [mean, _, rms] = errors(picture, &found[0]).map(|error| 100.0 * error);
        format!("| {name} | {level} | {shadows} | {time:.2} | {mean:+.2} | {rms:.2} |")
    });
    let traces =
        found[cases.len()..].iter().zip(&times[cases.len()..]).enumerate().map(|(level, (picture, time))| {
            let [mean, noise, rms] = errors(picture, &paths).map(|error| 100.0 * error);
            format!("| {name} | {level} | {time:.2} | {mean:+.2} ± {noise:.2} | {rms:.2} |")
        });
    Ok([marches.collect(), traces.collect()])
}

fn main() -> Result<(), Box<dyn Error>> {
    let files: Vec<String> = std::env::args().skip(1).filter(|argument| argument != "--bench").collect();
    let tables = files.iter().map(|file| table(Path::new(file))).collect::<Result<Vec<_>, _>>()?;
    println!(
        "| marched | level | shadow rays | s | error of the mean, % | of blocks, % |\n| --- | ---: | --- | ---: | ---: | ---: |"
    );
    tables.iter().flat_map(|[marched, _]| marched).for_each(|row| println!("{row}"));
    println!(
        "\n| {PATHS} paths | level | s | error of the mean, % | of blocks, % |\n| --- | ---: | ---: | ---: | ---: |"
    );
    tables.iter().flat_map(|[_, traced]| traced).for_each(|row| println!("{row}"));
    Ok(())
}
