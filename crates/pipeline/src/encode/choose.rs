//! Choosing a codec for each brick: as few words as keep to the quality asked for.
//!
//! An error bound holds for each brick alone. A signal-to-noise ratio holds for a channel over all frames, and bricks pay
//! for it where it is cheapest: each takes the codec for which words plus λ times squared error are least, and λ is
//! the smallest with which all bricks together meet the ratio. So λ has to be settled before the first brick is written:
//! [`Totals`] adds up what each λ of a fixed ladder would lead to. One λ for all frames also means that the bricks which
//! they have in common get the same words.

use nuage_volume::codec::Codec;

use super::quantize::Error;

/// What a channel's bricks have to keep to, together.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Target {
    /// The largest sum of squared errors.
    pub squared_error: Option<f64>,
    /// The most words that all bricks may take. As long as they do, more are spent to reduce the error, as far as
    /// `squared_error` asks for it.
    pub words: Option<u64>,
}

/// How λ is stepped: so many steps double it.
const STEPS_PER_OCTAVE: i32 = 16;
/// The first and last step. Beyond, for values of any unit, λ makes no difference.
const FIRST_STEP: i32 = -8 * STEPS_PER_OCTAVE;
const LAST_STEP: i32 = 40 * STEPS_PER_OCTAVE;
const STEPS: usize = (LAST_STEP - FIRST_STEP + 1) as usize;

/// The weight of a squared error of 1 in units of a channel, in words.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lambda(f64);

impl Lambda {
    /// Words alone count.
    pub const NONE: Lambda = Lambda(0.0);

    /// The λ of a step, for errors of a channel of this unit.
    fn of_step(step: i32, unit: f32) -> Lambda {
        Lambda((f64::from(step) / f64::from(STEPS_PER_OCTAVE)).exp2() / f64::from(unit).powi(2))
    }
}

/// The codec of a brick, as an index into `codecs`, from the errors that [`super::quantize::measure`] gives. The last
/// codec is that of bricks which none of the others can hold.
pub fn choose(codecs: &[Codec], errors: &[Option<Error>], max_error: Option<f32>, lambda: Lambda) -> usize {
    let mut best = (codecs.len() - 1, f64::INFINITY);
    for (i, error) in errors.iter().enumerate() {
        let Some(error) = error else { continue };
        let cost = codecs[i].word_count() as f64 + lambda.0 * f64::from(error.squared);
        if cost < best.1 && max_error.is_none_or(|bound| error.max <= bound) {
            best = (i, cost);
        }
    }
    best.0
}

/// What each λ leads to: the sum of squared errors and of words over some bricks.
#[derive(Debug, Clone, PartialEq)]
pub struct Totals {
    steps: Vec<(f64, u64)>,
}

impl Default for Totals {
    fn default() -> Self {
        Totals { steps: vec![(0.0, 0); STEPS] }
    }
}

impl Totals {
    /// Adds a brick.
    pub fn add(&mut self, codecs: &[Codec], errors: &[Option<Error>], max_error: Option<f32>, unit: f32) {
        // With growing λ, bricks go from cheap codecs to exact ones and never back: most steps in between are alike.
        let pick =
            |step: usize| choose(codecs, errors, max_error, Lambda::of_step(FIRST_STEP + step as i32, unit));
        let mut fill = vec![(0, STEPS - 1, pick(0), pick(STEPS - 1))];
        while let Some((low, high, at_low, at_high)) = fill.pop() {
            if at_low == at_high || high - low <= 1 {
                (low..=high).for_each(|step| {
                    let i = if step == high { at_high } else { at_low };
                    // The ends of a part belong to the part that begins there.
                    if step < high || high == STEPS - 1 {
                        let error = errors[i].map_or(0.0, |error| f64::from(error.squared));
                        self.steps[step].0 += error;
                        self.steps[step].1 += codecs[i].word_count() as u64;
                    }
                });
            } else {
                let middle = low.midpoint(high);
                let at_middle = pick(middle);
                fill.push((low, middle, at_low, at_middle));
                fill.push((middle, high, at_middle, at_high));
            }
        }
    }

    /// Adds what others have added up.
    pub fn merge(&mut self, other: &Totals) {
        for (total, other) in self.steps.iter_mut().zip(&other.steps) {
            *total = (total.0 + other.0, total.1 + other.1);
        }
    }

    /// The λ that meets a target. If none does, that of the least error.
    pub fn lambda(&self, target: &Target, unit: f32) -> Lambda {
        if *target == Target::default() {
            return Lambda::NONE;
        }
        let fine_enough =
            |(squared, _): &(f64, u64)| target.squared_error.is_none_or(|limit| *squared <= limit);
        let too_large = |(_, words): &(f64, u64)| target.words.is_some_and(|limit| *words > limit);
        let fine = match target.squared_error {
            Some(_) => self.steps.iter().position(fine_enough).unwrap_or(STEPS - 1),
            None => STEPS - 1,
        };
        let small = self.steps.iter().position(too_large).map_or(STEPS - 1, |step| step.saturating_sub(1));
        Lambda::of_step(FIRST_STEP + fine.min(small) as i32, unit)
    }
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

    fn spent(bricks: &[Vec<Option<Error>>], max_error: Option<f32>, lambda: Lambda) -> (f64, f32, u64) {
        bricks.iter().fold((0.0, 0.0, 0), |(squared, max, words), errors| {
            let i = choose(&CODECS, errors, max_error, lambda);
            let error = errors[i].unwrap();
            (squared + f64::from(error.squared), error.max.max(max), words + CODECS[i].word_count() as u64)
        })
    }

    #[test]
    fn bounds_are_kept_and_cost_what_they_must() {
        let bricks = bricks();
        let mut last = u64::MAX;
        for bound in [1e-7, 1e-4, 1e-3, 1e-2, 1e-1, 1.0] {
            let (_, max, words) = spent(&bricks, Some(bound), Lambda::NONE);
            assert!(max <= bound && words <= last);
            last = words;
        }
        assert_eq!(last, 0, "all constant");
    }

    #[test]
    fn totals_are_what_each_lambda_leads_to_and_targets_are_met() {
        let bricks = bricks();
        for (unit, max_error) in [(1.0, None), (1.0, Some(0.05)), (0.25, None)] {
            let mut totals = Totals::default();
            bricks.iter().for_each(|errors| totals.add(&CODECS, errors, max_error, unit));
            for (step, (squared, words)) in totals.steps.iter().enumerate() {
                let lambda = Lambda::of_step(FIRST_STEP + step as i32, unit);
                let expected = spent(&bricks, max_error, lambda);
                assert!(
                    (squared - expected.0).abs() <= 1e-6 * squared && *words == expected.2,
                    "step {step}"
                );
            }
            let of = |target: Target| spent(&bricks, max_error, totals.lambda(&target, unit));
            let error = |limit: f64| of(Target { squared_error: Some(limit), words: None });
            for limit in [1e-4, 1e-3, 0.1, 10.0] {
                let (squared, _, words) = error(limit);
                assert!(squared <= limit && error(limit * 10.0).2 <= words);
            }
            let cheapest = spent(&bricks, max_error, Lambda::NONE).2;
            for limit in [cheapest, 1000 + cheapest, 3000 + cheapest] {
                let (squared, _, words) = of(Target { words: Some(limit), squared_error: None });
                assert!(words <= limit);
                let (better, ..) = of(Target { words: Some(2 * limit + 1000), squared_error: None });
                assert!(better <= squared);
            }
            let both = of(Target { words: Some(1_000_000), squared_error: Some(0.1) });
            assert_eq!(both, error(0.1), "no more words than the error asks for");
        }
    }
}
