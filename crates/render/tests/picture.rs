//! Whole pictures: independent of threads, bounded by the light there is, the same for the same field however
//! it is stored, and finite whatever the values.

mod common;

use common::{Dense, channel_of, empty};
use glam::{DAffine3, DMat3, DVec3, IVec3};
use nuage_render::camera::Camera;
use nuage_render::film::Image;
use nuage_render::light::{Sky, Sun};
use nuage_render::march::Quality;
use nuage_render::picture::render;
use nuage_render::scene::{Emission, Phase, Scene, Shape, Spectrum, Volume};
use nuage_volume::channel::Channel;

const SIZE: u32 = 40;

fn camera() -> Camera {
    Camera::look_at(DVec3::new(60.0, 45.0, 90.0), DVec3::splat(8.0), DVec3::Y, 35.0).expect("a view")
}

/// A lumpy ball of radius 11 around (8, 8, 8), with soft edges.
fn ball(p: DVec3) -> f32 {
    let lumps = 0.3 * (p.x * 0.9).sin() * (p.y * 0.7).cos() + 0.7;
    (lumps * (1.0 - (p - 8.0).length() / 11.0).max(0.0)) as f32
}

fn density() -> Channel {
    channel_of(IVec3::splat(-4), IVec3::splat(20), DAffine3::IDENTITY, |i| ball(i.as_dvec3()))
}

fn scene<'a>(density: &'a Channel, emission: Option<&'a Channel>) -> Scene<'a> {
    let spectrum = Spectrum::Linear { rgb: [0.1, 0.05, 0.02] };
    let volume = Volume {
        shape: Shape::Grid(density),
        coarse: None,
        extinction: [0.3; 3],
        albedo: [0.9, 0.8, 0.7],
        phase: Phase::HenyeyGreenstein { g: 0.3 },
        emission: emission.map(|channel| Emission { channel: Some(channel), spectrum }),
    };
    let direction_to = DVec3::new(0.3, 1.0, 0.2).normalize().as_vec3();
    Scene::of_one(camera(), volume, Some(Sun::point(direction_to, [3.0; 3])), [0.5; 3])
}

fn picture(scene: &Scene<'_>, quality: Quality) -> Image {
    render(scene, quality, SIZE, SIZE, &|_, _| {}).expect("a picture")
}

fn assert_close(a: &Image, b: &Image, tolerance: f32) {
    for (i, (a, b)) in a.pixels.iter().zip(&b.pixels).enumerate() {
        let near = a.iter().zip(b).all(|(a, b)| (a - b).abs() < tolerance);
        assert!(near, "pixel {} of row {}: {a:?} and {b:?}", i as u32 % SIZE, i as u32 / SIZE);
    }
}

#[test]
fn threads_do_not_change_a_bit() {
    let (density, glow) = (density(), density());
    let scene = scene(&density, Some(&glow));
    let with_threads = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a thread pool");
        pool.install(|| render(&scene, Quality::default(), 50, 33, &|_, _| {}).expect("a picture"))
    };
    let bits = |image: Image| image.pixels.into_iter().map(|p| p.map(f32::to_bits)).collect::<Vec<_>>();
    let one = bits(with_threads(1));
    assert!(one.iter().any(|p| *p != [0; 4]));
    assert!(one == bits(with_threads(2)) && one == bits(with_threads(3)));
}

#[test]
fn progress_counts_all_tiles_once() {
    let density = density();
    let seen = std::sync::Mutex::new(Vec::new());
    let quality = Quality { samples: 1, sky_rays: 0, ..Quality::default() };
    render(&scene(&density, None), quality, 50, 33, &|done, all| {
        assert_eq!(all, 12);
        seen.lock().expect("a lock").push(done);
    })
    .expect("a picture");
    let mut seen = seen.into_inner().expect("a lock");
    seen.sort_unstable();
    assert_eq!(seen, (1..=12).collect::<Vec<_>>());
}

/// In a white world nothing is brighter than white; single scattering leaves some light out.
#[test]
fn single_scattering_stays_below_the_furnace() {
    let density = density();
    for (g, scale) in [(0.0, 0.3), (0.8, 0.3), (-0.5, 0.05), (0.0, 30.0)] {
        let mut scene = scene(&density, None);
        (scene.lights, scene.sky) = (Vec::new(), Sky::Constant([1.0; 3]));
        let volume = &mut scene.volumes[0];
        (volume.albedo, volume.extinction) = ([1.0; 3], [scale; 3]);
        volume.phase = Phase::HenyeyGreenstein { g };
        let quality = Quality { sky_rays: 64, samples: 4, ..Quality::default() };
        let alone = picture(&scene, quality);
        let image = alone.over([1.0; 3]);
        let mut lowest = 1.0f32;
        for (pixel, alone) in image.pixels.iter().zip(&alone.pixels) {
            // The sky's rays are counted in whole numbers: one too many per camera ray at most.
            assert!(pixel[0] <= 1.0 + 1.0 / 64.0, "g {g}, scale {scale}: {pixel:?}");
            assert!(alone[0] <= alone[3] + 1.0 / 64.0);
            lowest = lowest.min(pixel[0]);
        }
        let mean = image.mean()[0];
        assert!(mean < 1.0 && mean > 0.5 && lowest < 0.995, "g {g}, scale {scale}: {mean}, {lowest}");
    }
    // Where the medium is thin, little scatters twice.
    let mut thin = scene(&density, None);
    (thin.lights, thin.sky) = (Vec::new(), Sky::Constant([1.0; 3]));
    (thin.volumes[0].albedo, thin.volumes[0].extinction) = ([1.0; 3], [1e-3; 3]);
    let mean = picture(&thin, Quality { sky_rays: 16, ..Quality::default() }).over([1.0; 3]).mean()[0];
    assert!((mean - 1.0).abs() < 1e-3, "{mean}");
}

/// One field stored four ways: moved by bricks, mirrored, with turned axes, and at twice the resolution, which
/// interpolates to the same values.
#[test]
fn the_same_field_on_another_grid_gives_the_same_picture() {
    let (density, emission) = (density(), density());
    let quality = Quality {
        step_voxels: 0.25,
        shadow_step_voxels: 0.25,
        sun_rays: u32::MAX,
        sky_rays: 0,
        ..Quality::default()
    };
    let reference = picture(&scene(&density, Some(&emission)), quality);
    assert!(reference.mean()[3] > 0.03, "{:?}", reference.mean());

    let stored = |world_from_index: DAffine3, min, max| {
        channel_of(min, max, world_from_index, |i| {
            let p = world_from_index.transform_point3(i.as_dvec3());
            let inside = p.cmpge(DVec3::splat(-4.0)).all() && p.cmple(DVec3::splat(20.0)).all();
            if inside { ball(p) } else { 0.0 }
        })
    };
    let shift = IVec3::new(1000, -2003, 17);
    let moved = DAffine3::from_translation(-shift.as_dvec3());
    let mirrored = DAffine3::from_scale(DVec3::new(-1.0, 1.0, -1.0));
    let axes = DMat3::from_cols(DVec3::Y, DVec3::Z, DVec3::X);
    let rotated = DAffine3 { matrix3: axes, translation: DVec3::ZERO };
    let (low, high) = (IVec3::splat(-4), IVec3::splat(20));
    let dense = Dense::new(&density);
    let half = DAffine3::from_scale(DVec3::splat(0.5));
    let finer =
        channel_of(low * 2 - 1, high * 2 + 1, half, |i| dense.at(half.transform_point3(i.as_dvec3())) as f32);
    let others = [
        (stored(moved, low + shift, high + shift), 1.0),
        (stored(mirrored, IVec3::new(-20, -4, -20), IVec3::new(4, 20, 4)), 1.0),
        (stored(rotated, low, high), 1.0),
        (finer, 2.0),
    ];
    for (other, resolution) in &others {
        // The emission alone, then the density alone, then both.
        let glow = picture(&scene(&density, Some(other)), quality);
        assert_close(&reference, &glow, 3e-3);
        let dense = Quality {
            step_voxels: quality.step_voxels * resolution,
            shadow_step_voxels: quality.shadow_step_voxels * resolution,
            ..quality
        };
        assert_close(&reference, &picture(&scene(other, Some(&emission)), quality), 3e-3);
        let both = picture(&scene(other, Some(other)), dense);
        assert_close(&reference, &both, 3e-3);
    }
}

#[test]
fn huge_densities_are_opaque_and_finite() {
    let low = IVec3::splat(-4);
    for value in [1e10, f32::MAX] {
        let density = channel_of(low, IVec3::splat(20), DAffine3::IDENTITY, |_| value);
        for density_scale in [1.0, f32::MAX] {
            let mut scene = scene(&density, Some(&density));
            scene.volumes[0].extinction = [density_scale; 3];
            let image = picture(&scene, Quality { samples: 1, ..Quality::default() });
            let finite = image.pixels.iter().flatten().all(|v| v.is_finite());
            assert!(finite, "{value:e} × {density_scale:e}");
            assert_eq!(image.pixels[(SIZE / 2 * SIZE + SIZE / 2) as usize][3], 1.0);
            // Rays that graze an edge may meet next to nothing.
            assert!(image.pixels.iter().all(|p| p[3] == 0.0 || p[3] > 0.99999));
            assert!(image.pixels.iter().any(|p| p[3] == 0.0));
        }
    }
}

/// Glow so bright that single precision cannot hold it must not become NaN, which would spread.
#[test]
fn huge_emission_is_never_nan() {
    let huge = channel_of(IVec3::splat(-4), IVec3::splat(20), DAffine3::IDENTITY, |_| f32::MAX);
    let (thin, none) = (density(), empty());
    for density in [&huge, &thin, &none] {
        let mut scene = scene(density, Some(&huge));
        if let Some(emission) = &mut scene.volumes[0].emission {
            emission.spectrum = Spectrum::Linear { rgb: [1.0, 1e6, 0.0] };
        }
        let image = picture(&scene, Quality { samples: 1, ..Quality::default() });
        assert!(image.pixels.iter().flatten().all(|v| !v.is_nan()));
    }
}

#[test]
fn nothing_gives_nothing() {
    let nothing = empty();
    let zero = channel_of(IVec3::ZERO, IVec3::splat(9), DAffine3::IDENTITY, |_| 0.0);
    for density in [&nothing, &zero] {
        for emission in [None, Some(&nothing), Some(&zero)] {
            let image = picture(&scene(density, emission), Quality::default());
            assert!(image.pixels.iter().all(|p| *p == [0.0; 4]));
        }
    }
    // A glow needs no density.
    let glow = density();
    let image = picture(&scene(&nothing, Some(&glow)), Quality::default());
    assert!(image.mean()[0] > 0.0 && image.pixels.iter().all(|p| p[3] == 0.0));
}
