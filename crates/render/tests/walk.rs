//! The walk of rays through trees, against the voxels themselves: nothing that is not zero is missed, constant
//! means constant, and no ray hangs, whatever its direction and wherever the volume lies.

mod common;

use common::{Random, absorbing, any_camera, clip, line_integral, to_index, trilinear, voxel};
use glam::{DAffine3, DMat3, DQuat, DVec3, EulerRot, IVec3};
use nuage_render::blocks::{BlockStore, Blocks};
use nuage_render::camera::Ray;
use nuage_render::march::{Marcher, Quality};
use nuage_render::traverse::{Field, Run, RunKind};
use nuage_volume::brick::{BrickSummary, Bricks};
use nuage_volume::build::{TileSize, TreeBuilder};
use nuage_volume::channel::{Channel, IndexBox};
use nuage_volume::space::{BRICK_VOXELS, LOG2_NODE4_BRICKS, LOG2_NODE5_BRICKS};

/// More runs than a ray through a few nodes can have.
const MAX_RUNS: usize = 20_000;

/// Cubes of bricks that do not overlap: first brick and extent.
#[derive(Default)]
struct Places(Vec<(IVec3, i32)>);

impl Places {
    fn take(&mut self, brick: IVec3, extent: i32) -> bool {
        let apart = |(other, size): &(IVec3, i32)| {
            (brick + extent).cmple(*other).any() || (*other + *size).cmple(brick).any()
        };
        let free = self.0.iter().all(apart);
        if free {
            self.0.push((brick, extent));
        }
        free
    }
}

/// A tree of bricks and tiles of all sizes around the brick `base`, a multiple of 512 along each axis.
fn random_channel(random: &mut Random, base: IVec3, large: bool, world_from_index: DAffine3) -> Channel {
    let mut builder = TreeBuilder::new();
    let mut values = Vec::new();
    let mut places = Places::default();
    if large {
        let cell = base + (IVec3::new(random.below(2), 0, -random.below(2)) << LOG2_NODE5_BRICKS);
        places.take(cell, 1 << LOG2_NODE5_BRICKS);
        builder.tile(cell, TileSize::Node5, 0.5).expect("a free place");
    }
    // Around the corner of eight nodes of all sizes, or around one inside.
    let corner = if random.below(2) == 0 { base } else { base + 48 };
    for _ in 0..random.below(4) {
        let step = IVec3::new(random.below(4) - 2, random.below(4) - 2, random.below(4) - 2);
        let node = corner + (step << LOG2_NODE4_BRICKS);
        if places.take(node, 1 << LOG2_NODE4_BRICKS) {
            let value = if random.below(4) == 0 { 0.0 } else { 0.75 };
            builder.tile(node, TileSize::Node4, value).expect("a free place");
        }
    }
    for _ in 0..1 + random.below(60) {
        let reach = if random.below(4) == 0 { 20 } else { 4 };
        let mut step = || random.below(2 * reach as u32) - reach;
        let brick = corner + IVec3::new(step(), step(), step());
        if !places.take(brick, 1) {
            continue;
        }
        let kind = random.below(5);
        if kind == 0 {
            builder.tile(brick, TileSize::Brick, 0.25).expect("a free place");
            continue;
        }
        let mut brick_values = [0.0; BRICK_VOXELS];
        match kind {
            // Single voxels at the corners, the hardest to find.
            1 => brick_values[0] = 1.0,
            2 => brick_values[BRICK_VOXELS - 1] = 1.0,
            3 => brick_values.fill(0.75),
            _ => brick_values.fill_with(|| random.unit() as f32),
        }
        builder.brick(brick, BrickSummary::of(&brick_values)).expect("a free place");
        values.extend(brick_values);
    }
    let tree = builder.finish(Bricks::F32(values)).expect("a small tree");
    let min = places.0.iter().map(|(brick, _)| *brick).reduce(IVec3::min).expect("a region");
    let last = places.0.iter().map(|(brick, extent)| *brick + (*extent - 1)).reduce(IVec3::max);
    let max = (last.expect("a region") << 3) + 7;
    Channel { tree, world_from_index, active_box: Some(IndexBox { min: min << 3, max }) }
}

/// A ray in index space through a point that is likely to matter.
fn random_ray(random: &mut Random, index: IndexBox) -> (DVec3, DVec3) {
    let (low, high) = (index.min.as_dvec3(), index.max.as_dvec3());
    // Towards the middle, where the bricks are.
    let middle = random.in_box(low, high).lerp((low + high) / 2.0, random.unit());
    let target = match random.below(4) {
        0 => (middle / 128.0).round() * 128.0,
        1 => (middle / 8.0).round() * 8.0 - f64::from(random.below(2)),
        _ => middle,
    };
    let sign = |random: &mut Random| f64::from(random.below(2) * 2 - 1);
    let direction = match random.below(6) {
        0 => DVec3::AXES[random.below(3) as usize] * sign(random),
        1 => DVec3::new(sign(random), sign(random), sign(random)).normalize(),
        // Negative zeros among the zeros.
        2 => -(DVec3::AXES[random.below(3) as usize] + DVec3::AXES[random.below(3) as usize]).normalize(),
        3 => (DVec3::AXES[random.below(3) as usize] + random.direction() * 1e-9).normalize(),
        _ => random.direction(),
    };
    let distance = match random.below(3) {
        0 => 0.0,
        1 => 100.0 * random.unit(),
        _ => 2.0 * (high - low).length(),
    };
    (target - direction * distance, direction)
}

fn turned() -> DMat3 {
    DMat3::from_quat(DQuat::from_euler(EulerRot::XYZ, 0.3, 0.8, -2.0))
        * DMat3::from_diagonal(DVec3::new(0.05, 0.07, -0.04))
}

/// What must hold of the runs of a ray. Returns how many there were.
fn check(channel: &Channel, ray: &Ray) -> usize {
    let field = Field::new(channel).expect("a field");
    let (origin, direction) = to_index(&channel.world_from_index.inverse(), ray);
    let value = |t: f64| trilinear(&|index| voxel(&channel.tree, index), origin + direction * t);
    let index = channel.active_box.expect("a box");
    let bounds = [index.min.as_dvec3() - 1.0, index.max.as_dvec3() + 1.0];
    let interval = field.interval(ray);
    let Some([start, end]) = interval else {
        // A ray may slip along a face of the box, where all is zero.
        let [t0, t1] = clip(origin, direction, bounds[0], bounds[1]).unwrap_or([0.0; 2]);
        for i in 0..=100 {
            let found = value(t0 + (t1 - t0) * f64::from(i) / 100.0);
            assert!(found < 1e-5, "{found} on a ray that misses, {origin} along {direction}");
        }
        return 0;
    };
    let at_start = clip(origin, direction, bounds[0] - 1e-6, bounds[1] + 1e-6).expect("a hit");
    let slack = 1e-5 / direction.length() * (1.0 + at_start[0].abs());
    for outside in [0.0, start - slack, end + slack] {
        let found = value(outside);
        assert!(outside >= start && outside <= end || outside < 0.0 || found < 1e-3, "{found} at {outside}");
    }

    let mut reader = field.reader();
    let length = (end - start) as f32;
    let runs: Vec<Run> =
        field.runs(&mut reader.walker, field.local(ray, start), 0.0, length).take(MAX_RUNS).collect();
    assert!(runs.len() < MAX_RUNS, "a walk without end");
    let mut last = 0.0;
    for run in &runs {
        assert!(last <= run.t0 && run.t0 < run.t1 && run.t1 <= length, "{run:?} after {last} of {length}");
        last = run.t1;
    }
    // Values differ by at most this where positions differ by what single precision leaves of them.
    let extent = (bounds[1] - bounds[0]).max_element();
    let slack = 0.005 + 4e-6 * extent;
    for run in &runs {
        if let RunKind::Constant(constant) = run.kind {
            for i in 0..=16 {
                let t = f64::from(run.t0) + f64::from(run.t1 - run.t0) * f64::from(i) / 16.0;
                let found = value(start + t);
                assert!((found - f64::from(constant)).abs() < slack, "{run:?}: {found} at {t}");
            }
        }
    }
    // Between the runs all is zero: every half voxel, and close to their ends.
    let gaps_from = std::iter::once(0.0).chain(runs.iter().map(|run| run.t1));
    let gaps_to = runs.iter().map(|run| run.t0).chain(std::iter::once(length));
    for (t0, t1) in gaps_from.zip(gaps_to).map(|(a, b)| (f64::from(a), f64::from(b))) {
        if t0 == t1 {
            continue;
        }
        let steps = ((t1 - t0) * direction.length() * 2.0).ceil().clamp(1.0, 4000.0) as u32;
        for i in 0..=steps {
            let t = t0 + (t1 - t0) * f64::from(i) / f64::from(steps);
            let found = value(start + t);
            assert!(
                found < slack,
                "{found} at {t} between runs, {t0} to {t1} of {length}: {origin} along {direction} from {start} in {index:?}"
            );
        }
    }
    runs.len()
}

/// Channels and rays at a place.
fn check_place(seed: u32, base: IVec3, large: bool, matrix: DMat3, rays: u32) -> usize {
    let mut random = Random(seed);
    let mut runs = 0;
    for _ in 0..6 {
        // The world's origin near the volume, so that the world's own coordinates are precise.
        let near = matrix * base.as_dvec3() * -8.0;
        let world_from_index = DAffine3 { matrix3: matrix, translation: near + DVec3::new(3.0, -7.0, 1.5) };
        let channel = random_channel(&mut random, base, large, world_from_index);
        for _ in 0..rays {
            let (origin, direction) = random_ray(&mut random, channel.active_box.expect("a box"));
            let ray = Ray {
                origin: world_from_index.transform_point3(origin),
                direction: (matrix * direction).normalize(),
            };
            runs += check(&channel, &ray);
        }
    }
    runs
}

#[test]
fn runs_cover_all_that_is_not_zero() {
    let runs = check_place(1, IVec3::ZERO, false, DMat3::IDENTITY, 200)
        + check_place(2, IVec3::ZERO, false, turned(), 200);
    assert!(runs > 1000, "{runs}");
}

#[test]
fn runs_hold_in_the_largest_tiles() {
    let runs = check_place(3, IVec3::ZERO, true, DMat3::IDENTITY * 0.01, 40)
        + check_place(4, IVec3::ZERO, true, turned(), 40);
    assert!(runs > 300, "{runs}");
}

#[test]
fn runs_hold_far_from_the_origin() {
    let aligned = |x: i32, y: i32, z: i32| IVec3::new(x, y, z) & !511;
    // Index coordinates near ±10⁹ and near both ends of what 32 bits hold.
    let end = (1 << 28) - 1024;
    let places = [
        aligned(125_000_000, -125_000_000, 0),
        aligned(-125_000_000, 125_000_000, 125_000_000),
        aligned(end, -end, 0),
        aligned(-end, end, end),
    ];
    for (seed, base) in (10..).zip(places) {
        let runs = check_place(seed, base, false, DMat3::IDENTITY, 40)
            + check_place(seed, base, false, turned(), 40);
        assert!(runs > 300, "{runs} at {base}");
    }
}

/// The last voxels that index coordinates can name. Nothing is asked of values, only that all ends.
#[test]
fn the_ends_of_index_space_are_safe() {
    for (brick, voxel) in [((1 << 28) - 1, i32::MAX), (-(1 << 28), i32::MIN)] {
        for size in [None, Some(TileSize::Brick), Some(TileSize::Node4), Some(TileSize::Node5)] {
            let mut builder = TreeBuilder::new();
            let brick = IVec3::splat(brick);
            let mut values = Vec::new();
            match size {
                Some(size) => builder.tile(brick, size, 1.0).expect("a free place"),
                None => {
                    values = vec![1.0; BRICK_VOXELS];
                    let summary = BrickSummary::of(values[..].try_into().expect("a brick"));
                    builder.brick(brick, summary).expect("a free place");
                }
            }
            let tree = builder.finish(Bricks::F32(values)).expect("a small tree");
            let (min, max) = (IVec3::splat(voxel), IVec3::splat(voxel));
            let active_box = Some(IndexBox { min, max });
            let channel = Channel { tree, world_from_index: DAffine3::IDENTITY, active_box };
            let field = Field::new(&channel).expect("a field");
            let mut random = Random(5);
            for _ in 0..200 {
                let (origin, direction) = random_ray(&mut random, IndexBox { min, max });
                let ray = Ray { origin, direction };
                let Some([start, end]) = field.interval(&ray) else { continue };
                let mut reader = field.reader();

                let local = field.local(&ray, start);
                for run in field.runs(&mut reader.walker, local, 0.0, (end - start) as f32).take(MAX_RUNS) {
                    assert!(field.sample(&mut reader.blocks, local.at(run.t0)).is_finite());
                }
            }
        }
    }
}

/// The optical depth of rays of all kinds against exact integration, cell by cell.
#[test]
fn optical_depth_follows_the_voxels() {
    let mut random = Random(77);
    let quality = Quality { step_voxels: 1.0 / 16.0, ..Quality::default() };
    for matrix in [DMat3::IDENTITY, turned()] {
        for _ in 0..6 {
            let world_from_index = DAffine3 { matrix3: matrix, translation: DVec3::new(100.0, 0.0, -2.0) };
            let channel = random_channel(&mut random, IVec3::ZERO, false, world_from_index);
            let scene = absorbing(any_camera(), &channel, 1.0);
            let marcher = Marcher::new(&scene, quality);
            let mut worker = marcher.worker();
            let index = channel.active_box.expect("a box");
            for _ in 0..60 {
                let (origin, direction) = random_ray(&mut random, index);
                let direction = (matrix * direction).normalize();
                let ray = Ray { origin: world_from_index.transform_point3(origin), direction };
                let (o, d) = to_index(&world_from_index.inverse(), &ray);
                let (low, high) = (index.min.as_dvec3() - 1.0, index.max.as_dvec3() + 1.0);
                let voxel = |index| voxel(&channel.tree, index);
                let expected =
                    clip(o, d, low, high).map_or(0.0, |[t0, t1]| line_integral(&voxel, o, d, t0, t1));
                let found = f64::from(marcher.depth_per_scale(&mut worker, &ray));
                // In voxels. Steps of 1/16 that hold the corner of a cell err by less than 1/512.
                let error = (found - expected).abs() * d.length();
                assert!(
                    error < 0.02,
                    "{found} instead of {expected}: {error} voxels, {o} along {d} in {index:?}"
                );
            }
        }
    }
}

/// A brick at either end of index space has the optical depth of its voxels.
#[test]
fn the_ends_of_index_space_are_seen() {
    for brick in [IVec3::splat(-(1 << 28)), IVec3::splat((1 << 28) - 1)] {
        let values = [1.0; 512];
        let mut builder = TreeBuilder::new();
        builder.brick(brick, BrickSummary::of(&values)).expect("a free place");
        let tree = builder.finish(Bricks::F32(values.to_vec())).expect("a small tree");
        let min: IVec3 = brick << 3;
        let active_box = Some(IndexBox { min, max: min + 7 });
        let channel = Channel { tree, world_from_index: DAffine3::IDENTITY, active_box };
        let scene = absorbing(any_camera(), &channel, 1.0);
        let marcher = Marcher::new(&scene, Quality { step_voxels: 0.25, ..Quality::default() });
        let origin = min.as_dvec3() + DVec3::new(3.5, 3.5, -20.0);
        let ray = Ray { origin, direction: DVec3::Z };
        let depth = marcher.depth_per_scale(&mut marcher.worker(), &ray);
        // Eight voxels, of which the high end of index space has no neighbour to blend with.
        assert!(depth > 7.4 && depth < 8.1, "{depth} at {brick}");
    }
}

/// Blocks hold what the accessor reads: bricks, tiles, empty space and all borders between them.
#[test]
fn blocks_return_what_the_accessor_returns() {
    let mut random = Random(4711);
    for half_extent in [40, 9000] {
        let channel = random_channel(&mut random, IVec3::ZERO, false, DAffine3::IDENTITY);
        let store = BlockStore::new(&channel.tree);
        let mut blocks = Blocks::new(&channel.tree, &store);
        let mut accessor = nuage_volume::accessor::Accessor::new(&channel.tree);
        let index = channel.active_box.expect("a box");
        let mut not_zero = 0;
        for i in 0..20_000 {
            // Near the content first, then so far around that slots are used again and again.
            let unit = DVec3::new(random.unit(), random.unit(), random.unit());
            let (low, high) = (index.min.as_dvec3() - 20.0, index.max.as_dvec3() + 20.0);
            let p =
                if i % 2 == 0 { low + (high - low) * unit } else { (unit - 0.5) * f64::from(half_extent) };
            let (cell, fraction) = (p.floor().as_ivec3(), (p - p.floor()).as_vec3());
            let want = accessor.trilinear_in_cell(cell, fraction);
            let got = blocks.trilinear_in_cell(cell, fraction);
            assert!(
                (got - want).abs() <= 1e-6 * want.abs().max(1.0),
                "{got}, not {want}, in {cell} at {fraction}"
            );
            not_zero += usize::from(want != 0.0);
        }
        assert!(not_zero > 100, "{not_zero} points with a value");
    }
}
