//! Random numbers without state: every number is a hash of where it is used (pixel, sample, dimension). A
//! picture is therefore the same for any number of threads and any order of pixels, and a shader can draw the
//! same numbers.
//!
//! What is done with the numbers (directions, distances) lives with the thing that is sampled, such as
//! [`phase`](crate::phase).

/// What [`hash_u32`] multiplies by.
pub const HASH_FACTORS: [u32; 2] = [0x21f0_aaad, 0xd35a_2d97];

/// The golden ratio's bits.
pub const GOLDEN: u32 = 0x9e37_79b9;

/// What [`unit_f32`] counts in.
pub const UNIT_STEP: f32 = 1.0 / 16_777_216.0;

/// The additive recurrence of the plastic number, as steps of 32 bits (Roberts, "The Unreasonable Effectiveness of
/// Quasirandom Sequences", 2018).
pub const PLASTIC_STEPS: [u32; 2] = [0xc13f_a9a9, 0x91e1_0da5];

/// A bijection of 32 bits that flips each output bit with a chance close to one half when any input bit
/// flips.
///
/// Two rounds of xor-shift and multiplication, with the constants that TheIronBorn found by search (bias
/// 0.107) with Wellons' hash-prospector (<https://github.com/skeeto/hash-prospector>). 0 maps to 0.
#[inline]
pub fn hash_u32(x: u32) -> u32 {
    let x = (x ^ (x >> 16)).wrapping_mul(HASH_FACTORS[0]);
    let x = (x ^ (x >> 15)).wrapping_mul(HASH_FACTORS[1]);
    x ^ (x >> 15)
}

/// 32 random bits for one `dimension` (the count of numbers drawn so far) of one `sample` of the pixel at
/// `x`, `y`.
///
/// Pixels of an image of up to 65536 x 65536 start from different values. The dimension enters last, so that
/// a loop over dimensions, or over samples, repeats only the rounds that change.
#[inline]
pub fn hash_pixel(x: u32, y: u32, sample: u32, dimension: u32) -> u32 {
    // The golden ratio's bits keep the corner pixel's first number away from the hash's fixed point at 0.
    let pixel = hash_u32((x ^ y.rotate_left(16)).wrapping_add(GOLDEN));
    let path = hash_u32(pixel.wrapping_add(sample));
    hash_u32(path.wrapping_add(dimension))
}

/// The upper 24 of the `bits` as a number in [0, 1), evenly spaced by 2^-24: every step a float can take near
/// 1.
#[inline]
pub fn unit_f32(bits: u32) -> f32 {
    (bits >> 8) as f32 * UNIT_STEP
}

#[cfg(test)]
mod tests {
    use super::*;

    /// How many standard deviations the chi-square statistic of `counts`, expected equal, lies above its
    /// mean.
    fn chi_square_excess(counts: &[u32]) -> f64 {
        let expected = counts.iter().map(|&c| f64::from(c)).sum::<f64>() / counts.len() as f64;
        let chi_square: f64 = counts.iter().map(|&c| (f64::from(c) - expected).powi(2) / expected).sum();
        let freedom = counts.len() as f64 - 1.0;
        (chi_square - freedom) / (2.0 * freedom).sqrt()
    }

    #[test]
    fn flipping_an_input_bit_flips_half_of_the_output_bits() {
        let tries = 4096u32;
        for input in 0..32 {
            let mut flips = [0u32; 32];
            for i in 0..tries {
                let x = i.wrapping_mul(0x9e37_79b1);
                let changed = hash_u32(x) ^ hash_u32(x ^ (1 << input));
                flips.iter_mut().enumerate().for_each(|(bit, n)| *n += changed >> bit & 1);
            }
            for (output, n) in flips.into_iter().enumerate() {
                let share = f64::from(n) / f64::from(tries);
                assert!((share - 0.5).abs() < 0.05, "input bit {input} flips output bit {output} in {share}");
            }
        }
    }

    #[test]
    fn hash_is_a_bijection_on_what_we_can_try() {
        let mut seen: Vec<u32> = (0..1 << 18).map(|i: u32| hash_u32(i.wrapping_mul(16_411))).collect();
        seen.sort_unstable();
        assert!(seen.windows(2).all(|w| w[0] != w[1]));
    }

    #[test]
    fn unit_numbers_are_uniform_along_every_argument() {
        type Along = fn(u32) -> u32;
        let along: [(&str, Along); 4] = [
            ("x", |i| hash_pixel(i, 7, 3, 1)),
            ("y", |i| hash_pixel(7, i, 3, 1)),
            ("sample", |i| hash_pixel(7, 9, i, 1)),
            ("dimension", |i| hash_pixel(7, 9, 3, i)),
        ];
        for (name, hash) in along {
            let mut counts = [0u32; 256];
            for i in 0..1 << 17 {
                counts[(unit_f32(hash(i)) * 256.0) as usize] += 1;
            }
            let excess = chi_square_excess(&counts);
            assert!(excess.abs() < 4.0, "along {name}: {excess} standard deviations");
        }
    }

    #[test]
    fn neighbours_along_every_argument_are_independent() {
        type Pair = fn(u32, u32) -> (u32, u32);
        let pairs: [(&str, Pair); 4] = [
            ("x", |x, y| (hash_pixel(x, y, 0, 0), hash_pixel(x + 1, y, 0, 0))),
            ("y", |x, y| (hash_pixel(x, y, 0, 0), hash_pixel(x, y + 1, 0, 0))),
            ("sample", |x, y| (hash_pixel(x, y, 0, 0), hash_pixel(x, y, 1, 0))),
            ("dimension", |x, y| (hash_pixel(x, y, 0, 0), hash_pixel(x, y, 0, 1))),
        ];
        for (name, pair) in pairs {
            let mut counts = vec![0u32; 32 * 32];
            for i in 0..1 << 17 {
                let (a, b) = pair(i % 512, i / 512);
                counts[(a >> 27 << 5 | b >> 27) as usize] += 1;
            }
            let excess = chi_square_excess(&counts);
            assert!(excess.abs() < 4.0, "along {name}: {excess} standard deviations");
        }
    }

    #[test]
    fn unit_numbers_stay_below_one() {
        assert_eq!(unit_f32(0), 0.0);
        assert_eq!(unit_f32(255), 0.0);
        assert_eq!(unit_f32(u32::MAX), 1.0 - f32::EPSILON / 2.0);
        assert_eq!(unit_f32(1 << 31), 0.5);
        assert_ne!(hash_pixel(0, 0, 0, 0), 0);
    }
}
