//! The bytes of one leaf or inner node, and the statistics that go up to its parent.
//!
//! Where the nodes stand among each other is laid out in `build`.

use super::layout::{self, Kind, Layout, NodeLayout};
use super::quantize::{self, Quantizer};
use super::stats::{NanoValue, NodeStats};
use crate::stats::{IndexBox, grow_to_leaf};
use crate::tree::{Branching, InternalNode, Tree};
use crate::value::{LeafValues, Value};

/// Copies bytes to a place.
pub(super) fn put(bytes: &mut [u8], at: usize, what: &[u8]) {
    bytes[at..at + what.len()].copy_from_slice(what);
}

/// Copies the two corners of a box to a place.
pub(super) fn put_box(bytes: &mut [u8], at: usize, corners: [[i32; 3]; 2]) {
    for (i, c) in corners.as_flattened().iter().enumerate() {
        put(bytes, at + 4 * i, &c.to_le_bytes());
    }
}

fn put_words(bytes: &mut [u8], at: usize, words: impl Iterator<Item = u64>) {
    for (i, word) in words.enumerate() {
        put(bytes, at + 8 * i, &word.to_le_bytes());
    }
}

/// Writes a leaf in full width to bytes that are zero.
pub(super) fn leaf<V: NanoValue>(tree: &Tree<V>, i: usize, bytes: &mut [u8]) -> NodeStats<V> {
    let (mask, stored) = (tree.leaves.mask(i), tree.leaves.stored(i));
    let bbox = leaf_head(tree, i, 0, bytes);
    match V::leaf(stored) {
        LeafValues::Plain(values) => {
            let layout = Layout::of(V::KIND);
            let mut encoded = Vec::with_capacity(values.len() * V::SIZE_BYTES);
            V::encode(values, false, &mut encoded);
            put(bytes, layout.leaf_values, &encoded);
            let stats = NodeStats::of_voxels(active(mask).map(|offset| values[offset]), bbox);
            stats.write_to(bytes, layout.leaf_stats);
            stats
        }
        LeafValues::Bits(words) => {
            put_words(bytes, layout::LEAF_AFTER_MASK, words.iter().copied());
            NodeStats::of_voxels(std::iter::empty(), bbox)
        }
        LeafValues::Mask => NodeStats::of_voxels(std::iter::empty(), bbox),
    }
}

/// Writes a leaf as codes to bytes that are zero. Its statistics are those of the values that the codes stand
/// for.
pub(super) fn quantised_leaf(
    tree: &Tree<f32>,
    i: usize,
    kind: Kind,
    quantizer: &Quantizer,
    bytes: &mut [u8],
) -> NodeStats<f32> {
    let (mask, values) = (tree.leaves.mask(i), tree.leaves.stored(i));
    let flags = if kind == Kind::FpN { (quantizer.bits.trailing_zeros() as u8) << 5 } else { 0 };
    let bbox = leaf_head(tree, i, flags, bytes);
    let Quantizer { minimum, quantum, bits, .. } = *quantizer;
    put(bytes, layout::LEAF_AFTER_MASK, &minimum.to_le_bytes());
    put(bytes, layout::LEAF_AFTER_MASK + 4, &quantum.to_le_bytes());
    let all = values.iter().map(|value| quantizer.code(*value));
    quantize::pack(all, bits, &mut bytes[layout::LEAF_CODES..]);
    let stats = NodeStats::of_voxels(active(mask).map(|offset| quantizer.round(values[offset])), bbox);
    if let (Some([min, max]), 0.0..) = (stats.range, quantum) {
        let quanta = |x: f64| (x / f64::from(quantum) + 0.5) as u16;
        let above = |x: f64| quanta(x - f64::from(minimum));
        let codes = [above(min.into()), above(max.into()), above(stats.average()), quanta(stats.deviation())];
        put_codes(bytes, codes);
    }
    stats
}

/// Writes smallest, largest, average value and deviation of a quantised leaf.
fn put_codes(bytes: &mut [u8], codes: [u16; 4]) {
    for (i, code) in codes.iter().enumerate() {
        put(bytes, layout::LEAF_AFTER_MASK + 8 + 2 * i, &code.to_le_bytes());
    }
}

/// The offsets of the active voxels of a leaf.
fn active(mask: &[u64]) -> impl Iterator<Item = usize> + Clone {
    (0..mask.len() * 64).filter(|offset| mask[offset / 64] >> (offset % 64) & 1 == 1)
}

/// Writes what all leaves begin with. Gives the box of the active voxels.
fn leaf_head<V: Value>(tree: &Tree<V>, i: usize, flags: u8, bytes: &mut [u8]) -> Option<IndexBox> {
    let (origin, mask) = (tree.leaves.origins[i], tree.leaves.mask(i));
    let mut bbox = None;
    grow_to_leaf(&mut bbox, origin, mask, 3);
    let [min, max] = bbox.unwrap_or([origin, origin]);
    for axis in 0..3 {
        put(bytes, 4 * axis, &min[axis].to_le_bytes());
        bytes[layout::LEAF_BOX_SIZE + axis] = max[axis].wrapping_sub(min[axis]) as u8;
    }
    bytes[layout::LEAF_FLAGS] = flags | if bbox.is_some() { layout::HAS_ACTIVE_VALUES } else { 0 };
    put_words(bytes, layout::LEAF_MASK, mask.iter().copied());
    bbox
}

/// A node that has been written: where, and what it says to its parent.
#[derive(Debug, Clone, Copy)]
pub(super) struct Written<V> {
    pub(super) at: usize,
    pub(super) stats: NodeStats<V>,
}

/// Writes an inner node that stands at `at` to bytes that are zero. Its children are given in the order of
/// the mask. Gives its statistics and the number of its active tiles.
pub(super) fn node<V: NanoValue>(
    node: &InternalNode<V>,
    branching: Branching,
    places: &NodeLayout,
    children: &[Written<V>],
    at: usize,
    bytes: &mut [u8],
) -> (Written<V>, u64) {
    let mut stats = NodeStats::default();
    let mut children = children.iter();
    let mut encoded = Vec::with_capacity(24);
    let mut active_tiles = 0;
    for slot in 0..places.slots {
        encoded.clear();
        if node.child_mask.contains(slot) {
            if let Some(child) = children.next() {
                encoded.extend_from_slice(&(child.at as i64 - at as i64).to_le_bytes());
                stats.add(&child.stats);
            }
        } else {
            let value = node.tiles.value(slot);
            value.append_to(&mut encoded);
            if node.value_mask.contains(slot) {
                let origin = branching.child_origin(node.origin, slot);
                stats.add(&NodeStats::of_tile(value, origin, branching.log2_child_voxels));
                active_tiles += 1;
            }
        }
        put(bytes, places.table + slot * places.slot_bytes, &encoded);
    }
    // An empty box still says where the node stands.
    put_box(bytes, 0, stats.bbox.unwrap_or([node.origin, [i32::MIN; 3]]));
    let has_active = stats.bbox.is_some();
    bytes[layout::NODE_FLAGS] =
        if has_active { layout::HAS_ACTIVE_VALUES } else { layout::NOT_TO_BE_RENDERED };
    let child_words = node.child_mask.words().iter().copied();
    let tile_words = node.value_mask.words().iter().zip(child_words.clone()).map(|(on, child)| on & !child);
    put_words(bytes, places.value_mask, tile_words);
    put_words(bytes, places.child_mask, child_words);
    if V::HAS_STATS {
        stats.write_to(bytes, places.stats);
    }
    (Written { at, stats }, active_tiles)
}
