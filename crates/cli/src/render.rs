//! `nuage render`: one file, or a sequence of them, to pictures.

use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use nuage_pipeline::import;
use nuage_pipeline::output::write_whole;
use nuage_pipeline::sequence::{FrameFile, FrameRange, find_frames, output_path};
use nuage_render::film::Image;
use nuage_render::framing::WorldBox;
use nuage_render::output::exr::{ExrPrecision, encode_exr};
use nuage_render::output::png::encode_png;
use nuage_volume::channel::IndexBox;

use crate::error::Failure;
use crate::frames;
use crate::look::Look;
use crate::progress;
use crate::shot::{self, Shot, Volume};
use crate::source::DiskFile;

/// Volumes of a sequence that are looked at to settle automatic scales.
const FITTED_FRAMES: usize = 5;

/// Render a .vdb file, a sequence of them or a packed file to pictures.
///
/// A sequence is written smoke.####.vdb, smoke.%04d.vdb, as a glob in quotes, or as a folder; of a .nuage file all
/// frames are rendered, or one: smoke.nuage#12. It has one camera,
/// fitted to the union of its frames' boxes, and one density scale.
#[derive(clap::Args)]
pub(crate) struct Args {
    /// The file or sequence: smoke.vdb, smoke.nuage, smoke.####.vdb, smoke.%04d.vdb, 'smoke.*.vdb' or a folder
    input: String,

    /// Where to write: .png (sRGB, 8 bit) or .exr (linear); for a sequence with ####, %04d or $F4
    #[arg(short, long, value_name = "FILE")]
    output: String,

    /// Frames to render, as in 1-100, 1-100x2 or 5,10-20; negative numbers too
    #[arg(long, value_name = "RANGE", allow_hyphen_values = true)]
    frames: Option<FrameRange>,

    /// The density grid [default: density, else the first fog volume, level set or float grid]
    #[arg(long, value_name = "NAME")]
    grid: Option<String>,

    /// Replace pictures that are there
    #[arg(long)]
    overwrite: bool,

    /// Leave out frames whose picture is there
    #[arg(long, conflicts_with = "overwrite")]
    resume: bool,

    /// Write EXR with 32-bit floats in place of 16-bit ones
    #[arg(long)]
    exr_float: bool,

    /// Threads to use [default: one per core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,

    /// Print how long each part took, and the settled camera and scales
    #[arg(long)]
    timing: bool,

    #[command(flatten)]
    look: Look,
}

/// A frame to be rendered.
struct Job {
    input: PathBuf,
    output: PathBuf,
}

/// Renders.
pub(crate) fn run(args: &Args) -> Result<(), Failure> {
    if let Some(threads) = args.threads {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(usize::from(threads)).build_global();
        pool.map_err(|e| Failure::Usage(format!("cannot start {threads} threads: {e}")))?;
    }
    let frames = &match frames::packed(Path::new(&args.input)) {
        Some(_) => frames::find(Path::new(&args.input), args.frames.as_ref())?,
        None => {
            let sequence =
                find_frames(&args.input, args.frames.as_ref()).map_err(|e| plain(&args.input, e))?;
            if !sequence.missing.is_empty() {
                let missing: Vec<String> = sequence.missing.iter().map(i64::to_string).collect();
                warn(&args.input, &format!("frames not there: {}", missing.join(", ")));
            }
            sequence.frames
        }
    };
    let mut jobs = Vec::new();
    for frame in frames {
        let output =
            output_path(&args.output, frame.frame, frames.len() > 1).map_err(|e| plain(&args.output, e))?;
        // A name that cannot be encoded is said before anything is rendered.
        let _ = encoder(&output, args.exr_float)?;
        match output.exists() {
            true if args.resume => {}
            true if !args.overwrite => {
                let what = "the picture is there already; --overwrite replaces it, --resume leaves it out";
                return Err(Failure::file(&output, what));
            }
            _ => jobs.push(Job { input: frame.path.clone(), output }),
        }
    }
    if jobs.is_empty() {
        return Ok(());
    }
    let (shot, mut loaded) = settle(args, frames)?;
    if args.timing {
        note(&shot.describe());
    }
    let bar = progress::bar(jobs.len());
    let mut failed = false;
    for (i, job) in jobs.iter().enumerate() {
        bar.set_message(job.output.display().to_string());
        let show = |done, total| progress::show(&bar, i, done, total);
        if let Err(failure) = render_frame(args, &shot, job, loaded.take(), &show) {
            bar.suspend(|| failure.report());
            failed = true;
        }
    }
    bar.finish_and_clear();
    if failed { Err(Failure::Reported) } else { Ok(()) }
}

fn render_frame(
    args: &Args,
    shot: &Shot<'_>,
    job: &Job,
    loaded: Option<Volume>,
    progress: &(dyn Fn(u32, u32) + Sync),
) -> Result<(), Failure> {
    let start = Instant::now();
    let volume = match loaded {
        Some(volume) => volume,
        None => load(args, &job.input, true)?,
    };
    let read = start.elapsed();
    let image = shot.render(&volume, progress).map_err(|e| Failure::Usage(e.to_string()))?;
    let rendered = start.elapsed();
    let bytes = encoder(&job.output, args.exr_float)?(&image).map_err(|e| plain(&job.output, e))?;
    // What was there is replaced only if that was asked for when it was found.
    write_whole(&job.output, &bytes, args.overwrite).map_err(|e| plain(&job.output, e))?;
    if args.timing {
        note(&format!(
            "{}: read {:.0} ms, render {:.0} ms, write {:.0} ms",
            job.output.display(),
            read.as_secs_f64() * 1e3,
            (rendered - read).as_secs_f64() * 1e3,
            (start.elapsed() - rendered).as_secs_f64() * 1e3
        ));
    }
    Ok(())
}

/// Settles what all frames share, whether they are rendered now or were before. Gives the volume of a single
/// frame along, so that it is not read twice.
fn settle<'a>(args: &'a Args, frames: &[FrameFile]) -> Result<(Shot<'a>, Option<Volume>), Failure> {
    let mut volumes = Vec::new();
    let world_box = if let [frame] = frames {
        let start = Instant::now();
        let volume = load(args, &frame.path, true)?;
        if args.timing {
            note(&format!("read {:.0} ms", start.elapsed().as_secs_f64() * 1e3));
        }
        let boxes = [Some(&volume.density), volume.emission.as_ref()].into_iter().flatten();
        let world_box = boxes.filter_map(WorldBox::of).reduce(WorldBox::union);
        volumes.push(volume);
        world_box
    } else {
        let mut union: Option<WorldBox> = None;
        for frame in frames {
            match header_box(args, &frame.path) {
                Ok(Some(world_box)) => union = Some(union.map_or(world_box, |u| u.union(world_box))),
                Ok(None) => {}
                // The frame itself is reported when its turn comes.
                Err(_) => {}
            }
        }
        if Shot::needs_volumes(&args.look) {
            let count = FITTED_FRAMES.min(frames.len());
            let chosen = (0..count).map(|i| &frames[i * (frames.len() - 1) / (count - 1).max(1)]);
            volumes.extend(chosen.filter_map(|frame| load(args, &frame.path, false).ok()));
        }
        union
    };
    let shot = Shot::new(&args.look, world_box, &volumes).map_err(Failure::Usage)?;
    let loaded = if frames.len() == 1 { volumes.pop() } else { None };
    Ok((shot, loaded))
}

/// The world box of a frame as its header tells it, or if it does not, as its voxels do.
fn header_box(args: &Args, path: &Path) -> Result<Option<WorldBox>, Failure> {
    let disk = DiskFile::open(path)?;
    let file = disk.vdb()?;
    let (density, emission) =
        shot::choose_grids(&file, args.grid.as_deref(), &args.look).map_err(|e| Failure::file(path, e))?;
    let mut union: Option<WorldBox> = None;
    for index in [Some(density), emission].into_iter().flatten() {
        let info = &file.grids[index];
        let bbox = match info.file_bbox() {
            Some(bbox) => Some(bbox),
            None => {
                let grid = file.read_grid(index).map_err(|e| Failure::vdb(path, &e))?;
                grid.tree.statistics().active_bbox
            }
        };
        let Some([min, max]) = bbox else { continue };
        let transform = import::linear_transform(&info.unique_name, &info.transform)
            .map_err(|e| Failure::file(path, e.to_string()))?;
        let world_box = WorldBox::of_index_box(&transform, IndexBox { min: min.into(), max: max.into() });
        union = Some(union.map_or(world_box, |u| u.union(world_box)));
    }
    Ok(union)
}

fn load(args: &Args, path: &Path, warnings: bool) -> Result<Volume, Failure> {
    let disk = DiskFile::open(path)?;
    let file = disk.vdb()?;
    let mut tell = |message: String| {
        if warnings {
            warn(&path.display().to_string(), &message);
        }
    };
    shot::load(&file, args.grid.as_deref(), &args.look, &mut tell).map_err(|e| Failure::file(path, e))
}

type Encode = Box<dyn Fn(&Image) -> Result<Vec<u8>, nuage_render::output::OutputError>>;

/// How a picture of that name is encoded.
fn encoder(path: &Path, exr_float: bool) -> Result<Encode, Failure> {
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    match extension.as_str() {
        "png" => Ok(Box::new(encode_png)),
        "exr" => {
            let precision = if exr_float { ExrPrecision::Float } else { ExrPrecision::Half };
            Ok(Box::new(move |image| encode_exr(image, precision)))
        }
        _ => Err(Failure::Usage(format!("'{}': pictures are written as .png or .exr", path.display()))),
    }
}

fn plain(path: impl AsRef<Path>, error: impl std::fmt::Display) -> Failure {
    Failure::file(path.as_ref(), error.to_string())
}

fn warn(path: &str, message: &str) {
    note(&format!("nuage: {path}: {message}"));
}

/// Writes a line to standard error.
fn note(line: &str) {
    // With standard error gone there is nobody to tell.
    let _ = writeln!(io::stderr(), "{}", crate::text::one_line(line));
}
