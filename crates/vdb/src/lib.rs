//! Reads and writes OpenVDB files in pure, safe Rust.
//!
//! ```no_run
//! let bytes = std::fs::read("smoke.vdb")?;
//! let file = nuage_vdb::File::open(bytes)?;
//! for grid in &file.grids {
//!     println!("{}: {}, {}", grid.unique_name, grid.grid_type, grid.grid_class());
//! }
//! let density = file.read_grid(file.find("density").ok_or("no density")?)?;
//! println!("{} active voxels", density.tree.statistics().active_voxels);
//! println!("{:?}", density.tree.voxel([1, 2, 3]));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! What is read: float grids of the standard 5-4-3 tree, also saved as half, from file version 222 on (OpenVDB
//! 3 to 13), with ZIP, Blosc or no compression and with or without active masks; all metadata and transforms;
//! shared trees; files written as streams. Other grid types are listed and refused with
//! [`Error::Unsupported`] when asked for.
//!
//! What is written, by [`write()`]: grids of all these types but points, on trees of any shape, in the format of
//! OpenVDB 6 to 12.
//!
//! What to expect of a bad file: an [`Error`] that says what is wrong and at which byte; never a panic, and
//! never more memory than [`Limits`] allows.
//!
//! The crate does no I/O of its own: [`File::open`] takes the bytes, or anything that is a [`Source`] of them.
//!
//! What does not live here: a packed form for rendering (crate `nuage-volume`), any meaning of a grid as a
//! medium (crate `nuage-pipeline`).

#![forbid(unsafe_code)]

mod any;
mod block;
mod build;
mod codec;
mod error;
mod file;
mod header;
mod limits;
mod mask;
mod metadata;
pub mod points;
mod read;
mod source;
mod stats;
mod transform;
mod tree;
mod value;
mod write;

pub use any::{AnyTree, AnyVoxel, Grid};
pub use block::Compression;
pub use build::TreeBuilder;
pub use error::{Error, Result};
pub use file::File;
pub use header::{GridInfo, NEWEST_VERSION, OLDEST_VERSION};
pub use limits::Limits;
pub use mask::Mask;
pub use metadata::{MetaValue, Metadata, format_g};
pub use source::Source;
pub use stats::{ComponentStatistics, Histogram, IndexBox, Statistics};
pub use transform::{Map, Matrix4, Transform};
pub use tree::{
    Branching, InternalNode, LEAF_VOXELS, LEVEL4, LEVEL5, Leaves, RootTile, Shape, Tiles, Tree, Voxel,
    leaf_offset,
};
pub use value::{LeafValues, PointOffset, Value, ValueMask};
pub use write::{WriteOptions, write};
