//! The frame of a file: its header, its table of contents, and the checked bytes of one chunk.
//!
//! What the bytes of a chunk mean, once decompressed, is not known here. All numbers are little-endian; `docs/format.md`
//! is the specification.

use std::borrow::Cow;
use std::io::Read;

use ruzstd::decoding::{BlockDecodingStrategy, FrameDecoder};
use xxhash_rust::xxh3::xxh3_64;

use super::error::{FormatError, Limits};
use super::source::ReadAt;

/// The first bytes of every file. A line break that is changed on the way is noticed.
pub(super) const MAGIC: [u8; 8] = *b"NUAGE\r\n\x1a";
/// Files of a higher major version are not read.
pub(super) const MAJOR_VERSION: u16 = 1;
/// Files of a higher minor version are read, without what is new in them.
pub(super) const MINOR_VERSION: u16 = 0;
/// The bytes of the header.
pub(super) const HEADER_BYTES: usize = 64;
/// The bytes of a row of the table of contents.
pub(super) const ROW_BYTES: usize = 48;

/// Decompressed bytes per stored byte: a block of Zstandard takes at least four bytes and gives at most 128 KiB.
const MAX_EXPANSION: u64 = (128 << 10) / 4;
/// Windows up to this size are accepted for chunks of any size.
const MIN_WINDOW_LIMIT: u64 = 8 << 20;

/// What a chunk holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Kind {
    /// Channels and frames, as JSON.
    Contents,
    /// The source headers of all grids.
    SourceHeaders,
    /// The root cells of all trees.
    Cells,
    /// All `Node5`.
    Node5s,
    /// All `Node4`.
    Node4s,
    /// The entries of all nodes.
    Entries,
    /// The masks of all nodes.
    Masks,
    /// The codecs of all bricks.
    Codecs,
    /// The codecs of all shapes.
    ShapeCodecs,
    /// The words of all shapes.
    Shapes,
    /// The words of some bricks.
    Page,
}

impl Kind {
    /// All kinds; all but the last stand in a file once.
    pub const ALL: [Kind; 11] = [
        Kind::Contents,
        Kind::SourceHeaders,
        Kind::Cells,
        Kind::Node5s,
        Kind::Node4s,
        Kind::Entries,
        Kind::Masks,
        Kind::Codecs,
        Kind::ShapeCodecs,
        Kind::Shapes,
        Kind::Page,
    ];

    /// Its four letters in a file.
    pub(super) fn letters(self) -> [u8; 4] {
        *match self {
            Kind::Contents => b"CONT",
            Kind::SourceHeaders => b"HEAD",
            Kind::Cells => b"CELL",
            Kind::Node5s => b"NOD5",
            Kind::Node4s => b"NOD4",
            Kind::Entries => b"ENTR",
            Kind::Masks => b"MASK",
            Kind::Codecs => b"CODE",
            Kind::ShapeCodecs => b"SCOD",
            Kind::Shapes => b"SHAP",
            Kind::Page => b"PAGE",
        }
    }

    fn from_letters(letters: [u8; 4]) -> Option<Kind> {
        Kind::ALL.into_iter().find(|kind| kind.letters() == letters)
    }
}

/// A row of the table of contents.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Row {
    /// `None` if this version does not know it.
    pub(super) kind: Option<Kind>,
    pub(super) is_compressed: bool,
    /// Where the chunk begins in the file.
    pub(super) offset: u64,
    pub(super) stored_bytes: u64,
    pub(super) decoded_bytes: u64,
    /// XXH3-64 of the stored bytes.
    pub(super) checksum: u64,
    /// Of a page: the number of its first brick, and how many bricks it holds.
    pub(super) bricks: [u32; 2],
}

impl Row {
    pub(super) fn to_bytes(self) -> [u8; ROW_BYTES] {
        let mut bytes = [0; ROW_BYTES];
        bytes[..4].copy_from_slice(&self.kind.map(Kind::letters).unwrap_or_default());
        bytes[4..8].copy_from_slice(&u32::from(self.is_compressed).to_le_bytes());
        let numbers = [self.offset, self.stored_bytes, self.decoded_bytes, self.checksum];
        for (i, number) in numbers.iter().enumerate() {
            bytes[8 + i * 8..][..8].copy_from_slice(&number.to_le_bytes());
        }
        bytes[40..44].copy_from_slice(&self.bricks[0].to_le_bytes());
        bytes[44..].copy_from_slice(&self.bricks[1].to_le_bytes());
        bytes
    }

    fn from_bytes(bytes: &[u8; ROW_BYTES], at: u64) -> Result<Row, FormatError> {
        let (words, _) = bytes.as_chunks::<4>();
        let word = |i: usize| u32::from_le_bytes(words[i]);
        let number = |i: usize| u64::from(word(i)) | u64::from(word(i + 1)) << 32;
        let kind = Kind::from_letters(words[0]);
        let is_compressed = match word(1) {
            0 => false,
            1 => true,
            // Nobody reads what is unknown anyway.
            _ if kind.is_none() => false,
            other => {
                let feature = format!("compression {other} of a chunk, in the table at byte {at}");
                return Err(FormatError::Unsupported { feature });
            }
        };
        Ok(Row {
            kind,
            is_compressed,
            offset: number(2),
            stored_bytes: number(4),
            decoded_bytes: number(6),
            checksum: number(8),
            bricks: [word(10), word(11)],
        })
    }
}

/// The header of a file whose table of contents stands at an offset.
pub(super) fn header(table_at: u64, table: &[u8]) -> [u8; HEADER_BYTES] {
    let mut bytes = [0; HEADER_BYTES];
    bytes[..8].copy_from_slice(&MAGIC);
    bytes[8..10].copy_from_slice(&MAJOR_VERSION.to_le_bytes());
    bytes[10..12].copy_from_slice(&MINOR_VERSION.to_le_bytes());
    for (i, number) in [table_at, table.len() as u64, xxh3_64(table)].iter().enumerate() {
        bytes[16 + i * 8..][..8].copy_from_slice(&number.to_le_bytes());
    }
    let checksum = xxh3_64(&bytes[..HEADER_BYTES - 8]);
    bytes[HEADER_BYTES - 8..].copy_from_slice(&checksum.to_le_bytes());
    bytes
}

/// Reads the table of contents.
pub(super) fn read_table(source: &dyn ReadAt, limits: &Limits) -> Result<Vec<Row>, FormatError> {
    let file_bytes = source.size_bytes()?;
    if file_bytes < HEADER_BYTES as u64 {
        return Err(FormatError::malformed(file_bytes, "the file ends inside of its header"));
    }
    let header = source.range(0, HEADER_BYTES)?;
    let (words, _) = header.as_chunks::<8>();
    let number = |i: usize| words.get(i).map_or(0, |word| u64::from_le_bytes(*word));
    if words.first() != Some(&MAGIC) {
        return Err(FormatError::malformed(0, "the file does not begin as one of nuage does"));
    }
    // Versions may differ in all that follows, so they are told first.
    let major = number(1) as u16;
    if major > MAJOR_VERSION {
        let feature = format!("version {major} of the format; this program reads up to {MAJOR_VERSION}");
        return Err(FormatError::Unsupported { feature });
    }
    if major == 0 || xxh3_64(&header[..HEADER_BYTES - 8]) != number(7) {
        return Err(FormatError::malformed(0, "the header is damaged: its checksum is another"));
    }
    let (table_at, table_bytes) = (number(2), number(3));
    let is_inside = table_at.checked_add(table_bytes).is_some_and(|end| end <= file_bytes);
    if !is_inside || table_at < HEADER_BYTES as u64 || !table_bytes.is_multiple_of(ROW_BYTES as u64) {
        return Err(FormatError::malformed(
            16,
            "the table of contents is not in the file: the file is cut off",
        ));
    }
    limits.check(
        &[table_bytes, table_bytes / ROW_BYTES as u64 * size_of::<Row>() as u64],
        "the table of contents",
    )?;
    let table = range(source, table_at, table_bytes)?;
    if xxh3_64(&table) != number(4) {
        return Err(FormatError::malformed(
            table_at,
            "the table of contents is damaged: its checksum is another",
        ));
    }
    let mut rows = Vec::with_capacity(table.len() / ROW_BYTES);
    let mut free_from = HEADER_BYTES as u64;
    for (i, bytes) in table.as_chunks().0.iter().enumerate() {
        let at = table_at + (i * ROW_BYTES) as u64;
        let row = Row::from_bytes(bytes, at)?;
        let end = row.offset.checked_add(row.stored_bytes).filter(|end| *end <= file_bytes);
        match end {
            Some(end) if row.offset >= free_from => free_from = end,
            _ => {
                return Err(FormatError::malformed(
                    at,
                    "a chunk that overlaps another or the end of the file",
                ));
            }
        }
        rows.push(row);
    }
    Ok(rows)
}

/// Makes all checksums of a file right, as far as its header and table of contents say where they are: for fuzzing, which
/// would not get past them, and for repairs of files whose damage is known.
pub fn reseal(file: &mut [u8]) {
    if file.len() < HEADER_BYTES {
        return;
    }
    let number = |file: &[u8], at: usize| {
        file.get(at..)?.first_chunk().and_then(|bytes| usize::try_from(u64::from_le_bytes(*bytes)).ok())
    };
    let ends = |file: &[u8], at: usize| {
        let (begin, len) = (number(file, at)?, number(file, at + 8)?);
        Some((begin, begin.checked_add(len).filter(|end| *end <= file.len())?))
    };
    let Some((begin, end)) = ends(file, 16) else { return };
    for row in (begin..end).step_by(ROW_BYTES).filter(|row| row + ROW_BYTES <= end) {
        if let Some((first, last)) = ends(file, row + 8) {
            let checksum = xxh3_64(&file[first..last]);
            file[row + 32..row + 40].copy_from_slice(&checksum.to_le_bytes());
        }
    }
    let checksum = xxh3_64(&file[begin..end]);
    file[32..40].copy_from_slice(&checksum.to_le_bytes());
    let checksum = xxh3_64(&file[..HEADER_BYTES - 8]);
    file[HEADER_BYTES - 8..HEADER_BYTES].copy_from_slice(&checksum.to_le_bytes());
}

fn range(source: &dyn ReadAt, offset: u64, len: u64) -> Result<Cow<'_, [u8]>, FormatError> {
    let len =
        usize::try_from(len).map_err(|_| FormatError::malformed(offset, "a chunk larger than memory"))?;
    let bytes = source.range(offset, len)?;
    match bytes.len() == len {
        true => Ok(bytes),
        false => Err(FormatError::Io(std::io::ErrorKind::UnexpectedEof.into())),
    }
}

fn damaged(row: &Row, what: &str) -> FormatError {
    let name = row.kind.map(Kind::letters).unwrap_or_default();
    FormatError::malformed(row.offset, format!("chunk {} {what}", name.escape_ascii()))
}

/// The stored bytes of a chunk. The caller has made sure of the memory.
pub(super) fn read_stored<'a>(source: &'a dyn ReadAt, row: &Row) -> Result<Cow<'a, [u8]>, FormatError> {
    let stored = range(source, row.offset, row.stored_bytes)?;
    match xxh3_64(&stored) == row.checksum {
        true => Ok(stored),
        false => Err(damaged(row, "is damaged: its checksum is another")),
    }
}

/// The decompressed bytes of a chunk. The caller has made sure of the memory for the stored and the decoded bytes.
pub(super) fn read_chunk(source: &dyn ReadAt, row: &Row) -> Result<Vec<u8>, FormatError> {
    let stored = read_stored(source, row)?;
    Ok(decode_chunk(&stored, row)?.into_owned())
}

/// The decompressed bytes of a chunk from its stored ones.
pub(super) fn decode_chunk<'a>(stored: &'a [u8], row: &Row) -> Result<Cow<'a, [u8]>, FormatError> {
    let fits = match row.is_compressed {
        true => row.decoded_bytes <= row.stored_bytes.saturating_mul(MAX_EXPANSION),
        false => row.decoded_bytes == row.stored_bytes,
    };
    if !fits {
        return Err(damaged(row, "cannot have the size that the table says"));
    }
    if !row.is_compressed {
        return Ok(Cow::Borrowed(stored));
    }
    let decoded = decompress(stored, row.decoded_bytes);
    decoded.map(Cow::Owned).ok_or_else(|| damaged(row, "cannot be decompressed"))
}

/// Decompresses one Zstandard frame that must give so many bytes. Memory is taken as they come.
fn decompress(mut stream: &[u8], decoded_bytes: u64) -> Option<Vec<u8>> {
    let mut decoder = FrameDecoder::new();
    decoder.set_max_window_size(MIN_WINDOW_LIMIT.max(decoded_bytes));
    decoder.reset(&mut stream).ok()?;
    let mut out = Vec::new();
    loop {
        decoder.decode_blocks(&mut stream, BlockDecodingStrategy::UptoBytes(1 << 20)).ok()?;
        let left = decoded_bytes.checked_sub((out.len() + decoder.can_collect()) as u64)?;
        out.try_reserve(decoder.can_collect()).ok()?;
        let at = out.len();
        out.resize(at + decoder.can_collect(), 0);
        decoder.read_exact(&mut out[at..]).ok()?;
        if decoder.is_finished() {
            return (left == 0 && decoder.can_collect() == 0 && stream.is_empty()).then_some(out);
        }
    }
}
