//! What was read can be written, and is read again as it was.
#![no_main]

use nuage_fuzz::sound;
use nuage_vdb::{AnyTree, Compression, Metadata, WriteOptions};

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let mut grids = nuage_fuzz::read_all(bytes);
    grids.retain(|grid| !matches!(*grid.tree, AnyTree::Points(_)));
    // Rounding to half floats changes values once, and what is compared here are values.
    grids.iter_mut().for_each(|grid| grid.save_float_as_half = false);
    let compression = match bytes.last().map(|byte| byte % 4) {
        Some(0) => Compression::ZIP,
        Some(1) => Compression::NONE,
        Some(2) => Compression::NONE.with_all_values(),
        _ => Compression::BLOSC,
    };
    let options = WriteOptions { compression, ..WriteOptions::default() };
    let mut written = Vec::new();
    nuage_vdb::write(&grids, &Metadata::default(), &options, &mut written).expect("what was read can be written");
    let again = nuage_vdb::File::open(&written[..]).expect("what was written can be opened");
    assert_eq!(again.grids.len(), grids.len());
    for (index, grid) in grids.iter().enumerate() {
        let back = sound(again.read_grid(index)).expect("what was written can be read");
        assert_eq!(back.tree.topology_hash(), grid.tree.topology_hash());
        assert_eq!(back.tree.leaf_value_hash(), grid.tree.leaf_value_hash());
        assert_eq!(back.tree.grid_type(), grid.tree.grid_type());
        let counts = |tree: &AnyTree| tree.statistics().tiles_by_depth;
        assert_eq!(counts(&back.tree), counts(&grid.tree));
    }
});
