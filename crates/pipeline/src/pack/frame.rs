//! Encoding one frame: each channel's bricks in the codecs chosen for them, on every level.
//!
//! A frame is encoded without regard to others but for the plan, so that frames can be encoded at the same time, and one
//! that was encoded before can be taken as it is.

use std::sync::Arc;

use glam::IVec3;
use nuage_vdb::{AnyTree, Grid, LEVEL5, Metadata, Tree, WriteOptions};
use nuage_volume::build::TileSize;
use nuage_volume::codec::Codec;
use nuage_volume::format::Quality;

pub use super::options::{Bound, Options};

use super::level::{Level, Tile};
use super::plan::{ChannelPlan, ChannelTree, Plan, channel_trees};
use crate::encode::choose::{Lambda, Target, Totals, choose};
use crate::encode::quantize::{CODECS, ChannelScale, constant, measure, write};
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

/// Encodes the grids of a frame.
///
/// # Errors
/// If a grid is not in the plan or its header cannot be written.
pub fn encode_frame(
    grids: &[Grid],
    metadata: &Metadata,
    plan: &Plan,
    options: &Options,
) -> Result<EncodedFrame, EncodeError> {
    let (trees, _) = channel_trees(grids);
    let encode =
        |channel: ChannelTree| encode_channel(&grids[channel.grid], channel, metadata, plan, options);
    Ok(EncodedFrame { grids: trees.into_iter().map(encode).collect::<Result<_, _>>()? })
}

fn encode_channel(
    grid: &Grid,
    channel: ChannelTree,
    metadata: &Metadata,
    plan: &Plan,
    options: &Options,
) -> Result<EncodedGrid, EncodeError> {
    let ChannelTree { key, tree, .. } = channel;
    let index = plan.find(&key).ok_or_else(|| EncodeError::NotPlanned(key.grid.clone()))?;
    let planned = &plan.channels[index];
    let scale = planned.scale(tree.background);
    let choice = Choice::new(planned, options);
    let offset = index_offset(&tree);
    let mut level = Level::of(&tree, offset >> 3);
    let (voxels, source_bricks) = (level.voxels(tree.background), level.bricks.len() as u64);
    let (encoded, error) = encode_level(&level, &scale, &choice);
    let mut levels = vec![encoded];
    for _ in 0..options.coarser_levels {
        let Some(coarser) = level.coarser(tree.background) else { break };
        level = coarser;
        levels.push(encode_level(&level, &scale, &choice).0);
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
        quality: Quality { max_error: error.1, squared_error: error.0, voxels },
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
    codecs: Vec<Codec>,
    /// Whether it is the first of these that can hold the brick, whatever it costs.
    is_forced: bool,
    max_error: Option<f32>,
    lambda: Lambda,
}

impl Choice {
    fn new(planned: &ChannelPlan, options: &Options) -> Choice {
        let options = options.for_channel(&planned.key.grid);
        match options.codec {
            // A codec that is asked for is not weighed against others; what it cannot hold takes more.
            Some(codec) => {
                let codecs = vec![codec, Codec::Uniform { bits: 8 }, Codec::F32];
                Choice { codecs, is_forced: true, max_error: None, lambda: Lambda::NONE }
            }
            None => Choice {
                codecs: CODECS.to_vec(),
                is_forced: false,
                max_error: options.max_error.map(|bound| bound.of(planned.peak())),
                lambda: planned.lambda,
            },
        }
    }
}

/// What each weight of error leads to in one channel of a frame.
#[derive(Debug, Clone)]
pub struct ChannelTotals {
    /// The index of the channel in the plan.
    pub channel: usize,
    /// Words and errors.
    pub totals: Totals,
    /// Voxels that are not background.
    pub voxels: u64,
    /// Bricks that are not constant.
    pub bricks: u64,
}

/// The words that the tree takes for a brick: an entry of two, and its part of nodes, masks and entries that are no
/// bricks.
pub(super) const ENTRY_WORDS: f64 = 3.0;

impl ChannelTotals {
    /// Adds what another frame has.
    pub fn merge(&mut self, other: &ChannelTotals) {
        self.totals.merge(&other.totals);
        self.voxels += other.voxels;
        self.bricks += other.bricks;
    }

    /// The weight with which the channel meets what is asked of it.
    pub fn lambda(&self, planned: &ChannelPlan, options: &Options) -> Lambda {
        let options = options.for_channel(&planned.key.grid);
        let peak = f64::from(planned.peak());
        let target = Target {
            squared_error: options
                .psnr
                .map(|decibels| self.voxels as f64 * peak.powi(2) / 10.0_f64.powf(decibels / 10.0)),
            words: options
                .bits_per_voxel
                .map(|bits| ((bits * 16.0 - ENTRY_WORDS) * self.bricks as f64).max(0.0) as u64),
        };
        self.totals.lambda(&target, planned.scale(0.0).unit)
    }
}

/// Adds up what each weight of error would lead to in a frame.
pub fn frame_totals(grids: &[Grid], plan: &Plan, options: &Options) -> Vec<ChannelTotals> {
    let total = |channel: ChannelTree| {
        let index = plan.find(&channel.key)?;
        let planned = &plan.channels[index];
        let scale = planned.scale(channel.tree.background);
        let Choice { codecs, max_error, .. } = Choice::new(planned, options);
        let level = Level::of(&channel.tree, IVec3::ZERO);
        let parts: Vec<_> = level.bricks.chunks(512).collect();
        // Parts and not bricks, since sums depend on their order.
        let totals = map(&parts, |bricks| {
            let mut totals = Totals::default();
            for brick in *bricks {
                totals.add(&codecs, &measure(brick, &codecs, &scale), max_error, scale.unit);
            }
            totals
        });
        let mut sum = Totals::default();
        totals.iter().for_each(|totals| sum.merge(totals));
        let (voxels, bricks) = (level.voxels(channel.tree.background), level.bricks.len() as u64);
        Some(ChannelTotals { channel: index, totals: sum, voxels, bricks })
    };
    channel_trees(grids).0.into_iter().filter_map(total).collect()
}

/// Encodes the bricks of a level. Gives the sum of their squared errors and the largest error as well.
fn encode_level(level: &Level, scale: &ChannelScale, choice: &Choice) -> (EncodedLevel, (f64, f32)) {
    let Choice { codecs, is_forced, max_error, lambda } = choice;
    let coded = map(&level.bricks, |brick| {
        let errors = measure(brick, codecs, scale);
        let i = match is_forced {
            true => errors.iter().position(Option::is_some).unwrap_or(codecs.len() - 1),
            false => choose(codecs, &errors, *max_error, *lambda),
        };
        let mut words = Vec::with_capacity(codecs[i].word_count());
        write(brick, codecs[i], scale, &mut words);
        (codecs[i], errors[i], words)
    });
    let mut encoded = EncodedLevel { tiles: level.tiles.clone(), ..EncodedLevel::default() };
    let mut total = (0.0, 0.0_f32);
    for ((place, brick), (codec, error, words)) in level.places.iter().zip(&level.bricks).zip(coded) {
        if let Some(error) = error {
            total = (total.0 + f64::from(error.squared), total.1.max(error.max));
        }
        match codec {
            Codec::Constant => {
                let value = constant(brick, scale);
                if value != scale.background {
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

/// The results for all items, in order, on all threads where the feature `parallel` says so.
pub(crate) fn map<T: Sync, R: Send>(items: &[T], run: impl Fn(&T) -> R + Sync + Send) -> Vec<R> {
    #[cfg(feature = "parallel")]
    {
        use rayon::prelude::*;
        items.par_iter().with_min_len(16).map(run).collect()
    }
    #[cfg(not(feature = "parallel"))]
    {
        items.iter().map(run).collect()
    }
}
