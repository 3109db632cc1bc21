//! BC7 blocks, four channels of sixteen texels in sixteen bytes.
//!
//! A block states one of eight modes, which says how its 128 bits are shared out: into how many subsets the
//! texels fall, how precise the two endpoints of each subset are, and how finely indices divide the way
//! between them. The tables are those of the Khronos Data Format Specification 1.3, section "BPTC".

/// How a mode shares out its bits; all fields but the first count bits.
pub struct Mode {
    /// How many subsets there are.
    pub subsets: usize,
    /// The number of the partition.
    pub partition: u32,
    /// Which channel changes places with alpha.
    pub rotation: u32,
    /// Which indices are the colours'.
    pub selection: u32,
    /// Each colour of an endpoint.
    pub colour: u32,
    /// The alpha of an endpoint.
    pub alpha: u32,
    /// Of each endpoint, below its channels.
    pub endpoint_low: u32,
    /// Of each subset, below the channels of both its endpoints.
    pub shared_low: u32,
    /// Each index.
    pub index: u32,
    /// Each second index.
    pub second_index: u32,
}

impl Mode {
    #[rustfmt::skip]
    const fn of(
        [
            subsets, partition, rotation, selection, colour, alpha, endpoint_low, shared_low, index,
            second_index,
        ]: [u32; 10],
    ) -> Mode {
        let subsets = subsets as usize;
        Mode {
            subsets, partition, rotation, selection, colour, alpha, endpoint_low, shared_low, index,
            second_index,
        }
    }
}

/// The modes of blocks.
pub const MODES: [Mode; 8] = [
    Mode::of([3, 4, 0, 0, 4, 0, 1, 0, 3, 0]),
    Mode::of([2, 6, 0, 0, 6, 0, 0, 1, 3, 0]),
    Mode::of([3, 6, 0, 0, 5, 0, 0, 0, 2, 0]),
    Mode::of([2, 6, 0, 0, 7, 0, 1, 0, 2, 0]),
    Mode::of([1, 0, 2, 1, 5, 6, 0, 0, 2, 3]),
    Mode::of([1, 0, 2, 0, 7, 8, 0, 0, 2, 2]),
    Mode::of([1, 0, 0, 0, 7, 7, 1, 0, 4, 0]),
    Mode::of([2, 6, 0, 0, 5, 5, 1, 0, 2, 0]),
];

/// How far the texels of each index lie on the way between the endpoints, in 64ths.
pub const WEIGHTS_2: [u8; 4] = [0, 21, 43, 64];
/// The same for indices of three bits.
pub const WEIGHTS_3: [u8; 8] = [0, 9, 18, 27, 37, 46, 55, 64];
/// The same for indices of four bits.
pub const WEIGHTS_4: [u8; 16] = [0, 4, 9, 13, 17, 21, 26, 30, 34, 38, 43, 47, 51, 55, 60, 64];

/// The partitions into two subsets: bit `i` is the subset of texel `i`.
#[rustfmt::skip]
pub const TWO_SUBSETS: [u16; 64] = [
    0xcccc, 0x8888, 0xeeee, 0xecc8, 0xc880, 0xfeec, 0xfec8, 0xec80,
    0xc800, 0xffec, 0xfe80, 0xe800, 0xffe8, 0xff00, 0xfff0, 0xf000,
    0xf710, 0x008e, 0x7100, 0x08ce, 0x008c, 0x7310, 0x3100, 0x8cce,
    0x088c, 0x3110, 0x6666, 0x366c, 0x17e8, 0x0ff0, 0x718e, 0x399c,
    0xaaaa, 0xf0f0, 0x5a5a, 0x33cc, 0x3c3c, 0x55aa, 0x9696, 0xa55a,
    0x73ce, 0x13c8, 0x324c, 0x3bdc, 0x6996, 0xc33c, 0x9966, 0x0660,
    0x0272, 0x04e4, 0x4e40, 0x2720, 0xc936, 0x936c, 0x39c6, 0x639c,
    0x9336, 0x9cc6, 0x817e, 0xe718, 0xccf0, 0x0fcc, 0x7744, 0xee22,
];

/// The partitions into three subsets: bits `2i` and `2i + 1` are the subset of texel `i`.
#[rustfmt::skip]
pub const THREE_SUBSETS: [u32; 64] = [
    0xaa68_5050, 0x6a5a_5040, 0x5a5a_4200, 0x5450_a0a8, 0xa5a5_0000, 0xa0a0_5050, 0x5555_a0a0, 0x5a5a_5050,
    0xaa55_0000, 0xaa55_5500, 0xaaaa_5500, 0x9090_9090, 0x9494_9494, 0xa4a4_a4a4, 0xa9a5_9450, 0x2a0a_4250,
    0xa594_5040, 0x0a42_5054, 0xa5a5_a500, 0x55a0_a0a0, 0xa8a8_5454, 0x6a6a_4040, 0xa4a4_5000, 0x1a1a_0500,
    0x0050_a4a4, 0xaaa5_9090, 0x1469_6914, 0x6969_1400, 0xa085_85a0, 0xaa82_1414, 0x50a4_a450, 0x6a5a_0200,
    0xa9a5_8000, 0x5090_a0a8, 0xa8a0_9050, 0x2424_2424, 0x00aa_5500, 0x2492_4924, 0x2449_9224, 0x50a5_0a50,
    0x500a_a550, 0xaaaa_4444, 0x6666_0000, 0xa5a0_a5a0, 0x50a0_50a0, 0x6928_6928, 0x44aa_aa44, 0x6666_6600,
    0xaa44_4444, 0x54a8_54a8, 0x9580_9580, 0x9696_9600, 0xa854_54a8, 0x8095_9580, 0xaa14_1414, 0x9696_0000,
    0xaaaa_1414, 0xa050_50a0, 0xa0a5_a5a0, 0x9600_0000, 0x4080_4080, 0xa9a8_a9a8, 0xaaaa_aa44, 0x2a4a_5254,
];

/// The texel of the second of two subsets whose index has one bit less.
#[rustfmt::skip]
pub const TWO_ANCHOR: [u8; 64] = [
    15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15,
    15, 2, 8, 2, 2, 8, 8, 15, 2, 8, 2, 2, 8, 8, 2, 2,
    15, 15, 6, 8, 2, 8, 15, 15, 2, 8, 2, 2, 2, 15, 15, 6,
    6, 2, 6, 8, 15, 15, 2, 2, 15, 15, 15, 15, 15, 2, 2, 15,
];

/// The same for the second of three subsets.
#[rustfmt::skip]
pub const THREE_SECOND_ANCHOR: [u8; 64] = [
    3, 3, 15, 15, 8, 3, 15, 15, 8, 8, 6, 6, 6, 5, 3, 3,
    3, 3, 8, 15, 3, 3, 6, 10, 5, 8, 8, 6, 8, 5, 15, 15,
    8, 15, 3, 5, 6, 10, 8, 15, 15, 3, 15, 5, 15, 15, 15, 15,
    3, 15, 5, 5, 5, 8, 5, 10, 5, 10, 8, 13, 15, 12, 3, 3,
];

/// The same for the third of three subsets.
#[rustfmt::skip]
pub const THREE_THIRD_ANCHOR: [u8; 64] = [
    15, 8, 8, 3, 15, 15, 3, 8, 15, 15, 15, 15, 15, 15, 15, 8,
    15, 8, 15, 3, 15, 8, 15, 8, 3, 15, 6, 10, 15, 15, 10, 8,
    15, 3, 15, 10, 10, 8, 9, 10, 6, 15, 8, 15, 3, 6, 6, 8,
    15, 3, 15, 15, 15, 15, 15, 15, 15, 15, 15, 15, 3, 15, 15, 8,
];

/// A block taken apart, but for its indices.
struct Parsed {
    mode: &'static Mode,
    /// The first and second endpoint of each subset, as 8 bits a channel.
    endpoints: [[[u8; 4]; 2]; 3],
    /// The subset of texel `i` in bits `2i` and `2i + 1`.
    subsets: u32,
    /// Bit `i` is set where the index of texel `i` has one bit less: once in each subset.
    anchors: u16,
    /// The channel that changes places with alpha; alpha itself if none does.
    swapped: usize,
    /// Whether colours go by the second indices and alpha by the first.
    is_exchanged: bool,
    first_indices: u128,
    second_indices: u128,
}

/// Takes bits from the low end.
#[inline]
fn take(bits: &mut u128, count: u32) -> u32 {
    let taken = *bits as u32 & ((1 << count) - 1);
    *bits >>= count;
    taken
}

/// A number of 5 to 8 bits as 8: the high bits are repeated below.
#[inline]
fn expand(number: u32, bits: u32) -> u8 {
    (number << (8 - bits) | number >> (2 * bits - 8)) as u8
}

/// The weight of the second endpoint for a texel's index, which lies behind those of the texels before it.
#[inline]
fn weight(indices: u128, bits: u32, anchors: u16, texel: usize) -> u16 {
    let shorter_before = (anchors & ((1 << texel) - 1)).count_ones();
    let length = bits - u32::from(anchors >> texel & 1);
    let index = (indices >> (bits * texel as u32 - shorter_before)) as usize & ((1 << length) - 1);
    u16::from(match bits {
        2 => WEIGHTS_2[index & 3],
        3 => WEIGHTS_3[index & 7],
        _ => WEIGHTS_4[index & 15],
    })
}

impl Parsed {
    /// `None` for the reserved mode.
    #[inline]
    fn of(block: &[u8; 16]) -> Option<Parsed> {
        let mut bits = u128::from_le_bytes(*block);
        let number = bits.trailing_zeros();
        let mode = MODES.get(number as usize)?;
        take(&mut bits, number + 1);
        // At most six bits, and the tables have 64 entries.
        let partition = take(&mut bits, mode.partition) as usize & 63;
        let rotation = take(&mut bits, mode.rotation);
        let is_exchanged = take(&mut bits, mode.selection) == 1;

        let mut stored = [[[0; 4]; 2]; 3];
        let stored = &mut stored[..mode.subsets];
        for channel in 0..4 {
            let count = if channel < 3 { mode.colour } else { mode.alpha };
            for endpoint in stored.iter_mut().flatten() {
                endpoint[channel] = take(&mut bits, count);
            }
        }
        let low = mode.endpoint_low + mode.shared_low;
        let mut endpoints = [[[255; 4]; 2]; 3];
        for (subset, stored) in endpoints.iter_mut().zip(stored) {
            let shared = take(&mut bits, mode.shared_low);
            for (endpoint, stored) in subset.iter_mut().zip(stored) {
                let lowest = shared | take(&mut bits, mode.endpoint_low);
                for channel in 0..3 {
                    endpoint[channel] = expand(stored[channel] << low | lowest, mode.colour + low);
                }
                if mode.alpha > 0 {
                    endpoint[3] = expand(stored[3] << low | lowest, mode.alpha + low);
                }
            }
        }

        let (subsets, anchors) = match mode.subsets {
            1 => (0, 1),
            2 => (spread(TWO_SUBSETS[partition]), 1 | 1 << TWO_ANCHOR[partition]),
            _ => {
                let anchors = 1 << THREE_SECOND_ANCHOR[partition] | 1 << THREE_THIRD_ANCHOR[partition];
                (THREE_SUBSETS[partition], 1 | anchors)
            }
        };
        Some(Parsed {
            mode,
            endpoints,
            subsets,
            anchors,
            swapped: rotation.checked_sub(1).unwrap_or(3) as usize,
            is_exchanged,
            first_indices: bits,
            // Only modes of one subset, with one short index, have these.
            second_indices: bits >> (mode.index * 16 - 1),
        })
    }

    /// Red, green, blue and alpha of a texel, which must be below 16.
    #[inline]
    fn texel(&self, texel: usize) -> [u8; 4] {
        let mut weights = [weight(self.first_indices, self.mode.index, self.anchors, texel); 2];
        if self.mode.second_index > 0 {
            weights[1] = weight(self.second_indices, self.mode.second_index, self.anchors, texel);
        }
        if self.is_exchanged {
            weights.reverse();
        }
        let subset = (self.subsets >> (2 * texel) & 3) as usize;
        let [a, b] = self.endpoints[subset.min(2)];
        let mut channels = std::array::from_fn(|channel| {
            let weight = weights[usize::from(channel == 3)];
            ((u16::from(a[channel]) * (64 - weight) + u16::from(b[channel]) * weight + 32) >> 6) as u8
        });
        channels.swap(self.swapped, 3);
        channels
    }
}

/// Each bit moved to twice its place.
#[inline]
fn spread(bits: u16) -> u32 {
    let mut spread = u32::from(bits);
    for (shift, mask) in [(8, 0x00ff_00ff), (4, 0x0f0f_0f0f), (2, 0x3333_3333), (1, 0x5555_5555)] {
        spread = (spread | spread << shift) & mask;
    }
    spread
}

/// All texels of a block; 0 if its mode is the reserved one.
pub(super) fn decode(block: &[u8; 16]) -> [[f32; 4]; 16] {
    match Parsed::of(block) {
        Some(parsed) => {
            std::array::from_fn(|texel| parsed.texel(texel).map(|value| f32::from(value) / 255.0))
        }
        None => [[0.0; 4]; 16],
    }
}

/// One channel of one texel of a block.
pub(super) fn value(block: &[u8; 16], texel: usize, channel: usize) -> f32 {
    let texel = Parsed::of(block).map_or([0; 4], |parsed| parsed.texel(texel & 15));
    f32::from(texel[channel & 3]) / 255.0
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn assert_same(block: &[u8; 16]) {
        let mut expected = [0; 64];
        bcdec_rs::bc7(block, &mut expected, 16);
        let texels: Vec<f32> = decode(block).into_iter().flatten().collect();
        let expected = expected.map(|value| f32::from(value) / 255.0);
        assert_eq!(texels, expected, "{block:?}");
    }

    proptest! {
        #[test]
        fn texels_are_those_of_an_independent_decoder(block in any::<[u8; 16]>()) {
            for mode in 0..=8 {
                let mut block = block;
                block[0] = ((u32::from(block[0]) | 1) << mode) as u8;
                assert_same(&block);
            }
        }
    }

    #[test]
    fn every_partition_is_that_of_an_independent_decoder() {
        for mode in 0..8 {
            for partition in 0..64u128 {
                for filler in [0x9e37_79b9_7f4a_7c15_f39c_c060_5ced_c834u128, u128::MAX / 3] {
                    assert_same(&(filler << 14 | partition << (mode + 1) | 1 << mode).to_le_bytes());
                }
            }
        }
    }

    #[test]
    fn the_modes_use_all_128_bits() {
        for (number, mode) in MODES.iter().enumerate() {
            let subsets = mode.subsets as u32;
            let endpoints = 2 * subsets * (3 * mode.colour + mode.alpha + mode.endpoint_low);
            let indices = 16 * mode.index - subsets + (16 * mode.second_index).saturating_sub(1);
            let head = number as u32 + 1 + mode.partition + mode.rotation + mode.selection;
            assert_eq!(head + endpoints + subsets * mode.shared_low + indices, 128, "mode {number}");
        }
    }
}
