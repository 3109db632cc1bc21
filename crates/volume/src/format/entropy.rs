//! Entropy coding of codes: each code by what its neighbours in the brick are.
//!
//! In smoke a code is near the mean of those before it along x, y and z. That mean is the *context*; of each context a
//! table says how often each symbol follows in the page, and an rANS coder (J. Duda, "Asymmetric numeral systems",
//! arXiv:1311.2540, section 3) spends bits accordingly. The lowest bits of codes of more than five are noise, and stand as
//! they are. Four bricks are decoded at a time, each with its own state, since every symbol has to wait for the one before
//! it.
//!
//! How the bytes stand in a page is [`super::page`]'s.

use crate::space::BRICK_VOXELS;

/// The bits of a code that are coded by context.
const SYMBOL_BITS: u32 = 5;
/// Frequencies of a context add up to 2 to this.
const SCALE_BITS: u32 = 11;
const SCALE: u32 = 1 << SCALE_BITS;
/// A state is at least this, and takes 16 more bits when it falls below.
const LOW: u32 = 1 << 16;

/// There are at most so many contexts.
const MAX_CONTEXTS: usize = 2 << SYMBOL_BITS;

/// The bricks whose symbols take turns.
const TURNS: usize = 4;

type Codes = [u8; BRICK_VOXELS];

/// How the codes of some bits become symbols and contexts.
struct Shape {
    /// The lowest bits, which are kept as they are.
    raw_bits: u32,
    symbols: usize,
    contexts: usize,
    /// The context by the number of neighbours and their sum.
    context: [[u8; 3 << SYMBOL_BITS]; 4],
}

impl Shape {
    fn new(bits: u8) -> Shape {
        let bits = u32::from(bits);
        let raw_bits = bits.saturating_sub(SYMBOL_BITS);
        let symbols = 1_usize << (bits - raw_bits);
        // Without neighbours 0, else one more than twice the mean, rounded down.
        let mean = |count: usize, sum: usize| (2 * sum).checked_div(count).map_or(0, |twice| 1 + twice as u8);
        let context = std::array::from_fn(|count| std::array::from_fn(|sum| mean(count, sum)));
        Shape { raw_bits, symbols, contexts: 2 * symbols, context }
    }

    /// The context of a voxel by the neighbours of its row, its place there and the symbol before.
    #[inline(always)]
    fn context(&self, (before, count): &([u8; 8], usize), z: usize, last: u8) -> usize {
        usize::from(self.context[count + usize::from(z > 0)][usize::from(before[z] + last)])
    }
}

/// The bytes of the codes of some bricks, of 1 to 8 bits each.
pub(super) fn encode(bits: u8, bricks: &[Codes]) -> Vec<u8> {
    let shape = Shape::new(bits);
    // The place of each symbol in the tables, context by context, in the order in which they will be decoded.
    let mut counts = vec![0_u32; shape.contexts * shape.symbols];
    let coded: Vec<[u16; BRICK_VOXELS]> = bricks
        .iter()
        .map(|codes| {
            let symbols = codes.map(|code| code >> shape.raw_bits);
            let mut places = [0; BRICK_VOXELS];
            for row in 0..BRICK_VOXELS / 8 {
                let (neighbours, mut last) = (neighbours(&symbols, row), 0);
                for z in 0..8 {
                    let i = 8 * row + z;
                    let place = shape.context(&neighbours, z, last) * shape.symbols + usize::from(symbols[i]);
                    counts[place] += 1;
                    (places[i], last) = (place as u16, symbols[i]);
                }
            }
            places
        })
        .collect();
    let tables: Vec<Vec<u32>> = counts.chunks(shape.symbols).map(frequencies).collect();
    let parts: Vec<Part> =
        tables.iter().flat_map(|table| table.iter().zip(starts(table)).map(Part::new)).collect();

    // An rANS coder is a stack: the last symbol is encoded first.
    let mut words: Vec<u16> = Vec::new();
    for group in coded.chunks(TURNS).rev() {
        let mut states = [LOW; TURNS];
        for i in (0..BRICK_VOXELS).rev() {
            for (brick, state) in group.iter().zip(&mut states).rev() {
                let part = &parts[usize::from(brick[i])];
                if u64::from(*state) >= u64::from(part.frequency) << (32 - SCALE_BITS) {
                    words.push(*state as u16);
                    *state >>= 16;
                }
                *state = part.push(*state);
            }
        }
        for state in states[..group.len()].iter().rev() {
            words.extend([*state as u16, (*state >> 16) as u16]);
        }
    }
    words.reverse();

    let mut out = Vec::new();
    for table in &tables {
        write_table(table, &mut out);
    }
    out.extend(words.iter().flat_map(|word| word.to_le_bytes()));
    if shape.raw_bits > 0 {
        let mut packed = Vec::new();
        for codes in bricks {
            let low = codes.map(|code| code & ((1 << shape.raw_bits) - 1));
            crate::codec::codes::pack(shape.raw_bits as u8, &low, &mut packed);
        }
        let raw: Vec<u8> = packed.iter().flat_map(|word| word.to_le_bytes()).collect();
        // In front, so that the words may run to the end.
        out.splice(0..0, raw);
    }
    out
}

/// The part of [`SCALE`] that a symbol has.
struct Part {
    frequency: u32,
    start: u32,
    /// 2⁶³ over the frequency, rounded up: a product is faster than a quotient.
    inverse: u64,
}

impl Part {
    fn new((frequency, start): (&u32, u32)) -> Part {
        Part { frequency: *frequency, start, inverse: (1_u64 << 63).div_ceil(u64::from(*frequency).max(1)) }
    }

    /// The state after the symbol.
    #[inline(always)]
    fn push(&self, state: u32) -> u32 {
        // Rounding up adds less than 2¹¹ / 2⁶³ of the state, which is too little to reach the next whole number.
        let quotient = ((u128::from(state) * u128::from(self.inverse)) >> 63) as u32;
        let rest = state - quotient * self.frequency;
        quotient << SCALE_BITS | (rest + self.start)
    }
}

/// Frequencies that add up to [`SCALE`], none of them 0 where the count is not. All 0 if all counts are.
fn frequencies(counts: &[u32]) -> Vec<u32> {
    let total: u64 = counts.iter().map(|count| u64::from(*count)).sum();
    if total == 0 {
        return vec![0; counts.len()];
    }
    let share = |count: &u32| match count {
        0 => 0,
        count => ((u64::from(*count) * u64::from(SCALE) / total) as u32).max(1),
    };
    let mut table: Vec<u32> = counts.iter().map(share).collect();
    // What rounding has added or taken away is settled where it matters least.
    let mut sum: u32 = table.iter().sum();
    while sum != SCALE {
        let largest = (0..table.len()).max_by_key(|i| table[*i]).unwrap_or(0);
        let change = if sum < SCALE { SCALE - sum } else { (sum - SCALE).min(table[largest] / 2) };
        if sum < SCALE {
            table[largest] += change;
            sum += change;
        } else {
            table[largest] -= change;
            sum -= change;
        }
    }
    table
}

fn starts(table: &[u32]) -> Vec<u32> {
    let mut sum = 0;
    let start = |frequency: &u32| {
        sum += frequency;
        sum - frequency
    };
    table.iter().map(start).collect()
}

/// A table: which symbols occur, as a bit each, and the frequency of each but the last of them.
fn write_table(table: &[u32], out: &mut Vec<u8>) {
    let mask = (0..table.len()).filter(|i| table[*i] > 0).fold(0_u32, |mask, i| mask | 1 << i);
    out.extend_from_slice(&mask.to_le_bytes()[..table.len().div_ceil(8)]);
    let present: Vec<u32> = table.iter().copied().filter(|frequency| *frequency > 0).collect();
    for frequency in present.iter().take(present.len().saturating_sub(1)) {
        out.extend_from_slice(&(*frequency as u16).to_le_bytes());
    }
}

fn read_table(symbols: usize, bytes: &mut &[u8]) -> Option<Vec<u32>> {
    let mut mask = [0; 4];
    let mask_bytes = bytes.split_off(..symbols.div_ceil(8))?;
    mask[..mask_bytes.len()].copy_from_slice(mask_bytes);
    let mask = u32::from_le_bytes(mask);
    if u64::from(mask) >> symbols != 0 {
        return None;
    }
    let mut table = vec![0; symbols];
    let mut left = SCALE;
    for symbol in (0..symbols).filter(|symbol| mask >> symbol & 1 == 1) {
        let is_last = mask >> symbol == 1;
        let frequency = match is_last {
            true => left,
            false => u32::from(u16::from_le_bytes(*bytes.split_off(..2)?.first_chunk()?)),
        };
        left = left.checked_sub(frequency)?;
        // None may be 0, and the last one needs something too.
        if frequency == 0 || (!is_last && left == 0) {
            return None;
        }
        table[symbol] = frequency;
    }
    Some(table)
}

/// Decodes bricks one after the other.
pub(super) struct Decoder<'a> {
    shape: Shape,
    /// The symbol of each part of [`SCALE`], by context. A byte each, so that the tables of most bricks stay in the first cache.
    symbols: Box<[[u8; SCALE as usize]; MAX_CONTEXTS]>,
    /// Frequency in the upper half and start in the lower, by context and symbol. 0 in a context without a table.
    ranges: Box<[[u32; 1 << SYMBOL_BITS]; MAX_CONTEXTS]>,
    /// The coded words, two bytes each.
    words: &'a [[u8; 2]],
    raw: &'a [u8],
    bricks_left: usize,
    /// Bricks that were decoded with another, the next one last.
    waiting: Vec<Codes>,
}

impl<'a> Decoder<'a> {
    /// A decoder of `bricks` bricks of codes. `None` if the tables are damaged.
    pub(super) fn new(bits: u8, bricks: usize, mut bytes: &'a [u8]) -> Option<Decoder<'a>> {
        let shape = Shape::new(bits);
        let raw = bytes.split_off(..BRICK_VOXELS / 8 * shape.raw_bits as usize * bricks)?;
        let mut symbols: Box<[_; MAX_CONTEXTS]> = vec![[0; SCALE as usize]; MAX_CONTEXTS].try_into().ok()?;
        let mut ranges = Box::new([[0; 1 << SYMBOL_BITS]; MAX_CONTEXTS]);
        for context in 0..shape.contexts {
            let table = read_table(shape.symbols, &mut bytes)?;
            for (symbol, (frequency, start)) in table.iter().zip(starts(&table)).enumerate() {
                symbols[context][start as usize..(start + frequency) as usize].fill(symbol as u8);
                ranges[context][symbol] = frequency << 16 | start;
            }
        }
        let words = bytes.as_chunks().0;
        Some(Decoder {
            shape,
            symbols,
            ranges,
            words,
            raw,
            bricks_left: bricks,
            waiting: Vec::with_capacity(TURNS),
        })
    }

    /// The codes of the next brick. `None` if there is none or the words are damaged.
    pub(super) fn next_brick(&mut self) -> Option<Codes> {
        if self.waiting.is_empty() {
            match self.bricks_left {
                0 => return None,
                1 => self.decode::<1>()?,
                2 => self.decode::<2>()?,
                3 => self.decode::<3>()?,
                _ => self.decode::<TURNS>()?,
            }
        }
        let mut codes = self.waiting.pop()?;
        self.bricks_left -= 1;
        let raw_bits = self.shape.raw_bits;
        if raw_bits > 0 {
            let raw = self.raw.split_off(..BRICK_VOXELS / 8 * raw_bits as usize)?;
            let words: Vec<u32> = raw.as_chunks().0.iter().map(|word| u32::from_le_bytes(*word)).collect();
            for (i, code) in codes.iter_mut().enumerate() {
                *code = *code << raw_bits | crate::codec::codes::code(raw_bits as u8, &words, i) as u8;
            }
        }
        Some(codes)
    }

    /// Some bricks, voxel by voxel in turn: while one waits for its table, the others go on.
    fn decode<const N: usize>(&mut self) -> Option<()> {
        let mut out = [[0; BRICK_VOXELS]; N];
        let (first, mut words) = self.words.split_at_checked(2 * N)?;
        let word = |word: [u8; 2]| u32::from(u16::from_le_bytes(word));
        let mut states: [u32; N] = std::array::from_fn(|i| word(first[2 * i]) << 16 | word(first[2 * i + 1]));
        let mut least = u32::MAX;
        for row in 0..BRICK_VOXELS / 8 {
            let neighbours = std::array::from_fn::<_, N, _>(|i| neighbours(&out[i], row));
            // Each symbol takes a word at most.
            let (mut padded, mut taken) = ([[0; 2]; 8 * TURNS], 0);
            let next = words.first_chunk().unwrap_or_else(|| {
                padded[..words.len()].copy_from_slice(words);
                &padded
            });
            let mut last = [0; N];
            for z in 0..8 {
                for i in 0..N {
                    let context = self.shape.context(&neighbours[i], z, last[i]);
                    let part = states[i] & (SCALE - 1);
                    let symbol = self.symbols[context % MAX_CONTEXTS][part as usize];
                    let range = self.ranges[context % MAX_CONTEXTS][usize::from(symbol) % (1 << SYMBOL_BITS)];
                    least = least.min(range);
                    last[i] = symbol;
                    out[i][8 * row + z] = symbol;
                    // Below 2³²: the frequency is at most `SCALE`.
                    let above = (range >> 16).wrapping_mul(states[i] >> SCALE_BITS);
                    let state = above.wrapping_add(part.wrapping_sub(range & 0xffff));
                    let is_low = state < LOW;
                    states[i] = if is_low { state << 16 | word(next[taken % next.len()]) } else { state };
                    taken += usize::from(is_low);
                }
            }
            words = words.get(taken..)?;
        }
        self.words = words;
        self.waiting.extend(out.iter().rev());
        (least > 0).then_some(())
    }
}

/// Sums of the neighbours of a row of voxels along x and y, and how many those are.
#[inline]
fn neighbours(symbols: &Codes, row: usize) -> ([u8; 8], usize) {
    let (mut sums, mut count) = ([0; 8], 0);
    for (is_there, distance) in [(row >= 8, 64), (!row.is_multiple_of(8), 8)] {
        if is_there {
            let from = 8 * row - distance;
            sums.iter_mut().zip(&symbols[from..from + 8]).for_each(|(sum, symbol)| *sum += symbol);
            count += 1;
        }
    }
    (sums, count)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Bricks of codes that are near their neighbours.
    fn bricks(bits: u8, count: usize, seed: u32, noise: u32) -> Vec<Codes> {
        let largest = (1_u32 << bits) - 1;
        let brick = |n: usize| {
            std::array::from_fn(|i| {
                let [x, y, z] = [i >> 6, i >> 3 & 7, i & 7].map(|c| c as u32);
                let mixed = ((i + 512 * n) as u32 ^ seed).wrapping_mul(2_654_435_761) >> 16;
                let slope = (x * (seed & 3) + y + z * (seed >> 2 & 3)) * largest / 40 + n as u32;
                ((slope + if noise > 0 { mixed % noise } else { 0 }) % (largest + 1)) as u8
            })
        };
        (0..count).map(brick).collect()
    }

    fn decode(bits: u8, count: usize, bytes: &[u8]) -> Option<Vec<Codes>> {
        let mut decoder = Decoder::new(bits, count, bytes)?;
        (0..count).map(|_| decoder.next_brick()).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]

        #[test]
        fn codes_come_back(
            bits in 1_u8..=8, count in 0_usize..6, seed in any::<u32>(), noise in prop::sample::select(vec![0, 2, 5, 300]),
        ) {
            let bricks = bricks(bits, count, seed, noise);
            let bytes = encode(bits, &bricks);
            prop_assert_eq!(decode(bits, count, &bytes), Some(bricks));
            // Codes that cost nothing may come out of nothing: how many there are is for others to know.
            let _ = decode(bits, count + 2, &bytes);
        }

        #[test]
        fn damage_is_no_panic(
            bits in 1_u8..=8, seed in any::<u32>(), at in any::<prop::sample::Index>(), flip in 1_u8..=255,
            cut in any::<prop::sample::Index>(),
        ) {
            let mut bytes = encode(bits, &bricks(bits, 3, seed, 3));
            let cut = cut.index(bytes.len());
            prop_assert_eq!(decode(bits, 3, &bytes[..cut]), None);
            let at = at.index(bytes.len());
            bytes[at] ^= flip;
            let _ = decode(bits, 3, &bytes);
        }

        #[test]
        fn frequencies_add_up(counts in proptest::collection::vec(prop_oneof![Just(0_u32), 1..5_u32, 1..1_000_000_u32], 32)) {
            let table = frequencies(&counts);
            let expected = if counts.iter().any(|count| *count > 0) { SCALE } else { 0 };
            prop_assert_eq!(table.iter().sum::<u32>(), expected);
            prop_assert!(table.iter().zip(&counts).all(|(f, count)| (*f > 0) == (*count > 0)));
            let mut bytes = Vec::new();
            write_table(&table, &mut bytes);
            prop_assert_eq!(read_table(32, &mut &bytes[..]), Some(table));
        }
    }

    proptest! {
        #[test]
        fn a_product_is_the_quotient(state in any::<u32>(), frequency in 1..=SCALE, is_multiple in any::<bool>()) {
            let end = (u64::from(frequency) << (32 - SCALE_BITS)).min(u64::from(u32::MAX)) as u32;
            let state = (if is_multiple { state / frequency * frequency } else { state }) % end;
            let pushed = Part::new((&frequency, 0)).push(state);
            prop_assert_eq!(pushed, ((state / frequency) << SCALE_BITS) | (state % frequency));
        }
    }

    #[test]
    fn what_neighbours_tell_is_not_paid_for() {
        let ramp: Codes = std::array::from_fn(|i| (((i >> 6) + (i >> 3 & 7) + (i & 7)) * 15 / 21) as u8);
        let smooth = encode(4, &[ramp; 40]);
        assert!(smooth.len() < 40 * 256 / 4, "{}", smooth.len());
    }
}
