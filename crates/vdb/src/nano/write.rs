//! Writing `.nvdb` files: the choice of an encoding for each grid, and the frame around the grids.
//!
//! Each grid gets a segment of its own, so that only one is in memory at a time. Its bytes are made in
//! `build`.

use std::io::Write;

use flate2::Compression;
use flate2::write::ZlibEncoder;

use super::build::{self, LeafEncoder, ROOT, VERSION};
use super::encode;
use super::file::Codec;
use super::layout::{self, Kind, Layout};
use super::quantize::{self, Quantizer};
use super::stats::NanoValue;
use crate::any::{AnyTree, Grid};
use crate::error::{Error, Result};
use crate::tree::{Shape, Tree};

/// How the voxels of float grids are stored. Tiles, the background and grids of other types are always in
/// full width.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub enum Encoding {
    /// As they are.
    #[default]
    Full,
    /// 16 bits per voxel, spread over the values of each leaf.
    Fp16,
    /// 8 bits per voxel.
    Fp8,
    /// 4 bits per voxel.
    Fp4,
    /// The fewest of 1, 2, 4, 8 and 16 bits, leaf by leaf, that keep all values within an error; 16 if none
    /// do.
    FpN {
        /// The largest difference between a value and what is stored for it.
        max_error: f32,
    },
}

/// How grids are written.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct WriteOptions {
    /// How the voxels of float grids are stored.
    pub encoding: Encoding,
    /// How the file is compressed.
    pub codec: Codec,
}

/// Writes grids as a NanoVDB file of version 32.4: `float`, `double`, `int32`, `int64`, `bool`, `mask`,
/// `vec3s` and `vec3d` as what they are, `half` as `float`. Of the metadata only the class is kept, where
/// NanoVDB allows it with that type of values. The same grids give the same bytes.
///
/// # Errors
/// [`Error::Unsupported`] for other types, trees of another shape than the standard one, transforms that are
/// not affine, and [`Codec::Blosc`]. [`Error::Misuse`] if there are no grids, a name has a zero in it, a
/// transform has no inverse, or a leaf cannot be quantised because its values are not all finite or too far
/// apart. [`Error::Io`] if `out` fails.
pub fn write(grids: &[Grid], options: &WriteOptions, out: &mut dyn Write) -> Result<()> {
    if grids.is_empty() {
        return Err(Error::Misuse("a NanoVDB file cannot be without grids".into()));
    }
    for grid in grids {
        if grid.name.contains('\0') {
            return Err(Error::Misuse(format!("the name {:?} of a grid has a zero in it", grid.name)));
        }
        let bytes = grid_bytes(grid, options.encoding)?;
        write_segment(grid, &bytes, options.codec, out)?;
    }
    Ok(())
}

fn grid_bytes(grid: &Grid, encoding: Encoding) -> Result<Vec<u8>> {
    if grid.tree.shape() != Shape::STANDARD {
        return Err(Error::unsupported(format!(
            "{} (grid '{}') in NanoVDB files",
            grid.grid_type(),
            grid.name
        )));
    }
    match &*grid.tree {
        AnyTree::Float(tree) => float(grid, tree, encoding),
        AnyTree::Half(tree) => float(grid, &tree.map(f32::from), encoding),
        AnyTree::Double(tree) => full(grid, tree),
        AnyTree::Int32(tree) => full(grid, tree),
        AnyTree::Int64(tree) => full(grid, tree),
        AnyTree::Bool(tree) => full(grid, tree),
        AnyTree::Mask(tree) => full(grid, tree),
        AnyTree::Vec3s(tree) => full(grid, tree),
        AnyTree::Vec3d(tree) => full(grid, tree),
        AnyTree::Vec3i(_) | AnyTree::Points(_) => {
            Err(Error::unsupported(format!("{} (grid '{}') in NanoVDB files", grid.grid_type(), grid.name)))
        }
    }
}

fn full<V: NanoValue>(grid: &Grid, tree: &Tree<V>) -> Result<Vec<u8>> {
    let leaf_bytes = Layout::of(V::KIND).leaf_bytes(V::KIND);
    let leaf = LeafEncoder { bytes: &|_| leaf_bytes, encode: &|i, bytes| encode::leaf(tree, i, bytes) };
    build::grid(grid, tree, V::KIND, &leaf)
}

fn float(grid: &Grid, tree: &Tree<f32>, encoding: Encoding) -> Result<Vec<u8>> {
    let (kind, max_error) = match encoding {
        Encoding::Full => return full(grid, tree),
        Encoding::Fp16 => (Kind::Fp16, 0.0),
        Encoding::Fp8 => (Kind::Fp8, 0.0),
        Encoding::Fp4 => (Kind::Fp4, 0.0),
        Encoding::FpN { max_error } => (Kind::FpN, max_error),
    };
    let quantizer = |i: usize| {
        let values = tree.leaves.stored(i);
        let found = match kind.code_bits() {
            Some(bits) => Quantizer::covering(values, bits),
            None => quantize::narrowest(values, max_error),
        };
        found.ok_or_else(|| {
            Error::Misuse(format!(
                "the leaf at {:?} of grid '{}' cannot be quantised: not all finite, or too far apart",
                tree.leaves.origins[i], grid.name
            ))
        })
    };
    let quantizers = quantizers(tree.leaves.len(), quantizer)?;
    let leaf = LeafEncoder {
        bytes: &|i| layout::LEAF_CODES + layout::code_bytes(quantizers[i].bits),
        encode: &|i, bytes| encode::quantised_leaf(tree, i, kind, &quantizers[i], bytes),
    };
    build::grid(grid, tree, kind, &leaf)
}

fn quantizers(
    count: usize,
    quantizer: impl Fn(usize) -> Result<Quantizer> + Send + Sync,
) -> Result<Vec<Quantizer>> {
    #[cfg(feature = "parallel")]
    {
        use rayon::prelude::*;
        (0..count).into_par_iter().with_min_len(64).map(quantizer).collect()
    }
    #[cfg(not(feature = "parallel"))]
    (0..count).map(quantizer).collect()
}

/// Writes a segment with one grid.
fn write_segment(grid: &Grid, bytes: &[u8], codec: Codec, out: &mut dyn Write) -> Result<()> {
    let compressed;
    let stored = match codec {
        Codec::None => bytes,
        Codec::Zip => {
            compressed = zip(bytes)?;
            &compressed
        }
        Codec::Blosc => return Err(Error::unsupported("writing NanoVDB files with Blosc")),
    };
    let mut head = Vec::with_capacity(layout::SEGMENT_BYTES + layout::META_BYTES + grid.name.len() + 1);
    head.extend_from_slice(&layout::MAGIC_OLD.to_le_bytes());
    head.extend_from_slice(&VERSION.to_le_bytes());
    head.extend_from_slice(&1_u16.to_le_bytes());
    head.extend_from_slice(&codec.number().to_le_bytes());

    let begin = head.len();
    for number in [bytes.len() as u64, stored.len() as u64, name_hash(&grid.name)] {
        head.extend_from_slice(&number.to_le_bytes());
    }
    let mut copy = |at: usize, len: usize| head.extend_from_slice(&bytes[at..at + len]);
    copy(layout::TREE_VOXEL_COUNT, 8);
    copy(layout::GRID_TYPE, 4);
    copy(layout::GRID_CLASS, 4);
    copy(layout::GRID_WORLD_BOX, 48);
    // The box of the root.
    copy(ROOT, 24);
    copy(layout::GRID_VOXEL_SIZE, 24);
    let name_bytes = u32::try_from(grid.name.len() + 1)
        .map_err(|_| Error::Misuse(format!("a name of {} bytes", grid.name.len())))?;
    head.extend_from_slice(&name_bytes.to_le_bytes());
    head.extend_from_slice(&bytes[layout::TREE_NODE_COUNTS..][..12]);
    // There is one root.
    head.extend_from_slice(&1_u32.to_le_bytes());
    head.extend_from_slice(&bytes[layout::TREE_NODE_COUNTS + 12..][..12]);
    head.extend_from_slice(&codec.number().to_le_bytes());
    head.extend_from_slice(&[0; 2]);
    head.extend_from_slice(&VERSION.to_le_bytes());
    debug_assert_eq!(head.len() - begin, layout::META_BYTES);
    head.extend_from_slice(grid.name.as_bytes());
    head.push(0);
    out.write_all(&head)?;
    out.write_all(stored)?;
    Ok(())
}

/// One zlib stream behind its size.
fn zip(bytes: &[u8]) -> Result<Vec<u8>> {
    let mut encoder = ZlibEncoder::new(vec![0; 8], Compression::default());
    encoder.write_all(bytes)?;
    let mut stream = encoder.finish()?;
    let size = (stream.len() - 8) as u64;
    encode::put(&mut stream, 0, &size.to_le_bytes());
    Ok(stream)
}

/// The hash by which NanoVDB finds names: times 67 plus the next byte and the byte that falls out at the top.
fn name_hash(name: &str) -> u64 {
    name.bytes().fold(0, |hash: u64, byte| {
        hash.wrapping_mul(67).wrapping_add(u64::from(byte)).wrapping_add(hash >> 56)
    })
}
