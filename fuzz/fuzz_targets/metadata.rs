//! Metadata of any type, of the file and of grids without trees.
#![no_main]

use nuage_fuzz::{LIMITS, sound};
use nuage_vdb::File;

/// A header up to the file's metadata.
const HEADER: &[u8] = b"\x20BDV\0\0\0\0\xe0\0\0\0\x0a\0\0\0\0\0\0\0\x01000000000000000000000000000000000000";

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    // Files of the corpus as they are, anything else as what follows a header.
    let whole = if bytes.starts_with(&HEADER[..8]) { bytes.to_vec() } else { [HEADER, bytes].concat() };
    let Some(file) = sound(File::open_with(&whole[..], LIMITS)) else { return };
    for metadata in file.grids.iter().map(|grid| &grid.metadata).chain([&file.metadata]) {
        for (name, value) in metadata.iter() {
            assert!(metadata.get(name).is_some());
            value.text_bytes();
            value.to_string();
            (metadata.string(name), metadata.bool(name), metadata.vec3i(name));
        }
        (metadata.grid_class(), metadata.vector_type());
    }
    for grid in &file.grids {
        (grid.file_bbox(), grid.value_type(), grid.shape(), grid.transform.voxel_size());
    }
});
