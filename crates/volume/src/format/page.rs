//! The bytes that the words of a page become before they are compressed, and back.
//!
//! Words are sorted by meaning: lines, corners, shapes, and the values of each codec stand together, in streams whose
//! lengths follow from the codecs. Words become byte planes: all lowest bytes, then all second ones, and so on. Codes
//! and half floats may be predicted from their neighbours first; a byte per codec says how.
//!
//! Which bricks a page holds is [`crate::packed::store`]'s; compression is [`super::chunk`]'s.

use super::entropy;
use super::predict::{Number, Predictor, residuals, restore};
use crate::codec::sparse::{self, Coding};
use crate::codec::{Codec, codes, octant_of};
use crate::space::BRICK_VOXELS;

/// The groups of bricks whose values stand together: one for each tag but those of sparse bricks, then one for each number of bits of
/// these, first of those that are not fitted.
const GROUPS: usize = FIRST_SPARSE + 2 * sparse::MAX_BITS as usize;
const FIRST_SPARSE: usize = 52;

/// The group of a brick, by the word of a sparse one that says the bits of its codes.
fn group(codec: Codec, sparse_bits: u32) -> usize {
    match codec {
        Codec::Sparse { is_fitted, .. } => {
            // Any other number is in no file that decodes; such words stand as they are in the last group.
            let bits = Coding::from_word(sparse_bits).map_or(sparse::MAX_BITS, |coding| coding.most_bits);
            FIRST_SPARSE + usize::from(bits) - 1 + if is_fitted { usize::from(sparse::MAX_BITS) } else { 0 }
        }
        codec => usize::from(codec.tag()),
    }
}

/// The number of [`Mode::Coded`].
const CODED: u8 = 1 + Predictor::ALL.len() as u8;

/// How the values of all bricks of a codec are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Mode {
    /// Words as they are, as bytes if they hold codes, in byte planes if they hold floats.
    Words,
    /// Residuals: a byte each if they are codes, in byte planes if they are floats.
    Predicted(Predictor),
    /// Entropy-coded codes: their length in four bytes, then those.
    Coded,
}

impl Mode {
    fn number(self) -> u8 {
        match self {
            Mode::Words => 0,
            Mode::Predicted(predictor) => 1 + predictor as u8,
            Mode::Coded => CODED,
        }
    }

    fn from_number(number: u8) -> Option<Mode> {
        match number.checked_sub(1) {
            None => Some(Mode::Words),
            _ if number == CODED => Some(Mode::Coded),
            Some(predictor) => Predictor::ALL.get(usize::from(predictor)).copied().map(Mode::Predicted),
        }
    }
}

/// The streams of single words that stand before or instead of a brick's values.
const LINES: usize = 0;
const CORNERS: usize = 1;
const SHAPE_OFFSETS: usize = 2;
const SHAPE_TAGS: usize = 3;
const OCTANTS: usize = 4;
const LATTICES: usize = 5;
const SPARSE_BITS: usize = 6;
const SPARSE_ENDS: usize = 7;
const HEAD_STREAMS: usize = 8;

/// The streams of a lattice with codes.
const LATTICE: [usize; 18] = {
    let mut streams = [LATTICES; 18];
    (streams[0], streams[17]) = (LINES, LINES);
    streams
};

/// Which streams the first words of a brick go to. The second word of a sparse one may say that others follow.
fn head(codec: Codec, sparse_bits: u32) -> &'static [usize] {
    match codec {
        Codec::Constant | Codec::F16 | Codec::F32 => &[],
        Codec::Uniform { .. } | Codec::Block { .. } => &[LINES],
        Codec::Gradient { bits: 0 } => &[LINES, CORNERS, CORNERS],
        Codec::Gradient { .. } => &[LINES, CORNERS, CORNERS, LINES],
        Codec::Lattice { bits: 0 } => LATTICE.split_last().map_or(&[], |(_, head)| head),
        Codec::Lattice { .. } => &LATTICE,
        Codec::Split { .. } => &[LINES, OCTANTS, OCTANTS, OCTANTS, OCTANTS],
        Codec::Sparse { is_fitted: false, pairs } if sparse_bits & sparse::HAS_ENDS > 0 && pairs > 1 => {
            &[LINES, SPARSE_BITS, SPARSE_ENDS, SPARSE_ENDS]
        }
        Codec::Sparse { is_fitted: false, .. } => &[LINES, SPARSE_BITS],
        Codec::Sparse { is_fitted: true, .. } => &[LINES, SPARSE_BITS, LINES, CORNERS, CORNERS],
        Codec::Shared => &[LINES, SHAPE_OFFSETS, SHAPE_TAGS],
    }
}

/// What follows these words.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Values {
    None,
    Codes(u8),
    /// Masks and codes of the voxels that are there, of so many bits or fewer.
    Sparse(u8),
    /// Texture blocks, which have no neighbours that predict them.
    Blocks,
    Halves,
    Floats,
}

impl Values {
    /// What a group of bricks holds. `None` if no codec has its number.
    fn of_group(group: usize) -> Option<Values> {
        if let Some(sparse) = group.checked_sub(FIRST_SPARSE) {
            return Some(Values::Sparse((sparse % usize::from(sparse::MAX_BITS)) as u8 + 1));
        }
        Some(match Codec::from_tag(group as u8)? {
            Codec::Constant | Codec::Shared | Codec::Gradient { bits: 0 } | Codec::Lattice { bits: 0 } => {
                Values::None
            }
            Codec::Uniform { bits }
            | Codec::Gradient { bits }
            | Codec::Lattice { bits }
            | Codec::Split { bits } => Values::Codes(bits),
            Codec::Sparse { .. } => return None,
            Codec::Block { .. } => Values::Blocks,
            Codec::F16 => Values::Halves,
            Codec::F32 => Values::Floats,
        })
    }

    fn plane_count(self) -> usize {
        match self {
            Values::None | Values::Codes(_) | Values::Sparse(_) | Values::Blocks => 1,
            Values::Halves => 2,
            Values::Floats => 4,
        }
    }

    /// Takes the bytes of the values of some bricks, which are so many words in all. `None` if they are not there.
    fn take<'a>(self, mode: Mode, bricks: usize, words: usize, rest: &mut &'a [u8]) -> Option<&'a [u8]> {
        let len = match (self, mode) {
            (_, Mode::Coded) if bricks == 0 => 0,
            (_, Mode::Coded) => u32::from_le_bytes(*rest.split_off(..4)?.first_chunk()?) as usize,
            (Values::Codes(_), Mode::Predicted(_)) => bricks * BRICK_VOXELS,
            _ => 4 * words,
        };
        rest.split_off(..len)
    }
}

/// The most bytes that the words of such bricks become.
pub(super) fn max_encoded_bytes(codecs: &[Codec]) -> u64 {
    let bytes = |codec: &Codec| (4 * codec.word_count() + BRICK_VOXELS) as u64;
    // A mode for each group, and at most a length.
    codecs.iter().map(bytes).sum::<u64>() + 5 * GROUPS as u64
}

/// The words of a brick after its head.
#[derive(Clone, Copy)]
struct Brick<'a> {
    /// The word of a sparse one that says the bits of its codes.
    sparse_bits: u32,
    values: &'a [u32],
}

/// The bytes of the words of some bricks, one after the other.
pub(super) fn encode(codecs: &[Codec], words: &[u32]) -> Vec<u8> {
    let mut heads = [const { Vec::new() }; HEAD_STREAMS];
    let mut values = [const { Vec::new() }; GROUPS];
    let mut rest = words;
    for codec in codecs {
        let (brick, after) = rest.split_at(codec.word_count());
        let sparse_bits = brick.get(1).copied().unwrap_or_default();
        let streams = head(*codec, sparse_bits);
        let (first, last) = brick.split_at(streams.len());
        first.iter().zip(streams).for_each(|(word, stream)| heads[*stream].push(*word));
        values[group(*codec, sparse_bits)].push(Brick { sparse_bits, values: last });
        rest = after;
    }
    let mut out = vec![0; GROUPS];
    heads.iter().for_each(|words| out.extend(word_planes(words)));
    for (group, bricks) in values.iter().enumerate() {
        let Some(values) = Values::of_group(group).filter(|_| !bricks.is_empty()) else { continue };
        // Measured on clouds: a byte for a code of one or two bits never pays, however well it is predicted. What is
        // not entropy-coded here is so by whoever compresses the page.
        let modes = match values {
            Values::Codes(..=2) => vec![Mode::Coded, Mode::Words],
            Values::Codes(_) => [&[Mode::Coded][..], &Predictor::ALL.map(Mode::Predicted)].concat(),
            Values::Blocks => vec![Mode::Words],
            Values::Sparse(_) => vec![Mode::Coded, Mode::Words],
            _ => Predictor::ALL.map(Mode::Predicted).to_vec(),
        };
        let candidates =
            modes.into_iter().filter_map(|mode| Some((mode, encode_values(values, mode, bricks)?)));
        let best = candidates.min_by_key(|(mode, bytes)| match mode {
            Mode::Coded => 8 * bytes.len() as u64,
            _ => entropy_bits(bytes, values.plane_count()),
        });
        if let Some((mode, bytes)) = best {
            out[group] = mode.number();
            out.extend(bytes);
        }
    }
    out
}

/// The words of bricks of these codecs from what [`encode`] made of them. `None` if it made no such bytes.
pub(super) fn decode(codecs: &[Codec], bytes: &[u8]) -> Option<Vec<u32>> {
    let (modes, mut rest) = bytes.split_at_checked(GROUPS)?;
    // What says the heads and the groups of sparse bricks stands in a stream before those that hang on it.
    let mut head_counts = [0; HEAD_STREAMS];
    for codec in codecs {
        head(*codec, 0).iter().for_each(|stream| head_counts[*stream] += 1);
    }
    let mut heads = [const { Planes::<4>::NONE }; HEAD_STREAMS];
    for (head, count) in heads[..SPARSE_ENDS].iter_mut().zip(head_counts) {
        *head = Planes::new(rest.split_off(..4 * count)?);
    }
    let mut sparse_bits = heads[SPARSE_BITS].clone();
    let (mut bricks, mut counts, mut ends) = (Vec::with_capacity(codecs.len()), [(0, 0); GROUPS], 0);
    for codec in codecs {
        let bits = if let Codec::Sparse { .. } = codec { u32::from_le_bytes(sparse_bits.next()?) } else { 0 };
        let (group, streams) = (group(*codec, bits), head(*codec, bits));
        let (count, words) = &mut counts[group];
        *count += 1;
        *words += codec.word_count().checked_sub(streams.len())?;
        ends += streams.iter().filter(|stream| **stream == SPARSE_ENDS).count();
        bricks.push((bits, group, streams));
    }
    heads[SPARSE_ENDS] = Planes::new(rest.split_off(..4 * ends)?);
    let mut streams = [const { None }; GROUPS];
    for (group, stream) in streams.iter_mut().enumerate() {
        let Some(values) = Values::of_group(group) else { continue };
        let (mode, (bricks, words)) = (Mode::from_number(modes[group])?, counts[group]);
        let bytes = values.take(mode, bricks, words, &mut rest)?;
        *stream = Some(Stream::new(values, mode, bricks, bytes)?);
    }
    if !rest.is_empty() {
        return None;
    }
    let mut words = Vec::with_capacity(codecs.iter().map(|codec| codec.word_count()).sum());
    for (codec, (sparse_bits, group, head)) in codecs.iter().zip(bricks) {
        for stream in head {
            words.push(u32::from_le_bytes(heads[*stream].next()?));
        }
        let values = codec.word_count() - head.len();
        streams[group].as_mut()?.next_brick(sparse_bits, values, &mut words)?;
    }
    Some(words)
}

/// The values of all bricks of a group in one mode. `None` if they cannot stand in it.
fn encode_values(values: Values, mode: Mode, bricks: &[Brick]) -> Option<Vec<u8>> {
    let codes_of = |bits: u8| {
        bricks.iter().map(move |brick| std::array::from_fn(|i| codes::code(bits, brick.values, i) as u8))
    };
    let coded = |bits, codes: &[[u8; BRICK_VOXELS]]| {
        let coded = entropy::encode(bits, codes);
        [&(coded.len() as u32).to_le_bytes()[..], &coded].concat()
    };
    Some(match (values, mode) {
        (Values::None, _) => Vec::new(),
        (Values::Codes(_) | Values::Sparse(_), Mode::Words) | (Values::Blocks, _) => {
            bricks.iter().flat_map(|brick| brick.values).flat_map(|word| word.to_le_bytes()).collect()
        }
        (Values::Codes(bits), Mode::Coded) => coded(bits, &codes_of(bits).collect::<Vec<_>>()),
        (Values::Sparse(bits), Mode::Coded) => {
            // Words that are not as they would be packed do not come back from symbols.
            let symbols = |brick: &Brick| {
                let coding = Coding::from_word(brick.sparse_bits)?;
                let symbols = sparse::unpack(&coding, brick.values)?;
                let mut packed = Vec::with_capacity(brick.values.len());
                pack_sparse(&coding, &symbols, brick.values.len(), &mut packed)?;
                (packed == brick.values).then_some(symbols)
            };
            coded(bits + 1, &bricks.iter().map(symbols).collect::<Option<Vec<_>>>()?)
        }
        (Values::Codes(bits), Mode::Predicted(predictor)) => {
            let mut bytes = Vec::with_capacity(bricks.len() * BRICK_VOXELS);
            for mut codes in codes_of(bits) {
                residuals(predictor, &mut codes, mask(bits));
                bytes.extend(codes);
            }
            bytes
        }
        (Values::Sparse(_), Mode::Predicted(_)) => return None,
        (Values::Halves, _) => {
            let words = bricks.iter().flat_map(|brick| brick.values);
            let halves: Vec<u16> = words.flat_map(|word| [*word as u16, (*word >> 16) as u16]).collect();
            let bricks = predicted(&halves, mode, ordered_half);
            split_planes::<2>(bricks.iter().map(|half| half.to_le_bytes()))
        }
        (Values::Floats, _) => {
            let bricks = predicted(
                &bricks.iter().flat_map(|brick| brick.values).copied().collect::<Vec<_>>(),
                mode,
                ordered_float,
            );
            split_planes::<4>(bricks.iter().map(|word| word.to_le_bytes()))
        }
    })
}

/// Appends the words of a sparse brick, and zeros up to `len` of them. `None` if these are too few.
fn pack_sparse(coding: &Coding, symbols: &sparse::Symbols, len: usize, words: &mut Vec<u32>) -> Option<()> {
    let begin = words.len();
    sparse::pack(coding, symbols, words);
    let end = begin + len;
    (words.len() <= end).then(|| words.resize(end, 0))
}

/// The residuals of floats, bricks one after the other, that are numbers in their order after `ordered`.
fn predicted<T: Number>(floats: &[T], mode: Mode, ordered: impl Fn(T) -> T) -> Vec<T> {
    let Mode::Predicted(predictor) = mode else { return floats.to_vec() };
    let mut out = Vec::with_capacity(floats.len());
    for brick in floats.as_chunks::<BRICK_VOXELS>().0 {
        let mut numbers = brick.map(&ordered);
        residuals(predictor, &mut numbers, T::ALL_BITS);
        out.extend(numbers);
    }
    out
}

/// The values of all bricks of a codec, one brick after the other.
enum Stream<'a> {
    None,
    Packed { bytes: &'a [u8] },
    Codes { bits: u8, predictor: Predictor, bytes: &'a [u8] },
    Coded { bits: u8, decoder: Box<entropy::Decoder<'a>> },
    Sparse { decoder: Box<entropy::Decoder<'a>> },
    Halves { mode: Mode, planes: Planes<'a, 2> },
    Floats { mode: Mode, planes: Planes<'a, 4> },
}

impl<'a> Stream<'a> {
    /// The values of so many bricks. `None` if they are damaged, or the mode is not one of such values.
    fn new(values: Values, mode: Mode, bricks: usize, bytes: &'a [u8]) -> Option<Stream<'a>> {
        let stream = match (values, mode) {
            _ if bricks == 0 => Stream::None,
            (Values::Codes(bits), Mode::Coded) => {
                Stream::Coded { bits, decoder: Box::new(entropy::Decoder::new(bits, bricks, bytes)?) }
            }
            (Values::Sparse(bits), Mode::Coded) => {
                Stream::Sparse { decoder: Box::new(entropy::Decoder::new(bits + 1, bricks, bytes)?) }
            }
            (_, Mode::Coded) | (Values::Sparse(_), Mode::Predicted(_)) => return None,
            (Values::None, _) => Stream::None,
            (Values::Codes(_) | Values::Sparse(_), Mode::Words) | (Values::Blocks, _) => {
                Stream::Packed { bytes }
            }
            (Values::Codes(bits), Mode::Predicted(predictor)) => Stream::Codes { bits, predictor, bytes },
            (Values::Halves, mode) => Stream::Halves { mode, planes: Planes::new(bytes) },
            (Values::Floats, mode) => Stream::Floats { mode, planes: Planes::new(bytes) },
        };
        Some(stream)
    }

    /// Appends the values of the next brick, which are `len` words. `None` if there is none.
    fn next_brick(&mut self, sparse_bits: u32, len: usize, words: &mut Vec<u32>) -> Option<()> {
        match self {
            Stream::None => {}
            Stream::Packed { bytes } => {
                let brick = bytes.split_off(..4 * len)?;
                words.extend(brick.as_chunks().0.iter().map(|word| u32::from_le_bytes(*word)));
            }
            Stream::Coded { bits, decoder } => codes::pack(*bits, &decoder.next_brick()?, words),
            Stream::Sparse { decoder } => {
                let coding = Coding::from_word(sparse_bits)?;
                let symbols = decoder.next_brick()?;
                let most = coding.bits.map(|bits| 1 << bits);
                let is_too_large = |(voxel, symbol): (usize, &u8)| *symbol > most[octant_of(voxel)];
                // In most bricks all symbols are small enough for any octant.
                let largest = symbols.iter().fold(0, |largest, symbol| largest.max(*symbol));
                if most.iter().any(|most| largest > *most) && symbols.iter().enumerate().any(is_too_large) {
                    return None;
                }
                pack_sparse(&coding, &symbols, len, words)?;
            }
            Stream::Codes { bits, predictor, bytes } => {
                let mut numbers: [u8; BRICK_VOXELS] = *bytes.split_off(..BRICK_VOXELS)?.first_chunk()?;
                restore(*predictor, &mut numbers, mask(*bits));
                codes::pack(*bits, &numbers, words);
            }
            Stream::Halves { mode, planes } => {
                let mut halves: [u16; BRICK_VOXELS] = planes.next_brick(u16::from_le_bytes)?;
                if let Mode::Predicted(predictor) = mode {
                    restore(*predictor, &mut halves, u16::MAX);
                    halves = halves.map(half_of_ordered);
                }
                let pairs = halves.as_chunks().0.iter();
                words.extend(pairs.map(|[low, high]: &[u16; 2]| u32::from(*low) | u32::from(*high) << 16));
            }
            Stream::Floats { mode, planes } => {
                let mut floats: [u32; BRICK_VOXELS] = planes.next_brick(u32::from_le_bytes)?;
                if let Mode::Predicted(predictor) = mode {
                    restore(*predictor, &mut floats, u32::MAX);
                    floats = floats.map(float_of_ordered);
                }
                words.extend(floats);
            }
        }
        Some(())
    }
}

fn mask(bits: u8) -> u8 {
    (0xff_u32 >> (8 - bits)) as u8
}

/// The bits of floats as numbers in the order of the floats: the sign set for those that are positive, all bits turned
/// over for the others.
fn ordered_half(bits: u16) -> u16 {
    if bits >> 15 == 0 { bits | 1 << 15 } else { !bits }
}

fn half_of_ordered(number: u16) -> u16 {
    if number >> 15 == 1 { number & !(1 << 15) } else { !number }
}

fn ordered_float(bits: u32) -> u32 {
    if bits >> 31 == 0 { bits | 1 << 31 } else { !bits }
}

fn float_of_ordered(number: u32) -> u32 {
    if number >> 31 == 1 { number & !(1 << 31) } else { !number }
}

/// Numbers of `N` bytes in byte planes, read one after the other.
#[derive(Clone)]
struct Planes<'a, const N: usize> {
    planes: [&'a [u8]; N],
    at: usize,
}

impl<'a, const N: usize> Planes<'a, N> {
    const NONE: Planes<'a, N> = Planes { planes: [&[]; N], at: 0 };

    fn new(bytes: &'a [u8]) -> Planes<'a, N> {
        let len = bytes.len() / N;
        Planes { planes: std::array::from_fn(|i| &bytes[i * len..(i + 1) * len]), at: 0 }
    }

    fn next(&mut self) -> Option<[u8; N]> {
        let mut bytes = [0; N];
        for (byte, plane) in bytes.iter_mut().zip(self.planes) {
            *byte = *plane.get(self.at)?;
        }
        self.at += 1;
        Some(bytes)
    }

    fn next_brick<T>(&mut self, number: impl Fn([u8; N]) -> T) -> Option<[T; BRICK_VOXELS]> {
        let mut planes = [&[0; BRICK_VOXELS]; N];
        for (to, from) in planes.iter_mut().zip(self.planes) {
            *to = from.get(self.at..)?.first_chunk()?;
        }
        self.at += BRICK_VOXELS;
        Some(std::array::from_fn(|i| number(planes.map(|plane| plane[i]))))
    }
}

/// All first bytes, then all second ones, and so on.
pub(super) fn split_planes<const N: usize>(numbers: impl ExactSizeIterator<Item = [u8; N]>) -> Vec<u8> {
    let len = numbers.len();
    let mut out = vec![0; N * len];
    for (i, bytes) in numbers.enumerate() {
        bytes.iter().enumerate().for_each(|(plane, byte)| out[plane * len + i] = *byte);
    }
    out
}

/// The byte planes of words.
pub(super) fn word_planes(words: &[u32]) -> Vec<u8> {
    split_planes(words.iter().map(|word| word.to_le_bytes()))
}

/// The words of byte planes.
pub(super) fn words_of_planes(bytes: &[u8]) -> impl Iterator<Item = u32> {
    let mut planes = Planes::<4>::new(bytes);
    std::iter::from_fn(move || planes.next().map(u32::from_le_bytes))
}

/// About how many bits an entropy coder would make of bytes in so many planes.
fn entropy_bits(bytes: &[u8], plane_count: usize) -> u64 {
    let bits = |plane: &[u8]| {
        let mut counts = [0_u32; 256];
        plane.iter().for_each(|byte| counts[usize::from(*byte)] += 1);
        let cost = |count: u32| f64::from(count) * (plane.len() as f64 / f64::from(count)).log2();
        counts.into_iter().filter(|count| *count > 0).map(cost).sum::<f64>() as u64
    };
    bytes.chunks((bytes.len() / plane_count).max(1)).map(bits).sum()
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use proptest::prelude::*;

    fn mixed(seed: u32) -> u32 {
        let x = seed.wrapping_mul(2_654_435_761);
        (x ^ x >> 15).wrapping_mul(2_246_822_519) ^ x >> 13
    }

    /// Words of bricks of these codecs. Shapes are at `shape`, of a codec of tag 16.
    pub(in crate::format) fn words(codecs: &[Codec], seed: u32, shape: u32) -> Vec<u32> {
        let mut words = Vec::new();
        for (i, codec) in codecs.iter().enumerate() {
            let first = words.len() as u32;
            let is_noise = mixed(seed ^ i as u32).is_multiple_of(3);
            words.extend((0..codec.word_count() as u32).map(|word| {
                // Neither infinite nor no number, in any codec.
                let noise =
                    if is_noise { mixed(seed ^ (first + word)) } else { word.wrapping_mul(0x0101_0101) };
                noise & 0xb3ff_b3ff
            }));
            if *codec == Codec::Shared {
                words[first as usize + 1..].copy_from_slice(&[shape, 16]);
            }
            if let Codec::Sparse { .. } = codec
                && !is_noise
            {
                let most_bits = (i % usize::from(sparse::MAX_BITS)) as u8 + 1;
                let bits =
                    std::array::from_fn(|octant| (most_bits - 1).min(octant as u8 % 3 * (seed & 1) as u8));
                let coding = Coding { bits: bits.map(|fewer| most_bits - fewer), ..Coding::even(most_bits) };
                let mut head_words = Vec::new();
                coding.write(&mut head_words);
                words[first as usize + 1] = head_words[0] | if seed & 2 > 0 { sparse::HAS_ENDS } else { 0 };
                let begin = first as usize + head(*codec, words[first as usize + 1]).len();
                // As many voxels as there is room for, at most.
                let voxels = 8 * (words.len() - begin);
                let symbols = std::array::from_fn(|voxel| match voxel < voxels.saturating_sub(64) {
                    true => mixed(seed ^ voxel as u32) as u8 % (1 << coding.bits[octant_of(voxel)]) + 1,
                    false => 0,
                });
                let mut packed = Vec::new();
                if pack_sparse(&coding, &symbols, words.len() - begin, &mut packed).is_some() {
                    words[begin..].copy_from_slice(&packed);
                }
            }
        }
        words
    }

    pub(in crate::format) fn any_codecs(len: usize) -> impl Strategy<Value = Vec<Codec>> {
        let codec = (1_u8..200).prop_filter_map("a codec", Codec::from_tag);
        proptest::collection::vec(codec, 0..len)
    }

    proptest! {
        #[test]
        fn words_come_back(codecs in any_codecs(40), seed in any::<u32>()) {
            let words = words(&codecs, seed, 0);
            let bytes = encode(&codecs, &words);
            prop_assert!(bytes.len() as u64 <= max_encoded_bytes(&codecs));
            let decoded = decode(&codecs, &bytes);
            prop_assert_eq!(decoded.as_ref(), Some(&words));
            prop_assert_eq!(decode(&codecs, &bytes[..bytes.len() - 1]), None);
        }

        #[test]
        fn values_come_back_in_every_mode(tag in prop::sample::select(vec![1_u8, 2, 3, 4, 5, 6, 7, 8, 9, 10, 19]), seed in any::<u32>()) {
            let codec = Codec::from_tag(tag).unwrap();
            let values = Values::of_group(usize::from(tag)).unwrap();
            let count = codec.word_count() - head(codec, 0).len();
            let words: Vec<u32> = (0..3 * count as u32).map(|i| mixed(i ^ seed)).collect();
            let bricks: Vec<Brick> = words.chunks(count).map(|values| Brick { sparse_bits: 0, values }).collect();
            let modes = Predictor::ALL.map(Mode::Predicted).into_iter().chain([Mode::Words, Mode::Coded]);
            for mode in modes.filter(|mode| *mode != Mode::Coded || matches!(values, Values::Codes(_))) {
                prop_assert_eq!(Mode::from_number(mode.number()), Some(mode));
                let bytes = encode_values(values, mode, &bricks).unwrap();
                let mut rest = &bytes[..];
                let taken = values.take(mode, 3, words.len(), &mut rest).unwrap();
                prop_assert!(rest.is_empty());
                let mut stream = Stream::new(values, mode, 3, taken).unwrap();
                let mut found = Vec::new();
                (0..3).for_each(|_| stream.next_brick(0, count, &mut found).unwrap());
                prop_assert_eq!(&found, &words);
            }
        }

        #[test]
        fn sparse_bricks_are_smaller_than_their_words(seed in any::<u32>()) {
            let symbols: sparse::Symbols = std::array::from_fn(|i| {
                let (height, noise) = (i as u32 >> 6, mixed(seed ^ i as u32) & 1);
                if height + noise < 5 { (height + noise) as u8 + 1 } else { 0 }
            });
            let mut words = vec![0, 3];
            sparse::pack(&Coding::even(3), &symbols, &mut words);
            words.resize(words.len().next_multiple_of(2), 0);
            let codecs = [Codec::Sparse { is_fitted: false, pairs: (words.len() / 2) as u8 }; 40];
            let words = words.repeat(40);
            let bytes = encode(&codecs, &words);
            prop_assert!(bytes.len() < 3 * words.len(), "{}", bytes.len());
            prop_assert_eq!(decode(&codecs, &bytes), Some(words));
        }

        #[test]
        fn any_bytes_are_words_or_none(codecs in any_codecs(4), bytes in proptest::collection::vec(any::<u8>(), 0..3000), mode in 0_u8..9) {
            let mut bytes = bytes;
            bytes.iter_mut().take(GROUPS).for_each(|byte| *byte = mode);
            if let Some(words) = decode(&codecs, &bytes) {
                prop_assert_eq!(words.len(), codecs.iter().map(|codec| codec.word_count()).sum::<usize>());
            }
        }
    }

    #[test]
    fn floats_keep_their_order() {
        let floats = [f32::MIN, -1.5, -1.0, -0.0, 0.0, 1e-40, 1.0, f32::MAX];
        assert!(floats.is_sorted_by_key(|value| ordered_float(value.to_bits())));
        assert!(
            floats.iter().all(|value| float_of_ordered(ordered_float(value.to_bits())) == value.to_bits())
        );
        assert!((0..=u16::MAX).all(|bits| half_of_ordered(ordered_half(bits)) == bits));
    }
}
