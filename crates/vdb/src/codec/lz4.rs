//! An encoder of LZ4 blocks for streams of some hundred bytes.
//!
//! Blosc cuts the values of a leaf into streams of 512 bytes. Libraries clear a table of 8 KB or more before
//! each; here the table is kept, and what earlier streams left in it is told apart by its number. Decoding
//! stays with the library.
//!
//! Format: <https://github.com/lz4/lz4/blob/dev/doc/lz4_Block_format.md>.

const MIN_MATCH: usize = 4;
/// The last bytes of a block are literals …
const LAST_LITERALS: usize = 5;
/// … and no match begins in these.
const LAST_BYTES_WITHOUT_MATCH: usize = 12;
const MAX_DISTANCE: usize = 0xffff;
const TABLE_LOG2: u32 = 12;
/// After as many misses as two to this, the search takes longer steps.
const SKIP_LOG2: u32 = 6;

/// Where each hash was seen last. Positions count on from stream to stream, so that those of earlier streams
/// are below the first of the present one.
pub(super) struct Table {
    seen: Box<[u32; 1 << TABLE_LOG2]>,
    next: u32,
}

impl Default for Table {
    fn default() -> Self {
        Table { seen: Box::new([0; 1 << TABLE_LOG2]), next: 1 }
    }
}

/// Appends `src` as an LZ4 block to `out`, if that takes less than `limit` bytes. If not, what is appended is
/// of no use, and `false` comes back.
pub(super) fn compress(src: &[u8], limit: usize, table: &mut Table, out: &mut Vec<u8>) -> bool {
    let Some(room) = limit.checked_sub(1) else { return false };
    let begin = out.len();
    let base = match table.next.checked_add(u32::try_from(src.len()).unwrap_or(u32::MAX)) {
        Some(next) => std::mem::replace(&mut table.next, next),
        None => {
            *table = Table::default();
            table.next += src.len() as u32;
            1
        }
    };
    let seen = &mut *table.seen;
    let match_begin_limit = src.len().saturating_sub(LAST_BYTES_WITHOUT_MATCH);
    let match_end_limit = src.len().saturating_sub(LAST_LITERALS);
    // Where the literals begin that are not written yet.
    let mut anchor = 0;
    let mut at = 0;
    'search: while at < match_begin_limit {
        // Find four bytes that were there before.
        let mut misses = 1 << SKIP_LOG2;
        let (mut found, word) = loop {
            let word = four(src, at);
            let slot = &mut seen[hash(word)];
            let position = std::mem::replace(slot, base + at as u32);
            if position >= base {
                let candidate = (position - base) as usize;
                if at - candidate <= MAX_DISTANCE && four(src, candidate) == word {
                    break (candidate, word);
                }
            }
            at += misses >> SKIP_LOG2;
            misses += 1;
            if at >= match_begin_limit {
                break 'search;
            }
        };
        debug_assert_eq!(word, four(src, found));
        // Extend the match to both sides.
        let mut end = at + MIN_MATCH + common(src, found + MIN_MATCH, at + MIN_MATCH, match_end_limit);
        while at > anchor && found > 0 && src[at - 1] == src[found - 1] {
            at -= 1;
            found -= 1;
        }
        loop {
            // The worst that this sequence takes, and the token of the last one.
            let literals = &src[anchor..at];
            let extra = end - at - MIN_MATCH;
            if out.len() - begin + literals.len() + literals.len() / 255 + extra / 255 + 6 > room {
                return false;
            }
            sequence(literals, Some((at - found, extra)), out);
            anchor = end;
            at = end;
            if at >= match_begin_limit {
                break 'search;
            }
            let before = at - 2;
            seen[hash(four(src, before))] = base + before as u32;
            // Another match right behind, as in the reference encoder.
            let word = four(src, at);
            let position = std::mem::replace(&mut seen[hash(word)], base + at as u32);
            if position < base {
                break;
            }
            found = (position - base) as usize;
            if at - found > MAX_DISTANCE || four(src, found) != word {
                break;
            }
            end = at + MIN_MATCH + common(src, found + MIN_MATCH, at + MIN_MATCH, match_end_limit);
        }
        at += 1;
    }
    let literals = &src[anchor..];
    if out.len() - begin + literals.len() + literals.len() / 255 + 2 > room {
        return false;
    }
    sequence(literals, None, out);
    true
}

/// Appends literals and a match: its distance, and its length over the least.
fn sequence(literals: &[u8], repeat: Option<(usize, usize)>, out: &mut Vec<u8>) {
    let extra = repeat.map_or(0, |(_, extra)| extra);
    out.push((literals.len().min(15) << 4 | extra.min(15)) as u8);
    length_beyond_token(literals.len(), out);
    out.extend_from_slice(literals);
    if let Some((distance, extra)) = repeat {
        out.extend_from_slice(&(distance as u16).to_le_bytes());
        length_beyond_token(extra, out);
    }
}

fn length_beyond_token(length: usize, out: &mut Vec<u8>) {
    if let Some(mut rest) = length.checked_sub(15) {
        while rest >= 255 {
            out.push(255);
            rest -= 255;
        }
        out.push(rest as u8);
    }
}

fn four(src: &[u8], at: usize) -> u32 {
    src[at..].first_chunk().map_or(0, |bytes| u32::from_le_bytes(*bytes))
}

fn hash(word: u32) -> usize {
    (word.wrapping_mul(2_654_435_761) >> (32 - TABLE_LOG2)) as usize
}

/// The number of bytes that are the same from `a` and from `b` on, the later one, before `end`.
fn common(src: &[u8], a: usize, b: usize, end: usize) -> usize {
    let later = src.get(b..end).unwrap_or_default();
    let earlier = &src[a..];
    let mut len = 0;
    for (x, y) in earlier.as_chunks::<8>().0.iter().zip(later.as_chunks::<8>().0) {
        let differing = u64::from_le_bytes(*x) ^ u64::from_le_bytes(*y);
        if differing != 0 {
            return len + (differing.trailing_zeros() / 8) as usize;
        }
        len += 8;
    }
    len + earlier[len..].iter().zip(&later[len..]).take_while(|(x, y)| x == y).count()
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn comes_back(src: &[u8], table: &mut Table) {
        let mut out = b"before".to_vec();
        let worst = src.len() + src.len() / 255 + 16;
        assert!(compress(src, worst, table, &mut out));
        let mut decoded = vec![0; src.len()];
        assert_eq!(lz4_flex::block::decompress_into(&out[6..], &mut decoded).unwrap(), src.len());
        assert!(decoded == src);
        // The limit is kept, and what fits is the same.
        let size = out.len() - 6;
        for limit in [size.saturating_sub(1), size, size + 1, src.len() / 2] {
            let mut limited = Vec::new();
            if compress(src, limit, table, &mut limited) {
                assert!(limited.len() < limit && limited == out[6..], "{limit}");
            } else {
                assert!(limit <= size + 8, "{size} bytes should fit below {limit}");
            }
        }
    }

    #[test]
    fn long_runs_and_far_matches_come_back() {
        let mut table = Table::default();
        comes_back(&[], &mut table);
        comes_back(&[7; 300_000], &mut table);
        let noise = |i: u32| (i.wrapping_mul(2_654_435_761) >> 13) as u8;
        let mut far: Vec<u8> = (0..70_000).map(noise).collect();
        far.extend_from_within(..5000);
        far.extend_from_within(60_000..);
        comes_back(&far, &mut table);
    }

    #[test]
    fn positions_that_run_out_begin_anew() {
        let mut table = Table { next: u32::MAX - 700, ..Table::default() };
        for _ in 0..4 {
            comes_back(&[1, 2, 3, 4, 5, 6, 7, 8].repeat(40), &mut table);
        }
        assert!(table.next < 10_000);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(300))]

        #[test]
        fn every_stream_comes_back_whatever_came_before(
            streams in proptest::collection::vec(
                (proptest::collection::vec(any::<u8>(), 0..90), 1_usize..30, any::<u8>()), 1..6),
        ) {
            let mut table = Table::default();
            for (run, repeats, mask) in streams {
                let src: Vec<u8> = run.repeat(repeats).iter().map(|byte| byte & mask).collect();
                comes_back(&src, &mut table);
                let mut used = Vec::new();
                let mut fresh = Vec::new();
                let limit = src.len() + 100;
                compress(&src, limit, &mut table, &mut used);
                compress(&src, limit, &mut Table::default(), &mut fresh);
                prop_assert_eq!(used, fresh);
            }
        }
    }
}
