//! One zlib stream (RFC 1950), inflated into a slice of known size, or deflated if that makes it smaller.
//!
//! Deflating is flate2's work. Inflating is [`super::inflate`]'s: it is what reading a ZIP-compressed file waits for.

use flate2::{Compress, Compression, FlushCompress, Status};

use super::inflate::Inflater;
use super::{CodecError, EncodeScratch, Scratch};

/// OpenVDB's own level, and zlib's default.
const LEVEL: u32 = 6;

/// Inflates the zlib stream at the start of `data` into `out`. Bytes after the stream's end are ignored, as
/// zlib's own one-call function does.
///
/// # Errors
/// `Malformed` if the stream is damaged, fails its checksum, or gives fewer or more bytes than `out` holds.
pub(crate) fn decompress(data: &[u8], out: &mut [u8], scratch: &mut Scratch) -> Result<(), CodecError> {
    let (header, stream) = data.split_first_chunk::<2>().ok_or(CodecError::Malformed("a cut zlib stream"))?;
    let is_header = u16::from_be_bytes(*header) % 31 == 0 && header[0] & 0xf == 8 && header[0] >> 4 <= 7;
    let has_dictionary = header[1] & 0x20 != 0;
    if !is_header || has_dictionary {
        return Err(CodecError::Malformed("bytes that do not begin as a zlib stream does"));
    }
    let end = scratch.inflater.get_or_insert_with(Inflater::new).inflate(stream, out)?;
    let checksum = stream[end..].first_chunk().ok_or(CodecError::Malformed("a cut zlib stream"))?;
    match u32::from_be_bytes(*checksum) == simd_adler32::adler32(&&*out) {
        true => Ok(()),
        false => Err(CodecError::Malformed("a zlib stream with a wrong checksum")),
    }
}

/// Appends `data` as a zlib stream to `out`, if that is smaller; if not, `out` stays as it is and `false`
/// comes back.
pub(crate) fn compress(data: &[u8], out: &mut Vec<u8>, scratch: &mut EncodeScratch) -> bool {
    let deflate = scratch.deflate.get_or_insert_with(|| Compress::new(Compression::new(LEVEL), true));
    deflate.reset();
    let begin = out.len();
    out.resize(begin + data.len().saturating_sub(1), 0);
    let status = deflate.compress(data, &mut out[begin..], FlushCompress::Finish);
    let shrunk = matches!(status, Ok(Status::StreamEnd));
    out.truncate(if shrunk { begin + deflate.total_out() as usize } else { begin });
    shrunk
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use flate2::write::ZlibEncoder;
    use proptest::prelude::*;

    use super::*;

    fn deflated(data: &[u8], level: u32) -> Vec<u8> {
        let mut encoder = ZlibEncoder::new(Vec::new(), Compression::new(level));
        encoder.write_all(data).unwrap();
        encoder.finish().unwrap()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(64))]

        #[test]
        fn what_was_deflated_comes_back(
            run in proptest::collection::vec(any::<u8>(), 0..300), repeats in 1_usize..20, level in 0_u32..10,
        ) {
            let data = run.repeat(repeats);
            let stream = deflated(&data, level);
            let mut scratch = Scratch::default();
            let mut out = vec![0; data.len()];
            // Twice, so that the second run meets a used decoder state.
            for _ in 0..2 {
                out.fill(0);
                prop_assert_eq!(decompress(&stream, &mut out, &mut scratch), Ok(()));
                prop_assert_eq!(&out, &data);
            }
            let mut scratches = (EncodeScratch::default(), b"before".to_vec());
            for _ in 0..2 {
                scratches.1.truncate(6);
                if compress(&data, &mut scratches.1, &mut scratches.0) {
                    prop_assert!(scratches.1.len() - 6 < data.len());
                    prop_assert_eq!(decompress(&scratches.1[6..], &mut out, &mut scratch), Ok(()));
                    prop_assert_eq!(&out, &data);
                } else {
                    prop_assert_eq!(scratches.1.len(), 6);
                    prop_assert!(stream.len() + 8 > data.len() || level == 0 || data.len() < 20);
                }
            }
        }
    }

    #[test]
    fn other_sizes_and_cut_streams_are_malformed() {
        let data: Vec<u8> = (0..2048_u32).map(|i| ((i * i) >> 9) as u8).collect();
        let stream = deflated(&data, 6);
        let mut scratch = Scratch::default();
        for size in [0, 1, 2047, 2049, 5000] {
            assert!(matches!(
                decompress(&stream, &mut vec![0; size], &mut scratch),
                Err(CodecError::Malformed(_))
            ));
        }
        let mut out = vec![0; data.len()];
        for end in 0..stream.len() {
            assert!(decompress(&stream[..end], &mut out, &mut scratch).is_err(), "cut at {end}");
        }
        let mut damaged = stream.clone();
        *damaged.last_mut().unwrap() ^= 1;
        assert!(decompress(&damaged, &mut out, &mut scratch).is_err(), "the checksum is checked");
        assert_eq!(decompress(&stream, &mut out, &mut scratch), Ok(()));
        assert_eq!(out, data);
    }
}
