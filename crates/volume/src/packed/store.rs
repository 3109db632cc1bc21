//! The brick store: the words of all bricks, in pages of which some may be absent, and the shapes that shared bricks
//! refer to.
//!
//! Bricks stand one after the other without gaps, so that their codecs alone say where each begins. Offsets count words
//! over all pages, present or not. How pages come from a file and go to one is [`crate::format`]'s.

use std::ops::Range;

use crate::codec::{BrickContext, Codec, DecodeError};
use crate::space::BRICK_VOXELS;

/// A page that holds this many words takes no further brick.
pub const PAGE_WORDS: usize = 1 << 16;

/// One offset is kept for so many bricks; the others are counted from it.
const MARKED: usize = 16;

/// What is wrong with a brick that is added, or with words that are to be those of a page.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum StoreError {
    /// A constant among bricks, a shared brick among shapes, or words of a number that the codec does not have.
    #[error("words that are no brick of their codec")]
    NotABrick,
    /// A shared brick refers to something that is no shape.
    #[error("a shared brick without a shape")]
    NoShape,
    /// There are more than 2³² words.
    #[error("a brick store of more than 2³² words")]
    TooLarge,
    /// Pages that do not hold every brick once, in order.
    #[error("pages that do not follow each other")]
    Pages,
}

/// Bricks in order: the codec of each, and so where it begins.
#[derive(Debug, Clone, Default, PartialEq)]
struct Directory {
    codecs: Vec<Codec>,
    /// The offset of every brick whose number is a multiple of [`MARKED`].
    marks: Vec<u32>,
    word_count: u32,
}

impl Directory {
    /// Adds a brick. Gives its offset.
    fn push(&mut self, codec: Codec) -> Result<u32, StoreError> {
        let offset = self.word_count;
        let end = offset.checked_add(codec.word_count() as u32).ok_or(StoreError::TooLarge)?;
        if codec == Codec::Constant || self.codecs.len() >= u32::MAX as usize {
            return Err(StoreError::NotABrick);
        }
        if self.codecs.len().is_multiple_of(MARKED) {
            self.marks.push(offset);
        }
        self.codecs.push(codec);
        self.word_count = end;
        Ok(offset)
    }

    /// The bricks from a number on, with their offsets.
    fn from(&self, brick: usize) -> impl Iterator<Item = (Codec, u32)> {
        let mark = brick / MARKED;
        let mut at = self.marks.get(mark).copied().unwrap_or(self.word_count);
        let bricks = self.codecs.get(mark * MARKED..).unwrap_or_default().iter().map(move |codec| {
            let offset = at;
            at += codec.word_count() as u32;
            (*codec, offset)
        });
        bricks.skip(brick % MARKED)
    }

    /// The offset of a brick; past the last one, the end.
    fn offset(&self, brick: usize) -> u32 {
        self.from(brick).next().map_or(self.word_count, |(_, offset)| offset)
    }

    /// The brick that begins at an offset.
    fn at(&self, offset: u32) -> Option<Codec> {
        let mark = self.marks.partition_point(|mark| *mark <= offset).checked_sub(1)?;
        let mut marked = self.from(mark * MARKED).take(MARKED);
        marked.find_map(|(codec, at)| (at == offset).then_some(codec))
    }

    fn memory_bytes(&self) -> usize {
        size_of_val(self.codecs.as_slice()) + size_of_val(self.marks.as_slice())
    }
}

/// Whole bricks that come and go together.
#[derive(Debug, Clone, PartialEq)]
pub struct Page {
    /// The number of its first brick.
    pub first_brick: u32,
    /// How many bricks it holds.
    pub brick_count: u32,
    /// The offset of its first word.
    pub first_word: u32,
    /// How many words it holds.
    pub word_count: u32,
    /// The words, if they are in memory.
    words: Option<Vec<u32>>,
}

impl Page {
    /// Its words, if they are in memory.
    pub fn words(&self) -> Option<&[u32]> {
        self.words.as_deref()
    }

    /// The numbers of its bricks.
    pub fn bricks(&self) -> Range<usize> {
        let first = self.first_brick as usize;
        first..first + self.brick_count as usize
    }
}

/// The bricks of a volume, and the shapes that they share.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct BrickStore {
    bricks: Directory,
    pages: Vec<Page>,
    /// The words of all pages that are present.
    present_words: usize,
    shapes: Directory,
    shape_words: Vec<u32>,
}

impl BrickStore {
    /// A store whose pages are all absent.
    ///
    /// # Errors
    /// If a codec or the words of the shapes cannot be, there are too many words, or the pages, each so many bricks, do
    /// not hold all bricks.
    pub fn without_pages(
        codecs: &[Codec],
        page_bricks: &[u32],
        shape_codecs: &[Codec],
        shape_words: Vec<u32>,
    ) -> Result<BrickStore, StoreError> {
        let mut store = BrickStore { shape_words, ..BrickStore::default() };
        let mut codecs = codecs.iter();
        for count in page_bricks {
            let (first_brick, first_word) = (store.bricks.codecs.len() as u32, store.bricks.word_count);
            for _ in 0..*count {
                store.bricks.push(*codecs.next().ok_or(StoreError::Pages)?)?;
            }
            let word_count = store.bricks.word_count - first_word;
            store.pages.push(Page { first_brick, brick_count: *count, first_word, word_count, words: None });
        }
        if codecs.next().is_some() || page_bricks.contains(&0) {
            return Err(StoreError::Pages);
        }
        for codec in shape_codecs {
            if *codec == Codec::Shared {
                return Err(StoreError::NotABrick);
            }
            store.shapes.push(*codec)?;
        }
        match store.shapes.word_count as usize == store.shape_words.len() {
            true => Ok(store),
            false => Err(StoreError::NotABrick),
        }
    }

    /// Adds a brick, to the last page or to a new one. Gives its offset.
    ///
    /// # Errors
    /// If the words are not those of a brick, the shape is not there, or the store is full.
    pub fn push(&mut self, codec: Codec, words: &[u32]) -> Result<u32, StoreError> {
        if words.len() != codec.word_count() {
            return Err(StoreError::NotABrick);
        }
        if codec == Codec::Shared {
            self.check_shape(words)?;
        }
        let offset = self.bricks.push(codec)?;
        self.present_words += words.len();
        let has_room = |page: &&mut Page| (page.word_count as usize) < PAGE_WORDS;
        match self.pages.last_mut().filter(has_room) {
            Some(Page { brick_count, word_count, words: Some(page), .. }) => {
                page.extend_from_slice(words);
                *brick_count += 1;
                *word_count += words.len() as u32;
            }
            _ => self.pages.push(Page {
                first_brick: self.bricks.codecs.len() as u32 - 1,
                brick_count: 1,
                first_word: offset,
                word_count: words.len() as u32,
                words: Some(words.to_vec()),
            }),
        }
        Ok(offset)
    }

    /// Adds bricks as a page of their own, whose words are all there. Gives the number of the first.
    ///
    /// # Errors
    /// If there is no brick, the words are not those of these bricks, a shape is not there, or the store is full; the
    /// store is then of no more use.
    pub fn push_page(&mut self, codecs: &[Codec], words: &[u32]) -> Result<u32, StoreError> {
        let (first_brick, first_word) = (self.bricks.codecs.len() as u32, self.bricks.word_count);
        for codec in codecs {
            self.bricks.push(*codec)?;
        }
        if codecs.is_empty() {
            return Err(StoreError::Pages);
        }
        let (brick_count, word_count) = (codecs.len() as u32, self.bricks.word_count - first_word);
        self.pages.push(Page { first_brick, brick_count, first_word, word_count, words: None });
        self.set_page(self.pages.len() - 1, words.to_vec())?;
        Ok(first_brick)
    }

    /// Adds a shape. Gives its offset in the shape store.
    ///
    /// # Errors
    /// If the words are not those of a brick, the codec is that of a shared one, or the store is full.
    pub fn push_shape(&mut self, codec: Codec, words: &[u32]) -> Result<u32, StoreError> {
        if words.len() != codec.word_count() || codec == Codec::Shared {
            return Err(StoreError::NotABrick);
        }
        let offset = self.shapes.push(codec)?;
        self.shape_words.extend_from_slice(words);
        Ok(offset)
    }

    fn check_shape(&self, words: &[u32]) -> Result<(), StoreError> {
        let shape = words.get(1).and_then(|offset| self.shapes.at(*offset));
        match (shape, words.get(2)) {
            (Some(codec), Some(tag)) if u32::from(codec.tag()) == *tag => Ok(()),
            _ => Err(StoreError::NoShape),
        }
    }

    /// Makes a page present.
    ///
    /// # Errors
    /// If there is no such page, or the words cannot be its words.
    pub fn set_page(&mut self, index: usize, words: Vec<u32>) -> Result<(), StoreError> {
        let page = self.pages.get(index).ok_or(StoreError::Pages)?;
        if words.len() != page.word_count as usize {
            return Err(StoreError::NotABrick);
        }
        let mut at = 0;
        for codec in &self.bricks.codecs[page.bricks()] {
            if *codec == Codec::Shared {
                self.check_shape(&words[at..])?;
            }
            at += codec.word_count();
        }
        self.drop_page(index);
        self.present_words += words.len();
        self.pages[index].words = Some(words);
        Ok(())
    }

    /// Makes a page absent.
    pub fn drop_page(&mut self, index: usize) {
        let words = self.pages.get_mut(index).and_then(|page| page.words.take());
        self.present_words -= words.map_or(0, |words| words.len());
    }

    /// The page that an offset lies in.
    pub fn page_of(&self, offset: u32) -> Option<usize> {
        let page = self.pages.partition_point(|page| page.first_word <= offset).checked_sub(1)?;
        (offset < self.bricks.word_count).then_some(page)
    }

    /// The pages that hold bricks of these numbers.
    pub fn pages_of(&self, bricks: Range<usize>) -> Range<usize> {
        let begin = self.pages.partition_point(|page| page.bricks().end <= bricks.start);
        let end = self.pages.partition_point(|page| page.bricks().start < bricks.end);
        begin..end.max(begin)
    }

    /// All pages, present or not.
    pub fn pages(&self) -> &[Page] {
        &self.pages
    }

    /// The codecs of all bricks, in order.
    pub fn codecs(&self) -> &[Codec] {
        &self.bricks.codecs
    }

    /// The offset of the brick of a number; past the last one, the number of words.
    pub fn offset(&self, brick: usize) -> u32 {
        self.bricks.offset(brick)
    }

    /// The codecs of all shapes, in order.
    pub fn shape_codecs(&self) -> &[Codec] {
        &self.shapes.codecs
    }

    /// The words of all shapes.
    pub fn shape_words(&self) -> &[u32] {
        &self.shape_words
    }

    /// Whether a brick of this codec begins at this offset, its page being present or not.
    pub fn is_brick(&self, codec: Codec, offset: u32) -> bool {
        self.bricks.at(offset) == Some(codec)
    }

    /// Decodes a brick.
    ///
    /// # Errors
    /// If its page is absent, or its words are not all there or hold what none can.
    pub fn decode(
        &self,
        codec: Codec,
        offset: u32,
        unit: f32,
        floor: f32,
        out: &mut [f32; BRICK_VOXELS],
    ) -> Result<(), DecodeError> {
        let page = &self.pages[self.page_of(offset).ok_or(DecodeError::OutOfStore)?];
        let words = page.words().ok_or(DecodeError::NotLoaded)?;
        let context = BrickContext { words, shapes: &self.shape_words, unit, floor };
        context.decode(codec, offset - page.first_word, out)
    }

    /// The memory of the bricks that are present, and of what is known of all.
    pub fn brick_bytes(&self) -> usize {
        size_of::<u32>() * self.present_words
            + size_of_val(self.pages.as_slice())
            + self.bricks.memory_bytes()
    }

    /// The memory of the shapes.
    pub fn shape_bytes(&self) -> usize {
        size_of_val(self.shape_words.as_slice()) + self.shapes.memory_bytes()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn bricks_are_found_where_they_begin(tags in proptest::collection::vec(prop::sample::select(vec![1_u8, 5, 9, 10, 16, 20]), 0..400)) {
            let codecs: Vec<Codec> = tags.iter().filter_map(|tag| Codec::from_tag(*tag)).collect();
            let mut store = BrickStore::default();
            let offsets: Vec<u32> =
                codecs.iter().map(|codec| store.push(*codec, &vec![0; codec.word_count()]).unwrap()).collect();
            let mut out = [0.0; BRICK_VOXELS];
            for (i, (codec, offset)) in codecs.iter().zip(&offsets).enumerate() {
                prop_assert_eq!(store.offset(i), *offset);
                prop_assert!(store.is_brick(*codec, *offset));
                prop_assert!(!store.is_brick(*codec, *offset + 1));
                let other = Codec::Uniform { bits: 7 };
                prop_assert!(!store.is_brick(other, *offset));
                prop_assert_eq!(store.decode(*codec, *offset, 1.0, 0.0, &mut out), Ok(()));
                let page = store.page_of(*offset).unwrap();
                prop_assert!(store.pages()[page].bricks().contains(&i));
                prop_assert_eq!(store.pages_of(i..i + 1), page..page + 1);
            }
            let end = store.offset(codecs.len());
            prop_assert_eq!(store.page_of(end), None);
            prop_assert_eq!(store.decode(Codec::F32, end, 1.0, 0.0, &mut out), Err(DecodeError::OutOfStore));
            let counts: Vec<u32> = store.pages().iter().map(|page| page.brick_count).collect();
            let mut absent = BrickStore::without_pages(&codecs, &counts, &[], Vec::new()).unwrap();
            for (i, page) in store.pages().iter().enumerate() {
                let decoded = absent.decode(codecs[page.first_brick as usize], page.first_word, 1.0, 0.0, &mut out);
                prop_assert_eq!(decoded, Err(DecodeError::NotLoaded));
                absent.set_page(i, page.words().unwrap().to_vec()).unwrap();
            }
            prop_assert_eq!(absent, store);
        }
    }

    #[test]
    fn what_cannot_be_is_refused() {
        let mut store = BrickStore::default();
        assert_eq!(store.push(Codec::Constant, &[]), Err(StoreError::NotABrick));
        assert_eq!(store.push(Codec::F16, &[0; 255]), Err(StoreError::NotABrick));
        assert_eq!(store.push_shape(Codec::Shared, &[0; 3]), Err(StoreError::NotABrick));
        assert_eq!(store.push(Codec::Shared, &[0, 0, 16]), Err(StoreError::NoShape));
        let shape = Codec::Gradient { bits: 0 };
        assert_eq!((store.push_shape(shape, &[0; 3]), store.push_shape(shape, &[0; 3])), (Ok(0), Ok(3)));
        for words in [[0, 1, 16], [0, 0, 17], [0, 6, 16]] {
            assert_eq!(store.push(Codec::Shared, &words), Err(StoreError::NoShape));
        }
        assert_eq!(store.push(Codec::Shared, &[0, 3, 16]), Ok(0));
        assert_eq!(store.set_page(0, vec![0, 3, 17]), Err(StoreError::NoShape));
        assert_eq!(store.set_page(0, vec![0; 4]), Err(StoreError::NotABrick));
        assert_eq!(store.set_page(1, vec![0; 3]), Err(StoreError::Pages));
        let codecs = [Codec::F16; 3];
        for (pages, error) in
            [(vec![2], StoreError::Pages), (vec![4], StoreError::Pages), (vec![3, 0], StoreError::Pages)]
        {
            assert_eq!(BrickStore::without_pages(&codecs, &pages, &[], Vec::new()), Err(error));
        }
        assert!(BrickStore::without_pages(&codecs, &[3], &[Codec::F16], vec![0; 255]).is_err());
    }
}
