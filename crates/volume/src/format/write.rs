//! Writing: pages leave as soon as they are full, the rest and the table of contents come last.
//!
//! The encoder of Zstandard is the caller's: a good one is no pure Rust. What bricks there are, and how they are
//! encoded, is the pipeline's.

use std::io::{Seek, SeekFrom, Write};

use xxhash_rust::xxh3::xxh3_64;

use super::contents::Contents;
use super::error::FormatError;
use super::layout::{self, HEADER_BYTES, Kind, Row};
use super::read::Asset;
use super::{arrays, check, page};
use crate::codec::Codec;
use crate::packed::Trees;
use crate::packed::store::{BrickStore, PAGE_WORDS, StoreError};

/// Makes one Zstandard frame of bytes, or nothing if it cannot: they are then stored as they are. Its window must not
/// exceed the larger of 8 MiB and the bytes given.
pub type Compress<'a> = dyn Fn(&[u8]) -> Vec<u8> + Sync + 'a;

/// Where the bytes of a file went.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Summary {
    /// The stored bytes of all chunks of each kind, in the order of [`Kind::ALL`].
    pub chunk_bytes: Vec<(Kind, u64)>,
    /// The size of the file.
    pub file_bytes: u64,
}

/// Writes a file. The same calls give the same bytes, as long as `compress` does.
pub struct Writer<'a, W> {
    out: W,
    compress: &'a Compress<'a>,
    /// All bricks so far; pages that were written are absent.
    store: BrickStore,
    written_pages: usize,
    rows: Vec<Row>,
    /// Where the next chunk begins.
    at: u64,
    /// What the file begins after, in the sink.
    begin: u64,
}

fn misuse(error: StoreError) -> FormatError {
    FormatError::Misuse(error.to_string())
}

impl<'a, W: Write + Seek> Writer<'a, W> {
    /// Begins a file at the sink's position.
    ///
    /// # Errors
    /// If the sink fails.
    pub fn new(mut out: W, compress: &'a Compress<'a>) -> Result<Self, FormatError> {
        let begin = out.stream_position()?;
        // No header yet: a file that is not finished is not taken for one.
        out.write_all(&[0; HEADER_BYTES])?;
        let (store, rows) = (BrickStore::default(), Vec::new());
        Ok(Writer { out, compress, store, written_pages: 0, rows, at: HEADER_BYTES as u64, begin })
    }

    /// Adds a brick. Gives its offset in the brick store.
    ///
    /// # Errors
    /// If the sink fails, the words are no brick of that codec, its shape was not added before, or there are more than
    /// 2³² words.
    pub fn brick(&mut self, codec: Codec, words: &[u32]) -> Result<u32, FormatError> {
        let offset = self.store.push(codec, words).map_err(misuse)?;
        if self.store.pages().last().is_some_and(|page| page.word_count as usize >= PAGE_WORDS) {
            self.write_page()?;
        }
        Ok(offset)
    }

    /// Adds a shape. Gives its offset in the shape store.
    ///
    /// # Errors
    /// If the words are no brick of that codec, or it is that of a shared one.
    pub fn shape(&mut self, codec: Codec, words: &[u32]) -> Result<u32, FormatError> {
        self.store.push_shape(codec, words).map_err(misuse)
    }

    /// Adds all bricks of a page of another file, whose stored bytes are taken as they are. Its shapes have been added,
    /// in the same order. Gives the words, and the offset of the first.
    ///
    /// # Errors
    /// If the sink fails, there is no such page, it is damaged, or there are too many words.
    pub fn copy_page(&mut self, from: &Asset, page: usize) -> Result<(Vec<u32>, u32), FormatError> {
        let copied = from.read_stored_page(page)?;
        let codecs = &from.store().codecs()[from.store().pages()[page].bricks()];
        self.write_page()?;
        let offset = self.store.offset(self.store.codecs().len());
        let first_brick = self.store.push_page(codecs, &copied.words).map_err(misuse)?;
        self.store.drop_page(self.written_pages);
        self.written_pages += 1;
        let row = Row { offset: self.at, bricks: [first_brick, copied.row.bricks[1]], ..copied.row };
        self.chunk_as_it_is(row, &copied.stored)?;
        Ok((copied.words, offset))
    }

    /// The words of all shapes that were added, from which their offsets count.
    pub fn shape_words(&self) -> &[u32] {
        self.store.shape_words()
    }

    /// Writes the last page, and makes it absent.
    fn write_page(&mut self) -> Result<(), FormatError> {
        let Some(page) = self.store.pages().get(self.written_pages) else { return Ok(()) };
        let bricks = [page.first_brick, page.brick_count];
        let codecs = &self.store.codecs()[page.bricks()];
        let bytes = page::encode(codecs, page.words().unwrap_or_default());
        self.store.drop_page(self.written_pages);
        self.written_pages += 1;
        self.chunk(Kind::Page, &bytes, bricks)
    }

    fn chunk(&mut self, kind: Kind, bytes: &[u8], bricks: [u32; 2]) -> Result<(), FormatError> {
        let compressed = (self.compress)(bytes);
        let is_compressed = !compressed.is_empty() && compressed.len() < bytes.len();
        let stored = if is_compressed { &compressed } else { bytes };
        let (stored_bytes, decoded_bytes) = (stored.len() as u64, bytes.len() as u64);
        let checksum = xxh3_64(stored);
        let kind = Some(kind);
        let row = Row { kind, is_compressed, offset: self.at, stored_bytes, decoded_bytes, checksum, bricks };
        self.chunk_as_it_is(row, stored)
    }

    fn chunk_as_it_is(&mut self, row: Row, stored: &[u8]) -> Result<(), FormatError> {
        self.out.write_all(stored)?;
        self.at += row.stored_bytes;
        self.rows.push(row);
        Ok(())
    }

    /// Writes everything that is left, and last the header: until then there is no file.
    ///
    /// # Errors
    /// If the sink fails, or contents, trees and bricks do not fit together.
    pub fn finish(mut self, contents: &Contents, trees: &Trees) -> Result<Summary, FormatError> {
        self.write_page()?;
        check::check(contents, trees, &self.store).map_err(FormatError::Misuse)?;
        let json = serde_json::to_vec(contents).map_err(|error| FormatError::Misuse(error.to_string()))?;
        let tags = |codecs: &[Codec]| codecs.iter().map(|codec| codec.tag()).collect::<Vec<u8>>();
        let shapes = page::encode(self.store.shape_codecs(), self.store.shape_words());
        let chunks = [
            (Kind::ShapeCodecs, tags(self.store.shape_codecs())),
            (Kind::Shapes, shapes),
            (Kind::Codecs, tags(self.store.codecs())),
            (Kind::Masks, arrays::encode_masks(&trees.masks)),
            (Kind::Entries, arrays::encode_entries(&trees.entries)),
            (Kind::Node4s, arrays::encode_nodes(&trees.node4s)),
            (Kind::Node5s, arrays::encode_nodes(&trees.node5s)),
            (Kind::Cells, arrays::encode_cells(&trees.cells)),
            (Kind::SourceHeaders, encode_source_headers(contents)?),
            (Kind::Contents, json),
        ];
        for (kind, bytes) in chunks {
            self.chunk(kind, &bytes, [0; 2])?;
        }
        let table: Vec<u8> = self.rows.iter().flat_map(|row| row.to_bytes()).collect();
        self.out.write_all(&table)?;
        self.out.seek(SeekFrom::Start(self.begin))?;
        self.out.write_all(&layout::header(self.at, &table))?;
        let file_bytes = self.at + table.len() as u64;
        self.out.seek(SeekFrom::Start(self.begin + file_bytes))?;
        self.out.flush()?;
        let of_kind = |kind: Kind| {
            let rows = self.rows.iter().filter(|row| row.kind == Some(kind));
            (kind, rows.map(|row| row.stored_bytes).sum())
        };
        Ok(Summary { chunk_bytes: Kind::ALL.map(of_kind).to_vec(), file_bytes })
    }
}

/// How many headers there are, the length of each, and all of them.
fn encode_source_headers(contents: &Contents) -> Result<Vec<u8>, FormatError> {
    let headers: Vec<&[u8]> = contents.grids().map(|grid| &grid.source_header[..]).collect();
    let number = |len: usize| {
        let number = u32::try_from(len).map(u32::to_le_bytes);
        number.map_err(|_| FormatError::Misuse("source headers of more than 2³² bytes".to_owned()))
    };
    let mut out = number(headers.len())?.to_vec();
    for header in &headers {
        out.extend(number(header.len())?);
    }
    headers.iter().for_each(|header| out.extend_from_slice(header));
    Ok(out)
}

/// Writes all of a store at once. Every page must be present.
///
/// # Errors
/// As those of [`Writer`], and if a page is absent.
pub fn write(
    out: impl Write + Seek,
    contents: &Contents,
    trees: &Trees,
    store: &BrickStore,
    compress: &Compress,
) -> Result<Summary, FormatError> {
    let mut writer = Writer::new(out, compress)?;
    let mut rest = store.shape_words();
    for codec in store.shape_codecs() {
        let (words, after) = rest.split_at(codec.word_count());
        writer.shape(*codec, words)?;
        rest = after;
    }
    for page in store.pages() {
        let absent = || FormatError::Misuse("a page that is to be written is not in memory".to_owned());
        let mut rest = page.words().ok_or_else(absent)?;
        for codec in &store.codecs()[page.bricks()] {
            let (words, after) = rest.split_at(codec.word_count());
            writer.brick(*codec, words)?;
            rest = after;
        }
    }
    writer.finish(contents, trees)
}
