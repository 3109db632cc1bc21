//! Asking for the values of bricks before the rays of a packet reach them, so that they come into the caches while those before
//! are worked on. Nothing here changes what kernels find.

use fearless_simd::{Simd, f32x16, prelude::*};
use nuage_volume::space::BRICK_VOXELS;

use super::{Lanes, bricks_of, each_bit};
use crate::blocks::Blocks;
use crate::gather::prefetch;
use crate::walk::SPECIAL;

/// It is seen which bricks rays come to each so many turns of a voxel or less.
pub(super) const EACH_VOXELS: u32 = 8;

/// How far ahead is looked, in layers of voxels: a brick and a half.
const AHEAD_VOXELS: f32 = 12.0;

/// How many bricks are remembered. Rays of a packet are in few at once.
const ASKED: usize = 16;

/// The bricks that were asked for. They are asked for whole, since rays beside each other read most of one.
pub(super) struct Asked {
    turn: u32,
    each_turns: u32,
    /// The last ones, by the low bits of their numbers.
    bricks: [i32; ASKED],
}

/// How far ahead rays look.
#[inline(always)]
pub(super) fn ahead_of<S: Simd>(lanes: &Lanes<'_, S>) -> f32x16<S> {
    let [x, y, z] = lanes.inverse;
    x.abs().min(y.abs()).min(z.abs()) * AHEAD_VOXELS
}

impl Asked {
    /// Looks ahead each so many turns.
    pub(super) fn new(each_turns: u32) -> Asked {
        Asked { turn: 0, each_turns, bricks: [-1; ASKED] }
    }

    /// Calls with each brick in which rays are at `t`, but for those it was called with of late; not at every turn.
    #[inline(always)]
    pub(super) fn look_ahead<S: Simd>(
        &mut self,
        lanes: &Lanes<'_, S>,
        t: f32x16<S>,
        mut ask: impl FnMut(usize),
    ) {
        self.turn = self.turn.wrapping_add(1);
        if !self.turn.is_multiple_of(self.each_turns) {
            return;
        }
        let cells = lanes.cells(bricks_of(lanes.at(t)), t.simd_lt(lanes.ends));
        let holds_brick = cells.simd_ge(0) & cells.simd_lt(SPECIAL);
        let cells = cells.to_array();
        each_bit(holds_brick.to_bitmask() as u32, |lane| {
            let brick = cells[lane];
            let asked = &mut self.bricks[brick as usize % ASKED];
            if *asked != brick {
                *asked = brick;
                ask(brick as usize);
            }
        });
    }
}

/// Asks for the values of a brick.
#[inline(always)]
pub(super) fn ask_for_brick<V>(values: &[V], brick: usize) {
    if let Some(values) = values.get(brick * BRICK_VOXELS..(brick + 1) * BRICK_VOXELS) {
        prefetch(values);
    }
}

/// Asks for the block of an entry, if it has been made.
#[inline(always)]
pub(super) fn ask_for_block(blocks: &Blocks<'_>, entry: usize) {
    if let Some(block) = blocks.known(entry) {
        prefetch(block);
    }
}
