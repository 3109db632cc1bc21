//! The numbers of a path: a few that cover their ranges more evenly than chance would, and any count of
//! random ones after these. Each pixel's are its own, whatever thread or order; what is done with them lives
//! with what is sampled.
//!
//! Neighbouring pixels are independent. Spreading one sequence over pixels would move noise to high
//! frequencies, but only for a count of samples that is known beforehand, and renderings here may stop or go
//! on at any.

use crate::hash::{hash_pixel, hash_u32, unit_f32};

/// How many numbers belong together: all of them, not only each, are evenly spread.
pub const SET_SIZE: u32 = 4;

/// From this set on numbers are random: what a path does that late depends on too much for evenness to
/// survive, and making sets takes time.
pub const EVEN_SETS: u32 = 3;

/// The golden ratio's bits; multiples of it are far from each other.
const GOLDEN: u32 = 0x9e37_79b9;

/// Four bits of an index at a time, from the least: what each of their values flips in each of four coordinates. The
/// coordinates' bits stand in reverse, the most significant last: so does scrambling want them.
///
/// Sobol's sequence with the primitive polynomials and first numbers of Joe and Kuo, "Constructing Sobol
/// sequences with better two-dimensional projections", SIAM Journal on Scientific Computing 30 (2008).
static FLIPS: [[[u32; 4]; 16]; 8] = {
    // The first coordinate has no polynomial: it is the index with its bits in reverse.
    let coordinates = [
        directions(0, 0, [1, 1, 1]),
        directions(1, 0, [1, 0, 0]),
        directions(2, 1, [1, 3, 0]),
        directions(3, 1, [1, 3, 1]),
    ];
    let mut table = [[[0; 4]; 16]; 8];
    let mut entry = 0;
    while entry < 8 * 16 * 4 * 4 {
        let (digit, value, d, bit) = (entry / 256, entry / 16 % 16, entry / 4 % 4, entry % 4);
        if value >> bit & 1 == 1 {
            table[digit][value][d] ^= coordinates[d][4 * digit + bit];
        }
        entry += 1;
    }
    table
};

/// The directions of one coordinate, with their bits in reverse. `inner` are the coefficients of the
/// polynomial of that `degree` between the first and the last, which are 1; `first` its first odd numbers.
const fn directions(degree: usize, inner: u32, first: [u32; 3]) -> [u32; 32] {
    let mut m = [1u32; 32];
    let mut k = 0;
    while k < 32 && degree > 0 {
        if k < degree {
            m[k] = first[k];
        } else {
            // m[k] has k + 1 bits, so that shifts lose nothing.
            let mut next = m[k - degree] ^ (m[k - degree] << degree);
            let mut i = 1;
            while i < degree {
                if inner >> (degree - 1 - i) & 1 == 1 {
                    next ^= m[k - i] << i;
                }
                i += 1;
            }
            m[k] = next;
        }
        k += 1;
    }
    let mut k = 0;
    while k < 32 {
        m[k] = (m[k] << (31 - k)).reverse_bits();
        k += 1;
    }
    m
}

/// The point of Sobol's sequence at an index, in four coordinates with their bits in reverse.
#[inline]
fn sobol(index: u32) -> [u32; 4] {
    let mut point = [0; 4];
    for (digit, flips) in FLIPS.iter().enumerate() {
        let [a, b, c, d] = flips[(index >> (4 * digit) & 15) as usize];
        point = [point[0] ^ a, point[1] ^ b, point[2] ^ c, point[3] ^ d];
    }
    point
}

/// Owen's scrambling of a number whose bits stand in reverse: whether a bit is flipped depends on the more
/// significant ones at random, so that halves, quarters and so on are swapped as wholes. Returns the bits in
/// their usual order.
///
/// In operations that carry from low bits to high ones only, after Laine and Karras, "Stratified Sampling for
/// Stochastic Transparency" (2011); the constants are Vegdahl's, "Building a Better LK Hash" (2021).
#[inline]
fn scramble_reversed(bits: u32, seed: u32) -> u32 {
    let x = bits ^ bits.wrapping_mul(0x3d20_adea);
    let x = x.wrapping_add(seed).wrapping_mul(seed >> 16 | 1);
    let x = x ^ x.wrapping_mul(0x0552_6c56);
    (x ^ x.wrapping_mul(0x53a2_2864)).reverse_bits()
}

/// The numbers of one path: of one sample of one pixel.
///
/// Even numbers come in sets of [`SET_SIZE`]. Within a set, and over samples 0 to 2^m - 1 of a pixel, they
/// are a scrambled Sobol sequence: with boxes whose sides are powers of ½, the first pair falls once into
/// each box of area 2^-m, and all four together fall eight times into each box of volume 2^(3-m). Sets are
/// independent of each other (Burley, "Practical Hash-based Owen Scrambling", Journal of Computer Graphics
/// Techniques 9(4), 2020). Every single number is uniform, so estimates are without bias.
///
/// Evenness helps only where the same number of different samples serves the same purpose. So let each
/// purpose have a set of its own with [`start_set`](Self::start_set), such as each scattering, and take what
/// a loop draws without limit from [`random`](Self::random), which does not move the even numbers.
#[derive(Debug, Clone)]
pub struct Sampler {
    pixel: u32,
    sample: u32,
    set: u32,
    /// How many numbers of the set are used; all of them if it has not been made.
    used: u32,
    values: [f32; 4],
    path: u32,
    drawn: u32,
}

impl Sampler {
    /// The numbers of one sample of the pixel at `pixel_x`, `pixel_y`. Another `seed` makes another,
    /// independent picture. Starts with set 0.
    #[inline]
    pub fn new(pixel_x: u32, pixel_y: u32, sample_index: u32, seed: u32) -> Self {
        let pixel = hash_pixel(pixel_x, pixel_y, seed, 0);
        let path = hash_u32(pixel ^ hash_u32(sample_index.wrapping_add(GOLDEN)));
        let mut sampler =
            Sampler { pixel, sample: sample_index, set: 0, used: 0, values: [0.0; 4], path, drawn: 0 };
        sampler.start_set(0);
        sampler
    }

    /// Goes to a set, forward or back. Its numbers are the same whenever one gets there.
    #[inline]
    pub fn start_set(&mut self, set: u32) {
        self.set = set;
        self.used = 0;
        if set < EVEN_SETS {
            self.values = even_set(self.pixel, self.sample, set);
        }
    }

    /// The next number, from 0 to less than 1: even in the first [`EVEN_SETS`] sets, random beyond, and after the last of a
    /// set.
    #[inline]
    pub fn next_1d(&mut self) -> f32 {
        let even = if self.set < EVEN_SETS { self.values.get(self.used as usize).copied() } else { None };
        self.used = (self.used + 1).min(SET_SIZE);
        even.unwrap_or_else(|| self.random())
    }

    /// The next two numbers that are even together: those of the next whole pair of a set.
    #[inline]
    pub fn next_2d(&mut self) -> [f32; 2] {
        self.used += self.used & 1;
        [self.next_1d(), self.next_1d()]
    }

    /// A random number from 0 to less than 1. There are any number of them, and drawing one leaves the even
    /// numbers where they are.
    #[inline]
    pub fn random(&mut self) -> f32 {
        self.drawn = self.drawn.wrapping_add(1);
        unit_f32(hash_u32(hash_u32(self.path.wrapping_add(self.drawn)) ^ self.path.rotate_left(16)))
    }

    /// Two random numbers.
    #[inline]
    pub fn random_2d(&mut self) -> [f32; 2] {
        [self.random(), self.random()]
    }

    /// Three random numbers.
    #[inline]
    pub fn random_3d(&mut self) -> [f32; 3] {
        [self.random(), self.random(), self.random()]
    }
}

/// One sample's numbers of a set.
fn even_set(pixel: u32, sample: u32, set: u32) -> [f32; 4] {
    let key = hash_u32(pixel.wrapping_add(GOLDEN.wrapping_mul(set + 1)));
    // Scrambling the index as well shuffles each 2^m samples among themselves: sets lose their relation.
    let [a, b, c, d] = sobol(scramble_reversed(sample.reverse_bits(), key));
    let value = |bits, d| unit_f32(scramble_reversed(bits, hash_u32(key ^ GOLDEN.wrapping_mul(d))));
    [value(a, 1), value(b, 2), value(c, 3), value(d, 4)]
}

#[cfg(test)]
mod tests;
