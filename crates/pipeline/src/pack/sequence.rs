//! Packing a sequence: all its frames, looked through once and then encoded, a few at a time.
//!
//! Memory holds as many frames as there are threads, the trees and a digest of each brick. What comes out does not
//! depend on the number of threads.

use std::io::{Seek, Write};

use nuage_vdb::{Grid, Metadata};

use super::assemble::{AssembleError, Assembler, Report};
use super::frame::{EncodeError, EncodedFrame, Options, encode_frame};
use super::plan::Plan;

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
    /// A frame cannot be encoded.
    #[error(transparent)]
    Encode(#[from] EncodeError),
    /// The file cannot be written.
    #[error(transparent)]
    Assemble(#[from] AssembleError),
}

/// Packs the frames that `load` gives, by their index, into `out`. `done` is told of each frame that is finished, in
/// either of the two passes, as a part of the whole.
///
/// # Errors
/// If a frame cannot be loaded or encoded, or the file not written.
pub fn pack<E: Send, W: Write + Seek>(
    frames: &[FrameName],
    load: impl Fn(usize) -> Result<Loaded, E> + Sync,
    out: W,
    options: &Options,
    frame_rate: Option<f64>,
    done: &mut dyn FnMut(f64),
) -> Result<(Report, Plan), PackError<E>> {
    let steps = 2 * frames.len();
    let mut plan = Plan::default();
    // A still is loaded once.
    let mut kept = None;
    for window in windows(frames.len()) {
        let looked = each(window.clone(), |frame| {
            let loaded = load(frame)?;
            let mut plan = Plan::default();
            plan.note(&loaded.0);
            Ok((plan, (frames.len() == 1).then_some(loaded)))
        });
        for result in looked {
            let (found, loaded) = result.map_err(PackError::Load)?;
            plan.merge(found);
            kept = loaded;
        }
        done(window.end as f64 / steps as f64);
    }
    let compress = |bytes: &[u8]| compress(bytes);
    let mut assembler = Assembler::new(out, &compress, &plan, options, frame_rate)?;
    for window in windows(frames.len()) {
        let encoded = each(window.clone(), |frame| -> Result<EncodedFrame, PackError<E>> {
            let loaded;
            let (grids, metadata) = match &kept {
                Some(kept) => kept,
                None => {
                    loaded = load(frame).map_err(PackError::Load)?;
                    &loaded
                }
            };
            Ok(encode_frame(grids, metadata, &plan, options)?)
        });
        for (frame, encoded) in window.clone().zip(encoded) {
            assembler.add(&encoded?, frames[frame].number, &frames[frame].name)?;
        }
        done((frames.len() + window.end) as f64 / steps as f64);
    }
    Ok((assembler.finish()?, plan))
}

/// A zstd frame of some bytes.
#[cfg(feature = "native-zstd")]
pub fn compress(bytes: &[u8]) -> Vec<u8> {
    /// Higher levels take long and give little on codes.
    const LEVEL: i32 = 12;
    // It fails for lack of memory only; what is empty is stored as it is.
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
