//! Every grid of the test data against what OpenVDB says of it.

use nuage_testkit as testkit;
use nuage_vdb::{AnyTree, File, Grid, GridInfo};
use serde_json::Value;

#[test]
fn every_grid_equals_the_truth() {
    let (mut files, mut grids) = (0, 0);
    for (path, truth) in testkit::truths() {
        let file =
            File::open(std::fs::read(&path).unwrap()).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
        assert_eq!(u64::from(file.file_version), truth["file_version"].as_u64().unwrap());
        let [major, minor] = file.library_version;
        assert_eq!(format!("{major}.{minor}"), truth["library_version"].as_str().unwrap());
        check_metadata(&file.metadata, &truth["file_metadata"]);
        let wanted = truth["grids"].as_array().unwrap();
        assert_eq!(file.grids.len(), wanted.len(), "{}", path.display());
        files += 1;
        for want in wanted {
            let name = want["unique_name"].as_str().unwrap();
            let context = format!("{} {name}", path.display());
            let index = file.grids.iter().position(|g| g.unique_name == name).expect(&context);
            check_header(&file.grids[index], want, &context);
            let grid = file.read_grid(index).unwrap_or_else(|e| panic!("{context}: {e}"));
            check_tree(&grid.tree, want, &context);
            check_boxes(&file, index, &grid, want, &context);
            grids += 1;
        }
    }
    // What is committed is less than what lies outside.
    let (least_files, least_grids) =
        if testkit::data_roots()[0].join("data").is_dir() { (100, 250) } else { (50, 110) };
    assert!(files >= least_files && grids >= least_grids, "only {grids} grids in {files} files were found");
}

fn check_metadata(metadata: &nuage_vdb::Metadata, want: &Value) {
    let want = want.as_object().unwrap();
    let names: Vec<&str> = metadata.iter().map(|(name, _)| name).collect();
    assert_eq!(names, want.keys().map(String::as_str).collect::<Vec<_>>());
    for (name, value) in metadata.iter() {
        assert_eq!(value.type_name, want[name]["type"].as_str().unwrap(), "{name}");
        // The truth files spell each byte as the character of that number.
        let text: String = value.text_bytes().iter().map(|b| char::from(*b)).collect();
        assert_eq!(text, want[name]["str"].as_str().unwrap(), "{name}");
    }
}

fn check_header(info: &GridInfo, want: &Value, context: &str) {
    assert_eq!(info.name, want["name"].as_str().unwrap(), "{context}");
    assert_eq!(info.grid_type, want["grid_type"].as_str().unwrap(), "{context}");
    assert_eq!(info.value_type(), want["value_type"].as_str().unwrap(), "{context}");
    assert_eq!(info.grid_class(), want["grid_class"].as_str().unwrap(), "{context}");
    assert_eq!(info.save_float_as_half, want["save_float_as_half"].as_bool().unwrap(), "{context}");
    check_metadata(&info.metadata, &want["metadata"]);
    let transform = &want["transform"];
    assert_eq!(info.transform.type_name, transform["type"].as_str().unwrap(), "{context}");
    assert_eq!(info.transform.matrix().is_some(), transform["linear"].as_bool().unwrap(), "{context}");
    let close = |got: f64, want: f64| (got - want).abs() <= 1e-9 * want.abs().max(1.0);
    let floats = |v: &Value| v.as_array().unwrap().iter().map(|x| x.as_f64().unwrap()).collect::<Vec<_>>();
    if let Some(matrix) = info.transform.matrix() {
        assert_eq!(matrix.as_flattened(), floats(&transform["mat4_row_vector"]), "{context}");
    }
    for (got, want) in info.transform.voxel_size().iter().zip(floats(&transform["voxel_size"])) {
        assert!(close(*got, want), "{context}: voxel size {got}, not {want}");
    }
    for pair in transform["index_to_world"].as_array().unwrap() {
        let index: [f64; 3] = floats(&pair[0]).try_into().unwrap();
        for (got, want) in info.transform.world_from_index(index).iter().zip(floats(&pair[1])) {
            assert!(close(*got, want), "{context}: {index:?} at {got}, not {want}");
        }
    }
}

fn check_tree(tree: &AnyTree, want: &Value, context: &str) {
    // The truth files print single-precision numbers in nine digits.
    let is_single = matches!(tree, AnyTree::Float(_) | AnyTree::Vec3s(_));
    let number = |v: &Value| match v.as_bool() {
        Some(on) => f64::from(u8::from(on)),
        None if is_single => f64::from(testkit::number(v) as f32),
        None => testkit::number(v),
    };
    let numbers =
        |v: &Value| v.as_array().map_or_else(|| vec![number(v)], |v| v.iter().map(number).collect());
    let same = |got: &[f64], want: &[f64]| {
        got.len() == want.len() && got.iter().zip(want).all(|(a, b)| testkit::same(*a, *b))
    };
    assert_eq!(tree.grid_type(), want["grid_type"].as_str().unwrap(), "{context}");
    assert!(same(&tree.background(), &numbers(&want["background"])), "{context}: {:?}", tree.background());
    let stats = tree.statistics();
    let boxed = |v: &Value| serde_json::from_value::<Option<[[i32; 3]; 2]>>(v.clone()).unwrap();
    assert_eq!(stats.active_voxels, want["active_voxels"].as_u64().unwrap(), "{context}");
    assert_eq!(stats.active_leaf_voxels, want["active_leaf_voxels"].as_u64().unwrap(), "{context}");
    assert_eq!(tree.active_voxel_count(), stats.active_voxels, "{context}");
    assert_eq!(stats.active_tiles, want["active_tiles"].as_u64().unwrap(), "{context}");
    assert_eq!(stats.active_bbox, boxed(&want["active_bbox"]), "{context}");
    assert_eq!(stats.leaf_bbox, boxed(&want["leaf_bbox"]), "{context}");
    let counts: Vec<u64> = serde_json::from_value(want["node_counts_leaf_to_root"].clone()).unwrap();
    assert_eq!(stats.node_counts_leaf_to_root, counts, "{context}");
    assert_eq!(stats.dense_leaves, want["dense_leaves"].as_u64().unwrap(), "{context}");
    assert_eq!(stats.leaves_without_active, want["leaves_without_active"].as_u64().unwrap(), "{context}");
    for (depth, count) in stats.tiles_by_depth.iter().enumerate() {
        let want = &want["tiles_by_depth"][depth.to_string()];
        assert_eq!(count.active, want["active"].as_u64().unwrap_or(0), "{context}");
        let inactive = want["inactive_not_background"].as_u64().unwrap_or(0);
        // OpenVDB takes a NaN for different from any background.
        let nan_background = tree.background().iter().any(|x| x.is_nan());
        assert!(count.inactive_not_background == inactive || nan_background, "{context}");
    }
    let hex = |hash: u64| format!("{hash:016x}");
    assert_eq!(hex(tree.topology_hash()), want["fnv1a64_topology"].as_str().unwrap(), "{context}");
    // Over bits: NaN keeps its payload.
    assert_eq!(hex(tree.leaf_value_hash()), want["fnv1a64_leaf_values"].as_str().unwrap(), "{context}");
    if let Some(points) = want.get("point_count") {
        let AnyTree::Points(tree) = tree else { panic!("{context}: no tree of points") };
        assert_eq!(tree.point_count(), points.as_u64().unwrap(), "{context}");
        assert_eq!(tree.leaf_count() as u64, stats.node_counts_leaf_to_root[0], "{context}");
    }
    let min_max = stats.min_max();
    match want.get("min") {
        Some(min) => {
            let (min, max) = (numbers(min), numbers(&want["max"]));
            let wanted: Vec<[f64; 2]> = min.iter().zip(&max).map(|(a, b)| [*a, *b]).collect();
            assert_eq!(min_max, Some(wanted), "{context}");
            assert_eq!(stats.nan_count, want["nan_count"].as_u64().unwrap(), "{context}");
        }
        None => assert_eq!(min_max, None, "{context}"),
    }
    if let Some(sums) = want.get("sum_active_voxels").filter(|_| stats.nan_count == 0) {
        let sums = sums
            .as_array()
            .map_or_else(|| vec![testkit::number(sums)], |v| v.iter().map(testkit::number).collect());
        for (component, sum) in stats.components.iter().zip(sums) {
            let close = (component.sum - sum).abs() <= 1e-6 * sum.abs().max(component.sum_of_squares.sqrt());
            assert!(close || testkit::same(component.sum, sum), "{context}: sum {} not {sum}", component.sum);
        }
    }
    for probe in want["probes"].as_array().unwrap() {
        let ijk: [i32; 3] = serde_json::from_value(probe["ijk"].clone()).unwrap();
        let voxel = tree.voxel(ijk);
        assert!(same(&voxel.components, &numbers(&probe["v"])), "{context} {ijk:?}: {voxel:?}");
        assert_eq!(voxel.active, probe["on"].as_bool().unwrap(), "{context} {ijk:?}");
        assert_eq!(i64::from(voxel.depth), probe["depth"].as_i64().unwrap(), "{context} {ijk:?}");
    }
}

/// A box around some of the probes, read alone: the same values inside, inactive background outside.
fn check_boxes(file: &File<Vec<u8>>, index: usize, grid: &Grid, want: &Value, context: &str) {
    if matches!(*grid.tree, AnyTree::Points(_)) {
        return;
    }
    let probes: Vec<[i32; 3]> = want["probes"]
        .as_array()
        .unwrap()
        .iter()
        .map(|probe| serde_json::from_value(probe["ijk"].clone()).unwrap())
        .collect();
    let Some(center) = probes.get(probes.len() / 2) else { return };
    let bbox = [center.map(|c| c.saturating_sub(21)), center.map(|c| c.saturating_add(13))];
    let part = file.read_grid_in_box(index, bbox).unwrap_or_else(|e| panic!("{context}: {e}"));
    let is_mask = matches!(*grid.tree, AnyTree::Mask(_));
    for ijk in &probes {
        let (whole, part) = (grid.tree.voxel(*ijk), part.tree.voxel(*ijk));
        let inside = (0..3).all(|i| bbox[0][i] <= ijk[i] && ijk[i] <= bbox[1][i]);
        let bits = |values: &[f64]| values.iter().map(|x| x.to_bits()).collect::<Vec<u64>>();
        if inside {
            assert_eq!(bits(&part.components), bits(&whole.components), "{context} {ijk:?}");
            assert_eq!(part.active, whole.active, "{context} {ijk:?}");
        } else {
            assert!(!part.active, "{context} {ijk:?}");
            let outside = if is_mask { vec![0.0] } else { grid.tree.background() };
            assert_eq!(bits(&part.components), bits(&outside), "{context} {ijk:?}");
        }
    }
}
