//! Errors as they are seen, and partly empty bricks in [`Codec::Sparse`] with codes that make them least.
//!
//! What is seen of an error is its sum along rays, and only where light gets. Over all directions of rays that is a sum over pairs of
//! voxels: the product of their errors, times what light gets to both, times a weight that falls with the square of the
//! distance. Errors of one sign in a row show, those that take turns hardly do. So codes are not those of the nearest values:
//! from these, one after the other is stepped up or down as long as less is seen, and what was left out of a
//! brick comes back in its neighbours.

use std::cell::OnceCell;
use std::sync::LazyLock;

use fearless_simd::{Simd, dispatch};
use nuage_volume::codec::sparse::{self, Coding};
use nuage_volume::codec::{Codec, Line, codes, octant_of};
use nuage_volume::space::BRICK_VOXELS;

use super::quantize::{Brick, ChannelScale, Error, ROW, SIMD, StoredLine, decode, row_at, rows_of, write};
use super::shapes::Shapes;

/// What errors in each block of 2³ voxels of a brick are multiplied by, block `x << 4 | y << 2 | z`: how much light gets there, as an
/// amplitude.
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
    /// The ways to store it in [`Codec::Sparse`], found when they are first asked for: other codecs are written without them.
    ways: OnceCell<Vec<Way>>,
}

/// Voxels that are kept: those whose magnitude is more than some value.
#[derive(Clone, Copy)]
struct Kept {
    above: f32,
    is_there: sparse::Presence,
    /// The least and the largest of their values, by octant.
    ranges: [[f32; 2]; OCTANTS],
}

/// Voxels that are kept, with codes of some kind.
struct Way {
    kept: Kept,
    /// Its ends, if it has some, are still to be found.
    coding: Coding,
    /// The words they take, by two.
    pairs: u8,
}

/// A way with the line of its codes, and the error of those that are nearest to the values, with what is likely to be seen of it
/// once they are stepped.
struct Measured {
    above: f32,
    line: StoredLine,
    coding: Coding,
    error: Error,
}

const OCTANTS: usize = 8;

/// Which voxels are left out: those below these parts of the largest value over the number of codes.
const LEFT_OUT: [f32; 2] = [0.05, 0.15];

/// By what part the range of codes ends before the largest value.
const SHORTENED: [f32; 2] = [0.0, 0.1];

/// How many bits codes may lose for each doubling of what an error counts in another octant. A half would be right for many
/// bits.
const FEWER_BITS: [f32; 4] = [0.0, 0.15, 0.3, 0.5];

/// What is seen, in the mean, of the squared errors of the nearest codes of 1 to 7 bits once they are stepped, and of the
/// squares of what is left out. Fitted to bricks of explosions, of which half are within a tenth.
const SEEN_OF_CODES: [f64; sparse::MAX_BITS as usize] = [0.79, 0.69, 0.64, 0.63, 0.62, 0.62, 0.62];
const SEEN_OF_LEFT_OUT: [f64; sparse::MAX_BITS as usize] = [5.1, 2.1, 1.9, 1.5, 1.3, 0.9, 0.3];

/// The same of codes for all voxels.
const SEEN_OF_ALL_CODES: f64 = 0.62;

/// How often all codes are gone through.
const SWEEPS: usize = 6;

impl<'a> Seen<'a> {
    /// Begins with a brick and the light in it.
    pub fn of(values: &'a Brick, scale: &'a ChannelScale, light: &Light) -> Self {
        let block = |voxel: usize| (voxel >> 7) << 4 | (voxel >> 4 & 3) << 2 | (voxel >> 1 & 3);
        let amplitude = std::array::from_fn(|voxel| light[block(voxel)] / scale.unit);
        Seen { values, scale, amplitude, ways: OnceCell::new() }
    }

    /// All ways, those that take the least words first.
    fn ways(&self) -> &[Way] {
        self.ways.get_or_init(|| self.find_ways())
    }

    fn find_ways(&self) -> Vec<Way> {
        if self.scale.background != 0.0 || self.values.iter().all(|value| *value == 0.0) {
            return Vec::new();
        }
        let largest = self.values.iter().fold(0.0_f32, |largest, value| largest.max(value.abs()));
        let doublings = self.doublings();
        let mut ways = Vec::new();
        for most_bits in 1..=sparse::MAX_BITS {
            let bits = |part: f32| {
                doublings.map(|doublings| (f32::from(most_bits) - (part * doublings).round()).max(1.0) as u8)
            };
            let mut all_bits = FEWER_BITS.map(bits).to_vec();
            all_bits.dedup();
            for part in LEFT_OUT {
                let above = part * largest / f32::from(1_u16 << most_bits);
                let kept = self.kept(above.min(self.scale.max_error));
                for (bits, ends) in
                    all_bits.iter().flat_map(|bits| [(*bits, None), (*bits, Some(Default::default()))])
                {
                    let coding = Coding { most_bits, bits, is_bent: true, ends };
                    let words = 1 + coding.word_count() + sparse::word_count(&coding, &kept.is_there);
                    ways.push(Way { kept, coding, pairs: words.div_ceil(2) as u8 });
                }
            }
        }
        ways.sort_by_key(|way| way.pairs);
        ways
    }

    /// How often what an error counts doubles, from each octant to the one where it counts most.
    fn doublings(&self) -> [f32; OCTANTS] {
        let mut sums = [(0.0_f32, 0.0_f32); OCTANTS];
        for voxel in (0..BRICK_VOXELS).filter(|voxel| self.values[*voxel] != 0.0) {
            let (sum, count) = &mut sums[octant_of(voxel)];
            (*sum, *count) = (*sum + self.amplitude[voxel].powi(2), *count + 1.0);
        }
        let means = sums.map(|(sum, count)| sum / count);
        let most = means.into_iter().fold(0.0, f32::max);
        // An octant of nothing has no codes.
        means.map(|mean| if mean > 0.0 { (most / mean).log2() } else { 0.0 })
    }

    fn kept(&self, above: f32) -> Kept {
        let mut kept = Kept {
            above,
            is_there: sparse::Presence::default(),
            ranges: [[f32::INFINITY, f32::NEG_INFINITY]; OCTANTS],
        };
        for (voxel, value) in self.values.iter().enumerate().filter(|(_, value)| value.abs() > above) {
            kept.is_there[voxel >> 6] |= 1 << (voxel & 63);
            let [low, high] = &mut kept.ranges[octant_of(voxel)];
            (*low, *high) = (low.min(*value), high.max(*value));
        }
        kept
    }

    /// The sparse codecs to be tried, the cheapest first.
    pub fn codecs(&self) -> Vec<Codec> {
        let codec = |way: &Way| Codec::Sparse { is_fitted: false, pairs: way.pairs };
        let mut codecs: Vec<Codec> = self.ways().iter().map(codec).collect();
        codecs.dedup();
        codecs
    }

    /// How far off the brick is in one of these codecs. What is likely to be seen of it is squared error and bias together.
    pub fn sparse_error(&self, pairs: u8) -> Option<Error> {
        self.measured(pairs).map(|measured| measured.error)
    }

    /// Appends the words of a codec that has an error, with codes stepped. Gives the error that they have, or `None` if it is
    /// the one measured.
    pub fn write(&self, codec: Codec, shapes: &Shapes, words: &mut Vec<u32>) -> Option<Error> {
        let begin = words.len();
        if let Codec::Sparse { pairs, .. } = codec {
            let measured = self.measured(pairs)?;
            let Measured { line, coding, .. } = measured;
            let levels = levels(&line, &coding, self.scale.floor);
            let (mut symbols, mut errors) = self.nearest(measured.above, &levels);
            self.step(&mut symbols, &mut errors, |voxel, code| levels[octant_of(voxel)].get(code).copied());
            words.push(line.word);
            coding.write(words);
            sparse::pack(&coding, &symbols, words);
            words.resize(begin + codec.word_count(), 0);
        } else {
            write(self.values, codec, self.scale, shapes, words);
            self.step_codes(code_bits(codec)?, codec, &mut words[begin..]);
        }
        let mut given = [0.0; BRICK_VOXELS];
        decode(codec, &words[begin..], self.scale, &mut given).then(|| self.plain_error(&given))
    }

    /// What is seen of the error of given values.
    pub fn of_values(&self, given: &Brick) -> f64 {
        let errors = self.errors(given);
        dispatch!(*SIMD, simd => simd.vectorize(
            #[inline(always)]
            || Field::of(&errors).seen(&errors)
        ))
    }

    /// What is likely to be seen of the error of the nearest codes, once they are stepped.
    pub fn of_codes(&self, given: &Brick) -> f64 {
        let squared: f64 = self.errors(given).iter().map(|error| f64::from(*error).powi(2)).sum();
        SEEN_OF_ALL_CODES * squared
    }

    fn errors(&self, given: &Brick) -> Brick {
        std::array::from_fn(|i| (given[i] - self.values[i]) * self.amplitude[i])
    }

    /// Of the ways that take so many words, and the lines, the one of which the least is likely to be seen.
    fn measured(&self, pairs: u8) -> Option<Measured> {
        let ways = self.ways().iter().filter(|way| way.pairs == pairs);
        let all = ways.flat_map(|way| SHORTENED.map(|part| self.measure(way, part)));
        let seen = |measured: &Measured| measured.error.squared + measured.error.bias;
        all.min_by(|a, b| seen(a).total_cmp(&seen(b)))
    }

    fn measure(&self, way: &Way, shortened: f32) -> Measured {
        let Way { kept, mut coding, .. } = *way;
        let min = kept.ranges.iter().fold(f32::INFINITY, |min, [low, _]| min.min(*low));
        let max = kept.ranges.iter().fold(f32::NEG_INFINITY, |max, [_, high]| max.max(*high));
        let steps = (1_u32 << coding.most_bits) - 1;
        let line = StoredLine::covering(min, max - shortened * (max - min), steps, self.scale.unit);
        if let Some(ends) = &mut coding.ends {
            let fifteenth = sparse::LAST_END / (line.line.step * steps as f32);
            let end = |value: f32| ((value - line.line.low) * fifteenth).round().min(sparse::LAST_END) as u8;
            *ends = kept.ranges.map(|range| range.map(end));
        }
        let error = dispatch!(*SIMD, simd => simd.vectorize(
            #[inline(always)]
            || self.error_on(kept.above, line.line, &coding)
        ));
        Measured { above: kept.above, line, coding, error }
    }

    /// The error of the nearest codes.
    #[inline(always)]
    fn error_on(&self, above: f32, line: Line, coding: &Coding) -> Error {
        // A power of two, so that nothing is lost.
        let inverse_unit = 1.0 / self.scale.unit;
        let (mut squared, mut max) = ([0.0_f32; ROW], [0.0_f32; ROW]);
        let (mut of_codes, mut of_left_out) = ([0.0_f32; ROW], [0.0_f32; ROW]);
        for quadrant in 0..4 {
            // A row along z crosses two octants: its first half and its last.
            let lane = |of: [f32; 2]| -> [f32; ROW] { std::array::from_fn(|z| of[z / 4]) };
            let octants = [2 * quadrant, 2 * quadrant + 1];
            let last_codes = octants.map(|octant| (1_u32 << coding.bits[octant]) - 1);
            let level = |i: usize, code: u32| coding.value(line, octants[i], code);
            let (lows, highs) =
                ([level(0, 0), level(1, 0)], [level(0, last_codes[0]), level(1, last_codes[1])]);
            let (last, low) = (lane(last_codes.map(|code| code as f32)), lane(lows));
            let length = lane([0, 1].map(|i| (highs[i] - lows[i]).max(f32::MIN_POSITIVE)));
            for row in rows_of(quadrant) {
                let (values, amplitude) = (row_at(self.values, row), row_at(&self.amplitude, row));
                for z in 0..ROW {
                    let (value, last) = (values[z], last[z]);
                    // Of the bent codes, those below and above.
                    let along = ((value - low[z]) / length[z]).clamp(0.0, 1.0);
                    let code = (Coding::unbent(along) * last).floor().min(last - 1.0);
                    let level = |code: f32| low[z] + length[z] * Coding::bent(code / last);
                    let (below, over) = ((level(code) - value).abs(), (level(code + 1.0) - value).abs());
                    let difference = if below < over { below } else { over };
                    let is_kept = value.abs() > above;
                    let difference = if is_kept { difference } else { value.abs() };
                    let (plain, lit) = (difference * inverse_unit, difference * amplitude[z]);
                    squared[z] += plain * plain;
                    max[z] = if difference > max[z] { difference } else { max[z] };
                    of_codes[z] += if is_kept { lit * lit } else { 0.0 };
                    of_left_out[z] += if is_kept { 0.0 } else { lit * lit };
                }
            }
        }
        let sum = |lanes: [f32; ROW]| lanes.iter().map(|lane| f64::from(*lane)).sum::<f64>();
        let i = usize::from(coding.most_bits - 1);
        let seen = SEEN_OF_CODES[i] * sum(of_codes) + SEEN_OF_LEFT_OUT[i] * sum(of_left_out);
        let squared = sum(squared);
        Error { squared, max: max.into_iter().fold(0.0, f32::max), bias: seen - squared }
    }

    /// The codes of the nearest values, as symbols, and what they are off, times the light.
    fn nearest(&self, above: f32, levels: &[Vec<f32>; OCTANTS]) -> (sparse::Symbols, Brick) {
        let mut symbols = [0; BRICK_VOXELS];
        let errors = std::array::from_fn(|voxel| {
            let value = self.values[voxel];
            if value.abs() <= above {
                return -value * self.amplitude[voxel];
            }
            let levels = &levels[octant_of(voxel)];
            let above = levels.partition_point(|level| *level < value).clamp(1, levels.len() - 1);
            let is_nearer = levels[above] - value < value - levels[above - 1];
            let code = if is_nearer { above } else { above - 1 };
            symbols[voxel] = code as u8 + 1;
            (levels[code] - value) * self.amplitude[voxel]
        });
        (symbols, errors)
    }

    /// Steps the codes, of so many bits, of a brick in a codec that has one for each voxel.
    fn step_codes(&self, bits: u8, codec: Codec, words: &mut [u32]) {
        let (head, codes) = words.split_at_mut(words.len() - codes::word_count(bits));
        // On what line the codes of a voxel stand, the values of two tell.
        let scale = ChannelScale { floor: f32::MIN, ..*self.scale };
        let with_code = |code: u8| {
            let (mut words, mut values) = (head.to_vec(), [0.0; BRICK_VOXELS]);
            codes::pack(bits, &[code; BRICK_VOXELS], &mut words);
            decode(codec, &words, &scale, &mut values).then_some(values)
        };
        let (Some(first), Some(second)) = (with_code(0), with_code(1)) else { return };
        let level = |voxel: usize, code: usize| {
            let value = first[voxel] + (second[voxel] - first[voxel]) * code as f32;
            (code < 1 << bits).then_some(value.max(self.scale.floor))
        };
        let mut all: [u8; BRICK_VOXELS] = std::array::from_fn(|voxel| codes::code(bits, codes, voxel) as u8);
        let mut errors = std::array::from_fn(|voxel| {
            let given = level(voxel, usize::from(all[voxel])).unwrap_or_default();
            (given - self.values[voxel]) * self.amplitude[voxel]
        });
        // What is empty stays as it is: it has no symbol.
        let is_empty = |voxel: usize| self.values[voxel] == self.scale.background;
        let mut symbols = std::array::from_fn(|voxel| if is_empty(voxel) { 0 } else { all[voxel] + 1 });
        self.step(&mut symbols, &mut errors, level);
        for (code, symbol) in all.iter_mut().zip(symbols) {
            *code = symbol.checked_sub(1).unwrap_or(*code);
        }
        let mut packed = Vec::with_capacity(codes.len());
        codes::pack(bits, &all, &mut packed);
        codes.copy_from_slice(&packed);
    }

    /// Steps codes, which are symbols less 1 with such a value for each voxel, up or down as long as less is seen of their errors.
    fn step(
        &self,
        symbols: &mut sparse::Symbols,
        errors: &mut Brick,
        level: impl Fn(usize, usize) -> Option<f32>,
    ) {
        dispatch!(*SIMD, simd => simd.vectorize(
            #[inline(always)]
            || self.step_on(symbols, errors, &level)
        ))
    }

    #[inline(always)]
    fn step_on(
        &self,
        symbols: &mut sparse::Symbols,
        errors: &mut Brick,
        level: &impl Fn(usize, usize) -> Option<f32>,
    ) {
        let mut field = Field::of(errors);
        for _ in 0..SWEEPS {
            let mut is_done = true;
            for voxel in 0..BRICK_VOXELS {
                let Some(code) = usize::from(symbols[voxel]).checked_sub(1) else { continue };
                let change = |to: usize| {
                    let error = level(voxel, to)? - self.values[voxel];
                    let change = error * self.amplitude[voxel] - errors[voxel];
                    let gain = change * (2.0 * field.at(voxel) + change);
                    (error.abs() <= self.scale.max_error).then_some((gain, change, to))
                };
                let steps = [code.checked_sub(1), Some(code + 1)];
                let best = steps.into_iter().flatten().filter_map(change).min_by(|a, b| a.0.total_cmp(&b.0));
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
    }

    /// The error of values without regard to what is seen of it.
    fn plain_error(&self, given: &Brick) -> Error {
        let differences = || self.values.iter().zip(given).map(|(value, given)| (given - value).abs());
        let squares = differences().map(|difference| f64::from(difference / self.scale.unit).powi(2));
        Error { squared: squares.sum(), max: differences().fold(0.0, f32::max), bias: 0.0 }
    }
}

/// The value of each code, by octant, as the decoder has it.
fn levels(line: &StoredLine, coding: &Coding, floor: f32) -> [Vec<f32>; OCTANTS] {
    let level = |octant: usize, code: u32| coding.value(line.line, octant, code).max(floor);
    std::array::from_fn(|octant| (0..1 << coding.bits[octant]).map(|code| level(octant, code)).collect())
}

/// The bits of the codes that a codec has for all voxels, if they can be stepped.
fn code_bits(codec: Codec) -> Option<u8> {
    let (Codec::Uniform { bits }
    | Codec::Gradient { bits }
    | Codec::Lattice { bits }
    | Codec::Split { bits }) = codec
    else {
        return None;
    };
    (1..8).contains(&bits).then_some(bits)
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

    /// What a brick decodes to once it is written, and the error that writing said.
    fn written(seen: &Seen, codec: Codec) -> (Brick, Option<Error>) {
        let (mut words, mut out) = (Vec::new(), [0.0; BRICK_VOXELS]);
        let error = seen.write(codec, &Shapes::default(), &mut words);
        assert_eq!(words.len(), codec.word_count());
        assert!(decode(codec, &words, seen.scale, &mut out));
        (out, error)
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
    fn what_is_written_is_as_likely_as_was_measured_and_empty_stays_empty() {
        let (values, light) = (smoke(), std::array::from_fn(|i| 1.0 / (1 + i / 16) as f32));
        let seen = Seen::of(&values, &SCALE, &light);
        let (mut most, mut least) = (0.0_f64, f64::INFINITY);
        for codec in seen.codecs() {
            let Codec::Sparse { pairs, .. } = codec else { unreachable!() };
            let (error, (given, real)) = (seen.sparse_error(pairs).unwrap(), written(&seen, codec));
            let likely = (error.squared + error.bias) / seen.of_values(&given);
            assert!((0.4..2.5).contains(&likely), "{pairs}: {likely}");
            let squared: f64 = values.iter().zip(&given).map(|(a, b)| f64::from(a - b).powi(2)).sum();
            assert!((squared - real.unwrap().squared).abs() <= 1e-6 * squared);
            assert!(values.iter().zip(&given).all(|(value, given)| *value > 0.0 || *given == 0.0));
            most = most.max(error.squared + error.bias);
            least = least.min(error.squared + error.bias);
        }
        assert!(least < 0.01 * most);
        assert!(Seen::of(&[0.0; BRICK_VOXELS], &SCALE, &light).codecs().is_empty());
    }

    #[test]
    fn stepped_codes_are_better_than_the_nearest_and_keep_to_the_error() {
        for (values, background) in [(smoke(), 0.0), (smoke().map(|value| 1.0 + value), 5.0)] {
            let even = [4, 5, 6]
                .map(|bits| Codec::Uniform { bits })
                .into_iter()
                .chain([Codec::Gradient { bits: 4 }]);
            for codec in even {
                let (mut words, mut nearest) = (Vec::new(), [0.0; BRICK_VOXELS]);
                write(&values, codec, &SCALE, &Shapes::default(), &mut words);
                assert!(decode(codec, &words, &SCALE, &mut nearest));
                let before = values.iter().zip(&nearest).fold(0.0_f32, |max, (a, b)| max.max((a - b).abs()));
                let scale = ChannelScale { max_error: 1.5 * before, background, ..SCALE };
                let seen = Seen::of(&values, &scale, &[1.0; 64]);
                let (given, real) = written(&seen, codec);
                assert!(real.unwrap().max <= scale.max_error, "{codec:?}");
                let (stepped, nearest) = (seen.of_values(&given), seen.of_values(&nearest));
                assert!(stepped < 0.9 * nearest, "{codec:?}: {stepped} of {nearest}");
            }
        }
    }
}
