//! Pictures made of paths: a film that grows until it is good enough, is kept where that is asked for, and is written with all it
//! knows.
//!
//! What does not live here: which frames are rendered ([`crate::render`]), what is in them ([`crate::shot`]).

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use nuage_pipeline::output::write_whole;
use nuage_pipeline::pack::work::file_digest;
use nuage_render::checkpoint;
use nuage_render::film::{Film, Tally};
use nuage_render::output::exr::ExrPrecision;
use nuage_render::output::layers::encode_layers;
use nuage_render::progressive::{Stopped, Watch};

use crate::denoise;
use crate::error::Failure;
use crate::frames;
use crate::render::{Job, encoder};
use crate::scene_file::{self, RunKeys};
use crate::shot::{Frame, Shot};

/// How often a film is kept.
const KEPT_EVERY: Duration = Duration::from_secs(30);

/// Set by Ctrl-C.
static CANCELLED: AtomicBool = AtomicBool::new(false);

/// Lets Ctrl-C end a render with what there is; a second one ends the program.
///
/// # Errors
/// If the system refuses.
pub(crate) fn watch_for_interrupt() -> Result<(), Failure> {
    let interrupted = || {
        if CANCELLED.swap(true, Ordering::Relaxed) {
            std::process::exit(130);
        }
    };
    ctrlc::set_handler(interrupted).map_err(|e| Failure::Usage(format!("cannot watch for Ctrl-C: {e}")))
}

/// Whether Ctrl-C was pressed.
pub(crate) fn is_cancelled() -> bool {
    CANCELLED.load(Ordering::Relaxed)
}

/// Where the film of a picture is kept.
pub(crate) fn checkpoint_path(picture: &Path) -> PathBuf {
    let mut name = picture.as_os_str().to_owned();
    name.push(".checkpoint");
    name.into()
}

/// A picture that is finished, and how it came to be.
pub(crate) struct Traced {
    /// The file of it.
    pub(crate) bytes: Vec<u8>,
    /// Whether its film was kept, if it was to be. The picture is not lost with it.
    pub(crate) kept: Result<(), Failure>,
    /// Why it ended.
    pub(crate) stopped: Stopped,
    /// The fewest paths of a pixel.
    pub(crate) samples: u32,
    /// What [`Film::noise`] says of it.
    pub(crate) noise: f64,
}

/// Renders a frame. `denoiser` is the program that takes noise away, if one is to.
///
/// # Errors
/// If a checkpoint is of something else, the denoiser fails, or the picture cannot be encoded.
pub(crate) fn render(
    run: &RunKeys,
    shot: &Shot,
    job: &Job,
    frame: &Frame<'_>,
    denoiser: Option<&Path>,
    progress: &(dyn Fn(u32, u32) + Sync),
) -> Result<Traced, Failure> {
    let failed = |what: String| Failure::file(&job.output, what);
    let scene = scene_file::save(shot.plan(), &RunKeys::default(), Path::new(""));
    let [width, height] = shot.size();
    let mut film = Film::new(width, height).map_err(|e| Failure::Usage(e.to_string()))?;
    let mut keeper = None;
    if run.checkpoint {
        let digest = digest(shot, job)?;
        let path = checkpoint_path(&job.output);
        if run.resume && path.exists() {
            film = read(&path, digest)?;
        }
        keeper = Some((path, digest));
    }
    let keep = |film: &Film| match &keeper {
        Some((path, digest)) => {
            let bytes = checkpoint::encode(film, *digest);
            write_whole(path, &bytes, true).map_err(|e| Failure::file(path, e.to_string()))
        }
        None => Ok(()),
    };
    let mut kept = Instant::now();
    let mut pass = |film: &Film| {
        if kept.elapsed() >= KEPT_EVERY {
            // What goes wrong now goes wrong at the end as well, and is said then, unless it is over by then.
            let _ = keep(film);
            kept = Instant::now();
        }
    };
    let tile = |share: f64| progress((share.clamp(0.0, 1.0) * 1000.0) as u32, 1000);
    let mut watch = Watch { cancel: Some(&CANCELLED), tile: Some(&tile), pass: Some(&mut pass) };
    let stopped = shot.trace(frame, &mut film, &mut watch);
    let kept = keep(&film);
    let mut image = shot.before_background(film.image(), frame);
    if let Some(program) = denoiser {
        image = denoise::denoise(program, &image, &film.map(Tally::albedo))?;
    }
    let stops = shot.plan().look.exposure;
    let image = if stops == 0.0 { image } else { image.exposed(stops) };
    let bytes = if run.aovs {
        let precision = if run.exr_float { ExrPrecision::Float } else { ExrPrecision::Half };
        let attributes = [("nuage/scene", scene.as_str()), ("nuage/version", env!("CARGO_PKG_VERSION"))];
        encode_layers(&image, &film.exposed(stops), &attributes, precision)
    } else {
        encoder(&job.output, run.exr_float)?(&image)
    };
    let bytes = bytes.map_err(|e| failed(e.to_string()))?;
    let [samples, _] = film.samples();
    Ok(Traced { bytes, kept, stopped, samples, noise: film.noise() })
}

/// Stands for all that the paths of a frame depend on, and nothing that they do not.
fn digest(shot: &Shot, job: &Job) -> Result<u128, Failure> {
    let mut plan = shot.plan().clone();
    (plan.look.samples, plan.look.noise, plan.look.time) = (None, None, None);
    plan.look.exposure = 0.0;
    let scene = scene_file::save(&plan, &RunKeys::default(), Path::new(""));
    let mut parts = vec![env!("CARGO_PKG_VERSION").as_bytes().to_vec(), scene.into_bytes()];
    for input in job.inputs.iter().flatten() {
        let file = frames::packed(input).map_or_else(|| input.clone(), |(file, _)| file);
        let digest = file_digest(&file).map_err(|e| Failure::file(&file, e.to_string()))?;
        parts.push(input.as_os_str().as_encoded_bytes().to_vec());
        parts.push(digest.to_le_bytes().to_vec());
    }
    Ok(checkpoint::digest(parts.iter().map(Vec::as_slice)))
}

fn read(path: &Path, digest: u128) -> Result<Film, Failure> {
    let failed = |what: String| Failure::file(path, what);
    let size = fs::metadata(path).map_err(|e| failed(e.to_string()))?.len();
    if size > checkpoint::MAX_BYTES {
        return Err(failed("this is too large for a checkpoint".into()));
    }
    let bytes = fs::read(path).map_err(|e| failed(e.to_string()))?;
    checkpoint::decode(&bytes, digest).map_err(|e| failed(e.to_string()))
}
