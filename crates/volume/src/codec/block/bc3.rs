//! BC3 blocks, four channels of sixteen texels in sixteen bytes.
//!
//! First alpha, a BC4 block; then two colours of 5, 6 and 5 bits and sixteen indices of two bits into the
//! four colours on the line between them.

use super::bc4;

/// The four colours of the colour half.
#[inline]
fn palette(half: &[u8; 8]) -> [[f32; 3]; 4] {
    let ends =
        [expand(u16::from_le_bytes([half[0], half[1]])), expand(u16::from_le_bytes([half[2], half[3]]))];
    [[3, 0], [0, 3], [2, 1], [1, 2]].map(|[of_a, of_b]: [u16; 2]| {
        std::array::from_fn(|channel| {
            f32::from(of_a * ends[0][channel] + of_b * ends[1][channel]) / (255.0 * 3.0)
        })
    })
}

/// Red, green and blue of 5, 6 and 5 bits as 8 bits each: the high bits are repeated below.
#[inline]
fn expand(colour: u16) -> [u16; 3] {
    let [red, green, blue] = [colour >> 11, colour >> 5 & 63, colour & 31];
    [red << 3 | red >> 2, green << 2 | green >> 4, blue << 3 | blue >> 2]
}

/// The alpha half and the colour half.
#[inline]
fn halves(block: &[u8; 16]) -> [[u8; 8]; 2] {
    [0, 8].map(|from| std::array::from_fn(|i| block[from + i]))
}

/// All texels of a block.
#[inline]
pub(super) fn decode(block: &[u8; 16]) -> [[f32; 4]; 16] {
    let [alpha, colour] = halves(block);
    let (alphas, palette) = (bc4::decode(&alpha), palette(&colour));
    std::array::from_fn(|texel| {
        let [red, green, blue] = palette[index(&colour, texel)];
        [red, green, blue, alphas[texel]]
    })
}

/// One channel of one texel of a block.
pub(super) fn value(block: &[u8; 16], texel: usize, channel: usize) -> f32 {
    let [alpha, colour] = halves(block);
    match palette(&colour)[index(&colour, texel)].get(channel) {
        Some(value) => *value,
        None => bc4::texel(&alpha, texel),
    }
}

/// The entry of the palette that a texel has.
#[inline]
fn index(half: &[u8; 8], texel: usize) -> usize {
    (u64::from_le_bytes(*half) >> (32 + 2 * (texel & 15)) & 3) as usize
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn texels_are_those_of_an_independent_decoder(block in any::<[u8; 16]>()) {
            let mut expected = [0; 64];
            bcdec_rs::bc3(&block, &mut expected, 16);
            for (i, value) in decode(&block).into_iter().flatten().enumerate() {
                // In steps of 255: the other one cuts alpha off, expands colours by rounding and rounds them.
                let tolerance = if i % 4 == 3 { 0.999 } else { 1.001 };
                let difference = value * 255.0 - f32::from(expected[i]);
                prop_assert!(difference.abs() < tolerance, "{i}: {value} {}", expected[i]);
            }
        }
    }
}
