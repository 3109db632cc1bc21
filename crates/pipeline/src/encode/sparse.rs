//! Bricks that are partly empty, in [`Codec::Sparse`]: only the voxels that are there have codes.
//!
//! Codes are found and measured as those of whole bricks are, with empty voxels filled in such a way that they are exact.

use nuage_volume::codec::{Codec, interpolate_corners, sparse};
use nuage_volume::space::BRICK_VOXELS;

use super::quantize::{
    Brick, ChannelScale, Error, NOTHING, Prediction, Range, fit_corners, quantize, quantized_error,
};

/// A brick of which some voxels are there and others are not, with and without corners that predict it.
pub(super) struct Sparse {
    plain: Way,
    fitted: Option<Way>,
    /// The words of masks and codes by the bits of codes, less 1.
    words: [usize; sparse::MAX_BITS as usize],
}

/// What codes lead on from.
struct Way {
    prediction: Option<Prediction<8>>,
    /// What the values of the voxels that are there differ from it.
    range: Range,
    /// The values, with those of empty voxels as code 0 gives them.
    filled: Brick,
}

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
        let words = std::array::from_fn(|i| sparse::word_count(i as u8 + 1, |voxel| values[voxel] != 0.0));
        let plain = Way::new(values, None, scale);
        let fitted = (voxels >= FITTED_VOXELS).then(|| {
            let sum: f64 = values.iter().map(|value| f64::from(*value)).sum();
            let mean = (sum / voxels as f64) as f32;
            let is_free = |voxel: usize, _| values[voxel] == 0.0;
            let begin = values.map(|value| if value == 0.0 { mean } else { value });
            let fitted = Prediction::fit(&begin, scale, ROUNDS, is_free, fit_corners, interpolate_corners);
            Way::new(values, Some(fitted), scale)
        });
        Some(Sparse { plain, fitted, words })
    }

    /// The codecs that can be worth trying, the cheapest first.
    pub(super) fn codecs(&self) -> Vec<Codec> {
        let mut codecs = Vec::new();
        let fitted = self.fitted.iter().map(|way| (true, way));
        for (is_fitted, way) in std::iter::once((false, &self.plain)).chain(fitted) {
            codecs.extend(self.words.map(|words| {
                let pairs = (words + way.head_words()).div_ceil(2) as u8;
                Codec::Sparse { is_fitted, pairs }
            }));
        }
        codecs.sort_by_key(|codec| codec.word_count());
        codecs.dedup();
        codecs
    }

    /// The error in a codec of so many words. `None` if they are too few.
    pub(super) fn error(&self, is_fitted: bool, pairs: u8, scale: &ChannelScale) -> Option<Error> {
        let (way, bits) = self.way(is_fitted, pairs)?;
        let line = way.range.line(bits, scale).line;
        quantized_error(&way.filled, way.predicted(), &[line; 8], bits, scale)
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
        let Some((way, bits)) = self.way(is_fitted, pairs) else { return };
        let end = words.len() + 2 * usize::from(pairs);
        let line = way.range.line(bits, scale);
        words.extend([line.word, u32::from(bits)]);
        if let Some(prediction) = &way.prediction {
            prediction.write_points(words);
        }
        let codes = quantize(&way.filled, way.predicted(), &[line.line; 8], bits, scale);
        let symbol = |i: usize| if values[i] == 0.0 { 0 } else { codes[i] + 1 };
        sparse::pack(bits, &std::array::from_fn(symbol), words);
        words.resize(end, 0);
    }

    /// The way of a codec and the bits of its codes: the most for which there is room.
    fn way(&self, is_fitted: bool, pairs: u8) -> Option<(&Way, u8)> {
        let way = if is_fitted { self.fitted.as_ref()? } else { &self.plain };
        let room = (2 * usize::from(pairs)).checked_sub(way.head_words())?;
        let bits = self.words.iter().rposition(|words| *words <= room)? + 1;
        Some((way, bits as u8))
    }
}

impl Way {
    fn new(values: &Brick, prediction: Option<Prediction<8>>, scale: &ChannelScale) -> Way {
        let predicted = prediction.as_ref().map_or(&NOTHING, |prediction| &prediction.predicted);
        let there = values.iter().zip(predicted).filter(|(value, _)| **value != 0.0);
        let range = Range::of(there.map(|(value, predicted)| value - predicted));
        let low = range.line(1, scale).line.low;
        let mut filled = *values;
        for (filled, predicted) in filled.iter_mut().zip(predicted) {
            if *filled == 0.0 {
                *filled = (predicted + low).max(scale.floor);
            }
        }
        Way { prediction, range, filled }
    }

    fn predicted(&self) -> &Brick {
        self.prediction.as_ref().map_or(&NOTHING, |prediction| &prediction.predicted)
    }

    /// The words before masks and codes.
    fn head_words(&self) -> usize {
        if self.prediction.is_some() { 5 } else { 2 }
    }
}
