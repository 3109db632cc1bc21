//! Scenes of several volumes and lights of all kinds: against closed forms, and against other ways to say the same.

#![allow(clippy::print_stdout, reason = "the measured errors are worth reading")]

mod common;

use common::{any_camera, channel_of};
use glam::{DAffine3, DVec2, DVec3, IVec3, Vec3};
use nuage_render::camera::{Camera, Ray};
use nuage_render::light::{Light, Sky, Spot, Sun};
use nuage_render::march::unsupported;
use nuage_render::path::{PathSettings, PathTracer};
use nuage_render::sampler::Sampler;
use nuage_render::scene::{Emission, Phase, Scene, Shape, Spectrum, Volume};
use nuage_volume::channel::Channel;

const SIDE: u32 = 16;

/// The mean of what paths through all pixels bring, with its standard error per colour: light, and the share that passes.
fn means(scene: &Scene<'_>, settings: PathSettings, paths: u32) -> [(Vec3, Vec3); 2] {
    let tracer = PathTracer::new(scene, settings);
    let mut worker = tracer.worker();
    let mut sums = [[DVec3::ZERO; 2]; 2];
    let count = paths * SIDE * SIDE;
    for i in 0..count {
        let pixel = i / paths;
        let at = DVec2::new(f64::from(pixel % SIDE) + 0.5, f64::from(pixel / SIDE) + 0.5);
        let ray = scene.camera.ray(at, SIDE, SIDE);
        let sample = tracer.sample(&mut worker, &ray, Sampler::new(pixel, 0, i % paths, 0));
        for (sum, value) in sums.iter_mut().zip([sample.light(), Vec3::splat(f32::from(sample.passed))]) {
            let value = value.as_dvec3();
            sum[0] += value;
            sum[1] += value * value;
        }
    }
    sums.map(|[sum, squares]| {
        let mean = sum / f64::from(count);
        let variance = (squares / f64::from(count) - mean * mean).max(DVec3::ZERO);
        (mean.as_vec3(), (variance / f64::from(count)).map(f64::sqrt).as_vec3())
    })
}

/// That two scenes look alike: within four standard errors of both, and the errors are small.
fn same(what: &str, a: &Scene<'_>, b: &Scene<'_>, paths: u32) {
    let settings = PathSettings::default();
    let ([a, _], [b, _]) = (means(a, settings, paths), means(b, settings, paths));
    println!("{what}: {:.5} and {:.5}, standard errors {:.5} and {:.5}", a.0, b.0, a.1, b.1);
    let error = (a.1 * a.1 + b.1 * b.1).map(f32::sqrt);
    assert!((a.0 - b.0).abs().cmple(4.0 * error + 1e-6).all(), "{what}: {a:?} {b:?}");
    assert!((error / a.0.max(b.0)).max_element() < 0.05, "{what}: too noisy to tell: {a:?} {b:?}");
}

fn camera() -> Camera {
    Camera::look_at(DVec3::new(2.0, 1.0, 6.0), DVec3::ZERO, DVec3::Y, 24.0).expect("a view")
}

/// A lumpy ball within [−1, 1]³.
fn lumps() -> Channel {
    let scale = DAffine3::from_scale(DVec3::splat(1.0 / 16.0));
    channel_of(IVec3::splat(-16), IVec3::splat(16), scale, |i| {
        let p = i.as_dvec3() / 16.0;
        let lump = 0.6 + 0.4 * (p.x * 7.0).sin() * (p.y * 5.0).cos() * (p.z * 6.0).sin();
        (lump * (1.0 - p.length_squared()).max(0.0)) as f32
    })
}

fn ball(radius: f64, centre: DVec3) -> Shape<'static> {
    Shape::Ball {
        world_from_unit: DAffine3::from_translation(centre) * DAffine3::from_scale(DVec3::splat(radius)),
    }
}

fn cube(min: DVec3, max: DVec3) -> Shape<'static> {
    Shape::Box { world_from_unit: DAffine3::from_translation(min) * DAffine3::from_scale(max - min) }
}

fn medium(shape: Shape<'_>, extinction: [f32; 3], g: f32) -> Volume<'_> {
    let phase = Phase::HenyeyGreenstein { g };
    Volume { shape, coarse: None, extinction, albedo: [0.9, 0.6, 0.3], phase, emission: None }
}

fn sun() -> Light {
    Light::Sun(Sun::point(Vec3::new(0.6, 0.64, 0.48), [4.0, 3.0, 2.0]))
}

fn scene<'a>(volumes: Vec<Volume<'a>>, lights: Vec<Light>) -> Scene<'a> {
    Scene { camera: camera(), volumes, lights, sky: Sky::Constant([0.3, 0.4, 0.5]) }
}

#[test]
fn volumes_that_overlap_are_one_with_the_sum_of_their_extinctions() {
    let density = lumps();
    let grid = |extinction: f32| medium(Shape::Grid(&density), [extinction; 3], 0.4);
    let one = scene(vec![grid(8.0)], vec![sun()]);
    same("grids", &one, &scene(vec![grid(3.0), grid(5.0)], vec![sun()]), 60);
    same("many grids", &one, &scene(vec![grid(1.0); 8], vec![sun()]), 60);
    let solid = |extinction: f32| medium(ball(1.0, DVec3::ZERO), [extinction; 3], -0.2);
    let one = scene(vec![solid(3.0)], vec![sun()]);
    same("balls", &one, &scene(vec![solid(1.0), solid(2.0)], vec![sun()]), 60);
    // Two halves that touch are the whole.
    let [low, high] = [DVec3::NEG_ONE, DVec3::ONE];
    let part = |min: DVec3, max: DVec3| medium(cube(min, max), [1.5; 3], 0.5);
    let whole = scene(vec![part(low, high)], vec![sun()]);
    let (mut middle_low, mut middle_high) = (low, high);
    (middle_low.x, middle_high.x) = (0.2, 0.2);
    same("halves", &whole, &scene(vec![part(low, middle_high), part(middle_low, high)], vec![sun()]), 60);
}

#[test]
fn media_of_different_albedo_scatter_their_shares() {
    // Where they overlap, an absorbing and a scattering medium are one of the mean albedo.
    let with = |extinction: f32, albedo: f32| Volume {
        albedo: [albedo; 3],
        ..medium(ball(1.0, DVec3::ZERO), [extinction; 3], 0.3)
    };
    let two = scene(vec![with(1.0, 1.0), with(2.0, 0.25)], vec![sun()]);
    same("albedo", &scene(vec![with(3.0, 0.5)], vec![sun()]), &two, 60);
}

/// Each colour of a coloured medium is what a grey one of its extinction shows in that colour.
#[test]
fn colours_of_extinction_do_not_depend_on_each_other() {
    let density = lumps();
    let glow = lumps();
    for (name, shape, strength) in
        [("grid", Shape::Grid(&density), 4.0), ("ball", ball(1.0, DVec3::ZERO), 1.5)]
    {
        let coloured = [strength, 0.3 * strength, 0.0];
        let make = |extinction: [f32; 3]| {
            let spectrum = Spectrum::Linear { rgb: [0.5, 1.0, 2.0] };
            let emission = Some(Emission { channel: Some(&glow), spectrum });
            let other = medium(ball(0.5, DVec3::new(0.7, 0.0, 0.5)), [0.4; 3], 0.0);
            scene(vec![Volume { emission, ..medium(shape, extinction, 0.5) }, other], vec![sun()])
        };
        let settings = PathSettings::default();
        let [(mean, error), _] = means(&make(coloured), settings, 80);
        for i in 0..3 {
            let [(expected, expected_error), _] = means(&make([coloured[i]; 3]), settings, 40);
            let both = error[i].hypot(expected_error[i]);
            println!("{name} {i}: {} of {} ± {both}", mean[i], expected[i]);
            assert!((mean[i] - expected[i]).abs() < 4.0 * both, "{name} {i}: {} {}", mean[i], expected[i]);
            assert!(both < 0.03 * expected[i], "{name} {i}: too noisy to tell");
        }
    }
}

/// A slab lets through e^−τ of each colour, and what a glow in it sends out is (1 − e^−τ) / σ.
#[test]
fn a_slab_follows_the_closed_form() {
    let slab = cube(DVec3::new(-9.0, -9.0, -1.0), DVec3::new(9.0, 9.0, 1.0));
    let extinction = [0.2, 1.0, 2.5];
    let spectrum = Spectrum::Linear { rgb: [1.0; 3] };
    let emission = Some(Emission { channel: None, spectrum });
    let volume = Volume { albedo: [0.0; 3], emission, ..medium(slab, extinction, 0.0) };
    let mut scene = scene(vec![volume], Vec::new());
    scene.camera = any_camera();
    let tracer = PathTracer::new(&scene, PathSettings::default());
    let mut worker = tracer.worker();
    let ray = Ray { origin: DVec3::new(0.0, 0.0, 5.0), direction: DVec3::NEG_Z };
    let count = 100_000;
    let samples =
        (0..count).map(|seed| tracer.sample(&mut worker, &ray, Sampler::new(0, 0, seed, 0)).emission);
    let mean = samples.sum::<Vec3>() / count as f32;
    for (found, sigma) in mean.to_array().into_iter().zip(extinction) {
        let expected = (1.0 - f32::exp(-2.0 * sigma)) / sigma;
        assert!((found / expected - 1.0).abs() < 0.01, "σ {sigma}: {found} {expected}");
    }
}

#[test]
fn lights_of_one_kind_are_lights_of_another() {
    let density = lumps();
    for (g, paths) in [(0.0, 60), (0.6, 100)] {
        let lit = |light: Light| {
            let mut scene = scene(vec![medium(Shape::Grid(&density), [4.0; 3], g)], vec![light]);
            scene.sky = Sky::Constant([0.0; 3]);
            scene
        };
        // A narrow sun is a point.
        let to = Vec3::new(0.0, 0.6, -0.8);
        let sun = |angle_degrees| lit(Light::Sun(Sun { angle_degrees, ..Sun::point(to, [3.0; 3]) }));
        same("sun", &sun(0.0), &sun(0.3), paths);
        // A sphere far away is a sun.
        let (far, half) = (1e4, 15.0_f64.to_radians());
        let radiance = (3.0 / (std::f64::consts::PI * half.sin().powi(2))) as f32;
        let centre = to.as_dvec3() * far;
        same(
            "sphere",
            &sun(30.0),
            &lit(Light::Sphere { centre, radius: far * half.sin(), radiance: [radiance; 3] }),
            paths,
        );
        // A small sphere is a point of the same power, and so is a spot that shines everywhere.
        let (position, radius) = (DVec3::new(0.5, 2.0, -2.5), 0.01);
        let power = 4.0 * std::f64::consts::PI.powi(2) * radius * radius * 1e5;
        let intensity = [(power / (4.0 * std::f64::consts::PI)) as f32; 3];
        let point = lit(Light::Point { position, intensity });
        same(
            "small sphere",
            &point,
            &lit(Light::Sphere { centre: position, radius, radiance: [1e5; 3] }),
            paths,
        );
        let direction = Vec3::X;
        let everywhere =
            Light::Spot(Spot { position, direction, intensity, inner_degrees: 180.0, outer_degrees: 180.0 });
        same("spot", &point, &lit(everywhere), paths);
    }
}

/// Two suns of half the sky each are a sky: what the lights' own directions, the phase function's and their combination
/// bring adds up to all there is, whichever is narrower.
#[test]
fn suns_as_large_as_the_sky_make_a_furnace() {
    for g in [0.0, -0.6, 0.95] {
        let angle_degrees = 179.9;
        let irradiance = [(std::f64::consts::PI * (89.95_f64).to_radians().sin().powi(2)) as f32; 3];
        let half = |direction_to| Light::Sun(Sun { direction_to, irradiance, angle_degrees });
        let volume = Volume { albedo: [1.0; 3], ..medium(ball(1.0, DVec3::ZERO), [2.0, 4.0, 1.0], g) };
        let mut scene = scene(vec![volume], vec![half(Vec3::Y), half(Vec3::NEG_Y)]);
        scene.sky = Sky::Constant([0.0; 3]);
        scene.camera = Camera::look_at(DVec3::ZERO, DVec3::Z, DVec3::Y, 40.0).expect("a view");
        let [(light, error), (passes, _)] = means(&scene, PathSettings::default(), 500);
        println!("g {g}: {light} ± {error}, {passes} passes");
        // The light of a colour that does not scatter is not there: what passes depends on the colour.
        let expected = Vec3::ONE - Vec3::new(-2.0, -4.0, -1.0).map(f32::exp);
        assert!(((light - expected) / expected).abs().max_element() < 0.02, "g {g}: {light} of {expected}");
    }
}

#[test]
fn a_gradient_of_one_colour_is_an_even_sky() {
    let density = lumps();
    let even = scene(vec![medium(Shape::Grid(&density), [4.0; 3], 0.5)], Vec::new());
    let mut gradient = even.clone();
    let colour = [0.3, 0.4, 0.5];
    gradient.sky = Sky::Gradient { up: Vec3::Y, zenith: colour, horizon: colour, ground: colour };
    same("sky", &even, &gradient, 60);
    // Seen by rays of their own or by paths that leave: the same.
    gradient.sky = Sky::Gradient { up: Vec3::Y, zenith: [1.0; 3], horizon: [0.5; 3], ground: [0.1; 3] };
    let blind = PathSettings { sky_rays: false, ..PathSettings::default() };
    let [[a, _], [b, _]] = [PathSettings::default(), blind].map(|settings| means(&gradient, settings, 60));
    let error = (a.1 * a.1 + b.1 * b.1).map(f32::sqrt);
    assert!((a.0 - b.0).abs().cmple(4.0 * error).all(), "{a:?} {b:?}");
}

#[test]
fn the_marcher_says_what_it_cannot_follow() {
    let density = lumps();
    let plain = scene(vec![medium(Shape::Grid(&density), [4.0; 3], 0.0)], vec![sun()]);
    assert_eq!(unsupported(&plain), None);
    let with = |change: &dyn Fn(&mut Scene<'_>)| {
        let mut scene = plain.clone();
        change(&mut scene);
        unsupported(&scene).is_some()
    };
    assert!(with(&|scene| scene.volumes.clear()));
    assert!(with(&|scene| scene.volumes.extend(scene.volumes.clone())));
    assert!(with(&|scene| scene.volumes[0].shape = ball(1.0, DVec3::ZERO)));
    assert!(with(&|scene| scene.volumes[0].extinction[1] = 1.0));
    assert!(with(&|scene| scene.lights.push(sun())));
    assert!(with(&|scene| scene.lights = vec![Light::Point { position: DVec3::ONE, intensity: [1.0; 3] }]));
    assert!(with(
        &|scene| scene.lights = vec![Light::Sun(Sun { angle_degrees: 1.0, ..Sun::point(Vec3::Y, [1.0; 3]) })]
    ));
    let black = [0.0; 3];
    assert!(with(
        &|scene| scene.sky = Sky::Gradient { up: Vec3::Y, zenith: black, horizon: black, ground: black }
    ));
}

/// Nothing that a scene can say makes a number that is none, or a loop without end.
#[test]
fn extremes_stay_finite() {
    let density = lumps();
    for extinction in [[1e-30; 3], [1e35; 3], [f32::MAX, 0.0, 1.0], [0.0; 3]] {
        for shape in
            [Shape::Grid(&density), ball(1.0, DVec3::ZERO), cube(DVec3::NEG_ONE, DVec3::splat(1e-12))]
        {
            for g in [-1.0, 1.0] {
                let lights = vec![
                    sun(),
                    Light::Sun(Sun { angle_degrees: 1e-6, ..Sun::point(Vec3::Y, [1.0; 3]) }),
                    Light::Point { position: DVec3::ZERO, intensity: [1.0; 3] },
                    Light::Sphere { centre: DVec3::ONE, radius: 0.5, radiance: [1.0; 3] },
                ];
                let both =
                    vec![medium(shape, extinction, g), medium(ball(0.5, DVec3::ZERO), [1.0, 0.0, 0.5], g)];
                let [(light, _), (passes, _)] = means(&scene(both, lights), PathSettings::default(), 1);
                assert!(
                    light.is_finite() && passes.is_finite() && light.min_element() >= 0.0,
                    "{extinction:?}"
                );
            }
        }
    }
}
