//! A set of small files that covers what changed between the versions of the format.

use super::{ACTIVE_MASK, SyntheticFile, SyntheticGrid, SyntheticLeaf, SyntheticMetadata, SyntheticTile};
use super::{SyntheticTransform, Value, ZIP};

/// Named files: each version ZIP-compressed and, where it can be, stored plainly; half floats, booleans,
/// vectors and integers around the versions that changed them; other tree configurations, shared trees,
/// streams, and transforms. OpenVDB 10.0.1 reads all of them as described, but for the types `half` and
/// `string`, which it does not know.
pub fn corpus() -> Vec<(String, SyntheticFile)> {
    let mut corpus = Vec::new();
    let mut add = |name: String, version, compression, grids| {
        corpus.push((name, file(version, compression, grids)));
    };
    for version in 213..=226 {
        // Below 220 there is ZIP only.
        let compressions = if version < 220 { &[("zip", ZIP)][..] } else { &[("zip", ZIP), ("none", 0)] };
        for (suffix, compression) in compressions {
            let mut grid = sample("density", "float", &[5, 4, 3]);
            grid.extra_buffers = u8::from(version % 2 == 0) * 2;
            add(format!("float_{version}_{suffix}"), version, *compression, vec![grid]);
        }
    }
    for version in [222, 224] {
        for (suffix, compression) in [("mask", ACTIVE_MASK), ("zipmask", ZIP | ACTIVE_MASK)] {
            let grids = vec![sample("density", "float", &[5, 4, 3])];
            add(format!("float_{version}_{suffix}"), version, compression, grids);
        }
    }
    for version in [213, 214, 219, 221, 222, 224] {
        let compression = if version == 221 { 0 } else { ZIP | ACTIVE_MASK };
        let mut grid = sample("density", "float", &[5, 4, 3]);
        (grid.half, grid.extra_buffers) = (true, 1);
        add(format!("half_float_{version}"), version, compression, vec![grid]);
    }
    for version in [213, 216, 217, 221, 222] {
        let mut grid = sample("inside", "bool", &[5, 4, 3]);
        grid.extra_buffers = 1;
        add(format!("bool_{version}"), version, ACTIVE_MASK, vec![grid]);
    }
    for version in [213, 215, 220, 223] {
        let mut vectors = sample("v", "vec3s", &[5, 4, 3]);
        vectors.half = version == 215;
        let integers = sample("id", "int32", &[5, 4, 3]);
        add(format!("vec3s_int32_{version}"), version, ZIP | ACTIVE_MASK, vec![vectors, integers]);
    }
    for logs in [&[3_u8, 3][..], &[4, 3], &[4, 4, 3, 2], &[5, 5, 3], &[3], &[2, 1, 1]] {
        for (version, compression) in [(214, 0), (224, ACTIVE_MASK)] {
            let grid = sample("density", "float", logs);
            add(format!("{}_{version}", grid.type_name()), version, compression, vec![grid]);
        }
    }
    for logs in [&[4_u8, 3][..], &[3]] {
        let grid = sample("inside", "bool", logs);
        add(format!("{}_224", grid.type_name()), 224, ZIP, vec![grid]);
    }
    for (version, half) in [(214, false), (221, true), (221, false), (222, true)] {
        let mut grid = only_children();
        grid.half = half;
        let name = format!("only_children_{version}{}", if half { "_half" } else { "" });
        add(name, version, ZIP | ACTIVE_MASK, vec![grid]);
    }
    for version in [216, 218, 221, 224] {
        let original = sample("original\u{1e}0", "float", &[5, 4, 3]);
        let mut shared = sample("shared", "float", &[5, 4, 3]);
        shared.instance_of = Some(original.name.clone());
        shared.transform = SyntheticTransform::Affine(SHEAR);
        let last = sample("last", "int64", &[5, 4, 3]);
        add(format!("instances_{version}"), version, ZIP, vec![original, shared, last]);
    }
    for version in [216, 218, 219, 220, 221] {
        for (name, transform) in [("affine", SyntheticTransform::Affine(SHEAR)), ("frustum", frustum())] {
            let mut grid = sample("density", "float", &[5, 4, 3]);
            (grid.tiles, grid.transform) = (Vec::new(), transform);
            add(format!("{name}_{version}"), version, ZIP, vec![grid]);
        }
    }
    let half = sample("halves", "half", &[5, 4, 3]);
    add("half_grid_225".into(), 225, ZIP | ACTIVE_MASK, vec![half]);
    let types = ["double", "int32", "int64", "vec3s", "vec3d", "vec3i", "bool", "mask", "float"];
    let mixed = |names: &[&'static str]| names.iter().map(|name| sample(name, name, &[5, 4, 3])).collect();
    add("types_224".into(), 224, ZIP | ACTIVE_MASK, mixed(&types));
    let mut with_text = types.to_vec();
    with_text.push("string");
    add("types_text_224".into(), 224, 0, mixed(&with_text));
    let mut streams = Vec::new();
    for (name, file) in &corpus {
        if ["types_224", "types_text_224", "instances_224", "bool_216", "float_219_zip"].contains(&&name[..])
        {
            streams.push((format!("stream_{name}"), SyntheticFile { has_offsets: false, ..file.clone() }));
        }
    }
    corpus.extend(streams);
    corpus
}

const SHEAR: [[f64; 4]; 4] =
    [[0.5, 0.125, 0.0, 0.0], [0.0, 0.25, -0.5, 0.0], [0.0625, 0.0, 1.5, 0.0], [-3.0, 4.0, 0.5, 1.0]];

fn frustum() -> SyntheticTransform {
    let camera = [[0.0, 0.0, -1.0, 0.0], [0.0, 1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [2.0, 3.0, -5.0, 1.0]];
    SyntheticTransform::Frustum {
        index_box: [[-8, 0, 4], [24, 16, 68]],
        taper: 0.25,
        depth: 1.5,
        near_width: 2.0,
        near_distance: 0.75,
        camera,
    }
}

/// The library that wrote a version, roughly; before 222 there was no public one.
fn file(version: u32, compression: u32, grids: Vec<SyntheticGrid>) -> SyntheticFile {
    let library = match version {
        ..222 => [0, 90],
        222 => [1, 1],
        223 => [3, 0],
        224 => [10, 0],
        _ => [13, 0],
    };
    let metadata = vec![SyntheticMetadata::text("creator", "nuage")];
    SyntheticFile { version, library, has_offsets: true, compression, metadata, grids }
}

/// The kinds of leaves that blocks treat differently.
const LEAF_KINDS: [fn(usize) -> (bool, Pick); 8] = [
    |slot| (slot % 3 == 0, if slot % 3 == 0 { Pick::Any(slot) } else { Pick::Background }),
    |slot| (true, Pick::Any(slot)),
    |_| (false, Pick::Background),
    |slot| (slot % 5 > 1, if slot % 5 > 1 { Pick::Any(slot) } else { Pick::Negative }),
    |slot| (slot % 2 == 0, [Pick::Any(slot), Pick::Background, Pick::Any(1), Pick::Negative][slot % 4]),
    |slot| (slot % 4 == 1, [Pick::Background, Pick::Any(slot), Pick::Negative, Pick::Background][slot % 4]),
    |slot| (slot % 4 == 1, [Pick::Any(2), Pick::Any(slot), Pick::Background, Pick::Any(2)][slot % 4]),
    |slot| (slot % 4 == 1, [Pick::Any(5), Pick::Any(slot), Pick::Any(9), Pick::Any(5)][slot % 4]),
];

/// Where a voxel's value comes from.
#[derive(Clone, Copy)]
enum Pick {
    Background,
    Negative,
    Any(usize),
}

/// A grid of eight leaves, active and inactive tiles at all depths, on both sides of zero.
fn sample(name: &str, value_type: &'static str, log2_root_to_leaf: &[u8]) -> SyntheticGrid {
    let background = value(value_type, Pick::Background);
    let mut grid = SyntheticGrid {
        name: name.into(),
        instance_of: None,
        value_type,
        half: false,
        log2_root_to_leaf: log2_root_to_leaf.into(),
        background,
        transform: SyntheticTransform::Scale { scale: [0.1, 0.1, 0.25], translation: [1.0, -2.0, 0.5] },
        metadata: vec![SyntheticMetadata::text("class", "unknown")],
        tiles: Vec::new(),
        leaves: Vec::new(),
        extra_buffers: 0,
    };
    let leaf_depth = grid.leaf_depth();
    let below_root = grid.log2_tile(0);
    let leaf_log2 = grid.log2_tile(leaf_depth - 1);
    for (index, kind) in LEAF_KINDS.into_iter().enumerate() {
        // Every second leaf lies on the far side of zero.
        let step = (index as i32 / 2 + 1) << leaf_log2;
        let origin = if index % 2 == 0 { [0, step, 0] } else { [-(1 << leaf_log2), 0, -step] };
        let (mask, picks): (Vec<_>, Vec<_>) = (0..1 << (3 * leaf_log2)).map(kind).unzip();
        let values = picks.into_iter().map(|pick| value(value_type, pick)).collect();
        grid.leaves.push(SyntheticLeaf { origin, mask, values });
    }
    // Away from the leaves, root tiles, and a chain of nodes in slot 0 with tiles in other slots.
    let one = 1 << below_root;
    for depth in 0..leaf_depth {
        let size = 1 << grid.log2_tile(depth);
        for (index, active) in [true, false, true].into_iter().enumerate() {
            let origin = if depth == 0 {
                [5 * one, -one, (index as i32 - 1) * one]
            } else {
                let last = (1 << grid.log2_tile(depth - 1)) - size;
                let [x, y, z] = [[last, 0, 0], [0, last, 0], [0, 0, size]][index];
                [3 * one + x, -one + y, z]
            };
            let value = value(value_type, Pick::Any(1 + index + 4 * depth));
            grid.tiles.push(SyntheticTile { depth, origin, value, active });
        }
    }
    if value_type == "mask" {
        grid.tiles.iter_mut().for_each(|tile| tile.value = vec![f64::from(u8::from(tile.active))]);
    }
    grid
}

/// A tree whose inner nodes below the root's children have a child in every slot.
fn only_children() -> SyntheticGrid {
    let mut grid = sample("full", "float", &[2, 1, 2]);
    grid.tiles.clear();
    let first = grid.leaves[0].clone();
    grid.leaves = (0..8)
        .map(|i| SyntheticLeaf { origin: [i >> 2, i >> 1 & 1, i & 1].map(|c| c * 4), ..first.clone() })
        .collect();
    grid
}

fn value(value_type: &str, pick: Pick) -> Value {
    // Thirds are rounded by every type of float; every number is within what half floats hold.
    let component = |axis: usize| match pick {
        Pick::Background => 1.5 + axis as f64,
        Pick::Negative => -1.5 - axis as f64,
        Pick::Any(seed) => ((seed * 7 + axis * 5 + 3) * 2_654_435_761 % 1009) as f64 / 3.0 - 150.0,
    };
    let whole = |axis: usize| component(axis).trunc();
    match value_type {
        "float" | "double" | "half" => vec![component(0)],
        "int32" => vec![whole(0)],
        "int64" => vec![whole(0) * 1e10],
        "bool" | "mask" => {
            vec![f64::from(u8::from(matches!(pick, Pick::Negative) || component(0) > 20.0))]
        }
        "vec3i" => (0..3).map(whole).collect(),
        "string" => match pick {
            Pick::Background => Vec::new(),
            _ => whole(0).to_string().bytes().map(f64::from).collect(),
        },
        _ => (0..3).map(component).collect(),
    }
}
