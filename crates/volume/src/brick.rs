//! Bricks: the voxel values of 8³ voxels each, in one flat array, as f32 or as f16.

use crate::space::BRICK_VOXELS;

/// The values of all bricks of a tree, [`BRICK_VOXELS`] each, voxel offset `x << 6 | y << 3 | z`.
#[derive(Debug, Clone, PartialEq)]
pub enum Bricks {
    /// 32-bit floats.
    F32(Vec<f32>),
    /// The bits of 16-bit floats. Infinities and NaN do not occur.
    F16(Vec<u16>),
}

impl Bricks {
    /// The number of bricks.
    pub fn len(&self) -> usize {
        match self {
            Bricks::F32(values) => values.len() / BRICK_VOXELS,
            Bricks::F16(values) => values.len() / BRICK_VOXELS,
        }
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The memory of all values.
    pub fn size_bytes(&self) -> usize {
        match self {
            Bricks::F32(values) => size_of_val(values.as_slice()),
            Bricks::F16(values) => size_of_val(values.as_slice()),
        }
    }

    /// The value at a voxel offset of a brick.
    ///
    /// # Panics
    /// If there is no such brick or offset.
    #[inline]
    pub fn value(&self, brick: u32, offset: usize) -> f32 {
        let at = brick as usize * BRICK_VOXELS + offset;
        match self {
            Bricks::F32(values) => values[at],
            Bricks::F16(values) => f32_from_finite_f16(values[at]),
        }
    }

    /// The eight values from an offset on, a row along z if the offset is a multiple of eight.
    ///
    /// # Panics
    /// If there is no such brick, or the offset is larger than 504.
    #[inline]
    pub fn row(&self, brick: u32, offset: usize, row: &mut [f32; 8]) {
        let at = brick as usize * BRICK_VOXELS + offset;
        match self {
            Bricks::F32(values) => row.copy_from_slice(&values[at..at + 8]),
            Bricks::F16(values) => {
                for (to, from) in row.iter_mut().zip(&values[at..at + 8]) {
                    *to = f32_from_finite_f16(*from);
                }
            }
        }
    }

    /// The values at an offset and at its seven neighbours towards +x, +y, +z, all in the same brick: corner
    /// `i` is `dx << 2 | dy << 1 | dz`.
    ///
    /// # Panics
    /// If there is no such brick or offset.
    #[inline]
    pub fn corners(&self, brick: u32, offset: usize) -> [f32; 8] {
        // Neighbours are 64, 8 and 1 apart, so the eight lie in 74 consecutive values: one bounds check.
        let at = brick as usize * BRICK_VOXELS + offset;
        match self {
            Bricks::F32(values) => {
                let v: &[f32; 74] = values[at..at + 74].try_into().expect("74 values");
                [v[0], v[1], v[8], v[9], v[64], v[65], v[72], v[73]]
            }
            Bricks::F16(values) => {
                let v: &[u16; 74] = values[at..at + 74].try_into().expect("74 values");
                // Written out: `map` over the steps stays a call in a loop.
                let f = f32_from_finite_f16;
                [f(v[0]), f(v[1]), f(v[8]), f(v[9]), f(v[64]), f(v[65]), f(v[72]), f(v[73])]
            }
        }
    }

    /// The values at an offset and one step along each of two axes: `[00, 01, 10, 11]`, the first digit for
    /// `step_a`. The steps are 64, 8 or 1, for x, y and z.
    ///
    /// # Panics
    /// If there is no such brick, or the offsets leave it.
    #[inline]
    pub fn quad(&self, brick: u32, offset: usize, step_a: usize, step_b: usize) -> [f32; 4] {
        let at = brick as usize * BRICK_VOXELS;
        match self {
            Bricks::F32(values) => {
                let v: &[f32; BRICK_VOXELS] = values[at..at + BRICK_VOXELS].try_into().expect("512 values");
                [v[offset], v[offset + step_b], v[offset + step_a], v[offset + step_a + step_b]]
            }
            Bricks::F16(values) => {
                let v: &[u16; BRICK_VOXELS] = values[at..at + BRICK_VOXELS].try_into().expect("512 values");
                let f = |offset: usize| f32_from_finite_f16(v[offset]);
                [f(offset), f(offset + step_b), f(offset + step_a), f(offset + step_a + step_b)]
            }
        }
    }
}

/// The value of a finite f16. Exact: the exponent is moved by a multiplication with a power of two, which also
/// makes subnormals right.
#[inline]
pub fn f32_from_finite_f16(bits: u16) -> f32 {
    const TWO_POW_112: f32 = f32::from_bits((127 + 112) << 23);
    let magnitude = f32::from_bits(u32::from(bits & 0x7fff) << 13) * TWO_POW_112;
    f32::from_bits(magnitude.to_bits() | u32::from(bits & 0x8000) << 16)
}

/// Bounds of a set of values, both ends included.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Bounds {
    /// The smallest value.
    pub min: f32,
    /// The largest value.
    pub max: f32,
}

impl Bounds {
    /// The bounds of one value.
    pub fn of(value: f32) -> Self {
        Bounds { min: value, max: value }
    }

    /// The bounds of both sets.
    #[must_use]
    pub fn union(self, other: Bounds) -> Bounds {
        Bounds { min: self.min.min(other.min), max: self.max.max(other.max) }
    }

    /// Whether all values are the same.
    pub fn is_constant(self) -> bool {
        self.min == self.max
    }
}

/// What the tree needs to know of a brick's values.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BrickSummary {
    /// Bounds of the voxels at the low end of some axes: entry `dx << 2 | dy << 1 | dz` covers the voxels
    /// whose coordinate is 0 along each axis set. Entry 0 is the whole brick. A neighbour's trilinear
    /// footprint reaches just these voxels.
    pub low_bounds: [Bounds; 8],
    /// The mean of all voxels.
    pub mean: f32,
}

impl BrickSummary {
    /// Summarises the values of a brick. They must be finite.
    pub fn of(values: &[f32; BRICK_VOXELS]) -> Self {
        // Bounds of the columns of constant z over rows: all, those of y = 0, of x = 0, of x = y = 0.
        let (mut min, mut max) = ([[f32::INFINITY; 8]; 4], [[f32::NEG_INFINITY; 8]; 4]);
        let mut take = |axes: usize, row: &[f32]| {
            for z in 0..8 {
                min[axes][z] = if row[z] < min[axes][z] { row[z] } else { min[axes][z] };
                max[axes][z] = if row[z] > max[axes][z] { row[z] } else { max[axes][z] };
            }
        };
        let (rows, _) = values.as_chunks::<8>();
        rows.iter().for_each(|row| take(0, row));
        rows.iter().step_by(8).for_each(|row| take(1, row));
        rows[..8].iter().for_each(|row| take(2, row));
        take(3, &rows[0]);
        let low_bounds = std::array::from_fn(|axes| {
            let columns = if axes & 1 == 0 { 0..8 } else { 0..1 };
            let of = |z: usize| Bounds { min: min[axes / 2][z], max: max[axes / 2][z] };
            columns.map(of).fold(Bounds { min: f32::INFINITY, max: f32::NEG_INFINITY }, Bounds::union)
        });
        // Summed in f64: 512 values near f32::MAX would overflow.
        let mut sums = [0.0; 8];
        rows.iter().for_each(|row| (0..8).for_each(|z| sums[z] += f64::from(row[z])));
        let sum: f64 = sums.iter().sum();
        BrickSummary { low_bounds, mean: (sum / BRICK_VOXELS as f64) as f32 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn every_finite_half_converts_exactly() {
        for bits in 0..=u16::MAX {
            let reference = half::f16::from_bits(bits);
            if reference.is_finite() {
                assert_eq!(f32_from_finite_f16(bits).to_bits(), reference.to_f32().to_bits(), "{bits:#x}");
            }
        }
    }

    proptest! {
        #[test]
        fn low_bounds_cover_the_low_voxels(seed in any::<u32>()) {
            let mut values = [0.0; BRICK_VOXELS];
            for (i, v) in values.iter_mut().enumerate() {
                *v = ((i as u32 ^ seed).wrapping_mul(2_654_435_761) >> 8) as f32 - 8e6;
            }
            let summary = BrickSummary::of(&values);
            for (axes, bounds) in summary.low_bounds.iter().enumerate() {
                let low = (0..BRICK_VOXELS).filter(|o| {
                    let [x, y, z] = [o >> 6, o >> 3 & 7, o & 7];
                    (axes & 4 == 0 || x == 0) && (axes & 2 == 0 || y == 0) && (axes & 1 == 0 || z == 0)
                });
                let values: Vec<f32> = low.map(|o| values[o]).collect();
                prop_assert_eq!(bounds.min, values.iter().copied().fold(f32::INFINITY, f32::min));
                prop_assert_eq!(bounds.max, values.iter().copied().fold(f32::NEG_INFINITY, f32::max));
            }
        }

        #[test]
        fn corners_are_the_eight_values(offset in 0usize..439, half in any::<bool>()) {
            prop_assume!(offset >> 3 & 7 != 7 && offset & 7 != 7);
            let bricks = match half {
                true => Bricks::F16((0..1024).map(|i| half::f16::from_f32(i as f32).to_bits()).collect()),
                false => Bricks::F32((0..1024).map(|i| i as f32).collect()),
            };
            for (i, value) in bricks.corners(1, offset).iter().enumerate() {
                let at = offset + (i >> 2) * 64 + (i >> 1 & 1) * 8 + (i & 1);
                prop_assert_eq!(*value, bricks.value(1, at));
                prop_assert_eq!(*value, (512 + at) as f32);
            }
        }
    }
}
