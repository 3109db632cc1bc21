//! Bricks that are partly empty, in [`Codec::Sparse`]: only the voxels that are there have codes.
//!
//! With codes of few bits, voxels that are next to nothing are left out as well: what is empty is
//! then one more code, and the faint fringe of smoke costs next to nothing.
//!
//! Codes are found and measured as those of whole bricks are, with voxels that are left out filled in such a way that
//! they are exact; what they lose is added.

use nuage_volume::codec::{Codec, interpolate_corners, sparse};
use nuage_volume::space::BRICK_VOXELS;

use super::quantize::{
    Brick, ChannelScale, Error, NOTHING, Prediction, Range, fit_corners, quantize, quantized_error,
};

const MAX_BITS: usize = sparse::MAX_BITS as usize;

/// A brick of which some voxels are empty and others are not.
pub(super) struct Sparse {
    /// Corners fitted to the voxels that are not empty.
    corners: Option<Prediction<8>>,
    /// By the bits of a code, less 1.
    by_bits: [Kept; MAX_BITS],
}

/// The voxels that are kept with codes of some bits.
#[derive(Clone, Copy)]
struct Kept {
    /// Those are whose magnitude is more than this.
    above: f32,
    /// The words of masks and codes.
    words: usize,
    /// What leaving out the others costs.
    lost: Error,
}

/// How much more than its square the error of voxels that are left out counts. Measured on explosions: without it, pictures of the
/// same size are a quarter further off, although the ratio of signal to noise is better by a decibel.
const LOST_BIAS: f64 = 15.0;

/// How often corners are fitted anew, with what they predicted in the place of empty voxels.
const ROUNDS: usize = 6;

/// Fewer voxels than this are not fitted.
const FITTED_VOXELS: usize = 24;

impl Sparse {
    /// Prepares a brick. `None` if no voxel of it is empty, or all are, or if empty is not 0.
    pub(super) fn of(values: &Brick, scale: &ChannelScale) -> Option<Sparse> {
        let voxels = values.iter().filter(|value| **value != 0.0).count();
        if scale.background != 0.0 || voxels == 0 || voxels == BRICK_VOXELS {
            return None;
        }
        let corners = (voxels >= FITTED_VOXELS).then(|| {
            let sum: f64 = values.iter().map(|value| f64::from(*value)).sum();
            let mean = (sum / voxels as f64) as f32;
            let is_free = |voxel: usize, _| values[voxel] == 0.0;
            let begin = values.map(|value| if value == 0.0 { mean } else { value });
            Prediction::fit(&begin, scale, ROUNDS, is_free, fit_corners, interpolate_corners)
        });
        let (min, max) = values.iter().fold((0.0_f32, 0.0_f32), |(min, max), v| (min.min(*v), max.max(*v)));
        let by_bits = std::array::from_fn(|i| {
            // A quarter of the step of codes of which one is 0.
            let quarter_step = (0.25 * max - 0.25 * min) / (2 << i) as f32;
            Kept::above(quarter_step.min(scale.max_error), i as u8 + 1, values, scale)
        });
        Some(Sparse { corners, by_bits })
    }

    /// The codecs that can be worth trying, the cheapest first.
    pub(super) fn codecs(&self) -> Vec<Codec> {
        let ways = if self.corners.is_some() { &[false, true][..] } else { &[false] };
        let codec = |is_fitted: bool| {
            move |kept: &Kept| {
                let pairs = (head_words(is_fitted) + kept.words).div_ceil(2) as u8;
                Codec::Sparse { is_fitted, pairs }
            }
        };
        let mut codecs: Vec<Codec> =
            ways.iter().flat_map(|is_fitted| self.by_bits.iter().map(codec(*is_fitted))).collect();
        codecs.sort_by_key(|codec| codec.word_count());
        codecs.dedup();
        codecs
    }

    /// The error in a codec of so many words. `None` if they are too few.
    pub(super) fn error(
        &self,
        values: &Brick,
        is_fitted: bool,
        pairs: u8,
        scale: &ChannelScale,
    ) -> Option<Error> {
        let (predicted, bits) = self.way(is_fitted, pairs)?;
        let kept = &self.by_bits[usize::from(bits) - 1];
        let (filled, range) = kept.fill(values, predicted, scale);
        let line = range.line(bits, scale).line;
        let error = quantized_error(&filled, predicted, &[line; 8], bits, scale)?;
        Some(Error {
            squared: error.squared + kept.lost.squared,
            max: error.max.max(kept.lost.max),
            bias: kept.lost.bias,
        })
    }

    /// Appends the words of a codec that has an error.
    pub(super) fn write(
        &self,
        values: &Brick,
        is_fitted: bool,
        pairs: u8,
        scale: &ChannelScale,
        words: &mut Vec<u32>,
    ) {
        let Some((predicted, bits)) = self.way(is_fitted, pairs) else { return };
        let end = words.len() + 2 * usize::from(pairs);
        let kept = &self.by_bits[usize::from(bits) - 1];
        let (filled, range) = kept.fill(values, predicted, scale);
        let line = range.line(bits, scale);
        words.extend([line.word, u32::from(bits)]);
        if let Some(corners) = self.corners.as_ref().filter(|_| is_fitted) {
            corners.write_points(words);
        }
        let codes = quantize(&filled, predicted, &[line.line; 8], bits, scale);
        let symbol = |i: usize| if kept.holds(values[i]) { codes[i] + 1 } else { 0 };
        sparse::pack(bits, &std::array::from_fn(symbol), words);
        words.resize(end, 0);
    }

    /// What predicts the values in a codec, and the bits of its codes: the most for which there is room.
    fn way(&self, is_fitted: bool, pairs: u8) -> Option<(&Brick, u8)> {
        let predicted = if is_fitted { &self.corners.as_ref()?.predicted } else { &NOTHING };
        let room = (2 * usize::from(pairs)).checked_sub(head_words(is_fitted))?;
        let bits = self.by_bits.iter().rposition(|kept| kept.words <= room)? + 1;
        Some((predicted, bits as u8))
    }
}

impl Kept {
    fn above(above: f32, bits: u8, values: &Brick, scale: &ChannelScale) -> Kept {
        let empty = Kept { above, words: 0, lost: Error::default() };
        let words = sparse::word_count(bits, |voxel| empty.holds(values[voxel]));
        let mut lost = Error::default();
        for value in values.iter().filter(|value| !empty.holds(**value)) {
            lost.squared += f64::from(value / scale.unit).powi(2);
            lost.max = lost.max.max(value.abs());
        }
        lost.bias = LOST_BIAS * lost.squared;
        Kept { above, words, lost }
    }

    fn holds(&self, value: f32) -> bool {
        value.abs() > self.above
    }

    /// The values, with those that are left out as code 0 gives them, and the range of what is kept.
    fn fill(&self, values: &Brick, predicted: &Brick, scale: &ChannelScale) -> (Brick, Range) {
        let kept = values.iter().zip(predicted).filter(|(value, _)| self.holds(**value));
        let range = Range::of(kept.map(|(value, predicted)| value - predicted));
        let low = range.line(1, scale).line.low;
        let mut filled = *values;
        for (value, predicted) in filled.iter_mut().zip(predicted) {
            if !self.holds(*value) {
                *value = (predicted + low).max(scale.floor);
            }
        }
        (filled, range)
    }
}

/// The words before masks and codes.
fn head_words(is_fitted: bool) -> usize {
    if is_fitted { 5 } else { 2 }
}
