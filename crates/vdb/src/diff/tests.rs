//! Comparing trees quickly against comparing them one voxel after the other.

use proptest::prelude::*;

use super::*;
use crate::tree::Shape;
use crate::{LEAF_VOXELS, TreeBuilder};

/// A tree of some leaves and tiles in a small part of space, negative coordinates included.
fn tree(backgrounds: std::ops::Range<i32>) -> impl Strategy<Value = Tree<f32>> {
    let cell = (0..4_i32, 0..4_i32, 0..4_i32).prop_map(|(x, y, z)| [x, y, z].map(|c| (c - 2) * 8));
    let leaves = proptest::collection::btree_map(cell, (any::<u64>(), 0..4_u8, any::<bool>()), 1..12);
    (leaves, backgrounds).prop_map(|(leaves, background)| {
        let mut builder = TreeBuilder::new(background as f32, Shape::STANDARD);
        for (origin, (mask, value, is_tile)) in leaves {
            match is_tile {
                true => builder.tile(2, origin, f32::from(value), mask & 1 == 1),
                false => {
                    let values: Vec<f32> =
                        (0..LEAF_VOXELS).map(|i| f32::from(value) + (i % 7) as f32).collect();
                    builder.leaf(origin, &[mask; 8], &values);
                }
            }
        }
        builder.build().unwrap()
    })
}

fn compare(a: &Tree<f32>, b: &Tree<f32>) -> VoxelDifference {
    walk::compare(a, b, &Options::default())
}

/// What comparing voxel by voxel over the whole of the part of space that [`tree`] fills gives.
fn compare_slowly(a: &Tree<f32>, b: &Tree<f32>) -> VoxelDifference {
    let mut found = VoxelDifference::default();
    let errors = &mut found.components[0];
    errors.peak = f64::from(a.background.abs());
    for x in -16..16 {
        for y in -16..16 {
            for z in -16..16 {
                let [p, q] = [a, b].map(|tree| tree.voxel([x, y, z]));
                let error = f64::from((p.value - q.value).abs());
                let active = p.active || q.active;
                found.active += u64::from(active);
                found.differing_values += u64::from(active && error > 0.0);
                found.differing_inactive_values += u64::from(!active && error > 0.0);
                found.differing_states += u64::from(p.active != q.active);
                if error > errors.max {
                    errors.max = error;
                    errors.max_values = [p.value, q.value].map(f64::from);
                }
                errors.sign_changes += u64::from((p.value < 0.0) != (q.value < 0.0));
                if p.value != a.background {
                    errors.compared += 1;
                    errors.sum += error;
                    errors.squares += error * error;
                    errors.peak = errors.peak.max(f64::from(p.value.abs()));
                } else {
                    errors.background_squares += error * error;
                    errors.fog = errors.fog.max(error);
                }
            }
        }
    }
    found
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn a_tree_equals_itself(tree in tree(-2..2)) {
        let found = compare(&tree, &tree);
        prop_assert!(found.is_equal());
        prop_assert_eq!(found.active, tree.active_voxel_count());
        let errors = found.errors();
        prop_assert_eq!((errors.max, errors.max_at, errors.psnr()), (0.0, None, f64::INFINITY));
        prop_assert_eq!((found.nodes_only_in_a, found.nodes_only_in_b), (0, 0));
    }

    #[test]
    fn a_changed_voxel_is_found_with_its_coordinate(
        tree in tree(-2..2), leaf in any::<prop::sample::Index>(), offset in 0..LEAF_VOXELS, change in 1..100_u8,
    ) {
        prop_assume!(!tree.leaves.is_empty());
        let leaf = leaf.index(tree.leaves.len());
        let [x, y, z] = tree.leaves.origins[leaf];
        let ijk = [x + (offset >> 6) as i32, y + (offset >> 3 & 7) as i32, z + (offset & 7) as i32];
        let mut changed = tree.clone();
        changed.leaves.values[leaf * LEAF_VOXELS + offset] += f32::from(change);
        let found = compare(&tree, &changed);
        let active = tree.voxel(ijk).active;
        prop_assert_eq!([found.differing_values, found.differing_inactive_values], if active { [1, 0] } else { [0, 1] });
        let errors = found.errors();
        prop_assert_eq!((errors.max, errors.max_at), (f64::from(change), Some(ijk)));
        let before = tree.voxel(ijk).value;
        prop_assert_eq!(errors.max_values, [before, before + f32::from(change)].map(f64::from));
        let is_fog = before == tree.background;
        prop_assert_eq!((errors.fog, errors.fog_at), if is_fog { (errors.max, Some(ijk)) } else { (0.0, None) });
        prop_assert_eq!(&found.first, &vec![ijk]);
        let tolerance = f64::from(change);
        let tolerant = Options { tolerance, ..Options::default() };
        prop_assert!(walk::compare(&tree, &changed, &tolerant).is_equal());
        let active_only = Options { active_only: true, ..Options::default() };
        prop_assert_eq!(walk::compare(&tree, &changed, &active_only).is_equal(), !active);
        changed = tree.clone();
        changed.leaves.masks[leaf * 8 + offset / 64] ^= 1 << (offset % 64);
        let found = compare(&tree, &changed);
        prop_assert_eq!((found.differing_states, found.differing_values), (1, 0));
        prop_assert_eq!(found.first, vec![ijk]);
    }

    #[test]
    fn two_trees_differ_as_their_voxels_do((a, b) in (tree(0..1), tree(0..1))) {
        let (fast, slow) = (compare(&a, &b), compare_slowly(&a, &b));
        prop_assert_eq!(fast.active, slow.active);
        prop_assert_eq!(fast.differing_values, slow.differing_values);
        prop_assert_eq!(fast.differing_inactive_values, slow.differing_inactive_values);
        prop_assert_eq!(fast.differing_states, slow.differing_states);
        prop_assert_eq!(fast.is_equal(), slow.is_equal());
        // The worst voxel is the first in the order of the tree, which is not that of coordinates.
        let errors = fast.errors();
        prop_assert_eq!(errors.max_at.is_some(), errors.max > 0.0);
        prop_assert_eq!(errors.fog_at.is_some(), errors.fog > 0.0);
        if let Some(at) = errors.max_at {
            prop_assert_eq!([&a, &b].map(|tree| f64::from(tree.voxel(at).value)), errors.max_values);
        }
        let places = (errors.max_at, errors.max_values, errors.fog_at);
        let expected = Errors { max_at: places.0, max_values: places.1, fog_at: places.2, ..slow.errors() };
        prop_assert_eq!(errors, expected);
    }
}

#[test]
fn a_tile_equals_the_leaves_that_fill_it() {
    let mut tile = TreeBuilder::new(0.0_f32, Shape::STANDARD);
    tile.tile(1, [0; 3], 2.5, true);
    let mut leaves = TreeBuilder::new(0.0_f32, Shape::STANDARD);
    for i in 0..4096 {
        let origin = [i >> 8, i >> 4 & 15, i & 15].map(|c| c * 8);
        leaves.leaf(origin, &[!0; 8], &[2.5; LEAF_VOXELS]);
    }
    let [tile, leaves] = [tile, leaves].map(|builder| builder.build().unwrap());
    let found = compare(&tile, &leaves);
    assert!(found.is_equal());
    assert_eq!((found.active, found.nodes_only_in_a, found.nodes_only_in_b), (1 << 21, 0, 4097));
    assert_eq!(compare(&leaves, &tile).nodes_only_in_a, 4097);
}

#[test]
fn large_tiles_are_compared_as_a_whole() {
    let with_tile = |value: f32| {
        let mut builder = TreeBuilder::new(0.0_f32, Shape::STANDARD);
        builder.tile(0, [-4096, 0, 0], value, true);
        builder.build().unwrap()
    };
    let found = compare(&with_tile(1.0), &with_tile(1.5));
    assert_eq!((found.active, found.differing_values), (1 << 36, 1 << 36));
    let errors = found.errors();
    assert_eq!((errors.max, errors.max_at, errors.max_values), (0.5, Some([-4096, 0, 0]), [1.0, 1.5]));
    assert_eq!((errors.mean(), errors.rms()), (0.5, 0.5));
    assert!((errors.psnr() - 20.0 * 2.0_f64.log10()).abs() < 1e-12);
    let mut both = found.clone();
    both.merge(compare(&with_tile(4.0), &with_tile(-0.5)), 10);
    let errors = both.errors();
    assert_eq!((errors.max, errors.max_values, errors.peak), (4.5, [4.0, -0.5], 4.0));
    assert_eq!((errors.compared, errors.sign_changes), (1 << 37, 1 << 36));
    assert_eq!(errors.rms(), ((0.25 + 20.25) / 2.0_f64).sqrt());
}

fn grid_of<V: Value>(value: V) -> Grid
where
    AnyTree: From<Tree<V>>,
{
    let mut builder = TreeBuilder::new(V::default(), Shape::STANDARD);
    builder.tile(2, [0; 3], value, true);
    Grid::new("g", Transform::identity(), builder.build().unwrap())
}

#[test]
fn numbers_of_different_types_are_compared_as_numbers() {
    let exact = Options::default();
    let voxels = |a: &Grid, b: &Grid| grids(a, b, &exact).voxels;
    let same = grids(&grid_of(0.5_f32), &grid_of(0.5_f64), &exact);
    assert!(same.has_equal_voxels() && !same.is_equal());
    assert_eq!(same.disagreements[0].what, "type");
    assert_eq!(voxels(&grid_of(2_i32), &grid_of(2.5_f32)).unwrap().errors().max, 0.5);
    assert!(voxels(&grid_of(1_i32), &grid_of([1_i32; 3])).is_none());
    let big = 1_i64 << 60;
    assert_eq!(voxels(&grid_of(big), &grid_of(big + 1)).unwrap().errors().max, 1.0);
    assert!(voxels(&grid_of(7_i64), &grid_of(7_i32)).unwrap().is_equal());
    let found = voxels(&grid_of([1.0_f32, 2.0, 3.0]), &grid_of([1.0_f64, 2.0, 4.0])).unwrap();
    let errors = found.errors();
    assert_eq!((errors.max, errors.mean(), errors.peak), (1.0, 1.0 / 3.0, 3.0));
    assert_eq!(
        found.components.map(|errors| (errors.max, errors.peak)),
        [(0.0, 1.0), (0.0, 2.0), (1.0, 3.0)]
    );
}

#[test]
fn not_a_number_equals_itself_and_nothing_else() {
    let (nan, inf) = (grid_of(f32::NAN), grid_of(f32::INFINITY));
    let options = Options { tolerance: 1e30, ..Options::default() };
    for grid in [&nan, &inf] {
        assert!(grids(grid, grid, &options).is_equal());
    }
    for (a, b) in [(&nan, &inf), (&inf, &nan), (&grid_of(1.0_f32), &nan), (&grid_of(-f32::INFINITY), &inf)] {
        let found = grids(a, b, &options).voxels.unwrap();
        assert_eq!((found.not_finite, found.is_equal(), found.errors().compared), (512, false, 0));
    }
}

#[test]
fn headers_are_compared_and_weighed() {
    let a = grid_of(1.0_f32);
    let mut b = a.clone();
    b.save_float_as_half = true;
    b.metadata.insert("file_mem_bytes", MetaValue::from_int64(7));
    b.transform.type_name = "ScaleMap".into();
    let found = grids(&a, &b, &Options::default());
    assert!(found.is_equal());
    let whats: Vec<&str> = found.disagreements.iter().map(|d| d.what.as_str()).collect();
    assert_eq!(whats, ["saved as", "type of the transform", "metadata 'file_mem_bytes'"]);
    b.metadata.insert("creator", MetaValue::from_text("x"));
    assert!(!grids(&a, &b, &Options::default()).is_equal());
    let mut c = a.clone();
    c.transform = Transform::uniform_scale(1.0 + 1e-9);
    assert!(!grids(&a, &c, &Options::default()).is_equal());
    assert!(grids(&a, &c, &Options { transform_tolerance: 1e-8, ..Options::default() }).is_equal());
}

#[test]
fn grids_are_paired_by_name() {
    let pairs = pair_names(&["a", "b", "c", "c"], &["c", "d", "a", "c"]);
    assert_eq!(pairs.both, [[0, 2], [2, 0], [3, 3]]);
    assert_eq!((pairs.only_a, pairs.only_b), (vec![1], vec![1]));
}
