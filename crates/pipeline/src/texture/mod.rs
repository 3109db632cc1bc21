//! The bricks of a packed volume as a 3D texture, for engines that draw volumes with their own code.
//!
//! [`layout`] says where a brick stands in the texture; [`build`] fills it and lists the bricks of each frame; [`dds`] and
//! [`ktx2`] are files of the texels, [`sidecar`] is the JSON with all the rest. `docs/texture.md` describes both for
//! whoever reads them.
//!
//! What does not live here: how texture blocks are encoded ([`crate::encode`]), and trees, which stay behind: a frame is
//! a list of its bricks, of which an engine makes the structure that it likes.

pub mod build;
pub mod dds;
pub mod ktx2;
pub mod layout;
pub mod sidecar;

#[cfg(test)]
mod tests;
