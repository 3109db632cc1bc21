//! The table of what is supported, `SUPPORT.md`, which is also a part of the crate's front page: made here by trying
//! everything out, so that it cannot go stale.
//!
//! `NUAGE_BLESS=1 cargo test -p nuage-vdb --test support` writes it anew.

use std::collections::BTreeSet;
use std::fmt::Write;
use std::path::Path;

use nuage_testkit::{self as testkit, synthetic};
use nuage_vdb::{AnyTree, File, Grid, Metadata, NEWEST_VERSION, OLDEST_VERSION, WriteOptions, nano};

const PATH: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/SUPPORT.md");
/// The versions of the files that OpenVDB itself wrote for the test data.
const VERSIONS_OF_OPENVDB: [u32; 2] = [222, 224];
const VALUE_TYPES: [&str; 13] = [
    "float",
    "double",
    "half",
    "int32",
    "int64",
    "bool",
    "mask",
    "vec3s",
    "vec3d",
    "vec3i",
    "ptdataidx32",
    "ptidx32",
    "string",
];

/// What changed with a version, for those who meet one.
fn news(version: u32) -> &'static str {
    match version {
        213 => "the root is a table of entries",
        214 => "tiles of inner nodes stand in one block",
        215 => "short names of grid types",
        216 => "grids can share trees",
        217 => "bool leaves are bits",
        218 => "the UUID is text",
        219 => "transforms are maps",
        220 => "compression can be switched off",
        221 => "frusta have a box of floats",
        222 => "compression per grid, active values only",
        223 => "Blosc, point index grids",
        224 => "grids of points in several passes",
        225 => "grids of half floats",
        _ => "",
    }
}

#[test]
fn the_table_of_what_is_supported_is_true() {
    let mut text = String::from("# What is supported\n\n");
    versions(&mut text);
    types(&mut text);
    nanovdb(&mut text);
    text.push_str(
        "Trees of any widths from 2³ to 64³ per node that the grid type names are read and written, not only the standard \
         `5_4_3`;\ngrids of points and NanoVDB want the standard one. Compression: none, ZIP, Blosc (reading: with BloscLZ, \
         LZ4, LZ4HC, Snappy, Zlib or\nZstandard inside; writing: LZ4), each with active values only or with all. Transforms: \
         all maps of OpenVDB, frusta included, and the\nchains of matrices of before version 219.\n",
    );
    if std::env::var_os("NUAGE_BLESS").is_some() {
        std::fs::write(PATH, &text).unwrap();
    }
    let committed = std::fs::read_to_string(PATH).unwrap();
    assert!(
        text == committed,
        "SUPPORT.md is out of date; NUAGE_BLESS=1 writes it anew. It should be:\n{text}"
    );
}

/// A row per version: whether all synthetic files of it are read.
fn versions(text: &mut String) {
    let corpus = synthetic::corpus();
    let known: BTreeSet<u32> = corpus.iter().map(|(_, file)| file.version).collect();
    assert_eq!(known, (OLDEST_VERSION..=NEWEST_VERSION).collect(), "every version has a file");
    text.push_str("| file version | new in it | read | held to |\n| --- | --- | --- | --- |\n");
    for version in OLDEST_VERSION..=NEWEST_VERSION {
        let files = corpus.iter().filter(|(_, file)| file.version == version);
        let all_read = files.map(|(_, file)| file).filter(|file| !holds_strings(file)).all(|file| {
            let bytes = file.bytes();
            File::open(&bytes[..]).and_then(|file| file.read_all()).is_ok()
        });
        let evidence = match VERSIONS_OF_OPENVDB.contains(&version) {
            true => "files of OpenVDB",
            false => "synthetic only",
        };
        let read = if all_read { "yes" } else { "no" };
        writeln!(text, "| {version} | {} | {read} | {evidence} |", news(version)).unwrap();
    }
    writeln!(text, "\nOlder and newer files are refused by their number. Written is version 224, or 225 with grids of half floats.\n").unwrap();
}

fn holds_strings(file: &synthetic::SyntheticFile) -> bool {
    file.grids.iter().any(|grid| grid.value_type == "string")
}

/// A row per type of values.
fn types(text: &mut String) {
    text.push_str(
        "| values | read | one box | saved as half | written | to .nvdb |\n| --- | --- | --- | --- | --- | --- |\n",
    );
    for name in VALUE_TYPES {
        let yes = |is: bool| if is { "yes" } else { "–" };
        let grid = sample(name);
        let halves = grid.as_ref().is_some_and(|(grid, _)| {
            let mut grid = grid.clone();
            grid.save_float_as_half = true;
            written(&grid).is_some_and(|bytes| {
                bytes.len() < written(&Grid { save_float_as_half: false, ..grid }).unwrap().len()
            })
        });
        let (writes, nano) = match &grid {
            Some((grid, _)) => (
                written(grid)
                    .is_some_and(|bytes| File::open(bytes).unwrap().read_grid(0).unwrap().tree == grid.tree),
                nano::write(std::slice::from_ref(grid), &nano::WriteOptions::default(), &mut Vec::new())
                    .is_ok(),
            ),
            None => (false, false),
        };
        let read = match &grid {
            Some(_) if name == "ptdataidx32" => "attributes, positions, groups",
            Some(_) => "yes",
            None => "named and passed over",
        };
        let in_box = grid.as_ref().is_some_and(|(_, in_box)| *in_box);
        let row = [name, read, yes(in_box), yes(halves), yes(writes), yes(nano)];
        writeln!(text, "| {} |", row.join(" | ").replacen(name, &format!("`{name}`"), 1)).unwrap();
    }
    text.push('\n');
}

/// A grid of that type from a file, if it can be read, and whether a box of it can be.
fn sample(value_type: &str) -> Option<(Grid, bool)> {
    let from = |bytes: &[u8]| -> Option<(Grid, bool)> {
        let file = File::open(bytes).ok()?;
        let standard = |i: &usize| file.grids[*i].grid_type == format!("Tree_{value_type}_5_4_3");
        let index = (0..file.grids.len()).find(standard)?;
        let grid = file.read_grid(index).ok()?;
        let in_box = file.read_grid_in_box(index, [[0; 3], [7; 3]]).is_ok();
        Some((Grid { save_float_as_half: false, ..grid }, in_box))
    };
    if value_type == "ptdataidx32" {
        return from(&std::fs::read(testkit::committed("data/edge/points.vdb")).unwrap());
    }
    synthetic::corpus().iter().find_map(|(_, file)| from(&file.bytes()))
}

fn written(grid: &Grid) -> Option<Vec<u8>> {
    let mut bytes = Vec::new();
    nuage_vdb::write(std::slice::from_ref(grid), &Metadata::default(), &WriteOptions::default(), &mut bytes)
        .ok()?;
    Some(bytes)
}

/// A row per way in which NanoVDB stores numbers.
fn nanovdb(text: &mut String) {
    let Some((grid, _)) = sample("float") else { panic!("no float grid") };
    text.push_str("| NanoVDB | written | read back |\n| --- | --- | --- |\n");
    for (name, encoding) in [
        ("`float`", nano::Encoding::Full),
        ("`Fp16`", nano::Encoding::Fp16),
        ("`Fp8`", nano::Encoding::Fp8),
        ("`Fp4`", nano::Encoding::Fp4),
        ("`FpN`", nano::Encoding::FpN { max_error: 0.01 }),
    ] {
        let codecs = [("none", nano::Codec::None), ("ZIP", nano::Codec::Zip), ("Blosc", nano::Codec::Blosc)];
        let mut writes = Vec::new();
        for (codec_name, codec) in codecs {
            let mut bytes = Vec::new();
            let options = nano::WriteOptions { encoding, codec };
            if nano::write(std::slice::from_ref(&grid), &options, &mut bytes).is_ok() {
                let back = nano::File::open(&bytes[..]).unwrap().read_grid(0).unwrap();
                assert!(matches!(*back.tree, AnyTree::Float(_)));
                assert_eq!(back.tree.active_voxel_count(), grid.tree.active_voxel_count());
                writes.push(codec_name);
            }
        }
        writeln!(text, "| {name} | {} | yes |", writes.join(", ")).unwrap();
    }
    text.push_str("\nAlso read: `double`, `int16`, `int32`, `int64`, `Vec3f`, `Vec3d`, `bool` and `Mask`, with any of these compressions,\nversions 32.3 to 32.9. Version 32.4 is written.\n\n");
}

#[test]
fn the_versions_of_real_files_are_those_that_the_table_names() {
    let found: BTreeSet<u32> =
        testkit::truths().iter().map(|(_, truth)| truth["file_version"].as_u64().unwrap() as u32).collect();
    assert!(found.iter().all(|version| VERSIONS_OF_OPENVDB.contains(version)), "{found:?}");
    assert!(Path::new(PATH).is_file());
}
