//! From a grid's bytes to its tree.
//!
//! Nodes are found by offsets that nobody has checked. Each is followed from the level above and only ever
//! downward, so that there are no cycles, and more nodes than the grid's bytes could hold are refused, so
//! that a node that is named again and again does not grow without bound. Where a node stands in space
//! follows from its parent; the boxes in the file, which NanoVDB leaves without an origin in nodes without
//! active values, are not used.

use super::layout::{self, Kind, Layout, NodeLayout};
use super::quantize;
use crate::any::AnyTree;
use crate::error::{Error, Result};
use crate::limits::Budget;
use crate::mask::Mask;
use crate::metadata::{MetaValue, Metadata};
use crate::transform::Transform;
use crate::tree::{
    Branching, InternalNode, LEAF_VOXELS, LEVEL4, LEVEL5, Leaves, RootTile, Shape, Tiles, Tree,
};
use crate::value::{LeafValues, Value, ValueMask};

/// How many leaves a thread decodes at a time.
const LEAVES_PER_TASK: usize = 64;

/// Reads a grid from its bytes, which stand at offset `at` of the file.
pub(super) fn grid(
    bytes: &[u8],
    at: u64,
    kind: Kind,
    budget: &mut Budget,
) -> Result<(Transform, Metadata, AnyTree)> {
    let bytes = GridBytes { bytes, at };
    let magic = bytes.u64(0, "a grid")?;
    if magic != layout::MAGIC_OLD && magic != layout::MAGIC_GRID {
        return Err(bytes.malformed(0, "no NanoVDB grid: the magic number is missing"));
    }
    let type_number = bytes.u32(layout::GRID_TYPE, "the type of a grid")?;
    if type_number != kind.number() {
        return Err(
            bytes.malformed(layout::GRID_TYPE, "the type of the grid is not the one that the header says")
        );
    }
    let mut metadata = Metadata::default();
    let class = bytes.u32(layout::GRID_CLASS, "the class of a grid")?;
    if let Some((_, name)) = layout::CLASSES.iter().find(|(number, _)| *number == class) {
        metadata.insert("class", MetaValue::from_text(name));
    }
    let walk = Walk { bytes, kind, layout: Layout::of(kind), budget };
    let tree = match kind {
        Kind::Float => walk.tree::<f32>(f32::from_bytes, plain)?.into(),
        Kind::Double => walk.tree::<f64>(f64::from_bytes, plain)?.into(),
        Kind::Int32 => walk.tree::<i32>(i32::from_bytes, plain)?.into(),
        Kind::Int64 => walk.tree::<i64>(i64::from_bytes, plain)?.into(),
        Kind::Vec3f => walk.tree::<[f32; 3]>(Value::from_bytes, plain)?.into(),
        Kind::Vec3d => walk.tree::<[f64; 3]>(Value::from_bytes, plain)?.into(),
        Kind::Int16 => walk.tree::<i32>(int16, int16s)?.into(),
        Kind::Bool => walk.tree::<bool>(bool::from_bytes, bits)?.into(),
        Kind::Mask => walk.tree::<ValueMask>(ValueMask::from_bytes, |_, _, _| {})?.into(),
        Kind::Fp4 | Kind::Fp8 | Kind::Fp16 | Kind::FpN => walk.tree::<f32>(f32::from_bytes, codes)?.into(),
    };
    Ok((transform(bytes)?, metadata, tree))
}

/// The bytes of a grid, and where they stand in the file.
#[derive(Clone, Copy)]
struct GridBytes<'a> {
    bytes: &'a [u8],
    at: u64,
}

impl<'a> GridBytes<'a> {
    fn malformed(&self, at: usize, what: impl Into<String>) -> Error {
        Error::malformed(self.at.saturating_add(at as u64), what)
    }

    fn slice(&self, at: usize, len: usize, what: &str) -> Result<&'a [u8]> {
        let end = at.checked_add(len);
        end.and_then(|end| self.bytes.get(at..end))
            .ok_or_else(|| self.malformed(at.min(self.bytes.len()), format!("the grid ends before {what}")))
    }

    fn array<const N: usize>(&self, at: usize, what: &str) -> Result<[u8; N]> {
        let mut array = [0; N];
        array.copy_from_slice(self.slice(at, N, what)?);
        Ok(array)
    }

    fn u32(&self, at: usize, what: &str) -> Result<u32> {
        self.array(at, what).map(u32::from_le_bytes)
    }

    fn u64(&self, at: usize, what: &str) -> Result<u64> {
        self.array(at, what).map(u64::from_le_bytes)
    }

    fn f64(&self, at: usize, what: &str) -> Result<f64> {
        self.array(at, what).map(f64::from_le_bytes)
    }

    /// The place that an offset relative to `base` means.
    fn follow(&self, base: usize, offset: i64) -> Result<usize> {
        i64::try_from(base)
            .ok()
            .and_then(|base| usize::try_from(base.checked_add(offset)?).ok())
            .filter(|at| *at < self.bytes.len())
            .ok_or_else(|| self.malformed(base, "a node outside of the grid"))
    }
}

fn transform(bytes: GridBytes<'_>) -> Result<Transform> {
    let mut numbers = [0.0; layout::MAP_TRANSLATION + 3];
    for (i, number) in numbers.iter_mut().enumerate() {
        *number = bytes.f64(layout::GRID_MAP_F64 + 8 * i, "the map of a grid")?;
    }
    // Vectors are columns there and rows here.
    let row = |i: usize| [numbers[i], numbers[3 + i], numbers[6 + i], 0.0];
    let [.., x, y, z] = numbers;
    let matrix = [row(0), row(1), row(2), [x, y, z, 1.0]];
    let uniform = Transform::uniform_scale(matrix[0][0]);
    Ok(if uniform.matrix() == Some(&matrix) { uniform } else { Transform::affine(matrix) })
}

/// What a child of the root or of a node is known by before it is read.
#[derive(Clone, Copy)]
struct Child {
    at: usize,
    origin: [i32; 3],
}

struct Walk<'a, 'b> {
    bytes: GridBytes<'a>,
    kind: Kind,
    layout: Layout,
    budget: &'b mut Budget,
}

/// Decodes the bytes of a leaf, whose values begin at `value_at` if they are plain, into what a tree stores
/// of it.
type DecodeLeaf<V> = fn(leaf: &[u8], value_at: usize, stored: LeafValues<&mut [V], &mut [u64]>);

impl Walk<'_, '_> {
    fn tree<V: Value>(mut self, value: fn(&[u8]) -> V, decode: DecodeLeaf<V>) -> Result<Tree<V>> {
        let Layout { root, upper, lower, .. } = self.layout;
        let bytes = self.bytes;
        let offset = bytes.u64(layout::TREE + 24, "the place of the root")? as i64;
        let root_at = bytes.follow(layout::TREE, offset)?;
        let root_bytes = bytes.slice(root_at, root.bytes, "the end of the root")?;
        let background = value(&root_bytes[root.background..]);
        let mut tree = Tree::empty(background, Shape::STANDARD);

        let tile_count = bytes.u32(root_at + 24, "the root")? as usize;
        let tiles_bytes = tile_count.saturating_mul(root.tile_bytes);
        let tiles = bytes.slice(root_at + root.bytes, tiles_bytes, "the end of the root's tiles")?;
        self.budget.take(tile_count, size_of::<RootTile<V>>() + size_of::<Child>(), "root tiles")?;
        let mut children = Vec::new();
        for tile in tiles.chunks_exact(root.tile_bytes) {
            let number = |at: usize| u64::from_le_bytes(std::array::from_fn(|i| tile[at + i]));
            let (key, offset) = (number(0), number(8) as i64);
            // Each coordinate takes 21 bits of the key, without its lower 12.
            let origin = [42, 21, 0].map(|shift| ((key >> shift) as u32 & 0xf_ffff) << 12).map(|c| c as i32);
            match offset {
                0 => tree.root_tiles.push(RootTile {
                    origin,
                    value: value(&tile[root.tile_value..]),
                    active: number(16) as u32 != 0,
                }),
                _ => children.push(Child { at: bytes.follow(root_at, offset)?, origin }),
            }
        }
        tree.root_tiles.sort_by_key(|tile| tile.origin);
        children.sort_by_key(|child| child.origin);
        let is_child = |origin| children.binary_search_by_key(&origin, |child| child.origin).is_ok();
        if tree.root_tiles.windows(2).any(|pair| pair[0].origin == pair[1].origin)
            || children.windows(2).any(|pair| pair[0].origin == pair[1].origin)
            || tree.root_tiles.iter().any(|tile| is_child(tile.origin))
        {
            return Err(bytes.malformed(root_at, "two entries of the root stand at the same place"));
        }

        for (level, branching, node) in [(0, LEVEL5, upper), (1, LEVEL4, lower)] {
            let mut below = Vec::new();
            self.check_count(children.len(), node.bytes)?;
            for child in children {
                let node = self.node(child, branching, node, background, value, &mut below)?;
                tree.levels[level].push(node);
            }
            children = below;
        }
        self.leaves(&mut tree, &children, decode)?;
        Ok(tree)
    }

    /// Refuses more nodes than there are bytes for.
    fn check_count(&self, nodes: usize, node_bytes: usize) -> Result<()> {
        match nodes.saturating_mul(node_bytes) > self.bytes.bytes.len() {
            true => Err(self.bytes.malformed(0, "nodes that share their place with others")),
            false => Ok(()),
        }
    }

    /// Reads an inner node and appends its children.
    fn node<V: Value>(
        &mut self,
        Child { at, origin }: Child,
        branching: Branching,
        node: NodeLayout,
        background: V,
        value: fn(&[u8]) -> V,
        children: &mut Vec<Child>,
    ) -> Result<InternalNode<V>> {
        let bytes = self.bytes.slice(at, node.bytes, "the end of an inner node")?;
        let mask_bytes = 2 * node.slots / 64 * Mask::BYTES_PER_WORD;
        let table_bytes = node.slots * size_of::<V>();
        self.budget.take(1, size_of::<InternalNode<V>>() + mask_bytes + table_bytes, "inner nodes")?;
        let mask = |at: usize| Mask::new(words(&bytes[at..at + node.slots / 8]).collect(), node.slots);
        let (value_mask, child_mask) = (mask(node.value_mask), mask(node.child_mask));
        let first_child = children.len();
        // Twice for the growth of the vector.
        self.budget.take(child_mask.count(), 2 * size_of::<Child>(), "the places of nodes")?;
        let slot_at = |slot: usize| &bytes[node.table + slot * node.slot_bytes..];
        for slot in child_mask.iter() {
            let offset = i64::from_bytes(slot_at(slot));
            children.push(Child {
                at: self.bytes.follow(at, offset)?,
                origin: branching.child_origin(origin, slot),
            });
        }
        let values: Vec<V> = (0..node.slots).map(|slot| value(slot_at(slot))).collect();
        let tiles = Tiles::pack(&values, &child_mask, background);
        Ok(InternalNode { origin, child_mask, value_mask, tiles, first_child })
    }

    fn leaves<V: Value>(
        &mut self,
        tree: &mut Tree<V>,
        leaves: &[Child],
        decode: DecodeLeaf<V>,
    ) -> Result<()> {
        let fixed_bytes = self.layout.leaf_bytes(self.kind);
        self.check_count(leaves.len(), fixed_bytes)?;
        let per_leaf = V::stored_per_leaf(LEAF_VOXELS);
        let leaf_bytes = 12 + LEAF_VOXELS / 8 + per_leaf * size_of::<V::Stored>();
        self.budget.take(leaves.len(), leaf_bytes, "leaves")?;
        let mut masks = Vec::with_capacity(leaves.len() * 8);
        for leaf in leaves {
            let bytes = self.bytes.slice(leaf.at, fixed_bytes, "the end of a leaf")?;
            masks.extend(words(&bytes[layout::LEAF_MASK..layout::LEAF_AFTER_MASK]));
        }
        let mut values = vec![V::Stored::default(); leaves.len() * per_leaf];
        // Chunks of nothing are not a thing.
        let per_leaf = per_leaf.max(1);
        let (this, value_at) = (&*self, self.layout.leaf_values);
        let decode_some = |leaves: &[Child], stored: &mut [V::Stored]| -> Result<()> {
            for (leaf, stored) in leaves.iter().zip(stored.chunks_mut(per_leaf)) {
                decode(this.leaf_bytes(leaf.at)?, value_at, V::leaf_mut(stored));
            }
            Ok(())
        };
        #[cfg(feature = "parallel")]
        {
            use rayon::prelude::*;
            let tasks = leaves.par_chunks(LEAVES_PER_TASK);
            tasks
                .zip(values.par_chunks_mut(LEAVES_PER_TASK * per_leaf))
                .try_for_each(|(leaves, stored)| decode_some(leaves, stored))?;
        }
        #[cfg(not(feature = "parallel"))]
        for (leaves, stored) in
            leaves.chunks(LEAVES_PER_TASK).zip(values.chunks_mut(LEAVES_PER_TASK * per_leaf))
        {
            decode_some(leaves, stored)?;
        }
        let origins = leaves.iter().map(|leaf| leaf.origin).collect();
        tree.leaves = Leaves { leaf_voxels: LEAF_VOXELS, origins, masks, values };
        Ok(())
    }

    /// All bytes of a leaf, with its codes if it has any.
    fn leaf_bytes(&self, at: usize) -> Result<&[u8]> {
        let fixed_bytes = self.layout.leaf_bytes(self.kind);
        let fixed = self.bytes.slice(at, fixed_bytes, "the end of a leaf")?;
        if self.kind != Kind::FpN {
            return Ok(fixed);
        }
        match fixed[layout::LEAF_FLAGS] >> 5 {
            log2 @ 0..=4 => {
                let code_bytes = layout::code_bytes(1 << log2);
                self.bytes.slice(at, fixed_bytes + code_bytes, "the end of a leaf")
            }
            log2 => Err(self.bytes.malformed(at, format!("codes of 2^{log2} bits"))),
        }
    }
}

/// Words of 64 bits.
fn words(bytes: &[u8]) -> impl Iterator<Item = u64> {
    bytes.as_chunks().0.iter().map(|word| u64::from_le_bytes(*word))
}

fn plain<V: Value>(leaf: &[u8], value_at: usize, stored: LeafValues<&mut [V], &mut [u64]>) {
    if let LeafValues::Plain(values) = stored {
        V::decode(&leaf[value_at..], false, values);
    }
}

fn int16(bytes: &[u8]) -> i32 {
    i16::from_le_bytes([bytes[0], bytes[1]]).into()
}

fn int16s(leaf: &[u8], value_at: usize, stored: LeafValues<&mut [i32], &mut [u64]>) {
    if let LeafValues::Plain(values) = stored {
        for (value, bytes) in values.iter_mut().zip(leaf[value_at..].chunks_exact(2)) {
            *value = int16(bytes);
        }
    }
}

fn bits(leaf: &[u8], _value_at: usize, stored: LeafValues<&mut [bool], &mut [u64]>) {
    if let LeafValues::Bits(out) = stored {
        for (out, word) in out.iter_mut().zip(words(&leaf[layout::LEAF_AFTER_MASK..])) {
            *out = word;
        }
    }
}

/// Decodes a quantised leaf. How many bits its codes have follows from how many bytes they take.
fn codes(leaf: &[u8], _value_at: usize, stored: LeafValues<&mut [f32], &mut [u64]>) {
    let LeafValues::Plain(values) = stored else { return };
    let minimum = f32::from_bytes(&leaf[layout::LEAF_AFTER_MASK..]);
    let quantum = f32::from_bytes(&leaf[layout::LEAF_AFTER_MASK + 4..]);
    let codes = &leaf[layout::LEAF_CODES..];
    let bits = (codes.len() * 8 / LEAF_VOXELS) as u32;
    for (i, value) in values.iter_mut().enumerate() {
        *value = quantize::unpack(codes, bits, i) as f32 * quantum + minimum;
    }
}
