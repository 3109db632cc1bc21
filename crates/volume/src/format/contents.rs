//! What an asset holds, apart from trees and bricks: channels, frames, and what is known of their sources.

use serde::{Deserialize, Deserializer, Serialize};

use crate::packed::TreeRef;

/// All of an asset's channels and frames.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Contents {
    /// Frames per second, if known.
    pub frame_rate: Option<f64>,
    /// The channels, which grids refer to by their index.
    pub channels: Vec<ChannelInfo>,
    /// The frames in order.
    pub frames: Vec<Frame>,
    /// What the writer was asked for, if it says so: frames that are added later are to meet it too.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub asked: Option<Asked>,
    /// A digest of all that the writer made the file by, apart from its sources; only the writer knows of what.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub recipe: Option<String>,
}

/// What a writer was asked for.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct Asked {
    /// Of all channels.
    pub all: AskedOfChannel,
    /// Of the channels of single grids, by the grid's name: if it asks for size or error, in place of what is asked of all.
    pub channels: Vec<(String, AskedOfChannel)>,
    /// How many coarser levels at most.
    pub coarser_levels: u32,
    /// How many shapes a channel's bricks share at most.
    pub shapes: u32,
}

/// What a writer was asked for, of a channel.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default)]
pub struct AskedOfChannel {
    /// The largest error, in a channel's own numbers.
    pub max_error: Option<f32>,
    /// The largest error, as a part of a channel's peak.
    pub max_error_of_peak: Option<f32>,
    /// The ratio of peak to noise, in decibels.
    pub psnr: Option<f64>,
    /// The most bits per voxel of bricks that are not constant.
    pub bits_per_voxel: Option<f64>,
    /// The tag of the one codec that all bricks were to have.
    pub codec: Option<u8>,
    /// What the values mean, if not what the writer takes them for.
    pub role: Option<Role>,
    /// The unit that the values are measured in.
    pub physical_unit: Option<String>,
}

/// What the values of a channel are, and how exact.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ChannelInfo {
    /// The name of the source's grid.
    pub name: String,
    /// Which component of a vector grid it is: 0, 1 or 2.
    pub component: Option<u8>,
    /// What the values mean.
    pub role: Role,
    /// The unit that the values are measured in, such as `K`; empty if unknown.
    pub physical_unit: String,
    /// The codecs' unit: a power of two, not less than any magnitude.
    pub unit: f32,
    /// The smallest value: decoded values are raised to it.
    pub floor: f32,
    /// The largest value.
    pub peak: f32,
    /// How far decoded values are from the source's, as measured.
    pub quality: Quality,
    /// The largest error that was asked for.
    pub asked_max_error: Option<f32>,
    /// The ratio of peak to noise that was asked for, in decibels.
    pub asked_psnr: Option<f64>,
    /// What the encoder settled on, if the writer says so.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub encoding: Option<Encoding>,
}

/// What the encoder of a channel settled on: with it, equal bricks of frames that are added later get equal words.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Encoding {
    /// The weight of a squared error of 1, in units of the channel, in words.
    pub lambda: f64,
    /// The smallest and the largest value that it counted with. The peak may have grown since, up to the unit.
    pub range: [f32; 2],
    /// The bricks of the sources that are not constant.
    pub source_bricks: u64,
}

/// What the values of a channel mean.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
pub enum Role {
    /// How much there is.
    Density,
    /// How hot it is.
    Temperature,
    /// How much burns.
    Flame,
    /// How fast it moves.
    Velocity,
    /// The distance to a surface, negative inside.
    SignedDistance,
    /// A colour.
    Colour,
    /// Anything else, and what later versions may know.
    Other,
}

impl<'de> Deserialize<'de> for Role {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Role, D::Error> {
        Ok(match String::deserialize(deserializer)?.as_str() {
            "Density" => Role::Density,
            "Temperature" => Role::Temperature,
            "Flame" => Role::Flame,
            "Velocity" => Role::Velocity,
            "SignedDistance" => Role::SignedDistance,
            "Colour" => Role::Colour,
            _ => Role::Other,
        })
    }
}

/// Errors, measured over all frames.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Quality {
    /// The largest difference.
    pub max_error: f32,
    /// The sum of all squared differences.
    pub squared_error: f64,
    /// How many voxels were compared.
    pub voxels: u64,
}

impl Quality {
    /// The ratio of a channel's peak to its error in decibels, `10·log10(peak² / mean squared error)`; infinite if there
    /// is no error.
    pub fn psnr(&self, peak: f32) -> f64 {
        match self.squared_error > 0.0 {
            true => {
                let mean = self.squared_error / self.voxels.max(1) as f64;
                10.0 * (f64::from(peak).powi(2) / mean).log10()
            }
            false => f64::INFINITY,
        }
    }
}

/// A moment.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct Frame {
    /// Its number in the source's sequence, if it had one.
    pub number: Option<i64>,
    /// The name of its source.
    pub name: String,
    /// Its grids.
    pub grids: Vec<FrameGrid>,
    /// A digest of its source, if the writer took one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub source: Option<String>,
}

/// One channel at one moment.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FrameGrid {
    /// The index of the channel.
    pub channel: u32,
    /// The trees of all levels of detail, finest first; a level has half the voxels per axis of that before.
    pub levels: Vec<TreeRef>,
    /// What is added to a stored index for the source's.
    pub index_offset: [i32; 3],
    /// The first and the last active voxel along each axis in the source's indices. None if nothing is active.
    pub active_box: Option<[[i32; 3]; 2]>,
    /// From the source's indices to the world: the columns for x, y and z, then the translation. None if that is not
    /// linear.
    pub world_from_index: Option<[f64; 12]>,
    /// What is needed to write the source's kind of file again; only its writer knows more of it.
    #[serde(skip)]
    pub source_header: Vec<u8>,
}

impl Contents {
    /// All grids of all frames in order.
    pub fn grids(&self) -> impl Iterator<Item = &FrameGrid> {
        self.frames.iter().flat_map(|frame| &frame.grids)
    }

    /// The memory taken, roughly.
    pub fn memory_bytes(&self) -> usize {
        let grid = |grid: &FrameGrid| {
            size_of::<FrameGrid>() + size_of_val(grid.levels.as_slice()) + grid.source_header.len()
        };
        let frames = self.frames.iter().map(|frame| size_of::<Frame>() + frame.name.len()).sum::<usize>();
        let channels =
            self.channels.iter().map(|it| size_of::<ChannelInfo>() + it.name.len() + it.physical_unit.len());
        frames + channels.sum::<usize>() + self.grids().map(grid).sum::<usize>()
    }

    /// What cannot be, in words, of numbers alone.
    pub(super) fn fault(&self) -> Option<String> {
        for channel in &self.channels {
            let is_power = channel.unit.is_normal() && channel.unit > 0.0 && channel.unit.to_bits() << 9 == 0;
            let floats = [channel.floor, channel.peak, channel.quality.max_error];
            let lambda = channel.encoding.map(|encoding| encoding.lambda);
            let doubles = [Some(channel.quality.squared_error), channel.asked_psnr, lambda];
            let asked = channel.asked_max_error.is_none_or(f32::is_finite);
            if !is_power {
                return Some(format!("channel {:?} has a unit that is no power of two", channel.name));
            }
            let range = channel.encoding.map_or([0.0; 2], |encoding| encoding.range);
            if !floats.into_iter().chain(range).all(f32::is_finite)
                || !doubles.into_iter().flatten().all(f64::is_finite)
                || !asked
            {
                return Some(format!("channel {:?} has a number that is not finite", channel.name));
            }
            if range.iter().any(|value| value.abs() > channel.unit) {
                return Some(format!("channel {:?} has a range beyond its unit", channel.name));
            }
            if channel.component.is_some_and(|component| component > 2) {
                return Some(format!("channel {:?} is a component beyond the third", channel.name));
            }
        }
        if !self.frame_rate.is_none_or(f64::is_finite) {
            return Some("a frame rate that is not finite".to_owned());
        }
        for grid in self.grids() {
            if grid.channel as usize >= self.channels.len() {
                return Some(format!("a grid of channel {}, of {}", grid.channel, self.channels.len()));
            }
            let transform = grid.world_from_index.iter().flatten();
            let backgrounds = grid.levels.iter().all(|level| level.background.is_finite());
            if !backgrounds || !transform.copied().all(f64::is_finite) {
                return Some("a grid with a number that is not finite".to_owned());
            }
        }
        None
    }
}
