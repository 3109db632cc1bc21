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

use super::level::{Level, Tile};
use super::plan::{ChannelTree, Plan, channel_trees};
use crate::encode::choose::{Target, choose};
use crate::encode::quantize::{CODECS, ChannelScale, constant, measure, write};
use crate::import::linear_transform;

/// How large an error may be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Bound {
    /// In the channel's own numbers.
    Absolute(f32),
    /// As a part of the channel's peak over all frames.
    OfPeak(f32),
}

/// What is asked of a packed volume.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Options {
    /// The largest error of any voxel.
    pub max_error: Option<Bound>,
    /// The least ratio of a channel's peak over all frames to its error, in every frame, in dB.
    pub psnr: Option<f64>,
    /// The most bits per voxel of bricks that are not constant, in every frame.
    pub bits_per_voxel: Option<f64>,
    /// One codec for all bricks that it can hold, whatever the error.
    pub codec: Option<Codec>,
    /// How many coarser levels are made at most.
    pub coarser_levels: u32,
}

impl Default for Options {
    fn default() -> Self {
        Options {
            max_error: Some(Bound::OfPeak(0.03)),
            psnr: Some(45.0),
            bits_per_voxel: None,
            codec: None,
            coarser_levels: 0,
        }
    }
}

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
    let peak = planned.peak();
    let offset = index_offset(&tree);
    let mut level = Level::of(&tree, offset >> 3);
    let voxels = level.voxels(tree.background);
    let target = |level: &Level, voxels: u64| Target {
        max_error: options.max_error.filter(|_| options.codec.is_none()).map(|bound| match bound {
            Bound::Absolute(error) => error,
            Bound::OfPeak(part) => part * peak,
        }),
        squared_error: options
            .psnr
            .map(|decibels| voxels as f64 * f64::from(peak).powi(2) / 10.0_f64.powf(decibels / 10.0)),
        words: options.bits_per_voxel.map(|bits| (bits * 16.0 * level.bricks.len() as f64) as u64),
    };
    // A codec that is asked for is not weighed against others; what it cannot hold is kept as it is.
    let forced = options.codec.map(|codec| [codec, Codec::Uniform { bits: 8 }, Codec::F32]);
    let codecs: &[Codec] = forced.as_ref().map_or(&CODECS, |forced| forced);
    let (encoded, error) = encode_level(&level, codecs, &scale, &target(&level, voxels));
    let mut levels = vec![encoded];
    for _ in 0..options.coarser_levels {
        let Some(coarser) = level.coarser(tree.background) else { break };
        level = coarser;
        let voxels = level.voxels(tree.background);
        levels.push(encode_level(&level, codecs, &scale, &target(&level, voxels)).0);
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

/// Encodes the bricks of a level. Gives the sum of their squared errors and the largest error as well.
fn encode_level(
    level: &Level,
    codecs: &[Codec],
    scale: &ChannelScale,
    target: &Target,
) -> (EncodedLevel, (f64, f32)) {
    let errors = map(&level.bricks, |brick| measure(brick, codecs, scale));
    let chosen = choose(codecs, &errors, target);
    let items: Vec<_> = level.bricks.iter().zip(&chosen).collect();
    let written = map(&items, |(brick, i)| {
        let mut words = Vec::with_capacity(codecs[**i].word_count());
        write(brick, codecs[**i], scale, &mut words);
        words
    });
    let mut encoded = EncodedLevel { tiles: level.tiles.clone(), ..EncodedLevel::default() };
    let mut total = (0.0, 0.0_f32);
    for (n, ((place, i), words)) in level.places.iter().zip(&chosen).zip(written).enumerate() {
        if let Some(error) = errors[n][*i] {
            total = (total.0 + f64::from(error.squared), total.1.max(error.max));
        }
        match codecs[*i] {
            Codec::Constant => {
                let value = constant(&level.bricks[n]);
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
