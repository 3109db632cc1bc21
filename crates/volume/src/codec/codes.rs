//! Codes of 1 to 8 bits, one per voxel, packed into words without gaps: code `i` begins at bit `i × bits`, the lowest bit
//! of the first word being bit 0, and may run on into the next word. What codes mean is [`super`]'s.

use crate::space::BRICK_VOXELS;

/// The words that the codes of a brick fill.
pub fn word_count(bits: u8) -> usize {
    BRICK_VOXELS / 32 * usize::from(bits)
}

/// The code of one voxel. `words` are those of the brick; what is not there counts as 0.
pub fn code(bits: u8, words: &[u32], voxel: usize) -> u32 {
    let bit = voxel * usize::from(bits);
    let word = |i: usize| u64::from(words.get(i).copied().unwrap_or(0));
    let both = word(bit / 32) | word(bit / 32 + 1) << 32;
    (both >> (bit % 32)) as u32 & ((1 << bits) - 1)
}

/// Replaces every value by `value(itself, its code)`. Bits other than 1 to 8 change nothing.
pub fn unpack(bits: u8, words: &[u32], out: &mut [f32; BRICK_VOXELS], value: impl Fn(f32, u32) -> f32) {
    match bits {
        1 => unpack_bits::<1>(words, out, value),
        2 => unpack_bits::<2>(words, out, value),
        3 => unpack_bits::<3>(words, out, value),
        4 => unpack_bits::<4>(words, out, value),
        5 => unpack_bits::<5>(words, out, value),
        6 => unpack_bits::<6>(words, out, value),
        7 => unpack_bits::<7>(words, out, value),
        8 => unpack_bits::<8>(words, out, value),
        _ => {}
    }
}

/// `BITS` words hold 32 codes.
fn unpack_bits<const BITS: usize>(
    words: &[u32],
    out: &mut [f32; BRICK_VOXELS],
    value: impl Fn(f32, u32) -> f32,
) {
    let (groups, _) = words.as_chunks::<BITS>();
    for (words, out) in groups.iter().zip(out.as_chunks_mut::<32>().0) {
        for (i, out) in out.iter_mut().enumerate() {
            let (word, shift) = (i * BITS / 32, i * BITS % 32);
            let next = if word + 1 < BITS { words[word + 1] } else { 0 };
            let both = u64::from(words[word]) | u64::from(next) << 32;
            *out = value(*out, (both >> shift) as u32 & ((1 << BITS) - 1));
        }
    }
}

/// Appends the words of 512 codes.
///
/// # Panics
/// If `bits` is not 1 to 8.
pub fn pack(bits: u8, codes: &[u8; BRICK_VOXELS], words: &mut Vec<u32>) {
    match bits {
        1 => pack_bits::<1>(codes, words),
        2 => pack_bits::<2>(codes, words),
        3 => pack_bits::<3>(codes, words),
        4 => pack_bits::<4>(codes, words),
        5 => pack_bits::<5>(codes, words),
        6 => pack_bits::<6>(codes, words),
        7 => pack_bits::<7>(codes, words),
        8 => pack_bits::<8>(codes, words),
        _ => panic!("{bits} bits"),
    }
}

fn pack_bits<const BITS: usize>(codes: &[u8; BRICK_VOXELS], words: &mut Vec<u32>) {
    for codes in codes.as_chunks::<32>().0 {
        let mut group = [0_u32; BITS];
        for (i, code) in codes.iter().enumerate() {
            let (word, shift) = (i * BITS / 32, i * BITS % 32);
            let code = u64::from(*code) & ((1 << BITS) - 1);
            group[word] |= (code << shift) as u32;
            if shift + BITS > 32 {
                group[word + 1] |= (code >> (32 - shift)) as u32;
            }
        }
        words.extend(group);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn packed_codes_come_back(bits in 1_u8..=8, seed in any::<u32>()) {
            let codes: [u8; BRICK_VOXELS] = std::array::from_fn(|i| {
                ((i as u32 ^ seed).wrapping_mul(2_654_435_761) >> 24) as u8 & ((1_u16 << bits) - 1) as u8
            });
            let mut words = Vec::new();
            pack(bits, &codes, &mut words);
            prop_assert_eq!(words.len(), word_count(bits));
            let mut out = [0.0; BRICK_VOXELS];
            unpack(bits, &words, &mut out, |_, code| code as f32);
            for (i, expected) in codes.iter().enumerate() {
                prop_assert_eq!(out[i], f32::from(*expected));
                prop_assert_eq!(code(bits, &words, i), u32::from(*expected));
            }
        }
    }
}
