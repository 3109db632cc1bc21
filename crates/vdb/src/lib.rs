//! Reads and writes OpenVDB files, and NanoVDB's, in pure, safe Rust.
//!
//! ```no_run
//! let bytes = std::fs::read("smoke.vdb")?;
//! let file = nuage_vdb::File::open(bytes)?;
//! for grid in &file.grids {
//!     println!("{}: {}, {}", grid.unique_name, grid.grid_type, grid.grid_class());
//! }
//! let density = file.read_grid(file.find("density").ok_or("no density")?)?;
//! println!("{} active voxels", density.tree.active_voxel_count());
//! println!("{:?}", density.tree.voxel([1, 2, 3]));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! A [`Grid`] holds a tree of some type of values, an [`AnyTree`]; inside is a [`Tree`] whose nodes and leaves are flat
//! vectors to go through. One grid of a file is read without the others, and a box of one without the rest of it:
//!
//! ```no_run
//! # let file = nuage_vdb::File::open(std::fs::read("smoke.vdb")?)?;
//! let part = file.read_grid_in_box(0, [[0, 0, 0], [63, 63, 63]])?;
//! if let Some(tree) = part.tree.as_float() {
//!     for (origin, values) in tree.leaves.origins.iter().zip(tree.leaves.values.chunks_exact(512)) {
//!         println!("leaf at {origin:?}: {} to start with", values[0]);
//!     }
//! }
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! A grid of one's own is built from leaves and tiles, and written:
//!
//! ```
//! use nuage_vdb::{Grid, Metadata, Shape, Transform, TreeBuilder, WriteOptions};
//!
//! let mut builder = TreeBuilder::new(0.0_f32, Shape::STANDARD);
//! builder.leaf([0, 0, 0], &[u64::MAX; 8], &[0.5; 512]);
//! let grid = Grid::new("density", Transform::uniform_scale(0.1), builder.build()?);
//! let mut bytes = Vec::new();
//! nuage_vdb::write(&[grid], &Metadata::default(), &WriteOptions::default(), &mut bytes)?;
//! # assert!(nuage_vdb::File::open(bytes)?.grids[0].is_readable());
//! # Ok::<(), nuage_vdb::Error>(())
//! ```
//!
//! What to expect of a bad file: an [`Error`] that says what is wrong and at which byte; never a panic, and
//! never more memory than [`Limits`] allows.
//!
//! The crate does no I/O of its own: [`File::open`] takes the bytes, or anything that is a [`Source`] of them, such as a
//! file on disk of which it then asks for no more than it needs. Leaves are decoded and encoded in parallel by the
//! feature `parallel`, which is on by default.
//!
#![doc = include_str!("../SUPPORT.md")]
//!
//! What does not live here: a packed form for rendering (crate `nuage-volume`), any meaning of a grid as a
//! medium (crate `nuage-pipeline`).

#![forbid(unsafe_code)]

mod any;
mod any_file;
mod block;
mod build;
mod codec;
pub mod diff;
mod error;
mod file;
mod header;
mod limits;
mod mask;
mod metadata;
pub mod nano;
pub mod points;
mod read;
mod source;
mod stats;
mod transform;
mod tree;
pub mod validate;
mod value;
mod write;

pub use any::{AnyTree, AnyVoxel, Grid};
pub use any_file::AnyFile;
pub use block::Compression;
pub use build::TreeBuilder;
pub use error::{Error, Result};
pub use file::File;
pub use header::{GridInfo, NEWEST_VERSION, OLDEST_VERSION};
pub use limits::Limits;
pub use mask::Mask;
pub use metadata::{MetaValue, Metadata, format_g};
pub use source::Source;
pub use stats::{ComponentStatistics, Histogram, IndexBox, Statistics, TileCount};
pub use transform::{Map, Matrix4, Transform};
pub use tree::{
    Branching, InternalNode, LEAF_VOXELS, LEVEL4, LEVEL5, Leaves, RootTile, Shape, Tiles, Tree, Voxel,
    leaf_offset,
};
pub use value::{LeafValues, PointOffset, Value, ValueMask};
pub use write::{WriteOptions, write};
