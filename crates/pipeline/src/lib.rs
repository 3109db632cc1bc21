//! From sources to volumes: what an OpenVDB grid means as a medium, and how sequences lie on disk.
//!
//! [`import`] turns a decoded grid into a channel of the packed volume; [`select`] finds the grid that a user
//! means; [`encode`] puts bricks into fewer bytes, [`cluster`] finds those that can share their values, and [`pack`]
//! makes packed volumes of frames; [`eval`] has what they are held against; [`texture`] lays bricks out as a 3D texture
//! for engines of others; with the feature `fs`, [`sequence`] turns `smoke.####.vdb` into frames and [`output`] writes
//! files that appear whole or not at all.
//!
//! What does not live here: decoding of .vdb bytes (crate `nuage-vdb`), the volume itself (`nuage-volume`),
//! lights, cameras and pictures (`nuage-render`).

#![forbid(unsafe_code)]

pub mod cluster;
pub mod encode;
pub mod eval;
pub mod import;
#[cfg(feature = "fs")]
pub mod output;
pub mod pack;
pub mod select;
#[cfg(feature = "fs")]
pub mod sequence;
pub mod texture;

/// The results for 0 up to `count`, in order, on all threads where the feature `parallel` says so.
pub(crate) fn each<R: Send>(count: usize, run: impl Fn(usize) -> R + Sync + Send) -> Vec<R> {
    #[cfg(feature = "parallel")]
    {
        use rayon::prelude::*;
        (0..count).into_par_iter().map(run).collect()
    }
    #[cfg(not(feature = "parallel"))]
    {
        (0..count).map(run).collect()
    }
}
