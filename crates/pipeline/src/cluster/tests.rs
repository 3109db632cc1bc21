//! Properties of both ways of clustering, over made-up bricks.

use std::f32::consts::PI;

use super::shapes::{self, Shapes};
use super::thesis::{self, Clusters, KMeans, Rejection};
use super::*;

/// A number in -1..1.
fn number(seed: u64, i: usize) -> f32 {
    (random(seed, i as u64) >> 40) as f32 / (1 << 23) as f32 - 1.0
}

/// Bricks around a few levels: most are nearly flat, some slope, a few are rough.
fn smoke(count: usize, seed: u64) -> Vec<Brick> {
    let brick = |i: usize| -> Brick {
        let of = |k: usize| number(seed, i * 1024 + k);
        let rough = if i % 7 == 3 { 0.5 } else { 0.005 };
        let slope = [of(0), of(1), of(2)].map(|s| s * 0.2 * (i % 3) as f32);
        std::array::from_fn(|voxel| {
            let p = [voxel >> 6, voxel >> 3 & 7, voxel & 7].map(|k| k as f32 / 8.0);
            (0.6 + 0.4 * of(3) + slope[0] * p[0] + slope[1] * p[1] + slope[2] * p[2] + rough * of(9 + voxel))
                .max(0.0)
        })
    };
    (0..count).map(brick).collect()
}

fn thesis_settings(clusters: usize) -> thesis::Settings {
    let rejection = Rejection::VarianceOverMean;
    thesis::Settings { clusters, iterations: 4, rejection, threshold: 0.02, seed: 3 }
}

fn shape_settings(shapes: usize, max_error: f32) -> shapes::Settings {
    shapes::Settings { shapes, iterations: 4, max_error, max_mse: f32::INFINITY, seed: 3 }
}

/// Bricks that no arithmetic should be tried with, among others.
fn wild() -> Vec<Brick> {
    let mut bricks = smoke(40, 8);
    for (i, value) in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX, -1e20].into_iter().enumerate() {
        bricks[3 * i][100 * i] = value;
    }
    bricks.extend([
        [f32::MAX; BRICK_VOXELS],
        [f32::NAN; BRICK_VOXELS],
        [0.0; BRICK_VOXELS],
        [1e15; BRICK_VOXELS],
    ]);
    bricks.push([f32::MIN_POSITIVE / 8.0; BRICK_VOXELS]);
    bricks
}

/// The mean squared and the largest difference, in double precision.
fn errors(a: &Brick, b: &Brick) -> (f64, f64) {
    let each = || a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs());
    (each().map(|e| e * e).sum::<f64>() / BRICK_VOXELS as f64, each().fold(0.0, f64::max))
}

fn with_threads<T: Send>(threads: usize, run: impl FnOnce() -> T + Send) -> T {
    #[cfg(feature = "parallel")]
    return rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap().install(run);
    #[cfg(not(feature = "parallel"))]
    {
        let _ = threads;
        run()
    }
}

#[test]
fn measures_are_those_of_the_definition() {
    // Half of the values are a, half are b: the variance is a quarter of the square of the difference.
    let halves = |a: f32, b: f32| -> Brick { std::array::from_fn(|i| if i % 2 == 0 { a } else { b }) };
    let near = |a: f32, b: f32| (a - b).abs() <= 1e-6 * b.abs();
    for (a, b) in [(0.0, 1.0), (2.0, 2.5), (-1.0, 4.0), (1e-3, 2e-3)] {
        assert!(near(Rejection::NormalizedVariance.measure(&halves(a, b)), 0.25));
        let expected = (b - a).powi(2) / 4.0 / ((a + b) / 2.0).abs();
        assert!(near(Rejection::VarianceOverMean.measure(&halves(a, b)), expected));
    }
    for rejection in [Rejection::NormalizedVariance, Rejection::VarianceOverMean] {
        assert_eq!(rejection.measure(&[0.0; BRICK_VOXELS]), 0.0);
        assert_eq!(rejection.measure(&[0.3; BRICK_VOXELS]), 0.0);
        assert_eq!(rejection.measure(&halves(1.0, f32::NAN)), f32::INFINITY);
        assert_eq!(rejection.measure(&halves(1.0, f32::MAX)), f32::INFINITY);
    }
    assert_eq!(Rejection::VarianceOverMean.measure(&halves(-1.0, 1.0)), f32::INFINITY);
}

#[test]
fn bricks_go_to_the_nearest_centre_and_varied_ones_are_kept() {
    for (rejection, threshold) in [(Rejection::NormalizedVariance, 0.06), (Rejection::VarianceOverMean, 0.02)]
    {
        let bricks = smoke(300, 1);
        let settings = thesis::Settings { rejection, threshold, ..thesis_settings(12) };
        let Clusters { centres, of_brick } = thesis::cluster(&bricks, &settings);
        assert_eq!((centres.len(), of_brick.len()), (12, bricks.len()));
        for (brick, centre) in bricks.iter().zip(&of_brick) {
            assert_eq!(centre.is_none(), rejection.measure(brick) > settings.threshold);
            let Some(centre) = centre else { continue };
            let own = thesis::distance(brick, &centres[*centre as usize]);
            assert!(centres.iter().all(|other| own <= thesis::distance(brick, other)));
        }
        assert!(of_brick.iter().any(Option::is_some) && of_brick.iter().any(Option::is_none));
    }
}

#[test]
fn bounds_change_nothing_in_k_means() {
    for seed in 0..6 {
        let bricks = smoke(400, seed);
        let all: Vec<usize> = (0..bricks.len()).collect();
        let centres = thesis::first_centres(&bricks, &all, 3 + 7 * seed as usize, seed);
        let fast = thesis::k_means(&bricks, &all, centres.clone(), 5);
        let plain = thesis::plain_k_means(&bricks, &all, centres, 5);
        assert_eq!(fast.nearest, plain.nearest);
        let close = |(a, b): (&Brick, &Brick)| errors(a, b).1 <= 1e-6;
        assert!(fast.centres.iter().zip(&plain.centres).all(close));
    }
}

#[test]
fn of_centres_equally_near_the_first_is_taken() {
    // Small whole numbers, of which all sums are exact, and each centre twice.
    for seed in 0..20 {
        let whole = |i: usize| -> Brick {
            let level = random(seed, i as u64) % 5;
            std::array::from_fn(|voxel| (level + random(seed, (i * 512 + voxel) as u64) % 3) as f32)
        };
        let bricks: Vec<Brick> = (0..60).map(whole).collect();
        let all: Vec<usize> = (0..bricks.len()).collect();
        let mut centres = bricks[..20].to_vec();
        centres.extend_from_within(..);
        centres.extend((0..10).map(|i| [i as f32; BRICK_VOXELS]));
        let KMeans { nearest, .. } = thesis::k_means(&bricks, &all, centres.clone(), 0);
        assert_eq!(nearest, thesis::plain_k_means(&bricks, &all, centres, 0).nearest);
    }
}

#[test]
fn shared_bricks_meet_both_bounds() {
    let bricks = smoke(600, 5);
    let mut shared_bricks = 0;
    for (max_error, max_mse) in [(0.02, f32::INFINITY), (0.05, 1e-4), (1.0, 1e-5), (0.0, 1.0), (0.1, 0.0)] {
        let settings = shapes::Settings { max_mse, ..shape_settings(20, max_error) };
        let Shapes { shapes, of_brick } = shapes::share(&bricks, &settings);
        assert!(shapes.len() <= 20 && of_brick.len() == bricks.len());
        assert!(shapes.iter().flatten().all(|value| value.abs() <= 1.0));
        let mut users = vec![0; shapes.len()];
        for (brick, shared) in bricks.iter().zip(&of_brick) {
            let Some(shared) = shared else { continue };
            users[shared.shape as usize] += 1;
            shared_bricks += 1;
            let (mse, largest) = errors(brick, &shared.values(&shapes[shared.shape as usize]));
            assert!(largest <= f64::from(max_error) * (1.0 + 1e-6), "{largest} over {max_error}");
            assert!(mse <= f64::from(max_mse) * (1.0 + 1e-5), "{mse} over {max_mse}");
        }
        assert!(users.iter().all(|users| *users >= 2));
    }
    assert!(shared_bricks > 600);
}

#[test]
fn scaled_copies_share_one_shape() {
    let wave = |voxel: usize, frequency: f32| (frequency * PI * (voxel as f32 + 0.5) / 8.0).cos();
    let smooth: Brick = std::array::from_fn(|voxel| {
        let [x, y, z] = [voxel >> 6, voxel >> 3 & 7, voxel & 7];
        wave(x, 1.0) + 0.5 * wave(y, 2.0) * wave(z, 1.0) - 0.2 * wave(z, 3.0)
    });
    let copy = |i: usize| smooth.map(|value| i as f32 + (i as f32 - 20.5) / 20.0 * value);
    let bricks: Vec<Brick> = (0..40).map(copy).collect();
    let Shapes { shapes, of_brick } = shapes::share(&bricks, &shape_settings(5, 0.01));
    assert_eq!(shapes.len(), 1);
    assert!(of_brick.iter().all(Option::is_some));
}

#[test]
fn bricks_of_which_none_describes_another_share_what_is_flat() {
    let wave = |shift: usize| -> Brick {
        std::array::from_fn(|voxel| 0.1732 * (PI * ((voxel >> shift & 7) as f32 + 0.5) / 8.0).cos())
    };
    let bricks = [wave(6), wave(3), wave(0)];
    let found = shapes::share(&bricks, &shape_settings(10, 0.5));
    assert_eq!(found.shapes.len(), 1);
    assert!(found.of_brick.iter().all(Option::is_some));
}

#[test]
fn threads_and_repetition_change_nothing() {
    let bricks = smoke(1500, 2);
    let run = || {
        let clusters = thesis::cluster(&bricks, &thesis_settings(10));
        (clusters, shapes::share(&bricks, &shape_settings(10, 0.02)))
    };
    let once = with_threads(1, run);
    assert!(once == with_threads(2, run) && once == with_threads(5, run) && once == with_threads(1, run));
    // Another seed does make a difference, so that the comparison can fail.
    assert!(thesis::cluster(&bricks, &thesis::Settings { seed: 4, ..thesis_settings(10) }) != once.0);
}

#[test]
fn tiny_input_and_odd_settings_are_fine() {
    let flat = [[0.25; BRICK_VOXELS], [0.5; BRICK_VOXELS], [0.0; BRICK_VOXELS], [0.5; BRICK_VOXELS]];
    for count in 0..=flat.len() {
        for clusters in [0, 1, 3, 100, usize::MAX] {
            let found = thesis::cluster(&flat[..count], &thesis_settings(clusters));
            assert_eq!(found.centres.len(), clusters.min(count));
            assert!(found.of_brick.iter().all(|centre| centre.is_some() == (clusters > 0)));
            // Constant bricks share any one shape, without an error.
            let found = shapes::share(&flat[..count], &shape_settings(clusters, 0.0));
            assert_eq!(found.shapes.len(), usize::from(clusters > 0 && count > 1));
            for (brick, shared) in flat.iter().zip(&found.of_brick) {
                assert!(shared.is_some() == (clusters > 0 && count > 1));
                assert!(shared.is_none_or(|shared| shared.values(&found.shapes[0]) == *brick));
            }
        }
    }
    let bricks = smoke(20, 1);
    for threshold in [f32::NAN, -1.0, f32::NEG_INFINITY] {
        let settings = thesis::Settings { threshold, ..thesis_settings(4) };
        assert_eq!(thesis::cluster(&bricks, &settings).of_brick, vec![None; 20]);
    }
    for (max_error, max_mse) in [(f32::NAN, 1.0), (1.0, f32::NAN), (-1.0, 1.0), (1.0, -1.0)] {
        let settings = shapes::Settings { max_mse, ..shape_settings(4, max_error) };
        assert_eq!(shapes::share(&bricks, &settings).of_brick, vec![None; 20]);
    }
}

#[test]
fn wild_values_are_kept_and_spread_nowhere() {
    let bricks = wild();
    let is_wild = |brick: &Brick| brick.iter().any(|v| v.is_nan() || v.abs() > MAX_MAGNITUDE);
    for threshold in [0.02, f32::MAX, f32::INFINITY] {
        let settings = thesis::Settings { threshold, ..thesis_settings(8) };
        let found = thesis::cluster(&bricks, &settings);
        assert!(found.centres.iter().flatten().all(|value| value.is_finite()));
        assert!(bricks.iter().zip(&found.of_brick).all(|(brick, to)| !is_wild(brick) || to.is_none()));
    }
    for max_error in [0.02, 1e10, f32::MAX, f32::INFINITY] {
        let found = shapes::share(&bricks, &shape_settings(8, max_error));
        assert!(found.shapes.iter().flatten().all(|value| value.is_finite()));
        assert!(bricks.iter().zip(&found.of_brick).all(|(brick, to)| !is_wild(brick) || to.is_none()));
        let numbers = found.of_brick.iter().flatten().flat_map(|shared| [shared.scale, shared.bias]);
        assert!(numbers.into_iter().all(f32::is_finite));
    }
}
