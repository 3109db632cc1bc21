//! Errors as they are seen, and partly empty bricks in [`Codec::Sparse`] with codes that make them least.
//!
//! What is seen of an error is its sum along rays, and only where light gets. Over all directions of rays that is a sum over pairs of
//! voxels: the product of their errors, times what light gets to both, times a weight that falls with the square of the
//! distance. Errors of one sign in a row show, those that take turns hardly do. So codes are not those of the nearest values:
//! from these, one after the other is stepped up or down as long as less is seen, and what was left out of a
//! brick comes back in its neighbours.

use std::sync::LazyLock;

use fearless_simd::{Simd, dispatch};
use nuage_volume::codec::{Codec, sparse};
use nuage_volume::space::BRICK_VOXELS;

use super::quantize::{Brick, ChannelScale, Error, SIMD, StoredLine};

/// How much light gets to each block of 2³ voxels of a brick, block `x << 4 | y << 2 | z`, as an amplitude up to 1.
pub type Light = [f32; 64];

/// The voxels along an axis whose errors count together.
const REACH: usize = 3;

/// The weight of the product of two errors, by their distance along axes from the smallest to the largest. A voxel is the product of
/// three triangles, as interpolation makes it; weights are integrals of the correlation of two along lines,
/// in the mean over all directions, and fade by 1/e in 8 voxels.
const WEIGHTS: [([usize; 3], f32); 20] = [
    ([0, 0, 0], 1.0),
    ([0, 0, 1], 0.4204),
    ([0, 0, 2], 0.0822),
    ([0, 0, 3], 0.0303),
    ([0, 1, 1], 0.2116),
    ([0, 1, 2], 0.0628),
    ([0, 1, 3], 0.0264),
    ([0, 2, 2], 0.0351),
    ([0, 2, 3], 0.0192),
    ([0, 3, 3], 0.0125),
    ([1, 1, 1], 0.1265),
    ([1, 1, 2], 0.0502),
    ([1, 1, 3], 0.0231),
    ([1, 2, 2], 0.0305),
    ([1, 2, 3], 0.0177),
    ([1, 3, 3], 0.0118),
    ([2, 2, 2], 0.0215),
    ([2, 2, 3], 0.0133),
    ([2, 3, 3], 0.0101),
    ([3, 3, 3], 0.0082),
];

/// The rows of weights around a voxel, with a 0 to make them eight.
const AROUND: usize = 2 * REACH + 1;
static ROWS: LazyLock<[[f32; 8]; AROUND * AROUND]> = LazyLock::new(|| {
    let weight = |row: usize, z: usize| {
        let mut distance = [row / AROUND, row % AROUND, z].map(|c| c.abs_diff(REACH));
        distance.sort_unstable();
        WEIGHTS.iter().find(|(at, _)| *at == distance).map_or(0.0, |(_, weight)| *weight)
    };
    std::array::from_fn(|row| std::array::from_fn(|z| weight(row, z)))
});

/// What the errors of voxels around add up to at each voxel of a brick and its surroundings.
struct Field([f32; Field::ROWS * Field::ROWS * Field::ROW]);

impl Field {
    /// The rows along x and y, and what a row holds.
    const ROWS: usize = 8 + 2 * REACH;
    const ROW: usize = 16;

    #[inline(always)]
    fn of(errors: &Brick) -> Box<Field> {
        let mut field = Box::new(Field([0.0; Field::ROWS * Field::ROWS * Field::ROW]));
        for (voxel, error) in errors.iter().enumerate().filter(|(_, error)| **error != 0.0) {
            field.add(voxel, *error);
        }
        field
    }

    /// Adds an error.
    #[inline(always)]
    fn add(&mut self, voxel: usize, error: f32) {
        let begin = Field::index(voxel, 0);
        let rows = &*ROWS;
        for (row, weights) in rows.iter().enumerate() {
            let at = begin + (row / AROUND * Field::ROWS + row % AROUND) * Field::ROW;
            let Some(sums) = self.0[at..].first_chunk_mut::<8>() else { return };
            (0..8).for_each(|z| sums[z] += error * weights[z]);
        }
    }

    fn at(&self, voxel: usize) -> f32 {
        self.0[Field::index(voxel, REACH)]
    }

    fn index(voxel: usize, border: usize) -> usize {
        let [x, y, z] = [voxel >> 6, voxel >> 3 & 7, voxel & 7].map(|c| c + border);
        (x * Field::ROWS + y) * Field::ROW + z
    }

    /// What is seen of errors whose field this is.
    fn seen(&self, errors: &Brick) -> f64 {
        let products = errors.iter().enumerate().map(|(voxel, error)| f64::from(error * self.at(voxel)));
        products.sum::<f64>().max(0.0)
    }
}

/// A brick whose errors count by what is seen of them.
pub struct Seen<'a> {
    values: &'a Brick,
    scale: &'a ChannelScale,
    /// What an error is multiplied by: the light there, in units of the channel.
    amplitude: Brick,
    /// The ways to leave voxels out; none if the brick is not sparse.
    ways: Vec<Way>,
}

/// Voxels that are kept, with codes of some bits.
struct Way {
    bits: u8,
    /// Those are whose magnitude is more than this.
    above: f32,
    /// The words they take, by two.
    pairs: u8,
}

/// The codes of a brick that are nearest to its values.
struct Nearest {
    line: StoredLine,
    bits: u8,
    /// The value of each code.
    levels: Vec<f32>,
    symbols: sparse::Symbols,
    /// The errors, times the light.
    errors: Brick,
}

/// A brick in codes.
struct Coded {
    line: StoredLine,
    bits: u8,
    symbols: sparse::Symbols,
    error: Error,
}

/// Which voxels are left out: those below these parts of the largest value over the number of codes.
const LEFT_OUT: [f32; 2] = [0.05, 0.15];

/// By what part the range of codes ends before the largest value.
const SHORTENED: [f32; 2] = [0.0, 0.1];

/// How often all codes are gone through.
const SWEEPS: usize = 6;

/// The words before masks and codes.
const HEAD_WORDS: usize = 2;

impl<'a> Seen<'a> {
    /// Begins with a brick and the light in it.
    pub fn of(values: &'a Brick, scale: &'a ChannelScale, light: &Light) -> Self {
        let block = |voxel: usize| (voxel >> 7) << 4 | (voxel >> 4 & 3) << 2 | (voxel >> 1 & 3);
        let amplitude = std::array::from_fn(|voxel| light[block(voxel)] / scale.unit);
        let mut seen = Seen { values, scale, amplitude, ways: Vec::new() };
        let empty = values.iter().filter(|value| **value == 0.0).count();
        if scale.background == 0.0 && empty > 0 && empty < BRICK_VOXELS {
            let largest = values.iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
            for bits in 1..=sparse::MAX_BITS {
                let above = LEFT_OUT.map(|part| part * largest / f32::from(1_u16 << bits));
                seen.ways.extend(above.map(|above| seen.way(bits, above.min(scale.max_error))));
            }
            seen.ways.sort_by_key(|way| way.pairs);
        }
        seen
    }

    fn way(&self, bits: u8, above: f32) -> Way {
        let row = |row: &[f32; 8]| (0..8).fold(0, |bits, z| bits | u64::from(row[z].abs() > above) << z);
        let plane = |rows: &[[f32; 8]]| (0..8).fold(0, |bits, y| bits | row(&rows[y]) << (8 * y));
        let rows = self.values.as_chunks::<8>().0;
        let is_there = std::array::from_fn(|x| plane(&rows[8 * x..8 * x + 8]));
        let words = HEAD_WORDS + sparse::word_count(bits, &is_there);
        Way { bits, above, pairs: words.div_ceil(2) as u8 }
    }

    /// The sparse codecs to be tried, the cheapest first.
    pub fn codecs(&self) -> Vec<Codec> {
        let codec = |way: &Way| Codec::Sparse { is_fitted: false, pairs: way.pairs };
        let mut codecs: Vec<Codec> = self.ways.iter().map(codec).collect();
        codecs.dedup();
        codecs
    }

    /// How far off the brick is in one of these codecs. What is seen of it is squared error and bias together.
    pub fn sparse_error(&self, pairs: u8) -> Option<Error> {
        self.coded(pairs).map(|coded| coded.error)
    }

    /// Appends the words of a codec that has an error.
    pub fn write(&self, pairs: u8, words: &mut Vec<u32>) {
        let Some(Coded { line, bits, symbols, .. }) = self.coded(pairs) else { return };
        let end = words.len() + 2 * usize::from(pairs);
        words.extend([line.word, u32::from(bits) | sparse::BENT]);
        sparse::pack(bits, &symbols, words);
        words.resize(end, 0);
    }

    /// What is seen of the error of given values.
    pub fn of_values(&self, given: &Brick) -> f64 {
        let errors = self.errors(given);
        dispatch!(*SIMD, simd => simd.vectorize(
            #[inline(always)]
            || Field::of(&errors).seen(&errors)
        ))
    }

    /// What is seen of errors like noise, which do not hang together: the sum of their squares.
    pub fn of_noise(&self, given: &Brick) -> f64 {
        self.errors(given).iter().map(|error| f64::from(*error).powi(2)).sum()
    }

    fn errors(&self, given: &Brick) -> Brick {
        std::array::from_fn(|i| (given[i] - self.values[i]) * self.amplitude[i])
    }

    /// Of the ways that take so many words, and the ranges, the one whose nearest codes are the best, made better.
    fn coded(&self, pairs: u8) -> Option<Coded> {
        let ways = self.ways.iter().filter(|way| way.pairs == pairs);
        let all = ways.flat_map(|way| SHORTENED.map(|part| self.nearest(way, part)));
        let squared = |nearest: &Nearest| nearest.errors.iter().map(|error| error * error).sum::<f32>();
        let best = all.min_by(|a, b| squared(a).total_cmp(&squared(b)))?;
        Some(self.better(best))
    }

    /// The codes of the nearest values.
    fn nearest(&self, way: &Way, shortened: f32) -> Nearest {
        let Way { bits, above, .. } = *way;
        let (values, floor) = (self.values, self.scale.floor);
        let kept = values.iter().filter(|value| value.abs() > above);
        let (min, max) = kept
            .fold((f32::INFINITY, f32::NEG_INFINITY), |(min, max), value| (min.min(*value), max.max(*value)));
        let last = (1_usize << bits) - 1;
        let line = StoredLine::covering(min, max - shortened * (max - min), last as u32, self.scale.unit);
        // As the decoder has them.
        let level =
            |code: usize| (line.line.low + line.line.step * sparse::bend(bits, code as u32)).max(floor);
        let levels: Vec<f32> = (0..=last).map(level).collect();
        let mut symbols = [0; BRICK_VOXELS];
        let mut errors: Brick = std::array::from_fn(|voxel| -values[voxel] * self.amplitude[voxel]);
        for voxel in (0..BRICK_VOXELS).filter(|voxel| values[*voxel].abs() > above) {
            let above = levels.partition_point(|level| *level < values[voxel]).clamp(1, last);
            let is_nearer = levels[above] - values[voxel] < values[voxel] - levels[above - 1];
            let code = if is_nearer { above } else { above - 1 };
            symbols[voxel] = code as u8 + 1;
            errors[voxel] = (levels[code] - values[voxel]) * self.amplitude[voxel];
        }
        Nearest { line, bits, levels, symbols, errors }
    }

    /// Steps codes up or down as long as less is seen of their errors.
    fn better(&self, nearest: Nearest) -> Coded {
        dispatch!(*SIMD, simd => simd.vectorize(
            #[inline(always)]
            || self.better_on(nearest)
        ))
    }

    #[inline(always)]
    fn better_on(&self, nearest: Nearest) -> Coded {
        let Nearest { line, bits, levels, mut symbols, mut errors } = nearest;
        let last = levels.len() - 1;
        let mut field = Field::of(&errors);
        for _ in 0..SWEEPS {
            let mut is_done = true;
            for voxel in 0..BRICK_VOXELS {
                let Some(code) = usize::from(symbols[voxel]).checked_sub(1) else { continue };
                let change = |to: usize| {
                    let change = (levels[to] - levels[code]) * self.amplitude[voxel];
                    (change * (2.0 * field.at(voxel) + change), change, to)
                };
                let steps = [code.checked_sub(1), (code < last).then_some(code + 1)];
                let best = steps.into_iter().flatten().map(change).min_by(|a, b| a.0.total_cmp(&b.0));
                let Some((_, change, to)) = best.filter(|(gain, ..)| *gain < 0.0) else { continue };
                symbols[voxel] = to as u8 + 1;
                errors[voxel] += change;
                field.add(voxel, change);
                is_done = false;
            }
            if is_done {
                break;
            }
        }
        let given = std::array::from_fn(|voxel| match symbols[voxel] {
            0 => self.scale.floor.max(0.0),
            symbol => levels[usize::from(symbol) - 1],
        });
        let plain = self.plain_error(&given);
        let bias = field.seen(&errors) - plain.squared;
        Coded { line, bits, symbols, error: Error { bias, ..plain } }
    }

    /// The error of values without regard to what is seen of it.
    fn plain_error(&self, given: &Brick) -> Error {
        let differences = || self.values.iter().zip(given).map(|(value, given)| (given - value).abs());
        let squares = differences().map(|difference| f64::from(difference / self.scale.unit).powi(2));
        Error { squared: squares.sum(), max: differences().fold(0.0, f32::max), bias: 0.0 }
    }
}

#[cfg(test)]
mod tests {
    use super::super::quantize::decode;
    use super::*;

    const SCALE: ChannelScale = ChannelScale {
        unit: 1.0,
        floor: 0.0,
        background: 0.0,
        background_tolerance: 1e-3,
        keeps_sign: false,
        max_error: f32::INFINITY,
    };

    /// Smoke that begins beyond a plane.
    fn smoke() -> Brick {
        std::array::from_fn(|i| {
            let depth = (i >> 6) as f32 + 0.3 * (i >> 3 & 7) as f32 - 0.2 * (i & 7) as f32 - 2.0;
            let noise = ((i * 2_654_435_761) >> 7 & 0xff) as f32 / 255.0;
            (0.02 * depth * depth + 0.1 * noise * depth).max(0.0) * f32::from(depth > 0.0)
        })
    }

    fn decoded(seen: &Seen, pairs: u8) -> Brick {
        let (mut words, mut out) = (Vec::new(), [0.0; BRICK_VOXELS]);
        seen.write(pairs, &mut words);
        assert!(decode(Codec::Sparse { is_fitted: false, pairs }, &words, &SCALE, &mut out));
        out
    }

    #[test]
    fn errors_of_one_sign_show_and_those_that_take_turns_hardly_do() {
        let (values, light) = ([0.5; BRICK_VOXELS], [1.0; 64]);
        let seen = Seen::of(&values, &SCALE, &light);
        let turns: Brick = std::array::from_fn(|i| if ((i >> 6) + (i >> 3) + i) % 2 > 0 { 0.6 } else { 0.4 });
        let alone: Brick = std::array::from_fn(|i| if i == 200 { 0.6 } else { 0.5 });
        let of = |given: &Brick| seen.of_values(given) / 0.01;
        assert!((of(&alone) - 1.0).abs() < 1e-4);
        assert!(of(&[0.6; BRICK_VOXELS]) > 5.0 * 512.0);
        assert!(of(&turns) < 0.3 * 512.0, "{}", of(&turns));
        let dark = Seen::of(&values, &SCALE, &[0.1; 64]);
        assert!((100.0 * dark.of_values(&alone) / seen.of_values(&alone) - 1.0).abs() < 1e-3);
    }

    #[test]
    fn what_is_written_is_what_was_measured_and_empty_stays_empty() {
        let (values, light) = (smoke(), std::array::from_fn(|i| 1.0 / (1 + i / 16) as f32));
        let seen = Seen::of(&values, &SCALE, &light);
        let mut last = f64::INFINITY;
        for codec in seen.codecs() {
            let Codec::Sparse { pairs, .. } = codec else { unreachable!() };
            let (error, given) = (seen.sparse_error(pairs).unwrap(), decoded(&seen, pairs));
            let weighed = error.squared + error.bias;
            assert!((weighed - seen.of_values(&given)).abs() <= 1e-4 * weighed);
            let squared: f64 = values.iter().zip(&given).map(|(a, b)| f64::from(a - b).powi(2)).sum();
            assert!((squared - error.squared).abs() <= 1e-6 * squared);
            assert!(values.iter().zip(&given).all(|(value, given)| *value > 0.0 || *given == 0.0));
            assert!(weighed < last || pairs < 20, "{pairs}");
            last = weighed;
        }
        assert!(Seen::of(&[1.0; BRICK_VOXELS], &SCALE, &light).codecs().is_empty());
    }

    #[test]
    fn codes_are_better_than_the_nearest() {
        let (values, light) = (smoke(), [1.0; 64]);
        let seen = Seen::of(&values, &SCALE, &light);
        for way in seen.ways.iter().filter(|way| (3..=5).contains(&way.bits)) {
            let coded = seen.better(seen.nearest(way, 0.0));
            let level = |code: usize| {
                coded.line.line.low + coded.line.line.step * sparse::bend(way.bits, code as u32)
            };
            let levels: Vec<f32> = (0..1 << way.bits).map(level).collect();
            let nearest = values.map(|value| {
                let all = levels.iter().min_by(|a, b| (*a - value).abs().total_cmp(&(*b - value).abs()));
                if value > way.above { *all.unwrap() } else { 0.0 }
            });
            let shaped = coded.error.squared + coded.error.bias;
            let nearest = seen.of_values(&nearest);
            assert!(shaped < 0.9 * nearest, "{} bits: {shaped} of {nearest}", way.bits);
        }
    }
}
