//! Bricks that are partly empty, in [`Codec::Sparse`]: only the voxels that are there have codes.
//!
//! With codes of few bits, voxels that are next to nothing are left out as well: what is empty is
//! then one more code, and the faint fringe of smoke costs next to nothing.
//!
//! Codes are found and measured as those of whole bricks are, with voxels that are left out filled in such a way that
//! they are exact; what they lose is added.

use std::cell::OnceCell;

use fearless_simd::{Simd, dispatch};
use nuage_volume::codec::sparse::Coding;
use nuage_volume::codec::{Codec, Line, interpolate_corners, sparse};
use nuage_volume::space::BRICK_VOXELS;

use super::quantize::{
    Brick, ChannelScale, Error, NOTHING, Prediction, Range, RowLines, SIMD, fit_corners, last_code, quantize,
};

/// The voxels of a row along z.
const ROW: usize = 8;

const MAX_BITS: usize = sparse::MAX_BITS as usize;

/// A brick of which some voxels are empty and others are not.
pub(super) struct Sparse {
    /// Corners fitted to the voxels that are not empty, once they are asked for.
    corners: OnceCell<Prediction<8>>,
    /// By the bits of a code, less 1.
    by_bits: [Kept; MAX_BITS],
    /// The voxels that are not empty.
    voxels: usize,
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
/// same size are a third further off, although the ratio of signal to noise is better by a decibel.
const LOST_BIAS: f64 = 15.0;

/// How often corners are fitted anew, with what they predicted in the place of empty voxels.
const ROUNDS: usize = 4;

/// Fewer voxels than this are not fitted.
const FITTED_VOXELS: usize = 24;

impl Sparse {
    /// Prepares a brick. `None` if no voxel of it is empty, or all are, or if empty is not 0.
    pub(super) fn of(values: &Brick, scale: &ChannelScale) -> Option<Sparse> {
        let voxels = values.iter().filter(|value| **value != 0.0).count();
        if scale.background != 0.0 || voxels == 0 || voxels == BRICK_VOXELS {
            return None;
        }
        let (min, max) = extremes(values);
        let by_bits = std::array::from_fn(|i| {
            // A quarter of the step of codes of which one is 0.
            let quarter_step = (0.25 * max - 0.25 * min) / (2 << i) as f32;
            Kept::above(quarter_step.min(scale.max_error), i as u8 + 1, values, scale)
        });
        Some(Sparse { corners: OnceCell::new(), by_bits, voxels })
    }

    /// Whether so much is empty that codes for all voxels need not be tried. Measured on plumes and clouds: at the most, bricks take
    /// a hundredth more for it.
    pub(super) fn has_gaps(&self) -> bool {
        self.voxels < BRICK_VOXELS * 15 / 16
    }

    /// Corners fitted to the voxels that are not empty.
    fn corners(&self, values: &Brick, scale: &ChannelScale) -> &Prediction<8> {
        self.corners.get_or_init(|| {
            let sum: f64 = values.iter().map(|value| f64::from(*value)).sum();
            let mean = (sum / self.voxels as f64) as f32;
            let is_free = |voxel: usize, _| values[voxel] == 0.0;
            let begin = values.map(|value| if value == 0.0 { mean } else { value });
            Prediction::fit(&begin, scale, ROUNDS, is_free, fit_corners, interpolate_corners)
        })
    }

    /// The codecs that can be worth trying, the cheapest first.
    pub(super) fn codecs(&self, values: &Brick, scale: &ChannelScale) -> Vec<Codec> {
        let is_fitted = self.is_worth_fitting(values, scale);
        let codec = |kept: &Kept| {
            let pairs = (head_words(is_fitted) + kept.words).div_ceil(2) as u8;
            Codec::Sparse { is_fitted, pairs }
        };
        let mut codecs = self.by_bits.map(|kept| codec(&kept)).to_vec();
        // With more bits more voxels are kept, which mostly takes more words; but blocks that become full need no mask.
        codecs.sort_by_key(|codec| codec.word_count());
        codecs.dedup();
        codecs
    }

    /// Whether corners save more bits of codes than they take: one for each halving of the range.
    fn is_worth_fitting(&self, values: &Brick, scale: &ChannelScale) -> bool {
        if self.voxels < FITTED_VOXELS {
            return false;
        }
        let kept = &self.by_bits[MAX_BITS / 2];
        let [plain, fitted] = [false, true]
            .map(|is_fitted| kept.range(values, self.predicted(is_fitted, values, scale)).width());
        let extra = head_words(true) - head_words(false);
        (plain / fitted).log2() * self.voxels as f32 > 32.0 * extra as f32
    }

    /// The error in a codec of so many words. `None` if they are too few.
    pub(super) fn error(
        &self,
        values: &Brick,
        is_fitted: bool,
        pairs: u8,
        scale: &ChannelScale,
    ) -> Option<Error> {
        let bits = self.bits(is_fitted, pairs)?;
        let predicted = self.predicted(is_fitted, values, scale);
        let kept = &self.by_bits[usize::from(bits) - 1];
        let line = kept.range(values, predicted).line(bits, scale).line;
        Some(kept.error(values, predicted, line, bits, scale))
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
        let Some(bits) = self.bits(is_fitted, pairs) else { return };
        let predicted = self.predicted(is_fitted, values, scale);
        let end = words.len() + 2 * usize::from(pairs);
        let kept = &self.by_bits[usize::from(bits) - 1];
        let line = kept.range(values, predicted).line(bits, scale);
        words.extend([line.word, u32::from(bits)]);
        if is_fitted {
            self.corners(values, scale).write_points(words);
        }
        let codes = quantize(values, predicted, &[line.line; 8], bits, scale);
        let symbol = |i: usize| if kept.holds(values[i]) { codes[i] + 1 } else { 0 };
        sparse::pack(&Coding::even(bits), &std::array::from_fn(symbol), words);
        words.resize(end, 0);
    }

    /// The bits of codes: the most for which a codec has room.
    fn bits(&self, is_fitted: bool, pairs: u8) -> Option<u8> {
        let room = (2 * usize::from(pairs)).checked_sub(head_words(is_fitted))?;
        let bits = self.by_bits.iter().rposition(|kept| kept.words <= room)? + 1;
        Some(bits as u8)
    }

    /// What predicts the values.
    fn predicted(&self, is_fitted: bool, values: &Brick, scale: &ChannelScale) -> &Brick {
        if is_fitted { &self.corners(values, scale).predicted } else { &NOTHING }
    }
}

impl Kept {
    fn above(above: f32, bits: u8, values: &Brick, scale: &ChannelScale) -> Kept {
        dispatch!(*SIMD, simd => simd.vectorize(
            #[inline(always)]
            || Kept::above_on(above, bits, values, scale)
        ))
    }

    #[inline(always)]
    fn above_on(above: f32, bits: u8, values: &Brick, scale: &ChannelScale) -> Kept {
        // A power of two, so that nothing is lost.
        let inverse_unit = 1.0 / scale.unit;
        let mut is_there = sparse::Presence::default();
        let (mut squared, mut max) = ([0.0_f32; ROW], [0.0_f32; ROW]);
        for (row, values) in values.as_chunks::<ROW>().0.iter().enumerate() {
            let bits = (0..ROW).fold(0, |bits, i| bits | u64::from(values[i].abs() > above) << i);
            for (i, value) in values.iter().enumerate() {
                let magnitude = value.abs();
                let lost = if magnitude > above { 0.0 } else { magnitude };
                squared[i] += (lost * inverse_unit) * (lost * inverse_unit);
                max[i] = if lost > max[i] { lost } else { max[i] };
            }
            is_there[row / ROW] |= bits << (row % ROW * ROW);
        }
        let squared = squared.iter().map(|squared| f64::from(*squared)).sum();
        let max = max.into_iter().fold(0.0, f32::max);
        let lost = Error { squared, max, bias: LOST_BIAS * squared };
        Kept { above, words: sparse::word_count(&Coding::even(bits), &is_there), lost }
    }

    #[inline(always)]
    fn holds(&self, value: f32) -> bool {
        value.abs() > self.above
    }

    /// The range of what a prediction leaves over of the voxels that are kept.
    fn range(&self, values: &Brick, predicted: &Brick) -> Range {
        dispatch!(*SIMD, simd => simd.vectorize(
            #[inline(always)]
            || self.range_on(values, predicted)
        ))
    }

    #[inline(always)]
    fn range_on(&self, values: &Brick, predicted: &Brick) -> Range {
        let (mut min, mut max) = ([f32::INFINITY; ROW], [f32::NEG_INFINITY; ROW]);
        for (values, predicted) in rows(values, predicted) {
            for i in 0..ROW {
                let residual = values[i] - predicted[i];
                let holds = self.holds(values[i]);
                // Not `&&`: a branch would keep lanes apart.
                min[i] = if holds & (residual < min[i]) { residual } else { min[i] };
                max[i] = if holds & (residual > max[i]) { residual } else { max[i] };
            }
        }
        Range::of(min.into_iter().chain(max).filter(|residual| residual.is_finite()))
    }

    /// The error with codes of some bits on a line, and of what is left out.
    fn error(&self, values: &Brick, predicted: &Brick, line: Line, bits: u8, scale: &ChannelScale) -> Error {
        dispatch!(*SIMD, simd => simd.vectorize(
            #[inline(always)]
            || self.error_on(values, predicted, line, bits, scale)
        ))
    }

    #[inline(always)]
    fn error_on(
        &self,
        values: &Brick,
        predicted: &Brick,
        line: Line,
        bits: u8,
        scale: &ChannelScale,
    ) -> Error {
        // A power of two, so that nothing is lost.
        let inverse_unit = 1.0 / scale.unit;
        let lines = RowLines::of_one(line);
        let last_code = last_code(bits);
        let (mut squared, mut max) = ([0.0_f32; ROW], [0.0_f32; ROW]);
        for (values, predicted) in rows(values, predicted) {
            for z in 0..ROW {
                let code = lines.code(z, values[z], predicted[z], last_code, scale.floor);
                let decoded = lines.decoded(z, code, predicted[z], scale.floor);
                let error = (decoded - values[z]).abs() * inverse_unit;
                let error = if self.holds(values[z]) { error } else { 0.0 };
                squared[z] += error * error;
                max[z] = if error > max[z] { error } else { max[z] };
            }
        }
        let squared: f64 = squared.iter().map(|squared| f64::from(*squared)).sum();
        let max = max.into_iter().fold(0.0, f32::max) * scale.unit;
        Error { squared: squared + self.lost.squared, max: max.max(self.lost.max), bias: self.lost.bias }
    }
}

/// The rows of two bricks.
fn rows<'a>(a: &'a Brick, b: &'a Brick) -> impl Iterator<Item = (&'a [f32; ROW], &'a [f32; ROW])> {
    a.as_chunks().0.iter().zip(b.as_chunks().0)
}

/// The least and the largest value, or 0.
fn extremes(values: &Brick) -> (f32, f32) {
    let (mut min, mut max) = ([0.0_f32; ROW], [0.0_f32; ROW]);
    for values in values.as_chunks::<ROW>().0 {
        for i in 0..ROW {
            min[i] = if values[i] < min[i] { values[i] } else { min[i] };
            max[i] = if values[i] > max[i] { values[i] } else { max[i] };
        }
    }
    (min.into_iter().fold(0.0, f32::min), max.into_iter().fold(0.0, f32::max))
}

/// The words before masks and codes.
fn head_words(is_fitted: bool) -> usize {
    if is_fitted { 5 } else { 2 }
}
