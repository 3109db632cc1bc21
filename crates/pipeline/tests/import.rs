//! Imported channels against the trees they come from, by a second statement of what a grid means.

use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::time::Instant;

use glam::{DVec3, IVec3};
use half::f16;
use nuage_pipeline::import::{ImportError, Report, import};
use nuage_testkit as testkit;
use nuage_vdb::{
    AnyTree, File, Grid, LEAF_VOXELS, LEVEL4, LEVEL5, Leaves, Map, Matrix4, RootTile, Shape, Tiles, Tree,
    leaf_offset,
};
use nuage_volume::accessor::Accessor;
use nuage_volume::brick::{Bounds, Bricks};
use nuage_volume::build::BuildError;
use nuage_volume::channel::Channel;
use nuage_volume::tree::Content;
use serde_json::Value;

/// A box of index coordinates, both ends included.
type Box3 = [[i32; 3]; 2];

/// What a grid means as a medium, restated: one voxel at a time, from the rules alone.
struct Rules {
    tree: Tree<f32>,
    /// The depth at which the fog of a level set is full; `None` for densities.
    band: Option<f32>,
    active_box: Option<Box3>,
}

impl Rules {
    fn of(grid: &Grid) -> Self {
        let tree = grid.tree.as_float().unwrap();
        let background = tree.background.abs();
        let band = match background > 0.0 && background < f32::INFINITY {
            true => background,
            false => 3.0 * grid.transform.voxel_size()[0] as f32,
        };
        Rules {
            tree: tree.clone(),
            band: (grid.grid_class() == "level set").then_some(band),
            active_box: tree.active_bbox(),
        }
    }

    fn holds(&self, ijk: [i32; 3]) -> bool {
        self.active_box.is_some_and(|[min, max]| (0..3).all(|i| min[i] <= ijk[i] && ijk[i] <= max[i]))
    }

    fn density(&self, ijk: [i32; 3]) -> f32 {
        let value = self.tree.voxel(ijk).value;
        match self.band {
            _ if !self.holds(ijk) || value.is_nan() => 0.0,
            Some(_) if value >= 0.0 => 0.0,
            Some(band) => f32::min(-value / band, 1.0),
            None => value.clamp(0.0, f32::MAX),
        }
    }

    /// The coordinates inside the active box of all voxels of leaves.
    fn leaf_voxels(&self) -> impl Iterator<Item = [i32; 3]> + '_ {
        let voxels = |o: &[i32; 3]| cells([*o, o.map(|c| c + 7)]).collect::<Vec<_>>();
        self.tree.leaves.origins.iter().flat_map(voxels).filter(|ijk| self.holds(*ijk))
    }

    /// The values of all tiles that reach into the active box, and the background if it does.
    fn constants(&self) -> Vec<f32> {
        let Some([min, max]) = self.active_box else { return Vec::new() };
        let voxels_inside = |origin: [i32; 3], size: i64| -> i128 {
            (0..3)
                .map(|i| {
                    let first = i64::from(origin[i]).max(min[i].into());
                    let end = (i64::from(origin[i]) + size).min(i64::from(max[i]) + 1);
                    i128::from((end - first).max(0))
                })
                .product()
        };
        let mut found = Vec::new();
        for (nodes, level, size) in [(&self.tree.levels[0], LEVEL5, 128), (&self.tree.levels[1], LEVEL4, 8)] {
            for node in nodes {
                let reaches = |slot| voxels_inside(level.child_origin(node.origin, slot), size) > 0;
                found
                    .extend(node.tile_slots().filter(|(slot, ..)| reaches(*slot)).map(|(_, value, _)| value));
            }
        }
        let root_tiles = self.tree.root_tiles.iter().map(|tile| (tile.origin, tile.value));
        found.extend(root_tiles.filter(|(o, _)| voxels_inside(*o, 4096) > 0).map(|(_, value)| value));
        let cells = self.tree.levels[0].iter().map(|node| node.origin);
        let cells = cells.chain(self.tree.root_tiles.iter().map(|tile| tile.origin));
        let stored: i128 = cells.map(|origin| voxels_inside(origin, 4096)).sum();
        let all: i128 = (0..3).map(|i| i128::from(max[i]) - i128::from(min[i]) + 1).product();
        if stored < all {
            found.push(self.tree.background);
        }
        found
    }

    fn half_is_enough(&self) -> bool {
        let exact = |value: f32| f16::from_f32(value).to_f32() == value;
        self.leaf_voxels().all(|ijk| exact(self.density(ijk)))
    }

    fn check(&self, channel: &Channel, coordinates: impl IntoIterator<Item = [i32; 3]>, context: &str) {
        let bounds = channel.tree.bounds();
        let mut accessor = Accessor::new(&channel.tree);
        for ijk in coordinates {
            let (got, want) = (accessor.voxel(IVec3::from_array(ijk)), self.density(ijk));
            assert!(got == want, "{context}: {got} at {ijk:?}, not {want} ({:?})", self.tree.voxel(ijk));
            assert!(bounds.min <= got && got <= bounds.max, "{context}: {got} at {ijk:?} not in {bounds:?}");
        }
    }
}

/// All coordinates of a box.
fn cells([min, max]: Box3) -> impl Iterator<Item = [i32; 3]> {
    (min[0]..=max[0])
        .flat_map(move |x| (min[1]..=max[1]).flat_map(move |y| (min[2]..=max[2]).map(move |z| [x, y, z])))
}

/// SplitMix64.
struct Random(u64);

impl Random {
    fn below(&mut self, end: usize) -> usize {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ self.0 >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ z >> 31) % end as u64) as usize
    }

    fn pick<T: Copy>(&mut self, from: &[T]) -> T {
        from[self.below(from.len())]
    }

    /// A coordinate in `[min, max]`, moved into the range of coordinates.
    fn within(&mut self, min: i64, max: i64) -> i32 {
        let c = min + self.below((max - min + 1) as usize) as i64;
        c.clamp(i64::from(i32::MIN), i64::from(i32::MAX)) as i32
    }

    /// Coordinates in and around the active box, its faces, leaves and tiles, and the ends of index space.
    fn coordinates(&mut self, rules: &Rules, count: usize) -> Vec<[i32; 3]> {
        let tree = &rules.tree;
        let [min, max] = rules.active_box.unwrap_or([[-8; 3], [8; 3]]);
        let nodes = tree.levels.iter().flatten().map(|node| node.origin);
        let origins: Vec<[i32; 3]> = nodes.chain(tree.root_tiles.iter().map(|t| t.origin)).collect();
        let leaves = &tree.leaves.origins;
        let one = |kind: usize| -> [i32; 3] {
            let leaf = if leaves.is_empty() { min } else { self.pick(leaves) };
            let origin = if origins.is_empty() { min } else { self.pick(&origins) };
            let size = self.pick(&[8, 128, 4096]);
            std::array::from_fn(|axis| {
                let (low, high) = (i64::from(min[axis]), i64::from(max[axis]));
                match kind % 5 {
                    0 => self.within(low - 20, high + 20),
                    1 => self.within(i64::from(leaf[axis]) - 9, i64::from(leaf[axis]) + 16),
                    2 => self.pick(&[
                        min[axis].saturating_sub(1),
                        min[axis],
                        max[axis],
                        max[axis].saturating_add(1),
                    ]),
                    // Either side of a border between slots or nodes.
                    3 => (self.within(low, high) & !(size - 1)).saturating_sub(self.below(2) as i32),
                    _ => origin[axis].saturating_add(self.pick(&[-1, 0, size - 1, size, 2 * size])),
                }
            })
        };
        let mut found: Vec<[i32; 3]> = (0..count).map(one).collect();
        found.extend([[i32::MIN; 3], [i32::MAX; 3], [0; 3], [-1; 3]]);
        found
    }
}

fn open(relative: &str) -> Option<File<Vec<u8>>> {
    let path = testkit::find(relative)?;
    Some(File::open(std::fs::read(path).unwrap()).unwrap())
}

fn read(relative: &str, name: &str) -> Option<Grid> {
    let file = open(relative)?;
    Some(file.read_grid(file.find(name).expect(name)).unwrap())
}

/// The same, of a file that stands with the repository.
fn committed(name: &str, grid: &str) -> Grid {
    read(&format!("data/edge/{name}.vdb"), grid).expect("a committed file")
}

#[test]
fn every_float_grid_with_truth_becomes_what_the_rules_say_each_time() {
    let (mut linear, mut frustums, mut random) = (0, 0, Random(1));
    for (path, truth) in testkit::truths() {
        let bytes = std::fs::read(&path).unwrap();
        if bytes.len() > 25 << 20 {
            continue;
        }
        let file = File::open(bytes).unwrap();
        for want in truth["grids"].as_array().unwrap() {
            if want["grid_type"] != "Tree_float_5_4_3" {
                continue;
            }
            let name = want["unique_name"].as_str().unwrap();
            let context = format!("{} {name}", path.display());
            let grid = file.read_grid(file.find(name).unwrap()).unwrap();
            if want["transform"]["linear"] == false {
                let error = import(grid).unwrap_err();
                assert!(matches!(error, ImportError::NonlinearTransform { .. }), "{context}: {error}");
                let text = error.to_string();
                assert!(text.contains(name) && text.contains("NonlinearFrustumMap"), "{text}");
                frustums += 1;
                continue;
            }
            check_against_truth(grid, want, &mut random, &context);
            linear += 1;
        }
    }
    assert!(linear >= 40 && frustums >= 2, "only {linear} float grids and {frustums} frustums were found");
}

fn check_against_truth(grid: Grid, want: &Value, random: &mut Random, context: &str) {
    let rules = Rules { active_box: box_of(&want["active_bbox"]), ..Rules::of(&grid) };
    let half_is_enough = grid.save_float_as_half && rules.band.is_none() && rules.half_is_enough();
    let (channel, report) = import(grid.clone()).unwrap_or_else(|e| panic!("{context}: {e}"));
    let (again, report_again) = import(grid).unwrap();
    assert!(channel.tree == again.tree && report == report_again, "{context}: two imports differ");

    let probes = want["probes"].as_array().unwrap().iter().map(|probe| coordinate(&probe["ijk"]));
    rules.check(&channel, probes, context);
    rules.check(&channel, random.coordinates(&rules, 2000), context);
    let active_box = channel.active_box.map(|b| [b.min.to_array(), b.max.to_array()]);
    assert_eq!(active_box, rules.active_box, "{context}");
    if !channel.tree.bricks.is_empty() {
        assert_eq!(matches!(channel.tree.bricks, Bricks::F16(_)), half_is_enough, "{context}");
    }
    for pair in want["transform"]["index_to_world"].as_array().unwrap() {
        let [index, world] =
            [0, 1].map(|i| DVec3::from_array(serde_json::from_value(pair[i].clone()).unwrap()));
        let got = channel.world_from_index.transform_point3(index);
        assert!((got - world).length() <= 1e-9 * world.length().max(1.0), "{context}: {index} at {got}");
    }
}

fn coordinate(value: &Value) -> [i32; 3] {
    serde_json::from_value(value.clone()).unwrap()
}

fn box_of(value: &Value) -> Option<Box3> {
    serde_json::from_value(value.clone()).unwrap()
}

/// Real topologies with random values, states and backgrounds: tiles of every size, cut by the box of what
/// is active at random places.
#[test]
fn random_values_on_real_topologies_become_what_the_rules_say() {
    let bases = [
        ("cross_zero", "cross_zero"),
        ("tiles_levels", "tiles"),
        ("leaf_masks", "leaf_masks"),
        ("lower_tiles_only", "lower_tiles_only"),
        ("half_blosc", "ls_sphere_half"),
        ("half_blosc", "seven_half"),
    ];
    let mut refused = 0;
    for (file, name) in bases {
        let base = committed(file, name);
        for seed in 0..12 {
            let mut random = Random(seed);
            let grid = random_values(base.clone(), &mut random);
            let rules = Rules::of(&grid);
            let context = format!("{name}, seed {seed}");
            let (channel, report) = match import(grid) {
                Ok(imported) => imported,
                // The box cuts several tiles of the root.
                Err(error) if cut_limit(&error).is_some() => {
                    refused += 1;
                    continue;
                }
                Err(error) => panic!("{context}: {error}"),
            };
            rules.check(&channel, random.coordinates(&rules, 1500), &context);
            check_report(&rules, report, &context);
        }
    }
    assert!(refused <= 4, "{refused} of {} were refused", 12 * bases.len());
}

/// How many regions may be cut, if that is what is wrong.
fn cut_limit(error: &ImportError) -> Option<u64> {
    match error {
        ImportError::Build { source: BuildError::Limit { limit, .. }, .. } => Some(*limit),
        _ => None,
    }
}

/// The tree of a float grid, to be changed for this grid alone.
fn float_tree(grid: &mut Grid) -> &mut Tree<f32> {
    match Arc::make_mut(&mut grid.tree) {
        AnyTree::Float(tree) => tree,
        _ => panic!("'{}' is no float grid", grid.name),
    }
}

fn random_values(mut grid: Grid, random: &mut Random) -> Grid {
    // Few values, so that whole leaves may be constant; 0.1 is not exact in half floats, and 1e-9 and 7e4
    // lie outside of their range.
    let all =
        [0.0, -0.0, 1.0, 0.5, 0.1, -1.0, 7e4, 1e-9, f32::MAX, f32::NAN, f32::INFINITY, f32::NEG_INFINITY];
    let palette: [f32; 4] = std::array::from_fn(|_| random.pick(&all));
    let tree = float_tree(&mut grid);
    tree.background = random.pick(&palette);
    for tile in &mut tree.root_tiles {
        tile.value = random.pick(&palette);
        tile.active = random.below(4) == 0;
    }
    // A cell beside the origin that may be cut by the box.
    let beside = RootTile { origin: [0, 0, -4096], value: random.pick(&palette), active: false };
    let stored =
        |o| tree.levels[0].iter().any(|n| n.origin == o) || tree.root_tiles.iter().any(|t| t.origin == o);
    if !stored(beside.origin) {
        tree.root_tiles.push(beside);
        tree.root_tiles.sort_by_key(|tile| tile.origin);
    }
    for (nodes, level) in tree.levels.iter_mut().zip([LEVEL5, LEVEL4]) {
        for node in nodes {
            node.tiles = match random.below(3) {
                0 => Tiles::PerSlot((0..level.slots()).map(|_| random.pick(&palette)).collect()),
                _ => Tiles::Uniform(random.pick(&palette)),
            };
        }
    }
    for (leaf, values) in tree.leaves.values.chunks_exact_mut(LEAF_VOXELS).enumerate() {
        let constant = (random.below(3) == 0).then(|| random.pick(&palette));
        values.iter_mut().for_each(|value| *value = constant.unwrap_or_else(|| random.pick(&palette)));
        let active = random.below(LEAF_VOXELS);
        let mask = &mut tree.leaves.masks[leaf * 8..(leaf + 1) * 8];
        mask.fill(0);
        mask[active / 64] |= 1 << (active % 64);
    }
    grid
}

/// What is reported is what leaves, tiles and background hold inside the box.
fn check_report(rules: &Rules, report: Report, context: &str) {
    let mut values: Vec<f32> = rules.leaf_voxels().map(|ijk| rules.tree.voxel(ijk).value).collect();
    values.extend(rules.constants());
    let count = |test: fn(&f32) -> bool| values.iter().filter(|value| test(value)).count() as u64;
    let densities = u64::from(rules.band.is_none());
    let want = Report {
        nan_values: count(|v| v.is_nan()),
        negative_values: densities * count(|v| *v < 0.0),
        infinite_values: densities * count(|v| *v == f32::INFINITY),
        level_set_band: rules.active_box.and(rules.band),
    };
    assert_eq!(report, want, "{context}");
}

#[test]
fn values_that_are_no_densities_are_counted() {
    for name in ["background_inf", "background_nan", "special", "special_half"] {
        let grid = committed("special_values", name);
        let rules = Rules::of(&grid);
        let (channel, report) = import(grid).unwrap();
        check_report(&rules, report, name);
        rules.check(&channel, rules.leaf_voxels(), name);
        if name.starts_with("special") {
            assert!(
                report.nan_values > 0 && report.negative_values > 0 && report.infinite_values > 0,
                "{report:?}"
            );
            assert_eq!(channel.tree.bounds(), Bounds { min: 0.0, max: f32::MAX }, "{name}");
            assert!(matches!(channel.tree.bricks, Bricks::F32(_)), "f16 cannot hold the largest f32");
        }
    }
}

#[test]
fn grids_saved_as_half_stay_half_where_that_is_exact() {
    let f16 = |channel: &Channel| matches!(channel.tree.bricks, Bricks::F16(_));
    for name in ["half_blosc", "half_bloscmask", "half_mask"] {
        let grid = committed(name, "seven_half");
        let rules = Rules::of(&grid);
        let [min, max] = rules.active_box.unwrap();
        let around = [min.map(|c| c - 2), max.map(|c| c + 2)];
        let (channel, _) = import(grid.clone()).unwrap();
        assert!(f16(&channel), "{name}");
        rules.check(&channel, cells(around), name);

        // One value that a half float cannot hold makes all of them full floats.
        for value in [0.1, 65520.0, 1e-9, f32::INFINITY] {
            let mut grid = grid.clone();
            let leaves = &mut float_tree(&mut grid).leaves;
            let (leaf, mask) = leaves.masks.chunks(8).enumerate().find(|(_, m)| m[0] != 0).unwrap();
            leaves.values[leaf * LEAF_VOXELS + mask[0].trailing_zeros() as usize] = value;
            let rules = Rules::of(&grid);
            let (channel, _) = import(grid).unwrap();
            assert!(!f16(&channel), "{value} in {name}");
            rules.check(&channel, cells(around), name);
        }
    }
    let (full, _) = import(committed("comp_seven_mask", "seven_float")).unwrap();
    assert!(!f16(&full));
    // A level set saved as half becomes a fog of other values.
    let (fog, report) = import(committed("half_blosc", "ls_sphere_half")).unwrap();
    assert!(!f16(&fog) && report.level_set_band == Some(3.0), "{report:?}");
}

#[test]
fn a_constant_below_zero_over_the_whole_domain_is_an_empty_medium() {
    for (path, has_box) in [
        ("data/public/openusd_smoke_000001.vdb", false),
        ("data/sequences/chimney_full/fluid_data_0001.vdb", true),
        ("data/sequences/chimney_full/fluid_data_0051.vdb", true),
        ("data/sequences/chimney_full/fluid_data_0100.vdb", true),
    ] {
        let Some(grid) = read(path, "shadow") else { continue };
        let rules = Rules::of(&grid);
        let (channel, report) = import(grid).unwrap();
        assert!(channel.tree.root.is_empty() && channel.tree.bricks.is_empty(), "{path}");
        assert_eq!(channel.active_box.is_some(), has_box, "{path}");
        assert_eq!(report.negative_values > 0, has_box, "{path}: {report:?}");
        check_report(&rules, report, path);
        rules.check(&channel, Random(0).coordinates(&rules, 500), path);
    }
}

#[test]
fn a_grid_without_active_voxels_is_an_empty_channel_whatever_its_background() {
    for (file, name) in [("empty_grid", "empty"), ("empty_grid_background", "empty_bg")] {
        let (channel, report) = import(committed(file, name)).unwrap();
        assert!(channel.tree.root.is_empty() && channel.tree.bricks.is_empty(), "{name}");
        assert_eq!((channel.active_box, report), (None, Report::default()), "{name}");
    }
}

#[test]
fn a_background_counts_inside_the_box_and_ends_with_it() {
    for name in ["background_5", "background_minus"] {
        let mut grid = committed("background_nonzero", name);
        for background in [5.0, 0.1, -5.0, f32::INFINITY, f32::NAN] {
            let tree = float_tree(&mut grid);
            tree.background = background;
            for node in tree.levels.iter_mut().flatten() {
                node.tiles = Tiles::Uniform(background);
            }
            let rules = Rules::of(&grid);
            let [min, max] = rules.active_box.unwrap();
            let (channel, _) = import(grid.clone()).unwrap();
            rules.check(&channel, cells([min.map(|c| c - 9), max.map(|c| c + 9)]), name);
        }
    }
}

#[test]
fn a_background_over_a_huge_box_is_refused_at_once() {
    let mut grid = committed("far_coords", "far");
    import(grid.clone()).unwrap();
    float_tree(&mut grid).background = 1e-3;
    let started = Instant::now();
    let error = import(grid).unwrap_err();
    assert!(started.elapsed().as_secs_f32() < 20.0);
    assert!(matches!(error, ImportError::Background { .. }), "{error}");
    assert!(error.to_string().contains("over the limit of"), "{error}");
}

/// A box of voxels full of background, between two leaves of zeros at its ends. The leaves hang in no node, so
/// that background is all there is around them.
fn background_box(min: i32, size: i32) -> Grid {
    let mut grid = committed("background_nonzero", "background_5");
    let mut tree = Tree::empty(5.0_f32, Shape::STANDARD);
    for corner in [min, min + size - 1] {
        let mut mask = [0; 8];
        let offset = leaf_offset([corner; 3]);
        mask[offset / 64] |= 1 << (offset % 64);
        let Leaves { origins, masks, values, .. } = &mut tree.leaves;
        origins.push([corner & !7; 3]);
        masks.extend(mask);
        values.extend([0.0; LEAF_VOXELS]);
    }
    grid.tree = Arc::new(tree.into());
    grid
}

#[test]
fn a_background_cut_along_the_faces_of_its_box_is_quick() {
    let grid = background_box(-333, 1000);
    let rules = Rules::of(&grid);
    let started = Instant::now();
    let (channel, report) = import(grid).unwrap();
    let secs = started.elapsed().as_secs_f32();
    assert!(secs < 4.0, "{secs} s");
    assert_eq!(report, Report::default());
    rules.check(&channel, Random(3).coordinates(&rules, 20_000), "a box of background");
}

#[test]
fn a_box_that_cuts_too_many_regions_is_refused_at_once() {
    // Faces across regions of 128³ voxels, and faces between them that cross those of 4096³.
    for (min, size) in [(3, 3600), (-128, 20_096)] {
        let started = Instant::now();
        let error = import(background_box(min, size)).unwrap_err();
        assert!(started.elapsed().as_secs_f32() < 30.0);
        assert_eq!(cut_limit(&error), Some(4096), "{error}");
        assert!(error.to_string().contains("'background_5': the volume needs more than 4096"), "{error}");
    }
}

#[test]
fn tiles_stay_tiles_and_constant_leaves_become_some() {
    let files = [
        "tiles_levels",
        "tiles_levels_none",
        "tiles_levels_bg_m1_none",
        "root_tiles_only",
        "lower_tiles_only",
    ];
    for (name, path) in files.map(|name| (name, format!("data/edge/{name}.vdb"))) {
        let Some(file) = open(&path) else { continue };
        let text =
            std::fs::read_to_string(testkit::find(&path.replace(".vdb", ".truth.json")).unwrap()).unwrap();
        let truth: Value = serde_json::from_str(&text).unwrap();
        let grid = file.read_grid(0).unwrap();
        let rules = Rules::of(&grid);
        let (channel, _) = import(grid).unwrap();
        let leaves = rules.tree.leaves.len();
        assert!(channel.tree.bricks.len() <= leaves, "{name}: {} bricks", channel.tree.bricks.len());
        let mut tiles = 0;
        for tile in truth["grids"][0]["first_tiles"].as_array().unwrap() {
            let [min, max] = box_of(&tile["bbox"]).unwrap();
            if rules.holds(min) && rules.holds(max) {
                let region = channel.tree.region(IVec3::from_array(min) >> 3);
                let log2_bricks = [9, 4, 0][tile["depth"].as_u64().unwrap() as usize];
                assert_eq!(region.log2_bricks, log2_bricks, "{name}: {tile}");
                assert_eq!(
                    region.content,
                    Content::Constant(testkit::number(&tile["value"]) as f32),
                    "{name}"
                );
                tiles += 1;
            }
        }
        assert!(tiles >= 2, "{name}: {tiles} tiles");
    }

    let dense = committed("dense_constant_unpruned", "dense_constant");
    let rules = Rules::of(&dense);
    let (channel, _) = import(dense).unwrap();
    assert!(channel.tree.bricks.is_empty(), "constant leaves take no bricks");
    rules.check(&channel, rules.leaf_voxels(), "dense_constant");
}

#[test]
fn a_voxel_far_away_is_one_brick() {
    for name in ["single_voxel_far", "single_voxel_corner", "single_voxel_m1", "single_voxel_0"] {
        let grid = committed(name, "density");
        let rules = Rules::of(&grid);
        let [at, end] = rules.active_box.unwrap();
        assert_eq!(at, end);
        let (channel, _) = import(grid).unwrap();
        assert_eq!(channel.tree.bricks.len(), 1, "{name}");
        rules.check(&channel, cells([at.map(|c| c - 20), at.map(|c| c + 20)]), name);
        let Bricks::F32(values) = &channel.tree.bricks else { panic!("{name} was saved in full") };
        let want = rules.tree.voxel(at).value;
        assert!(values.iter().enumerate().all(|(o, v)| *v == if o == leaf_offset(at) { want } else { 0.0 }));
    }
}

#[test]
fn transforms_that_cannot_be_inverted_are_refused() {
    let base = committed("transforms", "affine");
    let with = |change: fn(&mut Matrix4)| {
        let mut grid = base.clone();
        let mut matrix = *grid.transform.matrix().unwrap();
        change(&mut matrix);
        grid.transform.map = Map::Linear(matrix);
        import(grid).map(|_| ())
    };
    assert_eq!(with(|_| ()), Ok(()));
    assert_eq!(with(|m| m[1] = m[1].map(|x| -x)), Ok(()), "mirrors are invertible");
    let flat =
        |m: &mut Matrix4| *m = [[1e-9, 0.0, 0.0, 0.0], [0.0, 1e3, 0.0, 0.0], [0.0, 0.0, 1e9, 0.0], m[3]];
    assert_eq!(with(flat), Ok(()), "voxels may be flat");
    let refused = Err(ImportError::SingularTransform { grid: "affine".to_owned() });
    let changes: [fn(&mut Matrix4); 11] = [
        |m| m[2] = [m[1][0] * (1.0 + 1e-14), m[1][1], m[1][2] * (1.0 - 1e-14), 0.0],
        |m| *m = [[0.1, 0.2, 0.3, 0.0], [0.4, 0.5, 0.6, 0.0], [0.7, 0.8, 0.9, 0.0], m[3]],
        |m| m[0] = [0.0; 4],
        |m| m[2] = m[1],
        |m| *m = [[0.0; 4]; 4],
        |m| m[1][1] = f64::NAN,
        |m| m[3][0] = f64::NAN,
        |m| m[3][2] = f64::INFINITY,
        |m| m[0][0] = f64::NEG_INFINITY,
        |m| m.iter_mut().take(3).flatten().for_each(|x| *x *= 1e-200),
        |m| m.iter_mut().take(3).flatten().for_each(|x| *x *= 1e200),
    ];
    for change in changes {
        assert_eq!(with(change), refused);
    }
}

/// All voxels of level sets against the fog that OpenVDB's `sdfToFogVolume` makes of them.
#[test]
fn a_level_set_becomes_the_fog_that_openvdb_makes_of_it() {
    if Command::new("vdb_tool").arg("-version").output().is_err() {
        return testkit::left_out("openvdb", "vdb_tool");
    }
    let folder = tempfile::tempdir().unwrap();
    for (path, name) in [
        ("data/edge/comp_sphere_mask.vdb", "ls_sphere"),
        ("data/edge/half_blosc.vdb", "ls_sphere_half"),
        ("data/edge/v12_sphere_half.vdb", "sphere"),
        ("data/static/bunny_ls200_f16_zip.vdb", "ls_bunny"),
        ("data/static/teapot_ls256_f16_none.vdb", "ls_teapot"),
    ] {
        let Some(path) = testkit::find(path) else { continue };
        let (fog, saved_as_half) = fog_by_openvdb(&path, name, &folder.path().join("fog.vdb"));
        let file = File::open(std::fs::read(&path).unwrap()).unwrap();
        let grid = file.read_grid(file.find(name).unwrap()).unwrap();
        let [min, max] = grid.tree.statistics().active_bbox.unwrap();
        let (channel, report) = import(grid).unwrap();
        assert!(report.level_set_band.is_some());
        // It multiplies by the inverse of the band, here values are divided; a half float has eleven bits.
        let relative = if saved_as_half { 1.0 / 2048.0 } else { 2.0 * f32::EPSILON };
        let mut accessor = Accessor::new(&channel.tree);
        let mut filled = 0;
        for ijk in cells([min.map(|c| c - 2), max.map(|c| c + 2)]) {
            let (got, want) = (accessor.voxel(IVec3::from_array(ijk)), fog.voxel(ijk).value);
            assert!((got - want).abs() <= relative * want + 1e-7, "{name}: {got} at {ijk:?}, not {want}");
            filled += usize::from(got > 0.0);
        }
        assert!(filled > 100, "{name}: {filled}");
        // Nothing lies outside of what was compared.
        let [fog_min, fog_max] = fog.statistics().active_bbox.unwrap();
        assert!((0..3).all(|i| fog_min[i] >= min[i] && fog_max[i] <= max[i]), "{name}");
    }
}

fn fog_by_openvdb(path: &Path, name: &str, output: &Path) -> (Tree<f32>, bool) {
    let grids = format!("grids={name}");
    let run = Command::new("vdb_tool")
        .args(["-quiet", "-read"])
        .arg(path)
        .args([&grids, "-ls2fog", "-write"])
        .arg(output)
        .arg("bits=32")
        .output()
        .unwrap();
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let file = File::open(std::fs::read(output).unwrap()).unwrap();
    let grid = file.read_grid(0).unwrap();
    assert_eq!(grid.grid_class(), "fog volume");
    (grid.tree.as_float().unwrap().clone(), grid.save_float_as_half)
}
