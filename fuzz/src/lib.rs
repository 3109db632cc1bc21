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

/// A file's grids as NanoVDB files; none where they have no such form.
pub fn as_nanovdb(bytes: &[u8]) -> Vec<Vec<u8>> {
    use nuage_vdb::nano::{Codec, Encoding, WriteOptions};
    let grids = read_all(bytes);
    let forms =
        [(Encoding::Full, Codec::None), (Encoding::Fp8, Codec::Zip), (Encoding::Fp4, Codec::None), (Encoding::FpN { max_error: 0.01 }, Codec::None)];
    let write = |(encoding, codec): &(Encoding, Codec)| {
        let options = WriteOptions { encoding: *encoding, codec: *codec };
        let mut out = Vec::new();
        nuage_vdb::nano::write(&grids, &options, &mut out).ok().map(|()| out)
    };
    forms.iter().filter_map(write).collect()
}

/// A packed file with a brick of every codec, stored without compression, so that mutations reach what is inside.
pub fn packed_file() -> Vec<u8> {
    use nuage_volume::codec::Codec;
    use nuage_volume::format::{Contents, Writer};
    use nuage_volume::packed::Trees;

    let mut out = std::io::Cursor::new(Vec::new());
    let stored = |bytes: &[u8]| vec![0; bytes.len() + 1];
    let write = |out| {
        let mut writer = Writer::new(out, &stored)?;
        let shape = writer.shape(Codec::Gradient { bits: 0 }, &[0x3c00, 1, 2])?;
        for codec in (1..=24).filter_map(Codec::from_tag) {
            let mut words = vec![0x1234_5678 & 0xb3ff_b3ff; codec.word_count()];
            if codec == Codec::Shared {
                words[1..].copy_from_slice(&[shape, 16]);
            }
            writer.brick(codec, &words)?;
        }
        writer.finish(&Contents::default(), &Trees::default())
    };
    write(&mut out).expect("a file in memory");
    out.into_inner()
}
