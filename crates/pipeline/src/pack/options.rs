//! What is asked of a packed volume, of all its channels or of one by name, and whether it was met.
//!
//! How bricks come to keep to it is [`crate::encode::choose`]'s.

use std::fmt;

use nuage_volume::codec::Codec;
use nuage_volume::format::Role;

use super::assemble::Report;
use super::plan::Plan;

/// How large an error may be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Bound {
    /// In the channel's own numbers.
    Absolute(f32),
    /// As a part of the channel's peak over all frames.
    OfPeak(f32),
}

impl Bound {
    /// The error in the numbers of a channel with this peak.
    pub fn of(self, peak: f32) -> f32 {
        match self {
            Bound::Absolute(error) => error,
            Bound::OfPeak(part) => part * peak,
        }
    }
}

/// What is asked of a packed volume.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// The largest error of any voxel.
    pub max_error: Option<Bound>,
    /// The least ratio of a channel's peak to its error over all frames, in dB.
    pub psnr: Option<f64>,
    /// The most bits per voxel of bricks that are not constant, over all frames, entries included.
    pub bits_per_voxel: Option<f64>,
    /// One codec for all bricks that it can hold, whatever the error.
    pub codec: Option<Codec>,
    /// How many coarser levels are made at most.
    pub coarser_levels: u32,
    /// How many shapes the bricks of a channel may share at most. Finding them takes long, and only where large errors are
    /// allowed do they save much.
    pub shapes: u32,
    /// What is asked of the channels of single grids, by the grid's name.
    pub channels: Vec<(String, ChannelOptions)>,
}

/// What is asked of the channels of one grid.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ChannelOptions {
    /// As [`Options::max_error`].
    pub max_error: Option<Bound>,
    /// As [`Options::psnr`].
    pub psnr: Option<f64>,
    /// As [`Options::bits_per_voxel`].
    pub bits_per_voxel: Option<f64>,
    /// As [`Options::codec`].
    pub codec: Option<Codec>,
    /// What the values mean, if not what class and name of the grid say.
    pub role: Option<Role>,
    /// The unit that the values are measured in, such as `K`.
    pub physical_unit: Option<String>,
}

impl Default for Options {
    fn default() -> Self {
        Options {
            max_error: Some(Bound::OfPeak(0.03)),
            psnr: Some(45.0),
            bits_per_voxel: None,
            codec: None,
            coarser_levels: 0,
            shapes: 0,
            channels: Vec::new(),
        }
    }
}

/// Something is asked of a channel that is not there.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("something is asked of channel '{name}', which is in no frame; there are: {}", there.join(", "))]
pub struct NoSuchChannel {
    /// The name.
    pub name: String,
    /// The names of the grids that are packed.
    pub there: Vec<String>,
}

impl ChannelOptions {
    /// Whether anything is asked of size or error.
    fn is_asked(&self) -> bool {
        self.max_error.is_some()
            || self.psnr.is_some()
            || self.bits_per_voxel.is_some()
            || self.codec.is_some()
    }

    /// Whether errors have to be weighed against words.
    fn is_weighed(&self) -> bool {
        self.codec.is_none() && (self.psnr.is_some() || self.bits_per_voxel.is_some())
    }
}

impl Options {
    /// What is asked of the channels of a grid. Size and error that are asked of it by name replace those asked of all.
    pub fn for_channel(&self, name: &str) -> ChannelOptions {
        let named = self.channels.iter().find(|(channel, _)| channel == name);
        match named.map(|(_, asked)| asked.clone()) {
            Some(asked) if asked.is_asked() => asked,
            other => ChannelOptions {
                max_error: self.max_error,
                psnr: self.psnr,
                bits_per_voxel: self.bits_per_voxel,
                codec: self.codec,
                ..other.unwrap_or_default()
            },
        }
    }

    /// Whether errors have to be weighed against words in any channel.
    pub(super) fn is_weighed(&self) -> bool {
        let names = self.channels.iter().map(|(name, _)| name.as_str());
        names.chain([""]).any(|name| self.for_channel(name).is_weighed())
    }

    /// Gives the channels of a plan the roles that are asked for, as far as they are there.
    ///
    /// # Errors
    /// If something is asked of a channel that the plan does not have.
    pub(super) fn apply(&self, plan: &mut Plan) -> Result<(), NoSuchChannel> {
        let mut missing = None;
        for (name, asked) in &self.channels {
            let mut is_there = false;
            for channel in plan.channels.iter_mut().filter(|channel| channel.key.grid == *name) {
                is_there = true;
                channel.role = asked.role.unwrap_or(channel.role);
            }
            if !is_there {
                let mut there: Vec<String> = plan.channels.iter().map(|c| c.key.grid.clone()).collect();
                there.dedup();
                missing = missing.or(Some(NoSuchChannel { name: name.clone(), there }));
            }
        }
        missing.map_or(Ok(()), Err)
    }
}

/// Something that was asked of a channel and not met.
#[derive(Debug, Clone, PartialEq)]
pub struct Unmet {
    /// The name of the grid.
    pub channel: String,
    /// Which component of a vector grid.
    pub component: Option<u8>,
    /// What was asked.
    pub what: Asked,
    /// How much.
    pub asked: f64,
    /// What became of it.
    pub found: f64,
}

/// What can be asked of a channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Asked {
    /// [`Options::max_error`], in the channel's own numbers.
    MaxError,
    /// [`Options::psnr`].
    Psnr,
    /// [`Options::bits_per_voxel`].
    BitsPerVoxel,
}

impl fmt::Display for Unmet {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let axis = self.component.map_or("", |c| [".x", ".y", ".z"][usize::from(c.min(2))]);
        let Unmet { channel, asked, found, .. } = self;
        write!(f, "{channel}{axis}: ")?;
        match self.what {
            Asked::MaxError => write!(f, "the largest error is {found}, above the {asked} asked for"),
            Asked::Psnr => write!(f, "{found:.2} dB are below the {asked} asked for"),
            Asked::BitsPerVoxel => write!(f, "{found:.2} bits per voxel are above the {asked} asked for"),
        }
    }
}

/// What of the options a packed file does not meet: a size that the errors allowed do not permit, a ratio that the size
/// or the codec asked for does not, an error that a codec asked for makes.
pub fn unmet(report: &Report, options: &Options) -> Vec<Unmet> {
    let mut all = Vec::new();
    for (channel, size) in report.contents.channels.iter().zip(&report.channels) {
        let asked = options.for_channel(&channel.name);
        let quality = channel.quality;
        let mut note = |what, asked, found| {
            let (name, component) = (channel.name.clone(), channel.component);
            all.push(Unmet { channel: name, component, what, asked, found });
        };
        if let Some(bound) = asked.max_error.map(|bound| bound.of(channel.peak))
            && quality.max_error > bound
        {
            note(Asked::MaxError, f64::from(bound), f64::from(quality.max_error));
        }
        let psnr = quality.psnr(channel.peak);
        // Sums of one and the same numbers differ by their order.
        if let Some(least) = asked.psnr.filter(|least| psnr + 1e-3 < *least) {
            note(Asked::Psnr, least, psnr);
        }
        let bits = size.bits_per_voxel();
        if let Some(most) = asked.bits_per_voxel.filter(|most| bits > most * (1.0 + 1e-9)) {
            note(Asked::BitsPerVoxel, most, bits);
        }
    }
    all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_asked_by_name_replaces_what_is_asked_of_all() {
        let named = ChannelOptions { psnr: Some(60.0), ..ChannelOptions::default() };
        let unit = ChannelOptions { physical_unit: Some("K".into()), ..ChannelOptions::default() };
        let options = Options {
            channels: vec![("density".into(), named.clone()), ("heat".into(), unit)],
            ..Options::default()
        };
        assert_eq!(options.for_channel("density"), named);
        let heat = options.for_channel("heat");
        assert_eq!((heat.max_error, heat.psnr), (options.max_error, options.psnr));
        assert_eq!(heat.physical_unit.as_deref(), Some("K"));
        assert_eq!(options.for_channel("other").psnr, options.psnr);
        let codec = Options { psnr: None, max_error: None, codec: Some(Codec::F16), ..options.clone() };
        assert!(codec.is_weighed(), "density is");
        assert!(!Options { channels: Vec::new(), ..codec }.is_weighed());
    }

    #[test]
    fn what_was_not_met_is_said_with_its_numbers() {
        let unmet = Unmet {
            channel: "velocity".into(),
            component: Some(1),
            what: Asked::BitsPerVoxel,
            asked: 1.5,
            found: 2.25,
        };
        assert_eq!(unmet.to_string(), "velocity.y: 2.25 bits per voxel are above the 1.5 asked for");
    }
}
