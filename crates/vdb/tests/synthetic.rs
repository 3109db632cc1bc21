//! Files of every version, shape and kind, written after the format's history by code that shares nothing with this
//! crate, against what their descriptions say.

use nuage_testkit::synthetic::{self, SyntheticFile, SyntheticGrid};
use nuage_vdb::{Error, File, Grid};

#[test]
fn every_synthetic_file_is_read_as_it_is_described() {
    let (mut read, mut refused) = (0, 0);
    let mut versions = std::collections::BTreeSet::new();
    for (name, described) in synthetic::corpus() {
        let bytes = described.bytes();
        let file = match File::open(&bytes[..]) {
            Ok(file) => file,
            // A string's values are a memory image of the machine that wrote them: nothing to walk through.
            Err(Error::Unsupported { .. }) if !described.has_offsets && has_strings(&described) => {
                refused += 1;
                continue;
            }
            Err(error) => panic!("{name}: {error}"),
        };
        assert_eq!(file.file_version, described.version, "{name}");
        assert_eq!(file.library_version, described.library, "{name}");
        assert_eq!(file.grids.len(), described.grids.len(), "{name}");
        for (index, grid) in described.grids.iter().enumerate() {
            let context = format!("{name} {}", grid.name);
            let plain_name = grid.name.split('\x1e').next().unwrap();
            assert_eq!(file.grids[index].name, plain_name, "{context}");
            let tree = described.tree_of(grid);
            match file.read_grid(index) {
                Ok(got) => check(&got, grid, tree, &context),
                Err(Error::Unsupported { feature }) if grid.value_type == "string" => {
                    assert!(feature.contains("string"), "{feature}");
                    refused += 1;
                    continue;
                }
                Err(error) => panic!("{context}: {error}"),
            }
            check_box(&file, index, tree, &context);
            read += 1;
        }
        versions.insert(described.version);
    }
    assert_eq!(versions, (213..=226).collect());
    assert!(read >= 100 && refused >= 2, "{read} read, {refused} refused");
}

fn has_strings(file: &SyntheticFile) -> bool {
    file.grids.iter().any(|grid| grid.value_type == "string")
}

fn check(got: &Grid, grid: &SyntheticGrid, tree: &SyntheticGrid, context: &str) {
    let type_name = grid.type_name();
    assert_eq!(got.grid_type(), type_name.trim_end_matches("_HalfFloat"), "{context}");
    for index in [[0.0; 3], [1.0, 0.0, 0.0], [10.0, -20.0, 30.0], [0.5, 7.25, 12.125]] {
        let (got, want) = (got.transform.world_from_index(index), grid.transform.world_from_index(index));
        for (got, want) in got.iter().zip(want) {
            assert!((got - want).abs() <= 1e-9 * want.abs().max(1.0), "{context}: {got}, not {want}");
        }
    }
    for ijk in tree.coordinates() {
        let (got, want) = (got.tree.voxel(ijk), tree.at(ijk));
        assert_eq!(got.components, want.value, "{context} {ijk:?}");
        assert_eq!((got.active, got.depth), (want.active, want.depth), "{context} {ijk:?}");
    }
}

/// The box around one of the leaves or tiles, read alone.
fn check_box(file: &File<&[u8]>, index: usize, tree: &SyntheticGrid, context: &str) {
    let Some(leaf) = tree.leaves.last() else { return };
    let bbox = [leaf.origin.map(|c| c + 1), leaf.origin.map(|c| c + 4)];
    let part = file.read_grid_in_box(index, bbox).unwrap_or_else(|e| panic!("{context}: {e}"));
    for ijk in tree.coordinates() {
        let (got, want) = (part.tree.voxel(ijk), tree.at(ijk));
        if (0..3).all(|i| bbox[0][i] <= ijk[i] && ijk[i] <= bbox[1][i]) {
            assert_eq!((got.components, got.active), (want.value, want.active), "{context} {ijk:?}");
        } else {
            assert!(!got.active, "{context} {ijk:?}");
        }
    }
}

#[test]
fn every_prefix_of_a_synthetic_file_is_an_error() {
    for (name, described) in synthetic::corpus() {
        let bytes = described.bytes();
        let step = 1 + bytes.len() / 150;
        for len in (0..bytes.len()).step_by(step) {
            let result = File::open(&bytes[..len]).and_then(|file| file.read_all());
            assert!(
                matches!(result, Err(Error::Malformed { .. } | Error::Unsupported { .. })),
                "{name} after {len} of {} bytes: {:?}",
                bytes.len(),
                result.map(|grids| grids.len())
            );
        }
    }
}

#[test]
fn other_versions_are_refused_by_their_number() {
    let (_, described) = synthetic::corpus().swap_remove(0);
    for version in [0_u32, 1, 200, 212, 227, 999, u32::MAX] {
        let mut bytes = described.bytes();
        bytes[8..12].copy_from_slice(&version.to_le_bytes());
        match File::open(&bytes[..]).map(|_| ()) {
            Err(Error::Unsupported { feature }) => {
                assert!(feature.contains(&version.to_string()), "{feature}")
            }
            other => panic!("version {version}: {other:?}"),
        }
    }
}
