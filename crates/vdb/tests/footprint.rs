//! Reading takes little more memory than the grid that comes of it: at most 1.3 times what OpenVDB says it takes.
//!
//! One test, because the counting allocator is one for the whole process.

use std::alloc::System;

use cap::Cap;
use nuage_testkit as testkit;
use nuage_vdb::File;

#[global_allocator]
static ALLOCATOR: Cap<System> = Cap::new(System, usize::MAX);

/// Smaller grids say more of buffers than of grids.
const LEAST_BYTES: i64 = 2 << 20;

#[test]
fn reading_a_grid_peaks_near_its_own_size() {
    let mut grids: Vec<(i64, String, Vec<u8>, usize)> = Vec::new();
    for (path, _) in testkit::truths() {
        let bytes = std::fs::read(&path).unwrap();
        let file = File::open(&bytes[..]).unwrap();
        for (index, info) in file.grids.iter().enumerate() {
            let Some(stated) = info.metadata.get("file_mem_bytes") else { continue };
            let stated = i64::from_le_bytes(stated.bytes.clone().try_into().unwrap());
            // Points are made of more than their tree, which alone is stated.
            if stated >= LEAST_BYTES && info.instance_of.is_none() && info.value_type() != "ptdataidx32" {
                grids.push((stated, format!("{} {}", path.display(), info.name), bytes.clone(), index));
            }
        }
    }
    // The allocator knows only the highest peak of all, so the grids go from small to large.
    grids.sort();
    let mut worst: f64 = 0.0;
    for (stated, name, bytes, index) in &grids {
        let file = File::open(&bytes[..]).unwrap();
        let (start, before) = (ALLOCATOR.allocated(), ALLOCATOR.max_allocated());
        let grid = file.read_grid(*index).unwrap();
        let peak = ALLOCATOR.max_allocated().saturating_sub(start) as f64;
        drop(grid);
        // A peak of an earlier grid that was larger in truth than it stated says nothing here.
        if ALLOCATOR.max_allocated() > before {
            let ratio = peak / *stated as f64;
            assert!(ratio <= 1.3, "{name}: {peak} bytes at the peak, {stated} in OpenVDB: {ratio:.2}");
            worst = worst.max(ratio);
        }
    }
    assert!(grids.len() >= 3, "only {} grids", grids.len());
    assert!(worst > 0.0, "no grid set a peak of its own");
}
