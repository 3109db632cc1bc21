//! The encoder of Blosc 1 chunks: one block, bytes shuffled, LZ4. The format is described in
//! [`super::blosc`].
//!
//! Chunks differ from those of OpenVDB in one thing: their elements are the numbers that the values consist
//! of, not always four bytes. Halves and doubles compress better that way, and every decoder reads it.

use super::blosc::{HEADER_BYTES, MAX_SPLIT_TYPESIZE, MIN_SPLIT_BYTES};
use super::{EncodeScratch, lz4, shuffle};

const FORMAT_VERSION: u8 = 2;
const LZ4_STREAM_VERSION: u8 = 1;
const FLAG_BYTE_SHUFFLE: u8 = 1;
const FLAG_NOT_SPLIT: u8 = 1 << 4;
const CODEC_LZ4: u8 = 1 << 5;

/// Appends `data`, whole elements of `typesize` bytes, as a Blosc chunk to `out`, if that is smaller; if not,
/// `out` stays as it is and `false` comes back.
pub(crate) fn compress(data: &[u8], typesize: usize, out: &mut Vec<u8>, scratch: &mut EncodeScratch) -> bool {
    let begin = out.len();
    let done = append(data, typesize, out, scratch).is_some();
    if !done {
        out.truncate(begin);
    }
    done
}

fn append(data: &[u8], typesize: usize, out: &mut Vec<u8>, scratch: &mut EncodeScratch) -> Option<()> {
    let begin = out.len();
    let size = u32::try_from(data.len()).ok().filter(|size| i32::try_from(*size).is_ok())?;
    let type_byte =
        u8::try_from(typesize).ok().filter(|size| *size > 0 && data.len().is_multiple_of(typesize))?;
    let split = typesize <= MAX_SPLIT_TYPESIZE && data.len() / typesize >= MIN_SPLIT_BYTES;
    let flags = FLAG_BYTE_SHUFFLE | CODEC_LZ4 | if split { 0 } else { FLAG_NOT_SPLIT };
    out.extend_from_slice(&[FORMAT_VERSION, LZ4_STREAM_VERSION, flags, type_byte]);
    // The data and the only block are as large as each other; the chunk's own size is put in at the end.
    for number in [size, size, 0, HEADER_BYTES as u32 + 4] {
        out.extend_from_slice(&number.to_le_bytes());
    }
    let EncodeScratch { shuffled, lz4: table, .. } = scratch;
    shuffled.resize(data.len(), 0);
    shuffle::shuffle_bytes(typesize, data, shuffled);
    let streams = if split { typesize } else { 1 };
    for stream in shuffled.chunks_exact((data.len() / streams).max(1)) {
        let size_at = out.len();
        out.extend_from_slice(&[0; 4]);
        if !lz4::compress(stream, stream.len(), table, out) {
            // As large as what it stands for: the stream itself.
            out.truncate(size_at + 4);
            out.extend_from_slice(stream);
        }
        let stream_bytes = (out.len() - size_at - 4) as u32;
        out[size_at..size_at + 4].copy_from_slice(&stream_bytes.to_le_bytes());
        if out.len() - begin >= data.len() {
            return None;
        }
    }
    let chunk_bytes = (out.len() - begin) as u32;
    out[begin + 12..begin + 16].copy_from_slice(&chunk_bytes.to_le_bytes());
    (out.len() - begin < data.len()).then_some(())
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
    }
}
