//! The packed volume: a 5-4-3 tree over bricks of 8³ voxels in flat arrays.
//!
//! Modules from the bottom up: [`space`] (address arithmetic), [`brick`] (voxel values), [`tree`] (the arrays
//! and single look-ups), [`accessor`] (fast look-ups and interpolation), [`build`] (from bricks and tiles to a
//! tree), [`channel`] (a tree in the world).
//!
//! ```
//! use glam::{IVec3, Vec3};
//! use nuage_volume::{accessor::Accessor, brick::{BrickSummary, Bricks}, build::TreeBuilder};
//!
//! let values = [0.5; 512];
//! let mut builder = TreeBuilder::new();
//! builder.brick(IVec3::ZERO, BrickSummary::of(&values))?;
//! let tree = builder.finish(Bricks::F32(values.to_vec()))?;
//! let mut accessor = Accessor::new(&tree);
//! assert_eq!(accessor.trilinear(Vec3::splat(3.2)), 0.5);
//! assert_eq!(accessor.trilinear(Vec3::new(7.5, 0.0, 0.0)), 0.25);
//! # Ok::<(), nuage_volume::build::BuildError>(())
//! ```
//!
//! A voxel's value sits at its integer index coordinate. Everything that is not stored is zero: whatever a
//! source's background is, its importer has resolved it.
//!
//! What does not live here: files, threads, the meaning of values as a medium, and rendering.

#![forbid(unsafe_code)]

pub mod accessor;
pub mod brick;
pub mod build;
pub mod channel;
pub mod codec;
pub mod format;
pub mod packed;
pub mod space;
pub mod tree;
