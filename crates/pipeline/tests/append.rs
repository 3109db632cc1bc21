//! Frames that are added to a packed file: the old ones stay to the bit, the new ones keep to what was asked, and what is
//! equal is stored once. And packing that is stopped and taken up again.

use std::collections::HashMap;
use std::convert::Infallible;
use std::io::Cursor;
use std::sync::Mutex;

use nuage_pipeline::pack::append;
use nuage_pipeline::pack::assemble::Report;
use nuage_pipeline::pack::frame::{Bound, Options};
use nuage_pipeline::pack::sequence::{FrameName, Loaded, PackError, Surroundings, pack_with};
use nuage_pipeline::pack::unpack::unpack_frame;
use nuage_pipeline::pack::work::{Keep, Recipe};
use nuage_vdb::{AnyTree, Grid, Metadata, Shape, Transform, Tree, TreeBuilder};
use nuage_volume::codec::Codec;
use nuage_volume::format::Asset;

/// A cloud between `low` and `high` that is another for each seed, but for one leaf.
fn cloud(seed: u32, low: f32, high: f32) -> Tree<f32> {
    let mut builder = TreeBuilder::new(0.0_f32, Shape::STANDARD);
    for leaf in 0..30_i32 {
        let seed = if leaf == 0 { 0 } else { seed };
        let wave = |i: usize| {
            let [x, y, z] = [i >> 6, i >> 3 & 7, i & 7].map(|c| c as f32 * 0.4);
            let at = leaf as f32 + seed as f32;
            let noise = ((i as u32 + 1).wrapping_mul(2_654_435_761 ^ seed) >> 20) as f32 / 4096.0;
            0.5 + 0.4 * (x + at).sin() * (y * at * 0.1).cos() * z.cos() + 0.1 * noise
        };
        // The ends of the range are there.
        let part = |i: usize| [0.0, 1.0].get(i).copied().unwrap_or_else(|| wave(i));
        let values: Vec<f32> = (0..512)
            .map(|i| if leaf == 0 { 0.2 * wave(i) } else { low + (high - low) * part(i).clamp(0.0, 1.0) })
            .collect();
        builder.leaf([leaf * 8, 0, leaf % 3 * 8], &[u64::MAX; 8], &values);
    }
    builder.build().unwrap()
}

fn frame(tree: Tree<f32>) -> Loaded {
    (vec![Grid::new("density", Transform::identity(), tree)], Metadata::default())
}

fn pack(
    surroundings: Surroundings,
    frames: &[Loaded],
    first: i64,
    options: &Options,
) -> Result<(Report, Vec<u8>), PackError<Infallible>> {
    let names: Vec<FrameName> =
        (first..).take(frames.len()).map(|n| FrameName { number: Some(n), name: format!("f{n}") }).collect();
    let mut out = Cursor::new(Vec::new());
    let load = |i: usize| Ok(frames[i].clone());
    let (report, _) = pack_with(surroundings, &names, load, &mut out, options, Some(24.0), &mut |_| {})?;
    Ok((report, out.into_inner()))
}

fn values(asset: &mut Asset, number: i64) -> (Tree<f32>, usize) {
    asset.load_all().unwrap();
    let place = asset.contents().frames.iter().position(|frame| frame.number == Some(number)).unwrap();
    let (grids, _) = unpack_frame(asset, place).unwrap();
    let channel = asset.contents().frames[place].grids[0].channel as usize;
    match &*grids[0].tree {
        AnyTree::Float(tree) => (tree.clone(), channel),
        other => panic!("{}", other.value_type()),
    }
}

/// The largest difference, over the voxels of leaves of `a`.
fn difference(a: &Tree<f32>, b: &Tree<f32>) -> f32 {
    let mut largest = 0.0_f32;
    for (i, origin) in a.leaves.origins.iter().enumerate() {
        for (voxel, value) in a.leaves.stored(i).iter().enumerate() {
            let [x, y, z] = [voxel >> 6, voxel >> 3 & 7, voxel & 7].map(|c| c as i32);
            let other = b.voxel([origin[0] + x, origin[1] + y, origin[2] + z]).value;
            largest = largest.max((value - other).abs());
        }
    }
    largest
}

#[test]
fn what_is_added_keeps_to_what_was_asked_and_changes_nothing() {
    let demands = [
        Options::default(),
        Options { psnr: Some(25.0), max_error: None, shapes: 8, ..Options::default() },
        Options {
            psnr: None,
            max_error: Some(Bound::Absolute(0.01)),
            coarser_levels: 2,
            ..Options::default()
        },
        Options {
            psnr: None,
            max_error: None,
            codec: Some(Codec::Uniform { bits: 6 }),
            ..Options::default()
        },
        Options { psnr: None, max_error: None, bits_per_voxel: Some(4.0), ..Options::default() },
    ];
    for options in &demands {
        // Range of the frames that are added, and the channel that takes them.
        let added: [(f32, f32, usize); 6] =
            [(0.0, 0.8, 0), (0.0, 0.97, 0), (0.0, 3.0, 1), (-0.5, 0.5, 2), (0.0, 2.5, 1), (-0.45, 0.3, 2)];
        let first: Vec<Loaded> = (1..4).map(|seed| frame(cloud(seed, 0.0, 0.9))).collect();
        let (report, mut bytes) = pack(Surroundings::default(), &first, 1, options).unwrap();
        assert_eq!(append::options(&report.contents).as_ref(), Some(options));
        let (words, mut source_bricks) = (report.brick_bytes, report.source_bricks);
        for (i, (low, high, channel)) in added.into_iter().enumerate() {
            let number = 10 + i as i64;
            let (new, mut before) = (cloud(50 + i as u32, low, high), Asset::open(bytes.clone()).unwrap());
            let surroundings = Surroundings { base: Some(&before), ..Surroundings::default() };
            let (report, grown) = pack(surroundings, &[frame(new.clone())], number, options).unwrap();
            assert_eq!(report.summary.file_bytes, grown.len() as u64);
            source_bricks += 30;
            assert_eq!(report.source_bricks, source_bricks);
            let mut after = Asset::open(grown.clone()).unwrap();
            for frame in before.contents().frames.clone() {
                let number = frame.number.unwrap();
                assert_eq!(
                    values(&mut before, number),
                    values(&mut after, number),
                    "{options:?} frame {number}"
                );
            }
            let (back, found) = values(&mut after, number);
            assert_eq!(found, channel, "{options:?} {low} to {high}");
            let info = &after.contents().channels[channel];
            let error = difference(&new, &back);
            assert!(error <= info.quality.max_error && error > 0.0, "{error} {:?}", info.quality);
            let old_bound = info.asked_max_error.unwrap_or(f32::MAX);
            assert!(error <= old_bound && info.peak >= high.max(-low) && info.peak <= info.unit);
            let mean = info.quality.squared_error / info.quality.voxels as f64;
            let psnr = 10.0 * (f64::from(info.peak).powi(2) / mean).log10();
            assert!(options.psnr.is_none_or(|asked| psnr >= asked), "{options:?} {i}: {psnr} dB");
            let levels = &after.contents().frames.last().unwrap().grids[0].levels;
            assert_eq!(levels.len(), options.coarser_levels as usize + 1);
            assert_eq!(after.contents().frame_rate, Some(24.0));
            bytes = grown;
        }
        // A frame that is there already costs its roots, and stands where its number belongs.
        let before = Asset::open(bytes.clone()).unwrap();
        let stored: u64 = before.store().pages().iter().map(|page| 4 * u64::from(page.word_count)).sum();
        let surroundings = Surroundings { base: Some(&before), ..Surroundings::default() };
        let (report, again) = pack(surroundings, &first[1..2], 5, options).unwrap();
        // Shapes are found anew, so that what shares them may do so otherwise.
        let is_equal = report.brick_bytes == stored || options.shapes > 0;
        assert!(words < stored && is_equal, "{options:?}");
        let levels = &report.contents.frames[3].grids[0].levels;
        let root_bytes = 20 * levels.iter().map(|tree| u64::from(tree.cell_count)).sum::<u64>();
        let tree_bytes = before.trees().size_bytes() as u64 + root_bytes;
        assert!(report.tree_bytes == tree_bytes || options.shapes > 0, "{options:?}");
        let numbers: Vec<Option<i64>> = report.contents.frames.iter().map(|frame| frame.number).collect();
        assert_eq!(numbers[..5], [1, 2, 3, 5, 10].map(Some));
        let mut after = Asset::open(again).unwrap();
        assert!(options.shapes > 0 || values(&mut after, 5) == values(&mut after, 2));
    }
}

#[test]
fn a_damaged_file_is_not_added_to() {
    let frames = [frame(cloud(1, 0.0, 1.0))];
    let (_, bytes) = pack(Surroundings::default(), &frames, 1, &Options::default()).unwrap();
    // The first page stands behind the header.
    let mut damaged = bytes;
    damaged[100] ^= 1;
    let base = Asset::open(damaged).unwrap();
    let surroundings = Surroundings { base: Some(&base), ..Surroundings::default() };
    let error = pack(surroundings, &frames, 2, &Options::default()).unwrap_err();
    assert!(error.to_string().contains("checksum"), "{error}");
}

#[test]
fn what_was_finished_is_not_done_again_and_gives_the_same_file() {
    let frames: Vec<Loaded> = (1..6).map(|seed| frame(cloud(seed, 0.0, 1.0))).collect();
    let options =
        Options { psnr: Some(25.0), max_error: None, coarser_levels: 1, shapes: 8, ..Options::default() };
    let recipe = Recipe::new(&options, Some(24.0), "", (0..5).collect());
    let noted = Surroundings { recipe: Some(&recipe), ..Surroundings::default() };
    let (report, whole) = pack(noted, &frames, 1, &options).unwrap();
    let names: Vec<FrameName> =
        (1..6).map(|n| FrameName { number: Some(n), name: format!("f{n}") }).collect();
    assert!(recipe.made(&report.contents, &names));
    for other in [
        Recipe::new(&options, Some(25.0), "", (0..5).collect()),
        Recipe::new(&options, Some(24.0), "crop", (0..5).collect()),
        Recipe::new(&Options::default(), Some(24.0), "", (0..5).collect()),
        Recipe::new(&options, Some(24.0), "", (1..6).collect()),
    ] {
        assert!(!other.made(&report.contents, &names));
        assert_ne!(other.key(&names, None), recipe.key(&names, None));
    }
    assert!(!recipe.made(&report.contents, &names[..4]));
    let kept: Mutex<HashMap<String, Vec<u8>>> = Mutex::default();
    let load = |name: &str| kept.lock().unwrap().get(name).cloned();
    let save = |name: &str, bytes: &[u8]| _ = kept.lock().unwrap().insert(name.to_owned(), bytes.to_vec());
    let keep = Surroundings { keep: Some(Keep { load: &load, save: &save }), ..noted };
    let (_, kept_whole) = pack(keep, &frames, 1, &options).unwrap();
    assert!(kept_whole == whole);
    assert_eq!(kept.lock().unwrap().len(), 6);
    // Frames that are asked for again would be others.
    let nothing: Vec<Loaded> = frames.iter().map(|_| (Vec::new(), Metadata::default())).collect();
    let (_, again) = pack(keep, &nothing, 1, &options).unwrap();
    assert!(again == whole, "all of it was kept");
    for lost in ["frame.0", "frame.3", "plan"] {
        kept.lock().unwrap().remove(lost);
        let (_, again) = pack(keep, &frames, 1, &options).unwrap();
        assert!(again == whole, "{lost}");
        kept.lock().unwrap().insert(lost.to_owned(), b"damaged".to_vec());
        let (_, again) = pack(keep, &frames, 1, &options).unwrap();
        assert!(again == whole, "damaged {lost}");
    }
}
