//! The ray marcher against closed forms: homogeneous boxes and tiles, and what follows from the optical depth
//! alone.
//!
//! Values end over one voxel: outside a box of N voxels they are zero, and interpolation makes a ramp of the
//! step. A ray along an axis through N voxels of value 1 therefore has the optical depth σ × N voxels exactly.

mod common;

use std::f64::consts::PI;

use common::{
    Random, absorbing, any_camera, channel_of, clip, empty, line_integral, tile, tile_voxels, to_index,
};
use glam::{DAffine3, DMat3, DQuat, DVec3, IVec3};
use nuage_render::camera::Ray;
use nuage_render::light::{Light, Sun};
use nuage_render::march::{Marcher, Quality, Radiance};
use nuage_render::phase::hg;
use nuage_render::scene::{Emission, Phase, Scene, Spectrum};
use nuage_volume::build::TileSize;
use nuage_volume::channel::Channel;

const VOXEL: f64 = 0.125;
const TILES: [TileSize; 3] = [TileSize::Brick, TileSize::Node4, TileSize::Node5];

fn scaled() -> DAffine3 {
    DAffine3::from_scale(DVec3::splat(VOXEL))
}

fn with_step(step_voxels: f32) -> Quality {
    Quality {
        step_voxels,
        shadow_step_voxels: step_voxels,
        sun_rays: u32::MAX,
        sky_rays: 0,
        ..Quality::default()
    }
}

fn radiance(scene: &Scene<'_>, quality: Quality, ray: &Ray) -> Radiance {
    let marcher = Marcher::new(scene, quality);
    marcher.radiance(&mut marcher.worker(), ray, 12345)
}

fn depth(channel: &Channel, quality: Quality, ray: &Ray) -> f64 {
    let scene = absorbing(any_camera(), channel, 1.0);
    let marcher = Marcher::new(&scene, quality);
    marcher.depth_per_scale(&mut marcher.worker(), ray).into()
}

/// A box of ones whose faces do not lie on bricks.
fn plain_box(size: i32) -> Channel {
    channel_of(IVec3::splat(-3), IVec3::splat(size - 4), scaled(), |_| 1.0)
}

/// Rays along the axes, both ways, through the middle of the first `voxels`.
fn axis_rays(middle: DVec3) -> impl Iterator<Item = Ray> {
    (0..6).map(move |i| {
        let direction = DVec3::AXES[i / 2] * if i % 2 == 0 { 1.0 } else { -1.0 };
        Ray { origin: middle - direction * 1000.0, direction }
    })
}

fn assert_near(found: f64, expected: f64, relative: f64, what: &str) {
    assert!((found - expected).abs() <= relative * expected.abs(), "{what}: {found} instead of {expected}");
}

#[test]
fn a_ray_through_n_voxels_has_the_depth_of_n_voxels() {
    for size in [1, 5, 8, 24, 37] {
        let channel = plain_box(size);
        let middle = DVec3::splat(VOXEL * (f64::from(size - 1) / 2.0 - 3.0));
        for ray in axis_rays(middle) {
            // The ramps have three corners each, and a step that holds a corner errs by its square.
            for (step, absolute) in [(1.0, 0.3), (0.5, 0.08), (0.125, 0.005)] {
                let error = (depth(&channel, with_step(step), &ray) / VOXEL - f64::from(size)).abs();
                assert!(error < absolute, "{size} voxels along {:?}, step {step}: {error}", ray.direction);
            }
        }
    }
}

#[test]
fn tiles_are_integrated_in_closed_form() {
    for size in TILES {
        let channel = tile(size, scaled());
        let voxels = f64::from(tile_voxels(size));
        for ray in axis_rays(DVec3::splat(VOXEL * 3.3)) {
            let what = format!("{size:?} along {:?}", ray.direction);
            for step in [4.0, 0.5, 0.125f32] {
                let found = depth(&channel, with_step(step), &ray);
                // A tile of one brick is sampled, and so are the bricks before it.
                let relative = if size == TileSize::Brick { 0.04 * f64::from(step * step) } else { 2e-6 };
                assert_near(found, voxels * VOXEL, relative.max(2e-6), &format!("{what}, step {step}"));
            }
            // With a transmittance of e^−3.
            let scene = absorbing(any_camera(), &channel, (3.0 / (voxels * VOXEL)) as f32);
            let through = radiance(&scene, with_step(0.125), &ray).transmittance;
            let relative = if size == TileSize::Brick { 3e-3 } else { 5e-6 };
            assert_near(through.into(), (-3.0f64).exp(), relative, &what);
        }
    }
}

/// Oblique rays, turned and sheared grids: the interpolated box integrated cell by cell.
#[test]
fn oblique_rays_agree_with_quadrature() {
    let mut random = Random(7);
    let turned = DAffine3 {
        matrix3: DMat3::from_quat(DQuat::from_euler(glam::EulerRot::XYZ, 0.4, -1.1, 2.0))
            * DMat3::from_cols(
                DVec3::new(0.1, 0.0, 0.0),
                DVec3::new(0.03, -0.2, 0.0),
                DVec3::new(0.0, 0.0, 0.07),
            ),
        translation: DVec3::new(-30.0, 5.0, 700.0),
    };
    for transform in [scaled(), turned] {
        for size in TILES {
            let channel = tile(size, transform);
            let voxels = tile_voxels(size);
            let inside = |i: IVec3| i.cmpge(IVec3::ZERO).all() && i.cmplt(IVec3::splat(voxels)).all();
            let one = |i: IVec3| if inside(i) { 1.0 } else { 0.0 };
            let extent = f64::from(voxels);
            for _ in 0..if size == TileSize::Node5 { 5 } else { 40 } {
                let target = random.in_box(DVec3::splat(-2.0), DVec3::splat(extent + 1.0));
                let direction = random.direction();
                let origin = transform.transform_point3(target) - 3.0 * extent * direction;
                let ray = Ray { origin, direction };
                let (o, d) = to_index(&transform.inverse(), &ray);
                let expected = clip(o, d, DVec3::NEG_ONE, DVec3::splat(extent))
                    .map_or(0.0, |[t0, t1]| line_integral(&one, o, d, t0, t1));
                let found = depth(&channel, with_step(0.125), &ray);
                // In voxels; single precision counts to 4096 voxels.
                let tolerance = 3e-3 + 3e-6 * extent;
                let error = (found - expected).abs() * d.length();
                assert!(error < tolerance, "{size:?}: {found} instead of {expected}, error {error} voxels");
            }
        }
    }
}

/// Where emission is proportional to density, σ cancels: L = j/σ (1 − e^−τ) for any shape.
#[test]
fn glowing_media_follow_the_closed_form() {
    let boxes = [plain_box(24), tile(TileSize::Node4, scaled()), tile(TileSize::Node5, scaled())];
    for channel in &boxes {
        for tau in [0.01, 1.0, 5.0] {
            for ray in axis_rays(DVec3::splat(VOXEL * 3.3)) {
                let length = depth(channel, with_step(0.125), &ray);
                let sigma = tau / length;
                let mut scene = absorbing(any_camera(), channel, sigma as f32);
                scene.volumes[0].emission = Some(Emission {
                    channel: Some(channel),
                    spectrum: Spectrum::Linear { rgb: [1.0, 2.0, 0.0] },
                });
                let found = radiance(&scene, with_step(0.125), &ray);
                let expected = (1.0 - f64::exp(-tau)) / sigma;
                // Lattices differ between both ways of marching.
                assert_near(found.scattered.x.into(), expected, 2e-3, "emission");
                assert_eq!((found.scattered.y, found.scattered.z), (2.0 * found.scattered.x, 0.0));
                let through = f64::from(found.transmittance);
                let rounding = 1e-5 + 1e-5 / tau;
                assert_near(found.scattered.x.into(), (1.0 - through) / sigma, rounding, "what is absorbed");
            }
        }
    }
}

/// Light from an empty density is not absorbed: L = j d.
#[test]
fn a_glow_without_density_adds_up() {
    let density = empty();
    for size in TILES {
        let glow = tile(size, scaled());
        let mut scene = absorbing(any_camera(), &density, 1.0);
        let spectrum = Spectrum::Linear { rgb: [3.0; 3] };
        scene.volumes[0].emission = Some(Emission { channel: Some(&glow), spectrum });
        let expected = 3.0 * f64::from(tile_voxels(size)) * VOXEL;
        for ray in axis_rays(DVec3::splat(VOXEL * 3.3)) {
            let found = radiance(&scene, with_step(0.125), &ray);
            assert_near(found.scattered.x.into(), expected, 1e-3, "emission");
            assert_eq!(found.transmittance, 1.0);
        }
    }
}

/// A glow behind an absorbing tile and one in front of it, on grids of their own.
#[test]
fn density_in_front_dims_a_glow() {
    let density = tile(TileSize::Node4, scaled());
    let far = 1000.0;
    let moved = |z: f64| DAffine3 { translation: DVec3::new(0.0, 0.0, z), ..scaled() };
    let sigma = 0.125;
    let tau = sigma * 128.0 * VOXEL;
    for (z, share) in [(far, 1.0), (-far, f64::exp(-tau))] {
        let glow = tile(TileSize::Node4, moved(z));
        let mut scene = absorbing(any_camera(), &density, sigma as f32);
        let spectrum = Spectrum::Linear { rgb: [1.0; 3] };
        scene.volumes[0].emission = Some(Emission { channel: Some(&glow), spectrum });
        let ray = Ray { origin: DVec3::new(5.0, 5.0, 3.0 * far), direction: DVec3::NEG_Z };
        let found = radiance(&scene, with_step(0.25), &ray);
        // 16 length units of glow 1000 away: the ends of its ramps have the precision of f32 at 1000.
        assert_near(found.scattered.x.into(), 128.0 * VOXEL * share, 1e-4, "emission");
        assert_near(found.transmittance.into(), f64::exp(-tau), 1e-5, "transmittance");
    }
}

/// With the sun behind the camera, light takes the same way in and out; with the sun in front all paths are as
/// long. Along all axes, both ways: such directions have zeros, negative ones among them.
#[test]
fn sun_along_the_axes_has_closed_forms() {
    let albedo = 0.75;
    for channel in [plain_box(24), tile(TileSize::Node4, scaled()), tile(TileSize::Node5, scaled())] {
        for ray in axis_rays(DVec3::splat(VOXEL * 3.3)) {
            let length = depth(&channel, with_step(0.125), &ray);
            for tau in [0.1, 2.0] {
                for (direction_to, cos) in [(ray.direction, 1.0), (-ray.direction, -1.0f64)] {
                    let mut scene = absorbing(any_camera(), &channel, (tau / length) as f32);
                    scene.volumes[0].albedo = [albedo as f32; 3];
                    scene.volumes[0].phase = Phase::HenyeyGreenstein { g: 0.6 };
                    scene.lights = vec![Light::Sun(Sun::point(direction_to.as_vec3(), [2.0; 3]))];
                    let found = radiance(&scene, with_step(0.25), &ray).scattered.x;
                    let share =
                        if cos > 0.0 { tau * f64::exp(-tau) } else { (1.0 - f64::exp(-2.0 * tau)) / 2.0 };
                    let phase = (1.0 - 0.36) / (4.0 * PI * (1.36 - 1.2 * cos).powf(1.5));
                    assert_near(f64::from(hg(cos as f32, 0.6)), phase, 1e-5, "phase");
                    let what = format!("τ {tau}, sun at {direction_to:?}, view {:?}", ray.direction);
                    assert_near(found.into(), 2.0 * albedo * phase * share, 5e-3, &what);
                }
            }
        }
    }
}
