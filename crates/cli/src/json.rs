//! The JSON that `--json` prints: one object per file, one per probe.
//!
//! JSON knows neither NaN nor infinities, so they are the strings `"nan"`, `"inf"` and `"-inf"`. Strings of VDB
//! files are bytes in no stated encoding, so each byte becomes the character of that number: nothing is lost,
//! ASCII reads as it is.

use std::path::Path;

use nuage_vdb::points::Attribute;
use nuage_vdb::{
    ComponentStatistics, File, GridInfo, Histogram, IndexBox, MetaValue, Metadata, TileCount, Transform,
    Voxel, format_g, nano,
};
use serde_json::{Value, json};

use crate::info::Contents;

/// Where the transform of each grid is sampled, in index space.
const SAMPLES: [[f64; 3]; 6] = [
    [0.0, 0.0, 0.0],
    [1.0, 0.0, 0.0],
    [0.0, 1.0, 0.0],
    [0.0, 0.0, 1.0],
    [10.0, -20.0, 30.0],
    [0.5, 7.25, 12.125],
];

/// A file with its grids, as [`grid`] describes them.
pub(crate) fn file<S>(path: &Path, size_bytes: u64, file: &File<S>, grids: Vec<Value>) -> Value {
    let [major, minor] = file.library_version;
    json!({
        "file": base_name(path),
        "size": size_bytes,
        "file_version": file.file_version,
        "library_version": format!("{major}.{minor}"),
        "file_metadata": metadata(&file.metadata),
        "grids": grids,
    })
}

/// A file that could not be opened.
pub(crate) fn failed_file(path: &Path, error: &str) -> Value {
    json!({ "file": base_name(path), "error": error })
}

/// A grid. What its voxels would tell is null if they were not decoded; `error` says why if they should have
/// been.
pub(crate) fn grid(info: &GridInfo, contents: &Contents, with_hashes: bool) -> Value {
    let single_precision = matches!(info.value_type(), "float" | "vec3s");
    with_contents(header(info), info.file_bbox(), single_precision, contents, with_hashes)
}

/// A NanoVDB file with its grids, as [`nano_grid`] describes them.
pub(crate) fn nano_file(path: &Path, size_bytes: u64, grids: Vec<Value>) -> Value {
    json!({ "file": base_name(path), "size": size_bytes, "format": "NanoVDB", "grids": grids })
}

/// A grid of a NanoVDB file, as [`grid`] describes others.
pub(crate) fn nano_grid(info: &nano::GridInfo, contents: &Contents, with_hashes: bool) -> Value {
    let [major, minor, patch] = info.version;
    let header = json!({
        "name": text(info.name.as_bytes()),
        "value_type": info.value_type,
        "grid_class": info.grid_class,
        "version": format!("{major}.{minor}.{patch}"),
        "compression": format!("{:?}", info.codec).to_lowercase(),
        "size": info.size_bytes,
        "voxel_size": numbers(&info.voxel_size),
    });
    let single_precision = !matches!(info.value_type, "double" | "Vec3d" | "int32" | "int64");
    with_contents(header, info.active_bbox, single_precision, contents, with_hashes)
}

/// What is known of a grid's voxels, added to its header.
fn with_contents(
    header: Value,
    stated_bbox: Option<IndexBox>,
    single_precision: bool,
    contents: &Contents,
    with_hashes: bool,
) -> Value {
    let mut grid = header;
    let (decoded, error) = match contents {
        Contents::Decoded(decoded) => (Some(decoded), None),
        Contents::NotDecoded => (None, None),
        Contents::Damaged(error) => (None, Some(error)),
    };
    let stats = decoded.map(|decoded| &decoded.statistics);
    let per_component = |value: &dyn Fn(&ComponentStatistics) -> f64| {
        stats
            .filter(|s| s.min_max().is_some())
            .map_or(Value::Null, |s| components(&s.components.iter().map(value).collect::<Vec<f64>>(), false))
    };
    grid["background"] = decoded.map_or(Value::Null, |d| match d.is_bool {
        true => json!(d.background == [1.0]),
        false => components(&d.background, single_precision),
    });
    grid["active_voxels"] = json!(stats.map(|s| s.active_voxels));
    grid["active_tiles"] = json!(stats.map(|s| s.active_tiles));
    grid["active_leaf_voxels"] = json!(stats.map(|s| s.active_leaf_voxels));
    grid["tiles_by_depth"] = json!(stats.map(|s| tiles(&s.tiles_by_depth)));
    grid["node_counts_leaf_to_root"] = json!(stats.map(|s| s.node_counts_leaf_to_root.clone()));
    grid["leaf_count"] = json!(stats.map(|s| s.node_counts_leaf_to_root[0]));
    grid["active_bbox"] = json!(stats.map_or(stated_bbox, |s| s.active_bbox));
    grid["leaf_bbox"] = json!(stats.and_then(|s| s.leaf_bbox));
    grid["min"] = per_component(&|c| c.min);
    grid["max"] = per_component(&|c| c.max);
    grid["sum_active_voxels"] = per_component(&|c| c.sum);
    let voxels = stats.map_or(0, |s| s.active_voxels) as f64;
    grid["mean"] = per_component(&|c| c.mean(voxels));
    grid["standard_deviation"] = per_component(&|c| c.standard_deviation(voxels));
    grid["histogram"] = json!(decoded.map(|d| histograms(&d.histograms)));
    grid["memory_bytes"] = json!(decoded.map(|d| d.memory_bytes));
    grid["nan_count"] = json!(stats.map(|s| s.nan_count));
    if let Some(points) = decoded.and_then(|decoded| decoded.points.as_ref()) {
        let attribute = |a: &Attribute| {
            let [name, value_type, codec] = [&a.name, &a.value_type, &a.codec].map(|t| text(t.as_bytes()));
            json!({ "name": name, "type": value_type, "codec": codec })
        };
        grid["point_count"] = json!(points.count);
        grid["attributes"] = points.set.attributes.iter().map(attribute).collect();
        grid["groups"] = points.set.groups.iter().map(|group| text(group.name.as_bytes())).collect();
    }
    if with_hashes {
        let hashes = decoded.and_then(|decoded| decoded.hashes.as_ref());
        let hex = |hash: u64| format!("{hash:016x}");
        grid["fnv1a64_topology"] = json!(hashes.map(|h| hex(h.topology)));
        grid["fnv1a64_leaf_values"] = json!(hashes.map(|h| hex(h.leaf_values)));
    }
    if let Some(error) = error {
        grid["error"] = json!(error);
    }
    grid
}

/// What a grid says of one index coordinate.
pub(crate) fn probe<V: nuage_vdb::Value>(ijk: [i32; 3], voxel: Voxel<V>) -> Value {
    json!({ "ijk": ijk, "v": exact(voxel.value), "on": voxel.active, "depth": voxel.depth })
}

/// A value of any type, so that nothing of it is lost.
pub(crate) fn exact<V: nuage_vdb::Value>(value: V) -> Value {
    match V::NAME {
        "bool" | "mask" => json!(value.component(0) != 0.0),
        // Not every one is a double.
        "int64" => {
            let mut bytes = Vec::new();
            value.append_to(&mut bytes);
            json!(bytes.try_into().map(i64::from_le_bytes).ok())
        }
        name => {
            let numbers: Vec<f64> = (0..V::COMPONENTS).map(|i| value.component(i)).collect();
            components(&numbers, matches!(name, "float" | "vec3s"))
        }
    }
}

/// A number, or three of a vector.
fn components(values: &[f64], single_precision: bool) -> Value {
    let one = |x: &f64| if single_precision { single(*x as f32) } else { number(*x) };
    match values {
        [x] => one(x),
        more => more.iter().map(one).collect(),
    }
}

fn tiles(by_depth: &[TileCount]) -> Value {
    let entry = |(depth, count): (usize, &TileCount)| {
        let TileCount { active, inactive_not_background } = count;
        (depth.to_string(), json!({ "active": active, "inactive_not_background": inactive_not_background }))
    };
    let some = by_depth.iter().enumerate().filter(|(_, count)| **count != TileCount::default());
    Value::Object(some.map(entry).collect())
}

fn histograms(all: &[Histogram]) -> Value {
    let one = |h: &Histogram| json!({ "range": numbers(&h.range), "counts": h.counts });
    match all {
        [histogram] => one(histogram),
        more => more.iter().map(one).collect(),
    }
}

fn header(info: &GridInfo) -> Value {
    let creator = info.metadata.get("creator").filter(|value| value.type_name == "string");
    json!({
        "name": text(info.name.as_bytes()),
        "unique_name": text(info.unique_name.as_bytes()),
        "grid_type": text(info.grid_type.as_bytes()),
        "value_type": text(info.value_type().as_bytes()),
        "grid_class": info.grid_class(),
        "vector_type": info.metadata.vector_type(),
        "creator": creator.map_or_else(String::new, |value| text(&value.bytes)),
        "save_float_as_half": info.save_float_as_half,
        "in_world_space": !info.metadata.bool("is_local_space").unwrap_or(false),
        "transform": transform(&info.transform),
        "metadata": metadata(&info.metadata),
    })
}

fn transform(transform: &Transform) -> Value {
    let samples = SAMPLES.map(|index| [numbers(&index), numbers(&transform.world_from_index(index))]);
    let mut object = json!({
        "type": text(transform.type_name.as_bytes()),
        "linear": transform.matrix().is_some(),
        "voxel_size": numbers(&transform.voxel_size()),
    });
    if let Some(matrix) = transform.matrix() {
        object["mat4_row_vector"] = numbers(matrix.as_flattened());
    }
    object["index_to_world"] = json!(samples);
    object
}

fn metadata(metadata: &Metadata) -> Value {
    let entry = |(name, value): (&str, &MetaValue)| {
        let spelled = text(&value.text_bytes());
        (text(name.as_bytes()), json!({ "type": text(value.type_name.as_bytes()), "str": spelled }))
    };
    Value::Object(metadata.iter().map(entry).collect())
}

fn base_name(path: &Path) -> String {
    text(path.file_name().unwrap_or(path.as_os_str()).as_encoded_bytes())
}

/// The characters of the numbers of the bytes.
pub(crate) fn text(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| char::from(*byte)).collect()
}

fn numbers(values: &[f64]) -> Value {
    values.iter().map(|value| number(*value)).collect()
}

/// A number that parses back to exactly `x`; whole ones without a decimal point.
pub(crate) fn number(x: f64) -> Value {
    const EXACT_INTEGERS: f64 = (1u64 << 53) as f64;
    if x.is_nan() {
        json!("nan")
    } else if x.is_infinite() {
        json!(if x > 0.0 { "inf" } else { "-inf" })
    } else if x.fract() == 0.0 && x.abs() < EXACT_INTEGERS && !(x == 0.0 && x.is_sign_negative()) {
        json!(x as i64)
    } else {
        json!(x)
    }
}

/// A single-precision number in nine digits, which tell all of them apart.
fn single(x: f32) -> Value {
    number(format_g(x.into(), 9).parse().unwrap_or_else(|_| x.into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_number_parses_back_to_itself() {
        for bits in (0..=u32::MAX).step_by(99_991) {
            let x = f32::from_bits(bits);
            if x.is_finite() {
                let text = single(x).to_string();
                assert_eq!((text.parse::<f64>().unwrap() as f32).to_bits(), bits, "{text}");
                let text = number(x.into()).to_string();
                assert_eq!(text.parse::<f64>().unwrap().to_bits(), f64::from(x).to_bits(), "{text}");
            }
        }
        assert_eq!(number(f64::NAN), "nan");
        assert_eq!([number(f64::INFINITY), number(f64::NEG_INFINITY)], ["inf", "-inf"]);
        assert_eq!(json!([number(-3.0), number(0.0), number(-0.0)]).to_string(), "[-3,0,-0.0]");
    }

    #[test]
    fn bytes_become_the_characters_of_their_numbers() {
        assert_eq!(text(b"a\xc3\xa9\n"), "a\u{c3}\u{a9}\n");
    }
}
