//! From a scene to a picture in one go, on all cores. Pictures of paths, which grow, are
//! [`progressive`](crate::progressive)'s.
//!
//! Each pixel depends on its own coordinates alone, so the picture is the same for any number of threads.

use std::sync::atomic::{AtomicU32, Ordering};

use glam::DVec2;

use crate::film::{Image, ImageSizeError};
use crate::hash::{PLASTIC_STEPS, hash_pixel, unit_f32};
use crate::march::{Marcher, Quality, Worker};
use crate::packet::RAYS;
use crate::scene::Scene;
use crate::tiling::Tiling;

/// Renders a scene by marching. The picture's alpha is 1 − transmittance; nothing stands behind the medium
/// yet.
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

/// What `pixel` makes of each pixel, row by row, on all cores. Each thread has a worker of its own.
pub(crate) fn each_pixel<W>(
    [width, height]: [u32; 2],
    worker: impl Fn() -> W + Sync + Send,
    pixel: impl Fn(&mut W, u32, u32) -> [f32; 4] + Sync + Send,
    progress: &(dyn Fn(u32, u32) + Sync),
) -> Vec<[f32; 4]> {
    let tiling = Tiling { width, height };
    let mut tiles = vec![Vec::new(); tiling.count() as usize];
    let done = AtomicU32::new(0);
    each_tile(&mut tiles, worker, |worker, index, tile: &mut Vec<[f32; 4]>| {
        tile.extend(tiling.pixels(index).map(|[x, y]| pixel(worker, x, y)));
        progress(done.fetch_add(1, Ordering::Relaxed) + 1, tiling.count());
    });
    tiling.rows(tiles)
}

/// What `packet` makes of each square of pixels, row by row as those of [`each_pixel`]. Squares at the right and at the bottom
/// may reach beyond the picture.
pub(crate) fn each_packet<W>(
    [width, height]: [u32; 2],
    worker: impl Fn() -> W + Sync + Send,
    packet: impl Fn(&mut W, &[[u32; 2]; RAYS]) -> [[f32; 4]; RAYS] + Sync + Send,
    progress: &(dyn Fn(u32, u32) + Sync),
) -> Vec<[f32; 4]> {
    let tiling = Tiling { width, height };
    let mut tiles = vec![Vec::new(); tiling.count() as usize];
    let done = AtomicU32::new(0);
    each_tile(&mut tiles, worker, |worker, index, tile: &mut Vec<([u32; 2], [f32; 4])>| {
        for pixels in tiling.squares(index) {
            tile.extend(pixels.into_iter().zip(packet(worker, &pixels)));
        }
        progress(done.fetch_add(1, Ordering::Relaxed) + 1, tiling.count());
    });
    let mut all = vec![[0.0; 4]; width as usize * height as usize];
    for ([x, y], pixel) in tiles.into_iter().flatten().filter(|([x, y], _)| *x < width && *y < height) {
        all[y as usize * width as usize + x as usize] = pixel;
    }
    all
}

/// Does some work on every tile, by the threads of the pool this is called in. Each thread has a worker of its own, and takes the
/// next tiles in order whenever it has none.
pub fn each_tile<W, T: Send>(
    tiles: &mut [T],
    worker: impl Fn() -> W + Sync + Send,
    work: impl Fn(&mut W, u32, &mut T) + Sync + Send,
) {
    #[cfg(feature = "parallel")]
    {
        use std::sync::{Mutex, PoisonError};

        // Neighbours that a thread takes at once, so that it finds what their rays read in its own cache; and how often each takes
        // some at least, so that none waits long for another at the end.
        const MOST_TOGETHER: usize = 16;
        const LEAST_TURNS: usize = 16;
        let threads = rayon::current_num_threads();
        let together = (tiles.len() / (threads * LEAST_TURNS)).clamp(1, MOST_TOGETHER);
        let left = Mutex::new((0..).step_by(together).zip(tiles.chunks_mut(together)));
        let take = || left.lock().unwrap_or_else(PoisonError::into_inner).next();
        rayon::scope(|scope| {
            for _ in 0..threads {
                scope.spawn(|_| {
                    let mut own = None;
                    while let Some((first, tiles)) = take() {
                        let own = own.get_or_insert_with(&worker);
                        (first..).zip(tiles).for_each(|(index, tile)| work(own, index, tile));
                    }
                });
            }
        });
    }
    #[cfg(not(feature = "parallel"))]
    {
        let mut worker = worker();
        (0..).zip(tiles).for_each(|(index, tile)| work(&mut worker, index, tile));
    }
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
    DVec2::new(spread(0, PLASTIC_STEPS[0]), spread(1, PLASTIC_STEPS[1]))
}
