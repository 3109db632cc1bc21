//! Putting encoded frames one after the other into a file.
//!
//! Equal bricks stand in the file once, whatever frame and channel they come from, and so do equal nodes and masks. Only
//! a digest of each brick is kept; the words go to the writer at once. Frames of another file may come first, as they are.

use std::collections::HashMap;
use std::io::{Seek, Write};
use std::ops::Range;
use std::sync::Arc;

use glam::IVec3;
use nuage_volume::brick::BrickSummary;
use nuage_volume::build::{BuildError, TreeBuilder};
use nuage_volume::codec::{BrickContext, Codec};
use nuage_volume::format::{
    Asset, ChannelInfo, Contents, Encoding, FormatError, Frame, FrameGrid, Quality, Summary, Writer,
};
use nuage_volume::packed::TreeRef;
use nuage_volume::packed::build::{EntryScale, Packer, TooLarge};
use nuage_volume::space::BRICK_VOXELS;

use super::append::asked;
use super::frame::{ENTRY_WORDS, EncodedFrame, EncodedGrid, EncodedLevel};
use super::options::Options;
use super::plan::{ChannelPlan, Plan};
use crate::each;
use crate::encode::shapes::{SHAPE_CODEC, Shapes};

/// Why a file cannot be put together.
#[derive(Debug, thiserror::Error)]
pub enum AssembleError {
    /// It cannot be written.
    #[error(transparent)]
    Write(#[from] FormatError),
    /// A tree is too large, or its regions overlap.
    #[error(transparent)]
    Build(#[from] BuildError),
    /// All trees together are too large.
    #[error(transparent)]
    TooLarge(#[from] TooLarge),
}

/// What went into a file.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    /// What is in the file.
    pub contents: Contents,
    /// The bytes of its parts on disk.
    pub summary: Summary,
    /// The bytes of the trees in memory.
    pub tree_bytes: u64,
    /// The bytes of all bricks in memory.
    pub brick_bytes: u64,
    /// The bytes of all shapes in memory.
    pub shape_bytes: u64,
    /// The entries of all nodes.
    pub entries: u64,
    /// The bricks of the sources that are not constant, over all frames and channels.
    pub source_bricks: u64,
    /// The bricks that are stored, of all levels.
    pub bricks_stored: u64,
    /// What each channel takes in the frames that were added.
    pub channels: Vec<ChannelSize>,
}

/// What a channel takes over all frames, at its finest level and before equal bricks become one.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ChannelSize {
    /// The bricks of the source that are not constant.
    pub bricks: u64,
    /// The words of all bricks.
    pub words: u64,
}

impl ChannelSize {
    /// The bits per voxel of bricks that are not constant, entries included; 0 if there are none.
    pub fn bits_per_voxel(&self) -> f64 {
        match self.bricks {
            0 => 0.0,
            bricks => (self.words as f64 / bricks as f64 + ENTRY_WORDS) / 16.0,
        }
    }
}

/// A channel of a file before its first frame.
fn channel_info(planned: &ChannelPlan, options: &Options) -> ChannelInfo {
    let scale = planned.scale(0.0);
    let asked = options.for_channel(&planned.key.grid);
    ChannelInfo {
        name: planned.key.grid.clone(),
        component: planned.key.component,
        role: planned.role,
        physical_unit: asked.physical_unit.unwrap_or_default(),
        unit: scale.unit,
        floor: scale.floor,
        peak: planned.peak(),
        quality: Quality::default(),
        asked_max_error: asked.max_error.map(|bound| bound.of(planned.peak())),
        asked_psnr: asked.psnr,
        encoding: Some(Encoding {
            lambda: planned.lambda.weight(),
            range: [planned.min, planned.max],
            source_bricks: 0,
        }),
    }
}

/// What a brick is found again by.
fn digest(codec: Codec, words: &[u32]) -> u128 {
    let mut digest = xxhash_rust::xxh3::Xxh3::new();
    digest.update(&[codec.tag()]);
    digest.update(bytemuck::cast_slice(words));
    digest.digest128()
}

/// A digest as it stands in a file.
pub fn hex(digest: u128) -> String {
    format!("{digest:032x}")
}

/// Writes frames to a file.
pub struct Assembler<'c, W: Write + Seek> {
    writer: Writer<'c, W>,
    packer: Packer,
    contents: Contents,
    /// Where each brick stands, by a digest of its codec and words.
    bricks: HashMap<u128, u32>,
    /// The shapes that bricks have shared so far: where each stands, by channel and index.
    shapes: HashMap<(usize, u32), u32>,
    /// The shapes of each channel.
    channel_shapes: Vec<Arc<Shapes>>,
    stored_words: u64,
    /// The bricks and words that frames took which were added, by channel of the file.
    sizes: Vec<ChannelSize>,
    /// Which channel of the file each one of the plan is.
    channels: Vec<usize>,
    /// Whether there are frames of another file, among which new ones have their place by number.
    is_continued: bool,
}

impl<'c, W: Write + Seek> Assembler<'c, W> {
    /// Begins a file. `compress` makes a zstd frame of some bytes.
    ///
    /// # Errors
    /// If nothing can be written.
    pub fn new(
        out: W,
        compress: &'c (dyn Fn(&[u8]) -> Vec<u8> + Sync),
        plan: &Plan,
        options: &Options,
        frame_rate: Option<f64>,
    ) -> Result<Self, AssembleError> {
        let channels = plan.channels.iter().map(|planned| channel_info(planned, options));
        let contents = Contents {
            frame_rate,
            channels: channels.collect(),
            asked: Some(asked(options)),
            ..Contents::default()
        };
        Ok(Assembler {
            sizes: vec![ChannelSize::default(); contents.channels.len()],
            writer: Writer::new(out, compress)?,
            packer: Packer::default(),
            channels: (0..contents.channels.len()).collect(),
            contents,
            bricks: HashMap::new(),
            shapes: HashMap::new(),
            channel_shapes: plan.channels.iter().map(|channel| Arc::clone(&channel.shapes)).collect(),
            stored_words: 0,
            is_continued: false,
        })
    }

    /// Begins a file with all that is in another: its bricks, nodes and masks as they are. The plan has been
    /// settled ([`settle`](super::append::settle)).
    ///
    /// # Errors
    /// If nothing can be written, or the other file is damaged.
    pub fn onto(
        out: W,
        compress: &'c (dyn Fn(&[u8]) -> Vec<u8> + Sync),
        base: &Asset,
        plan: &Plan,
        options: &Options,
    ) -> Result<Self, AssembleError> {
        let mut assembler = Assembler::new(out, compress, &Plan::default(), options, None)?;
        assembler.is_continued = true;
        // One file made of all frames at once would be another.
        assembler.contents = Contents { recipe: None, ..base.contents().clone() };
        assembler.packer = Packer::onto(base.trees().clone());
        let store = base.store();
        let mut rest = store.shape_words();
        for codec in store.shape_codecs() {
            assembler.writer.shape(*codec, rest.split_off(..codec.word_count()).unwrap_or_default())?;
        }
        for (i, page) in store.pages().iter().enumerate() {
            let (words, mut offset) = assembler.writer.copy_page(base, i)?;
            let mut rest = &words[..];
            for codec in &store.codecs()[page.bricks()] {
                let words = rest.split_off(..codec.word_count()).unwrap_or_default();
                assembler.bricks.entry(digest(*codec, words)).or_insert(offset);
                offset += words.len() as u32;
            }
            assembler.stored_words += words.len() as u64;
        }
        assembler.channel_shapes = plan.channels.iter().map(|channel| Arc::clone(&channel.shapes)).collect();
        let channels = &mut assembler.contents.channels;
        for planned in &plan.channels {
            let index = planned.before.map_or(channels.len(), |before| before.channel);
            match (channels.get_mut(index), planned.before) {
                (Some(channel), Some(before)) => channel.peak = before.peak,
                _ => channels.push(channel_info(planned, options)),
            }
            assembler.channels.push(index);
        }
        assembler.sizes = vec![ChannelSize::default(); channels.len()];
        Ok(assembler)
    }

    /// Notes in the file what it is made by.
    pub fn note_recipe(&mut self, recipe: u128) {
        self.contents.recipe = Some(hex(recipe)).filter(|_| !self.is_continued);
    }

    /// Adds a frame behind those that are there, or among those of another file where its number belongs. `source` is a
    /// digest of what it was made of.
    ///
    /// # Errors
    /// If it cannot be written or the file becomes too large.
    pub fn add(
        &mut self,
        frame: &EncodedFrame,
        number: Option<i64>,
        name: &str,
        source: Option<u128>,
    ) -> Result<(), AssembleError> {
        let mut grids = Vec::with_capacity(frame.grids.len());
        for grid in &frame.grids {
            let levels = grid.levels.iter().map(|level| self.add_level(level, grid));
            let levels = levels.collect::<Result<_, _>>()?;
            let index = self.channels[grid.channel];
            let channel = &mut self.contents.channels[index];
            if let Some(encoding) = &mut channel.encoding {
                encoding.source_bricks = encoding.source_bricks.saturating_add(grid.source_bricks);
            }
            let size = &mut self.sizes[index];
            size.bricks += grid.source_bricks;
            size.words += grid.levels.first().map_or(0, |level| level.words.len() as u64);
            let quality = &mut channel.quality;
            quality.max_error = quality.max_error.max(grid.quality.max_error);
            quality.squared_error += grid.quality.squared_error;
            quality.voxels = quality.voxels.saturating_add(grid.quality.voxels);
            grids.push(FrameGrid {
                channel: index as u32,
                levels,
                index_offset: grid.index_offset,
                active_box: grid.active_box,
                world_from_index: grid.world_from_index,
                source_header: grid.source_header.clone(),
            });
        }
        let frames = &mut self.contents.frames;
        let is_before = |frame: &Frame| frame.number.is_none_or(|other| number.is_none_or(|it| other < it));
        let place = match self.is_continued {
            true => frames.iter().rposition(is_before).map_or(0, |last| last + 1),
            false => frames.len(),
        };
        frames.insert(place, Frame { number, name: name.to_owned(), grids, source: source.map(hex) });
        Ok(())
    }

    fn add_level(&mut self, level: &EncodedLevel, grid: &EncodedGrid) -> Result<TreeRef, AssembleError> {
        let scale = &grid.scale;
        let background = scale.background;
        let mut words = level.words.clone();
        let begins = [0].into_iter().chain(level.bricks.iter().map(|(_, _, end)| *end));
        let ranges = level.bricks.iter().zip(begins).map(|((_, _, end), begin)| begin..*end);
        let ranges: Vec<Range<usize>> = ranges.collect();
        for ((_, codec, _), range) in level.bricks.iter().zip(&ranges) {
            if *codec == Codec::Shared {
                self.place_shape(grid.channel, &mut words[range.clone()])?;
            }
        }
        let bricks: Vec<(IVec3, Codec, &[u32])> = (level.bricks.iter().zip(ranges))
            .map(|((place, codec, _), range)| (*place, *codec, &words[range]))
            .collect();
        let shapes = self.writer.shape_words();
        // Trees know of no background but zero: they are built of what values differ from it.
        let summaries = each(bricks.len(), |i| {
            let (_, codec, words) = bricks[i];
            let mut values = [background; BRICK_VOXELS];
            let context = BrickContext { words, shapes, unit: scale.unit, floor: scale.floor };
            let decoded = context.decode(codec, 0, &mut values);
            debug_assert!(decoded.is_ok(), "what was encoded decodes");
            values.iter_mut().for_each(|value| *value -= background);
            BrickSummary::of(&values)
        });
        let mut builder = TreeBuilder::new();
        let mut places = Vec::with_capacity(bricks.len());
        for ((place, codec, words), summary) in bricks.iter().zip(summaries) {
            builder.brick(*place, summary)?;
            let digest = digest(*codec, words);
            let offset = match self.bricks.get(&digest) {
                Some(offset) => *offset,
                None => {
                    let offset = self.writer.brick(*codec, words)?;
                    self.bricks.insert(digest, offset);
                    self.stored_words += words.len() as u64;
                    offset
                }
            };
            places.push((*codec, offset));
        }
        let mut exact: HashMap<u32, f32> = HashMap::new();
        for (place, size, value) in &level.tiles {
            let mut relative = value - background;
            // Beside a large background, small values differ by less than the difference can say.
            while *exact.entry(relative.to_bits()).or_insert(*value) != *value {
                relative = relative.next_up();
            }
            builder.tile(*place, *size, relative)?;
        }
        let tree = builder.topology()?;
        let constant = |value: f32| exact.get(&value.to_bits()).copied().unwrap_or(value + background);
        let scale = EntryScale { unit: scale.unit, background };
        Ok(self.packer.add(&tree, &places, scale, constant)?)
    }

    /// Puts the offset of a shape where a brick has its index. A shape stands in the file from when it is first used.
    fn place_shape(&mut self, channel: usize, brick: &mut [u32]) -> Result<(), AssembleError> {
        let index = brick[1];
        let offset = match self.shapes.get(&(channel, index)) {
            Some(offset) => *offset,
            None => {
                let words = &self.channel_shapes[channel].words[index as usize];
                let offset = self.writer.shape(SHAPE_CODEC, words)?;
                self.shapes.insert((channel, index), offset);
                offset
            }
        };
        brick[1] = offset;
        Ok(())
    }

    /// Ends the file.
    ///
    /// # Errors
    /// If the rest cannot be written.
    pub fn finish(self) -> Result<Report, AssembleError> {
        let trees = self.packer.finish();
        let shape_bytes = 4 * self.writer.shape_words().len() as u64;
        let summary = self.writer.finish(&self.contents, &trees)?;
        Ok(Report {
            summary,
            tree_bytes: trees.size_bytes() as u64,
            brick_bytes: 4 * self.stored_words,
            shape_bytes,
            entries: trees.entries.len() as u64,
            source_bricks: self
                .contents
                .channels
                .iter()
                .filter_map(|channel| Some(channel.encoding?.source_bricks))
                .fold(0, u64::saturating_add),
            bricks_stored: self.bricks.len() as u64,
            channels: self.sizes,
            contents: self.contents,
        })
    }
}
