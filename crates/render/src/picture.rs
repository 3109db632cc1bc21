//! From a scene to a picture: pixels, samples and tiles on all cores.
//!
//! Each pixel depends on its own coordinates alone, so the picture is the same for any number of threads.

use glam::DVec2;

use crate::film::{Image, ImageSizeError};
use crate::hash::{hash_pixel, hash_u32, unit_f32};
use crate::march::{Marcher, Quality, Worker};
use crate::path::{PathSettings, PathTracer, PathWorker};
use crate::scene::Scene;

/// Pixels per side of a tile, the unit of work of a thread.
const TILE: u32 = 16;

/// Renders a scene by marching. The picture's alpha is 1 − transmittance; nothing stands behind the medium yet.
///
/// `progress` is called with tiles done and tiles in all, from any thread.
///
/// # Errors
/// If the picture has no pixels or too many.
pub fn render<'s>(
    scene: &'s Scene<'s>,
    quality: Quality,
    width: u32,
    height: u32,
    progress: &(dyn Fn(u32, u32) + Sync),
) -> Result<Image, ImageSizeError> {
    let mut image = Image::new(width, height)?;
    let marcher = Marcher::new(scene, quality);
    let samples = quality.samples.max(1);
    let pixel = |worker: &mut Worker<'s>, x: u32, y: u32| {
        let mut sum = [0.0; 4];
        for sample in 0..samples {
            let offset = pixel_offset(x, y, sample, samples);
            let ray = scene.camera.ray(DVec2::new(x.into(), y.into()) + offset, width, height);
            let light = marcher.radiance(worker, &ray, hash_pixel(x, y, sample, 2));
            let [r, g, b] = light.scattered.to_array();
            for (sum, value) in sum.iter_mut().zip([r, g, b, 1.0 - light.transmittance]) {
                *sum += value;
            }
        }
        sum.map(|value| value / samples as f32)
    };
    image.pixels = each_pixel([width, height], || marcher.worker(), pixel, progress);
    Ok(image)
}

/// A picture made of paths.
#[derive(Debug, Clone, PartialEq)]
pub struct Traced {
    /// The means over all paths of a pixel; alpha is 1 − transmittance.
    pub image: Image,
    /// The standard error of each mean, as far as the paths of the pixel tell; 0 where there is only one.
    pub standard_error: Vec<[f32; 4]>,
}

/// Renders a scene by tracing `paths` paths per pixel. Nothing stands behind the medium yet. Pictures of different seeds are
/// independent.
///
/// `progress` is called with tiles done and tiles in all, from any thread.
///
/// # Errors
/// If the picture has no pixels or too many.
pub fn trace<'s>(
    scene: &'s Scene<'s>,
    settings: PathSettings,
    paths: u32,
    seed: u32,
    [width, height]: [u32; 2],
    progress: &(dyn Fn(u32, u32) + Sync),
) -> Result<Traced, ImageSizeError> {
    let mut image = Image::new(width, height)?;
    let tracer = PathTracer::new(scene, settings);
    let paths = paths.max(1);
    let pixel = |worker: &mut PathWorker<'s>, x: u32, y: u32| {
        // Welford's method: sums of squares would lose the small differences of bright pixels.
        let (mut mean, mut spread) = ([0.0_f64; 4], [0.0_f64; 4]);
        for path in 0..paths {
            let number = |dimension| hash_pixel(x, y, path, hash_u32(seed).wrapping_add(dimension));
            let offset = DVec2::new(unit_f32(number(0)).into(), unit_f32(number(1)).into());
            let ray = scene.camera.ray(DVec2::new(x.into(), y.into()) + offset, width, height);
            let sample = tracer.sample(worker, &ray, number(2));
            let [r, g, b] = sample.light().to_array();
            for (i, value) in [r, g, b, f32::from(!sample.passed)].into_iter().enumerate() {
                let from_mean = f64::from(value) - mean[i];
                mean[i] += from_mean / f64::from(path + 1);
                spread[i] += from_mean * (f64::from(value) - mean[i]);
            }
        }
        let freedom = f64::from(paths) * f64::from(paths.max(2) - 1);
        (mean.map(|mean| mean as f32), spread.map(|spread| (spread / freedom).sqrt() as f32))
    };
    let pixels = each_pixel([width, height], || tracer.worker(), pixel, progress);
    let (means, standard_error) = pixels.into_iter().unzip();
    image.pixels = means;
    Ok(Traced { image, standard_error })
}

/// What `pixel` makes of each pixel, row by row, on all cores. Each thread has a worker of its own.
pub(crate) fn each_pixel<W, P: Copy + Default + Send>(
    [width, height]: [u32; 2],
    worker: impl Fn() -> W + Sync + Send,
    pixel: impl Fn(&mut W, u32, u32) -> P + Sync + Send,
    progress: &(dyn Fn(u32, u32) + Sync),
) -> Vec<P> {
    let (columns, rows) = (width.div_ceil(TILE), height.div_ceil(TILE));
    let done = std::sync::atomic::AtomicU32::new(0);
    let corner = |tile: u32| [tile % columns * TILE, tile / columns * TILE];
    let make_tile = |worker: &mut W, tile: u32| -> Vec<P> {
        let [left, top] = corner(tile);
        let [across, down] = [TILE.min(width - left), TILE.min(height - top)];
        let pixels = (0..across * down).map(|i| pixel(worker, left + i % across, top + i / across));
        let pixels = pixels.collect();
        let done = done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1;
        progress(done, columns * rows);
        pixels
    };
    #[cfg(feature = "parallel")]
    let tiles: Vec<Vec<P>> = {
        use rayon::prelude::*;
        (0..columns * rows).into_par_iter().map_init(worker, make_tile).collect()
    };
    #[cfg(not(feature = "parallel"))]
    let tiles: Vec<Vec<P>> = {
        let mut worker = worker();
        (0..columns * rows).map(|tile| make_tile(&mut worker, tile)).collect()
    };
    let mut all = vec![P::default(); width as usize * height as usize];
    for (tile, pixels) in (0..).zip(&tiles) {
        let [left, top] = corner(tile);
        let across = TILE.min(width - left) as usize;
        for (row, pixels) in (top as usize..).zip(pixels.chunks(across)) {
            let begin = row * width as usize + left as usize;
            all[begin..begin + across].copy_from_slice(pixels);
        }
    }
    all
}

/// Where in its pixel a sample lies: the centre if it is the only one, else spread evenly (the additive
/// recurrence of the plastic number, turned per pixel).
fn pixel_offset(x: u32, y: u32, sample: u32, samples: u32) -> DVec2 {
    if samples <= 1 {
        return DVec2::splat(0.5);
    }
    let spread = |dimension, step: u32| {
        let start = hash_pixel(x, y, 0, dimension);
        f64::from(unit_f32(start.wrapping_add(sample.wrapping_mul(step))))
    };
    DVec2::new(spread(0, 0xc13f_a9a9), spread(1, 0x91e1_0da5))
}
