//! From a scene to a picture: pixels, samples and tiles on all cores.
//!
//! Each pixel depends on its own coordinates alone, so the picture is the same for any number of threads.

use glam::DVec2;

use crate::film::{Image, ImageSizeError};
use crate::hash::{hash_pixel, unit_f32};
use crate::march::{Marcher, Quality, Worker};
use crate::scene::Scene;

/// Pixels per side of a tile, the unit of work of a thread.
const TILE: u32 = 16;

/// Renders a scene. The picture's alpha is 1 − transmittance; nothing stands behind the medium yet.
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
    let (columns, rows) = (width.div_ceil(TILE), height.div_ceil(TILE));
    let done = std::sync::atomic::AtomicU32::new(0);
    let render_tile = |worker: &mut Worker<'s>, tile: u32| -> Image {
        let (left, top) = (tile % columns * TILE, tile / columns * TILE);
        let size = [TILE.min(width - left), TILE.min(height - top)];
        let mut part = Image::new(size[0], size[1]).expect("a tile is smaller than its picture");
        for (i, pixel) in part.pixels.iter_mut().enumerate() {
            let (x, y) = (left + i as u32 % size[0], top + i as u32 / size[0]);
            let mut sum = [0.0; 4];
            for sample in 0..quality.samples.max(1) {
                let offset = pixel_offset(x, y, sample, quality.samples);
                let ray = scene.camera.ray(DVec2::new(x.into(), y.into()) + offset, width, height);
                let light = marcher.radiance(worker, &ray, hash_pixel(x, y, sample, 2));
                let [r, g, b] = light.scattered.to_array();
                for (sum, value) in sum.iter_mut().zip([r, g, b, 1.0 - light.transmittance]) {
                    *sum += value;
                }
            }
            *pixel = sum.map(|value| value / quality.samples.max(1) as f32);
        }
        let done = done.fetch_add(1, std::sync::atomic::Ordering::Relaxed) + 1;
        progress(done, columns * rows);
        part
    };
    #[cfg(feature = "parallel")]
    let tiles: Vec<Image> = {
        use rayon::prelude::*;
        (0..columns * rows).into_par_iter().map_init(|| marcher.worker(), render_tile).collect()
    };
    #[cfg(not(feature = "parallel"))]
    let tiles: Vec<Image> = {
        let mut worker = marcher.worker();
        (0..columns * rows).map(|tile| render_tile(&mut worker, tile)).collect()
    };
    for (tile, part) in (0u32..).zip(&tiles) {
        image.blit(part, tile % columns * TILE, tile / columns * TILE);
    }
    Ok(image)
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
