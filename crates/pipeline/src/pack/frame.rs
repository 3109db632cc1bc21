//! Encoding one frame: each channel's bricks in the codecs chosen for them, on every level.
//!
//! A frame is encoded without regard to others but for the plan, so that frames can be encoded at the same time, and one
//! that was encoded before can be taken as it is.

use std::sync::Arc;

use glam::IVec3;
use nuage_vdb::{AnyTree, Grid, LEVEL5, Metadata, Tree, WriteOptions};
use nuage_volume::build::TileSize;
use nuage_volume::codec::Codec;
use nuage_volume::format::{Quality, Role};
use nuage_volume::space::BRICK_VOXELS;

pub use super::options::{Bound, Options};

use super::level::{Level, Tile};
use super::light;
use super::plan::{ChannelPlan, ChannelTree, Plan, channel_trees};
use crate::each;
use crate::encode::choose::{Candidate, Curve, Lambda, Target, Totals};
use crate::encode::quantize::{Brick, ChannelScale, Error, Measure, constant, write};
use crate::encode::seen::{Light, Seen};
use crate::encode::shapes::{SAMPLE_BRICKS, Shapes};
use crate::import::linear_transform;

/// A frame that is encoded.
#[derive(Debug, Clone, Default)]
pub struct EncodedFrame {
    /// Its channels.
    pub grids: Vec<EncodedGrid>,
}

/// A channel of a frame.
#[derive(Debug, Clone)]
pub struct EncodedGrid {
    /// The index of the channel in the plan.
    pub channel: usize,
    /// Its levels, the finest first.
    pub levels: Vec<EncodedLevel>,
    /// How values are written.
    pub scale: ChannelScale,
    /// What is added to stored index coordinates to have those of the source.
    pub index_offset: [i32; 3],
    /// The box of active voxels of the source, both ends included.
    pub active_box: Option<[[i32; 3]; 2]>,
    /// World from index of the source, the columns x, y, z and translation; `None` if it is not linear.
    pub world_from_index: Option<[f64; 12]>,
    /// A .vdb file of the grid without its voxels: metadata, transform and all else there is.
    pub source_header: Vec<u8>,
    /// The error of the finest level.
    pub quality: Quality,
    /// The bricks of the source that are not constant.
    pub source_bricks: u64,
}

/// A level of a channel.
#[derive(Debug, Clone, Default)]
pub struct EncodedLevel {
    /// Each brick: its place in bricks, its codec, and where its words end in `words`; they begin where those of the one
    /// before end.
    pub bricks: Vec<(IVec3, Codec, usize)>,
    /// The words of all bricks.
    pub words: Vec<u32>,
    /// Regions of one value.
    pub tiles: Vec<Tile>,
}

/// Why a frame cannot be encoded.
#[derive(Debug, thiserror::Error)]
pub enum EncodeError {
    /// A grid's header cannot be written.
    #[error("grid '{grid}': {source}")]
    Header {
        /// The grid.
        grid: String,
        /// What went wrong.
        source: nuage_vdb::Error,
    },
    /// A grid is in none of the frames that the plan was made from.
    #[error("grid '{0}' was not there when the frames were looked through")]
    NotPlanned(String),
}

/// Encodes the grids of a frame. `weighed` is what [`weigh_frame`] found, if it is still there.
///
/// # Errors
/// If a grid is not in the plan or its header cannot be written.
pub fn encode_frame(
    grids: &[Grid],
    metadata: &Metadata,
    plan: &Plan,
    options: &Options,
    weighed: Option<&[WeighedChannel]>,
) -> Result<EncodedFrame, EncodeError> {
    let (trees, _) = channel_trees(grids);
    let encode = |(i, channel): (usize, ChannelTree)| {
        let curves = weighed.and_then(|weighed| Some(weighed.get(i)?.curves.as_slice()));
        encode_channel(&grids[channel.grid], channel, metadata, plan, options, curves)
    };
    Ok(EncodedFrame { grids: trees.into_iter().enumerate().map(encode).collect::<Result<_, _>>()? })
}

fn encode_channel(
    grid: &Grid,
    channel: ChannelTree,
    metadata: &Metadata,
    plan: &Plan,
    options: &Options,
    curves: Option<&[Curve]>,
) -> Result<EncodedGrid, EncodeError> {
    let ChannelTree { key, tree, .. } = channel;
    let index = plan.find(&key).ok_or_else(|| EncodeError::NotPlanned(key.grid.clone()))?;
    let planned = &plan.channels[index];
    let choice = Choice::new(planned, options, tree.background, planned.lambda);
    let scale = choice.scale;
    let offset = index_offset(&tree);
    let mut level = Level::of(&tree, offset >> 3);
    let (voxels, source_bricks) = (level.voxels(tree.background), level.bricks.len() as u64);
    let (encoded, error) = encode_level(&level, &choice, curves);
    let mut levels = vec![encoded];
    for _ in 0..options.coarser_levels {
        let Some(coarser) = level.coarser(tree.background) else { break };
        level = coarser;
        levels.push(encode_level(&level, &choice, None).0);
    }
    let world_from_index =
        linear_transform(&grid.name, &grid.transform).ok().map(|affine| affine.to_cols_array());
    Ok(EncodedGrid {
        channel: index,
        levels,
        scale,
        index_offset: offset.to_array(),
        active_box: tree.active_bbox(),
        world_from_index,
        source_header: source_header(grid, metadata)?,
        quality: Quality {
            max_error: error.max,
            squared_error: error.squared * f64::from(scale.unit).powi(2),
            voxels,
        },
        source_bricks,
    })
}

/// A multiple of 128 that brings the tree into one `Node5`, or 0 if it does not fit.
fn index_offset(tree: &Tree<f32>) -> IVec3 {
    let node4s = tree.levels[1].iter().map(|node| node.origin);
    let tiles = tree.levels[0].iter().flat_map(|node| {
        let tiles = node.tile_slots().filter(|(_, value, _)| *value != tree.background);
        tiles.map(|(slot, _, _)| LEVEL5.child_origin(node.origin, slot))
    });
    let (mut min, mut max) = (IVec3::MAX, IVec3::MIN);
    for origin in node4s.chain(tiles) {
        min = min.min(IVec3::from_array(origin));
        max = max.max(IVec3::from_array(origin));
    }
    let is_small = (max.as_i64vec3() - min.as_i64vec3()).max_element() < 4096 - 127;
    if !tree.root_tiles.is_empty() || min.cmpgt(max).any() || !is_small { IVec3::ZERO } else { min }
}

/// A .vdb file of a grid with all but its voxels.
fn source_header(grid: &Grid, metadata: &Metadata) -> Result<Vec<u8>, EncodeError> {
    let empty: AnyTree = match &*grid.tree {
        AnyTree::Vec3s(tree) => Tree::empty(tree.background, tree.shape).into(),
        AnyTree::Vec3d(tree) => Tree::empty(tree.background, tree.shape).into(),
        AnyTree::Double(tree) => Tree::empty(tree.background, tree.shape).into(),
        AnyTree::Half(tree) => Tree::empty(tree.background, tree.shape).into(),
        AnyTree::Float(tree) => Tree::empty(tree.background, tree.shape).into(),
        // What else there is has no channel.
        _ => return Ok(Vec::new()),
    };
    let grid = Grid { tree: Arc::new(empty), ..grid.clone() };
    let mut bytes = Vec::new();
    nuage_vdb::write(std::slice::from_ref(&grid), metadata, &WriteOptions::default(), &mut bytes)
        .map_err(|source| EncodeError::Header { grid: grid.name, source })?;
    Ok(bytes)
}

/// What decides which codec a brick gets.
struct Choice {
    /// The one that was asked for: it is not weighed against others, and what it cannot hold takes more.
    asked: Option<Codec>,
    /// How bricks are written.
    scale: ChannelScale,
    lambda: Lambda,
    shapes: Arc<Shapes>,
    /// Whether errors count by how much of a brick is seen.
    is_lit: bool,
}

impl Choice {
    fn new(planned: &ChannelPlan, options: &Options, background: f32, lambda: Lambda) -> Choice {
        let options = options.for_channel(&planned.key.grid);
        let shapes = Arc::clone(&planned.shapes);
        let max_error = options.max_error.map_or(f32::INFINITY, |bound| bound.of(planned.peak()));
        let scale = ChannelScale { max_error, ..planned.scale(background) };
        // A budget goes where it shows. A bound of the error is one for all voxels.
        let is_lit = options.codec.is_none()
            && options.bits_per_voxel.is_some()
            && options.psnr.is_none()
            && planned.role == Role::Density;
        Choice { asked: options.codec, scale, lambda, shapes, is_lit }
    }

    /// The light in each brick, if errors count by it.
    fn light(&self, level: &Level) -> Option<Vec<Light>> {
        self.is_lit.then(|| light::light(level, self.scale.unit))
    }

    /// The codecs that are the best for a brick with some λ up to that of the choice.
    fn curve(&self, brick: &Brick, light: Option<&Light>) -> Curve {
        let mut measure = match light {
            Some(light) => Measure::in_light(brick, &self.scale, &self.shapes, light),
            None => Measure::of(brick, &self.scale, &self.shapes),
        };
        Curve::of(&mut measure, 1.0, self.lambda)
    }

    fn best(&self, brick: &Brick, light: Option<&Light>) -> Candidate {
        let Some(asked) = self.asked else {
            return self.curve(brick, light).at(self.lambda);
        };
        let mut measure = Measure::of(brick, &self.scale, &self.shapes);
        let mut held = [asked, Codec::Uniform { bits: 8 }]
            .into_iter()
            .filter_map(|codec| Some(Candidate::new(codec, measure.error(codec)?, 1.0)));
        held.next().unwrap_or(Candidate::new(Codec::F32, Error::default(), 1.0))
    }
}

/// The words that the tree takes for a brick: an entry of two, and its part of nodes, masks and entries that are no
/// bricks.
pub(super) const ENTRY_WORDS: f64 = 3.0;

/// The same in bits per voxel: what [`Options::bits_per_voxel`] allows beyond the bricks themselves.
pub const ENTRY_BITS_PER_VOXEL: f64 = ENTRY_WORDS * 32.0 / BRICK_VOXELS as f64;

/// What a channel's bricks have to keep to, over all frames, squared errors in its unit.
fn target(planned: &ChannelPlan, options: &Options) -> Target {
    let options = options.for_channel(&planned.key.grid);
    // What frames before these have used up, and what they are allowed.
    let (peak, voxels, squared) = match planned.before {
        Some(before) => (before.peak, before.voxels, before.squared_error),
        None => (planned.peak(), 0, 0.0),
    };
    let peak = f64::from(peak / planned.scale(0.0).unit);
    let voxels = (voxels as f64) + planned.voxels as f64;
    Target {
        squared_error: options
            .psnr
            .map(|decibels| (voxels * peak.powi(2) / 10.0_f64.powf(decibels / 10.0) - squared).max(0.0)),
        words: options
            .bits_per_voxel
            .map(|bits| ((bits - ENTRY_BITS_PER_VOXEL) * 16.0 * planned.bricks as f64).max(0.0) as u64),
    }
}

/// The λ with which a channel meets what is asked of it, from the sums over all its bricks. That of frames before these
/// stays, so that equal bricks get equal words, unless all together would then miss the ratio that was asked for. A size
/// was shared out among the frames that were there.
pub fn settle(totals: &Totals, planned: &ChannelPlan, options: &Options) -> Lambda {
    match planned.before {
        None => totals.lambda(&target(planned, options)),
        Some(before) if options.bits_per_voxel.is_some() => before.lambda,
        Some(before) => totals.lambda(&target(planned, options)).max(before.lambda),
    }
}

/// A λ with which a channel is sure to meet what is asked of it.
pub fn sure_lambda(planned: &ChannelPlan, options: &Options) -> Lambda {
    let sure = match target(planned, options).squared_error {
        Some(squared) => Lambda::sure(planned.bricks, squared),
        None => Lambda::LARGEST,
    };
    planned.before.map_or(sure, |before| sure.max(before.lambda))
}

/// A λ is guessed from so many bricks of a channel, or some more, in at most so many frames.
const GUESS_BRICKS: usize = 1024;
const GUESS_FRAMES: usize = 16;

/// How much more the λ of all bricks may be than that of some.
const GUESS_MARGIN: f64 = 2.0;

/// A λ for each channel that is likely to do, from some bricks of some frames. It saves trying what only a larger one asks for.
///
/// # Errors
/// If a grid is not in the plan.
pub fn likely_lambdas(
    frames: &[&[Grid]],
    plan: &Plan,
    options: &Options,
) -> Result<Vec<Lambda>, EncodeError> {
    let sure: Vec<Lambda> = plan.channels.iter().map(|planned| sure_lambda(planned, options)).collect();
    let mut found = vec![(Totals::default(), 0_u64); sure.len()];
    let some: Vec<&[Grid]> =
        frames.iter().step_by(frames.len().div_ceil(GUESS_FRAMES).max(1)).copied().collect();
    let bricks = plan.channels.iter().map(|planned| planned.bricks as usize).max().unwrap_or(0);
    let every = (bricks * some.len() / frames.len().max(1) / GUESS_BRICKS).max(1);
    for weighed in each(some.len(), |i| weigh_frame(some[i], plan, options, &sure, every)) {
        for WeighedChannel { channel, totals, curves } in weighed? {
            found[channel].0.merge(&totals);
            found[channel].1 += curves.len() as u64;
        }
    }
    let guess = |((planned, sure), (totals, bricks)): ((&ChannelPlan, Lambda), (Totals, u64))| {
        if bricks == 0 {
            return sure;
        }
        let part = bricks as f64 / planned.bricks as f64;
        let guess = totals.lambda(&target(planned, options).of_part(part));
        let least = planned.before.map_or(Lambda::NONE, |before| before.lambda);
        Lambda::of_weight(sure.weight().min(GUESS_MARGIN * guess.weight())).max(least)
    };
    Ok(plan.channels.iter().zip(sure).zip(found).map(guess).collect())
}

/// Finds the shapes of each channel, in bricks of some frames of the sequence. A codec that is asked for has none.
pub fn find_shapes(frames: &[&[Grid]], plan: &mut Plan, options: &Options) {
    for planned in &mut plan.channels {
        let asked = options.for_channel(&planned.key.grid);
        if asked.codec.is_some() || options.shapes == 0 {
            continue;
        }
        let trees = frames.iter().flat_map(|grids| channel_trees(grids).0);
        let levels: Vec<Level> = trees
            .filter(|tree| tree.key == planned.key)
            .map(|tree| Level::of(&tree.tree, IVec3::ZERO))
            .collect();
        let count: usize = levels.iter().map(|level| level.bricks.len()).sum();
        let every = count.div_ceil(SAMPLE_BRICKS).max(1);
        let bricks = levels.iter().flat_map(|level| &level.bricks).step_by(every).copied();
        let bricks: Vec<Brick> = bricks.collect();
        let bound = asked.max_error.map_or(f32::INFINITY, |bound| bound.of(planned.peak()));
        // Bricks that are like others may take some times their share of the error, as it saves so much.
        let share = target(planned, options)
            .squared_error
            .map_or(f64::INFINITY, |squared| 4.0 * squared / planned.bricks.max(1) as f64);
        planned.shapes =
            Arc::new(Shapes::find(&bricks, options.shapes as usize, &planned.scale(0.0), bound, share));
    }
}

/// What each λ leads to in one channel of a frame.
#[derive(Debug, Clone)]
pub struct WeighedChannel {
    /// The index of the channel in the plan.
    pub channel: usize,
    /// The sums over its bricks.
    pub totals: Totals,
    /// The codecs worth choosing for each brick, with any λ that may come out; none where one codec is asked for.
    pub curves: Vec<Curve>,
}

/// Finds what each λ up to the `largest` of a channel would lead to in a frame, in each brick or each so many.
///
/// # Errors
/// If a grid is not in the plan.
pub fn weigh_frame(
    grids: &[Grid],
    plan: &Plan,
    options: &Options,
    largest: &[Lambda],
    every: usize,
) -> Result<Vec<WeighedChannel>, EncodeError> {
    let weigh = |tree: ChannelTree| {
        let index = plan.find(&tree.key).ok_or_else(|| EncodeError::NotPlanned(tree.key.grid.clone()))?;
        let choice = Choice::new(&plan.channels[index], options, tree.tree.background, largest[index]);
        if choice.asked.is_some() {
            return Ok(WeighedChannel { channel: index, totals: Totals::default(), curves: Vec::new() });
        }
        let level = Level::of(&tree.tree, IVec3::ZERO);
        let light = choice.light(&level);
        let light_in = |i: usize| light.as_ref().and_then(|light| light.get(i));
        let curve = |i: usize| choice.curve(&level.bricks[i * every], light_in(i * every));
        let curves = each(level.bricks.len().div_ceil(every), curve);
        // In the order of bricks, on which sums depend.
        let mut totals = Totals::default();
        curves.iter().for_each(|curve| totals.add(curve));
        Ok(WeighedChannel { channel: index, totals, curves })
    };
    channel_trees(grids).0.into_iter().map(weigh).collect()
}

/// Encodes the bricks of a level, by their curves if these are known. Gives the sum of their squared errors, in units
/// of the channel, and the largest error as well.
fn encode_level(level: &Level, choice: &Choice, curves: Option<&[Curve]>) -> (EncodedLevel, Error) {
    let light = choice.light(level);
    let light_in = |i: usize| light.as_ref().and_then(|light| light.get(i));
    let coded = each(level.bricks.len(), |i| {
        let brick = &level.bricks[i];
        let mut best = match curves {
            Some(curves) if choice.asked.is_none() => curves[i].at(choice.lambda),
            _ => choice.best(brick, light_in(i)),
        };
        let mut words = Vec::with_capacity(best.codec.word_count());
        match light_in(i) {
            Some(light) => {
                let written =
                    Seen::of(brick, &choice.scale, light).write(best.codec, &choice.shapes, &mut words);
                best.error = written.unwrap_or(best.error);
            }
            None => write(brick, best.codec, &choice.scale, &choice.shapes, &mut words),
        }
        (best, words)
    });
    let mut encoded = EncodedLevel { tiles: level.tiles.clone(), ..EncodedLevel::default() };
    let mut total = Error::default();
    for ((place, brick), (Candidate { codec, error, .. }, words)) in
        level.places.iter().zip(&level.bricks).zip(coded)
    {
        total.squared += error.squared;
        total.max = total.max.max(error.max);
        match codec {
            Codec::Constant => {
                let value = constant(brick, &choice.scale);
                if value != choice.scale.background {
                    encoded.tiles.push((*place, TileSize::Brick, value));
                }
            }
            codec => {
                encoded.words.extend(words);
                encoded.bricks.push((*place, codec, encoded.words.len()));
            }
        }
    }
    (encoded, total)
}
