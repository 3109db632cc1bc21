//! Opening `.nvdb` files: segments, what they say of each grid, and a grid's bytes without compression.
//!
//! A file is a row of segments, and a segment a header, a description of each grid with its name, and the
//! grids; a file can also be nothing but grids one after the other. What a grid's bytes mean lives in `read`
//! and `layout`.

use std::borrow::Cow;
use std::io::Read;

use flate2::read::ZlibDecoder;

use super::layout::{self, Kind};
use super::read;
use crate::any::Grid;
use crate::codec::{Scratch, blosc};
use crate::error::{Error, Result};
use crate::limits::{Budget, Limits};
use crate::source::{Reader, Source};
use crate::stats::IndexBox;

/// How the grids of a segment are compressed.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum Codec {
    /// Not at all.
    #[default]
    None,
    /// Each grid as one zlib stream.
    Zip,
    /// Each grid as Blosc chunks of up to 1 GiB.
    Blosc,
}

impl Codec {
    pub(super) fn number(self) -> u16 {
        match self {
            Codec::None => 0,
            Codec::Zip => 1,
            Codec::Blosc => 2,
        }
    }
}

/// What a file says of a grid before one reads it.
#[derive(Debug, Clone, PartialEq)]
pub struct GridInfo {
    /// The name.
    pub name: String,
    /// The type of the values as NanoVDB calls it: `float`, `Vec3f`, `Fp8`, `OnIndex`, …
    pub value_type: &'static str,
    /// `"level set"`, `"fog volume"`, `"staggered"` or `"unknown"`, which includes classes that `.vdb` files
    /// lack.
    pub grid_class: &'static str,
    /// The version of the format: major, minor, patch.
    pub version: [u32; 3],
    /// How the grid is compressed.
    pub codec: Codec,
    /// The size of the grid without compression.
    pub size_bytes: u64,
    /// Active voxels, those of tiles included.
    pub active_voxels: u64,
    /// The box of all active voxels and tiles.
    pub active_bbox: Option<IndexBox>,
    /// The size of a voxel in world units.
    pub voxel_size: [f64; 3],
    /// The numbers of nodes: leaves, lower and upper inner nodes, roots.
    pub node_counts_leaf_to_root: [u32; 4],
    type_number: u32,
    /// Where the grid's bytes stand in the file.
    range: [u64; 2],
}

impl GridInfo {
    /// Whether the values are of a type that this crate reads.
    pub fn is_readable(&self) -> bool {
        Kind::from_number(self.type_number).is_some()
    }
}

/// An open NanoVDB file: what it says of its grids, and the source to read them from.
pub struct File<S> {
    source: S,
    limits: Limits,
    /// The grids in the order of the file.
    pub grids: Vec<GridInfo>,
}

impl<S: Source> File<S> {
    /// Reads the headers of a file with the default [`Limits`].
    ///
    /// # Errors
    /// If the source fails, the bytes are no NanoVDB file or a damaged one, or the version is not supported.
    pub fn open(source: S) -> Result<Self> {
        Self::open_with(source, Limits::default())
    }

    /// Reads the headers of a file. The limits hold for opening and for each grid read later.
    ///
    /// # Errors
    /// As [`File::open`], and if a limit is passed.
    pub fn open_with(source: S, limits: Limits) -> Result<Self> {
        let mut reader = Reader::new(&source, 0, u64::MAX)?;
        let mut budget = Budget::new(&limits);
        let mut grids = Vec::new();
        if reader.u64("a NanoVDB file's first bytes")? == layout::MAGIC_GRID {
            reader.seek(0);
            bare_grids(&mut reader, &mut grids, &mut budget)?;
        } else {
            reader.seek(0);
            while reader.left() > 0 {
                segment(&mut reader, &mut grids, &mut budget)?;
            }
        }
        drop(reader);
        Ok(File { source, limits, grids })
    }

    /// The first grid of that name.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.grids.iter().position(|grid| grid.name == name)
    }

    /// Reads the voxels of grid `index`, without reading those of any other. Quantised and 16-bit values come
    /// in the types that hold them exactly: `float` and `int32`.
    ///
    /// # Errors
    /// If the source fails, the bytes are damaged, the type of the grid is not supported, a limit is passed,
    /// or there is no such grid.
    pub fn read_grid(&self, index: usize) -> Result<Grid> {
        let info = self
            .grids
            .get(index)
            .ok_or_else(|| Error::Misuse(format!("there is no grid {index}, only {}", self.grids.len())))?;
        let kind = Kind::from_number(info.type_number).ok_or_else(|| {
            Error::unsupported(format!(
                "NanoVDB grids of type '{}' ({}) (grid '{}')",
                info.value_type, info.type_number, info.name
            ))
        })?;
        let mut budget = Budget::new(&self.limits);
        let [begin, end] = info.range;
        let file_bytes = memory_size(end - begin)?;
        budget.take(file_bytes, 1, "the bytes of a grid")?;
        let stored = self.source.range(begin, file_bytes)?;
        let bytes = decompress(&stored, info, &mut budget)?;
        let (transform, metadata, tree) = read::grid(&bytes, begin, kind, &mut budget)?;
        let mut grid = Grid::new(&info.name, transform, tree);
        grid.metadata = metadata;
        Ok(grid)
    }

    /// Reads all grids.
    ///
    /// # Errors
    /// As [`File::read_grid`]. The memory limit holds for each grid on its own.
    pub fn read_all(&self) -> Result<Vec<Grid>> {
        (0..self.grids.len()).map(|index| self.read_grid(index)).collect()
    }
}

fn memory_size(bytes: u64) -> Result<usize> {
    usize::try_from(bytes).map_err(|_| Error::unsupported(format!("grids of {bytes} bytes on this machine")))
}

fn check_version(version: u32) -> Result<[u32; 3]> {
    // Versions before 32.3 were never part of a release of that major version, later ones may differ in ways
    // that nobody knows yet.
    match layout::unpack_version(version) {
        known @ [32, 3..=9, _] => Ok(known),
        [major, minor, patch] => {
            Err(Error::unsupported(format!("version {major}.{minor}.{patch} of the NanoVDB format")))
        }
    }
}

/// Reads what a segment says of its grids, and moves past them.
fn segment(reader: &mut Reader<'_>, grids: &mut Vec<GridInfo>, budget: &mut Budget) -> Result<()> {
    let magic = reader.u64("a segment's header")?;
    if magic.swap_bytes() == layout::MAGIC_OLD || magic.swap_bytes() == layout::MAGIC_FILE {
        return Err(Error::unsupported("NanoVDB files of big-endian machines"));
    }
    if magic != layout::MAGIC_OLD && magic != layout::MAGIC_FILE {
        return Err(Error::malformed(reader.offset() - 8, "no NanoVDB file: the magic number is missing"));
    }
    let version = check_version(reader.u32("a segment's version")?)?;
    let count = reader.u16("the number of grids")?;
    let codec = match reader.u16("a segment's codec")? {
        0 => Codec::None,
        1 => Codec::Zip,
        2 => Codec::Blosc,
        other => return Err(Error::unsupported(format!("codec {other} of NanoVDB files"))),
    };
    let mut sizes = Vec::new();
    for _ in 0..count {
        let size_bytes = reader.u64("the size of a grid")?;
        sizes.push(reader.u64("the size of a grid in the file")?);
        reader.skip(8, "the hash of a grid's name")?;
        let active_voxels = reader.u64("the number of active voxels")?;
        let type_number = reader.u32("the type of a grid")?;
        let grid_class = layout::class_name(reader.u32("the class of a grid")?);
        reader.skip(48, "the box of a grid in the world")?;
        let active_bbox = index_box(reader)?;
        let voxel_size = reader.vec3d("the size of a voxel")?;
        let name_bytes = reader.u32("the size of a grid's name")?;
        let mut node_counts_leaf_to_root = [0; 4];
        for count in &mut node_counts_leaf_to_root {
            *count = reader.u32("the number of nodes")?;
        }
        // Active tiles per level, the codec once more, what was padding once, the version once more.
        reader.skip(20, "the description of a grid")?;
        let name = name(reader, name_bytes)?;
        // Three times for the growth of the vectors.
        budget.take(3, size_of::<GridInfo>() + 8, "the descriptions of grids")?;
        budget.take(1, name.len(), "the names of grids")?;
        grids.push(GridInfo {
            name,
            value_type: layout::type_name(type_number),
            grid_class,
            version,
            codec,
            size_bytes,
            active_voxels,
            active_bbox,
            voxel_size,
            node_counts_leaf_to_root,
            type_number,
            range: [0; 2],
        });
    }
    let first = grids.len() - usize::from(count);
    for (info, size) in grids[first..].iter_mut().zip(sizes) {
        let begin = reader.offset();
        reader.skip(size, "a grid")?;
        info.range = [begin, reader.offset()];
    }
    Ok(())
}

/// A name that ends at a zero.
fn name(reader: &mut Reader<'_>, max_bytes: u32) -> Result<String> {
    const MAX_NAME_BYTES: u32 = 1 << 20;
    if max_bytes > MAX_NAME_BYTES {
        return Err(reader.malformed(format!("a name of {max_bytes} bytes")));
    }
    let bytes = reader.take(max_bytes as usize, "the name of a grid")?;
    let len = bytes.iter().position(|byte| *byte == 0).unwrap_or(bytes.len());
    Ok(String::from_utf8_lossy(&bytes[..len]).into_owned())
}

/// A box of coordinates; an empty one has its ends the wrong way round.
fn index_box(reader: &mut Reader<'_>) -> Result<Option<IndexBox>> {
    let bbox = [reader.coord("the box of a grid")?, reader.coord("the box of a grid")?];
    Ok(Some(bbox).filter(|[min, max]| (0..3).all(|i| min[i] <= max[i])))
}

/// Reads what grids that stand in the file without a header say of themselves.
fn bare_grids(reader: &mut Reader<'_>, grids: &mut Vec<GridInfo>, budget: &mut Budget) -> Result<()> {
    let mut count = 1;
    while (grids.len() as u64) < u64::from(count) {
        let begin = reader.offset();
        let at = |field: usize| begin.saturating_add(field as u64);
        if reader.u64("a grid")? != layout::MAGIC_GRID {
            return Err(Error::malformed(begin, "no NanoVDB grid: the magic number is missing"));
        }
        reader.seek(at(layout::GRID_VERSION));
        let version = check_version(reader.u32("a grid's version")?)?;
        let flags = reader.u32("a grid's flags")?;
        reader.seek(at(layout::GRID_COUNT));
        count = reader.u32("the number of grids")?;
        let size_bytes = reader.u64("the size of a grid")?;
        let left = reader.left().saturating_add(reader.offset() - begin);
        if size_bytes > left {
            return Err(reader.malformed(format!("a grid of {size_bytes} bytes where there are {left}")));
        }
        let mut name = name(reader, layout::SHORT_NAME_BYTES as u32)?;
        reader.seek(at(layout::GRID_VOXEL_SIZE));
        let voxel_size = reader.vec3d("the size of a voxel")?;
        let grid_class = layout::class_name(reader.u32("the class of a grid")?);
        let type_number = reader.u32("the type of a grid")?;
        let blind_at = reader.i64("the place of a grid's blind data")?;
        let blind_count = reader.u32("the number of a grid's blind data")?;
        reader.seek(at(layout::TREE + 24));
        let root_at = reader.i64("the place of the root")?;
        let mut node_counts_leaf_to_root = [0, 0, 0, 1];
        for count in &mut node_counts_leaf_to_root[..3] {
            *count = reader.u32("the number of nodes")?;
        }
        reader.seek(at(layout::TREE_VOXEL_COUNT));
        let active_voxels = reader.u64("the number of active voxels")?;
        let root = at(layout::TREE).checked_add_signed(root_at);
        let root = root.filter(|root| root.checked_sub(begin).is_some_and(|root| root < size_bytes));
        reader.seek(root.ok_or_else(|| Error::malformed(begin, "the root stands outside of the grid"))?);
        let active_bbox = index_box(reader)?;
        if flags & layout::HAS_LONG_NAME != 0 {
            name = long_name(reader, [begin, begin + size_bytes], blind_at, blind_count)?.unwrap_or(name);
        }
        budget.take(3, size_of::<GridInfo>(), "the descriptions of grids")?;
        budget.take(1, name.len(), "the names of grids")?;
        reader.seek(begin);
        reader.skip(size_bytes, "a grid")?;
        // A size below that of the structures would let the loop stand still.
        if size_bytes < (layout::GRID_BYTES + layout::TREE_BYTES) as u64 {
            return Err(Error::malformed(begin, format!("a grid of {size_bytes} bytes")));
        }
        grids.push(GridInfo {
            name,
            value_type: layout::type_name(type_number),
            grid_class,
            version,
            codec: Codec::None,
            size_bytes,
            active_voxels,
            active_bbox,
            voxel_size,
            node_counts_leaf_to_root,
            type_number,
            range: [begin, reader.offset()],
        });
    }
    Ok(())
}

/// The name that stands in the blind data of a grid in that range of the file, if one does.
fn long_name(
    reader: &mut Reader<'_>,
    [begin, end]: [u64; 2],
    blind_at: i64,
    blind_count: u32,
) -> Result<Option<String>> {
    let outside = || Error::malformed(begin, "blind data stand outside of the grid");
    let inside = |at: Option<u64>| at.filter(|at| (begin..end).contains(at)).ok_or_else(outside);
    for i in 0..u64::from(blind_count) {
        let skip = i.checked_mul(layout::BLIND_BYTES as u64);
        let at = inside(begin.checked_add_signed(blind_at).and_then(|at| at.checked_add(skip?)))?;
        reader.seek(at);
        let name_at = reader.i64("a description of blind data")?;
        reader.seek(at.saturating_add(layout::BLIND_CLASS as u64));
        if reader.u32("a description of blind data")? == layout::BLIND_CLASS_NAME {
            let name_at = inside(at.checked_add_signed(name_at))?;
            reader.seek(name_at);
            return name(reader, u32::try_from(end - name_at).unwrap_or(u32::MAX).min(1 << 20)).map(Some);
        }
    }
    Ok(None)
}

/// A grid's bytes without compression.
fn decompress<'a>(stored: &'a [u8], info: &GridInfo, budget: &mut Budget) -> Result<Cow<'a, [u8]>> {
    let malformed = |what: String| Error::malformed(info.range[0], what);
    let size = memory_size(info.size_bytes)?;
    match info.codec {
        Codec::None => {
            let bytes = stored.get(..size).ok_or_else(|| {
                malformed(format!("a grid of {size} bytes in {} bytes of the file", stored.len()))
            })?;
            Ok(bytes.into())
        }
        Codec::Zip => {
            let (stream, _) =
                sized_block(stored).ok_or_else(|| malformed("a ZIP stream that is cut".into()))?;
            // Two bits of a Deflate stream stand for 258 bytes at most.
            if size / 1032 > stream.len() {
                return Err(malformed(format!("a ZIP stream of {} bytes for {size}", stream.len())));
            }
            budget.take(size, 1, "the bytes of a grid")?;
            let mut bytes = vec![0; size];
            let mut decoder = ZlibDecoder::new(stream);
            let damaged = |_| malformed(format!("a ZIP stream that is damaged or not of {size} bytes"));
            decoder.read_exact(&mut bytes).map_err(damaged)?;
            match decoder.read(&mut [0]).map_err(damaged)? {
                0 => Ok(bytes.into()),
                _ => Err(malformed(format!("a ZIP stream of more than {size} bytes"))),
            }
        }
        Codec::Blosc => {
            const CHUNK_BYTES: usize = 1 << 30;
            budget.take(size, 1, "the bytes of a grid")?;
            let mut scratch = Scratch::default();
            let (mut bytes, mut rest) = (Vec::new(), stored);
            while bytes.len() < size {
                let (chunk, behind) =
                    sized_block(rest).ok_or_else(|| malformed("a Blosc chunk that is cut".into()))?;
                let begin = bytes.len();
                let len = (size - begin).min(CHUNK_BYTES);
                // The chunk says its size too. Nothing is allocated before both agree.
                if chunk.get(4..8) != Some(&(len as u32).to_le_bytes()[..]) {
                    return Err(malformed(format!("a Blosc chunk that is not of {len} bytes")));
                }
                match begin {
                    0 => bytes = vec![0; len],
                    _ => bytes.resize(begin + len, 0),
                }
                blosc::decompress(chunk, &mut bytes[begin..], &mut scratch).map_err(|error| {
                    use crate::codec::CodecError::{Malformed, Unsupported};
                    match error {
                        Malformed(what) => malformed(what.into()),
                        Unsupported(feature) => Error::unsupported(feature),
                    }
                })?;
                rest = behind;
            }
            Ok(bytes.into())
        }
    }
}

/// A block that its size (u64) stands before, and what follows it.
fn sized_block(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (size, rest) = bytes.split_first_chunk()?;
    rest.split_at_checked(usize::try_from(u64::from_le_bytes(*size)).ok()?)
}
