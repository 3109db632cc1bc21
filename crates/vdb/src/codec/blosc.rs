//! Blosc 1 chunks, the form in which most `.vdb` files hold their values.
//!
//! A chunk cuts its data into blocks, filters each block (see [`super::shuffle`]) and compresses it with one of
//! five general codecs, as one stream or as one stream per byte of an element. All integers are little-endian.
//!
//! ```text
//! 0   version of the chunk format: 2          4   size of the data
//! 1   version of the codec's stream: 1        8   size of a block; the last may be shorter
//! 2   flags                                   12  size of the chunk with this header
//! 3   size of an element
//! ```
//!
//! Flags: bit 0 byte shuffle, bit 1 the data follow as they are, bit 2 bit shuffle, bit 3 must be 0, bit 4 one
//! stream per block, bits 5 to 7 the codec. After the header comes the start of each block in the chunk (4
//! bytes each), then the streams: a size in 4 bytes and as many bytes. A stream as large as what it
//! stands for is not compressed.
//!
//! Blosc 2 chunks are refused: they have another header, more filters and more codecs.
//!
//! Source: <https://github.com/Blosc/c-blosc/blob/main/README_CHUNK_FORMAT.rst>; when blocks are split and when
//! bits are shuffled is known from the behaviour of that library.

use std::io::Read;

use ruzstd::decoding::{BlockDecodingStrategy, FrameDecoder};

use super::CodecError::{Malformed, Unsupported};
use super::{CodecError, Scratch, blosclz, shuffle, zlib};

const HEADER_BYTES: usize = 16;
/// Where a chunk may split blocks at all, it does so for elements of up to this size …
const MAX_SPLIT_TYPESIZE: usize = 16;
/// … if each stream of the block gets at least this many bytes.
const MIN_SPLIT_BYTES: usize = 128;
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
    if block.len() % count != 0 {
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

/// Decodes one Zstandard frame, step by step, so that the decoder never holds more than a window and a block
/// (at most 1 MiB or so) beyond what `out` has room for, whatever the frame goes on to claim.
fn decode_zstd(mut stream: &[u8], out: &mut [u8], scratch: &mut Scratch) -> Result<(), CodecError> {
    const DAMAGED: CodecError = Malformed("a damaged Zstandard stream in a Blosc chunk");
    const WRONG_SIZE: CodecError = Malformed("a Zstandard stream of the wrong size in a Blosc chunk");

    let decoder = scratch.zstd.get_or_insert_with(FrameDecoder::new);
    // One-shot encoders fit the window to the data, rounded up to a power of two.
    decoder.set_max_window_size(MIN_ZSTD_WINDOW_LIMIT.max(2 * out.len() as u64));
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
