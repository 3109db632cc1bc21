//! `nuage convert --verify`: whether a file that was written is what it is said to be.
//!
//! A file is read again from disk before it gets its name, and held against its sources, read anew. What counts as a
//! difference is [`nuage_vdb::diff`]'s; converting does not live here.

use std::fs;
use std::path::Path;

use half::f16;
use nuage_pipeline::pack::assemble::Report;
use nuage_pipeline::pack::plan::channel_trees;
use nuage_pipeline::pack::unpack::unpack_frame;
use nuage_pipeline::sequence::FrameFile;
use nuage_vdb::diff::{self, Errors};
use nuage_vdb::{AnyFile, AnyTree, Grid, Metadata, nano};
use nuage_volume::format::{Asset, ChannelInfo, Role};

use crate::convert;
use crate::error::{Failure, explain};
use crate::frames;
use crate::source::{DiskFile, Memory};
use crate::text::{number, one_line};

/// How far a largest error may be from the reported one, as a part of the channel's peak: both are differences of
/// single-precision numbers.
const MAX_ROUNDING: f64 = 1e-6;

/// The same of a sum of squares, as a part of it: one adds in single precision brick by brick.
const SQUARED_ROUNDING: f64 = 1e-4;

/// The part of the peak by which empty voxels of packed files may be off, with its rounding.
const FOG: f64 = 1.001e-3;

/// What a failure of verifying reads like.
fn failed(output: &Path, what: impl std::fmt::Display) -> Failure {
    Failure::file(output, format!("verifying failed, so the file was not put in place: {what}"))
}

/// The file that was written, from its first byte on.
fn reopened(file: &fs::File, output: &Path) -> Result<DiskFile, Failure> {
    let handle = file.sync_all().and_then(|()| file.try_clone());
    DiskFile::of(output, handle.map_err(|error| failed(output, error))?)
}

/// Holds a packed file against its sources: every page, every frame, the errors that are reported, and those that were
/// asked for. Gives a line that says so.
///
/// # Errors
/// If anything is not as it should be: what, and where.
pub(crate) fn packed(
    file: &fs::File,
    output: &Path,
    frames: &[FrameFile],
    args: &convert::Args,
    report: &Report,
) -> Result<String, Failure> {
    let fail = |what: String| failed(output, what);
    let mut asset = Asset::open(reopened(file, output)?).map_err(|error| fail(error.to_string()))?;
    if *asset.contents() != report.contents {
        return Err(fail("its contents are not those that were written".into()));
    }
    let pages = asset.store().pages().len();
    for page in 0..pages {
        asset.read_page(page).map_err(|error| fail(format!("page {page}: {error}")))?;
    }
    let mut found = vec![Found::default(); asset.contents().channels.len()];
    for (i, frame) in frames.iter().enumerate() {
        let in_frame = |what: String| fail(format!("frame {}: {what}", frame.path.display()));
        frames::load_frame(&mut asset, i).map_err(|error| in_frame(error.to_string()))?;
        let (grids, metadata) = unpack_frame(&asset, i).map_err(|error| in_frame(error.to_string()))?;
        let (sources, source_metadata) = convert::load(args, &frame.path)?;
        let channels: Vec<usize> =
            asset.contents().frames[i].grids.iter().map(|grid| grid.channel as usize).collect();
        let next = asset.pages_of_frame(i + 1).unwrap_or_default();
        let done = asset.pages_of_frame(i).map_err(|error| in_frame(error.to_string()))?;
        if !grids.is_empty() && metadata != source_metadata {
            return Err(in_frame("the metadata of the file is not that of the source".into()));
        }
        compare_frame(&sources, &grids, &channels, &mut found).map_err(in_frame)?;
        done.into_iter().filter(|page| !next.contains(page)).for_each(|page| asset.drop_page(page));
    }
    for (channel, found) in asset.contents().channels.iter().zip(&found) {
        let axis = channel.component.map_or("", |c| [".x", ".y", ".z"][usize::from(c.min(2))]);
        found.check(channel).map_err(|what| fail(format!("channel {}{axis}: {what}", channel.name)))?;
    }
    let [pages, frames, channels] = [(pages, "page"), (frames.len(), "frame"), (found.len(), "channel")]
        .map(|(n, what)| counted(n, what));
    Ok(format!(
        "verified: {pages}, {frames}, {channels}; the errors are those reported and within what was asked"
    ))
}

fn counted(count: usize, what: &str) -> String {
    if count == 1 { format!("1 {what}") } else { format!("{count} {what}s") }
}

/// What a channel was found to be, over all frames.
#[derive(Debug, Clone, Copy, Default)]
struct Found {
    errors: Errors,
    /// Whether decoded values were rounded once more, to the half floats of their source.
    is_half: bool,
}

/// Adds the errors of a frame. `channels` are the indices of the channels of the packed frame, in order.
fn compare_frame(
    sources: &[Grid],
    grids: &[Grid],
    channels: &[usize],
    found: &mut [Found],
) -> Result<(), String> {
    let ((expected, _), (decoded, _)) = (channel_trees(sources), channel_trees(grids));
    if expected.len() != decoded.len() || decoded.len() != channels.len() {
        return Err(format!("{} channels came back of {}", decoded.len(), expected.len()));
    }
    let options = diff::Options { listed: 0, ..diff::Options::default() };
    for ((source, back), channel) in expected.into_iter().zip(decoded).zip(channels) {
        let (grid, name) = (&sources[source.grid], one_line(&source.key.grid));
        if source.key != back.key {
            return Err(format!("grid '{name}' came back as '{}'", one_line(&back.key.grid)));
        }
        if !diff::transforms(&grid.transform, &grids[back.grid].transform, 0.0).is_empty() {
            return Err(format!("grid '{name}': its transform is another"));
        }
        let is_half = matches!(&*grid.tree, AnyTree::Half(_));
        let difference =
            diff::trees(&source.tree.into_owned().into(), &back.tree.into_owned().into(), &options);
        let (Some(difference), Some(found)) = (difference, found.get_mut(*channel)) else {
            return Err(format!("grid '{name}' cannot be compared"));
        };
        if difference.not_finite > 0 {
            return Err(format!("grid '{name}': {} voxels are not finite", difference.not_finite));
        }
        found.errors.merge(&difference.errors());
        found.is_half |= is_half;
    }
    Ok(())
}

impl Found {
    /// Whether this is what the file says of a channel.
    fn check(&self, channel: &ChannelInfo) -> Result<(), String> {
        let (errors, quality, peak) = (&self.errors, channel.quality, f64::from(channel.peak));
        let place = errors.max_at.map_or(String::new(), |ijk| format!(" at {ijk:?}"));
        let slack = peak * if self.is_half { f64::from(f16::EPSILON) } else { MAX_ROUNDING };
        let reported = f64::from(quality.max_error);
        if (errors.max - reported).abs() > slack {
            let [found, reported] = [errors.max, reported].map(number);
            return Err(format!("the largest error is {found}{place}, and {reported} is reported"));
        }
        let squared = errors.squares + errors.background_squares;
        let slack_squared =
            SQUARED_ROUNDING * squared.max(quality.squared_error) + f64::from(f32::MIN_POSITIVE);
        if !self.is_half && (squared - quality.squared_error).abs() > slack_squared {
            let [found, reported] = [squared, quality.squared_error].map(number);
            return Err(format!("the squared errors sum up to {found}, and {reported} is reported"));
        }
        if let Some(asked) = channel.asked_max_error.map(f64::from)
            && errors.max > asked + slack
        {
            let [found, asked] = [errors.max, asked].map(number);
            return Err(format!("the largest error is {found}{place}, above the {asked} asked for"));
        }
        let psnr = quality.psnr(channel.peak);
        if let Some(asked) = channel.asked_psnr.filter(|asked| psnr + 1e-3 < *asked) {
            return Err(format!("{psnr:.2} dB are below the {asked} asked for"));
        }
        if let Some(ijk) = errors.fog_at.filter(|_| errors.fog > FOG * peak + slack) {
            return Err(format!("an empty voxel became {} at {ijk:?}", number(errors.fog)));
        }
        if channel.role == Role::SignedDistance && errors.sign_changes > 0 && !self.is_half {
            return Err(format!("{} voxels changed their sign", errors.sign_changes));
        }
        Ok(())
    }
}

/// Holds a .vdb file against its sources, which it has to equal, but for the rounding of grids saved as half floats.
///
/// # Errors
/// If it differs: what, and where.
pub(crate) fn vdb(
    file: &fs::File,
    output: &Path,
    sources: &[Grid],
    metadata: &Metadata,
    memory: Memory,
) -> Result<String, Failure> {
    let disk = reopened(file, output)?;
    let file = disk.any(memory)?;
    if let Some(wrong) = diff::metadata(metadata, &file.metadata()).iter().find(|d| d.counts) {
        return Err(failed(output, &wrong.what));
    }
    let grids = read_back(&file, output, sources)?;
    for (source, grid) in sources.iter().zip(&grids) {
        let expected = if source.save_float_as_half { &as_saved(source) } else { source };
        let difference = diff::grids(expected, grid, &diff::Options::default());
        if !difference.is_equal() {
            return Err(unequal(output, source, &difference));
        }
    }
    Ok(format!("verified: {} came back equal", counted(grids.len(), "grid")))
}

/// Holds a .nvdb file against its sources: values and states of all voxels, up to what the encoding may lose.
///
/// # Errors
/// If it differs: what, and where.
pub(crate) fn nano(
    file: &fs::File,
    output: &Path,
    sources: &[Grid],
    options: &nano::WriteOptions,
    memory: Memory,
) -> Result<String, Failure> {
    let disk = reopened(file, output)?;
    let file = disk.any(memory)?;
    let grids = read_back(&file, output, sources)?;
    let mut largest = 0.0_f64;
    for (source, grid) in sources.iter().zip(&grids) {
        // Only grids of floats are quantised.
        let is_quantised = matches!(&*source.tree, AnyTree::Float(_));
        let range = source.tree.statistics().min_max().and_then(|ranges| ranges.first().copied());
        // Inactive voxels beside active ones hold the background, in level sets of either sign.
        let beside = source.tree.background().first().map_or(0.0, |background| background.abs());
        let [low, high] = range.unwrap_or_default();
        let (low, high) = (low.min(-beside), high.max(beside));
        // A step of a leaf is no wider than one over the whole range.
        let step = |bits: i32| (high - low) / (2.0_f64.powi(bits) - 1.0);
        let tolerance = match options.encoding {
            nano::Encoding::Full => 0.0,
            _ if !is_quantised => 0.0,
            nano::Encoding::Fp4 => step(4),
            nano::Encoding::Fp8 => step(8),
            nano::Encoding::Fp16 => step(16),
            nano::Encoding::FpN { max_error } => f64::from(max_error) * (1.0 + 1e-6),
        };
        let options = diff::Options { tolerance, ..diff::Options::default() };
        let difference = diff::grids(source, grid, &options);
        if !difference.has_equal_voxels() {
            return Err(unequal(output, source, &difference));
        }
        largest = largest.max(difference.voxels.map_or(0.0, |voxels| voxels.errors().max));
    }
    let came_back = counted(grids.len(), "grid");
    Ok(match largest > 0.0 {
        true => format!("verified: {came_back} came back, with no error above {}", number(largest)),
        false => format!("verified: {came_back} came back equal"),
    })
}

/// All grids of a file that was written, as many as there should be.
fn read_back(file: &AnyFile<&DiskFile>, output: &Path, sources: &[Grid]) -> Result<Vec<Grid>, Failure> {
    let grids = file.read_all().map_err(|error| failed(output, explain(&error)))?;
    match grids.len() == sources.len() {
        true => Ok(grids),
        false => Err(failed(output, format!("it holds {} grids of {}", grids.len(), sources.len()))),
    }
}

/// What of a grid is not as it was.
fn unequal(output: &Path, source: &Grid, difference: &diff::GridDifference) -> Failure {
    let of_header = difference.disagreements.iter().find(|d| d.counts).map(|d| d.what.clone());
    let of_voxels = difference.voxels.as_ref().filter(|voxels| !voxels.is_equal()).map(|voxels| {
        let errors = voxels.errors();
        let place = errors.max_at.or(voxels.first.first().copied()).unwrap_or_default();
        format!("voxels differ, by at most {}, as at {place:?}", number(errors.max))
    });
    let what = of_voxels.or(of_header).unwrap_or_else(|| "its voxels cannot be compared".into());
    failed(output, format!("grid '{}': {what}", one_line(&source.name)))
}

/// The grid with its values rounded to half floats, as they stand in the file.
fn as_saved(grid: &Grid) -> Grid {
    let tree = match &*grid.tree {
        AnyTree::Float(tree) => tree.map(|value| f16::from_f32(value).to_f32()).into(),
        AnyTree::Double(tree) => tree.map(|value| f16::from_f64(value).to_f64()).into(),
        AnyTree::Vec3s(tree) => tree.map(|value| value.map(|x| f16::from_f32(x).to_f32())).into(),
        AnyTree::Vec3d(tree) => tree.map(|value| value.map(|x| f16::from_f64(x).to_f64())).into(),
        other => return Grid { tree: std::sync::Arc::new(other.clone()), ..grid.clone() },
    };
    Grid { tree: std::sync::Arc::new(tree), ..grid.clone() }
}
