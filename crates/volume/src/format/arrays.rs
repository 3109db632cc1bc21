//! The bytes of the arrays of [`Trees`] before they are compressed, and back.
//!
//! An array of records of several words is split into columns, and those into byte planes. In columns of indices, which
//! mostly grow, each word but the first is stored less the one before.

use super::page::{word_planes, words_of_planes};
use crate::packed::{Entry, Node, RootCell, Trees};

/// Which columns of a record hold differences.
type Columns<const N: usize> = [bool; N];

const CELL: Columns<5> = [false, false, false, true, false];
const NODE: Columns<2> = [true, true];
const ENTRY: Columns<2> = [true, false];

fn encode<const N: usize>(records: impl Iterator<Item = [u32; N]> + Clone, columns: Columns<N>) -> Vec<u8> {
    let mut out = Vec::new();
    for (i, is_difference) in columns.into_iter().enumerate() {
        let mut before = 0;
        let column = records.clone().map(|record| match is_difference {
            true => record[i].wrapping_sub(std::mem::replace(&mut before, record[i])),
            false => record[i],
        });
        out.extend(word_planes(&column.collect::<Vec<u32>>()));
    }
    out
}

/// The records of bytes. `None` if there are not whole records.
fn decode<T: From<[u32; N]>, const N: usize>(bytes: &[u8], columns: Columns<N>) -> Option<Vec<T>> {
    let count = bytes.len() / (4 * N);
    if count * 4 * N != bytes.len() {
        return None;
    }
    let mut sums = [0_u32; N];
    let mut words: [_; N] =
        std::array::from_fn(|i| words_of_planes(&bytes[i * 4 * count..(i + 1) * 4 * count]));
    let record = |_| {
        let mut record = [0; N];
        for i in 0..N {
            let word = words[i].next()?;
            sums[i] = if columns[i] { sums[i].wrapping_add(word) } else { word };
            record[i] = sums[i];
        }
        Some(T::from(record))
    };
    (0..count).map(record).collect()
}

impl From<[u32; 5]> for RootCell {
    fn from([x, y, z, payload, kind]: [u32; 5]) -> RootCell {
        RootCell { cell: [x, y, z].map(u32::cast_signed), entry: Entry { payload, kind } }
    }
}

impl From<[u32; 2]> for Node {
    fn from([mask, first_entry]: [u32; 2]) -> Node {
        Node { mask, first_entry }
    }
}

impl From<[u32; 2]> for Entry {
    fn from([payload, kind]: [u32; 2]) -> Entry {
        Entry { payload, kind }
    }
}

pub(super) fn encode_cells(cells: &[RootCell]) -> Vec<u8> {
    let record = |RootCell { cell, entry }: &RootCell| {
        let [x, y, z] = cell.map(i32::cast_unsigned);
        [x, y, z, entry.payload, entry.kind]
    };
    encode(cells.iter().map(record), CELL)
}

pub(super) fn encode_nodes(nodes: &[Node]) -> Vec<u8> {
    encode(nodes.iter().map(|node| [node.mask, node.first_entry]), NODE)
}

pub(super) fn encode_entries(entries: &[Entry]) -> Vec<u8> {
    encode(entries.iter().map(|entry| [entry.payload, entry.kind]), ENTRY)
}

pub(super) fn encode_masks(masks: &[u32]) -> Vec<u8> {
    encode(masks.iter().map(|word| [*word]), [false])
}

/// The arrays from the bytes of cells, `Node5`, `Node4`, entries and masks. `None` if one does not hold whole records.
pub(super) fn decode_trees([cells, node5s, node4s, entries, masks]: [Vec<u8>; 5]) -> Option<Trees> {
    Some(Trees {
        cells: decode(&cells, CELL)?,
        node5s: decode(&node5s, NODE)?,
        node4s: decode(&node4s, NODE)?,
        entries: decode(&entries, ENTRY)?,
        masks: decode::<Word, 1>(&masks, [false])?.into_iter().map(|Word(word)| word).collect(),
    })
}

struct Word(u32);

impl From<[u32; 1]> for Word {
    fn from([word]: [u32; 1]) -> Word {
        Word(word)
    }
}
