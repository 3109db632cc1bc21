//! The packed tree against a list of regions, looked through one by one.

use glam::{IVec3, Vec3};
use nuage_volume::accessor::Accessor;
use nuage_volume::brick::{BrickSummary, Bricks};
use nuage_volume::build::{TileSize, TreeBuilder};
use nuage_volume::space::voxel_offset;
use nuage_volume::tree::{Content, Tree};
use proptest::prelude::*;

struct Naive {
    /// First brick, extent in bricks, values.
    regions: Vec<(IVec3, i32, Result<Vec<f32>, f32>)>,
}

impl Naive {
    fn voxel(&self, index: IVec3) -> f32 {
        for (brick, extent, values) in &self.regions {
            let local = index - *brick * 8;
            if local.min_element() >= 0 && local.max_element() < extent * 8 {
                return match values {
                    Ok(values) => values[voxel_offset(local)],
                    Err(value) => *value,
                };
            }
        }
        0.0
    }

    fn trilinear(&self, p: Vec3) -> f32 {
        let corner = p.floor();
        let f = p - corner;
        (0..8)
            .map(|i| {
                let d = IVec3::new(i >> 2 & 1, i >> 1 & 1, i & 1);
                let w = Vec3::select(d.cmpeq(IVec3::ONE), f, 1.0 - f);
                self.voxel(corner.as_ivec3() + d) * w.x * w.y * w.z
            })
            .sum()
    }
}

fn noise(i: usize, seed: u32) -> f32 {
    let h = (i as u32 ^ seed).wrapping_mul(2_654_435_761);
    ((h ^ h >> 15).wrapping_mul(2_246_822_519) >> 22) as f32 / 1024.0
}

/// A tree and its double: bricks and tiles thrown around the origin, one tile of each size.
fn random(placed: &[(i8, i8, i8, u8)], with_root_tile: bool, half: bool) -> (Tree, Naive) {
    let mut builder = TreeBuilder::new();
    let mut naive = Naive { regions: Vec::new() };
    let mut bricks = Vec::new();
    if with_root_tile {
        builder.tile(IVec3::splat(-512), TileSize::Node5, 0.25).unwrap();
        naive.regions.push((IVec3::splat(-512), 512, Err(0.25)));
    }
    for (x, y, z, kind) in placed {
        let brick = IVec3::new((*x).into(), (*y).into(), (*z).into());
        match kind {
            0 if builder.tile(brick & !15, TileSize::Node4, 0.75).is_ok() => {
                naive.regions.push((brick & !15, 16, Err(0.75)));
            }
            1 if builder.tile(brick, TileSize::Brick, 0.5).is_ok() => {
                naive.regions.push((brick, 1, Err(0.5)));
            }
            2.. => {
                let mut values = [0.0; 512];
                for (i, v) in values.iter_mut().enumerate() {
                    *v = if *kind == 2 { noise(i, (*x as u8).into()) } else { f32::from(i == 511) };
                }
                let taken = naive.regions.iter().any(|(b, e, _)| {
                    let local = brick - *b;
                    local.min_element() >= 0 && local.max_element() < *e
                });
                if !taken {
                    builder.brick(brick, BrickSummary::of(&values)).unwrap();
                    bricks.extend_from_slice(&values);
                    naive.regions.push((brick, 1, Ok(values.to_vec())));
                }
            }
            _ => {}
        }
    }
    let bricks = match half {
        true => Bricks::F16(bricks.iter().map(|v| half::f16::from_f32(*v).to_bits()).collect()),
        false => Bricks::F32(bricks),
    };
    (builder.finish(bricks).unwrap(), naive)
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    #[test]
    fn samples_and_bounds_agree(
        tiles in prop::collection::vec((-20i8..20, -20i8..20, -20i8..20, Just(0u8)), 0..2),
        placed in prop::collection::vec((-3i8..18, -3i8..18, -3i8..18, 1u8..4), 1..40),
        with_root_tile in any::<bool>(),
        half in any::<bool>(),
        points in prop::collection::vec((-40.0f32..180.0, -40.0f32..180.0, -40.0f32..180.0), 200),
    ) {
        let placed: Vec<_> = tiles.into_iter().chain(placed).filter(|(x, y, z, _)| {
            !with_root_tile || *x >= 0 || *y >= 0 || *z >= 0
        }).collect();
        let (tree, naive) = random(&placed, with_root_tile, half);
        let mut accessor = Accessor::new(&tree);
        // Half of the points fall near bricks, where the interesting cases are.
        let near = placed.iter().zip(&points).map(|((x, y, z, _), p)| {
            let brick = Vec3::new((*x).into(), (*y).into(), (*z).into()) * 8.0;
            brick + Vec3::new(p.0, p.1, p.2) / 18.0
        });
        let all: Vec<Vec3> = points.iter().map(|p| Vec3::new(p.0, p.1, p.2)).chain(near).collect();
        for p in all {
            let index = p.floor().as_ivec3();
            prop_assert_eq!(accessor.voxel(index), naive.voxel(index));
            prop_assert_eq!(accessor.nearest(p), naive.voxel((p + 0.5).floor().as_ivec3()));
            let (got, want) = (accessor.trilinear(p), naive.trilinear(p));
            prop_assert!((got - want).abs() <= 1e-5, "{} at {}, not {}", got, p, want);
            let region = tree.region(index >> 3);
            prop_assert_eq!(region, accessor.region(index >> 3));
            let bounds = region.footprint;
            prop_assert!(got >= bounds.min - 1e-6 && got <= bounds.max + 1e-6, "{got} outside {bounds:?} at {p}");
            if let Content::Constant(value) = region.content {
                prop_assert_eq!(value, naive.voxel(index));
            }
        }
        prop_assert!(tree.bounds().max <= 1.0);
    }
}

#[test]
fn overlaps_are_refused() {
    let summary = BrickSummary::of(&[1.0; 512]);
    let mut builder = TreeBuilder::new();
    builder.brick(IVec3::ZERO, summary).unwrap();
    assert!(builder.brick(IVec3::ZERO, summary).is_err());
    assert!(builder.tile(IVec3::ZERO, TileSize::Brick, 1.0).is_err());
    assert!(builder.tile(IVec3::ONE, TileSize::Node4, 1.0).is_err());
    assert!(builder.tile(IVec3::ONE, TileSize::Node5, 1.0).is_err());
    assert!(builder.tile(IVec3::splat(600), TileSize::Node5, 1.0).is_ok());
    assert!(builder.brick(IVec3::splat(601), summary).is_err());

    // What was there first has stayed, and what was refused left nothing behind.
    let tree = builder.finish(Bricks::F32(vec![1.0; 512])).unwrap();
    assert_eq!(tree.region(IVec3::ZERO).content, Content::Brick(0));
    assert_eq!(tree.region(IVec3::ONE).content, Content::Constant(0.0));
    assert_eq!(tree.region(IVec3::splat(601)).content, Content::Constant(1.0));
}

#[test]
fn regions_at_the_ends_of_index_space_are_kept() {
    let mut builder = TreeBuilder::new();
    let ends = [IVec3::splat((1 << 28) - 1), IVec3::splat(-(1 << 28))];
    for end in ends {
        builder.brick(end, BrickSummary::of(&[2.0; 512])).unwrap();
    }
    let tree = builder.finish(Bricks::F32(vec![2.0; 1024])).unwrap();
    let mut accessor = Accessor::new(&tree);
    assert_eq!(accessor.voxel(IVec3::MAX), 2.0);
    assert_eq!(accessor.voxel(IVec3::MIN), 2.0);
    assert_eq!(accessor.voxel(IVec3::ZERO), 0.0);
}
