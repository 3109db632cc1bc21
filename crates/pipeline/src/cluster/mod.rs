//! Bricks that are alike, so that fewer of them need be kept: lossy, and only on request.
//!
//! [`thesis`] replaces nearly homogeneous bricks by the centres of k-means; [`shapes`] lets bricks share a
//! shape and gives each its own scale and bias, within a bound on the error. Both are pure functions on
//! bricks. What does not live here: how shared bricks are stored in a volume, and when to share them.

pub mod shapes;
pub mod thesis;

use nuage_volume::space::BRICK_VOXELS;

/// The values of 8³ voxels.
pub type Brick = [f32; BRICK_VOXELS];

/// Bricks with larger values than this, or with values that are not numbers, are kept as they are: sums of
/// squares of theirs would leave the range of f32.
pub const MAX_MAGNITUDE: f32 = 1e15;

/// How many sums run side by side, so that the loops become vector instructions.
const LANES: usize = 16;

/// Whether all values can be computed with.
fn is_tame(brick: &Brick) -> bool {
    // Without a branch in the loop; the comparison is false for NaN.
    brick.iter().fold(true, |all, value| all & (value.abs() <= MAX_MAGNITUDE))
}

/// The sum of `term` over the voxels of two bricks, always in the same order.
fn sum(a: &Brick, b: &Brick, term: impl Fn(f32, f32) -> f32) -> f32 {
    let mut lanes = [0f32; LANES];
    for (a, b) in a.as_chunks::<LANES>().0.iter().zip(b.as_chunks::<LANES>().0) {
        for lane in 0..LANES {
            lanes[lane] += term(a[lane], b[lane]);
        }
    }
    lanes.iter().sum()
}

/// The mean of the values.
fn mean(brick: &Brick) -> f32 {
    sum(brick, brick, |value, _| value) / BRICK_VOXELS as f32
}

/// The values less their mean, and the mean. The mean is what rounding left of it; the values that are given
/// are centred on the number that is given.
fn centred(brick: &Brick) -> (Brick, f32) {
    let mean = mean(brick);
    (brick.map(|value| value - mean), mean)
}

/// A number that looks random: the same for the same seed and counter. The finalizer of SplitMix64 (Steele,
/// Lea, Flood: Fast Splittable Pseudorandom Number Generators, 2014).
fn random(seed: u64, counter: u64) -> u64 {
    let mut bits = seed.wrapping_add(counter.wrapping_add(1).wrapping_mul(0x9e37_79b9_7f4a_7c15));
    bits = (bits ^ bits >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    bits = (bits ^ bits >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
    bits ^ bits >> 31
}

/// Some of the items, each at most once and as likely as any other.
fn choose(from: &[usize], count: usize, seed: u64) -> Vec<usize> {
    let mut items = from.to_vec();
    let count = count.min(items.len());
    for i in 0..count {
        let rest = (items.len() - i) as u64;
        items.swap(i, i + (random(seed, i as u64) % rest) as usize);
    }
    items.truncate(count);
    items
}

/// What `make` gives for 0 to `count`, in this order, in parallel where the feature is on. Each thread has
/// working memory of its own.
pub(crate) fn map<S, T: Send>(
    count: usize,
    memory: impl Fn() -> S + Sync + Send,
    make: impl Fn(&mut S, usize) -> T + Sync + Send,
) -> Vec<T> {
    #[cfg(feature = "parallel")]
    {
        use rayon::prelude::*;
        (0..count).into_par_iter().map_init(memory, make).collect()
    }
    #[cfg(not(feature = "parallel"))]
    {
        let mut memory = memory();
        (0..count).map(|i| make(&mut memory, i)).collect()
    }
}

#[cfg(test)]
mod tests;
