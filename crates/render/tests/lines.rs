//! Line integrals, surfaces, collisions and views against quadrature in double precision, closed forms and each other.

mod common;
#[allow(dead_code, reason = "each test binary uses its own part")]
mod reference;

use common::{Dense, cell_crossings, channel_of, to_index};
use glam::{DAffine3, DMat3, DVec2, DVec3, IVec3};
use nuage_render::camera::{Camera, Ray};
use nuage_render::depth::{optical_depth, stepped_transmittance};
use nuage_render::filter::{Filter, nearest_voxel};
use nuage_render::hash::{hash_u32, unit_f32};
use nuage_render::surface::{first_hit, first_voxel};
use nuage_render::track::first_collision;
use nuage_render::traverse::Field;
use nuage_render::views::{View, hue, render_view};
use nuage_testkit::npy::read_raw_f64;
use nuage_volume::channel::Channel;
use reference::{SIZE, camera, channel, json, path};

fn random(seed: u32) -> f64 {
    f64::from(unit_f32(hash_u32(seed)))
}

/// Blobs and holes over some bricks, in a sheared and moved space.
fn blobs() -> Channel {
    let shear = DMat3::from_cols(DVec3::new(0.2, 0.03, 0.0), DVec3::new(0.0, 0.15, 0.02), DVec3::Z * 0.25);
    let world_from_index = DAffine3 { matrix3: shear, translation: DVec3::new(3.0, -7.0, 11.0) };
    let value = |p: IVec3| {
        let wave = (p.as_vec3() * 0.31).to_array().map(f32::sin);
        let noise = unit_f32(hash_u32((p.x * 31 + p.y * 1009 + p.z * 65_537) as u32));
        (wave[0] * wave[1] * wave[2] + 0.2 * noise - 0.2).max(0.0)
    };
    channel_of(IVec3::new(-19, -3, 5), IVec3::new(31, 40, 37), world_from_index, value)
}

/// Rays from around a channel through it, a few of them along axes of its space.
fn rays(channel: &Channel, count: u32) -> Vec<Ray> {
    let active = channel.active_box.expect("voxels");
    let extent = (active.max - active.min).as_dvec3();
    let point = |seed: u32| {
        let share = DVec3::new(random(seed), random(seed + 1), random(seed + 2));
        active.min.as_dvec3() + extent * share
    };
    let to_world = |p| channel.world_from_index.transform_point3(p);
    let ray = |i: u32| {
        let target = point(100 * i);
        let away = match i % 8 {
            0 => DVec3::Z * -200.0,
            1 => DVec3::Y * 150.0,
            2 => DVec3::X * -150.0,
            _ => (point(100 * i + 7) - point(100 * i + 13)).normalize() * 120.0,
        };
        let (origin, target) = (to_world(target + away), to_world(target));
        Ray { origin, direction: (target - origin).normalize() }
    };
    (0..count).map(ray).collect()
}

#[test]
fn optical_depth_is_the_integral() {
    let channel = blobs();
    let (field, dense) = (Field::new(&channel).expect("a field"), Dense::new(&channel));
    let mut reader = field.reader();
    let index_from_world = channel.world_from_index.inverse();
    let mut seen = 0;
    for ray in rays(&channel, 400) {
        let expected = dense.line_integral(&ray);
        let depth = f64::from(optical_depth(&field, &mut reader, &ray, Filter::Trilinear));
        assert!((depth - expected).abs() < 2e-5 * (1.0 + expected), "{ray:?}: {depth}, not {expected}");
        // Voxels are boxes around their places: cells of a lattice that is shifted by half.
        let (origin, direction) = to_index(&index_from_world, &ray);
        let expected = match dense.interval(&ray) {
            None => 0.0,
            Some([t0, t1]) => {
                // A little wider, since boxes reach beyond the last place.
                let margin = 2.0 / direction.length();
                let crossings = cell_crossings(origin + 0.5, direction, t0 - margin, t1 + margin);
                let share = |w: &[f64]| {
                    let middle = origin + direction * 0.5 * (w[0] + w[1]);
                    (w[1] - w[0]) * dense.voxel((middle + 0.5).floor().as_ivec3())
                };
                crossings.windows(2).map(share).sum::<f64>()
            }
        };
        let depth = f64::from(optical_depth(&field, &mut reader, &ray, Filter::Nearest));
        assert!((depth - expected).abs() < 1e-4 * (1.0 + expected), "{ray:?}: {depth}, not {expected}");
        seen += u32::from(expected > 0.1);
    }
    assert!(seen > 100, "only {seen} rays meet anything");
}

#[test]
fn the_reference_scene_is_met_to_the_last_digits() {
    let (camera, density) = (camera(&json()), channel("density"));
    let field = Field::new(&density).expect("a field");
    let mut reader = field.reader();
    let expected = read_raw_f64(&path("tau_center.f64"));
    let scale = json()["scenes"]["het64_g0_ss"]["sigma_scale"].as_f64().expect("a number");
    let (mut worst, mut largest) = (0.0_f64, 0.0_f64);
    for (i, expected) in (0..).zip(expected) {
        let centre = DVec2::new(f64::from(i % SIZE) + 0.5, f64::from(i / SIZE) + 0.5);
        let ray = camera.ray(centre, SIZE, SIZE);
        let depth = optical_depth(&field, &mut reader, &ray, Filter::Trilinear);
        worst = worst.max((f64::from(depth) * scale - expected).abs());
        largest = largest.max(expected);
    }
    assert!(worst < 5e-6 * largest, "off by {worst} of {largest}");
}

#[test]
fn short_steps_come_to_the_exact_integral() {
    let channel = blobs();
    let field = Field::new(&channel).expect("a field");
    let mut reader = field.reader();
    for filter in [Filter::Nearest, Filter::Trilinear] {
        for ray in rays(&channel, 60) {
            let exact = (-1.7 * optical_depth(&field, &mut reader, &ray, filter)).exp();
            let passes =
                |reader: &mut _, step| stepped_transmittance(&field, reader, &ray, filter, step, 1.7);
            assert!((passes(&mut reader, 0.01) - exact).abs() < 4e-3, "{ray:?} {exact}");
            assert!((passes(&mut reader, 0.5) - exact).abs() < 0.15, "{ray:?} {exact}");
        }
    }
}

#[test]
fn collisions_follow_the_exact_transmittance() {
    let channel = blobs();
    let field = Field::new(&channel).expect("a field");
    let mut reader = field.reader();
    const PATHS: u32 = 4000;
    for (number, ray) in (0..).zip(rays(&channel, 24)) {
        let expected = f64::from((-2.5 * optical_depth(&field, &mut reader, &ray, Filter::Trilinear)).exp());
        let mut passed = 0;
        for path in 0..PATHS {
            let mut count = hash_u32(number * PATHS + path);
            let random = || {
                count = count.wrapping_add(1);
                unit_f32(hash_u32(count))
            };
            passed += u32::from(first_collision(&field, &mut reader, &ray, 2.5, random).is_none());
        }
        let share = f64::from(passed) / f64::from(PATHS);
        let error = (expected * (1.0 - expected) / f64::from(PATHS)).sqrt();
        assert!((share - expected).abs() < 4.5 * error + 1e-4, "{share} instead of {expected}");
    }
}

#[test]
fn the_surface_of_a_ball_is_where_it_should_be() {
    let radius = 20.0_f64;
    let centre = DVec3::new(3.3, -2.1, 0.4);
    // The distance from outside of a band of three voxels.
    let value = |p: IVec3| (radius + 3.0 - (p.as_dvec3() - centre).length()).clamp(0.0, 6.0) as f32;
    let channel = channel_of(IVec3::splat(-30), IVec3::splat(30), DAffine3::IDENTITY, value);
    let field = Field::new(&channel).expect("a field");
    let mut reader = field.reader();
    let mut hits = 0;
    for ray in rays(&channel, 500) {
        let along = (centre - ray.origin).dot(ray.direction);
        let aside2 = (centre - ray.origin).length_squared() - along * along;
        let half2 = radius * radius - aside2;
        let hit = first_hit(&field, &mut reader, &ray, 3.0);
        // Trilinear interpolation of a distance is off by the curvature of the ball.
        if half2.abs() < 40.0 {
            continue;
        }
        assert_eq!(hit.is_some(), half2 > 0.0, "{ray:?}");
        let Some(hit) = hit else { continue };
        assert!((hit.distance - (along - half2.sqrt())).abs() < 0.06, "{hit:?}");
        let normal = (ray.origin + ray.direction * hit.distance - centre).normalize();
        assert!(hit.normal.as_dvec3().dot(normal) > 0.999, "{hit:?} {normal}");
        hits += 1;
    }
    assert!(hits > 100, "only {hits} rays hit");
}

#[test]
fn the_first_voxel_is_the_first_that_small_steps_find() {
    let channel = blobs();
    let (field, dense) = (Field::new(&channel).expect("a field"), Dense::new(&channel));
    let index_from_world = channel.world_from_index.inverse();
    let mut reader = field.reader();
    let mut found = 0;
    for ray in rays(&channel, 200) {
        let hit = first_voxel(&field, &mut reader, &ray, 0.3);
        let (origin, direction) = to_index(&index_from_world, &ray);
        let at = |t: f64| nearest_voxel((origin + direction * t).as_vec3());
        let mut steps = (0..30_000).map(|i| f64::from(i) * 0.01 / direction.length());
        let stepped = steps.find(|t| dense.voxel(at(*t)) > 0.300_001);
        match (hit, stepped) {
            (None, None) => {}
            (Some(hit), _) if dense.voxel(hit.voxel) != f64::from(hit.value) => {
                panic!("{hit:?} is {}", dense.voxel(hit.voxel))
            }
            // Steps may jump over the corner of a voxel.
            (Some(hit), stepped) => {
                assert!(hit.value > 0.3);
                assert!(stepped.is_none_or(|t| hit.distance < t + 1e-3), "{hit:?} {stepped:?}");
                let inside = at(hit.distance + 1e-3 / direction.length());
                assert!((inside - hit.voxel).abs().max_element() <= 1, "{hit:?} {inside}");
                found += u32::from(stepped.is_some_and(|t| t - hit.distance < 0.1));
            }
            (None, Some(t)) => panic!("nothing, but {} at {t}", at(t)),
        }
    }
    assert!(found > 50, "only {found} rays find the same");
}

#[test]
fn views_show_what_is_there() {
    let channel = blobs();
    let field = Field::new(&channel).expect("a field");
    let centre = channel.world_from_index.transform_point3(DVec3::new(6.0, 18.0, 21.0));
    let camera = Camera::look_at(centre + DVec3::Z * 30.0, centre, DVec3::Y, 40.0).expect("a view");
    let picture = |view| render_view(&field, view, &camera, [48, 32], &|_, _| {}).expect("a picture").pixels;
    let density = picture(View::Density { extinction: 2.0 });
    for view in [View::Depth, View::Index, View::FirstDensity] {
        let pixels = picture(view);
        for (pixel, density) in pixels.iter().zip(&density) {
            assert!(pixel[..3].iter().all(|c| (0.0..=1.0).contains(c)), "{pixel:?}");
            // Voxels are boxes, interpolation reaches a little further: not each pixel agrees.
            assert!(pixel[3] == 1.0 || density[3] < 0.2, "{view:?} {pixel:?} {density:?}");
        }
        assert!(pixels.iter().any(|p| p[3] == 1.0) && pixels.iter().any(|p| p[3] == 0.0), "{view:?}");
        let first = pixels.iter().find(|p| p[3] == 1.0);
        assert!(pixels.iter().any(|p| p[3] == 1.0 && Some(p) != first), "{view:?} is all one colour");
    }
    assert_eq!(hue(0.0), [1.0, 0.0, 0.0]);
    assert_eq!(hue(1.0 / 3.0).map(f32::round), [0.0, 1.0, 0.0]);
    assert_eq!(hue(2.0 / 3.0).map(f32::round), [0.0, 0.0, 1.0]);
}
