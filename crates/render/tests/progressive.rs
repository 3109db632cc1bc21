//! Pictures that grow: the same however they came about, with errors that are what they say, and stopped when
//! asked.

mod common;

use std::sync::atomic::{AtomicBool, AtomicU32, Ordering};
use std::time::{Duration, Instant};

use common::channel_of;
use glam::{DAffine3, DVec3, IVec3};
use nuage_render::camera::Camera;
use nuage_render::checkpoint;
use nuage_render::film::{Film, Tally};
use nuage_render::light::Sun;
use nuage_render::progressive::{MIN_NOISE_SAMPLES, Plan, Stopped, Watch, trace};
use nuage_render::scene::{Emission, Phase, Scene, Shape, Spectrum, Volume};
use nuage_volume::channel::Channel;

/// A ball of radius 9 around (8, 8, 8), with soft edges.
fn density() -> Channel {
    let ball = |i: IVec3| (1.0 - (i.as_dvec3() - 8.0).length() / 9.0).max(0.0) as f32;
    channel_of(IVec3::splat(-1), IVec3::splat(17), DAffine3::IDENTITY, ball)
}

/// The ball before nothing, lit by a sun and a sky; it glows a little. Some of the picture is empty.
fn scene(density: &Channel) -> Scene<'_> {
    let camera = Camera::look_at(DVec3::new(8.0, 8.0, 60.0), DVec3::splat(8.0), DVec3::Y, 25.0);
    let emission = Emission { channel: None, spectrum: Spectrum::Linear { rgb: [0.1, 0.05, 0.02] } };
    let volume = Volume {
        shape: Shape::Grid(density),
        coarse: None,
        extinction: [0.3; 3],
        albedo: [0.9, 0.8, 0.7],
        phase: Phase::HenyeyGreenstein { g: 0.3 },
        emission: Some(emission),
    };
    let direction_to = DVec3::new(0.3, 1.0, 0.2).normalize().as_vec3();
    let sun = Sun::point(direction_to, [3.0, 2.5, 2.0]);
    Scene::of_one(camera.expect("a view"), volume, Some(sun), [0.5; 3])
}

fn render(plan: &Plan, [width, height]: [u32; 2]) -> Film {
    let density = density();
    let mut film = Film::new(width, height).expect("a film");
    assert_eq!(trace(&scene(&density), plan, &mut film, &mut Watch::default()), Stopped::Samples);
    film
}

#[test]
fn threads_and_passes_do_not_change_a_bit() {
    let plan = Plan { samples: 12, pass_samples: 12, ..Plan::default() };
    let whole = render(&plan, [50, 33]);
    assert_eq!(whole.samples(), [12, 12]);
    assert!(whole.image().mean().iter().all(|value| *value > 0.01));
    for threads in [1, 2, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a thread pool");
        for pass_samples in [0, 1, 5] {
            let film = pool.install(|| render(&Plan { pass_samples, ..plan }, [50, 33]));
            assert!(film == whole, "{threads} threads, passes of {pass_samples}");
        }
    }
    assert!(render(&Plan { seed: 1, ..plan }, [50, 33]) != whole);
}

/// Cancelled in the middle of a pass, kept as bytes and gone on with: nothing tells.
#[test]
fn a_film_that_was_stopped_and_went_on_is_the_same() {
    let (density, size) = (density(), [50, 33]);
    let scene = scene(&density);
    let plan = Plan { samples: 9, pass_samples: 2, ..Plan::default() };
    let whole = render(&plan, size);
    let mut film = Film::new(size[0], size[1]).expect("a film");
    let mut stops = 0;
    loop {
        let (cancel, tiles) = (AtomicBool::new(false), AtomicU32::new(0));
        // Pictures of 12 tiles, of which some of each pass are done.
        let tile = |_| {
            if tiles.fetch_add(1, Ordering::Relaxed) == 17 {
                cancel.store(true, Ordering::Relaxed);
            }
        };
        let mut watch = Watch { cancel: Some(&cancel), tile: Some(&tile), ..Watch::default() };
        let stopped = trace(&scene, &plan, &mut film, &mut watch);
        let [fewest, most] = film.samples();
        if stopped == Stopped::Samples {
            break;
        }
        assert_eq!(stopped, Stopped::Cancelled);
        assert!(film != whole && fewest <= most && most <= fewest + 2);
        film = checkpoint::decode(&checkpoint::encode(&film, 1), 1).expect("what was encoded");
        stops += 1;
    }
    assert!(stops > 1 && film == whole, "{stops}");
    // More paths than were asked for before.
    trace(&scene, &Plan { samples: 12, ..plan }, &mut film, &mut Watch::default());
    assert!(film == render(&Plan { samples: 12, ..plan }, size));
}

/// Means of many renders differ from each other less than each says it may be off, which is what independent paths would be off:
/// paths that are spread evenly do better.
#[test]
fn standard_errors_are_not_too_small_and_even_paths_are_quieter() {
    const SEEDS: u32 = 200;
    let size = [8, 6];
    let films: Vec<Film> = (0..SEEDS)
        .map(|seed| render(&Plan { seed, samples: 24, pass_samples: 24, ..Plan::default() }, size))
        .collect();
    let images: Vec<_> = films.iter().map(|film| film.image().pixels).collect();
    let errors: Vec<_> = films.iter().map(|film| film.map(Tally::standard_error)).collect();
    let pixels = (size[0] * size[1]) as usize;
    for c in 0..4 {
        let (mut found, mut said) = (0.0, 0.0);
        for i in 0..pixels {
            let mean = images.iter().map(|image| f64::from(image[i][c])).sum::<f64>() / f64::from(SEEDS);
            let squares = images.iter().map(|image| (f64::from(image[i][c]) - mean).powi(2)).sum::<f64>();
            found += squares / f64::from(SEEDS - 1);
            said += errors.iter().map(|error| f64::from(error[i][c]).powi(2)).sum::<f64>() / f64::from(SEEDS);
        }
        // 48 variances, each of 200 means: known to about 1.5 %, somewhat less for light with rare bright
        // paths.
        assert!((0.4..0.9).contains(&(found / said)), "channel {c}: {found} {said}");
    }
}

/// The noise that stops a render is how far off it is, measured against a picture with many more paths.
#[test]
fn noise_stops_when_it_is_low_and_means_what_it_says() {
    let (density, size) = (density(), [12, 12]);
    let scene = scene(&density);
    let until = |noise: f64, pass_samples: u32| {
        let mut film = Film::new(size[0], size[1]).expect("a film");
        let plan = Plan { samples: 4096, noise: Some(noise), pass_samples, ..Plan::default() };
        assert_eq!(trace(&scene, &plan, &mut film, &mut Watch::default()), Stopped::Noise);
        assert!(film.noise() <= noise);
        film
    };
    let (rough, fine) = (until(0.1, 1), until(0.05, 1));
    let [rough_samples, fine_samples] = [&rough, &fine].map(|film| film.samples()[1]);
    // Half the noise takes four times the paths, and some more for pixels in which light is found only then.
    let ratio = f64::from(fine_samples) / f64::from(rough_samples);
    assert!((3.0..5.5).contains(&ratio), "{rough_samples} {fine_samples}");
    assert_eq!(until(1e9, 1).samples(), [MIN_NOISE_SAMPLES; 2]);
    assert_eq!(until(0.05, 32).samples()[1], fine_samples.div_ceil(32) * 32);

    let truth = render(&Plan { seed: 9, samples: 4096, pass_samples: 4096, ..Plan::default() }, size).image();
    let luminance = |p: &[f32; 4]| f64::from(nuage_render::color::luminance([p[0], p[1], p[2]]));
    let fine = fine.image();
    let lit: Vec<(f64, f64)> = (fine.pixels.iter().zip(&truth.pixels))
        .map(|(found, truth)| (luminance(found), luminance(truth)))
        .filter(|(_, truth)| *truth > 0.0)
        .collect();
    let mean = lit.iter().map(|(_, truth)| truth).sum::<f64>() / lit.len() as f64;
    let off = lit.iter().map(|(found, truth)| ((found - truth) / (truth + 0.1 * mean)).powi(2));
    let off = (off.sum::<f64>() / lit.len() as f64).sqrt();
    assert!((0.04..0.065).contains(&off), "{off}");
}

#[test]
fn time_and_cancellation_leave_a_whole_picture() {
    let (density, size) = (density(), [64, 64]);
    let scene = scene(&density);
    let plan = Plan { samples: u32::MAX, ..Plan::default() };
    let mut film = Film::new(size[0], size[1]).expect("a film");
    // No time at all is enough for one path per pixel.
    let at_once = Plan { time: Some(Duration::ZERO), ..plan };
    assert_eq!(trace(&scene, &at_once, &mut film, &mut Watch::default()), Stopped::Time);
    assert_eq!(film.samples(), [1, 1]);
    let start = Instant::now();
    let limit = Duration::from_millis(150);
    let soon = Plan { time: Some(limit), ..plan };
    assert_eq!(trace(&scene, &soon, &mut film, &mut Watch::default()), Stopped::Time);
    let elapsed = start.elapsed();
    // Well beyond what a loaded machine takes for a tile.
    assert!(elapsed >= limit && elapsed < limit + Duration::from_secs(2), "{elapsed:?}");
    let [fewest, most] = film.samples();
    assert!(fewest > 1 && most <= fewest + 1);

    // Each pixel is what it would be with the paths that it has.
    let samples = film.map(|tally| tally.samples);
    let image = film.image();
    for count in [fewest, most] {
        let whole = render(&Plan { samples: count, ..plan }, size).image();
        let same = (0..samples.len()).filter(|i| samples[*i] == count);
        assert!(same.into_iter().all(|i| image.pixels[i] == whole.pixels[i]));
    }

    let cancel = AtomicBool::new(true);
    let mut none = Film::new(size[0], size[1]).expect("a film");
    let mut watch = Watch { cancel: Some(&cancel), ..Watch::default() };
    assert_eq!(trace(&scene, &plan, &mut none, &mut watch), Stopped::Cancelled);
    assert_eq!(none.samples(), [0, 0]);
}

#[test]
fn watchers_see_every_pass_and_shares_that_grow_to_the_end() {
    let density = density();
    let mut film = Film::new(40, 20).expect("a film");
    let shares = std::sync::Mutex::new(Vec::new());
    let mut passes = Vec::new();
    let tile = |share| shares.lock().expect("a lock").push(share);
    let mut pass = |film: &Film| passes.push(film.samples());
    let mut watch = Watch { tile: Some(&tile), pass: Some(&mut pass), ..Watch::default() };
    let plan = Plan { samples: 7, pass_samples: 3, ..Plan::default() };
    trace(&scene(&density), &plan, &mut film, &mut watch);
    assert_eq!(passes, [[3, 3], [6, 6], [7, 7]]);
    let mut shares: Vec<f64> = shares.into_inner().expect("a lock");
    shares.sort_by(f64::total_cmp);
    assert_eq!(shares.len(), 3 * 6);
    assert!(shares[0] > 0.0 && shares[0] < 0.2 && shares[17] == 1.0);
}
