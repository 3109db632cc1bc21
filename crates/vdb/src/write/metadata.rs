//! The metadata that a grid is written with: its own, and what OpenVDB notes on writing.

use crate::any::{AnyTree, Grid};
use crate::block::{COMPRESS_ACTIVE_MASK, COMPRESS_BLOSC, COMPRESS_ZIP, Compression};
use crate::metadata::{MetaValue, Metadata};
use crate::tree::Tree;
use crate::value::{LeafValues, Value};
use crate::with_tree;

/// The metadata of a grid as they are written.
pub(super) fn of_grid(grid: &Grid, compression: Compression) -> Metadata {
    const HALF: &str = "is_saved_as_half_float";
    let mut metadata = grid.metadata.clone();
    metadata.remove("file_delayed_load");
    if !grid.name.is_empty() || metadata.get("name").is_some() {
        metadata.insert("name", MetaValue::from_text(&grid.name));
    }
    // OpenVDB reads values as half floats if this entry says so, whatever the name of the type.
    if grid.save_float_as_half || metadata.get(HALF).is_some() {
        metadata.insert(HALF, MetaValue::from_bool(grid.save_float_as_half));
    }
    // OpenVDB's box of nothing.
    let [min, max] = grid.tree.active_bbox().unwrap_or([[i32::MAX; 3], [i32::MIN; 3]]);
    let voxels = i64::try_from(grid.tree.active_voxel_count()).unwrap_or(i64::MAX);
    metadata.insert("file_bbox_min", MetaValue::from_vec3i(min));
    metadata.insert("file_bbox_max", MetaValue::from_vec3i(max));
    metadata.insert("file_voxel_count", MetaValue::from_int64(voxels));
    metadata.insert("file_mem_bytes", MetaValue::from_int64(openvdb_memory_bytes(&grid.tree)));
    metadata.insert("file_compression", MetaValue::from_text(&compression_text(compression)));
    metadata
}

/// The compression in OpenVDB's words.
fn compression_text(compression: Compression) -> String {
    let names = [(COMPRESS_ZIP, "zip"), (COMPRESS_BLOSC, "blosc"), (COMPRESS_ACTIVE_MASK, "active values")];
    let used: Vec<&str> =
        names.iter().filter(|(flag, _)| compression.flags & flag != 0).map(|(_, name)| *name).collect();
    if used.is_empty() { "none".into() } else { used.join(" + ") }
}

/// The memory that OpenVDB 10.0 takes for the tree on a machine of 64 bits, by the sizes of its classes.
fn openvdb_memory_bytes(tree: &AnyTree) -> i64 {
    fn of<V: Value>(tree: &Tree<V>) -> u64 {
        /// Of a tree object, what does not belong to its root.
        const TREE_BYTES: usize = 1160;
        /// A red-black tree, the origin and a number.
        const ROOT_BYTES: usize = 48 + 12 + 4;
        const COORD_BYTES: usize = 12;
        const POINTER_BYTES: usize = 8;
        let padded = |bytes: usize, to: usize| bytes.next_multiple_of(to);
        // Numbers are as wide as they are aligned, vectors as their numbers.
        let value_bytes = size_of::<V>();
        let root = padded(ROOT_BYTES + padded(value_bytes, 4), 8);
        // The root is counted with the tree and again on its own.
        let mut total = (TREE_BYTES + 2 * root) as u64;
        for (level, nodes) in tree.levels.iter().enumerate() {
            let slots = tree.shape.branching(level).slots();
            let node = slots * padded(value_bytes, POINTER_BYTES) + 2 * (slots / 8) + COORD_BYTES;
            total += (nodes.len() * node) as u64;
        }
        let voxels = tree.leaves.leaf_voxels;
        let mask_bytes = voxels / 8;
        let alignment = mask_bytes.clamp(4, 8);
        let leaf = match V::leaf(&[]) {
            // A buffer's pointer and flags, mask, origin and a number; the values stand elsewhere.
            LeafValues::Plain(_) => {
                padded(16 + padded(mask_bytes, 4) + COORD_BYTES + 4, 8) + voxels * value_bytes
            }
            LeafValues::Bits(_) => padded(padded(2 * mask_bytes, 4) + COORD_BYTES + 4, alignment),
            LeafValues::Mask => padded(padded(mask_bytes, 4) + COORD_BYTES + 4, alignment),
        };
        total + (tree.leaves.len() * leaf) as u64
    }
    i64::try_from(with_tree!(tree, tree => of(tree))).unwrap_or(i64::MAX)
}
