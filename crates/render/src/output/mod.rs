//! Pictures as files in memory: [`png`] for looking at, [`exr`] for measuring and compositing, [`layers`]
//! with all that a film knows beside the picture. The encoders return bytes and know no file system; the same
//! picture always gives the same bytes.
//!
//! Exposure and backgrounds are applied before ([`film`](crate::film)); the transfer curve is
//! [`color`](crate::color)'s.

pub mod exr;
pub mod layers;
pub mod png;

use crate::film::{Image, ImageSizeError, pixel_count};

/// Why a picture could not be encoded.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum OutputError {
    /// No such picture can exist.
    #[error(transparent)]
    Size(#[from] ImageSizeError),
    /// The caller passed something that makes no picture.
    #[error("{0}")]
    Misuse(String),
    /// The encoder refused.
    #[error("cannot encode the picture as {format}: {reason}")]
    Encode {
        /// The file format.
        format: &'static str,
        /// What the encoder says.
        reason: String,
    },
}

/// Refuses a picture whose size is impossible or whose pixels are not as many as its size says.
fn check(image: &Image) -> Result<(), OutputError> {
    let (expected, found) = (pixel_count(image.width, image.height)?, image.pixels.len());
    if found == expected {
        return Ok(());
    }
    let (width, height) = (image.width, image.height);
    Err(OutputError::Misuse(format!("a picture of {width} x {height} needs {expected} pixels, not {found}")))
}
