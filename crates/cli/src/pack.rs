//! `nuage convert … out.nuage`: a file or a sequence to one packed file.
//!
//! The options and the closing report live here, and what is done with files that are there already; packing itself is
//! the pipeline's.

use std::collections::{HashMap, HashSet};
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use nuage_pipeline::output::{OutputError, write_whole_with};
use nuage_pipeline::pack::append;
use nuage_pipeline::pack::assemble::Report;
use nuage_pipeline::pack::options::{Bound, ChannelOptions, Options, unmet};
use nuage_pipeline::pack::sequence::{FrameName, PackError, Surroundings, pack_with};
use nuage_pipeline::pack::work::{Keep, Recipe, Work, file_digest};
use nuage_pipeline::sequence::{FrameFile, FrameRange};
use nuage_volume::codec::Codec;
use nuage_volume::format::{Asset, Role};

use crate::convert;
use crate::error::Failure;
use crate::frames;
use crate::progress;
use crate::source::DiskFile;
use crate::text::{number, one_line, thousands};
use crate::verify;

/// What is asked of a packed file.
#[derive(Debug, Clone, clap::Args)]
pub(crate) struct PackArgs {
    /// The least signal-to-noise ratio of .nuage files in dB, over all frames [default: 45, unless something else is
    /// asked for]
    #[arg(long, value_name = "[NAME=]DB", value_parser = |text: &str| asked(text, amount))]
    psnr: Vec<Asked<f64>>,

    /// The most bits per voxel of bricks that are not constant, in .nuage files. A density's are spent where light gets;
    /// with --psnr as well, where errors are largest
    #[arg(long, value_name = "[NAME=]BITS", value_parser = |text: &str| asked(text, amount))]
    bits_per_voxel: Vec<Asked<f64>>,

    /// What the values of a grid mean, in .nuage files: density, temperature, flame, velocity, signed-distance, colour or
    /// other; may be repeated [default: what class and name of the grid say]
    #[arg(long, value_name = "NAME=ROLE", value_parser = |text: &str| named(text, role))]
    role: Vec<Asked<Role>>,

    /// The unit of the values of a grid, kept in .nuage files, as in temperature=K; may be repeated
    #[arg(long, value_name = "NAME=TEXT", value_parser = |text: &str| named(text, |unit| Ok(unit.to_owned())))]
    unit: Vec<Asked<String>>,

    /// How many coarser levels of detail .nuage files get at most
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=12))]
    levels: u32,

    /// How many shapes the bricks of .nuage files may share at most: smaller where errors may be large, but slower
    #[arg(long, value_name = "N", default_value_t = 0, value_parser = clap::value_parser!(u32).range(0..=4096))]
    shapes: u32,

    /// Frames per second, kept in .nuage files
    #[arg(long, value_name = "RATE")]
    fps: Option<f64>,

    /// Add the frames to a .nuage file that is there, which keeps the quality that was asked of it and its rate
    #[arg(long)]
    pub(crate) append: bool,

    /// Begin anew, and keep no finished frames for a run that takes up again where this one was stopped
    #[arg(long)]
    no_resume: bool,

    /// Frames of a sequence to convert, as in 1-100, 1-100x2 or 5,10-20; negative numbers too
    #[arg(long, value_name = "RANGE", allow_hyphen_values = true)]
    pub(crate) frames: Option<FrameRange>,
}

/// A value that is asked of all channels, or of those of one grid.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Asked<T> {
    /// The name of the grid.
    pub(crate) name: Option<String>,
    pub(crate) value: T,
}

/// `VALUE`, or `NAME=VALUE`. Names may hold a `=`, values none.
pub(crate) fn asked<T>(text: &str, value: impl Fn(&str) -> Result<T, String>) -> Result<Asked<T>, String> {
    match text.rsplit_once('=') {
        Some(("", _)) => Err("a name is needed before the =".into()),
        Some((name, text)) => Ok(Asked { name: Some(name.to_owned()), value: value(text)? }),
        None => Ok(Asked { name: None, value: value(text)? }),
    }
}

/// `NAME=VALUE`.
fn named<T>(text: &str, value: impl Fn(&str) -> Result<T, String>) -> Result<Asked<T>, String> {
    match text.contains('=') {
        true => asked(text, value),
        false => Err("write NAME=VALUE, with the name of a grid".into()),
    }
}

fn amount(text: &str) -> Result<f64, String> {
    match text.trim().parse::<f64>() {
        Ok(x) if x > 0.0 && x.is_finite() => Ok(x),
        _ => Err("a number above 0 is needed".into()),
    }
}

fn role(text: &str) -> Result<Role, String> {
    match text {
        "density" => Ok(Role::Density),
        "temperature" => Ok(Role::Temperature),
        "flame" => Ok(Role::Flame),
        "velocity" => Ok(Role::Velocity),
        "signed-distance" => Ok(Role::SignedDistance),
        "colour" | "color" => Ok(Role::Colour),
        "other" => Ok(Role::Other),
        _ => Err("there are density, temperature, flame, velocity, signed-distance, colour and other".into()),
    }
}

/// Puts what was given for one option into the options of all channels and of single ones. That of all is returned.
fn spread<T: Clone>(
    option: &str,
    given: &[Asked<T>],
    channels: &mut Vec<(String, ChannelOptions)>,
    set: impl Fn(&mut ChannelOptions) -> &mut Option<T>,
) -> Result<Option<T>, Failure> {
    let mut general = None;
    for Asked { name, value } in given {
        let slot = match name {
            None => &mut general,
            Some(name) => {
                let i = channels.iter().position(|(other, _)| other == name).unwrap_or_else(|| {
                    channels.push((name.clone(), ChannelOptions::default()));
                    channels.len() - 1
                });
                set(&mut channels[i].1)
            }
        };
        if slot.replace(value.clone()).is_some() {
            let whom = name.as_ref().map_or("all channels".to_owned(), |name| format!("'{name}'"));
            return Err(Failure::Usage(format!("{option} is given twice for {whom}")));
        }
    }
    Ok(general)
}

impl PackArgs {
    /// The names of the options that were given, which are for packed files alone.
    pub(crate) fn given(&self) -> [(&'static str, bool); 9] {
        let [psnr, bits, role, unit, levels, shapes, fps] = self.of_file();
        [
            psnr,
            bits,
            role,
            unit,
            levels,
            shapes,
            fps,
            ("--append", self.append),
            ("--no-resume", self.no_resume),
        ]
    }

    /// Those of them that say how a file is to be.
    fn of_file(&self) -> [(&'static str, bool); 7] {
        [
            ("--psnr", !self.psnr.is_empty()),
            ("--bits-per-voxel", !self.bits_per_voxel.is_empty()),
            ("--role", !self.role.is_empty()),
            ("--unit", !self.unit.is_empty()),
            ("--levels", self.levels > 0),
            ("--shapes", self.shapes > 0),
            ("--fps", self.fps.is_some()),
        ]
    }

    /// What the options ask for.
    ///
    /// # Errors
    /// If they make no sense, in words.
    pub(crate) fn options(
        &self,
        max_errors: &[Asked<Bound>],
        codecs: &[Asked<Codec>],
    ) -> Result<Options, Failure> {
        if self.fps.is_some_and(|rate| !rate.is_finite() || rate <= 0.0) {
            return Err(Failure::Usage("--fps must be a number above 0".into()));
        }
        let of_encoder = [("--max-error", !max_errors.is_empty()), ("--codec", !codecs.is_empty())];
        let mut given = self.of_file().into_iter().chain(of_encoder).filter(|(_, is_given)| *is_given);
        if let (true, Some((name, _))) = (self.append, given.next()) {
            return Err(Failure::Usage(format!(
                "{name} is not for --append: the file keeps what was asked of it"
            )));
        }
        let mut channels = Vec::new();
        let max_error = spread("--max-error", max_errors, &mut channels, |asked| &mut asked.max_error)?;
        let psnr = spread("--psnr", &self.psnr, &mut channels, |asked| &mut asked.psnr)?;
        let bits = spread("--bits-per-voxel", &self.bits_per_voxel, &mut channels, |asked| {
            &mut asked.bits_per_voxel
        })?;
        let codec = spread("--codec", codecs, &mut channels, |asked| &mut asked.codec)?;
        spread("--role", &self.role, &mut channels, |asked| &mut asked.role)?;
        spread("--unit", &self.unit, &mut channels, |asked| &mut asked.physical_unit)?;
        let nothing_asked = max_error.is_none() && psnr.is_none() && bits.is_none() && codec.is_none();
        let default = Options::default();
        Ok(Options {
            max_error: if nothing_asked { default.max_error } else { max_error },
            psnr: if nothing_asked { default.psnr } else { psnr },
            bits_per_voxel: bits,
            codec,
            coarser_levels: self.levels,
            shapes: self.shapes,
            channels,
        })
    }
}

/// A bound as it is written: `0.01`, or `3%` of the channel's peak.
pub(crate) fn bound(text: &str) -> Result<Bound, String> {
    let (digits, is_part) = match text.strip_suffix('%') {
        Some(digits) => (digits, true),
        None => (text, false),
    };
    let value: f32 =
        digits.trim().parse().map_err(|_| "write a number, or one with % for a part of the peak")?;
    match value.is_finite() && value >= 0.0 {
        true if is_part => Ok(Bound::OfPeak(value / 100.0)),
        true => Ok(Bound::Absolute(value)),
        false => Err("an error is 0 or above".into()),
    }
}

/// Packs frames into the file `output`.
///
/// # Errors
/// If one cannot be read, or the file not be written.
pub(crate) fn run(
    args: &convert::Args,
    frames: &[FrameFile],
    options: &Options,
    output: &Path,
) -> Result<(), Failure> {
    let start = Instant::now();
    if args.pack.append && args.verify {
        let hint = "--verify is not for --append: the errors of frames that are there cannot be found without their sources";
        return Err(Failure::Usage(hint.into()));
    }
    let base = match args.pack.append {
        true => Some(frames::open(output)?),
        false => None,
    };
    let options = match &base {
        Some(base) => &append::options(base.contents()).ok_or_else(|| {
            Failure::file(output, "the file does not say what was asked of it: convert all frames anew")
        })?,
        None => options,
    };
    let names: Vec<FrameName> = frames.iter().map(frame_name).collect();
    check_numbers(base.as_ref(), &names, output)?;
    let selection = args.selection();
    let recipe = Recipe::new(options, args.pack.fps, &selection, digests(frames)?);
    let base_digest = match &base {
        Some(_) => Some(digest(output)?),
        None => None,
    };
    let work = Work::beside(output, recipe.key(&names, base_digest));
    if base.is_none() && !args.force && is_up_to_date(output, &recipe, &names) {
        work.iter().for_each(Work::remove);
        writeln!(io::stdout(), "{}: up to date", one_line(&output.display().to_string()))?;
        return Ok(());
    }
    if base.is_none() {
        convert::check_absent(output, args.force)?;
    }
    let kept = work.as_ref().filter(|_| !args.pack.no_resume);
    let finished = kept.map_or(0, Work::finished_frames);
    if finished > 0 {
        let _ = writeln!(io::stderr(), "nuage: resuming: {finished} of {} frames were done", frames.len());
    }
    let bar = progress::bar(1);
    bar.set_message(one_line(&output.display().to_string()));
    let load = |frame: usize| convert::load(args, &frames[frame].path);
    let frames_before = base.as_ref().map_or(0, |base| base.contents().frames.len());
    let overwrite = args.force || base.is_some();
    let written = write_whole_with(output, overwrite, |file| {
        // The file that is added to is closed before it is replaced.
        let base = base;
        let found = |name: &str| kept?.load(name);
        let save = |name: &str, bytes: &[u8]| kept.iter().for_each(|work| work.save(name, bytes));
        let keep = kept.map(|_| Keep { load: &found, save: &save });
        let surroundings = Surroundings { base: base.as_ref(), recipe: Some(&recipe), keep };
        let mut done = |part: f64| bar.set_position((part * 1000.0) as u64);
        let out = BufWriter::new(&mut *file);
        let packed = pack_with(surroundings, &names, load, out, options, args.pack.fps, &mut done);
        let (report, plan) = packed.map_err(PackFailure::Pack)?;
        // What is wrong never gets the name that was asked for.
        let verified = match args.verify {
            true => Some(verify::packed(file, output, frames, args, &report).map_err(PackFailure::Verify)?),
            false => None,
        };
        Ok((report, plan, verified))
    });
    bar.finish_and_clear();
    if matches!(written, Err(PackFailure::Verify(_))) {
        // Taken up again, it would be as wrong.
        work.iter().for_each(Work::remove);
    }
    let (report, plan, verified) = written.map_err(|failure| match failure {
        PackFailure::Output(error) => Failure::file(output, error.to_string()),
        PackFailure::Pack(PackError::Load(failure)) | PackFailure::Verify(failure) => failure,
        PackFailure::Pack(other) => Failure::file(output, other.to_string()),
    })?;
    work.iter().for_each(Work::remove);
    for what in &plan.left_out {
        let _ = writeln!(io::stderr(), "nuage: left out: {}", one_line(what));
    }
    if plan.channels.is_empty() {
        let _ = writeln!(io::stderr(), "nuage: there was no grid to pack");
    }
    let input_bytes =
        frames.iter().map(|frame| DiskFile::open(&frame.path).map_or(0, |file| file.size())).sum();
    print(&report, frames_before, output, input_bytes, start.elapsed().as_secs_f64())?;
    if let Some(verified) = verified {
        writeln!(io::stdout(), "  {verified}")?;
    }
    for missed in unmet(&report, options) {
        let _ = writeln!(io::stderr(), "nuage: not met: {}", one_line(&missed.to_string()));
    }
    Ok(())
}

fn frame_name(frame: &FrameFile) -> FrameName {
    let name = frame.path.file_name().unwrap_or(frame.path.as_os_str());
    FrameName { number: frame.frame, name: name.to_string_lossy().into_owned() }
}

/// Makes sure that each frame has a number of its own, among those that are there as well.
fn check_numbers(base: Option<&Asset>, names: &[FrameName], output: &Path) -> Result<(), Failure> {
    let old = base.map_or(0, |base| base.contents().frames.len());
    let mut numbers: HashSet<i64> =
        base.iter().flat_map(|base| (0..old).map(|frame| frames::number(base, frame))).collect();
    let before = numbers.clone();
    for (place, name) in names.iter().enumerate() {
        // A frame is asked for by its number, or by its place if it has none.
        let number = name.number.unwrap_or((old + place) as i64 + 1);
        if before.contains(&number) {
            return Err(Failure::file(
                output,
                format!("there is a frame {number} already; nothing was added"),
            ));
        }
        if !numbers.insert(number) {
            return Err(Failure::Usage(format!(
                "two frames would have the number {number}; a .nuage file takes one sequence: put grids of several \
                 files together in .vdb files first"
            )));
        }
    }
    Ok(())
}

fn digest(path: &Path) -> Result<u128, Failure> {
    // Opened first for the sake of what is no regular file.
    DiskFile::open_plain(path)?;
    file_digest(path).map_err(|error| Failure::file(path, format!("cannot read the file: {error}")))
}

/// A digest of each frame's source. The frames of a packed file have one source, and their numbers beside it.
fn digests(frames: &[FrameFile]) -> Result<Vec<u128>, Failure> {
    let mut known: HashMap<PathBuf, u128> = HashMap::new();
    let digest = |frame: &FrameFile| {
        let path = frames::packed(&frame.path).map_or_else(|| frame.path.clone(), |(path, _)| path);
        match known.get(&path) {
            Some(known) => Ok(*known),
            None => {
                let found = digest(&path)?;
                known.insert(path, found);
                Ok(found)
            }
        }
    };
    frames.iter().map(digest).collect()
}

/// Whether a sound file was made of the same frames by the same recipe.
fn is_up_to_date(output: &Path, recipe: &Recipe, names: &[FrameName]) -> bool {
    let Ok(asset) = frames::open(output) else { return false };
    recipe.made(asset.contents(), names) && asset.check_pages().is_ok()
}

/// Why a packed file was not written.
enum PackFailure {
    Output(OutputError),
    Pack(PackError<Failure>),
    Verify(Failure),
}

impl From<OutputError> for PackFailure {
    fn from(error: OutputError) -> Self {
        PackFailure::Output(error)
    }
}

/// Says what became of the frames.
fn print(report: &Report, before: usize, output: &Path, input_bytes: u64, seconds: f64) -> io::Result<()> {
    let mut out = io::stdout().lock();
    let rounded =
        |value: f64, digits: i32| number((value * 10.0_f64.powi(digits)).round() / 10.0_f64.powi(digits));
    let disk = report.summary.file_bytes;
    let ratio = rounded(disk as f64 / input_bytes.max(1) as f64 * 100.0, 1);
    let frames = match report.contents.frames.len() - before {
        1 => "1 frame".to_owned(),
        count => format!("{count} frames"),
    };
    let path = one_line(&output.display().to_string());
    let [from, to] = [input_bytes, disk].map(thousands);
    match before {
        0 => writeln!(out, "{path}: {frames}, {from} bytes to {to} ({ratio} %), {seconds:.2} s")?,
        _ => writeln!(
            out,
            "{path}: {frames} of {from} bytes added to {before}, now {to} bytes, {seconds:.2} s"
        )?,
    }
    let memory = report.tree_bytes + report.brick_bytes + report.shape_bytes;
    let voxels = report.source_bricks * 512;
    let per_voxel = |bytes: u64| rounded(bytes as f64 * 8.0 / voxels.max(1) as f64, 2);
    writeln!(
        out,
        "  in memory {} bytes: tree {}, bricks {}, shapes {}; {} bits per voxel of {} bricks; {} are stored",
        thousands(memory),
        thousands(report.tree_bytes),
        thousands(report.brick_bytes),
        thousands(report.shape_bytes),
        per_voxel(memory),
        thousands(report.source_bricks),
        thousands(report.bricks_stored),
    )?;
    writeln!(
        out,
        "  tree: {} entries, {} bytes each with nodes and masks",
        thousands(report.entries),
        rounded(report.tree_bytes as f64 / report.entries.max(1) as f64, 2)
    )?;
    for channel in &report.contents.channels {
        let component = channel
            .component
            .map_or(String::new(), |c| format!(".{}", ["x", "y", "z"][usize::from(c.min(2))]));
        let quality = channel.quality;
        let error = number(f64::from(quality.max_error));
        let psnr = match quality.psnr(channel.peak) {
            psnr if psnr.is_finite() => format!("{} dB", rounded(psnr, 2)),
            _ => "exact".to_owned(),
        };
        writeln!(
            out,
            "  {}{component}: {psnr}, largest error {error} of a peak of {}",
            one_line(&channel.name),
            number(f64::from(channel.peak))
        )?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bound_is_a_number_or_a_part_of_the_peak() {
        assert_eq!(bound("0.25"), Ok(Bound::Absolute(0.25)));
        assert_eq!(bound("3%"), Ok(Bound::OfPeak(0.03)));
        assert!(bound("-1").is_err() && bound("x%").is_err() && bound("inf").is_err());
    }

    #[test]
    fn a_value_may_be_for_one_grid() {
        let asked = |text: &str| asked(text, bound);
        assert_eq!(asked("3%"), Ok(Asked { name: None, value: Bound::OfPeak(0.03) }));
        let of = |name: &str| Ok(Asked { name: Some(name.to_owned()), value: Bound::Absolute(2.0) });
        assert_eq!(asked("heat=2"), of("heat"));
        assert_eq!(asked("a=b=2"), of("a=b"));
        assert!(asked("=2").is_err() && asked("heat=x").is_err());
        assert!(named("density", role).is_err() && named("density=smoke", role).is_err());
        assert_eq!(named("x=signed-distance", role).unwrap().value, Role::SignedDistance);
    }

    #[test]
    fn the_same_is_not_asked_twice() {
        let twice = |names: [Option<&str>; 2]| {
            let given = names.map(|name| Asked { name: name.map(str::to_owned), value: 1.0 });
            let mut channels = Vec::new();
            spread("--psnr", &given, &mut channels, |asked| &mut asked.psnr).is_err()
        };
        assert!(twice([None, None]) && twice([Some("a"), Some("a")]));
        assert!(!twice([None, Some("a")]) && !twice([Some("b"), Some("a")]));
    }
}
