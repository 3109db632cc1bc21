//! Decoded bricks, each with the layer of voxels beyond it: what trilinear interpolation reads.
//!
//! A third of all cells reach into a neighbouring brick, and half floats take work to decode. Rays visit the
//! same bricks again and again, so a brick is kept from its first visit on as a block of 9³ floats, in which
//! every cell of the brick is eight plain reads. All threads share the blocks. They take 2.9 KB per brick that
//! any ray has met.
//!
//! The values are those of [`Accessor::trilinear`], which is the specification.

use std::sync::{Arc, OnceLock};

use glam::{IVec3, Vec3};
use nuage_volume::accessor::{Accessor, BrickPlace};
use nuage_volume::space::brick_of;
use nuage_volume::tree::{Content, Tree};

use crate::gather::prefetch;

/// Voxels of a block per axis.
pub(crate) const SIDE: usize = 9;

/// The values of a brick and of the layer beyond it, at `(x * 9 + y) * 9 + z`.
pub(crate) type Block = [f32; SIDE * SIDE * SIDE];

/// The blocks of a tree, by the index of the brick's entry.
#[derive(Debug, Clone)]
pub struct BlockStore {
    blocks: Arc<[OnceLock<Box<Block>>]>,
}

/// One thread's view of a tree through its blocks.
#[derive(Debug, Clone)]
pub struct Blocks<'a> {
    store: BlockStore,
    accessor: Accessor<'a>,
    /// The brick met last, and its place. Its block is there.
    brick: IVec3,
    place: BrickPlace,
    /// The block of a brick that has no entry, inside a tile, and its place.
    border: (IVec3, Option<Box<Block>>),
}

impl BlockStore {
    /// A store for a tree, still empty.
    pub fn new(tree: &Tree) -> Self {
        BlockStore { blocks: (0..tree.node4.entries.len()).map(|_| OnceLock::new()).collect() }
    }
}

impl<'a> Blocks<'a> {
    /// A view of a tree, whose blocks are kept in its store.
    pub fn new(tree: &'a Tree, store: &BlockStore) -> Self {
        let mut blocks = Blocks {
            store: store.clone(),
            accessor: Accessor::new(tree),
            brick: IVec3::ZERO,
            place: BrickPlace::Tile,
            border: (IVec3::ZERO, None),
        };
        blocks.meet(IVec3::ZERO);
        blocks
    }

    /// The trilinear interpolation inside the cell whose lower corner is the voxel `cell`, at `fraction` in
    /// `[0, 1]` along each axis.
    #[inline]
    pub fn trilinear_in_cell(&mut self, cell: IVec3, fraction: Vec3) -> f32 {
        let brick = brick_of(cell);
        if brick != self.brick {
            self.meet(brick);
        }
        let block = match self.place {
            BrickPlace::Entry(entry) => self.store.blocks[entry].get(),
            BrickPlace::Zero => return 0.0,
            BrickPlace::Tile => None,
        };
        let Some(block) = block else {
            return self.accessor.trilinear_in_cell(cell, fraction);
        };
        let local = cell & 7;
        let offset = (local.x * 81 + local.y * 9 + local.z) as usize;
        // The eight corners lie in 92 consecutive values: one bounds check.
        let v: &[f32; 92] = block[offset..offset + 92].try_into().expect("92 values");
        let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
        let [x, y, z] = fraction.to_array();
        let low = mix(mix(v[0], v[1], z), mix(v[9], v[10], z), y);
        let high = mix(mix(v[81], v[82], z), mix(v[90], v[91], z), y);
        mix(low, high, x)
    }

    /// The block of an entry, whose brick is asked for when the block is made.
    #[inline(always)]
    pub(crate) fn of_entry(&mut self, entry: usize, brick: impl Fn() -> IVec3) -> &Block {
        let slot = &self.store.blocks[entry];
        match slot.get() {
            Some(block) => block,
            None => {
                let accessor = &mut self.accessor;
                slot.get_or_init(|| decode_first(accessor, brick()))
            }
        }
    }

    /// The block of an entry, if it has been made.
    #[inline(always)]
    pub(crate) fn known(&self, entry: usize) -> Option<&Block> {
        self.store.blocks.get(entry)?.get().map(AsRef::as_ref)
    }

    /// Asks for what says where the block of an entry is.
    #[inline(always)]
    pub(crate) fn ask_for_place(&self, entry: usize) {
        if let Some(slot) = self.store.blocks.get(entry) {
            prefetch(std::slice::from_ref(slot));
        }
    }

    /// The block of a brick that has no entry of its own, being part of a tile.
    #[cold]
    pub(crate) fn of_tile(&mut self, brick: IVec3) -> &Block {
        let (place, block) = &mut self.border;
        if *place != brick {
            *block = None;
        }
        *place = brick;
        block.get_or_insert_with(|| decode(&mut self.accessor, brick))
    }

    /// Makes a brick the one met last.
    #[inline(never)]
    fn meet(&mut self, brick: IVec3) {
        self.brick = brick;
        self.place = self.accessor.place(brick);
        if let BrickPlace::Entry(entry) = self.place {
            let accessor = &mut self.accessor;
            self.store.blocks[entry].get_or_init(|| decode(accessor, brick));
        }
    }
}

/// What is done once for each brick need not stand where it is done for each ray.
#[cold]
#[inline(never)]
fn decode_first(accessor: &mut Accessor<'_>, brick: IVec3) -> Box<Block> {
    decode(accessor, brick)
}

/// The block of a brick, from it and its seven neighbours.
fn decode(accessor: &mut Accessor<'_>, brick: IVec3) -> Box<Block> {
    let bricks = &accessor.tree().bricks;
    let mut block: Box<Block> = Box::new([0.0; SIDE * SIDE * SIDE]);
    for neighbour in 0..8 {
        let step = [neighbour >> 2, neighbour >> 1 & 1, neighbour & 1];
        let at = brick.wrapping_add(IVec3::new(step[0] as i32, step[1] as i32, step[2] as i32));
        // Of this brick all voxels, of a neighbour those at its low end.
        let [nx, ny, nz] = step.map(|step| if step == 0 { 8 } else { 1 });
        let content = accessor.region(at).content;
        let mut row = [0.0; 8];
        for x in 0..nx {
            for y in 0..ny {
                match content {
                    Content::Constant(value) => row = [value; 8],
                    Content::Brick(index) => bricks.row(index, x << 6 | y << 3, &mut row),
                }
                let to = (x + 8 * step[0]) * 81 + (y + 8 * step[1]) * 9 + 8 * step[2];
                block[to..to + nz].copy_from_slice(&row[..nz]);
            }
        }
    }
    block
}
