//! `nuage diff`: what differs between two files.
//!
//! What is compared, and what counts, lives in [`nuage_vdb::diff`]; here files are opened, their grids go through it
//! pair by pair, and the outcome is put into lines and an exit code.

use std::io::{self, BufWriter, Write};
use std::path::PathBuf;

use nuage_vdb::diff::{self, Disagreement, GridDifference, Options, VoxelDifference};
use nuage_vdb::{AnyFile, AnyTree, Grid, with_tree};
use serde_json::{Value, json};

use crate::error::Failure;
use crate::json::{exact, number as json_number, text};
use crate::probe::spelled;
use crate::source::{DiskFile, Memory};
use crate::text::{number, one_line, thousands};

/// Say what differs between two files, VDB or NanoVDB: grids, types, transforms, metadata, voxels.
///
/// Grids are paired by name. Voxels are compared as look-ups see them: a tile equals voxels of the same value. Values
/// of different types are compared as numbers. Mean, RMS and PSNR are taken over the voxels of A that differ from its
/// background; PSNR is 10·log10(peak²/MSE), the peak their largest absolute value. The largest error is that over all
/// voxels. Lines marked (note) do not count: how values are saved, the kind of a transform that does the same, and
/// metadata that writers note anew (file_*). Exit codes: 0 equal, 1 different or not readable.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The first file
    a: PathBuf,

    /// The second file
    b: PathBuf,

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

    /// How many differing voxels to list per grid
    #[arg(long, value_name = "N", default_value_t = 5)]
    list: usize,

    /// Print one JSON object instead of lines
    #[arg(long)]
    json: bool,

    #[command(flatten)]
    memory: Memory,
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
    /// The first differing voxels: coordinate, then value and state in A and in B.
    voxels: Vec<[String; 3]>,
    voxels_json: Vec<Value>,
}

/// Prints what differs.
///
/// # Errors
/// If something does, or a file cannot be read.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let disks = [DiskFile::open(&args.a)?, DiskFile::open(&args.b)?];
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
    let mut equal = only.iter().all(Vec::is_empty);
    equal &= args.values_only || !of_files.iter().any(|d| d.counts);

    let mut out = BufWriter::new(io::stdout().lock());
    let mut all = Vec::new();
    if !args.json {
        for (side, names) in ["A", "B"].iter().zip(&only) {
            for name in names {
                writeln!(out, "{}: only in {side}", one_line(name))?;
            }
        }
        print_disagreements(&mut out, "the files", &of_files, args)?;
    }
    for [i, j] in pairs.both {
        let read = |side: usize, index: usize| {
            let named = |error| {
                let name = files[side].names()[index];
                Failure::file(disks[side].path(), format!("grid '{name}': {}", crate::error::explain(&error)))
            };
            files[side].read_grid(index).map_err(named)
        };
        let compared = compare(files[0].names()[i], &read(0, i)?, &read(1, j)?, args);
        equal &= compared.equal;
        match args.json {
            true => all.push(grid_json(&compared)),
            false => print(&mut out, &compared, args)?,
        }
    }
    if args.json {
        let [only_a, only_b] = only.map(|names| names.iter().map(|n| text(n.as_bytes())).collect::<Vec<_>>());
        let of_files = disagreements_json(&of_files);
        let object =
            json!({ "equal": equal, "only_a": only_a, "only_b": only_b, "file": of_files, "grids": all });
        writeln!(out, "{object}")?;
    } else {
        writeln!(out, "{}", if equal { "equal" } else { "different" })?;
    }
    out.flush()?;
    if equal { Ok(()) } else { Err(Failure::Reported) }
}

fn compare(name: &str, a: &Grid, b: &Grid, args: &Args) -> Compared {
    let options = Options {
        tolerance: args.tolerance,
        transform_tolerance: args.transform_tolerance,
        active_only: args.active_only,
        listed: args.list,
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
    Compared { name: name.to_owned(), equal, difference, voxels, voxels_json }
}

fn print(out: &mut impl Write, compared: &Compared, args: &Args) -> io::Result<()> {
    let Compared { name, difference, .. } = compared;
    let verdict = if compared.equal { "equal" } else { "different" };
    writeln!(out, "{}: {verdict}", one_line(name))?;
    print_disagreements(out, "", &difference.disagreements, args)?;
    let Some(found) = &difference.voxels else {
        return writeln!(
            out,
            "  voxels: not compared, since the types or the shapes of the trees do not match"
        );
    };
    let active = thousands(found.active);
    if found.differing_values > 0 {
        writeln!(out, "  values: {} of {active} active voxels differ", thousands(found.differing_values))?;
    }
    if found.differing_inactive_values > 0 {
        let count = thousands(found.differing_inactive_values);
        writeln!(out, "  values: {count} voxels that are inactive in both differ")?;
    }
    if found.differing_states > 0 {
        writeln!(out, "  states: {} voxels are active in one alone", thousands(found.differing_states))?;
    }
    if found.not_finite > 0 {
        writeln!(out, "  values: {} voxels are NaN or infinite in one alone", thousands(found.not_finite))?;
    }
    if let Some(ijk) = found.max_error_at {
        let [largest, mean, rms, psnr] =
            [found.max_error, found.mean_error(), found.rms_error(), found.psnr()].map(number);
        writeln!(out, "  error: at most {largest} at {ijk:?}, mean {mean}, RMS {rms}, PSNR {psnr} dB")?;
    }
    if found.nodes_only_in_a + found.nodes_only_in_b > 0 {
        let [a, b] = [found.nodes_only_in_a, found.nodes_only_in_b].map(thousands);
        writeln!(out, "  (note) topology: {a} nodes and leaves only in A, {b} only in B")?;
    }
    for [ijk, a, b] in &compared.voxels {
        writeln!(out, "  {ijk}: {a} | {b}")?;
    }
    Ok(())
}

fn print_disagreements(
    out: &mut impl Write,
    of: &str,
    disagreements: &[Disagreement],
    args: &Args,
) -> io::Result<()> {
    if !of.is_empty() && !disagreements.is_empty() {
        writeln!(out, "{of}:")?;
    }
    for Disagreement { what, a, b, counts } in disagreements {
        let mark = if *counts && !args.values_only { "" } else { "(note) " };
        let [a, b] = [a, b].map(|side| one_line(side.as_deref().unwrap_or("nothing")));
        writeln!(out, "  {mark}{}: {a} | {b}", one_line(what))?;
    }
    Ok(())
}

fn disagreements_json(disagreements: &[Disagreement]) -> Vec<Value> {
    let one = |Disagreement { what, a, b, counts }: &Disagreement| json!({ "what": what, "a": a, "b": b, "counts": counts });
    disagreements.iter().map(one).collect()
}

fn grid_json(compared: &Compared) -> Value {
    let voxels = compared.difference.voxels.as_ref().map(|found: &VoxelDifference| {
        json!({
            "active": found.active,
            "differing_values": found.differing_values,
            "differing_inactive_values": found.differing_inactive_values,
            "differing_states": found.differing_states,
            "not_finite": found.not_finite,
            "max_error": json_number(found.max_error),
            "max_error_at": found.max_error_at,
            "mean_error": json_number(found.mean_error()),
            "rms_error": json_number(found.rms_error()),
            "peak": json_number(found.peak),
            "psnr": json_number(found.psnr()),
            "nodes_only_in_a": found.nodes_only_in_a,
            "nodes_only_in_b": found.nodes_only_in_b,
            "first": compared.voxels_json,
        })
    });
    json!({
        "name": text(compared.name.as_bytes()),
        "equal": compared.equal,
        "disagreements": disagreements_json(&compared.difference.disagreements),
        "voxels": voxels,
    })
}
