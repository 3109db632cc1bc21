//! One zlib stream, inflated into a slice of known size.
//!
//! The inflating itself is flate2's; here is only the rule that a block must fill its slice exactly.

use flate2::{Decompress, FlushDecompress, Status};

use super::{CodecError, Scratch};

/// Inflates the zlib stream at the start of `data` into `out`. Bytes after the stream's end are ignored, as
/// zlib's own one-call function does.
///
/// # Errors
/// `Malformed` if the stream is damaged, fails its checksum, or gives fewer or more bytes than `out` holds.
pub(crate) fn decompress(data: &[u8], out: &mut [u8], scratch: &mut Scratch) -> Result<(), CodecError> {
    let inflate = scratch.inflate.get_or_insert_with(|| Decompress::new(true));
    inflate.reset(true);
    match inflate.decompress(data, out, FlushDecompress::Finish) {
        Ok(Status::StreamEnd) if inflate.total_out() == out.len() as u64 => Ok(()),
        Ok(_) => {
            Err(CodecError::Malformed("a zlib stream that does not give the size its block should have"))
        }
        Err(_) => Err(CodecError::Malformed("a damaged zlib stream")),
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use flate2::{Compression, write::ZlibEncoder};
    use proptest::prelude::*;

    use super::*;

    fn compress(data: &[u8], level: u32) -> Vec<u8> {
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
            let stream = compress(&data, level);
            let mut scratch = Scratch::default();
            let mut out = vec![0; data.len()];
            // Twice, so that the second run meets a used decoder state.
            for _ in 0..2 {
                out.fill(0);
                prop_assert_eq!(decompress(&stream, &mut out, &mut scratch), Ok(()));
                prop_assert_eq!(&out, &data);
            }
        }
    }

    #[test]
    fn other_sizes_and_cut_streams_are_malformed() {
        let data: Vec<u8> = (0..2048_u32).map(|i| ((i * i) >> 9) as u8).collect();
        let stream = compress(&data, 6);
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
