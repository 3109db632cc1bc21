//! The text that `nuage info` prints for people, and the spelling of numbers, sizes and names in it.

use std::io::{self, Write};
use std::path::Path;

use nuage_vdb::points::Attribute;
use nuage_vdb::{File, GridInfo, IndexBox, Map, Metadata, Shape, Statistics, Transform, format_g, nano};

use crate::info::{Contents, Decoded, Points};

/// Where the second column begins.
const LABEL_WIDTH: usize = 16;
/// Longer values of metadata are cut.
const MAX_METADATA_CHARS: usize = 500;

/// Prints what the header says of the file itself.
pub(crate) fn file<S>(out: &mut impl Write, path: &Path, size_bytes: u64, file: &File<S>) -> io::Result<()> {
    let [major, minor] = file.library_version;
    let count = match file.grids.len() {
        0 => "no grids".to_owned(),
        1 => "1 grid".to_owned(),
        n => format!("{n} grids"),
    };
    writeln!(out, "{}: {count}", one_line(&path.display().to_string()))?;
    row(out, "size", size(size_bytes))?;
    row(out, "file version", format!("{} (library {major}.{minor})", file.file_version))?;
    row(out, "uuid", one_line(&file.uuid))?;
    metadata(out, &file.metadata)
}

/// Prints a grid.
pub(crate) fn grid(out: &mut impl Write, info: &GridInfo, contents: &Contents) -> io::Result<()> {
    writeln!(out, "\n{}", one_line(&info.unique_name))?;
    row(out, "class", info.grid_class())?;
    let half = if info.save_float_as_half { ", saved as half floats" } else { "" };
    row(out, "type", format!("{}{half}", one_line(&info.grid_type)))?;
    let active_mask = if info.compression.active_mask() { " + active values only" } else { "" };
    row(out, "compression", format!("{}{active_mask}", info.compression.codec()))?;
    if let Some(owner) = &info.instance_of {
        row(out, "voxels", format!("shared with grid '{}'", one_line(owner)))?;
    }
    transform(out, &info.transform)?;
    match contents {
        Contents::Decoded(decoded) => {
            values(out, info.shape(), decoded)?;
            boxes(out, info, decoded.statistics.active_bbox, "")?;
            storage(out, decoded)?;
        }
        Contents::NotDecoded => {
            row(
                out,
                "values",
                format!("not shown: values of type {} are not read", one_line(info.value_type())),
            )?;
            boxes(out, info, info.file_bbox(), " (from the metadata)")?;
        }
        Contents::Damaged(error) => {
            row(out, "values", format!("cannot be read: {}", one_line(error)))?;
            boxes(out, info, info.file_bbox(), " (from the metadata)")?;
        }
    }
    metadata(out, &info.metadata)
}

fn points(out: &mut impl Write, points: &Points) -> io::Result<()> {
    let sets = match points.set_count {
        1 => String::new(),
        more => format!(" in {more} different sets, of which this is the first"),
    };
    row(out, "points", thousands(points.count))?;
    row(out, "attributes", format!("{}{sets}", thousands(points.set.attributes.len() as u64)))?;
    for Attribute { name, value_type, codec } in &points.set.attributes {
        writeln!(out, "    {}: {} ({})", one_line(name), one_line(value_type), one_line(codec))?;
    }
    if !points.set.groups.is_empty() {
        let names: Vec<String> = points.set.groups.iter().map(|group| one_line(&group.name)).collect();
        row(out, "groups", names.join(", "))?;
    }
    Ok(())
}

fn values(out: &mut impl Write, shape: Option<Shape>, decoded: &Decoded) -> io::Result<()> {
    if let Some(found) = &decoded.points {
        points(out, found)?;
    }
    let stats = &decoded.statistics;
    row(out, "background", vector_or_number(&decoded.background))?;
    match stats.min_max() {
        Some(ends) => {
            let ends: [Vec<f64>; 2] = [0, 1].map(|end| ends.iter().map(|range| range[end]).collect());
            row(
                out,
                "active values",
                format!("{} to {}", vector_or_number(&ends[0]), vector_or_number(&ends[1])),
            )?;
            let voxels = stats.active_voxels as f64;
            let means: Vec<f64> = stats.components.iter().map(|c| c.mean(voxels)).collect();
            let deviations: Vec<f64> =
                stats.components.iter().map(|c| c.standard_deviation(voxels)).collect();
            let (mean, deviation) = (vector_or_number(&means), vector_or_number(&deviations));
            row(out, "mean", format!("{mean}, standard deviation {deviation}"))?;
        }
        None => row(out, "active values", "none")?,
    }
    for (i, histogram) in decoded.histograms.iter().enumerate() {
        row(out, if i == 0 { "histogram" } else { "" }, bars(&histogram.counts))?;
    }
    if stats.nan_count > 0 {
        row(out, "NaN values", thousands(stats.nan_count))?;
    }
    row(out, "active voxels", thousands(stats.active_voxels))?;
    row(out, "active tiles", tiles(stats))?;
    row(out, "nodes", nodes(shape, stats))
}

fn storage(out: &mut impl Write, decoded: &Decoded) -> io::Result<()> {
    if let Some(bbox) = decoded.statistics.leaf_bbox {
        row(out, "leaf box", index_box(bbox))?;
    }
    row(out, "memory", format!("{} when read", size(decoded.memory_bytes)))?;
    if let Some(hashes) = &decoded.hashes {
        row(out, "topology hash", format!("{:016x}", hashes.topology))?;
        row(out, "value hash", format!("{:016x}", hashes.leaf_values))?;
    }
    Ok(())
}

/// Prints what there is to say of a NanoVDB file itself.
pub(crate) fn nano_file<S>(
    out: &mut impl Write,
    path: &Path,
    size_bytes: u64,
    file: &nano::File<S>,
) -> io::Result<()> {
    let count = match file.grids.len() {
        1 => "1 grid".to_owned(),
        n => format!("{n} grids"),
    };
    writeln!(out, "{}: {count}", one_line(&path.display().to_string()))?;
    row(out, "size", size(size_bytes))?;
    row(out, "format", "NanoVDB")
}

/// Prints a grid of a NanoVDB file.
pub(crate) fn nano_grid(out: &mut impl Write, info: &nano::GridInfo, contents: &Contents) -> io::Result<()> {
    writeln!(out, "\n{}", one_line(&info.name))?;
    row(out, "class", info.grid_class)?;
    let [major, minor, patch] = info.version;
    row(out, "type", format!("{} (NanoVDB {major}.{minor}.{patch})", info.value_type))?;
    row(out, "compression", format!("{:?}", info.codec).to_lowercase())?;
    row(out, "grid", size(info.size_bytes))?;
    row(out, "voxel size", vector(&info.voxel_size))?;
    match contents {
        Contents::Decoded(decoded) => values(out, Some(Shape::STANDARD), decoded)?,
        Contents::NotDecoded => {
            row(out, "values", format!("not shown: values of type {} are not read", info.value_type))?;
            row(out, "active voxels", thousands(info.active_voxels))?;
        }
        Contents::Damaged(error) => row(out, "values", format!("cannot be read: {}", one_line(error)))?,
    }
    row(out, "active box", info.active_bbox.map_or_else(|| "none".to_owned(), index_box))?;
    match contents {
        Contents::Decoded(decoded) => storage(out, decoded),
        _ => Ok(()),
    }
}

/// A number, or a vector in brackets.
fn vector_or_number(values: &[f64]) -> String {
    match values {
        [x] => number(*x),
        more => vector(more),
    }
}

/// Counts as a line of bars, as high as the logarithm of the count: the background of a smoke would hide the rest.
fn bars(counts: &[u64]) -> String {
    const BARS: [char; 9] = [' ', '▁', '▂', '▃', '▄', '▅', '▆', '▇', '█'];
    let height = |count: u64| (count as f64 + 1.0).log2();
    let highest = counts.iter().copied().map(height).fold(1.0, f64::max);
    let bar = |count: &u64| match count {
        0 => ' ',
        _ => BARS[((height(*count) / highest * 8.0).ceil() as usize).clamp(1, 8)],
    };
    format!("|{}| (heights are logarithms)", counts.iter().map(bar).collect::<String>())
}

fn tiles(stats: &Statistics) -> String {
    let inactive: u64 = stats.tiles_by_depth.iter().map(|count| count.inactive_not_background).sum();
    let by_depth: Vec<String> = stats
        .tiles_by_depth
        .iter()
        .enumerate()
        .filter(|(_, count)| count.active > 0)
        .map(|(depth, count)| format!("{} at depth {depth}", thousands(count.active)))
        .collect();
    let mut text = thousands(stats.active_tiles);
    if !by_depth.is_empty() {
        text = format!("{text} ({})", by_depth.join(", "));
    }
    match inactive {
        0 => text,
        _ => format!("{text}; {} inactive ones that differ from the background", thousands(inactive)),
    }
}

/// How many nodes there are of each width.
fn nodes(shape: Option<Shape>, stats: &Statistics) -> String {
    let widths = shape.map(|shape| shape.log2_root_to_leaf().to_vec()).unwrap_or_default();
    let mut counts = stats.node_counts_leaf_to_root.iter().rev();
    let root = counts.next().copied().unwrap_or_default();
    let mut texts = vec![format!("root {}", thousands(root))];
    for (i, (count, log2)) in counts.zip(&widths).enumerate() {
        let (width, count) = (1 << log2, thousands(*count));
        texts.push(match i + 1 == widths.len() {
            true => format!("leaves of {width}³ {count}"),
            false => format!("{width}³ {count}"),
        });
    }
    let dense = format!(
        "{} dense, {} without active voxels",
        thousands(stats.dense_leaves),
        thousands(stats.leaves_without_active)
    );
    format!("{} ({dense})", texts.join(", "))
}

fn boxes(out: &mut impl Write, info: &GridInfo, bbox: Option<IndexBox>, origin: &str) -> io::Result<()> {
    let Some(bbox) = bbox else {
        return row(out, "active box", "none");
    };
    row(out, "active box", format!("{}{origin}", index_box(bbox)))?;
    let [min, max] = world_box(&info.transform, bbox);
    row(out, "world box", format!("{} to {} (voxel centres)", vector(&min), vector(&max)))
}

/// The world box of the corners of a box. Linear maps and frusta are linear in each coordinate alone, so
/// nothing inside lies further out.
fn world_box(transform: &Transform, bbox: IndexBox) -> [[f64; 3]; 2] {
    let corners = (0..8).map(|corner: usize| {
        transform.world_from_index(std::array::from_fn(|axis| f64::from(bbox[corner >> axis & 1][axis])))
    });
    corners.fold([[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]], |[min, max], corner| {
        [
            std::array::from_fn(|axis| min[axis].min(corner[axis])),
            std::array::from_fn(|axis| max[axis].max(corner[axis])),
        ]
    })
}

fn transform(out: &mut impl Write, transform: &Transform) -> io::Result<()> {
    row(out, "transform", one_line(&transform.type_name))?;
    let [x, y, z] = transform.voxel_size();
    let voxel_size = if x == y && y == z { number(x) } else { vector(&[x, y, z]) };
    match &transform.map {
        Map::Linear(matrix) => {
            row(out, "voxel size", voxel_size)?;
            for (i, matrix_row) in matrix.iter().enumerate() {
                row(out, if i == 0 { "world from index" } else { "" }, vector(matrix_row))?;
            }
            Ok(())
        }
        Map::Frustum { index_box: [min, max], taper, depth, .. } => {
            row(out, "voxel size", format!("{voxel_size} (in the middle of the near face)"))?;
            let near_box = format!("{} to {}", vector(min), vector(max));
            row(out, "frustum", format!("{near_box}, taper {}, depth {}", number(*taper), number(*depth)))
        }
    }
}

fn metadata(out: &mut impl Write, metadata: &Metadata) -> io::Result<()> {
    if metadata.iter().len() > 0 {
        row(out, "metadata", "")?;
    }
    for (name, value) in metadata.iter() {
        let text = value.to_string();
        let shown: String = text.chars().take(MAX_METADATA_CHARS).collect();
        // Matrices and texts of several lines stay below each other.
        let name = one_line(name);
        let lines: Vec<String> = shown.lines().map(one_line).collect();
        let indent = format!("\n    {:1$}  ", "", name.chars().count());
        let cut = if shown.len() < text.len() { " … (--json shows all)" } else { "" };
        writeln!(out, "{}{cut}", format!("    {name}: {}", lines.join(&indent)).trim_end())?;
    }
    Ok(())
}

fn row(out: &mut impl Write, label: &str, value: impl AsRef<str>) -> io::Result<()> {
    writeln!(out, "{}", format!("  {label:LABEL_WIDTH$}  {}", value.as_ref()).trim_end())
}

fn index_box(bbox: IndexBox) -> String {
    let [min, max] = bbox;
    let [x, y, z]: [i64; 3] = std::array::from_fn(|i| i64::from(max[i]) - i64::from(min[i]) + 1);
    format!("{min:?} to {max:?}, {x} × {y} × {z} voxels")
}

pub(crate) fn number(x: f64) -> String {
    format_g(x, 6)
}

fn vector(values: &[f64]) -> String {
    let texts: Vec<String> = values.iter().map(|x| number(*x)).collect();
    format!("[{}]", texts.join(", "))
}

/// `1234567` as `1,234,567`.
pub(crate) fn thousands(n: u64) -> String {
    let digits = n.to_string();
    let groups: Vec<&str> =
        digits.as_bytes().rchunks(3).rev().filter_map(|group| std::str::from_utf8(group).ok()).collect();
    groups.join(",")
}

/// `694 KiB (710,376 bytes)`.
pub(crate) fn size(bytes: u64) -> String {
    let exact = format!("{} bytes", thousands(bytes));
    let unit = [("KiB", 1), ("MiB", 2), ("GiB", 3), ("TiB", 4)]
        .into_iter()
        .rfind(|(_, power)| bytes >> (10 * power) > 0);
    match unit {
        Some((unit, power)) => {
            format!("{} {unit} ({exact})", format_g(bytes as f64 / f64::exp2(10.0 * f64::from(power)), 3))
        }
        None => exact,
    }
}

/// The text on one line and without anything that could steer a terminal: control characters are spelled
/// out.
pub(crate) fn one_line(text: &str) -> String {
    let escaped = |c: char| if c.is_control() { c.escape_default().to_string() } else { c.to_string() };
    text.chars().map(escaped).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_grouped_in_threes() {
        for (n, text) in [(0, "0"), (999, "999"), (1000, "1,000"), (1234567, "1,234,567")] {
            assert_eq!(thousands(n), text);
        }
        assert_eq!(thousands(u64::MAX).replace(',', ""), u64::MAX.to_string());
    }

    #[test]
    fn sizes_take_the_largest_unit_that_fits() {
        assert_eq!(size(1023), "1,023 bytes");
        assert_eq!(size(710_376), "694 KiB (710,376 bytes)");
        assert_eq!(size(3 << 29), "1.5 GiB (1,610,612,736 bytes)");
        assert!(size(u64::MAX).contains("TiB"));
    }

    #[test]
    fn a_name_cannot_steer_the_terminal() {
        let shown = one_line("a\x1b[2Jb\nc\u{9b}é");
        assert!(!shown.chars().any(char::is_control) && shown.ends_with('é'), "{shown}");
    }
}
