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
use nuage_testkit::blocks::{Estimate, hold};
use nuage_testkit::find;
use nuage_testkit::npy::read_f32;
use reference::{SIZE, camera, channel, json, lit_scene, packed_channel};

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

/// Holds a picture before its sky to a reference.
fn compare(name: &str, scene: &Scene, traced: &Traced) {
    let read = |what: &str| find(&format!("oracle/{name}_{what}.npy")).map(|path| read_f32(&path));
    let (Some(mean), Some(stderr)) = (read("mean"), read("stderr")) else { return };
    let sky = scene.sky.radiance(Vec3::Y).to_array();
    let image = traced.image.over(sky);
    for colour in 0..3 {
        // The sky behind is as uncertain as the transmittance in front of it.
        let ours = image.pixels.iter().zip(&traced.standard_error).map(|(pixel, error)| Estimate {
            mean: pixel[colour].into(),
            variance: f64::from(error[colour] + error[3] * sky[colour]).powi(2),
        });
        let theirs = mean.iter().zip(&stderr).skip(colour).step_by(3);
        let theirs = theirs
            .map(|(mean, error)| Estimate { mean: (*mean).into(), variance: f64::from(*error).powi(2) });
        hold(
            &format!("{name} {colour}"),
            SIZE as usize,
            &ours.collect::<Vec<_>>(),
            &theirs.collect::<Vec<_>>(),
        );
    }
}

/// The scenes as files are held to more of them, by the tests of the program.
#[test]
fn pictures_are_those_of_another_renderer() {
    let (json, density) = (json(), channel("density"));
    for (name, g, max_scatterings, sky_rays) in
        [("het64_g0", 0.0, None, false), ("het64_g08", 0.8, None, true), ("het64_g0_ss", 0.0, Some(1), false)]
    {
        let scene = lit_scene(&json, &density, g);
        let settings = PathSettings { max_scatterings, sky_rays, ..PathSettings::default() };
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

/// The mean of many short renders is the long one, within their errors: nothing depends on how many paths there are. Neither
/// of the values as they were nor of what packing made of them, which has other bounds.
#[test]
fn few_paths_are_not_biased() {
    let json = json();
    for density in [channel("density"), packed_channel("density")] {
        let scene = lit_scene(&json, &density, 0.8);
        let mean_of =
            |paths, seed| f64::from(traced(&scene, PathSettings::default(), paths, seed).image.mean()[0]);
        let means: Vec<f64> = (0..64).map(|seed| mean_of(1, seed)).collect();
        let mean = means.iter().sum::<f64>() / 64.0;
        let variance = means.iter().map(|value| (value - mean).powi(2)).sum::<f64>() / 63.0;
        let long = mean_of(64, 1000);
        let error = (2.0 * variance / 64.0).sqrt();
        println!("64 renders of 1 path: {mean:.6}, one of 64: {long:.6}, standard error {error:.6}");
        assert!((mean - long).abs() < 4.0 * error, "{mean} {long} {error}");
    }
}
