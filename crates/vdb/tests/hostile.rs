//! Damaged files: whatever the damage, the end is an error or a grid, soon and within the memory limit.
//!
//! All in one test, because the counting allocator is one for the whole process.

mod surgery;

use std::alloc::System;
use std::path::Path;
use std::time::{Duration, Instant};

use cap::Cap;
use nuage_testkit as testkit;
use nuage_vdb::{AnyTree, Error, File, Limits, with_tree};

#[global_allocator]
static ALLOCATOR: Cap<System> = Cap::new(System, usize::MAX);

const MIB: u64 = 1 << 20;
/// What the reader may take beyond its limit: a few megabytes per thread, on machines of many threads.
const WORKING_BYTES: u64 = 256 * MIB;

#[test]
fn bad_files_end_in_errors_within_the_limits() {
    // From the smaller limits to the larger, since the allocator knows only the highest peak of all.
    small_limits_are_kept_and_named();
    with_limit(64 * MIB, every_truncation_is_an_error);
    with_limit(64 * MIB, prefixes_of_all_files_are_errors);
    with_limit(64 * MIB, random_damage_is_an_error_or_a_grid);
    with_limit(64 * MIB, extreme_values_in_headers_are_errors_or_grids);
    with_limit(64 * MIB, the_collected_bad_files_end_soon);
}

/// Runs `f` with limits of that many bytes and holds the memory it takes to them.
fn with_limit(max_memory_bytes: u64, f: impl FnOnce(Limits)) {
    let start = ALLOCATOR.allocated();
    f(Limits { max_memory_bytes });
    let peak = ALLOCATOR.max_allocated().saturating_sub(start) as u64;
    assert!(peak <= max_memory_bytes + WORKING_BYTES, "{peak} bytes under a limit of {max_memory_bytes}");
}

fn committed(name: &str) -> Vec<u8> {
    std::fs::read(testkit::committed("data/edge").join(name)).unwrap()
}

/// Opens the file, reads every grid and makes use of the trees.
fn read_all(bytes: &[u8], limits: Limits) -> Result<usize, Error> {
    let file = File::open_with(bytes, limits)?;
    let mut read = 0;
    for index in (0..file.grids.len()).filter(|i| file.grids[*i].is_readable()) {
        let grid = file.read_grid(index)?;
        use_tree(&grid.tree);
        grid.transform.voxel_size();
        read += 1;
    }
    Ok(read)
}

/// Walks through a tree; whatever a damaged file made of it, nothing may point outside.
fn use_tree(tree: &AnyTree) {
    for corner in tree.statistics().active_bbox.into_iter().flatten() {
        tree.voxel(corner);
    }
    with_tree!(tree, tree => {
        let leaves = tree.leaf_order();
        assert!(leaves.iter().all(|leaf| *leaf < tree.leaves.len()));
        assert_eq!(leaves.len(), tree.leaves.len());
    });
}

/// Like [`read_all`] for a file that was sound before: its errors are never the caller's or the disk's fault.
fn survives(bytes: &[u8], limits: Limits, context: impl Fn() -> String) -> bool {
    match read_all(bytes, limits) {
        Ok(_) => true,
        Err(Error::Malformed { .. } | Error::Unsupported { .. } | Error::Limit { .. }) => false,
        Err(error) => panic!("{}: {error:?}", context()),
    }
}

fn small_limits_are_kept_and_named() {
    for name in ["leaf_masks.vdb", "half_bloscmask.vdb", "transforms.vdb", "metadata_all.vdb"] {
        let bytes = committed(name);
        read_all(&bytes, Limits::default()).unwrap();
        let mut limit = 1;
        loop {
            let mut result = Ok(0);
            with_limit(limit, |limits| result = read_all(&bytes, limits));
            match result {
                Ok(_) => break,
                Err(Error::Limit { needed_bytes, limit_bytes, .. }) => {
                    assert!(
                        limit_bytes == limit && needed_bytes > limit,
                        "{name}: {needed_bytes} of {limit}"
                    );
                }
                Err(error) => panic!("{name} with a limit of {limit} bytes: {error}"),
            }
            limit *= 2;
        }
        assert!((bytes.len() as u64 / 16..64 * MIB).contains(&limit), "{name} is read with {limit} bytes");
    }
}

fn every_truncation_is_an_error(limits: Limits) {
    let files = ["leaf_masks.vdb", "comp_random_blosc.vdb", "leaf_masks_zip.vdb", "comp_random_mask.vdb"];
    let mut all: Vec<(&str, Vec<u8>)> = files.iter().map(|name| (*name, committed(name))).collect();
    all.push(("half_bloscmask.vdb", surgery::first_grid(&committed("half_bloscmask.vdb"))));
    for (name, bytes) in all {
        assert_eq!(read_all(&bytes, limits).unwrap(), 1, "{name}");
        let malformed = |cut: &[u8], how: &str| match read_all(cut, limits) {
            Err(Error::Malformed { offset, .. }) if offset <= cut.len() as u64 => {}
            other => panic!("{name} {how} after {} bytes: {other:?}", cut.len()),
        };
        for len in 0..bytes.len() {
            malformed(&bytes[..len], "cut");
        }
        // As above, opening sees that the grid is cut. Where it cannot see that, reading does.
        let (stream, layout) = (surgery::as_stream(&bytes), surgery::layout(&bytes));
        assert_eq!(read_all(&stream, limits).unwrap(), 1, "{name}");
        let sparse = |len: &usize| *len < 600 || len + 300 > bytes.len() || len.is_multiple_of(41);
        for len in (0..bytes.len()).filter(sparse) {
            malformed(&stream[..len], "as a stream cut");
            if len >= layout.grids[0].begin {
                malformed(&surgery::cut_with_its_end(&bytes, &layout, len), "with its end moved and cut");
            }
        }
    }
}

fn prefixes_of_all_files_are_errors(limits: Limits) {
    let folder = std::fs::read_dir(testkit::committed("data/edge")).unwrap();
    let paths = folder.map(|entry| entry.unwrap().path());
    let mut files = 0;
    for path in paths.filter(|path| path.extension().is_some_and(|extension| extension == "vdb")) {
        let bytes = std::fs::read(&path).unwrap();
        let stream = surgery::as_stream(&bytes);
        for whole in [&bytes, &stream] {
            let started = Instant::now();
            // The beginning in full, the rest here and there.
            let step = 1 + whole.len() / 40;
            for len in
                (0..whole.len().min(130)).chain((130..whole.len()).step_by(step)).chain([whole.len() - 1])
            {
                let result = read_all(&whole[..len], limits);
                assert!(
                    matches!(result, Err(Error::Malformed { .. })),
                    "{}: {len}: {result:?}",
                    path.display()
                );
            }
            assert!(started.elapsed() < Duration::from_secs(20), "{}", path.display());
        }
        files += 1;
    }
    assert!(files >= 35, "only {files} files");
}

fn random_damage_is_an_error_or_a_grid(limits: Limits) {
    let sound = [
        committed("leaf_masks_zip.vdb"),
        surgery::first_grid(&committed("half_bloscmask.vdb")),
        committed("comp_random_blosc.vdb"),
    ];
    let forms: Vec<Vec<u8>> = sound.iter().flat_map(|b| [b.clone(), surgery::as_stream(b)]).collect();
    let mut random = SplitMix(0x6e75_6167_6520_7664);
    let mut read = 0;
    const ROUNDS: usize = 10_000;
    for round in 0..ROUNDS {
        let mut bytes = forms[round % forms.len()].clone();
        let reach = if (round / forms.len()).is_multiple_of(2) { 2048 } else { bytes.len() };
        for _ in 0..1 + random.below(4) {
            bytes[random.below(reach)] = random.next() as u8;
        }
        read += usize::from(survives(&bytes, limits, || format!("round {round}")));
    }
    assert!(read > ROUNDS / 100 && read < ROUNDS * 99 / 100, "{read} of {ROUNDS} damaged files were read");
}

fn extreme_values_in_headers_are_errors_or_grids(limits: Limits) {
    let words: [u32; 5] = [0, 1, 0x7fff_ffff, 0x8000_0000, 0xffff_ffff];
    let longs: [i64; 5] = [0, 1, i64::MIN, i64::MAX, -1];
    let patches: Vec<Vec<u8>> = words
        .iter()
        .map(|w| w.to_le_bytes().to_vec())
        .chain(longs.map(|l| l.to_le_bytes().to_vec()))
        .collect();
    for name in ["empty_grid.vdb", "leaf_masks.vdb"] {
        let sound = committed(name);
        for form in [sound.clone(), surgery::as_stream(&sound)] {
            for (at, patch) in (0..600).flat_map(|at| patches.iter().map(move |patch| (at, patch))) {
                let mut bytes = form.clone();
                let Some(place) = bytes.get_mut(at..at + patch.len()) else { continue };
                place.copy_from_slice(patch);
                survives(&bytes, limits, || format!("{name} with {patch:?} at {at}"));
            }
        }
    }
}

fn the_collected_bad_files_end_soon(limits: Limits) {
    let committed = testkit::committed("data/edge/bad");
    assert!(check_folder(&committed, limits) >= 30, "{} is incomplete", committed.display());
    if let Some(external) = testkit::find("data/edge/bad") {
        check_folder(&external, limits);
    }
}

/// Reads the files that a manifest names, as far as they are there; gives their number.
fn check_folder(folder: &Path, limits: Limits) -> usize {
    let manifest = std::fs::read_to_string(folder.join("MANIFEST.txt")).unwrap();
    let names = manifest.lines().filter_map(|line| line.split_once(':')).map(|(name, _)| name);
    let mut found = 0;
    for name in names {
        let Ok(bytes) = std::fs::read(folder.join(format!("{name}.vdb"))) else { continue };
        found += 1;
        let begin = Instant::now();
        let read = survives(&bytes, limits, || name.to_owned());
        assert!(begin.elapsed() < Duration::from_secs(5), "{name} took {:?}", begin.elapsed());
        let whole = ["noise_", "huge_"].iter().any(|kind| name.starts_with(kind));
        assert!(whole || !read, "{name} was read");
    }
    found
}

/// A small random number generator, the same everywhere (Steele, Lea and Flood 2014).
struct SplitMix(u64);

impl SplitMix {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ z >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ z >> 31
    }

    fn below(&mut self, end: usize) -> usize {
        (self.next() % end as u64) as usize
    }
}
