//! Bricks as blocks of texture compression: the counterpart of `nuage_volume::codec::block`, which describes
//! the layouts.
//!
//! BC4 and the alpha of BC3 are encoded here; the colours of BC3 and all of BC7 by a library: one in plain
//! Rust, or with the feature `native-encoders` the same algorithm as vector code, several times faster. What
//! does not live here: scaling values to 0..=1 and choosing a format.

use nuage_volume::codec::block::{BlockFormat, PackingAxis, voxel_offset};
use nuage_volume::space::BRICK_VOXELS;

use super::bc4;

/// How much time an encoder may take.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quality {
    /// The quickest that is not careless.
    Fast,
    /// Several times slower. What the libraries can do beyond that takes four times as long again for a fifth
    /// of a decibel.
    Best,
}

/// So many bricks go to the library at once: enough for its vectors, and few enough to stay in a cache.
const BATCH: usize = 64;

/// Encodes one brick. Values are clamped to 0..=1; NaN counts as 0.
pub fn encode_brick(
    format: BlockFormat,
    axis: PackingAxis,
    values: &[f32; BRICK_VOXELS],
    quality: Quality,
) -> Vec<u8> {
    encode_bricks(format, axis, std::slice::from_ref(values), quality)
}

/// Encodes bricks, one after the other in the result: the same bytes as each on its own.
pub fn encode_bricks(
    format: BlockFormat,
    axis: PackingAxis,
    bricks: &[[f32; BRICK_VOXELS]],
    quality: Quality,
) -> Vec<u8> {
    let mut out = Vec::with_capacity(bricks.len().saturating_mul(format.brick_bytes()));
    match format {
        BlockFormat::Bc4 => {
            for brick in bricks {
                for block in 0..32 {
                    out.extend(bc4::encode(&channel(format, axis, brick, block, 0), quality));
                }
            }
        }
        BlockFormat::Bc3 => {
            for batch in bricks.chunks(BATCH) {
                let from = out.len();
                out.extend(library::bc3(&surface(format, axis, batch)));
                let (blocks, _) = out[from..].as_chunks_mut::<16>();
                for (i, bytes) in blocks.iter_mut().enumerate() {
                    let alpha = channel(format, axis, &batch[i / 8], i % 8, 3);
                    bytes[..8].copy_from_slice(&bc4::encode(&alpha, quality));
                }
            }
        }
        BlockFormat::Bc7 => {
            for batch in bricks.chunks(BATCH) {
                out.extend(library::bc7(&surface(format, axis, batch), quality));
            }
        }
    }
    out
}

/// One channel of the texels of a block.
fn channel(
    format: BlockFormat,
    axis: PackingAxis,
    brick: &[f32; BRICK_VOXELS],
    block: usize,
    channel: usize,
) -> [f32; 16] {
    let [.., along_packing] = axis.strides();
    std::array::from_fn(|texel| {
        let value = brick[voxel_offset(format, axis, block, texel) + channel * along_packing];
        // So NaN becomes 0.
        if value > 0.0 { value.min(1.0) } else { 0.0 }
    })
}

/// The blocks of bricks with four channels side by side, as an image four texels high of bytes. A library
/// that goes through it from left to right writes them in the order of the layout.
struct Surface {
    texels: Vec<u8>,
    blocks: usize,
}

impl Surface {
    fn width(&self) -> u32 {
        self.blocks as u32 * 4
    }

    fn stride(&self) -> u32 {
        self.width() * 4
    }
}

fn surface(format: BlockFormat, axis: PackingAxis, bricks: &[[f32; BRICK_VOXELS]]) -> Surface {
    let blocks = bricks.len() * 8;
    let mut texels = vec![0; blocks * 64];
    let [.., along_packing] = axis.strides();
    for (i, brick) in bricks.iter().enumerate() {
        for block in 0..8 {
            for texel in 0..16 {
                let from = voxel_offset(format, axis, block, texel);
                let to = ((texel >> 2) * blocks * 4 + (i * 8 + block) * 4 + (texel & 3)) * 4;
                for channel in 0..4 {
                    // A cast saturates and takes NaN to 0.
                    texels[to + channel] = (brick[from + channel * along_packing] * 255.0 + 0.5) as u8;
                }
            }
        }
    }
    Surface { texels, blocks }
}

/// The library in plain Rust.
#[cfg(not(feature = "native-encoders"))]
mod library {
    use block_compression::encode::compress_rgba8;
    use block_compression::{BC7Settings, CompressionVariant};

    use super::{Quality, Surface};

    pub(super) fn bc3(surface: &Surface) -> Vec<u8> {
        compress(CompressionVariant::BC3, surface)
    }

    pub(super) fn bc7(surface: &Surface, quality: Quality) -> Vec<u8> {
        let settings = match quality {
            Quality::Fast => BC7Settings::alpha_ultrafast(),
            Quality::Best => BC7Settings::alpha_very_fast(),
        };
        compress(CompressionVariant::BC7(settings), surface)
    }

    fn compress(variant: CompressionVariant, surface: &Surface) -> Vec<u8> {
        let mut out = vec![0; surface.blocks * 16];
        compress_rgba8(variant, &surface.texels, &mut out, surface.width(), 4, surface.stride());
        out
    }
}

/// The library in vector code.
#[cfg(feature = "native-encoders")]
mod library {
    use intel_tex_2::{RgbaSurface, bc3, bc7};

    use super::{Quality, Surface};

    pub(super) fn bc3(surface: &Surface) -> Vec<u8> {
        bc3::compress_blocks(&rgba(surface))
    }

    pub(super) fn bc7(surface: &Surface, quality: Quality) -> Vec<u8> {
        let settings = match quality {
            Quality::Fast => bc7::alpha_ultra_fast_settings(),
            Quality::Best => bc7::alpha_very_fast_settings(),
        };
        bc7::compress_blocks(&settings, &rgba(surface))
    }

    fn rgba(surface: &Surface) -> RgbaSurface<'_> {
        RgbaSurface { data: &surface.texels, width: surface.width(), height: 4, stride: surface.stride() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nuage_volume::codec::block::decode_brick;
    use proptest::prelude::*;

    const FORMATS: [BlockFormat; 3] = [BlockFormat::Bc4, BlockFormat::Bc3, BlockFormat::Bc7];
    const AXES: [PackingAxis; 3] = [PackingAxis::X, PackingAxis::Y, PackingAxis::Z];
    const QUALITIES: [Quality; 2] = [Quality::Fast, Quality::Best];

    /// A wave through the brick between `low` and `high`, of less than half a period across it.
    fn smooth([x, y, z]: [f32; 3], low: f32, high: f32) -> [f32; BRICK_VOXELS] {
        std::array::from_fn(|offset| {
            let [i, j, k] = [offset >> 6, offset >> 3 & 7, offset & 7].map(|i| i as f32 / 8.0);
            low + (high - low) * (0.5 + 0.5 * (x * i + y * j + z * k).sin())
        })
    }

    /// The root of the mean squared difference after encoding and decoding, and the largest difference.
    fn errors(
        format: BlockFormat,
        axis: PackingAxis,
        values: &[f32; BRICK_VOXELS],
        quality: Quality,
    ) -> [f32; 2] {
        let bytes = encode_brick(format, axis, values, quality);
        assert_eq!(bytes.len(), format.brick_bytes());
        let mut decoded = [f32::NAN; BRICK_VOXELS];
        decode_brick(format, axis, &bytes, &mut decoded).unwrap();
        let differences = values.iter().zip(&decoded).map(|(a, b)| (a - b).abs());
        let squares: f32 = differences.clone().map(|difference| difference * difference).sum();
        [(squares / BRICK_VOXELS as f32).sqrt(), differences.fold(0.0, f32::max)]
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(24))]

        #[test]
        fn smooth_bricks_come_back(
            wave in proptest::array::uniform3(-1.5f32..1.5),
            low in 0.0f32..1.0,
            high in 0.0f32..1.0,
            axis in 0usize..3,
        ) {
            let values = smooth(wave, low, high);
            for (format, [root_mean_square, largest]) in
                FORMATS.into_iter().zip([[0.016, 0.045], [0.04, 0.11], [0.012, 0.07]])
            {
                for quality in QUALITIES {
                    let [root, worst] = errors(format, AXES[axis], &values, quality);
                    prop_assert!(root < root_mean_square, "{format:?} {quality:?}: {root}");
                    prop_assert!(worst < largest, "{format:?} {quality:?}: {worst}");
                }
            }
        }

        #[test]
        fn constant_bricks_come_back(value in 0.0f32..=1.0) {
            for (format, largest) in
                [(BlockFormat::Bc4, 0.0003), (BlockFormat::Bc3, 0.02), (BlockFormat::Bc7, 0.0041)]
            {
                let [_, worst] = errors(format, PackingAxis::Z, &[value; BRICK_VOXELS], Quality::Best);
                prop_assert!(worst <= largest, "{format:?}: {worst}");
            }
        }

        #[test]
        fn anything_can_be_encoded(seed in any::<u64>(), format in 0usize..3) {
            let mut state = seed | 1;
            let values = std::array::from_fn(|_| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                f32::from_bits((state >> 32) as u32)
            });
            let clamp = |value: f32| if value.is_nan() { 0.0 } else { value.clamp(0.0, 1.0) };
            let clamped: [f32; BRICK_VOXELS] = values.map(clamp);
            for quality in QUALITIES {
                let encode = |values| encode_brick(FORMATS[format], PackingAxis::Z, values, quality);
                prop_assert_eq!(encode(&values), encode(&clamped));
            }
        }
    }

    #[test]
    fn many_bricks_are_the_bricks_one_by_one() {
        let bricks: Vec<_> = (0..BATCH + 3).map(|i| smooth([i as f32 / 7.0, 1.0, 0.5], 0.0, 1.0)).collect();
        for format in FORMATS {
            let each = bricks.iter().map(|brick| encode_brick(format, PackingAxis::Y, brick, Quality::Fast));
            let all = encode_bricks(format, PackingAxis::Y, &bricks, Quality::Fast);
            assert_eq!(all, each.collect::<Vec<_>>().concat(), "{format:?}");
        }
        assert!(encode_bricks(BlockFormat::Bc7, PackingAxis::Y, &[], Quality::Fast).is_empty());
    }
}
