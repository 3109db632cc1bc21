//! The memory that reading points takes: what they hold in the end, and little more.
//!
//! One test, because the counting allocator is one for the whole process.

use std::alloc::System;
use std::path::Path;

use cap::Cap;
use nuage_vdb::{Error, File, Limits};

#[global_allocator]
static ALLOCATOR: Cap<System> = Cap::new(System, usize::MAX);

#[test]
fn reading_points_takes_little_more_than_the_points() {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/points/pages.vdb");
    let bytes = std::fs::read(path).unwrap();
    // Limits that are too small come first, since the allocator knows only the highest peak of all.
    let mut limit = 100_000;
    let read = loop {
        let file = File::open_with(&bytes[..], Limits { max_memory_bytes: limit }).unwrap();
        match file.read_grid(0) {
            Ok(grid) => break grid.tree.memory_bytes(),
            Err(Error::Limit { limit_bytes, .. }) => assert_eq!(limit_bytes, limit),
            Err(error) => panic!("{error}"),
        }
        assert!(
            ALLOCATOR.max_allocated() < bytes.len() + limit as usize + (2 << 20),
            "under a limit of {limit}"
        );
        limit += limit / 4;
    };
    assert!(limit < 2 * read, "{read} bytes took a limit of {limit}");
    let file = File::open(&bytes[..]).unwrap();
    let (before, peak_before) = (ALLOCATOR.allocated(), ALLOCATOR.max_allocated());
    let grid = file.read_grid(0).unwrap();
    let peak = ALLOCATOR.max_allocated().max(peak_before) - before;
    // A page per thread is unpacked on its way.
    assert!((peak as u64) < grid.tree.memory_bytes() + (4 << 20), "{peak} bytes for {read}");
}
