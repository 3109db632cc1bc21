//! Filters in the renderers: what they may not change, and that their stochastic forms are they in the mean.

#![allow(clippy::print_stdout, reason = "the measured errors are worth reading")]

mod common;

use common::{absorbing, boxed, channel_of};
use glam::{DAffine3, DVec2, DVec3, IVec3, Vec3};
use nuage_render::camera::{Camera, Ray};
use nuage_render::filter::{self, Lookup};
use nuage_render::hash::{hash_u32, unit_f32};
use nuage_render::light::{Light, Sky, Sun};
use nuage_render::march::{Marcher, Quality};
use nuage_render::path::{PathSettings, PathTracer};
use nuage_render::sampler::Sampler;
use nuage_render::scene::{Phase, Scene, Shape, Volume};
use nuage_volume::channel::Channel;

const ALL: [Lookup; 5] = [
    Lookup::Nearest,
    Lookup::Trilinear,
    Lookup::Tricubic,
    Lookup::StochasticTrilinear,
    Lookup::StochasticTricubic,
];

fn random(seed: u32) -> f32 {
    unit_f32(hash_u32(seed))
}

fn noise(voxel: IVec3) -> f32 {
    let seed = (voxel.x as u32).wrapping_mul(7919) ^ (voxel.y as u32).wrapping_mul(104_729) ^ voxel.z as u32;
    random(seed)
}

/// Voxels without any order, a few of them many times as dense, in bricks whose neighbours are far less so.
fn rough() -> Channel {
    channel_of(IVec3::new(-9, -3, -7), IVec3::new(12, 11, 14), DAffine3::IDENTITY, rough_voxel)
}

fn rough_voxel(voxel: IVec3) -> f32 {
    let value = noise(voxel);
    if value > 0.98 { 40.0 * value } else { 0.5 * value * value }
}

/// A ray that crosses the rough channel, and its ends.
fn crossing(seed: u32) -> Ray {
    let point = |seed: u32| {
        let [x, y, z] = [1, 2, 3].map(|i| f64::from(random(8 * seed + i)));
        DVec3::new(-9.0, -3.0, -7.0) + DVec3::new(x, y, z) * DVec3::new(21.0, 14.0, 21.0)
    };
    let [a, b] = [point(2 * seed), point(2 * seed + 1)];
    let direction = (b - a).normalize();
    Ray { origin: a - direction * 60.0, direction }
}

/// The integral of a filter along a ray by short steps, in values × length.
fn integral(ray: &Ray, lookup: Lookup) -> f64 {
    const STEP: f64 = 1.0 / 64.0;
    let (min, max) = (IVec3::new(-9, -3, -7), IVec3::new(12, 11, 14));
    let inside = |v: IVec3| v.cmpge(min).all() && v.cmple(max).all();
    let voxel = |v: IVec3| if inside(v) { rough_voxel(v) } else { 0.0 };
    let value = |p: Vec3| match lookup.mean() {
        Lookup::Nearest => filter::nearest(p, voxel),
        Lookup::Trilinear => filter::trilinear(p, voxel),
        _ => filter::tricubic(p, voxel),
    };
    let steps = (0..(120.0 / STEP) as u32).map(|i| ray.origin + ray.direction * (f64::from(i) + 0.5) * STEP);
    // Only where there is something.
    let near = |p: &DVec3| p.cmpge(min.as_dvec3() - 3.0).all() && p.cmple(max.as_dvec3() + 3.0).all();
    steps.filter(near).map(|p| f64::from(value(p.as_vec3())) * STEP).sum()
}

fn share_that_passes(scene: &Scene<'_>, lookup: Lookup, ray: &Ray, paths: u32) -> f64 {
    let tracer = PathTracer::new(scene, PathSettings { lookup, ..PathSettings::default() });
    let mut worker = tracer.worker();
    let passed =
        (0..paths).filter(|i| tracer.sample(&mut worker, ray, Sampler::new(0, 0, *i, 0)).passed).count();
    passed as f64 / f64::from(paths)
}

/// Delta tracking is right only where no value is above its majorant: dense voxels beside empty bricks would show it, above all
/// with the spline, which reaches into bricks that no other filter reads.
#[test]
fn paths_pass_as_often_as_the_integral_of_their_filter_says() {
    const PATHS: u32 = 4000;
    let density = rough();
    let scene = absorbing(common::any_camera(), &density, 0.1);
    for lookup in ALL {
        let mut squares = 0.0;
        for seed in 0..24 {
            let ray = crossing(seed);
            let expected = (-0.1 * integral(&ray, lookup)).exp();
            let found = share_that_passes(&scene, lookup, &ray, PATHS);
            let error = (expected * (1.0 - expected) / f64::from(PATHS)).sqrt();
            let apart = (found - expected) / error.max(1e-3);
            assert!(apart.abs() < 4.5, "{lookup:?}, ray {seed}: {found} instead of {expected}");
            squares += apart * apart;
        }
        println!("{lookup:?}: {:.2} of {}", squares, 24);
        assert!(squares < 50.0, "{lookup:?}: chi-square {squares} of 24 rays");
    }
}

/// A lone voxel in a brick's corner is seen by the spline from all eight bricks around, of which seven are empty.
#[test]
fn the_spline_sees_a_voxel_from_all_bricks_around_it() {
    for at in [[0, 0, 0], [7, 7, 7], [0, 7, 0], [7, 0, 4], [4, 4, 4]].map(IVec3::from_array) {
        let one = channel_of(at, at, DAffine3::IDENTITY, |_| 30.0);
        let scene = absorbing(common::any_camera(), &one, 1.0);
        let marcher = Marcher::new(&scene, Quality { lookup: Lookup::Tricubic, ..Quality::default() });
        let mut worker = marcher.worker();
        for offset in boxed(IVec3::splat(-2), IVec3::splat(1)) {
            let through = at.as_dvec3() + offset.as_dvec3() + DVec3::new(0.45, 0.55, 0.5);
            let ray = Ray { origin: through - 20.0 * DVec3::Z, direction: DVec3::Z };
            // Of the spline, whose integral along an axis is 1, the weights along the other two axes are left.
            let weight = |x: f64| match x.abs() {
                x if x < 1.0 => 2.0 / 3.0 - x * x * (1.0 - 0.5 * x),
                x => (2.0 - x).max(0.0).powi(3) / 6.0,
            };
            let across = through - at.as_dvec3();
            let expected = 30.0 * weight(across.x) * weight(across.y);
            let depth = f64::from(marcher.depth_per_scale(&mut worker, &ray));
            assert!((depth - expected).abs() < 0.02 * expected + 1e-3, "{at} {offset}: {depth}, {expected}");
            let passes = share_that_passes(&scene, Lookup::Tricubic, &ray, 150);
            let error = ((-expected).exp() * (1.0 - (-expected).exp()) / 150.0).sqrt().max(4e-3);
            assert!((passes - (-expected).exp()).abs() < 5.0 * error, "{at} {offset}: {passes}, {expected}");
        }
    }
}

fn lit(density: &Channel, albedo: f32) -> Scene<'_> {
    let camera = Camera::look_at(DVec3::new(1.0, 40.0, 60.0), DVec3::new(1.5, 4.0, 3.5), DVec3::Y, 24.0);
    let volume = Volume {
        albedo: [albedo; 3],
        phase: Phase::HenyeyGreenstein { g: 0.3 },
        ..Volume::absorbing(Shape::Grid(density), 0.08)
    };
    let sun = Sun::point(DVec3::new(0.5, 0.7, -0.5).normalize().as_vec3(), [6.0; 3]);
    Scene {
        camera: camera.expect("a view"),
        volumes: vec![volume],
        lights: vec![Light::Sun(sun)],
        sky: Sky::Constant([0.3; 3]),
    }
}

const SIDE: u32 = 12;

fn rays(scene: &Scene<'_>) -> Vec<Ray> {
    let at = |i: u32| DVec2::new(f64::from(i % SIDE) + 0.5, f64::from(i / SIDE) + 0.5);
    (0..SIDE * SIDE).map(|i| scene.camera.ray(at(i), SIDE, SIDE)).collect()
}

/// The mean light of paths through all pixels, and its standard error.
fn traced(scene: &Scene<'_>, lookup: Lookup, paths: u32) -> [f64; 2] {
    let tracer = PathTracer::new(scene, PathSettings { lookup, ..PathSettings::default() });
    let mut worker = tracer.worker();
    let (mut sum, mut squares, mut count) = (0.0, 0.0, 0.0);
    for (pixel, ray) in (0..).zip(rays(scene)) {
        for i in 0..paths {
            let numbers = Sampler::new(pixel, 0, i, lookup as u32);
            let light = f64::from(tracer.sample(&mut worker, &ray, numbers).light().y);
            (sum, squares, count) = (sum + light, squares + light * light, count + 1.0);
        }
    }
    let mean = sum / count;
    [mean, ((squares / count - mean * mean) / count).sqrt()]
}

#[test]
fn a_voxel_at_random_makes_the_same_picture_as_its_filter() {
    let density = rough();
    let scene = lit(&density, 0.9);
    let means = ALL.map(|lookup| traced(&scene, lookup, 200));
    println!("{means:.5?}");
    for (exact, stochastic) in [(1, 3), (2, 4)] {
        let [[a, ea], [b, eb]] = [means[exact], means[stochastic]];
        assert!((a - b).abs() < 4.0 * ea.hypot(eb), "{:?}: {a} {b}", ALL[exact]);
        assert!(ea.hypot(eb) < 0.025 * a, "too noisy to tell");
    }
    // Filters do differ here, so that a mistaken one would show.
    assert!((means[0][0] - means[2][0]).abs() > 4.0 * means[0][1].hypot(means[2][1]));
}

/// Marched in short steps, a voxel at random is the filter in the mean too; in long ones it lets more light pass.
#[test]
fn marching_at_random_comes_to_the_filter_as_steps_become_short() {
    let density = channel_of(IVec3::new(-9, -3, -7), IVec3::new(12, 11, 14), DAffine3::IDENTITY, noise);
    let scene = absorbing(lit(&density, 0.0).camera, &density, 0.3);
    const SEEDS: u32 = 10;
    let mean = |lookup, step_voxels: f32| {
        let quality = Quality {
            lookup,
            step_voxels,
            shadow_step_voxels: step_voxels,
            shadow_growth: 0.0,
            ..Quality::default()
        };
        let marcher = Marcher::new(&scene, quality);
        let mut worker = marcher.worker();
        let rays: Vec<Ray> = (0..SEEDS).flat_map(|_| rays(&scene)).collect();
        let light = (0..).zip(&rays).map(|(i, ray)| marcher.radiance(&mut worker, ray, hash_u32(i)));
        light.map(|light| f64::from(1.0 - light.transmittance)).sum::<f64>() / rays.len() as f64
    };
    for (exact, stochastic) in [(1, 3), (2, 4)] {
        let [coarse, fine] =
            [1.0, 0.05].map(|step| mean(ALL[stochastic], step) / mean(ALL[exact], 0.05) - 1.0);
        println!(
            "{:?}: {:+.2} % at steps of a voxel, {:+.2} % at a twentieth",
            ALL[stochastic],
            coarse * 100.0,
            fine * 100.0
        );
        assert!(fine.abs() < 0.0015 && coarse < -0.002, "{coarse} {fine}");
    }
}

/// What is the same everywhere is so through any filter.
#[test]
fn an_even_field_stays_even() {
    let even = channel_of(IVec3::splat(-20), IVec3::splat(20), DAffine3::IDENTITY, |_| 0.75);
    let scene = absorbing(common::any_camera(), &even, 0.05);
    let mut depths = Vec::new();
    for lookup in ALL {
        let marcher = Marcher::new(&scene, Quality { lookup, step_voxels: 0.25, ..Quality::default() });
        let mut worker = marcher.worker();
        let ray = Ray { origin: DVec3::new(0.3, -0.4, 50.0), direction: DVec3::NEG_Z };
        depths.push(marcher.depth_per_scale(&mut worker, &ray));
        let passes = share_that_passes(&scene, lookup, &ray, 20_000);
        let expected = f64::exp(-0.05 * 0.75 * 41.0);
        assert!((passes - expected).abs() < 4.0 * (expected / 20_000.0).sqrt(), "{lookup:?}: {passes}");
    }
    // 41 voxels, whatever their edges look like.
    assert!(depths.iter().all(|depth| (depth / 30.75 - 1.0).abs() < 2e-3), "{depths:?}");
}

/// Steps of shadow rays let too much light pass; without them it is what a great many would find.
#[test]
fn shadow_rays_without_steps_are_the_limit_of_short_ones() {
    let density = rough();
    let mut scene = lit(&density, 0.9);
    scene.sky = Sky::Constant([0.0; 3]);
    let mean = |shadow_step_voxels: f32| {
        let quality = Quality {
            shadow_step_voxels,
            shadow_growth: 0.0,
            min_transmittance: 1e-6,
            sun_rays: 64,
            ..Quality::default()
        };
        let marcher = Marcher::new(&scene, quality);
        let mut worker = marcher.worker();
        let light = (0..).zip(rays(&scene)).map(|(i, ray)| marcher.radiance(&mut worker, &ray, hash_u32(i)));
        light.map(|light| f64::from(light.scattered.y)).sum::<f64>()
    };
    let exact = mean(0.0);
    let [coarse, fine] = [2.0, 0.05].map(|step| mean(step) / exact - 1.0);
    println!(
        "shadows {:+.2} % at steps of two voxels, {:+.3} % at a twentieth",
        coarse * 100.0,
        fine * 100.0
    );
    assert!(coarse > 0.02 && fine.abs() < 2e-3, "{coarse} {fine}");
}
