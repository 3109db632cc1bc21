//! NanoVDB: reading and writing `.nvdb` files.
//!
//! ```no_run
//! use nuage_vdb::nano;
//!
//! let file = nano::File::open(std::fs::read("smoke.nvdb")?)?;
//! let density = file.read_grid(file.find("density").ok_or("no density")?)?;
//! let mut bytes = Vec::new();
//! let options = nano::WriteOptions { encoding: nano::Encoding::Fp8, ..Default::default() };
//! nano::write(&[density], &options, &mut bytes)?;
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! A NanoVDB grid is a block of memory that a program can use as it is: fixed structures of little-endian
//! numbers, aligned to 32 bytes, that point to each other by relative offsets. Here it is taken apart into a
//! [`crate::Tree`], so that it can be used like a grid of a `.vdb` file, and put together from one. What is
//! read: versions 32.3 to 32.9, files of any number of segments and bare grids, without compression, with ZIP
//! or Blosc; values of the types `float`, `double`, `int16` (as `int32`), `int32`, `int64`, `Vec3f`, `Vec3d`,
//! `bool` and `Mask`, and the quantised `Fp4`, `Fp8`, `Fp16` and `FpN` (as `float`). Grids of other types are
//! listed, and refused when asked for. What is written: version 32.4, which all of these read.
//!
//! `file` reads headers and brings a grid's block of memory, `layout` says what stands where in it, `read`
//! makes a tree of it; `write` frames grids that `build` lays out with the values of `encode` and the
//! statistics of `stats`; `quantize` holds the codes of the quantised types. The tree itself and the codecs
//! live elsewhere in this crate.
//!
//! Source of the layout: the public headers `NanoVDB.h` and `io/IO.h` of
//! <https://github.com/AcademySoftwareFoundation/openvdb/tree/master/nanovdb/nanovdb>.

mod build;
mod encode;
mod file;
mod layout;
mod quantize;
mod read;
mod stats;
mod write;

pub use file::{Codec, File, GridInfo};
pub use write::{Encoding, WriteOptions, write};
