//! The headers of a file and of its grids, through all versions of the format.
//!
//! Here is what stands before the first node of a tree, and where each grid begins and ends. Opening files and
//! reading trees lives in [`crate::file`].

use std::fmt::Write;

use crate::block::{COMPRESS_ACTIVE_MASK, COMPRESS_ZIP, Compression};
use crate::error::{Error, Result};
use crate::limits::Budget;
use crate::metadata::Metadata;
use crate::source::Reader;
use crate::stats::IndexBox;
use crate::transform::Transform;
use crate::tree::Shape;

/// The first eight bytes of every VDB file.
pub(crate) const MAGIC: [u8; 8] = [0x20, 0x42, 0x44, 0x56, 0, 0, 0, 0];
/// In version 213 the root became a table of entries.
pub const OLDEST_VERSION: u32 = 213;
/// The newest version whose grids are laid out as described here.
pub const NEWEST_VERSION: u32 = 226;
/// From this version on grids can share trees, and transforms stand before the topology.
pub(crate) const INSTANCES_SINCE: u32 = 216;
/// From this version on the UUID is text.
const TEXT_UUID_SINCE: u32 = 218;
/// From this version until [`GRID_COMPRESSION_SINCE`] the header says whether values are zipped; before, they are.
const FILE_COMPRESSION_SINCE: u32 = 220;
/// From this version on each grid says how it is compressed.
const GRID_COMPRESSION_SINCE: u32 = 222;
/// The appendix of a grid type's name that says that values are saved as half floats.
pub(crate) const HALF_SUFFIX: &str = "_HalfFloat";
/// What separates a name that several grids share from a number.
pub(crate) const NAME_SEPARATOR: char = '\x1e';

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
    pub(crate) tree_range: [u64; 2],
}

impl GridInfo {
    /// The type of the values: `float`, `vec3s`, `ptdataidx32`, … as the grid type names it, but `bool` for
    /// mask grids, whose values are the active states themselves.
    pub fn value_type(&self) -> &str {
        match self.stored_type() {
            "mask" => "bool",
            other => other,
        }
    }

    /// The type of the values as the grid type names it.
    pub(crate) fn stored_type(&self) -> &str {
        parse_grid_type(&self.grid_type).0
    }

    /// The widths of the nodes, if the grid type names one that is supported.
    pub fn shape(&self) -> Option<Shape> {
        parse_grid_type(&self.grid_type).1
    }

    /// `"fog volume"`, `"level set"`, `"staggered"` or `"unknown"`.
    pub fn grid_class(&self) -> &str {
        self.metadata.grid_class()
    }

    /// The box of active voxels `[min, max]`, both ends included, as the writer noted it in the metadata.
    pub fn file_bbox(&self) -> Option<IndexBox> {
        let (min, max) = (self.metadata.vec3i("file_bbox_min")?, self.metadata.vec3i("file_bbox_max")?);
        (0..3).all(|i| min[i] <= max[i]).then_some([min, max])
    }

    /// The bytes that the grid's tree takes in the file: none for a grid that shares another's.
    pub fn tree_bytes(&self) -> u64 {
        self.tree_range[1] - self.tree_range[0]
    }
}

/// `Tree_float_5_4_3` as the type of values and the shape, `None` if there is none or one that is not supported.
fn parse_grid_type(grid_type: &str) -> (&str, Option<Shape>) {
    let Some(name) = grid_type.strip_prefix("Tree_") else { return (grid_type, None) };
    let mut widths = Vec::new();
    let mut value_type = name;
    while let Some((rest, width)) = value_type.rsplit_once('_') {
        let Ok(log2) = width.parse::<u8>() else { break };
        widths.insert(0, log2);
        value_type = rest;
    }
    (value_type, Shape::new(&widths))
}

/// The part of a grid's header that stands before its body.
#[derive(Debug)]
pub(crate) struct Descriptor {
    pub(crate) unique_name: String,
    pub(crate) name: String,
    pub(crate) grid_type: String,
    pub(crate) save_float_as_half: bool,
    pub(crate) instance_of: Option<String>,
    /// Where the grid's header begins and the grid ends; zero in a stream.
    pub(crate) grid_begin: u64,
    pub(crate) grid_end: u64,
}

/// The header of a file.
#[derive(Debug)]
pub(crate) struct Header {
    pub(crate) file_version: u32,
    pub(crate) library_version: [u32; 2],
    pub(crate) has_offsets: bool,
    pub(crate) uuid: String,
    /// How grids are compressed that do not say so themselves.
    pub(crate) compression: Compression,
    pub(crate) metadata: Metadata,
    pub(crate) grid_count: u32,
}

pub(crate) fn read_header(reader: &mut Reader<'_>, budget: &mut Budget) -> Result<Header> {
    if reader.take(8, "the magic number")? != MAGIC {
        return Err(Error::malformed(0, "this is not a VDB file: it does not begin with VDB's magic number"));
    }
    let file_version = reader.u32("the file version")?;
    if !(OLDEST_VERSION..=NEWEST_VERSION).contains(&file_version) {
        return Err(Error::unsupported(format!(
            "file version {file_version} (supported are {OLDEST_VERSION} to {NEWEST_VERSION})"
        )));
    }
    let library_version = [reader.u32("the library version")?, reader.u32("the library version")?];
    let has_offsets = reader.u8("the header")? != 0;
    let flags = match file_version {
        ..FILE_COMPRESSION_SINCE => COMPRESS_ZIP,
        FILE_COMPRESSION_SINCE..GRID_COMPRESSION_SINCE => match reader.u8("the compression of the file")? {
            0 => 0,
            _ => COMPRESS_ZIP,
        },
        GRID_COMPRESSION_SINCE.. => COMPRESS_ACTIVE_MASK,
    };
    let uuid = match file_version {
        TEXT_UUID_SINCE.. => String::from_utf8_lossy(reader.take(36, "the file's UUID")?).into_owned(),
        _ => uuid_text(reader.array("the file's UUID")?),
    };
    let metadata = Metadata::read(reader, budget)?;
    let grid_count = reader.u32("the number of grids")?;
    let compression = Compression { flags };
    Ok(Header { file_version, library_version, has_offsets, uuid, compression, metadata, grid_count })
}

/// Sixteen bytes in the text form of a UUID.
pub(crate) fn uuid_text(bytes: [u8; 16]) -> String {
    let mut text = String::with_capacity(36);
    for (i, byte) in bytes.iter().enumerate() {
        if matches!(i, 4 | 6 | 8 | 10) {
            text.push('-');
        }
        write!(text, "{byte:02x}").expect("writing to a string");
    }
    text
}

pub(crate) fn read_descriptor(reader: &mut Reader<'_>, file_version: u32) -> Result<Descriptor> {
    let stored_name = reader.string("a grid's name")?;
    let stored_type = reader.string("a grid's type")?;
    let instance_of = match file_version {
        INSTANCES_SINCE.. => reader.string("the name of a shared grid")?,
        _ => String::new(),
    };
    let mut position = || -> Result<u64> {
        let at = reader.offset();
        let position = reader.i64("the position of a grid")?;
        u64::try_from(position).map_err(|_| Error::malformed(at, "the position of a grid is negative"))
    };
    let (grid_begin, _values_begin, grid_end) = (position()?, position()?, position()?);
    let half = stored_type.strip_suffix(HALF_SUFFIX);
    Ok(Descriptor {
        unique_name: bracketed(&stored_name),
        name: stored_name.split(NAME_SEPARATOR).next().unwrap_or_default().to_owned(),
        grid_type: half.unwrap_or(&stored_type).to_owned(),
        save_float_as_half: half.is_some(),
        instance_of: (!instance_of.is_empty()).then(|| bracketed(&instance_of)),
        grid_begin,
        grid_end,
    })
}

/// A name with a separator and a number as people write it: `density[1]`.
fn bracketed(name: &str) -> String {
    match name.split_once(NAME_SEPARATOR) {
        Some((plain, number)) => format!("{plain}[{number}]"),
        None => name.to_owned(),
    }
}

/// Reads what stands between a grid's descriptor and its tree. Before version [`INSTANCES_SINCE`] the transform stands
/// behind the topology; it is left to the caller then.
pub(crate) fn read_grid_header(
    reader: &mut Reader<'_>,
    header: &Header,
    descriptor: &Descriptor,
    budget: &mut Budget,
) -> Result<GridInfo> {
    let compression = match header.file_version {
        GRID_COMPRESSION_SINCE.. => Compression::read(reader)?,
        _ => header.compression,
    };
    let metadata = Metadata::read(reader, budget)?;
    let transform = match header.file_version {
        INSTANCES_SINCE.. => Transform::read(reader, header.file_version)?,
        _ => Transform::identity(),
    };
    Ok(GridInfo {
        name: metadata.string("name").unwrap_or(&descriptor.name).to_owned(),
        unique_name: descriptor.unique_name.clone(),
        grid_type: descriptor.grid_type.clone(),
        // OpenVDB goes by the metadata; the mark on the type is for those who have not read them yet.
        save_float_as_half: metadata.bool("is_saved_as_half_float").unwrap_or(descriptor.save_float_as_half),
        compression,
        metadata,
        transform,
        instance_of: descriptor.instance_of.clone(),
        tree_range: [reader.offset(); 2],
    })
}

/// Counts what is kept of a grid's header. A byte of it becomes up to six: names are held twice and each byte
/// that is not UTF-8 becomes three, and the smallest metadata entry has twelve bytes.
pub(crate) fn take_grid_header(budget: &mut Budget, header_bytes: u64) -> Result<()> {
    let kept_bytes = usize::try_from(header_bytes).unwrap_or(usize::MAX).saturating_mul(6);
    // Twice for the growth of the vector of grids.
    let info_bytes = 2 * size_of::<GridInfo>();
    budget.take(1, kept_bytes.saturating_add(info_bytes), "the headers of all grids")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_grid_type_names_its_values_and_its_shape() {
        assert_eq!(parse_grid_type("Tree_float_5_4_3"), ("float", Some(Shape::STANDARD)));
        assert_eq!(parse_grid_type("Tree_vec3s_4_3"), ("vec3s", Shape::new(&[4, 3])));
        assert_eq!(parse_grid_type("Tree_my_type_3"), ("my_type", Shape::new(&[3])));
        assert_eq!(parse_grid_type("Tree_float_5_4_300"), ("float_5_4_300", None));
        assert_eq!(parse_grid_type("Tree_float"), ("float", None));
        assert_eq!(parse_grid_type("Something_5_4_3"), ("Something_5_4_3", None));
    }

    #[test]
    fn a_uuid_has_its_hyphens() {
        let text = uuid_text(std::array::from_fn(|i| i as u8 * 17));
        assert_eq!(text, "00112233-4455-6677-8899-aabbccddeeff");
    }
}
