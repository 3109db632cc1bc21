//! What has to be known of a sequence before its first frame is encoded: its channels, and the range of each.

use nuage_vdb::{AnyTree, Grid, Shape, Tree};
use nuage_volume::format::Role;
use rayon_or_not::map_slice;

use crate::encode::choose::Lambda;
use crate::encode::quantize::ChannelScale;

/// Values beyond this count as this: twice as much is still a float, and a power of two above it is.
pub const LARGEST: f32 = 8.507_059e37; // 2¹²⁶

/// The part of the peak by which empty voxels may be off.
pub(crate) const BACKGROUND_TOLERANCE: f32 = 1e-3;

/// Which channel a tree of numbers belongs to: frames are matched by it.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
pub struct ChannelKey {
    /// The name of the grid.
    pub grid: String,
    /// Which of the grids of that name, from 0.
    pub repeat: u32,
    /// Which number of a vector.
    pub component: Option<u8>,
}

/// A channel of a sequence.
#[derive(Debug, Clone, PartialEq)]
pub struct ChannelPlan {
    /// Which one it is.
    pub key: ChannelKey,
    /// What its values are.
    pub role: Role,
    /// The smallest value over all frames, the background included.
    pub min: f32,
    /// The largest value over all frames, the background included.
    pub max: f32,
    /// The weight of errors with which the channel meets what is asked of it.
    pub lambda: Lambda,
}

/// The channels of a sequence, in the order in which they were met.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Plan {
    /// The channels.
    pub channels: Vec<ChannelPlan>,
    /// Grids that cannot be packed, each once, and why.
    pub left_out: Vec<String>,
}

/// One channel of a frame: single-precision numbers in a standard tree.
#[derive(Debug, Clone)]
pub struct ChannelTree {
    /// Which channel.
    pub key: ChannelKey,
    /// The index of the grid it comes from.
    pub grid: usize,
    /// The values.
    pub tree: Tree<f32>,
}

impl ChannelPlan {
    /// The largest magnitude over all frames.
    pub fn peak(&self) -> f32 {
        self.min.abs().max(self.max.abs())
    }

    /// How values are written.
    pub fn scale(&self, background: f32) -> ChannelScale {
        let peak = self.peak();
        // The smallest power of two that is not less: one with no mantissa bits, or the next exponent.
        let exponent = peak.max(f32::MIN_POSITIVE).to_bits().div_ceil(1 << 23);
        ChannelScale {
            unit: f32::from_bits(exponent << 23),
            floor: if self.min >= 0.0 { 0.0 } else { f32::MIN },
            background,
            background_tolerance: BACKGROUND_TOLERANCE * peak,
            keeps_sign: self.role == Role::SignedDistance,
        }
    }
}

impl Plan {
    /// Adds what one frame holds.
    pub fn note(&mut self, grids: &[Grid]) {
        let (trees, left_out) = channel_trees(grids);
        let channels = trees.into_iter().map(|ChannelTree { key, grid, tree }| {
            let (min, max) = range(&tree);
            ChannelPlan { key, role: role(&grids[grid]), min, max, lambda: Lambda::NONE }
        });
        self.merge(Plan { channels: channels.collect(), left_out });
    }

    /// Adds what another plan has.
    pub fn merge(&mut self, other: Plan) {
        for what in other.left_out {
            if !self.left_out.contains(&what) {
                self.left_out.push(what);
            }
        }
        for found in other.channels {
            match self.channels.iter_mut().find(|channel| channel.key == found.key) {
                Some(channel) => {
                    (channel.min, channel.max) = (channel.min.min(found.min), channel.max.max(found.max));
                }
                None => self.channels.push(found),
            }
        }
    }

    /// The index of a channel.
    pub fn find(&self, key: &ChannelKey) -> Option<usize> {
        self.channels.iter().position(|channel| channel.key == *key)
    }
}

/// The channels of the grids of a frame, and what of them cannot be one.
pub fn channel_trees(grids: &[Grid]) -> (Vec<ChannelTree>, Vec<String>) {
    let (mut trees, mut left_out) = (Vec::new(), Vec::new());
    for (i, grid) in grids.iter().enumerate() {
        let repeat = grids[..i].iter().filter(|other| other.name == grid.name).count() as u32;
        let key = |component| ChannelKey { grid: grid.name.clone(), repeat, component };
        let mut add = |component, tree| trees.push(ChannelTree { key: key(component), grid: i, tree });
        match &*grid.tree {
            tree if tree.shape() != Shape::STANDARD => {
                left_out.push(format!(
                    "grid '{}': its tree has another shape ({})",
                    grid.name,
                    grid.grid_type()
                ));
            }
            AnyTree::Vec3s(tree) => {
                (0..3).for_each(|c| add(Some(c as u8), tree.map(|value| finite(value[c]))));
            }
            AnyTree::Vec3d(tree) => {
                (0..3).for_each(|c| add(Some(c as u8), tree.map(|value| finite(value[c] as f32))));
            }
            AnyTree::Float(tree) => add(None, tree.map(finite)),
            AnyTree::Double(tree) => add(None, tree.map(|value| finite(value as f32))),
            AnyTree::Half(tree) => add(None, tree.map(|value| finite(value.to_f32()))),
            other => {
                left_out.push(format!("grid '{}': values of type {}", grid.name, other.value_type()));
            }
        }
    }
    (trees, left_out)
}

/// A number that can be packed: NaN counts as 0, and what is too large as the largest.
fn finite(value: f32) -> f32 {
    if value.is_nan() { 0.0 } else { value.clamp(-LARGEST, LARGEST) }
}

fn range(tree: &Tree<f32>) -> (f32, f32) {
    let of = |values: &[f32]| {
        values.iter().fold((f32::INFINITY, f32::NEG_INFINITY), |(min, max), value| {
            (if *value < min { *value } else { min }, if *value > max { *value } else { max })
        })
    };
    let leaves = map_slice(&tree.leaves.values, 1 << 16, of);
    let tiles = tree.inner_nodes().flat_map(|(_, node)| node.tile_slots().map(|(_, value, _)| value));
    let others = tiles.chain(tree.root_tiles.iter().map(|tile| tile.value)).chain([tree.background]);
    leaves
        .into_iter()
        .chain(others.map(|value| (value, value)))
        .fold((f32::INFINITY, f32::NEG_INFINITY), |(min, max), (low, high)| (min.min(low), max.max(high)))
}

/// What the values of a grid are, by its class and its name.
pub fn role(grid: &Grid) -> Role {
    let name = grid.name.to_lowercase();
    let has = |words: &[&str]| words.iter().any(|word| name.contains(word));
    let is_vector = matches!(&*grid.tree, AnyTree::Vec3s(_) | AnyTree::Vec3d(_));
    match grid.grid_class() {
        "level set" => Role::SignedDistance,
        _ if has(&["color", "colour", "albedo"]) || name == "cd" => Role::Colour,
        _ if is_vector && (has(&["vel"]) || name == "v") => Role::Velocity,
        _ if is_vector => Role::Other,
        _ if has(&["temperature", "temp"]) => Role::Temperature,
        _ if has(&["flame", "fire", "fuel"]) => Role::Flame,
        _ if has(&["density", "smoke", "fog", "cloud"]) => Role::Density,
        _ => Role::Other,
    }
}

/// Running over parts of a slice, in parallel where the feature says so.
mod rayon_or_not {
    /// The results of chunks of a slice, in order.
    pub(super) fn map_slice<T: Sync, R: Send>(
        items: &[T],
        chunk: usize,
        run: impl Fn(&[T]) -> R + Sync + Send,
    ) -> Vec<R> {
        #[cfg(feature = "parallel")]
        {
            use rayon::prelude::*;
            items.par_chunks(chunk).map(run).collect()
        }
        #[cfg(not(feature = "parallel"))]
        {
            items.chunks(chunk).map(run).collect()
        }
    }
}
