//! Counts held against the packed tree itself, and walks against cells looked at one by one.

use std::collections::BTreeSet;

use glam::{DVec3, IVec3};
use nuage_volume::brick::BrickSummary;
use nuage_volume::build::TreeBuilder;
use nuage_volume::codec::Codec;
use nuage_volume::packed::build::{EntryScale, Packer};
use nuage_volume::packed::{Content, Trees, mask};
use nuage_volume::space::{NODE4_SLOTS, NODE5_SLOTS, node4_slot_brick, node5_slot_brick};
use proptest::prelude::*;

use super::*;

fn bricks_within(extent: i32, count: usize) -> impl Strategy<Value = Vec<IVec3>> {
    let brick = (0..extent, 0..extent, 0..extent).prop_map(|(x, y, z)| IVec3::new(x, y, z));
    (proptest::collection::vec(brick, 1..count), (-9_i32..9, -9_i32..9, -9_i32..9)).prop_map(
        |(mut bricks, (x, y, z))| {
            bricks.iter_mut().for_each(|brick| *brick += IVec3::new(x, y, z) * 16);
            bricks
        },
    )
}

/// The packed tree of bricks of all different words, and where its nodes have entries of the size of a brick.
fn packed(bricks: &[IVec3]) -> (Trees, Vec<IVec3>) {
    let offset: IVec3 = bricks.iter().copied().reduce(IVec3::min).unwrap() & !15;
    let unique: BTreeSet<[i32; 3]> = bricks.iter().map(|brick| (*brick - offset).to_array()).collect();
    let mut builder = TreeBuilder::new();
    let values: [f32; 512] = std::array::from_fn(|i| 1.0 + i as f32);
    for brick in &unique {
        builder.brick(IVec3::from_array(*brick), BrickSummary::of(&values)).unwrap();
    }
    let tree = builder.topology().unwrap();
    let places: Vec<(Codec, u32)> = (0..unique.len() as u32).map(|i| (Codec::F32, i * 512)).collect();
    let mut packer = Packer::default();
    let scale = EntryScale { unit: 1024.0, background: 0.0 };
    packer.add(&tree, &places, scale, |value| value).unwrap();
    let trees = packer.finish();
    let mut entries = Vec::new();
    for cell in &trees.cells {
        let Some(Content::Node(node5)) = cell.entry.content() else { continue };
        let node5 = trees.node5s[node5 as usize];
        for (i, slot) in mask::slots(&trees, node5.mask, NODE5_SLOTS).enumerate() {
            let entry = trees.entries[node5.first_entry as usize + i];
            let Some(Content::Node(node4)) = entry.content() else { continue };
            let first = node5_slot_brick(IVec3::from_array(cell.cell) << 9, slot);
            let slots = mask::slots(&trees, trees.node4s[node4 as usize].mask, NODE4_SLOTS);
            entries.extend(slots.map(|slot| node4_slot_brick(first, slot)));
        }
    }
    (trees, entries)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn nodes_and_bytes_of_5_4_3_are_those_of_the_packed_tree(bricks in bricks_within(90, 40)) {
        // Away from the lower sides of nodes: what is before those would be tiles, of which no topology knows.
        let bricks: Vec<IVec3> =
            bricks.into_iter().map(|brick| (brick & !15) + (brick & 15).max(IVec3::ONE)).collect();
        let (trees, entries) = packed(&bricks);
        let topology = Topology::new(&entries, &[5, 4, 3]).unwrap();
        prop_assert_eq!(topology.bricks(), entries.len());
        prop_assert_eq!(topology.nodes(), vec![trees.node5s.len(), trees.node4s.len()]);
        prop_assert_eq!(topology.entries(), trees.entries.len());
        prop_assert_eq!(topology.packed_bytes(Masks::Shared), trees.size_bytes());
    }

    #[test]
    fn a_walk_visits_the_cells_that_the_ray_passes(
        bricks in bricks_within(20, 30),
        from in proptest::array::uniform3(-300.0..300.0_f64),
        to in proptest::array::uniform3(0.0..160.0_f64),
        widths in prop_oneof![
            Just(vec![5, 4, 3]), Just(vec![3, 3, 3]), Just(vec![2, 2, 4]), Just(vec![1, 1, 1, 1, 1, 3]), Just(vec![2, 3, 3])
        ],
    ) {
        let topology = Topology::new(&bricks, &widths).unwrap();
        let first = bricks.iter().copied().reduce(IVec3::min).unwrap();
        let last = bricks.iter().copied().reduce(IVec3::max).unwrap();
        let offset: IVec3 = (first & !15) << 3;
        let origin = DVec3::from_array(from) + offset.as_dvec3();
        let direction = DVec3::from_array(to) - DVec3::from_array(from);
        let visits = topology.visits(origin, direction);

        // Every cell of every level inside the box, asked whether it is reached and passed.
        let ray = Ray { origin: origin - offset.as_dvec3(), direction };
        let (low, end) = ((first << 3) - offset, ((last + 1) << 3) - offset);
        let mut expected = Visits::default();
        if let Some(span) = ray.interval(low, end) {
            let voxels: Vec<IVec3> = bricks.iter().map(|brick| (*brick << 3) - offset).collect();
            let mut log2_cell: u32 = widths.iter().sum();
            let mut parents: Option<BTreeSet<[i32; 3]>> = None;
            for depth in 0..widths.len() {
                let cells: BTreeSet<[i32; 3]> = cells_of_box(low, end, log2_cell)
                    .filter(|cell| {
                        let (first, size) = (*cell << log2_cell as i32, 1 << log2_cell);
                        let parent = parents.as_ref().map(|parents| {
                            let parent: IVec3 = *cell >> widths[depth - 1] as i32;
                            parents.contains(&parent.to_array())
                        });
                        parent != Some(false) && ray.interval(first, first + size).is_some_and(|inside| {
                            inside[0].max(span[0]) < inside[1].min(span[1])
                        })
                    })
                    .map(|cell| cell.to_array())
                    .collect();
                expected.cells += cells.len() as u64;
                let full = |cell: &[i32; 3]| {
                    voxels.iter().any(|voxel| (*voxel >> log2_cell as i32).to_array() == *cell)
                };
                let full: BTreeSet<[i32; 3]> = cells.into_iter().filter(full).collect();
                if depth + 1 == widths.len() {
                    expected.bricks = full.len() as u64;
                }
                log2_cell -= widths[depth];
                parents = Some(full);
            }
        }
        prop_assert_eq!(visits, expected);
    }
}

fn cells_of_box(low: IVec3, end: IVec3, log2_cell: u32) -> impl Iterator<Item = IVec3> {
    let (low, high): (IVec3, IVec3) = (low >> log2_cell as i32, (end - 1) >> log2_cell as i32);
    let range = move |axis: usize| low[axis]..=high[axis];
    range(0).flat_map(move |x| range(1).flat_map(move |y| range(2).map(move |z| IVec3::new(x, y, z))))
}

#[test]
fn an_empty_volume_of_the_thesis_takes_16_mebibytes() {
    // Section 4.1: all nodes of the second level are there, with their masks of 512 bytes.
    let levels = Topology::new(&[IVec3::ZERO], &[5, 4, 3]).unwrap().unpacked(1);
    let mask_bytes = levels[0].nodes * levels[0].mask_bytes + levels[1].nodes * levels[1].mask_bytes;
    assert_eq!(mask_bytes, (1 << 12) + (16 << 20));
    assert_eq!(levels.iter().map(|level| 4 + level.mask_bytes).collect::<Vec<u64>>(), [4100, 516, 68]);
    assert_eq!(levels.iter().map(|level| level.nodes).collect::<Vec<u64>>(), [1, 32768, 4096]);
}

/// Table 3: frames, nodes and megabytes of each level.
const TABLE_3: [(u64, [u64; 3], [f64; 3]); 9] = [
    (1, [1, 32_768, 65_536], [0.004, 17.0, 4.0]),
    (1, [1, 32_768, 307_200], [0.004, 17.0, 21.0]),
    (1, [1, 32_768, 303_104], [0.004, 17.0, 20.0]),
    (1, [1, 32_768, 1_339_392], [0.004, 17.0, 91.0]),
    (1, [1, 32_768, 1_302_528], [0.004, 17.0, 88.0]),
    (10, [10, 327_680, 905_216], [0.041, 168.0, 61.0]),
    (1, [1, 32_768, 1_007_616], [0.004, 17.0, 69.0]),
    (100, [100, 3_276_800, 9_195_520], [0.410, 1678.0, 625.0]),
    (50, [50, 1_638_400, 9_658_368], [0.205, 838.0, 657.0]),
];

#[test]
fn node_counts_and_sizes_are_those_of_table_3() {
    for (frames, nodes, megabytes) in TABLE_3 {
        // As many nodes of the second level that are not empty as the table's bricks take, spread over the frames.
        let full = nodes[2] / 4096;
        assert_eq!(nodes[2] % 4096, 0);
        let mut sums = [(0, 0); 3];
        for frame in 0..frames {
            let count = full / frames + u64::from(frame < full % frames);
            let bricks: Vec<IVec3> =
                (0..count as i32).map(|i| IVec3::new(i & 31, i >> 5 & 31, i >> 10) * 16).collect();
            let levels = Topology::new(&bricks, &[5, 4, 3]).unwrap().unpacked(1);
            for (sum, level) in sums.iter_mut().zip(levels) {
                *sum = (sum.0 + level.nodes, sum.1 + level.bytes(Masks::Own));
            }
        }
        assert_eq!(sums.map(|(nodes, _)| nodes), nodes);
        let [l1, l2, l3] = sums.map(|(_, bytes)| bytes as f64 / 1e6);
        // The thesis rounds now up, now down.
        assert!((l1 - megabytes[0]).abs() < 0.001 && (l3 - megabytes[2]).abs() < 1.0, "{l1} {l3}");
        // Its second column is that of 512 bytes a node, the mask alone, though the text says 516.
        let masks_alone = l2 * 512.0 / 516.0;
        assert!((masks_alone - megabytes[1]).abs() < 1.0 && l2 >= megabytes[1] - 0.1, "{l2}");
    }
}

#[test]
fn masks_that_are_shared_stand_once() {
    // The same nodes of 16³ bricks, three times.
    let bricks: Vec<IVec3> = (0..3).flat_map(|i| [0, 5].map(|x| IVec3::new(x + 16 * i, 0, 0))).collect();
    let topology = Topology::new(&bricks, &[5, 4, 3]).unwrap();
    let fixed = 20 + 4 * 8 + (3 + 6) * 8;
    let [own, shared] = [Masks::Own, Masks::Shared].map(|masks| topology.packed_bytes(masks));
    let node4_mask = {
        let mut bits = vec![0_u32; 128];
        bits[0] |= 1;
        bits[5 * 8] |= 1;
        4 * mask::encode(&bits).len()
    };
    assert_eq!(own - shared, 2 * node4_mask);
    let unpacked = topology.unpacked(1);
    assert_eq!(unpacked[1].unique_masks, 2, "that of the three nodes, and the empty one");
    assert_eq!(unpacked[2].nodes, 3 * 4096);
    assert!(own > fixed && shared > fixed);
}

#[test]
fn what_is_no_tree_is_refused() {
    for widths in [&[][..], &[3], &[5, 4, 2], &[0, 4, 3], &[10, 3], &[9, 9, 9, 4]] {
        assert_eq!(Topology::new(&[IVec3::ZERO], widths), None, "{widths:?}");
    }
    assert_eq!(Topology::new(&[IVec3::splat(1 << 28)], &[5, 4, 3]), None);
    assert_eq!(Topology::new(&[IVec3::splat(-1 << 28), IVec3::ZERO], &[5, 4, 3]), None);
    let empty = Topology::new(&[], &[5, 4, 3]).unwrap();
    assert_eq!((empty.nodes(), empty.packed_bytes(Masks::Own)), (vec![0, 0], 0));
    assert_eq!(empty.visits(DVec3::ZERO, DVec3::X), Visits::default());
}
