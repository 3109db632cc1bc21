//! Adding frames to a packed file: what was asked of it holds for them too, and its channels take what they can hold.
//!
//! A channel takes values up to its unit; with the range and the λ that it was encoded with, equal bricks get equal words
//! and are shared; shapes are found anew. What no channel can hold becomes another channel of the same name. Copying what is there is
//! [`super::assemble`]'s.

use nuage_volume::codec::Codec;
use nuage_volume::format::{Asked, AskedOfChannel, ChannelInfo, Contents};

use super::options::{Bound, ChannelOptions, Options};
use super::plan::{Before, ChannelKey, ChannelPlan, Plan};
use crate::encode::choose::Lambda;

/// What options ask for, as it stands in a file.
pub fn asked(options: &Options) -> Asked {
    let of = |asked: &ChannelOptions| {
        let (max_error, max_error_of_peak) = match asked.max_error {
            Some(Bound::Absolute(error)) => (Some(error), None),
            Some(Bound::OfPeak(part)) => (None, Some(part)),
            None => (None, None),
        };
        AskedOfChannel {
            max_error,
            max_error_of_peak,
            psnr: asked.psnr,
            bits_per_voxel: asked.bits_per_voxel,
            codec: asked.codec.map(Codec::tag),
            role: asked.role,
            physical_unit: asked.physical_unit.clone(),
        }
    };
    let all = ChannelOptions {
        max_error: options.max_error,
        psnr: options.psnr,
        bits_per_voxel: options.bits_per_voxel,
        codec: options.codec,
        ..ChannelOptions::default()
    };
    Asked {
        all: of(&all),
        channels: options.channels.iter().map(|(name, asked)| (name.clone(), of(asked))).collect(),
        coarser_levels: options.coarser_levels,
        shapes: options.shapes,
    }
}

/// The options that a file was made with. `None` if it does not say, or names what this program does not know.
pub fn options(contents: &Contents) -> Option<Options> {
    let asked = contents.asked.as_ref()?;
    let of = |asked: &AskedOfChannel| {
        let codec = match asked.codec {
            Some(tag) => Some(Codec::from_tag(tag)?),
            None => None,
        };
        Some(ChannelOptions {
            max_error: asked.max_error.map(Bound::Absolute).or(asked.max_error_of_peak.map(Bound::OfPeak)),
            psnr: asked.psnr,
            bits_per_voxel: asked.bits_per_voxel,
            codec,
            role: asked.role,
            physical_unit: asked.physical_unit.clone(),
        })
    };
    let all = of(&asked.all)?;
    let channels = asked.channels.iter().map(|(name, asked)| Some((name.clone(), of(asked)?)));
    Some(Options {
        max_error: all.max_error,
        psnr: all.psnr,
        bits_per_voxel: all.bits_per_voxel,
        codec: all.codec,
        coarser_levels: asked.coarser_levels,
        shapes: asked.shapes,
        channels: channels.collect::<Option<_>>()?,
    })
}

/// Finds the channel of a file that takes each channel of a plan, if there is one. The plan then has the range that this
/// was encoded with.
pub fn settle(contents: &Contents, plan: &mut Plan) {
    let keys = keys(contents);
    for planned in &mut plan.channels {
        let mut candidates = contents.channels.iter().zip(&keys).enumerate();
        let settled = candidates.find_map(|(index, (channel, key))| {
            let is_same = key.as_ref() == Some(&planned.key) && channel.role == planned.role;
            let has_room = planned.peak() <= channel.unit && (planned.min >= 0.0 || channel.floor < 0.0);
            (is_same && has_room).then(|| continued(planned, index, channel))?
        });
        if let Some(settled) = settled {
            *planned = settled;
        }
    }
}

/// The plan of a channel that a file has. `None` if this program would not have encoded it so.
fn continued(planned: &ChannelPlan, index: usize, channel: &ChannelInfo) -> Option<ChannelPlan> {
    let encoding = channel.encoding?;
    let [min, max] = encoding.range;
    let before = Before {
        channel: index,
        lambda: Lambda::of_weight(encoding.lambda),
        peak: channel.peak.max(planned.peak()),
        squared_error: channel.quality.squared_error / f64::from(channel.unit).powi(2),
        voxels: channel.quality.voxels,
    };
    let settled = ChannelPlan { min, max, before: Some(before), ..planned.clone() };
    let scale = settled.scale(0.0);
    ((scale.unit, scale.floor) == (channel.unit, channel.floor)).then_some(settled)
}

/// Which channel of the sources each one of a file is: one more of the same name in the same frame is the next of that
/// name. `None` if no frame has it.
fn keys(contents: &Contents) -> Vec<Option<ChannelKey>> {
    let mut keys: Vec<Option<ChannelKey>> = vec![None; contents.channels.len()];
    for frame in &contents.frames {
        let channels: Vec<usize> = frame.grids.iter().map(|grid| grid.channel as usize).collect();
        for (place, index) in channels.iter().enumerate() {
            let of = |index: usize| contents.channels.get(index).map(|found| (&found.name, found.component));
            let Some((name, component)) = of(*index) else { continue };
            let repeat = channels[..place].iter().filter(|other| of(**other) == of(*index)).count() as u32;
            if let Some(key @ None) = keys.get_mut(*index) {
                *key = Some(ChannelKey { grid: name.clone(), repeat, component });
            }
        }
    }
    keys
}
