//! The environment against its own densities and against sums over all directions.

use super::*;
use crate::hash::{hash_pixel, unit_f32};

fn draw(i: u32) -> [f32; 2] {
    [unit_f32(hash_pixel(3, 5, i, 0)), unit_f32(hash_pixel(3, 5, i, 1))]
}

/// Texels of every brightness, some black.
fn noisy(width: u32, height: u32) -> Vec<[f32; 3]> {
    let texel = |i: u32| {
        let bright = |c| unit_f32(hash_pixel(i, width, height, c)).powi(6) * 20.0;
        if hash_pixel(i, 1, 1, 9).is_multiple_of(4) { [0.0; 3] } else { [bright(0), bright(1), bright(2)] }
    };
    (0..width * height).map(texel).collect()
}

fn single(width: u32, height: u32, at: [u32; 2], colour: [f32; 3]) -> Vec<[f32; 3]> {
    let mut texels = vec![[0.0; 3]; (width * height) as usize];
    texels[(at[1] * width + at[0]) as usize] = colour;
    texels
}

fn tilted() -> Mat3 {
    orientation(Vec3::new(0.3, -0.5, 0.8), 0.37)
}

fn maps() -> Vec<EnvironmentMap> {
    let sizes = [(1, 1), (1, 7), (16, 8), (33, 17), (2, 1)];
    let noisy = sizes.map(|(w, h)| EnvironmentMap::new(w, h, noisy(w, h), tilted()).unwrap());
    let spots = [[0, 0], [15, 7], [5, 3]].map(|at| single(16, 8, at, [0.0, 0.0, 900.0]));
    let spots = spots.map(|texels| EnvironmentMap::new(16, 8, texels, tilted()).unwrap());
    noisy.into_iter().chain(spots).filter(|map| !map.is_black()).collect()
}

/// Directions of a grid of equal steps in longitude and latitude, with the solid angles that they stand for.
fn grid(width: u32, height: u32) -> impl Iterator<Item = (Vec3, f64)> {
    use std::f64::consts::PI;
    (0..height).flat_map(move |y| {
        let theta = (f64::from(y) + 0.5) / f64::from(height) * PI;
        let edge = |y: u32| (f64::from(y) / f64::from(height) * PI).cos();
        let solid_angle = (edge(y) - edge(y + 1)) * 2.0 * PI / f64::from(width);
        (0..width).map(move |x| {
            let phi = (f64::from(x) + 0.5) / f64::from(width) * 2.0 * PI;
            let d = glam::DVec3::new(theta.sin() * phi.sin(), theta.cos(), theta.sin() * phi.cos());
            (d.as_vec3(), solid_angle)
        })
    })
}

#[test]
fn directions_lie_where_the_convention_says() {
    let looks = |map: Mat3, direction| {
        let texels = (0..32 * 16).map(|i| [(i % 32) as f32, (i / 32) as f32, 0.0]).collect();
        EnvironmentMap::new(32, 16, texels, map).unwrap().radiance(direction)
    };
    let near = |a: Vec3, x: f32, y: f32| (a.x - x).abs() < 1e-3 && (a.y - y).abs() < 1e-3;
    assert!(near(looks(Mat3::IDENTITY, Vec3::Z), 15.5, 7.5));
    assert!(near(looks(Mat3::IDENTITY, Vec3::X), 7.5, 7.5));
    assert!(near(looks(Mat3::IDENTITY, -Vec3::X), 23.5, 7.5));
    assert!(near(looks(Mat3::IDENTITY, -Vec3::Z), 15.5, 7.5), "the mean of both ends");
    assert_eq!(looks(Mat3::IDENTITY, Vec3::Y).y, 0.0);
    assert_eq!(looks(Mat3::IDENTITY, -Vec3::Y).y, 15.0);
    // Turned by a quarter, what was at +Z is at +X; with another up, the top is there.
    assert!(near(looks(orientation(Vec3::Y, 0.25), Vec3::X), 15.5, 7.5));
    assert!(looks(orientation(Vec3::Z * 3.0, 0.1), Vec3::Z).y < 1e-3);
    for up in [Vec3::Y, -Vec3::Y, Vec3::X, -Vec3::Z, Vec3::new(1e-4, -1.0, 1e-4), Vec3::ZERO] {
        let turned = orientation(up, 0.3);
        assert!((turned * turned.transpose()).abs_diff_eq(Mat3::IDENTITY, 1e-5), "{up}");
        assert!((turned.determinant() - 1.0).abs() < 1e-5, "{up}");
        assert!((turned * Vec3::Y).dot(up.try_normalize().unwrap_or(Vec3::Y)) > 0.999_999, "{up}");
    }
}

#[test]
fn densities_integrate_to_one() {
    for map in maps() {
        let total: f64 = grid(1056, 544).map(|(d, sr)| f64::from(map.pdf(d)) * sr).sum();
        assert!((total - 1.0).abs() < 0.02, "{} x {}: {total}", map.width, map.height);
    }
    // Exactly, by the texels' own shares.
    for map in maps() {
        let texels = (0..map.height).flat_map(|y| (0..map.width).map(move |x| (x, y)));
        let total: f64 = texels
            .map(|(x, y)| {
                let (_, row) = parts(&map.row_ends, y as usize);
                let (_, column) = parts(map.row(y), x as usize);
                f64::from(map.density(y, row, column)) * f64::from(map.texel_solid_angle(y))
            })
            .sum();
        assert!((total - 1.0).abs() < 1e-5, "{total}");
    }
}

#[test]
fn samples_follow_the_density() {
    for (map, count) in maps().into_iter().zip(std::iter::repeat(100_000u32)) {
        // Four bins in each texel, found without the map's own help.
        let (columns, rows) = (map.width as usize * 2, map.height as usize * 2);
        let mut counts = vec![0u32; columns * rows];
        for i in 0..count {
            let d = (map.map_from_world * map.sample(draw(i)).unwrap().direction).as_dvec3();
            let u = 0.5 - d.x.atan2(d.z) / std::f64::consts::TAU;
            let v = d.x.hypot(d.z).atan2(d.y) / std::f64::consts::PI;
            let column = ((u * columns as f64) as usize).min(columns - 1);
            counts[((v * rows as f64) as usize).min(rows - 1) * columns + column] += 1;
        }
        let (mut chi_square, mut freedom) = (0.0f64, -1.0f64);
        for (bin, &n) in counts.iter().enumerate() {
            let (x, y) = ((bin % columns / 2) as u32, bin / columns);
            let edge = |y: usize| (y as f64 / rows as f64 * std::f64::consts::PI).cos();
            let solid_angle = (edge(y) - edge(y + 1)) * std::f64::consts::TAU / columns as f64;
            let (_, row_parts) = parts(&map.row_ends, y / 2);
            let (_, column_parts) = parts(map.row((y / 2) as u32), x as usize);
            let density = map.density((y / 2) as u32, row_parts, column_parts);
            let expected = f64::from(density) * solid_angle * f64::from(count);
            if expected < 5.0 {
                assert!(n < 25, "{n} instead of {expected}");
                continue;
            }
            chi_square += (f64::from(n) - expected).powi(2) / expected;
            freedom += 1.0;
        }
        let excess = (chi_square - freedom) / (2.0 * freedom.max(1.0)).sqrt();
        assert!(excess < 4.0, "{} x {}: {excess} standard deviations", map.width, map.height);
    }
}

#[test]
fn samples_say_what_radiance_and_pdf_say() {
    for map in maps() {
        let mut unequal = 0;
        for i in 0..5000 {
            let sample = map.sample(draw(i)).unwrap();
            assert!((sample.direction.length() - 1.0).abs() < 1e-6);
            let off = sample.radiance.distance(map.radiance(sample.direction));
            assert!(off < 1e-3 * (1.0 + sample.radiance.length()), "off by {off}");
            // Rounding may move a direction over an edge.
            unequal += u32::from((map.pdf(sample.direction) / sample.pdf - 1.0).abs() > 1e-6);
        }
        assert!(unequal <= 3, "{unequal} of 5000 in a map of {} x {}", map.width, map.height);
    }
}

#[test]
fn light_over_density_has_the_integral_as_mean() {
    for map in maps() {
        let expected: glam::DVec3 =
            grid(528, 272).map(|(d, sr)| map.radiance(d).as_dvec3() * sr).sum::<glam::DVec3>();
        let count = 40_000;
        let (mut sum, mut squares) = (glam::DVec3::ZERO, glam::DVec3::ZERO);
        for i in 0..count {
            let sample = map.sample(draw(i)).unwrap();
            let weighed = sample.radiance.as_dvec3() / f64::from(sample.pdf);
            (sum, squares) = (sum + weighed, squares + weighed * weighed);
        }
        let mean = sum / f64::from(count);
        let error = ((squares / f64::from(count) - mean * mean).max(glam::DVec3::ZERO) / f64::from(count))
            .map(f64::sqrt);
        let off = (mean - expected).abs();
        let allowed = error * 4.5 + expected * 1e-3;
        assert!(off.cmple(allowed).all(), "{} x {}: {mean} instead of {expected}", map.width, map.height);
    }
}

#[test]
fn one_bright_texel_is_found_by_every_sample() {
    for at in [[0, 0], [40, 20], [63, 31]] {
        let map = EnvironmentMap::new(64, 32, single(64, 32, at, [1e6, 1e6, 1e5]), Mat3::IDENTITY).unwrap();
        for i in 0..2000 {
            let sample = map.sample(draw(i)).unwrap();
            let [x, y] = map.position(sample.direction);
            let across = (x - at[0] as f32 - 0.5).abs();
            let (across, down) = (across.min(64.0 - across), (y - at[1] as f32 - 0.5).abs());
            assert!(across <= 1.501 && down <= 1.501, "{x}, {y}");
            assert!(sample.pdf > 1.0 && sample.pdf.is_finite());
        }
    }
}

#[test]
fn smooth_maps_have_nearly_constant_weights() {
    let texels = grid(64, 32).map(|(d, _)| [1.5 + d.x, 1.5 + d.x, 1.5 + d.x]).collect();
    let map = EnvironmentMap::new(64, 32, texels, tilted()).unwrap();
    for i in 0..2000 {
        let sample = map.sample(draw(i)).unwrap();
        let weight = sample.radiance.x / sample.pdf;
        assert!((weight / (1.5 * 4.0 * PI) - 1.0).abs() < 0.12, "{weight}");
    }
}

#[test]
fn wrong_maps_are_refused_and_black_ones_give_nothing() {
    let new = |width, height, texels| EnvironmentMap::new(width, height, texels, Mat3::IDENTITY);
    let black = new(8, 4, vec![[0.0; 3]; 32]).unwrap();
    assert!(black.is_black());
    assert_eq!(black.sample([0.5, 0.5]), None);
    assert_eq!((black.pdf(Vec3::X), black.radiance(Vec3::X)), (0.0, Vec3::ZERO));
    assert_eq!(new(0, 4, vec![]).err(), Some(EnvironmentError::Size { width: 0, height: 4 }));
    assert!(matches!(new(MAX_SIDE + 1, 1, vec![]), Err(EnvironmentError::Size { .. })));
    assert!(matches!(new(u32::MAX, u32::MAX, vec![]), Err(EnvironmentError::Size { .. })));
    assert_eq!(
        new(2, 2, vec![[1.0; 3]; 3]).err(),
        Some(EnvironmentError::Count { width: 2, height: 2, count: 3 })
    );
    for odd in [-1e-9, f32::NAN, f32::INFINITY, 2e30] {
        let error = new(4, 2, single(4, 2, [3, 1], [0.0, odd, 0.0])).err();
        assert_eq!(error, Some(EnvironmentError::Texel { x: 3, y: 1 }), "{odd}");
    }
    // The largest values, and those that are hardly above 0, have finite densities.
    for value in [MAX_RADIANCE, 1e-38, f32::from_bits(1)] {
        let map = new(4, 2, single(4, 2, [3, 1], [value; 3])).unwrap();
        for i in 0..100 {
            let Some(sample) = map.sample(draw(i)) else { continue };
            assert!(sample.pdf.is_finite() && sample.pdf > 0.0 && sample.radiance.is_finite(), "{value:e}");
        }
    }
    for direction in [Vec3::ZERO, Vec3::NAN, Vec3::INFINITY] {
        let map = new(4, 2, noisy(4, 2)).unwrap();
        let _ = (map.radiance(direction), map.pdf(direction));
    }
}

#[test]
fn dim_texels_beside_bright_ones_keep_a_share() {
    let mut weights = vec![1e-12; 1000];
    weights[500] = 1e12;
    weights[3] = 0.0;
    let mut ends = Vec::new();
    push_ends(&weights, &mut ends);
    for (i, &weight) in weights.iter().enumerate() {
        let (_, count) = parts(&ends, i);
        assert_eq!(count > 0, weight > 0.0, "{i}");
    }
    assert_eq!(ends.last(), Some(&PARTS));
    // Every number chooses an entry that has a chance.
    for u in (0..4096).map(|i| i as f32 / 4096.0).chain([0.0, 1.0 - f32::EPSILON / 2.0, 1.0, f32::NAN]) {
        let (index, within, count) = pick(&ends, u).unwrap();
        assert!(weights[index as usize] > 0.0 && count > 0 && (0.0..1.0).contains(&within), "{u}");
    }
}

#[test]
fn gradient_sky_is_smooth_and_has_the_stated_mean() {
    let sky = GradientSky { zenith: [0.1, 0.2, 0.9], horizon: [0.8, 0.8, 0.7], ground: [0.3, 0.2, 0.1] };
    let up = Vec3::new(1.0, 2.0, -0.5).normalize();
    assert!(gradient_sky(up, up, &sky).distance(Vec3::from_array(sky.zenith)) < 1e-6);
    assert!(gradient_sky(-up, up, &sky).distance(Vec3::from_array(sky.ground)) < 1e-6);
    let level = up.any_orthonormal_vector();
    assert!(gradient_sky(level, up, &sky).distance(Vec3::from_array(sky.horizon)) < 1e-6);
    let mean = grid(400, 400).map(|(d, sr)| gradient_sky(d, up, &sky).as_dvec3() * sr).sum::<glam::DVec3>();
    let mean = mean / (4.0 * std::f64::consts::PI);
    assert!(mean.distance(Vec3::from_array(sky.mean()).as_dvec3()) < 1e-4, "{mean}");
    let at = |s: f32| gradient_sky(up * s + level * (1.0 - s * s).max(0.0).sqrt(), up, &sky);
    for i in -99..99 {
        let (a, b, c) = (at(i as f32 / 100.0 - 0.01), at(i as f32 / 100.0), at(i as f32 / 100.0 + 0.01));
        assert!((a - 2.0 * b + c).length() < 2e-3, "a kink at {i}");
    }
}

#[test]
fn uniform_directions_cover_the_sphere() {
    let mean = (0..20_000).map(|i| uniform_direction(draw(i)).as_dvec3()).sum::<glam::DVec3>() / 20_000.0;
    let up = (0..20_000).filter(|&i| uniform_direction(draw(i)).y > 0.5).count();
    assert!(mean.length() < 0.02 && (up as f64 / 20_000.0 - 0.25).abs() < 0.012);
}
