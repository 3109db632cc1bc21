//! One zlib stream, inflated into a slice of known size, or deflated if that makes it smaller.
//!
//! Both are flate2's work; here are only the rules that a block must fill its slice exactly, and that it must
//! shrink.

use flate2::{Compress, Compression, Decompress, FlushCompress, FlushDecompress, Status};

use super::{CodecError, EncodeScratch, Scratch};

/// OpenVDB's own level, and zlib's default.
const LEVEL: u32 = 6;

/// The fast loop of the inflater ends where less room than this is left. Values are a few kilobytes: without that room
/// behind them, a good part of each block would go through the slow loop.
const FAST_LOOP_BYTES: usize = 320;

/// Inflates the zlib stream at the start of `data` into `out`. Bytes after the stream's end are ignored, as
/// zlib's own one-call function does.
///
/// # Errors
/// `Malformed` if the stream is damaged, fails its checksum, or gives fewer or more bytes than `out` holds.
pub(crate) fn decompress(data: &[u8], out: &mut [u8], scratch: &mut Scratch) -> Result<(), CodecError> {
    let Scratch { inflate, inflated, .. } = scratch;
    let inflate = inflate.get_or_insert_with(|| Decompress::new(true));
    inflate.reset(true);
    inflated.resize(out.len() + FAST_LOOP_BYTES, 0);
    match inflate.decompress(data, inflated, FlushDecompress::Finish) {
        Ok(Status::StreamEnd) if inflate.total_out() == out.len() as u64 => {
            out.copy_from_slice(&inflated[..out.len()]);
            Ok(())
        }
        Ok(_) => {
            Err(CodecError::Malformed("a zlib stream that does not give the size its block should have"))
        }
        Err(_) => Err(CodecError::Malformed("a damaged zlib stream")),
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
