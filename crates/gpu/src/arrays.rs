//! The words of a volume as shaders read them: trees, bricks and shapes of some frames, gathered from a packed volume or
//! from channels in memory.
//!
//! Bricks stay as they are stored, whatever their codec: the shader decodes them. [`Bricks::Decoded`] trades memory for
//! speed: 2 KiB for each brick, and the same values. Only what the frames asked for hold is taken; nodes and bricks that
//! frames share are taken once.
//!
//! What does not live here: buffers ([`crate::upload`]), files, and the meaning of grids as media.

use std::collections::{HashMap, HashSet};
use std::ops::Range;

use glam::{DAffine3, DVec3, IVec3};
use nuage_volume::brick;
use nuage_volume::channel::{Channel, IndexBox};
use nuage_volume::codec::Codec;
use nuage_volume::codec::block::BlockFormat;
use nuage_volume::format::Asset;
use nuage_volume::format::contents::{ChannelInfo, FrameGrid};
use nuage_volume::packed::build::{EntryScale, Packer};
use nuage_volume::packed::{Content, Entry, Node, RootCell, TreeRef, Trees, mask};
use nuage_volume::space::{BRICK_VOXELS, NODE4_SLOTS, NODE5_SLOTS};

use crate::blocks;
use crate::error::GpuError;
use crate::maps;
use crate::params::{Field, Place};
use crate::shader::{HEADER_WORDS, codec_bit};

/// In which form bricks are kept on the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Bricks {
    /// As they are stored: the least memory.
    AsStored,
    /// As they are stored, but for those of texture blocks, which stand in 3D textures that the device decodes as it reads
    /// them: as little memory, and less work. [`crate::device::Gpu::smallest_bricks`] says whether a device does.
    Textures,
    /// As floats, 2 KiB each: the least work for each sample, and the same values.
    Decoded,
}

/// What the values of a stored channel mean to the renderer, which wants values that are not negative, and 0 outside.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Meaning {
    /// Themselves; what is negative counts as 0.
    Density,
    /// Signed distances, as fog that is full at a depth of `band` world lengths.
    Fog {
        /// The depth.
        band: f32,
    },
    /// Signed distances, as what grows inwards from 0 at `band` outside to twice that: the surface is where it is `band`.
    Surface {
        /// The width of the band.
        band: f32,
    },
}

impl Meaning {
    /// Scale, bias, and the largest value.
    pub(crate) fn line(self) -> [f32; 3] {
        match self {
            Meaning::Density => [1.0, 0.0, f32::MAX],
            Meaning::Fog { band } => [-1.0 / band, 0.0, 1.0],
            Meaning::Surface { band } => [-1.0, band, 2.0 * band],
        }
    }
}

/// A channel of a packed volume that is wanted.
#[derive(Debug, Clone, PartialEq)]
pub struct Wanted {
    /// The name of its grid.
    pub name: String,
    /// What its values mean.
    pub meaning: Meaning,
}

/// The words of a volume, and where each channel is in each frame.
#[derive(Debug, Clone, Default)]
pub struct Arrays {
    trees: Trees,
    words: Vec<u32>,
    shapes: Vec<u32>,
    /// What goes to textures, by [`blocks::FORMATS`], where bricks of blocks have a number in place of them.
    blocks: [Vec<u32>; 3],
    has_textures: bool,
    /// Whether only room is asked for: then the words of bricks are zeros, and their pages need not be loaded.
    is_room: bool,
    /// Frame by frame, as many as there are channels; those that are nowhere are `None`.
    places: Vec<Option<Place>>,
    largest: Vec<f32>,
    channels: usize,
    codecs: u32,
    origin: DVec3,
    /// Whether there are flat maps of bricks: not if they would be large beside the rest.
    has_maps: bool,
    /// These, and where that of each place begins.
    maps: Vec<u32>,
    first_map_words: Vec<u32>,
}

/// How much a volume has to hold.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct Room {
    pub(crate) tree_words: usize,
    pub(crate) fields: usize,
    /// With those of shapes.
    pub(crate) brick_words: usize,
    /// Bricks in textures, by [`blocks::FORMATS`].
    pub(crate) blocks: [usize; 3],
    /// The most bytes that maps may bring all this to: [`maps::most_bytes`].
    pub(crate) most_bytes: usize,
}

impl Room {
    /// Room for either.
    pub(crate) fn max(self, other: Room) -> Room {
        Room {
            tree_words: self.tree_words.max(other.tree_words),
            fields: self.fields.max(other.fields),
            brick_words: self.brick_words.max(other.brick_words),
            blocks: std::array::from_fn(|i| self.blocks[i].max(other.blocks[i])),
            most_bytes: self.most_bytes.max(other.most_bytes),
        }
    }

    /// Whether maps of so many words are worth it beside what there is room for.
    pub(crate) fn are_maps_worth(&self, words: usize) -> bool {
        let of_blocks = blocks::FORMATS.iter().zip(self.blocks);
        let of_blocks: usize = of_blocks.map(|(format, bricks)| bricks * blocks::brick_words(*format)).sum();
        let [maps, trees, bricks] =
            [words, self.tree_words, self.brick_words + of_blocks].map(|words| 4 * words);
        maps::are_worth(maps, trees, bricks, self.most_bytes)
    }
}

/// Of which kind a node is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
enum Kind {
    Node5,
    Node4,
}

/// What is in which place already.
#[derive(Default)]
struct Gathered {
    masks: HashMap<u32, u32>,
    nodes: HashMap<(Kind, usize, u32), u32>,
    bricks: HashMap<(usize, u32), u32>,
    /// The bricks whose values were looked at, each of a channel.
    seen: HashSet<(usize, u32)>,
    /// The smallest and the largest value of each channel, as encoding made them.
    ranges: HashMap<usize, [f32; 2]>,
}

impl Gathered {
    fn see(&mut self, channel: usize, values: &[f32]) {
        let range = self.ranges.entry(channel).or_insert([f32::MAX, f32::MIN]);
        *range = values.iter().fold(*range, |[min, max], value| [min.min(*value), max.max(*value)]);
    }
}

impl Arrays {
    /// The words of channels in memory: one frame, whose channels are numbered as they are given.
    ///
    /// # Errors
    /// If they are too large to be indexed.
    pub fn of_channels(channels: &[&Channel]) -> Result<Arrays, GpuError> {
        let too_large = |_| GpuError::Misuse("a volume of more than 2³² words".to_owned());
        let mut arrays = Arrays { channels: channels.len(), ..Arrays::default() };
        let mut packer = Packer::default();
        for channel in channels {
            let bounds = channel.tree.bounds();
            let unit = power_of_two_above(bounds.max.max(-bounds.min));
            let (codec, codec_words) = match &channel.tree.bricks {
                brick::Bricks::F32(_) => (Codec::F32, BRICK_VOXELS),
                brick::Bricks::F16(_) => (Codec::F16, BRICK_VOXELS / 2),
            };
            let first = arrays.words.len();
            match &channel.tree.bricks {
                brick::Bricks::F32(values) => arrays.words.extend(values.iter().map(|value| value.to_bits())),
                brick::Bricks::F16(values) => {
                    let pairs = values.as_chunks::<2>().0.iter();
                    arrays.words.extend(pairs.map(|[low, high]| u32::from(*low) | u32::from(*high) << 16));
                }
            }
            let end = u32::try_from(arrays.words.len()).map_err(too_large)?;
            let bricks: Vec<(Codec, u32)> =
                (first as u32..end).step_by(codec_words).map(|offset| (codec, offset)).collect();
            arrays.codecs |= if bricks.is_empty() { 0 } else { codec_bit(codec) };
            let scale = EntryScale { unit, background: 0.0 };
            let tree = packer.add(&channel.tree, &bricks, scale, |value| value);
            let tree = tree.map_err(|error| GpuError::Misuse(error.to_string()))?;
            arrays.places.push(channel.active_box.map(|active_box| Place {
                world_from_index: channel.world_from_index,
                active_box,
                index_offset: IVec3::ZERO,
                cells: [tree.first_cell, tree.cell_count],
                brick_unit: 1.0,
                bounds_unit: unit,
                floor: 0.0,
                meaning: Meaning::Density.line(),
            }));
            arrays.largest.push(bounds.max);
        }
        arrays.trees = packer.finish();
        arrays.settle();
        arrays.make_maps_where_worth();
        Ok(arrays)
    }

    /// The words of some frames of a packed volume, whose pages are loaded. Channels are numbered as they are wanted; one
    /// that a frame lacks is empty there.
    ///
    /// # Errors
    /// If there are no such frames, pages are not loaded, bricks are damaged, a transform is not linear, or a background is not
    /// empty: channels of such grids can be taken by [`Arrays::of_channels`].
    pub fn of_asset(
        asset: &Asset,
        wanted: &[Wanted],
        frames: Range<usize>,
        form: Bricks,
    ) -> Result<Arrays, GpuError> {
        let mut arrays = Arrays::default().with(asset, wanted, frames, form)?;
        arrays.make_maps_where_worth();
        Ok(arrays)
    }

    /// The words of one frame that is to take others' place: without maps until [`Arrays::agree_with`] makes them.
    pub(crate) fn of_frame(
        asset: &Asset,
        wanted: &[Wanted],
        frame: usize,
        form: Bricks,
    ) -> Result<Arrays, GpuError> {
        Arrays::default().with(asset, wanted, frame..frame + 1, form)
    }

    /// As [`Arrays::of_frame`], with zeros in place of the words of bricks, whose pages need not be loaded.
    pub(crate) fn room_of(
        asset: &Asset,
        wanted: &[Wanted],
        frame: usize,
        form: Bricks,
    ) -> Result<Arrays, GpuError> {
        Arrays { is_room: true, ..Arrays::default() }.with(asset, wanted, frame..frame + 1, form)
    }

    fn with(
        self,
        asset: &Asset,
        wanted: &[Wanted],
        frames: Range<usize>,
        form: Bricks,
    ) -> Result<Arrays, GpuError> {
        let contents = asset.contents();
        let frames =
            contents.frames.get(frames.clone()).filter(|frames| !frames.is_empty()).ok_or_else(|| {
                let count = contents.frames.len();
                GpuError::Misuse(format!("frames {} to {} of {count}", frames.start, frames.end))
            })?;
        let mut arrays = Arrays { channels: wanted.len(), largest: vec![0.0; wanted.len()], ..self };
        arrays.has_textures = form == Bricks::Textures;
        if form != Bricks::Decoded {
            arrays.take_shapes(asset);
        }
        let mut gathered = Gathered::default();
        for frame in frames {
            for (wanted, largest) in wanted.iter().zip(0..) {
                let is_wanted = |grid: &&FrameGrid| {
                    contents.channels.get(grid.channel as usize).is_some_and(|info| info.name == wanted.name)
                };
                let Some(grid) = frame.grids.iter().find(is_wanted) else {
                    arrays.places.push(None);
                    continue;
                };
                let channel = grid.channel as usize;
                let info = &contents.channels[channel];
                if arrays.is_room {
                    gathered.see(channel, &[info.floor, info.peak]);
                }
                let place = arrays.gather(asset, channel, grid, form, wanted.meaning, &mut gathered)?;
                arrays.places.push(place);
                let [scale, bias, most] = wanted.meaning.line();
                let range = gathered.ranges.get(&channel).copied().unwrap_or_default();
                let ends = range.map(|value| bias + scale * value);
                arrays.largest[largest] = arrays.largest[largest].max(ends[0].max(ends[1]).clamp(0.0, most));
            }
        }
        arrays.settle();
        Ok(arrays)
    }

    /// Bricks and shapes that no tree holds, for tests of their decoders.
    #[cfg(test)]
    pub(crate) fn of_words(words: Vec<u32>, shapes: Vec<u32>, unit: f32, floor: f32) -> Arrays {
        let place = Place {
            world_from_index: DAffine3::IDENTITY,
            active_box: IndexBox { min: IVec3::ZERO, max: IVec3::ZERO },
            index_offset: IVec3::ZERO,
            cells: [0, 0],
            brick_unit: unit,
            bounds_unit: unit,
            floor,
            meaning: Meaning::Density.line(),
        };
        let (places, largest) = (vec![Some(place)], vec![unit]);
        Arrays { words, shapes, places, largest, channels: 1, codecs: u32::MAX, ..Arrays::default() }
    }

    /// Takes all shapes. Each stays where it is, so that bricks find it; what goes to textures leaves a gap.
    fn take_shapes(&mut self, asset: &Asset) {
        let store = asset.store();
        self.shapes = store.shape_words().to_vec();
        let mut at = 0;
        for codec in store.shape_codecs() {
            let end = at + codec.word_count();
            if let Some(words) = store.shape_words().get(at..end) {
                let taken = self.taken(*codec, words);
                self.shapes[at..at + taken.len()].copy_from_slice(&taken);
            }
            self.codecs |= codec_bit(*codec);
            at = end;
        }
    }

    /// The words of a brick as they stand among others: of blocks that go to a texture, the line and their number there.
    fn taken(&mut self, codec: Codec, words: &[u32]) -> Vec<u32> {
        match (codec, words) {
            (Codec::Block { format, .. }, [line, of_blocks @ ..]) if self.has_textures => {
                let blocks = &mut self.blocks[blocks::number_of(format)];
                let number = blocks.len() / blocks::brick_words(format);
                blocks.extend_from_slice(of_blocks);
                vec![*line, number as u32]
            }
            _ => words.to_vec(),
        }
    }

    /// The same, to be looked up by the tree.
    #[cfg(test)]
    pub(crate) fn without_maps(self) -> Arrays {
        Arrays { has_maps: false, maps: Vec::new(), first_map_words: Vec::new(), ..self }
    }

    /// Moves bricks and shapes at these offsets to textures, for tests of their decoders.
    #[cfg(test)]
    pub(crate) fn move_to_textures(&mut self, bricks: &[(Codec, u32)], shapes: &[(Codec, u32)]) {
        self.has_textures = true;
        let (mut words, mut shape_words) = (self.words.clone(), self.shapes.clone());
        for (all, places) in [(&mut words, bricks), (&mut shape_words, shapes)] {
            for (codec, at) in places {
                let words = &mut all[*at as usize..][..codec.word_count()];
                let taken = self.taken(*codec, words);
                words[..taken.len()].copy_from_slice(&taken);
            }
        }
        (self.words, self.shapes) = (words, shape_words);
    }

    /// Channels of one frame whose trees are built on the device, in bricks of floats.
    pub(crate) fn of_places(places: Vec<Place>) -> Arrays {
        let (largest, channels) = (vec![0.0; places.len()], places.len());
        let places = places.into_iter().map(Some).collect();
        let mut arrays =
            Arrays { places, largest, channels, codecs: codec_bit(Codec::F32), ..Arrays::default() };
        arrays.settle();
        arrays
    }

    /// Takes the finest tree of a grid.
    fn gather(
        &mut self,
        asset: &Asset,
        channel: usize,
        grid: &FrameGrid,
        form: Bricks,
        meaning: Meaning,
        gathered: &mut Gathered,
    ) -> Result<Option<Place>, GpuError> {
        let (Some([min, max]), Some(tree)) = (grid.active_box, grid.levels.first()) else { return Ok(None) };
        // Where nothing stands, shaders take it that nothing is.
        let [scale, bias, most] = meaning.line();
        if (bias + scale * tree.background).clamp(0.0, most) > 0.0 {
            return Err(GpuError::Unsupported {
                feature: "a packed grid that is not empty where it has no voxels",
            });
        }
        let columns = grid
            .world_from_index
            .ok_or(GpuError::Unsupported { feature: "a transform that is not linear" })?;
        let world_from_source = DAffine3::from_cols_array(&columns);
        let offset = IVec3::from_array(grid.index_offset);
        let first_cell = self.trees.cells.len() as u32;
        let info = &asset.contents().channels[channel];
        for cell in asset.trees().cells_of(*tree) {
            let entry = self.node(asset, channel, cell.entry, Kind::Node5, form, gathered)?;
            self.trees.cells.push(RootCell { entry, ..*cell });
        }
        // No sum of what a file says may overflow.
        let inside = |p: [i32; 3]| IVec3::from_array(p).checked_sub(offset).ok_or_else(damaged);
        let active_box = IndexBox { min: inside(min)?, max: inside(max)? };
        Ok(Some(place_of(info, tree, world_from_source, offset, active_box, first_cell, meaning)))
    }

    /// An entry of a root or of a `Node5`, which leads to a node of the given kind, with all below it.
    fn node(
        &mut self,
        asset: &Asset,
        channel: usize,
        entry: Entry,
        kind: Kind,
        form: Bricks,
        gathered: &mut Gathered,
    ) -> Result<Entry, GpuError> {
        let index = match entry.content() {
            Some(Content::Node(index)) => index,
            Some(Content::Constant(value)) => {
                gathered.see(channel, &[value]);
                return Ok(entry);
            }
            _ => return Ok(entry),
        };
        let key = (kind, channel, index);
        let payload = match gathered.nodes.get(&key) {
            Some(known) => *known,
            None => {
                let (nodes, slots) = match kind {
                    Kind::Node5 => (&asset.trees().node5s, NODE5_SLOTS),
                    Kind::Node4 => (&asset.trees().node4s, NODE4_SLOTS),
                };
                let node = nodes.get(index as usize).ok_or_else(damaged)?;
                let entries = entries_of(asset.trees(), node, slots)?.iter();
                let below: Result<Vec<Entry>, GpuError> = match kind {
                    Kind::Node5 => entries
                        .map(|entry| self.node(asset, channel, *entry, Kind::Node4, form, gathered))
                        .collect(),
                    Kind::Node4 => {
                        entries.map(|entry| self.brick(asset, channel, *entry, form, gathered)).collect()
                    }
                };
                let node = self.add_node(asset.trees(), node, slots, below?, gathered)?;
                let nodes = match kind {
                    Kind::Node5 => &mut self.trees.node5s,
                    Kind::Node4 => &mut self.trees.node4s,
                };
                nodes.push(node);
                let new = nodes.len() as u32 - 1;
                gathered.nodes.insert(key, new);
                new
            }
        };
        Ok(Entry { payload, ..entry })
    }

    /// An entry of a `Node4`, with its brick.
    fn brick(
        &mut self,
        asset: &Asset,
        channel: usize,
        entry: Entry,
        form: Bricks,
        gathered: &mut Gathered,
    ) -> Result<Entry, GpuError> {
        let (codec, offset) = match entry.content() {
            Some(Content::Brick { codec, offset }) => (codec, offset),
            Some(Content::Constant(value)) => {
                gathered.see(channel, &[value]);
                return Ok(entry);
            }
            _ => return Ok(entry),
        };
        // Decoding is also what finds a damaged brick before a shader meets it.
        let mut values = [0.0; BRICK_VOXELS];
        if !self.is_room && gathered.seen.insert((channel, offset)) {
            asset.decode(channel, codec, offset, &mut values)?;
            gathered.see(channel, &values);
        }
        // Words mean the same in all channels, values do not.
        let (key, kept) = match form {
            Bricks::AsStored | Bricks::Textures => ((0, offset), codec),
            Bricks::Decoded => ((channel, offset), Codec::F32),
        };
        let payload = match gathered.bricks.get(&key) {
            Some(known) => *known,
            None => {
                let at = u32::try_from(self.words.len() + BRICK_VOXELS).map_err(|_| too_many_words())?;
                let at = at - BRICK_VOXELS as u32;
                match form {
                    Bricks::Decoded => self.words.extend(values.iter().map(|value| value.to_bits())),
                    Bricks::AsStored | Bricks::Textures => {
                        let words = match self.is_room {
                            true => self.taken(codec, &vec![0; codec.word_count()]),
                            false => self.taken(codec, stored_words(asset, codec, offset)?),
                        };
                        self.words.extend(words);
                    }
                }
                self.codecs |= codec_bit(kept);
                gathered.bricks.insert(key, at);
                at
            }
        };
        Ok(Entry { payload, kind: entry.kind & !0xff | u32::from(kept.tag()) })
    }

    /// A node of other entries.
    fn add_node(
        &mut self,
        trees: &Trees,
        node: &Node,
        slots: usize,
        entries: Vec<Entry>,
        gathered: &mut Gathered,
    ) -> Result<Node, GpuError> {
        let mask = match gathered.masks.get(&node.mask) {
            Some(known) => *known,
            None => {
                let begin = node.mask as usize;
                let len = mask::len(&trees.masks, node.mask, slots).ok_or_else(damaged)?;
                let new = self.trees.masks.len() as u32;
                self.trees.masks.extend_from_slice(trees.masks.get(begin..begin + len).ok_or_else(damaged)?);
                gathered.masks.insert(node.mask, new);
                new
            }
        };
        let first_entry = u32::try_from(self.trees.entries.len()).map_err(|_| too_many_words())?;
        self.trees.entries.extend(entries);
        Ok(Node { mask, first_entry })
    }

    /// Puts the origin of the shaders' world into the middle of what is there.
    fn settle(&mut self) {
        let corners = self.places.iter().flatten().flat_map(Place::world_corners);
        let (sum, count) =
            corners.fold((DVec3::ZERO, 0.0), |(sum, count), corner| (sum + corner, count + 1.0));
        let middle = sum / f64::max(count, 1.0);
        self.origin = if middle.is_finite() { middle } else { DVec3::ZERO };
    }

    /// Makes maps of all places, unless they are large beside what stands there already.
    fn make_maps_where_worth(&mut self) {
        let room = self.room();
        if self.map_words().is_some_and(|words| room.are_maps_worth(words)) {
            self.make_maps();
        }
    }

    /// The words of a map of each place. `None` if they are too many to be had.
    pub(crate) fn map_words(&self) -> Option<usize> {
        let boxes = self.places.iter().flatten().map(Place::bricks);
        let cells: Option<usize> = boxes.map(|[first, last]| maps::cell_count(first, last)).sum();
        cells?.checked_mul(maps::CELL_WORDS)
    }

    /// Makes maps of all places.
    fn make_maps(&mut self) {
        // Frames of the same tree share a map.
        let mut known: HashMap<([u32; 2], [IVec3; 2]), u32> = HashMap::new();
        let mut words = Vec::new();
        let mut firsts = Vec::with_capacity(self.places.len());
        for place in &self.places {
            let Some(place) = place else {
                firsts.push(0);
                continue;
            };
            let key = (place.cells, place.bricks());
            let first = match known.get(&key) {
                Some(first) => *first,
                None => {
                    let [low, high] = place.bricks();
                    let Some(map) = maps::map(&self.trees, place.cells, low, high) else { return };
                    let first = words.len() as u32;
                    words.extend(map);
                    known.insert(key, first);
                    first
                }
            };
            firsts.push(first);
        }
        (self.has_maps, self.maps, self.first_map_words) = (true, words, firsts);
    }

    /// Leaves the maps of all places to others, one behind the other and behind so many words of trees, if they are worth it.
    /// Gives their words.
    pub(crate) fn make_maps_elsewhere(&mut self, room: Room) -> usize {
        let Some(words) = self.map_words().filter(|words| room.are_maps_worth(*words)) else {
            return 0;
        };
        let mut at = (room.tree_words - self.trees_words()) as u32;
        self.first_map_words.clear();
        for place in &self.places {
            self.first_map_words.push(at);
            let cells =
                place.as_ref().map(Place::bricks).and_then(|[first, last]| maps::cell_count(first, last));
            at += (maps::CELL_WORDS * cells.unwrap_or(0)) as u32;
        }
        self.has_maps = true;
        words
    }

    /// The words of trees and of what says where they begin.
    fn trees_words(&self) -> usize {
        HEADER_WORDS + self.trees.size_bytes() / size_of::<u32>()
    }

    /// Whether all values mean themselves: none is less than 0, and has to be raised.
    pub(crate) fn are_densities(&self) -> bool {
        let is_density = |place: &Place| place.meaning == Meaning::Density.line() && place.floor >= 0.0;
        self.places.iter().flatten().all(is_density)
    }

    /// Whether all fields have a map.
    pub(crate) fn has_maps(&self) -> bool {
        self.has_maps
    }

    /// Takes other frames for what is to be the same for all: their origin, their codecs, their largest values, and whether there
    /// are maps.
    pub(crate) fn agree_with(&mut self, other: &Arrays) {
        self.origin = other.origin;
        self.codecs |= other.codecs;
        if other.has_maps && !self.has_maps {
            self.make_maps();
        }
        for (largest, other) in self.largest.iter_mut().zip(&other.largest) {
            *largest = largest.max(*other);
        }
    }

    /// Keeps of further frames where they are and what [`Arrays::agree_with`] takes of them, and not their words.
    pub(crate) fn append_places(&mut self, other: &Arrays) {
        self.places.extend(&other.places);
        self.channels = other.channels;
        self.largest.resize(other.largest.len(), 0.0);
        self.agree_with(other);
        self.settle();
    }

    /// Says that frames that agree with these have maps.
    pub(crate) fn set_maps(&mut self) {
        self.has_maps = true;
    }

    /// How many channels each frame has.
    pub fn channels(&self) -> usize {
        self.channels
    }

    /// How many frames there are.
    pub fn frames(&self) -> usize {
        // Without channels, nothing is in one frame.
        self.places.len().checked_div(self.channels).unwrap_or(1)
    }

    /// The bytes of trees, and of bricks and shapes.
    pub fn size_bytes(&self) -> [usize; 2] {
        let of_blocks: usize = self.blocks.iter().map(Vec::len).sum();
        [self.trees.size_bytes(), size_of::<u32>() * (self.words.len() + self.shapes.len() + of_blocks)]
    }

    /// The words of what goes to textures, by [`blocks::FORMATS`]; `None` if nothing does.
    pub(crate) fn blocks(&self) -> Option<&[Vec<u32>; 3]> {
        self.has_textures.then_some(&self.blocks)
    }

    pub(crate) fn codecs(&self) -> u32 {
        self.codecs
    }

    pub(crate) fn origin(&self) -> DVec3 {
        self.origin
    }

    /// Where each channel is, frame by frame.
    pub(crate) fn places(&self) -> &[Option<Place>] {
        &self.places
    }

    /// The largest value of a channel in all frames.
    pub(crate) fn largest(&self, channel: usize) -> f32 {
        self.largest.get(channel).copied().unwrap_or(0.0)
    }

    /// The room that all this takes.
    pub(crate) fn room(&self) -> Room {
        let bricks = |(format, words): (&BlockFormat, &Vec<u32>)| words.len() / blocks::brick_words(*format);
        let mut of_formats = blocks::FORMATS.iter().zip(&self.blocks).map(bricks);
        Room {
            tree_words: self.trees_words() + self.maps.len(),
            fields: self.places.len().max(1),
            brick_words: self.words.len() + self.shapes.len(),
            blocks: std::array::from_fn(|_| of_formats.next().unwrap_or(0)),
            most_bytes: self.most_bytes(),
        }
    }

    /// The most bytes that maps may bring all this to.
    fn most_bytes(&self) -> usize {
        let floats = codec_bit(Codec::F32) | codec_bit(Codec::F16);
        let is_brick = |entry: &&Entry| matches!(entry.content(), Some(Content::Brick { .. }));
        let bricks = self.trees.entries.iter().filter(is_brick).count();
        let counts = [self.trees.node5s.len(), self.trees.node4s.len(), bricks];
        maps::most_bytes(counts, self.codecs & !floats != 0)
    }

    /// All fields, frame by frame. One at least, since no buffer is empty.
    pub(crate) fn fields(&self) -> Vec<Field> {
        let field =
            |place: &Option<Place>| place.as_ref().map_or_else(Field::default, |p| p.field(self.origin));
        let mut fields: Vec<Field> = self.places.iter().map(field).collect();
        for (field, first) in fields.iter_mut().zip(&self.first_map_words) {
            field.box_last[3] = (self.trees_words() + *first as usize) as i32;
        }
        if fields.is_empty() {
            fields.push(Field::default());
        }
        fields
    }

    /// The trees in one array of words, which begins by saying where each of them does, and the maps behind them.
    pub(crate) fn tree_words(&self) -> Vec<u32> {
        let Trees { cells, node5s, node4s, entries, masks } = &self.trees;
        let arrays: [&[u32]; 5] = [
            bytemuck::cast_slice(cells),
            bytemuck::cast_slice(node5s),
            bytemuck::cast_slice(node4s),
            bytemuck::cast_slice(entries),
            masks,
        ];
        let mut words =
            Vec::with_capacity(HEADER_WORDS + arrays.iter().map(|array| array.len()).sum::<usize>());
        let mut at = HEADER_WORDS as u32;
        for array in arrays {
            words.push(at);
            at += array.len() as u32;
        }
        words.extend([self.words.len() as u32, self.channels as u32]);
        words.resize(HEADER_WORDS, 0);
        arrays.iter().for_each(|array| words.extend_from_slice(array));
        words.extend_from_slice(&self.maps);
        words
    }

    /// The words of bricks, and of shapes behind them.
    pub(crate) fn brick_words(&self) -> [&[u32]; 2] {
        [&self.words, &self.shapes]
    }
}

fn place_of(
    info: &ChannelInfo,
    tree: &TreeRef,
    world_from_source: DAffine3,
    offset: IVec3,
    active_box: IndexBox,
    first_cell: u32,
    meaning: Meaning,
) -> Place {
    Place {
        world_from_index: world_from_source * DAffine3::from_translation(offset.as_dvec3()),
        active_box,
        index_offset: offset,
        cells: [first_cell, tree.cell_count],
        brick_unit: info.unit,
        bounds_unit: info.unit,
        floor: info.floor,
        meaning: meaning.line(),
    }
}

/// The entries of a node.
fn entries_of<'t>(trees: &'t Trees, node: &Node, slots: usize) -> Result<&'t [Entry], GpuError> {
    let bits = mask::decode(&trees.masks, node.mask, slots).ok_or_else(damaged)?;
    let count = bits.iter().map(|word| word.count_ones() as usize).sum::<usize>();
    let first = node.first_entry as usize;
    trees.entries.get(first..first + count).ok_or_else(damaged)
}

/// The words of a brick in a page that is loaded.
fn stored_words(asset: &Asset, codec: Codec, offset: u32) -> Result<&[u32], GpuError> {
    let store = asset.store();
    let page = store.page_of(offset).and_then(|page| store.pages().get(page)).ok_or_else(damaged)?;
    let begin = (offset - page.first_word) as usize;
    page.words().and_then(|words| words.get(begin..begin + codec.word_count())).ok_or_else(damaged)
}

fn damaged() -> GpuError {
    GpuError::Misuse("a volume whose trees name what is not there".to_owned())
}

fn too_many_words() -> GpuError {
    GpuError::Misuse("a volume of more than 2³² words: take fewer frames".to_owned())
}

/// The smallest power of two that is not less than a finite number; 1 for 0.
fn power_of_two_above(value: f32) -> f32 {
    if value <= 0.0 {
        return 1.0;
    }
    let bits = value.max(f32::MIN_POSITIVE).to_bits();
    let is_exact = bits & 0x007f_ffff == 0;
    // Above 2¹²⁷ there is no power of two: bounds are then too low by less than half, which only what is 10³⁸ dense has.
    let exponent = ((bits >> 23) + u32::from(!is_exact)).min(254);
    f32::from_bits(exponent << 23)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn units_are_powers_of_two_not_less_than_what_they_count() {
        for (value, unit) in [(0.0, 1.0), (1.0, 1.0), (1.1, 2.0), (0.3, 0.5), (65504.0, 65536.0)] {
            assert_eq!(power_of_two_above(value), unit, "{value}");
        }
    }
}
