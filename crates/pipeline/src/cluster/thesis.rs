//! Clustering by k-means, as in a master's thesis on rendering VDB files (sections 4.5 and 5.3): bricks of
//! low variance are replaced by the nearest of k centres under the normalised Manhattan distance, others are
//! kept.
//!
//! [`k_means`] passes over most centres by lower bounds of their distance; [`plain_k_means`] is the same in
//! textbook loops, to test and to measure against. What does not live here: sharing with scale and bias,
//! which is in [`shapes`](super::shapes).

use super::{BRICK_VOXELS, Brick, choose, is_tame, map, mean, sum};

/// What is held against the threshold to tell whether a brick is too varied to be clustered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Rejection {
    /// The variance of the values once scaled to 0 to 1 inside the brick (section 4.5).
    NormalizedVariance,
    /// The variance of the values over their mean (section 5.3).
    VarianceOverMean,
}

impl Rejection {
    /// How varied a brick is; infinite where it is varied about a mean of zero, or holds numbers that are
    /// none or too large ([`MAX_MAGNITUDE`](super::MAX_MAGNITUDE)).
    pub fn measure(self, brick: &Brick) -> f32 {
        if !is_tame(brick) {
            return f32::INFINITY;
        }
        let min = brick.iter().fold(f32::INFINITY, |min, value| min.min(*value));
        let max = brick.iter().fold(f32::NEG_INFINITY, |max, value| max.max(*value));
        if min == max {
            return 0.0;
        }
        let mean = mean(brick);
        match self {
            Rejection::NormalizedVariance => {
                let range = max - min;
                sum(brick, brick, |value, _| ((value - mean) / range).powi(2)) / BRICK_VOXELS as f32
            }
            // Differing values about zero mean have a positive variance unless it is too small for a float.
            Rejection::VarianceOverMean if mean == 0.0 => f32::INFINITY,
            Rejection::VarianceOverMean => {
                sum(brick, brick, |value, _| (value - mean).powi(2)) / BRICK_VOXELS as f32 / mean.abs()
            }
        }
    }
}

/// How to cluster.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// How many centres there are to be; fewer if fewer bricks take part.
    pub clusters: usize,
    /// How often centres are moved into the middle of their bricks, at most.
    pub iterations: u32,
    /// What is held against the threshold.
    pub rejection: Rejection,
    /// Bricks that measure more are kept.
    pub threshold: f32,
    /// Picks the bricks that are the first centres.
    pub seed: u64,
}

/// Which bricks are replaced, and by what.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Clusters {
    /// The new bricks.
    pub centres: Vec<Brick>,
    /// For each brick the index of its centre, or `None` if it is kept.
    pub of_brick: Vec<Option<u32>>,
}

/// Centres and the bricks around them.
#[derive(Debug, Clone, PartialEq)]
pub struct KMeans {
    /// The centres.
    pub centres: Vec<Brick>,
    /// For each brick taking part the index of the nearest centre, of equals the first. Empty if there are no
    /// centres.
    pub nearest: Vec<u32>,
}

/// The mean absolute difference of the voxels: the Manhattan distance over the number of voxels.
pub fn distance(a: &Brick, b: &Brick) -> f32 {
    manhattan(a, b) / BRICK_VOXELS as f32
}

fn manhattan(a: &Brick, b: &Brick) -> f32 {
    sum(a, b, |a, b| (a - b).abs())
}

/// Finds which bricks take part: those that measure no more than the threshold.
pub fn low_variance_bricks(bricks: &[Brick], rejection: Rejection, threshold: f32) -> Vec<usize> {
    let takes_part = map(bricks.len(), || (), |(), i| rejection.measure(&bricks[i]));
    // An infinite threshold does not admit what cannot be computed with, nor does NaN admit anything.
    let is_low = |measure: f32| measure < f32::INFINITY && measure <= threshold;
    (0..bricks.len()).filter(|i| is_low(takes_part[*i])).collect()
}

/// Picks the first centres among the bricks that take part.
pub fn first_centres(bricks: &[Brick], taking_part: &[usize], count: usize, seed: u64) -> Vec<Brick> {
    choose(taking_part, count.min(u32::MAX as usize), seed).into_iter().map(|i| bricks[i]).collect()
}

/// Clusters the bricks of low variance. The same for any number of threads.
pub fn cluster(bricks: &[Brick], settings: &Settings) -> Clusters {
    let taking_part = low_variance_bricks(bricks, settings.rejection, settings.threshold);
    let centres = first_centres(bricks, &taking_part, settings.clusters, settings.seed);
    let KMeans { centres, nearest } = k_means(bricks, &taking_part, centres, settings.iterations);
    let mut of_brick = vec![None; bricks.len()];
    for (brick, centre) in taking_part.iter().zip(nearest) {
        of_brick[*brick] = Some(centre);
    }
    Clusters { centres, of_brick }
}

/// Moves centres into the middle of the bricks nearest to them, again and again until no brick changes its
/// centre. Takes part of `bricks` those whose indices are given, which must have no values over
/// [`MAX_MAGNITUDE`](super::MAX_MAGNITUDE). A centre that is nearest to none stays.
///
/// # Panics
/// If an index is out of range.
pub fn k_means(bricks: &[Brick], taking_part: &[usize], mut centres: Vec<Brick>, iterations: u32) -> KMeans {
    if centres.is_empty() {
        return KMeans { centres, nearest: Vec::new() };
    }
    let mut nearest = assign(bricks, taking_part, &centres, None);
    for _ in 0..iterations {
        move_centres(bricks, taking_part, &nearest, &mut centres);
        let moved = assign(bricks, taking_part, &centres, Some(&nearest));
        let settled = moved == nearest;
        nearest = moved;
        if settled {
            break;
        }
    }
    KMeans { centres, nearest }
}

fn assign(bricks: &[Brick], taking_part: &[usize], centres: &[Brick], before: Option<&[u32]>) -> Vec<u32> {
    let targets = Targets::new(centres);
    let search = |bounds: &mut Vec<f32>, i: usize| {
        targets.nearest(&bricks[taking_part[i]], before.map(|before| before[i] as usize), bounds)
    };
    map(taking_part.len(), || vec![0.0; centres.len()], search)
}

/// Sums over 4³ blocks of 2³ voxels and over 2³ blocks of 4³ voxels. Their Manhattan distance is at most that
/// of the voxels, as the absolute value of a sum is at most the sum of the absolute values.
struct BlockSums {
    fine: [f32; 64],
    coarse: [f32; 8],
    /// The absolute values of all voxels, which bounds the rounding errors of the other sums.
    total: f32,
}

impl BlockSums {
    fn new(brick: &Brick) -> Self {
        let (mut fine, mut coarse) = ([0f32; 64], [0f32; 8]);
        let rows = brick.as_chunks::<8>().0;
        for (block_row, fine) in fine.as_chunks_mut::<4>().0.iter_mut().enumerate() {
            let first = block_row / 4 * 16 + block_row % 4 * 2;
            let mut row = [0f32; 8];
            for (z, value) in row.iter_mut().enumerate() {
                *value = rows[first][z] + rows[first + 1][z] + rows[first + 8][z] + rows[first + 9][z];
            }
            for (z, sum) in fine.iter_mut().enumerate() {
                *sum = row[2 * z] + row[2 * z + 1];
            }
        }
        for (block, sum) in fine.iter().enumerate() {
            let (x, y, z) = (block >> 5, block >> 3 & 1, block >> 1 & 1);
            coarse[x * 4 + y * 2 + z] += sum;
        }
        BlockSums { fine, coarse, total: sum(brick, brick, |value, _| value.abs()) }
    }
}

/// The centres and their sums.
struct Targets<'a> {
    centres: &'a [Brick],
    sums: Vec<BlockSums>,
    /// The coarse sums again, all centres of one block side by side.
    coarse: Vec<f32>,
    largest_total: f32,
}

impl<'a> Targets<'a> {
    fn new(centres: &'a [Brick]) -> Self {
        let sums: Vec<_> = centres.iter().map(BlockSums::new).collect();
        let coarse = (0..8).flat_map(|block| sums.iter().map(move |sums| sums.coarse[block])).collect();
        let largest_total = sums.iter().fold(0.0, |largest: f32, sums| largest.max(sums.total));
        Targets { centres, sums, coarse, largest_total }
    }

    /// The nearest centre. `guess` is one that may be near; `bounds` has room for a number per centre.
    fn nearest(&self, brick: &Brick, guess: Option<usize>, bounds: &mut [f32]) -> u32 {
        let own = BlockSums::new(brick);
        bounds.fill(0.0);
        for (sum, centres) in own.coarse.iter().zip(self.coarse.chunks_exact(self.centres.len())) {
            for (bound, centre) in bounds.iter_mut().zip(centres) {
                *bound += (sum - centre).abs();
            }
        }
        // The sums are off by less than 16 roundings of the absolute values, the distances by less than 64 of
        // themselves.
        let slack = 16.0 * f32::EPSILON * (own.total + self.largest_total);
        let may_be_nearer = |bound: f32, best: f32| bound * (1.0 - 64.0 * f32::EPSILON) - slack <= best;

        let lowest = (0..bounds.len()).fold(0, |low, i| if bounds[i] < bounds[low] { i } else { low });
        let mut nearest = lowest;
        let mut best = manhattan(brick, &self.centres[lowest]);
        let mut consider = |i: usize| {
            let distance = manhattan(brick, &self.centres[i]);
            if distance < best || (distance == best && i < nearest) {
                (best, nearest) = (distance, i);
            }
            best
        };
        let mut best_yet = consider(guess.unwrap_or(lowest));
        for (i, bound) in bounds.iter().enumerate() {
            if !may_be_nearer(*bound, best_yet) || i == lowest || Some(i) == guess {
                continue;
            }
            let fine = fine_distance(&own.fine, &self.sums[i].fine);
            if may_be_nearer(fine, best_yet) {
                best_yet = consider(i);
            }
        }
        nearest as u32
    }
}

fn fine_distance(a: &[f32; 64], b: &[f32; 64]) -> f32 {
    let mut lanes = [0f32; 8];
    for (a, b) in a.as_chunks::<8>().0.iter().zip(b.as_chunks::<8>().0) {
        for lane in 0..8 {
            lanes[lane] += (a[lane] - b[lane]).abs();
        }
    }
    lanes.iter().sum()
}

/// How many bricks are summed at a time. Fixed, so that sums do not depend on the number of threads.
const BRICKS_PER_SUM: usize = 1024;

fn move_centres(bricks: &[Brick], taking_part: &[usize], nearest: &[u32], centres: &mut [Brick]) {
    let mut members = vec![Vec::new(); centres.len()];
    for (brick, centre) in taking_part.iter().zip(nearest) {
        members[*centre as usize].push(*brick);
    }
    let parts: Vec<(usize, &[usize])> = members
        .iter()
        .enumerate()
        .flat_map(|(centre, members)| members.chunks(BRICKS_PER_SUM).map(move |part| (centre, part)))
        .collect();
    let add = |_: &mut (), i: usize| {
        let mut sum = [0f64; BRICK_VOXELS];
        for brick in parts[i].1 {
            for (sum, value) in sum.iter_mut().zip(&bricks[*brick]) {
                *sum += f64::from(*value);
            }
        }
        sum
    };
    let sums = map(parts.len(), || (), add);
    let mut totals = vec![[0f64; BRICK_VOXELS]; centres.len()];
    for ((centre, _), sum) in parts.iter().zip(&sums) {
        for (total, part) in totals[*centre].iter_mut().zip(sum) {
            *total += part;
        }
    }
    for ((centre, total), members) in centres.iter_mut().zip(&totals).zip(&members) {
        if !members.is_empty() {
            *centre = total.map(|total| (total / members.len() as f64) as f32);
        }
    }
}

/// The same as [`k_means`] in the plainest loops: every brick is held against every centre, voxel by voxel.
///
/// # Panics
/// If an index is out of range.
pub fn plain_k_means(
    bricks: &[Brick],
    taking_part: &[usize],
    mut centres: Vec<Brick>,
    iterations: u32,
) -> KMeans {
    if centres.is_empty() {
        return KMeans { centres, nearest: Vec::new() };
    }
    let mut nearest = plain_assign(bricks, taking_part, &centres);
    for _ in 0..iterations {
        let mut sums = vec![[0f64; BRICK_VOXELS]; centres.len()];
        let mut counts = vec![0u32; centres.len()];
        for (brick, centre) in taking_part.iter().zip(&nearest) {
            counts[*centre as usize] += 1;
            for voxel in 0..BRICK_VOXELS {
                sums[*centre as usize][voxel] += f64::from(bricks[*brick][voxel]);
            }
        }
        for (i, centre) in centres.iter_mut().enumerate() {
            for voxel in 0..BRICK_VOXELS {
                if counts[i] > 0 {
                    centre[voxel] = (sums[i][voxel] / f64::from(counts[i])) as f32;
                }
            }
        }
        let moved = plain_assign(bricks, taking_part, &centres);
        let settled = moved == nearest;
        nearest = moved;
        if settled {
            break;
        }
    }
    KMeans { centres, nearest }
}

fn plain_assign(bricks: &[Brick], taking_part: &[usize], centres: &[Brick]) -> Vec<u32> {
    let mut nearest = Vec::with_capacity(taking_part.len());
    for brick in taking_part {
        let (mut best, mut best_distance) = (0, f32::INFINITY);
        for (i, centre) in centres.iter().enumerate() {
            let mut distance = 0.0;
            for voxel in 0..BRICK_VOXELS {
                distance += (bricks[*brick][voxel] - centre[voxel]).abs();
            }
            if distance < best_distance {
                (best, best_distance) = (i as u32, distance);
            }
        }
        nearest.push(best);
    }
    nearest
}
