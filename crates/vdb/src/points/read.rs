//! Reading a tree of points: several passes over its leaves.
//!
//! Behind the topology stands the number of passes, 4 and two more per attribute. Pass 0 holds the sizes of
//! the voxels' offsets, pass 1 what attributes there are and the metadata of their arrays, then one pass per
//! attribute the sizes of its pages, then one for the offsets, and again one per attribute for its arrays.
//! The last is empty. Everything is located first and decoded afterwards.
//!
//! Layout as in OpenVDB's `points/PointDataGrid.h`, `AttributeSet.cc` and `AttributeArray.h`.

use std::collections::HashMap;

use super::PointTree;
use super::attribute::{Array, Attribute, AttributeSet, Column, Group};
use super::paged::{self, Page, Piece};
use crate::block::BlockFormat;
use crate::build::TreeBuilder;
use crate::error::{Error, Result};
use crate::limits::Budget;
use crate::metadata::Metadata;
use crate::read;
use crate::source::{Reader, Source};
use crate::stats::IndexBox;
use crate::tree::{LEAF_VOXELS, Leaves, Shape, Tree};
use crate::value::{PointOffset, Value};

/// From this version on point grids are written in several passes.
const PASSES_SINCE: u32 = 224;
/// The passes that do not belong to an attribute.
const OWN_PASSES: u16 = 4;
/// Stands where the size of the offsets of a leaf would, if they are not compressed.
const NOT_COMPRESSED: u16 = u16::MAX;
const OFFSETS_BYTES: usize = LEAF_VOXELS * PointOffset::SIZE_BYTES;
const MASK_BYTES: u64 = (LEAF_VOXELS / 8) as u64;

/// Where all parts of a tree of points stand.
struct Layout {
    /// The offsets of each leaf.
    offsets: Vec<Piece>,
    attribute_sets: Vec<AttributeSet>,
    set_of_leaf: Vec<u32>,
    columns: Vec<ColumnLayout>,
}

#[derive(Default)]
struct ColumnLayout {
    arrays: Vec<Array>,
    /// The bytes in the file of each array that stands on its own.
    stored_bytes: Vec<u64>,
    pieces: Vec<Piece>,
}

/// Reads a tree of points.
pub(crate) fn read(
    source: &dyn Source,
    reader: &mut Reader<'_>,
    format: BlockFormat,
    shape: Shape,
    bbox: Option<IndexBox>,
    budget: &mut Budget,
) -> Result<PointTree> {
    let (mut offsets, layout) = locate(reader, format, shape, budget)?;
    let mut worked_bytes = 0;
    let leaves = offsets.leaves.len();
    budget.take(leaves, OFFSETS_BYTES, "the offsets of points")?;
    let ends = decode_offsets(source, &layout.offsets)?;
    offsets.leaves.values = ends;
    check_sizes(&offsets.leaves, &layout)?;
    let mut columns = Vec::with_capacity(layout.columns.len());
    for ColumnLayout { arrays, pieces, .. } in layout.columns {
        let bytes = paged::decode(source, &pieces, budget, &mut worked_bytes, "the attributes of points")?;
        columns.push(Column { arrays, bytes });
    }
    let points = PointTree {
        offsets,
        attribute_sets: layout.attribute_sets,
        set_of_leaf: layout.set_of_leaf,
        columns,
    };
    match bbox {
        None => Ok(points),
        Some(bbox) => leaves_in_box(points, bbox, budget),
    }
}

/// Moves past a tree of points.
pub(crate) fn skip(
    reader: &mut Reader<'_>,
    format: BlockFormat,
    shape: Shape,
    budget: &mut Budget,
) -> Result<()> {
    locate(reader, format, shape, budget).map(|_| ())
}

/// Moves past a tree of point indices: leaves as those of other grids, each with a list of indices behind it.
pub(crate) fn skip_point_indices(
    reader: &mut Reader<'_>,
    format: BlockFormat,
    shape: Shape,
    budget: &mut Budget,
) -> Result<()> {
    let tree = read::topology::<PointOffset>(reader, format, shape, budget)?;
    for leaf in 0..tree.leaves.len() {
        read::skip_leaf(reader, format, &tree.leaves, leaf)?;
        let index_count = reader.u64("the number of a leaf's points")?;
        reader.skip(index_count.saturating_mul(4), "the points of a leaf")?;
        let more_bytes = reader.u64("the size of a leaf's other data")?;
        reader.skip(more_bytes, "the other data of a leaf")?;
    }
    Ok(())
}

/// Reads the topology and finds everything behind it.
fn locate(
    reader: &mut Reader<'_>,
    format: BlockFormat,
    shape: Shape,
    budget: &mut Budget,
) -> Result<(Tree<PointOffset>, Layout)> {
    if shape != Shape::STANDARD {
        return Err(Error::unsupported("grids of points with nodes of other sizes than 32, 16 and 8"));
    }
    if format.file_version < PASSES_SINCE {
        return Err(Error::unsupported(format!(
            "grids of points in files of version {}, before {PASSES_SINCE}",
            format.file_version
        )));
    }
    let tree = read::topology::<PointOffset>(reader, format, shape, budget)?;
    let at = reader.offset();
    let passes = reader.u16("the number of passes")?;
    let leaves = tree.leaves.len();
    if leaves > 0 && passes < OWN_PASSES {
        return Err(Error::malformed(
            at,
            format!("points in {passes} passes, of which there are at least 4"),
        ));
    }
    let max_attributes = usize::from(passes.saturating_sub(OWN_PASSES) / 2);
    budget.take(leaves, 2 + size_of::<Piece>() + 4, "the leaves of points")?;
    let sizes: Vec<u16> =
        (0..leaves).map(|_| reader.u16("the size of a leaf's offsets")).collect::<Result<_>>()?;
    let mut sets = Sets {
        leaves,
        max_attributes,
        attribute_sets: Vec::new(),
        set_of_leaf: Vec::with_capacity(leaves),
        columns: Vec::new(),
        is_shared: false,
        known: HashMap::new(),
    };
    for leaf in 0..leaves {
        sets.leaf(reader, leaf, budget)?;
    }
    let Sets { attribute_sets, set_of_leaf, mut columns, .. } = sets;
    let mut pages: Vec<Vec<Page>> = Vec::with_capacity(columns.len());
    for column in &columns {
        pages.push(paged::page_sizes(reader, &column.arrays, budget)?);
    }
    let offsets = sizes.iter().map(|size| locate_offsets(reader, *size)).collect::<Result<_>>()?;
    for (column, pages) in columns.iter_mut().zip(pages) {
        column.place(reader)?;
        column.pieces = paged::locate(reader, &column.arrays, &column.stored_bytes, pages, budget)?;
    }
    Ok((tree, Layout { offsets, attribute_sets, set_of_leaf, columns }))
}

/// Moves past the offsets of a leaf, whose size has been told before.
fn locate_offsets(reader: &mut Reader<'_>, told: u16) -> Result<Piece> {
    // Each leaf repeats its mask; the topology's counts.
    reader.skip(MASK_BYTES, "a leaf's mask")?;
    let size = reader.u16("the size of a leaf's offsets")?;
    let at = reader.offset();
    if size != told {
        return Err(Error::malformed(
            at,
            format!("the offsets of a leaf take {size} bytes, not {told} as told"),
        ));
    }
    let is_compressed = size != NOT_COMPRESSED;
    let stored_bytes = if is_compressed { u32::from(size) } else { OFFSETS_BYTES as u32 };
    if stored_bytes as usize > OFFSETS_BYTES {
        return Err(Error::malformed(at, format!("the offsets of a leaf take {size} bytes compressed")));
    }
    reader.skip(stored_bytes.into(), "a leaf's offsets")?;
    Ok(Piece { at, stored_bytes, is_compressed, bytes: OFFSETS_BYTES as u64 })
}

/// The state of the pass that says what attributes leaves have.
struct Sets {
    leaves: usize,
    max_attributes: usize,
    attribute_sets: Vec<AttributeSet>,
    set_of_leaf: Vec<u32>,
    columns: Vec<ColumnLayout>,
    /// Whether all further leaves have the last set, which they then do not repeat.
    is_shared: bool,
    /// The sets by their bytes in the file, where each leaf repeats its own.
    known: HashMap<Vec<u8>, u32>,
}

impl Sets {
    /// A following field is to be skipped.
    const HAS_MORE: u8 = 2;

    fn leaf(&mut self, reader: &mut Reader<'_>, leaf: usize, budget: &mut Budget) -> Result<()> {
        let set = match self.is_shared {
            true => self.set_of_leaf.last().copied().unwrap_or_default(),
            false => self.read_set(reader, budget)?,
        };
        self.set_of_leaf.push(set);
        let attributes = &self.attribute_sets[set as usize].attributes;
        for (i, attribute) in attributes.iter().enumerate() {
            if i == self.columns.len() {
                budget.take(self.leaves, size_of::<Array>(), "the arrays of attributes")?;
                let arrays = Vec::with_capacity(self.leaves);
                self.columns.push(ColumnLayout { arrays, ..Default::default() });
            }
            let column = &mut self.columns[i];
            column.arrays.resize(leaf, Array::NONE);
            let (array, stored_bytes) = read_array(reader, attribute)?;
            column.arrays.push(array);
            if array.is_alone() {
                budget.take(2, 8, "the arrays of attributes")?;
                column.stored_bytes.push(stored_bytes);
            }
        }
        if leaf + 1 == self.leaves {
            self.columns.iter_mut().for_each(|column| column.arrays.resize(self.leaves, Array::NONE));
        }
        Ok(())
    }

    fn read_set(&mut self, reader: &mut Reader<'_>, budget: &mut Budget) -> Result<u32> {
        let at = reader.offset();
        let flags = reader.u8("the flags of a set of attributes")?;
        if flags > 3 {
            return Err(Error::unsupported(format!("sets of attributes with flags {flags} (at byte {at})")));
        }
        let (begin, budget_before) = (reader.offset(), budget.clone());
        let set = read_attribute_set(reader, budget)?;
        if set.attributes.len() > self.max_attributes {
            return Err(Error::malformed(
                begin,
                format!("{} attributes in passes for {}", set.attributes.len(), self.max_attributes),
            ));
        }
        let end = reader.offset();
        self.is_shared = flags & 1 != 0;
        if flags & Self::HAS_MORE != 0 {
            let more_bytes = reader.u64("the size of what follows a set of attributes")?;
            reader.skip(more_bytes, "what follows a set of attributes")?;
        }
        let after = reader.offset();
        reader.seek(begin);
        let bytes = reader.take((end - begin) as usize, "a set of attributes")?.to_vec();
        reader.seek(after);
        let next = self.attribute_sets.len() as u32;
        if let Some(known) = self.known.get(&bytes) {
            *budget = budget_before;
            return Ok(*known);
        }
        budget.take(1, 2 * (bytes.len() + size_of::<AttributeSet>()), "sets of attributes")?;
        self.known.insert(bytes, next);
        self.attribute_sets.push(set);
        Ok(next)
    }
}

impl ColumnLayout {
    /// Gives the arrays their places in memory: one after the other.
    fn place(&mut self, reader: &Reader<'_>) -> Result<()> {
        let (mut at, mut paged) = (0_u64, 0);
        for array in &mut self.arrays {
            array.begin = at;
            let end = at.checked_add(array.bytes());
            at = end.ok_or_else(|| reader.malformed("the arrays of an attribute pass all memory"))?;
            paged += usize::from(array.is_paged() && array.bytes() > 0);
        }
        match paged > 0 && !self.stored_bytes.is_empty() {
            true => Err(Error::unsupported("attributes of which only some arrays stand in pages")),
            false => Ok(()),
        }
    }
}

/// Reads what attributes there are.
fn read_attribute_set(reader: &mut Reader<'_>, budget: &mut Budget) -> Result<AttributeSet> {
    let count = reader.u64("the number of attributes")?;
    let mut attributes = Vec::new();
    for _ in 0..count {
        let value_type = reader.string("the type of an attribute")?;
        let codec = reader.string("the coding of an attribute")?;
        // Twice for the growth of the vector.
        let bytes = 2 * size_of::<Attribute>() + value_type.len() + codec.len();
        budget.take(1, bytes, "attributes")?;
        attributes.push(Attribute { name: String::new(), value_type, codec });
    }
    for _ in 0..count {
        let at = reader.offset();
        let name = reader.string("the name of an attribute")?;
        let position = reader.u64("the position of an attribute")?;
        budget.take(1, name.len(), "attributes")?;
        let attribute = usize::try_from(position).ok().and_then(|i| attributes.get_mut(i));
        match attribute {
            Some(attribute) if attribute.name.is_empty() && !name.is_empty() => attribute.name = name,
            _ => {
                return Err(Error::malformed(
                    at,
                    format!("the attribute '{name}' cannot stand at position {position} of {count}"),
                ));
            }
        }
    }
    let group_count = reader.u64("the number of groups")?;
    let mut groups = Vec::new();
    for _ in 0..group_count {
        let name = reader.string("the name of a group")?;
        budget.take(1, 2 * size_of::<Group>() + name.len(), "groups of points")?;
        groups.push(Group { name, bit: reader.u64("the bit of a group")? });
    }
    attributes.shrink_to_fit();
    groups.shrink_to_fit();
    Ok(AttributeSet { attributes, groups, metadata: Metadata::read(reader, budget)? })
}

/// Reads the metadata of an array, and how many bytes of the file its values take, if not in pages.
fn read_array(reader: &mut Reader<'_>, attribute: &Attribute) -> Result<(Array, u64)> {
    // The size counts the two flags and the number of points, but neither itself nor the stride.
    const COUNTED_BYTES: u64 = 6;
    let at = reader.offset();
    let size = reader.u64("the size of an array")?;
    let flags = reader.u8("the flags of an array")?;
    let storage = reader.u8("the flags of an array")?;
    let points = reader.u32("the number of points of an array")?;
    if storage & !Array::ALL_STORAGE != 0 {
        return Err(Error::unsupported(format!(
            "arrays of attributes with flags {storage:#x} (at byte {at})"
        )));
    }
    let stride = if storage & Array::STRIDED != 0 { reader.u32("the stride of an array")? } else { 1 };
    let mut array = Array { begin: 0, points, stride, value_bytes: 0, flags, storage };
    let wrong = |array: &Array| {
        let values = array.stored_values();
        let Attribute { name, value_type, codec } = attribute;
        Error::malformed(
            at,
            format!("an array of size {size} for {values} values of '{name}' ({value_type}, {codec})"),
        )
    };
    let bytes = size.checked_sub(COUNTED_BYTES).ok_or_else(|| wrong(&array))?;
    let values = array.stored_values();
    // Of a type that is not known, the size of a value follows from that of them all.
    let value_bytes = match attribute.value_bytes() {
        Some(value_bytes) => Some(value_bytes),
        None => bytes.checked_div(values).map_or(Some(0), |value_bytes| u32::try_from(value_bytes).ok()),
    };
    array.value_bytes = value_bytes.ok_or_else(|| wrong(&array))?;
    // An array that stands on its own may be compressed; where it stands it is known whether it is.
    let is_exact = array.is_paged() || array.is_uniform() || attribute.value_bytes().is_none();
    match array.bytes() == bytes || (!is_exact && bytes <= array.bytes()) {
        true => Ok((array, bytes)),
        false => Err(wrong(&array)),
    }
}

/// Decodes the offsets of all leaves.
fn decode_offsets(source: &dyn Source, pieces: &[Piece]) -> Result<Vec<PointOffset>> {
    let mut ends = vec![PointOffset(0); pieces.len() * LEAF_VOXELS];
    let mut rest = &mut ends[..];
    let mut tasks = Vec::new();
    for task in paged::tasks(pieces) {
        let (out, after) = rest.split_at_mut(task.len() * LEAF_VOXELS);
        rest = after;
        tasks.push((task, out));
    }
    paged::for_each(tasks, |(task, out): (&[Piece], &mut [PointOffset]), scratch| {
        let Some(first) = task.first() else { return Ok(()) };
        let stored = source.range(first.at, paged::span(task) as usize)?;
        let mut bytes = [0; OFFSETS_BYTES];
        for (piece, out) in task.iter().zip(out.chunks_mut(LEAF_VOXELS)) {
            let begin = (piece.at - first.at) as usize;
            let stored = stored.get(begin..begin + piece.stored_bytes as usize).unwrap_or_default();
            piece.decode(stored, &mut bytes, scratch)?;
            PointOffset::decode(&bytes, false, out);
            if !out.is_sorted_by_key(|end| end.0) {
                return Err(Error::malformed(piece.at, "the offsets of a leaf's points descend"));
            }
        }
        Ok(())
    })?;
    Ok(ends)
}

/// Makes sure that the arrays of each leaf hold all of its points.
fn check_sizes(leaves: &Leaves<PointOffset>, layout: &Layout) -> Result<()> {
    for (leaf, piece) in layout.offsets.iter().enumerate() {
        let points = leaves.stored(leaf).last().map_or(0, |end| end.0);
        let set = layout.set_of_leaf.get(leaf).and_then(|set| layout.attribute_sets.get(*set as usize));
        let attributes = set.map_or(0, |set| set.attributes.len());
        for column in layout.columns.iter().take(attributes) {
            let size = column.arrays.get(leaf).map_or(0, |array| array.points);
            if size < points {
                return Err(Error::malformed(
                    piece.at,
                    format!("a leaf of {points} points with an array for {size}"),
                ));
            }
        }
    }
    Ok(())
}

/// The leaves that touch a box, as they are, and nothing else: tiles hold no points.
fn leaves_in_box(points: PointTree, bbox: IndexBox, budget: &mut Budget) -> Result<PointTree> {
    let tree = &points.offsets;
    let last = (1 << tree.shape.leaf_log2()) - 1;
    let touches = |origin: &[i32; 3]| {
        (0..3).all(|i| origin[i] <= bbox[1][i] && bbox[0][i] <= origin[i].saturating_add(last))
    };
    let wanted: HashMap<[i32; 3], usize> =
        tree.leaves.origins.iter().enumerate().filter(|(_, o)| touches(o)).map(|(i, o)| (*o, i)).collect();
    budget.take(wanted.len(), 2 * OFFSETS_BYTES + 512, "the leaves in a box")?;
    let mut builder = TreeBuilder::new(tree.background, tree.shape);
    for (origin, leaf) in &wanted {
        builder.leaf(*origin, tree.leaves.mask(*leaf), tree.leaves.stored(*leaf));
    }
    let offsets = builder.build()?;
    // Where the leaves of the new tree come from: a builder orders them.
    let from: Vec<usize> =
        offsets.leaves.origins.iter().filter_map(|origin| wanted.get(origin).copied()).collect();
    let mut columns = Vec::with_capacity(points.columns.len());
    for column in &points.columns {
        let wanted_bytes: u64 = from.iter().map(|leaf| column.arrays[*leaf].bytes()).sum();
        budget.take(wanted_bytes as usize, 1, "the attributes in a box")?;
        let mut bytes = Vec::with_capacity(wanted_bytes as usize);
        let mut arrays = Vec::with_capacity(from.len());
        for leaf in &from {
            let array = column.arrays[*leaf];
            let (begin, len) = (array.begin as usize, array.bytes() as usize);
            arrays.push(Array { begin: bytes.len() as u64, ..array });
            bytes.extend_from_slice(column.bytes.get(begin..begin + len).unwrap_or_default());
        }
        columns.push(Column { arrays, bytes });
    }
    let set_of_leaf = from.iter().map(|leaf| points.set_of_leaf[*leaf]).collect();
    Ok(PointTree { offsets, attribute_sets: points.attribute_sets, set_of_leaf, columns })
}
