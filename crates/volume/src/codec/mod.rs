//! How the values of a brick are stored: the codecs and their decoders.
//!
//! An encoded brick is a [`Codec`] and some words in the store that all bricks of a volume share. This module decodes;
//! [`codes`] reads codes of few bits, [`sparse`] those of bricks that are partly empty, [`bounds`] the bounds of an entry. Encoders, and the choice among codecs, live in
//! the pipeline. What a tree is, and where bricks stand in it, is [`crate::packed`]'s.
//!
//! A channel has a *unit*, a power of two no smaller than any of its values, and a *floor*, the smallest value it can
//! have. Half floats in a brick count in units. Every decoded value is raised to the floor: predictions that run below it
//! end there, which is what keeps empty voxels empty.

pub mod block;
pub mod bounds;
pub mod codes;
pub mod sparse;

use block::{BlockFormat, PackingAxis};
use sparse::Coding;

use crate::brick::f32_from_finite_f16;
use crate::space::BRICK_VOXELS;

/// How a brick is stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum Codec {
    /// One value, which stands in the entry itself.
    Constant,
    /// 512 floats: 512 words.
    F32,
    /// 512 half floats in units: 256 words.
    F16,
    /// Codes of 1 to 8 bits between bounds of the brick: a word with the value of code 0 and the step between codes,
    /// both half floats in units, then `16 × bits` words of codes.
    Uniform {
        /// The bits of a code.
        bits: u8,
    },
    /// The trilinear interpolation of eight corners, and what differs from it as in [`Codec::Uniform`]: a word for the
    /// corners like that of the codes, two words of 8-bit codes of the corners, then, unless `bits` is 0, the words of
    /// [`Codec::Uniform`].
    Gradient {
        /// The bits of a code, 0 to 8.
        bits: u8,
    },
    /// The trilinear interpolation of a lattice of 4³ points, and what differs from it: as [`Codec::Gradient`], with sixteen
    /// words of 8-bit codes of the points `x << 4 | y << 2 | z`.
    Lattice {
        /// The bits of a code, 0 to 5.
        bits: u8,
    },
    /// Codes of 1 to 8 bits between bounds of each octant of 4³ voxels: a word as in [`Codec::Uniform`], then, in four
    /// words, an 8-bit code of the lower bound of each octant `x << 2 | y << 1 | z` and one of its upper bound, two to a
    /// half word, the lower first; then the words of codes. A line of its own leads from one
    /// bound to the other: its step is their difference over the largest code.
    Split {
        /// The bits of a code.
        bits: u8,
    },
    /// Codes of 1 to 7 bits of those voxels that are there: a word as in [`Codec::Uniform`], one with the bits of a code,
    /// if it is fitted the three words of corners of [`Codec::Gradient`], from whose interpolation the codes
    /// lead on; then the words of [`sparse`], and 0 in what is left of `2 × pairs` words. Voxels that are not there are 0.
    Sparse {
        /// Whether corners predict the values.
        is_fitted: bool,
        /// Half the words of the brick.
        pairs: u8,
    },
    /// The values of a shape, scaled: a word with bias and scale, both half floats in units (the shape's own values count
    /// as they are); the shape's offset in the shape store; the tag of its codec. A shape is stored as a brick is, and
    /// is not shared itself.
    Shared,
    /// Texture blocks as [`block`] lays them out, in words of four bytes, the first lowest: a word with the value of 0 and
    /// what is added to it for 1, both half floats in units, then the blocks.
    Block {
        /// The kind of block.
        format: BlockFormat,
        /// The axis that runs through the channels, or the slices.
        axis: PackingAxis,
    },
}

const FORMATS: [BlockFormat; 3] = [BlockFormat::Bc4, BlockFormat::Bc3, BlockFormat::Bc7];
const AXES: [PackingAxis; 3] = [PackingAxis::X, PackingAxis::Y, PackingAxis::Z];

/// The first tag of [`Codec::Sparse`].
pub const SPARSE_TAG: u8 = 56;
/// The first of those that are fitted.
pub const SPARSE_FITTED_TAG: u8 = SPARSE_TAG + 70;
/// The first tag beyond.
const SPARSE_END_TAG: u8 = SPARSE_FITTED_TAG + 70;

impl Codec {
    /// The codec's number in a file.
    pub fn tag(self) -> u8 {
        match self {
            Codec::Constant => 0,
            Codec::Uniform { bits } => bits,
            Codec::F16 => 9,
            Codec::F32 => 10,
            Codec::Shared => 11,
            Codec::Gradient { bits } => 16 + bits,
            Codec::Lattice { bits } => 25 + bits,
            Codec::Block { format, axis } => {
                let axis = match axis {
                    PackingAxis::X => 0,
                    PackingAxis::Y => 1,
                    PackingAxis::Z => 2,
                };
                let first = match format {
                    BlockFormat::Bc4 => 32,
                    BlockFormat::Bc3 => 36,
                    BlockFormat::Bc7 => 40,
                };
                first + axis
            }
            Codec::Split { bits } => 43 + bits,
            Codec::Sparse { is_fitted: false, pairs } => SPARSE_TAG + pairs,
            Codec::Sparse { is_fitted: true, pairs } => SPARSE_FITTED_TAG + pairs,
        }
    }

    /// The codec of a number in a file.
    pub fn from_tag(tag: u8) -> Option<Codec> {
        match tag {
            0 => Some(Codec::Constant),
            1..=8 => Some(Codec::Uniform { bits: tag }),
            9 => Some(Codec::F16),
            10 => Some(Codec::F32),
            11 => Some(Codec::Shared),
            16..=24 => Some(Codec::Gradient { bits: tag - 16 }),
            25..=30 => Some(Codec::Lattice { bits: tag - 25 }),
            32..=43 => {
                let (format, axis) = (usize::from(tag - 32) / 4, usize::from(tag) % 4);
                Some(Codec::Block { format: FORMATS[format], axis: *AXES.get(axis)? })
            }
            44..=51 => Some(Codec::Split { bits: tag - 43 }),
            SPARSE_TAG..SPARSE_END_TAG => {
                let is_fitted = tag >= SPARSE_FITTED_TAG;
                let pairs = tag - if is_fitted { SPARSE_FITTED_TAG } else { SPARSE_TAG };
                // With less there is no room for masks.
                (pairs > 2).then_some(Codec::Sparse { is_fitted, pairs })
            }
            _ => None,
        }
    }

    /// The words of a brick.
    pub fn word_count(self) -> usize {
        match self {
            Codec::Constant => 0,
            Codec::F32 => BRICK_VOXELS,
            Codec::F16 => BRICK_VOXELS / 2,
            Codec::Uniform { bits } => 1 + codes::word_count(bits),
            Codec::Gradient { bits: 0 } => 3,
            Codec::Gradient { bits } => 4 + codes::word_count(bits),
            Codec::Lattice { bits: 0 } => 1 + LATTICE_POINTS / 4,
            Codec::Lattice { bits } => 2 + LATTICE_POINTS / 4 + codes::word_count(bits),
            Codec::Split { bits } => 5 + codes::word_count(bits),
            Codec::Sparse { pairs, .. } => 2 * usize::from(pairs),
            Codec::Shared => 3,
            Codec::Block { format, .. } => 1 + format.brick_bytes() / 4,
        }
    }
}

/// Why a brick cannot be decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum DecodeError {
    /// Its words are not all there.
    #[error("a brick stands outside of the brick store")]
    OutOfStore,
    /// It stands in a page of the brick store that is not in memory.
    #[error("a brick of a page that was not loaded")]
    NotLoaded,
    /// Its shape is no brick, or a shared one itself.
    #[error("a shared brick without a shape")]
    NoShape,
    /// Its words say that there are more.
    #[error("a sparse brick whose voxels are not all there")]
    Sparse,
    /// It holds a half float that is infinite or no number.
    #[error("a brick with a number that is none")]
    NotFinite,
}

/// What a brick needs to be decoded, besides its codec and place.
#[derive(Debug, Clone, Copy)]
pub struct BrickContext<'a> {
    /// The brick store, or the part of it that offsets count from.
    pub words: &'a [u32],
    /// The shape store, which [`Codec::Shared`] bricks refer to.
    pub shapes: &'a [u32],
    /// The unit of half floats: a power of two.
    pub unit: f32,
    /// The smallest value.
    pub floor: f32,
}

/// A line of values: `at(code) = low + step × code`, one multiplication and one addition in f32.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Line {
    /// The value of code 0.
    pub low: f32,
    /// The step between codes.
    pub step: f32,
}

impl Line {
    /// The line of a word: `low` in the lower half, `step` in the upper.
    ///
    /// # Errors
    /// If one of them is not finite.
    pub fn from_word(word: u32, unit: f32) -> Result<Line, DecodeError> {
        let half = |bits: u32| match bits & 0x7c00 {
            0x7c00 => Err(DecodeError::NotFinite),
            _ => Ok(f32_from_finite_f16(bits as u16) * unit),
        };
        Ok(Line { low: half(word & 0xffff)?, step: half(word >> 16)? })
    }

    /// The value of a code.
    pub fn at(self, code: u32) -> f32 {
        self.low + self.step * code as f32
    }
}

fn mix(a: f32, b: f32, t: f32) -> f32 {
    a + (b - a) * t
}

/// The trilinear interpolation of eight corners, corner `x << 2 | y << 1 | z`, at the voxels of a brick, whose first
/// voxel is the first corner and whose last is the last: first along x, then y, then z.
pub fn interpolate_corners(corners: &[f32; 8], out: &mut [f32; BRICK_VOXELS]) {
    let (planes, _) = out.as_chunks_mut::<64>();
    for (x, plane) in planes.iter_mut().enumerate() {
        let t = x as f32 / 7.0;
        let edge: [f32; 4] = std::array::from_fn(|i| mix(corners[i], corners[4 + i], t));
        let (rows, _) = plane.as_chunks_mut::<8>();
        for (y, row) in rows.iter_mut().enumerate() {
            let t = y as f32 / 7.0;
            let (low, high) = (mix(edge[0], edge[2], t), mix(edge[1], edge[3], t));
            for (z, value) in row.iter_mut().enumerate() {
                *value = mix(low, high, z as f32 / 7.0);
            }
        }
    }
}

/// The interpolation of corners in two words of 8-bit codes.
fn decode_corners(line: Line, words: [u32; 2], out: &mut [f32; BRICK_VOXELS]) {
    let code = |i: usize| words[i / 4] >> (i % 4 * 8) & 0xff;
    interpolate_corners(&std::array::from_fn(|i| line.at(code(i))), out);
}

/// The points of the lattice of [`Codec::Lattice`].
pub const LATTICE_POINTS: usize = 64;

/// The cell of the lattice that a voxel lies in along an axis, and where in it: the first and last voxels lie on the first and last
/// points.
pub const fn lattice_cell(voxel: usize) -> (usize, f32) {
    let cell = if voxel == 7 { 2 } else { voxel * 3 / 7 };
    (cell, (voxel * 3 - cell * 7) as f32 / 7.0)
}

/// The trilinear interpolation of a lattice, along x, then y, then z.
pub fn interpolate_lattice(points: &[f32; LATTICE_POINTS], out: &mut [f32; BRICK_VOXELS]) {
    for (x, plane) in out.as_chunks_mut::<64>().0.iter_mut().enumerate() {
        let (cell, t) = lattice_cell(x);
        let (low, high) = (&points[cell * 16..cell * 16 + 16], &points[cell * 16 + 16..cell * 16 + 32]);
        let across: [f32; 16] = std::array::from_fn(|i| mix(low[i], high[i], t));
        for (y, row) in plane.as_chunks_mut::<8>().0.iter_mut().enumerate() {
            let (cell, t) = lattice_cell(y);
            let ends: [f32; 4] =
                std::array::from_fn(|i| mix(across[cell * 4 + i], across[cell * 4 + 4 + i], t));
            for (z, value) in row.iter_mut().enumerate() {
                let (cell, t) = lattice_cell(z);
                *value = mix(ends[cell], ends[cell + 1], t);
            }
        }
    }
}

/// The octant of a voxel.
pub fn octant_of(voxel: usize) -> usize {
    (voxel >> 6 & 4) | (voxel >> 4 & 2) | (voxel >> 2 & 1)
}

/// The lines of the codes of each octant of [`Codec::Split`], from the words of their bounds.
pub fn octant_lines(bounds: [u32; 4], line: Line, bits: u8) -> [Line; 8] {
    let last = f32::from((1_u16 << bits.min(8)) - 1);
    std::array::from_fn(|i| {
        let both = bounds[i / 2] >> (i % 2 * 16);
        let (low, high) = (line.at(both & 0xff), line.at(both >> 8 & 0xff));
        Line { low, step: (high - low) / last }
    })
}

impl BrickContext<'_> {
    /// Decodes a brick that is not [`Codec::Constant`].
    ///
    /// # Errors
    /// If its words are not all there or hold what none can.
    pub fn decode(
        &self,
        codec: Codec,
        offset: u32,
        out: &mut [f32; BRICK_VOXELS],
    ) -> Result<(), DecodeError> {
        self.decode_above(codec, offset, out, true)?;
        out.iter_mut().for_each(|value| *value = value.max(self.floor));
        Ok(())
    }

    /// Decodes a brick without regard to the floor.
    fn decode_above(
        &self,
        codec: Codec,
        offset: u32,
        out: &mut [f32; BRICK_VOXELS],
        may_share: bool,
    ) -> Result<(), DecodeError> {
        let begin = offset as usize;
        let words = begin.checked_add(codec.word_count()).and_then(|end| self.words.get(begin..end));
        let words = words.ok_or(DecodeError::OutOfStore)?;
        match (codec, words) {
            (Codec::F32, words) => {
                for (value, word) in out.iter_mut().zip(words) {
                    *value = f32::from_bits(*word);
                    if !value.is_finite() {
                        return Err(DecodeError::NotFinite);
                    }
                }
            }
            (Codec::F16, words) => {
                for (pair, word) in out.as_chunks_mut::<2>().0.iter_mut().zip(words) {
                    // Two half floats stand in a word as low and step do.
                    let Line { low, step } = Line::from_word(*word, self.unit)?;
                    *pair = [low, step];
                }
            }
            (Codec::Uniform { bits }, [line, words @ ..]) => {
                let line = Line::from_word(*line, self.unit)?;
                codes::unpack(bits, words, out, |_, code| line.at(code));
            }
            (Codec::Gradient { bits }, [line, low, high, rest @ ..]) => {
                let line = Line::from_word(*line, self.unit)?;
                decode_corners(line, [*low, *high], out);
                if let [line, words @ ..] = rest {
                    let line = Line::from_word(*line, self.unit)?;
                    codes::unpack(bits, words, out, |predicted, code| predicted + line.at(code));
                }
            }
            (Codec::Lattice { bits }, [line, rest @ ..]) if rest.len() >= LATTICE_POINTS / 4 => {
                let line = Line::from_word(*line, self.unit)?;
                let (points, rest) = rest.split_at(LATTICE_POINTS / 4);
                let code = |i: usize| points[i / 4] >> (i % 4 * 8) & 0xff;
                interpolate_lattice(&std::array::from_fn(|i| line.at(code(i))), out);
                if let [line, words @ ..] = rest {
                    let line = Line::from_word(*line, self.unit)?;
                    codes::unpack(bits, words, out, |predicted, code| predicted + line.at(code));
                }
            }
            (Codec::Split { bits }, [line, b0, b1, b2, b3, words @ ..]) => {
                let line = Line::from_word(*line, self.unit)?;
                let octants = octant_lines([*b0, *b1, *b2, *b3], line, bits);
                // Each voxel is given its octant first, which then becomes its value.
                out.iter_mut().enumerate().for_each(|(i, value)| *value = octant_of(i) as f32);
                codes::unpack(bits, words, out, |octant, code| octants[octant as usize & 7].at(code));
            }
            (Codec::Sparse { is_fitted, .. }, [line, rest @ ..]) => {
                let line = Line::from_word(*line, self.unit)?;
                let (coding, rest) = Coding::from_words(rest).ok_or(DecodeError::Sparse)?;
                let rest = match (is_fitted, rest) {
                    (true, [corners, low, high, rest @ ..]) if coding.ends.is_none() => {
                        decode_corners(Line::from_word(*corners, self.unit)?, [*low, *high], out);
                        rest
                    }
                    (true, _) => return Err(DecodeError::Sparse),
                    (false, rest) => {
                        out.fill(0.0);
                        rest
                    }
                };
                let symbols = sparse::unpack(&coding, rest).ok_or(DecodeError::Sparse)?;
                for (voxel, (value, symbol)) in out.iter_mut().zip(symbols).enumerate() {
                    *value = match u32::from(symbol).checked_sub(1) {
                        None => 0.0,
                        Some(code) => *value + coding.value(line, octant_of(voxel), code),
                    };
                }
            }
            (Codec::Block { format, axis }, [line, words @ ..]) => {
                let line = Line::from_word(*line, self.unit)?;
                let mut bytes = [0; 256];
                for (bytes, word) in bytes.as_chunks_mut::<4>().0.iter_mut().zip(words) {
                    *bytes = word.to_le_bytes();
                }
                block::decode_brick(format, axis, &bytes, out).ok_or(DecodeError::OutOfStore)?;
                out.iter_mut().for_each(|value| *value = line.low + line.step * *value);
            }
            (Codec::Shared, [line, shape, tag]) if may_share => {
                let line = Line::from_word(*line, self.unit)?;
                let codec = u8::try_from(*tag).ok().and_then(Codec::from_tag);
                let codec = codec.filter(|codec| !matches!(codec, Codec::Constant | Codec::Shared));
                let shapes = BrickContext { words: self.shapes, unit: 1.0, ..*self };
                shapes.decode_above(codec.ok_or(DecodeError::NoShape)?, *shape, out, false)?;
                out.iter_mut().for_each(|value| *value = line.low + line.step * *value);
            }
            _ => return Err(DecodeError::NoShape),
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HALF_ONE: u32 = 0x3c00;

    #[test]
    fn tags_and_codecs_are_inverse() {
        let all: Vec<Codec> = (0..=255).filter_map(Codec::from_tag).collect();
        assert_eq!(all.len(), 44 + 2 * 67);
        for (i, codec) in all.iter().enumerate() {
            assert_eq!(Codec::from_tag(codec.tag()), Some(*codec));
            assert!(!all[..i].contains(codec));
        }
    }

    #[test]
    fn octants_are_halves_along_each_axis() {
        for voxel in 0..BRICK_VOXELS {
            let [x, y, z] = [voxel / 64, voxel / 8 % 8, voxel % 8];
            assert_eq!(octant_of(voxel), 4 * (x / 4) + 2 * (y / 4) + z / 4);
        }
    }

    #[test]
    fn values_are_what_the_words_say() {
        let mut words = vec![0; 1024];
        // Uniform at 4: low 1, step 2 in units of 4; all codes 3.
        words[4] = HALF_ONE | 0x4000 << 16;
        words[5..37].fill(u32::MAX);
        // Gradient at 100: corners 0, 0, …, 255; step 1.
        (words[100], words[102]) = (HALF_ONE << 16, 255 << 24);
        let context = BrickContext { words: &words, shapes: &[], unit: 4.0, floor: 0.0 };
        let mut out = [0.0; BRICK_VOXELS];
        context.decode(Codec::Uniform { bits: 2 }, 4, &mut out).unwrap();
        assert_eq!(out, [4.0 + 8.0 * 3.0; BRICK_VOXELS]);
        context.decode(Codec::Gradient { bits: 0 }, 100, &mut out).unwrap();
        assert_eq!((out[0], out[7], out[511]), (0.0, 0.0, 1020.0));
        let expected = 1020.0 * (3.0 / 7.0) * (5.0 / 7.0) * (6.0 / 7.0);
        assert!((out[3 << 6 | 5 << 3 | 6] - expected).abs() < 1e-3);
        // A shared brick of the first, now at 2 among the shapes, in units of 1: 28 becomes 1 + 7 × 0.5, in units of 4.
        let shared = [HALF_ONE | 0x3800 << 16, 2, 2];
        let context = BrickContext { words: &shared, shapes: &words[2..37], unit: 4.0, floor: 0.0 };
        context.decode(Codec::Shared, 0, &mut out).unwrap();
        assert_eq!(out, [4.0 + 2.0 * 7.0; BRICK_VOXELS]);
    }

    #[test]
    fn sparse_voxels_lead_on_from_corners_and_others_are_empty() {
        let symbols = std::array::from_fn(|i| if i % 3 == 0 { (i % 4 + 1) as u8 } else { 0 });
        // Corners 1 everywhere and codes in steps of 0.5, in units of 2.
        let (fitted, plain) = ([0x3800 << 16, 2, HALF_ONE, 0, 0], [0x3800 << 16, 2]);
        for (is_fitted, head, predicted) in [(true, &fitted[..], 2.0), (false, &plain[..], 0.0)] {
            let mut words = head.to_vec();
            sparse::pack(&Coding::even(2), &symbols, &mut words);
            words.resize(words.len().next_multiple_of(2), 0);
            let codec = Codec::Sparse { is_fitted, pairs: (words.len() / 2) as u8 };
            let decode = |words: &[u32], codec, out: &mut _| {
                let context = BrickContext { words, shapes: &[], unit: 2.0, floor: 0.0 };
                context.decode(codec, 0, out)
            };
            let mut out = [9.0; BRICK_VOXELS];
            decode(&words, codec, &mut out).unwrap();
            for (value, symbol) in out.iter().zip(symbols) {
                let expected = if symbol > 0 { predicted + f32::from(symbol - 1) } else { 0.0 };
                assert_eq!(*value, expected);
            }
            // Bent, the codes from 0 to 3 stand at 0, 7/15, 22/15 and 3.
            words[1] = 2 + 8;
            decode(&words, codec, &mut out).unwrap();
            for (value, symbol) in out.iter().zip(symbols) {
                let bent = [0.0, 7.0 / 15.0, 22.0 / 15.0, 3.0];
                let expected = if symbol > 0 { predicted + bent[usize::from(symbol) - 1] } else { 0.0 };
                assert!((value - expected).abs() < 1e-6);
            }
            for none in [0, 8, 16, 33, 1 << 8 | 1, u32::MAX] {
                words[1] = none;
                assert_eq!(decode(&words, codec, &mut out), Err(DecodeError::Sparse));
            }
            let short = Codec::Sparse { is_fitted, pairs: 3 };
            words[1] = 2;
            assert_eq!(decode(&words, short, &mut out), Err(DecodeError::Sparse));
        }
    }

    #[test]
    fn nothing_is_below_the_floor() {
        let words = [0xbc00, 0, 0].map(|word: u32| word);
        let mut out = [1.0; BRICK_VOXELS];
        for (floor, expected) in [(0.0, 0.0), (-0.5, -0.5), (f32::MIN, -1.0)] {
            let context = BrickContext { words: &words, shapes: &words, unit: 1.0, floor };
            context.decode(Codec::Gradient { bits: 0 }, 0, &mut out).unwrap();
            assert_eq!(out, [expected; BRICK_VOXELS]);
        }
    }

    #[test]
    fn what_is_not_there_or_no_number_is_an_error() {
        let mut words = vec![0; 600];
        words[1] = 0x7c00;
        words[2] = 0x7e00 << 16;
        words[3..6].copy_from_slice(&[0, 0, 11]);
        let context = BrickContext { words: &words, shapes: &words, unit: 1.0, floor: 0.0 };
        let mut out = [0.0; BRICK_VOXELS];
        let mut decode = |codec, offset| context.decode(codec, offset, &mut out);
        assert_eq!(decode(Codec::F32, 100), Err(DecodeError::OutOfStore));
        assert_eq!(decode(Codec::F16, u32::MAX), Err(DecodeError::OutOfStore));
        assert_eq!(decode(Codec::Uniform { bits: 1 }, 1), Err(DecodeError::NotFinite));
        assert_eq!(decode(Codec::Uniform { bits: 8 }, 2), Err(DecodeError::NotFinite));
        assert_eq!(decode(Codec::Shared, 3), Err(DecodeError::NoShape));
        assert_eq!(decode(Codec::Constant, 3), Err(DecodeError::NoShape));
    }
}
