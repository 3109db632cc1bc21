//! Choosing a codec for each brick: as few words as keep to the quality asked for.
//!
//! An error bound holds for each brick alone. A signal-to-noise ratio holds for a channel over all frames, and bricks pay
//! for it where it is cheapest: each takes the codec for which words plus λ times its weighed error are least, and λ is
//! the smallest with which all bricks together meet the ratio. So λ has to be settled before the first brick is written:
//! [`Totals`] adds up what each λ of a fixed ladder would lead to. One λ for all frames also means that the bricks which
//! they have in common get the same words.

use nuage_volume::codec::Codec;

use super::quantize::{Error, Measure};

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
const STEPS_PER_OCTAVE: i32 = 64;
/// The first and last step. Beyond, λ makes no difference.
const FIRST_STEP: i32 = -8 * STEPS_PER_OCTAVE;
const LAST_STEP: i32 = 40 * STEPS_PER_OCTAVE;
const STEPS: usize = (LAST_STEP - FIRST_STEP + 1) as usize;

/// The weight of a squared error of 1, in units of a channel, in words.
#[derive(Debug, Clone, Copy, PartialEq, PartialOrd, serde::Serialize, serde::Deserialize)]
pub struct Lambda(f64);

impl Lambda {
    /// Words alone count.
    pub const NONE: Lambda = Lambda(0.0);
    /// The largest of the ladder.
    pub const LARGEST: Lambda = Lambda((1_u64 << (LAST_STEP / STEPS_PER_OCTAVE)) as f64);

    /// The λ of a weight in words.
    pub fn of_weight(words: f64) -> Lambda {
        Lambda(words)
    }

    /// The weight in words.
    pub fn weight(self) -> f64 {
        self.0
    }

    /// The larger of two.
    pub fn max(self, other: Lambda) -> Lambda {
        Lambda(self.0.max(other.0))
    }

    fn of_step(step: usize) -> Lambda {
        let octaves = (step as i32 + FIRST_STEP) as f64 / f64::from(STEPS_PER_OCTAVE);
        Lambda(octaves.exp2())
    }

    /// A λ with which so many bricks are sure to keep to a sum of squared errors, in units of the channel: a brick is
    /// worth all its 512 words where its error is more than its share. Some more, so that a step lies below it.
    pub fn sure(bricks: u64, squared_error: f64) -> Lambda {
        let exact = 2.0 * Codec::F32.word_count() as f64;
        Lambda((exact * bricks as f64 / squared_error).min(Lambda::LARGEST.0))
    }
}

/// A codec that a brick may get.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// The codec.
    pub codec: Codec,
    /// How far off the brick is in it.
    pub error: Error,
    /// What that counts beside words: squares and bias, times the weight of the brick.
    pub weighed: f64,
}

impl Candidate {
    /// A codec for a brick whose errors count `weight` times.
    pub fn new(codec: Codec, error: Error, weight: f64) -> Candidate {
        Candidate { codec, error, weighed: weight * (error.squared + error.bias) }
    }

    fn words(&self) -> f64 {
        self.codec.word_count() as f64
    }

    fn cost(&self, lambda: Lambda) -> f64 {
        self.words() + lambda.0 * self.weighed
    }
}

/// The codecs that are the best for a brick with one λ or another, from the least to the largest. Each takes more words
/// than the one before and has less error, and each saves less error per word.
#[derive(Debug, Clone, PartialEq)]
pub struct Curve(Vec<Candidate>);

impl Curve {
    /// Tries codecs as far as they can be the best with some λ up to `largest`, for a brick whose errors count `weight` times.
    pub fn of(measure: &mut Measure, weight: f64, largest: Lambda) -> Curve {
        let mut curve: Vec<Candidate> = Vec::new();
        for codec in measure.codecs() {
            // With a smaller λ, the best so far but gains on what takes more words.
            let words = codec.word_count() as f64;
            if curve.iter().any(|candidate| candidate.cost(largest) <= words) {
                break;
            }
            let Some(error) = measure.error(codec) else { continue };
            if error.max > measure.scale().max_error {
                continue;
            }
            let candidate = Candidate::new(codec, error, weight);
            if curve.last().is_some_and(|last| last.weighed <= candidate.weighed) {
                continue;
            }
            // Drop what is never the best beside this one.
            while let Some(last) = curve.last() {
                let is_better = last.words() < candidate.words()
                    && match curve.iter().rev().nth(1) {
                        Some(before) => turn(before, last) < turn(last, &candidate),
                        None => true,
                    };
                if is_better {
                    break;
                }
                curve.pop();
            }
            curve.push(candidate);
        }
        Curve(curve)
    }

    /// The best with a λ.
    ///
    /// # Panics
    /// If there is none: the last of the codecs cannot hold the brick.
    pub fn at(&self, lambda: Lambda) -> Candidate {
        let mut best = self.0[0];
        for candidate in &self.0[1..] {
            if candidate.cost(lambda) >= best.cost(lambda) {
                break;
            }
            best = *candidate;
        }
        best
    }
}

/// The λ beyond which `fine` is better than `coarse`.
fn turn(coarse: &Candidate, fine: &Candidate) -> f64 {
    (fine.words() - coarse.words()) / (coarse.weighed - fine.weighed)
}

/// What each λ leads to: the sum of squared errors, in units of the channel, and of words over some bricks.
#[derive(Debug, Clone, PartialEq)]
pub struct Totals {
    /// What bricks lose of their error and gain in words where a step is reached.
    turns: Vec<(f64, u64)>,
    /// The errors of the last step and the words of the first.
    ends: (f64, u64),
}

impl Default for Totals {
    fn default() -> Self {
        Totals { turns: vec![(0.0, 0); STEPS], ends: (0.0, 0) }
    }
}

impl Totals {
    /// Adds a brick.
    pub fn add(&mut self, curve: &Curve) {
        let first = curve.at(Lambda::of_step(0));
        let begin = curve.0.iter().position(|candidate| *candidate == first).unwrap_or(0);
        self.ends.1 += first.codec.word_count() as u64;
        let mut last = first;
        for fine in &curve.0[begin + 1..] {
            let octaves = turn(&last, fine).log2() * f64::from(STEPS_PER_OCTAVE) - f64::from(FIRST_STEP);
            // Logarithms are rounded: what counts is which costs less.
            let is_reached =
                |step: usize| fine.cost(Lambda::of_step(step)) < last.cost(Lambda::of_step(step));
            let mut step = octaves.ceil().clamp(1.0, STEPS as f64) as usize;
            while step > 1 && is_reached(step - 1) {
                step -= 1;
            }
            while step < STEPS && !is_reached(step) {
                step += 1;
            }
            let Some(turn) = self.turns.get_mut(step) else { break };
            turn.0 += last.error.squared - fine.error.squared;
            turn.1 += (fine.codec.word_count() - last.codec.word_count()) as u64;
            last = *fine;
        }
        self.ends.0 += last.error.squared;
    }

    /// The squared error and the words of each step.
    fn steps(&self) -> Vec<(f64, u64)> {
        let mut steps = self.turns.clone();
        let mut words = self.ends.1;
        for step in &mut steps {
            words += step.1;
            step.1 = words;
        }
        // From the smallest sum to the largest, so that none is what is left of a difference.
        let mut squared = self.ends.0;
        for step in steps.iter_mut().rev() {
            (squared, step.0) = (squared + step.0, squared);
        }
        steps
    }

    /// Adds what others have added up.
    pub fn merge(&mut self, other: &Totals) {
        for (turn, other) in self.turns.iter_mut().zip(&other.turns).chain([(&mut self.ends, &other.ends)]) {
            *turn = (turn.0 + other.0, turn.1 + other.1);
        }
    }

    /// The λ that meets a target. If none does, that of the least error.
    pub fn lambda(&self, target: &Target) -> Lambda {
        if *target == Target::default() {
            return Lambda::NONE;
        }
        let steps = self.steps();
        let fine_enough =
            |(squared, _): &(f64, u64)| target.squared_error.is_none_or(|limit| *squared <= limit);
        let too_large = |(_, words): &(f64, u64)| target.words.is_some_and(|limit| *words > limit);
        let fine = match target.squared_error {
            Some(_) => steps.iter().position(fine_enough).unwrap_or(STEPS - 1),
            None => STEPS - 1,
        };
        let small = steps.iter().position(too_large).map_or(STEPS - 1, |step| step.saturating_sub(1));
        Lambda::of_step(fine.min(small))
    }
}

#[cfg(test)]
mod tests {
    use super::super::quantize::{Brick, ChannelScale};
    use super::super::shapes::Shapes;
    use super::*;

    const SCALE: ChannelScale = ChannelScale {
        unit: 1.0,
        floor: 0.0,
        background: 0.0,
        background_tolerance: 1e-3,
        keeps_sign: false,
        max_error: f32::INFINITY,
    };

    fn bounded(max_error: Option<f32>) -> ChannelScale {
        ChannelScale { max_error: max_error.unwrap_or(f32::INFINITY), ..SCALE }
    }

    fn bricks() -> Vec<Brick> {
        let wave =
            |i: usize, brick: usize| ((i * i * (brick + 3)) as f32 * 0.001).sin() * 0.4 / (1 + brick) as f32;
        let empty = |i: usize, brick: usize| brick.is_multiple_of(4) && i % (brick + 8) < brick;
        let value = |i, brick| if empty(i, brick) { 0.0 } else { 0.5 + wave(i, brick) };
        (0..40).map(|brick| std::array::from_fn(|i| value(i, brick))).collect()
    }

    fn curve(brick: &Brick, max_error: Option<f32>, largest: Lambda) -> Curve {
        Curve::of(&mut Measure::of(brick, &bounded(max_error), &Shapes::default()), 1.0, largest)
    }

    /// The least that a brick costs, tried codec by codec.
    fn least(brick: &Brick, max_error: Option<f32>, lambda: Lambda) -> f64 {
        let shapes = Shapes::default();
        let scale = bounded(max_error);
        let mut measure = Measure::of(brick, &scale, &shapes);
        let candidates = measure.codecs().filter_map(|codec| {
            let error =
                measure.error(codec).filter(|error| max_error.is_none_or(|bound| error.max <= bound))?;
            Some(Candidate::new(codec, error, 1.0).cost(lambda))
        });
        candidates.fold(f64::INFINITY, f64::min)
    }

    fn spent(bricks: &[Brick], max_error: Option<f32>, lambda: Lambda) -> (f64, f32, u64) {
        bricks.iter().fold((0.0, 0.0, 0), |(squared, max, words), brick| {
            let Candidate { codec, error, .. } = curve(brick, max_error, lambda).at(lambda);
            (squared + error.squared, error.max.max(max), words + codec.word_count() as u64)
        })
    }

    #[test]
    fn a_curve_has_the_best_codec_for_every_lambda() {
        for brick in &bricks()[..4] {
            for max_error in [None, Some(0.1), Some(1e-3)] {
                let whole = curve(brick, max_error, Lambda::LARGEST);
                for step in (0..STEPS).step_by(23) {
                    let lambda = Lambda::of_step(step);
                    let least = least(brick, max_error, lambda);
                    assert!((whole.at(lambda).cost(lambda) - least).abs() <= 1e-9 * least, "step {step}");
                    assert_eq!(curve(brick, max_error, lambda).at(lambda), whole.at(lambda), "step {step}");
                }
            }
        }
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
        for max_error in [None, Some(0.05)] {
            let mut totals = Totals::default();
            bricks.iter().for_each(|brick| totals.add(&curve(brick, max_error, Lambda::LARGEST)));
            for (step, (squared, words)) in totals.steps().into_iter().enumerate().step_by(13) {
                let expected = spent(&bricks, max_error, Lambda::of_step(step));
                assert!((squared - expected.0).abs() <= 1e-9 * squared && words == expected.2, "step {step}");
            }
            let of = |target: Target| spent(&bricks, max_error, totals.lambda(&target));
            let error = |limit: f64| of(Target { squared_error: Some(limit), words: None });
            for limit in [1e-4, 1e-3, 0.1, 10.0] {
                let (squared, _, words) = error(limit);
                assert!(squared <= limit && error(limit * 10.0).2 <= words);
                let sure = Lambda::sure(bricks.len() as u64, limit);
                assert!(totals.lambda(&Target { squared_error: Some(limit), words: None }) <= sure);
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
