//! A file's header: versions, metadata and the list of grids, without their voxels.
//!
//! Opening reads headers only. Each grid says where it begins and ends, so one grid is read without touching
//! the others. Files written as streams lack those positions; they are walked through once at opening.

use crate::block::{Compression, ValueLayout};
use crate::error::{Error, Result};
use crate::limits::{Budget, Limits};
use crate::metadata::Metadata;
use crate::read;
use crate::source::{Cursor, Source, parse_window};
use crate::transform::Transform;
use crate::tree::Tree;

/// The first eight bytes of every VDB file.
const MAGIC: [u8; 8] = [0x20, 0x42, 0x44, 0x56, 0, 0, 0, 0];
/// Version 222 moved compression flags from the file to each grid and stores active values only.
const OLDEST_VERSION: u32 = 222;
/// The newest version whose float grids are laid out as described here.
const NEWEST_VERSION: u32 = 226;
/// The appendix of a grid type's name that says that values are saved as half floats.
const HALF_SUFFIX: &str = "_HalfFloat";

/// An open VDB file: its header, and the source to read grids from.
pub struct File<S> {
    source: S,
    limits: Limits,
    /// The version of the file format.
    pub file_version: u32,
    /// Major and minor version of the library that wrote the file.
    pub library_version: [u32; 2],
    /// The file's identifier, a UUID in text form.
    pub uuid: String,
    /// The file's own metadata.
    pub metadata: Metadata,
    /// The grids in the order of the file.
    pub grids: Vec<GridInfo>,
}

/// What the header says of a grid.
#[derive(Debug, Clone)]
pub struct GridInfo {
    /// The name; several grids of a file may share it.
    pub name: String,
    /// The name with a number in brackets where several grids share it: `density[1]`.
    pub unique_name: String,
    /// The tree type without the mark for half floats: `Tree_float_5_4_3`.
    pub grid_type: String,
    /// Whether float values are saved as half floats.
    pub save_float_as_half: bool,
    /// How values are compressed.
    pub compression: Compression,
    /// The metadata of the grid.
    pub metadata: Metadata,
    /// The transform of the grid.
    pub transform: Transform,
    /// The unique name of the grid whose tree this one shares.
    pub instance_of: Option<String>,
    /// Where the grid's tree begins and the grid ends, in bytes from the start of the file.
    tree_range: [u64; 2],
}

/// A grid with its voxels.
#[derive(Debug, Clone)]
pub struct Grid {
    /// What the header says.
    pub info: GridInfo,
    /// The voxels.
    pub tree: Tree,
}

impl GridInfo {
    /// The type of the values: `float`, `vec3s`, `ptdataidx32`, … as the grid type names it, but `bool` for
    /// mask grids, whose values are the active states themselves.
    pub fn value_type(&self) -> &str {
        let name = self.grid_type.strip_prefix("Tree_").unwrap_or(&self.grid_type);
        match name.split('_').next().unwrap_or(name) {
            "mask" => "bool",
            other => other,
        }
    }

    /// `"fog volume"`, `"level set"`, `"staggered"` or `"unknown"`.
    pub fn grid_class(&self) -> &str {
        match self.metadata.string("class") {
            Some(class @ ("fog volume" | "level set" | "staggered")) => class,
            _ => "unknown",
        }
    }

    /// The box of active voxels `[min, max]`, both ends included, as the writer noted it in the metadata.
    pub fn file_bbox(&self) -> Option<[[i32; 3]; 2]> {
        let (min, max) = (self.metadata.vec3i("file_bbox_min")?, self.metadata.vec3i("file_bbox_max")?);
        (0..3).all(|i| min[i] <= max[i]).then_some([min, max])
    }

    /// Whether [`File::read_grid`] reads this type of grid.
    pub fn is_readable(&self) -> bool {
        self.grid_type == "Tree_float_5_4_3"
    }

    fn layout(&self) -> Option<ValueLayout> {
        let standard = self.grid_type.ends_with("_5_4_3");
        standard.then(|| ValueLayout::of(self.value_type(), self.save_float_as_half))?
    }
}

/// The part of a grid's header that stands before its body.
struct Descriptor {
    unique_name: String,
    name: String,
    grid_type: String,
    save_float_as_half: bool,
    instance_of: Option<String>,
    /// Where the grid's header begins and the grid ends; zero in a stream.
    grid_begin: u64,
    grid_end: u64,
}

struct Header {
    file_version: u32,
    library_version: [u32; 2],
    has_offsets: bool,
    uuid: String,
    metadata: Metadata,
    grid_count: u32,
    end: u64,
}

impl<S: Source> File<S> {
    /// Reads the header of a file with the default [`Limits`].
    ///
    /// # Errors
    /// If the source fails, the bytes are no VDB file or a damaged one, or the version is not supported.
    pub fn open(source: S) -> Result<Self> {
        Self::open_with(source, Limits::default())
    }

    /// Reads the header of a file. The limits hold for opening and for each grid read later.
    ///
    /// # Errors
    /// As [`File::open`], and if a limit is passed.
    pub fn open_with(source: S, limits: Limits) -> Result<Self> {
        let size = source.size_bytes()?;
        let max_window = limits.max_memory_bytes;
        let header = parse_window(&source, 0, 64 << 10, max_window, |cursor| {
            read_header(cursor, &mut Budget::new(&limits))
        })?;
        let mut budget = Budget::new(&limits);
        let mut grids = Vec::new();
        if header.has_offsets {
            let mut at = header.end;
            for _ in 0..header.grid_count {
                let (descriptor, after) = parse_window(&source, at, 4 << 10, max_window, |cursor| {
                    Ok((read_descriptor(cursor)?, cursor.offset()))
                })?;
                let Descriptor { grid_begin, grid_end, .. } = descriptor;
                if grid_end > size {
                    return Err(Error::malformed(
                        after,
                        format!("the grid '{}' ends at byte {grid_end} of {size}", descriptor.unique_name),
                    ));
                }
                // Growing positions also bound the number of grids by the size of the file.
                if grid_begin < after || grid_end < grid_begin {
                    return Err(Error::malformed(after, "the positions of a grid are out of order"));
                }
                let (mut info, used) = parse_window(&source, grid_begin, 64 << 10, max_window, |cursor| {
                    let mut budget = Budget::new(&limits);
                    let info = read_grid_header(cursor, &descriptor, &mut budget)?;
                    Ok((info, cursor.offset() - grid_begin))
                })?;
                take_grid_header(&mut budget, after - at + used)?;
                if info.tree_range[0] > grid_end {
                    return Err(Error::malformed(info.tree_range[0], "a grid's header passes its end"));
                }
                info.tree_range[1] = grid_end;
                grids.push(info);
                at = grid_end;
            }
        } else {
            grids = walk_stream(&source, &header, size, &limits)?;
        }
        let Header { file_version, library_version, uuid, metadata, .. } = header;
        Ok(File { source, limits, file_version, library_version, uuid, metadata, grids })
    }

    /// The grid of that name: a unique name, else the first grid of that plain name.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.grids
            .iter()
            .position(|grid| grid.unique_name == name)
            .or_else(|| self.grids.iter().position(|grid| grid.name == name))
    }

    /// Reads the voxels of grid `index`, without reading those of any other.
    ///
    /// # Errors
    /// If the source fails, the bytes are damaged, the type of the grid is not supported, a limit is passed,
    /// or there is no such grid.
    pub fn read_grid(&self, index: usize) -> Result<Grid> {
        let info = self
            .grids
            .get(index)
            .ok_or_else(|| Error::Misuse(format!("there is no grid {index}, only {}", self.grids.len())))?;
        let owner = match &info.instance_of {
            None => info,
            Some(name) => self
                .grids
                .iter()
                .find(|grid| grid.unique_name == *name && grid.instance_of.is_none())
                .ok_or_else(|| {
                    Error::malformed(
                        info.tree_range[0],
                        format!("the grid '{name}' that it shares is missing"),
                    )
                })?,
        };
        if !owner.is_readable() {
            return Err(Error::unsupported(format!(
                "grids of type '{}' (grid '{}')",
                info.grid_type, info.unique_name
            )));
        }
        let layout = owner.layout().ok_or_else(|| Error::unsupported("this value type"))?;
        let [begin, end] = owner.tree_range;
        let mut budget = Budget::new(&self.limits);
        let len = usize::try_from(end - begin).unwrap_or(usize::MAX);
        budget.take(len, 1, "a grid's compressed bytes")?;
        let bytes = self.source.range(begin, len)?;
        let mut cursor = Cursor::new(&bytes, begin);
        let tree = read::read_float_tree(&mut cursor, owner.compression, layout, &mut budget)?;
        Ok(Grid { info: info.clone(), tree })
    }
}

fn read_header(cursor: &mut Cursor<'_>, budget: &mut Budget) -> Result<Header> {
    if cursor.take(8, "the magic number")? != MAGIC {
        return Err(Error::malformed(0, "this is not a VDB file: it does not begin with VDB's magic number"));
    }
    let file_version = cursor.u32("the file version")?;
    if !(OLDEST_VERSION..=NEWEST_VERSION).contains(&file_version) {
        return Err(Error::unsupported(format!(
            "file version {file_version} (supported are {OLDEST_VERSION} to {NEWEST_VERSION})"
        )));
    }
    let library_version = [cursor.u32("the library version")?, cursor.u32("the library version")?];
    let has_offsets = cursor.u8("the header")? != 0;
    let uuid = String::from_utf8_lossy(cursor.take(36, "the file's UUID")?).into_owned();
    let metadata = Metadata::read(cursor, budget)?;
    let grid_count = cursor.u32("the number of grids")?;
    let end = cursor.offset();
    Ok(Header { file_version, library_version, has_offsets, uuid, metadata, grid_count, end })
}

fn read_descriptor(cursor: &mut Cursor<'_>) -> Result<Descriptor> {
    // Names that several grids share carry a separator and a number.
    let bracketed = |name: &str| match name.split_once('\x1e') {
        Some((plain, number)) => format!("{plain}[{number}]"),
        None => name.to_owned(),
    };
    let stored_name = cursor.string("a grid's name")?;
    let stored_type = cursor.string("a grid's type")?;
    let instance_of = cursor.string("the name of a shared grid")?;
    let mut position = || -> Result<u64> {
        let position = cursor.i64("the position of a grid")?;
        u64::try_from(position).map_err(|_| cursor.malformed("the position of a grid is negative"))
    };
    let (grid_begin, _values_begin, grid_end) = (position()?, position()?, position()?);
    let half = stored_type.strip_suffix(HALF_SUFFIX);
    Ok(Descriptor {
        unique_name: bracketed(&stored_name),
        name: stored_name.split('\x1e').next().unwrap_or_default().to_owned(),
        grid_type: half.unwrap_or(&stored_type).to_owned(),
        save_float_as_half: half.is_some(),
        instance_of: (!instance_of.is_empty()).then(|| bracketed(&instance_of)),
        grid_begin,
        grid_end,
    })
}

fn read_grid_header(
    cursor: &mut Cursor<'_>,
    descriptor: &Descriptor,
    budget: &mut Budget,
) -> Result<GridInfo> {
    let compression = Compression::read(cursor)?;
    let metadata = Metadata::read(cursor, budget)?;
    let transform = Transform::read(cursor)?;
    Ok(GridInfo {
        name: metadata.string("name").unwrap_or(&descriptor.name).to_owned(),
        unique_name: descriptor.unique_name.clone(),
        grid_type: descriptor.grid_type.clone(),
        save_float_as_half: descriptor.save_float_as_half,
        compression,
        metadata,
        transform,
        instance_of: descriptor.instance_of.clone(),
        tree_range: [cursor.offset(), cursor.offset()],
    })
}

/// Counts what is kept of a grid's header. A byte of it becomes up to six: names are held twice and each byte
/// that is not UTF-8 becomes three, and the smallest metadata entry has twelve bytes.
fn take_grid_header(budget: &mut Budget, header_bytes: u64) -> Result<()> {
    let kept_bytes = usize::try_from(header_bytes).unwrap_or(usize::MAX).saturating_mul(6);
    // Twice for the growth of the vector of grids.
    let info_bytes = 2 * size_of::<GridInfo>();
    budget.take(1, kept_bytes.saturating_add(info_bytes), "the headers of all grids")
}

/// Finds the grids of a file without positions by walking through all of them.
fn walk_stream(source: &impl Source, header: &Header, size: u64, limits: &Limits) -> Result<Vec<GridInfo>> {
    let mut budget = Budget::new(limits);
    // The source may have grown since it was asked for its size.
    let len = usize::try_from(size.saturating_sub(header.end)).unwrap_or(usize::MAX);
    budget.take(len, 1, "a file without grid positions")?;
    let bytes = source.range(header.end, len)?;
    let mut cursor = Cursor::new(&bytes, header.end);
    let mut grids = Vec::new();
    for _ in 0..header.grid_count {
        let begin = cursor.offset();
        let descriptor = read_descriptor(&mut cursor)?;
        let mut info = read_grid_header(&mut cursor, &descriptor, &mut budget)?;
        take_grid_header(&mut budget, cursor.offset() - begin)?;
        if info.instance_of.is_none() {
            let layout = info.layout().ok_or_else(|| {
                Error::unsupported(format!(
                    "a file without grid positions that holds a grid of type '{}'",
                    info.grid_type
                ))
            })?;
            read::skip_tree(&mut cursor, info.compression, layout, limits)?;
        }
        info.tree_range[1] = cursor.offset();
        grids.push(info);
    }
    Ok(grids)
}
