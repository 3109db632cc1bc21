//! From the values of bricks to fewer bytes, which `nuage_volume::codec` decodes.
//!
//! What does not live here: which encoding a volume should have, and files.

mod bc4;
pub mod block;
