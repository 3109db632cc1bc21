//! KTX2 files of a 3D texture: one level, no supercompression.
//!
//! Layout: Khronos, "KTX File Format Specification" 2.0; the descriptor of the texels: "Khronos Data Format
//! Specification" 1.3, section "Basic descriptor".

use super::layout::{Layout, TextureFormat};

const IDENTIFIER: [u8; 12] = *b"\xabKTX 20\xbb\r\n\x1a\n";
/// The identifier, the header, the index of sections and that of the one level.
const FIXED_BYTES: u32 = 12 + 36 + 32 + 24;
const WRITER: &str = concat!("nuage ", env!("CARGO_PKG_VERSION"));

/// The number of a kind of texel in the enumeration `VkFormat`.
pub fn vk_format(format: TextureFormat) -> u32 {
    match format {
        TextureFormat::R8 => 9,
        TextureFormat::R16F => 76,
        TextureFormat::Bc3 => 137,
        TextureFormat::Bc4 => 139,
        TextureFormat::Bc7 => 145,
    }
}

/// What stands before the texels in the file of a texture.
pub fn header(layout: &Layout) -> Vec<u8> {
    let descriptor = descriptor(layout.format());
    let writer = entry("KTXwriter", WRITER);
    let descriptor_bytes = descriptor.len() as u32;
    let writer_at = FIXED_BYTES + descriptor_bytes;
    let writer_bytes = writer.len() as u32;
    // Texels begin at a multiple of a block and of four bytes; all sizes are powers of two.
    let texels_at = (writer_at + writer_bytes).next_multiple_of(layout.format().block_bytes().max(4));
    let component_bytes = if layout.format() == TextureFormat::R16F { 2 } else { 1 };
    let [width, height, depth] = layout.size();
    // No layers, one face, one level, no supercompression.
    let header = [vk_format(layout.format()), component_bytes, width, height, depth, 0, 1, 1, 0];
    // No global data.
    let sections = [FIXED_BYTES, descriptor_bytes, writer_at, writer_bytes, 0, 0, 0, 0];
    let mut bytes = Vec::with_capacity(texels_at as usize);
    bytes.extend(IDENTIFIER);
    header.iter().chain(&sections).for_each(|word| bytes.extend(word.to_le_bytes()));
    for number in [u64::from(texels_at), layout.size_bytes(), layout.size_bytes()] {
        bytes.extend(number.to_le_bytes());
    }
    bytes.extend(descriptor);
    bytes.extend(writer);
    bytes.resize(texels_at as usize, 0);
    bytes
}

/// A key and its value, both ended by a zero, filled up to whole words.
fn entry(key: &str, value: &str) -> Vec<u8> {
    let length = (key.len() + value.len() + 2) as u32;
    let mut bytes = length.to_le_bytes().to_vec();
    for text in [key, value] {
        bytes.extend(text.bytes());
        bytes.push(0);
    }
    bytes.resize(bytes.len().next_multiple_of(4), 0);
    bytes
}

/// A run of bits in a texel or block: first bit, count, channel and its qualifiers, the numbers for the lower and the
/// upper end of the range.
type Sample = (u16, u8, u8, u32, u32);

/// The section that describes the texels: its length and one basic descriptor.
fn descriptor(format: TextureFormat) -> Vec<u8> {
    const RED_GREEN_BLUE: u8 = 1;
    const LINEAR: u8 = 1;
    const PRIMARIES_UNSPECIFIED: u8 = 0;
    const VERSION: u16 = 2;
    const SIGNED_FLOAT: u8 = 0x40 | 0x80;
    const ALPHA: u8 = 15;
    let all = u32::MAX;
    let (model, samples): (u8, &[Sample]) = match format {
        TextureFormat::R8 => (RED_GREEN_BLUE, &[(0, 8, 0, 0, 255)]),
        TextureFormat::R16F => {
            (RED_GREEN_BLUE, &[(0, 16, SIGNED_FLOAT, (-1.0_f32).to_bits(), 1.0_f32.to_bits())])
        }
        TextureFormat::Bc3 => (130, &[(0, 64, ALPHA, 0, all), (64, 64, 0, 0, all)]),
        TextureFormat::Bc4 => (131, &[(0, 64, 0, 0, all)]),
        TextureFormat::Bc7 => (134, &[(0, 128, 0, 0, all)]),
    };
    let block_bytes = 24 + 16 * samples.len() as u16;
    let mut bytes = Vec::new();
    bytes.extend((4 + u32::from(block_bytes)).to_le_bytes());
    // Vendor Khronos, type basic.
    bytes.extend(0_u32.to_le_bytes());
    bytes.extend(VERSION.to_le_bytes());
    bytes.extend(block_bytes.to_le_bytes());
    bytes.extend([model, PRIMARIES_UNSPECIFIED, LINEAR, 0]);
    // Texels of a block along each axis, and bytes of each plane.
    let last = format.block_texels() as u8 - 1;
    bytes.extend([last, last, 0, 0]);
    bytes.extend([format.block_bytes() as u8, 0, 0, 0, 0, 0, 0, 0]);
    for (offset, length, channel, lower, upper) in samples {
        bytes.extend(offset.to_le_bytes());
        bytes.extend([length - 1, *channel]);
        // The position in the texel.
        bytes.extend([0; 4]);
        bytes.extend(lower.to_le_bytes());
        bytes.extend(upper.to_le_bytes());
    }
    bytes
}
