//! Codes of the voxels that are there, in bricks that are partly empty.
//!
//! A brick is 4³ blocks of 2³ voxels. Two bits of a block say whether it has voxels at all and whether it has all of them; each block
//! that has some but not all has a mask of eight bits. The codes of the voxels follow without gaps, block by block. So an
//! empty half of a brick costs next to nothing, and where a voxel's code stands follows from counting bits.
//!
//! What is not a code is here a *symbol*: 0 for a voxel that is not there, else its code plus 1. What codes mean is
//! [`super`]'s.

use super::Line;
use crate::space::BRICK_VOXELS;

/// Codes have at most so many bits.
pub const MAX_BITS: u8 = 7;

/// The octants of a brick, which hold eight blocks each.
const OCTANTS: usize = 8;

/// What the codes of a brick are: how many bits they have, and where on the line of the brick they stand.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Coding {
    /// The most bits that the codes of any octant may have, 1 to 7.
    pub most_bits: u8,
    /// Those of each octant, 1 to `most_bits`.
    pub bits: [u8; OCTANTS],
    /// Whether the first codes stand closer together than the last.
    pub is_bent: bool,
    /// Where the codes of each octant begin and end, in fifteenths of the line; `None` if all go from its beginning to its end.
    pub ends: Option<[[u8; 2]; OCTANTS]>,
}

impl Coding {
    /// The same everywhere, and not bent.
    pub fn even(bits: u8) -> Coding {
        Coding { most_bits: bits, bits: [bits; OCTANTS], is_bent: false, ends: None }
    }

    /// Whether it is the same everywhere.
    pub fn is_even(&self) -> bool {
        self.bits == [self.most_bits; OCTANTS] && self.ends.is_none()
    }

    /// What the first word of a brick after its line says, but for ends. `None` if it is no such word.
    pub fn from_word(word: u32) -> Option<Coding> {
        let most_bits = (word & 7) as u8;
        let mut bits = [0; OCTANTS];
        for (octant, bits) in bits.iter_mut().enumerate() {
            *bits = most_bits.checked_sub((word >> (8 + 3 * octant) & 7) as u8).filter(|bits| *bits > 0)?;
        }
        let is_known = word & 0xff & !(7 | BENT | HAS_ENDS) == 0;
        is_known.then_some(Coding { most_bits, bits, is_bent: word & BENT > 0, ends: None })
    }

    /// What the words of a brick say after its line, and what follows. `None` if they are no such words.
    pub fn from_words(words: &[u32]) -> Option<(Coding, &[u32])> {
        let (&word, rest) = words.split_first()?;
        let coding = Coding::from_word(word)?;
        if word & HAS_ENDS == 0 {
            return Some((coding, rest));
        }
        let (ends, rest) = rest.split_first_chunk::<END_WORDS>()?;
        let end = |i: usize| (ends[i / 8] >> (i % 8 * 4) & 15) as u8;
        let ends = std::array::from_fn(|octant| [end(2 * octant), end(2 * octant + 1)]);
        Some((Coding { ends: Some(ends), ..coding }, rest))
    }

    /// Appends the words that say it.
    pub fn write(&self, words: &mut Vec<u32>) {
        let fewer = self.bits.iter().enumerate();
        let fewer = fewer.fold(0, |word, (i, bits)| word | u32::from(self.most_bits - bits) << (8 + 3 * i));
        let flag = |is_set: bool, flag: u32| if is_set { flag } else { 0 };
        let flags = flag(self.is_bent, BENT) | flag(self.ends.is_some(), HAS_ENDS);
        words.push(u32::from(self.most_bits) | flags | fewer);
        for ends in self.ends.iter().flat_map(|ends| ends.as_chunks::<4>().0) {
            words.push(ends.as_flattened().iter().rev().fold(0, |word, end| word << 4 | u32::from(*end)));
        }
    }

    /// The words that say it.
    pub fn word_count(&self) -> usize {
        if self.ends.is_some() { 1 + END_WORDS } else { 1 }
    }

    /// Where on the line a code of an octant stands, as a count of the steps of codes of the most bits.
    fn place(&self, octant: usize, code: u32) -> f32 {
        let last = |bits: u8| ((1_u32 << bits) - 1) as f32;
        let part = code as f32 / last(self.bits[octant]);
        let bent = if self.is_bent { Coding::bent(part) } else { part };
        let [begin, end] =
            self.ends.map_or([0.0, 1.0], |ends| ends[octant].map(|end| f32::from(end) / LAST_END));
        (begin + (end - begin) * bent) * last(self.most_bits)
    }

    /// The value of a code of an octant on a line.
    #[inline]
    pub fn value(&self, line: Line, octant: usize, code: u32) -> f32 {
        match self.is_even() && !self.is_bent {
            true => line.at(code),
            false => line.low + line.step * self.place(octant, code),
        }
    }

    /// Where bent codes stand, as a part of the way from the first to the last: the first are closer together than the last. Smoke that is
    /// thin is seen as well as what is dense and hides itself, so it should be told more exactly.
    #[inline]
    pub fn bent(part: f32) -> f32 {
        part * (BENT_START + BENT_GROWTH * part)
    }

    /// What [`Coding::bent`] makes of some part, back.
    #[inline]
    pub fn unbent(bent: f32) -> f32 {
        ((0.04 + 3.2 * bent).sqrt() - 0.2) / 1.6
    }
}

/// How fast bent codes go at first, and how much faster at the end, where they have gone all the way.
pub const BENT_START: f32 = 0.2;
/// See [`BENT_START`].
pub const BENT_GROWTH: f32 = 0.8;

/// What is added to the bits of codes in their word if they are bent.
pub const BENT: u32 = 8;
/// What is added if each octant has ends of its own.
pub const HAS_ENDS: u32 = 16;
/// The words of all ends.
const END_WORDS: usize = 2;
/// The end of the line.
pub const LAST_END: f32 = 15.0;

/// The words of the two masks of blocks.
const BLOCK_MASK_WORDS: usize = 4;

/// Blocks of a brick, and voxels of a block.
const BLOCKS: usize = 64;
const BLOCK_VOXELS: usize = 8;

/// A symbol per voxel: 0 where there is none, else its code plus 1.
pub type Symbols = [u8; BRICK_VOXELS];

/// The first voxel of a block, and from it to each of its voxels, both in the order of x, y and z.
const fn first_voxel(block: usize) -> usize {
    let (octant, block) = (block >> 3, block & 7);
    let [x, y, z] = [octant >> 1 & 2 | block >> 2, octant & 2 | block >> 1 & 1, octant << 1 & 2 | block & 1];
    x << 7 | y << 4 | z << 1
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
pub fn word_count(coding: &Coding, is_there: &Presence) -> usize {
    /// The bits of even y and z.
    const EVEN: u64 = 0x0055_0055_0055_0055;
    let (mut mixed, mut voxels) = (0, 0);
    for [low, high] in is_there.as_chunks::<2>().0 {
        // Two and two voxels along x, then z, then y.
        let (some, all) = (low | high, low & high);
        let (some, all) = (some | some >> 1, all & all >> 1);
        let (some, all) = (some | some >> 8, all & all >> 8);
        mixed += (some & !all & EVEN).count_ones() as usize;
        voxels += low.count_ones() + high.count_ones();
    }
    let code_bits = match coding.is_even() {
        true => voxels * u32::from(coding.most_bits),
        false => {
            (0..OCTANTS).map(|octant| voxels_of(is_there, octant) * u32::from(coding.bits[octant])).sum()
        }
    };
    BLOCK_MASK_WORDS + mixed.div_ceil(4) + code_bits.div_ceil(32) as usize
}

/// How many voxels of an octant are there.
fn voxels_of(is_there: &Presence, octant: usize) -> u32 {
    let [y, z] = [octant >> 1 & 1, octant & 1];
    let quadrant = 0x0f0f_0f0f << (32 * y + 4 * z);
    is_there.iter().skip(octant & 4).take(4).map(|plane| (plane & quadrant).count_ones()).sum()
}

/// Appends the words of a brick: the mask of blocks that have voxels, that of those that have all, the masks of the
/// others, and the codes.
///
/// # Panics
/// If `bits` are not 1 to 7.
pub fn pack(coding: &Coding, symbols: &Symbols, words: &mut Vec<u32>) {
    assert!(coding.bits.iter().all(|bits| (1..=MAX_BITS).contains(bits)), "{coding:?}");
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
        let bits = u32::from(coding.bits[block / OCTANTS]);
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

/// The symbols of a brick from its words, which may be followed by others. `None` if they are not all there, or `bits` are not 1 to 7.
pub fn unpack(coding: &Coding, words: &[u32]) -> Option<Symbols> {
    if !coding.bits.iter().all(|bits| (1..=MAX_BITS).contains(bits)) {
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
        let (first, bits) = (first_voxel(block), u32::from(coding.bits[block / OCTANTS]));
        for (i, step) in STEPS.iter().enumerate() {
            if mask >> i & 1 == 0 {
                continue;
            }
            if waiting_bits < bits {
                waiting |= u64::from(*codes.get(word)?) << waiting_bits;
                (word, waiting_bits) = (word + 1, waiting_bits + 32);
            }
            symbols[first + step] = (waiting as u8 & ((1 << bits) - 1)) + 1;
            (waiting, waiting_bits) = (waiting >> bits, waiting_bits - bits);
        }
    }
    Some(symbols)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::codec::octant_of;
    use proptest::prelude::*;

    fn presence(is_there: impl Fn(usize) -> bool) -> Presence {
        std::array::from_fn(|x| (0..64).fold(0, |plane, i| plane | u64::from(is_there(x << 6 | i)) << i))
    }

    proptest! {
        #[test]
        fn packed_symbols_come_back(most_bits in 1_u8..=MAX_BITS, fewer in any::<[u8; 8]>(), seed in any::<u32>(), plane in -2_i32..26) {
            let bits = fewer.map(|fewer| most_bits - fewer % most_bits);
            let coding = Coding { bits, ..Coding::even(most_bits) };
            let symbols: Symbols = std::array::from_fn(|i| {
                let random = (i as u32 ^ seed).wrapping_mul(2_654_435_761) >> 16;
                let is_there = (i >> 6) + (i >> 3 & 7) + (i & 7) < plane.max(0) as usize + (random & 1) as usize;
                if is_there { (random >> 1) as u8 % (1 << bits[octant_of(i)]) + 1 } else { 0 }
            });
            let mut words = Vec::new();
            pack(&coding, &symbols, &mut words);
            prop_assert_eq!(words.len(), word_count(&coding, &presence(|i| symbols[i] > 0)));
            prop_assert_eq!(unpack(&coding, &words), Some(symbols));
            // With less, nothing is made up.
            for len in 0..words.len() {
                prop_assert!(unpack(&coding, &words[..len]).is_none_or(|found| found == symbols));
            }
            words.push(u32::MAX);
            prop_assert_eq!(unpack(&coding, &words), Some(symbols));
        }
    }

    proptest! {
        #[test]
        fn words_say_how_codes_are(words in any::<[u32; 3]>(), known in any::<bool>()) {
            let words = if known { [words[0] & 0xff00_001f, words[1], words[2]] } else { words };
            let Some((coding, rest)) = Coding::from_words(&words) else { return Ok(()) };
            prop_assert!(coding.bits.iter().all(|bits| (1..=coding.most_bits).contains(bits)));
            prop_assert_eq!(coding.word_count() + rest.len(), words.len());
            let mut written = Vec::new();
            coding.write(&mut written);
            prop_assert_eq!(&written, &words[..coding.word_count()]);
        }
    }

    #[test]
    fn codes_go_from_one_end_to_the_other() {
        let ends = std::array::from_fn(|octant| [octant as u8, 15 - octant as u8]);
        let uneven =
            Coding { bits: [4, 3, 2, 1, 4, 3, 2, 1], is_bent: true, ends: Some(ends), ..Coding::even(4) };
        for octant in 0..8 {
            let place = |code| uneven.place(octant, code);
            assert!((place(0) - octant as f32).abs() < 1e-5);
            assert!((place((1 << uneven.bits[octant]) - 1) - (15 - octant) as f32).abs() < 1e-5);
        }
        assert_eq!((0..16).map(|code| Coding::even(4).place(7, code)).sum::<f32>(), 120.0);
        for part in [0.0, 0.1, 0.5, 1.0] {
            assert!((Coding::unbent(Coding::bent(part)) - part).abs() < 1e-6);
        }
    }

    #[test]
    fn a_half_brick_takes_half_the_codes() {
        assert_eq!(word_count(&Coding::even(4), &presence(|i| i < 256)), 4 + 32);
        assert_eq!(word_count(&Coding::even(4), &presence(|_| true)), 4 + 64);
        // A layer of one voxel cuts sixteen blocks.
        assert_eq!(word_count(&Coding::even(1), &presence(|i| i < 64)), 4 + 4 + 2);
    }
}
