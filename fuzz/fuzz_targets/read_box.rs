//! One box of each grid: what lies inside is what reading all of the grid gives.
#![no_main]

use nuage_fuzz::{LIMITS, sound};
use nuage_vdb::{AnyTree, File};

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    // The box comes from the end, so that files of the corpus are inputs as they are.
    let Some((_, tail)) = bytes.split_last_chunk::<4>() else { return };
    let corner = [tail[0], tail[1], tail[2]].map(|c| i32::from(c) - 128);
    let bbox = [corner, corner.map(|c| c + i32::from(tail[3] % 40))];
    let Some(file) = sound(File::open_with(bytes, LIMITS)) else { return };
    for index in 0..file.grids.len().min(4) {
        let Some(part) = sound(file.read_grid_in_box(index, bbox)) else { continue };
        nuage_fuzz::use_tree(&part.tree);
        if matches!(*part.tree, AnyTree::Points(_)) {
            continue;
        }
        // Leaves outside of the box may be damaged.
        let Some(whole) = sound(file.read_grid(index)) else { continue };
        for corner in bbox {
            let (a, b) = (part.tree.voxel(corner), whole.tree.voxel(corner));
            let bits = |values: &[f64]| values.iter().map(|x| x.to_bits()).collect::<Vec<u64>>();
            assert_eq!((bits(&a.components), a.active), (bits(&b.components), b.active));
        }
    }
});
