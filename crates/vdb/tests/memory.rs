//! Files that make much memory out of few bytes: headers and trees whose decoded form is larger than the file.
//!
//! One test, because the counting allocator is one for the whole process; every case has the same limit, since
//! the allocator knows only the highest peak of all.

mod surgery;

use std::alloc::System;

use cap::Cap;
use nuage_vdb::{Error, File, Limits};

#[global_allocator]
static ALLOCATOR: Cap<System> = Cap::new(System, usize::MAX);

const LIMIT_BYTES: u64 = 16 << 20;
const WORKING_BYTES: u64 = 32 << 20;

#[test]
fn no_header_takes_more_memory_than_the_limit() {
    let cases = [
        ("many metadata entries", many_metadata_entries()),
        ("a long metadata name", long_metadata_name()),
        ("long names of grids", long_grid_names()),
        ("a stream of many shared grids", many_instances(false)),
        ("many shared grids", many_instances(true)),
    ];
    let mut failures = Vec::new();
    for (name, bytes) in cases {
        assert!(bytes.len() as u64 <= LIMIT_BYTES, "{name}: the file is within the limit");
        let (start, before) = (ALLOCATOR.allocated(), ALLOCATOR.max_allocated());
        let result = File::open_with(&bytes[..], Limits { max_memory_bytes: LIMIT_BYTES })
            .map(|file| file.grids.len());
        let peak = ALLOCATOR.max_allocated().saturating_sub(start) as u64;
        // A peak that an earlier case set has been judged there.
        if ALLOCATOR.max_allocated() > before && peak > LIMIT_BYTES + WORKING_BYTES {
            failures.push(format!("{name}: {peak} bytes, then {result:?}"));
        }
        if !matches!(result, Err(Error::Limit { .. } | Error::Malformed { .. })) {
            failures.push(format!("{name}: {result:?}"));
        }
    }
    assert!(failures.is_empty(), "{failures:#?}");
}

fn many_metadata_entries() -> Vec<u8> {
    let mut bytes = surgery::header(true, 0);
    bytes.truncate(bytes.len() - 8);
    bytes.extend(u32::MAX.to_le_bytes());
    bytes.resize(LIMIT_BYTES as usize, 0);
    bytes
}

/// Bytes that are not UTF-8, each of which becomes three.
fn long_metadata_name() -> Vec<u8> {
    let mut bytes = surgery::header(true, 0);
    bytes.truncate(bytes.len() - 8);
    bytes.extend(1_u32.to_le_bytes());
    surgery::push_string(&mut bytes, &vec![0xff; 15 << 20]);
    bytes.extend([0; 100]);
    bytes
}

fn long_grid_names() -> Vec<u8> {
    let mut bytes = surgery::header(true, 16);
    for _ in 0..16 {
        surgery::push_instance(&mut bytes, &vec![0xff; 1_000_000], b"other", [0.0; 3]);
    }
    bytes
}

fn many_instances(has_offsets: bool) -> Vec<u8> {
    const COUNT: u32 = 140_000;
    let mut bytes = surgery::header(has_offsets, COUNT);
    for _ in 0..COUNT {
        surgery::push_instance(&mut bytes, b"", b"a", [0.0; 3]);
    }
    bytes
}
