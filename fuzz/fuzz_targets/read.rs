//! Any bytes as a file: an error or grids, never a panic.
#![no_main]

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    for grid in nuage_fuzz::read_all(bytes) {
        nuage_fuzz::use_tree(&grid.tree);
        grid.transform.voxel_size();
    }
});
