//! Blue noise: a tile of numbers from 0 to 1 of which neighbours differ, so that what is taken by them errs finely, where
//! the eye and a filter smooth it. Made by void and cluster (Ulichney, "The void-and-cluster method for dither array
//! generation", 1993), the same each time.
//!
//! What does not live here: random numbers that are independent (`nuage_render::hash`).

use nuage_render::hash::hash_u32;

/// Pixels along each side of the tile.
pub(crate) const SIDE: u32 = 64;

const PIXELS: usize = (SIDE * SIDE) as usize;

/// How far a pixel is felt, in pixels: Ulichney's choice.
const SIGMA: f32 = 1.5;

/// Further away than this nothing is felt that single precision could hold.
const REACH: i32 = 8;

/// Which pixels are set, and how crowded it is around each.
#[derive(Clone)]
struct Pattern {
    is_set: Vec<bool>,
    crowd: Vec<f32>,
}

impl Pattern {
    fn flip(&mut self, pixel: usize) {
        let side = SIDE as i32;
        let sign = if self.is_set[pixel] { -1.0 } else { 1.0 };
        self.is_set[pixel] = !self.is_set[pixel];
        let (x, y) = (pixel as i32 % side, pixel as i32 / side);
        for dy in -REACH..=REACH {
            for dx in -REACH..=REACH {
                let at = (y + dy).rem_euclid(side) * side + (x + dx).rem_euclid(side);
                let squared = (dx * dx + dy * dy) as f32;
                self.crowd[at as usize] += sign * (-squared / (2.0 * SIGMA * SIGMA)).exp();
            }
        }
    }

    /// The set pixel where it is the most crowded.
    fn cluster(&self) -> usize {
        let set = (0..PIXELS).filter(|pixel| self.is_set[*pixel]);
        set.max_by(|a, b| self.crowd[*a].total_cmp(&self.crowd[*b])).unwrap_or(0)
    }

    /// The pixel that is not set where it is the least crowded.
    fn void(&self) -> usize {
        let free = (0..PIXELS).filter(|pixel| !self.is_set[*pixel]);
        free.min_by(|a, b| self.crowd[*a].total_cmp(&self.crowd[*b])).unwrap_or(0)
    }
}

/// The tile, row by row: each of as many even numbers as there are pixels once.
pub(crate) fn tile() -> Vec<f32> {
    let mut pattern = Pattern { is_set: vec![false; PIXELS], crowd: vec![0.0; PIXELS] };
    let first = PIXELS / 10;
    for i in 0.. {
        if pattern.is_set.iter().filter(|is_set| **is_set).count() == first {
            break;
        }
        let pixel = hash_u32(i + 1) as usize % PIXELS;
        if !pattern.is_set[pixel] {
            pattern.flip(pixel);
        }
    }
    // From clusters to voids until that would undo itself.
    for _ in 0..PIXELS {
        let cluster = pattern.cluster();
        pattern.flip(cluster);
        let void = pattern.void();
        pattern.flip(void);
        if void == cluster {
            break;
        }
    }
    let mut ranks = vec![0; PIXELS];
    let mut thinned = pattern.clone();
    for rank in (0..first).rev() {
        let cluster = thinned.cluster();
        thinned.flip(cluster);
        ranks[cluster] = rank;
    }
    for rank in first..PIXELS {
        let void = pattern.void();
        pattern.flip(void);
        ranks[void] = rank;
    }
    ranks.into_iter().map(|rank| (rank as f32 + 0.5) / PIXELS as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Means over blocks of 4 x 4 differ by far less than those of numbers that are independent, whose deviation is a
    /// quarter of a number's, and each number is there once.
    #[test]
    fn errs_finely() {
        let tile = tile();
        let mut sorted = tile.clone();
        sorted.sort_by(f32::total_cmp);
        assert!(sorted.iter().zip(0..).all(|(value, i)| *value == (i as f32 + 0.5) / PIXELS as f32));
        let side = SIDE as usize;
        let mut squares = 0.0;
        for block in 0..PIXELS / 16 {
            let (x, y) = (block % (side / 4) * 4, block / (side / 4) * 4);
            let mean = (0..16).map(|i| tile[(y + i / 4) * side + x + i % 4]).sum::<f32>() / 16.0;
            squares += (mean - 0.5) * (mean - 0.5);
        }
        let deviation = (squares / (PIXELS / 16) as f32).sqrt();
        let independent = (1.0_f32 / 12.0).sqrt() / 4.0;
        assert!(deviation < 0.5 * independent, "{deviation} of {independent}");
    }
}
