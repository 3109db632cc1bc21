//! Filters: what the values of voxels say of the points between them.
//!
//! Each filter is a sum of voxels with weights that are not negative and sum to one. Its stochastic form reads a single voxel,
//! chosen with the chance of its weight, so that the mean over many reads is the filter (Hofmann et al., "Efficient Unbiased
//! Volume Path Tracing on the GPU", 2021). Points are in index space, where a voxel's value sits at its index.
//!
//! Line integrals through filtered values are in [`depth`](crate::depth).

use glam::{IVec3, Vec3};
use nuage_volume::channel::Channel;

use crate::blocks::Blocks;
use crate::traverse::Field;

/// How a value is made of the voxels around a point, for [`depth`](crate::depth).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Filter {
    /// [`nearest`].
    Nearest,
    /// [`trilinear`].
    Trilinear,
}

/// How a renderer looks up the value at a point.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Hash)]
pub enum Lookup {
    /// [`nearest`].
    Nearest,
    /// [`trilinear`], the fastest to track.
    #[default]
    Trilinear,
    /// [`tricubic`], whose bounds are wider.
    Tricubic,
    /// One voxel at random, which is [`trilinear`] in the mean.
    StochasticTrilinear,
    /// One voxel at random, which is [`tricubic`] in the mean.
    StochasticTricubic,
}

impl Lookup {
    /// What it is in the mean.
    #[must_use]
    pub fn mean(self) -> Self {
        match self {
            Lookup::StochasticTrilinear => Lookup::Trilinear,
            Lookup::StochasticTricubic => Lookup::Tricubic,
            exact => exact,
        }
    }

    /// The filter whose line integrals, in the mean, have a closed form.
    pub(crate) fn along_lines(self) -> Option<Filter> {
        match self.mean() {
            Lookup::Nearest => Some(Filter::Nearest),
            Lookup::Trilinear => Some(Filter::Trilinear),
            _ => None,
        }
    }

    /// A channel made ready for rays that look values up so.
    pub(crate) fn field(self, channel: &Channel) -> Option<Field<'_>> {
        match self.mean() {
            Lookup::Tricubic => Field::wide(channel),
            _ => Field::new(channel),
        }
    }
}

impl<'a> Field<'a> {
    /// The value at a position. `random` gives three numbers from 0 to less than 1, if one voxel is to be chosen.
    #[inline]
    pub(crate) fn look_up(
        &self,
        blocks: &mut Blocks<'a>,
        position: Vec3,
        lookup: Lookup,
        random: impl FnOnce() -> [f32; 3],
    ) -> f32 {
        let mut voxel = |voxel: IVec3| blocks.trilinear_in_cell(self.voxel_at(voxel.as_vec3()), Vec3::ZERO);
        match lookup {
            Lookup::Trilinear => self.sample(blocks, position),
            Lookup::Nearest => voxel(nearest_voxel(position)),
            Lookup::StochasticTrilinear => voxel(trilinear_voxel(position, random())),
            Lookup::StochasticTricubic => voxel(tricubic_voxel(position, random())),
            Lookup::Tricubic => tricubic_of_linear(position, |cell, fraction| {
                blocks.trilinear_in_cell(self.voxel_at(cell), fraction)
            }),
        }
    }
}

/// [`tricubic`] by eight trilinear samples, each at the place between two voxels along each axis that has their weights (Sigg &
/// Hadwiger, "Fast Third-Order Texture Filtering", GPU Gems 2, 2005). `linear` gives the sample of a cell, by its lower corner.
fn tricubic_of_linear(p_index: Vec3, mut linear: impl FnMut(Vec3, Vec3) -> f32) -> f32 {
    let cell = p_index.floor();
    let pairs = (p_index - cell).to_array().map(|x| {
        let [a, b, c, d] = cubic_weights(x);
        [(a + b, b / (a + b)), (c + d, d / (c + d))]
    });
    let mut sum = 0.0;
    for i in 0..8_usize {
        let halves = [i >> 2, i >> 1 & 1, i & 1];
        let along = |axis: usize| pairs[axis][halves[axis]];
        let corner = cell + Vec3::from(halves.map(|half| if half == 0 { -1.0 } else { 1.0 }));
        let weight: f32 = (0..3).map(|axis| along(axis).0).product();
        sum += weight * linear(corner, Vec3::from([0, 1, 2].map(|axis| along(axis).1)));
    }
    sum
}

/// The voxel at `floor(p + ½)`.
pub fn nearest_voxel(p_index: Vec3) -> IVec3 {
    (p_index + 0.5).floor().as_ivec3()
}

/// The value of the nearest voxel.
pub fn nearest(p_index: Vec3, mut voxel: impl FnMut(IVec3) -> f32) -> f32 {
    voxel(nearest_voxel(p_index))
}

/// Linear along each axis between the eight voxels from `floor(p)` on.
pub fn trilinear(p_index: Vec3, voxel: impl FnMut(IVec3) -> f32) -> f32 {
    let corner = p_index.floor();
    weighted(corner.as_ivec3(), (p_index - corner).to_array().map(linear_weights), voxel)
}

/// The cubic B-spline of the 64 voxels from `floor(p) - 1` on. Smooth to the second derivative, and does not go through the
/// values of the voxels themselves.
pub fn tricubic(p_index: Vec3, voxel: impl FnMut(IVec3) -> f32) -> f32 {
    let corner = p_index.floor();
    weighted(corner.as_ivec3() - 1, (p_index - corner).to_array().map(cubic_weights), voxel)
}

/// The voxel to read for [`trilinear`] in the mean, by three random numbers from 0 to less than 1.
pub fn trilinear_voxel(p_index: Vec3, random: [f32; 3]) -> IVec3 {
    let corner = p_index.floor();
    corner.as_ivec3() + chosen((p_index - corner).to_array().map(linear_weights), random)
}

/// The voxel to read for [`tricubic`] in the mean, by three random numbers from 0 to less than 1.
pub fn tricubic_voxel(p_index: Vec3, random: [f32; 3]) -> IVec3 {
    let corner = p_index.floor();
    corner.as_ivec3() - 1 + chosen((p_index - corner).to_array().map(cubic_weights), random)
}

/// The weights of two neighbours, `x` from the first one.
pub fn linear_weights(x: f32) -> [f32; 2] {
    [1.0 - x, x]
}

/// The weights of the uniform cubic B-spline, for the voxels from one before the cell to one behind it; `x` in the cell.
pub fn cubic_weights(x: f32) -> [f32; 4] {
    let y = 1.0 - x;
    let outer = |x: f32| x * x * x / 6.0;
    let inner = |x: f32| 2.0 / 3.0 - x * x * (1.0 - 0.5 * x);
    [outer(y), inner(x), inner(y), outer(x)]
}

/// The sum of the voxels from one on, each with the product of its weights.
fn weighted<const N: usize>(
    first: IVec3,
    [x, y, z]: [[f32; N]; 3],
    mut voxel: impl FnMut(IVec3) -> f32,
) -> f32 {
    let mut sum = 0.0;
    for (i, wx) in (0..).zip(x) {
        for (j, wy) in (0..).zip(y) {
            for (k, wz) in (0..).zip(z) {
                sum += wx * wy * wz * voxel(first.wrapping_add(IVec3::new(i, j, k)));
            }
        }
    }
    sum
}

/// One of the voxels along each axis, with the chance of its weight.
fn chosen<const N: usize>(weights: [[f32; N]; 3], random: [f32; 3]) -> IVec3 {
    let along = |axis: usize| {
        let mut left = random[axis];
        let passed = weights[axis].iter().take(N - 1).take_while(|weight| {
            left -= **weight;
            left >= 0.0
        });
        passed.count() as i32
    };
    IVec3::new(along(0), along(1), along(2))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::hash::{hash_u32, unit_f32};

    fn random(seed: u32) -> f32 {
        unit_f32(hash_u32(seed))
    }

    fn points(count: u32) -> impl Iterator<Item = Vec3> {
        (0..count).map(|i| Vec3::new(random(3 * i), random(3 * i + 1), random(3 * i + 2)) * 20.0 - 10.0)
    }

    /// Values without any order.
    fn noise(voxel: IVec3) -> f32 {
        random((voxel.x as u32).wrapping_mul(7919) ^ (voxel.y as u32).wrapping_mul(104_729) ^ voxel.z as u32)
    }

    #[test]
    fn weights_are_not_negative_and_sum_to_one() {
        for i in 0..=1000 {
            let x = i as f32 / 1000.0;
            for weights in [linear_weights(x).to_vec(), cubic_weights(x).to_vec()] {
                assert!(weights.iter().all(|w| *w >= 0.0), "{weights:?}");
                assert!((weights.iter().sum::<f32>() - 1.0).abs() < 1e-6, "{weights:?}");
            }
        }
    }

    #[test]
    fn linear_fields_are_reproduced() {
        let plane = |p: Vec3| p.dot(Vec3::new(0.3, -0.7, 0.2)) + 5.0;
        for p in points(300) {
            for filtered in [trilinear(p, |v| plane(v.as_vec3())), tricubic(p, |v| plane(v.as_vec3()))] {
                assert!((filtered - plane(p)).abs() < 1e-4, "{p}: {filtered} instead of {}", plane(p));
            }
        }
    }

    #[test]
    fn eight_linear_samples_make_the_spline() {
        for p in points(300) {
            let linear = |cell: Vec3, fraction: Vec3| trilinear(cell + fraction, noise);
            let (found, expected) = (tricubic_of_linear(p, linear), tricubic(p, noise));
            assert!((found - expected).abs() < 1e-5, "{p}: {found} instead of {expected}");
        }
    }

    #[test]
    fn the_spline_is_smooth_where_cells_meet() {
        // Second differences across a face of a cell, by halves of a small step, agree with those beside it.
        let along = |x: f32| f64::from(tricubic(Vec3::new(x, 0.3, 0.6), noise));
        let bend = |x: f32| (along(x - 0.125) - 2.0 * along(x) + along(x + 0.125)) * 64.0;
        let linear = |x: f32| f64::from(trilinear(Vec3::new(x, 0.3, 0.6), noise));
        let linear_bend = |x: f32| (linear(x - 0.125) - 2.0 * linear(x) + linear(x + 0.125)) * 64.0;
        let jump =
            |bend: &dyn Fn(f32) -> f64, x: f32| (bend(x) - 0.5 * (bend(x - 0.25) + bend(x + 0.25))).abs();
        let largest = |bend: &dyn Fn(f32) -> f64| (0..20).map(|i| jump(bend, i as f32)).fold(0.0, f64::max);
        assert!(largest(&bend) < 0.25, "{}", largest(&bend));
        assert!(largest(&linear_bend) > 1.0, "{}", largest(&linear_bend));
    }

    #[test]
    fn one_voxel_at_random_is_the_filter_in_the_mean() {
        const READS: u32 = 20_000;
        for (number, p) in (0..).zip(points(6)) {
            let mean = |voxel: fn(Vec3, [f32; 3]) -> IVec3| {
                let read = |i: u32| {
                    let seed = hash_u32(number * READS + i);
                    let numbers = [1, 2, 3].map(|j| random(seed.wrapping_add(j)));
                    f64::from(noise(voxel(p, numbers)))
                };
                (0..READS).map(read).sum::<f64>() / f64::from(READS)
            };
            // The values lie between 0 and 1: five standard errors at most.
            let tolerance = 5.0 * 0.5 / f64::from(READS).sqrt();
            for (mean, filtered) in
                [(mean(trilinear_voxel), trilinear(p, noise)), (mean(tricubic_voxel), tricubic(p, noise))]
            {
                assert!((mean - f64::from(filtered)).abs() < tolerance, "{p}: {mean} instead of {filtered}");
            }
        }
    }

    #[test]
    fn the_ends_of_the_random_numbers_choose_voxels_with_weight() {
        let last = 1.0 - f32::EPSILON / 2.0;
        for p in points(100) {
            let corner = p.floor().as_ivec3();
            assert!(trilinear_voxel(p, [0.0; 3]) == corner || p.fract().min_element() == 0.0);
            assert!((trilinear_voxel(p, [last; 3]) - corner).cmple(IVec3::ONE).all());
            assert!((tricubic_voxel(p, [last; 3]) - corner).cmple(IVec3::splat(2)).all());
        }
        assert_eq!(nearest_voxel(Vec3::new(0.5, -0.5, 0.49)), IVec3::new(1, 0, 0));
    }
}
