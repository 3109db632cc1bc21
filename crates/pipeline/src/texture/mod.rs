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

use build::BrickTexture;

/// The kinds of texture file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Container {
    /// A .dds file.
    Dds,
    /// A .ktx2 file.
    Ktx2,
}

impl Container {
    /// The kind of file that an extension stands for, whatever its case.
    pub fn of_extension(extension: &str) -> Option<Container> {
        match extension.to_ascii_lowercase().as_str() {
            "dds" => Some(Container::Dds),
            "ktx2" => Some(Container::Ktx2),
            _ => None,
        }
    }

    /// The file of a texture: a header and the texels.
    pub fn file(self, texture: BrickTexture) -> Vec<u8> {
        let header = match self {
            Container::Dds => dds::header(&texture.layout),
            Container::Ktx2 => ktx2::header(&texture.layout),
        };
        let mut bytes = texture.bytes;
        bytes.splice(0..0, header);
        bytes
    }
}

#[cfg(test)]
mod tests;
