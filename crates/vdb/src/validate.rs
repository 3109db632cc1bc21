//! What is wrong with a file, or odd about it.
//!
//! A file whose bytes break the format ends in an [`Error`] that says what and where; the first one, since little
//! of what follows can be trusted. What can be read is then held against what it says of itself and against what
//! its class of grid means. Nothing here repairs anything.

use std::fmt;

use crate::any::{AnyTree, Grid};
use crate::any_file::is_nano;
use crate::error::{Error, Result};
use crate::file::{self, File};
use crate::header::{self, GridInfo};
use crate::limits::{Budget, Limits};
use crate::metadata::Metadata;
use crate::nano;
use crate::source::{Reader, Source};
use crate::stats::{IndexBox, Statistics};
use crate::transform::{Map, Transform};
use crate::tree::Tree;
use crate::value::Value;
use crate::with_tree;

/// How bad a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Severity {
    /// Unusual, and allowed.
    Note,
    /// Likely a mistake of whoever wrote the file; it can be used.
    Warning,
    /// The file contradicts itself or cannot mean what it says.
    Error,
}

impl fmt::Display for Severity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Severity::Note => "note",
            Severity::Warning => "warning",
            Severity::Error => "error",
        })
    }
}

/// Something worth saying of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Finding {
    /// How bad it is.
    pub severity: Severity,
    /// The unique name of the grid that it is about, if it is about one.
    pub grid: Option<String>,
    /// What it is, in words.
    pub what: String,
}

/// What became known of a file all of whose grids can be read.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Report {
    /// The number of grids.
    pub grids: usize,
    /// The active voxels of all grids that were read.
    pub active_voxels: u64,
    /// What is wrong or odd, grid by grid, what concerns the file itself first.
    pub findings: Vec<Finding>,
}

impl Report {
    /// How many findings are this bad.
    pub fn count(&self, severity: Severity) -> usize {
        self.findings.iter().filter(|finding| finding.severity == severity).count()
    }

    /// Adds what there is to say of a grid that has been read.
    pub fn add(&mut self, unique_name: &str, grid: &Grid) {
        let statistics = grid.tree.statistics();
        self.active_voxels = self.active_voxels.saturating_add(statistics.active_voxels);
        self.findings.extend(check_grid(unique_name, grid, &statistics));
    }
}

/// Reads a `.vdb` or `.nvdb` file whole and says what is wrong with it.
///
/// # Errors
/// If the bytes break the format, a limit is passed or the source fails. The message names the grid.
pub fn validate<S: Source>(source: &S, limits: Limits) -> Result<Report> {
    if is_nano(source)? {
        return validate_nano(&nano::File::open_with(source, limits)?);
    }
    let file = File::open_with(source, limits)?;
    let mut report = Report { grids: file.grids.len(), ..Report::default() };
    report.findings = check_layout(source, &file, &limits)?;
    report.findings.extend(check_names(&file.grids));
    for (index, info) in file.grids.iter().enumerate() {
        let named = |error| in_grid(error, &info.unique_name);
        let mut say = |severity, what| {
            report.findings.push(Finding { severity, grid: Some(info.unique_name.clone()), what });
        };
        if !info.is_readable() {
            say(
                Severity::Warning,
                format!("its voxels were not looked at: grids of type '{}' are not read", info.grid_type),
            );
            continue;
        }
        check_header(info).into_iter().for_each(|(severity, what)| say(severity, what));
        // An instance has no tree of its own.
        if info.instance_of.is_none()
            && let Some(walked) = file::walk_tree(&file, info).map_err(named)?
        {
            if let Some((at, origin)) = walked.contrary_mask {
                let what = format!(
                    "the mask of the leaf at {origin:?} is not the same in the topology and before its values, \
                     at byte {at}"
                );
                say(Severity::Error, what);
            }
            let [_, grid_end] = info.tree_range;
            if walked.end < grid_end {
                let unused = grid_end - walked.end;
                say(
                    Severity::Warning,
                    format!("{unused} bytes behind its voxels, at byte {}, have no meaning", walked.end),
                );
            }
        }
        let grid = file.read_grid(index).map_err(named)?;
        report.add(&info.unique_name, &grid);
    }
    Ok(report)
}

fn validate_nano<S: Source>(file: &nano::File<S>) -> Result<Report> {
    let mut report = Report { grids: file.grids.len(), ..Report::default() };
    for (index, info) in file.grids.iter().enumerate() {
        if !info.is_readable() {
            report.findings.push(Finding {
                severity: Severity::Warning,
                grid: Some(info.name.clone()),
                what: format!(
                    "its voxels were not looked at: values of type '{}' are not read",
                    info.value_type
                ),
            });
            continue;
        }
        let grid = file.read_grid(index).map_err(|error| in_grid(error, &info.name))?;
        report.add(&info.name, &grid);
    }
    Ok(report)
}

/// The error with the name of the grid in its message.
fn in_grid(error: Error, unique_name: &str) -> Error {
    match error {
        Error::Malformed { what, offset } => {
            Error::Malformed { what: format!("grid '{unique_name}': {what}"), offset }
        }
        Error::Unsupported { feature } => {
            Error::Unsupported { feature: format!("grid '{unique_name}': {feature}") }
        }
        Error::Limit { what, needed_bytes, limit_bytes } => {
            Error::Limit { what: format!("grid '{unique_name}': {what}"), needed_bytes, limit_bytes }
        }
        other => other,
    }
}

/// Looks for bytes that belong to nothing.
fn check_layout<S: Source>(source: &S, file: &File<&S>, limits: &Limits) -> Result<Vec<Finding>> {
    let mut findings = Vec::new();
    let mut reader = Reader::new(source, 0, u64::MAX)?;
    let head = header::read_header(&mut reader, &mut Budget::new(limits))?;
    for info in &file.grids {
        let descriptor = header::read_descriptor(&mut reader, head.file_version)?;
        let after = reader.offset();
        if head.has_offsets && descriptor.grid_begin > after {
            findings.push(Finding {
                severity: Severity::Warning,
                grid: Some(info.unique_name.clone()),
                what: format!(
                    "{} bytes before it, at byte {after}, have no meaning",
                    descriptor.grid_begin - after
                ),
            });
        }
        reader.seek(info.tree_range[1]);
    }
    if reader.left() > 0 {
        let (unused, at) = (reader.left(), reader.offset());
        let what = format!("{unused} bytes behind the last grid, at byte {at}, have no meaning");
        findings.push(Finding { severity: Severity::Warning, grid: None, what });
    }
    Ok(findings)
}

/// Looks for grids that cannot be told apart.
fn check_names(grids: &[GridInfo]) -> Vec<Finding> {
    let is_again = |i: usize| grids[..i].iter().any(|grid| grid.unique_name == grids[i].unique_name);
    let again = (0..grids.len()).filter(|i| is_again(*i));
    again
        .map(|i| Finding {
            severity: Severity::Warning,
            grid: Some(grids[i].unique_name.clone()),
            what: "an earlier grid has the same name; asking for it by name gives that one".into(),
        })
        .collect()
}

/// Holds what the header of a grid says of it twice against each other.
fn check_header(info: &GridInfo) -> Vec<(Severity, String)> {
    let mut found = Vec::new();
    let half = info.save_float_as_half;
    if info.metadata.bool("is_saved_as_half_float").is_some_and(|stated| stated != half) {
        let [by_type, by_metadata] = if half { ["half", "full"] } else { ["full", "half"] };
        found.push((
            Severity::Warning,
            format!("its type says that values are in {by_type} width, its metadata that they are in {by_metadata}"),
        ));
    }
    if half && !matches!(info.value_type(), "float" | "double" | "half" | "vec3s" | "vec3d") {
        found.push((Severity::Note, format!("{} values are never saved as half floats", info.value_type())));
    }
    found
}

/// What there is to say of a grid that has been read, with its statistics.
fn check_grid(unique_name: &str, grid: &Grid, statistics: &Statistics) -> Vec<Finding> {
    let mut found = check_transform(&grid.transform);
    found.extend(check_metadata(&grid.metadata, statistics));
    found.extend(with_tree!(&*grid.tree, tree => check_finite(tree)));
    found.extend(check_class(grid, statistics));
    if statistics.leaves_without_active > 0 {
        let (count, of) = (statistics.leaves_without_active, statistics.node_counts_leaf_to_root[0]);
        found.push((Severity::Note, format!("{count} of {of} leaves have no active voxel")));
    }
    let named = |(severity, what)| Finding { severity, grid: Some(unique_name.to_owned()), what };
    found.into_iter().map(named).collect()
}

fn check_transform(transform: &Transform) -> Vec<(Severity, String)> {
    let mut found = Vec::new();
    let matrix = match &transform.map {
        Map::Linear(matrix) => matrix,
        Map::Frustum { linear, .. } => linear,
    };
    let middle = match &transform.map {
        Map::Linear(_) => [0.0; 3],
        Map::Frustum { index_box: [min, max], .. } => std::array::from_fn(|i| 0.5 * (min[i] + max[i])),
    };
    if !matrix.as_flattened().iter().all(|x| x.is_finite()) {
        found.push((Severity::Error, "its transform has numbers that are not finite".into()));
    } else if transform.index_from_world(transform.world_from_index(middle)).is_none() {
        let what = "its transform has no inverse: different voxels are at the same place";
        found.push((Severity::Error, what.into()));
    }
    if [matrix[0][3], matrix[1][3], matrix[2][3], matrix[3][3]] != [0.0, 0.0, 0.0, 1.0] {
        found.push((Severity::Warning, "the last column of its transform is not 0, 0, 0, 1".into()));
    }
    found
}

/// Holds what a writer noted of the voxels against the voxels.
fn check_metadata(metadata: &Metadata, statistics: &Statistics) -> Vec<(Severity, String)> {
    let mut found = Vec::new();
    let counted = statistics.active_voxels;
    let stated = metadata.get("file_voxel_count").filter(|value| value.type_name == "int64");
    let stated = stated.and_then(|value| Some(i64::from_le_bytes(value.bytes.as_slice().try_into().ok()?)));
    if let Some(stated) = stated.filter(|stated| u64::try_from(*stated) != Ok(counted)) {
        let what = format!("its metadata state {stated} active voxels, it has {counted}");
        found.push((Severity::Warning, what));
    }
    if let (Some(min), Some(max)) = (metadata.vec3i("file_bbox_min"), metadata.vec3i("file_bbox_max")) {
        let stated = (0..3).all(|i| min[i] <= max[i]).then_some([min, max]);
        if stated != statistics.active_bbox {
            let spelled = |bbox: Option<IndexBox>| match bbox {
                Some([min, max]) => format!("{min:?} to {max:?}"),
                None => "empty".to_owned(),
            };
            let [stated, real] = [stated, statistics.active_bbox].map(spelled);
            found.push((
                Severity::Warning,
                format!("its metadata state the active box {stated}, it is {real}"),
            ));
        }
    }
    if let Some(class) = metadata.string("class")
        && metadata.grid_class() != class
        && class != "unknown"
    {
        found.push((Severity::Warning, format!("its class '{class}' is none that OpenVDB knows")));
    }
    found
}

/// Looks for values that are no numbers, or infinite.
fn check_finite<V: Value>(tree: &Tree<V>) -> Vec<(Severity, String)> {
    let mut found = Vec::new();
    if !matches!(V::NAME, "float" | "double" | "half" | "vec3s" | "vec3d") {
        return found;
    }
    let is_finite = |value: V| (0..V::COMPONENTS).all(|i| value.component(i).is_finite());
    if !is_finite(tree.background) {
        found.push((Severity::Warning, "its background is NaN or infinite".into()));
    }
    let mut tiles = 0_u64;
    let mut voxels = 0_u64;
    let mut first = None;
    for tile in tree.root_tiles.iter().filter(|tile| tile.active && !is_finite(tile.value)) {
        tiles += 1;
        first.get_or_insert(tile.origin);
    }
    for (branching, node) in tree.inner_nodes() {
        for slot in node.value_mask.iter().filter(|slot| !node.child_mask.contains(*slot)) {
            if !is_finite(node.tiles.value(slot)) {
                tiles += 1;
                first.get_or_insert_with(|| branching.child_origin(node.origin, slot));
            }
        }
    }
    let log2 = tree.shape.leaf_log2();
    for (leaf, origin) in tree.leaves.origins.iter().enumerate() {
        let mask = tree.leaves.mask(leaf);
        for (i, word) in mask.iter().enumerate() {
            for offset in crate::mask::bits(*word).map(|bit| i * 64 + bit) {
                if is_finite(V::in_leaf(tree.leaves.stored(leaf), mask, offset)) {
                    continue;
                }
                voxels += 1;
                first.get_or_insert_with(|| {
                    let local = [2, 1, 0].map(|axis| (offset >> (log2 * axis)) as i32 & ((1 << log2) - 1));
                    std::array::from_fn(|axis| origin[axis].wrapping_add(local[axis]))
                });
            }
        }
    }
    if let Some(first) = first {
        let of_tiles = if tiles > 0 { format!(" and {tiles} active tiles") } else { String::new() };
        found.push((
            Severity::Warning,
            format!("{voxels} active voxels{of_tiles} are NaN or infinite, the first at {first:?}"),
        ));
    }
    found
}

/// Holds the values against what the class of the grid means.
fn check_class(grid: &Grid, statistics: &Statistics) -> Vec<(Severity, String)> {
    let mut found = Vec::new();
    let is_real = matches!(*grid.tree, AnyTree::Float(_) | AnyTree::Double(_) | AnyTree::Half(_));
    let range = statistics.min_max().and_then(|ranges| ranges.first().copied());
    match grid.grid_class() {
        "level set" if !is_real => {
            let what = format!("a level set of {} values", grid.tree.value_type());
            found.push((Severity::Warning, what));
        }
        "level set" => {
            let background = grid.tree.background().first().copied().unwrap_or_default();
            if background.is_nan() || background <= 0.0 {
                found.push((
                    Severity::Error,
                    format!("the background of a level set is {background}: outside, distances are positive"),
                ));
            } else if let Some([min, max]) = range {
                // Half floats have eleven bits, floats 24.
                let slack = if grid.save_float_as_half { 1e-3 } else { 1e-6 };
                let bound = background * (1.0 + slack);
                if min < -bound || max > bound {
                    found.push((
                        Severity::Warning,
                        format!(
                            "values of a level set from {min} to {max} pass its background ±{background}"
                        ),
                    ));
                }
            }
            if statistics.active_tiles > 0 {
                let what = format!("{} active tiles in a level set", statistics.active_tiles);
                found.push((Severity::Warning, what));
            }
        }
        "fog volume" if is_real => {
            let [min, max] = range.unwrap_or_default();
            if min < 0.0 {
                found.push((Severity::Warning, format!("a fog volume with negative values, down to {min}")));
            }
            if max > 1.0 {
                found.push((Severity::Note, format!("a fog volume with values above 1, up to {max}")));
            }
        }
        "staggered" if statistics.components.len() != 3 => {
            let what = format!("a staggered grid of {} values, not of vectors", grid.tree.value_type());
            found.push((Severity::Warning, what));
        }
        _ => {}
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metadata::MetaValue;
    use crate::tree::Shape;
    use crate::{LEAF_VOXELS, TreeBuilder, WriteOptions, write};

    fn grid(class: &str, background: f32, values: [f32; LEAF_VOXELS]) -> Grid {
        let mut builder = TreeBuilder::new(background, Shape::STANDARD);
        builder.leaf([-8, 0, 8], &[!0; 8], &values);
        let mut grid = Grid::new("g", Transform::uniform_scale(0.5), builder.build().unwrap());
        grid.metadata.insert("class", MetaValue::from_text(class));
        grid
    }

    fn found(grid: &Grid) -> Vec<(Severity, String)> {
        let mut report = Report::default();
        report.add("g", grid);
        report.findings.into_iter().map(|finding| (finding.severity, finding.what)).collect()
    }

    fn finds(grid: &Grid, severity: Severity, part: &str) {
        let all = found(grid);
        assert!(all.iter().any(|(s, what)| *s == severity && what.contains(part)), "{part}: {all:?}");
    }

    #[test]
    fn sound_grids_have_no_findings() {
        for class in ["level set", "fog volume", "unknown"] {
            assert_eq!(found(&grid(class, 3.0, [0.5; LEAF_VOXELS])), []);
        }
    }

    #[test]
    fn what_a_class_forbids_is_found() {
        let mut values = [0.5; LEAF_VOXELS];
        values[7] = -4.0;
        finds(&grid("level set", 3.0, values), Severity::Warning, "pass its background");
        finds(&grid("level set", 0.0, values), Severity::Error, "distances are positive");
        finds(&grid("fog volume", 0.0, values), Severity::Warning, "down to -4");
        finds(&grid("fog volume", 0.0, [2.0; LEAF_VOXELS]), Severity::Note, "up to 2");
        finds(&grid("staggered", 0.0, values), Severity::Warning, "not of vectors");
        finds(&grid("liquid", 0.0, values), Severity::Warning, "'liquid'");
    }

    #[test]
    fn values_that_are_no_numbers_are_counted_and_located() {
        let mut values = [0.5; LEAF_VOXELS];
        values[1 << 6 | 2 << 3 | 3] = f32::NAN;
        values[LEAF_VOXELS - 1] = f32::INFINITY;
        finds(
            &grid("unknown", 0.0, values),
            Severity::Warning,
            "2 active voxels are NaN or infinite, the first at [-7, 2, 11]",
        );
        finds(&grid("unknown", f32::NAN, values), Severity::Warning, "its background");
    }

    #[test]
    fn transforms_without_an_inverse_are_found() {
        let mut grid = grid("unknown", 0.0, [0.5; LEAF_VOXELS]);
        grid.transform = Transform::uniform_scale(0.0);
        finds(&grid, Severity::Error, "no inverse");
        grid.transform = Transform::uniform_scale(f64::NAN);
        finds(&grid, Severity::Error, "not finite");
    }

    /// A sound file of one grid.
    fn file() -> Vec<u8> {
        let mut bytes = Vec::new();
        let grid = grid("fog volume", 0.0, std::array::from_fn(|i| i as f32 / 512.0));
        let options = WriteOptions { compression: crate::Compression::NONE };
        write(&[grid], &Metadata::default(), &options, &mut bytes).unwrap();
        bytes
    }

    fn of_file(bytes: &[u8]) -> Vec<String> {
        let report = validate(&bytes, Limits::default()).unwrap();
        report.findings.into_iter().map(|finding| finding.what).collect()
    }

    #[test]
    fn a_file_is_held_against_what_it_says_of_itself() {
        let sound = file();
        assert_eq!(of_file(&sound), [""; 0]);

        let mut longer = sound.clone();
        longer.extend_from_slice(b"tail");
        assert_eq!(
            of_file(&longer),
            [format!("4 bytes behind the last grid, at byte {}, have no meaning", sound.len())]
        );

        // The last leaf ends with its mask and values, uncompressed.
        let mask_at = sound.len() - 4 * LEAF_VOXELS - 1 - 64;
        let mut contrary = sound.clone();
        contrary[mask_at] ^= 1;
        let all = of_file(&contrary);
        assert_eq!(all.len(), 1);
        assert!(all[0].contains("[-8, 0, 8]") && all[0].ends_with(&format!("at byte {mask_at}")), "{all:?}");

        let name = b"file_voxel_count";
        let count_at = sound.windows(name.len()).position(|w| w == name).unwrap() + name.len() + 4 + 5 + 4;
        let mut miscounted = sound.clone();
        miscounted[count_at] ^= 1;
        assert_eq!(of_file(&miscounted), ["its metadata state 513 active voxels, it has 512"]);
    }

    #[test]
    fn a_file_cut_short_is_one_error_with_an_offset() {
        let sound = file();
        for len in (0..sound.len()).step_by(7) {
            let error = validate(&&sound[..len], Limits::default()).unwrap_err();
            assert!(
                matches!(error, Error::Malformed { offset, .. } if offset <= len as u64),
                "{len}: {error}"
            );
        }
    }
}
