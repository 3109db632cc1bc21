//! Random grids written by OpenVDB itself, where its Python module is installed, read here and compared.

use std::path::{Path, PathBuf};
use std::process::Command;

use nuage_testkit as testkit;
use nuage_vdb::{File, Grid};
use serde_json::Value;

const WRITER: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/live/write_grids.py");

/// A folder of its own for this process, removed at the end.
struct Folder(PathBuf);

impl Folder {
    fn new() -> Self {
        let path = std::env::temp_dir().join(format!("nuage-vdb-live-{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Folder(path)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // Nothing hangs on it, and a panic here would hide the one that may be under way.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// A Python that has OpenVDB's module: that of the system first, since it is packaged for that one.
fn python_with_openvdb() -> Option<&'static str> {
    let has_module = |python: &&str| {
        let tried = Command::new(python).arg(WRITER).arg("--check").output();
        tried.is_ok_and(|output| output.status.success())
    };
    ["/usr/bin/python3", "python3"].into_iter().find(has_module)
}

#[test]
fn grids_written_by_openvdb_are_read_as_it_reads_them() {
    let Some(python) = python_with_openvdb() else {
        return testkit::left_out("openvdb", "python3-openvdb");
    };
    let folder = Folder::new();
    let written = Command::new(python).arg(WRITER).arg(&folder.0).output().unwrap();
    assert!(written.status.success(), "{}", String::from_utf8_lossy(&written.stderr));
    let text = std::fs::read_to_string(folder.0.join("truth.json")).unwrap();
    let truth: Value = serde_json::from_str(&text).unwrap();
    let files = truth.as_object().unwrap();
    let mut grids = 0;
    for (name, wanted) in files {
        grids += check_file(&folder.0.join(name), wanted.as_array().unwrap());
    }
    assert!(files.len() >= 4 && grids >= 12, "only {grids} grids in {} files", files.len());
}

fn check_file(path: &Path, wanted: &[Value]) -> usize {
    let file = File::open(std::fs::read(path).unwrap()).unwrap();
    assert_eq!(file.grids.len(), wanted.len());
    for want in wanted {
        let name = want["name"].as_str().unwrap();
        let grid = file.read_grid(file.find(name).expect(name)).unwrap_or_else(|e| panic!("{name}: {e}"));
        check_grid(&grid, want, name);
    }
    wanted.len()
}

fn check_grid(grid: &Grid, want: &Value, name: &str) {
    let number = |value: &Value| value.as_f64().unwrap();
    let coord = |value: &Value| -> [i32; 3] { serde_json::from_value(value.clone()).unwrap() };
    assert_eq!(grid.save_float_as_half, want["half"].as_bool().unwrap(), "{name}");
    assert_eq!(grid.grid_class(), want["class"].as_str().unwrap(), "{name}");
    for (key, text) in want["metadata"].as_object().unwrap() {
        let value = grid.metadata.get(key).unwrap_or_else(|| panic!("{name}: no metadata '{key}'"));
        assert_eq!(value.to_string(), text.as_str().unwrap(), "{name}: {key}");
    }
    for pair in want["index_to_world"].as_array().unwrap() {
        let index = coord(&pair[0]).map(f64::from);
        for (got, want) in grid.transform.world_from_index(index).iter().zip(pair[1].as_array().unwrap()) {
            let want = number(want);
            assert!((got - want).abs() <= 1e-9 * want.abs().max(1.0), "{name}: {got}, not {want}");
        }
    }
    let tree = grid.tree.as_float().expect(name);
    assert_eq!(f64::from(tree.background), number(&want["background"]), "{name}");
    let stats = tree.statistics();
    assert_eq!(stats.active_voxels, want["active_voxels"].as_u64().unwrap(), "{name}");
    assert_eq!(stats.node_counts_leaf_to_root[0], want["leaves"].as_u64().unwrap(), "{name}");
    if stats.active_voxels > 0 {
        assert_eq!(stats.active_bbox, Some([coord(&want["bbox"][0]), coord(&want["bbox"][1])]), "{name}");
        let range = stats.min_max().unwrap()[0];
        assert_eq!(range, [number(&want["min_max"][0]), number(&want["min_max"][1])], "{name}");
    }
    let probes = want["probes"].as_array().unwrap();
    assert!(probes.len() > 100, "{name}");
    for probe in probes {
        let ijk = coord(&probe[0]);
        let voxel = tree.voxel(ijk);
        assert_eq!(f64::from(voxel.value), number(&probe[1]), "{name} {ijk:?}");
        assert_eq!(voxel.active, probe[2].as_bool().unwrap(), "{name} {ijk:?}");
        assert_eq!(i64::from(voxel.depth), probe[3].as_i64().unwrap(), "{name} {ijk:?}");
    }
}
