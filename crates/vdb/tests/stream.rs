//! Files without grid positions, as written to a stream, and grids that share a tree.

mod surgery;

use std::sync::Arc;

use nuage_testkit as testkit;
use nuage_vdb::{AnyTree, Error, File};

fn committed() -> impl Iterator<Item = (String, Vec<u8>)> {
    let folder = std::fs::read_dir(testkit::committed("data/edge")).unwrap();
    let paths = folder.map(|entry| entry.unwrap().path());
    let files = paths.filter(|path| path.extension().is_some_and(|extension| extension == "vdb"));
    files.map(|path| (path.display().to_string(), std::fs::read(&path).unwrap()))
}

/// Equal, with values that are not numbers compared by their bits.
fn assert_same(a: &AnyTree, b: &AnyTree, context: &str) {
    assert_eq!(a.grid_type(), b.grid_type(), "{context}");
    assert_eq!(a.topology_hash(), b.topology_hash(), "{context}");
    assert_eq!(a.leaf_value_hash(), b.leaf_value_hash(), "{context}");
    let (stats, other) = (a.statistics(), b.statistics());
    // As text, since a sum over infinities of both signs is not equal to itself.
    assert_eq!(format!("{stats:?}"), format!("{other:?}"), "{context}");
    let has_nan = stats.nan_count > 0 || a.background().iter().any(|x| x.is_nan());
    assert!(a == b || has_nan, "{context}");
}

#[test]
fn a_stream_holds_the_same_grids_as_a_file() {
    let (mut several, mut read) = (0, 0);
    for (name, bytes) in committed() {
        let file = File::open(&bytes[..]).unwrap();
        let stream = surgery::as_stream(&bytes);
        let streamed = match File::open(&stream[..]) {
            Ok(streamed) => streamed,
            Err(error) => panic!("{name}: {error}"),
        };
        assert_eq!(streamed.metadata, file.metadata);
        assert_eq!(streamed.grids.len(), file.grids.len());
        for (index, (a, b)) in file.grids.iter().zip(&streamed.grids).enumerate() {
            assert_eq!((&a.unique_name, &a.grid_type), (&b.unique_name, &b.grid_type));
            assert_eq!((&a.metadata, &a.transform), (&b.metadata, &b.transform));
            let context = format!("{name} {}", a.unique_name);
            let [a, b] = [file.read_grid(index), streamed.read_grid(index)].map(Result::unwrap);
            assert_same(&a.tree, &b.tree, &context);
            read += 1;
        }
        several += usize::from(file.grids.len() > 1);
    }
    assert!(several >= 12 && read >= 70, "{several} {read}");
}

#[test]
fn a_shared_tree_is_read_from_its_owner() {
    let bytes = std::fs::read(testkit::committed("data/edge/comp_random_zip.vdb")).unwrap();
    let shared = surgery::with_instance(&bytes, b"twin", b"random", [1.0, 2.0, 3.0]);
    for shared in [surgery::as_stream(&shared), shared] {
        let file = File::open(&shared[..]).unwrap();
        let [own, twin] = [0, 1].map(|i| file.read_grid(i).unwrap());
        assert_same(&own.tree, &twin.tree, "twin");
        assert_eq!(twin.name, "twin");
        assert_eq!(file.grids[1].instance_of.as_deref(), Some("random"));
        let all = file.read_all().unwrap();
        assert!(Arc::ptr_eq(&all[0].tree, &all[1].tree) && all[0].tree == own.tree);
        assert_eq!(twin.transform.world_from_index([0.5; 3]), [1.5, 2.5, 3.5]);
    }
}

#[test]
fn a_shared_tree_that_is_missing_is_malformed() {
    let bytes = std::fs::read(testkit::committed("data/edge/comp_random_zip.vdb")).unwrap();
    // None of that name, and one that shares itself.
    for owner in [&b"nobody"[..], b"twin"] {
        let shared = surgery::with_instance(&bytes, b"twin", owner, [0.0; 3]);
        for shared in [surgery::as_stream(&shared), shared] {
            let file = File::open(&shared[..]).unwrap();
            assert!(file.read_grid(0).is_ok());
            let result = file.read_grid(1);
            assert!(matches!(result, Err(Error::Malformed { .. })), "{result:?}");
        }
    }
}
