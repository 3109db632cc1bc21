//! `nuage render`: one file, or a sequence of them, to pictures.

use std::borrow::Cow;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::time::Instant;

use glam::DAffine3;
use nuage_pipeline::import;
use nuage_pipeline::output::write_whole;
use nuage_pipeline::sequence::{FrameFile, FrameRange, SequenceError, find_frames, output_path};
use nuage_render::film::Image;
use nuage_render::framing::WorldBox;
use nuage_render::output::exr::{ExrPrecision, encode_exr};
use nuage_render::output::png::encode_png;
use nuage_render::progressive::Stopped;
use nuage_volume::channel::IndexBox;

use crate::denoise;
use crate::device::{self, Gpu};
use crate::error::Failure;
use crate::frames;
use crate::look::{Filter, Integrator, Look, View};
use crate::plan::{Given, Plan, SkyPlan, VolumePlan, What};
use crate::progress;
use crate::scene_file::{self, RunKeys};
use crate::shot::{self, Shot, Volume};
use crate::source::DiskFile;
use crate::trace::{self, Traced, checkpoint_path};

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
    #[arg(required_unless_present = "scene")]
    input: Option<String>,

    /// Where to write: .png (sRGB, 8 bit) or .exr (linear); for a sequence with ####, %04d or $F4
    #[arg(short, long, value_name = "FILE", required_unless_present = "scene")]
    output: Option<String>,

    /// A scene file (TOML) that says what is rendered; options given beside it overrule it
    ///
    /// It can hold several volumes, homogeneous ones among them, and more kinds of lights than there are options. A lone
    /// volume of it is meant by INPUT and by the options of medium and emission.
    #[arg(long, value_name = "FILE")]
    scene: Option<PathBuf>,

    /// Write a scene file that says what is rendered, automatic values settled, and then render
    #[arg(long, value_name = "FILE")]
    save_scene: Option<PathBuf>,

    /// Frames to render, as in 1-100, 1-100x2 or 5,10-20; negative numbers too
    #[arg(long, value_name = "RANGE", allow_hyphen_values = true)]
    frames: Option<FrameRange>,

    /// The density grid [default: density, else the first fog volume, level set or float grid]
    #[arg(long, value_name = "NAME")]
    grid: Option<String>,

    /// Replace pictures that are there
    #[arg(long)]
    overwrite: bool,

    /// Leave out frames whose picture is there; with --checkpoint, go on with those that are kept
    #[arg(long, conflicts_with = "overwrite")]
    resume: bool,

    /// With --integrator path, keep what is traced beside the picture, as PICTURE.checkpoint, so that --resume can add to it
    #[arg(long)]
    checkpoint: bool,

    /// With --integrator path, write an .exr of several layers: light given off, scattered once and more often, albedo,
    /// depth, transmittance, standard errors, number of paths; and the scene in its head
    #[arg(long)]
    aovs: bool,

    /// With --integrator path, have Open Image Denoise (the program oidnDenoise, where installed) take the noise away
    #[arg(long)]
    denoise: bool,

    /// Write EXR with 32-bit floats in place of 16-bit ones
    #[arg(long)]
    exr_float: bool,

    /// Threads to use [default: one per core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,

    /// What renders: cpu, gpu for the best graphics card, or a part of a card's name
    #[arg(long, value_name = "DEVICE", default_value = "cpu")]
    device: String,

    /// Print how long each part took, and the settled camera and scales
    #[arg(long)]
    timing: bool,

    #[command(flatten)]
    look: Look,
}

/// A frame to be rendered.
pub(crate) struct Job {
    /// The files of the volumes, in the order of the plan; nothing for those that come from no file.
    pub(crate) inputs: Vec<Option<PathBuf>>,
    pub(crate) output: PathBuf,
    /// Whether it may be there already.
    replaces: bool,
}

/// The number of a frame, and the files of its volumes.
type FrameInputs = (Option<i64>, Vec<Option<PathBuf>>);

/// What the frames of one volume are.
enum Files {
    /// It comes from no file.
    None,
    /// One file for all frames.
    One(PathBuf),
    Sequence(Vec<FrameFile>),
}

/// Renders. `given` are the options that stand on the command line.
pub(crate) fn run(args: &Args, given: &Given) -> Result<(), Failure> {
    let (plan, mut run) = match &args.scene {
        Some(path) => {
            let (mut plan, run) = scene_file::read(path, &args.look, given)?;
            plan.overrule(given, args.input.as_deref(), args.grid.as_deref()).map_err(Failure::Usage)?;
            (plan, run)
        }
        None => {
            let input = args.input.as_deref().unwrap_or_default();
            (Plan::of_look(&args.look, input, args.grid.as_deref()), RunKeys::default())
        }
    };
    overrule(&mut run, args);
    if let Some(threads) = run.threads {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(usize::from(threads)).build_global();
        pool.map_err(|e| Failure::Usage(format!("cannot start {threads} threads: {e}")))?;
    }
    let Some(output) = run.output.as_deref() else {
        return Err(Failure::Usage("the scene names no picture to write: give --output".into()));
    };
    let gpu = device::open(&args.device)?;
    let is_traced = plan.look.integrator == Integrator::Path && gpu.is_none();
    check_device(gpu.is_some(), &plan.look, &run).map_err(Failure::Usage)?;
    check(&plan.look, &run, Path::new(output)).map_err(Failure::Usage)?;
    let denoiser = if run.denoise { Some(denoise::find()?) } else { None };
    let frames = find_inputs(&plan, run.frames.as_ref())?;
    let mut jobs = Vec::new();
    for (number, inputs) in &frames {
        let output = output_path(output, *number, frames.len() > 1).map_err(|e| plain(output, e))?;
        // A name that cannot be encoded is said before anything is rendered.
        let _ = encoder(&output, run.exr_float)?;
        match output.exists() {
            true if run.resume && run.checkpoint && checkpoint_path(&output).exists() => {
                jobs.push(Job { inputs: inputs.clone(), output, replaces: true });
            }
            true if run.resume => {}
            true if !run.overwrite => {
                let what = "the picture is there already; --overwrite replaces it, --resume leaves it out";
                return Err(Failure::file(&output, what));
            }
            _ => jobs.push(Job { inputs: inputs.clone(), output, replaces: run.overwrite }),
        }
    }
    if jobs.is_empty() && args.save_scene.is_none() {
        return Ok(());
    }
    // Settled from all frames, whether they are rendered now or were before.
    let (world_box, mut volumes) = look_at(&plan, &run, &frames)?;
    let loaded: Vec<Vec<Option<&Volume>>> =
        volumes.iter().map(|frame| frame.iter().map(Option::as_ref).collect()).collect();
    let mut shot = Shot::of_plan(plan, world_box, &loaded).map_err(Failure::Usage)?;
    if let SkyPlan::Map { file, .. } = shot.plan().sky.clone() {
        let (size, texels) = picture(Path::new(&file))?;
        shot.light_by(size, texels).map_err(|e| plain(&file, e))?;
    }
    if run.timing {
        note(&shot.describe());
    }
    if let Some(path) = &args.save_scene {
        let text = scene_file::save(shot.plan(), &run, path.parent().unwrap_or(Path::new("")));
        write_whole(path, text.as_bytes(), run.overwrite).map_err(|e| plain(path, e))?;
    }
    let mut loaded = if frames.len() == 1 { volumes.pop() } else { None };
    if is_traced {
        trace::watch_for_interrupt()?;
    }
    let bar = progress::bar(jobs.len());
    let mut failed = false;
    for (i, job) in jobs.iter().enumerate() {
        bar.set_message(job.output.display().to_string());
        let show = |done, total| progress::show(&bar, i, done, total);
        if let Err(failure) =
            render_frame(&run, &shot, job, loaded.take(), denoiser.as_deref(), gpu.as_ref(), &show)
        {
            if let Failure::Usage(_) = failure {
                return Err(failure);
            }
            bar.suspend(|| failure.report());
            failed = true;
        }
        if trace::is_cancelled() {
            failed = true;
            break;
        }
    }
    bar.finish_and_clear();
    if failed { Err(Failure::Reported) } else { Ok(()) }
}

/// Puts the options over what the scene file says of the run.
fn overrule(run: &mut RunKeys, args: &Args) {
    if args.output.is_some() {
        run.output.clone_from(&args.output);
    }
    if args.frames.is_some() {
        run.frames.clone_from(&args.frames);
    }
    if args.overwrite || args.resume {
        (run.overwrite, run.resume) = (args.overwrite, args.resume);
    }
    run.exr_float |= args.exr_float;
    run.threads = args.threads.or(run.threads);
    run.timing |= args.timing;
    run.checkpoint |= args.checkpoint;
    run.aovs |= args.aovs;
    run.denoise |= args.denoise;
}

/// What only paths have is not asked of other integrators, and layers not of a .png.
fn check(look: &Look, run: &RunKeys, output: &Path) -> Result<(), String> {
    let of_paths = [
        ("--noise", look.noise.is_some()),
        ("--time", look.time.is_some()),
        ("--checkpoint", run.checkpoint),
        ("--aovs", run.aovs),
        ("--denoise", run.denoise),
    ];
    if look.view.is_some() && look.integrator == Integrator::Path {
        return Err("--view shows no light: leave out --integrator path".into());
    }
    if look.view.is_some() && (look.lod > 0 || look.filter != Filter::default()) {
        return Err("--view shows voxels as they are: leave out --lod and --filter".into());
    }
    if let Some((name, _)) = of_paths.iter().find(|(_, is_asked)| *is_asked)
        && look.integrator != Integrator::Path
    {
        return Err(format!("{name} is for --integrator path"));
    }
    let is_exr = output.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("exr"));
    if run.aovs && !is_exr {
        return Err("--aovs takes an .exr: a .png has no layers".into());
    }
    Ok(())
}

/// What only the processor does is not asked of a GPU.
fn check_device(has_gpu: bool, look: &Look, run: &RunKeys) -> Result<(), String> {
    let of_the_processor = [
        ("--noise", look.noise.is_some()),
        ("--time", look.time.is_some()),
        ("--checkpoint", run.checkpoint),
        ("--aovs", run.aovs),
        ("--denoise", run.denoise),
        ("--seed", look.seed != 0),
    ];
    match of_the_processor.iter().find(|(_, is_asked)| has_gpu && *is_asked) {
        Some((name, _)) => Err(format!("{name} is for --device cpu")),
        None => Ok(()),
    }
}

/// The frames to be rendered, each with its number and the files of its volumes.
fn find_inputs(plan: &Plan, range: Option<&FrameRange>) -> Result<Vec<FrameInputs>, Failure> {
    let is_alone = plan.volumes.len() == 1;
    let found = plan.volumes.iter().map(|volume| match &volume.what {
        What::File { input, .. } => files(input, range, is_alone),
        What::Box { .. } | What::Sphere { .. } => Ok(Files::None),
    });
    let found: Vec<Files> = found.collect::<Result<_, _>>()?;
    let sequence = found.iter().find_map(|files| match files {
        Files::Sequence(frames) => Some(frames),
        Files::None | Files::One(_) => None,
    });
    if let (None, Some(_)) = (sequence, range) {
        return Err(Failure::Usage("--frames is for sequences, and the scene has none".into()));
    }
    let numbers: Vec<Option<i64>> = match sequence {
        Some(frames) => frames.iter().map(|frame| frame.frame).collect(),
        None => vec![None],
    };
    let inputs = |number: Option<i64>| -> Result<Vec<Option<PathBuf>>, Failure> {
        let input = |(files, volume): (&Files, &VolumePlan)| match files {
            Files::None => Ok(None),
            Files::One(path) => Ok(Some(path.clone())),
            Files::Sequence(frames) => match frames.iter().find(|frame| frame.frame == number) {
                Some(frame) => Ok(Some(frame.path.clone())),
                None => {
                    let What::File { input, .. } = &volume.what else { return Ok(None) };
                    let number = number.map_or(String::new(), |number| format!(" {number}"));
                    Err(plain(
                        input,
                        format!("frame{number} of another volume is not there; --frames leaves it out"),
                    ))
                }
            },
        };
        found.iter().zip(&plan.volumes).map(input).collect()
    };
    numbers.into_iter().map(|number| Ok((number, inputs(number)?))).collect()
}

/// The files of a volume. If it is not the only one, it may be one file where a range of frames is asked for.
fn files(input: &str, range: Option<&FrameRange>, is_alone: bool) -> Result<Files, Failure> {
    let as_files = |frames: Vec<FrameFile>| match <[FrameFile; 1]>::try_from(frames) {
        Ok([FrameFile { frame: None, path }]) => Files::One(path),
        Ok(frame) => Files::Sequence(frame.into()),
        Err(frames) => Files::Sequence(frames),
    };
    if frames::packed(Path::new(input)).is_some() {
        return Ok(as_files(frames::find(Path::new(input), range)?));
    }
    let found = match find_frames(input, range) {
        Err(SequenceError::RangeOfOneFile { .. }) if !is_alone => find_frames(input, None),
        found => found,
    };
    let sequence = found.map_err(|e| plain(input, e))?;
    if !sequence.missing.is_empty() {
        let missing: Vec<String> = sequence.missing.iter().map(i64::to_string).collect();
        warn(input, &format!("frames not there: {}", missing.join(", ")));
    }
    Ok(as_files(sequence.frames))
}

fn render_frame(
    run: &RunKeys,
    shot: &Shot,
    job: &Job,
    loaded: Option<Vec<Option<Volume>>>,
    denoiser: Option<&Path>,
    gpu: Option<&Gpu>,
    progress: &(dyn Fn(u32, u32) + Sync),
) -> Result<(), Failure> {
    let start = Instant::now();
    let mut volumes = match loaded {
        Some(volumes) => volumes,
        None => load(shot.plan(), &job.inputs, true)?,
    };
    for volume in volumes.iter_mut().flatten() {
        volume.coarsen(shot.plan().look.lod).map_err(Failure::Usage)?;
    }
    let volumes: Vec<Option<&Volume>> = volumes.iter().map(Option::as_ref).collect();
    if let Some(what) = shot.unsupported(&volumes) {
        return Err(Failure::Usage(what));
    }
    let read = start.elapsed();
    let traced = match shot.plan().look.integrator {
        Integrator::Path if gpu.is_none() => {
            Some(trace::render(run, shot, job, &volumes, denoiser, progress)?)
        }
        Integrator::Path | Integrator::March => None,
    };
    let bytes = match &traced {
        Some(traced) => Cow::Borrowed(&traced.bytes),
        None => {
            let image = match gpu {
                Some(gpu) => shot.render_frame_on(gpu, &volumes, progress),
                None => shot.render_frame(&volumes, progress).map_err(|e| e.to_string()),
            };
            let image = image.map_err(Failure::Usage)?;
            Cow::Owned(encoder(&job.output, run.exr_float)?(&image).map_err(|e| plain(&job.output, e))?)
        }
    };
    let rendered = start.elapsed();
    // What was there is replaced only if that was asked for when it was found.
    write_whole(&job.output, &bytes, job.replaces).map_err(|e| plain(&job.output, e))?;
    if let Some(Traced { samples, noise, stopped, .. }) = &traced
        && (run.timing || *stopped == Stopped::Cancelled)
    {
        let why = match stopped {
            Stopped::Samples => "",
            Stopped::Noise => ", the noise that was asked for",
            Stopped::Time => ", time was up",
            Stopped::Cancelled => ", called off",
        };
        note(&format!("{}: {samples} paths per pixel, noise {noise:.4}{why}", job.output.display()));
    }
    if run.timing {
        note(&format!(
            "{}: read {:.0} ms, render {:.0} ms, write {:.0} ms",
            job.output.display(),
            read.as_secs_f64() * 1e3,
            (rendered - read).as_secs_f64() * 1e3,
            (start.elapsed() - rendered).as_secs_f64() * 1e3
        ));
    }
    traced.map_or(Ok(()), |traced| traced.kept)
}

/// The volumes of some frames.
type Volumes = Vec<Vec<Option<Volume>>>;

/// The box of all frames, and the volumes of some of them by which scales are settled. Those of a single frame are always
/// there, so that they are not read twice.
fn look_at(
    plan: &Plan,
    run: &RunKeys,
    frames: &[FrameInputs],
) -> Result<(Option<WorldBox>, Volumes), Failure> {
    if let [(_, inputs)] = frames {
        let start = Instant::now();
        let volumes = load(plan, inputs, true)?;
        if run.timing {
            note(&format!("read {:.0} ms", start.elapsed().as_secs_f64() * 1e3));
        }
        let boxes = volumes.iter().flatten().filter_map(Volume::world_box);
        return Ok((boxes.reduce(WorldBox::union), vec![volumes]));
    }
    let mut union: Option<WorldBox> = None;
    for (_, inputs) in frames {
        for (volume, path) in plan.volumes.iter().zip(inputs) {
            // A frame that cannot be read is reported when its turn comes.
            if let Some(Ok(Some(world_box))) =
                path.as_ref().map(|path| header_box(volume, plan.look.view, path))
            {
                union = Some(union.map_or(world_box, |u| u.union(world_box)));
            }
        }
    }
    let mut volumes = Vec::new();
    if plan.needs_volumes() {
        let count = FITTED_FRAMES.min(frames.len());
        let chosen = (0..count).filter_map(|i| frames.get(i * (frames.len() - 1) / (count - 1).max(1)));
        volumes.extend(chosen.filter_map(|(_, inputs)| load(plan, inputs, false).ok()));
    }
    Ok((union, volumes))
}

/// The world box of a volume as the header of its file tells it, or if that does not, as its voxels do.
fn header_box(volume: &VolumePlan, view: Option<View>, path: &Path) -> Result<Option<WorldBox>, Failure> {
    let disk = DiskFile::open(path)?;
    let file = disk.vdb()?;
    let (grid, glowing) = names(volume);
    let (density, emission) =
        shot::choose_grids(&file, grid, glowing, view).map_err(|e| Failure::file(path, e))?;
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
        let transform = match volume.transform == DAffine3::IDENTITY {
            true => transform,
            false => volume.transform * transform,
        };
        let world_box = WorldBox::of_index_box(&transform, IndexBox { min: min.into(), max: max.into() });
        union = Some(union.map_or(world_box, |u| u.union(world_box)));
    }
    Ok(union)
}

/// The names of the density grid and of the grid that glows.
fn names(volume: &VolumePlan) -> (Option<&str>, Option<&str>) {
    let grid = match &volume.what {
        What::File { grid, .. } => grid.as_deref(),
        What::Box { .. } | What::Sphere { .. } => None,
    };
    (grid, volume.emission.as_ref().and_then(|emission| emission.grid.as_deref()))
}

/// Reads the volumes of a frame.
fn load(plan: &Plan, inputs: &[Option<PathBuf>], warnings: bool) -> Result<Vec<Option<Volume>>, Failure> {
    let load = |(volume_plan, path): (&VolumePlan, &Option<PathBuf>)| {
        let Some(path) = path else { return Ok(None) };
        let disk = DiskFile::open(path)?;
        let file = disk.vdb()?;
        let mut tell = |message: String| {
            if warnings {
                warn(&path.display().to_string(), &message);
            }
        };
        let (grid, glowing) = names(volume_plan);
        let mut volume = shot::load_grids(&file, grid, glowing, plan.look.view, &mut tell)
            .map_err(|e| Failure::file(path, e))?;
        volume.transform(&volume_plan.transform);
        Ok(Some(volume))
    };
    plan.volumes.iter().zip(inputs).map(load).collect()
}

/// The size and the pixels of a picture in OpenEXR.
fn picture(path: &Path) -> Result<([u32; 2], Vec<[f32; 3]>), Failure> {
    use exr::prelude::{ReadChannels, ReadLayers};
    type Pixels = (usize, Vec<[f32; 3]>);
    // Opened by ourselves: a folder or a pipe is refused, and so is a header that asks for too much.
    let disk = DiskFile::open_plain(path)?;
    let bytes =
        nuage_volume::format::ReadAt::range(&disk, 0, usize::try_from(disk.size()).unwrap_or(usize::MAX));
    let bytes = bytes.map_err(|e| plain(path, e))?;
    let meta = exr::meta::MetaData::read_from_buffered(bytes.as_ref(), false).map_err(|e| plain(path, e))?;
    for header in &meta.headers {
        let [width, height] = [header.layer_size.width(), header.layer_size.height()];
        let side = |side: usize| u32::try_from(side).unwrap_or(u32::MAX);
        nuage_render::film::pixel_count(side(width), side(height)).map_err(|e| plain(path, e))?;
    }
    let read = exr::prelude::read()
        .no_deep_data()
        .largest_resolution_level()
        .rgb_channels(
            |size, _| -> Pixels { (size.width(), vec![[0.0; 3]; size.width() * size.height()]) },
            |(width, pixels): &mut Pixels, at, (r, g, b): (f32, f32, f32)| {
                if let Some(pixel) = pixels.get_mut(at.y() * *width + at.x()) {
                    *pixel = [r, g, b];
                }
            },
        )
        .first_valid_layer()
        .all_attributes()
        .from_buffered(io::Cursor::new(bytes.as_ref()))
        .map_err(|e| plain(path, e))?;
    let (width, pixels) = read.layer_data.channel_data.pixels;
    let height = pixels.len() / width.max(1);
    let side = |side: usize| u32::try_from(side).unwrap_or(0);
    Ok(([side(width), side(height)], pixels))
}

pub(crate) type Encode = Box<dyn Fn(&Image) -> Result<Vec<u8>, nuage_render::output::OutputError>>;

/// How a picture of that name is encoded.
pub(crate) fn encoder(path: &Path, exr_float: bool) -> Result<Encode, Failure> {
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
