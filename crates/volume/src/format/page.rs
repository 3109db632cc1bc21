//! The bytes that the words of a page become before they are compressed, and back.
//!
//! Words are sorted by meaning: lines, corners, shapes, and the values of each codec stand together, in streams whose
//! lengths follow from the codecs. Words become byte planes: all lowest bytes, then all second ones, and so on. Codes
//! and half floats may be predicted from their neighbours first; a byte per codec says how.
//!
//! Which bricks a page holds is [`crate::packed::store`]'s; compression is [`super::chunk`]'s.

use super::entropy;
use super::predict::{Number, Predictor, residuals, restore};
use crate::codec::{Codec, codes};
use crate::space::BRICK_VOXELS;

/// One more than the largest tag of a codec.
const TAGS: usize = 52;

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
const HEAD_STREAMS: usize = 6;

/// The streams of a lattice with codes.
const LATTICE: [usize; 18] = {
    let mut streams = [LATTICES; 18];
    (streams[0], streams[17]) = (LINES, LINES);
    streams
};

/// Which streams the first words of a brick go to.
fn head(codec: Codec) -> &'static [usize] {
    match codec {
        Codec::Constant | Codec::F16 | Codec::F32 => &[],
        Codec::Uniform { .. } | Codec::Block { .. } => &[LINES],
        Codec::Gradient { bits: 0 } => &[LINES, CORNERS, CORNERS],
        Codec::Gradient { .. } => &[LINES, CORNERS, CORNERS, LINES],
        Codec::Lattice { bits: 0 } => LATTICE.split_last().map_or(&[], |(_, head)| head),
        Codec::Lattice { .. } => &LATTICE,
        Codec::Split { .. } => &[LINES, OCTANTS, OCTANTS, OCTANTS, OCTANTS],
        Codec::Shared => &[LINES, SHAPE_OFFSETS, SHAPE_TAGS],
    }
}

/// What follows these words.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Values {
    None,
    Codes(u8),
    /// So many words of texture blocks, which have no neighbours that predict them.
    Blocks(usize),
    Halves,
    Floats,
}

impl Values {
    fn of(codec: Codec) -> Values {
        match codec {
            Codec::Constant | Codec::Shared | Codec::Gradient { bits: 0 } | Codec::Lattice { bits: 0 } => {
                Values::None
            }
            Codec::Uniform { bits }
            | Codec::Gradient { bits }
            | Codec::Lattice { bits }
            | Codec::Split { bits } => Values::Codes(bits),
            Codec::Block { .. } => Values::Blocks(codec.word_count() - 1),
            Codec::F16 => Values::Halves,
            Codec::F32 => Values::Floats,
        }
    }

    fn plane_count(self) -> usize {
        match self {
            Values::None | Values::Codes(_) | Values::Blocks(_) => 1,
            Values::Halves => 2,
            Values::Floats => 4,
        }
    }

    /// Takes the bytes of so many bricks' values. `None` if they are not there.
    fn take<'a>(self, mode: Mode, bricks: usize, rest: &mut &'a [u8]) -> Option<&'a [u8]> {
        let len = match (self, mode) {
            (_, Mode::Coded) if bricks == 0 => 0,
            (_, Mode::Coded) => u32::from_le_bytes(*rest.split_off(..4)?.first_chunk()?) as usize,
            _ => bricks * self.brick_bytes(mode),
        };
        rest.split_off(..len)
    }

    /// The bytes of a brick's values in a stream.
    fn brick_bytes(self, mode: Mode) -> usize {
        match (self, mode) {
            (Values::None, _) => 0,
            (Values::Codes(_), Mode::Predicted(_)) => BRICK_VOXELS,
            (Values::Codes(bits), Mode::Words | Mode::Coded) => 4 * codes::word_count(bits),
            (Values::Blocks(words), _) => 4 * words,
            (Values::Halves, _) => 2 * BRICK_VOXELS,
            (Values::Floats, _) => 4 * BRICK_VOXELS,
        }
    }
}

/// The most bytes that the words of such bricks become.
pub(super) fn max_encoded_bytes(codecs: &[Codec]) -> u64 {
    let bytes = |codec: &Codec| (4 * codec.word_count() + BRICK_VOXELS) as u64;
    // A mode for each tag, and at most a length.
    codecs.iter().map(bytes).sum::<u64>() + 5 * TAGS as u64
}

/// The bytes of the words of some bricks, one after the other.
pub(super) fn encode(codecs: &[Codec], words: &[u32]) -> Vec<u8> {
    let mut heads = [const { Vec::new() }; HEAD_STREAMS];
    let mut values = [const { Vec::new() }; TAGS];
    let mut rest = words;
    for codec in codecs {
        let (brick, after) = rest.split_at(codec.word_count());
        let (first, last) = brick.split_at(head(*codec).len());
        first.iter().zip(head(*codec)).for_each(|(word, stream)| heads[*stream].push(*word));
        values[usize::from(codec.tag())].extend_from_slice(last);
        rest = after;
    }
    let mut out = vec![0; TAGS];
    heads.iter().for_each(|words| out.extend(word_planes(words)));
    for (tag, words) in values.iter().enumerate() {
        let Some(codec) = Codec::from_tag(tag as u8).filter(|_| !words.is_empty()) else { continue };
        let values = Values::of(codec);
        // Measured on clouds: a byte for a code of one or two bits never pays, however well it is predicted. What is
        // not entropy-coded here is so by whoever compresses the page.
        let modes = match values {
            Values::Codes(..=2) => vec![Mode::Coded, Mode::Words],
            Values::Codes(_) => [&[Mode::Coded][..], &Predictor::ALL.map(Mode::Predicted)].concat(),
            Values::Blocks(_) => vec![Mode::Words],
            _ => Predictor::ALL.map(Mode::Predicted).to_vec(),
        };
        let candidates = modes.into_iter().map(|mode| (mode, encode_values(values, mode, words)));
        let best = candidates.min_by_key(|(mode, bytes)| match mode {
            Mode::Coded => 8 * bytes.len() as u64,
            _ => entropy_bits(bytes, values.plane_count()),
        });
        if let Some((mode, bytes)) = best {
            out[tag] = mode.number();
            out.extend(bytes);
        }
    }
    out
}

/// The words of bricks of these codecs from what [`encode`] made of them. `None` if it made no such bytes.
pub(super) fn decode(codecs: &[Codec], bytes: &[u8]) -> Option<Vec<u32>> {
    let (modes, mut rest) = bytes.split_at_checked(TAGS)?;
    let (mut head_counts, mut brick_counts) = ([0; HEAD_STREAMS], [0; TAGS]);
    for codec in codecs {
        head(*codec).iter().for_each(|stream| head_counts[*stream] += 1);
        brick_counts[usize::from(codec.tag())] += 1;
    }
    let mut heads = [const { Planes::<4>::NONE }; HEAD_STREAMS];
    for (head, count) in heads.iter_mut().zip(head_counts) {
        *head = Planes::new(rest.split_off(..4 * count)?);
    }
    let mut streams = [const { None }; TAGS];
    for (tag, stream) in streams.iter_mut().enumerate() {
        let Some(codec) = Codec::from_tag(tag as u8) else { continue };
        let (mode, values) = (Mode::from_number(modes[tag])?, Values::of(codec));
        let bytes = values.take(mode, brick_counts[tag], &mut rest)?;
        *stream = Some(Stream::new(values, mode, brick_counts[tag], bytes)?);
    }
    if !rest.is_empty() {
        return None;
    }
    let mut words = Vec::with_capacity(codecs.iter().map(|codec| codec.word_count()).sum());
    for codec in codecs {
        for stream in head(*codec) {
            words.push(u32::from_le_bytes(heads[*stream].next()?));
        }
        streams[usize::from(codec.tag())].as_mut()?.next_brick(&mut words)?;
    }
    Some(words)
}

/// The values of all bricks of a codec in one mode.
fn encode_values(values: Values, mode: Mode, words: &[u32]) -> Vec<u8> {
    match (values, mode) {
        (Values::None, _) => Vec::new(),
        (Values::Codes(_), Mode::Words) | (Values::Blocks(_), _) => {
            words.iter().flat_map(|word| word.to_le_bytes()).collect()
        }
        (Values::Codes(bits), Mode::Coded) => {
            let bricks = words.chunks(codes::word_count(bits));
            let codes: Vec<[u8; BRICK_VOXELS]> =
                bricks.map(|brick| std::array::from_fn(|i| codes::code(bits, brick, i) as u8)).collect();
            let coded = entropy::encode(bits, &codes);
            [&(coded.len() as u32).to_le_bytes()[..], &coded].concat()
        }
        (Values::Codes(bits), Mode::Predicted(predictor)) => {
            let mut bytes = Vec::with_capacity(words.len() / usize::from(bits) * 32);
            for brick in words.chunks(codes::word_count(bits)) {
                let mut codes = std::array::from_fn(|i| codes::code(bits, brick, i) as u8);
                residuals(predictor, &mut codes, mask(bits));
                bytes.extend(codes);
            }
            bytes
        }
        (Values::Halves, _) => {
            let halves: Vec<u16> =
                words.iter().flat_map(|word| [*word as u16, (*word >> 16) as u16]).collect();
            let bricks = predicted(&halves, mode, ordered_half);
            split_planes::<2>(bricks.iter().map(|half| half.to_le_bytes()))
        }
        (Values::Floats, _) => {
            let bricks = predicted(words, mode, ordered_float);
            split_planes::<4>(bricks.iter().map(|word| word.to_le_bytes()))
        }
    }
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
    Packed { brick_bytes: usize, bytes: &'a [u8] },
    Codes { bits: u8, predictor: Predictor, bytes: &'a [u8] },
    Coded { bits: u8, decoder: Box<entropy::Decoder<'a>> },
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
            (_, Mode::Coded) => return None,
            (Values::None, _) => Stream::None,
            (Values::Codes(bits), Mode::Words) => {
                Stream::Packed { brick_bytes: 4 * codes::word_count(bits), bytes }
            }
            (Values::Blocks(words), _) => Stream::Packed { brick_bytes: 4 * words, bytes },
            (Values::Codes(bits), Mode::Predicted(predictor)) => Stream::Codes { bits, predictor, bytes },
            (Values::Halves, mode) => Stream::Halves { mode, planes: Planes::new(bytes) },
            (Values::Floats, mode) => Stream::Floats { mode, planes: Planes::new(bytes) },
        };
        Some(stream)
    }

    /// Appends the words of the next brick. `None` if there is none.
    fn next_brick(&mut self, words: &mut Vec<u32>) -> Option<()> {
        match self {
            Stream::None => {}
            Stream::Packed { brick_bytes, bytes } => {
                let brick = bytes.split_off(..*brick_bytes)?;
                words.extend(brick.as_chunks().0.iter().map(|word| u32::from_le_bytes(*word)));
            }
            Stream::Coded { bits, decoder } => codes::pack(*bits, &decoder.next_brick()?, words),
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
        }
        words
    }

    pub(in crate::format) fn any_codecs(len: usize) -> impl Strategy<Value = Vec<Codec>> {
        let codec = (1_u8..52).prop_filter_map("a codec", Codec::from_tag);
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
            let values = Values::of(codec);
            let count = 3 * values.brick_bytes(Mode::Words) / 4;
            let words: Vec<u32> = (0..count as u32).map(|i| mixed(i ^ seed)).collect();
            let modes = Predictor::ALL.map(Mode::Predicted).into_iter().chain([Mode::Words, Mode::Coded]);
            for mode in modes.filter(|mode| *mode != Mode::Coded || matches!(values, Values::Codes(_))) {
                prop_assert_eq!(Mode::from_number(mode.number()), Some(mode));
                let bytes = encode_values(values, mode, &words);
                let mut rest = &bytes[..];
                let taken = values.take(mode, 3, &mut rest).unwrap();
                prop_assert!(rest.is_empty());
                prop_assert!(mode == Mode::Coded || taken.len() == 3 * values.brick_bytes(mode));
                let mut stream = Stream::new(values, mode, 3, taken).unwrap();
                let mut found = Vec::new();
                (0..3).for_each(|_| stream.next_brick(&mut found).unwrap());
                prop_assert_eq!(&found, &words);
            }
        }

        #[test]
        fn any_bytes_are_words_or_none(codecs in any_codecs(4), bytes in proptest::collection::vec(any::<u8>(), 0..3000), mode in 0_u8..9) {
            let mut bytes = bytes;
            bytes.iter_mut().take(TAGS).for_each(|byte| *byte = mode);
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
