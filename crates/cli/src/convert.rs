//! `nuage convert`: grids of some files into another, or into one file each.
//!
//! Reading, cutting, encoding live in `nuage_vdb`, files that appear whole in `nuage_pipeline`; here stand the options
//! and what they mean together.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use nuage_pipeline::output::{OutputError, write_whole_with};
use nuage_pipeline::pack::options::{Bound, Options};
use nuage_pipeline::sequence::{FrameFile, output_path};
use nuage_vdb::{AnyFile, AnyTree, Compression, Grid, IndexBox, Metadata, WriteOptions, nano};
use nuage_volume::codec::Codec;
use nuage_volume::codec::block::{BlockFormat, PackingAxis};

use crate::error::{Failure, explain};
use crate::frames;
use crate::pack::{self, Asked, PackArgs};
use crate::source::{DiskFile, Memory};
use crate::text::{number, one_line, thousands};
use crate::verify;

/// Write grids of VDB and NanoVDB files to another file, chosen, renamed, cut or compressed otherwise; or a whole
/// sequence to one packed file, and back.
///
/// The name of the output says what it is: .vdb, .nvdb or .nuage. Of several inputs the grids are put together in order;
/// a sequence, written smoke.####.vdb, smoke.%04d.vdb or as a glob in quotes, becomes one .nuage file, or files with
/// names of the same kind. An output appears whole or not at all.
///
/// --max-error, --psnr, --bits-per-voxel and --codec take NAME=VALUE for one grid of a .nuage file and may be repeated, as
/// in --max-error temperature=1% --psnr density=50. What is asked of a grid by name replaces what is asked of all.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The files to read, and last the file to write
    #[arg(value_name = "FILE", required = true, num_args = 2..)]
    files: Vec<PathBuf>,

    /// Take only the grid of this name; may be repeated [default: all grids]
    #[arg(long, value_name = "NAME")]
    grid: Vec<String>,

    /// Give a grid another name; may be repeated
    #[arg(long, value_name = "OLD=NEW", value_parser = rename)]
    rename: Vec<(String, String)>,

    /// Keep only what lies in this box of index coordinates, both ends included
    #[arg(long, value_name = "X0,Y0,Z0,X1,Y1,Z1", value_parser = six::<i32>, allow_hyphen_values = true)]
    crop: Option<[i32; 6]>,

    /// Keep only voxels whose centres lie in this box of world coordinates
    #[arg(
        long, value_name = "X0,Y0,Z0,X1,Y1,Z1", value_parser = six::<f64>, allow_hyphen_values = true,
        conflicts_with = "crop"
    )]
    crop_world: Option<[f64; 6]>,

    /// Write each grid to its own file: the name of the grid is put before the extension, as in out.density.vdb
    #[arg(long)]
    split: bool,

    /// Save floating-point values of .vdb files as half floats [default: as they were]
    #[arg(long, conflicts_with = "full")]
    half: bool,

    /// Save floating-point values of .vdb files in full width
    #[arg(long)]
    full: bool,

    /// How values in .vdb files are compressed [default: blosc]
    #[arg(long, value_enum)]
    compression: Option<VdbCodec>,

    /// Store the values of inactive voxels in .vdb files too
    #[arg(long)]
    no_active_mask: bool,

    /// How the voxels of float grids are stored in .nvdb files [default: full]
    #[arg(long, value_enum)]
    encoding: Option<NanoEncoding>,

    /// The largest error of any voxel, in .nuage files and with --encoding fpn: a number, or for .nuage files a
    /// part of a channel's peak, as in 3%
    #[arg(
        long, value_name = "[NAME=]X", required_if_eq("encoding", "fpn"),
        value_parser = |text: &str| pack::asked(text, pack::bound)
    )]
    max_error: Vec<Asked<Bound>>,

    /// How .nvdb files are compressed: none, zip or blosc [default: none]; the codec of all bricks in .nuage files that
    /// it can hold: u1 to u8 (uniform codes of so many bits), s1 to s8 (the same by
    /// octants), g0 to g8 (the same around a gradient), f16, f32, or the
    /// texture blocks bc3, bc4 and bc7
    #[arg(long, value_name = "[NAME=]CODEC", value_parser = |text: &str| pack::asked(text, codec))]
    codec: Vec<Asked<CodecChoice>>,

    #[command(flatten)]
    pub(crate) pack: PackArgs,

    /// Read the written file again, decode all of it and compare it with the sources, read anew, before it gets its name
    #[arg(long)]
    pub(crate) verify: bool,

    /// Replace outputs that are there
    #[arg(long)]
    pub(crate) force: bool,

    #[command(flatten)]
    memory: Memory,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum VdbCodec {
    Blosc,
    Zip,
    None,
}

#[derive(Clone, Copy, clap::ValueEnum)]
enum NanoEncoding {
    Full,
    Fp16,
    Fp8,
    Fp4,
    Fpn,
}

impl Args {
    /// What is taken of each file, in words that differ where it does.
    pub(crate) fn selection(&self) -> String {
        format!("{:?} {:?} {:?} {:?}", self.grid, self.rename, self.crop, self.crop_world)
    }
}

/// What `--codec` names.
#[derive(Debug, Clone, Copy, PartialEq)]
enum CodecChoice {
    Nano(nano::Codec),
    Packed(Codec),
}

fn codec(text: &str) -> Result<CodecChoice, String> {
    let packed = |codec| Ok(CodecChoice::Packed(codec));
    let bits = text.get(1..).and_then(|digits| digits.parse::<u8>().ok());
    match (text, bits) {
        ("none", _) => Ok(CodecChoice::Nano(nano::Codec::None)),
        ("zip", _) => Ok(CodecChoice::Nano(nano::Codec::Zip)),
        ("blosc", _) => Ok(CodecChoice::Nano(nano::Codec::Blosc)),
        ("f16", _) => packed(Codec::F16),
        ("f32", _) => packed(Codec::F32),
        ("bc3", _) => packed(Codec::Block { format: BlockFormat::Bc3, axis: PackingAxis::Z }),
        ("bc4", _) => packed(Codec::Block { format: BlockFormat::Bc4, axis: PackingAxis::Z }),
        ("bc7", _) => packed(Codec::Block { format: BlockFormat::Bc7, axis: PackingAxis::Z }),
        (text, Some(bits @ 1..=8)) if text.starts_with('u') => packed(Codec::Uniform { bits }),
        (text, Some(bits @ 1..=8)) if text.starts_with('s') => packed(Codec::Split { bits }),
        (text, Some(bits @ 0..=8)) if text.starts_with('g') => packed(Codec::Gradient { bits }),
        _ => Err(
            "there are none, zip, blosc for .nvdb and u1 to u8, s1 to s8, g0 to g8, f16, f32, bc3, bc4, bc7 for .nuage"
                .into(),
        ),
    }
}

/// What is written, and how.
enum Target {
    Vdb(WriteOptions),
    Nano(nano::WriteOptions),
    Packed(Options),
}

fn rename(text: &str) -> Result<(String, String), String> {
    match text.split_once('=') {
        Some((old, new)) if !new.is_empty() => Ok((old.to_owned(), new.to_owned())),
        _ => Err("write OLD=NEW".into()),
    }
}

fn six<T: std::str::FromStr>(text: &str) -> Result<[T; 6], String> {
    let numbers: Result<Vec<T>, _> = text.split(',').map(|word| word.trim().parse()).collect();
    numbers
        .ok()
        .and_then(|numbers| numbers.try_into().ok())
        .ok_or_else(|| "write six numbers with commas between them: two corners".to_owned())
}

/// Converts.
///
/// # Errors
/// If an input cannot be read, an output cannot be written or is there already, or the options make no sense.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    let Some((output, inputs)) = args.files.split_last() else { return Ok(()) };
    let target = target(args, output)?;
    let frames = inputs.iter().map(|input| frames::find(input, args.pack.frames.as_ref()));
    let frames: Vec<Vec<FrameFile>> = frames.collect::<Result<_, _>>()?;
    let is_sequence = frames.iter().any(|frames| frames.len() > 1);
    // Of one input, every frame becomes a file; single files that are several become one.
    let is_pattern = is_sequence || inputs.len() == 1;
    match target {
        Target::Packed(_) if args.split => {
            Err(Failure::Usage("--split is for outputs with the extension .vdb or .nvdb".into()))
        }
        Target::Packed(options) => pack::run(args, &frames.concat(), &options, output),
        target if is_pattern => {
            for frame in frames.concat() {
                let pattern = output.to_string_lossy();
                let output = output_path(&pattern, frame.frame, is_sequence)
                    .map_err(|error| Failure::file(output, error.to_string()))?;
                convert(args, &[frame.path], &output, &target)?;
            }
            Ok(())
        }
        target => {
            let inputs: Vec<PathBuf> = frames.into_iter().flatten().map(|frame| frame.path).collect();
            convert(args, &inputs, output, &target)
        }
    }
}

/// Reads the grids of one frame, as they were asked for.
pub(crate) fn load(args: &Args, path: &Path) -> Result<(Vec<Grid>, Metadata), Failure> {
    let disk = DiskFile::open(path)?;
    let file = disk.any(args.memory)?;
    let asked = args.grid.iter().chain(args.rename.iter().map(|(old, _)| old));
    if let Some(name) = asked.into_iter().find(|name| file.find(name).is_none()) {
        return Err(Failure::file(path, not_found(name, &file.names())));
    }
    let mut grids = Vec::new();
    read(&disk, &file, args, &mut grids)?;
    Ok((grids, file.metadata()))
}

fn not_found(name: &str, names: &[impl std::borrow::Borrow<str>]) -> String {
    format!("grid '{name}' not found; there are: {}", names.join(", "))
}

/// The grids of some files put together, with the metadata of all.
struct Gathered {
    grids: Vec<Grid>,
    metadata: Metadata,
    bytes: u64,
}

/// Reads the grids of some files that were asked for.
fn gather(args: &Args, inputs: &[PathBuf]) -> Result<Gathered, Failure> {
    let mut gathered = Gathered { grids: Vec::new(), metadata: Metadata::default(), bytes: 0 };
    let mut names = Vec::new();
    let mut missing: Vec<&String> = args.grid.iter().chain(args.rename.iter().map(|(old, _)| old)).collect();
    for path in inputs {
        let disk = DiskFile::open(path)?;
        let file = disk.any(args.memory)?;
        gathered.bytes += disk.size();
        for (name, value) in file.metadata().iter() {
            if gathered.metadata.get(name).is_none() {
                gathered.metadata.insert(name, value.clone());
            }
        }
        missing = missing.iter().filter(|name| file.find(name).is_none()).copied().collect();
        names.extend(file.names().into_iter().map(str::to_owned));
        read(&disk, &file, args, &mut gathered.grids)?;
    }
    match (missing.first(), inputs.first()) {
        (Some(name), Some(input)) => Err(Failure::file(input, not_found(name, &names))),
        _ => Ok(gathered),
    }
}

/// Which grids go to which file.
fn outputs(args: &Args, output: &Path, grids: Vec<Grid>) -> Vec<(PathBuf, Vec<Grid>)> {
    match args.split {
        false => vec![(output.to_owned(), grids)],
        true => split(output, grids),
    }
}

/// Converts files to one.
fn convert(args: &Args, inputs: &[PathBuf], output: &Path, target: &Target) -> Result<(), Failure> {
    let start = Instant::now();
    if !args.split {
        check_absent(output, args.force)?;
    }
    let Gathered { grids, metadata, bytes: input_bytes } = gather(args, inputs)?;
    let outputs = outputs(args, output, grids);
    for (path, _) in &outputs {
        check_absent(path, args.force)?;
    }
    // Anew, so that what was read wrongly once is noticed.
    let sources = match args.verify {
        true => self::outputs(args, output, gather(args, inputs)?.grids),
        false => Vec::new(),
    };
    let mut out = io::stdout().lock();
    for (i, (path, grids)) in outputs.iter().enumerate() {
        let mut bytes = Vec::new();
        let written = match target {
            Target::Vdb(options) => nuage_vdb::write(grids, &metadata, options, &mut bytes),
            Target::Nano(options) => nano::write(grids, options, &mut bytes),
            Target::Packed(_) => Ok(()),
        };
        // The inputs were sound, so nothing of the advice for damaged files applies.
        written.map_err(|error| Failure::file(path, format!("cannot write this: {error}")))?;
        let verified = write_whole_with(path, args.force, |file| -> Result<Option<String>, Written> {
            let refused = |source| OutputError::Io { path: path.clone(), source };
            file.write_all(&bytes).map_err(refused)?;
            match (sources.get(i), target) {
                (Some((_, sources)), Target::Vdb(_)) => {
                    Ok(Some(verify::vdb(file, path, sources, &metadata, args.memory)?))
                }
                (Some((_, sources)), Target::Nano(options)) => {
                    Ok(Some(verify::nano(file, path, sources, options, args.memory)?))
                }
                _ => Ok(None),
            }
        });
        let verified = verified.map_err(|failure| match failure {
            Written::Output(error) => Failure::file(path, error.to_string()),
            Written::Verify(failure) => failure,
        })?;
        let count = if grids.len() == 1 { "1 grid".to_owned() } else { format!("{} grids", grids.len()) };
        let ratio = number((bytes.len() as f64 / input_bytes.max(1) as f64 * 1000.0).round() / 10.0);
        let seconds = start.elapsed().as_secs_f64();
        let [from, to] = [input_bytes, bytes.len() as u64].map(thousands);
        let path = one_line(&path.display().to_string());
        writeln!(out, "{path}: {count}, {from} bytes to {to} ({ratio} %), {seconds:.2} s")?;
        if let Some(verified) = verified {
            writeln!(out, "  {verified}")?;
        }
    }
    Ok(())
}

/// Why a file was not written.
enum Written {
    Output(OutputError),
    Verify(Failure),
}

impl From<OutputError> for Written {
    fn from(error: OutputError) -> Self {
        Written::Output(error)
    }
}

impl From<Failure> for Written {
    fn from(failure: Failure) -> Self {
        Written::Verify(failure)
    }
}

/// What the name of the output and the options ask for.
fn target(args: &Args, output: &Path) -> Result<Target, Failure> {
    let extension = output.extension().map(|e| e.to_string_lossy().to_lowercase());
    let misplaced = |options: &[(&str, bool)], extension: &str| {
        let given = options.iter().find(|(_, given)| *given);
        given.map_or(Ok(()), |(option, _)| {
            Err(Failure::Usage(format!("{option} is for outputs with the extension {extension}")))
        })
    };
    let of_vdb = [
        ("--compression", args.compression.is_some()),
        ("--no-active-mask", args.no_active_mask),
        ("--half", args.half),
        ("--full", args.full),
    ];
    let absolute = |bounds: &[Asked<Bound>]| match bounds {
        [] => Ok(0.0),
        [Asked { name: None, value: Bound::Absolute(error) }] => Ok(*error),
        _ => Err(Failure::Usage("--encoding fpn takes one error in the grids' own numbers".into())),
    };
    if !matches!(extension.as_deref(), Some("nuage")) {
        misplaced(&args.pack.given(), ".nuage")?;
    }
    match extension.as_deref() {
        Some("vdb") => {
            misplaced(
                &[
                    ("--encoding", args.encoding.is_some()),
                    ("--codec", !args.codec.is_empty()),
                    ("--max-error", !args.max_error.is_empty()),
                ],
                ".nvdb",
            )?;
            let compression = match args.compression.unwrap_or(VdbCodec::Blosc) {
                VdbCodec::Blosc => Compression::BLOSC,
                VdbCodec::Zip => Compression::ZIP,
                VdbCodec::None => Compression::NONE,
            };
            let compression = if args.no_active_mask { compression.with_all_values() } else { compression };
            Ok(Target::Vdb(WriteOptions { compression }))
        }
        Some("nvdb") => {
            misplaced(&of_vdb, ".vdb")?;
            let encoding = match args.encoding.unwrap_or(NanoEncoding::Full) {
                NanoEncoding::Full => nano::Encoding::Full,
                NanoEncoding::Fp16 => nano::Encoding::Fp16,
                NanoEncoding::Fp8 => nano::Encoding::Fp8,
                NanoEncoding::Fp4 => nano::Encoding::Fp4,
                NanoEncoding::Fpn => nano::Encoding::FpN { max_error: absolute(&args.max_error)? },
            };
            let codec = match args.codec.as_slice() {
                [] => nano::Codec::None,
                [Asked { name: None, value: CodecChoice::Nano(codec) }] => *codec,
                _ => {
                    return Err(Failure::Usage(
                        "the codecs of .nvdb files are none, zip and blosc, one for all grids".into(),
                    ));
                }
            };
            Ok(Target::Nano(nano::WriteOptions { encoding, codec }))
        }
        Some("nuage") => {
            misplaced(&of_vdb, ".vdb")?;
            misplaced(&[("--encoding", args.encoding.is_some())], ".nvdb")?;
            let codec = |asked: &Asked<CodecChoice>| match asked.value {
                CodecChoice::Packed(codec) => Ok(Asked { name: asked.name.clone(), value: codec }),
                CodecChoice::Nano(_) => {
                    Err(Failure::Usage("none, zip and blosc are codecs of .nvdb files".into()))
                }
            };
            let codecs = args.codec.iter().map(codec).collect::<Result<Vec<_>, _>>()?;
            Ok(Target::Packed(args.pack.options(&args.max_error, &codecs)?))
        }
        _ => {
            let output = output.display();
            Err(Failure::Usage(format!(
                "the output '{output}' must have the extension .vdb, .nvdb or .nuage"
            )))
        }
    }
}

/// Refuses a file that is there before the work is done. What holds against a race is in the writing itself.
pub(crate) fn check_absent(path: &Path, force: bool) -> Result<(), Failure> {
    match !force && path.symlink_metadata().is_ok() {
        true => Err(Failure::file(path, "the file exists already; --force replaces it")),
        false => Ok(()),
    }
}

/// Reads the grids of a file that were asked for, as they were asked for.
fn read(
    disk: &DiskFile,
    file: &AnyFile<&DiskFile>,
    args: &Args,
    grids: &mut Vec<Grid>,
) -> Result<(), Failure> {
    let refused = |what: String| Failure::file(disk.path(), what);
    let names = file.names();
    let wanted: Vec<usize> = (0..names.len())
        .filter(|i| {
            let is_meant = |name: &String| file.find(name) == Some(*i);
            args.grid.is_empty() || args.grid.iter().any(is_meant)
        })
        .collect();
    let is_whole = wanted.len() == names.len() && args.crop.is_none() && args.crop_world.is_none();
    let read: Vec<Grid> = match is_whole {
        // So that shared trees stay shared.
        true => file.read_all().map_err(|error| refused(explain(&error)))?,
        false => {
            let one = |i: &usize| {
                read_cut(file, *i, args).map_err(|what| refused(format!("grid '{}': {what}", names[*i])))
            };
            wanted.iter().map(one).collect::<Result<_, _>>()?
        }
    };
    for (i, mut grid) in wanted.into_iter().zip(read) {
        if let Some((_, new)) = args.rename.iter().find(|(old, _)| file.find(old) == Some(i)) {
            grid.name.clone_from(new);
        }
        let is_real = matches!(
            &*grid.tree,
            AnyTree::Float(_) | AnyTree::Double(_) | AnyTree::Vec3s(_) | AnyTree::Vec3d(_)
        );
        grid.save_float_as_half = (grid.save_float_as_half || args.half && is_real) && !args.full;
        grids.push(grid);
    }
    Ok(())
}

/// Reads a grid, or what lies in the box that was asked for.
fn read_cut(file: &AnyFile<&DiskFile>, index: usize, args: &Args) -> Result<Grid, String> {
    let in_box = |bbox: IndexBox| file.read_grid_in_box(index, bbox);
    let read = match (args.crop, args.crop_world) {
        (Some([x0, y0, z0, x1, y1, z1]), _) => {
            let (min, max) = ([x0.min(x1), y0.min(y1), z0.min(z1)], [x0.max(x1), y0.max(y1), z0.max(z1)]);
            in_box([min, max])
        }
        (None, Some([x0, y0, z0, x1, y1, z1])) => {
            let transform = match file {
                AnyFile::Vdb(file) => file.grids[index].transform.clone(),
                AnyFile::Nano(file) => file.read_grid(index).map_err(|error| explain(&error))?.transform,
            };
            let bbox = transform.index_box_from_world([[x0, y0, z0], [x1, y1, z1]]);
            in_box(bbox.ok_or("no centre of a voxel lies in that box of world space")?)
        }
        (None, None) => file.read_grid(index),
    };
    read.map_err(|error| explain(&error))
}

/// A file for each grid.
fn split(output: &Path, grids: Vec<Grid>) -> Vec<(PathBuf, Vec<Grid>)> {
    let mut outputs: Vec<(PathBuf, Vec<Grid>)> = Vec::new();
    for grid in grids {
        let path = (1..)
            .map(|number| with_name(output, &grid.name, number))
            .find(|path| outputs.iter().all(|(other, _)| other != path))
            .unwrap_or_default();
        outputs.push((path, vec![grid]));
    }
    outputs
}

/// The path with the name of a grid before the extension, and a number if it is not the first of that name. Of the
/// name, what file systems may refuse becomes an underscore.
fn with_name(output: &Path, name: &str, number: usize) -> PathBuf {
    let is_plain = |c: char| c.is_alphanumeric() || matches!(c, '-' | '_' | '.');
    let mut plain: String = name.chars().map(|c| if is_plain(c) { c } else { '_' }).collect();
    if plain.is_empty() {
        plain.push_str("grid");
    }
    if number > 1 {
        plain.push_str(&format!(".{number}"));
    }
    let [stem, extension] =
        [output.file_stem(), output.extension()].map(|part| part.unwrap_or_default().to_string_lossy());
    output.with_file_name(format!("{stem}.{plain}.{extension}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_name_of_a_grid_becomes_part_of_a_file_name_and_leads_nowhere_else() {
        let output = Path::new("a/out.vdb");
        assert_eq!(with_name(output, "density", 1), Path::new("a/out.density.vdb"));
        assert_eq!(with_name(output, "density", 2), Path::new("a/out.density.2.vdb"));
        assert_eq!(with_name(output, "../x y", 1), Path::new("a/out..._x_y.vdb"));
        assert_eq!(with_name(output, "", 1), Path::new("a/out.grid.vdb"));
    }

    #[test]
    fn a_box_is_six_numbers() {
        assert_eq!(six::<i32>("-1,2, 3,4,5,6"), Ok([-1, 2, 3, 4, 5, 6]));
        assert!(six::<i32>("1,2,3").is_err() && six::<i32>("1,2,3,4,5,x").is_err());
        assert!(rename("a").is_err() && rename("a=").is_err());
        assert_eq!(rename("a=b=c"), Ok(("a".into(), "b=c".into())));
    }
}
