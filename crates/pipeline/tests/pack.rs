//! Packed volumes as a sceptic takes them: what was asked for is what is measured, on trees of every kind.
//!
//! Everything is in memory; each source grid is compared with what comes back by code that knows not how it was encoded.

mod recipe;

use std::collections::BTreeSet;
use std::convert::Infallible;
use std::io::Cursor;

use glam::IVec3;
use half::f16;
use nuage_pipeline::pack::assemble::Report;
use nuage_pipeline::pack::options::{Asked, Bound, ChannelOptions, Options, unmet};
use nuage_pipeline::pack::plan::Plan;
use nuage_pipeline::pack::sequence::{FrameName, PackError, pack};
use nuage_pipeline::pack::unpack::unpack_frame;
use nuage_testkit as testkit;
use nuage_vdb::{
    AnyTree, Branching, Grid, LEVEL5, Map, MetaValue, Metadata, Shape, Transform, Tree, TreeBuilder,
};
use nuage_volume::codec::Codec;
use nuage_volume::codec::block::{BlockFormat, PackingAxis};
use nuage_volume::format::{Asset, FrameGrid, Role};
use nuage_volume::packed::{Content, Entry, Node, TreeRef, mask};
use nuage_volume::space::{NODE4_SLOTS, NODE5_SLOTS, node4_slot, node5_slot, root_cell};
use proptest::prelude::*;
use recipe::{Random, Recipe, recipes, tree_of};

type Frame = (Vec<Grid>, Metadata);

struct Packed {
    asset: Asset,
    report: Report,
    plan: Plan,
    bytes: Vec<u8>,
}

impl Packed {
    fn frame(&self, frame: usize) -> Frame {
        unpack_frame(&self.asset, frame).unwrap()
    }
}

/// Options that ask for nothing.
const NOTHING: Options = Options {
    max_error: None,
    psnr: None,
    bits_per_voxel: None,
    codec: None,
    coarser_levels: 0,
    shapes: 0,
    channels: Vec::new(),
};

fn packed(frames: &[Frame], options: &Options) -> Packed {
    let names: Vec<FrameName> = (0..frames.len())
        .map(|i| FrameName { number: Some(7 + 3 * i as i64), name: format!("frame {i}") })
        .collect();
    let load = |i: usize| Ok::<_, Infallible>(frames[i].clone());
    let mut out = Cursor::new(Vec::new());
    let (report, plan) = pack(&names, load, &mut out, options, Some(24.0), &mut |_| {}).unwrap();
    let bytes = out.into_inner();
    assert_eq!(report.summary.file_bytes, bytes.len() as u64);
    let mut asset = Asset::open(bytes.clone()).unwrap();
    asset.load_all().unwrap();
    assert_eq!(asset.contents().frames.len(), frames.len());
    for (frame, name) in asset.contents().frames.iter().zip(&names) {
        assert_eq!((frame.number, &frame.name), (name.number, &name.name));
    }
    assert_eq!(asset.contents().frame_rate, Some(24.0));
    Packed { asset, report, plan, bytes }
}

fn still(grids: Vec<Grid>) -> Vec<Frame> {
    vec![(grids, Metadata::default())]
}

fn grid(name: &str, tree: impl Into<AnyTree>) -> Grid {
    Grid::new(name, Transform::uniform_scale(0.1), tree)
}

/// The numbers of a grid, one tree for each component, as they can be packed, and how exact its type is.
fn numbers(grid: &Grid) -> (Vec<Tree<f32>>, f32) {
    fn finite(value: f32) -> f32 {
        const LARGEST: f32 = 8.507_059e37;
        if value.is_nan() { 0.0 } else { value.clamp(-LARGEST, LARGEST) }
    }
    let component = |tree: &Tree<[f32; 3]>| (0..3).map(|c| tree.map(|value| finite(value[c]))).collect();
    match &*grid.tree {
        AnyTree::Float(tree) => (vec![tree.map(finite)], 0.0),
        AnyTree::Double(tree) => (vec![tree.map(|value| finite(value as f32))], 0.0),
        AnyTree::Half(tree) => (vec![tree.map(|value| finite(value.to_f32()))], 1.0 / 2048.0),
        AnyTree::Vec3s(tree) => (component(tree), 0.0),
        AnyTree::Vec3d(tree) => (component(&tree.map(|value| value.map(|x| x as f32))), 0.0),
        other => panic!("{}", other.value_type()),
    }
}

fn is_packable(grid: &Grid) -> bool {
    let is_real = matches!(
        &*grid.tree,
        AnyTree::Float(_) | AnyTree::Double(_) | AnyTree::Half(_) | AnyTree::Vec3s(_) | AnyTree::Vec3d(_)
    );
    is_real && grid.tree.shape() == Shape::STANDARD
}

fn peak_of(trees: &[&Tree<f32>]) -> f32 {
    let mut peak = 0.0_f32;
    for tree in trees {
        regions(tree, |_, _, value| peak = peak.max(value.abs()));
        peak = tree.leaves.values.iter().fold(peak.max(tree.background.abs()), |peak, v| peak.max(v.abs()));
    }
    peak
}

/// Calls on each tile: its first voxel, log2 of its extent, its value.
fn regions(tree: &Tree<f32>, mut found: impl FnMut([i32; 3], u32, f32)) {
    tree.root_tiles.iter().for_each(|tile| found(tile.origin, 12, tile.value));
    for (branching, node) in tree.inner_nodes() {
        let branching: Branching = branching;
        for (slot, value, _) in node.tile_slots() {
            if value != tree.background {
                found(branching.child_origin(node.origin, slot), branching.log2_child_voxels, value);
            }
        }
    }
}

/// How far two trees are apart.
#[derive(Debug, Default, Clone, Copy)]
struct Distance {
    /// Over all voxels.
    max: f32,
    /// Over the voxels that are background in the source.
    in_background: f32,
    /// Over leaves of the source that are not constant.
    squared: f64,
    /// Their voxels that are not background.
    voxels: u64,
    flipped: u64,
}

fn voxels_of(origin: [i32; 3]) -> impl Iterator<Item = (usize, [i32; 3])> {
    (0..512_i32).map(move |i| {
        (
            i as usize,
            [
                origin[0].wrapping_add(i >> 6),
                origin[1].wrapping_add(i >> 3 & 7),
                origin[2].wrapping_add(i & 7),
            ],
        )
    })
}

fn distance(source: &Tree<f32>, decoded: &Tree<f32>) -> Distance {
    let mut found = Distance::default();
    let mut note = |value: f32, decoded: f32| {
        let error = (value - decoded).abs();
        found.max = found.max.max(error);
        if value == source.background {
            found.in_background = found.in_background.max(error);
        }
        found.flipped += u64::from((value < 0.0) != (decoded < 0.0));
        error
    };
    let (mut squared, mut voxels) = (0.0, 0);
    for (i, origin) in source.leaves.origins.iter().enumerate() {
        let values = source.leaves.stored(i);
        let is_constant = values.iter().all(|value| *value == values[0]);
        for (offset, ijk) in voxels_of(*origin) {
            let error = note(values[offset], decoded.voxel(ijk).value);
            if !is_constant {
                squared += f64::from(error).powi(2);
                voxels += u64::from(values[offset] != source.background);
            }
        }
    }
    let sample = |origin: [i32; 3], log2: u32, see: &mut dyn FnMut([i32; 3])| {
        for step in 0..27 {
            let inside = [step / 9, step / 3 % 3, step % 3].map(|part| part * ((1 << log2) - 1) / 2);
            see(std::array::from_fn(|axis| origin[axis].wrapping_add(inside[axis])));
        }
    };
    regions(source, |origin, log2, value| {
        sample(origin, log2, &mut |ijk| {
            note(value, decoded.voxel(ijk).value);
        });
    });
    // Nothing is there that was not.
    for origin in &decoded.leaves.origins {
        voxels_of(*origin).for_each(|(_, ijk)| {
            note(source.voxel(ijk).value, decoded.voxel(ijk).value);
        });
    }
    regions(decoded, |origin, log2, value| {
        sample(origin, log2, &mut |ijk| {
            note(source.voxel(ijk).value, value);
        });
    });
    Distance { squared, voxels, ..found }
}

/// The metadata of a grid without what a writer of .vdb files adds.
fn own_metadata(grid: &Grid) -> Vec<(&str, &MetaValue)> {
    let is_added =
        |name: &str| name.starts_with("file_") || ["name", "is_saved_as_half_float"].contains(&name);
    grid.metadata.iter().filter(|(name, _)| !is_added(name)).collect()
}

/// That a grid came back but for its values. Gives how far these are off, per component.
fn came_back(source: &Grid, decoded: &Grid) -> Vec<Distance> {
    assert_eq!(decoded.name, source.name);
    assert_eq!(own_metadata(decoded), own_metadata(source));
    assert_eq!(decoded.transform, source.transform);
    assert_eq!(decoded.save_float_as_half, source.save_float_as_half);
    assert_eq!(decoded.grid_type(), source.grid_type());
    if source.tree.background().iter().all(|value| value.is_finite() && value.abs() < 8e37) {
        assert_eq!(decoded.tree.background(), source.tree.background());
    }
    let ((source, _), (decoded, _)) = (numbers(source), numbers(decoded));
    source.iter().zip(&decoded).map(|(source, decoded)| distance(source, decoded)).collect()
}

/// The entries that hold a brick, from the root down; fewer than three where a larger region has one value.
fn entries_at(asset: &Asset, tree: TreeRef, brick: IVec3) -> Vec<Entry> {
    let trees = asset.trees();
    let cells = trees.cells_of(tree);
    let Some(cell) = cells.iter().find(|cell| cell.cell == root_cell(brick).to_array()) else {
        return vec![];
    };
    let mut found = vec![cell.entry];
    let below = |entry: Entry, nodes: &[Node], slots, slot| {
        let Some(Content::Node(node)) = entry.content() else { return None };
        let node = nodes[node as usize];
        let rank = mask::rank(&trees.masks, node.mask, slots, slot)?;
        Some(trees.entries[node.first_entry as usize + rank])
    };
    if let Some(entry) = below(cell.entry, &trees.node5s, NODE5_SLOTS, node5_slot(brick)) {
        found.push(entry);
        found.extend(below(entry, &trees.node4s, NODE4_SLOTS, node4_slot(brick)));
    }
    found
}

fn brick_of(grid: &FrameGrid, origin: [i32; 3]) -> IVec3 {
    (IVec3::from_array(origin).wrapping_sub(IVec3::from_array(grid.index_offset))) >> 3
}

/// That what is stored as the bounds of all entries at and beside the leaves holds what interpolation gives there.
fn footprints_hold(asset: &Asset, grid: &FrameGrid, decoded: &Tree<f32>) {
    let unit = asset.contents().channels[grid.channel as usize].unit;
    let mut places = BTreeSet::new();
    for origin in &decoded.leaves.origins {
        for step in 0..27 {
            let step = [step / 9 - 1, step / 3 % 3 - 1, step % 3 - 1];
            let place: [Option<i32>; 3] =
                std::array::from_fn(|axis| origin[axis].checked_add(8 * step[axis]));
            places.extend(place[0].zip(place[1]).zip(place[2]).map(|((x, y), z)| [x, y, z]));
        }
    }
    for place in places {
        let entries = entries_at(asset, grid.levels[0], brick_of(grid, place));
        let is_stored = match entries.last().and_then(|entry| entry.content()) {
            None | Some(Content::Node(_)) => false,
            Some(_) => true,
        };
        // Trilinear interpolation is within the corners of its cell.
        for i in 0..729 {
            let step = [i / 81, i / 9 % 9, i % 9];
            let ijk: [Option<i32>; 3] = std::array::from_fn(|axis| place[axis].checked_add(step[axis]));
            let [Some(x), Some(y), Some(z)] = ijk else { continue };
            let value = decoded.voxel([x, y, z]).value;
            assert!(is_stored || value == decoded.background, "{value} at {ijk:?} has no entry");
            for entry in &entries {
                let bounds = entry.footprint(unit);
                let is_within = bounds.min <= value && value <= bounds.max;
                assert!(
                    is_within,
                    "{value:e} at {ijk:?} is not in {bounds:?}, background {}",
                    decoded.background
                );
            }
        }
    }
}

/// That reported errors are those found, over all frames; that what was asked for holds.
fn check(frames: &[Frame], options: &Options) -> Packed {
    let packed = packed(frames, options);
    let contents = packed.asset.contents();
    let mut totals = vec![Distance::default(); contents.channels.len()];
    let mut roundings = vec![0.0_f32; contents.channels.len()];
    for (i, (grids, metadata)) in frames.iter().enumerate() {
        let (back, back_metadata) = packed.frame(i);
        let grids: Vec<&Grid> = grids.iter().filter(|grid| is_packable(grid)).collect();
        assert_eq!(back.len(), grids.len());
        if !grids.is_empty() {
            assert_eq!(back_metadata, *metadata);
        }
        let mut stored = contents.frames[i].grids.iter();
        for (source, decoded) in grids.into_iter().zip(&back) {
            let rounding = numbers(source).1;
            for (n, found) in came_back(source, decoded).into_iter().enumerate() {
                let stored = stored.next().unwrap();
                let channel = &contents.channels[stored.channel as usize];
                let tree = &numbers(decoded).0[n];
                let (peak, slack) = (channel.peak, rounding * channel.peak);
                if let Some(bound) = options.max_error {
                    let bound = match bound {
                        Bound::Absolute(error) => error,
                        Bound::OfPeak(part) => part * peak,
                    };
                    assert!(found.max <= bound + slack, "{} of {bound}", found.max);
                }
                assert!(found.in_background <= 1.001e-3 * peak + slack, "{} {peak}", found.in_background);
                if source.grid_class() == "level set" {
                    assert_eq!(found.flipped, 0);
                }
                if rounding == 0.0 {
                    footprints_hold(&packed.asset, stored, tree);
                }
                let total = &mut totals[stored.channel as usize];
                total.max = total.max.max(found.max);
                total.squared += found.squared;
                total.voxels += found.voxels;
                roundings[stored.channel as usize] = roundings[stored.channel as usize].max(rounding);
            }
        }
        assert!(stored.next().is_none());
    }
    let is_half = frames.iter().flat_map(|(grids, _)| grids).any(|grid| grid.tree.value_type() == "half");
    for (channel, total) in contents.channels.iter().zip(&totals).filter(|_| !is_half) {
        let quality = channel.quality;
        assert_eq!(quality.voxels, total.voxels);
        assert!((quality.max_error - total.max).abs() <= 1e-6 * channel.peak, "{quality:?} {total:?}");
        let difference = (quality.squared_error - total.squared).abs();
        // Squares are summed in units of the channel, where those of errors below 1e-19 vanish.
        let vanishing = 1e-36 * f64::from(channel.peak).powi(2) * total.voxels as f64;
        assert!(difference <= 1e-4 * total.squared + vanishing, "{quality:?} {total:?}");
    }
    for ((channel, total), rounding) in contents.channels.iter().zip(&totals).zip(roundings) {
        let is_asked = options.codec.is_none() && total.squared > 0.0 && rounding == 0.0;
        if let Some(psnr) = options.psnr.filter(|_| is_asked) {
            let mean = total.squared / total.voxels as f64;
            let reached = 10.0 * (f64::from(channel.peak).powi(2) / mean).log10();
            assert!(reached >= psnr - 1e-3, "{reached} dB of {psnr}");
        }
    }
    packed
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(10))]

    #[test]
    fn errors_keep_to_the_bound(recipe in recipes(), log10 in -6_f32..-0.7) {
        let tree = tree_of(&recipe);
        let bound = 10.0_f32.powf(log10) * peak_of(&[&tree]);
        check(&still(vec![grid("density", tree)]), &Options { max_error: Some(Bound::Absolute(bound)), ..NOTHING });
    }

    #[test]
    fn noise_keeps_to_what_was_asked_over_all_frames(
        recipes in prop::collection::vec(recipes(), 1..4), psnr in 15.0_f64..80.0
    ) {
        // Frames of one scale, so that a channel has one peak.
        let high = recipes[0].high;
        let frame = |recipe: &Recipe| {
            let scale = high / recipe.high;
            let recipe = Recipe { high, low: recipe.low * scale, background: recipe.background * scale, ..*recipe };
            (vec![grid("density", tree_of(&recipe))], Metadata::default())
        };
        let frames: Vec<Frame> = recipes.iter().map(frame).collect();
        check(&frames, &Options { psnr: Some(psnr), ..NOTHING });
        check(&frames, &Options { psnr: Some(psnr), max_error: Some(Bound::OfPeak(0.02)), ..NOTHING });
    }

    #[test]
    fn no_sign_of_a_level_set_changes(recipe in recipes(), psnr in 10.0_f64..50.0) {
        let recipe = Recipe { low: -recipe.high, background: recipe.high * 0.3, ..recipe };
        let mut grid = grid("surface", tree_of(&recipe));
        grid.metadata.insert("class", MetaValue::from_text("level set"));
        check(&still(vec![grid]), &Options { psnr: Some(psnr), ..NOTHING });
    }

    #[test]
    fn grids_of_every_type_come_back(recipe in recipes(), psnr in 20.0_f64..60.0) {
        let recipe = Recipe { high: 1.0, low: -1.0, background: recipe.background / recipe.high, ..recipe };
        let tree = tree_of(&recipe);
        let other = tree_of(&Recipe { seed: !recipe.seed, ..recipe });
        let grids = vec![
            grid("vel", tree.map(|value| [value, 0.25, -value * value])),
            grid("same", tree.clone()),
            grid("wide", tree.map(|value| [f64::from(value), 0.1, 1.0])),
            grid("same", other),
            grid("double", tree.map(|value| f64::from(value) + 0.1)),
            grid("half", tree.map(f16::from_f32)),
            grid("none", Tree::empty(0.7_f32, Shape::STANDARD)),
        ];
        check(&still(grids), &Options { psnr: Some(psnr), max_error: Some(Bound::OfPeak(0.05)), ..NOTHING });
    }

    #[test]
    fn bits_keep_to_the_target(recipe in recipes(), bits in 1.0_f64..12.0) {
        let recipe = Recipe { background: 0.0, low: 0.0, ..recipe };
        let tree = tree_of(&recipe);
        let options = Options { bits_per_voxel: Some(bits), ..NOTHING };
        let packed = check(&still(vec![grid("density", tree.clone())]), &options);
        let stored = &packed.asset.contents().frames[0].grids[0];
        let (mut words, mut bricks) = (0, 0);
        for (i, origin) in tree.leaves.origins.iter().enumerate() {
            let values = tree.leaves.stored(i);
            if values.iter().any(|value| *value != values[0]) {
                bricks += 1;
                let (content, _) = packed.asset.trees().find(stored.levels[0], brick_of(stored, *origin));
                if let Content::Brick { codec, .. } = content {
                    words += codec.word_count();
                }
            }
        }
        let found = words as f64 / 16.0;
        // Sparse noise cannot be had for less than what keeps empty voxels empty.
        let least = packed_least(&tree);
        prop_assert!(found <= (bits * f64::from(bricks)).max(least), "{found} bits per brick voxel of {bits} x {bricks}");
    }

    #[test]
    fn coarser_levels_are_means(recipe in recipes()) {
        let recipe = Recipe { tiles: [0, recipe.tiles[1], recipe.tiles[2]], ..recipe };
        let tree = tree_of(&recipe);
        let options = Options { codec: Some(Codec::F32), coarser_levels: 3, ..NOTHING };
        let Packed { mut asset, .. } = packed(&still(vec![grid("density", tree.clone())]), &options);
        asset.load_all().unwrap();
        let stored = asset.contents().frames[0].grids[0].clone();
        let offset = stored.index_offset;
        let level = |n: usize| {
            let mut contents = asset.contents().clone();
            contents.frames[0].grids[0].levels = vec![stored.levels[n]];
            let asset = Asset::from_parts(contents, asset.trees().clone(), asset.store().clone()).unwrap();
            let (grids, _) = unpack_frame(&asset, 0).unwrap();
            numbers(&grids[0]).0.remove(0)
        };
        let sum = |tree: &Tree<f32>| {
            let relative = |value: f32| f64::from(value) - f64::from(tree.background);
            let mut sum: f64 = tree.leaves.values.iter().map(|value| relative(*value)).sum();
            regions(tree, |_, log2, value| sum += relative(value) * f64::from(3.0 * log2 as f32).exp2());
            sum
        };
        let mut finer = level(0);
        prop_assert_eq!(distance(&tree, &finer).max, 0.0);
        let total = sum(&finer);
        let mut magnitude = 0.0;
        regions(&finer, |_, log2, _| magnitude += f64::from(3.0 * log2 as f32).exp2());
        magnitude = (magnitude + finer.leaves.values.len() as f64) * f64::from(peak_of(&[&finer]));
        for n in 1..stored.levels.len() {
            let coarse = level(n);
            let here = sum(&coarse) * 8.0_f64.powi(n as i32);
            prop_assert!((here - total).abs() <= 1e-5 * magnitude, "level {n}: {here} of {total}");
            for origin in &coarse.leaves.origins {
                for (_, ijk) in voxels_of(*origin) {
                    let fine = |i: usize, axis: usize| {
                        let stored = ijk[axis].wrapping_sub(offset[axis]);
                        stored.wrapping_mul(2).wrapping_add((i >> axis & 1) as i32).wrapping_add(offset[axis])
                    };
                    let mean = (0..8).map(|i| finer.voxel(std::array::from_fn(|axis| fine(i, axis))).value / 8.0);
                    let mean: f32 = mean.sum();
                    let found = coarse.voxel(ijk).value;
                    prop_assert!((found - mean).abs() <= 1e-5 * recipe.high.abs().max(recipe.background.abs()));
                }
                let (content, log2) = asset.trees().find(stored.levels[n], brick_of(&stored, *origin));
                let is_brick = matches!(content, Content::Brick { .. }) && log2 == 0;
                prop_assert!(is_brick);
            }
            finer = coarse;
        }
    }
}

/// The least bits with which the bricks of a tree can be had.
fn packed_least(tree: &Tree<f32>) -> f64 {
    let packed = packed(
        &still(vec![grid("density", tree.clone())]),
        &Options { bits_per_voxel: Some(1e-9), ..NOTHING },
    );
    packed.report.brick_bytes as f64 / 64.0
}

fn lively() -> Recipe {
    Recipe { seed: 5, leaves: 40, tiles: [1, 3, 5], background: 0.0, low: 0.0, high: 1.0, middle: [0; 3] }
}

#[test]
fn a_codec_that_is_asked_for_is_taken() {
    let block = |format| Codec::Block { format, axis: PackingAxis::Z };
    for (recipe, is_signed) in [(lively(), false), (Recipe { low: -1.0, background: 0.2, ..lively() }, true)]
    {
        let tree = tree_of(&recipe);
        let range = if is_signed { 2.0 } else { 1.0 };
        for (codec, most) in [
            (Codec::Uniform { bits: 8 }, range / 255.0 * 0.52),
            (Codec::Uniform { bits: 4 }, range / 15.0 * 0.52),
            (Codec::Uniform { bits: 1 }, range * 0.52),
            (Codec::Gradient { bits: 8 }, range / 255.0),
            (Codec::Gradient { bits: 3 }, range / 7.0),
            (Codec::Gradient { bits: 0 }, 2.0 * range),
            (Codec::F16, range / 2048.0),
            (block(BlockFormat::Bc3), range * 0.9),
            (block(BlockFormat::Bc4), range * 0.3),
            (block(BlockFormat::Bc7), range * 0.9),
            (Codec::F32, 0.0),
        ] {
            let packed = check(
                &still(vec![grid("density", tree.clone())]),
                &Options { codec: Some(codec), ..NOTHING },
            );
            let found = packed.asset.contents().channels[0].quality.max_error;
            assert!(found <= most, "{codec:?}: {found}");
            let is_allowed = |found: &&Codec| [codec, Codec::Uniform { bits: 8 }, Codec::F32].contains(found);
            let codecs = packed.asset.store().codecs();
            assert_eq!(codecs.iter().filter(is_allowed).count(), codecs.len());
            let taken = codecs.iter().filter(|found| **found == codec).count();
            assert!(taken > 0, "{codec:?}: none of {}", codecs.len());
            if matches!(codec, Codec::F16 | Codec::F32 | Codec::Uniform { bits: 8 }) && !is_signed {
                assert_eq!(taken, codecs.len(), "{codec:?}");
            }
        }
    }
}

#[test]
fn nan_and_infinities_are_taken_as_numbers() {
    let mut values = [0.5_f32; 512];
    (values[3], values[80], values[200], values[300]) =
        (f32::NAN, f32::INFINITY, f32::NEG_INFINITY, f32::MAX);
    for background in [0.0, f32::NAN, f32::INFINITY, -1.0] {
        let mut builder = TreeBuilder::new(background, Shape::STANDARD);
        builder.leaf([0; 3], &[u64::MAX; 8], &values);
        builder.leaf([8, 0, 0], &[u64::MAX; 8], &[f32::NAN; 512]);
        builder.tile(2, [-8, 0, 0], f32::NEG_INFINITY, true);
        builder.tile(1, [1024, 0, 0], f32::NAN, true);
        let tree = builder.build().unwrap();
        let grids = vec![grid("odd", tree.clone()), grid("v", tree.map(|value| [value, 1.0, f32::NAN]))];
        check(&still(grids.clone()), &Options { max_error: Some(Bound::OfPeak(1e-3)), ..NOTHING });
        check(&still(grids), &Options { codec: Some(Codec::F32), ..NOTHING });
    }
}

/// Else what was never to be seen would be, since importing keeps to the box of what is active.
#[test]
fn values_beside_the_active_box_come_back_inactive() {
    let mut builder = TreeBuilder::new(0.0, Shape::STANDARD);
    let mut active = [0; 8];
    active[1] = 0b1111 << 16;
    builder.leaf([0; 3], &active, &[0.5; 512]);
    builder.tile(2, [8, 0, 0], 0.25, false);
    let tree = builder.build().unwrap();
    let grids = vec![grid("odd", tree.clone()), grid("v", tree.map(|value| [value, 1.5 * value, 0.0]))];
    let packed = check(&still(grids), &Options { codec: Some(Codec::F32), ..NOTHING });
    for grid in packed.frame(0).0 {
        assert_eq!(grid.tree.active_bbox(), Some([[1, 2, 0], [1, 2, 3]]), "{}", grid.name);
        let numbers = numbers(&grid).0.remove(0);
        assert_eq!(numbers.voxel([7, 7, 7]).value, 0.5);
        assert_eq!(numbers.voxel([9, 1, 1]).value, 0.25);
    }
}

#[test]
fn small_values_beside_a_large_background_are_kept() {
    for background in [1.0, -1.0, 1e6] {
        let mut builder = TreeBuilder::new(background, Shape::STANDARD);
        let mut random = Random(3);
        for i in 0..40 {
            let values: Vec<f32> = (0..512).map(|_| 3.2e-8 + 1e-9 * random.part()).collect();
            builder.leaf([8 * i, 0, 0], &[u64::MAX; 8], &values);
            builder.tile(2, [8 * i, 64, 0], 3.2e-8 + 1e-9 * random.part(), true);
        }
        let frames = still(vec![grid("density", builder.build().unwrap())]);
        let packed = check(&frames, &Options { codec: Some(Codec::F32), ..NOTHING });
        assert_eq!(packed.asset.contents().channels[0].quality.max_error, 0.0);
        let (back, _) = packed.frame(0);
        let [source, back] = [&frames[0].0[0], &back[0]].map(|grid| numbers(grid).0.remove(0));
        assert_eq!(distance(&source, &back).max, 0.0);
    }
}

#[test]
fn names_transforms_and_metadata_come_back() {
    let tree = tree_of(&lively());
    let linear = [[0.5, 0.1, 0.0, 0.0], [-0.2, 2.0, 0.3, 0.0], [0.0, 0.1, -1.5, 0.0], [3.0, -4.0, 5.0, 1.0]];
    let index_box = [[-10.0, -20.0, 5.0], [30.0, 40.0, 60.0]];
    let frustum = Map::Frustum { index_box, taper: 0.4, depth: 1.7, linear };
    let flat = [[0.0; 4], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]];
    let transforms = [
        Transform::uniform_scale(0.1),
        Transform::affine(linear),
        Transform { type_name: "NonlinearFrustumMap".into(), map: frustum },
        Transform::affine(flat),
    ];
    let mut grids = Vec::new();
    for (i, transform) in transforms.into_iter().enumerate() {
        let mut grid = Grid::new(["", "a b", "é\u{1F32B}", "temperature"][i], transform, tree.clone());
        grid.metadata.insert("class", MetaValue::from_text(["fog volume", "unknown", "staggered", "x"][i]));
        grid.metadata.insert("odd", MetaValue { type_name: "mat9q".into(), bytes: vec![1, 2, 3] });
        grid.save_float_as_half = i % 2 == 1;
        grids.push(grid);
    }
    let mut metadata = Metadata::default();
    metadata.insert("creator", MetaValue::from_text("nobody"));
    check(&[(grids, metadata)], &Options::default());
}

#[test]
fn what_cannot_be_packed_is_named() {
    let tree = tree_of(&lively());
    let other_shape = Tree::empty(1.0_f32, Shape::new(&[3, 3]).unwrap());
    let mut grids =
        vec![grid("ids", tree.map(|value| value as i32)), grid("density", tree), grid("flat", other_shape)];
    let points =
        nuage_vdb::File::open(std::fs::read(testkit::committed("data/edge/points.vdb")).unwrap()).unwrap();
    let points = points.read_all().unwrap().into_iter();
    grids.extend(points.filter(|grid| matches!(&*grid.tree, AnyTree::Points(_))));
    let packed =
        check(&[(grids.clone(), Metadata::default()), (grids, Metadata::default())], &Options::default());
    let left_out = &packed.plan.left_out;
    for what in ["ids", "flat", "ptdataidx32"] {
        assert!(left_out.iter().any(|message| message.contains(what)), "{left_out:?}");
    }
    assert_eq!(left_out.iter().collect::<BTreeSet<_>>().len(), left_out.len(), "each once");
    assert_eq!(packed.asset.contents().channels.len(), 1);
}

#[test]
fn equal_frames_cost_next_to_nothing_and_threads_nothing() {
    let frame = (vec![grid("density", tree_of(&Recipe { leaves: 200, ..lively() }))], Metadata::default());
    let other = (vec![grid("density", tree_of(&Recipe { seed: 9, ..lively() }))], Metadata::default());
    let one = packed(std::slice::from_ref(&frame), &Options::default()).bytes.len();
    let frames = vec![frame; 9];
    let nine = packed(&frames, &Options::default());
    assert!(nine.bytes.len() < one + 8 * 256, "{} of {one}", nine.bytes.len());
    let frames = [&frames[..3], &[other]].concat();
    let options = Options { coarser_levels: 2, ..Options::default() };
    let of_threads = |count: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(count).build().unwrap();
        pool.install(|| packed(&frames, &options).bytes)
    };
    let alone = of_threads(1);
    assert!([2, 3, 8].into_iter().all(|count| of_threads(count) == alone));
}

/// A row of bricks that are a wave each, of another strength and height.
fn waves(strengths: impl Iterator<Item = f32>, unit: f32) -> Tree<f32> {
    let mut builder = TreeBuilder::new(0.0, Shape::STANDARD);
    for (brick, strength) in strengths.enumerate() {
        let wave = |i: usize| {
            let [x, y, z] = [i >> 6, i >> 3 & 7, i & 7].map(|c| c as f32 * 0.9);
            unit * (2.0 + 0.01 * brick as f32 + strength * (x.sin() * y.cos() + (0.7 * z).sin()))
        };
        let values: Vec<f32> = (0..512).map(wave).collect();
        builder.leaf([8 * brick as i32, 0, 0], &[u64::MAX; 8], &values);
    }
    builder.build().unwrap()
}

#[test]
fn bricks_that_are_alike_share_a_shape() {
    let strengths = || (0..200).map(|brick| (brick as f32 * 0.7).sin());
    for (unit, max_error, psnr) in
        [(1.0, Some(0.02), None), (1.0, None, Some(45.0)), (3e30, None, Some(40.0))]
    {
        let max_error = max_error.map(Bound::OfPeak);
        let options = Options { max_error, psnr, ..NOTHING };
        let frames = still(vec![grid("density", waves(strengths(), unit))]);
        let plain = check(&frames, &options);
        let shared = check(&frames, &Options { shapes: 16, ..options });
        assert_eq!(plain.report.shape_bytes, 0);
        let codecs = shared.asset.store().codecs();
        let count = codecs.iter().filter(|codec| **codec == Codec::Shared).count();
        assert!(count > 100 && shared.report.shape_bytes > 0, "{count} of {}", codecs.len());
        let bytes = |packed: &Packed| packed.report.brick_bytes + packed.report.shape_bytes;
        assert!(2 * bytes(&shared) < bytes(&plain), "{} of {}", bytes(&shared), bytes(&plain));
    }
}

/// A codec that is asked for one channel is taken there although others are weighed.
#[test]
fn a_codec_for_one_channel_is_taken_beside_a_ratio_for_others() {
    let waves = |name| grid(name, waves((0..20).map(|brick| 0.3 + brick as f32 * 0.05), 1.0));
    let codec = Codec::Block { format: BlockFormat::Bc4, axis: PackingAxis::X };
    let asked = ChannelOptions { codec: Some(codec), psnr: Some(70.0), ..ChannelOptions::default() };
    let options = Options { psnr: Some(40.0), channels: vec![("heat".into(), asked)], ..NOTHING };
    let packed = packed(&still(vec![waves("density"), waves("heat")]), &options);
    let codecs = packed.asset.store().codecs();
    assert_eq!(codecs.iter().filter(|found| **found == codec).count(), 20, "{codecs:?}");
    assert!(codecs.len() > 20, "density has bricks of its own: {codecs:?}");
}

#[test]
fn the_ratio_holds_for_values_whose_squares_vanish() {
    let options = Options { psnr: Some(45.0), ..NOTHING };
    let tree = waves((0..20).map(|brick| brick as f32 * 0.1), 1e-30);
    let packed = check(&still(vec![grid("density", tree)]), &options);
    assert!(packed.report.brick_bytes > 0);
}

#[test]
fn a_frame_that_is_not_there_is_an_error() {
    let names = [FrameName { number: None, name: "a".into() }];
    let failed = pack(&names, |_| Err("gone"), Cursor::new(vec![]), &Options::default(), None, &mut |_| {});
    assert!(matches!(failed, Err(PackError::Load("gone"))));
    let empty = packed(&[], &Options::default());
    assert!(unpack_frame(&empty.asset, 0).is_err() && empty.asset.contents().channels.is_empty());
}

#[test]
fn a_full_node_across_the_origin_comes_back() {
    // As many regions of 128³ as a node holds, but half of them in another.
    let mut builder = TreeBuilder::new(0.0_f32, Shape::STANDARD);
    for slot in 0..LEVEL5.slots() {
        let [x, y, z] = LEVEL5.child_origin([-2048, 0, 0], slot);
        builder.tile(1, [x, y, z], 0.5, true);
    }
    check(&still(vec![grid("density", builder.build().unwrap())]), &Options::default());
}

/// The small files of a folder that are not damaged.
fn small_files(folder: &str) -> Vec<std::path::PathBuf> {
    let Some(folder) = testkit::find(folder) else { return Vec::new() };
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap());
    let is_small = |entry: &std::fs::DirEntry| entry.metadata().unwrap().len() < 300_000;
    let mut files: Vec<_> = entries.filter(is_small).map(|entry| entry.path()).collect();
    files.retain(|path| path.extension().is_some_and(|extension| extension == "vdb"));
    files.sort();
    files
}

fn check_file(path: &std::path::Path) {
    let file = nuage_vdb::File::open(std::fs::read(path).unwrap()).unwrap();
    let Ok(grids) = file.read_all() else { return };
    let options = Options { max_error: Some(Bound::OfPeak(1e-3)), ..NOTHING };
    check(&[(grids, file.metadata.clone())], &options);
}

#[test]
fn files_come_back() {
    let samples = small_files("data/samples");
    for path in small_files("data/edge").iter().chain(samples.iter().step_by(8)) {
        check_file(path);
    }
}

#[test]
fn frames_of_sequences_come_back() {
    for path in [
        "data/sequences/chimney/fluid_data_0004.vdb",
        "data/sequences/blender_variants/test40_f6_ZIP_HALF.vdb",
    ] {
        testkit::find(path).iter().for_each(|path| check_file(path));
    }
}

#[test]
fn a_channel_gets_what_is_asked_of_it_by_name() {
    let noisy = |seed| tree_of(&Recipe { seed, ..lively() });
    let frames = still(vec![grid("density", noisy(5)), grid("heat", noisy(6)), grid("other", noisy(7))]);
    let asked = |name: &str, asked: ChannelOptions| (name.to_owned(), asked);
    let named = vec![
        asked("density", ChannelOptions { codec: Some(Codec::Uniform { bits: 2 }), ..Default::default() }),
        asked(
            "heat",
            ChannelOptions {
                max_error: Some(Bound::Absolute(1e-3)),
                role: Some(Role::Temperature),
                physical_unit: Some("K".into()),
                ..Default::default()
            },
        ),
    ];
    let options = Options { codec: Some(Codec::F32), channels: named, ..NOTHING };
    let all = packed(&frames, &options);
    let [density, heat, other] = all.asset.contents().channels.as_slice() else { panic!("three channels") };
    assert!(density.quality.max_error > 0.1, "{:?}", density.quality);
    assert!(heat.quality.max_error > 0.0 && heat.quality.max_error <= 1e-3, "{:?}", heat.quality);
    assert_eq!(
        (heat.role, heat.physical_unit.as_str(), heat.asked_max_error),
        (Role::Temperature, "K", Some(1e-3))
    );
    assert_eq!((other.quality.max_error, other.physical_unit.as_str()), (0.0, ""));
    assert_eq!(unmet(&all.report, &options), []);
    // Each as if it stood alone.
    let alone = packed(
        &still(vec![grid("heat", noisy(6))]),
        &Options { channels: options.channels[1..].to_vec(), ..NOTHING },
    );
    assert_eq!(alone.asset.contents().channels[0].quality, heat.quality);
    let wrong = Options { channels: vec![asked("smoke", ChannelOptions::default())], ..options };
    let load = |_| Ok::<_, Infallible>(frames[0].clone());
    let name = [FrameName { number: None, name: String::new() }];
    let error = pack(&name, load, Cursor::new(Vec::new()), &wrong, None, &mut |_| {}).unwrap_err();
    assert!(
        error.to_string().ends_with("'smoke', which is in no frame; there are: density, heat, other"),
        "{error}"
    );
}

#[test]
fn what_cannot_be_met_is_known() {
    let frames = still(vec![grid("density", tree_of(&lively()))]);
    let missed = |options: &Options| -> Vec<Asked> {
        unmet(&packed(&frames, options).report, options).into_iter().map(|unmet| unmet.what).collect()
    };
    let bound = Some(Bound::OfPeak(1e-4));
    assert_eq!(missed(&Options { bits_per_voxel: Some(33.0), max_error: bound, ..NOTHING }), []);
    assert_eq!(
        missed(&Options { bits_per_voxel: Some(2.0), max_error: bound, ..NOTHING }),
        [Asked::BitsPerVoxel]
    );
    assert_eq!(missed(&Options { psnr: Some(90.0), ..NOTHING }), []);
    assert_eq!(missed(&Options { psnr: Some(90.0), bits_per_voxel: Some(8.0), ..NOTHING }), [Asked::Psnr]);
    let coarse = Options { codec: Some(Codec::Uniform { bits: 2 }), ..NOTHING };
    assert_eq!(
        missed(&Options { psnr: Some(60.0), max_error: bound, ..coarse }),
        [Asked::MaxError, Asked::Psnr]
    );
}
