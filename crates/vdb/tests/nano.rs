//! NanoVDB files: what we write we read again, and so do NanoVDB's own tools where they are installed;
//! damaged files end in errors.

use std::path::{Path, PathBuf};
use std::process::Command;

use nuage_testkit as testkit;
use nuage_vdb::nano::{self, Codec, Encoding, WriteOptions};
use nuage_vdb::{
    AnyTree, Error, File, Grid, LeafValues, Limits, MetaValue, Shape, Transform, Tree, TreeBuilder, Value,
    ValueMask, with_tree,
};
use proptest::prelude::*;

/// A small generator of its own, so that every type of values is made from the same numbers.
struct SplitMix(u64);

impl SplitMix {
    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    fn below(&mut self, n: usize) -> usize {
        (self.next() % n as u64) as usize
    }
}

/// A tree with some leaves and tiles at all depths.
fn random_tree<V: Value>(seed: u64, value: fn(u64) -> V) -> Tree<V> {
    let mut random = SplitMix(seed);
    let mut builder = TreeBuilder::new(value(random.next()), Shape::STANDARD);
    // Places that cannot overlap: depths have regions of their own.
    for i in 0..1 + random.below(5) as i32 {
        let mask: Vec<u64> = match random.below(3) {
            0 => vec![0; 8],
            1 => vec![!0; 8],
            _ => (0..8).map(|_| random.next() & random.next()).collect(),
        };
        let mut stored = vec![V::Stored::default(); V::stored_per_leaf(512)];
        match V::leaf_mut(&mut stored) {
            LeafValues::Plain(values) => values.iter_mut().for_each(|v| *v = value(random.next())),
            LeafValues::Bits(words) => words.iter_mut().for_each(|w| *w = random.next()),
            LeafValues::Mask => {}
        }
        builder.leaf([-4096 + 8 * i * i, 8 * (i % 2) - 8, 128 * i], &mask, &stored);
    }
    for i in 0..random.below(4) as i32 {
        let active = random.below(2) == 1;
        builder.tile(2, [8 * i, 0, -100_000], value(random.next()), active);
        builder.tile(1, [128 * i, 4096, -100_000], value(random.next()), !active);
        builder.tile(0, [4096 * i, 500_000, 4096], value(random.next()), active);
    }
    builder.build().unwrap()
}

fn number(bits: u64) -> f64 {
    (bits >> 40) as f64 / 1024.0 - 5000.0
}

fn random_trees(seed: u64) -> Vec<AnyTree> {
    vec![
        random_tree(seed, |bits| number(bits) as f32).into(),
        random_tree(seed, number).into(),
        random_tree(seed, |bits| bits as i32).into(),
        random_tree(seed, |bits| bits as i64).into(),
        random_tree(seed, |bits| bits & 1 == 1).into(),
        random_tree(seed, |bits| ValueMask(bits & 1 == 1)).into(),
        random_tree(seed, |bits| [bits, bits << 13, bits << 26].map(|b| number(b) as f32)).into(),
        random_tree(seed, |bits| [bits, bits << 13, bits << 26].map(number)).into(),
        random_tree(!seed, |bits| number(bits) as f32).into(),
    ]
}

fn named(name: &str, tree: AnyTree) -> Grid {
    let matrix = [[0.5, 0.0, 0.1, 0.0], [0.0, 0.25, 0.0, 0.0], [0.0, -0.2, 2.0, 0.0], [1.0, -2.0, 1e6, 1.0]];
    let mut grid = Grid::new(name, Transform::affine(matrix), tree);
    let class = match &*grid.tree {
        AnyTree::Float(_) => "fog volume",
        AnyTree::Double(_) => "level set",
        AnyTree::Vec3s(_) => "staggered",
        _ => return grid,
    };
    grid.metadata.insert("class", MetaValue::from_text(class));
    grid
}

fn random_grids(seed: u64) -> Vec<Grid> {
    let trees = random_trees(seed).into_iter();
    trees.map(|tree| named(&format!("{} {seed}", tree.value_type()), tree)).collect()
}

fn written(grids: &[Grid], encoding: Encoding, codec: Codec) -> Vec<u8> {
    let mut bytes = Vec::new();
    nano::write(grids, &WriteOptions { encoding, codec }, &mut bytes).unwrap();
    bytes
}

fn read_back(bytes: Vec<u8>) -> Vec<Grid> {
    nano::File::open(bytes).unwrap().read_all().unwrap()
}

/// Holds two trees to the same nodes, states and values; values of leaf `i` may be `tolerance(i)` apart.
fn assert_close(got: &AnyTree, want: &AnyTree, tolerance: impl Fn(usize) -> f64, context: &str) {
    assert_eq!(got.value_type(), want.value_type(), "{context}");
    with_tree!(got, got => {
        with_tree!(want, want => assert_trees_close(got, want, tolerance, context))
    });
}

fn assert_trees_close<V: Value, W: Value>(
    got: &Tree<V>,
    want: &Tree<W>,
    tolerance: impl Fn(usize) -> f64,
    context: &str,
) {
    let same = |a: V, b: W, tolerance: f64| {
        (0..V::COMPONENTS).all(|i| {
            let (a, b) = (a.component(i), b.component(i));
            testkit::same(a, b) || (a - b).abs() <= tolerance
        })
    };
    assert!(same(got.background, want.background, 0.0), "{context}");
    assert_eq!(got.root_tiles.len(), want.root_tiles.len(), "{context}");
    for (a, b) in got.root_tiles.iter().zip(&want.root_tiles) {
        assert!(
            a.origin == b.origin && a.active == b.active && same(a.value, b.value, 0.0),
            "{context}: {a:?}"
        );
    }
    for (a, b) in got.levels.iter().zip(&want.levels) {
        assert_eq!(a.len(), b.len(), "{context}");
        for (a, b) in a.iter().zip(b) {
            assert!(a.origin == b.origin && a.child_mask == b.child_mask, "{context}: {:?}", a.origin);
            for ((slot, value, active), (other_slot, other, other_active)) in
                a.tile_slots().zip(b.tile_slots())
            {
                let same = slot == other_slot && active == other_active && same(value, other, 0.0);
                assert!(same, "{context}: {:?} {slot} {value:?} {other:?}", a.origin);
            }
        }
    }
    assert_eq!(got.leaves.origins, want.leaves.origins, "{context}");
    assert_eq!(got.leaves.masks, want.leaves.masks, "{context}");
    for i in 0..got.leaves.len() {
        for offset in 0..512 {
            let (a, b) = (got.leaves.value(i, offset), want.leaves.value(i, offset));
            assert!(same(a, b, tolerance(i)), "{context}: leaf {i} at {offset}: {a:?} for {b:?}");
        }
    }
}

/// Half of the quantum of each leaf with codes of that many bits, and what single precision adds.
fn half_quantum(tree: &AnyTree, bits: u32) -> impl Fn(usize) -> f64 {
    let leaves = tree.as_float().unwrap().leaves.clone();
    move |i| {
        let values = leaves.stored(i);
        let (min, max) = values.iter().fold((f32::MAX, f32::MIN), |(a, b), v| (a.min(*v), b.max(*v)));
        let quantum = f64::from(max - min) / f64::from((1u32 << bits) - 1);
        0.50001 * quantum + 2.0 * f64::from(f32::EPSILON * min.abs().max(max.abs()))
    }
}

const QUANTISED: [(Encoding, u32); 3] = [(Encoding::Fp16, 16), (Encoding::Fp8, 8), (Encoding::Fp4, 4)];

proptest! {
    #![proptest_config(ProptestConfig::with_cases(4))]

    #[test]
    fn grids_of_all_types_come_back(seed: u64) {
        let grids = random_grids(seed);
        for codec in [Codec::None, Codec::Zip] {
            let bytes = written(&grids, Encoding::Full, codec);
            prop_assert_eq!(&bytes, &written(&grids, Encoding::Full, codec));
            let back = read_back(bytes);
            prop_assert_eq!(back.len(), grids.len());
            for (got, want) in back.iter().zip(&grids) {
                prop_assert_eq!(got, want);
            }
        }
    }

    #[test]
    fn quantised_grids_come_back_within_half_a_quantum(seed: u64) {
        let tree = AnyTree::from(random_tree(seed, |bits| number(bits) as f32));
        let grids = [named("quantised", tree.clone())];
        for (encoding, bits) in QUANTISED {
            let back = read_back(written(&grids, encoding, Codec::Zip));
            prop_assert_eq!(&back[0].metadata, &grids[0].metadata);
            assert_close(&back[0].tree, &tree, half_quantum(&tree, bits), &format!("{encoding:?}"));
        }
        for max_error in [0.2, 3.0, 30.0, 300.0, 3000.0] {
            let back = read_back(written(&grids, Encoding::FpN { max_error }, Codec::None));
            assert_close(&back[0].tree, &tree, |_| max_error.into(), &format!("FpN {max_error}"));
        }
    }
}

#[test]
fn files_say_what_their_grids_are() {
    let mut builder = TreeBuilder::new(0.0_f32, Shape::STANDARD);
    builder.leaf([8, 0, -8], &[0, 0b1000, 0, 0, 0, 0, 0, 0], &[0.5; 512]);
    let long = "n".repeat(300);
    let tree = builder.build().unwrap();
    let grids = [
        Grid::new("b", Transform::uniform_scale(0.25), tree.clone()),
        Grid::new(&long, Transform::identity(), Tree::empty(true, Shape::STANDARD)),
    ];
    let bytes = written(&grids, Encoding::Fp8, Codec::Zip);
    let file = nano::File::open(&bytes[..]).unwrap();
    let info = &file.grids[file.find("b").unwrap()];
    assert_eq!((info.value_type, info.grid_class, info.version), ("Fp8", "unknown", [32, 4, 2]));
    assert_eq!((info.codec, info.active_voxels, info.voxel_size), (Codec::Zip, 1, [0.25; 3]));
    assert_eq!(info.active_bbox, Some([[9, 0, -5]; 2]));
    assert_eq!(info.node_counts_leaf_to_root, [1, 1, 1, 1]);
    let empty = &file.grids[file.find(&long).unwrap()];
    assert_eq!((empty.active_bbox, empty.value_type, empty.active_voxels), (None, "bool", 0));
    assert_eq!(file.read_grid(0).unwrap().transform, grids[0].transform);
    assert!(matches!(file.read_grid(2), Err(Error::Misuse(_))));

    // The same grids without a file around them, as later versions write them.
    let bare: Vec<u8> = grids.iter().enumerate().flat_map(|(i, grid)| bare_grid(grid, i as u32, 2)).collect();
    let second = bare_grid(&grids[0], 0, 2).len();
    for offset in [-5000, i64::MIN, i64::MAX, 1 << 20] {
        let mut wrong = bare.clone();
        wrong[second + 672 + 24..second + 672 + 32].copy_from_slice(&offset.to_le_bytes());
        let opened = nano::File::open(wrong);
        assert!(matches!(opened.err(), Some(Error::Malformed { .. })), "{offset}");
    }
    let file = nano::File::open(bare).unwrap();
    assert_eq!(file.grids.iter().map(|info| &info.name[..]).collect::<Vec<_>>(), ["b", &long]);
    assert_eq!(file.grids[0].active_bbox, Some([[9, 0, -5]; 2]));
    assert_eq!(file.grids[1].active_bbox, None);
    assert_eq!(file.read_all().unwrap(), grids);
}

/// A grid's bytes alone, with the magic number and version of later files.
fn bare_grid(grid: &Grid, index: u32, count: u32) -> Vec<u8> {
    let file = written(std::slice::from_ref(grid), Encoding::Full, Codec::None);
    let mut bytes = file[16 + 176 + grid.name.len() + 1..].to_vec();
    bytes[..8].copy_from_slice(b"NanoVDB1");
    bytes[16..20].copy_from_slice(&(32_u32 << 21 | 7 << 10).to_le_bytes());
    bytes[24..28].copy_from_slice(&index.to_le_bytes());
    bytes[28..32].copy_from_slice(&count.to_le_bytes());
    bytes
}

#[test]
fn what_nanovdb_cannot_hold_is_refused() {
    let write = |grid: Grid, encoding: Encoding, codec: Codec| {
        nano::write(&[grid], &WriteOptions { encoding, codec }, &mut Vec::new())
    };
    let grid = |tree: AnyTree| Grid::new("x", Transform::identity(), tree);
    let empty = || AnyTree::from(Tree::empty(0.0_f32, Shape::STANDARD));
    assert!(matches!(nano::write(&[], &WriteOptions::default(), &mut Vec::new()), Err(Error::Misuse(_))));
    let vectors = Tree::empty([0_i32; 3], Shape::STANDARD);
    let shape = Shape::new(&[4, 3]).unwrap();
    for tree in [AnyTree::from(vectors), Tree::empty(0.0_f32, shape).into()] {
        assert!(matches!(write(grid(tree), Encoding::Full, Codec::None), Err(Error::Unsupported { .. })));
    }
    let zero = Grid::new("a\0b", Transform::identity(), empty());
    let flat = Grid::new("flat", Transform::uniform_scale(0.0), empty());
    let mut builder = TreeBuilder::new(0.0_f32, Shape::STANDARD);
    builder.leaf([0; 3], &[0; 8], &[f32::NAN; 512]);
    let nan = grid(builder.build().unwrap().into());
    assert!(write(nan.clone(), Encoding::Full, Codec::None).is_ok());
    for grid in [zero, flat, nan] {
        assert!(matches!(write(grid, Encoding::Fp8, Codec::None), Err(Error::Misuse(_))));
    }
    let mut half = TreeBuilder::new(half::f16::ONE, Shape::STANDARD);
    half.tile(0, [0; 3], half::f16::from_f32(0.5), true);
    let back = read_back(written(&[grid(half.build().unwrap().into())], Encoding::Fp4, Codec::None));
    assert_eq!(back[0].tree.voxel([5; 3]).components, [0.5]);
}

#[test]
fn damaged_files_end_in_errors_or_grids() {
    let limits = Limits { max_memory_bytes: 64 << 20 };
    let grids: Vec<Grid> =
        [1, 4, 9].map(|seed| named("g", random_tree(seed, |bits| number(bits) as f32).into())).into();
    let bools = [named("b", random_tree(3, |bits| bits & 1 == 1).into())];
    let files = vec![
        written(&grids[..1], Encoding::Full, Codec::None),
        written(&grids[1..2], Encoding::FpN { max_error: 20.0 }, Codec::None),
        written(&grids[2..], Encoding::Fp8, Codec::Zip),
        written(&bools, Encoding::Full, Codec::None),
        bare_grid(&bools[0], 0, 1),
    ];
    let read_all = |bytes: &[u8]| match nano::File::open_with(bytes, limits).and_then(|file| file.read_all())
    {
        Ok(grids) => {
            for grid in grids {
                grid.tree.statistics();
                grid.transform.voxel_size();
            }
            true
        }
        Err(Error::Malformed { .. } | Error::Unsupported { .. } | Error::Limit { .. }) => false,
        Err(error) => panic!("{error:?}"),
    };
    let mut random = SplitMix(7);
    let mut read = 0;
    for bytes in &files {
        assert!(read_all(bytes));
        for len in (0..bytes.len()).filter(|len| *len < 2000 || len % 9973 == 0) {
            assert!(!read_all(&bytes[..len]), "cut after {len} of {}", bytes.len());
        }
        for round in 0..200 {
            let mut bytes = bytes.clone();
            // Headers and root, else anywhere.
            let reach = if round % 3 < 2 { bytes.len().min(1100) } else { bytes.len() };
            for _ in 0..1 + random.below(4) {
                let at = random.below(reach);
                bytes[at] = if random.below(2) == 0 { random.next() as u8 } else { 0xff };
            }
            read += usize::from(read_all(&bytes));
        }
    }
    assert!((50..950).contains(&read), "{read} of 1000 damaged files were read");
}

/// One root tile after the other that names the same nodes must not grow into more than the file holds.
#[test]
fn nodes_named_again_and_again_are_refused() {
    let mut builder = TreeBuilder::new(false, Shape::STANDARD);
    builder.leaf([0; 3], &[!0; 8], &[0; 8]);
    let mut bytes = written(
        &[Grid::new("", Transform::identity(), builder.build().unwrap())],
        Encoding::Full,
        Codec::None,
    );
    let grid = 16 + 176 + 1;
    let upper = grid + 672 + 64 + 64 + 32;
    let lower = upper + 270_400;
    let leaf = lower + 33_856;
    assert_eq!(bytes.len(), leaf + 160);
    // All slots of the lower node are children: the one leaf.
    bytes[lower + 32 + 512..lower + 32 + 1024].fill(0xff);
    for slot in 0..4096 {
        let at = lower + 1088 + 8 * slot;
        bytes[at..at + 8].copy_from_slice(&(leaf as i64 - lower as i64).to_le_bytes());
    }
    let error = nano::File::open(bytes).unwrap().read_grid(0).unwrap_err();
    assert!(matches!(&error, Error::Malformed { what, .. } if what.contains("share")), "{error}");
}

#[test]
fn other_types_and_versions_are_named() {
    let bytes = written(
        &[Grid::new("x", Transform::identity(), Tree::empty(1_i32, Shape::STANDARD))],
        Encoding::Full,
        Codec::None,
    );
    let mut points = bytes.clone();
    points[16 + 32..16 + 36].copy_from_slice(&20_u32.to_le_bytes());
    let file = nano::File::open(points).unwrap();
    assert_eq!((file.grids[0].value_type, file.grids[0].is_readable()), ("OnIndex", false));
    assert!(matches!(file.read_grid(0), Err(Error::Unsupported { feature }) if feature.contains("OnIndex")));
    for (version, name) in [([31, 9, 1], "31.9.1"), ([32, 2, 0], "32.2.0"), ([33, 0, 0], "33.0.0")] {
        let [major, minor, patch]: [u32; 3] = version;
        let mut other = bytes.clone();
        other[8..12].copy_from_slice(&(major << 21 | minor << 10 | patch).to_le_bytes());
        let error = nano::File::open(other).err().unwrap();
        assert!(matches!(&error, Error::Unsupported { feature } if feature.contains(name)), "{error}");
    }
    assert!(matches!(nano::File::open(&b"no NanoVDB file at all"[..]), Err(Error::Malformed { .. })));
}

/// A folder of its own for a test, removed at the end.
struct Folder(PathBuf);

impl Folder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("nuage-nano-{name}-{}", std::process::id()));
        std::fs::create_dir_all(&path).unwrap();
        Folder(path)
    }

    fn file(&self, name: &str) -> PathBuf {
        self.0.join(name)
    }
}

impl Drop for Folder {
    fn drop(&mut self) {
        // Nothing hangs on it, and a panic here would hide the one that may be under way.
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// Whether NanoVDB's tools are there; says so if not.
fn has_tools() -> bool {
    let tools = ["nanovdb_convert", "nanovdb_validate", "nanovdb_print"];
    let found = tools.iter().all(|tool| Command::new(tool).arg("--version").output().is_ok());
    if !found {
        testkit::left_out("openvdb", "libnanovdb-tools");
    }
    found
}

/// Runs a tool that must not complain. Gives what it prints.
fn run(tool: &str, options: &[&str], files: &[&Path]) -> String {
    let output = Command::new(tool).args(options).args(files).output().unwrap();
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{tool} {options:?} {files:?}: {text}{errors}");
    text
}

#[test]
fn files_of_nanovdb_are_read_as_the_vdb_files_they_come_from() {
    if !has_tools() {
        return;
    }
    let folder = Folder::new("read");
    let names = [
        "background_nonzero",
        "comp_random_none",
        "cross_zero",
        "empty_grid_background",
        "leaf_masks",
        "lower_tiles_only",
        "py10_mixed",
        "root_tiles_only",
        "single_voxel_corner",
        "single_voxel_far",
        "special_values",
        "tiles_levels",
    ];
    let encodings: [(&[&str], Option<u32>); 7] = [
        (&["-f"], None),
        (&["-f", "-z"], None),
        (&["-f", "-b", "--fp16"], Some(16)),
        (&["-f", "-b", "--fp8"], Some(8)),
        (&["-f", "--fp4"], Some(4)),
        (&["-f", "-b", "-c", "none", "-s", "none"], None),
        (&["-f", "--fpN", "-a", "0.01"], Some(16)),
    ];
    // All files at once, since starting the converter takes longer than what it does. Within a file it goes
    // by name.
    let files = names.map(|name| testkit::committed("data/edge").join(format!("{name}.vdb")));
    let wanted: Vec<Vec<Grid>> = files
        .iter()
        .map(|vdb| {
            let mut grids = File::open(std::fs::read(vdb).unwrap()).unwrap().read_all().unwrap();
            grids.sort_by(|a, b| a.name.cmp(&b.name));
            grids
        })
        .collect();
    let is_finite = |tree: &Tree<f32>| tree.leaves.values.iter().all(|value| value.is_finite());
    let has_leaves = |grid: &Grid| with_tree!(&*grid.tree, tree => !tree.leaves.is_empty());
    for (options, bits) in encodings {
        // The converter of that version trips over trees without leaves when the bits are its own choice.
        let is_taken = |grids: &[Grid]| !options.contains(&"--fpN") || grids.iter().all(has_leaves);
        let taken = || files.iter().zip(&wanted).filter(|(_, grids)| is_taken(grids));
        let nvdb = folder.file("x.nvdb");
        let mut paths: Vec<&Path> = taken().map(|(file, _)| &**file).collect();
        paths.push(&nvdb);
        run("nanovdb_convert", options, &paths);
        let got = read_back(std::fs::read(&nvdb).unwrap());
        let wanted: Vec<&Grid> = taken().flat_map(|(_, grids)| grids).collect();
        assert!(got.len() == wanted.len() && got.len() >= 8, "{options:?}: {} grids", got.len());
        for (got, want) in got.iter().zip(wanted) {
            let context = format!("{} {options:?}", want.name);
            assert_eq!((&got.name, got.grid_class()), (&want.name, want.grid_class()), "{context}");
            assert_same_transform(&got.transform, &want.transform, &context);
            match (bits, want.tree.as_float()) {
                (Some(_), Some(tree)) if !is_finite(tree) => {}
                (Some(bits), Some(_)) => {
                    let rounding = half_quantum(&want.tree, bits);
                    let least = if options.contains(&"--fpN") { 0.010_000_1 } else { 0.0 };
                    assert_close(&got.tree, &want.tree, |i| rounding(i).max(least), &context);
                }
                _ => assert_close(&got.tree, &want.tree, |_| 0.0, &context),
            }
        }
    }
}

fn of_name<'a>(grids: &'a [Grid], name: &str) -> &'a Grid {
    grids.iter().find(|grid| grid.name == name).expect(name)
}

#[test]
fn transforms_of_nanovdb_are_read_as_those_of_vdb_files() {
    if !has_tools() {
        return;
    }
    let folder = Folder::new("transforms");
    let vdb = testkit::committed("data/edge/transforms.vdb");
    let file = File::open(std::fs::read(&vdb).unwrap()).unwrap();
    let linear: Vec<_> = file.grids.iter().filter(|info| info.transform.matrix().is_some()).collect();
    assert!(linear.len() >= 8);
    for info in linear {
        let nvdb = folder.file("x.nvdb");
        run("nanovdb_convert", &["-f", "-g", &info.name], &[&vdb, &nvdb]);
        let got = read_back(std::fs::read(&nvdb).unwrap());
        assert_same_transform(&got[0].transform, &info.transform, &info.name);
    }
}

fn assert_same_transform(got: &Transform, want: &Transform, context: &str) {
    for index in [[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]] {
        for (a, b) in got.world_from_index(index).iter().zip(want.world_from_index(index)) {
            assert!((a - b).abs() <= 1e-12 * b.abs().max(1.0), "{context}: {got:?} for {want:?}");
        }
    }
}

#[test]
fn nanovdb_takes_what_we_write_and_finds_the_same_in_it() {
    if !has_tools() {
        return;
    }
    let folder = Folder::new("write");
    let (nvdb, vdb) = (folder.file("x.nvdb"), folder.file("x.vdb"));
    let back = || File::open(std::fs::read(&vdb).unwrap()).unwrap().read_all().unwrap();
    let encodings =
        [Encoding::Full, Encoding::Fp16, Encoding::Fp8, Encoding::Fp4, Encoding::FpN { max_error: 9.0 }];
    // The converter of that version loses its transposition of the matrix.
    let diagonal =
        [[0.5, 0.0, 0.0, 0.0], [0.0, -0.25, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0], [1.0, -2.0, 1e6, 1.0]];
    let mut grids: Vec<Grid> = (0..2).flat_map(random_grids).collect();
    for (i, grid) in grids.iter_mut().enumerate() {
        grid.transform = Transform::affine(diagonal);
        grid.name += &format!(" {i}");
    }
    grids[0].name = "long name ".repeat(30);
    for (i, encoding) in encodings.into_iter().enumerate() {
        let codec = if i % 2 == 0 { Codec::None } else { Codec::Zip };
        let context = format!("{encoding:?}");
        let bytes = written(&grids, encoding, codec);
        std::fs::write(&nvdb, &bytes).unwrap();
        let text = run("nanovdb_validate", &["-v"], &[&nvdb]);
        assert_eq!(text.matches("passed").count(), grids.len(), "{context}: {text}");
        let text = run("nanovdb_print", &["-l"], &[&nvdb]);
        assert!(text.contains(&grids[7].name), "{context}: {text}");
        run("nanovdb_convert", &["-f"], &[&nvdb, &vdb]);
        // What NanoVDB decodes is what we decode.
        let ours = read_back(bytes);
        let theirs = back();
        assert_eq!(theirs.len(), grids.len(), "{context}");
        for ours in &ours {
            let theirs = of_name(&theirs, &ours.name);
            let context = format!("{context} {}", ours.name);
            assert_eq!((&theirs.name, theirs.grid_class()), (&ours.name, ours.grid_class()), "{context}");
            assert_same_transform(&theirs.transform, &ours.transform, &context);
            assert_close(&theirs.tree, &ours.tree, |_| 0.0, &context);
        }
    }
}
