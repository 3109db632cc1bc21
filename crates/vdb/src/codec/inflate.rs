//! Deflate streams (RFC 1951) that are small and whose decoded size is known.
//!
//! A ZIP-compressed leaf is a stream of its own that gives 2 KiB or less, and this decoder is made for such: it has the
//! whole input and the whole output at hand, and builds its tables quickly (docs/decisions/0004 says why it is not a
//! library). Deflating and the zlib wrapping live elsewhere.

use super::CodecError;

/// The longest code of deflate.
const MAX_CODE_BITS: usize = 15;
/// Literals, lengths and the end of a block, with the two symbols that are never used.
const LENGTH_SYMBOLS: usize = 288;
const DISTANCE_SYMBOLS: usize = 32;
const END_OF_BLOCK: usize = 256;

/// What a symbol stands for: a value in the upper half; below it these flags, the length of the code in four bits, and
/// in the lowest byte that length with the extra bits behind the code. 0 stands for no symbol.
type Entry = u32;
const IS_LITERAL: Entry = 1 << 15;
const IS_END: Entry = 1 << 14;

fn value(entry: Entry) -> usize {
    (entry >> 16) as usize
}

fn code_bits(entry: Entry) -> u32 {
    entry >> 8 & 0xf
}

fn all_bits(entry: Entry) -> u32 {
    entry & 0x1f
}

/// A Huffman code. Codes of up to log2 `SIZE` bits are looked up at once, the few longer ones are searched for.
struct Code<const SIZE: usize> {
    table: [Entry; SIZE],
    /// How many codes have each length.
    counts: [u16; MAX_CODE_BITS + 1],
    /// All symbols by code.
    sorted: [Entry; LENGTH_SYMBOLS],
}

impl<const SIZE: usize> Code<SIZE> {
    const TABLE_BITS: usize = SIZE.ilog2() as usize;

    const EMPTY: Self =
        Code { table: [0; SIZE], counts: [0; MAX_CODE_BITS + 1], sorted: [0; LENGTH_SYMBOLS] };

    /// Makes the canonical code of symbols with the given code lengths (section 3.2.2), 0 for those that have none.
    /// `entries` says what the symbols stand for.
    fn build(&mut self, lengths: &[u8], entries: &[Entry]) -> Result<(), CodecError> {
        self.counts = [0; MAX_CODE_BITS + 1];
        for len in lengths {
            self.counts[usize::from(*len) & MAX_CODE_BITS] += 1;
        }
        self.counts[0] = 0;
        let mut next_place = [0_u16; MAX_CODE_BITS + 1];
        let (mut unused, mut place) = (1_i32, 0);
        for (len, count) in self.counts.iter().enumerate().skip(1) {
            next_place[len] = place;
            place += count;
            unused = 2 * unused - i32::from(*count);
            if unused < 0 {
                return Err(CodecError::Malformed("a deflate code with too many symbols"));
            }
        }
        // Only a code of one symbol or none may leave bits unused.
        if unused > 0 && self.counts[2..].iter().any(|count| *count > 0) {
            return Err(CodecError::Malformed("an incomplete deflate code"));
        }
        for (len, entry) in lengths.iter().zip(entries) {
            let len = *len & MAX_CODE_BITS as u8;
            if len > 0 {
                let place = &mut next_place[usize::from(len)];
                // A symbol that stands for nothing stays nothing.
                self.sorted[usize::from(*place) % LENGTH_SYMBOLS] =
                    if *entry == 0 { 0 } else { entry + Entry::from(len) * 0x101 };
                *place += 1;
            }
        }
        // The table of codes of up to `len` bits is that of one bit less, twice, and the codes of `len` bits. Codes
        // are read from their upper bit on, and all else in a stream from the lower: `code` stands reversed.
        self.table[0] = 0;
        let (mut code, mut place) = (0_usize, 0);
        for len in 1..=Self::TABLE_BITS {
            let half = 1 << (len - 1);
            self.table.copy_within(..half, half);
            let end = place + usize::from(self.counts[len]);
            for entry in &self.sorted[place..end] {
                self.table[code] = *entry;
                // One more: the ones at the upper end become zeros, and the zero below them one.
                let zeros = !code & (2 * half - 1);
                let top = 1 << zeros.checked_ilog2().unwrap_or(0);
                code = code & (top - 1) | top & zeros;
            }
            place = end;
        }
        Ok(())
    }

    /// The symbol whose code the bits start with, 0 if there is none.
    fn symbol(&self, bits: u64) -> Entry {
        match self.table[bits as usize % SIZE] {
            0 => self.long(bits),
            entry => entry,
        }
    }

    #[cold]
    fn long(&self, bits: u64) -> Entry {
        let reversed = u32::from((bits as u16).reverse_bits());
        let (mut first, mut place) = (0_u32, 0);
        for len in 1..=MAX_CODE_BITS {
            first <<= 1;
            let count = u32::from(self.counts[len]);
            let code = reversed >> (16 - len);
            if code < first + count {
                return self.sorted[place + code.saturating_sub(first) as usize];
            }
            first += count;
            place += count as usize;
        }
        0
    }
}

/// The codes of a block.
struct Codes {
    lengths: Code<1024>,
    distances: Code<256>,
}

impl Codes {
    const EMPTY: Codes = Codes { lengths: Code::EMPTY, distances: Code::EMPTY };

    fn build(&mut self, lengths: &[u8], distances: &[u8]) -> Result<(), CodecError> {
        self.lengths.build(lengths, &LENGTHS)?;
        self.distances.build(distances, &DISTANCES)
    }
}

/// What literal and length symbols stand for (section 3.2.5).
const LENGTHS: [Entry; LENGTH_SYMBOLS] = {
    let mut entries = [0; LENGTH_SYMBOLS];
    let mut symbol = 0;
    while symbol < END_OF_BLOCK {
        entries[symbol] = (symbol as Entry) << 16 | IS_LITERAL;
        symbol += 1;
    }
    entries[END_OF_BLOCK] = IS_END;
    let (mut base, mut i) = (3, 0);
    while i < 28 {
        let extra = if i < 4 { 0 } else { i / 4 - 1 };
        entries[257 + i] = base << 16 | extra as Entry;
        base += 1 << extra;
        i += 1;
    }
    // The longest match has a symbol of its own.
    entries[285] = 258 << 16;
    entries
};

/// What distance symbols stand for (section 3.2.5).
const DISTANCES: [Entry; DISTANCE_SYMBOLS] = {
    let mut entries = [0; DISTANCE_SYMBOLS];
    let (mut base, mut i) = (1, 0);
    while i < 30 {
        let extra = if i < 2 { 0 } else { i / 2 - 1 };
        entries[i] = base << 16 | extra as Entry;
        base += 1 << extra;
        i += 1;
    }
    entries
};

/// What the symbols of the code of code lengths stand for: themselves.
const CODE_LENGTHS: [Entry; 19] = {
    let mut entries = [IS_LITERAL; 19];
    let mut symbol = 0;
    while symbol < entries.len() {
        entries[symbol] |= (symbol as Entry) << 16;
        symbol += 1;
    }
    entries
};

/// Tables that outlive a stream, so that they are not set up for each.
pub(crate) struct Inflater {
    /// The code of the lengths of dynamic codes. Its own lengths are numbers of three bits.
    code_lengths: Code<128>,
    dynamic: Codes,
    fixed: Codes,
}

impl Inflater {
    pub(crate) fn new() -> Box<Inflater> {
        let mut inflater =
            Box::new(Inflater { code_lengths: Code::EMPTY, dynamic: Codes::EMPTY, fixed: Codes::EMPTY });
        let mut lengths = [8; LENGTH_SYMBOLS];
        lengths[144..256].fill(9);
        lengths[256..280].fill(7);
        let built = inflater.fixed.build(&lengths, &[5; DISTANCE_SYMBOLS]);
        debug_assert!(built.is_ok(), "the fixed codes are complete");
        inflater
    }

    /// Inflates the stream at the start of `data`, which has to fill `out` exactly. Gives the stream's length.
    ///
    /// # Errors
    /// `Malformed` if the stream is damaged, or gives fewer or more bytes than `out` holds.
    pub(crate) fn inflate(&mut self, data: &[u8], out: &mut [u8]) -> Result<usize, CodecError> {
        let mut input = Bits::new(data);
        let mut written = 0;
        loop {
            input.refill();
            let is_last = input.take(1) == 1;
            match input.take(2) {
                0 => written = stored_block(data, &mut input, out, written)?,
                1 => written = coded_block(&mut input, &self.fixed, out, written)?,
                2 => {
                    read_codes(&mut input, &mut self.code_lengths, &mut self.dynamic)?;
                    written = coded_block(&mut input, &self.dynamic, out, written)?;
                }
                _ => return Err(CodecError::Malformed("a deflate block of no known type")),
            }
            if is_last {
                break;
            }
        }
        match written == out.len() {
            true => Ok(data.len() - input.left()?),
            false => Err(WRONG_SIZE),
        }
    }
}

const WRONG_SIZE: CodecError =
    CodecError::Malformed("a deflate stream that does not give the size its block should have");
const CUT: CodecError = CodecError::Malformed("a deflate stream that is cut");

/// A stream as bits. The next `count` of them stand in `bits`, the first lowest. Loops work on a copy, which stays in
/// registers.
#[derive(Clone, Copy)]
struct Bits<'a> {
    /// The bytes that are not in `bits`.
    rest: &'a [u8],
    bits: u64,
    count: u32,
    /// How many bytes of nothing were put into `bits` behind the stream's end.
    past_end: usize,
}

impl<'a> Bits<'a> {
    fn new(data: &'a [u8]) -> Self {
        Bits { rest: data, bits: 0, count: 0, past_end: 0 }
    }

    /// Makes at least 56 bits ready: enough for three codes, or a length, a distance, and the extra bits of both.
    fn refill(&mut self) {
        if let Some(next) = self.rest.first_chunk::<8>() {
            // The bits above `count` may have been here before, and are the same.
            self.bits |= u64::from_le_bytes(*next) << self.count;
            self.rest = &self.rest[(63 - self.count) as usize / 8 % 8..];
            self.count |= 56;
        } else {
            self.refill_at_end();
        }
    }

    #[cold]
    fn refill_at_end(&mut self) {
        while self.count < 56 {
            match self.rest.split_first() {
                Some((byte, rest)) => {
                    self.bits |= u64::from(*byte) << self.count;
                    self.rest = rest;
                }
                None => self.past_end += 1,
            }
            self.count += 8;
        }
    }

    /// The next bits, at most as many as were made ready.
    fn take(&mut self, count: u32) -> usize {
        let taken = self.bits & !(u64::MAX << count);
        self.bits >>= count;
        self.count -= count;
        taken as usize
    }

    /// Takes a symbol of a code, as far as bits were made ready, and gives its value with that of its extra bits.
    fn take_symbol(&mut self, entry: Entry) -> usize {
        let extra = self.bits & !(u64::MAX << all_bits(entry));
        self.bits >>= all_bits(entry);
        self.count -= all_bits(entry);
        value(entry) + (extra >> code_bits(entry)) as usize
    }

    /// How many bytes of the stream stand behind the bits that were taken. What is left of the byte
    /// that was begun does not count.
    fn left(&self) -> Result<usize, CodecError> {
        (self.rest.len() + self.count as usize / 8).checked_sub(self.past_end).ok_or(CUT)
    }
}

/// Copies a block of bytes as they are. Gives the position in `out` behind it.
fn stored_block<'a>(
    data: &'a [u8],
    input: &mut Bits<'a>,
    out: &mut [u8],
    at: usize,
) -> Result<usize, CodecError> {
    let rest = &data[data.len() - input.left()?..];
    let (header, rest) = rest.split_first_chunk::<4>().ok_or(CUT)?;
    let [len, complement] = [[header[0], header[1]], [header[2], header[3]]].map(u16::from_le_bytes);
    if len != !complement {
        return Err(CodecError::Malformed("a stored deflate block of two lengths"));
    }
    let (stored, rest) = rest.split_at_checked(usize::from(len)).ok_or(CUT)?;
    out.get_mut(at..at + stored.len()).ok_or(WRONG_SIZE)?.copy_from_slice(stored);
    *input = Bits::new(rest);
    Ok(at + stored.len())
}

/// Reads the codes of a block (section 3.2.7).
fn read_codes(stream: &mut Bits<'_>, code: &mut Code<128>, codes: &mut Codes) -> Result<(), CodecError> {
    /// The order in which the lengths of the code of code lengths stand.
    const ORDER: [usize; 19] = [16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15];
    let mut input = *stream;
    let length_count = 257 + input.take(5);
    let distance_count = 1 + input.take(5);
    let order_count = 4 + input.take(4);
    if length_count > 286 || distance_count > 30 {
        return Err(CodecError::Malformed("a deflate code with too many symbols"));
    }
    let mut lengths = [0; ORDER.len()];
    for symbol in &ORDER[..order_count] {
        input.refill();
        lengths[*symbol] = input.take(3) as u8;
    }
    code.build(&lengths, &CODE_LENGTHS)?;
    if code.counts[1] == 1 && code.counts[2..].iter().all(|count| *count == 0) {
        return Err(CodecError::Malformed("an incomplete deflate code"));
    }
    let mut lengths = [0_u8; 286 + 30];
    let count = length_count + distance_count;
    let mut i = 0;
    while i < count {
        input.refill();
        let entry = code.symbol(input.bits);
        if entry == 0 {
            return Err(NO_CODE);
        }
        input.take(all_bits(entry));
        let (len, repeats) = match value(entry) {
            len @ 0..16 => {
                lengths[i] = len as u8;
                i += 1;
                continue;
            }
            16 if i == 0 => return Err(CodecError::Malformed("a deflate code that repeats nothing")),
            16 => (lengths[i - 1], 3 + input.take(2)),
            17 => (0, 3 + input.take(3)),
            _ => (0, 11 + input.take(7)),
        };
        if repeats > count - i {
            return Err(CodecError::Malformed("a deflate code with too many symbols"));
        }
        lengths[i..i + repeats].fill(len);
        i += repeats;
    }
    *stream = input;
    if lengths[END_OF_BLOCK] == 0 {
        return Err(CodecError::Malformed("a deflate block without an end"));
    }
    codes.build(&lengths[..length_count], &lengths[length_count..count])
}

const NO_CODE: CodecError = CodecError::Malformed("bits that are no deflate code");

/// Decodes a block of literals and matches. Gives the position in `out` behind it.
fn coded_block(
    stream: &mut Bits<'_>,
    codes: &Codes,
    out: &mut [u8],
    mut at: usize,
) -> Result<usize, CodecError> {
    let mut input = *stream;
    loop {
        input.refill();
        let mut entry = codes.lengths.symbol(input.bits);
        // 56 bits are enough for three codes.
        for _ in 0..2 {
            if entry & IS_LITERAL == 0 {
                break;
            }
            input.take(all_bits(entry));
            *out.get_mut(at).ok_or(WRONG_SIZE)? = value(entry) as u8;
            at += 1;
            entry = codes.lengths.symbol(input.bits);
        }
        if entry & IS_LITERAL != 0 {
            input.take(all_bits(entry));
            *out.get_mut(at).ok_or(WRONG_SIZE)? = value(entry) as u8;
            at += 1;
            continue;
        }
        if entry == 0 {
            return Err(NO_CODE);
        }
        if entry & IS_END != 0 {
            input.take(all_bits(entry));
            *stream = input;
            return Ok(at);
        }
        // What stands behind the code may take more bits than are left.
        input.refill();
        let len = input.take_symbol(entry);
        let entry = codes.distances.symbol(input.bits);
        if entry == 0 {
            return Err(NO_CODE);
        }
        let distance = input.take_symbol(entry);
        let from = at
            .checked_sub(distance)
            .ok_or(CodecError::Malformed("a deflate match from before the first byte"))?;
        copy_match(out, from, at, len)?;
        at += len;
    }
}

/// Copies `len` bytes from `from` to `to` behind it. Where they overlap, what was copied is copied again.
fn copy_match(out: &mut [u8], from: usize, to: usize, len: usize) -> Result<(), CodecError> {
    if to + len > out.len() {
        return Err(WRONG_SIZE);
    }
    // Most matches are short, and copying sixteen bytes costs no more. What stands behind is yet to be written.
    if len <= 16 && to - from >= 16 && to + 16 <= out.len() {
        out.copy_within(from..from + 16, to);
        return Ok(());
    }
    let mut done = 0;
    while done < len {
        // What was copied repeats the bytes between the two places, and can be copied in turn.
        let some = (to - from + done).min(len - done);
        out.copy_within(from..from + some, to + done);
        done += some;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use flate2::{Compress, Compression, Decompress, FlushCompress, FlushDecompress, Status};
    use proptest::prelude::*;

    use super::*;

    fn deflated(data: &[u8], level: u32) -> Vec<u8> {
        let mut out = Vec::with_capacity(2 * data.len() + 64);
        let status =
            Compress::new(Compression::new(level), false).compress_vec(data, &mut out, FlushCompress::Finish);
        assert_eq!(status.unwrap(), Status::StreamEnd);
        out
    }

    /// What the library makes of a stream: its length and its bytes, if it is sound and gives `size` bytes.
    fn by_library(stream: &[u8], size: usize) -> Option<(usize, Vec<u8>)> {
        let mut out = Vec::with_capacity(size + 1);
        let mut decoder = Decompress::new(false);
        let status = decoder.decompress_vec(stream, &mut out, FlushDecompress::Finish);
        (status.ok()? == Status::StreamEnd && out.len() == size).then(|| (decoder.total_in() as usize, out))
    }

    fn by_us(inflater: &mut Inflater, stream: &[u8], size: usize) -> Option<(usize, Vec<u8>)> {
        let mut out = vec![0; size];
        inflater.inflate(stream, &mut out).ok().map(|len| (len, out))
    }

    /// Bytes as they occur in values: near repeats of few or of many different bytes.
    fn data() -> impl Strategy<Value = Vec<u8>> {
        let run = proptest::collection::vec(any::<u8>(), 0..700);
        (run, 1_u8..=255, 1_usize..12, any::<u8>()).prop_map(|(run, range, repeats, step)| {
            let repeat = |i: usize| {
                let add = (i as u8).wrapping_mul(step);
                run.iter().map(move |byte| (byte % range).wrapping_add(add))
            };
            (0..repeats).flat_map(repeat).collect()
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(300))]

        #[test]
        fn streams_decode_as_by_the_library(data in data(), level in 0_u32..10, behind in 0_usize..12) {
            let mut inflater = Inflater::new();
            let mut stream = deflated(&data, level);
            let len = stream.len();
            stream.resize(len + behind, 0xa5);
            for _ in 0..2 {
                prop_assert_eq!(by_us(&mut inflater, &stream, data.len()), Some((len, data.clone())));
            }
            for size in [data.len() + 1, data.len().saturating_sub(1)] {
                let is_same = size == data.len();
                prop_assert_eq!(by_us(&mut inflater, &stream, size).is_some(), is_same);
            }
        }

        #[test]
        fn damaged_streams_have_the_library_s_verdict(
            data in data(), level in 0_u32..10, at in any::<prop::sample::Index>(), bits in 1_u8..=255,
            cut in any::<prop::sample::Index>(),
        ) {
            let mut inflater = Inflater::new();
            let mut stream = deflated(&data, level);
            prop_assert_eq!(by_us(&mut inflater, &stream[..cut.index(stream.len())], data.len()), None);
            // Much of what can be wrong stands at the beginning.
            for at in [at.index(stream.len()), at.index(stream.len().min(40))] {
                stream[at] ^= bits;
                let expected = by_library(&stream, data.len());
                prop_assert_eq!(by_us(&mut inflater, &stream, data.len()), expected);
            }
        }

        #[test]
        fn noise_has_the_library_s_verdict(stream in proptest::collection::vec(any::<u8>(), 1..60), size in 0_usize..40) {
            prop_assert_eq!(by_us(&mut Inflater::new(), &stream, size), by_library(&stream, size));
        }
    }

    #[test]
    fn codes_of_every_length_are_found_with_tables_of_any_size() {
        let mut lengths: Vec<u8> = (1..=15).chain([15]).collect();
        lengths.rotate_left(5);
        let entries: Vec<Entry> = (1..=16).map(|i| i << 16).collect();
        let (mut small, mut large) = (Code::<4>::EMPTY, Code::<1024>::EMPTY);
        small.build(&lengths, &entries).unwrap();
        large.build(&lengths, &entries).unwrap();
        for bits in 0..1_u64 << 15 {
            // In this code, a symbol of `len` bits is `len - 1` ones and a zero, but for the last: all ones.
            let len = (bits.trailing_ones() + 1).min(15);
            let is_last = bits.trailing_ones() >= 15;
            let found = large.symbol(bits);
            assert_eq!(found, small.symbol(bits));
            assert_eq!(code_bits(found), len);
            let symbol = value(found) - 1;
            assert_eq!(u32::from(lengths[symbol]), len);
            assert_eq!(is_last, len == 15 && !lengths[symbol + 1..].contains(&15));
        }
        assert!(small.build(&[1, 1, 2], &entries).is_err(), "more symbols than bits");
        assert!(small.build(&[1, 2, 0], &entries).is_err(), "bits that are no symbol");
        assert!(small.build(&[0, 1], &entries).is_ok(), "one symbol alone");
    }
}
