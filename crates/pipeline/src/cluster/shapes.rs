//! Shared shapes: a brick is `bias + scale * shape`, the shape one of a few that many bricks share.
//!
//! Own scale and bias let gradients and faint copies of one another share, which centres of k-means cannot. A
//! brick shares only where that meets the caller's bounds on its error, checked in full; else it is kept.
//! Shapes are found among a few low frequencies of a sample of the bricks, where comparing is cheap: first a
//! greedy cover of the sample, then rounds of k-means over lines through the origin, as scale may be of any
//! size and sign. Bricks with much fine detail are kept, even copies of one another.
//!
//! What does not live here: clustering without scale and bias, which is in [`thesis`](super::thesis).

use std::collections::BinaryHeap;

use super::{BRICK_VOXELS, Brick, LANES, centred, choose, is_tame, map, mean, sum};

/// How to share.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Settings {
    /// How many shapes there may be; fewer where more would not pay.
    pub shapes: usize,
    /// How often shapes are fitted again to the bricks that share them.
    pub iterations: u32,
    /// By how much a voxel of a shared brick may differ, in the unit of the values.
    pub max_error: f32,
    /// What the mean squared difference of a shared brick may be; infinite if only `max_error` counts.
    pub max_mse: f32,
    /// Picks the sample that shapes are found in.
    pub seed: u64,
}

/// A brick in terms of a shape.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SharedBrick {
    /// The index of the shape.
    pub shape: u32,
    /// What the shape's values are multiplied with, of either sign.
    pub scale: f32,
    /// What is then added.
    pub bias: f32,
}

impl SharedBrick {
    /// The values of the brick, given those of its shape.
    pub fn values(&self, shape: &Brick) -> Brick {
        shape.map(|value| self.bias + self.scale * value)
    }
}

/// Which bricks share a shape.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Shapes {
    /// The shapes, their values in -1..=1 and about zero on average. Each is shared by two bricks or more.
    pub shapes: Vec<Brick>,
    /// For each brick what it is in terms of a shape, or `None` if it is kept.
    pub of_brick: Vec<Option<SharedBrick>>,
}

/// How many low frequencies bricks are compared by.
const FREQUENCIES: usize = 32;
/// Frequencies per axis, the constant one included.
const PER_AXIS: usize = 4;

/// The amplitudes of low frequencies in an orthonormal basis, the mean left out.
type Spectrum = [f32; FREQUENCIES];

/// The most bricks that the greedy cover looks at; its cost grows with the square.
const COVER_SAMPLE: usize = 4096;
/// The most bricks that shapes are fitted to.
const FIT_SAMPLE: usize = 1 << 16;
/// How many of the likeliest shapes of a brick are checked in full.
const CHECKED: usize = 8;
/// How many times the root of the mean squared error the largest one is in a brick that fails by little. In
/// noise it would be 3; in clouds the largest errors stand at edges. Of 3 to 8, 5 left the lowest bound at
/// equal size.
const PEAK: f32 = 5.0;

/// What is known of a brick.
#[derive(Clone, Copy)]
struct Features {
    spectrum: Spectrum,
    /// The sum of the squares of the values less their mean; infinite for bricks to be kept.
    energy: f32,
}

/// Finds shapes, and the bricks that can share them. The same for any number of threads.
pub fn share(bricks: &[Brick], settings: &Settings) -> Shapes {
    // Written so that NaN fails.
    let has_bounds = settings.max_error >= 0.0 && settings.max_mse >= 0.0;
    if !has_bounds || settings.shapes == 0 {
        return Shapes { shapes: Vec::new(), of_brick: vec![None; bricks.len()] };
    }
    let mut shapes = find(bricks, settings);
    if shapes.is_empty() {
        // For bricks that are flat within the bounds.
        shapes.push([0.0; BRICK_VOXELS]);
    }
    let matcher = Matcher::new(shapes);
    let limit = settings.max_mse.min(settings.max_error.powi(2)) * BRICK_VOXELS as f32;
    let of_brick = assign(bricks, &matcher, settings, limit);
    drop_lonely(matcher.shapes, of_brick)
}

/// Finds shapes that many of some bricks can share within the bounds. The same for any number of threads.
pub fn find(bricks: &[Brick], settings: &Settings) -> Vec<Brick> {
    let basis = Basis::new();
    let features = map(bricks.len(), || (), |(), i| basis.features(&bricks[i]));
    let target = settings.max_mse.min((settings.max_error / PEAK).powi(2)) * BRICK_VOXELS as f32;

    // Worth learning from: bricks that are not flat, and that low frequencies can tell within the bounds.
    let reachable: Vec<usize> = (0..bricks.len())
        .filter(|i| {
            let Features { spectrum, energy } = &features[*i];
            *energy > target && *energy < f32::INFINITY && energy - dot(spectrum, spectrum) <= target
        })
        .collect();
    let sample = choose(&reachable, FIT_SAMPLE, settings.seed);
    let mut spectra = cover(&features, &sample, settings.shapes.min(u32::MAX as usize), target);
    if spectra.is_empty() {
        return Vec::new();
    }
    for _ in 0..settings.iterations {
        spectra = fit_spectra(&features, &sample, spectra, target);
    }
    fit_shapes(bricks, &features, &sample, &spectra, target)
}

/// Finds the shapes that are the most like a brick.
#[derive(Debug, Clone, PartialEq)]
pub struct Matcher {
    /// The shapes, about zero on average.
    pub shapes: Vec<Brick>,
    basis: Basis,
    /// The sum of squares of each shape.
    energies: Vec<f32>,
    /// The low frequencies of shapes as if their energies were one, all shapes of one frequency side by side.
    table: Vec<f32>,
}

/// A shape that a brick is like.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Match {
    /// The index of the shape.
    pub shape: usize,
    /// How much of the brick lies along the shape, by the low frequencies: a length, of either sign.
    along: f32,
}

impl Matcher {
    /// Prepares shapes for being compared with.
    pub fn new(shapes: Vec<Brick>) -> Matcher {
        let basis = Basis::new();
        let energies: Vec<f32> = shapes.iter().map(|shape| sum(shape, shape, |a, b| a * b)).collect();
        let spectra: Vec<Spectrum> = shapes.iter().map(|shape| basis.spectrum(shape)).collect();
        let length = |i: usize| if energies[i] > 0.0 { energies[i].sqrt() } else { 1.0 };
        let table = (0..basis.frequencies.len())
            .flat_map(|f| spectra.iter().enumerate().map(move |(i, spectrum)| spectrum[f] / length(i)))
            .collect();
        Matcher { shapes, basis, energies, table }
    }

    /// The likeliest shapes of a brick that may leave no more of it than `limit`, the sum of squares over its voxels;
    /// the best first. `along` is working memory.
    pub fn likely(
        &self,
        brick: &Brick,
        limit: f32,
        along: &mut Vec<f32>,
    ) -> impl Iterator<Item = Match> + use<> {
        let Features { spectrum, energy } = self.basis.features(brick);
        along.clear();
        along.resize(self.shapes.len(), 0.0);
        let mut likely = [Match::default(); CHECKED];
        // What a shape leaves of the whole energy: all that it does not describe among the low frequencies, if the rest
        // fits as well as it can.
        let rest = (energy - dot(&spectrum, &spectrum)).max(0.0).sqrt();
        if energy.is_finite() && !self.shapes.is_empty() {
            for (amplitude, shapes) in spectrum.iter().zip(self.table.chunks_exact(self.shapes.len())) {
                for (along, shape) in along.iter_mut().zip(shapes) {
                    *along += amplitude * shape;
                }
            }
            for (shape, along) in along.iter().enumerate() {
                if along.abs() > likely[CHECKED - 1].along.abs() {
                    likely[CHECKED - 1] = Match { shape, along: *along };
                    for place in (1..CHECKED).rev() {
                        if likely[place].along.abs() > likely[place - 1].along.abs() {
                            likely.swap(place, place - 1);
                        }
                    }
                }
            }
        }
        let can_fit = move |found: &Match| energy - (found.along.abs() + rest).powi(2) <= limit;
        likely.into_iter().filter(|found| found.along != 0.0).filter(can_fit)
    }

    /// A brick in terms of a shape, with the scale and bias of least squares.
    pub fn fit(&self, brick: &Brick, shape: usize) -> SharedBrick {
        let (values, mean) = centred(brick);
        let across = sum(&values, &self.shapes[shape], |a, b| a * b);
        let scale = if self.energies[shape] > 0.0 { across / self.energies[shape] } else { 0.0 };
        SharedBrick { shape: shape as u32, scale, bias: mean }
    }
}

/// The lowest frequencies of the discrete cosine transform along three axes.
#[derive(Debug, Clone, PartialEq)]
struct Basis {
    /// One axis: amplitude by frequency and voxel.
    axis: [[f32; 8]; PER_AXIS],
    /// The frequencies along x, y and z of each entry of a spectrum.
    frequencies: Vec<[usize; 3]>,
}

impl Basis {
    fn new() -> Self {
        let axis = std::array::from_fn(|frequency| {
            let norm: f64 = if frequency == 0 { 0.125 } else { 0.25 };
            std::array::from_fn(|voxel| {
                let angle = std::f64::consts::PI * frequency as f64 * (voxel as f64 + 0.5) / 8.0;
                (norm.sqrt() * angle.cos()) as f32
            })
        });
        // 31 without the constant one.
        let frequencies = (1..PER_AXIS.pow(3))
            .map(|i| [i / PER_AXIS.pow(2), i / PER_AXIS % PER_AXIS, i % PER_AXIS])
            .filter(|frequency| frequency.iter().sum::<usize>() <= PER_AXIS)
            .collect();
        Basis { axis, frequencies }
    }

    fn features(&self, brick: &Brick) -> Features {
        if !is_tame(brick) {
            return Features { spectrum: [0.0; FREQUENCIES], energy: f32::INFINITY };
        }
        let (values, _) = centred(brick);
        Features { spectrum: self.spectrum(&values), energy: sum(&values, &values, |a, b| a * b) }
    }

    fn spectrum(&self, values: &Brick) -> Spectrum {
        // Slabs along x, rows along y, and last along z.
        let mut slabs = [[0f32; 64]; PER_AXIS];
        for (x, slab) in values.as_chunks::<64>().0.iter().enumerate() {
            for (along_x, sums) in self.axis.iter().zip(&mut slabs) {
                for (sum, value) in sums.iter_mut().zip(slab) {
                    *sum += along_x[x] * value;
                }
            }
        }
        let mut rows = [[[0f32; 8]; PER_AXIS]; PER_AXIS];
        for (slab, rows) in slabs.iter().zip(&mut rows) {
            for (y, row) in slab.as_chunks::<8>().0.iter().enumerate() {
                for (along_y, sums) in self.axis.iter().zip(rows.iter_mut()) {
                    for (sum, value) in sums.iter_mut().zip(row) {
                        *sum += along_y[y] * value;
                    }
                }
            }
        }
        let mut spectrum = [0f32; FREQUENCIES];
        for (amplitude, [x, y, z]) in spectrum.iter_mut().zip(&self.frequencies) {
            *amplitude = rows[*x][*y].iter().zip(&self.axis[*z]).map(|(a, b)| a * b).sum();
        }
        spectrum
    }
}

fn dot(a: &Spectrum, b: &Spectrum) -> f32 {
    let mut lanes = [0f32; 8];
    for (a, b) in a.as_chunks::<8>().0.iter().zip(b.as_chunks::<8>().0) {
        for lane in 0..8 {
            lanes[lane] += a[lane] * b[lane];
        }
    }
    lanes.iter().sum()
}

/// A spectrum of length one, if there is a direction to it.
fn unit(spectrum: &Spectrum) -> Option<Spectrum> {
    let length = dot(spectrum, spectrum).sqrt();
    (length > 0.0 && length < f32::INFINITY).then(|| spectrum.map(|value| value / length))
}

/// Picks spectra out of a sample, each time the one that describes the most bricks not yet described within
/// the target: at most `count`, and none that describes itself alone.
fn cover(features: &[Features], sample: &[usize], count: usize, target: f32) -> Vec<Spectrum> {
    let candidates: Vec<(Spectrum, usize)> =
        sample.iter().take(COVER_SAMPLE).filter_map(|i| Some((unit(&features[*i].spectrum)?, *i))).collect();
    let described = map(
        candidates.len(),
        || (),
        |(), i| {
            let describes = |(_, brick): &(Spectrum, usize)| {
                let Features { spectrum, energy } = &features[*brick];
                energy - dot(&candidates[i].0, spectrum).powi(2) <= target
            };
            candidates
                .chunks(64)
                .map(|chunk| {
                    let bits =
                        chunk.iter().enumerate().map(|(bit, brick)| u64::from(describes(brick)) << bit);
                    bits.fold(0, |all, bit| all | bit)
                })
                .collect::<Vec<u64>>()
        },
    );
    let gain = |candidate: usize, open: &[u64]| {
        described[candidate].iter().zip(open).map(|(bits, open)| (bits & open).count_ones()).sum::<u32>()
    };
    let mut open = vec![u64::MAX; candidates.len().div_ceil(64)];
    // The gain of a candidate only falls, so what is at the top with its gain up to date is the best.
    let mut heap: BinaryHeap<(u32, usize)> =
        (0..candidates.len()).map(|i| (gain(i, &open), candidates.len() - i)).collect();
    let mut picked = Vec::new();
    while picked.len() < count {
        let Some((before, order)) = heap.pop() else { break };
        let candidate = candidates.len() - order;
        let now = gain(candidate, &open);
        if now < before {
            heap.push((now, order));
            continue;
        }
        // In a sample that leaves bricks out, one stands for more.
        if now == 0 || (now == 1 && sample.len() <= COVER_SAMPLE) {
            break;
        }
        for (open, bits) in open.iter_mut().zip(&described[candidate]) {
            *open &= !bits;
        }
        picked.push(candidates[candidate].0);
    }
    picked
}

/// The line nearest to each brick, with the brick's signed length along it. Bricks that are far from all are
/// left out: they will be kept, and would only draw shapes away from those that can share.
fn nearest_lines(
    features: &[Features],
    sample: &[usize],
    spectra: &[Spectrum],
    target: f32,
) -> Vec<Option<(usize, f32)>> {
    map(
        sample.len(),
        || (),
        |(), i| {
            let Features { spectrum, energy } = &features[sample[i]];
            let mut best = (0, 0f32);
            for (line, direction) in spectra.iter().enumerate() {
                let along = dot(spectrum, direction);
                if along.abs() > best.1.abs() {
                    best = (line, along);
                }
            }
            (!spectra.is_empty() && energy - best.1.powi(2) <= 2.0 * target).then_some(best)
        },
    )
}

/// Turns each line towards the bricks nearest to it: a step of the power iteration to their principal axis.
fn fit_spectra(
    features: &[Features],
    sample: &[usize],
    mut spectra: Vec<Spectrum>,
    target: f32,
) -> Vec<Spectrum> {
    let lines = nearest_lines(features, sample, &spectra, target);
    let mut sums = vec![[0f32; FREQUENCIES]; spectra.len()];
    for (brick, line) in sample.iter().zip(lines) {
        let Some((line, along)) = line else { continue };
        for (sum, value) in sums[line].iter_mut().zip(&features[*brick].spectrum) {
            *sum += along * value;
        }
    }
    for (spectrum, sum) in spectra.iter_mut().zip(&sums) {
        // A line that no brick is near to stays.
        *spectrum = unit(sum).unwrap_or(*spectrum);
    }
    spectra
}

/// The shapes in full, of those lines that bricks are near to.
fn fit_shapes(
    bricks: &[Brick],
    features: &[Features],
    sample: &[usize],
    spectra: &[Spectrum],
    target: f32,
) -> Vec<Brick> {
    let mut members = vec![Vec::new(); spectra.len()];
    for (brick, line) in sample.iter().zip(nearest_lines(features, sample, spectra, target)) {
        if let Some((line, along)) = line {
            members[line].push((*brick, along));
        }
    }
    let shapes = map(
        members.len(),
        || (),
        |(), i| {
            let mut shape = [0f32; BRICK_VOXELS];
            for (brick, along) in &members[i] {
                for (sum, value) in shape.iter_mut().zip(&centred(&bricks[*brick]).0) {
                    *sum += along * value;
                }
            }
            let (shape, _) = centred(&shape);
            let largest = shape.iter().fold(0.0, |largest: f32, value| largest.max(value.abs()));
            (largest > 0.0 && largest < f32::INFINITY).then(|| shape.map(|value| value / largest))
        },
    );
    shapes.into_iter().flatten().collect()
}

fn assign(bricks: &[Brick], matcher: &Matcher, settings: &Settings, limit: f32) -> Vec<Option<SharedBrick>> {
    map(bricks.len(), Vec::new, |along, i| {
        let brick = &bricks[i];
        if !is_tame(brick) {
            return None;
        }
        let likely = matcher.likely(brick, limit, along).map(|found| matcher.fit(brick, found.shape));
        let flat = SharedBrick { shape: 0, scale: 0.0, bias: mean(brick) };
        let mut best: Option<(f32, SharedBrick)> = None;
        for shared in likely.chain([flat]) {
            if let Some(mse) = error_within(brick, &shared, &matcher.shapes[shared.shape as usize], settings)
                && best.is_none_or(|(least, _)| mse < least)
            {
                best = Some((mse, shared));
            }
        }
        best.map(|(_, shared)| shared)
    })
}

/// The mean squared error of a brick, if that and the largest are within the bounds.
fn error_within(brick: &Brick, shared: &SharedBrick, shape: &Brick, settings: &Settings) -> Option<f32> {
    let mut largest = [0f32; LANES];
    let mut squares = [0f32; LANES];
    for (values, shape) in brick.as_chunks::<LANES>().0.iter().zip(shape.as_chunks::<LANES>().0) {
        for lane in 0..LANES {
            let error = (shared.bias + shared.scale * shape[lane] - values[lane]).abs();
            largest[lane] = if error > largest[lane] { error } else { largest[lane] };
            squares[lane] += error * error;
        }
    }
    let largest = largest.iter().fold(0.0, |a: f32, b| a.max(*b));
    let mse = squares.iter().sum::<f32>() / BRICK_VOXELS as f32;
    (largest <= settings.max_error && mse <= settings.max_mse).then_some(mse)
}

/// Drops shapes that fewer than two bricks share: keeping the brick costs the same, without an error.
fn drop_lonely(shapes: Vec<Brick>, mut of_brick: Vec<Option<SharedBrick>>) -> Shapes {
    let mut counts = vec![0u32; shapes.len()];
    for shared in of_brick.iter().flatten() {
        counts[shared.shape as usize] = counts[shared.shape as usize].saturating_add(1);
    }
    let mut left = 0;
    let new_index: Vec<Option<u32>> = counts
        .iter()
        .map(|count| {
            (*count >= 2).then(|| {
                left += 1;
                left - 1
            })
        })
        .collect();
    for brick in &mut of_brick {
        *brick = brick.and_then(|shared| {
            let shape = new_index[shared.shape as usize]?;
            Some(SharedBrick { shape, ..shared })
        });
    }
    let shapes = shapes.into_iter().zip(new_index).filter_map(|(shape, new)| new.map(|_| shape)).collect();
    Shapes { shapes, of_brick }
}
