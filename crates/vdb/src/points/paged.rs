//! Where the bytes of point data stand in a file, and getting them from there.
//!
//! Arrays of attributes are small, so that OpenVDB gathers those of many leaves into pages of about a
//! megabyte before it compresses them; the sizes of all pages stand before the first. Without compression
//! each array stands on its own. Either way a column of arrays becomes a list of [`Piece`]s that decode
//! independently.
//!
//! Layout as in OpenVDB's `points/StreamCompression.cc`.

use super::attribute::Array;
use crate::codec::{self, CodecError, Scratch};
use crate::error::{Error, Result};
use crate::limits::Budget;
use crate::source::{Reader, Source};

/// Blosc pads what is shorter than this with zeros.
const PADDED_BYTES: usize = 128;
/// Neighbouring pieces up to this size are read at once.
const TASK_BYTES: u64 = 1 << 20;
/// Larger tasks run one after the other, so that their working memory is that of one.
const MAX_PARALLEL_BYTES: u64 = 4 << 20;

/// Some bytes of a file that decode on their own.
#[derive(Debug, Clone, Copy)]
pub(super) struct Piece {
    pub(super) at: u64,
    pub(super) stored_bytes: u32,
    pub(super) is_compressed: bool,
    /// The size when decoded.
    pub(super) bytes: u64,
}

/// The size of a page, as it stands before all pages.
#[derive(Debug, Clone, Copy)]
pub(super) struct Page {
    stored_bytes: u32,
    bytes: u32,
    is_compressed: bool,
}

/// Reads the sizes of the pages of a column.
pub(super) fn page_sizes(
    reader: &mut Reader<'_>,
    arrays: &[Array],
    budget: &mut Budget,
) -> Result<Vec<Page>> {
    let mut pages = Vec::new();
    let mut left = 0;
    for array in arrays.iter().filter(|array| array.is_paged() && array.bytes() > 0) {
        if left == 0 {
            let page = page_size(reader)?;
            // Twice for the growth of the vector.
            budget.take(2, size_of::<Page>(), "the sizes of pages")?;
            pages.push(page);
            left = u64::from(page.bytes);
        }
        left = left
            .checked_sub(array.bytes())
            .ok_or_else(|| reader.malformed("an array of an attribute passes the end of its page"))?;
    }
    match left {
        0 => Ok(pages),
        _ => Err(reader.malformed(format!("a page holds {left} bytes more than its arrays"))),
    }
}

fn page_size(reader: &mut Reader<'_>) -> Result<Page> {
    let at = reader.offset();
    let stored = reader.i32("the size of a page")?;
    let is_compressed = stored > 0;
    let stored_bytes = stored.unsigned_abs();
    let bytes = match is_compressed {
        true => reader.i32("the size of a page")?,
        false => stored.wrapping_neg(),
    };
    match u32::try_from(bytes) {
        // Pages that do not shrink are not compressed.
        Ok(bytes) if bytes > 0 && stored_bytes <= bytes => Ok(Page { stored_bytes, bytes, is_compressed }),
        _ => Err(Error::malformed(at, format!("a page of {bytes} bytes stored in {stored}"))),
    }
}

/// Moves past the arrays of a column and says where they are.
pub(super) fn locate(
    reader: &mut Reader<'_>,
    arrays: &[Array],
    stored_bytes: &[u64],
    pages: Vec<Page>,
    budget: &mut Budget,
) -> Result<Vec<Piece>> {
    if !pages.is_empty() {
        budget.take(pages.len(), size_of::<Piece>(), "the pages of attributes")?;
        let locate = |page: Page| {
            let at = reader.offset();
            reader.skip(page.stored_bytes.into(), "a page of attributes")?;
            let Page { stored_bytes, bytes, is_compressed } = page;
            Ok(Piece { at, stored_bytes, is_compressed, bytes: bytes.into() })
        };
        return pages.into_iter().map(locate).collect();
    }
    budget.take(stored_bytes.len(), size_of::<Piece>(), "the arrays of attributes")?;
    let mut pieces = Vec::with_capacity(stored_bytes.len());
    let alone = arrays.iter().filter(|array| array.is_alone());
    for (array, stored) in alone.zip(stored_bytes) {
        let is_compressed = match array.is_uniform() {
            true => false,
            false => reader.u8("an array of an attribute")? == 1,
        };
        let at = reader.offset();
        reader.skip(*stored, "an array of an attribute")?;
        let bytes = array.bytes();
        let is_plausible = if is_compressed { *stored <= bytes } else { *stored == bytes };
        let Some(stored_bytes) = u32::try_from(*stored).ok().filter(|_| is_plausible) else {
            return Err(Error::malformed(at, format!("an array of {stored} bytes that stands for {bytes}")));
        };
        pieces.push(Piece { at, stored_bytes, is_compressed, bytes });
    }
    Ok(pieces)
}

/// Decodes pieces, one after the other in memory as in the list. `worked_bytes` is what the budget has been
/// asked for working memory so far.
pub(super) fn decode(
    source: &dyn Source,
    pieces: &[Piece],
    budget: &mut Budget,
    worked_bytes: &mut u64,
    what: &str,
) -> Result<Vec<u8>> {
    let total = pieces.iter().fold(0_u64, |sum, piece| sum.saturating_add(piece.bytes));
    let total = usize::try_from(total).unwrap_or(usize::MAX);
    budget.take(total, 1, what)?;
    let mut bytes = vec![0; total];
    let (mut small, mut large) = (Vec::new(), Vec::new());
    let mut rest = &mut bytes[..];
    let mut largest = 0;
    for task in tasks(pieces) {
        let size = task.iter().map(|piece| piece.bytes as usize).sum();
        let (out, after) = rest.split_at_mut(size);
        rest = after;
        let working_bytes = span(task) + size as u64;
        largest = largest.max(working_bytes);
        if working_bytes <= MAX_PARALLEL_BYTES { small.push((task, out)) } else { large.push((task, out)) }
    }
    if largest > MAX_PARALLEL_BYTES.max(*worked_bytes) {
        budget.take((largest - *worked_bytes) as usize, 1, what)?;
        *worked_bytes = largest;
    }
    let decode_task = |(task, mut out): (&[Piece], &mut [u8]), scratch: &mut Scratch| -> Result<()> {
        let Some(first) = task.first() else { return Ok(()) };
        let stored = source.range(first.at, span(task) as usize)?;
        for piece in task {
            let (piece_out, after) = out.split_at_mut(piece.bytes as usize);
            out = after;
            let begin = (piece.at - first.at) as usize;
            let stored = stored.get(begin..begin + piece.stored_bytes as usize).unwrap_or_default();
            piece.decode(stored, piece_out, scratch)?;
        }
        Ok(())
    };
    let mut scratch = Scratch::default();
    large.into_iter().try_for_each(|task| decode_task(task, &mut scratch))?;
    drop(scratch);
    for_each(small, decode_task)?;
    Ok(bytes)
}

/// Runs over items, in parallel where that is built in.
pub(super) fn for_each<T: Send>(
    items: Vec<T>,
    run: impl Fn(T, &mut Scratch) -> Result<()> + Sync,
) -> Result<()> {
    #[cfg(feature = "parallel")]
    {
        use rayon::prelude::*;
        items.into_par_iter().try_for_each_init(Scratch::default, |scratch, item| run(item, scratch))
    }
    #[cfg(not(feature = "parallel"))]
    {
        let mut scratch = Scratch::default();
        items.into_iter().try_for_each(|item| run(item, &mut scratch))
    }
}

/// Cuts a list into runs of pieces that are read at once.
pub(super) fn tasks(pieces: &[Piece]) -> impl Iterator<Item = &[Piece]> {
    let mut rest = pieces;
    std::iter::from_fn(move || {
        let first = rest.first()?;
        let is_near = |piece: &&Piece| piece.at + u64::from(piece.stored_bytes) - first.at <= TASK_BYTES;
        let mut size = 0_u64;
        let count = rest
            .iter()
            .take_while(is_near)
            .take_while(|piece| {
                size = size.saturating_add(piece.bytes);
                size <= TASK_BYTES
            })
            .count();
        let (task, after) = rest.split_at(count.max(1));
        rest = after;
        Some(task)
    })
}

/// The bytes of the file from the first to the last piece.
pub(super) fn span(task: &[Piece]) -> u64 {
    match (task.first(), task.last()) {
        (Some(first), Some(last)) => last.at + u64::from(last.stored_bytes) - first.at,
        _ => 0,
    }
}

impl Piece {
    /// Decodes the piece from what is stored of it.
    pub(super) fn decode(&self, stored: &[u8], out: &mut [u8], scratch: &mut Scratch) -> Result<()> {
        if !self.is_compressed {
            if stored.len() != out.len() {
                return Err(Error::malformed(self.at, "an array of another size than its values"));
            }
            out.copy_from_slice(stored);
            return Ok(());
        }
        let chunk_bytes = stored.get(4..8).and_then(|size| size.try_into().ok()).map(u32::from_le_bytes);
        let is_padded = out.len() < PADDED_BYTES && chunk_bytes == Some(PADDED_BYTES as u32);
        let result = if is_padded {
            let mut padded = [0; PADDED_BYTES];
            let result = codec::blosc::decompress(stored, &mut padded, scratch);
            out.copy_from_slice(&padded[..out.len()]);
            result
        } else {
            codec::blosc::decompress(stored, out, scratch)
        };
        result.map_err(|error| match error {
            CodecError::Malformed(what) => Error::malformed(self.at, what),
            CodecError::Unsupported(feature) => {
                Error::unsupported(format!("{feature} (at byte {})", self.at))
            }
        })
    }
}
