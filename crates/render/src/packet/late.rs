//! Looking values up some turns after they were asked for.
//!
//! A packet goes from box to box without waiting for what stands in them: when a ray enters a brick, its values are asked for,
//! and what is to be done with them is kept until they have come into the caches. It is done in the same order as at once, so
//! that nothing changes but the time it takes.

use fearless_simd::{Simd, i32x16, prelude::*};
use nuage_volume::space::BRICK_VOXELS;

use super::RAYS;
use crate::gather::prefetch;
use crate::walk::SPECIAL;

/// What is kept for so many turns.
pub(super) struct Late<T, const TURNS: usize> {
    kept: [T; TURNS],
    turn: usize,
}

impl<T: Copy, const TURNS: usize> Late<T, TURNS> {
    /// Nothing is kept yet; `filler` is never used.
    #[inline(always)]
    pub(super) fn new(filler: T) -> Self {
        Late { kept: [filler; TURNS], turn: 0 }
    }

    /// Keeps something, and gives what was kept `TURNS` turns ago.
    #[inline(always)]
    pub(super) fn keep(&mut self, new: T) -> Option<T> {
        let old = std::mem::replace(&mut self.kept[self.turn % TURNS], new);
        self.turn += 1;
        (self.turn > TURNS).then_some(old)
    }

    /// All that is still kept, in order.
    #[inline(always)]
    pub(super) fn rest(self) -> impl Iterator<Item = T> {
        (self.turn.saturating_sub(TURNS)..self.turn).map(move |turn| self.kept[turn % TURNS])
    }
}

/// Which bricks rays have been in when they were asked for, of which one is chosen each `TURNS` turns.
///
/// That is done whether one is new or not: what rays enter next cannot be told, so that a branch would cost more than lines that
/// are asked for twice.
pub(super) struct Asked<S: Simd, const TURNS: usize> {
    /// By ray, the brick it was in when that was last chosen.
    known: i32x16<S>,
    chosen: usize,
    turn: usize,
}

impl<S: Simd, const TURNS: usize> Asked<S, TURNS> {
    #[inline(always)]
    pub(super) fn new(simd: S) -> Self {
        Asked { known: i32x16::splat(simd, -1), chosen: 0, turn: 0 }
    }

    /// Calls with a brick in which rays are, or were some turns ago, and with the number of turns since then.
    #[inline(always)]
    pub(super) fn enter(&mut self, simd: S, cells: i32x16<S>, mut ask: impl FnMut(usize, usize)) {
        if self.turn == 0 {
            let new = cells.simd_ge(0) & cells.simd_lt(SPECIAL) & !cells.simd_eq(self.known);
            let first = new.to_bitmask().trailing_zeros() as usize % RAYS;
            let brick = cells.to_array()[first];
            self.known = cells.simd_eq(i32x16::splat(simd, brick)).select(cells, self.known);
            self.chosen = brick.max(0) as usize;
        }
        ask(self.chosen, self.turn);
        self.turn = (self.turn + 1) % TURNS;
    }
}

/// Asks for the values of a brick.
#[inline(always)]
pub(super) fn ask_for_brick<V>(values: &[V], brick: usize) {
    if let Some(values) = values.get(brick * BRICK_VOXELS..(brick + 1) * BRICK_VOXELS) {
        prefetch(values);
    }
}
