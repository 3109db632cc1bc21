//! Packing a sequence: all its frames, looked through for their range, weighed for what errors cost if a ratio or a size
//! is asked for, and then encoded, a few at a time.
//!
//! Memory holds as many frames as there are threads, the trees and a digest of each brick. What comes out does not
//! depend on the number of threads.

use std::borrow::Cow;
use std::io::{Seek, Write};

use nuage_vdb::{Grid, Metadata};

use super::assemble::{AssembleError, Assembler, Report};
use super::frame::{ChannelTotals, EncodeError, EncodedFrame, encode_frame, frame_totals};
use super::options::{NoSuchChannel, Options};
use super::plan::Plan;
use crate::encode::choose::Lambda;

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

/// Packs the frames that `load` gives, by their index, into `out`. `done` is told of each frame that is finished, in
/// any of the passes, as a part of the whole.
///
/// # Errors
/// If a frame cannot be loaded or encoded, a channel that is asked for by name is in none, or the file cannot be written.
pub fn pack<E: Send, W: Write + Seek>(
    frames: &[FrameName],
    load: impl Fn(usize) -> Result<Loaded, E> + Sync,
    out: W,
    options: &Options,
    frame_rate: Option<f64>,
    done: &mut dyn FnMut(f64),
) -> Result<(Report, Plan), PackError<E>> {
    // A still is loaded once.
    let kept = match frames.len() {
        1 => Some(load(0).map_err(PackError::Load)?),
        _ => None,
    };
    let with_frame = |frame: usize| match &kept {
        Some(kept) => Ok(Cow::Borrowed(kept)),
        None => load(frame).map(Cow::Owned).map_err(PackError::Load),
    };
    let is_weighed = options.is_weighed();
    let passes = if is_weighed { 3 } else { 2 };
    let mut finished = 0;
    let mut tell = |count: usize| {
        finished += count;
        done(finished as f64 / (passes * frames.len()) as f64);
    };

    let mut plan = Plan::default();
    for window in windows(frames.len()) {
        let looked = each(window.clone(), |frame| -> Result<Plan, PackError<E>> {
            let mut plan = Plan::default();
            plan.note(&with_frame(frame)?.0);
            Ok(plan)
        });
        looked.into_iter().try_for_each(|found| found.map(|found| plan.merge(found)))?;
        tell(window.len());
    }
    options.apply(&mut plan)?;
    if is_weighed {
        let mut sums: Vec<Option<ChannelTotals>> = vec![None; plan.channels.len()];
        for window in windows(frames.len()) {
            let weighed = each(window.clone(), |frame| -> Result<_, PackError<E>> {
                Ok(frame_totals(&with_frame(frame)?.0, &plan, options))
            });
            for totals in weighed {
                for found in totals? {
                    let sum = &mut sums[found.channel];
                    match sum {
                        Some(sum) => sum.merge(&found),
                        None => *sum = Some(found),
                    }
                }
            }
            tell(window.len());
        }
        for (channel, sum) in plan.channels.iter_mut().zip(sums) {
            channel.lambda = sum.map_or(Lambda::NONE, |sum| sum.lambda(channel, options));
        }
    }
    let compress = |bytes: &[u8]| compress(bytes);
    let mut assembler = Assembler::new(out, &compress, &plan, options, frame_rate)?;
    for window in windows(frames.len()) {
        let encoded = each(window.clone(), |frame| -> Result<EncodedFrame, PackError<E>> {
            let loaded = with_frame(frame)?;
            Ok(encode_frame(&loaded.0, &loaded.1, &plan, options)?)
        });
        for (frame, encoded) in window.clone().zip(encoded) {
            assembler.add(&encoded?, frames[frame].number, &frames[frame].name)?;
        }
        tell(window.len());
    }
    Ok((assembler.finish()?, plan))
}

/// A zstd frame of some bytes, or nothing if it cannot be made.
#[cfg(feature = "native-zstd")]
pub fn compress(bytes: &[u8]) -> Vec<u8> {
    /// Higher levels take long and give little on codes.
    const LEVEL: i32 = 12;
    // It fails for lack of memory only; the bytes are then stored as they are.
    zstd::bulk::compress(bytes, LEVEL).unwrap_or_default()
}

/// A zstd frame of some bytes.
#[cfg(not(feature = "native-zstd"))]
pub fn compress(bytes: &[u8]) -> Vec<u8> {
    ruzstd::encoding::compress_to_vec(bytes, ruzstd::encoding::CompressionLevel::Fastest)
}

/// The frames by as many as are worked on at once.
fn windows(count: usize) -> impl Iterator<Item = std::ops::Range<usize>> {
    #[cfg(feature = "parallel")]
    let width = rayon::current_num_threads().max(1);
    #[cfg(not(feature = "parallel"))]
    let width = 1;
    (0..count).step_by(width).map(move |begin| begin..count.min(begin + width))
}

fn each<R: Send>(range: std::ops::Range<usize>, run: impl Fn(usize) -> R + Sync + Send) -> Vec<R> {
    #[cfg(feature = "parallel")]
    {
        use rayon::prelude::*;
        range.into_par_iter().map(run).collect()
    }
    #[cfg(not(feature = "parallel"))]
    {
        range.map(run).collect()
    }
}
