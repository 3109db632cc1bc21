//! The mask of a node: which of its slots have an entry, stored so that sparse nodes take little.
//!
//! A mask of `slots` bits is words of 32 slots, of which only those that are not zero are kept. First comes a summary,
//! one bit per word, in `slots / 1024` words. Then, as 16-bit numbers two to a word, how many words are kept before each
//! word of the summary. Then the words that are kept, and last, as 16-bit numbers again, how many bits are set before
//! each of them. A look-up reads two bits and counts the bits below them.

use super::Trees;

/// The words of 16-bit numbers, two to a word.
fn halves(count: usize) -> usize {
    count.div_ceil(2)
}

fn half(words: &[u32], i: usize) -> Option<usize> {
    Some((words.get(i / 2)? >> (i % 2 * 16) & 0xffff) as usize)
}

fn push_halves(words: &mut Vec<u32>, numbers: &[u32]) {
    words.extend(numbers.chunks(2).map(|pair| pair[0] | pair.get(1).unwrap_or(&0) << 16));
}

/// The words of a mask whose set bits are given: `slots / 32` words, the first slot lowest.
pub fn encode(bits: &[u32]) -> Vec<u32> {
    let (mut summary, mut kept_before) = (vec![0_u32; bits.len().div_ceil(32)], Vec::new());
    let (mut kept, mut set_before) = (Vec::new(), Vec::new());
    let mut set = 0;
    for (i, word) in bits.iter().enumerate() {
        if i % 32 == 0 {
            kept_before.push(kept.len() as u32);
        }
        if *word != 0 {
            summary[i / 32] |= 1 << (i % 32);
            kept.push(*word);
            set_before.push(set);
            set += word.count_ones();
        }
    }
    let mut words = summary;
    push_halves(&mut words, &kept_before);
    words.extend_from_slice(&kept);
    push_halves(&mut words, &set_before);
    words
}

/// How many entries stand before that of a slot, if the slot has one. `begin` is where the mask begins.
pub fn rank(masks: &[u32], begin: u32, slots: usize, slot: usize) -> Option<usize> {
    let mask = masks.get(begin as usize..)?;
    let summary_words = slots / 1024;
    let (word, bit) = (slot / 32, slot % 32);
    let summary = *mask.get(word / 32)?;
    if summary >> (word % 32) & 1 == 0 {
        return None;
    }
    let below = |bits: u32, bit: usize| (bits & ((1 << bit) - 1)).count_ones() as usize;
    let kept = half(mask.get(summary_words..)?, word / 32)? + below(summary, word % 32);
    let first_kept = summary_words + halves(summary_words);
    let bits = *mask.get(first_kept + kept)?;
    if bits >> bit & 1 == 0 {
        return None;
    }
    let kept_count = kept_words(mask, summary_words);
    let before = half(mask.get(first_kept + kept_count..)?, kept)?;
    Some(before + below(bits, bit))
}

fn kept_words(mask: &[u32], summary_words: usize) -> usize {
    mask.iter().take(summary_words).map(|word| word.count_ones() as usize).sum()
}

/// The words that a mask of so many slots takes at most.
pub fn most_words(slots: usize) -> usize {
    let (summary_words, kept) = (slots / 1024, slots / 32);
    summary_words + halves(summary_words) + kept + halves(kept)
}

/// The words that a mask takes. `None` if it does not end.
pub fn len(masks: &[u32], begin: u32, slots: usize) -> Option<usize> {
    let mask = masks.get(begin as usize..)?;
    let summary_words = slots / 1024;
    let kept = kept_words(mask.get(..summary_words)?, summary_words);
    let len = summary_words + halves(summary_words) + kept + halves(kept);
    (mask.len() >= len).then_some(len)
}

/// The set bits of a mask, `slots / 32` words. `None` if it is not all there.
pub fn decode(masks: &[u32], begin: u32, slots: usize) -> Option<Vec<u32>> {
    let mask = masks.get(begin as usize..)?.get(..len(masks, begin, slots)?)?;
    let summary_words = slots / 1024;
    let mut kept = mask[summary_words + halves(summary_words)..].iter();
    let is_kept = |i: usize| mask[i / 32] >> (i % 32) & 1 == 1;
    let word = |i: usize| if is_kept(i) { kept.next().copied() } else { Some(0) };
    (0..slots / 32).map(word).collect()
}

/// The slots of a mask in order.
pub fn slots(trees: &Trees, begin: u32, slots: usize) -> impl Iterator<Item = usize> {
    let bits = decode(&trees.masks, begin, slots).unwrap_or_default();
    bits.into_iter()
        .enumerate()
        .flat_map(|(i, word)| (0..32).filter(move |bit| word >> bit & 1 == 1).map(move |bit| i * 32 + bit))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn masks_come_back(
            set in proptest::collection::btree_set(0_usize..32768, 0..600), is_small in any::<bool>(), dense in any::<bool>(),
        ) {
            let count = if is_small { 4096 } else { 32768 };
            let mut bits = vec![0_u32; count / 32];
            set.iter().map(|slot| slot % count).for_each(|slot| bits[slot / 32] |= 1 << (slot % 32));
            if dense {
                bits[..100].fill(u32::MAX);
            }
            let mut masks = vec![7; 3];
            masks.extend(encode(&bits));
            masks.push(9);
            prop_assert_eq!(len(&masks, 3, count), Some(masks.len() - 4));
            let decoded = decode(&masks, 3, count);
            prop_assert_eq!(decoded.as_ref(), Some(&bits));
            prop_assert!(masks.len() - 4 <= most_words(count));
            let mut expected = 0;
            for slot in 0..count {
                let is_set = bits[slot / 32] >> (slot % 32) & 1 == 1;
                prop_assert_eq!(rank(&masks, 3, count, slot), is_set.then_some(expected));
                expected += usize::from(is_set);
            }
            let cut = &masks[..masks.len() - 2];
            prop_assert_eq!(decode(cut, 3, count), None);
            (0..count).for_each(|slot| _ = rank(cut, 3, count, slot));
        }
    }
}
