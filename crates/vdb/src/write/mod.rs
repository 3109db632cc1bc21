//! Writing files: what stands where in a file, and which grids share a tree.
//!
//! Every position is known before the byte at it is written, so that the sink only has to take bytes in order: each
//! grid is encoded in memory and freed before the next one. How nodes are encoded lives in [`tree`] and [`block`],
//! what is added to the metadata in [`metadata`], transforms in [`transform`]. Files that appear whole or not at all
//! are a matter of those who own file names.

mod block;
mod metadata;
mod parallel;
mod transform;
mod tree;

use std::io::Write;
use std::sync::Arc;

use crate::any::{AnyTree, Grid};
use crate::block::{BlockFormat, Compression};
use crate::error::{Error, Result};
use crate::header::{HALF_SUFFIX, MAGIC, NAME_SEPARATOR, uuid_text};
use crate::metadata::Metadata;
use crate::stats::Fnv1a;
use crate::with_tree;

use tree::EncodedTree;

/// What OpenVDB 6 to 12 write and all since 3.3 read.
const FILE_VERSION: u32 = 224;
/// The first version that knows `half` as a type of values.
const HALF_GRID_VERSION: u32 = 225;
/// Readers look at the version of the library to drop positions for delayed loading that older ones copied from file
/// to file, up to 6.1. This one stands for how the metadata are computed: the memory is what 10.0 would take.
const LIBRARY_VERSION: [u32; 2] = [10, 0];
/// Behind its names and type, a grid has three positions: where its header, its values and what follows it begin.
const POSITIONS_BYTES: u64 = 24;

/// How a file is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct WriteOptions {
    /// How values are compressed, in grids of all classes.
    pub compression: Compression,
}

impl Default for WriteOptions {
    /// Blosc, and only the values of active voxels where the others can be restored, as OpenVDB does.
    fn default() -> Self {
        WriteOptions { compression: Compression::BLOSC }
    }
}

/// Writes a whole file: its metadata, and the grids in their order. Grids that share a tree ([`Arc::ptr_eq`], and the
/// same [`Grid::save_float_as_half`]) are written once, the others as instances.
///
/// What OpenVDB notes in the metadata of grids on writing is computed anew: `file_bbox_min`, `file_bbox_max`,
/// `file_voxel_count`, `file_mem_bytes`, `file_compression`, and `name` and `is_saved_as_half_float`, which follow
/// the fields of [`Grid`]. Equal input gives equal bytes, the file's UUID included.
///
/// # Errors
/// [`Error::Io`] if the sink fails, [`Error::Unsupported`] for grids of points, and [`Error::Misuse`] if the vectors of
/// a tree do not fit each other. Of the latter two nothing has been written yet.
pub fn write(grids: &[Grid], metadata: &Metadata, options: &WriteOptions, out: &mut dyn Write) -> Result<()> {
    let plans = plan(grids, options)?;
    let mut head = head(grids, &plans, metadata)?;
    let mut at = 0;
    for (grid, plan) in grids.iter().zip(&plans) {
        head.extend_from_slice(&plan.descriptor);
        let begin = at + head.len() as u64 + POSITIONS_BYTES;
        let encoded = match plan.parent {
            Some(_) => EncodedTree::default(),
            None => {
                let half = grid.save_float_as_half;
                let format =
                    BlockFormat { compression: options.compression, half, file_version: FILE_VERSION };
                with_tree!(&*grid.tree, tree => tree::encode(tree, format))
            }
        };
        let values_begin = begin + (plan.header.len() + encoded.topology.len()) as u64;
        let end = values_begin + encoded.leaves_bytes();
        // An instance has no values, which OpenVDB notes as a position of zero.
        for position in [begin, if plan.parent.is_some() { 0 } else { values_begin }, end] {
            head.extend_from_slice(&position.to_le_bytes());
        }
        head.extend_from_slice(&plan.header);
        out.write_all(&head)?;
        head.clear();
        out.write_all(&encoded.topology)?;
        for leaves in &encoded.leaves {
            out.write_all(leaves)?;
        }
        at = end;
    }
    out.write_all(&head)?;
    out.flush()?;
    Ok(())
}

/// What is written of a grid besides its tree.
struct Plan {
    /// The grid whose tree is this one's too.
    parent: Option<usize>,
    unique_name: String,
    /// Names and type, up to the positions.
    descriptor: Vec<u8>,
    /// Compression, metadata and transform, from behind the positions up to the tree.
    header: Vec<u8>,
}

/// Checks the grids and prepares everything but the trees.
fn plan(grids: &[Grid], options: &WriteOptions) -> Result<Vec<Plan>> {
    let mut plans: Vec<Plan> = Vec::with_capacity(grids.len());
    for (i, grid) in grids.iter().enumerate() {
        let shares = |other: &Grid| {
            Arc::ptr_eq(&grid.tree, &other.tree) && grid.save_float_as_half == other.save_float_as_half
        };
        let parent = grids[..i].iter().position(shares);
        if let AnyTree::Points(_) = *grid.tree {
            return Err(Error::unsupported(format!("writing grids of points (grid '{}')", grid.name)));
        }
        if parent.is_none() {
            with_tree!(&*grid.tree, tree => tree::check(tree)).map_err(|what| {
                Error::Misuse(format!("the tree of grid '{}' is no tree: {what}", grid.name))
            })?;
        }
        let unique_name = unique_name(grids, &plans, &grid.name);
        let mut descriptor = Vec::new();
        append_text(&unique_name, &mut descriptor)?;
        let half_suffix = if grid.save_float_as_half { HALF_SUFFIX } else { "" };
        append_text(&format!("{}{half_suffix}", grid.tree.grid_type()), &mut descriptor)?;
        append_text(parent.map_or("", |parent| &plans[parent].unique_name), &mut descriptor)?;
        let mut header = options.compression.flags.to_le_bytes().to_vec();
        append_metadata(&metadata::of_grid(grid, options.compression), &mut header)?;
        transform::append(&grid.transform, &mut header)?;
        plans.push(Plan { parent, unique_name, descriptor, header });
    }
    Ok(plans)
}

/// The name, with a number where there are several of that name or it is empty. OpenVDB finds grids by it.
fn unique_name(grids: &[Grid], plans: &[Plan], name: &str) -> String {
    let numbered = |number: usize| format!("{name}{NAME_SEPARATOR}{number}");
    let is_taken = |candidate: &String| plans.iter().any(|plan| plan.unique_name == *candidate);
    let is_shared = name.is_empty() || grids.iter().filter(|grid| grid.name == name).count() > 1;
    let first = if is_shared { numbered(0) } else { name.to_owned() };
    std::iter::once(first)
        .chain((1..).map(numbered))
        .find(|candidate| !is_taken(candidate))
        .unwrap_or_default()
}

/// The file's header up to the first grid.
fn head(grids: &[Grid], plans: &[Plan], metadata: &Metadata) -> Result<Vec<u8>> {
    let has_half = grids.iter().any(|grid| matches!(*grid.tree, AnyTree::Half(_)));
    let version = if has_half { HALF_GRID_VERSION } else { FILE_VERSION };
    let mut tail = Vec::new();
    append_metadata(metadata, &mut tail)?;
    append_count(grids.len(), &mut tail)?;
    let mut head = MAGIC.to_vec();
    for number in [version, LIBRARY_VERSION[0], LIBRARY_VERSION[1]] {
        head.extend_from_slice(&number.to_le_bytes());
    }
    // There are positions.
    head.push(1);
    let uuid = uuid(grids, plans, &tail);
    head.extend_from_slice(uuid.as_bytes());
    head.extend_from_slice(&tail);
    Ok(head)
}

/// An identifier that follows from everything that is written, so that it changes where the file does: a UUID of
/// version 8 (RFC 9562).
fn uuid(grids: &[Grid], plans: &[Plan], tail: &[u8]) -> String {
    let mut hashes = [Fnv1a::default(), Fnv1a::default()];
    hashes[1].add(b"second half");
    let mut add = |bytes: &[u8]| hashes.iter_mut().for_each(|hash| hash.add(bytes));
    add(tail);
    for (grid, plan) in grids.iter().zip(plans) {
        add(&plan.descriptor);
        add(&plan.header);
        if plan.parent.is_none() {
            add(&with_tree!(&*grid.tree, tree => tree::content_hash(tree)).to_le_bytes());
        }
    }
    let mut bytes = [0; 16];
    bytes[..8].copy_from_slice(&hashes[0].0.to_le_bytes());
    bytes[8..].copy_from_slice(&hashes[1].0.to_le_bytes());
    bytes[6] = bytes[6] & 0x0f | 0x80;
    bytes[8] = bytes[8] & 0x3f | 0x80;
    uuid_text(bytes)
}

fn append_metadata(metadata: &Metadata, bytes: &mut Vec<u8>) -> Result<()> {
    append_count(metadata.iter().len(), bytes)?;
    for (name, value) in metadata.iter() {
        append_text(name, bytes)?;
        append_text(&value.type_name, bytes)?;
        append_count(value.bytes.len(), bytes)?;
        bytes.extend_from_slice(&value.bytes);
    }
    Ok(())
}

fn append_text(text: &str, bytes: &mut Vec<u8>) -> Result<()> {
    append_count(text.len(), bytes)?;
    bytes.extend_from_slice(text.as_bytes());
    Ok(())
}

/// A count as files hold it, in 32 bits.
fn append_count(count: usize, bytes: &mut Vec<u8>) -> Result<()> {
    let count =
        u32::try_from(count).map_err(|_| Error::Misuse(format!("{count} is more than a file can count")))?;
    bytes.extend_from_slice(&count.to_le_bytes());
    Ok(())
}

#[cfg(all(test, feature = "parallel"))]
mod tests {
    use super::*;
    use crate::build::TreeBuilder;
    use crate::transform::Transform;
    use crate::tree::Shape;

    #[test]
    fn any_number_of_threads_writes_the_same_bytes() {
        let mut builder = TreeBuilder::new(0.5_f32, Shape::STANDARD);
        for leaf in 0..1000_i32 {
            let value = |i: i32| ((i * i + leaf) % 97) as f32 * 0.1;
            let values: Vec<f32> = (0..512).map(value).collect();
            builder.leaf([leaf % 31 * 8, leaf / 31 * 8, leaf % 7 * 640], &[u64::MAX / 3; 8], &values);
        }
        let grid = Grid {
            name: "a".into(),
            metadata: Metadata::default(),
            transform: Transform::identity(),
            save_float_as_half: false,
            tree: Arc::new(builder.build().unwrap().into()),
        };
        for compression in [Compression::BLOSC, Compression::ZIP] {
            let bytes = |threads| {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
                let mut bytes = Vec::new();
                let grids = std::slice::from_ref(&grid);
                let options = WriteOptions { compression };
                pool.install(|| write(grids, &Metadata::default(), &options, &mut bytes)).unwrap();
                bytes
            };
            let one = bytes(1);
            assert!(one.len() > 100_000);
            for threads in [2, 5] {
                assert!(bytes(threads) == one, "{threads} threads");
            }
        }
    }
}
