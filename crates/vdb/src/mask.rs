//! Bit masks of tree nodes, with rank: how many bits are set below a given one.
//!
//! Children of a node are stored packed in the order of their bits, so the rank of a bit is the position of
//! its child.

/// A bit mask of fixed length with a running count per word.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mask {
    len: usize,
    words: Box<[u64]>,
    /// Set bits in all words before each one.
    before: Box<[u32]>,
}

impl Mask {
    /// Bytes of memory per word, for budgets.
    pub(crate) const BYTES_PER_WORD: usize = 12;

    /// A mask of `len` bits; bit `i` is bit `i % 64` of word `i / 64`. Bits past the end are cleared.
    ///
    /// # Panics
    /// If the words hold less or more than that, or it is 2³² bits or more.
    pub fn new(mut words: Box<[u64]>, len: usize) -> Self {
        assert!(words.len() == len.div_ceil(64) && len <= u32::MAX as usize, "{len} bits");
        if let (Some(last), 1..) = (words.last_mut(), len % 64) {
            *last &= (1 << (len % 64)) - 1;
        }
        let mut count = 0;
        let before = words
            .iter()
            .map(|word| {
                let before = count;
                count += word.count_ones();
                before
            })
            .collect();
        Mask { len, words, before }
    }

    /// The number of bits, set or not.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether the mask has no bits at all.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Whether bit `i` is set; `false` past the end.
    pub fn contains(&self, i: usize) -> bool {
        self.words.get(i / 64).is_some_and(|word| word >> (i % 64) & 1 == 1)
    }

    /// The number of set bits below bit `i`.
    pub fn rank(&self, i: usize) -> usize {
        match (self.words.get(i / 64), self.before.get(i / 64)) {
            (Some(word), Some(before)) => {
                *before as usize + (word & ((1 << (i % 64)) - 1)).count_ones() as usize
            }
            _ => self.count(),
        }
    }

    /// The number of set bits.
    pub fn count(&self) -> usize {
        match (self.words.last(), self.before.last()) {
            (Some(word), Some(before)) => *before as usize + word.count_ones() as usize,
            _ => 0,
        }
    }

    /// The set bits in ascending order.
    pub fn iter(&self) -> impl Iterator<Item = usize> + '_ {
        self.words.iter().enumerate().flat_map(|(i, word)| bits(*word).map(move |bit| i * 64 + bit))
    }

    /// The mask as words of 64 bits.
    pub fn words(&self) -> &[u64] {
        &self.words
    }
}

/// The set bits of a word in ascending order.
pub(crate) fn bits(mut word: u64) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let bit = word.trailing_zeros() as usize;
        (word != 0).then(|| {
            word &= word - 1;
            bit
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rank_counts_the_bits_below() {
        let mask = Mask::new(vec![0b1011, 0, u64::MAX, 1 << 63].into(), 256);
        let set: Vec<usize> = mask.iter().collect();
        assert_eq!(set.len(), mask.count());
        for (position, bit) in set.iter().enumerate() {
            assert!(mask.contains(*bit));
            assert_eq!(mask.rank(*bit), position);
        }
        assert!(!mask.contains(4) && !mask.contains(1000));
        assert_eq!(mask.rank(1000), mask.count());
    }

    #[test]
    fn bits_past_the_end_do_not_count() {
        let mask = Mask::new(vec![u64::MAX].into(), 8);
        assert_eq!((mask.len(), mask.count(), mask.rank(64)), (8, 8, 8));
        assert!(mask.contains(7) && !mask.contains(8));
    }
}
