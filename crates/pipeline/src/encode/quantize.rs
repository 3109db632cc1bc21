//! One brick in each of the codecs that quantise: what it costs, how far off it is, and its words.
//!
//! Uniform codes cover the values themselves, gradient codes what a trilinear interpolation of eight fitted corners
//! leaves over, which in smoke is several bits less. Errors are measured on values as the decoder gives them.
//!
//! Empty voxels, those at the channel's floor, are special: decoded values are raised to the floor, so a code whose
//! value lies below it is as good as exact. Such voxels take the next code below and get exactly the floor.

use std::sync::LazyLock;

use fearless_simd::{Level, Simd, dispatch};
use half::f16;
use nuage_volume::codec::{
    BrickContext, Codec, LATTICE_POINTS, Line, codes, interpolate_corners, interpolate_lattice, lattice_cell,
    octant_lines, sparse,
};
use nuage_volume::space::BRICK_VOXELS;

use super::block;
use super::seen::{Light, Seen};
use super::shapes::{SHAPE_CODEC, Shapes, Shared};
use super::sparse::Sparse;

/// The values of a brick.
pub type Brick = [f32; BRICK_VOXELS];

/// What the encoder has to know of a channel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ChannelScale {
    /// The unit of half floats: a power of two, not less than any magnitude.
    pub unit: f32,
    /// The smallest value that the channel can have: decoded values are raised to it.
    pub floor: f32,
    /// The value of empty voxels.
    pub background: f32,
    /// How far off empty voxels may be.
    pub background_tolerance: f32,
    /// Whether no value may change its sign.
    pub keeps_sign: bool,
    /// No voxel should be further off; infinite if that is not asked for. The encoder gives nothing up that is more.
    pub max_error: f32,
}

/// How far a coded brick is from its source.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Error {
    /// The sum of squares over all voxels, in units of the channel: values may be so small that their squares are 0.
    pub squared: f64,
    /// The largest of a voxel, in the channel's numbers.
    pub max: f32,
    /// What counts besides `squared` where codecs are weighed, for errors that are all of one sign: a ray adds these up.
    pub bias: f64,
}

/// The codecs that are tried on every brick, the cheapest first.
const CODECS: [Codec; 31] = [
    Codec::Constant,
    Codec::Gradient { bits: 0 },
    Codec::Shared,
    Codec::Uniform { bits: 1 },
    Codec::Lattice { bits: 0 },
    Codec::Gradient { bits: 1 },
    Codec::Split { bits: 1 },
    Codec::Uniform { bits: 2 },
    Codec::Lattice { bits: 1 },
    Codec::Gradient { bits: 2 },
    Codec::Split { bits: 2 },
    Codec::Uniform { bits: 3 },
    Codec::Lattice { bits: 2 },
    Codec::Gradient { bits: 3 },
    Codec::Split { bits: 3 },
    Codec::Uniform { bits: 4 },
    Codec::Lattice { bits: 3 },
    Codec::Gradient { bits: 4 },
    Codec::Split { bits: 4 },
    Codec::Uniform { bits: 5 },
    Codec::Lattice { bits: 4 },
    Codec::Gradient { bits: 5 },
    Codec::Split { bits: 5 },
    Codec::Uniform { bits: 6 },
    Codec::Lattice { bits: 5 },
    Codec::Gradient { bits: 6 },
    Codec::Gradient { bits: 7 },
    Codec::Uniform { bits: 8 },
    Codec::Gradient { bits: 8 },
    Codec::F16,
    Codec::F32,
];

/// Measures one brick in one codec after another. What codecs have in common is found once.
pub struct Measure<'a> {
    values: &'a Brick,
    scale: &'a ChannelScale,
    shapes: &'a Shapes,
    range: Range,
    /// The fitted gradient and the range of what it leaves over, once a codec has asked for it.
    gradient: Option<(Prediction<8>, Range)>,
    /// The fitted lattice likewise.
    lattice: Option<(Prediction<LATTICE_POINTS>, Range)>,
    /// The voxels that are there, if some are not.
    sparse: Option<Sparse>,
    /// What is seen of errors, if they count by that.
    seen: Option<Seen<'a>>,
}

impl<'a> Measure<'a> {
    /// Begins with a brick. `shapes` are those that it may share.
    pub fn of(values: &'a Brick, scale: &'a ChannelScale, shapes: &'a Shapes) -> Self {
        let range = Range::of_residuals(values, &NOTHING, scale);
        let sparse = Sparse::of(values, scale);
        Measure { values, scale, shapes, range, gradient: None, lattice: None, sparse, seen: None }
    }

    /// Begins with a brick in which errors count by what is seen of them.
    pub fn in_light(values: &'a Brick, scale: &'a ChannelScale, shapes: &'a Shapes, light: &Light) -> Self {
        Measure { seen: Some(Seen::of(values, scale, light)), ..Measure::of(values, scale, shapes) }
    }

    /// How the brick is written.
    pub fn scale(&self) -> &ChannelScale {
        self.scale
    }

    /// The codecs to be tried unless one is asked for, the cheapest first. The last can hold any brick.
    pub fn codecs(&self) -> impl Iterator<Item = Codec> + use<> {
        let sparse = match (&self.seen, &self.sparse) {
            (Some(seen), _) => seen.codecs(),
            (None, Some(sparse)) => sparse.codecs(self.values, self.scale),
            (None, None) => Vec::new(),
        };
        // Where some is empty, codes for all voxels hardly pay.
        let is_sparse = self.sparse.as_ref().is_some_and(Sparse::has_gaps);
        let others = CODECS.into_iter().filter(move |codec| !is_sparse || !is_like_sparse(*codec));
        let (mut sparse, mut others) = (sparse.into_iter().peekable(), others.peekable());
        std::iter::from_fn(move || match (sparse.peek(), others.peek()) {
            (Some(one), Some(other)) if one.word_count() < other.word_count() => sparse.next(),
            _ => others.next(),
        })
    }

    /// The error in a codec, `None` where it cannot hold the brick: empty voxels would not stay empty, a sign would
    /// change, or no shape is like it. [`Codec::F32`] always can.
    pub fn error(&mut self, codec: Codec) -> Option<Error> {
        if self.seen.is_none() {
            return self.plain_error(codec);
        }
        if let (Some(seen), Codec::Sparse { pairs, .. }) = (&self.seen, codec) {
            return seen.sparse_error(pairs);
        }
        let error = self.plain_error(codec)?;
        let (seen, decoded) = (self.seen.as_ref()?, self.decoded(codec)?);
        // What rounding leaves over is like noise, and stepped away in part; what is but predicted is not.
        let weighed = match has_codes(codec) || error.max == 0.0 {
            true => seen.of_codes(&decoded),
            false => seen.of_values(&decoded),
        };
        Some(Error { bias: weighed - error.squared, ..error })
    }

    /// The values that a codec leads to.
    fn decoded(&self, codec: Codec) -> Option<Brick> {
        Some(match codec {
            Codec::Constant => [constant(self.values, self.scale); BRICK_VOXELS],
            Codec::Shared => {
                let (_, shared) = best_shared(self.values, self.scale, self.shapes)?;
                self.shapes.values(&shared)
            }
            codec => {
                let (mut words, mut decoded) = (Vec::new(), NOTHING);
                write(self.values, codec, self.scale, self.shapes, &mut words);
                decode(codec, &words, self.scale, &mut decoded).then_some(decoded)?
            }
        })
    }

    /// The error in a codec without regard to what is seen of it.
    fn plain_error(&mut self, codec: Codec) -> Option<Error> {
        let Measure { values, scale, shapes, range, ref mut gradient, ref mut lattice, ref sparse, .. } =
            *self;
        match codec {
            Codec::Constant => {
                let line = Line { low: constant(values, scale), step: 0.0 };
                quantized_error(values, &NOTHING, &[line; 8], 0, scale)
            }
            Codec::Uniform { bits } => {
                quantized_error(values, &NOTHING, &[range.line(bits, scale).line; 8], bits, scale)
            }
            Codec::Gradient { bits } => {
                let (gradient, residuals) =
                    gradient.get_or_insert_with(|| Prediction::gradient(values, scale).ranged(values, scale));
                gradient.error(*residuals, values, bits, scale)
            }
            Codec::Lattice { bits } => {
                let (lattice, residuals) =
                    lattice.get_or_insert_with(|| Prediction::lattice(values, scale).ranged(values, scale));
                lattice.error(*residuals, values, bits, scale)
            }
            Codec::Sparse { is_fitted, pairs } => sparse.as_ref()?.error(values, is_fitted, pairs, scale),
            Codec::Split { bits } => {
                quantized_error(values, &NOTHING, &Split::over(values, scale, bits).lines, bits, scale)
            }
            Codec::F16 => {
                let rounded = values.map(|value| f16::from_f32(value / scale.unit).to_f32() * scale.unit);
                error(values, &rounded, scale)
            }
            Codec::Block { .. } => {
                let mut words = Vec::new();
                write(values, codec, scale, shapes, &mut words);
                let mut decoded = [0.0; BRICK_VOXELS];
                decode(codec, &words, scale, &mut decoded).then(|| error(values, &decoded, scale)).flatten()
            }
            Codec::F32 => Some(Error::default()),
            Codec::Shared => best_shared(values, scale, shapes).map(|(error, _)| error),
        }
    }
}

/// Whether a codec has codes of two bits or more for all voxels.
fn has_codes(codec: Codec) -> bool {
    match codec {
        Codec::Uniform { bits }
        | Codec::Gradient { bits }
        | Codec::Lattice { bits }
        | Codec::Split { bits } => bits > 1,
        _ => false,
    }
}

/// Whether a codec has codes, for all voxels, that sparse bricks have as well.
fn is_like_sparse(codec: Codec) -> bool {
    match codec {
        Codec::Uniform { bits } | Codec::Gradient { bits } => bits <= sparse::MAX_BITS,
        Codec::Lattice { .. } | Codec::Split { .. } => true,
        _ => false,
    }
}

/// The shape that is the most like a brick, with its error.
fn best_shared(values: &Brick, scale: &ChannelScale, shapes: &Shapes) -> Option<(Error, Shared)> {
    let likely = shapes.likely(values, scale).into_iter();
    let errors = likely.filter_map(|shared| Some((error(values, &shapes.values(&shared), scale)?, shared)));
    errors.min_by(|(a, _), (b, _)| a.squared.total_cmp(&b.squared))
}

/// The value that stands for a brick of [`Codec::Constant`]: the background if some of it is empty, so that what is
/// faint all over becomes empty and nothing else becomes fog, else halfway between its bounds.
pub fn constant(values: &Brick, scale: &ChannelScale) -> f32 {
    if values.contains(&scale.background) {
        return scale.background;
    }
    let (min, max) = bounds(values.iter().copied());
    // A sum of halves does not overflow.
    (0.5 * min + 0.5 * max).clamp(min, max)
}

/// Appends the words of a brick in a codec: those that [`Measure`] measured. In the place of a shape's offset stands its
/// index.
///
/// # Panics
/// If [`Measure`] has no error for it: no shape is like the brick, or it is not sparse.
pub fn write(values: &Brick, codec: Codec, scale: &ChannelScale, shapes: &Shapes, words: &mut Vec<u32>) {
    match codec {
        Codec::Constant => {}
        Codec::Uniform { bits } => {
            let line = Range::of_residuals(values, &NOTHING, scale).line(bits, scale);
            words.push(line.word);
            codes::pack(bits, &quantize(values, &NOTHING, &[line.line; 8], bits, scale), words);
        }
        Codec::Gradient { bits } => Prediction::gradient(values, scale).write(values, bits, scale, words),
        Codec::Lattice { bits } => Prediction::lattice(values, scale).write(values, bits, scale, words),
        Codec::Sparse { is_fitted, pairs } => {
            let Some(sparse) = Sparse::of(values, scale) else {
                unreachable!("a brick that was measured is sparse")
            };
            sparse.write(values, is_fitted, pairs, scale, words);
        }
        Codec::F16 => {
            let half = |value: f32| u32::from(f16::from_f32(value / scale.unit).to_bits());
            let pairs = values.as_chunks::<2>().0;
            words.extend(pairs.iter().map(|[low, high]| half(*low) | half(*high) << 16));
        }
        Codec::Split { bits } => {
            let split = Split::over(values, scale, bits);
            words.push(split.word);
            words.extend(split.bounds);
            codes::pack(bits, &quantize(values, &NOTHING, &split.lines, bits, scale), words);
        }
        Codec::Block { .. } => write_block(values, codec, scale, words),
        Codec::F32 => words.extend(values.iter().map(|value| value.to_bits())),
        Codec::Shared => {
            let Some((_, shared)) = best_shared(values, scale, shapes) else {
                unreachable!("a brick that was measured has a shape")
            };
            words.extend([shared.word, shared.shape as u32, u32::from(SHAPE_CODEC.tag())]);
        }
    }
}

/// The bounds of the octants of a brick.
struct Split {
    word: u32,
    bounds: [u32; 4],
    lines: [Line; 8],
}

impl Split {
    fn over(values: &Brick, scale: &ChannelScale, bits: u8) -> Split {
        let (mut mins, mut maxs) = ([f32::INFINITY; 8], [f32::NEG_INFINITY; 8]);
        for quadrant in 0..4 {
            // A row along z crosses two octants: its first half and its last.
            let (mut low, mut high) = ([f32::INFINITY; ROW], [f32::NEG_INFINITY; ROW]);
            for row in rows_of(quadrant) {
                for (i, value) in row_at(values, row).iter().enumerate() {
                    low[i] = if *value < low[i] { *value } else { low[i] };
                    high[i] = if *value > high[i] { *value } else { high[i] };
                }
            }
            for (half, (low, high)) in low.chunks(4).zip(high.chunks(4)).enumerate() {
                mins[2 * quadrant + half] = bounds(low.iter().copied()).0;
                maxs[2 * quadrant + half] = bounds(high.iter().copied()).1;
            }
        }
        let (min, max) = (bounds(mins.into_iter()).0, bounds(maxs.into_iter()).1);
        let StoredLine { line, word } = StoredLine::covering(min, max, 255, scale.unit);
        let inverse = inverse(line);
        let mut octants = [0; 4];
        for i in 0..8 {
            let low = ((mins[i] - line.low) * inverse).floor().clamp(0.0, 255.0) as u32;
            let high = ((maxs[i] - line.low) * inverse).ceil().clamp(0.0, 255.0) as u32;
            octants[i / 2] |= (low | high << 8) << (i % 2 * 16);
        }
        Split { word, bounds: octants, lines: octant_lines(octants, line, bits) }
    }
}

/// How often a block is encoded anew with its range reaching further below the floor.
const BLOCK_ROUNDS: usize = 5;

/// Appends the words of a brick of texture blocks. These spread errors over the texels of a block, to empty ones too:
/// the range reaches as far below the floor as is needed for what is wrong there to end at the floor.
fn write_block(values: &Brick, codec: Codec, scale: &ChannelScale, words: &mut Vec<u32>) {
    let Codec::Block { format, axis } = codec else { return };
    let (min, max) = bounds(values.iter().copied());
    let begin = words.len();
    let mut below = 0.0;
    for _ in 0..BLOCK_ROUNDS {
        let line = StoredLine::covering((min - below).max(-scale.unit), max, 1, scale.unit);
        let inverse = inverse(line.line);
        let normalised = values.map(|value| (value - line.line.low) * inverse);
        let bytes = block::encode_brick(format, axis, &normalised, block::Quality::Fast);
        words.truncate(begin);
        words.push(line.word);
        words.extend(bytes.as_chunks::<4>().0.iter().map(|bytes| u32::from_le_bytes(*bytes)));
        let mut decoded = [0.0; BRICK_VOXELS];
        if min != scale.floor || !decode(codec, &words[begin..], scale, &mut decoded) {
            return;
        }
        let empty = values.iter().zip(&decoded).filter(|(value, _)| **value == scale.floor);
        let fog = empty.fold(0.0_f32, |fog, (_, decoded)| fog.max(decoded - scale.floor));
        if fog <= scale.background_tolerance {
            return;
        }
        below += 1.25 * fog;
    }
}

/// A line as a brick stores it.
#[derive(Debug, Clone, Copy)]
pub(super) struct StoredLine {
    pub(super) line: Line,
    pub(super) word: u32,
}

impl StoredLine {
    /// The line of codes up to `last_code` that covers `min` to `max`: half floats, rounded outward.
    pub(super) fn covering(min: f32, max: f32, last_code: u32, unit: f32) -> StoredLine {
        let low = half_not_above(min / unit);
        let step = half_not_below((max / unit - low.to_f32()) / last_code as f32);
        let word = u32::from(low.to_bits()) | u32::from(step.to_bits()) << 16;
        let line = Line { low: low.to_f32() * unit, step: step.to_f32() * unit };
        StoredLine { line, word }
    }
}

fn half_not_above(value: f32) -> f16 {
    let nearest = f16::from_f32(value);
    match nearest.to_f32() > value {
        // The next smaller one: down in magnitude for positive numbers, up for others.
        true if nearest.to_bits() == 0 => f16::from_bits(0x8001),
        true if nearest.is_sign_positive() => f16::from_bits(nearest.to_bits() - 1),
        true => f16::from_bits(nearest.to_bits() + 1),
        false => nearest,
    }
}

fn half_not_below(value: f32) -> f16 {
    -half_not_above(-value)
}

fn bounds(values: impl Iterator<Item = f32>) -> (f32, f32) {
    values.fold((f32::INFINITY, f32::NEG_INFINITY), |(min, max), value| {
        (if value < min { value } else { min }, if value > max { value } else { max })
    })
}

/// What the values of a brick differ from a prediction.
#[derive(Debug, Clone, Copy)]
pub(super) struct Range {
    min: f32,
    max: f32,
}

impl Range {
    pub(super) fn of(residuals: impl Iterator<Item = f32>) -> Range {
        let (min, max) = bounds(residuals);
        Range { min, max }
    }

    pub(super) fn width(self) -> f32 {
        self.max - self.min
    }

    /// Voxels at the floor need a code that leads to or below it, and none above.
    fn of_residuals(values: &Brick, predicted: &Brick, scale: &ChannelScale) -> Range {
        let (mut min, mut max) = ([f32::INFINITY; ROW], [f32::NEG_INFINITY; ROW]);
        for row in 0..ROWS {
            let (values, predicted) = (row_at(values, row), row_at(predicted, row));
            for i in 0..ROW {
                let residual = values[i] - predicted[i];
                min[i] = if residual < min[i] { residual } else { min[i] };
                let above = if values[i] == scale.floor { f32::NEG_INFINITY } else { residual };
                max[i] = if above > max[i] { above } else { max[i] };
            }
        }
        let (min, max) = (bounds(min.into_iter()).0, bounds(max.into_iter()).1);
        Range { min, max: max.max(min) }
    }

    /// The line of codes of some bits that covers it.
    pub(super) fn line(self, bits: u8, scale: &ChannelScale) -> StoredLine {
        StoredLine::covering(self.min, self.max, (1 << bits) - 1, scale.unit)
    }
}

/// What nothing is predicted from.
pub(super) const NOTHING: Brick = [0.0; BRICK_VOXELS];

/// The voxels of a row along z, and the rows of a brick.
pub(super) const ROW: usize = 8;
const ROWS: usize = BRICK_VOXELS / ROW;

pub(super) fn row_at(values: &Brick, row: usize) -> &[f32; ROW] {
    &values.as_chunks().0[row]
}

/// The rows whose halves along z are the octants `2 quadrant` and `2 quadrant + 1`.
pub(super) fn rows_of(quadrant: usize) -> impl Iterator<Item = usize> {
    let first = (quadrant >> 1) * 32 + (quadrant & 1) * 4;
    (0..16).map(move |i| first + (i >> 2) * 8 + (i & 3))
}

/// The lines of two octants, by voxel of a row across them.
pub(super) struct RowLines {
    low: [f32; ROW],
    step: [f32; ROW],
    /// One over the step.
    inverse: [f32; ROW],
}

impl RowLines {
    fn new(lines: &[Line; 8], quadrant: usize) -> RowLines {
        let of = |z: usize| lines[2 * quadrant + (z >> 2)];
        RowLines {
            low: std::array::from_fn(|z| of(z).low),
            step: std::array::from_fn(|z| of(z).step),
            inverse: std::array::from_fn(|z| inverse(of(z))),
        }
    }

    /// One line for all voxels.
    pub(super) fn of_one(line: Line) -> RowLines {
        RowLines::new(&[line; 8], 0)
    }

    /// The value that a code leads to.
    #[inline(always)]
    pub(super) fn decoded(&self, z: usize, code: f32, predicted: f32, floor: f32) -> f32 {
        let decoded = predicted + (self.low[z] + self.step[z] * code);
        if decoded < floor { floor } else { decoded }
    }

    /// The code of a voxel, as a float.
    #[inline(always)]
    pub(super) fn code(&self, z: usize, value: f32, predicted: f32, last_code: f32, floor: f32) -> f32 {
        /// Adding and taking away this rounds a float below 2²² to the nearest whole number.
        const ROUNDING: f32 = 12_582_912.0;
        let exact = (value - predicted - self.low[z]) * self.inverse[z];
        let down = if value == floor { 0.5 } else { 0.0 };
        let code = (exact - down + ROUNDING) - ROUNDING;
        // Not `clamp`, which checks its bounds each time.
        let code = if code > 0.0 { code } else { 0.0 };
        if code < last_code { code } else { last_code }
    }
}

fn inverse(line: Line) -> f32 {
    if line.step > 0.0 { 1.0 / line.step } else { 0.0 }
}

pub(super) fn last_code(bits: u8) -> f32 {
    f32::from((1_u16 << bits) - 1)
}

/// The codes of a brick on the lines of its octants.
pub(super) fn quantize(
    values: &Brick,
    predicted: &Brick,
    lines: &[Line; 8],
    bits: u8,
    scale: &ChannelScale,
) -> [u8; BRICK_VOXELS] {
    let mut codes = [0; BRICK_VOXELS];
    for quadrant in 0..4 {
        let lines = RowLines::new(lines, quadrant);
        for row in rows_of(quadrant) {
            let (values, predicted) = (row_at(values, row), row_at(predicted, row));
            for z in 0..ROW {
                let code = lines.code(z, values[z], predicted[z], last_code(bits), scale.floor);
                codes[row * ROW + z] = code as u8;
            }
        }
    }
    codes
}

/// The error of values that are given instead of those of a brick.
fn error(values: &Brick, given: &Brick, scale: &ChannelScale) -> Option<Error> {
    quantized_error(values, given, &[Line::default(); 8], 0, scale)
}

/// The error of the values that the codes of a brick lead to. `None` if an empty voxel is not empty or a sign changed.
fn quantized_error(
    values: &Brick,
    predicted: &Brick,
    lines: &[Line; 8],
    bits: u8,
    scale: &ChannelScale,
) -> Option<Error> {
    dispatch!(*SIMD, simd => simd.vectorize(
        #[inline(always)]
        || quantized_error_on(values, predicted, lines, bits, scale)
    ))
}

/// What the processor can do. All of it gives the same numbers.
pub(super) static SIMD: LazyLock<Level> = LazyLock::new(Level::new);

#[inline(always)]
fn quantized_error_on(
    values: &Brick,
    predicted: &Brick,
    lines: &[Line; 8],
    bits: u8,
    scale: &ChannelScale,
) -> Option<Error> {
    let ChannelScale { unit, floor, background, .. } = *scale;
    // A power of two, so that nothing is lost.
    let inverse_unit = 1.0 / unit;
    let last_code = last_code(bits);
    let (mut squared, mut max, mut fog, mut flips) =
        ([0.0_f32; ROW], [0.0_f32; ROW], [0.0_f32; ROW], [0_u32; ROW]);
    for quadrant in 0..4 {
        let lines = RowLines::new(lines, quadrant);
        for row in rows_of(quadrant) {
            let (values, predicted) = (row_at(values, row), row_at(predicted, row));
            for z in 0..ROW {
                let (value, predicted) = (values[z], predicted[z]);
                let code = lines.code(z, value, predicted, last_code, floor);
                let decoded = lines.decoded(z, code, predicted, floor);
                let error = (decoded - value).abs() * inverse_unit;
                squared[z] += error * error;
                max[z] = if error > max[z] { error } else { max[z] };
                let in_empty = if value == background { error } else { 0.0 };
                fog[z] = if in_empty > fog[z] { in_empty } else { fog[z] };
                flips[z] |= u32::from((value < 0.0) != (decoded < 0.0));
            }
        }
    }
    let largest = |lanes: [f32; ROW]| lanes.into_iter().fold(0.0, f32::max);
    let has_fog = largest(fog) * unit > scale.background_tolerance;
    let is_flipped = scale.keeps_sign && flips.contains(&1);
    let squared = squared.iter().map(|squared| f64::from(*squared)).sum();
    (!has_fog && !is_flipped).then(|| Error { squared, max: largest(max) * unit, bias: 0.0 })
}

/// A few points and what their interpolation predicts of a brick.
pub(super) struct Prediction<const POINTS: usize> {
    line: StoredLine,
    codes: [u8; POINTS],
    pub(super) predicted: Brick,
}

/// The least-squares fit of a line through eight values at 0 to 7: weights of the value at each end. With the positions
/// t from 0 to 1, those of the ends are `1/8 ± (t - 1/2) / (2 Σ (t - 1/2)²)` and the sum is 6/7.
const FIT: [[f32; 8]; 2] = {
    let mut weights = [[0.0; 8]; 2];
    let mut i = 0;
    while i < 8 {
        let tilt = (i as f32 / 7.0 - 0.5) / (2.0 * 6.0 / 7.0);
        weights[0][i] = 0.125 - tilt;
        weights[1][i] = 0.125 + tilt;
        i += 1;
    }
    weights
};

/// How often the fit is repeated where some voxels are empty.
const EMPTY_ROUNDS: usize = 3;

impl Prediction<8> {
    fn gradient(values: &Brick, scale: &ChannelScale) -> Self {
        Prediction::above_floor(values, scale, fit_corners, interpolate_corners)
    }
}

impl Prediction<LATTICE_POINTS> {
    fn lattice(values: &Brick, scale: &ChannelScale) -> Self {
        Prediction::above_floor(values, scale, fit_lattice, interpolate_lattice)
    }
}

impl<const POINTS: usize> Prediction<POINTS> {
    /// Fits points. What they predict below the floor is as good as the floor, so where voxels are empty they are
    /// fitted to what was predicted there before, as far as that is below.
    fn above_floor(
        values: &Brick,
        scale: &ChannelScale,
        fit: impl Fn(&Brick) -> [f32; POINTS],
        interpolate: impl Fn(&[f32; POINTS], &mut Brick),
    ) -> Self {
        let rounds = if values.contains(&scale.floor) { EMPTY_ROUNDS } else { 0 };
        let is_free = |i: usize, predicted| values[i] == scale.floor && predicted < scale.floor;
        Prediction::fit(values, scale, rounds, is_free, fit, interpolate)
    }

    /// Fits points, and so many times once more, with what they predicted in the place of free values.
    pub(super) fn fit(
        values: &Brick,
        scale: &ChannelScale,
        rounds: usize,
        is_free: impl Fn(usize, f32) -> bool,
        fit: impl Fn(&Brick) -> [f32; POINTS],
        interpolate: impl Fn(&[f32; POINTS], &mut Brick),
    ) -> Self {
        let mut points = fit(values);
        let (mut target, mut predicted) = (*values, [0.0; BRICK_VOXELS]);
        for _ in 0..rounds {
            interpolate(&points, &mut predicted);
            for i in 0..BRICK_VOXELS {
                target[i] = if is_free(i, predicted[i]) { predicted[i] } else { values[i] };
            }
            points = fit(&target);
        }
        // Bounds of entries end at twice the unit.
        let points = points.map(|point| point.clamp(-1.9 * scale.unit, 1.9 * scale.unit));
        let (min, max) = bounds(points.into_iter());
        let line = StoredLine::covering(min, max, 255, scale.unit);
        let inverse = inverse(line.line);
        let codes = points.map(|point| ((point - line.line.low) * inverse).round().clamp(0.0, 255.0) as u8);
        let mut predicted = [0.0; BRICK_VOXELS];
        interpolate(&codes.map(|code| line.line.at(code.into())), &mut predicted);
        Prediction { line, codes, predicted }
    }

    /// Along with the range of what it leaves over.
    fn ranged(self, values: &Brick, scale: &ChannelScale) -> (Self, Range) {
        let residuals = Range::of_residuals(values, &self.predicted, scale);
        (self, residuals)
    }

    /// The error with codes of some bits for the residuals, or without.
    fn error(&self, residuals: Range, values: &Brick, bits: u8, scale: &ChannelScale) -> Option<Error> {
        let line = match bits {
            0 => Line::default(),
            bits => residuals.line(bits, scale).line,
        };
        quantized_error(values, &self.predicted, &[line; 8], bits, scale)
    }

    /// Appends the words of the points.
    pub(super) fn write_points(&self, words: &mut Vec<u32>) {
        words.push(self.line.word);
        words.extend(self.codes.as_chunks::<4>().0.iter().map(|codes| u32::from_le_bytes(*codes)));
    }

    fn write(&self, values: &Brick, bits: u8, scale: &ChannelScale, words: &mut Vec<u32>) {
        self.write_points(words);
        if bits > 0 {
            let line = Range::of_residuals(values, &self.predicted, scale).line(bits, scale);
            words.push(line.word);
            codes::pack(bits, &quantize(values, &self.predicted, &[line.line; 8], bits, scale), words);
        }
    }
}

/// The corners whose trilinear interpolation is closest to the values.
pub(super) fn fit_corners(values: &Brick) -> [f32; 8] {
    // One axis after the other: rows of eight become pairs.
    let mut along_z = [[0.0; 2]; 64];
    for (pair, row) in along_z.iter_mut().zip(values.as_chunks::<8>().0) {
        for (i, value) in row.iter().enumerate() {
            pair[0] += FIT[0][i] * value;
            pair[1] += FIT[1][i] * value;
        }
    }
    let mut along_y = [[0.0; 4]; 8];
    for (x, plane) in along_y.iter_mut().enumerate() {
        for (i, pair) in along_z[x * 8..x * 8 + 8].iter().enumerate() {
            for (corner, value) in plane.iter_mut().enumerate() {
                *value += FIT[corner >> 1][i] * pair[corner & 1];
            }
        }
    }
    std::array::from_fn(|corner| (0..8).map(|x| FIT[corner >> 2][x] * along_y[x][corner & 3]).sum())
}

/// The least-squares fit of four points to eight values along an axis: weights of the values for each point, which solve the
/// normal equations of [`lattice_cell`]'s interpolation.
static LATTICE_FIT: LazyLock<[[f32; 8]; 4]> = LazyLock::new(|| {
    let mut interpolation = [[0.0_f64; 4]; 8];
    for (voxel, weights) in interpolation.iter_mut().enumerate() {
        let (cell, t) = lattice_cell(voxel);
        (weights[cell], weights[cell + 1]) = (1.0 - f64::from(t), f64::from(t));
    }
    // Gauss and Jordan: the rows of the normal matrix, with the right sides behind.
    let mut rows = [[0.0_f64; 12]; 4];
    for (i, row) in rows.iter_mut().enumerate() {
        for weights in &interpolation {
            (0..4).for_each(|j| row[j] += weights[i] * weights[j]);
        }
        (0..8).for_each(|voxel| row[4 + voxel] = interpolation[voxel][i]);
    }
    for pivot in 0..4 {
        rows[pivot] = rows[pivot].map(|value| value / rows[pivot][pivot]);
        for i in (0..4).filter(|i| *i != pivot) {
            let (factor, from) = (rows[i][pivot], rows[pivot]);
            rows[i].iter_mut().zip(from).for_each(|(value, from)| *value -= factor * from);
        }
    }
    rows.map(|row| std::array::from_fn(|voxel| row[4 + voxel] as f32))
});

/// The lattice whose trilinear interpolation is closest to the values.
fn fit_lattice(values: &Brick) -> [f32; LATTICE_POINTS] {
    let fit = &*LATTICE_FIT;
    // Along z, then y, then x, as in `fit_corners`.
    let mut along_z = [[0.0_f32; 4]; 64];
    for (points, row) in along_z.iter_mut().zip(values.as_chunks::<8>().0) {
        for (i, point) in points.iter_mut().enumerate() {
            *point = row.iter().zip(&fit[i]).map(|(value, weight)| value * weight).sum();
        }
    }
    let mut along_y = [[0.0_f32; 16]; 8];
    for (plane, rows) in along_y.iter_mut().zip(along_z.as_chunks::<8>().0) {
        for (y, row) in rows.iter().enumerate() {
            for (i, point) in plane.iter_mut().enumerate() {
                *point += fit[i >> 2][y] * row[i & 3];
            }
        }
    }
    let mut points = [0.0; LATTICE_POINTS];
    for (i, point) in points.iter_mut().enumerate() {
        *point = (0..8).map(|x| fit[i >> 4][x] * along_y[x][i & 15]).sum();
    }
    points
}

/// Decodes words that [`write()`] wrote.
pub fn decode(codec: Codec, words: &[u32], scale: &ChannelScale, out: &mut Brick) -> bool {
    let context = BrickContext { words, shapes: &[], unit: scale.unit, floor: scale.floor };
    context.decode(codec, 0, out).is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use nuage_volume::codec::block::{BlockFormat, PackingAxis};
    use proptest::prelude::*;

    fn scale(background: f32) -> ChannelScale {
        let floor = if background == 0.0 { 0.0 } else { f32::MIN };
        ChannelScale {
            unit: 8.0,
            floor,
            background,
            background_tolerance: 1e-3,
            keeps_sign: background != 0.0,
            max_error: f32::INFINITY,
        }
    }

    /// A plume: smooth, with empty voxels beyond a plane.
    fn brick(normal: [f32; 3], offset: f32, curve: f32, noise: f32, is_distance: bool) -> Brick {
        std::array::from_fn(|i| {
            let p = [i >> 6, i >> 3 & 7, i & 7].map(|c| c as f32 / 7.0);
            let plane: f32 = p.iter().zip(normal).map(|(p, n)| p * n).sum::<f32>() + offset;
            let grain = ((i as u32).wrapping_mul(2_654_435_761) >> 16) as f32 / 65536.0;
            let value = plane + curve * p[0] * p[1] * p[1] + noise * grain;
            if is_distance { value.clamp(-1.0, 1.0) } else { value.clamp(0.0, 8.0) }
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(100))]

        #[test]
        fn the_decoder_gives_what_was_measured(
            normal in [-2.0_f32..2.0, -2.0_f32..2.0, -2.0_f32..2.0], offset in -1.0_f32..3.0, curve in -1.0_f32..1.0,
            noise in prop::sample::select(vec![0.0_f32, 0.01, 1.0]), is_distance in any::<bool>(),
        ) {
            let values = brick(normal, offset, curve, noise, is_distance);
            let scale = scale(if is_distance { 1.0 } else { 0.0 });
            let blocks = [BlockFormat::Bc3, BlockFormat::Bc4, BlockFormat::Bc7];
            let blocks = blocks.map(|format| Codec::Block { format, axis: PackingAxis::Y });
            let shapes = Shapes::default();
            let mut measure = Measure::of(&values, &scale, &shapes);
            let codecs: Vec<Codec> = measure.codecs().collect();
            prop_assert!(codecs.is_sorted_by_key(|codec| codec.word_count()));
            let codecs = [&codecs[..], &blocks].concat();
            prop_assert!(measure.error(Codec::F32) == Some(Error::default()));
            for codec in codecs {
                let Some(error) = measure.error(codec) else { continue };
                let mut words = Vec::new();
                write(&values, codec, &scale, &shapes, &mut words);
                prop_assert_eq!(words.len(), codec.word_count());
                let mut decoded = [constant(&values, &scale); BRICK_VOXELS];
                if codec != Codec::Constant {
                    prop_assert!(decode(codec, &words, &scale, &mut decoded));
                }
                let max = values.iter().zip(&decoded).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                let in_units = |difference: f32| f64::from(difference / scale.unit);
                let squared: f64 = values.iter().zip(&decoded).map(|(a, b)| in_units(a - b).powi(2)).sum();
                prop_assert_eq!(max, error.max, "{:?}", codec);
                prop_assert!((squared - error.squared).abs() <= 1e-4 * squared + 1e-12);
                for (value, decoded) in values.iter().zip(&decoded) {
                    prop_assert!(*value != scale.background || (decoded - value).abs() <= 1e-3);
                    prop_assert!(!scale.keeps_sign || (*value < 0.0) == (*decoded < 0.0));
                }
                // A uniform code is off by half a step, which is a little wider than the range asks for.
                if let Codec::Uniform { bits } = codec {
                    let (min, max) = bounds(values.iter().copied());
                    let step = (max - min) / f32::from((1_u16 << bits) - 1);
                    prop_assert!(error.max <= 0.51 * step + 0.01, "{bits} {}", error.max);
                }
            }
        }
    }

    #[test]
    fn a_linear_ramp_is_its_corners() {
        let values = brick([1.0, 0.5, 0.25], 1.0, 0.0, 0.0, false);
        let scale = scale(0.0);
        let shapes = Shapes::default();
        let mut measure = Measure::of(&values, &scale, &shapes);
        let gradient = measure.error(Codec::Gradient { bits: 0 });
        assert!(gradient.is_some_and(|error| error.max < 0.01), "{gradient:?}");
        assert!(measure.error(Codec::Uniform { bits: 1 }).is_some_and(|error| error.max > 0.2));
    }

    #[test]
    fn half_floats_are_rounded_to_the_side_asked_for() {
        for value in [0.0, 1.0, 0.1, -0.1, 1e-9, -1e-9, 1.0 / 3.0, -123.456] {
            let (below, above) = (half_not_above(value).to_f32(), half_not_below(value).to_f32());
            assert!(below <= value && value <= above, "{below} {value} {above}");
            assert!((above - below).abs() <= value.abs() / 1000.0 + 1e-7);
        }
    }
}
