//! Bricks stored as blocks of texture compression: BC3, BC4 and BC7, which graphics hardware also decodes.
//!
//! A block is 4x4 texels of one slice of the brick. With the packing axis Z, texel (u, v) of a slice lies at
//! u = x, v = y; with Y at u = x, v = z; with X at u = y, v = z. Let p be the coordinate along the packing
//! axis.
//! - [`BlockFormat::Bc3`] and [`BlockFormat::Bc7`] have two slices; red, green, blue and alpha of a texel of
//!   slice s are the voxels at p = 4s, 4s + 1, 4s + 2 and 4s + 3.
//! - [`BlockFormat::Bc4`] has eight slices of one channel; slice s is p = s.
//!
//! Each slice is 2x2 blocks. Blocks follow each other by slice, then by v, then by u. Texel `i` of a block
//! lies at u = `i & 3`, v = `i >> 2` from the block's corner.
//!
//! Values are unsigned normalised numbers, 0 to 1; what they stand for is the caller's. What does not live
//! here: encoding.

mod bc3;
pub mod bc4;
pub mod bc7;

use crate::space::BRICK_VOXELS;

/// How a brick is compressed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum BlockFormat {
    /// One channel, 4 bits a voxel: the most precise where neighbours along the packing axis are unlike.
    Bc4,
    /// Four channels, 2 bits a voxel: three of them vary along one line per block, the fourth is free.
    Bc3,
    /// Four channels, 2 bits a voxel, in eight modes that an encoder chooses from: better than BC3, slower to
    /// make.
    Bc7,
}

impl BlockFormat {
    /// The bytes of a compressed brick.
    pub fn brick_bytes(self) -> usize {
        self.block_bytes() * self.slices() * 4
    }

    /// The bytes of a block.
    pub fn block_bytes(self) -> usize {
        match self {
            BlockFormat::Bc4 => 8,
            BlockFormat::Bc3 | BlockFormat::Bc7 => 16,
        }
    }

    /// The channels of a texel: as many voxels along the packing axis.
    pub fn channels(self) -> usize {
        8 / self.slices()
    }

    /// The slices of a brick.
    pub fn slices(self) -> usize {
        match self {
            BlockFormat::Bc4 => 8,
            BlockFormat::Bc3 | BlockFormat::Bc7 => 2,
        }
    }
}

/// The axis along which a brick is cut into slices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub enum PackingAxis {
    /// Slices of constant x.
    X,
    /// Slices of constant y.
    Y,
    /// Slices of constant z.
    Z,
}

impl PackingAxis {
    /// The steps in voxel offset along u, v and the packing axis.
    pub fn strides(self) -> [usize; 3] {
        match self {
            PackingAxis::X => [8, 1, 64],
            PackingAxis::Y => [64, 1, 8],
            PackingAxis::Z => [64, 8, 1],
        }
    }
}

/// The voxel offset of the first channel of a texel of a block. The next channels are the packing axis'
/// stride apart.
///
/// `block` counts the blocks of a brick, `texel` the sixteen texels of a block; more than there are counts as
/// the last.
#[inline]
pub fn voxel_offset(format: BlockFormat, axis: PackingAxis, block: usize, texel: usize) -> usize {
    let (block, texel) = (block.min(format.slices() * 4 - 1), texel.min(15));
    let [along_u, along_v, along_packing] = axis.strides();
    let u = (block & 1) << 2 | texel & 3;
    let v = (block & 2) << 1 | texel >> 2;
    u * along_u + v * along_v + (block >> 2) * format.channels() * along_packing
}

/// Decodes a brick. `None` if there are fewer than [`BlockFormat::brick_bytes`]; more are left alone.
///
/// The values, all in f32:
/// - BC4 and the alpha of BC3: with the endpoints a and b as integers, (w₀a + w₁b) / (255 · 7) where a > b;
///   where not, (w₀a + w₁b) / (255 · 5), or 0, or 1. The sum is exact, the division rounds once.
/// - The colours of BC3: endpoints of 5 and 6 bits become 8 by repeating their high bits; then a / 255, b /
///   255, (2a + b) / 765 or (a + 2b) / 765. The order of the endpoints does not matter.
/// - BC7: the integers 0 to 255 that the format prescribes, divided by 255. A block of the reserved mode is
///   0.
///
/// Formats: Khronos Data Format Specification 1.3, sections "S3TC", "RGTC" and "BPTC".
pub fn decode_brick(
    format: BlockFormat,
    axis: PackingAxis,
    bytes: &[u8],
    out: &mut [f32; BRICK_VOXELS],
) -> Option<()> {
    let bytes = bytes.get(..format.brick_bytes())?;
    match format {
        BlockFormat::Bc4 => {
            scatter(format, axis, bytes, out, |block| bc4::decode(block).map(|value| [value]))
        }
        BlockFormat::Bc3 => scatter(format, axis, bytes, out, bc3::decode),
        BlockFormat::Bc7 => scatter(format, axis, bytes, out, bc7::decode),
    }
    Some(())
}

/// Decodes block after block and puts the texels' channels where they belong.
#[inline]
fn scatter<const BLOCK_BYTES: usize, const CHANNELS: usize>(
    format: BlockFormat,
    axis: PackingAxis,
    bytes: &[u8],
    out: &mut [f32; BRICK_VOXELS],
    decode: impl Fn(&[u8; BLOCK_BYTES]) -> [[f32; CHANNELS]; 16],
) {
    let [.., along_packing] = axis.strides();
    let (blocks, _) = bytes.as_chunks();
    for (at, block) in blocks.iter().enumerate() {
        for (i, texel) in decode(block).iter().enumerate() {
            let first = voxel_offset(format, axis, at, i);
            for (channel, value) in texel.iter().enumerate() {
                // The mask changes nothing: it shows the compiler that the offset is inside.
                out[(first + channel * along_packing) & (BRICK_VOXELS - 1)] = *value;
            }
        }
    }
}

/// One voxel of a brick: what [`decode_brick`] puts at that offset, decoding no more than its block. Offsets
/// count modulo 512; a block that is not there is 0.
pub fn value(format: BlockFormat, axis: PackingAxis, bytes: &[u8], offset: usize) -> f32 {
    let [u, v, p] = axis.strides().map(|stride| (offset / stride) & 7);
    let (slice, channel) = (p / format.channels(), p % format.channels());
    let block = slice << 2 | (v >> 2) << 1 | u >> 2;
    let texel = (v & 3) << 2 | u & 3;
    let bytes = bytes.get(block * format.block_bytes()..).unwrap_or_default();
    let value = match format {
        BlockFormat::Bc4 => bytes.first_chunk().map(|block| bc4::texel(block, texel)),
        BlockFormat::Bc3 => bytes.first_chunk().map(|block| bc3::value(block, texel, channel)),
        BlockFormat::Bc7 => bytes.first_chunk().map(|block| bc7::value(block, texel, channel)),
    };
    value.unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const FORMATS: [BlockFormat; 3] = [BlockFormat::Bc4, BlockFormat::Bc3, BlockFormat::Bc7];
    const AXES: [PackingAxis; 3] = [PackingAxis::X, PackingAxis::Y, PackingAxis::Z];

    /// 256 bytes, the first of each sixteen such that all modes of BC7 occur.
    fn bytes() -> impl Strategy<Value = Vec<u8>> {
        let block = (proptest::array::uniform16(any::<u8>()), 0u32..=8).prop_map(|(mut block, mode)| {
            block[0] = ((u32::from(block[0]) | 1) << mode) as u8;
            block
        });
        proptest::collection::vec(block, 16).prop_map(|blocks| blocks.concat())
    }

    proptest! {
        #[test]
        fn a_single_value_is_that_of_the_brick(bytes in bytes(), format in 0usize..3, axis in 0usize..3) {
            let (format, axis) = (FORMATS[format], AXES[axis]);
            let mut brick = [f32::NAN; BRICK_VOXELS];
            prop_assert_eq!(decode_brick(format, axis, &bytes, &mut brick), Some(()));
            for (offset, expected) in brick.iter().enumerate() {
                prop_assert!((0.0..=1.0).contains(expected));
                prop_assert_eq!(value(format, axis, &bytes, offset), *expected);
            }
        }

        #[test]
        fn axes_are_permutations(bytes in bytes(), format in 0usize..3) {
            let format = FORMATS[format];
            let [x, y, z] = AXES.map(|axis| {
                let mut brick = [f32::NAN; BRICK_VOXELS];
                decode_brick(format, axis, &bytes, &mut brick);
                brick
            });
            for offset in 0..BRICK_VOXELS {
                let [u, v, p] = [offset >> 6, offset >> 3 & 7, offset & 7];
                prop_assert_eq!(z[u << 6 | v << 3 | p], x[p << 6 | u << 3 | v]);
                prop_assert_eq!(z[u << 6 | v << 3 | p], y[u << 6 | p << 3 | v]);
            }
        }

        #[test]
        fn too_few_bytes_are_none(length in 0usize..256, offset in 0usize..2000) {
            let bytes = vec![0xff; length];
            for format in FORMATS {
                let mut brick = [2.0; BRICK_VOXELS];
                let expected = (length >= format.brick_bytes()).then_some(());
                prop_assert_eq!(decode_brick(format, PackingAxis::Z, &bytes, &mut brick), expected);
                prop_assert!(value(format, PackingAxis::Z, &bytes, offset) <= 1.0);
            }
        }

        #[test]
        fn blocks_lie_where_an_independent_decoder_puts_them(bytes in bytes()) {
            // Slices as images of 8x8 texels: the other decoder places blocks by the pitch of an image.
            let mut brick = [f32::NAN; BRICK_VOXELS];
            decode_brick(BlockFormat::Bc7, PackingAxis::Z, &bytes, &mut brick);
            for slice in 0..2 {
                let mut image = [0; 8 * 8 * 4];
                for block in 0..4 {
                    let corner = (block >> 1) * 4 * 32 + (block & 1) * 16;
                    bcdec_rs::bc7(&bytes[(slice * 4 + block) * 16..][..16], &mut image[corner..], 32);
                }
                for (i, expected) in image.iter().enumerate() {
                    let [x, y, z] = [i / 4 % 8, i / 32, slice * 4 + i % 4];
                    prop_assert_eq!(brick[x << 6 | y << 3 | z], f32::from(*expected) / 255.0);
                }
            }
        }
    }

    #[test]
    fn offsets_of_texels_are_each_taken_once() {
        for (format, axis) in FORMATS.into_iter().flat_map(|format| AXES.map(|axis| (format, axis))) {
            let mut taken = [false; BRICK_VOXELS];
            for at in 0..format.slices() * 4 * 16 {
                for channel in 0..format.channels() {
                    let offset = voxel_offset(format, axis, at / 16, at % 16) + channel * axis.strides()[2];
                    assert!(!std::mem::replace(&mut taken[offset], true));
                }
            }
            assert!(taken.iter().all(|taken| *taken));
        }
    }
}
