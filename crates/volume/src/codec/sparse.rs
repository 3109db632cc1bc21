//! Codes of the voxels that are there, in bricks that are partly empty.
//!
//! A brick is 4³ blocks of 2³ voxels. Two bits of a block say whether it has voxels at all and whether it has all of them; each block
//! that has some but not all has a mask of eight bits. The codes of the voxels follow without gaps, block by block. So an
//! empty half of a brick costs next to nothing, and where a voxel's code stands follows from counting bits.
//!
//! What is not a code is here a *symbol*: 0 for a voxel that is not there, else its code plus 1. What codes mean is
//! [`super`]'s.

use crate::space::BRICK_VOXELS;

/// Codes have at most so many bits.
pub const MAX_BITS: u8 = 7;

/// The words of the two masks of blocks.
const BLOCK_MASK_WORDS: usize = 4;

/// Blocks of a brick, and voxels of a block.
const BLOCKS: usize = 64;
const BLOCK_VOXELS: usize = 8;

/// A symbol per voxel: 0 where there is none, else its code plus 1.
pub type Symbols = [u8; BRICK_VOXELS];

/// The voxel of a brick from block and voxel of the block, both in the order of x, y and z.
const VOXEL: [u16; BRICK_VOXELS] = {
    let mut voxels = [0; BRICK_VOXELS];
    let mut i = 0;
    while i < BRICK_VOXELS {
        let (block, voxel) = (i / BLOCK_VOXELS, i % BLOCK_VOXELS);
        let x = (block >> 4) << 1 | voxel >> 2;
        let y = (block >> 2 & 3) << 1 | voxel >> 1 & 1;
        let z = (block & 3) << 1 | voxel & 1;
        voxels[i] = (x << 6 | y << 3 | z) as u16;
        i += 1;
    }
    voxels
};

/// The masks of a brick's blocks: bit `i` for voxel `i` of the block.
fn masks(symbols: &Symbols) -> [u8; BLOCKS] {
    let mut masks = [0; BLOCKS];
    for (mask, voxels) in masks.iter_mut().zip(VOXEL.as_chunks::<BLOCK_VOXELS>().0) {
        for (i, voxel) in voxels.iter().enumerate() {
            *mask |= u8::from(symbols[usize::from(*voxel)] > 0) << i;
        }
    }
    masks
}

/// Which voxels of a brick are there: bit `y << 3 | z` of word `x`.
pub type Presence = [u64; 8];

/// The words that masks and codes of a brick take.
pub fn word_count(bits: u8, is_there: &Presence) -> usize {
    /// The bits of even y and z.
    const EVEN: u64 = 0x0055_0055_0055_0055;
    let (mut mixed, mut voxels) = (0, 0);
    for [low, high] in is_there.as_chunks::<2>().0 {
        // Two and two voxels along x, then z, then y.
        let (some, all) = (low | high, low & high);
        let (some, all) = (some | some >> 1, all & all >> 1);
        let (some, all) = (some | some >> 8, all & all >> 8);
        mixed += (some & !all & EVEN).count_ones() as usize;
        voxels += (low.count_ones() + high.count_ones()) as usize;
    }
    BLOCK_MASK_WORDS + mixed.div_ceil(4) + (voxels * usize::from(bits)).div_ceil(32)
}

/// Appends the words of a brick: the mask of blocks that have voxels, that of those that have all, the masks of the
/// others, and the codes.
///
/// # Panics
/// If `bits` is not 1 to 7.
pub fn pack(bits: u8, symbols: &Symbols, words: &mut Vec<u32>) {
    assert!((1..=MAX_BITS).contains(&bits), "{bits} bits");
    let masks = masks(symbols);
    let set_of = |has: fn(u8) -> bool| (0..BLOCKS).fold(0_u64, |set, i| set | u64::from(has(masks[i])) << i);
    for set in [set_of(|mask| mask != 0), set_of(|mask| mask == 0xff)] {
        words.extend([set as u32, (set >> 32) as u32]);
    }
    let mixed: Vec<u8> = masks.into_iter().filter(|mask| *mask != 0 && *mask != 0xff).collect();
    for bytes in mixed.chunks(4) {
        let mut word = [0; 4];
        word[..bytes.len()].copy_from_slice(bytes);
        words.push(u32::from_le_bytes(word));
    }
    let (mut waiting, mut waiting_bits) = (0_u64, 0);
    for voxel in VOXEL {
        let symbol = symbols[usize::from(voxel)];
        if symbol > 0 {
            waiting |= u64::from(symbol - 1) << waiting_bits;
            waiting_bits += u32::from(bits);
        }
        if waiting_bits >= 32 {
            words.push(waiting as u32);
            (waiting, waiting_bits) = (waiting >> 32, waiting_bits - 32);
        }
    }
    if waiting_bits > 0 {
        words.push(waiting as u32);
    }
}

/// The symbols of a brick from its words, which may be followed by others. `None` if they are not all there, or `bits` is not 1 to 7.
pub fn unpack(bits: u8, words: &[u32]) -> Option<Symbols> {
    if !(1..=MAX_BITS).contains(&bits) {
        return None;
    }
    let (sets, rest) = words.split_at_checked(BLOCK_MASK_WORDS)?;
    let some = u64::from(sets[0]) | u64::from(sets[1]) << 32;
    let all = u64::from(sets[2]) | u64::from(sets[3]) << 32;
    let (masks, codes) = rest.split_at_checked(((some & !all).count_ones() as usize).div_ceil(4))?;
    let mut mixed = 0;
    let mut symbols = [0; BRICK_VOXELS];
    let (mut word, mut waiting, mut waiting_bits) = (0, 0_u64, 0);
    for (block, voxels) in VOXEL.as_chunks::<BLOCK_VOXELS>().0.iter().enumerate() {
        let mask = match (all >> block & 1, some >> block & 1) {
            (1, _) => 0xff,
            (_, 0) => continue,
            _ => {
                mixed += 1;
                masks[(mixed - 1) / 4] >> ((mixed - 1) % 4 * 8) & 0xff
            }
        };
        for (i, voxel) in voxels.iter().enumerate() {
            if mask >> i & 1 == 0 {
                continue;
            }
            if waiting_bits < u32::from(bits) {
                waiting |= u64::from(*codes.get(word)?) << waiting_bits;
                (word, waiting_bits) = (word + 1, waiting_bits + 32);
            }
            symbols[usize::from(*voxel)] = (waiting as u8 & ((1 << bits) - 1)) + 1;
            (waiting, waiting_bits) = (waiting >> bits, waiting_bits - u32::from(bits));
        }
    }
    Some(symbols)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn presence(is_there: impl Fn(usize) -> bool) -> Presence {
        std::array::from_fn(|x| (0..64).fold(0, |plane, i| plane | u64::from(is_there(x << 6 | i)) << i))
    }

    proptest! {
        #[test]
        fn packed_symbols_come_back(bits in 1_u8..=MAX_BITS, seed in any::<u32>(), plane in -2_i32..26) {
            let symbols: Symbols = std::array::from_fn(|i| {
                let random = (i as u32 ^ seed).wrapping_mul(2_654_435_761) >> 16;
                let is_there = (i >> 6) + (i >> 3 & 7) + (i & 7) < plane.max(0) as usize + (random & 1) as usize;
                if is_there { (random >> 1) as u8 % (1 << bits) + 1 } else { 0 }
            });
            let mut words = Vec::new();
            pack(bits, &symbols, &mut words);
            prop_assert_eq!(words.len(), word_count(bits, &presence(|i| symbols[i] > 0)));
            prop_assert_eq!(unpack(bits, &words), Some(symbols));
            // With less, nothing is made up.
            for len in 0..words.len() {
                prop_assert!(unpack(bits, &words[..len]).is_none_or(|found| found == symbols));
            }
            words.push(u32::MAX);
            prop_assert_eq!(unpack(bits, &words), Some(symbols));
        }
    }

    #[test]
    fn a_half_brick_takes_half_the_codes() {
        assert_eq!(word_count(4, &presence(|i| i < 256)), 4 + 32);
        assert_eq!(word_count(4, &presence(|_| true)), 4 + 64);
        // A layer of one voxel cuts sixteen blocks.
        assert_eq!(word_count(1, &presence(|i| i < 64)), 4 + 4 + 2);
    }
}
