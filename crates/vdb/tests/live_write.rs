//! Files written here and read by OpenVDB itself, where its Python module is installed: it finds the same.

use std::path::PathBuf;
use std::process::Command;
use std::sync::Arc;

use nuage_testkit as testkit;
use nuage_vdb::{
    AnyTree, Compression, Grid, MetaValue, Metadata, Shape, Transform, Tree, TreeBuilder, Value, WriteOptions,
};
use serde_json::Value as Json;

const READER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/live/read_grids.py");

/// A folder of its own for this process, removed at the end.
struct Folder(PathBuf);

impl Drop for Folder {
    fn drop(&mut self) {
        // Nothing hangs on it, and a panic here would hide the one that may be under way.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// A Python that has OpenVDB's module: that of the system first, since it is packaged for that one.
fn python_with_openvdb() -> Option<&'static str> {
    let code = "try:\n import pyopenvdb\nexcept ImportError:\n import openvdb";
    let has_module = |python: &&str| {
        Command::new(python).args(["-c", code]).output().is_ok_and(|output| output.status.success())
    };
    ["/usr/bin/python3", "python3"].into_iter().find(has_module)
}

fn random(seed: &mut u64, below: u64) -> u64 {
    *seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*seed >> 33) % below
}

/// Leaves of all kinds of blocks and tiles of all levels. `value` makes values of small numbers; 0 the background.
fn tree<V: Value<Stored = V>>(seed: &mut u64, value: impl Fn(u64) -> V) -> Tree<V> {
    let mut builder = TreeBuilder::new(value(0), Shape::STANDARD);
    for i in 0..14_i32 {
        let mask: Vec<u64> =
            (0..8).map(|_| [0, u64::MAX, random(seed, u64::MAX)][random(seed, 3) as usize]).collect();
        let (first, kinds, noisy) = (random(seed, 3), 1 + random(seed, 3), random(seed, 2));
        let values: Vec<V> = (0..512)
            .map(|voxel: usize| match mask[voxel / 64] >> (voxel % 64) & 1 {
                1 if noisy == 1 => value(random(seed, 1000)),
                1 => value(voxel as u64 / 40),
                _ => value(first + random(seed, kinds)),
            })
            .collect();
        builder.leaf([i * 8 - 64, (i % 3) * 8, i % 2 * 4096], &mask, &values);
    }
    builder.tile(2, [80, 0, 0], value(5), true);
    builder.tile(2, [88, 0, 0], value(1), false);
    builder.tile(1, [-1000, 256, 0], value(7), true);
    builder.tile(0, [-5000, -5000, -5000], value(3), true);
    builder.tile(0, [9000, -5000, -5000], value(1), false);
    builder.build().unwrap()
}

fn bool_tree(seed: &mut u64) -> Tree<bool> {
    let mut builder = TreeBuilder::new(true, Shape::STANDARD);
    for i in 0..5 {
        let words: Vec<u64> =
            (0..16).map(|_| random(seed, u64::MAX) | random(seed, u64::MAX) << 32).collect();
        builder.leaf([i * 8 - 16, 0, 0], &words[..8], &words[8..]);
    }
    builder.tile(2, [80, 0, 0], false, true);
    builder.tile(1, [-1000, 256, 0], false, false);
    builder.build().unwrap()
}

fn grids(seed: &mut u64, half: bool) -> Vec<Grid> {
    // All values are half floats, and 1 is the negative background.
    let number = |i: u64| [1.5, -1.5].get(i as usize).copied().unwrap_or(i as f32 * 0.25 - 3.0);
    let trees: [AnyTree; 3] = [
        tree(seed, number).into(),
        tree(seed, |i| [number(i), -number(i), number(i + 1)]).into(),
        bool_tree(seed).into(),
    ];
    let mut grids: Vec<Grid> = trees
        .into_iter()
        .zip(["density", "velocity", "inside"])
        .map(|(tree, name)| {
            let mut metadata = Metadata::default();
            metadata.insert("class", MetaValue::from_text("fog volume"));
            metadata.insert("count", MetaValue::from_int64(-7));
            metadata.insert("text", MetaValue::from_text("smoke"));
            let transform = Transform::uniform_scale(0.125);
            let save_float_as_half = half && name != "inside";
            Grid { name: name.into(), metadata, transform, save_float_as_half, tree: Arc::new(tree) }
        })
        .collect();
    let matrix = [[0.8, 0.6, 0.0, 0.0], [-0.6, 0.8, 0.0, 0.0], [0.0, 0.0, 1.5, 0.0], [1.0, 2.0, 3.0, 1.0]];
    grids.push(Grid { name: "again".into(), transform: Transform::affine(matrix), ..grids[0].clone() });
    grids.push(Grid {
        name: "nothing".into(),
        tree: Arc::new(Tree::empty(0.5_f32, Shape::STANDARD).into()),
        ..grids[0].clone()
    });
    grids
}

fn probes(seed: &mut u64) -> Vec<[i32; 3]> {
    let mut coords =
        vec![[80, 1, 2], [90, 3, 4], [-1000, 300, 5], [-5000; 3], [9000, -5000, -5000], [0, 0, 90_000]];
    for _ in 0..3000 {
        let [x, y, z] = [160, 24, 8].map(|below| random(seed, below) as i32);
        coords.push([x - 70, y, z + 4096 * random(seed, 2) as i32]);
    }
    coords
}

#[test]
fn openvdb_reads_what_is_written() {
    let Some(python) = python_with_openvdb() else {
        return testkit::left_out("openvdb", "python3-openvdb");
    };
    let folder = Folder(std::env::temp_dir().join(format!("nuage-vdb-live-write-{}", std::process::id())));
    std::fs::create_dir_all(&folder.0).unwrap();
    let [file, probe_list, truth] =
        ["grids.vdb", "probes.json", "truth.json"].map(|name| folder.0.join(name));
    let compressions =
        [Compression::BLOSC, Compression::ZIP, Compression::NONE.with_all_values(), Compression::BLOSC];
    for (seed, compression) in (1_u64..).zip(compressions) {
        let mut state = seed;
        let grids = grids(&mut state, seed % 2 == 0);
        let coords = probes(&mut state);
        let mut bytes = Vec::new();
        nuage_vdb::write(&grids, &Metadata::default(), &WriteOptions { compression }, &mut bytes).unwrap();
        std::fs::write(&file, bytes).unwrap();
        std::fs::write(&probe_list, serde_json::to_string(&coords).unwrap()).unwrap();
        let read = Command::new(python).arg(READER).args([&file, &probe_list, &truth]).output().unwrap();
        assert!(read.status.success(), "{}", String::from_utf8_lossy(&read.stderr));
        let found: Json = serde_json::from_str(&std::fs::read_to_string(&truth).unwrap()).unwrap();
        let found = found.as_array().unwrap();
        assert_eq!(found.len(), grids.len());
        for grid in &grids {
            // OpenVDB sorts them by name.
            let found = found.iter().find(|found| found["name"] == grid.name.as_str()).expect(&grid.name);
            check(grid, found, &coords);
        }
    }
}

fn numbers(value: &Json) -> Vec<f64> {
    value.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect()
}

fn check(grid: &Grid, found: &Json, coords: &[[i32; 3]]) {
    let (name, tree) = (&grid.name, &grid.tree);
    assert_eq!(found["half"], grid.save_float_as_half, "{name}");
    assert_eq!(found["class"], "fog volume", "{name}");
    for (key, text) in [("text", "smoke"), ("count", "-7")] {
        assert_eq!(found["metadata"][key], text, "{name}");
    }
    assert_eq!(numbers(&found["background"]), tree.background(), "{name}");
    assert_eq!(found["active_voxels"], tree.active_voxel_count(), "{name}");
    assert_eq!(found["leaves"], tree.statistics().node_counts_leaf_to_root[0], "{name}");
    let corner = grid.transform.world_from_index([10.0, -20.0, 30.0]);
    for (found, wanted) in numbers(&found["corner"]).iter().zip(corner) {
        assert!((found - wanted).abs() < 1e-9, "{name}: {found}, {wanted}");
    }
    let mut depths = [0; 5];
    for (ijk, probe) in coords.iter().zip(found["probes"].as_array().unwrap()) {
        let voxel = tree.voxel(*ijk);
        assert_eq!(numbers(&probe[0]), voxel.components, "{name} {ijk:?}");
        assert_eq!((&probe[1], &probe[2]), (&voxel.active.into(), &voxel.depth.into()), "{name} {ijk:?}");
        depths[(voxel.depth + 1) as usize] += 1;
    }
    assert!(
        tree.active_voxel_count() == 0 || depths[0] > 0 && depths[3] > 0 && depths[4] > 50,
        "{name}: {depths:?}"
    );
}
