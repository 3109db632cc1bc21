//! `nuage info`: what is in VDB and NanoVDB files, grid by grid.
//!
//! This module goes through files and grids and keeps going past what is damaged; [`text`] and [`json`] say
//! how the findings look. Grids are read one after another, so memory holds one at a time.

use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use nuage_vdb::points::AttributeSet;
use nuage_vdb::{AnyFile, AnyTree, File, Histogram, Source, Statistics, nano};
use serde_json::Value;

use crate::error::{Failure, explain};
use crate::frames;
use crate::source::{DiskFile, Memory};
use crate::{json, text};

/// List the grids of VDB files: type, size, values, transform, metadata.
///
/// The values of each grid are read and summed up; of grids of a type that is not read the header alone is shown.
/// Boxes include both ends. Matrices apply to row vectors, so the last row is the translation.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The files to look into
    #[arg(value_name = "FILE", required = true)]
    files: Vec<PathBuf>,

    /// Print one JSON object per file, one per line
    ///
    /// NaN and infinities are the strings "nan", "inf" and "-inf". Text from the file is spelled byte by byte:
    /// each byte becomes the character of that number (0 to 255), whatever its encoding. What only the values
    /// of a grid could tell is null if they were not read; a file or grid that is damaged has a key "error".
    #[arg(long)]
    json: bool,

    /// Add a hash of each grid's topology and one of its values
    ///
    /// FNV-1a, 64 bits, over origin and active mask of every leaf and over the 512 values of every leaf.
    #[arg(long)]
    hash: bool,

    #[command(flatten)]
    memory: Memory,
}

/// How finely values are counted.
const HISTOGRAM_INTERVALS: usize = 32;

/// What became known of a grid's voxels.
pub(crate) enum Contents {
    /// All of this.
    Decoded(Box<Decoded>),
    /// Nothing: values of this type are not read.
    NotDecoded,
    /// Nothing, and this is why.
    Damaged(String),
}

/// A grid's voxels, summed up.
pub(crate) struct Decoded {
    /// Whether the values are true or false and no numbers.
    pub(crate) is_bool: bool,
    /// The numbers of the value of everything that is not stored.
    pub(crate) background: Vec<f64>,
    /// How the active values are distributed, per component; none where they are not finite.
    pub(crate) histograms: Vec<Histogram>,
    /// Counts, boxes and extremes.
    pub(crate) statistics: Statistics,
    /// Memory that the tree took, in bytes.
    pub(crate) memory_bytes: u64,
    /// If the grid is one of points.
    pub(crate) points: Option<Points>,
    /// If asked for.
    pub(crate) hashes: Option<Hashes>,
}

/// What is known of a grid's points.
pub(crate) struct Points {
    /// How many there are.
    pub(crate) count: u64,
    /// The attributes and groups of the first leaf, which almost always are those of all.
    pub(crate) set: AttributeSet,
    /// How many different sets there are.
    pub(crate) set_count: usize,
}

/// 64-bit FNV-1a hashes of a tree.
pub(crate) struct Hashes {
    /// Over the origins and active masks of the leaves.
    pub(crate) topology: u64,
    /// Over the values of the leaves.
    pub(crate) leaf_values: u64,
}

/// Prints what is in each file.
///
/// # Errors
/// If a file or a grid cannot be read, after the others have been printed.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let mut out = BufWriter::new(io::stdout().lock());
    let mut whole = true;
    for (i, path) in args.files.iter().enumerate() {
        match show_file(path, args, i > 0, &mut out) {
            Ok(complete) => whole &= complete,
            Err(failure @ Failure::File { .. }) => {
                whole = false;
                out.flush()?;
                failure.report();
            }
            Err(failure) => return Err(failure),
        }
    }
    out.flush()?;
    if whole { Ok(()) } else { Err(Failure::Reported) }
}

/// Prints one file. Whether all its grids that should be readable are.
fn show_file(path: &Path, args: &Args, after_another: bool, out: &mut impl Write) -> Result<bool, Failure> {
    if let (false, Some((packed, None))) = (args.json, frames::packed(path)) {
        if after_another {
            writeln!(out)?;
        }
        show_packed(&packed, out)?;
    }
    let opened = DiskFile::open(path);
    let disk = opened.or_else(|failure| failed(path, failure, args, out))?;
    let file = match disk.any(args.memory).or_else(|failure| failed(path, failure, args, out))? {
        AnyFile::Vdb(file) => file,
        AnyFile::Nano(file) => return show_nano(&disk, &file, args, after_another, out),
    };
    if !args.json {
        if after_another {
            writeln!(out)?;
        }
        text::file(out, path, disk.size(), &file)?;
    }
    let mut complete = true;
    let mut grids: Vec<Value> = Vec::new();
    for (index, info) in file.grids.iter().enumerate() {
        let contents = look_into(&file, index, args.hash);
        match args.json {
            true => grids.push(json::grid(info, &contents, args.hash)),
            false => text::grid(out, info, &contents)?,
        }
        if let Contents::Damaged(error) = &contents {
            complete = false;
            out.flush()?;
            Failure::file(path, format!("grid '{}': {error}", info.unique_name)).report();
        }
    }
    if args.json {
        writeln!(out, "{}", json::file(path, disk.size(), &file, grids))?;
    }
    Ok(complete)
}

/// Prints what a packed file holds besides the grids of its frames.
fn show_packed(path: &Path, out: &mut impl Write) -> Result<(), Failure> {
    let disk = DiskFile::open_plain(path)?;
    let asset = frames::open(path)?;
    let contents = asset.contents();
    let [first, last] =
        [0, contents.frames.len().saturating_sub(1)].map(|frame| frames::number(&asset, frame));
    let rate =
        contents.frame_rate.map_or(String::new(), |rate| format!(", {} per second", text::number(rate)));
    let memory = asset.memory_bytes();
    // All bricks, though none is loaded yet.
    let brick_words: u64 = asset.store().pages().iter().map(|page| u64::from(page.word_count)).sum();
    writeln!(
        out,
        "{}: packed, {} bytes",
        text::one_line(&path.display().to_string()),
        text::thousands(disk.size())
    )?;
    writeln!(out, "  frames      {} ({first} to {last}{rate})", contents.frames.len())?;
    writeln!(
        out,
        "  in memory   tree {}, bricks {}, shapes {} bytes",
        text::thousands(memory.trees as u64),
        text::thousands(4 * brick_words),
        text::thousands(memory.shapes as u64)
    )?;
    for channel in &contents.channels {
        let axis = channel.component.map_or("", |c| [".x", ".y", ".z"][usize::from(c.min(2))]);
        let unit = match channel.physical_unit.as_str() {
            "" => String::new(),
            unit => format!(" {}", text::one_line(unit)),
        };
        writeln!(
            out,
            "  channel     {}{axis} ({:?}), peak {}{unit}, largest error {}",
            text::one_line(&channel.name),
            channel.role,
            text::number(f64::from(channel.peak)),
            text::number(f64::from(channel.quality.max_error))
        )?;
    }
    writeln!(out, "  the first frame; {}#N is frame N:", text::one_line(&path.display().to_string()))?;
    Ok(())
}

/// Prints a NanoVDB file. Whether all its grids that should be readable are.
fn show_nano(
    disk: &DiskFile,
    file: &nano::File<&DiskFile>,
    args: &Args,
    after_another: bool,
    out: &mut impl Write,
) -> Result<bool, Failure> {
    if !args.json {
        if after_another {
            writeln!(out)?;
        }
        text::nano_file(out, disk.path(), disk.size(), file)?;
    }
    let mut complete = true;
    let mut grids: Vec<Value> = Vec::new();
    for (index, info) in file.grids.iter().enumerate() {
        let contents = match info.is_readable() {
            false => Contents::NotDecoded,
            true => match file.read_grid(index) {
                Ok(grid) => Contents::Decoded(Box::new(decoded(&grid.tree, args.hash))),
                Err(error) => Contents::Damaged(explain(&error)),
            },
        };
        match args.json {
            true => grids.push(json::nano_grid(info, &contents, args.hash)),
            false => text::nano_grid(out, info, &contents)?,
        }
        if let Contents::Damaged(error) = &contents {
            complete = false;
            out.flush()?;
            Failure::file(disk.path(), format!("grid '{}': {error}", info.name)).report();
        }
    }
    if args.json {
        writeln!(out, "{}", json::nano_file(disk.path(), disk.size(), grids))?;
    }
    Ok(complete)
}

/// Says in the JSON output too that a file could not be opened.
fn failed<T>(path: &Path, failure: Failure, args: &Args, out: &mut impl Write) -> Result<T, Failure> {
    if let (true, Failure::File { what, .. }) = (args.json, &failure) {
        writeln!(out, "{}", json::failed_file(path, what))?;
    }
    Err(failure)
}

fn look_into<S: Source>(file: &File<S>, index: usize, with_hashes: bool) -> Contents {
    if file.grids.get(index).is_none_or(|info| !info.is_readable()) {
        return Contents::NotDecoded;
    }
    match file.read_grid(index) {
        Ok(grid) => Contents::Decoded(Box::new(decoded(&grid.tree, with_hashes))),
        Err(error) => Contents::Damaged(explain(&error)),
    }
}

fn decoded(tree: &AnyTree, with_hashes: bool) -> Decoded {
    let statistics = tree.statistics();
    let ranges = statistics.min_max().unwrap_or_default();
    let finite = ranges.iter().enumerate().filter(|(_, [min, max])| min.is_finite() && max.is_finite());
    Decoded {
        is_bool: matches!(tree.value_type(), "bool" | "mask"),
        background: tree.background(),
        histograms: finite.map(|(i, range)| tree.histogram(i, *range, HISTOGRAM_INTERVALS)).collect(),
        memory_bytes: tree.memory_bytes(),
        points: match tree {
            AnyTree::Points(points) => points.attribute_sets.first().map(|set| Points {
                count: points.point_count(),
                set: set.clone(),
                set_count: points.attribute_sets.len(),
            }),
            _ => None,
        },
        hashes: with_hashes
            .then(|| Hashes { topology: tree.topology_hash(), leaf_values: tree.leaf_value_hash() }),
        statistics,
    }
}
