//! The path tracer against converged pictures of another renderer, and against what must be exact. Numbers are printed
//! with `--nocapture`.

#![allow(clippy::print_stdout, reason = "the measured errors are worth reading")]

mod reference;

use glam::Vec3;
use nuage_render::film::{Film, Image, Tally};
use nuage_render::light::Sky;
use nuage_render::path::PathSettings;
use nuage_render::progressive::{self, Plan, Watch};
use nuage_render::scene::Scene;
use nuage_testkit::find;
use nuage_testkit::npy::read_f32;
use reference::{SIZE, camera, channel, json, lit_scene};

/// A picture and the standard error of each of its pixels.
#[derive(Debug, PartialEq)]
struct Traced {
    image: Image,
    standard_error: Vec<[f32; 4]>,
}

fn trace(
    scene: &Scene,
    settings: PathSettings,
    samples: u32,
    seed: u32,
    [width, height]: [u32; 2],
) -> Traced {
    let mut film = Film::new(width, height).expect("a picture");
    let plan = Plan { settings, seed, samples, pass_samples: samples, ..Plan::default() };
    progressive::trace(scene, &plan, &mut film, &mut Watch::default());
    Traced { image: film.image(), standard_error: film.map(Tally::standard_error) }
}

fn traced(scene: &Scene, settings: PathSettings, paths: u32, seed: u32) -> Traced {
    trace(scene, settings, paths, seed, [SIZE, SIZE])
}

/// Holds a picture before its sky to a reference: the mean, and blocks of 8 × 8 pixels in standard errors of both.
fn compare(name: &str, scene: &Scene, traced: &Traced) {
    let read = |what: &str| find(&format!("oracle/{name}_{what}.npy")).map(|path| read_f32(&path));
    let (Some(mean), Some(stderr)) = (read("mean"), read("stderr")) else { return };
    let sky = scene.sky.radiance(Vec3::Y).to_array();
    let image = traced.image.over(sky);
    let pixels = (SIZE * SIZE) as usize;
    let (mut good, mut blocks, mut worst) = (0, 0, 0.0_f64);
    for channel in 0..3 {
        let ours = |i: usize| f64::from(image.pixels[i][channel]);
        // The sky behind is as uncertain as the transmittance in front of it.
        let variance = |i: usize| {
            let [own, alpha] =
                [traced.standard_error[i][channel], traced.standard_error[i][3]].map(f64::from);
            (own + alpha * f64::from(sky[channel])).powi(2)
        };
        let theirs = |i: usize| f64::from(mean[3 * i + channel]);
        let sum = |f: &dyn Fn(usize) -> f64| (0..pixels).map(f).sum::<f64>() / pixels as f64;
        let (found, expected) = (sum(&ours), sum(&theirs));
        let error = sum(&|i| variance(i) + f64::from(stderr[3 * i + channel]).powi(2)).sqrt()
            / (pixels as f64).sqrt();
        let off = (found - expected).abs();
        println!("{name} {channel}: {found:.5} of {expected:.5}, {:+.3} %", 100.0 * (found / expected - 1.0));
        assert!(off <= 0.005 * expected && off <= 3.0 * error + 0.001 * expected, "{name}: {off} {error}");
        for block in 0..pixels / 64 {
            let first = block / 16 * 8 * 128 + block % 16 * 8;
            let block = |f: &dyn Fn(usize) -> f64| {
                (0..64).map(|i| f(first + i / 8 * 128 + i % 8)).sum::<f64>() / 64.0
            };
            let difference = block(&ours) - block(&theirs);
            let both = block(&|i| variance(i) + f64::from(stderr[3 * i + channel]).powi(2)) / 64.0;
            let z = difference.abs() / (both + 1e-6 * block(&theirs).powi(2)).sqrt();
            good += u32::from(z < 3.0);
            blocks += 1;
            worst = worst.max(z);
        }
    }
    println!("{name}: {good} of {blocks} blocks within 3 standard errors, the worst {worst:.2}");
    assert!(
        f64::from(good) >= 0.99 * f64::from(blocks) && worst < 5.0,
        "{name}: {good} of {blocks}, {worst}"
    );
}

/// The scenes as files are held to more of them, by the tests of the program.
#[test]
fn pictures_are_those_of_another_renderer() {
    let (json, density) = (json(), channel("density"));
    for (name, g, max_scatterings, sky_rays) in
        [("het64_g0", 0.0, None, false), ("het64_g08", 0.8, None, true), ("het64_g0_ss", 0.0, Some(1), false)]
    {
        let scene = lit_scene(&json, &density, g);
        let settings = PathSettings { max_scatterings, sky_rays };
        compare(name, &scene, &traced(&scene, settings, 48, 1));
    }
}

/// Nothing is lost in a medium that absorbs nothing: it cannot be seen before a sky of the same light.
#[test]
fn a_furnace_is_white() {
    let (json, density) = (json(), channel("density"));
    let mut scene = lit_scene(&json, &density, 0.5);
    scene.camera = camera(&json);
    (scene.lights, scene.sky) = (Vec::new(), Sky::Constant([1.0; 3]));
    scene.volumes[0].albedo = [1.0; 3];
    let blind = traced(&scene, PathSettings { sky_rays: false, ..PathSettings::default() }, 4, 3);
    for pixel in &blind.image.over([1.0; 3]).pixels {
        assert!(pixel[..3].iter().all(|value| (value - 1.0).abs() < 1e-4), "{pixel:?}");
    }
    let seeing = traced(&scene, PathSettings::default(), 64, 4).image.over([1.0; 3]);
    let mean = seeing.mean()[1];
    println!("furnace with rays to the sky: {mean}");
    assert!((mean - 1.0).abs() < 1e-3, "{mean}");
}

#[test]
fn seeds_are_independent_and_threads_change_nothing() {
    let (json, density) = (json(), channel("density"));
    let scene = lit_scene(&json, &density, 0.3);
    let small = |seed| trace(&scene, PathSettings::default(), 4, seed, [40, 24]);
    let first = small(1);
    assert_ne!(first, small(2));
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().expect("a pool").install(|| small(1));
    assert_eq!(first, one);
}

/// The mean of many short renders is the long one, within their errors: nothing depends on how many paths there are.
#[test]
fn few_paths_are_not_biased() {
    let (json, density) = (json(), channel("density"));
    let scene = lit_scene(&json, &density, 0.8);
    let means: Vec<f64> = (0..64)
        .map(|seed| f64::from(traced(&scene, PathSettings::default(), 1, seed).image.mean()[0]))
        .collect();
    let mean = means.iter().sum::<f64>() / 64.0;
    let variance = means.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / 63.0;
    let long = f64::from(traced(&scene, PathSettings::default(), 64, 1000).image.mean()[0]);
    let error = (2.0 * variance / 64.0).sqrt();
    println!("64 renders of 1 path: {mean:.6}, one of 64: {long:.6}, standard error {error:.6}");
    assert!((mean - long).abs() < 4.0 * error, "{mean} {long} {error}");
}
