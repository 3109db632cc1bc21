//! Grids of points against what OpenVDB reads from the same files, and damaged ones.
//!
//! The files in `data/points` and what OpenVDB says of them are made by `make_points.cc` beside them.

mod surgery;

use std::path::Path;

use nuage_vdb::points::{AttributeArray, PointTree};
use nuage_vdb::{AnyTree, Error, File, Limits};
use serde_json::Value;

fn bytes_of(name: &str) -> Vec<u8> {
    std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/points").join(name)).unwrap()
}

fn points_of(tree: &AnyTree) -> &PointTree {
    match tree {
        AnyTree::Points(points) => points,
        other => panic!("a grid of {}", other.value_type()),
    }
}

/// Holds the point grids of a file to those that OpenVDB found; gives how many there were.
fn check(bytes: &[u8], truth: &Value, context: &str) -> usize {
    let file = File::open(bytes).unwrap();
    let mut checked = 0;
    for want in truth.as_array().unwrap() {
        let Some(index) = file.find(want["name"].as_str().unwrap()) else { continue };
        let context = format!("{context} {}", want["name"]);
        let grid = file.read_grid(index).unwrap_or_else(|e| panic!("{context}: {e}"));
        let points = points_of(&grid.tree);
        assert_eq!(points.point_count(), want["points"].as_u64().unwrap(), "{context}");
        let mut world = points.positions_world(&grid.transform);
        let leaves = want["leaves"].as_array().unwrap();
        assert_eq!(points.leaf_count(), leaves.len(), "{context}");
        for (leaf, want) in leaves.iter().enumerate() {
            let context = format!("{context} leaf {leaf}");
            let origin: [i32; 3] = serde_json::from_value(want["origin"].clone()).unwrap();
            assert_eq!(points.offsets.leaves.origins[leaf], origin, "{context}");
            assert_eq!(points.leaf_point_count(leaf) as u64, want["points"].as_u64().unwrap(), "{context}");
            match want.get("positions") {
                None => assert!(points.positions_index(leaf).is_none(), "{context}"),
                Some(positions) => {
                    let mut index = points.positions_index(leaf).unwrap();
                    for pair in positions.as_array().unwrap() {
                        let pair: [[f64; 3]; 2] = serde_json::from_value(pair.clone()).unwrap();
                        assert_eq!([index.next().unwrap(), world.next().unwrap()], pair, "{context}");
                    }
                    assert_eq!(index.next(), None, "{context}");
                }
            }
            check_attributes(points, leaf, want, &context);
        }
        assert_eq!(world.next(), None, "{context}");
        checked += 1;
    }
    checked
}

fn check_attributes(points: &PointTree, leaf: usize, want: &Value, context: &str) {
    let set = points.attribute_set(leaf);
    let attributes = want["attributes"].as_array().unwrap();
    assert_eq!(set.attributes.len(), attributes.len(), "{context}");
    for (array, want) in points.attributes(leaf).zip(attributes) {
        let context = format!("{context} {}", array.attribute.name);
        assert_eq!(array.attribute.name, want["name"].as_str().unwrap(), "{context}");
        assert_eq!(array.attribute.value_type, want["type"].as_str().unwrap(), "{context}");
        assert_eq!(array.attribute.codec, want["codec"].as_str().unwrap(), "{context}");
        assert_eq!(array.point_count() as u64, want["points"].as_u64().unwrap(), "{context}");
        assert_eq!(array.stride().unwrap_or(0) as u64, want["stride"].as_u64().unwrap(), "{context}");
        assert_eq!(u64::from(array.is_uniform()), want["uniform"].as_u64().unwrap(), "{context}");
        assert_eq!(u64::from(array.is_hidden()), want["hidden"].as_u64().unwrap(), "{context}");
        assert!(!array.is_transient(), "{context}");
        let values = want["values"].as_array().unwrap();
        if array.attribute.codec == "str" {
            let texts: Vec<Value> =
                expanded(&array).iter().map(|value| set.text(*value as u32).unwrap().into()).collect();
            assert_eq!(&texts, values, "{context}");
        } else {
            let values: Vec<f64> = values.iter().map(|value| value.as_f64().unwrap()).collect();
            assert_eq!(expanded(&array), values, "{context}");
        }
    }
    let groups = want["groups"].as_object().unwrap();
    assert_eq!(set.groups.len(), groups.len(), "{context}");
    for (name, members) in groups {
        let group = points.group(leaf, name).unwrap();
        let members: Vec<usize> = serde_json::from_value(members.clone()).unwrap();
        for point in 0..=points.leaf_point_count(leaf) {
            assert_eq!(group.contains(point), members.contains(&point), "{context} {name} {point}");
        }
    }
    assert!(points.attribute(leaf, "nothing").is_none() && points.group(leaf, "nothing").is_none());
}

/// All numbers of an array, also if it is uniform.
fn expanded(array: &AttributeArray<'_>) -> Vec<f64> {
    let numbers = array.numbers().unwrap();
    let components = array.components();
    assert_eq!(array.value(array.len()), None);
    let number = |i: u64, k: usize| {
        assert!(array.value(i).is_some());
        let i = if array.is_uniform() { 0 } else { i as usize };
        numbers.get(i * components + k).unwrap()
    };
    (0..array.len()).flat_map(|i| (0..components).map(move |k| (i, k))).map(|(i, k)| number(i, k)).collect()
}

#[test]
fn positions_attributes_and_groups_are_as_openvdb_reads_them() {
    let truth = |name: &str| serde_json::from_slice::<Value>(&bytes_of(name)).unwrap();
    let codings = truth("codings_blosc.json");
    for (name, grids) in [("codings_blosc.vdb", 3), ("codings_zip.vdb", 2), ("codings_none.vdb", 1)] {
        let bytes = bytes_of(name);
        assert_eq!(check(&bytes, &codings, name), grids);
        assert_eq!(check(&surgery::as_stream(&bytes), &codings, name), grids);
    }
    let (bytes, sets) = (bytes_of("sets.vdb"), truth("sets.json"));
    assert_eq!(check(&bytes, &sets, "sets"), 1);
    assert_eq!(check(&surgery::as_stream(&bytes), &sets, "sets"), 1);
}

#[test]
fn arrays_of_many_pages_come_back() {
    let bytes = bytes_of("pages.vdb");
    for bytes in [surgery::as_stream(&bytes), bytes] {
        let file = File::open(&bytes[..]).unwrap();
        let grid = file.read_grid(0).unwrap();
        let points = points_of(&grid.tree);
        assert_eq!(points.point_count(), 160_000);
        for leaf in 0..points.leaf_count() {
            let x = f64::from(points.offsets.leaves.origins[leaf][0]);
            let [number, triple] = ["number", "triple"].map(|name| points.attribute(leaf, name).unwrap());
            let (number, triple) = (expanded(&number), expanded(&triple));
            assert_eq!((number.len(), triple.len()), (points.leaf_point_count(leaf), 3 * number.len()));
            for (i, value) in number.iter().enumerate() {
                assert_eq!(*value, x + (i / 1000) as f64);
                assert_eq!(triple[3 * i..][..3], [x, (i / 4096) as f64, 0.5]);
            }
        }
        let triples = |leaf: usize| points.attribute(leaf, "triple").unwrap().bytes().len();
        assert!(
            triples(0) > 1 << 20 && triples(1) < 1 << 19,
            "an array that fills a page, and a smaller one"
        );
        assert!(points.memory_bytes() > 160_000 * (3 + 4 + 24), "{}", points.memory_bytes());
    }
}

#[test]
fn a_box_holds_its_leaves_whole_and_no_others() {
    for name in ["codings_blosc.vdb", "sets.vdb"] {
        let bytes = bytes_of(name);
        let file = File::open(&bytes[..]).unwrap();
        let whole = file.read_grid(0).unwrap();
        let whole = points_of(&whole.tree);
        for bbox in [[[3, -2, 0], [8, 4, 7]], [[-100; 3], [300; 3]], [[-9; 3], [-9; 3]]] {
            let part = file.read_grid_in_box(0, bbox).unwrap();
            let part = points_of(&part.tree);
            let mut leaves = 0;
            for leaf in 0..whole.leaf_count() {
                let origin = whole.offsets.leaves.origins[leaf];
                let touches = (0..3).all(|i| origin[i] <= bbox[1][i] && bbox[0][i] <= origin[i] + 7);
                let found = part.offsets.leaves.origins.iter().position(|o| *o == origin);
                assert_eq!(found.is_some(), touches, "{name} {bbox:?} {origin:?}");
                let Some(found) = found else { continue };
                leaves += 1;
                assert_eq!(part.offsets.leaves.stored(found), whole.offsets.leaves.stored(leaf));
                assert_eq!(part.attribute_set(found), whole.attribute_set(leaf));
                for (a, b) in part.attributes(found).zip(whole.attributes(leaf)) {
                    assert_eq!((a.bytes(), a.len()), (b.bytes(), b.len()), "{name} {}", a.attribute.name);
                }
            }
            assert_eq!(part.leaf_count(), leaves);
        }
    }
}

#[test]
fn point_indices_are_named_and_passed_over() {
    let bytes = bytes_of("indices.vdb");
    for bytes in [surgery::as_stream(&bytes), bytes] {
        let file = File::open(&bytes[..]).unwrap();
        let [indices, other] = ["indices", "other"].map(|name| file.find(name).unwrap());
        assert!(!file.grids[indices].is_readable());
        assert!(matches!(file.read_grid(indices), Err(Error::Unsupported { .. })));
        assert_eq!(file.read_grid(other).unwrap().tree.voxel([1, 2, 3]).components, [5.0]);
    }
}

#[test]
fn values_of_unknown_types_keep_their_bytes() {
    let bytes = bytes_of("codings_none.vdb");
    let mut other = bytes.clone();
    let at = bytes.windows(5).position(|window| window == b"quats").unwrap();
    other[at..at + 5].copy_from_slice(b"octos");
    let [known, unknown] =
        [&bytes, &other].map(|bytes| File::open(&bytes[..]).unwrap().read_grid(0).unwrap());
    let [known, unknown] = [&known, &unknown].map(|grid| points_of(&grid.tree));
    for leaf in 0..known.leaf_count() {
        let arrays = [known, unknown].map(|points| points.attribute(leaf, "quats").unwrap());
        assert_eq!(arrays[1].attribute.value_type, "octos");
        assert_eq!(arrays[1].numbers(), None);
        assert_eq!(arrays[1].bytes(), arrays[0].bytes());
        assert_eq!(arrays[1].value_bytes(), 16);
    }
}

#[test]
fn points_before_the_passes_are_named() {
    let mut bytes = bytes_of("codings_none.vdb");
    bytes[8..12].copy_from_slice(&223_u32.to_le_bytes());
    let result = File::open(&bytes[..]).unwrap().read_grid(0);
    assert!(matches!(&result, Err(Error::Unsupported { feature }) if feature.contains("223")), "{result:?}");
}

/// Reads all grids and makes use of what is in them.
fn use_all(bytes: &[u8]) -> Result<u64, Error> {
    let file = File::open_with(bytes, Limits { max_memory_bytes: 64 << 20 })?;
    let mut used = 0;
    for index in (0..file.grids.len()).filter(|index| file.grids[*index].is_readable()) {
        let grid = file.read_grid(index)?;
        let AnyTree::Points(points) = &*grid.tree else { continue };
        used += points.positions_world(&grid.transform).take(10_000).count() as u64;
        used += points.memory_bytes();
        for leaf in 0..points.leaf_count() {
            for array in points.attributes(leaf) {
                used += array.numbers().map_or(0, |numbers| numbers.len()) as u64;
                used += array.value(array.len().saturating_sub(1)).map_or(0, <[u8]>::len) as u64;
            }
            for group in &points.attribute_set(leaf).groups {
                used += u64::from(points.group(leaf, &group.name).is_some_and(|group| group.contains(0)));
            }
        }
        file.read_grid_in_box(index, [[0; 3], [9; 3]])?;
    }
    Ok(used)
}

/// Errors are the file's fault, and say where.
fn survives(bytes: &[u8], context: &str) -> bool {
    match use_all(bytes) {
        Ok(_) => true,
        Err(Error::Malformed { offset, .. }) => {
            assert!(offset <= bytes.len() as u64, "{context}: at {offset}");
            false
        }
        Err(Error::Unsupported { .. } | Error::Limit { .. }) => false,
        Err(error) => panic!("{context}: {error:?}"),
    }
}

#[test]
fn every_truncation_is_an_error() {
    for name in ["codings_none.vdb", "codings_blosc.vdb"] {
        let bytes = surgery::first_grid(&bytes_of(name));
        let layout = surgery::layout(&bytes);
        assert!(survives(&bytes, name));
        // All cuts near the end, and some everywhere.
        for len in (0..bytes.len()).filter(|len| *len > bytes.len() - 700 || len % 61 == 0) {
            assert!(!survives(&bytes[..len], &format!("{name} cut at {len}")), "{name} cut at {len}");
            if len > layout.grids[0].begin {
                let cut = surgery::cut_with_its_end(&bytes, &layout, len);
                assert!(!survives(&cut, &format!("{name} ends at {len}")), "{name} ends at {len}");
            }
        }
    }
}

#[test]
fn random_damage_is_an_error_or_a_grid() {
    let mut state = 1_u64;
    let mut random = |end: usize| {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((state >> 33) % end as u64) as usize
    };
    let (mut sound, mut refused) = (0, 0);
    for name in ["codings_none.vdb", "codings_blosc.vdb", "sets.vdb", "indices.vdb"] {
        let bytes = bytes_of(name);
        let begin = surgery::layout(&bytes).grids[0].begin;
        let end = surgery::layout(&bytes).grids[0].end;
        for round in 0..200 {
            // Half of them as streams, in which the damage of one grid moves the next.
            let mut damaged = if round % 2 == 0 { bytes.clone() } else { surgery::as_stream(&bytes) };
            for _ in 0..1 + random(3) {
                // Mostly in what stands behind the masks of the topology.
                let at = end - 1 - random(end - begin) / (1 + 3 * (round % 2));
                damaged[at] = [damaged[at] ^ 1 << random(8), 0, 0xff, random(256) as u8][random(4)];
            }
            match survives(&damaged, &format!("{name} round {round}")) {
                true => sound += 1,
                false => refused += 1,
            }
        }
    }
    assert!(sound > 50 && refused > 200, "{sound} sound, {refused} refused");
}
