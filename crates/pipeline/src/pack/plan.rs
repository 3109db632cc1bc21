//! What has to be known of a sequence before its first frame is encoded: its channels, and the range of each.

use std::borrow::Cow;
use std::sync::Arc;

use nuage_vdb::{AnyTree, Grid, Shape, Tree};
use nuage_volume::format::Role;
use nuage_volume::space::BRICK_VOXELS;

use crate::each;
use crate::encode::choose::Lambda;
use crate::encode::quantize::ChannelScale;
use crate::encode::shapes::Shapes;

/// Values beyond this count as this: twice as much is still a float, and a power of two above it is.
pub const LARGEST: f32 = 8.507_059e37; // 2¹²⁶

/// The part of the peak by which empty voxels may be off.
pub(crate) const BACKGROUND_TOLERANCE: f32 = 1e-3;

/// Which channel a tree of numbers belongs to: frames are matched by it.
#[derive(Debug, Clone, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
pub struct ChannelKey {
    /// The name of the grid.
    pub grid: String,
    /// Which of the grids of that name, from 0.
    pub repeat: u32,
    /// Which number of a vector.
    pub component: Option<u8>,
}

/// A channel of a sequence.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct ChannelPlan {
    /// Which one it is.
    pub key: ChannelKey,
    /// What its values are.
    pub role: Role,
    /// The smallest value over all frames, the background included.
    pub min: f32,
    /// The largest value over all frames, the background included.
    pub max: f32,
    /// The voxels of bricks that are not constant, those that differ from the background, over all frames.
    pub voxels: u64,
    /// The bricks that are not constant, over all frames.
    pub bricks: u64,
    /// The weight of errors with which the channel meets what is asked of it.
    pub lambda: Lambda,
    /// The shapes that bricks may share.
    #[serde(skip)]
    pub shapes: Arc<Shapes>,
    /// What of it is encoded already, if frames are added to a file. Range and scale are then those of the file.
    pub before: Option<Before>,
}

/// What a file holds of a channel before frames are added.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Before {
    /// The index of the channel in the file.
    pub channel: usize,
    /// The weight of errors that it was encoded with.
    pub lambda: Lambda,
    /// The largest magnitude over old and new frames, which may be more than the range says but not than the unit.
    pub peak: f32,
    /// The sum of squared errors, in the channel's unit.
    pub squared_error: f64,
    /// The voxels over which these are summed.
    pub voxels: u64,
}

/// The channels of a sequence, in the order in which they were met.
#[derive(Debug, Clone, Default, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Plan {
    /// The channels.
    pub channels: Vec<ChannelPlan>,
    /// Grids that cannot be packed, each once, and why.
    pub left_out: Vec<String>,
}

/// One channel of a frame: single-precision numbers in a standard tree.
#[derive(Debug, Clone)]
pub struct ChannelTree<'g> {
    /// Which channel.
    pub key: ChannelKey,
    /// The index of the grid it comes from.
    pub grid: usize,
    /// The values.
    pub tree: Cow<'g, Tree<f32>>,
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
            max_error: f32::INFINITY,
        }
    }
}

impl Plan {
    /// Adds what one frame holds.
    pub fn note(&mut self, grids: &[Grid]) {
        let (trees, left_out) = channel_trees(grids);
        let channels = trees.into_iter().map(|ChannelTree { key, grid, tree }| {
            let Survey { min, max, voxels, bricks } = survey(&tree);
            ChannelPlan {
                key,
                role: role(&grids[grid]),
                min,
                max,
                voxels,
                bricks,
                lambda: Lambda::NONE,
                shapes: Arc::default(),
                before: None,
            }
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
                    channel.voxels += found.voxels;
                    channel.bricks += found.bricks;
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
pub fn channel_trees(grids: &[Grid]) -> (Vec<ChannelTree<'_>>, Vec<String>) {
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
                (0..3).for_each(|c| add(Some(c as u8), Cow::Owned(tree.map(|value| finite(value[c])))));
            }
            AnyTree::Vec3d(tree) => {
                let component = |c: usize| tree.map(|value| finite(value[c] as f32));
                (0..3).for_each(|c| add(Some(c as u8), Cow::Owned(component(c))));
            }
            AnyTree::Float(tree) if is_finite(tree) => add(None, Cow::Borrowed(tree)),
            AnyTree::Float(tree) => add(None, Cow::Owned(tree.map(finite))),
            AnyTree::Double(tree) => add(None, Cow::Owned(tree.map(|value| finite(value as f32)))),
            AnyTree::Half(tree) => add(None, Cow::Owned(tree.map(|value| finite(value.to_f32())))),
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

/// Whether [`finite`] would change no value of a tree.
fn is_finite(tree: &Tree<f32>) -> bool {
    let all = |values: &[f32]| values.iter().fold(true, |all, value| all & (value.abs() <= LARGEST));
    let leaves = tree.leaves.values.chunks(1 << 12).all(all);
    leaves && tile_values(tree).all(|value| value.abs() <= LARGEST)
}

/// The values of all tiles and the background.
fn tile_values(tree: &Tree<f32>) -> impl Iterator<Item = f32> {
    let tiles = tree.inner_nodes().flat_map(|(_, node)| node.tile_slots().map(|(_, value, _)| value));
    tiles.chain(tree.root_tiles.iter().map(|tile| tile.value)).chain([tree.background])
}

/// What there is to know of a tree before it is encoded.
struct Survey {
    min: f32,
    max: f32,
    /// Of bricks that are not constant: the voxels that differ from the background.
    voxels: u64,
    /// Bricks that are not constant.
    bricks: u64,
}

fn survey(tree: &Tree<f32>) -> Survey {
    const EMPTY: Survey = Survey { min: f32::INFINITY, max: f32::NEG_INFINITY, voxels: 0, bricks: 0 };
    let add = |sum: Survey, part: Survey| Survey {
        min: sum.min.min(part.min),
        max: sum.max.max(part.max),
        voxels: sum.voxels + part.voxels,
        bricks: sum.bricks + part.bricks,
    };
    let brick = |values: &[f32; BRICK_VOXELS]| {
        let mut found = EMPTY;
        for value in values {
            found.min = if *value < found.min { *value } else { found.min };
            found.max = if *value > found.max { *value } else { found.max };
            found.voxels += u64::from(*value != tree.background);
        }
        match found.min < found.max {
            true => Survey { bricks: 1, ..found },
            false => Survey { voxels: 0, ..found },
        }
    };
    const AT_ONCE: usize = 256;
    let bricks = tree.leaves.values.as_chunks::<BRICK_VOXELS>().0;
    let chunk = |i: usize| {
        let end = bricks.len().min((i + 1) * AT_ONCE);
        bricks[i * AT_ONCE..end].iter().map(brick).fold(EMPTY, add)
    };
    let leaves = each(bricks.len().div_ceil(AT_ONCE), chunk).into_iter().fold(EMPTY, add);
    tile_values(tree).map(|value| Survey { min: value, max: value, ..EMPTY }).fold(leaves, add)
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
