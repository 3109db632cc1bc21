//! Codecs of compressed value blocks: bytes in, bytes out.
//!
//! A `.vdb` file compresses the values of each leaf and inner node on their own, with zlib or as a Blosc
//! chunk. The decoders here turn one such block back into exactly the bytes that the caller expects, and
//! take no more memory than a few times that (plus a constant), whatever the block claims about itself. The
//! encoders make blocks that OpenVDB reads.
//!
//! What the bytes mean, which codec a grid uses and where a block starts and ends is none of their business:
//! the readers and writers of files and grids know that.

pub(crate) mod blosc;
pub(crate) mod blosc_encoder;
mod blosclz;
mod inflate;
mod shuffle;
pub(crate) mod zlib;

/// Why a block could not be decoded. The caller knows the block's offset and adds it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum CodecError {
    /// The block breaks the rules of its format, or decodes to another size than it should.
    Malformed(&'static str),
    /// The block may be sound but uses a feature that is not read here.
    Unsupported(&'static str),
}

/// Buffers and decoder states that outlive a block.
///
/// Grids hold tens of thousands of blocks of 2 KiB, so that setting these up for each would cost more than
/// decoding it. One per thread; what is left in it never changes what the next block decodes to.
#[derive(Default)]
pub(crate) struct Scratch {
    /// A Blosc block before its shuffle is undone.
    shuffled: Vec<u8>,
    inflater: Option<Box<inflate::Inflater>>,
    zstd: Option<ruzstd::decoding::FrameDecoder>,
}

/// What encoders keep from block to block, for the same reason. What is left in it never changes what the
/// next block is encoded to.
#[derive(Default)]
pub(crate) struct EncodeScratch {
    /// A Blosc block after its shuffle.
    shuffled: Vec<u8>,
    deflate: Option<flate2::Compress>,
}
