//! DDS files of a 3D texture, with the header that Direct3D 10 brought.
//!
//! Layout: "Programming Guide for DDS" of the Direct3D documentation.

use super::layout::{Layout, TextureFormat};

/// The bytes before the texels: the letters, the header and its extension.
pub const HEADER_BYTES: usize = 4 + 124 + 20;

/// Capabilities, height, width, kind of texel and depth are given.
const GIVEN: u32 = 0x1 | 0x2 | 0x4 | 0x1000 | 0x80_0000;
/// The bytes of a row are given.
const ROW_GIVEN: u32 = 0x8;
/// The bytes of a slice are given.
const SLICE_GIVEN: u32 = 0x8_0000;
/// The kind of texel is four letters.
const FOUR_LETTERS: u32 = 0x4;
/// In the capabilities: a texture, and of three axes.
const TEXTURE: u32 = 0x1000;
const VOLUME: u32 = 0x20_0000;
/// In the extension: three axes.
const DIMENSION_3D: u32 = 4;

/// The number of a kind of texel in the enumeration `DXGI_FORMAT`.
pub fn dxgi_format(format: TextureFormat) -> u32 {
    match format {
        TextureFormat::R8 => 61,
        TextureFormat::R16F => 54,
        TextureFormat::Bc3 => 77,
        TextureFormat::Bc4 => 80,
        TextureFormat::Bc7 => 98,
    }
}

/// What stands before the texels in the file of a texture.
pub fn header(layout: &Layout) -> Vec<u8> {
    let [width, height, depth] = layout.size();
    let (pitch_given, pitch) = match layout.format().block_texels() {
        1 => (ROW_GIVEN, layout.row_bytes()),
        _ => (SLICE_GIVEN, layout.slice_bytes()),
    };
    // Textures within the limit have slices of at most 2048² × 2 bytes.
    let head = [124, GIVEN | pitch_given, height, width, pitch as u32, depth, 1];
    let kind = [32, FOUR_LETTERS, u32::from_le_bytes(*b"DX10"), 0, 0, 0, 0, 0];
    let capabilities = [TEXTURE, VOLUME, 0, 0, 0];
    let extension = [dxgi_format(layout.format()), DIMENSION_3D, 0, 1, 0];
    let mut bytes = Vec::with_capacity(HEADER_BYTES);
    bytes.extend(b"DDS ");
    for words in [&head[..], &[0; 11], &kind, &capabilities, &extension] {
        words.iter().for_each(|word| bytes.extend(word.to_le_bytes()));
    }
    bytes
}
