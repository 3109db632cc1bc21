//! Value blocks as they are written: which of the seven kinds fits a node, and its payload.
//!
//! The grammar of blocks stands in [`crate::block`]. Values are compared by their bits, so that NaN and −0
//! come back as they were; OpenVDB compares them as numbers, but reads what is written here.

use crate::block::{
    ALL_VALUES, BACKGROUND, BlockFormat, MASK_AND_ONE_INACTIVE_VALUE, MASK_AND_TWO_INACTIVE_VALUES,
    MASK_OF_BACKGROUNDS, MINUS_BACKGROUND, ONE_INACTIVE_VALUE,
};
use crate::codec::{self, EncodeScratch};
use crate::mask::bits;
use crate::value::Value;

/// Encodes blocks one after the other, with buffers that it keeps.
pub(super) struct BlockEncoder<V> {
    format: BlockFormat,
    /// The background as readers will know it.
    background: V,
    packed: Vec<V>,
    raw: Vec<u8>,
    codec: EncodeScratch,
}

/// How inactive values are restored.
struct Inactive<V> {
    kind: u8,
    /// The values that the block holds.
    stored: [Option<V>; 2],
    /// Whether the selection mask marks the first of the two values met, not the second.
    marks_first: bool,
}

/// The distinct inactive values of a node.
enum Distinct<V> {
    None,
    One(V),
    /// And for each word of slots, where the second one is.
    Two([V; 2], Vec<u64>),
    More,
}

impl<V: Value> BlockEncoder<V> {
    pub(super) fn new(format: BlockFormat, background: V) -> Self {
        BlockEncoder {
            format,
            background: rounded(background, format.half),
            packed: Vec::new(),
            raw: Vec::new(),
            codec: EncodeScratch::default(),
        }
    }

    /// Appends the block of a node: its values, one per slot, of which those in `children` say nothing. A
    /// mask that is too short has no bits behind its end.
    pub(super) fn append(&mut self, values: &[V], active: &[u64], children: &[u64], out: &mut Vec<u8>) {
        let all_values = || Inactive { kind: ALL_VALUES, stored: [None; 2], marks_first: false };
        let mut selection = Vec::new();
        let inactive = match self.format.compression.active_mask() {
            false => all_values(),
            true => match distinct_inactive(values, active, children) {
                Distinct::None => self.one(self.background),
                Distinct::One(value) => self.one(rounded(value, self.format.half)),
                Distinct::Two(two, second) => {
                    selection = second;
                    self.two(two.map(|value| rounded(value, self.format.half)))
                }
                Distinct::More => all_values(),
            },
        };
        out.push(inactive.kind);
        inactive.stored.iter().flatten().for_each(|value| value.append_to(out));
        if matches!(
            inactive.kind,
            MASK_OF_BACKGROUNDS | MASK_AND_ONE_INACTIVE_VALUE | MASK_AND_TWO_INACTIVE_VALUES
        ) {
            if inactive.marks_first {
                for (i, word) in selection.iter_mut().enumerate() {
                    *word = !(*word | word_of(active, i) | word_of(children, i));
                }
            }
            append_mask(&selection, values.len(), out);
        }
        if inactive.kind == ALL_VALUES {
            return self.append_payload(values, out);
        }
        self.packed.clear();
        for (i, slots) in values.chunks(64).enumerate() {
            match word_of(active, i) {
                u64::MAX => self.packed.extend_from_slice(slots),
                word => self.packed.extend(bits(word).filter_map(|bit| slots.get(bit))),
            }
        }
        let packed = std::mem::take(&mut self.packed);
        self.append_payload(&packed, out);
        self.packed = packed;
    }

    fn one(&self, value: V) -> Inactive<V> {
        let (kind, stored) = if value.same_bits(self.background) {
            (BACKGROUND, None)
        } else if value.same_bits(self.background.negative()) {
            (MINUS_BACKGROUND, None)
        } else {
            (ONE_INACTIVE_VALUE, Some(value))
        };
        Inactive { kind, stored: [stored, None], marks_first: false }
    }

    /// The selection mask marks the background if that is one of the two.
    fn two(&self, [first, second]: [V; 2]) -> Inactive<V> {
        if first.same_bits(second) {
            // Only half floats cannot tell them apart.
            return self.one(first);
        }
        let (marks_first, other) = match () {
            () if second.same_bits(self.background) => (false, first),
            () if first.same_bits(self.background) => (true, second),
            () => {
                let stored = [Some(first), Some(second)];
                return Inactive { kind: MASK_AND_TWO_INACTIVE_VALUES, stored, marks_first: false };
            }
        };
        if other.same_bits(self.background.negative()) {
            return Inactive { kind: MASK_OF_BACKGROUNDS, stored: [None; 2], marks_first };
        }
        Inactive { kind: MASK_AND_ONE_INACTIVE_VALUE, stored: [Some(other), None], marks_first }
    }

    /// Appends the stored values, compressed if that makes them smaller.
    fn append_payload(&mut self, values: &[V], out: &mut Vec<u8>) {
        let half = self.format.half && V::HALF_BYTES != V::SIZE_BYTES;
        if values.is_empty() && half {
            // Nothing at all, not even a size.
            return;
        }
        let codec = self.format.compression.codec();
        if codec == "none" {
            return V::encode(values, half, out);
        }
        self.raw.clear();
        V::encode(values, half, &mut self.raw);
        let size_at = out.len();
        out.extend_from_slice(&[0; 8]);
        let number_bytes = self.format.stored_bytes::<V>() / V::COMPONENTS;
        let shrunk = match codec {
            "blosc" => codec::blosc_encoder::compress(&self.raw, number_bytes, out, &mut self.codec),
            _ => codec::zlib::compress(&self.raw, out, &mut self.codec),
        };
        let size = match shrunk {
            true => (out.len() - size_at - 8) as i64,
            false => {
                out.extend_from_slice(&self.raw);
                // A size below zero marks values as they are.
                -(self.raw.len() as i64)
            }
        };
        out[size_at..size_at + 8].copy_from_slice(&size.to_le_bytes());
    }
}

/// The value as it comes back.
pub(super) fn rounded<V: Value>(value: V, half: bool) -> V {
    if !half || V::HALF_BYTES == V::SIZE_BYTES {
        return value;
    }
    let (mut bytes, mut back) = (Vec::new(), [value]);
    V::encode(&[value], true, &mut bytes);
    V::decode(&bytes, true, &mut back);
    back[0]
}

/// Appends a mask as files hold it, a bit per slot.
pub(super) fn append_mask(words: &[u64], slots: usize, out: &mut Vec<u8>) {
    let end = out.len() + slots / 8;
    words.iter().for_each(|word| out.extend_from_slice(&word.to_le_bytes()));
    out.resize(end, 0);
}

fn word_of(mask: &[u64], i: usize) -> u64 {
    mask.get(i).copied().unwrap_or(0)
}

fn distinct_inactive<V: Value>(values: &[V], active: &[u64], children: &[u64]) -> Distinct<V> {
    let mut first = None;
    let mut second = None;
    let mut selection = Vec::new();
    for (i, slots) in values.chunks(64).enumerate() {
        let mut left = !(word_of(active, i) | word_of(children, i));
        if slots.len() < 64 {
            left &= (1 << slots.len()) - 1;
        }
        if left == 0 {
            continue;
        }
        let first = *first.get_or_insert_with(|| slots[left.trailing_zeros() as usize]);
        left &= !equal(slots, first);
        if left == 0 {
            continue;
        }
        if second.is_none() {
            selection.resize(values.len().div_ceil(64), 0);
        }
        let second = *second.get_or_insert_with(|| slots[left.trailing_zeros() as usize]);
        selection[i] = left & equal(slots, second);
        if left != selection[i] {
            return Distinct::More;
        }
    }
    match (first, second) {
        (Some(first), Some(second)) => Distinct::Two([first, second], selection),
        (Some(first), None) => Distinct::One(first),
        _ => Distinct::None,
    }
}

/// Which of up to 64 values equal another one to the bit.
fn equal<V: Value>(values: &[V], other: V) -> u64 {
    values.iter().enumerate().fold(0, |mask, (bit, value)| mask | u64::from(value.same_bits(other)) << bit)
}
