//! `nuage diff`: what differs between two files, or two sequences frame by frame.
//!
//! What is compared, and what counts, lives in [`nuage_vdb::diff`]; here frames are paired and opened one pair at a time,
//! and their grids go through it. How the outcome reads is in `report`, pictures of it in `picture`.

mod picture;
mod report;

use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use nuage_pipeline::sequence::{FrameFile, FrameRange};
use nuage_vdb::diff::{self, Disagreement, GridDifference, Options, VoxelDifference};
use nuage_vdb::{AnyFile, AnyTree, Grid, with_tree};
use serde_json::{Value, json};

use crate::convert::check_absent;
use crate::error::Failure;
use crate::frames;
use crate::json::exact;
use crate::look::Look;
use crate::probe::spelled;
use crate::progress;
use crate::source::{DiskFile, Memory};
use crate::values::Auto;

/// Say what differs between two files or sequences, VDB, NanoVDB or packed: grids, types, transforms, metadata, voxels.
///
/// Frames of sequences (smoke.####.vdb, a folder, all of smoke.nuage) are paired by their number; against one file, or
/// smoke.nuage#7, only its frame is compared. Grids are paired by name. Voxels are compared as look-ups see them: a tile
/// equals voxels of the same value. Values of different types are compared as numbers. Mean, RMS and PSNR are taken over
/// the voxels of A that differ from its background; PSNR is 10·log10(peak²/MSE), the peak the largest absolute value of
/// A over all frames. The largest error is that over all voxels, fog that where A is background. Lines marked (note) do
/// not count and are left out of sequences: how values are saved, the kind of a transform that does the same, and metadata that writers note anew
/// (file_*). Exit codes: 0 equal, 1 different or not readable.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The first file or sequence: the reference
    a: PathBuf,

    /// The second file or sequence
    b: PathBuf,

    /// Frames to compare, as in 1-100, 1-100x2 or 5,10-20; negative numbers too
    #[arg(long, value_name = "RANGE", allow_hyphen_values = true)]
    frames: Option<FrameRange>,

    /// Compare only the grid of this name
    #[arg(long, value_name = "NAME")]
    grid: Option<String>,

    /// Take values as equal that are no further apart than this
    #[arg(long, value_name = "X", value_parser = tolerance, default_value = "0")]
    tolerance: f64,

    /// Take numbers of transforms as equal that are no further apart than this
    #[arg(long, value_name = "X", value_parser = tolerance, default_value = "0")]
    transform_tolerance: f64,

    /// Let voxels that are inactive in both files, and backgrounds, have any value
    #[arg(long)]
    active_only: bool,

    /// Let values and active states alone count, not types, transforms and metadata
    #[arg(long)]
    values_only: bool,

    /// How many differing voxels to list per grid [default: 5, of sequences none]
    #[arg(long, value_name = "N")]
    list: Option<usize>,

    /// Print one JSON object instead of lines
    #[arg(long)]
    json: bool,

    /// Write a picture: A, B and their difference side by side, in the same view and light
    #[arg(long, value_name = "OUT.png")]
    picture: Option<PathBuf>,

    /// The frame of the picture [default: the one of the least PSNR]
    #[arg(long, value_name = "N", requires = "picture", allow_hyphen_values = true)]
    frame: Option<i64>,

    /// By what the difference is multiplied in the picture; auto makes its brightest pixel nearly white
    #[arg(long, value_name = "FACTOR|auto", requires = "picture", default_value = "auto")]
    amplify: Auto,

    /// Replace a picture that is there
    #[arg(long, requires = "picture")]
    force: bool,

    #[command(flatten)]
    memory: Memory,

    #[command(flatten)]
    look: Look,
}

fn tolerance(text: &str) -> Result<f64, String> {
    let x: f64 = text.parse().map_err(|_| "this is no number".to_owned())?;
    if x >= 0.0 { Ok(x) } else { Err("a tolerance is 0 or above".into()) }
}

/// A pair of grids of one name, and how they differ.
struct Compared {
    name: String,
    equal: bool,
    difference: GridDifference,
    /// How many numbers a value of the first one has.
    components: usize,
    is_level_set: bool,
    /// The first differing voxels: coordinate, then value and state in A and in B.
    voxels: Vec<[String; 3]>,
    voxels_json: Vec<Value>,
}

/// A pair of files, or of frames, and how they differ.
struct ComparedFiles {
    equal: bool,
    /// Grids that one side alone has.
    only: [Vec<String>; 2],
    of_files: Vec<Disagreement>,
    grids: Vec<Compared>,
}

/// Two frames that are compared.
struct Pair {
    number: Option<i64>,
    files: [PathBuf; 2],
}

/// The frames of both sides.
struct Frames {
    both: Vec<Pair>,
    /// The numbers of frames that one side alone has.
    only: [Vec<i64>; 2],
}

impl Frames {
    fn is_sequence(&self) -> bool {
        self.both.len() != 1 || self.only.iter().any(|only| !only.is_empty())
    }
}

/// The errors of the grids of one name over all frames.
struct Total {
    name: String,
    components: usize,
    is_level_set: bool,
    voxels: VoxelDifference,
    /// The frame of the largest error.
    worst: Option<i64>,
}

/// Prints what differs.
///
/// # Errors
/// If something does, or a file cannot be read.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    if let Some(picture) = &args.picture {
        picture::check_name(picture)?;
        check_absent(picture, args.force)?;
    }
    let frames = pair_frames(args)?;
    let is_sequence = frames.is_sequence();
    if let Some(wanted) = args.frame
        && !frames.both.iter().any(|pair| pair.number == Some(wanted))
    {
        return Err(Failure::Usage(format!("--frame: frame {wanted} is none of those compared")));
    }
    let listed = args.list.unwrap_or(if is_sequence { 0 } else { 5 });
    let bar = progress::bar(if is_sequence { frames.both.len() } else { 0 });
    let mut compared = Vec::with_capacity(frames.both.len());
    for (i, pair) in frames.both.iter().enumerate() {
        compared.push(compare_files(pair, args, listed)?);
        progress::show(&bar, i, 1, 1);
    }
    bar.finish_and_clear();
    let totals = totals(&frames, &mut compared);
    let equal = frames.only.iter().all(Vec::is_empty) && compared.iter().all(|files| files.equal);
    let picture = match &args.picture {
        Some(path) => Some(picture::write(path, worst(args, &frames, &compared), args)?),
        None => None,
    };

    let mut out = BufWriter::new(io::stdout().lock());
    if args.json {
        let mut object = match (is_sequence, compared.as_slice()) {
            (false, [files]) => report::files_json(files),
            _ => report::sequence_json(&frames, &compared, &totals),
        };
        object["equal"] = json!(equal);
        if let Some(picture) = picture {
            object["picture"] = picture.json();
        }
        writeln!(out, "{object}")?;
    } else {
        match (is_sequence, compared.as_slice()) {
            (false, [files]) => report::print_files(&mut out, files, args, true)?,
            _ => report::print_sequence(&mut out, &frames, &compared, &totals, args)?,
        }
        if let Some(picture) = picture {
            picture.print(&mut out)?;
        }
        writeln!(out, "{}", if equal { "equal" } else { "different" })?;
    }
    out.flush()?;
    if equal { Ok(()) } else { Err(Failure::Reported) }
}

/// Which frames are compared with which. Two single frames are a pair whatever their numbers.
fn pair_frames(args: &Args) -> Result<Frames, Failure> {
    let a = frames::find(&args.a, args.frames.as_ref())?;
    let b = frames::find(&args.b, args.frames.as_ref())?;
    let pair =
        |number, a: &FrameFile, b: &FrameFile| Pair { number, files: [a.path.clone(), b.path.clone()] };
    let none = [Vec::new(), Vec::new()];
    match (a.as_slice(), b.as_slice()) {
        ([one], [other]) => {
            Ok(Frames { both: vec![pair(one.frame.or(other.frame), one, other)], only: none })
        }
        ([one], many) => {
            let other = frame_like(one, many, &args.a, &args.b)?;
            Ok(Frames { both: vec![pair(one.frame, one, other)], only: none })
        }
        (many, [other]) => {
            let one = frame_like(other, many, &args.b, &args.a)?;
            Ok(Frames { both: vec![pair(other.frame, one, other)], only: none })
        }
        (a, b) => {
            let find = |in_frames: &[FrameFile], number: Option<i64>| {
                in_frames.binary_search_by_key(&number, |frame| frame.frame).ok()
            };
            let (mut both, mut only) = (Vec::new(), none);
            for frame in a {
                match find(b, frame.frame) {
                    Some(i) => both.push(pair(frame.frame, frame, &b[i])),
                    None => only[0].extend(frame.frame),
                }
            }
            only[1] =
                b.iter().filter(|frame| find(a, frame.frame).is_none()).filter_map(|f| f.frame).collect();
            if both.is_empty() {
                return Err(Failure::file(&args.b, "none of its frames has a number of those of the other"));
            }
            Ok(Frames { both, only })
        }
    }
}

/// The frame of a sequence that has the number of a single one.
fn frame_like<'f>(
    one: &FrameFile,
    many: &'f [FrameFile],
    one_path: &Path,
    many_path: &Path,
) -> Result<&'f FrameFile, Failure> {
    let Some(number) = one.frame else {
        let what = "this has no frame number: say which frame it is compared with, as in smoke.nuage#7";
        return Err(Failure::file(one_path, what));
    };
    let found = many.iter().find(|frame| frame.frame == Some(number));
    found.ok_or_else(|| Failure::file(many_path, format!("there is no frame {number}")))
}

/// The errors of each grid over all frames. Each frame's peak becomes that of all, so that their ratios can be
/// compared.
fn totals(frames: &Frames, compared: &mut [ComparedFiles]) -> Vec<Total> {
    let mut totals: Vec<Total> = Vec::new();
    for (pair, grid) in
        frames.both.iter().zip(&*compared).flat_map(|(p, f)| f.grids.iter().map(move |g| (p, g)))
    {
        let Some(voxels) = &grid.difference.voxels else { continue };
        let Some(total) = totals.iter_mut().find(|t| t.name == grid.name && t.components == grid.components)
        else {
            totals.push(Total {
                name: grid.name.clone(),
                components: grid.components,
                is_level_set: grid.is_level_set,
                voxels: voxels.clone(),
                worst: pair.number,
            });
            continue;
        };
        if voxels.errors().max > total.voxels.errors().max {
            total.worst = pair.number;
        }
        total.voxels.merge(voxels.clone(), 0);
    }
    for grid in compared.iter_mut().flat_map(|files| &mut files.grids) {
        let total = totals.iter().find(|t| t.name == grid.name && t.components == grid.components);
        if let (Some(total), Some(voxels)) = (total, &mut grid.difference.voxels) {
            for (errors, all) in voxels.components.iter_mut().zip(&total.voxels.components) {
                errors.peak = all.peak;
            }
        }
    }
    totals
}

/// The pair that a picture is made of: that asked for, else that of the least signal-to-noise ratio.
fn worst<'f>(args: &Args, frames: &'f Frames, compared: &[ComparedFiles]) -> &'f Pair {
    let ratio = |files: &ComparedFiles| {
        let grids = files.grids.iter().filter_map(|grid| grid.difference.voxels.as_ref());
        grids.map(|voxels| voxels.errors().psnr()).fold(f64::INFINITY, f64::min)
    };
    let asked = frames.both.iter().find(|pair| args.frame.is_some() && pair.number == args.frame);
    let least = || {
        let pairs = frames.both.iter().zip(compared);
        pairs.min_by(|(_, a), (_, b)| ratio(a).total_cmp(&ratio(b))).map(|(pair, _)| pair)
    };
    asked.or_else(least).unwrap_or(&frames.both[0])
}

fn compare_files(pair: &Pair, args: &Args, listed: usize) -> Result<ComparedFiles, Failure> {
    let disks = [DiskFile::open(&pair.files[0])?, DiskFile::open(&pair.files[1])?];
    let files = [disks[0].any(args.memory)?, disks[1].any(args.memory)?];
    let pairs = match &args.grid {
        None => diff::pair_names(&files[0].names(), &files[1].names()),
        Some(name) => {
            let found = [0, 1].map(|i| {
                let index = crate::grid::find_grid(&files[i], Some(name));
                index.map_err(|what| Failure::file(disks[i].path(), what))
            });
            let [a, b] = found;
            diff::Pairs { both: vec![[a?, b?]], ..Default::default() }
        }
    };
    let of_files = match args.grid {
        Some(_) => Vec::new(),
        None => diff::metadata(&files[0].metadata(), &files[1].metadata()),
    };
    let names = |file: &AnyFile<&DiskFile>, indices: &[usize]| -> Vec<String> {
        indices.iter().map(|i| file.names()[*i].to_owned()).collect()
    };
    let only = [names(&files[0], &pairs.only_a), names(&files[1], &pairs.only_b)];
    let mut grids = Vec::with_capacity(pairs.both.len());
    for [i, j] in pairs.both {
        let read = |side: usize, index: usize| {
            let named = |error| {
                let name = files[side].names()[index];
                Failure::file(disks[side].path(), format!("grid '{name}': {}", crate::error::explain(&error)))
            };
            files[side].read_grid(index).map_err(named)
        };
        grids.push(compare(files[0].names()[i], &read(0, i)?, &read(1, j)?, args, listed));
    }
    let equal = only.iter().all(Vec::is_empty)
        && (args.values_only || !of_files.iter().any(|d| d.counts))
        && grids.iter().all(|grid| grid.equal);
    Ok(ComparedFiles { equal, only, of_files, grids })
}

fn compare(name: &str, a: &Grid, b: &Grid, args: &Args, listed: usize) -> Compared {
    let options = Options {
        tolerance: args.tolerance,
        transform_tolerance: args.transform_tolerance,
        active_only: args.active_only,
        listed,
    };
    let difference = diff::grids(a, b, &options);
    let equal = if args.values_only { difference.has_equal_voxels() } else { difference.is_equal() };
    let first = difference.voxels.as_ref().map(|voxels| voxels.first.as_slice()).unwrap_or_default();
    let shown = |tree: &AnyTree, ijk: [i32; 3]| {
        with_tree!(tree, tree => {
            let voxel = tree.voxel(ijk);
            let state = if voxel.active { "active" } else { "inactive" };
            (format!("{} {state}", spelled(voxel.value)), json!({ "v": exact(voxel.value), "on": voxel.active }))
        })
    };
    let (mut voxels, mut voxels_json) = (Vec::new(), Vec::new());
    for ijk in first {
        let [(a, a_json), (b, b_json)] = [a, b].map(|grid| shown(&grid.tree, *ijk));
        voxels.push([format!("{ijk:?}"), a, b]);
        voxels_json.push(json!({ "ijk": ijk, "a": a_json, "b": b_json }));
    }
    Compared {
        name: name.to_owned(),
        equal,
        difference,
        components: a.tree.background().len(),
        is_level_set: a.grid_class() == "level set",
        voxels,
        voxels_json,
    }
}
