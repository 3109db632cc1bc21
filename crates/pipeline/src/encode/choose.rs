//! Choosing a codec for each brick of a frame: as few words as keep to the quality asked for.
//!
//! An error bound holds for each brick alone. A signal-to-noise ratio holds for the frame as a whole, and bricks pay
//! for it where it is cheapest: each takes the codec for which words plus λ times squared error are least, and λ is
//! the smallest with which the frame meets the ratio. λ goes in steps, so that the bricks which frames have in common
//! mostly get the same words.

use nuage_volume::codec::Codec;

use super::quantize::Error;

/// What a channel's bricks have to keep to.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Target {
    /// The largest error of any voxel.
    pub max_error: Option<f32>,
    /// The largest sum of squared errors of the frame.
    pub squared_error: Option<f64>,
    /// The most words that all bricks may take. As long as they do, more are spent to reduce the error.
    pub words: Option<u64>,
}

/// How λ is stepped: as powers of two of this many parts.
const STEPS_PER_OCTAVE: i32 = 8;
/// Beyond 2^±this, λ makes no difference.
const LAST_OCTAVE: i32 = 120;

/// The codec of each brick, as indices into `codecs`, from the errors that [`super::quantize::measure`] gives. The last
/// codec is that of bricks which none of the others can hold.
pub fn choose(codecs: &[Codec], bricks: &[Vec<Option<Error>>], target: &Target) -> Vec<usize> {
    let pick = |errors: &[Option<Error>], lambda: f64| {
        let mut best = (codecs.len() - 1, f64::INFINITY);
        for (i, error) in errors.iter().enumerate() {
            let Some(error) = error else { continue };
            let cost = codecs[i].word_count() as f64 + lambda * f64::from(error.squared);
            if cost < best.1 && target.max_error.is_none_or(|bound| error.max <= bound) {
                best = (i, cost);
            }
        }
        best.0
    };
    let lambda = |step: i32| f64::from(step).exp2().powf(1.0 / f64::from(STEPS_PER_OCTAVE));
    let totals = |step: i32| {
        bricks.iter().fold((0.0, 0), |(squared, words), errors| {
            let i = pick(errors, lambda(step));
            let error = errors[i].map_or(0.0, |error| f64::from(error.squared));
            (squared + error, words + codecs[i].word_count() as u64)
        })
    };
    let last = LAST_OCTAVE * STEPS_PER_OCTAVE;
    // The smallest step that is fine enough, then, if words are limited, the largest that is not too fine.
    let first_fine = match target.squared_error {
        Some(limit) => first(-last, last, |step| totals(step).0 <= limit),
        None if target.words.is_some() => last,
        None => -last,
    };
    let step = match target.words {
        Some(limit) => first_fine.min(first(-last, last, |step| totals(step).1 > limit) - 1),
        None => first_fine,
    };
    bricks.iter().map(|errors| pick(errors, lambda(step))).collect()
}

/// The first number from `low` on for which something holds that then holds for all after it, at most `high`.
fn first(mut low: i32, mut high: i32, holds: impl Fn(i32) -> bool) -> i32 {
    while low < high {
        let middle = low + (high - low) / 2;
        if holds(middle) { high = middle } else { low = middle + 1 }
    }
    low
}

#[cfg(test)]
mod tests {
    use super::super::quantize::{CODECS, ChannelScale, measure};
    use super::*;

    fn bricks() -> Vec<Vec<Option<Error>>> {
        let scale = ChannelScale {
            unit: 1.0,
            floor: 0.0,
            background: 0.0,
            background_tolerance: 1e-3,
            keeps_sign: false,
        };
        let wave =
            |i: usize, brick: usize| ((i * i * (brick + 3)) as f32 * 0.001).sin() * 0.4 / (1 + brick) as f32;
        let brick = |brick: usize| std::array::from_fn(|i| 0.5 + wave(i, brick));
        (0..40).map(|i| measure(&brick(i), &CODECS, &scale)).collect()
    }

    fn totals(bricks: &[Vec<Option<Error>>], chosen: &[usize]) -> (f64, f32, u64) {
        chosen.iter().zip(bricks).fold((0.0, 0.0, 0), |(squared, max, words), (i, errors)| {
            let error = errors[*i].unwrap();
            (squared + f64::from(error.squared), error.max.max(max), words + CODECS[*i].word_count() as u64)
        })
    }

    #[test]
    fn targets_are_met_and_cost_what_they_must() {
        let bricks = bricks();
        let of = |target: Target| totals(&bricks, &choose(&CODECS, &bricks, &target));
        let bounded = |bound: f32| of(Target { max_error: Some(bound), ..Target::default() });
        let (mut last_words, mut cheapest) = (u64::MAX, 0);
        for bound in [1e-7, 1e-4, 1e-3, 1e-2, 1e-1, 1.0] {
            let (_, max, words) = bounded(bound);
            assert!(max <= bound && words <= last_words);
            (last_words, cheapest) = (words, words);
        }
        assert_eq!(cheapest, 0, "all constant");
        for limit in [1e-9, 1e-3, 0.1, 10.0] {
            let (squared, _, words) = of(Target { squared_error: Some(limit), ..Target::default() });
            assert!(squared <= limit);
            let (looser, _, fewer) = of(Target { squared_error: Some(limit * 10.0), ..Target::default() });
            assert!(fewer <= words && looser <= limit * 10.0);
        }
        for limit in [0, 1000, 3000, 8000] {
            let (squared, _, words) = of(Target { words: Some(limit), ..Target::default() });
            assert!(words <= limit);
            let (better, _, _) = of(Target { words: Some(2 * limit + 1000), ..Target::default() });
            assert!(better <= squared);
        }
        let both = Target { words: Some(100_000), squared_error: Some(0.1), ..Target::default() };
        let one = Target { squared_error: Some(0.1), ..Target::default() };
        assert_eq!(of(both), of(one), "no more words than the error asks for");
    }
}
