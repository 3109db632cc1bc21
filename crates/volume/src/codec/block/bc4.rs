//! BC4 blocks, one channel of sixteen texels in eight bytes: also the alpha half of BC3.
//!
//! Two endpoints of a byte each, then sixteen indices of three bits into a palette between them.

/// The eight values that a block with these endpoints can hold.
///
/// Where the first is larger, six values lie evenly between the two; where not, four do, and the last two
/// entries are 0 and 1.
#[inline]
pub fn palette(endpoints: [u8; 2]) -> [f32; 8] {
    let [a, b] = endpoints.map(u16::from);
    if a > b {
        let mix = |to_b: u16| f32::from(a * (7 - to_b) + b * to_b) / (255.0 * 7.0);
        [mix(0), mix(7), mix(1), mix(2), mix(3), mix(4), mix(5), mix(6)]
    } else {
        let mix = |to_b: u16| f32::from(a * (5 - to_b) + b * to_b) / (255.0 * 5.0);
        [mix(0), mix(5), mix(1), mix(2), mix(3), mix(4), 0.0, 1.0]
    }
}

/// All texels of a block.
#[inline]
pub(super) fn decode(block: &[u8; 8]) -> [f32; 16] {
    let palette = palette([block[0], block[1]]);
    let indices = u64::from_le_bytes(*block) >> 16;
    std::array::from_fn(|texel| palette[(indices >> (3 * texel) & 7) as usize])
}

/// One texel of a block.
pub(super) fn texel(block: &[u8; 8], texel: usize) -> f32 {
    let index = u64::from_le_bytes(*block) >> (16 + 3 * (texel & 15)) & 7;
    palette([block[0], block[1]])[index as usize]
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn texels_are_those_of_an_independent_decoder(block in any::<[u8; 8]>()) {
            let (mut rounded, mut floats) = ([0; 16], [0.0; 16]);
            bcdec_rs::bc4(&block, &mut rounded, 4, false);
            bcdec_rs::bc4_float(&block, &mut floats, 4, false);
            for (i, value) in decode(&block).into_iter().enumerate() {
                prop_assert!((value - floats[i]).abs() < 1e-6, "{value} {}", floats[i]);
                // The other one rounds to whole steps of 255.
                prop_assert!((value * 255.0 - f32::from(rounded[i])).abs() < 0.6, "{value} {}", rounded[i]);
            }
        }
    }

    #[test]
    fn endpoints_are_met_exactly() {
        for endpoints in [[200, 100], [100, 200], [0, 255], [255, 0], [7, 7]] {
            let palette = palette(endpoints);
            assert_eq!(palette[0], f32::from(endpoints[0]) / 255.0);
            assert_eq!(palette[1], f32::from(endpoints[1]) / 255.0);
        }
    }
}
