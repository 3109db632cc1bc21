//! A channel: one field of a volume, its tree placed in the world.

use glam::{DAffine3, IVec3};

use crate::tree::Tree;

/// A box of index coordinates, both ends included.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct IndexBox {
    /// The smallest coordinates.
    pub min: IVec3,
    /// The largest coordinates.
    pub max: IVec3,
}

/// One field of a volume at one time.
#[derive(Debug, Clone)]
pub struct Channel {
    /// The values, zero outside `active_box`.
    pub tree: Tree,
    /// Where index coordinates lie in the world. Invertible.
    pub world_from_index: DAffine3,
    /// The box of the active voxels of the source; `None` if there are none.
    pub active_box: Option<IndexBox>,
}
