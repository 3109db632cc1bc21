//! Packing a sequence: all its frames, looked through for their range, weighed for what errors cost if a ratio or a size
//! is asked for, and then encoded, a few at a time.
//!
//! Memory holds at most a GiB of frames that are wanted again, else as many frames as there are threads, the trees and a
//! digest of each brick. What comes out does not depend on the number of threads.

use std::io::{Seek, Write};
use std::ops::Range;

use nuage_vdb::{Grid, Metadata};
use nuage_volume::format::Asset;

use super::append;
use super::assemble::{AssembleError, Assembler, Report};
use super::frame::{
    EncodeError, EncodedFrame, WeighedChannel, encode_frame, find_shapes, likely_lambdas, settle,
    sure_lambda, weigh_frame,
};
use super::options::{NoSuchChannel, Options};
use super::plan::Plan;
use super::work::{self, Keep, Recipe};
use crate::each;
use crate::encode::choose::{Lambda, Totals};

/// A frame's number, if it has one, and the name of its source.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FrameName {
    /// The number.
    pub number: Option<i64>,
    /// The name, for people.
    pub name: String,
}

/// The grids of a frame and the metadata of its file.
pub type Loaded = (Vec<Grid>, Metadata);

/// Why a sequence cannot be packed.
#[derive(Debug, thiserror::Error)]
pub enum PackError<E> {
    /// A frame cannot be loaded.
    #[error("{0}")]
    Load(E),
    /// Something is asked of a channel that is in no frame.
    #[error(transparent)]
    Channel(#[from] NoSuchChannel),
    /// A frame cannot be encoded.
    #[error(transparent)]
    Encode(#[from] EncodeError),
    /// The file cannot be written.
    #[error(transparent)]
    Assemble(#[from] AssembleError),
}

/// What frames are packed with, apart from what is asked.
#[derive(Clone, Copy, Default)]
pub struct Surroundings<'a> {
    /// The file that frames are added to. It says what is asked ([`append::options`]), and keeps its frame rate.
    pub base: Option<&'a Asset>,
    /// What is noted of where the frames come from.
    pub recipe: Option<&'a Recipe>,
    /// Where finished work is kept.
    pub keep: Option<Keep<'a>>,
}

/// As [`pack_with`], with nothing around.
///
/// # Errors
/// As those of [`pack_with`].
pub fn pack<E: Send, W: Write + Seek + Send>(
    frames: &[FrameName],
    load: impl Fn(usize) -> Result<Loaded, E> + Sync,
    out: W,
    options: &Options,
    frame_rate: Option<f64>,
    done: &mut dyn FnMut(f64),
) -> Result<(Report, Plan), PackError<E>> {
    pack_with(Surroundings::default(), frames, load, out, options, frame_rate, done)
}

/// Packs the frames that `load` gives, by their index, into `out`. `done` is told of each frame that is finished, in
/// any of the passes, as a part of the whole.
///
/// # Errors
/// If a frame cannot be loaded or encoded, a channel that is asked for by name is in none, the file that frames are added to is damaged, or the new one not written.
pub fn pack_with<E: Send, W: Write + Seek + Send>(
    surroundings: Surroundings,
    frames: &[FrameName],
    load: impl Fn(usize) -> Result<Loaded, E> + Sync,
    out: W,
    options: &Options,
    frame_rate: Option<f64>,
    done: &mut dyn FnMut(f64),
) -> Result<(Report, Plan), PackError<E>> {
    let Surroundings { base, recipe, keep } = surroundings;
    let passes = if options.is_weighed() { 3 } else { 2 };
    let mut finished = 0;
    let mut tell = |count: usize| {
        finished += count;
        done(finished as f64 / (passes * frames.len()) as f64);
    };
    // What the passes keep of each frame for the next.
    let mut kept: Vec<Kept> = frames.iter().map(|_| Kept::default()).collect();
    let plan = match keep.and_then(|keep| work::plan(&(keep.load)(work::PLAN)?)) {
        Some(plan) => {
            tell((passes - 1) * frames.len());
            plan
        }
        None => {
            let plan = survey(base, &load, &mut kept, options, &mut tell)?;
            if let Some(keep) = keep {
                (keep.save)(work::PLAN, &work::plan_bytes(&plan));
            }
            plan
        }
    };
    let compress = |bytes: &[u8]| compress(bytes);
    let mut assembler = match base {
        Some(base) => Assembler::onto(out, &compress, base, &plan, options)?,
        None => Assembler::new(out, &compress, &plan, options, frame_rate)?,
    };
    if let Some(recipe) = recipe {
        assembler.note_recipe(recipe.digest);
    }
    // While some frames are encoded, those before them are put into the file.
    let mut before: (Range<usize>, Vec<Result<EncodedFrame, PackError<E>>>) = (0..0, Vec::new());
    for window in windows(frames.len()).chain(std::iter::once(0..0)) {
        let encode = |i: usize| -> Result<EncodedFrame, PackError<E>> {
            let frame = window.start + i;
            let name = work::frame_name(frame);
            if let Some(encoded) = keep.and_then(|keep| work::frame(&(keep.load)(&name)?, &plan)) {
                return Ok(encoded);
            }
            let (grids, metadata) = loaded(&load, &kept[frame], frame)?;
            let encoded = encode_frame(&grids, &metadata, &plan, options, kept[frame].weighed.as_deref())?;
            if let Some(keep) = keep {
                (keep.save)(&name, &work::frame_bytes(&encoded));
            }
            Ok(encoded)
        };
        let (done, encoded_before) = before;
        let add = || -> Result<(), PackError<E>> {
            for (frame, encoded) in done.clone().zip(encoded_before) {
                let FrameName { number, name } = &frames[frame];
                let source = recipe.and_then(|recipe| recipe.sources.get(frame).copied());
                assembler.add(&encoded?, *number, name, source)?;
            }
            Ok(())
        };
        let (encoded, added) = both(|| each(window.len(), encode), add);
        added?;
        kept[window.clone()].fill_with(Kept::default);
        tell(done.len());
        before = (window, encoded);
    }
    Ok((assembler.finish()?, plan))
}

fn loaded<E>(
    load: &impl Fn(usize) -> Result<Loaded, E>,
    kept: &Kept,
    frame: usize,
) -> Result<Loaded, PackError<E>> {
    match &kept.loaded {
        Some(loaded) => Ok(loaded.clone()),
        None => load(frame).map_err(PackError::Load),
    }
}

/// Goes through all frames for their plan, and keeps of them what fits.
fn survey<E: Send>(
    base: Option<&Asset>,
    load: &(impl Fn(usize) -> Result<Loaded, E> + Sync),
    kept: &mut [Kept],
    options: &Options,
    tell: &mut impl FnMut(usize),
) -> Result<Plan, PackError<E>> {
    let mut plan = Plan::default();
    let mut kept_bytes = 0;
    for window in windows(kept.len()) {
        let looked = each(window.len(), |i| -> Result<(Plan, Loaded), PackError<E>> {
            let loaded = load(window.start + i).map_err(PackError::Load)?;
            let mut plan = Plan::default();
            plan.note(&loaded.0);
            Ok((plan, loaded))
        });
        for (frame, looked) in window.clone().zip(looked) {
            let (found, loaded) = looked?;
            plan.merge(found);
            let bytes: u64 = loaded.0.iter().map(|grid| grid.tree.memory_bytes()).sum();
            if kept_bytes == 0 || kept_bytes + bytes <= KEPT_BYTES {
                kept_bytes += bytes;
                kept[frame].loaded = Some(loaded);
            }
        }
        tell(window.len());
    }
    let applied = options.apply(&mut plan);
    match base {
        Some(base) => append::settle(base.contents(), &mut plan),
        // Frames that are added need not have all channels that were asked for.
        None => applied?,
    }
    // Shapes are found in what is at hand: all frames, or the first of a long sequence.
    let samples: Vec<&[Grid]> =
        kept.iter().filter_map(|kept| Some(kept.loaded.as_ref()?.0.as_slice())).collect();
    find_shapes(&samples, &mut plan, options);
    if options.is_weighed() {
        let likely = likely_lambdas(&samples, &plan, options)?;
        let mut lambdas = weigh(load, kept, &plan, options, &likely, tell)?;
        if lambdas.iter().zip(&likely).any(|(lambda, likely)| lambda > likely) {
            let sure: Vec<Lambda> =
                plan.channels.iter().map(|planned| sure_lambda(planned, options)).collect();
            lambdas = weigh(load, kept, &plan, options, &sure, &mut |_| {})?;
        }
        for (channel, lambda) in plan.channels.iter_mut().zip(lambdas) {
            channel.lambda = lambda;
        }
    }
    Ok(plan)
}

/// The λ of each channel over all frames, as long as it is no more than the `largest`; else one that is more. Keeps what was found of frames that are kept.
fn weigh<E: Send>(
    load: &(impl Fn(usize) -> Result<Loaded, E> + Sync),
    kept: &mut [Kept],
    plan: &Plan,
    options: &Options,
    largest: &[Lambda],
    tell: &mut impl FnMut(usize),
) -> Result<Vec<Lambda>, PackError<E>> {
    let mut sums: Vec<Totals> = plan.channels.iter().map(|_| Totals::default()).collect();
    for window in windows(kept.len()) {
        let weighed = each(window.len(), |i| -> Result<_, PackError<E>> {
            let frame = window.start + i;
            Ok(weigh_frame(&loaded(load, &kept[frame], frame)?.0, plan, options, largest, 1)?)
        });
        for (frame, weighed) in window.clone().zip(weighed) {
            let weighed = weighed?;
            weighed.iter().for_each(|found| sums[found.channel].merge(&found.totals));
            if kept[frame].loaded.is_some() {
                kept[frame].weighed = Some(weighed);
            }
        }
        tell(window.len());
    }
    Ok(plan.channels.iter().zip(sums).map(|(channel, sum)| settle(&sum, channel, options)).collect())
}

/// Does two things, at the same time where the feature `parallel` says so.
fn both<A: Send, B: Send>(a: impl FnOnce() -> A + Send, b: impl FnOnce() -> B + Send) -> (A, B) {
    #[cfg(feature = "parallel")]
    {
        rayon::join(a, b)
    }
    #[cfg(not(feature = "parallel"))]
    {
        (a(), b())
    }
}

/// What the passes keep of a frame: its grids, and the curves of their bricks.
#[derive(Default)]
struct Kept {
    loaded: Option<Loaded>,
    weighed: Option<Vec<WeighedChannel>>,
}

/// Frames are kept from one pass to the next as long as all that are kept have no more bytes of values than this;
/// others are loaded and measured again. What is noted of their bricks takes a tenth beside that.
const KEPT_BYTES: u64 = 1 << 30;

/// A zstd frame of some bytes, or nothing if it cannot be made.
#[cfg(feature = "native-zstd")]
pub fn compress(bytes: &[u8]) -> Vec<u8> {
    /// Higher levels take long and give little on codes.
    const LEVEL: i32 = 6;
    // It fails for lack of memory only; the bytes are then stored as they are.
    zstd::bulk::compress(bytes, LEVEL).unwrap_or_default()
}

/// A zstd frame of some bytes.
#[cfg(not(feature = "native-zstd"))]
pub fn compress(bytes: &[u8]) -> Vec<u8> {
    ruzstd::encoding::compress_to_vec(bytes, ruzstd::encoding::CompressionLevel::Fastest)
}

/// The frames by as many as are worked on at once.
fn windows(count: usize) -> impl Iterator<Item = Range<usize>> {
    #[cfg(feature = "parallel")]
    let width = rayon::current_num_threads().max(1);
    #[cfg(not(feature = "parallel"))]
    let width = 1;
    (0..count).step_by(width).map(move |begin| begin..count.min(begin + width))
}
