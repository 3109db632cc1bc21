//! Value blocks: how the values of a node or leaf are laid out and compressed.
//!
//! A block opens with a byte that says how the inactive values can be restored (file version 222 and later),
//! then the distinct inactive values and a mask that selects between them where there are any, then the stored
//! values: all of them, or with active-mask compression only the active ones; raw, ZIP or Blosc; as written or
//! as half floats. The same parse serves to skip a block and to decode it.

use half::f16;
use half::slice::HalfFloatSliceExt;

use crate::codec::{self, CodecError, Scratch};
use crate::error::{Error, Result};
use crate::source::Cursor;

const COMPRESS_ZIP: u32 = 1;
const COMPRESS_ACTIVE_MASK: u32 = 2;
const COMPRESS_BLOSC: u32 = 4;

// The first byte of a block.
const MINUS_BACKGROUND: u8 = 1;
const ONE_INACTIVE_VALUE: u8 = 2;
const MASK_OF_BACKGROUNDS: u8 = 3;
const MASK_AND_ONE_INACTIVE_VALUE: u8 = 4;
const MASK_AND_TWO_INACTIVE_VALUES: u8 = 5;
const ALL_VALUES: u8 = 6;

/// How a grid's values are written: the compression flags of the file and the width of a value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Compression {
    flags: u32,
}

impl Compression {
    pub(crate) fn read(cursor: &mut Cursor<'_>) -> Result<Self> {
        let flags = cursor.u32("compression flags")?;
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

/// The width of the values in a file, in bytes.
#[derive(Debug, Clone, Copy)]
pub(crate) struct ValueLayout {
    /// A value as it stands alone: background, tiles of the root, inactive values.
    pub(crate) value_bytes: usize,
    /// A value inside a block: smaller if the grid is saved as half.
    pub(crate) stored_bytes: usize,
}

impl ValueLayout {
    /// The layout of a value type, `None` if the type has no fixed-size blocks or is not known.
    pub(crate) fn of(value_type: &str, saved_as_half: bool) -> Option<Self> {
        let (value_bytes, half_bytes) = match value_type {
            "float" => (4, 2),
            "double" => (8, 2),
            "vec3s" => (12, 6),
            "vec3d" => (24, 6),
            "int32" => (4, 4),
            "int64" => (8, 8),
            "vec3i" => (12, 12),
            _ => return None,
        };
        let stored_bytes = if saved_as_half { half_bytes } else { value_bytes };
        Some(ValueLayout { value_bytes, stored_bytes })
    }
}

/// A parsed block, its parts still as in the file.
pub(crate) struct Block<'a> {
    kind: u8,
    inactive: [&'a [u8]; 2],
    selection: &'a [u8],
    stored_count: usize,
    payload: Payload<'a>,
    /// Where the payload begins in the file.
    offset: u64,
}

enum Payload<'a> {
    Raw(&'a [u8]),
    Zip(&'a [u8]),
    Blosc(&'a [u8]),
}

/// Parses the block of a node with `slots` values of which `active` are active.
pub(crate) fn parse<'a>(
    cursor: &mut Cursor<'a>,
    compression: Compression,
    layout: ValueLayout,
    slots: usize,
    active: usize,
) -> Result<Block<'a>> {
    let kind = cursor.u8("a block's first byte")?;
    if kind > ALL_VALUES {
        return Err(cursor.malformed(format!("{kind} does not say how inactive values are stored")));
    }
    let mut inactive: [&[u8]; 2] = [&[], &[]];
    if matches!(kind, ONE_INACTIVE_VALUE | MASK_AND_ONE_INACTIVE_VALUE | MASK_AND_TWO_INACTIVE_VALUES) {
        inactive[0] = cursor.take(layout.value_bytes, "an inactive value")?;
    }
    if kind == MASK_AND_TWO_INACTIVE_VALUES {
        inactive[1] = cursor.take(layout.value_bytes, "an inactive value")?;
    }
    let has_selection =
        matches!(kind, MASK_OF_BACKGROUNDS | MASK_AND_ONE_INACTIVE_VALUE | MASK_AND_TWO_INACTIVE_VALUES);
    let selection = cursor.take(if has_selection { slots / 8 } else { 0 }, "a selection mask")?;
    let stored_count = if compression.active_mask() && kind != ALL_VALUES { active } else { slots };
    let stored_bytes = stored_count * layout.stored_bytes;
    // A half-saved block of no values has no payload at all; every other compressed one has at least a size.
    let no_payload = stored_count == 0 && layout.stored_bytes != layout.value_bytes;
    let codec = if no_payload { "none" } else { compression.codec() };
    let mut offset = cursor.offset();
    let payload = if codec == "none" {
        Payload::Raw(cursor.take(stored_bytes, "the values of a node")?)
    } else {
        // A size that is not positive marks values that did not shrink and stand there as they are.
        let size = cursor.i64("the size of a compressed block")?;
        offset = cursor.offset();
        let len = usize::try_from(size.unsigned_abs()).unwrap_or(usize::MAX);
        if size <= 0 && len != stored_bytes {
            return Err(cursor.malformed(format!("a block of {len} bytes where {stored_bytes} are expected")));
        }
        let bytes = cursor.take(len, "a compressed block")?;
        match codec {
            _ if size <= 0 => Payload::Raw(bytes),
            "zip" => Payload::Zip(bytes),
            _ => Payload::Blosc(bytes),
        }
    };
    Ok(Block { kind, inactive, selection, stored_count, payload, offset })
}

impl Block<'_> {
    /// Decodes the values of a float node into `out`, one per slot.
    pub(crate) fn decode_f32(
        &self,
        layout: ValueLayout,
        background: f32,
        value_mask: &[u64],
        out: &mut [f32],
        scratch: &mut DecodeScratch,
    ) -> Result<()> {
        let DecodeScratch { codec, bytes, halves, packed } = scratch;
        bytes.resize(self.stored_count * layout.stored_bytes, 0);
        let stored: &[u8] = match self.payload {
            Payload::Raw(raw) => raw,
            Payload::Zip(data) => {
                codec::zlib::decompress(data, bytes, codec).map_err(|e| self.codec_error(e))?;
                bytes
            }
            Payload::Blosc(chunk) => {
                codec::blosc::decompress(chunk, bytes, codec).map_err(|e| self.codec_error(e))?;
                bytes
            }
        };
        let mut to_f32 = |values: &mut [f32]| match layout.stored_bytes {
            2 => halves_to_f32(stored, values, halves),
            _ => words_to_f32(stored, values),
        };
        if self.stored_count == out.len() {
            to_f32(out);
            return Ok(());
        }
        packed.resize(self.stored_count, 0.0);
        to_f32(packed);
        let [inactive0, inactive1] = self.inactive_f32(background);
        let selection = |word: usize| {
            self.selection
                .get(word * 8..word * 8 + 8)
                .map_or(0, |b| u64::from_le_bytes(b.try_into().expect("eight bytes")))
        };
        let mut active = packed.iter();
        for (word, slots) in out.chunks_mut(64).enumerate() {
            let (on, select) = (value_mask.get(word).copied().unwrap_or(0), selection(word));
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
    fn inactive_f32(&self, background: f32) -> [f32; 2] {
        let stored = |i: usize| {
            let bytes: Option<[u8; 4]> = self.inactive[i].try_into().ok();
            bytes.map(f32::from_le_bytes)
        };
        let first = match self.kind {
            MINUS_BACKGROUND | MASK_OF_BACKGROUNDS => -background,
            _ => stored(0).unwrap_or(background),
        };
        [first, stored(1).unwrap_or(background)]
    }

    fn codec_error(&self, error: CodecError) -> Error {
        match error {
            CodecError::Malformed(what) => Error::malformed(self.offset, what),
            CodecError::Unsupported(feature) => {
                Error::unsupported(format!("{feature} (at byte {})", self.offset))
            }
        }
    }
}

/// Buffers that one thread reuses over many blocks.
#[derive(Default)]
pub(crate) struct DecodeScratch {
    codec: Scratch,
    bytes: Vec<u8>,
    halves: Vec<f16>,
    packed: Vec<f32>,
}

fn words_to_f32(bytes: &[u8], out: &mut [f32]) {
    for (value, chunk) in out.iter_mut().zip(bytes.chunks_exact(4)) {
        *value = f32::from_le_bytes(chunk.try_into().expect("four bytes"));
    }
}

fn halves_to_f32(bytes: &[u8], out: &mut [f32], halves: &mut Vec<f16>) {
    halves.clear();
    halves.extend(bytes.chunks_exact(2).map(|b| f16::from_le_bytes(b.try_into().expect("two bytes"))));
    // Both have one entry per value; the length is matched because the conversion insists on it.
    halves.resize(out.len(), f16::ZERO);
    halves.convert_to_f32_slice(out);
}
