//! Pictures that grow: paths in passes over all pixels, until there are enough of them, the noise is low,
//! time is up or somebody calls it off.
//!
//! Path number i of a pixel depends on the pixel, i and the seed alone, and the tally of a pixel on its own
//! paths in their order. So a film is the same, bit for bit, for any number of threads, passes of any size,
//! and a render that was stopped and went on.
//!
//! The paths of a pixel are spread evenly ([`sampler`](crate::sampler)), so that their mean is less noisy than that of independent
//! ones. Standard errors and noise are those of independent paths: never too small in the mean, and by up to two fifths too large where a
//! pixel holds an edge.
//!
//! All pixels get the same number of paths. To give more to those that look noisy would bias the picture: a
//! pixel whose first paths all miss a rare bright event looks quiet, gets no more of them and stays too dark.
//! Where the whole picture stops by its noise, the same holds to a degree that drowns in it.
//!
//! What does not live here: files of what was not finished ([`checkpoint`](crate::checkpoint)), and signals.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::time::{Duration, Instant};

use glam::DVec2;

use crate::film::Film;
use crate::path::{PathSettings, PathTracer, PathWorker};
use crate::picture::each_tile;
use crate::sampler::Sampler;
use crate::scene::Scene;

/// The noise of fewer paths per pixel is not believed.
pub const MIN_NOISE_SAMPLES: u32 = 16;

/// Which paths are traced, and when there are enough.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Plan {
    /// How paths are made.
    pub settings: PathSettings,
    /// Pictures of different seeds are independent.
    pub seed: u32,
    /// Paths per pixel in a pass. Between passes it is decided whether to go on.
    pub pass_samples: u32,
    /// The most paths per pixel, those counted that the film has already.
    pub samples: u32,
    /// Stop when [`Film::noise`] is no more than this, but not before [`MIN_NOISE_SAMPLES`] paths per pixel.
    pub noise: Option<f64>,
    /// Stop when this long has passed since the call. A pass that it cuts short leaves some pixels without
    /// their paths of this pass; but every pixel gets its first.
    pub time: Option<Duration>,
}

impl Default for Plan {
    /// 64 paths per pixel, in passes of one.
    fn default() -> Self {
        Plan {
            settings: PathSettings::default(),
            seed: 0,
            pass_samples: 1,
            samples: 64,
            noise: None,
            time: None,
        }
    }
}

/// Who looks on while a picture grows; nobody by default.
#[derive(Default)]
pub struct Watch<'w> {
    /// Set it to true, from anywhere, and the render ends as soon as the tiles in work are done.
    pub cancel: Option<&'w AtomicBool>,
    /// Called after each tile, from any thread, with the share of the work that is done, as far as can be
    /// foreseen.
    pub tile: Option<&'w (dyn Fn(f64) + Sync)>,
    /// Called after each pass, and after one that was cut short, with the film so far.
    pub pass: Option<&'w mut dyn FnMut(&Film)>,
}

/// Why a render ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Stopped {
    /// Every pixel has its paths.
    Samples,
    /// The noise is low enough.
    Noise,
    /// Time is up.
    Time,
    /// It was called off. Pixels may have different numbers of paths, or none.
    Cancelled,
}

/// Traces paths into a film, from where it stands, until one of the plan's ends is met.
pub fn trace<'s>(scene: &'s Scene<'s>, plan: &Plan, film: &mut Film, watch: &mut Watch<'_>) -> Stopped {
    let tiling = film.tiling;
    let tracer = PathTracer::new(scene, plan.settings);
    let start = plan.time.map(|limit| (Instant::now(), limit));
    // The share of the time that has passed; all of it for a time of nothing.
    let time_share = || {
        start.map_or(0.0, |(start, limit)| {
            let share = start.elapsed().as_secs_f64() / limit.as_secs_f64();
            if share.is_nan() { 1.0 } else { share }
        })
    };
    let (cancel, tile_done) = (watch.cancel, watch.tile);
    let cancelled = || cancel.is_some_and(|cancel| cancel.load(Ordering::Relaxed));
    let path = |worker: &mut PathWorker<'s>, x: u32, y: u32, number: u32| {
        let mut numbers = Sampler::new(x, y, number, plan.seed);
        let [u, v] = numbers.next_2d().map(f64::from);
        let at = DVec2::new(f64::from(x) + u, f64::from(y) + v);
        let ray = scene.camera.ray(at, tiling.width, tiling.height);
        tracer.sample(worker, &ray, numbers)
    };
    let pass_samples = plan.pass_samples.max(1);
    let pixels = f64::from(tiling.width) * f64::from(tiling.height);
    // Paths per pixel that will be enough, as far as can be foreseen.
    let mut foreseen = f64::from(plan.samples.max(1));
    loop {
        let [fewest, most] = film.samples();
        if fewest >= plan.samples {
            return Stopped::Samples;
        }
        // Only between whole passes, so that a render that was stopped and went on ends where it would have.
        let between = fewest == most && fewest.is_multiple_of(pass_samples);
        if let Some(target) = plan.noise.filter(|_| between && fewest >= MIN_NOISE_SAMPLES) {
            let noise = film.noise();
            if noise <= target {
                return Stopped::Noise;
            }
            foreseen = (f64::from(fewest) * (noise / target).powi(2)).min(f64::from(plan.samples));
        }
        if cancelled() {
            return Stopped::Cancelled;
        }
        let may_end = fewest > 0;
        if may_end && time_share() >= 1.0 {
            return Stopped::Time;
        }
        let goal = (fewest / pass_samples + 1).saturating_mul(pass_samples).min(plan.samples);
        let done = AtomicU64::new(film.tiles.iter().flatten().map(|tally| u64::from(tally.samples)).sum());
        each_tile(
            &mut film.tiles,
            || tracer.worker(),
            |worker, index, tile| {
                if cancelled() || may_end && time_share() >= 1.0 {
                    return;
                }
                let mut added = 0;
                for ([x, y], tally) in tiling.pixels(index).zip(tile) {
                    while tally.samples < goal {
                        tally.add(&path(worker, x, y, tally.samples));
                        added += 1;
                    }
                }
                let done = done.fetch_add(added, Ordering::Relaxed) + added;
                if let Some(tell) = tile_done {
                    tell((done as f64 / (pixels * foreseen)).max(time_share()).min(1.0));
                }
            },
        );
        if let Some(tell) = &mut watch.pass {
            tell(film);
        }
    }
}
