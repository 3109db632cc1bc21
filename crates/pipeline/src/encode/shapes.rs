//! The shapes of a channel: bricks that many others are like, but for scale and bias.
//!
//! Shapes are found among some bricks of the sequence before the first is encoded, and stored as bricks of few bits
//! themselves. A brick that shares one takes three words. Which bricks do is [`super::choose`]'s to say, as with any
//! codec; how shapes are found is [`crate::cluster::shapes`]'.

use half::f16;
use nuage_volume::codec::{BrickContext, Codec, Line};
use nuage_volume::space::BRICK_VOXELS;

use super::quantize::{Brick, ChannelScale, write};
use crate::cluster::shapes::{Matcher, Settings, find};

/// How a shape is stored.
pub const SHAPE_CODEC: Codec = Codec::Uniform { bits: 6 };

/// The most bricks that shapes are found among; the time grows with the square.
pub const SAMPLE_BRICKS: usize = 16384;

/// How many of the likeliest shapes of a brick are tried.
const TRIED: usize = 3;

/// The shapes of a channel.
#[derive(Debug, Clone, PartialEq)]
pub struct Shapes {
    /// The words of each, in [`SHAPE_CODEC`].
    pub words: Vec<Vec<u32>>,
    matcher: Matcher,
    /// Bricks of which a shape may leave more than this, the sum of squares over all voxels in units of the channel, are not
    /// compared.
    limit: f32,
}

/// A brick as a shape, scaled.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shared {
    /// The index of the shape.
    pub shape: usize,
    /// Bias and scale.
    pub line: Line,
    /// Both as they are stored: half floats in units of the channel.
    pub word: u32,
}

impl Default for Shapes {
    fn default() -> Self {
        Shapes { words: Vec::new(), matcher: Matcher::new(Vec::new()), limit: 0.0 }
    }
}

impl Shapes {
    /// Finds so many shapes at most for bricks like those given, of a channel with this scale, which are to keep to an error: the largest
    /// of a voxel, and the sum of squares over a brick in units of the channel; infinite what is not asked for.
    pub fn find(
        bricks: &[Brick],
        most: usize,
        scale: &ChannelScale,
        max_error: f32,
        squared_error: f64,
    ) -> Shapes {
        let in_units: Vec<Brick> = bricks.iter().map(|brick| normalised(brick, scale)).collect();
        let settings = Settings {
            shapes: most,
            iterations: 5,
            max_error: max_error / scale.unit,
            max_mse: (squared_error / BRICK_VOXELS as f64) as f32,
            seed: 0,
        };
        let stored = ChannelScale {
            unit: 1.0,
            floor: f32::MIN,
            background: f32::MIN,
            background_tolerance: 0.0,
            keeps_sign: false,
            max_error: f32::INFINITY,
        };
        let encode = |shape: &Brick| {
            let mut words = Vec::new();
            write(shape, SHAPE_CODEC, &stored, &Shapes::default(), &mut words);
            words
        };
        let words: Vec<Vec<u32>> = find(&in_units, &settings).iter().map(encode).collect();
        let limit = settings.max_mse.min(settings.max_error.powi(2)) * BRICK_VOXELS as f32;
        Shapes::of(words, limit)
    }

    /// Shapes from their words, and from what a shape may leave.
    pub fn of(words: Vec<Vec<u32>>, limit: f32) -> Shapes {
        let decode = |words: &Vec<u32>| {
            let mut values = [0.0; BRICK_VOXELS];
            let context = BrickContext { words, shapes: &[], unit: 1.0, floor: f32::MIN };
            let decoded = context.decode(SHAPE_CODEC, 0, &mut values);
            debug_assert!(decoded.is_ok(), "what was written decodes");
            values
        };
        let matcher = Matcher::new(words.iter().map(decode).collect());
        Shapes { words, matcher, limit }
    }

    /// Bricks of which a shape may leave more than this, the sum of squares over all voxels in units of the channel, are
    /// not compared.
    pub fn limit(&self) -> f32 {
        self.limit
    }

    /// The likeliest ways to have a brick as a shape.
    pub fn likely(&self, values: &Brick, scale: &ChannelScale) -> Vec<Shared> {
        if self.words.is_empty() {
            return Vec::new();
        }
        let in_units = normalised(values, scale);
        let found = self.matcher.likely(&in_units, self.limit, &mut Vec::new()).take(TRIED);
        let stored = |shape| {
            let fit = self.matcher.fit(&in_units, shape);
            let halves = [fit.bias, fit.scale].map(f16::from_f32);
            let [bias, factor] = halves.map(|half| half.to_f32() * scale.unit);
            let word = u32::from(halves[0].to_bits()) | u32::from(halves[1].to_bits()) << 16;
            Shared { shape, line: Line { low: bias, step: factor }, word }
        };
        found.map(|found| stored(found.shape)).filter(|shared| shared.line.step.is_finite()).collect()
    }

    /// The values of a brick that shares a shape, before they are raised to the floor.
    pub fn values(&self, shared: &Shared) -> Brick {
        self.matcher.shapes[shared.shape].map(|value| shared.line.low + shared.line.step * value)
    }
}

fn normalised(brick: &Brick, scale: &ChannelScale) -> Brick {
    let inverse = 1.0 / scale.unit;
    brick.map(|value| value * inverse)
}
