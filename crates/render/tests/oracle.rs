//! The ray marcher against reference solutions: line integrals by quadrature in double precision, and single
//! scattering by another renderer. Numbers are printed with `--nocapture`.

#![allow(clippy::print_stdout, reason = "the measured errors are worth reading")]

mod common;
mod reference;

use std::f64::consts::PI;
use std::time::Instant;

use common::{Dense, absorbing};
use glam::{DVec2, DVec3, Vec3};
use nuage_render::camera::{Camera, Ray};
use nuage_render::light::{Light, Sky, Sun};
use nuage_render::march::{Marcher, Quality};
use nuage_render::picture::render;
use nuage_render::scene::{Emission, Spectrum};
use nuage_testkit::npy::{read_f32, read_raw_f64};
use reference::{SIZE, camera, channel, json, lit_scene, numbers, path};

const STEPS: [f32; 5] = [4.0, 2.0, 1.0, 0.5, 0.25];
/// What single precision and the end of rays at a transmittance of 1e-4 leave of the errors at any step.
const FLOOR: f64 = 2e-5;

fn pixel_centres(camera: &Camera) -> impl Iterator<Item = Ray> {
    let centre = |i| DVec2::new(f64::from(i % SIZE) + 0.5, f64::from(i / SIZE) + 0.5);
    (0..SIZE * SIZE).map(move |i| camera.ray(centre(i), SIZE, SIZE))
}

/// Largest, mean and root mean square difference.
#[derive(Debug, Clone, Copy)]
struct Errors {
    max: f64,
    mean: f64,
    rms: f64,
}

impl Errors {
    fn of(values: &[f64], reference: &[f64]) -> Self {
        assert_eq!(values.len(), reference.len());
        let differences: Vec<f64> = values.iter().zip(reference).map(|(a, b)| (a - b).abs()).collect();
        let n = differences.len() as f64;
        Errors {
            max: differences.iter().copied().fold(0.0, f64::max),
            mean: differences.iter().sum::<f64>() / n,
            rms: (differences.iter().map(|d| d * d).sum::<f64>() / n).sqrt(),
        }
    }

    /// As shares of a value.
    fn over(self, whole: f64) -> Self {
        Errors { max: self.max / whole, mean: self.mean / whole, rms: self.rms / whole }
    }
}

/// Prints the errors at all steps, and asserts that those of the default step are small and that halving the
/// step quarters them.
fn assert_second_order(what: &str, errors: &[Errors; STEPS.len()], limit_max: f64, limit_mean: f64) {
    println!("{what}: step in voxels, max, mean, RMS error, ratio to the step before");
    let mut last: Option<f64> = None;
    for (step, e) in STEPS.iter().zip(errors) {
        let ratio = last.map_or(f64::NAN, |last| last / e.rms);
        println!("  {step:5} {:10.2e} {:10.2e} {:10.2e} {ratio:6.2}", e.max, e.mean, e.rms);
        last = Some(e.rms);
        if *step == Quality::default().step_voxels {
            assert!(e.max < limit_max && e.mean < limit_mean, "{what} at the default step: {e:?}");
        }
    }
    for pair in errors.windows(2).filter(|pair| pair[1].rms > FLOOR) {
        let ratio = pair[0].rms / pair[1].rms;
        assert!(ratio > 3.0, "{what}: halving the step divides the error by {ratio} only");
    }
    let (coarse, fine) = (errors[0].rms, errors[STEPS.len() - 1].rms);
    assert!(coarse / fine > 60.0 || fine < FLOOR, "{what}: {coarse} falls to {fine} only");
}

#[test]
fn optical_depth_follows_the_quadrature() {
    let (camera, density) = (camera(&json()), channel("density"));
    let dense = Dense::new(&density);
    let exact: Vec<f64> = pixel_centres(&camera).map(|ray| 8.0 * dense.line_integral(&ray)).collect();
    let stored = read_raw_f64(&path("tau_center.f64"));
    let largest = stored.iter().copied().fold(0.0, f64::max);
    let between = Errors::of(&exact, &stored);
    println!("optical depth up to {largest:.3}; the reference file against exact integration: {between:?}");
    assert!(between.max < 5e-5, "{between:?}");

    let scene = absorbing(camera, &density, 8.0);
    let errors = STEPS.map(|step_voxels| {
        let marcher = Marcher::new(&scene, Quality { step_voxels, ..Quality::default() });
        let mut worker = marcher.worker();
        let depths: Vec<f64> = pixel_centres(&camera)
            .map(|ray| 8.0 * f64::from(marcher.depth_per_scale(&mut worker, &ray)))
            .collect();
        Errors::of(&depths, &exact).over(largest)
    });
    assert_second_order("optical depth as a share of the largest", &errors, 1e-3, 1e-3);
}

#[test]
fn transmittance_follows_the_quadrature() {
    let (camera, density) = (camera(&json()), channel("density"));
    let scene = absorbing(camera, &density, 8.0);
    let reference = read_raw_f64(&path("trans_center.f64"));
    let errors = STEPS.map(|step_voxels| {
        let quality = Quality { step_voxels, samples: 1, ..Quality::default() };
        let image = render(&scene, quality, SIZE, SIZE, &|_, _| {}).expect("a picture");
        assert!(image.pixels.iter().all(|p| p[..3] == [0.0; 3]));
        let through: Vec<f64> = image.pixels.iter().map(|p| 1.0 - f64::from(p[3])).collect();
        Errors::of(&through, &reference)
    });
    assert_second_order("transmittance", &errors, 1e-3, 1e-3);
}

#[test]
fn emission_follows_the_quadrature() {
    let (camera, density, emission) = (camera(&json()), channel("density"), channel("emission"));
    let mut scene = absorbing(camera, &density, 1.5);
    scene.volumes[0].emission =
        Some(Emission { channel: Some(&emission), spectrum: Spectrum::Linear { rgb: [1.0, 2.0, 0.25] } });
    let reference = read_raw_f64(&path("emit_center.f64"));
    let largest = reference.iter().copied().fold(0.0, f64::max);
    let mean = reference.iter().sum::<f64>() / reference.len() as f64;
    let images = STEPS.map(|step_voxels| {
        let quality = Quality { step_voxels, samples: 1, ..Quality::default() };
        render(&scene, quality, SIZE, SIZE, &|_, _| {}).expect("a picture")
    });
    let red = |pixels: &[[f32; 4]]| -> Vec<f64> { pixels.iter().map(|p| p[0].into()).collect() };
    let errors = images.each_ref().map(|image| Errors::of(&red(&image.pixels), &reference).over(largest));
    assert_second_order("emission as a share of the largest", &errors, 1e-3, 1e-3);
    for image in &images {
        for [r, g, b, _] in &image.pixels {
            assert!((g - 2.0 * r).abs() <= 1e-6 * g && (b - 0.25 * r).abs() <= 1e-6 * r);
        }
    }
    let default = red(&images[3].pixels).iter().sum::<f64>() / reference.len() as f64;
    println!("mean emission {default:.6} instead of {mean:.6}");
    assert!((default / mean - 1.0).abs() < 1e-3);
}

/// The scene of the oracle with sun and sky.
#[test]
fn single_scattering_follows_another_renderer() {
    let (json, density) = (json(), channel("density"));
    let scene = lit_scene(&json, &density, 0.0);
    let sky = scene.sky.radiance(Vec3::Y).to_array();
    let reference: Vec<f64> = read_f32(&path("het64_g0_ss_mean.npy")).into_iter().map(f64::from).collect();
    let stderr: Vec<f64> = read_f32(&path("het64_g0_ss_stderr.npy")).into_iter().map(f64::from).collect();
    let mean_of = |values: &[f64], channel: usize| {
        values.iter().skip(channel).step_by(3).sum::<f64>() / f64::from(SIZE * SIZE)
    };
    let blocks = |values: &[f64], f: &dyn Fn(f64) -> f64| -> Vec<f64> {
        let mut sums = vec![0.0; (SIZE / 8 * (SIZE / 8) * 3) as usize];
        for (i, value) in values.iter().enumerate() {
            let (pixel, channel) = (i as u32 / 3, i as u32 % 3);
            let block = pixel / SIZE / 8 * (SIZE / 8) + pixel % SIZE / 8;
            sums[(block * 3 + channel) as usize] += f(*value);
        }
        sums
    };
    let expected: Vec<f64> = blocks(&reference, &|v| v / 64.0);
    let block_stderr: Vec<f64> = blocks(&stderr, &|v| v * v).into_iter().map(|v| v.sqrt() / 64.0).collect();

    // The second with so many samples that what remains of noise is small.
    let fine = Quality { samples: 8, ..Quality::default() };
    for (quality, limit_mean, limit_rms) in [(Quality::default(), 0.01, 0.01), (fine, 0.002, 0.005)] {
        let begin = Instant::now();
        let image = render(&scene, quality, SIZE, SIZE, &|_, _| {}).expect("a picture").over(sky);
        println!("single scattering at {quality:?}: {:.2} s", begin.elapsed().as_secs_f64());
        let values: Vec<f64> = image.pixels.iter().flat_map(|p| [p[0], p[1], p[2]]).map(f64::from).collect();
        for channel in 0..3 {
            let (ours, theirs) = (mean_of(&values, channel), mean_of(&reference, channel));
            println!("  mean {ours:.5} instead of {theirs:.5}: {:+.3} %", 100.0 * (ours / theirs - 1.0));
            assert!((ours / theirs - 1.0).abs() < limit_mean);
        }
        let ours = blocks(&values, &|v| v / 64.0);
        let relative: Vec<f64> = ours.iter().zip(&expected).map(|(a, b)| a / b - 1.0).collect();
        let good = |((r, e), s): &((&f64, &f64), &f64)| r.abs() < 0.03 || r.abs() * **e < 3.0 * **s;
        let count = relative.iter().zip(&expected).zip(&block_stderr).filter(good).count();
        let share = count as f64 / relative.len() as f64;
        let rms = (relative.iter().map(|r| r * r).sum::<f64>() / relative.len() as f64).sqrt();
        let worst = relative.iter().fold(0.0f64, |worst, r| worst.max(r.abs()));
        let percent = [rms, worst, share].map(|v| 100.0 * v);
        println!(
            "  8×8 blocks in %: RMS error {:.3}, worst {:.3}, good {:.2}",
            percent[0], percent[1], percent[2]
        );
        assert!(share >= 0.99 && rms < limit_rms, "{share} of the blocks are good, RMS error {rms}");
    }
}

/// Single scattering along a ray by quadrature in double precision: the light of the sun and that of a sky of
/// radiance 1, both with albedo and irradiance 1.
fn brute_force(dense: &Dense, ray: &Ray, sigma: f64, g: f64, to_sun: DVec3) -> [f64; 2] {
    const DIRECTIONS: u32 = 2000;
    let phase = |cos: f64| (1.0 - g * g) / (4.0 * PI * (1.0 + g * g - 2.0 * g * cos).powf(1.5));
    // Optical depth by steps of half a voxel.
    let depth = |from: DVec3, direction: DVec3| {
        let Some([t0, t1]) = dense.interval(&Ray { origin: from, direction }) else { return 0.0 };
        let steps = ((t1 - t0) * 64.0).ceil();
        let at = |i: u32| dense.at(from + direction * (t0 + (t1 - t0) * (f64::from(i) + 0.5) / steps));
        sigma * (t1 - t0) / steps * (0..steps as u32).map(at).sum::<f64>()
    };
    // A Fibonacci lattice on the sphere.
    let golden = PI * (3.0 - 5.0f64.sqrt());
    let directions: Vec<(DVec3, f64)> = (0..DIRECTIONS)
        .map(|i| {
            let z = 1.0 - (2.0 * f64::from(i) + 1.0) / f64::from(DIRECTIONS);
            let (sin, cos) = (golden * f64::from(i)).sin_cos();
            let across = (1.0 - z * z).sqrt();
            let to_sky = DVec3::new(across * cos, across * sin, z);
            // The light travels along −to_sky, then along −ray.direction.
            (to_sky, phase(to_sky.dot(ray.direction)))
        })
        .collect();
    let norm: f64 = directions.iter().map(|(_, p)| p).sum();
    let Some([t0, t1]) = dense.interval(ray) else { return [0.0; 2] };
    let steps = ((t1 - t0) * 64.0).ceil() as u32;
    let length = (t1 - t0) / f64::from(steps);
    let (mut tau, mut light) = (0.0, [0.0; 2]);
    let (mut pending, mut weighted) = (0.0, DVec3::ZERO);
    for i in 0..steps {
        let p = ray.origin + ray.direction * (t0 + length * (f64::from(i) + 0.5));
        let step_depth = sigma * dense.at(p) * length;
        let share = f64::exp(-tau) * (1.0 - f64::exp(-step_depth));
        tau += step_depth;
        if share > 0.0 {
            light[0] += share * phase(to_sun.dot(ray.direction)) * f64::exp(-depth(p, to_sun));
        }
        // The sky varies slowly along the ray: steps share one look from their centre of gravity.
        pending += share;
        weighted += share * p;
        if pending > 0.02 || (i + 1 == steps && pending > 0.0) {
            let p = weighted / pending;
            let sky = |(to_sky, p_sky): &(DVec3, f64)| match p_sky / norm * f64::from(DIRECTIONS) {
                weight if weight < 1e-3 => 0.0,
                weight => weight * f64::exp(-depth(p, *to_sky)),
            };
            light[1] += pending * directions.iter().map(sky).sum::<f64>() / f64::from(DIRECTIONS);
            (pending, weighted) = (0.0, DVec3::ZERO);
        }
    }
    light
}

#[test]
fn phase_function_and_lights_agree_with_brute_force() {
    let (json, density) = (json(), channel("density"));
    let dense = Dense::new(&density);
    let quality = Quality {
        sky_rays: 512,
        sun_rays: u32::MAX,
        shadow_step_voxels: 0.5,
        shadow_growth: 0.0,
        ..Quality::default()
    };
    for g in [0.8f32, -0.5] {
        let full = lit_scene(&json, &density, g);
        for (x, y) in [(64.5, 64.5), (50.5, 80.5)] {
            let ray = full.camera.ray(DVec2::new(x, y), SIZE, SIZE);
            let [Light::Sun(sun)] = full.lights[..] else { panic!("a sun") };
            let to_sun = sun.direction_to.as_dvec3();
            let scale = full.volumes[0].extinction[0].into();
            let expected = brute_force(&dense, &ray, scale, g.into(), to_sun);
            let mut found = [0.0; 2];
            for (which, found) in found.iter_mut().enumerate() {
                let mut scene = full.clone();
                scene.volumes[0].albedo = [1.0; 3];
                let sun = Light::Sun(Sun { irradiance: [1.0; 3], ..sun });
                scene.lights = if which == 0 { vec![sun] } else { Vec::new() };
                scene.sky = Sky::Constant(if which == 1 { [1.0; 3] } else { [0.0; 3] });
                let marcher = Marcher::new(&scene, quality);
                let mut worker = marcher.worker();
                let seeds = 16;
                let sum: f32 =
                    (0..seeds).map(|s| marcher.radiance(&mut worker, &ray, s * 7919).scattered.y).sum();
                *found = f64::from(sum) / f64::from(seeds);
            }
            let [sun, sky] = [0, 1].map(|i| found[i] / expected[i] - 1.0);
            println!(
                "g {g} at {x}, {y}: {expected:.5?}, sun {:+.2} %, sky {:+.2} %",
                sun * 100.0,
                sky * 100.0
            );
            assert!(expected[0] > 1e-3 && expected[1] > 1e-2, "a pixel in the volume");
            assert!(sun.abs() < 0.02 && sky.abs() < 0.02, "{found:?} instead of {expected:?}");
        }
    }
}

/// With the sun behind the camera, light takes the same way in and out; with the sun in front, all paths are as
/// long. Both have closed forms in the optical depth alone, whatever the volume.
#[test]
fn sun_along_the_view_has_closed_forms() {
    let (json, density) = (json(), channel("density"));
    let dense = Dense::new(&density);
    let quality =
        Quality { step_voxels: 0.125, shadow_step_voxels: 0.25, sun_rays: u32::MAX, ..Quality::default() };
    let mut checked = 0;
    for g in [0.0f32, 0.8, -0.5] {
        let mut scene = lit_scene(&json, &density, g);
        scene.sky = Sky::Constant([0.0; 3]);
        scene.volumes[0].albedo = [1.0, 0.5, 0.25];
        for ray in pixel_centres(&scene.camera).step_by(97) {
            let tau = 8.0 * dense.line_integral(&ray);
            if tau < 0.01 {
                continue;
            }
            for cos in [1.0, -1.0f64] {
                let direction_to = (cos * ray.direction).normalize().as_vec3();
                let mut scene = scene.clone();
                scene.lights = vec![Light::Sun(Sun::point(direction_to, [4.0; 3]))];
                let marcher = Marcher::new(&scene, quality);
                let light = marcher.radiance(&mut marcher.worker(), &ray, 5).scattered;
                let g = f64::from(g);
                let phase = (1.0 - g * g) / (4.0 * PI * (1.0 + g * g - 2.0 * g * cos).powf(1.5));
                let share = if cos > 0.0 { tau * f64::exp(-tau) } else { (1.0 - f64::exp(-2.0 * tau)) / 2.0 };
                let expected = 4.0 * phase * share;
                let error = (f64::from(light.x) - expected).abs() / (4.0 * phase);
                // Shadow rays end at an optical depth of 9, camera rays at a transmittance of 1e-4.
                assert!(error < 2e-3, "τ {tau}, g {g}, cos {cos}: {light} instead of {expected}");
                assert!((light - light.x * Vec3::new(1.0, 0.5, 0.25)).length() <= 1e-6 * light.x);
                checked += 1;
            }
        }
    }
    assert!(checked > 100, "{checked} rays in the volume");
}

#[test]
fn the_camera_is_the_one_of_the_reference() {
    let json = json();
    let camera = camera(&json);
    for (ours, name) in [(camera.forward, "forward"), (camera.right, "right"), (camera.up, "true_up")] {
        assert!((ours - DVec3::from_array(numbers(&json["camera"][name]))).length() < 1e-12, "{name}");
    }
}
