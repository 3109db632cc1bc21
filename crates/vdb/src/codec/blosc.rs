//! Blosc 1 chunks, the form in which most `.vdb` files hold their values, and their decoder. The encoder is
//! [`super::blosc_encoder`].
//!
//! A chunk cuts its data into blocks, filters each block (see [`super::shuffle`]) and compresses it with
//! one of five general codecs, as one stream or as one stream per byte of an element. All integers are
//! little-endian.
//!
//! ```text
//! 0   version of the chunk format: 2          4   size of the data
//! 1   version of the codec's stream: 1        8   size of a block; the last may be shorter
//! 2   flags                                   12  size of the chunk with this header
//! 3   size of an element
//! ```
//!
//! Flags: bit 0 byte shuffle, bit 1 the data follow as they are, bit 2 bit shuffle, bit 3 must be 0, bit 4
//! one stream per block, bits 5 to 7 the codec. After the header comes the start of each block in the chunk
//! (4 bytes each), then the streams: a size in 4 bytes and as many bytes. A stream as large as what it
//! stands for is not compressed.
//!
//! Blosc 2 chunks are refused: they have another header, more filters and more codecs.
//!
//! Source: <https://github.com/Blosc/c-blosc/blob/main/README_CHUNK_FORMAT.rst>; what that
//! page leaves open (when blocks are split, when bits are shuffled) is as in `blosc.c` and `shuffle.c` there.

use std::io::Read;

use ruzstd::decoding::{BlockDecodingStrategy, FrameDecoder};

use super::CodecError::{Malformed, Unsupported};
use super::{CodecError, Scratch, blosclz, shuffle, zlib};

pub(super) const HEADER_BYTES: usize = 16;
/// Where a chunk may split blocks at all, it does so for elements of up to this size …
pub(super) const MAX_SPLIT_TYPESIZE: usize = 16;
/// … if each stream of the block gets at least this many bytes.
pub(super) const MIN_SPLIT_BYTES: usize = 128;
/// Zstandard windows up to this size are accepted for blocks of any size, larger ones only for large blocks.
const MIN_ZSTD_WINDOW_LIMIT: u64 = 1 << 20;

/// Decodes the Blosc 1 chunk at the start of `chunk` into `out`. Bytes after the chunk's end are ignored.
///
/// # Errors
/// `Malformed` if the chunk is damaged or does not hold exactly `out.len()` bytes, `Unsupported` if it is a
/// Blosc 2 chunk or one of a codec or version unknown to Blosc 1. What `out` then holds is unspecified.
pub(crate) fn decompress(chunk: &[u8], out: &mut [u8], scratch: &mut Scratch) -> Result<(), CodecError> {
    let header = Header::read(chunk)?;
    if header.data_bytes != out.len() {
        return Err(Malformed("a Blosc chunk of another size than its values"));
    }
    if out.is_empty() {
        return Ok(());
    }
    let chunk = chunk.get(..header.chunk_bytes).ok_or(Malformed("a Blosc chunk that is cut off"))?;
    let body = chunk.get(HEADER_BYTES..).ok_or(Malformed("a Blosc chunk that is cut off"))?;
    if header.stored {
        if body.len() != out.len() {
            return Err(Malformed("a stored Blosc chunk of the wrong size"));
        }
        out.copy_from_slice(body);
        return Ok(());
    }
    if header.block_bytes == 0 || header.block_bytes > out.len() {
        return Err(Malformed("a Blosc chunk with an impossible block size"));
    }
    let block_count = out.len().div_ceil(header.block_bytes);
    let starts = body.as_chunks::<4>().0.get(..block_count);
    let starts = starts.ok_or(Malformed("a Blosc chunk too short for its blocks"))?;

    // Taken out so that the decoders can borrow the rest of the scratch.
    let mut shuffled = std::mem::take(&mut scratch.shuffled);
    if header.filter != Filter::None && shuffled.len() < header.block_bytes {
        shuffled.resize(header.block_bytes, 0);
    }
    // Blocks never share input. Holding a chunk to that keeps the work in proportion to its size.
    let mut unread_bytes = body.len();
    let mut decode_all = || {
        for (block, &start) in out.chunks_mut(header.block_bytes).zip(starts) {
            let streams = chunk.get(u32::from_le_bytes(start) as usize..);
            let streams = streams.ok_or(Malformed("a Blosc block that starts outside its chunk"))?;
            let read_bytes = decode_block(&header, streams, block, &mut shuffled, scratch)?;
            let left = unread_bytes.checked_sub(read_bytes);
            unread_bytes = left.ok_or(Malformed("a Blosc chunk whose blocks overlap"))?;
        }
        Ok(())
    };
    let result = decode_all();
    scratch.shuffled = shuffled;
    result
}

#[derive(Clone, Copy, PartialEq)]
enum Filter {
    None,
    Bytes,
    Bits,
}

#[derive(Clone, Copy)]
enum Codec {
    BloscLz,
    Lz4,
    Snappy,
    Zlib,
    Zstd,
}

struct Header {
    filter: Filter,
    stored: bool,
    may_split: bool,
    codec: Codec,
    typesize: usize,
    data_bytes: usize,
    block_bytes: usize,
    chunk_bytes: usize,
}

impl Header {
    fn read(chunk: &[u8]) -> Result<Header, CodecError> {
        let bytes = chunk.first_chunk::<HEADER_BYTES>().ok_or(Malformed("a Blosc chunk without a header"))?;
        let [version, codec_version, flags, typesize, sizes @ ..] = *bytes;
        let size =
            |i: usize| u32::from_le_bytes([sizes[i], sizes[i + 1], sizes[i + 2], sizes[i + 3]]) as usize;
        let filter = match flags & 0b101 {
            0b000 => Filter::None,
            0b001 => Filter::Bytes,
            0b100 => Filter::Bits,
            _ => return Err(Unsupported("Blosc 2 chunks")),
        };
        if version != 2 {
            return Err(Unsupported("Blosc chunks of a format version other than 2"));
        }
        if flags & 0b1000 != 0 {
            return Err(Unsupported("Blosc chunks with an unknown flag"));
        }
        if codec_version != 1 {
            return Err(Unsupported("Blosc streams of a codec version other than 1"));
        }
        let codec = match flags >> 5 {
            0 => Codec::BloscLz,
            1 => Codec::Lz4,
            2 => Codec::Snappy,
            3 => Codec::Zlib,
            4 => Codec::Zstd,
            _ => return Err(Unsupported("Blosc chunks of an unknown codec")),
        };
        if typesize == 0 {
            return Err(Malformed("a Blosc chunk of elements without a size"));
        }
        Ok(Header {
            filter,
            stored: flags & 0b10 != 0,
            may_split: flags & 0b1_0000 == 0,
            codec,
            typesize: usize::from(typesize),
            data_bytes: size(0),
            block_bytes: size(4),
            chunk_bytes: size(8),
        })
    }
}

/// Decodes the block whose streams start at `streams`; gives the number of bytes read there.
fn decode_block(
    header: &Header,
    streams: &[u8],
    block: &mut [u8],
    shuffled: &mut [u8],
    scratch: &mut Scratch,
) -> Result<usize, CodecError> {
    match header.filter {
        Filter::None => decode_streams(header, streams, block, scratch),
        filter => {
            let shuffled = &mut shuffled[..block.len()];
            let read_bytes = decode_streams(header, streams, shuffled, scratch)?;
            match filter {
                Filter::Bits => shuffle::unshuffle_bits(header.typesize, shuffled, block),
                _ => shuffle::unshuffle_bytes(header.typesize, shuffled, block),
            }
            Ok(read_bytes)
        }
    }
}

fn decode_streams(
    header: &Header,
    streams: &[u8],
    block: &mut [u8],
    scratch: &mut Scratch,
) -> Result<usize, CodecError> {
    let is_last_and_short = block.len() < header.block_bytes;
    let split = header.may_split
        && !is_last_and_short
        && header.typesize <= MAX_SPLIT_TYPESIZE
        && block.len() / header.typesize >= MIN_SPLIT_BYTES;
    let count = if split { header.typesize } else { 1 };
    if !block.len().is_multiple_of(count) {
        return Err(Malformed("a Blosc block that does not split evenly"));
    }
    let piece_bytes = block.len() / count;
    let mut rest = streams;
    for piece in block.chunks_exact_mut(piece_bytes) {
        let (size, after_size) =
            rest.split_first_chunk().ok_or(Malformed("a Blosc block that is cut off"))?;
        let (stream, after) = after_size
            .split_at_checked(u32::from_le_bytes(*size) as usize)
            .ok_or(Malformed("a Blosc stream that is cut off"))?;
        decode_stream(header.codec, stream, piece, scratch)?;
        rest = after;
    }
    Ok(streams.len() - rest.len())
}

fn decode_stream(
    codec: Codec,
    stream: &[u8],
    out: &mut [u8],
    scratch: &mut Scratch,
) -> Result<(), CodecError> {
    if stream.len() == out.len() {
        out.copy_from_slice(stream);
        return Ok(());
    }
    match codec {
        Codec::BloscLz => {
            blosclz::decompress(stream, out).ok_or(Malformed("a damaged BloscLZ stream in a Blosc chunk"))
        }
        Codec::Lz4 => match lz4_flex::block::decompress_into(stream, out) {
            Ok(size) if size == out.len() => Ok(()),
            _ => Err(Malformed("a damaged LZ4 stream in a Blosc chunk")),
        },
        Codec::Snappy => match snap::raw::decompress_len(stream) {
            Ok(size) if size == out.len() => snap::raw::Decoder::new()
                .decompress(stream, out)
                .map(drop)
                .map_err(|_| Malformed("a damaged Snappy stream in a Blosc chunk")),
            _ => Err(Malformed("a Snappy stream of the wrong size in a Blosc chunk")),
        },
        Codec::Zlib => zlib::decompress(stream, out, scratch),
        Codec::Zstd => decode_zstd(stream, out, scratch),
    }
}

/// Decodes one Zstandard frame, block by block, so that the decoder never holds more than a window (no larger
/// than `out` or 1 MiB) and one block (about 1 MiB at worst), whatever the frame goes on to claim.
fn decode_zstd(mut stream: &[u8], out: &mut [u8], scratch: &mut Scratch) -> Result<(), CodecError> {
    const DAMAGED: CodecError = Malformed("a damaged Zstandard stream in a Blosc chunk");
    const WRONG_SIZE: CodecError = Malformed("a Zstandard stream of the wrong size in a Blosc chunk");

    let decoder = scratch.zstd.get_or_insert_with(FrameDecoder::new);
    // An encoder that sees all data at once, as Blosc's does, never needs a window larger than the data.
    decoder.set_max_window_size(MIN_ZSTD_WINDOW_LIMIT.max(out.len() as u64));
    decoder.reset(&mut stream).map_err(|_| DAMAGED)?;
    let mut written = 0;
    while !decoder.is_finished() {
        decoder.decode_blocks(&mut stream, BlockDecodingStrategy::UptoBlocks(1)).map_err(|_| DAMAGED)?;
        written += decoder.read(&mut out[written..]).map_err(|_| DAMAGED)?;
        if decoder.can_collect() > 0 {
            return Err(WRONG_SIZE);
        }
    }
    if written == out.len() && stream.is_empty() { Ok(()) } else { Err(WRONG_SIZE) }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use proptest::prelude::*;

    use super::*;

    /// A chunk made by the reference library, and the bytes that went into it.
    struct Sample {
        chunk: &'static [u8],
        data: Vec<u8>,
    }

    /// The records of `make_blosc_chunks.py`.
    fn samples() -> Vec<Sample> {
        let mut rest: &[u8] = include_bytes!("../../tests/data/blosc_chunks.bin");
        let mut samples = Vec::new();
        while let Some((&[kind, typesize, size @ .., c0, c1, c2, c3], after)) = rest.split_first_chunk::<10>()
        {
            let (chunk, next) = after.split_at(u32::from_le_bytes([c0, c1, c2, c3]) as usize);
            samples
                .push(Sample { chunk, data: payload(kind, u32::from(typesize), u32::from_le_bytes(size)) });
            rest = next;
        }
        samples
    }

    fn noise(k: u32) -> u8 {
        let x = k.wrapping_mul(2_654_435_761);
        ((x ^ x >> 15).wrapping_mul(2_246_822_519) >> 24) as u8
    }

    /// The formula of `make_blosc_chunks.py`.
    fn payload(kind: u8, typesize: u32, size: u32) -> Vec<u8> {
        let byte = |k: u32| {
            let (element, byte) = (k / typesize, k % typesize);
            let smooth = ((element >> 3).wrapping_mul(2_654_435) >> (8 * (byte % 4))) as u8;
            match kind {
                0 => smooth,
                1 => noise(k),
                2 if byte < typesize / 2 => noise(k),
                2 => smooth,
                3 if k.is_multiple_of(3000) => 1,
                4 if k % 9000 >= 7000 => noise(k % 9000),
                _ => 7,
            }
        };
        (0..size).map(byte).collect()
    }

    fn decoded(chunk: &[u8], size: usize, scratch: &mut Scratch) -> Result<Vec<u8>, CodecError> {
        let mut out = vec![0xa5; size];
        decompress(chunk, &mut out, scratch).map(|()| out)
    }

    /// A chunk with the given flags and elements of 4 bytes: one block, its streams as given.
    fn one_block_chunk(flags: u8, size: usize, streams: &[&[u8]]) -> Vec<u8> {
        let mut body = Vec::from(20_u32.to_le_bytes());
        for stream in streams {
            body.extend((stream.len() as u32).to_le_bytes());
            body.extend(*stream);
        }
        let mut chunk = vec![2, 1, flags, 4];
        for size in [size, size, HEADER_BYTES + body.len()] {
            chunk.extend((size as u32).to_le_bytes());
        }
        chunk.extend(body);
        chunk
    }

    #[test]
    fn chunks_of_the_reference_library_decode_to_what_went_in() {
        let samples = samples();
        assert!(samples.len() > 100);
        let mut scratch = Scratch::default();
        for (index, Sample { chunk, data }) in samples.iter().enumerate() {
            let out = decoded(chunk, data.len(), &mut scratch);
            assert!(out.as_deref() == Ok(data), "sample {index}, header {:?}: {:?}", &chunk[..16], out.err());
            for other in [data.len() + 1, data.len().saturating_sub(1)] {
                if other != data.len() {
                    assert!(matches!(decoded(chunk, other, &mut scratch), Err(Malformed(_))));
                }
            }
        }
    }

    #[test]
    fn snappy_streams_decode() {
        let data = payload(0, 4, 2048);
        let snappy = |data: &[u8]| snap::raw::Encoder::new().compress_vec(data).unwrap();
        let mut scratch = Scratch::default();
        let whole = one_block_chunk(2 << 5 | 0x10, 2048, &[&snappy(&data)]);
        assert_eq!(decoded(&whole, 2048, &mut scratch), Ok(data.clone()));
        let quarters: Vec<_> = data.chunks(512).map(snappy).collect();
        let split = one_block_chunk(2 << 5, 2048, &quarters.iter().map(Vec::as_slice).collect::<Vec<_>>());
        assert_eq!(decoded(&split, 2048, &mut scratch), Ok(data.clone()));
        let wrong = one_block_chunk(2 << 5 | 0x10, 2048, &[&snappy(&data[..2047])]);
        assert!(decoded(&wrong, 2048, &mut scratch).is_err());
    }

    #[test]
    fn cut_chunks_are_malformed() {
        let mut scratch = Scratch::default();
        for Sample { chunk, data } in samples().iter().filter(|sample| sample.chunk.len() < 600).step_by(3) {
            for end in 0..chunk.len() {
                let result = decoded(&chunk[..end], data.len(), &mut scratch);
                assert!(matches!(result, Err(Malformed(_))) || data.is_empty() && end >= HEADER_BYTES);
                // The same with a header that claims nothing is missing.
                if end >= HEADER_BYTES && !data.is_empty() {
                    let mut shorter = chunk[..end].to_vec();
                    shorter[12..16].copy_from_slice(&(end as u32).to_le_bytes());
                    assert!(decoded(&shorter, data.len(), &mut scratch).is_err());
                }
            }
        }
    }

    #[test]
    fn damaged_chunks_never_panic_and_leave_no_trace() {
        let samples = samples();
        let mut scratch = Scratch::default();
        let mut random = 1_u64;
        let mut below = |limit: usize| {
            random = random.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (random >> 33) as usize % limit
        };
        for Sample { chunk, data } in samples.iter().filter(|sample| sample.data.len() < 20_000) {
            for _ in 0..40 {
                let mut damaged = chunk.to_vec();
                for _ in 0..1 + below(3) {
                    // Half of the damage in the headers, where it does the most.
                    let range = if below(2) == 0 { chunk.len() } else { chunk.len().min(40) };
                    damaged[below(range)] ^= 1 << below(8);
                }
                let _ = decoded(&damaged, data.len(), &mut scratch);
            }
            assert!(decoded(chunk, data.len(), &mut scratch).as_ref() == Ok(data));
        }
    }

    #[test]
    fn other_formats_are_unsupported() {
        let sample = &samples()[10];
        let mut scratch = Scratch::default();
        for (at, value) in [(0, 1), (0, 5), (1, 2), (2, 0x05), (2, 0x08), (2, 0xa0), (2, 0xe0)] {
            let mut chunk = sample.chunk.to_vec();
            chunk[at] = value;
            let result = decoded(&chunk, sample.data.len(), &mut scratch);
            assert!(matches!(result, Err(Unsupported(_))), "byte {at} = {value}: {result:?}");
        }
    }

    #[test]
    fn headers_that_lie_are_malformed() {
        let data = payload(1, 4, 2048);
        let chunk = one_block_chunk(1 << 5 | 0x10, 2048, &[&data]);
        let mut scratch = Scratch::default();
        assert_eq!(decoded(&chunk, 2048, &mut scratch), Ok(data));
        let lies: [(usize, u32); 8] = [
            (4, 2047),     // another size of the data
            (8, 0),        // no block size
            (8, 2049),     // a block larger than the data
            (8, u32::MAX), //
            (8, 1),        // more blocks than the chunk can hold
            (12, 15),      // a chunk smaller than its header
            (12, 1 << 31), // or larger than it is
            (16, 1 << 31), // a block that starts outside
        ];
        for (at, value) in lies {
            let mut lying = chunk.clone();
            lying[at..at + 4].copy_from_slice(&value.to_le_bytes());
            let result = decoded(&lying, 2048, &mut scratch);
            assert!(matches!(result, Err(Malformed(_))), "{value} at {at}: {result:?}");
        }
        let mut no_typesize = chunk.clone();
        no_typesize[3] = 0;
        assert!(matches!(decoded(&no_typesize, 2048, &mut scratch), Err(Malformed(_))));
    }

    #[test]
    fn blocks_must_not_share_input() {
        // Four blocks of 512 bytes that all point at one stored stream.
        let mut chunk = vec![2, 1, 1 << 5 | 0x10, 4];
        for value in [2048, 512, 16 + 16 + 4 + 512, 32, 32, 32, 32, 512_u32] {
            chunk.extend(value.to_le_bytes());
        }
        chunk.extend([0; 512]);
        let result = decoded(&chunk, 2048, &mut Scratch::default());
        assert_eq!(result, Err(Malformed("a Blosc chunk whose blocks overlap")));
    }

    /// A Zstandard frame without checksum: window descriptor, then blocks of a type, a size and bytes.
    fn zstd_frame(window: u8, blocks: &[(u32, u32, &[u8])]) -> Vec<u8> {
        let mut frame = vec![0x28, 0xb5, 0x2f, 0xfd, 0, window];
        for (i, &(kind, size, bytes)) in blocks.iter().enumerate() {
            let last = u32::from(i + 1 == blocks.len());
            frame.write_all(&(last | kind << 1 | size << 3).to_le_bytes()[..3]).unwrap();
            frame.write_all(bytes).unwrap();
        }
        frame
    }

    #[test]
    fn zstd_frames_beyond_the_block_are_refused() {
        const RUN: u32 = 1;
        let decode = |frame: &[u8], size| {
            let mut out = vec![0; size];
            decode_zstd(frame, &mut out, &mut Scratch::default()).map(|()| out)
        };
        let kib = |count| vec![(RUN, 1024, &[7_u8][..]); count];
        assert_eq!(decode(&zstd_frame(0, &kib(2)), 2048), Ok(vec![7; 2048]));
        // 20 runs of 128 KiB in a window of 256 KiB are refused before the last of them.
        assert!(decode(&zstd_frame(8 << 3, &[(RUN, 1 << 17, &[7][..]); 20]), 2048).is_err());
        assert!(decode(&zstd_frame(0, &kib(1)), 2048).is_err(), "too short");
        assert!(decode(&zstd_frame(0, &kib(3)), 2048).is_err(), "too long");
        assert!(decode(&zstd_frame(21 << 3, &kib(2)), 2048).is_err(), "a window of 2 GiB");
        let mut trailing = zstd_frame(0, &kib(2));
        trailing.push(0);
        assert!(decode(&trailing, 2048).is_err(), "bytes after the frame");
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        #[test]
        fn any_streams_decode_or_fail(
            flags in any::<u8>(),
            size in 1_usize..4000,
            streams in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 0..60), 1..5),
        ) {
            let streams: Vec<_> = streams.iter().map(Vec::as_slice).collect();
            let chunk = one_block_chunk(flags & !0b1010, size, &streams);
            let _ = decoded(&chunk, size, &mut Scratch::default());
        }
    }
}
