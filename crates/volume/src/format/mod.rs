//! The file format of packed volumes, `.nuage`: contents, trees and bricks in checked, compressed chunks.
//!
//! From the bottom up: [`source`] (where bytes come from), `layout` (header, table of contents, one chunk), `predict`, `entropy` and
//! `page` (the words of bricks), `arrays` (those of trees), [`contents`] (channels and frames), [`mod@read`] and
//! [`mod@write`]. The specification is `docs/format.md`.
//!
//! What does not live here: files on disk, the encoder of Zstandard, and how bricks are encoded.

mod arrays;
mod check;
pub mod contents;
mod entropy;
mod error;
mod layout;
mod page;
mod predict;
pub mod read;
pub mod source;
pub mod write;

pub use contents::{Asked, AskedOfChannel, ChannelInfo, Contents, Encoding, Frame, FrameGrid, Quality, Role};
pub use error::{FormatError, Limits};
pub use layout::{Kind, reseal};
pub use read::{Asset, MemoryBytes};
pub use source::ReadAt;
pub use write::{Summary, Writer, write};

#[cfg(test)]
mod tests;
