//! The encoder of Blosc 1 chunks: one block, bytes shuffled, LZ4. The format is described in
//! [`super::blosc`].
//!
//! Chunks differ from those of OpenVDB in one thing: their elements are the numbers that the values consist
//! of, not always four bytes. Halves and doubles compress better that way, and every decoder reads it.

use lz4_flex::block;

use super::blosc::{HEADER_BYTES, MAX_SPLIT_TYPESIZE, MIN_SPLIT_BYTES};
use super::{EncodeScratch, shuffle};

const FORMAT_VERSION: u8 = 2;
const LZ4_STREAM_VERSION: u8 = 1;
const FLAG_BYTE_SHUFFLE: u8 = 1;
const FLAG_STORED: u8 = 1 << 1;
const FLAG_NOT_SPLIT: u8 = 1 << 4;
const CODEC_LZ4: u8 = 1 << 5;

/// Appends `data`, whole elements of `typesize` bytes, as a Blosc chunk of one block to `out`, if that is smaller; if
/// not, `out` stays as it is and `false` comes back.
pub(crate) fn compress(data: &[u8], typesize: usize, out: &mut Vec<u8>, scratch: &mut EncodeScratch) -> bool {
    let begin = out.len();
    let done = append(data, typesize, data.len(), out, scratch).is_some();
    if !done {
        out.truncate(begin);
    }
    done
}

/// Appends `data`, whole elements of `typesize` bytes and less than 2 GiB, as a Blosc chunk to `out`: in blocks that a
/// decoder holds in its caches, or as they are if that is not smaller.
pub(crate) fn compress_or_store(data: &[u8], typesize: u8, out: &mut Vec<u8>, scratch: &mut EncodeScratch) {
    const BLOCK_BYTES: usize = 256 << 10;
    let begin = out.len();
    let block_bytes = BLOCK_BYTES.min(data.len()) / usize::from(typesize) * usize::from(typesize);
    if append(data, typesize.into(), block_bytes, out, scratch).is_none() {
        out.truncate(begin);
        out.extend_from_slice(&[FORMAT_VERSION, LZ4_STREAM_VERSION, FLAG_STORED | CODEC_LZ4, typesize]);
        for size in [data.len(), data.len(), data.len() + HEADER_BYTES] {
            out.extend_from_slice(&(size as u32).to_le_bytes());
        }
        out.extend_from_slice(data);
    }
}

fn append(
    data: &[u8],
    typesize: usize,
    block_bytes: usize,
    out: &mut Vec<u8>,
    scratch: &mut EncodeScratch,
) -> Option<()> {
    let begin = out.len();
    let size = u32::try_from(data.len()).ok().filter(|size| i32::try_from(*size).is_ok())?;
    let type_byte =
        u8::try_from(typesize).ok().filter(|size| *size > 0 && data.len().is_multiple_of(typesize))?;
    let may_split = typesize <= MAX_SPLIT_TYPESIZE && block_bytes / typesize >= MIN_SPLIT_BYTES;
    let flags = FLAG_BYTE_SHUFFLE | CODEC_LZ4 | if may_split { 0 } else { FLAG_NOT_SPLIT };
    out.extend_from_slice(&[FORMAT_VERSION, LZ4_STREAM_VERSION, flags, type_byte]);
    // The chunk's own size is put in at the end, and so are the places of the blocks.
    for number in [size, block_bytes as u32, 0] {
        out.extend_from_slice(&number.to_le_bytes());
    }
    let blocks = data.chunks(block_bytes.max(1));
    let starts_at = out.len();
    // Of nothing there is a block too.
    out.resize(starts_at + 4 * blocks.len().max(1), 0);
    let EncodeScratch { shuffled, .. } = scratch;
    for (i, block) in blocks.enumerate() {
        let start = (out.len() - begin) as u32;
        out[starts_at + 4 * i..][..4].copy_from_slice(&start.to_le_bytes());
        shuffled.resize(block.len(), 0);
        shuffle::shuffle_bytes(typesize, block, shuffled);
        // A last block that is shorter than the others is never split.
        let streams = if may_split && block.len() == block_bytes { typesize } else { 1 };
        for stream in shuffled.chunks_exact((block.len() / streams).max(1)) {
            let size_at = out.len();
            out.extend_from_slice(&[0; 4]);
            append_stream(stream, out);
            let stream_bytes = (out.len() - size_at - 4) as u32;
            out[size_at..size_at + 4].copy_from_slice(&stream_bytes.to_le_bytes());
            if out.len() - begin >= data.len() {
                return None;
            }
        }
    }
    let chunk_bytes = (out.len() - begin) as u32;
    out[begin + 12..begin + 16].copy_from_slice(&chunk_bytes.to_le_bytes());
    (out.len() - begin < data.len()).then_some(())
}

/// Appends a stream as an LZ4 block, or as it is if that is not smaller: a stream as large as what it stands for is
/// taken for that.
fn append_stream(stream: &[u8], out: &mut Vec<u8>) {
    let begin = out.len();
    out.resize(begin + block::get_maximum_output_size(stream.len()), 0);
    match block::compress_into(stream, &mut out[begin..]) {
        Ok(size) if size < stream.len() => out.truncate(begin + size),
        _ => {
            out.truncate(begin);
            out.extend_from_slice(stream);
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::codec::{Scratch, blosc};

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        #[test]
        fn chunks_decode_to_what_went_in(
            typesize in prop_oneof![Just(2_usize), Just(4), Just(8), 1_usize..=20],
            elements in prop_oneof![0_usize..200, Just(512_usize), 500_usize..3000],
            seed in proptest::collection::vec(any::<u8>(), 1..700),
            noise in any::<bool>(),
        ) {
            // Without noise, all bytes of an element but the first are zero, which shrinks.
            // An element of one byte has no others.
            let noise = noise || typesize == 1;
            let keep = |i: usize| if noise || i.is_multiple_of(typesize) { 0xff } else { 0 };
            let byte = |i: usize| seed[i % seed.len()] & keep(i);
            let data: Vec<u8> = (0..elements * typesize).map(byte).collect();
            let mut scratch = EncodeScratch::default();
            let mut out = b"before".to_vec();
            if compress(&data, typesize, &mut out, &mut scratch) {
                prop_assert!(out.len() - 6 < data.len());
                let mut decoded = vec![0xa5; data.len()];
                prop_assert_eq!(blosc::decompress(&out[6..], &mut decoded, &mut Scratch::default()), Ok(()));
                prop_assert!(decoded == data);
            } else {
                prop_assert_eq!(out, b"before");
                prop_assert!(noise || elements < 60, "{} × {}", typesize, elements);
            }
        }

        #[test]
        fn chunks_of_many_blocks_decode_to_what_went_in(
            elements in 60_000_usize..300_000, mask in prop_oneof![Just(0_u32), Just(0xff), Just(u32::MAX)],
        ) {
            let word = |i: usize| (i as u32).wrapping_mul(2_654_435_761).rotate_left(7) & mask | (i >> 4) as u32;
            let data: Vec<u8> = (0..elements).flat_map(|i| word(i).to_le_bytes()).collect();
            let (mut out, mut decoded) = (Vec::new(), vec![0; data.len()]);
            compress_or_store(&data, 4, &mut out, &mut EncodeScratch::default());
            prop_assert!(out.len() <= data.len() + HEADER_BYTES);
            prop_assert_eq!(blosc::decompress(&out, &mut decoded, &mut Scratch::default()), Ok(()));
            prop_assert!(decoded == data);
        }
    }
}
