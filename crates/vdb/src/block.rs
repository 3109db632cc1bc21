//! Value blocks: how the values of a node or leaf are laid out and compressed.
//!
//! From file version 222 on a block opens with a byte that says how the inactive values can be restored, then the
//! distinct inactive values and a mask that selects between them where there are any. Then the stored values: all of
//! them, or with active-mask compression only the active ones; raw, ZIP or Blosc; as written or as half floats. The
//! same parse serves to skip a block and to decode it; how a block is written lives in [`crate::write`].

use crate::codec::{self, CodecError, Scratch};
use crate::error::{Error, Result};
use crate::source::Reader;
use crate::value::Value;

pub(crate) const COMPRESS_ZIP: u32 = 1;
pub(crate) const COMPRESS_ACTIVE_MASK: u32 = 2;
pub(crate) const COMPRESS_BLOSC: u32 = 4;

// The first byte of a block.
pub(crate) const BACKGROUND: u8 = 0;
pub(crate) const MINUS_BACKGROUND: u8 = 1;
pub(crate) const ONE_INACTIVE_VALUE: u8 = 2;
pub(crate) const MASK_OF_BACKGROUNDS: u8 = 3;
pub(crate) const MASK_AND_ONE_INACTIVE_VALUE: u8 = 4;
pub(crate) const MASK_AND_TWO_INACTIVE_VALUES: u8 = 5;
pub(crate) const ALL_VALUES: u8 = 6;

/// How the values of a grid are compressed: the flags of the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Compression {
    pub(crate) flags: u32,
}

impl Compression {
    /// Values as they are.
    pub const NONE: Compression = Compression { flags: COMPRESS_ACTIVE_MASK };
    /// Values deflated.
    pub const ZIP: Compression = Compression { flags: COMPRESS_ZIP | COMPRESS_ACTIVE_MASK };
    /// Values shuffled and compressed with LZ4: OpenVDB's default.
    pub const BLOSC: Compression = Compression { flags: COMPRESS_BLOSC | COMPRESS_ACTIVE_MASK };

    /// The same with the values of inactive voxels stored too.
    pub const fn with_all_values(self) -> Self {
        Compression { flags: self.flags & !COMPRESS_ACTIVE_MASK }
    }

    pub(crate) fn read(reader: &mut Reader<'_>) -> Result<Self> {
        let flags = reader.u32("compression flags")?;
        match flags & !(COMPRESS_ZIP | COMPRESS_ACTIVE_MASK | COMPRESS_BLOSC) {
            0 => Ok(Compression { flags }),
            _ => Err(Error::unsupported(format!("compression flags {flags:#x}"))),
        }
    }

    /// Only the values of active voxels are stored where the others can be restored.
    pub fn active_mask(self) -> bool {
        self.flags & COMPRESS_ACTIVE_MASK != 0
    }

    /// `"blosc"`, `"zip"` or `"none"`.
    pub fn codec(self) -> &'static str {
        // OpenVDB looks for Blosc first.
        if self.flags & COMPRESS_BLOSC != 0 {
            "blosc"
        } else if self.flags & COMPRESS_ZIP != 0 {
            "zip"
        } else {
            "none"
        }
    }
}

/// How the blocks of a grid are written.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BlockFormat {
    pub(crate) compression: Compression,
    /// Whether values are saved as half floats, if the type has such a form.
    pub(crate) half: bool,
    /// The version of the file.
    pub(crate) file_version: u32,
}

impl BlockFormat {
    /// From this version on blocks open with a byte that tells of inactive values.
    pub(crate) const INACTIVE_VALUES_SINCE: u32 = 222;

    pub(crate) fn has_inactive_values(self) -> bool {
        self.file_version >= Self::INACTIVE_VALUES_SINCE
    }

    /// The bytes of a value inside a block.
    pub(crate) fn stored_bytes<V: Value>(self) -> usize {
        if self.half { V::HALF_BYTES } else { V::SIZE_BYTES }
    }
}

/// A parsed block: where its parts stand in the file.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Block {
    begin: u64,
    kind: u8,
    inactive_at: u64,
    selection_at: u64,
    selection_bytes: usize,
    stored_count: usize,
    codec: Codec,
    payload_at: u64,
    payload_bytes: usize,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum Codec {
    Raw,
    Zip,
    Blosc,
}

/// Compressed values are never larger than raw ones by more than a header. A file that says so is damaged, and would
/// have us read it all at once.
const MAX_COMPRESSED_SLACK: usize = 4096;

/// Parses the block of a node with `slots` values of which `active` are active, and moves past it. Of its payload
/// nothing is read.
pub(crate) fn parse<V: Value>(
    reader: &mut Reader<'_>,
    format: BlockFormat,
    slots: usize,
    active: usize,
) -> Result<Block> {
    let begin = reader.offset();
    let kind = if format.has_inactive_values() { reader.u8("a block's first byte")? } else { ALL_VALUES };
    if kind > ALL_VALUES {
        return Err(Error::malformed(begin, format!("{kind} does not say how inactive values are stored")));
    }
    let inactive_count = match kind {
        ONE_INACTIVE_VALUE | MASK_AND_ONE_INACTIVE_VALUE => 1,
        MASK_AND_TWO_INACTIVE_VALUES => 2,
        _ => 0,
    };
    let inactive_at = reader.offset();
    reader.skip((inactive_count * V::SIZE_BYTES) as u64, "an inactive value")?;
    let has_selection =
        matches!(kind, MASK_OF_BACKGROUNDS | MASK_AND_ONE_INACTIVE_VALUE | MASK_AND_TWO_INACTIVE_VALUES);
    let selection_at = reader.offset();
    let selection_bytes = if has_selection { slots / 8 } else { 0 };
    reader.skip(selection_bytes as u64, "a selection mask")?;
    let stored_count = if format.compression.active_mask() && kind != ALL_VALUES { active } else { slots };
    let raw_bytes = stored_count * format.stored_bytes::<V>();
    // A half-saved block of no values has no payload at all; every other compressed one has at least a size.
    let no_payload = stored_count == 0 && format.half && V::HALF_BYTES != V::SIZE_BYTES;
    let mut codec = match format.compression.codec() {
        _ if no_payload => Codec::Raw,
        "zip" => Codec::Zip,
        "blosc" => Codec::Blosc,
        _ => Codec::Raw,
    };
    let mut payload_bytes = raw_bytes;
    if codec != Codec::Raw {
        // A size that is not positive marks values that did not shrink and stand there as they are.
        let size = reader.i64("the size of a compressed block")?;
        payload_bytes = usize::try_from(size.unsigned_abs()).unwrap_or(usize::MAX);
        if size <= 0 {
            codec = Codec::Raw;
        }
        if codec == Codec::Raw && payload_bytes != raw_bytes {
            return Err(
                reader.malformed(format!("a block of {payload_bytes} bytes where {raw_bytes} are expected"))
            );
        }
        if payload_bytes > 2 * raw_bytes + MAX_COMPRESSED_SLACK {
            return Err(reader.malformed(format!(
                "a compressed block of {payload_bytes} bytes that stands for {raw_bytes}"
            )));
        }
    }
    let payload_at = reader.offset();
    let what = if codec == Codec::Raw { "the values of a node" } else { "a compressed block" };
    reader.skip(payload_bytes as u64, what)?;
    Ok(Block {
        begin,
        kind,
        inactive_at,
        selection_at,
        selection_bytes,
        stored_count,
        codec,
        payload_at,
        payload_bytes,
    })
}

/// Buffers that one thread reuses over many blocks.
pub(crate) struct DecodeScratch<V> {
    codec: Scratch,
    bytes: Vec<u8>,
    packed: Vec<V>,
}

impl<V> Default for DecodeScratch<V> {
    fn default() -> Self {
        DecodeScratch { codec: Scratch::default(), bytes: Vec::new(), packed: Vec::new() }
    }
}

impl Block {
    /// Decodes the values of the node into `out`, one per slot. The reader is the one that the block was parsed from.
    pub(crate) fn decode<V: Value>(
        &self,
        reader: &mut Reader<'_>,
        format: BlockFormat,
        background: V,
        value_mask: &[u64],
        out: &mut [V],
        scratch: &mut DecodeScratch<V>,
    ) -> Result<()> {
        let DecodeScratch { codec, bytes, packed } = scratch;
        let whole_bytes = (self.payload_at - self.begin) as usize + self.payload_bytes;
        reader.load(self.begin, whole_bytes)?;
        let payload = reader.loaded(self.payload_at, self.payload_bytes);
        bytes.resize(self.stored_count * format.stored_bytes::<V>(), 0);
        let stored: &[u8] = match self.codec {
            Codec::Raw => payload,
            Codec::Zip => {
                codec::zlib::decompress(payload, bytes, codec).map_err(|e| self.codec_error(e))?;
                bytes
            }
            Codec::Blosc => {
                codec::blosc::decompress(payload, bytes, codec).map_err(|e| self.codec_error(e))?;
                bytes
            }
        };
        if self.stored_count == out.len() {
            V::decode(stored, format.half, out);
            return Ok(());
        }
        packed.resize(self.stored_count, V::default());
        V::decode(stored, format.half, packed);
        let [inactive0, inactive1] = self.inactive_values(reader, background);
        let selection_bytes = reader.loaded(self.selection_at, self.selection_bytes);
        let mut active = packed.iter();
        for (word, slots) in out.chunks_mut(64).enumerate() {
            let on = value_mask.get(word).copied().unwrap_or(0);
            if on == 0 && self.selection_bytes == 0 {
                slots.fill(inactive0);
                continue;
            }
            let mut select = [0; 8];
            if let Some(bytes) = selection_bytes.get(word * 8..) {
                let len = bytes.len().min(8);
                select[..len].copy_from_slice(&bytes[..len]);
            }
            let select = u64::from_le_bytes(select);
            for (bit, slot) in slots.iter_mut().enumerate() {
                *slot = if on >> bit & 1 == 1 {
                    active.next().copied().unwrap_or(background)
                } else if select >> bit & 1 == 1 {
                    inactive1
                } else {
                    inactive0
                };
            }
        }
        Ok(())
    }

    /// The two inactive values: where the selection mask is off and where it is on.
    fn inactive_values<V: Value>(&self, reader: &Reader<'_>, background: V) -> [V; 2] {
        let stored = |i: usize| {
            let at = self.inactive_at + (i * V::SIZE_BYTES) as u64;
            V::from_bytes(reader.loaded(at, V::SIZE_BYTES))
        };
        match self.kind {
            MINUS_BACKGROUND | MASK_OF_BACKGROUNDS => [background.negative(), background],
            ONE_INACTIVE_VALUE | MASK_AND_ONE_INACTIVE_VALUE => [stored(0), background],
            MASK_AND_TWO_INACTIVE_VALUES => [stored(0), stored(1)],
            _ => [background; 2],
        }
    }

    fn codec_error(&self, error: CodecError) -> Error {
        match error {
            CodecError::Malformed(what) => Error::malformed(self.payload_at, what),
            CodecError::Unsupported(feature) => {
                Error::unsupported(format!("{feature} (at byte {})", self.payload_at))
            }
        }
    }
}
