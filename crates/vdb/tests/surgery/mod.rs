//! Cuts and changes sound `.vdb` files to get those that no test data holds: streams, shared trees, damage.
//!
//! Where things stand in a file is found by a small parser of its own, so that what the crate says can be held
//! against it.

#![allow(dead_code, reason = "each test uses a part of this")]

/// The header bytes after the magic number: two versions, and whether grids have positions.
const HAS_OFFSETS_AT: usize = 20;
const FILE_METADATA_AT: usize = 8 + 4 + 8 + 1 + 36;

/// Where the parts of a sound file stand, in bytes from its start.
pub(crate) struct Layout {
    pub(crate) grid_count_at: usize,
    pub(crate) grids: Vec<Placed>,
}

/// Where a grid stands: name and type at `descriptor_at`, then three positions of eight bytes, then the grid.
pub(crate) struct Placed {
    pub(crate) descriptor_at: usize,
    pub(crate) positions_at: usize,
    pub(crate) begin: usize,
    pub(crate) end: usize,
}

pub(crate) fn layout(bytes: &[u8]) -> Layout {
    let mut at = FILE_METADATA_AT;
    let metadata_count = u32_at(bytes, at);
    at += 4;
    for _ in 0..3 * metadata_count {
        at = after_string(bytes, at);
    }
    let grid_count_at = at;
    at += 4;
    let mut grids = Vec::new();
    for _ in 0..u32_at(bytes, grid_count_at) {
        let descriptor_at = at;
        let positions_at = (0..3).fold(at, |at, _| after_string(bytes, at));
        let [begin, end] = [0, 16].map(|i| {
            let position = bytes[positions_at + i..][..8].try_into().unwrap();
            usize::try_from(i64::from_le_bytes(position)).unwrap()
        });
        grids.push(Placed { descriptor_at, positions_at, begin, end });
        at = end;
    }
    assert_eq!(at, bytes.len(), "the last grid ends with the file");
    Layout { grid_count_at, grids }
}

fn u32_at(bytes: &[u8], at: usize) -> usize {
    u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap()) as usize
}

fn after_string(bytes: &[u8], at: usize) -> usize {
    at + 4 + u32_at(bytes, at)
}

/// The same grids as a stream: no flag for positions, and zeros where they stood.
pub(crate) fn as_stream(bytes: &[u8]) -> Vec<u8> {
    let mut stream = bytes.to_vec();
    stream[HAS_OFFSETS_AT] = 0;
    for grid in layout(bytes).grids {
        stream[grid.positions_at..grid.positions_at + 24].fill(0);
    }
    stream
}

/// The file with its first grid alone.
pub(crate) fn first_grid(bytes: &[u8]) -> Vec<u8> {
    let Layout { grid_count_at, grids } = layout(bytes);
    let mut cut = bytes[..grids[0].end].to_vec();
    cut[grid_count_at] = 1;
    cut
}

/// A file of one grid cut after `len` bytes, with the grid's stated end moved to the cut.
pub(crate) fn cut_with_its_end(bytes: &[u8], layout: &Layout, len: usize) -> Vec<u8> {
    let end_at = layout.grids[0].positions_at + 16;
    let mut cut = bytes.to_vec();
    cut[end_at..end_at + 8].copy_from_slice(&(len as i64).to_le_bytes());
    cut.truncate(len);
    cut
}

/// The file with a further grid that shares the tree of another and is moved by `translation`.
pub(crate) fn with_instance(bytes: &[u8], name: &[u8], of: &[u8], translation: [f64; 3]) -> Vec<u8> {
    let count_at = layout(bytes).grid_count_at;
    let mut out = bytes.to_vec();
    out[count_at] += 1;
    push_instance(&mut out, name, of, translation);
    out
}

/// Appends a grid without a tree of its own.
pub(crate) fn push_instance(out: &mut Vec<u8>, name: &[u8], of: &[u8], translation: [f64; 3]) {
    for text in [name, b"Tree_float_5_4_3", of] {
        push_string(out, text);
    }
    let mut grid = vec![6, 0, 0, 0];
    grid.extend([0; 4]);
    push_string(&mut grid, b"TranslationMap");
    translation.iter().for_each(|c| grid.extend(c.to_le_bytes()));
    let begin = out.len() + 24;
    let end = begin + grid.len();
    [begin, end, end].iter().for_each(|position| out.extend((*position as i64).to_le_bytes()));
    out.extend(grid);
}

/// The header of a file of `grid_count` grids that has no metadata.
pub(crate) fn header(has_offsets: bool, grid_count: u32) -> Vec<u8> {
    let mut out = vec![0x20, 0x42, 0x44, 0x56, 0, 0, 0, 0];
    [224_u32, 10, 0].iter().for_each(|number| out.extend(number.to_le_bytes()));
    out.push(has_offsets.into());
    out.extend([b'0'; 36]);
    [0, grid_count].iter().for_each(|number| out.extend(number.to_le_bytes()));
    out
}

pub(crate) fn push_string(out: &mut Vec<u8>, text: &[u8]) {
    out.extend((text.len() as u32).to_le_bytes());
    out.extend(text);
}
