//! From a packed volume to a texture of its bricks and a list of them for each frame.
//!
//! Bricks that are stored in just the codec that the texture takes are copied; others are decoded and encoded again. A
//! brick stands in the texture once, however many frames have it. Of levels of detail only the finest is taken.

use std::collections::HashMap;

use glam::IVec3;
use nuage_volume::codec::{Codec, DecodeError, Line};
use nuage_volume::format::{Asset, ChannelInfo, Contents, FrameGrid, Role};
use nuage_volume::packed::{Content, Entry, Node, TreeRef, mask};
use nuage_volume::space::{
    BRICK_VOXELS, LOG2_NODE5_BRICKS, NODE4_SLOTS, NODE5_SLOTS, node4_slot_brick, node5_slot_brick,
};
use serde::Serialize;

use super::layout::{Layout, TextureFormat};
use crate::each;
use crate::encode::block::{self, Quality};
use crate::encode::quantize::{self, Brick, ChannelScale};
use crate::encode::shapes::Shapes;
use crate::pack::plan::BACKGROUND_TOLERANCE;

/// What is asked of a texture.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// The kind of texel.
    pub format: TextureFormat,
    /// The channel, as an index of the volume's.
    pub channel: usize,
    /// The frames, as indices of the volume's. Their bricks have been loaded.
    pub frames: Vec<usize>,
    /// Whether all bricks have one scale and bias, as engines need that know of none per brick.
    pub common_scale: bool,
    /// The most memory for texture and lists, in bytes.
    pub max_bytes: u64,
}

/// Why there is no texture.
#[derive(Debug, thiserror::Error)]
pub enum TextureError {
    /// No channel has the name, or the one that is meant is not clear.
    #[error("{0}")]
    Channel(String),
    /// There is no such frame.
    #[error("there is no frame {0}")]
    NoFrame(usize),
    /// A brick is damaged.
    #[error(transparent)]
    Brick(#[from] DecodeError),
    /// A brick has values that do not go together with the channel's unit, or with a texture's texels.
    #[error("a brick with values too large for a texture")]
    Range,
    /// There are more bricks than a 3D texture holds.
    #[error(
        "{bricks} bricks do not fit into one 3D texture; take fewer frames, or a format with four channels such as bc7"
    )]
    TooMany {
        /// How many.
        bricks: u64,
    },
    /// More memory is needed than is allowed.
    #[error("the texture and its lists take more than the {max_bytes} bytes allowed; take fewer frames")]
    TooLarge {
        /// The limit.
        max_bytes: u64,
    },
}

/// What texels of 0 to 1, or half floats, stand for: the value is `bias + scale × texel`, raised to the channel's floor.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(into = "[f32; 2]")]
pub struct BrickScale {
    /// What a texel of 1 is more than one of 0.
    pub scale: f32,
    /// The value of 0.
    pub bias: f32,
}

impl From<BrickScale> for [f32; 2] {
    fn from(BrickScale { scale, bias }: BrickScale) -> [f32; 2] {
        [scale, bias]
    }
}

impl BrickScale {
    fn checked(scale: f32, bias: f32) -> Result<BrickScale, TextureError> {
        match scale.is_finite() && bias.is_finite() {
            true => Ok(BrickScale { scale, bias }),
            false => Err(TextureError::Range),
        }
    }
}

/// A brick of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(into = "(i32, i32, i32, u32)")]
pub struct PlacedBrick {
    /// Its first stored index over 8.
    pub brick: [i32; 3],
    /// Its number in the texture.
    pub number: u32,
}

impl From<PlacedBrick> for (i32, i32, i32, u32) {
    fn from(PlacedBrick { brick: [x, y, z], number }: PlacedBrick) -> Self {
        (x, y, z, number)
    }
}

/// A region of a frame that has one value other than the background.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(into = "(i32, i32, i32, u32, f32)")]
pub struct PlacedConstant {
    /// Its first stored index over 8.
    pub brick: [i32; 3],
    /// The bricks that it spans along each axis: 1, 16 or 512.
    pub extent: u32,
    /// The value.
    pub value: f32,
}

impl From<PlacedConstant> for (i32, i32, i32, u32, f32) {
    fn from(PlacedConstant { brick: [x, y, z], extent, value }: PlacedConstant) -> Self {
        (x, y, z, extent, value)
    }
}

/// What a frame has of the channel. A frame without it has nothing, over a background of 0.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct FrameTable {
    /// The frame's number in its source, if it had one.
    pub number: Option<i64>,
    /// The name of its source.
    pub name: String,
    /// The value of all that has neither brick nor constant.
    pub background: f32,
    /// What is added to a stored index for the source's.
    pub index_offset: [i32; 3],
    /// The first and the last active voxel in the source's indices.
    pub active_box: Option<[[i32; 3]; 2]>,
    /// From the source's indices to the world: the columns for x, y, z, then the translation.
    pub world_from_index: Option<[f64; 12]>,
    /// Its bricks, in the order of the tree.
    pub bricks: Vec<PlacedBrick>,
    /// Its regions of one value; no brick lies in them.
    pub constants: Vec<PlacedConstant>,
}

/// A texture and what goes with it.
#[derive(Debug, Clone, PartialEq)]
pub struct BrickTexture {
    /// Where bricks stand; has the format and the size.
    pub layout: Layout,
    /// The texels.
    pub bytes: Vec<u8>,
    /// What the texels of each brick stand for.
    pub bricks: Vec<BrickScale>,
    /// The scale of all bricks, if there is one.
    pub common_scale: Option<BrickScale>,
    /// The frames, in the order in which they were asked for.
    pub frames: Vec<FrameTable>,
    /// The channel.
    pub channel: ChannelInfo,
    /// Frames per second, if known.
    pub frame_rate: Option<f64>,
}

/// The name of a channel as a user writes it: that of the grid, and behind a point the component of a vector.
pub fn channel_name(channel: &ChannelInfo) -> String {
    let component = channel.component.and_then(|component| ["x", "y", "z"].get(usize::from(component)));
    component.map_or(channel.name.clone(), |component| format!("{}.{component}", channel.name))
}

/// The channel of a name; without one the only channel, or the first that is a density.
///
/// # Errors
/// If there is none, in words that name those that there are.
pub fn find_channel(contents: &Contents, name: Option<&str>) -> Result<usize, TextureError> {
    let channels = &contents.channels;
    let found = match name {
        Some(name) => channels.iter().position(|channel| channel_name(channel) == name),
        None if channels.len() == 1 => Some(0),
        None => channels.iter().position(|channel| channel.role == Role::Density),
    };
    found.ok_or_else(|| {
        let names: Vec<String> = channels.iter().map(channel_name).collect();
        TextureError::Channel(match (name, names.as_slice()) {
            (_, []) => "there is no channel".to_owned(),
            (Some(name), names) => format!("there is no channel '{name}'; there are {}", names.join(", ")),
            (None, names) => format!("name one of the channels {}", names.join(", ")),
        })
    })
}

/// So many bricks are encoded at once, so that little memory is taken beyond the texture.
const BATCH: usize = 4096;

/// A brick of the store.
type Source = (Codec, u32);

/// Makes a texture of the bricks of some frames.
///
/// # Errors
/// If there is no such channel or frame, bricks are not loaded or damaged, or there are too many.
pub fn build(asset: &Asset, options: &Options) -> Result<BrickTexture, TextureError> {
    let contents = asset.contents();
    let channel = contents.channels.get(options.channel);
    let channel =
        channel.ok_or_else(|| TextureError::Channel(format!("there is no channel {}", options.channel)))?;
    let too_large = || TextureError::TooLarge { max_bytes: options.max_bytes };
    let mut lists = Lists {
        asset,
        numbers: HashMap::new(),
        sources: Vec::new(),
        bytes_left: options.max_bytes,
        brick_bytes: u64::from(options.format.brick_bytes()),
    };
    let frames = options.frames.iter().map(|frame| {
        let found = contents.frames.get(*frame).ok_or(TextureError::NoFrame(*frame))?;
        let mut table =
            FrameTable { number: found.number, name: found.name.clone(), ..FrameTable::default() };
        let grid = found.grids.iter().find(|grid| grid.channel as usize == options.channel);
        grid.map_or(Some(()), |grid| lists.frame(grid, &mut table)).ok_or_else(too_large)?;
        Ok(table)
    });
    let frames = frames.collect::<Result<Vec<_>, TextureError>>()?;
    let sources = std::mem::take(&mut lists.sources);
    let too_many = || TextureError::TooMany { bricks: sources.len() as u64 };
    let count = u32::try_from(sources.len()).map_err(|_| too_many())?;
    let layout = Layout::for_bricks(options.format, count).ok_or_else(too_many)?;
    // Bricks that the texture has beyond those that are there.
    let unused_bytes = layout.size_bytes() - u64::from(count) * u64::from(options.format.brick_bytes());
    lists.take(unused_bytes).ok_or_else(too_large)?;
    let size = usize::try_from(layout.size_bytes()).map_err(|_| too_large())?;
    let common_scale = match options.format {
        _ if !options.common_scale => None,
        TextureFormat::R16F => Some(BrickScale { scale: channel.unit, bias: 0.0 }),
        _ => Some(common_scale(asset, options.channel, &sources)?),
    };
    let encoder = Encoder { asset, channel, index: options.channel, format: options.format, common_scale };
    let mut texture = BrickTexture {
        layout,
        bytes: vec![0; size],
        bricks: Vec::with_capacity(sources.len()),
        common_scale,
        frames,
        channel: channel.clone(),
        frame_rate: contents.frame_rate,
    };
    for batch in sources.chunks(BATCH) {
        for encoded in each(batch.len(), |i| encoder.encode(batch[i])) {
            let (scale, bytes) = encoded?;
            texture.put(&bytes);
            texture.bricks.push(scale);
        }
    }
    Ok(texture)
}

impl BrickTexture {
    /// Writes the bytes of the next brick to where it stands.
    fn put(&mut self, bytes: &[u8]) {
        let (layout, format) = (self.layout, self.layout.format());
        let [x, y, z] = layout.origin(self.bricks.len() as u32);
        let block = format.block_texels();
        let (rows, row_bytes) = (8 / block, 8 / block * format.block_bytes());
        for (i, row) in bytes.chunks_exact(row_bytes as usize).enumerate() {
            let (slice, row_of_slice) = (i as u32 / rows, i as u32 % rows);
            let at = layout.byte_offset([x, y + row_of_slice * block, z + slice]) as usize;
            if let Some(to) = self.bytes.get_mut(at..at + row.len()) {
                to.copy_from_slice(row);
            }
        }
    }
}

/// The least scale and bias for all values; a bias of 0 where none is negative.
fn common_scale(asset: &Asset, channel: usize, sources: &[Source]) -> Result<BrickScale, TextureError> {
    let (mut low, mut high) = (0.0_f32, 0.0_f32);
    for batch in sources.chunks(BATCH) {
        let bounds = each(batch.len(), |i| -> Result<_, DecodeError> {
            let (codec, offset) = batch[i];
            let mut values = [0.0; BRICK_VOXELS];
            asset.decode(channel, codec, offset, &mut values)?;
            Ok(values.iter().fold((0.0_f32, 0.0_f32), |(low, high), v| (low.min(*v), high.max(*v))))
        });
        for bounds in bounds {
            let (brick_low, brick_high) = bounds?;
            (low, high) = (low.min(brick_low), high.max(brick_high));
        }
    }
    BrickScale::checked(high - low, low)
}

struct Encoder<'a> {
    asset: &'a Asset,
    channel: &'a ChannelInfo,
    index: usize,
    format: TextureFormat,
    common_scale: Option<BrickScale>,
}

impl Encoder<'_> {
    /// The scale of a brick, and its bytes in the order of the texture: by slice, then row.
    fn encode(&self, (codec, offset): Source) -> Result<(BrickScale, Vec<u8>), TextureError> {
        let wanted = self.format.codec();
        let decode = || -> Result<Brick, DecodeError> {
            let mut values = [0.0; BRICK_VOXELS];
            self.asset.decode(self.index, codec, offset, &mut values)?;
            Ok(values)
        };
        match self.common_scale {
            Some(scale) if self.format != TextureFormat::R16F => {
                Ok((scale, self.normalised(&decode()?, scale)))
            }
            _ if codec == wanted => self.of_words(self.stored(codec, offset)?),
            _ => {
                let scale = ChannelScale {
                    unit: self.channel.unit,
                    floor: self.channel.floor,
                    background: self.channel.floor,
                    background_tolerance: BACKGROUND_TOLERANCE * self.channel.peak,
                    keeps_sign: false,
                    max_error: f32::INFINITY,
                };
                let mut words = Vec::with_capacity(wanted.word_count());
                quantize::write(&decode()?, wanted, &scale, &Shapes::default(), &mut words);
                self.of_words(&words)
            }
        }
    }

    /// The words of a brick in the store.
    fn stored(&self, codec: Codec, offset: u32) -> Result<&[u32], DecodeError> {
        let store = self.asset.store();
        let page =
            store.page_of(offset).and_then(|page| store.pages().get(page)).ok_or(DecodeError::OutOfStore)?;
        let words = page.words().ok_or(DecodeError::NotLoaded)?;
        let words = words.get((offset - page.first_word) as usize..);
        words.and_then(|words| words.get(..codec.word_count())).ok_or(DecodeError::OutOfStore)
    }

    /// Scale and bytes of a brick in the codec of the format.
    fn of_words(&self, words: &[u32]) -> Result<(BrickScale, Vec<u8>), TextureError> {
        let unit = self.channel.unit;
        if self.format == TextureFormat::R16F {
            // Two halves a word: each is looked at for being finite.
            words
                .iter()
                .try_for_each(|word| Line::from_word(*word, unit).map(drop))
                .map_err(|_| TextureError::Range)?;
            let halves: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
            return Ok((BrickScale { scale: unit, bias: 0.0 }, slices(&halves, 2)));
        }
        let Some((line, words)) = words.split_first() else { return Err(TextureError::Range) };
        let line = Line::from_word(*line, unit).map_err(|_| TextureError::Range)?;
        let bytes: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
        match self.format {
            // Codes count in 255ths of what a texel gives.
            TextureFormat::R8 => Ok((BrickScale::checked(line.step * 255.0, line.low)?, slices(&bytes, 1))),
            _ => Ok((BrickScale::checked(line.step, line.low)?, bytes)),
        }
    }

    /// The bytes of values between 0 and 1 after a scale is taken off.
    fn normalised(&self, values: &Brick, BrickScale { scale, bias }: BrickScale) -> Vec<u8> {
        let inverse = if scale > 0.0 { 1.0 / scale } else { 0.0 };
        let values = values.map(|value| (value - bias) * inverse);
        match self.format.codec() {
            Codec::Block { format, axis } => block::encode_brick(format, axis, &values, Quality::Fast),
            // A cast saturates.
            _ => slices(&values.map(|value| (value * 255.0 + 0.5) as u8), 1),
        }
    }
}

/// Voxels of some bytes each, with z running first, in an order with x running first.
fn slices(voxels: &[u8], voxel_bytes: usize) -> Vec<u8> {
    let order = (0..BRICK_VOXELS).map(|i| (i & 7) << 6 | (i >> 3 & 7) << 3 | i >> 6);
    let voxel = |at: usize| voxels.get(at * voxel_bytes..(at + 1) * voxel_bytes).unwrap_or_default();
    order.flat_map(voxel).copied().collect()
}

/// Goes through trees and gives each brick a number.
struct Lists<'a> {
    asset: &'a Asset,
    /// The number of the brick at each offset of the store.
    numbers: HashMap<u32, u32>,
    sources: Vec<Source>,
    bytes_left: u64,
    brick_bytes: u64,
}

impl Lists<'_> {
    /// Lists what a grid has. `None` if that takes too much memory: nodes that are used many times make small files of
    /// many regions.
    fn frame(&mut self, grid: &FrameGrid, table: &mut FrameTable) -> Option<()> {
        table.index_offset = grid.index_offset;
        table.active_box = grid.active_box;
        table.world_from_index = grid.world_from_index;
        let none = TreeRef { first_cell: 0, cell_count: 0, background: 0.0 };
        let tree = grid.levels.first().copied().unwrap_or(none);
        table.background = tree.background;
        let trees = self.asset.trees();
        for cell in trees.cells_of(tree) {
            let first = IVec3::from_array(cell.cell) << LOG2_NODE5_BRICKS;
            let Some(node) = self.region(cell.entry, first, 512, table)? else { continue };
            for (slot, entry) in self.entries(&trees.node5s, node, NODE5_SLOTS) {
                let first = node5_slot_brick(first, slot);
                let Some(node) = self.region(entry, first, 16, table)? else { continue };
                for (slot, entry) in self.entries(&trees.node4s, node, NODE4_SLOTS) {
                    self.region(entry, node4_slot_brick(first, slot), 1, table)?;
                }
            }
        }
        Some(())
    }

    /// The slots of a node that have entries.
    fn entries(&self, nodes: &[Node], node: u32, slots: usize) -> Vec<(usize, Entry)> {
        let trees = self.asset.trees();
        let Some(node) = nodes.get(node as usize) else { return Vec::new() };
        let entries = trees.entries.get(node.first_entry as usize..).unwrap_or_default();
        mask::slots(trees, node.mask, slots).zip(entries.iter().copied()).collect()
    }

    /// Lists a brick or a constant. Gives the index of a node. The outer `None` is that of too little memory.
    fn region(
        &mut self,
        entry: Entry,
        first: IVec3,
        extent: u32,
        table: &mut FrameTable,
    ) -> Option<Option<u32>> {
        let brick = first.to_array();
        match entry.content() {
            Some(Content::Node(node)) => return Some(Some(node)),
            Some(Content::Constant(value)) if value != table.background => {
                self.take(size_of::<PlacedConstant>() as u64)?;
                table.constants.push(PlacedConstant { brick, extent, value });
            }
            Some(Content::Brick { codec, offset }) => {
                self.take(size_of::<PlacedBrick>() as u64)?;
                let next = self.sources.len() as u32;
                let number = *self.numbers.entry(offset).or_insert(next);
                if number == next {
                    // The brick, its scale, its place in the store and its number.
                    self.take(self.brick_bytes + 32)?;
                    self.sources.push((codec, offset));
                }
                table.bricks.push(PlacedBrick { brick, number });
            }
            _ => {}
        }
        Some(None)
    }

    fn take(&mut self, bytes: u64) -> Option<()> {
        self.bytes_left = self.bytes_left.checked_sub(bytes)?;
        Some(())
    }
}
