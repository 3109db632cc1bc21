//! Trees as they are written: all nodes depth first, then all leaf values in the same order.
//!
//! Before that, the check that a tree's vectors fit each other, since anyone can fill them.

use super::block::{BlockEncoder, append_mask, rounded};
use super::parallel::in_order;
use crate::block::BlockFormat;
use crate::mask::bits;
use crate::tree::{InternalNode, Leaves, Tiles, Tree};
use crate::value::{LeafValues, Value};

/// How many leaves a thread encodes at a time.
const LEAVES_PER_TASK: usize = 64;

/// A tree as a file holds it.
#[derive(Default)]
pub(super) struct EncodedTree {
    pub(super) topology: Vec<u8>,
    /// The leaves in order, some in each piece.
    pub(super) leaves: Vec<Box<[u8]>>,
}

impl EncodedTree {
    pub(super) fn leaves_bytes(&self) -> u64 {
        self.leaves.iter().map(|leaves| leaves.len() as u64).sum()
    }
}

/// Whether the vectors fit each other: their lengths, every node at its place, every node with one parent. If not,
/// what is wrong.
pub(super) fn check<V: Value>(tree: &Tree<V>) -> Result<(), String> {
    let ensure = |holds: bool, what: &str| if holds { Ok(()) } else { Err(what.to_owned()) };
    let (shape, leaves) = (tree.shape, &tree.leaves);
    ensure(tree.levels.len() == shape.inner_levels(), "its levels are not those of its shape")?;
    ensure(leaves.leaf_voxels == shape.leaf_voxels(), "its leaves are not of its shape")?;
    let per_leaf = V::stored_per_leaf(leaves.leaf_voxels);
    ensure(
        Some(leaves.masks.len()) == leaves.len().checked_mul(leaves.mask_words()),
        "a mask of a leaf lacks",
    )?;
    ensure(Some(leaves.values.len()) == leaves.len().checked_mul(per_leaf), "values of a leaf lack")?;
    if leaves.leaf_voxels < 64 {
        let fits = leaves.masks.iter().all(|word| word >> leaves.leaf_voxels == 0);
        ensure(fits, "a mask of a leaf has bits behind its end")?;
    }
    let origins_of = |level: usize| -> Box<dyn Fn(usize) -> Option<[i32; 3]> + '_> {
        match tree.levels.get(level) {
            Some(nodes) => Box::new(|i| nodes.get(i).map(|node| node.origin)),
            None => Box::new(|i| leaves.origins.get(i).copied()),
        }
    };
    let count_of = |level: usize| tree.levels.get(level).map_or(leaves.len(), Vec::len);
    for (level, nodes) in tree.levels.iter().enumerate() {
        let branching = shape.branching(level);
        let child_origin = origins_of(level + 1);
        let mut children = 0;
        for node in nodes {
            let lengths = [node.child_mask.len(), node.value_mask.len()];
            ensure(lengths == [branching.slots(); 2], "a mask of a node has the wrong length")?;
            if let Tiles::PerSlot(values) = &node.tiles {
                ensure(values.len() == branching.slots(), "tiles of a node lack")?;
            }
            children += node.child_mask.count();
            for (i, slot) in node.child_mask.iter().enumerate() {
                let child = node.first_child.checked_add(i).and_then(&child_origin);
                let origin = branching.child_origin(node.origin, slot);
                ensure(child == Some(origin), "a child of a node is not where it should be")?;
            }
        }
        ensure(children == count_of(level + 1), "a node has no parent, or two")?;
    }
    let root_origin = origins_of(0);
    let mut root_origins: Vec<[i32; 3]> = (0..count_of(0)).filter_map(root_origin).collect();
    root_origins.extend(tree.root_tiles.iter().map(|tile| tile.origin));
    let aligned = root_origins.iter().all(|origin| shape.root_origin(*origin) == *origin);
    ensure(aligned, "an entry of the root is not where entries can be")?;
    root_origins.sort_unstable();
    ensure(root_origins.is_sorted_by(|a, b| a < b), "two entries of the root stand at the same place")?;
    ensure(u32::try_from(root_origins.len()).is_ok(), "the root has over 2³² entries")
}

/// A number that changes when the tree does.
pub(super) fn content_hash<V: Value>(tree: &Tree<V>) -> u64 {
    let leaves = &tree.leaves;
    let mut hash = mix(0, tree.background.hash_bits());
    for tile in &tree.root_tiles {
        hash = coord_hash(hash, tile.origin);
        hash = mix(mix(hash, tile.value.hash_bits()), tile.active.into());
    }
    for nodes in &tree.levels {
        let of_nodes = in_order(nodes.len(), || (), |(), i| node_hash(&nodes[i]));
        hash = of_nodes.into_iter().fold(hash, mix);
    }
    let tasks = leaves.len().div_ceil(LEAVES_PER_TASK);
    let of_leaves = in_order(
        tasks,
        || (),
        |(), task| {
            let range = range_of(task, leaves.len());
            let mut hash = range.clone().fold(0, |hash, i| coord_hash(hash, leaves.origins[i]));
            for i in range {
                hash = lanes_hash(hash, leaves.mask(i), |word| *word);
                hash = match V::leaf(leaves.stored(i)) {
                    LeafValues::Plain(values) => lanes_hash(hash, values, |value| value.hash_bits()),
                    LeafValues::Bits(words) => lanes_hash(hash, words, |word| *word),
                    LeafValues::Mask => hash,
                };
            }
            hash
        },
    );
    of_leaves.into_iter().fold(hash, mix)
}

/// What stands at children makes no difference, since it is not written.
fn node_hash<V: Value>(node: &InternalNode<V>) -> u64 {
    let mut hash = coord_hash(0, node.origin);
    for (child, on) in node.child_mask.words().iter().zip(node.value_mask.words()) {
        hash = mix(mix(hash, *child), on & !child);
    }
    match &node.tiles {
        Tiles::Uniform(value) => mix(hash, value.hash_bits()),
        Tiles::PerSlot(values) => {
            let words = values.chunks(64).zip(node.child_mask.words());
            words.fold(hash, |hash, (values, children)| match children {
                0 => lanes_hash(hash, values, |value| value.hash_bits()),
                _ => bits(!children)
                    .filter_map(|i| values.get(i))
                    .fold(hash, |h, value| mix(h, value.hash_bits())),
            })
        }
    }
}

fn mix(hash: u64, bits: u64) -> u64 {
    (hash ^ bits).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29)
}

fn coord_hash(hash: u64, coord: [i32; 3]) -> u64 {
    coord.iter().fold(hash, |hash, c| mix(hash, *c as u64))
}

/// Four chains, since one would wait for each of its multiplications.
fn lanes_hash<T>(hash: u64, items: &[T], bits: impl Fn(&T) -> u64) -> u64 {
    let (fours, rest) = items.as_chunks::<4>();
    let mut lanes = [hash, 1, 2, 3];
    for four in fours {
        for (lane, item) in lanes.iter_mut().zip(four) {
            *lane = mix(*lane, bits(item));
        }
    }
    let rest = rest.iter().fold(0, |hash, item| mix(hash, bits(item)));
    lanes.iter().fold(rest, |hash, lane| mix(hash, *lane))
}

fn range_of(task: usize, count: usize) -> std::ops::Range<usize> {
    let begin = task * LEAVES_PER_TASK;
    begin..count.min(begin + LEAVES_PER_TASK)
}

/// Encodes a tree that has been checked.
pub(super) fn encode<V: Value>(tree: &Tree<V>, format: BlockFormat) -> EncodedTree {
    EncodedTree { topology: topology(tree, format), leaves: leaves(tree, format) }
}

fn topology<V: Value>(tree: &Tree<V>, format: BlockFormat) -> Vec<u8> {
    let nodes: Vec<Vec<Box<[u8]>>> =
        (0..tree.levels.len()).map(|level| level_nodes(tree, format, level)).collect();
    let leaf_mask_bytes = tree.leaves.leaf_voxels / 8;
    let nodes_bytes: usize = nodes.iter().flatten().map(|node| node.len()).sum();
    let root_bytes = 64 + 12 * tree.levels.first().map_or(tree.leaves.len(), Vec::len);
    let tiles_bytes = tree.root_tiles.len() * (13 + V::SIZE_BYTES);
    let mut out =
        Vec::with_capacity(nodes_bytes + tree.leaves.len() * leaf_mask_bytes + root_bytes + tiles_bytes);
    // The number of buffers.
    out.extend_from_slice(&1_u32.to_le_bytes());
    rounded(tree.background, format.half).append_to(&mut out);
    let root_children = tree.levels.first().map_or(tree.leaves.len(), Vec::len);
    for count in [tree.root_tiles.len(), root_children] {
        out.extend_from_slice(&(count as u32).to_le_bytes());
    }
    for tile in &tree.root_tiles {
        append_coord(tile.origin, &mut out);
        tile.value.append_to(&mut out);
        out.push(tile.active.into());
    }
    for i in 0..root_children {
        append_coord(
            tree.levels.first().map_or_else(|| tree.leaves.origins[i], |nodes| nodes[i].origin),
            &mut out,
        );
        append_branch(tree, &nodes, 0, i, &mut out);
    }
    out
}

/// The bytes of each node of a level, without its children.
fn level_nodes<V: Value>(tree: &Tree<V>, format: BlockFormat, level: usize) -> Vec<Box<[u8]>> {
    let nodes = &tree.levels[level];
    let slots = tree.shape.branching(level).slots();
    let scratch = || (BlockEncoder::new(format, tree.background), vec![V::default(); slots], Vec::new());
    in_order(nodes.len(), scratch, |(block, values, out), i| {
        let node = &nodes[i];
        let children = node.child_mask.words();
        // At children active states say nothing here, but OpenVDB expects none.
        let active: Vec<u64> =
            node.value_mask.words().iter().zip(children).map(|(on, child)| on & !child).collect();
        match &node.tiles {
            Tiles::Uniform(value) => values.fill(*value),
            Tiles::PerSlot(tiles) => values.copy_from_slice(tiles),
        }
        for slot in node.child_mask.iter() {
            values[slot] = V::default();
        }
        out.clear();
        append_mask(children, slots, out);
        append_mask(&active, slots, out);
        block.append(values, &active, children, out);
        Box::from(out.as_slice())
    })
}

/// Appends a node and all below it.
fn append_branch<V: Value>(
    tree: &Tree<V>,
    nodes: &[Vec<Box<[u8]>>],
    level: usize,
    i: usize,
    out: &mut Vec<u8>,
) {
    let Some(encoded) = nodes.get(level) else {
        return append_mask(tree.leaves.mask(i), tree.leaves.leaf_voxels, out);
    };
    out.extend_from_slice(&encoded[i]);
    tree.levels[level][i].children().for_each(|child| append_branch(tree, nodes, level + 1, child, out));
}

fn leaves<V: Value>(tree: &Tree<V>, format: BlockFormat) -> Vec<Box<[u8]>> {
    let order = tree.leaf_order();
    let scratch = || (BlockEncoder::new(format, tree.background), Vec::new());
    in_order(order.len().div_ceil(LEAVES_PER_TASK), scratch, |(block, out), task| {
        out.clear();
        for leaf in &order[range_of(task, order.len())] {
            append_leaf(&tree.leaves, *leaf, block, out);
        }
        Box::from(out.as_slice())
    })
}

fn append_leaf<V: Value>(leaves: &Leaves<V>, leaf: usize, block: &mut BlockEncoder<V>, out: &mut Vec<u8>) {
    let mask = leaves.mask(leaf);
    append_mask(mask, leaves.leaf_voxels, out);
    match V::leaf(leaves.stored(leaf)) {
        LeafValues::Plain(values) => block.append(values, mask, &[], out),
        LeafValues::Bits(words) => {
            append_coord(leaves.origins[leaf], out);
            append_mask(words, leaves.leaf_voxels, out);
        }
        LeafValues::Mask => append_coord(leaves.origins[leaf], out),
    }
}

fn append_coord(coord: [i32; 3], out: &mut Vec<u8>) {
    coord.iter().for_each(|c| out.extend_from_slice(&c.to_le_bytes()));
}
