//! Coarser levels for shadow rays and scattered light: what they change of a picture, held to what the documentation says.

#![allow(clippy::print_stdout, reason = "the measured errors are worth reading")]

mod common;

use common::channel_of;
use glam::{DAffine3, DVec3, IVec3};
use nuage_render::camera::Camera;
use nuage_render::film::{Film, Image, Tally};
use nuage_render::light::Sun;
use nuage_render::lod::coarser_by;
use nuage_render::march::Quality;
use nuage_render::picture;
use nuage_render::progressive::{Plan, Watch, trace};
use nuage_render::scene::{Phase, Scene, Shape, Volume};
use nuage_volume::channel::Channel;

/// Pixels per side of pictures, and of the blocks over which noise is averaged.
const SIDE: u32 = 40;
const BLOCK: u32 = 8;

/// A ball with lumps of eight voxels and finer ones, about 64 voxels wide.
fn cloud() -> Channel {
    let scale = DAffine3::from_scale(DVec3::splat(1.0 / 32.0));
    channel_of(IVec3::splat(-32), IVec3::splat(32), scale, |i| {
        let p = i.as_dvec3() / 32.0;
        let lumps = |f: f64| (p.x * f).sin() * (p.y * f * 0.9 + 1.0).cos() * (p.z * f * 1.1 + 2.0).sin();
        let edge = 1.0 - p.length() + 0.25 * lumps(12.0) + 0.12 * lumps(29.0) + 0.06 * lumps(61.0);
        (4.0 * edge).clamp(0.0, 1.0) as f32
    })
}

fn scene<'a>(density: &'a Channel, coarse: Option<&'a Channel>, g: f32) -> Scene<'a> {
    let camera = Camera::look_at(DVec3::new(2.0, 1.0, 5.0), DVec3::ZERO, DVec3::Y, 24.0).expect("a view");
    let volume = Volume {
        coarse,
        albedo: [0.98; 3],
        phase: Phase::HenyeyGreenstein { g },
        ..Volume::absorbing(Shape::Grid(density), 8.0)
    };
    let sun = Sun::point(DVec3::new(-0.6, 0.7, 0.3).normalize().as_vec3(), [6.0; 3]);
    Scene::of_one(camera, volume, Some(sun), [0.3; 3])
}

/// The errors of a picture's mean and of its blocks, root mean square over the mean.
fn errors(picture: &Image, expected: &Image) -> [f64; 2] {
    let blocks = |image: &Image| -> Vec<f64> {
        let mut sums = vec![0.0; (SIDE / BLOCK * (SIDE / BLOCK)) as usize];
        for (i, pixel) in (0..).zip(&image.pixels) {
            sums[(i / SIDE / BLOCK * (SIDE / BLOCK) + i % SIDE / BLOCK) as usize] += f64::from(pixel[1]);
        }
        sums
    };
    let (found, expected) = (blocks(picture), blocks(expected));
    let [sum, whole] = [&found, &expected].map(|blocks| blocks.iter().sum::<f64>());
    let squares: f64 = found.iter().zip(&expected).map(|(a, b)| (a - b).powi(2)).sum();
    let count = expected.len() as f64;
    [sum / whole - 1.0, (squares / count).sqrt() / (whole / count)]
}

/// Light that is scattered once: without noise, so that the error is that of the levels alone.
#[test]
fn shadows_of_coarser_levels_are_a_little_darker() {
    let density = cloud();
    let levels = [1, 2].map(|n| coarser_by(&density, n).expect("few tiles").expect("a coarser level"));
    let quality = Quality { shadow_step_voxels: 0.0, samples: 4, ..Quality::default() };
    let marched = |coarse| {
        picture::render(&scene(&density, coarse, 0.3), quality, SIDE, SIDE, &|_, _| {}).expect("a picture")
    };
    let expected = marched(None);
    for (level, most_mean, most_rms) in [(1, 0.02, 0.025), (2, 0.06, 0.07)] {
        let [mean, rms] = errors(&marched(Some(&levels[level - 1])), &expected);
        println!("marched, level {level}: mean {:+.2} %, RMS {:.2} %", 100.0 * mean, 100.0 * rms);
        assert!(mean.abs() < most_mean && rms < most_rms, "level {level}: {mean} {rms}");
        assert!(rms > 1e-4, "the level is read");
    }
}

/// Light that is scattered any number of times.
#[test]
fn paths_through_coarser_levels_stay_within_the_stated_error() {
    let density = cloud();
    let levels = [1, 2].map(|n| coarser_by(&density, n).expect("few tiles").expect("a coarser level"));
    let traced = |coarse, seed| {
        let mut film = Film::new(SIDE, SIDE).expect("a picture");
        let plan = Plan { samples: 400, pass_samples: 400, seed, ..Plan::default() };
        trace(&scene(&density, coarse, 0.8), &plan, &mut film, &mut Watch::default());
        let variance: f64 = film.map(Tally::standard_error).iter().map(|e| f64::from(e[1]).powi(2)).sum();
        (film.image(), variance)
    };
    let (expected, variance) = traced(None, 1);
    let sum: f64 = expected.pixels.iter().map(|pixel| f64::from(pixel[1])).sum();
    let blocks = f64::from(SIDE / BLOCK).powi(2);
    for (level, most_mean, most_rms) in [(1, 0.005, 0.01), (2, 0.01, 0.015)] {
        let (picture, other) = traced(Some(&levels[level - 1]), 2);
        let [mean, rms] = errors(&picture, &expected);
        // Of the whole, and of one block in its mean square.
        let noise = (variance + other).sqrt() / sum;
        let block_noise = noise * blocks.sqrt();
        println!(
            "paths, level {level}: mean {:+.2} ± {:.2} %, RMS {:.2} % with noise of {:.2} %",
            100.0 * mean,
            100.0 * noise,
            100.0 * rms,
            100.0 * block_noise
        );
        assert!(mean.abs() < most_mean + 3.0 * noise && noise < 0.005, "level {level}: {mean} {noise}");
        assert!(
            rms < most_rms + 2.0 * block_noise && block_noise < 0.025,
            "level {level}: {rms} {block_noise}"
        );
    }
}
