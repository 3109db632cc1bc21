//! Any bytes as a NanoVDB file: an error or grids, never a panic.
#![no_main]

use nuage_fuzz::{LIMITS, sound};
use nuage_vdb::nano;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let Some(file) = sound(nano::File::open_with(bytes, LIMITS)) else { return };
    for index in 0..file.grids.len().min(4) {
        if let Some(grid) = sound(file.read_grid(index)) {
            nuage_fuzz::use_tree(&grid.tree);
        }
    }
});
