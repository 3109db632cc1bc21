//! One brick in each of the codecs that quantise: what it costs, how far off it is, and its words.
//!
//! Uniform codes cover the values themselves, gradient codes what a trilinear interpolation of eight fitted corners
//! leaves over, which in smoke is several bits less. Errors are measured on values as the decoder gives them.
//!
//! Empty voxels, those at the channel's floor, are special: decoded values are raised to the floor, so a code whose
//! value lies below it is as good as exact. Such voxels take the next code below and get exactly the floor.

use half::f16;
use nuage_volume::codec::{BrickContext, Codec, Line, codes, interpolate_corners, octant_lines, octant_of};
use nuage_volume::space::BRICK_VOXELS;

use super::block;

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
}

/// How far a coded brick is from its source.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Error {
    /// The sum of squares over all voxels.
    pub squared: f32,
    /// The largest of a voxel.
    pub max: f32,
}

/// The codecs that are tried unless one is asked for, the cheapest first.
pub const CODECS: [Codec; 24] = [
    Codec::Constant,
    Codec::Gradient { bits: 0 },
    Codec::Uniform { bits: 1 },
    Codec::Gradient { bits: 1 },
    Codec::Split { bits: 1 },
    Codec::Uniform { bits: 2 },
    Codec::Gradient { bits: 2 },
    Codec::Split { bits: 2 },
    Codec::Uniform { bits: 3 },
    Codec::Gradient { bits: 3 },
    Codec::Split { bits: 3 },
    Codec::Uniform { bits: 4 },
    Codec::Gradient { bits: 4 },
    Codec::Split { bits: 4 },
    Codec::Uniform { bits: 5 },
    Codec::Gradient { bits: 5 },
    Codec::Split { bits: 5 },
    Codec::Uniform { bits: 6 },
    Codec::Gradient { bits: 6 },
    Codec::Uniform { bits: 8 },
    Codec::Gradient { bits: 7 },
    Codec::Gradient { bits: 8 },
    Codec::F16,
    Codec::F32,
];

/// The error of a brick in each of some codecs, `None` where the codec cannot hold it: empty voxels would not stay
/// empty, or a sign would change. [`Codec::F32`] always can.
pub fn measure(values: &Brick, codecs: &[Codec], scale: &ChannelScale) -> Vec<Option<Error>> {
    let is_gradient = |codec: &Codec| matches!(codec, Codec::Gradient { .. });
    let gradient = codecs.iter().any(is_gradient).then(|| Gradient::fit(values, scale));
    let zero = [0.0; BRICK_VOXELS];
    let measure = |codec: &Codec| match (*codec, &gradient) {
        (Codec::Constant, _) => check(values, &[constant(values, scale); BRICK_VOXELS], scale),
        (Codec::Uniform { bits }, _) => {
            let line = line_over(values, &zero, scale, bits);
            quantized_error(values, &zero, line, bits, scale)
        }
        (Codec::Gradient { bits: 0 }, Some(gradient)) => {
            check(values, &floored(gradient.predicted, scale.floor), scale)
        }
        (Codec::Gradient { bits }, Some(gradient)) => {
            let line = line_over(values, &gradient.predicted, scale, bits);
            quantized_error(values, &gradient.predicted, line, bits, scale)
        }
        (Codec::F16, _) => {
            let rounded = values.map(|value| f16::from_f32(value / scale.unit).to_f32() * scale.unit);
            check(values, &rounded, scale)
        }
        (Codec::Split { bits }, _) => {
            let split = Split::over(values, scale, bits);
            let last_code = f32::from((1_u16 << bits) - 1);
            let inverses = split.lines.map(inverse);
            let decoded = std::array::from_fn(|i| {
                let octant = octant_of(i);
                let line = split.lines[octant];
                line.low + line.step * code_of(values[i], 0.0, line, inverses[octant], last_code, scale.floor)
            });
            check(values, &floored(decoded, scale.floor), scale)
        }
        (Codec::Block { .. }, _) => {
            let mut words = Vec::new();
            write(values, *codec, scale, &mut words);
            let mut decoded = [0.0; BRICK_VOXELS];
            decode(*codec, &words, scale, &mut decoded).then(|| check(values, &decoded, scale)).flatten()
        }
        (Codec::F32, _) => Some(Error::default()),
        (Codec::Gradient { .. } | Codec::Shared, _) => None,
    };
    codecs.iter().map(measure).collect()
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

/// Appends the words of a brick in a codec: those that [`measure`] measured.
///
/// # Panics
/// If the codec is [`Codec::Shared`], which takes more than the brick's own values.
pub fn write(values: &Brick, codec: Codec, scale: &ChannelScale, words: &mut Vec<u32>) {
    match codec {
        Codec::Constant => {}
        Codec::Uniform { bits } => {
            let zero = [0.0; BRICK_VOXELS];
            let line = line_over(values, &zero, scale, bits);
            words.push(line.word);
            codes::pack(bits, &quantize(values, &zero, line, bits, scale), words);
        }
        Codec::Gradient { bits } => {
            let gradient = Gradient::fit(values, scale);
            words.push(gradient.line.word);
            words.extend(gradient.codes.as_chunks::<4>().0.iter().map(|codes| u32::from_le_bytes(*codes)));
            if bits > 0 {
                let line = line_over(values, &gradient.predicted, scale, bits);
                words.push(line.word);
                codes::pack(bits, &quantize(values, &gradient.predicted, line, bits, scale), words);
            }
        }
        Codec::F16 => {
            let half = |value: f32| u32::from(f16::from_f32(value / scale.unit).to_bits());
            let pairs = values.as_chunks::<2>().0;
            words.extend(pairs.iter().map(|[low, high]| half(*low) | half(*high) << 16));
        }
        Codec::Split { bits } => {
            let split = Split::over(values, scale, bits);
            let last_code = f32::from((1_u16 << bits) - 1);
            let inverses = split.lines.map(inverse);
            words.push(split.word);
            words.extend(split.bounds);
            let code = |i: usize| {
                let octant = octant_of(i);
                code_of(values[i], 0.0, split.lines[octant], inverses[octant], last_code, scale.floor) as u8
            };
            codes::pack(bits, &std::array::from_fn(code), words);
        }
        Codec::Block { .. } => write_block(values, codec, scale, words),
        Codec::F32 => words.extend(values.iter().map(|value| value.to_bits())),
        Codec::Shared => unreachable!("a shared brick needs a shape"),
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
        for (i, value) in values.iter().enumerate() {
            let octant = octant_of(i);
            mins[octant] = if *value < mins[octant] { *value } else { mins[octant] };
            maxs[octant] = if *value > maxs[octant] { *value } else { maxs[octant] };
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
struct StoredLine {
    line: Line,
    word: u32,
}

impl StoredLine {
    /// The line of codes up to `last_code` that covers `min` to `max`: half floats, rounded outward.
    fn covering(min: f32, max: f32, last_code: u32, unit: f32) -> StoredLine {
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

/// The line of the codes of what the values differ from a prediction. Voxels at the floor need a code that leads to or
/// below it, and none above.
fn line_over(values: &Brick, predicted: &Brick, scale: &ChannelScale, bits: u8) -> StoredLine {
    let (mut min, mut max) = (f32::INFINITY, f32::NEG_INFINITY);
    for (value, predicted) in values.iter().zip(predicted) {
        let residual = value - predicted;
        min = if residual < min { residual } else { min };
        let above = if *value == scale.floor { f32::NEG_INFINITY } else { residual };
        max = if above > max { above } else { max };
    }
    StoredLine::covering(min, max.max(min), (1 << bits) - 1, scale.unit)
}

/// Adding and taking away this rounds a float below 2²² to the nearest whole number.
const ROUNDING: f32 = 12_582_912.0;

/// The code of a voxel, as a float.
fn code_of(value: f32, predicted: f32, line: Line, inverse: f32, last_code: f32, floor: f32) -> f32 {
    let exact = (value - predicted - line.low) * inverse;
    let down = if value == floor { 0.5 } else { 0.0 };
    let code = (exact - down + ROUNDING) - ROUNDING;
    // Not `clamp`, which checks its bounds each time.
    let code = if code > 0.0 { code } else { 0.0 };
    if code < last_code { code } else { last_code }
}

fn inverse(line: Line) -> f32 {
    if line.step > 0.0 { 1.0 / line.step } else { 0.0 }
}

fn quantize(
    values: &Brick,
    predicted: &Brick,
    line: StoredLine,
    bits: u8,
    scale: &ChannelScale,
) -> [u8; BRICK_VOXELS] {
    let (inverse, last_code) = (inverse(line.line), f32::from((1_u16 << bits) - 1));
    std::array::from_fn(|i| {
        code_of(values[i], predicted[i], line.line, inverse, last_code, scale.floor) as u8
    })
}

fn quantized_error(
    values: &Brick,
    predicted: &Brick,
    line: StoredLine,
    bits: u8,
    scale: &ChannelScale,
) -> Option<Error> {
    let StoredLine { line, .. } = line;
    let (inverse, last_code) = (inverse(line), f32::from((1_u16 << bits) - 1));
    let mut decoded = [0.0; BRICK_VOXELS];
    for (i, decoded) in decoded.iter_mut().enumerate() {
        let code = code_of(values[i], predicted[i], line, inverse, last_code, scale.floor);
        *decoded = predicted[i] + (line.low + line.step * code);
    }
    check(values, &floored(decoded, scale.floor), scale)
}

fn floored(mut values: Brick, floor: f32) -> Brick {
    values.iter_mut().for_each(|value| *value = if *value < floor { floor } else { *value });
    values
}

/// The error of decoded values, `None` if an empty voxel is not empty or a sign changed.
fn check(values: &Brick, decoded: &Brick, scale: &ChannelScale) -> Option<Error> {
    const LANES: usize = 8;
    let (mut squared, mut max, mut fog, mut flips) =
        ([0.0_f32; LANES], [0.0_f32; LANES], [0.0_f32; LANES], 0);
    for (values, decoded) in values.as_chunks::<LANES>().0.iter().zip(decoded.as_chunks::<LANES>().0) {
        for i in 0..LANES {
            let error = (decoded[i] - values[i]).abs();
            squared[i] += error * error;
            max[i] = if error > max[i] { error } else { max[i] };
            let in_empty = if values[i] == scale.background { error } else { 0.0 };
            fog[i] = if in_empty > fog[i] { in_empty } else { fog[i] };
            flips += u32::from((values[i] < 0.0) != (decoded[i] < 0.0));
        }
    }
    let largest = |lanes: [f32; LANES]| lanes.iter().copied().fold(0.0, f32::max);
    let is_sound = largest(fog) <= scale.background_tolerance && !(scale.keeps_sign && flips > 0);
    let squared: f32 = squared.iter().sum();
    // Squares of large values overflow: such a codec is of no use. False for NaN.
    (is_sound && squared < f32::MAX).then(|| Error { squared, max: largest(max) })
}

/// The corners of a brick and what they predict.
struct Gradient {
    line: StoredLine,
    codes: [u8; 8],
    predicted: Brick,
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

impl Gradient {
    /// Fits corners. What they predict below the floor is as good as the floor, so where voxels are empty they are
    /// fitted to what was predicted there before, as far as that is below.
    fn fit(values: &Brick, scale: &ChannelScale) -> Gradient {
        let mut target = *values;
        let has_empty = values.contains(&scale.floor);
        let mut corners = fit_corners(&target);
        if has_empty {
            let mut predicted = [0.0; BRICK_VOXELS];
            for _ in 0..EMPTY_ROUNDS {
                interpolate_corners(&corners, &mut predicted);
                for i in 0..BRICK_VOXELS {
                    let is_below = values[i] == scale.floor && predicted[i] < scale.floor;
                    target[i] = if is_below { predicted[i] } else { values[i] };
                }
                corners = fit_corners(&target);
            }
        }
        // Bounds of entries end at twice the unit.
        let corners = corners.map(|corner| corner.clamp(-1.9 * scale.unit, 1.9 * scale.unit));
        let (min, max) = bounds(corners.into_iter());
        let line = StoredLine::covering(min, max, 255, scale.unit);
        let inverse = inverse(line.line);
        let codes =
            corners.map(|corner| ((corner - line.line.low) * inverse).round().clamp(0.0, 255.0) as u8);
        let mut predicted = [0.0; BRICK_VOXELS];
        interpolate_corners(&codes.map(|code| line.line.at(code.into())), &mut predicted);
        Gradient { line, codes, predicted }
    }
}

/// The corners whose trilinear interpolation is closest to the values.
fn fit_corners(values: &Brick) -> [f32; 8] {
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
            let codecs = [&CODECS[..], &blocks].concat();
            let errors = measure(&values, &codecs, &scale);
            prop_assert!(errors[CODECS.len() - 1] == Some(Error::default()));
            for (codec, error) in codecs.into_iter().zip(errors) {
                let Some(error) = error else { continue };
                let mut words = Vec::new();
                write(&values, codec, &scale, &mut words);
                prop_assert_eq!(words.len(), codec.word_count());
                let mut decoded = [constant(&values, &scale); BRICK_VOXELS];
                if codec != Codec::Constant {
                    prop_assert!(decode(codec, &words, &scale, &mut decoded));
                }
                let max = values.iter().zip(&decoded).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
                let squared: f64 = values.iter().zip(&decoded).map(|(a, b)| f64::from(a - b).powi(2)).sum();
                prop_assert_eq!(max, error.max, "{:?}", codec);
                prop_assert!((squared - f64::from(error.squared)).abs() <= 1e-4 * squared + 1e-12);
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
        let errors = measure(&values, &CODECS, &scale(0.0));
        assert!(errors[1].is_some_and(|error| error.max < 0.01), "{:?}", errors[1]);
        assert!(errors[2].is_some_and(|error| error.max > 0.2));
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
