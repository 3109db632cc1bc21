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

/// What is added to the bits of codes, where these are told, if codes are bent.
pub const BENT: u32 = 8;

/// The bits of codes and whether these are bent, from the word that tells both. `None` if it is none of these.
pub fn code_bits(word: u32) -> Option<(u8, bool)> {
    let bits = word & !BENT;
    (1..=u32::from(MAX_BITS)).contains(&bits).then_some((bits as u8, bits != word))
}

/// Where on its line a bent code stands: with the first codes closer together than the last. Smoke that is thin is seen as
/// well as what is dense and hides itself, so it should be told more exactly.
pub fn bend(bits: u8, code: u32) -> f32 {
    let (code, last) = (code as f32, ((1_u32 << bits) - 1) as f32);
    code * (0.2 + 0.8 * code / last)
}

/// The words of the two masks of blocks.
const BLOCK_MASK_WORDS: usize = 4;

/// Blocks of a brick, and voxels of a block.
const BLOCKS: usize = 64;
const BLOCK_VOXELS: usize = 8;

/// A symbol per voxel: 0 where there is none, else its code plus 1.
pub type Symbols = [u8; BRICK_VOXELS];

/// The first voxel of a block, and from it to each of its voxels, both in the order of x, y and z.
const fn first_voxel(block: usize) -> usize {
    (block >> 4) << 7 | (block >> 2 & 3) << 4 | (block & 3) << 1
}
const STEPS: [usize; BLOCK_VOXELS] = [0, 1, 8, 9, 64, 65, 72, 73];

/// The symbols of a block's voxels.
fn of_block(symbols: &Symbols, block: usize) -> [u8; BLOCK_VOXELS] {
    let first = first_voxel(block);
    STEPS.map(|step| symbols[first + step])
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
    let bits = u32::from(bits);
    let (mut some, mut all) = (0_u64, 0_u64);
    let (mut masks, mut mixed) = ([0_u8; BLOCKS], 0);
    let (mut codes, mut count) = ([0_u32; BRICK_VOXELS * MAX_BITS as usize / 32 + 1], 0);
    let (mut waiting, mut waiting_bits) = (0_u64, 0);
    for block in 0..BLOCKS {
        let symbols = of_block(symbols, block);
        if symbols == [0; BLOCK_VOXELS] {
            continue;
        }
        let mask = (0..BLOCK_VOXELS).fold(0, |mask, i| mask | u8::from(symbols[i] > 0) << i);
        some |= 1 << block;
        if mask == 0xff {
            all |= 1 << block;
        } else {
            masks[mixed] = mask;
            mixed += 1;
        }
        for symbol in symbols {
            // A voxel that is not there adds nothing and takes no bits.
            let is_there = u32::from(symbol > 0);
            waiting |= u64::from(symbol.saturating_sub(1)) << waiting_bits;
            waiting_bits += bits * is_there;
            if waiting_bits >= 32 {
                codes[count] = waiting as u32;
                count += 1;
                (waiting, waiting_bits) = (waiting >> 32, waiting_bits - 32);
            }
        }
    }
    codes[count] = waiting as u32;
    count += usize::from(waiting_bits > 0);
    words.extend([some, all].iter().flat_map(|set| [*set as u32, (set >> 32) as u32]));
    let masks = masks[..mixed.next_multiple_of(4)].as_chunks::<4>().0;
    words.extend(masks.iter().map(|masks| u32::from_le_bytes(*masks)));
    words.extend_from_slice(&codes[..count]);
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
    for block in 0..BLOCKS {
        let mask = match (all >> block & 1, some >> block & 1) {
            (1, _) => 0xff,
            (_, 0) => continue,
            _ => {
                mixed += 1;
                masks[(mixed - 1) / 4] >> ((mixed - 1) % 4 * 8) & 0xff
            }
        };
        let first = first_voxel(block);
        for (i, step) in STEPS.iter().enumerate() {
            if mask >> i & 1 == 0 {
                continue;
            }
            if waiting_bits < u32::from(bits) {
                waiting |= u64::from(*codes.get(word)?) << waiting_bits;
                (word, waiting_bits) = (word + 1, waiting_bits + 32);
            }
            symbols[first + step] = (waiting as u8 & ((1 << bits) - 1)) + 1;
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
