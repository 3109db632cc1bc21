//! Predicting the numbers of a brick from their neighbours, so that what is left compresses well.
//!
//! Numbers are unsigned, of some bits; a residual is a number less its prediction, modulo 2^bits. Neighbours outside of
//! the brick count as 0 unless a predictor says otherwise. Which bytes residuals become is [`super::page`]'s.

use crate::space::BRICK_VOXELS;

/// How numbers are predicted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Predictor {
    /// Zero: residuals are the numbers.
    Zero,
    /// Differences along z, then along y, then along x: exact where the numbers are a sum of functions of two axes.
    Lorenzo,
    /// Half the sum of the number before along x and the mean of those before along y and z, all halves rounded down;
    /// without the former at x = 0. At y = 0 the number before along z, at z = 0 that along y, at both that along x. For
    /// numbers of few bits, which are mostly noise.
    Average,
}

impl Predictor {
    pub(super) const ALL: [Predictor; 3] = [Predictor::Zero, Predictor::Lorenzo, Predictor::Average];
}

/// Unsigned integers that wrap.
pub(super) trait Number: Copy + Default {
    const ALL_BITS: Self;
    fn plus(self, other: Self) -> Self;
    fn minus(self, other: Self) -> Self;
    /// Half the sum, rounded down.
    fn mean(self, other: Self) -> Self;
    fn masked(self, mask: Self) -> Self;
}

macro_rules! number {
    ($type:ty) => {
        impl Number for $type {
            const ALL_BITS: $type = <$type>::MAX;
            #[inline(always)]
            fn plus(self, other: Self) -> Self {
                self.wrapping_add(other)
            }
            #[inline(always)]
            fn minus(self, other: Self) -> Self {
                self.wrapping_sub(other)
            }
            #[inline(always)]
            fn mean(self, other: Self) -> Self {
                (self & other).wrapping_add((self ^ other) >> 1)
            }
            #[inline(always)]
            fn masked(self, mask: Self) -> Self {
                self & mask
            }
        }
    };
}

number!(u8);
number!(u16);
number!(u32);

/// The average that predicts a number from those before it along x, y and z.
#[inline(always)]
fn average<T: Number>(numbers: &[T; BRICK_VOXELS], x: usize, y: usize, z: usize) -> T {
    let at = x << 6 | y << 3 | z;
    let before = |step: usize| numbers[at.wrapping_sub(step) % BRICK_VOXELS];
    match (x, y, z) {
        (0, 0, 0) => T::default(),
        (_, 0, 0) => before(64),
        (_, _, 0) => before(8),
        (_, 0, _) => before(1),
        (0, ..) => before(1).mean(before(8)),
        _ => before(1).mean(before(8)).mean(before(64)),
    }
}

/// Replaces numbers by their residuals.
pub(super) fn residuals<T: Number>(predictor: Predictor, numbers: &mut [T; BRICK_VOXELS], mask: T) {
    match predictor {
        Predictor::Zero => {}
        Predictor::Lorenzo => {
            for step in [1, 8, 64] {
                for at in (step..BRICK_VOXELS).rev().filter(|at| at / step % 8 != 0) {
                    numbers[at] = numbers[at].minus(numbers[at - step]);
                }
            }
        }
        Predictor::Average => {
            let given = *numbers;
            for (at, number) in numbers.iter_mut().enumerate() {
                *number = number.minus(average(&given, at >> 6, at >> 3 & 7, at & 7));
            }
        }
    }
    numbers.iter_mut().for_each(|number| *number = number.masked(mask));
}

/// Replaces residuals by their numbers.
pub(super) fn restore<T: Number>(predictor: Predictor, numbers: &mut [T; BRICK_VOXELS], mask: T) {
    match predictor {
        Predictor::Zero => {}
        Predictor::Average => {
            for x in 0..8 {
                for y in 0..8 {
                    for z in 0..8 {
                        let at = x << 6 | y << 3 | z;
                        numbers[at] = numbers[at].plus(average(numbers, x, y, z)).masked(mask);
                    }
                }
            }
        }
        Predictor::Lorenzo => {
            // Sums along x and y are sums of whole planes and rows.
            let (planes, _) = numbers.as_chunks_mut::<64>();
            for x in 1..8 {
                let [before, plane] = &mut planes[x - 1..=x] else { return };
                plane.iter_mut().zip(before).for_each(|(number, before)| *number = number.plus(*before));
            }
            for plane in planes {
                let (rows, _) = plane.as_chunks_mut::<8>();
                for y in 1..8 {
                    let [before, row] = &mut rows[y - 1..=y] else { return };
                    row.iter_mut().zip(before).for_each(|(number, before)| *number = number.plus(*before));
                }
                for row in rows {
                    (1..8).for_each(|z| row[z] = row[z].plus(row[z - 1]));
                }
            }
        }
    }
    numbers.iter_mut().for_each(|number| *number = number.masked(mask));
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn numbers_come_back(seed in any::<u32>(), bits in 1_u32..=8) {
            let number = |i: usize| (i as u32 ^ seed).wrapping_mul(2_654_435_761);
            let codes: [u8; BRICK_VOXELS] = std::array::from_fn(|i| (number(i) >> (32 - bits)) as u8);
            let words: [u32; BRICK_VOXELS] = std::array::from_fn(number);
            for predictor in Predictor::ALL {
                let (mut coded, mut word) = (codes, words);
                residuals(predictor, &mut coded, (0xff_u32 >> (8 - bits)) as u8);
                residuals(predictor, &mut word, u32::MAX);
                prop_assert!(coded.iter().all(|code| u32::from(*code) < 1 << bits));
                restore(predictor, &mut coded, (0xff_u32 >> (8 - bits)) as u8);
                restore(predictor, &mut word, u32::MAX);
                prop_assert_eq!((coded, word), (codes, words));
            }
        }
    }

    #[test]
    fn predictions_meet_what_they_are_for() {
        let of = |value: fn(usize, usize, usize) -> usize| {
            std::array::from_fn(|i| value(i >> 6, i >> 3 & 7, i & 7) as u8)
        };
        let ramp = of(|x, y, z| 3 * x + 5 * y + 7 * z + 1);
        let product = of(|x, y, z| x * y + y * z + x * z);
        let constant = of(|_, _, _| 9);
        let left = |predictor, mut numbers: [u8; BRICK_VOXELS]| {
            residuals(predictor, &mut numbers, 0xff);
            numbers.iter().filter(|number| **number != 0).count()
        };
        assert_eq!(left(Predictor::Lorenzo, ramp), 1 + 7 * 3);
        assert_eq!(left(Predictor::Lorenzo, product), 7 * 7 * 3);
        for predictor in [Predictor::Average, Predictor::Lorenzo] {
            assert_eq!(left(predictor, constant), 1);
        }
    }
}
