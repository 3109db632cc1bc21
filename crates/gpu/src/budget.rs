//! How much work a picture may be: a controller that is told what pictures took, and makes those that follow coarser until
//! they take no longer than they may.
//!
//! Time is taken to fall as steps get longer, with a part that does not: told what that came to each time, the controller
//! closes in on it. It goes up at once and down slowly, so that one slow picture does not make the next ones flicker.
//!
//! What does not live here: clocks ([`crate::timer`]), and what coarser means to passes ([`crate::real_time`]).

/// How coarse a picture is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Effort {
    /// How many times as long as asked steps are, from 1 on.
    pub(crate) coarseness: f32,
    /// Whether a quarter of the pixels is marched.
    pub(crate) is_half: bool,
}

/// The most that steps are lengthened before a quarter of the pixels is marched, …
const MOST_COARSE: f32 = 4.0;
/// … and after that.
const MOST_COARSE_HALF: f32 = 16.0;
/// What a quarter of the pixels takes of the time.
const QUARTER: f32 = 0.25;
/// All pixels are marched again where this coarseness would do for a quarter of them.
const BACK: f32 = 0.7;
/// The share of the time that is aimed at: times scatter.
const AIM: f32 = 0.85;
/// The most that steps are lengthened at once, …
const MOST_RISE: f32 = 2.0;
/// … and how much of the way down is gone with each picture.
const FALL: f32 = 0.1;

/// A controller of effort.
#[derive(Debug, Clone)]
pub(crate) struct Budget {
    /// What is wanted, below 1 too.
    coarseness: f32,
    is_half: bool,
}

impl Default for Budget {
    fn default() -> Budget {
        Budget { coarseness: 1.0, is_half: false }
    }
}

impl Budget {
    /// The effort of the next picture.
    pub(crate) fn effort(&self) -> Effort {
        Effort { coarseness: self.coarseness.max(1.0), is_half: self.is_half }
    }

    /// Learns what a picture of an effort took. Pictures may be told of late, when others were made meanwhile.
    pub(crate) fn learn(&mut self, effort: Effort, took_ms: f32, budget_ms: f32) {
        let is_number = took_ms.is_finite() && took_ms >= 0.0 && budget_ms > 0.0;
        // What pictures of other numbers of pixels took says little.
        if !is_number || effort.is_half != self.is_half {
            return;
        }
        let wanted = effort.coarseness * took_ms / (AIM * budget_ms);
        if wanted > self.coarseness {
            self.coarseness = wanted.min(effort.coarseness * MOST_RISE).max(self.coarseness);
        } else {
            self.coarseness += FALL * (wanted - self.coarseness);
        }
        if !self.is_half && self.coarseness > MOST_COARSE {
            *self = Budget { coarseness: self.coarseness * QUARTER, is_half: true };
        } else if self.is_half && self.coarseness < BACK {
            *self = Budget { coarseness: self.coarseness / QUARTER, is_half: false };
        }
        let most = if self.is_half { MOST_COARSE_HALF } else { MOST_COARSE };
        self.coarseness = self.coarseness.clamp(BACK * BACK, most);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nuage_render::hash::{hash_u32, unit_f32};

    /// What a device takes: a part for each picture, and one that falls with effort, give or take a tenth.
    fn took(effort: Effort, fixed_ms: f32, march_ms: f32, picture: u32) -> f32 {
        let pixels = if effort.is_half { 0.25 } else { 1.0 };
        let scatter = 0.9 + 0.2 * unit_f32(hash_u32(picture + 1));
        scatter * (fixed_ms + pixels * march_ms / effort.coarseness)
    }

    /// The times of pictures, each of which is learnt of two pictures later.
    fn times(budget: &mut Budget, pictures: u32, budget_ms: f32, fixed_ms: f32, march_ms: f32) -> Vec<f32> {
        let mut under_way = Vec::new();
        let mut times = Vec::new();
        for picture in 0..pictures {
            let effort = budget.effort();
            under_way.push((effort, took(effort, fixed_ms, march_ms, picture)));
            times.push(under_way[under_way.len() - 1].1);
            if under_way.len() > 2 {
                let (effort, took_ms) = under_way.remove(0);
                budget.learn(effort, took_ms, budget_ms);
            }
        }
        times
    }

    #[test]
    fn pictures_come_to_take_what_they_may() {
        for (budget_ms, fixed_ms, march_ms) in
            [(5.0, 0.5, 8.0), (4.0, 0.5, 30.0), (2.0, 0.3, 60.0), (10.0, 0.0, 300.0)]
        {
            let mut budget = Budget::default();
            let times = times(&mut budget, 100, budget_ms, fixed_ms, march_ms);
            let late = &times[40..];
            let mean = late.iter().sum::<f32>() / late.len() as f32;
            let over = late.iter().filter(|took| **took > budget_ms).count();
            assert!(over <= 3, "{over} of {} pictures took longer than {budget_ms}", late.len());
            assert!(mean > 0.5 * budget_ms, "{mean} of {budget_ms}: coarser than need be");
        }
    }

    #[test]
    fn nothing_is_coarser_without_need_and_all_comes_back() {
        let mut budget = Budget::default();
        times(&mut budget, 50, 10.0, 1.0, 5.0);
        assert_eq!(budget.effort(), Effort { coarseness: 1.0, is_half: false });
        times(&mut budget, 50, 10.0, 1.0, 200.0);
        assert!(budget.effort().is_half);
        times(&mut budget, 200, 10.0, 1.0, 5.0);
        assert_eq!(budget.effort(), Effort { coarseness: 1.0, is_half: false });
    }

    #[test]
    fn what_cannot_be_held_ends_at_the_coarsest() {
        let mut budget = Budget::default();
        times(&mut budget, 60, 1.0, 5.0, 50.0);
        assert_eq!(budget.effort(), Effort { coarseness: MOST_COARSE_HALF, is_half: true });
        budget.learn(budget.effort(), f32::NAN, 1.0);
        budget.learn(budget.effort(), 1.0, 0.0);
        assert_eq!(budget.effort(), Effort { coarseness: MOST_COARSE_HALF, is_half: true });
    }
}
