//! Reading: an asset is opened without its pages, which come as they are needed.

use std::borrow::Cow;
use std::ops::Range;

use super::contents::Contents;
use super::error::{FormatError, Limits};
use super::layout::{self, Kind, Row};
use super::source::ReadAt;
use super::{arrays, check, page};
use crate::codec::{Codec, DecodeError};
use crate::packed::store::BrickStore;
use crate::packed::{Content, TreeRef, Trees, mask};
use crate::space::{BRICK_VOXELS, NODE4_SLOTS, NODE5_SLOTS};

/// The most words of a page.
const MAX_PAGE_WORDS: u32 = 1 << 20;

/// A packed volume: contents, trees, and bricks as far as they are loaded.
pub struct Asset {
    contents: Contents,
    trees: Trees,
    store: BrickStore,
    file: Option<File>,
}

/// Where the pages of an asset come from.
struct File {
    source: Box<dyn ReadAt>,
    limits: Limits,
    /// The chunk of each page.
    pages: Vec<Row>,
    /// The memory of all that is not bricks.
    other_bytes: u64,
}

/// A page as it stands in its file, and its words.
pub(super) struct StoredPage<'a> {
    pub(super) row: Row,
    pub(super) stored: Cow<'a, [u8]>,
    pub(super) words: Vec<u32>,
}

/// The memory that an asset takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MemoryBytes {
    /// The arrays of the trees.
    pub trees: usize,
    /// The bricks that are loaded, and what is known of all.
    pub bricks: usize,
    /// The shapes.
    pub shapes: usize,
    /// Channels and frames.
    pub contents: usize,
}

impl MemoryBytes {
    /// All of it.
    pub fn total(self) -> usize {
        self.trees + self.bricks + self.shapes + self.contents
    }
}

/// Reads chunks one after the other, and adds up what is kept of them.
struct Chunks<'a> {
    source: &'a dyn ReadAt,
    limits: Limits,
    rows: &'a [Row],
    kept_bytes: u64,
}

impl Chunks<'_> {
    /// The one chunk of a kind. `kept` is how many bytes each decoded byte will be kept as.
    fn read(&mut self, kind: Kind, kept: u64) -> Result<(Vec<u8>, u64), FormatError> {
        let mut rows = self.rows.iter().filter(|row| row.kind == Some(kind));
        let (Some(row), None) = (rows.next(), rows.next()) else {
            let name = kind.letters();
            let what = format!("the file does not hold exactly one chunk {}", name.escape_ascii());
            return Err(FormatError::malformed(0, what));
        };
        let kept_bytes = row.decoded_bytes.saturating_mul(kept);
        let terms = [self.kept_bytes, row.stored_bytes, row.decoded_bytes, kept_bytes];
        self.limits.check(&terms, "opening the file")?;
        let bytes = layout::read_chunk(self.source, row)?;
        self.kept_bytes = self.kept_bytes.saturating_add(kept_bytes);
        Ok((bytes, row.offset))
    }

    fn codecs(&mut self, kind: Kind) -> Result<Vec<Codec>, FormatError> {
        // A codec takes two bytes, and a quarter of one for where it begins.
        let (tags, at) = self.read(kind, 3)?;
        let codecs: Option<Vec<Codec>> = tags.iter().map(|tag| Codec::from_tag(*tag)).collect();
        codecs.ok_or_else(|| FormatError::malformed(at, "a brick of an unknown codec"))
    }
}

impl Asset {
    /// Opens a file, with the default limits.
    ///
    /// # Errors
    /// As those of [`Asset::open_with`].
    pub fn open(source: impl ReadAt + 'static) -> Result<Asset, FormatError> {
        Asset::open_with(source, Limits::default())
    }

    /// Opens a file: reads and checks everything but the pages of bricks.
    ///
    /// # Errors
    /// If the source fails, the file is damaged or of a later version, or it asks for more memory than the limits allow.
    pub fn open_with(source: impl ReadAt + 'static, limits: Limits) -> Result<Asset, FormatError> {
        let rows = layout::read_table(&source, &limits)?;
        let kept_bytes = size_of_val(rows.as_slice()) as u64;
        let mut chunks = Chunks { source: &source, limits, rows: &rows, kept_bytes };
        // A grid in memory takes at most a few times its text.
        let (json, contents_at) = chunks.read(Kind::Contents, 8)?;
        let mut contents: Contents = serde_json::from_slice(&json)
            .map_err(|error| FormatError::malformed(contents_at, format!("contents: {error}")))?;
        let (headers, at) = chunks.read(Kind::SourceHeaders, 1)?;
        decode_source_headers(&headers, &mut contents)
            .ok_or_else(|| FormatError::malformed(at, "source headers that are not those of all grids"))?;
        let pages: Vec<Row> = rows.iter().filter(|row| row.kind == Some(Kind::Page)).copied().collect();
        let (store, shapes_at) = open_store(&mut chunks, &pages)?;
        let mut read = |kind| chunks.read(kind, 1).map(|(bytes, _)| bytes);
        let arrays = [
            read(Kind::Cells)?,
            read(Kind::Node5s)?,
            read(Kind::Node4s)?,
            read(Kind::Entries)?,
            read(Kind::Masks)?,
        ];
        let trees = arrays::decode_trees(arrays)
            .ok_or_else(|| FormatError::malformed(shapes_at, "trees of broken records"))?;
        check::check(&contents, &trees, &store).map_err(|what| FormatError::malformed(contents_at, what))?;
        let mut asset = Asset { contents, trees, store, file: None };
        let other_bytes = (asset.memory_bytes().total() - asset.store.brick_bytes()) as u64;
        asset.file = Some(File { source: Box::new(source), limits, pages, other_bytes });
        Ok(asset)
    }

    /// An asset in memory.
    ///
    /// # Errors
    /// If contents, trees and bricks do not fit together.
    pub fn from_parts(contents: Contents, trees: Trees, store: BrickStore) -> Result<Asset, FormatError> {
        check::check(&contents, &trees, &store).map_err(FormatError::Misuse)?;
        Ok(Asset { contents, trees, store, file: None })
    }

    /// Channels and frames.
    pub fn contents(&self) -> &Contents {
        &self.contents
    }

    /// The trees of all grids.
    pub fn trees(&self) -> &Trees {
        &self.trees
    }

    /// The bricks.
    pub fn store(&self) -> &BrickStore {
        &self.store
    }

    /// The memory taken.
    pub fn memory_bytes(&self) -> MemoryBytes {
        MemoryBytes {
            trees: self.trees.size_bytes(),
            bricks: self.store.brick_bytes(),
            shapes: self.store.shape_bytes(),
            contents: self.contents.memory_bytes(),
        }
    }

    /// Decodes a brick of a channel.
    ///
    /// # Errors
    /// If its page is not loaded, or its words are not all there or hold what none can.
    pub fn decode(
        &self,
        channel: usize,
        codec: Codec,
        offset: u32,
        out: &mut [f32; BRICK_VOXELS],
    ) -> Result<(), DecodeError> {
        let channel = self.contents.channels.get(channel).ok_or(DecodeError::OutOfStore)?;
        self.store.decode(codec, offset, channel.unit, channel.floor, out)
    }

    /// The pages that the bricks of a frame stand in, all levels included.
    ///
    /// # Errors
    /// If there is no such frame.
    pub fn pages_of_frame(&self, frame: usize) -> Result<Vec<usize>, FormatError> {
        let none = || FormatError::Misuse(format!("frame {frame} of {}", self.contents.frames.len()));
        let frame = self.contents.frames.get(frame).ok_or_else(none)?;
        let mut walk = Walk {
            node5s: vec![false; self.trees.node5s.len()],
            node4s: vec![false; self.trees.node4s.len()],
            pages: vec![false; self.store.pages().len()],
        };
        frame.grids.iter().flat_map(|grid| &grid.levels).for_each(|tree| walk.tree(self, *tree));
        Ok((0..walk.pages.len()).filter(|page| walk.pages[*page]).collect())
    }

    /// Loads the pages that a frame needs, as far as they are absent.
    ///
    /// # Errors
    /// If there is no such frame, the source fails, a page is damaged, or memory runs out.
    pub fn load_frame(&mut self, frame: usize) -> Result<(), FormatError> {
        self.pages_of_frame(frame)?.into_iter().try_for_each(|page| self.load_page(page))
    }

    /// Loads all pages that are absent.
    ///
    /// # Errors
    /// As those of [`Asset::load_frame`].
    pub fn load_all(&mut self) -> Result<(), FormatError> {
        (0..self.store.pages().len()).try_for_each(|page| self.load_page(page))
    }

    /// Loads the pages that hold bricks of these numbers.
    ///
    /// # Errors
    /// As those of [`Asset::load_frame`].
    pub fn load_bricks(&mut self, bricks: Range<usize>) -> Result<(), FormatError> {
        self.store.pages_of(bricks).try_for_each(|page| self.load_page(page))
    }

    /// Loads a page, if it is absent.
    ///
    /// # Errors
    /// As those of [`Asset::load_frame`].
    pub fn load_page(&mut self, page: usize) -> Result<(), FormatError> {
        match self.store.pages().get(page) {
            Some(present) if present.words().is_some() => Ok(()),
            _ => {
                let words = self.read_page(page)?;
                self.set_page(page, words)
            }
        }
    }

    /// The words of a page, read from the file whether the page is present or not. Pages may be read in parallel and
    /// then handed to [`Asset::set_page`]; each is held to the limits as if it were alone.
    ///
    /// # Errors
    /// If there is no such page, the source fails, the page is damaged, or memory runs out.
    pub fn read_page(&self, page: usize) -> Result<Vec<u32>, FormatError> {
        Ok(self.read_stored_page(page)?.words)
    }

    /// A page as it is stored, and its words.
    pub(super) fn read_stored_page(&self, page: usize) -> Result<StoredPage<'_>, FormatError> {
        let (file, row) = self.page_row(page)?;
        let page = &self.store.pages()[page];
        let word_bytes = 4 * u64::from(page.word_count);
        let terms = [
            file.other_bytes,
            self.store.brick_bytes() as u64,
            row.stored_bytes,
            row.decoded_bytes,
            word_bytes,
        ];
        file.limits.check(&terms, "loading bricks")?;
        let codecs = &self.store.codecs()[page.bricks()];
        let stored = layout::read_stored(&*file.source, row)?;
        let words = page::decode(codecs, &layout::decode_chunk(&stored, row)?);
        let damaged = || FormatError::malformed(row.offset, "a page of other bricks than the codecs say");
        Ok(StoredPage { row: *row, words: words.ok_or_else(damaged)?, stored })
    }

    fn page_row(&self, page: usize) -> Result<(&File, &Row), FormatError> {
        let found = self.file.as_ref().and_then(|file| Some((file, file.pages.get(page)?)));
        found
            .filter(|_| page < self.store.pages().len())
            .ok_or_else(|| FormatError::Misuse(format!("page {page} does not stand in a file")))
    }

    /// Holds the stored bytes of all pages against their checksums, without decoding them.
    ///
    /// # Errors
    /// If the source fails or a page is damaged.
    pub fn check_pages(&self) -> Result<(), FormatError> {
        (0..self.store.pages().len()).try_for_each(|page| {
            let (file, row) = self.page_row(page)?;
            file.limits.check(&[file.other_bytes, row.stored_bytes], "checking bricks")?;
            layout::read_stored(&*file.source, row).map(drop)
        })
    }

    /// Makes a page present.
    ///
    /// # Errors
    /// If the words cannot be those of the page.
    pub fn set_page(&mut self, page: usize, words: Vec<u32>) -> Result<(), FormatError> {
        let row = self.file.as_ref().and_then(|file| file.pages.get(page));
        let at = row.map_or(0, |row| row.offset);
        self.store.set_page(page, words).map_err(|error| FormatError::malformed(at, error.to_string()))
    }

    /// Makes a page absent that can be loaded again.
    pub fn drop_page(&mut self, page: usize) {
        if self.file.is_some() {
            self.store.drop_page(page);
        }
    }
}

/// Reads codecs and shapes. Gives the offset of the shapes, too.
fn open_store(chunks: &mut Chunks, pages: &[Row]) -> Result<(BrickStore, u64), FormatError> {
    let codecs = chunks.codecs(Kind::Codecs)?;
    let shape_codecs = chunks.codecs(Kind::ShapeCodecs)?;
    // A code of one bit may be stored as a byte and is kept as an eighth; nothing grows.
    let (bytes, shapes_at) = chunks.read(Kind::Shapes, 4)?;
    let shape_bytes = shape_codecs.iter().map(|codec| 4 * codec.word_count() as u64).sum::<u64>();
    chunks.limits.check(&[chunks.kept_bytes, shape_bytes], "the shapes")?;
    let malformed = |at: u64, what: &str| FormatError::malformed(at, what);
    let words = page::decode(&shape_codecs, &bytes)
        .ok_or_else(|| malformed(shapes_at, "shapes of other codecs than the file says"))?;
    let mut first = 0_u32;
    for page in pages {
        let bricks = codecs.get(first as usize..).and_then(|rest| rest.get(..page.bricks[1] as usize));
        let bricks = bricks.filter(|_| page.bricks[0] == first);
        let bricks =
            bricks.ok_or_else(|| malformed(page.offset, "a page that does not follow the one before"))?;
        let words = bricks.iter().map(|codec| codec.word_count() as u64).sum::<u64>();
        if words > u64::from(MAX_PAGE_WORDS) || page.decoded_bytes > page::max_encoded_bytes(bricks) {
            return Err(malformed(page.offset, "a page larger than its bricks"));
        }
        first += page.bricks[1];
    }
    let counts: Vec<u32> = pages.iter().map(|page| page.bricks[1]).collect();
    let store = BrickStore::without_pages(&codecs, &counts, &shape_codecs, words);
    Ok((store.map_err(|error| malformed(shapes_at, &error.to_string()))?, shapes_at))
}

/// Gives each grid its source header.
fn decode_source_headers(bytes: &[u8], contents: &mut Contents) -> Option<()> {
    let (words, _) = bytes.as_chunks::<4>();
    let mut numbers = words.iter().map(|word| u32::from_le_bytes(*word) as usize);
    let count = numbers.next()?;
    let mut rest = bytes.get(count.checked_add(1)?.checked_mul(4)?..)?;
    let mut grids = contents.frames.iter_mut().flat_map(|frame| &mut frame.grids);
    for len in numbers.take(count) {
        grids.next()?.source_header = rest.split_off(..len)?.to_vec();
    }
    (grids.next().is_none() && rest.is_empty()).then_some(())
}

/// What of trees was seen.
struct Walk {
    node5s: Vec<bool>,
    node4s: Vec<bool>,
    pages: Vec<bool>,
}

impl Walk {
    fn tree(&mut self, asset: &Asset, tree: TreeRef) {
        for cell in asset.trees.cells_of(tree) {
            let Some(Content::Node(node5)) = cell.entry.content() else { continue };
            for content in entries(&asset.trees, &asset.trees.node5s, node5, NODE5_SLOTS, &mut self.node5s) {
                let Content::Node(node4) = content else { continue };
                for content in
                    entries(&asset.trees, &asset.trees.node4s, node4, NODE4_SLOTS, &mut self.node4s)
                {
                    let Content::Brick { offset, .. } = content else { continue };
                    asset.store.page_of(offset).into_iter().for_each(|page| self.pages[page] = true);
                }
            }
        }
    }
}

/// What a node holds, if it was not seen before.
fn entries<'a>(
    trees: &'a Trees,
    nodes: &[crate::packed::Node],
    node: u32,
    slots: usize,
    seen: &mut [bool],
) -> impl Iterator<Item = Content> + 'a {
    let is_seen = seen.get_mut(node as usize).map(|seen| std::mem::replace(seen, true));
    let node = nodes.get(node as usize).filter(|_| is_seen == Some(false));
    let range = node.and_then(|node| {
        let bits = mask::decode(&trees.masks, node.mask, slots)?;
        let count = bits.iter().map(|word| word.count_ones() as usize).sum::<usize>();
        let first = node.first_entry as usize;
        trees.entries.get(first..first + count)
    });
    range.unwrap_or_default().iter().filter_map(|entry| entry.content())
}
