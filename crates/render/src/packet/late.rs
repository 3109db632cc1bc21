//! Looking values up some turns after they were asked for.
//!
//! A packet goes from box to box without waiting for what stands in them: when a ray enters a brick, its values are asked for,
//! and what is to be done with them is kept until they have come into the caches. It is done in the same order as at once, so
//! that nothing changes but the time it takes.

use fearless_simd::{Simd, i32x16, prelude::*};
use nuage_volume::space::BRICK_VOXELS;

use super::RAYS;
use crate::blocks::Blocks;
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

/// The bricks rays were in when those were last chosen to be asked for, by ray.
///
/// One is chosen whether it is new or not: what rays enter next cannot be told, so that a branch would cost more than lines that
/// are asked for twice.
pub(super) struct Asked<S: Simd>(i32x16<S>);

impl<S: Simd> Asked<S> {
    #[inline(always)]
    pub(super) fn new(simd: S) -> Self {
        Asked(i32x16::splat(simd, -1))
    }

    /// A brick in which rays are, one they have entered since it was last chosen if there is one; any where they are in none.
    #[inline(always)]
    pub(super) fn choose(&mut self, simd: S, cells: i32x16<S>) -> usize {
        let new = cells.simd_ge(0) & cells.simd_lt(SPECIAL) & !cells.simd_eq(self.0);
        let first = new.to_bitmask().trailing_zeros() as usize % RAYS;
        let brick = cells.to_array()[first];
        self.0 = cells.simd_eq(i32x16::splat(simd, brick)).select(cells, self.0);
        brick.max(0) as usize
    }
}

/// Asks for the values of a brick.
#[inline(always)]
pub(super) fn ask_for_brick<V>(values: &[V], brick: usize) {
    if let Some(values) = values.get(brick * BRICK_VOXELS..(brick + 1) * BRICK_VOXELS) {
        prefetch(values);
    }
}

/// Asks for the first or the second half of the block of an entry, if it has been made.
#[inline(always)]
pub(super) fn ask_for_half(blocks: &Blocks<'_>, entry: usize, is_second: bool) {
    if let Some(block) = blocks.known(entry) {
        let (first, second) = block.split_at(block.len() / 2);
        prefetch(if is_second { second } else { first });
    }
}
